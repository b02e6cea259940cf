"""PDF of sheets as pages, through matplotlib, which the figures of reports need anyway.

reportlab and fpdf2 would be a further dependency; cairo is not available as a wheel. matplotlib's circles consist of
eight Bézier curves, which deviate by at most 4 · 10⁻⁶ of the radius.
"""

import io
import warnings
from collections.abc import Sequence

import numpy as np

from stcal.drawing.shapes import LAYERS, Area, Disc, Shape, Text
from stcal.drawing.sheets import Sheet
from stcal.drawing.svg import CAPITAL_SHARE, COLOURS

INCH_MM = 25.4
POINT_MM = INCH_MM / 72
DASH = (0, (20, 10))
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
        options = {"linestyle": DASH} if shape.dashed else {}
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
