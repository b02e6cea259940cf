"""The same poses, written in each format, are read as the same poses; other formats and false pairs are refused. What
is wrong with a file of poses is said in one line: where, what, and what to do."""

import io
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.handeye import HandEyePoses, read_poses
from stcal.handeye.data.pose_content import Said
from stcal.handeye.data.pose_files import read_pairs, read_robot, read_two
from stcal.handeye.data.pose_pairs import inverted
from stcal.handeye.data.pose_partners import partners, rows_of_images
from stcal.io.table import COVARIANCE
from stcal.workflows.handeye_inputs import Files
from tests.handeye.test_cli import NOISE
from tests.handeye.written import (
    FORMATS,
    REFUSED,
    easy_handeye,
    in_metres,
    message,
    moveit,
    poses_file,
    sides_of,
    table,
    tum,
)
from tests.outcome import INPUT, assert_error, refuses
from tests.shared import written
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


def refused(path, said=None, call=read_robot) -> str:
    with pytest.raises(InputError) as caught:
        call(path, said or Said())
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_poses(name, tmp_path):
    found = read(FORMATS[name](tmp_path, PAIRS))
    for side, wanted in sides_of(PAIRS).items():
        assert np.abs(getattr(found.pairs, side).difference(wanted)).max() < ROUNDING
    assert len(found.understood) >= 2 or name == "columns in metres"  # whose names say it all
    assert found.left_out == ()


@pytest.mark.parametrize("name", REFUSED)
def test_other_formats_are_refused_in_a_line(name, tmp_path):
    """As the robot's poses beside images, as one of two files, and as pairs."""
    path = written(tmp_path / "poses", REFUSED[name])
    np.save(tmp_path / "b.npy", np.array([pose.matrix() for pose in PAIRS.camera_from_board])[:1])
    said = Said(rotation="rotvec-rad", length_unit="m")
    refused(path)
    refused(path, said, lambda path, said: Files(path, second=tmp_path / "b.npy", statements=said).read())
    refused(path, call=lambda path, said: Files(path, statements=said).read())


def test_names_of_rows_are_those_of_images(tmp_path):
    """Without folder and ending too, where that leaves one image and one row."""
    columns = ",".join(f"base_from_flange_{c}" for c in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    row = "0.png,0.1,0.2,0.3,1,0,0,0\n"
    twice = read_robot(written(tmp_path / "poses.csv", f"image,{columns}\n{row}g/{row}"), Said())
    refuses("E-POSE-REPEATED … line 2 and line 3 … 'g/0.png'", rows_of_images, twice, ["g/0.png"])
    np.savez(tmp_path / "r.npz", base_from_flange=np.tile(np.eye(4), (3, 1, 1)), images=["0", "1", "10"])
    found = read_robot(tmp_path / "r.npz", Said(length_unit="mm"))
    assert rows_of_images(found, ["a/0.png", "a/10.png", "a/7.png"]) == ({"a/0.png": 0, "a/10.png": 2}, ("1",), "")
    refuses("E-IMAGE-NAME-AMBIGUOUS … pose 2 … 1 … a/1.png … b/1.png", rows_of_images, found, ["a/1.png", "b/1.png"])


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
    found = read_robot(written(tmp_path / "r.csv", text), Said(rotation=rotation), order)
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
    refuses(error, read_robot, written(tmp_path / "r.csv", text), said)


QUICK = ("--method", "pose", "--splits", 0)


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(5), 12, **NOISE)


def test_a_dry_run_says_what_it_understood_and_what_motion_is_missing_and_writes_nothing(command, tmp_path, truth):
    arguments = FORMATS["KUKA"](tmp_path, truth.pairs)
    code, shown, _ = command(*arguments, "--dry-run", "--out", tmp_path / "h.json", "--setup", "eye-in-hand")
    assert code == 0
    lines = shown.splitlines()
    for line, text in (
        (0, "robot: robot.csv: table; 12 poses; base_from_flange by default; a, b, c as Euler angles ZYX"),
        (1, "camera: camera.npy: NumPy array; 12 poses; camera_from_board by default; 4×4 matrices; mm by"),
        (2, "rows joined by their order, for neither file has names or times"),
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


EIGHT = simulated(np.random.default_rng(1), 8, camera=(1e-3, 0.3))


def test_bad_cells_and_sides_identical_poses_a_board_that_did_not_follow_and_false_matrices_are_named(tmp_path):
    for row, column, cell, error in (
        (2, 0, "nan", "E-TABLE-NUMBER … 4 … base_from_flange_x_mm … 'nan'"),
        (5, 13, "3", "E-QUATERNION-LENGTH … line 7"),
        (0, 8, "abc", "E-TABLE-NUMBER … 2 … camera_from_board_y_mm … 'abc'"),
    ):
        path = poses_file(tmp_path / "poses.csv", EIGHT, lambda rows: rows[row].__setitem__(column, cell))  # noqa: B023
        refuses(error, read_poses, path)
    flange, board = EIGHT.pairs.base_from_flange, EIGHT.pairs.camera_from_board
    every = {"base_from_flange": flange, "flange_from_base": flange.inverse(), "camera_from_board": board}
    for sides, fault in (({"base_from_flange": flange}, "no such columns … camera_from_board"), (every, "both … base")):
        refuses(f"E-TABLE-COLUMN-MISSING … {fault}", read_poses, table(tmp_path / "a.csv", sides))
    rows = [0, 1, 2, 3, 1, 5]
    same = table(tmp_path / "poses.csv", {name: poses[rows] for name, poses in sides_of(EIGHT.pairs).items()})
    refuses("E-POSES-IDENTICAL … line 3 and line 6", read_poses, same)
    refuses("E-POSES-IDENTICAL … pose 4 and pose 5", HandEyePoses, flange, board[[0, 1, 2, 3, 3, 5, 6, 7]])
    flange = [p.matrix() for p in EIGHT.pairs.base_from_flange]
    board = [p.matrix() for p in EIGHT.pairs.camera_from_board]
    same = HandEyePoses.from_matrices(flange, board)
    assert same.camera_from_board.translation == pytest.approx(EIGHT.pairs.camera_from_board.translation)
    mirrored = [m.copy() for m in board]
    mirrored[3][:3, 2] *= -1
    refuses("E-ROTATION-IMPROPER … camera_from_board", HandEyePoses.from_matrices, flange, mirrored)
    broken = [m.copy() for m in flange]
    broken[1][0, 3] = np.inf
    refuses("E-ARRAY-NOT-FINITE", HandEyePoses.from_matrices, broken, board)
    refuses("E-POSES-COUNT … 8 … 7", HandEyePoses.from_matrices, flange, board[:7])
    refuses("E-POSES-COUNT … 7 … 8", HandEyePoses.from_matrices, flange[:7], board)


def test_covariances_are_read_and_turned_over(tmp_path):
    """The inverse's covariance, given under the inverse's name, comes back as the pose's own."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(8, 6, 6)) * np.repeat([1e-3, 0.3], 3)[:, None]
    covariance = root @ np.swapaxes(root, 1, 2)
    board = EIGHT.pairs.camera_from_board
    i, j = np.triu_indices(6)
    _, inverse, _ = inverted(board, covariance, None)
    extra = {f"board_from_camera_{name}": inverse[:, i[k], j[k]] for k, name in enumerate(COVARIANCE)}
    sides = {"base_from_flange": EIGHT.pairs.base_from_flange, "board_from_camera": board.inverse()}
    pairs = read_poses(table(tmp_path / "poses.csv", sides, **extra))
    flange = EIGHT.pairs.base_from_flange
    other = {"flange_from_base": flange.inverse(), "camera_from_board": board}
    for each in (pairs, read_poses(table(tmp_path / "m.csv", other, unit="m"))):
        assert np.abs(each.base_from_flange.difference(flange)).max() < ROUNDING
        assert np.abs(each.camera_from_board.difference(board)).max() < ROUNDING
        assert each.names[:2] == ("line 2", "line 3")
    assert pairs.camera_from_board_covariance == pytest.approx(covariance, rel=1e-6, abs=1e-10)
    assert pairs.base_from_flange_covariance is None
    assert pairs[2:4].camera_from_board_covariance.shape == (2, 6, 6)


FIVE = simulated(np.random.default_rng(5), 5).pairs
GOOD = FIVE.base_from_flange.matrix()


def changed(i: int, edit) -> np.ndarray:
    found = GOOD.copy()
    found[i] = edit(found[i])
    return found


def at(factor: float) -> np.ndarray:
    found = GOOD.copy()
    found[:, :3, 3] *= factor / np.linalg.norm(GOOD[:, :3, 3], axis=1).max()
    return found


@pytest.mark.parametrize(("farthest", "unit", "in_mm"), [(4.9, "m", 1000), (51, "mm", 1)])
def test_the_unit_is_told_by_size(tmp_path, farthest, unit, in_mm):
    path = tmp_path / "poses.npy"
    np.save(path, at(farthest))
    found = read_robot(path, Said())
    assert f"{unit} by their size, up to {farthest:.4g}" in found.understood
    assert np.linalg.norm(found.poses.translation, axis=1).max() == pytest.approx(farthest * in_mm)


@pytest.mark.parametrize("farthest", [5.1, 49])
def test_the_unit_is_asked_for(tmp_path, farthest):
    path = tmp_path / "poses.npy"
    np.save(path, at(farthest))
    assert f"lengths up to {farthest:.3g}" in (said := refused(path))
    assert "give --length-unit mm, cm or m" in said
    stated = read_robot(path, Said.of_options([], ["robot=cm", "camera=m"], []))
    assert np.linalg.norm(stated.poses.translation, axis=1).max() == pytest.approx(10 * farthest)
    assert "cm as you say" in stated.understood


def test_two_sides_in_two_units_are_refused_and_a_direction_that_the_file_states_is_not_changed(tmp_path):
    np.savez(tmp_path / "p.npz", base_from_flange=GOOD, camera_from_board=in_metres(FIVE.camera_from_board))
    assert "the robot's lengths are in mm and the camera's in m" in refused(tmp_path / "p.npz", call=read_pairs)
    told = read_pairs(tmp_path / "p.npz", Said.of_options([], ["camera=m", "robot=mm"], []))
    assert np.abs(told.pairs.camera_from_board.difference(FIVE.camera_from_board)).max() < 1e-9
    np.savez(tmp_path / "p.npz", flange_from_base=GOOD, camera_from_board=FIVE.camera_from_board.matrix())
    said = Said(frames=("base_from_flange",))
    told = refused(tmp_path / "p.npz", said, read_pairs)
    assert "flange_from_base by its name flange_from_base, --poses-are base_from_flange" in told
    np.save(tmp_path / "p.npy", GOOD)
    turned = read_robot(tmp_path / "p.npy", Said(frames=("flange_from_base",)))
    assert turned.poses.inverse().translation == pytest.approx(GOOD[:, :3, 3])


def saved(array, **options) -> bytes:
    content = io.BytesIO()
    np.save(content, array, **options)
    return content.getvalue()


def archived(content: bytes) -> bytes:
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", content)
    return whole.getvalue()


PROGRAM = saved(np.array([{"a": 1}]), allow_pickle=True)
PROMISE = io.BytesIO()
np.lib.format.write_array_header_1_0(PROMISE, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 4, 4)})
DAMAGED = archived(saved(GOOD))

LARGER, IN_METRES = [1.01, 1.01, 1.01, 1], np.array([[1, 1, 1, 1e-3]] * 3 + [[1] * 4])
EULER = "x_mm,y_mm,z_mm"
TUM = "1.5 0.1 0.2 0.3 0 0 0 1\n"


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (saved(changed(2, lambda m: m * LARGER)), ["pose 3", "not a rotation", "1.01", "1 ± 0.001 needed"]),
        (saved(changed(2, lambda m: m * [1, -1, 1, 1])), ["pose 3", "a reflection", "change the sign of one axis"]),
        (saved(changed(1, np.transpose)), ["pose 2", "last row", "0 0 0 1 needed", "transposed"]),
        (saved(changed(4, lambda m: m * [1, 1, 1, np.nan])), ["pose 5", "not finite"]),
        (saved(changed(0, lambda m: m * IN_METRES)), ["pose 1 is", "two units", "--length-unit"]),
        (saved(GOOD[:, :3]), ["no poses", "4×4 matrices", "TUM", "needed"]),
        (saved(np.zeros((0, 4, 4))), ["shape (0, 4, 4); numbers needed"]),
        (PROGRAM, ["not a file of NumPy (Object arrays"]),
        (archived(PROGRAM), ["no arrays of numbers"]),
        (PROMISE.getvalue(), ["not a file of NumPy"]),
        (saved(GOOD) * 2, ["bytes after its array"]),
        (saved(GOOD).replace(b"(5, 4, 4)", b"(5, 4, 4 "), ["not a file of NumPy"]),
        (DAMAGED[:60] + b"\xff" * 20 + DAMAGED[80:], ["not a file of NumPy"]),
        (saved(at(1e300)), ["pose 1: length"]),
        (archived(bytes(101_000_000)), ["101 MB unpacked, at most 100 MB are read"]),
        (pickle.dumps(GOOD), ["not UTF-8 text"]),
        (f"{TUM}{TUM.replace('1.5', '2.5 1')}", ["line 2: 9 numbers, 8 as in the first one needed"]),
        ("p[1, 2, 3, 0, 0, 1]\np[1, 2, 3, 0, 0]\n", ["line 2: 5 numbers, 6 as in the first one needed"]),
        ("p[1, 2, 3, 10, 20, 30]\n", ["Euler angles", "give --rotation, like"]),
        (TUM + TUM, ["line 1 and line 2 are both '1.5'"]),
        (TUM.replace("0 1\n", "1e308 1\n"), ["line 1: quaternion of length inf"]),
        (TUM.replace("0.3", "nan"), ["not finite"]),
        (f"{EULER},a,b,c\n1,2,3,10,20,30\n", ["abc may be", "--rotation, like kuka-abc or mitsubishi-abc"]),
        (f"{EULER},q1,q2,q3,q4\n1,2,3,1,0,0,0\n", ["q1, q2, q3, q4 may be quaternions"]),
        (f"{EULER},euler_ZYX_1_deg,euler_ZYX_2_deg\n1,2,3,1,2\n", ["without euler_ZYX_3_deg; all 3 needed"]),
        (f"image,{EULER},rotvec_x_rad,rotvec_y_rad,rotvec_z_rad\na,1,2,3,0,0,0\na,1,2,3,0,0,1\n", ["are both 'a'"]),
        (f"x_mm,y_mm,z_m,{'rotvec_x_rad,rotvec_y_rad,rotvec_z_rad'}\n1,2,3,0,0,0\n", ["x, y and z in one unit needed"]),
        ("a: &a [1, 1]\nb: [*a, *a]\n", ["alias *a: write the values out"]),
        pytest.param("{" * 1_500, ["not YAML"], marks=pytest.mark.slow),
        ("name: cell\n", ["no poses in keys name …"]),
        ("- {image: a, matrix: [1, 2]}\n", ["no poses in YAML"]),
        ('{"a.png": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', ["a.png: the 3×3 part is not a rotation"]),
        ('{"samples": [{"robot": 1, "tracking": 1}]}', ["sample 1: no translation x, y, z and rotation x, y, z, w"]),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path, content, parts):
    said = refused(written(tmp_path / "poses", content))
    for part in parts:
        assert part in said


def test_bad_conventions_and_options_are_named(tmp_path):
    path = written(tmp_path / "poses.csv", f"{EULER},a,b,c\n1,2,300,0.1,0.2,0.3\n")
    for rotation, error in (
        ("kuka", "E-OPTION-VALUE … --rotation … kuka"),
        ("xyz-grad", "E-OPTION-VALUE"),
        ("wxyz", "E-OPTION-CONTRADICTS … 3 … --rotation … wxyz … 4"),
        ("ZYX", "E-ROTATION-AMBIGUOUS … 0.3 … --rotation … ZYX … ZYX"),
    ):
        refuses(error, read_robot, path, Said(rotation=rotation))
    for error, *options in (
        ("E-OPTION-VALUE … --length-unit feet … mm, m", [], ["feet"], []),
        ("E-OPTION-VALUE … --length-unit tool=m … robot= or camera=", [], ["tool=m"], []),
        ("E-OPTION-REPEATED … --length-unit mm", [], ["m", "mm"], []),
        ("E-OPTION-VALUE … --poses-are tool_from_base … base_from_flange", [], [], ["tool_from_base"]),
        ("E-OPTION-VALUE … one of each side", [], [], ["base_from_flange", "flange_from_base"]),
    ):
        refuses(error, Said.of_options, *options)


def test_the_file_of_the_other_side_and_samples_without_one_side_are_named(tmp_path):
    (arguments,) = easy_handeye(tmp_path, FIVE)
    np.save(tmp_path / "p.npy", GOOD)
    camera = written(tmp_path / "c.json", json.dumps({"camera_from_board": GOOD.tolist()}))
    assert "of camera_from_board, base_from_flange needed here" in refused(camera)
    assert "give the robot's file as --a and the camera's as --b" in refused(tmp_path / "p.npy", call=read_pairs)
    assert len(read_robot(tmp_path / "demo.samples", Said())) == len(FIVE)  # both sides: the robot's are taken
    assert arguments.endswith("demo.samples")
    (path,) = moveit(tmp_path, FIVE)
    text = Path(path).read_text()
    other = text.replace("object_wrt_sensor", "object", 2).replace("object", "object_wrt_sensor", 1)
    broken = written(tmp_path / "broken.yaml", other)
    assert "pose 2: object_wrt_sensor is missing, which pose 1 has" in refused(broken, call=read_pairs)
    samples = [{"robot": message(GOOD[0]), "tracking": message(GOOD[0])}, {"robot": message(GOOD[1])}]
    path = written(tmp_path / "s.json", json.dumps({"samples": samples}))
    assert "sample 2: robot and tracking needed" in refused(path, call=read_pairs)


def test_rows_of_two_files_that_do_not_fit(tmp_path):
    np.save(tmp_path / "a.npy", GOOD)
    np.save(tmp_path / "b.npy", FIVE.camera_from_board.matrix()[:4])
    refuses("E-POSES-COUNT … 5 … 4", read_two, tmp_path / "a.npy", tmp_path / "b.npy", Said(), "image")
    _, a, _, b = tum(tmp_path, FIVE)
    refuses("E-POSES-UNNAMED … b.npy … 100.5000", read_two, Path(a), tmp_path / "b.npy", Said(), "image")
    lines = Path(b).read_text().splitlines()
    late = written(tmp_path / "late.txt", "\n".join([lines[0], *(f"9{row}" for row in lines[1:])]))
    said = "E-POSES-UNMATCHED … 9100.5 … 8996 … robot.txt … 0.02"
    refuses(said, read_two, Path(a), late, Said(), "image")
    fewer = written(tmp_path / "fewer.txt", "\n".join(lines[:3] + lines[4:]))
    told = read_two(Path(a), fewer, Said(), "image")
    assert (told.left_out, len(told.pairs)) == ((("102.5000", "in robot.txt alone"),), 4)


@pytest.mark.parametrize(
    ("first", "second", "rows", "how"),
    [
        (["a", "b"], ["b", "c"], [(1, 0)], ""),
        (["1.50", "2"], ["2.0", "1.5"], [(0, 1), (1, 0)], "by their times as numbers"),
        (["1500000000000000001"], ["1500000000.000000001"], [(0, 0)], "by their times as numbers"),
        (["x/a.png"], ["a.jpg"], [(0, 0)], "by names without folder and ending"),
        (["pos01", "pos02"], ["img2.png", "img1.png"], [(0, 1), (1, 0)], "by the number at the end of each name"),
        (["pos01", "pre01"], ["img1.png", "img2.png"], None, ""),
        (["1.25"], ["img25.png"], None, ""),
    ],
)
def test_names_that_mean_the_same(first, second, rows, how):
    found, said = partners(first, second) or (None, "")
    assert found == rows
    assert said.startswith(how)
    assert bool(said) == bool(how)


@pytest.mark.parametrize(("head", "name"), [("u,v,w,RX,RY,RZ", "p.csv"), ("u;v;w;RX;RY;RZ", "p.txt")])
def test_a_table_that_is_not_understood_is_not_told_to_leave_options_out(tmp_path, head, name):
    between = ";" if ";" in head else ","
    path = written(tmp_path / name, f"{head}\n{between.join('123456')}\n")
    said = Said(rotation="ur-rotvec")
    refuses("E-TABLE-COLUMN-MISSING … base_from_flange_x_mm", Files(path, statements=said).read)
    refuses("E-POSES-NOT-FOUND … u", Files(path, second=path, statements=said).read)
    refuses("E-POSES-NOT-FOUND … u", read_robot, path, said)
