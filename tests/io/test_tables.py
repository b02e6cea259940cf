"""Tables of other programs: separators, decimal commas, units in brackets, SpatialAnalyzer."""

from pathlib import Path

import numpy as np
import pytest

import stcal
from stcal.io.join import join_tables
from stcal.io.table import COVARIANCE, LENGTHS, csv_rows, csv_text, read_table
from tests.outcome import fails_with, refuses

POINTS = np.array([[-594.288, -1.155, 162.397], [1616.584, -790.796, 506.870], [0.125, 2.0, -3.5]])


def table(tmp_path, text, name="t.csv"):
    (tmp_path / name).write_text(text, encoding="utf-8")
    return read_table(tmp_path / name, "data")


def lines(separator, comma=False):
    rows = [separator.join([f"P{i}", *(f"{v:.3f}" for v in row)]) for i, row in enumerate(POINTS)]
    return "\n".join(rows).replace(".", "," if comma else ".")


@pytest.mark.parametrize("separator", [";", "\t", " "])
@pytest.mark.parametrize("comma", [False, True])
def test_separators_and_decimal_commas(tmp_path, separator, comma):
    head = separator.join(["name", "x_mm", "y_mm", "z_mm"])
    found = table(tmp_path, f"// a comment\n{head}\n{lines(separator, comma)}\n")
    np.testing.assert_array_equal(found.points(), POINTS)
    assert found.text("name") == ["P0", "P1", "P2"]
    assert list(found.lines) == [3, 4, 5]
    assert ("decimal commas" in found.form) == comma


@pytest.mark.parametrize(
    "head",
    [
        "name;X [mm];Y [mm];Z [mm]",
        "name;X_mm;Y_MM;z_mm",
        "name;x (mm);y(mm);z (MM)",
        "name;X/mm;Y/mm;Z/mm",
        "name;X;Y;Z;",
        "name;X (millimeters);Y (Millimetres);Z [millimeter]",
    ],
)
@pytest.mark.parametrize("separator", [";", ","])
def test_names_of_columns(tmp_path, head, separator):
    end = ";" if head.endswith(";") else ""
    rows = lines(";").replace("\n", f"{end}\n")
    text = f"# Units: Millimeters\nsep=;\n{head}\n{rows}{end}\n".replace(";", separator)
    np.testing.assert_array_equal(table(tmp_path, text).points(), POINTS)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("a;b\n1,5;2.5\n", "E-TABLE-DECIMAL … 1,5 beside 2.5"),
        ("a\tb\n594,288\t1,155\n-2,000\t3\n", "E-TABLE-DECIMAL … 594,288"),  # of thousands as well
        ("a;b\n1;2\n3\n", "E-TABLE-CELLS … line 3"),  # no other separator
        ("PT0;10.5;2000.25;-3.125;0;0;1\nPT1;11.5;2000.25;-3.5;0;0;1\n", "E-TABLE-HEADER … line 1 … numbers"),
        ("My measurement\nname,x_mm,y_mm\nA,1,2\n", "E-TABLE-HEADER … line 1 … no header"),
        ("P1 1.5 2.5 3.5\nP2 4 5 6\n", "E-TABLE-HEADER … line 1"),
        (f"{','.join(f'c{i}' for i in range(2001))}\n", "E-TABLE-HEADER … line 1 … 2001 columns … 2000"),
    ],
)
def test_what_is_no_table_is_said(tmp_path, text, error):
    refuses(error, table, tmp_path, text)


def test_cells_that_stay_as_they_are(tmp_path):
    """Text that holds commas, the case of turned axes; one number shows what a comma is."""
    assert table(tmp_path, "a;b\nx, y;1\n1,5;2\n").text("a") == ["x, y", "1,5"]
    assert list(table(tmp_path, "euler_ZYX_1_deg,X_mm,QW\n1,2,3\n").columns) == ["euler_ZYX_1_deg", "x_mm", "qw"]
    np.testing.assert_array_equal(table(tmp_path, "a\tb\n594,288\t0,155\n").numbers("a"), [594.288])


@pytest.mark.parametrize(
    ("separator", "comma", "unit", "factor"),
    [
        (" ", False, "units mm", 1),
        (", ", False, "Units: Inches", 25.4),
        (";", True, "Units: meters", 1000),
        ("  ", True, "Units: mm", 1),
        (",", False, "units mm", 1),
    ],
)
def test_points_of_spatial_analyzer(tmp_path, separator, comma, unit, factor):
    rows = [separator.join([f"A::Main group::P {i}", *(f"{v:.4f}" for v in row)]) for i, row in enumerate(POINTS)]
    text = "\n".join(rows).replace(".", "," if comma else ".")
    found = table(tmp_path, f"// SA 2021.1  Frame: World\n// {unit}\n{text}\n")
    np.testing.assert_allclose(found.points(), factor * POINTS, rtol=1e-15)
    assert found.text("name")[1] == "A::Main group::P 1"
    assert (found.text("group")[0], found.text("target")[2]) == ("Main group", "P 2")


@pytest.mark.parametrize(
    ("comment", "axis"),
    [
        ("// Units in mm", "x_mm"),
        ("// units are in millimetres, deg", "x_mm"),
        ("# Unit: in", "x_in"),
        ("// Length units = m", "x_m"),
        ("// Units in deg", "X"),
        ("// a unit in the workshop", "X"),
        ("// Units mm // units m", "X"),  # two are none
    ],
)
def test_what_comments_say_of_units(tmp_path, comment, axis):
    assert next(iter(table(tmp_path, f"{comment}\nX;Y\n1,5;2\n").columns)) == axis


def test_a_unit_that_nothing_states_is_asked_for(tmp_path):
    with fails_with("E-TABLE-COLUMN-MISSING … X … open … x_mm …"):
        table(tmp_path, "Point Name;X;Y;Z\np0;1,5;2,5;3,5\n").quantity("x", LENGTHS)


def test_key_columns_of_two_names(tmp_path):
    (tmp_path / "a.csv").write_text("image,q1_deg\np2,20\np1,10\n")
    (tmp_path / "b.csv").write_text("Point Name;X [mm]\np1;1,5\np2;2,5\n")
    found = join_tables(tmp_path / "a.csv", tmp_path / "b.csv", "image=Point Name").table
    np.testing.assert_array_equal(found.numbers("x_mm"), [2.5, 1.5])
    with fails_with("E-TABLE-COLUMN-MISSING … b.csv … image … image=NAME"):
        join_tables(tmp_path / "a.csv", tmp_path / "b.csv", "image")


@pytest.mark.parametrize("units", ["mm", "[mm]", "(mm)", " mm "])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_row_of_units_below_the_header(tmp_path, units, separator):
    text = f"name,x,y,z\n,{units},{units},{units}\nA,1.5,2,3\nB,4,5,6\n".replace(",", separator)
    np.testing.assert_array_equal(table(tmp_path, text).points(), [[1.5, 2, 3], [4, 5, 6]])


def test_a_covariance_is_whole_or_there_is_none(tmp_path):
    given = [f"tool_{name}" for name in COVARIANCE if name != "cov_ry_z"]
    found = table(tmp_path, ",".join(given) + "\n" + ",".join(["1"] * len(given)) + "\n")
    refuses("E-TABLE-COLUMN-MISSING … tool_cov_ry_z", found.pose_covariances, "tool_")
    assert found.pose_covariances("other_") is None


def test_names_that_a_spreadsheet_would_run_are_guarded_and_read_back(tmp_path):
    """CWE-1236; figures stay figures."""
    names = ["=1+11/a.jpg", "+a", "-b", "@c", "'=d", "'e", "f"]
    text = csv_text([["image", "=x"], *([name, "-0.5"] for name in names)])
    assert [line.split(",") for line in text.splitlines()[1:3]] == [["'=1+11/a.jpg", "-0.5"], ["'+a", "-0.5"]]
    assert [row["image"] for row in csv_rows(text)] == names
    assert {row["=x"] for row in csv_rows(text)} == {"-0.5"}
    with pytest.raises(ValueError, match="field larger"):
        list(csv_rows("image\n" + "1" * 200_000))
    assert list(read_table(table(tmp_path, text), "t").text("image")) == names


def test_no_other_place_writes_csv():
    package = Path(stcal.__file__).parent
    found = {path for path in package.rglob("*.py") if "csv.writer(" in path.read_text(encoding="utf-8")}
    assert found == {package / "io" / "table.py"}
