"""The uncertainty budget of a run with its length tests, and its report."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.report.document import (
    Block,
    Document,
    Notes,
    Printed,
    Section,
    Table,
    bullets,
    legend,
    macro,
    page_only,
    plot,
    subheading,
    tiles,
)
from stcal.report.svg import COLOURS, LETTER, SMALL, Axes, Drawing
from stcal.report.text import NONE, WIDTH, number, significant, text_table, wrapped
from stcal.sfm.budget.combine import Budget, budget_of_run
from stcal.sfm.budget.file import BudgetFile, FaceUncertainty, LengthTestPart, SourceRow, Uncertainty, refusals
from stcal.sfm.budget.lengths import LengthTest, against_run, against_stated, common_views
from stcal.sfm.budget.sources import statement_of
from stcal.sfm.runs.saved import AnyRun, saved_run, verify


def verdict_of(test: LengthTestPart) -> str:
    """Returns the verdict of a length test in words."""
    count = len(test.lengths)
    if test.beyond is None:
        return f"not judged: {count} lengths with their errors, without U, which holds of no run that must not be used"
    largest = f"largest |E_n| {number(max(abs(e) for e in _known(test)), 2)}"
    if not test.beyond:
        return f"agrees: all {count} lengths within U, {largest}"
    word = "differs" if not test.agrees else "may agree"
    return (
        f"{word}: {test.beyond} of {count} lengths beyond U, where 1 in 22 is by chance; {largest}, which reaches "
        f"{test.limit:.2f} by chance in one of 22 tests of {count}"
    )


def _in_order(label: str) -> list[tuple[int, str]]:
    """Returns a sort key that takes the numbers in a label as numbers."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", label)]


def _known(test: LengthTestPart) -> list[float]:
    return [np.inf if each.e_n is None else each.e_n for each in test.lengths]


def name_of(circles: Sequence[str]) -> str:
    """Returns the name of a length, made from its ends."""
    return "–".join(circles)


RELATES = (
    "The results relate only to the item named above, in the state in which it was photographed. The certificate may "
    "be reproduced only as a whole."
)
REQUIRED = ("number", "laboratory", "date", "traceability")
"""Fields without which a page is no certificate (ISO/IEC 17025:2017, 7.8.2.1 and 7.8.4.1)."""
HEADS = {"date": "date of calibration"}
"""Names of fields where the key does not say what they are."""
SIGNED = ("date of issue", "name", "signature")
"""Lines that are left empty for whoever signs a certificate."""
LEAST_SHARE = 1e-3
"""Least share of a variance that is drawn."""
MANY = 1e4
EXACT_UM = 1e-6
"""σ below which a value is exact by definition, as that of the frame's own origin is up to rounding, µm or mdeg."""
NEGLIGIBLE = 1e-4
"""Share of u below which a contribution has no sensitivity in the tables."""
IN_OTHERS = 0.05
"""Share of u up to which intrinsics that the photographs determine are told as part of the other rows."""


def budget_report(file: BudgetFile) -> Document:
    """Returns the report of ``budget``: expanded uncertainties, inputs, contributions, and tests of lengths."""
    kinds = _contributions(file)
    measurands = [
        (f"{name}, rotation" if title.startswith("rotations") else name, u)
        for title, columns in kinds.items()
        for name, u in columns.items()
    ]
    images, folder = sum(each.images for each in file.views), Path(file.run.folder).name
    groups = f"{len(file.views)} group{'s' * (len(file.views) != 1)}"
    tone = "failed" if not file.usable else "care" if _is_reserved(file) else "passed"
    hashes = [
        ["folder of the run", folder],
        ["folder of the photographs", Path(file.run.images).name],
        ["SHA-256 of stcal-run.json, which has those of all files", file.run.sha256],
        ["SHA-256 of faces.json", file.run.faces_sha256],
        ["run made by", f"stcal {file.run.version}"],
        ["budget made by", f"stcal {file.version}"],
    ]
    fields = [[HEADS.get(name, name.replace("_", " ")), value or NONE] for name, value in file.fields.items()]
    signature = Table(["<", "<"], [[name, ""] for name in SIGNED], css="text facts")
    return Document(
        title_of(file),
        f"{folder}: {images} photographs in {groups}; faces against face {file.reference_face}, the target frame",
        [
            Section("Result", [*_result(file), *(_shares(file, measurands) if kinds else [])], terminal=True),
            Section("Inputs", _inputs(file), terminal=True),
            Section("Contributions", [_table(title, columns, file) for title, columns in kinds.items()], terminal=True),
            Section(
                "Length test", [block for test in file.length_tests for block in _length_test(test)], terminal=True
            ),
            Section("Circles and corners", _points(file)),
            Section("What is measured", [bullets(file.definitions)]),
            Section(
                "What it rests on",
                [
                    f"The final adjustment was made again from the run's files; σ₀ = {file.sigma0:.3f} with "
                    f"{file.redundancy} degrees of freedom, by which all σ are multiplied: the σ₀ of the run's "
                    "report, but 1 where it is smaller, as small residuals make no σ smaller than stated. The "
                    "covariance of each kind of observation goes through the adjustment's inverse to the circles and "
                    "to the frames of the faces (JCGM 100, 5.1.2); coverage is by 100 000 draws (JCGM 101). Not in "
                    "it: radii of circles and dots, a shift of centres that all views share, and whatever fails a "
                    "check of the run",
                    Table(["<Of", "<"], hashes, css="text facts"),
                ],
            ),
            Section("Signature", [RELATES, signature] if certifies(file) else []),
        ],
        banner=[
            macro("answers", [("May the run be used?", file.use)], tone) if file.use else None,
            Table(["<Field", "<"], fields, css="text facts"),
        ],
    )


def _contributions(file: BudgetFile) -> dict[str, dict[str, Uncertainty]]:
    """Returns the uncertainties by title of their table and name of the measurand."""
    faces = file.faces
    tables = {
        "positions of faces, x, y, z together, µm": {
            f"face {face}": u for face, each in faces.items() if (u := each.position_um)
        },
        "rotations of faces, x, y, z together, mdeg": {
            f"face {face}": each.rotation_mdeg for face, each in faces.items()
        },
        "longest distances, µm": {name_of(each.circles): each.distance_um for each in file.distances},
    }
    return {title: columns for title, columns in tables.items() if columns}


def _result(file: BudgetFile) -> list[Block]:
    """Returns headline, notes, and the tables of positions, rotations and distances with their U."""
    faces, k = file.faces, file.coverage_factor
    lengths = [
        [
            name_of(e.circles),
            *(as_exact(v, 1e-3 * e.distance_um.expanded) for v in (e.length_mm, e.corrected_mm)),
            significant(e.distance_um.expanded),
        ]
        for e in file.distances
    ]
    positions = [
        [face, *_with_u(e.position_mm, e.position_xyz_um, k)]
        for face, e in faces.items()
        if e.position_mm is not None and e.position_xyz_um is not None
    ]
    rotations = [[face, *_with_u(e.rotation_vector_deg, e.rotation_xyz_mdeg, k)] for face, e in faces.items()]
    lacks_statements = _is_valid(file) and not certifies(file)
    return [
        tiles(_headline(file)),
        _what_u_is(file) if faces else None,
        Notes([*([_no_certificate(file)] if lacks_statements else []), *file.notes]),
        Printed([f"May the run be used? {file.use}"] if file.use else []),
        file.holds if file.size_known else None,
        Table(_heads("position of face", "mm", "µm"), positions),
        Table(_heads("rotation vector of face", "°", "mdeg"), rotations),
        Table(["<distance of", "as in faces.json, mm", "corrected for what is stated, mm", "U, µm"], lengths),
    ]


def _inputs(file: BudgetFile) -> list[Block]:
    """Returns the sources, what is stated, and the views."""
    inputs = []
    for each in file.sources:
        sigma = NONE if each.sigma is None else f"{float(f'{each.sigma:.3g}'):g} {each.unit}"
        inputs.append([each.title, sigma, each.evaluation, each.origin, each.words])
    stated = [[each.body, each.key, f"{each.value:g}", each.origin] for each in file.stated]
    views = [[each.group, each.images, number(each.spread_deg, 0)] for each in file.views]
    return [
        page_only(
            "Type A: by statistics of this run; type B: by other knowledge. What is stated comes from the user's "
            "files, what is estimated from this run; what is not stated is taken as exact"
        ),
        Table(["<input", "standard uncertainty", "<type", "<σ is", "<from"], inputs, css="text"),
        subheading("Stated sizes and temperatures") if stated else None,
        page_only(Table(["<of", "<key", "value", "<from"], stated)),
        subheading("Views"),
        page_only(
            "Number and spread of the views act through the sensitivity to centres: µm of the result for each px of "
            "their σ"
        ),
        Table(["<group", "photographs", "largest angle between them, °"], views),
    ]


def _points(file: BudgetFile) -> list[Block]:
    """Returns the places of circles and corners with their U."""
    points = [
        [label, *_with_u(e.position_mm, e.position_xyz_um, file.coverage_factor)]
        for label, e in sorted(file.circles.items(), key=lambda row: _in_order(row[0]))
    ]
    frame = f"In the frame of face {file.reference_face}"
    return [frame, Table(_heads("point", "mm", "µm"), points)] if points else []


MOST_FACES = 5
"""Number of faces that the terminal shows, those with the largest uncertainty."""


def budget_in_brief(file: BudgetFile) -> str:
    """Returns the result in at most fifteen lines; :func:`budget_report` has all."""
    k, images = file.coverage_factor, sum(each.images for each in file.views)
    lines = [f"{Path(file.run.folder).name}: {images} photographs; faces against face {file.reference_face}; k = {k:g}"]
    lines += _cut(f"May the run be used? {file.use}") if file.use else []
    ranked = sorted(file.faces.items(), key=lambda each: -_of_face(each[1]).expanded)
    shown = [(face, each.position_xyz_um or [], each.rotation_xyz_mdeg) for face, each in ranked[:MOST_FACES]]
    rows = [[face, *(" ".join(significant(k * v) for v in each) for each in xyz)] for face, *xyz in shown]
    lines += text_table([["<face", "U of x, y, z, µm", "U of rotation about x, y, z, mdeg"], *rows]) if rows else []
    lines += [f"… and {len(ranked) - MOST_FACES} faces with less"] if len(ranked) > MOST_FACES else []
    for each in file.distances[:1]:
        length = as_exact(each.corrected_mm, 1e-3 * each.distance_um.expanded)
        u = significant(each.distance_um.expanded)
        lines.append(f"longest distance {name_of(each.circles)}: {length} mm, U {u} µm")
    if ranked and (worst := _of_face(ranked[0][1])).standard:
        shares = {row.title: worst.share(row.key) for row in file.sources}
        most = sorted((title for title in shares if shares[title] > IN_OTHERS), key=lambda title: -shares[title])
        lines += _cut(f"from: {', '.join(f'{title} {shares[title]:.0%}' for title in most[:3])}")
    for test in file.length_tests[:1]:
        lines += _cut(f"lengths against {test.reference}: {verdict_of(test)}")
    lines += _cut(_no_certificate(file)) if not certifies(file) and _is_valid(file) else []
    lines += _cut(f"changed since the run: {', '.join(file.run.changed)}") if file.run.changed else []
    return "\n".join([*lines, f"inputs, contributions and {len(file.notes)} notes: -v, or --report FILE.html"])


def _of_face(each: FaceUncertainty) -> Uncertainty:
    """Returns the uncertainty of a face's position, or rotation where no lengths are known."""
    return each.position_um or each.rotation_mdeg


def _cut(text: str) -> list[str]:
    """Returns a sentence in two lines at most."""
    lines = wrapped(text)
    return lines if len(lines) <= 2 else [lines[0], f"{lines[1][: WIDTH - 2]} …"]


def certifies(file: BudgetFile) -> bool:
    """Returns whether the page is a certificate: the run may be used, inputs and required fields are stated."""
    return _is_valid(file) and not _unstated(file) and not _is_reserved(file)


def _is_reserved(file: BudgetFile) -> bool:
    """Returns whether the run's own answer has a reservation, which no certificate can have."""
    return file.use.startswith(("With care", "Part, with care"))


def _is_valid(file: BudgetFile) -> bool:
    """Returns whether sizes are known, and nothing says that the run must not be used."""
    return file.usable and file.size_known and all(test.agrees for test in file.length_tests)


def _unstated(file: BudgetFile) -> list[str]:
    """Returns what a certificate needs and nothing is stated of; faces that need not be flat need no statement."""
    inputs = [row.title for row in file.sources if row.origin == "not stated" and row.key != "flatness"]
    return inputs + [name for name in REQUIRED if not file.fields.get(name, "").strip()]


def _no_certificate(file: BudgetFile) -> str:
    if _is_reserved(file):
        return "this is not a certificate: the run says that it is to be used with care; clear that up, and run again"
    unstated = _unstated(file)
    camera = ", and σ of the intrinsics in the camera file" if "intrinsics" in unstated else ""
    return f"this is not a certificate: nothing is stated of {', '.join(unstated)}; state it with --statement{camera}"


def as_exact(value: float, expanded: float) -> str:
    """Returns a value to the last digit of its expanded uncertainty with two digits (JCGM 100, 7.2.6), at most six."""
    stated = significant(expanded)
    return number(value, min(len(stated.partition(".")[2]), 6) if float(stated) else 4)


def _with_u(values: Sequence[float], sigma: Sequence[float], k: float) -> list[str]:
    """Returns x, y, z and U of each; ``sigma`` : in a thousandth of the unit."""
    expanded = [k * v if v > EXACT_UM else 0.0 for v in sigma]
    return [*(as_exact(v, 1e-3 * u) for v, u in zip(values, expanded, strict=True)), *map(significant, expanded)]


def title_of(file: BudgetFile) -> str:
    """Returns the title, which calls the page a certificate only if it is one."""
    if not certifies(file):
        return f"Uncertainty budget: {file.run.target}"
    number_of_it = file.fields["number"].strip()  # it stands on every page, which has the title at its foot
    return f"Certificate of calibration no. {number_of_it}, with uncertainty budget: {file.run.target}"


def _what_u_is(file: BudgetFile) -> str:
    k = f"{file.coverage_factor:g}"
    return (
        f"The expanded uncertainty U is the combined standard uncertainty multiplied by the coverage factor k = {k}, "
        "which for a normal distribution gives a coverage probability of about 95 % (JCGM 100:2008, GUM). U of x, of y "
        f"or of z is of that axis alone: {k} times its σ in the run and in what is stated. U of a position is "
        f"{k} times the root of the three variances together; a sphere of that radius covers more than 95 %, as the "
        "coverage in the tables says"
    )


def _heads(of: str, unit: str, unit_of_u: str) -> list[str]:
    """Returns the heads of a table of vectors and of their expanded uncertainties."""
    return [f"<{of}", *(f"{axis}, {unit}" for axis in "xyz"), *(f"U of {axis}, {unit_of_u}" for axis in "xyz")]


def _length_test(test: LengthTestPart) -> list[Block]:
    """Returns the verdict of a length test, and its lengths."""
    rows = [
        [
            name_of(length.circles),
            *(number(v, 4) for v in (length.measured_mm, length.reference_mm)),
            number(length.error_um, 2),
            significant(length.expanded_um),
            number(length.e_n, 2),
        ]
        for length in test.lengths
    ]
    return [
        subheading(f"Against {test.reference}"),
        f"length test against {test.reference}: {verdict_of(test)}",
        page_only(
            "The error is the measured less the reference length (length measurement error of VDI/VDE 2634 part 1); U "
            "is that of both, E_n the error over it (ISO 13528)"
        ),
        Notes(test.notes),
        Table(["<length", "measured, mm", "reference, mm", "error, µm", "U, µm", "E_n"], rows),
    ]


def _headline(file: BudgetFile) -> list[tuple[str, str, str]]:
    headline, faces = [], file.faces
    positions = {face: each.position_um for face, each in faces.items() if each.position_um}
    if faces:
        worst = max(faces, key=lambda face: (positions.get(face) or faces[face].rotation_mdeg).expanded)
        if worst in positions:
            caption = f"U of the position of face {worst}, the worst; x, y, z together"
            headline.append((significant(positions[worst].expanded), "µm", caption))
        caption = f"U of the rotation of face {worst}{'' if positions else ', the worst'}; x, y, z together"
        headline.append((significant(faces[worst].rotation_mdeg.expanded), "mdeg", caption))
    if file.distances:
        longest = file.distances[0]
        caption = f"U of the longest distance, {number(longest.corrected_mm, 3)} mm"
        headline.append((significant(longest.distance_um.expanded), "µm", caption))
    if not file.size_known:
        headline.append(("no", "size", "only the shape is known: no lengths and no positions in mm"))
    for test in file.length_tests:
        if test.beyond is not None:
            word, count = verdict_of(test).partition(":")[0], len(test.lengths)
            largest = max(abs(e) for e in _known(test))
            headline.append((number(largest, 2), "", f"largest |E_n| of {count} lengths, {test.reference}: {word}"))
    unknown = sum(source.origin == "not stated" for source in file.sources)
    assumed = sum(source.origin == "assumed" for source in file.sources)
    also = f"; {assumed} assumed" if assumed else ""
    return [*headline, (str(unknown), "", f"of {len(file.sources)} inputs not stated, taken as exact{also}")]


def _table(title: str, columns: dict[str, Uncertainty], file: BudgetFile) -> Table:
    """Returns contributions by input, with the sensitivity of the first measurand, then the sums."""
    unit = title.rpartition(" ")[2]
    heads = [f"<{title}", f"sensitivity, {next(iter(columns))}", *columns]
    rows = []
    first = next(iter(columns.values()))
    for source in file.sources:
        value = _slope(first, source) if source.key in first.sensitivities else 0.0
        slope = f"{value:.3g} {unit}/{source.unit}" if value else "–"
        parts = [number(u.contributions[source.key], 2) for u in columns.values()]
        none = all(u.contributions[source.key] <= IN_OTHERS * u.standard for u in columns.values())
        if (
            source.key == "intrinsics" and source.origin == "estimated" and none
        ):  # what they do is in the rows of the centres, with which they were adjusted
            parts = ["in the other rows"] * len(parts)
        rows.append(
            [source.title, slope, *("–" if source.origin == "not stated" else contribution for contribution in parts)]
        )
    for name, values in (
        ("combined standard uncertainty u", [number(u.standard, 2) for u in columns.values()]),
        (f"expanded uncertainty U, k = {file.coverage_factor:g}", [significant(u.expanded) for u in columns.values()]),
        ("coverage of U, simulated, %", [number(100 * u.coverage, 1) for u in columns.values()]),
        ("effective degrees of freedom", [_freedom(u.degrees_of_freedom) for u in columns.values()]),
    ):
        rows.append([name, "", *values])
    return Table(heads, rows)


def _freedom(degrees: float | None) -> str:
    """Returns degrees of freedom; beyond ten thousand they are as good as infinitely many."""
    return "∞" if degrees is None or degrees > MANY else f"{degrees:.0f}"


def _slope(of: Uncertainty, source: SourceRow) -> float:
    """Returns the sensitivity, or 0 if it contributes nothing that the table shows."""
    share = of.contributions[source.key] / of.standard if of.standard else 0.0
    return of.sensitivities[source.key] if share > NEGLIGIBLE else 0.0


def _shares(file: BudgetFile, measurands: list[tuple[str, Uncertainty]]) -> list[Block]:
    """Returns a figure with stacked shares of the variances, and its legend."""
    shares = {row.key: np.array([u.share(row.key) for _, u in measurands]) for row in file.sources}
    drawn = [row for row in file.sources if shares[row.key].max(initial=0) > LEAST_SHARE]
    colours = {row.key: COLOURS[i % len(COLOURS)] for i, row in enumerate(drawn)}

    def draw() -> Drawing:
        names, place = [name for name, _ in measurands], np.arange(len(measurands))[::-1]
        drawing = Drawing(9.0, 0.6 + 0.24 * len(measurands))
        left = min(20 + LETTER * SMALL * max(map(len, names)), 290)
        axes = Axes(drawing, drawing.panels(left=left, top=4)[0], (0, 100), (-0.6, len(measurands) - 0.4))
        so_far = np.zeros(len(measurands))
        for row in drawn:
            share = 100 * shares[row.key]
            bars = [
                ((a, a + b, a + b, a), (y - 0.35, y - 0.35, y + 0.35, y + 0.35))
                for a, b, y in zip(so_far, share, place, strict=True)
            ]
            axes.lines(bars, fill=colours[row.key])
            so_far += share
        axes.frame("share of the variance, %", y_ticks=(place.tolist(), names))
        return drawing

    return [
        plot(draw, "shares of the variances", "What each input has in the variance of the results"),
        legend({row.title: colours[row.key] for row in drawn}),
    ]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class UncertaintyBudget(Brief):
    """The budget of a run.

    ``budget`` : sources, and the covariance of each measurand by source; ``tests`` : length tests; ``file`` : all of
    it as the JSON file has it; ``refusals`` : why it must not be used, empty if it may.
    """

    budget: Budget
    tests: tuple[LengthTest, ...]
    file: BudgetFile
    refusals: tuple[str, ...]

    def document(self) -> Document:
        """Returns the report, for terminal (``.text()``) and page (``.page()``)."""
        return budget_report(self.file)


@require_arguments
def uncertainty_budget(
    run: AnyRun,
    statement: str | Path | None = None,
    fields: Mapping[str, str] | None = None,
    check_lengths: str | Path | None = None,
    lengths: AnyRun | None = None,
    lengths_statement: str | Path | None = None,
) -> UncertaintyBudget:
    """Returns the uncertainty budget of faces and of the longest distances of a run (GUM), each contribution apart.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    statement : str or Path, optional
        File with temperatures, expansion, the σ of the board's pitch and fields of the head (TOML).
    fields : dict of str, optional
        Fields of the head by name, such as ``{"operator": "A. Smith"}``; they override those of ``statement``.
    check_lengths : str or Path, optional
        File of lengths with which distances between circles are compared (CSV: from, to, length_mm, sigma_mm).
    lengths : str, Path, SavedRun or RunResult, optional
        A second calibration of the target, with which the longest distances are compared.
    lengths_statement : str or Path, optional
        What is stated of that run; ``statement`` if None.

    Returns
    -------
    UncertaintyBudget
        ``file`` has every figure with its unit; ``refusals`` say why the budget must not be used.

    Raises
    ------
    InputError
        The run states no covariance or is damaged, a file is not of the required form, or an argument comes without the
        one that it belongs to.
    """
    if lengths_statement is not None and lengths is None:
        raise InputError(
            "E-OPTION-NEEDS",
            f"--lengths-statement {lengths_statement}: it is for a second calibration; give it with --lengths",
        )
    saved = saved_run(run)
    stated = statement_of(saved.board_design.stated, _path(statement), fields)
    budget, tests, others = budget_of_run(saved, stated), [], []
    if check_lengths is not None:
        tests.append(against_stated(budget, Path(check_lengths)))
    if lengths is not None:
        second = saved_run(lengths)
        others.append(second)
        other = budget_of_run(second, statement_of(second.board_design.stated, _path(lengths_statement or statement)))
        test = against_run(budget, other, second.folder, (saved.board_design, second.board_design))
        tests.append(replace(test, notes=common_views(saved.observations, second.observations) + test.notes))
    file = BudgetFile.of(budget, saved, verify(saved), tests, *others)
    return UncertaintyBudget(budget, tuple(tests), file, tuple(refusals([saved, *others], file.length_tests)))


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
