"""Text and page of an uncertainty budget."""

from collections.abc import Sequence

import numpy as np

from stcal.report.figure import COLOURS, INK, SMALL, calm, new_figure, uri
from stcal.report.page import render, swatch
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
        lines += ["", *_text_table(title, columns, file)]
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


def _text_table(title: str, columns: dict[str, Uncertainty], file: BudgetFile) -> list[str]:
    """Returns contributions by input, and combined and expanded uncertainty, with a column for each measurand."""
    if not columns:
        return [f"{title}: none is given, see the first note"]
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


LEAST_SHARE = 1e-3
"""Least share of a variance that is drawn."""
ROUNDING = 1e-6
"""Ratio to u below which a contribution is rounding error alone."""


def budget_page(file: BudgetFile) -> str:
    """Returns a self-contained HTML page of the budget."""
    faces, k = file.faces, file.coverage_factor
    kinds = [
        ("Positions of faces", "µm", {f"face {f}": each.position_um for f, each in faces.items()}),
        ("Rotations of faces", "mdeg", {f"face {f}": each.rotation_mdeg for f, each in faces.items()}),
        ("Longest distances", "µm", {name_of(each.circles): each.distance_um for each in file.distances}),
    ]
    worst = max(faces, key=lambda face: faces[face].position_um.expanded) if faces else None
    return render(
        "sfm/budget/page.html.jinja",
        file=file,
        images=sum(each.images for each in file.views),
        k=f"{k:g}",
        headline=_headline(file, worst),
        fields=[[name, value or "–"] for name, value in file.fields.items()],
        hashes=[
            ["folder of the run", file.run.folder],
            ["photographs", file.run.images],
            ["SHA-256 of stcal-run.json, which has those of all files", file.run.sha256],
            ["SHA-256 of faces.json", file.run.faces_sha256],
            ["run made by", f"stcal {file.run.version}"],
            ["budget made by", f"stcal {file.version}"],
        ],
        views=[[each.group, each.images, number(each.spread_deg, 0)] for each in file.views],
        inputs=[_input(each) for each in file.sources],
        stated=[[each.body, each.key, f"{each.value:g}", each.origin] for each in file.stated],
        kinds=[(title, unit, *_table(columns, file, unit)) for title, unit, columns in kinds if columns],
        shares=_shares(file, [(name, u) for _, _, columns in kinds for name, u in columns.items()]),
        lengths=[
            [name_of(each.circles), number(each.length_mm, 4), number(each.corrected_mm, 4),
             number(each.distance_um.expanded, 2)]
            for each in file.distances
        ],
        tests=[(test, verdict_of(test), _lengths(test)) for test in file.length_tests],
    )  # fmt: skip


def _headline(file: BudgetFile, worst: str | None) -> list[tuple[str, str, str]]:
    tiles = []
    if worst is not None:
        worst_face = file.faces[worst]
        tiles = [
            (number(worst_face.position_um.expanded, 1), "µm", f"U of the position of face {worst}, the worst"),
            (number(worst_face.rotation_mdeg.expanded, 1), "mdeg", f"U of the rotation of face {worst}"),
        ]
    if file.distances:
        longest = file.distances[0]
        caption = f"U of the longest distance, {number(longest.corrected_mm, 3)} mm"
        tiles.append((number(longest.distance_um.expanded, 1), "µm", caption))
    unknown = sum(source.origin == "not stated" for source in file.sources)
    return [*tiles, (str(unknown), "", f"of {len(file.sources)} inputs not stated, taken as exact")]


def _input(each: SourceRow) -> list[str]:
    sigma = "–" if each.sigma is None else f"{each.sigma:.3g} {each.unit}"
    return [each.title, sigma, each.evaluation, each.origin, each.words]


def _table(columns: dict[str, Uncertainty], file: BudgetFile, unit: str) -> tuple[list[str], list[list[str]]]:
    """Returns heads and rows: contributions by input, with the sensitivity of the first measurand, then the sums."""
    heads = ["<Contribution to u", f"sensitivity, {next(iter(columns))}", *columns]
    rows = []
    first = next(iter(columns.values()))
    for source in file.sources:
        slope = f"{_slope(first, source):.3g} {unit}/{source.unit}" if source.key in first.sensitivities else "–"
        parts = [number(u.contributions[source.key], 2) for u in columns.values()]
        rows.append(
            [source.title, slope, *("–" if source.origin == "not stated" else contribution for contribution in parts)]
        )
    for title, values in (
        ("combined standard uncertainty u", [number(u.standard, 2) for u in columns.values()]),
        (f"expanded uncertainty U, k = {file.coverage_factor:g}", [number(u.expanded, 2) for u in columns.values()]),
        ("coverage of U, simulated, %", [number(100 * u.coverage, 1) for u in columns.values()]),
        (
            "effective degrees of freedom",
            ["∞" if u.degrees_of_freedom is None else f"{u.degrees_of_freedom:.0f}" for u in columns.values()],
        ),
    ):
        rows.append([title, "", *values])
    return heads, rows


def _slope(of: Uncertainty, source: SourceRow) -> float:
    """Returns the sensitivity, or 0 if it is rounding error alone."""
    share = of.contributions[source.key] / of.standard if of.standard else 0.0
    return of.sensitivities[source.key] if share > ROUNDING else 0.0


def _shares(file: BudgetFile, measurands: list[tuple[str, Uncertainty]]) -> tuple[str, list]:
    """Returns a figure with stacked shares of the variances, and its legend."""
    shares = {
        row.key: np.array([(u.contributions[row.key] / u.standard) ** 2 if u.standard else 0 for _, u in measurands])
        for row in file.sources
    }
    drawn = [row for row in file.sources if shares[row.key].max(initial=0) > LEAST_SHARE]
    figure = new_figure(9.0, 0.6 + 0.24 * len(measurands))
    axes = figure.subplots()
    drawn_so_far, place = np.zeros(len(measurands)), np.arange(len(measurands))[::-1]
    legend = []
    for i, row in enumerate(drawn):
        colour = COLOURS[i % len(COLOURS)]
        axes.barh(place, 100 * shares[row.key], left=100 * drawn_so_far, height=0.7, color=colour)
        drawn_so_far += shares[row.key]
        legend.append(swatch(row.title, colour))
    names = [name for name, _ in measurands]
    rotations = {i for i, (_, u) in enumerate(measurands) if any(u is row.rotation_mdeg for row in file.faces.values())}
    axes.set_yticks(place, [f"{name}, rotation" if i in rotations else name for i, name in enumerate(names)])
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of the variance, %", fontsize=SMALL + 0.5, color=INK)
    calm(axes)
    return uri(figure), legend


def _lengths(test) -> list[list[str]]:
    return [
        [
            name_of(length.circles),
            number(length.measured_mm, 4),
            number(length.reference_mm, 4),
            number(length.error_um, 2),
            number(length.expanded_um, 2),
            number(length.e_n, 2),
        ]
        for length in test.lengths
    ]
