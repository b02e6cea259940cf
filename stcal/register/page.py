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
from stcal.report.svg import (
    COLOURS,
    DASH,
    FAINT,
    INK,
    SMALL,
    YELLOW_RED,
    Axes,
    Box,
    Drawing,
    limits,
    round_below,
    ticks,
)
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
        width = np.ptp(findings.xyz_a[field.rows], axis=0)
        if width.min() >= 1e-3 * width.max():  # else planes through the points' middle show nothing
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
    drawing = Drawing(10.2, 3.7)
    for box, (i, j) in zip(drawing.panels(3, left=54, top=14, gap=50), VIEWS, strict=True):
        axes = _axes(drawing, box, "b", i, j, middle, reach)
        for kind, colour in ((True, COLOURS[0]), (False, COLOURS[1])):
            own = inlier == kind
            axes.arrows(place[own][:, [i, j]], arrow[own][:, [i, j]], 1.1, colour)
            axes.marks(*place[own][:, [i, j]].T, kind="dot", size=2.5, colour=colour)
        ends = (place + arrow)[beyond][:, [i, j]]
        axes.marks(*ends.T, kind="ring", size=4, colour=COLOURS[1])
        for row, (x, y) in zip(beyond[:MOST_LABELS].tolist(), ends.tolist(), strict=False):
            axes.words(x, y, f"{length[row]:.2g}", (4, -5), size=SMALL - 1, anchor="start")
    drawing.words((drawing.width - 6, 7), f"{scale:,g} times", SMALL + 1, "end")
    return drawing


def field_figure(findings: Findings, field: Field) -> Drawing:
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
    drawing = Drawing(10.2, 3.5)
    boxes = drawing.panels(3, left=54, right=52, gap=50)
    for box, (i, j), (u, v, size) in zip(boxes, VIEWS, planes, strict=True):
        axes = _axes(drawing, box, "a", i, j, middle, reach)
        axes.shade(size, (u[0], v[0], u[-1], v[-1]), 0, levels[-1], YELLOW_RED, len(levels) - 1)
        third = 3 - i - j
        near = np.abs(own[:, third] - middle[third]) < (high - low)[third] / 8
        axes.marks(*own[near][:, [i, j]].T, kind="dot", size=3, colour=INK)
        corners = (low[i], high[i], high[i], low[i], low[i]), (low[j], low[j], high[j], high[j], low[j])
        axes.lines([corners], INK, 0.7, dash=DASH)
    right, top, bottom = drawing.width - 38, boxes[0][1], boxes[0][3]
    drawing.scale((right, top + 14, right + 8, bottom), 0, levels[-1], "mm", YELLOW_RED)
    return drawing


def errors_figure(findings: Findings, reach: Cubes) -> Drawing:
    """Returns a figure of each residual against the side of the centred cube on whose surface its point lies."""
    result = findings.registration
    rows = _shown(findings)
    side = 2 * np.abs(findings.xyz_a[rows] - reach.middle).max(1)
    length, inlier = findings.length_mm[rows], result.inliers[rows]
    drawing = Drawing(9, 2.6)
    top = 1.25 * result.inlier_errors.max_mm
    axes = Axes(
        drawing, drawing.panels(top=24)[0], limits([side.max(initial=0), *reach.sides_mm], low=0), (0, 1.04 * top)
    )
    axes.lines([((edge, edge), axes.y) for edge in reach.sides_mm], FAINT, 0.8)
    key = {}
    for kind, colour, name in ((True, COLOURS[0], "inlier"), (False, COLOURS[1], "outlier")):
        own = inlier == kind
        inside = own & (length <= top)
        axes.marks(side[inside], length[inside], "dot", 3.2, colour)
        axes.marks(side[own & ~inside], top, "triangle", 4.5, colour)
        key |= {name: ("dot", colour)} if own.any() else {}
    held = result.held_out
    if held is not None and len(held.rows) == len(result):
        tried = np.full(len(result), np.nan)
        tried[held.rows] = held.error_mm
        tried = tried[rows]
        axes.marks(side[tried <= top], tried[tried <= top], "dash", 6, COLOURS[2])
        key["held out"] = "dash", COLOURS[2]
    axes.frame("cube about the middle, side in mm (triangles: farther off than shown)", "error, mm")
    drawing.key((axes.box[0], 10), key)
    return drawing


def _shown(findings: Findings) -> np.ndarray:
    """Returns all rows; of many, the outliers (a part of very many) and as many others as can be distinguished."""
    result = findings.registration
    if len(result) <= MOST_ARROWS:
        return np.arange(len(result))
    bad, good = result.outliers[: MOST_ARROWS // 3], np.flatnonzero(result.inliers)
    return np.concatenate([good[np.linspace(0, len(good) - 1, MOST_ARROWS - len(bad)).astype(int)], bad])


def _axes(drawing: Drawing, box: Box, frame: str, i: int, j: int, middle: np.ndarray, reach: np.ndarray) -> Axes:
    """Returns axes of equal scale that hold ``middle`` ± ``reach``."""
    axes = Axes.equal(drawing, box, np.array([middle - reach, middle + reach])[:, [i, j]], 0)
    axes.frame(f"{'xyz'[i]} of {frame}, mm", f"{'xyz'[j]} of {frame}, mm")
    return axes


def sample_size_figure(sizes: list[SampleSize], share: float) -> Drawing:
    """Returns a figure of the best and median share of inliers by size of the sample. The requested share is dashed."""
    drawing = Drawing(6.4, 2.9)
    points = [each.points for each in sizes]
    axes = Axes(drawing, drawing.panels(top=24)[0], limits(points), (0, 102))
    axes.frame("points of a sample", "inliers of the other points, %", "y", ticks(*axes.x, len(points)))
    best, median = [100 * each.best for each in sizes], [100 * each.median for each in sizes]
    axes.lines([(points, best)], COLOURS[0], 1.4)
    axes.lines([(points, median)], COLOURS[4], 1.2)
    axes.marks(points, best, "dot", 3.5, COLOURS[0])
    axes.marks(points, median, "dot", 2.5, COLOURS[4])
    axes.level(100 * share, dash=DASH)
    drawing.key((axes.box[0], 10), {"best": ("dot", COLOURS[0]), "median": ("dot", COLOURS[4])})
    return drawing
