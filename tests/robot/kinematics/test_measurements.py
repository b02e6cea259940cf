"""Measured data of robots: units, kinds, angles in place of quaternions, columns that nothing reads, and every mistake
named by its line."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.io.table import COVARIANCE, POSE, common_columns, pose_cells
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.measurements import Measurements, read_measurements, read_targets
from stcal.robot.kinematics.robot_file import save_robot
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot, mh80
from stcal.robot.simulated import measured
from stcal.robot.use.compensation import joint_cells, joint_columns
from tests.outcome import fails_with, refuses
from tests.shared import write_rows, written
from tests.support.arms import seen_arm

GANTRY = Robot("gantry", "standard", (DHRow(0, 0.3, 0, 0), DHRow(100, 0, 50, 0)), (Joint("prismatic"), Joint()))
POSES = Poses.of([Rigid.exp([0.1, 0.2, 0.3, 4, 5, 6]), Rigid.exp([-0.4, 0, 0.3, 40, 50, 60])])


def read(tmp_path, text: str, robot: Robot = GANTRY) -> Measurements:
    return read_measurements(written(tmp_path / "data.csv", text), robot)


def test_units_targets_and_distances_from_rows(tmp_path):
    data = read(tmp_path, "# a note\nq1_m,q2_deg,x_um,y_mm,z_in,target\n\n0.25,90,1000,2,1,N1\n0.5,-45,0,0,0,N2\n")
    assert data.q == pytest.approx(np.array([[250, np.pi / 2], [500, -np.pi / 4]]))
    assert data.positions == pytest.approx(np.array([[1, 2, 25.4], [0, 0, 0]]))
    assert data.targets == ("N1", "N2")
    assert list(data.lines) == [4, 5]
    assert data.rotations is None
    refuses("E-MEASURED-NO-ORIENTATION", data.poses)
    data = read(tmp_path, "q1_mm,q2_deg,distance_mm,from_row\n0,0,0,1\n10,5,20,1\n20,10,30,2\n")
    assert data.distances == pytest.approx([0, 20, 30])
    assert data.from_row.tolist() == [0, 0, 1]
    assert read(tmp_path, "q1_mm,q2_deg,distance_mm\n0,0,0\n10,5,20\n").from_row.tolist() == [0, 0]
    with fails_with("E-MEASURED-DISTANCES"):
        data[:2]


def test_poses_with_covariance_and_common_errors(tmp_path):
    covariance = np.diag([1e-8, 2e-8, 3e-8, 1e-4, 2e-4, 3e-4])
    rows = [["1", "2", *pose_cells(pose, covariance)] for pose in POSES]
    data = read(tmp_path, "\n".join(",".join(r) for r in [["q1_mm", "q2_rad", *POSE, *COVARIANCE], *rows]))
    assert np.abs(data.poses().difference(POSES)).max() < 1e-12
    assert data.covariance == pytest.approx(np.array([covariance] * 2))
    assert data[1:].covariance.shape == (1, 6, 6)
    common = np.random.default_rng(0).normal(size=(2, 6, 3)) * 0.3 * np.repeat([1e-4, 1e-2], 3)[:, None]
    data = read(tmp_path, common_text(common))
    assert data.common == pytest.approx(common, rel=1e-5)
    assert data[1:].common == pytest.approx(common[1:], rel=1e-5)
    assert data.own_covariance() == pytest.approx(data.covariance - common @ np.swapaxes(common, 1, 2), rel=1e-5)
    refuses("E-TABLE-COVARIANCE … line 2", read, tmp_path, common_text(4 * common))
    with fails_with("E-TABLE-COLUMN-MISSING … common1_rx … common1_rx"):
        read(tmp_path, common_text(common, ["common1_r", *common_columns(3)[1:]]))
    without = ",".join(["q1_mm,q2_deg", *POSE, *common_columns(1)]) + "\n1,2,0,0,0,1,0,0,0,0,0,0,0,0,0\n"
    refuses("E-TABLE-COVARIANCE", read, tmp_path, without)


def common_text(common, names=None):
    """Two poses with the covariance 1e-8 rad², 1e-4 mm² and common errors (2, 6, r)."""
    covariance = np.diag([1e-8] * 3 + [1e-4] * 3)
    columns = common_columns(common.shape[2]) if names is None else names
    cells = [[f"{v:g}" for v in each.T.ravel()] for each in common]
    rows = [["1", "2", *pose_cells(p, covariance), *c] for p, c in zip(POSES, cells, strict=True)]
    return "\n".join(",".join(row) for row in [["q1_mm", "q2_deg", *POSE, *COVARIANCE, *columns], *rows])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("q1_mm,q2_deg,x_mm,y_mm,z_mm\n", "E-TABLE-EMPTY … data.csv"),
        ("q1_mm,x_mm,y_mm,z_mm\n1,2,3,4\n", "E-TABLE-COLUMN-MISSING … data.csv … q2_rad or q2_deg"),
        ("q1_deg,q2_deg,x_mm,y_mm,z_mm\n1,2,3,4,5\n", "E-TABLE-COLUMN-MISSING … data.csv … q1_mm or"),
        ("q1_mm,q2_deg,q3_deg,x_mm,y_mm,z_mm\n1,2,3,4,5,6\n", "E-ROBOT-MISMATCH … data.csv … gantry … 2"),
        ("q1_mm,q2_deg,x_mm,y_mm,z_mm\n1,2,3,4,nan\n", "E-TABLE-NUMBER … data.csv … 2 … z_mm … 'nan'"),
        ("q1_mm,q2_deg,x_mm,y_mm,z_mm\n1,2,3,4,5\n1,2,inf,4,5\n", "E-TABLE-NUMBER … data.csv … 3 … x_mm … 'inf'"),
        ("q1_mm,q2_deg,x_mm,y_mm,z_mm\n1,2,1e200,4,5\n", "E-VALUE-TOO-FAR … 2 … x_mm … 1e+200 … 1e+12"),
        ("q1_mm,q2_rad,x_mm,y_mm,z_mm\n1,90,3,4,5\n", "E-JOINT-VALUE … data.csv … 2 … q2_rad … 90 … 4"),
        ("q1_mm,q2_rad\n1,0\n", "E-MEASURED-KIND … data.csv … x_mm … y_mm … z_mm … distance_mm"),
        ("q1_mm,q2_rad,distance_mm\n1,0,3\n2,0,5\n", "E-MEASURED-DISTANCES … line 2 … itself is 3 mm … first row"),
        ("q1_mm,q2_rad,distance_mm,from_row\n1,0,3,7\n", "E-MEASURED-FROM-ROW … data.csv … from_row … 7 … 1"),
        ("q1_mm,q2_rad,x_mm,y_mm,z_mm,qw,qx\n1,0,3,7,4,1,0\n", "E-TABLE-COLUMN-MISSING … data.csv … qw, qx … qy, qz"),
        ("q1_mm,q2_rad,x_mm,y_mm,z_mm,qw,qx,qy,qz\n1,0,3,7,4,1,1,0,0\n", "E-QUATERNION-LENGTH … data.csv … 1.414"),
    ],
)
def test_mistakes_are_named(tmp_path, text, words):
    refuses(words, read, tmp_path, text)


def test_ambiguous_poses_are_left_out_and_told(tmp_path):
    """As ``stcal-sfm measure --joints`` writes it: two of 8 poses could be flipped."""
    head = ",".join(["image", "status", *POSE, "q1_mm", "q2_deg"])
    words = {i: "ambiguous" if i in (3, 6) else "certain" for i in range(8)}
    lines = [f"{i}.jpg,{word},{','.join(pose_cells(POSES[i % 2]))},{i},{i}" for i, word in words.items()]
    text = "\n".join([head, *lines])
    data = read(tmp_path, text)
    assert list(data.lines) == [2, 3, 4, 6, 7, 9]
    assert "2 of 8 rows left out, first line 5: their status is ambiguous" in data.notes[0]
    refuses("E-MEASURED-REACH … 8 … 8", read, tmp_path, text.replace("certain", "ambiguous"))


WPR, ABC, OPEN = ("w_deg", "p_deg", "r_deg"), ("a_deg", "b_deg", "c_deg"), ("rx_deg", "ry_deg", "rz_deg")
ORDER = {WPR: "xyz", ABC: "ZYX", OPEN: "XYZ"}


class Data:
    """40 poses of a made arm, with and without orientations as ``names`` state them, and more columns of ones."""

    def __init__(self, folder):
        self.folder = folder
        self.true, self.seen = seen_arm(np.random.default_rng(5), 40)
        save_robot(folder / "robot.toml", mh80())

    def write(self, name: str, names: tuple[str, ...], *more: str, poses=None, joints: bool = True):
        header, rows = [*(joint_columns(self.true) if joints else ()), *POSE[:3], *names, *more], []
        for pose, q in zip(poses or self.seen.poses(), self.seen.q, strict=True):
            turn = pose_cells(pose)[3:] if names == POSE[3:] else []
            if names in ORDER:
                angles = Rotation.from_matrix(pose.rotation).as_euler(ORDER[names], degrees=True)
                turn = [repr(float(angle)) for angle in angles]
            own = joint_cells(self.true, q) if joints else []
            rows.append([*own, *pose_cells(pose)[:3], *turn, *["1"] * len(more)])
        return write_rows(self.folder / name, header, rows)


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


def test_the_order_of_quaternions_is_an_option_and_columns_that_nothing_reads_are_named(data):
    wxyz = data.seen.poses().quaternions()
    path = data.write("data.csv", POSE[3:], poses=Poses.from_quaternions(wxyz[:, [1, 2, 3, 0]], data.seen.points()))
    read = read_measurements(path, mh80(), quaternions="xyzw")
    assert np.abs(read.poses().difference(data.seen.poses())).max() < 1e-9
    known = ("station", "faces", "circles", "rms_px", "chi2_per_dof", "commanded_x_mm", "nominal_q1_deg", "name")
    assert read_measurements(data.write("data.csv", POSE[3:], *known), mh80()).notes == ()
    alone = read_measurements(data.write("data.csv", (), "temperature"), mh80())
    assert alone.notes == ("column not read: temperature",)
    both = ("columns not read: w_deg, p_deg, r_deg, load",)
    assert read_measurements(data.write("data.csv", POSE[3:], *WPR, "load"), mh80()).notes == both
    assert read_targets(data.write("data.csv", POSE[3:], *WPR, "load"), mh80()).notes == both


def test_an_open_convention_is_refused_and_a_needless_one_too(data):
    for read in (read_measurements, read_targets):
        with fails_with("E-ROTATION-AMBIGUOUS … rx, ry, rz … --rotation … ur-rotvec"):
            read(data.write("data.csv", OPEN), mh80())
        for names in (POSE[3:], ()):
            with fails_with("E-OPTION-NEEDS … --rotation … yaskawa"):
                read(data.write("data.csv", names), mh80(), rotation="yaskawa")
    alone, path = Robot("one", "standard", mh80().rows[:1], mh80().joints[:1]), data.folder / "d.csv"
    distances = written(path, "q1_deg,distance_mm\n1,2\n")
    refuses("E-OPTION-NEEDS", read_measurements, distances, alone, rotation="yaskawa")


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
    head = [*(f"commanded_{name}" for name in POSE[:3]), *POSE[:3], "load"]
    path = write_rows(data.folder / "v.csv", head, [[i, i * i, 0, i, i * i, 0, 1] for i in range(5)])
    code, printed, _ = stcal_robot("verify", path, "--json", out, "--overwrite")
    assert "note: column not read: load" in printed
    assert json.loads(out.read_text())["notes"] == ["column not read: load"]


def test_notes_of_sweeps(data, stcal_robot):
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
