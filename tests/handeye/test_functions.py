"""The functions of `stcal.workflows` for hand-eye calibration give what their commands write."""

import json

import numpy as np
import pytest

import stcal
from stcal import workflows
from stcal.geometry.camera import Camera
from stcal.handeye.handeye_file import HandEyeFile
from stcal.handeye.plan import HandEyePlanFile
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.files import json_text
from stcal.io.table import POSE, pose_cells
from stcal.workflows.handeye_inputs import HandEyeInput
from tests.handeye.test_plan_cli import NOISE, poses_file
from tests.outcome import refuses
from tests.support.handeye import simulated, simulated_views


@pytest.fixture
def poses(tmp_path):
    return poses_file(tmp_path / "poses.csv", simulated(np.random.default_rng(8), 8, **NOISE))


@pytest.fixture
def written(command, tmp_path):
    def call(*words) -> dict:
        assert command(*words, "--json", tmp_path / "a.json")[0] == 0
        return json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))

    return call


def test_what_is_no_input_is_refused(poses):
    refuses("E-FIELD-TYPE … given … HandEyeInput", workflows.calibrate_handeye, poses)
    refuses("E-OPTION-VALUE … setup", workflows.read_handeye, poses, setup="in hand")


def test_two_files_of_poses(written, poses, tmp_path):
    table = stcal.load_table(poses)
    paths = []
    for name, prefix in (("robot", "base_from_flange_"), ("camera", "camera_from_board_")):
        rows = [f"p{i}," + ",".join(pose_cells(pose)) for i, pose in enumerate(table.poses(prefix))]
        rows += [] if name == "robot" else ["p99," + rows[0].partition(",")[2]]
        paths.append(tmp_path / f"{name}.csv")
        paths[-1].write_text("\n".join([",".join(["image", *POSE]), *rows]), encoding="utf-8")
    answer = written("--a", paths[0], "--b", paths[1], "--splits", 0, "--method", "pose", "--setup", "eye-in-hand")
    given = workflows.read_handeye(paths[0], second=paths[1], setup="eye-in-hand")
    found = workflows.calibrate_handeye(given, "pose", repeats=0)
    assert json.loads(json_text(HandEyeFile.of(found, whole=True))) == answer
    assert given.notes == (f"1 rows of {paths[1]} have no partner: image p99",)


def test_plan_handeye(written, poses):
    answer = written("plan", poses, "--count", 1)
    found = workflows.plan_handeye(workflows.read_handeye(poses), 1)
    assert json.loads(json_text(HandEyePlanFile.of(found.result, found.poses, found.joints))) == answer


def test_without_flips(poses):
    given, said = workflows.without_flips(workflows.read_handeye(poses))
    assert given.pairs.camera_from_board == workflows.read_handeye(poses).pairs.camera_from_board
    assert said.endswith("0 of 8 poses: none")


@pytest.mark.parametrize("refine", [True, False])
def test_intrinsics_are_adjusted_where_that_is_asked(refine):
    truth = simulated_views(np.random.default_rng(3), 8, robot=(2e-4, 0.05), corner_px=0.1)
    prior = camera_prior(Camera.of(truth.views.camera, "OPENCV"))
    given = HandEyeInput("", truth.pairs, truth.views, prior=prior)
    found = workflows.calibrate_handeye(given, "reprojection", refine_camera=refine, repeats=0)
    assert (found.result.reprojection.camera_covariance is not None) == refine
