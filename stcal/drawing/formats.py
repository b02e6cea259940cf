"""Sheets in mm as SVG, and as PDF through matplotlib."""

import io
import warnings
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


INCH_MM = 25.4
POINT_MM = INCH_MM / 72
PDF_DASH = (0, (20, 10))
"""Dash pattern, in widths of the line."""
ANCHORS = {"start": "left", "middle": "center", "end": "right"}


def pdf(sheets: Sequence[Sheet]) -> bytes:
    """Return the bytes of the file; equal sheets give equal bytes."""
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages

    stream = io.BytesIO()
    metadata = {"CreationDate": None, "Creator": None, "Producer": None, "Title": sheets[0].title}
    with warnings.catch_warnings(), matplotlib.rc_context({"pdf.fonttype": 42, "path.simplify": False}):
        warnings.filterwarnings("ignore", "Glyph")  # a face may be named in any script
        with PdfPages(stream, metadata=metadata) as pages:
            for sheet in sheets:
                pages.savefig(figure_of(sheet))
    return stream.getvalue()


def figure_of(sheet: Sheet):
    """Return the page as a figure of its size; a millimetre in data is a millimetre on paper."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(sheet.width / INCH_MM, sheet.height / INCH_MM), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0, sheet.width)
    axes.set_ylim(0, sheet.height)
    for placed in sheet.placed:
        for layer in LAYERS:
            for shape in (layer_shape for layer_shape in placed.shapes if layer_shape.layer == layer):
                _add(axes, shape, placed.clip)
    return figure


def _add(axes, shape: Shape, clip: np.ndarray | None) -> None:
    from matplotlib.patches import Circle, PathPatch, Rectangle
    from matplotlib.path import Path
    from matplotlib.transforms import Bbox, TransformedBbox

    colour = COLOURS[shape.ink]
    if isinstance(shape, Text):
        size = shape.height / CAPITAL_SHARE / POINT_MM
        options = {"ha": ANCHORS[shape.anchor], "va": "baseline", "rotation": 90 if shape.turned else 0}
        artist = axes.text(
            *(shape.x, shape.y, shape.words.replace("$", r"\$")),
            fontsize=size, color=colour, rotation_mode="anchor", clip_on=clip is not None, **options,
        )  # fmt: skip
    elif isinstance(shape, Disc):
        artist = axes.add_patch(Circle((shape.x, shape.y), shape.radius, facecolor=colour, linewidth=0))
    elif isinstance(shape, Area):
        paths = [Path(np.vstack([line, line[:1]]), closed=True) for line in shape.lines]
        artist = axes.add_patch(PathPatch(Path.make_compound_path(*paths), facecolor=colour, linewidth=0))
    else:
        points = np.vstack([shape.points, shape.points[:1]]) if shape.closed else shape.points
        options = {"linestyle": PDF_DASH} if shape.dashed else {}
        line = Path(points, closed=shape.closed)
        width = shape.width / POINT_MM
        artist = axes.add_patch(
            PathPatch(line, fill=False, edgecolor=colour, linewidth=width, capstyle="butt", **options)
        )
    if clip is not None:
        (x, y), (right, top) = clip.tolist()
        artist.set_clip_path(Rectangle((x, y), right - x, top - y, transform=axes.transData))
        if isinstance(shape, Text):
            artist.set_clip_box(TransformedBbox(Bbox(clip), axes.transData))
