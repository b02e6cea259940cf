"""The study behind the figures of docs/accuracy: one trial of each of its methods."""

import pytest

from tests.scripts import load_script

METHODS = ("pose, camera as filed", "reprojection, camera as filed", "reprojection, camera solved for")


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_trial(method):
    """The square of six numbers of σ 1 is below 34 but once in 10⁵."""
    by_sigma, off_mm2 = load_script("handeye_study").camera_trial(method, "eye-to-hand", "camera ≈ robot", 1.0, 3)
    assert 0.1 < by_sigma < 34
    assert off_mm2 > 0
