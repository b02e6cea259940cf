"""Calls that were reported (``../shared/cases``): tables, poses, layouts and robots of other programs.

Results are those of the truth beside each input, or of OpenCV; what cannot be told is refused in a line that says what
to do.
"""

import json
import shlex
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.cli.main import main
from tests.outcome import assert_error, ended


@pytest.fixture
def call(monkeypatch, capsys, shared_case, tmp_path):
    """Runs a call in the folder of a case, of which files in ``tmp_path`` may take the place."""

    def run(case: str, words: str):
        monkeypatch.chdir(shared_case(case))
        monkeypatch.setattr(sys, "argv", ["stcal", *shlex.split(words.format(tmp=tmp_path))])
        return ended(main, capsys)

    return run


def truth(folder) -> np.ndarray:
    """The first matrix of a truth file, as NumPy prints it."""
    text = (folder / "truth").read_text().split("]]")[0]
    return np.array([row.replace("[", " ").replace("]", " ").split() for row in text.splitlines()], float)


def apart(one: np.ndarray, two: np.ndarray) -> tuple[float, float]:
    """Angle in degrees and distance in mm between two transforms."""
    turn = Rotation.from_matrix(one[:3, :3].T @ two[:3, :3]).magnitude()
    return np.degrees(turn), float(np.linalg.norm(one[:3, 3] - two[:3, 3]))


HANDEYE = {
    "kuka_semicolon_comma": "--a kuka.csv --b camera.csv --rotation robot=kuka-abc --length-unit robot=mm",
    "ur_pendant": "--a ur.csv --b camera.csv --rotation robot=ur-rotvec",
    "ur_pendant, lower": "--a lower.csv --b camera.csv",
    "ur_pendant, l2": "--a l2.csv --b camera.csv --rotation robot=ur-rotvec",
    "ur_pendant, l3": "--a l3.csv --b camera.csv --rotation robot=ur-rotvec",
}


@pytest.mark.parametrize("name", HANDEYE)
def test_hand_eye_of_a_controllers_table(call, shared_case, tmp_path, name):
    """Noise of 0.2 mm and 0.02° on twelve poses: the camera is found to a tenth of a degree and a millimetre."""
    case = name.split(",")[0]
    outcome = call(case, f"handeye {HANDEYE[name]} --splits 0 --method pose --out {{tmp}}/h.json")
    assert outcome[0] == 0, outcome
    found = np.array(json.loads((tmp_path / "h.json").read_text())["flange_from_camera"])
    degrees, mm = apart(truth(shared_case(case)), found)
    assert degrees < 0.1, degrees
    assert mm < 1.0, mm


@pytest.mark.parametrize(
    ("case", "files"),
    [("reg_german_csv", "--a a.csv --b b.csv"), ("reg_sa_two_exports", "--a a.txt --b b.txt --key name")],
)
def test_points_of_a_tracker_are_registered(call, shared_case, tmp_path, case, files):
    """Noise of 0.05 mm on some twenty points within a metre."""
    assert call(case, f"register {files} --out {{tmp}}/r.json")[0] == 0
    degrees, mm = apart(truth(shared_case(case)), np.array(json.loads((tmp_path / "r.json").read_text())["b_from_a"]))
    assert degrees < 0.01, degrees
    assert mm < 0.1, mm


@pytest.mark.slow
def test_a_trackers_export_is_joined_by_two_names(call, shared_case, tmp_path):
    words = "robot identify --a joints.csv --b tracker.txt --robot robot.toml --out {tmp}/o.toml --key "
    line = assert_error(call("rob_tracker_nomap", words + '"Point Name"'), 2, "no column Point Name", "--key")
    assert "NAME=Point Name" in line
    line = assert_error(
        call("rob_tracker_nomap", words + '"image=Point Name"'), 2, "the unit of X is open", "call it x_mm"
    )
    text = (shared_case("rob_tracker_nomap") / "tracker.txt").read_text()
    (tmp_path / "tracker.txt").write_text(text.replace(";X;Y;Z", ";x_mm;y_mm;z_mm"))
    assert call("rob_tracker_nomap", words.replace("tracker.txt", "{tmp}/tracker.txt") + '"image=Point Name"')[0] == 0


def test_a_part_of_a_universal_robots_calibration_is_named(call):
    assert_error(
        call("rob_ur_kinematics_yaml", "robot convert k.yaml {tmp}/o.toml"),
        2,
        "forearm, wrist_1, wrist_2",
        "anew",
    )


def test_names_of_apriltag(call, shared_case, tmp_path):
    """The family's own name, tag36h11; scene s1 is free of the tag that contradicts the others."""
    words = "locate run ../loc_bundle/images --layout {} --camera cameras.txt --json {{tmp}}/l.json --overwrite"
    assert call("loc_tag36h11_name", words.format("layout.toml"))[0] == 0
    scenes = json.loads((tmp_path / "l.json").read_text())["scenes"]
    wanted = [[-40, -30, 700], [-40, -30, 800]]
    for scene, place in zip(scenes, wanted, strict=True):
        np.testing.assert_allclose(np.array(scene["camera_from_obj"])[:3, 3], place, atol=0.5)


def test_bundles_of_apriltag_ros(call, shared_case, tmp_path):
    """The tags were drawn as OpenCV draws them: said at first, and right where it is stated."""
    words = "locate run ../loc_bundle/images --layout {} --camera cameras.txt --json {{tmp}}/l.json --overwrite"
    code, out, _ = call("loc_apriltag_ros_yaml", words.format("tags.yaml"))
    assert code == 3
    assert "half a turn the other way" in out
    assert "upright: true" in out
    tags = shared_case("loc_apriltag_ros_yaml/tags.yaml").read_text()
    (tmp_path / "tags.yaml").write_text(f"upright: true\n{tags}")
    assert call("loc_apriltag_ros_yaml", words.format("{{tmp}}/tags.yaml").replace("{{tmp}}", "{tmp}"))[0] == 0
    scenes = json.loads((tmp_path / "l.json").read_text())["scenes"]
    for scene, place in zip(scenes, [[-40, -30, 700], [-40, -30, 800]], strict=True):
        np.testing.assert_allclose(np.array(scene["camera_from_obj"])[:3, 3], place, atol=0.5)


@pytest.mark.slow
def test_tags_half_a_turn_off_are_told(call):
    words = "locate run tags --layout {} --camera cam.txt --out {{tmp}}/o.csv --overwrite"
    code, out, _ = call("rotated_tags", words.format("tags0.toml"))
    assert code == 3
    assert out.count("add 180 to each angle_deg") == 3
    code, out, _ = call("rotated_tags", words.format("tags180.toml"))
    assert code == 0
    assert out.count("accept") >= 2
    assert "reject" not in out
