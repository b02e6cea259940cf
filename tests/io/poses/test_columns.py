"""Rotations in columns: the conventions of controllers by their own formulas, which names leave them open, and columns
of quaternions that hold something else than they say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses
from stcal.io.rotations import FIRST, INVERTED, LAST, READINGS, read_rotations
from stcal.io.table import Table, read_table
from tests.outcome import fails_with, refuses


def about(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = c
    turn[i, j], turn[j, i] = -s, s
    return turn


def read(header: str, *values: float, rotation: str | None = None):
    columns = {name: np.array([value]) for name, value in zip(header.split(","), values, strict=True)}
    return read_rotations(Table("table", columns, [2]), rotation=rotation)


FANUC = about("z", 30) @ about("y", 20) @ about("x", 10)
"""Rz(R) Ry(P) Rx(W), FANUC's and Yaskawa's manuals; Rz(A) Ry(B) Rx(C), KUKA's."""


@pytest.mark.parametrize(
    ("header", "values", "rotation", "expected"),
    [
        ("w_deg,p_deg,r_deg", (10, 20, 30), None, FANUC),
        ("W_DEG,P_DEG,R_DEG", (10, 20, 30), "yaskawa", FANUC),
        ("a_deg,b_deg,c_deg", (30, 20, 10), None, FANUC),
        ("a_deg,b_deg,c_deg", (10, 20, 30), "mitsubishi-abc", FANUC),
        ("roll_deg,pitch_deg,yaw_deg", (10, 20, 30), None, FANUC),
        ("rpy_roll_rad,rpy_pitch_rad,rpy_yaw_rad", np.radians([10, 20, 30]), None, FANUC),
        ("o_deg,a_deg,t_deg", (10, 20, 30), None, about("z", 10) @ about("y", 20) @ about("z", 30)),
        ("rx_deg,ry_deg,rz_deg", (10, 20, 30), "yaskawa", FANUC),
        ("rx_deg,ry_deg,rz_deg", (10, 20, 30), "staubli", about("x", 10) @ about("y", 20) @ about("z", 30)),
        ("rx,ry,rz", (100, 20, 30), "ZYX", about("z", 30) @ about("y", 20) @ about("x", 100)),
        ("rx_rad,ry_rad,rz_rad", (0, 0, np.radians(40)), None, about("z", 40)),
        ("rotvec_x_deg,rotvec_y_deg,rotvec_z_deg", (0, -40, 0), None, about("y", -40)),
    ],
)
def test_conventions(header, values, rotation, expected):
    found = read(header, *values, rotation=rotation)
    assert np.abs(found.rotation[0] - expected).max() < 1e-12  # rounding
    assert found.columns == tuple(header.split(","))


def test_columns_that_name_their_angles_are_not_overruled_in_silence():
    header = "euler_ZYX_1_deg,euler_ZYX_2_deg,euler_ZYX_3_deg"
    assert np.array_equal(read(header, 3, 2, 1).rotation, read(header, 3, 2, 1, rotation="ZYX-deg").rotation)
    with fails_with("E-OPTION-CONTRADICTS … euler_ZYX_1_deg … --rotation xyz-deg … rename"):
        read(header, 3, 2, 1, rotation="xyz-deg")


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("rx_deg,ry_deg,rz_deg", "E-ROTATION-AMBIGUOUS … rx, ry, rz … --rot"),
        ("rx,ry,rz", "E-ROTATION-AMBIGUOUS … --rotation … ur-rotvec, yaskawa"),
        ("w_rad,p_rad,r_rad", "E-ROTATION-AMBIGUOUS … wpr"),
        ("a,b,c", "E-ROTATION-AMBIGUOUS … abc"),
        ("roll,pitch,yaw", "E-ROTATION-AMBIGUOUS … roll, pitch, yaw"),
    ],
)
def test_names_that_leave_it_open(header, words):
    refuses(words, read, header, 10, 20, 30)
    assert read(header.rpartition(",")[0], 10, 20) is None


@pytest.mark.parametrize("header", ["roll_rad,pitch_rad,yaw_rad", "rotvec_x_rad,rotvec_y_rad,rotvec_z_rad"])
def test_degrees_that_are_called_radians(header):
    refuses("E-ANGLE-UNIT … 13 rad … _deg … --rotation", read, header, 10, -13, 0)
    assert len(read(header, 12, -12, 0).rotation) == 1  # two turns less a little


XYZW = np.array([[0.1, 0.2, 0.3, 0.0], [0.5, -0.5, 0.1, 0.0]])
XYZW[:, 3] = np.sqrt(1 - (XYZW**2).sum(1))
TRUE = Rotation.from_quat(XYZW).as_matrix()


def table(folder, header: str, values: np.ndarray, order="wxyz"):
    rows = "\n".join(",".join(["1", "2", "3", *(repr(float(v)) for v in row)]) for row in values)
    (folder / "t.csv").write_text(f"x_mm,y_mm,z_mm,{header}\n{rows}\n")
    return read_table(folder / "t.csv", "poses", order)


@pytest.mark.parametrize("header", ["qw,qx,qy,qz", "qx,qy,qz,qw", "qa_qw,qa_qx,qa_qy,qa_qz"])
def test_xyzw_is_the_order_in_which_columns_stand(tmp_path, header):
    prefix = "qa_" if "qa_" in header else ""
    found = table(tmp_path, header, XYZW, "xyzw")
    if prefix:
        found = table(tmp_path, header + ",qa_x_mm,qa_y_mm,qa_z_mm", np.hstack([XYZW, np.ones((2, 3))]), "xyzw")
    np.testing.assert_allclose(found.poses(prefix).rotation, TRUE, atol=1e-12)


def test_columns_hold_what_their_names_say_if_nothing_is_said(tmp_path):
    np.testing.assert_allclose(table(tmp_path, "qx,qy,qz,qw", XYZW).poses().rotation, TRUE, atol=1e-12)
    assert np.abs(table(tmp_path, "qw,qx,qy,qz", XYZW).poses().rotation - TRUE).max() > 0.5


def test_the_reading_of_x_y_z_w_is_what_the_option_does(tmp_path):
    read = table(tmp_path, "qw,qx,qy,qz", XYZW)
    np.testing.assert_allclose(LAST.rotations(read.poses().rotation), TRUE, atol=1e-12)
    right = table(tmp_path, "qw,qx,qy,qz", XYZW[:, [3, 0, 1, 2]], "xyzw")
    np.testing.assert_allclose(FIRST.rotations(right.poses().rotation), TRUE, atol=1e-12)
    assert "--quaternions xyzw" in LAST.remedy


@pytest.mark.parametrize("wrong", READINGS, ids=lambda each: each.held)
def test_the_reading_that_fits_is_found(wrong):
    rng = np.random.default_rng(3)
    true = Rotation.random(12, random_state=rng).as_matrix()
    held = np.swapaxes(true, 1, 2) if wrong.conjugated else true
    wxyz = Poses(held, np.zeros((12, 3))).quaternions()
    read = Poses.from_quaternions(wxyz[:, np.argsort(wrong.order)], np.zeros((12, 3))).rotation
    off = {each.held: np.abs(each.rotations(read) - true).max() for each in READINGS}
    assert [held for held in off if off[held] < 1e-9] == [wrong.held]


def test_half_turns_are_their_own_inverse():
    half = np.repeat(Rotation.from_rotvec([np.pi, 0, 0]).as_matrix()[None], 5, axis=0)
    np.testing.assert_allclose(INVERTED.rotations(half), half, atol=1e-12)
