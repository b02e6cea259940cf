"""Lengths of hardware that files state in metres, as it is read in mm."""

import numpy as np
import pytest

from stcal.boards.board_designs import UNIT_SQUARE
from stcal.boards.board_file import load_flat_board
from stcal.boards.target_file import load_target, target_toml
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.locate.layout import TargetLayout, layout_toml, load_layout
from stcal.robot.descriptions import load_urdf
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot
from tests.outcome import refuses
from tests.shared import written

TAGS = 'type = "tags"\n' + "".join(
    f'[[tag]]\ndictionary = "APRILTAG_36h11"\nid = {i}\nsize_mm = {{0}}\nx_mm = {{{i + 1}}}\ny_mm = 0.0\n'
    for i in (0, 1)
)
BOARDS = {
    "dots": 'rows = 7\ncolumns = 9\npitch_mm = {0}\nradius_mm = {1}\npolarity = "dark"\n',
    "chessboard": 'type = "chessboard"\nrows = 5\ncolumns = 7\nsquare_mm = {0}\n',
    "charuco": 'type = "charuco"\nrows = 5\ncolumns = 7\nsquare_mm = {0}\nmarker_mm = {1}\ndictionary = "4X4_50"\n',
    "aprilgrid": 'type = "aprilgrid"\nrows = 3\ncolumns = 3\ntag_mm = {0}\nspacing = 0.3\n',
    "circles": 'type = "asymmetric-circles"\nrows = 11\ncolumns = 4\nspacing_mm = {0}\nradius_mm = {1}\n'
    'polarity = "dark"\n',
}
ROBOT = 'convention = "standard"\n[[joint]]\na_mm = {0}\nalpha_deg = 90\n[[joint]]\na_mm = {1}\n'


@pytest.mark.parametrize("kind", BOARDS)
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_boards_in_another_unit_are_refused(tmp_path, kind, factor):
    text = BOARDS[kind]
    load_flat_board(written(tmp_path / "file.toml", text.format(30.0, 7.0)))
    wrong = text.format(30.0 * factor, 7.0 * factor)
    refuses("E-LENGTH-UNIT … unusual_size", load_flat_board, written(tmp_path / "file.toml", wrong))
    load_flat_board(written(tmp_path / "file.toml", f"unusual_size = true\n{wrong}"))


@pytest.mark.parametrize("size", ["30", "0.5e-4"])
def test_lengths_of_kalibr_are_metres(tmp_path, size):
    text = "target_type: aprilgrid\ntagCols: 3\ntagRows: 3\ntagSize: {}\ntagSpacing: 0.3\n"
    load_flat_board(written(tmp_path / "kalibr.yaml", text.format("0.03")))
    with pytest.raises(InputError, match="tagSize") as caught:
        load_flat_board(written(tmp_path / "kalibr.yaml", text.format(size)))
    assert "metres" in str(caught.value)


def test_layouts_and_places_in_metres_a_tag_inside_another_and_tiny_ones_that_come_back(tmp_path):
    load_layout(written(tmp_path / "file.toml", TAGS.format(60.0, 0.0, 120.0)))
    refuses("E-LENGTH-UNIT … tag 0 … 0.06", load_layout, written(tmp_path / "file.toml", TAGS.format(0.06, 0.0, 0.12)))
    refuses("E-TAG-OVERLAP … 0 … 1 … 0.12", load_layout, written(tmp_path / "file.toml", TAGS.format(60.0, 0.0, 0.12)))
    text = TAGS.format(60.0, 0.0, 0.0).replace("id = 1\nsize_mm = 60.0", "id = 1\nsize_mm = 6.0")
    assert len(load_layout(written(tmp_path / "file.toml", text)).tags) == 2
    tags = (("DICT_APRILTAG_36h11", 0),)
    layout = TargetLayout("tiny", tags, 0.5 * UNIT_SQUARE[None], np.eye(8) * 1e-8, 0, unusual_size=True)
    assert load_layout(written(tmp_path / "file.toml", layout_toml(layout))).corners_mm[0, 1, 0] == pytest.approx(0.25)


def test_targets_in_metres(tmp_path):
    circles = ", ".join(
        f"{{id = {i}, x_mm = {x}, y_mm = {y}, radius_mm = 0.006}}"
        for i, (x, y) in enumerate([(0.01, 0.012), (0.078, 0.01), (0.014, 0.074), (0.046, 0.04)], 1)
    )
    text = f'polarity = "dark"\n[[face]]\nid = "1"\norigin = 1\nx = 2\ny = 3\ncircles = [{circles}]\n'
    refuses("E-LENGTH-UNIT … 1:1 … 0.006", load_target, written(tmp_path / "file.toml", text))
    small = load_target(written(tmp_path / "file.toml", "unusual_size = true\n" + text))
    assert load_target(written(tmp_path / "file.toml", target_toml(small))).faces[0].radius_mm[0] == 0.006


def test_robots_in_metres_one_without_links_and_urdf_in_millimetres(tmp_path):
    load_robot(written(tmp_path / "file.toml", ROBOT.format(0, -612.0)))
    for wrong in (-0.612, -612000.0):
        refuses(
            f"E-LENGTH-UNIT … joint 2 … {wrong:g}", load_robot, written(tmp_path / "file.toml", ROBOT.format(0, wrong))
        )
    load_robot(written(tmp_path / "file.toml", ROBOT.format(0, 0)))  # axes that meet: zeros are meant
    rows = (DHRow(0.02, np.pi / 2, 0.0, 0.0), DHRow(0.0, 0.0, 0.01, 0.0))
    robot = Robot("gimbal", "standard", rows, (Joint(), Joint()), tools={"": Rigid()}, unusual_size=True)
    assert load_robot(written(tmp_path / "file.toml", robot_toml(robot))).rows[0].a == 0.02
    text = (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/><origin xyz="{} 0 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint></robot>'
    )
    load_urdf(written(tmp_path / "r.urdf", text.format(0.612)))
    refuses("E-LENGTH-UNIT … j … 612", load_urdf, written(tmp_path / "r.urdf", text.format(612)))
