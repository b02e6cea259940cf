"""Figures for pages, as SVG data URIs or files: equal figures give equal bytes.

Plain plots are written directly. matplotlib takes half a second to load and a tenth of a second for each figure, so
only figures that need it load it.
"""

import base64
import io
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import product
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


AXIS, PANE, PANE_EDGE = "#9aa0a8", "#f4f6f8", "#e1e5e9"
FONTS = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
RED_BLUE = "#053061 #2166ac #4393c3 #92c5de #d1e5f0 #f7f7f7 #fddbc7 #f4a582 #d6604d #b2182b #67001f"
"""The diverging scale RdBu of ColorBrewer (Harrower & Brewer 2003), from blue to red."""
UNWRITABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
"""Characters that no XML file may contain."""
MARGIN_PT = 34.0
"""Space around a view in space for ticks and names of its axes."""


class Drawing:
    """A drawing of a ``width`` and a ``height`` in inches; coordinates are in pt from the upper left corner."""

    def __init__(self, width: float, height: float):
        self.width, self.height = 72 * width, 72 * height
        self._parts: list[str] = []

    def lines(
        self,
        lines: Iterable[np.ndarray],
        colour: str = "none",
        width: float = 1.0,
        fill: str = "",
        opacity: float = 1.0,
    ) -> None:
        """Draws lines, (k, 2) each; closed and filled areas if ``fill`` is given."""
        end, area = ("z", f'fill="{fill}" fill-opacity="{opacity:g}"') if fill else ("", 'fill="none"')
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line.tolist()) + end for line in lines)
        if path:
            self._parts.append(f'<path d="{path}" {area} stroke="{colour}" stroke-width="{width:g}"/>')

    def dots(self, xy: np.ndarray, diameter: float, colour: str) -> None:
        """Draws round dots at places (n, 2)."""
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in xy.tolist())
        self._parts.append(f'<path d="{path}" stroke="{colour}" stroke-width="{diameter:g}" stroke-linecap="round"/>')

    def discs(self, xy: np.ndarray, radius: float, fills: Sequence[str], edge: str) -> None:
        """Draws discs at places (n, 2) in colours of their own."""
        discs = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}"/>'
            for (x, y), fill in zip(xy.tolist(), fills, strict=True)
        )
        self._parts.append(f'<g stroke="{edge}" stroke-width="0.5">{discs}</g>')

    def words(
        self,
        at: Sequence[float] | np.ndarray,
        text: str,
        size: float = SMALL,
        anchor: str = "middle",
        colour: str = INK,
        turned_deg: float = 0.0,
        weight: str = "normal",
    ) -> None:
        """Writes words in the middle of the height of a line at a place (2,)."""
        x, y = float(at[0]), float(at[1])
        turn = f' transform="rotate({turned_deg:.1f} {x:.1f} {y:.1f})"' if turned_deg else ""
        written = escape(UNWRITABLE.sub("\ufffd", text.encode("utf-8", "backslashreplace").decode()))
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" dy="0.35em" font-size="{size:g}" font-weight="{weight}" fill="{colour}" '
            f'text-anchor="{anchor}"{turn}>{written}</text>'
        )

    def scale(self, box: tuple[float, float, float, float], end: float, title: str) -> None:
        """Draws the scale of :func:`red_blue` from −end to end into a box (left, top, right, bottom)."""
        left, top, right, bottom = box
        stops = "".join(f'<stop offset="{i / 10:g}" stop-color="{c}"/>' for i, c in enumerate(RED_BLUE.split()[::-1]))
        self._parts.append(
            f'<linearGradient id="scale" x1="0" y1="0" x2="0" y2="1">{stops}</linearGradient><rect x="{left:.1f}" '
            f'y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" fill="url(#scale)"/>'
        )
        axes = Axes(box, (0, 1), (-end, end))
        for value, text in zip(*ticks(-end, end), strict=True):
            y = axes.at(1, value)[0, 1]
            self.lines([np.array([[right, y], [right + 2, y]])], AXIS, 0.8)
            self.words((right + 4, y), text, SMALL - 1, "start")
        self.words(((left + right) / 2, top - 8), title)

    def uri(self) -> str:
        """Returns the drawing as a data URI."""
        svg = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width:g}pt" height="{self.height:g}pt" '
            f'viewBox="0 0 {self.width:g} {self.height:g}" font-family="{FONTS}">{"".join(self._parts)}</svg>'
        )
        return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


@dataclass(frozen=True, slots=True)
class Axes:
    """Plane axes in a ``box`` of a drawing (left, top, right, bottom), with limits of ``x`` (at the left and right end)
    and ``y`` (at the bottom and top end)."""

    box: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x, y) -> np.ndarray:
        """Returns the places (n, 2) in the drawing of coordinates (n,) each, or of one place."""
        left, top, right, bottom = self.box
        across = left + (np.asarray(x, float) - self.x[0]) / (self.x[1] - self.x[0]) * (right - left)
        down = bottom + (np.asarray(y, float) - self.y[0]) / (self.y[1] - self.y[0]) * (top - bottom)
        return np.stack(np.broadcast_arrays(across, down), axis=-1).reshape(-1, 2)

    def draw(
        self,
        drawing: Drawing,
        x_ticks: tuple[Sequence[float], Sequence[str]],
        y_ticks: tuple[Sequence[float], Sequence[str]],
        x: str,
        y: str,
        grid: bool = False,
        size: float = SMALL + 1,
    ) -> None:
        """Draws left and lower line with ticks (values and words) and the names of the axes, and lines of a ``grid``
        across."""
        left, top, right, bottom = self.box
        rows, columns = self.at(self.x[0], y_ticks[0]), self.at(x_ticks[0], self.y[0])
        if grid:
            drawing.lines([np.array([[left, row], [right, row]]) for row in rows[:, 1]], FAINT, 0.6)
        marks = [np.array([[left, row], [left - 2, row]]) for row in rows[:, 1]]
        marks += [np.array([[column, bottom], [column, bottom + 2]]) for column in columns[:, 0]]
        drawing.lines([np.array([[left, top], [left, bottom], [right, bottom]]), *marks], AXIS, 0.8)
        for (_, row), text in zip(rows, y_ticks[1], strict=True):
            drawing.words((left - 4.5, row), text, anchor="end")
        for (column, _), text in zip(columns, x_ticks[1], strict=True):
            drawing.words((column, bottom + 9), text)
        widest = max(map(len, y_ticks[1]), default=0)
        drawing.words(((left + right) / 2, bottom + 21), x, size)
        drawing.words((left - 13 - 0.55 * SMALL * widest, (top + bottom) / 2), y, size, turned_deg=-90)


def ticks(low: float, high: float, most: int = 5) -> tuple[list[float], list[str]]:
    """Returns round values within limits, at most one more than ``most``, and their words."""
    apart = (high - low) / most
    if not np.isfinite(apart) or apart <= 0:
        return [], []
    power = int(np.floor(np.log10(apart)))
    step = next(s for s in (1, 2, 5, 10) if s * 10.0**power >= apart * (1 - 1e-9)) * 10.0**power
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    values = (np.arange(first, last + 1) * step).tolist()
    digits = max(0, -int(np.floor(np.log10(step * (1 + 1e-9)))))
    return values, [f"{value + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}") for value in values]


def red_blue(share: np.ndarray) -> list[str]:
    """Returns colours between blue (−1), white (0) and red (1) for values (n,)."""
    stops = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in RED_BLUE.split()], float)
    place = (np.clip(share, -1, 1) + 1) * (len(stops) - 1) / 2
    mixed = np.stack([np.interp(place, np.arange(len(stops)), stops[:, i]) for i in range(3)], axis=1)
    return ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in np.rint(mixed).astype(int).tolist()]


def arrows(start: np.ndarray, along: np.ndarray, width: float) -> list[np.ndarray]:
    """Returns the outlines (7, 2) of arrows from places (n, 2) along vectors (n, 2), with shafts of a width."""
    outlines = []
    for at, vector in zip(start, along, strict=True):
        length = float(np.hypot(*vector))
        if length <= 0:
            continue
        unit = vector / length
        head = min(5 * width, length)
        wide = 1.5 * width * head / (5 * width)
        thin = min(width / 2, wide / 2)
        shape = [(0, thin), (length - head, thin), (length - head, wide), (length, 0), (length - head, -wide)]
        shape += [(length - head, -thin), (0, -thin)]
        outlines.append(at + np.array(shape) @ np.array([unit, [-unit[1], unit[0]]]))
    return outlines


class Space:
    """Parallel projection of a box in space that is just large enough for points (n, 3), mm, with its axes.

    The same scale holds for X, Y and Z. ``elevation_deg``, ``azimuth_deg`` : direction to the viewer.
    """

    def __init__(self, drawing: Drawing, xyz: np.ndarray, elevation_deg: float, azimuth_deg: float):
        low, high = (xyz.min(0), xyz.max(0)) if len(xyz) else (-np.ones(3), np.ones(3))
        margin = 0.03 * max(float((high - low).max()), 1e-6)
        self._limits = np.array([low - margin, high + margin])
        (sin_e, sin_a), (cos_e, cos_a) = (f(np.radians([elevation_deg, azimuth_deg])) for f in (np.sin, np.cos))
        self._towards = np.array([cos_e * cos_a, cos_e * sin_a, sin_e])
        self._axes = np.array([[-sin_a, cos_a, 0.0], [sin_e * cos_a, sin_e * sin_a, -cos_e]])
        corners = np.array(list(product(*self._limits.T))) @ self._axes.T
        extent = np.maximum(np.ptp(corners, axis=0), 1e-9)
        room = np.array([drawing.width, drawing.height]) - 2 * MARGIN_PT
        self._scale = float((room / extent).min())
        self._middle = (corners.min(0) + corners.max(0)) / 2
        self._centre = np.array([drawing.width, drawing.height]) / 2
        self._draw_box(drawing)

    def at(self, xyz: np.ndarray) -> np.ndarray:
        """Returns the places (n, 2) in the drawing of points (n, 3)."""
        return self._centre + self._scale * (np.asarray(xyz, float) @ self._axes.T - self._middle)

    def _draw_box(self, drawing: Drawing) -> None:
        """Draws the three walls behind the points, and ticks and names along edges that nothing hides."""
        front = (self._towards > 0).astype(int)  # index of the limit that is nearer to the viewer, by axis
        for axis in range(3):
            others = [i for i in range(3) if i != axis]
            wall = np.empty((4, 3))
            wall[:, axis] = self._limits[1 - front[axis], axis]
            wall[:, others] = [[self._limits[i, others[0]], self._limits[k, others[1]]] for i, k in
                               ((0, 0), (1, 0), (1, 1), (0, 1))]  # fmt: skip
            drawing.lines([self.at(wall)], PANE_EDGE, 0.8, PANE)
        for axis, name in enumerate("XYZ"):
            self._draw_axis(drawing, axis, name, front)

    def _draw_axis(self, drawing: Drawing, axis: int, name: str, front: np.ndarray) -> None:
        a, b = (i for i in range(3) if i != axis)
        low, high = self._limits[:, axis]

        def points(sides: tuple[int, int], values) -> np.ndarray:
            xyz = np.empty((len(values), 3))
            xyz[:, axis], xyz[:, a], xyz[:, b] = values, self._limits[sides[0], a], self._limits[sides[1], b]
            return self.at(xyz)

        outline = ((front[a], 1 - front[b]), (1 - front[a], front[b]))  # edges between a wall in front and one behind
        ends = [points(sides, [low, high]) for sides in outline]
        chosen = int(np.argmax([end.mean(0)[0 if name == "Z" else 1] for end in ends]))
        edge = ends[chosen]
        along = edge[1] - edge[0]
        length = float(np.hypot(*along))
        if length < 1:  # seen from its end
            return
        across = np.array([-along[1], along[0]]) / length
        across *= np.sign(across @ (edge.mean(0) - self._centre)) or 1.0
        values, texts = ticks(low, high, 5 if length > 100 else 3)
        places = points(outline[chosen], values)
        drawing.lines([edge, *(np.array([at, at + 3 * across]) for at in places)], AXIS, 0.8)
        for at, text in zip(places, texts, strict=True):
            drawing.words(at + 11 * across, text, SMALL - 0.5)
        turned = float(np.degrees(np.arctan2(along[1], along[0])))
        turned -= 180 * round(turned / 180)
        drawing.words(edge.mean(0) + 27 * across, f"{name}, mm", SMALL + 0.5, turned_deg=turned)
