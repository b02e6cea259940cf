"""Notes on what a user should check, one line each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.geometry.rigid import Affine, Similarity
from stcal.geometry.robust import ratio_limit
from stcal.register.core.liu2017 import ASSUMED
from stcal.register.core.models import squares
from stcal.register.core.pairs import Problem
from stcal.register.core.result import Alternative
from stcal.register.core.robust import CLEAN_SETS_WITH_OUTLIER, LEVERAGE_UP_TO, Covariance, Fitted
from stcal.register.judge.degeneracy import WIDER_THAN, row_name, single_supports, spreads, symmetry, symmetry_note
from stcal.register.judge.mistakes import (
    SHOWN,
    UNIT_WITHIN,
    UNITS,
    Shifted,
    Wider,
    moved_meanwhile,
    neighbours_alike,
    order_note,
    outlier_notes,
)

LOW_REDUNDANCY = 6
"""Degrees of freedom below which the relative uncertainty of σ exceeds 30 %."""
MAJORITY = 0.5
"""Fraction of the point pairs below which a note says that few agree."""
SMALL_MM = 20.0
"""Extent of points below which they may be in metres: 20 m are 20 mm then. Few parts that are measured are smaller."""
TIGHT = 2.5
"""Threshold in σ below which the covariance of few points is too small. 2.5 σ cuts off a tenth of the good points."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Subject:
    """A registration to judge.

    Parameters
    ----------
    problem : problem
    method : str
    fitted : fitted
    alternative : alternative or None
    ambiguous : whether the alternative is about as good
    other : a wider model that explains the points
    shifted : inliers that are shifted together
    covariance : covariance
    factor : ratio of the residuals to the given σ; None if none was given
    lines : lines of the file that name the points
    """

    problem: Problem
    method: str
    fitted: Fitted
    alternative: Alternative | None
    ambiguous: bool
    other: Wider | None
    shifted: Shifted | None
    covariance: Covariance
    factor: float | None
    lines: Sequence[int] | None

    def name(self, row: int) -> str:
        """Returns a point's name for messages."""
        return row_name(row, self.lines)


def notes_of(subject: Subject) -> list[str]:
    """Returns all notes."""
    other = subject.other
    sigma = subject.fitted.sigma if other is None else other.sigma_mm
    notes = [*_agreement(subject), *_noise(subject, other), *_layout(subject, sigma)]
    return notes + outlier_notes(subject.problem, subject.fitted, subject.name)


def _agreement(subject: Subject) -> list[str]:
    fitted, other = subject.fitted, subject.alternative
    agree, count = int(fitted.inliers.sum()), len(fitted.inliers)
    notes = []
    if agree < MAJORITY * count:
        notes.append(f"only {agree} of {count} point pairs agree; check the others before you trust the transform")
    if other is not None:
        shown = ", ".join(subject.name(i) for i in other.rows[:SHOWN])
        more = ", …" if len(other.rows) > SHOWN else ""
        start = "AMBIGUOUS: " if subject.ambiguous else ""
        notes.append(
            f"{start}{len(other.rows)} of the other points agree on another transform, {other.apart_mm:.4g} mm and "
            f"{np.degrees(other.turn_rad):.3g}° from this one ({shown}{more}); did an instrument move between them?"
        )
    if subject.method == "liu2017":
        notes.append(ASSUMED)
    if subject.method == "least-squares":
        notes += _far_rows(subject)
    return notes


def _far_rows(subject: Subject) -> list[str]:
    """Returns notes on rows that the robust method would examine."""
    problem = subject.problem
    redundancy = problem.redundancy
    square = squares(problem.residuals(subject.fitted.transform))
    bound = square.sum() / redundancy * 3 * ratio_limit(CLEAN_SETS_WITH_OUTLIER / len(problem), 3, redundancy)
    far = np.flatnonzero(square > bound)
    if not len(far):
        return []
    worst = int(far[square[far].argmax()])
    return [
        f"{len(far)} points lie farther off than noise would put them, the farthest {subject.name(worst)} at "
        f"{np.sqrt(square[worst]):.4g} mm; use the robust method"
    ]


def _noise(subject: Subject, other: Wider | None) -> list[str]:
    fitted, notes = subject.fitted, []
    inside, transform = subject.problem[fitted.inliers], fitted.transform
    if other is not None:
        notes.append(other.note)
        inside, transform = other.problem, other.transform
    residuals = inside.residuals(transform)
    if np.abs(residuals).max() > inside.rounding_mm() and neighbours_alike(inside.xyz_a, residuals):
        notes.append(
            "the residuals are not noise: neighbours have similar errors, so that the frames are bent relative to each "
            "other, and a transform is valid only where its points are; see the residual field"
        )
    if other is None and subject.method != "liu2017":
        change = moved_meanwhile(subject.problem, transform)
        notes += [] if change is None else [order_note(change, subject.name)]
    if subject.shifted is not None:
        notes.append(_two_groups(subject, subject.shifted))
    if subject.factor is not None and subject.covariance.scaled:
        notes.append(
            f"residuals exceed the σ given {subject.factor:.3g} times, which is beyond chance; the covariance is "
            f"scaled by this factor"
        )
    enough = inside.model.sample + 1  # all but any one of so many fit: their residuals cannot show which one is wrong
    if len(inside) <= enough and subject.covariance.scaled:
        more = enough + 2 - len(inside)
        notes.append(f"of {len(inside)} points a wrong one cannot be identified: measure {more} more")
    redundancy = subject.covariance.redundancy
    if redundancy < LOW_REDUNDANCY:
        notes.append(f"σ rests on {redundancy:.0f} degrees of freedom and is a rough guess; measure more points")
    if fitted.threshold < TIGHT * fitted.sigma and subject.method == "robust":
        notes.append(
            f"the threshold of {fitted.threshold:.4g} mm is only {fitted.threshold / fitted.sigma:.2g} σ and cuts off "
            "good points; leave it out to have it estimated"
        )
    return notes


def _two_groups(subject: Subject, shifted: Shifted) -> str:
    inliers = np.flatnonzero(subject.fitted.inliers)
    shown = ", ".join(subject.name(int(inliers[i])) for i in shifted.rows[:SHOWN])
    more = ", …" if len(shifted.rows) > SHOWN else ""
    by = ", ".join(f"{v:.3g}" for v in shifted.by_mm)
    where = ", and lie together" if shifted.together else ""
    return (
        f"{len(shifted.rows)} rows agree with each other on a shift of ({by}) mm against the other "
        f"{shifted.count - len(shifted.rows)}{where} ({shown}{more}): two groups, and the data do not show which is "
        f"right (or noise far from normal); σ of the transform cover both; did an instrument move between them?"
    )


def _layout(subject: Subject, sigma: float) -> list[str]:
    """Returns notes on the layout of the points. ``sigma`` : of a coordinate, by a model that explains the points."""
    model, fitted, notes = subject.problem.model, subject.fitted, []
    rows = np.flatnonzero(fitted.inliers)
    inside, transform = subject.problem.xyz_a[rows], fitted.transform
    if len(rows) <= LEVERAGE_UP_TO and subject.method != "liu2017":
        alone = single_supports(model, inside, sigma)
        kind = "plane" if model.name == "affine" else "line"
        notes += [
            f"only {subject.name(row)} keeps the points off a {kind}, and no other checks it; measure more off it"
            for row in rows[alone[:SHOWN]].tolist()
        ]
    if model.name != "affine" and spreads(inside)[2] < WIDER_THAN * sigma:
        notes.append("the points lie in a plane: a mirrored frame would not be noticed")
    if isinstance(transform, Affine) and np.linalg.det(transform.linear) < 0:
        notes.append("the transform is a reflection: one of the frames is left-handed")
    if isinstance(transform, Similarity):
        scale = transform.scale
        for factor, (name, _) in UNITS.items():
            if abs(max(scale, 1 / scale) / factor - 1) < UNIT_WITHIN:
                notes.append(f"the scale is {scale:.6g}: is {'a' if scale > 1 else 'b'} in {name}?")
    extent = max(float(np.ptp(xyz[rows], axis=0).max()) for xyz in (subject.problem.xyz_a, subject.problem.xyz_b))
    if 0 < extent < SMALL_MM:
        notes.append(f"all points lie within {extent:.2g} mm: if lengths are metres, name the columns _m")
    found = symmetry(inside, fitted.threshold if np.isfinite(fitted.threshold) else 4 * sigma)
    return notes if found is None else [*notes, symmetry_note(found, rows, subject.name)]
