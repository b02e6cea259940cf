"""Cross-validation of a rig's calibration over the robot's poses, compared with each camera by itself."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import DegenerateError, StcalError
from stcal.geometry.arrays import frozen
from stcal.handeye.data.pairs import Setup
from stcal.handeye.data.rig import RigPoses
from stcal.handeye.rig.solve import POSE, Rig, RigOptions, alone, handeye_rig
from stcal.handeye.validate import HeldOutPoses, predicted, scatter_notes, scatter_of
from stcal.parallel import one_thread, run_in_order

ERRORS = ("rotation_rad", "translation_mm", "board_mm", "pose_mm")


@dataclass(frozen=True, slots=True, eq=False)
class CameraHeldOut:
    """Errors of one camera on n views from held-out poses of the robot.

    ``split``, ``view`` : (n,) number of the split, and of the camera's view; ``joint``, ``alone`` : errors of
    :class:`~stcal.handeye.HeldOutPoses` by name: from all cameras solved together, and from this camera alone with the
    same poses of the robot. NaN if the camera cannot be solved alone.
    """

    split: np.ndarray
    view: np.ndarray
    joint: dict[str, np.ndarray]
    alone: dict[str, np.ndarray]

    def means(self, by: str = "joint") -> dict[str, float]:
        """Returns mean errors over the views for which both ``joint`` and ``alone`` are known.

        If ``alone`` is known for no view, the means of ``joint`` cover all views and those of ``alone`` are empty.
        """
        both = np.isfinite(self.alone["board_mm"])
        rows = both if both.any() or by == "alone" else np.ones(len(both), bool)
        if not rows.any():
            return {}
        return {name: float(values[rows].mean()) for name, values in getattr(self, by).items()}

    def gain(self) -> float | None:
        """Returns the relative reduction of the 3-D error at the board against the camera alone, or None if unknown."""
        by_itself = self.means("alone")
        return 1 - self.means()["board_mm"] / by_itself["board_mm"] if by_itself else None

    def poses(self) -> HeldOutPoses | None:
        """Returns the joint errors with equally many views in every split, or None if a split has no view."""
        splits = np.unique(self.split)
        rows_of_split = [np.flatnonzero(self.split == k) for k in splits]
        fewest = min(map(len, rows_of_split), default=0)
        if not fewest:
            return None
        rows = np.array([views[:fewest] for views in rows_of_split])
        return HeldOutPoses(self.view[rows], **{name: values[rows] for name, values in self.joint.items()})


@dataclass(frozen=True, slots=True, eq=False)
class RigHeldOut:
    """Errors of a rig on held-out poses of the robot.

    ``rows`` : (s, k) poses of the robot held out in each split; ``cameras`` : errors of each camera;
    ``mount_from_camera`` : (s, c, 4, 4) solutions from the other poses of each split, mm.
    """

    rows: np.ndarray
    cameras: tuple[CameraHeldOut, ...]
    mount_from_camera: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "rows", frozen(self.rows, (None, None), "held-out poses", int))
        shape = len(self.rows), len(self.cameras), 4, 4
        object.__setattr__(self, "mount_from_camera", frozen(self.mount_from_camera, shape, "solutions"))


@one_thread()
def cross_validate_rig(
    given: RigPoses,
    setup: Setup,
    options: RigOptions,
    rows: np.ndarray,
    workers: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> RigHeldOut:
    """Solves without some of the robot's poses, all cameras together and each alone, and predicts these poses.

    Parameters
    ----------
    given, setup, options : see :func:`~stcal.handeye.handeye_rig`
    rows : (s, k) poses of the robot to hold out, from :func:`~stcal.handeye.splits`
    workers : number of processes; as many as cores if None
    progress : called with the number of splits done, and the number of all splits

    Returns
    -------
    RigHeldOut

    Raises
    ------
    StcalError
        A split cannot be solved; see :func:`~stcal.handeye.handeye_rig`.
    """
    jobs = [(given, setup, options, out) for out in rows]
    results = run_in_order(_errors_without, jobs, workers, progress)
    cameras = []
    for i in range(len(given.cameras)):
        parts = [errors[i] for errors, _ in results]
        split = np.repeat(np.arange(len(parts)), [len(camera_errors["view"]) for camera_errors in parts])
        joint, by_itself = (
            {name: np.concatenate([camera_errors[by][name] for camera_errors in parts]) for name in ERRORS}
            for by in ("joint", "alone")
        )
        cameras.append(
            CameraHeldOut(split, np.concatenate([camera_errors["view"] for camera_errors in parts]), joint, by_itself)
        )
    return RigHeldOut(rows, tuple(cameras), np.array([x for _, x in results]))


def _errors_without(
    given: RigPoses, setup: Setup, options: RigOptions, out: np.ndarray
) -> tuple[list[dict], np.ndarray]:
    """Solves without the poses ``out``. Returns each camera's views of these and their errors, and all X, (c, 4, 4)."""
    training = given.only(np.setdiff1d(np.arange(len(given)), out))
    try:
        rig = handeye_rig(training, setup, options)
    except DegenerateError as error:
        raise DegenerateError(error.code, f"without {', '.join(given.names[i] for i in out)}: {error}") from error
    errors_of_cameras = []
    for i, camera in enumerate(given.cameras):
        held = np.flatnonzero(np.isin(camera.rows, out))
        unknown = dict.fromkeys(ERRORS, np.full(len(held), np.nan))
        camera_errors = {"view": held, "joint": unknown, "alone": unknown}
        if len(held):
            pairs, views = given.pairs(i)[held], camera.views[held]
            camera_errors["joint"] = predicted(rig.cameras[i], pairs, views)
            with suppress(
                StcalError
            ):  # with too few of its images left, the camera is solved by means of the others only
                camera_errors["alone"] = predicted(alone(training, i, setup, options), pairs, views)
        errors_of_cameras.append(camera_errors)
    return errors_of_cameras, np.array([each.mount_from_camera.matrix() for each in rig.cameras])


def rig_scatter(rig: Rig, held_out: RigHeldOut) -> float:
    """Returns the scatter of solutions without some of the robot's poses, relative to what σ predict.

    It is :func:`~stcal.handeye.validate.scatter` of all cameras at once.
    """
    images, size = sum(len(camera.names) for camera in rig.cameras), POSE * len(rig.names)
    found = [camera.mount_from_camera for camera in rig.cameras]
    out = held_out.rows.shape[1] / len(rig.poses)
    covariance = rig.covariance[:size, :size]
    return scatter_of(found, held_out.mount_from_camera, covariance, images, out, len(rig.covariance))


def widened_by_scatter(rig: Rig, held_out: RigHeldOut) -> tuple[Rig, float]:
    """Returns the rig with σ widened by the :func:`rig_scatter`, with a note if that is large, and the factor."""
    factor = rig_scatter(rig, held_out)
    if not factor > 1:
        return rig, 1.0
    return replace(rig.widened(factor), notes=(*rig.notes, *scatter_notes(factor, "all"))), factor
