"""Propagation of pixel errors to a centre: the covariance of a fit, and the effect of correlation between pixels."""

import numpy as np

from stcal.sfm.detect.circles.fits import CUSP, Fits

MIN_NOISE2 = 1e-12
"""Noise variance, in squared grey values, that counts as no noise."""
CHANCE_WAVES = 3
"""So many odd harmonics around the rim stand for the first: the third, the fifth, the seventh. Higher ones are shorter
than what correlates the pixels: JPEG's blocks are of 8 px, and the seventh wave around a circle of 6 px is of 5. (JPEG
50 to 95 on 240 sheets of 200 circles: errors over σ were within 0.9…1.15 on 227 with 1 wave, 235 with 2, 234 with 3,
219 with 4; the fewer, the more is left to chance.)"""
MAX_CHANCE = 4.2
"""Largest ratio of one circle's squares to the median: exceeded by chance by one in a thousand (χ² of six degrees of
freedom). It bounds the influence of a dirty circle."""
SHARP_PX, SHARP = 1.5, 0.33
"""Where the blur is wider than this, in pixels or in the ellipse's smaller radius, how the fit answers to a shift is
asked of the image; below it that changed σ by 1 %, and it costs a tenth of the fit."""


def correlation(chance: np.ndarray) -> float:
    """Factor of the covariances of independent pixels, from the squares of n circles' harmonics over what independent
    pixels would make them; 1 of no circle. Few squares may be small by chance: their mean times ν/(ν−2), ν degrees of
    freedom, keeps the expectation of squared errors over variances at one (mean of the F distribution)."""
    freedom = 2 * CHANCE_WAVES * len(chance)
    if not freedom:
        return 1.0
    return float(np.minimum(chance, MAX_CHANCE * np.median(chance)).mean()) * freedom / (freedom - 2)


def covariances(fits: Fits) -> tuple[np.ndarray, np.ndarray]:
    """Returns covariances of the centres, (n, 2, 2), for independent pixels, and :func:`_chance` over their noise.

    The noise is that of the pixels where the centre's weight is: errors sit on the edge more than beside it. The
    covariance is S·H·Sᵀ, H the inverse of the normal equations, S⁻¹ the share of a shift of the image that one step
    answers with (Huber 1981, sec. 6.3). The step's own derivatives would make that share 1; it is less by what the
    weights give away, and another where the edge is too wide for them, or not as the model has it.
    """
    pull = fits.scores[:, 0] ** 2 + fits.scores[:, 1] ** 2
    weight = np.where(fits.real > 0, fits.weight, 1)
    share = pull / weight
    total = share.sum(1, dtype=float)
    noise2 = np.maximum((pull * fits.residual**2).sum(1, dtype=float) / total, MIN_NOISE2)
    # ψ' over the weight of Geman–McClure, not below zero, where it would reward outliers.
    influence = np.maximum(4 * np.sqrt(weight) - 3, 0)
    chance = _chance(fits, np.sqrt(share / weight), total) / noise2
    spread = (pull.sum(1, dtype=float) / (pull * influence).sum(1, dtype=float))[:, None, None] * np.eye(2)
    wide = (fits.blur >= np.minimum(SHARP_PX, SHARP * _narrowest(fits))) & ~fits.failed
    for i in np.flatnonzero(wide).tolist():
        n = len(fits.rows[i])
        slope = _exact_slope(fits, i, fits.scores[i, :2, :n] / weight[i, :n]) - _residual_slope(fits, i)
        answer = (fits.inverse[i, :2] @ fits.scores[i, :, :n]) * influence[i, :n]
        spread[i] = np.linalg.inv(answer @ slope.T)
    covariance = spread @ fits.inverse[:, :2, :2] @ np.swapaxes(spread, 1, 2)
    return noise2[:, None, None] * covariance, np.where(noise2 > MIN_NOISE2, chance, 1.0)


def _chance(fits: Fits, edge: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Variance of a pixel from the residuals' :data:`CHANCE_WAVES` on the rim, of amplitudes ``edge`` and weighted
    squares ``total``: an estimate from orthonormal series (Phillips 2005), less what the parameters took of these.
    """
    wave = np.empty(edge.shape, np.complex64)
    wave.real, wave.imag = np.moveaxis(fits.direction(), 1, 0)
    double, wave = wave * wave, wave * edge
    waves = np.empty((len(edge), 2 * CHANCE_WAVES, edge.shape[1]), np.float32)
    for k in range(CHANCE_WAVES):
        wave *= double
        waves[:, 2 * k], waves[:, 2 * k + 1] = wave.real, wave.imag
    taken = (waves @ np.swapaxes(fits.scores, 1, 2)).astype(float)
    left = CHANCE_WAVES * total - (taken @ fits.inverse * taken).sum((1, 2))
    found = waves @ (fits.weight * fits.residual)[..., None]
    return (found**2).sum((1, 2)) / left


def _narrowest(fits: Fits) -> np.ndarray:
    """Returns the ellipses' smaller radii, px."""
    xx, xy, yy = fits.inverse_shape[:, 0, 0], fits.inverse_shape[:, 0, 1], fits.inverse_shape[:, 1, 1]
    return 2 / (xx + yy + np.hypot(xx - yy, 2 * xy))


def _exact_slope(fits: Fits, i: int, slope: np.ndarray) -> np.ndarray:
    """Returns the derivatives of one model by the centre, (2, pixels): those of the step, ``slope``, and the change
    of the distance's slope."""
    on_unit, reduced = fits.on_unit[i, :, : slope.shape[1]], fits.reduced[i, : slope.shape[1]]
    inverse_shape = fits.inverse_shape[i].astype(np.float32)
    rho = np.maximum(np.hypot(*on_unit), np.float32(CUSP))
    steepness = np.maximum(np.hypot(*(inverse_shape @ on_unit)), np.float32(CUSP / fits.radius[i]))
    turn = np.float32(fits.blur[i]) * inverse_shape @ inverse_shape
    return (2 - 1 / rho) * slope - reduced / steepness * (turn @ slope)


def _residual_slope(fits: Fits, i: int) -> np.ndarray:
    """Returns the derivatives of one residual by the place, (2, pixels); zero if a neighbour is not in the band."""
    rows, columns = fits.rows[i], fits.columns[i]
    patch = np.full((fits.high[i] - fits.low[i])[::-1], np.nan, np.float32)
    patch[rows, columns] = fits.residual[i, : len(rows)]
    slope = np.zeros((2, *patch.shape), np.float32)
    slope[0, :, 1:-1] = patch[:, 2:] - patch[:, :-2]
    slope[1, 1:-1] = patch[2:] - patch[:-2]
    by_pixel = np.nan_to_num(slope[:, rows, columns]) / 2
    return np.linalg.inv(fits.jacobian[i]).T.astype(np.float32) @ by_pixel
