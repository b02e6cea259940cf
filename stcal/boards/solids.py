"""Designs of bodies with a tag on each face: a cube and a dodecahedron."""

import numpy as np

from stcal.boards.design import TagLayout
from stcal.boards.target import TAG_SIGMA_MM, printed_face
from stcal.design import FaceDesign, TargetDesign
from stcal.geometry.rigid import Rigid

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
