"""Measurement poses that determine a robot's parameters well: D-optimal choice among random candidates.

A greedy choice is followed by exchanges of single poses while they help (Fedorov 1972; Mitchell 1974, DETMAX). The
inverse information matrix is updated by the few rows of a pose (Sherman, Morrison & Woodbury).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Array, Brief, freeze, require_arguments, require_fields
from stcal.geometry.rigid import Poses
from stcal.io.json import Finite, ResultFile
from stcal.io.table import POSE, csv_text, pose_cells
from stcal.parallel import one_thread
from stcal.robot.identification.adjustment import (
    SEEN,
    ObservabilityIndices,
    identification_jacobian,
    parameter_scale,
)
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_model import Robot
from stcal.robot.use.compensation import joint_cells, joint_columns

RANDOM_SETS, TEST_POSES = 20, 200
"""Number of random sets for comparison, and of random poses at which the identified robot's position is predicted."""
DRAWS = 200  # number of joint vectors drawn for each candidate in the box, before the box counts as out of reach
GAIN = 1e-9  # least growth of log det that counts as an improvement


class DesignFile(ResultFile):
    """Result file of ``design``."""

    format: Literal["stcal pose design 1"] = Field(description="the file's form and its version")
    parameters: int = Field(description="of the robot and its tool")
    seen: int = Field(description="how many combinations of them any pose shows; the indices are of these")
    exchanges: int = Field(description="single poses exchanged after the greedy choice")
    chosen: ObservabilityIndices = Field(description="`o1`, `o2`, `o3`, `o4`, `o5` of the chosen poses")
    random: list[ObservabilityIndices] = Field(description="`o1`, `o2`, `o3`, `o4`, `o5` of 20 random sets of as many")
    sigma_mm: float = Field(description="σ per axis of positions that the identified robot predicts, RMS")
    random_sigma_mm: Finite = Field(description="median of the random sets (null where they leave parameters open)")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class PoseDesign(Brief):
    """The chosen poses, compared with random sets of as many.

    ``q`` : (count, n) joint vectors, of which the first alone are a good set too; ``poses`` : base_from_tool there;
    ``parameters``, ``seen`` : how many there are, and how many (in combination) the candidates show, of which the
    indices ``chosen`` and ``random`` are; ``sigma_mm`` : σ of the position that the identified robot will predict, RMS
    per axis over random poses; ``random_sigma_mm`` : median of the random sets; ``exchanges`` : after the first choice.
    """

    format: ClassVar = "stcal pose design 1"
    q: Array
    poses: Poses
    parameters: int
    seen: int
    chosen: ObservabilityIndices
    random: tuple[ObservabilityIndices, ...]
    sigma_mm: float
    random_sigma_mm: float
    exchanges: int

    def __post_init__(self):
        freeze(self, "q", (len(self.poses), None), "joint values")

    def median(self) -> dict[str, float]:
        """Returns the median of each index over the random sets."""
        names = self.chosen.values()
        return {name: float(np.median([each.values()[name] for each in self.random])) for name in names}


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """Options of :func:`design`: candidates and instrument.

    Parameters
    ----------
    count : poses to choose.
    seed : of the candidates and of the random sets.
    observe : what the instrument measures.
    candidates : random poses to choose from, more than ``count``.
    sigma_mm, sigma_rad : σ of the instrument, of one coordinate of a position, mm, and of an orientation, rad.
    box : lowest x, y, z and highest x, y, z of the tool in the base, mm.
    tool : name of the tool that is measured.

    Raises InputError: a choice that does not exist, no more candidates than poses, a σ that is not positive, or a box
    that is empty.
    """

    count: int = 40
    seed: int = 0
    observe: Literal["pose", "position"] = "position"
    candidates: int = 1000
    sigma_mm: float = 0.05
    sigma_rad: float = 2e-4
    box: tuple[float, ...] | None = None
    tool: str = ""

    def __post_init__(self):
        require_fields(self, "design", seed=0)
        if self.count < 1 or self.candidates <= self.count:
            fault = f"design: {self.count} poses of {self.candidates} candidates"
            raise InputError("E-DESIGN-OPTIONS", f"{fault}; more candidates than poses needed")
        if not (1e-9 <= self.sigma_mm <= 1e4 and 1e-12 <= self.sigma_rad <= 4):
            fault = f"design: σ of {self.sigma_mm:g} mm and {self.sigma_rad:g} rad"
            raise InputError("E-SIGMA-VALUE", f"{fault}; positive numbers needed, 1e-9 to 1e4 mm and 1e-12 to 4 rad")
        if self.box is not None and not (len(self.box) == 6 and np.less(self.box[:3], self.box[3:]).all()):
            remedy = "xmin,ymin,zmin,xmax,ymax,zmax needed, each minimum below its maximum"
            raise InputError("E-DESIGN-OPTIONS", f"design: box {self.box}; {remedy}")


@require_arguments
@one_thread()
def design(robot: Robot, options: DesignOptions | None = None) -> PoseDesign:
    """Chooses poses for the identification of ``robot``, the same for the same seed.

    D-optimal: the volume of the ellipsoid of the parameters' uncertainty is small.

    Parameters
    ----------
    robot : the nominal robot, with joint limits; mm, rad.
    options : how many poses, of how many candidates, for which instrument.

    Returns
    -------
    PoseDesign : joint vectors with their poses base_from_tool, and their observability beside random ones.

    Raises InputError: a prismatic joint without limits, or no poses in the box. Raises DegenerateError: so few poses
    that the parameters cannot be determined.

    References
    ----------
    V. V. Fedorov, "Theory of Optimal Experiments", 1972. T. J. Mitchell, "An algorithm for the construction of
    'D-optimal' experimental designs", Technometrics 16, 1974 (DETMAX).
    """
    options = options or DesignOptions()
    rng = np.random.default_rng(options.seed)
    q = _candidates(robot, options, rng)
    scale = parameter_scale(robot, options.observe, [options.tool])
    rows = identification_jacobian(robot, q, options.observe, options.sigma_mm, options.sigma_rad, options.tool) * scale
    _, sigma, vt = np.linalg.svd(np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode="r"))
    determined = int((sigma > SEEN * sigma[0]).sum())
    basis = vt[:determined].T  # the combinations of parameters that the candidates show
    rows = rows @ basis
    needed = -(-determined // rows.shape[1])
    if options.count < needed:
        fault = f"design: {options.count} poses with {rows.shape[1]} values each for {determined} parameters"
        raise DegenerateError("E-DESIGN-FEW", f"{fault}; at least {needed} needed, some tens advisable")
    chosen, exchanges = choose(rows, options.count)
    sets = [rng.choice(len(q), options.count, replace=False) for _ in range(RANDOM_SETS)]
    predict = identification_jacobian(robot, q[:TEST_POSES], options.observe, tool=options.tool)[:, -3:] * scale @ basis
    return PoseDesign(
        q=q[chosen],
        poses=forward(robot, q[chosen], options.tool),
        parameters=len(scale),
        seen=determined,
        chosen=ObservabilityIndices.of_jacobian(rows[chosen]),
        random=tuple(ObservabilityIndices.of_jacobian(rows[s]) for s in sets),
        sigma_mm=_predicted_mm(rows[chosen], predict),
        random_sigma_mm=float(np.median([_predicted_mm(rows[s], predict) for s in sets])),
        exchanges=exchanges,
    )


def _candidates(robot: Robot, options: DesignOptions, rng: np.random.Generator) -> np.ndarray:
    """Returns random joint vectors (candidates, n) within limits (one turn if unlimited), with the tool in the box."""
    low, high = robot.limits().T
    for joint in np.flatnonzero(robot.prismatic & ~np.isfinite(high - low)) + 1:
        fault = f"robot {robot.name}: joint {joint} is prismatic without limits"
        raise InputError("E-ROBOT-LIMITS", f"{fault}; min_mm and max_mm needed")
    low = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2 * np.pi, -np.pi))
    high = np.where(np.isfinite(high), high, low + 2 * np.pi)
    wanted, box, found, drawn = options.candidates, options.box, np.zeros((0, len(low))), 0
    while len(found) < wanted:
        if box is not None and drawn >= DRAWS * wanted:
            fault = f"design: of {drawn} random joint vectors {len(found)} bring the tool into the box {box} mm"
            remedy = "widen it (it is in the robot's base) or ask for fewer candidates"
            raise InputError("E-DESIGN-BOX", f"{fault}, {wanted} needed; {remedy}")
        q = rng.uniform(low, high, (wanted, len(low)))
        drawn += len(q)
        if box is not None:
            at = forward(robot, q, options.tool).translation
            q = q[((at >= box[:3]) & (at <= box[3:])).all(axis=1)]
        found = np.concatenate([found, q])
    return found[:wanted]


def choose(rows: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Chooses ``count`` of m candidates with rows (m, r, k) for a large det Σ JᵀJ; returns them and the exchanges."""
    k = rows.shape[2]
    mean = np.einsum("mri,mrj->ij", rows, rows) / len(rows)
    start = 1e-6 * np.trace(mean) / k * np.eye(k)
    inverse = np.linalg.inv(start)
    chosen: list[int] = []
    for _ in range(count):
        gain = _gains(rows, inverse)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        inverse = _updated(inverse, rows[chosen[-1]], 1.0)
    exchanges = 0
    for _ in range(20):  # no exchange helps any more after 2 to 6 sweeps
        before = exchanges
        inverse = np.linalg.inv(start + np.einsum("mri,mrj->ij", rows[chosen], rows[chosen]))  # no rounding gathers
        for place in range(count):
            without = _updated(inverse, rows[chosen[place]], -1.0)
            gain = _gains(rows, without)
            own = gain[chosen[place]]
            gain[chosen] = -np.inf
            best = int(gain.argmax())
            if gain[best] > own + GAIN:
                chosen[place] = best
                inverse = _updated(without, rows[best], 1.0)
                exchanges += 1
        if exchanges == before:
            break
    return np.array(chosen), exchanges


def _gains(rows: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Returns the growth (m,) of log det of the information with each candidate."""
    inner = np.einsum("mri,mji->mrj", rows @ inverse, rows)
    r = np.arange(inner.shape[1])
    inner[:, r, r] += 1
    return np.linalg.slogdet(inner)[1]


def _updated(inverse: np.ndarray, rows: np.ndarray, sign: float) -> np.ndarray:
    """Returns the inverse information after rows (r, k) are added (+1) or removed (−1)."""
    half = inverse @ rows.T
    return inverse - half @ np.linalg.solve(sign * np.eye(len(rows)) + rows @ half, half.T)


def _predicted_mm(rows: np.ndarray, predict: np.ndarray) -> float:
    """Returns σ of predicted positions, RMS per axis, mm; infinite if the set leaves a parameter undetermined."""
    _, sigma, vt = np.linalg.svd(rows.reshape(-1, rows.shape[2]), full_matrices=False)
    if len(sigma) < rows.shape[2] or sigma[-1] <= SEEN * sigma[0]:
        return float("inf")
    return float(np.sqrt(np.mean(((predict @ vt.T / sigma) ** 2).sum(axis=2))))


@require_arguments
def design_csv(result: PoseDesign, robot: Robot) -> str:
    """Returns the CSV of the poses of ``result`` to measure with ``robot``, for which they were designed.

    Joint values in degrees or mm, and base_from_tool of the nominal robot, mm (form: ``data_layout.md``).
    """
    rows: list[Sequence] = [["pose", *joint_columns(robot), *(f"nominal_{c}" for c in POSE)]]
    for i, (q, pose) in enumerate(zip(result.q, result.poses, strict=True), 1):
        rows.append([i, *joint_cells(robot, q), *pose_cells(pose)])
    return csv_text(rows)
