"""How well a set of poses shows a robot's parameters: the observability indices O1 … O5."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.robot.kinematics import chain_jacobian, chain_parameters, flange_poses
from stcal.robot.model import Robot
from stcal.robot.solve import reach_mm

Observe = Literal["pose", "position"]


@dataclass(frozen=True, slots=True)
class Observability:
    """Indices of an identification Jacobian with singular values σ₁ ≥ … ≥ σ_L from ``count`` poses; larger is better.

    All depend on the unit of the parameters but for the order that O1 gives to sets of poses.

    Parameters
    ----------
    o1 : float
        (σ₁ … σ_L)^(1/L) / √count: the volume of the ellipsoid of uncertainty, D-optimality (Borm & Menq 1989, 1991).
    o2 : float
        σ_L / σ₁: inverse condition number (Driels & Pathre 1990).
    o3 : float
        σ_L: the parameter that is seen worst, E-optimality (Nahvi, Hollerbach & Hayward 1994).
    o4 : float
        σ_L² / σ₁: noise amplification (Nahvi & Hollerbach 1996).
    o5 : float
        1 / (1/σ₁ + … + 1/σ_L): harmonic, near to A-optimality (Sun & Hollerbach 2008).
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    @classmethod
    def of(cls, singular_values: np.ndarray, count: int) -> "Observability":
        """From the singular values (L,) of the Jacobian of ``count`` poses; all indices are 0 where one of them is 0.

        Raises
        ------
        InputError
            No singular values, negative ones, or no poses.
        """
        sigma = np.sort(np.asarray(singular_values, float).ravel())[::-1]
        if not len(sigma) or not np.isfinite(sigma).all() or sigma[-1] < 0 or count < 1:
            raise InputError(
                f"observability: {len(sigma)} singular values of {count} poses; at least one of each, none negative"
            )
        first, last = float(sigma[0]), float(sigma[-1])
        if last == 0:
            return cls(0.0, 0.0, 0.0, 0.0, 0.0)
        volume = float(np.exp(np.log(sigma).mean()))
        return cls(
            float(volume / np.sqrt(count)), last / first, last, last * last / first, float(1 / (1 / sigma).sum())
        )

    def values(self) -> dict[str, float]:
        """By name, O1 … O5."""
        return {"O1": self.o1, "O2": self.o2, "O3": self.o3, "O4": self.o4, "O5": self.o5}


def identification_jacobian(
    robot: Robot,
    q: np.ndarray,
    observe: Observe = "position",
    sigma_mm: float = 1.0,
    sigma_rad: float = 1.0,
    tool: str = "",
) -> np.ndarray:
    """Whitened derivative of what is measured at joint vectors by all that is identified, (m, r, k).

    r is 6 (rotation over σ_rad, translation over σ_mm) or 3 (position over σ_mm), in the world's axes. The k parameters
    are 4 R + 2 P of the joints' axes (:func:`~stcal.robot.kinematics.chain_parameters`) and 6 or 3 of the tool, in its
    own axes; rad and mm.

    Parameters
    ----------
    q : (m, n) array
        Values of the controller, rad or mm.
    """
    chain = robot.chain()
    tip = flange_poses(chain, q) @ robot.tool(tool)
    axes = chain_jacobian(chain, q, tip)
    by_tool = np.zeros((len(q), 6, 6))
    by_tool[:, :3, :3] = by_tool[:, 3:, 3:] = tip.rotation
    if observe == "position":
        return np.concatenate([axes[:, 3:], by_tool[:, 3:, 3:]], axis=2) / sigma_mm
    weight = 1 / np.repeat([sigma_rad, sigma_mm], 3)
    return np.concatenate([axes, by_tool], axis=2) * weight[:, None]


def parameter_scale(robot: Robot, observe: Observe = "position", tool: str = "") -> np.ndarray:
    """(k,) factors of the columns of :func:`identification_jacobian` after which all parameters are in mm: an angle
    counts by the arc that it makes at the arm's whole reach."""
    turning = [c < 3 for _, c in chain_parameters(robot.chain())]
    turning += [True] * 3 * (observe == "pose") + [False] * 3
    return np.where(turning, 1 / reach_mm(robot, tool), 1.0)
