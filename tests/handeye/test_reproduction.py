"""The published hand-eye experiment in simulation, as its script runs it: one seed, by all methods."""

import numpy as np
import pytest

from stcal.handeye import METHODS
from tests.scripts import load_script


@pytest.mark.slow
def test_a_seed(capsys):
    study = load_script("reproduce_handeye")
    found = study.trial(3)
    for method in METHODS:
        motions, (mm, rad) = found[method]
        assert motions.shape == (6, 2)
        # 0.1 mm, 0.3 mrad and 0.1 px: 0.1 to 0.5 mm; the convex method is worse, evolution as published random.
        assert mm < {"de": 200, "zhao": 10, "li": 3}.get(method, 1.5)
        assert method == "de" or rad < np.radians(0.2)
    ratios = found["ratios"]
    assert all(value == pytest.approx(1, rel=1e-6) for name, value in ratios.items() if name.endswith("polished"))
    # Where it ends depends on the last bits of sums, hence on the machine: the order alone holds for each seed.
    unknown, *drawing, closed = (ratio for name, ratio in ratios.items() if not name.endswith("polished"))
    assert unknown > max(drawing) > closed
    assert closed < 1.001
    study.print_tables([found])
    assert "| about the closed form: ±10°, ±20 mm |" in capsys.readouterr().out


@pytest.mark.slow
def test_a_trial():
    """The square of six numbers of σ 1 is below 34 but once in 10⁵."""
    trial, method = load_script("handeye_study").camera_trial, "reprojection, camera solved for"
    by_sigma, off_mm2 = trial(method, "eye-to-hand", "camera ≈ robot", 1.0, 3)
    assert 0.1 < by_sigma < 34
    assert off_mm2 > 0
