"""Designs of the hardware: the target's faces and circles, and the dot board. Their files: ``boards/*_file.py``."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Array, Brief, ByValue, freeze, require_fields
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD, CircleLabel, DotLabel, Label, dot_cells
from stcal.lengths import Length, radius, require_millimetres, side
from stcal.lookalikes import MAX_GAP, MAX_RADIUS_RATIO, whole_likeness

Polarity = Literal["bright", "dark"]
POINT_RADIUS_MM = 1e-6
"""Radius of a corner as a circle: it has no extent and therefore no eccentricity."""


@runtime_checkable
class PrintedPattern(Protocol):
    """A board or tags printed on a face: what :mod:`stcal.boards` finds in images."""

    def xy_mm(self) -> np.ndarray:
        """Returns the corners, (n, 2) mm, in the frame of the board."""
        ...


MIN_SINE = 0.02  # smallest sine of the angle between the X and Y circles as seen from the origin circle
DOTS_SIGMA_MM = 0.005  # σ of the places of a board's dots where its file states none, mm per axis


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FaceDesign(Brief):
    """One face of the target: circles in the face frame (origin circle at 0, X through the x circle, Z out of the box).

    Parameters
    ----------
    id : Name of the face.
    ids : Names of its n circles, which neither occur twice nor overlap.
    xy_mm : (n, 2) array. Centres, face frame, mm.
    radius_mm : (n,) array. Radii, mm.
    origin, x, y : Circles that define the frame.
    rough_target_from_face : Rigid, optional
        Approximate pose in a frame that all faces share, for plans and simulations; a calibration does not use it.
    outline_mm : (k, 2) array. Corners of its plate in order, face frame, for drawings.
    rim_mm : (n,) array, optional
        Heights of the rims in front of the circles, negative for discs that stand out; None if they lie in the surface.
    printed : The board or tags on the face, whose corners are the face's points (radii are then nearly zero), and whose
        frame is the face frame, Z into the body; None for a face of circles.
    sigma_mm : σ of a point's place in the plane about the design if the design is what the face was made by, as print
        is; None if the design only names the points.
    size_sigma, edge_share : float
        Relative σ of the printed size, and the share of its variance that is due to the edges of tags.
    of_tags : Whether the corners are those of tags, four by four, whose edges light and ink move.
    """

    id: str
    ids: tuple[str, ...]
    xy_mm: Array
    radius_mm: Array
    origin: str
    x: str
    y: str
    rough_target_from_face: Rigid | None = None
    outline_mm: np.ndarray | None = None
    rim_mm: Array | None = None
    printed: PrintedPattern | None = None
    sigma_mm: float | None = None
    size_sigma: float = 0.0
    of_tags: bool = False
    edge_share: float = 0.0

    def __post_init__(self):
        require_fields(self, f"face {self.id}", sigma_mm=0, size_sigma=0)
        freeze(self, "xy_mm", (len(self.ids), 2), f"face {self.id}: circles")
        freeze(self, "radius_mm", (len(self.ids),), f"face {self.id}: radii")
        self._require_possible()
        if self.outline_mm is not None:
            freeze(self, "outline_mm", (None, 2), f"face {self.id}: outline")
        if self.rim_mm is not None:
            freeze(self, "rim_mm", (len(self.ids),), f"face {self.id}: rims")

    def _require_possible(self) -> None:
        where, ids, xy, radius = f"face {self.id}", self.ids, self.xy_mm, self.radius_mm
        frame = self.origin, self.x, self.y
        _require_different(ids, f"{where}: circle id")
        for key, circle in zip(("origin", "x", "y"), frame, strict=True):
            if circle not in ids:
                raise InputError("E-TARGET-FRAME", f"{where}: {key} circle {circle} is not among {', '.join(ids)}")
        if radius.min() <= 0:
            fault = f"{where}: circle {ids[int(radius.argmin())]}: radius {radius.min():g} mm"
            raise InputError("E-TARGET-RADIUS", f"{fault}; more needed")
        gap = np.linalg.norm(xy[:, None] - xy, axis=2) - radius[:, None] - radius
        np.fill_diagonal(gap, np.inf)
        if gap.min() <= 0:
            i, j = np.unravel_index(gap.argmin(), gap.shape)
            raise InputError("E-TARGET-OVERLAP", f"{where}: circles {ids[i]} and {ids[j]} overlap; move them apart")
        origin, x, y = (xy[ids.index(circle)] for circle in frame)
        length_x, length_y = np.linalg.norm(x - origin), np.linalg.norm(y - origin)
        named = ", ".join(frame)
        if min(length_x, length_y) == 0:
            raise InputError("E-TARGET-FRAME", f"{where}: frame circles {named}; three different ones needed")
        axis = (x - origin) / length_x
        sine = float(axis[0] * (y - origin)[1] - axis[1] * (y - origin)[0]) / length_y
        if abs(sine) < MIN_SINE:
            raise InputError("E-TARGET-FRAME", f"{where}: frame circles {named} on one line; choose others")
        if sine < 0:
            fault = f"{where}: X to Y through {frame[1]} and {frame[2]} turns clockwise seen from outside"
            remedy = "swap x and y, or give positions as seen from outside with y up"
            raise InputError("E-TARGET-FRAME", f"{fault}; {remedy}")

    def labels(self) -> list[CircleLabel]:
        """Returns the label ``face:circle`` of every circle, in order."""
        return [CircleLabel(self.id, circle) for circle in self.ids]

    def places_mm(self, circles: Iterable[str]) -> np.ndarray:
        """Returns the places of these circles, (n, 3), face frame."""
        row = {circle: i for i, circle in enumerate(self.ids)}
        return np.pad(self.xy_mm[[row[circle] for circle in circles]].reshape(-1, 2), ((0, 0), (0, 1)))

    @property
    def outward(self) -> Literal[1, -1]:
        """1 if the face's Z points out of the body, −1 if it points into it, as the Z of boards and tags does."""
        return 1 if self.printed is None else -1


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """A measured distance between two points of the target, mm, with σ; ``drawn`` : it defines the unit."""

    first: CircleLabel
    second: CircleLabel
    mm: float
    sigma_mm: float
    drawn: bool = False

    def __post_init__(self):
        require_fields(self, "distance", mm=0, sigma_mm=0)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TargetDesign(Brief):
    """Target: its faces, which differ, and whether its circles are brighter or darker than their surroundings.

    Parameters
    ----------
    name : For messages and reports.
    polarity : Of the circles against their surroundings.
    faces : The first one is the reference face.
    unusual_size : True if unusually large or small radii are not a mistake of units.
    distances : Known distances between its points.
    """

    name: str
    polarity: Polarity
    faces: tuple[FaceDesign, ...]
    unusual_size: bool = False
    distances: tuple[KnownDistance, ...] = ()

    def __post_init__(self):
        where = f"target {self.name}"
        require_fields(self, where)
        ids = [face.id for face in self.faces]
        _require_different(ids, f"{where}: face id")
        if BOARD in ids:
            raise InputError("E-TARGET-ID", f"{where}: face id {BOARD} is taken by the board; choose another")
        circles = [face for face in self.faces if face.printed is None]
        sizes = _by_label((face, face.radius_mm) for face in circles)
        radii = [radius(f"radius_mm of circle {label}", mm) for label, mm in sizes.items()]
        require_millimetres(radii, self.unusual_size, where)
        require_distinct(circles, where)

    @property
    def has_scale(self) -> bool:
        """True if the target itself determines the size: by printed faces, or by known distances."""
        return bool(self.distances) or self.has_printed

    @property
    def up_to_scale(self) -> bool:
        """True if no size is known, and lengths are in the unit of the drawing."""
        return any(known.drawn for known in self.distances)

    def with_faces(self, printed: bool) -> "TargetDesign":
        """Returns the design with only the printed faces, or only the faces of circles."""
        return replace(self, faces=tuple(face for face in self.faces if (face.printed is not None) == printed))

    @property
    def has_printed(self) -> bool:
        """True if a face is a board or has tags."""
        return any(face.printed is not None for face in self.faces)

    @property
    def points(self) -> Literal["circles", "corners", "points"]:
        """What the faces have: circles, corners where all are boards and tags, or points where they have both."""
        kinds = {face.printed is None for face in self.faces}
        return "points" if len(kinds) > 1 else "circles" if True in kinds else "corners"

    def printed_ids(self) -> frozenset[str]:
        """Returns the ids of the faces that are boards or have tags."""
        return frozenset(face.id for face in self.faces if face.printed is not None)

    def face(self, face_id: str) -> FaceDesign:
        """Returns the face with this id; raises InputError if there is none."""
        for face in self.faces:
            if face.id == face_id:
                return face
        known = ", ".join(face.id for face in self.faces)
        raise InputError("E-TARGET-NO-FACE", f"target {self.name}: no face {face_id}; choose one of {known}")

    def rough_poses(self) -> dict[str, Rigid]:
        """Returns the rough poses by face id, of the faces that have one."""
        return {face.id: face.rough_target_from_face for face in self.faces if face.rough_target_from_face is not None}

    def patterns_alone(self) -> "TargetDesign":
        """Returns the design without the rough poses, which is the part that a calibration depends on."""
        return replace(self, faces=tuple(replace(face, rough_target_from_face=None) for face in self.faces))

    def radius_of(self) -> dict[CircleLabel, float]:
        """Returns the radius in mm by label."""
        return _by_label((face, face.radius_mm) for face in self.faces)

    def rim_of(self) -> dict[CircleLabel, float]:
        """Returns the height of the rim in mm by label, of faces that state it."""
        return _by_label((face, face.rim_mm) for face in self.faces if face.rim_mm is not None)


def _by_label(faces: Iterable[tuple[FaceDesign, np.ndarray]]) -> dict[CircleLabel, float]:
    pairs = (zip(face.labels(), values.tolist(), strict=True) for face, values in faces)
    return {label: value for of_face in pairs for label, value in of_face}


@dataclass(frozen=True, slots=True)
class StatedSize:
    """Size of a body as stated in addition to its drawing; None for values that are not stated. Only the uncertainty
    budget uses it. ``pitch_sigma_ppm`` : relative standard uncertainty of the pitch, common to all dots;
    ``expansion_ppm_per_k`` : coefficient of linear thermal expansion, with its σ; ``temperature_c`` : temperature of
    the body in the photographs, with its σ; ``reference_temperature_c`` : temperature at which its size is stated,
    or is to be reported (ISO 1: 20 °C)."""

    pitch_sigma_ppm: float | None = None
    expansion_ppm_per_k: float | None = None
    expansion_sigma_ppm_per_k: float | None = None
    temperature_c: float | None = None
    temperature_sigma_k: float | None = None
    reference_temperature_c: float | None = None

    def __post_init__(self):
        require_fields(self, "size", pitch_sigma_ppm=0, expansion_sigma_ppm_per_k=0, temperature_sigma_k=0)


@dataclass(frozen=True, slots=True, eq=False)
class BoardDesign(ByValue):
    """Board with a rectangular grid of dots; X along a row, Y down the columns, Z into the board, origin at dot (0, 0).

    Parameters
    ----------
    rows, columns : Numbers of dots down and across.
    pitch_mm, radius_mm : Distance of neighbouring dots, and their radius, mm.
    polarity : Of the dots against the board.
    sigma_mm : Standard deviation of the dots' positions about the grid, per axis, mm.
    corner : (int, int). Row and column of the one larger dot; None for a plain board.
    corner_radius_mm : Radius of the larger dot, mm.
    stated : What is stated about its size, in addition to the drawing.
    unusual_size : True if an unusually large or small pitch or radius is not a mistake of units.
    rim_mm : Height of the rims in front of the dots, negative for dots that stand out; mm.
    rings : tuple of (int, int). Row and column of each dot with a hole, which tell the board from its turns.
    """

    rows: int
    columns: int
    pitch_mm: float
    radius_mm: float
    polarity: Polarity
    sigma_mm: float
    corner: tuple[int, int] | None = None
    corner_radius_mm: float | None = None
    stated: StatedSize = StatedSize()
    unusual_size: bool = False
    rim_mm: float = 0.0
    rings: tuple[tuple[int, int], ...] = ()

    def __post_init__(self):
        require_fields(self, "board")
        if not (np.isfinite(self.sigma_mm) and self.sigma_mm >= 0):
            raise InputError("E-SIGMA-VALUE", f"board: sigma_mm {self.sigma_mm:g}; 0 or a positive number needed")
        require_millimetres(board_lengths(self.pitch_mm, self.radius_mm), self.unusual_size, "board")
        size, corner = (self.rows, self.columns), self.corner
        if min(size) < 1:
            raise InputError("E-BOARD-SIZE", "board: {} rows and {} columns; 1 or more of each needed".format(*size))
        if not 0 < 2 * self.radius_mm < self.pitch_mm:
            fault = f"board: radius {self.radius_mm:g}"
            raise InputError("E-BOARD-RADIUS", f"{fault}, under half the pitch {self.pitch_mm:g} mm needed")
        if corner is None:
            return
        if any(place not in (0, count - 1) for place, count in zip(corner, size, strict=True)):
            fault = f"board: corner dot at row {corner[0]}, column {corner[1]}"
            raise InputError("E-BOARD-CORNER", f"{fault}; a corner needed")
        least, most = 1.15 * self.radius_mm, self.pitch_mm - self.radius_mm
        if self.corner_radius_mm is None or not least <= self.corner_radius_mm < most:
            fault = f"board: corner radius {self.corner_radius_mm} mm"
            raise InputError("E-BOARD-CORNER", f"{fault}; at least {least:g} mm and under {most:g} mm needed")

    def scaled(self, factor: float) -> "BoardDesign":
        """Returns the board printed larger by a factor."""
        corner = self.corner_radius_mm and factor * self.corner_radius_mm
        size = {"pitch_mm": factor * self.pitch_mm, "radius_mm": factor * self.radius_mm, "corner_radius_mm": corner}
        return replace(self, **size, unusual_size=True)

    def cells(self) -> np.ndarray:
        """Returns row and column of every dot, (rows·columns, 2), row-major."""
        return np.column_stack(np.divmod(np.arange(self.rows * self.columns), self.columns))

    def unique(self) -> bool:
        """Returns True if the board looks different after any turn."""
        return self.corner is not None or bool(self.rings)

    def steps(self) -> np.ndarray:
        """Returns the steps (2, 2), as columns, from column to column and from row to row, in pitches."""
        return np.eye(2)

    def flat(self, column_row: np.ndarray) -> np.ndarray:
        """Returns the positions (n, 2) of columns and rows (n, 2), in pitches."""
        return column_row @ self.steps().T

    def xy_mm(self) -> np.ndarray:
        """Returns the grid positions, (rows·columns, 2), row-major, mm."""
        return self.pitch_mm * self.flat(self.cells()[:, ::-1].astype(float))

    def radii_mm(self) -> np.ndarray:
        """Returns the dot radii, (rows·columns,), row-major, mm."""
        radii = np.full(self.rows * self.columns, self.radius_mm)
        if self.corner is not None:
            radii[self.corner[0] * self.columns + self.corner[1]] = self.corner_radius_mm
        return radii

    def labels(self) -> list[DotLabel]:
        """Returns the labels ``board:row:column``, row-major."""
        return list(_dot_labels(self.rows, self.columns))

    def places_mm(self, labels: Iterable[Label]) -> np.ndarray:
        """Returns the places at which these dots are seen, (n, 3), board frame: half of a rim before the surface."""
        cells = dot_cells(labels)
        return np.column_stack([self.pitch_mm * self.flat(cells[:, ::-1]), np.full(len(cells), -0.5 * self.rim_mm)])

    def radius_of(self) -> dict[DotLabel, float]:
        """Returns the radius in mm by label."""
        return dict(zip(self.labels(), self.radii_mm().tolist(), strict=True))


def _require_different(ids: Sequence[str], what: str) -> None:
    for i, value in enumerate(ids):
        if value in ids[:i]:
            raise InputError("E-TARGET-ID", f"{what} {value} occurs twice; ids must differ")


def require_distinct(faces: Sequence[FaceDesign], where: str) -> None:
    """Refuses faces that look alike in photographs, and a face that looks the same after a rotation."""
    for face, second in combinations_with_replacement(faces, 2):
        few, many = sorted((face, second), key=lambda each: len(each.ids))
        in_place = np.arange(len(few.ids)) if few is many else None
        like = whole_likeness(few.xy_mm, few.radius_mm, many.xy_mm, many.radius_mm, in_place)
        if like is not None:
            size = "" if abs(like.scale - 1) < 0.005 else f", at {like.scale:.2f} times the size"
            as_on = f"are all on face {many.id} too{size}"
            after = f"look the same after a turn by {abs(np.degrees(like.turn_rad)):.0f}°"
            by = f"its place by more than {MAX_GAP:g} radii or its radius by more than {MAX_RADIUS_RATIO - 1:.0%}"
            fault = f"{where}: the circles of face {few.id} {after if few is many else as_on}"
            raise InputError("E-TARGET-LIKENESS", f"{fault}; change one, {by}")


def board_lengths(pitch_mm: float, radius_mm: float) -> list[Length]:
    """Returns the lengths of a board of dots by which its unit is judged."""
    return [side("pitch_mm", pitch_mm), radius("radius_mm", radius_mm)]


@dataclass(frozen=True, slots=True, eq=False)
class ScaleReference(BoardDesign):
    """All that a run takes its scale from: the board, if any, faces of known shape, and known distances."""

    faces: tuple[FaceDesign, ...] = ()
    distances: tuple[KnownDistance, ...] = ()

    def __post_init__(self):
        if self.rows:
            BoardDesign.__post_init__(self)

    def with_sigma_times(self, factor: float) -> "ScaleReference":
        """Returns what the scale is taken from with all of its σ multiplied by a factor."""
        faces = (
            replace(face, sigma_mm=factor * (face.sigma_mm or 0.0), size_sigma=factor * face.size_sigma)
            for face in self.faces
        )
        distances = tuple(replace(known, sigma_mm=factor * known.sigma_mm) for known in self.distances)
        return replace(self, sigma_mm=factor * self.sigma_mm, faces=tuple(faces), distances=distances)


def scale_reference(board: BoardDesign | None, target: TargetDesign) -> BoardDesign:
    """Returns the board, with the faces and distances of the target that tell its size if there are any."""
    faces = tuple(face for face in target.faces if face.sigma_mm is not None)
    if board is not None and not faces and not target.distances:
        return board
    if board is not None and type(board) is not BoardDesign:
        fault = "--board: a lattice of circles or corners, beside a target whose own size is known"
        raise InputError("E-BOARD-TYPE", f"{fault}; a rectangular board of dots needed, or none")
    known = {} if board is None else {entry.name: getattr(board, entry.name) for entry in fields(BoardDesign)}
    none = {"rows": 0, "columns": 0, "pitch_mm": 1.0, "radius_mm": 0.25, "polarity": "bright", "sigma_mm": 1.0}
    return ScaleReference(**(known or none), faces=faces, distances=target.distances)  # type: ignore[arg-type]


DRAWN_SIGMA = 1e-7  # relative σ of the drawn distance that defines the unit where no size is known


def with_drawn_size(target: TargetDesign, images: Iterable[Sequence[Label]]) -> TargetDesign:
    """Returns the design with one drawn distance as the unit: the longest on the face that most images see whole."""
    views = [set(labels) for labels in images]

    def longest(face: FaceDesign) -> tuple[int, float, tuple[CircleLabel, CircleLabel]]:
        apart, labels = np.linalg.norm(face.xy_mm[:, None] - face.xy_mm, axis=2), face.labels()
        i, j = np.unravel_index(int(apart.argmax()), apart.shape)
        ends = labels[i], labels[j]
        return sum(view.issuperset(ends) for view in views), float(apart[i, j]), ends

    _, mm, ends = max(map(longest, target.faces), key=lambda each: each[:2])
    return replace(target, distances=(KnownDistance(*ends, mm, DRAWN_SIGMA * mm, drawn=True),))


def faces_of_known_shape(board: BoardDesign) -> tuple[FaceDesign, ...]:
    """Returns the faces of known shape among what the scale is taken from."""
    return board.faces if isinstance(board, ScaleReference) else ()


def known_distances(board: BoardDesign) -> tuple[KnownDistance, ...]:
    """Returns the known distances among what the scale is taken from."""
    return board.distances if isinstance(board, ScaleReference) else ()


@lru_cache(maxsize=4)
def _dot_labels(rows: int, columns: int) -> tuple[DotLabel, ...]:
    return tuple(DotLabel(r, c) for r in range(rows) for c in range(columns))


def reference_target() -> TargetDesign:
    """Returns the reference design: five faces of seven big and three small circles (after Zhang & Wei 2017, fig. 1).

    Rough poses are in the frame of face 1, close to table 2 of that paper as far as it is consistent.
    """
    common = {"1": (0, 0), "2": (40, 0), "3": (80, 0), "4": (0, 40), "5": (0, 80), "6": (40, 40), "7": (80, 80)}
    small = {"a": (20, 0), "b": (0, 20)}
    naming = {"1": (94.142, 65.858), "2": (100, 80), "3": (60, 80), "4": (80, 100), "5": (80, 60)}
    x, y, z = np.eye(3)
    rough = {
        "1": ((x, y, z), (0, 0, 0)),
        "2": ((-z, y, x), (138.4, 0, -58.0)),
        "3": ((-x, y, -z), (78.6, 0, -198.4)),
        "4": ((z, y, -x), (-58.4, 0, -138.4)),
        "5": ((x, z, -y), (0, -46.0, -138.4)),
    }
    faces = []
    for face_id, xy_c in naming.items():
        places = common | small | {"c": xy_c}
        radius = [8.0 if circle in common else 4.0 for circle in places]
        axes, place = rough[face_id]
        pose = Rigid(np.column_stack(axes), place)
        faces.append(FaceDesign(face_id, tuple(places), list(places.values()), radius, "1", "3", "5", pose))
    return TargetDesign("reference target", "bright", tuple(faces))


def reference_board() -> BoardDesign:
    """Returns the reference board: 9 columns × 7 rows, 30 mm pitch, radius 7.5 mm, bright, plain, σ 5 µm."""
    return BoardDesign(7, 9, 30.0, 7.5, "bright", DOTS_SIGMA_MM)
