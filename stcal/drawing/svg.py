"""SVG of a sheet in mm."""

from html import escape

import numpy as np

from stcal.drawing.shapes import LAYERS, Area, Disc, Shape, Text
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
