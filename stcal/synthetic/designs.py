"""Designs to simulate: the reference target's poses, a quite different target, a cube and a dodecahedron of tags."""

from dataclasses import replace

import numpy as np

from stcal.boards.design import TAG_SIGMA_MM, TagLayout
from stcal.boards.target import printed_face
from stcal.design import BoardDesign, FaceDesign, TargetDesign, reference_target
from stcal.geometry.rigid import Rigid

REFERENCE_GROUPS = (("1", "2"), ("1", "4"), ("1", "5"), ("2", "3"))
"""Groups of Zhang & Wei (2017), sec. 2."""


def nominal_target_from_face() -> dict[str, Rigid]:
    """Returns the nominal face poses of the reference design, target frame = frame of face 1, mm."""
    return reference_target().rough_poses()


# Drawings of the second design: id, x, y, radius in mm, in a drawing frame with the origin in a corner of the face.
_TOP = [
    ("A", 15, 16, 6.0),
    ("B", 50, 18, 6.0),
    ("C", 85, 14, 6.0),
    ("D", 17, 60, 6.0),
    ("E", 62, 55, 6.0),
    ("F", 34, 38, 3.5),
    ("G", 84, 50, 3.5),
    ("H", 40, 84, 3.5),
    ("I", 76, 82, 3.5),
]
_LEFT = [
    ("p", 15, 26, 6.0),
    ("q", 46, 15, 6.0),
    ("r", 82, 40, 6.0),
    ("s", 24, 82, 6.0),
    ("t", 60, 78, 6.0),
    ("u", 32, 52, 3.5),
    ("v", 56, 44, 3.5),
    ("w", 85, 80, 3.5),
]
_RIGHT = [
    ("21", 20, 15, 6.0),
    ("22", 82, 18, 6.0),
    ("23", 18, 85, 6.0),
    ("24", 50, 52, 6.0),
    ("25", 52, 26, 3.5),
    ("26", 68, 70, 3.5),
    ("27", 34, 66, 3.5),
    ("28", 86, 58, 3.5),
    ("29", 74, 86, 3.5),
]
_EDGE_MM = 140.0


def second_design() -> tuple[TargetDesign, BoardDesign, dict[str, Rigid]]:
    """Returns a cube with dark circles on three white faces, a board with one larger corner dot, and nominal poses.

    It shares nothing with the reference design: face and circle ids, pattern, number of circles, radii, polarity, frame
    circles and board all differ. The poses are in the cube's own frame, with the origin at its centre.
    """
    x, y, z = np.eye(3)
    drawings = {
        "top": (_TOP, ("A", "C", "D"), (x, y, z)),
        "left": (_LEFT, ("q", "r", "s"), (y, z, x)),
        "right": (_RIGHT, ("24", "22", "29"), (z, x, y)),
    }
    faces, poses = [], {}
    for face_id, (circles, frame, axes) in drawings.items():
        face, drawing_from_face = face_of_drawing(face_id, circles, *frame)
        middle = np.array([50.0, 50.0, 0.0])
        rotation = np.column_stack(axes)
        cube_from_drawing = Rigid(rotation, rotation @ ([0, 0, _EDGE_MM / 2] - middle))
        poses[face_id] = cube_from_drawing @ drawing_from_face
        faces.append(replace(face, rough_target_from_face=poses[face_id]))
    target = TargetDesign("second target", "dark", tuple(faces))
    return target, BoardDesign(6, 8, 20.0, 5.0, "dark", 0.005, (0, 7), 7.5), poses


def face_of_drawing(face_id: str, circles, origin: str, x: str, y: str) -> tuple[FaceDesign, Rigid]:
    """Returns a face from (id, x, y, radius) rows in any drawing frame, and drawing_from_face.

    The face frame has its origin at circle ``origin``, X through circle ``x``, Y on the side of circle ``y``.
    """
    ids = tuple(row[0] for row in circles)
    xy = np.array([row[1:3] for row in circles], float)
    zero, on_x, on_y = (np.append(xy[ids.index(circle)], 0.0) for circle in (origin, x, y))
    drawing_from_face = three_point_frame(zero, on_x, on_y)
    xy_face = (drawing_from_face.inverse() @ np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
    return FaceDesign(face_id, ids, xy_face, [row[3] for row in circles], origin, x, y), drawing_from_face


def three_point_frame(origin: np.ndarray, on_x: np.ndarray, on_y: np.ndarray) -> Rigid:
    """Returns a_from_face of the frame through three points of frame a: X through ``on_x``, ``on_y`` on Y's side."""
    x = (on_x - origin) / np.linalg.norm(on_x - origin)
    z = np.cross(x, on_y - origin)
    z /= np.linalg.norm(z)
    return Rigid(np.column_stack([x, np.cross(z, x), z]), origin)


FAMILY = "DICT_APRILTAG_36h11"
CUBE_SHARE, PENTAGON_SHARE = 0.75, 0.7
"""Side of the tag over the edge of the body. A square face keeps a white border of an eighth, a pentagon about one of
0.14 edges at the tag's corners."""
GOLDEN = (1 + np.sqrt(5)) / 2


def tag_cube(edge_mm: float, dictionary: str = FAMILY, first_id: int = 0, size_sigma_mm: float = 0.0) -> TargetDesign:
    """Return a cube of this edge with six tags; ids count up from ``first_id``."""
    normals = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    half = edge_mm / 2
    square = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return _body("cube of tags", normals, half, CUBE_SHARE * edge_mm, square, dictionary, first_id, size_sigma_mm)


def tag_dodecahedron(
    edge_mm: float, dictionary: str = FAMILY, first_id: int = 0, size_sigma_mm: float = 0.0
) -> TargetDesign:
    """Return a dodecahedron of this edge with twelve tags; ids count up from ``first_id``."""
    signs = [(a, b) for a in (1, -1) for b in (1, -1)]
    corners = [np.roll([0.0, a, b * GOLDEN], k) for k in range(3) for a, b in signs]
    normals = np.array(corners) / np.sqrt(1 + GOLDEN**2)
    order = np.argsort(-normals @ normals[0], kind="stable")
    distance = edge_mm / 2 * np.sqrt(2.5 + 1.1 * np.sqrt(5))
    return _body(
        "dodecahedron of tags", normals[order], distance, PENTAGON_SHARE * edge_mm, None, dictionary, first_id,
        size_sigma_mm,
    )  # fmt: skip


def _body(
    name: str,
    normals: np.ndarray,
    distance_mm: float,
    tag_mm: float,
    outline: np.ndarray | None,
    dictionary: str,
    first_id: int,
    size_sigma_mm: float,
) -> TargetDesign:
    """Return a body of faces with these outward normals (n, 3), all at one distance from its middle."""
    tag_mm = float(np.round(tag_mm, 3))
    corners = tag_mm / 2 * np.array([[[-1, -1], [1, -1], [1, 1], [-1, 1]]], float)
    faces: list[FaceDesign] = []
    for k, normal in enumerate(normals):
        z = -normal
        side = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 else np.array([0, 1.0, 0])
        x = side - (side @ z) * z
        x /= np.linalg.norm(x)
        pose = Rigid(np.column_stack([x, np.cross(z, x), z]), distance_mm * normal)
        layout = TagLayout(((dictionary, first_id + k),), corners, TAG_SIGMA_MM)
        face = printed_face(
            str(k + 1), layout, TAG_SIGMA_MM, size_sigma_mm, rough_target_from_face=pose, outline_mm=outline
        )
        faces.append(face)
    return TargetDesign(name, "bright", tuple(faces))
