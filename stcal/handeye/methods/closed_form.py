"""Methods that solve AX = XB or AX = ZB: closed forms, Zhao's convex method, differential evolution (Jin et al.)."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import minimize, nnls
from scipy.spatial.transform import Rotation

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Poses, Rigid, best_rotations, skew
from stcal.handeye.data.pose_pairs import Loop, LoopState, Motions
from stcal.io.device import quiet_opencv

SUBSETS = 200
"""Number of subsets of three or four poses. With a third of all poses bad, enough subsets are clean on average."""
LEAST_LENGTH = 0.1
"""Least ratio of the lengths of camera's and flange's paths: 1 but for the board's size, 0 where neither moves."""
LEAST_SCALE = 1e-6  # smallest scale of the board; lengths in metres give 0.001
SEED = 0  # seed of the subsets, so that they are the same every time


def robust(loop: Loop, with_scale: bool = False) -> LoopState:
    """Returns X, Z and scale of the best of many small subsets, by least product of median rotation and translation,
    which needs no weight between the two units; then of all poses within three times the medians. Rotations are found
    by Shah (2013), then translations and scale by linear least squares, in units of the board: one shrunk to nothing
    would fit a flange that turns about a point. Raises DegenerateError: fewer than three poses."""
    m = len(loop)
    if m < 3:
        raise DegenerateError("E-HANDEYE-FEW-POSES", f"hand-eye: {m} poses, 3 needed; turn the flange about two axes")
    candidates = [_linear(loop, np.arange(m)[None], with_scale)]
    rng = np.random.default_rng(SEED)
    if m > 3:
        order = rng.permuted(np.tile(np.arange(m), (SUBSETS, 1)), axis=1)
        candidates.append(_linear(loop, order[:, : 3 if m < 6 else 4], with_scale))
    parts = [np.concatenate(arrays) for arrays in zip(*candidates, strict=True)]
    turn, shift = _misses(loop, *parts)
    best = np.argmin(np.log(np.median(turn, 1) + 1e-15) + np.log(np.median(shift, 1) + 1e-12))
    turn, shift = turn[best], shift[best]
    inside = (turn <= 3 * np.median(turn)) & (shift <= 3 * np.median(shift))
    if inside.sum() >= 3:
        again = _linear(loop, np.flatnonzero(inside)[None], with_scale)
        new_turn, new_shift = _misses(loop, *again)
        if np.median(new_turn) * np.median(new_shift) < np.median(turn) * np.median(shift):
            parts, best = again, 0
    x, t_x, z, t_z, scale = (arrays[best] for arrays in parts)
    return LoopState(Rigid(x, t_x), Rigid(z, t_z), float(scale))


def about_one_axis(mount_axis: np.ndarray, loop: Loop, with_scale: bool = False) -> LoopState:
    """Returns X, Z and scale of poses that turn about one axis (3,) of the mount only; X has no part along it.
    Translations give the angle about it, and the scale."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    motions = Motions.all(loop)
    motions = motions[motions.has_log()]
    camera_axis = (motions.alpha @ mount_axis) @ motions.beta
    if not np.linalg.norm(camera_axis) > LEAST_LENGTH:
        raise DegenerateError("E-HANDEYE-AXES", "hand-eye: the flange turns, and the board not with it in the camera")
    turn = Rotation.align_vectors(mount_axis[None], camera_axis[None])[0]
    board = eye.translation @ turn.as_matrix().T
    along = (board @ mount_axis)[:, None] * mount_axis
    across = np.stack([board - along, np.cross(mount_axis, board)], axis=2)
    of_stand = np.tile(-np.eye(3), (len(loop), 1, 1))
    rows = np.concatenate([hand.rotation @ across, hand.rotation, of_stand], axis=2).reshape(-1, 8)
    right = -hand.translation - np.einsum("mab,mb->ma", hand.rotation, along)
    cosine, sine = np.linalg.lstsq(rows, right.ravel(), rcond=1e-9)[0][:2]
    length = float(np.hypot(cosine, sine))
    if length < LEAST_LENGTH:
        said = "hand-eye: the flange turns about one axis only and does not move across it, so that the angle about it "
        said += "is not determined; also move it across the axis by a tenth of the board's distance or more"
        raise DegenerateError("E-HANDEYE-AXES", said)
    scale = length if with_scale else 1.0
    about = Rotation.from_rotvec(np.arctan2(sine, cosine) * mount_axis)
    x = (about * turn).as_matrix()
    z = mean_pose(loop.chain(Rigid(x, np.zeros(3)))).rotation
    scaled = replace(loop, camera_from_board=Poses(eye.rotation, scale * eye.translation))
    t_x, t_z, _ = _translations(scaled, np.arange(len(loop))[None], x[None], False)
    return LoopState(*slid(Rigid(x, t_x[0]), Rigid(z, t_z[0]), mount_axis, loop), scale)


def slid(x: Rigid, z: Rigid, mount_axis: np.ndarray, loop: Loop) -> tuple[Rigid, Rigid]:
    """Returns X without its part along the axis about which all poses turn, and the Z that still closes the loop."""
    along = (x.translation @ mount_axis) * mount_axis
    stand = (loop.stand_from_mount.rotation @ along).mean(0)
    return Rigid(x.rotation, x.translation - along), Rigid(z.rotation, z.translation - stand)


def _linear(loop: Loop, subsets: np.ndarray, with_scale: bool) -> tuple[np.ndarray, ...]:
    """Returns X, Z and scale of subsets (s, k): rotations (s, 3, 3) and translations (s, 3) of each, scales (s,)."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    # R_G R_X R_C = R_Z: Σ R_C ⊗ R_G maps vec R_X to k vec R_Z, both of one length. They are the first singular vectors.
    k = np.einsum("mab,mcd->madbc", hand.rotation, eye.rotation).reshape(len(loop), 9, 9)
    total = k[subsets].sum(1)
    first = np.linalg.eigh(np.swapaxes(total, 1, 2) @ total)[1][:, :, -1:]
    z, x = (total @ first).reshape(-1, 3, 3), first.reshape(-1, 3, 3)
    sign = np.sign(np.linalg.det(x))[:, None, None]
    x, z = best_rotations(sign * x)[0], best_rotations(sign * z)[0]
    t_x, t_z, scale = _translations(loop, subsets, x, with_scale)
    return x, t_x, z, t_z, scale


def _translations(loop: Loop, subsets: np.ndarray, x: np.ndarray, with_scale: bool) -> tuple[np.ndarray, ...]:
    """Returns the shortest t_X and t_Z (s, 3), and scales (s,), for R_X: R_G t_X + s R_G R_X t_C − t_Z = −t_G."""
    hand, eye, s = loop.stand_from_mount, loop.camera_from_board, len(subsets)
    rows = np.concatenate([hand.rotation, np.tile(-np.eye(3), (len(loop), 1, 1))], axis=2)[subsets]
    moved = np.einsum("skab,sbc,skc->ska", hand.rotation[subsets], x, eye.translation[subsets])
    right = -hand.translation[subsets] - (0 if with_scale else moved)
    if with_scale:
        rows = np.concatenate([rows, moved[..., None]], axis=3)
    solved = (np.linalg.pinv(rows.reshape(s, -1, rows.shape[3]), rcond=1e-9) @ right.reshape(s, -1, 1))[:, :, 0]
    return solved[:, :3], solved[:, 3:6], solved[:, 6] if with_scale else np.ones(s)


def _misses(loop: Loop, x, t_x, z, t_z, scale) -> tuple[np.ndarray, np.ndarray]:
    """Returns angles and distances (s, m) by which the chains miss Z, in units of the board: infinite if of no size."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    cosine = (np.einsum("smab,sab->sm", hand.rotation @ (x[:, None] @ eye.rotation), z) - 1) / 2
    board = scale[:, None, None] * eye.translation @ np.swapaxes(x, 1, 2) + t_x[:, None]
    at = np.einsum("mab,smb->sma", hand.rotation, board)
    shift, size = np.linalg.norm(at + hand.translation - t_z[:, None], axis=2), np.abs(scale)[:, None]
    shift = np.where(size < LEAST_SCALE, np.inf, shift / np.maximum(size, LEAST_SCALE))
    return np.arccos(np.clip(cosine, -1, 1)), shift


def mean_pose(chain: Poses) -> Rigid:
    """Returns the mean of poses, with the chordal mean of their rotations."""
    return Rigid(Rotation.from_matrix(np.array(chain.rotation)).mean().as_matrix(), chain.translation.mean(0))


AX_XB = {
    "tsai-lenz": cv2.CALIB_HAND_EYE_TSAI,
    "park-martin": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
"""Tsai & Lenz 1989, Park & Martin 1994, Horaud & Dornaika 1995, Andreff et al. 1999, Daniilidis 1999."""
AX_ZB = {"shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
"""Shah 2013, Li, Wang & Wu 2010."""


def solve_closed_form(loop: Loop, method: str, unit_mm: float = 1000.0) -> tuple[Rigid, Rigid]:
    """Returns X and Z by one of :data:`AX_XB`, whose Z is the mean of the chains, or :data:`AX_ZB`; ``unit_mm`` weighs
    like one radian. Raises ConvergenceError: OpenCV fails, or its result is not a rigid transform."""

    def split(poses: Poses) -> tuple[list[np.ndarray], list[np.ndarray]]:
        return list(poses.rotation), list(poses.translation / unit_mm)

    def rigid(rotation: np.ndarray, translation: np.ndarray) -> Rigid:
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all() and np.linalg.det(rotation) > 0):
            said = f"hand-eye: {method} returns no transform; the motions are too small or too alike for it"
            raise ConvergenceError("E-HANDEYE-METHOD-FAILS", said)
        u, _, vt = np.linalg.svd(rotation)
        return Rigid(u @ vt, unit_mm * translation.ravel())

    hand, eye = loop.stand_from_mount, split(loop.camera_from_board)
    try:
        with quiet_opencv():  # of few poses it prints lines of its own
            if method in AX_XB:
                x = rigid(*cv2.calibrateHandEye(*split(hand), *eye, method=AX_XB[method]))
                return x, mean_pose(loop.chain(x))
            r_z, t_z, r_x, t_x = cv2.calibrateRobotWorldHandEye(*eye, *split(hand.inverse()), method=AX_ZB[method])
    except cv2.error as error:
        raise ConvergenceError("E-HANDEYE-METHOD-FAILS", f"hand-eye: {method} fails in OpenCV ({error.err})") from error
    return rigid(r_x, t_x).inverse(), rigid(r_z, t_z).inverse()


GAP = 1e-4  # largest relative excess of the largest error over the proven bound: a hundredth of any σ


def convex(motions: Motions, unit_mm: float = 1000.0) -> Rigid:
    """Returns X by Zhao's L∞ minimisation (*Hand-eye calibration using convex optimization*, ICRA 2011), in the form of
    orthogonal matrices: over x = (vec R_X, b_X), with R_X any matrix, the largest ‖C_i x − d_i‖, the twelve equations
    of motion i; then the nearest rotation. Sequential quadratic programming solves this cone program of 13 unknowns,
    and its multipliers prove the minimum. ``unit_mm`` : the length that weighs like one radian. Raises
    ConvergenceError: the bound is not reached, or the matrix is not a rotation."""
    c, d = equations(motions, unit_mm)
    x = smallest_largest(c, d, np.linalg.lstsq(c.reshape(-1, 12), d.ravel(), rcond=None)[0])
    u, s, vt = np.linalg.svd(x[:9].reshape(3, 3, order="F"))
    if np.linalg.det(u @ vt) < 0 or s[2] < 0.1:
        raise ConvergenceError("E-HANDEYE-METHOD-FAILS", "hand-eye: zhao finds no rotation; motions are too alike")
    return Rigid(u @ vt, unit_mm * x[9:])


def equations(motions: Motions, unit_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns C (k, 12, 12), d (k, 12) of R_A R_X − R_X R_B and (R_A − I) b_X − R_X b_B + b_A; x has R_X by columns."""
    eye, none = np.eye(3), np.zeros((9, 3))
    parts = zip(motions.mount.rotation, motions.camera.rotation, motions.camera.translation / unit_mm, strict=True)
    rows = [[[np.kron(eye, a) - np.kron(b.T, eye), none], [-np.kron(shift, eye), a - eye]] for a, b, shift in parts]
    d = np.concatenate([np.zeros((len(motions), 9)), -motions.mount.translation / unit_mm], axis=1)
    return np.array([np.block(each) for each in rows]), d


def smallest_largest(c: np.ndarray, d: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Returns the x of least largest ‖C_i x − d_i‖; raises ConvergenceError if not proven within :data:`GAP`."""
    scale = np.linalg.norm(np.einsum("kij,j->ki", c, x) - d, axis=1).max()
    if scale < 1e-12:  # the start has no residuals
        return x
    hessian, pull = np.swapaxes(c, 1, 2) @ c / scale**2, np.einsum("kij,ki->kj", c, d) / scale**2
    level = (d**2).sum(1) / scale**2

    def squared(y):
        return (np.einsum("kij,j->ki", c, y) - d) ** 2 / scale**2

    limits = {
        "type": "ineq",
        "fun": lambda y: y[-1] - squared(y[:-1]).sum(1),
        "jac": lambda y: np.column_stack([-2 * (hessian @ y[:-1] - pull), np.ones(len(c))]),
    }
    start, ahead, options = np.append(x, 1.0), np.eye(13)[-1], {"maxiter": 500, "ftol": 1e-14}
    x = minimize(ahead.dot, start, jac=lambda _: ahead, method="SLSQP", constraints=limits, options=options).x[:-1]
    errors = squared(x).sum(1)
    # The minimum of a weighted mean of the squared errors is below that of the largest: multipliers give the best mean.
    active = errors > (1 - 1e-2) * errors.max()
    slopes = 2 * (hessian @ x - pull)[active]
    shares, _ = nnls(np.vstack([slopes.T, np.ones(active.sum())]), np.append(np.zeros(12), 1.0))
    shares /= shares.sum()
    mean, right = np.tensordot(shares, hessian[active], 1), shares @ pull[active]
    bound = shares @ level[active] - right @ np.linalg.lstsq(mean, right, rcond=None)[0]
    if errors.max() > (1 + 2 * GAP) * bound:
        said = f"hand-eye: zhao's largest error is {np.sqrt(errors.max() / max(bound, 1e-300)):.4g} times its proven "
        said += "bound; use another method"
        raise ConvergenceError("E-HANDEYE-METHOD-FAILS", said)
    return x


MOST = 100_000  # largest number of candidates, and of generations
EXACT = 1e-24  # gain of a step at which the minimum is reached, rad²: the objective is not in units of any σ
FARTHEST = 1e9  # largest number of bounds, mm or rad: a thousand kilometres


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of three coordinates of the first population.

    ``half_width`` : mm, or rad of the rotation vector; ``centre`` : (3,) centre of the bounds; where None, that of the
    closed-form solution (Park & Martin 1994).

    Raises InputError: the half width is not positive, or a number is not finite or beyond :data:`FARTHEST`.
    """

    half_width: float
    centre: tuple[float, float, float] | None = (0.0, 0.0, 0.0)

    def __post_init__(self):
        require_fields(self, "differential evolution")
        if not (0 < self.half_width <= FARTHEST and (np.abs(self.centre or 0) <= FARTHEST).all()):
            said = f"differential evolution: bounds of half width {self.half_width:g} about {self.centre}; numbers up "
            said += f"to {FARTHEST:g} and a positive half width needed"
            raise InputError("E-EVOLUTION-OPTIONS", said)


@dataclass(frozen=True, slots=True)
class EvolutionOptions:
    """DE/rand/1/bin (Storn & Price 1997) with the values of the paper.

    Parameters
    ----------
    population, generations : M and the number of generations
    factor, crossover : F and CR
    weight : λ, with lengths in the unit that weighs like one radian (1 m where no σ are stated)
    bounds_rad : bounds of the rotation vectors of the first population. The paper takes them from knowledge of the
        set-up; its values are not legible in the source.
    bounds_mm : bounds of its translations; where None, about zero, as wide as the distance of the farthest board or
        flange
    seed : int
    """

    population: int = 30
    generations: int = 100
    factor: float = 0.5
    crossover: float = 0.9
    weight: float = 1.0
    bounds_rad: Bounds = Bounds(np.pi)
    bounds_mm: Bounds | None = None
    seed: int = 0

    def __post_init__(self):
        require_fields(self, "differential evolution", seed=0)
        numbers = (self.population, self.generations, self.factor, self.crossover, self.weight)
        least, most = (4, 0, 1e-300, 0, 1e-300), (MOST, MOST, 2, 1, FARTHEST)
        if not all(low <= number <= high for low, number, high in zip(least, numbers, most, strict=True)):
            said = "population {}, {} generations, F {:g}, CR {:g}, λ {:g}".format(*numbers)
            needed = f"4 to {MOST}, 0 to {MOST}, above 0 to 2, 0 to 1, and a positive number needed"
            raise InputError("E-EVOLUTION-OPTIONS", f"differential evolution: {said}; {needed}")


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """Objective f = Σ‖α − R_X β‖² + λ Σ‖(R_A − I) b_X + b_A − R_X b_B‖², lengths in ``unit_mm``; x = (log R_X, b_X)."""

    motions: Motions
    unit_mm: float
    weight: float

    def values(self, x: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(x[:, :3]).as_matrix()
        rotation, translation = self._parts(turn, x[:, 3:])
        return (rotation**2).sum((1, 2)) + self.weight * (translation**2).sum((1, 2))

    def linear(self, x: Rigid) -> NormalEquations:
        """Returns the normal equations about X, translation in mm."""
        rotation, translation = self._parts(x.rotation[None], x.translation[None] / self.unit_mm)
        root = np.sqrt(self.weight)
        white = np.concatenate([rotation[0], root * translation[0]]).ravel()
        jacobian = np.zeros((2, len(self.motions), 3, 6))
        jacobian[0, :, :, :3] = skew(self.motions.beta @ x.rotation.T)
        jacobian[1, :, :, :3] = root / self.unit_mm * skew(self.motions.camera.translation @ x.rotation.T)
        jacobian[1, :, :, 3:] = root / self.unit_mm * (self.motions.mount.rotation - np.eye(3))
        return NormalEquations.of(white, jacobian.reshape(-1, 6))

    def _parts(self, turn: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the errors (p, k, 3) of rotation and translation."""
        a, b = self.motions.mount, self.motions.camera
        rotation = self.motions.alpha - np.einsum("pij,kj->pki", turn, self.motions.beta)
        moved = np.einsum("kij,pj->pki", a.rotation - np.eye(3), shift) + a.translation / self.unit_mm
        return rotation, moved - np.einsum("pij,kj->pki", turn, b.translation / self.unit_mm)


def evolve(objective: Objective, options: EvolutionOptions, reach_mm: float, closed_form: Rigid | None = None) -> Rigid:
    """Returns the best candidate of the last generation; bounds limit the first one only. ``reach_mm``, ``closed_form``
    : half width and centre of bounds that have none."""
    rng, size = np.random.default_rng(options.seed), options.population
    about = np.zeros(6) if closed_form is None else closed_form.log()
    parts = options.bounds_rad, options.bounds_mm or Bounds(reach_mm)
    own = (about[:3], about[3:])
    centre = np.concatenate([a if b.centre is None else b.centre for a, b in zip(own, parts, strict=True)])
    scale = np.repeat([1.0, 1 / objective.unit_mm], 3)
    centre, half = centre * scale, np.repeat([bounds.half_width for bounds in parts], 3) * scale
    x = rng.uniform(centre - half, centre + half, (size, 6))
    value = objective.values(x)
    for _ in range(options.generations):
        order = rng.random((size, size))
        np.fill_diagonal(order, 2)  # a candidate itself comes last
        a, b, c = np.argsort(order, axis=1)[:, :3].T  # three others, all different
        mutant = x[a] + options.factor * (x[b] - x[c])
        trial = np.where(rng.random((size, 6)) <= options.crossover, mutant, x)
        trial_value = objective.values(trial)
        better = trial_value <= value
        x, value = np.where(better[:, None], trial, x), np.where(better, trial_value, value)
    best = x[np.argmin(value)]
    return Rigid.exp(np.concatenate([best[:3], objective.unit_mm * best[3:]]))


def polish(objective: Objective, x: Rigid) -> Rigid:
    """Returns the minimum of the objective next to X; raises ConvergenceError."""
    minimum = minimise(x, objective.linear, Rigid.moved, least_gain=EXACT)
    return minimum.required("differential evolution", "check the poses that fit worst").state
