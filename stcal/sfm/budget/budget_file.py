"""Form of the JSON file of ``budget``, which its page and PDF show too."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from pydantic import Field, TypeAdapter

import stcal
from stcal.design import StatedSize
from stcal.io.files import RUN_MARKER
from stcal.io.json import ByName, Finite, Part, ResultFile
from stcal.report.text import join
from stcal.sfm.budget.combine import COVERAGE_FACTOR, Budget, GroupViews, Row
from stcal.sfm.budget.length_test import LengthTest
from stcal.sfm.budget.sources import REFERENCE_C, Origin, Statement
from stcal.sfm.report.check import invalidated
from stcal.sfm.report.judgement import Judgement, judgement_of
from stcal.sfm.runs.run_result import SavedRun
from stcal.sfm.runs.saved import Verified

MICRO = 1e3
MILLIDEGREES = 1e3 * float(np.degrees(1.0))
PPM = 1e6


@dataclass(frozen=True, slots=True)
class RunOfBudget:
    folder: str
    images: str
    target: str
    version: str
    sha256: str
    faces_sha256: str
    changed: list[str]


class SourceRow(Part):
    key: str
    title: str
    evaluation: Literal["A", "B"]
    origin: Origin
    sigma: float | None
    unit: str
    words: str


class Uncertainty(Part):
    """Uncertainty of one measurand."""

    axes: list[float]
    contributions: dict[str, float]
    standard: float
    expanded: float
    coverage: float
    degrees_of_freedom: Finite

    @classmethod
    def of(cls, row: Row, unit: float) -> "Uncertainty":
        return cls(
            axes=(unit * np.sqrt(np.diag(row.covariance))).tolist(),
            contributions={key: unit * contribution for key, contribution in row.contributions.items()},
            standard=unit * row.standard,
            expanded=unit * row.expanded,
            coverage=row.coverage,
            degrees_of_freedom=row.freedom,
        )

    def share(self, key: str) -> float:
        """Returns the share of one source in the variance."""
        return (self.contributions[key] / self.standard) ** 2 if self.standard else 0.0


class FaceUncertainty(Part):
    position_mm: list[float] | None
    rotation_vector_deg: list[float]
    position_um: Uncertainty | None
    rotation_mdeg: Uncertainty


class DistanceUncertainty(Part):
    circles: list[str]
    length_mm: float
    corrected_mm: float
    distance_um: Uncertainty


@dataclass(frozen=True, slots=True)
class CircleUncertainty:
    position_mm: list[float]
    position_xyz_um: list[float]


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
        description="`folder`, `images` (its photographs), name of the `target`, `version` of stcal that made it, "
        "`sha256` of its `stcal-run.json` (which has the hashes of all other files) and `faces_sha256` of "
        "`faces.json`; `changed`: files that are not as the run left them"
    )
    fields: dict[ByName, str] = Field(
        description="`number` (of the certificate), `laboratory`, `place` (of the calibration), `customer`, "
        "`instrument`, `operator`, `date` (of the "
        "calibration), `traceability` and others, as given; empty where not"
    )
    reference_face: str = Field(description="its frame is the target frame, and has no uncertainty")
    use: str = Field(description='the run\'s own answer to "May I use it?"')
    reserved: bool = Field(False, description="whether that answer is to use it with care, also as a part")
    usable: bool = Field(
        description="false where that answer is no or a check has failed: no uncertainty is given, `faces` and "
        "`distances` are empty"
    )
    size_known: bool = Field(
        description="false where nothing of known size was in view: only the shape is known, positions and their "
        "uncertainties are null, and there are no `distances`"
    )
    reference_temperature_c: float | None = Field(
        description="of the target: the temperature for which corrected lengths and positions hold, null where it is "
        "not known; 20 °C (ISO 1) unless stated otherwise, or that of the photographs where the expansion of board or "
        "target is not stated"
    )
    holds: str = Field(description="the same in words, and why; empty where `usable` is false")
    coverage_factor: float = Field(description="k of the expanded uncertainties")
    sigma0: float = Field(
        description="residuals of the adjustment over the σ of all observations, 1 where they are smaller; scales these"
    )
    redundancy: int = Field(description="degrees of freedom of the adjustment")
    views: list[GroupViews] = Field(
        description="of each `group`: `images`, and `spread_deg`, the largest angle between two camera axes"
    )
    sources: list[SourceRow] = Field(
        description="inputs: `key`, `title`; `evaluation` of type A or B (JCGM 100, 4.2, 4.3); `origin`: `estimated` "
        "from this run, `stated` by the user, `assumed` where none is stated, `not stated`: taken as exact, or `not "
        "known`: of a size that nothing tells; "
        "standard uncertainty `sigma` in `unit`, null where it is not one number; `words` on where it comes from"
    )
    stated: list[StatedRow] = Field(
        description="sizes and temperatures: `body`, `key`, `value`, and the file of `origin`, or why it is assumed"
    )
    definitions: list[str] = Field(default=[], description="what positions, rotations and distances are of, in words")
    correction_ppm: float | None = Field(
        description="by which lengths of the run are to be enlarged for the stated expansion; the run did not apply "
        "it; null where the size is not known"
    )
    faces: dict[ByName, FaceUncertainty] = Field(
        description="against the reference face: `position_mm`, x, y, z of the face's origin in the target frame, with "
        "`correction_ppm`, and `rotation_vector_deg` of the run; `position_um` (root of the summed variances of x, y, "
        "z) and `rotation_mdeg` likewise, each with the combined standard uncertainties of x, y, z (`axes`), "
        "`contributions` by key of the source, combined `standard` and `expanded` uncertainty, `coverage` of the "
        "latter by simulation, and effective `degrees_of_freedom`, null for infinitely many; all of positions null "
        "without a known size"
    )
    distances: list[DistanceUncertainty] = Field(
        description="the longest between two faces' `circles`: `length_mm` of the run, `corrected_mm` with "
        "`correction_ppm`, and `distance_um` with `axes`, `contributions`, `standard`, `expanded`, `coverage`, "
        "`degrees_of_freedom` as of faces"
    )
    circles: dict[ByName, CircleUncertainty] = Field(
        default={},
        description="by label, circles or corners of the target in its frame: `position_mm` with `correction_ppm`, and "
        "combined standard uncertainties of x, y, z, `position_xyz_um`; empty where the size is not known or the run "
        "must not be used",
    )
    length_tests: list[LengthTest] = Field(
        description="with `--check-lengths` and `--lengths`: `reference` (file or run); `lengths` between `circles`: "
        "`measured_mm` (corrected) and `reference_mm`, length measurement error `error_um` (VDI/VDE 2634), U of both "
        "`expanded_um`, and `e_n`, the error over it (ISO 13528; null where both are exact); `largest_e_n`, how many "
        "are `beyond` U, the `limit` of the largest |E_n| for so many lengths, whether all `agrees`, the `verdict` in "
        "words, and `notes`; U, `e_n`, `beyond` and `agrees` null where a run must not be used"
    )
    notes: list[str] = Field(description="what is not in the combined uncertainty, or not known")

    @classmethod
    def of(
        cls, budget: Budget, run: SavedRun, verified: Verified, tests: Sequence[LengthTest] = (), *others: SavedRun
    ) -> "BudgetFile":
        """Returns the file of a run's budget; ``others`` are further runs that the tests compare it with."""
        conditions, refused, known = budget.conditions, is_refused(run), budget.conditions.size_known
        enlarged, sigma = 1 + conditions.correction, np.diagonal(budget.circles_covariance_mm2, axis1=1, axis2=2)
        faces = {}
        for position, rotation in zip(budget.of_kind("position"), budget.of_kind("rotation"), strict=True):
            pose = run.faces.poses()[position.measurand.name]
            faces[position.measurand.name] = FaceUncertainty(
                position_mm=(enlarged * pose.translation).tolist() if known else None,
                rotation_vector_deg=pose.as_scipy().as_rotvec(degrees=True).tolist(),
                position_um=Uncertainty.of(position, MICRO) if known else None,
                rotation_mdeg=Uncertainty.of(rotation, MILLIDEGREES),
            )
        distances = [
            DistanceUncertainty(
                circles=list(row.measurand.circles),
                length_mm=row.measurand.length_mm or 0.0,
                corrected_mm=(row.measurand.length_mm or 0.0) * enlarged,
                distance_um=Uncertainty.of(row, MICRO),
            )
            for row in budget.of_kind("distance")
        ]
        circles = {
            str(label): CircleUncertainty(
                (enlarged * np.asarray(run.faces.circles[label])).tolist(), (MICRO * np.sqrt(own)).tolist()
            )
            for label, own in zip(budget.joint.labels, sigma, strict=True)
        }
        if any(is_refused(each) for each in (run, *others)):
            tests = [test.without_u() for test in tests]
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
            ),
            fields=budget.statement.fields,
            reference_face=budget.reference_face,
            use=(answer := answer_of(run)).use,
            reserved=answer.reserved,
            usable=not refused,
            size_known=known,
            reference_temperature_c=conditions.temperature_c,
            holds="" if refused else conditions.words,
            coverage_factor=COVERAGE_FACTOR,
            sigma0=budget.joint.sigma_scale,
            redundancy=budget.joint.redundancy,
            views=list(budget.views),
            sources=[SourceRow.model_validate(source) for source in budget.sources],
            stated=list(_stated(budget.statement, run)),
            definitions=_definitions(run),
            correction_ppm=PPM * conditions.correction if known else None,
            faces={} if refused else faces,
            distances=[] if refused or not known else distances,
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
            yield StatedRow(body, "reference_temperature_c", REFERENCE_C, "assumed, ISO 1")


def _definitions(run: SavedRun) -> list[str]:
    """Returns sentences that define the measurands."""
    plane = run.faces.frame == "plane"
    normal = "normal to the plane of all its circles, " if plane else ""
    foot = ", at its foot on the plane of all circles" if plane else ""
    return [
        f"position of a face: its origin in the frame of face {run.faces.reference_face}; rotation vector: axis, and "
        "angle as its length, of the rotation that takes the axes of that frame to those of the face",
        "a distance a–b is that of the points with the labels a and b, face:circle, as draw numbers them",
        *(
            f"face {face.id}: the frame of its drawing, Z into the body"
            if face.printed is not None
            else f"face {face.id}: origin at circle {face.origin}{foot}, X towards circle {face.x}, Y on the side of "
            f"circle {face.y}, Z {normal}out of the body"
            for face in run.target_design.faces
        ),
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
        if warm is not None and abs(warm - REFERENCE_C) > USUAL_K:
            fahrenheit = (warm - 32) / 1.8
            asked.append(f"the {body}'s temperature is {warm:g} °C: or °F, which were {fahrenheit:.1f} °C?")
        if sigma > USUAL_SIGMA_K:
            asked.append(f"σ of the {body}'s temperature is {sigma:g} K: is that its value?")
        if abs(rate) > USUAL_EXPANSION:
            asked.append(f"the {body} expands by {rate:g} ppm/K, more than plastics do: is that so?")
    return asked


def notes_of(budget: Budget, verified: Verified, run: SavedRun) -> list[str]:
    """Returns notes on what a reader must know that no number shows."""
    statement, conditions, has_board = budget.statement, budget.conditions, bool(run.board_design.rows)
    failed, unknown = run.failed_checks(), [source.title for source in budget.sources if source.origin == "not stated"]
    notes = []
    if failed:
        invalid = join(invalidated(check["key"] for check in failed))
        notes.append(
            f"failed checks of the run: {len(failed)}, first {failed[0]['title']}; what they found is not among the "
            f"inputs: {invalid} do not hold before it is put right, and no uncertainty of them is given"
        )
    elif is_refused(run):
        notes.append(f"may the run be used? {answer_of(run).use} No uncertainty of it is given")
    corrected = conditions.size_known and conditions.correction and not is_refused(run)
    both = statement.board.temperature_sigma_k and statement.target.temperature_sigma_k
    told = {
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
        *notes,
        *(note for note, applies in told.items() if applies),
        *_unusual(statement),
        *verified.notes(),
        "the reference face's frame is the target frame and carries no uncertainty; that of how its own points define "
        "the frame is in the poses of the other faces",
    ]
