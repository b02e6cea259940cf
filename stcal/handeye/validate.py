"""Validation of a hand-eye calibration on poses and motions that were held out, and the scatter of its solutions."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from stcal.cross_validation import repeated_splits
from stcal.errors import DegenerateError, InputError, StcalError
from stcal.geometry.arrays import Brief, freeze, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.corner_views import View, Views, resect
from stcal.handeye.data.pose_pairs import OTHER, HandEyePoses, Loop, Motions, Setup
from stcal.handeye.handeye_problem import IN_COMMON, METHODS, HandEye, HandEyeOptions, HandEyeProblem
from stcal.handeye.methods.closed_form import robust
from stcal.handeye.methods.pose_adjustment import UNKNOWNS
from stcal.handeye.remarks import Aside, Grave
from stcal.parallel import one_thread, run_in_order

SETUP_SPLITS = 6  # number of splits that decide which setup is meant
SETUP_BETTER = 4.0  # factor by which the product of rotation and translation error must be smaller in the other setup
LEAST_LEFT = 3  # least number of poses that must remain to solve with
ERRORS = ("rotation_rad", "translation_mm", "board_mm", "pose_mm")
TRANSFORMS = ("mount_from_camera", "stand_from_board")
SCATTERED = 1.5
"""Scatter, in units of what σ predict, from which on there is a note. One in a hundred sets of twelve simulated poses
scatters as much if the poses err as assumed."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HeldOutPoses(Brief):
    """Errors on held-out poses, in s splits of k poses. One row of an array is one split.

    Parameters
    ----------
    rows : (s, k) int, rows of the poses that were held out
    rotation_rad, translation_mm : (s, k), deviation of the chain through robot and camera from the board's pose: angle,
        and distance of the origins
    board_mm : (s, k), 3-D error at the board: the board is placed by the robot's chain, and each corner's line of sight
        is intersected with it. Distance of the intersection from the corner, mean over the corners of a view.
    pose_mm : (s, k), distance between the corners as placed by the robot's chain and by the pose from the view alone,
        mean over the corners. It contains the error of the latter pose, mostly along the line of sight.
    mount_from_camera : (s, 4, 4), solution from the other poses of each split, mm
    """

    rows: np.ndarray
    rotation_rad: np.ndarray
    translation_mm: np.ndarray
    board_mm: np.ndarray | None = None
    pose_mm: np.ndarray | None = None
    mount_from_camera: np.ndarray | None = None

    def __post_init__(self):
        freeze(self, "rows", (None, None), "held-out poses", int)
        for name in ERRORS:
            if getattr(self, name) is not None:
                freeze(self, name, self.rows.shape, name)
        if self.mount_from_camera is not None:
            freeze(self, "mount_from_camera", (len(self.rows), 4, 4), "solutions")

    @classmethod
    def of_splits(cls, rows: np.ndarray, errors: list[dict[str, np.ndarray]]) -> "HeldOutPoses":
        """Returns the errors of all splits, from the fields of each by name."""
        return cls(rows, **{name: np.array([each[name] for each in errors]) for name in errors[0]})

    def means(self, of: np.ndarray | None = None) -> dict[str, float]:
        """Returns the mean of every available error over all splits, by name.

        ``of`` : mask (m,) of the poses that count, all if None. Empty if none of these was held out.
        """
        mask = np.ones(self.rows.shape, bool) if of is None else of[self.rows]
        known = {name: getattr(self, name) for name in ERRORS} if mask.any() else {}
        return {name: float(errors[mask].mean()) for name, errors in known.items() if errors is not None}

    def summary(self, outliers: np.ndarray | None = None) -> dict:
        """Returns the numbers of splits and of poses in each, and the means, of all poses and without outliers."""
        splits, poses = self.rows.shape
        agreeing = self.means(~outliers) if outliers is not None and outliers.any() else None
        return {"splits": splits, "poses": poses, **self.means(), "agreeing": agreeing or None}

    def scatter(self, result: HandEye) -> float:
        """Returns how much solutions without some poses scatter about that of all, relative to its σ, RMS over splits
        and six parameters: 1 is expected; NaN without covariance or solutions. If k of m poses are held out, the
        difference has the covariance C k / (m − k) (delete-k jackknife, Shao & Wu, Ann. Statist. 17, 1989), more with
        few poses left. Correlated or unequal errors make it larger."""
        matrices, seen = self.mount_from_camera, result.observability
        if result.covariance is None or matrices is None or not len(self.rows):
            return float("nan")
        m, out = len(result.names), self.rows.shape[1] / len(result.names)
        all_poses = Poses.of([result.mount_from_camera] * len(matrices))
        differences, told = Poses(matrices[:, :3, :3], matrices[:, :3, 3]).difference(all_poses), np.eye(6)
        if seen is not None and seen.one_axis:  # along it X is set, not estimated
            told = null_space(np.concatenate([np.zeros(3), seen.mount_axis])[None])
        differences = differences @ told
        inverse = generalised_inverse(told.T @ result.covariance @ told)
        squared = np.einsum("sa,ab,sb->s", differences, inverse, differences)
        dof = 6 * m * (1 - out) - UNKNOWNS - 1
        return float(np.sqrt(squared.mean() / differences.shape[1] * dof / (6 * m * out)))

    def widened(self, result: HandEye) -> HandEye:
        """Returns the result with σ widened by the :meth:`scatter`, if that exceeds 1, and a note if it is large."""
        factor = self.scatter(result)
        if not factor > 1:
            return result
        notes = result.notes
        if factor > SCATTERED:
            notes += (
                f"solutions of parts of the poses scatter {factor:.2g} times as much as σ say, so that poses do not "
                "err independently and alike: σ of both transforms are widened by that",
            )
        return replace(result.widened(factor), notes=notes)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Compared(Brief):
    """Result and errors of one method in a comparison.

    Parameters
    ----------
    method : one of :data:`~stcal.handeye.METHODS`
    result : solution from all poses; None if the method fails
    held_out : errors on held-out poses; None if the method fails, or no poses were held out
    reason : why the method fails; empty if it does not
    """

    method: str
    result: HandEye | None
    held_out: HeldOutPoses | None
    reason: str = ""


@require_arguments
def splits(count: int, held_out: int | None = None, repeats: int = 15, seed: int = 0) -> np.ndarray:
    """Draws the poses to hold out: at random, in rounds, each of which holds out every pose about once.

    Parameters
    ----------
    count : number of poses
    held_out : number of poses k to hold out at once; if None, a quarter of the poses, at least one
    repeats : number of splits
    seed : seed of the random order

    Returns
    -------
    (repeats, k) int array : Rows held out in each split, in ascending order.

    Raises InputError: fewer than three poses would remain.
    """
    if held_out is not None and held_out < 1:
        raise InputError("E-OPTION-RANGE", f"cross-validation: held_out {held_out}: 1 or more needed")
    k = max(1, count // 4) if held_out is None else held_out
    if count - k < LEAST_LEFT:
        said = f"{k} of {count} poses held out leave {count - k}, {LEAST_LEFT} needed; take more"
        raise InputError("E-HELD-OUT-FEW", f"cross-validation: {said}")
    return repeated_splits(count, k, repeats, np.random.default_rng(seed))


@require_arguments
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
    """Solves without some of the poses and predicts these, split by split.

    Parameters
    ----------
    pairs, setup, method, views, options : see :func:`~stcal.handeye.handeye`
    rows : (s, k) int, poses to hold out; those of :func:`splits` if None
    workers : number of processes for adjustments of corners; as many as cores if None
    progress : called with the number of splits done, and the number of all splits

    Raises StcalError: a split cannot be solved; see :func:`~stcal.handeye.handeye`.
    """
    problem = HandEyeProblem(pairs, setup, views, options or HandEyeOptions()).mended()
    rows = splits(len(pairs)) if rows is None else rows
    slow = views is not None and method in (None, "reprojection")
    jobs = [(problem, method, out) for out in rows]
    return HeldOutPoses.of_splits(rows, run_in_order(errors_without, jobs, workers if slow else 1, progress))


def errors_without(problem: HandEyeProblem, method: str | None, out: np.ndarray) -> dict[str, np.ndarray]:
    """Solves without the poses ``out``, (k,). Returns :func:`errors_of` these poses."""
    with naming_held_out(problem, out):
        result = problem.without(out).solved(method).result
    return errors_of(result, problem[out])


@contextmanager
def naming_held_out(problem: HandEyeProblem, out: np.ndarray) -> Iterator[None]:
    """Adds to a DegenerateError the names of the poses ``out``, (k,), that were held out."""
    try:
        yield
    except DegenerateError as error:
        names = ", ".join(problem.pairs.names[i] for i in out)
        raise DegenerateError(error.code, f"without {names}: {error}") from error


def errors_of(result: HandEye, unseen: HandEyeProblem) -> dict[str, np.ndarray]:
    """Returns the fields of :class:`HeldOutPoses` by name, (k,) each, for poses that the result has not seen."""
    loop, x, z, scale = unseen.loop, result.mount_from_camera, result.stand_from_board, result.scale
    errors = {"mount_from_camera": x.matrix()}
    if unseen.views is not None:
        adjusted = as_adjusted(result, unseen.views)
        by_view, _ = resect(adjusted, unseen.pairs.names)
        chains = zip(adjusted.views, poses_by_robot(result, loop), by_view, strict=True)
        off = (first @ view.xyz_board - second @ view.xyz_board for view, first, second in chains)
        errors["board_mm"] = deciding_error(result, unseen)
        errors["pose_mm"] = np.array([np.linalg.norm(each, axis=1).mean() for each in off])
        loop, scale = replace(loop, camera_from_board=by_view), 1.0
    turn, shift = loop.misses(x, z, scale).T
    return {"rotation_rad": turn, "translation_mm": shift, **errors}


def deciding_error(result: HandEye, unseen: HandEyeProblem) -> np.ndarray:
    """Returns errors (k,), mm, that choose among solutions: ``board_mm``, or ``translation_mm`` without views."""
    if unseen.views is None:
        return errors_of(result, unseen)["translation_mm"]
    adjusted = as_adjusted(result, unseen.views)
    poses = zip(adjusted.views, poses_by_robot(result, unseen.loop), strict=True)
    return np.array([_beside(view, adjusted.camera, pose) for view, pose in poses])


def _beside(view: View, camera: Camera, camera_from_board: Rigid) -> float:
    """Returns the mean distance of the corners from where their rays meet the board's plane at the corner's height."""
    ray = np.column_stack([camera.normalised_from_pixel(view.xy_px), np.ones(len(view))]) @ camera_from_board.rotation
    camera_centre, normal = camera_from_board.inverse().translation, view.normals()
    length = ((view.xyz_board - camera_centre) * normal).sum(1) / (ray * normal).sum(1)
    return float(np.linalg.norm(camera_centre + length[:, None] * ray - view.xyz_board, axis=1).mean())


def as_adjusted(result: HandEye, views: Views) -> Views:
    """Returns the views by the camera of the result, with the corners at their places on its board."""
    if result.reprojection is not None:
        return result.reprojection.adjusted(views)
    return replace(views, views=tuple(view.moved(result.scale * view.xyz_board) for view in views.views))


def poses_by_robot(result: HandEye, loop: Loop) -> Poses:
    """Returns camera_from_board as the robot's poses give it."""
    return result.mount_from_camera.inverse() @ loop.stand_from_mount.inverse() @ result.stand_from_board


@one_thread()
def better_setup(problem: HandEyeProblem, rows: np.ndarray) -> tuple[str, ...]:
    """Returns a note if method ``pose`` predicts held-out poses ``rows`` (s, k) far better in the other setup."""
    setup = problem.setup
    opposite = OTHER[setup]
    plain = replace(problem, views=None, options=replace(problem.options, intrinsics=None, symmetries=()))
    try:
        if not problem.options.four_dof and SETUP_BETTER * _robust_miss(plain, setup) < _robust_miss(plain, opposite):
            return ()
        known = {"options": plain.options, "rows": rows[:SETUP_SPLITS]}
        first, other = (cross_validate(plain.pairs, each, "pose", **known).means() for each in (setup, opposite))
    except StcalError:  # the stated setup failed, which was reported before, or the other setup is none
        return ()
    (turn, shift), (other_turn, other_shift) = (list(each.values()) for each in (first, other))
    if not (turn * shift > SETUP_BETTER * other_turn * other_shift and turn > other_turn and shift > other_shift):
        return ()
    as_stated = f"{np.degrees(turn):.2g}° and {shift:.2g} mm as {setup}"
    as_other = f"{np.degrees(other_turn):.2g}° and {other_shift:.2g} mm as {opposite}"
    return (Grave(f"poses held out are missed by {as_stated}, by {as_other}: give --setup {opposite} if it is that"),)


def _robust_miss(problem: HandEyeProblem, setup: Setup) -> float:
    """Returns the product of median rotation and translation (rad mm) by which a quick solution misses the poses."""
    loop = Loop.of(problem.pairs, setup)
    return float(np.median(loop.misses(*robust(loop, problem.options.with_scale)), axis=0).prod())


@require_arguments
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
    """Solves by every method on the same poses and the same splits.

    Parameters
    ----------
    pairs, setup, views, options : see :func:`~stcal.handeye.handeye`; without views, ``reprojection`` is skipped
    methods : names out of :data:`~stcal.handeye.METHODS`
    rows, workers : see :func:`cross_validate`; nothing is held out if ``rows`` is empty
    progress : called with the number of methods done, and the number of all methods

    Returns
    -------
    tuple of Compared : One per method, in the order of ``methods``; a method that fails has a reason.

    Raises InputError: the poses follow another convention. Raises DegenerateError: no method can solve these poses.
    """
    problem = HandEyeProblem(pairs, setup, views, options or HandEyeOptions()).mended()
    problem.solved("pose")  # raises if the poses themselves are at fault, whatever the method
    rows = splits(len(pairs)) if rows is None else rows
    compared, methods = [], tuple(each for each in methods if views is not None or each != "reprojection")
    for done, method in enumerate(methods, 1):
        result, held_out, reason = None, None, ""
        try:
            result = problem.solved(method).result
            if len(rows):
                known = {"options": problem.options, "rows": rows, "workers": workers}
                held_out = cross_validate(problem.pairs, setup, method, problem.views, **known)
        except StcalError as error:
            reason = str(error)
        compared.append(Compared(method, result, held_out, reason))
        if progress is not None:
            progress(done, len(methods))
    return tuple(compared)


def with_jackknife(result: HandEye, without_one: list[HandEye]) -> HandEye:
    """Returns a result with covariances by the delete-one jackknife (Quenouille 1956, Tukey 1958): solutions without
    each of m poses scatter (m − 1)⁻² as much as independent ones."""
    m, moved = len(without_one), (each - each.mean(0) for each in _differences(without_one, result))
    mount, stand = ((m - 1) / m * each.T @ each for each in moved)
    note = Aside(f"σ of both transforms are by the jackknife: the scatter of {result.method} without each of the poses")
    return replace(result, covariance=mount, stand_covariance=stand, notes=(*result.notes, note))


def _differences(others: list[HandEye], result: HandEye) -> list[np.ndarray]:
    """Returns the differences (n, 6) of X and of Z of other results against ``result``."""
    pairs = ([(getattr(each, name), getattr(result, name)) for each in others] for name in TRANSFORMS)
    return [np.array([one.difference(other) for one, other in each]).reshape(-1, 6) for each in pairs]


def with_common_errors(result: HandEye, problem: HandEyeProblem) -> HandEye:
    """Returns a result with covariances that contain what one σ of each common error of the board's poses moves it."""
    common, seen = problem.pairs.camera_from_board_common, problem.pairs.camera_from_board
    if common is None:
        return result
    erring = (replace(problem.pairs, camera_from_board=seen.moved(s.copy())) for s in np.moveaxis(common, 2, 0))
    moved = [replace(problem, pairs=each, views=None).solved(result.method).result for each in erring]
    mount, stand = (m.T @ m for m in _differences(moved, result))
    wider = {"covariance": result.covariance + mount, "stand_covariance": result.stand_covariance + stand}
    return replace(result, **wider, common_covariance=mount, notes=(*result.notes, IN_COMMON))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HeldOutMotions(Brief):
    """Errors of the last k motions, predicted by the solution from the poses before them: Jin et al., eqs. 24–26.

    Parameters
    ----------
    fitted : number of motions that the solution uses
    names : (str, str), names of the poses from which and to which each motion leads
    rotation_rad, translation_mm : (k,), errors of Â = X B X⁻¹ against A
    """

    fitted: int
    names: tuple[tuple[str, str], ...]
    rotation_rad: np.ndarray
    translation_mm: np.ndarray

    def __post_init__(self):
        for name in ("rotation_rad", "translation_mm"):
            freeze(self, name, (len(self.names),), name)


def motion_errors(mount_from_camera: Rigid, motions: Motions) -> np.ndarray:
    """Returns the errors of Â = X B X⁻¹ against A: Jin et al., eqs. 24–26.

    Parameters
    ----------
    mount_from_camera : X
    motions : the k motions: A of the mount, B of the camera

    Returns
    -------
    (k, 2) array : Angle of the difference, rad; distance of the translations, mm.
    """
    difference = (mount_from_camera @ motions.camera @ mount_from_camera.inverse()).difference(motions.mount)
    return np.column_stack([np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)])


@require_arguments
@one_thread()
def predict_motions(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
    count: int = 6,
) -> HeldOutMotions:
    """Solves with the poses before the last ``count`` motions from pose to pose, and predicts these motions.

    Jin et al. hold out the last 6 of 24 motions.

    Parameters
    ----------
    pairs, setup, method, views, options : see :func:`~stcal.handeye.handeye`
    count : number of motions to hold out

    Raises InputError: too few poses are left. Raises StcalError: the solution fails; see
    :func:`~stcal.handeye.handeye`.
    """
    remaining, most = len(pairs) - count, max(len(pairs) - LEAST_LEFT, 0)
    if not 1 <= count <= most:
        said = f"of {max(len(pairs) - 1, 0)} motions, 1 to {most} can be held out; give another number, or more poses"
        raise InputError("E-OPTION-RANGE", f"--motions-held-out {count}: {said}")
    problem = HandEyeProblem(pairs, setup, views, options or HandEyeOptions())
    result = problem[np.arange(remaining)].solved(method).result
    errors = motion_errors(result.mount_from_camera, Motions.consecutive(problem.loop)[remaining - 1 :])
    names = tuple(zip(pairs.names[remaining - 1 : -1], pairs.names[remaining:], strict=True))
    return HeldOutMotions(remaining - 1, names, errors[:, 0], errors[:, 1])
