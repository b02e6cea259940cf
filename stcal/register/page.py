"""The report of a registration: page and pictures."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from stcal.geometry.rigid import Affine, Similarity
from stcal.register.file import matrix_of
from stcal.register.liu2017 import Liu2017Options, SampleSize
from stcal.register.result import ErrorFigures
from stcal.register.workspace import Cubes, Field, Findings
from stcal.report.document import (
    MOST_ROWS,
    Block,
    Document,
    Section,
    Table,
    alarms,
    fold,
    legend,
    page_only,
    plot,
    tiles,
)
from stcal.report.svg import COLOURS, FAINT, INK, SMALL, calm, locator, new_figure, round_below
from stcal.report.text import NONE, number

FEW_ROWS = 24
"""Largest number of rows that are all listed. Of more, only the outliers and some inliers are."""
WORST = 5
"""Number of inliers that are then listed, those with the largest residuals."""


def sample_size_section(sizes: list[SampleSize], options: Liu2017Options) -> Section:
    """Returns the paper's figure 6 for these points, as a section of the page."""
    rows = [
        [
            str(e.points),
            number(100 * e.best, 1),
            number(100 * e.median, 1),
            str(e.orthogonal),
            f"{e.acceptable} of {e.tries}",
        ]
        for e in sizes
    ]
    told = (
        "Samples of every size, as in figure 6 of Liu et al. (2017): the share of the other points within "
        f"{options.limit_mm:g} mm of what the sample says. A sample is acceptable with more than "
        f"{100 * options.share:g} %; samples whose 3×3 part is not orthogonal are not used"
    )
    figure = plot(
        lambda: sample_size_figure(sizes, options.share),
        "Share of inliers against the size of the sample: best and median",
    )
    heads = ["points", "best (%)", "median (%)", "orthogonal", "acceptable"]
    return Section("Size of the sample", [told, figure, Table(heads, rows)])


def matrix_table(name: str, matrix: np.ndarray) -> Table:
    """Returns a 4×4 matrix: the images of the axes, and the origin."""
    rows = [[axis, *(f"{v:.9f}" for v in row[:3]), f"{row[3]:.4f}"] for axis, row in zip("xyz ", matrix, strict=True)]
    return Table([f"<{name}", "x axis", "y axis", "z axis", "origin, mm"], rows)


def _heading(findings: Findings) -> str:
    result = findings.registration
    count, agree = len(result), int(result.inliers.sum())
    cut = "" if result.threshold_mm is None else f", threshold {result.threshold_mm:.4g} mm"
    way = f"{result.model}, {result.method}{cut}"
    return f"{findings.where}: {count} point pairs, {way}: {agree} inliers, {count - agree} outliers"


def _three(values: np.ndarray) -> str:
    return ", ".join(f"{v:.3g}" for v in values)


def _parts_lines(findings: Findings) -> list[str]:
    """Returns lines on σ of the transform, and on its scale or shear."""
    result, lines = findings.registration, []
    sigma = np.sqrt(np.diag(result.covariance))
    if isinstance(result.b_from_a, Affine):
        scales = np.linalg.svd(result.b_from_a.linear, compute_uv=False)
        lines.append(f"scales {' '.join(f'{s:.6f}' for s in scales)}: a frame of the same unit has 1 1 1")
    else:
        lines.append(f"σ of its rotation about x, y, z: {_three(1e3 * np.degrees(sigma[:3]))} mdeg")
    if isinstance(result.b_from_a, Similarity):
        lines.append(f"scale {result.b_from_a.scale:.8f} ± {sigma[6] * result.b_from_a.scale:.2g}")
    for place, xyz in (("the middle of the inliers", findings.middle()), ("a's origin", np.zeros(3))):
        lines.append(f"σ of a transformed point at {place}, along x, y, z: {_three(findings.sigma_mm_at(xyz))} mm")
    redundancy = f", {result.redundancy:.0f} degrees of freedom" if np.isfinite(result.redundancy) else ""
    factor = "" if result.sigma_factor is None else f", {result.sigma_factor:.2f} of the σ given"
    return [*lines, f"σ of a coordinate {result.sigma_mm:.4g} mm{factor}{redundancy}"]


def _error_cells(findings: Findings) -> list[list[str]]:
    """Returns cells with name, points, mean, RMS, maximum."""
    result, held = findings.registration, findings.registration.held_out
    rows = [_figures("residuals of the inliers", result.inlier_errors)]
    if held is not None:
        rows.append(_figures(f"held out ({held.folds} folds), inliers", held.of_inliers))
        if held.of_inliers.points < held.of_all.points:
            rows.append(_figures(f"held out ({held.folds} folds), all", held.of_all))
    return rows


def _figures(name: str, errors: ErrorFigures) -> list[str]:
    return [name, str(errors.points), *(number(v, 4) for v in (errors.mean_mm, errors.rms_mm, errors.max_mm))]


def _rows(findings: Findings) -> Table:
    """Returns the residuals of all rows; of many rows those of outliers, and the largest of inliers."""
    result = findings.registration
    if len(result) <= FEW_ROWS:
        return _table_of(findings, np.arange(len(result)))
    inliers = np.flatnonzero(result.inliers)
    worst = inliers[np.argsort(-findings.length_mm[inliers], kind="stable")][:WORST]
    return _table_of(findings, np.concatenate([worst, result.outliers]))


def _table_of(findings: Findings, rows: np.ndarray) -> Table:
    result, length = findings.registration, findings.length_mm
    cells = []
    for row in rows.tolist():
        values = (number(float(v), 4) for v in (*result.residuals[row], length[row]))
        cells.append([f"line {findings.lines[row]}", "inlier" if result.inliers[row] else "OUTLIER", *values])
    return Table(["<residual, mm", "<", "x", "y", "z", "length"], cells)


UNRELATED = 0.1
"""Ratio of residuals to the spread of the points, both RMS, beyond which the transform explains no measurement: the
coarsest instruments reach a hundredth of their range."""


def field_sentence(findings: Findings, field: Field) -> str:
    """Returns a sentence on whether residuals are more than noise."""
    result = findings.registration
    own = result.inliers
    xyz_b = (result.b_from_a @ findings.xyz_a + result.residuals)[own]
    share = float(np.sqrt((result.residuals[own] ** 2).sum() / ((xyz_b - xyz_b.mean(0)) ** 2).sum()))
    if share > UNRELATED:
        return (
            f"residuals are {100 * share:.0f} % of the spread of the points, {100 * UNRELATED:.0f} % at most of points "
            "that correspond: the rows are not the same points in both frames, or not in the same order or unit; do "
            "not use this transform"
        )
    if not field.seen:
        return (
            f"no systematic residuals seen: they look like noise of σ {field.noise_mm:.3g} mm "
            f"(chance of as much structure: {field.p_value:.2g})"
        )
    back = len(field.taken_back)
    taken = f"; {back} of the outliers follow{'s' * (back == 1)} it" if back else ""
    return (
        f"residuals are systematic: {field.size_mm:.3g} mm RMS change smoothly over {field.length_mm:.0f} mm, beside "
        f"noise of σ {field.noise_mm:.3g} mm; a point left out errs by {field.plain_mm.mean():.3g} mm on average, by "
        f"{field.corrected_mm.mean():.3g} mm with this field of the others taken off{taken}; σ of the transform, which "
        "takes residuals as independent, are too small"
    )


def shells(reach: Cubes) -> list[str]:
    """Returns names of the cubes: ``inner 200 mm``, ``200 … 300 mm`` …."""
    sides = [f"{side:g}" for side in reach.sides_mm]
    return [f"inner {sides[0]} mm"] + [f"{a} … {b} mm" for a, b in pairwise(sides)]


def holds(reach: Cubes) -> list[str]:
    """Returns how large the errors of a fit to the inner cube are there, and farther out."""
    first = reach.errors[0]
    outside = [(side, e) for side, e in zip(reach.sides_mm[1:], first[1:], strict=True) if e]
    if first[0] is None or not outside:
        return []
    text, most = f"fitted in the cube of {reach.sides_mm[0]:g} mm it holds within {first[0].max_mm:.3g} mm there", 0.0
    for side, each in outside:
        most = max(most, each.max_mm, first[0].max_mm)
        text += f", {most:.3g} mm to {side:g} mm"
    return [text]


def registration_report(findings: Findings, more: Sequence[Section] = ()) -> Document:
    """Returns the report of ``register``. ``more`` : sections to insert before the rows."""
    result = findings.registration
    matrix = matrix_table("b_from_a", matrix_of(result.b_from_a))
    errors = Table(["<lengths of errors, mm", "points", "mean", "RMS", "max"], _error_cells(findings))
    answer = [page_only(alarms(result.notes)), tiles(_headline(findings)), matrix, *_parts_lines(findings), errors]
    outliers = len(result.outliers) > 0
    cut = "; arrows of outliers that would leave the picture end in a ring, their length in mm beside them"
    space = [
        legend({"inlier": COLOURS[0], **({"outlier": COLOURS[1]} if outliers else {})}),
        plot(
            lambda: space_figure(findings),
            "residuals in three views",
            f"Points in frame b and their residuals b − b_from_a a, enlarged{cut if outliers else ''}",
        ),
    ]
    rows, first = _rows(findings), min(len(result), MOST_ROWS)
    what = "All rows" if first == len(result) else f"The first {first} of {len(result)} rows"
    every = fold(what, _table_of(findings, np.arange(first))) if len(result) > FEW_ROWS else None
    return Document(
        "Registration",
        _heading(findings),
        [
            Section("Result", answer, terminal=True),
            Section("Residuals in space", space),
            Section("Where it holds", _where_it_holds(findings), terminal=True),
            *more,
            Section("Rows", ["" if outliers else "no outliers", rows, every], terminal=True),
        ],
    )


def _where_it_holds(findings: Findings) -> list[Block]:
    """Returns whether residuals are systematic, and errors in cubes about the middle of the points."""
    field, reach = findings.field, findings.cubes
    blocks: list[Block] = []
    if field is not None:
        blocks.append(field_sentence(findings, field))
        if has_field_figure(findings, field):
            blocks.append(
                plot(
                    lambda: field_figure(findings, field),
                    "systematic error over the workspace",
                    "Systematic error to expect of the transform (RMS: of what the residuals show and of what they "
                    "leave open), in planes through the middle of the points, frame a. Dots: the points within an "
                    "eighth of the plane; dashed: the box of all. Beyond it the model is less certain, and its errors "
                    "are larger",
                )
            )
    if reach is not None:
        middle = " ".join(f"{v:.1f}" for v in reach.middle)
        explained = (
            f"Cubes about ({middle}) mm, along the axes of a. The transform is fitted again to the points in one cube "
            "and tried on those of all; the points that it is fitted to are held out in turn. This makes no "
            "assumption about the cause of errors"
        )
        place = plot(lambda: errors_figure(findings, reach), "errors by place", "Lengths of the residuals by place")
        blocks += [page_only(explained), *holds(reach), _cubes(reach), place]
    return blocks or [page_only("Too few points to tell")]


def _headline(findings: Findings) -> list[tuple[str, str, str]]:
    """Returns value, unit and meaning of each tile."""
    result, errors = findings.registration, findings.registration.inlier_errors
    tiles = [(f"{result.inliers.sum()} / {len(result)}", "", "inliers of the point pairs")]
    tiles.append((f"{errors.rms_mm:.3g} mm", "", f"RMS residual of the inliers, at most {errors.max_mm:.3g} mm"))
    if result.held_out is not None:
        held = result.held_out.of_inliers
        tiles.append((f"{held.mean_mm:.3g} mm", "", f"mean error of inliers held out, at most {held.max_mm:.3g} mm"))
    sigma = float(np.linalg.norm(findings.sigma_mm_at(findings.middle())))
    tiles.append((f"{sigma:.2g} mm", "", "σ of the transform at the middle of the inliers, all axes together"))
    return tiles


def _cubes(reach: Cubes) -> Table:
    """Returns errors in cubes, one row for each cube that the transform is fitted to."""
    rows = []
    for side, row in zip(reach.sides_mm, reach.errors, strict=True):
        errors = [[str(e.points), number(e.mean_mm, 4), number(e.max_mm, 4)] if e else ["0", NONE, NONE] for e in row]
        rows.append([f"{side:g} mm", *(cell for error in errors for cell in error)])
    over = [("", 1), *((f"{name}:", 3) for name in shells(reach))]
    return Table(["<fitted in the cube of", *["points", "mean", "max"] * len(rows)], rows, over)


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
    """Returns a figure of each residual against the side of the centred cube on whose surface its point lies."""
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
