"""Pages of drawings: as large as their content, or of a paper, with parts split over several pages."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress, product

import numpy as np

from stcal.drawing.parts import (
    WIDTH_PER_HEIGHT,
    Disc,
    Line,
    Part,
    Shape,
    Text,
    box_of,
    extent,
    moved,
    said_mm,
    words_with_room,
)
from stcal.errors import InputError

APART = 6.0  # distance from a part to its first dimension, and between dimensions, mm
ARROW = 1.5
CUT_FROM, CUT_TO = 1.5, 5.0  # distances from the outline at which cut marks begin and end, mm
LETTERS = 2.0
ROW = 4.0
COLUMN_GAP = 3.0
PLAN, PLAN_LETTERS = 45.0, 1.5  # longer side of the plan of a plate, and height of its numbers, mm
BAR, SHORT_BAR = 100.0, 50.0  # lengths of scale bars, mm


def framed(part: Part, bare: bool = False) -> list[Shape]:
    """Return the part with its outline and, unless ``bare``, its name above, cut marks, and dimensions."""
    box = box_of(part.outline)
    lines = part.lines or (Line(part.outline, "CUT", width=0.1, closed=True),)
    if bare:
        return [*part.shapes, *lines]
    shapes: list[Shape] = [*part.shapes, *lines]
    for right, above, axis in product((0, 1), (0, 1), (0, 1)) if not part.lines else ():
        outwards = np.where(np.arange(2) == axis, [2 * right - 1, 2 * above - 1], 0)
        ends = np.array([box[right, 0], box[above, 1]]) + np.array([[CUT_FROM], [CUT_TO]]) * outwards
        shapes.append(Line(ends, "CUT", width=0.1))
    for axis in (0, 1):
        spans = [span for span in part.spans if span[0] == axis]
        outer = (axis, float(box[0, axis]), float(box[1, axis]), said_mm(box[1, axis] - box[0, axis]))
        for place, (_, low, high, words) in enumerate([*spans, outer]):
            shapes += _dimension(axis, low, high, words, float(box[0, 1 - axis]), APART * (place + 1))
    shapes.append(Text(float(box[0, 0]), float(box[1, 1]) + CUT_TO + 1.5, part.name, LETTERS))
    return shapes


def table(part: Part, below: bool) -> list[Shape]:
    """Return the part's table and plan, beside or below the shapes of :func:`framed`."""
    if not part.table:
        return []
    box = extent(framed(part))
    top = float(part.outline[:, 1].max())
    beside = float(box[1, 0]) + APART, top - LETTERS
    x, y = (float(part.outline[:, 0].min()), float(box[0, 1]) - ROW) if below else beside
    heading, *rows = part.table
    shapes: list[Shape] = [Text(x, y, " ".join(filter(None, heading)), LETTERS)]
    widths = [max(len(row[k]) for row in rows) * WIDTH_PER_HEIGHT * LETTERS + COLUMN_GAP for k in range(len(rows[0]))]
    ends = x + np.cumsum(widths)
    for number, row in enumerate(rows, 1):
        places = zip(row, ends.tolist(), strict=True)
        shapes += [Text(end - COLUMN_GAP, y - ROW * number, word, LETTERS, "end") for word, end in places]
    # The circles' numbers stand in a plan: a detector may take those on the plate itself for circles.
    corner = np.array((float(ends[-1]), y + LETTERS) if below else (x, y - ROW * len(part.table)))
    low, high = box_of(part.outline)
    scale, left_above = min(PLAN / float((high - low).max()), 1.0), np.array([low[0], high[1]])
    discs = [shape for shape in part.pattern() if isinstance(shape, Disc)]
    places = corner + scale * (np.array([(disc.x, disc.y) for disc in discs]) - left_above)
    shapes.append(Line(corner + scale * (part.outline - left_above), "LABELS", closed=True))
    return [*shapes, *words_with_room(places, [row[0] for row in part.table[2:]], PLAN_LETTERS)]


def scale_bars(width: float, height: float) -> list[Shape]:
    """Return scale bars along the lower and the left edge of a field from (0, 0), each with its true length."""
    shapes: list[Shape] = []
    for axis, room in ((0, width), (1, height)):
        length = BAR if room >= BAR + 2 else SHORT_BAR
        if room < length + 2:
            continue
        ends = np.zeros((2, 2))
        ends[1, axis] = length
        shapes.append(Line(ends + 1.0, "DIMENSIONS", width=0.2))
        for place in range(0, round(length) + 1, 10):
            tick = np.ones((2, 2))
            tick[:, axis] += place
            tick[1, 1 - axis] += 3.0 if place % 50 == 0 else 1.8
            shapes.append(Line(tick, "DIMENSIONS", width=0.2))
        words = f"{said_mm(length)} mm"
        middle = 1 + length / 2 + 8
        at = (middle, 3.5) if axis == 0 else (3.0 + LETTERS, middle)
        shapes.append(Text(*at, words, LETTERS, "middle", turned=axis == 1, layer="DIMENSIONS"))
    return shapes


def _dimension(axis: int, low: float, high: float, words: str, edge: float, away: float) -> list[Shape]:
    """Return the dimension of a length along X below ``edge``, or along Y to the left of it."""
    level = edge - away

    def line(*points) -> Line:
        xy = np.array(points, float)
        return Line(xy if axis == 0 else xy[:, ::-1], "DIMENSIONS", width=0.1)

    shapes: list[Shape] = [line((low, level), (high, level))]
    for end, sign in ((low, 1), (high, -1)):
        shapes.append(line((end, edge - 1.0), (end, level - 1.0)))
        shapes.append(line((end + sign * ARROW, level + 0.5), (end, level), (end + sign * ARROW, level - 0.5)))
    middle, above = (low + high) / 2, level + 0.8
    at = (middle, above) if axis == 0 else (above - 1.6, middle)
    return [*shapes, Text(*at, words, LETTERS, "middle", turned=axis == 1, layer="DIMENSIONS")]


PAPERS = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "Letter": (215.9, 279.4),
    "Legal": (215.9, 355.6),
    "Tabloid": (279.4, 431.8),
}
"""Width and height, mm."""
EDGE = 8.0  # width of the border that printers leave white, mm
SIDE, FOOT = 10.0, 14.0  # widths at the left and the bottom of a page for the scale bars and their text, mm
FURNITURE = np.array([2 * EDGE + SIDE, 2 * EDGE + FOOT])
"""Part of a page's width and height that is not available for parts, mm."""
OVERLAP = 10.0  # overlap of neighbouring sheets, mm
CROSS = 2.5  # half the length of a registration mark, mm
CLEAR = 1.0  # distance from a seam to the circles and squares that it passes, mm
BETWEEN = 12.0  # distance of parts on one sheet, mm
MOST_SHEETS = 500
MOST_MM = 5000.0  # largest side of a page in a PDF, mm


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Shapes in the sheet's frame, clipped to the box ``clip`` (2, 2) if it is given."""

    shapes: tuple[Shape, ...]
    clip: np.ndarray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A page with its origin at the bottom left."""

    title: str
    width: float
    height: float
    placed: tuple[Placed, ...]
    cuts: bool = False  # whether a seam runs through the pattern of its part
    bare: bool = False  # whether the part is without dimensions and table, with which it would take more sheets


def one_sheet(parts: Sequence[Part], title: str) -> Sheet:
    """Return one sheet with all parts, as large as needed."""
    drawn = [[*framed(part), *table(part, below=False)] for part in parts]
    boxes = [extent(shapes) for shapes in drawn]
    widest = max(np.sqrt(sum(np.prod(box[1] - box[0] + BETWEEN) for box in boxes)), *(np.ptp(b, 0)[0] for b in boxes))
    placed: list[Shape] = []
    x, top, lowest = 0.0, 0.0, 0.0
    for shapes, box in zip(drawn, boxes, strict=True):
        width, height = (box[1] - box[0]).tolist()
        if x > 0 and x + width > widest:
            x, top = 0.0, lowest - BETWEEN
        placed += [moved(shape, x - float(box[0, 0]), top - float(box[1, 1])) for shape in shapes]
        x, lowest = x + width + BETWEEN, min(lowest, top - height)
    box = extent(placed)
    width, height = (np.ptp(box, 0) + FURNITURE).tolist()
    shift = [EDGE + SIDE - float(box[0, 0]), EDGE + FOOT - float(box[0, 1])]
    return _sheet(title, width, height, tuple(moved(shape, *shift) for shape in placed))


def paper_sheets(parts: Sequence[Part], paper: str, title: str) -> list[Sheet]:
    """Return the sheets of a paper for all parts, as few as possible for each part without a seam through its pattern.

    A part that is larger than a sheet only by its dimensions and its table is drawn without them.
    """
    split = [min(_ways(part, paper), key=lambda way: (way.cuts, way.count, way.bare)) for part in parts]
    total = sum(way.count for way in split)
    if total > MOST_SHEETS:
        raise InputError(
            "E-DRAW-SHEETS", f"--paper {paper}: {total} sheets, at most {MOST_SHEETS}; take a larger paper, or none"
        )
    return [
        sheet
        for part, way in zip(parts, split, strict=True)
        for sheet in _tiles(way, f"{title}, {part.name}" if len(parts) > 1 else title)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """A layout of a part on a paper."""

    shapes: list[Shape]
    box: np.ndarray  # extent of the shapes
    size: tuple[float, float]  # of the paper
    seams: tuple[list[float], list[float]]  # along X and Y
    cuts: bool  # whether a seam runs through a circle, square or tag
    bare: bool

    @property
    def count(self) -> int:
        """Number of sheets."""
        return (len(self.seams[0]) + 1) * (len(self.seams[1]) + 1)


def _ways(part: Part, paper: str) -> list[_Way]:
    """Return the layouts of a part: portrait and landscape, with the table beside and below, or bare on one sheet."""
    ways, boxes = [], np.array([shape.box() for shape in part.pattern()])
    drawn = [(False, [*framed(part), *table(part, below)]) for below in (True, False)]
    if not part.lines:  # the pieces of a net need their names
        drawn.append((True, framed(part, bare=True)))
    for (bare, shapes), turned in product(drawn, (False, True)):
        width, height = PAPERS[paper]
        size = (height, width) if turned else (width, height)
        box, room = extent(shapes), np.array(size) - FURNITURE
        words = np.array([shape.box() for shape in shapes if isinstance(shape, Text)]).reshape(-1, 2, 2)
        across, down = (
            seams_between(float(box[0, k]), float(box[1, k]), float(room[k]), boxes[:, :, k], words[:, :, k])
            for k in (0, 1)
        )
        low, high = np.moveaxis(boxes, 1, 0)
        cuts = any(((low[:, k] < at) & (high[:, k] > at)).any() for k in (0, 1) for at in (across, down)[k])
        way = _Way(shapes, box, size, (across, down), cuts, bare)
        if not bare or way.count == 1:
            ways.append(way)
    return ways


def seams_between(
    low: float, high: float, room: float, taken: np.ndarray, words: np.ndarray | None = None
) -> list[float]:
    """Return the places that split a length so that no piece, with half the overlap at either end, exceeds ``room``.

    Seams avoid the intervals ``taken`` (n, 2) and, in a piece's second half, those of ``words`` (m, 2) if they can.
    """
    both = taken if words is None else np.concatenate([taken, words])
    seams, start = [], low
    while high - start > room:
        last = start + room - OVERLAP / 2
        choices = ((start + room / 2, both), (start + room / 2, taken), (start + OVERLAP, taken))
        places = (_free(last, first, avoided) for first, avoided in choices)
        seams.append(next((place for place in places if place is not None), last))
        start = seams[-1] - OVERLAP / 2
    return seams


def _free(last: float, first: float, taken: np.ndarray) -> float | None:
    """Return the last place up to ``last`` that is clear of the intervals ``taken``, or None beyond ``first``."""
    place = last
    while place > first:
        hit = taken[(taken[:, 0] < place + CLEAR) & (taken[:, 1] > place - CLEAR)]
        if not len(hit):
            return place
        place = min(float(hit[:, 0].min()) - CLEAR, place - 1e-6)
    return None


def _tiles(way: _Way, title: str) -> list[Sheet]:
    if way.count == 1:
        shift = [EDGE + SIDE - float(way.box[0, 0]), way.size[1] - EDGE - float(way.box[1, 1])]
        sheet = _sheet(title, *way.size, tuple(moved(shape, *shift) for shape in way.shapes))
        return [replace(sheet, bare=way.bare)]
    pieces = [  # start and end of each piece along X, and along Y
        [*zip([low, *(at - OVERLAP / 2 for at in seams)], [*(at + OVERLAP / 2 for at in seams), high], strict=True)]
        for seams, low, high in zip(way.seams, *way.box.tolist(), strict=True)
    ]
    shapes = [*way.shapes, *_registration(way)]
    boxes = [shape.box() for shape in shapes]
    sheets = []
    for row, (below, above) in enumerate(reversed(pieces[1]), 1):
        for column, (left, right) in enumerate(pieces[0], 1):
            shift = [EDGE + SIDE - left, EDGE + FOOT - below]
            clip = np.array([[left, below], [right, above]])
            inside = [(box[0] <= clip[1]).all() and (box[1] >= clip[0]).all() for box in boxes]
            shapes_of_sheet = tuple(moved(shape, *shift) for shape in compress(shapes, inside))
            place = f"sheet {len(sheets) + 1} of {way.count}: row {row}, column {column}"
            sheets.append(_sheet(f"{title}; {place}", *way.size, shapes_of_sheet, clip + shift, way.cuts))
    return sheets


def _registration(way: _Way) -> list[Shape]:
    """Return crosses where seams meet each other and the border; they appear on both sheets."""
    places = []
    for k in (0, 1):
        crossings = [way.box[0, 1 - k] + CROSS, *way.seams[1 - k], way.box[1, 1 - k] - CROSS]
        places += [(seam, crossing)[:: 1 - 2 * k] for seam in way.seams[k] for crossing in crossings]
    marks: list[Shape] = []
    for x, y in dict.fromkeys(places):
        for step in ([CROSS, 0.0], [0.0, CROSS]):
            ends = np.array([[x, y]]) + np.array([[-1.0], [1.0]]) * step
            marks.append(Line(ends, "DIMENSIONS", "white", 0.6))
            marks.append(Line(ends, "DIMENSIONS", "black", 0.1))
    return marks


def _sheet(title: str, width: float, height: float, shapes: tuple[Shape, ...], clip=None, cuts: bool = False) -> Sheet:
    bars = [moved(shape, EDGE, EDGE) for shape in scale_bars(width - 2 * EDGE, height - 2 * EDGE)]
    instruction = "1:1: print at 100 %, not fitted to the page, and measure the bars"
    if clip is not None:
        instruction += "; cut one of two sheets from cross to cross and lay it on the other's crosses"
    words = [Text(EDGE + SIDE, EDGE + 10.0, title, LETTERS), Text(EDGE + SIDE, EDGE + 7.0, instruction, 1.6)]
    return Sheet(title, width, height, (Placed(shapes, clip), Placed((*bars, *words))), cuts)
