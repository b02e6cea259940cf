"""Figures as files."""

import pytest

from stcal.report.svg import new_figure, save
from tests.outcome import fails_with


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_a_figure_that_is_broken_off_leaves_the_earlier_one(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"plot{suffix}"
    path.write_text("earlier")
    figure = new_figure(2, 2)
    figure.subplots().plot([0, 1])

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        with fails_with("E-OUTPUT-UNWRITABLE … No space left"):
            save(figure, path)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "earlier"
    save(figure, path)
    assert path.stat().st_size > 1000
