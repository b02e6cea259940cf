"""The two poses of a plane: both are found, told apart in σ, and weighed by their odds."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from stcal.geometry import least_squares
from stcal.geometry.least_squares import Normal
from stcal.geometry.plane import covariance_of_both, deciding_delta, distinct, mirrored, two_minima, weigh
from stcal.geometry.rigid import Poses, Rigid
from tests.geometry import test_pose_descent
from tests.outcome import fails_with

XYZ = np.array([[x, y, 0.0] for x in (-30, -10, 10, 30) for y in (-20, 0, 20)])
SIGMA = 1e-4
MIDDLE = Rigid(np.eye(3), np.zeros(3))
seen = partial(test_pose_descent.seen, xyz=XYZ, scale=1.0)


def descend(measured, poses, huber):
    def evaluate(poses):
        xy, by_pose, possible = seen(poses)
        return Normal.of((measured - xy) / SIGMA, by_pose / SIGMA, possible, huber)

    return least_squares.descend(evaluate, poses, 1e-6)


def measured(truth, factor=1.0, seed=0):
    noise = np.random.default_rng(seed).normal(0, factor * SIGMA, (len(XYZ), 2))
    return seen(Poses.of([truth]))[0][0] + noise


def minima(truth, start, factor=1.0):
    return two_minima(lambda _: partial(descend, measured(truth, factor)), Poses.of([start]), MIDDLE, "no pose")


def tilted(angle_rad, away_mm):
    return Rigid.exp([0.0, angle_rad, 0.0, 3.0, -5.0, away_mm])


@pytest.mark.parametrize("side", [1, -1])
def test_both_minima_are_found_from_either(side):
    """25° and 2 m off: the second solution is mirrored at the line of sight, and worse by some χ²."""
    truth = tilted(0.44, 2000.0)
    start = truth if side > 0 else mirrored(Poses.of([truth]), MIDDLE)[0]
    found = minima(truth, start)
    assert len(found.minima.cost) == 2
    assert found.minima.cost[0] < found.minima.cost[1]
    assert found.robust_sigma == 1.0
    error = found.minima.poses[0].difference(truth)
    assert error @ found.minima.normal[0] @ error < 30  # χ² of 6 unknowns: once in 25 000
    second = found.minima.poses[1].difference(mirrored(Poses.of([truth]), MIDDLE)[0])
    assert np.linalg.norm(second[:3]) < 0.1


def test_a_near_plane_has_one():
    """25° at 100 mm, where perspective decides: one minimum, or a second one that is far worse."""
    cost = minima(tilted(0.44, 100.0), tilted(0.44, 100.0)).minima.cost
    assert len(cost) == 1 or cost[1] > cost[0] + 1e4


def test_minima_are_told_apart_by_the_residuals_own_sigma():
    """Residuals ten times what is stated: what is two by the stated σ is one by what the residuals say."""
    normal = np.diag([1e6] * 3 + [1.0] * 3)
    poses = Poses.of([Rigid.exp([0, 0, 0, 0, 0, 500.0]), Rigid.exp([0.005, 0, 0, 0, 0, 500.0])])  # 5 σ
    assert distinct(poses, normal)
    assert not distinct(poses, normal, robust_sigma=10.0)
    assert 5 < minima(tilted(0.44, 2000.0), tilted(0.44, 2000.0), factor=10.0).robust_sigma < 20


def test_mirrored_twice_is_where_it_was():
    poses = Poses.of([tilted(0.3, 700.0), tilted(-0.2, 300.0)])
    plane = Rigid.exp([0.1, 0.2, 0.3, 5.0, 6.0, 7.0])
    twice = mirrored(mirrored(poses, plane), plane)
    assert twice.rotation == pytest.approx(poses.rotation, abs=1e-12)
    assert twice.translation == pytest.approx(poses.translation, abs=1e-9)


def test_a_descent_that_does_not_settle_raises():
    def unsettled(poses, huber):
        found = descend(measured(tilted(0.1, 500.0)), poses, huber)
        return replace(found, settled=np.zeros(len(poses), bool))

    with fails_with("E-NO-MINIMUM"):
        two_minima(lambda _: unsettled, Poses.of([tilted(0.1, 500.0)]), MIDDLE, "no pose at all")


def test_odds():
    """Even odds put half a squared distance on the covariance; one in 10⁶ needs Δχ² 27.6, of residuals as stated."""
    away = np.array([0.1, 0, 0, 2.0, 0, 0])
    assert covariance_of_both(np.eye(6), away, 0.0) == pytest.approx(np.eye(6) + np.outer(away, away) / 2)
    assert covariance_of_both(np.eye(6), away, np.inf) == pytest.approx(np.eye(6))
    assert deciding_delta(1e-6, 1.0, 0.5) == pytest.approx(27.63, abs=0.01)
    assert deciding_delta(1e-6, 1.5, 4.0) == pytest.approx(4 * 27.63, abs=0.01)


def test_weighed_by_what_is_common():
    """A shift that all points share weighs nothing once it is in their covariance: χ² is of what is left of 2n − 6."""
    truth = tilted(0.44, 400.0)
    shifted = measured(truth) + 50 * SIGMA
    n = len(XYZ)
    common = np.tile(np.eye(2), (n, 1))
    covariance = SIGMA**2 * (np.eye(2 * n) + 2500 * common @ common.T)
    poses = Poses.of([truth])
    for _ in range(4):
        xy, by_pose, _ = seen(poses)
        found = weigh(shifted - xy, by_pose, covariance[None], poses)
        poses = found.poses
    assert found.moved2[0] < 1e-12
    assert 5 < found.chi2[0] < 45  # χ² of 18: once in 2000 on either side
    assert found.residual.shape == (1, n, 2)
