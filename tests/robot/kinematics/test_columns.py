"""Columns of robots' tables: angles in place of quaternions, and those that nothing reads."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses
from stcal.io.table import POSE, pose_cells
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.measurements import read_measurements, read_targets
from stcal.robot.kinematics.robot_file import save_robot
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import measured
from stcal.robot.use.compensation import joint_cells, joint_columns
from tests.outcome import fails_with
from tests.support.arms import seen_arm

WPR, ABC, OPEN = ("w_deg", "p_deg", "r_deg"), ("a_deg", "b_deg", "c_deg"), ("rx_deg", "ry_deg", "rz_deg")
ORDER = {WPR: "xyz", ABC: "ZYX", OPEN: "XYZ"}


class Data:
    """40 poses of a made arm, with and without orientations as ``names`` state them, and more columns of ones."""

    def __init__(self, folder):
        self.folder = folder
        self.true, self.seen = seen_arm(np.random.default_rng(5), 40)
        save_robot(folder / "robot.toml", mh80())

    def write(self, name: str, names: tuple[str, ...], *more: str, poses=None, joints: bool = True):
        header = [*(joint_columns(self.true) if joints else ()), *POSE[:3], *names, *more]
        rows = [header]
        for pose, q in zip(poses or self.seen.poses(), self.seen.q, strict=True):
            turn = pose_cells(pose)[3:] if names == POSE[3:] else []
            if names in ORDER:
                angles = Rotation.from_matrix(pose.rotation).as_euler(ORDER[names], degrees=True)
                turn = [repr(float(angle)) for angle in angles]
            own = joint_cells(self.true, q) if joints else []
            rows.append([*own, *pose_cells(pose)[:3], *turn, *["1"] * len(more)])
        path = self.folder / name
        path.write_text("\n".join(map(",".join, rows)) + "\n")
        return path


@pytest.fixture
def data(tmp_path):
    return Data(tmp_path)


@pytest.mark.parametrize(("names", "rotation"), [(WPR, None), (ABC, None), (OPEN, "staubli")])
def test_angles_are_orientations(data, names, rotation):
    read = read_measurements(data.write("data.csv", names), mh80(), rotation=rotation)
    assert np.abs(read.poses().difference(data.seen.poses())).max() < 1e-9
    assert len(read.notes) == 1
    assert read.notes[0].startswith(f"orientation: {', '.join(names)} as Euler angles {ORDER[names]} (about ")
    targets = read_targets(data.write("t.csv", names, joints=False), mh80(), rotation=rotation)
    assert np.abs(targets.poses.difference(data.seen.poses())).max() < 1e-9
    assert targets.notes == read.notes


def test_the_order_of_quaternions_is_an_option(data):
    wxyz = data.seen.poses().quaternions()
    path = data.write("data.csv", POSE[3:], poses=Poses.from_quaternions(wxyz[:, [1, 2, 3, 0]], data.seen.points()))
    read = read_measurements(path, mh80(), quaternions="xyzw")
    assert np.abs(read.poses().difference(data.seen.poses())).max() < 1e-9


def test_an_open_convention_is_refused_and_a_needless_one_too(data):
    for read in (read_measurements, read_targets):
        with fails_with("E-ROTATION-AMBIGUOUS … rx, ry, rz … --rotation … ur-rotvec"):
            read(data.write("data.csv", OPEN), mh80())
        for names in (POSE[3:], ()):
            with fails_with("E-OPTION-NEEDS … --rotation … yaskawa"):
                read(data.write("data.csv", names), mh80(), rotation="yaskawa")
    (data.folder / "d.csv").write_text("q1_deg,distance_mm\n1,2\n")
    with fails_with("E-OPTION-NEEDS"):
        alone = Robot("one", "standard", mh80().rows[:1], mh80().joints[:1])
        read_measurements(data.folder / "d.csv", alone, rotation="yaskawa")


def test_columns_that_nothing_reads_are_named_and_the_known_ones_are_not(data):
    known = ("station", "faces", "circles", "rms_px", "chi2_per_dof", "commanded_x_mm", "nominal_q1_deg", "name")
    assert read_measurements(data.write("data.csv", POSE[3:], *known), mh80()).notes == ()
    assert read_measurements(data.write("data.csv", (), "temperature"), mh80()).notes == (
        "column not read: temperature",
    )
    both = ("columns not read: w_deg, p_deg, r_deg, load",)
    assert read_measurements(data.write("data.csv", POSE[3:], *WPR, "load"), mh80()).notes == both
    assert read_targets(data.write("data.csv", POSE[3:], *WPR, "load"), mh80()).notes == both


@pytest.mark.slow
def test_notes_reach_terminal_and_json(data, stcal_robot):
    robot, out = ("--robot", data.folder / "robot.toml"), data.folder / "out.json"
    angles = "orientation: w_deg, p_deg, r_deg as Euler angles xyz (about fixed axes), degrees"
    path = data.write("data.csv", WPR, "load")
    code, printed, _ = stcal_robot("identify", path, *robot, "--folds", 0, "--json", out, "--overwrite")
    assert code == 0
    assert f"40 poses from robot data {path}, 30 parameters determined" in printed
    for note in (angles, "column not read: load"):
        assert f"note: {note}" in printed
        assert note in json.loads(out.read_text())["notes"]
    poses = forward(mh80(), data.seen.q)
    targets = data.write("targets.csv", WPR, "load", poses=poses)
    code, printed, _ = stcal_robot("compensate", targets, *robot, "--json", out, "--overwrite")
    assert code == 0
    assert json.loads(out.read_text())["notes"][:2] == [angles, "column not read: load"]
    assert f"note: targets {targets}: column not read: load" in printed
    at = ["commanded_x_mm", "commanded_y_mm", "commanded_z_mm"]
    lines = [",".join([*at, *POSE[:3], "load"]), *(f"{i},{i * i},0,{i},{i * i},0,1" for i in range(5))]
    (data.folder / "v.csv").write_text("\n".join(lines) + "\n")
    code, printed, _ = stcal_robot("verify", data.folder / "v.csv", "--json", out, "--overwrite")
    assert "note: column not read: load" in printed
    assert json.loads(out.read_text())["notes"] == ["column not read: load"]


def test_notes_of_sweeps(data, stcal_robot, monkeypatch):
    monkeypatch.setattr("stcal.robot.axes.axes_model.REFITTED", 0)
    rest, out = np.radians([10, 20, -20, 15, 40, 5.0]), data.folder / "out.json"
    q = np.array([rest + np.eye(6)[i] * step for i in range(6) for step in np.linspace(-0.6, 0.6, 5)])
    data.seen = measured(data.true, q, np.random.default_rng(1))
    path, options = data.write("sweeps.csv", OPEN, "load"), ("--robot", data.folder / "robot.toml", "--json", out)
    code, _, error = stcal_robot("axes", path, *options)
    assert (code, "give --rotation" in error) == (2, True)
    code, printed, _ = stcal_robot("axes", path, *options, "--rotation", "staubli")
    assert code == 0
    assert "column not read: load" in printed
    assert json.loads(out.read_text())["notes"][1] == "column not read: load"
