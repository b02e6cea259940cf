"""Figures with a plain look, as SVG data URIs for a page and as files; equal figures give equal bytes.

matplotlib is imported when the first figure is drawn.
"""

import base64
import io
import warnings
from pathlib import Path
from typing import Literal

import numpy as np

from stcal.io import files

# The palette of Okabe & Ito (2008), darkened where it would be faint on white; then shades for many groups.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b8559a", "#3d9bd1", "#c98a00", "#5b3f8c", "#555555", "#8c2d04", "#00606b")
INK, FAINT = "#333333", "#d5d9de"
AXIS_COLOURS = ("#c1272d", "#2e8b3d", "#2457a8")
SMALL = 7.5


def round_below(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten up to ``value``; 1 if that is not a positive number."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def locator(integer: bool = False):
    """Return a locator of few ticks at round values."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(5, steps=[1, 2, 5, 10], integer=integer)


def new_figure(width: float, height: float):
    """Return an empty figure; width and height in inches."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="none")
    FigureCanvasSVG(figure)
    return figure


def calm(axes, x: str = "", y: str = "", grid: Literal["", "x", "y", "both"] = "") -> None:
    """Remove the frame of axes, and make ticks and remaining lines inconspicuous; set labels and a faint grid."""
    axes.tick_params(labelsize=SMALL, length=2, color="#9aa0a8")
    axes.set_facecolor("none")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#9aa0a8")
    for text, label in ((x, axes.set_xlabel), (y, axes.set_ylabel)):
        if text:
            label(text, fontsize=SMALL + 1, color=INK)
    if grid:
        axes.grid(axis=grid, color=FAINT, lw=0.6)
        axes.set_axisbelow(True)


def plane(axes, x: str, y: str, margin: float) -> None:
    """Prepare the axes of a map: equal scales, a faint grid, and a ``margin`` as a share of the extent."""
    axes.set_aspect("equal", "datalim")
    axes.margins(margin)
    axes.xaxis.set_major_locator(locator())
    axes.yaxis.set_major_locator(locator())
    calm(axes, x, y, "both")


def uri(figure) -> str:
    """Return the figure as an SVG data URI; equal figures give equal bytes."""
    import matplotlib

    stream = io.BytesIO()
    with warnings.catch_warnings(), matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "stcal"}):
        warnings.filterwarnings("ignore", "Glyph")  # a face may be named in any script
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode()


def save(figure, path: Path) -> None:
    """Save a figure as PNG or SVG, by the file's suffix, and make its folder; all of it, or nothing.

    In SVG, text stays text: files are small, and changes of them are readable.
    """
    import matplotlib

    stream, kind = io.BytesIO(), path.suffix[1:]
    with matplotlib.rc_context({"svg.hashsalt": "stcal", "svg.fonttype": "none"}):
        figure.savefig(stream, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)
    files.save(path, stream.getvalue())
