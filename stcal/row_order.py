"""Test for jumps and drifts along the order of the rows: the instrument, the base or the target moved meanwhile."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtrc

LEAST_SIDE = 4
"""Smallest number of rows before and after a jump. Fewer are outliers, which are named by themselves."""
INDEPENDENT = 1e-6
"""Share of the squares of a motion that must be left beside the fitted parameters; less is rounding."""
GROSS_SIGMAS, ROUNDS = 5.0, 5
"""Size in σ from which a row is an error that belongs to neither side; and largest number of rounds without them."""
EQUAL = 4.6
"""Difference of log likelihood below which another row may be the first one after the jump, at 99 %."""


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """A jump of the rows from ``row`` on, or a drift of all rows in proportion to their place in the order."""

    kind: Literal["jump", "drift"]
    row: int
    first: int  # range of rows that may be the first one after the jump
    last: int
    motion: np.ndarray  # (c,) jump, or drift from the first to the last row, in units of the motions given
    moves: np.ndarray  # (r,) share of the motion in each row
    share: float  # of the squared residuals that it explains
    log_p: float  # logarithm of the probability of such a change by chance, wherever it is in the order
    good: np.ndarray  # (r,) rows that are no gross errors

    @property
    def p(self) -> float:
        """Probability of such a change by chance."""
        return float(np.exp(min(self.log_p, 0.0)))


def change_along(errors: np.ndarray, explained: np.ndarray, motions: np.ndarray) -> Change | None:
    """Returns the jump or the drift that explains residuals best, however improbable it is by chance; None if there are
    too few rows, or the parameters explain any such change. The F test of each place is made in the space that the
    fitted parameters leave open; probabilities are multiplied by their number (Bonferroni). ``errors`` : (r, w)
    residuals in units of one common σ, in the order of measurement; ``explained`` : (r, w, k) derivatives by the fitted
    parameters; ``motions`` : (r, w, c) effects of the motions that may have happened."""
    return changes_along(errors, explained, [motions])[0]


def changes_along(
    errors: np.ndarray, explained: np.ndarray, families: Sequence[np.ndarray]
) -> tuple[Change | None, ...]:
    """Returns :func:`change_along` for each of several ``families`` of motions (r, w, c)."""
    known: dict[bytes, np.ndarray] = {}

    def basis_of(good: np.ndarray) -> np.ndarray:
        """Returns an orthonormal basis (N, k') of what the parameters explain in the good rows."""
        key = good.tobytes()
        if key not in known:
            columns = _flat(explained[good])
            size = np.linalg.norm(columns, axis=0)
            u, s, _ = np.linalg.svd(columns[:, size > 0] / size[size > 0], full_matrices=False)
            known[key] = u[:, s > 1e-9 * s[:1].max(initial=0.0)]
        return known[key]

    def change(motions: np.ndarray) -> Change | None:
        good, width = np.ones(len(errors), bool), errors.shape[1]
        for _ in range(ROUNDS):
            found = _best(errors, basis_of(good), motions, good)
            if found is None:
                return None
            stay = errors - found.moves[:, None] * (motions @ found.motion)
            step = np.linalg.lstsq(_flat(explained[good]), stay[good].ravel(), rcond=1e-12)[0]
            left = np.linalg.norm(stay - explained @ step, axis=1)
            sigma = np.median(left[good]) / np.sqrt(max(width - 2 / 3, 0.45))  # of one coordinate
            before, good = good, left <= GROSS_SIGMAS * sigma * np.sqrt(width)
            if (good == before).all() or good.mean() < 0.5:
                break
        return found

    return tuple(change(motions) for motions in families)


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(values.shape[0] * values.shape[1], values.shape[2])


def _sums(values: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Returns the sums (m + 1, …) of values (m, …) from each row on; the last is weighted by ``along`` (m, 1)."""
    weighted = np.einsum("r,r...->...", along[:, 0], values)
    return np.concatenate([np.flip(np.cumsum(np.flip(values, 0), 0), 0), weighted[None]])


def _best(errors: np.ndarray, basis: np.ndarray, motions: np.ndarray, good: np.ndarray) -> Change | None:
    rows, (r, w, c) = np.flatnonzero(good), motions.shape
    scale = np.linalg.norm(_flat(motions), axis=0)
    unit = motions[good] / np.where(scale > 0, scale, 1.0)
    before = errors[good].ravel()
    rest = before - basis @ (basis.T @ before)
    square, freedom = float(rest @ rest), len(before) - basis.shape[1]
    if len(rows) < 2 * LEAST_SIDE or freedom <= c + 1 or square <= 0:
        return None

    by_row = basis.reshape(len(rows), w, basis.shape[1])
    along = (rows / max(r - 1, 1))[:, None]
    normal = _sums(np.einsum("rwi,rwj->rij", unit, unit), along**2)
    shared = _sums(np.einsum("rwk,rwj->rkj", by_row, unit), along)
    pull = _sums(np.einsum("rwj,rw->rj", unit, rest.reshape(len(rows), w)), along)
    places = np.array([*range(LEAST_SIDE, len(rows) - LEAST_SIDE + 1), len(rows)])
    normal, shared, pull = normal[places], shared[places], pull[places]
    values, directions = np.linalg.eigh(normal - np.swapaxes(shared, 1, 2) @ shared)
    keep = values > INDEPENDENT * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-300)[:, None]
    inside = np.einsum("pij,pi->pj", directions, pull)
    inverse = np.where(keep, 1 / np.where(keep, values, 1.0), 0.0)
    gains, counts = (inside**2 * inverse).sum(1), keep.sum(1)
    ratio = gains / np.maximum(counts, 1) / np.maximum((square - gains) / np.maximum(freedom - counts, 1), 1e-300)
    chances = np.maximum(fdtrc(np.maximum(counts, 1), freedom - counts, ratio), np.finfo(float).tiny)
    chances = np.where(counts > 0, np.log(chances), 0.0)
    if not counts.any():
        return None
    best = int(chances.argmin())
    place, gain, step = int(places[best]), float(gains[best]), directions[best] @ (inverse[best] * inside[best])
    jump = place < len(rows)
    moves = np.where(np.arange(r) >= rows[place], 1.0, 0.0) if jump else np.arange(r) / max(r - 1, 1)
    motion = step / np.where(scale > 0, scale, 1.0)
    variance = max(square - gain, 1e-300) / freedom
    near = places[:-1][(gain - gains[:-1]) / variance / 2 < EQUAL]
    row, first, last = rows[[place, near[0], near[-1]]].tolist() if jump else (0, 0, 0)
    told = motion, moves, gain / square, float(chances[best] + np.log(len(places))), good
    return Change("jump" if jump else "drift", row, first, last, *told)
