"""The uncertainty budget of a run with its length tests, and its report."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.report.document import Answer, Block, Document, Notes, Section, Table, bullets, page_only, subheading, tiles
from stcal.report.text import join, number, significant, wrapped
from stcal.sfm.budget import budget_tables as tables
from stcal.sfm.budget.budget_file import BudgetFile, LengthTest, against_run, against_stated, common_views, refusals
from stcal.sfm.budget.certificate import REQUIRED, certificate
from stcal.sfm.budget.combine import FIELDS, Budget, budget_of_run, statement_of
from stcal.sfm.runs.saved import AnyRun, saved_run
from stcal.sfm.runs.transaction import verify

TOGETHER = "x, y, z together"
LIMITS = 0.05  # share of the variance above which a source is among those that limit a result


def budget_report(file: BudgetFile) -> Document:
    """Returns the report of ``budget``: a certificate if all is stated, else the budget alone, with what is missing."""
    if certifies(file):
        return certificate(file)
    given = [[FIELDS.get(name, name), value] for name, value in file.fields.items() if value and name != "number"]
    tests = [block for test in file.length_tests for block in [*tables.length_test(test), Notes(test.notes)]]
    rests = [tables.method(file), "whatever fails a check of the run is not in it", tables.hashes(file)]
    return Document(
        f"Uncertainty budget: {file.run.target}",
        _about(file),
        [
            Section("Result", _result(file), terminal=True),
            Section("Inputs", _inputs(file), terminal=True),
            Section("Contributions", tables.contributions(file), terminal=True),
            Section("Length test", tests, terminal=True),
            Section("What is measured", [bullets(file.definitions)]),
            Section("What it rests on", rests),
        ],
        banner=[_answer(file), tables.facts(given)],
    )


def budget_in_brief(file: BudgetFile, page: bool) -> str:
    """Returns the result in at most fifteen lines; :func:`budget_report` has all. ``page`` : whether it is written."""
    tests = [f"lengths against {test.reference}: {test.verdict}" for test in file.length_tests]
    offered = certifies(file) and not page
    lines = [
        _about(file),
        *_answer(file).lines(),
        *(f"{value} {unit}: {words}".replace(" :", ":") for value, unit, words in _headline(file)),
        *tests,
        _no_certificate(file, brief=True) or "--report FILE.html writes a certificate of calibration" * offered,
        f"changed since the run: {join(file.run.changed)}" if file.run.changed else "",
        "" if page else f"inputs, contributions{'' if certifies(file) else ' and notes'}: -v, or --report FILE.html",
    ]
    return "\n".join(part for line in filter(None, lines) for part in wrapped(line))


def _answer(file: BudgetFile) -> Answer:
    return Answer(file.verdict, question="May the run be used?", said=file.use)


def _about(file: BudgetFile) -> str:
    groups = f"{len(file.views)} group{'s' * (len(file.views) != 1)}"
    photographs = f"{sum(each.images for each in file.views)} photographs in {groups}"
    faces = f"faces against face {file.reference_face}, the target frame"
    return f"{Path(file.run.folder).name}: {photographs}; {faces}"


def _headline(file: BudgetFile) -> Iterator[tuple[str, str, str]]:
    """Yields (value, unit, what it is) of the worst face and what limits it, the longest distance, and inputs."""
    if file.faces:
        name, worst = max(file.faces.items(), key=lambda each: (each[1].position_um or each[1].rotation_mdeg).expanded)
        if position := worst.position_um:
            yield significant(position.expanded), "µm", f"U of the position of face {name}, the worst; {TOGETHER}"
        turned, most = max(file.faces.items(), key=lambda each: each[1].rotation_mdeg.expanded)
        value = significant(most.rotation_mdeg.expanded)
        yield value, "mdeg", f"U of the rotation of face {turned}, the worst; {TOGETHER}"
        shares = {row.title: (position or worst.rotation_mdeg).share(row.key) for row in file.sources}
        first, *more = sorted(shares, key=lambda title: -shares[title])
        then = "".join(f", {100 * shares[title]:.0f} % from {title}" for title in more[:2] if shares[title] > LIMITS)
        yield f"{100 * shares[first]:.0f}", "%", f"of the variance of face {name} is from {first}{then}"
    for each in file.distances[:1]:
        length = tables.as_exact(each.corrected_mm, 1e-3 * each.distance_um.expanded)
        ends = "–".join(each.circles)
        yield significant(each.distance_um.expanded), "µm", f"U of the longest distance {ends}, {length} mm"
    if not file.size_known:
        yield "no", "size", "only the shape is known: no lengths and no positions in mm"
    unknown, assumed = (sum(each.origin == origin for each in file.sources) for origin in ("not stated", "assumed"))
    also = f"; {assumed} assumed" if assumed else ""
    yield str(unknown), "", f"of {len(file.sources)} inputs not stated, taken as exact{also}"


def _result(file: BudgetFile) -> list[Block]:
    """Returns headline, notes, and the tables of results with their U."""
    tests = [("", "", f"{test.reference}: {test.verdict}") for test in file.length_tests if test.beyond is not None]
    return [
        tiles([*_headline(file), *tests]),
        tables.what_u_is(file),
        Notes([*filter(None, [_no_certificate(file)]), *file.notes]),
        file.holds if file.size_known else None,
        *tables.results(file),
    ]


def _inputs(file: BudgetFile) -> list[Block]:
    """Returns the sources, what is stated, and the views."""
    stated = [[each.body, each.key, f"{each.value:g}", each.origin] for each in file.stated]
    views = [[each.group, each.images, number(each.spread_deg, 0)] for each in file.views]
    return [
        page_only(
            "Type A: by statistics of this run; type B: by other knowledge. What is stated comes from the user's "
            "files, what is estimated from this run; what is not stated is taken as exact"
        ),
        tables.inputs(file, words=True),
        subheading("Stated sizes and temperatures") if stated else None,
        page_only(Table(["<of", "<key", "value", "<from"], stated)),
        subheading("Views"),
        Table(["<group", "photographs", "largest angle between them, °"], views),
    ]


def certifies(file: BudgetFile) -> bool:
    """Returns whether the page is a certificate: the run may be used, inputs and required fields are stated."""
    return not _no_certificate(file) and _is_valid(file)


def _is_valid(file: BudgetFile) -> bool:
    """Returns whether sizes are known, and nothing says that the run must not be used."""
    return file.usable and file.size_known and all(test.agrees for test in file.length_tests)


def _no_certificate(file: BudgetFile, brief: bool = False) -> str:
    """Returns why a valid budget is no certificate, ``brief`` without keys; empty if it is one."""
    if not _is_valid(file):
        return ""
    if file.reserved:
        return "this is not a certificate: the run says that it is to be used with care; clear that up, and run again"
    missing = [row for row in file.sources if row.origin == "not stated" and row.key != "flatness"]
    unstated = [row.title if brief else f"{row.title} ({row.words})" for row in missing]
    unstated += [name for name in REQUIRED if not file.fields.get(name, "").strip()]
    without = any(row.key == "intrinsics" for row in missing)
    camera = ", and σ of the intrinsics in the camera file" if without else ""
    remedy = f"this is not a certificate: nothing is stated of {join(unstated)}; state it with --statement{camera}"
    return remedy if unstated else ""


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
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    statement : File with temperatures, expansion, the σ of the board's pitch and fields of the head (TOML).
    fields : Fields of the head by name, such as ``{"operator": "A. Smith"}``; they override those of ``statement``.
    check_lengths : str or Path, optional
        File of lengths with which distances between circles are compared (CSV: from, to, length_mm, sigma_mm).
    lengths : A second calibration of the target, with which the longest distances are compared.
    lengths_statement : What is stated of that run; ``statement`` if None.

    Returns
    -------
    UncertaintyBudget : ``file`` has every figure with its unit; ``refusals`` say why the budget must not be used.

    Raises
    ------
    InputError
        The run states no covariance or is damaged, a file is not of the required form, or an argument comes without the
        one that it belongs to.
    """
    if lengths_statement is not None and lengths is None:
        fault = f"--lengths-statement {lengths_statement}: it is for a second calibration"
        raise InputError("E-OPTION-NEEDS", f"{fault}; give it with --lengths")
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
    file = BudgetFile.of(budget, saved, verify(saved.folder), tests, *others)
    return UncertaintyBudget(budget, tuple(tests), file, tuple(refusals([saved, *others], file.length_tests)))
