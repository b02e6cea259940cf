"""Columns of quaternions that hold something else than they say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses
from stcal.io.rotations import FIRST, INVERTED, LAST, READINGS
from stcal.io.table import read_table

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
