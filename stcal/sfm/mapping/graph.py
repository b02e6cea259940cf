"""Pairs of images in the database, and the images of a group that are mapped first.

Labels are known, so a match adds no information to them: it is enough that the images of each circle are connected
(its track). In large sets a few images that see the scene from all sides, the skeleton, are paired with one another.
Every other image is paired with the images of the skeleton that are nearest or that its circles need.
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
"""Largest set of images that gets all pairs. Above it the sparse graph is faster (scripts/studies/scale_study.py)."""
MIN_SHARED = 6
"""Smallest number of common labels of a pair of images that is written."""
SKELETON = 20
"""Number of images of a group that are mapped first. Smaller groups are mapped as a whole."""
MIN_VIEWS = 3
"""Smallest number of views of every circle in the skeleton, if the group has that many."""
NEIGHBOURS = 3
"""Smallest number of skeleton images that each image outside the skeleton is paired with."""
MIN_DOTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class ImageGraph:
    """Pairs of images to match.

    ``pairs`` : (n, 2) indices of images, ascending; ``skeleton`` : indices of the images mapped first, by group.
    """

    kind: GraphKind
    pairs: np.ndarray
    skeleton: dict[str, np.ndarray]


def image_graph(
    observations: Sequence[ImageObservations], board: BoardDesign, kind: GraphKind | None = None
) -> ImageGraph:
    """Returns all pairs of images with at least six common labels, or just enough to keep every track connected.

    ``kind`` : if None, sparse for more than ``SPARSE_FROM`` images.
    """
    kind = kind_of_graph(len(observations), kind)
    sees = incidence(observations)
    shared = (sees.astype(np.float32) @ sees.T.astype(np.float32)).astype(np.int32)
    groups: dict[str, list[int]] = {}
    for i, image in enumerate(observations):
        groups.setdefault(image.group, []).append(i)
    members = {name: np.array(indices) for name, indices in groups.items()}
    if kind == "all":
        return ImageGraph(kind, np.argwhere(np.triu(shared, 1) >= MIN_SHARED), members)
    skeleton, pairs = {}, set()
    for name, indices in members.items():
        direction = np.array([_direction(observations[i], board) for i in indices])
        chosen = _skeleton(direction, sees[indices])
        skeleton[name] = indices[chosen]
        pairs |= {(i, j) for i, j in combinations(skeleton[name].tolist(), 2) if shared[i, j] >= MIN_SHARED}
        pairs |= _links(indices, chosen, direction, sees, shared)
    _join_tracks(pairs, sees, shared, np.isin(np.arange(len(observations)), np.concatenate([*skeleton.values()])))
    return ImageGraph(kind, np.array(sorted(pairs), int).reshape(-1, 2), skeleton)


def kind_of_graph(images: int, kind: GraphKind | None = None) -> GraphKind:
    """Returns the given kind of graph, or the default for this number of images."""
    return kind or ("sparse" if images > SPARSE_FROM else "all")


def incidence(observations: Sequence[ImageObservations]) -> np.ndarray:
    """Returns which image sees which circle, (images, circles) bool. Dots of two groups are different circles."""
    column: dict[tuple[str, str], int] = {}
    rows, columns = [], []
    for i, image in enumerate(observations):
        for label in image.labels:
            columns.append(column.setdefault((image.group if isinstance(label, DotLabel) else "", label), len(column)))
        rows += [i] * len(image)
    sees = np.zeros((len(observations), len(column)), bool)
    sees[rows, columns] = True
    return sees


def _direction(image: ImageObservations, board: BoardDesign) -> np.ndarray:
    """Returns the unit vector (3,) from the board's middle to the camera, board frame; nan if there is no pose."""
    dots = [k for k, label in enumerate(image.labels) if isinstance(label, DotLabel)]
    if len(dots) >= MIN_DOTS:
        design = board.places_mm(image.labels[k] for k in dots)[:, :2]
        try:
            camera_from_board = camera_from_plane(fit_homography(design, image.centre[dots]))
        except DegenerateError:
            return np.full(3, np.nan)
        middle = board.pitch_mm * np.array([board.columns - 1, board.rows - 1, 0]) / 2
        offset = camera_from_board.inverse().translation - middle
        return offset / np.linalg.norm(offset)
    return np.full(3, np.nan)


def _skeleton(direction: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Returns indices (into the group) of images far apart that see every circle at least ``MIN_VIEWS`` times."""
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
    """Returns pairs of the group's other images with skeleton images: the nearest, and those their circles need."""
    pairs = set()
    skeleton = indices[chosen]
    for k in np.setdiff1d(np.arange(len(indices)), chosen):
        i = indices[k]
        near = np.nan_to_num(direction[chosen] @ direction[k], nan=-1.0)
        order = skeleton[np.argsort(-near, kind="stable")]
        order = order[shared[i, order] >= MIN_SHARED]
        picked = list(order[:NEIGHBOURS])
        candidates = list(order[NEIGHBOURS:])
        open_labels = seen[i] & seen[order].any(0) & ~seen[picked].any(0)
        while open_labels.any():
            best = max(candidates, key=lambda j: int((seen[j] & open_labels).sum()))
            picked.append(best)
            candidates.remove(best)
            open_labels &= ~seen[best]
        pairs |= {(int(min(i, j)), int(max(i, j))) for j in picked}
    return pairs


def _join_tracks(pairs: set[tuple[int, int]], seen: np.ndarray, shared: np.ndarray, preferred: np.ndarray) -> None:
    """Adds pairs until the images of every circle are as connected as all pairs would make them."""
    for column in range(seen.shape[1]):
        images = np.flatnonzero(seen[:, column])
        component = track_parts(np.array(sorted(pairs), int).reshape(-1, 2), images)
        for allowed in (preferred[images], np.ones(len(images), bool)):
            if component.max(initial=0) == 0:
                break
            usable = np.flatnonzero(allowed)
            i, j = np.triu_indices(len(usable), 1)
            i, j = usable[i], usable[j]
            count = shared[images[i], images[j]]
            useful = np.flatnonzero((component[i] != component[j]) & (count >= MIN_SHARED))
            for k in useful[np.argsort(-count[useful], kind="stable")]:
                a, b = component[i[k]], component[j[k]]
                if a != b:
                    component[component == max(a, b)] = min(a, b)
                    pairs.add((int(images[i[k]]), int(images[j[k]])))


def track_parts(pairs: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Returns the connected component of each of the ``images`` (ascending) in the graph of ``pairs`` among them."""
    inside = np.isin(pairs, images).all(1)
    i, j = np.searchsorted(images, pairs[inside]).T
    matrix = coo_array((np.ones(len(i)), (i, j)), shape=(len(images), len(images)))
    return connected_components(matrix, directed=False)[1]
