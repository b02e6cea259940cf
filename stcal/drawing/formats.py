"""Sheets in mm as SVG and as PDF."""

import io
from collections.abc import Sequence
from html import escape

import numpy as np

from stcal.drawing.parts import LAYERS, Area, Disc, Shape, Text
from stcal.drawing.sheets import Sheet

COLOURS = {"black": "#000000", "white": "#ffffff", "grey": "#808080"}
CAPITAL_SHARE = 0.72
"""Height of a capital as a share of the font's size."""
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
                f'<clipPath id="clip{number}"><path d="{_path(_corners(placed.clip), sheet.height)}"/></clipPath>'
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


def _corners(box: np.ndarray) -> np.ndarray:
    (left, below), (right, above) = box.tolist()
    return np.array([[left, below], [right, below], [right, above], [left, above]])


def _path(points: np.ndarray, height: float, closed: bool = True) -> str:
    places = " L".join(f"{_number(x)},{_number(height - y)}" for x, y in points.tolist())
    return f"M{places}{' Z' if closed else ''}"


def _number(value: float) -> str:
    """Return the text of a length to the nanometre, without trailing zeros."""
    return f"{value:.6f}".rstrip("0").rstrip(".")


POINT_MM = 25.4 / 72
FONT = "Helvetica"
"""One of the fonts that every reader of PDF has. Greek letters and signs that it lacks come from Symbol."""
DASH_WIDTHS = (20, 10)
"""Lengths of a dash and of the gap after it in PDF, in widths of the line."""


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
                canvas.clipPath(_outline(canvas, [_corners(placed.clip)]), stroke=0)
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
        canvas.setFont(FONT, shape.height / CAPITAL_SHARE)
        draw = {"start": canvas.drawString, "middle": canvas.drawCentredString, "end": canvas.drawRightString}
        draw[shape.anchor](0, 0, shape.words)
        canvas.restoreState()
    elif isinstance(shape, Disc):
        canvas.drawPath(_circle(canvas, shape), stroke=0, fill=1)
    elif isinstance(shape, Area):
        canvas.drawPath(_outline(canvas, shape.lines), stroke=0, fill=1, fillMode=0)  # even-odd
    else:
        canvas.setStrokeColor(colour)
        canvas.setLineWidth(shape.width)
        canvas.setDash([shape.width * each for each in DASH_WIDTHS] if shape.dashed else [])
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


ARCS = 8
"""Number of Bézier arcs of a circle: they leave it by less than 5 parts in a million of its radius."""


def _circle(canvas, disc: Disc):
    angle = np.arange(2 * ARCS + 1) * np.pi / ARCS
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)[::2]
    along = 4 / 3 * np.tan(np.pi / (2 * ARCS)) * np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    ends, before, after = ([disc.x, disc.y] + disc.radius * each for each in (unit, unit - along, unit + along))
    path = canvas.beginPath()
    path.moveTo(*ends[0].tolist())
    for arc in zip(after[:-1], before[1:], ends[1:], strict=True):
        path.curveTo(*np.concatenate(arc).tolist())
    path.close()
    return path
