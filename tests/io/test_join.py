"""Tables of two commands as one: rows by their key, columns as the next command reads them."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import stcal
from stcal import register
from stcal.cli.main import app
from stcal.geometry.rigid import Rigid
from stcal.io.join import join_tables, stack_tables
from stcal.register.registered import read_pairs
from tests.outcome import refuses
from tests.shared import written


def test_rows_of_one_key_stand_side_by_side(tmp_path):
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


def test_pairs_of_two_files(tmp_path):
    a = written(tmp_path / "a.csv", "name,x_mm,y_mm,z_mm\np1,1,2,3\np2,4,5,6\np9,0,0,0\n")
    b = written(tmp_path / "b.csv", "P;x_m;y_m;z_m\np2;1;1;1\np1;2;2;2\n")
    pairs = register.read_pairs(a, b, key="name=P")
    assert np.allclose(pairs.xyz_a, [[1, 2, 3], [4, 5, 6]])
    assert np.allclose(pairs.xyz_b, [[2000] * 3, [1000] * 3])
    assert pairs.notes == (f"1 rows of {a} have no partner: name p9",)
    table = stcal.load_table(b)
    joined = stcal.join_tables(a, table, "name=P", ("a", "b"))
    assert np.array_equal(register.read_pairs(joined.table).xyz_b, pairs.xyz_b)
    both = stcal.stack_tables([table, table], ["first", "second"])
    assert both.text("set") == ["first", "first", "second", "second"]


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


def test_names_that_are_numbers_stay_as_they_are_written(tmp_path):
    """Both columns are numbers in both files, and no float has these digits."""
    stamps = "1700000000123456789", "1700000000223456789"
    a = written(tmp_path / "a.csv", f"image,time_ns,x_mm\n0001,{stamps[0]},1.50\n0002,{stamps[1]},2.50\n")
    b = written(tmp_path / "b.csv", "image,u_px\n0002,7\n0001,8\n")
    joined = join_tables(a, b, "image").table
    assert (joined.text("image"), joined.text("time_ns")) == (["0001", "0002"], list(stamps))
    assert np.array_equal(joined.numbers("x_mm"), [1.5, 2.5])
    both = stcal.stack_tables([stcal.load_table(a)] * 2, ["first", "second"])
    assert both.text("image") == ["0001", "0002"] * 2
