"""Variance components against closed forms of the textbook."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.adjust.components import Components, Equations
from stcal.robot.identification.problem import MOST_BENT, Bent, Relaxation, Spread


def regression(
    rng: np.random.Generator, rows: int, width: int = 4, groups: int = 0, sigma: float = 1.0, tau: float = 1.0
):
    """A linear model of ``width`` parameters, the last ``groups`` of them drawn with ``tau`` about 0; about zero."""
    design = rng.normal(size=(rows, width))
    drawn = rng.normal(size=width) * tau * (np.arange(width) >= width - groups)
    seen = design @ drawn + rng.normal(size=rows) * sigma
    each, doubt = [Equations.of(seen, -design)], [np.inf]
    if groups:
        mine = np.diag((np.arange(width) >= width - groups).astype(float))
        each, doubt = [*each, replace(Equations.of(np.zeros(width), mine), count=groups)], [np.inf, 1.0]
    fixed = Equations.of(np.zeros(width), 1e-6 * np.eye(width))
    far = np.full(len(each), 3.0)
    return Spread(Components(each, fixed, 0.0, np.array(doubt)), -far, far, np.ones(width)), design, seen, drawn


@pytest.mark.parametrize("rows", [14, 24, 104])
def test_one_sigma_is_that_of_least_squares_and_the_covariance_that_of_t(rows):
    parts, design, seen, _ = regression(np.random.default_rng(rows), rows)
    freedom = rows - 4
    left = np.linalg.lstsq(design, seen, rcond=None)[1][0]
    best = parts.best()
    assert np.exp(2 * best[0]) == pytest.approx(left / freedom, rel=1e-6)
    wanted = left / (freedom - 2) * np.linalg.inv(design.T @ design)  # of a t distribution with so many degrees
    # three nodes are exact to the fourth order of the spread of log σ, 1 / √(2 · freedom)
    assert parts.covariance(best) == pytest.approx(wanted, rel=3 / freedom**2 + 1e-3)


@pytest.mark.slow
def test_of_several_parts_the_covariance_is_true_on_average():
    error = []
    for seed in range(400):
        parts, _, _, drawn = regression(np.random.default_rng(seed), 30, 10, 6, 1.0, 0.6)
        best = parts.best()
        step = parts.parts.at(best)[2]
        away = step - drawn
        error.append(away @ np.linalg.solve(parts.covariance(best), away) / 10)
    # With the σ taken for known it is 1.18. Three standard errors of the mean of 400 draws:
    assert np.mean(error) == pytest.approx(1, abs=0.1)


def test_parts_without_noise_do_not_break_it():
    design = np.random.default_rng(3).normal(size=(20, 3))
    exact = design @ [1.0, 2.0, 3.0]
    parts = Components([Equations.of(exact, -design)], Equations.nothing(3), 0.0, np.array([np.inf]))
    parts = Spread(parts, np.array([-2.0]), np.array([3.0]), np.ones(3))
    best = parts.best()
    assert best == pytest.approx([-2.0])
    assert np.isfinite(parts.covariance(best)).all()


@pytest.mark.parametrize("slope", [-2.5, -0.5, 0.9])
def test_steps_that_overshoot_are_shortened(slope):
    """Of an iteration x → slope · x the first wanted step is (slope - 1) x; at -2.5 whole steps lead away for ever."""
    relaxation, x = Relaxation(), np.array([1.0, -2.0])
    for _ in range(30):
        x = x + relaxation.step((slope - 1) * x)
    assert np.abs(x).max() < 0.1 * max(slope, 0) ** 30 * 20 + 1e-6


def test_second_derivatives_leave_a_minimum():
    """They are as they are where they take little, and are cut off where they would make a saddle."""
    root = np.random.default_rng(0).normal(size=(4, 4)) * [1, 10, 100, 1000]
    normal, share = root @ root.T, np.array([-1.0, 0.1, 0.5, 2.0])
    little = (root * np.minimum(share, 0.5)) @ root.T
    assert Bent.of(normal, little).taken() == pytest.approx(little, rel=1e-6)
    bent = Bent.of(normal, (root * share) @ root.T)
    left = (root * [2.0, 0.9, 0.5, 1 - MOST_BENT]) @ root.T
    assert normal - bent.taken() == pytest.approx(left, rel=1e-6)
    assert bent.bends().T @ normal @ bent.bends() == pytest.approx(left, rel=1e-6)
