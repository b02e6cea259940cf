"""The budget as a page for a laboratory's file, and for print."""

import numpy as np

from stcal.report.figure import COLOURS, INK, SMALL, calm, new_figure, uri
from stcal.report.page import render, swatch
from stcal.report.text import number
from stcal.sfm.budget.file import BudgetFile, SourceRow, Uncertainty
from stcal.sfm.budget.text import name_of, verdict_of

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
