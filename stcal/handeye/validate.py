"""How good a hand-eye calibration is: on poses that it has not seen, by every method."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import DegenerateError, InputError, StcalError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.loop import Loop, Setup
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import View, Views, resect
from stcal.handeye.judge.notes import Grave
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.result import HandEye
from stcal.handeye.solve import METHODS, HandEyeOptions, handeye
from stcal.held_out import repeated_splits
from stcal.parallel import one_thread, run_parallel

SETUP_SPLITS = 6
"""Splits that tell which setup is meant."""
SETUP_BETTER = 4.0
"""Times by which the product of both errors must be smaller in the other setup."""
LEAST_LEFT = 3
"""Poses that must be left to solve with."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutPoses:
    """Errors on s times k poses that were held out. One row of an array is one split.

    Parameters
    ----------
    rows : (s, k) int array
        Which poses were held out.
    rotation_rad, translation_mm : (s, k) arrays
        By how much the chain through robot and camera misses the board's pose: angle, and distance of the origins.
    board_mm : (s, k) array, or None without corners
        3-D error at the board: how far from each corner the ray on which the camera saw it pierces the board where the
        robot's chain has put it; mean over the corners of a view.
    pose_mm : (s, k) array, or None without corners
        Mean distance of the corners by the robot's chain from those by the pose that the view gives by itself; holds
        the error of that pose, mostly along the line of sight.
    mount_from_camera : (s, 4, 4) array, optional
        The solution of the other poses of each split, mm.
    """

    rows: np.ndarray
    rotation_rad: np.ndarray
    translation_mm: np.ndarray
    board_mm: np.ndarray | None = None
    pose_mm: np.ndarray | None = None
    mount_from_camera: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "rows", frozen(self.rows, (None, None), "held-out poses", int))
        for name in ("rotation_rad", "translation_mm", "board_mm", "pose_mm"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name), self.rows.shape, name))
        if self.mount_from_camera is not None:
            four = frozen(self.mount_from_camera, (len(self.rows), 4, 4), "solutions")
            object.__setattr__(self, "mount_from_camera", four)

    def means(self, of: np.ndarray | None = None) -> dict[str, float]:
        """Means over all splits of every error there is; ``of`` : which poses (m,) count, all where
        None; empty where none of these was held out."""
        names = ("rotation_rad", "translation_mm", "board_mm", "pose_mm")
        rows = np.ones(self.rows.shape, bool) if of is None else of[self.rows]
        if not rows.any():
            return {}
        return {name: float(getattr(self, name)[rows].mean()) for name in names if getattr(self, name) is not None}


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """One method beside the others.

    Parameters
    ----------
    method : str
        One of :data:`~stcal.handeye.METHODS`.
    result : HandEye or None
        Of all poses; None where the method fails.
    held_out : HeldOutPoses or None
        Errors on poses that were held out; None where the method fails, or none were.
    reason : str
        Why it fails; empty where it does not.
    """

    method: str
    result: HandEye | None
    held_out: HeldOutPoses | None
    reason: str = ""


def splits(count: int, held_out: int | None = None, repeats: int = 15, seed: int = 0) -> np.ndarray:
    """Poses to hold out: at random, in rounds in each of which every pose comes about once.

    Parameters
    ----------
    count : int
        Poses there are.
    held_out : int, optional
        Poses to hold out at once, k; a quarter of them, at least one, where None.
    repeats : int
        Splits wanted.
    seed : int
        Of the random order.

    Returns
    -------
    (repeats, k) int array
        Rows held out in each split, in ascending order.

    Raises
    ------
    InputError
        Fewer than three would be left.
    """
    k = held_out or max(1, count // 4)
    if count - k < LEAST_LEFT:
        raise InputError(
            "E-HELD-OUT-FEW",
            f"cross-validation: {k} of {count} poses held out leave {count - k}, {LEAST_LEFT} needed; take more poses",
        )
    return repeated_splits(count, k, repeats, np.random.default_rng(seed))


@one_thread()
def cross_validate(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
    rows: np.ndarray | None = None,
    workers: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> HeldOutPoses:
    """Solve without some of the poses and predict these.

    Parameters
    ----------
    pairs, setup, method, views, options
        As of :func:`~stcal.handeye.handeye`.
    rows : (s, k) int array, optional
        Poses to hold out, from :func:`splits`, which is also what None means.
    workers : int or None
        Processes for adjustments of corners, as many as cores where None.
    progress : callable, optional
        Called with the number of splits done, and that of all.

    Returns
    -------
    HeldOutPoses

    Raises
    ------
    StcalError
        As of :func:`~stcal.handeye.handeye`, where a split cannot be solved.
    """
    options = options or HandEyeOptions()
    if options.symmetries:
        mended = repair(pairs, setup, options.symmetries, views)
        pairs, views, options = mended.pairs, mended.views, replace(options, symmetries=())
    rows = splits(len(pairs)) if rows is None else rows
    jobs = [(pairs, setup, method, views, options, out) for out in rows]
    found: list[dict[str, np.ndarray]] = [{}] * len(jobs)
    slow = views is not None and method in (None, "reprojection")
    for done, (i, errors) in enumerate(run_parallel(errors_without, jobs, workers if slow else 1), 1):
        found[i] = errors
        if progress:
            progress(done, len(jobs))
    return HeldOutPoses(rows, **{name: np.array([errors[name] for errors in found]) for name in found[0]})


def errors_without(
    pairs: HandEyePoses,
    setup: Setup,
    method: str | None,
    views: Views | None,
    options: HandEyeOptions,
    out: np.ndarray,
) -> dict[str, np.ndarray]:
    """Of :class:`HeldOutPoses`, by name, on the poses ``out``, (k,): errors of the solution of the others, and it."""
    kept, arm = np.setdiff1d(np.arange(len(pairs)), out), options.arm
    if arm is not None:
        options = replace(options, arm=arm[kept])
    try:
        result = handeye(pairs[kept], setup, method, None if views is None else views[kept], options)
    except DegenerateError as error:
        names = ", ".join(pairs.names[i] for i in out)
        raise DegenerateError(error.code, f"without {names}: {error}") from error
    unseen = pairs[out]
    if arm is not None and result.reprojection is not None and result.reprojection.arm is not None:
        unseen = replace(unseen, base_from_flange=arm[out].poses(result.reprojection.arm))
    errors = predicted(result, unseen, None if views is None else views[out])
    return errors | {"mount_from_camera": result.mount_from_camera.matrix()}


def predicted(result: HandEye, pairs: HandEyePoses, views: Views | None) -> dict[str, np.ndarray]:
    """Errors of :class:`HeldOutPoses` by name, (k,) each, on pairs and views that the result has not seen."""
    scale, loop = result.scale, Loop.of(pairs, result.setup)
    if views is None:
        off = loop.residuals(result.mount_from_camera, result.stand_from_board, scale)
        return {
            "rotation_rad": np.linalg.norm(off[:, :3], axis=1),
            "translation_mm": np.linalg.norm(off[:, 3:], axis=1),
        }
    board = result.reprojection
    camera = views.camera if board is None else board.camera
    seen = [
        view.moved(scale * view.xyz_board if board is None else board.board(view.xyz_board)) for view in views.views
    ]
    by_view = resect(Views(camera, tuple(seen)), pairs.names).camera_from_board
    off = replace(loop, camera_from_board=by_view).residuals(result.mount_from_camera, result.stand_from_board)
    by_robot = result.mount_from_camera.inverse() @ loop.stand_from_mount.inverse() @ result.stand_from_board
    return {
        "rotation_rad": np.linalg.norm(off[:, :3], axis=1),
        "translation_mm": np.linalg.norm(off[:, 3:], axis=1),
        "board_mm": np.array([_beside(view, camera, pose) for view, pose in zip(seen, by_robot, strict=True)]),
        "pose_mm": np.array([_apart(view, *two) for view, *two in zip(seen, by_robot, by_view, strict=True)]),
    }


@one_thread()
def better_setup(pairs: HandEyePoses, setup: Setup, options: HandEyeOptions, rows: np.ndarray) -> str:
    """Whether poses held out are predicted far better in the other setup, by method ``pose``; empty where not.

    Parameters
    ----------
    pairs, setup, options
        As of :func:`~stcal.handeye.handeye`.
    rows : (s, k) int array
        Poses to hold out.

    Returns
    -------
    str
        A note, with both errors.
    """
    other: Setup = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    plain = replace(options, intrinsics=None, symmetries=())
    rows = rows[:SETUP_SPLITS]
    try:
        means = [cross_validate(pairs, each, "pose", None, plain, rows).means() for each in (setup, other)]
    except StcalError:  # of the one, which was told before, or of the other, which is none then
        return ""
    (turn, shift), (other_turn, other_shift) = ((m["rotation_rad"], m["translation_mm"]) for m in means)
    if not (turn * shift > SETUP_BETTER * other_turn * other_shift and turn > other_turn and shift > other_shift):
        return ""
    return Grave(
        f"poses held out are missed by {np.degrees(turn):.2g}° and {shift:.2g} mm as {setup}, by "
        f"{np.degrees(other_turn):.2g}° and {other_shift:.2g} mm as {other}: give --setup {other} if it is that"
    )


@one_thread()
def compare(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    views: Views | None = None,
    options: HandEyeOptions | None = None,
    methods: tuple[str, ...] = METHODS,
    rows: np.ndarray | None = None,
    workers: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Compared, ...]:
    """Every method on the same poses and the same splits.

    Parameters
    ----------
    pairs, setup, views, options
        As of :func:`~stcal.handeye.handeye`; without views, ``reprojection`` is passed over.
    methods : tuple of str
        Of :data:`~stcal.handeye.METHODS`.
    rows, workers
        As of :func:`cross_validate`; nothing is held out where ``rows`` is empty.
    progress : callable, optional
        Called with the number of methods done, and that of all.

    Returns
    -------
    tuple of Compared
        In the order of ``methods``; a method that fails says why.

    Raises
    ------
    InputError
        Poses in another convention.
    DegenerateError
        Poses that no method can solve.
    """
    options = options or HandEyeOptions()
    if options.symmetries:
        mended = repair(pairs, setup, options.symmetries, views)
        pairs, views, options = mended.pairs, mended.views, replace(options, symmetries=())
    handeye(pairs, setup, "pose", views, options)  # what is wrong with the poses is wrong for all methods
    rows = splits(len(pairs)) if rows is None else rows
    found = []
    for done, method in enumerate(methods):
        if progress:
            progress(done, len(methods))
        if method == "reprojection" and views is None:
            continue
        result, held_out, reason = None, None, ""
        try:
            result = handeye(pairs, setup, method, views, options)
            if len(rows):
                held_out = cross_validate(pairs, setup, method, views, options, rows, workers)
        except StcalError as error:
            reason = str(error)
        found.append(Compared(method, result, held_out, reason))
    if progress:
        progress(len(methods), len(methods))
    return tuple(found)


def _beside(view: View, camera: Camera, camera_from_board: Rigid) -> float:
    """Mean distance of the corners from where their rays pierce the plane of the board at their height."""
    ray = np.column_stack([camera.normalised_from_pixel(view.xy_px), np.ones(len(view))]) @ camera_from_board.rotation
    eye = camera_from_board.inverse().translation
    normal = view.normals()
    length = ((view.xyz_board - eye) * normal).sum(1) / (ray * normal).sum(1)
    return float(np.linalg.norm(eye + length[:, None] * ray - view.xyz_board, axis=1).mean())


def _apart(view: View, first: Rigid, second: Rigid) -> float:
    """Mean distance of the corners by two poses."""
    return float(np.linalg.norm(first @ view.xyz_board - second @ view.xyz_board, axis=1).mean())
