"""Checks whether the points determine the transform, and notes on what a user should check, one line each."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Affine, Similarity, best_rotations
from stcal.geometry.robust import ratio_limit
from stcal.register.liu2017 import ASSUMED
from stcal.register.mistakes import (
    Shifted,
    Wider,
    mistaken_unit,
    moved_meanwhile,
    neighbours_alike,
    order_note,
    outlier_notes,
)
from stcal.register.models import Model, squares
from stcal.register.pairs import SHOWN, Problem, some_of
from stcal.register.result import Registration
from stcal.register.robust import CLEAN_SETS_WITH_OUTLIER, LEVERAGE_UP_TO

WIDER_THAN = 10.0
"""Least spread √Σd² of points off a line (affine: off a plane), in σ. The turn about it then has σ ≤ 0.1 rad."""
SYMMETRY_UP_TO = 200
"""Largest number of points checked for symmetry. Larger sets are clouds, not layouts with labels."""


def spreads(xyz: np.ndarray) -> np.ndarray:
    """Returns the root square sums (3,) of centred points along their principal axes, the longest first, mm."""
    centred = xyz - xyz.mean(0)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred)[::-1], 0))


def by_chance(agreeing: int, n: int, sigma_mm: float) -> DegenerateError:
    """Returns the error of point pairs that agree no better than chance."""
    return DegenerateError(
        "E-REGISTER-CHANCE",
        f"registration: {agreeing} of {n} point pairs agree to {sigma_mm:.4g} mm, no better than chance; check that "
        "row i of both is the same point",
    )


def check_extent(model: Model, xyz_a: np.ndarray, sigma_mm: float) -> None:
    """Raises DegenerateError if points do not determine the model at their σ: along a line, in a plane for the affine
    model, or with σ as large as their extent."""
    n, spread = len(xyz_a), spreads(xyz_a)
    needed = WIDER_THAN * sigma_mm
    off_line = float(np.hypot(spread[1], spread[2]))
    length = spread[0] / np.sqrt(n)
    if n > model.needed and spread[0] < needed:
        raise by_chance(n, n, sigma_mm)
    if off_line < needed:
        raise DegenerateError(
            "E-POINTS-COLLINEAR",
            f"registration: the {n} points lie along a line, {off_line / np.sqrt(n):.4g} mm RMS off it ({length:.4g} "
            f"mm along it); {needed / np.sqrt(n):.4g} mm needed at σ {sigma_mm:.4g} mm; measure points off the line",
        )
    if model.name == "affine" and spread[2] < needed:
        raise DegenerateError(
            "E-POINTS-COPLANAR",
            f"registration: the {n} points lie in a plane, {spread[2] / np.sqrt(n):.4g} mm RMS off it ({length:.4g} mm "
            f"along it); {needed / np.sqrt(n):.4g} mm needed for the affine model at σ {sigma_mm:.4g} mm; measure "
            "points off the plane, or use the rigid model",
        )


def single_supports(model: Model, xyz_a: np.ndarray, sigma_mm: float) -> np.ndarray:
    """Returns the indices of points without which :func:`check_extent` refuses the others."""
    n = len(xyz_a)
    centred = xyz_a - xyz_a.mean(0)
    scatter = centred.T @ centred
    held = np.linalg.eigvalsh(scatter)[: 1 if model.name == "affine" else 2].sum()
    taken = n / (n - 1) * (centred**2).sum(1)  # upper bound of a point's part of these eigenvalues: few pass it
    rows = np.flatnonzero(held - taken < (1 + 1e-6) * (WIDER_THAN * sigma_mm) ** 2 + 1e-9 * np.trace(scatter))
    own = centred[rows]
    values = np.maximum(np.linalg.eigvalsh(scatter - n / (n - 1) * own[:, :, None] * own[:, None, :]), 0)
    off = values[:, 0] if model.name == "affine" else values[:, 0] + values[:, 1]
    return rows[np.sqrt(off) < WIDER_THAN * sigma_mm]


def check_supports(problem: Problem, inliers: np.ndarray, sigma_mm: float) -> None:
    """Raises DegenerateError for a set with outliers if :func:`check_extent` refuses it without a single point, since
    any wrong point would have fitted there."""
    rows = np.flatnonzero(inliers)
    alone = single_supports(problem.model, problem.xyz_a[rows], sigma_mm)
    if len(alone):
        kind = "plane" if problem.model.name == "affine" else "line"
        raise DegenerateError(
            "E-REGISTER-DEGENERATE",
            f"registration: only {problem.name(rows[alone[0]])} keeps the {len(rows)} points that agree off a {kind}, "
            f"and any wrong point would fit there as well; measure more points off the {kind}",
        )


def symmetry(xyz: np.ndarray, tolerance_mm: float) -> tuple[float, np.ndarray] | None:
    """Returns a turn that maps the points onto themselves but not each onto itself: angle (rad), permutation (n,), of
    the smallest misfit. None if there is none, or points are too close together for the tolerance."""
    n = len(xyz)
    if not 3 <= n <= SYMMETRY_UP_TO:
        return None
    centred = xyz - xyz.mean(0)
    if pdist(centred).min() < 4 * tolerance_mm:
        return None
    radius = np.linalg.norm(centred, axis=1)
    first = int(radius.argmax())
    second = int(np.linalg.norm(np.cross(centred, centred[first]), axis=1).argmax())
    apart = np.linalg.norm(centred[:, None] - centred, axis=2)
    near_first, near_second = (np.abs(radius - radius[i]) < 2 * tolerance_mm for i in (first, second))
    fits = near_first[:, None] & near_second & (np.abs(apart - apart[first, second]) < 2 * tolerance_mm)
    tree = KDTree(centred)
    least, best = np.inf, None
    for i, j in np.argwhere(fits):
        if (i, j) == (first, second):
            continue
        turn = best_rotations(centred[[i, j]].T @ centred[[first, second]])[0]
        to = np.arange(n)
        for _ in range(2):  # from two points, then from all: the first two carry their own noise
            to = np.asarray(tree.query(centred @ turn.T)[1])
            turn = best_rotations(centred[to].T @ centred)[0]
        misfit = np.linalg.norm(centred @ turn.T - centred[to], axis=1).max()
        is_one = len(np.unique(to)) == n and (to != np.arange(n)).any()
        if is_one and misfit <= 2 * tolerance_mm and misfit < least:
            least, best = misfit, (float(Rotation.from_matrix(turn).magnitude()), to)
    return best


LOW_REDUNDANCY = 6
"""Degrees of freedom below which the relative uncertainty of σ exceeds 30 %."""
MAJORITY = 0.5
"""Fraction of the point pairs below which a note says that few agree."""
SMALL_MM = 20.0
"""Extent of points below which they may be in metres: 20 m are 20 mm then. Few parts that are measured are smaller."""
TIGHT = 2.5
"""Threshold in σ below which the covariance of few points is too small. 2.5 σ cuts off a tenth of the good points."""


def notes_of(result: Registration, problem: Problem, other: Wider | None, shifted: Shifted | None) -> tuple[str, ...]:
    """Returns all notes on a registration.

    ``other`` : a wider model that explains the points; ``shifted`` : inliers that are shifted together.
    """
    sigma = result.sigma_mm if other is None else other.sigma_mm
    return (
        *_on_agreement(result, problem),
        *_on_noise(result, problem, other, shifted),
        *_on_certainty(result, problem[result.inliers] if other is None else other.problem),
        *_on_layout(result, problem, sigma),
        *outlier_notes(result, problem),
    )


def _on_agreement(result: Registration, problem: Problem) -> Iterator[str]:
    other, agree, count = result.alternative, int(result.inliers.sum()), len(result)
    if agree < MAJORITY * count:
        yield f"only {agree} of {count} point pairs agree; check the others before you trust the transform"
    if other is not None:
        start = "AMBIGUOUS: " if result.ambiguous else ""
        yield (
            f"{start}{len(other.rows)} of the other points agree on another transform, {other.apart_mm:.4g} mm and "
            f"{np.degrees(other.turn_rad):.3g}° from this one ({problem.names(other.rows)}); did an instrument move "
            "between them?"
        )
    if result.method == "liu2017":
        yield ASSUMED
    if result.method == "least-squares":  # rows that the robust method would examine
        square, redundancy = squares(result.residuals), problem.redundancy
        bound = square.sum() / redundancy * 3 * ratio_limit(CLEAN_SETS_WITH_OUTLIER / count, 3, redundancy)
        if square.max() > bound:
            worst = int(square.argmax())
            yield (
                f"{(square > bound).sum()} points lie farther off than noise would put them, the farthest "
                f"{problem.name(worst)} at {np.sqrt(square[worst]):.4g} mm; use the robust method"
            )


def _on_noise(result: Registration, problem: Problem, other: Wider | None, shifted: Shifted | None) -> Iterator[str]:
    inside, transform = problem[result.inliers], result.b_from_a
    if other is not None:
        yield other.note
        inside, transform = other.problem, other.transform
    residuals = inside.residuals(transform)
    if np.abs(residuals).max() > inside.rounding_mm() and neighbours_alike(inside.xyz_a, residuals):
        yield (
            "the residuals are not noise: neighbours have similar errors, so that the frames are bent relative to each "
            "other, and a transform is valid only where its points are; see the residual field"
        )
    if other is None and result.method != "liu2017":
        change = moved_meanwhile(problem, transform)
        if change is not None:
            yield order_note(change, problem)
    if shifted is not None:
        by = ", ".join(f"{v:.3g}" for v in shifted.by_mm)
        where = ", and lie together" if shifted.together else ""
        names = problem.names(np.flatnonzero(result.inliers)[shifted.rows])
        yield (
            f"{len(shifted.rows)} rows agree with each other on a shift of ({by}) mm against the other "
            f"{shifted.count - len(shifted.rows)}{where} ({names}): two groups, and the data do not show which is "
            "right (or noise far from normal); σ of the transform cover both; did an instrument move between them?"
        )


def _on_certainty(result: Registration, inside: Problem) -> Iterator[str]:
    """Yields notes on σ. ``inside`` : the inliers, with a model that explains them."""
    if result.sigma_factor is not None and result.scaled:
        yield (
            f"residuals exceed the σ given {result.sigma_factor:.3g} times, which is beyond chance; the covariance is "
            f"scaled by this factor"
        )
    enough = inside.model.sample + 1  # all but any one of so many fit: their residuals cannot show which one is wrong
    if len(inside) <= enough and result.scaled:
        yield f"of {len(inside)} points a wrong one cannot be identified: measure {enough + 2 - len(inside)} more"
    if result.redundancy < LOW_REDUNDANCY:
        yield f"σ rests on {result.redundancy:.0f} degrees of freedom and is a rough guess; measure more points"
    threshold, sigma = result.threshold_mm, result.sigma_mm
    if threshold is not None and threshold < TIGHT * sigma and result.method == "robust":
        yield (
            f"the threshold of {threshold:.4g} mm is only {threshold / sigma:.2g} σ and cuts off good points; leave "
            "it out to have it estimated"
        )


def _on_layout(result: Registration, problem: Problem, sigma: float) -> Iterator[str]:
    """Yields notes on the layout of the points. ``sigma`` : of a coordinate, by a model that explains the points."""
    model, transform, rows = problem.model, result.b_from_a, np.flatnonzero(result.inliers)
    inside = problem.xyz_a[rows]
    if len(rows) <= LEVERAGE_UP_TO and result.method != "liu2017":
        kind = "plane" if model.name == "affine" else "line"
        for row in rows[single_supports(model, inside, sigma)[:SHOWN]]:
            yield f"only {problem.name(row)} keeps the points off a {kind}, and no other checks it; measure more off it"
    if model.name != "affine" and spreads(inside)[2] < WIDER_THAN * sigma:
        yield "the points lie in a plane: a mirrored frame would not be noticed"
    if isinstance(transform, Affine) and np.linalg.det(transform.linear) < 0:
        yield "the transform is a reflection: one of the frames is left-handed"
    if isinstance(transform, Similarity) and (unit := mistaken_unit(transform.scale)):
        yield f"the scale is {transform.scale:.6g}: {unit}"
    extent = max(float(np.ptp(xyz[rows], axis=0).max()) for xyz in (problem.xyz_a, problem.xyz_b))
    if 0 < extent < SMALL_MM:
        yield f"all points lie within {extent:.2g} mm: if lengths are metres, name the columns _m"
    found = symmetry(inside, 4 * sigma if result.threshold_mm is None else result.threshold_mm)
    if found is not None:
        angle, to = found
        moved = np.flatnonzero(to != np.arange(len(to)))
        names = some_of(moved, lambda i: f"{problem.name(rows[i])} → {problem.name(rows[to[i]])}")
        yield (
            f"the layout is symmetric: a turn by {np.degrees(angle):.1f}° maps it onto itself ({names}); "
            "labels exchanged like that would fit as well, so check that rows are the same points"
        )
