"""Plates of a target's faces, their net to fold, and sheets of boards, as discs, paths and words; mm, Y upwards."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    BoardSet,
    ChessboardDesign,
    FlatBoard,
    SquaresOrTags,
    TagLayout,
    black_areas,
    clear_mm,
    column_row,
)
from stcal.boards.target_file import INWARDS, ROUGH_KEYS
from stcal.design import BoardDesign, FaceDesign, Polarity, TargetDesign
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid

Ink = Literal["black", "white", "grey"]
Layer = Literal["GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS"]
LAYERS: tuple[Layer, ...] = ("GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS")
"""Layers. ``GROUND`` : ink behind a bright pattern; ``CUT`` : outlines and cut marks; ``DIMENSIONS`` : dimensions,
scale bars, registration marks; ``LABELS`` : words beside the parts."""
NO_TURN = np.eye(2)
WIDTH_PER_HEIGHT = 0.85
"""Approximate width of a letter over its height: for reserving space, not for typesetting."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A filled circle."""

    x: float
    y: float
    radius: float
    ink: Ink
    layer: Layer = "PATTERN"
    name: str = ""  # its label

    def box(self) -> np.ndarray:
        """Return the bounding box, (2, 2): smallest and largest coordinates."""
        return np.array([[self.x, self.y]]) + self.radius * np.array([[-1.0], [1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Lines (k, 2) each: thin ones, or, with a ``width`` of 0, the edges of an area, in which inner lines are holes."""

    lines: tuple[np.ndarray, ...]
    layer: Layer = "PATTERN"
    ink: Ink = "black"
    width: float = 0.0
    closed: bool = True
    dashed: bool = False

    def box(self) -> np.ndarray:
        return box_of(np.concatenate(self.lines))


@dataclass(frozen=True, slots=True)
class Text:
    """Words from (x, y) on the base line."""

    x: float
    y: float
    words: str
    height: float = 2.5  # of capitals
    anchor: Literal["start", "middle"] = "start"
    turned: bool = False  # upwards instead of along X
    ink: Ink = "black"
    layer: Layer = "LABELS"

    def box(self) -> np.ndarray:
        length = WIDTH_PER_HEIGHT * self.height * len(self.words)
        before = length / 2 if self.anchor == "middle" else 0.0
        box = np.array([[-before, -0.4 * self.height], [length - before, 1.2 * self.height]])
        if self.turned:
            box = np.array([[-box[1, 1], box[0, 0]], [-box[0, 1], box[1, 0]]])
        return box + np.array([self.x, self.y])


Shape: TypeAlias = Disc | Outline | Text


def box_of(points: np.ndarray) -> np.ndarray:
    """Return the bounding box of points (..., 2), (2, 2): smallest and largest coordinates."""
    flat = points.reshape(-1, 2)
    return np.array([flat.min(0), flat.max(0)])


def extent(shapes: Iterable[Shape]) -> np.ndarray:
    """Return the bounding box of all shapes, (2, 2)."""
    return box_of(np.array([shape.box() for shape in shapes]))


def line(points, layer: Layer, ink: Ink = "black", width: float = 0.15, closed=False, dashed=False) -> Outline:
    """Return a thin line through points (k, 2)."""
    return Outline((np.asarray(points, float),), layer, ink, width, closed, dashed)


def moved(shape: Shape, shift: ArrayLike, turn: np.ndarray = NO_TURN) -> Shape:
    """Return the shape after a turn (2, 2), which words do not follow, and a shift (2,)."""
    if isinstance(shape, Outline):
        return replace(shape, lines=tuple(line @ turn.T + shift for line in shape.lines))
    x, y = (np.array([shape.x, shape.y]) @ turn.T + shift).tolist()
    return replace(shape, x=x, y=y)


def corners_of(box: np.ndarray) -> np.ndarray:
    """Return the corners (4, 2) of a box (2, 2) of smallest and largest coordinates, anticlockwise."""
    (left, below), (right, above) = box.tolist()
    return np.array([[left, below], [right, below], [right, above], [left, above]])


def said_mm(value: float, digits: int = 3) -> str:
    """Return the text of a length in mm to the µm, or to more digits, without trailing zeros."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


Spans: TypeAlias = tuple[tuple[int, float, float, str], ...]
"""Lengths with their axis, both ends, and words."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A flat piece, seen from the side that is photographed, Y upwards."""

    name: str
    outline: np.ndarray  # (k, 2) cutting line
    shapes: tuple[Shape, ...]
    spans: Spans = ()  # lengths that are dimensioned
    lines: tuple[Outline, ...] = ()  # to cut and fold, if they replace the outline, which then only encloses the part


def face_part(face: FaceDesign, polarity: Polarity, margin_mm: float) -> Piece:
    """Return the plate of a face, in the face's frame as seen from outside, Y upwards."""
    if face.printed is not None:
        part = board_part(face.printed, f"face {face.id}", margin_mm)  # type: ignore[arg-type]
        outline = as_seen(face).outline_mm
        return part if outline is None else replace(part, outline=outline)
    shapes = _discs(face.xy_mm, face.radius_mm, face.labels(), polarity)
    return _part(f"face {face.id}", shapes, polarity, margin_mm, outline=face.outline_mm)


def as_seen(face: FaceDesign) -> FaceDesign:
    """Return a face with outline and pose in the frame of its drawing; the Y and Z of printed faces are inverted."""
    if face.printed is None:
        return face
    pose, outline = face.rough_target_from_face, None if face.outline_mm is None else face.outline_mm * [1, -1]
    return replace(face, outline_mm=outline, rough_target_from_face=None if pose is None else pose @ INWARDS)


def parts_of(design: TargetDesign | BoardDesign | FlatBoard | BoardSet, margin_mm: float) -> list[Piece]:
    """Return a plate for each face of a target, or a sheet for each board, with a margin of at least ``margin_mm``."""
    if isinstance(design, TargetDesign):
        return [face_part(face, design.polarity, margin_mm) for face in design.faces]
    boards = zip(design.names, design.boards, strict=True) if isinstance(design, BoardSet) else [("board", design)]
    return [board_part(board, name, margin_mm) for name, board in boards]


def board_part(board: BoardDesign | FlatBoard, name: str, margin_mm: float) -> Piece:
    """Return the sheet of a board; the board's Y, which points down, is inverted."""
    if isinstance(board, BoardDesign | AsymmetricCirclesDesign):
        return _dots(board, name, margin_mm)
    areas = [Outline(tuple(line * [1, -1] for line in lines)) for lines in black_areas(board)]
    description, spans = _squares_said(board)
    return _part(f"{name}: {description}", areas, "dark", max(margin_mm, clear_mm(board)), spans)


def _dots(board: BoardDesign | AsymmetricCirclesDesign, name: str, margin_mm: float) -> Piece:
    xy, radii = board.xy_mm() * [1, -1], board.radii_mm()
    names = board.labels() if isinstance(board, BoardDesign) else [""] * len(xy)
    pitch = board.pitch_mm if isinstance(board, BoardDesign) else board.spacing_mm
    spans = []
    for axis in (0, 1):
        low, high = float(xy[:, axis].min()), float(xy[:, axis].max())
        count, length = round((high - low) / pitch), said_mm(high - low)
        whole = abs(count * pitch - (high - low)) < 1e-6 * pitch  # rows of a hexagonal grid are nearer
        spans.append((axis, low, high, f"{count} × {said_mm(pitch)} = {length}" if whole else length))
    sizes = " and ".join(said_mm(2 * radius) for radius in sorted(set(radii.tolist())))
    description = f"{name}: {board.rows} × {board.columns} dots, diameter {sizes} mm"
    dots = _discs(xy, radii, names, board.polarity)
    if board.rings:
        cells = board.cells() if isinstance(board, BoardDesign) else column_row(board.rows, board.columns)[:, ::-1]
        holed = np.array([tuple(cell) in board.rings for cell in cells.tolist()])
        hole = 0.5  # of the radius of the dot
        other: Polarity = "bright" if board.polarity == "dark" else "dark"
        dots += _discs(xy[holed], hole * radii[holed], [""] * int(holed.sum()), other)
    return _part(description, dots, board.polarity, margin_mm, tuple(spans))


def _squares_said(board: SquaresOrTags) -> tuple[str, Spans]:
    """Return the description of a board, and the lengths to check as :attr:`Part.spans`; of tags those along the sides
    of the first that lies along the axes."""
    if isinstance(board, TagLayout):
        tags = board.tags
        names = ", ".join(f"{tag}" for _, tag in tags) if len(tags) <= 6 else f"{len(tags)}"
        families = ", ".join(dict.fromkeys(family for family, _ in tags))
        description = f"tag{'s' if len(tags) > 1 else ''} {names} of {families}"
        for corners in board.corners_mm * [1, -1]:
            low, high = box_of(corners)
            if np.abs(np.abs(corners - (low + high) / 2) - (high - low) / 2).max() < 1e-6:
                ends = zip(low.tolist(), high.tolist(), strict=True)
                return description, tuple((axis, a, b, said_mm(b - a)) for axis, (a, b) in enumerate(ends))
        return description, ()
    if isinstance(board, AprilGridDesign):
        tag = said_mm(board.tag_mm)
        words = f"{tag}, step {said_mm(board.tag_mm * (1 + board.spacing))}"
        description = f"AprilGrid, {board.rows} × {board.columns} tags of {tag} mm, {board.dictionary}"
        return description, ((0, 0.0, board.tag_mm, words), (1, 0.0, board.tag_mm, words))
    if isinstance(board, ChessboardDesign):
        columns, rows, first = board.columns - 1, board.rows - 1, 0.0
        description = f"chessboard, {board.rows} × {board.columns} inner corners"
    else:
        columns, rows, first = board.columns - 2, board.rows - 2, board.square_mm
        tags = f"tags {said_mm(board.marker_mm)} mm, {board.dictionary}"
        description = f"ChArUco, {board.rows} × {board.columns} squares, {tags}"
    across, down = ((count * board.square_mm, count) for count in (columns, rows))
    words = [f"{count} × {said_mm(board.square_mm)} = {said_mm(mm)}" for mm, count in (across, down)]
    return description, ((0, first, first + across[0], words[0]), (1, -first - down[0], -first, words[1]))


def _discs(xy, radii, names, polarity: Polarity) -> list[Shape]:
    ink = "black" if polarity == "dark" else "white"
    rows = zip(xy.tolist(), radii.tolist(), names, strict=True)
    return [Disc(x, y, radius, ink, name=str(name)) for (x, y), radius, name in rows]


def _part(name: str, pattern, polarity: Polarity, margin_mm: float, spans=(), outline=None) -> Piece:
    if outline is None:
        outline = corners_of(extent(pattern) + margin_mm * np.array([[-1.0], [1.0]]))
    outline = np.asarray(outline)
    ground = [Outline((outline,), "GROUND")] if polarity == "bright" else []
    return Piece(name, outline, (*ground, *pattern), spans)


TOGETHER_MM, TOGETHER_SHARE = 1.0, 0.01
"""Largest distance between the ends of an edge that two plates share, mm, and as a share of its length."""
TAB_MM, TAB_SHARE = 10.0, 0.25  # largest width of a tab, mm, and as a share of its edge
SKETCH, BESIDE = 1 / 8, 15.0  # scale of the sketch that names the faces, and its distance from the net, mm
LETTERS = 2.0  # height of names, mm
IN_CORNER = 3.0
"""Distance of the name of a printed face from the corner of its plate, mm: in the white about a tag."""
TOUCH = 1e-3  # overlap of plates that counts as rounding, mm
Edge: TypeAlias = tuple[str, int]
"""A face, and the number of an edge of its outline, anticlockwise."""


@dataclass(frozen=True, slots=True, eq=False)
class _Plate:
    """A face with net_from_face."""

    face: FaceDesign
    turn: np.ndarray  # (2, 2)
    shift: np.ndarray  # (2,)

    @property
    def corners(self) -> np.ndarray:
        """Corners (k, 2) of its outline in the net's plane."""
        return np.asarray(self.face.outline_mm) @ self.turn.T + self.shift

    def edges(self) -> Iterator[tuple[Edge, np.ndarray]]:
        """Yield the edges with their ends (2, 2)."""
        for edge, ends in enumerate(zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True)):
            yield (self.face.id, edge), np.array(ends)


def net_part(target: TargetDesign) -> Piece:
    """Return the net of all plates: those that share an edge, by ``outline_mm`` at rough poses, unfolded."""
    for face in target.faces:
        if face.outline_mm is None or face.rough_target_from_face is None:
            fault = f"--net: face {face.id} has no {'outline_mm' if face.outline_mm is None else ROUGH_KEYS}"
            remedy = "add it to the target file, or draw plates one by one without --net"
            raise InputError("E-DRAW-NET", f"{fault}; {remedy}")
    faces = {face.id: _against_the_clock(as_seen(face)) for face in target.faces}
    shared = _shared_edges(faces.values())
    first = max(faces, key=lambda face: sum(face == own for own, _ in shared))
    plates, free = [_Plate(faces[first], NO_TURN, np.zeros(2))], faces.keys() - {first}
    folds: set[Edge] = set()
    for plate in plates:  # grows
        for edge, ends in plate.edges():
            partner = shared.get(edge)
            if partner is None or partner[0] not in free:
                continue
            unfolded = _unfolded(ends, faces[partner[0]], partner[1])
            if _is_clear(unfolded.corners, [each.corners for each in plates]):
                plates.append(unfolded)
                free -= {partner[0]}
                folds |= {edge, partner}
    if free:
        fault = f"--net: the plate of face {min(free)} shares no edge with the others, or would lie on one"
        remedy = "correct outline_mm and rough_pose, or draw plates one by one without --net"
        raise InputError("E-DRAW-NET", f"{fault}; {remedy}")
    return _folded(plates, target.polarity, shared, folds)


def _against_the_clock(face: FaceDesign) -> FaceDesign:
    outline = np.asarray(face.outline_mm)
    ahead = np.roll(outline, -1, axis=0)
    area = (outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1]).sum()
    return replace(face, outline_mm=outline if area > 0 else outline[::-1])


def _shared_edges(faces: Iterable[FaceDesign]) -> dict[Edge, Edge]:
    """Return pairs of edges that two plates share in space, in both directions."""
    ends: dict[Edge, tuple[np.ndarray, np.ndarray]] = {}
    for face in faces:
        place = Rigid() if face.rough_target_from_face is None else face.rough_target_from_face
        corners = place @ np.pad(np.asarray(face.outline_mm), ((0, 0), (0, 1)))
        ends |= {(face.id, k): (corners[k], corners[(k + 1) % len(corners)]) for k in range(len(corners))}
    nearest = {}
    for edge, (a, b) in ends.items():
        near = max(TOGETHER_MM, TOGETHER_SHARE * float(np.linalg.norm(b - a)))
        for candidate, (c, d) in ends.items():
            if edge[0] != candidate[0] and max(np.linalg.norm(a - d), np.linalg.norm(b - c)) < near:
                nearest[edge] = candidate
    return {edge: candidate for edge, candidate in nearest.items() if nearest.get(candidate) == edge}


def _unfolded(ends: np.ndarray, face: FaceDesign, own: int) -> _Plate:
    """Return the face as a plate of the net, with its edge ``own`` along an edge of another plate, reversed."""
    outline = np.asarray(face.outline_mm)
    last, first = outline[own], outline[(own + 1) % len(outline)]
    angle = np.arctan2(*(ends[1] - ends[0])[::-1]) - np.arctan2(*(last - first)[::-1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return _Plate(face, turn, (ends[0] + ends[1]) / 2 - turn @ (first + last) / 2)


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


def _folded(plates: list[_Plate], polarity: Polarity, shared: dict[Edge, Edge], folds: set[Edge]) -> Piece:
    """Return the plates with what is to cut and fold, tabs under their partners, and a sketch with names."""
    grounds: list[Shape] = []
    shapes: list[Shape] = []
    lines: list[Outline] = []
    taken = [plate.corners for plate in plates]
    for plate in plates:
        for shape in face_part(plate.face, polarity, 0.0).shapes:
            (shapes if isinstance(shape, Disc) else grounds).append(moved(shape, plate.shift, plate.turn))
        if plate.face.printed:  # beside circles, a detector may take letters for circles
            inwards = plate.corners.mean(0) - plate.corners[0]
            x, y = (plate.corners[0] + IN_CORNER * inwards / np.linalg.norm(inwards)).tolist()
            shapes.append(Text(x, y - LETTERS / 2, plate.face.id, LETTERS, "middle"))
        for edge, ends in plate.edges():
            partner = shared.get(edge, edge)
            fold = line(ends, "FOLD", "grey", dashed=True)
            if edge in folds:
                lines += [fold] if edge < partner else []
                continue
            tab = _tab(ends)
            if edge >= partner or not _is_clear(tab, taken):
                lines.append(line(ends, "CUT", width=0.1))
                continue
            taken.append(tab)
            lines += [fold, line(tab, "CUT", width=0.1)]
            x, y = tab.mean(0).tolist()
            level = abs(ends[0, 1] - ends[1, 1]) < abs(ends[0, 0] - ends[1, 0])
            at = (x, y - LETTERS / 2) if level else (x + LETTERS / 2, y)
            shapes.append(Text(*at, f"under {partner[0]}", LETTERS, "middle", turned=not level))
    box = box_of(np.concatenate(taken))
    sketch = _sketch(plates, np.array([box[1, 0] + BESIDE, box[1, 1]]))
    return Piece("net", corners_of(box), (*grounds, *shapes, *sketch), lines=tuple(lines))


def _tab(ends: np.ndarray) -> np.ndarray:
    """Return a trapezium (4, 2) to the right of an edge, its outer side; it is open at the edge."""
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    along = along / length
    out = np.array([along[1], -along[0]])
    width = min(TAB_MM, TAB_SHARE * length)
    return np.array([ends[0], ends[0] + width * (along + out), ends[1] + width * (out - along), ends[1]])


def _sketch(plates: list[_Plate], left_above: np.ndarray) -> list[Shape]:
    """Return a small sketch of the plates, each with the name of its face."""
    every = np.concatenate([plate.corners for plate in plates])
    shift = left_above - SKETCH * np.array([every[:, 0].min(), every[:, 1].max()])
    shapes: list[Shape] = []
    for plate in plates:
        corners = SKETCH * plate.corners + shift
        x, y = corners.mean(0).tolist()
        shapes += [line(corners, "LABELS", closed=True), Text(x, y - LETTERS / 2, plate.face.id, LETTERS, "middle")]
    return shapes
