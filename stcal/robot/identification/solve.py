"""Identification of a robot's kinematics from poses, positions or distances: parameters, σ and held-out error."""

from dataclasses import replace
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.cross_validation import dealt
from stcal.errors import DegenerateError
from stcal.geometry.arrays import require_arguments, rms
from stcal.geometry.clusters import by_clusters
from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.rigid import skew
from stcal.geometry.robust import huber_weights
from stcal.parallel import one_thread
from stcal.robot.identification.adjustment import (
    WIDTH,
    Kind,
    Observed,
    Solution,
    State,
    Weighting,
    huber_limit,
    jacobian,
    normal_rank,
    observed,
    only_of,
    parameter_names,
    parameter_units,
    require_enough,
    residuals,
    solve,
    tips_of,
    unseen,
)
from stcal.robot.identification.consensus import agreeing
from stcal.robot.identification.observability import (
    ObservabilityIndices,
    directions_named,
    doubts,
    parameter_scale,
    predicted,
    widened,
)
from stcal.robot.identification.prior import Deviations, NominalRows, bending, placed
from stcal.robot.identification.result import (
    LEAST_FOLDS,
    Adjustment,
    Gain,
    HeldOutRows,
    Identified,
    IdentifyOptions,
    misgivings,
    position_errors,
)
from stcal.robot.identification.start import start
from stcal.robot.identification.unexplained import left, moved_meanwhile
from stcal.robot.identification.variances import GROSS, Relaxation, components, estimated
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import with_values
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot

LEAST_MM, LEAST_RAD = 1e-3, 1e-6
"""Lower limit of the σ at the start; σ that are not given start at the misfit of the nominal robot."""
TYPICAL_MM, TYPICAL_RAD = 0.1, 5e-4
"""σ of typical instruments, for which it is decided what the joint values determine."""
VARIANCE_ROUNDS = 10
"""Largest number of rounds of estimating σ. Two to four suffice for most data; a robot without noise needs the most."""
VARIANCE_SETTLED, VARIANCE_UNSETTLED = 1e-3, 1e-2
"""Changes of the logarithm of a σ: convergence below the first, a note above the second. A thousandth of a σ is far
below what any data determine."""
FOLD_ROUNDS = 3
"""Number of rounds of estimating the σ without some of the rows, starting from those of all rows."""
FALLS = 0.5
"""Ratio of successive medians of residuals above which they are near enough to start the actual estimation."""
STILL_RAD, STILL_MM = 1e-5, 1e-2
"""Motion, in rad or mm, below which a joint did not move."""
OUTLIER_ROUNDS = 5
"""Largest number of rounds of leaving out gross errors; after 1 to 3 rounds the same ones are left out again."""
MOSTLY_GOOD = 0.5
"""Smallest share of good observations; where fewer would be good, nothing is called an error."""
SAME_DIGITS = 5
"""Decimals, of rad or mm, to which joint values agree that are one place of the robot."""
REPEATED = "joint values were measured several times: what the model lacks there counts once in σ"
MOST_OF_IT = 0.5
"""Share of the squared residuals that a jump along the rows must explain to be named before parameters that stay
open."""
ROUNDED_RAD, BEYOND, BEYOND_MM = 2e-5, 20.0, 0.3
"""Difference of a turn of the tool from that of the robot file, as rounding leaves it; and how many times what it does
across the range of positions these must err, and by how much at least, for the orientations to be computed by the
controller."""
COMPUTED = (
    "orientations are the robot file's, to rounding, and positions are not: the controller computed them. "
    "Positions alone are used, as with --observe position; with --observe pose orientations count as measured"
)
TRY_ELASTIC = "gravity and gears may explain it: --model auto tries whether they predict rows held out better"
REPEATS, FEW_ROWS = 5, 300
"""Number of divisions of the cross-validation for few rows, and largest number of few rows; one division does for
more."""


@require_arguments
@one_thread()
def identify(robot: Robot, data: Measurements, options: IdentifyOptions | None = None) -> Identified:
    """Identify the axes, base and tools of ``robot`` from ``data``.

    The parameters are complete, minimal and continuous (:func:`stcal.robot.kinematics.forward.chain_parameters`). They
    are adjusted by a trust-region method with Huber weights, have a covariance, and are converted back to D-H rows,
    with Hayati's β for nearly parallel axes.

    Parameters
    ----------
    robot : Robot
        The nominal robot: mm, rad. The search starts at it, and dimensions are expected to be near it.
    data : Measurements
        Joint values with the measurements made at them, in the instrument's frame.
    options : IdentifyOptions, optional
        σ, robustness, cross-validation.

    Returns
    -------
    Identified
        The robot with ``world_from_base`` in the instrument's frame, its covariance and errors. Its notes name
        iterations of the σ that did not converge.

    Raises
    ------
    ConvergenceError
        The adjustment reaches no minimum.
    DegenerateError
        A joint or a target never moved, too few observations, or directions that the data do not determine (kept
        nominal with ``partial``).
    InputError
        The nominal robot does not fit the data.

    References
    ----------
    S. A. Hayati, "Robot arm geometric link parameter estimation", IEEE CDC 1983. H. Zhuang, Z. S. Roth, F. Hamano, "A
    complete and parametrically continuous kinematic model for robot manipulators", IEEE Trans. Robotics and Automation
    8, 1992. K. Okamura, F. C. Park, "Kinematic calibration using the product of exponentials formula", Robotica 14,
    1996.
    """
    options = options or IdentifyOptions()
    _still_joints(robot, data, options.partial)
    first = start(robot, data)
    computed = options.observe is None and _turns_as_computed(first, data)
    observations = observed(data, "position" if computed else options.observe)
    rows = NominalRows.about(first, parameter_units(jacobian(first, observations)), robot, options.adjust)
    seeks = len(parameter_names(first, observations.kind)) - unseen(observations.kind) - int(rows.fixed.sum())
    require_enough(observations, seeks, "parameters", "better twice that")
    adjusted, held_out, gain = _modelled(robot, first, observations, options, rows)
    solution, state = adjusted.solution, adjusted.solution.state
    names = parameter_names(state, observations.kind)
    undetermined = _undetermined(solution, names, observations, options.partial)
    full_covariance, rank = _covariance(adjusted, observations), solution.rank() - _place(observations)
    named = slice(len(names))
    covariance = full_covariance[named, named]
    identified = robot_from_chain(state.chain, state.tools, robot)
    prediction, slope = predicted(state, robot, observations, full_covariance), jacobian(state, observations)
    findings = left(state, identified.world_from_base, observations, adjusted.weighting, slope, solution.weights)
    wider, remarks = widened(prediction, findings or ())
    of_arm = any(not each.advice for each in findings or ())
    tested = held_out is not None or options.folds < LEAST_FOLDS
    elasticity_sigma = None
    if state.elastic and state.chain.elasticity is not None:
        template = replace(state.chain.elasticity, hysteresis=np.zeros(len(state.chain)))
        elasticity_sigma = with_values(template, np.sqrt(np.diag(full_covariance))[-state.elastic_count :])
    every = None
    if rows.fixed.any():  # a rigid arm with all dimensions adjusted
        free = replace(robot, joints=tuple(replace(joint, fixed={}) for joint in robot.joints))
        all_rows = NominalRows.about(first, parameter_units(jacobian(first, observations)), free)
        every = _cross_validated(observations, _adjusted(first, observations, options, all_rows), options)
    result = Identified(
        robot=identified,
        nominal=robot,
        seen=observations,
        adjustment=adjusted,
        names=tuple(names),
        covariance=covariance,
        rank=rank,
        ranks=_ranks(state, data),
        undetermined=undetermined,
        nominal_mm=position_errors(residuals(first, observations)),
        held_out=held_out,
        predicted=wider,
        placed=placed(state, observations.kind, covariance, solution.units[named], robot),
        left=findings,
        dh_sigma=adjusted.rows.sigma(identified, covariance),
        observability=_observability(identified, adjusted, observations, rank),
        deviations=adjusted.deviations.of(adjusted.rows.groups),
        elasticity_sigma=elasticity_sigma,
        gain=gain,
        all_held_out=every,
        notes=data.notes
        + ((COMPUTED,) if computed else ())
        + adjusted.rows.notes(identified)
        + adjusted.notes
        + ((REPEATED,) if _places(observations) is not None else ())
        + doubts(prediction, observations, solution.units[named], covariance, names, tested)
        + tuple(each.sentence() for each in findings or ())
        + remarks
        + ((TRY_ELASTIC,) if remarks and of_arm and not state.elastic else ())
        + (data.conditions.ignored("the arm as identified") if identified.elasticity is None else ()),
    )
    return replace(result, notes=result.notes + misgivings(result))


def _modelled(
    robot: Robot, first: State, measured: Observed, options: IdentifyOptions, rows: NominalRows
) -> tuple[Adjustment, HeldOutRows | None, Gain | None]:
    """Returns the adjustment by the requested model, or by the one that predicts better by more than chance; with its
    held-out errors, and the gain if both were tried."""
    rigid = _adjusted(first, measured, options, rows)
    if options.model == "rigid":
        return rigid, _cross_validated(measured, rigid, options), None
    _undetermined(rigid.solution, parameter_names(first, measured.kind), measured, options.partial)
    conditions = measured.data.conditions
    state = bending(rigid.solution.state, robot, rigid.deviations.axis_rad, conditions)
    elasticity, units = state.chain.elasticity, parameter_units(jacobian(state, measured))
    carried = conditions.loaded  # if no row states a load, by the payload of the chain
    if conditions.payload_kg is None:
        carried = elasticity is not None and elasticity.payload_kg > 0
    rows = NominalRows.about(state, units, robot, options.adjust, carried)
    good = rigid.solution.weights >= GROSS
    good |= good.mean() < MOSTLY_GOOD
    elastic = _without_errors(state, measured, good, options, (rows, rigid.weighting, rigid.deviations))
    held_out = [_cross_validated(measured, each, options) for each in (rigid, elastic)]
    if held_out[0] is None or held_out[1] is None:
        return (elastic, None, None) if options.model == "elastic" else (rigid, None, None)
    gain = Gain.between(held_out[0], held_out[1])
    if options.model == "elastic" or gain.beyond_chance:
        return elastic, held_out[1], gain
    return rigid, held_out[0], gain


def _turns_as_computed(first: State, data: Measurements) -> bool:
    """True if the tool turns from row to row exactly as the robot file says, although its positions are elsewhere."""
    if data.rotations is None or data.positions is None:
        return False
    same = np.flatnonzero(np.array(data.targets[1:]) == np.array(data.targets[:-1]))
    measured, modelled = (
        Rotation.from_matrix(np.swapaxes(turn[same], 1, 2) @ turn[same + 1]).magnitude()
        for turn in (data.rotations, tips_of(first, data).rotation)
    )
    turned = rms(measured - modelled) if len(same) else np.inf
    away = rms(position_errors(residuals(first, observed(data, "position"))))
    return turned < ROUNDED_RAD and away > max(BEYOND_MM, BEYOND * turned * float(np.ptp(data.positions, axis=0).max()))


def _still_joints(robot: Robot, data: Measurements, partial: bool) -> None:
    moves = np.ptp(data.q @ robot.coupling.T, axis=0)
    for i, move in enumerate(moves, 1):
        prismatic = robot.joints[i - 1].type == "prismatic"
        if move < (STILL_MM if prismatic else STILL_RAD) and not partial:
            raise DegenerateError(
                "E-IDENTIFY-UNMOVED",
                f"{data.where}: joint {i} never moved, so that its axis is not determined; measure with other values "
                f"of q{i}, or keep its nominal values with --partial",
            )


def _weighting(state: State, measured: Observed, options: IdentifyOptions) -> Weighting:
    """Returns the weighting at the start. If all σ are given, they are weights that σ₀ multiplies; one of two σ is
    exact. σ that are not given start at the misfit, so that no observation is an outlier at first."""
    sigma = {"mm": options.sigma_mm, "rad": options.sigma_rad}
    needed = ("rad", "mm") if measured.kind == "pose" else ("mm",)
    missing = tuple(name for name in needed if sigma[name] is None)
    with_covariances = measured.data.covariance is not None and measured.kind != "distance" and missing == needed
    estimated = ("factor",) if with_covariances or not missing else missing
    weighting = Weighting(
        options.sigma_mm or LEAST_MM, options.sigma_rad or LEAST_RAD, with_covariances, estimated=estimated
    )
    white = weighting.whiten(residuals(state, measured), measured)
    misfit = {name: float(np.median(np.abs(white[:, c]))) for name, c in weighting.columns(white.shape[1]).items()}
    return weighting.with_values({n: weighting.value(n) * max(misfit[n], 1.0) for n in estimated})


def _adjusted(state: State, measured: Observed, options: IdentifyOptions, rows: NominalRows) -> Adjustment:
    """Solves with the observations that agree, and estimates σ."""
    good = np.ones(len(measured), bool)
    if options.robust:
        good = agreeing(state, measured, _weighting(state, measured, options))
        good |= good.mean() < MOSTLY_GOOD
    consistent = measured if good.all() else only_of(measured, good)
    state, weighting = _by_medians(state, consistent, options, rows)
    return _without_errors(state, measured, good, options, (rows, weighting, Deviations()))


Known = tuple[NominalRows, Weighting, Deviations]
"""The nominal dimensions, and the values at which σ of measurements and dimensions start."""


def _without_errors(
    state: State,
    measured: Observed,
    good: np.ndarray,
    options: IdentifyOptions,
    known: Known,
    rounds: int = VARIANCE_ROUNDS,
) -> Adjustment:
    """Solves, removes gross errors, and solves again until their set (``good`` is the first) stays the same. Huber
    weights bound an outlier's pull, but no covariance shows it."""
    for _ in range(OUTLIER_ROUNDS + 1):
        adjustment = _settled(state, measured if good.all() else only_of(measured, good), options, known, rounds)
        if not good.all():
            errors = residuals(adjustment.solution.state, measured)
            length = np.linalg.norm(adjustment.weighting.whiten(errors, measured), axis=1)
            weights = huber_weights(length, huber_limit(measured.kind))
            adjustment = replace(adjustment, solution=replace(adjustment.solution, residuals=errors, weights=weights))
        now_good = adjustment.solution.weights >= GROSS
        if (now_good == good).all() or now_good.mean() < MOSTLY_GOOD:
            return adjustment
        good, state = now_good, adjustment.solution.state
        known = (adjustment.rows, adjustment.weighting, adjustment.deviations)
    note = f"which observations are errors still changes after {OUTLIER_ROUNDS} rounds; look at the outliers"
    return replace(adjustment, notes=(*adjustment.notes, note))


def _by_medians(
    state: State, measured: Observed, options: IdentifyOptions, rows: NominalRows
) -> tuple[State, Weighting]:
    """Returns the state, and σ by medians, which outliers do not move, iterated until they stay."""
    weighting = _weighting(state, measured, options)
    for _ in range(VARIANCE_ROUNDS):
        state = solve(state, measured, weighting, options.robust, rows.held(state, Deviations(), measured.kind)).state
        before, weighting = weighting, _weighting(state, measured, options)
        if all(weighting.value(n) > FALLS * before.value(n) for n in weighting.estimated):
            break
    return state, weighting


def _settled(state: State, measured: Observed, options: IdentifyOptions, known: Known, rounds: int) -> Adjustment:
    """Solves and estimates σ in turns."""
    rows, weighting, deviations = known
    relaxation = Relaxation()
    for _ in range(rounds):
        solution = solve(state, measured, weighting, options.robust, rows.held(state, deviations, measured.kind))
        parts = components(solution, measured, weighting, options.robust, rows, deviations)
        best = parts.best()
        change = float(np.abs(best).max())
        if change < VARIANCE_SETTLED:
            return Adjustment(solution, weighting, deviations, rows, parts)
        state = solution.state
        weighting, deviations = estimated(relaxation.step(best), rows, weighting, deviations)
    note = f"the σ still change by {np.expm1(change):.2%} after {rounds} rounds of estimating them"
    return Adjustment(solution, weighting, deviations, rows, parts, (note,) if change > VARIANCE_UNSETTLED else ())


def _undetermined(solution: Solution, names: list[str], measured: Observed, partial: bool) -> tuple[str, ...]:
    """Returns names of the directions that the data leave open, beyond those that distances never show."""
    _, directions, determined = solution.spectrum()
    expected = unseen(measured.kind)
    if (~determined).sum() <= expected:
        return ()
    open_directions = directions_named(directions[:, ~determined][:, expected:], names)
    if not partial:
        where = measured.data.where
        first = ", ".join(open_directions[:4]) + (" …" if len(open_directions) > 4 else "")
        moved = moved_meanwhile(solution.state, measured, MOST_OF_IT)
        if moved is not None and moved.advice:
            raise DegenerateError(
                "E-IDENTIFY-UNDETERMINED",
                f"{where}: {first} stay open with residuals that no robot leaves; {moved.sentence()}",
            )
        raise DegenerateError(
            "E-IDENTIFY-UNDETERMINED",
            f"{where}: the data determine {solution.rank()} of {len(names) - expected - solution.count} parameters, "
            f"open are {first}; measure more varied poses (`stcal robot design`), or keep the nominal values of these "
            "with --partial",
        )
    return open_directions


def _ranks(state: State, data: Measurements) -> dict[str, int]:
    """Returns how many parameters each kind of measurement at these joint values would determine."""
    tip = tips_of(state, data)
    exact = replace(
        data,
        positions=tip.translation,
        rotations=tip.rotation,
        covariance=None,
        common=None,
        distances=None,
        from_row=None,
    )
    ranks, weighting = {}, Weighting(TYPICAL_MM, TYPICAL_RAD)
    for kind in get_args(Kind):
        seen = observed(exact, kind)
        ranks[kind] = normal_rank(state, seen, weighting) - _place(seen)
    return ranks


def _observability(robot: Robot, adjusted: Adjustment, measured: Observed, rank: int) -> ObservabilityIndices:
    state, weighting = adjusted.solution.state, adjusted.weighting
    scale = parameter_scale(robot, measured.kind, state.tools)
    rows = weighting.whiten(jacobian(state, measured)[:, :, : len(scale)], measured) * scale
    if measured.frameless:  # remove what a motion of all points of a station can produce
        blocks, points = [], measured.data.points()
        for rows_of_station in measured.data.by_station().values():
            lever = (points - points[rows_of_station].mean(0)) * rows_of_station[:, None]
            shift = np.eye(3) * rows_of_station[:, None, None]
            blocks.append(np.concatenate([-skew(lever) / np.linalg.norm(lever), shift], axis=2))
        motions = np.concatenate(blocks, axis=2)
        u, s, _ = np.linalg.svd(weighting.whiten(motions, measured).reshape(-1, motions.shape[2]), full_matrices=False)
        u, flat = u[:, s > 1e-9 * s[0]], rows.reshape(-1, rows.shape[2])
        rows = (flat - u @ (u.T @ flat)).reshape(rows.shape)
    return ObservabilityIndices.of_jacobian(rows, rank)


def _place(measured: Observed) -> int:
    """Returns in how many directions positions that count by distances move together: 6 a station, 5 if on a line."""
    if not measured.frameless:
        return 0
    directions = 0
    for rows in measured.data.by_station().values():
        at = measured.data.points()[rows] - measured.data.points()[rows].mean(0)
        directions += 3 + int(np.linalg.matrix_rank(skew(at).reshape(-1, 3), tol=STILL_MM))
    return directions


def _covariance(adjusted: Adjustment, measured: Observed) -> np.ndarray:
    """Returns the covariance (k, k) of the parameters; 0 along the directions that distances never show."""
    covariance = adjusted.parts.covariance(np.zeros(len(adjusted.parts.least)))
    if measured.kind != "distance":
        return _by_places(covariance, adjusted, measured)
    units = adjusted.solution.units
    blind = adjusted.solution.spectrum()[1][:, : unseen(measured.kind)]
    blind = np.pad(blind, ((0, len(units) - len(blind)), (0, 0)))
    projector = (np.eye(len(units)) - blind @ blind.T) * units[:, None] / units
    return projector @ covariance @ projector.T


def _places(measured: Observed) -> np.ndarray | None:
    """Returns the number (r,) of the joint values of each row; None if no values are repeated, and for distances."""
    rows = np.round(measured.data.q, SAME_DIGITS)
    first, place = np.unique(rows, axis=0, return_inverse=True)
    return None if measured.kind == "distance" or len(first) == len(rows) else place.ravel()


def _by_places(covariance: np.ndarray, adjusted: Adjustment, measured: Observed) -> np.ndarray:
    """Returns the covariance where joint values were measured several times: what the model lacks there is one error,
    not several."""
    place = _places(measured)
    if place is None:
        return covariance
    solution, whiten = adjusted.solution, adjusted.weighting.whiten
    sigma, root = np.sqrt(np.diag(covariance)), np.sqrt(solution.weights)[:, None]
    slope = root[..., None] * whiten(jacobian(solution.state, measured), measured) * sigma
    information, pull = blocks_of(slope, root * whiten(solution.residuals, measured), place, place.max() + 1)
    clusters = by_clusters(np.linalg.inv(covariance / sigma[:, None] / sigma), pull, information)
    return covariance + (clusters.covariance - clusters.independent) * sigma[:, None] * sigma


def _cross_validated(measured: Observed, whole: Adjustment, options: IdentifyOptions) -> HeldOutRows | None:
    """Returns errors of rows that took no part in the parameters; None if too few. If few, they do not count for σ and
    gross errors either. Iterations start at the solution of all rows."""
    rows = len(measured)
    if min(options.folds, rows) < LEAST_FOLDS:
        return None
    repeats = options.repeats or (REPEATS if rows <= FEW_ROWS else 1)
    rng = np.random.default_rng(options.seed)
    position, rotation = np.full((repeats, rows), np.nan), np.full((repeats, rows), np.nan)
    good, begin = whole.solution.weights >= GROSS, (whole.rows, whole.weighting, whole.deviations)
    good |= good.mean() < MOSTLY_GOOD
    for repeat in range(repeats):
        for test_rows in dealt(rows, options.folds, rng):
            train_rows = np.setdiff1d(np.arange(rows), test_rows)
            train, test = only_of(measured, train_rows), only_of(measured, test_rows)
            state = _of_targets(whole.solution.state, train)
            seeks = len(parameter_names(state, measured.kind)) - unseen(measured.kind) - whole.solution.count
            if WIDTH[measured.kind] * len(train) <= seeks:
                return None
            if rows <= FEW_ROWS:
                state = _without_errors(state, train, good[train_rows], options, begin, FOLD_ROUNDS).solution.state
            else:
                held = whole.rows.held(state, whole.deviations, measured.kind)
                state = solve(state, train, whole.weighting, options.robust, held).state
            if measured.kind != "distance":
                named = zip(test.data.targets, test.data.stations, strict=True)
                known = np.array([target in state.tools and station in state.stations for target, station in named])
                test, test_rows = only_of(test, known), test_rows[known]
            errors = residuals(state, test)
            position[repeat, test_rows] = position_errors(errors)
            if measured.kind == "pose":
                rotation[repeat, test_rows] = np.linalg.norm(errors[:, :3], axis=1)
    return HeldOutRows(min(options.folds, rows), position, rotation)


def _of_targets(state: State, measured: Observed) -> State:
    """Returns the state with the tools and stations that ``measured`` shows, and the first station."""
    tools = {name: tool for name, tool in state.tools.items() if name in measured.data.targets}
    first = next(iter(state.stations))
    stations = {name: each for name, each in state.stations.items() if name in {first, *measured.data.stations}}
    return replace(state, tools=tools, stations=stations)
