"""Which pairs of images the database holds, and which images of a group are mapped first.

With labels known a match says nothing that its label does not: it is enough that the images of a circle hang together
(its track). In large sets a few images that see the scene from all sides, the skeleton, are paired with one another,
and every other image with those of them that stand nearest or that its circles need.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stcal.design import BoardDesign
from stcal.errors import DegenerateError
from stcal.geometry.plane import camera_from_plane, fit_homography
from stcal.labels import DotLabel
from stcal.sfm.data.observations import ImageObservations

GraphKind = Literal["all", "sparse"]
SPARSE_FROM = 80
"""Sets of more images get a sparse graph: from here on it is the faster one (scripts/studies/scale_study.py)."""
MIN_SHARED = 6
"""Pairs of images with fewer labels in common are not written."""
SKELETON = 20
"""Images of a group that are mapped first; groups of no more are mapped as they are."""
MIN_VIEWS = 3
"""Of every circle in the skeleton, where the group has as many."""
NEIGHBOURS = 3
"""Images of the skeleton that each other image is paired with at least."""
MIN_DOTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class ImageGraph:
    """``pairs`` : (n, 2) indices of images, ascending; ``skeleton`` : by group the indices that are mapped first."""

    kind: GraphKind
    pairs: np.ndarray
    skeleton: dict[str, np.ndarray]


def image_graph(
    observations: Sequence[ImageObservations], board: BoardDesign, kind: GraphKind | None = None
) -> ImageGraph:
    """Pairs of images with at least six labels in common: all, or so few that every track still hangs together.

    ``kind`` : sparse above ``SPARSE_FROM`` images where None.
    """
    kind = kind_of_graph(len(observations), kind)
    seen = incidence(observations)
    shared = (seen.astype(np.float32) @ seen.T.astype(np.float32)).astype(np.int32)
    groups: dict[str, list[int]] = {}
    for i, image in enumerate(observations):
        groups.setdefault(image.group, []).append(i)
    members = {name: np.array(indices) for name, indices in groups.items()}
    if kind == "all":
        return ImageGraph(kind, np.argwhere(np.triu(shared, 1) >= MIN_SHARED), members)
    skeleton, pairs = {}, set()
    for name, indices in members.items():
        direction = np.array([_direction(observations[i], board) for i in indices])
        chosen = _skeleton(direction, seen[indices])
        skeleton[name] = indices[chosen]
        pairs |= {(i, j) for i, j in combinations(skeleton[name].tolist(), 2) if shared[i, j] >= MIN_SHARED}
        pairs |= _links(indices, chosen, direction, seen, shared)
    _join_tracks(pairs, seen, shared, np.isin(np.arange(len(observations)), np.concatenate([*skeleton.values()])))
    return ImageGraph(kind, np.array(sorted(pairs), int).reshape(-1, 2), skeleton)


def kind_of_graph(images: int, kind: GraphKind | None = None) -> GraphKind:
    """Which graph so many images get, where it is not given."""
    return kind or ("sparse" if images > SPARSE_FROM else "all")


def incidence(observations: Sequence[ImageObservations]) -> np.ndarray:
    """Which image sees which circle, (images, circles) bool; dots of the board are others in every group."""
    column: dict[tuple[str, str], int] = {}
    rows, columns = [], []
    for i, image in enumerate(observations):
        for label in image.labels:
            columns.append(column.setdefault((image.group if isinstance(label, DotLabel) else "", label), len(column)))
        rows += [i] * len(image)
    seen = np.zeros((len(observations), len(column)), bool)
    seen[rows, columns] = True
    return seen


def _direction(image: ImageObservations, board: BoardDesign) -> np.ndarray:
    """Unit vector (3,) from the board's middle to the camera, board frame; nan where the board does not tell."""
    dots = [k for k, label in enumerate(image.labels) if isinstance(label, DotLabel)]
    if len(dots) >= MIN_DOTS:
        design = board.places_mm(image.labels[k] for k in dots)[:, :2]
        try:
            camera_from_board = camera_from_plane(fit_homography(design, image.centre[dots]))
        except DegenerateError:
            return np.full(3, np.nan)
        middle = board.pitch_mm * np.array([board.columns - 1, board.rows - 1, 0]) / 2
        way = camera_from_board.inverse().translation - middle
        return way / np.linalg.norm(way)
    return np.full(3, np.nan)


def _skeleton(direction: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Indices (into the group) of images far apart that see every circle from ``MIN_VIEWS`` places."""
    count = len(direction)
    if count <= SKELETON:
        return np.arange(count)
    known = np.isfinite(direction[:, 0])
    chosen = [int(np.argmax(seen.sum(1) + count * known))]
    nearest = np.full(count, -1.0)
    while known[chosen[-1]] and len(chosen) < SKELETON:
        nearest = np.fmax(nearest, direction @ direction[chosen[-1]])
        apart = np.where(known, nearest, 1.0)
        apart[chosen] = 1.0
        if apart.min() >= 1.0:
            break
        chosen.append(int(np.argmin(apart)))
    wanted = np.minimum(seen.sum(0), MIN_VIEWS)
    while (short := seen[chosen].sum(0) < wanted).any():
        gain = seen[:, short].sum(1)
        gain[chosen] = 0
        chosen.append(int(np.argmax(gain)))
    return np.sort(chosen)


def _links(indices, chosen, direction, seen, shared) -> set[tuple[int, int]]:
    """Pairs of every other image of a group with the skeleton: the nearest, and those that its circles need."""
    pairs = set()
    skeleton = indices[chosen]
    for k in np.setdiff1d(np.arange(len(indices)), chosen):
        i = indices[k]
        near = np.nan_to_num(direction[chosen] @ direction[k], nan=-1.0)
        order = skeleton[np.argsort(-near, kind="stable")]
        order = order[shared[i, order] >= MIN_SHARED]
        picked = list(order[:NEIGHBOURS])
        rest = list(order[NEIGHBOURS:])
        open_labels = seen[i] & seen[order].any(0) & ~seen[picked].any(0)
        while open_labels.any():
            best = max(rest, key=lambda j: int((seen[j] & open_labels).sum()))
            picked.append(best)
            rest.remove(best)
            open_labels &= ~seen[best]
        pairs |= {(int(min(i, j)), int(max(i, j))) for j in picked}
    return pairs


def _join_tracks(pairs: set[tuple[int, int]], seen: np.ndarray, shared: np.ndarray, preferred: np.ndarray) -> None:
    """Add pairs until the images of every circle hang together as far as all pairs would make them."""
    for column in range(seen.shape[1]):
        images = np.flatnonzero(seen[:, column])
        part = track_parts(np.array(sorted(pairs), int).reshape(-1, 2), images)
        for candidates in (preferred[images], np.ones(len(images), bool)):
            if part.max(initial=0) == 0:
                break
            own = np.flatnonzero(candidates)
            i, j = np.triu_indices(len(own), 1)
            i, j = own[i], own[j]
            count = shared[images[i], images[j]]
            useful = np.flatnonzero((part[i] != part[j]) & (count >= MIN_SHARED))
            for k in useful[np.argsort(-count[useful], kind="stable")]:
                a, b = part[i[k]], part[j[k]]
                if a != b:
                    part[part == max(a, b)] = min(a, b)
                    pairs.add((int(images[i[k]]), int(images[j[k]])))


def track_parts(pairs: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Number of the connected part that each of the ``images`` (ascending) lies in, over ``pairs`` among them."""
    inside = np.isin(pairs, images).all(1)
    i, j = np.searchsorted(images, pairs[inside]).T
    matrix = coo_array((np.ones(len(i)), (i, j)), shape=(len(images), len(images)))
    return connected_components(matrix, directed=False)[1]
