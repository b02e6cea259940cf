"""``stcal register``: files in and out, bad rows by line, base and kinematics beside the transform."""

import json

import numpy as np
import pytest

from stcal import register, workflows
from stcal.geometry.rigid import Rigid
from stcal.register import Pairs
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, made, placed
from tests.outcome import lines_of, program, refuses
from tests.shared import written
from tests.support.arms import elastic
from tests.support.point_pairs import B_FROM_A

HEAD = "ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm"
WITH_JOINTS = HEAD + "".join(f",q{i}_deg" for i in range(1, 7))


run = program("stcal", "register")


def points(n: int = 30, seed: int = 0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(-200, 200, (n, 3)) + np.array([800, 200, 700])
    return a, B_FROM_A @ a + rng.normal(0, 0.1, a.shape)


def rows_of(*columns) -> list[str]:
    return [",".join(f"{v:.6f}" for v in row) for row in np.hstack(columns)]


def pairs_file(folder, rows: list[str], head: str = HEAD):
    return written(folder / "pairs.csv", "\n".join([head, *rows]) + "\n")


def test_two_motions_are_refused_unless_allowed(run, tmp_path):
    """A third of the points moved together by 9 mm, as when an instrument is knocked."""
    a, b = points()
    b[::3] += [0, 9, 0]
    pairs, out = pairs_file(tmp_path, rows_of(a, b)), tmp_path / "o.json"
    code, _, err = run(pairs, "--out", out)
    assert code == 3
    assert "20 point pairs agree on one transform and 10 others on another" in err
    assert not out.exists()
    code, printed, _ = run(pairs, "--out", out, "--allow-ambiguous", "--folds", 0)
    assert code == 0
    assert "AMBIGUOUS" in printed
    other = json.loads(out.read_text())["alternative"]
    assert other["rows"] == list(range(0, 30, 3))
    assert other["apart_mm"] == pytest.approx(9, abs=0.5)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--threshold", "1e308"], "1e-09 to 1e+12, needed"),
        (["--folds", "-1"], "folds"),
        (["--identified", "r.toml"], "--robot"),
        (["--robot", "no.toml"], "robot init"),
    ],
)
def test_bad_options(run, tmp_path, arguments, says):
    code, _, err = run(pairs_file(tmp_path, rows_of(*points())), *arguments)
    assert code == 2
    assert says in err
    assert len(lines_of(err)) == 1


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
    pairs = pairs_file(folder, rows_of(forward(drawn, q).translation, b, np.degrees(q)), WITH_JOINTS)
    (folder / "robot.toml").write_text(robot_toml(drawn))
    return folder, pairs, real


@pytest.mark.slow
def test_base_and_kinematics_together(run, tmp_path, robot_pairs):
    folder, pairs, real = robot_pairs
    out, page, identified = tmp_path / "o.json", tmp_path / "o.html", tmp_path / "identified.toml"
    arguments = ("--robot", folder / "robot.toml", "--folds", 2, "--out", out, "--report", page)
    code, printed, err = run(pairs, *arguments, "--identified", identified)
    assert (code, lines_of(err)) == (0, [])
    content = json.loads(out.read_text())["robot"]
    assert content["identified"]["rank"] == len(content["identified"]["names"]) == 27
    assert content["better"] is True
    assert content["off_mm"] < 1e-4  # what six digits in the file leave
    assert np.flatnonzero(content["wild"]).tolist() == [4, 20, 33]
    assert content["rows"] == list(range(45))
    assert content["kinematics"]["points"] == 42
    # 0.3 mm and 0.5 mrad in every axis bend by a millimetre; measured to 0.03 mm, 30 points tell 27 parameters
    assert content["transform"]["mean_mm"] > 0.5
    assert content["kinematics"]["mean_mm"] < content["transform"]["mean_mm"] / 5
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
    out = tmp_path / "o.json"
    pairs = pairs_file(tmp_path, rows_of(a, b, np.degrees(q), mass[:, None]), WITH_JOINTS + ",payload_kg")
    (tmp_path / "robot.toml").write_text(robot_toml(drawn))
    code, _, err = run(pairs, "--robot", tmp_path / "robot.toml", "--folds", 0, "--out", out)
    assert (code, lines_of(err)) == (0, [])
    content = json.loads(out.read_text())["robot"]
    assert content["off_mm"] < 1e-3
    assert content["identified"]["weighting"]["sigma_mm"] == pytest.approx(0.03, rel=0.3)


def test_joint_values_are_needed_and_a_transform_stands_where_the_kinematics_do_not(run, tmp_path, robot_pairs):
    """Eight points for 27 parameters: the transform is written, and the command says that the rest failed."""
    folder, pairs, _ = robot_pairs
    out = tmp_path / "o.json"
    code, _, err = run(pairs_file(tmp_path, rows_of(*points())), "--robot", folder / "robot.toml", "--out", out)
    assert code == 2
    assert "q1_deg" in err
    assert "--robot" in err
    head, *rows = pairs.read_text().splitlines()
    rows[5] = rows[5][rows[5].index(",") :]
    code, _, err = run(pairs_file(tmp_path, rows, head), "--robot", folder / "robot.toml")
    assert code == 2
    assert "line 7" in err
    given, robot = register.read_pairs(pairs), load_robot(folder / "robot.toml")
    transform = register.register(given.xyz_a, given.xyz_b, folds=0, allow_ambiguous=True)
    fewer = Measurements.from_arrays(np.zeros((44, 6)), given.xyz_b[1:])
    said = "E-ARRAY-SHAPE … 45 point pairs … 44 joint vectors"
    refuses(said, workflows.register_with_robot, given, transform, robot, fewer)
    head, *rows = pairs.read_text().splitlines()
    code, _, err = run(pairs_file(tmp_path, rows[:8], head), "--robot", folder / "robot.toml", "--out", out)
    assert code == 3
    assert "27 parameters" in err
    assert "robot" not in json.loads(out.read_text())


def read(*given) -> Pairs:
    return register.read_pairs(pairs_file(*given))


ROWS = ["0,0,0,10,20,30", "1,0,0,11,20,30", "0,2,0,10,22,30", "0,0,3.5,10,20,33.5"]
COV = "cov_x_x,cov_x_y,cov_x_z,cov_y_y,cov_y_z,cov_z_z"


def with_cells(cells):
    return [f"{row},{cell}" for row, cell in zip(ROWS, cells, strict=True)]


def test_points_lines_units_and_noise_of_three_kinds(tmp_path):
    pairs = read(tmp_path, [ROWS[0], "# a remark", *ROWS[1:]])
    assert list(pairs.lines) == [2, 4, 5, 6]
    np.testing.assert_array_equal(pairs.xyz_a[3], [0, 0, 3.5])
    np.testing.assert_array_equal(pairs.xyz_b[2], [10, 22, 30])
    assert pairs.weights is None
    assert pairs.covariances is None
    pairs = read(tmp_path, ROWS, "ax_m,ay_mm,az_mm,bx_in,by_in,bz_in")
    np.testing.assert_allclose(pairs.xyz_a[1], [1000, 0, 0])
    np.testing.assert_allclose(pairs.xyz_b[0], np.array([10, 20, 30]) * 25.4)
    numbered = with_cells([1, 2, 3, 4])
    assert read(tmp_path, numbered, HEAD + ",weight").weights.tolist() == [1, 2, 3, 4]
    variances = read(tmp_path, numbered, HEAD + ",sigma_um").covariances
    np.testing.assert_allclose(variances, np.array([1, 4, 9, 16]) * 1e-6)
    full = read(tmp_path, with_cells(["4,1,0,5,2,6"] * 4), f"{HEAD},{COV}").covariances
    np.testing.assert_array_equal(full[2], [[4, 1, 0], [1, 5, 2], [0, 2, 6]])


@pytest.mark.parametrize(
    ("rows", "head", "message"),
    [
        ([], HEAD, "E-TABLE-EMPTY"),
        ([*ROWS, "1,2,nan,4,5,6"], HEAD, "E-TABLE-NUMBER … 6 … az_mm … 'nan'"),
        ([*ROWS, "1,2,3,4,much,6"], HEAD, "E-TABLE-NUMBER … 6 … by_mm … 'much'"),
        ([*ROWS, "1,2,3,4,5"], HEAD, "E-TABLE-CELLS … 6 … 5 … 6"),
        ([*ROWS, "", ROWS[1]], HEAD, "E-TABLE-ROW-REPEATED … 7 … 3"),
        ([*ROWS, ROWS[1], ROWS[1]], HEAD, "E-TABLE-ROW-REPEATED … 6"),
        (ROWS, HEAD.replace("bz_mm", "z_mm"), "E-TABLE-COLUMN-MISSING … no such column … bz_mm or bz_m"),
        (with_cells([1, 2, 0, 4]), HEAD + ",weight", "E-SIGMA-VALUE … 4 … weight … 0"),
        (with_cells([1, -2, -1, 4]), HEAD + ",sigma_mm", "E-SIGMA-VALUE … 3 … sigma … -2 … (and 1 more)"),
        (with_cells(["1,1"] * 4), HEAD + ",sigma_mm,weight", "E-TABLE-COLUMNS-CONFLICT … weight and sigma"),
        (with_cells(["1,2"] * 4), HEAD + ",cov_x_x,cov_x_y", "E-TABLE-COLUMN-MISSING … cov_x_z … 6"),
        (with_cells(["1,0,0,1,0,1"] * 3 + ["1,2,0,1,0,1"]), f"{HEAD},{COV}", "E-TABLE-COVARIANCE … 5 … 2 of x and y"),
    ],
)
def test_bad_files(tmp_path, rows, head, message):
    refuses(message, read, tmp_path, rows, head)
