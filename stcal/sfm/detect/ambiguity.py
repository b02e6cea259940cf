"""Which circles of a face also fit another face, or the same face turned: they cannot tell the two apart."""

from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

from stcal.design import FaceDesign, TargetDesign

MAX_GAP = 0.5
"""Circles of two designs coincide when their centres are closer than this many radii …"""
MAX_RADIUS_RATIO = 1.3
"""… and their radii differ by less than this factor."""
MIN_COMMON = 4
BLOCK = 4000
"""Motions looked at together: bounds the memory for patterns of many circles."""


def confusable(target: TargetDesign) -> dict[str, tuple[frozenset[int], ...]]:
    """For every face the sets of its circles (places in the design) that another reading explains as well.

    A face is only named by circles that are not all in one of these sets.
    """
    key = tuple((f.id, f.xy_mm.tobytes(), f.radius_mm.tobytes()) for f in target.faces)
    return _confusable(key)


@lru_cache(maxsize=8)
def _confusable(key) -> dict[str, tuple[frozenset[int], ...]]:
    faces = [(face_id, np.frombuffer(xy).reshape(-1, 2), np.frombuffer(radius)) for face_id, xy, radius in key]
    found = {}
    for face_id, xy, radius in faces:
        sets: set[frozenset[int]] = set()
        for other_id, other_xy, other_radius in faces:
            for common in _common(xy, radius, other_xy, other_radius, same=face_id == other_id):
                sets.add(common)
        found[face_id] = tuple(s for s in sets if not any(s < t for t in sets))
    return found


def _common(xy, radius, other_xy, other_radius, same: bool) -> set[frozenset[int]]:
    """Sets of circles that coincide under some rigid motion of the plane that puts two circles onto two."""
    n, m = len(xy), len(other_xy)
    k, near = (g.ravel() for g in np.meshgrid(np.arange(n), np.arange(n)))
    p, q = (g.ravel() for g in np.meshgrid(np.arange(m), np.arange(m)))
    k, near, p, q = k[k != near], near[k != near], p[p != q], q[p != q]
    step, other_step = xy[near] - xy[k], other_xy[q] - other_xy[p]
    length, other_length = np.linalg.norm(step, axis=1), np.linalg.norm(other_step, axis=1)
    slack = MAX_GAP * min(radius.min(), other_radius.min())
    like = _alike(radius[k][:, None], other_radius[p]) & _alike(radius[near][:, None], other_radius[q])
    a, b = np.nonzero((np.abs(length[:, None] - other_length) < slack) & like)
    sets: set[frozenset[int]] = set()
    for start in range(0, len(a), BLOCK):
        block = slice(start, start + BLOCK)
        fits = _coincide(
            xy, radius, other_xy, other_radius, (k[a[block]], p[b[block]]), step[a[block]], other_step[b[block]], same
        )
        sets |= {frozenset(np.flatnonzero(row).tolist()) for row in np.unique(fits, axis=0) if row.sum() >= MIN_COMMON}
    return sets


def _coincide(xy, radius, other_xy, other_radius, origin, step, other_step, same: bool) -> np.ndarray:
    """For every motion, given by two circles put onto two, the mask (motions, n) of circles that coincide."""
    turn = np.arctan2(other_step[:, 1], other_step[:, 0]) - np.arctan2(step[:, 1], step[:, 0])
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x, y = np.moveaxis(xy - xy[origin[0]][:, None], 2, 0)
    moved = np.stack([c * x - s * y, s * x + c * y], -1) + other_xy[origin[1]][:, None]
    gap, nearest = KDTree(other_xy).query(moved)
    fits = (gap < MAX_GAP * np.minimum(radius, other_radius[nearest])) & _alike(radius[None], other_radius[nearest])
    if same:  # the reading itself is no rival
        fits = fits[~((nearest == np.arange(len(xy))) | ~fits).all(1)]
    return fits


def _alike(a, b):
    return np.maximum(a, b) < MAX_RADIUS_RATIO * np.minimum(a, b)


def is_named(face: FaceDesign, found: np.ndarray, target: TargetDesign) -> bool:
    """Whether the circles found (mask) name the face: no other reading explains them all."""
    circles = frozenset(np.flatnonzero(found).tolist())
    return not any(circles <= rival for rival in confusable(target)[face.id])


def mirror_images(target: TargetDesign) -> dict[str, str]:
    """For every face whose image in a mirror passes for a face, that face."""
    key = tuple((f.id, f.xy_mm.tobytes(), f.radius_mm.tobytes()) for f in target.faces)
    return _mirror_images(key)


@lru_cache(maxsize=8)
def _mirror_images(key) -> dict[str, str]:
    faces = [(face_id, np.frombuffer(xy).reshape(-1, 2), np.frombuffer(radius)) for face_id, xy, radius in key]
    found = {}
    for face_id, xy, radius in faces:
        for other_id, other_xy, other_radius in faces:
            most = max(map(len, _common(xy * [1, -1], radius, other_xy, other_radius, same=False)), default=0)
            if most == len(xy) == len(other_xy):
                found[face_id] = other_id
    return found
