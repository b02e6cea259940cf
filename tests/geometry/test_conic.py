"""Images of circles: the ellipse's centre against a conic fitted to projected rim points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stcal.geometry.plane import circle_image_offset
from tests.support.circle_images import circle_conic, ellipse_of_conic


@st.composite
def circles(draw):
    """Centre, unit normal and radius of a circle wholly in front of the camera, tilted up to 75°."""
    depth, radius = draw(st.floats(200, 3000)), draw(st.floats(2, 60))
    xy = np.array([draw(st.floats(-0.6, 0.6)), draw(st.floats(-0.6, 0.6))])
    centre = np.array([*(xy * depth), depth])
    tilt, azimuth = draw(st.floats(0, 1.3)), draw(st.floats(0, 2 * np.pi))
    to_camera = -centre / depth / np.linalg.norm(centre / depth)
    across = np.cross(to_camera, [np.cos(azimuth), np.sin(azimuth), 0])
    return centre, Rotation.from_rotvec(tilt * across / np.linalg.norm(across)).apply(to_camera), radius


def rim(centre, normal, radius, n=64) -> np.ndarray:
    """Projected rim points, normalised coordinates, (n, 2)."""
    e1 = np.linalg.svd(normal[None])[2][1]
    e2 = np.cross(normal, e1)
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None]
    xyz = centre + radius * (np.cos(t) * e1 + np.sin(t) * e2)
    return xyz[:, :2] / xyz[:, 2:]


def fitted_centre(xy: np.ndarray) -> np.ndarray:
    """Centre of the conic through points, by a plain algebraic fit in centred and scaled coordinates."""
    mean, scale = xy.mean(0), xy.std()
    x, y = ((xy - mean) / scale).T
    a, b, c, d, e, _ = np.linalg.svd(np.column_stack([x * x, x * y, y * y, x, y, np.ones_like(x)]))[2][-1]
    return mean + scale * np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])


@given(circles())
def test_offset_point_projects_to_the_centre_of_the_fitted_ellipse(circle):
    centre, normal, radius = circle
    xyz = circle_image_offset(centre, normal, radius)
    # Points on an exact conic: the fit is limited by rounding, magnified by the aspect of up to 4 : 1.
    np.testing.assert_allclose(xyz[:2] / xyz[2], fitted_centre(rim(*circle)), atol=1e-11)
    np.testing.assert_array_equal(circle_image_offset(centre, -normal, radius), xyz)


def test_offset_of_the_field_notes():
    # 1 m, f = 5580 px, r = 8 mm, 45°: 0.18 px (FIELD_NOTES.md).
    xyz = circle_image_offset([0, 0, 1000.0], np.array([np.sqrt(0.5), 0, -np.sqrt(0.5)]), 8.0)
    assert np.hypot(*(5580 * xyz[:2] / xyz[2])) == pytest.approx(0.18, abs=0.005)


def test_offset_takes_stacks():
    rng = np.random.default_rng(0)
    centres = rng.uniform([-100, -100, 900], [100, 100, 1100], (4, 3))
    normals = rng.normal(size=(4, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    radii = rng.uniform(2, 10, 4)
    together = circle_image_offset(centres, normals, radii)
    for i in range(4):
        np.testing.assert_allclose(together[i], circle_image_offset(centres[i], normals[i], radii[i]), rtol=1e-15)


@given(circles())
def test_rim_points_lie_on_the_conic_and_on_its_ellipse(circle):
    conic = circle_conic(*circle)
    xy = rim(*circle)
    centre, shape = ellipse_of_conic(conic)
    # On the unit circle once the shape is taken out; the conic loses (D/r)² ≈ 1e6…1e7 of 1e-16 to cancellation.
    unit = np.linalg.solve(shape, (xy - centre).T)
    np.testing.assert_allclose(np.hypot(*unit), 1, atol=1e-6)
    np.testing.assert_allclose(centre, fitted_centre(xy), atol=1e-9)
    np.testing.assert_allclose(conic, conic.T, rtol=0, atol=1e-14 * np.abs(conic).max())
    assert conic[0, 0] + conic[1, 1] > 0
