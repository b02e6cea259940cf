"""Annotations around a part: its name, cut marks, dimensions, a table; and bars that show the scale of a print."""

import numpy as np

from stcal.drawing.parts import Part
from stcal.drawing.shapes import WIDTH_PER_HEIGHT, Line, Shape, Text, extent, said_mm

APART = 6.0
"""Distance from a part to its first dimension, and between dimensions, mm."""
ARROW = 1.5
CUT_FROM, CUT_TO = 1.5, 5.0
"""Distances from the outline at which cut marks begin and end, mm."""
LETTERS = 2.0
ROW = 4.0
COLUMN_GAP = 3.0
BAR, SHORT_BAR = 100.0, 50.0
"""Lengths of scale bars, mm."""


def framed(part: Part) -> list[Shape]:
    """Return the part with its name above, cut marks, and dimensions below and to the left."""
    box = np.array([part.outline.min(0), part.outline.max(0)])
    lines = part.lines or (Line(part.outline, "CUT", width=0.1, closed=True),)
    shapes: list[Shape] = [*part.shapes, *lines, *([] if part.lines else _cut_marks(box))]
    for axis in (0, 1):
        spans = [span for span in part.spans if span[0] == axis]
        outer = (axis, float(box[0, axis]), float(box[1, axis]), said_mm(box[1, axis] - box[0, axis]))
        for place, (_, low, high, words) in enumerate([*spans, outer]):
            shapes += _dimension(axis, low, high, words, float(box[0, 1 - axis]), APART * (place + 1))
    shapes.append(Text(float(box[0, 0]), float(box[1, 1]) + CUT_TO + 1.5, part.name, LETTERS))
    return shapes


def table(part: Part, below: bool) -> list[Shape]:
    """Return the part's table, beside or below the shapes of :func:`framed`."""
    if not part.table:
        return []
    box = extent(framed(part))
    top = float(part.outline[:, 1].max())
    x, y = (
        (float(part.outline[:, 0].min()), float(box[0, 1]) - ROW)
        if below
        else (float(box[1, 0]) + APART, top - LETTERS)
    )
    heading, *rows = part.table
    shapes: list[Shape] = [Text(x, y, " ".join(filter(None, heading)), LETTERS)]
    widths = [max(len(row[k]) for row in rows) * WIDTH_PER_HEIGHT * LETTERS + COLUMN_GAP for k in range(len(rows[0]))]
    ends = x + np.cumsum(widths)
    for number, row in enumerate(rows, 1):
        places = zip(row, ends.tolist(), strict=True)
        shapes += [Text(end - COLUMN_GAP, y - ROW * number, word, LETTERS, "end") for word, end in places]
    return shapes


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


def _cut_marks(box: np.ndarray) -> list[Shape]:
    marks: list[Shape] = []
    for x, outwards in ((box[0, 0], -1), (box[1, 0], 1)):
        for y, upwards in ((box[0, 1], -1), (box[1, 1], 1)):
            for direction in (np.array([outwards, 0.0]), np.array([0.0, upwards])):
                ends = np.array([x, y]) + np.array([[CUT_FROM], [CUT_TO]]) * direction
                marks.append(Line(ends, "CUT", width=0.1))
    return marks


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
