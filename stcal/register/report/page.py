"""Text and page of a registration."""

from itertools import pairwise

import numpy as np
from markupsafe import Markup

from stcal.geometry.rigid import Affine, Similarity
from stcal.parallel import one_thread
from stcal.register.core.liu2017 import Liu2017Options, SampleSize
from stcal.register.core.result import ErrorFigures
from stcal.register.report.drawings import errors_figure, field_figure, sample_size_figure, space_figure
from stcal.register.report.file import matrix_of
from stcal.register.workspace.field import Cubes, Field
from stcal.register.workspace.findings import Findings
from stcal.report.figure import COLOURS, uri
from stcal.report.page import Sections, render
from stcal.report.text import NONE, number, text_table

FEW_ROWS = 24
"""Largest number of rows that are all listed. Of more, only the outliers and some inliers are."""
WORST = 5
"""Number of inliers that are then listed, those with the largest residuals."""
MOST_OUTLIERS = 30
ROWS_ON_PAGE = 2000


def registration_text(found: Findings) -> str:
    """Returns the tables for the terminal."""
    result = found.registration
    lines = [_heading(found), "", "b_from_a, mm", *matrix_lines(matrix_of(result.b_from_a)), *_parts_lines(found), ""]
    heads = ["<mm", "points", "mean", "RMS", "max"]
    lines += text_table([heads, *_error_cells(found)], least=(28, 8, 10, 10, 10), gap=0)
    lines += ["", *_row_lines(found)]
    reach = _field_lines(found) + _cube_lines(found)
    return "\n".join(lines + (["", *reach] if reach else []))


def sample_size_section(sizes: list[SampleSize], options: Liu2017Options) -> tuple[str, str, Markup]:
    """Returns the paper's figure 6 for these points, as a section of the page."""
    rows = [
        [
            str(each.points),
            *(number(100 * share, 1) for share in (each.best, each.median)),
            str(each.orthogonal),
            f"{each.acceptable} of {each.tries}",
        ]
        for each in sizes
    ]
    content = render(
        "register/report/sample_size.html.jinja",
        figure=uri(sample_size_figure(sizes, options.share)),
        rows=rows,
        limit=f"{options.limit_mm:g}",
        share=f"{100 * options.share:g}",
    )
    return "sample", "Size of the sample", Markup(content)


def matrix_lines(matrix: np.ndarray) -> list[str]:
    """Returns a 4×4 matrix as text, row by row."""
    return ["  " + "".join(f"{v:14.9f}" for v in row[:3]) + f"{row[3]:16.4f}" for row in matrix]


def matrix_rows(matrix: np.ndarray) -> list[list[str]]:
    """Returns a 4×4 matrix for a page: the images of the axes and the origin."""
    return [[axis, *(f"{v:.9f}" for v in row[:3]), f"{row[3]:.4f}"] for axis, row in zip("xyz ", matrix, strict=True)]


def _heading(found: Findings) -> str:
    result = found.registration
    count, agree = len(result), int(result.inliers.sum())
    cut = "" if result.threshold_mm is None else f", threshold {result.threshold_mm:.4g} mm"
    way = f"{result.model}, {result.method}{cut}"
    return f"{found.where}: {count} point pairs, {way}: {agree} inliers, {count - agree} outliers"


def _parts_lines(found: Findings) -> list[str]:
    """Returns lines on σ of the transform, and on its scale or shear."""
    result, lines = found.registration, []
    sigma = np.sqrt(np.diag(result.covariance))
    if isinstance(result.b_from_a, Affine):
        scales = np.linalg.svd(result.b_from_a.linear, compute_uv=False)
        lines.append(f"scales {' '.join(f'{s:.6f}' for s in scales)}: a frame of the same unit has 1 1 1")
    else:
        lines.append(f"σ of its rotation {' '.join(f'{v:.3g}' for v in 1e3 * np.degrees(sigma[:3]))} mdeg")
    if isinstance(result.b_from_a, Similarity):
        lines.append(f"scale {result.b_from_a.scale:.8f} ± {sigma[6] * result.b_from_a.scale:.2g}")
    for place, xyz in (("the middle of the inliers", found.middle()), ("a's origin", np.zeros(3))):
        lines.append(f"σ it makes at {place}: {' '.join(f'{v:.3g}' for v in found.sigma_mm_at(xyz))} mm")
    redundancy = f", {result.redundancy:.0f} degrees of freedom" if np.isfinite(result.redundancy) else ""
    factor = "" if result.sigma_factor is None else f", {result.sigma_factor:.2f} of the σ given"
    return [*lines, f"σ of a coordinate {result.sigma_mm:.4g} mm{factor}{redundancy}"]


def _error_cells(found: Findings) -> list[list[str]]:
    """Returns cells with name, points, mean, RMS, maximum."""
    result, held = found.registration, found.registration.held_out
    rows = [_figures("residuals of the inliers", result.inlier_errors)]
    if held is not None:
        rows.append(_figures(f"held out ({held.folds} folds), inliers", held.of_inliers))
        if held.of_inliers.points < held.of_all.points:
            rows.append(_figures(f"held out ({held.folds} folds), all", held.of_all))
    return rows


def _figures(name: str, errors: ErrorFigures) -> list[str]:
    return [name, str(errors.points), *(number(v, 4) for v in (errors.mean_mm, errors.rms_mm, errors.max_mm))]


def _row_lines(found: Findings) -> list[str]:
    result, length = found.registration, found.length_mm
    if len(result) <= FEW_ROWS:
        rows, title = np.arange(len(result)), "residuals b − b_from_a a, mm"
    else:
        inliers = np.flatnonzero(result.inliers)
        worst = inliers[np.argsort(-length[inliers], kind="stable")][:WORST]
        rows = np.concatenate([result.outliers[:MOST_OUTLIERS], worst])
        title = f"residuals b − b_from_a a of the outliers and of the {len(worst)} largest inliers, mm"
    cells = []
    for row in rows.tolist():
        kind = "inlier" if result.inliers[row] else "OUTLIER"
        values = [*result.residuals[row], length[row]]
        cells.append([f"  {f'line {found.lines[row]}':<16}{kind}", *(number(v, 3) for v in values)])
    heads = ["<" + title, "x", "y", "z", "length"]
    lines = text_table([heads, *cells], (60, *[8] * 4)) if cells else []
    if len(result) > FEW_ROWS and len(result.outliers) > MOST_OUTLIERS:
        lines.append(f"  … and {len(result.outliers) - MOST_OUTLIERS} more outliers; all are in --out and --report")
    return lines


UNRELATED = 0.1
"""Ratio of residuals to the spread of the points, both RMS, beyond which the transform explains no measurement: the
coarsest instruments reach a hundredth of their range."""


def field_sentence(found: Findings, field: Field) -> str:
    """Returns a sentence on whether residuals are more than noise."""
    result = found.registration
    own = result.inliers
    xyz_b = (result.b_from_a @ found.xyz_a + result.residuals)[own]
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


def _field_lines(found: Findings) -> list[str]:
    return [] if found.field is None else [field_sentence(found, found.field)]


def shells(reach: Cubes) -> list[str]:
    """Returns names of the cubes: ``inner 200 mm``, ``200 … 300 mm`` …."""
    sides = [f"{side:g}" for side in reach.sides_mm]
    return [f"inner {sides[0]} mm"] + [f"{a} … {b} mm" for a, b in pairwise(sides)]


def _cube_lines(found: Findings) -> list[str]:
    reach = found.cubes
    if reach is None:
        return []
    middle = " ".join(f"{v:.0f}" for v in reach.middle)
    rows = [[f"{e.mean_mm:.3f} / {e.max_mm:.3f}" if e else "–" for e in row] for row in reach.errors]
    heads = [f"<errors in cubes about {middle} of a, mean / max, mm", *shells(reach)]
    fits = [[f"  fitted in the cube of {s:g} mm", *row] for s, row in zip(reach.sides_mm, rows, strict=True)]
    return [*text_table([heads, *fits], (52, *[14] * len(rows))), *holds(reach)]


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


@one_thread()
def registration_page(found: Findings, more: Sections = ()) -> str:
    """Returns the report page. ``more`` : sections to insert before the rows."""
    result = found.registration
    space, enlarged = space_figure(found)
    field = None if found.field is None else field_figure(found, found.field)
    length = found.length_mm
    return render(
        "register/report/page.html.jinja",
        more=list(more),
        counts=_heading(found),
        alarming=result.notes,
        headline=_headline(found),
        matrix=matrix_rows(matrix_of(result.b_from_a)),
        parts=_parts_lines(found),
        errors=_error_cells(found),
        colours=COLOURS,
        space=uri(space),
        enlarged=enlarged,
        systematic="" if found.field is None else field_sentence(found, found.field),
        field=field and uri(field),
        cubes=found.cubes and _cubes(found, found.cubes),
        outliers=[_row(found, row, length) for row in result.outliers[:ROWS_ON_PAGE]],
        rows=[_row(found, row, length) for row in range(min(len(result), ROWS_ON_PAGE))],
        count=len(result),
    )


def _headline(found: Findings) -> list[tuple[str, str, str]]:
    """Returns value, unit and meaning of each tile."""
    result, errors = found.registration, found.registration.inlier_errors
    tiles = [(f"{result.inliers.sum()} / {len(result)}", "", "inliers of the point pairs")]
    tiles.append((f"{errors.rms_mm:.3g} mm", "", f"RMS residual of the inliers, at most {errors.max_mm:.3g} mm"))
    if result.held_out is not None:
        held = result.held_out.of_inliers
        tiles.append((f"{held.mean_mm:.3g} mm", "", f"mean error of inliers held out, at most {held.max_mm:.3g} mm"))
    sigma = float(np.linalg.norm(found.sigma_mm_at(found.middle())))
    tiles.append((f"{sigma:.2g} mm", "", "σ of the transform at the middle of the inliers, all axes together"))
    return tiles


def _cubes(found: Findings, reach: Cubes) -> dict:
    """Returns errors in cubes in the form of the template."""
    rows = []
    for side, row in zip(reach.sides_mm, reach.errors, strict=True):
        errors = [[str(e.points), number(e.mean_mm, 4), number(e.max_mm, 4)] if e else ["0", NONE, NONE] for e in row]
        rows.append([f"{side:g} mm", *(cell for error in errors for cell in error)])
    return {
        "middle": " ".join(f"{v:.1f}" for v in reach.middle),
        "holds": holds(reach),
        "shells": shells(reach),
        "rows": rows,
        "figure": uri(errors_figure(found, reach)),
    }


def _row(found: Findings, row: int, length: np.ndarray) -> list[str]:
    """Returns the cells of a row. ``length`` : (n,) of all residuals."""
    result = found.registration
    kind = "inlier" if result.inliers[row] else "outlier"
    values = [number(v, 4) for v in (*result.residuals[row], length[row])]
    return [str(found.lines[row]), kind, *values]
