"""Planes, homographies and planar poses: the truth comes back, and degenerate points are named."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.geometry.plane import (
    apply_homography,
    camera_from_plane,
    fit_homographies,
    fit_homography,
    fit_plane,
    homography_jacobian,
    refine_planar_pose,
)
from stcal.geometry.rigid import Rigid
from tests.outcome import fails_with

GRID = np.array([[x, y] for y in range(0, 100, 25) for x in range(0, 125, 25)], float)
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
THREE_ON_A_LINE = np.array([[0.0, 0], [1, 0], [2, 0], [0, 1]])
angle = st.floats(-0.8, 0.8)
shift = st.floats(-100, 100)
poses = st.builds(
    lambda rx, ry, rz, x, y, z: Rigid.exp([rx, ry, rz, x, y, z]), angle, angle, st.floats(-2, 2), shift, shift,
    st.floats(500, 2000),
)  # fmt: skip


def on_plane(xy: np.ndarray) -> np.ndarray:
    return np.column_stack([xy, np.zeros(len(xy))])


def view(pose: Rigid, xy: np.ndarray) -> np.ndarray:
    xyz = pose @ on_plane(xy)
    return xyz[:, :2] / xyz[:, 2:]


@given(poses)
def test_fit_plane_finds_the_plane(pose):
    xyz = pose @ on_plane(GRID)
    normal = pose.rotation[:, 2]
    for side in (1, -1):
        plane = fit_plane(xyz, towards=side * normal)
        np.testing.assert_allclose(plane.normal, side * normal, atol=1e-12)
        assert plane.offset == pytest.approx(side * normal @ pose.translation, abs=1e-9)  # lengths of 1e3 mm
        assert plane.rms < 1e-10
        np.testing.assert_allclose(plane.distance(xyz + 3 * normal), side * 3, atol=1e-9)
        np.testing.assert_allclose(plane.project(xyz + 3 * normal), xyz, atol=1e-9)


def test_plane_rms_is_the_spread_about_it():
    rng = np.random.default_rng(0)
    xyz = on_plane(rng.uniform(-100, 100, (4000, 2)))
    xyz[:, 2] = rng.normal(5, 0.1, 4000)
    plane = fit_plane(xyz, towards=np.array([0, 0, 1.0]))
    # Standard error of a σ from 4000 values: 1.1 %; of the offset 0.1/√4000 = 0.0016 mm.
    assert plane.rms == pytest.approx(0.1, rel=0.05)
    assert plane.rms == pytest.approx(np.sqrt((plane.distance(xyz) ** 2).mean()), rel=1e-9)
    assert plane.offset == pytest.approx(5, abs=0.008)


@pytest.mark.parametrize(
    ("xyz", "message"),
    [
        (np.eye(3)[:2], "E-POINTS-FEW … 2"),
        (np.arange(5.0)[:, None] * [1, 2, 3], "E-POINTS-COLLINEAR"),
        (np.ones((4, 3)), "E-POINTS-COLLINEAR"),
    ],
)
def test_fit_plane_degenerate(xyz, message):
    with fails_with(message):
        fit_plane(xyz)


@given(poses, st.sampled_from([4, 5, 20]))
def test_homography_comes_back_from_its_points(pose, n):
    corners = GRID[[0, 4, 15, 19]]
    used = corners if n == 4 else np.vstack([corners, GRID[6:7]]) if n == 5 else GRID
    true = np.column_stack([pose.rotation[:, :2], pose.translation])
    found = fit_homography(used, view(pose, used))
    np.testing.assert_allclose(apply_homography(found, GRID), view(pose, GRID), atol=1e-10)
    np.testing.assert_allclose(found / found[2, 2], true / true[2, 2], atol=1e-9)
    assert found[2] @ [*used[0], 1] > 0
    assert np.linalg.norm(found) == pytest.approx(1, rel=1e-12)


def test_homographies_side_by_side_are_those_of_single_ones():
    """Of points with noise, of which each set uses others; and one set that determines none."""
    rng = np.random.default_rng(4)
    used = rng.random((6, len(GRID))) < 0.6
    used[5] = np.arange(len(GRID)) < 5  # a row
    xy_a = np.stack([view(Rigid.exp([0.4, 0.1 * k, 0.2, -50, -30, 800]), GRID) for k in range(6)])
    xy_a += rng.normal(0, 1e-4, xy_a.shape)
    xy_b = np.tile(GRID, (6, 1, 1))
    together = fit_homographies(xy_b, xy_a, used)
    mapped, jacobian = apply_homography(together, xy_b), homography_jacobian(together, xy_b)
    for k in range(5):
        alone = fit_homography(GRID[used[k]], xy_a[k][used[k]])
        np.testing.assert_allclose(together[k], alone, rtol=0, atol=1e-12)
        np.testing.assert_allclose(mapped[k], apply_homography(alone, GRID), rtol=1e-9)
        np.testing.assert_allclose(jacobian[k], homography_jacobian(alone, GRID), rtol=1e-9)
    assert np.isnan(together[5]).all()


def test_homography_of_noisy_points_agrees_with_opencv():
    rng = np.random.default_rng(3)
    xy_a = view(Rigid.exp([0.4, -0.3, 0.2, -50, -30, 800]), GRID) * 4000 + rng.normal(0, 0.3, GRID.shape)
    ours = apply_homography(fit_homography(GRID, xy_a), GRID)
    opencv = apply_homography(cv2.findHomography(GRID, xy_a, 0)[0], GRID)
    # OpenCV minimises the geometric error, we the algebraic one: apart, but by far less than the noise of 0.3 px.
    assert 0 < np.abs(ours - opencv).max() < 0.02
    rms = np.sqrt(((ours - xy_a) ** 2).mean())
    assert rms == pytest.approx(0.3 * np.sqrt(1 - 8 / 40), rel=0.3)  # 40 equations, 8 unknowns, 12 % standard error


@given(poses)
def test_homography_jacobian_is_the_derivative(pose):
    h = np.column_stack([pose.rotation[:, :2], pose.translation])
    step = 1e-3
    jac = homography_jacobian(h, GRID)
    for axis in range(2):
        d = np.zeros(2)
        d[axis] = step
        numeric = (apply_homography(h, GRID + d) - apply_homography(h, GRID - d)) / (2 * step)
        # Entries are about 1/z = 1e-3; central differences err by rounding, 1e-16 / 1e-3.
        np.testing.assert_allclose(jac[:, :, axis], numeric, atol=1e-11)


@pytest.mark.parametrize(
    ("xy_b", "xy_a", "message"),
    [
        (SQUARE[:3], SQUARE[:3], "E-POINTS-FEW … 3"),
        (THREE_ON_A_LINE, THREE_ON_A_LINE, "E-POINTS-COLLINEAR"),
        (THREE_ON_A_LINE, SQUARE, "E-POINTS-COLLINEAR"),
        (SQUARE, THREE_ON_A_LINE, "E-POINTS-COLLINEAR"),
        (np.ones((4, 2)), SQUARE, "E-POINTS-COLLINEAR"),
        (np.arange(9.0)[:, None] * [1, 2], np.arange(9.0)[:, None] * [2, 1], "E-POINTS-COLLINEAR"),
    ],
)
def test_homography_degenerate(xy_b, xy_a, message):
    with fails_with(message):
        fit_homography(xy_b, xy_a)


@given(poses, st.floats(0.1, 10), st.sampled_from([1, -1]))
def test_planar_pose_from_a_homography_of_any_scale_and_sign(pose, scale, sign):
    h = sign * scale * np.column_stack([pose.rotation[:, :2], pose.translation])
    np.testing.assert_allclose(camera_from_plane(h).matrix(), pose.matrix(), atol=1e-9)  # lengths of 2e3 mm


@given(poses, st.tuples(*[st.floats(-0.05, 0.05)] * 3), st.tuples(*[st.floats(-20, 20)] * 3))
def test_refinement_recovers_the_pose_from_a_poor_start(pose, turn, move):
    start = Rigid.exp([*turn, *move]) @ pose
    start = Rigid(start.rotation, pose.translation + move)  # turned about its own origin, then moved
    found = refine_planar_pose(start, GRID, view(pose, GRID))
    # 1e-10 rad ends the iteration; the lever to the camera is 2000 mm and the depth is the weak direction.
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-8)
    np.testing.assert_allclose(found.translation, pose.translation, atol=1e-5)


def test_refinement_agrees_with_opencv_on_noisy_points():
    rng = np.random.default_rng(1)
    pose = Rigid.exp([0.5, 0.3, -0.2, -40, -30, 900])
    seen = view(pose, GRID) + rng.normal(0, 1e-4, GRID.shape)
    ours = refine_planar_pose(camera_from_plane(fit_homography(GRID, seen)), GRID, seen)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-15)
    rvec, tvec = cv2.solvePnPRefineLM(
        on_plane(GRID), seen, np.eye(3), np.zeros(4), pose.log()[:3, None], pose.translation[:, None].copy(), criteria
    )
    # Both minimise the same sum of squares; OpenCV's LM stops some 1e-6 from the minimum.
    np.testing.assert_allclose(ours.log(), np.concatenate([rvec, tvec]).ravel(), rtol=1e-5, atol=1e-6)
    assert np.abs(ours.translation - pose.translation).max() > 1e-3  # the noise did move it


def test_refinement_refuses_points_behind_the_camera_and_poses_that_do_not_settle(monkeypatch):
    with fails_with("E-POINTS-BEHIND"):
        refine_planar_pose(Rigid(translation=[0, 0, -500]), GRID, GRID / 1000)
    monkeypatch.setattr("stcal.geometry.plane.MAX_STEPS", 1)
    with fails_with("E-NO-MINIMUM … planar pose … 1"):
        refine_planar_pose(Rigid(translation=[0, 0, 600]), GRID, GRID / 500)
