"""The adjustment of the corners of several cameras about one board.

It joins each camera's own problem; the unknowns of board and robot are in common. For one camera it is that camera's
problem.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import NormalEquations
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.methods.bundle import Bundle, Corners
from stcal.handeye.methods.rounds import Knowledge

POSE = 6
"""Number of unknowns of a pose."""
SHARED = ("scale", "arm", "board", "robot")
"""Unknowns of all cameras together, in their order. Those of an arm are empty here."""
OWN = ("corner_px", "camera")
"""First parts of the names of the groups that each camera has of its own."""


@dataclass(frozen=True, slots=True, eq=False)
class RigBundle:
    """The unknowns: X and intrinsics of each camera, Z, the true base_from_flange (m), the board's corners (K, 3) and
    scale."""

    mount_from_camera: tuple[Rigid, ...]
    stand_from_board: Rigid
    base_from_flange: Poses
    corners: np.ndarray
    camera: tuple[Camera, ...]
    scale: float = 1.0

    def of(self, i: int) -> Bundle:
        """Returns the unknowns of one camera's problem."""
        x, camera = self.mount_from_camera[i], self.camera[i]
        return Bundle(x, self.stand_from_board, self.base_from_flange, self.corners, camera, self.scale)


@dataclass(frozen=True, slots=True, eq=False)
class RigCorners:
    """``names`` : of the cameras; ``each`` : measurements of each camera, with the same poses of the robot, the same
    corners of the board and the same σ of both. The name of a σ that belongs to one camera ends in a colon and the
    camera's name."""

    names: tuple[str, ...]
    each: tuple[Corners, ...]

    @property
    def base_from_flange(self) -> Poses:
        """The m poses of the flange, as reported."""
        return self.each[0].base_from_flange

    @property
    def sigma(self) -> dict[str, float]:
        """σ of each group."""
        sigma_of_group = {}
        for name, corners in zip(self.names, self.each, strict=True):
            sigma_of_group |= {_renamed(key, name): value for key, value in corners.sigma.items()}
        return sigma_of_group

    def places(self) -> dict[str, slice]:
        """Returns the places of the unknowns in a step: all X, Z, the intrinsics of all cameras, and the shared
        unknowns."""
        shared = self.each[0].places()
        sizes = {"x": POSE * len(self.each), "z": POSE, "camera": sum(corners.basis.shape[1] for corners in self.each)}
        sizes |= {name: shared[name].stop - shared[name].start for name in SHARED}
        ends = np.cumsum([0, *sizes.values()])
        return {name: slice(int(i), int(j)) for name, i, j in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def columns(self, i: int) -> np.ndarray:
        """Returns the columns, among all unknowns, of the unknowns of one camera's problem."""
        at, places = self.places(), self.each[i].places()
        before = sum(corners.basis.shape[1] for corners in self.each[:i])
        first = {name: place.start for name, place in at.items()}
        first |= {"x": POSE * i, "camera": at["camera"].start + before}
        return np.concatenate([first[name] + np.arange(place.stop - place.start) for name, place in places.items()])

    def count(self) -> int:
        """Returns the number of unknowns."""
        return max(place.stop for place in self.places().values())

    def robot_weight(self) -> np.ndarray:
        """Returns the whitening (m, 6, 6) of errors of base_from_flange."""
        return self.each[0].robot_weight()

    def factors(self) -> dict[str, float]:
        """Returns a factor of 1 for each kind of the intrinsics solved for."""
        factor_of_kind = {}
        for name, corners in zip(self.names, self.each, strict=True):
            factor_of_kind |= {_renamed(key, name): value for key, value in corners.factors().items()}
        return factor_of_kind

    def with_sigma(self, sigma: dict[str, float]) -> "RigCorners":
        """Returns the same problem with other σ."""
        problems = []
        for name, corners in zip(self.names, self.each, strict=True):
            problems.append(corners.with_sigma({key: sigma[_renamed(key, name)] for key in corners.sigma}))
        return replace(self, each=tuple(problems))

    def with_board_scale(self) -> "RigCorners":
        """Returns the same problem with the board's scale among the unknowns."""
        return replace(self, each=tuple(own.with_board_scale() for own in self.each))

    def with_intrinsics(self, known: dict[int, tuple[np.ndarray, np.ndarray]]) -> "RigCorners":
        """Returns the same problem with intrinsics of some cameras among the unknowns: basis and information, by number
        of the camera."""
        each = (own.with_intrinsics(*known[i]) if i in known else own for i, own in enumerate(self.each))
        return replace(self, each=tuple(each))

    def moved(self, state: RigBundle, step: np.ndarray) -> RigBundle:
        """Returns the state after a step of all unknowns."""
        moved = [corners.moved(state.of(i), step[self.columns(i)]) for i, corners in enumerate(self.each)]
        x, cameras, first = (m.mount_from_camera for m in moved), (m.camera for m in moved), moved[0]
        return RigBundle(
            tuple(x), first.stand_from_board, first.base_from_flange, first.corners, tuple(cameras), first.scale
        )

    def groups(self, state: RigBundle) -> list[Knowledge]:
        """Returns all observations: what each camera saw, and the prior knowledge."""
        count, observations = self.count(), []
        for i, (name, corners) in enumerate(zip(self.names, self.each, strict=True)):
            observations += [_among(group, self.columns(i), count, name) for group in corners.own_groups(state.of(i))]
        shared = self.each[0].shared_groups(state.of(0))
        return observations + [_among(group, self.columns(0), count, "") for group in shared]

    def linear(self, state: RigBundle) -> NormalEquations:
        """Returns cost and normal equations; the cost is infinite where a corner lies behind its camera."""
        if not all(own.in_front(state.of(i)) for i, own in enumerate(self.each)):
            return NormalEquations.impossible(self.count())
        first, *others = (group.linear() for group in self.groups(state))
        return sum(others, first)


def _renamed(key: str, name: str) -> str:
    return f"{key}:{name}" if key.startswith(OWN) else key


def _among(group: Knowledge, columns: np.ndarray, count: int, name: str) -> Knowledge:
    """Returns one camera's group with its columns among all unknowns."""
    narrow = group.jacobian
    jacobian = csr_matrix((narrow.data, columns[narrow.indices], narrow.indptr), shape=(len(narrow.indptr) - 1, count))
    return replace(group, names=tuple(_renamed(key, name) for key in group.names), jacobian=jacobian)
