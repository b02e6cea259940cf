"""Figures of a hand-eye calibration: residuals, coverage of the poses, and views with their reprojected boards."""

import base64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.handeye.data.pairs import HandEyePoses, Loop
from stcal.handeye.data.views import Views
from stcal.handeye.judge.observability import Observability
from stcal.handeye.methods.reprojection import Reprojection
from stcal.handeye.result import HandEye
from stcal.handeye.validate import as_adjusted, poses_by_robot
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode, grey_8bit, thumbnail
from stcal.report.svg import (
    COLOURS,
    FAINT,
    INK,
    SMALL,
    VIRIDIS,
    Axes,
    Drawing,
    count_ticks,
    limits,
    mixed_names,
    round_below,
    ticks,
)
from stcal.report.text import number, telling_names

CELLS = 60
"""Number of cells along the longer side of the image, in which views of the board are counted."""
MOST_TURNS = 1000
"""Largest number of pairs of poses whose turn is drawn; of more pairs, a random sample."""
LEAST_TURN = np.radians(2)
"""Smallest turn whose axis is drawn, in rad; the axes of smaller turns are noise."""


def image_coverage(views: Views) -> np.ndarray:
    """Returns the number (rows, columns) of photographs whose board, the convex hull of its corners, covers each cell
    of the image."""
    width, height = views.camera.width, views.camera.height
    cell = max(width, height) / CELLS
    columns, rows = max(1, round(width / cell)), max(1, round(height / cell))
    # Pixel centres are integers: the image reaches from -0.5 on.
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    middle = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    counts = np.zeros(len(middle), int)
    for view in views.views:
        try:
            sides = ConvexHull(view.xy_px).equations
        except QhullError:  # all corners on a line
            continue
        counts += (middle @ sides[:, :2].T + sides[:, 2] <= 0).all(1)
    return counts.reshape(rows, columns)


def turns_between(pairs: HandEyePoses) -> np.ndarray:
    """Returns rotation vectors (n, 3) of the flange between poses, in its axes, rad, with Z ≥ 0."""
    rotation = pairs.base_from_flange.rotation
    i, j = np.triu_indices(len(rotation), 1)
    if len(i) > MOST_TURNS:
        sample = np.random.default_rng(0).choice(len(i), MOST_TURNS, replace=False)
        i, j = i[sample], j[sample]
    turn = Rotation.from_matrix(np.swapaxes(rotation[j], 1, 2) @ rotation[i]).as_rotvec()
    return np.where(turn[:, 2:] < 0, -turn, turn)


def equal_area(directions: np.ndarray) -> np.ndarray:
    """Projects unit vectors with Z ≥ 0 by Lambert's azimuthal projection, (n, 2), onto a disc of radius 1."""
    return directions[:, :2] / np.sqrt(1 + np.abs(directions[:, 2:]))


def by_robot(result: HandEye, pairs: HandEyePoses, views: Views) -> list[np.ndarray]:
    """Returns the corners (k, 2) px of each view by the robot's reported pose, NaN behind the camera."""
    camera, adjusted = as_adjusted(result, views)
    poses = poses_by_robot(result, Loop.of(pairs, result.setup))
    return [camera.project(pose @ view.xyz_board) for view, pose in zip(adjusted, poses, strict=True)]


def rms_px(predicted: np.ndarray, seen: np.ndarray) -> float:
    """Returns the RMS distance over all corners that could be predicted, or infinity if none could."""
    squared = ((predicted - seen) ** 2).sum(1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.any() else float("inf")


GOOD, BAD = COLOURS[0], COLOURS[1]
BLUES = "#f7fbff #c6dbef #6baed6 #2171b5 #08306b"
"""The ramp Blues of ColorBrewer, light to dark."""
MOST_NAMED = 40
"""Largest number of pose names below the chart. Of more poses, every second, third, … is named."""
MOST_VECTORS = 1500
"""Largest number of residuals that are drawn over the image."""
WIDE, HIGH, LEFT, GAP = 960.0, 112.0, 62.0, 30.0
"""Layout of the chart of poses, in px: width, height of one panel, room for its numbers, gap between panels."""
LONGEST = 0.06
"""Length at which the 95 % quantile of the residuals is drawn, as a share of the image's width."""


@dataclass(frozen=True, slots=True)
class Panel:
    """Bars of one quantity: ``ticks`` (y, text) and ``bars`` (x, top, height, colour, title), px."""

    label: str
    top: float
    ticks: list[tuple[float, str]]
    bars: list[tuple[float, float, float, str, str]]


@dataclass(frozen=True, slots=True)
class PoseBars:
    """``panels`` one below the other, with ``names`` (x, text, full name), slanted if ``slope``, shortened if
    ``cut``."""

    width: float
    height: float
    left: float
    bar: float
    panels: list[Panel]
    names: list[tuple[float, str, str]]
    slope: bool
    cut: bool


def pose_bars(result: HandEye) -> PoseBars:
    """Returns the chart of each pose's residuals: rotation, board's origin, and corner RMS if corners were adjusted."""
    turn, shift = (np.linalg.norm(part, axis=1) for part in np.split(result.residuals, 2, axis=1))
    rows = [("rotation, °", np.degrees(turn), 4, "°"), ("board's origin, mm", shift, 3, " mm")]
    if result.reprojection is not None:
        rms = np.array([result.reprojection.rms_px(i) for i in range(len(result.names))])
        rows.append(("corners, RMS px", rms, 3, " px"))
    step = (WIDE - LEFT) / len(result.names)
    centres = [LEFT + (i + 0.5) * step for i in range(len(result.names))]
    panels = []
    for k, (label, values, digits, unit) in enumerate(rows):
        top = 20 + k * (HIGH + GAP)
        largest = float(np.nanmax(values, initial=0)) or 1.0
        bars = []
        for x, value, name, bad in zip(centres, values, result.names, result.outliers, strict=True):
            title = f"{name}: {number(value, digits)}{unit}{', left out' if bad else ''}"
            height = HIGH * float(np.nan_to_num(value)) / largest
            bars.append((x, top + HIGH - height, height, BAD if bad else GOOD, title))
        panels.append(
            Panel(label, top, [(top + HIGH * (1 - t / largest), f"{t:g}") for t in ticks(0, largest)[0]], bars)
        )
    every = int(np.ceil(len(centres) / MOST_NAMED))
    short = telling_names(result.names)
    slope = max(map(len, short)) * 7.5 > every * step
    names = list(zip(centres, short, result.names, strict=True))[::every]
    room = 22 if not slope else 18 + 5.0 * max(len(text) for _, text, _ in names)
    height = panels[-1].top + HIGH + room
    return PoseBars(
        WIDE, height, LEFT, float(np.clip(0.7 * step, 1, 26)), panels, names, slope, short != list(result.names)
    )


def corner_figure(found: Reprojection) -> Drawing:
    """Draws the residuals of the corners, and the circle that holds 95 % of them."""
    drawing = Drawing(4.4, 4.0)
    residuals = found.residuals_px[_some(len(found.residuals_px))]
    circle = _circle(float(np.quantile(np.linalg.norm(found.residuals_px, axis=1), 0.95)))
    axes = Axes.equal(drawing, drawing.panels()[0], np.vstack([residuals, circle]), down=True)
    axes.frame("x, px", "y, px (down)", "y")
    axes.marks(*residuals.T, kind="dot", size=2.2, colour=GOOD, opacity=0.6)
    axes.lines([circle.T], INK, 0.8)
    return drawing


def _circle(radius: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 100)
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def image_figure(size: tuple[int, int], counts: np.ndarray, seen: np.ndarray, off: np.ndarray) -> Drawing:
    """Draws how often the board covered the image, and enlarged residuals ``off`` (n, 2) of corners ``seen`` (n, 2)."""
    width, height = size
    drawing = Drawing(6.0, 5.25 * height / width + 0.6)
    axes = Axes(drawing, drawing.panels()[0], (-0.5, width - 0.5), (height - 0.5, -0.5))
    shown = np.where(counts > 0, counts, np.nan)
    most = max(int(counts.max()), 1)
    axes.shade(shown, (-0.5, -0.5, width - 0.5, height - 0.5), -most / 3, 2.5 * most, BLUES, smooth=False)
    sample = _some(len(seen))
    seen, off = seen[sample], enlargement(off, width) * off[sample]
    known = np.isfinite(off).all(1)
    axes.lines(np.stack([seen, seen + off], axis=2)[known], BAD, 0.8)
    axes.marks(*seen.T, kind="dot", size=1.6, colour=INK)
    axes.frame("x, px", "y, px")
    return drawing


def enlargement(off: np.ndarray, width: float) -> float:
    """Returns a round factor, 1 or more, that makes residuals (n, 2) visible on an image of this width."""
    length = np.linalg.norm(off[np.isfinite(off).all(1)], axis=1)
    usual = float(np.quantile(length, 0.95)) if len(length) else 0.0
    return max(1.0, round_below(LONGEST * width / usual)) if usual else 1.0


def turns_figure(turns: np.ndarray, observability: Observability | None) -> Drawing:
    """Draws the axes of the turns (n, 3) between poses on the half sphere, and a histogram of their angles."""
    drawing = Drawing(9.4, 4.1)
    axes = Axes(drawing, (8.0, 8.0, 294.0, 287.0), (-1.16, 1.16), (-1.13, 1.13))
    for tilt in (30, 60, 90):
        radius = np.sqrt(2) * np.sin(np.radians(tilt) / 2)
        axes.lines([_circle(radius).T], INK if tilt == 90 else FAINT, 0.8)
        if tilt < 90:
            axes.words(0, -radius, f"{tilt}°", (0, -5), size=SMALL - 1, colour="#556270")
    for text, x, y in (("+X", 1.08, 0), ("−X", -1.08, 0), ("+Y", 0, 1.06), ("−Y", 0, -1.06), ("Z", 0.04, 0.04)):
        axes.words(x, y, text, size=SMALL + 0.5)
    axes.marks(0, 0, "dash", 6, "#9aa0a8")
    axes.marks(0, 0, "bar", 6, "#9aa0a8")
    angle = np.linalg.norm(turns, axis=1)
    large = angle > LEAST_TURN
    most = float(np.degrees(angle.max(initial=0)))
    colours = mixed_names(1 - np.degrees(angle[large]) / max(most, 1e-9), VIRIDIS)
    drawing.discs(axes.at(*equal_area(turns[large] / angle[large, None]).T), 1.7, colours)
    if observability is not None:
        for k, axis in enumerate(np.where(observability.axes[:, 2:] < 0, -observability.axes, observability.axes), 1):
            x, y = equal_area(axis[None])[0]
            axes.marks(x, y, "ring", 11, BAD)
            axes.words(x, y, str(k), (11, 0), size=SMALL + 1.5, colour=BAD, weight="bold")
    if large.any():
        drawing.scale((312, 60, 320, 235), 0, most, "turn, °", " ".join(VIRIDIS.split()[::-1]))
    edges = np.linspace(0, max(10.0, 10.0 * np.ceil(most / 10)), 19)
    counts = np.histogram(np.degrees(angle), edges)[0]
    bars = Axes(drawing, (405.0, 12.0, 668.0, 258.0), (0, edges[-1]), limits(counts, low=0))
    bars.frame("turn between two poses, °", "pairs of poses", "y", y_ticks=count_ticks(*bars.y))
    boxes = zip(edges[:-1], edges[1:], counts, strict=True)
    bars.lines([((a, a, b, b), (0, n, n, 0)) for a, b, n in boxes], fill=GOOD)
    return drawing


def _some(count: int) -> np.ndarray:
    """Returns the rows that are drawn: all of them, or a random sample of :data:`MOST_VECTORS`."""
    return np.sort(np.random.default_rng(0).permutation(count)[:MOST_VECTORS])


WIDTH_PX = 800
"""Width of an image in the page, in px. The page holds three images of some 100 kB each."""


@dataclass(frozen=True, slots=True)
class Overlay:
    """One image. ``corners`` : (x, y, x and y of the enlarged residual's end, title); ``factor`` : enlargement; ``dot``
    : radius of the dots, px of the image."""

    title: str
    says: str
    width: int
    height: int
    jpeg: str
    factor: float
    dot: float
    corners: list[tuple[float, float, float, float, str]]


def overlays(result: HandEye, pairs: HandEyePoses, views: Views, folder: Path) -> tuple[list[Overlay], list[str]]:
    """Returns the overlays of the worst, median and best image, and a message for each unreadable one."""
    predicted = by_robot(result, pairs, views)
    rms = np.array([rms_px(p, view.xy_px) for p, view in zip(predicted, views.views, strict=True)])
    order = np.argsort(rms, kind="stable")[::-1]
    chosen: dict[int, str] = {}
    for i, word in ((order[0], "worst"), (order[len(order) // 2], "usual"), (order[-1], "best")):
        chosen.setdefault(int(i), word)
    shown, missing = [], []
    for i, word in chosen.items():
        name = pairs.names[i]
        try:
            grey = grey_8bit(decode(read_bytes(folder / name, IMAGE_BYTES), name))
        except (OSError, InputError) as error:
            reason = error.strerror or error if isinstance(error, OSError) else error
            missing.append(f"{name} cannot be shown: {reason}")
            continue
        text = f"{rms[i]:.3g} px RMS by the robot's pose{', left out' if result.outliers[i] else ''}"
        shown.append(_overlay(f"{word}: {name}", text, grey, views.views[i].xy_px, predicted[i]))
    return shown, missing


def _overlay(title: str, says: str, grey: np.ndarray, seen: np.ndarray, predicted: np.ndarray) -> Overlay:
    height, width = grey.shape
    residuals = predicted - seen
    factor = enlargement(residuals, width)
    corners = []
    for (x, y), (right, down) in zip(seen.tolist(), residuals.tolist(), strict=True):
        if np.isfinite(right):
            text = f"x {right:+.2f} px, y {down:+.2f} px, {np.hypot(right, down):.2f} px"
            corners.append((x, y, x + factor * right, y + factor * down, text))
    jpeg = base64.b64encode(thumbnail(grey, WIDTH_PX)[0].tobytes()).decode()
    return Overlay(title, says, width, height, f"data:image/jpeg;base64,{jpeg}", factor, 0.005 * width, corners)
