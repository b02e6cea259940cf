"""Figures for pages and files, written directly as SVG."""

import base64
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from stcal.errors import InputError
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


AXIS = "#9aa0a8"
FONTS = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
RED_BLUE = "#053061 #2166ac #4393c3 #92c5de #d1e5f0 #f7f7f7 #fddbc7 #f4a582 #d6604d #b2182b #67001f"
"""The diverging ramp RdBu of ColorBrewer (Harrower & Brewer 2003), from blue to red."""
VIRIDIS = "#440154 #472d7b #3b528b #2c728e #21918c #28ae80 #5ec962 #addc30 #fde725"
"""The ramp viridis (van der Walt & Smith 2015), dark to light."""
DASH = "5 4"
LETTER = 0.55  # mean width of a letter as a share of the font's size
MARKS = {
    "dot": "h0",
    "ring": "m-{1:.1f} 0a{1:.1f} {1:.1f} 0 1 0 {0:.1f} 0a{1:.1f} {1:.1f} 0 1 0 -{0:.1f} 0",
    "dash": "m-{1:.1f} 0h{0:.1f}",
    "bar": "m0 -{1:.1f}v{0:.1f}",
    "triangle": "m0 -{1:.1f}l{1:.1f} {0:.1f}h-{0:.1f}z",
    "square": "m-{1:.1f} -{1:.1f}h{0:.1f}v{0:.1f}h-{0:.1f}z",
    "diamond": "m0 -{1:.1f}l{1:.1f} {1:.1f}l-{1:.1f} {1:.1f}l-{1:.1f} -{1:.1f}z",
}
"""Path of each mark from its middle; {0} is its size, {1} half of it, pt."""
STROKES = {"ring": 1.0, "dash": 1.4, "bar": 1.4}  # widths of the lines of marks that are not filled, pt
Ticks = tuple[Sequence[float], Sequence[str]]  # values of an axis, and their words
UNWRITABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")  # characters that no XML file may contain


Box = tuple[float, float, float, float]  # left, top, right and bottom in a drawing, pt


class Drawing:
    """A drawing of a ``width`` and a ``height`` in inches; coordinates are in pt from the upper left corner."""

    def __init__(self, width: float, height: float):
        self.width, self.height = 72 * width, 72 * height
        self._parts: list[str] = []

    def panels(
        self,
        across: int = 1,
        down: int = 1,
        left: float = 46.0,
        top: float = 10.0,
        right: float = 8.0,
        bottom: float = 32.0,
        gap: float = 48.0,
    ) -> list[Box]:
        """Returns boxes of equal size for axes, row by row, with margins around them and a gap between them."""
        width = (self.width - left - right - (across - 1) * gap) / across
        height = (self.height - top - bottom - (down - 1) * gap) / down
        corners = [(left + k * (width + gap), top + i * (height + gap)) for i in range(down) for k in range(across)]
        return [(x, y, x + width, y + height) for x, y in corners]

    def lines(
        self,
        lines: Iterable[np.ndarray],
        colour: str = "none",
        width: float = 1.0,
        fill: str = "",
        opacity: float = 1.0,
        dash: str = "",
    ) -> None:
        """Draws lines, (k, 2) each; closed and filled areas if ``fill`` is given."""
        end, area = ("z", f'fill="{fill}" fill-opacity="{opacity:g}"') if fill else ("", 'fill="none"')
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line.tolist()) + end for line in lines)
        if path:
            self._parts.append(f'<path d="{path}" {area} stroke="{colour}" stroke-width="{width:g}"{dashes}/>')

    def marks(self, xy: np.ndarray, kind: str, size: float, colour: str, opacity: float = 1.0) -> None:
        """Draws a mark at each place (n, 2): dot, ring, dash, bar, triangle, square or diamond."""
        path = "".join(f"M{x:.1f} {y:.1f}" + MARKS[kind].format(size, size / 2) for x, y in xy.tolist())
        look = f'fill="{colour}"'
        if kind == "dot":
            look = f'stroke="{colour}" stroke-opacity="{opacity:g}" stroke-width="{size:g}" stroke-linecap="round"'
        elif kind in STROKES:
            look = f'fill="none" stroke="{colour}" stroke-width="{STROKES[kind]:g}"'
        if path:
            self._parts.append(f'<path d="{path}" {look}/>')

    def key(self, at: Sequence[float], entries: dict[str, tuple[str, str]]) -> None:
        """Draws a legend to the right of a place: by its words, the kind of mark and the colour of each entry."""
        x, y = at
        for text, (kind, colour) in entries.items():
            self.marks(np.array([[x + 4, y]]), kind, 6.0 if kind in STROKES else 4.5, colour)
            self.words((x + 12, y), text, anchor="start")
            x += 28 + LETTER * SMALL * len(text)

    def discs(self, xy: np.ndarray, radius: float, fills: Sequence[str], edge: str) -> None:
        """Draws discs at places (n, 2) in colours of their own."""
        places = zip(xy.tolist(), fills, strict=True)
        discs = (f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}"/>' for (x, y), fill in places)
        self._parts.append(f'<g stroke="{edge}" stroke-width="0.5">{"".join(discs)}</g>')

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
        x, y = map(float, at)
        turn = f' transform="rotate({turned_deg:.1f} {x:.1f} {y:.1f})"' if turned_deg else ""
        written = escape(UNWRITABLE.sub("\ufffd", text.encode("utf-8", "backslashreplace").decode()))
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" dy="0.35em" font-size="{size:g}" font-weight="{weight}" fill="{colour}" '
            f'text-anchor="{anchor}"{turn}>{written}</text>'
        )

    def scale(self, box: Box, low: float, high: float, title: str, ramp: str) -> None:
        """Draws the colours of a ramp from the value low (below) to high into a box."""
        left, top, right, bottom = box
        colours = ramp.split()[::-1]
        stops = "".join(f'<stop offset="{i / (len(colours) - 1):g}" stop-color="{c}"/>' for i, c in enumerate(colours))
        self._parts.append(
            f'<linearGradient id="scale" x1="0" y1="0" x2="0" y2="1">{stops}</linearGradient><rect x="{left:.1f}" '
            f'y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" fill="url(#scale)"/>'
        )
        axes = Axes(self, box, (0, 1), (low, high))
        for value, text in zip(*ticks(low, high), strict=True):
            y = axes.at(1, value)[0, 1]
            self.lines([np.array([[right, y], [right + 2, y]])], AXIS, 0.8)
            self.words((right + 4, y), text, SMALL - 1, "start")
        self.words(((left + right) / 2, top - 8), title)

    def picture(self, box: Box, rgba: np.ndarray) -> None:
        """Draws an image (rows, columns, 4), 8 bit, into a box."""
        stream = io.BytesIO()
        Image.fromarray(rgba).save(stream, "PNG")
        left, top, right, bottom = box
        self._parts.append(
            f'<image x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" '
            f'preserveAspectRatio="none" href="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"/>'
        )

    def svg(self) -> str:
        """Returns the text of the drawing; equal drawings give equal text."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width:g}pt" height="{self.height:g}pt" '
            f'viewBox="0 0 {self.width:g} {self.height:g}" font-family="{FONTS}">{"".join(self._parts)}</svg>'
        )

    def uri(self) -> str:
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg().encode()).decode()


def save(drawing: Drawing, path: Path) -> None:
    """Saves a drawing on white, all of it or nothing, and makes its folder."""
    if path.suffix.lower() != ".svg":
        raise InputError("E-OUTPUT-SUFFIX", f"--plot {path}: a name ending in .svg needed")
    files.save(path, drawing.svg().replace(">", ' style="background:#fff">', 1).encode())


@dataclass(frozen=True, slots=True)
class Axes:
    """Plane axes in a ``box`` of a drawing, with limits of ``x`` (at the left and right end) and ``y`` (at the bottom
    and top end). ``log`` : the axes that are logarithmic, such as ``y``."""

    drawing: Drawing
    box: Box
    x: tuple[float, float]
    y: tuple[float, float]
    log: str = ""

    @classmethod
    def equal(cls, drawing: Drawing, box: Box, xy: np.ndarray, margin: float = 0.05, down: bool = False) -> "Axes":
        """Returns axes with the same scale for x and y that hold points (n, 2) and a margin, a share of their extent;
        ``down`` : whether y grows downwards."""
        low, high = (xy.min(0), xy.max(0)) if len(xy) else (np.zeros(2), np.ones(2))
        room = np.array([box[2] - box[0], box[3] - box[1]])
        extent = np.maximum((1 + 2 * margin) * (high - low), 1e-9)
        half = room * (extent / room).max() / 2
        (left, bottom), (right, top) = ((low + high) / 2 + sign * half for sign in (-1, 1))
        return cls(drawing, box, (left, right), (top, bottom) if down else (bottom, top))

    def at(self, x, y) -> np.ndarray:
        """Returns the places (n, 2) in the drawing of coordinates (n,) each, or of one place."""
        left, top, right, bottom = self.box
        across = left + self._share("x", x) * (right - left)
        down = bottom + self._share("y", y) * (top - bottom)
        return np.stack(np.broadcast_arrays(across, down), axis=-1).reshape(-1, 2)

    def _share(self, axis: str, values) -> np.ndarray:
        ends, values = np.asarray(getattr(self, axis), float), np.asarray(values, float)
        if axis in self.log:
            ends, values = np.log(ends), np.log(np.maximum(values, ends[0]))
        return (values - ends[0]) / (ends[1] - ends[0])

    def lines(self, lines: Iterable, colour: str = "none", width: float = 1.0, **look) -> None:
        """Draws lines, each given by its x (k,) and y (k,)."""
        self.drawing.lines([self.at(*line) for line in lines], colour, width, **look)

    def level(self, y: float, colour: str = INK, width: float = 0.7, dash: str = "") -> None:
        self.lines([(self.x, (y, y))], colour, width, dash=dash)

    def marks(self, x, y, kind: str, size: float, colour: str, opacity: float = 1.0) -> None:
        """Draws a mark at each place that has finite coordinates; see :meth:`Drawing.marks`."""
        xy = self.at(x, y)
        self.drawing.marks(xy[np.isfinite(xy).all(1)], kind, size, colour, opacity)

    def words(self, x: float, y: float, text: str, shift: Sequence[float] = (0, 0), **look) -> None:
        """Writes words beside a place, ``shift`` in pt right and down from it."""
        self.drawing.words(self.at(x, y)[0] + shift, text, **look)

    def arrows(self, xy: np.ndarray, along: np.ndarray, width: float, colour: str, opacity: float = 1.0) -> None:
        """Draws arrows from places (n, 2) along vectors (n, 2), in coordinates of the axes."""
        start = self.at(*xy.T)
        outlines = arrows(start, self.at(*(xy + along).T) - start, width)
        self.drawing.lines(outlines, fill=colour, opacity=opacity)

    def shade(
        self, values: np.ndarray, extent: Box, low: float, high: float, ramp: str, bands: int = 0, smooth: bool = True
    ) -> None:
        """Shades values (rows, columns) in colours of a ramp from low to high; nan stays empty. ``extent`` : x and y of
        the first and of the last value; ``bands`` : steps of colours, or 0; ``smooth`` : interpolated."""
        from scipy.ndimage import zoom

        share = (values - low) / ((high - low) or 1.0)
        share = np.asarray(zoom(share, max(1, 240 // max(share.shape)), order=1) if smooth else share)
        known = np.isfinite(share)
        share = np.clip(np.where(known, share, 0), 0, 1)
        if bands:
            share = np.minimum(np.floor(share * bands), bands - 1) / max(bands - 1, 1)
        rgba = np.dstack([mixed(share, ramp), np.where(known, 255, 0)]).astype(np.uint8)
        (x0, y0), (x1, y1) = self.at(extent[::2], extent[1::2])
        self.drawing.picture((x0, min(y0, y1), x1, max(y0, y1)), rgba if y0 < y1 else rgba[::-1])

    def frame(
        self,
        x: str = "",
        y: str = "",
        grid: str = "",
        x_ticks: Ticks | None = None,
        y_ticks: Ticks | None = None,
        size: float = SMALL + 1,
    ) -> None:
        """Draws left and lower line with ticks (values and words) and names of the axes; ``grid`` : axes with lines."""
        drawing, (left, top, right, bottom) = self.drawing, self.box
        x_values, x_texts = x_ticks or self._ticks("x", (right - left) / 45)
        y_values, y_texts = y_ticks or self._ticks("y", (bottom - top) / 22)
        rows, columns = self.at(self.x[0], y_values)[:, 1], self.at(x_values, self.y[0])[:, 0]
        if "y" in grid:
            drawing.lines([np.array([[left, row], [right, row]]) for row in rows], FAINT, 0.6)
        if "x" in grid:
            drawing.lines([np.array([[column, top], [column, bottom]]) for column in columns], FAINT, 0.6)
        marks = [np.array([[left, row], [left - 2, row]]) for row in rows]
        marks += [np.array([[column, bottom], [column, bottom + 2]]) for column in columns]
        drawing.lines([np.array([[left, top], [left, bottom], [right, bottom]]), *marks], AXIS, 0.8)
        for row, text in zip(rows, y_texts, strict=True):
            drawing.words((left - 4.5, row), text, anchor="end")
        for column, text in zip(columns, x_texts, strict=True):
            drawing.words((column, bottom + 9), text)
        if x:
            drawing.words(((left + right) / 2, bottom + 21), x, size)
        if y:
            widest = LETTER * SMALL * max(map(len, y_texts), default=0)
            drawing.words((left - 13 - widest, (top + bottom) / 2), y, size, turned_deg=-90)

    def _ticks(self, axis: str, most: float) -> Ticks:
        low, high = sorted(getattr(self, axis))
        return log_ticks(low, high) if axis in self.log else ticks(low, high, int(np.clip(most, 3, 8)))


def limits(values, margin: float = 0.05, low: float | None = None) -> tuple[float, float]:
    """Returns limits of an axis for all finite values and a margin, a share of their extent; ``low`` : if given."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    first, last = (values.min(), values.max()) if len(values) else (0.0, 1.0)
    first = first if low is None else low
    room = margin * (last - first) if last > first else 0.5 * abs(last) or 0.5
    return float(first - room if low is None else low), float(last + room)


def log_limits(values) -> tuple[float, float]:
    """Returns limits of a logarithmic axis that hold all positive values."""
    values = np.asarray(values, float)
    ends = limits(np.log(values[values > 0]))
    return float(np.exp(ends[0])), float(np.exp(ends[1]))


def count_ticks(low: float, high: float) -> Ticks:
    """Returns a few whole numbers within limits."""
    values = [value for value in ticks(low, high, 8)[0] if value == round(value)]
    return values, [f"{value:.0f}" for value in values]


def log_ticks(low: float, high: float) -> Ticks:
    """Returns powers of ten within limits, or, over less than two decades, also twice and five times these."""
    steps = (1,) if high > 100 * low else (1, 2, 5)
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    values = [value for power in powers for step in steps if low <= (value := step * 10.0**power) <= high]
    return values, [f"{value:g}" for value in values]


def ticks(low: float, high: float, most: int = 5) -> Ticks:
    """Returns round values within limits, at most one more than ``most``, and their words."""
    apart = (high - low) / most
    if not np.isfinite(apart) or apart <= 0:
        return [], []
    power = int(np.floor(np.log10(apart)))
    step = next(s for s in (1, 2, 5, 10) if s * 10.0**power >= apart * (1 - 1e-9)) * 10.0**power
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    values = (np.arange(first, last + 1) * step + 0.0).tolist()
    digits = max(0, -int(np.floor(np.log10(step * (1 + 1e-9)))))
    return values, [f"{value:.{digits}f}".replace("-", "\N{MINUS SIGN}") for value in values]


def mixed(share: np.ndarray, ramp: str) -> np.ndarray:
    """Returns colours (…, 3), 0 to 255, between the first (0) and the last (1) colour of a ramp."""
    stops = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in ramp.split()], float)
    place = np.clip(share, 0, 1) * (len(stops) - 1)
    return np.rint(np.stack([np.interp(place, np.arange(len(stops)), stops[:, i]) for i in range(3)], axis=-1))


def mixed_names(share: np.ndarray, ramp: str) -> list[str]:
    """Returns the colours of :func:`mixed` for values (n,) as SVG has them."""
    return ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in mixed(share, ramp).astype(int).tolist()]


def arrows(start: np.ndarray, along: np.ndarray, width: float) -> list[np.ndarray]:
    """Returns the outlines (7, 2) of arrows from places (n, 2) along vectors (n, 2), with shafts of a width."""
    outlines = []
    for at, vector in zip(start, along, strict=True):
        if (length := float(np.hypot(*vector))) > 0:
            unit, head = vector / length, min(5 * width, length)
            neck, wide = length - head, 1.5 * width * head / (5 * width)
            thin = min(width / 2, wide / 2)
            shape = [(0, thin), (neck, thin), (neck, wide), (length, 0), (neck, -wide), (neck, -thin), (0, -thin)]
            outlines.append(at + np.array(shape) @ np.array([unit, [-unit[1], unit[0]]]))
    return outlines
