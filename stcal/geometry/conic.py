"""Circles in space and their images: the centre of the ellipse is not the image of the circle's centre."""

import numpy as np

from stcal.errors import DegenerateError


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


def circle_conic(xyz_camera: np.ndarray, normal_camera: np.ndarray, radius_mm: float) -> np.ndarray:
    """Return the conic matrix Q (3, 3) of one circle's image.

    xᵀ Q x = 0 in normalised coordinates, and Q[0, 0] + Q[1, 1] > 0.
    """
    n = np.asarray(normal_camera, float)
    e1 = np.cross(n, [1.0, 0, 0] if abs(n[0]) < 0.9 else [0, 1.0, 0])
    e1 /= np.linalg.norm(e1)
    m = np.column_stack([e1, np.cross(n, e1), np.asarray(xyz_camera, float)])
    inverse = np.linalg.inv(m)
    q = inverse.T @ np.diag([1.0, 1.0, -(radius_mm**2)]) @ inverse
    return q * np.sign(q[0, 0] + q[1, 1])


def ellipse_of_conic(conic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centre (2,) and shape (2, 2) of an ellipse; the rim is ``centre + shape @ unit circle``, shape symmetric.

    Raises
    ------
    DegenerateError
        The conic is no real ellipse but a parabola, a hyperbola, a point, or empty.
    """
    q = conic[:2, :2]
    if np.linalg.det(q) <= 0:
        raise DegenerateError(
            "E-CONIC-NO-ELLIPSE", "conic: not an ellipse; the circle must lie wholly in front of the camera"
        )
    centre = -np.linalg.solve(q, conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    value, vector = np.linalg.eigh(q)
    if level * value[0] <= 0:
        raise DegenerateError("E-CONIC-NO-ELLIPSE", "conic: no real points; an ellipse of positive size needed")
    value = value / level
    return centre, (vector / np.sqrt(value)) @ vector.T


def conic_of_ellipse(centre: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the conic matrix (3, 3) of the ellipse ``centre + shape @ unit circle``; see :func:`ellipse_of_conic`."""
    inverse = np.linalg.inv(shape)
    to_unit = np.column_stack([inverse, -inverse @ centre])
    m = np.vstack([to_unit, [0, 0, 1.0]])
    return m.T @ np.diag([1.0, 1.0, -1.0]) @ m
