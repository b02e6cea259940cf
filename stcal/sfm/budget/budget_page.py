"""The uncertainty budget of a run with its length tests, and its report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.report.document import (
    Answer,
    Block,
    Document,
    Notes,
    Section,
    Table,
    bullets,
    page_only,
    subheading,
    tiles,
)
from stcal.report.text import NONE, join, number, significant
from stcal.sfm.budget.budget_file import (
    BudgetFile,
    LengthTest,
    SourceRow,
    Uncertainty,
    against_run,
    against_stated,
    common_views,
    refusals,
)
from stcal.sfm.budget.combine import Budget, budget_of_run, statement_of
from stcal.sfm.runs.saved import AnyRun, saved_run, verify

RELATES = (
    "The results relate only to the item named above, in the state in which it was photographed. The certificate may "
    "be reproduced only as a whole."
)
WHAT_U_IS = (
    "The expanded uncertainty U is the combined standard uncertainty multiplied by the coverage factor k = {k:g}, "
    "which for a normal distribution gives a coverage probability of about 95 % (JCGM 100:2008, GUM). U of x, of y or "
    "of z is of that axis alone; U of a position is {k:g} times the root of the three variances together, with the "
    "coverage that the tables say"
)
METHOD = (
    "The final adjustment was made again from the run's files; σ₀ = {file.sigma0:.3f} with {file.redundancy} degrees "
    "of freedom, by which all σ are multiplied: the σ₀ of the run's report, but 1 where it is smaller. The covariance "
    "of each kind of observation goes through the adjustment's inverse to the circles and to the frames of the faces "
    "(JCGM 100, 5.1.2); coverage is by 100 000 draws (JCGM 101). Not in it: radii of circles and dots, a shift of "
    "centres that all views share, and whatever fails a check of the run"
)
REQUIRED = ("number", "laboratory", "date", "traceability")
"""Fields without which a page is no certificate (ISO/IEC 17025:2017, 7.8.2.1 and 7.8.4.1)."""
SIGNED = ("date of issue", "name", "signature")
"""Lines that are left empty for whoever signs a certificate."""
MANY = 1e4
"""Degrees of freedom that are as good as infinitely many."""
EXACT_UM = 1e-6
"""σ below which a value is exact by definition, as that of the frame's own origin is up to rounding, µm or mdeg."""
NEGLIGIBLE = 1e-4
"""Share of u below which a contribution has no sensitivity in the tables."""
LIMITS = 0.05
"""Share of the variance above which a source is among those that limit a result."""


def budget_report(file: BudgetFile) -> Document:
    """Returns the report of ``budget``: expanded uncertainties, inputs, contributions, and tests of lengths."""
    hashes = [
        ["folder of the run", Path(file.run.folder).name],
        ["folder of the photographs", Path(file.run.images).name],
        ["SHA-256 of stcal-run.json, which has those of all files", file.run.sha256],
        ["SHA-256 of faces.json", file.run.faces_sha256],
        ["run made by", f"stcal {file.run.version}"],
        ["budget made by", f"stcal {file.version}"],
    ]
    heads = {name: name.replace("_", " ") for name in file.fields} | {"date": "date of calibration"}
    fields = [[heads[name], value or NONE] for name, value in file.fields.items()]
    points = [[label, *_with_u(e.position_mm, e.position_xyz_um, file)] for label, e in file.circles.items()]
    tests = [block for test in file.length_tests for block in _length_test(test)]
    frame = f"In the frame of face {file.reference_face}" if points else ""
    return Document(
        title_of(file),
        _about(file),
        [
            Section("Result", _result(file), terminal=True),
            Section("Inputs", _inputs(file), terminal=True),
            Section("Contributions", _contributions(file), terminal=True),
            Section("Length test", tests, terminal=True),
            Section("Circles and corners", [frame, Table(_heads("point", "mm", "µm"), points)]),
            Section("What is measured", [bullets(file.definitions)]),
            Section("What it rests on", [METHOD.format(file=file), _facts(hashes)]),
            Section("Signature", [RELATES, _facts([[name, ""] for name in SIGNED])] if certifies(file) else []),
        ],
        banner=[_answer(file), _facts(fields)],
    )


def _facts(rows: list[list[str]]) -> Table:
    return Table(["<Of", "<"], rows, css="text facts")


def budget_in_brief(file: BudgetFile) -> str:
    """Returns the result in at most fifteen lines; :func:`budget_report` has all."""
    tests = [f"lengths against {test.reference}: {test.verdict}" for test in file.length_tests]
    lines = [
        _about(file),
        *_answer(file).lines(),
        *(f"{value} {unit}: {words}".replace(" :", ":") for value, unit, words in _headline(file)),
        *tests,
        _no_certificate(file),
        f"changed since the run: {join(file.run.changed)}" if file.run.changed else "",
        f"inputs, contributions and {len(file.notes)} notes: -v, or --report FILE.html",
    ]
    return "\n".join(filter(None, lines))


def _answer(file: BudgetFile) -> Answer:
    word = "no" if not file.usable else "with care" if file.reserved else "yes"
    return Answer(word, question="May the run be used?", said=file.use)


def _about(file: BudgetFile) -> str:
    groups = f"{len(file.views)} group{'s' * (len(file.views) != 1)}"
    return (
        f"{Path(file.run.folder).name}: {sum(each.images for each in file.views)} photographs in {groups}; faces "
        f"against face {file.reference_face}, the target frame"
    )


def _headline(file: BudgetFile) -> list[tuple[str, str, str]]:
    """Returns (value, unit, what it is) of the worst face and what limits it, the longest distance, and inputs."""
    headline, together = [], "x, y, z together"
    if file.faces:
        name, worst = max(file.faces.items(), key=lambda each: (each[1].position_um or each[1].rotation_mdeg).expanded)
        if worst.position_um:
            value = significant(worst.position_um.expanded)
            headline.append((value, "µm", f"U of the position of face {name}, the worst; {together}"))
        value, which = significant(worst.rotation_mdeg.expanded), "" if worst.position_um else ", the worst"
        headline.append((value, "mdeg", f"U of the rotation of face {name}{which}; {together}"))
        shares = {row.title: (worst.position_um or worst.rotation_mdeg).share(row.key) for row in file.sources}
        first, *more = sorted(shares, key=lambda title: -shares[title])
        then = "".join(f", {shares[title]:.0%} from {title}" for title in more[:2] if shares[title] > LIMITS)
        headline.append((f"{100 * shares[first]:.0f}", "%", f"of the variance of face {name} is from {first}{then}"))
    for each in file.distances[:1]:
        length = as_exact(each.corrected_mm, 1e-3 * each.distance_um.expanded)
        ends = "–".join(each.circles)
        headline.append(
            (significant(each.distance_um.expanded), "µm", f"U of the longest distance {ends}, {length} mm")
        )
    if not file.size_known:
        headline.append(("no", "size", "only the shape is known: no lengths and no positions in mm"))
    unknown, assumed = (sum(each.origin == origin for each in file.sources) for origin in ("not stated", "assumed"))
    also = f"; {assumed} assumed" if assumed else ""
    return [*headline, (str(unknown), "", f"of {len(file.sources)} inputs not stated, taken as exact{also}")]


def _result(file: BudgetFile) -> list[Block]:
    """Returns headline, notes, and the tables of positions, rotations and distances with their U."""
    lengths = [
        [
            "–".join(own.circles),
            *(as_exact(v, 1e-3 * own.distance_um.expanded) for v in (own.length_mm, own.corrected_mm)),
            significant(own.distance_um.expanded),
        ]
        for own in file.distances
    ]
    positions = [
        [face, *_with_u(e.position_mm, e.position_um.axes, file)]
        for face, e in file.faces.items()
        if e.position_mm is not None and e.position_um is not None
    ]
    rotations = [[face, *_with_u(e.rotation_vector_deg, e.rotation_mdeg.axes, file)] for face, e in file.faces.items()]
    tests = [("", "", f"{test.reference}: {test.verdict}") for test in file.length_tests if test.beyond is not None]
    return [
        tiles(_headline(file) + tests),
        WHAT_U_IS.format(k=file.coverage_factor) if file.faces else None,
        Notes([*filter(None, [_no_certificate(file)]), *file.notes]),
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
        Table(["<group", "photographs", "largest angle between them, °"], views),
    ]


def _contributions(file: BudgetFile) -> list[Block]:
    """Returns the table of contributions of each kind of measurands."""
    faces = file.faces
    positions = {f"face {face}": u for face, each in faces.items() if (u := each.position_um)}
    rotations = {f"face {face}": each.rotation_mdeg for face, each in faces.items()}
    distances = {"–".join(each.circles): each.distance_um for each in file.distances}
    kinds = (
        ("positions of faces, x, y, z together", "µm", positions),
        ("rotations of faces, x, y, z together", "mdeg", rotations),
        ("longest distances", "µm", distances),
    )
    return [
        Table(
            [f"<{title}, {unit}", f"sensitivity, {next(iter(columns))}", *columns],
            [
                *(_source_row(source, unit, columns) for source in file.sources),
                ["combined standard uncertainty u", "", *(number(u.standard, 2) for u in columns.values())],
                [f"expanded uncertainty U, k = {file.coverage_factor:g}", "",
                 *(significant(u.expanded) for u in columns.values())],
                ["coverage of U, simulated, %", "", *(number(100 * u.coverage, 1) for u in columns.values())],
                ["effective degrees of freedom", "",
                 *(f"{u.degrees_of_freedom:.0f}" if (u.degrees_of_freedom or MANY) < MANY else "∞"
                   for u in columns.values())],
            ],
        )
        for title, unit, columns in kinds
        if columns
    ]  # fmt: skip


def _source_row(source: SourceRow, unit: str, columns: dict[str, Uncertainty]) -> list[str]:
    """Returns the contributions of an input, with the sensitivity of the first measurand."""
    own = [u.contributions[source.key] for u in columns.values()]
    first, slope = next(iter(columns.values())), NONE
    if source.sigma and first.standard and own[0] / first.standard > NEGLIGIBLE:
        slope = f"{own[0] / source.sigma:.3g} {unit}/{source.unit}"
    return [source.title, slope, *(NONE if source.origin == "not stated" else number(part, 2) for part in own)]


def _length_test(test: LengthTest) -> list[Block]:
    """Returns the verdict of a length test, and its lengths."""
    rows = [
        ["–".join(own.circles), number(own.measured_mm, 4), number(own.reference_mm, 4), number(own.error_um, 2),
         significant(own.expanded_um), number(own.e_n, 2)]
        for own in test.lengths
    ]  # fmt: skip
    return [
        subheading(f"Against {test.reference}"),
        f"length test against {test.reference}: {test.verdict}",
        page_only(
            "The error is the measured less the reference length (length measurement error of VDI/VDE 2634 part 1); U "
            "is that of both, E_n the error over it (ISO 13528)"
        ),
        Notes(test.notes),
        Table(["<length", "measured, mm", "reference, mm", "error, µm", "U, µm", "E_n"], rows),
    ]


def certifies(file: BudgetFile) -> bool:
    """Returns whether the page is a certificate: the run may be used, inputs and required fields are stated."""
    return not _no_certificate(file) and _is_valid(file)


def _is_valid(file: BudgetFile) -> bool:
    """Returns whether sizes are known, and nothing says that the run must not be used."""
    return file.usable and file.size_known and all(test.agrees for test in file.length_tests)


def _no_certificate(file: BudgetFile) -> str:
    """Returns why a valid budget is no certificate; empty if it is one. Faces that need not be flat need no
    statement."""
    if not _is_valid(file):
        return ""
    if file.reserved:
        return "this is not a certificate: the run says that it is to be used with care; clear that up, and run again"
    unstated = [row.title for row in file.sources if row.origin == "not stated" and row.key != "flatness"]
    unstated += [name for name in REQUIRED if not file.fields.get(name, "").strip()]
    camera = ", and σ of the intrinsics in the camera file" if "intrinsics" in unstated else ""
    remedy = f"this is not a certificate: nothing is stated of {join(unstated)}; state it with --statement{camera}"
    return remedy if unstated else ""


def title_of(file: BudgetFile) -> str:
    """Returns the title, which calls the page a certificate only if it is one; it stands at the foot of every page."""
    if not certifies(file):
        return f"Uncertainty budget: {file.run.target}"
    return f"Certificate of calibration no. {file.fields['number'].strip()}, with uncertainty budget: {file.run.target}"


def as_exact(value: float, expanded: float) -> str:
    """Returns a value to the last digit of its expanded uncertainty with two digits (JCGM 100, 7.2.6), at most six."""
    stated = significant(expanded)
    return number(value, min(len(stated.partition(".")[2]), 6) if float(stated) else 4)


def _with_u(values: Sequence[float], sigma: Sequence[float], file: BudgetFile) -> list[str]:
    """Returns x, y, z and U of each; ``sigma`` : in a thousandth of the unit."""
    expanded = [file.coverage_factor * v if v > EXACT_UM else 0.0 for v in sigma]
    return [*(as_exact(v, 1e-3 * u) for v, u in zip(values, expanded, strict=True)), *map(significant, expanded)]


def _heads(of: str, unit: str, unit_of_u: str) -> list[str]:
    """Returns the heads of a table of vectors and of their expanded uncertainties."""
    return [f"<{of}", *(f"{axis}, {unit}" for axis in "xyz"), *(f"U of {axis}, {unit_of_u}" for axis in "xyz")]


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
    stated = statement_of(saved.board_design.stated, statement, fields)
    budget, tests, others = budget_of_run(saved, stated), [], []
    if check_lengths is not None:
        tests.append(against_stated(budget, Path(check_lengths)))
    if lengths is not None:
        second = saved_run(lengths)
        others.append(second)
        other = budget_of_run(second, statement_of(second.board_design.stated, lengths_statement or statement))
        test = against_run(budget, other, second.folder, (saved.board_design, second.board_design))
        tests.append(replace(test, notes=common_views(saved.observations, second.observations) + test.notes))
    file = BudgetFile.of(budget, saved, verify(saved), tests, *others)
    return UncertaintyBudget(budget, tuple(tests), file, tuple(refusals([saved, *others], file.length_tests)))
