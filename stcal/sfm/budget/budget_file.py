"""Form of the JSON file of ``budget``, which its page and PDF show too, and the length test in it: distances between
circles against stated lengths, or against a second calibration.

Terms of the length test are those of VDI/VDE 2634 part 1 and ISO 10360; E_n is of ISO 13528:2022, 9.7, at most 1 where
both agree."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from pydantic import Field, TypeAdapter
from scipy.special import ndtri

import stcal
from stcal.design import BoardDesign, FaceDesign, StatedSize
from stcal.errors import InputError
from stcal.io.files import RUN_MARKER, digest_of
from stcal.io.json import ByName, Finite, Part, ResultFile
from stcal.io.table import LENGTHS, read_table
from stcal.report.text import join, number
from stcal.sfm.budget import combine
from stcal.sfm.budget.combine import FIELDS, Budget, GroupViews, Kind, Measurand, Origin, Statement, Uncertainty
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.report.check import invalidated
from stcal.sfm.report.judgement import Judgement, Use, judgement_of
from stcal.sfm.runs.saved import SavedRun
from stcal.sfm.runs.transaction import Verified

SHARED = ("board_pitch", "board_expansion", "target_expansion")
"""Sources whose errors two calibrations of one target with one board share: they scale all lengths by one factor."""


@dataclass(frozen=True, slots=True)
class TestedLength:
    """A measured length against a reference; U of their difference, and E_n with its sign, None where none holds."""

    circles: tuple[str, ...]
    measured_mm: float
    reference_mm: float
    error_um: float
    expanded_um: float | None
    e_n: Finite  # infinite if both lengths are exact and differ


@dataclass(frozen=True, slots=True)
class LengthTest:
    """A length test. ``reference`` : what the lengths are compared with; ``notes`` : what the test cannot detect."""

    reference: str
    lengths: list[TestedLength]
    largest_e_n: Finite
    beyond: int | None
    limit: float
    agrees: bool | None
    verdict: str
    notes: tuple[str, ...]

    @classmethod
    def of(cls, reference: str, lengths: Sequence[TestedLength], notes: tuple[str, ...]) -> "LengthTest":
        """Returns the test. The limit of the largest E_n is 1 for one length, more for many (Bonferroni)."""
        count, e_n = len(lengths), [abs(length.e_n) for length in lengths if length.e_n is not None]
        limit = float(-ndtri(combine.BY_CHANCE / 2 / count) / combine.COVERAGE_FACTOR)
        if not e_n:
            verdict = f"not judged: {count} lengths with their errors, without U, which a run not to be used has not"
            return cls(reference, list(lengths), None, None, limit, None, verdict, notes)
        largest, beyond = max(e_n), sum(each > 1 for each in e_n)
        agrees = largest <= limit * (1 + 1e-9)
        verdict = f"agrees: all {count} lengths within U, largest |E_n| {number(largest, 2)}"
        if beyond:
            how_many = f"{beyond} of {count} lengths beyond U, where 1 in 22 is by chance"
            reaches = f"which reaches {limit:.2f} by chance in one of 22 tests of {count}"
            word = "may agree" if agrees else "differs"
            verdict = f"{word}: {how_many}; largest |E_n| {number(largest, 2)}, {reaches}"
        return cls(reference, list(lengths), largest, beyond, limit, agrees, verdict, notes)


def against_stated(budget: Budget, path: Path) -> LengthTest:
    """Tests the run against a CSV of ``from``, ``to`` (``face:circle``), ``length_mm`` and perhaps ``sigma_mm``."""
    _require_size(budget)
    table = read_table(path, "lengths")
    ends = list(zip(table.text("from"), table.text("to"), strict=True))
    length = table.quantity("length", LENGTHS)
    known = table.has("sigma", LENGTHS)
    sigma = table.quantity("sigma", LENGTHS) if known else np.zeros(len(length))
    tested, places = [], {str(label): i for i, label in enumerate(budget.joint.labels)}
    for line, (a, b), value, sigma_mm in zip(table.lines, ends, length, sigma, strict=True):
        where = f"{table.where}: line {line}"
        if unknown := {a, b} - places.keys():
            fault = f"{where}: no circle {min(unknown)} in the run"
            raise InputError("E-BUDGET-LENGTHS", f"{fault}; give one such as {budget.joint.labels[0]}")
        if a == b or value <= 0 or sigma_mm < 0:
            fault = f"{where}: {a} to {b}, {value:g} ± {sigma_mm:g} mm"
            raise InputError("E-BUDGET-LENGTHS", f"{fault}; a length between two circles needed, and a σ of 0 or more")
        own = _corrected(budget, (places[a], places[b]))
        tested.append(_tested((a, b), own, (float(value), float(sigma_mm) ** 2, 0.0)))
    notes = () if known else (f"{path} states no sigma_mm: its lengths are taken as exact",)
    if budget.conditions.temperature_c != combine.reference_temperature_c(budget.statement.target):
        needed = f"{path} must state lengths for the temperature at which the target was photographed"
        notes += (f"{needed}: those of the run are not corrected to another",)
    return LengthTest.of(str(path), tested, notes)


def against_run(budget: Budget, other: Budget, folder: Path, boards: Sequence[BoardDesign]) -> LengthTest:
    """Tests the longest distances between circles that two calibrations of the same target share."""
    _require_size(budget)
    _require_size(other)
    common = [label for label in budget.joint.labels if label in set(other.joint.labels)]
    rows, other_rows = ([each.joint.labels.index(label) for label in common] for each in (budget, other))
    pairs = combine.longest_of(common, budget.joint.xyz_model[rows])
    if not pairs:
        fault = f"run {folder}: {len(common)} circles in common, 2 needed"
        raise InputError("E-BUDGET-LENGTHS", f"{fault}; give a run of the same target")
    # The two runs may have used one board.
    same = len({(board.rows, board.columns, board.pitch_mm, board.corner) for board in boards}) == 1
    shared = SHARED if same else ("target_expansion",)
    tested = []
    for i, j in pairs:
        reference = _corrected(other, (other_rows[i], other_rows[j]), shared)
        tested.append(_tested((common[i], common[j]), _corrected(budget, (rows[i], rows[j]), shared), reference))
    note = (
        "both calibrations rest on boards of the same description: if it is one board, what its pitch and expansion "
        "are off is in both alike, cannot be seen here, and is not in U of the differences; a length from elsewhere "
        "(--check-lengths) shows it"
    )
    notes = (note,) if same else ()
    if budget.conditions.temperature_c != other.conditions.temperature_c:
        remedy = "state expansion and temperature of board and target for both"
        notes += (f"the lengths of the two calibrations hold at different temperatures; {remedy}",)
    return LengthTest.of(str(folder), tested, notes)


SAME_VIEW_PX = 0.2
"""Median distance of equal circles below which two photographs are of one view: no hand comes back to it."""


def common_views(first: Sequence[ImageObservations], second: Sequence[ImageObservations]) -> tuple[str, ...]:
    """Returns a note on photographs of which both runs have the same view; none if there are none."""
    common = sum(any(_same_view(image, other) for other in second) for image in first)
    same = f"{common} of {len(first)} photographs have the same view in the other run, to {SAME_VIEW_PX} px"
    why = "the two calibrations are not independent, and what both have wrong cannot be seen here"
    return (f"{same}: {why}; compare with a run of other photographs",) if common else ()


def _same_view(image: ImageObservations, other: ImageObservations) -> bool:
    place = {label: i for i, label in enumerate(other.labels)}
    rows = [(i, place[label]) for i, label in enumerate(image.labels) if label in place]
    if 2 * len(rows) <= max(len(image), len(other)):
        return False
    own, others = np.array(rows).T
    apart = np.linalg.norm(image.centre_px[own] - other.centre_px[others], axis=1)
    return bool(np.median(apart) < SAME_VIEW_PX)


def _require_size(budget: Budget) -> None:
    if not budget.conditions.size_known:
        fault = "a run saw nothing of known size, so that only its shape is known and its lengths cannot be compared"
        remedy = "state one of the lengths with [[scale]] in target.toml, and run again"
        raise InputError("E-BUDGET-NO-SIZE", f"{fault}; {remedy}")


Length = tuple[float, float, float]
"""A length, mm, its variance, mm², and of that the square of the part of type A over its degrees of freedom."""


def _corrected(budget: Budget, ends: tuple[int, int], without: Sequence[str] = ()) -> Length:
    """Returns a corrected length of the run, with its variance by all sources except ``without``."""
    measurand = combine.distance(budget.joint, *ends)
    used = [each for each in budget.sources if each.key not in without]
    variances = [float(measurand.covariance(each)[0, 0]) for each in used]
    estimated = sum(variance for each, variance in zip(used, variances, strict=True) if each.evaluation == "A")
    return measurand.value * (1 + budget.conditions.correction), sum(variances), estimated**2 / budget.freedom


def _tested(circles: Sequence[str], own: Length, reference: Length) -> TestedLength:
    """Returns a length against a reference, with U of their difference."""
    (measured_mm, *_), (reference_mm, *_) = own, reference
    variance, lost = (own[i] + reference[i] for i in (1, 2))
    k = combine.coverage_factor(variance**2 / lost if lost else np.inf)
    expanded, error = 1e3 * k * float(np.sqrt(variance)), 1e3 * (measured_mm - reference_mm)
    e_n = error / expanded if expanded else float(np.copysign(np.inf, error)) if error else 0.0
    return TestedLength(tuple(circles), measured_mm, reference_mm, error, expanded, e_n)


MICRO, PPM = 1e3, 1e6


@dataclass(frozen=True, slots=True)
class RunOfBudget:
    folder: str
    images: str
    target: str
    version: str
    sha256: str
    faces_sha256: str
    changed: list[str]
    photographs_sha256: dict[str, str] = field(default_factory=dict)


class SourceRow(Part):
    key: str
    title: str
    evaluation: Literal["A", "B"]
    origin: Origin
    sigma: float | None
    unit: str
    words: str


class FaceUncertainty(Part):
    position_mm: list[float] | None
    rotation_vector_deg: list[float]
    position_um: Uncertainty | None
    rotation_mdeg: Uncertainty


class AngleUncertainty(Part):
    faces: list[str]
    angle_deg: float
    angle_mdeg: Uncertainty


class DistanceUncertainty(Part):
    circles: list[str]
    length_mm: float
    corrected_mm: float
    distance_um: Uncertainty


@dataclass(frozen=True, slots=True)
class CircleUncertainty:
    position_mm: list[float]
    position_xyz_um: list[float]
    coverage_factor: float = 2.0


@dataclass(frozen=True, slots=True)
class StatedRow:
    body: str
    key: str
    value: float
    origin: str


class BudgetFile(ResultFile):
    """The JSON file of ``budget``."""

    format: Literal["stcal budget 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    run: RunOfBudget = Field(
        description="`folder`, `images` (photographs), name of the `target`, `version` of stcal that made it, `sha256` "
        f"of its `{RUN_MARKER}` (that of all files) and `faces_sha256`; `changed` files, not as the run left them; "
        "`photographs_sha256` of those that are still in their folder"
    )
    fields: dict[ByName, str] = Field(
        description=f"{', '.join(f'`{name}`' for name in FIELDS)} and others, as given; empty where not"
    )
    reference_face: str = Field(description="its frame is the target frame, and has no uncertainty")
    use: str = Field(description='the run\'s own answer to "May I use it?"')
    verdict: Use = Field("yes", description="the same in a word")
    reserved: bool = Field(False, description="whether that answer is to use it with care, also as a part")
    usable: bool = Field(description="false if the run must not be used: then no uncertainty is given")
    size_known: bool = Field(
        description="false if nothing of known size was in view: then positions are null, and there are no `distances`"
    )
    reference_temperature_c: float | None = Field(
        description="temperature of the target for which corrected lengths and positions hold; null if not known"
    )
    holds: str = Field(description="the same in words, and why; empty where `usable` is false")
    coverage_factor: float = Field(
        description="k for many degrees of freedom; each uncertainty has its own `coverage_factor`"
    )
    sigma0: float = Field(description="residuals over σ of all observations, 1 if smaller; multiplies all σ")
    redundancy: int = Field(description="degrees of freedom of the adjustment")
    views: list[GroupViews] = Field(
        description="of each `group`: `images`, and `spread_deg`, the largest angle between two camera axes"
    )
    sources: list[SourceRow] = Field(
        description="inputs: `key`, `title`; `evaluation` (type A or B); `origin`: `estimated` from this run, `stated` "
        "by the user, `assumed`, `not stated` (taken as exact) or `not known`; standard uncertainty `sigma` in `unit`, "
        "null if it is not one number; `words` on where it comes from"
    )
    stated: list[StatedRow] = Field(
        description="sizes and temperatures: `body`, `key`, `value`, and the file of `origin`, or why it is assumed"
    )
    definitions: list[str] = Field(default=[], description="what positions, rotations and distances are of, in words")
    correction_ppm: float | None = Field(
        description="of the run's lengths for the stated expansion, not applied by the run; null without a size"
    )
    faces: dict[ByName, FaceUncertainty] = Field(
        description="against the reference face: `position_mm` of the origin, corrected, and `rotation_vector_deg`; "
        "`position_um` and `rotation_mdeg`, their uncertainties"
    )
    angles: list[AngleUncertainty] = Field(
        default=[], description="`angle_deg` between the Z axes of every two `faces`; `angle_mdeg`, its uncertainty"
    )
    distances: list[DistanceUncertainty] = Field(
        description="the longest between two faces' `circles`: `length_mm` of the run, `corrected_mm`, and "
        "`distance_um`, its uncertainty"
    )
    circles: dict[ByName, CircleUncertainty] = Field(
        default={},
        description="by label: corrected `position_mm` in the target frame, and standard uncertainties of x, y, z, "
        "`position_xyz_um`, with their `coverage_factor`; empty without a size, or if the run must not be used",
    )
    length_tests: list[LengthTest] = Field(
        description="`reference` (file or run); `lengths` between `circles`: corrected `measured_mm`, `reference_mm`, "
        "`error_um`, U of both `expanded_um`, and `e_n`, null if both are exact; `largest_e_n`, how many are `beyond` "
        "U, the `limit` of the largest |E_n| of so many, whether all `agrees`, the `verdict` in words, and `notes`; "
        "null where a run must not be used"
    )
    notes: list[str] = Field(description="what is not in the combined uncertainty, or not known")

    @classmethod
    def of(
        cls, budget: Budget, run: SavedRun, verified: Verified, tests: Sequence[LengthTest] = (), *others: SavedRun
    ) -> "BudgetFile":
        """Returns the file of a run's budget; ``others`` are further runs that the tests compare it with."""
        conditions, known = budget.conditions, budget.conditions.size_known
        answer, refused = answer_of(run), is_refused(run)
        enlarged, poses = 1 + conditions.correction, run.faces.poses()
        rows: dict[Kind, list[tuple[Measurand, Uncertainty]]] = {kind: [] for kind in get_args(Kind)}
        for measurand, own in () if refused else budget.rows:
            rows[measurand.kind].append((measurand, own))
        position_um = {measurand.name: own for measurand, own in rows["position"] if known}
        faces = {
            each.name: FaceUncertainty(
                position_mm=(enlarged * poses[each.name].translation).tolist() if known else None,
                rotation_vector_deg=poses[each.name].as_scipy().as_rotvec(degrees=True).tolist(),
                position_um=position_um.get(each.name),
                rotation_mdeg=own,
            )
            for each, own in rows["rotation"]
        }
        angles = [
            AngleUncertainty(faces=list(each.of), angle_deg=float(np.degrees(each.value)), angle_mdeg=own)
            for each, own in rows["angle"]
        ]
        distances = [
            DistanceUncertainty(
                circles=list(each.of), length_mm=each.value, corrected_mm=enlarged * each.value, distance_um=own
            )
            for each, own in rows["distance"]
            if known
        ]
        circles: dict[str, CircleUncertainty] = {}
        variance = np.diagonal(budget.circles_covariance_mm2, axis1=1, axis2=2)
        for label, own, freedom in zip(budget.joint.labels, variance, budget.circles_freedom, strict=True):
            xyz, sigma_um = enlarged * np.asarray(run.faces.circles[label]), (MICRO * np.sqrt(own)).tolist()
            circles[str(label)] = CircleUncertainty(xyz.tolist(), sigma_um, combine.coverage_factor(freedom))
        if any(is_refused(each) for each in (run, *others)):  # no U holds: nothing is judged
            bare = ([replace(own, expanded_um=None, e_n=None) for own in test.lengths] for test in tests)
            tests = [test.of(test.reference, own, test.notes) for test, own in zip(tests, bare, strict=True)]
        photographs = {name: Path(run.photographs) / name for name in sorted(each.name for each in run.observations)}
        return cls(
            format="stcal budget 1",
            version=stcal.__version__,
            run=RunOfBudget(
                folder=str(run.folder),
                images=str(run.photographs),
                target=run.target_design.name,
                version=verified.version,
                sha256=run.sha256.get(RUN_MARKER, ""),
                faces_sha256=run.sha256.get("faces.json", ""),
                changed=[*verified.missing, *verified.changed, *verified.added],
                photographs_sha256={name: digest_of(path) for name, path in photographs.items() if path.is_file()},
            ),
            fields=budget.statement.fields,
            reference_face=budget.reference_face,
            use=answer.use,
            verdict="no" if refused else answer.verdict,
            reserved=answer.reserved,
            usable=not refused,
            size_known=known,
            reference_temperature_c=conditions.temperature_c,
            holds="" if refused else conditions.words,
            coverage_factor=combine.COVERAGE_FACTOR,
            sigma0=budget.joint.sigma_scale,
            redundancy=budget.joint.redundancy,
            views=list(budget.views),
            sources=[SourceRow.model_validate(source) for source in budget.sources],
            stated=list(_stated(budget.statement, run)),
            definitions=_definitions(run),
            correction_ppm=PPM * conditions.correction if known else None,
            faces=faces,
            angles=angles,
            distances=distances,
            circles={} if refused or not known else circles,
            length_tests=TypeAdapter(list[LengthTest]).validate_python([asdict(test) for test in tests]),
            notes=notes_of(budget, verified, run),
        )


def _stated(statement: Statement, run: SavedRun) -> Iterator[StatedRow]:
    """Yields the size of the board, what is stated of both bodies, and a reference temperature that is assumed."""
    board = run.board_design
    for key in ("rows", "columns", "pitch_mm") if board.rows else ():
        if value := getattr(board, key, None):
            yield StatedRow("board", key, value, "board.toml")
    for body, size in (("board", statement.board), ("target", statement.target)):
        values = {key: value for key, value in asdict(size).items() if value is not None}
        for key, value in values.items():
            yield StatedRow(body, key, value, statement.origin[body, key])
        if values.keys() - {"pitch_sigma_ppm"} and size.reference_temperature_c is None:
            yield StatedRow(body, "reference_temperature_c", combine.REFERENCE_C, "assumed, ISO 1")


def _definitions(run: SavedRun) -> list[str]:
    plane = run.faces.frame == "plane"
    normal = "normal to the plane of all its circles, " if plane else ""
    foot = ", at its foot on the plane of all circles" if plane else ""

    def axes_of(face: FaceDesign) -> str:
        if face.printed is not None:
            return "the frame of its drawing, Z into the body"
        xy = f"X towards circle {face.x}, Y on the side of circle {face.y}"
        return f"origin at circle {face.origin}{foot}, {xy}, Z {normal}out of the body"

    return [
        f"position of a face: its origin in the frame of face {run.faces.reference_face}; rotation vector: axis, and "
        "angle as its length, of the rotation that takes the axes of that frame to those of the face",
        "the angle of two faces is that between their Z axes",
        "a distance a–b is that of the points a and b, face:circle, numbered as in the drawing",
        *(f"face {face.id}: {axes_of(face)}" for face in run.target_design.faces),
    ]


def answer_of(run: SavedRun) -> Judgement:
    """Returns a run's answer to "May I use it?"; that of today's rules where an older version did not say it all."""
    stated = run.report.get("judgement") or {}
    return Judgement.model_validate(stated) if "reserved" in stated else judgement_of(run.report)


def is_refused(run: SavedRun) -> bool:
    """Whether a run says that it must not be used, so that no uncertainty of it holds."""
    return bool(run.failed_checks()) or answer_of(run).verdict == "no"


def refusals(runs: Sequence[SavedRun], tests: Sequence[LengthTest]) -> list[str]:
    """Returns why a budget must not be used, in words: the answer of each run, and length tests that differ."""
    reasons = []
    for run in filter(is_refused, runs):
        answer = answer_of(run)
        failed = "failed: " + "; ".join(check["title"] for check in run.failed_checks())
        own = answer.use.removesuffix(".") if answer.verdict == "no" else failed
        reasons.append(f"may run {run.folder} be used? {own}")
    return reasons + [f"length test against {test.reference}: differs" for test in tests if test.agrees is False]


USUAL_K, USUAL_SIGMA_K, USUAL_EXPANSION = 25.0, 10.0, 250.0
"""Distance from 20 °C, σ of a temperature, K, and expansion, ppm/K, beyond which a statement is asked about: rooms are
nearer, thermometers better, and plastics expand less."""


def _unusual(statement: Statement) -> list[str]:
    """Returns questions about statements that are possible, and as unusual as those in another unit."""
    asked = []
    for body, size in (("board", statement.board), ("target", statement.target)):
        warm, sigma, rate = size.temperature_c, size.temperature_sigma_k or 0.0, size.expansion_ppm_per_k or 0.0
        if warm is not None and abs(warm - combine.REFERENCE_C) > USUAL_K:
            asked.append(f"the {body}'s temperature is {warm:g} °C: or °F, which were {(warm - 32) / 1.8:.1f} °C?")
        if sigma > USUAL_SIGMA_K:
            asked.append(f"σ of the {body}'s temperature is {sigma:g} K: is that its value?")
        if abs(rate) > USUAL_EXPANSION:
            asked.append(f"the {body} expands by {rate:g} ppm/K, more than plastics do: is that so?")
    return asked


def notes_of(budget: Budget, verified: Verified, run: SavedRun) -> list[str]:
    """Returns notes on what a reader must know that no number shows."""
    statement, conditions, has_board = budget.statement, budget.conditions, bool(run.board_design.rows)
    failed, unknown = run.failed_checks(), [source.title for source in budget.sources if source.origin == "not stated"]
    first, invalid = [check["title"] for check in failed][:1], join(invalidated(check["key"] for check in failed))
    corrected = conditions.size_known and conditions.correction and not is_refused(run)
    both = statement.board.temperature_sigma_k and statement.target.temperature_sigma_k
    told = {
        f"failed checks of the run: {len(failed)}, first {join(first)}; what they found is not among the inputs: "
        f"{invalid} do not hold before it is put right, and no uncertainty of them is given": failed,
        f"may the run be used? {answer_of(run).use} No uncertainty of it is given": is_refused(run) and not failed,
        f"{conditions.words}; lengths of the run are in the unit of the drawing": not conditions.size_known,
        f"taken as exact, since nothing is stated of them: {join(unknown)}; the uncertainties hold as far as these "
        "are": unknown,
        f"for the stated expansion, lengths in faces.json are still to be changed by "
        f"{PPM * conditions.correction:+.1f} ppm; the tables here have them changed, and U holds for these": corrected,
        "no board was in view: what is stated of [board] is not used": not has_board
        and statement.board != StatedSize(),
        "errors of the temperatures of board and target are taken as uncorrelated; where one thermometer measured both "
        "(one_thermometer of the statement), U is too large": has_board and both and not statement.one_thermometer,
    }
    return [
        *(note for note, applies in told.items() if applies),
        *_unusual(statement),
        *verified.notes(),
        f"face {budget.reference_face} defines the target frame, which is exact; errors of its own points are in the "
        "poses of the other faces",
    ]
