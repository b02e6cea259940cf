"""The same poses, written in each format, are read as the same poses; other formats are refused."""

from pathlib import Path

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.handeye.data.pose_content import Said
from stcal.handeye.data.pose_partners import paired
from stcal.workflows.handeye_inputs import Files
from tests.handeye.test_cli import NOISE
from tests.handeye.written import FORMATS, REFUSED, easy_handeye, poses_file, read_robot, table
from tests.outcome import INPUT, assert_error, fails_with
from tests.support.handeye import simulated

PAIRS = simulated(np.random.default_rng(5), 7).pairs
ROUNDING = 1e-9
"""rad and mm: rotations go through quaternions and angles, lengths of a metre through metres."""


def read(arguments, path=None):
    options = {"--rotation": [], "--length-unit": [], "--poses-are": [], "--a": [], "--b": []}
    own = list(arguments)
    source = own.pop(0) if not own[0].startswith("--") else None
    for name, value in zip(own[::2], own[1::2], strict=True):
        options[name].append(value)
    said = Said.of_options(options["--rotation"], options["--length-unit"], options["--poses-are"])
    first, second = (source, None) if source is not None else (options["--a"][0], Path(options["--b"][0]))
    return Files(Path(first), second=second, statements=said).read()


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_poses(name, tmp_path):
    found = read(FORMATS[name](tmp_path, PAIRS))
    for wanted, got in (
        (PAIRS.base_from_flange, found.pairs.base_from_flange),
        (PAIRS.camera_from_board, found.pairs.camera_from_board),
    ):
        assert np.abs(got.difference(wanted)).max() < ROUNDING
    assert len(found.understood) >= 2
    assert found.left_out == ()


@pytest.mark.parametrize("name", REFUSED)
def test_other_formats_are_refused_in_a_line(name, tmp_path):
    """As the robot's poses beside images, as one of two files, and as pairs."""
    path = tmp_path / "poses"
    path.write_text(REFUSED[name])
    np.save(tmp_path / "b.npy", np.array([pose.matrix() for pose in PAIRS.camera_from_board])[:1])
    for call in (
        lambda: read_robot(path, Said()),
        Files(path, second=tmp_path / "b.npy", statements=Said(rotation="rotvec-rad", length_unit="m")).read,
        Files(path).read,
    ):
        with pytest.raises(InputError) as caught:
            call()
        message = str(caught.value)
        assert "\n" not in message
        assert str(path) in message


def test_names_of_rows_are_those_of_images(tmp_path):
    """Without folder and ending too, where that leaves one image and one row."""
    columns = ",".join(f"base_from_flange_{c}" for c in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    row = "0.png,0.1,0.2,0.3,1,0,0,0\n"
    (tmp_path / "poses.csv").write_text(f"image,{columns}\n{row}g/{row}")
    assert paired(read_robot(tmp_path / "poses.csv", Said()), ["g/0.png"], "images").left_out == (
        ("0.png", "in poses.csv alone"),
    )
    np.savez(tmp_path / "r.npz", base_from_flange=np.tile(np.eye(4), (3, 1, 1)), images=["0", "1", "10"])
    robot = read_robot(tmp_path / "r.npz", Said(length_unit="mm"))
    found = paired(robot, ["a/0.png", "a/10.png", "a/7.png"], "in/a")
    assert (found.robot.names, found.rows) == (("0", "10"), [0, 1])
    assert found.left_out == (("1", "in r.npz alone"), ("a/7.png", "in a alone"))
    with fails_with("E-POSES-UNMATCHED … a/1.png"):  # of two folders
        paired(robot, ["a/1.png", "b/1.png"], "in")


def test_tables_of_the_package_are_joined_by_their_names(tmp_path):
    """Rows of one of them are named, and rows without names are not joined by their order."""
    rows, names = [0, 1, 2, 4, 5, 6], [f"{i}.png" for i in range(len(PAIRS))]
    first = table(tmp_path / "a.csv", {"base_from_flange": PAIRS.base_from_flange}, image=names)
    second = table(tmp_path / "b.csv", {"": PAIRS.camera_from_board[rows]}, image=[names[i] for i in rows])
    found = Files(first, second=second).read()
    assert (found.left_out, found.understood) == ((("3.png", "in a.csv alone"),), ())
    assert np.abs(found.pairs.camera_from_board.difference(PAIRS.camera_from_board[rows])).max() < ROUNDING
    with fails_with("E-TABLE-COLUMN-MISSING … shot … --key"):
        Files(first, second=second, key="shot").read()
    alone = table(tmp_path / "c.csv", {"camera_from_board": PAIRS.camera_from_board})
    with fails_with("E-TABLE-COLUMN-MISSING … c.csv … image"):
        Files(first, second=alone).read()
    with fails_with("E-OPTION-NEEDS … --length-unit"):
        Files(first, second=second, statements=Said(length_unit="m")).read()


OWN = ",".join(f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"))
RTDE = "timestamp " + " ".join(f"actual_TCP_pose_{i}" for i in range(6))
VINS = "".join(f"14036365797635558{i:02},0.1,0.2,0.{i},0.8,0.0,0.0,0.6\n" for i in range(3))
"""Of w first and no header, where TUM's files have seconds and w last."""


@pytest.mark.parametrize(
    ("text", "rotation", "order", "names", "place", "turned"),
    [
        (f"image,{OWN}\na.png,1,2,3,0,0.8,0,0.6\n", None, "xyzw", ("a.png",), [1, 2, 3], {(0, 2): 0.96, (1, 1): 1}),
        (f"{RTDE}\n0.008 0.21 -0.2 0.3 0 0 0.5\n", None, "wxyz", ("0.008",), [210, -200, 300], {(1, 0): np.sin(0.5)}),
        (",x,y,z,qx,qy,qz,qw\n0,0.1,0.2,0.3,0,0,0.6,0.8\n", None, "wxyz", ("0",), [100, 200, 300], {(1, 0): 0.96}),
        (VINS, "wxyz", "wxyz", None, [100, 200, 0], {(1, 0): 0.96}),
        (VINS, "xyzw", "wxyz", None, [100, 200, 0], {(2, 1): 0.96}),
    ],
)
def test_tables_of_other_programs_are_read(tmp_path, text, rotation, order, names, place, turned):
    """By the order of columns, a recording of UR's RTDE, an index without a name, and VINS, by either order."""
    (tmp_path / "r.csv").write_text(text)
    found = read_robot(tmp_path / "r.csv", Said(rotation=rotation), order)
    assert found.names == (names or found.names)
    assert found.poses.translation[0] == pytest.approx(place)
    for at, value in turned.items():
        assert found.poses.rotation[0][at] == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "said", "error"),
    [
        (VINS, Said(), "E-ROTATION-AMBIGUOUS … r.csv … wxyz or xyzw"),
        ("X,Y,Z,Rx,Ry,Rz\n100,200,300,10,20,35\n", Said(rotation="ur-rotvec"), "E-ANGLE-UNIT … 35 … rotvec-deg"),
    ],
)
def test_rotations_that_cannot_be_told_are_refused(tmp_path, text, said, error):
    (tmp_path / "r.csv").write_text(text)
    with fails_with(error):
        read_robot(tmp_path / "r.csv", said)


QUICK = ("--method", "pose", "--splits", 0)


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(5), 12, **NOISE)


def test_a_dry_run_says_what_it_understood_and_writes_nothing(command, tmp_path, truth):
    arguments = FORMATS["KUKA"](tmp_path, truth.pairs)
    code, shown, _ = command(*arguments, "--dry-run", "--out", tmp_path / "h.json", "--setup", "eye-in-hand")
    assert code == 0
    lines = shown.splitlines()
    for line, text in (
        (0, "robot: robot.csv: table; 12 poses; base_from_flange by default; a, b, c as Euler angles ZYX"),
        (1, "camera: camera.npy: NumPy array; 12 poses; camera_from_board by default; 4×4 matrices; mm by"),
        (2, "rows joined by their order, for the robot's have no names: line 2 with pose 1"),
        (3, "setup: eye-in-hand, as you say"),
        (4, "pairs: 12"),
    ):
        assert lines[line].startswith(text)
    assert "degrees; mm by the columns" in lines[0]
    assert len(lines) == 5
    assert not (tmp_path / "h.json").exists()
    code, shown, _ = command(poses_file(tmp_path / "poses.csv", truth), "--dry-run")
    assert code == 0
    assert (
        "poses.csv: table; 12 poses; base_from_flange by the columns base_from_flange_…; quaternions by name; mm"
        in shown
    )


def test_a_dry_run_says_what_motion_is_missing(command, tmp_path, truth):
    still = truth.pairs.base_from_flange.matrix()
    still[:, :3, :3] = still[0, :3, :3]
    np.savez(tmp_path / "p.npz", base_from_flange=still, camera_from_board=truth.pairs.camera_from_board.matrix())
    code, shown, _ = command(tmp_path / "p.npz", "--dry-run")
    assert code == 0
    assert "motions: the flange turns by 0° (RMS) between poses; rotate the flange" in shown


def test_the_setup_that_a_file_states_is_taken(command, tmp_path):
    truth = simulated(np.random.default_rng(5), 12, "eye-to-hand", **NOISE)
    arguments = easy_handeye(tmp_path, truth.pairs, "eye_on_base")
    code, shown, _ = command(*arguments, *QUICK)
    assert code == 0
    assert "flange_from_base as easy_handeye writes it of eye-to-hand" in shown
    assert "base_from_camera" in shown
    said = "of eye-to-hand, --setup eye-in-hand; leave it out"
    assert_error(command(*arguments, *QUICK, "--setup", "eye-in-hand"), INPUT, said)
    arguments = easy_handeye(tmp_path, truth.pairs, "")  # as its server leaves it: --setup tells
    assert command(*arguments, *QUICK, "--setup", "eye-to-hand")[0] == 0
