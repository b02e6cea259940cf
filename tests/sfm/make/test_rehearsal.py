"""The whole chain with a target made by itself, as ``scripts/studies/own_target.py`` calls it."""

import json

import pytest

from tests.scripts import load_script


@pytest.mark.full
def test_a_made_target_is_simulated_calibrated_and_compared(tmp_path, monkeypatch, capsys):
    """Every circle named rightly, errors as the run states them; smaller images than the study's."""
    study = load_script("own_target")
    monkeypatch.setattr(study, "WIDTH", "1836")
    study.rehearse(tmp_path)
    said = capsys.readouterr().out
    assert "named with any 3 circles hidden: 600 of 600 cases" in said
    assert "labels: 0 wrong" in said
    faces = json.loads((tmp_path / "run" / "compare.json").read_text())["faces"]
    assert set(faces) == {"front", "right", "back", "left", "top"}
    over_sigma = [face["normalised_error"] for face in faces.values() if "normalised_error" in face]
    assert len(over_sigma) == 4
    # Six numbers of each face, of which those of one photograph's circles are correlated: some twelve by themselves.
    assert 0.4 < (sum(each**2 for each in over_sigma) / 4) ** 0.5 < 1.8
