"""Unknowns and residuals of a hand-eye adjustment from corners."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.adjust.blocks import Block, Huber, Vector
from stcal.adjust.engine import Adjustment
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.geometry.robust import length_limit

CORNER, POSE = length_limit(2, 0.001), length_limit(6, 0.001)
"""Huber's limits: one good corner, and one good pose, in a thousand has a weight below one."""
ROBOT = ("robot_rad", "robot_mm")
"""Kinds of the robot's errors: of its rotations and of its translations."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The unknowns: X, Z, true base_from_flange (m), corners (K, 3), camera, and scale."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: Camera
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """The measurements and their precision: n corners in m views of a board with K corners.

    ``inverted`` : eye-to-hand; ``base_from_flange`` : m, as reported; ``xyz_board`` : (K, 3) as designed; ``view``,
    ``corner`` : (n,) view and corner of each measurement; ``xy_px`` : (n, 2); ``weight`` : (n, 2, 2) whitening at σ 1;
    ``robot`` : (m, 6, 6) whitening in place of σ, or None; ``sigma`` : σ of each kind, 0 where exact; ``basis`` : (16,
    q) of the intrinsics solved for; ``information`` : (q, q) of them about ``camera``, to be divided by the squares of
    the factors; ``with_scale``.
    """

    inverted: bool
    base_from_flange: Poses
    xyz_board: np.ndarray
    view: np.ndarray
    corner: np.ndarray
    xy_px: np.ndarray
    weight: np.ndarray
    robot: np.ndarray | None
    sigma: dict[str, float]
    camera: Camera
    basis: np.ndarray
    information: np.ndarray
    with_scale: bool

    def problem(self) -> Adjustment:
        """Returns the adjustment: X, Z, the scale, and what else has a σ."""
        a, one = Adjustment(sigma=dict(self.sigma)), Poses.of([Rigid()])
        on: list[tuple[Block, np.ndarray | None]] = [(a.block("x", one), None), (a.block("z", one), None)]
        on.append((a.block("scale", Vector(np.ones((1, 1))), fixed=[] if self.with_scale else [0]), None))
        if self.basis.shape[1]:
            on.append((a.block("camera", Vector(np.zeros((1, self.basis.shape[1])))), None))
            for name, rows in camera_parts(self.basis, self.information):
                root = np.linalg.cholesky(self.information[np.ix_(rows, rows)]).T
                a.factor(_linear(root, rows), on[-1:], kind=name)
        m = len(self.base_from_flange)
        if self.robot is not None or self.sigma["robot_mm"]:
            on.append((a.block("robot", Poses.of([Rigid()] * m)), self.view))
            by_itself, kinds = np.tile(np.eye(6), (m, 1, 1)), np.repeat(ROBOT, 3).tolist() if self.robot is None else ""
            root, off = by_itself if self.robot is None else self.robot, [(on[-1][0], np.arange(m))]
            a.factor(errors, off, derivatives=lambda robot: [by_itself], root=root, kind=kinds, loss=Huber(POSE))
        if self.sigma["board_mm"]:
            board = a.block("board", Vector(self.xyz_board), eliminate=True)
            on.append((board, self.corner))
            every, apart = np.arange(len(self.xyz_board)), np.tile(np.eye(3), (len(self.xyz_board), 1, 1))
            a.factor(
                lambda own: own.array - self.xyz_board, [(board, every)], 1.0, lambda own: [apart], kind="board_mm"
            )
        names = [block.name for block, _ in on]

        def residuals(*own: Any) -> np.ndarray:
            return self.residuals(self.bundle(dict(zip(names, own, strict=True))))

        def slopes(*own: Any) -> list[np.ndarray]:
            by = self.slopes(self.bundle(dict(zip(names, own, strict=True))))
            return [by[name] for name in names]

        a.factor(residuals, on, derivatives=slopes, root=self.weight, kind="corner_px", loss=Huber(CORNER))
        return a

    def start(self, x: Rigid, z: Rigid, scale: float) -> dict[str, Any]:
        """Returns the values of the unknowns at the start."""
        given = {"x": Poses.of([x]), "z": Poses.of([z]), "scale": Vector(np.full((1, 1), scale))}
        return {block.name: block.start for block in self.problem().blocks} | given

    def bundle(self, values: Mapping[str, Any]) -> Bundle:
        """Returns the unknowns, those that are not solved for included."""
        flange, camera = self.base_from_flange, self.camera
        if "robot" in values:
            off = values["robot"]
            flange = Poses(off.rotation @ flange.rotation, off.translation + flange.translation)
        if "camera" in values:
            camera = camera.with_parameters(camera.parameters() + self.basis @ values["camera"].array[0])
        corners = values["board"].array if "board" in values else self.xyz_board
        x, z = values["x"][0], values["z"][0]
        return Bundle(x, z, flange, corners, camera, float(values["scale"].array[0, 0]))

    def _placed(self, state: Bundle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns of each measured corner its place (n, 3) in the frames of the stand, the mount and the camera."""
        x, z, hand = state.mount_from_camera, state.stand_from_board, state.base_from_flange
        hand = hand if self.inverted else hand.inverse()
        stand = state.scale * state.corners[self.corner] @ z.rotation.T + z.translation
        mount = np.einsum("nab,nb->na", hand.rotation[self.view], stand) + hand.translation[self.view]
        return stand, mount, (mount - x.translation) @ x.rotation

    def residuals(self, state: Bundle) -> np.ndarray:
        """Returns projected minus measured corners (n, 2), px; NaN behind the camera."""
        return state.camera.project(self._placed(state)[2]) - self.xy_px

    def slopes(self, state: Bundle) -> dict[str, np.ndarray]:
        """Returns the derivatives (n, 2, ·) of :meth:`residuals` by each kind of unknown."""
        x, z, hand = state.mount_from_camera, state.stand_from_board, state.base_from_flange
        stand, mount, xyz_camera = self._placed(state)
        turn, place = hand.rotation[self.view], hand.translation[self.view]
        if self.inverted:  # the flange is the stand, the base is the mount
            mount_from_stand = turn
            by_hand = np.concatenate([-skew(mount - place), np.broadcast_to(np.eye(3), turn.shape)], axis=2)
        else:
            mount_from_stand = np.swapaxes(turn, 1, 2)
            by_hand = np.concatenate([mount_from_stand @ skew(stand - place), -mount_from_stand], axis=2)
        by_mount = state.camera.projection_jacobian(xyz_camera) @ x.rotation.T
        by_stand = by_mount @ mount_from_stand
        of_board = stand - z.translation
        return {
            "x": np.concatenate([by_mount @ skew(mount - x.translation), -by_mount], axis=2),
            "z": np.concatenate([-by_stand @ skew(of_board), by_stand], axis=2),
            "camera": state.camera.parameter_jacobian(xyz_camera[:, :2] / xyz_camera[:, 2:]) @ self.basis,
            "scale": np.einsum("nab,nb->na", by_stand, of_board / state.scale)[:, :, None],
            "board": state.scale * by_stand @ z.rotation,
            "robot": by_mount @ by_hand,
        }

    def only(self, keep: np.ndarray) -> "Corners":
        """Returns the problem of the poses ``keep``, a mask (m,)."""
        rows = np.flatnonzero(keep[self.view])
        return replace(
            self,
            base_from_flange=self.base_from_flange[keep],
            view=(np.cumsum(keep) - 1)[self.view[rows]],
            corner=self.corner[rows],
            xy_px=self.xy_px[rows],
            weight=self.weight[rows],
            robot=None if self.robot is None else self.robot[keep],
        )

    def with_intrinsics(self, basis: np.ndarray, information: np.ndarray) -> "Corners":
        """Returns the problem with intrinsics about ``camera`` among the unknowns, factors of their prior σ at 1."""
        wider = replace(self, basis=basis, information=information)
        return replace(wider, sigma=wider.sigma | wider.factors())

    def factors(self) -> dict[str, float]:
        """Returns a factor of 1 for each kind of the intrinsics solved for."""
        return dict.fromkeys((name for name, _ in camera_parts(self.basis, self.information)), 1.0)


def errors(robot: Poses) -> np.ndarray:
    """Returns what poses of a robot err (m, 6): rotation vectors, rad, and translations, mm."""
    return np.hstack([Rotation.from_matrix(robot.rotation).as_rotvec(), robot.translation])


def _linear(root: np.ndarray, rows: np.ndarray, about: np.ndarray | float = 0.0) -> Callable[[Vector], np.ndarray]:
    """Returns a function that gives ``root`` times the numbers ``rows`` of a single member and ``about``, as a row."""
    return lambda own: ((own.array[0, rows] + about) @ root.T)[None]


def camera_parts(basis: np.ndarray, information: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Returns names and rows of the intrinsics with a factor on their prior σ: by kind, or all if they are correlated.
    ``basis`` : (16, q) of the intrinsics; ``information`` : (q, q)."""
    first = basis.argmax(0)
    if np.count_nonzero(information - np.diag(np.diag(information))):
        return [("camera_all", np.arange(len(first)))]
    kinds = {"focal": (0, 1), "centre": (2, 3), "radial": (4, 5, 8, 9, 10, 11), "tangential": (6, 7)}
    parts = [(f"camera_{kind}", np.flatnonzero(np.isin(first, numbers))) for kind, numbers in kinds.items()]
    return [(name, rows) for name, rows in parts if len(rows)]
