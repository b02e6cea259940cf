"""What the poses covered: the image by the board, rotations by the flange, and how corners by the robot miss."""

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
"""Along the longer side of the image, in which is counted where the board was."""
MOST_TURNS = 1000
"""Pairs of poses of which the turn is drawn, some of all at random."""
LEAST_TURN = np.radians(2)
"""Below it the axis of a turn is noise."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageCoverage:
    """``counts`` : (rows, columns), in how many photographs the board lay over each cell of the image; ``share`` of the
    cells over which it ever lay."""

    counts: np.ndarray
    share: float

    def __post_init__(self):
        object.__setattr__(self, "counts", frozen(self.counts, (None, None), "counts", int))


def image_coverage(views: Views) -> ImageCoverage:
    """Over the hulls of the corners of each view."""
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
            side = ConvexHull(view.xy_px).equations
        except QhullError:  # all on a line
            continue
        counts += (middle @ side[:, :2].T + side[:, 2] <= 0).all(1)
    return ImageCoverage(counts.reshape(rows, columns), float((counts > 0).mean()))


def turns_between(pairs: HandEyePoses) -> np.ndarray:
    """(n, 3) rotation vectors of the flange between poses, its axes, rad; Z ≥ 0, as a turn and its inverse are one."""
    rotation = pairs.base_from_flange.rotation
    i, j = np.triu_indices(len(rotation), 1)
    if len(i) > MOST_TURNS:
        some = np.random.default_rng(0).choice(len(i), MOST_TURNS, replace=False)
        i, j = i[some], j[some]
    turn = Rotation.from_matrix(np.swapaxes(rotation[j], 1, 2) @ rotation[i]).as_rotvec()
    return np.where(turn[:, 2:] < 0, -turn, turn)


def equal_area(directions: np.ndarray) -> np.ndarray:
    """(n, 2): unit vectors with Z ≥ 0 in Lambert's azimuthal projection, the half sphere a disc of radius 1."""
    return directions[:, :2] / np.sqrt(1 + np.abs(directions[:, 2:]))


def by_robot(result: HandEye, pairs: HandEyePoses, views: Views) -> list[np.ndarray]:
    """(k, 2) px for each view: where its corners would be, by the robot's pose as reported and the transforms; NaN
    where that is behind the camera."""
    loop, board = Loop.of(pairs, result.setup), result.reprojection
    camera = views.camera if board is None else board.camera
    found = []
    poses = result.mount_from_camera.inverse() @ loop.stand_from_mount.inverse() @ result.stand_from_board
    for view, pose in zip(views.views, poses, strict=True):
        xyz = pose @ (result.scale * view.xyz_board if board is None else board.board(view.xyz_board))
        before = xyz[:, 2] > 0
        px = np.full((len(xyz), 2), np.nan)
        px[before] = camera.project(xyz[before])
        found.append(px)
    return found


def rms_px(predicted: np.ndarray, seen: np.ndarray) -> float:
    """RMS distance of those that could be predicted; infinite where none could."""
    squared = ((predicted - seen) ** 2).sum(1)
    known = np.isfinite(squared)
    return float(np.sqrt(squared[known].mean())) if known.any() else float("inf")
