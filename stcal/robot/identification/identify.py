"""Identification of a robot's kinematics from poses, positions or distances: parameters, σ and held-out error."""

from dataclasses import replace
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.cross_validation import dealt
from stcal.errors import DegenerateError
from stcal.geometry.arrays import require_arguments, rms
from stcal.geometry.rigid import skew
from stcal.parallel import one_thread
from stcal.robot.identification.adjustment import (
    UNSEEN,
    WIDTH,
    Kind,
    ObservabilityIndices,
    Observed,
    State,
    Weighting,
    frame_motions,
    observed,
    parameter_scale,
    parameter_units,
    position_errors,
)
from stcal.robot.identification.prior import NominalRows, bending, placed
from stcal.robot.identification.problem import GROSS, MOSTLY_GOOD, ArmProblem, ArmSolution, agreeing, mostly, relaxed
from stcal.robot.identification.result import (
    LEAST_FOLDS,
    Gain,
    HeldOutRows,
    Identified,
    IdentifyOptions,
    Predicted,
    directions_named,
    remarks,
)
from stcal.robot.identification.start import start
from stcal.robot.identification.unexplained import left, moved_meanwhile
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot

LEAST_MM, LEAST_RAD = 1e-3, 1e-6
"""Lower limit of the σ at the start; σ that are not given start at the misfit of the nominal robot."""
TYPICAL = Weighting(0.1, 5e-4)  # σ of typical instruments, for which it is decided what the joint values determine
VARIANCE_ROUNDS = 10
"""Largest number of rounds of estimating σ. Two to four suffice for most data; a robot without noise needs the most."""
VARIANCE_SETTLED, VARIANCE_UNSETTLED = 1e-3, 1e-2
"""Changes of the logarithm of a σ: convergence below the first, a note above the second."""
FOLD_ROUNDS = 3  # number of rounds of estimating the σ without some of the rows, starting from those of all rows
FALLS = 0.5  # ratio of successive medians of residuals above which they are near enough to start the actual estimation
STILL_RAD, STILL_MM = 1e-5, 1e-2  # motion, in rad or mm, below which a joint did not move
OUTLIER_ROUNDS = 5
"""Largest number of rounds of leaving out gross errors; after 1 to 3 rounds the same ones are left out again."""
MOST_OF_IT = 0.5
"""Share of the squared residuals that a jump along the rows must explain to be named before open parameters."""
ROUNDED_RAD, BEYOND, BEYOND_MM = 2e-5, 20.0, 0.3
"""Difference of the turns of the tool from those of the robot file by rounding; and how many times what it does across
the positions these must err, and by how much at least, for the controller to have computed the orientations."""
REPEATS, FEW_ROWS = 5, 300
"""Number of divisions of the cross-validation for few rows, and largest number of few rows; more are divided once."""


@require_arguments
@one_thread()
def identify(robot: Robot, data: Measurements, options: IdentifyOptions | None = None) -> Identified:
    """Identify the axes, base and tools of ``robot`` from ``data``.

    The parameters are complete, minimal and continuous (:meth:`stcal.robot.kinematics.robot_model.Chain.parameters`).
    They are adjusted by a trust-region method with Huber weights, have a covariance, and are converted back to D-H
    rows, with Hayati's β for nearly parallel axes.

    Parameters
    ----------
    robot : the nominal robot: mm, rad. The search starts at it, and dimensions are expected to be near it.
    data : joint values with the measurements made at them, in the instrument's frame.
    options : σ, robustness, cross-validation.

    Returns
    -------
    Identified : the robot with ``world_from_base`` in the instrument's frame, its covariance and errors. Its notes name
        iterations of the σ that did not converge.

    Raises
    ------
    ConvergenceError : the adjustment reaches no minimum.
    DegenerateError : a joint or a target never moved, too few observations, or directions that the data do not
        determine (kept nominal with ``partial``).
    InputError : the nominal robot does not fit the data.

    References
    ----------
    S. A. Hayati, "Robot arm geometric link parameter estimation", IEEE CDC 1983. H. Zhuang, Z. S. Roth, F. Hamano, "A
    complete and parametrically continuous kinematic model for robot manipulators", IEEE Trans. Robotics and Automation
    8, 1992. K. Okamura, F. C. Park, "Kinematic calibration using the product of exponentials formula", Robotica 14,
    1996.
    """
    options = options or IdentifyOptions()
    moves = np.ptp(data.q @ robot.coupling.T, axis=0)
    still = np.flatnonzero(moves < np.where(robot.prismatic, STILL_MM, STILL_RAD)) + 1
    if len(still) and not options.partial:
        fault = f"{data.where}: joint {still[0]} never moved, so that its axis is not determined"
        remedy = f"measure with other values of q{still[0]}, or keep its nominal values with --partial"
        raise DegenerateError("E-IDENTIFY-UNMOVED", f"{fault}; {remedy}")
    first = start(robot, data)
    computed = options.observe is None and _turns_as_computed(first, data)
    seen = observed(data, "position" if computed else options.observe)
    units = parameter_units(first.jacobian(seen))
    rows, names = NominalRows.about(first, units, robot, options.adjust), first.parameter_names(seen.kind)
    seeks = len(names) - UNSEEN[seen.kind] - int(rows.fixed.sum())
    seen.require_more_than(seeks, "parameters", "better twice that")
    solution, held_out, gain = _modelled(robot, first, seen, options, rows)
    state, rows, k = solution.state, solution.rows, len(names)
    undetermined = _undetermined(solution, names, options.partial)
    covariance, rank = solution.covariance(), solution.rank() - _place(seen)
    identified = robot_from_chain(state.chain, state.tools, robot)
    findings = left(state, identified.world_from_base, seen, solution.problem.weighting, weights=solution.weights)
    elasticity_sigma = None
    if state.elastic and state.chain.elasticity is not None:
        template = replace(state.chain.elasticity, hysteresis=np.zeros(len(state.chain)))
        elasticity_sigma = template.with_values(np.sqrt(np.diag(covariance))[-state.elastic_count :])
    every = None
    if rows.fixed.any():  # a rigid arm with all dimensions adjusted
        free = replace(robot, joints=tuple(replace(joint, fixed={}) for joint in robot.joints))
        every = _cross_validated(_adjusted(first, seen, options, NominalRows.about(first, units, free)), options)
    result = Identified(
        robot=identified,
        nominal=robot,
        seen=seen,
        adjustment=solution,
        names=tuple(names),
        covariance=covariance[:k, :k],
        rank=rank,
        ranks=_ranks(state, data),
        undetermined=undetermined,
        nominal_mm=position_errors(first.residuals(seen)),
        held_out=held_out,
        predicted=Predicted.of(state, robot, seen, covariance, findings or ()),
        placed=placed(state, seen.kind, covariance[:k, :k], solution.units[:k], robot),
        left=findings,
        dh_sigma=rows.sigma(identified, covariance),
        observability=_observability(identified, solution, rank),
        deviations=solution.problem.deviations.of(rows.groups),
        elasticity_sigma=elasticity_sigma,
        gain=gain,
        all_held_out=every,
    )
    return replace(result, notes=remarks(result, held_out is not None or options.folds < LEAST_FOLDS, computed))


def _modelled(
    robot: Robot, first: State, seen: Observed, options: IdentifyOptions, rows: NominalRows
) -> tuple[ArmSolution, HeldOutRows | None, Gain | None]:
    """Returns the solution by the model asked for, or by the better one, with its held-out errors, and the gain."""
    rigid = _adjusted(first, seen, options, rows)
    if options.model == "rigid":
        return rigid, _cross_validated(rigid, options), None
    _undetermined(rigid, first.parameter_names(seen.kind), options.partial)
    conditions, deviations = seen.data.conditions, rigid.problem.deviations
    state = bending(rigid.state, robot, deviations.axis_rad, conditions)
    elasticity, units = state.chain.elasticity, parameter_units(state.jacobian(seen))
    carried = conditions.loaded  # if no row states a load, by the payload of the chain
    if conditions.payload_kg is None:
        carried = elasticity is not None and elasticity.payload_kg > 0
    rows = NominalRows.about(state, units, robot, options.adjust, carried)
    elastic = _without_errors(replace(rigid.problem, rows=rows), state, mostly(rigid.weights >= GROSS))
    by_rigid, by_elastic = (_cross_validated(each, options) for each in (rigid, elastic))
    gain = Gain.between(by_rigid, by_elastic) if by_rigid and by_elastic else None
    if options.model == "elastic" or (gain is not None and gain.beyond_chance):
        return elastic, by_elastic if gain else None, gain
    return rigid, by_rigid if gain else None, gain


def _turns_as_computed(first: State, data: Measurements) -> bool:
    """True if the tool turns from row to row exactly as the robot file says, although its positions are elsewhere."""
    if data.rotations is None or data.positions is None:
        return False
    same = np.flatnonzero(np.array(data.targets[1:]) == np.array(data.targets[:-1]))
    both = (np.swapaxes(turn[same], 1, 2) @ turn[same + 1] for turn in (data.rotations, first.tips_of(data).rotation))
    measured, modelled = (Rotation.from_matrix(turns).magnitude() for turns in both)
    turned = rms(measured - modelled) if len(same) else np.inf
    away = rms(position_errors(first.residuals(observed(data, "position"))))
    return turned < ROUNDED_RAD and away > max(BEYOND_MM, BEYOND * turned * float(np.ptp(data.positions, axis=0).max()))


def _weighting(state: State, seen: Observed, options: IdentifyOptions) -> Weighting:
    """Returns the weighting at the start: by stated σ times σ₀; σ that are not given start at the misfit."""
    sigma = {"mm": options.sigma_mm, "rad": options.sigma_rad}
    needed = ("rad", "mm") if seen.kind == "pose" else ("mm",)
    missing = tuple(name for name in needed if sigma[name] is None)
    with_covariances = seen.data.covariance is not None and seen.kind != "distance" and missing == needed
    estimated = ("factor",) if with_covariances or not missing else missing
    least = options.sigma_mm or LEAST_MM, options.sigma_rad or LEAST_RAD
    weighting = Weighting(*least, with_covariances, estimated=estimated)
    misfit = weighting.medians(weighting.whiten(state.residuals(seen), seen))
    return weighting.with_values({n: weighting.value(n) * max(misfit[n], 1.0) for n in estimated})


def _adjusted(state: State, seen: Observed, options: IdentifyOptions, rows: NominalRows) -> ArmSolution:
    """Solves with the observations that agree, and estimates σ: at first by medians, which outliers do not move."""
    problem = ArmProblem(seen, _weighting(state, seen, options), options.robust, rows)
    good = np.ones(len(seen), bool)
    if options.robust:
        good = mostly(agreeing(problem, state))
    some = problem.of(good).measured
    weighting = _weighting(state, some, options)
    for _ in range(VARIANCE_ROUNDS):
        state = replace(problem, measured=some, weighting=weighting).solve(state).state
        before, weighting = weighting, _weighting(state, some, options)
        if all(weighting.value(n) > FALLS * before.value(n) for n in weighting.estimated):
            break
    return _without_errors(replace(problem, weighting=weighting), state, good)


def _without_errors(problem: ArmProblem, state: State, good: np.ndarray, rounds: int = VARIANCE_ROUNDS) -> ArmSolution:
    """Solves and removes gross errors until their set stays the same: no covariance shows a bounded outlier's pull."""
    for _ in range(OUTLIER_ROUNDS + 1):
        solution = _settled(problem.of(good), state, rounds)
        if not good.all():
            solution = solution.among(problem.measured)
        now_good = solution.weights >= GROSS
        if (now_good == good).all() or now_good.mean() < MOSTLY_GOOD:
            return solution
        good, state, problem = now_good, solution.state, solution.problem
    note = f"which observations are errors still changes after {OUTLIER_ROUNDS} rounds; look at the outliers"
    return replace(solution, notes=(*solution.notes, note))


def _settled(problem: ArmProblem, state: State, rounds: int) -> ArmSolution:
    """Solves and estimates σ in turns."""
    last, share = None, 1.0
    for _ in range(rounds):
        solution = problem.solve(state)
        solution = replace(solution, spread=(spread := solution.estimated()))
        best = spread.best()
        change = float(np.abs(best).max())
        if change < VARIANCE_SETTLED:
            return solution
        last, share = best, 1.0 if last is None else relaxed(best, last, share)
        state, problem = solution.state, problem.scaled(share * best)
    note = f"the σ still change by {np.expm1(change):.2%} after {rounds} rounds of estimating them"
    return replace(solution, problem=problem, notes=(note,) if change > VARIANCE_UNSETTLED else ())


def _undetermined(solution: ArmSolution, names: list[str], partial: bool) -> tuple[str, ...]:
    """Returns names of the directions that the data leave open, beyond those that distances never show."""
    measured, (_, directions, determined) = solution.problem.measured, solution.spectrum()
    expected = UNSEEN[measured.kind]
    if (~determined).sum() <= expected:
        return ()
    open_directions = directions_named(directions[:, ~determined][:, expected:], names)
    if partial:
        return open_directions
    first = ", ".join(open_directions[:4]) + (" …" if len(open_directions) > 4 else "")
    moved = moved_meanwhile(solution.state, measured, MOST_OF_IT)
    fault = f"the data determine {solution.rank()} of {solution.seeks()} parameters, open are {first}"
    remedy = "measure more varied poses (`stcal robot design`), or keep the nominal values of these with --partial"
    if moved is not None and moved.advice:
        fault, remedy = f"{first} stay open with residuals that no robot leaves", moved.sentence()
    raise DegenerateError("E-IDENTIFY-UNDETERMINED", f"{measured.data.where}: {fault}; {remedy}")


def _ranks(state: State, data: Measurements) -> dict[str, int]:
    """Returns how many parameters each kind of measurement at these joint values would determine."""
    tip, none = state.tips_of(data), {"covariance": None, "common": None, "distances": None, "from_row": None}
    exact = replace(data, positions=tip.translation, rotations=tip.rotation, **none)
    seen = {kind: observed(exact, kind) for kind in get_args(Kind)}
    return {kind: ArmProblem(own, TYPICAL, robust=False).at(state).rank() - _place(own) for kind, own in seen.items()}


def _observability(robot: Robot, solution: ArmSolution, rank: int) -> ObservabilityIndices:
    state, weighting, measured = solution.state, solution.problem.weighting, solution.problem.measured
    scale = parameter_scale(robot, measured.kind, state.tools)
    rows = weighting.whiten(state.jacobian(measured)[:, :, : len(scale)], measured) * scale
    if measured.frameless:  # remove what a motion of all points of a station can produce
        points, stations = measured.data.points(), measured.data.by_station().values()
        moves = [frame_motions(points, points[own].mean(0))[:, 3:] * own[:, None, None] for own in stations]
        motions = weighting.whiten(np.concatenate(moves, axis=2), measured).reshape(rows.shape[0] * rows.shape[1], -1)
        flat = rows.reshape(len(motions), -1)
        rows = (flat - motions @ np.linalg.lstsq(motions, flat, rcond=1e-9)[0]).reshape(rows.shape)
    return ObservabilityIndices.of_jacobian(rows, rank)


def _place(measured: Observed) -> int:
    """Returns in how many directions positions that count by distances move together: 6 a station, 5 if on a line."""
    if not measured.frameless:
        return 0
    points = [measured.data.points()[rows] for rows in measured.data.by_station().values()]
    turns = [skew(at - at.mean(0)).reshape(-1, 3) for at in points]
    return sum(3 + int(np.linalg.matrix_rank(each, tol=STILL_MM)) for each in turns)


def _cross_validated(whole: ArmSolution, options: IdentifyOptions) -> HeldOutRows | None:
    """Returns errors of rows that took no part in the parameters, if few not in σ either; None if too few."""
    problem, measured = whole.problem, whole.problem.measured
    rows = len(measured)
    if min(options.folds, rows) < LEAST_FOLDS:
        return None
    few = rows <= FEW_ROWS
    repeats = options.repeats or (REPEATS if few else 1)
    rng, good = np.random.default_rng(options.seed), mostly(whole.weights >= GROSS)
    position, rotation = np.full((repeats, rows), np.nan), np.full((repeats, rows), np.nan)
    for repeat in range(repeats):
        for test_rows in dealt(rows, options.folds, rng):
            train_rows = np.setdiff1d(np.arange(rows), test_rows)
            train, test = replace(problem, measured=measured[train_rows]), measured[test_rows]
            state = whole.state.of(train.measured.data)
            if WIDTH[measured.kind] * len(train_rows) <= replace(whole, state=state).seeks():
                return None
            found = _without_errors(train, state, good[train_rows], FOLD_ROUNDS) if few else train.solve(state)
            state = found.state
            if measured.kind != "distance":
                named = zip(test.data.targets, test.data.stations, strict=True)
                known = np.array([target in state.tools and station in state.stations for target, station in named])
                test, test_rows = test[known], test_rows[known]
            errors = state.residuals(test)
            position[repeat, test_rows] = position_errors(errors)
            if measured.kind == "pose":
                rotation[repeat, test_rows] = np.linalg.norm(errors[:, :3], axis=1)
    return HeldOutRows(min(options.folds, rows), position, rotation)
