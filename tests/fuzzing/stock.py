"""Valid inputs of every command, small, made once; a case copies of them what it spoils."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from stcal.boards.target_file import target_toml
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.read import WRITERS, read_camera, save_camera
from stcal.io.files import digest_of
from stcal.io.table import POSE, pose_cells
from stcal.locate.layout import layout_toml
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.robot_file import robot_toml
from stcal.robot.kinematics.robot_model import Conditions, Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.sfm.data.group_model import detections_csv
from stcal.sfm.interop.export_colmap import export_model
from stcal.sfm.make import make_pattern, sides_of
from stcal.sfm.pipeline import run
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.saved import load_run
from stcal.sfm.runs.transaction import MarkerFile
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.boards.drawn import chessboard_mm, photograph
from tests.handeye.photographed import looks, photographs
from tests.locate.drawn_target import CAMERA, LAYOUT, PER_MM, SHEET_MM, photo, sheet, tilted
from tests.shared import own_copy, write_rows
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
BOARD_AT_MM = (30, 230)  # of the board beside the tags, on the sheet


def make_stock(folder: Path, dataset: Path | None = None, finished: Path | None = None) -> Path:
    """Fill a new folder; data set and run are copied where there are some."""
    folder.mkdir(parents=True, exist_ok=True)
    if dataset:
        own_copy(dataset, folder / "data")
    else:
        write_dataset(folder / "data", make_scene(SMALL), workers=1)
    data = folder / "data"
    if finished:
        own_copy(finished, folder / "run")
    else:
        designs = [data / name for name in ("target.toml", "board.toml")]
        run(data / "images", data / "cameras.txt", folder / "run", *designs, RunOptions(workers=1))
    _of_runs(folder)
    _cameras(folder)
    rng = np.random.default_rng(7)
    _robots(folder / "robot", rng)
    _held(folder)
    _handeye(folder / "handeye", rng)
    write_tags(folder / "locate", rng)
    _register(folder / "register", rng)
    return folder


def _of_runs(folder: Path) -> None:
    """Photographs to measure with their joint values, a folder of detections, a model as text."""
    (folder / "shots").mkdir()
    own_copy(folder / "data/images/12/IMG_1000.jpg", folder / "shots")
    write_rows(folder / "joints.csv", ["image", "q1_deg", "q2_deg"], [["IMG_1000.jpg", 10.5, -3.25]])
    truth = json.loads((folder / "data/truth.json").read_text())
    placed_faces = {key: truth[key] for key in ("unit", "reference_face", "target_from_face", "circles")}
    (folder / "faces.json").write_text(json.dumps({"format": "stcal faces 1"} | placed_faces, indent=1))
    export_model(folder / "run", folder / "model-txt", "colmap-txt")
    (folder / "detected").mkdir()
    own_copy(folder / "run/.stcal/cache", folder / "detected/.stcal/cache")
    seen = [image for group in load_run(folder / "run").groups().values() for image in group]
    (folder / "detected/detections.csv").write_text(detections_csv(seen))
    marker = MarkerFile.of(folder / "data/images", None)
    sealed = marker.sealed({"detections.csv": digest_of(folder / "detected/detections.csv")})
    (folder / "detected/.stcal/run.json").write_text(json.dumps(sealed.content()))
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
    """Nominal and made arm, poses of the arm, sweeps, targets, positions before and after."""
    folder.mkdir()
    nominal = mh80()
    world_from_base, tool = Rigid.exp([0.1, -0.05, 2.1, 2500.0, -900.0, 400.0]), Rigid.exp([0, 0.1, 0, 220, 60, 150])
    arm = placed(made(nominal, rng), world_from_base, {"": tool})
    (folder / "robot.toml").write_text(robot_toml(nominal, []))
    (folder / "made.toml").write_text(robot_toml(arm, []))
    joints = [f"q{i}_deg" for i in range(1, 7)]
    q = joint_vectors(arm, 50, rng)
    seen = measured(arm, q, rng)
    poses = [pose_cells(Rigid(r, t)) for r, t in zip(seen.rotations, seen.positions, strict=True)]
    write_rows(folder / "poses.csv", [*joints, *POSE], [[*d, *p] for d, p in zip(np.degrees(q), poses, strict=True)])
    home = np.array([0.25, -0.25, 0.25, -0.25, 0.25, -0.25])
    turns = np.linspace(-1.0, 1.0, 12)
    sweeps = np.array([np.where(np.arange(6) == j, turn, home) for j in range(6) for turn in turns])
    places = (arm.world_from_base @ forward(arm, sweeps, "")).translation + rng.normal(0, 0.02, (len(sweeps), 3))
    write_rows(folder / "sweeps.csv", [*joints, *POSE[:3]], np.column_stack([np.degrees(sweeps), places]).tolist())
    wanted = forward(nominal, q[:8], "")
    rows = [[*d, *pose_cells(p)] for d, p in zip(np.degrees(q), wanted, strict=False)]
    write_rows(folder / "targets.csv", [*joints, *POSE], rows)
    commanded, sizes = rng.uniform(-500, 500, (12, 3)), {"before": 0.5, "after": 0.05}.items()
    rows = [[name, *c, *(c + rng.normal(0, size, 3))] for name, size in sizes for c in commanded]
    write_rows(folder / "verify.csv", ["set", *(f"commanded_{c}" for c in POSE[:3]), *POSE[:3]], rows)
    _loaded(folder, arm, q)


def _loaded(folder: Path, arm: Robot, q: np.ndarray) -> None:
    """The arm with elastic links, and positions of it with and without a load, joint 2 coming from either side."""
    rng = np.random.default_rng(3)
    bent, mass, came = elastic(arm, rng), np.resize([0.0, 60.0], len(q)), np.resize([1.0, 1.0, -1.0], len(q))
    (folder / "elastic.toml").write_text(robot_toml(bent, []))
    seen = measured(bent, q, rng, conditions=Conditions(mass))
    names = [*(f"q{i}_deg" for i in range(1, 7)), *POSE[:3], "payload_kg", "approach2"]
    write_rows(folder / "loaded.csv", names, np.column_stack([np.degrees(q), seen.points(), mass, came]).tolist())


def _held(folder: Path) -> None:
    """Joint values of an arm that holds the target as the data set's photographs show it."""
    groups = json.loads((folder / "data/truth.json").read_text())["groups"]
    images = {name: each for own in groups.values() for name, each in own["images"].items()}
    shown = [(name, Rigid.from_matrix(np.array(each["camera_from_target"]))) for name, each in images.items()]
    base_from_camera = forward(mh80(), HOLDS)[0] @ shown[0][1].inverse()
    poses = Poses.of(base_from_camera @ pose for _, pose in shown)
    found = inverse(mh80(), poses, np.tile(HOLDS, (len(poses), 1)))
    assert found.usable.all()
    rows = [[name, *q] for (name, _), q in zip(shown, np.degrees(found.q).tolist(), strict=True)]
    write_rows(folder / "held.csv", ["image", *(f"q{i}_deg" for i in range(1, 7))], rows)


def _handeye(folder: Path, rng: np.random.Generator) -> None:
    """Pairs of poses, and photographs of a chessboard with the robot's poses."""
    folder.mkdir()
    pairs = simulated(rng, 14, robot=(2e-4, 0.1), camera=(5e-4, 0.2)).pairs
    header = [f"{name}_{column}" for name in ("base_from_flange", "camera_from_board") for column in POSE]
    both = zip(pairs.base_from_flange, pairs.camera_from_board, strict=True)
    write_rows(folder / "poses.csv", header, [[*pose_cells(a), *pose_cells(b)] for a, b in both])
    inner = folder / "drawn"
    inner.mkdir()
    found = photographs(inner, *chessboard_mm(6, 8, 20.0), looks(rng, 7, np.array([70.0, 50.0]), 0.6), CHESSBOARD)
    for path, name in ((found.poses, "robot.csv"), (found.camera, "cameras.txt"), (found.board, "board.toml")):
        path.rename(folder / name)
    found.images.rename(folder / "images")
    inner.rmdir()
    (folder / "checker.yaml").write_text(KALIBR)
    (folder / "boards.toml").write_text(BOARDS)


def write_tags(folder: Path, rng: np.random.Generator, printed: np.ndarray | None = None, count: int = 3) -> None:
    """Exposures of a scene with what leads to the robot, and photographs of the target above a chessboard; or of
    another sheet of 220 × 320 mm."""
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
    write_rows(folder / "robot.csv", ["scene", *POSE], [["a", *pose_cells(Rigid.exp([1, 0, 0, 400, 0, 300]))]])
    printed = _sheet_with_board() if printed is None else printed
    matrix = np.array([[1300.0, 0, 599.5], [0, 1300.0, 449.5], [0, 0, 1]])
    for k in range(count):
        tilt = Rigid.exp([*rng.uniform(-0.4, 0.4, 2), 0, 0, 0, 0]).rotation
        turn = tilt @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        shift = np.array([0, 0, 620.0]) - turn @ np.array([SHEET_MM[0] / 2, 160.0, 0])
        view = photograph(printed, PER_MM, matrix @ np.column_stack([turn[:, :2], shift]), (1200, 900))
        cv2.imwrite(str(folder / "images" / f"{k}.png"), view)
    (folder / "board.toml").write_text('type = "chessboard"\nrows = 4\ncolumns = 9\nsquare_mm = 20.0\n')
    tags = "".join(f'[[tag]]\ndictionary = "{dictionary}"\nid = {tag}\n' for dictionary, tag in LAYOUT.tags)
    (folder / "plan.toml").write_text('type = "tags"\norigin = 0\n' + tags)


def _sheet_with_board() -> np.ndarray:
    printed = np.full((320 * PER_MM, int(SHEET_MM[0]) * PER_MM), 255, np.uint8)
    printed[: sheet().shape[0]] = sheet()
    side, (x, y) = 20 * PER_MM, np.array(BOARD_AT_MM) * PER_MM
    squares = np.kron(np.indices((5, 10)).sum(0) % 2 * 255, np.ones((side, side)))
    printed[y - side : y + 4 * side, x - side : x + 9 * side] = squares
    return printed


def _register(folder: Path, rng: np.random.Generator) -> None:
    """Points in two frames; and those of an arm, with its joint values."""
    folder.mkdir()
    names = [f"{frame}{axis}_mm" for frame in "ab" for axis in "xyz"]
    b_from_a = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])
    a = rng.uniform(-200, 200, (24, 3)) + np.array([800, 200, 700])
    write_rows(folder / "pairs.csv", names, np.hstack([a, b_from_a @ a + rng.normal(0, 0.1, a.shape)]).tolist())
    nominal = mh80()
    arm = placed(made(nominal, rng), Rigid(), dict(nominal.tools))
    q = joint_vectors(arm, 40, rng)
    a, b = forward(nominal, q, "").translation, b_from_a @ forward(arm, q, "").translation
    head = [*(f"q{i}_deg" for i in range(1, 7)), *names]
    write_rows(folder / "arm.csv", head, np.hstack([np.degrees(q), a, b + rng.normal(0, 0.05, b.shape)]).tolist())
