"""Places for circles on the sides of a box, and patterns that no face shares with another, also with circles hidden."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.design import FaceDesign, Polarity, TargetDesign
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.sfm.data.patterns import Pattern, images_px
from stcal.sfm.detect.circles.candidates import Candidates, Ellipses
from stcal.sfm.detect.faces import FaceFinder
from stcal.sfm.detect.sightings import MIN_NAMING, in_common
from stcal.synthetic.designs import face_of_drawing

EDGE_SHARE = 0.06
"""Width of the margin along the rim of a plate that stays free of circles, as a share of the plate's shorter side. It
leaves room to cut, fold and glue."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A side of the box."""

    name: str
    width: float  # of its plate, mm
    height: float
    box_from_plate: Rigid  # origin lower left as seen from outside, Y upwards, Z outwards

    @property
    def edge(self) -> float:
        """Width of the margin without circles, mm."""
        return EDGE_SHARE * min(self.width, self.height)

    def outline(self) -> np.ndarray:
        """Returns the corners of the plate, (4, 2), mm."""
        return np.array([[0, 0], [self.width, 0], [self.width, self.height], [0, self.height]])


NAMES = ("front", "right", "back", "left", "top")
"""Names of the sides that may have circles."""


def sides_of(size_mm: tuple[float, float, float], names: tuple[str, ...] = NAMES) -> list[Side]:
    """Returns the named sides of a box of this width, height and depth, whose middle is the origin, Z upwards."""
    w, h, d = size_mm
    x, y, z = np.eye(3)
    rows = (
        ("front", w, h, (x, z), (-w, -d, -h)),
        ("right", d, h, (y, z), (w, -d, -h)),
        ("back", w, h, (-x, z), (w, d, -h)),
        ("left", d, h, (-y, z), (-w, d, -h)),
        ("top", w, d, (x, y), (-w, -d, h)),
    )
    side_of = {
        name: Side(name, width, height, Rigid(np.column_stack([x, y, np.cross(x, y)]), np.array(corner) / 2))
        for name, width, height, (x, y), corner in rows
    }
    return [side_of[name] for name in names]


def faces_of(text: str) -> tuple[str, ...]:
    """Parses ``front,right,top`` into the names of sides; all of them if the text is empty."""
    names = tuple(name.strip().lower() for name in text.split(",")) if text else NAMES
    require_sides(names, text)
    return names


def require_sides(names: Sequence[str], text: str) -> None:
    """Refuses names of sides that are unknown, occur twice, or have no neighbour."""
    for name in names:
        if name not in NAMES:
            raise InputError("E-OPTION-VALUE", f"--faces {text}: {name!r} is no side; use some of {', '.join(NAMES)}")
        if names.count(name) > 1:
            raise InputError("E-OPTION-REPEATED", f"--faces {text}: {name} occurs twice; name each side once")
    if len(names) < 2 or set(names) in ({"front", "back"}, {"left", "right"}):
        raise InputError(
            "E-OPTION-VALUE",
            f"--faces {text}: two sides with a common edge needed, so that one photograph shows both; "
            "use such as front,right,top",
        )


def size_of(text: str) -> tuple[float, float, float]:
    """Parses ``W,H,D``, or ``WxHxD``, into width, height and depth in mm."""
    try:
        width, height, depth = map(float, re.split("[,x×]", text))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--size {text}: W,H,D in mm needed, such as 120,120,100") from error
    require_size((width, height, depth), text)
    return width, height, depth


def require_size(size_mm: Sequence[float], text: str) -> None:
    """Refuses sides outside 1 mm to 100 m; ``text`` : the size in the message."""
    if not all(1 <= side <= 1e5 for side in size_mm):
        raise InputError("E-OPTION-RANGE", f"--size {text}: sides of 1 mm to 100 m needed")


HIDDEN = 3
"""Number of circles of a face that may be hidden. Any set of the remaining circles identifies the face."""
LEAST_CIRCLES = MIN_NAMING + HIDDEN
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
class MadeTarget:
    """A target, and its ``likeness`` : most circles that a face has in common with another reading, 0 if under four."""

    target: TargetDesign
    likeness: int


def make_pattern(
    sides: list[Side], circles: int, radius_mm: float, polarity: Polarity, seed: int | list[int], name: str
) -> MadeTarget:
    """Returns a face for each side, named by its circles with any :data:`HIDDEN` of them hidden."""
    if circles < LEAST_CIRCLES:
        raise InputError(
            "E-MAKE-CIRCLES",
            f"--circles {circles}: {LEAST_CIRCLES} needed, {MIN_NAMING} name a face and {HIDDEN} may be hidden",
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
                f"face {side.name}: {least} of {circles} circles also fit another interpretation, at most "
                f"{circles - HIDDEN - 1} may; more --circles, a smaller --radius-mm, or another --seed",
            )
        faces.append(best)
        likeness = max(likeness, least)
    return MadeTarget(TargetDesign(name, polarity, tuple(faces)), likeness)


def _likeness(face: FaceDesign, others: list[FaceDesign]) -> int:
    """Most circles in common with the face itself turned or mirrored, or another one or its mirror image."""
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


TILT_RAD = np.radians(40.0)
"""Tilt of the face about an oblique axis in the simulated views."""
CONTRAST = 100.0


def unnamed_cases(
    target: TargetDesign, camera: Camera, distance_mm: float, hidden: int, progress: Callable[[int, int], None] | None
) -> tuple[list[tuple[str, tuple[str, ...]]], int]:
    """Cases (face, hidden circles) whose visible circles the finder does not read, and the number of all."""
    finder = FaceFinder(target)
    failed, done = [], 0
    total = sum(comb(len(face.ids), hidden) for face in target.faces)
    for face in target.faces:
        ellipses = _seen(face, target, camera, distance_mm)
        for hidden_rows in combinations(range(len(face.ids)), hidden):
            visible = np.setdiff1d(np.arange(len(face.ids)), hidden_rows)
            readings = finder.find(Candidates.of(ellipses.select(visible), camera)).faces
            right = [reading for reading in readings if reading.face is face and len(readings) == 1]
            named = {(i, int(row)) for r in right for i, row in enumerate(r.index) if row >= 0}
            if named != {(int(circle), row) for row, circle in enumerate(visible)}:
                failed.append((face.id, tuple(face.ids[i] for i in hidden_rows)))
            done += 1
            if progress is not None and (done % 20 == 0 or done == total):
                progress(done, total)
    return failed, total


def _seen(face: FaceDesign, target: TargetDesign, camera: Camera, distance_mm: float) -> Ellipses:
    """Returns the ellipses of all circles of a face that is tilted and turned, with its middle on the optical axis."""
    axis = np.array([0.6, 0.8, 0.0])
    front = np.diag([1.0, -1.0, -1.0])  # Z of the face to the camera
    turn = Rotation.from_rotvec(TILT_RAD * axis).as_matrix() @ front
    middle = np.append((face.xy_mm.min(0) + face.xy_mm.max(0)) / 2, 0.0)
    pose = Rigid(turn, np.array([0, 0, distance_mm]) - turn @ middle)
    pattern = Pattern(face.id, face.labels(), face.xy_mm, face.radius_mm, target.polarity, 1)
    centre, shape = images_px(pattern, pose, camera)
    return Ellipses(centre, shape, np.full(len(centre), CONTRAST))
