"""The adjustment of corners behind the reprojection method: unknowns, residuals, normal equations, σ of each group."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.stats import chi2

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.handeye.leastsq import Linear, minimise, perturbed
from stcal.handeye.views import project_jacobian

HUBER_CORNER, HUBER_POSE = (float(np.sqrt(chi2.ppf(0.999, dof))) for dof in (2, 6))
"""One good corner, and one good pose, in a thousand weighs less than one."""
GROUPS = ("corner_px", "robot_rad", "robot_mm", "board_mm")
LEAST = {"corner_px": 1e-6, "robot_rad": 1e-8, "robot_mm": 1e-5, "board_mm": 1e-5}
"""Estimated σ stay above: exact data have none."""
ROUNDS = 100
SETTLED = 1e-3
"""Relative change of σ from round to round that moves nothing any more."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The unknowns: X, Z, base_from_flange as it really was (m), the board's corners (K, 3), camera and scale."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: Camera
    scale: float = 1.0

    def camera_from_board(self, inverted: bool) -> Poses:
        """By the robot's poses, of the scaled board."""
        hand = self.base_from_flange if inverted else self.base_from_flange.inverse()
        return self.mount_from_camera.inverse() @ hand @ self.stand_from_board


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """What was measured and how well, n corners in m views of a board of K.

    ``inverted`` : eye-to-hand; ``base_from_flange`` : m, as reported; ``xyz_board`` : (K, 3) as designed; ``view``,
    ``corner`` : (n,) of each measurement; ``xy_px`` : (n, 2); ``weight`` : (n, 2, 2) whitening at σ 1; ``robot`` :
    (m, 6, 6) whitening in place of σ, or None; ``sigma`` : of each of GROUPS, 0 where exact; ``basis`` : (12, q) of the
    intrinsics solved for, ``information`` : (q, q) about ``camera``; ``with_scale``.
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

    def places(self) -> dict[str, slice]:
        """Where the unknowns stand in a step."""
        at, found = 0, {}
        sizes = {"x": 6, "z": 6, "camera": self.basis.shape[1], "scale": int(self.with_scale)}
        sizes["board"] = self.xyz_board.size if self.sigma["board_mm"] else 0
        exact = self.robot is None and not self.sigma["robot_mm"]
        sizes["robot"] = 0 if exact else 6 * len(self.base_from_flange)
        for name, size in sizes.items():
            found[name] = slice(at, at + size)
            at += size
        return found

    def robot_weight(self) -> np.ndarray:
        """(m, 6, 6) whitening."""
        if self.robot is not None:
            return self.robot
        sigma = np.repeat([self.sigma["robot_rad"], self.sigma["robot_mm"]], 3)
        return np.tile(np.diag(1 / sigma), (len(self.base_from_flange), 1, 1))

    def moved(self, state: Bundle, step: np.ndarray) -> Bundle:
        """By a step of all unknowns."""
        at = self.places()
        camera, flange = state.camera, state.base_from_flange
        if at["camera"].stop > at["camera"].start:
            camera = camera.with_parameters(camera.parameters() + self.basis @ step[at["camera"]])
        if at["robot"].stop > at["robot"].start:
            each = step[at["robot"]].reshape(-1, 6)
            flange = Poses.of(perturbed(p, s) for p, s in zip(flange, each, strict=True))
        corners = state.corners
        if at["board"].stop > at["board"].start:
            corners = corners + step[at["board"]].reshape(-1, 3)
        return Bundle(
            perturbed(state.mount_from_camera, step[at["x"]]),
            perturbed(state.stand_from_board, step[at["z"]]),
            flange,
            corners,
            camera,
            state.scale + float(step[at["scale"]].sum()),
        )

    def residuals(self, state: Bundle) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """White residuals (n, 2), and their derivatives (n, 2, ·) by each kind of unknown: of their view, their corner."""
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
        return np.einsum("nab,nb->na", self.weight, px - self.xy_px) / self.sigma["corner_px"], by

    def slope(self, by: dict[str, np.ndarray]) -> csr_matrix:
        """Derivative (2 n, k) by all unknowns."""
        at, n = self.places(), len(self.view)
        columns, values = [], []
        for name, place in at.items():
            if place.stop == place.start:
                continue
            width = by[name].shape[2]
            own = {"board": self.corner, "robot": self.view}.get(name)
            first = place.start + (np.zeros(n, int) if own is None else width * own)
            columns.append(np.repeat((first[:, None] + np.arange(width))[:, None], 2, axis=1))
            values.append(by[name])
        columns, values = np.concatenate(columns, axis=2), np.concatenate(values, axis=2)
        pointers = np.arange(2 * n + 1) * columns.shape[2]
        shape = (2 * n, max(place.stop for place in at.values()))
        return csr_matrix((values.ravel(), columns.ravel(), pointers), shape=shape)

    def parts(self, state: Bundle) -> dict[str, tuple[float, np.ndarray, np.ndarray]]:
        """Of the corners and of each kind of knowledge beside them: cost, normal matrix and gradient in all unknowns;
        quadratic with Huber's weights of ``state``."""
        at = self.places()
        size = max(place.stop for place in at.values())
        white, by = self.residuals(state)
        weight = _huber(np.linalg.norm(white, axis=1), HUBER_CORNER)
        slope = self.slope(by)
        pulled = slope.multiply(np.repeat(weight, 2)[:, None]).tocsr().T
        found = {"corner_px": (float(weight @ (white**2).sum(1)), (pulled @ slope).toarray(), pulled @ white.ravel())}

        def add(name, place, cost, information, pull):
            normal, gradient = np.zeros((size, size)), np.zeros(size)
            normal[place, place], gradient[place] = information, pull
            found[name] = cost, normal, gradient

        if self.basis.shape[1]:
            off = np.linalg.pinv(self.basis) @ (state.camera.parameters() - self.camera.parameters())
            add("camera", at["camera"], off @ self.information @ off, self.information, self.information @ off)
        if self.sigma["board_mm"]:
            off = (state.corners - self.xyz_board).ravel() / self.sigma["board_mm"]
            add(
                "board_mm",
                at["board"],
                off @ off,
                np.eye(off.size) / self.sigma["board_mm"] ** 2,
                off / self.sigma["board_mm"],
            )
        if at["robot"].stop > at["robot"].start:
            self._add_robot(add, state, at["robot"])
        return found

    def _add_robot(self, add, state: Bundle, place: slice) -> None:
        weight, m = self.robot_weight(), len(self.base_from_flange)
        white = np.einsum("mab,mb->ma", weight, state.base_from_flange.difference(self.base_from_flange))
        soft = np.sqrt(_huber(np.linalg.norm(white, axis=1), HUBER_POSE))[:, None]
        white, weight = white * soft, weight * soft[:, :, None]
        parts = (
            {"robot": slice(0, 6)} if self.robot is not None else {"robot_rad": slice(0, 3), "robot_mm": slice(3, 6)}
        )
        for name, rows in parts.items():
            information = np.zeros((6 * m, 6 * m))
            for i, w in enumerate(weight[:, rows]):
                information[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = w.T @ w
            pull = np.einsum("mab,ma->mb", weight[:, rows], white[:, rows]).ravel()
            add(name, place, float((white[:, rows] ** 2).sum()), information, pull)

    def linear(self, state: Bundle) -> Linear:
        """Cost and normal equations."""
        depth = state.camera_from_board(self.inverted)
        reach = depth.rotation[self.view, 2] * (state.scale * state.corners[self.corner])
        size = max(place.stop for place in self.places().values())
        if (reach.sum(1) + depth.translation[self.view, 2] <= 0).any():
            return Linear(np.inf, np.eye(size), np.zeros(size))
        parts = self.parts(state).values()
        return Linear(self.cost(state), sum(p[1] for p in parts), sum(p[2] for p in parts))

    def cost(self, state: Bundle) -> float:
        """Huber's, of corners and poses; squares of the rest."""
        white, _ = self.residuals(state)
        found = _huber_cost(np.linalg.norm(white, axis=1), HUBER_CORNER)
        at = self.places()
        if self.basis.shape[1]:
            off = np.linalg.pinv(self.basis) @ (state.camera.parameters() - self.camera.parameters())
            found += off @ self.information @ off
        if self.sigma["board_mm"]:
            found += float(((state.corners - self.xyz_board) ** 2).sum()) / self.sigma["board_mm"] ** 2
        if at["robot"].stop > at["robot"].start:
            off = np.einsum("mab,mb->ma", self.robot_weight(), state.base_from_flange.difference(self.base_from_flange))
            found += _huber_cost(np.linalg.norm(off, axis=1), HUBER_POSE)
        return float(found)


def _huber(length: np.ndarray, limit: float) -> np.ndarray:
    return np.minimum(1, limit / np.maximum(length, 1e-300))


def _huber_cost(length: np.ndarray, limit: float) -> float:
    inside = np.minimum(length, limit)
    return float((inside**2 + 2 * limit * (length - inside)).sum())


def adjust(corners: Corners, start: Bundle, free: tuple[str, ...]) -> tuple[Corners, Bundle, np.ndarray]:
    """Solve, and estimate the σ of the ``free`` groups: each is its squared residuals over its share of the redundancy
    (Helmert's variance components in their simplified form; Förstner 1979). Returns the corners with these σ, the
    state, and the normal matrix."""
    state = start
    for _ in range(ROUNDS):
        state, last = minimise(state, corners.linear, corners.moved, "hand-eye")
        if not free:
            break
        parts = corners.parts(state)
        inverse = np.linalg.inv(last.normal)
        sizes = {
            "corner_px": 2 * len(corners.view),
            "board_mm": corners.xyz_board.size,
            "robot_rad": 3 * len(corners.base_from_flange),
            "robot_mm": 3 * len(corners.base_from_flange),
        }
        sigma = dict(corners.sigma)
        for name in free:
            cost, normal, _ = parts[name]
            redundancy = sizes[name] - float((inverse * normal).sum())
            sigma[name] = max(sigma[name] * np.sqrt(cost / max(redundancy, 1e-9)), LEAST[name])
        change = max(abs(np.log(sigma[name] / corners.sigma[name])) for name in free)
        corners = replace(corners, sigma=sigma)
        if change < SETTLED:
            break
    return corners, state, minimise(state, corners.linear, corners.moved, "hand-eye")[1].normal
