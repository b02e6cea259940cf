"""Residuals of measurements about a robot, their derivatives by the minimal parameters, and robust least squares over
these; it separates determined from undetermined directions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from stcal.errors import DegenerateError, InputError
from stcal.geometry.least_squares import Minimum, NormalEquations, minimise
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.geometry.robust import huber_cost, huber_weights, length_limit
from stcal.io.covariance import TWIST
from stcal.robot.kinematics.conditions import USUAL, Conditions
from stcal.robot.kinematics.forward import (
    carried_poses,
    chain_jacobian,
    chain_parameters,
    elasticity_curvature,
    elasticity_jacobian,
    elasticity_values,
    moved_chain,
    with_values,
)
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Chain

Kind = Literal["pose", "position", "distance"]
WIDTH = {"pose": 6, "position": 3, "distance": 1}


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """The unknowns. ``tools`` : flange_from_tool by target; ``elastic`` : whether the chain's elasticity is among them,
    last; ``stations`` : station_from_world, the first is the world; ``hysteresis`` : whether elasticity includes it."""

    chain: Chain
    tools: dict[str, Rigid]
    elastic: bool = False
    stations: dict[str, Rigid] = field(default_factory=lambda: {"": Rigid()})
    hysteresis: bool = False

    @property
    def elastic_count(self) -> int:
        """Number of parameters of the elasticity."""
        return (10 if self.hysteresis else 9) * len(self.chain) if self.elastic else 0


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Measurements as one kind of observation. ``first``, ``second`` : (r,) rows of each observation, different for
    distances only; ``values`` : (r,) distances, mm, else empty. ``frameless`` : positions that count by their distances
    alone, and are therefore in a frame of their own, whose pose is identified but not counted."""

    kind: Kind
    data: Measurements
    first: np.ndarray
    second: np.ndarray
    values: np.ndarray
    frameless: bool = False

    def __len__(self) -> int:
        return len(self.first)

    @property
    def lines(self) -> list[int]:
        """Lines (r,) of the file."""
        return [int(self.data.lines[row]) for row in self.first]

    @property
    def used(self) -> Kind:
        """Kind of observation for which the measurements are used."""
        return "distance" if self.frameless else self.kind


def tool_width(kind: Kind) -> int:
    """Returns the number of parameters of each tool; orientation is seen in poses only."""
    return 6 if kind == "pose" else 3


def observed(data: Measurements, kind: Kind | None = None) -> Observed:
    """Returns the measurements as ``kind``, or the richest that they hold; raises InputError if they do not hold it."""
    richest = "distance" if data.distances is not None else "position" if data.rotations is None else "pose"
    kind = kind or richest
    if WIDTH[kind] > WIDTH[richest]:
        raise InputError("E-MEASURED-KIND", f"{data.where}: {richest}s were measured; they do not give {kind}s")
    rows, none = np.arange(len(data)), np.zeros(0)
    if kind != "distance":
        return Observed(kind, data, rows, rows, none)
    if richest == "distance":
        distances, from_row = data.lengths()
        real = rows[from_row != rows]
        return Observed(kind, data, real, from_row[real], distances[real])
    return Observed("position", data, rows, rows, none, frameless=True)


def parameter_names(state: State, kind: Kind) -> list[str]:
    """Returns the names of the parameters without elasticity: ``J2 rx`` … of the axes, ``tool x`` … of the tools, and
    ``station B rx`` … of stations but the first; r in rad, the others in mm."""
    names = [f"J{i + 1} {TWIST[c]}" for i, c in chain_parameters(state.chain)]
    names += [f"{f'tool {name}'.rstrip()} {c}" for name in state.tools for c in TWIST[-tool_width(kind) :]]
    return names + [f"station {name} {c}" for name in list(state.stations)[1:] for c in TWIST]


def tips(state: State, q: np.ndarray, targets: Sequence[str], conditions: Conditions = USUAL) -> Poses:
    """Returns world_from_tool at joint vectors (m, n), with the tool and the load of each."""
    place = {name: i for i, name in enumerate(state.tools)}
    tool = Poses.of(state.tools.values())
    return carried_poses(state.chain, q, targets, conditions) @ tool[[place[t] for t in targets]]


def tips_of(state: State, data: Measurements) -> Poses:
    """Returns world_from_tool of m measurements."""
    return tips(state, data.q, data.targets, data.conditions)


def residuals(state: State, measured: Observed) -> np.ndarray:
    """Returns measured minus modelled values, (r, 6), (r, 3) or (r, 1): rad and mm in the axes of the row's station."""
    return _beside(state, tips_of(state, measured.data), measured)


def jacobian(state: State, measured: Observed) -> np.ndarray:
    """Returns the derivative (r, 6 or 3 or 1, k) of the modelled values by :func:`parameter_names` and elasticity."""
    return linear(state, measured)[1]


def linear(state: State, measured: Observed) -> tuple[np.ndarray, np.ndarray]:
    """Returns :func:`residuals` and :func:`jacobian`."""
    tip, full = tip_jacobian(state, measured.data.q, measured.data.targets, measured.kind, measured.data.conditions)
    if len(state.stations) > 1:
        full, names = full.copy(), np.array(measured.data.stations)
        offset = len(parameter_names(state, measured.kind)) - 6 * (len(state.stations) - 1)
        for s, name in enumerate(list(state.stations)[1:]):
            full[names == name, :, offset + 6 * s : offset + 6 * s + 6] = frame_motions(tip[names == name], np.zeros(3))
    return _beside(state, tip, measured), as_seen(state, measured, tip, full)


def curvature(state: State, measured: Observed, pull: np.ndarray) -> np.ndarray:
    """Returns the second derivative (9 n, 9 n), by compliances and moments, of the sum of ``pull`` times the model."""
    tip, data = tips_of(state, measured.data), measured.data
    moves = as_seen(state, measured, tip, np.broadcast_to(np.eye(6), (len(tip), 6, 6)))
    pulls = np.einsum("rw,rwk->rk", pull, moves)
    return elasticity_curvature(state.chain, data.q, tip, data.targets, pulls, data.conditions)


def as_seen(state: State, measured: Observed, tip: Poses, moves: np.ndarray) -> np.ndarray:
    """Returns the effect (r, 6 or 3 or 1, k), in the station's axes, of motions (m, 6, k) of the tools, rad over mm."""
    if len(state.stations) > 1:
        turn = _stations(state, measured.data.stations).rotation[:, None]
        moves = (turn @ moves.reshape(len(moves), 2, 3, -1)).reshape(moves.shape)
    if measured.kind == "pose":
        return moves
    if measured.kind == "position":
        return moves[:, 3:]
    apart = tip.translation[measured.first] - tip.translation[measured.second]
    unit = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-12)[:, None]
    return np.einsum("ri,rik->rk", unit, moves[measured.first, 3:] - moves[measured.second, 3:])[:, None]


def _stations(state: State, names: Sequence[str]) -> Poses:
    """Returns station_from_world of each row."""
    place = {name: i for i, name in enumerate(state.stations)}
    return Poses.of(state.stations.values())[[place[name] for name in names]]


def frame_motions(tip: Poses, centre: np.ndarray) -> np.ndarray:
    """Returns the motions (m, 6, 6) of the tools with the world, by its small rotations about ``centre`` and shifts."""
    moves = np.zeros((len(tip), 6, 6))
    moves[:, :3, :3] = moves[:, 3:, 3:] = np.eye(3)
    moves[:, 3:, :3] = -skew(tip.translation - centre)
    return moves


def tool_motions(tip: Poses, targets: Sequence[str], tool: str, kind: Kind) -> np.ndarray:
    """Returns the motions (m, 6, 6 or 3) of the tools by small motions of one of them on its flange."""
    moves = np.zeros((len(tip), 6, 6))
    moves[:, :3, :3] = moves[:, 3:, 3:] = tip.rotation
    moves *= np.array([name == tool for name in targets])[:, None, None]
    return moves[..., -tool_width(kind) :]


def _beside(state: State, tip: Poses, measured: Observed) -> np.ndarray:
    """Returns measured minus modelled values for the poses ``tip`` (m,) of the tools."""
    if len(state.stations) > 1:
        tip = _stations(state, measured.data.stations) @ tip
    if measured.kind == "pose":
        return measured.data.poses().difference(tip)
    if measured.kind == "position":
        return measured.data.points() - tip.translation
    apart = tip.translation[measured.first] - tip.translation[measured.second]
    return (measured.values - np.linalg.norm(apart, axis=1))[:, None]


def tip_jacobian(
    state: State, q: np.ndarray, targets: Sequence[str], kind: Kind, conditions: Conditions = USUAL
) -> tuple[Poses, np.ndarray]:
    """Returns world_from_tool at joint vectors (m, n), and its derivative (m, 6, k) by all parameters, rad over mm."""
    tip = tips(state, q, targets, conditions)
    axes_part = chain_jacobian(state.chain, q, tip, conditions)
    if state.chain.grown is not None:
        joint = [i for i, _ in chain_parameters(state.chain)]
        axes_part = axes_part * state.chain.carries(targets)[joint].T[:, None]
    parts = [axes_part, *(tool_motions(tip, targets, name, kind) for name in state.tools)]
    parts.append(np.zeros((len(tip), 6, 6 * (len(state.stations) - 1))))
    if state.elastic:
        parts.append(elasticity_jacobian(state.chain, q, tip, targets, conditions, state.hysteresis))
    return tip, np.concatenate(parts, axis=2)


def moved(state: State, step: np.ndarray, kind: Kind) -> State:
    """Returns the state after small motions along the parameters, (k,)."""
    k = len(chain_parameters(state.chain))
    width = tool_width(kind)
    tools = {}
    for t, (name, tool) in enumerate(state.tools.items()):
        tool_step = step[k + width * t : k + width * (t + 1)]
        tools[name] = tool @ Rigid.exp(tool_step if width == 6 else [0, 0, 0, *tool_step])
    stations, k = dict(state.stations), k + width * len(tools)
    for s, name in enumerate(list(stations)[1:]):
        stations[name] = stations[name] @ Rigid.exp(step[k + 6 * s : k + 6 * s + 6])
    chain = moved_chain(state.chain, step[: len(chain_parameters(state.chain))])
    if state.elastic and chain.elasticity is not None:
        values = elasticity_values(chain.elasticity, state.hysteresis) + step[-state.elastic_count :]
        chain = replace(chain, elasticity=with_values(chain.elasticity, values))
    return replace(state, chain=chain, tools=tools, stations=stations)


def only_of(measured: Observed, keep: np.ndarray) -> Observed:
    """Returns the observations at the indices, or of the mask (r,), ``keep``."""
    if measured.kind == "distance":
        return replace(
            measured,
            first=measured.first[keep],
            second=measured.second[keep],
            values=measured.values[keep],
        )
    data = measured.data[keep]
    rows = np.arange(len(data))
    return replace(measured, data=data, first=rows, second=rows)


MAX_STEPS = 100
SETTLED = 1e-10
"""Relative decrease of the cost below which the descent has converged."""
HUBER_LEVEL = 0.999
"""Probability that an observation without a gross error has full weight; one in a thousand has less."""
USELESS_MM = 50.0
"""Largest σ of a determined direction (1 mm, or the rotation that moves the tool by 1 mm). Beyond it the nominal value
is better. All parameters are held to their start by this σ, which determined directions do not feel."""
ACCEPTED = 1e-4
"""Largest predicted decrease of the cost, in σ², that is accepted when a descent has used up its steps. Along a flat
direction Huber weights halve every step, so that steps are many and short."""
ACCEPTED_ELASTIC = 0.05
"""The same for elastic arms, whose valleys are curved: 0.2 σ of a hardly determined parameter."""
MOST_BENT = 2 / 3
"""Largest share of the curvature along a direction that second derivatives may take away; variances become three times
as large. Flatter valleys have two minima, and the curvature at one minimum does not describe the other."""
ROUNDING = 1e-13
"""Relative error by rounding in the square root of a normal matrix with unit diagonal and some hundred parameters."""
NEAR, NEAR_STEPS = 1.0, 50
"""Largest predicted decrease of a step, in σ², for which second derivatives are good, and largest number of steps
without them before. Second derivatives used from afar may lead to a state where compliance and moment both have the
wrong sign. Steps without them are many along curved valleys, and need not converge."""
STAYS_MM = 1e-3
"""σ, in mm, that fixes a movement which the observations never show."""
LEAST_GAIN, LEAST_ELASTIC = 1e-9, 1e-3
"""Decrease of the cost, in σ², below which a descent ends, for rigid and for elastic arms. Measurements without noise
still gain the first by rounding. The second moves no parameter by more than 0.03 σ: it is not worth a step along the
curved valleys of products of compliance and moment."""


@dataclass(frozen=True, slots=True)
class Weighting:
    """Weights of the observations. ``given`` : the measurements' covariances replace both σ; ``factor`` : multiplies
    either; ``estimated`` : which of ``"mm"``, ``"rad"``, ``"factor"`` come from the residuals."""

    sigma_mm: float
    sigma_rad: float
    given: bool = False
    factor: float = 1.0
    estimated: tuple[str, ...] = ()

    def whiten(self, values: np.ndarray, measured: Observed) -> np.ndarray:
        """Returns residuals (r, w) or derivatives (r, w, k) of ``measured`` in units of σ."""
        flat = values.ndim == 2
        values = values[..., None] if flat else values
        width = values.shape[1]
        if self.given and width > 1:
            root = self._root(measured, width)
            values = _decorrelated(np.linalg.solve(root, values), root, measured)
        else:
            values = values / self._sigma(width)[:, None]
        return values[..., 0] if flat else values

    def pull(self, white: np.ndarray, measured: Observed) -> np.ndarray:
        """Returns half the derivative (r, w) by the residuals of the square sum of ``white``, from :meth:`whiten`."""
        width = white.shape[1]
        if not (self.given and width > 1):
            return white / self._sigma(width)
        root = self._root(measured, width)
        white = _decorrelated(white[..., None], root, measured)
        return np.linalg.solve(np.swapaxes(root, 1, 2), white)[..., 0]

    def _sigma(self, width: int) -> np.ndarray:
        """Returns σ (width,) of the coordinates."""
        return self.factor * np.array([self.sigma_rad] * 3 + [self.sigma_mm] * 3)[-width:]

    def _root(self, measured: Observed, width: int) -> np.ndarray:
        """Returns the roots (r, width, width) of the covariances that came with the measurements, times ``factor``."""
        return self.factor * np.linalg.cholesky(measured.data.own_covariance()[:, -width:, -width:])

    def columns(self, width: int) -> dict[str, slice]:
        """Returns the columns among the ``width`` coordinates to which each σ belongs."""
        if "factor" in self.estimated:
            return {"factor": slice(None)}
        return {"rad": slice(0, 3), "mm": slice(3, 6)} if width == 6 else {"mm": slice(None)}

    def value(self, name: str) -> float:
        """Returns the value of σ ``name``."""
        return {"mm": self.sigma_mm, "rad": self.sigma_rad, "factor": self.factor}[name]

    def with_values(self, found: Mapping[str, float]) -> "Weighting":
        """Returns the weighting with the σ ``found`` in place of its own."""
        new = {name: found.get(name, self.value(name)) for name in ("mm", "rad", "factor")}
        return replace(self, sigma_mm=new["mm"], sigma_rad=new["rad"], factor=new["factor"])


def _decorrelated(values: np.ndarray, root: np.ndarray, measured: Observed) -> np.ndarray:
    """Returns values (r, w, k) of σ 1 times the inverse root of 1 + F Fᵀ, F being the common errors over ``root``."""
    if measured.data.common is None:
        return values
    common = np.linalg.solve(root, measured.data.common[:, -root.shape[1] :])
    f = common.reshape(-1, common.shape[2])
    size, directions = np.linalg.eigh(f.T @ f)
    size, directions = size[size > 0], directions[:, size > 0]
    u = f @ directions / np.sqrt(size)
    flat = values.reshape(len(f), -1)
    return (flat - u * (1 - 1 / np.sqrt(1 + size)) @ (u.T @ flat)).reshape(values.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Prior knowledge: ``value + jacobian @ step``, (p,), is 0 with ``sigma``; ``fixed`` : (p,) mask of conditions."""

    value: np.ndarray
    jacobian: np.ndarray
    sigma: np.ndarray
    fixed: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """An adjusted state with its normal equations. ``residuals`` : (r, w) rad, mm; ``weights`` : (r,) Huber weights;
    ``normal`` : (k, k) normal matrix of the observations alone, whitened and weighted; ``units`` : (k,) factors that
    make each parameter a movement of the tool of about 1 mm; ``cost`` : Huber cost; ``prior`` : (k, k) normal matrix of
    the prior knowledge; ``conditions`` : (k, k) normal matrix of the conditions; ``count`` : number of conditions."""

    state: State
    residuals: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    units: np.ndarray
    cost: float
    prior: np.ndarray
    conditions: np.ndarray
    count: int = 0

    def spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns eigenvalues (j,) and directions (j, j), in columns, of the normal matrix with conditions, over axes
        and tools, and a mask (j,) of determined ones. Elasticity is left out, as there is prior knowledge of it."""
        rigid = slice(len(self.units) - self.state.elastic_count)
        known = self.normal[rigid, rigid] + self.conditions[rigid, rigid]
        values, directions = np.linalg.eigh(known * self.units[rigid, None] * self.units[rigid])
        return values, directions, values > 1 / USELESS_MM**2

    def rank(self) -> int:
        """Returns the number of directions that the data determine."""
        return int(self.spectrum()[2].sum()) - self.count

    def inverse(self) -> np.ndarray:
        """Returns the covariance (k, k) of the parameters at unit weight."""
        scaled = (self.normal + self.prior) * self.units[:, None] * self.units
        return np.linalg.inv(scaled) * self.units[:, None] * self.units


Away = tuple[State, np.ndarray]
"""A state, and the sum of the steps (k,) that led to it."""


def solve(
    state: State, measured: Observed, weighting: Weighting, robust: bool = True, held: Held | None = None
) -> Solution:
    """Minimises the whitened residuals from ``state``, about which ``held`` is linear. Parameters are small motions
    about the present state, so that none is singular. Raises ConvergenceError."""
    limit = huber_limit(measured.kind) if robust else np.inf
    first = _linearised(state, measured, weighting, limit)[0]
    held_normal, pull = np.zeros_like(first.normal), np.zeros(len(first.units))
    conditions, count = np.zeros_like(first.normal), 0
    if held is not None:
        weighted = held.jacobian.T / held.sigma**2
        held_normal, pull = weighted @ held.jacobian, weighted @ held.value  # half the gradient of the squares
        fixed = held.jacobian[held.fixed] / held.sigma[held.fixed, None]
        conditions, count = fixed.T @ fixed, len(fixed)
    _, directions, determined = replace(first, conditions=conditions).spectrum()
    prior = held_normal + _fixed(first, directions[:, : unseen(measured.kind)])
    hold = held_normal + _fixed(first, directions[:, ~determined])  # along undetermined ones valleys bend, and lead far

    def kept(away: np.ndarray) -> NormalEquations:
        return NormalEquations(float(away @ (hold @ away + 2 * pull)), hold, hold @ away + pull)

    def linearise(at: Away, bends: bool) -> NormalEquations:
        fit, gradient = _linearised(at[0], measured, weighting, limit)
        straight = NormalEquations(fit.cost, fit.normal, gradient) + kept(at[1])
        curved = curvature_of(fit, measured, weighting) if bends else None
        if curved is None:
            return straight
        return replace(straight, normal=straight.normal - Bent.of(straight.normal, curved).taken())

    def cost(at: Away) -> float:
        white = weighting.whiten(residuals(at[0], measured), measured)
        return float(huber_cost(np.linalg.norm(white, axis=1), limit).sum() + kept(at[1]).cost)

    def descended(begin: Away, bends: bool, least_gain: float, max_steps: int) -> Minimum[Away, NormalEquations]:
        return minimise(
            begin,
            partial(linearise, bends=bends),
            lambda at, step: (moved(at[0], step, measured.kind), at[1] + step),
            cost=cost,
            settled=SETTLED,
            least_gain=least_gain,
            max_steps=max_steps,
        )

    begin = state, np.zeros(len(hold))
    if state.elastic:
        near = descended(begin, False, NEAR, NEAR_STEPS).state
        fit, accepted = descended(near, True, LEAST_ELASTIC, MAX_STEPS), ACCEPTED_ELASTIC
    else:
        fit, accepted = descended(begin, False, LEAST_GAIN, MAX_STEPS), ACCEPTED
    fit.required(f"{measured.data.where}: identification", "check the robot file and the outliers", accepted)
    solution = _linearised(fit.state[0], measured, weighting, limit)[0]
    return replace(solution, prior=prior, conditions=conditions, count=count)


def curvature_of(solution: Solution, measured: Observed, weighting: Weighting) -> np.ndarray | None:
    """Returns the part (k, k) of the normal matrix that second derivatives by compliance and moment subtract: without
    it descents take hundreds of steps. None for rigid arms and distances."""
    if not solution.state.elastic or measured.kind == "distance":
        return None
    white = solution.weights[:, None] * weighting.whiten(solution.residuals, measured)
    elastic = curvature(solution.state, measured, weighting.pull(white, measured))
    k, count = len(solution.units), solution.state.elastic_count
    taken = np.zeros((k, k))
    place = slice(k - count, k - count + len(elastic))
    taken[place, place] = elastic
    return taken


@dataclass(frozen=True, slots=True, eq=False)
class Bent:
    """Shares, at most :data:`MOST_BENT`, of a normal matrix (k, k) with this ``root`` that second derivatives take
    away: ``share`` : (k,) of each of ``directions`` (k, k), columns that are independent in the matrix's metric."""

    root: np.ndarray
    directions: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, normal: np.ndarray, curved: np.ndarray) -> "Bent":
        """Returns the shares for ``curved`` (k, k), all that second derivatives take."""
        scale = np.sqrt(np.diag(normal))
        unit = normal / scale[:, None] / scale + ROUNDING * np.eye(len(scale))
        root = scale[:, None] * np.linalg.cholesky(unit)
        half = solve_triangular(root, curved, lower=True)
        share, directions = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
        return cls(root, directions, np.minimum(share, MOST_BENT))

    def taken(self) -> np.ndarray:
        """Returns what is taken from the normal matrix, (k, k)."""
        along = self.root @ self.directions
        return (along * self.share) @ along.T

    def bends(self) -> np.ndarray:
        """Returns B (k, k): Bᵀ N B is what is left of the normal matrix N."""
        wider = (self.directions * np.sqrt(1 - self.share)) @ self.directions.T
        return solve_triangular(self.root, wider @ self.root.T, lower=True, trans=1)


def require_enough(measured: Observed, seeks: int, what: str, advice: str) -> None:
    """Refuses observations that give no more numbers than ``seeks`` parameters."""
    numbers, width = WIDTH[measured.kind] * len(measured), WIDTH[measured.kind]
    if numbers <= seeks:
        raise DegenerateError(
            "E-IDENTIFY-FEW",
            f"{measured.data.where}: {len(measured)} {measured.kind}s give {numbers} numbers for {seeks} {what}; "
            f"{seeks // width + 1} or more needed, {advice}",
        )


def unseen(kind: Kind) -> int:
    """Returns the number of directions that this kind of observation never shows: those of the instrument's place."""
    return 6 if kind == "distance" else 0


def _fixed(solution: Solution, directions: np.ndarray) -> np.ndarray:
    """Returns the normal matrix (k, k) that holds parameters at their start: weakly, but firmly along ``directions``
    (j, d)."""
    padded = np.pad(directions, ((0, solution.state.elastic_count), (0, 0)))
    fixed = np.eye(len(padded)) / USELESS_MM**2 + padded @ padded.T / STAYS_MM**2
    return fixed / solution.units[:, None] / solution.units


def huber_limit(kind: Kind) -> float:
    """Returns the length of an observation's whitened residual beyond which it weighs less."""
    return length_limit(WIDTH[kind], 1 - HUBER_LEVEL)


def normal_rank(state: State, measured: Observed, weighting: Weighting) -> int:
    """Returns how many parameters these observations determine, at the state where they would be exact."""
    return _linearised(state, measured, weighting, np.inf)[0].rank()


def _linearised(state: State, measured: Observed, weighting: Weighting, limit: float) -> tuple[Solution, np.ndarray]:
    """Returns the state with its normal matrix, and half the gradient (k,) of the cost."""
    errors, derivative = linear(state, measured)
    units = parameter_units(derivative)
    white, whitened = weighting.whiten(errors, measured), weighting.whiten(derivative, measured)
    weights = huber_weights(np.linalg.norm(white, axis=1), limit)
    flat = whitened.reshape(-1, whitened.shape[2])
    weighted = flat * np.repeat(weights, white.shape[1])[:, None]
    cost = float(huber_cost(np.linalg.norm(white, axis=1), limit).sum())
    normal = weighted.T @ flat
    zero = np.zeros_like(normal)
    return Solution(state, errors, weights, normal, units, cost, zero, zero), -weighted.T @ white.ravel()


def parameter_units(derivative: np.ndarray) -> np.ndarray:
    """Returns steps (k,) that move the tool by 1 mm RMS, or by 1 rad if they move no point; 1 if they move nothing."""
    lengths = derivative[:, -3:] if derivative.shape[1] > 1 else derivative
    moves = np.sqrt((lengths**2).sum(1).mean(0))
    turns = np.sqrt((derivative[:, :3] ** 2).sum(1).mean(0)) if derivative.shape[1] == 6 else np.zeros(len(moves))
    moves = np.where(moves > 1e-9, moves, turns)  # the tool's orientation moves no point
    return np.where(moves > 1e-9, 1 / np.maximum(moves, 1e-9), 1.0)
