"""The published calibration in simulation, as its script runs it: one trial of small photographs, by all methods."""

import pytest

from tests.scripts import load_script


@pytest.mark.full
def test_a_trial_of_the_published_calibration(tmp_path, capsys):
    """2 megapixels: a part of the accuracy of 18, the same order of the methods."""
    study = load_script("reproduce_paper")
    found = study.trial(1, 1728, tmp_path)
    worst = {method: max(um for um, _ in each.faces.values()) for method, each in found.items()}
    # Eccentricity alone is tens of µm (58 to 88 at 18 megapixels); ours has σ of some µm here, and single groups with
    # three-point frames, which lack the other groups and circles, of up to three times that.
    assert worst[study.PAPER] > 25
    assert worst["+ centres of blurred edges"] > 25
    assert worst["+ eccentricity"] < 36
    assert worst["+ weights"] < 36
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
