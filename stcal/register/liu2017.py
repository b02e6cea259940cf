"""Baseline: the method of Liu et al. (2017), "Research on coordinate transformation method between robot and laser
tracker" (China Measurement & Test 43(11), 102–107), as written.

Random samples of N point pairs are drawn. Each gives a 12-parameter affine transform by least squares (eqs. 5–6).
Transforms whose 3×3 part is not orthogonal are rejected (eq. 7). Points outside of the sample whose residuals are
within a limit are inliers (eq. 8). A transform is acceptable if the share of inliers exceeds a limit. The acceptable
transform of the smallest variance is the answer (eq. 9); it is not fitted again to its inliers. The paper does not
state the limit for orthogonality and the number of samples; both are options here.
"""

from dataclasses import dataclass

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.rigid import Affine

ASSUMED = (
    "liu2017: eqs. 8 and 9 are not legible in the source; taken as: the share of inliers among the points outside the "
    "sample, and the variance of their distances"
)


@dataclass(frozen=True, slots=True)
class Liu2017Options:
    """Options of the method of Liu et al. (2017). The defaults are in the paper's best range.

    Parameters
    ----------
    sample : int
        Number N of points of a sample; 4 … 40 in the paper, best 30–36.
    limit_mm : float
        Largest distance of an inlier; 0.18 … 0.23 in the paper.
    share : float
        Share of inliers among the points outside the sample, above which a sample is acceptable.
    orthogonal_within : float
        Largest entry of |RᵀR − 1| that passes; not stated in the paper.
    tries : int
        Number of samples drawn; not stated in the paper.

    Raises
    ------
    InputError
        If a sample has fewer than four points, or a number is not positive.
    """

    sample: int = 30
    limit_mm: float = 0.2
    share: float = 0.85
    orthogonal_within: float = 0.01
    tries: int = 1000

    def __post_init__(self):
        require_fields(self, "liu2017")
        positive = ("limit_mm", "orthogonal_within", "tries")
        for name, fits, words in (
            ("sample", self.sample >= 4, "4 or more points for twelve parameters"),
            ("share", 0 < self.share <= 1, "more than 0 and at most 1"),
            *((name, getattr(self, name) > 0, "a positive number") for name in positive),
        ):
            if not fits:
                raise InputError("E-LIU-OPTIONS", f"liu2017: {name} is {getattr(self, name):g}; {words} needed")


@dataclass(frozen=True, slots=True, eq=False)
class Liu2017Result:
    """``sample`` : (N,) rows of the best one; ``inliers`` : (n,) points within the limit, those of the sample too;
    ``acceptable`` : number of samples; ``shares`` : (tries,) of inliers outside each sample, NaN if screened out."""

    b_from_a: Affine
    sample: np.ndarray
    inliers: np.ndarray
    acceptable: int
    shares: np.ndarray


def affine_least_squares(xyz_a: np.ndarray, xyz_b: np.ndarray) -> Affine:
    """Returns b_from_a of twelve parameters (eqs. 5–6). Coplanar points leave it open off their plane, by metres."""
    design = np.column_stack([xyz_a, np.ones(len(xyz_a))])
    solution = np.linalg.lstsq(design, np.asarray(xyz_b, float), rcond=None)[0]
    return Affine(solution[:3].T, solution[3])


def liu2017(xyz_a: np.ndarray, xyz_b: np.ndarray, options: Liu2017Options, seed: int = 0) -> Liu2017Result:
    """Returns b_from_a by the paper's method. Raises DegenerateError: too few points, or no sample is acceptable."""
    count, size = len(xyz_a), options.sample
    if count <= size:
        raise DegenerateError(
            "E-LIU-SAMPLE",
            f"liu2017: {count} point pairs, more than the {size} of a sample needed; lower it (--sample)",
        )
    best, least, acceptable = None, np.inf, 0
    shares = np.full(options.tries, np.nan)
    for i, sample, b_from_a, error in orthogonal_samples(xyz_a, xyz_b, options, seed):
        near, others = error < options.limit_mm, np.delete(error, sample)
        inside = others[others < options.limit_mm]
        shares[i] = len(inside) / len(others)
        if shares[i] > options.share:
            acceptable += 1
            if inside.var() < least:
                least, best = inside.var(), (b_from_a, np.sort(sample), near)
    if best is None:
        tried = shares[np.isfinite(shares)]
        most = f"at most {100 * tried.max():.0f} %" if len(tried) else "none had an orthogonal 3×3 part"
        raise DegenerateError(
            "E-LIU-SAMPLE",
            f"liu2017: no sample of {size} points leaves more than {100 * options.share:g} % of the others within "
            f"{options.limit_mm:g} mm in {options.tries} tries ({most}); a larger limit (--threshold-mm), a smaller "
            "--share, another --sample, or the robust method needed",
        )
    return Liu2017Result(*best, acceptable, shares)


def orthogonal_samples(xyz_a: np.ndarray, xyz_b: np.ndarray, options: Liu2017Options, seed: int):
    """Yields the tries whose 3×3 part is orthogonal enough: number, sample, transform, and errors (n,)."""
    rng, count = np.random.default_rng(seed), len(xyz_a)
    for i in range(options.tries):
        sample = rng.choice(count, options.sample, replace=False)
        b_from_a = affine_least_squares(xyz_a[sample], xyz_b[sample])
        if np.abs(b_from_a.linear.T @ b_from_a.linear - np.eye(3)).max() <= options.orthogonal_within:
            yield i, sample, b_from_a, np.linalg.norm(xyz_b - b_from_a @ xyz_a, axis=1)
