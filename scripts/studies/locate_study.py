"""How good ``stcal locate`` is: real photographs of a ChArUco board whose tags are the target and whose chessboard
corners are the truth, and rendered tags.

.venv/bin/python scripts/studies/locate_study.py [--part subsets|edges] [--only GATE] [--most 200]

``charuco_handeye`` holds ``images/`` of a 7×5 board of DICT_6X6_250 (squares of 36.195 mm, tags of 18.256 mm) and
``cal_data.yaml`` with its intrinsics. Even images calibrate the layout, odd ones are located; then the other way round.
``--only`` : gates that begin so; ``--most`` : subsets of each image, or scenes.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from scripts.runner import DATA, executor_of, head, row, script
from stcal.boards.board_designs import CharucoDesign, TagLayout
from stcal.boards.dictionaries import dictionary_of
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.read import read_camera
from stcal.locate.layout import LayoutPlan
from stcal.locate.layout_calibration import CalibrationImages
from stcal.locate.scenes import locate_image
from stcal.locate.verdict import PatentOptions, VerdictOptions
from stcal.parallel import one_thread
from stcal.workflows.board_views import calibration_images
from tests.support.areas import homography, rendered, squares_nees, warped
from tests.support.tags import PoseTrial, half_calibrated, subset_trials

BOARD = CharucoDesign(7, 5, 36.195, 18.256, "DICT_6X6_250")
TAGS = 17
ORIGIN = 8
FOLDER = DATA / "charuco_handeye" / "test_set_charuco"
EDGE_LAYOUT = TagLayout.from_tags(
    "APRILTAG_36h11", (0, 1, 2), [[0.0, 0.0], [120.0, 0.0], [0.0, 110.0]], [60.0, 60.0, 40.0], [0.0, 90.0, 180.0]
)
EDGE_CAMERA = Camera(640, 560, [1100.0, 1100.0], [319.5, 279.5], np.zeros(8))
SHEET_PER_MM, SHEET_MARGIN_MM = 6, 30.0


def charuco_plan() -> LayoutPlan:
    """The board's tags as a target of unknown places."""
    tags = tuple((BOARD.dictionary, k) for k in range(TAGS))
    return LayoutPlan("tags of a ChArUco", tags, ORIGIN, np.full((TAGS, 4, 2), np.nan))


def charuco_images(folder: Path) -> CalibrationImages:
    """All images of the set in the order of their numbers."""
    camera = read_camera(folder / "cal_data.yaml")  # of no distortion
    found = calibration_images(folder / "images", camera, BOARD, (BOARD.dictionary,), 1, lambda *_: None)
    order = sorted(range(len(found.names)), key=lambda i: int(Path(found.names[i]).stem))
    names, views, tags = (tuple(values[i] for i in order) for values in (found.names, found.views, found.tags))
    return replace(found, names=names, views=views, tags=tags)


def subsets(images: CalibrationImages, only: str, most: int | None) -> None:
    print("real images, against the chessboard corners; subsets: all, or so many of each size and image (--most)\n")
    counts = "poses", "accepted", "ambiguous", "wrong branch", "off by > 5°"
    head("gate", "tags", *counts, "mean of the accepted", "worst")
    gates = {"verdict": VerdictOptions(), "odds of the other 1:100": VerdictOptions(flip_odds=1e-2)}
    gates["the patent's gate"] = PatentOptions()
    halves = [list(range(first, len(images.names), 2)) for first in (0, 1)]
    calibrated = [(half_calibrated(images, charuco_plan(), own), other) for own, other in (halves, halves[::-1])]
    for name, options in gates.items():
        if not name.startswith(only):
            continue
        for size in (None, 4, 3, 2, 1):
            trials: list[PoseTrial] = []
            for half, others in calibrated:
                trials += subset_trials(images, others, half, size, options, most)
            row(name, f"any {size}" if size else "all", *_cells(trials))


def _cells(trials: Sequence[PoseTrial]) -> list:
    used = [t for t in trials if t.decision == "accept"]
    ambiguous = sum(t.decision == "ambiguous" for t in trials)
    flipped, far = sum(t.flipped for t in used), sum(t.error_rad > np.radians(5) for t in used)
    counts = [len(trials), len(used), ambiguous, flipped, far]
    if not used:
        return [*counts, "–", "–"]
    rad, mm = np.array([(t.error_rad, t.error_mm) for t in used]).T
    mean = f"{np.degrees(rad.mean()):.2f}°, {mm.mean():.2f} mm"
    return [*counts, mean, f"{np.degrees(rad.max()):.1f}°, {mm.max():.1f} mm"]


def edges(count: int) -> None:
    print(f"three tags of 30 to 130 px, rendered with noise of 1 % of the contrast, {count} scenes a row\n")
    head("rendered", "blur, px", "turned", "tilted", "mean of e'C^-1 e / 6", "largest", "accepted")
    views = [(turn, 0) for turn in (0, 1, 2, 5, 20, 45)] + [(0, 20), (0, 40), (0, 60), (20, 60)]
    kinds = ("by area", 0.5), ("by area", 1.0), ("warped sheet", 0.5)
    cases = [(*kind, *view, count) for kind in kinds for view in views]
    with executor_of() as pool:
        for case, (squares, accepted) in zip(cases, pool.map(_edge_scenes, *zip(*cases, strict=True)), strict=True):
            kind, blur, turn, tilt, _ = case
            figures = f"{np.mean(squares):.2f}", f"{np.max(squares):.1f}"
            row(kind, blur, f"{turn}°", f"{tilt}°", *figures, f"{accepted} of {count}")


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


@script(part="", only="", most=int, limited=True)
def main(given) -> None:
    if given.part in ("", "subsets"):
        subsets(charuco_images(FOLDER), given.only, given.most)
    if given.part in ("", "edges"):
        edges(given.most or 160)
