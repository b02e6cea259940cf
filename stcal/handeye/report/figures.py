"""Figures of a hand-eye calibration: residuals of poses, and coverage of the image with the residuals over it."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stcal.handeye.data.pairs import HandEyePoses, Loop
from stcal.handeye.data.views import Views
from stcal.handeye.result import HandEye
from stcal.handeye.validate import as_adjusted, poses_by_robot
from stcal.report.svg import COLOURS, INK, Axes, Drawing, count_ticks, limits, round_below

CELLS = 60
"""Number of cells along the longer side of the image, in which views of the board are counted."""
GOOD, BAD = COLOURS[0], COLOURS[1]
BLUES = "#f7fbff #c6dbef #6baed6 #2171b5 #08306b"
"""The ramp Blues of ColorBrewer, light to dark."""
MOST_VECTORS = 1500
"""Largest number of residuals that are drawn over the image."""
LONGEST = 0.06
"""Length at which the 95 % quantile of the residuals is drawn, as a share of the image's width."""


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


def by_robot(result: HandEye, pairs: HandEyePoses, views: Views) -> list[np.ndarray]:
    """Returns the corners (k, 2) px of each view by the robot's reported pose, NaN behind the camera."""
    camera, adjusted = as_adjusted(result, views)
    poses = poses_by_robot(result, Loop.of(pairs, result.setup))
    return [camera.project(pose @ view.xyz_board) for view, pose in zip(adjusted, poses, strict=True)]


def pose_bars(result: HandEye) -> Drawing:
    """Draws each pose's residuals: rotation, board's origin, and corner RMS if corners were adjusted."""
    turn, shift = np.linalg.norm(result.residuals.reshape(-1, 2, 3), axis=2).T
    rows = {"rotation, °": np.degrees(turn), "origin, mm": shift}
    if result.reprojection is not None:
        rows["corners, px"] = np.array([result.reprojection.rms_px(i) for i in range(len(result.names))])
    drawing = Drawing(9.4, 0.6 + 1.2 * len(rows))
    for box, (label, values) in zip(drawing.panels(1, len(rows), gap=26), rows.items(), strict=True):
        axes = Axes(drawing, box, (0.4, len(values) + 0.6), limits(values, low=0))
        axes.frame("pose, in order", label, "y", count_ticks(1, len(values)))
        for colour, rows_of in ((GOOD, ~result.outliers), (BAD, result.outliers)):
            shown = np.flatnonzero(rows_of & np.isfinite(values))
            axes.lines(
                [((i + 0.6, i + 0.6, i + 1.4, i + 1.4), (0, values[i], values[i], 0)) for i in shown], fill=colour
            )
    return drawing


def image_figure(size: tuple[int, int], counts: np.ndarray, seen: np.ndarray, off: np.ndarray) -> Drawing:
    """Draws how often the board covered the image, and enlarged residuals ``off`` (n, 2) of corners ``seen`` (n, 2)."""
    width, height = size
    drawing = Drawing(6.0, 5.25 * height / width + 0.6)
    axes = Axes(drawing, drawing.panels()[0], (-0.5, width - 0.5), (height - 0.5, -0.5))
    shown = np.where(counts > 0, counts, np.nan)
    most = max(int(counts.max()), 1)
    axes.shade(shown, (-0.5, -0.5, width - 0.5, height - 0.5), -most / 3, 2.5 * most, BLUES, smooth=False)
    sample = np.sort(np.random.default_rng(0).permutation(len(seen))[:MOST_VECTORS])
    seen, off = seen[sample], enlargement(off, width) * off[sample]
    axes.lines(np.stack([seen, seen + off], axis=2), BAD, 0.8)
    axes.marks(*seen.T, kind="dot", size=1.6, colour=INK)
    axes.frame("x, px", "y, px")
    return drawing


def enlargement(off: np.ndarray, width: float) -> float:
    """Returns a round factor, 1 or more, that makes residuals (n, 2) visible on an image of this width."""
    usual = float(np.quantile(np.linalg.norm(off, axis=1), 0.95)) if len(off) else 0.0
    return max(1.0, round_below(LONGEST * width / usual)) if usual else 1.0
