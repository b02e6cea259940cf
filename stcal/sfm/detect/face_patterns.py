"""Faces of the target: two neighbouring candidates that may be two circles of a design determine a map of the plane,
which is extended to all circles of a face. A face is named only if one reading explains more circles than every other.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.geometry.plane import homography_jacobian, singular_values
from stcal.lookalikes import common_circles, mirrored_circles
from stcal.sfm.detect.candidates import MAX_AXIS_RATIO, Candidates, FaceSighting, OpenFace, grow_matches

MIN_NAMING = 6  # smallest number of circles that can name a face: four determine a homography, two more confirm it
NEIGHBOURS_IN_DESIGN = 3
NEIGHBOURS_IN_IMAGE = 12
PAIR_TOLERANCE = 0.3  # relative tolerance of distance and size of a pair after the map of one ellipse to a circle
SUPPORT = 5  # number of nearest circles that are predicted from a pair
MIN_SUPPORT = 2  # number of the predicted circles that must be present before the hypothesis is grown
FIRST_HYPOTHESES = 300  # number of the best supported hypotheses of an image that are all grown, so that rivals compete
MAX_TRIES = 8
"""Number of further hypotheses grown from each outline without a reading: a dim face ranks behind all clutter."""
AT_ONCE = 32  # number of hypotheses that are grown side by side, ahead of their turn
MAX_CONTRAST_RATIO = 4.0
"""Largest ratio of contrasts of neighbouring circles of one face, which a shadow or a glare may cross."""
MAX_SIZE_RATIO = 1.25
"""Largest ratio of measured to designed size between two circles of a face, in addition to one pixel of diameter."""


@dataclass(frozen=True, slots=True, eq=False)
class _Starts:
    """n hypotheses, the best supported first."""

    origin: np.ndarray  # (n,) first outline
    face: np.ndarray  # (n,) number of the face
    circles: np.ndarray  # (n, s) of this face
    candidates: np.ndarray  # (n, s) that match them, −1 if there is none

    def agree(self, face: int, index: np.ndarray) -> np.ndarray:
        """Returns the hypotheses of a face that agree with a reading, ``index`` by circle, in two circles or more."""
        rows = np.flatnonzero(self.face == face)
        matches = self.candidates[rows]
        return rows[((matches >= 0) & (index[self.circles[rows]] == matches)).sum(1) >= 2]

    def index(self, ranks: np.ndarray, width: int) -> np.ndarray:
        """Returns the candidate of each circle of the hypotheses' faces, (ranks, width), −1 if there is none."""
        index = np.full((len(ranks), width), -1)
        row, column = np.nonzero(self.candidates[ranks] >= 0)
        index[row, self.circles[ranks][row, column]] = self.candidates[ranks][row, column]
        return index


class _Pairs:
    """p distinct pairs of neighbouring circles of a design, each with the s circles nearest to the first."""

    def __init__(self, target: TargetDesign):
        faces, most = target.faces, max(len(face.ids) for face in target.faces)
        width = min(SUPPORT + 2, most)
        uses_of: dict[tuple, list[tuple[int, np.ndarray]]] = {}
        for number, face in enumerate(faces):
            distance = np.linalg.norm(face.xy_mm[:, None] - face.xy_mm, axis=2)
            for nearest in np.argsort(distance, axis=1, kind="stable")[:, :width]:
                offset = np.round(face.xy_mm[nearest] - face.xy_mm[nearest[0]], 6)
                same = (*offset.ravel(), *np.round(face.radius_mm[nearest], 6))
                for second in range(1, min(NEIGHBOURS_IN_DESIGN, len(nearest) - 1) + 1):
                    uses_of.setdefault((second, *same), []).append((number, nearest))
        firsts = [(faces[number], nearest, width - len(nearest)) for (number, nearest), *_ in uses_of.values()]
        # (p, s, 2) places relative to the first, (p, s) radii, and a mask, as small faces have fewer circles
        self.offset = np.array([np.pad(f.xy_mm[c] - f.xy_mm[c[0]], ((0, more), (0, 0))) for f, c, more in firsts])
        self.radius = np.array([np.pad(f.radius_mm[c], (0, more), constant_values=1.0) for f, c, more in firsts])
        self.there = np.array([np.arange(width) < len(c) for _, c, _ in firsts])
        self.second = np.array([second for second, *_ in uses_of], int)  # (p,) index of the pair's second circle
        self.uses = np.cumsum([0, *map(len, uses_of.values())])  # (p + 1,) start of each pair's rows in the next two
        every = [use for uses in uses_of.values() for use in uses]
        self.face = np.array([number for number, _ in every], int)  # (u,) number of the face
        # (u, s) numbers of the circles in it, −1 if there is none
        self.circles = np.array([np.pad(c, (0, width - len(c)), constant_values=-1) for _, c in every])
        # (f, m, 2) and (f, m): all circles of the f faces, mm; a radius of 0 is behind the last circle of a face
        self.face_xy = np.array([np.pad(f.xy_mm, ((0, most - len(f.ids)), (0, 0)), "wrap") for f in faces])
        self.face_radius = np.array([np.pad(f.radius_mm, (0, most - len(f.ids))) for f in faces])


_pairs = lru_cache(maxsize=8)(_Pairs)


def find_faces(candidates: Candidates, target: TargetDesign) -> tuple[list[FaceSighting], list[OpenFace]]:
    """Finds all faces of a design among the candidates: those that are unambiguously named, and patterns without a
    name. A face in view twice occurs twice; the mirror image of a face may look like another one."""
    readings: list[FaceSighting] = []
    if len(candidates) < MIN_NAMING or not target.faces:
        return [], []
    starts, tries = _hypotheses(candidates, target), np.zeros(len(candidates), int)
    is_open, explained = np.ones(len(starts.origin), bool), np.zeros(len(candidates), bool)
    grown: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}
    for rank, first in enumerate(starts.origin.tolist()):
        if rank == FIRST_HYPOTHESES:
            for reading in readings:
                explained[reading.rows] = True
        if not is_open[rank] or tries[first] == MAX_TRIES or explained[first]:
            continue
        tries[first] += rank >= FIRST_HYPOTHESES
        if rank not in grown:
            wanted = is_open & ((tries < MAX_TRIES) & ~explained)[starts.origin]
            wanted[:rank], wanted[rank] = False, True
            grown = _grown(candidates, target, starts, np.flatnonzero(wanted)[:AT_ONCE])
        match, number = grown[rank], int(starts.face[rank])
        face = target.faces[number]
        if match is None:
            continue
        depth = face.xy_mm[0] @ match[1][2, :2] + match[1][2, 2]
        if np.linalg.det(match[1]) * depth < 0:  # on the mirror image of a face, its Z points away from the camera
            index = _of_one_size(candidates, face, *match)
            is_open[starts.agree(number, index)] = False
            circles = np.flatnonzero(index >= 0)
            if len(circles) >= min(MIN_NAMING, len(face.ids)):
                readings.append(FaceSighting(face.id, index[circles], circles))
    return _decide(readings, target)


def _grown(candidates: Candidates, target: TargetDesign, starts: _Starts, ranks: np.ndarray):
    """Grows hypotheses side by side: returns circles and homography by rank, None if too few circles agree."""
    circles, face = _pairs(target), starts.face[ranks]
    index = starts.index(ranks, circles.face_radius.shape[1])
    found = grow_matches(candidates, index, circles.face_xy[face], circles.face_radius[face])
    size = [len(target.faces[number].ids) for number in face.tolist()]
    grown = zip(ranks.tolist(), *found, size, strict=True)
    return {rank: (own[:n], homography) if sure else None for rank, own, homography, sure, n in grown}


def find_mirrored(candidates: Candidates, target: TargetDesign, named: Sequence[FaceSighting]) -> tuple[str, ...]:
    """Returns the ids of faces that appear mirrored; none if a ``named`` face shows that the image is not."""
    alike = mirror_images(target)
    if any(each.face not in alike for each in named):
        return ()
    return tuple(each.face for each in find_faces(candidates.mirrored(), target)[0] if each.face not in alike)


def _hypotheses(candidates: Candidates, target: TargetDesign) -> _Starts:
    """Returns all pairs of neighbouring outlines that may be a pair of the design, with their support."""
    pairs = _pairs(target)
    first, step, ratio = _candidate_pairs(candidates)
    every = np.arange(len(pairs.second))
    neighbour, own_radius = pairs.offset[every, pairs.second], pairs.radius[:, 0]
    length, distance = np.linalg.norm(step, axis=1), np.linalg.norm(neighbour, axis=1)
    ok = np.abs(length * (own_radius / distance)[:, None] - 1) < PAIR_TOLERANCE
    ok &= np.abs(ratio * (own_radius / pairs.radius[every, pairs.second])[:, None] - 1) < PAIR_TOLERANCE
    pair, row = np.nonzero(ok)
    linear = candidates.shape[first[row]] @ _turn(neighbour[pair] * [1, -1], step[row]) * [1, -1]
    support = _support(candidates, pairs, pair, candidates.xy[first[row]], linear)
    hits = (support >= 0).sum(1)
    supported = np.flatnonzero(hits >= 2 + MIN_SUPPORT)
    origin = first[row[supported]]
    best = np.lexsort((-candidates.contrast[origin], -hits[supported]))
    supported, origin = supported[best], origin[best]
    begin, count = pairs.uses[pair[supported]], np.diff(pairs.uses)[pair[supported]]
    use = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
    return _Starts(
        np.repeat(origin, count), pairs.face[use], pairs.circles[use], np.repeat(support[supported], count, axis=0)
    )


def _candidate_pairs(candidates: Candidates):
    """Returns neighbours of similar shape: first, step to the second if the first is a unit circle, ratio of sizes."""
    k = min(NEIGHBOURS_IN_IMAGE + 1, len(candidates))
    second = candidates.tree.query(candidates.xy, k=k)[1][:, 1:].ravel()
    first = np.repeat(np.arange(len(candidates)), k - 1)
    to_circle = np.linalg.inv(candidates.shape)[first]
    largest, smallest = singular_values(to_circle @ candidates.shape[second])
    ratio = candidates.radius[second] / candidates.radius[first]
    ok = (largest < MAX_AXIS_RATIO * ratio) & (smallest * MAX_AXIS_RATIO > ratio)
    contrast = candidates.contrast[second] / candidates.contrast[first]
    ok &= (contrast < MAX_CONTRAST_RATIO) & (contrast > 1 / MAX_CONTRAST_RATIO)
    first, second, ratio = first[ok], second[ok], ratio[ok]
    step = np.einsum("nij,nj->ni", to_circle[ok], candidates.xy[second] - candidates.xy[first])
    return first, step, ratio


def _turn(step_plane: np.ndarray, step_image: np.ndarray) -> np.ndarray:
    """Returns the rotations with scale, (n, 2, 2), that map plane vectors (n, 2) to image vectors (n, 2)."""
    (a, b), (x, y) = step_plane.T, step_image.T
    square = a * a + b * b
    c, s = (a * x + b * y) / square, (a * y - b * x) / square
    return np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1)


def _support(candidates: Candidates, pairs: _Pairs, pair: np.ndarray, xy: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Candidates near the affine prediction of the circles around the first: (h, s), −1 if there is none."""
    offset, radius = pairs.offset[pair], pairs.radius[pair]
    predicted = xy[:, None] + offset @ np.swapaxes(linear, 1, 2)
    _, nearest = candidates.tree.query(predicted)
    error = (candidates.xy[nearest] - predicted) @ np.swapaxes(np.linalg.inv(linear), 1, 2)
    size = candidates.radius[nearest] / np.sqrt(np.abs(np.linalg.det(linear)))[:, None]
    ok = np.linalg.norm(error, axis=2) < 0.4 * radius + 0.12 * np.linalg.norm(offset, axis=2)
    ok &= (np.abs(size / radius - 1) < 0.5) & pairs.there[pair]
    return np.where(ok, nearest, -1)


def _of_one_size(candidates: Candidates, face: FaceDesign, index: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Returns ``index`` without circles whose ratio of size to design deviates from the median."""
    local = homography_jacobian(homography, face.xy_mm)
    expected = face.radius_mm * np.sqrt(np.abs(np.linalg.det(local)))
    ratio = candidates.radius[index] / expected
    middle = np.median(ratio[index >= 0])
    allowed = MAX_SIZE_RATIO * (1 + candidates.px / (2 * middle * expected))
    return np.where((ratio < middle * allowed) & (ratio * allowed > middle), index, -1)


def _decide(readings: list[FaceSighting], target: TargetDesign) -> tuple[list[FaceSighting], list[OpenFace]]:
    """Keeps the readings that explain more circles than every other reading of the same candidates."""
    readings = sorted(readings, key=lambda r: -len(r.rows))
    named: list[FaceSighting] = []
    refused: list[OpenFace] = []
    settled: set[int] = set()
    for reading in readings:
        used, read = set(reading.rows), (reading.face, list(reading.rows), list(reading.circles))
        if settled & used:
            continue
        settled |= used
        rivals = [r for r in readings if used & set(r.rows) and len(r.rows) >= len(reading.rows)]
        ambiguous = [r for r in rivals if (r.face, *map(list, (r.rows, r.circles))) != read]
        if ambiguous or not is_named(target.face(reading.face), reading.circles.tolist(), target):
            refused.append((reading, *ambiguous))
        else:
            named.append(reading)
    return named, refused


def confusable(face: FaceDesign, target: TargetDesign) -> set[frozenset[int]]:
    """Returns the sets of a face's circles that another reading explains as well; such a set names no face."""
    return set().union(
        *(common_circles(face.xy_mm, face.radius_mm, o.xy_mm, o.radius_mm, o.id == face.id) for o in target.faces)
    )


def in_common(face: FaceDesign, other: FaceDesign, mirrored: bool = False) -> int:
    """Returns the largest number of circles that coincide with another face, or with the own after a turn; 0 below
    ``MIN_COMMON``. The face is moved rigidly or, if ``mirrored``, turned over."""
    xy = np.asarray(face.xy_mm) * [-1 if mirrored else 1, 1]
    same = face.id == other.id and not mirrored
    found = common_circles(xy, face.radius_mm, other.xy_mm, other.radius_mm, same)
    return max(map(len, found), default=0)


def is_named(face: FaceDesign, circles: Iterable[int], target: TargetDesign) -> bool:
    """Returns whether the circles found name the face, as no other reading explains them all."""
    found = frozenset(circles)
    return not any(found <= rival for rival in confusable(face, target))


def mirror_images(target: TargetDesign) -> dict[str, tuple[str, ...]]:
    """Returns by face the faces that its mirror image looks like, whole and with its radii; others have no entry."""
    found: dict[str, tuple[str, ...]] = {}
    for face, other in product(target.faces, target.faces):
        pairs = mirrored_circles(face.xy_mm, face.radius_mm, other.xy_mm, other.radius_mm)
        if any(len(face.ids) == len(other.ids) == len(own) for own in pairs):
            found[face.id] = (*found.get(face.id, ()), other.id)
    return found
