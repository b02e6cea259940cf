"""Reprojection adjustment: X and Z from the corners in the images, with the errors of robot, board and camera."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.special import fdtri

from stcal.adjust.blocks import Block, Huber, Vector
from stcal.adjust.engine import Adjustment, Solution
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid, by_pose
from stcal.geometry.robust import length_limit
from stcal.handeye.data.corner_views import Views, whitened
from stcal.handeye.data.pose_pairs import Loop, LoopState
from stcal.handeye.methods.pose_adjustment import (
    CAUTION,
    FALSE_ALARM,
    FARTHEST,
    LEAST_POSES,
    UNKNOWNS,
    Noise,
    PoseSolution,
    squared_within,
)
from stcal.io.cameras.camera_model import CameraPrior

CORNER, POSE = length_limit(2, 0.001), length_limit(6, 0.001)
"""Huber's limits: one good corner, and one good pose, in a thousand has a weight below one."""
ROBOT = ("robot_rad", "robot_mm")  # kinds of the robot's errors: of its rotations and of its translations
GROSS_RAD, GROSS_SHARE = np.radians(10), 0.2
"""Residuals (rotation; translation as share of the distance) above which a pose is wrong from the start. No error of
the camera file, which is solved for here, makes so much."""
UNKNOWN_LENS = intrinsic_basis("OPENCV"), 1e-12 * np.eye(intrinsic_basis("OPENCV").shape[1])
"""Basis of the intrinsics in which errors of the camera file are looked for, and their negligible information, px⁻²."""
CAMERA_GAIN = 5.0
"""Gain in cost per intrinsic above which intrinsics are wrong. Eight right ones gain 8 ± 4 together, 1 ± 0.5 each."""
SAME_DIGITS = 6  # decimals of a millimetre to which two places on the board agree that are one corner
FIRST = {"corner_px": 0.3, "robot_rad": 1e-3, "robot_mm": 0.5, "board_mm": 0.1}
"""First guesses of the σ that are estimated."""
LEAST_SIGMA = {kind: {"px": 1e-6, "rad": 1e-8, "mm": 1e-5}[kind.rpartition("_")[2]] for kind in FIRST}
"""Lower limits of estimated σ: exact data would give 0. The lower limit of the factors of stated camera σ is 1."""
ROUNDS, SETTLED = 50, 1e-3
"""Rounds in which factors of σ are estimated, and their relative change below which the iteration has converged."""
ADJUST_ROUNDS, ROUGHLY = 20, 1e-6
"""Rounds of σ, and relative fall of the cost below which the minimisation within a round ends."""
INFLUENCE_STEPS, LEAST_DAMPING = 2, 1e-9
"""Steps from the solution of all poses to one without some; damping of directions that nothing determines."""
SEEN = 1e-3  # share of the robot's variance below which the corners tell nothing about the robot's error
WORST = "check the poses that fit worst"


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Results of a reprojection adjustment besides X and Z.

    ``camera`` : adjusted camera, or the given one where the intrinsics were not solved for; ``camera_covariance`` : (q,
    q) covariance of the intrinsics solved for, in the order of their COLMAP model; ``base_from_flange`` : m true poses
    of the flange; as reported for outliers, and where the robot is exact; ``designed``, ``corners`` : (K, 3) the
    board's corners as designed, and as adjusted in the true scale, mm; ``view``, ``corner`` : (n,) pose and row in
    ``corners`` of each measured corner. Outliers have no corners; ``residuals_px`` : (n, 2) projected minus measured.
    """

    camera: Camera
    camera_covariance: np.ndarray | None
    base_from_flange: Poses
    designed: np.ndarray
    corners: np.ndarray
    view: np.ndarray
    corner: np.ndarray
    residuals_px: np.ndarray

    def __post_init__(self):
        freeze(self, "designed", (None, 3), "corners")
        freeze(self, "corners", self.designed.shape, "corners")
        freeze(self, "view", (None,), "views", int)
        freeze(self, "corner", self.view.shape, "numbers of corners", int)
        freeze(self, "residuals_px", (len(self.view), 2), "residuals")

    def rms_px(self, pose: int) -> float:
        """Returns the RMS length of the residuals in one view; NaN where it has none."""
        residuals = self.residuals_px[self.view == pose]
        return float(np.sqrt((residuals**2).sum(1).mean())) if len(residuals) else float("nan")

    def board(self, xyz_board: np.ndarray) -> np.ndarray:
        """Returns the true places (k, 3) of designed corners (k, 3), mm; those not seen keep their place, scaled."""
        distance, nearest = KDTree(self.designed).query(xyz_board)
        scale = np.linalg.norm(self.corners) / np.linalg.norm(self.designed)
        return np.where((distance < 10.0**-SAME_DIGITS)[:, None], self.corners[nearest], scale * np.asarray(xyz_board))

    def adjusted(self, views: Views) -> Views:
        """Returns the views by the adjusted camera, with corners at their places on the adjusted board."""
        return Views(self.camera, tuple(view.moved(self.board(view.xyz_board)) for view in views.views))


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The unknowns: X, Z, true base_from_flange (m), corners (K, 3), camera, and scale."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: Camera
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """The measurements and their precision: n corners in m views of a board with K corners.

    ``loop`` : the m poses, as reported; ``xyz_board`` : (K, 3) as designed; ``view``, ``corner`` : (n,) view and corner
    of each measurement; ``xy_px`` : (n, 2); ``weight`` : (n, 2, 2) whitening at σ 1; ``sigma`` : σ of each kind, 0
    where exact; ``free`` : kinds whose σ are to be estimated; ``basis`` : (16, q) of the intrinsics solved for;
    ``information`` : (q, q) of them about ``camera``, to be divided by the squares of the factors; ``with_scale``.
    """

    loop: Loop
    xyz_board: np.ndarray
    view: np.ndarray
    corner: np.ndarray
    xy_px: np.ndarray
    weight: np.ndarray
    sigma: dict[str, float]
    free: tuple[str, ...]
    camera: Camera
    basis: np.ndarray
    information: np.ndarray
    with_scale: bool

    @classmethod
    def of(
        cls, loop: Loop, views: Views, noise: Noise, intrinsics: CameraPrior | None = None, with_scale: bool = False
    ) -> "Corners":
        """Returns the problem of poses and views, with σ that are not stated from :data:`FIRST`."""
        seen = np.round(np.concatenate([view.xyz_board for view in views.views]), SAME_DIGITS)
        designed, corner = np.unique(seen, axis=0, return_inverse=True)
        stated = {name: getattr(noise, name) for name in FIRST}
        sigma = {name: FIRST[name] if value is None else value for name, value in stated.items()}
        known = ROBOT if loop.robot_covariance is not None else ()
        free = tuple(name for name, value in stated.items() if value is None and name not in known)
        if sigma["robot_rad"] or sigma["robot_mm"]:  # exact in one of them only: tiny σ there
            sigma |= {name: max(sigma[name], LEAST_SIGMA[name]) for name in ROBOT}
        view = np.repeat(np.arange(len(views)), [len(each) for each in views.views])
        xy_px = np.concatenate([each.xy_px for each in views.views])
        measured = view, corner.ravel(), xy_px, np.concatenate([each.whitening() for each in views.views])
        none = np.zeros((len(PARAMETER_NAMES), 0)), np.zeros((0, 0))
        corners = cls(loop, designed, *measured, sigma, free, views.camera, *none, with_scale)
        return corners if intrinsics is None else corners.with_lens(*lens_of(intrinsics))

    def with_lens(self, basis: np.ndarray, information: np.ndarray) -> "Corners":
        """Returns the problem with intrinsics among the unknowns, and factors of their σ, from 1."""
        factors = dict.fromkeys((name for name, _ in camera_parts(basis, information)), 1.0)
        own = {"sigma": self.sigma | factors, "free": (*self.free, *factors)}
        return replace(self, basis=basis, information=information, **own)

    @property
    def robot(self) -> np.ndarray | None:
        """Whitening (m, 6, 6) of the robot's errors by their covariances, in place of σ; None where not stated."""
        stated = self.loop.robot_covariance
        return None if stated is None else np.linalg.inv(np.linalg.cholesky(stated))

    def problem(self) -> Adjustment:
        """Returns the adjustment: X, Z, the scale, and what else has a σ."""
        a, one, true = Adjustment(sigma=dict(self.sigma)), Poses.of([Rigid()]), Poses.of([Rigid()] * len(self.loop))
        on: list[tuple[Block, np.ndarray | None]] = [(a.block("x", one), None), (a.block("z", one), None)]
        on.append((a.block("scale", Vector(np.ones((1, 1))), fixed=[] if self.with_scale else [0]), None))
        if self.basis.shape[1]:
            on.append((a.block("camera", Vector(np.zeros((1, self.basis.shape[1])))), None))
            for name, rows in camera_parts(self.basis, self.information):
                root = np.linalg.cholesky(self.information[np.ix_(rows, rows)]).T
                off = partial(lambda root, rows, own: own.array[:, rows] @ root.T, root, rows)
                a.factor(off, on[-1:], kind=name)
        if (root := self.robot) is not None or self.sigma["robot_mm"]:
            on.append((a.block("robot", true), self.view))
            by_itself, each = np.tile(np.eye(6), (len(true), 1, 1)), [(on[-1][0], np.arange(len(true)))]
            root, kind = (by_itself, [name for name in ROBOT for _ in "xyz"]) if root is None else (root, "")
            a.factor(lambda own: own.difference(true), each, 1.0, lambda own: [by_itself], root, kind, loss=Huber(POSE))
        if self.sigma["board_mm"]:
            board = a.block("board", Vector(self.xyz_board), eliminate=True)
            on.append((board, self.corner))
            every, apart = np.arange(len(self.xyz_board)), np.tile(np.eye(3), (len(self.xyz_board), 1, 1))
            a.factor(
                lambda own: own.array - self.xyz_board, [(board, every)], 1.0, lambda own: [apart], kind="board_mm"
            )
        names = [block.name for block, _ in on]

        def residuals(*own: Any) -> np.ndarray:
            return self.residuals(self.bundle(dict(zip(names, own, strict=True))))

        def slopes(*own: Any) -> list[np.ndarray]:
            by = self.slopes(self.bundle(dict(zip(names, own, strict=True))))
            return [by[name] for name in names]

        a.factor(residuals, on, derivatives=slopes, root=self.weight, kind="corner_px", loss=Huber(CORNER))
        return a

    def start(self, first: LoopState) -> dict[str, Any]:
        x, z, scale = first
        given = {"x": Poses.of([x]), "z": Poses.of([z]), "scale": Vector(np.full((1, 1), scale))}
        return {block.name: block.start for block in self.problem().blocks} | given

    def bundle(self, values: Mapping[str, Any]) -> Bundle:
        """Returns the unknowns, those that are not solved for included."""
        flange, camera = self.loop.base_from_flange, self.camera
        if "robot" in values:
            off = values["robot"]
            flange = Poses(off.rotation @ flange.rotation, off.translation + flange.translation)
        if "camera" in values:
            camera = camera.with_parameters(camera.parameters() + self.basis @ values["camera"].array[0])
        corners = values["board"].array if "board" in values else self.xyz_board
        x, z = values["x"][0], values["z"][0]
        return Bundle(x, z, flange, corners, camera, float(values["scale"].array[0, 0]))

    def _placed(self, state: Bundle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns of each measured corner its place (n, 3) in the frames of the stand, the mount and the camera."""
        x, z, hand = state.mount_from_camera, state.stand_from_board, state.base_from_flange
        hand = hand if self.loop.inverted else hand.inverse()
        stand = state.scale * state.corners[self.corner] @ z.rotation.T + z.translation
        mount = np.einsum("nab,nb->na", hand.rotation[self.view], stand) + hand.translation[self.view]
        return stand, mount, (mount - x.translation) @ x.rotation

    def residuals(self, state: Bundle) -> np.ndarray:
        """Returns projected minus measured corners (n, 2), px; NaN behind the camera."""
        return state.camera.project(self._placed(state)[2]) - self.xy_px

    def slopes(self, state: Bundle) -> dict[str, np.ndarray]:
        """Returns the derivatives (n, 2, ·) of :meth:`residuals` by each kind of unknown."""
        x, z, hand = state.mount_from_camera, state.stand_from_board, state.base_from_flange
        stand, mount, xyz_camera = self._placed(state)
        turn, place = hand.rotation[self.view], hand.translation[self.view]
        if self.loop.inverted:  # the flange is the stand, the base is the mount
            mount_from_stand = turn
            by_hand = by_pose(np.broadcast_to(np.eye(3), turn.shape), mount - place)
        else:
            mount_from_stand = np.swapaxes(turn, 1, 2)
            by_hand = -by_pose(mount_from_stand, stand - place)
        by_mount = state.camera.projection_jacobian(xyz_camera) @ x.rotation.T
        by_stand = by_mount @ mount_from_stand
        of_board = stand - z.translation
        return {
            "x": -by_pose(by_mount, mount - x.translation),
            "z": by_pose(by_stand, of_board),
            "camera": state.camera.parameter_jacobian(xyz_camera[:, :2] / xyz_camera[:, 2:]) @ self.basis,
            "scale": np.einsum("nab,nb->na", by_stand, of_board / state.scale)[:, :, None],
            "board": state.scale * by_stand @ z.rotation,
            "robot": by_mount @ by_hand,
        }

    def only(self, keep: np.ndarray) -> "Corners":
        """Returns the problem of the poses ``keep``, a mask (m,)."""
        rows = np.flatnonzero(keep[self.view])
        same = {name: getattr(self, name)[rows] for name in ("corner", "xy_px", "weight")}
        return replace(self, loop=self.loop[keep], view=(np.cumsum(keep) - 1)[self.view[rows]], **same)


def camera_parts(basis: np.ndarray, information: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Returns names and rows of the intrinsics with a factor on their prior σ: by kind, or all if they are correlated.
    ``basis`` : (16, q) of the intrinsics; ``information`` : (q, q)."""
    first = basis.argmax(0)
    if np.count_nonzero(information - np.diag(np.diag(information))):
        return [("camera_all", np.arange(len(first)))]
    kinds = {"focal": (0, 1), "centre": (2, 3), "radial": (4, 5, 8, 9, 10, 11), "tangential": (6, 7)}
    parts = [(f"camera_{kind}", np.flatnonzero(np.isin(first, numbers))) for kind, numbers in kinds.items()]
    return [(name, rows) for name, rows in parts if len(rows)]


def lens_of(prior: CameraPrior) -> tuple[np.ndarray, np.ndarray]:
    """Returns the basis (16, q) of a camera's intrinsics, and their information (q, q)."""
    return intrinsic_basis(prior.colmap_model), np.linalg.inv(prior.covariance)


def adjust(corners: Corners, values: dict[str, Any]) -> tuple[Corners, Solution, bool]:
    """Solves, and estimates the free σ, in rounds: returns the problem with these σ, its solution, and whether σ
    settled; raises ConvergenceError: no minimum is reached."""
    if not np.isfinite(corners.problem().cost(values)):
        raise ConvergenceError("E-NO-MINIMUM", f"hand-eye: corners lie behind the camera at the start; {WORST}")
    settled = not corners.free
    for _ in range(0 if settled else ADJUST_ROUNDS):
        solution = corners.problem().minimum(values, settled=ROUGHLY).required("hand-eye", WORST).linear
        values, before = solution.values, corners.sigma
        corners = replace(corners, sigma=before | estimated(corners, solution))
        settled = bool(max(abs(np.log(corners.sigma[name] / before[name])) for name in corners.free) < SETTLED)
        if settled:
            break
    return corners, corners.problem().minimum(values).required("hand-eye", WORST).linear, settled


def estimated(corners: Corners, solution: Solution) -> dict[str, float]:
    """Returns restricted maximum-likelihood σ of the free kinds, all else linear."""
    present = [name for name in corners.free if any(name in factor.kinds for factor in solution.problem.factors)]
    least = np.log([LEAST_SIGMA.get(name, 1.0) / corners.sigma[name] for name in present])
    caution = np.array([CAUTION if name in LEAST_SIGMA else 0.0 for name in present])
    farthest = np.full(len(present), FARTHEST)
    likelihood = solution.components(present, caution)
    best = likelihood.best(np.maximum(least, -farthest), farthest, [np.zeros(len(present))])
    return {name: float(corners.sigma[name] * np.exp(x)) for name, x in zip(present, best, strict=True)}


def of_poses(solution: PoseSolution, views: Views, prior: CameraPrior, inverse: np.ndarray) -> np.ndarray:
    """Returns the covariance (k, k) that intrinsics as filed, by which the board's poses were computed from ``views``,
    add to the ``inverse`` normal matrix (k, k) of X, Z (and the scale)."""
    basis, known = lens_of(prior)
    q = basis.shape[1]
    information, gradient, cost, slopes = np.zeros((q, q)), np.zeros(q), 0.0, []
    for view, pose in zip(views.views, solution.loop.camera_from_board, strict=True):
        white, by_board = whitened(view, views.camera, pose)
        point = pose @ view.xyz_board
        by_own = view.whitening() @ views.camera.parameter_jacobian(point[:, :2] / point[:, 2:]) @ basis
        by_own = by_own.reshape(-1, q)
        slopes.append(-np.linalg.lstsq(by_board, by_own)[0])
        reduced = by_own + by_board @ slopes[-1]
        information += reduced.T @ reduced
        gradient += reduced.T @ white
        cost += float(white @ white)
    gain = float(gradient @ generalised_inverse(information) @ gradient)
    redundancy = 2 * views.corners() - 6 * len(views) - q
    variance = (cost - gain) / redundancy if redundancy > 0 else 1.0
    moved = inverse @ solution.slope(np.array(slopes))
    return moved @ moment(information / variance, gradient / variance, basis, known) @ moved.T


def moment(information: np.ndarray, gradient: np.ndarray, basis: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Returns the second moment (q, q) of the intrinsics' error: squared estimate plus covariance. Where corners
    contradict what is ``known`` (q, q), its σ are widened by kind, by EM (Dempster, Laird & Rubin 1977)."""
    parts = [rows for _, rows in camera_parts(basis, known)]
    squared = np.ones(len(parts))
    for _ in range(ROUNDS):
        scaled = known.copy()
        for rows, value in zip(parts, squared, strict=True):
            scaled[np.ix_(rows, rows)] /= value
        covariance = np.linalg.inv(information + scaled)
        error = -covariance @ gradient
        second = covariance + np.outer(error, error)
        new = [max(float(np.trace(known[np.ix_(r, r)] @ second[np.ix_(r, r)])) / len(r), 1.0) for r in parts]
        settled = np.abs(np.log(new / squared)).max() < SETTLED
        squared = np.array(new)
        if settled:
            break
    return second


@dataclass(frozen=True, eq=False)
class AdjustedCorners:
    """An adjustment of corners.

    ``loop``, ``views`` : all; ``outliers`` : (m,); ``corners`` : problem of the others, ``solution`` : its solution;
    ``inverse`` : covariance of its kept unknowns; ``settled`` : whether σ settled.
    """

    loop: Loop
    views: Views
    outliers: np.ndarray
    corners: Corners
    solution: Solution
    inverse: np.ndarray
    settled: bool

    @cached_property
    def state(self) -> Bundle:
        return self.corners.bundle(self.solution.values)

    @property
    def sigma(self) -> dict[str, float]:
        """The σ by kind that are not 0."""
        return {name: float(value) for name, value in self.corners.sigma.items() if value}

    @cached_property
    def found(self) -> Reprojection:
        state, corners, at = self.state, self.corners, self.solution.places.get("camera")
        true, rows = list(self.loop.base_from_flange), np.flatnonzero(~self.outliers)
        for row, pose in zip(rows, state.base_from_flange, strict=True):
            true[row] = pose
        covariance, seen = None if at is None else self.inverse[at, at], (rows[corners.view], corners.corner)
        board = corners.xyz_board, state.scale * state.corners
        return Reprojection(state.camera, covariance, Poses.of(true), *board, *seen, corners.residuals(state))

    @property
    def scale_hint(self) -> tuple[float, float]:
        """The scale, one step from the solution, if it were solved for, and its σ."""
        wider = replace(self.corners, with_scale=True).problem().at(self.solution.values)
        inverse, at = generalised_inverse(wider.normal), wider.places["scale"].start
        return self.state.scale + float(inverse[at] @ wider.right), float(np.sqrt(inverse[at, at]))

    def camera_gain(self) -> float:
        """Returns the fall of the cost per intrinsic if these were solved for by one step: 1 if the camera is right."""
        _, wider = self._with_lens(*UNKNOWN_LENS)
        gain = float(wider.right @ generalised_inverse(wider.normal) @ wider.right) + wider.reduction.gain
        return gain / UNKNOWN_LENS[0].shape[1]

    def considering(self, prior: CameraPrior, inverse: np.ndarray) -> np.ndarray:
        """Returns the covariance (12, 12) of X and Z with the errors of the intrinsics as filed, which are *considered*
        (Schmidt 1966; Bierman 1977, ch. VIII): their ``prior`` covariance is carried through. Estimated σ, too large by
        the camera's error, are estimated again with them, linear about the state. ``inverse`` : without them."""
        free, (wider, linear) = self.corners.free, self._with_lens(*lens_of(prior))
        sigma = wider.sigma | estimated(wider, linear)
        again = replace(wider, sigma=sigma).problem().at(linear.values)
        covariance = generalised_inverse(again.normal)
        camera = np.arange(len(covariance))[linear.places["camera"]]
        error = covariance[camera] @ again.right
        # What each kind of observation tells, in units of the σ that weighted the solution.
        kinds = {kind for factor in linear.problem.factors for kind in factor.kinds if not kind.startswith("camera_")}
        told = {kind: linear.equations((kind,)).told(linear.reduction.from_kept) for kind in kinds}
        normal = np.sum(list(told.values()), axis=0)
        share = {kind: (sigma[kind] / wider.sigma[kind]) ** 2 if kind in free else 1.0 for kind in kinds}
        scattered = sum(share[kind] * own for kind, own in told.items())
        eliminated = np.setdiff1d(np.arange(UNKNOWNS, len(normal)), camera)
        reduced = np.eye(UNKNOWNS, len(normal))
        held = generalised_inverse(normal[np.ix_(eliminated, eliminated)])
        reduced[:, eliminated] = -normal[:UNKNOWNS, eliminated] @ held
        second_moment = covariance[np.ix_(camera, camera)] + np.outer(error, error)
        moved = inverse @ reduced  # X and Z by the gradient of all other unknowns
        by_camera = moved @ normal[:, camera]
        return moved @ scattered @ moved.T + by_camera @ second_moment @ by_camera.T

    def _with_lens(self, basis: np.ndarray, information: np.ndarray) -> tuple[Corners, Solution]:
        """Returns the problem with intrinsics among the unknowns, and it about the state."""
        wider = self.corners.with_lens(basis, information)
        return wider, wider.problem().at(self.solution.values | {"camera": Vector(np.zeros((1, basis.shape[1])))})

    @property
    def normal(self) -> np.ndarray:
        """Normal matrix (12, 12) of X and Z, all other unknowns eliminated."""
        normal, k = self.solution.normal, UNKNOWNS
        return normal[:k, :k] - normal[:k, k:] @ generalised_inverse(normal[k:, k:]) @ normal[k:, :k]

    def without(self, out: np.ndarray) -> Bundle:
        """Returns the solution without the poses ``out``, rows among all: by steps from the solution of all, with its
        σ. The error of such a step is of second order in a small change (influence: Cook & Weisberg 1982)."""
        keep = ~np.isin(np.flatnonzero(~self.outliers), out)
        corners, values = self.corners.only(keep), dict(self.solution.values)
        if "robot" in values:
            values["robot"] = values["robot"][keep]
        problem = corners.problem()
        for _ in range(INFLUENCE_STEPS):
            if not np.isfinite(problem.cost(values)):
                break
            values = problem.moved(values, problem.at(values).step(LEAST_DAMPING)[0])
        return corners.bundle(values)


def adjust_views(
    loop: Loop, views: Views, first: LoopState, noise: Noise, intrinsics: CameraPrior | None, with_scale: bool
) -> AdjustedCorners:
    """Returns the least-squares adjustment of all corners from ``first`` X, Z, scale. ``loop`` holds the same poses as
    ``views``. Unknowns are X, Z and, according to their σ, the true poses of the robot and places of the corners; on
    demand intrinsics about ``intrinsics``, and the scale. Corners and poses have Huber's weights; poses that contradict
    the others are then left out. Raises ConvergenceError: no minimum is reached. Raises DegenerateError: fewer than
    three poses agree."""
    used, good = _near(loop, first), len(loop)
    while True:
        rows = np.flatnonzero(used)
        if len(rows) < 3:
            said = f"hand-eye: {len(rows)} of {good} poses of the robot agree, 3 needed; check that poses and images "
            said += "belong together, and the conventions of both"
            raise DegenerateError("E-HANDEYE-DISAGREE", said)
        corners = Corners.of(loop[rows], views[rows], noise, intrinsics, with_scale)
        corners, solution, settled = adjust(corners, corners.start(first))
        inverse = generalised_inverse(solution.normal)
        bad = contradicting(corners, solution, inverse)
        if not bad.any() or len(rows) - bad.sum() < LEAST_POSES:
            break
        used[rows[bad]] = False
        good -= int(bad.sum())
    return AdjustedCorners(loop, views, ~used, corners, solution, inverse, settled)


def contradicting(corners: Corners, solution: Solution, inverse: np.ndarray) -> np.ndarray:
    """Returns which poses (m,) have a robot error that is not by chance, by the variance of its estimate."""
    m, at = len(corners.loop), solution.places.get("robot")
    if at is None:
        return np.zeros(m, bool)
    if (weight := corners.robot) is None:
        weight = np.tile(np.diag(1 / np.repeat([corners.sigma[name] for name in ROBOT], 3)), (m, 1, 1))
    white = np.einsum("mab,mb->ma", weight, solution.values["robot"].difference(Poses.of([Rigid()] * m)))
    covariance = inverse[at, at].reshape(m, 6, m, 6)[np.arange(m), :, np.arange(m)]
    # For Gaussian knowledge δ ~ N(0, Σ) with posterior covariance C, the estimate of δ scatters by Σ − C.
    squared = squared_within(white, np.eye(6) - weight @ covariance @ np.swapaxes(weight, 1, 2), SEEN)
    redundancy = max(6 * (m - 1) - at.start + (not corners.with_scale), 6)
    return squared > 6 * fdtri(6, redundancy, 1 - FALSE_ALARM / m)


def _near(loop: Loop, first: LoopState) -> np.ndarray:
    """Returns which poses (m,) are not wrong from the start."""
    turn, shift = loop.misses(*first).T
    far = GROSS_SHARE * np.linalg.norm(loop.camera_from_board.translation, axis=1)
    return ~((shift > far) | (turn > GROSS_RAD))
