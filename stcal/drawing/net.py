"""A folding net: plates (``outline_mm`` at rough poses) that share an edge in space, unfolded into one plane."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from stcal.boards.target_file import ROUGH_KEYS
from stcal.design import FaceDesign, TargetDesign
from stcal.drawing.parts import (
    Area,
    Disc,
    Line,
    Part,
    Shape,
    Text,
    as_seen,
    box_of,
    corners_of,
    face_part,
    words_with_room,
)
from stcal.errors import InputError

TOGETHER_MM, TOGETHER_SHARE = 1.0, 0.01
"""Largest distance between the ends of an edge that two plates share, mm, and as a share of its length."""
TAB_MM, TAB_SHARE = 10.0, 0.25  # largest width of a tab, mm, and as a share of its edge
SKETCH, SKETCH_OF_CIRCLES = 1 / 8, 1 / 5
"""Scale of the sketch that names the faces, and of one that numbers their circles too."""
APART = 15.0
LETTERS, SMALL_LETTERS = 2.0, 1.2  # height of names, and of the numbers of circles in the sketch, mm
IN_CORNER = 3.0
"""Distance of the name of a printed face from the corner of its plate, mm: in the white about a tag."""
TOUCH = 1e-3  # overlap of plates that counts as rounding, mm


@dataclass(frozen=True, slots=True, eq=False)
class _Plate:
    """A face with net_from_face."""

    face: FaceDesign
    turn: np.ndarray  # (2, 2)
    shift: np.ndarray  # (2,)

    def place(self, xy) -> np.ndarray:
        """Return points of the face in the net's plane."""
        return np.asarray(xy) @ self.turn.T + self.shift

    def corners(self) -> np.ndarray:
        """Return the corners of the outline, (k, 2), in the net's plane."""
        return self.place(self.face.outline_mm)


def net_part(target: TargetDesign) -> Part:
    """Return the net of all plates."""
    for face in target.faces:
        if face.outline_mm is None or face.rough_target_from_face is None:
            raise InputError(
                "E-DRAW-NET",
                f"--net: face {face.id} has no {'outline_mm' if face.outline_mm is None else ROUGH_KEYS}; add it to "
                "the target file, or draw plates one by one without --net",
            )
    target = replace(target, faces=tuple(as_seen(face) for face in target.faces))
    shared = _shared_edges(target)
    faces = [replace(face, outline_mm=_against_the_clock(face)) for face in target.faces]
    first = max(faces, key=lambda face: sum(face.id == face_id for face_id, _ in shared))
    plates = [_Plate(first, np.eye(2), np.zeros(2))]
    free = {face.id for face in faces} - {first.id}
    folds: set[tuple[tuple[str, int], tuple[str, int]]] = set()
    for plate in plates:  # grows
        for edge in range(len(plate.corners())):
            partner = shared.get((plate.face.id, edge))
            if partner is None or partner[0] not in free:
                continue
            unfolded = _unfolded(plate, edge, target.face(partner[0]), partner[1])
            if _is_clear(unfolded.corners(), [each.corners() for each in plates]):
                plates.append(unfolded)
                free.remove(partner[0])
                folds |= {((plate.face.id, edge), partner), (partner, (plate.face.id, edge))}
    if free:
        raise InputError(
            "E-DRAW-NET",
            f"--net: the plate of face {min(free)} shares no edge with the others, or would lie on one; correct "
            "outline_mm and rough_pose, or draw plates one by one without --net",
        )
    return _part(plates, target, shared, folds)


def _shared_edges(target: TargetDesign) -> dict[tuple[str, int], tuple[str, int]]:
    """Return pairs of shared edges, in both directions, as face and edge number; edges count anticlockwise."""
    ends = {}
    for face in target.faces:
        assert face.rough_target_from_face is not None
        outline = _against_the_clock(face)
        place = face.rough_target_from_face @ np.pad(outline, ((0, 0), (0, 1)))
        ends |= {(face.id, k): (place[k], place[(k + 1) % len(place)]) for k in range(len(place))}
    nearest = {}
    for edge, (a, b) in ends.items():
        near = max(TOGETHER_MM, TOGETHER_SHARE * float(np.linalg.norm(b - a)))
        for candidate, (c, d) in ends.items():
            if edge[0] != candidate[0] and max(np.linalg.norm(a - d), np.linalg.norm(b - c)) < near:
                nearest[edge] = candidate
    return {edge: candidate for edge, candidate in nearest.items() if nearest.get(candidate) == edge}


def _against_the_clock(face: FaceDesign) -> np.ndarray:
    outline = np.asarray(face.outline_mm)
    ahead = np.roll(outline, -1, axis=0)
    area = (outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1]).sum()
    return outline if area > 0 else outline[::-1]


def _unfolded(plate: _Plate, edge: int, face: FaceDesign, own: int) -> _Plate:
    """Return the face as a plate beside ``plate``, with its edge ``own`` along that plate's ``edge``, reversed."""
    corners, outline = plate.corners(), _against_the_clock(face)
    start, end = corners[edge], corners[(edge + 1) % len(corners)]
    last, first = outline[own], outline[(own + 1) % len(outline)]
    angle = np.arctan2(*(end - start)[::-1]) - np.arctan2(*(last - first)[::-1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = (start + end) / 2 - turn @ (first + last) / 2
    return _Plate(replace(face, outline_mm=outline), turn, middle)


def _is_clear(one: np.ndarray, others: Iterable[np.ndarray]) -> bool:
    """Return True if a polygon overlaps no other, by separating axes; concave polygons may count with their hulls."""

    def overlaps(other: np.ndarray) -> bool:
        for polygon in (one, other):
            side = np.roll(polygon, -1, axis=0) - polygon
            normals = np.column_stack([side[:, 1], -side[:, 0]]) / np.linalg.norm(side, axis=1)[:, None]
            a, b = one @ normals.T, other @ normals.T
            if ((a.max(0) <= b.min(0) + TOUCH) | (b.max(0) <= a.min(0) + TOUCH)).any():
                return False
        return True

    return not any(map(overlaps, others))


def _part(plates: list[_Plate], target: TargetDesign, shared, folds) -> Part:
    grounds: list[Shape] = []
    shapes: list[Shape] = []
    lines: list[Line] = []
    tabs: list[np.ndarray] = []
    for plate in plates:
        plate_part = face_part(plate.face, target.polarity, 0.0)
        for shape in plate_part.shapes:
            if isinstance(shape, Disc):
                x, y = plate.place([shape.x, shape.y]).tolist()
                shapes.append(replace(shape, x=x, y=y))
            elif isinstance(shape, Area):
                grounds.append(replace(shape, lines=tuple(plate.place(line) for line in shape.lines)))
        corners = plate.corners()
        if plate.face.printed:  # beside circles, a detector may take letters for circles
            inwards = corners.mean(0) - corners[0]
            x, y = (corners[0] + IN_CORNER * inwards / np.linalg.norm(inwards)).tolist()
            shapes.append(Text(x, y - LETTERS / 2, plate.face.id, LETTERS, "middle"))
        for edge in range(len(corners)):
            edge_id, partner = (plate.face.id, edge), shared.get((plate.face.id, edge))
            ends = np.array([corners[edge], corners[(edge + 1) % len(corners)]])
            if (edge_id, partner) in folds:
                lines += [Line(ends, "FOLD", "grey", dashed=True)] if edge_id < partner else []
                continue
            tab = _tab(ends) if partner and edge_id < partner else None
            if tab is None or not _is_clear(tab, [*(each.corners() for each in plates), *tabs]):
                lines.append(Line(ends, "CUT", width=0.1))
                continue
            tabs.append(tab)
            lines += [Line(ends, "FOLD", "grey", dashed=True), Line(tab, "CUT", width=0.1)]
            x, y = tab.mean(0).tolist()
            level = abs(ends[0, 1] - ends[1, 1]) < abs(ends[0, 0] - ends[1, 0])
            words = f"under {partner[0]}"
            at = (x, y - LETTERS / 2) if level else (x + LETTERS / 2, y)
            shapes.append(Text(*at, words, LETTERS, "middle", turned=not level))
    box = box_of(np.concatenate([*(plate.corners() for plate in plates), *tabs]))
    sketch = _sketch(plates, box[1, 0] + APART, box[1, 1])
    return Part("net", corners_of(box), (*grounds, *shapes, *sketch), lines=tuple(lines))


def _tab(ends: np.ndarray) -> np.ndarray:
    """Return a trapezium (4, 2) to the right of an edge, its outer side; it is open at the edge."""
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    along = along / length
    out = np.array([along[1], -along[0]])
    width = min(TAB_MM, TAB_SHARE * length)
    return np.array([ends[0], ends[0] + width * (along + out), ends[1] + width * (out - along), ends[1]])


def _sketch(plates: list[_Plate], left: float, above: float) -> list[Shape]:
    """Return a small sketch of the plates, each with the name of its face, and the numbers of its circles."""
    every = np.concatenate([plate.corners() for plate in plates])
    scale = SKETCH if any(plate.face.printed for plate in plates) else SKETCH_OF_CIRCLES
    shift = np.array([left, above]) - scale * np.array([every[:, 0].min(), every[:, 1].max()])
    words: list[Text] = []
    for plate in plates:
        if plate.face.printed is None:  # corners of tags have no numbers
            places = scale * plate.place(plate.face.xy_mm) + shift
            words += words_with_room(places, plate.face.ids, SMALL_LETTERS, words)
    outlines = [scale * plate.corners() + shift for plate in plates]
    for plate, corners in zip(plates, outlines, strict=True):
        words.append(_name(plate.face.id, corners, words))
    return [*(Line(corners, "LABELS", closed=True) for corners in outlines), *words]


def _name(face: str, corners: np.ndarray, words: list[Text]) -> Text:
    """Return the name of a face within a plate of the sketch, near its middle, if there is room between ``words``."""
    middle, half = corners.mean(0), np.ptp(corners, axis=0) / 2
    inner = np.maximum(half - Text(0, 0, face, LETTERS, "middle").box()[1], 0)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 17)]), axis=-1).reshape(-1, 2) * inner
    grid = np.concatenate([np.zeros((1, 2)), grid[np.argsort(np.linalg.norm(grid, axis=1), kind="stable")]])
    free = words_with_room(middle + grid, [face] * len(grid), LETTERS, words)
    x, y = middle.tolist()
    return free[0] if free else Text(x, y - LETTERS / 2, face, LETTERS, "middle")
