"""The simulated experiment of Liu et al. (2017): what the table of docs/accuracy says, for one robot."""

import numpy as np
import pytest

from stcal.robot.kinematics.forward import forward
from tests.scripts import load_script


@pytest.fixture(scope="module")
def script():
    return load_script("reproduce_registration")


def test_the_simulation_is_what_it_says(script):
    rng = np.random.default_rng(0)
    cell = script.Cell.of(rng)
    true = cell.points(100, script.SMALL, 0.0, rng)
    assert np.abs(true.a - script.MIDDLE).max() <= script.SMALL / 2
    np.testing.assert_allclose(forward(cell.drawn, true.q).translation, true.a, atol=1e-6)
    np.testing.assert_allclose(cell.b_from_base @ forward(cell.real, true.q).translation, true.b, atol=1e-9)
    # drawn and made differ by tenths of a millimetre in every axis: a millimetre or two at the tool
    assert 0.1 < np.linalg.norm(true.b - cell.b_from_base @ true.a, axis=1).mean() < 5
    measured = cell.measured(100, script.SMALL, (0.3, 0.0), np.random.default_rng(1))
    again = cell.points(100, script.SMALL, 0.0, np.random.default_rng(1))
    off = np.linalg.norm(measured.b - again.b, axis=1)
    assert (off > 0.9).sum() == 30
    assert off.max() < script.OFF_MM[1] + 0.3


@pytest.mark.slow
def test_ours_beats_theirs_which_beats_their_least_squares_and_only_the_kinematics_hold_outside(script):
    """Mean errors in the cube of the fit and in the large one, mm, one point in ten wrong. The paper says three times
    their least squares; one robot of ours: at least 1.5 and at most 6."""
    errors = {name: [float(e.mean()) for e in errors] for name, errors in script.trial(1, script.SHOWN).items()}
    near, far = ({name: both[i] for name, both in errors.items()} for i in (0, 1))
    assert 1.5 < near[script.USUAL] / near[script.PAPER] < 6
    assert near[script.AFFINE] < near[script.PAPER] / 1.5
    assert near[script.TOGETHER] < near[script.PAPER] / 1.5
    assert near[script.FIELD] < near[script.RIGID]
    for name in (script.USUAL, script.PAPER, script.RIGID, script.AFFINE):
        assert far[name] > near[name]
    assert far[script.RIGID] > 1.3 * near[script.RIGID]
    assert far[script.TOGETHER] == min(far.values())
