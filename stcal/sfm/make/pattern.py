"""Patterns of circles that no face shares with another face, with its mirror image or with itself turned.

Circles of two sizes are placed at random on each plate. Each circle takes the one of several random places that is
farthest from the other circles. Of several such patterns, the one is taken whose most similar reading among the
faces so far has the fewest circles in common.
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.design import FaceDesign, Polarity, TargetDesign
from stcal.errors import InputError
from stcal.sfm.detect.ambiguity import in_common
from stcal.sfm.detect.faces import MIN_CIRCLES
from stcal.sfm.make.box import Side
from stcal.synthetic.designs import face_of_drawing

HIDDEN = 3
"""Number of circles of a face that may be hidden. Any set of the remaining circles identifies the face."""
LEAST_CIRCLES = MIN_CIRCLES + HIDDEN
LARGE = 1.6
"""Radius of the larger circles as a multiple of the smaller radius. Detection takes radii up to a ratio of 1.3 for
equal."""
GAP = 0.8
"""Least gap between the rims of two circles, in radii of the smaller circles."""
PLACES, TRIES = 40, 30
"""Numbers of candidate places for each circle, and of candidate patterns for each face."""
GRID_MM = 0.5
"""Grid of the coordinates of circles, so that they are round numbers that can be measured again."""
CORNER_SHARE = 0.15
"""Size of the area at each corner in which a circle of the frame lies, as a share of the plate's sides."""


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """A target, and its ``likeness`` : most circles that a face has in common with another reading, 0 if under four."""

    target: TargetDesign
    likeness: int


def make_pattern(
    sides: list[Side], circles: int, radius_mm: float, polarity: Polarity, seed: int | list[int], name: str
) -> Pattern:
    """A face for each side, each named by its circles with any :data:`HIDDEN` of them hidden.

    Raises
    ------
    InputError
        Too few circles, or no room for them.
    """
    if circles < LEAST_CIRCLES:
        raise InputError(
            "E-MAKE-CIRCLES",
            f"--circles {circles}: {LEAST_CIRCLES} needed, {MIN_CIRCLES} name a face and {HIDDEN} may be hidden",
        )
    rng = np.random.default_rng(seed)
    faces: list[FaceDesign] = []
    likeness = 0
    for side in sides:
        least, best = circles + 1, None
        for _ in range(TRIES):
            face = _strewn(side, circles, radius_mm, rng)
            if face is not None and (alike := _likeness(face, faces)) < least:
                least, best = alike, face
            if least == 0:
                break
        if best is None:
            raise InputError(
                "E-MAKE-ROOM",
                f"face {side.name}: no room for {circles} circles of {radius_mm:.3g} and {LARGE * radius_mm:.3g} mm on "
                f"{side.width:g} × {side.height:g} mm; fewer --circles, a smaller --radius-mm, or a larger --size",
            )
        if least > circles - HIDDEN - 1:
            raise InputError(
                "E-MAKE-CIRCLES",
                f"face {side.name}: {least} of {circles} circles fit another reading too, at most "
                f"{circles - HIDDEN - 1} may; more --circles, a smaller --radius-mm, or another --seed",
            )
        faces.append(best)
        likeness = max(likeness, least)
    return Pattern(TargetDesign(name, polarity, tuple(faces)), likeness)


def _likeness(face: FaceDesign, others: list[FaceDesign]) -> int:
    """Returns the most circles that a face has in common with itself turned or mirrored, with another face, or with the
    mirror image of another face."""
    pairs = [(face, False), (face, True), *((other, mirrored) for other in others for mirrored in (False, True))]
    return max(in_common(face, other, mirrored) for other, mirrored in pairs)


def _strewn(side: Side, count: int, radius_mm: float, rng: np.random.Generator) -> FaceDesign | None:
    """Returns one random pattern, or None if the last circles had no room."""
    size = np.array([side.width, side.height])
    large = LARGE * radius_mm
    low, high = np.full(2, side.edge + large), size - side.edge - large
    if (high <= low).any():
        return None
    corner = CORNER_SHARE * (high - low)
    first = low + rng.random(2) * corner
    second = np.array([high[0] - rng.random() * corner[0], first[1]])  # X runs along the plate's edge
    third = np.array([low[0], high[1]]) + rng.random(2) * corner * [1, -1]
    xy = [_on_grid(place) for place in (first, second, third)]
    radii = [large, large, large]
    for place in range(3, count):
        radius = large if place % 2 == 0 else radius_mm
        edge = side.edge + radius
        places = _on_grid(edge + rng.random((PLACES, 2)) * (size - 2 * edge))
        gap = np.linalg.norm(places[:, None] - np.array(xy), axis=2) - np.array(radii) - radius
        gap = gap.min(1)
        if gap.max() < GAP * radius_mm:
            return None
        xy.append(places[int(gap.argmax())])
        radii.append(radius)
    distances = np.linalg.norm(np.array(xy[:3])[:, None] - np.array(xy[:3]), axis=2) + np.diag([np.inf] * 3)
    if distances.min() < 2 * large + GAP * radius_mm:
        return None
    rows = [(str(i), *place.tolist(), radius) for i, (place, radius) in enumerate(zip(xy, radii, strict=True), 1)]
    face, plate_from_face = face_of_drawing(side.name, rows, "1", "2", "3")
    outline = plate_from_face.inverse() @ np.pad(side.outline(), ((0, 0), (0, 1)))
    return replace(face, rough_target_from_face=side.box_from_plate @ plate_from_face, outline_mm=outline[:, :2])


def _on_grid(place: np.ndarray) -> np.ndarray:
    return np.rint(place / GRID_MM) * GRID_MM
