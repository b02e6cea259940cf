"""Orientations in another convention than their columns say are refused with what they are."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.identification.start import start
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.levels import sampled
from tests.outcome import fails_with, refuses
from tests.robot.identification.test_solve import simulated

LAST = "quaternions were x, y, z, w in the order of their columns"


def seen(seed: int, count: int, targets=("",)):
    return simulated(seed, count, targets=targets)[1]


def in_order(data, order, conjugated=False):
    """The file as it is read when its quaternion columns hold other components than they say."""
    wxyz = data.poses().quaternions() * ([1, -1, -1, -1] if conjugated else [1, 1, 1, 1])
    return replace(data, rotations=Poses.from_quaternions(wxyz[:, order], data.points()).rotation)


@pytest.mark.parametrize(
    ("order", "conjugated", "said"),
    [
        ([1, 2, 3, 0], False, f"if {LAST}; give --quaternions xyzw"),
        ([0, 1, 2, 3], True, "conjugated (the first frame seen from the second); change the sign of qw"),
        ([1, 2, 3, 0], True, f"if {LAST}, and conjugated; give --quaternions xyzw and change the sign of qw"),
    ],
)
def test_another_convention_is_named(order, conjugated, said):
    data = seen(8, 8, ("a", "b"))
    start(mh80(), data)
    with fails_with("E-ROBOT-ORIENTATIONS") as caught:
        start(mh80(), in_order(data, order, conjugated))
    assert str(caught.value).endswith(said)


def test_orientations_that_no_convention_mends_are_left_to_the_adjustment():
    """One orientation in all rows, whatever the joints do."""
    data = seen(1, 20)
    still = np.tile(Rigid.exp([0.4, -0.3, 0.9, 0, 0, 0]).rotation, (20, 1, 1))
    start(mh80(), replace(data, rotations=still))


def turned(*quarters):
    """The robot with quarters of a turn added to theta of its rows."""
    rows = zip(mh80().rows, quarters, strict=True)
    return replace(mh80(), rows=tuple(replace(row, theta=row.theta + k * np.pi / 2) for row, k in rows))


WITH_ZERO = turned(0, 0, 0, -1, 0, 0)


def as_it_is(q: np.ndarray) -> np.ndarray:
    return q


@pytest.mark.parametrize(
    ("mistaken", "change", "wrong", "named"),
    [
        (mh80(), as_it_is, [3, 20, 31], "lines 5, 22, 33 were not there … remove them"),
        *sampled(
            [
                (replace(mh80(), convention="modified"), as_it_is, [], "standard convention"),
                (WITH_ZERO, as_it_is, [3, 20], "theta of joint 4 … +90° … lines 5, 22 were not there"),
                # joint 1 is square to joint 2: half a turn of the one's zero is the opposite sign of the other
                (turned(0, 0, 0, 2, 0, 0), as_it_is, [], "or if"),
                (mh80(), lambda q: q[:, [0, 2, 1, 3, 4, 5]], [], "columns q2 and q3 were exchanged"),
                (mh80(), lambda q: np.roll(q, 1, axis=0), [], "one row further up"),
                (mh80(), lambda q: np.roll(q, -1, axis=0), [], "one row further down"),
                (mh80(), lambda q: q - q[:, [1]] * [0, 0, 1, 0, 0, 0], [], "joint 3 were coupled to joint 2 by +1"),
            ],
            kept=(1, 2, 4),
        ),
    ],
)
def test_mistakes_are_named(mistaken, change, wrong, named):
    data = replace(seen(6, 40), rotations=None)
    positions = np.array(data.positions)
    positions[wrong] += np.random.default_rng(0).normal(0, 600.0, (len(wrong), 3))
    refuses(f"E-IDENTIFY-MISFIT … {named}", start, mistaken, replace(data, q=change(data.q), positions=positions))


def test_orientations_that_are_not_the_robots_are_refused_though_positions_fit():
    rng = np.random.default_rng(4)
    robot = mh80()
    data = measured(robot, joint_vectors(robot, 30, rng), rng)
    rotations, said = Rotation.random(30, rng), "check the convention of the angles"
    refuses(f"E-ROBOT-ORIENTATIONS … {said}", start, robot, replace(data, rotations=rotations.as_matrix()))
    third = np.where((np.arange(30) % 3 == 0)[:, None, None], rotations.as_matrix(), data.rotations)
    start(robot, replace(data, rotations=third))  # the fit gives such rows no weight


def test_an_instrument_that_moved_far_is_refused_with_the_column_that_mends_it():
    data = replace(seen(2, 40), rotations=None)
    positions = data.positions.copy()
    positions[12:] = Rigid.exp([0.3, -0.2, 1.0, 1500, -900, 400]) @ positions[12:]
    refuses("E-IDENTIFY-MISFIT … moved … column station or target", start, mh80(), replace(data, positions=positions))


def test_a_target_that_slipped_far_is_named_before_parameters_that_stay_open():
    rng = np.random.default_rng(1)
    true = placed(
        made(mh80(), rng), Rigid.exp([0.1, -0.05, 2.1, 2500, -900, 400]), {"": Rigid.exp([0, 0.1, 0, 220, 60, 150])}
    )
    slipped = replace(true, tools={"": Rigid.exp([0.2, 0.1, 0.4, 120, 160, 180])})
    q = joint_vectors(true, 60, rng)
    parts = [measured(robot, q[rows], rng) for robot, rows in ((true, slice(30)), (slipped, slice(30, 60)))]
    positions = np.vstack([part.positions for part in parts])
    data = Measurements.from_arrays(q, positions)
    with fails_with("E-IDENTIFY-UNDETERMINED … the target elsewhere on its flange from line 31 on … column target"):
        identify(mh80(), data, IdentifyOptions(folds=0))
