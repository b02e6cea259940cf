#!/usr/bin/env python
"""Calibrate cameras from real photographs of boards, of which no truth is known, with stcal and with OpenCV.

OpenCV finds corners with its own detectors and default settings, and calibrates with `calibrateCamera` and the lens
model of COLMAP's OPENCV (k3 is zero); `OpenCV, stcal's corners` is given those that stcal has found and kept. RMS: of
all residuals, px per coordinate. Held out: the views are left out in five parts, a fifth at a time, the camera is
calibrated without them, and then only their poses are fitted, all residuals again. OpenCV has the board as designed,
stcal with the places of its dots and corners estimated from the other views. σ of the focal length is the one stated.

Data: `real` of shared/data; a set that is not there is left out. Each set takes minutes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scripts.runner import DATA, head, row, script
from stcal.boards.board_designs import CharucoDesign, ChessboardDesign
from stcal.boards.board_file import load_flat_board
from stcal.boards.dictionaries import dictionary_of
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign
from stcal.io.images import find_images
from stcal.sfm.camera.calibrate import FOLDS, calibrate_camera, residual_rms_px
from stcal.workflows.board_views import calibrate_camera_by_corners, corner_grid

SETS = {
    "boofcv_circle_regular": (".", "board.toml"),
    "multidic_chessboard": ("201", "board.toml"),
    "pycamset_charuco": ("1", "board.toml"),
    "pycamset_cube": ("cam0", "face4.toml"),
}
"""Folder of the photographs and board file of each set."""
LEAST_POINTS = 6
"""Smallest number of points of a view that OpenCV calibrates with."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Points of one image: ``xyz_board`` (n, 3) mm and ``xy_px`` (n, 2)."""

    xyz_board: np.ndarray
    xy_px: np.ndarray


def found_by_opencv(grey: np.ndarray, board) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows (n,) of the board's points, and where OpenCV has them, (n, 2) px; None without the board."""
    if isinstance(board, CharucoDesign):
        ids = np.array(board.tag_ids(), np.int32)
        own = dictionary_of(board.dictionary)
        plain = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, own, ids)
        plain.setLegacyPattern(board.legacy)
        corners, rows, _, _ = cv2.aruco.CharucoDetector(plain).detectBoard(grey)
        return None if rows is None else (rows.ravel(), corners.reshape(-1, 2))
    if isinstance(board, ChessboardDesign):
        found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows))
    else:
        found, corners = cv2.findCirclesGrid(grey, (board.columns, board.rows))
    return (np.arange(board.rows * board.columns), corners.reshape(-1, 2)) if found else None


def views_of_opencv(folder: Path, board) -> list[View]:
    """The views in which OpenCV finds the board."""
    xyz, views = np.pad(board.xy_mm(), ((0, 0), (0, 1))), []
    for file in find_images(folder)[0]:
        found = found_by_opencv(cv2.imread(str(file.path), cv2.IMREAD_GRAYSCALE), board)
        if found is not None and len(found[0]) >= LEAST_POINTS:
            views.append(View(xyz[found[0]], found[1]))
    return views


def of_opencv(views: Sequence[View], size: tuple[int, int]):
    """What `calibrateCameraExtended` returns."""
    xyz, xy = [v.xyz_board.astype(np.float32) for v in views], [v.xy_px.astype(np.float32) for v in views]
    return cv2.calibrateCameraExtended(xyz, xy, size, None, None, flags=cv2.CALIB_FIX_K3)


def cells(views: Sequence, rms: float, held_out: Sequence[np.ndarray], focal: float, focal_sigma: float) -> tuple:
    """Of a row: what one way made of a set; ``held_out`` : residuals by view, px."""
    residual = float(np.sqrt((np.concatenate(held_out) ** 2).mean()))
    return len(views), sum(map(len, views)), f"{rms:.3f}", f"{residual:.3f}", f"{focal:.1f} ± {focal_sigma:.2g}"


def by_opencv(views: Sequence[View], size: tuple[int, int]) -> tuple:
    """Cells of OpenCV, with the board as designed."""
    rms, matrix, _, _, _, sigma, *_ = of_opencv(views, size)
    residuals = []
    for fold in range(FOLDS):
        _, inner, lens, *_ = of_opencv([view for i, view in enumerate(views) if i % FOLDS != fold], size)
        for view in views[fold::FOLDS]:
            _, turn, place = cv2.solvePnP(view.xyz_board, view.xy_px, inner, lens)
            there = cv2.projectPoints(view.xyz_board, turn, place, inner, lens)[0]
            residuals.append(there.reshape(-1, 2) - view.xy_px)
    return cells([v.xy_px for v in views], rms / np.sqrt(2), residuals, matrix[0, 0], float(sigma[0, 0]))


def rows(name: str) -> None:
    """Prints the table's rows of one set."""
    images, file = SETS[name]
    place = DATA / "real" / name
    folder, board = place / images, load_flat_board(place / file)
    dots = isinstance(board, BoardDesign)
    grid = board if dots else corner_grid(board)
    found = calibrate_camera(folder, target_of(None), board) if dots else calibrate_camera_by_corners(folder, board)
    own = found.intrinsics
    size = own.camera.width, own.camera.height
    title = f"{name}: {len(find_images(folder)[0])} images"
    focal = float(own.camera.focal[0]), float(own.sigma()[0])
    row(title, "stcal", *cells(found.views, residual_rms_px(own), found.held_out.residuals_px, *focal))
    views = [View(grid.places_mm(view.labels), view.centre_px) for view in found.views]
    row(title, "OpenCV, stcal's corners", *by_opencv(views, size))
    row(title, "OpenCV", *by_opencv(views_of_opencv(folder, board), size))


@script(sets=list(SETS))
def main(given) -> None:
    head("photographs", "way", "views", "points", "RMS px", "held out px", "focal length px")
    for name in given.sets:
        if (DATA / "real" / name).is_dir():
            rows(name)
