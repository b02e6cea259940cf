"""Mistakes that the data show: units, mirrored axes, exchanged rows, scale, correlated residuals of neighbours, and two
groups of points that were shifted against each other."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc, chdtrc, gammaln, ndtr

from stcal.errors import ConvergenceError, DegenerateError, InputError, StcalError
from stcal.explain import Candidate, explain
from stcal.geometry.rigid import Affine, Rigid, best_rotations
from stcal.geometry.robust import ratio_limit
from stcal.register.models import MODELS, Model, Transform, jacobian, parts, unit_covariance, whitened
from stcal.register.pairs import Problem, some_of
from stcal.register.result import Registration
from stcal.register.robust import BY_CHANCE, FALSE_ALARMS, by_share, chernoff, search
from stcal.row_order import Change, change_along

UNITS = {1000.0: ("m", "m"), 25.4: ("inches", "in"), 10.0: ("cm", "cm")}
"""Units by their length in mm, with name and suffix of their columns."""
UNIT_WITHIN = 0.08
"""Relative tolerance of the ratio. Outliers move the median ratio by a few per cent; the factors are far apart."""
PAIRS = 4000
"""Number of pairs of points whose distances are compared."""
MIRROR_RATIO = 4.0
"""Ratio of misfits that indicates a mirrored frame. Mirrored points fit a mirrored frame to noise, and a correct frame
only to their thickness; bent frames never gain so much."""
MIRROR_CHANCE = 1e-4
"""Probability of calling right frames mirrored if the points had thickness only by noise."""
NAMED_BELOW_RAD = np.radians(15)
"""Largest remaining turn of the frames with which a change of sign or exchange of axes is named as the likely cause."""
LOOKED_AT = 10_000
"""Largest number of outliers that are examined. More would show the same mistakes."""


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


def check_units(xyz_a: np.ndarray, xyz_b: np.ndarray, seed: int) -> None:
    """Raises InputError if the median ratio of distances between the same points in b and a is that of two units."""
    rng = np.random.default_rng([seed, 3])
    i, j = rng.integers(len(xyz_a), size=(2, PAIRS))
    in_a, in_b = (np.linalg.norm(xyz[i] - xyz[j], axis=1) for xyz in (xyz_a, xyz_b))
    apart = (in_a > 0) & (in_b > 0)
    if not apart.any():
        return
    ratio = float(np.median(in_b[apart] / in_a[apart]))
    if words := mistaken_unit(ratio):
        small, large = "ab" if ratio > 1 else "ba"
        times = max(ratio, 1 / ratio)
        raise InputError(
            "E-REGISTER-UNITS",
            f"registration: distances in {large} are {times:.4g} times those in {small} (median); {words}",
        )


def mirrored_ratio(xyz_a: np.ndarray, xyz_b: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns the square sum of the best rotation over that of the best reflection, and this reflection (3, 3)."""
    a, b = xyz_a - xyz_a.mean(0), xyz_b - xyz_b.mean(0)
    total = (a**2).sum() + (b**2).sum()
    flip = np.array([1, 1, -1.0])
    proper = total - 2 * best_rotations(b.T @ a)[1]
    turn, product = best_rotations(b.T @ (a * flip))
    floor = 1e-20 * total  # rounding of exact data
    return float(max(proper, floor) / max(total - 2 * product, floor)), turn * flip


def check_mirrored(model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray) -> None:
    """Raises InputError if a reflection explains points (n, 3) far better than any rotation, naming the axis to change
    if one change of sign or exchange makes the frames nearly parallel."""
    if model.name == "affine" or len(xyz_a) <= model.sample:
        return
    ratio, reflection = mirrored_ratio(xyz_a, xyz_b)
    redundancy = model.redundancy(len(xyz_a))
    if ratio > max(MIRROR_RATIO, ratio_limit(MIRROR_CHANCE, redundancy, redundancy)):
        raise mirrored_error(reflection, len(xyz_a), len(xyz_a), np.sqrt(ratio))


def mirrored_error(reflection: np.ndarray, agree: int, count: int, times: float) -> InputError:
    """Returns the error for mirrored data. ``reflection`` : (3, 3), b from a, determinant −1."""
    candidates = [
        Candidate(f"the sign of a{axis}", lambda k=k: np.diag(np.where(np.arange(3) == k, -1.0, 1.0)))
        for k, axis in enumerate("xyz")
    ]
    candidates += [
        Candidate(f"a{'xyz'[i]} and a{'xyz'[j]} with each other", lambda order=order: np.eye(3)[order])
        for i, j, order in ((0, 1, [1, 0, 2]), (1, 2, [0, 2, 1]), (0, 2, [2, 1, 0]))
    ]
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


def outlier_notes(result: Registration, problem: Problem) -> Iterator[str]:
    """Yields notes on outliers that a slip explains: exchanged rows, or another unit."""
    rows, reach = np.flatnonzero(~result.inliers)[:LOOKED_AT], result.threshold_mm
    if not len(rows) or reach is None:
        return
    a, b, transform = problem.xyz_a[rows], problem.xyz_b[rows], result.b_from_a
    mapped = transform @ a
    distance, nearest = (np.asarray(each) for each in KDTree(mapped).query(b))
    swapped = np.flatnonzero((distance <= reach) & (nearest != np.arange(len(rows))))
    taken = np.minimum(1, 2 * reach / np.maximum(np.ptp(mapped, axis=0), 1e-300)).prod()
    by_chance = bdtrc(len(swapped) - 1, len(rows), 1 - (1 - taken) ** (len(rows) - 1))
    if len(swapped) and by_chance < BY_CHANCE:
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
    for name in {"rigid": ("similarity", "affine"), "similarity": ("affine",), "affine": ()}[problem.model.name]:
        model = MODELS[name]
        if len(problem) < model.needed + 1:
            break
        candidate = replace(problem, model=model)
        try:
            fitted = candidate.fit()
        except StcalError:  # coplanar points have no affine transform
            break
        before, after = (float(p.squares(t).sum()) for p, t in (narrow, (candidate, fitted)))
        extra, redundancy = model.parameters - narrow[0].model.parameters, candidate.redundancy
        rounding = 3 * len(problem) * problem.rounding_mm() ** 2
        gain = (before - after) / extra / max(after / redundancy, rounding / redundancy)
        sigma = np.sqrt(max(after, 0) / redundancy)
        enough = sigma < (1 - MATTERS) * np.sqrt(before / narrow[0].redundancy)
        if before > rounding and gain > ratio_limit(SCALE_BY_CHANCE, extra, redundancy) and enough:
            narrow = candidate, fitted
            best = Wider(candidate, fitted, float(sigma), _said(candidate, fitted, float(sigma)))
    return best


def _said(problem: Problem, transform: Transform, sigma_mm: float) -> str:
    """Returns a text on the ratio of lengths in b to those in a, the likely cause, and the remedy."""
    if isinstance(transform, Affine):
        scales = np.linalg.svd(transform.linear, compute_uv=False)
        return (
            f"lengths in b are {', '.join(f'{s:.6g}' for s in scales)} times those in a along three axes: an axis of "
            "one instrument is scaled or not square to the others, or an arm bends; correct it, or use --model affine "
            "within these points"
        )
    covariance = sigma_mm**2 * unit_covariance(problem.model, transform, problem.xyz_a, problem.noise.precision)
    scale = float(np.cbrt(np.linalg.det(parts(transform)[0])))
    sigma = scale * float(np.sqrt(covariance[6, 6]))
    digits = max(1, 1 - int(np.floor(np.log10(max(sigma, 1e-15)))))
    cause = "a length standard, a board or an instrument of another scale"
    if abs(scale - 1) < THERMAL:
        cause = f"{1e6 * abs(scale - 1):.0f} ppm, of temperature (steel 11.5, aluminium 23 ppm/K) or a length standard"
    return (
        f"lengths in b are {scale:.{digits}f} ± {sigma:.{digits}f} times those in a: {cause}; correct one of the "
        "files, or use --model similarity"
    )


NEIGHBOURS = 2000
"""Largest number of points whose residuals are compared with the nearest neighbour's."""
FEWEST_NEIGHBOURS = 20
"""Least number of points for this comparison, as the sum of fewer products is not normal."""
BY_NEIGHBOURS = 1e-4
"""Probability of calling clean data bent."""


def neighbours_alike(xyz_a: np.ndarray, residuals: np.ndarray) -> bool:
    """Returns whether residuals (n, 3) correlate with those of their nearest neighbours beyond chance."""
    rows = slice(None, None, max(1, len(xyz_a) // NEIGHBOURS))
    xyz, r = xyz_a[rows], residuals[rows]
    if len(xyz) < FEWEST_NEIGHBOURS:
        return False
    nearest = np.asarray(KDTree(xyz).query(xyz, k=2)[1])[:, 1]
    pairs = np.column_stack([np.arange(len(xyz)), nearest])
    one, two = np.unique(np.sort(pairs, axis=1), axis=0).T
    product = np.einsum("ni,ni->n", r[one], r[two])  # the variance of their sum is the sum of their squares
    return bool(ndtr(-product.sum() / max(np.sqrt((product**2).sum()), 1e-300)) < BY_NEIGHBOURS)


LEVEL = 0.01
"""Probability that sound points seem to move along the order of their rows."""
IN_ORDER = 10_000
"""Largest number of points that are examined; larger sets are clouds without an order."""


def moved_meanwhile(problem: Problem, transform: Transform) -> Change | None:
    """Returns the jump or drift of one frame against the other along the order of the rows; None if there is none
    beyond chance, or the frames are bent and it explains no bend."""
    if len(problem) > IN_ORDER:
        return None
    from_middle = problem.xyz_a - problem.xyz_a.mean(0)
    by_parameters = jacobian(problem.model, transform, from_middle)
    motions = jacobian(MODELS["rigid"], Rigid(best_rotations(parts(transform)[0])[0]), from_middle)
    residuals, precision = problem.residuals(transform), problem.noise.precision

    def white(values: np.ndarray) -> np.ndarray:
        return np.stack([whitened(values[:, :, k], precision) for k in range(values.shape[2])], axis=2)

    change = change_along(whitened(residuals, precision), white(by_parameters), white(motions))
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
    return (
        f"from {row} on{likely} an instrument stands elsewhere, by {size} ({share}): register the rows before it, and "
        "those from it on, separately"
    )


TRIED = 200
"""Largest number of points that are examined. It shows a shift of half of them by 4 σ."""
MAX_ROUNDS = 30
"""Largest number of rounds of assigning and fitting; each lowers the sum of squares, so that they end earlier."""
FEW = 16
"""Largest number of points for which square sums replace determinants (see above)."""
SPHERICAL = 0.1
"""Significance level of anisotropic noise: half of the sets of 16 points with three times the noise along one axis."""
TOGETHER = 0.01
"""Probability that scattered groups seem to lie together."""


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """``transforms`` : of the larger group and the other; ``in_space`` : the place determines the group."""

    transforms: tuple[Transform, Transform]
    in_space: bool


def two_groups(problem: Problem, rng: np.random.Generator) -> Groups | None:
    """Returns the two transforms of points in two groups; None if one explains them as well."""
    n, model = len(problem), problem.model
    points = problem if n <= TRIED else problem[np.sort(rng.choice(np.arange(n), TRIED, replace=False))]
    n = len(points)
    if n < 2 * (model.sample + 1):
        return None
    try:
        single = points.whitened(points.fit())
        assigned = _assigned(points, rng)
    except (DegenerateError, ConvergenceError):
        return None
    if assigned is None or np.abs(single).max() <= points.rounding_mm():
        return None
    first, (one, two) = assigned
    parted = np.where(first[:, None], points.whitened(one), points.whitened(two))
    if (n - 1) * np.log(2) + _log_chance(model, single, parted) > np.log(FALSE_ALARMS):
        return None
    return Groups((two, one) if first.sum() < n / 2 else (one, two), lies_together(points.xyz_a, first))


def _log_chance(model: Model, whole: np.ndarray, parted: np.ndarray) -> float:
    """Returns a bound of the log probability that parting into given groups shrinks residuals (n, 3) so. It is 0 if the
    loudest axis's noise in the fit exceeds the quiet axes' there: determinants then tell nothing."""
    n, per_axis = len(whole), model.parameters / 3
    one, two = whole.T @ whole, parted.T @ parted
    of_error = n - 2 * per_axis
    if np.linalg.cond(two) > n / 2:
        return 0.0
    bound = wilks_bound(np.linalg.slogdet(two)[1] - np.linalg.slogdet(one)[1], of_error, per_axis)
    if n <= FEW and sphericity(two, of_error) > SPHERICAL:
        share = np.trace(two) / np.trace(one)
        bound = min(bound, float(chernoff(share, 1.5 * of_error, model.parameters / 2)))
    return bound


def sphericity(scatter: np.ndarray, redundancy: float) -> float:
    """Returns the p-value of equal noise along all axes (Mauchly 1940, with Bartlett's factor)."""
    w = np.linalg.slogdet(scatter)[1] - 3 * np.log(np.trace(scatter) / 3)
    return float(chdtrc(5, max(-(redundancy - 23 / 18) * w, 0.0)))


def wilks_bound(log_ratio: float, of_error: float, of_hypothesis: float) -> float:
    """Returns Chernoff's bound of log P(Λ ≤ exp(log_ratio)) for Wilks' Λ(3, of_error, of_hypothesis), a product of
    Beta((νₑ − i)/2, νₕ/2), i = 0, 1, 2 (Anderson 2003, th. 8.4.1)."""
    a, b = (of_error - np.arange(3)) / 2, of_hypothesis / 2
    t = np.linspace(0, a[2], 400, endpoint=False)[:, None]
    moments = gammaln(a - t) + gammaln(a + b) - gammaln(a) - gammaln(a + b - t)
    return float((t[:, 0] * log_ratio + moments.sum(1)).min())


def lies_together(xyz_a: np.ndarray, group: np.ndarray) -> bool:
    """Returns whether neighbours are in the same group more often than by chance."""
    nearest = np.asarray(KDTree(xyz_a).query(xyz_a, k=2)[1])[:, 1]
    same = int((group[nearest] == group).sum())
    share = group.mean()
    return bool(bdtrc(same - 1, len(group), share**2 + (1 - share) ** 2) < TOGETHER)


def _assigned(problem: Problem, rng: np.random.Generator) -> tuple[np.ndarray, tuple[Transform, Transform]] | None:
    """Returns the mask (n,) of one group, and the transforms of both; None if one becomes too small."""
    model, n = problem.model, len(problem)
    core = search(problem, by_share(model, n), rng)
    others = np.flatnonzero(~core.inliers) if core else np.zeros(0, int)
    inner = search(problem[others], by_share(model, len(others)), rng) if len(others) > model.sample else None
    if core is None or inner is None:
        return None
    first, second = core.inliers, np.isin(np.arange(n), others[inner.inliers])
    best, least = None, np.inf
    for _ in range(MAX_ROUNDS):
        if min(first.sum(), second.sum()) <= model.sample:
            break
        transforms = problem[first].fit(), problem[second].fit()
        apart = np.array([problem.squares(t) for t in transforms])
        total = apart.min(0).sum()
        if total >= least:
            break
        first = apart[0] <= apart[1]
        second = ~first
        best, least = (first, transforms), total
    return best


NEEDED, ALONG = 14.5, 9.2
"""Least gain in log likelihood: along any direction, and along the first principal axis."""
LEAST_SHARE = 0.15
"""Smallest fraction of the points in a group."""
ROUNDS = 60
NARROWEST = 0.01
"""Smallest ratio of a group's variance to the variance of all points, along the shift."""


@dataclass(frozen=True, slots=True, eq=False)
class Shifted:
    """``rows`` : (m,) of the smaller group of ``count`` points; ``by_mm`` : (3,) its shift, frame b."""

    rows: np.ndarray
    count: int
    by_mm: np.ndarray
    together: bool


def shifted_rows(problem: Problem, transform: Transform) -> Shifted | None:
    """Returns the rows that are shifted together; None if there is no such group, a bent frame, or too few points."""
    count = len(problem)
    residuals = problem.whitened(transform)
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
    if best is None or neighbours_alike(problem.xyz_a, problem.residuals(transform)):
        return None
    _, axis, border = best
    second = (residuals - middle) @ to_unit @ axis < border
    if second.sum() > count / 2:
        second = ~second
    plain = problem.residuals(transform)
    by_mm = plain[second].mean(0) - plain[~second].mean(0)
    return Shifted(np.flatnonzero(second), count, by_mm, lies_together(problem.xyz_a, second))


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
    for _ in range(ROUNDS):
        share = float(np.clip(first.mean(), LEAST_SHARE, 1 - LEAST_SHARE))
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
