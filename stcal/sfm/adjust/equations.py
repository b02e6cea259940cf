"""The joint adjustment as blocks and factors: all groups share circles, common shape of the board, and intrinsics; each
has poses of its cameras, dots, and a pose of its board of its own."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from stcal.adjust.blocks import Block, Huber, Known, Vector
from stcal.adjust.engine import Adjustment, Joined
from stcal.design import BoardDesign, faces_of_known_shape, known_distances
from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import free_motions, generalised_inverse
from stcal.geometry.plane import fit_plane
from stcal.geometry.print_modes import AMPLITUDES, PrintModes, Told
from stcal.geometry.rigid import Poses, Rigid, align_rigid, skew
from stcal.geometry.robust import huber_cost, huber_weights
from stcal.labels import CircleLabel
from stcal.sfm.adjust.refine import known_points, placed, projection_jacobians, reproject
from stcal.sfm.data.group_model import GroupModel, MetricModel, rows_by

CIRCLES, DOTS, BOARD, SHAPE, CAMERA, POSES = "circles", "dots", "board", "shape", "camera", "poses"
"""Names of blocks; those of a group end with its name. The first three are kinds of rows, too."""
SHARED = CIRCLES, CAMERA, SHAPE  # blocks that all groups share, the last if the board keeps its shape
FREE_DIRECTIONS = 6  # number of free directions: a rigid motion of the world changes nothing


def normalised(model: GroupModel, camera: Camera) -> np.ndarray:
    """Returns the residuals over σ, (n, 2)."""
    return model.whiten(model.residuals_px(camera))


def image_cost(model: GroupModel, camera: Camera, huber: float) -> float:
    """Returns squared residuals over σ², Huber's cost beyond ``huber``; infinite for a point behind a camera."""
    if (model.xyz_camera()[:, 2] <= 0).any():
        return np.inf
    return float(huber_cost(np.linalg.norm(normalised(model, camera), axis=1), huber).sum())


def robust_weights(model: GroupModel, camera: Camera, huber: float) -> np.ndarray:
    """Returns Huber's weights, (n,), for the lengths of the residuals over σ."""
    return huber_weights(np.linalg.norm(normalised(model, camera), axis=1), huber)


@dataclass(frozen=True, slots=True, eq=False)
class RowsOfView:
    """Whitened derivatives of one image by points and intrinsics, of which its pose takes six directions."""

    rows: csr_array  # (2n, 3p + q)
    pose: np.ndarray  # (2n, 6) orthonormal

    @classmethod
    def of(cls, model: GroupModel, camera: Camera, basis: np.ndarray, root: np.ndarray | None = None) -> "RowsOfView":
        """Returns the rows of a model of one image; ``root``: (2n,) of robust weights."""
        by_pose, by_point = projection_jacobians(model, camera)
        n, p = len(model.point_index), 3 * len(model.labels)
        weight = (np.ones(2 * n) if root is None else root).reshape(n, 2, 1)
        by_point, lens, by_pose = (
            weight * model.whiten(each) for each in (by_point, model.by_parameters(camera) @ basis, by_pose)
        )
        columns = np.concatenate(
            [3 * model.point_index[:, None] + np.arange(3), np.tile(p + np.arange(basis.shape[1]), (n, 1))], axis=1
        )
        values, size = np.concatenate([by_point, lens], axis=2), columns.shape[1]
        starts = np.arange(0, 2 * n * size + 1, size)
        rows = csr_array((values.ravel(), np.repeat(columns, 2, axis=0).ravel(), starts), (2 * n, p + basis.shape[1]))
        return cls(rows, np.linalg.qr(by_pose.reshape(2 * n, 6))[0])

    def free(self, values: np.ndarray) -> np.ndarray:
        return values - self.pose @ (self.pose.T @ values)

    def along(self, directions: np.ndarray) -> np.ndarray:
        """Returns the change (2n, k) of the rows along directions (3p + q, k), the pose adjusted."""
        return self.free(self.rows @ directions)

    def square(self, covariance: np.ndarray) -> np.ndarray:
        """Returns the covariance (2n, 2n) of the rows by that of points and intrinsics, the pose adjusted."""
        return self.along(self.along(covariance).T)


@dataclass(frozen=True, slots=True, eq=False)
class GroupPart:
    """One group of the joint adjustment, with e dots."""

    model: MetricModel  # at the start
    model_from_board: Rigid
    design: np.ndarray  # (e, 3) of its dots, board frame
    dots: np.ndarray  # (e,) indices of the model's points, as ``circles``
    circles: np.ndarray
    cells: np.ndarray  # (e,) of its dots on the board
    circle_place: np.ndarray  # of each circle among all

    def name(self, block: str) -> str:
        return f"{block} of {self.model.group}"

    def at(self, values: Mapping[str, Any]) -> MetricModel:
        points = np.empty_like(self.model.xyz_model)
        points[self.circles] = values[CIRCLES].array[self.circle_place]
        points[self.dots] = values[self.name(DOTS)].array
        return placed(self.model, values[self.name(POSES)], Vector(points))

    def board_at(self, values: Mapping[str, Any]) -> Rigid:
        return values[self.name(BOARD)][0]

    def place(self) -> np.ndarray:
        """Returns the place (n,) of the point of each observation among all circles, or among the group's dots."""
        place = np.zeros(len(self.model.labels), int)
        place[self.circles], place[self.dots] = self.circle_place, np.arange(len(self.dots))
        return place[self.model.point_index]

    def observations(self, kind: str) -> np.ndarray:
        return np.flatnonzero(np.isin(self.model.point_index, self.circles if kind == CIRCLES else self.dots))


class ShapeFactors(NamedTuple):
    """Factors on the stated σ of faces of known shape, in their plane and off it, and ``amplitude`` of the smooth
    deviations of their prints."""

    in_plane: float = 1.0
    off_plane: float = 1.0
    amplitude: float = AMPLITUDES[0]


AS_STATED, UNKNOWN_SHAPES = ShapeFactors(), ShapeFactors(amplitude=1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Constants of one minimisation."""

    groups: tuple[GroupPart, ...]
    labels: tuple[CircleLabel, ...]
    board: BoardDesign
    common: float
    flatness_mm: float  # infinite if unknown
    given: Camera
    basis: np.ndarray  # (16, q) derivative of the camera's parameters by those that are adjusted
    prior: np.ndarray
    huber: float
    factors: ShapeFactors = AS_STATED

    def own_sigma_mm(self) -> float:
        return self.board.sigma_mm * float(np.sqrt(1 - self.common))

    def cells(self) -> np.ndarray:
        """Returns the cells of the board of whose dots the common shape consists."""
        return np.unique(np.concatenate([group.cells for group in self.groups])) if self.common else np.zeros(0, int)

    def values(self, xyz: np.ndarray, start: Camera) -> dict[str, Any]:
        """Returns all unknowns at the start, with circles (c, 3) and intrinsics of ``start``."""
        away = np.linalg.pinv(self.basis) @ (start.parameters() - self.given.parameters())
        values: dict[str, Any] = {CIRCLES: Vector(xyz), CAMERA: Vector(away[None])}
        for group in self.groups:
            values[group.name(POSES)] = Poses.of(group.model.camera_from_model)
            values[group.name(DOTS)] = Vector(group.model.xyz_model[group.dots])
            values[group.name(BOARD)] = Poses.of([group.model_from_board])
        return values

    def camera(self, values: Mapping[str, Any]) -> Camera:
        return self.camera_at(values[CAMERA]) if self.basis.shape[1] else self.given

    def camera_at(self, away: Vector | None = None) -> Camera:
        """Returns the camera with parameters away from the given ones, if they are adjusted."""
        if away is None:
            return self.given
        return self.given.with_parameters(self.given.parameters() + self.basis @ away.array[0])

    def joined(self, values: Mapping[str, Any]) -> Joined:
        """Returns the problem of all groups at a state: that of :meth:`values`, and a common shape if there is one."""
        parts = []
        for group in self.groups:
            a = Adjustment()
            circles, camera = a.block(CIRCLES, values[CIRCLES]), a.block(CAMERA, values[CAMERA])
            if self.common:
                shape = a.block(SHAPE, values[SHAPE])
            if not parts:
                a.know(of_target(circles, self))
                a.prior(camera, np.zeros((1, len(self.prior))), self.prior)
                if self.common:
                    a.factor(
                        lambda v: v.array,
                        [(shape, np.arange(len(shape.start)))],
                        self.board.sigma_mm * float(np.sqrt(self.common)),
                        lambda v: [np.broadcast_to(np.eye(3), (len(v), 3, 3))],
                        kind=BOARD,
                    )
            self._add(a, group, values, circles, camera)
            parts.append(a)
        return Joined(parts, SHARED if self.common else SHARED[:2], free_directions)

    def _add(self, a: Adjustment, group: GroupPart, values: Mapping[str, Any], circles: Block, camera: Block) -> None:
        model, few = group.model, is_dots_first_cheaper(group)
        poses = a.block(group.name(POSES), values[group.name(POSES)], eliminate=not few)
        points = [(CIRCLES, self.labels, circles)]
        if len(group.dots):
            dots = a.block(group.name(DOTS), values[group.name(DOTS)], eliminate=few)
            points.append((DOTS, tuple(model.labels[i] for i in group.dots), dots))
        for kind, labels, block in points:
            own = replace(model, labels=labels, xyz_model=values[block.name].array, point_index=group.place())
            on = (block, poses, camera)[: 2 + bool(self.basis.shape[1])]
            seen = own.observed(group.observations(kind))
            reproject(a, seen, on, self.camera_at, self.basis, kind=kind, loss=Huber(self.huber))
        if not len(group.dots):
            return
        # Dots minus their places on the board, mm: dot = pose · (design + shape).
        cells = np.searchsorted(self.cells(), group.cells)
        ends = [(dots, np.arange(len(group.dots))), (a.block(group.name(BOARD), values[group.name(BOARD)]), None)]
        if self.common:
            ends.append((a.blocks[SHARED.index(SHAPE)], cells))

        def turned(board: Poses, shape: tuple[Vector, ...]) -> np.ndarray:
            return (group.design + shape[0].array[cells] if shape else group.design) @ board.rotation[0].T

        def residuals(dots: Vector, board: Poses, *shape: Vector) -> np.ndarray:
            return dots.array - turned(board, shape) - board.translation

        def derivatives(dots: Vector, board: Poses, *shape: Vector) -> list[np.ndarray]:
            unit = np.broadcast_to(np.eye(3), (len(dots), 3, 3))
            by_board = np.concatenate([skew(turned(board, shape)), -unit], axis=2)
            return [unit, by_board, *(np.broadcast_to(-board.rotation[0], unit.shape) for _ in shape)]

        a.factor(residuals, ends, self.own_sigma_mm(), derivatives, kind=BOARD)


def is_dots_first_cheaper(group: GroupPart) -> bool:
    """True if the cameras of a group are fewer unknowns than its dots."""
    return 6 * len(group.model.images) < 3 * len(group.dots)


@dataclass(frozen=True, slots=True, eq=False)
class KnownShape:
    """The n points of a face of known shape against its design, which is laid over them with their weights."""

    members: np.ndarray  # (n,) indices among the circles
    rotation: np.ndarray  # (3, 3) model_from_face
    off_mm: np.ndarray  # (n, 3) points minus design, face frame
    weight: np.ndarray  # (n, 3) 1/σ²
    # (3n, k) derivative of ``off_mm`` by the pose, the relative size of the print if it is free, and the print's modes
    by_pose: np.ndarray
    prior: np.ndarray  # (k,) weights of these unknowns about 0
    value: np.ndarray  # (k - 6,) size, minus 1, and modes
    sized: bool  # whether the size is free

    @classmethod
    def of(
        cls,
        members: np.ndarray,
        design: np.ndarray,
        xyz: np.ndarray,
        weight: np.ndarray,
        size_sigma: float,
        amplitude: float,
    ) -> "KnownShape":
        """Lays the design (n, 3) over points; ``size_sigma`` : relative; ``amplitude`` : of its smooth deviations."""
        modes = PrintModes.of(design[:, :2])
        unit = np.broadcast_to(np.eye(3), (len(xyz), 3, 3))
        smooth = -modes.modes.reshape(len(xyz), 3, -1)
        others = np.concatenate([-design[:, :, None], smooth], axis=2) if size_sigma else smooth
        prior = np.concatenate(
            [np.zeros(6), [size_sigma**-2] if size_sigma else [], (amplitude * modes.spread_mm) ** -2.0]
        )
        pose, value = align_rigid(xyz, design), np.zeros(len(prior) - 6)
        for _ in range(20):
            in_face = (xyz - pose.translation) @ pose.rotation
            off = in_face - design + others @ value
            by_pose = np.concatenate([skew(in_face), -unit, others], axis=2).reshape(len(weight) * 3, -1)
            weighted = weight.reshape(-1, 1) * by_pose
            normal, right = by_pose.T @ weighted + np.diag(prior), weighted.T @ off.ravel()
            right[6:] += prior[6:] * value
            scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
            step = -scale * np.linalg.lstsq(normal * scale[:, None] * scale, scale * right, rcond=1e-12)[0]
            if np.abs(step).max() < 1e-13:  # rad, mm
                break
            pose, value = pose @ Rigid.exp(step[:6]), value + step[6:]
        return cls(members, pose.rotation, off, weight, by_pose, prior, value, bool(size_sigma))

    def cost(self) -> float:
        return float((self.weight * self.off_mm**2).sum() + self.prior[6:] @ self.value**2)

    def _to_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """The unknowns by the deviations (k, 3n), and their covariance (k, k)."""
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        inverse = generalised_inverse(self.by_pose.T @ weighted + np.diag(self.prior))
        return inverse @ weighted.T, inverse

    def slope(self) -> np.ndarray:
        """Returns half the gradient of the cost by the points, (3n,), model frame."""
        return ((self.weight * self.off_mm) @ self.rotation.T).ravel()

    def normal(self) -> np.ndarray:
        """Returns the normal matrix (3n, 3n) over the points, model frame, with pose, size and modes eliminated."""
        n = len(self.members)
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        inner = np.diag(self.weight.ravel()) - weighted @ self._to_pose()[0]
        blocks = inner.reshape(n, 3, n, 3)
        return np.einsum("ai,minj,bj->manb", self.rotation, blocks, self.rotation, optimize=True).reshape(3 * n, 3 * n)

    def by_size(self) -> np.ndarray:
        """Returns the right-hand side (3n,) that a stated size one σ off brings, model frame; 0 for an exact size."""
        if not self.sized:
            return np.zeros(self.off_mm.size)
        force = self._to_pose()[0][6] * np.sqrt(self.prior[6])
        return (force.reshape(-1, 3) @ self.rotation.T).ravel()

    def _in_face(self, covariance_mm2: np.ndarray) -> np.ndarray:
        n = len(self.members)
        turned = covariance_mm2.reshape(n, 3, n, 3)
        turned = np.einsum("ai,manb,bj->minj", self.rotation, turned, self.rotation, optimize=True)
        return turned.reshape(3 * n, 3 * n)

    def leverage(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Variance of adjusted deviations, by that of the points, over the stated one, (n, 3), at most 1."""
        turned = self._in_face(covariance_mm2)
        to_pose, of_pose = self._to_pose()
        left = np.eye(len(turned)) - self.by_pose @ to_pose
        variance = np.einsum("ij,jk,ik->i", left, turned, left, optimize=True)
        variance = variance + np.einsum("ij,jk,ik->i", self.by_pose, of_pose, self.by_pose)
        return self.weight * variance.reshape(-1, 3)

    def told(self, covariance_mm2: np.ndarray, amplitude: float) -> Told:
        """Returns what the adjusted points tell about the modes of the print; ``covariance_mm2``: (3n, 3n) of these."""
        to_pose, of_pose = self._to_pose()
        of_points = to_pose @ self._in_face(covariance_mm2) @ to_pose.T
        modes = slice(6 + self.sized, len(self.prior))
        spread = 1 / np.sqrt(self.prior[modes]) / amplitude
        return Told(self.value[self.sized :], (of_pose + of_points)[modes, modes], np.zeros_like(spread), spread)


def of_target(block: Block, setting: Setting) -> Known:
    """Returns what is known of the circles: flatness of faces, known distances, faces of known shape."""

    @lru_cache(maxsize=1)  # both of a state are asked for
    def known(circles: Vector) -> tuple[list[KnownRows], list[KnownShape]]:
        xyz = circles.array
        return [*planes(xyz, setting), *bars(xyz, setting)], list(shapes(xyz, setting))

    def cost(circles: Vector) -> float:
        rows, faces = known(circles)
        return sum(face.cost() for face in faces) + sum(float((gap**2).sum()) / sigma**2 for _, _, gap, sigma in rows)

    def equations(circles: Vector) -> tuple[np.ndarray, np.ndarray]:
        size = circles.array.size
        normal, right = np.zeros((size, size)), np.zeros(size)
        rows, faces = known(circles)
        parts = [(members, slope.T @ slope / s**2, slope.T @ gap / s**2) for members, slope, gap, s in rows]
        parts += [(face.members, face.normal(), face.slope()) for face in faces]
        for members, square, pull in parts:
            place = coordinates(members)
            normal[np.ix_(place, place)] += square
            right[place] -= pull
        return normal, right

    return Known(block, cost, equations)


KnownRows = tuple[np.ndarray, np.ndarray, np.ndarray, float]
"""Circles (n,), derivatives (r, 3n) of r deviations by their coordinates, these (r,), mm, and their σ, mm."""


def coordinates(members: np.ndarray) -> np.ndarray:
    """Returns the places (3n,) of the coordinates of points (n,)."""
    return (3 * members[:, None] + np.arange(3)).ravel()


def planes(xyz: np.ndarray, setting: Setting) -> Iterator[KnownRows]:
    """Yields the distances of the circles of each face from their best plane; not of three, or of known shape."""
    if not np.isfinite(setting.flatness_mm):
        return
    known = {face.id for face in faces_of_known_shape(setting.board)}
    for face, members in rows_by(label.face for label in setting.labels).items():
        if face in known or len(members) <= 3:
            continue
        own = xyz[members]
        normal = fit_plane(own).normal
        base = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2]
        design = np.column_stack([np.ones(len(own)), (own - own.mean(0)) @ base])
        across = np.eye(len(own)) - design @ np.linalg.pinv(design)  # from heights to distances
        slope = (across[:, :, None] * normal).reshape(len(own), -1)
        yield members, slope, across @ (own @ normal), setting.flatness_mm


def shapes(xyz: np.ndarray, setting: Setting) -> Iterator[KnownShape]:
    """Yields the faces of known shape, with their stated σ; none for a state that a step has sent to infinity."""
    if not np.isfinite(xyz).all():
        return
    off, known = setting.factors.off_plane * setting.flatness_mm, known_points(setting.labels, setting.board)
    # What the sizes of all prints have in common counts once: each alone may be off by more.
    alone = float(np.sqrt(len(known)))
    for face, members in known:
        design = face.places_mm(setting.labels[i].circle for i in members)
        within = setting.factors.in_plane * (face.sigma_mm or 1.0)
        weight = np.tile([within**-2, within**-2, 0.0 if np.isinf(off) else off**-2], (len(members), 1))
        try:
            size_sigma = alone * face.size_sigma
            yield KnownShape.of(members, design, xyz[members], weight, size_sigma, setting.factors.amplitude)
        except DegenerateError:  # corners on a line
            continue


def bars(xyz: np.ndarray, setting: Setting) -> Iterator[KnownRows]:
    """Yields by how much known distances are too long."""
    place = {label: i for i, label in enumerate(setting.labels)}
    for known in known_distances(setting.board):
        if known.first in place and known.second in place:
            members = np.array([place[known.first], place[known.second]])
            apart = xyz[members[0]] - xyz[members[1]]
            length = float(np.linalg.norm(apart))
            slope = np.concatenate([apart, -apart]) / length
            yield members, slope[None], np.array([length - known.mm]), known.sigma_mm


def free_directions(values: Mapping[str, Any]) -> np.ndarray:
    """Directions (s, 6) in which all circles move as one; the datum is that of smallest trace over them."""
    motions = free_motions(values[CIRCLES].array, scale=False)
    others = sum(values[name].array.size for name in SHARED[1:] if name in values)
    return np.vstack([motions, np.zeros((others, FREE_DIRECTIONS))])
