"""Faces of the target: the pattern is found in the face plane, after a homography, and the face named there.

Document 000 walks along image directions and decides by dot products, which perspective breaks. Here two
neighbouring candidates that could be two neighbouring circles of a design fix a map of the plane; it is grown to
all circles of a face and every reading of the same candidates competes with it. A face is named only when one
reading explains more circles than every other.
"""

from dataclasses import dataclass

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.sfm.detect.ambiguity import is_named
from stcal.sfm.detect.candidates import MAX_AXIS_RATIO, Candidates, grow_match, singular_values

NEIGHBOURS_IN_DESIGN = 3
NEIGHBOURS_IN_IMAGE = 12
PAIR_TOLERANCE = 0.3
"""Relative tolerance of distance and size of a pair after the map of one ellipse to a circle."""
SUPPORT = 5
"""So many nearest circles are predicted from a pair …"""
MIN_SUPPORT = 2
"""… and so many of them must be there before the hypothesis is grown."""
MAX_HYPOTHESES = 300
MAX_CONTRAST_RATIO = 2.0
"""Between circles of one target; a reflection of it is fainter."""
MAX_HIDDEN = 2
MIN_CIRCLES = 6
"""A homography takes four circles; two more confirm it."""


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
    """A reading of the candidates ``used`` that was left out: its ``value`` did not pass the ``limit`` of ``gate``;
    ``note`` : the same in words."""

    used: np.ndarray
    gate: str
    value: float
    limit: float
    note: str


@dataclass(frozen=True, slots=True, eq=False)
class FaceFinding:
    """``faces`` : named with certainty, at most one reading each; ``refused`` : what was seen and left out, and why;
    ``repeated`` : ids of faces seen more than once."""

    faces: tuple[FaceReading, ...]
    refused: tuple[RefusedReading, ...]
    repeated: tuple[str, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was seen and left out, and why, in words."""
        return tuple(reading.note for reading in self.refused)


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

    def find(self, candidates: Candidates, contrast: float = 0.0) -> FaceFinding:
        """All faces among the candidates.

        ``contrast`` : of what is certainly no reflection, the board say. The mirror image of a face can pass for
        another face; it is told by its faintness, against ``contrast`` and against the brightest face.
        """
        readings: list[FaceReading] = []
        if len(candidates) >= MIN_CIRCLES:
            for face, index in self._hypotheses(candidates):
                matched = index >= 0
                if any(r.face is face and (r.index == index)[matched].sum() >= 2 for r in readings):
                    continue
                grown = grow_match(candidates, index, face.xy_mm, face.radius_mm)
                if grown is not None and _seen_from_outside(grown[1], face):
                    readings.append(FaceReading(face, *grown))
        return _decide(readings, candidates, contrast, self.target)

    def _hypotheses(self, candidates: Candidates) -> list[tuple[FaceDesign, np.ndarray]]:
        """Starts (face, index), the best supported first."""
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
            hits, contrast = (support >= 0).sum(1), candidates.contrast[first[ok]]
            for h in np.flatnonzero(hits >= 2 + MIN_SUPPORT):
                for face, near in pair.faces:
                    index = np.full(len(face.ids), -1)
                    index[near] = support[h]
                    found.append((hits[h], contrast[h], face, index))
        found.sort(key=lambda item: (-item[0], -item[1]))
        return [(face, index) for _, _, face, index in found[:MAX_HYPOTHESES]]


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


def needed_circles(face: FaceDesign) -> int:
    """Fewest circles that make a reading of the face."""
    return max(len(face.ids) - MAX_HIDDEN, min(MIN_CIRCLES, len(face.ids)))


def _decide(readings: list[FaceReading], candidates: Candidates, contrast: float, target: TargetDesign) -> FaceFinding:
    """Keep the readings that explain more than every other reading of the same candidates, and no reflections."""
    readings = [r for r in readings if r.count() >= needed_circles(r.face)]
    readings.sort(key=lambda r: -r.count())
    named: list[FaceReading] = []
    refused: list[RefusedReading] = []
    own = [float(np.median(candidates.contrast[r.used()])) for r in readings]
    least = max([contrast, *own]) / MAX_CONTRAST_RATIO
    faint: set[int] = set()
    for reading, value in zip(readings, own, strict=True):
        if value < least and not faint & set(reading.used()):
            faint |= set(reading.used())
            note = f"a pattern like face {reading.face.id}: contrast {value:.0f}, {least:.0f} needed; a reflection, "
            refused.append(RefusedReading(reading.used(), "face_contrast", value, least, f"{note}left out"))
    readings = [r for r, value in zip(readings, own, strict=True) if value >= least]
    settled: set[int] = set()
    for reading in readings:
        if settled & set(reading.used()):
            continue
        settled |= set(reading.used())
        ambiguous = [
            r
            for r in readings
            if r is not reading
            and set(r.used()) & set(reading.used())
            and r.count() >= reading.count()
            and not (r.face is reading.face and (r.index == reading.index).all())
        ]
        if ambiguous or not is_named(reading.face, reading.index >= 0, target):
            ids = ", ".join(sorted({r.face.id for r in (reading, *ambiguous)}))
            note = (
                f"a pattern of {reading.count()} circles that fits face {ids} but may be another; left out, "
                "show the circles that tell the faces apart"
            )
            others = max(len(ambiguous), 1)
            refused.append(RefusedReading(reading.used(), "face_readings", others, 0, note))
        else:
            named.append(reading)
    ids = [r.face.id for r in named]
    repeated = tuple(sorted({i for i in ids if ids.count(i) > 1}))
    return FaceFinding(tuple(r for r in named if r.face.id not in repeated), tuple(refused), repeated)
