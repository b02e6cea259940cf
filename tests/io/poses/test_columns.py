"""Rotations in columns: the conventions of controllers by their own formulas, and which names leave them open."""

import numpy as np
import pytest

from stcal.io.rotations import read_rotations
from stcal.io.table import Table
from tests.outcome import fails_with


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
    with fails_with(words):
        read(header, 10, 20, 30)
    assert read(header.rpartition(",")[0], 10, 20) is None


@pytest.mark.parametrize("header", ["roll_rad,pitch_rad,yaw_rad", "rotvec_x_rad,rotvec_y_rad,rotvec_z_rad"])
def test_degrees_that_are_called_radians(header):
    with fails_with("E-ANGLE-UNIT … 13 rad … _deg … --rotation"):
        read(header, 10, -13, 0)
    assert len(read(header, 12, -12, 0).rotation) == 1  # two turns less a little
