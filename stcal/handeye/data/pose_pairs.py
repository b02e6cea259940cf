"""Pose pairs of robot and camera, the loop of transforms AX = ZB, and the motions AX = XB between its poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, frozen, require_fields
from stcal.geometry.rigid import Order, Poses, Rigid, skew
from stcal.io.table import LENGTHS, Table, read_table

Role = Literal["robot", "camera"]
SIDES: dict[Role, tuple[str, str]] = {
    "robot": ("base_from_flange", "flange_from_base"),
    "camera": ("camera_from_board", "board_from_camera"),
}
"""Transform that each row must hold of each side, with the inverse that is accepted in its place."""
LengthUnit = Literal["mm", "m", "cm", "um", "in"]  # units of translations


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HandEyePoses(Brief):
    """m pairs of poses of one robot, one camera and one board.

    Parameters
    ----------
    base_from_flange, camera_from_board : m poses each, mm
    base_from_flange_covariance, camera_from_board_covariance : (m, 6, 6), rotation (rad) and translation (mm), left
        perturbation in the first frame, where they are known
    names : name of each pair in messages: ``line 7``, an image's name; ``pose 1`` … where no names are given
    where : source of the poses
    camera_from_board_common : (m, 6, k), errors that the poses of the board have in common, as
        :func:`stcal.sfm.measure` states them: pose i errs by ``common[i] @ z`` with the same z, k independent normal
        numbers of σ 1, for all. The covariances contain them.

    Raises InputError: unequal lengths; a pair that occurs twice; a board that stands still to the last digit while the
    flange moves.
    """

    base_from_flange: Poses
    camera_from_board: Poses
    base_from_flange_covariance: np.ndarray | None = None
    camera_from_board_covariance: np.ndarray | None = None
    names: tuple[str, ...] = ()
    where: str = "poses"
    camera_from_board_common: np.ndarray | None = None

    def __post_init__(self):
        require_fields(self, "poses")
        m = len(self.base_from_flange)
        if len(self.camera_from_board) != m:
            counts = f"{m} poses of the flange and {len(self.camera_from_board)} of the board"
            raise InputError("E-POSES-COUNT", f"{self.where}: {counts}; pairs needed")
        for name in ("base_from_flange_covariance", "camera_from_board_covariance"):
            if getattr(self, name) is not None:
                freeze(self, name, (m, 6, 6), name)
        if self.camera_from_board_common is not None:
            freeze(self, "camera_from_board_common", (m, 6, None), "common errors")
        names = tuple(self.names) or tuple(f"pose {i}" for i in range(1, m + 1))
        if len(names) != m:
            raise InputError("E-NAMES-COUNT", f"{self.where}: {len(names)} names of {m} poses; one each needed")
        object.__setattr__(self, "names", names)
        self._check_copies()

    @classmethod
    def from_matrices(
        cls,
        base_from_flange: ArrayLike | Poses,
        camera_from_board: ArrayLike | Poses,
        names: Sequence[str] = (),
        where: str = "poses",
        *,
        unit: LengthUnit = "mm",
    ) -> "HandEyePoses":
        """Returns pose pairs from homogeneous matrices (m, 4, 4), or from :class:`stcal.Poses`.

        ``base_from_flange``, ``camera_from_board`` : (m, 4, 4) row i of both belongs together; ``names`` : names of the
        pairs in messages; ``where`` : source of the poses; ``unit`` : {"mm", "m", "cm", "um", "in"}: unit of the
        translations.

        Raises InputError: a matrix that is not finite, left-handed, scaled or transposed; the message names it. Another
        unit.
        """
        if unit not in LENGTHS:
            raise InputError("E-OPTION-VALUE", f"{where}: unit {unit!r}: not a choice; use {', '.join(LENGTHS)}")
        sides = []
        for side, matrices in (("base_from_flange", base_from_flange), ("camera_from_board", camera_from_board)):
            if not isinstance(matrices, Poses):
                rigid = []
                for i, matrix in enumerate(frozen(matrices, None, f"{where}: {side}", finite=False)):
                    try:
                        rigid.append(Rigid.from_matrix(matrix))
                    except InputError as error:
                        name = names[i] if i < len(names) else f"pose {i + 1}"
                        raise InputError(error.code, f"{where}: {name}: {side}: {error}") from error
                matrices = Poses.of(rigid)
            sides.append(Poses(matrices.rotation, LENGTHS[unit] * matrices.translation))
        first, second = sides
        return cls(first, second, names=tuple(names), where=where)

    def __len__(self) -> int:
        return len(self.base_from_flange)

    def __getitem__(self, index) -> "HandEyePoses":
        """Returns the pairs selected by a mask, slice or list."""
        rows = np.arange(len(self))[index]
        known = (self.base_from_flange_covariance, self.camera_from_board_covariance, self.camera_from_board_common)
        of_flange, of_board, common = (None if values is None else values[rows] for values in known)
        flange, board, names = self.base_from_flange[rows], self.camera_from_board[rows], [self.names[i] for i in rows]
        return HandEyePoses(flange, board, of_flange, of_board, tuple(names), self.where, common)

    def _check_copies(self):
        """Refuse poses that are equal to the last digit: measured values never are, so equal values were copied."""
        flange, copies = self.base_from_flange, _copies(self.camera_from_board)
        if not copies:
            return
        i, j = min((i, same[0]) for same in copies for i in same[1:])
        pair, others = f"{self.where}: {self.names[j]} and {self.names[i]}", sum(map(len, copies)) - len(copies) - 1
        moved = np.linalg.norm(flange.translation[i] - flange.translation[j])
        turned = Rigid(flange.rotation[j].T @ flange.rotation[i]).angle_rad()
        said = f": the board's pose is the same to the last digit, while the flange moved by {moved:.3g} mm and "
        said += f"{np.degrees(turned):.3g}°; give each its own pose of the board"
        if moved == 0 and turned < 1e-12:
            more, out = (f", and {others} more pairs", "one of each") if others else ("", "one of them")
            said = f"{more} are identical poses; take {out} out"
        raise InputError("E-POSES-IDENTICAL", f"{pair}{said}")

    def require_moving_flange(self):
        """Refuse poses of the flange that are equal to the last digit while the board moved about it.

        Commanded poses may be equal, and images at one of them differ by noise and by wrong numberings or flips of the
        board; so the board must have turned and moved, each by more than :data:`STALE` of what poses usually do.
        """
        board, copies = self.camera_from_board, _copies(self.base_from_flange)
        if not copies:
            return
        usual = np.median(apart(board, np.arange(len(self))), axis=0)
        stale = [same for same in copies if (apart(board, same) > STALE * usual).all(1).any()]
        if stale:
            same = max(stale, key=len)
            named = ", ".join(self.names[i] for i in same[:3]) + (" …" if len(same) > 3 else "")
            turn, shift = apart(board, same).max(0)
            said = f"{self.where}: {named}: the flange's pose is the same to the last digit in {len(same)} rows, "
            said += f"while the board moved by up to {shift:.3g} mm and {np.degrees(turn):.3g}°; read the robot's pose "
            said += "anew with each image"
            raise InputError("E-POSES-IDENTICAL", said)


def _copies(poses: Poses) -> list[np.ndarray]:
    """Returns the rows of poses that are equal to the last digit, for each such pose, in order of the first one."""
    values = np.column_stack([poses.rotation.reshape(-1, 9), poses.translation])
    inverse = np.unique(values, axis=0, return_inverse=True)[1].ravel()
    groups = (np.flatnonzero(inverse == k) for k in np.flatnonzero(np.bincount(inverse) > 1))
    return sorted(groups, key=lambda same: int(same[0]))


STALE = 0.2
"""Share of the median turn, and of the median way, of the board between two poses, beyond both of which the board moved
although the flange's pose is a copy. Noise of usable poses is some hundredths."""


def apart(poses: Poses, rows: np.ndarray) -> np.ndarray:
    """Returns angle (rad) and distance (mm) between each two of these rows, (k, 2)."""
    first, second = (rows[k] for k in np.triu_indices(len(rows), 1))
    turns = Rotation.from_matrix(np.swapaxes(poses.rotation[first], 1, 2) @ poses.rotation[second]).magnitude()
    return np.column_stack([turns, np.linalg.norm(poses.translation[first] - poses.translation[second], axis=1)])


def rms_of(differences: np.ndarray) -> tuple[float, float]:
    """Returns the RMS lengths of differences of poses, (m, 6): rad, mm."""
    turn, shift = np.sqrt((differences.reshape(-1, 2, 3) ** 2).sum(2).mean(0))
    return float(turn), float(shift)


def read_poses(path: str | Path | Table, quaternions: Order = "wxyz") -> HandEyePoses:
    """Read a CSV file of pose pairs.

    Columns ``base_from_flange_x_mm`` … ``_qw`` … and ``camera_from_board_…`` (or ``flange_from_base_…``,
    ``board_from_camera_…``), lengths in any unit of :data:`~stcal.io.table.LENGTHS`, covariances as ``…_cov_rx_rx``.
    The camera's side may also have ``…_common1_rx`` …, what the errors of its poses have in common.

    Parameters
    ----------
    path : the file
    quaternions : {"wxyz", "xyzw"}, ``wxyz`` reads them by their columns' names; ``xyzw`` takes x, y, z, w in the order
        of the columns

    Returns
    -------
    HandEyePoses : Poses in mm; pairs are named by their lines.

    Raises InputError: missing columns; a value that is not finite or a quaternion that is not of unit length, named by
    line; copied poses.
    """
    table = read_table(path, "pose file", quaternions)
    sides = [read_side(table, *names) for names in SIDES.values()]
    (flange, flange_covariance, _), (board, board_covariance, common) = sides
    names = tuple(f"line {line}" for line in table.lines)
    return HandEyePoses(flange, board, flange_covariance, board_covariance, names, table.where, common)


def read_side(table: Table, wanted: str, inverse: str) -> tuple[Poses, np.ndarray | None, np.ndarray | None]:
    """Returns poses ``wanted``, covariances and common errors, from the columns of ``wanted`` or of its inverse."""
    names = [name for name in (wanted, inverse) if any(column.startswith(name + "_") for column in table.columns)]
    if len(names) != 1:
        fault = "no such columns" if not names else "both"
        needed = f"{wanted}_x_mm … or {inverse}_x_mm … needed; the header is {table.header()}"
        other = [name for side in SIDES.values() if wanted not in side for name in side]
        swapped = not names and any(column.startswith(f"{name}_") for name in other for column in table.columns)
        exchanged = "; it has those of the other side: exchange the files" if swapped else ""
        raise InputError("E-TABLE-COLUMN-MISSING", f"{table.where}: {fault}, {needed}{exchanged}")
    poses, covariance = table.poses(names[0] + "_"), table.pose_covariances(names[0] + "_")
    common = table.common_errors(covariance, names[0] + "_")
    return (poses, covariance, common) if names[0] == wanted else inverted(poses, covariance, common)


def inverted(
    poses: Poses, covariance: np.ndarray | None, common: np.ndarray | None
) -> tuple[Poses, np.ndarray | None, np.ndarray | None]:
    """Returns the inverses of poses, with their covariances (m, 6, 6) and common errors (m, 6, k), where known."""
    return poses.inverse(), *carried(inverse_jacobian(poses), covariance, common)


def carried(
    jacobian: np.ndarray, covariance: np.ndarray | None, common: np.ndarray | None
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Returns covariances (m, 6, 6) and common errors (m, 6, k), where known, carried by derivatives (m, 6, 6)."""
    moved = None if covariance is None else jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    return moved, None if common is None else jacobian @ common


def inverse_jacobian(poses: Poses) -> np.ndarray:
    """Returns the derivative (m, 6, 6) of the left perturbation of the inverses by that of the poses."""
    transposed = np.swapaxes(poses.rotation, 1, 2)
    derivative = np.zeros((len(poses), 6, 6))
    derivative[:, :3, :3] = derivative[:, 3:, 3:] = -transposed
    derivative[:, 3:, :3] = -transposed @ skew(poses.translation)
    return derivative


Setup = Literal["eye-in-hand", "eye-to-hand"]
SETUPS: tuple[str, ...] = get_args(Setup)
OTHER: dict[Setup, Setup] = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}


@dataclass(frozen=True, slots=True)
class Frames:
    """The frames that carry camera and board, and the names of mount_from_camera and stand_from_board."""

    mount: str
    stand: str
    camera: str
    board: str


FRAMES = {
    "eye-in-hand": Frames("flange", "base", "flange_from_camera", "base_from_board"),
    "eye-to-hand": Frames("base", "flange", "base_from_camera", "flange_from_board"),
}


@dataclass(frozen=True, eq=False)
class Loop:
    """m pose pairs in the terms of the one equation.

    ``robot_covariance``, ``camera_covariance`` : (m, 6, 6) of base_from_flange and camera_from_board, where known, the
    latter without ``camera_common`` : (m, 6, k), the errors that camera_from_board have in common.
    """

    base_from_flange: Poses
    camera_from_board: Poses
    setup: Setup = "eye-in-hand"
    robot_covariance: np.ndarray | None = None
    camera_covariance: np.ndarray | None = None
    camera_common: np.ndarray | None = None

    @classmethod
    def of(cls, pairs: HandEyePoses, setup: Setup) -> "Loop":
        if setup not in SETUPS:
            raise InputError("E-HANDEYE-SETUP", f"hand-eye: setup {setup!r}; {' or '.join(SETUPS)} needed")
        of_camera, common = pairs.camera_from_board_covariance, pairs.camera_from_board_common
        if of_camera is not None and common is not None:
            of_camera = of_camera - common @ np.swapaxes(common, 1, 2)
        covariances = (pairs.base_from_flange_covariance, of_camera, common)
        return cls(pairs.base_from_flange, pairs.camera_from_board, setup, *covariances)

    @property
    def inverted(self) -> bool:
        """Whether the mount is the base, and the stand the flange."""
        return self.setup == "eye-to-hand"

    @cached_property
    def stand_from_mount(self) -> Poses:
        """The robot's part of the loop."""
        return self.base_from_flange.inverse() if self.inverted else self.base_from_flange

    def __len__(self) -> int:
        return len(self.stand_from_mount)

    def __getitem__(self, index) -> "Loop":
        known = (self.robot_covariance, self.camera_covariance, self.camera_common)
        covariances = (None if c is None else c[index] for c in known)
        return Loop(self.base_from_flange[index], self.camera_from_board[index], self.setup, *covariances)

    def chain(self, mount_from_camera: Rigid, scale: float = 1.0) -> Poses:
        """Returns stand_from_board by each pose; the camera's lengths are multiplied by ``scale``."""
        seen = self.camera_from_board
        return self.stand_from_mount @ mount_from_camera @ Poses(seen.rotation, scale * seen.translation)

    def residuals(self, mount_from_camera: Rigid, stand_from_board: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns residuals (m, 6) of the chains against ``stand_from_board``: rad, mm at its origin; stand axes."""
        return self.chain(mount_from_camera, scale).difference(Poses.of([stand_from_board] * len(self)))

    def misses(self, mount_from_camera: Rigid, stand_from_board: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the lengths (m, 2) of :meth:`residuals`: rad, mm."""
        return np.linalg.norm(self.residuals(mount_from_camera, stand_from_board, scale).reshape(-1, 2, 3), axis=2)

    def jacobian(self, mount_from_camera: Rigid, scale: float = 1.0, count: int = 12) -> np.ndarray:
        """Returns the derivative (m, 6, 12 or 13) of :meth:`residuals` by left perturbations of X and Z, and by the
        scale; that of the rotation is for small residuals, which leaves the gradient exact as φ × φ = 0."""
        to_stand = self.stand_from_mount.rotation
        arm = self.camera_from_board.translation @ mount_from_camera.rotation.T
        derivative = np.zeros((len(self), 6, 13))
        derivative[:, :3, :3] = derivative[:, 3:, 3:6] = to_stand
        derivative[:, 3:, :3] = -to_stand @ skew(scale * arm)
        derivative[:, :, 6:12] = -np.eye(6)
        derivative[:, 3:, 12] = np.einsum("mij,mj->mi", to_stand, arm)
        return derivative[:, :, :count]

    def by_camera(self, mount_from_camera: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the derivative (m, 6, 6) of :meth:`residuals` by left perturbations of camera_from_board."""
        to_stand = self.stand_from_mount.rotation @ mount_from_camera.rotation
        derivative = np.zeros((len(self), 6, 6))
        derivative[:, :3, :3], derivative[:, 3:, 3:] = to_stand, scale * to_stand
        return derivative

    def by_robot(self, mount_from_camera: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the derivative (m, 6, 6) of :meth:`residuals` by left perturbations of base_from_flange."""
        derivative = np.tile(np.eye(6), (len(self), 1, 1))
        arm = self.chain(mount_from_camera, scale).translation - self.stand_from_mount.translation
        derivative[:, 3:, :3] = -skew(arm)
        return derivative @ inverse_jacobian(self.stand_from_mount.inverse()) if self.inverted else derivative


class LoopState(NamedTuple):
    """The unknowns of a loop: X, Z and the board's scale."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    scale: float = 1.0

    def moved(self, step: np.ndarray) -> "LoopState":
        """Returns the state after left perturbations of X and Z and a change of the scale, (12,) or (13,)."""
        x, z = self.mount_from_camera.moved(step[:6]), self.stand_from_board.moved(step[6:12])
        return LoopState(x, z, self.scale + float(step[12:].sum()))


LARGEST_RAD = np.radians(170)
"""Angle beyond which the logarithm is ill-conditioned: at a half turn the smallest error reverses the axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """k motions from ``first`` to ``second``, (k,) poses i, j: ``mount`` : mount_j_from_mount_i, A; ``camera`` :
    camera_j_from_camera_i, B; ``alpha``, ``beta`` : (k, 3) their rotation vectors, rad."""

    first: np.ndarray
    second: np.ndarray
    mount: Poses
    camera: Poses
    alpha: np.ndarray
    beta: np.ndarray

    @classmethod
    def between(cls, loop: Loop, first: np.ndarray, second: np.ndarray) -> "Motions":
        """Returns the motions between poses ``first`` and ``second`` (k,) of a loop."""
        hand, eye = loop.stand_from_mount, loop.camera_from_board
        mount = hand[second].inverse() @ hand[first]
        camera = eye[second] @ eye[first].inverse()
        logs = (Rotation.from_matrix(np.array(p.rotation)).as_rotvec() for p in (mount, camera))
        return cls(np.asarray(first), np.asarray(second), mount, camera, *logs)

    @classmethod
    def consecutive(cls, loop: Loop) -> "Motions":
        return cls.between(loop, np.arange(len(loop) - 1), np.arange(1, len(loop)))

    @classmethod
    def all(cls, loop: Loop) -> "Motions":
        return cls.between(loop, *np.triu_indices(len(loop), 1))

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, index) -> "Motions":
        return Motions(*(getattr(self, name)[index] for name in self.__slots__))

    def has_log(self) -> np.ndarray:
        """Returns (k,) True where the logarithms of both rotations are well-conditioned."""
        return (np.linalg.norm(self.alpha, axis=1) < LARGEST_RAD) & (np.linalg.norm(self.beta, axis=1) < LARGEST_RAD)


def poses_with_log(loop: Loop) -> np.ndarray:
    """Returns which poses (m,) to use so that the logarithm between any two of them is well-conditioned."""
    motions, used = Motions.all(loop), np.ones(len(loop), bool)
    bad = ~motions.has_log()
    while bad.any():
        worst = np.bincount(np.concatenate([motions.first[bad], motions.second[bad]]), minlength=len(loop)).argmax()
        used[worst] = False
        bad &= (motions.first != worst) & (motions.second != worst)
    return used
