"""Figures as files."""

from stcal.report.svg import Drawing, save
from tests.outcome import fails_with


def test_a_figure_that_is_broken_off_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "plot.svg"
    path.write_text("earlier")

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        with fails_with("E-OUTPUT-UNWRITABLE … No space left"):
            save(Drawing(2, 2), path)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "earlier"
    save(Drawing(2, 2), path)
    assert path.read_text().startswith("<svg")


def test_other_forms_are_refused(tmp_path):
    with fails_with("E-OUTPUT-SUFFIX … plot.png … .svg"):
        save(Drawing(2, 2), tmp_path / "plot.png")
