"""Coverage by the poses: the image by the board, and rotations by the flange; and errors of corners by the robot."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from stcal.geometry.arrays import frozen
from stcal.handeye.data.loop import Loop
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import Views
from stcal.handeye.result import HandEye

CELLS = 60
"""Number of cells along the longer side of the image, in which views of the board are counted."""
MOST_TURNS = 1000
"""Largest number of pairs of poses whose turn is drawn; of more pairs, a random sample."""
LEAST_TURN = np.radians(2)
"""Smallest turn whose axis is drawn, in rad; the axes of smaller turns are noise."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageCoverage:
    """Coverage of the image by the board.

    ``counts`` : (rows, columns) number of photographs in which the board covers a cell; ``share`` : share of the cells
    that the board covers at least once.
    """

    counts: np.ndarray
    share: float

    def __post_init__(self):
        object.__setattr__(self, "counts", frozen(self.counts, (None, None), "counts", int))


def image_coverage(views: Views) -> ImageCoverage:
    """Returns the coverage of the image by the convex hulls of each view's corners."""
    width, height = views.camera.width, views.camera.height
    cell = max(width, height) / CELLS
    columns, rows = max(1, round(width / cell)), max(1, round(height / cell))
    # Pixel centres are integers: the image reaches from -0.5 on.
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    middle = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    counts = np.zeros(len(middle), int)
    for view in views.views:
        try:
            sides = ConvexHull(view.xy_px).equations
        except QhullError:  # all corners on a line
            continue
        counts += (middle @ sides[:, :2].T + sides[:, 2] <= 0).all(1)
    return ImageCoverage(counts.reshape(rows, columns), float((counts > 0).mean()))


def turns_between(pairs: HandEyePoses) -> np.ndarray:
    """Returns rotation vectors (n, 3) of the flange between poses, in its axes, rad.

    A turn and its inverse count as one, with Z ≥ 0.
    """
    rotation = pairs.base_from_flange.rotation
    i, j = np.triu_indices(len(rotation), 1)
    if len(i) > MOST_TURNS:
        sample = np.random.default_rng(0).choice(len(i), MOST_TURNS, replace=False)
        i, j = i[sample], j[sample]
    turn = Rotation.from_matrix(np.swapaxes(rotation[j], 1, 2) @ rotation[i]).as_rotvec()
    return np.where(turn[:, 2:] < 0, -turn, turn)


def equal_area(directions: np.ndarray) -> np.ndarray:
    """Projects unit vectors with Z ≥ 0 by Lambert's azimuthal projection, (n, 2), onto a disc of radius 1."""
    return directions[:, :2] / np.sqrt(1 + np.abs(directions[:, 2:]))


def by_robot(result: HandEye, pairs: HandEyePoses, views: Views) -> list[np.ndarray]:
    """Predicts the corners of each view from the robot's reported pose and the transforms, (k, 2) px.

    Corners behind the camera are NaN.
    """
    loop, board = Loop.of(pairs, result.setup), result.reprojection
    camera = views.camera if board is None else board.camera
    predicted = []
    poses = result.mount_from_camera.inverse() @ loop.stand_from_mount.inverse() @ result.stand_from_board
    for view, pose in zip(views.views, poses, strict=True):
        xyz = pose @ (result.scale * view.xyz_board if board is None else board.board(view.xyz_board))
        in_front = xyz[:, 2] > 0
        px = np.full((len(xyz), 2), np.nan)
        px[in_front] = camera.project(xyz[in_front])
        predicted.append(px)
    return predicted


def rms_px(predicted: np.ndarray, seen: np.ndarray) -> float:
    """Returns the RMS distance over all corners that could be predicted, or infinity if none could."""
    squared = ((predicted - seen) ** 2).sum(1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.any() else float("inf")
