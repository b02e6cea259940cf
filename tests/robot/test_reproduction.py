"""The published chain end to end, as the study runs it: photographs of the target on an arm, axes, model, positions."""

import numpy as np
import pytest

from tests.scripts import load_script


@pytest.fixture
def study(monkeypatch):
    module = load_script("reproduce_robot")
    monkeypatch.setattr(module, "VERIFIED", 15)
    monkeypatch.setattr(module, "POOL", 15)
    return module


@pytest.mark.full
def test_one_arm_is_calibrated_by_the_target_on_its_flange(study):
    draw = study.one_draw(3, 0, 0.0)
    shift = np.linalg.norm(draw.pose_error[:, 3:], axis=1)
    assert 0.02 < np.sqrt((shift**2).mean()) < 0.06  # 0.037 over 100 arms; each has a target of its own
    for kind in (study.REACH, study.TRUE):
        nominal, axes, cmmk = draw.sets[kind].values()
        assert 0.1 < nominal.mean_mm < 3  # 0.3 mm and 0.5 mrad at 2 m
        # At least the 70 % that are asked for. Of 100 arms: axes up to 0.4 mm, the model 0.0003 to 0.014 mm all over
        # the reach; none errs by less than a hundredth of the photographs' noise.
        assert 1e-3 < axes.mean_mm < 0.5
        assert 1e-4 < cmmk.mean_mm < min(0.03, 0.3 * nominal.mean_mm)
        assert cmmk.max_mm < axes.max_mm
    seen = draw.sets[study.CAMERA][study.CMMK]
    assert draw.sets[study.TRUE][study.CMMK].mean_mm < seen.mean_mm < 0.04  # the photographs' own errors
