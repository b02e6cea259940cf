"""``stcal handeye`` of files of other programs, as a user types it."""

import numpy as np
import pytest

from tests.handeye.test_cli import NOISE, poses_file
from tests.handeye.written import FORMATS, easy_handeye, matrices
from tests.outcome import INPUT, assert_error
from tests.support.handeye import simulated

QUICK = ("--method", "pose", "--splits", 0)


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(5), 12, **NOISE)


def test_a_dry_run_says_what_it_understood_and_writes_nothing(command, tmp_path, truth):
    arguments = FORMATS["KUKA"](tmp_path, truth.pairs)
    code, shown, _ = command(*arguments, "--dry-run", "--out", tmp_path / "h.json", "--setup", "eye-in-hand")
    assert code == 0
    lines = shown.splitlines()
    assert lines[0].startswith(
        "robot: robot.csv: table; 12 poses; base_from_flange by default; a, b, c as Euler angles ZYX"
    )
    assert "degrees; mm by the columns" in lines[0]
    assert lines[1].startswith(
        "camera: camera.npy: NumPy array; 12 poses; camera_from_board by default; 4×4 matrices; mm by"
    )
    assert lines[2:5] == [
        "rows joined by their order, for neither file has names or times",
        "setup: eye-in-hand, as you say",
        "pairs: 12",
    ]
    assert not any(line.startswith("motions") for line in lines)
    assert not (tmp_path / "h.json").exists()
    code, shown, _ = command(poses_file(tmp_path / "poses.csv", truth), "--dry-run")
    assert code == 0
    assert (
        "poses.csv: table; 12 poses; base_from_flange by the columns base_from_flange_…; quaternions by name; mm"
        in shown
    )


def test_a_dry_run_says_what_motion_is_missing(command, tmp_path, truth):
    still = matrices(truth.pairs.base_from_flange)
    still[:, :3, :3] = still[0, :3, :3]
    np.savez(tmp_path / "p.npz", base_from_flange=still, camera_from_board=matrices(truth.pairs.camera_from_board))
    code, shown, _ = command(tmp_path / "p.npz", "--dry-run")
    assert code == 0
    assert "motions: the flange turns by 0° (RMS) between poses; rotate the flange" in shown


def test_the_setup_that_a_file_states_is_taken(command, tmp_path):
    truth = simulated(np.random.default_rng(5), 12, "eye-to-hand", **NOISE)
    arguments = easy_handeye(tmp_path, truth.pairs, "eye_on_base")
    code, shown, _ = command(*arguments, *QUICK)
    assert code == 0
    assert "flange_from_base as easy_handeye writes it of eye-to-hand" in shown
    assert "base_from_camera" in shown
    said = "of eye-to-hand, --setup eye-in-hand; leave it out"
    assert_error(command(*arguments, *QUICK, "--setup", "eye-in-hand"), INPUT, said)
    arguments = easy_handeye(tmp_path, truth.pairs, "")  # as its server leaves it: --setup tells
    assert command(*arguments, *QUICK, "--setup", "eye-to-hand")[0] == 0
