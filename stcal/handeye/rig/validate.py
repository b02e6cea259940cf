"""How good a rig's calibration is on poses of the robot that it has not seen, beside each camera by itself."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import DegenerateError, StcalError
from stcal.geometry.arrays import frozen
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.data.loop import Setup
from stcal.handeye.data.rig import RigPoses
from stcal.handeye.rig.result import POSE, Rig
from stcal.handeye.rig.solve import RigOptions, alone, handeye_rig
from stcal.handeye.scatter import SCATTERED
from stcal.handeye.validate import HeldOutPoses, predicted
from stcal.parallel import one_thread, run_parallel

ERRORS = ("rotation_rad", "translation_mm", "board_mm", "pose_mm")


@dataclass(frozen=True, slots=True, eq=False)
class CameraHeldOut:
    """Errors of one camera on n views of poses of the robot that were held out.

    Parameters
    ----------
    split, view : (n,) int arrays
        Which split, and which view of the camera.
    joint, alone : dict of str to (n,) array
        Errors as of :class:`~stcal.handeye.HeldOutPoses`, by name: of all cameras solved together, and of this one by
        itself from the same poses of the robot; NaN where it cannot be.
    """

    split: np.ndarray
    view: np.ndarray
    joint: dict[str, np.ndarray]
    alone: dict[str, np.ndarray]

    def means(self, by: str = "joint") -> dict[str, float]:
        """Means over all views for which ``joint`` and ``alone`` are both known, or, of ``joint``, over all where none
        is; empty where there are none."""
        both = np.isfinite(self.alone["board_mm"])
        rows = both if both.any() or by == "alone" else np.ones(len(both), bool)
        if not rows.any():
            return {}
        return {name: float(values[rows].mean()) for name, values in getattr(self, by).items()}

    def gain(self) -> float | None:
        """By which share the 3-D error at the board is less than that of the camera by itself; None where that is not
        known."""
        by_itself = self.means("alone")
        return 1 - self.means()["board_mm"] / by_itself["board_mm"] if by_itself else None

    def poses(self) -> HeldOutPoses | None:
        """The same with as many views in every split, those beyond left out; None where a split has none."""
        splits = np.unique(self.split)
        each = [np.flatnonzero(self.split == k) for k in splits]
        fewest = min(map(len, each), default=0)
        if not fewest:
            return None
        rows = np.array([own[:fewest] for own in each])
        return HeldOutPoses(self.view[rows], **{name: values[rows] for name, values in self.joint.items()})


@dataclass(frozen=True, slots=True, eq=False)
class RigHeldOut:
    """``rows`` : (s, k) poses of the robot held out in each split; ``cameras`` : errors of each camera;
    ``mount_from_camera`` : (s, c, 4, 4) the solutions of the other poses of each split, mm."""

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
    """Solve without some of the robot's poses, all cameras together and each by itself, and predict these.

    Parameters
    ----------
    given, setup, options
        As of :func:`~stcal.handeye.handeye_rig`.
    rows : (s, k) int array
        Poses of the robot to hold out, from :func:`~stcal.handeye.splits`.
    workers : int or None
        Processes, as many as cores where None.
    progress : callable, optional
        Called with the number of splits done, and that of all.

    Returns
    -------
    RigHeldOut

    Raises
    ------
    StcalError
        As of :func:`~stcal.handeye.handeye_rig`, where a split cannot be solved.
    """
    jobs = [(given, setup, options, out) for out in rows]
    found: list[tuple[list[dict], np.ndarray]] = [([], np.zeros(0))] * len(jobs)
    for done, (i, errors) in enumerate(run_parallel(_errors_without, jobs, workers), 1):
        found[i] = errors
        if progress:
            progress(done, len(jobs))
    cameras = []
    for i in range(len(given.cameras)):
        each = [errors[i] for errors, _ in found]
        split = np.repeat(np.arange(len(each)), [len(own["view"]) for own in each])
        joint, by_itself = (
            {name: np.concatenate([own[by][name] for own in each]) for name in ERRORS} for by in ("joint", "alone")
        )
        cameras.append(CameraHeldOut(split, np.concatenate([own["view"] for own in each]), joint, by_itself))
    return RigHeldOut(rows, tuple(cameras), np.array([x for _, x in found]))


def _errors_without(
    given: RigPoses, setup: Setup, options: RigOptions, out: np.ndarray
) -> tuple[list[dict], np.ndarray]:
    """Of each camera the views of the poses ``out`` and their errors, and all X, (c, 4, 4)."""
    kept = given.only(np.setdiff1d(np.arange(len(given)), out))
    try:
        rig = handeye_rig(kept, setup, options)
    except DegenerateError as error:
        raise DegenerateError(error.code, f"without {', '.join(given.names[i] for i in out)}: {error}") from error
    found = []
    for i, camera in enumerate(given.cameras):
        held = np.flatnonzero(np.isin(camera.rows, out))
        nothing = dict.fromkeys(ERRORS, np.full(len(held), np.nan))
        own = {"view": held, "joint": nothing, "alone": nothing}
        if len(held):
            pairs, views = given.pairs(i)[held], camera.views[held]
            own["joint"] = predicted(rig.cameras[i], pairs, views)
            with suppress(StcalError):  # too few of its images may be left: it is then known by the others alone
                own["alone"] = predicted(alone(kept, i, setup, options), pairs, views)
        found.append(own)
    return found, np.array([each.mount_from_camera.matrix() for each in rig.cameras])


def rig_scatter(rig: Rig, held_out: RigHeldOut) -> float:
    """As :func:`~stcal.handeye.scatter.scatter`, of all cameras at once: by how much solutions without some of the
    robot's poses scatter about the one of all, in units of what its σ say."""
    (s, k), c = held_out.rows.shape, len(rig.names)
    off = []
    for i, camera in enumerate(rig.cameras):
        four = held_out.mount_from_camera[:, i]
        each = Poses(four[:, :3, :3], four[:, :3, 3])
        off.append(each.difference(Poses.of([camera.mount_from_camera] * s)))
    flat, size = np.concatenate(off, axis=1), POSE * c
    squared = np.einsum("sa,ab,sb->s", flat, generalised_inverse(rig.covariance[:size, :size]), flat)
    images = sum(len(camera.names) for camera in rig.cameras)
    left = POSE * images * (1 - k / len(rig.poses)) - len(rig.covariance) - 1
    return float(np.sqrt(squared.mean() / size * left / (POSE * images * k / len(rig.poses))))


def widened_by_scatter(rig: Rig, held_out: RigHeldOut) -> tuple[Rig, float]:
    """With σ that reach the :func:`rig_scatter`, and by what they were multiplied; a note where that is much."""
    factor = rig_scatter(rig, held_out)
    if not factor > 1:
        return rig, 1.0
    notes = rig.notes
    if factor > SCATTERED:
        notes += (
            f"solutions of parts of the poses scatter {factor:.2g} times as much as σ say, so that poses do not err "
            "independently and alike: σ of all transforms are widened by that",
        )
    return replace(rig.widened(factor), notes=notes), factor
