"""The clocks' offset: found with true σ where the robot moves, refused where it stands."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.handeye.time_offset import TimeOffset, estimate_offset
from tests.outcome import fails_with, refuses
from tests.support.handeye import handeye, squared
from tests.support.handeye_stream import StreamTruth, simulated_stream

SETUPS = ("eye-in-hand", "eye-to-hand")


def found_of(truth: StreamTruth) -> TimeOffset:
    return estimate_offset(truth.pairs, truth.stream, truth.seconds, truth.setup)


def squares(truth: StreamTruth) -> tuple[float, float]:
    """Errors of the offset and of X (over six numbers), in units of σ²."""
    found = found_of(truth)
    pairs = replace(truth.pairs[np.flatnonzero(found.kept)], base_from_flange=found.base_from_flange)
    result = found.carried(handeye(pairs, truth.setup, "pose"))
    off_s = found.seconds - truth.offset_s
    return off_s**2 / found.sigma_s**2, squared(result, truth) / 6


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("offset_s", [0.023, -0.31])
def test_the_offset_is_found(setup, offset_s):
    """20 images of a robot at 150 mm/s and 0.15 mm of errors: some 0.2 ms."""
    found = found_of(simulated_stream(np.random.default_rng(4), 20, setup, offset_s))
    assert abs(found.seconds - offset_s) < 3 * found.sigma_s
    assert 5e-5 < found.sigma_s < 5e-4
    words = found.in_words()
    assert f"robot's is {'ahead of' if offset_s > 0 else 'behind'} the camera's" in words
    assert f"taken at t {'+' if offset_s > 0 else '-'} {1e3 * abs(found.seconds):.2f} ms of the robot's" in words


@pytest.mark.full
@pytest.mark.parametrize("setup", SETUPS)
def test_the_offset_knows_its_error(setup):
    """120 trials with σ estimated of 20 images: χ² of one number and of six, once in 10⁴ beyond, with a tail of t."""
    trials = 120
    found = np.mean(
        [squares(simulated_stream(np.random.default_rng([k, 5]), 20, setup)) for k in range(trials)], axis=0
    )
    for value, numbers in zip(found, (1, 6), strict=True):
        low, high = chi2.ppf([1e-4, 1 - 1e-4], numbers * trials) / (numbers * trials)
        assert 0.9 * low < value < 1.15 * high


@pytest.mark.parametrize("samples", [0.02, 0.1])
def test_a_robot_that_stands_still_is_said(samples):
    truth = simulated_stream(np.random.default_rng(5), 12, still=True, spacing_s=samples)
    far = np.abs(truth.seconds[:, None] - truth.seconds[None]) + 9 * np.eye(len(truth.seconds))
    alone = np.flatnonzero(far.min(1) > 0.6)
    with fails_with("E-TIME-OFFSET-STANDSTILL"):
        estimate_offset(truth.pairs[alone], truth.stream, truth.seconds[alone])


def test_what_does_not_do_is_said():
    truth = simulated_stream(np.random.default_rng(5), 8)
    refuses("E-TIME-OFFSET-FEW … 3 … 4", estimate_offset, truth.pairs[:3], truth.stream, truth.seconds[:3])
    refuses("E-TIME-OFFSET-RANGE … 0 … 8 … 67%", estimate_offset, truth.pairs, truth.stream, truth.seconds + 100)
