"""What is doubtful in a registration: rows that moved together, mistakes in the data, points that do not determine it.

Rows that moved together are sought along their order, in two groups that overlap, and shifted against the others.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc, ndtr

from stcal.errors import DegenerateError, InputError, StcalError
from stcal.geometry.rigid import Affine, Rigid, Similarity, best_rotations
from stcal.geometry.robust import ratio_limit
from stcal.register import consensus
from stcal.register.consensus import AFFINE, MODELS, RIGID, Fitted, Model, Problem
from stcal.register.registered import Registration
from stcal.row_order import Change, change_along

NEIGHBOURS = 2000
"""Largest number of points whose residuals are compared with the nearest neighbour's."""
FEWEST_NEIGHBOURS = 20
"""Least number of points for this comparison, as the sum of fewer products is not normal."""
BY_NEIGHBOURS = 1e-4  # probability of calling clean data bent


def neighbours_alike(xyz_a: np.ndarray, residuals: np.ndarray) -> bool:
    """Returns whether residuals (n, 3) correlate with those of their nearest neighbours beyond chance."""
    rows = slice(None, None, max(1, len(xyz_a) // NEIGHBOURS))
    xyz, r = xyz_a[rows], residuals[rows]
    if len(xyz) < FEWEST_NEIGHBOURS:
        return False
    pairs = np.column_stack([np.arange(len(xyz)), _nearest(xyz)])
    one, two = np.unique(np.sort(pairs, axis=1), axis=0).T
    product = np.einsum("ni,ni->n", r[one], r[two])  # the variance of their sum is the sum of their squares
    return bool(ndtr(-product.sum() / max(np.sqrt((product**2).sum()), 1e-300)) < BY_NEIGHBOURS)


def _nearest(xyz: np.ndarray) -> np.ndarray:
    return np.asarray(KDTree(xyz).query(xyz, k=2)[1])[:, 1]


LEVEL, IN_ORDER = 0.01, 10_000
"""Probability that sound points seem to move along their rows; largest number examined, as more are clouds."""


def moved_meanwhile(problem: Problem, transform: Affine) -> Change | None:
    """Returns the jump or drift of one frame against the other along the order of the rows; None if there is none
    beyond chance, or the frames are bent and it explains no bend."""
    if len(problem) > IN_ORDER:
        return None
    from_middle = problem.xyz_a - problem.xyz_a.mean(0)
    residuals, turned = problem.residuals(transform), Rigid(consensus.rotation_of(transform))
    motions = consensus.jacobian(RIGID, turned, from_middle)
    by_parameters = consensus.jacobian(problem.model, transform, from_middle)
    change = change_along(*(problem.whitened(each) for each in (residuals, by_parameters, motions)))
    size = 0.0 if change is None else float(np.abs(motions @ change.motion).max())
    if change is None or change.p > LEVEL or size <= problem.rounding_mm():
        return None
    rest = residuals - change.moves[:, None] * (motions @ change.motion)
    alike = [neighbours_alike(problem.xyz_a[change.good], each[change.good]) for each in (residuals, rest)]
    return None if all(alike) else change


def order_note(change: Change, problem: Problem) -> str:
    """Returns one line on a change along the order of the rows."""
    size = f"{np.linalg.norm(change.motion[3:]):.3g} mm and {np.degrees(np.linalg.norm(change.motion[:3])):.2g}°"
    share = f"{change.share:.0%} of the squared residuals, p {'< 0.001' if change.p < 1e-3 else f'= {change.p:.2g}'}"
    if change.kind == "drift":
        return f"one frame drifts against the other along the rows, by {size} from the first to the last ({share})"
    first, row, last = (problem.name(row) for row in (change.first, change.row, change.last))
    likely = f" ({first} to {last} as likely)" if first != last else ""
    moved = f"from {row} on{likely} an instrument stands elsewhere, by {size} ({share})"
    return f"{moved}: register the rows before it, and those from it on, separately"


TRIED = 200  # largest number of points that are examined for groups
TOGETHER = 0.01  # probability that scattered groups seem to lie together


def lies_together(xyz_a: np.ndarray, group: np.ndarray) -> bool:
    """Returns whether neighbours are in the same group more often than by chance."""
    same = int((group[_nearest(xyz_a)] == group).sum())
    share = group.mean()
    return bool(bdtrc(same - 1, len(group), share**2 + (1 - share) ** 2) < TOGETHER)


NEEDED, ALONG = 14.5, 9.2
"""Least gain in log likelihood: along any direction, and along the first principal axis."""
SMALLEST_GROUP, NARROWEST = 0.15, 0.01
"""Smallest fraction of the points in a group, and smallest ratio of its variance to that of all along the shift."""


@dataclass(frozen=True, slots=True, eq=False)
class Shifted:
    """``rows`` : (m,) of the smaller group of ``count`` points; ``by_mm`` : (3,) its shift, frame b."""

    rows: np.ndarray
    count: int
    by_mm: np.ndarray


def shifted_rows(problem: Problem, transform: Affine) -> Shifted | None:
    """Returns the rows that are shifted together; None if there is no such group, a bent frame, or too few points."""
    count = len(problem)
    plain = problem.residuals(transform)
    residuals = problem.whitened(plain)
    if count < FEWEST_NEIGHBOURS or np.abs(residuals).max() <= problem.rounding_mm():
        return None
    sample = np.unique(np.linspace(0, count - 1, min(count, TRIED)).astype(int))
    middle = residuals[sample].mean(0)
    centred = residuals[sample] - middle
    variances, axes = np.linalg.eigh(centred.T @ centred / len(sample))
    if variances[0] <= 1e-12 * variances[2]:
        return None
    to_unit = axes / np.sqrt(variances) @ axes.T
    unit = centred @ to_unit
    best = _clear(unit, axes)
    if best is None or neighbours_alike(problem.xyz_a, plain):
        return None
    _, axis, border = best
    second = (residuals - middle) @ to_unit @ axis < border
    if second.sum() > count / 2:
        second = ~second
    by_mm = plain[second].mean(0) - plain[~second].mean(0)
    return Shifted(np.flatnonzero(second), count, by_mm)


Parted = tuple[float, np.ndarray, float]
"""Gain of log likelihood by two groups, the axis of their shift, and the border between them along it."""


def _clear(unit: np.ndarray, axes: np.ndarray) -> Parted | None:
    """Divides residuals (n, 3) of unit scatter into two groups, or None; ``axes`` : principal, longest last."""
    best = max((_parted(unit, axis) for axis in (*_by_kurtosis(unit).T, *axes.T)), key=lambda found: found[0])
    across = unit - (unit @ best[1])[:, None] * best[1]
    rest = max(_parted(across, axis)[0] for axis in _by_kurtosis(across).T[1:])
    if best[0] - max(rest, 0.0) > NEEDED:
        return best
    *others, (gain, sign, border) = (_parted(unit @ axis[:, None], np.ones(1)) for axis in axes.T)
    if gain - max(0.0, *(each[0] for each in others)) > ALONG:
        return gain, sign[0] * axes[:, 2], border
    return None


def _by_kurtosis(unit: np.ndarray) -> np.ndarray:
    """Returns directions as columns (3, 3), by ascending kurtosis (Cardoso 1989), those without variance first."""
    return np.linalg.eigh((unit * (unit**2).sum(1)[:, None]).T @ unit)[1]


def _parted(unit: np.ndarray, axis: np.ndarray) -> Parted:
    """Divides residuals (n, d) of unit scatter into two groups, starting from the median along ``axis``."""
    along = unit @ axis
    first = (along > np.median(along)).astype(float)
    low, high, apart = 0.0, 0.0, 0.0
    for _ in range(60):
        share = float(np.clip(first.mean(), SMALLEST_GROUP, 1 - SMALLEST_GROUP))
        shift = first @ unit / max(first.sum(), 1e-300) - (1 - first) @ unit / max(len(first) - first.sum(), 1e-300)
        apart = max(float(np.linalg.norm(shift)), 1e-12)
        axis, narrow = shift / apart, max(1 - share * (1 - share) * apart**2, NARROWEST)
        high, low = (1 - share) * apart, -share * apart
        along = unit @ axis
        one = np.log(share) - (along - high) ** 2 / (2 * narrow)
        two = np.log1p(-share) - (along - low) ** 2 / (2 * narrow)
        both = np.logaddexp(one, two)
        first = np.exp(one - both)
    gain = float((both + along**2 / 2).sum() - len(unit) / 2 * np.log(narrow))
    border = (high + low) / 2 - narrow / apart * np.log(share / (1 - share))
    return gain, axis, float(border)


UNITS = {1000.0: ("m", "m"), 25.4: ("inches", "in"), 10.0: ("cm", "cm")}
"""Units by their length in mm, with name and suffix of their columns."""
UNIT_WITHIN, PAIRS = 0.08, 4000
"""Relative tolerance of the median ratio of so many pairs' distances; outliers move it by a few per cent."""


def mistaken_unit(ratio: float) -> str | None:
    """Returns the unit that a ratio of lengths in b to those in a suggests, in words, or None."""
    sides = [(abs(ratio / by - 1), "a", names) for by, names in UNITS.items()]
    sides += [(abs(ratio * by - 1), "b", names) for by, names in UNITS.items()]
    off, side, (name, suffix) = min(sides)
    if off >= UNIT_WITHIN:
        return None
    return f"is {side} in {name} (columns {', '.join(f'{side}{x}_{suffix}' for x in 'xyz')})?"


def check_units(problem: Problem, seed: int) -> None:
    """Raises InputError if the median ratio of distances between the same points in b and a is that of two units."""
    i, j = np.random.default_rng([seed, 3]).integers(len(problem), size=(2, PAIRS))
    in_a, in_b = (np.linalg.norm(xyz[i] - xyz[j], axis=1) for xyz in (problem.xyz_a, problem.xyz_b))
    apart = (in_a > 0) & (in_b > 0)
    ratio = float(np.median(in_b[apart] / in_a[apart])) if apart.any() else 1.0
    if words := mistaken_unit(ratio):
        small, large = "ab" if ratio > 1 else "ba"
        fault = f"registration: distances in {large} are {max(ratio, 1 / ratio):.4g} times those in {small} (median)"
        raise InputError("E-REGISTER-UNITS", f"{fault}; {words}")


MIRROR_RATIO, MIRROR_CHANCE = 4.0, 1e-4
"""Least ratio of misfits of a mirrored frame, more than bent frames gain, and its probability for right frames."""
SUSPICIOUS_SHARE, SUSPICIOUS_SIGMA = 0.5, 0.05
"""Inlier share below which, and σ over the points' RMS distance from their middle above which, a mirror is tried."""
FLIP = np.array([1, 1, -1.0])


def mirrored_ratio(xyz_a: np.ndarray, xyz_b: np.ndarray) -> float:
    """Returns the square sum of the best rotation over that of the best reflection."""
    a, b = xyz_a - xyz_a.mean(0), xyz_b - xyz_b.mean(0)
    total = (a**2).sum() + (b**2).sum()
    proper, mirrored = (total - 2 * best_rotations(b.T @ each)[1] for each in (a, a * FLIP))
    floor = 1e-20 * total  # rounding of exact data
    return float(max(proper, floor) / max(mirrored, floor))


def check_mirrored(problem: Problem) -> None:
    """Raises InputError if a reflection explains all points far better than any rotation."""
    if problem.model == AFFINE or len(problem) <= problem.model.sample:
        return
    ratio = mirrored_ratio(problem.xyz_a, problem.xyz_b)
    if ratio > max(MIRROR_RATIO, ratio_limit(MIRROR_CHANCE, problem.redundancy, problem.redundancy)):
        raise _mirrored(len(problem), len(problem), ratio)


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
        mirrored = consensus.robust_fit(image, threshold, seed)
    except DegenerateError:
        return
    if mirrored.inliers.mean() < consensus.LEAST_SHARE:  # points near any one plane fit
        return
    usual = 0.0 if fitted is None else consensus.chance(problem, fitted)
    if consensus.chance(image, mirrored) < 2 * usual + np.log(consensus.BY_CHANCE) and (
        fitted is None or mirrored.inliers.sum() > fitted.inliers.sum() or mirrored.sigma < fitted.sigma / 2
    ):
        agreeing = problem[mirrored.inliers]
        raise _mirrored(len(agreeing), len(problem), mirrored_ratio(agreeing.xyz_a, agreeing.xyz_b))


def _mirrored(agree: int, count: int, ratio: float) -> InputError:
    better = f"mirrored, {agree} of {count} point pairs fit {np.sqrt(ratio):.3g} times better"
    fault = f"registration: one of the frames is left-handed: {better}"
    return InputError("E-REGISTER-MIRRORED", f"{fault}; change the sign of one axis of a or of b, or exchange two")


SCALE_BY_CHANCE, MATTERS = 1e-4, 0.1
"""Probability of two scales in frames of one, and least relative decrease of σ by the wider model that matters."""


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """Points, the transform by the model that explains them, σ of a coordinate with it, and a note if that is a wider
    model than was asked for."""

    problem: Problem
    transform: Affine
    sigma_mm: float
    note: str = ""


def explained(problem: Problem, transform: Affine, sigma_mm: float) -> Explained:
    """Returns the points with the narrowest wider model that explains them better beyond chance, or as given."""
    narrow, transform_of, sigma = problem, transform, sigma_mm
    for model in list(MODELS.values())[list(MODELS).index(problem.model.name) + 1 :]:
        candidate = replace(problem, model=model)
        try:
            fitted = candidate.fit() if len(problem) > model.needed else None
        except StcalError:  # coplanar points have no affine transform
            fitted = None
        if fitted is None:
            break
        before, after = (float(p.squares(t).sum()) for p, t in ((narrow, transform_of), (candidate, fitted)))
        extra, redundancy = model.parameters - narrow.model.parameters, candidate.redundancy
        rounding = 3 * len(problem) * problem.rounding_mm() ** 2
        gain = (before - after) / extra / max(after / redundancy, rounding / redundancy)
        decrease = np.sqrt(max(after, 0) / redundancy) / max(np.sqrt(before / narrow.redundancy), 1e-300)
        if before > rounding and gain > ratio_limit(SCALE_BY_CHANCE, extra, redundancy) and decrease < 1 - MATTERS:
            narrow, transform_of, sigma = candidate, fitted, float(np.sqrt(max(after, 0) / redundancy))
    if narrow is problem:
        return Explained(problem, transform, sigma_mm)
    scales = np.linalg.svd(transform_of.linear, compute_uv=False)
    if narrow.model == AFFINE:
        said = (
            f"{', '.join(f'{s:.6g}' for s in scales)} times those in a along three axes: an axis of one instrument is "
            "scaled or not square to the others, or an arm bends; correct it, or use --model affine within these points"
        )
    else:
        scale = float(np.cbrt(scales.prod()))
        of_scale = scale * sigma * float(np.sqrt(narrow.unit_covariance(transform_of)[6, 6]))
        digits = max(1, 1 - int(np.floor(np.log10(max(of_scale, 1e-15)))))
        said = (
            f"{scale:.{digits}f} ± {of_scale:.{digits}f} times those in a: temperature (steel 11.5, aluminium 23 "
            "ppm/K), a length standard, a board or an instrument of another scale; correct one of the files, or use "
            "--model similarity"
        )
    return Explained(narrow, transform_of, sigma, f"lengths in b are {said}")


WIDER_THAN = 10.0
"""Least spread √Σd² of points off a line (affine: off a plane), in σ. The turn about it then has σ ≤ 0.1 rad."""


def spreads(xyz: np.ndarray) -> np.ndarray:
    """Returns the root square sums (3,) of centred points along their principal axes, the longest first, mm."""
    centred = xyz - xyz.mean(0)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred)[::-1], 0))


def by_chance(agreeing: int, n: int, sigma_mm: float) -> DegenerateError:
    """Returns the error of point pairs that agree no better than chance."""
    fault = f"registration: {agreeing} of {n} point pairs agree to {sigma_mm:.4g} mm, no better than chance"
    return DegenerateError("E-REGISTER-CHANCE", f"{fault}; check that row i of both is the same point")


def check_extent(model: Model, xyz_a: np.ndarray, sigma_mm: float) -> None:
    """Raises DegenerateError if points do not determine the model at their σ: in a line, plane (affine) or point."""
    n, spread, needed = len(xyz_a), spreads(xyz_a), WIDER_THAN * sigma_mm
    off_line, root = float(np.hypot(spread[1], spread[2])), np.sqrt(n)
    if n > model.needed and spread[0] < needed:
        raise by_chance(n, n, sigma_mm)
    if off_line < needed:
        lie = f"along a line, {off_line / root:.4g} mm RMS off it ({spread[0] / root:.4g} mm along it)"
        least = f"{needed / root:.4g} mm needed at σ {sigma_mm:.4g} mm; measure points off the line"
        raise DegenerateError("E-POINTS-COLLINEAR", f"registration: the {n} points lie {lie}; {least}")
    if model == AFFINE and spread[2] < needed:
        lie = f"in a plane, {spread[2] / root:.4g} mm RMS off it ({spread[0] / root:.4g} mm along it)"
        least = f"{needed / root:.4g} mm needed for the affine model at σ {sigma_mm:.4g} mm"
        remedy = "measure points off the plane, or use the rigid model"
        raise DegenerateError("E-POINTS-COPLANAR", f"registration: the {n} points lie {lie}; {least}; {remedy}")


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
    """Raises DegenerateError if :func:`check_extent` refuses inliers without one: any wrong one would fit there."""
    rows = np.flatnonzero(inliers)
    alone = single_supports(problem.model, problem.xyz_a[rows], sigma_mm)
    if len(alone):
        kind = "plane" if problem.model == AFFINE else "line"
        fault = f"only {problem.name(rows[alone[0]])} keeps the {len(rows)} points that agree off a {kind}"
        wrong = "and any wrong point would fit there as well"
        raise DegenerateError(
            "E-REGISTER-DEGENERATE", f"registration: {fault}, {wrong}; measure more points off the {kind}"
        )


ASSUMED = (
    "liu2017: eqs. 8 and 9 are not legible in the source; taken as: the share of inliers among the points outside the "
    "sample, and the variance of their distances"
)
SMALL_MM = 20.0
"""Extent of points below which they may be in metres: 20 m are 20 mm then. Few parts that are measured are smaller."""


def notes_of(result: Registration, problem: Problem, found: Explained, shifted: Shifted | None) -> Iterator[str]:
    """Yields all notes on a registration. ``found`` : its inliers; ``shifted`` : those that are shifted together."""
    inside = found.problem
    yield from _on_agreement(result, problem)
    if found.note:
        yield found.note
    residuals = inside.residuals(found.transform)
    if np.abs(residuals).max() > inside.rounding_mm() and neighbours_alike(inside.xyz_a, residuals):
        yield (
            "the residuals are not noise: neighbours have similar errors, so that the frames are bent relative to each "
            "other, and a transform is valid only where its points are; see the residual field"
        )
    if not found.note and result.method != "liu2017" and (change := moved_meanwhile(problem, found.transform)):
        yield order_note(change, problem)
    if shifted is not None:
        by = ", ".join(f"{v:.3g}" for v in shifted.by_mm)
        names = problem.names(np.flatnonzero(result.inliers)[shifted.rows])
        yield (
            f"{len(shifted.rows)} rows agree with each other on a shift of ({by}) mm against the other "
            f"{shifted.count - len(shifted.rows)} ({names}): two groups, and the data do not show which is "
            "right (or noise far from normal); σ of the transform cover both; did an instrument move between them?"
        )
    if result.sigma_factor is not None and result.scaled:
        excess = f"residuals exceed the σ given {result.sigma_factor:.3g} times, which is beyond chance"
        yield f"{excess}; the covariance is scaled by this factor"
    enough = inside.model.sample + 1  # all but any one of so many fit: their residuals cannot show which one is wrong
    if len(inside) <= enough and result.scaled:
        yield f"of {len(inside)} points a wrong one cannot be identified: measure {enough + 2 - len(inside)} more"
    if result.redundancy < 6:  # below, σ is known to 30 % at best
        yield f"σ rests on {result.redundancy:.0f} degrees of freedom and is a rough guess; measure more points"
    yield from _on_layout(result, problem, found.sigma_mm)


def _on_agreement(result: Registration, problem: Problem) -> Iterator[str]:
    other, agree, count = result.alternative, int(result.inliers.sum()), len(result)
    if agree < count / 2:
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
        bound = square.sum() / redundancy * 3 * ratio_limit(consensus.CLEAN_SETS_WITH_OUTLIER / count, 3, redundancy)
        if square.max() > bound:
            worst = int(square.argmax())
            farthest = f"the farthest {problem.name(worst)} at {np.sqrt(square[worst]):.4g} mm"
            far = f"{(square > bound).sum()} points lie farther off than noise would put them"
            yield f"{far}, {farthest}; use the robust method"


def _on_layout(result: Registration, problem: Problem, sigma: float) -> Iterator[str]:
    """Yields notes on the layout of the points. ``sigma`` : of a coordinate, by a model that explains the points."""
    model, transform, rows = problem.model, result.b_from_a, np.flatnonzero(result.inliers)
    inside = problem.xyz_a[rows]
    if len(rows) <= consensus.LEVERAGE_UP_TO and result.method != "liu2017":
        kind = "plane" if model == AFFINE else "line"
        for row in rows[single_supports(model, inside, sigma)[: consensus.SHOWN]]:
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
