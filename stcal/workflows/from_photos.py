"""From photographs of the target on an arm to joint values that reach points: measure, axes, identify, compensate.

The way of Zhang & Wei (2017) in one go. Every step's files are those of its own command, so that each can be repeated
by itself.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DegenerateError, InputError
from stcal.io.camera import CameraModel
from stcal.io.join import join
from stcal.io.saving import json_text, real_place, save
from stcal.io.table import Table, read_table
from stcal.report.figure import COLOURS, calm, new_figure, uri
from stcal.report.page import render
from stcal.report.text import number
from stcal.robot.axes.model import AxesResult, robot_from_sweeps
from stcal.robot.axes.orientations import length_of, ring
from stcal.robot.axes.report import axes_file, axes_page
from stcal.robot.axes.sweeps import find_arcs
from stcal.robot.identify.report import identified_file, identified_page
from stcal.robot.identify.result import Identified, IdentifyOptions
from stcal.robot.identify.solve import identify
from stcal.robot.kinematics.file import robot_toml
from stcal.robot.kinematics.measurements import Measurements, read_measurements
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import (
    Compensated,
    compensate,
    compensated_csv,
    compensated_summary,
    compensation_file,
)
from stcal.robot.use.evaluation import Figures, evaluate
from stcal.robot.use.report import compensation_page
from stcal.robot.use.targets import read_targets
from stcal.sfm.measure.images import MeasureOptions, MeasureResult, measure
from stcal.sfm.measure.output import poses_csv, poses_file, summary
from stcal.sfm.measure.report import measure_page
from stcal.sfm.measure.target import TargetCircles

POSES = "poses.csv"
DRAWING, AXES, SAME_ROWS = "as drawn", "by the axis method", "identified, the same rows"
PAGES = {
    "poses.html": "Poses of the target in the photographs",
    "axes.html": "Axes by the axis method",
    "identified.html": "Identification of the arm",
    "compensated.html": "Joint values for the targets",
}
MOST_NOTES = 20


@dataclass(frozen=True, slots=True, eq=False)
class FromPhotos:
    """What was found on the way.

    Parameters
    ----------
    images : str
        The folder.
    measured : MeasureResult
        Poses of the target.
    nominal : Robot
        As drawn.
    data : Measurements
        Poses with their joint values.
    axes : AxesResult or None
        The axis method, where every joint is swept …
    without_axes : str
        … and else why not.
    identified : Identified
        From all poses.
    compensated : Compensated or None
        Joint values for the targets, where there are any.
    errors : dict of str to Figures
        Position errors of the rows, mm: as drawn and by the axis method with base and tool fitted, identified, and of
        rows held out.
    notes : tuple of str
        On rows and photographs that have no partner, and of what was read.
    """

    images: str
    measured: MeasureResult
    nominal: Robot
    data: Measurements
    axes: AxesResult | None
    without_axes: str
    identified: Identified
    compensated: Compensated | None
    errors: dict[str, Figures]
    notes: tuple[str, ...]

    def files(self) -> dict[str, str]:
        """By name, all that is written."""
        identified, found = self.identified.robot, self.compensated
        files = {
            POSES: poses_csv(self.measured)[0],
            "poses.json": json_text(poses_file(self.measured)),
            "poses.html": measure_page(self.measured, self.images),
        }
        if self.axes is not None:
            files |= {
                "axes.toml": robot_toml(self.axes.robot, ["Identified by the axis method from the sweeps."]),
                "axes.json": json_text(axes_file(self.axes)),
                "axes.html": axes_page(self.axes, self.data.where),
            }
        said = f"Identified from {self.data.where}: {self.identified.rank} parameters."
        files |= {
            "identified.toml": robot_toml(identified, [said]),
            "identified.json": json_text(identified_file(self.identified, self.nominal)),
            "identified.html": identified_page(self.identified, self.nominal),
        }
        if found is not None:
            files |= {
                "compensated.csv": compensated_csv(found, identified),
                "compensated.json": json_text(compensation_file(found, identified)),
                "compensated.html": compensation_page(found, identified),
            }
        return files | {"report.html": from_photos_page(self, tuple(files))}


def from_photos(
    images: str | Path,
    camera: CameraModel,
    target: TargetCircles,
    design: TargetDesign,
    joints: str | Path,
    nominal: Robot,
    targets: str | Path | Table | None = None,
    board: BoardDesign | None = None,
    key: str = "image",
    measure_options: MeasureOptions | None = None,
    options: IdentifyOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> FromPhotos:
    """Measure the target in photographs, identify the arm that carried it, and compensate targets.

    Parameters
    ----------
    images, camera, target, design, board, progress
        As of :func:`stcal.sfm.measure.images.measure`.
    joints : path
        Table of joint values with a column ``key`` that names each one's photograph (CSV).
    nominal : Robot
        The arm as drawn, mm and rad; what the controller commands by.
    targets : path or Table, optional
        Poses or joint values to compensate.
    key : str
        Name of that column.
    measure_options, options
        Of measuring and of identifying; the defaults where None.

    Returns
    -------
    FromPhotos
        All results, mm and rad, in the camera's frame.

    Raises
    ------
    StcalError
        One of its kinds, of the step that failed, with a one-line message that says what to do.
    """
    wanted = None if targets is None else read_targets(targets, nominal)  # before the work: both may be refused
    values = read_table(joints, "joints")
    measured = measure(images, camera, target, design, board, measure_options, progress)
    with tempfile.TemporaryDirectory(prefix="stcal-photos-") as folder:
        own = Path(folder) / POSES
        save(own, poses_csv(measured)[0])
        joined = join(replace(read_table(own, "poses"), where="the photographs"), values, key)
    data = read_measurements(joined.table, nominal)
    axes, without = _axes(data, nominal)
    found = identify(nominal, data, options)
    compensated = None if wanted is None else compensate(found.robot, wanted, nominal)
    models = {DRAWING: nominal} if axes is None else {DRAWING: nominal, AXES: axes.robot}
    evaluation = evaluate(models, data)
    good = ~evaluation.wrong
    errors = {name: Figures.of(each.errors_mm[good]) for name, each in zip(models, evaluation.robots, strict=True)}
    errors[SAME_ROWS] = Figures.of(found.fitted_mm[good])
    if found.held_out is not None:
        held = found.held_out.position_mm[:, good]
        errors[f"identified, {found.held_out.folds} folds held out"] = Figures.of(held[np.isfinite(held)])
    return FromPhotos(
        str(images),
        measured,
        nominal,
        data,
        axes,
        without,
        found,
        compensated,
        errors,
        joined.notes + tuple(data.notes),
    )


def _axes(data: Measurements, nominal: Robot) -> tuple[AxesResult | None, str]:
    """The axis method by the rows that sweep one joint each; or why not."""
    try:
        arcs, _ = find_arcs(data, nominal)
        rows = np.unique(np.concatenate([arc.rows for arc in arcs]))
        length_mm = length_of(data)
        return robot_from_sweeps(data[rows], nominal, places=None if length_mm is None else ring(length_mm)), ""
    except (InputError, DegenerateError) as error:
        return None, str(error).removeprefix(f"{data.where}: ")


def require_new_folder(out: Path, images: Path) -> None:
    """Refuse, before the work, a place that holds anything, or that lies among the photographs.

    Raises
    ------
    InputError
        Which.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: is not a new or empty folder; give another place")
    if real_place(images) in (real_place(out), *real_place(out).parents):
        raise InputError(f"--out {out}: lies in the folder of the photographs {images}; give another place")


def save_folder(out: Path, files: dict[str, str]) -> None:
    """Write all files into a new folder, or none.

    Raises
    ------
    InputError
        They cannot be written.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as folder:
        made = Path(folder) / "made"
        for name, content in files.items():
            save(made / name, content)
        try:
            made.replace(out)
        except OSError as error:
            raise InputError(f"{out}: cannot be written: {error.strerror or error}; give another place") from error


def story(result: FromPhotos) -> list[str]:
    """What was done and found, a sentence a step."""
    identified, least = result.identified, list(result.errors.values())[-1]
    said = [*summary(result.measured), f"{len(result.data)} poses have joint values"]
    if result.axes is None:
        said.append(f"the axis method was left out: {result.without_axes}")
    else:
        spans = [
            f"{np.degrees(fit.span):.0f}°" if len(fit.gain) != 2 else f"{fit.span:.0f} mm" for fit in result.axes.fits
        ]
        said.append(f"every joint is swept by itself, over {', '.join(spans)}: axis method")
    said.append(
        f"identified: {identified.rank} parameters; position errors {result.errors[DRAWING].rms:.3g} mm RMS as drawn, "
        f"{least.rms:.3g} mm {'of rows held out' if identified.held_out else 'of the same rows'}"
    )
    if result.compensated is not None:
        said += [line[0].lower() + line[1:] for line in compensated_summary(result.compensated)]
    return said


def from_photos_page(result: FromPhotos, names: tuple[str, ...]) -> str:
    """The report: the story, errors of each model of the arm, and where the rest is; ``names`` : of the other files."""
    found, last = result.compensated, list(result.errors.values())[-1]
    before = None if found is None or not found.compared().any() else found.before_mm[found.compared()]
    tiles = [
        (str(len(result.data)), "", "poses measured, with joint values"),
        (number(result.errors[DRAWING].rms, 3), "mm RMS", "position error of the arm as drawn"),
        (number(last.rms, 3), "mm RMS", list(result.errors)[-1]),
    ]
    if before is not None:
        tiles.append((number(float(np.sqrt((before**2).mean())), 3), "mm RMS", "taken away at the targets"))
    notes = [
        *result.notes,
        *(f"{each.name}: {each.reason}" for each in result.measured.left_out),
        *result.identified.notes,
        *([] if found is None else found.notes()),
    ]
    return render(
        "workflows/from_photos.html.jinja",
        robot=result.nominal.name,
        images=result.images,
        figures=tiles,
        story=story(result),
        errors=[
            [name, str(each.rows), *(number(v, 4) for v in (each.mean, each.rms, each.p95, each.max))]
            for name, each in result.errors.items()
        ],
        drawn=uri(_figure(result)),
        pages=[(name, PAGES[name]) for name in names if name in PAGES],
        files=[name for name in names if not name.endswith(".html")],
        notes=notes[:MOST_NOTES],
        more=max(len(notes) - MOST_NOTES, 0),
    )


def _figure(result: FromPhotos):
    """Mean, RMS and largest error of each model, on a scale of powers of ten."""
    figure = new_figure(8, 0.5 * len(result.errors) + 0.9)
    axes = figure.add_subplot()
    for place, each in enumerate(result.errors.values()):
        axes.plot([each.median, each.max], [place, place], color=COLOURS[0], lw=1.2)
        axes.plot([each.rms], [place], "o", color=COLOURS[0], ms=6, label="RMS" if not place else None)
        axes.plot([each.max], [place], "|", color=COLOURS[1], ms=10, mew=2, label="largest" if not place else None)
    axes.set_yticks(range(len(result.errors)), list(result.errors), fontsize=8)
    axes.set_ylim(len(result.errors) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlabel("position error of a row, mm", fontsize=8)
    axes.legend(fontsize=7.5, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
    calm(axes)
    figure.subplots_adjust(left=0.3, right=0.97, bottom=0.5 / (0.5 * len(result.errors) + 0.9), top=0.86)
    return figure
