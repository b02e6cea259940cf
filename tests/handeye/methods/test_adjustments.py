"""Pose-error least squares and reprojection adjustment: they reach their bound, their covariances are true, camera,
board and robot are told apart, and bad poses and views are named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions, HandEyePoses, Noise, View, Views, pairs_of_views
from stcal.handeye.data.pose_pairs import SETUPS, Loop, LoopState
from stcal.handeye.methods.pose_adjustment import components
from stcal.handeye.methods.reprojection import Corners
from stcal.io.cameras.camera_model import CameraPrior, camera_prior
from tests.outcome import refuses
from tests.support.handeye import CAMERA, error, handeye, normalised, simulated, simulated_views, squared

TRUE = Noise(3e-4, 0.1, 1e-3, 0.3)


def bound(truth, noise):
    loop = Loop.of(truth.pairs, truth.setup)
    slope = loop.jacobian(truth.mount_from_camera)
    spread = components(loop, noise, truth.mount_from_camera).known
    return np.linalg.inv(np.einsum("mai,maj->ij", slope, np.linalg.solve(spread, slope)))[:6, :6]


@pytest.mark.full
@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("stated", [True, False])
def test_pose_error_reaches_the_bound_and_knows_it(setup, stated):
    """40 trials of 6 numbers: a ratio that is 1 scatters by 1/√480 = 5 %. σ from 15 poses is itself known to
    1/√150 = 8 % only, which adds 2 % to errors and 5 % to errors in units of it."""
    options = HandEyeOptions(noise=TRUE if stated else Noise())
    errors, covariances, bounds = [], [], []
    for seed in range(40):
        truth = simulated(np.random.default_rng(seed), 15, setup, (3e-4, 0.1), (1e-3, 0.3))
        found = handeye(truth.pairs, setup, "pose", options=options)
        errors.append(error(found, truth))
        covariances.append(found.covariance)
        bounds.append(bound(simulated(np.random.default_rng(seed), 15, setup), TRUE))
    assert 0.8 < normalised(errors, bounds) < 1.2
    assert 0.8 < normalised(errors, covariances) < 1.25


@pytest.mark.full
@pytest.mark.parametrize("robot", [(3e-4, 0.1), (1e-3, 0.02)])
def test_sigma_are_estimated(robot):
    """Mean of 30 estimates from 30 poses each: 180 − 12 redundancies, 3 each of 4 kinds, so 1/√(2·30·90) = 1.4 % and
    2 % for caution; turns of the robot, told by levers only, are worth fewer redundancies. Shifts are told together."""
    found = []
    for seed in range(30):
        truth = simulated(np.random.default_rng(seed), 30, "eye-in-hand", robot, (1e-3, 0.3))
        found.append(list(handeye(truth.pairs).sigma.values()))
    mean = np.sqrt((np.array(found) ** 2).mean(0))
    assert mean[0] == pytest.approx(robot[0], rel=0.3)
    assert mean[1:] == pytest.approx([1e-3, np.hypot(robot[1], 0.3)], rel=0.1)


def test_the_robot_is_estimated_where_the_camera_is_known():
    truth = simulated(np.random.default_rng(1), 60, "eye-to-hand", (5e-4, 0.2), (1e-3, 0.3))
    found = handeye(truth.pairs, "eye-to-hand", options=HandEyeOptions(noise=Noise(camera_rad=1e-3, camera_mm=0.3)))
    assert found.estimated == ("robot_rad", "robot_mm")
    assert (found.sigma["robot_rad"], found.sigma["robot_mm"]) == pytest.approx((5e-4, 0.2), rel=0.4)
    assert found.sigma["camera_mm"] == 0.3


@pytest.mark.full
@pytest.mark.parametrize(("count", "low", "high"), [(3, 0.7, 1.3), (4, 0.7, 1.15)])
def test_few_poses_state_what_they_can_know(count, low, high):
    """All σ estimated from 6 or 12 redundancies: heavy tails, so 200 draws tell their RMS to some 10 %; caution may
    state too much by a third, as the four are left 12 − 3·2 redundancies."""
    errors, covariances = [], []
    for seed in range(200):
        truth = simulated(np.random.default_rng(seed), count, "eye-in-hand", (5e-4, 0.2), (5e-4, 0.2))
        try:
            found = handeye(truth.pairs)
        except DegenerateError:  # three that hardly turned
            continue
        errors.append(error(found, truth))
        covariances.append(found.covariance)
    assert len(errors) > 190
    assert low < normalised(errors, covariances) < high


@pytest.mark.parametrize("factor", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_covariances_of_the_board_s_poses_hold_up_to_a_factor(factor):
    """40 poses, 240 − 12 redundancies, most of them for the camera: 1/√(2·228) = 5 % of the factor, and what robot and
    camera take from each other."""
    truth = simulated_views(np.random.default_rng(5), 40, "eye-to-hand", (1e-4, 0.03), 0.3)
    stated = replace(truth.pairs, camera_from_board_covariance=truth.pairs.camera_from_board_covariance / factor**2)
    found, right = handeye(stated, "eye-to-hand"), handeye(truth.pairs, "eye-to-hand")
    assert found.sigma["camera_factor"] == pytest.approx(factor, rel=0.15)
    assert any("check the intrinsics" in note for note in found.notes) == (factor > 2)
    assert found.covariance == pytest.approx(right.covariance, rel=1e-3)


@pytest.mark.parametrize("bad", [1, 4])
def test_bad_poses_are_named_and_left_out(bad):
    """Boards seen 8° and 20 mm off: they are found, and the rest gives what it gives without them."""
    truth = simulated(np.random.default_rng(2), 14, camera=(1e-3, 0.3))
    board = list(truth.pairs.camera_from_board)
    for i in range(bad):
        board[3 * i] = Rigid.exp([0.1, -0.08, 0.05, 12, -8, 14]) @ board[3 * i]
    pairs = HandEyePoses(truth.pairs.base_from_flange, Poses.of(board))
    found = handeye(pairs)
    assert np.flatnonzero(found.outliers).tolist() == [3 * i for i in range(bad)]
    assert found.notes[0].startswith("pose 1 contradicts the others, by ")
    without = handeye(truth.pairs[~found.outliers])
    assert found.mount_from_camera.translation == pytest.approx(without.mount_from_camera.translation, abs=1e-3)


def prior(camera, model):
    """Intrinsics of a calibration of some age."""
    return camera_prior(Camera.of(camera, model))


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS)
def test_derivatives_of_the_corners(setup):
    truth = simulated_views(np.random.default_rng(5), 4, setup)
    loop = Loop.of(truth.pairs, setup)
    noise = Noise(1e-3, 0.5, corner_px=0.2, board_mm=0.1)
    corners = Corners.of(loop, truth.views, noise, prior(truth.views.camera, "FULL_OPENCV"), True)
    adjustment = corners.problem()
    values = corners.start(LoopState(truth.mount_from_camera, truth.stand_from_board))
    kinds = {kind for factor in adjustment.factors for kind in factor.kinds}
    camera = {f"camera_{kind}" for kind in ("focal", "centre", "radial", "tangential")}
    assert kinds == {"corner_px", "board_mm", "robot_rad", "robot_mm"} | camera
    for factor in adjustment.factors:
        numerical = replace(factor, derivatives=None)
        for own, wanted in zip(factor.slopes(values, {}), numerical.slopes(values, {}), strict=True):
            assert np.abs(own - wanted).max() <= 1e-5 * max(np.abs(wanted).max(), 1)


@pytest.mark.full
@pytest.mark.parametrize("setup", SETUPS)
def test_reprojection_knows_its_error(setup):
    """20 trials of 6 numbers scatter by 1/√240 = 6.5 %; σ of 12 robot poses by 1/√(2·20·30) = 3 %, and it is
    stated larger by 1/30 for caution."""
    errors, covariances, sigma = [], [], []
    for seed in range(20):
        truth = simulated_views(np.random.default_rng(seed), 12, setup, (3e-4, 0.1), 0.1, 0.03)
        found = handeye(truth.pairs, setup, views=truth.views)
        errors.append(error(found, truth))
        covariances.append(found.covariance)
        sigma.append([found.sigma[name] for name in ("corner_px", "robot_rad", "robot_mm", "board_mm")])
    assert 0.75 < normalised(errors, covariances) < 1.3
    assert np.sqrt((np.array(sigma) ** 2).mean(0)) == pytest.approx([0.1, 3e-4, 0.1, 0.03], rel=0.15)


@pytest.mark.slow
def test_a_camera_file_that_is_wrong_is_said_and_mended_and_a_pose_of_the_robot_left_out():
    """Distortion left out of the camera file: said; with the intrinsics solved for, the truth comes back. A pose by 1°
    and 5 mm, 100 σ: not gross, but told by the other poses."""
    truth = simulated_views(np.random.default_rng(6), 15, "eye-to-hand", (2e-4, 0.05), 0.1)
    good = truth.views.camera
    plain = Camera(good.width, good.height, good.focal, good.centre, np.zeros(8))
    views = Views(plain, truth.views.views)
    pairs = pairs_of_views(truth.pairs.base_from_flange, views)
    doubtful = handeye(pairs, "eye-to-hand", views=views)
    assert doubtful.notes[-1].startswith("the camera file does not fit the corners")
    options = HandEyeOptions(intrinsics=prior(plain, "OPENCV"))
    found = handeye(pairs, "eye-to-hand", views=views, options=options)
    # k1 is eight σ off what a calibration of some age may be, k2 five; the rest is right.
    assert 3 < found.sigma["camera_radial"] < 16
    assert found.sigma["camera_focal"] < 3
    assert "the camera file: its σ were widened (radial distortion " in found.notes[-1]
    off, off_doubtful = (np.linalg.norm(error(f, truth)[3:]) for f in (found, doubtful))
    assert off < 0.7 < 2 * off_doubtful
    assert found.reprojection.camera.distortion[0] == pytest.approx(-0.08, abs=0.02)
    assert found.reprojection.camera_covariance.shape == (8, 8)
    truth = simulated_views(np.random.default_rng(11), 12, robot=(2e-4, 0.05), corner_px=0.1)
    flange = list(truth.pairs.base_from_flange)
    flange[7] = Rigid.exp([0.01, -0.012, 0.008, 3, -2, 3.5]) @ flange[7]
    pairs = pairs_of_views(Poses.of(flange), truth.views)
    found = handeye(pairs, views=truth.views)
    assert np.flatnonzero(found.outliers).tolist() == [7]
    assert "pose 8 contradicts the others" in found.notes[0]
    assert found.sigma["robot_mm"] == pytest.approx(0.05, rel=0.5)


def test_a_view_of_another_board_is_left_out_and_those_that_show_too_little_are_named():
    truth = simulated_views(np.random.default_rng(7), 12, corner_px=0.1)
    view, bent = truth.views.views[4], truth.views.views[2].xy_px.copy()
    bent[10] += [30, -20]  # one bad corner does no harm
    views, _ = with_view(truth, 2, View(view.xyz_board, bent))
    from_the_other_end = View(view.xyz_board, view.xy_px[::-1])
    views, pairs = with_view(replace(truth, views=views), 4, from_the_other_end)
    found = handeye(pairs, views=views)
    assert np.flatnonzero(found.outliers).tolist() == [4]
    assert np.isnan(found.reprojection.rms_px(4))
    assert found.reprojection.rms_px(3) == pytest.approx(0.1 * np.sqrt(2), rel=0.4)
    assert np.abs(error(found, truth)) @ [200, 200, 200, 1, 1, 1] < 2
    truth = simulated_views(np.random.default_rng(9), 5)
    view = truth.views.views[1]
    for count, message in ((3, "E-VIEW-CORNERS … 1.png … 3 … 4"), (5, "E-VIEW-CORNERS … 1.png")):
        refuses(message, with_view, truth, 1, View(view.xyz_board[:count], view.xy_px[:count]))
    refuses("E-POSES-COUNT … 5 … 4", pairs_of_views, truth.pairs.base_from_flange, truth.views[:4])


def with_view(truth, i: int, view: View):
    """The views with another one, and pairs of them."""
    views = Views(truth.views.camera, tuple(view if k == i else own for k, own in enumerate(truth.views.views)))
    names = tuple(f"{k}.png" for k in range(len(views.views)))
    return views, pairs_of_views(truth.pairs.base_from_flange, views, names)


def test_a_camera_file_that_is_right_keeps_its_sigma():
    """Intrinsics drawn with the σ of the file: the factor is 1 or next to it, and the truth is within 4 σ."""
    rng = np.random.default_rng(10)
    truth = simulated_views(rng, 9, "eye-in-hand", (2e-4, 0.05), 0.1)
    held = prior(good := truth.views.camera, "OPENCV")
    drawn = good.parameters() + intrinsic_basis("OPENCV") @ rng.multivariate_normal(np.zeros(8), held.covariance)
    views = Views(good.with_parameters(drawn), truth.views.views)
    pairs = pairs_of_views(truth.pairs.base_from_flange, views)
    found = handeye(pairs, views=views, options=HandEyeOptions(intrinsics=held))
    factors = [value for name, value in found.sigma.items() if name.startswith("camera_")]
    assert len(factors) == 4
    assert 1 <= max(factors) < 2.5
    assert found.notes == ()
    off = intrinsic_basis("OPENCV").T @ (found.reprojection.camera.parameters() - good.parameters())
    assert off @ np.linalg.solve(found.reprojection.camera_covariance, off) < 4 * 8


PRIOR = camera_prior(Camera.of(CAMERA, "OPENCV"))
TRIALS = 12


def by_a_wrong_camera(seed: int, times: float, method: str, options: HandEyeOptions) -> float:
    rng = np.random.default_rng(seed)
    truth = simulated_views(rng, 12, "eye-in-hand", (1e-4, 0.03), 0.1, 0.03)
    error = times * rng.multivariate_normal(np.zeros(len(PRIOR.covariance)), PRIOR.covariance)
    camera = CAMERA.with_parameters(CAMERA.parameters() + intrinsic_basis("OPENCV") @ error)
    views = Views(camera, truth.views.views)
    found = handeye(pairs_of_views(truth.pairs.base_from_flange, views), "eye-in-hand", method, views, options)
    return squared(found, truth)


@pytest.mark.full
@pytest.mark.parametrize("method", ["pose", "reprojection"])
@pytest.mark.parametrize("times", [1.0, 4.0])
def test_sigma_covers_what_the_camera_file_errs(method, times):
    """Of all trials together within what chance makes of six numbers each, a factor of 1.25² left for errors that are
    not linear; it is far beyond without (8 to 15 times σ)."""
    considered = [by_a_wrong_camera(seed, times, method, HandEyeOptions(camera=PRIOR)) for seed in range(TRIALS)]
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * TRIALS)
    assert low / 1.25**2 < sum(considered) < high * 1.25**2
    exact = [by_a_wrong_camera(seed, times, method, HandEyeOptions()) for seed in range(TRIALS)]
    assert sum(exact) > 2 * high


@pytest.mark.parametrize("method", ["pose", "reprojection"])
def test_a_camera_that_is_known_exactly_adds_nothing(method):
    """σ of 1e-9 of the usual: what they add, and what the others' σ change with them, is below 1e-3."""
    exact = HandEyeOptions(camera=CameraPrior("OPENCV", 1e-18 * PRIOR.covariance))
    truth = simulated_views(np.random.default_rng(5), 12, "eye-in-hand", (1e-4, 0.03), 0.1, 0.03)
    stated, silent = (handeye(truth.pairs, "eye-in-hand", method, truth.views, o) for o in (exact, HandEyeOptions()))
    assert np.allclose(stated.mount_from_camera.matrix(), silent.mount_from_camera.matrix(), atol=1e-9)
    assert np.allclose(np.diag(stated.covariance), np.diag(silent.covariance), rtol=1e-3)
