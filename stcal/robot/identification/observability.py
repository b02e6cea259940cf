"""How well a set of poses determines a robot's parameters: observability indices, and errors expected elsewhere."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import rms
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import TOOL_WIDTH, WIDTH, Kind, Observed, State, tip_jacobian
from stcal.robot.identification.unexplained import Finding
from stcal.robot.kinematics.forward import chain_parameters
from stcal.robot.kinematics.inverse import reach_mm
from stcal.robot.kinematics.robot_model import USUAL, Conditions, Robot

SEEN = 1e-9
"""Share of the largest singular value below which a singular value is rounding: no pose shows the parameter."""

TOGETHER, MOST_BESIDE = 0.2, 2
"""Share of a direction's largest motion from which on a parameter is named with it, and largest number of those."""

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

    The indices depend on the units of the parameters, except for the order that O1 gives to sets of poses. In this
    module all parameters are lengths in mm, an angle being the arc that it makes at the arm's whole reach
    (:func:`parameter_scale`), and measurements are counted in their σ. So singular values, O1, O3, O4 and O5 are in
    1/mm; O2 has no unit; and 1 / O3 is the σ in mm of the combination of parameters that is seen worst.

    ``o1`` : (σ₁ … σ_L)^(1/L) / √count, volume of the ellipsoid of uncertainty, D-optimality (Borm & Menq 1989, 1991);
    ``o2`` : σ_L / σ₁, inverse condition number (Driels & Pathre 1990); ``o3`` : σ_L, the combination of parameters that
    is seen worst, E-optimality (Nahvi, Hollerbach & Hayward 1994); ``o4`` : σ_L² / σ₁, noise amplification (Nahvi &
    Hollerbach 1996); ``o5`` : 1 / (1/σ₁ + … + 1/σ_L), near to A-optimality (Sun & Hollerbach 2008).
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    @classmethod
    def of(cls, singular_values: np.ndarray, count: int) -> "ObservabilityIndices":
        """Returns the indices by singular values (L,) of ``count`` poses, all 0 if one value is 0; raises
        InputError."""
        sigma = np.sort(np.asarray(singular_values, float).ravel())[::-1]
        if not len(sigma) or not np.isfinite(sigma).all() or sigma[-1] < 0 or count < 1:
            raise InputError(
                "E-ARRAY-SHAPE",
                f"observability: {len(sigma)} singular values of {count} poses; at least one of each, none negative",
            )
        first, last = float(sigma[0]), float(sigma[-1])
        if last == 0:
            return cls(0.0, 0.0, 0.0, 0.0, 0.0)
        volume = float(np.exp(np.log(sigma).mean()))
        return cls(
            float(volume / np.sqrt(count)), last / first, last, last * last / first, float(1 / (1 / sigma).sum())
        )

    @classmethod
    def of_jacobian(cls, rows: np.ndarray, seen: int | None = None) -> "ObservabilityIndices":
        """Returns the indices of the Jacobian (m, r, k) of m poses over σ, by its ``seen`` largest singular values."""
        sigma = np.linalg.svd(rows.reshape(-1, rows.shape[2]), compute_uv=False)[:seen]
        return cls.of(np.where(sigma > SEEN * sigma[0], sigma, 0.0), len(rows))

    def values(self) -> dict[str, float]:
        """Returns the indices by name, O1 … O5."""
        return {"O1": self.o1, "O2": self.o2, "O3": self.o3, "O4": self.o4, "O5": self.o5}


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
    derivative = tip_jacobian(state, q, (tool,) * len(q), observe)[1]
    sigma = np.repeat([sigma_rad, sigma_mm], 3)
    return (derivative / sigma[:, None])[:, -WIDTH[observe] :]


def parameter_scale(robot: Robot, observe: Kind = "position", tools: Iterable[str] = ("",)) -> np.ndarray:
    """Returns factors (k,) that bring all parameters to mm, angles as arcs at the reach with the longest tool."""
    tools = list(tools)
    turning = [c < 3 for _, c in chain_parameters(robot.chain())]
    turning += ([True] * (TOOL_WIDTH[observe] - 3) + [False] * 3) * len(tools)
    return np.where(turning, 1 / reach_mm(robot, tools), 1.0)


def directions_named(directions: np.ndarray, names: list[str]) -> tuple[str, ...]:
    """Returns names of directions (k, d), ``J2 y (with tool z)``, each led by a parameter of its own."""
    lead, reduced = [], directions.copy()
    for column in range(reduced.shape[1]):
        free = np.abs(reduced)
        free[lead] = 0
        i, j = np.unravel_index(free[:, column:].argmax(), free[:, column:].shape)
        reduced[:, [column, column + j]] = reduced[:, [column + j, column]]
        reduced[:, column] /= reduced[i, column]
        others = np.arange(reduced.shape[1]) != column
        reduced[:, others] -= np.outer(reduced[:, column], reduced[i, others])
        lead.append(int(i))
    named = []
    for i, direction in zip(lead, np.abs(reduced.T), strict=True):
        order = np.argsort(-direction)
        strong = [names[k] for k in order if k != i and direction[k] > TOGETHER * direction.max()]
        beside = " and ".join(strong[:MOST_BESIDE]) + (" …" if len(strong) > MOST_BESIDE else "")
        named.append(f"{names[i]} (with {beside})" if beside else names[i])
    return tuple(named)


SAMPLES, SEED = 200, 0
ELSEWHERE = 3.0
"""Largest ratio of σ over the ranges to σ at the rows without a warning: 40 rows over 60 % of the ranges have 1.6."""
FEW = 2.0
"""Number of measured values per parameter below which σ may come out at a tenth of the true ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """σ of the tool's position, mm (root of the summed variances of x, y, z). ``here_mm`` : (m,) at the measured joint
    values; ``ranges_mm`` : (s,) at random ones over the joints' ranges, including ``left_mm``, the RMS of effects in
    the residuals; ``covariance`` : (k, k) of all parameters, rad and mm."""

    here_mm: np.ndarray
    ranges_mm: np.ndarray
    covariance: np.ndarray
    left_mm: float = 0.0

    def elsewhere(self) -> float:
        """Returns σ over the joints' ranges as a multiple of σ at the measured rows (RMS)."""
        return rms(self.ranges_mm) / max(rms(self.here_mm), 1e-9)

    def at(self, state: State, kind: Kind, q: np.ndarray, targets: Sequence[str]) -> np.ndarray:
        """Returns σ (r,) of the position, mm, at joint values (r, n) that were not measured, with the effects found in
        the residuals; nan for tools that were not measured."""
        sigma, known = np.full(len(q), np.nan), np.array([name in state.tools for name in targets], bool)
        if known.any():
            known_targets = [name for name in targets if name in state.tools]
            sigma[known] = np.hypot(_sigma(state, q[known], known_targets, kind, self.covariance), self.left_mm)
        return sigma


def predicted(state: State, robot: Robot, measured: Observed, covariance: np.ndarray) -> Predicted | None:
    """Returns σ for the target of most rows; None for distances, which do not place the arm."""
    if measured.kind == "distance":
        return None
    data, kind = measured.data, measured.kind
    target = max(dict.fromkeys(data.targets), key=data.targets.count)
    here = _sigma(state, data.q, data.targets, kind, covariance, data.conditions)
    q = over_ranges(replace(robot, tools={"": Rigid()}), SAMPLES)
    ranges = _sigma(state, q, (target,) * SAMPLES, kind, covariance)
    return Predicted(here, ranges, covariance)


def _sigma(
    state: State,
    q: np.ndarray,
    targets: Sequence[str],
    kind: Kind,
    covariance: np.ndarray,
    conditions: Conditions = USUAL,
) -> np.ndarray:
    """Returns σ (r,) of the position at joint values (r, n), mm."""
    place = tip_jacobian(state, q, targets, kind, conditions)[1][:, 3:]
    return np.sqrt(np.einsum("rik,kl,ril->r", place, covariance, place))


def over_ranges(robot: Robot, count: int, tool: str = "") -> np.ndarray:
    """Returns random joint values (count, n); without limits, of half a turn, or the reach, to either side."""
    low, high = robot.limits().T
    half = np.where(robot.prismatic, reach_mm(robot, [tool]), np.pi)
    low, high = np.where(np.isfinite(low), low, -half), np.where(np.isfinite(high), high, half)
    return np.random.default_rng(SEED).uniform(low, high, (count, len(half)))


def widened(found: Predicted | None, left: Sequence[Finding]) -> tuple[Predicted | None, tuple[str, ...]]:
    """Returns the prediction, enlarged over the ranges by the effects that the model lacks, and notes on it."""
    if found is None or not left:
        return found, ()
    effects = np.array([finding.effect_mm / (np.sqrt(2) if finding.turns else 1.0) for finding in left])
    size = float(np.sqrt((effects**2).sum()))
    wider = replace(found, ranges_mm=np.hypot(found.ranges_mm, size), left_mm=size)
    return wider, (
        f"σ hold for these rows, and for places like theirs: the model leaves {size:.2g} mm RMS that goes with what is "
        f"named above; over the joints' ranges the tool's position is known to {rms(wider.ranges_mm):.2g} mm (σ, with "
        "that in it)",
    )


def doubts(
    found: Predicted | None,
    measured: Observed,
    units: np.ndarray,
    covariance: np.ndarray,
    names: list[str],
    tested: bool,
) -> tuple[str, ...]:
    """Returns notes on few rows, or of a small part of the ranges; ``tested`` : rows were held out."""
    numbers = WIDTH[measured.kind] * len(measured)
    count, notes = f"{len(measured)} {measured.kind}s give {numbers} numbers for {len(names)} parameters", []
    few = "σ estimated from so few may be several times too small; state --sigma-mm, or measure more"
    if not tested:
        few = "none can be held out to test the result, and errors of the same rows say nothing; measure twice as many"
    if not tested or numbers < FEW * len(names):
        notes.append(f"{count}: {few}")
    if found is not None and found.elsewhere() > ELSEWHERE:
        sizes, directions = np.linalg.eigh(covariance / units[:, None] / units)
        worst = directions_named(directions[:, -1:], names)[0]
        notes.append(
            f"over the joints' ranges the tool's position is known to {rms(found.ranges_mm):.2g} mm (σ), "
            f"{found.elsewhere():.0f} times that at the measured rows, {rms(found.here_mm):.2g} mm: they are few, or "
            f"of a small part of the ranges; least known: {worst}, ± {np.sqrt(sizes[-1]):.2g} mm; add rows "
            "(`stcal robot design`), or use the result where it was measured only"
        )
    return tuple(notes)
