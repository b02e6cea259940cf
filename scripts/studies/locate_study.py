"""How good ``stcal locate`` is: real photographs of a ChArUco board whose tags are the target and whose chessboard
corners are the truth, the same exposed again in simulated light, simulated corners, and the time of it.

.venv/bin/python scripts/studies/locate_study.py [../shared/data/charuco_handeye/test_set_charuco]
    [--part subsets|exposures|covariance|edges|time] [--only GATE] [--most 200]

The folder holds ``images/`` of a 7×5 board of DICT_6X6_250 (squares of 36.195 mm, tags of 18.256 mm) and
``cal_data.yaml`` with its intrinsics. Even images calibrate the layout, odd ones are located; then the other way round.
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import CharucoDesign, TagLayout
from stcal.boards.dictionaries import dictionary_of
from stcal.boards.tags import Tags, find_tags
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import read_camera
from stcal.io.images import decode, find_images
from stcal.locate.estimate import locate, merge
from stcal.locate.layout import LayoutPlan, TargetLayout
from stcal.locate.layout_calibration import CalibrationImages
from stcal.locate.scenes import LocateOptions, find_scenes, locate_image, run
from stcal.locate.verdict import PatentOptions, VerdictOptions, judge
from stcal.parallel import one_thread
from stcal.synthetic.optics import Light, expose
from stcal.workflows.board_views import calibration_images
from tests.support.areas import homography, rendered, squares_nees, warped
from tests.support.holdout import PoseTrial, half_calibrated, subset_trials
from tests.support.tags import CAMERA, CornerNoise, example_layout, random_pose, simulated_exposures

BOARD = CharucoDesign(7, 5, 36.195, 18.256, "DICT_6X6_250")
TAGS = 17
ORIGIN = 8
TIMES = np.geomspace(1 / 16, 16, 5)
PARTS = ("subsets", "exposures", "covariance", "edges", "time")
EDGE_LAYOUT = TagLayout.from_tags(
    "APRILTAG_36h11", (0, 1, 2), [[0.0, 0.0], [120.0, 0.0], [0.0, 110.0]], [60.0, 60.0, 40.0], [0.0, 90.0, 180.0]
)
EDGE_CAMERA = Camera(640, 560, [1100.0, 1100.0], [319.5, 279.5], np.zeros(8))
SHEET_PER_MM, SHEET_MARGIN_MM = 6, 30.0


def charuco_plan() -> LayoutPlan:
    """The board's tags as a target of unknown places."""
    tags = tuple((BOARD.dictionary, k) for k in range(TAGS))
    return LayoutPlan("tags of a ChArUco", tags, np.full(TAGS, BOARD.marker_mm), ORIGIN, np.full((TAGS, 4, 2), np.nan))


def charuco_camera(folder: Path) -> CameraModel:
    """Intrinsics of the set, which states no distortion."""
    return read_camera(folder / "cal_data.yaml")


def charuco_images(folder: Path) -> CalibrationImages:
    """All images of the set in the order of their numbers."""
    found = calibration_images(
        folder / "images", charuco_camera(folder), BOARD, (BOARD.dictionary,), 1, lambda *_: None
    )
    order = sorted(range(len(found.names)), key=lambda i: int(Path(found.names[i]).stem))
    names, views, tags = (tuple(values[i] for i in order) for values in (found.names, found.views, found.tags))
    return replace(found, names=names, views=views, tags=tags)


def halves(images: CalibrationImages) -> list[tuple[list[int], list[int]]]:
    """Images to calibrate with and to locate."""
    even, odd = list(range(0, len(images.names), 2)), list(range(1, len(images.names), 2))
    return [(even, odd), (odd, even)]


def subsets(images: CalibrationImages, only: str, most: int | None) -> None:
    print("real images, against the chessboard corners; subsets: all, or so many of each size and image (--most)\n")
    print("| gate | tags | poses | accepted | ambiguous | wrong branch | off by > 5° | mean of the accepted | worst |")
    print("|---|---|---|---|---|---|---|---|---|")
    gates = {"verdict": VerdictOptions(), "odds of the other 1:100": VerdictOptions(flip_odds=1e-2)}
    gates["the patent's gate"] = PatentOptions()
    calibrated = [(half_calibrated(images, charuco_plan(), chosen), others) for chosen, others in halves(images)]
    for name, options in gates.items():
        if not name.startswith(only):
            continue
        for size in (None, 4, 3, 2, 1):
            trials: list[PoseTrial] = []
            for half, others in calibrated:
                trials += subset_trials(images, others, half, size, options, most)
            print(f"| {name} | {f'any {size}' if size else 'all'} | {_cells(trials)} |", flush=True)


def _cells(trials: Sequence[PoseTrial]) -> str:
    used = [t for t in trials if t.decision == "accept"]
    ambiguous = sum(t.decision == "ambiguous" for t in trials)
    flipped, far = sum(t.flipped for t in used), sum(t.error_rad > np.radians(5) for t in used)
    text = f"{len(trials)} | {len(used)} | {ambiguous} | {flipped} | {far} | "
    if not used:
        return text + "– | –"
    rad, mm = np.array([(t.error_rad, t.error_mm) for t in used]).T
    return text + f"{np.degrees(rad.mean()):.2f}°, {mm.mean():.2f} mm | {np.degrees(rad.max()):.1f}°, {mm.max():.1f} mm"


def relit(photograph: np.ndarray, tags: Tags, seed: int, stops: float = 8.0) -> list[np.ndarray]:
    """Five exposures in light that falls off by so many powers of two over the target, with a spot of glare on it."""
    rng = np.random.default_rng(seed)
    width = photograph.shape[1]
    corners = tags.corners_px.reshape(-1, 2) / width
    at = tuple(corners.mean(0) + 0.05 * rng.standard_normal(2))
    extent = float(np.ptp(corners, axis=0).max())
    middle = tuple(corners.mean(0))
    light = Light(stops / extent, rng.uniform(0, 2 * np.pi), middle, glare=2.0, glare_at=at, glare_radius=extent / 8)
    return expose(photograph, TIMES, light=light, seed=seed)


def exposures(folder: Path, images: CalibrationImages) -> None:
    print("real images exposed again (simulated): 5 exposures over 8 stops; light falling off over the target, glare")
    layout = half_calibrated(images, charuco_plan(), range(len(images.names))).layout
    photographs = [cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE) for name in images.names]
    for stops in (2, 4, 6, 8):
        counts, together, shifts = [], [], []
        for i, photograph in enumerate(photographs):
            found = [find_tags(each, layout.dictionaries()) for each in relit(photograph, images.tags[i], i, stops)]
            merged = merge(found, layout)
            counts.append(max(merged.counts))
            together.append(len(merged.seen))
            shifts += [shift.shift_px for shift in merged.shifts]
        fewer = sum(all_ < best for all_, best in zip(together, counts, strict=True))
        print(
            f"  {stops} stops: best single exposure {sum(counts):3d} tags, together {sum(together):3d}: "
            f"{sum(together) / sum(counts):.2f} times, fewer in {fewer} scenes; apparent shift of tags at most "
            f"{max(shifts):.2f} px"
        )


def covariance(count: int = 500) -> None:
    print(f"simulated corners, mean of e'C^-1 e / 6 over {count} poses (expected 1, σ of the mean 0.026)")
    layout, printed = example_layout(), example_layout(0.03, 0.3)
    six = tuple(range(6))
    cases = {
        "6 tags, 1 exposure": (layout, (six,), (10, 50), CornerNoise()),
        "6 tags, 5 exposures, half of the variance shared": (layout, (six,) * 5, (10, 50), CornerNoise()),
        "6 tags, 5 exposures, all of it shared": (layout, (six,) * 5, (10, 50), CornerNoise(shared=1.0)),
        "6 tags, 5 exposures, none of it shared": (layout, (six,) * 5, (10, 50), CornerNoise(shared=0.0)),
        "each exposure other tags": (layout, ((0, 1, 2), (2, 3, 4), (4, 5)), (10, 50), CornerNoise()),
        "6 tags, 0.3 px of print and lens": (printed, (six,), (10, 50), CornerNoise()),
        "6 tags, frontal": (layout, (six,), (0, 5), CornerNoise()),
        "2 tags": (layout, ((0, 3),), (10, 50), CornerNoise()),
        "1 tag": (layout, ((0,),), (10, 50), CornerNoise()),
        "1 tag, frontal": (layout, ((0,),), (0, 10), CornerNoise()),
    }
    for name, case in cases.items():
        value, accepted, wrong = calibration(*case, count)
        print(f"  {name:<50} {value:.3f}  accepted {accepted}, wrong branch {wrong}")


def calibration(
    layout: TargetLayout, shown, tilt_deg, noise: CornerNoise, count: int, seed: int = 5
) -> tuple[float, int, int]:
    """Mean normalised squared error of the accepted poses, how many these are, and how many of them off by over 5°."""
    rng = np.random.default_rng(seed)
    squares, wrong = [], 0
    for _ in range(count):
        truth = random_pose(rng, tilt_deg=tilt_deg)
        seen = merge(simulated_exposures(layout, truth, rng, noise, shown), layout).seen
        pose, verdict = judge(locate(seen, layout, CAMERA))
        error = Poses.of([pose.camera_from_obj]).difference(Poses.of([truth]))[0]
        if verdict.decision == "accept":
            squares.append(error @ np.linalg.solve(pose.covariance, error) / 6)
            wrong += np.linalg.norm(error[:3]) > np.radians(5)
    return float(np.mean(squares)), len(squares), int(wrong)


def edges(count: int) -> None:
    print(f"three tags of 30 to 130 px, rendered with noise of 1 % of the contrast, {count} scenes a row\n")
    print("| rendered | blur, px | turned | tilted | mean of e'C^-1 e / 6 | largest | accepted |")
    print("|---|---|---|---|---|---|---|")
    views = [(turn, 0) for turn in (0, 1, 2, 5, 20, 45)] + [(0, 20), (0, 40), (0, 60), (20, 60)]
    rows = [
        (kind, blur, turn, tilt, count)
        for kind, blur in (("by area", 0.5), ("by area", 1.0), ("warped sheet", 0.5))
        for turn, tilt in views
    ]
    pool = ProcessPoolExecutor(mp_context=multiprocessing.get_context("fork"))
    for row, (squares, accepted) in zip(rows, pool.map(_edge_scenes, *zip(*rows, strict=True)), strict=True):
        kind, blur, turn, tilt, _ = row
        figures = f"{np.mean(squares):.2f} | {np.max(squares):.1f}"
        print(f"| {kind} | {blur} | {turn}° | {tilt}° | {figures} | {accepted} of {count} |", flush=True)


@one_thread()
def _edge_scenes(kind: str, blur: float, turn: float, tilt: float, count: int) -> tuple[list[float], int]:
    """Normalised squared errors of the poses in as many scenes, and how many of them are accepted."""
    sheet, sheet_from_mm = _drawn_sheet()
    matrix = np.array([[1100.0, 0, 319.5], [0, 1100.0, 279.5], [0, 0, 1]])
    rng, squares, accepted = np.random.default_rng(7), [], 0
    for _ in range(count):
        truth = _edge_pose(rng, turn, tilt)
        place, size = homography(matrix, truth.rotation, truth.translation), (640, 560)
        if kind == "by area":
            image = rendered(EDGE_LAYOUT, place, size, rng, blur)
        else:
            image = warped(sheet, place @ np.linalg.inv(sheet_from_mm), size, rng, blur)
        result = locate_image(image, EDGE_LAYOUT, EDGE_CAMERA)
        accepted += result.verdict.decision == "accept"
        if result.pose is not None:
            error = Poses.of([result.pose.camera_from_obj]).difference(Poses.of([truth]))
            squares.append(squares_nees(error, result.pose.covariance[None])[0])
    return squares, accepted


def _edge_pose(rng: np.random.Generator, turn_deg: float, tilt_deg: float) -> Rigid:
    """camera_from_obj of a target turned in the image, then tilted to any side."""
    side = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([np.cos(side), np.sin(side), 0]))
    rotation = (tilt * Rotation.from_euler("z", turn_deg + 90 * rng.integers(4), degrees=True)).as_matrix()
    middle = EDGE_LAYOUT.corners_mm.reshape(-1, 2).mean(0)
    depth = rng.uniform(500, 900)
    return Rigid(rotation, np.array([*rng.uniform(-15, 15, 2), depth]) - rotation[:, :2] @ middle)


def _drawn_sheet() -> tuple[np.ndarray, np.ndarray]:
    """The target drawn in pixels, and the homography to them from mm."""
    corners = EDGE_LAYOUT.corners_mm
    first, last = corners.min((0, 1)) - SHEET_MARGIN_MM, corners.max((0, 1)) + SHEET_MARGIN_MM
    sheet = np.full(np.rint((last - first)[::-1] * SHEET_PER_MM).astype(int), 255, np.uint8)
    for (name, tag), place in zip(EDGE_LAYOUT.tags, corners, strict=True):
        side = round(np.linalg.norm(place[1] - place[0]) * SHEET_PER_MM)
        turns = round(np.degrees(np.arctan2(*(place[1] - place[0])[::-1])) / 90)
        left, top = np.rint((place.min(0) - first) * SHEET_PER_MM).astype(int)
        drawn = cv2.aruco.generateImageMarker(dictionary_of(name), tag, side)
        sheet[top : top + side, left : left + side] = np.rot90(drawn, -turns)
    scale, half = SHEET_PER_MM, 0.5
    return sheet, np.array([[scale, 0, -scale * first[0] - half], [0, scale, -scale * first[1] - half], [0, 0, 1]])


def timing(folder: Path, images: CalibrationImages, rounds: int = 5) -> None:
    print("time of a scene of 5 exposures of 2 MP, against decoding them")
    layout = half_calibrated(images, charuco_plan(), range(len(images.names))).layout
    model = charuco_camera(folder)
    with tempfile.TemporaryDirectory() as place:
        photograph = cv2.imread(str(folder / "images" / images.names[5]), cv2.IMREAD_GRAYSCALE)
        for k, each in enumerate(relit(photograph, images.tags[5], 5)):
            cv2.imwrite(f"{place}/{k}.png", each)
        scenes = find_scenes(place)
        files, _ = find_images(place)
        list(run(scenes, layout, model))
        for name, clock in (("by the clock", time.perf_counter), ("time of all cores", time.process_time)):
            decoding, all_of_it = [], []
            for _ in range(rounds):
                start = clock()
                for file in files:
                    decode(file.path.read_bytes(), file.name)
                middle = clock()
                result = next(iter(run(scenes, layout, model, LocateOptions())))
                decoding.append(middle - start)
                all_of_it.append(clock() - middle)
            ratio = np.median(np.array(all_of_it) / decoding)
            print(
                f"  {name}: decoding {1e3 * np.median(decoding):.0f} ms, scene {1e3 * np.median(all_of_it):.0f} ms: "
                f"{ratio:.2f} times ({result.verdict.decision}, {len(result.merged.seen)} tags)"
            )


@one_thread()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    default = Path(__file__).resolve().parents[3] / "shared" / "data" / "charuco_handeye" / "test_set_charuco"
    parser.add_argument("folder", type=Path, nargs="?", default=default)
    parser.add_argument("--part", choices=PARTS)
    parser.add_argument("--only", default="", metavar="TEXT", help="of the subsets, gates that begin so")
    parser.add_argument("--most", type=int)
    arguments = parser.parse_args()
    chosen = [arguments.part] if arguments.part else PARTS
    images = None if arguments.part in ("covariance", "edges") else charuco_images(arguments.folder)
    for part in chosen:
        match part:
            case "subsets":
                subsets(images, arguments.only, arguments.most)
            case "exposures":
                exposures(arguments.folder, images)
            case "covariance":
                covariance()
            case "edges":
                edges(arguments.most or 160)
            case "time":
                timing(arguments.folder, images)


if __name__ == "__main__":
    main()
