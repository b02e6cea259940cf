"""Rigs: X of all cameras and their poses in each other with true σ, better than alone; what is wrong is named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import Noise, RigCamera, RigOptions, RigPoses, View, Views, handeye_rig
from stcal.handeye.data.pairs import Loop
from stcal.handeye.methods.bundle import RigBundle, RigCorners
from stcal.handeye.methods.reprojection import board_of, problem
from stcal.handeye.rig import ERRORS, CameraHeldOut, alone, of_places
from stcal.io.cameras.model import camera_prior
from tests.handeye.derivatives import assert_derivatives
from tests.outcome import fails_with
from tests.support.handeye_rig import NAMES, RigTruth, simulated_rig

ROBOT, PX, BOARD = (3e-4, 0.1), (0.1, 0.2, 0.1), 0.03
STATED = RigOptions(noise=Noise(*ROBOT, board_mm=BOARD))
SETUPS = ("eye-in-hand", "eye-to-hand")
NOT_FIT = "the camera file does not fit the corners"


def apart(found: Rigid, true: Rigid) -> np.ndarray:
    return Poses.of([found]).difference(Poses.of([true]))[0]


def squared(found: Rigid, true: Rigid, covariance: np.ndarray) -> float:
    """In units of σ, over the six numbers."""
    off = apart(found, true)
    return float(off @ np.linalg.solve(covariance, off)) / 6


def errors(truth: RigTruth, options: RigOptions | None = None) -> tuple[list[float], list[float], list[float]]:
    """Normalised squared errors: of each X, of each pose between two cameras, of all X and Z at once."""
    rig = handeye_rig(truth.given, truth.setup, options)
    own = [
        squared(c.mount_from_camera, x, c.covariance) for c, x in zip(rig.cameras, truth.mount_from_camera, strict=True)
    ]
    between = []
    for i, first in enumerate(rig.names):
        for j, second in enumerate(rig.names[:i]):
            pose, covariance = rig.relative(first, second)
            between.append(squared(pose, truth.mount_from_camera[i].inverse() @ truth.mount_from_camera[j], covariance))
    off = [apart(c.mount_from_camera, x) for c, x in zip(rig.cameras, truth.mount_from_camera, strict=True)]
    every = np.concatenate([*off, apart(rig.stand_from_board, truth.stand_from_board)])
    return own, between, [float(every @ np.linalg.solve(rig.covariance, every)) / len(every)]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, pytest.param(40, marks=pytest.mark.full)])
@pytest.mark.parametrize("setup", SETUPS)
def test_a_rig_knows_its_error(setup, count):
    """χ² of trials with σ estimated, each camera at four fifths of the poses: once in 10⁴ beyond. All cameras of a
    trial share the robot, so that it counts as one set of six numbers; σ from some 12 poses have tails of their own."""
    found = [
        errors(simulated_rig(np.random.default_rng([seed, 1]), 12, setup, 3, ROBOT, PX, BOARD, 0.8))
        for seed in range(count)
    ]
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * count) / (6 * count)
    for kind in zip(*found, strict=True):
        assert 0.9 * low < np.mean(kind) < 1.15 * high


@pytest.mark.slow
def test_derivatives_of_a_rig():
    """By all shared unknowns, every ninth of the board's and the robot's."""
    truth = simulated_rig(np.random.default_rng(5), 4, "eye-to-hand", 2, (0.0, 0.0))
    given, noise = truth.given, Noise(1e-3, 0.5, corner_px=0.2, board_mm=0.1)
    board = board_of([camera.views for camera in given.cameras])
    each = []
    for i, camera in enumerate(given.cameras):
        prior = camera_prior(Camera.of(camera.views.camera, "OPENCV"))
        loop = Loop.of(given.pairs(i), truth.setup)
        flange, own = given.base_from_flange, {"rows": camera.rows, "designed": board}
        each.append(problem(loop, flange, camera.views, noise, prior, True, **own)[0])
    corners = RigCorners(NAMES[:2], tuple(each))
    cameras = tuple(camera.views.camera for camera in given.cameras)
    state = RigBundle(truth.mount_from_camera, truth.stand_from_board, given.base_from_flange, board, cameras)
    names = tuple(corners.parts(state))
    assert (names[0], names[5], *names[-2:]) == ("corner_px:left", "corner_px:right", "robot_rad", "robot_mm")
    shared = corners.places()["robot"].start
    assert shared == 2 * 6 + 6 + 2 * 8 + 1
    assert_derivatives(corners, state, (*range(shared), *range(shared, corners.count(), 9)))


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS)
def test_one_camera_is_the_special_case(setup):
    """The same adjustment as `stcal handeye` makes by method reprojection."""
    truth = simulated_rig(np.random.default_rng(3), 10, setup, 1, ROBOT, PX, BOARD)
    rig, single = handeye_rig(truth.given, setup), alone(truth.given, 0, setup, RigOptions())
    own = rig.camera("left")
    assert np.abs(own.mount_from_camera.matrix() - single.mount_from_camera.matrix()).max() < 1e-9
    assert np.abs(own.covariance / single.covariance - 1).max() < 1e-6
    assert own.sigma == pytest.approx(single.sigma, rel=1e-6)
    assert own.residuals == pytest.approx(single.residuals, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS)
def test_together_cameras_are_known_better_than_alone(setup):
    """With the robot's σ as they are; of two cameras a third of the variance is common, but no more than all of it."""
    truth = simulated_rig(np.random.default_rng(4), 12, setup, 3, ROBOT, PX, BOARD, 0.75)
    rig = handeye_rig(truth.given, setup, STATED)
    for i, camera in enumerate(rig.cameras):
        ratio = np.sqrt(np.diag(camera.covariance) / np.diag(alone(truth.given, i, setup, STATED).covariance))
        assert 0.2 < ratio.min() < ratio.max() < 1
    _, covariance = rig.relative("left", "right")
    apart_mm = np.sqrt(np.diag(rig.camera("left").covariance)[3:] + np.diag(rig.camera("right").covariance)[3:])
    assert np.linalg.norm(np.sqrt(np.diag(covariance)[3:])) < 0.8 * np.linalg.norm(apart_mm)


@pytest.mark.slow
def test_σ_of_the_robot_is_one_for_all():
    truth = simulated_rig(np.random.default_rng(6), 20, "eye-in-hand", 2, ROBOT, PX, BOARD)
    rig = handeye_rig(truth.given, "eye-in-hand")
    first, second = (camera.sigma for camera in rig.cameras)
    assert [first[name] for name in ("robot_rad", "robot_mm", "board_mm")] == pytest.approx([*ROBOT, BOARD], rel=0.35)
    assert {name: first[name] for name in first if name != "corner_px"} == {
        name: second[name] for name in second if name != "corner_px"
    }
    assert [first["corner_px"], second["corner_px"]] == pytest.approx(PX[:2], rel=0.06)


def test_a_camera_with_two_images_is_found_by_the_others():
    truth = simulated_rig(np.random.default_rng(7), 10, "eye-in-hand", 2, ROBOT, PX, BOARD)
    few = truth.given.cameras[1][[2, 6]]
    rig = handeye_rig(replace(truth.given, cameras=(truth.given.cameras[0], few)), "eye-in-hand")
    found = rig.camera("right")
    assert squared(found.mount_from_camera, truth.mount_from_camera[1], found.covariance) < 4
    assert np.sqrt(np.diag(found.covariance)[3:]).max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.003, 1.01, 1.1])
@pytest.mark.parametrize("i", [0, 1])
def test_intrinsics_that_are_wrong_are_named(factor, i):
    truth = simulated_rig(np.random.default_rng(3), 12, "eye-in-hand", 2, ROBOT, PX, BOARD)
    lens = truth.given.cameras[i].views.camera
    wrong = Views(
        lens.with_parameters(lens.parameters() * np.r_[factor, factor, np.ones(14)]), truth.given.cameras[i].views.views
    )
    notes = handeye_rig(with_views(truth.given, i, wrong), "eye-in-hand").all_notes()
    assert [note.partition(":")[0] for note in notes if NOT_FIT in note] == [NAMES[i]]


@pytest.mark.slow
def test_intrinsics_that_are_wrong_are_mended():
    """Off by 3 σ of what is stated of them; then solved for."""
    truth = simulated_rig(np.random.default_rng(8), 15, "eye-to-hand", 2, ROBOT, (0.1, 0.1, 0.1), BOARD)
    given = truth.given
    for i, camera in enumerate(given.cameras):
        lens = camera.views.camera
        prior = camera_prior(Camera.of(lens, "OPENCV"))
        off = 3 * np.sqrt(np.diag(prior.covariance)) * np.random.default_rng(i).choice([-1, 1], 8)
        moved = lens.with_parameters(lens.parameters() + intrinsic_basis("OPENCV") @ off)
        given = with_views(given, i, Views(moved, camera.views.views))
        cameras = list(given.cameras)
        cameras[i] = replace(cameras[i], prior=prior)
        given = replace(given, cameras=tuple(cameras))
    rig = handeye_rig(given, "eye-to-hand", RigOptions(refine=True))
    for camera, x in zip(rig.cameras, truth.mount_from_camera, strict=True):
        assert camera.reprojection.camera_covariance.shape == (8, 8)
        assert squared(camera.mount_from_camera, x, camera.covariance) < 4


def seen_elsewhere(truth: RigTruth, i: int, off: Rigid) -> RigPoses:
    """One camera sees another board, which stands elsewhere."""
    camera, x, flange = truth.given.cameras[i], truth.mount_from_camera[i], truth.given.base_from_flange
    mount_from_stand = flange if truth.setup == "eye-to-hand" else flange.inverse()
    rng, views = np.random.default_rng(0), []
    for view, row in zip(camera.views.views, camera.rows, strict=True):
        pose = x.inverse() @ mount_from_stand[int(row)] @ off @ truth.stand_from_board
        px = camera.views.camera.project(pose @ view.xyz_board) + rng.normal(0, 0.1, (len(view), 2))
        views.append(View(view.xyz_board, px))
    return with_views(truth.given, i, Views(camera.views.camera, tuple(views)))


def with_views(given: RigPoses, i: int, views: Views) -> RigPoses:
    cameras = list(given.cameras)
    cameras[i] = replace(cameras[i], views=views)
    return replace(given, cameras=tuple(cameras))


@pytest.mark.parametrize(("cameras", "said"), [(3, "E-RIG-CONTRADICTS"), (2, "E-RIG-CONTRADICTS")])
@pytest.mark.parametrize("setup", SETUPS)
def test_another_board_is_named(setup, cameras, said):
    truth = simulated_rig(np.random.default_rng(3), 12, setup, cameras, ROBOT, PX, BOARD)
    given = seen_elsewhere(truth, 1, Rigid.exp([0, 0, 0.1, 150, 20, 0]))
    with fails_with(said):
        handeye_rig(given, setup)


@pytest.mark.slow
def test_a_board_that_was_moved_a_little_is_named():
    truth = simulated_rig(np.random.default_rng(3), 12, "eye-in-hand", 3, ROBOT, PX, BOARD)
    given = seen_elsewhere(truth, 1, Rigid.exp([0, 0, 0.003, 3, 1, 0]))
    single = [alone(given, i, "eye-in-hand", RigOptions()) for i in range(3)]
    (note,) = of_places(NAMES, single)
    assert note.startswith("right finds the board 4.4 mm and 0.18° from where left, up do")
    assert of_places(NAMES, [single[0], None, single[2]]) == ()


@pytest.mark.slow
def test_an_image_of_another_moment_is_left_out():
    """One of 12 images of the second camera, taken 2 mm later."""
    truth = simulated_rig(np.random.default_rng(9), 12, "eye-in-hand", 2, ROBOT, PX, BOARD)
    late = seen_elsewhere(truth, 1, Rigid.exp([0, 0.003, 0, 2, 0, 0])).cameras[1].views.views
    views = list(truth.given.cameras[1].views.views)
    views[5] = late[5]
    given = with_views(truth.given, 1, Views(truth.given.cameras[1].views.camera, tuple(views)))
    rig = handeye_rig(given, "eye-in-hand")
    assert np.flatnonzero(rig.camera("right").outliers).tolist() == [5]
    assert not rig.camera("left").outliers.any()
    assert any("right/5.png contradicts the others" in note for note in rig.all_notes())


@pytest.mark.slow
def test_a_pose_of_the_robot_that_is_wrong_is_left_out_for_all():
    truth = simulated_rig(np.random.default_rng(11), 12, "eye-to-hand", 2, (2e-4, 0.05), PX)
    flange = list(truth.given.base_from_flange)
    flange[7] = Rigid.exp([0.01, -0.012, 0.008, 3, -2, 3.5]) @ flange[7]
    rig = handeye_rig(replace(truth.given, base_from_flange=Poses.of(flange)), "eye-to-hand")
    assert np.flatnonzero(rig.outliers).tolist() == [7]
    assert [np.flatnonzero(camera.outliers).tolist() for camera in rig.cameras] == [[7], [7]]
    assert rig.notes[0].startswith("pose 8: contradicts")


def test_what_is_not_a_rig_is_refused():
    truth = simulated_rig(np.random.default_rng(1), 4, "eye-in-hand", 1)
    (camera,) = truth.given.cameras
    with fails_with("E-RIG-CAMERAS"):
        RigPoses(truth.given.base_from_flange, (camera, camera))
    with fails_with("E-RIG-INSTANT"):
        RigCamera("left", camera.views, np.zeros(4, int), camera.images)
    with fails_with("E-RIG-ROW … 3"):
        RigPoses(truth.given.base_from_flange[:3], (camera,))
    with fails_with("E-RIG-NO-CAMERA … 'right'"):
        handeye_rig(truth.given, "eye-in-hand").camera("right")
    with fails_with("E-HANDEYE-FEW-POSES … camera left: 2 … 3"):
        handeye_rig(replace(truth.given, cameras=(camera[[0, 1]],)), "eye-in-hand")


def test_a_cameras_gain_is_over_the_views_that_it_can_place_alone():
    joint, by_itself = np.array([1.0, 2, 9]), np.array([2.0, 4, np.nan])
    errors_of = dict.fromkeys(ERRORS, joint), dict.fromkeys(ERRORS, by_itself)
    held_out = CameraHeldOut(np.zeros(3, int), np.arange(3), *errors_of)
    assert held_out.gain() == pytest.approx(0.5)
    none = {name: np.full(3, np.nan) for name in ERRORS}
    held_out = CameraHeldOut(np.zeros(3, int), np.arange(3), errors_of[0], none)
    assert held_out.gain() is None
    assert held_out.means()["board_mm"] == pytest.approx(4.0)


def moved(pose: Rigid, step: np.ndarray) -> Rigid:
    return Rigid(Rigid.exp(step * [1, 1, 1, 0, 0, 0]).rotation @ pose.rotation, pose.translation + step[3:])


def test_the_pose_between_two_cameras_has_the_σ_of_both():
    """By central differences over both poses, perturbed from the left in the mount's frame."""
    rng = np.random.default_rng(2)
    x, y = (Rigid.exp([*rng.normal(0, 1, 3), *rng.normal(0, 300, 3)]) for _ in range(2))
    truth = simulated_rig(rng, 12, "eye-in-hand", 2, ROBOT, PX, BOARD, 0.8)
    rig = handeye_rig(truth.given, truth.setup)
    placed = tuple(replace(camera, mount_from_camera=pose) for camera, pose in zip(rig.cameras, (x, y), strict=True))
    rig = replace(rig, cameras=placed)
    jacobian = np.zeros((6, len(rig.covariance)))
    for i, step in enumerate(1e-6 * np.eye(12)):  # rotation and translation apart
        ends = [moved(x, sign * step[:6]).inverse() @ moved(y, sign * step[6:]) for sign in (1, -1)]
        jacobian[:, i] = apart(*ends) / 2e-6
    pose, covariance = rig.relative(*rig.names)
    assert np.abs(apart(pose, x.inverse() @ y)).max() < 1e-9
    expected = jacobian @ rig.covariance @ jacobian.T
    np.testing.assert_allclose(covariance, expected, atol=1e-6 * np.abs(expected).max())
