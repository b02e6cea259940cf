"""The budget as text for people."""

from collections.abc import Sequence

import numpy as np

from stcal.report.text import number, text_table
from stcal.sfm.budget.file import BudgetFile, LengthTestPart, SourceRow, Uncertainty


def budget_text(file: BudgetFile) -> str:
    """Returns the inputs, a table each for positions, rotations and distances, and the notes."""
    images = sum(each.images for each in file.views)
    groups = ", ".join(f"{each.group}: {each.images} over {each.spread_deg:.0f}°" for each in file.views)
    lines = [
        f"uncertainty budget of {file.run.folder}: {file.run.target}, {images} images ({groups})",
        *(f"{name}: {value}" for name, value in file.fields.items() if value),
        "",
        *_inputs(file.sources),
    ]
    faces, lengths = file.faces, file.distances
    for title, columns in (
        (f"position, µm, against face {file.reference_face}", {f: each.position_um for f, each in faces.items()}),
        (f"rotation, mdeg, against face {file.reference_face}", {f: each.rotation_mdeg for f, each in faces.items()}),
        ("longest distances, µm", {name_of(each.circles): each.distance_um for each in lengths}),
    ):
        lines += ["", *_table(title, columns, file)]
    lines += [f"{name_of(each.circles)}: {_length(each, file)}" for each in lengths]
    for test in file.length_tests:
        lines += ["", *_length_test(test)]
    return "\n".join([*lines, "", *(f"note: {note}" for note in file.notes)])


def _length_test(test: LengthTestPart) -> list[str]:
    """Returns a table of the lengths, and the verdict."""
    rows = [("<length", "measured mm", "reference mm", "error µm", "U µm", "E_n")]
    for length in test.lengths:
        values = (
            f"{length.measured_mm:.4f}",
            f"{length.reference_mm:.4f}",
            f"{length.error_um:.2f}",
            f"{length.expanded_um:.2f}",
        )
        rows.append((name_of(length.circles), *values, number(length.e_n, 2)))
    return [
        f"length test against {test.reference}:",
        *text_table(rows),
        verdict_of(test),
        *(f"note: {length}" for length in test.notes),
    ]


def verdict_of(test: LengthTestPart) -> str:
    """Returns the verdict of a length test in words."""
    count = len(test.lengths)
    return (
        f"{'agrees' if test.agrees else 'differs'}: {test.beyond} of {count} lengths beyond U, by chance 1 in 22 is; "
        f"largest |E_n| {number(max(abs(e) for e in _known(test)), 2)}, up to {test.limit:.2f} for {count}"
    )


def _known(test: LengthTestPart) -> list[float]:
    return [np.inf if each.e_n is None else each.e_n for each in test.lengths]


def name_of(circles: Sequence[str]) -> str:
    """Returns the name of a length, made from its ends."""
    return "–".join(circles)


def _length(row, file: BudgetFile) -> str:
    own = f"{row.length_mm:.4f} mm"
    return f"{own}, corrected {row.corrected_mm:.4f} mm" if file.correction_ppm else own


def _inputs(sources: Sequence[SourceRow]) -> list[str]:
    rows = [("<input", "u", "<", "<type", "<σ is", "<from")]
    for source in sources:
        sigma = "–" if source.sigma is None else f"{source.sigma:.3g}"
        unit = "" if source.sigma is None else source.unit
        rows.append((source.title, sigma, unit, source.evaluation, source.origin, source.words))
    return text_table(rows)


def _table(title: str, columns: dict[str, Uncertainty], file: BudgetFile) -> list[str]:
    """Returns contributions by input, and combined and expanded uncertainty, with a column for each measurand."""
    rows = [(f"<{title}", *columns)]
    for source in file.sources:
        if source.origin != "not stated" or any(u.contributions[source.key] for u in columns.values()):
            rows.append((source.title, *(f"{u.contributions[source.key]:.2f}" for u in columns.values())))
    k = file.coverage_factor
    rows += [
        ("combined standard uncertainty u", *(f"{u.standard:.2f}" for u in columns.values())),
        (f"expanded uncertainty U, k = {k:g}", *(f"{u.expanded:.2f}" for u in columns.values())),
        ("coverage of U, simulated, %", *(f"{100 * u.coverage:.1f}" for u in columns.values())),
    ]
    return text_table(rows)
