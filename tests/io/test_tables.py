"""Tables of other programs: separators, decimal commas, units in brackets, SpatialAnalyzer, COLMAP's lines of images;
rotations in columns, by the controllers' own formulas, and false quaternions; tables of two commands as one."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import stcal
from stcal import register
from stcal.cli.main import app
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.join import join_tables, stack_tables
from stcal.io.rotations import FIRST, INVERTED, LAST, READINGS, read_rotations
from stcal.io.static_transforms import image_lines
from stcal.io.table import COVARIANCE, LENGTHS, Table, csv_rows, csv_text, read_table
from stcal.register.registered import read_pairs
from tests.outcome import fails_with, refuses
from tests.shared import written

POINTS = np.array([[-594.288, -1.155, 162.397], [1616.584, -790.796, 506.870], [0.125, 2.0, -3.5]])


def table(tmp_path, text, order="wxyz"):
    return read_table(written(tmp_path / "t.csv", text), "data", order)


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


def test_a_unit_that_nothing_states_is_asked_for_and_a_covariance_is_whole_or_there_is_none(tmp_path):
    with fails_with("E-TABLE-COLUMN-MISSING … X … open … x_mm …"):
        table(tmp_path, "Point Name;X;Y;Z\np0;1,5;2,5;3,5\n").quantity("x", LENGTHS)
    given = [f"tool_{name}" for name in COVARIANCE if name != "cov_ry_z"]
    found = table(tmp_path, ",".join(given) + "\n" + ",".join(["1"] * len(given)) + "\n")
    refuses("E-TABLE-COLUMN-MISSING … tool_cov_ry_z", found.pose_covariances, "tool_")
    assert found.pose_covariances("other_") is None


def test_key_columns_of_two_names_and_pairs_of_two_files(tmp_path):
    a = written(tmp_path / "a.csv", "image,q1_deg\np2,20\np1,10\n")
    b = written(tmp_path / "b.csv", "Point Name;X [mm]\np1;1,5\np2;2,5\n")
    np.testing.assert_array_equal(join_tables(a, b, "image=Point Name").table.numbers("x_mm"), [2.5, 1.5])
    refuses("E-TABLE-COLUMN-MISSING … b.csv … image … image=NAME", join_tables, a, b, "image")
    a = written(tmp_path / "c.csv", "name,x_mm,y_mm,z_mm\np1,1,2,3\np2,4,5,6\np9,0,0,0\n")
    b = written(tmp_path / "d.csv", "P;x_m;y_m;z_m\np2;1;1;1\np1;2;2;2\n")
    pairs = register.read_pairs(a, b, key="name=P")
    assert np.allclose(pairs.xyz_a, [[1, 2, 3], [4, 5, 6]])
    assert np.allclose(pairs.xyz_b, [[2000] * 3, [1000] * 3])
    assert pairs.notes == (f"1 rows of {a} have no partner: name p9",)
    table = stcal.load_table(b)
    joined = stcal.join_tables(a, table, "name=P", ("a", "b"))
    assert np.array_equal(register.read_pairs(joined.table).xyz_b, pairs.xyz_b)
    both = stcal.stack_tables([table, table], ["first", "second"])
    assert both.text("set") == ["first", "first", "second", "second"]


@pytest.mark.parametrize("units", ["mm", "[mm]", "(mm)", " mm "])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_row_of_units_below_the_header(tmp_path, units, separator):
    text = f"name,x,y,z\n,{units},{units},{units}\nA,1.5,2,3\nB,4,5,6\n".replace(",", separator)
    np.testing.assert_array_equal(table(tmp_path, text).points(), [[1.5, 2, 3], [4, 5, 6]])


def test_names_that_a_spreadsheet_would_run_are_guarded_in_the_one_place_that_writes_csv(tmp_path):
    """CWE-1236; figures stay figures."""
    names = ["=1+11/a.jpg", "+a", "-b", "@c", "'=d", "'e", "f"]
    text = csv_text([["image", "=x"], *([name, "-0.5"] for name in names)])
    assert [line.split(",") for line in text.splitlines()[1:3]] == [["'=1+11/a.jpg", "-0.5"], ["'+a", "-0.5"]]
    assert [row["image"] for row in csv_rows(text)] == names
    assert {row["=x"] for row in csv_rows(text)} == {"-0.5"}
    with pytest.raises(ValueError, match="field larger"):
        list(csv_rows("image\n" + "1" * 200_000))
    assert list(read_table(table(tmp_path, text), "t").text("image")) == names
    package = Path(stcal.__file__).parent
    found = {path for path in package.rglob("*.py") if "csv.writer(" in path.read_text(encoding="utf-8")}
    assert found == {package / "io" / "table.py"}


def about(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = c
    turn[i, j], turn[j, i] = -s, s
    return turn


def read(header: str, *values: float, rotation: str | None = None):
    columns = {name: np.array([value]) for name, value in zip(header.split(","), values, strict=True)}
    return read_rotations(Table("table", columns, [2]), rotation=rotation)


FANUC = about("z", 30) @ about("y", 20) @ about("x", 10)
"""Rz(R) Ry(P) Rx(W), FANUC's and Yaskawa's manuals; Rz(A) Ry(B) Rx(C), KUKA's."""


@pytest.mark.parametrize(
    ("header", "values", "rotation", "expected"),
    [
        ("w_deg,p_deg,r_deg", (10, 20, 30), None, FANUC),
        ("W_DEG,P_DEG,R_DEG", (10, 20, 30), "yaskawa", FANUC),
        ("a_deg,b_deg,c_deg", (30, 20, 10), None, FANUC),
        ("a_deg,b_deg,c_deg", (10, 20, 30), "mitsubishi-abc", FANUC),
        ("roll_deg,pitch_deg,yaw_deg", (10, 20, 30), None, FANUC),
        ("rpy_roll_rad,rpy_pitch_rad,rpy_yaw_rad", np.radians([10, 20, 30]), None, FANUC),
        ("o_deg,a_deg,t_deg", (10, 20, 30), None, about("z", 10) @ about("y", 20) @ about("z", 30)),
        ("rx_deg,ry_deg,rz_deg", (10, 20, 30), "yaskawa", FANUC),
        ("rx_deg,ry_deg,rz_deg", (10, 20, 30), "staubli", about("x", 10) @ about("y", 20) @ about("z", 30)),
        ("rx,ry,rz", (100, 20, 30), "ZYX", about("z", 30) @ about("y", 20) @ about("x", 100)),
        ("rx_rad,ry_rad,rz_rad", (0, 0, np.radians(40)), None, about("z", 40)),
        ("rotvec_x_deg,rotvec_y_deg,rotvec_z_deg", (0, -40, 0), None, about("y", -40)),
    ],
)
def test_conventions(header, values, rotation, expected):
    found = read(header, *values, rotation=rotation)
    assert np.abs(found.rotation[0] - expected).max() < 1e-12  # rounding
    assert found.columns == tuple(header.split(","))


def test_columns_that_name_their_angles_are_not_overruled_and_half_turns_are_their_own_inverse():
    header = "euler_ZYX_1_deg,euler_ZYX_2_deg,euler_ZYX_3_deg"
    assert np.array_equal(read(header, 3, 2, 1).rotation, read(header, 3, 2, 1, rotation="ZYX-deg").rotation)
    with fails_with("E-OPTION-CONTRADICTS … euler_ZYX_1_deg … --rotation xyz-deg … rename"):
        read(header, 3, 2, 1, rotation="xyz-deg")
    half = np.repeat(Rotation.from_rotvec([np.pi, 0, 0]).as_matrix()[None], 5, axis=0)
    np.testing.assert_allclose(INVERTED.rotations(half), half, atol=1e-12)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("rx_deg,ry_deg,rz_deg", "E-ROTATION-AMBIGUOUS … rx, ry, rz … --rot"),
        ("rx,ry,rz", "E-ROTATION-AMBIGUOUS … --rotation … ur-rotvec, yaskawa"),
        ("w_rad,p_rad,r_rad", "E-ROTATION-AMBIGUOUS … wpr"),
        ("a,b,c", "E-ROTATION-AMBIGUOUS … abc"),
        ("roll,pitch,yaw", "E-ROTATION-AMBIGUOUS … roll, pitch, yaw"),
    ],
)
def test_names_that_leave_it_open(header, words):
    refuses(words, read, header, 10, 20, 30)
    assert read(header.rpartition(",")[0], 10, 20) is None


@pytest.mark.parametrize("header", ["roll_rad,pitch_rad,yaw_rad", "rotvec_x_rad,rotvec_y_rad,rotvec_z_rad"])
def test_degrees_that_are_called_radians(header):
    refuses("E-ANGLE-UNIT … 13 rad … _deg … --rotation", read, header, 10, -13, 0)
    assert len(read(header, 12, -12, 0).rotation) == 1  # two turns less a little


XYZW = np.array([[0.1, 0.2, 0.3, 0.0], [0.5, -0.5, 0.1, 0.0]])
XYZW[:, 3] = np.sqrt(1 - (XYZW**2).sum(1))
TRUE = Rotation.from_quat(XYZW).as_matrix()


def poses_of(folder, header: str, values: np.ndarray, order="wxyz", prefix="") -> np.ndarray:
    """Rotations of a table with columns of this header, and of these values."""
    rows = "\n".join(",".join(["1", "2", "3", *(repr(float(v)) for v in row)]) for row in values)
    return table(folder, f"x_mm,y_mm,z_mm,{header}\n{rows}\n", order).poses(prefix).rotation


def test_xyzw_is_the_order_in_which_columns_stand_and_else_they_hold_what_their_names_say(tmp_path):
    for header in ("qw,qx,qy,qz", "qx,qy,qz,qw"):
        np.testing.assert_allclose(poses_of(tmp_path, header, XYZW, "xyzw"), TRUE, atol=1e-12)
    header, more = "qa_qw,qa_qx,qa_qy,qa_qz,qa_x_mm,qa_y_mm,qa_z_mm", np.ones((2, 3))
    np.testing.assert_allclose(poses_of(tmp_path, header, np.hstack([XYZW, more]), "xyzw", "qa_"), TRUE, atol=1e-12)
    np.testing.assert_allclose(poses_of(tmp_path, "qx,qy,qz,qw", XYZW), TRUE, atol=1e-12)
    wrong = poses_of(tmp_path, "qw,qx,qy,qz", XYZW)
    assert np.abs(wrong - TRUE).max() > 0.5
    np.testing.assert_allclose(LAST.rotations(wrong), TRUE, atol=1e-12)  # the reading is what the option does
    right = poses_of(tmp_path, "qw,qx,qy,qz", XYZW[:, [3, 0, 1, 2]], "xyzw")
    np.testing.assert_allclose(FIRST.rotations(right), TRUE, atol=1e-12)
    assert "--quaternions xyzw" in LAST.remedy


@pytest.mark.parametrize("wrong", READINGS, ids=lambda each: each.held)
def test_the_reading_that_fits_is_found(wrong):
    rng = np.random.default_rng(3)
    true = Rotation.random(12, random_state=rng).as_matrix()
    held = np.swapaxes(true, 1, 2) if wrong.conjugated else true
    wxyz = Poses(held, np.zeros((12, 3))).quaternions()
    read = Poses.from_quaternions(wxyz[:, np.argsort(wrong.order)], np.zeros((12, 3))).rotation
    off = {each.held: np.abs(each.rotations(read) - true).max() for each in READINGS}
    assert [held for held in off if off[held] < 1e-9] == [wrong.held]


A, B, C = (f"{i} 1 0 0 0 0 0 {i} 1 {name}\n" for i, name in ((1, "a.jpg"), (2, "b c.jpg"), (3, "0003")))


@pytest.mark.parametrize(
    ("text", "followed"),
    [
        (f"# head\n{A}\n{B}\n{C}\n", [True, True, True]),
        (f"{A}1.5 2.5 -1 3 4 7\n{B}\n{C}5 6 1\n", [True, True, True]),
        (A + B + C, [False, False, False]),
        (f"{A}\n{B}\n{C}", [True, True, False]),
        (f"\n\n{A}{B}1 2 3\n{C}\n", [False, True, True]),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_every_image_is_read(text, followed, end):
    images = image_lines(text.replace("\n", end), "images.txt")
    assert [image.name for image in images] == ["a.jpg", "b c.jpg", "0003"]
    assert [image.followed for image in images] == followed


def test_a_line_of_another_form_is_named():
    refuses("E-MODEL-UNREADABLE … line 2 … 2 cells", image_lines, f"{A}1.0 2.0\n{B}\n", "images.txt")
    refuses("E-MODEL-UNREADABLE … line 3", image_lines, f"{A}\nno image\n", "images.txt")


def test_rows_of_one_key_stand_side_by_side_and_names_that_are_numbers_as_they_are_written(tmp_path):
    a = written(tmp_path / "poses.csv", "image,x_mm,y_mm,z_mm,status\np1,1,2,3,ok\np2,4,5,6,ok\np9,0,0,0,ok\n")
    b = written(tmp_path / "tracker.csv", "image,x_m,y_m,z_m,cov_x_x,status\np2,0.4,0.5,0.6,1,?\np1,0.1,0.2,0.3,1,?\n")
    found = join_tables(a, b, "image", ("a", "b"))
    pairs = read_pairs(found.table)
    assert np.allclose(pairs.xyz_a, [[1, 2, 3], [4, 5, 6]])
    assert np.allclose(pairs.xyz_b, [[100, 200, 300], [400, 500, 600]])
    assert list(pairs.lines) == [2, 3]
    assert found.table.text("status") == ["ok", "ok"]
    assert "bcov_x_x" in found.table
    assert found.notes == (f"1 rows of {a} have no partner: image p9",)
    # Both columns are numbers in both files, and no float has these digits.
    stamps = "1700000000123456789", "1700000000223456789"
    a = written(tmp_path / "c.csv", f"image,time_ns,x_mm\n0001,{stamps[0]},1.50\n0002,{stamps[1]},2.50\n")
    b = written(tmp_path / "d.csv", "image,u_px\n0002,7\n0001,8\n")
    joined = join_tables(a, b, "image").table
    assert (joined.text("image"), joined.text("time_ns")) == (["0001", "0002"], list(stamps))
    assert np.array_equal(joined.numbers("x_mm"), [1.5, 2.5])
    both = stcal.stack_tables([stcal.load_table(a)] * 2, ["first", "second"])
    assert both.text("image") == ["0001", "0002"] * 2


@pytest.mark.parametrize(
    ("second", "key", "said"),
    [
        ("image,x_mm,y_mm,z_mm\nq1,1,2,3\n", "image", "E-TABLES-UNMATCHED … image … p1 … q1"),
        ("name,x_mm,y_mm,z_mm\np1,1,2,3\n", "image", "E-TABLE-COLUMN-MISSING … image"),
        ("image,x_mm,y_mm,z_mm\np1,1,2,3\np1,1,2,4\n", "image", "E-TABLE-ROW-REPEATED … 3 … image … p1 … 2"),
        ("image,x_mm,y_mm,z_mm\np1,1,2,3\n", "image", "E-TABLES-BOTH … x_mm"),
    ],
)
def test_what_cannot_be_joined_says_why(tmp_path, second, key, said):
    a = written(tmp_path / "a.csv", "image,x_mm,y_mm,z_mm\np1,1,2,3\n")
    b = written(tmp_path / "b.csv", second)
    refuses(said, join_tables, a, b, key)


def test_registration_of_two_files(tmp_path):
    xyz, true = np.random.default_rng(3).uniform(-200, 200, (30, 3)), Rigid.exp([0.1, 0.2, -0.3, 100, 50, 20])
    for name, points, order in (("a", xyz, range(30)), ("b", true @ xyz, reversed(range(30)))):
        rows = ["name,x_mm,y_mm,z_mm", *(f"n{i}," + ",".join(f"{v:.6f}" for v in points[i]) for i in order)]
        (tmp_path / name).write_text("\n".join(rows))
    words = ["register", "--a", str(tmp_path / "a"), "--out", str(tmp_path / "r.json"), "--folds", "0"]
    done = CliRunner().invoke(app, [*words, "--b", str(tmp_path / "b")])
    assert done.exit_code == 0, done.output
    found = np.array(json.loads((tmp_path / "r.json").read_text())["b_from_a"])
    assert np.abs(found - true.matrix()).max() < 1e-4  # digits of the files
    assert CliRunner().invoke(app, words).exit_code != 0


def test_files_of_one_kind_stand_below_each_other(tmp_path):
    a = written(tmp_path / "wanted.csv", "image,x_mm,y_mm,z_mm\np1,1,2,3\np2,4,5,6\n")
    files = [
        written(tmp_path / "before.csv", "image,x_mm,y_mm,z_mm,only\np2,7,7,7,1\np1,8,8,8,1\n"),
        written(tmp_path / "after.csv", "image,x_mm,y_mm,z_mm\np1,9,9,9\n"),
    ]
    joined = [join_tables(a, file, "image", ("commanded_", "")).table for file in files]
    found = stack_tables(joined, ["before", "after"], {"pose": "image"})
    assert found.text("set") == ["before", "before", "after"]
    assert found.text("pose") == ["p1", "p2", "p1"]
    assert "only" not in found
    assert np.allclose(found.points(), [[8, 8, 8], [7, 7, 7], [9, 9, 9]])
    assert np.allclose(found.points("commanded_"), [[1, 2, 3], [4, 5, 6], [1, 2, 3]])
    refuses("E-TABLES-NAMES … after … set", stack_tables, joined, ["after", "after"], {})
