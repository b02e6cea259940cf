"""The report of a registration."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from stcal.geometry.rigid import Affine, Similarity
from stcal.register.core.liu2017 import Liu2017Options, SampleSize
from stcal.register.core.result import ErrorFigures
from stcal.register.report.drawings import (
    errors_figure,
    field_figure,
    has_field_figure,
    sample_size_figure,
    space_figure,
)
from stcal.register.report.file import matrix_of
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
from stcal.report.figure import COLOURS
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
