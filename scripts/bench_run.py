#!/usr/bin/env python
"""Time the program on rendered photographs against merely decoding them.

All times are wall times on this machine, of the program as a user starts it, its processes included; the files are read
once before, so that none waits for the disk. Ratios are to decoding the same photographs to grey by as many threads of
one process as there are cores. ``measure`` is told in images a second and core, ``--help`` and what needs no photograph
in seconds. The joint adjustment alone is that of the run's own models, in one process.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from bench_rows import ADVISED, GROUPS, TREE, timed_advice, timed_boards, timed_handeye, timed_tree

from scripts.runner import options_of
from stcal.design import reference_board
from stcal.io.cameras.read import read_camera
from stcal.io.design import board_toml, load_board, load_target
from stcal.parallel import run_parallel

FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION  # as stcal.io.images.decode
RIGHT_PX = 3.0  # a board is right when every centre is this close to the image of a true dot
BY_HAND = "OpenCV, 1 threshold, set by hand"
THRESHOLDS = {
    "OpenCV, its own 17 thresholds": (50, 220, 10, 2),
    "OpenCV, 3 thresholds": (60, 180, 40, 2),
    BY_HAND: (100, 101, 10, 1),
}
"""minThreshold, maxThreshold, thresholdStep, minRepeatability. The last one is the least with which it can work."""


STREAM = 40, 1728
"""Photographs for ``measure``, and their width, px: 2 megapixels."""
MEMORY_EVERY_S = 0.05
TARGET_SIGMA_MM = 0.002
"""Of the circles of the target that is followed, about that of a run."""


def decode_file(path: Path) -> None:
    """Decode and forget."""
    cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), FLAGS)


def timed_decoding(paths: list[Path]) -> float:
    """Seconds to decode by threads of this process, one per core and one in each decoder."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    start = time.perf_counter()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(decode_file, paths))
    seconds = time.perf_counter() - start
    cv2.setNumThreads(threads)
    return seconds


def opencv_board(path: Path, size: tuple[int, int], areas: tuple[float, float], thresholds) -> np.ndarray | None:
    """Decode and find the board with OpenCV: (n, 2) centres, or None."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), FLAGS)
    p = cv2.SimpleBlobDetector_Params()
    p.minThreshold, p.maxThreshold, p.thresholdStep, p.minRepeatability = thresholds
    p.filterByColor = p.filterByArea = p.filterByConvexity = p.filterByInertia = True
    p.filterByCircularity = False
    p.blobColor, (p.minArea, p.maxArea), p.minConvexity, p.minInertiaRatio = 255, areas, 0.9, 0.1
    p.minDistBetweenBlobs = float(np.sqrt(areas[0]) / 2)
    detector = cv2.SimpleBlobDetector_create(p)
    found, centres = cv2.findCirclesGrid(image, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=detector)
    return centres.reshape(-1, 2) if found else None


def render(folder: Path, images: int, width: int) -> None:
    """Render the data set unless it is there."""
    from stcal.synthetic.dataset import write_dataset
    from stcal.synthetic.scene import SceneOptions, make_scene

    if not (folder / "truth.json").exists():
        print(f"rendering {images} images {width}×{width * 2 // 3} …", file=sys.stderr)
        options = SceneOptions(width=width, height=width * 2 // 3, images_per_group=images // GROUPS)
        write_dataset(folder, make_scene(options))
    held = len(list((folder / "images").glob("*/*"))), read_camera(folder / "cameras.txt").width
    if held != (images, width):
        sys.exit("error: {} holds {} images {} px wide; give another folder".format(folder, *held))


def filmed_scene():
    """A camera that moves on by up to 7.5 mm and 0.75° from image to image."""
    from stcal.synthetic.scene import SceneOptions, make_scene
    from tests.support.film import filmed

    images, width = STREAM
    options = SceneOptions(width=width, height=width * 2 // 3, images_per_group=images // GROUPS)
    return filmed(make_scene(options), "12", images)


def render_film(folder: Path) -> None:
    """Render the sequence unless it is there."""
    from stcal.synthetic.dataset import write_dataset

    if not (folder / "truth.json").exists():
        write_dataset(folder, filmed_scene())


def timed(function, jobs: list[tuple]) -> tuple[float, list]:
    """Seconds, and the results in the jobs' order."""
    start = time.perf_counter()
    results = dict(run_parallel(function, jobs))
    return time.perf_counter() - start, [results[i] for i in range(len(jobs))]


def timed_program(words: list, log: Path, entry: str = "main_sfm", watched: bool = False) -> tuple[float, float, float]:
    """Seconds of one call; peak MiB of its largest process, and, ``watched``, of all together (0 without /proc), which
    takes a part of the time."""
    program = [sys.executable, "-P", "-c", f"from stcal.cli.entry import {entry}; {entry}()"]
    start = time.perf_counter()
    with log.open("w") as stream:
        run = subprocess.Popen([*program, *map(str, words)], stdout=stream, stderr=stream)
        together, done, looked = 0, 0, start
        while not done:
            time.sleep(0.005)
            if watched and time.perf_counter() - looked > MEMORY_EVERY_S:
                looked = time.perf_counter()
                together = max(together, proportional(run.pid))
            done, status, usage = os.wait4(run.pid, os.WNOHANG)
    seconds = time.perf_counter() - start
    run.returncode = os.waitstatus_to_exitcode(status)
    if run.returncode:
        sys.exit(f"error: {words[0]} failed\n{log.read_text()}")
    largest = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return seconds, largest / 2**20, together / 2**20


def files_of(data: Path) -> list:
    """Options that name a data set's camera and designs."""
    return ["--camera", data / "cameras.txt", "--target", data / "target.toml", "--board", data / "board.toml"]


def timed_second_run(data: Path, scratch: Path, log: Path) -> float:
    """Seconds of a run into the folder of an earlier one, after one more photograph."""
    shutil.copytree(data / "images", scratch / "growing")
    last = sorted((scratch / "growing").glob("*/*"))[-1]
    kept = last.rename(scratch / last.name)
    words = ["run", "--no-strict", scratch / "growing", *files_of(data), "--out", scratch / "grown"]
    timed_program(words, log)
    kept.rename(last)
    seconds = timed_program(words, log)[0]
    shutil.rmtree(scratch / "growing")
    return seconds


def timed_stream(data: Path, out: Path, workers: int) -> float:
    """Seconds of ``measure`` over all photographs, by its function, the libraries loaded."""
    from stcal.sfm import MeasureOptions, read_target
    from stcal.sfm import measure as measure_images

    design, board = load_target(data / "target.toml"), load_board(data / "board.toml")
    circles, camera = read_target(out / "faces.json", design), read_camera(data / "cameras.txt")
    start = time.perf_counter()
    result = measure_images(data / "images", camera, circles, design, board, MeasureOptions(workers=workers))
    seconds = time.perf_counter() - start
    if len(result.images) != STREAM[0]:
        sys.exit(f"error: {len(result.images)} of {STREAM[0]} images measured")
    return seconds


def timed_following(film: Path, scene) -> tuple[float, float]:
    """Seconds of a sequence in one process: ``measure --sequence``, and a tracker on arrays in memory. The target is
    that of the truth, as the calibration of it is another row."""
    from stcal.io.images import decode
    from stcal.sfm import MeasureOptions, Tracker
    from stcal.sfm import measure as measure_images
    from stcal.sfm.measurement.known_target import TargetCircles

    labels, radius = tuple(scene.circles_target), scene.target.radius_of()
    xyz = np.array([scene.circles_target[label] for label in labels])
    known = np.eye(3 * len(labels)) * TARGET_SIGMA_MM**2
    circles = TargetCircles(labels, xyz, np.array([radius[label] for label in labels]), known, design=scene.target)
    camera = read_camera(film / "cameras.txt")
    options = MeasureOptions(sequence=True, workers=1)
    start = time.perf_counter()
    result = measure_images(film / "images", camera, circles, scene.target, scene.board, options)
    seconds = time.perf_counter() - start
    if len(result.images) != STREAM[0] or result.searched != 1:
        sys.exit(f"error: {len(result.images)} of {STREAM[0]} images measured, {result.searched} searched as a whole")
    images = [decode(path.read_bytes(), path.name) for path in sorted((film / "images").glob("*/*"))]
    tracker = Tracker(circles, camera, scene.board)
    start = time.perf_counter()
    for image in images:
        tracker.locate(image)
    return seconds, time.perf_counter() - start


def proportional(pid: int) -> int:
    """Bytes of a process and all that it started, as far as /proc tells; of a page that several share, each has a part
    (``Pss``)."""
    try:
        rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
        own = int(rollup.partition("\nPss:")[2].split()[0]) * 1024
        children = " ".join(each.read_text() for each in Path(f"/proc/{pid}/task").glob("*/children")).split()
    except (OSError, IndexError):
        return 0  # no /proc, or ended meanwhile
    return own + sum(proportional(int(child)) for child in children)


def timed_detection(data: Path, cache: Path):
    """Seconds of detection alone, and the centres of the board's dots by image."""
    from stcal.io.images import find_images
    from stcal.sfm.detect.circles.candidates import EllipseOptions
    from stcal.sfm.detect.files import detect_files

    designs = load_target(data / "target.toml"), load_board(data / "board.toml")
    camera, (files, _) = read_camera(data / "cameras.txt"), find_images(data / "images")
    start = time.perf_counter()
    result = detect_files(files, camera, *designs, EllipseOptions(), cache)
    seconds = time.perf_counter() - start
    found = {i.file.name: i.detection for i in result.images}
    return seconds, {name: d.centres.centre_px[d.board.rows] for name, d in found.items() if d.board is not None}


def timed_calibration(out: Path) -> float:
    """Seconds from the models of a finished run's groups to the calibrated target, options as in the run."""
    from stcal.io.cameras.model import camera_prior
    from stcal.sfm.adjust.calibration import calibrate
    from stcal.sfm.mapping.database import image_ids
    from stcal.sfm.mapping.models import read_model
    from stcal.sfm.runs.saved import load_run

    run = load_run(out)
    ids, px = image_ids(run.observations), run.corrected_px
    models = [
        m for g in run.groups() for m in read_model(out / "colmap" / "models" / g, run.observations, ids, px).groups
    ]
    prior = camera_prior(run.camera)
    start = time.perf_counter()
    calibrate(models, run.camera, run.target_design, run.board_design, run.options.adjustment(run.target_design), prior)
    return time.perf_counter() - start


def timed_large(images: int) -> tuple[float, float]:
    """Time an image with labels known, over that of 40 images; and MiB, of ``scale_study.py``, in processes of its
    own."""
    found = []
    for count in (40, images):
        words = [sys.executable, Path(__file__).parent / "studies" / "scale_study.py", "--one", str(count), "sparse"]
        run = subprocess.run(words, capture_output=True, text=True, check=True)
        found.append(json.loads(run.stdout))
    return found[1]["ms_per_image"] / found[0]["ms_per_image"], found[1]["memory_mib"]


def boards(found: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> dict[str, int]:
    """How many boards were found, how many with every dot, and how many with no centre where no dot is."""
    off = [np.linalg.norm(xy[:, None] - true[name], axis=2).min(1).max() for name, xy in found.items()]
    complete = sum(len(xy) == len(true[name]) for name, xy in found.items())
    return {"found": len(found), "complete": complete, "right": sum(bool(value < RIGHT_PX) for value in off)}


def measure(data: Path, stream: Path, film: Path, scratch: Path) -> dict:
    """All measurements, once."""
    scratch.mkdir()
    log = scratch / "run.log"
    truth = json.loads((data / "truth.json").read_text(encoding="utf-8"))
    true = {
        name: np.array([c["centre_px"] for label, c in image["circles"].items() if label.startswith("board:")])
        for group in truth["groups"].values()
        for name, image in group["images"].items()
    }
    paths = [data / "images" / name for name in true]
    camera, board = read_camera(data / "cameras.txt"), load_board(data / "board.toml")
    megabytes = sum(len(path.read_bytes()) for path in paths) / 1e6
    rows = {"decoding alone": {"seconds": timed_decoding(paths)}}
    words = ["run", "--no-strict", data / "images", *files_of(data), "--out", scratch / "run"]
    rows["stcal-sfm run"] = {"seconds": timed_program(words, log)[0]}
    rows["run again, a photograph more"] = {"seconds": timed_second_run(data, scratch, log)}
    seconds, found = timed_detection(data, scratch / "cache")
    rows["stcal detection"] = {"seconds": seconds} | boards(found, true)
    rows["joint adjustment alone"] = {"seconds": timed_calibration(scratch / "run")}
    # At 1 m ± 10 %, tilted by up to 70°, in images as wide as 22.3 mm behind 24 mm: half and twice that for safety.
    area = np.pi * (board.radius_mm * 24 / 22.3 * camera.width / 1000) ** 2
    for title, thresholds in THRESHOLDS.items():
        jobs = [(path, (board.columns, board.rows), (0.34 * area / 2, area * 2), thresholds) for path in paths]
        seconds, grids = timed(opencv_board, jobs)
        found = {name: xy for name, xy in zip(true, grids, strict=True) if xy is not None}
        rows[title] = {"seconds": seconds} | boards(found, true)
    rows[f"advise, {ADVISED} images, its function"] = {"seconds": timed_advice()}
    rows["advise"] = {"seconds": timed_program(["advise", scratch / "run"], log)[0]}
    fine = replace(reference_board(), rows=100, columns=100, pitch_mm=4.0, radius_mm=1.2, corner=None)
    (scratch / "fine.toml").write_text(board_toml(replace(fine, corner_radius_mm=None)), encoding="utf-8")
    seconds, memory, _ = timed_program(["plan", "--board", scratch / "fine.toml"], log)
    rows["plan, board of 100 × 100 dots"] = {"seconds": seconds, "mib": memory}
    rows["stcal-sfm --help"] = {"seconds": timed_program(["--help"], log)[0]}
    rows["stcal --version"] = {"seconds": timed_program(["--version"], log, "main")[0]}
    timed_program(["run", "--no-strict", stream / "images", *files_of(stream), "--out", scratch / "stream"], log)
    rows["measure, 2 Mpx, one core"] = {"seconds": timed_stream(stream, scratch / "stream", 1), "images": STREAM[0]}
    following = timed_following(film, filmed_scene())
    for title, seconds in zip(("measure --sequence, one core", "Tracker.locate, one core"), following, strict=True):
        rows[title] = {"seconds": seconds, "images": STREAM[0]}
    rows |= timed_boards(stream, scratch, log, timed_program)
    rows |= timed_handeye(scratch)
    rows[TREE] = {"seconds": timed_tree()}
    shutil.rmtree(scratch)
    about = {"images": len(paths), "size_px": [camera.width, camera.height], "megabytes": megabytes}
    about["workers"] = os.cpu_count()
    return about | {"rows": rows}


STAGES = {
    "detect": "detection",
    "map": "labels, mapping of the groups (overlays beside it)",
    "faces": "joint adjustment and faces",
    "overlays": "rest of the overlays",
    "check": "checks",
    "report": "results, figures, report",
}
"""By the name of a run's stage: what it does until it says that it is done."""


def run_profile(data: Path, out: Path) -> dict[str, float]:
    """Seconds of each stage of a run in this process, its libraries loaded."""
    from stcal.parallel import load_ahead
    from stcal.sfm import run

    ends = {}
    load_ahead()
    start = time.perf_counter()
    files = [data / name for name in ("images", "cameras.txt")], [data / name for name in ("target.toml", "board.toml")]
    run(*files[0], out, *files[1], progress=lambda stage, *_: ends.update({stage: time.perf_counter() - start}))
    begins = [0.0, *ends.values()]
    return {STAGES[stage]: end - begin for (stage, end), begin in zip(ends.items(), begins, strict=False)}


def detection_profile(paths: list[Path], data: Path) -> dict[str, float]:
    """Milliseconds an image of detection's parts, one process alone."""
    from stcal.io.images import decode
    from stcal.parallel import one_thread
    from stcal.sfm.detect import files, image
    from stcal.sfm.detect.circles.candidates import EllipseOptions

    target, board = load_target(data / "target.toml"), load_board(data / "board.toml")
    camera = read_camera(data / "cameras.txt")
    camera = camera.sized(camera.width, camera.height)
    found: dict[str, float] = {}

    def told(what: str, function):
        def call(*arguments, **named):
            start = time.perf_counter()
            result = function(*arguments, **named)
            found[what] = found.get(what, 0.0) + 1e3 * (time.perf_counter() - start) / len(paths)
            return result

        return call

    def packed(seen, picture) -> bytes:
        return files._packed(seen, "", "", *files.thumbnail(files.grey_8bit(picture)))

    parts = {"outlines": "find_ellipses", "board": "find_boards", "circles' fits": "measure_centres"}
    kept = {name: getattr(image, name) for name in parts.values()}
    try:
        for what, name in parts.items():
            setattr(image, name, told(what, kept[name]))
        with one_thread():
            for path in paths:
                picture = told("decoding", decode)(path.read_bytes(), path.name)
                seen = told("together", image.detect_image)(picture, camera, target, board, EllipseOptions())
                told("packing, with a small picture", packed)(seen, picture)
    finally:
        for name, function in kept.items():
            setattr(image, name, function)
    found["faces' hypotheses, and the rest"] = found.pop("together") - sum(found[what] for what in parts)
    return found


def processor_time(paths: list[Path], data: Path) -> dict[str, float]:
    """CPU ms an image of one process with one thread, decoded before: ours, and what others find in them."""
    from stcal.io.images import decode
    from stcal.parallel import one_thread
    from stcal.sfm.detect.circles.candidates import EllipseOptions
    from stcal.sfm.detect.image import detect_image

    target, board = load_target(data / "target.toml"), load_board(data / "board.toml")
    camera = read_camera(data / "cameras.txt")
    camera = camera.sized(camera.width, camera.height)
    pictures = [decode(path.read_bytes(), path.name) for path in paths]
    area = np.pi * (board.radius_mm * 24 / 22.3 * camera.width / 1000) ** 2
    blobs = cv2.SimpleBlobDetector_Params()
    blobs.minThreshold, blobs.maxThreshold, blobs.thresholdStep, blobs.minRepeatability = THRESHOLDS[BY_HAND]
    blobs.blobColor, blobs.minArea, blobs.maxArea = 255, 0.34 * area / 2, 2 * area
    refined = cv2.aruco.DetectorParameters()
    refined.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    ways = {
        "stcal: faces, board, centres with σ": lambda grey: detect_image(grey, camera, target, board, EllipseOptions()),
        "OpenCV, blobs at 1 threshold": cv2.SimpleBlobDetector_create(blobs).detect,
        "OpenCV, ArUco": cv2.aruco.ArucoDetector(tags).detectMarkers,
        "OpenCV, ArUco, AprilTag's corners": cv2.aruco.ArucoDetector(tags, refined).detectMarkers,
    }
    try:
        from pupil_apriltags import Detector
    except ImportError:
        print("pupil_apriltags is not there: its rows are left out", file=sys.stderr)
    else:
        Detector.__del__ = lambda _: None  # it frees the family a second time, which ends the process
        ways["AprilTag 3, half resolution"] = Detector(quad_decimate=2.0).detect
        ways["AprilTag 3"] = Detector(quad_decimate=1.0).detect
    found, threads = {}, cv2.getNumThreads()
    cv2.setNumThreads(1)
    with one_thread():
        for title, way in ways.items():
            start = time.process_time()
            for picture in pictures:
                way(picture)
            found[title] = 1e3 * (time.process_time() - start) / len(pictures)
    cv2.setNumThreads(threads)
    return found


def best_of(rounds: list[dict]) -> dict:
    """Of each row the smallest and the median time (what else the machine did only adds)."""
    best = rounds[-1] | {"rounds": len(rounds)}
    for title, row in best["rows"].items():
        row["all_seconds"] = [each["rows"][title]["seconds"] for each in rounds]
        row["seconds"], row["median"] = min(row["all_seconds"]), statistics.median(row["all_seconds"])
        row["ratio"] = row["seconds"] / best["rows"]["decoding alone"]["seconds"]
    return best


def main() -> None:
    """Command line."""
    given = options_of(__doc__, images=40, width=5184, keep=Path, rounds=5, large=10_000, json=Path)
    if given.images % GROUPS or given.images < 4 * GROUPS:
        sys.exit(f"error: --images {given.images}: a multiple of {GROUPS}, at least {4 * GROUPS}, needed")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a user's modules are compiled from the second start on
    with tempfile.TemporaryDirectory() as scratch:
        os.environ.setdefault("PYTHONPYCACHEPREFIX", str(Path(scratch) / "compiled"))
        keep = given.keep or Path(scratch)
        data, stream = keep / "photographs", keep / "stream"
        render(data, given.images, given.width)
        render(stream, *STREAM)
        render_film(keep / "film")
        some = sorted((data / "images").glob("*/*"))[:: max(1, given.images // 10)]
        profiles = {
            "run_profile_s": run_profile(data, Path(scratch) / "profiled"),
            "detection_profile_ms": detection_profile(some, data),
        }
        rounds = [measure(data, stream, keep / "film", Path(scratch) / str(i)) for i in range(max(given.rounds, 1))]
        result = best_of(rounds) | profiles
        words = ["run", "--no-strict", data / "images", *files_of(data), "--out", Path(scratch) / "watched"]
        memory = timed_program(words, Path(scratch) / "log", watched=True)[1:]
        result |= dict(zip(("peak_process_mib", "peak_together_mib"), memory, strict=True))
        if given.large:
            result["large"] = dict(zip(("ratio", "mib"), timed_large(given.large), strict=True)) | {
                "images": given.large
            }
        times = [processor_time(some[::3], data) for _ in range(max(given.rounds, 1))]
        result["cpu_ms"] = {title: min(each[title] for each in times) for title in times[0]}
    print("{images} images of {size_px} px, {megabytes:.0f} MB, {workers} workers, {rounds} rounds".format(**result))
    print(f"{'':40} {'seconds':>8} {'median':>7} {'ratio':>6}   boards found, complete, right")
    for name, row in result["rows"].items():
        counts = f"{row['found']:8} {row['complete']:9} {row['right']:6}" if "found" in row else ""
        counts = f"{row['images'] / row['seconds']:8.1f} images a second" if "images" in row else counts
        counts = f"{row['mib']:8.0f} MiB" if "mib" in row else counts
        print(f"{name:40} {row['seconds']:8.2f} {row['median']:7.2f} {row['ratio']:6.2f} {counts}".rstrip())
    row = result["rows"]["stcal detection"]
    cost = row["seconds"] * result["workers"] / result["images"]
    a_day = f"{cost * 1e6 / 86400:.1f} cores, {result['megabytes'] / result['images'] * 1e6 / 86400:.0f} MB a second"
    print(f"detection: {cost:.2f} s of a core an image; a million such images a day: {a_day}")
    print("peak memory of the run: largest process {peak_process_mib:.0f} MiB, together".format(**result), end=" ")
    print("{peak_together_mib:.0f} MiB, pages that they share counted once".format(**result))
    if "large" in result:
        print(
            "{images} images, labels known: time an image {ratio:.2f} × that of 40, {mib:.0f} MiB".format(
                **result["large"]
            )
        )
    print("\nwhere the time of a run goes, s (one run, libraries loaded):")
    for stage, seconds in result["run_profile_s"].items():
        print(f"  {stage:52} {seconds:6.2f}")
    print("where that of detection goes, ms an image (one process alone):")
    for part, ms in result["detection_profile_ms"].items():
        print(f"  {part:52} {ms:6.1f}")
    print("detection, CPU ms an image (one thread, decoded before, the least of the rounds):")
    for title, ms in result["cpu_ms"].items():
        print(f"  {title:52} {ms:6.1f}")
    if given.json:
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    # Workers do not import the main module (stcal.parallel): they find these functions in an ordinary one.
    from bench_run import main as main_of_module

    main_of_module()
