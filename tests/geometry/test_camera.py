"""The camera against OpenCV, its inverse and its derivative, and the folds it must refuse."""

from itertools import product

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.geometry.camera import Camera
from tests.outcome import refuses

WIDTH, HEIGHT = 5184, 3456
small = st.floats(-1, 1)
# Lenses from strong barrel to strong pincushion that do not fold within ±0.5 (27° off axis), and thin prisms.
SIZES = np.array([0.2, 0.1, 2e-3, 2e-3, 0.05, 0.1, 0.05, 0.02, 5e-3, 5e-3, 5e-3, 5e-3])
lenses = st.lists(small, min_size=12, max_size=12).map(lambda c: np.array(c) * SIZES)
coordinate = st.floats(-0.5, 0.5)
normalised = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=8).map(np.array)


def camera_of(distortion) -> Camera:
    return Camera(WIDTH, HEIGHT, [5580.0, 5570.0], [2600.0, 1700.0], np.resize([*distortion, *[0.0] * 12], 12))


def matrix_of(camera: Camera) -> np.ndarray:
    (fx, fy), (cx, cy) = camera.focal, camera.centre
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


BARREL = camera_of([-0.3])  # r − 0.3 r³ turns back at r = 1.054, where it is 0.703


@given(lenses, normalised, st.floats(100, 5000))
def test_projection_is_opencvs(distortion, xy, depth_mm):
    camera = camera_of(distortion)
    xyz = np.column_stack([xy, np.ones(len(xy))]) * depth_mm
    expected = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), matrix_of(camera), distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(xyz), expected, atol=1e-9)  # px; rounding at 5000 px is 1e-12
    np.testing.assert_allclose(camera.normalised_from_pixel(expected), xy, atol=1e-11)  # 1e-12 through slopes of 0.1


def test_inverse_is_opencvs_in_all_of_the_image_and_points_keep_their_shape():
    camera = camera_of([-0.12, 0.08, 1e-3, -5e-4, 0.01])
    grid = np.stack(np.meshgrid(np.linspace(0, WIDTH, 20), np.linspace(0, HEIGHT, 15)), -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 1000, 1e-13)
    opencv = cv2.undistortPointsIter(grid, matrix_of(camera), camera.distortion, None, None, criteria)
    np.testing.assert_allclose(camera.normalised_from_pixel(grid), opencv, atol=1e-12)
    ideal = (grid - camera.centre) / camera.focal
    assert 0.005 < np.abs(opencv - ideal).max() < 0.1  # and there is distortion to remove: 30 px and more
    for shape in [(2,), (0, 2), (3, 2), (3, 4, 2)]:
        assert BARREL.normalised_from_pixel(np.full(shape, 2000.0)).shape == shape
        assert BARREL.pixel_from_normalised(np.zeros(shape)).shape == shape


@given(lenses, normalised)
def test_distort_and_undistort_are_inverse_in_either_order(distortion, xy):
    camera = camera_of(distortion)
    np.testing.assert_allclose(camera.distort(camera.undistort(0.5 * xy)), 0.5 * xy, atol=1.1e-12)
    np.testing.assert_allclose(camera.undistort(camera.distort(xy)), xy, atol=1e-11)


def test_barrel_inverts_up_to_its_fold_and_refuses_every_point_beyond():
    for radius, angle in product((0.1, 0.5, 0.69, 0.7), np.linspace(0, 2 * np.pi, 7)):
        direction = np.array([np.cos(angle), np.sin(angle)])
        ideal = BARREL.undistort(radius * direction) @ direction
        # The branch before the fold, outwards from the distorted radius: r = 1 gives exactly 0.7.
        assert radius < ideal < 1.0000001
        assert ideal - 0.3 * ideal**3 == pytest.approx(radius, abs=2e-12)
    # The cubic has a root there too, at −2.1 and less: the mirrored side of the image, and Newton finds it.
    for radius in np.linspace(0.71, 3, 30):
        for xy in ([radius, 0.0], [-0.6 * radius, 0.8 * radius], [[0.1, 0.2], [0.0, radius]]):
            refuses("E-CAMERA-FOLDED", BARREL.undistort, xy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "E-CAMERA-SIZE … 0 … 3456"),
        ({"height": -5}, "E-CAMERA-SIZE … 5184 … -5"),
        ({"focal": [0, 1000]}, "E-CAMERA-FOCAL"),
        ({"focal": [1000, -1]}, "E-CAMERA-FOCAL"),
        ({"focal": [1000]}, "E-ARRAY-SHAPE … focal length … (1,)"),
        ({"focal": [np.nan, 1000]}, "E-ARRAY-NOT-FINITE … focal length"),
        ({"centre": [1, np.inf]}, "E-ARRAY-NOT-FINITE … principal point"),
        ({"distortion": np.zeros(5)}, "E-ARRAY-SHAPE … distortion … (5,)"),
        ({"distortion": np.full(8, np.nan)}, "E-ARRAY-NOT-FINITE … distortion"),
        ({"distortion": [0, 0, 0, 0, 0, 0, 1, 0], "fisheye": True}, "E-CAMERA-COEFFICIENTS"),
    ],
)
def test_camera_refuses(change, message):
    good = {"width": WIDTH, "height": HEIGHT, "focal": [1e3, 1e3], "centre": [0, 0], "distortion": np.zeros(8)}
    refuses(message, Camera, **good | change)


FISHEYES = st.tuples(small, small, small, small).map(lambda c: np.array(c) * [0.05, 0.01, 2e-3, 5e-4])
wide = st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=8).map(np.array)
"""Up to 77° from the axis."""


def fisheye_of(k, p=(0.0, 0.0), s=(0.0, 0.0)) -> Camera:
    distortion = [*k[:2], *p, *k[2:], 0, 0, s[0], 0, s[1], 0]
    return Camera(WIDTH, HEIGHT, [2000.0, 1990.0], [2600.0, 1700.0], np.array(distortion), True)


@given(FISHEYES, wide, st.floats(100, 5000))
def test_equidistant_projection_is_opencvs(k, xy, depth_mm):
    camera = fisheye_of(k)
    xyz = np.column_stack([xy, np.ones(len(xy))]) * depth_mm
    expected = cv2.fisheye.projectPoints(xyz[:, None], np.zeros(3), np.zeros(3), matrix_of(camera), k)[0][:, 0]
    np.testing.assert_allclose(camera.project(xyz), expected, atol=1e-9)
    np.testing.assert_allclose(camera.normalised_from_pixel(expected), xy, atol=1e-9)  # 20 times steeper at 77°


CAMERAS = {
    "rational": camera_of([-0.2, 0.1, 2e-3, -1e-3, 0.05, 0.1, -0.05, 0.02]),
    "prisms": camera_of([-0.1, 0.03, 1e-3, -2e-3, 0.01, 0.02, 0, 0, 2e-3, -1e-3, 1e-3, 5e-4]),
    "equidistant": fisheye_of([0.02, -0.01, 3e-3, -1e-3], (1e-3, -2e-3), (1.5e-3, -7e-4)),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_are_those_of_differences(name):
    camera = CAMERAS[name]
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2)) * (4 if camera.fisheye else 1)
    xy[0] = 0, 1e-5  # where the angle's series is taken
    moved = [camera.distort(xy + sign * step) for step in 1e-6 * np.eye(2) for sign in (1, -1)]
    by_difference = np.stack([moved[0] - moved[1], moved[2] - moved[3]], axis=-1) / 2e-6
    value, by_xy = camera.distort_jacobian(xy)
    np.testing.assert_array_equal(value, camera.distort(xy))
    np.testing.assert_allclose(by_xy, by_difference, atol=1e-9)
    jacobian, parameters = camera.parameter_jacobian(xy), camera.parameters()
    unused = {10, 11, 13, 15} if camera.fisheye else set()
    for k in sorted(set(range(16)) - unused):
        step = np.zeros(16)
        step[k] = 1e-3 if k < 4 else 1e-6
        ahead, behind = (camera.with_parameters(parameters + sign * step) for sign in (1, -1))
        by_difference = (ahead.pixel_from_normalised(xy) - behind.pixel_from_normalised(xy)) / (2 * step[k])
        np.testing.assert_allclose(jacobian[:, :, k], by_difference, atol=1e-5 * max(np.abs(by_difference).max(), 1))


STRAIGHT = fisheye_of([0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("function", "place", "message"),
    [
        (BARREL.normalised_from_pixel, [[2600.0, 1700], [8180, 1700]], "E-CAMERA-FOLDED … 8180 … 1700"),
        (camera_of([0, 0, 0, 0, 0, -1.0]).undistort, [2.0, 0.0], "E-CAMERA-FOLDED"),  # at the pole
        (BARREL.undistort, [1e200, 1e200], "E-CAMERA-FOLDED"),
        (BARREL.normalised_from_pixel, [[100.0, 100], [np.nan, 100]], "E-CAMERA-PIXEL"),
        (BARREL.normalised_from_pixel, [[100.0, 100], [np.inf, 100]], "E-CAMERA-PIXEL"),
        (STRAIGHT.normalised_from_pixel, [2600 + 1000 * np.pi, 1700.0], "E-CAMERA-FIELD … 90.0 … 89"),
    ],
)
def test_places_without_a_ray_are_named(function, place, message):
    refuses(message, function, place)
    # Just before a right angle there is one.
    assert np.isfinite(STRAIGHT.normalised_from_pixel([2600.0 + 2000 * np.radians(88), 1700.0])).all()
