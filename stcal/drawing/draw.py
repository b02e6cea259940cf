"""Drawing of a target or a board from its file, on pages of its own size or on sheets of paper, as SVG or PDF in mm."""

import io
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from itertools import compress, product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from stcal.boards.board_designs import BoardSet, FlatBoard
from stcal.boards.board_file import board_content
from stcal.boards.target_file import load_boards, load_target
from stcal.design import BoardDesign, TargetDesign
from stcal.drawing.parts import (
    LAYERS,
    LETTERS,
    Disc,
    Piece,
    Shape,
    Text,
    box_of,
    corners_of,
    extent,
    line,
    moved,
    net_part,
    parts_of,
    said_mm,
)
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import save

APART = 6.0  # distance from a part to its first dimension, and between dimensions, mm
ARROW = 1.5
CUT_FROM, CUT_TO = 1.5, 5.0  # distances from the outline at which cut marks begin and end, mm
BAR, SHORT_BAR = 100.0, 50.0  # lengths of scale bars, mm


def framed(part: Piece, bare: bool = False) -> list[Shape]:
    """Return the part with its outline and, unless ``bare``, its name above, cut marks, and dimensions."""
    box = box_of(part.outline)
    shapes: list[Shape] = [*part.shapes, *(part.lines or [line(part.outline, "CUT", width=0.1, closed=True)])]
    if bare:
        return shapes
    for right, above, axis in product((0, 1), (0, 1), (0, 1)) if not part.lines else ():
        outwards = np.where(np.arange(2) == axis, [2 * right - 1, 2 * above - 1], 0)
        ends = np.array([box[right, 0], box[above, 1]]) + np.array([[CUT_FROM], [CUT_TO]]) * outwards
        shapes.append(line(ends, "CUT", width=0.1))
    for axis in (0, 1):
        spans = [span for span in part.spans if span[0] == axis]
        outer = (axis, float(box[0, axis]), float(box[1, axis]), said_mm(box[1, axis] - box[0, axis]))
        for place, (_, low, high, words) in enumerate([*spans, outer]):
            shapes += _dimension(axis, low, high, words, float(box[0, 1 - axis]), APART * (place + 1))
    shapes.append(Text(float(box[0, 0]), float(box[1, 1]) + CUT_TO + 1.5, part.name, LETTERS))
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
        shapes.append(line(ends + 1.0, "DIMENSIONS", width=0.2))
        for place in range(0, round(length) + 1, 10):
            tick = np.ones((2, 2))
            tick[:, axis] += place
            tick[1, 1 - axis] += 3.0 if place % 50 == 0 else 1.8
            shapes.append(line(tick, "DIMENSIONS", width=0.2))
        middle = 1 + length / 2 + 8
        at = (middle, 3.5) if axis == 0 else (3.0 + LETTERS, middle)
        shapes.append(Text(*at, f"{said_mm(length)} mm", LETTERS, "middle", turned=axis == 1, layer="DIMENSIONS"))
    return shapes


def _dimension(axis: int, low: float, high: float, words: str, edge: float, away: float) -> list[Shape]:
    """Return the dimension of a length along X below ``edge``, or along Y to the left of it."""
    level = edge - away
    lines = [[(low, level), (high, level)]]
    for end, sign in ((low, 1), (high, -1)):
        lines.append([(end, edge - 1.0), (end, level - 1.0)])
        lines.append([(end + sign * ARROW, level + 0.5), (end, level), (end + sign * ARROW, level - 0.5)])
    shapes: list[Shape] = [line(np.array(xy)[:, :: 1 - 2 * axis], "DIMENSIONS", width=0.1) for xy in lines]
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
class Sheet:
    """A page with its origin at the bottom left."""

    title: str
    width: float
    height: float
    shapes: tuple[Shape, ...]  # of the parts
    furniture: tuple[Shape, ...]
    clip: np.ndarray | None = None  # box (2, 2) of what is drawn of the parts; all of them if None
    bare: bool = False  # whether the part is without dimensions, with which it would take more sheets


def one_sheet(parts: Sequence[Piece], title: str) -> Sheet:
    """Return one sheet with all parts, as large as needed."""
    drawn = [framed(part) for part in parts]
    boxes = [extent(shapes) for shapes in drawn]
    widest = max(np.sqrt(sum(np.prod(box[1] - box[0] + BETWEEN) for box in boxes)), *(np.ptp(b, 0)[0] for b in boxes))
    placed: list[Shape] = []
    x, top, lowest = 0.0, 0.0, 0.0
    for shapes, box in zip(drawn, boxes, strict=True):
        width, height = (box[1] - box[0]).tolist()
        if x > 0 and x + width > widest:
            x, top = 0.0, lowest - BETWEEN
        placed += [moved(shape, [x - box[0, 0], top - box[1, 1]]) for shape in shapes]
        x, lowest = x + width + BETWEEN, min(lowest, top - height)
    box = extent(placed)
    width, height = (np.ptp(box, 0) + FURNITURE).tolist()
    return _sheet(title, width, height, placed, [EDGE + SIDE - box[0, 0], EDGE + FOOT - box[0, 1]])


def paper_sheets(parts: Sequence[Piece], paper: str, title: str) -> list[Sheet]:
    """Return the sheets of a paper for all parts, as few as possible for each part without a seam through its pattern.
    A part that is larger than a sheet only by its dimensions is drawn without them."""
    split = [min(_ways(part, paper), key=lambda way: (way.cuts, way.count, way.bare)) for part in parts]
    total = sum(way.count for way in split)
    if total > MOST_SHEETS:
        fault = f"--paper {paper}: {total} sheets, at most {MOST_SHEETS}"
        raise InputError("E-DRAW-SHEETS", f"{fault}; take a larger paper, or none")
    titles = [f"{title}, {part.name}" if len(parts) > 1 else title for part in parts]
    return [sheet for way, own in zip(split, titles, strict=True) for sheet in _tiles(way, own)]


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


def _ways(part: Piece, paper: str) -> list[_Way]:
    """Return the layouts of a part: portrait and landscape, with dimensions, or bare on one sheet."""
    ways, (width, height) = [], PAPERS[paper]
    boxes = np.array([shape.box() for shape in part.shapes if shape.layer == "PATTERN"])
    for bare, size in product((False, True), ((width, height), (height, width))):
        shapes = framed(part, bare)
        box, room = extent(shapes), np.array(size) - FURNITURE
        across, down = (seams_between(box[:, k].tolist(), float(room[k]), boxes[:, :, k]) for k in (0, 1))
        low, high = np.moveaxis(boxes, 1, 0)
        cuts = any(((low[:, k] < at) & (high[:, k] > at)).any() for k in (0, 1) for at in (across, down)[k])
        way = _Way(shapes, box, size, (across, down), cuts, bare)
        if not bare or (way.count == 1 and not part.lines):  # the pieces of a net need their names
            ways.append(way)
    return ways


def seams_between(ends: Sequence[float], room: float, taken: np.ndarray) -> list[float]:
    """Return the places that split a length so that no piece, with half the overlap at either end, exceeds ``room``.
    Seams avoid the intervals ``taken`` (n, 2) if they can."""
    seams, (start, high) = [], ends
    while high - start > room:
        place = last = start + room - OVERLAP / 2
        while len(hit := taken[(taken[:, 0] < place + CLEAR) & (taken[:, 1] > place - CLEAR)]):
            place = min(float(hit[:, 0].min()) - CLEAR, place - 1e-6)
        seams.append(place if place > start + OVERLAP else last)
        start = seams[-1] - OVERLAP / 2
    return seams


def _tiles(way: _Way, title: str) -> list[Sheet]:
    if way.count == 1:
        shift = [EDGE + SIDE - way.box[0, 0], way.size[1] - EDGE - way.box[1, 1]]
        return [replace(_sheet(title, *way.size, way.shapes, shift), bare=way.bare)]
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
            place = f"sheet {len(sheets) + 1} of {way.count}: row {row}, column {column}"
            sheets.append(_sheet(f"{title}; {place}", *way.size, compress(shapes, inside), shift, clip + shift))
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
            marks += [line(ends, "DIMENSIONS", "white", 0.6), line(ends, "DIMENSIONS", width=0.1)]
    return marks


def _sheet(title: str, width: float, height: float, shapes: Iterable[Shape], shift: ArrayLike, clip=None) -> Sheet:
    bars = [moved(shape, EDGE) for shape in scale_bars(width - 2 * EDGE, height - 2 * EDGE)]
    instruction = "1:1: print at 100 %, not fitted to the page, and measure the bars"
    if clip is not None:
        instruction += "; cut one of two sheets from cross to cross and lay it on the other's crosses"
    words = [Text(EDGE + SIDE, EDGE + 10.0, title, LETTERS), Text(EDGE + SIDE, EDGE + 7.0, instruction, 1.6)]
    return Sheet(title, width, height, tuple(moved(shape, shift) for shape in shapes), (*bars, *words), clip)


COLOURS = {"black": "#000000", "white": "#ffffff", "grey": "#808080"}
_number = partial(said_mm, digits=6)  # in files
CAPITAL_SHARE = 0.72  # height of a capital as a share of the font's size
DASH = "3 1.5"


def svg(sheet: Sheet) -> str:
    """Return the text of the file, all lengths in mm, with a group for each layer in use, the bottom layer first."""
    width, height = _number(sheet.width), _number(sheet.height)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}">',
        f"<title>{escape(sheet.title)}</title>",
    ]
    clip = ""
    if sheet.clip is not None:
        clip = ' clip-path="url(#clip0)"'
        lines.append(f'<clipPath id="clip0"><path d="{_path([corners_of(sheet.clip)], sheet.height)}"/></clipPath>')
    for every, attribute in ((sheet.shapes, clip), (sheet.furniture, "")):
        for layer in LAYERS:
            if shapes := [shape for shape in every if shape.layer == layer]:
                elements = (_element(shape, sheet.height) for shape in shapes)
                lines += [f'<g class="{layer}"{attribute}>', *elements, "</g>"]
    return "\n".join([*lines, "</svg>", ""])


def _element(shape: Shape, height: float) -> str:
    colour = COLOURS[shape.ink]
    if isinstance(shape, Disc):
        name = f' data-label="{escape(shape.name)}"' if shape.name else ""
        place = f'cx="{_number(shape.x)}" cy="{_number(height - shape.y)}" r="{_number(shape.radius)}"'
        return f'<circle {place} fill="{colour}"{name}/>'
    if isinstance(shape, Text):
        x, y = _number(shape.x), _number(height - shape.y)
        turn = f' transform="rotate(-90 {x} {y})"' if shape.turned else ""
        font = f'font-family="sans-serif" font-size="{_number(shape.height / CAPITAL_SHARE)}"'
        attributes = f'{font} text-anchor="{shape.anchor}" fill="{colour}"{turn}'
        return f'<text x="{x}" y="{y}" {attributes}>{escape(shape.words)}</text>'
    path = _path(shape.lines, height, shape.closed)
    if not shape.width:
        return f'<path d="{path}" fill="{colour}" fill-rule="evenodd"/>'
    dash = f' stroke-dasharray="{DASH}"' if shape.dashed else ""
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{_number(shape.width)}"{dash}/>'


def _path(lines: Sequence[np.ndarray], height: float, closed: bool = True) -> str:
    places = (" L".join(f"{_number(x)},{_number(height - y)}" for x, y in line.tolist()) for line in lines)
    return " ".join(f"M{place}{' Z' if closed else ''}" for place in places)


POINT_MM = 25.4 / 72
ARC_DEG = 45
"""Length of the Bézier curves of a circle, which leave it by less than 5 parts in a million of its radius."""


def pdf(sheets: Sequence[Sheet]) -> bytes:
    """Return the bytes of the file; equal sheets give equal bytes."""
    from reportlab.pdfgen.canvas import Canvas

    stream = io.BytesIO()
    canvas = Canvas(stream, invariant=True)
    canvas.setTitle(sheets[0].title)
    for sheet in sheets:
        canvas.setPageSize((sheet.width / POINT_MM, sheet.height / POINT_MM))
        canvas.scale(1 / POINT_MM, 1 / POINT_MM)  # from here on lengths are in mm, upwards from the lower left corner
        for shapes, clip in ((sheet.shapes, sheet.clip), (sheet.furniture, None)):
            canvas.saveState()
            if clip is not None:
                canvas.clipPath(_outline(canvas, [corners_of(clip)]), stroke=0)
            for shape in sorted(shapes, key=lambda shape: LAYERS.index(shape.layer)):
                _add(canvas, shape)
            canvas.restoreState()
        canvas.showPage()
    canvas.save()
    return stream.getvalue()


def _add(canvas, shape: Shape) -> None:
    colour = COLOURS[shape.ink]
    canvas.setFillColor(colour)
    if isinstance(shape, Text):
        canvas.saveState()
        canvas.translate(shape.x, shape.y)
        canvas.rotate(90 if shape.turned else 0)
        canvas.setFont("Helvetica", shape.height / CAPITAL_SHARE)  # which every reader has; its Greek is Symbol's
        draw = canvas.drawCentredString if shape.anchor == "middle" else canvas.drawString
        draw(0, 0, shape.words)
        canvas.restoreState()
    elif isinstance(shape, Disc):
        box = shape.box().ravel().tolist()
        path = canvas.beginPath()
        path.arc(*box, startAng=0, extent=ARC_DEG)
        for start in range(ARC_DEG, 360, ARC_DEG):
            path.arcTo(*box, startAng=start, extent=ARC_DEG)
        path.close()
        canvas.drawPath(path, stroke=0, fill=1)
    elif not shape.width:
        canvas.drawPath(_outline(canvas, shape.lines), stroke=0, fill=1, fillMode=0)  # even-odd
    else:
        canvas.setStrokeColor(colour)
        canvas.setLineWidth(shape.width)
        canvas.setDash([20 * shape.width, 10 * shape.width] if shape.dashed else [])
        canvas.drawPath(_outline(canvas, shape.lines, shape.closed))


def _outline(canvas, lines: Sequence[np.ndarray], closed: bool = True):
    path = canvas.beginPath()
    for start, *points in (points.tolist() for points in lines):
        path.moveTo(*start)
        for point in points:
            path.lineTo(*point)
        if closed:
            path.close()
    return path


SUFFIXES = (".pdf", ".svg")
OWN = "own"  # value of paper for pages as large as their content


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A drawing that was written."""

    path: Path
    parts: list[Piece]
    sheets: list[Sheet]
    paper: str  # its name, or ``own``


Design = TargetDesign | BoardDesign | FlatBoard | BoardSet


@require_arguments
def draw(
    design: Design | str | Path, out: str | Path, paper: str = "", margin_mm: float = 10.0, net: bool = False
) -> Drawn:
    """Draw a target or a board 1:1 to a file, whose suffix gives the form: ``.pdf`` or ``.svg``.

    Parameters
    ----------
    design : The design, or its ``target.toml`` or board file.
    out : File of the drawing; an earlier one is replaced.
    paper : ``A5`` … ``A0``, ``Letter``, ``Legal``, ``Tabloid``, or ``own`` for pages as large as their content; if
        empty, ``own`` for SVG, and for PDF A4, or the smallest that takes a net on one sheet.
    margin_mm : Distance from the outermost circles to the edge of a plate without an outline, mm.
    net : Whether the plates of a target are unfolded into one net on one sheet, by their outlines and rough poses.

    Raises
    ------
    InputError
        The design cannot be read or drawn, the file has another suffix, or the paper does not suit the form.
    """
    path, is_pdf = Path(out), Path(out).suffix.lower() == ".pdf"
    if margin_mm < 0:
        raise InputError("E-OPTION-RANGE", f"draw: margin_mm {margin_mm:g}: 0 or more needed")
    given, paper = paper, _paper(path, paper)
    name, loaded = (design, load_design(design)) if isinstance(design, str | Path) else (type(design).__name__, design)
    if not net:
        parts = parts_of(loaded, margin_mm)
    elif not isinstance(loaded, TargetDesign):
        raise InputError("E-DRAW-DESIGN", f"--net: {name} is a board; nets are of targets")
    else:
        parts = [net_part(loaded)]
        fitting = paper_for(parts) or OWN
        paper = paper if given or paper == OWN else fitting
        if paper != OWN and len(paper_sheets(parts, paper, "")) > 1:
            size, room = (_size(sides) for sides in (np.ptp(parts[0].outline, axis=0), PAPERS[paper] - FURNITURE))
            fault = f"--net: {size}, and a sheet of {paper} has room for {room}"
            remedy = f"take --paper {fitting}, or draw the plates one by one without --net"
            raise InputError("E-DRAW-SHEETS", f"{fault}; {remedy}")
    title = loaded.name if isinstance(loaded, TargetDesign) else parts[0].name if len(parts) == 1 else "boards"
    if paper != OWN:
        sheets = paper_sheets(parts, paper, title)
    elif is_pdf:
        sheets = [one_sheet([part], f"{title}, {part.name}" if len(parts) > 1 else title) for part in parts]
    else:
        sheets = [one_sheet(parts, title)]
    if not is_pdf and len(sheets) > 1:
        fault = f"{path}: {len(sheets)} sheets, an SVG holds one"
        raise InputError("E-DRAW-SHEETS", f"{fault}; take .pdf, a larger --paper, or none")
    largest = max(max(sheet.width, sheet.height) for sheet in sheets)
    if is_pdf and largest > MOST_MM:
        fault = f"{path}: page of {largest:.0f} mm, at most {MOST_MM:.0f} mm in a PDF"
        raise InputError("E-DRAW-SHEETS", f"{fault}; take --paper or .svg")
    save(path, pdf(sheets) if is_pdf else svg(sheets[0]))
    return Drawn(path, parts, sheets, paper)


def net_text(target: TargetDesign) -> str:
    """Return how large the net of a body is, and which paper takes it."""
    part = net_part(target)
    paper = paper_for([part])
    sheet = f"one sheet of {paper}" if paper else "larger than A0"
    return f"net to fold, {_size(np.ptp(part.outline, axis=0))}: {sheet}"


def _size(sides: np.ndarray) -> str:
    return f"{' × '.join(map(said_mm, sides))} mm"


def load_design(path: str | Path) -> Design:
    """Read a target, or a board or boards of any kind."""
    if not Path(path).exists():
        fault = f"{path}: no such file"
        raise InputError("E-DRAW-DESIGN", f"{fault}; give a target.toml or a board file (`stcal-sfm init` writes both)")
    content = board_content(path)
    return load_target(path) if content is not None and "face" in content else load_boards(path)


def paper_for(parts: Sequence[Piece]) -> str | None:
    """Return the smallest paper from A4 to A0 that takes each part on one sheet, or None."""
    for paper in ("A4", "A3", "A2", "A1", "A0"):
        with suppress(InputError):  # more sheets than are drawn
            if len(paper_sheets(parts, paper, "")) == len(parts):
                return paper
    return None


def _paper(path: Path, paper: str) -> str:
    """Return the listed name of a paper, or the default for the suffix; refuse combinations that do not work."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        fault = f"{path}: suffix {path.suffix or 'missing'}"
        raise InputError("E-OUTPUT-SUFFIX", f"{fault}; one of {', '.join(SUFFIXES)} needed")
    names = {name.lower(): name for name in (*PAPERS, OWN)}
    if paper and paper.lower() not in names:
        raise InputError("E-OPTION-VALUE", f"--paper {paper}: unknown; one of {', '.join(names.values())} needed")
    return names.get(paper.lower(), "A4" if suffix == ".pdf" else OWN)


def drawn_text(drawn: Drawn) -> str:
    """Return the parts and sheets of a drawing, and how to use them, as text."""
    lines = [f"{part.name}: {_size(np.ptp(part.outline, axis=0))}" for part in drawn.parts]
    sheets = len(drawn.sheets)
    kind = "of its own size" if drawn.paper == OWN else drawn.paper
    lines.append(f"{drawn.path}: {sheets} sheet{'s' if sheets > 1 else ''} {kind}")
    lines.append("print at 100 %, not fitted to the page, and measure the scale bars")
    if bare := sum(sheet.bare for sheet in drawn.sheets):
        lines.append(f"sheets without dimensions, which would take more sheets: {bare} of {sheets}")
    if drawn.paper != OWN and sheets > len(drawn.parts):
        whole = paper_for(drawn.parts)
        larger = f"print with --paper {whole}" if whole else "have it printed on one sheet"
        lines.append(f"parts glued of several sheets are off at the seams: state it in sigma_mm, or {larger}")
    return "\n".join(lines)
