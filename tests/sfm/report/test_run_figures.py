"""Figures of residuals: what they show is in the run."""

import re

import numpy as np
import pytest

from stcal.sfm.report.run_figures import by_photograph, normalised_residuals, residual_field
from stcal.sfm.runs import folder


def words(drawing) -> list[str]:
    return re.findall(r">([^<]+)</text>", drawing.svg())


def test_residuals_over_their_sigma_are_of_a_normal_distribution(small_result, monkeypatch):
    """As in any adjustment with true σ. Circles that both groups show are counted as unknown in each, which makes the
    share of the redundancy smaller by up to a sixth, and the spread larger by up to a twelfth."""
    run, drawn = small_result.out, []
    monkeypatch.setattr(folder, "report_html", lambda report, overlays, residuals, gone: drawn.append(residuals) or "")
    folder._report_page(run, small_result.report)
    values = np.concatenate([*drawn[0].values()])[:, 4:]
    assert np.std(values) == pytest.approx(1.04, abs=0.06)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.1
    assert f"{values.size} coordinates, " in " ".join(words(normalised_residuals(values.ravel())))


def test_mean_residuals_stand_in_their_cells_with_their_number():
    """Twenty in one cell and four, too few to be drawn, in another."""
    one = np.tile([110.0, 70.0, 0.02, 0.0], (20, 1))
    seen = words(residual_field(np.vstack([one, np.tile([1000.0, 70.0, 5.0, 0.0], (4, 1))]), (1200, 800)))
    assert "20" in seen
    assert "4" not in seen
    assert any(text.startswith("0.02 px") for text in seen)


def test_the_worst_photograph_is_named():
    rows = [{"image": f"{i}.jpg", "rms_px": rms} for i, rms in enumerate((0.01, 0.05, 0.02))]
    assert [text for text in words(by_photograph(rows)) if text.endswith(".jpg")] == ["1.jpg"]
