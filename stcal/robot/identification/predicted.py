"""The error that an identified robot is expected to have, where it was measured and elsewhere.

Few rows, or rows of a small part of the joints' ranges, fit well but determine little; the covariance shows how little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.arrays import rms
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.observability import directions_named
from stcal.robot.identification.residuals import WIDTH, Kind, Observed, State, tip_jacobian
from stcal.robot.identification.unexplained import Finding
from stcal.robot.kinematics.conditions import USUAL, Conditions
from stcal.robot.kinematics.inverse import reach_mm
from stcal.robot.kinematics.model import Robot

SAMPLES, SEED = 200, 0
ELSEWHERE = 3.0
"""Ratio of σ over the joints' ranges to σ at the measured rows, above which there is a warning: 40 rows over the middle
60 % of all ranges have 1.6, over 30 % 3.5, eight rows 3."""
FEW = 2.0
"""Number of measured values per parameter below which σ are hardly estimated: of 40 simulated sets of eight poses (1.6)
two gave a tenth of the true σ."""


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """σ of the tool's position, mm (root of the summed variances of x, y, z), by the covariance of the parameters.

    ``here_mm`` : (m,) at the measured joint values; ``ranges_mm`` : (s,) at random ones over the joints' ranges (± half
    a turn, or the reach, where unlimited), including ``left_mm``, the RMS of the effects found in the residuals;
    ``covariance`` : (k, k) of all parameters, including elasticity, rad and mm.
    """

    here_mm: np.ndarray
    ranges_mm: np.ndarray
    covariance: np.ndarray
    left_mm: float = 0.0

    def elsewhere(self) -> float:
        """Returns σ over the joints' ranges as a multiple of σ at the measured rows (RMS)."""
        return rms(self.ranges_mm) / max(rms(self.here_mm), 1e-9)


def predicted(state: State, robot: Robot, measured: Observed, covariance: np.ndarray) -> Predicted | None:
    """Returns σ for the target of most rows; None for distances, which do not show where the whole arm is.

    ``state`` : the identified state; ``robot`` : the robot with the joints' ranges; ``measured`` : the observations;
    ``covariance`` : (k, k) covariance of the parameters, rad and mm.
    """
    if measured.kind == "distance":
        return None
    names = list(dict.fromkeys(measured.data.targets))
    target = max(names, key=measured.data.targets.count)

    here = _sigma(
        state,
        measured.data.q,
        measured.data.targets,
        measured.kind,
        covariance,
        measured.data.conditions,
    )
    ranges = _sigma(state, _over_ranges(robot, SAMPLES), (target,) * SAMPLES, measured.kind, covariance)
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


def predicted_at(found: Predicted, state: State, kind: Kind, q: np.ndarray, targets: Sequence[str]) -> np.ndarray:
    """Returns σ (r,) of the tool's position at joint values (r, n) that were not measured, mm.

    It includes the effects found in the residuals, and is nan for tools that were not measured.

    ``found`` : prediction of the identification; ``state``, ``kind`` : the identified state, and the kind of
    observation that it was identified from; ``q`` : (r, n) joint values, rad and mm; ``targets`` : (r,) the tool of
    each.
    """
    sigma, known = np.full(len(q), np.nan), np.array([name in state.tools for name in targets], bool)
    if known.any():
        known_targets = [name for name in targets if name in state.tools]
        sigma[known] = np.hypot(_sigma(state, q[known], known_targets, kind, found.covariance), found.left_mm)
    return sigma


def _over_ranges(robot: Robot, count: int) -> np.ndarray:
    """Returns random joint values (count, n), rad or mm."""
    low, high = robot.limits().T
    half = np.where(robot.prismatic, reach_mm(replace(robot, tools={"": Rigid()})), np.pi)
    low, high = np.where(np.isfinite(low), low, -half), np.where(np.isfinite(high), high, half)
    return np.random.default_rng(SEED).uniform(low, high, (count, len(half)))


def widened(found: Predicted | None, left: Sequence[Finding]) -> tuple[Predicted | None, tuple[str, ...]]:
    """Returns the prediction with the effects found in the residuals added to the σ over the ranges, and notes on it.

    These effects show how much the model is wrong. The covariance takes the model as true and does not include them,
    so that values identified from other rows differ by more than it says.
    """
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
    """Returns notes on rows that are few, or that cover a small part of the ranges.

    ``units`` : (k,) factors that make each parameter a movement of the tool of about 1 mm; ``tested`` : rows were held
    out.
    """
    notes = []
    numbers = WIDTH[measured.kind] * len(measured)
    count = f"{len(measured)} {measured.kind}s give {numbers} numbers for {len(names)} parameters"
    if not tested:
        notes.append(
            f"{count}: none can be held out to test the result, and errors of the same rows say nothing; measure twice "
            "as many"
        )
    elif numbers < FEW * len(names):
        notes.append(
            f"{count}: σ estimated from so few may be several times too small; state --sigma-mm, or measure more"
        )
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
