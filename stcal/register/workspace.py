"""Range of validity of a registration: systematic residuals over the workspace, and errors around cubes."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.special import chdtrc, chdtri

from stcal.errors import StcalError
from stcal.geometry.arrays import Array, freeze
from stcal.parallel import one_thread
from stcal.register.consensus import AFFINE, MODELS, Problem, Transform, jacobian, problem_of
from stcal.register.registered import ErrorFigures, Pairs, Registration, held_out

MOST_POINTS = 500
"""Largest number of points of the model, evenly chosen from more, as its cost grows with the third power."""
SEEN_AT, WILD = 0.01, 0.01
"""Probability of a systematic part in noise, and that a clean set has any point taken for an outlier of the field."""
LENGTHS, RATIOS = 12, np.geomspace(1e-3, 1e7, 41)
"""Number of lengths tried before refinement, and tried ratios of the variance of f to that of the noise."""
GRID, MARGIN = 7, 0.25
"""Number of places along each side of the grid of the field, and its margin beyond the box of the points."""
sytrd, ormqr, pttrf, pttrs = get_lapack_funcs(("sytrd", "ormqr", "pttrf", "pttrs"), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Systematic residuals b − b_from_a a over the workspace, frame b's axes, at places in frame a."""

    length_mm: float  # over which they change
    p_value: float  # of such a part by chance
    rows: Array  # (m,) of the points used
    taken_back: Array  # outliers that follow the field of the others
    plain_mm: Array  # (m,) errors of points by the transform, fitted to the others
    corrected_mm: Array  # (m,) by transform and field
    sigma_ratio: float  # RMS of the latter over their σ
    _problem: Problem
    _transform: Transform
    _ratio: float
    _kriged: "_Kriged"

    def __post_init__(self):
        for name, kind in (("rows", int), ("taken_back", int), ("plain_mm", float), ("corrected_mm", float)):
            freeze(self, name, (None,), name, kind)

    @property
    def seen(self) -> bool:
        """Whether residuals are more than noise."""
        return self.p_value < SEEN_AT

    @property
    def noise_mm(self) -> float:
        return float(np.sqrt(self._kriged.variance))

    @property
    def size_mm(self) -> float:
        return float(np.sqrt((self.at(self._problem.xyz_a)[0] ** 2).sum(1).mean()))

    @property
    def plain(self) -> ErrorFigures:
        return ErrorFigures.of(self.plain_mm)

    @property
    def corrected(self) -> ErrorFigures:
        return ErrorFigures.of(self.corrected_mm)

    @property
    def grid(self) -> dict[str, np.ndarray]:
        """Places in and around the points, frame a, with the error to expect there and its σ per axis, mm."""
        low, high = self._problem.xyz_a.min(0), self._problem.xyz_a.max(0)
        side = MARGIN * (high - low)
        axes = [np.linspace(a, b, GRID) if b > a else [a] for a, b in zip(low - side, high + side, strict=True)]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        error, covariance = self.at(places)
        sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)
        return {"xyz_a_mm": places, "error_mm": error, "sigma_mm": sigma}

    def at(self, xyz_a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the expected systematic error (g, 3) of the transform at places (g, 3), and its covariance, mm."""
        kriged, places = self._kriged, np.asarray(xyz_a, float)
        near = self._ratio * _matern(cdist(places, self._problem.xyz_a) / self.length_mm)
        motions = _motions(self._problem, self._transform, places)
        left = motions - np.einsum("gm,mcp->gcp", near, kriged.of_motions)
        value = near @ kriged.of_y + left @ kriged.beta
        own = self._ratio - np.einsum("gm,mk,gk->g", near, kriged.inverse, near, optimize=True)
        covariance = np.maximum(own, 0)[:, None, None] * np.eye(3) + left @ kriged.spread @ np.swapaxes(left, 1, 2)
        return value, kriged.variance * covariance


def residual_field(registration: Registration, problem: Problem) -> Field | None:
    """Returns the systematic part of the residuals, or None; of covariances only mean variances are used."""
    model, precision, residuals = problem.model, problem.precision, problem.residuals(registration.b_from_a)
    variance = 1 / precision if precision.ndim == 1 else np.trace(np.linalg.inv(precision), axis1=1, axis2=2) / 3
    used, followers = registration.inliers.copy(), np.zeros(0, int)
    for _ in range(5):
        rows = _few(np.flatnonzero(used))
        if model.redundancy(len(rows)) < 2 * model.parameters:
            return None
        field = _field(problem[rows], registration.b_from_a, variance[rows], rows, followers)
        others = _few(np.flatnonzero(~used))
        if not field.seen or not len(others):
            return field
        value, covariance = field.at(problem.xyz_a[others])
        off = residuals[others] - value
        whole = covariance + (field.noise_mm**2 * variance[others])[:, None, None] * np.eye(3)
        square = np.einsum("ni,ni->n", off, np.linalg.solve(whole, off[:, :, None])[:, :, 0])
        near = np.linalg.norm(off, axis=1) < np.linalg.norm(residuals[others], axis=1) / 2
        added = others[(square < chdtri(3, WILD / len(others))) & near]
        if not len(added):
            return field
        used[added] = True
        followers = np.sort(np.concatenate([followers, added]))
    return field


def _few(rows: np.ndarray) -> np.ndarray:
    return rows if len(rows) <= MOST_POINTS else rows[np.linspace(0, len(rows) - 1, MOST_POINTS).astype(int)]


def _matern(distance: np.ndarray) -> np.ndarray:
    """Returns Matérn's 5/2 function of distances over the length."""
    scaled = np.sqrt(5) * distance
    return (1 + scaled + scaled**2 / 3) * np.exp(-scaled)


def _motions(problem: Problem, transform: Transform, xyz_a: np.ndarray) -> np.ndarray:
    """Returns the residuals due to small motions of the transform, (m, 3, p), for parameters scaled to about 1."""
    origin = problem.xyz_a.mean(0)
    extent = float(np.abs(problem.xyz_a - origin).max())
    unit = np.tile([extent, extent, extent, 1.0], 3)
    if problem.model != AFFINE:
        unit = np.repeat([extent, 1.0, extent], [3, 3, 1])[: problem.model.parameters]
    return jacobian(problem.model, transform, xyz_a - origin) / unit


def _field(problem: Problem, transform: Transform, variance: np.ndarray, rows: np.ndarray, taken: np.ndarray) -> Field:
    """Returns the field of the best length and variance ratio; ``variance`` : (m,) relative, of the points' noise."""
    residuals, motions = problem.residuals(transform), _motions(problem, transform, problem.xyz_a)
    distance, root = cdist(problem.xyz_a, problem.xyz_a), np.sqrt(variance)
    columns = np.concatenate([motions, residuals[:, :, None]], axis=2) / root[:, None, None]

    def at(length: float) -> tuple[float, float, float]:
        return _at_length(_matern(distance / length) / root[:, None] / root, columns)

    nearest = KDTree(problem.xyz_a).query(problem.xyz_a, k=2)[0][:, 1]
    low, high = max(np.median(nearest), 1e-6 * distance.max()), 2 * distance.max()
    length, _ = _least(lambda length: at(length)[1], np.geomspace(low, high, LENGTHS), 0.02)
    ratio, value, without = at(length)
    kriged = _Kriged.of(np.linalg.inv(ratio * _matern(distance / length) + np.diag(variance)), residuals, motions)
    corrected, sigma_ratio = kriged.left_out()
    plain, _ = _Kriged.of(np.diag(1 / variance), residuals, motions).left_out()
    p_value = float(chdtrc(2, max(without - value, 0.0)))
    return Field(length, p_value, rows, taken, plain, corrected, sigma_ratio, problem, transform, ratio, kriged)


def _at_length(covariance: np.ndarray, columns: np.ndarray) -> tuple[float, float, float]:
    """Returns by restricted likelihood the ratio of f's variance to the noise's, and −2 log L with and without f."""
    m, _, width = columns.shape
    flat = columns.reshape(m, -1)
    # A tridiagonal form Q T Qᵀ takes a third of the time of eigenvectors.
    reflectors, diagonal, beside, scale, _ = sytrd(covariance, lower=1, lwork=64 * m)
    turned = np.vstack([flat[:1], ormqr("L", "T", reflectors[1:, :-1], scale, flat[1:], lwork=64 * flat.shape[1])[0]])
    rows, p = turned.reshape(3 * m, width).T, width - 1

    def twice(ratio: float) -> float:
        spread, factor, _ = pttrf(1 + ratio * diagonal, ratio * beside)
        both = rows @ pttrs(spread, factor, turned)[0].reshape(3 * m, width)
        a, g = both[:p, :p], both[:p, p]
        rest = both[p, p] - g @ np.linalg.solve(a, g)
        return (3 * m - p) * np.log(max(rest, 1e-300)) + 3 * np.log(spread).sum() + np.linalg.slogdet(a)[1]

    return *_least(twice, RATIOS, 0.01), twice(0.0)


def _least(function: Callable[[float], float], places: np.ndarray, within: float) -> tuple[float, float]:
    """Returns the place of the least of the values at ascending places, refined by its logarithm, and the value."""
    values = [function(place) for place in places]
    i = int(np.argmin(values))
    around = np.log(places[[max(i - 1, 0), min(i + 1, len(places) - 1)]])
    refined = minimize_scalar(
        lambda log: function(np.exp(log)), bounds=around, method="bounded", options={"xatol": within}
    )
    if refined.fun < values[i]:
        return float(np.exp(refined.x)), float(refined.fun)
    return float(places[i]), float(values[i])


@dataclass(frozen=True, slots=True, eq=False)
class _Kriged:
    """Generalised least squares by unit C: C⁻¹, C⁻¹ y, C⁻¹ J, (JᵀC⁻¹J)⁻¹, β, C⁻¹ (y − J β), and the variance factor."""

    inverse: np.ndarray
    of_y: np.ndarray
    of_motions: np.ndarray
    spread: np.ndarray
    beta: np.ndarray
    left: np.ndarray
    variance: float

    @classmethod
    def of(cls, inverse: np.ndarray, y: np.ndarray, motions: np.ndarray) -> "_Kriged":
        m, _, p = motions.shape
        of_y = inverse @ y
        of_motions = (inverse @ motions.reshape(m, -1)).reshape(m, 3, p)
        spread = np.linalg.inv(np.einsum("mcp,mcq->pq", motions, of_motions))
        beta = spread @ np.einsum("mcp,mc->p", motions, of_y)
        left = of_y - of_motions @ beta
        variance = float((y * left).sum() / (3 * m - p))
        return cls(inverse, of_y, of_motions, spread, beta, left, variance)

    def left_out(self) -> tuple[np.ndarray, float]:
        """Returns each point's error (m,) by the model of the others, and the RMS ratio to σ (Dubrule 1983)."""
        block = np.diag(self.inverse)[:, None, None] * np.eye(3)
        block = block - self.of_motions @ self.spread @ np.swapaxes(self.of_motions, 1, 2)
        error = np.linalg.solve(block, self.left[:, :, None])[:, :, 0]
        ratio = np.sqrt((error * self.left).sum() / (3 * len(error) * self.variance))
        return np.linalg.norm(error, axis=1), float(ratio)


SHARES = (0.25, 0.5, 0.75, 1.0)
"""Sides of the cubes relative to the cube that holds all points, which is rounded up to two digits."""
LEAST_POINTS = 10
"""Least number of points in the inner cube: 30 coordinates for the six parameters of a rigid transform."""


@dataclass(frozen=True, slots=True, eq=False)
class Cubes:
    """Errors of fits in cubes about the middle of the points."""

    middle: Array  # (3,) mm, frame a, along whose axes the cubes are
    sides_mm: Array
    # errors[i][j]: of the fit in cube i at points in cube j that are not in cube j − 1, held out in turn, or None
    errors: tuple[tuple[ErrorFigures | None, ...], ...]

    def __post_init__(self):
        freeze(self, "middle", (3,), "middle")
        freeze(self, "sides_mm", (None,), "sides")


def cubes(
    registration: Registration, every: Problem, taken_back: np.ndarray | None = None, folds: int = 6
) -> Cubes | None:
    """Fits the model in cubes about the middle of the inliers and ``taken_back``; None for too few points."""
    used = registration.inliers.copy()
    if taken_back is not None:
        used[taken_back] = True
    problem = every[np.flatnonzero(used)]
    a = problem.xyz_a
    middle = (a.min(0) + a.max(0)) / 2
    reach = 2 * np.abs(a - middle).max(1)
    step = 10.0 ** (np.floor(np.log10(reach.max())) - 1)
    outer = np.ceil(reach.max() / step * (1 - 1e-9)) * step
    sides = [share * outer for share in SHARES if (reach <= share * outer).sum() >= LEAST_POINTS]
    by_side: dict[float, np.ndarray] = {}
    for side in sides:
        with suppress(StcalError):  # the points of the inner cube may lie in a plane
            by_side[side] = _errors(problem, reach <= side, folds, registration.seed)
    if not by_side:
        return None
    sides = list(by_side)
    shell = np.searchsorted(sides, reach * (1 - 1e-12))
    errors = tuple(
        tuple(ErrorFigures.of(error[shell == j]) if (shell == j).any() else None for j in range(len(sides)))
        for error in by_side.values()
    )
    return Cubes(middle, np.array(sides), errors)


def _errors(problem: Problem, inside: np.ndarray, folds: int, seed: int) -> np.ndarray:
    """Returns the errors (n,) of all points, mm, for the fit to the points ``inside``. These are held out in turn."""
    cube = problem[inside]
    error = np.linalg.norm(problem.residuals(cube.fit()), axis=1)
    held = held_out(cube, lambda rows: cube[rows].fit(), np.ones(len(cube), bool), folds, seed)
    if held is not None:
        error[np.flatnonzero(inside)[held.rows]] = held.error_mm
    return error


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Findings(Registration):
    """A registration of the file ``pairs`` and its checks. ``lines`` : (n,) of the points; ``xyz_a`` : (n, 3) points,
    mm; ``field``, ``cubes`` : or None."""

    format: ClassVar = "stcal registration 1"
    pairs: str
    lines: Sequence[int]
    xyz_a: Array
    field: Field | None
    cubes: Cubes | None

    def __post_init__(self):
        Registration.__post_init__(self)
        freeze(self, "xyz_a", (len(self), 3), "points")

    @property
    def covariance_of(self) -> tuple[str, ...]:
        """Names of the covariance's rows, with units."""
        if len(self.covariance) < 12:
            return ("rx_rad", "ry_rad", "rz_rad", "x_mm", "y_mm", "z_mm", "scale")[: len(self.covariance)]
        return tuple(f"m{row}{column}" + ("_mm" if column == "4" else "") for row in "123" for column in "1234")

    @property
    def length_mm(self) -> np.ndarray:
        """Lengths (n,) of the residuals, mm."""
        return np.linalg.norm(self.residuals, axis=1)

    def sigma_mm_at(self, xyz_a: np.ndarray) -> np.ndarray:
        """Returns σ (3,) by the transform's covariance at a point of frame a, along b's axes."""
        by_step = jacobian(MODELS[self.model], self.b_from_a, xyz_a[None])[0]
        return np.sqrt(np.diag(by_step @ self.covariance @ by_step.T).clip(0))


@one_thread()
def findings(pairs: Pairs, registration: Registration) -> Findings:
    """Returns a registration of these pairs with its residual field and cubes."""
    model = MODELS[registration.model]
    problem = problem_of(model, pairs.xyz_a, pairs.xyz_b, pairs.weights, pairs.covariances)
    field = residual_field(registration, problem)
    reach = cubes(registration, problem, None if field is None else field.taken_back)
    found = {each.name: getattr(registration, each.name) for each in fields(registration)}
    return Findings(**found, pairs=pairs.where, lines=pairs.lines, xyz_a=pairs.xyz_a, field=field, cubes=reach)
