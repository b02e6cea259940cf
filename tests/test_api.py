"""Public names are documented, their constructors are as strict as readers of files, and values show themselves; arrays
in, arrays out: cameras, poses, robots, hand-eyes and images that a program has in memory. Folders can be seen at a
glance, names stand for one thing, and another distribution ``stcal`` in the same environment is refused. pyproject.toml
says who imports whom."""

import copy
import dataclasses
import importlib
import inspect
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stcal
from stcal import Camera, InputError, errors, handeye, locate, register, robot, sfm, synthetic
from stcal.design import TargetDesign, reference_board, reference_target
from stcal.errors import fault
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Poses, Rigid, Similarity
from stcal.handeye import HandEyePoses
from stcal.io.images import decode, grey_of
from stcal.locate import SeenTags
from stcal.robot import DesignOptions, DHRow, IdentifyOptions, Joint, Robot
from stcal.robot.kinematics.robot_model import mh80
from stcal.sfm import RunOptions, Trial
from stcal.sfm.detect.detect_files import files_of_arrays
from stcal.sfm.pipeline import own_checks
from tests.outcome import refuses

SYSTEMS = ("sfm", "robot", "register", "handeye", "locate", "adjust", "synthetic", "workflows")


def public() -> dict[str, object]:
    """Functions and classes of every ``__all__``, by dotted name; constants carry no docstring."""
    modules = [stcal, *(importlib.import_module(f"stcal.{system}") for system in SYSTEMS)]
    found = {f"{m.__name__}.{name}": getattr(m, name) for m in modules for name in getattr(m, "__all__", ())}
    return {name: value for name, value in found.items() if inspect.isclass(value) or inspect.isroutine(value)}


def arguments(value: object) -> set[str]:
    if dataclasses.is_dataclass(value):
        return {field.name for field in dataclasses.fields(value) if field.init and not field.name.startswith("_")}
    if inspect.isclass(value) and issubclass(value, tuple | BaseException):
        return set(getattr(value, "_fields", ()))
    try:
        return {name for name in inspect.signature(value).parameters if name not in ("self", "cls")}
    except ValueError:  # of a class without a signature
        return set()


PUBLIC = public()


def test_public_names_are_shown_listed_documented_and_stand_for_one_thing_in_folders_seen_at_a_glance():
    """Sixty at this writing; an empty ``__all__`` would let everything below pass. They are listed before they are
    loaded, in a process of its own: here all have been used. Every argument or field stands in the docstring."""
    assert len(PUBLIC) > 40
    assert {"stcal.sfm.run", "stcal.robot.identify", "stcal.register.register", "stcal.handeye.handeye"} <= set(PUBLIC)
    code = "from importlib import import_module\n"
    for module in ("stcal", *(f"stcal.{system}" for system in SYSTEMS)):
        code += f"m = import_module('{module}'); print(sorted(set(m.__all__) - set(dir(m))), len(m.__all__) >= 4)\n"
    printed = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines() == ["[] True"] * (1 + len(SYSTEMS))
    named = {name: set(re.findall(r"\w+", value.__doc__ or "")) for name, value in PUBLIC.items()}
    assert {name: missing for name, value in PUBLIC.items() if (missing := arguments(value) - named[name])} == {}
    counts = Counter(path.parent for path in FILES)
    assert {folder: n for folder, n in counts.items() if n > MOST_FILES} == {}
    entries = [p for p in (ROOT / "sfm").iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()]
    assert len(entries) <= MOST_ENTRIES
    assert [path for path in FILES if path.stem == path.parent.name] == []
    stems = Counter(path.stem for path in FILES if not path.stem.startswith("__"))
    assert {stem: n for stem, n in stems.items() if n > 1} == {}
    for system in SYSTEMS[:5]:
        names = importlib.import_module(f"stcal.{system}").__all__
        assert {each.stem for each in (ROOT / system).iterdir()} & set(names) == set()


FACE, TWO = reference_target().faces[:2]
ROW = DHRow(100.0, 0.0, 0.0, 0.0)


def wrong_values(value: object, hint: object) -> list[object]:
    """Values that no field of this type can have, beside one that it has."""
    if isinstance(value, np.ndarray):
        return ["word", [[1, 2], [3]], value + 1j, value[None], None if "None" not in str(hint) else object()]
    if "str" in str(hint) and "tuple" not in str(hint):
        return [object(), 7]
    return [object(), "word", *([] if value is None or not isinstance(value, int | float) else [float("nan")])]


INPUTS = [
    Camera.from_opencv([[900, 0, 500], [0, 900, 400], [0, 0, 1]], [], (1000, 800)),
    Rigid(),
    Poses.of([Rigid()]),
    FACE,
    reference_target(),
    reference_board(),
    reference_board().stated,
    RunOptions(),
    RunOptions().pairs,
    RunOptions().ellipses,
    sfm.MeasureOptions(),
    sfm.MeasureOptions().pose,
    sfm.Tolerances(),
    sfm.PlanOptions(),
    sfm.PlanOptions().noise,
    sfm.DesignOptions((130.0, 120.0, 110.0)),
    Trial("a", 1.0, "mm", 1.0, 1),
    sfm.judge("key", "Title", [Trial("a", 1.0, "mm", 1.0, 1)], "faces", "nothing"),
    ROW,
    Joint(),
    Robot("a", "standard", (ROW,), (Joint(),)),
    robot.Measurements.from_arrays(np.zeros((3, 1)), np.zeros((3, 3))),
    robot.Targets("t", (1,), ("",), Poses.of([Rigid()]), None),
    DesignOptions(),
    IdentifyOptions(),
    register.Pairs("pairs", range(3), np.eye(3), np.eye(3)),
    register.Liu2017Options(),
    HandEyePoses(Poses.of([Rigid()]), Poses.of([Rigid()])),
    handeye.HandEyeOptions(),
    handeye.EvolutionOptions(),
    handeye.Noise(),
    handeye.View(np.eye(4, 3), np.eye(4, 2)),
    locate.TagLayout.from_tags("4X4_50", [3, 7], [[0, 0], [50, 0]], 30),
    locate.LocateOptions(),
    locate.VerdictOptions(),
    locate.PatentOptions(),
    SeenTags([0], np.zeros((1, 4, 2)), np.eye(8)[None]),
    synthetic.SceneOptions(),
    synthetic.RenderOptions(),
    synthetic.BodyOptions(),
    synthetic.ThinLens(8.0, 24.0, 1000.0),
]


@pytest.mark.parametrize("made", INPUTS, ids=lambda made: type(made).__name__)
def test_no_field_takes_a_value_of_another_type_a_copy_is_equal_and_a_value_shows_itself_in_a_line(made):
    """Results with many values: in `tests/sfm/runs/test_results.py`, and by what they are made of."""
    hints, taken = get_type_hints(type(made)), []
    for entry in (each for each in dataclasses.fields(made) if each.init):
        for value in wrong_values(getattr(made, entry.name), hints[entry.name]):
            if value is None and entry.default is None:
                continue
            try:
                replace(made, **{entry.name: value})
            except InputError:
                continue
            taken.append((entry.name, value))
    assert taken == []
    for again in (copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert (again, hash(again)) == (made, hash(made))
    assert len(repr(made)) < 600
    assert len(repr(made)) < 200 or "array([[" not in repr(made) or isinstance(made, Rigid)


def test_results_designs_and_transforms_are_equal_by_value():
    """Those of the engine of least squares hold functions."""
    kinds = [kind for name, kind in PUBLIC.items() if dataclasses.is_dataclass(kind) and "adjust" not in name]
    assert [kind for kind in kinds if kind.__eq__ is object.__eq__] == []
    xyz = np.vstack([np.eye(3), np.ones((1, 3)), -np.eye(3)])
    found = register.register(xyz, xyz + 1.0)
    assert pickle.loads(pickle.dumps(found)) == found != replace(found, notes=("another",))
    assert reference_target() != replace(reference_target(), name="another")
    turned = Rigid.exp([0.1, 0, 0, 1, 2, 3])
    again = Rigid(turned.rotation, turned.translation)
    assert turned == again != Rigid()
    assert len({turned, again, Rigid(), Rigid([[1, 0, 0], [0, 1, -0.0], [0, 0, 1]])}) == 2
    assert Poses.of([turned, Rigid()]) == Poses.of([turned, Rigid()]) != Poses.of([Rigid(), turned])
    assert Similarity(2.0, turned) == Similarity(2.0, turned) != Similarity(2.0, Rigid())
    assert Rigid() != "identity"


def test_errors_speak_of_arguments(monkeypatch):
    """Where the command's name of an option differs, `PYTHON_NAMES` has that of the argument."""
    monkeypatch.delenv(errors.COMMAND_LINE, raising=False)
    said = InputError("E-TEST", "--to-link a, --no-strict: give '--flatness 0.1', as `stcal robot --dh` has it; a--b")
    assert str(said) == "to_link a, strict=False: give 'flatness_mm 0.1', as `stcal robot --dh` has it; a--b"
    said.append(", or --out")
    with errors.at_command_line():
        assert str(said).startswith("--to-link a, --no-strict")
        assert str(said).endswith(", or --out")
    assert errors.COMMAND_LINE not in os.environ
    assert str(pickle.loads(pickle.dumps(said))) == str(said)
    refuses("E-OPTION-RANGE … flatness_mm 1e+09", RunOptions(flatness_mm=1e9).settled, reference_target())
    assert all(name.split(".")[0] in RunOptions.__dataclass_fields__ for name in errors.PYTHON_NAMES.values())


ROOT = Path(stcal.__file__).parent
FILES = sorted(path.relative_to(ROOT) for path in ROOT.rglob("*.py"))
MOST_FILES = 14
"""Most files of a folder: what can be seen at a glance."""
MOST_ENTRIES = 16  # most folders and files of `sfm/`


def test_another_distribution_beside_the_package_is_refused_at_import(tmp_path):
    (tmp_path / "stereo_target_calibration-0.1.0.dist-info").mkdir()
    assert fault(tmp_path / "stcal") == ""
    package = tmp_path / "stcal"
    package.mkdir()
    for name in ("__init__.py", "errors.py"):
        shutil.copy(Path(stcal.__file__).with_name(name), package)
    (tmp_path / "stcal-1.20.0.dist-info").mkdir()
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import stcal"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    last = ended.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {package}: the distribution stcal 1.20.0")
    assert "pip uninstall stcal" in last


MATRIX = np.array([[900.0, 0, 640.3], [0, 905.0, 355.8], [0, 0, 1]])
SIZE = (1280, 720)
EIGHT = [-0.2, 0.08, 1e-3, -5e-4, 0.01, 0.02, -0.01, 0.005]
POINTS = np.random.default_rng(1).uniform([-200, -100, 500], [200, 100, 900], (30, 3))
ROUNDING_PX = 1e-9  # of a dozen products of numbers below 1e3 in double precision


def test_cameras_of_opencv_project_as_opencv():
    for count in (0, 4, 5, 8):
        camera = Camera.from_opencv(MATRIX, EIGHT[:count], SIZE)
        wanted, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, np.array(EIGHT[:count]))
        assert np.abs(camera.project(POINTS) - wanted[:, 0]).max() < ROUNDING_PX
        assert np.isnan(camera.project(-POINTS)).all()  # behind it
        matrix, distortion = camera.to_opencv()
        assert ((matrix == MATRIX).all(), len(distortion)) == (True, max(4, count))
        assert Camera.from_opencv(matrix, distortion, SIZE).same_as(camera)
    four = np.array([0.02, -0.01, 0.003, -0.001])
    camera = Camera.from_opencv(MATRIX, four, SIZE, fisheye=True)
    wanted, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), MATRIX, four)
    assert np.abs(camera.project(POINTS) - wanted[:, 0]).max() < ROUNDING_PX
    assert camera.colmap_model == "OPENCV_FISHEYE"
    assert np.array_equal(camera.to_opencv()[1], four)


SKEWED = MATRIX + np.diag([2.0, 0], 1)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: Joint("Prismatic"), "E-OPTION-VALUE … 'Prismatic' … revolute or prismatic"),
        (lambda: Joint(lower=1.0, upper=-1.0), "E-ROBOT-LIMITS … 1 … -1"),
        (lambda: Joint(fixed={"alpha_deg": "why"}), "E-ROBOT-FIXED … alpha_deg … alpha"),
        (lambda: DHRow(float("nan"), 0, 0, 0), "E-ROBOT-ROW … a … nan"),
        (lambda: DHRow(0, "0", 0, 0), "E-ROBOT-ROW … alpha … '0'"),
        (lambda: Robot("a", "Modified", (ROW,), (Joint(),)), "E-OPTION-VALUE … robot a … 'Modified'"),
        (lambda: Robot("a", "modified", ((1, 2, 3, 4),), (Joint(),)), "E-FIELD-TYPE … rows … DHRow"),
        (lambda: Robot("a", "modified", (DHRow(0.4, 0, 0.1, 0),), (Joint(),)), "E-LENGTH-UNIT … 0.4 mm … metres"),
        (lambda: TargetDesign("t", "black", (FACE,)), "E-OPTION-VALUE … 'black' … bright or dark"),
        (
            lambda: TargetDesign("t", "dark", (replace(FACE, xy_mm=FACE.xy_mm / 1e3, radius_mm=FACE.radius_mm / 1e3),)),
            "E-LENGTH-UNIT … metres",
        ),
        (lambda: replace(FACE, ids=FACE.ids[:-1]), "E-ARRAY-SHAPE … face 1"),
        (lambda: replace(FACE, radius_mm=0 * FACE.radius_mm), "E-TARGET-RADIUS … 0 mm"),
        (lambda: replace(FACE, radius_mm=-FACE.radius_mm), "E-TARGET-RADIUS … -"),
        (lambda: replace(reference_board(), polarity="black"), "E-OPTION-VALUE … 'black'"),
        (lambda: replace(reference_board(), pitch_mm=0.03, radius_mm=0.01), "E-LENGTH-UNIT … 0.03 mm"),
        (lambda: replace(reference_board(), rows=0), "E-BOARD-SIZE … 0 rows"),
        (lambda: replace(reference_board(), corner=(0, 0)), "E-BOARD-CORNER … None"),
        (lambda: replace(reference_board(), sigma_mm=-1.0), "E-SIGMA-VALUE … -1"),
        (lambda: RunOptions(solve="Joint"), "E-OPTION-VALUE … solve 'Joint' … joint"),
        (lambda: IdentifyOptions(model="stiff"), "E-OPTION-VALUE … model 'stiff'"),
        (lambda: DesignOptions(observe="poses"), "E-OPTION-VALUE … observe 'poses'"),
        (lambda: RunOptions(workers=0), "E-OPTION-RANGE … workers 0 … 1"),
        (lambda: RunOptions(exclude="12/a.jpg"), "E-FIELD-TYPE … exclude '12/a.jpg' … tuple"),
        (lambda: replace(FACE, xy_mm=[["0", "1"]] * len(FACE.ids)), "E-ARRAY-TYPE … face 1"),
        (lambda: Rigid.exp([0] * 6) and Rigid(translation=[0, "1", 2]), "E-ARRAY-TYPE … translation"),
        (lambda: SeenTags([0.5], np.zeros((1, 4, 2)), np.eye(8)[None]), "E-ARRAY-TYPE … rows … whole"),
        (lambda: Camera(2.5, 3, [1, 1], [1, 1], [0] * 8), "E-FIELD-TYPE … width 2.5 … whole"),
        (lambda: HandEyePoses(Poses.of([Rigid()]).matrix(), Poses.of([Rigid()])), "E-FIELD-TYPE … Poses"),
        (lambda: Camera.from_opencv(SKEWED, [], SIZE), "E-CAMERA-MATRIX … 2.0 … skew"),
        (lambda: Camera.from_opencv(MATRIX[:2], [], SIZE), "E-ARRAY-SHAPE … (2, 3)"),
        (lambda: Camera.from_opencv(MATRIX, EIGHT[:6], SIZE), "E-CAMERA-COEFFICIENTS … 6 … 4, 5, 8"),
        (lambda: Camera.from_opencv(MATRIX, EIGHT[:5], SIZE, fisheye=True), "E-CAMERA-COEFFICIENTS … 5 … k1 to k4"),
        (lambda: Camera.from_opencv(MATRIX, [], (0, 720)), "E-CAMERA-SIZE … 0×720"),
        (lambda: Camera(*SIZE, [9, 9], [5, 5], np.zeros(8), colmap_model="OPENCV_FISHEYE"), "E-CAMERA-MODEL … OPENCV"),
        (lambda: Camera(*SIZE, [9, 9], [5, 5], np.zeros(8), covariance=np.eye(3)), "E-ARRAY-SHAPE … (12, 12)"),
        (
            lambda: Camera(*SIZE, [900, 900], [640, 360], [0, 0, 1e-3, 0, 0, 0, 0, 0], True).to_opencv(),
            "E-CAMERA-MODEL … fish",
        ),
        (lambda: Rigid.exp([1, 2]), "E-ARRAY-SHAPE … (2,)"),
        (lambda: Poses.from_quaternions([[1, 0, 0]], [[0, 0, 0]]), "E-ARRAY-SHAPE … quaternions"),
        (lambda: Poses.from_matrices([np.eye(4), -np.eye(4)]), "E-MATRIX-LAST-ROW … pose 2"),
        (lambda: robot.Robot.from_dh(np.zeros((6, 3)), "standard"), "E-ARRAY-SHAPE … (6, 3) … a, alpha, d, theta"),
        (lambda: robot.Robot.from_dh(np.full((2, 4), 300), "standard", np.zeros((3, 2))), "E-ARRAY-SHAPE … (3, 2)"),
        (lambda: robot.Measurements.from_arrays(np.zeros((4, 6))), "E-MEASURED-KIND … positions"),
        (lambda: robot.Measurements.from_arrays(np.zeros((4, 6)), np.zeros((3, 3))), "E-ARRAY-SHAPE … positions"),
        (lambda: robot.Targets("t", (1,), ("",), Poses.of([Rigid()]), np.zeros((2, 6))), "E-ARRAY-SHAPE … (2, 6)"),
        (lambda: handeye.HandEyePoses.from_matrices([], [], unit="km"), "E-OPTION-VALUE … 'km' … mm"),
        (lambda: files_of_arrays({}), "E-IMAGES-NONE … memory"),
        (lambda: files_of_arrays({"a/b": [np.zeros((4, 4), np.uint8)]}), "E-IMAGES-GROUP … 'a/b'"),
        (lambda: files_of_arrays({"..": [np.zeros((4, 4), np.uint8)]}), "E-IMAGES-GROUP … '..'"),
        (lambda: files_of_arrays({"a": [np.zeros((4, 4))]}), "E-IMAGE-TYPE … a/0.png … float64"),
        (lambda: sfm.Tracker("target", Camera.from_opencv(MATRIX, [], SIZE)), "E-FACES-DESIGN … str … circles()"),
    ],
)
def test_constructors_are_as_strict_as_readers_of_files(make, error):
    refuses(error, make)


def test_a_camera_keeps_its_covariance_and_its_model_in_files_and_takes_a_size_that_none_states(tmp_path):
    camera = replace(Camera.from_opencv(MATRIX, EIGHT[:4], SIZE), covariance=np.diag(np.arange(1.0, 9.0)))
    assert stcal.save_camera(tmp_path / "cameras.txt", camera) == ()
    again = stcal.load_camera(tmp_path / "cameras.txt")
    assert again.same_as(camera)
    assert again.colmap_model == "OPENCV"
    assert np.allclose(again.covariance, camera.covariance, rtol=1e-12)
    assert stcal.save_camera(tmp_path / "camera.yaml", camera) == ("σ and correlations of the parameters",)
    refuses("E-OPTION-FORM … camera.json … .json", stcal.save_camera, tmp_path / "camera.json", camera)
    (tmp_path / "m.yaml").write_text(f"camera_matrix: {MATRIX.tolist()}\ndist_coeffs: {EIGHT[:4]}\n", encoding="utf-8")
    refuses("E-CAMERA-SIZE … m.yaml", stcal.load_camera, tmp_path / "m.yaml")
    assert stcal.load_camera(tmp_path / "m.yaml", size=SIZE).same_as(Camera.from_opencv(MATRIX, EIGHT[:4], SIZE))


def test_transforms_are_taken_and_given_also_in_metres():
    turn = Rotation.from_euler("xyz", [0.3, -0.2, 0.9])
    one = Rigid(turn, [1, 2, 3])
    assert (one.as_scipy().inv() * turn).magnitude() < 1e-15
    assert Poses.from_matrices(np.array([one.matrix()] * 2))[1] == Rigid.from_matrix(one.matrix())
    a_from_b = Similarity(2.5, Rigid.exp([0.1, 0.2, 0.3, 4, 5, 6]))
    moved = a_from_b.matrix() @ np.column_stack([POINTS, np.ones(len(POINTS))]).T
    assert np.allclose(moved[:3].T, a_from_b @ POINTS, rtol=1e-14)
    poses = Poses.of(Rigid.exp([0.1 * k, 0.2, -0.1 * k, 100.0 * k, 50, 20 * k]) for k in range(4))
    metres = poses.matrix() * np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])
    pairs = handeye.HandEyePoses.from_matrices(metres, Poses(poses.rotation, 1e-3 * poses.translation), unit="m")
    for side in (pairs.base_from_flange, pairs.camera_from_board):
        assert np.allclose(side.matrix(), poses.matrix(), rtol=1e-14)


def test_a_table_and_arrays_make_the_robot_and_its_data():
    arm = mh80()
    table = [[row.a, row.alpha, row.d, row.theta] for row in arm.rows]
    made = robot.Robot.from_dh(table, "standard", arm.limits(), name="MH80")
    assert (made.rows, made.joints) == (arm.rows, arm.joints)
    q = np.random.default_rng(2).uniform(-0.5, 0.5, (5, 6))
    reached = robot.forward(arm, q)
    data = robot.Measurements.from_arrays(q, poses=reached)
    assert data.poses() == reached
    assert (data.targets, list(data.lines)) == (("",) * 5, [1, 2, 3, 4, 5])
    by_poses = robot.compensate(arm, reached, arm)
    assert by_poses.found.usable.all()
    assert np.abs(robot.forward(arm, by_poses.found.q).translation - reached.translation).max() < 1e-3  # µm


def test_images_in_memory_are_read_to_the_last_bit_and_colours_in_the_channel_that_tells_them():
    """Red 200 and green 102 have the same grey value."""
    rng = np.random.default_rng(3)
    grey, deep = rng.integers(0, 256, (40, 60), np.uint8), rng.integers(0, 65536, (40, 60), np.uint16)
    files, skipped = files_of_arrays({"12": [grey, deep], "13": [np.dstack([grey] * 3)]}, exclude=["12/1.png"])
    assert [file.name for file in files] == ["12/0.png", "13/0.png"]
    assert [each.name for each in skipped] == ["12/1.png"]
    for file in files:
        assert np.array_equal(decode(file.read(), file.name), grey)
    (both, _) = files_of_arrays({"12": [grey, deep]})
    assert np.array_equal(decode(both[1].read(), "12/1.png"), deep)
    for scale in (1, 257):
        image = np.zeros((40, 60, 3), np.uint8 if scale == 1 else np.uint16)
        image[..., 1] = 102 * scale
        image[10:30, 20:40] = (200 * scale, 0, 0)
        png = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
        for grey in (grey_of(image, "a"), decode(png, "a.png")):
            assert grey[0, 0] == 0
            assert grey[20, 30] == 200 * scale
        image[:5] = 255 * scale  # something else is seen in grey: it stays
        assert grey_of(image, "a")[20, 30] == pytest.approx(60 * scale, rel=0.02)


def check(key: str) -> sfm.Check:
    return sfm.judge(key, "Mine", [sfm.Trial("it", 5.0, "mm", statistic=25.0, freedom=1)], "things", "mend it")


class Result:
    """What a check of one's own is given, as far as names are concerned."""

    checks = (check("camera"),)


def test_checks_of_ones_own_have_their_own_names_and_lose_no_result():
    assert [each.verdict for each in own_checks(Result(), [lambda _: check("mine")])] == ["failed"]  # 5 σ
    for make, said in (
        (lambda _: check("camera"), "it has the key 'camera' of another"),
        (lambda _: True, "it returned bool, a Check needed"),
        (lambda _: [][1], "it raised IndexError: list index out of range"),
    ):
        first, second = own_checks(Result(), [make, make])
        assert (first.verdict, second.verdict) == ("suspicious", "suspicious")
        assert first.reason.startswith(said)
        assert first.key != second.key


def test_a_result_shows_itself_in_a_line_and_masked_values_are_refused():
    """A notebook prints it."""
    pair = np.random.default_rng(0).uniform(-100, 100, (60, 3))
    result = stcal.register.register(pair, pair + np.array([1.0, 2.0, 3.0]))
    assert repr(result).startswith("Registration(")
    assert len(repr(result)) < 1000
    assert "\n" not in repr(result)
    pair = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    off = pair + np.eye(20, 3) * 9.0
    result = stcal.register.register(pair, off, method="least-squares")
    assert result.notes
    assert result.notes[0] in repr(result)
    pair = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    other = np.ma.array(pair + 1.0, mask=np.zeros_like(pair, bool))
    stcal.register.register(pair, other)  # nothing is masked
    other.mask[4] = True
    for call in (lambda: stcal.register.register(pair, other), lambda: frozen(other)):
        refuses("E-ARRAY-NOT-FINITE … 3 values are masked; leave out their rows", call)
