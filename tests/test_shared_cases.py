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
    "ur_pendant, lower": "--a lower.csv --b camera.csv",
    "ur_pendant, l2": "--a l2.csv --b camera.csv --rotation robot=ur-rotvec",
    "ur_pendant, l3": "--a l3.csv --b camera.csv --rotation robot=ur-rotvec",
}


@pytest.mark.parametrize("name", HANDEYE)
def test_hand_eye_of_a_controllers_table(call, shared_case, tmp_path, name):
    """Written otherwise than in its ``cmd``, which `test_cases_as_typed` calls.

    Noise of 0.2 mm and 0.02° on twelve poses: the camera is found to a tenth of a degree and a millimetre.
    """
    case = name.split(",")[0]
    outcome = call(case, f"handeye {HANDEYE[name]} --splits 0 --method pose --out {{tmp}}/h.json")
    assert outcome[0] == 0, outcome
    found = np.array(json.loads((tmp_path / "h.json").read_text())["flange_from_camera"])
    degrees, mm = apart(truth(shared_case(case)), found)
    assert degrees < 0.1, degrees
    assert mm < 1.0, mm


@pytest.mark.slow
def test_a_trackers_export_is_joined_by_two_names(call, shared_case, tmp_path):
    words = "robot identify --a joints.csv --b tracker.txt --robot robot.toml --out {tmp}/o.toml --key "
    outcome = call("rob_tracker_nomap", words + '"image=Point Name"')
    assert_error(outcome, 2, "the unit of X is open", "call it x_mm")
    text = (shared_case("rob_tracker_nomap") / "tracker.txt").read_text()
    (tmp_path / "tracker.txt").write_text(text.replace(";X;Y;Z", ";x_mm;y_mm;z_mm"))
    assert call("rob_tracker_nomap", words.replace("tracker.txt", "{tmp}/tracker.txt") + '"image=Point Name"')[0] == 0


def test_bundles_of_apriltag_ros(call, shared_case, tmp_path):
    """The tags were drawn as OpenCV draws them: right where it is stated."""
    words = "locate run ../loc_bundle/images --layout {} --camera cameras.txt --json {{tmp}}/l.json --overwrite"
    tags = shared_case("loc_apriltag_ros_yaml/tags.yaml").read_text()
    (tmp_path / "tags.yaml").write_text(f"upright: true\n{tags}")
    assert call("loc_apriltag_ros_yaml", words.format("{{tmp}}/tags.yaml").replace("{{tmp}}", "{tmp}"))[0] == 0
    scenes = json.loads((tmp_path / "l.json").read_text())["scenes"]
    for scene, place in zip(scenes, [[-40, -30, 700], [-40, -30, 800]], strict=True):
        np.testing.assert_allclose(np.array(scene["camera_from_obj"])[:3, 3], place, atol=0.5)


@pytest.mark.slow
def test_tags_half_a_turn_off_fit_with_180_added(call):
    code, out, _ = call("rotated_tags", "locate run tags --layout tags180.toml --camera cam.txt --out {tmp}/o.csv")
    assert code == 0
    assert out.count("accept") >= 2
    assert "reject" not in out
