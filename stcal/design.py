"""Designs of the hardware: the target's faces and circles, and the dot board. Their files: ``io/design.py``."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Literal, Protocol

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel, DotLabel, Label, dot_cells

Polarity = Literal["bright", "dark"]
POINT_RADIUS_MM = 1e-6
"""Radius of a corner as a circle: it has no extent and therefore no eccentricity."""


class Printed(Protocol):
    """A board or tags printed on a face: what :mod:`stcal.boards` finds in images."""

    def xy_mm(self) -> np.ndarray:
        """Returns the corners, (n, 2) mm, in the frame of the board."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class FaceDesign:
    """One face of the target: circles in the face frame (origin circle at 0, X through the x circle, Z out of the box).

    ``ids`` : n circle ids; ``xy_mm`` : (n, 2); ``radius_mm`` : (n,);
    ``origin``, ``x``, ``y`` : ids of the circles that define the frame;
    ``rough_target_from_face`` : approximate pose of the face in a frame that all faces share, or None if the design
    states none. Plans and simulations use it, a calibration does not;
    ``outline_mm`` : (k, 2) corners of its plate in order, face frame, for drawings, or None if the design states none;
    ``rim_mm`` : (n,) heights of the rims in front of the circles, negative for discs that stand out, or None if the
    circles lie in the surface of the plate;
    ``printed`` : the board or tags on the face, whose corners are the face's points (radii are then nearly zero), and
    whose frame is the face frame, Z into the body; None for a face of circles;
    ``sigma_mm`` : σ of a point's place in the plane about the design if the design is what the face was made by, as
    print is; None if the design only names the points; ``size_sigma`` : relative σ of the printed size; ``of_tags`` :
    whether the corners are those of tags, four by four, whose edges light and ink move.
    """

    id: str
    ids: tuple[str, ...]
    xy_mm: Array
    radius_mm: Array
    origin: str
    x: str
    y: str
    rough_target_from_face: Rigid | None = None
    outline_mm: Array | None = None
    rim_mm: Array | None = None
    printed: Printed | None = None
    sigma_mm: float | None = None
    size_sigma: float = 0.0
    of_tags: bool = False

    def __post_init__(self):
        freeze(self, "xy_mm", (len(self.ids), 2), f"face {self.id}: circles")
        freeze(self, "radius_mm", (len(self.ids),), f"face {self.id}: radii")
        if self.outline_mm is not None:
            freeze(self, "outline_mm", (None, 2), f"face {self.id}: outline")
        if self.rim_mm is not None:
            freeze(self, "rim_mm", (len(self.ids),), f"face {self.id}: rims")

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
    """A measured distance between two points of the target, mm, with its σ: a scale bar."""

    first: CircleLabel
    second: CircleLabel
    mm: float
    sigma_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class TargetDesign:
    """Target: its faces, and whether its circles are brighter or darker than their surroundings.

    ``distances`` : known distances between its points.
    """

    name: str
    polarity: Polarity
    faces: tuple[FaceDesign, ...]
    distances: tuple[KnownDistance, ...] = ()

    @property
    def has_scale(self) -> bool:
        """True if the target itself tells its size: by printed faces, or by known distances."""
        return bool(self.distances) or any(face.printed is not None for face in self.faces)

    def with_faces(self, printed: bool) -> "TargetDesign":
        """Returns the design with only the printed faces, or only the faces of circles."""
        return replace(self, faces=tuple(face for face in self.faces if (face.printed is not None) == printed))

    def face(self, face_id: str) -> FaceDesign:
        """Returns the face with this id; raises InputError if there is none."""
        for face in self.faces:
            if face.id == face_id:
                return face
        known = ", ".join(face.id for face in self.faces)
        raise InputError(
            "E-TARGET-NO-FACE", f"target {self.name}: no face {face_id}; the design has {known}, choose one of them"
        )

    def rough_poses(self) -> dict[str, Rigid]:
        """Returns the rough poses by face id, of the faces that have one."""
        return {face.id: face.rough_target_from_face for face in self.faces if face.rough_target_from_face is not None}

    def patterns_alone(self) -> "TargetDesign":
        """Returns the design without the rough poses, which is the part that a calibration depends on."""
        return replace(self, faces=tuple(replace(face, rough_target_from_face=None) for face in self.faces))

    def radius_of(self) -> dict[CircleLabel, float]:
        """Returns the radius in mm by label."""
        return {
            label: float(radius)
            for face in self.faces
            for label, radius in zip(face.labels(), face.radius_mm, strict=True)
        }

    def rim_of(self) -> dict[CircleLabel, float]:
        """Returns the height of the rim in mm by label, of faces that state it."""
        return {
            label: float(height)
            for face in self.faces
            if face.rim_mm is not None
            for label, height in zip(face.labels(), face.rim_mm, strict=True)
        }


@dataclass(frozen=True, slots=True)
class StatedSize:
    """Size of a body as stated in addition to its drawing; None for values that are not stated.

    Only the uncertainty budget uses it. ``pitch_sigma_ppm`` : relative standard uncertainty of the pitch, common to all
    dots; ``expansion_ppm_per_k`` : coefficient of linear thermal expansion, with its σ; ``temperature_c`` : temperature
    of the body in the photographs, with its σ; ``reference_temperature_c`` : temperature at which its size is stated,
    or is to be reported (ISO 1: 20 °C).
    """

    pitch_sigma_ppm: float | None = None
    expansion_ppm_per_k: float | None = None
    expansion_sigma_ppm_per_k: float | None = None
    temperature_c: float | None = None
    temperature_sigma_k: float | None = None
    reference_temperature_c: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BoardDesign:
    """Board with a rectangular grid of dots; X along a row, Y down the columns, Z into the board, origin at dot (0, 0).

    ``corner`` : (row, column) of the one larger dot, with ``corner_radius_mm``, or None for a plain board.
    ``sigma_mm`` : standard deviation of the dots' positions about the grid, per axis; ``stated`` : its stated size.
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

    def cells(self) -> np.ndarray:
        """Returns row and column of every dot, (rows·columns, 2), row-major."""
        return np.column_stack(np.divmod(np.arange(self.rows * self.columns), self.columns))

    def xy_mm(self) -> np.ndarray:
        """Returns the grid positions, (rows·columns, 2), row-major, mm."""
        return self.pitch_mm * self.cells()[:, ::-1].astype(float)

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
        """Returns the grid positions of these dots, (n, 3), board frame."""
        cells = dot_cells(labels)
        return np.column_stack([self.pitch_mm * cells[:, ::-1], np.zeros(len(cells))])

    def radius_of(self) -> dict[DotLabel, float]:
        """Returns the radius in mm by label."""
        return dict(zip(self.labels(), self.radii_mm().tolist(), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class ScaleReference(BoardDesign):
    """All that a run takes its scale from: the board if there is one, faces of known shape, known distances.

    Without a board it has no dots: ``rows`` and ``columns`` are 0.
    """

    faces: tuple[FaceDesign, ...] = ()
    distances: tuple[KnownDistance, ...] = ()


def scale_reference(board: BoardDesign | None, target: TargetDesign) -> BoardDesign:
    """Returns the board, with the faces and distances of the target that tell its size if there are any."""
    faces = tuple(face for face in target.faces if face.sigma_mm is not None)
    if board is not None and not faces and not target.distances:
        return board
    known = {} if board is None else {entry.name: getattr(board, entry.name) for entry in fields(BoardDesign)}
    none = {"rows": 0, "columns": 0, "pitch_mm": 1.0, "radius_mm": 0.25, "polarity": "bright", "sigma_mm": 1.0}
    return ScaleReference(**(known or none), faces=faces, distances=target.distances)


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

    Rough poses: target frame = frame of face 1; close to table 2 of Zhang & Wei (2017) as far as that is consistent.
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
    return BoardDesign(7, 9, 30.0, 7.5, "bright", 0.005)
