"""Fit of a supported camera model to a lens of an unsupported one, and the residuals of the fit."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from stcal.errors import InputError
from stcal.geometry.camera import WIDEST_RAD, Camera
from stcal.io.cameras.foreign import ForeignLens
from stcal.io.cameras.model import FISHEYE, CalibratedCamera, intrinsic_basis, parameter_names

CANDIDATES = ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE")
"""Camera models that are tried, from few parameters to many, perspective and equidistant."""
AS_GOOD_PX = 1e-3
"""Reduction of the largest residual, in px, that a model with more parameters must reach to be preferred."""
AZIMUTHS, RADII, STEPS = 72, 40, 1000
"""Numbers of azimuths of the rays, of radii along each, and of steps in the search for the edge of the image."""
BEYOND = 0.01
"""Share of the image's size by which rays extend beyond the edge, so that they enclose the whole image."""
FAR_PX = 1e6
"""Residual, in px, where the fitted lens projects a ray to no pixel."""
MOST_STEPS, SETTLED = 200, 1e-14
HALF = 0.5
"""Largest share by which a focal length may shrink in the fit."""
SMALL = 1e-6
"""Step about the axis, in normalised coordinates, from which the initial focal lengths are computed."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedLens:
    """Result of fitting a lens.

    ``camera`` : the fitted camera; ``rms_px``, ``most_px`` : RMS and largest residual over the image; ``share`` : share
    of the azimuths in which the image ends within 89° of the axis.
    """

    camera: CalibratedCamera
    rms_px: float
    most_px: float
    share: float


def fit_lens(lens: ForeignLens, width: int, height: int) -> FittedLens:
    """Return the supported camera model that is nearest to a lens over the image.

    Parameters
    ----------
    lens : ForeignLens
        Lens to approximate.
    width, height : int
        Image size, px.

    Raises
    ------
    InputError
        The lens projects nearly no ray into the image.
    """
    rays, pixels, share = _rays(lens, width, height)
    best = None
    for model in CANDIDATES:
        camera = _fitted(model, rays, pixels, lens, (width, height))
        off = np.linalg.norm(camera.project(rays) - pixels, axis=1)
        if best is None or not off.max() > best.most_px - AS_GOOD_PX:
            best = FittedLens(camera, float(np.sqrt((off**2).mean())), float(off.max()), share)
    assert best is not None
    return best


def _rays(lens: ForeignLens, width: int, height: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return rays (n, 3) with z = 1 spread evenly over the image, their pixels (n, 2), and :attr:`FittedLens.share`."""
    angle = np.linspace(0, WIDEST_RAD, STEPS + 1)[1:]
    far = np.array([width, height]) * BEYOND
    centre = lens.project(np.array([[0.0, 0.0, 1.0]]))[0]
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [width, height] - 0.5 - centre
    around = np.concatenate([np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False), np.arctan2(*corners.T[::-1])])
    rays, pixels, ends = [], [], 0
    for azimuth in around:
        rays_of_azimuth = np.column_stack(
            [np.cos(azimuth) * np.tan(angle), np.sin(azimuth) * np.tan(angle), np.ones(STEPS)]
        )
        pixels_of_azimuth = lens.project(rays_of_azimuth)
        radius = np.linalg.norm(pixels_of_azimuth - centre, axis=1)
        inside = ((pixels_of_azimuth >= -0.5 - far) & (pixels_of_azimuth <= np.array([width, height]) - 0.5 + far)).all(
            axis=1
        )
        grows = np.diff(radius, prepend=0) > 0  # beyond this radius the distortion folds over
        good = np.logical_and.accumulate(inside & grows)
        count = int(good.sum())
        ends += count < STEPS and bool(grows[count])
        if count:
            at = np.searchsorted(radius[:count], np.linspace(0, radius[count - 1], RADII + 1)[1:])
            rays.append(rays_of_azimuth[np.unique(np.minimum(at, count - 1))])
            pixels.append(pixels_of_azimuth[np.unique(np.minimum(at, count - 1))])
    if sum(map(len, rays)) < AZIMUTHS:
        raise InputError(
            "E-CAMERA-NO-FIELD",
            f"camera file {lens.source}: {lens.called} projects nearly nothing into {width}×{height} px; check it",
        )
    return np.concatenate(rays), np.concatenate(pixels), ends / len(around)


def _fitted(
    model: str, rays: np.ndarray, pixels: np.ndarray, lens: ForeignLens, size: tuple[int, int]
) -> CalibratedCamera:
    """Fit one model by least squares; weights grow with the radius, since outer rays represent a larger area."""
    about = lens.project(np.array([[0, 0, 1], [SMALL, 0, 1], [0, SMALL, 1]]))
    focal = np.linalg.norm(about[1:] - about[0], axis=1) / SMALL
    start = Camera(*size, focal, about[0], np.zeros(12), FISHEYE in model)
    weight = np.sqrt(np.linalg.norm(pixels - about[0], axis=1, keepdims=True) / max(size))
    basis = intrinsic_basis(model)
    names = parameter_names(model)
    scale = np.array([focal[0] if name in ("fx", "fy", "cx", "cy") else 1.0 for name in names])

    def camera_at(x: np.ndarray) -> Camera:
        return start.with_parameters(start.parameters() + basis @ (x * scale))

    def off(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            away = weight * (camera_at(x).project(rays) - pixels)
        return np.nan_to_num(away, nan=FAR_PX, posinf=FAR_PX, neginf=-FAR_PX).ravel()

    def slope(x: np.ndarray) -> np.ndarray:
        derivatives = camera_at(x).parameter_jacobian(rays[:, :2]) @ basis * scale
        return (weight[:, :, None] * derivatives).reshape(-1, len(names))

    solution = least_squares(
        off,
        np.zeros(len(names)),
        slope,  # pyright: ignore[reportArgumentType]
        bounds=(np.where(scale == 1, -np.inf, -HALF), np.inf),
        x_scale="jac",
        max_nfev=MOST_STEPS,
        xtol=SETTLED,
        ftol=SETTLED,
        gtol=SETTLED,
    )
    return CalibratedCamera.of(camera_at(solution.x), model)
