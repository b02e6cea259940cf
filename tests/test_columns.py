"""Maps of columns for tables that stand beside images: each belongs to the option of its table."""

import sys
from decimal import Decimal

import pytest

from stcal.cli.main import main
from stcal.workflows.handeye.robot_at_images import Timing, _times_of_images
from tests.outcome import assert_error, ended

CALLS = {
    "handeye IMAGES --times-columns m.toml": "--image-times",
    "sfm measure IMAGES --camera c.txt --faces f.json --columns m.toml": "--joints",
    "sfm budget RUN --columns m.toml": "--check-lengths",
}


def test_times_of_images_are_read_by_their_columns(tmp_path):
    (tmp_path / "times.txt").write_text("exported\nfile\ttime\na.png\t12,25\nb.png\t13,5\n")
    (tmp_path / "m.toml").write_text(
        'delimiter = "tab"\nskip_lines = 1\ndecimal_comma = true\n[columns]\nimage = "file"\ntime_s = "time"\n'
    )
    timing = Timing(image_times=tmp_path / "times.txt", times_columns=tmp_path / "m.toml")
    assert _times_of_images(["1/a.png", "b.png"], timing) == {"1/a.png": Decimal("12.25"), "b.png": Decimal("13.5")}


@pytest.mark.parametrize("words", CALLS)
def test_a_map_of_columns_needs_its_table(monkeypatch, capsys, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.toml").write_text("")
    monkeypatch.setattr(sys, "argv", ["stcal", *words.split()])
    assert_error(ended(main, capsys), 2, "E-OPTION-NEEDS", "m.toml", CALLS[words])
