"""Text files of trackers by a map of their columns."""

import numpy as np
import pytest

from stcal.io.join import join_tables
from stcal.io.poses.columns import read_mapped
from stcal.io.table import LENGTHS
from tests.outcome import fails_with

SA = """// SpatialAnalyzer export
Job: cell 4

Point Name\tX\tY\tZ\tTimestamp
p1\t39,37007874\t1,5\t-2\t10:01
p2\t0\t2,5\t3\t10:02
"""
MAP = """delimiter = "tab"
skip_lines = 2
decimal_comma = true
[columns]
image = "Point Name"
x_in = "X"
y_mm = "Y"
z_mm = 4
"""


def read(tmp_path, text=SA, columns=MAP):
    (tmp_path / "t.txt").write_text(text)
    (tmp_path / "map.toml").write_text(columns)
    return read_mapped(tmp_path / "t.txt", tmp_path / "map.toml", "data")


def test_names_units_and_lines(tmp_path):
    table = read(tmp_path)
    assert table.quantity("x", LENGTHS) == pytest.approx([1000.0, 0.0], abs=1e-5)
    np.testing.assert_array_equal(table.numbers("z_mm"), [-2, 3])
    assert table.text("image") == ["p1", "p2"]
    assert list(table.columns) == ["image", "x_in", "y_mm", "z_mm", "Timestamp"]
    assert list(table.lines) == [5, 6]


def test_without_a_header_and_by_spaces(tmp_path):
    text = "p1  1.5   2 3\n# a note\np2 4 5    6\n"
    columns = 'delimiter = "space"\nheader = false\n[columns]\nname = 1\nx_mm = 2\ny_mm = 3\nz_mm = 4\n'
    np.testing.assert_array_equal(read(tmp_path, text, columns).points(), [[1.5, 2, 3], [4, 5, 6]])


def test_joint_values_beside_it(tmp_path):
    read(tmp_path)
    (tmp_path / "joints.csv").write_text("image,q1_deg\np2,20\np1,10\n")
    table = join_tables(tmp_path / "joints.csv", tmp_path / "t.txt", "image", columns=tmp_path / "map.toml").table
    np.testing.assert_array_equal(table.numbers("q1_deg"), [20, 10])
    np.testing.assert_array_equal(table.numbers("y_mm"), [2.5, 1.5])


@pytest.mark.parametrize(
    ("text", "columns", "words"),
    [
        (SA, MAP.replace('"X"', '"East"'), "E-COLUMNS-FILE"),
        (SA, MAP.replace("= 4", "= 9"), "E-COLUMNS-FILE … 5"),
        (SA, MAP.replace("= 2", "= 20", 1), "E-TABLE-EMPTY … 20 … skip_lines"),
        (SA.replace("-2\t", "-2 "), MAP, "E-COLUMNS-FILE … 5 … 4 cells, 5 needed"),
        (SA, MAP.replace('"tab"', '"bar"'), "E-KEY-VALUE"),
        (SA, "[columns]\n", "E-KEY-VALUE"),
    ],
)
def test_mistakes_are_named(tmp_path, text, columns, words):
    with fails_with(words):
        read(tmp_path, text, columns)
