"""Check whether an instrument moved between two rows, or drifts along them."""

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.register.core.models import MODELS, Transform, jacobian, parts, whitened
from stcal.register.core.pairs import Problem
from stcal.register.judge.degeneracy import Namer
from stcal.register.judge.mistakes import neighbours_alike
from stcal.row_order import Change, change_along

LEVEL = 0.01
"""Probability that sound points seem to move along the order of their rows."""
TRIED = 10_000
"""Largest number of points that are examined; larger sets are clouds without an order."""


def moved_meanwhile(problem: Problem, transform: Transform) -> Change | None:
    """Returns the jump or drift of one frame against the other along the order of the rows; None if there is none
    beyond chance, or the frames are bent and it explains no bend."""
    if len(problem) > TRIED:
        return None
    from_middle = problem.xyz_a - problem.xyz_a.mean(0)
    by_parameters = jacobian(problem.model, transform, from_middle)
    motions = jacobian(MODELS["rigid"], Rigid(_turn(transform)), from_middle)
    residuals, precision = problem.residuals(transform), problem.noise.precision

    def white(values: np.ndarray) -> np.ndarray:
        return np.stack([whitened(values[:, :, k], precision) for k in range(values.shape[2])], axis=2)

    change = change_along(whitened(residuals, precision), white(by_parameters), white(motions))
    size = 0.0 if change is None else float(np.abs(motions @ change.motion).max())
    if change is None or change.p > LEVEL or size <= problem.rounding_mm():
        return None
    rest = residuals - change.moves[:, None] * (motions @ change.motion)
    alike = [neighbours_alike(problem.xyz_a[change.good], each[change.good]) for each in (residuals, rest)]
    return None if all(alike) else change


def _turn(transform: Transform) -> np.ndarray:
    """Returns the rotation next to the linear part of a transform."""
    u, _, vt = np.linalg.svd(parts(transform)[0])
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def order_note(change: Change, name: Namer) -> str:
    """Returns one line on a change along the order of the rows."""
    size = f"{np.linalg.norm(change.motion[3:]):.3g} mm and {np.degrees(np.linalg.norm(change.motion[:3])):.2g}°"
    share = f"{change.share:.0%} of the squared residuals, p {'< 0.001' if change.p < 1e-3 else f'= {change.p:.2g}'}"
    if change.kind == "drift":
        return f"one frame drifts against the other along the rows, by {size} from the first to the last ({share})"
    likely = f" ({name(change.first)} to {name(change.last)} as likely)" if change.first < change.last else ""
    return (
        f"from {name(change.row)} on{likely} an instrument stands elsewhere, by {size} ({share}): register the rows "
        f"before it, and those from it on, separately"
    )
