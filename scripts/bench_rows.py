"""Rows of ``bench_run.py`` beside a run: advice, boards, hand-eye and a robot."""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.model import write_cameras_txt
from stcal.io.table import POSE, pose_cells

GROUPS = 4
ADVISED = 2000
"""Images of the larger set for ``advise``."""
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
REAL_BOARDS = {
    "calibrate-camera, 25 chessboards, 8 Mpx": ("multidic_chessboard", "201"),
    "calibrate-camera, 22 ChArUco, 1.3 Mpx": ("pycamset_charuco", "1"),
    "calibrate-camera, 6 dot plates": ("boofcv_circle_regular", "."),
}
"""Sets of real photographs of boards in ``shared/data/real``; a set that is not there is left out."""
EXCHANGED = "calibrate-camera, 10 small boards, rows and columns exchanged"
HANDEYE = "handeye, 19 chessboards of 1.3 Mpx, drawn"
CHESSBOARD = 8, 11, 20.0
"""Rows and columns of squares, and their side, mm."""
CAMERA = Camera(1280, 1024, [1500.0, 1500.0], [644.0, 507.0], np.zeros(8))
VIEWS, TILT, ROLL = 19, 0.45, 0.6
HEAD, ROWS = Rigid.exp([0.0, 0.4, 0.0, 0, 0, 400]), 1000
TREE = "identify --model elastic, tree of 18 joints, 1000 rows, 6 folds"


def timed_advice() -> float:
    """Seconds of ``advise`` over many images, by its function: labels simulated, the geometry that of a run."""
    from stcal.geometry.rigid import Rigid
    from stcal.sfm.adjust.chain import CalibratedTarget
    from stcal.sfm.adjust.joint import covariance_of
    from stcal.sfm.planning.advise import Known, advise
    from stcal.sfm.planning.forecast import CentreNoise, Setup, observe, true_models
    from stcal.sfm.planning.views import known_scene
    from stcal.synthetic.scene import SceneOptions, make_scene

    scene = make_scene(SceneOptions(images_per_group=ADVISED // GROUPS))
    noise, radius = CentreNoise.expected(), scene.target.radius_of() | scene.board.radius_of()
    models = true_models(scene, observe(scene, 0.0, np.random.default_rng(0)))
    models = [noise.applied(model, scene.camera, radius) for model in models]
    poses, groups = dict(scene.target_from_face), dict.fromkeys(scene.groups, Rigid())
    start = CalibratedTarget(scene.reference_face, poses, scene.circles_target, groups)
    setup = Setup(scene.target, scene.board, scene.camera, start, "plane", 0.02, None, 0.0)
    joint = covariance_of(models, setup.board, setup.camera, setup.flatness_mm)
    known = Known(tuple(models), joint, setup, noise, known_scene(models, joint, setup, "OPENCV"))
    begin = time.perf_counter()
    advise(known)
    return time.perf_counter() - begin


def timed_boards(stream: Path, scratch: Path, log: Path, timed_program: Callable) -> dict[str, dict]:
    """Seconds of ``calibrate-camera`` on each set."""
    places = {"calibrate-camera, 40 dot boards, 2 Mpx": (stream / "images", stream / "board.toml")}
    places |= {
        title: (SHARED / "real" / name / folder, SHARED / "real" / name / "board.toml")
        for title, (name, folder) in REAL_BOARDS.items()
    }
    rows = {}
    for title, (images, board) in places.items():
        if images.is_dir():
            words = ["calibrate-camera", images, "--board", board, "--out", scratch / "camera.txt", "--overwrite"]
            rows[title] = {"seconds": timed_program(words, log)[0]}
    folder = photographed_chessboards(scratch / "small", 10, 0.25)
    turned = (folder / "board.toml").read_text().replace("rows = 7\ncolumns = 10", "rows = 10\ncolumns = 7")
    (folder / "board.toml").write_text(turned)
    words = ["calibrate-camera", folder / "images", "--board", folder / "board.toml", "--out", scratch / "camera.txt"]
    rows[EXCHANGED] = {"seconds": timed_program([*words, "--overwrite"], log)[0]}
    return rows


def timed_handeye(scratch: Path) -> dict[str, dict]:
    """Seconds of ``handeye`` by its function, detection included, on real sets and on drawn chessboards."""
    sys.path.append(str(Path(__file__).parent / "studies"))
    import handeye_shared

    from stcal.handeye import HandEyeOptions
    from stcal.workflows.handeye_inputs import read_handeye
    from stcal.workflows.handeye_run import calibrate_handeye

    rows = {}
    folder = photographed_chessboards(scratch / "chessboards", VIEWS, 1.0)
    files = (folder / name for name in ("images", "poses.csv", "cameras.txt", "board.toml"))
    start = time.perf_counter()
    given = read_handeye(*files)
    calibrate_handeye(given, options=HandEyeOptions(intrinsics=given.prior))
    rows[HANDEYE] = {"seconds": time.perf_counter() - start}
    for title, name in (("ChArUco, 16 of 1.9 Mpx", "charuco"), ("dot boards, 15 of 0.3 Mpx", "dots")):
        if (SHARED / f"{name.replace('dots', 'dotgrid')}_handeye").is_dir():
            start = time.perf_counter()
            getattr(handeye_shared, name)(SHARED, scratch / name, splits=handeye_shared.DEFAULT)
            rows[f"handeye, {title}"] = {"seconds": time.perf_counter() - start}
    return rows


def photographed_chessboards(folder: Path, count: int, size: float) -> Path:
    """Draws photographs of a chessboard by a camera on a robot, ``size`` times as wide as :data:`CAMERA`'s, with the
    files that ``stcal handeye`` takes; returns the folder."""
    from tests.boards.drawn import chessboard_mm, photograph
    from tests.support.handeye import BASE_FROM_BOARD, FLANGE_FROM_CAMERA

    rng, (rows, columns, square_mm) = np.random.default_rng(0), CHESSBOARD
    sheet, first_mm = chessboard_mm(rows - 1, columns - 1, square_mm)
    half = 0.5 * (size - 1)  # the middle of a pixel has whole coordinates
    width, height = round(CAMERA.width * size), round(CAMERA.height * size)
    camera = Camera(width, height, CAMERA.focal * size, CAMERA.centre * size + half, np.zeros(8))
    tilt, turn = rng.uniform(-TILT, TILT, (count, 2)), rng.uniform(-ROLL, ROLL, count)
    rotation = Rotation.from_rotvec(np.pad(tilt, ((0, 0), (0, 1)))) * Rotation.from_rotvec(np.outer(turn, [0, 0, 1]))
    middle = np.array([columns - 2, rows - 2, 0]) * square_mm / 2
    at = rng.uniform(-1, 1, (count, 3)) * [40, 30, 50] + [0, 0, 480]
    seen = Poses(rotation.as_matrix(), at - rotation.apply(middle))
    (folder / "images").mkdir(parents=True)
    base_from_flange = BASE_FROM_BOARD @ seen.inverse() @ FLANGE_FROM_CAMERA.inverse()
    lines = [",".join(["image", *(f"base_from_flange_{column}" for column in POSE)])]
    intrinsic = np.array([[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]])
    from_sheet = np.array([[1, 0, -first_mm], [0, 1, -first_mm], [0, 0, 1]])
    for i, (pose, flange) in enumerate(zip(seen, base_from_flange, strict=True)):
        image = intrinsic @ np.column_stack([pose.rotation[:, :2], pose.translation]) @ from_sheet
        picture = photograph(sheet, 4, image / image[2, 2], (camera.width, camera.height))
        cv2.imwrite(str(folder / "images" / f"{i:02}.png"), picture)
        lines.append(",".join([f"{i:02}.png", *pose_cells(flange)]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    write_cameras_txt(folder / "cameras.txt", Camera.of(camera, "PINHOLE"))
    board = f'type = "chessboard"\nrows = {rows - 1}\ncolumns = {columns - 1}\nsquare_mm = {square_mm}\n'
    (folder / "board.toml").write_text(board)
    return folder


def timed_tree() -> float:
    """Seconds of the identification of an elastic tree of joints, its files read."""
    from stcal.robot import IdentifyOptions, identify
    from stcal.robot.kinematics.model import Robot, Tree
    from stcal.robot.simulated import joint_vectors, made, measured
    from tests.support.arms import LEFT, MARKERS, RIGHT, elastic, two_arms

    body, rng = two_arms(), np.random.default_rng(0)
    tree = Tree({2: (1, LEFT), 8: (1, RIGHT), 14: (1, HEAD)}, {"left": 7, "right": 13, "elbow": 4, "head": 17})
    rows, joints = (*body.rows, *body.rows[2:6]), (*body.joints, *body.joints[2:6])
    tools = dict(body.tools) | {"head": Rigid.exp([0.2, 0.1, 0, 30, 40, 60])}
    nominal = Robot(
        "humanoid", body.convention, rows, joints, world_from_base=body.world_from_base, tools=tools, tree=tree
    )
    true = elastic(made(nominal, rng), rng)
    targets = ((*MARKERS, "head") * ROWS)[:ROWS]
    data = replace(measured(true, joint_vectors(true, ROWS, rng), rng, targets=targets), rotations=None)
    start = time.perf_counter()
    identify(nominal, data, IdentifyOptions(model="elastic", folds=6))
    return time.perf_counter() - start
