"""The adjustment of the corners of several cameras about one board: each camera's own problem, with the unknowns of
board and robot in common. Of one camera it is that camera's problem."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import NormalEquations
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.methods.bundle import Bundle, Corners
from stcal.handeye.methods.rounds import Knowledge

POSE = 6
"""Unknowns of a pose."""
SHARED = ("scale", "arm", "board", "robot")
"""Unknowns of all cameras together, in their order; those of an arm are none here."""
OWN = ("corner_px", "camera")
"""Groups that each camera has of its own begin so."""


@dataclass(frozen=True, slots=True, eq=False)
class RigBundle:
    """The unknowns: X and intrinsics of each camera, Z, base_from_flange as it really was (m), the board's corners
    (K, 3) and scale."""

    mount_from_camera: tuple[Rigid, ...]
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: tuple[Camera, ...]
    scale: float = 1.0

    def of(self, i: int) -> Bundle:
        """What concerns one camera."""
        x, camera = self.mount_from_camera[i], self.camera[i]
        return Bundle(x, self.stand_from_board, self.base_from_flange, self.corners, camera, self.scale)


@dataclass(frozen=True, slots=True, eq=False)
class RigCorners:
    """``names`` : of the cameras; ``each`` : what each of them measured, with the same poses of the robot, the same
    corners of the board and the same σ of both. σ that are one camera's have its name behind a colon."""

    names: tuple[str, ...]
    each: tuple[Corners, ...]

    @property
    def base_from_flange(self) -> Poses:
        """m, as reported."""
        return self.each[0].base_from_flange

    @property
    def sigma(self) -> dict[str, float]:
        """Of each group."""
        found = {}
        for name, own in zip(self.names, self.each, strict=True):
            found |= {_renamed(key, name): value for key, value in own.sigma.items()}
        return found

    def places(self) -> dict[str, slice]:
        """Where the unknowns stand in a step: all X, Z, the intrinsics of all, and what they share."""
        shared = self.each[0].places()
        sizes = {"x": POSE * len(self.each), "z": POSE, "camera": sum(own.basis.shape[1] for own in self.each)}
        sizes |= {name: shared[name].stop - shared[name].start for name in SHARED}
        ends = np.cumsum([0, *sizes.values()])
        return {name: slice(int(i), int(j)) for name, i, j in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def columns(self, i: int) -> np.ndarray:
        """Where the unknowns of one camera's problem stand among all."""
        at, own = self.places(), self.each[i].places()
        before = sum(each.basis.shape[1] for each in self.each[:i])
        first = {name: place.start for name, place in at.items()}
        first |= {"x": POSE * i, "camera": at["camera"].start + before}
        return np.concatenate([first[name] + np.arange(place.stop - place.start) for name, place in own.items()])

    def count(self) -> int:
        """Number of unknowns."""
        return max(place.stop for place in self.places().values())

    def robot_weight(self) -> np.ndarray:
        """(m, 6, 6) whitening of errors of base_from_flange."""
        return self.each[0].robot_weight()

    def factors(self) -> dict[str, float]:
        """1 for each kind of the intrinsics solved for."""
        found = {}
        for name, own in zip(self.names, self.each, strict=True):
            found |= {_renamed(key, name): value for key, value in own.factors().items()}
        return found

    def with_sigma(self, sigma: dict[str, float]) -> "RigCorners":
        """With other σ."""
        each = []
        for name, own in zip(self.names, self.each, strict=True):
            each.append(own.with_sigma({key: sigma[_renamed(key, name)] for key in own.sigma}))
        return replace(self, each=tuple(each))

    def with_board_scale(self) -> "RigCorners":
        """With the board's scale among the unknowns."""
        return replace(self, each=tuple(own.with_board_scale() for own in self.each))

    def with_intrinsics(self, known: dict[int, tuple[np.ndarray, np.ndarray]]) -> "RigCorners":
        """With intrinsics of some cameras among the unknowns: their basis and information, by number of the camera."""
        each = (own.with_intrinsics(*known[i]) if i in known else own for i, own in enumerate(self.each))
        return replace(self, each=tuple(each))

    def moved(self, state: RigBundle, step: np.ndarray) -> RigBundle:
        """By a step of all unknowns."""
        moved = [own.moved(state.of(i), step[self.columns(i)]) for i, own in enumerate(self.each)]
        x, cameras, one = (m.mount_from_camera for m in moved), (m.camera for m in moved), moved[0]
        return RigBundle(tuple(x), one.stand_from_board, one.base_from_flange, one.corners, tuple(cameras), one.scale)

    def groups(self, state: RigBundle) -> list[Knowledge]:
        """Everything that is known: what each camera saw, and what was known before."""
        count, found = self.count(), []
        for i, (name, own) in enumerate(zip(self.names, self.each, strict=True)):
            found += [_among(group, self.columns(i), count, name) for group in own.own_groups(state.of(i))]
        shared = self.each[0].shared_groups(state.of(0))
        return found + [_among(group, self.columns(0), count, "") for group in shared]

    def linear(self, state: RigBundle) -> NormalEquations:
        """Cost and normal equations; infinite cost where a corner lies behind its camera."""
        if not all(own.in_front(state.of(i)) for i, own in enumerate(self.each)):
            return NormalEquations.impossible(self.count())
        first, *others = (group.linear() for group in self.groups(state))
        return sum(others, first)


def _renamed(key: str, name: str) -> str:
    return f"{key}:{name}" if key.startswith(OWN) else key


def _among(group: Knowledge, columns: np.ndarray, count: int, name: str) -> Knowledge:
    """One camera's group by all unknowns."""
    own = group.jacobian
    jacobian = csr_matrix((own.data, columns[own.indices], own.indptr), shape=(len(own.indptr) - 1, count))
    return replace(group, names=tuple(_renamed(key, name) for key in group.names), jacobian=jacobian)
