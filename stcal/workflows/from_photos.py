"""From photographs of the target on an arm to joint values that reach points: measure, axes, identify, compensate.

The way of Zhang & Wei (2017) in one go. Every step's files are those of its own command, so that each can be repeated
by itself.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.rigid import Rigid
from stcal.io.camera import CameraModel
from stcal.io.images import find_images
from stcal.io.join import join
from stcal.io.saving import json_text, real_place, save
from stcal.io.table import POSE, Table, read_table
from stcal.report.figure import COLOURS, calm, new_figure, uri
from stcal.report.page import render
from stcal.report.text import number
from stcal.robot.axes.model import AxesResult, robot_from_sweeps
from stcal.robot.axes.orientations import length_of, ring
from stcal.robot.axes.report import axes_file, axes_page
from stcal.robot.axes.sweeps import find_arcs
from stcal.robot.identify.predicted import predicted_at
from stcal.robot.identify.report import identified_file, identified_page
from stcal.robot.identify.result import Identified, IdentifyOptions
from stcal.robot.identify.solve import identify
from stcal.robot.kinematics.file import robot_toml
from stcal.robot.kinematics.measurements import Measurements, joint_values, read_measurements, targets_of
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
from stcal.robot.use.targets import Targets, read_targets
from stcal.sfm.measure.images import MeasureOptions, MeasureResult, measure
from stcal.sfm.measure.output import IMAGE, poses_csv, poses_file, summary
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
MOST_NOTES, MOST_TARGETS = 20, 20
PHOTOGRAPHS = "the photographs"


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

    def sigma_mm(self) -> np.ndarray:
        """(t,) predicted σ of the tool's position at the targets, mm; nan where not reached, or of unmeasured tools."""
        found, sigma = self.compensated, self.identified.predicted
        if found is None or sigma is None:
            return np.zeros(0)
        at = predicted_at(sigma, self.identified.state, "pose", found.found.q, found.targets.tools)
        return np.where(found.found.usable, at, np.nan)

    def moves(self) -> np.ndarray:
        """(t, n) joint values to send less those of the arm as drawn, rad or mm; nan where one of both is none."""
        found = self.compensated
        if found is None or found.nominal is None:
            return np.zeros((0, len(self.nominal.rows)))
        return np.where(found.compared()[:, None], found.found.q - found.nominal.q, np.nan)

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
    # before the work, as both may be refused
    values = read_joints(joints, key, [each.name for each in find_images(images)[0]], nominal)
    carried = dict.fromkeys(targets_of(values), Rigid())
    wanted = None if targets is None else read_targets(targets, replace(nominal, tools=carried))
    measured = measure(images, camera, target, design, board, measure_options, progress)
    return from_measured(str(images), measured, values, nominal, wanted, options)


def read_joints(path: str | Path, key: str, photographs: Sequence[str], nominal: Robot) -> Table:
    """Joint values with the name of each one's photograph in the column ``image``, in place of ``key``.

    Raises
    ------
    InputError
        No such column, none of the photographs, one twice, poses beside the joint values, or not those of the robot.
    """
    values, nowhere = read_table(path, "joints"), np.zeros(len(photographs))
    files = Table(PHOTOGRAPHS, {key: list(photographs)} | dict.fromkeys(POSE, nowhere), range(len(photographs)))
    join(files, values, key)
    joint_values(values, nominal)
    own = {name: column for name, column in values.columns.items() if name not in (key, IMAGE)}
    return replace(values, columns={IMAGE: values.text(key)} | own, rows=())


def from_measured(
    images: str,
    measured: MeasureResult,
    values: Table,
    nominal: Robot,
    wanted: Targets | None = None,
    options: IdentifyOptions | None = None,
) -> FromPhotos:
    """The steps after the photographs are measured; arguments and errors as of :func:`from_photos`.

    ``values`` : as of :func:`read_joints`; ``wanted`` : what to compensate.
    """
    with tempfile.TemporaryDirectory(prefix="stcal-photos-") as folder:
        own = Path(folder) / POSES
        save(own, poses_csv(measured)[0])
        joined = join(replace(read_table(own, "poses"), where=PHOTOGRAPHS), values, IMAGE)
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
        images,
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
    except StcalError as error:  # a step that can be done without
        return None, str(error).removeprefix(f"{data.where}: ")


def require_new_folder(out: Path, images: Path) -> None:
    """Refuse, before the work, a place that holds anything, that lies among the photographs or cannot be written.

    Raises
    ------
    InputError
        Which.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: is not a new or empty folder; give another place")
    if real_place(images) in (real_place(out), *real_place(out).parents):
        raise InputError(f"--out {out}: lies in the folder of the photographs {images}; give another place")
    above = next(each for each in out.absolute().parents if each.exists())
    try:
        tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=above).cleanup()
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror or error}; give another place") from error


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
        said += _at_targets(result)
    return said


def _at_targets(result: FromPhotos) -> list[str]:
    """What the identified arm is expected to err by there, and how far the joints move."""
    said, sigma, moves = [], result.sigma_mm(), result.moves()
    known, moved = sigma[np.isfinite(sigma)], moves[np.isfinite(moves).all(axis=1)]
    here = result.identified.predicted
    if len(known) and here is not None:
        said.append(
            f"predicted σ of the tool's position there: {known.min():.2g} to {known.max():.2g} mm; at the measured "
            f"rows {np.sqrt((here.here_mm**2).mean()):.2g} mm RMS"
        )
    if len(moved):
        most = _shown(result, np.abs(moved).max(axis=0))
        each = [f"{number(v, 4)}{unit}" for v, unit in zip(most, _units(result), strict=True)]
        said.append(f"joints move by up to {', '.join(each)}")
    return said


def _units(result: FromPhotos) -> list[str]:
    """Of each joint's values, as shown."""
    return [" mm" if sliding else "°" for sliding in result.nominal.prismatic]


def _shown(result: FromPhotos, values: np.ndarray) -> np.ndarray:
    """Joint values (…, n) in those."""
    return np.where(result.nominal.prismatic, values, np.degrees(values))


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
        tiles.append(
            (number(float(np.sqrt((before**2).mean())), 3), "mm RMS", "taken away at the targets, base included")
        )
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
        heads=[f"J{i}, {unit.strip()}" for i, unit in enumerate(_units(result), 1)],
        targets=_target_rows(result),
        more_targets=0 if found is None else max(len(found) - MOST_TARGETS, 0),
        pages=[(name, PAGES[name]) for name in names if name in PAGES],
        files=[name for name in names if not name.endswith(".html")],
        notes=notes[:MOST_NOTES],
        more=max(len(notes) - MOST_NOTES, 0),
    )


def _target_rows(result: FromPhotos) -> list[list[str]]:
    """Of each target what its nominal joint values err by, the predicted σ, and by how much the joints move."""
    found = result.compensated
    if found is None:
        return []
    moves, sigma = _shown(result, result.moves()), result.sigma_mm()
    return [
        [
            str(found.targets.lines[i]),
            found.found.status[i],
            *(number(float(v), 4) for v in (found.before_mm[i], sigma[i], *moves[i])),
        ]
        for i in range(min(MOST_TARGETS, len(found)))
    ]


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
