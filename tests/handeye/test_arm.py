"""The arm's parameters beside hand and eye."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions, cross_validate, splits
from stcal.handeye.data.pose_pairs import SETUPS
from stcal.robot import Joint, forward, inverse, load_robot
from stcal.robot.kinematics.forward import chain_parameters, flange_poses, jacobian, moved_chain
from stcal.robot.kinematics.robot_file import save_robot
from stcal.robot.kinematics.robot_model import mh80
from stcal.workflows.handeye_inputs import Arm
from tests.boards.drawn import chessboard_mm
from tests.handeye.photographed import FLANGE_FROM_CAMERA, PER_MM, looks, photographs
from tests.outcome import INPUT, assert_error, fails_with
from tests.support.handeye import BASE_FROM_BOARD, handeye, simulated_views, squared

OFF = (1e-3, 0.5)
"""σ of the axes about the robot's file: rad, mm."""


def arm_at(rng: np.random.Generator, base_from_flange: Poses):
    """A robot without joint limits, motions of its joints' frames by which its axes really are off, and joint values at
    which its flange is where it is wanted, by Newton's steps."""
    robot = replace(mh80(), joints=(Joint(),) * 6)
    chain = replace(robot, world_from_base=Rigid()).chain()
    parameters = rng.normal(0, [OFF[component >= 3] for _, component in chain_parameters(chain)])
    true, q = moved_chain(chain, parameters), inverse(robot, base_from_flange).q.copy()
    for _ in range(20):
        off = base_from_flange.difference(flange_poses(true, q))
        q += np.linalg.solve(jacobian(robot, q), off[:, :, None])[:, :, 0]
    assert np.abs(off).max() < 1e-9
    return robot, parameters, q


def scene(seed: int, setup: str = "eye-in-hand", count: int = 16):
    """Truth, pairs by the robot's file, the axes' errors, and the arm; the robot repeats to 0.02 mm."""
    rng = np.random.default_rng(seed)
    truth = simulated_views(rng, count, setup, (2e-5, 0.02), 0.1)
    robot, errors, q = arm_at(rng, truth.pairs.base_from_flange)
    return truth, replace(truth.pairs, base_from_flange=forward(robot, q)), errors, Arm(robot, q)


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS)
def test_what_the_arm_errs_is_found(setup):
    """Poses held out are missed by what robot and corners scatter, 0.02 mm and 0.1 px, in place of millimetres."""
    truth, pairs, errors, model = scene(2, setup)
    options, rows = HandEyeOptions(arm=model), splits(len(pairs), 4, 1)
    found = handeye(pairs, setup, None, truth.views, options)
    plain, own = (cross_validate(pairs, setup, None, truth.views, each, rows).means() for each in (None, options))
    assert own["board_mm"] < 0.5 * plain["board_mm"]
    off = found.reprojection.arm - errors
    # χ² of 24, of which 1 in 1000 exceeds 51; what poses tell little of is held by σ that are estimated from 24 values.
    assert off @ np.linalg.solve(found.reprojection.arm_covariance, off) < 51 * 1.5
    assert found.sigma["arm_rad"] == pytest.approx(OFF[0], rel=0.8)
    assert found.sigma["arm_mm"] == pytest.approx(OFF[1], rel=0.8)


@pytest.mark.full
def test_sigma_is_honest_with_an_arm_that_errs():
    """240 numbers of χ²: their mean lies within 1 ± 4 √(2 / 240) by chance; σ of groups are estimated of few values."""
    errors = []
    for seed in range(40):
        truth, pairs, _, model = scene(100 + seed, count=25)
        found = handeye(pairs, truth.setup, None, truth.views, HandEyeOptions(arm=model))
        errors.append(squared(found, truth) / 6)
    assert 1 - 4 * np.sqrt(2 / 240) < np.mean(errors) < 1 + 4 * np.sqrt(2 / 240)


def test_only_corners_tell_of_the_arm():
    _, pairs, _, model = scene(3, count=4)
    with fails_with("E-HANDEYE-NEEDS-VIEWS … pose"):
        handeye(pairs, options=HandEyeOptions(arm=model))


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Ten photographs of a chessboard by an arm that is off its file: arguments, joint values by image in its poses."""
    folder = tmp_path_factory.mktemp("arm")
    rng = np.random.default_rng(4)
    seen = looks(rng, 12, np.array([70.0, 50.0]), 0.6)
    sheet, first = chessboard_mm(6, 8, 20, PER_MM)
    files = photographs(folder, sheet, first, seen, 'type = "chessboard"\nrows = 6\ncolumns = 8\nsquare_mm = 20\n')
    robot, _, q = arm_at(rng, BASE_FROM_BOARD @ seen.inverse() @ FLANGE_FROM_CAMERA.inverse())
    heads = ["image", *(f"q{i}_deg" for i in range(1, 7))]
    rows = [[f"{i}.png", *map(repr, row)] for i, row in enumerate(np.degrees(q).tolist())]
    files.poses.write_text("\n".join(",".join(row) for row in [heads, *rows]) + "\n")
    save_robot(folder / "robot.toml", robot)
    return files, folder / "robot.toml", q


@pytest.mark.full
def test_photographs_and_joint_values(command, photographed, tmp_path):
    files, robot_file, q = photographed
    out, written, page = tmp_path / "h.json", tmp_path / "made.toml", tmp_path / "h.html"
    more = ("--out", out, "--robot-out", written, "--report", page, "--splits", 2, "--workers", 1)
    code, shown, error = command(*files.arguments(), "--with-kinematics", robot_file, *more)
    assert code == 0, error
    assert "joint values of 12 images; poses by the file of MH80" in shown
    assert "with the parameters of MH80 solved for, poses held out are missed by" in shown
    data = json.loads(out.read_text())
    now, before = data["held_out"]["board_mm"], data["arm"]["plain"]["board_mm"]
    assert now < before / 3
    assert len(data["arm"]["parameters"]) == 24
    # The written arm carries the board where it is: a rigid move of base and flange beside, which X and Z take up.
    by_file, made = (forward(load_robot(path), q) for path in (robot_file, written))
    true = BASE_FROM_BOARD
    x, z = (np.array(data[name]) for name in ("flange_from_camera", "base_from_board"))
    assert np.abs(made.difference(by_file)).max() > 0.1
    assert np.linalg.norm(z[:3, 3] - true.translation) < 5
    assert np.linalg.norm(x[:3, 3] - FLANGE_FROM_CAMERA.translation) < 2
    assert "The arm" in page.read_text()


def test_what_does_not_go_with_it(command, photographed, tmp_path):
    files, robot_file, _ = photographed
    images, arm = files.arguments(), ("--with-kinematics", robot_file)
    lines = [line.rsplit(",", 1)[0] for line in files.poses.read_text().splitlines()]
    (tmp_path / "five.csv").write_text("\n".join(lines) + "\n")
    five = [tmp_path / "five.csv" if word == str(files.poses) else word for word in images]
    for words, said in (
        ((*images, *arm, "--method", "pose"), "pose does not solve for the arm"),
        ((*images, *arm, "--four-dof"), "--four-dof: give one of them"),
        ((files.poses, *arm), "only with a folder of images"),
        ((*images, "--robot-out", tmp_path / "r.toml"), "--robot-out: only with --with-kinematics"),
        ((*five, *arm), "q6"),
    ):
        assert_error(command(*words), INPUT, said)
