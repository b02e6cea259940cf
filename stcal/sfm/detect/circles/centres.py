"""Centres to the sub-pixel: a blurred ellipse is fitted to the grey values around the rim of each candidate.

The edge is modelled as a step blurred by a Gaussian (its width is estimated), between two brightness planes, along
an ellipse in *ideal* coordinates: every pixel is first moved to where a lens without distortion would have put it,
because a distorted ellipse is none. The fit is a robust Gauss–Newton over the centre (2), the ellipse (3), the blur
and both planes (6). (The field's alternatives are grey-value centroids, edges along the normals with an ellipse fit,
and contours; this model is the one nearest to the Cramér–Rao bound, also under a brightness gradient.)

The σ that a centre carries is that of an M-estimator: what errors in the pixels do to its equation, through the
inverse of how the equation answers to a shifted image. Errors are not independent from pixel to pixel, as JPEG,
demosaicing and denoising spread them, and what the model does not follow, as motion blur, is none: it is even about
the centre and moves nothing. Both are measured where centres live, on the rim: a centre is the residuals' first
harmonic around it, and the next odd ones, which no parameter takes up, show how large it is by chance. All circles
of a pattern share that factor; each has its own noise.

Planes do not follow a circle of which one half is darker, or with an edge beside it: the centre then moves by up to
0.2 px without any residual that a rim's share would show. The third harmonic of the residuals around the rim does show
it (the first is the planes', even ones move no centre), inside and outside apart; where it is significant the fit goes
on with brightness that varies around the rim, at the price of a larger σ.
"""

from dataclasses import dataclass, fields

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.robust import robust_sigmas
from stcal.sfm.data.observations import Centres
from stcal.sfm.detect.circles import bands
from stcal.sfm.detect.circles.ellipses import Ellipses
from stcal.sfm.detect.circles.fits import Fits
from stcal.sfm.detect.circles.sigmas import correlation, covariances

PIXELS_AT_ONCE = 30_000
"""Number of pixels of ellipses that are fitted side by side: their derivatives, 1.5 MB, stay in a core's cache."""
SECTORS = 16
MIN_RIM = 0.8
"""Smallest share of the rim's sectors that follow the model. With less, the circle is partly hidden or cut off."""
MAX_RIM_RESIDUAL = 0.15
"""Largest RMS residual of a sector that follows the model, as a fraction of the contrast."""
UNTRUSTED = 0.2
"""Largest share of the shift by uneven brightness that the correction leaves (circles of 8 to 28 px, halves darker by
5 to 30 %). It is added to σ."""


def measure_centres(
    image: np.ndarray,
    camera: Camera,
    ellipses: Ellipses,
    neighbours: Ellipses,
    groups: np.ndarray | None = None,
) -> Centres:
    """Measures ``ellipses`` in a grey image of any depth.

    Parameters
    ----------
    image : (height, width) array, uint8 or uint16
    ellipses : ellipses to measure
    neighbours : all candidates of the image; pixels of near ones are excluded
    groups : (n,) number of each ellipse's pattern; circles of one pattern share the factor for correlation between
        pixels; one pattern if None
    """
    focal = float(np.sqrt(camera.focal.prod()))
    found = _fitted(image, camera, ellipses, neighbours)
    centre, uneven = found.centre / focal, found.uneven / focal
    groups, ok = np.zeros(len(ellipses), int) if groups is None else groups, found.rim >= MIN_RIM
    factor = np.array([correlation(found.chance[ok & (groups == i)]) for i in range(groups.max(initial=0) + 1)])
    covariance = factor[groups, None, None] * found.covariance / focal**2
    covariance += UNTRUSTED**2 * uneven[:, :, None] * uneven[:, None, :]
    distorted, jacobian = camera.distort_jacobian(centre)
    jacobian = jacobian * camera.focal[:, None]
    return Centres(
        centre_px=distorted * camera.focal + camera.centre,
        centre=centre,
        shape=found.shape / focal,
        covariance_px2=jacobian @ covariance @ np.swapaxes(jacobian, 1, 2),
        blur_px=found.blur,
        contrast=found.contrast,
        noise=found.noise,
        rim=found.rim,
        uneven_px=(jacobian @ uneven[..., None])[..., 0],
        ok=ok,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rims:
    """n fitted ellipses, ideal px: ``centre`` : (n, 2); ``shape`` and ``covariance`` : (n, 2, 2) for independent
    pixels; ``chance`` : (n,); others as in :class:`Centres`. Contrast and rim are zero if the fit failed."""

    centre: np.ndarray
    shape: np.ndarray
    covariance: np.ndarray
    chance: np.ndarray
    blur: np.ndarray
    contrast: np.ndarray
    noise: np.ndarray
    rim: np.ndarray
    uneven: np.ndarray

    @classmethod
    def joined(cls, parts: list["_Rims"], order: np.ndarray) -> "_Rims":
        """Returns the concatenated parts with row k at place ``order[k]``."""
        place = np.argsort(order)
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts])[place] for f in fields(cls)))


def _fitted(image: np.ndarray, camera: Camera, ellipses: Ellipses, neighbours: Ellipses) -> _Rims:
    """Fits circles of similar size side by side, as many as a processor's cache holds pixels."""
    half = bands.boxes(ellipses)
    to_ideal = bands.local_ideal_maps(camera, ellipses.centre_px, half)
    masks = bands.intruders(ellipses, neighbours, half)
    size = ellipses.radius_px()
    order = np.argsort(size, kind="stable")
    pixels = np.cumsum(2 * np.pi * size[order] * 2 * bands.BAND_PX)
    ends = np.flatnonzero(np.diff(pixels // PIXELS_AT_ONCE)) + 1
    parts = [
        _rims(Fits(image, ellipses.select(own), half[own], to_ideal[own], [masks[i] for i in own]))
        for own in np.split(order, ends)
    ]
    return _Rims.joined(parts, order)


def _rims(fits: Fits) -> _Rims:
    """Returns the fitted ellipses with noise, rim and covariance."""
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
    ok = ~fits.failed
    return _Rims(
        np.where(ok[:, None], fits.centre, fits.start),
        np.where(ok[:, None, None], np.linalg.inv(fits.inverse_shape), fits.radius[:, None, None] * np.eye(2)),
        np.where(ok[:, None, None], covariance, np.eye(2)),
        np.where(ok, chance, 0.0),
        np.where(ok, fits.blur, 0.0),
        np.where(ok, contrast, 0.0),
        np.where(ok, noise, 0.0),
        np.where(ok, rim, 0.0),
        np.where(ok[:, None], fits.uneven, 0.0),
    )
