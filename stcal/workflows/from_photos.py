"""All steps from photographs of the target on an arm to joint values that reach points.

The steps are measure, axes, identify, compensate. It is the method of Zhang & Wei (2017) in one go. The files of every
step are those of its own command, so that each step can be repeated by itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.files import json_text, save
from stcal.io.images import find_images
from stcal.io.join import join_tables
from stcal.io.json import ResultFile, require_result_written
from stcal.io.table import POSE, Table, read_table
from stcal.parallel import Progress, scratch_folder
from stcal.report.document import Block, Document, Section, bullets, links, listed, plot, tiles
from stcal.report.document import Table as ShownTable
from stcal.report.svg import COLOURS, Axes, Drawing, log_limits
from stcal.report.text import number
from stcal.robot.axes.model import AxesFile, AxesResult, robot_from_sweeps
from stcal.robot.axes.report import axes_report
from stcal.robot.axes.sweeps import find_arcs, length_of, ring
from stcal.robot.identification.observability import predicted_at
from stcal.robot.identification.report import identified_report
from stcal.robot.identification.result import (
    Figures,
    Identified,
    IdentifiedFile,
    IdentifyOptions,
    require_identified_written,
)
from stcal.robot.identification.solve import identify
from stcal.robot.kinematics.file import require_robot_written, robot_toml
from stcal.robot.kinematics.measurements import Measurements, joint_values, read_measurements, targets_of
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import (
    Compensated,
    CompensationFile,
    compensate,
    compensated_csv,
    compensated_summary,
    require_compensated_written,
)
from stcal.robot.use.evaluation import evaluate
from stcal.robot.use.report import compensation_report
from stcal.robot.use.targets import Targets, read_targets
from stcal.sfm.measurement.images import MeasureOptions, MeasureResult, measure
from stcal.sfm.measurement.report import (
    IMAGE,
    measure_report,
    poses_csv,
    poses_file,
    require_table_written,
    summary,
)
from stcal.sfm.measurement.target import TargetCircles

STAGES = ("poses", "axes", "identified", "compensated")
"""Names of the files, in the order of the steps."""
DRAWING, AXES, SAME_ROWS = "as drawn", "by the axis method", "identified, the same rows"


@dataclass(frozen=True, slots=True, eq=False)
class FromPhotos:
    """Results of all steps, from photographs to joint values.

    Parameters
    ----------
    images : folder of the photographs
    measured : poses of the target
    nominal : the arm as drawn
    data : poses with their joint values
    axes : result of the axis method, where every joint is swept
    without_axes : reason why there is no result of the axis method
    identified : identification from all poses
    compensated : joint values for the targets, where there are any
    errors : position errors of the rows, mm: as drawn and by the axis method with base and tool fitted, identified, and
        of rows held out
    notes : notes on rows and photographs that have no partner, and on the input
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
        """Predicted σ (t,) of the tool at the targets, mm; nan if not reached, or the tool was not measured."""
        compensated, sigma = self.compensated, self.identified.predicted
        if compensated is None or sigma is None:
            return np.zeros(0)
        at = predicted_at(sigma, self.identified.state, "pose", compensated.found.q, compensated.targets.tools)
        return np.where(compensated.found.usable, at, np.nan)

    def moves(self) -> np.ndarray:
        """Joint values to send minus those as drawn, (t, n), rad or mm; nan where one of them does not exist."""
        compensated = self.compensated
        if compensated is None or compensated.nominal is None:
            return np.zeros((0, len(self.nominal.rows)))
        return np.where(compensated.compared()[:, None], compensated.found.q - compensated.nominal.q, np.nan)


PAGES = {
    "poses.html": "Poses of the target in the photographs",
    "axes.html": "Axes by the axis method",
    "identified.html": "Identification of the arm",
    "compensated.html": "Joint values for the targets",
}
MOST_NOTES, MOST_TARGETS = 20, 20


def story(result: FromPhotos) -> list[str]:
    """Returns the steps and their results, one sentence a step."""
    identified, least = result.identified, list(result.errors.values())[-1]
    sentences = [*summary(result.measured), f"{len(result.data)} poses have joint values"]
    if result.axes is None:
        sentences.append(f"the axis method was left out: {result.without_axes}")
    else:
        spans = [
            f"{np.degrees(fit.span):.0f}°" if len(fit.gain) != 2 else f"{fit.span:.0f} mm" for fit in result.axes.fits
        ]
        sentences.append(f"every joint is swept by itself, over {', '.join(spans)}: axis method")
    sentences.append(
        f"identified: {identified.rank} parameters; position errors {result.errors[DRAWING].rms:.3g} mm RMS as drawn, "
        f"{least.rms:.3g} mm {'of rows held out' if identified.held_out else 'of the same rows'}"
    )
    if result.compensated is not None:
        sentences += [line[0].lower() + line[1:] for line in compensated_summary(result.compensated)]
        sentences += _at_targets(result)
    return sentences


def _at_targets(result: FromPhotos) -> list[str]:
    """Returns sentences on the predicted error of the identified arm at the targets, and the joints' motion."""
    sentences, sigma, moves = [], result.sigma_mm(), result.moves()
    finite, moved = sigma[np.isfinite(sigma)], moves[np.isfinite(moves).all(axis=1)]
    prediction = result.identified.predicted
    if len(finite) and prediction is not None:
        sentences.append(
            f"predicted σ of the tool's position there: {finite.min():.2g} to {finite.max():.2g} mm; at the measured "
            f"rows {np.sqrt((prediction.here_mm**2).mean()):.2g} mm RMS"
        )
    if len(moved):
        most = _shown(result, np.abs(moved).max(axis=0))
        motions = [f"{number(v, 4)}{unit}" for v, unit in zip(most, _units(result), strict=True)]
        sentences.append(f"joints move by up to {', '.join(motions)}")
    return sentences


def _units(result: FromPhotos) -> list[str]:
    """Returns the unit in which each joint's values are shown."""
    return [" mm" if sliding else "°" for sliding in result.nominal.prismatic]


def _shown(result: FromPhotos, values: np.ndarray) -> np.ndarray:
    """Returns joint values (…, n) in these units."""
    return np.where(result.nominal.prismatic, values, np.degrees(values))


def from_photos_page(result: FromPhotos, names: tuple[str, ...]) -> str:
    """Returns the report: the story, errors of each model of the arm, and links to the other files ``names``."""
    compensated, last = result.compensated, list(result.errors.values())[-1]
    before = (
        None
        if compensated is None or not compensated.compared().any()
        else compensated.before_mm[compensated.compared()]
    )
    headline = [
        (str(len(result.data)), "", "poses measured, with joint values"),
        (number(result.errors[DRAWING].rms, 3), "mm RMS", "position error of the arm as drawn"),
        (number(last.rms, 3), "mm RMS", list(result.errors)[-1]),
    ]
    if before is not None:
        headline.append(
            (number(float(np.sqrt((before**2).mean())), 3), "mm RMS", "taken away at the targets, base included")
        )
    notes = [
        *result.notes,
        *(f"{entry.name}: {entry.reason}" for entry in result.measured.left_out),
        *result.identified.notes,
        *([] if compensated is None else compensated.notes()),
    ]
    errors = [
        [name, str(entry.rows), *(number(v, 4) for v in (entry.mean, entry.rms, entry.p95, entry.max))]
        for name, entry in result.errors.items()
    ]
    heads = [
        "line",
        "<status",
        "as drawn, mm",
        "σ, mm",
        *(f"J{i}, {u.strip()}" for i, u in enumerate(_units(result), 1)),
    ]
    targets: list[Block] = [
        ShownTable(heads, rows := _target_rows(result)),
        "as drawn: where the joint values of the drawing really lead, by the identified arm; nothing is fitted here, "
        "so that errors of the base count, unlike above. σ: of the tool's position after compensation, as predicted. "
        "Then how far each joint moves",
        "compensated.html has all of them" if compensated is not None and len(compensated) > len(rows) else "",
    ]
    more = len(notes) - MOST_NOTES
    return Document(
        f"From photographs to points: {result.nominal.name}",
        f"photographs of {result.images}",
        [
            Section("Result", [tiles(headline), *story(result)]),
            Section(
                "Errors of the arm's models",
                [
                    plot(
                        lambda: _figure(result),
                        "errors of each model of the arm",
                        "Line: from the median to the largest error of a row",
                    ),
                    ShownTable(["<position error, mm", "errors", "mean", "RMS", "95 %", "max"], errors),
                    "As drawn and by the axis method, base and tool are fitted to the same rows. Rows held out took "
                    "no part in what they are compared with: their error is what is to be expected at other poses "
                    "among these",
                ],
            ),
            Section("At the targets", targets if rows else []),
            Section(
                "To look at",
                [bullets(notes[:MOST_NOTES]), f"and {more} more, in the pages of each step" if more > 0 else ""],
            ),
            Section(
                "Each step",
                [
                    links((name, PAGES[name]) for name in names if name in PAGES),
                    listed("for programs", [name for name in names if not name.endswith(".html")]),
                ],
            ),
        ],
    ).page()


def _target_rows(result: FromPhotos) -> list[list[str]]:
    """Returns each target's error by nominal joint values, predicted σ, and motion of the joints."""
    compensated = result.compensated
    if compensated is None:
        return []
    moves, sigma = _shown(result, result.moves()), result.sigma_mm()
    return [
        [
            str(compensated.targets.lines[i]),
            compensated.found.status[i],
            *(number(float(v), 4) for v in (compensated.before_mm[i], sigma[i], *moves[i])),
        ]
        for i in range(min(MOST_TARGETS, len(compensated)))
    ]


def _figure(result: FromPhotos) -> Drawing:
    """Returns a figure of median, RMS and largest error of each model, on a logarithmic scale."""
    names, figures = list(result.errors), list(result.errors.values())
    rows = list(range(len(names)))
    median, rms, largest = ([getattr(each, name) for each in figures] for name in ("median", "rms", "max"))
    drawing = Drawing(8, 0.5 * len(names) + 0.9)
    box = drawing.panels(left=160, top=22)[0]
    axes = Axes(drawing, box, log_limits([*median, *rms, *largest]), (len(names) - 0.5, -0.5), "x")
    axes.frame("position error of a row, mm", y_ticks=(rows, names))
    axes.lines([(ends, (row, row)) for row, *ends in zip(rows, median, largest, strict=True)], COLOURS[0], 1.2)
    axes.marks(rms, rows, "dot", 6, COLOURS[0])
    axes.marks(largest, rows, "bar", 10, COLOURS[1])
    drawing.key((box[0], 10), {"RMS": ("dot", COLOURS[0]), "largest": ("bar", COLOURS[1])})
    return drawing


POSES = "poses.csv"


def _results(result: FromPhotos) -> dict[str, ResultFile]:
    """Returns the result files, by name."""
    axes, identified, compensated = result.axes, result.identified, result.compensated
    return {
        "poses.json": poses_file(result.measured),
        "identified.json": IdentifiedFile.model_validate(identified),
        **({} if axes is None else {"axes.json": AxesFile.model_validate(axes)}),
        **({} if compensated is None else {"compensated.json": CompensationFile.model_validate(compensated)}),
    }


def files_of(result: FromPhotos) -> dict[str, str]:
    """Returns the contents of all files, by name."""
    identified, compensated = result.identified.robot, result.compensated
    source = f"Identified from {result.data.where}: {result.identified.rank} parameters."
    files = {name: json_text(content) for name, content in _results(result).items()} | {
        POSES: poses_csv(result.measured)[0],
        "poses.html": measure_report(result.measured, result.images).page(),
        "identified.toml": robot_toml(identified, [source]),
        "identified.html": identified_report(result.identified).page(),
    }
    if result.axes is not None:
        files |= {
            "axes.toml": robot_toml(result.axes.robot, ["Identified by the axis method from the sweeps."]),
            "axes.html": axes_report(result.axes, result.data.where).page(),
        }
    if compensated is not None:
        files |= {
            "compensated.csv": compensated_csv(compensated, identified),
            "compensated.html": compensation_report(compensated).page(),
        }
    files = dict(sorted(files.items(), key=lambda item: STAGES.index(item[0].split(".")[0])))
    return files | {"report.html": from_photos_page(result, tuple(files))}


def require_files_written(out: Path, result: FromPhotos) -> None:
    """Read the files of :func:`files_of` in ``out`` again, and require what was reported."""
    for name, content in _results(result).items():
        require_result_written(out / name, content)
    require_table_written(out / POSES, result.measured)
    require_identified_written(out / "identified.toml", result.identified)
    if result.axes is not None:
        require_robot_written(out / "axes.toml", result.axes.robot, result.axes.chain)
    if result.compensated is not None:
        require_compensated_written(out / "compensated.csv", result.compensated, result.identified.robot)


PHOTOGRAPHS = "the photographs"


@require_arguments
def robot_from_photos(
    images: str | Path,
    camera: str | Path | Camera | CameraModel,
    target: TargetCircles,
    design: TargetDesign,
    joints: str | Path,
    nominal: Robot,
    targets: str | Path | Table | None = None,
    board: BoardDesign | None = None,
    key: str = "image",
    measure_options: MeasureOptions | None = None,
    options: IdentifyOptions | None = None,
    progress: Progress | None = None,
) -> FromPhotos:
    """Measures the target in photographs, identifies the arm that carried it, and compensates targets.

    Parameters
    ----------
    images : str or Path
        Folder of the photographs, and of folders of them.
    camera : Camera
        The camera that took them, or its file.
    target : TargetCircles
        The calibrated target, of :func:`stcal.sfm.read_target` or ``RunResult.circles()``.
    design : TargetDesign
        Its design.
    joints : str or Path
        Table of joint values with a column ``key`` that names the photograph of each row (CSV).
    nominal : Robot
        The arm as drawn, mm and rad; the model by which the controller commands it.
    targets : str, Path or Table, optional
        Poses or joint values to compensate.
    board : BoardDesign, optional
        The board whose dots are to be told apart, if it is in view.
    key : str
        Name of the column of photographs.
    measure_options, options : MeasureOptions, IdentifyOptions
        Options of measuring and of identifying; the defaults if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    FromPhotos
        All results, mm and rad, in the camera's frame.

    Raises
    ------
    StcalError
        One of its subclasses, from the step that failed, with a one-line message that says what to do.
    """
    # Both are read before the work, as both may be refused.
    values = read_joints(joints, key, [file.name for file in find_images(images)[0]], nominal)
    carried = dict.fromkeys(targets_of(values), Rigid())
    wanted = None if targets is None else read_targets(targets, replace(nominal, tools=carried))
    measured = measure(images, camera_model(camera), target, design, board, measure_options, progress)
    return from_measured(str(images), measured, values, nominal, wanted, options)


def read_joints(path: str | Path, key: str, photographs: Sequence[str], nominal: Robot) -> Table:
    """Returns joint values with each row's photograph as ``image``, which replaces ``key``. Raises InputError: no such
    column, rows of no photograph or of one twice, poses beside them, or other joints than the robot's."""
    values, nowhere = read_table(path, "joints"), np.zeros(len(photographs))
    files = Table(PHOTOGRAPHS, {key: list(photographs)} | dict.fromkeys(POSE, nowhere), range(len(photographs)))
    join_tables(files, values, key)
    joint_values(values, nominal)
    remaining = {name: column for name, column in values.columns.items() if name not in (key, IMAGE)}
    return replace(values, columns={IMAGE: values.text(key)} | remaining, rows=())


def from_measured(
    images: str,
    measured: MeasureResult,
    values: Table,
    nominal: Robot,
    wanted: Targets | None = None,
    options: IdentifyOptions | None = None,
) -> FromPhotos:
    """Perform the steps after measuring, for the table of :func:`read_joints`; otherwise as
    :func:`robot_from_photos`."""
    with scratch_folder("photos") as folder:
        poses_file = folder / POSES
        save(poses_file, poses_csv(measured)[0])
        joined = join_tables(replace(read_table(poses_file, "poses"), where=PHOTOGRAPHS), values, IMAGE)
    data = read_measurements(joined.table, nominal)
    axes, without = _axes(data, nominal)
    identified = identify(nominal, data, options)
    compensated = None if wanted is None else compensate(identified.robot, wanted, nominal)
    models = {DRAWING: nominal} if axes is None else {DRAWING: nominal, AXES: axes.robot}
    evaluation = evaluate(models, data)
    good = ~evaluation.wrong
    errors = {
        name: Figures.of(evaluated.errors_mm[good]) for name, evaluated in zip(models, evaluation.robots, strict=True)
    }
    errors[SAME_ROWS] = Figures.of(identified.fitted_mm[good])
    if identified.held_out is not None:
        held = identified.held_out.position_mm[:, good]
        errors[f"identified, {identified.held_out.folds} folds held out"] = Figures.of(held[np.isfinite(held)])
    return FromPhotos(
        images,
        measured,
        nominal,
        data,
        axes,
        without,
        identified,
        compensated,
        errors,
        joined.notes + tuple(data.notes),
    )


def _axes(data: Measurements, nominal: Robot) -> tuple[AxesResult | None, str]:
    """Returns the axis method's result from the rows that sweep one joint each, or the reason why there is none."""
    try:
        arcs, _ = find_arcs(data, nominal)
        rows = np.unique(np.concatenate([arc.rows for arc in arcs]))
        length_mm = length_of(data)
        return robot_from_sweeps(data[rows], nominal, places=None if length_mm is None else ring(length_mm)), ""
    except StcalError as error:  # the workflow can do without this step
        return None, str(error).removeprefix(f"{data.where}: ")
