"""Pictures of a registration: residuals in space, the field over the workspace, errors by place."""

import numpy as np

from stcal.register.core.liu2017 import SampleSize
from stcal.register.workspace import Cubes, Field, Findings
from stcal.report.figure import COLOURS, FAINT, INK, SMALL, calm, locator, new_figure, round_below

VIEWS = ((0, 1), (0, 2), (1, 2))
"""Horizontal and vertical axis of each view."""
MOST_ARROWS = 1500
ARROW_SHARE, FEW = 0.12, 80
"""Length of the inliers' RMS residual as a share of the picture's side; number of points above which it shrinks."""
LONGEST_SHARE = 0.3
"""Longest arrow of an outlier, as a fraction of the picture's side; longer arrows are cut off."""
MOST_LABELS = 60
"""Largest number of labels, for the longest of the arrows cut off; more labels would overlap."""
RASTER = 41
MARGIN = 0.25


def space_figure(findings: Findings):
    """Returns three views of the points in frame b with their residuals, enlarged."""
    result = findings.registration
    rows = _shown(findings)
    place = result.b_from_a @ findings.xyz_a[rows]
    residual, inlier = result.residuals[rows], result.inliers[rows]
    side = float(np.ptp(place, axis=0).max()) or 1.0
    typical = max(result.inlier_errors.rms_mm, 1e-12)
    crowded = min(1.0, FEW / len(rows)) ** (1 / 3)
    scale = round_below(ARROW_SHARE * crowded * side / typical)
    length = np.linalg.norm(residual, axis=1)
    cut = np.minimum(1, LONGEST_SHARE * side / np.maximum(scale * length, 1e-300))
    arrow = scale * residual * np.where(inlier, 1, cut)[:, None]
    middle = (place.min(0) + place.max(0)) / 2
    beyond = np.flatnonzero(~inlier & (cut < 1))
    beyond = beyond[np.argsort(-length[beyond], kind="stable")]
    reach = np.abs(np.concatenate([place, place + arrow]) - middle).max(0) * 1.06 + 0.01 * side
    figure = new_figure(10.2, 3.7)
    for k, (i, j) in enumerate(VIEWS):
        axes = figure.add_axes((0.075 + k * 0.325, 0.14, 0.255, 0.82))
        for kind, colour in ((True, COLOURS[0]), (False, COLOURS[1])):
            own = inlier == kind
            if own.any():
                axes.quiver(
                    *place[own][:, [i, j]].T,
                    *arrow[own][:, [i, j]].T,
                    color=colour,
                    angles="xy",
                    scale_units="xy",
                    scale=1,
                    width=0.006,
                    headwidth=3.2,
                    headlength=4,
                    headaxislength=3.6,
                    zorder=2 if kind else 3,
                )
                axes.plot(*place[own][:, [i, j]].T, ".", color=colour, ms=2.5, zorder=2)
        ends = (place + arrow)[:, [i, j]]
        axes.plot(*ends[beyond].T, "o", mfc="white", mec=COLOURS[1], ms=4, mew=0.8, zorder=4)
        for row, end in zip(beyond[:MOST_LABELS].tolist(), ends[beyond], strict=False):
            axes.annotate(
                f"{length[row]:.2g}", end, (3, 3), textcoords="offset points", fontsize=SMALL - 1, color=INK, zorder=5
            )
        _frame(axes, "b", i, j, middle, reach)
    figure.text(0.99, 0.99, f"{scale:,g} times", ha="right", va="top", fontsize=SMALL + 1, color=INK)
    return figure


def has_field_figure(findings: Findings, field: Field) -> bool:
    """Returns whether the points have a width in all directions, so that planes through their middle show something."""
    width = np.ptp(findings.xyz_a[field.rows], axis=0)
    return bool(width.min() >= 1e-3 * width.max())


def field_figure(findings: Findings, field: Field):
    """Returns planes through the middle of the points with the expected error."""
    own = findings.xyz_a[field.rows]
    low, high = own.min(0), own.max(0)
    middle, reach = (low + high) / 2, (high - low) / 2 * (1 + 2 * MARGIN)
    planes = []
    for i, j in VIEWS:
        u = middle[i] + reach[i] * np.linspace(-1, 1, RASTER)
        v = middle[j] + reach[j] * np.linspace(-1, 1, RASTER)
        grid = np.tile(middle, (RASTER * RASTER, 1))
        grid[:, i], grid[:, j] = (each.ravel() for each in np.meshgrid(u, v))
        error, covariance = field.at(grid)
        size = np.sqrt((error**2).sum(1) + np.trace(covariance, axis1=1, axis2=2))
        planes.append((u, v, size.reshape(RASTER, RASTER)))
    most = max(float(size.max()) for _, _, size in planes)
    step = round_below(most / 10)
    levels = np.arange(np.ceil(most / step * (1 - 1e-9)) + 1) * step
    figure, shown = new_figure(10.2, 3.5), []
    for k, ((i, j), (u, v, size)) in enumerate(zip(VIEWS, planes, strict=True)):
        axes = figure.add_axes((0.075 + k * 0.29, 0.15, 0.225, 0.8))
        shown.append(axes.contourf(u, v, size, levels=levels, cmap="YlOrRd"))
        axes.contour(u, v, size, levels=levels[1:-1:2], colors=INK, linewidths=0.4, alpha=0.5)
        third = 3 - i - j
        near = np.abs(own[:, third] - middle[third]) < (high - low)[third] / 8
        axes.plot(*own[near][:, [i, j]].T, ".", color=INK, ms=3)
        box = np.array([[low[i], low[j]], [high[i], low[j]], [high[i], high[j]], [low[i], high[j]], [low[i], low[j]]])
        axes.plot(*box.T, color=INK, lw=0.7, ls=(0, (4, 3)))
        _frame(axes, "a", i, j, middle, reach)
    bar = figure.colorbar(shown[-1], cax=figure.add_axes((0.918, 0.15, 0.012, 0.8)))
    bar.set_ticks(levels[:: -(-len(levels) // 8)])
    bar.ax.tick_params(labelsize=SMALL, length=2)
    bar.set_label("mm", fontsize=SMALL + 1)
    return figure


def errors_figure(findings: Findings, reach: Cubes):
    """Returns a figure of the residuals' lengths against the side of the cube about the middle that a point lies on."""
    result = findings.registration
    rows = _shown(findings)
    side = 2 * np.abs(findings.xyz_a[rows] - reach.middle).max(1)
    length, inlier = findings.length_mm[rows], result.inliers[rows]
    figure = new_figure(9, 2.6)
    axes = figure.add_axes((0.07, 0.2, 0.92, 0.66))
    top = 1.25 * result.inlier_errors.max_mm
    for edge in reach.sides_mm:
        axes.axvline(edge, color=FAINT, lw=0.8)
    for kind, colour, name in ((True, COLOURS[0], "inlier"), (False, COLOURS[1], "outlier")):
        own = inlier == kind
        inside = own & (length <= top)
        axes.plot(side[inside], length[inside], "o", color=colour, ms=3.2, mew=0, label=name if own.any() else None)
        axes.plot(side[own & ~inside], np.full((own & ~inside).sum(), top), "^", color=colour, ms=4.5, mew=0)
    held = result.held_out
    if held is not None and len(held.rows) == len(result):
        tried = np.full(len(result), np.nan)
        tried[held.rows] = held.error_mm
        tried = tried[rows]
        axes.plot(side[tried <= top], tried[tried <= top], "_", color=COLOURS[2], ms=6, mew=1, label="held out")
    axes.set_ylim(0, 1.04 * top)
    axes.set_xlim(0, None)
    calm(axes, "cube about the middle, side in mm (triangles: farther off than shown)", "error, mm")
    axes.legend(fontsize=SMALL, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    return figure


def _shown(findings: Findings) -> np.ndarray:
    """Returns all rows; of many, the outliers (a part of very many) and as many others as can be distinguished."""
    result = findings.registration
    if len(result) <= MOST_ARROWS:
        return np.arange(len(result))
    bad, good = result.outliers[: MOST_ARROWS // 3], np.flatnonzero(result.inliers)
    return np.concatenate([good[np.linspace(0, len(good) - 1, MOST_ARROWS - len(bad)).astype(int)], bad])


def _frame(axes, frame: str, i: int, j: int, middle: np.ndarray, reach: np.ndarray) -> None:
    """Sets limits of equal scale that hold ``middle`` ± ``reach``."""
    width, height = axes.get_position().size * axes.figure.get_size_inches()
    per_inch = max(reach[i] / width, reach[j] / height)
    axes.set_xlim(middle[i] - per_inch * width, middle[i] + per_inch * width)
    axes.set_ylim(middle[j] - per_inch * height, middle[j] + per_inch * height)
    axes.xaxis.set_major_locator(locator())
    axes.yaxis.set_major_locator(locator())
    calm(axes, f"{'xyz'[i]} of {frame}, mm", f"{'xyz'[j]} of {frame}, mm")


def sample_size_figure(sizes: list[SampleSize], share: float):
    """Returns a figure of the best and median share of inliers by size of the sample. The requested share is dashed."""
    figure = new_figure(6.4, 2.9)
    axes = figure.add_axes((0.1, 0.17, 0.87, 0.78))
    points = [each.points for each in sizes]
    axes.plot(points, [100 * each.best for each in sizes], "o-", color=COLOURS[0], ms=3.5, lw=1.4, label="best")
    axes.plot(points, [100 * each.median for each in sizes], "o:", color=COLOURS[0], ms=2.5, lw=1.2, label="median")
    axes.axhline(100 * share, color=INK, lw=0.8, ls=(0, (4, 3)))
    axes.set(ylim=(0, 102))
    axes.legend(frameon=False, fontsize=SMALL + 0.5, loc="lower right")
    axes.xaxis.set_major_locator(locator(integer=True))
    calm(axes, "points of a sample", "inliers of the other points, %", "y")
    return figure
