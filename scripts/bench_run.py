#!/usr/bin/env python
"""Time the program on rendered photographs against merely decoding them.

All times are wall times on this machine, of commands as a user starts them, their processes included, or of a function
with its libraries loaded; the least of the rounds is told, as what else the machine did only adds. The files are read
once before, so that none waits for the disk. Ratios are to decoding the same photographs to grey by as many threads of
one process as there are cores.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from scripts.runner import DATA, options_of
from stcal.boards.board_file import board_toml, load_dots
from stcal.boards.target_file import load_target
from stcal.design import reference_board
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.read import read_camera
from stcal.io.images import decode, find_images
from stcal.parallel import run_parallel
from stcal.robot import IdentifyOptions, identify
from stcal.robot.kinematics.robot_model import Robot, Tree
from stcal.robot.simulated import joint_vectors, made, measured
from stcal.sfm import MeasureOptions, Tracker, measure, read_target
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.detect_files import detect_files
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.support.arms import LEFT, MARKERS, RIGHT, elastic, two_arms
from tests.support.image_poses import filmed

FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION  # as stcal.io.images.decode
RIGHT_PX = 3.0  # a board is right when every centre is this close to the image of a true dot
GROUPS = 4
STREAM = 40, 1728
"""Photographs for ``measure``, and their width, px: 2 megapixels."""
TARGET_SIGMA_MM = 0.002
"""Of the circles of the target that is followed, about that of a run."""
HEAD, ROWS = Rigid.exp([0.0, 0.4, 0.0, 0, 0, 400]), 1000
"""Of the tree of joints: where its head is, and the number of its measured rows."""


def decode_file(path: Path) -> None:
    """Decode and forget."""
    cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), FLAGS)


def decode_all(paths: list[Path]) -> None:
    """Decode by threads of this process, one per core and one in each decoder."""
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(decode_file, paths))
    cv2.setNumThreads(-1)


def opencv_board(path: Path, size: tuple[int, int], areas: tuple[float, float]) -> np.ndarray | None:
    """Decode and find the board with OpenCV and its own 17 thresholds: (n, 2) centres, or None."""
    p = cv2.SimpleBlobDetector_Params()
    p.filterByColor = p.filterByArea = p.filterByConvexity = p.filterByInertia = True
    p.filterByCircularity = False
    p.blobColor, (p.minArea, p.maxArea), p.minConvexity, p.minInertiaRatio = 255, areas, 0.9, 0.1
    p.minDistBetweenBlobs = float(np.sqrt(areas[0]) / 2)
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), FLAGS)
    detector = cv2.SimpleBlobDetector_create(p)
    found, centres = cv2.findCirclesGrid(image, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=detector)
    return centres.reshape(-1, 2) if found else None


def render(folder: Path, images: int, width: int, film: bool = False) -> None:
    """Render a data set; ``film``: a camera that moves by up to 7.5 mm and 0.75° between images."""
    scene = make_scene(SceneOptions(width=width, height=width * 2 // 3, images_per_group=images // GROUPS))
    print(f"rendering {images} images {width}×{width * 2 // 3} …", file=sys.stderr)
    write_dataset(folder, filmed(scene, "12", images) if film else scene)


def call(words: list) -> float:
    """Calls ``stcal-sfm``; returns the peak MiB of its largest process."""
    program = [sys.executable, "-P", "-c", "from stcal.cli.entry import main_sfm; main_sfm()"]
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen([*program, *map(str, words)], stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            log.seek(0)
            sys.exit(f"error: {words[0]} failed\n{log.read()}")
    return usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)


def run_words(data: Path, out: Path, images: Path | None = None) -> list:
    """The words of a run."""
    designs = ["--camera", data / "cameras.txt", "--target", data / "target.toml", "--board", data / "board.toml"]
    return ["run", "--no-strict", images or data / "images", *designs, "--out", out]


def run_again(data: Path, scratch: Path) -> Callable[[], float]:
    """Returns a run into the folder of an earlier one, after one more photograph."""
    shutil.copytree(data / "images", scratch / "growing")
    last = sorted((scratch / "growing").glob("*/*"))[-1]
    kept = last.rename(scratch / last.name)
    words = run_words(data, scratch / "grown", scratch / "growing")
    call(words)
    kept.rename(last)
    return lambda: call(words)


def true_dots(data: Path) -> dict[str, np.ndarray]:
    """True centres of the board's dots by the name of the image."""
    truth = json.loads((data / "truth.json").read_text(encoding="utf-8"))
    return {
        name: np.array([c["centre_px"] for label, c in image["circles"].items() if label.startswith("board:")])
        for group in truth["groups"].values()
        for name, image in group["images"].items()
    }


def boards(found: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> str:
    """How many boards were found, how many with every dot, and how many with no centre where no dot is."""
    off = [np.linalg.norm(xy[:, None] - true[name], axis=2).min(1).max() for name, xy in found.items()]
    complete = sum(len(xy) == len(true[name]) for name, xy in found.items())
    return f"{len(found):8} {complete:9} {sum(bool(value < RIGHT_PX) for value in off):6}"


def detected(data: Path, cache: Path) -> str:
    """Detects all images; returns the counts of boards."""
    files, _ = find_images(data / "images")
    designs = load_target(data / "target.toml"), load_dots(data / "board.toml")
    result = detect_files(files, read_camera(data / "cameras.txt"), *designs, EllipseOptions(), cache)
    found = {i.file.name: i.detection for i in result.images}
    dots = {name: d.centres.centre_px[d.board.rows] for name, d in found.items() if d.board is not None}
    return boards(dots, true_dots(data))


def detected_by_opencv(data: Path) -> str:
    """Finds all boards with OpenCV; returns the counts."""
    board, true = load_dots(data / "board.toml"), true_dots(data)
    # At 1 m ± 10 %, tilted by up to 70°, in images as wide as 22.3 mm behind 24 mm: half and twice that for safety.
    area = np.pi * (board.radius_mm * 24 / 22.3 * read_camera(data / "cameras.txt").width / 1000) ** 2
    size, areas = (board.columns, board.rows), (0.34 * area / 2, area * 2)
    found = dict(run_parallel(opencv_board, [(data / "images" / name, size, areas) for name in true]))
    return boards({name: found[i] for i, name in enumerate(true) if found[i] is not None}, true)


def measured_stream(data: Path, faces: Path) -> str:
    """Measures all photographs of a set on one core; returns the number of images."""
    design, board = load_target(data / "target.toml"), load_dots(data / "board.toml")
    circles, camera = read_target(faces, design), read_camera(data / "cameras.txt")
    result = measure(data / "images", camera, circles, design, board, MeasureOptions(workers=1))
    return f"{len(result.images)} images"


def tracked(film: Path) -> Callable[[], str]:
    """Returns a tracker's way through a sequence in memory, with the true target, as its calibration is
    another row."""
    images, width = STREAM
    scene = make_scene(SceneOptions(width=width, height=width * 2 // 3, images_per_group=images // GROUPS))
    labels, radius = tuple(scene.circles_target), scene.target.radius_of()
    xyz = np.array([scene.circles_target[label] for label in labels])
    known = np.eye(3 * len(labels)) * TARGET_SIGMA_MM**2
    circles = TargetCircles(labels, xyz, np.array([radius[label] for label in labels]), known, design=scene.target)
    pictures = [decode(path.read_bytes(), path.name) for path in sorted((film / "images").glob("*/*"))]

    def follow() -> str:
        tracker = Tracker(circles, read_camera(film / "cameras.txt"), scene.board)
        return f"{sum(tracker.locate(picture) is not None for picture in pictures)} images"

    return follow


def tree_identified() -> Callable[[], None]:
    """Returns the identification of an elastic tree of joints."""
    body, rng = two_arms(), np.random.default_rng(0)
    tree = Tree({2: (1, LEFT), 8: (1, RIGHT), 14: (1, HEAD)}, {"left": 7, "right": 13, "elbow": 4, "head": 17})
    rows, joints = (*body.rows, *body.rows[2:6]), (*body.joints, *body.joints[2:6])
    tools = dict(body.tools) | {"head": Rigid.exp([0.2, 0.1, 0, 30, 40, 60])}
    known = {"world_from_base": body.world_from_base, "tools": tools, "tree": tree}
    nominal = Robot("humanoid", body.convention, rows, joints, **known)
    true = elastic(made(nominal, rng), rng)
    targets = ((*MARKERS, "head") * ROWS)[:ROWS]
    data = replace(measured(true, joint_vectors(true, ROWS, rng), rng, targets=targets), rotations=None)
    return lambda: identify(nominal, data, IdentifyOptions(model="elastic", folds=6)) and None


def handeye_charuco(scratch: Path) -> None:
    """A measured hand-eye set, detection included."""
    sys.path.append(str(Path(__file__).parent / "studies"))
    import handeye_shared

    handeye_shared.charuco(DATA, scratch / "charuco", splits=handeye_shared.DEFAULT)


def rows(data: Path, stream: Path, film: Path, scratch: Path) -> Iterator[tuple[str, Callable]]:
    """What is timed: titles and functions, which may return a remark."""
    paths = sorted((data / "images").glob("*/*"))
    fine = replace(reference_board(), rows=100, columns=100, pitch_mm=4.0, radius_mm=1.2, corner=None)
    (scratch / "fine.toml").write_text(board_toml(replace(fine, corner_radius_mm=None)), encoding="utf-8")
    yield "decoding alone", lambda: decode_all(paths)
    yield "stcal-sfm run", lambda: call(run_words(data, scratch / "run"))
    yield "run again, a photograph more", run_again(data, scratch)
    yield "stcal detection", lambda: detected(data, scratch / "cache")
    yield "OpenCV, its own 17 thresholds", lambda: detected_by_opencv(data)
    yield "advise", lambda: call(["advise", scratch / "run"])
    plan = ["plan", "--board", scratch / "fine.toml"]
    yield "plan, board of 100 × 100 dots", lambda: f"{call(plan):.0f} MiB"
    yield "stcal-sfm --help", lambda: call(["--help"])
    call(run_words(stream, scratch / "stream"))
    yield "measure, 2 Mpx, one core", lambda: measured_stream(stream, scratch / "stream" / "faces.json")
    yield "Tracker.locate, one core", tracked(film)
    if (real := DATA / "real" / "multidic_chessboard").is_dir():
        words = ["calibrate-camera", real / "201", "--board", real / "board.toml", "--out", scratch / "camera.txt"]
        yield "calibrate-camera, 25 chessboards, 8 Mpx", lambda: call([*words, "--overwrite"])
    if (DATA / "charuco_handeye").is_dir():
        yield "handeye, ChArUco, 16 of 1.9 Mpx", lambda: handeye_charuco(scratch)
    yield f"identify, elastic tree of 18 joints, {ROWS} rows", tree_identified()


def large(images: int) -> str:
    """Time an image with labels known, over that of 40 images; and MiB, of ``scale_study.py``, in own processes."""
    found = []
    for count in (40, images):
        words = [sys.executable, Path(__file__).parent / "studies" / "scale_study.py", "--one", str(count), "sparse"]
        found.append(json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout))
    ratio = found[1]["ms_per_image"] / found[0]["ms_per_image"]
    memory = found[1]["memory_mib"]
    return f"{images} images, labels known: time an image {ratio:.2f} × that of 40, {memory:.0f} MiB"


def main() -> None:
    """Command line."""
    given = options_of(__doc__, images=40, width=5184, rounds=5, large=10_000)
    if given.images % GROUPS or given.images < 4 * GROUPS:
        sys.exit(f"error: --images {given.images}: a multiple of {GROUPS}, at least {4 * GROUPS}, needed")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a user's modules are compiled from the second start on
    seconds: dict[str, list[float]] = {}
    remarks: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as temporary:
        os.environ.setdefault("PYTHONPYCACHEPREFIX", str(Path(temporary) / "compiled"))
        data, stream, film = (Path(temporary) / name for name in ("photographs", "stream", "film"))
        render(data, given.images, given.width)
        render(stream, *STREAM)
        render(film, *STREAM, film=True)
        for _ in range(max(given.rounds, 1)):
            scratch = Path(tempfile.mkdtemp(dir=temporary))
            for title, function in rows(data, stream, film, scratch):
                start = time.perf_counter()
                remark = function()
                seconds.setdefault(title, []).append(time.perf_counter() - start)
                remarks[title] = remark if isinstance(remark, str) else ""
            shutil.rmtree(scratch)
        megabytes = sum(path.stat().st_size for path in (data / "images").glob("*/*")) / 1e6
        peak = call(run_words(data, Path(temporary) / "watched"))
    cores, decoding = os.cpu_count() or 1, min(seconds["decoding alone"])
    size = f"{given.width} × {given.width * 2 // 3} px, {megabytes:.0f} MB"
    print(f"{given.images} images of {size}, {cores} workers, {given.rounds} rounds")
    print(f"{'':44} {'seconds':>8} {'median':>7} {'ratio':>6}   boards found, complete, right")
    for title, times in seconds.items():
        remark = remarks[title]
        if remark.endswith("images"):
            remark = f"{int(remark.split()[0]) / min(times):8.1f} images a second"
        ratio = min(times) / decoding
        print(f"{title:44} {min(times):8.2f} {statistics.median(times):7.2f} {ratio:6.2f} {remark}".rstrip())
    cost = min(seconds["stcal detection"]) * cores / given.images
    a_day = f"{cost * 1e6 / 86400:.1f} cores, {megabytes / given.images * 1e6 / 86400:.0f} MB a second"
    print(f"detection: {cost:.2f} s of a core an image; a million such images a day: {a_day}")
    print(f"peak memory of the run: largest process {peak:.0f} MiB")
    if given.large:
        print(large(given.large))


if __name__ == "__main__":
    # Workers do not import the main module (stcal.parallel): they find these functions in an ordinary one.
    from bench_run import main as main_of_module

    main_of_module()
