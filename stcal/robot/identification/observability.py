"""Observability indices O1 … O5: how well a set of poses determines a robot's parameters."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.robot.identification.residuals import WIDTH, Kind, State, tip_jacobian, tool_width
from stcal.robot.kinematics.forward import chain_parameters
from stcal.robot.kinematics.inverse import reach_mm
from stcal.robot.kinematics.model import Robot

SEEN = 1e-9
"""Share of the largest singular value below which a singular value is rounding: no pose shows the parameter."""

TOGETHER, MOST_BESIDE = 0.2, 2
"""Share of a direction's largest motion from which on a parameter is named with it, and largest number of parameters
named beside the first."""

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

    Parameters
    ----------
    o1 : (σ₁ … σ_L)^(1/L) / √count: the volume of the ellipsoid of uncertainty, D-optimality (Borm & Menq 1989, 1991)
    o2 : σ_L / σ₁: inverse condition number (Driels & Pathre 1990)
    o3 : σ_L: the combination of parameters that is seen worst, E-optimality (Nahvi, Hollerbach & Hayward 1994)
    o4 : σ_L² / σ₁: noise amplification (Nahvi & Hollerbach 1996)
    o5 : 1 / (1/σ₁ + … + 1/σ_L): harmonic, near to A-optimality (Sun & Hollerbach 2008)
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    @classmethod
    def of(cls, singular_values: np.ndarray, count: int) -> "ObservabilityIndices":
        """Returns the indices by the singular values (L,) of the Jacobian of ``count`` poses; all are 0 if one value is
        0.

        Raises InputError: no singular values, negative ones, or no poses.
        """
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
        """Returns the indices of the Jacobian (m, r, k) of m poses over σ, parameters in mm, by its ``seen`` largest
        singular values."""
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
    """Returns the derivatives (m, r, k) of the measured values at joint vectors by all identified parameters, over σ.

    r is 6 (rotation over σ_rad, translation over σ_mm) or 3 (position over σ_mm), in the world's axes; the k parameters
    are those of :func:`~stcal.robot.identification.residuals.parameter_names`, rad and mm.

    ``q`` : (m, n) joint values of the controller, rad or mm.
    """
    state = State(robot.chain(), {tool: robot.tool(tool)})
    derivative = tip_jacobian(state, q, (tool,) * len(q), observe)[1]
    sigma = np.repeat([sigma_rad, sigma_mm], 3)
    return (derivative / sigma[:, None])[:, -WIDTH[observe] :]


def parameter_scale(robot: Robot, observe: Kind = "position", tools: Iterable[str] = ("",)) -> np.ndarray:
    """Returns factors (k,) of the columns of an identification Jacobian that bring all parameters to mm.

    An angle counts by the arc that it makes at the arm's whole reach (:func:`~stcal.robot.kinematics.inverse.reach_mm`,
    with the longest tool).
    """
    tools = list(tools)
    turning = [c < 3 for _, c in chain_parameters(robot.chain())]
    turning += ([True] * (tool_width(observe) - 3) + [False] * 3) * len(tools)
    return np.where(turning, 1 / max(reach_mm(robot, tool) for tool in tools), 1.0)


def directions_named(directions: np.ndarray, names: list[str]) -> tuple[str, ...]:
    """Returns names of directions (k, d) of k parameters, such as ``J2 y (with tool z)``.

    A direction is led by a parameter that is in no other direction, followed by the parameters that move with it.
    """
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
    for i, direction in zip(lead, reduced.T, strict=True):
        strong = [
            k
            for k in np.argsort(-np.abs(direction))
            if k != i and abs(direction[k]) > TOGETHER * np.abs(direction).max()
        ]
        beside = " and ".join(names[k] for k in strong[:MOST_BESIDE]) + (" …" if len(strong) > MOST_BESIDE else "")
        named.append(f"{names[i]} (with {beside})" if beside else names[i])
    return tuple(named)
