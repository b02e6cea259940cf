"""Hand-eye calibration: the problem, its result, and one call for every method."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial

import numpy as np
from scipy.special import chdtri

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, ByValue, freeze, require_fields
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Rigid
from stcal.handeye import remarks
from stcal.handeye.conventions import check_conventions, repair
from stcal.handeye.data.corner_views import Views, resect
from stcal.handeye.data.pose_content import HandEyeInput
from stcal.handeye.data.pose_pairs import FRAMES, HandEyePoses, Loop, LoopState, Motions, Setup, poses_with_log, rms_of
from stcal.handeye.methods import closed_form
from stcal.handeye.methods.closed_form import AX_XB, AX_ZB, EvolutionOptions
from stcal.handeye.methods.pose_adjustment import UNKNOWNS, Noise, PoseSolution, adjust_poses, places
from stcal.handeye.methods.reprojection import (
    CAMERA_GAIN,
    ROBOT,
    AdjustedCorners,
    Bundle,
    Reprojection,
    adjust_views,
    of_poses,
)
from stcal.handeye.remarks import Aside, Observability, Remarks, Verdict, check, in_words, require_scale
from stcal.io.cameras.camera_model import CameraPrior


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HandEye(Brief):
    """A hand-eye calibration from m pose pairs.

    Parameters
    ----------
    method : name of the method, one of :data:`~stcal.handeye.METHODS`
    setup : ``eye-in-hand`` or ``eye-to-hand``
    mount_from_camera, stand_from_board : the two unknowns, mm; see :attr:`transforms`
    residuals : (m, 6), deviation of each pose's chain from ``stand_from_board``: rotation vector (rad), and translation
        (mm) at the board's origin, in the axes of the stand
    names : names of the poses
    outliers : (m,) bool, poses that were left out of the solution because they contradict the others
    covariance, stand_covariance : (6, 6), covariances of ``mount_from_camera`` and ``stand_from_board``: rotation
        (rad), translation (mm), left perturbation. None if the method gives no covariance.
    scale : the board's true size over its stated size, if it was solved for; else 1
    sigma_scale : σ of the scale
    sigma : σ by which poses or corners were weighted, if the method weights: ``robot_rad``, ``robot_mm``,
        ``camera_rad``, ``camera_mm``, ``corner_px``, ``board_mm``. ``camera_factor`` is the factor on the σ that were
        stated with camera_from_board. ``camera_focal``, ``camera_centre``, ``camera_radial``, ``camera_tangential``
        (``camera_all`` if their covariance is stated) are the factors, 1 or more, by which the σ of the stated
        intrinsics were widened.
    estimated : keys of ``sigma`` that were estimated from the residuals
    reprojection : adjusted camera, board and robot, if corners were adjusted
    observability : what the poses determine
    notes : notes on the result, one line each
    common_covariance : (6, 6), part of ``covariance`` that comes from what the errors of the board's poses have in
        common, where that is stated; more poses do not make it smaller
    judgement : whether to use the result; None of a single method's solution, which was not judged. See
        :attr:`verdict`.
    """

    method: str
    setup: Setup
    mount_from_camera: Rigid
    stand_from_board: Rigid
    residuals: np.ndarray
    names: tuple[str, ...]
    outliers: np.ndarray
    covariance: np.ndarray | None = None
    stand_covariance: np.ndarray | None = None
    scale: float = 1.0
    sigma_scale: float | None = None
    sigma: dict[str, float] = field(default_factory=dict)
    estimated: tuple[str, ...] = ()
    reprojection: Reprojection | None = None
    observability: Observability | None = None
    notes: tuple[str, ...] = ()
    common_covariance: np.ndarray | None = None
    judgement: Verdict | None = None

    def __post_init__(self):
        m = len(self.names)
        freeze(self, "residuals", (m, 6), "residuals")
        freeze(self, "outliers", (m,), "outliers", bool)
        for name in ("covariance", "stand_covariance", "common_covariance"):
            if getattr(self, name) is not None:
                freeze(self, name, (6, 6), name)

    @property
    def verdict(self) -> Verdict:
        """Whether to use the result: its ``word`` is ``good``, ``use with care`` or ``do not use``.

        ``sentence()`` adds the reasons, ``remedies()`` what to do. Raises InputError if nobody judged the result.
        """
        if self.judgement is None:
            said = f"hand-eye: the solution of {self.method} alone has no verdict"
            raise InputError("E-HANDEYE-NOT-JUDGED", f"{said}; handeye.handeye judges what it returns")
        return self.judgement

    @property
    def transforms(self) -> dict[str, Rigid]:
        """``flange_from_camera`` and ``base_from_board``, or ``base_from_camera`` and ``flange_from_board``."""
        frames = FRAMES[self.setup]
        return {frames.camera: self.mount_from_camera, frames.board: self.stand_from_board}

    @property
    def flange_from_camera(self) -> Rigid:
        """The transform flange_from_camera of the eye-in-hand setup; raises InputError in the other setup."""
        return self._named("flange_from_camera")

    @property
    def base_from_camera(self) -> Rigid:
        """The transform base_from_camera of the eye-to-hand setup; raises InputError in the other setup."""
        return self._named("base_from_camera")

    def _named(self, name: str) -> Rigid:
        if name not in self.transforms:
            said = f"hand-eye: {self.setup} has no {name}; it has {' and '.join(self.transforms)}"
            raise InputError("E-HANDEYE-NO-TRANSFORM", said)
        return self.transforms[name]

    def widened(self, factor: float) -> "HandEye":
        """Returns the result with all σ of the two unknowns multiplied by ``factor``."""
        if self.covariance is None or self.stand_covariance is None:
            return self
        square = factor**2
        return replace(self, covariance=square * self.covariance, stand_covariance=square * self.stand_covariance)

    def rms(self) -> tuple[float, float]:
        """Returns the RMS lengths of the residuals of all poses except outliers: rad, mm."""
        return rms_of(self.residuals[~self.outliers])


Adjusted = PoseSolution | AdjustedCorners
SCALED = ("pose", "reprojection")  # methods that weigh errors, and can find the board's size
METHODS = (*AX_XB, *AX_ZB, "zhao", "de", "de-polished", *SCALED)
"""Names of all methods."""
UNIT_MM = 1000.0
"""Length that weighs like one radian if no σ are stated, in mm: an error of 1 mm weighs like one of 1 mrad."""
FACTORS = {
    "camera_focal": "focal length",
    "camera_centre": "principal point",
    "camera_radial": "radial distortion",
    "camera_tangential": "tangential distortion",
    "camera_all": "all",
}
LEAST_WITH_SCALE = 4
"""Least number of poses if the scale is unknown: three leave a redundancy of five, too little to estimate σ."""
WIDENED = 2.0  # factor on the σ of a camera file, or of poses computed with it, beyond which a note questions the file
ROBOT_BEYOND, BY_CHANCE = 2.0, 5e-4
"""Smallest ratio of estimated to stated σ at which a robot's stated σ are doubted, and the probability with which
chance may exceed the ratio that is required."""
REST_WORSE = 1.2
"""Factor by which corners must fit worse with an exact robot before a robot that is stated as exact is doubted."""
AT_ONE_PLACE = Aside("the robot stood several times at one place: its errors there count once in σ")
OF_EVOLUTION = Aside("differential evolution: what it reaches depends on its bounds; the paper's own are not legible")
IN_COMMON = Aside("σ contain the errors that the board's poses have in common (columns common…)")
UNSETTLED = "the estimated σ, or the set of outliers, did not settle: state those σ that are known, or add poses"
HELD_MM = 1e-6
"""σ that holds X along the one axis of rotation of a four-axis robot, where the poses do not determine it, in mm."""


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeOptions(ByValue):
    """Options of a hand-eye calibration: known errors, and further unknowns.

    Parameters
    ----------
    noise : known σ of the errors; unknown σ are estimated
    intrinsics : prior of the camera's parameters; if given, they are solved for. ``reprojection`` only.
    with_scale : solve for the board's true size too; ``pose`` and ``reprojection`` only
    symmetries : all board_from_board except the identity that map the board onto itself. Views whose corners were
        numbered from another end are renumbered.
    four_dof : the flange turns about one axis only: solve for everything except X along this axis. ``pose`` and
        ``reprojection`` only.
    evolution : options of ``de`` and ``de-polished``
    camera : uncertainty of the camera's parameters if they are not solved for. With views, it is propagated into σ. The
        parameters are exact if None.
    """

    noise: Noise = field(default_factory=Noise)
    intrinsics: CameraPrior | None = None
    with_scale: bool = False
    symmetries: tuple[Rigid, ...] = ()
    four_dof: bool = False
    evolution: EvolutionOptions = field(default_factory=EvolutionOptions)
    camera: CameraPrior | None = None

    def __post_init__(self):
        require_fields(self, "hand-eye")

    @property
    def names_unknowns(self) -> bool:
        """True if the options name what is solved for, so that no way of solving is left to choose."""
        return bool(self.intrinsics or self.with_scale or self.four_dof)


@dataclass(frozen=True, eq=False)
class HandEyeProblem:
    """What is solved: ``pairs`` of poses in a ``setup``, the ``views`` from which they were computed, and ``options``;
    ``notes`` : on repairs; ``part`` : whether the poses are a part of others, of which conventions were judged."""

    pairs: HandEyePoses
    setup: Setup = "eye-in-hand"
    views: Views | None = None
    options: HandEyeOptions = field(default_factory=HandEyeOptions)
    notes: tuple[str, ...] = ()
    part: bool = False

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, rows: np.ndarray) -> "HandEyeProblem":
        return replace(self, pairs=self.pairs[rows], views=None if self.views is None else self.views[rows])

    def without(self, out: np.ndarray) -> "HandEyeProblem":
        return replace(self[np.setdiff1d(np.arange(len(self)), out)], part=True)

    @cached_property
    def loop(self) -> Loop:
        """The poses in the terms of the equation."""
        return Loop.of(self.pairs, self.setup)

    @cached_property
    def seen(self) -> Observability:
        """What the poses determine; raises DegenerateError if that is not enough."""
        return check(self.loop, self.pairs.where, self.options.four_dof)

    def mended(self) -> "HandEyeProblem":
        """Returns the problem with the numberings of a symmetric board corrected, and a note on that."""
        if not self.options.symmetries:
            return self
        pairs, views, turned = repair(self.pairs, self.setup, self.options.symmetries, self.views)
        options, notes = replace(self.options, symmetries=()), self.notes
        if named := ", ".join(name for name, turn in zip(pairs.names, turned, strict=True) if turn):
            said = f"numbered from another end of the board, and corrected: {named}"
            notes = (*notes, Aside(f"{said}; base_from_board may belong to either end"))
        return replace(self, pairs=pairs, views=views, options=options, notes=notes)

    def solved(self, method: str | None = None) -> "Solved":
        """Returns the result of one method, ``reprojection`` with views, else ``pose``, if None, with the state from
        which solutions without some poses start. Its σ are estimated from its own residuals. Raises StcalError: as
        :func:`stcal.handeye.handeye`."""
        method = method or ("pose" if self.views is None else "reprojection")
        options, pairs = self.options, self.pairs
        if method not in METHODS:
            choices = ", ".join(METHODS)
            raise InputError("E-OPTION-METHOD", f"hand-eye: method {method!r} is unknown; one of {choices} needed")
        if method == "reprojection" and (self.views is None or len(self.views) != len(pairs)):
            said = "hand-eye: reprojection needs the corners of every pose; give views, or use method pose"
            raise InputError("E-HANDEYE-NEEDS-VIEWS", said)
        seen = self.seen  # what the poses must determine
        if options.with_scale and len(pairs) < LEAST_WITH_SCALE:
            said = f"{len(pairs)} poses, {LEAST_WITH_SCALE} needed to find the board's size too; take more"
            raise DegenerateError("E-HANDEYE-FEW-POSES", f"{pairs.where}: {said}")
        problem = self.mended()
        problem.pairs.require_moving_flange()
        about_axis = partial(closed_form.about_one_axis, seen.mount_axis)
        guess = cache(about_axis if options.four_dof else closed_form.robust)
        if not self.part:
            by_images = problem.views is not None
            doubts = check_conventions(problem.pairs, problem.loop, guess, options.with_scale, by_images)
            problem = replace(problem, notes=(*problem.notes, *doubts))
        if method not in SCALED:
            x, z, notes = problem._by_equations(method)
            of_loop = problem.loop.residuals(x, z), problem.pairs.names, np.zeros(len(problem), bool)
            return Solved(problem, HandEye(method, self.setup, x, z, *of_loop, observability=seen, notes=notes))
        return problem._adjusted(method, guess(problem.loop, options.with_scale))

    def _by_equations(self, method: str) -> tuple[Rigid, Rigid, Remarks]:
        """Returns X and Z, by AX = XB or AX = ZB and the named method, and notes."""
        options, pairs, loop, notes = self.options, self.pairs, self.loop, self.notes
        if options.four_dof:
            said = f"hand-eye: {method} needs turns about two axes; of four axes use pose"
            raise DegenerateError("E-HANDEYE-AXES", said)
        noise, evolution = options.noise, options.evolution
        unit_mm = noise.camera_mm / noise.camera_rad if noise.camera_mm and noise.camera_rad else UNIT_MM
        by_logs = method in (*AX_XB, "de", "de-polished")
        if by_logs and not (used := poses_with_log(loop)).all():
            left_out = ", ".join(name for name, u in zip(pairs.names, used, strict=True) if not u)
            notes = (*notes, Aside(f"left out, for they turn by more than 170° against others: {left_out}"))
            loop = loop[used]
            if len(loop) < 3 or Observability.of(loop).useless:
                said = f"hand-eye: without {left_out}, which turn by more than 170° relative to others, too few poses "
                said += f"are left for {method}; use method pose or shah"
                raise DegenerateError("E-HANDEYE-LARGE-TURNS", said)
        if method in (*AX_XB, *AX_ZB):
            x, z = closed_form.solve_closed_form(loop, method, unit_mm)
        else:
            motions = Motions.consecutive(loop)
            if method == "zhao":
                x = closed_form.convex(motions, unit_mm)
            else:
                objective = closed_form.Objective(motions, unit_mm, evolution.weight)
                about = any(b is not None and b.centre is None for b in (evolution.bounds_rad, evolution.bounds_mm))
                known_x = closed_form.solve_closed_form(loop, "park-martin", unit_mm)[0] if about else None
                farthest = np.vstack([loop.camera_from_board.translation, loop.stand_from_mount.translation])
                x = closed_form.evolve(objective, evolution, float(np.linalg.norm(farthest, axis=1).max()), known_x)
                x = closed_form.polish(objective, x) if method == "de-polished" else x
            if method == "de":
                notes = (*notes, OF_EVOLUTION)
            z = closed_form.mean_pose(loop.chain(x))
        return x, z, notes

    def _adjusted(self, method: str, first: LoopState) -> "Solved":
        """Solves by least squares of the poses' errors, or of the corners of the views, from ``first`` X, Z, scale."""
        options, views = self.options, self.views if method == "reprojection" else None

        def solved(loop: Loop, noise: Noise) -> Adjusted:
            if views is None:
                return adjust_poses(loop, first, noise, options.with_scale)
            return adjust_views(loop, views, first, noise, options.intrinsics, options.with_scale)

        solution, noise, of_robot = self._by_true_robot(solved)
        state, outliers, count, notes = solution.state, solution.outliers, len(solution.normal), self.notes + of_robot
        x, z, covariance = state.mount_from_camera, state.stand_from_board, solution.inverse[:count, :count]
        sigma_scale = float(np.sqrt(solution.inverse[UNKNOWNS, UNKNOWNS])) if options.with_scale else None
        board = common = by_poses = None
        if options.four_dof:
            x, z, covariance, slide = self._without_slide(x, z, solution.normal)
            notes = (*notes, slide)
        if isinstance(solution, PoseSolution):
            by_poses, residuals = solution, solution.residuals
        else:
            if options.intrinsics is None and options.camera is not None:
                covariance = solution.considering(options.camera, covariance)
            board = solution.found
            seen, _ = resect(board.adjusted(solution.views), self.pairs.names)
            loop = replace(solution.loop, camera_from_board=seen)
            residuals, good = loop.residuals(x, z), loop[~outliers]
            if not options.four_dof and places(good) is not None:
                by_poses = adjust_poses(good, LoopState(x, z, state.scale), Noise(), options.with_scale, False)
        if by_poses is not None and not options.four_dof and (clusters := by_poses.by_places()):
            # What the places add to the covariance of the board's poses, they add to that of the corners.
            added = clusters.covariance - clusters.independent
            covariance, notes = covariance + added[:count, :count], (*notes, AT_ONE_PLACE)
            if sigma_scale is not None:
                sigma_scale = float(np.sqrt(sigma_scale**2 + added[UNKNOWNS, UNKNOWNS]))
        if sigma_scale is not None:
            require_scale(state.scale, sigma_scale, self.loop, self.pairs.where)
        notes += self._remarks(x, outliers, residuals, solution.scale_hint)
        if isinstance(solution, PoseSolution):
            estimated = tuple(solution.sigma)
            stated = {name: getattr(noise, name) for name in (*ROBOT, "camera_rad", "camera_mm")}
            sigma = {name: value for name, value in stated.items() if value} | solution.sigma
            covariance, common, doubts = self._of_poses(solution, noise, covariance)
        else:
            sigma, estimated, doubts = solution.sigma, solution.corners.free, self._of_camera(solution)
        notes += doubts if solution.settled else (*doubts, UNSETTLED)
        told = residuals, self.pairs.names, outliers, covariance[:6, :6], covariance[6:12, 6:12]
        more = state.scale, sigma_scale, sigma, estimated, board, self.seen, notes, common
        return Solved(self, HandEye(method, self.setup, x, z, *told, *more), solution)

    def _of_poses(
        self, solution: PoseSolution, noise: Noise, inverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None, Remarks]:
        """Returns the covariance with what residuals, common errors, and the camera add to the ``inverse`` normal
        matrix, (k, k); the part of X from common errors; and notes."""
        loop, covariance, common, notes = self.loop, inverse, None, ()
        if (factor := solution.sigma.get("camera_factor", 1.0)) > WIDENED:
            notes += (f"the board's poses err {factor:.2g} times what their σ say: check the intrinsics",)
        if not solution.sigma or noise.robot_rad is not None or noise.camera_rad is not None:
            factor, redundancy = solution.variance_factor, solution.redundancy
            low, high = chdtri(redundancy, [0.9995, 0.0005]) / redundancy
            if not low <= factor <= high:
                times = f"the residuals are {np.sqrt(factor):.2g} times what the stated σ make expect"
                notes += (f"{times}; correct σ, or look for errors",)
                covariance = covariance * max(factor, 1)
        if loop.camera_common is not None:
            moved = inverse @ solution.slope(loop.camera_common)
            added = moved @ moved.T
            common, notes, covariance = added[:6, :6], (*notes, IN_COMMON), covariance + added
        if self.views is not None and self.options.camera is not None:
            covariance = covariance + of_poses(solution, self.views, self.options.camera, inverse)
        return covariance, common, notes

    def _of_camera(self, solution: AdjustedCorners) -> Remarks:
        """Returns notes on a camera file that the corners contradict."""
        notes: Remarks = ()
        if self.options.intrinsics is None and solution.camera_gain() > CAMERA_GAIN:
            notes += ("the camera file does not fit the corners: solve for the intrinsics too, or calibrate it again",)
        doubted = {name: factor for name, factor in solution.sigma.items() if name in FACTORS and factor > WIDENED}
        if doubted:
            which = ", ".join(f"{FACTORS[name]} {factor:.1f} times" for name, factor in doubted.items())
            notes += (f"the corners contradict the camera file: its σ were widened ({which}); calibrate the camera",)
        return notes

    def _by_true_robot(self, solved: Callable[[Loop, Noise], Adjusted]) -> tuple[Adjusted, Noise, Remarks]:
        """Returns the solution by the robot's stated σ, or if poses contradict these, by estimated ones."""
        noise, loop = self.options.noise, self.loop
        solution, stated = solved(loop, noise), loop.robot_covariance
        if stated is not None:
            rad, mm = np.sqrt(np.diagonal(stated, axis1=1, axis2=2).reshape(-1, 2, 3).mean((0, 2))).tolist()
        elif noise.robot_rad is not None and noise.robot_mm is not None:
            rad, mm = noise.robot_rad, noise.robot_mm
        else:
            return solution, noise, ()
        unknown = replace(noise, robot_rad=None, robot_mm=None)
        free = solved(replace(loop, robot_covariance=None), unknown)
        estimated = tuple(free.sigma.get(name, 0.0) for name in ROBOT)
        if rad and mm:
            dof = max(3 * (len(loop) - LEAST_WITH_SCALE), 3)
            limit = max(ROBOT_BEYOND, float(np.sqrt(chdtri(dof, BY_CHANCE) / dof)))
            contradicted = estimated[0] > limit * rad or estimated[1] > limit * mm
        else:  # an exact robot, with which corners or the board's poses fit worse
            shared = [
                name for name in ("corner_px", "camera_factor") if solution.sigma.get(name) and free.sigma.get(name)
            ]
            worse = max((solution.sigma[name] / free.sigma[name] for name in shared), default=1.0)
            contradicted = any(estimated) and worse > REST_WORSE
        if contradicted and isinstance(solution, PoseSolution) and isinstance(free, PoseSolution):
            # σ of a robot far better than the camera hardly show: what is estimated then is no evidence by itself.
            used = ~free.outliers
            contradicted = solution.misfit(used) - free.misfit(used) >= chdtri(len(ROBOT), BY_CHANCE)
        if not contradicted:
            return solution, noise, ()
        own, said = (f"{np.degrees(turn):.2g}° and {shift:.2g} mm" for turn, shift in (estimated, (rad, mm)))
        note = f"the robot's poses err by {own} an axis, where {said} are stated: its σ are estimated instead"
        return free, unknown, (f"{note}; check the robot's poses",)

    def _remarks(self, x: Rigid, outliers: np.ndarray, residuals: np.ndarray, hint: tuple[float, float]) -> Remarks:
        """Returns notes on outliers, moves between two poses, groups of poses, the board's size, and distances."""
        if self.part:
            return ()
        pairs, options, loop, good = self.pairs, self.options, self.loop, ~outliers
        notes = remarks.of_outliers(pairs.names, outliers, residuals)
        moved = remarks.of_order(pairs.names, residuals, loop.jacobian(x), places(loop) is None)
        notes += moved or remarks.of_groups(pairs[good].names, residuals[good])
        if not (options.with_scale or options.four_dof):
            notes += remarks.of_size(loop[good], hint, options.noise)
        return notes + remarks.of_distance(loop)

    def _without_slide(self, x: Rigid, z: Rigid, normal: np.ndarray) -> tuple[Rigid, Rigid, np.ndarray, str]:
        """Returns X with no translation along the one axis of rotation, Z, the covariance given that, and a note."""
        axis, frames = self.seen.mount_axis, FRAMES[self.setup]
        x, z = closed_form.slid(x, z, axis, self.loop)
        held = normal.copy()
        held[3:6, 3:6] += np.outer(axis, axis) / HELD_MM**2
        note = f"{frames.camera} is not known along {in_words(axis)} of the {frames.mount}, the one axis about which "
        note += f"the flange turns: it is set to 0 there, and {frames.board} goes with it; measure one of them along "
        note += "that axis"
        return x, z, generalised_inverse(held), note


def problem_of(given: HandEyeInput, options: HandEyeOptions) -> HandEyeProblem:
    return HandEyeProblem(given.pairs, given.setup or "eye-in-hand", given.views, options)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """``result`` of a ``problem``, and the ``solution`` behind it where the method adjusts poses or corners."""

    problem: HandEyeProblem
    result: HandEye
    solution: Adjusted | None = None

    def without(self, out: np.ndarray) -> HandEye:
        """Returns X, Z, scale, camera and board without the poses ``out``, (k,) rows; σ, outliers and all else as of
        all poses. Adjustments take one step; other methods are solved again. Raises StcalError: they fail."""
        problem, solution, board = self.problem, self.solution, None
        if solution is None:
            x, z, _ = problem.without(out)._by_equations(self.result.method)
            return replace(self.result, mount_from_camera=x, stand_from_board=z)
        state = solution.without(out)
        if isinstance(solution, AdjustedCorners) and isinstance(state, Bundle):
            board = replace(solution.found, camera=state.camera, corners=state.scale * state.corners)
        x, z = state.mount_from_camera, state.stand_from_board
        if problem.options.four_dof:
            x, z = closed_form.slid(x, z, problem.seen.mount_axis, problem.loop)
        return replace(self.result, mount_from_camera=x, stand_from_board=z, scale=state.scale, reprojection=board)
