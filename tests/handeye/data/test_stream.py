"""Poses by time: interpolated where samples are close, the nearest within a tolerance, and all else said."""

from decimal import Decimal

import numpy as np
import pytest

from stcal.geometry.rigid import Poses
from stcal.handeye.data.pose_content import PoseSide
from stcal.handeye.data.stream import Stream, stamps_of, taken_at, time_of
from stcal.workflows.handeye_inputs import Files, robot_at_images
from tests.outcome import refuses
from tests.support.handeye import disturbed
from tests.support.handeye_stream import trajectory

PHASE = np.array([[0.3, 1.1, 2.0], [0.1, 4.0, 5.0]])
EVERY = np.arange(0, 10, 0.05)
AT = np.random.default_rng(0).uniform(0.1, 9.9, 60)


def stream(times=EVERY, noise=(0.0, 0.0)) -> Stream:
    poses = disturbed(np.random.default_rng(1), trajectory(times, PHASE), *noise)
    return Stream.of([Decimal(repr(round(float(t), 6))) for t in times], poses, "robot.csv")


def test_a_cubic_meets_the_trajectory_by_samples_in_any_order_and_at_both_ends():
    """Of samples h = 50 ms apart it errs by at most 3/128 h⁴ |y⁗|: y⁗ = 80 mm · 1.3⁴ = 230 mm/s⁴ gives 34 nm, that of
    rotations by their changing axis too; lines between samples would err by h²/8 |ÿ| = 0.04 mm."""
    off = np.abs(stream().at(AT).difference(trajectory(AT, PHASE)))
    assert 1e-9 < off[:, 3:].max() < 4e-5
    assert off[:, :3].max() < 1e-6
    assert max(stream().rest()) < 1e-3
    order = np.random.default_rng(2).permutation(len(EVERY))
    times = [Decimal(repr(round(float(t), 6))) for t in EVERY[order]]
    found = Stream.of(times, trajectory(EVERY[order], PHASE), "robot.csv")
    ends = np.array([0.0, 0.02, 9.94, 9.95])
    assert np.abs(found.at(ends).difference(trajectory(ends, PHASE))).max() < 1e-4


def test_noise_of_samples_is_told():
    """196 samples that miss the cubic through their neighbours: σ to 5 %; lengths of three numbers, √3 σ."""
    turn, shift = stream(noise=(1e-4, 0.05)).rest()
    assert [turn, shift] == pytest.approx([np.sqrt(3) * 1e-4, np.sqrt(3) * 0.05], rel=0.2)


def test_what_is_taken_is_said():
    times = np.concatenate([EVERY[:100], EVERY[120:]])
    taken = taken_at(stream(times), np.array([0.05, 1.234, 4.96, 5.4, -0.015, 9.98, 12.0]), "abcdefg")
    assert taken.rows == [0, 1, 2, 4]
    why = dict(taken.left_out)
    assert list(why) == ["d", "f", "g"]
    for part in ("7 times in 180 samples of robot.csv", "1 at a sample", "1 interpolated", "2 by the nearest sample"):
        assert part in taken.said
    assert "3 left out" in taken.said
    assert why["d"] == (
        "in a gap of 1.05 s of robot.csv, 0.25 s allowed; the nearest sample is 0.45 s away, 0.02 s allowed "
        "(--time-tolerance)"
    )
    assert why["f"] == "0.03 s after the samples of robot.csv, 0.02 s allowed (--time-tolerance)"
    assert taken_at(stream(times), np.array([5.4]), "d", 0.5).rows == [0]
    nearest = taken.base_from_flange[3]
    assert np.abs(Poses.of([nearest]).difference(trajectory(np.zeros(1), PHASE))).max() < 1e-12


def test_names_that_are_times_and_streams_that_are_none():
    for names, times in (
        (["a/1689.25.png", "1690.png"], ["1689.25", "1690"]),
        (["1403636579763555584.png"], ["1403636579.763555584"]),
        (["1700000000", "1700000001"], ["1700000000", "1700000001"]),
    ):
        assert stamps_of(names) == [Decimal(time) for time in times]
    assert stamps_of(["01.png", "02.png"]) is None
    assert stamps_of(["1.5.png", "left.png"]) is None
    assert time_of("nan") is None
    for times, error in (([1], "E-TIMES-FEW … 1"), ([1, 2, 1], "E-TIMES-REPEATED … 1")):
        refuses(error, Stream.of, list(map(Decimal, times)), trajectory(np.array(times) * 1.0, PHASE), "robot.csv")


def test_more_images_than_samples():
    times = np.arange(5) * 0.1
    samples = trajectory(times, PHASE)
    places = tuple(f"line {k + 2}" for k in range(5))
    robot = PoseSide(samples, places, "", names=tuple(f"{t:.1f}" for t in times), where="robot.csv", timed=True)
    seconds = np.round(0.01 + 0.04 * np.arange(9), 2)
    at, left_out, _ = robot_at_images(robot, [f"{t:.2f}.png" for t in seconds], Files("images"))
    assert (len(at), at.names[-1], left_out) == (9, "0.33.png", ())
    assert np.abs(at.poses.difference(trajectory(seconds, PHASE))).max() < 0.01
