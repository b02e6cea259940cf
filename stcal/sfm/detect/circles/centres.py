"""Centres to the sub-pixel from blurred ellipses, and their σ from pixel errors."""

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.robust import robust_sigmas
from stcal.sfm.data.group_model import Centres
from stcal.sfm.detect.circles.candidates import Ellipses
from stcal.sfm.detect.circles.fits import BAND_PX, CUSP, Fits, boxes, intruders, local_ideal_maps

MIN_NOISE2 = 1e-12
"""Noise variance, in squared grey values, that counts as no noise."""
CHANCE_WAVES = 3
"""Number of odd harmonics around the rim, from the third on, that stand for the first; higher ones are too short."""
MAX_CHANCE = 4.2
"""Largest ratio of one circle's squares to the median, exceeded by chance by one in a thousand (χ² of six freedoms)."""
SHARP_PX, SHARP = 1.5, 0.33
"""Blur, in pixels and in smaller radii, from which on the response of the fit to a shift is computed from the image."""


def correlation(chance: np.ndarray) -> float:
    """Returns the factor by which correlation between pixels enlarges covariances; 1 without circles. ``chance``: (n,)
    as :func:`_chance` gives it; ν/(ν−2) keeps expected squares over variances at one (F distribution)."""
    freedom = 2 * CHANCE_WAVES * len(chance)
    if not freedom:
        return 1.0
    return float(np.minimum(chance, MAX_CHANCE * np.median(chance)).mean()) * freedom / (freedom - 2)


def covariances(fits: Fits) -> tuple[np.ndarray, np.ndarray]:
    """Returns covariances of the centres, (n, 2, 2), for independent pixels, and :func:`_chance` over their noise. It
    is S·H·Sᵀ, with H the inverse of the normal equations, and S⁻¹ the share of a shift of the image that one step
    responds with (Huber 1981, sec. 6.3)."""
    pull = fits.scores[:, 0] ** 2 + fits.scores[:, 1] ** 2
    weight = np.where(fits.real > 0, fits.weight, 1)
    share = pull / weight
    total = share.sum(1, dtype=float)
    noise2 = np.maximum((pull * fits.residual**2).sum(1, dtype=float) / total, MIN_NOISE2)
    # ψ' over the weight of Geman–McClure, not below zero, where it would reward outliers.
    influence = np.maximum(4 * np.sqrt(weight) - 3, 0)
    chance = _chance(fits, np.sqrt(share / weight), total) / noise2
    spread = (pull.sum(1, dtype=float) / (pull * influence).sum(1, dtype=float))[:, None, None] * np.eye(2)
    xx, xy, yy = fits.inverse_shape[:, 0, 0], fits.inverse_shape[:, 0, 1], fits.inverse_shape[:, 1, 1]
    narrowest = 2 / (xx + yy + np.hypot(xx - yy, 2 * xy))
    wide = (fits.blur >= np.minimum(SHARP_PX, SHARP * narrowest)) & ~fits.failed
    for i in np.flatnonzero(wide).tolist():
        n = len(fits.rows[i])
        slope = _exact_slope(fits, i, fits.scores[i, :2, :n] / weight[i, :n]) - _residual_slope(fits, i)
        answer = (fits.inverse[i, :2] @ fits.scores[i, :, :n]) * influence[i, :n]
        spread[i] = np.linalg.inv(answer @ slope.T)
    covariance = spread @ fits.inverse[:, :2, :2] @ np.swapaxes(spread, 1, 2)
    return noise2[:, None, None] * covariance, np.where(noise2 > MIN_NOISE2, chance, 1.0)


def _chance(fits: Fits, edge: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Returns a pixel's variance from :data:`CHANCE_WAVES` harmonics (orthonormal series, Phillips 2005) along the rim.
    ``edge``: amplitudes of the harmonics at the pixels; ``total``: their weighted squares."""
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


def _exact_slope(fits: Fits, i: int, slope: np.ndarray) -> np.ndarray:
    """Returns derivatives by the centre, (2, pixels): ``slope`` of the step, and the change of the distance's slope."""
    on_unit, reduced = fits.on_unit[i, :, : slope.shape[1]], fits.reduced[i, : slope.shape[1]]
    inverse_shape = fits.inverse_shape[i].astype(np.float32)
    rho = np.maximum(np.hypot(*on_unit), np.float32(CUSP))
    steepness = np.maximum(np.hypot(*(inverse_shape @ on_unit)), np.float32(CUSP / fits.radius[i]))
    turn = np.float32(fits.blur[i]) * inverse_shape @ inverse_shape
    return (2 - 1 / rho) * slope - reduced / steepness * (turn @ slope)


def _residual_slope(fits: Fits, i: int) -> np.ndarray:
    """Returns the gradient of one circle's residuals, (2, pixels); zero if a neighbour is not in the band."""
    rows, columns = fits.rows[i], fits.columns[i]
    patch = np.full((fits.high[i] - fits.low[i])[::-1], np.nan, np.float32)
    patch[rows, columns] = fits.residual[i, : len(rows)]
    slope = np.zeros((2, *patch.shape), np.float32)
    slope[0, :, 1:-1] = patch[:, 2:] - patch[:, :-2]
    slope[1, 1:-1] = patch[2:] - patch[:-2]
    by_pixel = np.nan_to_num(slope[:, rows, columns]) / 2
    return np.linalg.inv(fits.jacobian[i]).T.astype(np.float32) @ by_pixel


PIXELS_AT_ONCE = 30_000
"""Number of pixels of ellipses that are fitted side by side: their derivatives, 1.5 MB, stay in a core's cache."""
SECTORS = 16
MIN_RIM = 0.8
"""Smallest share of the rim's sectors that follow the model. With less, the circle is partly hidden or cut off."""
MAX_RIM_RESIDUAL = 0.15  # largest RMS residual of a sector that follows the model, as a fraction of the contrast
UNTRUSTED = 0.2  # largest share of the shift by uneven brightness that the correction leaves, which is added to σ


def measure_centres(
    image: np.ndarray,
    camera: Camera,
    ellipses: Ellipses,
    neighbours: Ellipses,
    groups: np.ndarray | None = None,
) -> Centres:
    """Measures ``ellipses`` in a grey image of 8 or 16 bits. ``neighbours``: all candidates; pixels of near ones are
    excluded. ``groups``: (n,) patterns, whose circles share the factor for correlation; None: one pattern."""
    focal = float(np.sqrt(camera.focal.prod()))
    rims = _fitted(image, camera, ellipses, neighbours)
    centre, uneven, chance = rims.pop("centre") / focal, rims.pop("uneven") / focal, rims.pop("chance")
    groups, ok = np.zeros(len(ellipses), int) if groups is None else groups, rims["rim"] >= MIN_RIM
    factor = np.array([correlation(chance[ok & (groups == i)]) for i in range(groups.max(initial=0) + 1)])
    covariance = factor[groups, None, None] * rims.pop("covariance") / focal**2
    covariance += UNTRUSTED**2 * uneven[:, :, None] * uneven[:, None, :]
    distorted, jacobian = camera.distort_jacobian(centre)
    jacobian = jacobian * camera.focal[:, None]
    covariance_px2 = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    # Far beyond any lens, as with k1 = 1e9, rounding leaves negative variances.
    ok &= (np.diagonal(covariance_px2, axis1=1, axis2=2) > 0).all(1)
    rims |= {"shape": rims["shape"] / focal, "uneven_px": (jacobian @ uneven[..., None])[..., 0]}
    centre_px = distorted * camera.focal + camera.centre
    return Centres(centre_px=centre_px, centre=centre, covariance_px2=covariance_px2, ok=ok, **rims)


def _fitted(image: np.ndarray, camera: Camera, ellipses: Ellipses, neighbours: Ellipses) -> dict[str, np.ndarray]:
    """Fits circles of similar size side by side, as many as a processor's cache holds pixels; as :func:`_rims`."""
    half = boxes(ellipses)
    to_ideal = local_ideal_maps(camera, ellipses.centre_px, half)
    masks = intruders(ellipses, neighbours, half)
    size = ellipses.radius_px()
    order = np.argsort(size, kind="stable")
    pixels = np.cumsum(2 * np.pi * size[order] * 2 * BAND_PX)
    parts = [
        _rims(Fits(image, ellipses.select(own), half[own], to_ideal[own], [masks[i] for i in own]))
        for own in np.split(order, np.flatnonzero(np.diff(pixels // PIXELS_AT_ONCE)) + 1)
    ]
    return {name: np.concatenate([part[name] for part in parts])[np.argsort(order)] for name in parts[0]}


def _rims(fits: Fits) -> dict[str, np.ndarray]:
    """Returns n fitted ellipses by the names of :class:`Centres`, ideal px; contrast and rim are zero if a fit failed.
    ``covariance`` is for independent pixels, ``chance`` for :func:`correlation`."""
    n = len(fits.blur)
    near = (np.abs(fits.reduced) * fits.blur[:, None] < np.maximum(1.5, fits.blur)[:, None]) & (fits.real > 0)
    angle = np.arctan2(fits.on_unit[:, 1][near], fits.on_unit[:, 0][near])
    sector = (angle * (SECTORS / (2 * np.pi))).astype(int) % SECTORS + SECTORS * np.nonzero(near)[0]
    total = np.bincount(sector, minlength=n * SECTORS).reshape(n, SECTORS)
    square = np.bincount(sector, fits.residual[near] ** 2, minlength=n * SECTORS).reshape(n, SECTORS)
    contrast = fits.levels[:, 3].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):  # for failed fits
        noise = robust_sigmas(np.abs(fits.residual), fits.real > 0)
        rim = (square <= ((MAX_RIM_RESIDUAL * contrast) ** 2 + (2 * noise) ** 2)[:, None] * total).mean(1)
        covariance, chance = covariances(fits)
        domes = fits.domes()
    ok = ~fits.failed
    one, all_of = ok[:, None], ok[:, None, None]
    numbers = {"chance": chance, "blur_px": fits.blur, "contrast": contrast, "noise": noise, "rim": rim}
    return {name: np.where(ok, value, 0.0) for name, value in numbers.items()} | {
        "centre": np.where(one, fits.centre, fits.start),
        "shape": np.where(all_of, np.linalg.inv(fits.inverse_shape), fits.radius[:, None, None] * np.eye(2)),
        "covariance": np.where(all_of, covariance, np.eye(2)),
        "uneven": np.where(one, fits.uneven, 0.0),
        "domes": np.where(one & np.isfinite(domes), domes, 0.0),
    }
