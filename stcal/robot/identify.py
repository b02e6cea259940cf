"""Identification of a robot's kinematics from poses, positions or distances: parameters, σ and held-out error."""

from dataclasses import astuple, dataclass, replace

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.arrays import frozen
from stcal.robot.adjustment import Solution, Weighting, normal_rank, solve
from stcal.robot.data import Measurements
from stcal.robot.dh import robot_from_chain
from stcal.robot.model import Robot
from stcal.robot.nominal import Deviations, NominalRows, dh_slope
from stcal.robot.observe import (
    WIDTH,
    Kind,
    Observed,
    State,
    jacobian,
    observed,
    only_of,
    parameter_names,
    residuals,
    tips,
    unknowns,
)
from stcal.robot.start import start

GUESS_MM, GUESS_RAD = 0.1, 5e-4
"""σ to begin with where none is given; then they are estimated."""
VARIANCE_ROUNDS = 10
VARIANCE_SETTLED = 1e-3
STILL_RAD, STILL_MM = 1e-5, 1e-2
"""A joint that moves less than this did not move."""
OUTLIER_WEIGHT = 0.5
REPEATS, FEW_ROWS = 5, 300
"""Divisions of the cross-validation of few rows; one does for more."""


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """``observe`` : kind of observation, None for the most that was measured; ``sigma_mm``, ``sigma_rad`` : of one
    coordinate, estimated where None; ``folds`` of the cross-validation, 0 for none, each row held out once in each of
    ``repeats`` divisions drawn with ``seed``; ``partial`` : keep nominal what the data do not determine."""

    observe: Kind | None = None
    sigma_mm: float | None = None
    sigma_rad: float | None = None
    robust: bool = True
    folds: int = 6
    repeats: int | None = None
    seed: int = 0
    partial: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Errors of rows that a fit had not seen: ``position_mm`` : (repeats, r); ``rotation_rad`` : the same, or empty."""

    folds: int
    position_mm: np.ndarray
    rotation_rad: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The identified robot, and how far to trust it.

    ``robot`` : base where the instrument stands, tools by target; ``names`` : (k,) of the parameters, small motions of
    each joint's frame and of the tools (J2 ry: axis of joint 2 about its y, rad; tool x: mm); ``covariance`` : (k, k);
    ``rank`` of the data used, ``ranks`` by kind of observation of the same joint values;
    ``undetermined`` : names of parameters along directions that were kept nominal; ``weights`` : (r,) Huber's;
    ``nominal_mm``, ``fitted_mm`` : (r,) errors with nominal axes (base and tools fitted) and identified ones;
    ``dh_sigma`` : (n, 5) of a, alpha, d, theta, beta, mm and rad; ``spectrum`` : (rank,) singular values in 1/mm of the
    tool's movement, whitened; ``deviations`` : σ of this robot's dimensions about nominal, as the data show them.
    """

    robot: Robot
    state: State
    seen: Observed
    weighting: Weighting
    sigma0: float
    names: tuple[str, ...]
    covariance: np.ndarray
    rank: int
    ranks: dict[str, int]
    undetermined: tuple[str, ...]
    weights: np.ndarray
    residuals: np.ndarray
    nominal_mm: np.ndarray
    fitted_mm: np.ndarray
    held_out: HeldOut | None
    dh_sigma: np.ndarray
    spectrum: np.ndarray
    deviations: Deviations

    def __post_init__(self):
        k = len(self.names)
        object.__setattr__(self, "covariance", frozen(self.covariance, (k, k), "covariance"))

    def outliers(self) -> list[tuple[int, float]]:
        """(row of the observations, error in mm) of those that weigh less than half."""
        return [(int(i), float(self.fitted_mm[i])) for i in np.flatnonzero(self.weights < OUTLIER_WEIGHT)]


def identify(robot: Robot, data: Measurements, options: IdentifyOptions | None = None) -> Identified:
    """Identify the axes, base and tools of ``robot`` from ``data``.

    Complete, minimal and continuous parameters (:func:`stcal.robot.kinematics.chain_parameters`), trust region, Huber
    weights, covariance, and the way back to D-H rows with Hayati's β (Hayati 1983) for nearly parallel axes.

    Raises
    ------
    DegenerateError
        A joint or a target never moved, too few observations, or directions that the data do not determine (kept
        nominal with ``partial``).
    InputError
        The nominal robot does not fit the data.
    """
    options = options or IdentifyOptions()
    seen = observed(data, options.observe)
    _still_joints(robot, data, options.partial)
    first = start(robot, data)
    _enough(robot, seen, first)
    solution, weighting, sigma0, deviations = _weighted(robot, first, seen, options)
    names = parameter_names(solution.state, seen.kind)
    undetermined = _undetermined(solution, names, seen, options.partial)
    covariance = sigma0**2 * (_of_distances(solution, seen, weighting) if seen.derived else solution.inverse())
    values, _, good = solution.spectrum()
    identified = robot_from_chain(solution.state.chain, solution.state.tools, robot)
    return Identified(
        identified,
        solution.state,
        seen,
        weighting,
        sigma0,
        tuple(names),
        covariance,
        solution.rank(),
        _ranks(solution.state, data, weighting),
        undetermined,
        solution.weights,
        solution.residuals,
        _lengths(residuals(first, seen)),
        _lengths(solution.residuals),
        _cross_validated(robot, seen, weighting, options),
        _dh_sigma(solution, covariance, seen.kind, robot),
        np.sqrt(values[good])[::-1],
        deviations,
    )


def _still_joints(robot: Robot, data: Measurements, partial: bool) -> None:
    moves = np.ptp(data.q @ robot.coupling.T, axis=0)
    for i, move in enumerate(moves, 1):
        prismatic = robot.joints[i - 1].type == "prismatic"
        if move < (STILL_MM if prismatic else STILL_RAD) and not partial:
            raise DegenerateError(
                f"{data.where}: joint {i} never moved, so that its axis is not seen; measure with other values of "
                f"q{i}, or keep its nominal values with --partial"
            )


def _enough(robot: Robot, seen: Observed, state: State) -> None:
    unknowns = len(parameter_names(state, seen.kind))
    numbers = WIDTH[seen.kind] * len(seen)
    if numbers <= unknowns:
        needed = unknowns // WIDTH[seen.kind] + 1
        raise DegenerateError(
            f"{seen.data.where}: {len(seen)} {seen.kind}s give {numbers} numbers for {unknowns} parameters; "
            f"{needed} or more needed, better twice that"
        )


def _weighted(nominal: Robot, state: State, seen: Observed, options: IdentifyOptions):
    """Solve; with σ from the residuals where none is given (Förstner's variance components); σ₀ after that."""
    given = seen.data.covariance is not None and options.sigma_mm is None and options.sigma_rad is None
    given = given and seen.kind != "distance"
    weighting = Weighting(options.sigma_mm or GUESS_MM, options.sigma_rad or GUESS_RAD, given)
    free = not given and (options.sigma_mm is None or (options.sigma_rad is None and seen.kind == "pose"))
    solution = solve(state, seen, weighting, options.robust)
    deviations, rows = Deviations(), NominalRows.about(solution, seen.kind, nominal)
    for _ in range(VARIANCE_ROUNDS):
        held = rows.held(solution.state, deviations)
        solution = solve(solution.state, seen, weighting, options.robust, held)
        new_deviations = rows.estimated(solution, deviations)
        new = _variances(solution, seen, weighting, options) if free else weighting
        change = _change(astuple(new)[:2] + astuple(new_deviations), astuple(weighting)[:2] + astuple(deviations))
        weighting, deviations = new, new_deviations
        if change < VARIANCE_SETTLED:
            break
    held = rows.held(solution.state, deviations)
    solution = solve(solution.state, seen, weighting, options.robust, held)
    white = weighting.whiten(solution.residuals, seen)
    redundancy = solution.weights.sum() * white.shape[1] - solution.rank()
    sigma0 = float(np.sqrt((solution.weights[:, None] * white**2).sum() / max(redundancy, 1.0)))
    return solution, weighting, 1.0 if free else sigma0, deviations


def _variances(solution: Solution, seen: Observed, weighting: Weighting, options: IdentifyOptions) -> Weighting:
    """σ of each kind of coordinate from its residuals and its share of the redundancy."""
    slope = weighting.whiten(jacobian(solution.state, seen), seen)
    white = weighting.whiten(solution.residuals, seen)
    inverse = solution.inverse()
    part = np.einsum("rwk,kl,rwl->rw", slope, inverse, slope) * solution.weights[:, None]
    left = solution.weights[:, None] * (1 - part)
    square = solution.weights[:, None] * white**2
    mm = slice(-3, None) if white.shape[1] > 1 else slice(None)
    sigma_mm = weighting.sigma_mm * np.sqrt(square[:, mm].sum() / max(left[:, mm].sum(), 1e-3))
    sigma_rad = weighting.sigma_rad
    if white.shape[1] == 6:
        sigma_rad = sigma_rad * np.sqrt(square[:, :3].sum() / max(left[:, :3].sum(), 1e-3))
    least = 1e-9  # data without noise
    return Weighting(options.sigma_mm or max(float(sigma_mm), least), options.sigma_rad or max(float(sigma_rad), least))


def _of_distances(solution: Solution, seen: Observed, weighting: Weighting) -> np.ndarray:
    """Covariance where distances were made of positions, whose noise they share (the sandwich of least squares)."""
    tip = tips(solution.state, seen.data).translation
    apart = tip[seen.first] - tip[seen.second]
    unit = apart / np.linalg.norm(apart, axis=1)[:, None]
    slope = jacobian(solution.state, seen)[:, 0] * solution.weights[:, None] / weighting.sigma_mm**2
    by_position = np.zeros((len(tip), 3, slope.shape[1]))
    pulled = unit[:, :, None] * slope[:, None, :]
    np.add.at(by_position, seen.first, pulled)
    np.add.at(by_position, seen.second, -pulled)
    inverse = solution.inverse()
    middle = np.einsum("mak,mal->kl", by_position, by_position)
    # of the squared residuals' expectation, tr(W D Dᵀ) less what the parameters take up
    left = 2 * solution.weights.sum() - weighting.sigma_mm**2 * np.trace(inverse @ middle)
    square = float((solution.weights * solution.residuals[:, 0] ** 2).sum())
    return square / max(left, 1e-3) * inverse @ middle @ inverse


def _undetermined(solution: Solution, names: list[str], seen: Observed, partial: bool) -> tuple[str, ...]:
    """Parameters along the directions that the data leave open, beyond those that distances never see."""
    _, directions, good = solution.spectrum()
    expected = 6 if seen.kind == "distance" else 0
    open_ones = directions[:, ~good]
    if open_ones.shape[1] <= expected:
        return ()
    strength = (open_ones**2).sum(1)
    found = tuple(names[i] for i in np.argsort(-strength) if strength[i] > 0.1)
    if not partial:
        raise DegenerateError(
            f"{seen.data.where}: the data determine {solution.rank()} of {len(names) - expected} parameters, open are "
            f"{', '.join(found[:6])}; measure more varied poses (`stcal robot design`), or keep the nominal values of "
            "these with --partial"
        )
    return found


def _ranks(state: State, data: Measurements, weighting: Weighting) -> dict[str, int]:
    """Parameters that poses, positions and distances at these joint values determine, whichever were measured."""
    tip = tips(state, data)
    exact = Measurements(data.where, data.lines, data.q, data.targets, tip.translation, tip.rotation)
    weighting = replace(weighting, given=False)
    return {kind: normal_rank(state, observed(exact, kind), weighting) for kind in WIDTH}


def _cross_validated(robot: Robot, seen: Observed, weighting: Weighting, options: IdentifyOptions) -> HeldOut | None:
    """Errors of rows that took no part, each fit begun from the nominal robot."""
    rows = len(seen)
    folds = min(options.folds, rows)
    if folds < 2:
        return None
    repeats = options.repeats or (REPEATS if rows <= FEW_ROWS else 1)
    rng = np.random.default_rng(options.seed)
    position, rotation = np.full((repeats, rows), np.nan), np.full((repeats, rows), np.nan)
    for repeat in range(repeats):
        fold = rng.permutation(np.arange(rows) % folds)
        for k in range(folds):
            train, test = only_of(seen, fold != k), only_of(seen, fold == k)
            if WIDTH[seen.kind] * len(train) <= unknowns(robot.chain(), len(set(train.data.targets)), seen.kind):
                return None
            begin = start(robot, train.data)
            if rows <= FEW_ROWS:  # σ too from these rows alone
                state = _weighted(robot, begin, train, options)[0].state
            else:
                state = solve(begin, train, weighting, options.robust).state
            known = np.array([t in state.tools for t in test.data.targets])
            if seen.kind != "distance":
                test = only_of(test, known)
            found = residuals(state, test)
            place = np.flatnonzero(fold == k)
            place = place[known] if seen.kind != "distance" else place
            position[repeat, place] = _lengths(found)
            if seen.kind == "pose":
                rotation[repeat, place] = np.linalg.norm(found[:, :3], axis=1)
    return HeldOut(folds, position, rotation)


def _dh_sigma(solution: Solution, covariance: np.ndarray, kind: Kind, nominal: Robot) -> np.ndarray:
    """(n, 5) σ of a, alpha, d, theta, beta."""
    slope = dh_slope(solution.state, solution.units, kind, nominal)
    return np.sqrt(np.einsum("njk,kl,njl->nj", slope, covariance, slope).clip(0))


def _change(new: tuple[float, ...], old: tuple[float, ...]) -> float:
    """Largest relative change."""
    return float(np.abs(np.log(np.array(new) / np.array(old))).max())


def _lengths(found: np.ndarray) -> np.ndarray:
    """(r,) position error, mm."""
    return np.linalg.norm(found[:, -3:], axis=1) if found.shape[1] > 1 else np.abs(found[:, 0])
