"""Measurements as observations of an arm: residuals, derivatives by the minimal parameters, σ, and observability."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import TWIST
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.robot.kinematics.forward import carried_poses, chain_jacobian, elasticity_curvature, elasticity_jacobian
from stcal.robot.kinematics.inverse import reach_mm
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import USUAL, Chain, Conditions, Robot

Kind = Literal["pose", "position", "distance"]
WIDTH = {"pose": 6, "position": 3, "distance": 1}
TOOL_WIDTH = {"pose": 6, "position": 3, "distance": 3}
"""Number of parameters of each tool; orientation is seen in poses only."""
UNSEEN = {"pose": 0, "position": 0, "distance": 6}
"""Number of directions that observations never show: those of the instrument's place."""


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

    def of(self, data: Measurements) -> "State":
        """Returns the state without the tools and stations that ``data`` have not; the first station stays."""
        shown = {*data.stations, next(iter(self.stations))}
        tools = {name: tool for name, tool in self.tools.items() if name in data.targets}
        return replace(self, tools=tools, stations={n: each for n, each in self.stations.items() if n in shown})

    def seen_from(self, names: Sequence[str]) -> Poses:
        """Returns station_from_world by the names (r,) of stations."""
        place = {name: i for i, name in enumerate(self.stations)}
        return Poses.of(self.stations.values())[[place[name] for name in names]]

    def parameter_names(self, kind: Kind) -> list[str]:
        """Returns the names of the parameters without elasticity: ``J2 rx`` … of the axes, ``tool x`` … of the tools,
        and ``station B rx`` … of stations but the first; r in rad, the others in mm."""
        names = [f"J{i + 1} {TWIST[c]}" for i, c in self.chain.parameters()]
        names += [f"{f'tool {name}'.rstrip()} {c}" for name in self.tools for c in TWIST[-TOOL_WIDTH[kind] :]]
        return names + [f"station {name} {c}" for name in list(self.stations)[1:] for c in TWIST]

    def tips(self, q: np.ndarray, targets: Sequence[str], conditions: Conditions = USUAL) -> Poses:
        """Returns world_from_tool at joint vectors (m, n), with the tool and the load of each."""
        place = {name: i for i, name in enumerate(self.tools)}
        tool = Poses.of(self.tools.values())
        return carried_poses(self.chain, q, targets, conditions) @ tool[[place[t] for t in targets]]

    def tips_of(self, data: Measurements) -> Poses:
        """Returns world_from_tool of m measurements."""
        return self.tips(data.q, data.targets, data.conditions)

    def residuals(self, measured: "Observed", tip: Poses | None = None) -> np.ndarray:
        """Returns measured minus modelled values, (r, 6), (r, 3) or (r, 1): rad and mm in the axes of the row's
        station; ``tip`` : world_from_tool (m,), where they are known."""
        tip = self.tips_of(measured.data) if tip is None else tip
        if len(self.stations) > 1:
            tip = self.seen_from(measured.data.stations) @ tip
        if measured.kind == "pose":
            return measured.data.poses().difference(tip)
        if measured.kind == "position":
            return measured.data.points() - tip.translation
        return (measured.values - np.linalg.norm(measured.between(tip.translation), axis=1))[:, None]

    def jacobian(self, measured: "Observed") -> np.ndarray:
        """Returns the derivative (r, 6 or 3 or 1, k) of the modelled values, by all parameters."""
        return self.linear(measured)[1]

    def linear(self, measured: "Observed") -> tuple[np.ndarray, np.ndarray]:
        """Returns :meth:`residuals` and :meth:`jacobian`."""
        tip, full = self.tip_jacobian(measured.data.q, measured.data.targets, measured.kind, measured.data.conditions)
        if len(self.stations) > 1:
            full, names = full.copy(), np.array(measured.data.stations)
            begin = len(self.parameter_names(measured.kind)) - 6 * (len(self.stations) - 1)
            for s, name in enumerate(list(self.stations)[1:]):
                at = begin + 6 * s
                full[names == name, :, at : at + 6] = frame_motions(tip.translation[names == name], np.zeros(3))
        return self.residuals(measured, tip), self.as_seen(measured, tip, full)

    def curvature(self, measured: "Observed", pull: np.ndarray) -> np.ndarray:
        """Returns the second derivative (9 n, 9 n), by compliances and moments, of the sum of ``pull`` times values."""
        tip, data = self.tips_of(measured.data), measured.data
        moves = self.as_seen(measured, tip, np.broadcast_to(np.eye(6), (len(tip), 6, 6)))
        pulls = np.einsum("rw,rwk->rk", pull, moves)
        return elasticity_curvature(self.chain, data.q, tip, data.targets, pulls, data.conditions)

    def as_seen(self, measured: "Observed", tip: Poses, moves: np.ndarray) -> np.ndarray:
        """Returns the effect (r, 6 or 3 or 1, k), in the station's axes, of motions (m, 6, k) of tools, rad over mm."""
        if len(self.stations) > 1:
            turn = self.seen_from(measured.data.stations).rotation[:, None]
            moves = (turn @ moves.reshape(len(moves), 2, 3, -1)).reshape(moves.shape)
        if measured.kind == "pose":
            return moves
        if measured.kind == "position":
            return moves[:, 3:]
        return np.einsum("ri,rik->rk", measured.along(tip), measured.between(moves[:, 3:]))[:, None]

    def tip_jacobian(
        self, q: np.ndarray, targets: Sequence[str], kind: Kind, conditions: Conditions = USUAL
    ) -> tuple[Poses, np.ndarray]:
        """Returns world_from_tool at joint vectors (m, n), and its derivative (m, 6, k) by parameters, rad over mm."""
        tip = self.tips(q, targets, conditions)
        axes_part = chain_jacobian(self.chain, q, tip, conditions)
        if self.chain.tree:
            joint = [i for i, _ in self.chain.parameters()]
            axes_part = axes_part * self.chain.carries(targets)[joint].T[:, None]
        parts = [axes_part, *(tool_motions(tip, targets, name, kind) for name in self.tools)]
        parts.append(np.zeros((len(tip), 6, 6 * (len(self.stations) - 1))))
        if self.elastic:
            parts.append(elasticity_jacobian(self.chain, q, tip, targets, conditions, self.hysteresis))
        return tip, np.concatenate(parts, axis=2)

    def moved(self, step: np.ndarray, kind: Kind) -> "State":
        """Returns the state after small motions along the parameters, (k,)."""
        later = list(self.stations)[1:]
        sizes = [len(self.chain.parameters()), *[TOOL_WIDTH[kind]] * len(self.tools), *[6] * len(later)]
        of_chain, *motions, of_elasticity = np.split(step, np.cumsum(sizes))
        motions = [Rigid.exp(np.pad(each, (6 - len(each), 0))) for each in motions]
        tools = {name: tool @ motion for (name, tool), motion in zip(self.tools.items(), motions, strict=False)}
        stations = dict(self.stations)
        stations |= {name: stations[name] @ motion for name, motion in zip(later, motions[len(tools) :], strict=True)}
        chain = self.chain.moved(of_chain)
        if self.elastic and chain.elasticity is not None:
            values = chain.elasticity.values(self.hysteresis) + of_elasticity
            chain = replace(chain, elasticity=chain.elasticity.with_values(values))
        return replace(self, chain=chain, tools=tools, stations=stations)


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

    def between(self, values: np.ndarray) -> np.ndarray:
        """Returns the differences (r, …) of values (m, …) at both ends of the distances."""
        return values[self.first] - values[self.second]

    def along(self, tip: Poses) -> np.ndarray:
        """Returns the directions (r, 3) of the distances."""
        apart = self.between(tip.translation)
        return apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-12)[:, None]

    def __getitem__(self, keep: np.ndarray) -> "Observed":
        """Returns the observations at the indices, or of the mask (r,), ``keep``."""
        if self.kind == "distance":
            return replace(self, first=self.first[keep], second=self.second[keep], values=self.values[keep])
        data = self.data[keep]
        rows = np.arange(len(data))
        return replace(self, data=data, first=rows, second=rows)

    def require_more_than(self, seeks: int, what: str, advice: str) -> None:
        """Refuses observations that give no more numbers than ``seeks`` parameters."""
        count, width = len(self), WIDTH[self.kind]
        if width * count <= seeks:
            fault = f"{self.data.where}: {count} {self.kind}s give {width * count} numbers for {seeks} {what}"
            raise DegenerateError("E-IDENTIFY-FEW", f"{fault}; {seeks // width + 1} or more needed, {advice}")


def observed(data: Measurements, kind: Kind | None = None) -> Observed:
    """Returns the measurements as ``kind``, or the richest that they hold; raises InputError if they do not hold it."""
    richest = "distance" if data.distances is not None else "position" if data.rotations is None else "pose"
    kind = kind or richest
    if WIDTH[kind] > WIDTH[richest]:
        raise InputError("E-MEASURED-KIND", f"{data.where}: {richest}s were measured; they do not give {kind}s")
    rows, none = np.arange(len(data)), np.zeros(0)
    if richest != "distance":
        frameless = kind == "distance"
        return Observed("position" if frameless else kind, data, rows, rows, none, frameless)
    distances, from_row = data.lengths()
    real = rows[from_row != rows]
    return Observed(kind, data, real, from_row[real], distances[real])


def frame_motions(xyz: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Returns the motions (m, 6, 6) of tools at (m, 3) by small rotations of the world about ``centre`` and shifts."""
    moves = np.zeros((len(xyz), 6, 6))
    moves[:, :3, :3] = moves[:, 3:, 3:] = np.eye(3)
    moves[:, 3:, :3] = -skew(xyz - centre)
    return moves


def tool_motions(tip: Poses, targets: Sequence[str], tool: str, kind: Kind) -> np.ndarray:
    """Returns the motions (m, 6, 6 or 3) of the tools by small motions of one of them on its flange."""
    moves = np.zeros((len(tip), 6, 6))
    moves[:, :3, :3] = moves[:, 3:, 3:] = tip.rotation
    moves *= np.array([name == tool for name in targets])[:, None, None]
    return moves[..., -TOOL_WIDTH[kind] :]


FIELDS = {"factor": "factor", "rad": "sigma_rad", "mm": "sigma_mm"}
"""Fields of :class:`Weighting` by the names of their σ, in the order in which σ are estimated."""


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
        columns = values.reshape(*values.shape[:2], -1)
        return self._whitened(columns, measured, back=False).reshape(values.shape)

    def pull(self, white: np.ndarray, measured: Observed) -> np.ndarray:
        """Returns half the derivative (r, w) by the residuals of the square sum of ``white``, from :meth:`whiten`."""
        return self._whitened(white[..., None], measured, back=True)[..., 0]

    def _whitened(self, values: np.ndarray, measured: Observed, back: bool) -> np.ndarray:
        """Returns W values (r, w, k), or Wᵀ values if ``back``; WᵀW is the inverse covariance with common errors F."""
        width = values.shape[1]
        if not self.given or width == 1:
            sigma = self.factor * np.array([self.sigma_rad] * 3 + [self.sigma_mm] * 3)[-width:]
            return values / sigma[:, None]
        data = measured.data
        root = self.factor * np.linalg.cholesky(data.own_covariance()[:, -width:, -width:])
        if not back:
            values = np.linalg.solve(root, values)
        if data.common is not None:
            f = np.linalg.solve(root, data.common[:, -width:]).reshape(-1, data.common.shape[2])
            size, directions = np.linalg.eigh(f.T @ f)
            size, directions = size[size > 0], directions[:, size > 0]
            u, flat = f @ directions / np.sqrt(size), values.reshape(len(f), -1)
            values = (flat - u * (1 - 1 / np.sqrt(1 + size)) @ (u.T @ flat)).reshape(values.shape)
        return np.linalg.solve(np.swapaxes(root, 1, 2), values) if back else values

    def columns(self, width: int) -> dict[str, slice]:
        """Returns the columns among the ``width`` coordinates to which each σ belongs."""
        if "factor" in self.estimated:
            return {"factor": slice(None)}
        return {"rad": slice(0, 3), "mm": slice(3, 6)} if width == 6 else {"mm": slice(None)}

    def value(self, name: str) -> float:
        """Returns the value of σ ``name``."""
        return getattr(self, FIELDS[name])

    def with_values(self, found: Mapping[str, float]) -> "Weighting":
        """Returns the weighting with the σ ``found`` in place of its own."""
        return replace(self, **{FIELDS[name]: value for name, value in found.items()})

    def scaled(self, change: np.ndarray) -> "Weighting":
        """Returns the weighting after a ``change`` (p,) of the logarithms of the σ that are estimated."""
        names = [name for name in FIELDS if name in self.estimated]
        return self.with_values({name: self.value(name) * np.exp(x) for name, x in zip(names, change, strict=True)})

    def medians(self, white: np.ndarray) -> dict[str, float]:
        """Returns the median size of whitened residuals (r, w) by the name of their σ."""
        return {n: float(np.median(np.abs(white[:, at]))) for n, at in self.columns(white.shape[1]).items()}


def parameter_units(derivative: np.ndarray) -> np.ndarray:
    """Returns steps (k,) that move the tool by 1 mm RMS, or by 1 rad if they move no point; 1 if they move nothing."""
    moves, turns = (np.sqrt((part**2).sum(1).mean(0)) for part in (derivative[:, -3:], derivative[:, :-3]))
    moves = np.where(moves > 1e-9, moves, turns)  # the tool's orientation moves no point
    return np.where(moves > 1e-9, 1 / np.maximum(moves, 1e-9), 1.0)


def sigma_of(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Returns σ (…) of values from their ``jacobian`` (…, k) by parameters with this covariance (k, k)."""
    return np.sqrt(((jacobian @ covariance) * jacobian).sum(-1).clip(0))


def position_errors(found: np.ndarray) -> np.ndarray:
    """Returns the position errors (r,), mm."""
    return np.linalg.norm(found[:, -3:], axis=1)


SEEN = 1e-9  # share of the largest singular value below which a singular value is rounding: no pose shows the parameter
MEANING = {
    "O1": "volume of the ellipsoid of uncertainty (D-optimality)",
    "O2": "inverse condition number",
    "O3": "the combination of parameters that is seen worst (E-optimality)",
    "O4": "noise amplification",
    "O5": "harmonic mean, near to A-optimality",
}
"""The meaning of each index."""


@dataclass(frozen=True, slots=True)
class ObservabilityIndices:
    """Indices of an identification Jacobian with singular values σ₁ ≥ … ≥ σ_L from ``count`` poses; larger is better.

    The indices depend on the units of the parameters, except for the order that O1 gives to sets of poses. Here all
    parameters are in mm (:func:`parameter_scale`), and measurements are counted in their σ: O1, O3, O4 and O5 are in
    1/mm, and 1 / O3 is the σ in mm of the combination of parameters that is seen worst.

    ``o1`` : (σ₁ … σ_L)^(1/L) / √count (Borm & Menq 1989, 1991); ``o2`` : σ_L / σ₁ (Driels & Pathre 1990); ``o3`` : σ_L
    (Nahvi, Hollerbach & Hayward 1994); ``o4`` : σ_L² / σ₁ (Nahvi & Hollerbach 1996); ``o5`` : 1 / (1/σ₁ + … + 1/σ_L)
    (Sun & Hollerbach 2008); see :data:`MEANING`.
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    @classmethod
    def of(cls, singular_values: np.ndarray, count: int) -> "ObservabilityIndices":
        """Returns the indices by singular values (L,) of ``count`` poses, all 0 if one value is 0."""
        sigma = np.asarray(singular_values, float)
        first, last = float(sigma.max()), float(sigma.min())
        if last == 0:
            return cls(0.0, 0.0, 0.0, 0.0, 0.0)
        volume = float(np.exp(np.log(sigma).mean()) / np.sqrt(count))
        return cls(volume, last / first, last, last * last / first, float(1 / (1 / sigma).sum()))

    @classmethod
    def of_jacobian(cls, rows: np.ndarray, seen: int | None = None) -> "ObservabilityIndices":
        """Returns the indices of the Jacobian (m, r, k) of m poses over σ, by its ``seen`` largest singular values."""
        sigma = np.linalg.svd(rows.reshape(-1, rows.shape[2]), compute_uv=False)[:seen]
        return cls.of(np.where(sigma > SEEN * sigma[0], sigma, 0.0), len(rows))

    def values(self) -> dict[str, float]:
        """Returns the indices by name, O1 … O5."""
        return {name.upper(): value for name, value in asdict(self).items()}


def identification_jacobian(
    robot: Robot,
    q: np.ndarray,
    observe: Kind = "position",
    sigma_mm: float = 1.0,
    sigma_rad: float = 1.0,
    tool: str = "",
) -> np.ndarray:
    """Returns the derivatives (m, 6 or 3, k) of the measured values, over σ, at joint vectors (m, n), in the world."""
    state = State(robot.chain(), {tool: robot.tool(tool)})
    derivative = state.tip_jacobian(q, (tool,) * len(q), observe)[1]
    sigma = np.repeat([sigma_rad, sigma_mm], 3)
    return (derivative / sigma[:, None])[:, -WIDTH[observe] :]


def parameter_scale(robot: Robot, observe: Kind = "position", tools: Iterable[str] = ("",)) -> np.ndarray:
    """Returns factors (k,) that bring all parameters to mm, angles as arcs at the reach with the longest tool."""
    tools = list(tools)
    turning = [c < 3 for _, c in robot.chain().parameters()]
    turning += ([True] * (TOOL_WIDTH[observe] - 3) + [False] * 3) * len(tools)
    return np.where(turning, 1 / reach_mm(robot, tools), 1.0)


def over_ranges(robot: Robot, count: int, tool: str = "") -> np.ndarray:
    """Returns random joint values (count, n); without limits, of half a turn, or the reach, to either side."""
    low, high = robot.limits().T
    half = np.where(robot.prismatic, reach_mm(robot, [tool]), np.pi)
    low, high = np.where(np.isfinite(low), low, -half), np.where(np.isfinite(high), high, half)
    return np.random.default_rng(0).uniform(low, high, (count, len(half)))
