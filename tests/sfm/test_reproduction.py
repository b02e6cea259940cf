"""The published calibration in simulation, as its script runs it: one trial of small photographs, by all methods."""

import numpy as np
import pytest

from tests.scripts import load_script


@pytest.mark.slow
def test_a_trial_of_the_published_calibration(tmp_path, capsys):
    """2 megapixels: a part of the accuracy of 18, the same order of the methods."""
    study = load_script("reproduce_paper")
    found = study.trial(1, 1728, tmp_path)
    worst = {method: max(um for um, _ in each.faces.values()) for method, each in found.items()}
    # Eccentricity alone is tens of µm (58 to 88 at 18 megapixels); ours has σ of some µm here.
    assert worst[study.PAPER] > 25
    assert worst[study.MIXED] > 25
    assert worst[study.OURS] < 12
    ours = found[study.OURS]
    for face, (um, _) in ours.faces.items():
        assert um < 4 * ours.predicted_um[face]  # its square is a χ² of 3: once in ten thousand at 21
    design, true, spread = ours.board_um
    # Dots 5 µm off per axis: 5 √(8/π) = 8.0 µm in length, spread 5 √(3 − 8/π) = 3.4 µm; less after a rigid fit.
    assert 6 < design < 12
    assert 2 < spread < 5
    assert true < design
    study.print_tables([found])
    printed = capsys.readouterr().out
    assert "| 1 | 33.9 ± 12.6 |" in printed
    assert "| mean | 33.2 ± 13.6 |" in printed


def test_contour_centres_are_good_to_a_tenth_of_a_pixel():
    """An ellipse drawn sharp, thresholded half way: its own centre, to what pixels leave."""
    study = load_script("reproduce_paper")
    y, x = np.mgrid[:80, :90]
    shape = np.array([[14.0, 3.0], [3.0, 9.0]])
    unit = np.linalg.solve(shape, np.stack([x - 44.3, y - 38.7]).reshape(2, -1))
    grey = np.where(np.hypot(*unit) < 1, 200, 20).reshape(80, 90).astype(np.uint8)
    assert np.abs(study.contour_centre(grey, np.array([44.0, 39.0]), shape) - [44.3, 38.7]).max() < 0.15
    assert study.contour_centre(np.full((80, 90), 20, np.uint8), np.array([44.0, 39.0]), shape) is None
