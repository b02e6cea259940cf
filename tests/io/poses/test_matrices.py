"""Matrices in columns: any names of elements, order of columns, encoding and line end give the same poses."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stcal.handeye.data.formats.record import Said
from stcal.handeye.data.inputs import read_pairs, read_robot
from stcal.handeye.data.robot_poses import read_robot_poses
from stcal.io.poses.columns import find_matrices, read_rotations
from stcal.io.table import Table
from tests.handeye.written import line
from tests.outcome import fails_with

RNG = np.random.default_rng(4)
POSES = np.tile(np.eye(4), (4, 1, 1))
POSES[:, :3, :3] = Rotation.random(4, random_state=4).as_matrix()
POSES[:, :3, 3] = RNG.uniform(-900, 900, (4, 3))
STYLES = ("T[{}][{}]", "T_{}{}", "m{}{}", "T{}_{}", "r{}{}", "Pose({} {})", "base_from_flange_T[{}][{}]", "M.{}.{}")
"""Row and column of an element. Without a comma, which would need quotation marks."""
VECTORS = {"r{}{}": "t{}", "R[{}][{}]": "t[{}]", "rot_{}_{}": "trans_{}", "R_{}{}": "tvec_{}"}
FORMS = {
    "plain": lambda text: text.encode(),
    "crlf": lambda text: text.replace("\n", "\r\n").encode(),
    "cr": lambda text: text.replace("\n", "\r").encode(),
    "utf-16": lambda text: text.encode("utf-16"),
    "byte-order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "tabs": lambda text: text.replace(",", "\t").encode(),
    "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ",").encode(),
    "blank lines": lambda text: f"\n{text}\n\n".encode(),
}


def elements(style: str, first: int, rows: int, unit: str = "") -> dict[str, np.ndarray]:
    """Columns of the matrices; ``unit`` of the translation, which is written in it."""
    factor = {"": 1.0, "mm": 1.0, "m": 1e-3}[unit]
    names = {(i, j): style.format(i + first, j + first) for i in range(rows) for j in range(4)}
    return {
        name + (f"_{unit}" if unit and j == 3 and i < 3 else ""): POSES[:, i, j] * (factor if j == 3 and i < 3 else 1)
        for (i, j), name in names.items()
    }


def with_vector(style: str, first: int) -> dict[str, np.ndarray]:
    found = {style.format(i + first, j + first): POSES[:, i, j] for i in range(3) for j in range(3)}
    return found | {VECTORS[style].format(i + first): POSES[:, i, 3] for i in range(3)}


def text_of(columns: dict[str, np.ndarray]) -> str:
    rows = np.column_stack(list(columns.values()))
    return "\n".join([",".join(columns), *(line(row, ",") for row in rows)]) + "\n"


def read(path, text: bytes, said: Said | None = None) -> np.ndarray:
    path.write_bytes(text)
    posed = read_robot(path, said or Said(length_unit="mm"))
    assert posed is not None
    return posed.poses.matrix()


@given(
    st.sampled_from(STYLES),
    st.sampled_from([0, 1]),
    st.sampled_from([3, 4]),
    st.sampled_from(sorted(FORMS)),
    st.booleans(),
    st.randoms(use_true_random=False),
)
def test_elements_by_any_names(tmp_path_factory, style, first, rows, form, more, random):
    columns = elements(style, first, rows)
    if more:
        columns |= {"temperature": np.full(4, 21.5), "quality[0]": np.arange(4.0), "image": np.arange(4.0)}
    names = list(columns)
    random.shuffle(names)
    text = text_of({name: columns[name] for name in names})
    if form == "semicolons and decimal commas" and "." in style:
        form = "tabs"  # names with points would change
    found = read(tmp_path_factory.mktemp("t") / "robot.csv", FORMS[form](text))
    np.testing.assert_allclose(found, POSES, atol=1e-9)  # rounding: projected onto rotations


@pytest.mark.parametrize("style", VECTORS)
@pytest.mark.parametrize("first", [0, 1])
def test_a_rotation_with_its_translation(tmp_path, style, first):
    columns = with_vector(style, first)
    reverse = {name: columns[name] for name in reversed(columns)}
    for each in (columns, reverse):
        np.testing.assert_allclose(read(tmp_path / "p.csv", text_of(each).encode()), POSES, atol=1e-9)


@pytest.mark.parametrize("place", ["{}_mm", "t{}_mm", "T{}"])
def test_a_rotation_beside_a_place(tmp_path, place):
    columns = {f"R[{i}][{j}]": POSES[:, i, j] for i in range(3) for j in range(3)}
    columns |= {place.format(axis): POSES[:, i, 3] for i, axis in enumerate("xyz")}
    np.testing.assert_allclose(read(tmp_path / "p.csv", text_of(columns).encode()), POSES, atol=1e-9)


def test_the_unit_of_a_translation_is_its_columns(tmp_path):
    text = text_of(elements("T_{}{}", 0, 4, "m")).encode()
    np.testing.assert_allclose(read(tmp_path / "p.csv", text, Said()), POSES, atol=1e-9)
    columns = elements("T_{}{}", 0, 4, "m")
    columns["T_23_mm"] = columns.pop("T_23_m")
    with fails_with("E-POSES-UNITS … t_03_m, t_13_m, t_23_mm … one for all"):
        read(tmp_path / "p.csv", text_of(columns).encode())


def test_a_transposed_or_stretched_matrix_is_named(tmp_path):
    flat = {f"T[{i}][{j}]": POSES[:, j, i] for i in range(4) for j in range(4)}
    with fails_with("E-MATRIX-LAST-ROW … line 2 … transposed"):
        read(tmp_path / "p.csv", text_of(flat).encode())
    wrong = elements("T[{}][{}]", 0, 3)
    wrong["T[1][1]"] = wrong["T[1][1]"] + [0, 0.5, 0, 0]
    with fails_with("E-ROTATION-IMPROPER … line 3"):
        read(tmp_path / "p.csv", text_of(wrong).encode())


def test_matrices_of_two_sides_are_told_by_their_names(tmp_path):
    path, other = tmp_path / "p.csv", POSES[::-1]
    for robot, camera in (("robot_m", "camera_m"), ("T_gripper2base_", "T_target2cam_"), ("hand_T", "board_T")):
        columns = {f"{robot}{i}{j}": POSES[:, i, j] for i in range(3) for j in range(4)}
        columns |= {f"{camera}{i}{j}": other[:, i, j] for i in range(3) for j in range(4)}
        path.write_text(text_of(columns))
        told = read_pairs(path, Said(length_unit="mm"))
        assert told is not None
        np.testing.assert_allclose(told.pairs.base_from_flange.matrix(), POSES, atol=1e-9)
        np.testing.assert_allclose(told.pairs.camera_from_board.matrix(), other, atol=1e-9)
    columns = {f"{name}{i}{j}": POSES[:, i, j] for name in ("A", "B") for i in range(3) for j in range(4)}
    path.write_text(text_of(columns))
    with fails_with("E-POSES-MIXED … 2 matrices, A, B … base_from_flange_"):
        read_pairs(path, Said())


def test_an_element_that_is_missing_makes_no_matrix():
    columns = elements("T[{}][{}]", 0, 3)
    del columns["T[1][2]"]
    table = Table("table", columns, [2, 3, 4, 5])
    assert find_matrices(table) == []
    assert read_rotations(table) is None
    three = {f"C{i}{j}": POSES[:, i - 1, j - 1] for i in range(1, 4) for j in range(1, 4)}
    turned = read_rotations(Table("table", three, [2, 3, 4, 5]))
    assert turned is not None
    np.testing.assert_allclose(turned.rotation, POSES[:, :3, :3], atol=1e-12)


def kitti(poses: np.ndarray, metres: bool = True) -> str:
    """As the development kit of KITTI's odometry writes poses: 12 numbers, row by row, ``%e``; metres."""
    found = poses[:, :3].copy()
    found[:, :, 3] /= 1000 if metres else 1
    return "".join(" ".join(f"{v:.12e}" for v in m.ravel()) + "\n" for m in found)


@pytest.mark.parametrize("form", FORMS)
def test_rows_of_kitti(tmp_path, form):
    if form in ("tabs", "semicolons and decimal commas"):
        text = FORMS[form](kitti(POSES).replace(" ", ","))
    else:
        text = FORMS[form](kitti(POSES))
    (tmp_path / "p.txt").write_bytes(text)
    np.testing.assert_allclose(read_robot_poses(tmp_path / "p.txt").base_from_flange.matrix(), POSES, atol=1e-6)


def test_a_trajectory_of_kitti_begins_at_the_origin(tmp_path):
    """The left camera in its first frame, metres, whatever its size; a comment and a name before each row are taken."""
    own = np.linalg.inv(POSES[0]) @ POSES
    own[:, :3, 3] *= 30  # up to 50 m: by their size neither metres nor mm
    (tmp_path / "p.txt").write_text("# KITTI\n" + kitti(own))
    posed = read_robot(tmp_path / "p.txt", Said())
    assert posed is not None
    np.testing.assert_allclose(posed.poses.matrix(), own, atol=1e-4)
    assert "as KITTI writes trajectories" in posed.understood
    assert "m as in KITTI" in posed.understood


def test_one_row_of_kitti_that_is_no_rotation_is_named(tmp_path):
    rows = kitti(POSES).splitlines()
    rows[2] = rows[2].replace(rows[2].split()[0], "9.0", 1)
    (tmp_path / "p.txt").write_text("\n".join(rows))
    with fails_with("E-ROTATION-IMPROPER … line 3"):
        read_robot_poses(tmp_path / "p.txt")


def test_matrices_of_three_lines(tmp_path):
    blocks = "\n\n".join("\n".join(line(row) for row in m[:3]) for m in POSES)
    (tmp_path / "p.txt").write_text(blocks)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(read_robot_poses(tmp_path / "p.txt").base_from_flange.matrix(), POSES, atol=1e-9)
    (tmp_path / "p.txt").write_text(blocks.rpartition("\n")[0])
    with fails_with("E-MATRIX-ROWS … 11 rows"):
        read_robot_poses(tmp_path / "p.txt")
