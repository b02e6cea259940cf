"""The identification of an arm as one problem: least squares, what the data determine, and the σ of data and robot.

Components are the σ of the measurements and of the robot's dimensions about nominal. About the solution everything is
linear, so that for any σ the parameters and the likelihood of the σ (restricted maximum likelihood, Patterson &
Thompson 1971) are closed forms of a few k × k matrices. The covariance of the parameters is the mean, over the
posterior of the σ, of their covariance at these σ and of the square of their shift (Kass & Steffey 1989), by
Gauss-Hermite quadrature about the maximum. It exceeds the covariance with σ taken as known as a t distribution exceeds
a normal one.
"""

from dataclasses import astuple, dataclass, field, replace
from functools import partial
from itertools import compress

import numpy as np
from scipy.linalg import eigh
from scipy.special import chdtr, chdtrc, chdtri

from stcal.adjust.blocks import Components, Equations
from stcal.geometry.clusters import by_clusters
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.robust import huber_cost, huber_weights, length_limit, ratio_limit
from stcal.robot.identification.adjustment import UNSEEN, WIDTH, Kind, Observed, State, Weighting, parameter_units
from stcal.robot.identification.prior import ACROSS, AXIS, DOUBT, MOMENT, Deviations, NominalRows

MAX_STEPS = 100
SETTLED = 1e-10  # relative decrease of the cost below which the descent has converged
HUBER_LEVEL = 0.999  # probability that an observation without a gross error has full weight; one in a thousand has less
USELESS_MM = 50.0
"""Largest σ of a determined direction (1 mm, or the rotation that moves the tool by 1 mm). Beyond it the nominal value
is better. All parameters are held to their start by this σ, which determined directions do not feel."""
ACCEPTED, ACCEPTED_ELASTIC = 1e-4, 0.05
"""Largest predicted decrease of the cost, in σ², accepted after the last step, for rigid and elastic arms."""
MOST_BENT = 2 / 3
"""Largest share of the curvature that second derivatives may take away: flatter valleys have two minima."""
ROUNDING = 1e-13
"""Relative error by rounding in the square root of a normal matrix with unit diagonal and some hundred parameters."""
NEAR, NEAR_STEPS = 1.0, 50
"""Largest predicted decrease of a step, in σ², for which second derivatives are good, and largest number of steps
without them before: used from afar they may lead to a compliance and a moment that both have the wrong sign."""
STAYS_MM = 1e-3  # σ, in mm, that fixes a movement which the observations never show
LEAST_GAIN, LEAST_ELASTIC = 1e-9, 1e-3
"""Decrease of the cost, in σ², below which a descent ends, for rigid and for elastic arms. Measurements without noise
still gain the first by rounding; the second moves no parameter by more than 0.03 σ."""
LEAST = 1e-9  # smallest σ, in mm or rad: that of data without noise
FARTHEST, NEAREST = 3.0, 0.7
"""Largest change of log σ in a round; the second of compliances, whose products with moments are nonlinear."""
QUIETER = -2.5
"""Second start of the search for log σ of the data: few data may be explained by noise alone, or by dimensions."""
GROSS = 0.5
"""Weight below which an observation is a gross error, and does not count for σ: normal errors are never so large."""
MOSTLY_GOOD = 0.5  # smallest share of good observations; where fewer would be good, nothing is called an error
NODES, NODE_WEIGHTS = np.sqrt(3.0) * np.array([0.0, -1.0, 1.0]), np.array([4.0, 1.0, 1.0]) / 6
"""Points and weights of three-point Gauss-Hermite quadrature for a standard normal distribution."""
MOST_PRODUCT = 5  # largest number of dimensions for the product rule: 243 points; rigid arms have no more
SHORTEST = 0.1
"""Smallest share of a step of the σ: two steps that lead back and forth by chance must not stop the iteration."""
STEP = 1e-4  # step of the second derivatives, in log σ
SAME_DIGITS = 5  # decimals, of rad or mm, to which joint values agree that are one place of the robot

Away = tuple[State, np.ndarray]  # a state, and the sum of the steps (k,) that led to it


def huber_limit(kind: Kind) -> float:
    """Returns the length of an observation's whitened residual beyond which it weighs less."""
    return length_limit(WIDTH[kind], 1 - HUBER_LEVEL)


def mostly(good: np.ndarray) -> np.ndarray:
    """Returns the mask (r,) of good rows; all rows, where it holds too few."""
    return good | (good.mean() < MOSTLY_GOOD)


@dataclass(frozen=True, slots=True, eq=False)
class ArmProblem:
    """Observations of an arm with their σ, and what is known of the arm before.

    ``rows`` : its nominal dimensions, which it has to within ``deviations``; None if nothing is known; ``robust`` :
    whether outliers weigh less (Huber). Parameters are small motions about a state, so that none is singular.
    """

    measured: Observed
    weighting: Weighting
    robust: bool = True
    rows: NominalRows | None = None
    deviations: Deviations = field(default_factory=Deviations)

    def of(self, good: np.ndarray) -> "ArmProblem":
        """Returns the problem of the rows of a mask (r,) alone."""
        return self if good.all() else replace(self, measured=self.measured[good])

    def scaled(self, change: np.ndarray) -> "ArmProblem":
        """Returns the problem after a ``change`` (p,) of the logarithms of its σ: of measurements, then dimensions."""
        assert self.rows is not None
        of_data, of_robot = np.split(change, [len(self.weighting.estimated)])
        sigma = np.array(astuple(self.deviations))
        sigma[np.intersect1d(self.rows.groups, np.arange(len(sigma)))] *= np.exp(of_robot)
        return replace(self, weighting=self.weighting.scaled(of_data), deviations=Deviations(*sigma.tolist()))

    def at(self, state: State) -> "ArmSolution":
        """Returns the observations alone, linearised about a state."""
        errors, derivative = state.linear(self.measured)
        white, slope = (self.weighting.whiten(each, self.measured) for each in (errors, derivative))
        cost, weights = self._cost(white)
        flat = slope.reshape(-1, slope.shape[2])
        weighted = flat * np.repeat(weights, white.shape[1])[:, None]
        equations = NormalEquations(cost, weighted.T @ flat, -weighted.T @ white.ravel())
        return ArmSolution(self, state, errors, weights, equations, parameter_units(derivative))

    def _cost(self, white: np.ndarray) -> tuple[float, np.ndarray]:
        """Returns the cost of whitened residuals (r, w), and their Huber weights (r,)."""
        length = np.linalg.norm(white, axis=1)
        limit = huber_limit(self.measured.kind) if self.robust else np.inf
        return float(huber_cost(length, limit).sum()), huber_weights(length, limit)

    def solve(self, state: State) -> "ArmSolution":
        """Returns the state of least cost, from a start about which priors are linear; raises ConvergenceError."""
        measured, first = self.measured, self.at(state)
        _, directions, determined = first.spectrum()
        fixed = np.pad(directions[:, ~determined], ((0, state.elastic_count), (0, 0)))
        fixed = np.eye(len(fixed)) / USELESS_MM**2 + fixed @ fixed.T / STAYS_MM**2
        hold = fixed / first.units[:, None] / first.units  # along undetermined directions valleys bend, lead far
        pull = np.zeros(len(hold))
        if self.rows is not None:
            held, slope, _ = self.rows.held(state, self.deviations, measured.kind)
            hold, pull = hold + slope.T @ slope, slope.T @ held  # half the gradient of the squares

        def kept(away: np.ndarray) -> NormalEquations:
            return NormalEquations(float(away @ (hold @ away + 2 * pull)), hold, hold @ away + pull)

        def linearise(at: Away, bends: bool) -> NormalEquations:
            fit = self.at(at[0])
            straight, curved = fit.equations + kept(at[1]), fit.curvature() if bends else None
            if curved is None:
                return straight
            directions, share = bent(straight.normal, curved)
            along = straight.normal @ directions
            return replace(straight, normal=straight.normal - (along * share) @ along.T)

        def cost(at: Away) -> float:
            return self._cost(self.weighting.whiten(at[0].residuals(measured), measured))[0] + float(kept(at[1]).cost)

        def later(at: Away, step: np.ndarray) -> Away:
            return at[0].moved(step, measured.kind), at[1] + step

        begin: Away = state, np.zeros(len(hold))
        descents = [(False, NEAR, NEAR_STEPS), (True, LEAST_ELASTIC, MAX_STEPS)]
        for bends, gain, most in descents if state.elastic else [(False, LEAST_GAIN, MAX_STEPS)]:
            equations = partial(linearise, bends=bends)
            fit = minimise(begin, equations, later, cost, settled=SETTLED, least_gain=gain, max_steps=most)
            begin = fit.state
        accepted = ACCEPTED_ELASTIC if state.elastic else ACCEPTED
        fit.required(f"{measured.data.where}: identification", "check the robot file and the outliers", accepted)
        return self.at(begin[0])


@dataclass(frozen=True, slots=True, eq=False)
class ArmSolution:
    """A problem linearised about a state.

    ``residuals`` : (r, w) rad, mm; ``weights`` : (r,) Huber weights; ``equations`` : of the observations alone,
    whitened and weighted; ``units`` : (k,) factors that make each parameter a movement of the tool of about 1 mm;
    ``spread`` : the σ about the solution, where they were estimated; ``notes`` : on iterations that did not converge.
    """

    problem: ArmProblem
    state: State
    residuals: np.ndarray
    weights: np.ndarray
    equations: NormalEquations
    units: np.ndarray
    spread: "Spread | None" = None
    notes: tuple[str, ...] = ()

    def spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns eigenvalues (j,), directions (j, j) in columns, and a mask of determined ones, without elasticity;
        dimensions that are not adjusted count as determined."""
        problem, rigid = self.problem, slice(len(self.units) - self.state.elastic_count)
        known, units = self.equations.normal[rigid, rigid], self.units[rigid]
        if problem.rows is not None:
            _, slope, fixed = problem.rows.held(self.state, problem.deviations, problem.measured.kind)
            known = known + slope[fixed, rigid].T @ slope[fixed, rigid]
        values, directions = np.linalg.eigh(known * units[:, None] * units)
        return values, directions, values > 1 / USELESS_MM**2

    def rank(self) -> int:
        """Returns the number of directions that the data determine."""
        return int(self.spectrum()[2].sum()) - self.fixed_count

    @property
    def fixed_count(self) -> int:
        """Number of dimensions that are not adjusted."""
        return 0 if self.problem.rows is None else int(self.problem.rows.fixed.sum())

    def seeks(self) -> int:
        """Returns the number of parameters that observations of this kind could determine, without conditions."""
        kind = self.problem.measured.kind
        return len(self.state.parameter_names(kind)) - UNSEEN[kind] - self.fixed_count

    def among(self, measured: Observed) -> "ArmSolution":
        """Returns the solution beside all observations, of which those of the problem are a part."""
        errors = self.state.residuals(measured)
        length = np.linalg.norm(self.problem.weighting.whiten(errors, measured), axis=1)
        weights = huber_weights(length, huber_limit(measured.kind))
        return replace(self, problem=replace(self.problem, measured=measured), residuals=errors, weights=weights)

    def curvature(self) -> np.ndarray | None:
        """Returns what second derivatives take from the normal matrix (k, k); None for rigid arms and distances."""
        state, measured, weighting = self.state, self.problem.measured, self.problem.weighting
        if not state.elastic or measured.kind == "distance":
            return None
        white = self.weights[:, None] * weighting.whiten(self.residuals, measured)
        elastic = state.curvature(measured, weighting.pull(white, measured))
        begin, rest = len(self.units) - state.elastic_count, state.elastic_count - len(elastic)
        return np.pad(elastic, (begin, rest))

    def estimated(self) -> "Spread":
        """Returns what tells the σ, linear about the solution: of the data where σ is sought, then of dimensions."""
        problem, measured, weighting, rows = self.problem, self.problem.measured, self.problem.weighting, self.rows
        white = weighting.whiten(self.residuals, measured)
        derivative = weighting.whiten(self.state.jacobian(measured), measured) * self.units
        width, limit = white.shape[1], huber_limit(measured.kind) ** 2
        # Share of the square of normal residuals below Huber's limit (Huber's Proposal 2).
        share = float(chdtr(width + 2, limit) + limit / width * chdtrc(width, limit)) if problem.robust else 1.0
        honest = mostly(self.weights >= GROSS)
        # σ scales the square of the residual cut off at Huber's limit, (w e)²; the rest of w e² does not depend on σ.
        scaled = self.weights**2 * honest

        def linear_of(columns: slice, weight: np.ndarray) -> Equations:
            root = np.sqrt(weight)[:, None]
            flat = -(root[..., None] * derivative[:, columns]).reshape(-1, derivative.shape[2])
            return Equations.of((root * white[:, columns]).ravel(), flat)

        parts = []
        fixed = replace(Equations.nothing(len(self.units)), normal=np.eye(len(self.units)) / USELESS_MM**2)
        for name, columns in weighting.columns(width).items():
            sought = scaled if name in weighting.estimated else np.zeros(len(scaled))
            fixed = fixed + linear_of(columns, self.weights - sought)
            if name in weighting.estimated:
                equations = replace(linear_of(columns, scaled), count=share * white[honest, columns].size)
                parts.append((equations, 0.0, np.inf, max(np.log(LEAST / weighting.value(name)), -FARTHEST), FARTHEST))
        e, j, _ = rows.held(self.state, problem.deviations, measured.kind)
        j, group = j * self.units, rows.groups
        fixed = fixed + Equations.of(e[group >= MOMENT], j[group >= MOMENT])
        for g, (sigma, expected) in enumerate(zip(astuple(problem.deviations), astuple(Deviations()), strict=True)):
            if (own := group == g).any():
                far = NEAREST if g in (AXIS, ACROSS) else FARTHEST
                parts.append((Equations.of(e[own], j[own]), np.log(expected / sigma), DOUBT, -far, far))
        each, *numbers = zip(*parts, strict=True)
        expected, doubt, least, most = (np.array(values, float) for values in numbers)
        curved = self.curvature()
        if curved is not None:
            # At the minimum the data pull as much as held and fixed parts hold; this changes with the σ of these parts.
            each, holds = [*each, fixed], [*np.isfinite(doubt), True]
            holding = np.sum([own.normal for own in compress(each, holds)], axis=0)
            directions, share = bent(holding, curved * self.units[:, None] * self.units)
            bends = (directions * np.sqrt(1 - share)) @ directions.T @ holding
            for i in np.flatnonzero(holds):
                each[i] = replace(each[i], normal=bends.T @ each[i].normal @ bends)
            *each, fixed = each
        return Spread(Components(each, fixed, expected, doubt), least, most, self.units)

    @property
    def rows(self) -> NominalRows:
        """The nominal dimensions."""
        assert self.problem.rows is not None
        return self.problem.rows

    def covariance(self) -> np.ndarray:
        """Returns the covariance (k, k) of the parameters; 0 along the directions that distances never show. Where the
        same joint values were measured several times, the model errs once."""
        assert self.spread is not None
        covariance = self.spread.covariance()
        measured, whiten, k = self.problem.measured, self.problem.weighting.whiten, len(self.units)
        if measured.kind == "distance":
            blind = self.spectrum()[1][:, : UNSEEN["distance"]]
            blind = np.pad(blind, ((0, k - len(blind)), (0, 0)))
            projector = (np.eye(k) - blind @ blind.T) * self.units[:, None] / self.units
            return projector @ covariance @ projector.T
        if (place := self.places()) is None:
            return covariance
        sigma, root = np.sqrt(np.diag(covariance)), np.sqrt(self.weights)[:, None]
        slope = root[..., None] * whiten(self.state.jacobian(measured), measured) * sigma
        information, pull = blocks_of(slope, root * whiten(self.residuals, measured), place, place.max() + 1)
        clusters = by_clusters(np.linalg.inv(covariance / sigma[:, None] / sigma), pull, information)
        return covariance + (clusters.covariance - clusters.independent) * sigma[:, None] * sigma

    def places(self) -> np.ndarray | None:
        """Returns the number (r,) of the joint values of each row; None if none are repeated, and for distances."""
        rows = np.round(self.problem.measured.data.q, SAME_DIGITS)
        first, place = np.unique(rows, axis=0, return_inverse=True)
        return None if self.problem.measured.kind == "distance" or len(first) == len(rows) else place.ravel()


def bent(normal: np.ndarray, curved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns directions (k, k), in columns that are orthonormal in the metric of a normal matrix (k, k), and the share
    (k,) of each, at most :data:`MOST_BENT`, that second derivatives ``curved`` (k, k) take from it."""
    scale = np.sqrt(np.diag(normal))
    unit = normal / scale[:, None] / scale + ROUNDING * np.eye(len(scale))
    share, directions = eigh(curved / scale[:, None] / scale, unit)
    return directions / scale[:, None], np.minimum(share, MOST_BENT)


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Components of a solution, linear about it, in ``units`` (k,) of its parameters. Those of the data come first,
    then the groups of the robot's dimensions. ``least``, ``most`` : (p,) limits of log (σ / present σ)."""

    parts: Components
    least: np.ndarray
    most: np.ndarray
    units: np.ndarray

    def best(self) -> np.ndarray:
        """Returns log (σ / present σ) (p,) of highest posterior density."""
        data = np.isinf(self.parts.doubt)
        starts = (np.zeros(len(data)), np.where(data, QUIETER, self.parts.expected))
        return self.parts.best(self.least, self.most, starts)

    def covariance(self) -> np.ndarray:
        """Returns the covariance (k, k) of the parameters about the estimate at the present σ, by a product rule, or by
        a cubature (Arasaratnam & Haykin 2009), over the log σ that are above their lower limit."""
        free = np.flatnonzero(self.least < -STEP)
        moves, f = STEP * np.eye(len(self.least))[free], len(free)
        points = np.concatenate([moves, -moves])
        gradient = np.array([self.parts.at(x)[1] for x in points]).reshape(points.shape)
        hessian = (gradient[:f] - gradient[f:])[:, free] / (2 * STEP)
        values, directions = np.linalg.eigh(-(hessian + hessian.T) / 2)
        # a flat or rising direction is at most as wide as the prior
        values = np.maximum(values, np.min(self.parts.doubt, initial=1.0) ** -2.0)
        root = np.zeros((len(self.least), f))
        root[free] = directions / np.sqrt(values)
        if f > MOST_PRODUCT:
            z, rule = np.sqrt(f) * np.vstack([np.eye(f), -np.eye(f)]), np.full(2 * f, 0.5 / f)
        else:
            index = np.indices((len(NODES),) * f).reshape(f, len(NODES) ** f).T
            z, rule = NODES[index], NODE_WEIGHTS[index].prod(1)
        log_density, _, step, inverse = map(np.array, zip(*map(self.parts.at, z @ root.T), strict=True))
        middle = self.parts.at(np.zeros(len(self.least)))
        log_weight = np.log(rule) + log_density - middle[0] + 0.5 * (z**2).sum(1)
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        shift = step - middle[2]
        mean = np.einsum("m,mkl->kl", weight, inverse) + (shift.T * weight) @ shift
        return mean * self.units[:, None] * self.units


def relaxed(wanted: np.ndarray, last: np.ndarray, share: float) -> float:
    """Returns the share to take of a ``wanted`` step (p,) of an iteration that may overshoot, by how it agrees with the
    ``last`` one, of which ``share`` was taken (Aitken's Δ² of vectors, Irons & Tuck 1969)."""
    turned = wanted - last
    falls = -float(last @ turned)  # if this is not positive, there is no sign of overshooting
    return float(np.clip(share * falls / max(float(turned @ turned), 1e-300), SHORTEST, 1.0)) if falls > 0 else 1.0


SUBSETS, SEED = 1000, 0
"""Number of random subsets, and seed. With a quarter of 40 rows wrong, one in forty is clean."""
KEPT_SUBSETS, FIRST_STEPS, STEPS = 20, 2, 50
"""Number of subsets that are followed to their end, and of concentration steps before and after their choice."""
MOST_ROWS = 400  # largest number of rows that are searched; of more a random sample is, with the same share of errors
HELD = 1e-4  # information on each parameter (of 1 mm) about its start, in units of that of one observation
FALSE_ALARM = 1e-3  # false-alarm probability of a set: that any row of a good set is called wrong
TINY = 1e-300
ROUNDS, SEARCHES = 6, 2
"""Number of linear solutions, the third of which is practically exact, and of searches, the second by better σ."""


def agreeing(problem: ArmProblem, state: State) -> np.ndarray:
    """Returns a mask (r,) of the observations that agree with a solution near ``state``, linear about it; all agree if
    too few are redundant. Their σ need only be known up to a common factor. Where few rows bend a solution with Huber's
    weights, least trimmed squares (Rousseeuw 1984) seeks the one whose better half fits best, by concentration steps
    (Rousseeuw & Van Driessen 2006); rows unlikely by it are errors."""
    measured, weighting = problem.measured, problem.weighting
    good = every = np.ones(len(measured), bool)
    for step in range(ROUNDS):
        errors, derivative = state.linear(measured)
        units = parameter_units(derivative)
        if step:
            medians = weighting.medians(weighting.whiten(errors, measured))
            weighting = weighting.with_values({n: weighting.value(n) * (value or 1.0) for n, value in medians.items()})
        rows = _LinearRows(weighting.whiten(errors, measured), weighting.whiten(derivative * units, measured))
        r, w, k = rows.slope.shape
        half = (r + k // w + 1) // 2 + 1
        if half >= r:
            return every
        before, searched = good, step < SEARCHES
        begin = rows.trimmed(half) if searched else good
        good = rows.tested(begin, half if searched else None, list(weighting.columns(w).values()))
        state = state.moved(units * rows.solved(good[None])[0], measured.kind)
        if not searched and (good == before).all():
            break
    return good


@dataclass(frozen=True, slots=True, eq=False)
class _LinearRows:
    """``white`` : (r, w) residuals over σ; ``slope`` : (r, w, k) derivatives by parameters of about 1 mm."""

    white: np.ndarray
    slope: np.ndarray

    def solved(self, masks: np.ndarray) -> np.ndarray:
        """Returns the steps (s, k) that solve the rows of each mask (s, r)."""
        r, _, k = self.slope.shape
        normal = np.einsum("rwa,rwb->rab", self.slope, self.slope).reshape(r, k * k)
        pull = np.einsum("rwa,rw->ra", self.slope, self.white)
        share = masks.astype(float)
        information = (share @ normal).reshape(-1, k, k) + HELD * np.eye(k)
        return np.linalg.solve(information, (share @ pull)[:, :, None])[:, :, 0]

    def squares(self, steps: np.ndarray) -> np.ndarray:
        """Returns the squares (s, r, w) of the residuals after steps (s, k)."""
        r, w, k = self.slope.shape
        return (self.white.ravel() - steps @ self.slope.reshape(r * w, k).T).reshape(-1, r, w) ** 2

    def trimmed(self, half: int) -> np.ndarray:
        """Returns a mask (r,) of the rows of the best half."""
        rng, count = np.random.default_rng(SEED), len(self.white)
        rows = np.sort(rng.permutation(count)[:MOST_ROWS])
        sample = _LinearRows(self.white[rows], self.slope[rows])
        r, w, k = sample.slope.shape
        wanted = half * r // count

        def smallest(squares: np.ndarray, number: int) -> np.ndarray:
            """Returns masks (s, r) of the smallest values in each row."""
            masks = np.zeros(squares.shape, bool)
            np.put_along_axis(masks, squares.argpartition(number - 1, axis=1)[:, :number], True, axis=1)
            return masks

        steps = sample.solved(smallest(rng.random((SUBSETS, r)), k // w + 1))
        cost, last = np.zeros(0), np.inf
        for step in range(FIRST_STEPS + STEPS):
            squares = sample.squares(steps).sum(2)
            if step >= FIRST_STEPS:
                cost = np.sort(squares, axis=1)[:, :wanted].sum(1)
                if step == FIRST_STEPS:
                    best = np.argsort(cost)[:KEPT_SUBSETS]
                    steps, squares, cost = steps[best], squares[best], cost[best]
                if cost.sum() >= last * (1 - 1e-9):
                    break
                last = cost.sum()
            steps = sample.solved(smallest(squares, wanted))
        return smallest(self.squares(steps[[cost.argmin()]]).sum(2), half)[0]

    def tested(self, good: np.ndarray, half: int | None, kinds: list[slice]) -> np.ndarray:
        """Returns the rows that fit the solution of the good rows within chance, repeated. ``half`` : number of good
        rows if they are the smallest; ``kinds`` : columns with one σ each, estimated from the good rows."""
        r, w, k = self.slope.shape
        for _ in range(STEPS):
            squares = self.squares(self.solved(good[None]))[0]
            slopes = self.slope[good].reshape(-1, k)
            inverse = np.linalg.inv(slopes.T @ slopes + HELD * np.eye(k))
            leverage = ((self.slope @ inverse) * self.slope).sum(2)  # variance of a row's prediction, in σ²
            redundancy = w * good.sum() - leverage[good].sum()
            if redundancy < 1:
                return np.ones(r, bool)
            share = 1.0
            if half is not None:  # mean square of so many smallest ones, in σ²
                limit = chdtri(w, 1 - half / r)
                share, half = chdtr(w + 2, limit) / (half / r), None
            length = np.zeros(r)
            for columns in kinds:
                left_over = max(squares[good, columns].size - leverage[good, columns].sum(), 1.0)
                variance = max(squares[good, columns].sum(), TINY) / left_over / share
                lever = leverage[:, columns].mean(1)
                length += squares[:, columns].sum(1) / variance / np.where(good, np.maximum(1 - lever, 1e-3), 1 + lever)
            new = length <= w * ratio_limit(FALSE_ALARM / r, w, redundancy)
            if (new == good).all():
                break
            good = new
        return good
