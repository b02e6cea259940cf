"""Data that leave much open: rows along a line, or over a surface, at one orientation."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.robot import inverse
from stcal.robot.identification.adjustment import State, tips
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import made, measured, placed
from tests.levels import sampled
from tests.outcome import fails_with
from tests.support.arms import TOOL, WORLD

DOWN = Rigid.exp([0, np.pi * 0.9, 0, 0, 0, 0]).rotation


def at_one_orientation(places: np.ndarray):
    """The arm as made, and what was measured where its flange is at (m, 3)."""
    rng = np.random.default_rng(0)
    true = placed(made(mh80(), rng), WORLD, {"": TOOL})
    found = inverse(true, Poses(np.tile(DOWN, (len(places), 1, 1)), places))
    assert found.usable.all()
    return true, measured(true, found.q, rng)


LINE = np.column_stack([np.linspace(1000, 1500, 200), np.linspace(-300, 300, 200), np.full(200, 800.0)])
X, Y = (each.ravel() for each in np.meshgrid(np.linspace(900, 1500, 12), np.linspace(-400, 400, 12)))
SURFACE = np.column_stack([X, Y, 700 + 30 * np.sin(X / 100)])


@pytest.mark.parametrize(
    ("places", "observe", "rank"),
    sampled(
        [(LINE, "pose", 25), (LINE, "position", 15), (SURFACE, "position", 24), (SURFACE, "distance", 18)], kept=(1, 3)
    ),
)
def test_partial_solves_whatever_is_seen(places, observe, rank):
    """Where it was measured, to the noise of 0.05 mm an axis; each direction that is not seen is listed once."""
    true, data = at_one_orientation(places)
    if observe != "pose":
        data = replace(data, rotations=None)
    found = identify(mh80(), data, IdentifyOptions(observe, folds=0, partial=True))
    assert found.rank == rank
    assert len(found.undetermined) == len(found.names) - found.rank - 6 * (observe == "distance")
    assert len(set(found.undetermined)) == len(found.undetermined)
    assert all(" (with " in name or name in found.names for name in found.undetermined)
    if observe == "position":
        tip = tips(State(true.chain(), dict(true.tools)), data.q, data.targets).translation
        own = tips(found.state, data.q, data.targets).translation
        assert np.sqrt(((own - tip) ** 2).sum(1).mean()) < 0.05


@pytest.mark.slow
def test_what_is_open_is_said_first():
    _, data = at_one_orientation(LINE)
    with fails_with("E-IDENTIFY-UNDETERMINED … 25 … 30 … --partial"):
        identify(mh80(), data, IdentifyOptions(folds=0))
