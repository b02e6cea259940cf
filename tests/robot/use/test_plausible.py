"""Commanded poses and nominal robots that cannot be meant as they stand; and such as can."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import joint_vectors, made
from stcal.robot.use.compensation import compensate, on_targets, robots_apart
from tests.levels import sampled
from tests.outcome import refuses
from tests.support.arms import scara, targets

TOOL = Rigid.exp([0.2, -0.4, 0.1, 30, -20, 180])


def arm(seed: int, size: float = 1.0) -> Robot:
    rng, nominal = np.random.default_rng(seed), mh80()
    rows = (
        replace(r, a=r.a * size * rng.uniform(0.7, 1.3), d=r.d * size * rng.uniform(0.7, 1.3)) for r in nominal.rows
    )
    return replace(nominal, rows=tuple(rows), tools={"": TOOL})


def sliding(_: int) -> Robot:
    return replace(scara(), tools={"": TOOL})


def commanded(robot: Robot, count: int, seed: int, share: float = 0.6) -> tuple[np.ndarray, Poses]:
    q = joint_vectors(robot, count, np.random.default_rng(seed), share)
    return q, forward(robot, q)


def times(poses: Poses, factor: float) -> Poses:
    return Poses(poses.rotation, factor * poses.translation)


@pytest.mark.parametrize(
    ("make", "count", "share"),
    sampled([(make, *each) for make in (arm, sliding) for each in ((1, 0.02), (1, 0.6), (2, 0.02), (30, 0.6))], (0, 7)),
)
def test_good_targets_and_arms_as_made_pass(make, count, share):
    """Far apart and all near one another; with their own joint values, with others that choose a branch, with none."""
    for seed in range(3):
        nominal, rng = make(seed), np.random.default_rng([seed, count])
        q, poses = commanded(nominal, count, seed, share)
        assert on_targets(nominal, targets(poses, q)) == (True, ())
        assert on_targets(nominal, targets(poses)) == (False, ())
        on_targets(nominal, targets(poses, q + rng.normal(0, 0.3, q.shape)))
        on_targets(nominal, targets(poses, q + np.where(np.arange(q.shape[1]) == q.shape[1] - 1, np.pi, 0)))
        on_targets(nominal, targets(poses, np.zeros_like(q)))
        moved = replace(made(nominal, rng, 1.0, 2e-3), tools={"": Rigid()}, world_from_base=TOOL)
        assert robots_apart(moved, nominal) == ""


def test_one_orientation_fits_in_every_convention():
    """The tool points down in all rows, whatever the last joint's value is said to be."""
    nominal = arm(1)
    q, poses = commanded(nominal, 8, 1)
    down = np.repeat(Rotation.from_euler("xz", [180, 40], degrees=True).as_matrix()[None], 8, axis=0)
    _, notes = on_targets(nominal, targets(Poses(down, poses.translation), q))
    assert [note.split(",")[0] for note in notes] == ["joint values of 8 of 8 rows"]


def test_joint_values_that_lead_elsewhere_are_said():
    nominal = arm(2)
    q, poses = commanded(nominal, 6, 2)
    other = q.copy()
    other[3:] = commanded(nominal, 3, 9)[0]
    confirmed, notes = on_targets(nominal, targets(poses, other))
    assert not confirmed
    assert "joint values of 3 of 6 rows, first line 5, lead elsewhere than their poses, by" in notes[0]


@pytest.mark.parametrize(
    ("factor", "words", "count"), [(1e-3, "metres, call the columns x_m", 1), (1 / 25.4, "inches", 12)]
)
def test_targets_in_the_arms_foot_are_said(factor, words, count):
    for seed in range(4):
        nominal = arm(seed, 0.3 + 0.4 * seed)
        _, notes = on_targets(nominal, targets(times(commanded(nominal, count, seed)[1], factor)))
        assert len(notes) == 1
        assert "of the base's origin, where no arm works that reaches" in notes[0]
        assert words in notes[0]


def test_a_nominal_robot_of_another_arm_is_refused():
    nominal = arm(4)
    real = made(nominal, np.random.default_rng(4))
    q, poses = commanded(nominal, 3, 4)
    for given in (targets(poses, q), targets(poses), targets(None, q)):
        refuses("E-ROBOT-MISMATCH", compensate, real, given, arm(5))


def test_files_unusually_far_apart_are_said():
    """Zeros off by 1° in all joints: 2 % of the reach."""
    nominal = arm(4)
    off = replace(nominal, rows=tuple(replace(r, theta=r.theta + np.radians(1.0)) for r in nominal.rows))
    q, poses = commanded(nominal, 3, 4)
    notes = compensate(off, targets(poses, q), nominal).notes()
    assert "more than arms are off their drawing (1% of the reach): are both files of this robot?" in notes[0]
    real = made(nominal, np.random.default_rng(4))
    assert not any("apart" in note for note in compensate(real, targets(poses, q), nominal).notes())
