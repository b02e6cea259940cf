"""Drawing of a target or a board from its file, as SVG or PDF in mm."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from stcal.boards.board_designs import BoardSet, FlatBoard
from stcal.boards.board_file import board_content
from stcal.boards.target_file import load_boards, load_target
from stcal.design import BoardDesign, TargetDesign
from stcal.drawing.net import net_part
from stcal.drawing.parts import LAYERS, Area, Disc, Part, Shape, Text, corners_of, parts_of, said_mm
from stcal.drawing.sheets import FURNITURE, MOST_MM, PAPERS, Sheet, one_sheet, paper_sheets
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.io.files import save

COLOURS = {"black": "#000000", "white": "#ffffff", "grey": "#808080"}
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
    for number, placed in enumerate(sheet.placed):
        if placed.clip is not None:
            lines.append(
                f'<clipPath id="clip{number}"><path d="{_path(corners_of(placed.clip), sheet.height)}"/></clipPath>'
            )
        clip = "" if placed.clip is None else f' clip-path="url(#clip{number})"'
        for layer in LAYERS:
            if shapes := [shape for shape in placed.shapes if shape.layer == layer]:
                lines += [f'<g class="{layer}"{clip}>', *(_element(shape, sheet.height) for shape in shapes), "</g>"]
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
    if isinstance(shape, Area):
        path = " ".join(_path(line, height) for line in shape.lines)
        return f'<path d="{path}" fill="{colour}" fill-rule="evenodd"/>'
    dash = f' stroke-dasharray="{DASH}"' if shape.dashed else ""
    path = _path(shape.points, height, shape.closed)
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{_number(shape.width)}"{dash}/>'


def _path(points: np.ndarray, height: float, closed: bool = True) -> str:
    places = " L".join(f"{_number(x)},{_number(height - y)}" for x, y in points.tolist())
    return f"M{places}{' Z' if closed else ''}"


def _number(value: float) -> str:
    """Return the text of a length to the nanometre, without trailing zeros."""
    return f"{value:.6f}".rstrip("0").rstrip(".")


POINT_MM = 25.4 / 72


def pdf(sheets: Sequence[Sheet]) -> bytes:
    """Return the bytes of the file; equal sheets give equal bytes."""
    from reportlab.pdfgen.canvas import Canvas

    stream = io.BytesIO()
    canvas = Canvas(stream, invariant=True)
    canvas.setTitle(sheets[0].title)
    for sheet in sheets:
        canvas.setPageSize((sheet.width / POINT_MM, sheet.height / POINT_MM))
        canvas.scale(1 / POINT_MM, 1 / POINT_MM)  # from here on lengths are in mm, upwards from the lower left corner
        for placed in sheet.placed:
            canvas.saveState()
            if placed.clip is not None:
                canvas.clipPath(_outline(canvas, [corners_of(placed.clip)]), stroke=0)
            for layer in LAYERS:
                for shape in (layer_shape for layer_shape in placed.shapes if layer_shape.layer == layer):
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
        draw = {"start": canvas.drawString, "middle": canvas.drawCentredString, "end": canvas.drawRightString}
        draw[shape.anchor](0, 0, shape.words)
        canvas.restoreState()
    elif isinstance(shape, Disc):
        arcs = 8  # leave the circle by less than 5 parts in a million of its radius
        angle = np.arange(2 * arcs + 1) * np.pi / arcs
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)[::2]
        along = 4 / 3 * np.tan(np.pi / (2 * arcs)) * np.stack([-unit[:, 1], unit[:, 0]], axis=1)
        ends, before, after = ([shape.x, shape.y] + shape.radius * at for at in (unit, unit - along, unit + along))
        path = canvas.beginPath()
        path.moveTo(*ends[0].tolist())
        for arc in zip(after[:-1], before[1:], ends[1:], strict=True):
            path.curveTo(*np.concatenate(arc).tolist())
        path.close()
        canvas.drawPath(path, stroke=0, fill=1)
    elif isinstance(shape, Area):
        canvas.drawPath(_outline(canvas, shape.lines), stroke=0, fill=1, fillMode=0)  # even-odd
    else:
        canvas.setStrokeColor(colour)
        canvas.setLineWidth(shape.width)
        canvas.setDash([20 * shape.width, 10 * shape.width] if shape.dashed else [])
        canvas.drawPath(_outline(canvas, [shape.points], shape.closed))


def _outline(canvas, lines: Sequence[np.ndarray], closed: bool = True):
    path = canvas.beginPath()
    for line in lines:
        path.moveTo(*line[0].tolist())
        for point in line[1:].tolist():
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
    parts: list[Part]
    sheets: list[Sheet]
    paper: str  # its name, or ``own``


Design = TargetDesign | BoardDesign | FlatBoard | BoardSet


@require_arguments
def draw(
    design: Design | str | Path,
    out: str | Path,
    paper: str = "",
    margin_mm: float = 10.0,
    net: bool = False,
) -> Drawn:
    """Draw a target or a board 1:1 to a file, whose suffix gives the form: ``.pdf`` or ``.svg``.

    Parameters
    ----------
    design : TargetDesign, board of any kind, or path
        The design, or its ``target.toml`` or board file.
    out : str or Path
        File of the drawing; an earlier one is replaced.
    paper : str
        ``A5`` … ``A0``, ``Letter``, ``Legal``, ``Tabloid``, or ``own`` for pages as large as their content; if empty,
        ``own`` for SVG, and for PDF A4, or the smallest that takes a net on one sheet.
    margin_mm : float
        Distance from the outermost circles to the edge of a plate without an outline, mm.
    net : bool
        Whether the plates of a target are unfolded into one net on one sheet, by their outlines and rough poses.

    Raises
    ------
    InputError
        The design cannot be read or drawn, the file has another suffix, or the paper does not suit the form.
    """
    path = Path(out)
    if margin_mm < 0:
        raise InputError("E-OPTION-RANGE", f"draw: margin_mm {margin_mm:g}: 0 or more needed")
    given, paper = paper, _paper(path, paper)
    name, loaded = (design, load_design(design)) if isinstance(design, str | Path) else (type(design).__name__, design)
    if net and not isinstance(loaded, TargetDesign):
        raise InputError("E-DRAW-DESIGN", f"--net: {name} is a board; nets are of targets")
    if net and isinstance(loaded, TargetDesign):
        parts = [net_part(loaded)]
        fitting = paper_for(parts)
        paper = paper if given or paper == OWN else fitting or OWN
        if paper != OWN and len(paper_sheets(parts, paper, "")) > 1:
            raise InputError(
                "E-DRAW-SHEETS",
                f"--net: {_size(parts[0])}, and a sheet of {paper} has room for {_room(paper)}; take --paper "
                f"{fitting or OWN}, or draw the plates one by one without --net",
            )
    else:
        parts = parts_of(loaded, margin_mm)
    title = loaded.name if isinstance(loaded, TargetDesign) else parts[0].name if len(parts) == 1 else "boards"
    if paper != OWN:
        sheets = paper_sheets(parts, paper, title)
    elif path.suffix.lower() == ".pdf":
        sheets = [one_sheet([part], f"{title}, {part.name}" if len(parts) > 1 else title) for part in parts]
    else:
        sheets = [one_sheet(parts, title)]
    if path.suffix.lower() == ".svg" and len(sheets) > 1:
        raise InputError(
            "E-DRAW-SHEETS", f"{path}: {len(sheets)} sheets, an SVG holds one; take .pdf, a larger --paper, or none"
        )
    largest = max(max(sheet.width, sheet.height) for sheet in sheets)
    if path.suffix.lower() == ".pdf" and largest > MOST_MM:
        raise InputError(
            "E-DRAW-SHEETS",
            f"{path}: page of {largest:.0f} mm, at most {MOST_MM:.0f} mm in a PDF; take --paper or .svg",
        )
    save(path, pdf(sheets) if path.suffix.lower() == ".pdf" else svg(sheets[0]))
    return Drawn(path, parts, sheets, paper)


def net_text(target: TargetDesign) -> str:
    """Return how large the net of a body is, and which paper takes it."""
    part = net_part(target)
    paper = paper_for([part])
    return f"net to fold, {_size(part)}: {f'one sheet of {paper}' if paper else 'larger than A0'}"


def _size(part: Part) -> str:
    return f"{' × '.join(said_mm(side) for side in np.ptp(part.outline, axis=0))} mm"


def _room(paper: str) -> str:
    """Return the room that a sheet has for parts and their dimensions."""
    room = [said_mm(side - margin) for side, margin in zip(PAPERS[paper], FURNITURE, strict=True)]
    return f"{' × '.join(room)} mm"


def load_design(path: str | Path) -> Design:
    """Read a target, or a board or boards of any kind."""
    if not Path(path).exists():
        raise InputError(
            "E-DRAW-DESIGN", f"{path}: no such file; give a target.toml or a board file (`stcal-sfm init` writes both)"
        )
    content = board_content(path)
    return load_target(path) if content is not None and "face" in content else load_boards(path)


def paper_for(parts: Sequence[Part]) -> str | None:
    """Return the smallest paper from A4 to A0 that takes each part on one sheet, or None."""
    for paper in ("A4", "A3", "A2", "A1", "A0"):
        try:
            if len(paper_sheets(parts, paper, "")) == len(parts):
                return paper
        except InputError:  # more sheets than are drawn
            continue
    return None


def _paper(path: Path, paper: str) -> str:
    """Return the listed name of a paper, or the default for the suffix; refuse combinations that do not work."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            "E-OUTPUT-SUFFIX", f"{path}: suffix {path.suffix or 'missing'}; one of {', '.join(SUFFIXES)} needed"
        )
    names = {name.lower(): name for name in (*PAPERS, OWN)}
    if paper and paper.lower() not in names:
        raise InputError("E-OPTION-VALUE", f"--paper {paper}: unknown; one of {', '.join(names.values())} needed")
    return names.get(paper.lower(), "A4" if suffix == ".pdf" else OWN)


def drawn_text(drawn: Drawn) -> str:
    """Return the parts and sheets of a drawing, and how to use them, as text."""
    lines = [f"{part.name}: {_size(part)}" for part in drawn.parts]
    sheets = len(drawn.sheets)
    kind = "of its own size" if drawn.paper == OWN else drawn.paper
    lines.append(f"{drawn.path}: {sheets} sheet{'s' if sheets > 1 else ''} {kind}")
    lines.append("print at 100 %, not fitted to the page, and measure the scale bars")
    if bare := sum(sheet.bare for sheet in drawn.sheets):
        which = "the sheet is" if sheets == 1 else f"{bare} of {sheets} sheets are"
        lines.append(f"{which} without dimensions and table, which would take more sheets")
    if drawn.paper != OWN and sheets > len(drawn.parts):
        whole = paper_for(drawn.parts)
        larger = f"print with --paper {whole}" if whole else "have it printed on one sheet"
        through = ", the worse as one runs through a pattern" if any(sheet.cuts for sheet in drawn.sheets) else ""
        lines.append(
            f"a sheet of {drawn.paper} has room for {_room(drawn.paper)}, either way round, dimensions included; "
            f"parts that are glued of several sheets are off at the seams{through}: state it in sigma_mm, or "
            f"{larger}"
        )
    return "\n".join(lines)
