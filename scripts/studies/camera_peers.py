#!/usr/bin/env python
"""Calibrate cameras with stcal, OpenCV, COLMAP's bundle adjustment and mrcal from the same centres; the truth is known.

Simulated are the centres of dots or corners on a board that is shown 15 times; rendered are the sets of
`stereo_target`, whose centres stcal finds. Told is by how much a camera sees directions elsewhere than the true one,
after the best turn, px RMS: over the whole image, and within the hull of all dots; RMS over the trials, too. In bold is
the nearest over the whole image, with all whose mean squares differ from its own by less than two standard errors of
the trials' differences. mrcal is called where its program is on the PATH. Views are complete, as OpenCV's method RO
wants them.

`with the target` : `run --refine-camera` on the same photographs, from the camera of `calibrate-camera` without its σ:
the target's circles stand where the board's dots do not reach. `mrcal, free` : without its regularization.
"""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from scripts.runner import DATA, head, script
from scripts.runner import row as print_row
from stcal.boards.board_file import board_of
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, reference_board
from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_image_offset
from stcal.io.cameras.camera_model import CameraModel, camera_from_colmap
from stcal.io.cameras.difference import compare_cameras
from stcal.io.cameras.read import read_camera
from stcal.sfm import run
from stcal.sfm.camera.calibrate import calibrate_camera
from stcal.sfm.camera.intrinsics import adjust_intrinsics, closed_form, start_camera, start_pose
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.runs.run_options import RunOptions

TRUE = Camera(2592, 1728, [2790.0, 2784.0], [1301.0, 859.0], [-0.06, 0.045, 1.5e-4, -1e-4, 0, 0, 0, 0])
SIZE = 2592, 1728
"""px, of simulated views."""
VIEWS = 15
NOISE_PX = 0.02
MODEL, MRCAL_MODEL = "OPENCV", "LENSMODEL_OPENCV4"
SETS = ("clean", "clutter", "white_block")


def boards() -> dict[str, tuple[BoardDesign, float, float]]:
    """Board, and how far its points are from the grid at random and by a bow, mm."""
    own = reference_board()
    large = replace(own, radius_mm=0.35 * own.pitch_mm, corner=None, corner_radius_mm=None)
    corners = replace(own, radius_mm=1e-6, unusual_size=True, corner=None, corner_radius_mm=None)
    return {
        "dots, exact board": (own, 0.0, 0.0),
        f"dots, board to {own.sigma_mm:g} mm": (own, own.sigma_mm, 0.0),
        "large dots, exact board": (large, 0.0, 0.0),
        "corners, exact board": (corners, 0.0, 0.0),
        "corners, board bowed by 0.2 mm": (corners, 0.0, 0.2),
    }


def simulated(board: BoardDesign, sigma_mm: float, bow_mm: float, rng) -> list[ImageObservations]:
    """Complete views of a board that is held before the camera, to the corners of the image."""
    flat = board.xy_mm()
    made = np.column_stack([flat, np.zeros(len(flat))]) + sigma_mm * rng.standard_normal((len(flat), 3))
    middle = flat.mean(axis=0)
    made[:, 2] += bow_mm * (((flat - middle) / np.ptp(flat, axis=0) * 2) ** 2).sum(axis=1) / 2
    size, views = np.array(SIZE), []
    while len(views) < VIEWS:
        rotation, place = held(rng, 700, 0.42)
        xyz = (made - [*middle, 0]) @ rotation.T + place
        xy = TRUE.project(circle_image_offset(xyz, np.tile(rotation[:, 2], (len(xyz), 1)), board.radii_mm()))
        if not ((xy > 10) & (xy < size - 10)).all():
            continue
        views.append(view_of(len(views), board.labels(), xy + NOISE_PX * rng.standard_normal(xy.shape)))
    return views


def held(rng: np.random.Generator, farthest_mm: float, aside: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and middle of a board that is held by hand from 0.3 m on, up to a share of the image ``aside``."""
    angles = [rng.uniform(-180, 180), *rng.uniform(-35, 35, 2)]
    depth = rng.uniform(300, farthest_mm)
    middle = np.append(rng.uniform(-aside, aside, 2) * [TRUE.width, TRUE.height] / TRUE.focal * depth, depth)
    return Rotation.from_euler("zxy", angles, degrees=True).as_matrix(), middle


def view_of(number: int, labels, xy: np.ndarray) -> ImageObservations:
    """Measured places (n, 2) px in one photograph."""
    n = len(xy)
    shape, covariance = np.tile(np.eye(2), (n, 1, 1)), np.tile(NOISE_PX**2 * np.eye(2), (n, 1, 1))
    return ImageObservations(f"{number:03}.png", ".", tuple(labels), xy, np.zeros((n, 2)), shape, covariance)


def points(views, board: BoardDesign) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Of the board, (n, 3) mm, and in the image, (n, 2) px, for each view."""
    xyz = [board.places_mm(view.labels).astype(np.float32) for view in views]
    return xyz, [view.centre_px.astype(np.float32) for view in views]


def by_stcal(views, board: BoardDesign, size) -> Camera:
    """This package."""
    start = closed_form(views, board, start_camera(*size, MODEL))
    return adjust_intrinsics(views, board, start, MODEL).camera


def of_opencv(size, matrix, distortion) -> Camera:
    """k1 k2 p1 p2 alone were free."""
    flat = np.concatenate([np.ravel(distortion), np.zeros(8)])[:8]
    return Camera(*size, np.diag(matrix)[:2], matrix[:2, 2], flat)


def by_opencv(views, board: BoardDesign, size) -> Camera:
    """Zhang's method as OpenCV has it: the board is exact."""
    xyz, xy = points(views, board)
    return of_opencv(size, *cv2.calibrateCamera(xyz, xy, size, None, None, flags=cv2.CALIB_FIX_K3)[1:3])


def by_opencv_ro(views, board: BoardDesign, size) -> Camera | None:
    """With the points of the board free (Strobl and Hirzinger 2011), all but three."""
    xyz, xy = points(views, board)
    if len({len(each) for each in xyz}) > 1 or len(xyz[0]) != board.rows * board.columns:
        return None
    order = [np.lexsort((own[:, 0], own[:, 1])) for own in xyz]
    xyz, xy = ([own[i] for own, i in zip(every, order, strict=True)] for every in (xyz, xy))
    found = cv2.calibrateCameraRO(xyz, xy, size, board.columns - 1, None, None, flags=cv2.CALIB_FIX_K3)
    return of_opencv(size, *found[1:3])


def by_colmap(views, board: BoardDesign, size) -> Camera:
    """COLMAP's bundle adjustment: the board is exact, poses and camera start where stcal's closed form has them."""
    start = closed_form(views, board, start_camera(*size, MODEL))
    made = pycolmap.Reconstruction()
    fx, cx = float(start.focal[0]), start.centre + 0.5
    camera = pycolmap.Camera(model=MODEL, width=size[0], height=size[1], params=[fx, fx, *cx, 0, 0, 0, 0], camera_id=1)
    made.add_camera_with_trivial_rig(camera)
    labels = board.labels()
    for xyz in board.places_mm(labels):
        made.add_point3D(xyz.astype(float), pycolmap.Track(), np.zeros(3, np.uint8))
    number = dict(zip(labels, sorted(made.points3D), strict=True))
    for k, view in enumerate(views):
        pose = start_pose(view, board, start)
        image = pycolmap.Image(name=view.name, image_id=k + 1, camera_id=1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy + 0.5) for xy in view.centre_px])
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation])))
        for j, label in enumerate(view.labels):
            made.add_observation(number[label], pycolmap.TrackElement(k + 1, j))
    config = pycolmap.BundleAdjustmentConfig()
    for k in range(len(views)):
        config.add_image(k + 1)
    for i in number.values():
        config.add_constant_point(i)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    pycolmap.create_default_bundle_adjuster(options, config, made).solve()
    own = made.cameras[1]
    return camera_from_colmap(MODEL, own.width, own.height, own.params, "COLMAP").calibrated(0, 0)


def by_mrcal(views, board: BoardDesign, size, more: tuple[str, ...] = ()) -> Camera | None:
    """mrcal's program, with ``more`` options; the board may be bowed."""
    if not shutil.which("mrcal-calibrate-cameras"):
        return None
    rows = ["# filename x y level"]
    for k, view in enumerate(views):
        place = dict(zip(view.labels, view.centre_px, strict=True))
        rows += [f"{k:03}.png {x:.9f} {y:.9f} 0" if (x == x) else f"{k:03}.png - - -" for x, y in _all(place, board)]
    with tempfile.TemporaryDirectory() as scratch:
        corners = Path(scratch) / "corners.vnl"
        corners.write_text("\n".join(rows) + "\n")
        words = ["--corners-cache", corners, "--lensmodel", MRCAL_MODEL, "--focal", 1.2 * size[0]]
        words += ["--object-spacing", board.pitch_mm / 1e3, "--object-width-n", board.columns]
        words += ["--object-height-n", board.rows, "--imagersize", *size, "--outdir", scratch]
        command = ["mrcal-calibrate-cameras", *map(str, words), *more, "*.png"]
        ended = subprocess.run(command, capture_output=True, text=True, cwd=scratch, check=False)
        models = list(Path(scratch).glob("*.cameramodel"))
        if not models:
            sys.exit(f"error: mrcal: {ended.stderr[-300:]}")
        return read_camera(models[0]).calibrated(0, 0)


def _all(place: dict, board: BoardDesign):
    return (place.get(label, (np.nan, np.nan)) for label in board.labels())


def errors(camera: Camera | None, truth: Camera, views) -> tuple[float, float]:
    """px RMS over the image and within the hull of the dots."""
    if camera is None:
        return np.nan, np.nan
    found = compare_cameras(truth, camera)
    length = found.lengths()
    inside = Delaunay(np.concatenate([v.centre_px for v in views])).find_simplex(found.pixels) >= 0
    return float(np.sqrt(np.nanmean(length**2))), float(np.sqrt(np.nanmean(length[inside] ** 2)))


WAYS = {"stcal": by_stcal, "OpenCV": by_opencv, "OpenCV RO": by_opencv_ro, "COLMAP": by_colmap, "mrcal": by_mrcal}
FREE, TARGET = "mrcal, free", "stcal with the target"
COLUMNS = ("stcal", TARGET, *list(WAYS)[1:], FREE)


def with_the_target(folder: Path, found: Camera, designs: tuple[Path | None, Path | None]) -> Camera:
    """`run --refine-camera`, which starts at the camera found, and takes nothing of its σ."""
    given = CameraModel(found.focal, found.centre, found.distortion, MODEL, found.width, found.height, "the study")
    with tempfile.TemporaryDirectory() as scratch:
        result = run(folder / "images", given, Path(scratch) / "run", *designs, options=RunOptions(refine_camera=True))
    assert result.refined_camera is not None
    return result.refined_camera


def as_near(squares: np.ndarray, best: np.ndarray) -> bool:
    """Whether mean squares (n,) differ from the best by less than two standard errors of their differences."""
    further = squares - best
    return bool(further.mean() <= 2 * further.std(ddof=min(1, len(best) - 1)) / np.sqrt(len(best)))


def row(name: str, trials: list[dict[str, tuple[float, float]]]) -> None:
    """Prints RMS of the trials; the nearest to the truth over the image, and what is as near, in bold."""
    squares = {way: np.square([trial.get(way, (np.nan, np.nan)) for trial in trials]) for way in COLUMNS}
    rms = {way: np.sqrt(each.mean(axis=0)) for way, each in squares.items()}
    best = squares[min((way for way in COLUMNS if np.isfinite(rms[way][0])), key=lambda way: rms[way][0])][:, 0]
    cells = []
    for way in COLUMNS:
        whole, inside = rms[way]
        bold = "**" if as_near(squares[way][:, 0], best) else ""
        cells.append(f"{bold}{whole:.4f} ({inside:.4f}){bold}" if np.isfinite(whole) else "–")
    print_row(name, len(trials), *cells)


@script(trials=60)
def main(options) -> None:
    head("px RMS over the image (where dots are)", "trials", *COLUMNS)
    peers = WAYS | {FREE: partial(by_mrcal, more=("--skip-regularization",))}
    for name, (board, sigma_mm, bow_mm) in boards().items():
        trials = []
        for seed in range(options.trials):
            views = simulated(board, sigma_mm, bow_mm, np.random.default_rng(seed))
            trials.append({way: errors(calibrate(views, board, SIZE), TRUE, views) for way, calibrate in peers.items()})
        row(f"simulated {name}", trials)
    for name in SETS if (DATA / "stereo_target").is_dir() else ():
        folder = DATA / "stereo_target" / name
        target_file, board_file = (p if p.exists() else None for p in (folder / "target.toml", folder / "board.toml"))
        target, board = target_of(target_file), board_of(board_file)
        found = calibrate_camera(folder / "images", target, board, MODEL)
        truth = read_camera(folder / "cameras.txt").calibrated(0, 0)
        size = truth.width, truth.height
        ways = {way: calibrate(found.views, board, size) for way, calibrate in peers.items() if way != "stcal"}
        own = found.intrinsics.camera
        ways |= {"stcal": own, TARGET: with_the_target(folder, own, (target_file, board_file))}
        trial = {way: errors(camera, truth, found.views) for way, camera in ways.items()}
        row(f"rendered {name}, {len(found.views)} views", [trial])
