"""All steps from photographs of the target on an arm to joint values that reach points.

The steps are measure, axes, identify, compensate. It is the method of Zhang & Wei (2017) in one go. The files of every
step are those of its own command, so that each step can be repeated by itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal import robot as arms
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.arrays import require_arguments, rms
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.files import json_text, require_text_written, save
from stcal.io.images import find_images
from stcal.io.join import join_tables
from stcal.io.json import require_result_written
from stcal.io.table import POSE, Table, read_table
from stcal.parallel import Progress, scratch_folder
from stcal.report.document import Document, Section, bullets, links, listed
from stcal.report.document import Table as ShownTable
from stcal.report.text import number
from stcal.robot.axes.axes_model import AxesFile, AxesResult
from stcal.robot.axes.fit import find_arcs, length_of, ring
from stcal.robot.identification.result import Figures, IdentifiedFile, require_identified_written
from stcal.robot.identified_report import identified_report
from stcal.robot.kinematics.measurements import joint_values, targets_of
from stcal.robot.kinematics.robot_file import require_robot_written
from stcal.robot.robot_report import axes_report, compensation_report
from stcal.robot.use.compensation import Compensated, CompensationFile, compensated_summary
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.measurement import pose_report
from stcal.sfm.measurement.measure_images import MeasureOptions, MeasureResult, measure

STAGES = {
    "poses": "Poses of the target in the photographs",
    "axes": "Axes by the axis method",
    "identified": "Identification of the arm",
    "compensated": "Joint values for the targets",
}
"""Names of the files, in the order of the steps, and what their pages are."""
DRAWING, AXES, SAME_ROWS = "as drawn", "by the axis method", "identified, the same rows"


@dataclass(frozen=True, slots=True, eq=False)
class FromPhotos:
    """Results of all steps, from photographs to joint values.

    ``data`` : poses with their joint values; ``axes`` : where every joint is swept, else ``without_axes`` says why not;
    ``compensated`` : joint values for the targets, where there are any; ``errors`` : position errors of the rows, mm:
    as drawn and by the axis method with base and tool fitted, identified, and of rows held out; ``notes`` : on rows and
    photographs that have no partner, and on the input.
    """

    images: str
    measured: MeasureResult
    nominal: arms.Robot
    data: arms.Measurements
    axes: AxesResult | None
    without_axes: str
    identified: arms.Identified
    compensated: Compensated | None
    errors: dict[str, Figures]
    notes: tuple[str, ...]

    def sigma_mm(self) -> np.ndarray:
        """Predicted σ (t,) of the tool at the targets, mm; nan if not reached, or the tool was not measured."""
        compensated, sigma = self.compensated, self.identified.predicted
        if compensated is None or sigma is None:
            return np.zeros(0)
        at = sigma.at(self.identified.state, "pose", compensated.found.q, compensated.targets.tools)
        return np.where(compensated.found.usable, at, np.nan)


MOST_NOTES = 20


def story(result: FromPhotos) -> list[str]:
    """Returns the steps and their results, one sentence a step."""
    identified, least, compensated = result.identified, list(result.errors.values())[-1], result.compensated
    sentences = [*pose_report.summary(result.measured), f"{len(result.data)} poses have joint values"]
    if result.axes is None:
        sentences.append(f"the axis method was left out: {result.without_axes}")
    else:
        units = zip(result.axes.fits, result.nominal.prismatic, strict=True)
        spans = [f"{fit.span:.0f} mm" if slides else f"{np.degrees(fit.span):.0f}°" for fit, slides in units]
        sentences.append(f"every joint is swept by itself, over {', '.join(spans)}: axis method")
    sentences.append(
        f"identified: {identified.rank} parameters; position errors {result.errors[DRAWING].rms:.3g} mm RMS as drawn, "
        f"{least.rms:.3g} mm {'of rows held out' if identified.held_out else 'of the same rows'}"
    )
    if compensated is None:
        return sentences
    sentences += compensated_summary(compensated)
    sigma, predicted = result.sigma_mm(), identified.predicted
    finite = sigma[np.isfinite(sigma)]
    if len(finite) and predicted is not None:
        sentences.append(
            f"predicted σ of the tool's position there: {finite.min():.2g} to {finite.max():.2g} mm; at the measured "
            f"rows {rms(predicted.here_mm):.2g} mm RMS"
        )
    return sentences


def from_photos_page(result: FromPhotos, names: tuple[str, ...]) -> str:
    """Returns the report: the story, errors of each model of the arm, and links to the other files ``names``."""
    compensated = result.compensated
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
    models = [
        ShownTable(["<position error, mm", "errors", "mean", "RMS", "95 %", "max"], errors),
        "As drawn and by the axis method, base and tool are fitted to the same rows. Rows held out took no part in "
        "what they are compared with: their error is what is to be expected at other poses among these",
    ]
    more = f"and {len(notes) - MOST_NOTES} more, in the pages of each step" if len(notes) > MOST_NOTES else ""
    pages = [(name, STAGES[name.split(".")[0]]) for name in names if name.endswith(".html")]
    files = listed("for programs", [name for name in names if not name.endswith(".html")])
    return Document(
        f"From photographs to points: {result.nominal.name}",
        f"photographs of {result.images}",
        [
            Section("Result", story(result)),
            Section("Errors of the arm's models", models),
            Section("To look at", [bullets(notes[:MOST_NOTES]), more]),
            Section("Each step", [links(pages), files]),
        ],
    ).page()


def _steps(result: FromPhotos) -> dict[str, tuple]:
    """Returns for each step: kind, text and check of its table or robot file, its result file, and its page."""
    measured, axes, identified, compensated = result.measured, result.axes, result.identified, result.compensated
    source = f"Identified from {result.data.where}: {identified.rank} parameters."
    table, content = pose_report.poses_csv(measured)[0], pose_report.poses_file(measured)
    check, page = pose_report.require_table_written, partial(pose_report.measure_report, measured, result.images)
    steps: dict[str, tuple] = {"poses": ("csv", table, partial(check, result=measured), content, page)}
    if axes is not None:
        text = arms.robot_toml(axes.robot, ["Identified by the axis method from the sweeps."])
        again = partial(require_robot_written, robot=axes.robot, chain=axes.chain)
        page = partial(axes_report, axes, result.data.where)
        steps["axes"] = "toml", text, again, AxesFile.model_validate(axes), page
    text, again = arms.robot_toml(identified.robot, [source]), partial(require_identified_written, result=identified)
    page = partial(identified_report, identified)
    steps["identified"] = "toml", text, again, IdentifiedFile.model_validate(identified), page
    if compensated is not None:
        text = arms.compensated_csv(compensated, identified.robot, result.sigma_mm())
        content = CompensationFile.model_validate(compensated)
        again, page = partial(require_text_written, text=text), partial(compensation_report, compensated)
        steps["compensated"] = "csv", text, again, content, page
    return steps


def files_of(result: FromPhotos) -> dict[str, str]:
    """Returns the contents of all files, by name."""
    files: dict[str, str] = {}
    for name, (kind, text, _, content, page) in _steps(result).items():
        files |= {f"{name}.json": json_text(content), f"{name}.{kind}": text, f"{name}.html": page().page()}
    return files | {"report.html": from_photos_page(result, tuple(files))}


def require_files_written(out: Path, result: FromPhotos) -> None:
    """Read the files of :func:`files_of` in ``out`` again, and require what was reported."""
    for name, (kind, _, again, content, _) in _steps(result).items():
        require_result_written(out / f"{name}.json", content)
        again(out / f"{name}.{kind}")


PHOTOGRAPHS = "the photographs"


@require_arguments
def robot_from_photos(
    images: str | Path,
    camera: str | Path | Camera | CameraModel,
    target: TargetCircles,
    design: TargetDesign,
    joints: str | Path,
    nominal: arms.Robot,
    targets: str | Path | Table | None = None,
    board: BoardDesign | None = None,
    key: str = "image",
    measure_options: MeasureOptions | None = None,
    options: arms.IdentifyOptions | None = None,
    progress: Progress | None = None,
) -> FromPhotos:
    """Measures the target in photographs, identifies the arm that carried it, and compensates targets.

    Parameters
    ----------
    images : folder of the photographs, and of folders of them.
    camera : the camera that took them, or its file.
    target : the calibrated target, of :func:`stcal.sfm.read_target` or ``RunResult.circles()``.
    design : its design.
    joints : table of joint values with a column ``key`` that names the photograph of each row (CSV).
    nominal : the arm as drawn, mm and rad; the model by which the controller commands it.
    targets : poses or joint values to compensate.
    board : the board whose dots are to be told apart, if it is in view.
    key : name of the column of photographs.
    measure_options, options : options of measuring and of identifying; the defaults if None.
    progress : called with (stage, done, total).

    Returns
    -------
    FromPhotos : all results, mm and rad, in the camera's frame.

    Raises
    ------
    StcalError : one of its subclasses, from the step that failed, with a one-line message that says what to do.
    """
    # Both are read before the work, as both may be refused.
    values = read_joints(joints, key, [file.name for file in find_images(images)[0]], nominal)
    carried = dict.fromkeys(targets_of(values), Rigid())
    wanted = None if targets is None else arms.read_targets(targets, replace(nominal, tools=carried))
    measured = measure(images, camera_model(camera), target, design, board, measure_options, progress)
    return from_measured(str(images), measured, values, nominal, wanted, options)


def read_joints(path: str | Path, key: str, photographs: Sequence[str], nominal: arms.Robot) -> Table:
    """Returns joint values with each row's photograph as ``image``, which replaces ``key``. Raises InputError: no such
    column, rows of no photograph or of one twice, poses beside them, or other joints than the robot's."""
    values, nowhere = read_table(path, "joints"), np.zeros(len(photographs))
    files = Table(PHOTOGRAPHS, {key: list(photographs)} | dict.fromkeys(POSE, nowhere), range(len(photographs)))
    join_tables(files, values, key)
    joint_values(values, nominal)
    remaining = {name: column for name, column in values.columns.items() if name not in (key, pose_report.IMAGE)}
    return replace(values, columns={pose_report.IMAGE: values.text(key)} | remaining, rows=())


def from_measured(
    images: str,
    measured: MeasureResult,
    values: Table,
    nominal: arms.Robot,
    wanted: arms.Targets | None = None,
    options: arms.IdentifyOptions | None = None,
) -> FromPhotos:
    """Perform the steps after measuring, for the table of :func:`read_joints`, as the above."""
    with scratch_folder("photos") as folder:
        written = folder / "poses.csv"
        save(written, pose_report.poses_csv(measured)[0])
        joined = join_tables(replace(read_table(written, "poses"), where=PHOTOGRAPHS), values, pose_report.IMAGE)
    data = arms.read_measurements(joined.table, nominal)
    axes, without = _axes(data, nominal)
    identified = arms.identify(nominal, data, options)
    compensated = None if wanted is None else arms.compensate(identified.robot, wanted, nominal)
    models = {DRAWING: nominal} if axes is None else {DRAWING: nominal, AXES: axes.robot}
    evaluation = arms.evaluate(models, data)
    good = ~evaluation.wrong
    errors = {each.name: each.good_mm for each in evaluation.robots}
    errors[SAME_ROWS] = Figures.of(identified.fitted_mm[good])
    if identified.held_out is not None:
        name = f"identified, {identified.held_out.folds} folds held out"
        errors[name] = Figures.of(identified.held_out.position_mm[:, good])
    results = data, axes, without, identified, compensated, errors
    return FromPhotos(images, measured, nominal, *results, joined.notes + tuple(data.notes))


def _axes(data: arms.Measurements, nominal: arms.Robot) -> tuple[AxesResult | None, str]:
    """Returns the axis method's result from the rows that sweep one joint each, or the reason why there is none."""
    try:
        arcs, _ = find_arcs(data, nominal)
        rows = np.unique(np.concatenate([arc.rows for arc in arcs]))
        length_mm = length_of(data)
        return arms.robot_from_sweeps(data[rows], nominal, places=None if length_mm is None else ring(length_mm)), ""
    except StcalError as error:  # the workflow can do without this step
        return None, str(error).removeprefix(f"{data.where}: ")
