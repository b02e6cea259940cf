"""Hand-eye calibration from a file of poses or from images of any board, for ``stcal handeye``, and the poses to take
next within an arm's reach. The offset of the clocks may be unknown too. It composes three systems."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, NextPoses, plan_poses
from stcal.handeye.conventions import flipped, tilted
from stcal.handeye.data.pose_pairs import rms_of
from stcal.handeye.data.stream import LONGEST_S, Timed
from stcal.handeye.handeye_pipeline import ALL, Outcome, validated
from stcal.handeye.handeye_problem import HandEye, HandEyeProblem, problem_of
from stcal.handeye.remarks import Aside, Grave, SizeDoubt, of_setup
from stcal.handeye.time_offset import TimeOffset, estimate_offset
from stcal.handeye.validate import LEAST_LEFT, better_setup, predict_motions, splits
from stcal.parallel import Progress, one_thread
from stcal.robot import Robot, inverse
from stcal.robot.kinematics.inverse import REACHED
from stcal.robot.use.compensation import joint_columns
from stcal.workflows.handeye_inputs import HandEyeInput


@require_arguments
def calibrate_handeye(
    given: HandEyeInput,
    method: str | None = None,
    options: HandEyeOptions | None = None,
    *,
    refine_camera: bool = False,
    time_offset: bool = False,
    repeats: int = 15,
    held_out: int | None = None,
    seed: int = 0,
    motions: int | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Returns where the camera sits on the flange, or in the base, with errors on poses held out.

    Parameters
    ----------
    given : of :func:`stcal.workflows.read_handeye`
    method : one of :data:`stcal.handeye.METHODS`, or ``all`` to compare them; the way that predicts poses held out best
        if None
    options : known errors, and further unknowns; the symmetries of the board are those of ``given``
    refine_camera : whether the intrinsics are adjusted, from those of the camera file with their σ
    time_offset : whether the offset of the two clocks is estimated first
    repeats : number of splits of the cross-validation; 0 for none
    held_out : number of poses held out in each; a quarter if None
    seed : seed of the splits
    motions : number of the last motions to predict from the poses before
    workers : number of processes; one per core if None
    progress : called with (stage, done, total)

    Returns
    -------
    Outcome
        ``result``, a :class:`stcal.handeye.HandEye`, mm and rad; its errors on poses ``held_out``; ``all_notes()``.

    Raises StcalError: as of :func:`stcal.handeye.handeye`; the message also names what was left out before.
    """
    options, offset, told = options or HandEyeOptions(), None, progress or (lambda *_: None)
    intrinsics = given.prior if refine_camera else options.intrinsics
    options = replace(options, intrinsics=intrinsics, symmetries=given.symmetries)
    choosing = method is None and not (options.names_unknowns or options.camera is not None)
    if time_offset:
        given, options, offset = at_offset(given, options)
    try:
        if options.camera is None:
            options = replace(options, camera=given.prior)
        pairs, rows = given.pairs, np.zeros((0, 0), int)
        if repeats and (held_out or len(pairs) > LEAST_LEFT):
            rows = splits(len(pairs), held_out, repeats, seed)
        stage, prior = "methods" if method == ALL else "held out", given.prior if given.views is not None else None
        outcome = validated(given, options, method, rows, prior, choosing, workers, partial(told, stage))
        problem, result, notes = problem_of(given, outcome.options), outcome.result, outcome.notes
        if len(rows):
            notes += better_setup(problem, rows)
        if not given.setup:
            notes += of_setup(result.mount_from_camera, result.stand_from_board, problem.setup)
        if given.views is None and pairs.camera_from_board_covariance is None and result.covariance is not None:
            notes += (NO_COVARIANCE,)
        if not time_offset:
            result, lagging = lag_tried(problem, given.timed, result)
            notes += lagging
        last, mended = None, problem.mended()
        if motions is not None:
            last = predict_motions(pairs, problem.setup, result.method, given.views, problem.options, motions)
        solved = replace(given, pairs=mended.pairs, views=mended.views)
        outcome = replace(outcome, given=solved, result=result, notes=notes, motions=last)
    except StcalError as error:
        if given.left_out:
            name, why = given.left_out[0]
            error.append(f"; {len(given.left_out)} left out before, first {name}: {why}")
        raise
    return outcome if offset is None else replace(outcome, result=offset.carried(outcome.result), time_offset=offset)


NO_COVARIANCE = Aside(
    "the board's poses state no covariance: what all of them err by in common, as by the intrinsics or the board's "
    "size, is not in σ; `measure` writes it (columns cov_… and common…)"
)
HINT_T, SURE_SIGMAS = 3.0, 4.0
"""Student's t from which an offset is solved for, and number of its σ from which it is reported (1 in 16,000)."""
FALLS = 0.98
"""Largest ratio of mean squares of residuals with and without a harmless offset at which the offset is reported."""
HARMFUL = 1.0  # change of the transform by the offset, in its σ, from which it is called wrong; without σ it is always
SMOOTH, LEAST_ROWS = 0.2, 20
"""Largest deviation of poses from a cubic through their neighbours, as a share of the steps between them, with which
their order counts as that of a motion; and least number of such poses."""


@one_thread()
def at_offset(given: HandEyeInput, options: HandEyeOptions) -> tuple[HandEyeInput, HandEyeOptions, TimeOffset]:
    """Returns the input with the robot's poses at the estimated offset, and numberings of a symmetric board corrected.
    Raises InputError: there are no times, or the robot has four axes. Raises StcalError: as :func:`estimate_offset`."""
    timed = given.timed
    if timed is None:
        said = f"{given.where}: --time-offset needs times of both, of the robot's poses (a column time_s"
        raise InputError("E-POSES-UNTIMED", f"{said}, or TUM) and of the images (their names, or --image-times)")
    if options.four_dof:
        said = "--time-offset: not with --four-dof, whose motions do not determine it; leave one of them out"
        raise InputError("E-OPTION-CONFLICT", said)
    problem = problem_of(given, options).mended()
    pairs, views, noise = problem.pairs, problem.views, options.noise
    offset = estimate_offset(pairs, timed.stream, timed.seconds, problem.setup, noise, options.with_scale)
    rows, why = np.flatnonzero(offset.kept), "outside of the robot's times at the time offset"
    left_out = (*given.left_out, *((pairs.names[i], why) for i in np.flatnonzero(~offset.kept)))
    lines, views = (*given.understood, *problem.notes), None if views is None else views[rows]
    pairs = replace(pairs[rows], base_from_flange=offset.base_from_flange)
    given = replace(given, pairs=pairs, views=views, symmetries=(), left_out=left_out, understood=lines)
    return given, problem.options, offset


@one_thread()
def lag_tried(problem: HandEyeProblem, timed: Timed | None, result: HandEye) -> tuple[HandEye, tuple[str, ...]]:
    """Returns the result and a note if clocks that differ explain its residuals; a doubt of size that it ends goes."""
    pairs, setup, options = problem.pairs, problem.setup, problem.options
    if timed is None or options.four_dof or len(result.outliers) != len(pairs) or not _is_moving(timed):
        return result, ()
    try:
        if abs(_lag_t(problem, timed, result)) < HINT_T:
            return result, ()
        plain = replace(options, intrinsics=None, camera=None, symmetries=())
        lag = estimate_offset(pairs, timed.stream, timed.seconds, setup, options.noise, options.with_scale)
        shifted = replace(pairs[np.flatnonzero(lag.kept)], base_from_flange=lag.base_from_flange)
        problems = (HandEyeProblem(each, setup, None, plain) for each in (pairs[lag.kept], shifted))
        before, after = (each.solved("pose").result for each in problems)
    except StcalError:  # the motions tell no offset
        return result, ()
    fits = [float((np.linalg.norm(each.residuals[~each.outliers, 3:], axis=1) ** 2).mean()) for each in (before, after)]
    moved = np.abs(lag.seconds * lag.slope[:6])
    harmful = result.covariance is None or (moved / np.sqrt(np.diag(result.covariance))).max() > HARMFUL
    if abs(lag.seconds) < SURE_SIGMAS * lag.sigma_s or fits[1] > (1.0 if harmful else FALLS) * fits[0]:
        return result, ()
    old, new = (f"{np.degrees(each.rms()[0]):.2g}° and {each.rms()[1]:.3g} mm" for each in (before, after))
    size, sigma, ahead = abs(lag.seconds), lag.sigma_s, lag.seconds > 0
    clock = f"robot's clock is {1e3 * size:.3g} ± {1e3 * sigma:.2g} ms {'ahead of' if ahead else 'behind'} the camera's"
    said = f"by the motions the {clock}, with which residuals fall from {old} to {new}: solve with --time-offset"
    if not any(isinstance(note, SizeDoubt) for note in after.notes):
        result = replace(result, notes=tuple(note for note in result.notes if not isinstance(note, SizeDoubt)))
    return result, (Grave(said) if harmful else said,)


def _is_moving(timed: Timed) -> bool:
    """True if the robot's poses tell velocities at the images; about one sample for each image must be smooth."""
    samples = timed.stream.seconds
    after = np.clip(np.searchsorted(samples, timed.seconds, side="right"), 1, len(samples) - 1)
    if np.median(samples[after] - samples[after - 1]) > LONGEST_S:
        return False
    if timed.stream.spacing_s() < float(np.median(np.diff(np.sort(timed.seconds)))) / 2:
        return True
    poses = timed.stream.base_from_flange
    steps = rms_of(poses[1:].difference(poses[:-1]))
    smooth = all(own < SMOOTH * step for own, step in zip(timed.stream.rest(), steps, strict=True))
    return smooth and len(timed.seconds) >= LEAST_ROWS


def _lag_t(problem: HandEyeProblem, timed: Timed, result: HandEye) -> float:
    """Returns Student's t of an offset solved for with X and Z, to first order, without outliers."""
    good = np.flatnonzero(~result.outliers)
    loop, x = problem.loop[good], result.mount_from_camera
    residuals = loop.residuals(x, result.stand_from_board, result.scale)
    by_time = loop.by_robot(x, result.scale) @ timed.stream.velocity(timed.seconds[good])[:, :, None]
    columns = 12 + (result.sigma_scale is not None)
    jacobian = np.concatenate([loop.jacobian(x, result.scale, columns), by_time], axis=2)
    size = np.sqrt((residuals.reshape(-1, 2, 3) ** 2).mean((0, 2)))
    weight = 1 / np.repeat(np.maximum(size, 1e-12), 3)
    flat, left = (jacobian * weight[:, None]).reshape(-1, columns + 1), (residuals * weight).ravel()
    covariance = generalised_inverse(flat.T @ flat)
    step = -covariance @ (flat.T @ left)
    variance = float(((left + flat @ step) ** 2).sum()) / max(len(left) - columns - 1, 1)
    return float(step[-1] / np.sqrt(max(variance * covariance[-1, -1], 1e-300)))


LEAST_REACHED = 0.5  # share of the poses taken that the arm of a robot file must reach to be accepted as this robot


@dataclass(frozen=True, slots=True, eq=False)
class Planned:
    """``poses`` : to take, after ``result``; ``joints`` : (k,) of these by column, deg or mm, with a robot file."""

    result: HandEye
    poses: NextPoses
    joints: dict[str, np.ndarray]
    notes: tuple[str, ...]


@require_arguments
@one_thread()
def plan_handeye(given: HandEyeInput, count: int = 3, robot: Robot | None = None, seed: int = 0) -> Planned:
    """Returns the robot poses that would lower the worst σ at the board most, after those of a hand-eye calibration.

    Parameters
    ----------
    given : poses taken so far, of :func:`stcal.workflows.read_handeye`
    count : number of poses to plan
    robot : robot within whose joint limits the poses are to be, from its own base to its flange, no tool
    seed : seed of the candidates

    Returns
    -------
    Planned : ``poses`` to take, mm; with a robot ``joints``, deg or mm, by column; the ``result`` so far.

    Raises InputError: for the reasons given in :func:`stcal.handeye.plan_poses`, or the robot does not reach half of
    the poses taken. Raises DegenerateError: for the reasons given in :func:`stcal.handeye.handeye`.
    """
    result = problem_of(given, HandEyeOptions(symmetries=given.symmetries)).solved().result
    camera = outline = None
    if given.views is not None:
        camera = given.views.camera
        outline = np.unique(np.concatenate([view.xyz_board for view in given.views.views]), axis=0)
    if robot is None:
        return Planned(result, plan_poses(given.pairs, result, count, outline, camera, None, seed), {}, ())
    near, notes = _taken(robot, given)

    def reachable(flange: Poses) -> np.ndarray:
        """Returns True where a pose is within the limits and its joint values are determined."""
        return np.array([status == REACHED for status in inverse(robot, flange, near).status])  # type: ignore[arg-type]

    planned = plan_poses(given.pairs, result, count, outline, camera, reachable, seed)
    q = inverse(robot, planned.base_from_flange, near).q
    joints = dict(zip(joint_columns(robot), np.where(robot.prismatic, q, np.degrees(q)).T, strict=True))
    return Planned(result, planned, joints, notes)


def _taken(robot: Robot, given: HandEyeInput) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns the joint values (n,) of the last pose that the robot reaches, and notes on those that it does not."""
    flange, middle = given.pairs.base_from_flange, robot.limits().mean(1)
    solutions = inverse(robot, flange, np.where(np.isfinite(middle), middle, 0.0))  # joints without limits from 0
    beyond = [name for name, usable in zip(given.pairs.names, solutions.usable, strict=True) if not usable]
    message = f"robot {robot.name}: reaches {len(flange) - len(beyond)} of the {len(flange)} poses taken"
    if len(beyond) > (1 - LEAST_REACHED) * len(flange):
        remedy = "give the robot's own file, in whose base and flange (no tool) the poses are"
        raise InputError("E-PLAN-ROBOT", f"{message}, first not {beyond[0]}; {remedy}")
    notes = (f"{message}, not {', '.join(beyond)}: do its lengths and limits hold for this arm?",) if beyond else ()
    return solutions.q[np.flatnonzero(solutions.usable)[-1]], notes


MOST_ROUNDS = 3
"""Largest number of rounds of solving and tilting; a flip by few degrees stands out when the larger ones are gone."""


@require_arguments
def without_flips(given: HandEyeInput, options: HandEyeOptions | None = None) -> tuple[HandEyeInput, str]:
    """Returns the input with the second pose of a flat target, tilted the other way, for poses that agree only so.

    Parameters
    ----------
    given : pairs of poses, of :func:`stcal.workflows.read_handeye`
    options : as for :func:`stcal.workflows.calibrate_handeye`

    Returns
    -------
    HandEyeInput, str : The input, and a sentence that names the poses.

    Raises InputError: the input consists of images, which determine the poses by themselves.
    """
    problem = problem_of(given, options or HandEyeOptions())
    if given.views is not None:
        raise InputError("E-OPTION-NEEDS", "--undo-flips: only with poses; of images, the corners decide the tilt")
    undone = np.zeros(len(problem), bool)
    for _ in range(MOST_ROUNDS):
        result, pairs = problem.solved("pose").result, problem.pairs
        flips = flipped(problem.loop, result.mount_from_camera, result.stand_from_board, result.outliers) & ~undone
        if not flips.any():
            break
        seen, other = pairs.camera_from_board, tilted(pairs.camera_from_board)
        turned = Poses(np.where(flips[:, None, None], other.rotation, seen.rotation), seen.translation)
        problem, undone = replace(problem, pairs=replace(pairs, camera_from_board=turned)), undone | flips
    shown = ", ".join(name for name, flip in zip(given.pairs.names, undone, strict=True) if flip)
    said = f"tilted the other way, as --undo-flips asks, {undone.sum()} of {len(problem)} poses: {shown or 'none'}"
    return replace(given, pairs=problem.pairs), said
