"""Faces of the target: the pattern is found in the face plane, after a homography, and the face named there.

Document 000 walks along image directions and decides by dot products, which perspective breaks. Here two
neighbouring candidates that could be two neighbouring circles of a design fix a map of the plane; it is grown to
all circles of a face and every reading of the same candidates competes with it. A face is named only when one
reading explains more circles than every other.
"""

from dataclasses import dataclass

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.geometry.plane import homography_jacobian
from stcal.sfm.detect.ambiguity import is_named, mirror_images
from stcal.sfm.detect.candidates import MAX_AXIS_RATIO, Candidates, grow_match, singular_values

NEIGHBOURS_IN_DESIGN = 3
NEIGHBOURS_IN_IMAGE = 12
PAIR_TOLERANCE = 0.3
"""Relative tolerance of distance and size of a pair after the map of one ellipse to a circle."""
SUPPORT = 5
"""So many nearest circles are predicted from a pair …"""
MIN_SUPPORT = 2
"""… and so many of them must be there before the hypothesis is grown."""
FIRST_HYPOTHESES = 300
"""The best supported ones in an image are all grown, so that rivals meet; of the others …"""
MAX_TRIES = 8
"""… at most so many from each outline that is in no reading yet: a dim face comes after all clutter."""
MAX_CONTRAST_RATIO = 4.0
"""Between neighbouring circles of one face, which a shadow or a glare may cross."""
MIN_CIRCLES = 6
"""A homography takes four circles; two more confirm it."""
MAX_SIZE_RATIO = 1.25
"""Between the sizes of two circles of a face, each over its design's, on top of a pixel of their diameters: the equal
discs of a printed grid are no large and small circles."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceReading:
    """One face in one image: ``index`` (n circles,) into the candidates, −1 where missing; ``homography`` from the
    face plane (mm) into normalised coordinates."""

    face: FaceDesign
    index: np.ndarray
    homography: np.ndarray

    def count(self) -> int:
        """Circles found."""
        return int((self.index >= 0).sum())

    def used(self) -> np.ndarray:
        """Candidates that it uses."""
        return self.index[self.index >= 0]


@dataclass(frozen=True, slots=True, eq=False)
class RefusedReading:
    """Candidates that were not named: ``readings`` that fit them, the ``value`` that did not pass the ``limit`` of
    ``gate``."""

    readings: tuple[FaceReading, ...]
    gate: str
    value: float
    limit: float

    def used(self) -> np.ndarray:
        """Candidates that any of the readings uses."""
        return np.unique(np.concatenate([each.used() for each in self.readings]))


@dataclass(frozen=True, slots=True, eq=False)
class FaceFinding:
    """``faces`` : named with certainty, a face in view twice with two readings; ``refused`` : what was seen and not
    named, and why."""

    faces: tuple[FaceReading, ...]
    refused: tuple[RefusedReading, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two neighbouring circles of a design with the circles around the first, and the faces that have all of them.

    ``offset`` : (s, 2) places of the circles around, from the first; ``radius`` : (s,), the first's own in front;
    ``second`` : which of them is the neighbour; ``faces`` : with the circles' numbers (s,) in each.
    """

    offset: np.ndarray
    radius: np.ndarray
    second: int
    faces: list[tuple[FaceDesign, np.ndarray]]


def _pairs(target: TargetDesign) -> list[_Pair]:
    """All pairs of a design, alike ones of several faces once."""
    pairs: dict[tuple, _Pair] = {}
    for face in target.faces:
        distance = np.linalg.norm(face.xy_mm[:, None] - face.xy_mm, axis=2)
        for row in np.argsort(distance, axis=1, kind="stable"):
            near = row[: SUPPORT + 2]
            offset, radius = face.xy_mm[near] - face.xy_mm[near[0]], face.radius_mm[near]
            same = (*np.round(offset, 6).ravel(), *np.round(radius, 6))
            for second in range(1, min(NEIGHBOURS_IN_DESIGN, len(near) - 1) + 1):
                pair = pairs.setdefault((second, *same), _Pair(offset, radius, second, []))
                pair.faces.append((face, near))
    return list(pairs.values())


class FaceFinder:
    """Finds the faces of one design."""

    def __init__(self, target: TargetDesign):
        self.target = target

    def find(self, candidates: Candidates) -> FaceFinding:
        """All faces among the candidates. The image of a face in a mirror can pass for another face, which only the
        group can tell."""
        readings: list[FaceReading] = []
        known = {face.id: np.zeros((0, len(face.ids)), int) for face in self.target.faces}
        tries = np.zeros(len(candidates), int)
        explained: set[int] = set()
        starts = self._hypotheses(candidates) if len(candidates) >= MIN_CIRCLES else []
        for rank, (first, face, index) in enumerate(starts):
            if rank == FIRST_HYPOTHESES:
                explained = {i for r in readings for i in r.used() if r.count() >= needed_circles(r.face)}
            matched = index >= 0
            if tries[first] == MAX_TRIES or first in explained:
                continue
            if ((known[face.id][:, matched] == index[matched]).sum(1) >= 2).any():
                continue
            if rank >= FIRST_HYPOTHESES:
                tries[first] += 1
            grown = grow_match(candidates, index, face.xy_mm, face.radius_mm)
            if grown is not None and _seen_from_outside(grown[1], face):
                readings.append(FaceReading(face, _of_one_size(candidates, face, *grown), grown[1]))
                known[face.id] = np.vstack([known[face.id], readings[-1].index])
        return _decide(readings, self.target)

    def find_mirrored(self, candidates: Candidates, named: tuple[FaceReading, ...]) -> tuple[FaceReading, ...]:
        """Faces that the image shows as a mirror does, if none of those ``named`` in it says that it does not."""
        if any(reading.face.id not in mirror_images(self.target) for reading in named):
            return ()
        found = self.find(candidates.mirrored()).faces
        return tuple(reading for reading in found if reading.face.id not in mirror_images(self.target))

    def _hypotheses(self, candidates: Candidates) -> list[tuple[int, FaceDesign, np.ndarray]]:
        """Starts (first candidate, face, index), the best supported first."""
        first, step, ratio = _candidate_pairs(candidates)
        length = np.linalg.norm(step, axis=1)
        found = []
        for pair in _pairs(self.target):
            first_radius, distance = pair.radius[0], np.linalg.norm(pair.offset[pair.second])
            ok = np.abs(length * first_radius / distance - 1) < PAIR_TOLERANCE
            ok &= np.abs(ratio * first_radius / pair.radius[pair.second] - 1) < PAIR_TOLERANCE
            if not ok.any():
                continue
            linear = candidates.shape[first[ok]] @ _turn(pair.offset[pair.second] * [1, -1], step[ok]) * [1, -1]
            support = _support(candidates, pair, candidates.xy[first[ok]], linear)
            hits, contrast, origin = (support >= 0).sum(1), candidates.contrast[first[ok]], first[ok].tolist()
            for h in np.flatnonzero(hits >= 2 + MIN_SUPPORT):
                for face, near in pair.faces:
                    index = np.full(len(face.ids), -1)
                    index[near] = support[h]
                    found.append((hits[h], contrast[h], origin[h], face, index))
        found.sort(key=lambda item: (-item[0], -item[1]))
        return [(start, face, index) for _, _, start, face, index in found]


def _candidate_pairs(candidates: Candidates):
    """Neighbours of like shape: the first, the step to the second where the first is a unit circle, size ratio."""
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
    """Turn and scale, (n, 2, 2), that takes one plane vector to each image vector."""
    a, b = step_plane
    s = step_image @ np.array([[a, -b], [b, a]]) / (a * a + b * b)
    return np.stack([np.stack([s[:, 0], -s[:, 1]], 1), np.stack([s[:, 1], s[:, 0]], 1)], 1)


def _support(candidates: Candidates, pair: _Pair, xy: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Candidates near the affine prediction of the circles around the first: (h, s), −1 where there is none."""
    predicted = xy[:, None] + np.einsum("hij,mj->hmi", linear, pair.offset)
    _, nearest = candidates.tree.query(predicted)
    error = np.linalg.solve(linear[:, None], (candidates.xy[nearest] - predicted)[..., None])[..., 0]
    size = candidates.radius[nearest] / np.sqrt(np.abs(np.linalg.det(linear)))[:, None]
    ok = np.linalg.norm(error, axis=2) < 0.4 * pair.radius + 0.12 * np.linalg.norm(pair.offset, axis=1)
    ok &= np.abs(size / pair.radius - 1) < 0.5
    return np.where(ok, nearest, -1)


def _seen_from_outside(homography: np.ndarray, face: FaceDesign) -> bool:
    """Whether the face's Z points to the camera; the mirror image of a face has it point away."""
    depth = face.xy_mm[0] @ homography[2, :2] + homography[2, 2]
    return np.linalg.det(homography) * depth < 0


def _of_one_size(candidates: Candidates, face: FaceDesign, index: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """``index`` without the circles that are larger or smaller against their design than most others."""
    local = homography_jacobian(homography, face.xy_mm)
    expected = face.radius_mm * np.sqrt(np.abs(np.linalg.det(local)))
    ratio = candidates.radius[index] / expected
    middle = np.median(ratio[index >= 0])
    allowed = MAX_SIZE_RATIO * (1 + candidates.px / (2 * middle * expected))
    return np.where((ratio < middle * allowed) & (ratio * allowed > middle), index, -1)


def needed_circles(face: FaceDesign) -> int:
    """Fewest circles that make a reading of the face."""
    return min(MIN_CIRCLES, len(face.ids))


def _decide(readings: list[FaceReading], target: TargetDesign) -> FaceFinding:
    """Keep the readings that explain more than every other reading of the same candidates."""
    readings = [r for r in readings if r.count() >= needed_circles(r.face)]
    readings.sort(key=lambda r: -r.count())
    named: list[FaceReading] = []
    refused: list[RefusedReading] = []
    settled: set[int] = set()
    for reading in readings:
        used = set(reading.used())
        if settled & used:
            continue
        settled |= used
        ambiguous = [
            r
            for r in readings
            if r is not reading
            and used & set(r.used())
            and r.count() >= reading.count()
            and not (r.face is reading.face and (r.index == reading.index).all())
        ]
        if ambiguous or not is_named(reading.face, reading.index >= 0, target):
            refused.append(RefusedReading((reading, *ambiguous), "face_readings", max(len(ambiguous), 1), 0))
        else:
            named.append(reading)
    return FaceFinding(tuple(named), tuple(refused))
