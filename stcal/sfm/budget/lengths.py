"""The length test: distances between circles against stated lengths, or against a second calibration.

Terms of VDI/VDE 2634 part 1 and ISO 10360: the length measurement error is the measured less the reference length; E_n
is its ratio to the expanded uncertainty of both (ISO 13528:2022, 9.7), at most 1 where they agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm

from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.io.table import LENGTHS, read_table
from stcal.labels import CircleLabel, circle_labels
from stcal.sfm.adjust.joint import JointResult
from stcal.sfm.budget.combine import COVERAGE_FACTOR, Budget, distance, longest_of

WHAT = "lengths"
BY_CHANCE = 2 * float(norm.sf(COVERAGE_FACTOR))
"""Of one length that agrees, and of all lengths of a test together."""
SHARED = ("board_pitch", "board_expansion", "target_expansion")
"""What two calibrations with one board, of one target, are wrong by alike: by one factor on all lengths."""


@dataclass(frozen=True, slots=True, eq=False)
class Length:
    """mm; ``expanded_mm`` : U of the difference."""

    circles: tuple[CircleLabel, CircleLabel]
    measured_mm: float
    reference_mm: float
    expanded_mm: float

    @property
    def error_mm(self) -> float:
        """Length measurement error."""
        return self.measured_mm - self.reference_mm

    @property
    def e_n(self) -> float:
        """Of ISO 13528, with its sign; infinite where both lengths are exact and differ."""
        if self.expanded_mm:
            return self.error_mm / self.expanded_mm
        return np.inf * np.sign(self.error_mm) if self.error_mm else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LengthTest:
    """``reference`` : what the lengths are compared with; ``notes`` on what the test does not see."""

    reference: str
    lengths: tuple[Length, ...]
    notes: tuple[str, ...]

    @property
    def beyond(self) -> int:
        """Lengths whose error is larger than U."""
        return sum(abs(each.e_n) > 1 for each in self.lengths)

    @property
    def limit(self) -> float:
        """Of the largest \\|E_n\\|: 1 for one length, more for many, so that all together are beyond it as rarely
        (Bonferroni)."""
        return float(norm.isf(BY_CHANCE / 2 / len(self.lengths)) / COVERAGE_FACTOR)

    @property
    def agrees(self) -> bool:
        """The verdict."""
        return all(abs(each.e_n) <= self.limit * (1 + 1e-9) for each in self.lengths)


def against_stated(budget: Budget, path: Path) -> LengthTest:
    """Against lengths of a CSV file: columns ``from``, ``to`` (circles as ``face:circle``), ``length_mm``, and
    ``sigma_mm``, their standard uncertainty; without it they are taken as exact.

    Raises
    ------
    InputError
        A file that is none, circles that the run has not, or a length that is none.
    """
    table = read_table(path, WHAT)
    ends = list(zip(table.text("from"), table.text("to"), strict=True))
    length = table.quantity("length", LENGTHS)
    known = table.has("sigma", LENGTHS)
    sigma = table.quantity("sigma", LENGTHS) if known else np.zeros(len(length))
    joint, found = budget.joint, []
    places = {str(label): i for i, label in enumerate(joint.labels)}
    for line, pair, value, own in zip(table.lines, ends, length, sigma, strict=True):
        where = f"{table.where}: line {line}"
        for name in pair:
            if name not in places:
                raise InputError(
                    "E-BUDGET-LENGTHS", f"{where}: no circle {name} in the run; give one such as {joint.labels[0]}"
                )
        if pair[0] == pair[1] or value <= 0 or own < 0:
            raise InputError(
                "E-BUDGET-LENGTHS",
                f"{where}: {pair[0]} to {pair[1]}, {value:g} ± {own:g} mm; a length between two circles needed, "
                "and a σ of 0 or more",
            )
        i, j = places[pair[0]], places[pair[1]]
        measured, standard = _measured(budget, i, j)
        expanded = COVERAGE_FACTOR * float(np.hypot(standard, own))
        found.append(Length((joint.labels[i], joint.labels[j]), measured, float(value), expanded))
    notes = () if known else (f"{path} states no sigma_mm: its lengths are taken as exact",)
    return LengthTest(str(path), tuple(found), notes)


def against_run(budget: Budget, other: Budget, folder: Path, boards: Sequence[BoardDesign]) -> LengthTest:
    """Against a second calibration of the same target: the longest distances of every two faces, and within each, of
    circles that both have. ``boards`` : of the two.

    Raises
    ------
    InputError
        The runs have no face with two circles in common.
    """
    both = [label for label in budget.joint.labels if label in set(other.joint.labels)]
    own, its = (_places(each.joint, both) for each in (budget, other))
    pairs = longest_of(both, budget.joint.xyz_model[own])
    if not pairs:
        raise InputError(
            "E-BUDGET-LENGTHS", f"run {folder}: {len(both)} circles in common, 2 needed; give a run of the same target"
        )
    shared = SHARED if _same(*boards) else ("target_expansion",)
    found = []
    for i, j in pairs:
        measured, standard = _measured(budget, own[i], own[j], shared)
        reference, its_standard = _measured(other, its[i], its[j], shared)
        expanded = COVERAGE_FACTOR * float(np.hypot(standard, its_standard))
        found.append(Length((both[i], both[j]), measured, reference, expanded))
    note = (
        "both calibrations rest on boards of the same description: if it is one board, what its pitch and expansion "
        "are off is in both alike, cannot be seen here, and is not in U of the differences; a length from elsewhere "
        "(--check-lengths) shows it"
    )
    return LengthTest(str(folder), tuple(found), (note,) if _same(*boards) else ())


def _places(joint: JointResult, labels: Sequence[CircleLabel]) -> list[int]:
    places = {label: i for i, label in enumerate(joint.labels)}
    return [places[label] for label in circle_labels(labels)]


def _same(a: BoardDesign, b: BoardDesign) -> bool:
    """Whether two runs may have had one board."""
    return (a.rows, a.columns, a.pitch_mm, a.corner) == (b.rows, b.columns, b.pitch_mm, b.corner)


def _measured(budget: Budget, i: int, j: int, without: Sequence[str] = ()) -> tuple[float, float]:
    """Corrected length of the run and its standard uncertainty by all sources but some, mm."""
    own = distance(budget.joint, i, j)
    variance = sum(float(own.covariance(each, 0.0)[0, 0]) for each in budget.sources if each.key not in without)
    return float(own.length_mm or 0.0) * (1 + budget.correction), float(np.sqrt(variance))
