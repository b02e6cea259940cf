"""Plates of a target's faces and sheets of boards as discs, areas, lines and words; mm, X to the right, Y upwards."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

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
)
from stcal.design import BoardDesign, FaceDesign, Polarity, TargetDesign
from stcal.geometry.rigid import Rigid

Ink = Literal["black", "white", "grey"]
Layer = Literal["GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS"]
LAYERS: tuple[Layer, ...] = ("GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS")
"""Layers. ``GROUND`` : ink behind a bright pattern; ``CUT`` : outlines and cut marks; ``DIMENSIONS`` : dimensions,
scale bars, registration marks; ``LABELS`` : words beside the parts."""
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
class Area:
    """A filled area between closed ``lines`` (k, 2); lines inside others are holes."""

    lines: tuple[np.ndarray, ...]
    ink: Ink
    layer: Layer = "PATTERN"

    def box(self) -> np.ndarray:
        return box_of(np.concatenate(self.lines))


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A thin line through ``points`` (k, 2)."""

    points: np.ndarray
    layer: Layer
    ink: Ink = "black"
    width: float = 0.15
    closed: bool = False
    dashed: bool = False

    def box(self) -> np.ndarray:
        return box_of(self.points)


@dataclass(frozen=True, slots=True)
class Text:
    """Words from (x, y) on the base line."""

    x: float
    y: float
    words: str
    height: float = 2.5  # of capitals
    anchor: Literal["start", "middle", "end"] = "start"
    turned: bool = False  # upwards instead of along X
    ink: Ink = "black"
    layer: Layer = "LABELS"

    def box(self) -> np.ndarray:
        length = WIDTH_PER_HEIGHT * self.height * len(self.words)
        before = {"start": 0.0, "middle": length / 2, "end": length}[self.anchor]
        box = np.array([[-before, -0.4 * self.height], [length - before, 1.2 * self.height]])
        if self.turned:
            box = np.array([[-box[1, 1], box[0, 0]], [-box[0, 1], box[1, 0]]])
        return box + np.array([self.x, self.y])


Shape: TypeAlias = Disc | Area | Line | Text


def box_of(points: np.ndarray) -> np.ndarray:
    """Return the bounding box of points (..., 2), (2, 2): smallest and largest coordinates."""
    flat = points.reshape(-1, 2)
    return np.array([flat.min(0), flat.max(0)])


def extent(shapes: Iterable[Shape]) -> np.ndarray:
    """Return the bounding box of all shapes, (2, 2)."""
    return box_of(np.array([shape.box() for shape in shapes]))


def moved(shape: Shape, x: float, y: float) -> Shape:
    """Return the shape shifted by (x, y)."""
    if isinstance(shape, Disc | Text):
        return replace(shape, x=shape.x + x, y=shape.y + y)
    if isinstance(shape, Area):
        return replace(shape, lines=tuple(line + np.array([x, y]) for line in shape.lines))
    return replace(shape, points=shape.points + np.array([x, y]))


def corners_of(box: np.ndarray) -> np.ndarray:
    """Return the corners (4, 2) of a box (2, 2) of smallest and largest coordinates, anticlockwise."""
    (left, below), (right, above) = box.tolist()
    return np.array([[left, below], [right, below], [right, above], [left, above]])


def words_with_room(places: np.ndarray, words: Iterable[str], height: float, taken: Iterable[Text] = ()) -> list[Text]:
    """Return words about their places (n, 2), without those that would overlap others before, or the ``taken`` ones."""
    found, boxes = [], [text.box() for text in taken]
    for (x, y), word in zip(places.tolist(), words, strict=True):
        text = Text(x, y - height / 2, word, height, "middle")
        low, high = text.box()
        if all((low >= box[1]).any() or (high <= box[0]).any() for box in boxes):
            found.append(text)
            boxes.append(text.box())
    return found


def said_mm(value: float) -> str:
    """Return the text of a length in mm to the µm, without trailing zeros."""
    text = f"{value:.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


Spans: TypeAlias = tuple[tuple[int, float, float, str], ...]
"""Lengths with their axis, both ends, and words."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A flat piece, seen from the side that is photographed, Y upwards."""

    name: str
    outline: np.ndarray  # (k, 2) cutting line
    shapes: tuple[Shape, ...]
    spans: Spans = ()  # lengths that are dimensioned
    table: tuple[tuple[str, ...], ...] = ()  # rows of words, the first a note, the second the heads
    lines: tuple[Line, ...] = ()  # to cut and fold, if they replace the outline, which then only encloses the part

    def pattern(self) -> list[Shape]:
        """Return the shapes of the pattern, without the ground."""
        return [shape for shape in self.shapes if shape.layer == "PATTERN"]


def face_part(face: FaceDesign, polarity: Polarity, margin_mm: float) -> Part:
    """Return the plate of a face, in the face's frame as seen from outside, Y upwards."""
    if face.printed is not None:
        part = board_part(face.printed, f"face {face.id}", margin_mm)  # type: ignore[arg-type]
        outline = as_seen(face).outline_mm
        return part if outline is None else replace(part, outline=outline)
    shapes = _discs(face.xy_mm, face.radius_mm, face.labels(), polarity)
    rows = [
        (circle, said_mm(x), said_mm(y), said_mm(2 * r))
        for circle, (x, y), r in zip(face.ids, face.xy_mm.tolist(), face.radius_mm.tolist(), strict=True)
    ]
    frame = (f"mm from circle {face.origin},", f"X through {face.x}", "", "")
    table = (frame, ("circle", "x", "y", "diameter"), *rows)
    return _part(f"face {face.id}", shapes, polarity, margin_mm, table=table, outline=face.outline_mm)


def as_seen(face: FaceDesign) -> FaceDesign:
    """Return a face with outline and pose in the frame of its drawing; the Y and Z of printed faces are inverted."""
    if face.printed is None:
        return face
    turn, pose = Rigid(np.diag([1.0, -1.0, -1.0])), face.rough_target_from_face
    outline = None if face.outline_mm is None else face.outline_mm * [1, -1]
    return replace(face, outline_mm=outline, rough_target_from_face=None if pose is None else pose @ turn)


def parts_of(design: TargetDesign | BoardDesign | FlatBoard | BoardSet, margin_mm: float) -> list[Part]:
    """Return a plate for each face of a target, or a sheet for each board, with a margin of at least ``margin_mm``."""
    if isinstance(design, TargetDesign):
        return [face_part(face, design.polarity, margin_mm) for face in design.faces]
    boards = zip(design.names, design.boards, strict=True) if isinstance(design, BoardSet) else [("board", design)]
    return [board_part(board, name, margin_mm) for name, board in boards]


def board_part(board: BoardDesign | FlatBoard, name: str, margin_mm: float) -> Part:
    """Return the sheet of a board; the board's Y, which points down, is inverted."""
    if isinstance(board, BoardDesign | AsymmetricCirclesDesign):
        return _dots(board, name, margin_mm)
    areas = [Area(tuple(line * [1, -1] for line in lines), "black") for lines in black_areas(board)]
    description, spans = _squares_said(board)
    return _part(f"{name}: {description}", areas, "dark", max(margin_mm, clear_mm(board)), spans)


def _dots(board: BoardDesign | AsymmetricCirclesDesign, name: str, margin_mm: float) -> Part:
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
        in_rows = np.column_stack(np.divmod(np.arange(len(xy)), board.columns))
        cells = board.cells() if isinstance(board, BoardDesign) else in_rows
        holed = np.array([tuple(cell) in board.rings for cell in cells.tolist()])
        hole = 0.5  # of the radius of the dot
        other: Polarity = "bright" if board.polarity == "dark" else "dark"
        dots += _discs(xy[holed], hole * radii[holed], [""] * int(holed.sum()), other)
    return _part(description, dots, board.polarity, margin_mm, tuple(spans))


def _squares_said(board: SquaresOrTags) -> tuple[str, Spans]:
    """Return the description of a board, and the lengths to check as :attr:`Part.spans`."""
    if isinstance(board, TagLayout):
        return _tags_said(board)
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


def _tags_said(layout: TagLayout) -> tuple[str, Spans]:
    """Return as :func:`_squares_said`; the side of a tag that lies along the axes is what to measure."""
    names = ", ".join(f"{tag}" for _, tag in layout.tags) if len(layout.tags) <= 6 else f"{len(layout.tags)}"
    families = ", ".join(dict.fromkeys(family for family, _ in layout.tags))
    description = f"tag{'s' if len(layout.tags) > 1 else ''} {names} of {families}"
    for corners in layout.corners_mm * [1, -1]:
        low, high = box_of(corners)
        if np.abs(np.abs(corners - (low + high) / 2) - (high - low) / 2).max() < 1e-6:
            ends = zip(low.tolist(), high.tolist(), strict=True)
            return description, tuple((axis, a, b, said_mm(b - a)) for axis, (a, b) in enumerate(ends))
    return description, ()


def _discs(xy, radii, names, polarity: Polarity) -> list[Shape]:
    ink = "black" if polarity == "dark" else "white"
    rows = zip(xy.tolist(), radii.tolist(), names, strict=True)
    return [Disc(x, y, radius, ink, name=str(name)) for (x, y), radius, name in rows]


def _part(name: str, pattern, polarity: Polarity, margin_mm: float, spans=(), table=(), outline=None) -> Part:
    if outline is None:
        outline = corners_of(extent(pattern) + margin_mm * np.array([[-1.0], [1.0]]))
    outline = np.asarray(outline)
    ground = [Area((outline,), "black", "GROUND")] if polarity == "bright" else []
    return Part(name, outline, (*ground, *pattern), spans, table)
