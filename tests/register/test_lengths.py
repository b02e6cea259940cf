"""Frames of different scale, skewed and mirrored ones, and points too few: named for what they are."""

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.register import register

B_FROM_A = Rigid.exp([0.3, -0.2, 0.5, 100, 50, -30])
SIGMA_MM = 0.05


def points(count=80, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(-300, 300, (count, 3))
    return a, B_FROM_A @ a, rng.normal(0, SIGMA_MM, (count, 3))


@pytest.mark.parametrize("scale", [1.5, 1.002, 0.99809, 1.0002])
def test_another_scale_is_named_with_its_sigma(scale):
    a, b, noise = points()
    notes = register(a, scale * b + noise).notes
    (note,) = notes  # neither bent nor in a plane
    found, sigma = (float(note.split()[at]) for at in (4, 6))
    # σ of a scale: of a coordinate over the root of the square sum of the coordinates about their mean.
    assert sigma == pytest.approx(SIGMA_MM / np.sqrt(((a - a.mean(0)) ** 2).sum()), rel=0.3)
    assert abs(found - scale) < 4 * sigma
    assert "use --model similarity" in note
    assert register(a, scale * b + noise, model="similarity").notes == ()


def test_an_axis_that_is_scaled_is_told_from_a_scale():
    a, b, noise = points()
    (note,) = register(a, (b - b.mean(0)) * [1.0, 1.0, 1.01] + noise).notes
    assert "lengths in b are 1.01" in note
    assert "along three axes" in note


def test_a_bend_is_still_said_beside_a_scale():
    a, b, noise = points(300)
    bent = 2.0 * np.sin(a[:, [1, 2, 0]] / 60.0)
    notes = register(a, 1.01 * b + bent + noise).notes
    assert any("lengths in b" in note for note in notes)
    assert any("the frames are bent" in note for note in notes)


def test_equal_frames_are_not_bent():
    a, b, _ = points()
    assert register(a, a).notes == ()
    assert register(a, b).notes == ()
