"""What is doubtful in a registration: mistakes in the data, points that do not determine the transform, and notes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from stcal.errors import DegenerateError, InputError, StcalError
from stcal.explain import Candidate, explain
from stcal.geometry.rigid import Affine, Similarity, best_rotations
from stcal.geometry.robust import ratio_limit
from stcal.register.consensus import (
    BY_CHANCE,
    CLEAN_SETS_WITH_OUTLIER,
    LEAST_SHARE,
    LEVERAGE_UP_TO,
    Fitted,
    chance,
    robust_fit,
)
from stcal.register.liu2017 import ASSUMED
from stcal.register.registered import Registration
from stcal.register.row_groups import Shifted, moved_meanwhile, neighbours_alike, order_note
from stcal.register.transforms import AFFINE, MODELS, SHOWN, Model, Problem, Transform, parts, some_of

UNITS = {1000.0: ("m", "m"), 25.4: ("inches", "in"), 10.0: ("cm", "cm")}
"""Units by their length in mm, with name and suffix of their columns."""
UNIT_WITHIN = 0.08
"""Relative tolerance of the ratio. Outliers move the median ratio by a few per cent; the factors are far apart."""
PAIRS = 4000
"""Number of pairs of points whose distances are compared."""


def mistaken_unit(ratio: float) -> str | None:
    """Returns the unit that a ratio of lengths in b to those in a suggests, in words, or None."""
    candidates = [
        Candidate(
            f"is {side} in {name} (columns {', '.join(f'{side}{x}_{suffix}' for x in 'xyz')})?", partial(float, by)
        )
        for factor, (name, suffix) in UNITS.items()
        for side, by in (("a", factor), ("b", 1 / factor))
    ]
    found = explain(candidates, lambda by: abs(ratio / by - 1), UNIT_WITHIN)
    return found[0][0].words if found else None


def check_units(problem: Problem, seed: int) -> None:
    """Raises InputError if the median ratio of distances between the same points in b and a is that of two units."""
    i, j = np.random.default_rng([seed, 3]).integers(len(problem), size=(2, PAIRS))
    in_a, in_b = (np.linalg.norm(xyz[i] - xyz[j], axis=1) for xyz in (problem.xyz_a, problem.xyz_b))
    apart = (in_a > 0) & (in_b > 0)
    ratio = float(np.median(in_b[apart] / in_a[apart])) if apart.any() else 1.0
    if words := mistaken_unit(ratio):
        small, large = "ab" if ratio > 1 else "ba"
        raise InputError(
            "E-REGISTER-UNITS",
            f"registration: distances in {large} are {max(ratio, 1 / ratio):.4g} times those in {small} (median); "
            f"{words}",
        )


MIRROR_RATIO = 4.0
"""Ratio of misfits that indicates a mirrored frame. Mirrored points fit a mirrored frame to noise, and a correct frame
only to their thickness; bent frames never gain so much."""
MIRROR_CHANCE = 1e-4
"""Probability of calling right frames mirrored if the points had thickness only by noise."""
NAMED_BELOW_RAD = np.radians(15)
"""Largest remaining turn of the frames with which a change of sign or exchange of axes is named as the likely cause."""
SUSPICIOUS_SHARE, SUSPICIOUS_SIGMA = 0.5, 0.05
"""Inlier share below which, and σ as a fraction of the points' RMS distance from their centroid above which, a mirrored
frame is tried. Both are met long before a mirrored frame is found; the trial costs time only."""
FLIP = np.array([1, 1, -1.0])
MIRRORED = [(f"the sign of a{axis}", np.diag(np.where(np.arange(3) == k, -1.0, 1.0))) for k, axis in enumerate("xyz")]
MIRRORED += [
    (f"a{'xyz'[i]} and a{'xyz'[j]} with each other", np.eye(3)[order])
    for i, j, order in ((0, 1, [1, 0, 2]), (1, 2, [0, 2, 1]), (0, 2, [2, 1, 0]))
]
"""Changes of a that mend a mirrored frame, with the matrix of each."""


def mirrored_ratio(xyz_a: np.ndarray, xyz_b: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns the square sum of the best rotation over that of the best reflection, and this reflection (3, 3)."""
    a, b = xyz_a - xyz_a.mean(0), xyz_b - xyz_b.mean(0)
    total = (a**2).sum() + (b**2).sum()
    proper = total - 2 * best_rotations(b.T @ a)[1]
    turn, product = best_rotations(b.T @ (a * FLIP))
    floor = 1e-20 * total  # rounding of exact data
    return float(max(proper, floor) / max(total - 2 * product, floor)), turn * FLIP


def check_mirrored(problem: Problem) -> None:
    """Raises InputError if a reflection explains all points far better than any rotation."""
    if problem.model == AFFINE or len(problem) <= problem.model.sample:
        return
    ratio, reflection = mirrored_ratio(problem.xyz_a, problem.xyz_b)
    if ratio > max(MIRROR_RATIO, ratio_limit(MIRROR_CHANCE, problem.redundancy, problem.redundancy)):
        raise _mirrored(reflection, len(problem), len(problem), np.sqrt(ratio))


def check_mirrored_with_outliers(problem: Problem, fitted: Fitted | None, threshold: float | None, seed: int) -> None:
    """Refuses points of which far more agree, or agree far better, if a is mirrored. ``fitted`` : to a as it is."""
    if problem.model == AFFINE:
        return
    if fitted is not None and fitted.inliers.mean() >= SUSPICIOUS_SHARE:
        size = np.sqrt(np.var(problem.xyz_a[fitted.inliers], axis=0).sum())
        if fitted.sigma <= SUSPICIOUS_SIGMA * size:
            return
    image = replace(problem, xyz_a=problem.xyz_a * FLIP)
    try:
        mirrored = robust_fit(image, threshold, seed)
    except DegenerateError:
        return
    if mirrored.inliers.mean() < LEAST_SHARE:  # points near any one plane fit
        return
    usual = 0.0 if fitted is None else chance(problem, fitted)
    if chance(image, mirrored) < 2 * usual + np.log(BY_CHANCE) and (
        fitted is None or mirrored.inliers.sum() > fitted.inliers.sum() or mirrored.sigma < fitted.sigma / 2
    ):
        agreeing = problem[mirrored.inliers]
        times = float(np.sqrt(mirrored_ratio(agreeing.xyz_a, agreeing.xyz_b)[0]))
        linear = parts(mirrored.transform)[0]
        raise _mirrored(linear / np.cbrt(np.linalg.det(linear)) * FLIP, len(agreeing), len(problem), times)


def _mirrored(reflection: np.ndarray, agree: int, count: int, times: float) -> InputError:
    """Returns the error for mirrored data, which names the axis to change if one change makes the frames nearly
    parallel. ``reflection`` : (3, 3), b from a, determinant −1."""
    candidates = [Candidate(words, lambda mend=mend: mend) for words, mend in MIRRORED]
    found = explain(candidates, lambda mend: Rotation.from_matrix(reflection @ mend).magnitude(), NAMED_BELOW_RAD)
    advice = "change the sign of one axis of a or of b"
    if found:
        (mend, turn), *_ = found
        advice = f"change {mend.words}: the frames are then turned by only {np.degrees(turn):.1f}°"
    return InputError(
        "E-REGISTER-MIRRORED",
        f"registration: one of the frames is left-handed: mirrored, {agree} of {count} point pairs fit {times:.3g} "
        f"times better; {advice}",
    )


SCALE_BY_CHANCE = 1e-4
"""Probability of finding two scales in frames of one scale."""
MATTERS = 0.1
"""Least relative decrease of the noise's σ by the wider model. Many points show less, but it matters for none."""
THERMAL = 5e-4
"""Largest relative scale that temperature may cause: 45 K in steel, 20 K in aluminium."""


@dataclass(frozen=True, slots=True, eq=False)
class Wider:
    """A wider model that explains the points: its ``transform``, σ of a coordinate with it, and the message."""

    problem: Problem
    transform: Transform
    sigma_mm: float
    note: str


def wider(problem: Problem, transform: Transform) -> Wider | None:
    """Returns the narrowest wider model that explains the points of ``transform`` better beyond chance, or None."""
    narrow, best = (problem, transform), None
    for model in list(MODELS.values())[list(MODELS).index(problem.model.name) + 1 :]:
        candidate = replace(problem, model=model)
        try:
            fitted = candidate.fit() if len(problem) > model.needed else None
        except StcalError:  # coplanar points have no affine transform
            fitted = None
        if fitted is None:
            break
        before, after = (float(p.squares(t).sum()) for p, t in (narrow, (candidate, fitted)))
        extra, redundancy = model.parameters - narrow[0].model.parameters, candidate.redundancy
        rounding = 3 * len(problem) * problem.rounding_mm() ** 2
        gain = (before - after) / extra / max(after / redundancy, rounding / redundancy)
        sigma = float(np.sqrt(max(after, 0) / redundancy))
        enough = sigma < (1 - MATTERS) * np.sqrt(before / narrow[0].redundancy)
        if before > rounding and gain > ratio_limit(SCALE_BY_CHANCE, extra, redundancy) and enough:
            narrow = candidate, fitted
            best = Wider(candidate, fitted, sigma, f"lengths in b are {_scale_in_words(candidate, fitted, sigma)}")
    return best


def _scale_in_words(problem: Problem, transform: Transform, sigma_mm: float) -> str:
    """Returns the ratio of lengths in b to those in a, the likely cause, and the remedy."""
    if isinstance(transform, Affine):
        scales = np.linalg.svd(transform.linear, compute_uv=False)
        return (
            f"{', '.join(f'{s:.6g}' for s in scales)} times those in a along three axes: an axis of one instrument is "
            "scaled or not square to the others, or an arm bends; correct it, or use --model affine within these points"
        )
    scale = float(np.cbrt(np.linalg.det(parts(transform)[0])))
    sigma = scale * float(np.sqrt((sigma_mm**2 * problem.unit_covariance(transform))[6, 6]))
    digits = max(1, 1 - int(np.floor(np.log10(max(sigma, 1e-15)))))
    cause = "a length standard, a board or an instrument of another scale"
    if abs(scale - 1) < THERMAL:
        cause = f"{1e6 * abs(scale - 1):.0f} ppm, of temperature (steel 11.5, aluminium 23 ppm/K) or a length standard"
    return (
        f"{scale:.{digits}f} ± {sigma:.{digits}f} times those in a: {cause}; correct one of the files, or use --model "
        "similarity"
    )


WIDER_THAN = 10.0
"""Least spread √Σd² of points off a line (affine: off a plane), in σ. The turn about it then has σ ≤ 0.1 rad."""


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
    n, spread, needed = len(xyz_a), spreads(xyz_a), WIDER_THAN * sigma_mm
    off_line, root = float(np.hypot(spread[1], spread[2])), np.sqrt(n)
    if n > model.needed and spread[0] < needed:
        raise by_chance(n, n, sigma_mm)
    if off_line < needed:
        raise DegenerateError(
            "E-POINTS-COLLINEAR",
            f"registration: the {n} points lie along a line, {off_line / root:.4g} mm RMS off it "
            f"({spread[0] / root:.4g} mm along it); {needed / root:.4g} mm needed at σ {sigma_mm:.4g} mm; measure "
            "points off the line",
        )
    if model == AFFINE and spread[2] < needed:
        raise DegenerateError(
            "E-POINTS-COPLANAR",
            f"registration: the {n} points lie in a plane, {spread[2] / root:.4g} mm RMS off it "
            f"({spread[0] / root:.4g} mm along it); {needed / root:.4g} mm needed for the affine model at σ "
            f"{sigma_mm:.4g} mm; measure points off the plane, or use the rigid model",
        )


def single_supports(model: Model, xyz_a: np.ndarray, sigma_mm: float) -> np.ndarray:
    """Returns the indices of points without which :func:`check_extent` refuses the others."""
    n, small = len(xyz_a), 1 if model == AFFINE else 2
    centred = xyz_a - xyz_a.mean(0)
    scatter = centred.T @ centred
    held = np.linalg.eigvalsh(scatter)[:small].sum()
    taken = n / (n - 1) * (centred**2).sum(1)  # upper bound of a point's part of these eigenvalues: few pass it
    rows = np.flatnonzero(held - taken < (1 + 1e-6) * (WIDER_THAN * sigma_mm) ** 2 + 1e-9 * np.trace(scatter))
    own = centred[rows]
    values = np.maximum(np.linalg.eigvalsh(scatter - n / (n - 1) * own[:, :, None] * own[:, None, :]), 0)
    return rows[np.sqrt(values[:, :small].sum(1)) < WIDER_THAN * sigma_mm]


def check_supports(problem: Problem, inliers: np.ndarray, sigma_mm: float) -> None:
    """Raises DegenerateError for a set with outliers if :func:`check_extent` refuses it without a single point, since
    any wrong point would have fitted there."""
    rows = np.flatnonzero(inliers)
    alone = single_supports(problem.model, problem.xyz_a[rows], sigma_mm)
    if len(alone):
        kind = "plane" if problem.model == AFFINE else "line"
        raise DegenerateError(
            "E-REGISTER-DEGENERATE",
            f"registration: only {problem.name(rows[alone[0]])} keeps the {len(rows)} points that agree off a {kind}, "
            f"and any wrong point would fit there as well; measure more points off the {kind}",
        )


SYMMETRY_UP_TO = 200
"""Largest number of points checked for symmetry. Larger sets are clouds, not layouts with labels."""


def symmetry(xyz: np.ndarray, tolerance_mm: float) -> tuple[float, np.ndarray] | None:
    """Returns a turn that maps the points onto themselves but not each onto itself: angle (rad), permutation (n,), of
    the smallest misfit. None if there is none, or points are too close together for the tolerance."""
    n, centred = len(xyz), xyz - xyz.mean(0)
    if not 3 <= n <= SYMMETRY_UP_TO or pdist(centred).min() < 4 * tolerance_mm:
        return None
    radius = np.linalg.norm(centred, axis=1)
    first = int(radius.argmax())
    second = int(np.linalg.norm(np.cross(centred, centred[first]), axis=1).argmax())
    apart = np.linalg.norm(centred[:, None] - centred, axis=2)
    near_first, near_second = (np.abs(radius - radius[i]) < 2 * tolerance_mm for i in (first, second))
    fits = near_first[:, None] & near_second & (np.abs(apart - apart[first, second]) < 2 * tolerance_mm)
    fits[first, second] = False
    tree, least, best = KDTree(centred), np.inf, None
    for i, j in np.argwhere(fits):
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
LOOKED_AT = 10_000
"""Largest number of outliers that are examined. More would show the same mistakes."""


def notes_of(result: Registration, problem: Problem, other: Wider | None, shifted: Shifted | None) -> tuple[str, ...]:
    """Returns all notes on a registration.

    ``other`` : a wider model that explains the points; ``shifted`` : inliers that are shifted together.
    """
    inside, transform, sigma = problem[result.inliers], result.b_from_a, result.sigma_mm
    if other is not None:
        inside, transform, sigma = other.problem, other.transform, other.sigma_mm
    return (
        *_on_agreement(result, problem),
        *([] if other is None else [other.note]),
        *_on_noise(result, problem, inside, transform),
        *([] if shifted is None else [_shift_note(result, problem, shifted)]),
        *_on_certainty(result, inside),
        *_on_layout(result, problem, sigma),
        *_on_outliers(result, problem),
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
        square, redundancy = (result.residuals**2).sum(1), problem.redundancy
        bound = square.sum() / redundancy * 3 * ratio_limit(CLEAN_SETS_WITH_OUTLIER / count, 3, redundancy)
        if square.max() > bound:
            worst = int(square.argmax())
            yield (
                f"{(square > bound).sum()} points lie farther off than noise would put them, the farthest "
                f"{problem.name(worst)} at {np.sqrt(square[worst]):.4g} mm; use the robust method"
            )


def _on_noise(result: Registration, problem: Problem, inside: Problem, transform: Transform) -> Iterator[str]:
    residuals = inside.residuals(transform)
    if np.abs(residuals).max() > inside.rounding_mm() and neighbours_alike(inside.xyz_a, residuals):
        yield (
            "the residuals are not noise: neighbours have similar errors, so that the frames are bent relative to each "
            "other, and a transform is valid only where its points are; see the residual field"
        )
    if transform is result.b_from_a and result.method != "liu2017":  # no wider model explains the points
        change = moved_meanwhile(problem, transform)
        if change is not None:
            yield order_note(change, problem)


def _shift_note(result: Registration, problem: Problem, shifted: Shifted) -> str:
    by = ", ".join(f"{v:.3g}" for v in shifted.by_mm)
    where = ", and lie together" if shifted.together else ""
    names = problem.names(np.flatnonzero(result.inliers)[shifted.rows])
    return (
        f"{len(shifted.rows)} rows agree with each other on a shift of ({by}) mm against the other "
        f"{shifted.count - len(shifted.rows)}{where} ({names}): two groups, and the data do not show which is right "
        "(or noise far from normal); σ of the transform cover both; did an instrument move between them?"
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
        kind = "plane" if model == AFFINE else "line"
        for row in rows[single_supports(model, inside, sigma)[:SHOWN]]:
            yield f"only {problem.name(row)} keeps the points off a {kind}, and no other checks it; measure more off it"
    if model != AFFINE and spreads(inside)[2] < WIDER_THAN * sigma:
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


def _on_outliers(result: Registration, problem: Problem) -> Iterator[str]:
    """Yields notes on outliers that a slip explains: exchanged rows, or another unit."""
    rows, reach = np.flatnonzero(~result.inliers)[:LOOKED_AT], result.threshold_mm
    if not len(rows) or reach is None:
        return
    a, b, transform = problem.xyz_a[rows], problem.xyz_b[rows], result.b_from_a
    mapped = transform @ a
    distance, nearest = (np.asarray(each) for each in KDTree(mapped).query(b))
    swapped = np.flatnonzero((distance <= reach) & (nearest != np.arange(len(rows))))
    taken = np.minimum(1, 2 * reach / np.maximum(np.ptp(mapped, axis=0), 1e-300)).prod()
    unlikely = bdtrc(len(swapped) - 1, len(rows), 1 - (1 - taken) ** (len(rows) - 1)) < BY_CHANCE
    if len(swapped) and unlikely:
        names = some_of(swapped, lambda i: f"{problem.name(rows[i])} is the point of {problem.name(rows[nearest[i]])}")
        yield f"rows exchanged: b of {names}; correct the order"
    linear, translation = parts(transform)
    back = np.linalg.inv(linear)
    for factor in [f for unit in UNITS for f in (unit, 1 / unit)]:
        of_b = (b * factor - translation) @ back.T - a
        for side, residual in (("a", b - transform @ (a * factor)), ("b", of_b)):
            fits = rows[np.linalg.norm(residual, axis=1) <= reach]
            if len(fits):
                yield f"another unit: {side} of {problem.names(fits)} fits when multiplied by {factor:.6g}; correct it"
