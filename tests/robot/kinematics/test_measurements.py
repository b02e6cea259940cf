"""Measured data of robots: units, kinds, and every mistake named by its line."""

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.io.table import COVARIANCE, POSE, common_columns, pose_cells
from stcal.robot.kinematics.measurements import Measurements, read_measurements
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot
from tests.outcome import fails_with, refuses

GANTRY = Robot("gantry", "standard", (DHRow(0, 0.3, 0, 0), DHRow(100, 0, 50, 0)), (Joint("prismatic"), Joint()))
POSES = Poses.of([Rigid.exp([0.1, 0.2, 0.3, 4, 5, 6]), Rigid.exp([-0.4, 0, 0.3, 40, 50, 60])])


def read(tmp_path, text: str, robot: Robot = GANTRY) -> Measurements:
    (tmp_path / "data.csv").write_text(text)
    return read_measurements(tmp_path / "data.csv", robot)


def test_units_and_targets(tmp_path):
    data = read(tmp_path, "# a note\nq1_m,q2_deg,x_um,y_mm,z_in,target\n\n0.25,90,1000,2,1,N1\n0.5,-45,0,0,0,N2\n")
    assert data.q == pytest.approx(np.array([[250, np.pi / 2], [500, -np.pi / 4]]))
    assert data.positions == pytest.approx(np.array([[1, 2, 25.4], [0, 0, 0]]))
    assert data.targets == ("N1", "N2")
    assert list(data.lines) == [4, 5]
    assert data.rotations is None
    refuses("E-MEASURED-NO-ORIENTATION", data.poses)


def test_poses_with_covariance(tmp_path):
    covariance = np.diag([1e-8, 2e-8, 3e-8, 1e-4, 2e-4, 3e-4])
    rows = [["1", "2", *pose_cells(pose, covariance)] for pose in POSES]
    data = read(tmp_path, "\n".join(",".join(r) for r in [["q1_mm", "q2_rad", *POSE, *COVARIANCE], *rows]))
    assert np.abs(data.poses().difference(POSES)).max() < 1e-12
    assert data.covariance == pytest.approx(np.array([covariance] * 2))
    assert data[1:].covariance.shape == (1, 6, 6)


def common_text(common, names=None):
    """Two poses with the covariance 1e-8 rad², 1e-4 mm² and common errors (2, 6, r)."""
    covariance = np.diag([1e-8] * 3 + [1e-4] * 3)
    columns = common_columns(common.shape[2]) if names is None else names
    cells = [[f"{v:g}" for v in each.T.ravel()] for each in common]
    rows = [["1", "2", *pose_cells(p, covariance), *c] for p, c in zip(POSES, cells, strict=True)]
    return "\n".join(",".join(row) for row in [["q1_mm", "q2_deg", *POSE, *COVARIANCE, *columns], *rows])


def test_common_errors_of_poses(tmp_path):
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


def test_distances_from_rows(tmp_path):
    data = read(tmp_path, "q1_mm,q2_deg,distance_mm,from_row\n0,0,0,1\n10,5,20,1\n20,10,30,2\n")
    assert data.distances == pytest.approx([0, 20, 30])
    assert data.from_row.tolist() == [0, 0, 1]
    assert read(tmp_path, "q1_mm,q2_deg,distance_mm\n0,0,0\n10,5,20\n").from_row.tolist() == [0, 0]
    with fails_with("E-MEASURED-DISTANCES"):
        data[:2]


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
