"""Designs to simulate: the reference target's poses, a quite different target, a cube and a dodecahedron of tags."""

from dataclasses import replace
from typing import Literal

import numpy as np

from stcal.boards.board_designs import TAG_SIGMA_MM, UNIT_SQUARE, TagLayout
from stcal.boards.dictionaries import dictionary_of, known_tags
from stcal.boards.target_file import in_own_frame, printed_face, tags_on
from stcal.design import BoardDesign, FaceDesign, TargetDesign
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid

REFERENCE_GROUPS = (("1", "2"), ("1", "4"), ("1", "5"), ("2", "3"))  # groups of Zhang & Wei (2017), sec. 2.
DRAWINGS = {
    "top": "A 15 16 6, B 50 18 6, C 85 14 6, D 17 60 6, E 62 55 6, F 34 38 3.5, G 84 50 3.5, H 40 84 3.5, I 76 82 3.5",
    "left": "p 15 26 6, q 46 15 6, r 82 40 6, s 24 82 6, t 60 78 6, u 32 52 3.5, v 56 44 3.5, w 85 80 3.5",
    "right": "21 20 15 6, 22 82 18 6, 23 18 85 6, 24 50 52 6, 25 52 26 3.5, 26 68 70 3.5, 27 34 66 3.5, 28 86 58 3.5, "
    "29 74 86 3.5",
}
"""Circles of the second design, id, x, y and radius in mm, in a frame with the origin in a corner of the face."""
EDGE_MM = 140.0


def second_design() -> tuple[TargetDesign, BoardDesign, dict[str, Rigid]]:
    """Returns a cube with dark circles on three white faces, a board with one larger corner dot, and nominal poses.

    It shares nothing with the reference design: face and circle ids, pattern, number of circles, radii, polarity, frame
    circles and board all differ. The poses target_from_face, mm, by face id are in the cube's own frame, with the
    origin at its centre.
    """
    frames, faces, poses = (("A", "C", "D"), ("q", "r", "s"), ("24", "22", "29")), [], {}
    for k, ((face_id, drawing), frame) in enumerate(zip(DRAWINGS.items(), frames, strict=True)):
        rows = [row.split() for row in drawing.split(", ")]
        circles = [(name, float(x), float(y), float(radius)) for name, x, y, radius in rows]
        face, drawing_from_face = face_of_drawing(face_id, circles, *frame)
        rotation = np.roll(np.eye(3), k, axis=0)
        cube_from_drawing = Rigid(rotation, rotation @ [-50.0, -50.0, EDGE_MM / 2])
        poses[face_id] = cube_from_drawing @ drawing_from_face
        faces.append(replace(face, rough_target_from_face=poses[face_id]))
    target = TargetDesign("second target", "dark", tuple(faces))
    return target, BoardDesign(6, 8, 20.0, 5.0, "dark", 0.005, (0, 7), 7.5), poses


def face_of_drawing(face_id: str, circles, origin: str, x: str, y: str) -> tuple[FaceDesign, Rigid]:
    """Returns a face from (id, x, y, radius) rows in any drawing frame, and drawing_from_face."""
    ids, xy = tuple(row[0] for row in circles), np.array([row[1:3] for row in circles], float)
    return in_own_frame(FaceDesign(face_id, ids, xy, [row[3] for row in circles], origin, x, y))


FAMILY = "DICT_APRILTAG_36h11"
CUBE_SHARE, PENTAGON_SHARE = 0.75, 0.7
"""Side of the tag over the edge of the body. A square face keeps a white border of an eighth, a pentagon about one of
0.14 edges at the tag's corners."""
GOLDEN = (1 + np.sqrt(5)) / 2
DODECAHEDRON_WIDTH = float(np.sqrt(2.5 + 1.1 * np.sqrt(5)))
"""Distance of opposite faces of a dodecahedron over its edge."""


def tag_cube(edge_mm: float, dictionary: str = FAMILY, first_id: int = 0, size_sigma_mm: float = 0.0) -> TargetDesign:
    """Return a cube of this edge with six tags; ids count up from ``first_id``."""
    normals = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    tag_mm = CUBE_SHARE * edge_mm
    return _body("cube of tags", normals, edge_mm / 2, tag_mm, dictionary, first_id, size_sigma_mm)


def tag_dodecahedron(edge_mm: float, dictionary: str = FAMILY, first_id: int = 0) -> TargetDesign:
    """Return a dodecahedron of this edge with twelve tags; ids count up from ``first_id``."""
    signs = [(a, b) for a in (1, -1) for b in (1, -1)]
    corners = [np.roll([0.0, a, b * GOLDEN], k) for k in range(3) for a, b in signs]
    normals = np.array(corners) / np.sqrt(1 + GOLDEN**2)
    order = np.argsort(-normals @ normals[0], kind="stable")
    distance, tag_mm = edge_mm * DODECAHEDRON_WIDTH / 2, PENTAGON_SHARE * edge_mm
    return _body("dodecahedron of tags", normals[order], distance, tag_mm, dictionary, first_id)


MOST_WIDTH_MM = 10_000.0
MIN_CELL_PX = 2.0  # width of a tag's cell below which its corners are several times less exact
Body = Literal["cube", "dodecahedron"]


def tag_body(kind: Body, size: str | float, dictionary: str, first_id: int, faces: str = "") -> TargetDesign:
    """Return a body of tags by its width between opposite faces, mm, which may be a text. ``faces`` : ids of the
    faces that it is to have, such as ``1,2,3,4,5``; all of them if empty."""
    width = width_of(size)
    make, edge_mm, count = {
        "cube": (tag_cube, width, 6),
        "dodecahedron": (tag_dodecahedron, width / DODECAHEDRON_WIDTH, 12),
    }[kind]
    family = known_tags([(dictionary, first_id + face) for face in range(count)], "--tags, --dictionary")[0][0]
    whole = make(edge_mm, family, first_id)
    kept, ids = [name.strip() for name in faces.split(",") if name.strip()], [face.id for face in whole.faces]
    if unknown := [name for name in kept if name not in ids]:
        raise InputError("E-OPTION-VALUE", f"--faces {faces}: no face {unknown[0]}; use some of {', '.join(ids)}")
    if kept and len(set(kept)) < 2:
        raise InputError("E-OPTION-VALUE", f"--faces {faces}: one face; two or more needed, such as 1,2,3")
    return replace(whole, faces=tuple(face for face in whole.faces if not kept or face.id in kept))


def width_of(size: str | float) -> float:
    """Return the width of a body, mm, which may be a text; errors as :func:`tag_body`."""
    try:
        width = float(size)
    except ValueError:
        width = 0.0
    if not 0 < width <= MOST_WIDTH_MM:
        raise InputError("E-OPTION-VALUE", f"--size {size}: a width between opposite faces, mm, needed with --tags")
    return width


def made_text(target: TargetDesign, camera: Camera, distance_mm: float) -> str:
    """Return the size of the tags of a body, on paper and in photographs, with a warning where they are small."""
    face = target.faces[0]
    tag_mm = float(np.linalg.norm(face.xy_mm[1] - face.xy_mm[0]))
    tag_px = tag_mm / distance_mm * float(np.sqrt(camera.focal.prod()))
    tags = [tag for each in target.with_faces(printed=True).faces for tag in tags_on(each.printed)]
    cells = dictionary_of(tags[0][0]).markerSize + 2
    text = (
        f"{len(target.faces)} faces, tags {tags[0][1]} to {tags[-1][1]} of {tags[0][0]}, {tag_mm:g} mm; "
        f"{tag_px:.0f} px at {distance_mm:g} mm, {tag_px / cells:.1f} px a cell"
    )
    nearest = distance_mm * tag_px / (2 * MIN_CELL_PX * cells)
    tilted = f"\nwarning: cells tilted by 60° are under {MIN_CELL_PX:g} px; photograph it from {nearest:.0f} mm"
    return text + tilted * (nearest < distance_mm)


def _body(name, normals: np.ndarray, distance_mm, tag_mm, dictionary, first_id: int, size_sigma_mm=0.0) -> TargetDesign:
    """Return a body of faces with these outward normals (n, 3), all at one distance from its middle."""
    tag_mm = float(np.round(tag_mm, 3))
    faces: list[FaceDesign] = []
    for k, normal in enumerate(normals):
        z = -normal
        side = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 else np.array([0, 1.0, 0])
        x = side - (side @ z) * z
        x /= np.linalg.norm(x)
        pose = Rigid(np.column_stack([x, np.cross(z, x), z]), distance_mm * normal)
        layout = TagLayout(((dictionary, first_id + k),), tag_mm * UNIT_SQUARE[None], TAG_SIGMA_MM)
        more = {"rough_target_from_face": pose, "outline_mm": _outline(k, normals, distance_mm, pose)}
        faces.append(printed_face(str(k + 1), layout, TAG_SIGMA_MM, size_sigma_mm, **more))
    return TargetDesign(name, "bright", tuple(faces))


def _outline(face: int, normals: np.ndarray, distance_mm: float, pose: Rigid) -> np.ndarray:
    """Return the corners (k, 2) of a face of a regular body in its own frame: where it meets two neighbours."""
    cosine = normals @ normals[face]
    beside = np.flatnonzero(np.isclose(cosine, cosine[cosine < 1 - 1e-6].max()))
    across = normals[beside] @ pose.rotation[:, :2]
    beside = beside[np.argsort(np.arctan2(across[:, 1], across[:, 0]))]
    corners = [
        np.linalg.solve(normals[[face, one, other]], np.full(3, distance_mm))
        for one, other in zip(beside, np.roll(beside, -1), strict=True)
    ]
    return (pose.inverse() @ np.array(corners))[:, :2].round(6)
