"""Arrays in, arrays out: cameras, poses, robots, hand-eyes and images that a program has in memory."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stcal
from stcal import handeye, robot, sfm
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid, Similarity
from stcal.io.images import decode, grey_of
from stcal.robot.kinematics.robot_model import mh80
from stcal.sfm.detect.detect_files import files_of_arrays
from stcal.sfm.pipeline import own_checks
from tests.outcome import refuses

MATRIX = np.array([[900.0, 0, 640.3], [0, 905.0, 355.8], [0, 0, 1]])
SIZE = (1280, 720)
EIGHT = [-0.2, 0.08, 1e-3, -5e-4, 0.01, 0.02, -0.01, 0.005]
POINTS = np.random.default_rng(1).uniform([-200, -100, 500], [200, 100, 900], (30, 3))
ROUNDING_PX = 1e-9  # of a dozen products of numbers below 1e3 in double precision


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_a_camera_of_opencv_projects_as_opencv(count):
    camera = Camera.from_opencv(MATRIX, EIGHT[:count], SIZE)
    wanted, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, np.array(EIGHT[:count]))
    assert np.abs(camera.project(POINTS) - wanted[:, 0]).max() < ROUNDING_PX
    assert np.isnan(camera.project(-POINTS)).all()  # behind it
    matrix, distortion = camera.to_opencv()
    assert ((matrix == MATRIX).all(), len(distortion)) == (True, max(4, count))
    assert Camera.from_opencv(matrix, distortion, SIZE).same_as(camera)


def test_a_fisheye_of_opencv_projects_as_opencv():
    four = np.array([0.02, -0.01, 0.003, -0.001])
    camera = Camera.from_opencv(MATRIX, four, SIZE, fisheye=True)
    wanted, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), MATRIX, four)
    assert np.abs(camera.project(POINTS) - wanted[:, 0]).max() < ROUNDING_PX
    assert camera.colmap_model == "OPENCV_FISHEYE"
    assert np.array_equal(camera.to_opencv()[1], four)


SKEWED = MATRIX + np.diag([2.0, 0], 1)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: Camera.from_opencv(SKEWED, [], SIZE), "E-CAMERA-MATRIX … 2.0 … skew"),
        (lambda: Camera.from_opencv(MATRIX[:2], [], SIZE), "E-ARRAY-SHAPE … (2, 3)"),
        (lambda: Camera.from_opencv(MATRIX, EIGHT[:6], SIZE), "E-CAMERA-COEFFICIENTS … 6 … 4, 5, 8"),
        (lambda: Camera.from_opencv(MATRIX, EIGHT[:5], SIZE, fisheye=True), "E-CAMERA-COEFFICIENTS … 5 … k1 to k4"),
        (lambda: Camera.from_opencv(MATRIX, [], (0, 720)), "E-CAMERA-SIZE … 0×720"),
        (lambda: Camera(*SIZE, [9, 9], [5, 5], np.zeros(8), colmap_model="OPENCV_FISHEYE"), "E-CAMERA-MODEL … OPENCV"),
        (lambda: Camera(*SIZE, [9, 9], [5, 5], np.zeros(8), covariance=np.eye(3)), "E-ARRAY-SHAPE … (12, 12)"),
        (
            lambda: Camera(*SIZE, [900, 900], [640, 360], [0, 0, 1e-3, 0, 0, 0, 0, 0], True).to_opencv(),
            "E-CAMERA-MODEL … fish",
        ),
        (lambda: Rigid.exp([1, 2]), "E-ARRAY-SHAPE … (2,)"),
        (lambda: Poses.from_quaternions([[1, 0, 0]], [[0, 0, 0]]), "E-ARRAY-SHAPE … quaternions"),
        (lambda: Poses.from_matrices([np.eye(4), -np.eye(4)]), "E-MATRIX-LAST-ROW … pose 2"),
        (lambda: robot.Robot.from_dh(np.zeros((6, 3)), "standard"), "E-ARRAY-SHAPE … (6, 3) … a, alpha, d, theta"),
        (lambda: robot.Robot.from_dh(np.full((2, 4), 300), "standard", np.zeros((3, 2))), "E-ARRAY-SHAPE … (3, 2)"),
        (lambda: robot.Measurements.from_arrays(np.zeros((4, 6))), "E-MEASURED-KIND … positions"),
        (lambda: robot.Measurements.from_arrays(np.zeros((4, 6)), np.zeros((3, 3))), "E-ARRAY-SHAPE … positions"),
        (lambda: robot.Targets("t", (1,), ("",), Poses.of([Rigid()]), np.zeros((2, 6))), "E-ARRAY-SHAPE … (2, 6)"),
        (lambda: handeye.HandEyePoses.from_matrices([], [], unit="km"), "E-OPTION-VALUE … 'km' … mm"),  # type: ignore
        (lambda: files_of_arrays({}), "E-IMAGES-NONE … memory"),
        (lambda: files_of_arrays({"a/b": [np.zeros((4, 4), np.uint8)]}), "E-IMAGES-GROUP … 'a/b'"),
        (lambda: files_of_arrays({"..": [np.zeros((4, 4), np.uint8)]}), "E-IMAGES-GROUP … '..'"),
        (lambda: files_of_arrays({"a": [np.zeros((4, 4))]}), "E-IMAGE-TYPE … a/0.png … float64"),
        (lambda: sfm.Tracker("target", Camera.from_opencv(MATRIX, [], SIZE)), "E-FACES-DESIGN … str … circles()"),
    ],
)
def test_what_is_wrong_is_refused_in_one_line(make, error):
    refuses(error, make)


def test_a_camera_keeps_its_covariance_and_its_model_in_files(tmp_path):
    camera = replace(Camera.from_opencv(MATRIX, EIGHT[:4], SIZE), covariance=np.diag(np.arange(1.0, 9.0)))
    assert stcal.save_camera(tmp_path / "cameras.txt", camera) == ()
    again = stcal.load_camera(tmp_path / "cameras.txt")
    assert again.same_as(camera)
    assert again.colmap_model == "OPENCV"
    assert np.allclose(again.covariance, camera.covariance, rtol=1e-12)
    assert stcal.save_camera(tmp_path / "camera.yaml", camera) == ("σ and correlations of the parameters",)
    refuses("E-OPTION-FORM … camera.json … .json", stcal.save_camera, tmp_path / "camera.json", camera)


def test_a_size_that_no_file_states_is_given(tmp_path):
    (tmp_path / "m.yaml").write_text(f"camera_matrix: {MATRIX.tolist()}\ndist_coeffs: {EIGHT[:4]}\n", encoding="utf-8")
    refuses("E-CAMERA-SIZE … m.yaml", stcal.load_camera, tmp_path / "m.yaml")
    assert stcal.load_camera(tmp_path / "m.yaml", size=SIZE).same_as(Camera.from_opencv(MATRIX, EIGHT[:4], SIZE))


def test_transforms_are_taken_and_given():
    turn = Rotation.from_euler("xyz", [0.3, -0.2, 0.9])
    one = Rigid(turn, [1, 2, 3])
    assert (one.as_scipy().inv() * turn).magnitude() < 1e-15
    assert Poses.from_matrices(np.array([one.matrix()] * 2))[1] == Rigid.from_matrix(one.matrix())
    a_from_b = Similarity(2.5, Rigid.exp([0.1, 0.2, 0.3, 4, 5, 6]))
    moved = a_from_b.matrix() @ np.column_stack([POINTS, np.ones(len(POINTS))]).T
    assert np.allclose(moved[:3].T, a_from_b @ POINTS, rtol=1e-14)


def test_poses_in_metres_are_those_in_millimetres():
    poses = Poses.of(Rigid.exp([0.1 * k, 0.2, -0.1 * k, 100.0 * k, 50, 20 * k]) for k in range(4))
    metres = poses.matrix() * np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])
    pairs = handeye.HandEyePoses.from_matrices(metres, Poses(poses.rotation, 1e-3 * poses.translation), unit="m")
    for side in (pairs.base_from_flange, pairs.camera_from_board):
        assert np.allclose(side.matrix(), poses.matrix(), rtol=1e-14)


def test_a_table_and_arrays_make_the_robot_and_its_data():
    arm = mh80()
    table = [[row.a, row.alpha, row.d, row.theta] for row in arm.rows]
    made = robot.Robot.from_dh(table, "standard", arm.limits(), name="MH80")
    assert (made.rows, made.joints) == (arm.rows, arm.joints)
    q = np.random.default_rng(2).uniform(-0.5, 0.5, (5, 6))
    reached = robot.forward(arm, q)
    data = robot.Measurements.from_arrays(q, poses=reached)
    assert data.poses() == reached
    assert (data.targets, list(data.lines)) == (("",) * 5, [1, 2, 3, 4, 5])
    by_poses = robot.compensate(arm, reached, arm)
    assert by_poses.found.usable.all()
    assert np.abs(robot.forward(arm, by_poses.found.q).translation - reached.translation).max() < 1e-3  # µm


def test_images_in_memory_are_read_to_the_last_bit():
    rng = np.random.default_rng(3)
    grey, deep = rng.integers(0, 256, (40, 60), np.uint8), rng.integers(0, 65536, (40, 60), np.uint16)
    files, skipped = files_of_arrays({"12": [grey, deep], "13": [np.dstack([grey] * 3)]}, exclude=["12/1.png"])
    assert [file.name for file in files] == ["12/0.png", "13/0.png"]
    assert [each.name for each in skipped] == ["12/1.png"]
    for file in files:
        assert np.array_equal(decode(file.read(), file.name), grey)
    (both, _) = files_of_arrays({"12": [grey, deep]})
    assert np.array_equal(decode(both[1].read(), "12/1.png"), deep)


def check(key: str) -> sfm.Check:
    return sfm.judge(key, "Mine", [sfm.Trial("it", 5.0, "mm", statistic=25.0, freedom=1)], "things", "mend it")


class Result:
    """What a check of one's own is given, as far as names are concerned."""

    checks = (check("camera"),)


def test_checks_of_ones_own_have_their_own_names():
    assert [each.verdict for each in own_checks(Result(), [lambda _: check("mine")])] == ["failed"]  # 5 σ


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda _: check("camera"), "it has the key 'camera' of another"),
        (lambda _: True, "it returned bool, a Check needed"),
        (lambda _: [][1], "it raised IndexError: list index out of range"),
    ],
)
def test_a_check_that_cannot_be_made_loses_no_result(make, fault):
    first, second = own_checks(Result(), [make, make])
    assert (first.verdict, second.verdict) == ("suspicious", "suspicious")
    assert first.reason.startswith(fault)
    assert first.key != second.key


def test_the_repr_of_a_large_result_is_a_line():
    """A notebook prints it."""
    pair = np.random.default_rng(0).uniform(-100, 100, (60, 3))
    result = stcal.register.register(pair, pair + np.array([1.0, 2.0, 3.0]))
    assert repr(result).startswith("Registration(")
    assert len(repr(result)) < 1000
    assert "\n" not in repr(result)


def test_masked_values_are_refused_where_arrays_are_taken():
    pair = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    other = np.ma.array(pair + 1.0, mask=np.zeros_like(pair, bool))
    stcal.register.register(pair, other)  # nothing is masked
    other.mask[4] = True
    for call in (lambda: stcal.register.register(pair, other), lambda: frozen(other)):
        refuses("E-ARRAY-NOT-FINITE … 3 values are masked; leave out their rows", call)


def test_a_repr_tells_the_notes():
    pair = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    off = pair + np.eye(20, 3) * 9.0
    result = stcal.register.register(pair, off, method="least-squares")
    assert result.notes
    assert result.notes[0] in repr(result)


@pytest.mark.parametrize("scale", [1, 257])
def test_colours_of_equal_brightness_are_seen_in_the_channel_that_tells_them(scale):
    """Red 200 and green 102 have the same grey value."""
    image = np.zeros((40, 60, 3), np.uint8 if scale == 1 else np.uint16)
    image[..., 1] = 102 * scale
    image[10:30, 20:40] = (200 * scale, 0, 0)
    png = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
    for grey in (grey_of(image, "a"), decode(png, "a.png")):
        assert grey[0, 0] == 0
        assert grey[20, 30] == 200 * scale
    image[:5] = 255 * scale  # something else is seen in grey: it stays
    assert grey_of(image, "a")[20, 30] == pytest.approx(60 * scale, rel=0.02)
