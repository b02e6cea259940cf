"""``stcal handeye rig`` as a user types it."""

import json
import sys

import cv2
import numpy as np
import pytest

from stcal.cli.main import main
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.robot_poses import read_robot_poses
from stcal.workflows.handeye.rig import read_handeye_rig
from tests.handeye.rig.photographed import LEFT_FROM, photographed_rig, write_poses
from tests.outcome import ended
from tests.shared import own_copy
from tests.support.handeye import FLANGE_FROM_CAMERA

INPUT = 2


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return photographed_rig(tmp_path_factory.mktemp("rig"))


@pytest.fixture
def files(drawn, tmp_path):
    """A copy that a test may change."""
    return own_copy(drawn.parent, tmp_path / "rig")


@pytest.fixture
def rig(monkeypatch, capsys):
    """Exit code, standard output and error."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["stcal", "handeye", "rig", *map(str, arguments), "--workers", "1"])
        return ended(main, capsys)

    return call


def in_sigmas(matrix, covariance, true: Rigid) -> float:
    off = Poses.of([Rigid.from_matrix(matrix)]).difference(Poses.of([true]))[0]
    return float(np.sqrt(off @ np.linalg.solve(np.array(covariance), off)))


@pytest.mark.slow
def test_two_cameras_from_photographs(rig, drawn, tmp_path):
    out = ["--out", tmp_path / "r.json", "--json", tmp_path / "all.json", "--report", tmp_path / "r.html"]
    code, shown, error = rig(drawn, "--splits", 3, *out)
    assert code == 0, error
    assert "7 of 8 poses of the robot are of several cameras' images" in shown
    assert "left out right: 01: no such image, in a row of robot.csv" in shown
    found = json.loads((tmp_path / "r.json").read_text())
    assert [each["name"] for each in found["cameras"]] == ["left", "right"]
    for each in found["cameras"]:
        true = FLANGE_FROM_CAMERA @ LEFT_FROM[each["name"]]
        assert in_sigmas(each["flange_from_camera"], each["covariance"], true) < 5
    (between,) = found["relative"]
    assert (between["first"], between["second"]) == ("left", "right")
    assert in_sigmas(between["first_from_second"], between["covariance"], LEFT_FROM["right"]) < 5
    assert np.array(found["covariance"]).shape == (18, 18)
    assert np.allclose(np.array(found["covariance"])[6:12, 6:12], found["cameras"][1]["covariance"])
    assert found["splits"] == 3
    whole = json.loads((tmp_path / "all.json").read_text())
    split = whole["cameras"][1]["splits"]
    assert len(split["joint_board_mm"]) > 3
    assert len(split["images"]) == len(split["alone_board_mm"]) == len(split["split"])
    assert whole["cameras"][1]["held_out"]["joint"]["board_mm"] == pytest.approx(np.mean(split["joint_board_mm"]))
    page = (tmp_path / "r.html").read_text()
    for part in ("flange_from_left", "flange_from_right", "left_from_right", "base_from_board", "Together, and each"):
        assert part in page
        assert part == "Together, and each" or part in shown


@pytest.mark.slow
def test_poses_in_files_of_their_own_are_shared_where_they_are_equal(rig, files):
    robot = read_robot_poses(files / "robot.csv")
    for name in LEFT_FROM:
        poses = {f"{name}/{image}.png": pose for image, pose in zip(robot.images, robot.base_from_flange, strict=True)}
        write_poses(files / f"{name}.csv", poses)
    text = (files / "rig.toml").read_text().replace('poses = "robot.csv"\n', "")
    for name in LEFT_FROM:
        text = text.replace(f'images = "{name}"', f'images = "{name}"\nposes = "{name}.csv"')
    (files / "rig.toml").write_text(text)
    code, shown, error = rig(files / "rig.toml", "--splits", 0)
    assert code == 0, error
    assert "7 of 8 poses of the robot are of several cameras' images" in shown
    assert "errors on poses held out are not known" in shown


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "right"', 'name = "left"', "camera 2 is called 'left' like another camera; give each"),
        ('poses = "robot.csv"\n', "", "camera left: no poses of the robot; add `poses`, here or for all"),
        ('setup = "eye-in-hand"', 'setup = "in hand"', "setup: 'in hand'"),
        ('images = "right"', 'image = "right"', "camera.2"),
        ('images = "right"', 'images = "up"', "camera right: image folder"),
        ('board = "board.toml"', 'board = "cameras.txt"', "cameras.txt"),
        ("[[camera]]", "[[cameras]]", "camera: key missing; add it"),
    ],
)
def test_mistakes_in_the_file_are_named(rig, files, old, new, said):
    text = (files / "rig.toml").read_text()
    (files / "rig.toml").write_text(text.replace(old, new))
    code, _, error = rig(files / "rig.toml", "--splits", 0)
    assert code == INPUT
    assert said in error
    assert error.strip().splitlines()[-1].startswith("error: ")


@pytest.mark.slow
def test_a_camera_of_a_file_of_several_is_named(rig, files):
    (line,) = [line for line in (files / "cameras.txt").read_text().splitlines() if line[:1] == "1"]
    (files / "both.txt").write_text(f"{line}\n{line.replace('1', '2', 1)}\n")
    text = (files / "rig.toml").read_text().replace('camera = "cameras.txt"', 'camera = "both.txt"')
    (files / "rig.toml").write_text(text)
    code, _, error = rig(files / "rig.toml", "--splits", 0)
    assert code == INPUT
    assert "camera left: camera file" in error
    assert "in a rig file camera_name" in error
    (files / "rig.toml").write_text(text.replace('"both.txt"', '"both.txt"\ncamera_name = "2"'))
    assert read_handeye_rig(files / "rig.toml", workers=1).given.cameras[0].name == "left"


def test_what_it_reads_is_not_written_over(rig, files):
    code, _, error = rig(files / "rig.toml", "--out", files / "cameras.txt")
    assert code == INPUT
    assert "cameras.txt" in error
    code, _, error = rig(files / "rig.toml", "--out", files / "left" / "00.png")
    assert code == INPUT


@pytest.mark.slow
def test_images_of_one_camera_that_are_not_of_the_board_are_named(rig, files):
    for path in (files / "right").iterdir():
        cv2.imwrite(str(path), np.full((600, 800), 200, np.uint8))
    code, _, error = rig(files / "rig.toml", "--splits", 0)
    assert code == INPUT
    assert "camera right: image folder" in error
    assert "the board is in none of 7 images" in error
