"""All steps from photographs of the target on an arm to joint values that reach points.

The steps are measure, axes, identify, compensate. It is the method of Zhang & Wei (2017) in one go. The files of every
step are those of its own command, so that each step can be repeated by itself.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.files import save
from stcal.io.images import find_images
from stcal.io.join import join_tables, table_of
from stcal.io.table import POSE, Table, read_table
from stcal.parallel import Progress
from stcal.robot.axes.model import AxesResult, robot_from_sweeps
from stcal.robot.axes.sweeps import find_arcs, length_of, ring
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.identification.solve import identify
from stcal.robot.kinematics.measurements import Measurements, joint_values, read_measurements, targets_of
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import (
    compensate,
)
from stcal.robot.use.evaluation import Figures, evaluate
from stcal.robot.use.targets import Targets, read_targets
from stcal.sfm.measurement.images import MeasureOptions, MeasureResult, measure
from stcal.sfm.measurement.report import IMAGE, poses_csv
from stcal.sfm.measurement.target import TargetCircles
from stcal.workflows.from_photos.result import AXES, DRAWING, POSES, SAME_ROWS, FromPhotos

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
    columns: str | Path | None = None,
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
    columns : str or Path, optional
        Columns, delimiter … of ``joints`` (TOML).

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
    values = read_joints(joints, key, [file.name for file in find_images(images)[0]], nominal, columns)
    carried = dict.fromkeys(targets_of(values), Rigid())
    wanted = None if targets is None else read_targets(targets, replace(nominal, tools=carried))
    measured = measure(images, camera_model(camera), target, design, board, measure_options, progress)
    return from_measured(str(images), measured, values, nominal, wanted, options)


def read_joints(
    path: str | Path, key: str, photographs: Sequence[str], nominal: Robot, columns: str | Path | None = None
) -> Table:
    """Returns joint values with the name of each row's photograph in the column ``image``, which replaces ``key``.

    Raises InputError: no such column, no row of the photographs, one twice, poses beside the joint values, or other
    joints than the robot's.
    """
    values, nowhere = table_of(path, columns, "joints"), np.zeros(len(photographs))
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
    """Perform the steps after the photographs are measured; arguments and errors as in :func:`robot_from_photos`.

    ``values`` : table from :func:`read_joints`; ``wanted`` : targets to compensate.
    """
    with tempfile.TemporaryDirectory(prefix="stcal-photos-") as folder:
        poses_file = Path(folder) / POSES
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
