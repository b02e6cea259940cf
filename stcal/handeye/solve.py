"""One call for every method."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TypeVar

import numpy as np
from scipy.stats import chi2

from stcal.errors import DegenerateError, InputError
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.loop import FRAMES, Loop, Setup
from stcal.handeye.data.motions import Motions, poses_with_log
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import Views
from stcal.handeye.judge import remarks
from stcal.handeye.judge.conventions import Guess, check_conventions
from stcal.handeye.judge.notes import Aside
from stcal.handeye.judge.observability import Observability, check, in_words, require_scale
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.methods import start
from stcal.handeye.methods.arm import ArmModel
from stcal.handeye.methods.camera_error import of_poses
from stcal.handeye.methods.closed_form import AX_XB, AX_ZB, closed_form
from stcal.handeye.methods.convex import convex
from stcal.handeye.methods.evolution import EvolutionOptions, Objective, evolve, polish
from stcal.handeye.methods.noise import Noise
from stcal.handeye.methods.pose_adjustment import LoopState, PoseSolution, adjust_poses
from stcal.handeye.methods.reprojection import CAMERA_GAIN, AdjustedViews, adjust_views, resected
from stcal.handeye.result import HandEye
from stcal.io.cameras.model import CameraPrior
from stcal.parallel import one_thread

S = TypeVar("S", PoseSolution, AdjustedViews)
OTHERS = ("zhao", "de", "de-polished", "pose", "reprojection")
METHODS = (*AX_XB, *AX_ZB, *OTHERS)
"""Names of the methods."""
UNIT_MM = 1000.0
"""Length that weighs like one radian where no σ are stated: errors of 1 mm go with errors of 1 mrad."""
FACTORS = {
    "camera_focal": "focal length",
    "camera_centre": "principal point",
    "camera_radial": "radial distortion",
    "camera_tangential": "tangential distortion",
    "camera_all": "all",
}
LEAST_WITH_SCALE = 4
"""Three poses leave five redundancies, with which no σ can be told."""
WIDENED = 2.0
"""Factor of the σ of a camera file, or of the poses by it, from which on the file is doubted."""
ROBOT_BEYOND, BY_CHANCE = 2.0, 5e-4
"""A robot's stated σ are doubted from so many times on, where chance makes as much so rarely."""
REST_WORSE = 1.2
"""Times by which corners fit worse if a robot that is called exact is."""
ROBOT = ("robot_rad", "robot_mm")
HELD_MM = 1e-6
"""σ by which X is held where it slides along the one axis of a robot of four axes."""


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeOptions:
    """What is known, and what is to be solved for.

    Parameters
    ----------
    noise : Noise
        What is known of the errors; the rest is estimated.
    intrinsics : CameraPrior, optional
        Solve for the camera's parameters too, held by this; ``reprojection`` only.
    with_scale : bool
        Solve for the board's true size too; ``pose`` and ``reprojection`` only.
    symmetries : tuple of Rigid
        All board_from_board after which the board looks the same, but for the identity: views that were numbered from
        another end are put right.
    four_dof : bool
        The flange turns about one axis only: solve for all but X along it; ``pose`` and ``reprojection`` only.
    evolution : EvolutionOptions
        Of ``de`` and ``de-polished``.
    camera : CameraPrior, optional
        What is known of the camera's parameters where they are not solved for: their errors become part of σ, with
        views. They are exact where None.
    arm : ArmModel, optional
        With the joint vectors of the same poses: solve for its parameters too, held by σ that are estimated;
        ``reprojection`` only. Its poses replace those of the pairs.
    """

    noise: Noise = field(default_factory=Noise)
    intrinsics: CameraPrior | None = None
    with_scale: bool = False
    symmetries: tuple[Rigid, ...] = ()
    four_dof: bool = False
    evolution: EvolutionOptions = field(default_factory=EvolutionOptions)
    camera: CameraPrior | None = None
    arm: ArmModel | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """One call's input: ``pairs`` and ``views`` repaired; ``guess`` : of a loop, and whether the board's scale is free,
    first X, Z and scale; ``seen`` : observability; ``notes`` : so far."""

    pairs: HandEyePoses
    loop: Loop
    setup: Setup
    views: Views | None
    options: HandEyeOptions
    guess: Guess
    seen: Observability
    notes: tuple[str, ...]


def _guess(options: HandEyeOptions, seen: Observability, loop: Loop, with_scale: bool) -> tuple[Rigid, Rigid, float]:
    """First X, Z and scale."""
    if options.four_dof:
        return start.about_one_axis(loop, seen.mount_axis, with_scale)
    return start.robust(loop, with_scale)


@one_thread()
def handeye(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
) -> HandEye:
    """Where the camera sits on the flange, or in the robot's base.

    Parameters
    ----------
    pairs : HandEyePoses
        At least three, rotated about two axes that are not parallel; see :func:`~stcal.handeye.read_poses`,
        :func:`~stcal.handeye.pairs_of_views`.
    setup : str
        ``eye-in-hand``: the camera on the flange; ``eye-to-hand``: the board on the flange.
    method : str, optional
        One of :data:`METHODS`; ``reprojection`` with views, else ``pose`` where none is named.
    views : Views, optional
        The corners that ``pairs`` come from; only ``reprojection`` uses them.
    options : HandEyeOptions, optional
        What is known of errors and camera, and what else to solve for; the defaults where None.

    Returns
    -------
    HandEye
        X and Z with covariances, residuals, outliers, and notes on what is doubtful.

    Raises
    ------
    InputError
        Unknown method or setup, ``reprojection`` without views, or poses in another convention.
    DegenerateError
        The poses do not determine the answer; the message says which motion is missing.
    ConvergenceError
        The method fails on these poses.

    Examples
    --------
    >>> pairs = read_poses("poses.csv")  # doctest: +SKIP
    >>> found = handeye(pairs, "eye-in-hand")  # doctest: +SKIP
    >>> found.flange_from_camera @ [0, 0, 500]  # a point half a metre before the camera  # doctest: +SKIP
    """
    method = method or ("pose" if views is None else "reprojection")
    if method not in METHODS:
        raise InputError(
            "E-OPTION-METHOD", f"hand-eye: method {method!r} is unknown; one of {', '.join(METHODS)} needed"
        )
    if method == "reprojection" and (views is None or len(views) != len(pairs)):
        raise InputError(
            "E-HANDEYE-NEEDS-VIEWS",
            "hand-eye: reprojection needs the corners of every pose; give views, or use method pose",
        )
    options = options or HandEyeOptions()
    if options.arm is not None and method != "reprojection":
        raise InputError(
            "E-HANDEYE-NEEDS-VIEWS",
            f"hand-eye: {method} does not solve for the arm; give views, and method reprojection",
        )
    task = _task(pairs, setup, views, options)
    if method == "pose":
        return _by_poses(task)
    if method == "reprojection" and task.views is not None:
        return _by_views(task, task.views)
    return _by_equations(task, method)


def _task(pairs: HandEyePoses, setup: Setup, views: Views | None, options: HandEyeOptions) -> _Task:
    """Checks that all methods share."""
    seen = check(Loop.of(pairs, setup), setup, pairs.where, options.four_dof)
    if options.with_scale and len(pairs) < LEAST_WITH_SCALE:
        raise DegenerateError(
            "E-HANDEYE-FEW-POSES",
            f"{pairs.where}: {len(pairs)} poses, {LEAST_WITH_SCALE} needed to find the board's size too; take more",
        )
    notes: tuple[str, ...] = ()
    if options.symmetries:
        mended = repair(pairs, setup, options.symmetries, views)
        pairs, views, notes = mended.pairs, mended.views, mended.notes()
    loop, guess = Loop.of(pairs, setup), cache(partial(_guess, options, seen))
    notes += check_conventions(pairs, loop, setup, guess, options.with_scale, views is not None)
    return _Task(pairs, loop, setup, views, options, guess, seen, notes)


def _by_equations(task: _Task, method: str) -> HandEye:
    """The methods that solve AX = XB or AX = ZB."""
    if task.options.four_dof:
        raise DegenerateError(
            "E-HANDEYE-AXES", f"hand-eye: {method} needs rotations about two axes; with four_dof use method pose"
        )
    loop, notes, noise = task.loop, task.notes, task.options.noise
    unit_mm = noise.camera_mm / noise.camera_rad if noise.camera_mm and noise.camera_rad else UNIT_MM
    if method in AX_XB and not (used := poses_with_log(loop)).all():
        left_out = ", ".join(name for name, u in zip(task.pairs.names, used, strict=True) if not u)
        notes = (*notes, Aside(f"left out, for they turn by more than 170° against others: {left_out}"))
        loop = loop[used]
        if len(loop) < 3 or Observability.of(loop).useless:
            raise DegenerateError(
                "E-HANDEYE-LARGE-TURNS",
                f"hand-eye: without {left_out}, that turn by more than 170° against others, too few poses are left for "
                f"{method}; use method pose or shah",
            )
    if method in (*AX_XB, *AX_ZB):
        x, z = closed_form(loop, method, unit_mm)
    else:
        x = _by_motions(loop, method, unit_mm, task.options.evolution)
        if method == "de":
            notes = (*notes, Aside(task.options.evolution.in_words(unit_mm)))
        z = start.mean_pose(task.loop.chain(x))
    none = np.zeros(len(task.loop), bool)
    residuals = task.loop.residuals(x, z)
    return HandEye(
        method=method,
        setup=task.setup,
        mount_from_camera=x,
        stand_from_board=z,
        residuals=residuals,
        names=task.pairs.names,
        outliers=none,
        observability=task.seen,
        notes=notes,
    )


def _by_motions(loop: Loop, method: str, unit_mm: float, options: EvolutionOptions) -> Rigid:
    """X from the motions from each pose to the next."""
    motions = Motions.consecutive(loop)
    if method == "zhao":
        return convex(motions, unit_mm)
    objective = Objective(motions.with_log(method), unit_mm, options.weight)
    farthest = max(np.linalg.norm(p.translation, axis=1).max() for p in (loop.camera_from_board, loop.stand_from_mount))
    known = closed_form(loop, "park-martin", unit_mm)[0] if options.needs_closed_form() else None
    x = evolve(objective, options, float(farthest), known)
    return polish(objective, x) if method == "de-polished" else x


def _by_poses(task: _Task) -> HandEye:
    options = task.options
    first = LoopState(*task.guess(task.loop, options.with_scale))
    solution, contradicted = _by_true_robot(
        task, lambda loop, noise: adjust_poses(loop, first, noise, options.with_scale)
    )
    noise = options.noise if not contradicted else replace(options.noise, robot_rad=None, robot_mm=None)
    state, normal = solution.state, solution.normal
    x, z = state.mount_from_camera, state.stand_from_board
    notes, covariance = task.notes + contradicted, generalised_inverse(normal)
    sigma_scale = float(np.sqrt(covariance[12, 12])) if options.with_scale else None
    if sigma_scale is not None:
        require_scale(state.scale, sigma_scale, task.loop, task.pairs.where)
    if options.four_dof:
        x, z, covariance, notes = _without_slide(task, x, z, normal)
    notes += _remarks(task, solution.outliers, solution.residuals, solution.scale_hint)
    if (factor := solution.sigma.get("camera_factor", 1.0)) > WIDENED:
        notes += (f"the board's poses err {factor:.2g} times what their σ say: check the intrinsics",)
    if not solution.sigma or noise.robot_rad is not None or noise.camera_rad is not None:
        beyond = remarks.of_variance(solution.variance_factor, solution.redundancy)
        notes += beyond
        if beyond and solution.variance_factor > 1:
            covariance = covariance * solution.variance_factor
    if task.views is not None and options.camera is not None:
        error = of_poses(task.loop, solution, task.views, options.camera)
        covariance = error.covariance(covariance[:12, :12])
    stated = {name: getattr(noise, name) for name in ("robot_rad", "robot_mm", "camera_rad", "camera_mm")}
    return HandEye(
        method="pose",
        setup=task.setup,
        mount_from_camera=x,
        stand_from_board=z,
        residuals=solution.residuals,
        names=task.pairs.names,
        outliers=solution.outliers,
        covariance=covariance[:6, :6],
        stand_covariance=covariance[6:12, 6:12],
        scale=state.scale,
        sigma_scale=sigma_scale,
        sigma={name: value for name, value in stated.items() if value} | solution.sigma,
        estimated=tuple(solution.sigma),
        observability=task.seen,
        notes=notes + remarks.of_rounds(solution.settled),
    )


def _by_views(task: _Task, views: Views) -> HandEye:
    options, names = task.options, task.pairs.names
    first = task.guess(task.loop, options.with_scale)

    def solved(loop: Loop, noise: Noise) -> AdjustedViews:
        flange = task.pairs.base_from_flange
        intrinsics, camera = options.intrinsics, options.camera
        return adjust_views(loop, flange, views, first, noise, intrinsics, options.with_scale, camera, options.arm)

    solution, contradicted = _by_true_robot(task, solved)
    if solution.sigma_scale is not None:
        require_scale(solution.state.scale, solution.sigma_scale, task.loop, task.pairs.where)
    x, z = solution.state.mount_from_camera, solution.state.stand_from_board
    notes, covariance = task.notes + contradicted, solution.covariance
    if options.four_dof:
        x, z, covariance, notes = _without_slide(task, x, z, solution.normal)
    if solution.camera_error is not None:
        covariance = solution.camera_error.covariance(covariance)
    seen = replace(solution.loop, camera_from_board=resected(names, views, solution.found))
    residuals = seen.residuals(x, z)
    notes += _remarks(task, solution.outliers, residuals, solution.scale_hint)
    notes += of_camera_file(solution.camera_gain, solution.sigma)
    return HandEye(
        method="reprojection",
        setup=task.setup,
        mount_from_camera=x,
        stand_from_board=z,
        residuals=residuals,
        names=names,
        outliers=solution.outliers,
        covariance=covariance[:6, :6],
        stand_covariance=covariance[6:12, 6:12],
        scale=solution.state.scale,
        sigma_scale=solution.sigma_scale,
        sigma=solution.sigma,
        estimated=solution.estimated,
        reprojection=solution.found,
        observability=task.seen,
        notes=notes + remarks.of_rounds(solution.settled),
    )


def of_camera_file(camera_gain: float, sigma: dict[str, float]) -> tuple[str, ...]:
    """Notes on a camera file that the corners contradict, by what other intrinsics gain, and by its widened σ."""
    notes: tuple[str, ...] = ()
    if camera_gain > CAMERA_GAIN:
        notes += (
            "the camera file does not fit the corners: solve for the intrinsics too, or calibrate the camera anew",
        )
    doubted = {name: factor for name, factor in sigma.items() if name in FACTORS and factor > WIDENED}
    if doubted:
        which = ", ".join(f"{FACTORS[name]} {factor:.2g} times" for name, factor in doubted.items())
        notes += (f"the corners contradict the camera file: its σ were widened ({which}); calibrate the camera",)
    return notes


def _by_true_robot(task: _Task, solved: Callable[[Loop, Noise], S]) -> tuple[S, tuple[str, ...]]:
    """Solved with the robot's σ as stated, or, where its poses contradict these, as estimated; and a note.

    A robot that is held too tightly is not seen in its own residuals: the camera and the board are blamed instead.
    """
    noise, loop = task.options.noise, task.loop
    given, own = solved(loop, noise), loop.robot_covariance
    if own is not None:
        rad, mm = np.sqrt(np.diagonal(own, axis1=1, axis2=2).reshape(-1, 2, 3).mean((0, 2))).tolist()
    elif noise.robot_rad is not None and noise.robot_mm is not None:
        rad, mm = noise.robot_rad, noise.robot_mm
    else:
        return given, ()
    free = solved(replace(loop, robot_covariance=None), replace(noise, robot_rad=None, robot_mm=None))
    found = tuple(free.sigma.get(name, 0.0) for name in ROBOT)
    if not _contradicted((rad, mm), found, given.sigma, free.sigma, len(loop)):
        return given, ()
    return free, (
        f"the robot's poses err by {np.degrees(found[0]):.2g}° and {found[1]:.2g} mm an axis, where "
        f"{np.degrees(rad):.2g}° and {mm:.2g} mm are stated: its σ are estimated instead; check the robot's poses",
    )


def _contradicted(
    stated: tuple[float, ...], found: tuple[float, ...], given: dict[str, float], free: dict[str, float], poses: int
) -> bool:
    """Whether the robot errs by more than is stated: its own σ are larger, or all else fits worse if it is exact."""
    dof = max(3 * (poses - LEAST_WITH_SCALE), 3)
    limit = max(ROBOT_BEYOND, float(np.sqrt(chi2.ppf(1 - BY_CHANCE, dof) / dof)))
    if all(stated):
        return any(own > limit * value for own, value in zip(found, stated, strict=True))
    rest = [name for name in ("corner_px", "camera_factor") if given.get(name) and free.get(name)]
    worse = max((given[name] / free[name] for name in rest), default=1.0)
    return any(found) and worse > REST_WORSE


def _remarks(task: _Task, outliers: np.ndarray, residuals: np.ndarray, hint: tuple[float, float]) -> tuple[str, ...]:
    """On poses and board."""
    names = tuple(name for name, bad in zip(task.pairs.names, outliers, strict=True) if not bad)
    found = remarks.of_outliers(task.pairs.names, outliers, residuals)
    found += remarks.of_groups(names, residuals[~outliers])
    if not (task.options.with_scale or task.options.four_dof):
        found += remarks.of_size(task.loop[~outliers], hint, task.options.noise)
    return found + remarks.of_distance(task.loop)


def _without_slide(task: _Task, x: Rigid, z: Rigid, normal: np.ndarray):
    """X with nothing along the axis about which all poses turn; covariance given that; notes with what is unknown."""
    axis, frames = task.seen.mount_axis, FRAMES[task.setup]
    x, z = start.slid(x, z, axis, task.loop)
    held = normal.copy()
    held[3:6, 3:6] += np.outer(axis, axis) / HELD_MM**2
    note = (
        f"{frames.camera} is not known along {in_words(axis)} of the {frames.mount}, the one axis about which the "
        f"flange turns: it is set to 0 there, and {frames.board} goes with it; measure one of them along that axis"
    )
    return x, z, generalised_inverse(held), (*task.notes, note)
