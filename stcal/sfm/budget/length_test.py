"""Length test: distances between circles against stated lengths, or against a second calibration. Terms are those of
VDI/VDE 2634 part 1 and ISO 10360; E_n is of ISO 13528:2022, 9.7, at most 1 where both agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import norm

from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.io.json import Finite
from stcal.io.table import LENGTHS, read_table
from stcal.report.text import number
from stcal.sfm.budget.combine import COVERAGE_FACTOR, Budget, distance, longest_of
from stcal.sfm.budget.sources import reference_temperature_c
from stcal.sfm.data.group_model import ImageObservations

WHAT = "lengths"
BY_CHANCE = 2 * float(norm.sf(COVERAGE_FACTOR))
"""Probability that one length that agrees is beyond U by chance, and that any length of a test is beyond the limit."""
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
        """Returns the test. The limit of the largest E_n is 1 for one length, and more for many, as more go beyond by
        chance (Bonferroni)."""
        count, e_n = len(lengths), [abs(length.e_n) for length in lengths if length.e_n is not None]
        limit = float(norm.isf(BY_CHANCE / 2 / count) / COVERAGE_FACTOR)
        if not e_n:
            verdict = f"not judged: {count} lengths with their errors, without U, which a run not to be used has not"
            return cls(reference, list(lengths), None, None, limit, None, verdict, notes)
        largest, beyond = max(e_n), sum(each > 1 for each in e_n)
        agrees = largest <= limit * (1 + 1e-9)
        verdict = f"agrees: all {count} lengths within U, largest |E_n| {number(largest, 2)}"
        if beyond:
            verdict = (
                f"{'may agree' if agrees else 'differs'}: {beyond} of {count} lengths beyond U, where 1 in 22 is by "
                f"chance; largest |E_n| {number(largest, 2)}, which reaches {limit:.2f} by chance in one of 22 tests "
                f"of {count}"
            )
        return cls(reference, list(lengths), largest, beyond, limit, agrees, verdict, notes)

    def without_u(self) -> "LengthTest":
        """Returns the test of a run that must not be used, of which no U holds: nothing is judged."""
        return self.of(self.reference, [replace(own, expanded_um=None, e_n=None) for own in self.lengths], self.notes)


def against_stated(budget: Budget, path: Path) -> LengthTest:
    """Tests the run against a CSV of ``from``, ``to`` (``face:circle``), ``length_mm`` and perhaps ``sigma_mm``."""
    _require_size(budget)
    table = read_table(path, WHAT)
    ends = list(zip(table.text("from"), table.text("to"), strict=True))
    length = table.quantity("length", LENGTHS)
    known = table.has("sigma", LENGTHS)
    sigma = table.quantity("sigma", LENGTHS) if known else np.zeros(len(length))
    tested, places = [], {str(label): i for i, label in enumerate(budget.joint.labels)}
    for line, (a, b), value, sigma_mm in zip(table.lines, ends, length, sigma, strict=True):
        where = f"{table.where}: line {line}"
        if unknown := {a, b} - places.keys():
            raise InputError(
                "E-BUDGET-LENGTHS",
                f"{where}: no circle {min(unknown)} in the run; give one such as {budget.joint.labels[0]}",
            )
        if a == b or value <= 0 or sigma_mm < 0:
            raise InputError(
                "E-BUDGET-LENGTHS",
                f"{where}: {a} to {b}, {value:g} ± {sigma_mm:g} mm; a length between two circles needed, and a σ of 0 "
                "or more",
            )
        tested.append(_length(budget, (places[a], places[b]), float(value), float(sigma_mm)))
    notes = () if known else (f"{path} states no sigma_mm: its lengths are taken as exact",)
    if budget.conditions.temperature_c != reference_temperature_c(budget.statement.target):
        notes += (
            f"{path} must state lengths for the temperature at which the target was photographed: those of the run are "
            "not corrected to another",
        )
    return LengthTest.of(str(path), tested, notes)


def against_run(budget: Budget, other: Budget, folder: Path, boards: Sequence[BoardDesign]) -> LengthTest:
    """Tests the longest distances between circles that two calibrations of the same target share."""
    _require_size(budget)
    _require_size(other)
    common = [label for label in budget.joint.labels if label in set(other.joint.labels)]
    rows, other_rows = ([each.joint.labels.index(label) for label in common] for each in (budget, other))
    pairs = longest_of(common, budget.joint.xyz_model[rows])
    if not pairs:
        raise InputError(
            "E-BUDGET-LENGTHS",
            f"run {folder}: {len(common)} circles in common, 2 needed; give a run of the same target",
        )
    # The two runs may have used one board.
    same = len({(board.rows, board.columns, board.pitch_mm, board.corner) for board in boards}) == 1
    shared = SHARED if same else ("target_expansion",)
    tested = []
    for i, j in pairs:
        reference = _length(other, (other_rows[i], other_rows[j]), 0.0, 0.0, shared)
        sigma_mm = 1e-3 * (reference.expanded_um or 0.0) / COVERAGE_FACTOR
        tested.append(_length(budget, (rows[i], rows[j]), reference.measured_mm, sigma_mm, shared))
    note = (
        "both calibrations rest on boards of the same description: if it is one board, what its pitch and expansion "
        "are off is in both alike, cannot be seen here, and is not in U of the differences; a length from elsewhere "
        "(--check-lengths) shows it"
    )
    notes = (note,) if same else ()
    if budget.conditions.temperature_c != other.conditions.temperature_c:
        notes += (
            "the lengths of the two calibrations hold at different temperatures; state expansion and temperature of "
            "board and target for both",
        )
    return LengthTest.of(str(folder), tested, notes)


SAME_VIEW_PX = 0.2
"""Median distance of equal circles below which two photographs are of one view: no hand comes back to it."""


def common_views(first: Sequence[ImageObservations], second: Sequence[ImageObservations]) -> tuple[str, ...]:
    """Returns a note on photographs of which both runs have the same view; none if there are none."""
    common = sum(any(_same_view(image, other) for other in second) for image in first)
    if not common:
        return ()
    return (
        f"{common} of {len(first)} photographs have the same view in the other run, to {SAME_VIEW_PX} px: the two "
        "calibrations are not independent, and what both have wrong cannot be seen here; compare with a run of other "
        "photographs",
    )


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
        raise InputError(
            "E-BUDGET-NO-SIZE",
            "a run saw nothing of known size, so that only its shape is known and its lengths cannot be compared; "
            "state one of the lengths with [[scale]] in target.toml, and run again",
        )


def _length(
    budget: Budget, ends: tuple[int, int], reference_mm: float, sigma_mm: float, without: Sequence[str] = ()
) -> TestedLength:
    """Returns a corrected length of the run, with U by all sources except ``without`` and by the reference's σ."""
    measurand = distance(budget.joint, *ends)
    variance = sum(
        float(measurand.covariance(source, 0.0)[0, 0]) for source in budget.sources if source.key not in without
    )
    measured = float(measurand.length_mm or 0.0) * (1 + budget.conditions.correction)
    expanded = 1e3 * COVERAGE_FACTOR * float(np.hypot(np.sqrt(variance), sigma_mm))
    error = 1e3 * (measured - reference_mm)
    e_n = error / expanded if expanded else float(np.copysign(np.inf, error)) if error else 0.0
    return TestedLength(measurand.circles, measured, reference_mm, error, expanded, e_n)
