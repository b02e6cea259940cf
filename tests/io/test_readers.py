"""Readers of files that people or other programs write: another encoding, line end or order of keys changes nothing.

One key more is named. Camera files: ``test_camera.py``.
"""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stcal.boards.board_file import load_board, load_flat_board
from stcal.boards.target_file import load_boards, load_target
from stcal.design import StatedSize
from stcal.errors import InputNote, StcalError
from stcal.handeye.data.pose_content import Said
from stcal.handeye.data.pose_files import read_pairs, read_robot
from stcal.io.files import text_of
from stcal.io.table import POSE, read_table
from stcal.locate.layout import load_plan
from stcal.robot.descriptions import load_universal, load_urdf
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.sfm.budget.combine import statement_of
from tests.boards.test_bundle import BUNDLE
from tests.boards.test_files import KALIBR, TAG, TARGET
from tests.io.test_lengths import BOARDS
from tests.robot.test_descriptions import UR5E, yaml_of

TABLE = "name,x_mm,y_mm,z_mm\n" + "".join(f"P{i},{i}.25,{-i}.5,{10 * i}\n" for i in range(1, 5))
SINES = ((1, 0.0, 1.0), (2, 0.6, 0.8), (3, -0.6, 0.8), (4, 0.8, 0.6))
ROWS = "".join(f"{10 + i}.5 {0.1 * i:.1f} 0.2 0.3 0.0 0.0 {s} {c}\n" for i, s, c in SINES)
CELLS = "".join(f"{i}.png,{i}.5,2,{-i},{c},{s},0,0\n" for i, s, c in SINES)
EASY = "parameters: {eye_on_hand: true}\nsamples:\n" + "".join(
    f"- robot: {{translation: {{x: {x}, y: 0.1, z: 0.5}}, rotation: {{x: {s}, y: 0.0, z: 0.0, w: {c}}}}}\n"
    f"  optical: {{translation: {{x: 0.0, y: {x}, z: 0.7}}, rotation: {{x: 0.0, y: {s}, z: 0.0, w: {c}}}}}\n"
    for x, s, c in ((0.1, 0.0, 1.0), (0.2, 0.6, 0.8), (0.3, -0.6, 0.8))
)


def of_board(path: Path) -> np.ndarray:
    return load_flat_board(path).xy_mm()


def of_table(path: Path) -> np.ndarray:
    table = read_table(path, "points")
    return np.column_stack([table.numbers(f"{axis}_mm") for axis in "xyz"])


def of_target(path: Path) -> np.ndarray:
    (face,) = load_target(path).faces
    return np.column_stack([face.xy_mm, face.radius_mm])


def rows_of(load: Callable[[Path], Robot]) -> Callable[[Path], np.ndarray]:
    return lambda path: np.array(robot_toml(load(path)).splitlines())


def of_robot_poses(path: Path) -> np.ndarray:
    poses = read_robot(path, Said()).poses
    return np.hstack([poses.translation, poses.rotation.reshape(-1, 9)])


def of_pairs(path: Path) -> np.ndarray:
    told = read_pairs(path, Said())
    return np.hstack([told.pairs.base_from_flange.translation, told.pairs.camera_from_board.translation])


URDF = '<robot name="a">\n  <link name="base_link"/>\n' + "".join(
    f'  <link name="l{i}"/>\n  <joint name="j{i}" type="revolute">\n    <parent link="{parent}"/>\n'
    f'    <child link="l{i}"/>\n    <origin xyz="0.{i} 0 0.3" rpy="{roll} 0 0"/>\n    <axis xyz="0 0 1"/>\n'
    '    <limit lower="-3" upper="3" effort="1" velocity="1"/>\n  </joint>\n'
    for i, parent, roll in ((1, "base_link", 0.0), (2, "l1", 1.5), (3, "l2", -1.5))
)
URDF += "</robot>\n"
CONF = (
    "[mounting]\ndelta_theta = [ 1e-5, 0.3, -0.3, 1e-5, -2e-5, 0]\ndelta_a = [ 1e-5, 0.02, 3e-3, -5e-5, 8e-6, 0]\n"
    "delta_d = [ 4e-5, 300.0, -320.0, 20.0, 1e-5, -4e-4]\ndelta_alpha = [ 1e-4, 3e-4, 6e-3, -1e-3, -2e-4, 0]\n"
    "\n[DH]\na = [0, -0.6127, -0.57155, 0, 0, 0]\nd = [0.1807, 0, 0, 0.17415, 0.11985, 0.11655]\n"
    "alpha = [1.570796327, 0, 0, 1.570796327, -1.570796327, 0]\n"
)
MATRICES = [
    [[c, -s, 0, x], [s, c, 0, 0.2], [0, 0, 1, 0.5], [0, 0, 0, 1]] for x, s, c in ((0.1, 0.6, 0.8), (0.2, 0.8, 0.6))
]


def of_statement(path: Path) -> np.ndarray:
    return np.array([repr(statement_of(StatedSize(), path))])


READERS: dict[str, tuple[str, Callable[[Path], np.ndarray]]] = {
    "table": (TABLE, of_table),
    **{name: (text.format(20.0, 6.0), of_board) for name, text in BOARDS.items()},
    "Kalibr, AprilGrid": (KALIBR["aprilgrid"], of_board),
    "target": (TARGET, of_target),
    "robot": (robot_toml(mh80()), rows_of(load_robot)),
    "easy_handeye": (EASY, of_pairs),
    "body": (
        'name = "a"\n\n[[face]]\nid = "1"\n'
        'board = { type = "charuco", rows = 5, columns = 5, square_mm = 10, marker_mm = 7, dictionary = "4X4_50" }\n'
        '\n[[face]]\nid = "2"\ntags = [{ dictionary = "tag36h11", id = 3, size_mm = 40, x_mm = 0, y_mm = 0 }]\n',
        lambda path: np.concatenate([face.xy_mm for face in load_target(path).faces]),
    ),
    "board of a run": (
        'type = "aprilgrid"\nrows = 3\ncolumns = 4\ntag_mm = 30.0\nspacing = 0.3\nfirst_id = 5\n',
        lambda path: load_board(path).xy_mm(),
    ),
    "several boards": (
        'type = "boards"\n\n[[board]]\ntype = "aprilgrid"\nrows = 2\ncolumns = 2\ntag_mm = 30.0\nspacing = 0.3\n'
        '\n[[board]]\ntype = "chessboard"\nrows = 5\ncolumns = 8\nsquare_mm = 20.0\nx_mm = 300.0\n'
        "y_mm = 0.0\nz_mm = 0.0\nqw = 0.8\nqx = 0.6\nqy = 0.0\nqz = 0.0\n",
        lambda path: load_boards(path).xyz_mm(),
    ),
    "tags": (TAG, of_board),
    "layout": (f"origin = 1\n{TAG}", lambda path: np.array([repr(load_plan(path))])),
    "apriltag_ros": (BUNDLE, of_board),
    "Universal Robots": (yaml_of(UR5E), rows_of(lambda path: load_universal(path).robot)),
    "poses, rows of TUM": (ROWS, of_robot_poses),
    "poses, table": (f"image,{','.join(f'base_from_flange_{name}' for name in POSE)}\n{CELLS}", of_robot_poses),
    "URDF": (URDF, rows_of(lambda path: load_urdf(path).robot)),
    "calibration.conf": (CONF, rows_of(lambda path: load_universal(path).robot)),
    "statement": ('[fields]\noperator = "A"\n\n[board]\ntemperature_c = 21.5\n', of_statement),
    "poses, JSON": (json.dumps({"base_from_flange": MATRICES, "units": "m"}, indent=1), of_robot_poses),
    "poses, MoveIt": (
        "".join(f"- effector_wrt_world: {each}\n  object_wrt_sensor: {each}\n" for each in MATRICES),
        of_pairs,
    ),
}
OF_YAML = [name for name in READERS if name.startswith(("Kalibr", "easy", "apriltag_ros", "Universal"))]
OF_ROWS = [name for name in READERS if "table" in name or "rows" in name]
WITH_SETTINGS = ("easy_handeye", "apriltag_ros", "URDF", "calibration.conf", "poses, JSON", "poses, MoveIt")
"""Their other keys are settings of their programs, or properties of other parts of the robot, and change nothing."""
OF_KEYS = [name for name in READERS if name not in OF_ROWS]


def outcome(read: Callable[[Path], np.ndarray], path: Path, content: bytes) -> tuple[np.ndarray | None, list[str]]:
    """What was read, None after an error, and what was said."""
    path.write_bytes(content)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputNote)
        try:
            return read(path), [str(each.message) for each in caught]
        except StcalError as error:
            return None, [str(error)]


FORMS: dict[str, Callable[[str], bytes]] = {
    "byte-order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "utf-16": lambda text: text.encode("utf-16"),
    "utf-16, big endian": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "crlf": lambda text: text.replace("\n", "\r\n").encode(),
    "cr": lambda text: text.replace("\n", "\r").encode(),
    "blank lines": lambda text: f"\n\n{text}\n\n".encode(),
    "no last line end": lambda text: text.rstrip("\n").encode(),
}


@pytest.mark.parametrize("form", FORMS)
def test_another_encoding_or_line_end_changes_nothing(form):
    lines = [line for line in text_of(FORMS[form](TABLE)).splitlines() if line]
    assert lines == TABLE.splitlines()


@pytest.mark.parametrize("name", READERS)
def test_every_reader_decodes_its_text(tmp_path, name):
    text, read = READERS[name]
    wanted, said = outcome(read, tmp_path / "file", text.encode())
    assert wanted is not None, said
    other = "\n{}\n".format(text.rstrip("\n")).replace("\n", "\r\n")
    found, said = outcome(read, tmp_path / "file", other.encode("utf-16"))
    assert found is not None, said
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("name", ["table", "dots", "URDF"])
def test_text_of_another_encoding_is_named(tmp_path, name):
    """Latin-1 is no UTF-8; of a table of numbers it could be guessed, and is not. One reader of each kind of text."""
    text, read = READERS[name]
    found, said = outcome(read, tmp_path / "file", f"<!-- Gerät -->{text}".encode("latin-1"))
    assert found is None
    assert any(word in said[0] for word in ("UTF-8", "utf-8", "not XML")), said
    assert "\n" not in said[0]


@pytest.mark.parametrize("name", OF_KEYS)
def test_an_unknown_key_is_named(tmp_path, name):
    text, read = READERS[name]
    more = "operator_42: 7\n" if name in OF_YAML else "operator_42 = 7\n"
    longer = {
        "URDF": text.replace("<axis", '<operator_42 value="7"/>\n    <axis'),
        "poses, JSON": text.replace("{", '{"operator_42": 7,', 1),
        "poses, MoveIt": text.replace("- eff", "- operator_42: 7\n  eff"),
    }.get(name, f"{more}{text}")
    found, said = outcome(read, tmp_path / "file", longer.encode())
    if name in WITH_SETTINGS:
        np.testing.assert_array_equal(found, outcome(read, tmp_path / "file", text.encode())[0])
    else:
        assert any("operator_42" in each for each in said), said


def test_columns_of_a_table_may_stand_in_any_order(tmp_path):
    rows = [line.split(",") for line in TABLE.splitlines()]
    turned = "\n".join(",".join(reversed([*row, "weather" if i == 0 else "7"])) for i, row in enumerate(rows))
    wanted, _ = outcome(of_table, tmp_path / "file", TABLE.encode())
    found, _ = outcome(of_table, tmp_path / "file", turned.encode())
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize(
    ("name", "between", "end"), [("URDF", "  <joint", "</robot>\n"), ("Universal Robots", "\n  ", "\n")]
)
def test_parts_of_a_robot_may_stand_in_any_order(tmp_path, name, between, end):
    text, read = READERS[name]
    first, *parts = text.removesuffix(end).split(between)
    turned = between.join([first, *reversed(parts)]) + end
    wanted, _ = outcome(read, tmp_path / "file", text.encode())
    found, said = outcome(read, tmp_path / "file", turned.encode())
    assert found is not None, said
    np.testing.assert_array_equal(found, wanted)
