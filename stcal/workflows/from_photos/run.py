"""From photographs of the target on an arm to joint values that reach points: measure, axes, identify, compensate.

The way of Zhang & Wei (2017) in one go. Every step's files are those of its own command, so that each can be repeated
by itself.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import StcalError
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.images import find_images
from stcal.io.join import join
from stcal.io.saving import save
from stcal.io.table import POSE, Table, read_table
from stcal.robot.axes.model import AxesResult, robot_from_sweeps
from stcal.robot.axes.orientations import length_of, ring
from stcal.robot.axes.sweeps import find_arcs
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
from stcal.sfm.measurement.output import IMAGE, poses_csv
from stcal.sfm.measurement.target import TargetCircles
from stcal.workflows.from_photos.output import POSES
from stcal.workflows.from_photos.result import AXES, DRAWING, SAME_ROWS, FromPhotos

PHOTOGRAPHS = "the photographs"


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
        As of :func:`stcal.sfm.measurement.images.measure`.
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
