"""``stcal register``: files in and out, bad rows by line, base and kinematics beside the transform."""

import json
import re

import numpy as np
import pytest

from stcal import register, workflows
from stcal.cli.main import main
from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.file import load_robot, robot_toml
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import mh80
from tests.outcome import ended, fails_with
from tests.support.arms import elastic
from tests.support.simulated_arms import joint_vectors, made, placed

HEAD = "ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm"
B_FROM_A = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])


def points(n: int = 30, seed: int = 0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(-200, 200, (n, 3)) + np.array([800, 200, 700])
    return a, B_FROM_A @ a + rng.normal(0, 0.1, a.shape)


def rows_of(*columns) -> list[str]:
    return [",".join(f"{v:.6f}" for v in row) for row in np.hstack(columns)]


def written(folder, rows: list[str], head: str = HEAD):
    path = folder / "pairs.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command: exit code, what it printed, and its error line."""

    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["stcal", "register", *map(str, arguments)])
        return ended(main, capsys)

    return call


@pytest.mark.slow
def test_json_and_page(run, tmp_path):
    a, b = points()
    b[4] += [0, 9, 0]
    out, page = tmp_path / "new" / "found.json", tmp_path / "found.html"
    code, printed, err = run(written(tmp_path, rows_of(a, b)), "--folds", 2, "--out", out, "--report", page)
    assert (code, err) == (0, "")
    content = json.loads(out.read_text())
    np.testing.assert_allclose(content["b_from_a"], B_FROM_A.matrix(), atol=1.0)
    # the line of a row: the header is line 1
    assert [o["line"] for o in content["outliers"]] == [6]
    assert content["outliers"][0]["length_mm"] == pytest.approx(9, abs=0.5)
    assert "line 6" in printed
    assert f"written: {out}" in printed
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_file(run, tmp_path):
    a, b = points()
    b[::3] += np.random.default_rng(2).uniform(-9, 9, (10, 3))
    pairs = written(tmp_path, rows_of(a, b))
    texts = []
    for name in ("one.json", "two.json"):
        run(pairs, "--seed", 7, "--out", tmp_path / name)
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1]


def test_two_motions_are_refused_unless_allowed(run, tmp_path):
    """A third of the points moved together by 9 mm, as when an instrument is knocked."""
    a, b = points()
    b[::3] += [0, 9, 0]
    pairs, out = written(tmp_path, rows_of(a, b)), tmp_path / "o.json"
    code, _, err = run(pairs, "--out", out)
    assert code == 3
    assert "20 point pairs agree on one transform and 10 others on another" in err
    assert not out.exists()
    code, printed, _ = run(pairs, "--out", out, "--allow-ambiguous", "--folds", 0)
    assert code == 0
    assert "AMBIGUOUS" in printed
    other = json.loads(out.read_text())["alternative"]
    assert other["lines"] == list(range(2, 32, 3))
    assert other["apart_mm"] == pytest.approx(9, abs=0.5)


@pytest.mark.slow
def test_methods_and_threshold(run, tmp_path):
    a, b = points(60)
    b[7] += [0, 4, 0]
    pairs = written(tmp_path, rows_of(a, b))
    out = tmp_path / "o.json"
    errors = {}
    for method, more in (
        ("robust", []),
        ("least-squares", []),
        ("liu2017", ["--threshold", 0.5]),
        ("robust", ["--threshold", 0.3]),
    ):
        code, _, err = run(pairs, "--method", method, *more, "--folds", 0, "--out", out, "--overwrite")
        assert (code, err) == (0, "")
        content = json.loads(out.read_text())
        assert content["held_out"] is None
        errors[method, *more] = content
    assert errors["least-squares",]["inliers"] == [True] * 60
    assert errors["robust",]["inliers"].count(False) == 1
    assert errors["liu2017", "--threshold", 0.5]["model"] == "affine"
    assert errors["robust", "--threshold", 0.3]["threshold_mm"] == 0.3
    lengths = np.linalg.norm(errors["robust", "--threshold", 0.3]["residuals"], axis=1)
    np.testing.assert_array_equal(lengths < 0.3, errors["robust", "--threshold", 0.3]["inliers"])


def test_other_units(run, tmp_path):
    """b in metres, a in inches: the same answer in mm."""
    a, b = points()
    found = []
    for head, columns in ((HEAD, (a, b)), ("ax_in,ay_in,az_in,bx_m,by_m,bz_m", (a / 25.4, b / 1000))):
        path = tmp_path / "pairs.csv"
        path.write_text("\n".join([head, *(",".join(f"{v:.12f}" for v in row) for row in np.hstack(columns))]))
        run(path, "--folds", 0, "--out", tmp_path / "o.json")
        found.append(json.loads((tmp_path / "o.json").read_text()))
    np.testing.assert_allclose(found[0]["b_from_a"], found[1]["b_from_a"], atol=1e-6)


def bad(kind: str) -> tuple[str, list[str]]:
    """A file with a mistake on line 9 (its eighth row)."""
    a, b = points()
    rows, head = rows_of(a, b), HEAD
    cells = rows[7].split(",")
    if kind == "nan":
        cells[3] = "nan"
    elif kind == "text":
        cells[1] = "12,5mm".replace(",", ".")
    elif kind == "empty":
        cells[5] = ""
    elif kind == "infinite":
        cells[0] = "inf"
    elif kind == "short":
        cells = cells[:5]
    elif kind == "twice":
        cells = rows[2].split(",")
    elif kind == "comma":
        cells = [*cells[:5], *cells[5].split(".")]
    rows[7] = ",".join(cells)
    return head, rows


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("nan", "bx_mm is 'nan', a finite number needed"),
        ("text", "ay_mm is '12.5mm', a finite number needed"),
        ("empty", "bz_mm is '', a finite number needed"),
        ("infinite", "ax_mm is 'inf', a finite number needed"),
        ("short", "5 cells, 6 needed"),
        ("comma", "7 cells, 6 needed"),
        ("twice", "the same pair as on line 4"),
    ],
)
def test_bad_rows_are_named_by_line(run, tmp_path, kind, says):
    head, rows = bad(kind)
    out = tmp_path / "o.json"
    code, printed, err = run(written(tmp_path, rows, head), "--out", out)
    assert code == 2
    assert printed == ""
    assert "line 9: " in err
    assert says in err
    assert len(err.splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--model", "projective"], 2, "rigid"),
        (["--method", "magic"], 2, "robust"),
        (["--threshold", "-1"], 2, "positive"),
        (["--threshold", "1e308"], 2, "1e-09 to 1e+12, needed"),
        (["--threshold", "1e-308"], 2, "1e-09 to 1e+12, needed"),
        (["--threshold", "nan"], 2, "a finite number"),
        (["--folds", "-1"], 2, "folds"),
        (["--identified", "r.toml"], 2, "--robot"),
        (["--robot", "no.toml"], 2, "robot init"),
    ],
)
def test_bad_options(run, tmp_path, arguments, code, says):
    found, _, err = run(written(tmp_path, rows_of(*points())), *arguments)
    assert found == code
    assert says in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("rows", "head", "code", "says"),
    [
        ([], HEAD, 2, "rows needed"),
        (["1,2,3,4,5,6"], HEAD.replace("bz_mm", "bz"), 2, "bz_mm"),
        (["1,2,3,4,5,6", "2,3,4,5,6,7"], HEAD, 3, "3 needed"),
        ([f"{i},0,0,0,{i},0" for i in range(9)], HEAD, 3, "line"),
    ],
)
def test_files_that_cannot_do(run, tmp_path, rows, head, code, says):
    found, _, err = run(written(tmp_path, rows, head))
    assert found == code
    assert says in err


def test_no_file(run, tmp_path):
    code, _, err = run(tmp_path / "none.csv")
    assert code == 2
    assert "none.csv" in err


@pytest.fixture(scope="module")
def robot_pairs(tmp_path_factory):
    """An arm that is not as drawn, seen by a tracker: a by the drawing, three points wrong; and the truth."""
    folder = tmp_path_factory.mktemp("robot")
    rng = np.random.default_rng(5)
    drawn = placed(mh80(), Rigid(), {"": Rigid(np.eye(3), [40.0, -20.0, 120.0])})
    real = made(drawn, rng)
    q = joint_vectors(drawn, 45, rng)
    b = B_FROM_A @ forward(real, q).translation + rng.normal(0, 0.03, (45, 3))
    b[[4, 20, 33]] += [[3.0, 0, 0], [0, -20, 0], [8, 8, 8]]
    pairs = folder / "pairs.csv"
    head = HEAD + "".join(f",q{i}_deg" for i in range(1, 7))
    pairs.write_text("\n".join([head, *rows_of(forward(drawn, q).translation, b, np.degrees(q))]))
    (folder / "robot.toml").write_text(robot_toml(drawn))
    return folder, pairs, real


@pytest.mark.slow
def test_base_and_kinematics_together(run, tmp_path, robot_pairs):
    folder, pairs, real = robot_pairs
    out, page, identified = tmp_path / "o.json", tmp_path / "o.html", tmp_path / "identified.toml"
    arguments = ("--robot", folder / "robot.toml", "--folds", 2, "--out", out, "--report", page)
    code, printed, err = run(pairs, *arguments, "--identified", identified)
    assert (code, err) == (0, "")
    content = json.loads(out.read_text())["robot"]
    assert content["rank"] == content["parameters"] == 27
    assert content["better"] is True
    assert content["a_off_robot_file_mm"] < 1e-4  # what six digits in the file leave
    assert {6, 22, 35} == set(content["held_out"]["outliers_of_both"])
    assert content["held_out"]["lines"] == list(range(2, 47))
    clean = content["held_out"]["figures"][-1]
    assert clean["points"] == 42
    # 0.3 mm and 0.5 mrad in every axis bend by a millimetre; measured to 0.03 mm, 30 points tell 27 parameters
    assert clean["transform"]["mean_mm"] > 0.5
    assert clean["kinematics"]["mean_mm"] < clean["transform"]["mean_mm"] / 5
    assert np.linalg.norm(np.array(content["b_from_base"])[:3, 3] - B_FROM_A.translation) < 1
    assert "base and kinematics together" in printed
    assert "Base and kinematics together" in page.read_text()
    # The identified robot predicts places that nobody measured.
    robot = load_robot(identified)
    new = joint_vectors(real, 200, np.random.default_rng(9), 0.5)
    predicted = robot.world_from_base @ forward(robot, new).translation
    assert np.linalg.norm(predicted - B_FROM_A @ forward(real, new).translation, axis=1).mean() < 0.15


@pytest.mark.slow
def test_loads_at_the_flange_are_known_to_an_elastic_robot(run, tmp_path):
    """Every other point with 60 kg, which bends the arm by a millimetre: a is where the file says."""
    rng = np.random.default_rng(6)
    drawn = elastic(placed(mh80(), Rigid(), {"": Rigid(np.eye(3), [40.0, -20.0, 120.0])}), rng, 3.0)
    q, mass = joint_vectors(drawn, 45, rng), np.resize([0.0, 60.0], 45)
    a = forward(drawn, q, payload_kg=mass).translation
    assert np.abs(a - forward(drawn, q).translation).max() > 0.3
    b = B_FROM_A @ a + rng.normal(0, 0.03, (45, 3))
    pairs, out = tmp_path / "pairs.csv", tmp_path / "o.json"
    head = HEAD + "".join(f",q{i}_deg" for i in range(1, 7)) + ",payload_kg"
    pairs.write_text("\n".join([head, *rows_of(a, b, np.column_stack([np.degrees(q), mass]))]))
    (tmp_path / "robot.toml").write_text(robot_toml(drawn))
    code, _, err = run(pairs, "--robot", tmp_path / "robot.toml", "--folds", 2, "--out", out)
    assert (code, err) == (0, "")
    content = json.loads(out.read_text())["robot"]
    assert content["a_off_robot_file_mm"] < 1e-3
    assert content["sigma_mm"] == pytest.approx(0.03, rel=0.3)


def test_joint_values_are_needed_for_a_robot(run, tmp_path, robot_pairs):
    folder, pairs, _ = robot_pairs
    out = tmp_path / "o.json"
    code, _, err = run(written(tmp_path, rows_of(*points())), "--robot", folder / "robot.toml", "--out", out)
    assert code == 2
    assert "q1_deg" in err
    assert "--robot" in err
    lines = pairs.read_text().splitlines()
    lines[6] = ",".join(["", *lines[6].split(",")[1:]])
    bad_row = tmp_path / "bad.csv"
    bad_row.write_text("\n".join(lines))
    code, _, err = run(bad_row, "--robot", folder / "robot.toml")
    assert code == 2
    assert "line 7" in err


def test_the_function_has_the_commands_answer(run, tmp_path, robot_pairs):
    folder, pairs, _ = robot_pairs
    out, identified = tmp_path / "o.json", tmp_path / "identified.toml"
    words = "--robot", folder / "robot.toml", "--folds", 0, "--out", out, "--identified", identified
    assert run(pairs, *words)[0] == 0
    read = register.read_pairs(pairs)
    transform = register.register(read.xyz_a, read.xyz_b, folds=0, allow_ambiguous=True)
    robot = load_robot(folder / "robot.toml")
    found = workflows.register_with_robot(read, transform, robot, pairs, folds=0)
    content = json.loads(out.read_text())["robot"]
    assert found.identified.robot.world_from_base.matrix().tolist() == content["b_from_base"]
    assert robot_toml(found.identified.robot) in identified.read_text()
    with fails_with("E-ARRAY-SHAPE … 45 point pairs … 44 joint vectors"):
        workflows.register_with_robot(
            read, transform, robot, Measurements.from_arrays(np.zeros((44, 6)), read.xyz_b[1:])
        )


def test_a_transform_stands_where_the_kinematics_do_not(run, tmp_path, robot_pairs):
    """Eight points for 27 parameters: the transform is written, and the command says that the rest failed."""
    folder, pairs, _ = robot_pairs
    few, out = tmp_path / "few.csv", tmp_path / "o.json"
    few.write_text("\n".join(pairs.read_text().splitlines()[:9]))
    code, _, err = run(few, "--robot", folder / "robot.toml", "--out", out)
    assert code == 3
    assert "27 parameters" in err
    assert "robot" not in json.loads(out.read_text())


@pytest.mark.slow
def test_the_published_method_takes_its_numbers(run, tmp_path):
    a, b = points(60)
    b[:6] += 3.0
    path = written(tmp_path, rows_of(a, b))
    words = ("--method", "liu2017", "--sample", 20, "--share", 0.6, "--threshold-mm", 0.4, "--tries", 400)
    page = tmp_path / "page.html"
    code, text, _ = run(path, *words, "--orthogonality", 0.05, "--report", page)
    assert code == 0
    assert "threshold 0.4 mm" in text
    assert "eqs. 8 and 9 are not legible" in text
    shown = page.read_text(encoding="utf-8")
    assert "Size of the sample" in shown
    assert re.search(r"within 0\.4 mm .*more than 60 %", shown, re.S)
    code, _, error = run(path, "--method", "liu2017", "--sample", 60)
    assert (code, "lower it (--sample)" in error) == (3, True)
    code, _, error = run(path, "--share", 0.6)
    assert (code, "only with --method liu2017" in error) == (2, True)
