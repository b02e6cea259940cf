"""Dot boards for systems that do not know circles: their dots found by ``stcal.sfm``, as points of a flat board."""

import tempfile
from pathlib import Path

import numpy as np

from stcal.boards.design import BoardView, turns
from stcal.camera_file import CameraModel
from stcal.design import BoardDesign, reference_target
from stcal.geometry.camera import Camera
from stcal.geometry.conic import circle_image_offset
from stcal.geometry.plane import camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.images import find_images

ROUNDS = 3
"""The correction depends on the pose, and the pose a little on the correction: a thousandth in each round."""


def circle_views(folder: Path, model: CameraModel, board: BoardDesign, workers: int | None, progress) -> dict:
    """:class:`BoardView` by image name, of images that show the board: where the dots' own centres are seen, which is
    not where their ellipses have theirs."""
    from stcal.sfm.board_views import board_views, design_mm
    from stcal.sfm.detect.ellipses import EllipseOptions
    from stcal.sfm.detection import detect_files

    files, _ = find_images(folder)
    done = []

    def step(name: str) -> None:
        done.append(name)
        progress("dots", len(done), len(files))

    with tempfile.TemporaryDirectory(prefix="stcal-dots-") as cache:
        found = detect_files(files, model, reference_target(), board, EllipseOptions(), Path(cache), workers, step)
    views, number = {}, {label: k for k, label in enumerate(board.labels())}
    for view in board_views(found.images, board, found.camera):
        xyz = design_mm(view.labels, board)
        ids = np.array([number[label] for label in view.labels])
        pixels = _centres(xyz, view.centre, board.radii_mm()[ids], found.camera)
        views[view.name] = BoardView(view.name, ids, xyz, pixels, view.covariance_px2)
    return views


def symmetries(board: BoardDesign) -> list[Rigid]:
    """Turns after which the board looks the same."""
    if board.corner is not None:
        return []
    return turns(board.xy_mm(), [1, 2, 3] if board.rows == board.columns else [2])


def _centres(xyz: np.ndarray, ellipse: np.ndarray, radius: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels (n, 2) of the dots' centres from their ellipses' in normalised coordinates."""
    centre = ellipse
    pose = camera_from_plane(fit_homography(xyz[:, :2], centre))
    for _ in range(ROUNDS):
        pose = refine_planar_pose(pose, xyz[:, :2], centre)
        at = pose @ xyz
        seen = circle_image_offset(at, np.broadcast_to(pose.rotation[:, 2], at.shape), radius)
        centre = ellipse - seen[:, :2] / seen[:, 2:] + at[:, :2] / at[:, 2:]
    return camera.pixel_from_normalised(centre)
