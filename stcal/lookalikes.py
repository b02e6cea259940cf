"""How alike two patterns of circles are when turned and scaled, so that a camera could take one for the other."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist, squareform

from stcal.geometry.arrays import kept

MAX_GAP = 0.5  # largest distance of two circles' centres, in radii, at which the circles coincide
MAX_RADIUS_RATIO = 1.3  # largest ratio of two circles' radii at which the circles coincide
MIN_COMMON = 4
BLOCK = 4000  # number of motions tested together, which bounds the memory for patterns of many circles
MOST_CIRCLES = 100
"""Largest number of circles of a pattern that is compared as a whole; larger ones take minutes."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """Best motion of a whole pattern onto another one."""

    gap_mm: float  # largest distance of two centres, at the size of the other pattern
    turn_rad: float  # −π … π
    scale: float  # the other pattern's size over the pattern's own


@kept
def whole_likeness(xy, radius, other_xy, other_radius, in_place: np.ndarray | None = None) -> Likeness | None:
    """Returns the motion with scale that puts all circles of a pattern onto circles of another, with the smallest gap;
    None if none does within ``MAX_GAP`` radii and ``MAX_RADIUS_RATIO``, and for more than ``MOST_CIRCLES``. ``xy``,
    ``other_xy`` : (n, 2) and (m, 2) centres, mm; ``in_place`` : (n,) places of the same circles among the other's, a
    motion that is excluded."""
    centres, other_centres = (x + 1j * y for x, y in (np.asarray(points, float).T for points in (xy, other_xy)))
    n, m = len(centres), len(other_centres)
    if not 2 <= n <= m <= MOST_CIRCLES:
        return None
    i, j = np.unravel_index(squareform(pdist(xy)).argmax(), (n, n))
    q, p = np.nonzero(~np.eye(m, dtype=bool))
    factor = (other_centres[q] - other_centres[p]) / (centres[j] - centres[i])
    fits = alike(abs(factor) * radius[i], other_radius[p]) & alike(abs(factor) * radius[j], other_radius[q])
    tree, found = KDTree(np.column_stack([other_centres.real, other_centres.imag])), list[Likeness]()
    for start, turn in zip(p[fits], factor[fits], strict=True):
        moved = other_centres[start] + turn * (centres - centres[i])
        nearest = np.asarray(tree.query(np.column_stack([moved.real, moved.imag]))[1])
        if len(np.unique(nearest)) < n or (in_place is not None and (nearest == in_place).all()):
            continue
        likeness = _fitted(centres, radius, other_centres[nearest], other_radius[nearest])
        found += [] if likeness is None else [likeness]
    return min(found, key=lambda each: (round(each.gap_mm, 6), abs(each.turn_rad)), default=None)


def _fitted(own, radius, other, other_radius) -> Likeness | None:
    """Returns the motion that makes all circles (complex centres) coincide, without scale if possible; None if none."""
    centred, target = own - own.mean(), other - other.mean()
    factor = (centred.conj() @ target) / (abs(centred) ** 2).sum()
    for change in (factor / abs(factor), factor):
        scale = float(abs(change))
        gap = abs(change * centred - target)
        coincides = gap < MAX_GAP * np.minimum(scale * radius, other_radius)
        if coincides.all() and alike(scale * radius, other_radius).all():
            return Likeness(float(gap.max()), float(np.angle(change)), scale)
    return None


@kept
def common_circles(xy, radius, other_xy, other_radius, same: bool) -> set[frozenset[int]]:
    """Finds sets of ``MIN_COMMON`` or more circles that coincide with circles of another pattern under a rigid
    motion. ``xy``, ``other_xy`` : (n, 2) and (m, 2) centres, mm; ``same`` : True if both are the same pattern, so
    that the motion that leaves it in place is excluded. Returns places in ``xy``."""
    fits, _ = _motions(xy, radius, other_xy, other_radius, same)
    return {frozenset(np.flatnonzero(row).tolist()) for row in np.unique(fits, axis=0)}


@kept
def mirrored_circles(xy, radius, other_xy, other_radius) -> list[np.ndarray]:
    """Finds the circles of a pattern's mirror image that coincide with circles of another pattern, as above. Returns
    their places in ``xy`` and ``other_xy`` for each motion, the most first, no part of another."""
    fits, nearest = _motions(xy * [1, -1], radius, other_xy, other_radius, same=False)
    found: list[np.ndarray] = []
    known: list[set[tuple[int, int]]] = []
    for row in np.argsort(-fits.sum(1), kind="stable"):
        own = np.flatnonzero(fits[row])
        pairs = np.column_stack([own, nearest[row][own]])
        members = set(map(tuple, pairs.tolist()))
        if len(np.unique(pairs[:, 1])) == len(pairs) and not any(members <= other for other in known):
            found.append(pairs)
            known.append(members)
    return found


def _motions(xy, radius, other_xy, other_radius, same: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns masks and nearest circles (motions, n) of the motions by two circles that let enough coincide."""
    n, m = len(xy), len(other_xy)
    (near, k), (q, p) = (np.nonzero(~np.eye(count, dtype=bool)) for count in (n, m))
    step, other_step = xy[near] - xy[k], other_xy[q] - other_xy[p]
    length, other_length = np.linalg.norm(step, axis=1), np.linalg.norm(other_step, axis=1)
    slack = MAX_GAP * min(radius.min(), other_radius.min())
    like = alike(radius[k][:, None], other_radius[p]) & alike(radius[near][:, None], other_radius[q])
    a, b = np.nonzero((np.abs(length[:, None] - other_length) < slack) & like)
    masks, places, tree = [np.zeros((0, n), bool)], [np.zeros((0, n), int)], KDTree(other_xy)
    for start in range(0, len(a), BLOCK):
        block = slice(start, start + BLOCK)
        own, other = step[a[block]], other_step[b[block]]
        turn = np.arctan2(other[:, 1], other[:, 0]) - np.arctan2(own[:, 1], own[:, 0])
        c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
        x, y = np.moveaxis(xy - xy[k[a[block]]][:, None], 2, 0)
        moved = np.stack([c * x - s * y, s * x + c * y], -1) + other_xy[p[b[block]]][:, None]
        gap, nearest = map(np.asarray, tree.query(moved))
        fits = (gap < MAX_GAP * np.minimum(radius, other_radius[nearest])) & alike(radius[None], other_radius[nearest])
        if same:  # the identity is excluded
            moved_away = ~((nearest == np.arange(n)) | ~fits).all(1)
            fits, nearest = fits[moved_away], nearest[moved_away]
        enough = fits.sum(1) >= MIN_COMMON
        _, first = np.unique(np.where(fits, nearest, -1)[enough], axis=0, return_index=True)
        masks.append(fits[enough][first])
        places.append(nearest[enough][first])
    return np.concatenate(masks), np.concatenate(places)


def alike(a, b):
    """True where two radii can be taken for each other."""
    return np.maximum(a, b) < MAX_RADIUS_RATIO * np.minimum(a, b)
