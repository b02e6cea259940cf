"""Views of the board: corners in images, and the board's pose in each image by itself."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, freeze, require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import Minimum, NormalEquations, minimise
from stcal.geometry.plane import camera_from_plane, fit_homography
from stcal.geometry.rigid import Poses, Rigid, by_pose
from stcal.handeye.data.pose_pairs import HandEyePoses

LEAST_CORNERS = 4
SAME_COSINE, APART = 1 - 1e-9, 0.02
"""Limits for corners of one plane: their normals agree to this cosine, and no gap in height exceeds this share of the
view's extent. Only the start of the pose depends on them."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class View(Brief):
    """Corners of the board in one image.

    Parameters
    ----------
    xyz_board : (k, 3), places on the board, mm; k ≥ 4, not all on a line
    xy_px : (k, 2), places in the image, px, with lens distortion
    covariance : (k, 2, 2), covariances of ``xy_px``, px², known up to a common factor. Without it, all corners have
        equal weight.
    normal : (k, 3), unit normals of the planes that the corners lie in, for several boards in one frame. Without it, Z
        for all.
    """

    xyz_board: np.ndarray
    xy_px: np.ndarray
    covariance: np.ndarray | None = None
    normal: np.ndarray | None = None

    def __post_init__(self):
        freeze(self, "xyz_board", (None, 3), "corners on the board")
        k = len(self.xyz_board)
        freeze(self, "xy_px", (k, 2), "corners in the image")
        if self.covariance is not None:
            freeze(self, "covariance", (k, 2, 2), "covariance of corners")
        if self.normal is not None:
            freeze(self, "normal", (k, 3), "normals")

    def __len__(self) -> int:
        return len(self.xyz_board)

    def normals(self) -> np.ndarray:
        """Returns the normals (k, 3) of the planes that the corners lie in."""
        return np.tile([0.0, 0.0, 1.0], (len(self), 1)) if self.normal is None else self.normal

    def moved(self, xyz_board: np.ndarray) -> "View":
        """Returns the same corners at other places on the board."""
        return replace(self, xyz_board=xyz_board)

    def turned(self, turn: Rigid) -> "View":
        """Returns the same corners after a rotation of the board."""
        normal = None if self.normal is None else self.normal @ turn.rotation.T
        return replace(self, xyz_board=turn @ self.xyz_board, normal=normal)

    def whitening(self) -> np.ndarray:
        """Returns matrices (k, 2, 2) that transform the covariance of the errors to the identity."""
        if self.covariance is None:
            return np.tile(np.eye(2), (len(self), 1, 1))
        return np.linalg.inv(np.linalg.cholesky(self.covariance))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Views(Brief):
    """One view for each pose of the flange, all by one camera.

    Parameters
    ----------
    camera : camera that took the views
    views : m views, in the order of the poses
    """

    camera: Camera
    views: tuple[View, ...]

    def __post_init__(self):
        require_fields(self, "views")

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index) -> "Views":
        """Returns the views selected by a mask, slice or list."""
        return Views(self.camera, tuple(self.views[i] for i in np.arange(len(self))[index]))

    def corners(self) -> int:
        """Returns the number of corners in all views."""
        return sum(len(view) for view in self.views)


def resect(views: Views, names: tuple[str, ...]) -> tuple[Poses, np.ndarray]:
    """Returns the pose of the board in each view, of least reprojection error, and the covariances (m, 6, 6). Raises
    DegenerateError naming the view: fewer than four corners in it, or in all its planes, or all on a line."""
    minima = [_pose_of(view, views.camera, name) for view, name in zip(views.views, names, strict=True)]
    redundancy = 2 * views.corners() - 6 * len(views)
    cost = sum(minimum.linear.cost for minimum in minima)
    normals = np.array([minimum.linear.normal for minimum in minima])
    covariance = (cost / redundancy if redundancy else 1.0) * np.linalg.inv(normals)
    return Poses.of([minimum.state for minimum in minima]), covariance


@require_arguments
def pairs_of_views(
    base_from_flange: Poses, views: Views, names: tuple[str, ...] = (), where: str = "views"
) -> HandEyePoses:
    """Returns pose pairs whose poses of the board, with their covariances, come from the corners of each view.

    Parameters
    ----------
    base_from_flange : m poses, mm, as the robot states them
    views : m views, in the same order
    names : name of each pair in messages; ``pose 1`` … where no names are given
    where : source of the views, for messages

    Raises InputError: unequal lengths. Raises DegenerateError: a view in which no pose can be found; the message names
    it.
    """
    if len(views) != len(base_from_flange):
        counts = f"{len(base_from_flange)} poses of the flange and {len(views)} views"
        raise InputError("E-POSES-COUNT", f"{where}: {counts}; pairs needed")
    names = names or tuple(f"pose {i}" for i in range(1, len(views) + 1))
    camera_from_board, covariance = resect(views, names)
    return HandEyePoses(base_from_flange, camera_from_board, None, covariance, names, where)


def whitened(view: View, camera: Camera, camera_from_board: Rigid) -> tuple[np.ndarray, np.ndarray]:
    """Returns residuals (2k,) of a view's corners in σ, and their derivative (2k, 6) by the board's pose."""
    weight = view.whitening()
    rotated = view.xyz_board @ camera_from_board.rotation.T
    xyz = rotated + camera_from_board.translation
    by_point = camera.projection_jacobian(xyz)
    residual = np.einsum("kab,kb->ka", weight, camera.project(xyz) - view.xy_px).ravel()
    return residual, (weight @ by_pose(by_point, rotated)).reshape(-1, 6)


def _pose_of(view: View, camera: Camera, name: str) -> Minimum[Rigid, NormalEquations]:
    if len(view) < LEAST_CORNERS:
        raise DegenerateError("E-VIEW-CORNERS", f"{name}: {len(view)} corners, {LEAST_CORNERS} needed; take it out")
    starts, seen = [], camera.normalised_from_pixel(view.xy_px)
    for rows, board_from_plane in _planes(view):
        xyz = board_from_plane.inverse() @ view.xyz_board[rows]
        with suppress(DegenerateError):
            starts.append(camera_from_plane(fit_homography(xyz[:, :2], seen[rows])) @ board_from_plane.inverse())
    if not starts:
        which = "of each board are fewer than four or " * (view.normal is not None)
        raise DegenerateError("E-VIEW-CORNERS", f"{name}: the corners seen {which}lie on a line; take the image out")

    def linearise(pose: Rigid) -> NormalEquations:
        if ((view.xyz_board @ pose.rotation[2] + pose.translation[2]) <= 0).any():
            return NormalEquations.impossible(6)
        return NormalEquations.of(*whitened(view, camera, pose))

    minima = [minimise(start, linearise, Rigid.moved) for start in starts]
    best = min(minima, key=lambda minimum: (not minimum.converged, minimum.linear.cost))
    return best.required(name, "take the image out")


def _planes(view: View) -> list[tuple[np.ndarray, Rigid]]:
    """Returns the rows of the corners of each plane with enough of them, and board_from_plane, Z the normal."""
    normals, planes = view.normals(), []
    extent = np.linalg.norm(np.ptp(view.xyz_board, axis=0))
    open_rows = np.ones(len(view), bool)
    while open_rows.any():
        normal = normals[open_rows][0]
        alike = np.flatnonzero(open_rows & (normals @ normal > SAME_COSINE))
        open_rows[alike] = False
        height = view.xyz_board[alike] @ normal
        order = np.argsort(height, kind="stable")
        steps = np.flatnonzero(np.diff(height[order]) > APART * extent) + 1
        turn = np.eye(3)
        if normal[2] <= SAME_COSINE:
            x = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
            x /= np.linalg.norm(x)
            turn = np.column_stack([x, np.cross(normal, x), normal])
        for group in np.split(order, steps):
            if len(group) >= LEAST_CORNERS:
                planes.append((np.sort(alike[group]), Rigid(turn, turn @ [0, 0, height[group].mean()])))
    return planes
