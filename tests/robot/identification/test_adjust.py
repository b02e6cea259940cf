"""Adjusting a part of the robot file: zero positions or geometry alone, and dimensions that the file calls fixed."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.robot.identification.identify import identify
from stcal.robot.identification.prior import adjusted, dh_values
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, measured, placed
from tests.outcome import refuses
from tests.support.arms import TOOL, WORLD, seen_arm

LENGTHS, ANGLES = [0, 2], [1, 3, 4]


def zeros_off():
    """An arm of which zero positions alone are off, by milliradians; the first one is in the base."""
    rng = np.random.default_rng(0)
    rows = [replace(row, theta=row.theta + (rng.normal(0, 3e-3) if i else 0)) for i, row in enumerate(mh80().rows)]
    true = placed(replace(mh80(), rows=tuple(rows)), WORLD, {"": TOOL})
    return true, measured(true, joint_vectors(true, 30, rng), rng)


@pytest.mark.slow
def test_zeros_alone_are_found_and_nothing_else_moves():
    true, data = zeros_off()
    found = identify(mh80(), data, IdentifyOptions(adjust="zeros"))
    change = dh_values(found.robot) - dh_values(mh80())
    assert np.abs(change[:, LENGTHS]).max() < 1e-3
    assert np.abs(change[:, [1, 4]]).max() < 1e-6
    # five σ of what 30 poses tell, 4 of them zeros that are seen apart from base and tool
    error = np.abs(dh_values(found.robot) - dh_values(true))[1:-1, 3]
    assert (error < 5 * found.dh_sigma[1:-1, 3]).all()
    assert found.rank == 6 + 6 + 4
    assert (found.dh_sigma[:, LENGTHS] == 0).all()


@pytest.mark.slow
def test_fewer_poses_do_for_zeros():
    """4 poses are 24 numbers: too few for 30 parameters, enough for 16."""
    data = zeros_off()[1][:4]
    with pytest.raises(Exception, match="24 numbers for 30 parameters"):
        identify(mh80(), data)
    assert identify(mh80(), data, IdentifyOptions(adjust="zeros", folds=0)).rank == 16


@pytest.mark.slow
def test_fixed_dimensions_stay_and_are_said(tmp_path):
    _, data = seen_arm(np.random.default_rng(2), 40)
    joints = list(mh80().joints)
    joints[1] = replace(joints[1], fixed={"a": "measured on a CMM"})
    (tmp_path / "robot.toml").write_text(robot_toml(replace(mh80(), joints=tuple(joints))))
    nominal = load_robot(tmp_path / "robot.toml")
    assert nominal.joints[1].fixed == {"a": "measured on a CMM"}
    found = identify(nominal, data)
    assert found.robot.rows[1].a == pytest.approx(mh80().rows[1].a, abs=1e-3)
    assert abs(identify(mh80(), data, IdentifyOptions(folds=0)).robot.rows[1].a - mh80().rows[1].a) > 0.01
    assert any("a of row 2 (measured on a CMM)" in note for note in found.notes)
    assert found.all_held_out is not None


def test_names_of_what_is_adjusted():
    for text in ("base,tool", "zeros", "geometry", "all"):
        assert adjusted(text) == text
    assert adjusted("tool, base") == "base,tool"
    assert adjusted("base,zeros") == "zeros"
    assert adjusted("zeros,geometry") == "all"
    refuses("E-OPTION-VALUE", adjusted, "lengths")
    refuses("E-OPTION-RANGE … 2", IdentifyOptions, model="auto", folds=0)
