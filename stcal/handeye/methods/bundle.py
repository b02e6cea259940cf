"""The adjustment of corners behind the reprojection method: unknowns, residuals, and what is known of each."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import NormalEquations, perturbed
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.geometry.robust import length_limit
from stcal.handeye.data.views import project_jacobian
from stcal.handeye.methods.arm import LinearArm
from stcal.handeye.methods.rounds import Knowledge

CORNER, POSE = length_limit(2, 0.001), length_limit(6, 0.001)
"""Huber's limits: one good corner, and one good pose, in a thousand weighs less than one."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The unknowns: X, Z, base_from_flange as it really was (m), the board's corners (K, 3), camera, scale, and a step
    of the arm's parameters (k,)."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: Camera
    scale: float = 1.0
    arm: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def camera_from_board(self, inverted: bool) -> Poses:
        """By the robot's poses, of the scaled board."""
        hand = self.base_from_flange if inverted else self.base_from_flange.inverse()
        return self.mount_from_camera.inverse() @ hand @ self.stand_from_board


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """What was measured and how well, n corners in m views of a board of K.

    ``inverted`` : eye-to-hand; ``base_from_flange`` : m, as reported; ``xyz_board`` : (K, 3) as designed; ``view``,
    ``corner`` : (n,) of each measurement; ``xy_px`` : (n, 2); ``weight`` : (n, 2, 2) whitening at σ 1; ``robot`` :
    (m, 6, 6) whitening in place of σ, or None; ``sigma`` : of each group, 0 where exact; ``basis`` : (16, q) of the
    intrinsics solved for, ``information`` : (q, q) about ``camera``, over the square of factors;
    ``with_scale``; ``arm`` : whose parameters are solved for, by which ``base_from_flange`` was computed, or None.
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
    arm: LinearArm | None = None

    def places(self) -> dict[str, slice]:
        """Where the unknowns stand in a step; empty for what is not solved for."""
        sizes = {"x": 6, "z": 6, "camera": self.basis.shape[1], "scale": int(self.with_scale)}
        sizes["arm"] = 0 if self.arm is None else len(self.arm.parameters)
        sizes["board"] = self.xyz_board.size if self.sigma["board_mm"] else 0
        exact = self.robot is None and not self.sigma["robot_mm"]
        sizes["robot"] = 0 if exact else 6 * len(self.base_from_flange)
        ends = np.cumsum([0, *sizes.values()])
        return {name: slice(int(i), int(j)) for name, i, j in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def camera_parts(self) -> list[tuple[str, np.ndarray]]:
        """As :func:`camera_parts`, of the intrinsics solved for."""
        return camera_parts(self.basis, self.information)

    def no_step(self) -> np.ndarray:
        """(k,) zeros for the arm's parameters."""
        return np.zeros(0 if self.arm is None else len(self.arm.parameters))

    def by_arm(self, step: np.ndarray) -> Poses:
        """base_from_flange after a step (k,) of the arm's parameters; as reported without an arm."""
        return self.base_from_flange if self.arm is None else self.arm.moved(self.base_from_flange, step)

    def count(self) -> int:
        """Number of unknowns."""
        return max(place.stop for place in self.places().values())

    def robot_weight(self) -> np.ndarray:
        """(m, 6, 6) whitening of errors of base_from_flange."""
        if self.robot is not None:
            return self.robot
        sigma = np.repeat([self.sigma["robot_rad"], self.sigma["robot_mm"]], 3)
        return np.tile(np.diag(1 / sigma), (len(self.base_from_flange), 1, 1))

    def moved(self, state: Bundle, step: np.ndarray) -> Bundle:
        """By a step of all unknowns."""
        part = {name: step[place] for name, place in self.places().items()}
        camera, flange, corners = state.camera, state.base_from_flange, state.corners
        if len(part["camera"]):
            camera = camera.with_parameters(camera.parameters() + self.basis @ part["camera"])
        if len(part["robot"]):
            each = part["robot"].reshape(-1, 6)
            turn = Rotation.from_rotvec(each[:, :3]).as_matrix()
            if self.arm is not None:
                before, after = self.by_arm(state.arm), self.by_arm(state.arm + part["arm"])
                turn = turn @ flange.rotation @ np.swapaxes(before.rotation, 1, 2) @ after.rotation
                flange = Poses(turn, flange.translation + after.translation - before.translation + each[:, 3:])
            else:
                flange = Poses(turn @ flange.rotation, flange.translation + each[:, 3:])
        if len(part["board"]):
            corners = corners + part["board"].reshape(-1, 3)
        x, z = perturbed(state.mount_from_camera, part["x"]), perturbed(state.stand_from_board, part["z"])
        scale = state.scale + float(part["scale"].sum())
        return Bundle(x, z, flange, corners, camera, scale, state.arm + part["arm"])

    def seen(self, state: Bundle) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """White residuals of the corners (n, 2), and their derivatives (n, 2, ·) by each kind of unknown, of the own
        view and corner."""
        x, z, hand = state.mount_from_camera, state.stand_from_board, state.base_from_flange
        turn, place = hand.rotation[self.view], hand.translation[self.view]
        board = state.corners[self.corner] @ z.rotation.T
        stand = state.scale * board + z.translation
        if self.inverted:  # the flange is the stand, the base the mount
            mount_from_stand, arm = turn, np.einsum("nab,nb->na", turn, stand)
            mount = arm + place
            by_hand = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), turn.shape)], axis=2)
        else:
            mount_from_stand = np.swapaxes(turn, 1, 2)
            mount = np.einsum("nab,nb->na", mount_from_stand, stand - place)
            by_hand = mount_from_stand @ np.concatenate([skew(stand - place), -np.ones_like(turn) * np.eye(3)], axis=2)
        reach = mount - x.translation
        seen = reach @ x.rotation
        px, by_point = project_jacobian(state.camera, seen)
        by_mount = self.weight / self.sigma["corner_px"] @ by_point @ x.rotation.T
        by_stand = by_mount @ mount_from_stand
        by_camera = state.camera.parameter_jacobian(seen[:, :2] / seen[:, 2:]) @ self.basis
        by = {
            "x": np.concatenate([by_mount @ skew(reach), -by_mount], axis=2),
            "z": np.concatenate([-by_stand @ skew(state.scale * board), by_stand], axis=2),
            "camera": self.weight / self.sigma["corner_px"] @ by_camera,
            "scale": np.einsum("nab,nb->na", by_stand, board)[:, :, None],
            "board": state.scale * by_stand @ z.rotation,
            "robot": by_mount @ by_hand,
        }
        if self.arm is not None:
            by["arm"] = by["robot"] @ self.arm.slope_after(state.arm)[self.view]
        return np.einsum("nab,nb->na", self.weight, px - self.xy_px) / self.sigma["corner_px"], by

    def with_sigma(self, sigma: dict[str, float]) -> "Corners":
        """With other σ."""
        return replace(self, sigma=sigma)

    def with_board_scale(self) -> "Corners":
        """With the board's scale among the unknowns."""
        return replace(self, with_scale=True)

    def with_intrinsics(self, basis: np.ndarray, information: np.ndarray) -> "Corners":
        """With intrinsics among the unknowns, about ``camera``; factors of what is known of them are 1."""
        wider = replace(self, basis=basis, information=information)
        return replace(wider, sigma=wider.sigma | wider.factors())

    def factors(self) -> dict[str, float]:
        """1 for each kind of the intrinsics solved for."""
        return dict.fromkeys((name for name, _ in self.camera_parts()), 1.0)

    def groups(self, state: Bundle) -> list[Knowledge]:
        """Everything that is known: the corners seen, and what was known before."""
        return [*self.own_groups(state), *self.shared_groups(state)]

    def own_groups(self, state: Bundle) -> list[Knowledge]:
        """Of this camera: the corners seen, and what was known of its intrinsics."""
        at, count = self.places(), self.count()
        white, by = self.seen(state)
        found = [
            Knowledge(("corner_px",), white, _sparse(by, at, count, {"board": self.corner, "robot": self.view}), CORNER)
        ]
        if self.basis.shape[1]:
            off = np.linalg.pinv(self.basis) @ (state.camera.parameters() - self.camera.parameters())
            for name, rows in self.camera_parts():
                root = np.linalg.cholesky(self.information[rows][:, rows]).T / self.sigma[name]
                whole = np.zeros((len(rows), len(off)))
                whole[:, rows] = root
                jacobian = _sparse({"camera": whole[None]}, at, count, {})
                found.append(Knowledge((name,), (whole @ off)[None], jacobian, np.inf))
        return found

    def shared_groups(self, state: Bundle) -> list[Knowledge]:
        """Of what all cameras see: the board as designed, and the robot's poses as reported."""
        at, count, found = self.places(), self.count(), []
        if at["board"].stop > at["board"].start:
            off = (state.corners - self.xyz_board) / self.sigma["board_mm"]
            jacobian = np.tile(np.eye(3) / self.sigma["board_mm"], (len(off), 1, 1))
            jacobian = _sparse({"board": jacobian}, at, count, {"board": np.arange(len(off))})
            found.append(Knowledge(("board_mm",), off, jacobian, np.inf))
        if at["robot"].stop > at["robot"].start:
            weight = self.robot_weight()
            off = np.einsum("mab,mb->ma", weight, state.base_from_flange.difference(self.by_arm(state.arm)))
            jacobian = _sparse({"robot": weight}, at, count, {"robot": np.arange(len(off))})
            names = ("robot_rad", "robot_mm") if self.robot is None else ()
            found.append(Knowledge(names, off, jacobian, POSE))
        if self.arm is not None:
            for name, rows in self.arm.parts().items():
                root = np.eye(len(state.arm))[rows] / self.sigma[name]
                off = (root @ (self.arm.parameters + state.arm))[None]
                found.append(Knowledge((name,), off, _sparse({"arm": root[None]}, at, count, {}), np.inf))
        return found

    def linear(self, state: Bundle) -> NormalEquations:
        """Cost and normal equations; infinite cost where a corner lies behind the camera."""
        if not self.in_front(state):
            return NormalEquations.impossible(self.count())
        first, *others = (group.linear() for group in self.groups(state))
        return sum(others, first)

    def in_front(self, state: Bundle) -> bool:
        """Whether all corners lie before the camera."""
        poses = state.camera_from_board(self.inverted)
        depth = (poses.rotation[self.view, 2] * (state.scale * state.corners[self.corner])).sum(1)
        return bool((depth + poses.translation[self.view, 2] > 0).all())


def camera_parts(basis: np.ndarray, information: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Intrinsics whose knowledge may be wrong by a factor of its own: kinds, or all where they are correlated.

    ``basis`` : (16, q) of the intrinsics; ``information`` : (q, q) about them.
    """
    first = basis.argmax(0)
    if np.count_nonzero(information - np.diag(np.diag(information))):
        return [("camera_all", np.arange(len(first)))]
    kinds = {"focal": (0, 1), "centre": (2, 3), "radial": (4, 5, 8, 9, 10, 11), "tangential": (6, 7)}
    parts = [(f"camera_{kind}", np.flatnonzero(np.isin(first, numbers))) for kind, numbers in kinds.items()]
    return [(name, rows) for name, rows in parts if len(rows)]


def _sparse(by: dict, at: dict[str, slice], count: int, own: dict[str, np.ndarray]) -> csr_matrix:
    """Derivatives by kind of unknown, (g, d, ·) each, as (g d, count); ``own`` : (g,) which block, of kinds of many."""
    columns, values = [], []
    for name, value in by.items():
        if at[name].stop > at[name].start:
            first = at[name].start + value.shape[2] * own.get(name, np.zeros(len(value), int))
            place = first[:, None, None] + np.arange(value.shape[2])
            columns.append(np.broadcast_to(place, value.shape))
            values.append(value)
    columns, values = np.concatenate(columns, axis=2), np.concatenate(values, axis=2)
    rows, width = values.shape[0] * values.shape[1], values.shape[2]
    return csr_matrix((values.ravel(), columns.ravel(), np.arange(rows + 1) * width), shape=(rows, count))
