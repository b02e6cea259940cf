"""Circles in space and their images: the centre of the ellipse is not the image of the circle's centre."""

import numpy as np


def circle_image_offset(xyz_camera: np.ndarray, normal_camera: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
    """Return points whose ordinary projection is the centre of the ellipse that each circle projects to.

    With centre C, unit normal n and radius r the ellipse centre is the projection of
    ``C + (r²/C_z)(n_z·n − e_z)`` (from the dual conic M·diag(r², r², −1)·Mᵀ, M = [e₁ e₂ C];
    Hartley & Zisserman, sec. 2.2 and 8.3). ``e_z`` is the optical axis.

    Parameters
    ----------
    xyz_camera, normal_camera : (..., 3) arrays
        Centre and unit normal (either sign), camera frame.
    radius_mm : (...) array
        In the unit of ``xyz_camera``.
    """
    c, n = np.asarray(xyz_camera, float), np.asarray(normal_camera, float)
    shift = n[..., 2:] * n - np.array([0.0, 0.0, 1.0])
    return c + (np.asarray(radius_mm, float) ** 2 / c[..., 2])[..., None] * shift


def circle_images(xyz_camera: np.ndarray, axes_camera: np.ndarray, radius_mm: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the image ellipses of n circles of one plane, by the dual conic of :func:`circle_image_offset`.

    Parameters
    ----------
    xyz_camera : (n, 3) array
        Centres, camera frame; the circles lie wholly in front of it.
    axes_camera : (3, 2) array
        Orthonormal directions in the plane, camera frame.
    radius_mm : (n,) array
        In the unit of ``xyz_camera``.

    Returns
    -------
    centre : (n, 2) array, shape : (n, 2, 2) array
        Normalised; the rim is ``centre + shape @ unit circle``, shape symmetric.
    """
    dual = radius_mm[:, None, None] ** 2 * (axes_camera @ axes_camera.T) - xyz_camera[:, :, None] * xyz_camera[:, None]
    dual = -dual / dual[:, 2:, 2:]
    centre = -dual[:, :2, 2]
    return centre, shape_of_square(dual[:, :2, :2] + centre[:, :, None] * centre[:, None])


def shape_of_square(square: np.ndarray) -> np.ndarray:
    """Return the symmetric shapes S of ellipses, (..., 2, 2), from S·Sᵀ; negative eigenvalues count as zero."""
    value, vector = np.linalg.eigh(square)
    return (vector * np.sqrt(np.maximum(value, 0))[..., None, :]) @ np.swapaxes(vector, -1, -2)
