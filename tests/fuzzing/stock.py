"""Valid inputs of every command, small, made once; a case copies of them what it spoils."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from stcal.boards.target_file import target_toml
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.read import WRITERS, read_camera, save_camera
from stcal.io.table import POSE, pose_cells
from stcal.locate.layout import layout_toml
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.robot_file import robot_toml
from stcal.robot.kinematics.robot_model import Conditions, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.sfm.interop.export_colmap import export_model
from stcal.sfm.make import make_pattern, sides_of
from stcal.sfm.pipeline import detect_images, run
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.boards.drawn import chessboard_mm
from tests.handeye.photographed import looks, photographs
from tests.handeye.written import poses_file
from tests.locate.drawn_target import CAMERA, LAYOUT, PER_MM, photo, sheet, tilted
from tests.shared import own_copy
from tests.support.arms import elastic
from tests.support.handeye import simulated

SMALL = SceneOptions(seed=3, width=1296, height=864, images_per_group=4, groups=(("1", "2"), ("1", "4")))
"""As the tests' small data set."""
CHESSBOARD = 'type = "chessboard"\nrows = 6\ncolumns = 8\nsquare_mm = 20\n'
KALIBR = "target_type: checkerboard\ntargetRows: 6\ntargetCols: 8\nrowSpacingMeters: 0.02\ncolSpacingMeters: 0.02\n"
BOARDS = """type = "boards"
[[board]]
type = "charuco"
rows = 7
columns = 5
square_mm = 30.0
marker_mm = 20.0
dictionary = "6x6_250"
[[board]]
type = "aprilgrid"
rows = 3
columns = 4
tag_mm = 25.0
spacing = 0.3
x_mm = 200.0
rpy_deg = [0.0, 30.0, 0.0]
"""
HOLDS = np.radians([10.0, 20.0, -15.0, 30.0, -50.0, 40.0])
"""Joint values of an arm at the first photograph."""


def make_stock(folder: Path, dataset: Path | None = None, finished: Path | None = None) -> Path:
    """Fill a new folder; data set and run are copied where there are some."""
    folder.mkdir(parents=True, exist_ok=True)
    data = folder / "data"
    photographed = data / "images", data / "cameras.txt"
    designs = data / "target.toml", data / "board.toml"
    if dataset and finished:
        own_copy(dataset, data)
        own_copy(finished, folder / "run")
    else:
        write_dataset(data, make_scene(SMALL), workers=1)
        run(*photographed, folder / "run", *designs, RunOptions(workers=1))
    detect_images(*photographed, folder / "detected", *designs, RunOptions(workers=1))
    _of_runs(folder)
    _cameras(folder)
    rng = np.random.default_rng(7)
    _robots(folder / "robot", rng)
    _held(folder)
    _handeye(folder / "handeye", rng)
    _tags(folder / "locate", rng)
    _register(folder / "register", rng)
    return folder


def table(path: Path, *parts: dict) -> None:
    """A CSV file of columns by their names."""
    columns = {name: np.asarray(column).tolist() for part in parts for name, column in part.items()}
    with open(path, "w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows([columns, *zip(*columns.values(), strict=True)])


def _joints(q: np.ndarray) -> dict[str, np.ndarray]:
    return {f"q{i}_deg": column for i, column in enumerate(np.degrees(q).T, 1)}


def _points(xyz: np.ndarray, prefix: str = "") -> dict[str, np.ndarray]:
    return {f"{prefix}{axis}_mm": column for axis, column in zip("xyz", xyz.T, strict=True)}


def _poses(poses) -> dict[str, tuple[str, ...]]:
    return dict(zip(POSE, zip(*map(pose_cells, poses), strict=True), strict=True))


def _of_runs(folder: Path) -> None:
    """Photographs to measure with their joint values, a folder of detections, a model as text."""
    (folder / "shots").mkdir()
    own_copy(folder / "data/images/12/IMG_1000.jpg", folder / "shots")
    (folder / "joints.csv").write_text("image,q1_deg,q2_deg\nIMG_1000.jpg,10.5,-3.25\n")
    truth = json.loads((folder / "data/truth.json").read_text())
    placed_faces = {key: truth[key] for key in ("unit", "reference_face", "target_from_face", "circles")}
    (folder / "faces.json").write_text(json.dumps({"format": "stcal faces 1"} | placed_faces, indent=1))
    export_model(folder / "run", folder / "model-txt", "colmap-txt")
    (folder / "no-colmap").write_text("no program\n")
    own, _ = make_pattern(sides_of((90.0, 80.0, 70.0))[:2], 9, 3.0, "dark", 1, "two plates")
    (folder / "own.toml").write_text(target_toml(own))


def _cameras(folder: Path) -> None:
    """The data set's camera in every form that is read."""
    given = read_camera(folder / "data/cameras.txt").calibrated(SMALL.width, SMALL.height)
    (fx, fy), (cx, cy) = given.focal.tolist(), given.centre.tolist()
    forms = folder / "cameras"
    forms.mkdir()
    storage = cv2.FileStorage(str(forms / "opencv.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", given.width)
    storage.write("image_height", given.height)
    storage.write("camera_matrix", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    storage.write("distortion_coefficients", given.distortion[None, :5].copy())
    storage.release()
    rng = np.random.default_rng(1)
    spread = rng.normal(size=(len(given.colmap_params()), 40)) * 1e-3
    save_camera(forms / "sigma.txt", replace(given, covariance=spread @ spread.T))
    names = {"ros": "ros.yaml", "opencv": "opencv.yaml", "colmap-bin": "cameras.bin", "kalibr": "camchain.yaml"}
    names |= {"mrcal": "camera.cameramodel", "metashape": "metashape.xml", "matlab": "matlab.mat"}
    for form, name in names.items():
        content = WRITERS[form](given, "cam0")
        (forms / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def _robots(folder: Path, rng: np.random.Generator) -> None:
    """Nominal and made arm, poses of the arm, sweeps, targets, positions before and after; an arm that bends, with and
    without a load, joint 2 coming from either side."""
    folder.mkdir()
    nominal = mh80()
    world_from_base, tool = Rigid.exp([0.1, -0.05, 2.1, 2500.0, -900.0, 400.0]), Rigid.exp([0, 0.1, 0, 220, 60, 150])
    arm = placed(made(nominal, rng), world_from_base, {"": tool})
    bent = elastic(arm, rng)
    for name, robot in (("robot", nominal), ("made", arm), ("elastic", bent)):
        (folder / f"{name}.toml").write_text(robot_toml(robot, []))
    q = joint_vectors(arm, 50, rng)
    seen = measured(arm, q, rng)
    table(folder / "poses.csv", _joints(q), _poses(map(Rigid, seen.rotations, seen.positions)))
    home, turns = np.resize([0.25, -0.25], 6), np.linspace(-1.0, 1.0, 12)
    sweeps = np.array([np.where(np.arange(6) == j, turn, home) for j in range(6) for turn in turns])
    places = (arm.world_from_base @ forward(arm, sweeps, "")).translation + rng.normal(0, 0.02, (len(sweeps), 3))
    table(folder / "sweeps.csv", _joints(sweeps), _points(places))
    table(folder / "targets.csv", _joints(q[:8]), _poses(forward(nominal, q[:8], "")))
    commanded, sigma = np.tile(rng.uniform(-500, 500, (12, 3)), (2, 1)), np.repeat([0.5, 0.05], 12)
    sets, off = np.repeat(["before", "after"], 12), rng.normal(0, 1, (24, 3)) * sigma[:, None]
    table(folder / "verify.csv", {"set": sets}, _points(commanded, "commanded_"), _points(commanded + off))
    mass, came = np.resize([0.0, 60.0], len(q)), np.resize([1.0, 1.0, -1.0], len(q))
    loaded = measured(bent, q, rng, conditions=Conditions(mass)).points()
    table(folder / "loaded.csv", _joints(q), _points(loaded), {"payload_kg": mass, "approach2": came})


def _held(folder: Path) -> None:
    """Joint values of an arm that holds the target as the data set's photographs show it."""
    groups = json.loads((folder / "data/truth.json").read_text())["groups"]
    images = {name: each for own in groups.values() for name, each in own["images"].items()}
    shown = [Rigid.from_matrix(np.array(each["camera_from_target"])) for each in images.values()]
    base_from_camera = forward(mh80(), HOLDS)[0] @ shown[0].inverse()
    found = inverse(mh80(), Poses.of(base_from_camera @ pose for pose in shown), np.tile(HOLDS, (len(shown), 1)))
    assert found.usable.all()
    table(folder / "held.csv", {"image": list(images)}, _joints(found.q))


def _handeye(folder: Path, rng: np.random.Generator) -> None:
    """Pairs of poses, and photographs of a chessboard with the robot's poses."""
    folder.mkdir()
    seen = looks(rng, 7, np.array([70.0, 50.0]), 0.6)
    photographs(folder, *chessboard_mm(6, 8, 20.0), seen, CHESSBOARD).poses.rename(folder / "robot.csv")
    poses_file(folder / "poses.csv", simulated(rng, 14, robot=(2e-4, 0.1), camera=(5e-4, 0.2)))
    (folder / "checker.yaml").write_text(KALIBR)
    (folder / "boards.toml").write_text(BOARDS)


def _tags(folder: Path, rng: np.random.Generator) -> None:
    """Exposures of a scene with what leads to the robot, and photographs of the target above a board."""
    (folder / "scenes" / "a").mkdir(parents=True)
    (folder / "images").mkdir()
    image = photo(tilted(30))
    cv2.imwrite(str(folder / "scenes/a/1.png"), image)
    cv2.imwrite(str(folder / "scenes/a/2.png"), cv2.convertScaleAbs(image, alpha=0.6))
    (folder / "layout.toml").write_text(layout_toml(LAYOUT), encoding="utf-8")
    save_camera(folder / "cameras.txt", Camera.of(CAMERA, "PINHOLE"))
    hand_eye = {"flange_from_camera": Rigid.exp([0, 0, 1, 0, 0, 50]).matrix().tolist()}
    hand_eye |= {"covariance": np.diag([1e-6] * 3 + [0.01] * 3).tolist()}
    (folder / "handeye.json").write_text(json.dumps(hand_eye))
    offset = {"obj_from_goal": Rigid.exp([0, 0, 0, 0, 0, -40]).matrix().tolist()}
    (folder / "offset.json").write_text(json.dumps(offset))
    table(folder / "robot.csv", {"scene": ["a"]}, _poses([Rigid.exp([1, 0, 0, 400, 0, 300])]))
    edge = 30 * PER_MM
    printed = np.vstack([sheet(), chessboard_mm(4, 9, 20.0, PER_MM)[0][edge:-edge, edge:-edge]])
    for k in range(3):
        turn = Rigid.exp([*rng.uniform(-0.4, 0.4, 2), 0, 0, 0, 0]).rotation @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
        middle = Rigid(turn, [0, 0, 620.0] - turn @ [0, 60, 0])
        cv2.imwrite(str(folder / "images" / f"{k}.png"), photo(middle, printed))
    (folder / "board.toml").write_text('type = "chessboard"\nrows = 4\ncolumns = 9\nsquare_mm = 20.0\n')
    tags = "".join(f'[[tag]]\ndictionary = "{dictionary}"\nid = {tag}\n' for dictionary, tag in LAYOUT.tags)
    (folder / "plan.toml").write_text('type = "tags"\norigin = 0\n' + tags)


def _register(folder: Path, rng: np.random.Generator) -> None:
    """Points in two frames; and those of an arm, with its joint values."""
    folder.mkdir()
    b_from_a = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])
    a = rng.uniform(-200, 200, (24, 3)) + np.array([800, 200, 700])
    b = b_from_a @ a + rng.normal(0, 0.1, a.shape)
    table(folder / "pairs.csv", _points(a, "a"), _points(b, "b"))
    nominal = mh80()
    arm = placed(made(nominal, rng), Rigid(), dict(nominal.tools))
    q = joint_vectors(arm, 40, rng)
    a, b = forward(nominal, q, "").translation, b_from_a @ forward(arm, q, "").translation
    table(folder / "arm.csv", _joints(q), _points(a, "a"), _points(b + rng.normal(0, 0.05, b.shape), "b"))
