"""Length test: distances between circles against stated lengths, or against a second calibration. Terms are those of
VDI/VDE 2634 part 1 and ISO 10360; E_n is of ISO 13528:2022, 9.7, at most 1 where both agree."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm

from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.io.table import LENGTHS, read_table
from stcal.labels import CircleLabel
from stcal.sfm.budget.combine import COVERAGE_FACTOR, Budget, distance, longest_of
from stcal.sfm.budget.sources import reference_temperature_c
from stcal.sfm.data.model import ImageObservations

WHAT = "lengths"
BY_CHANCE = 2 * float(norm.sf(COVERAGE_FACTOR))
"""Probability that one length that agrees is beyond U by chance, and that any length of a test is beyond the limit."""
SHARED = ("board_pitch", "board_expansion", "target_expansion")
"""Sources whose errors two calibrations of one target with one board share: they scale all lengths by one factor."""


@dataclass(frozen=True, slots=True, eq=False)
class Length:
    """A measured and a reference length, mm. ``expanded_mm`` : U of the difference."""

    circles: tuple[CircleLabel, CircleLabel]
    measured_mm: float
    reference_mm: float
    expanded_mm: float

    @property
    def error_mm(self) -> float:
        """Length measurement error, mm."""
        return self.measured_mm - self.reference_mm

    @property
    def e_n(self) -> float:
        """E_n of ISO 13528, with its sign; infinite if both lengths are exact and differ."""
        if self.expanded_mm:
            return self.error_mm / self.expanded_mm
        return np.inf * np.sign(self.error_mm) if self.error_mm else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LengthTest:
    """A length test. ``reference`` : what the lengths are compared with; ``notes`` : what the test cannot detect."""

    reference: str
    lengths: tuple[Length, ...]
    notes: tuple[str, ...]

    @property
    def beyond(self) -> int:
        """Number of lengths whose error is larger than U."""
        return sum(abs(length.e_n) > 1 for length in self.lengths)

    @property
    def limit(self) -> float:
        """Limit of the largest E_n: 1 for one length, more for many, as more go beyond by chance (Bonferroni)."""
        return float(norm.isf(BY_CHANCE / 2 / len(self.lengths)) / COVERAGE_FACTOR)

    @property
    def agrees(self) -> bool:
        """True if no length is beyond the limit."""
        return all(abs(length.e_n) <= self.limit * (1 + 1e-9) for length in self.lengths)


def against_stated(budget: Budget, path: Path) -> LengthTest:
    """Tests the run against a CSV of ``from``, ``to`` (``face:circle``), ``length_mm`` and perhaps ``sigma_mm``."""
    _require_size(budget)
    table = read_table(path, WHAT)
    ends = list(zip(table.text("from"), table.text("to"), strict=True))
    length = table.quantity("length", LENGTHS)
    known = table.has("sigma", LENGTHS)
    sigma = table.quantity("sigma", LENGTHS) if known else np.zeros(len(length))
    joint, tested = budget.joint, []
    places = {str(label): i for i, label in enumerate(joint.labels)}
    for line, pair, value, sigma_mm in zip(table.lines, ends, length, sigma, strict=True):
        where = f"{table.where}: line {line}"
        for name in pair:
            if name not in places:
                raise InputError(
                    "E-BUDGET-LENGTHS", f"{where}: no circle {name} in the run; give one such as {joint.labels[0]}"
                )
        if pair[0] == pair[1] or value <= 0 or sigma_mm < 0:
            raise InputError(
                "E-BUDGET-LENGTHS",
                f"{where}: {pair[0]} to {pair[1]}, {value:g} ± {sigma_mm:g} mm; a length between two circles needed, "
                "and a σ of 0 or more",
            )
        i, j = places[pair[0]], places[pair[1]]
        measured, standard = _measured(budget, i, j)
        expanded = COVERAGE_FACTOR * float(np.hypot(standard, sigma_mm))
        tested.append(Length((joint.labels[i], joint.labels[j]), measured, float(value), expanded))
    notes = () if known else (f"{path} states no sigma_mm: its lengths are taken as exact",)
    if budget.conditions.temperature_c != reference_temperature_c(budget.statement.target):
        notes += (
            f"{path} must state lengths for the temperature at which the target was photographed: those of the run are "
            "not corrected to another",
        )
    return LengthTest(str(path), tuple(tested), notes)


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
    shared = SHARED if _same(*boards) else ("target_expansion",)
    tested = []
    for i, j in pairs:
        measured, standard = _measured(budget, rows[i], rows[j], shared)
        reference, reference_standard = _measured(other, other_rows[i], other_rows[j], shared)
        expanded = COVERAGE_FACTOR * float(np.hypot(standard, reference_standard))
        tested.append(Length((common[i], common[j]), measured, reference, expanded))
    note = (
        "both calibrations rest on boards of the same description: if it is one board, what its pitch and expansion "
        "are off is in both alike, cannot be seen here, and is not in U of the differences; a length from elsewhere "
        "(--check-lengths) shows it"
    )
    notes = (note,) if _same(*boards) else ()
    if budget.conditions.temperature_c != other.conditions.temperature_c:
        notes += (
            "the lengths of the two calibrations hold at different temperatures; state expansion and temperature of "
            "board and target for both",
        )
    return LengthTest(str(folder), tuple(tested), notes)


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


def _same(a: BoardDesign, b: BoardDesign) -> bool:
    """True if the two runs may have used one board."""
    return (a.rows, a.columns, a.pitch_mm, a.corner) == (b.rows, b.columns, b.pitch_mm, b.corner)


def _measured(budget: Budget, i: int, j: int, without: Sequence[str] = ()) -> tuple[float, float]:
    """Returns the corrected length of the run, and its standard uncertainty from all sources except ``without``, mm."""
    measurand = distance(budget.joint, i, j)
    variance = sum(
        float(measurand.covariance(source, 0.0)[0, 0]) for source in budget.sources if source.key not in without
    )
    return float(measurand.length_mm or 0.0) * (1 + budget.conditions.correction), float(np.sqrt(variance))
