"""Planes and their images: circles, homographies, the two poses of a plane, and the descent from several poses."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from stcal.geometry import least_squares
from stcal.geometry.least_squares import Normal, block_diagonal, descend
from stcal.geometry.plane import (
    OUTLIER,
    apply_homography,
    camera_from_plane,
    circle_image_offset,
    covariance_of_both,
    deciding_delta,
    distinct,
    fit_homographies,
    fit_homography,
    fit_plane,
    homography_jacobian,
    mirrored,
    poses_of_plane,
    refine_planar_pose,
    two_minima,
    weigh,
)
from stcal.geometry.rigid import Poses, Rigid, by_pose, perspective
from tests.outcome import refuses

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
def test_fit_plane_finds_the_plane_and_the_jacobian_of_a_homography_is_the_derivative(pose):
    xyz = pose @ on_plane(GRID)
    normal = pose.rotation[:, 2]
    for side in (1, -1):
        plane = fit_plane(xyz, towards=side * normal)
        np.testing.assert_allclose(plane.normal, side * normal, atol=1e-12)
        assert plane.offset == pytest.approx(side * normal @ pose.translation, abs=1e-9)  # lengths of 1e3 mm
        assert plane.rms < 1e-10
        np.testing.assert_allclose((xyz + 3 * normal) @ plane.normal - plane.offset, side * 3, atol=1e-9)
    h = np.column_stack([pose.rotation[:, :2], pose.translation])
    step = 1e-3
    jac = homography_jacobian(h, GRID)
    for axis in range(2):
        d = np.zeros(2)
        d[axis] = step
        numeric = (apply_homography(h, GRID + d) - apply_homography(h, GRID - d)) / (2 * step)
        # Entries are about 1/z = 1e-3; central differences err by rounding, 1e-16 / 1e-3.
        np.testing.assert_allclose(jac[:, :, axis], numeric, atol=1e-11)


def test_plane_rms_is_the_spread_about_it_and_the_offset_that_of_the_field_notes():
    rng = np.random.default_rng(0)
    xyz = on_plane(rng.uniform(-100, 100, (4000, 2)))
    xyz[:, 2] = rng.normal(5, 0.1, 4000)
    plane = fit_plane(xyz, towards=np.array([0, 0, 1.0]))
    # Standard error of a σ from 4000 values: 1.1 %; of the offset 0.1/√4000 = 0.0016 mm.
    assert plane.rms == pytest.approx(0.1, rel=0.05)
    assert plane.rms == pytest.approx(np.sqrt(((xyz @ plane.normal - plane.offset) ** 2).mean()), rel=1e-9)
    assert plane.offset == pytest.approx(5, abs=0.008)
    # 1 m, f = 5580 px, r = 8 mm, 45°: 0.18 px (FIELD_NOTES.md).
    xyz = circle_image_offset([0, 0, 1000.0], np.array([np.sqrt(0.5), 0, -np.sqrt(0.5)]), 8.0)
    assert np.hypot(*(5580 * xyz[:2] / xyz[2])) == pytest.approx(0.18, abs=0.005)


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


def test_homographies_side_by_side_are_those_of_single_ones_and_of_opencv():
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
    rng = np.random.default_rng(3)
    xy_a = view(Rigid.exp([0.4, -0.3, 0.2, -50, -30, 800]), GRID) * 4000 + rng.normal(0, 0.3, GRID.shape)
    ours = apply_homography(fit_homography(GRID, xy_a), GRID)
    opencv = apply_homography(cv2.findHomography(GRID, xy_a, 0)[0], GRID)
    # OpenCV minimises the geometric error, we the algebraic one: apart, but by far less than the noise of 0.3 px.
    assert 0 < np.abs(ours - opencv).max() < 0.02
    rms = np.sqrt(((ours - xy_a) ** 2).mean())
    assert rms == pytest.approx(0.3 * np.sqrt(1 - 8 / 40), rel=0.3)  # 40 equations, 8 unknowns, 12 % standard error


@pytest.mark.parametrize(
    ("error", "fit", "points"),
    [
        ("E-POINTS-FEW … 2", fit_plane, [np.eye(3)[:2]]),
        ("E-POINTS-COLLINEAR", fit_plane, [np.arange(5.0)[:, None] * [1, 2, 3]]),
        ("E-POINTS-COLLINEAR", fit_plane, [np.ones((4, 3))]),
        ("E-POINTS-FEW … 3", fit_homography, [SQUARE[:3], SQUARE[:3]]),
        ("E-POINTS-COLLINEAR", fit_homography, [THREE_ON_A_LINE, THREE_ON_A_LINE]),
        ("E-POINTS-COLLINEAR", fit_homography, [THREE_ON_A_LINE, SQUARE]),
        ("E-POINTS-COLLINEAR", fit_homography, [SQUARE, THREE_ON_A_LINE]),
        ("E-POINTS-COLLINEAR", fit_homography, [np.ones((4, 2)), SQUARE]),
        ("E-POINTS-COLLINEAR", fit_homography, [np.arange(9.0)[:, None] * step for step in ([1, 2], [2, 1])]),
    ],
)
def test_points_that_determine_nothing(error, fit, points):
    refuses(error, fit, *points)


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


def test_refinement_agrees_with_opencv_on_noisy_points_and_refuses_those_behind_the_camera(monkeypatch):
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
    refuses("E-POINTS-BEHIND", refine_planar_pose, Rigid(translation=[0, 0, -500]), GRID, GRID / 1000)
    monkeypatch.setattr("stcal.geometry.plane.MAX_STEPS", 1)
    refuses("E-NO-MINIMUM … planar pose … 1", refine_planar_pose, Rigid(translation=[0, 0, 600]), GRID, GRID / 500)


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


def tilted_plane(seed: int):
    rng = np.random.default_rng(seed)
    while True:
        xy = rng.uniform(-50, 50, (6, 2)) + np.array([30, 10])
        turn = Rotation.from_rotvec(0.5 * rng.standard_normal(3)).as_matrix()
        pose = Rigid(turn, [*rng.uniform(-200, 200, 2), 800.0])
        at = pose @ np.pad(xy, ((0, 0), (0, 1)))
        middle = at.mean(0)
        cosine = turn[:, 2] @ middle / np.linalg.norm(middle)
        if cosine > 0.1 and (at[:, 2] > 0).all():
            return xy, at[:, :2] / at[:, 2:], pose, cosine


@pytest.mark.parametrize("seed", range(20))
def test_one_of_the_poses_is_the_true_one_and_both_are_opencvs(seed):
    xy, seen, pose, cosine = tilted_plane(seed)
    found = poses_of_plane(xy, seen)
    off = min(np.abs(each.matrix() - pose.matrix()).max() for each in found.poses)
    assert off < 1e-8  # rounding, over the condition of the homography
    assert found.foreshortening == pytest.approx(cosine, abs=1e-9)
    _, turns, _, _ = cv2.solvePnPGeneric(np.pad(xy, ((0, 0), (0, 1))), seen, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    theirs = [cv2.Rodrigues(turn)[0] for turn in turns]
    for ours in found.poses:
        assert min(np.abs(ours.rotation - each).max() for each in theirs) < 1e-9


def test_size_and_distance_change_det_j_but_not_the_foreshortening_and_from_behind_is_refused():
    xy, seen, _, _ = tilted_plane(3)
    one, ten = poses_of_plane(xy, seen), poses_of_plane(10 * xy, seen)
    assert ten.foreshortening == pytest.approx(one.foreshortening, rel=1e-9)
    assert ten.determinant == pytest.approx(one.determinant / 100, rel=1e-9)
    refuses("E-POINTS-MIRRORED", poses_of_plane, xy * [-1, 1], seen)


RNG = np.random.default_rng(0)
XYZ = RNG.uniform(-50, 50, (12, 3))
TRUTH = Rigid.exp([0.2, -0.1, 0.4, 10, -20, 400])


def seen(poses, xyz=XYZ, scale=1e3):
    """Coordinates (h, n, 2), their derivative (h, n, 2, 6), and whether all points lie before the camera."""
    turned = np.einsum("hij,nj->hni", poses.rotation, xyz)
    at = turned + poses.translation[:, None]
    ideal, by_point = perspective(at)
    return scale * ideal, scale * by_pose(by_point, turned), (at[..., 2] > 0).all(1)


MEASURED = seen(Poses.of([TRUTH]))[0][0] + RNG.normal(0, 0.01, (12, 2))


def evaluate(poses, huber=3.0):
    xy, by_pose, possible = seen(poses)
    return Normal.of((MEASURED - xy) / 0.01, by_pose / 0.01, possible, huber)


def test_every_start_reaches_its_minimum_and_a_pose_with_points_behind_the_camera_is_none():
    """To σ: 12 points, 24 − 6 degrees of freedom, χ² below 45 but for one in 2000; starts off by up to 17°, 30 mm."""
    far = [Rigid.exp([*RNG.normal(0, 0.1, 3), *RNG.normal(0, 10, 3)]) @ TRUTH for _ in range(5)]
    found = descend(evaluate, Poses.of(far), 1e-8)
    assert found.settled.all()
    assert 5 < found.cost.min() <= found.cost.max() < 45
    assert np.ptp(found.poses.translation, axis=0) == pytest.approx(0, abs=1e-4)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.normal[0])))[3:]
    assert (np.abs(found.poses.translation[0] - TRUTH.translation) < 4 * sigma).all()
    assert evaluate(Poses.of([Rigid.exp([0, 0, 0, 0, 0, -400])])).cost[0] == np.inf
    blocks = RNG.normal(size=(2, 4, 2, 3))
    assert np.array_equal(block_diagonal(blocks[0]), block_diag(*blocks[0]))
    assert np.array_equal(block_diagonal(blocks)[1], block_diag(*blocks[1]))


def test_hopeless_rivals_are_left():
    """A rival 1000 worse that could win 5 in all, by short steps: it is followed, unless 500 are hopeless."""

    def evaluate(poses):
        away = poses.translation[:, 0] - [0.0, 10.0]
        cost = 0.05 * away**2 + [0.0, 1000.0]
        normal = np.tile(np.eye(6), (2, 1, 1))  # twenty times the curvature
        gradient = np.zeros((2, 6))
        gradient[:, 3] = 0.05 * away
        return Normal(cost, normal, gradient, np.zeros((2, 1)))

    start = Poses(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    followed = descend(evaluate, start, 1e-9).poses.translation[:, 0]
    left = descend(evaluate, start, 1e-9, hopeless=500.0).poses.translation[:, 0]
    assert followed[1] > 8
    assert left.tolist() == [0, 0]


DOTS = np.array([[x, y, 0.0] for x in (-30, -10, 10, 30) for y in (-20, 0, 20)])
SIGMA = 1e-4
MIDDLE = Rigid(np.eye(3), np.zeros(3))


def descend_to(measured, poses, huber):
    def evaluate(poses):
        xy, by_pose, possible = seen(poses, DOTS, 1.0)
        return Normal.of((measured - xy) / SIGMA, by_pose / SIGMA, possible, huber)

    return least_squares.descend(evaluate, poses, 1e-6)


def measured(truth, factor=1.0, seed=0):
    noise = np.random.default_rng(seed).normal(0, factor * SIGMA, (len(DOTS), 2))
    return seen(Poses.of([truth]), DOTS, 1.0)[0][0] + noise


def minima(truth, start, factor=1.0):
    return two_minima(lambda _: partial(descend_to, measured(truth, factor)), Poses.of([start]), MIDDLE, "no pose")


def tilted(angle_rad, away_mm):
    return Rigid.exp([0.0, angle_rad, 0.0, 3.0, -5.0, away_mm])


@pytest.mark.parametrize("side", [1, -1])
def test_both_minima_are_found_from_either(side):
    """25° and 2 m off: the second solution is mirrored at the line of sight, and worse by some χ²."""
    truth = tilted(0.44, 2000.0)
    start = truth if side > 0 else mirrored(Poses.of([truth]), MIDDLE)[0]
    found, limit = minima(truth, start)
    assert len(found.cost) == 2
    assert found.cost[0] < found.cost[1]
    assert limit == OUTLIER
    error = found.poses[0].difference(truth)
    assert error @ found.normal[0] @ error < 30  # χ² of 6 unknowns: once in 25 000
    second = found.poses[1].difference(mirrored(Poses.of([truth]), MIDDLE)[0])
    assert np.linalg.norm(second[:3]) < 0.1


def test_a_near_plane_has_one_and_a_descent_that_does_not_settle_raises():
    """25° at 100 mm, where perspective decides: one minimum, or a second one that is far worse."""
    cost = minima(tilted(0.44, 100.0), tilted(0.44, 100.0))[0].cost
    assert len(cost) == 1 or cost[1] > cost[0] + 1e4

    def unsettled(poses, huber):
        found = descend_to(measured(tilted(0.1, 500.0)), poses, huber)
        return replace(found, settled=np.zeros(len(poses), bool))

    refuses("E-NO-MINIMUM", two_minima, lambda _: unsettled, Poses.of([tilted(0.1, 500.0)]), MIDDLE, "no pose at all")


def test_minima_are_told_apart_by_the_residuals_own_sigma_and_by_what_is_common():
    """Residuals ten times what is stated: what is two by the stated σ is one by what the residuals say. A shift that
    all points share weighs nothing once it is in their covariance: χ² is of what is left of 2n − 6."""
    normal = np.diag([1e6] * 3 + [1.0] * 3)
    poses = Poses.of([Rigid.exp([0, 0, 0, 0, 0, 500.0]), Rigid.exp([0.005, 0, 0, 0, 0, 500.0])])  # 5 σ
    assert distinct(poses, normal)
    assert not distinct(poses, normal, robust_sigma=10.0)
    limit = minima(tilted(0.44, 2000.0), tilted(0.44, 2000.0), factor=10.0)[1]
    assert 5 * OUTLIER < limit < 20 * OUTLIER
    truth = tilted(0.44, 400.0)
    shifted = measured(truth) + 50 * SIGMA
    n = len(DOTS)
    common = np.tile(np.eye(2), (n, 1))
    covariance = SIGMA**2 * (np.eye(2 * n) + 2500 * common @ common.T)
    poses = Poses.of([truth])
    for _ in range(4):
        xy, by_pose, _ = seen(poses, DOTS, 1.0)
        found = weigh(shifted - xy, by_pose, covariance[None], poses)
        step, poses = found.poses.difference(poses)[0], found.poses
    assert step @ found.normal[0] @ step < 1e-12
    assert 5 < found.chi2[0] < 45  # χ² of 18: once in 2000 on either side
    assert found.residual.shape == (1, n, 2)


def test_mirrored_twice_is_where_it_was_and_odds_decide():
    """Even odds put half a squared distance on the covariance; one in 10⁶ needs Δχ² 27.6, of residuals as stated."""
    poses = Poses.of([tilted(0.3, 700.0), tilted(-0.2, 300.0)])
    plane = Rigid.exp([0.1, 0.2, 0.3, 5.0, 6.0, 7.0])
    twice = mirrored(mirrored(poses, plane), plane)
    assert twice.rotation == pytest.approx(poses.rotation, abs=1e-12)
    assert twice.translation == pytest.approx(poses.translation, abs=1e-9)
    away = np.array([0.1, 0, 0, 2.0, 0, 0])
    assert covariance_of_both(np.eye(6), away, 0.0) == pytest.approx(np.eye(6) + np.outer(away, away) / 2)
    assert covariance_of_both(np.eye(6), away, np.inf) == pytest.approx(np.eye(6))
    assert deciding_delta(1e-6, 1.0, 0.5) == pytest.approx(27.63, abs=0.01)
    assert deciding_delta(1e-6, 1.5, 4.0) == pytest.approx(4 * 27.63, abs=0.01)
