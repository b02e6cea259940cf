"""The answer of :func:`stcal.handeye.handeye`: that of the command, from pairs of poses and from matrices."""

import json

import numpy as np
import pytest

import stcal
from stcal import handeye, workflows
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses
from stcal.handeye.handeye_file import HandEyeFile
from stcal.handeye.plan import HandEyePlanFile
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.files import json_text
from stcal.workflows.handeye_inputs import HandEyeInput
from tests.handeye.test_cli import NOISE
from tests.handeye.written import in_metres, poses_file, sides_of, table
from tests.levels import FULL
from tests.outcome import fails_with, refuses
from tests.support.handeye import FLANGE_FROM_CAMERA, simulated, simulated_views

TRUTH = simulated(np.random.default_rng(7), 8, **NOISE)
PAIRS = TRUTH.pairs


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, pytest.param("pose", marks=FULL)])
def test_the_answer_is_that_of_the_command(command, method, tmp_path):
    """To the last digits of the file: result, method and σ, which poses held out widen here."""
    out = tmp_path / "result.json"
    words = ["--method", method] if method else []
    assert command(poses_file(tmp_path / "poses.csv", TRUTH), "--out", out, *words)[0] == 0
    said, found = json.loads(out.read_text()), handeye.handeye(PAIRS, method=method)
    assert said["method"] == found.method
    np.testing.assert_allclose(said["flange_from_camera"], found.mount_from_camera.matrix(), atol=1e-6)
    np.testing.assert_allclose(said["covariance"], found.covariance, rtol=1e-3)
    assert said["verdict"]["word"] == found.verdict.word
    assert [finding["title"] for finding in said["verdict"]["findings"]] == [f.title for f in found.verdict.findings]


@pytest.mark.slow
def test_results_without_some_poses_widen_sigma_and_matrices_in_metres_are_pairs_of_poses():
    """Of eight poses they scatter by more than the adjustment's own σ; the size may be solved for too."""
    options = handeye.HandEyeOptions(with_scale=True)
    own = handeye.compare(PAIRS, methods=("pose",), options=options, rows=handeye.splits(8, None, 2))[0].result
    refuses("E-HANDEYE-NOT-JUDGED … pose alone", lambda: own.verdict)
    scaled = handeye.handeye(PAIRS, method="pose", options=options)
    assert scaled.covariance[3, 3] > 1.05 * own.covariance[3, 3]
    assert scaled.sigma_scale > 0
    sides = sides_of(PAIRS)
    found = handeye.handeye(**{name: in_metres(poses) for name, poses in sides.items()}, unit="m", method="shah")
    same = handeye.handeye(pairs=PAIRS, setup="eye-in-hand", method="shah")
    np.testing.assert_allclose(found.mount_from_camera.matrix(), same.mount_from_camera.matrix(), atol=1e-9)
    off = found.mount_from_camera.translation - FLANGE_FROM_CAMERA.translation
    assert np.linalg.norm(off) < 1.0  # noise of 0.2 mm an axis
    mixed = handeye.handeye(**sides | {"camera_from_board": PAIRS.camera_from_board.matrix()}, method="shah")
    np.testing.assert_allclose(mixed.mount_from_camera.matrix(), same.mount_from_camera.matrix(), atol=1e-9)


def test_what_is_no_pairs_of_poses_or_no_input_is_refused(poses):
    flange, board = PAIRS.base_from_flange, PAIRS.camera_from_board
    refuses("E-POSES-COUNT … camera_from_board", handeye.handeye, base_from_flange=flange, setup="eye-in-hand")
    refuses("E-OPTION-CONFLICT … no unit", handeye.handeye, PAIRS, unit="m")
    refuses("E-OPTION-CONFLICT … no matrices", handeye.handeye, PAIRS, camera_from_board=board)
    refuses("E-FIELD-TYPE … HandEyePoses", handeye.handeye, flange.matrix(), board.matrix())
    refuses("E-ARGUMENT-UNNAMED … setup=", handeye.handeye, PAIRS, "eye-in-hand")
    with fails_with("E-OPTION-VALUE … unit 'feet'"):
        handeye.handeye(base_from_flange=flange, camera_from_board=board, unit="feet")
    refuses("E-FIELD-TYPE … given … HandEyeInput", workflows.calibrate_handeye, poses)
    refuses("E-OPTION-VALUE … setup", workflows.read_handeye, poses, setup="in hand")


@pytest.fixture
def poses(tmp_path):
    return poses_file(tmp_path / "poses.csv", TRUTH)


@pytest.fixture
def written(command, tmp_path):
    def call(*words) -> dict:
        out = tmp_path / f"{words[0]}.json"  # of each command its own
        assert command(*words, "--json", out)[0] == 0
        return json.loads(out.read_text(encoding="utf-8"))

    return call


def test_two_files_of_poses_plans_and_flips_are_those_of_the_command(written, poses, tmp_path):
    read, names = stcal.load_table(poses), [f"p{i}" for i in range(8)]
    board = read.poses("camera_from_board_")
    robot = table(tmp_path / "robot.csv", {"": read.poses("base_from_flange_")}, image=names)
    camera = table(tmp_path / "camera.csv", {"": Poses.of([*board, board[0]])}, image=[*names, "p99"])
    answer = written("--a", robot, "--b", camera, "--splits", 0, "--method", "pose", "--setup", "eye-in-hand")
    given = workflows.read_handeye(robot, second=camera, setup="eye-in-hand")
    found = workflows.calibrate_handeye(given, "pose", repeats=0)
    assert json.loads(json_text(HandEyeFile.of(found, whole=True))) == answer
    assert given.notes == (f"1 rows of {camera} have no partner: image p99",)
    answer = written("plan", poses, "--count", 1)
    found = workflows.plan_handeye(workflows.read_handeye(poses), 1)
    assert json.loads(json_text(HandEyePlanFile.of(found.result, found.poses, found.joints))) == answer
    given, said = workflows.without_flips(found := workflows.read_handeye(poses))
    assert given.pairs.camera_from_board == found.pairs.camera_from_board
    assert said.endswith("0 of 8 poses: none")


@pytest.mark.parametrize("refine", [True, False])
def test_intrinsics_are_adjusted_where_that_is_asked(refine):
    truth = simulated_views(np.random.default_rng(3), 8, robot=(2e-4, 0.05), corner_px=0.1)
    prior = camera_prior(Camera.of(truth.views.camera, "OPENCV"))
    given = HandEyeInput("", truth.pairs, truth.views, prior=prior)
    found = workflows.calibrate_handeye(given, "reprojection", refine_camera=refine, repeats=0)
    assert (found.result.reprojection.camera_covariance is not None) == refine
