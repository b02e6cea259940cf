"""Checks of calibrated intrinsics: σ of projections over the image, and comparison of two halves of the images."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtrc

from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import intrinsic_basis
from stcal.sfm.camera.intrinsics import Intrinsics, adjust_intrinsics, model_parameters
from stcal.sfm.data.observations import ImageObservations

Verdict = Literal["passed", "suspicious", "failed"]
SUSPICIOUS_P, FAILED_P = 1e-2, 1e-4
"""p-values below which the halves' difference is suspicious or failed: false-alarm probabilities."""
GRID = (13, 9)
MIN_HALF = 3
MIN_REACH = 0.75
"""Smallest advised reach of dots from the middle towards a corner. Beyond it little distortion is extrapolated."""


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionSigma:
    """σ of projections over the image.

    ``xy_px`` : (n, 2) places in the image; ``sigma_px`` : (n,) σ per axis of the image of a known direction there, up
    to a rotation of the camera, which poses absorb; ``reach`` : (4,) how far dots come towards the corners (top left,
    top right, bottom left, bottom right), 1 at the corner; ``corner_sigma_px`` : (4,) σ in these corners.
    """

    xy_px: np.ndarray
    sigma_px: np.ndarray
    reach: np.ndarray
    corner_sigma_px: np.ndarray

    def __post_init__(self):
        for name in ("xy_px", "sigma_px", "reach", "corner_sigma_px"):
            object.__setattr__(self, name, frozen(getattr(self, name), what=name))


@dataclass(frozen=True, slots=True, eq=False)
class SplitHalf:
    """Comparison of the intrinsics from every second view with those from the other views, on the same boards.

    ``difference`` : (q,) of the parameters, and ``sigma`` : (q,) its σ; ``p_value`` : of the χ² of all q;
    ``largest_px`` : largest difference of a projection over the image; ``largest_sigma_px`` : its σ per axis.
    """

    difference: np.ndarray
    sigma: np.ndarray
    p_value: float
    largest_px: float
    largest_sigma_px: float
    verdict: Verdict


def image_grid(camera: Camera) -> np.ndarray:
    """Returns a grid of places over the whole image, including the corners, (n, 2) px."""
    x, y = np.linspace(0, camera.width - 1, GRID[0]), np.linspace(0, camera.height - 1, GRID[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def projection_jacobian(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns the derivative (n, 2, q) of the images of fixed directions at :func:`image_grid` by the parameters.

    The part that a rotation of the camera can absorb is removed.

    Raises
    ------
    DegenerateError
        The distortion folds the image over.
    """
    try:
        ideal = camera.normalised_from_pixel(image_grid(camera))
    except ConvergenceError as error:
        raise DegenerateError(
            "E-CAMERA-FOLDED",
            "camera: the distortion folds over inside the image, where no dots are; add views that fill the image "
            "to its corners, or choose a --model with fewer parameters",
        ) from error
    jacobian = camera.parameter_jacobian(ideal) @ intrinsic_basis(colmap_model)
    x, y = ideal.T
    rotation = np.stack([np.stack([-x * y, 1 + x * x, -y], axis=-1), np.stack([-1 - y * y, x * y, x], axis=-1)], axis=1)
    by_ideal = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    by_rotation = (by_ideal @ rotation).reshape(-1, 3)
    flat = jacobian.reshape(len(by_rotation), -1)
    return (flat - by_rotation @ np.linalg.lstsq(by_rotation, flat, rcond=None)[0]).reshape(jacobian.shape)


def projection_sigma(result: Intrinsics) -> ProjectionSigma:
    """Returns σ of projections over the image, and how far dots reach towards its corners."""
    camera = result.camera
    xy = image_grid(camera)
    jacobian = projection_jacobian(camera, result.colmap_model)
    sigma = _sigma_px(jacobian, result.covariance)
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    dots = np.concatenate([m.measured_px for m in result.models]) - middle
    # The smaller of the two coordinates counts: a dot at the side of the image is not in its corner.
    reach = np.minimum.reduce(dots[:, None] * corners / middle, axis=2).max(0)
    corner_index = [int(np.argmin(((xy - middle - corner * middle) ** 2).sum(1))) for corner in corners]
    return ProjectionSigma(xy, sigma, np.maximum(reach, 0), sigma[corner_index])


def split_half(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> SplitHalf | None:
    """Compares both halves of the views; None with fewer than six views.

    One adjustment with a camera for each half accounts for the dots that the halves have in common.
    """
    if len(views) < 2 * MIN_HALF:
        return None
    half = [i % 2 for i in range(len(views))]
    both = adjust_intrinsics(views, board, result.camera, result.colmap_model, half, result.factors)
    q = len(both.covariance) // 2
    difference = np.subtract(*(model_parameters(camera, result.colmap_model) for camera in reversed(both.cameras)))
    subtract = np.hstack([-np.eye(q), np.eye(q)])
    covariance = subtract @ both.covariance @ subtract.T
    p_value = float(chdtrc(q, difference @ np.linalg.solve(covariance, difference)))
    jacobian = projection_jacobian(result.camera, result.colmap_model)
    length = np.linalg.norm(jacobian @ difference, axis=1)
    worst = int(np.argmax(length))
    return SplitHalf(
        difference,
        np.sqrt(np.diag(covariance)),
        p_value,
        float(length[worst]),
        float(_sigma_px(jacobian, covariance)[worst]),
        "passed" if p_value >= SUSPICIOUS_P else "suspicious" if p_value >= FAILED_P else "failed",
    )


def _sigma_px(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Returns σ per axis (RMS over both axes), (n,)."""
    return np.sqrt(np.einsum("nip,pq,niq->n", jacobian, covariance, jacobian) / 2)
