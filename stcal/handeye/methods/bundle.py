"""Unknowns and residuals of a hand-eye adjustment from corners, and of an arm that is adjusted too."""

from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import perturbed
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.geometry.robust import huber_cost, huber_weights, length_limit
from stcal.handeye.data.views import project_jacobian
from stcal.handeye.methods.equations import Equations, Part

SETTLED_MM = 1e-3
"""Largest motion of a flange in a round of linear steps, in mm, after which only squares of the motion are
neglected."""
ARM_ROUNDS = 10
PARTS = ("arm_rad", "arm_mm")
"""Groups of σ of the parameters about the arm's file: directions of axes, and places of axes."""


@runtime_checkable
class ArmModel(Protocol):
    """An arm with k parameters, small motions of the axes about the arm's file, and m joint vectors."""

    @property
    def angles(self) -> np.ndarray:
        """Boolean array (k,): True for parameters in rad, False for those in mm."""
        ...

    def poses(self, parameters: np.ndarray) -> Poses:
        """Returns base_from_flange, m poses."""
        ...

    def slope(self, parameters: np.ndarray) -> np.ndarray:
        """Returns the derivative (m, 6, k) of :meth:`poses`, left perturbation, by a small further motion of the axes
        about their places at ``parameters``."""
        ...

    def __getitem__(self, rows: Any) -> "ArmModel":
        """Returns the arm with these joint vectors alone."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LinearArm:
    """An arm linearised about ``parameters`` (k,). ``slope`` : (m, 6, k) derivative of the flange's poses by the
    parameters; ``angles`` : (k,)."""

    parameters: np.ndarray
    slope: np.ndarray
    angles: np.ndarray

    @classmethod
    def about(cls, arm: ArmModel, parameters: np.ndarray) -> "LinearArm":
        """Returns the linearisation of a model."""
        return cls(parameters, arm.slope(parameters), arm.angles)

    def __getitem__(self, rows) -> "LinearArm":
        """Returns the linearisation with these poses alone."""
        return LinearArm(self.parameters, self.slope[rows], self.angles)

    def moved(self, base_from_flange: Poses, step: np.ndarray) -> Poses:
        """Returns the poses (m) of the flange after a step (k,) from the parameters."""
        motion = self.slope @ step
        turn = Rotation.from_rotvec(motion[:, :3]).as_matrix()
        return Poses(turn @ base_from_flange.rotation, base_from_flange.translation + motion[:, 3:])

    def slope_after(self, step: np.ndarray) -> np.ndarray:
        """Returns the derivative (m, 6, k) of :meth:`moved`, left, at a step: rotation vectors do not add."""
        turn = np.einsum("mak,k->ma", self.slope[:, :3], step)
        cross = skew(turn)
        to_left = np.eye(3) + cross / 2 + cross @ cross / 6  # series for rotations of some mrad
        return np.concatenate([to_left @ self.slope[:, :3], self.slope[:, 3:]], axis=1)

    def parts(self) -> dict[str, np.ndarray]:
        """Returns the rows of the parameters in each of :data:`PARTS` that has any."""
        rows_of_part = dict(zip(PARTS, (np.flatnonzero(self.angles), np.flatnonzero(~self.angles)), strict=True))
        return {name: rows for name, rows in rows_of_part.items() if len(rows)}

    def moves_mm(self, step: np.ndarray) -> float:
        """Returns the largest motion of a flange by the step (k,), in mm."""
        return float(np.linalg.norm(self.slope[:, 3:] @ step, axis=1).max())


CORNER, POSE = length_limit(2, 0.001), length_limit(6, 0.001)
"""Huber's limits: one good corner, and one good pose, in a thousand has a weight below one."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The unknowns: X, Z, true base_from_flange (m), corners (K, 3), camera, scale, and a step (k,) of the arm."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: Camera
    scale: float = 1.0
    arm: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def camera_from_board(self, inverted: bool) -> Poses:
        """Returns the poses of the scaled board that follow from the robot's poses."""
        hand = self.base_from_flange if inverted else self.base_from_flange.inverse()
        return self.mount_from_camera.inverse() @ hand @ self.stand_from_board


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """The measurements and their precision: n corners in m views of a board with K corners.

    ``inverted`` : eye-to-hand; ``base_from_flange`` : m, as reported; ``xyz_board`` : (K, 3) as designed; ``view``,
    ``corner`` : (n,) view and corner of each measurement; ``xy_px`` : (n, 2); ``weight`` : (n, 2, 2) whitening at σ 1;
    ``robot`` : (m, 6, 6) whitening in place of σ, or None; ``sigma`` : σ of each group, 0 where exact; ``basis`` : (16,
    q) of the intrinsics solved for; ``information`` : (q, q) of them about ``camera``, to be divided by the squares of
    the factors; ``with_scale``; ``arm`` : the arm whose parameters are solved for and by which ``base_from_flange`` was
    computed, or None.
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
        """Returns the slices of the unknowns in a step; those of what is not solved for are empty."""
        sizes = {"x": 6, "z": 6, "camera": self.basis.shape[1], "scale": int(self.with_scale)}
        sizes["arm"] = 0 if self.arm is None else len(self.arm.parameters)
        exact = self.robot is None and not self.sigma["robot_mm"]
        sizes["robot"] = 0 if exact else 6 * len(self.base_from_flange)
        sizes["board"] = self.xyz_board.size if self.sigma["board_mm"] else 0
        ends = np.cumsum([0, *sizes.values()])
        return {name: slice(int(i), int(j)) for name, i, j in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def camera_parts(self) -> list[tuple[str, np.ndarray]]:
        """Returns :func:`camera_parts` of the intrinsics solved for."""
        return camera_parts(self.basis, self.information)

    def by_arm(self, step: np.ndarray) -> Poses:
        """Returns base_from_flange after a step (k,) of the arm's parameters; as reported without an arm."""
        return self.base_from_flange if self.arm is None else self.arm.moved(self.base_from_flange, step)

    def robot_weight(self) -> np.ndarray:
        """Returns the whitening (m, 6, 6) of errors of base_from_flange."""
        if self.robot is not None:
            return self.robot
        sigma = np.repeat([self.sigma["robot_rad"], self.sigma["robot_mm"]], 3)
        return np.tile(np.diag(1 / sigma), (len(self.base_from_flange), 1, 1))

    def moved(self, state: Bundle, step: np.ndarray) -> Bundle:
        """Returns the state after a step of all unknowns."""
        steps = {name: step[place] for name, place in self.places().items()}
        camera, flange, corners = state.camera, state.base_from_flange, state.corners
        if len(steps["camera"]):
            camera = camera.with_parameters(camera.parameters() + self.basis @ steps["camera"])
        if len(steps["robot"]):
            pose_steps = steps["robot"].reshape(-1, 6)
            turn = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix()
            if self.arm is not None:
                before, after = self.by_arm(state.arm), self.by_arm(state.arm + steps["arm"])
                turn = turn @ flange.rotation @ np.swapaxes(before.rotation, 1, 2) @ after.rotation
                flange = Poses(turn, flange.translation + after.translation - before.translation + pose_steps[:, 3:])
            else:
                flange = Poses(turn @ flange.rotation, flange.translation + pose_steps[:, 3:])
        if len(steps["board"]):
            corners = corners + steps["board"].reshape(-1, 3)
        x, z = perturbed(state.mount_from_camera, steps["x"]), perturbed(state.stand_from_board, steps["z"])
        scale = state.scale + float(steps["scale"].sum())
        return Bundle(x, z, flange, corners, camera, scale, state.arm + steps["arm"])

    def seen(self, state: Bundle) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Returns the white residuals of the corners (n, 2) and their derivatives (n, 2, ·) by each kind of unknown.
        Derivatives by board and robot are those by the measurement's own corner and view."""
        x, z, hand = state.mount_from_camera, state.stand_from_board, state.base_from_flange
        turn, place = hand.rotation[self.view], hand.translation[self.view]
        board = state.corners[self.corner] @ z.rotation.T
        stand = state.scale * board + z.translation
        if self.inverted:  # the flange is the stand, the base is the mount
            mount_from_stand, arm = turn, np.einsum("nab,nb->na", turn, stand)
            mount = arm + place
            by_hand = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), turn.shape)], axis=2)
        else:
            mount_from_stand = np.swapaxes(turn, 1, 2)
            mount = np.einsum("nab,nb->na", mount_from_stand, stand - place)
            by_hand = mount_from_stand @ np.concatenate([skew(stand - place), -np.ones_like(turn) * np.eye(3)], axis=2)
        reach = mount - x.translation
        xyz_camera = reach @ x.rotation
        px, by_point = project_jacobian(state.camera, xyz_camera)
        by_mount = self.weight / self.sigma["corner_px"] @ by_point @ x.rotation.T
        by_stand = by_mount @ mount_from_stand
        by_camera = state.camera.parameter_jacobian(xyz_camera[:, :2] / xyz_camera[:, 2:]) @ self.basis
        derivatives = {
            "x": np.concatenate([by_mount @ skew(reach), -by_mount], axis=2),
            "z": np.concatenate([-by_stand @ skew(state.scale * board), by_stand], axis=2),
            "camera": self.weight / self.sigma["corner_px"] @ by_camera,
            "scale": np.einsum("nab,nb->na", by_stand, board)[:, :, None],
            "board": state.scale * by_stand @ z.rotation,
            "robot": by_mount @ by_hand,
        }
        if self.arm is not None:
            derivatives["arm"] = derivatives["robot"] @ self.arm.slope_after(state.arm)[self.view]
        return np.einsum("nab,nb->na", self.weight, px - self.xy_px) / self.sigma["corner_px"], derivatives

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
            arm=None if self.arm is None else self.arm[keep],
        )

    def with_intrinsics(self, basis: np.ndarray, information: np.ndarray) -> "Corners":
        """Returns the problem with intrinsics about ``camera`` among the unknowns, factors of their prior σ at 1."""
        wider = replace(self, basis=basis, information=information)
        return replace(wider, sigma=wider.sigma | wider.factors())

    def factors(self) -> dict[str, float]:
        """Returns a factor of 1 for each kind of the intrinsics solved for."""
        return dict.fromkeys((name for name, _ in self.camera_parts()), 1.0)

    def kept(self) -> int:
        """Returns the number of unknowns besides the corners of the board, which come last."""
        return self.places()["board"].start

    def parts(self, state: Bundle) -> "dict[str, Part]":
        """Returns all observations by the name of their σ."""
        return {name: part for group in self.groups(state) for name, part in group.parts.items()}

    def linear(self, state: Bundle) -> Equations:
        """Returns cost and normal equations; the cost is infinite where a corner lies behind the camera."""
        if not self.in_front(state):
            return Equations.impossible(self.kept(), self._corners())
        groups = self.groups(state)
        equations = reduce(add, (part.equations for group in groups for part in group.parts.values()))
        return replace(equations, cost=sum(group.cost for group in groups))

    def groups(self, state: Bundle) -> "list[Group]":
        """Returns all observations: the corners seen, the prior knowledge of the intrinsics, the board as designed, the
        robot's poses as reported, and the arm as filed."""
        groups, at = [self._seen_group(state)], self.places()
        if self.basis.shape[1]:
            deviation = np.linalg.pinv(self.basis) @ (state.camera.parameters() - self.camera.parameters())
            for name, rows in self.camera_parts():
                root = np.linalg.cholesky(self.information[rows][:, rows]).T / self.sigma[name]
                groups.append(self._prior(name, root @ deviation[rows], root, at["camera"].start + rows))
        if at["board"].stop > at["board"].start:
            nothing, information = self._nothing(), 1 / self.sigma["board_mm"] ** 2
            deviation = state.corners - self.xyz_board
            cost, k = information * float((deviation**2).sum()), len(deviation)
            block = np.tile(information * np.eye(3), (k, 1, 1))
            own = replace(nothing, cost=cost, block=block, slope=information * deviation)
            groups.append(Group(cost, {"board_mm": Part(3 * k, own)}))
        if at["robot"].stop > at["robot"].start:
            groups.append(self._robot_group(state))
        if self.arm is not None:
            for name, rows in self.arm.parts().items():
                root = np.eye(len(rows)) / self.sigma[name]
                white = root @ (self.arm.parameters + state.arm)[rows]
                groups.append(self._prior(name, white, root, at["arm"].start + rows))
        return groups

    def _corners(self) -> int:
        """Returns the number of corners that are unknowns."""
        return len(self.xyz_board) if self.sigma["board_mm"] else 0

    def _nothing(self) -> Equations:
        """Returns the equations of no observation."""
        s, k = self.kept(), self._corners()
        return Equations(0.0, np.zeros((s, s)), np.zeros(s), np.zeros((k, 3, 3)), np.zeros((k, 3)), None)

    def _prior(self, name: str, white: np.ndarray, root: np.ndarray, places: np.ndarray) -> "Group":
        """Returns the prior knowledge of the kept unknowns at ``places``, with residuals ``white`` and their derivative
        ``root``."""
        own, cost = self._nothing(), float(white @ white)
        own.normal[np.ix_(places, places)] = root.T @ root
        own.gradient[places] = root.T @ white
        return Group(cost, {name: Part(len(white), replace(own, cost=cost))})

    def _robot_group(self, state: Bundle) -> "Group":
        """Returns the robot's poses as observations; rotation and translation have a σ each, or stated covariances."""
        first, weight = self.places()["robot"].start, self.robot_weight()
        white = np.einsum("mab,mb->ma", weight, state.base_from_flange.difference(self.by_arm(state.arm)))
        length = np.linalg.norm(white, axis=1)
        share = huber_weights(length, POSE)
        halves = {"robot_rad": slice(0, 3), "robot_mm": slice(3, 6)} if self.robot is None else {"": slice(0, 6)}
        m, parts = len(white), {}
        columns = first + np.arange(6 * m).reshape(m, 6)
        for name, rows in halves.items():
            own, root = self._nothing(), weight[:, rows]
            pulled = np.swapaxes(root, 1, 2) * share[:, None, None]
            own.normal[columns[:, :, None], columns[:, None]] = pulled @ root
            own.gradient[columns] = np.einsum("mab,mb->ma", pulled, white[:, rows])
            cost = float(share @ (white[:, rows] ** 2).sum(1))
            parts[name] = Part(white[:, rows].size, replace(own, cost=cost))
        return Group(float(huber_cost(length, POSE).sum()), parts)

    def _seen_group(self, state: Bundle) -> "Group":
        """Returns the observations of the corners in the images."""
        white, derivatives = self.seen(state)
        length = np.linalg.norm(white, axis=1)
        root = np.sqrt(huber_weights(length, CORNER))
        at, equations, white = self.places(), self._nothing(), white * root[:, None]
        everywhere = [name for name in ("x", "z", "camera", "scale", "arm") if at[name].stop > at[name].start]
        places = np.concatenate([np.arange(at[name].start, at[name].stop) for name in everywhere])
        by_kept = np.concatenate([derivatives[name] for name in everywhere], axis=2)
        robot = at["robot"].stop > at["robot"].start
        if robot:
            by_kept = np.concatenate([by_kept, derivatives["robot"]], axis=2)
        by_kept *= root[:, None, None]
        by_corner = np.swapaxes(derivatives["board"] * root[:, None, None], 1, 2)
        k = self._corners()
        cross = np.zeros((k, 3, len(equations.gradient))) if k else None
        for rows in np.split(np.arange(len(white)), np.flatnonzero(np.diff(self.view)) + 1):
            view, jacobian = self.view[rows[0]], by_kept[rows].reshape(2 * len(rows), -1)
            columns = np.concatenate([places, at["robot"].start + 6 * view + np.arange(6)]) if robot else places
            equations.normal[np.ix_(columns, columns)] += jacobian.T @ jacobian
            equations.gradient[columns] += jacobian.T @ white[rows].ravel()
            if cross is not None:
                index, mixed = np.ix_(self.corner[rows], np.arange(3), columns), by_corner[rows] @ by_kept[rows]
                if len(set(self.corner[rows].tolist())) == len(rows):  # ten times as fast
                    cross[index] += mixed
                else:
                    np.add.at(cross, index, mixed)
        if k:
            np.add.at(equations.block, self.corner, by_corner @ np.swapaxes(by_corner, 1, 2))
            np.add.at(equations.slope, self.corner, np.einsum("nab,nb->na", by_corner, white))
        cost = float((white**2).sum())
        part = Part(white.size, replace(equations, cost=cost, cross=cross))
        return Group(float(huber_cost(length, CORNER).sum()), {"corner_px": part})

    def in_front(self, state: Bundle) -> bool:
        """True if all corners lie in front of the camera."""
        poses = state.camera_from_board(self.inverted)
        depth = (poses.rotation[self.view, 2] * (state.scale * state.corners[self.corner])).sum(1)
        return bool((depth + poses.translation[self.view, 2] > 0).all())


def camera_parts(basis: np.ndarray, information: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Returns names and rows of the intrinsics with a factor on their prior σ: by kind, or all if they are correlated.
    ``basis`` : (16, q) of the intrinsics; ``information`` : (q, q)."""
    first = basis.argmax(0)
    if np.count_nonzero(information - np.diag(np.diag(information))):
        return [("camera_all", np.arange(len(first)))]
    kinds = {"focal": (0, 1), "centre": (2, 3), "radial": (4, 5, 8, 9, 10, 11), "tangential": (6, 7)}
    parts = [(f"camera_{kind}", np.flatnonzero(np.isin(first, numbers))) for kind, numbers in kinds.items()]
    return [(name, rows) for name, rows in parts if len(rows)]


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Observations of one kind: their ``cost``, Huber's where they are robust, and ``parts`` by the name of their σ."""

    cost: float
    parts: dict[str, Part]
