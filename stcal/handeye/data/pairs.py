"""Pose pairs: the robot's poses of its flange, and the camera's poses of the board."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.io.quaternions import Order
from stcal.io.table import Table, read_table

WHAT = "pose file"
SIDES = (("base_from_flange", "flange_from_base"), ("camera_from_board", "board_from_camera"))
"""Transforms that each row must hold, with the inverse that is accepted in place of each."""


@dataclass(frozen=True, slots=True, eq=False)
class HandEyePoses:
    """m pairs of poses of one robot, one camera and one board.

    Parameters
    ----------
    base_from_flange, camera_from_board : Poses
        m poses each, mm.
    base_from_flange_covariance, camera_from_board_covariance : (m, 6, 6) arrays, optional
        Rotation (rad) and translation (mm), left perturbation in the first frame, where they are known.
    names : tuple of str
        Name of each pair in messages: ``line 7``, an image's name; ``pose 1`` … where no names are given.
    where : str
        Source of the poses.

    Raises
    ------
    InputError
        Unequal lengths; a pair that occurs twice; a board that stands still to the last digit while the flange moves.
    """

    base_from_flange: Poses
    camera_from_board: Poses
    base_from_flange_covariance: np.ndarray | None = None
    camera_from_board_covariance: np.ndarray | None = None
    names: tuple[str, ...] = ()
    where: str = "poses"

    def __post_init__(self):
        m = len(self.base_from_flange)
        if len(self.camera_from_board) != m:
            raise InputError(
                "E-POSES-COUNT",
                f"{self.where}: {m} poses of the flange and {len(self.camera_from_board)} of the board; pairs needed",
            )
        for name in ("base_from_flange_covariance", "camera_from_board_covariance"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name), (m, 6, 6), name))
        names = tuple(self.names) or tuple(f"pose {i}" for i in range(1, m + 1))
        if len(names) != m:
            raise InputError("E-NAMES-COUNT", f"{self.where}: {len(names)} names of {m} poses; one each needed")
        object.__setattr__(self, "names", names)
        self._check_copies()

    @classmethod
    def from_matrices(cls, base_from_flange, camera_from_board, names=(), where: str = "poses") -> "HandEyePoses":
        """Returns pose pairs from homogeneous matrices (m, 4, 4), mm.

        Raises
        ------
        InputError
            A matrix that is not finite, left-handed, scaled or transposed; the message names it.
        """
        sides = []
        for side, matrices in (("base_from_flange", base_from_flange), ("camera_from_board", camera_from_board)):
            rigid = []
            for i, matrix in enumerate(matrices):
                name = names[i] if i < len(names) else f"pose {i + 1}"
                try:
                    rigid.append(Rigid.from_matrix(matrix))
                except InputError as error:
                    raise InputError(error.code, f"{where}: {name}: {side}: {error}") from error
            sides.append(Poses.of(rigid))
        return cls(*sides, names=tuple(names), where=where)

    def __len__(self) -> int:
        return len(self.base_from_flange)

    def __getitem__(self, index) -> "HandEyePoses":
        """Returns the pairs selected by a mask, slice or list."""
        rows = np.arange(len(self))[index]
        of_flange, of_board = self.base_from_flange_covariance, self.camera_from_board_covariance
        return HandEyePoses(
            self.base_from_flange[rows],
            self.camera_from_board[rows],
            None if of_flange is None else of_flange[rows],
            None if of_board is None else of_board[rows],
            tuple(self.names[i] for i in rows),
            self.where,
        )

    def _check_copies(self):
        """Refuse poses that are equal to the last digit: measured values never are, so equal values were copied."""
        flange, board = self.base_from_flange, self.camera_from_board
        first: dict[bytes, int] = {}
        for i in range(len(self)):
            content = board.rotation[i].tobytes() + board.translation[i].tobytes()
            j = first.setdefault(content, i)
            if j == i:
                continue
            pair = f"{self.where}: {self.names[j]} and {self.names[i]}"
            moved = np.linalg.norm(flange.translation[i] - flange.translation[j])
            turned = Rigid(flange.rotation[j].T @ flange.rotation[i]).angle_rad()
            if moved == 0 and turned < 1e-12:
                raise InputError("E-POSES-IDENTICAL", f"{pair} are identical poses; take one of them out")
            raise InputError(
                "E-POSES-IDENTICAL",
                f"{pair}: the board's pose is the same to the last digit, while the flange moved by {moved:.3g} mm and "
                f"{np.degrees(turned):.3g}°; give each its own pose of the board",
            )


def read_poses(path: str | Path | Table, quaternions: Order = "wxyz") -> HandEyePoses:
    """Read a CSV file of pose pairs.

    Columns ``base_from_flange_x_mm`` … ``_qw`` … and ``camera_from_board_…`` (or ``flange_from_base_…``,
    ``board_from_camera_…``), lengths in any unit of :data:`~stcal.io.table.LENGTHS`, covariances as ``…_cov_rx_rx``.

    Parameters
    ----------
    path : str or Path
        The file.
    quaternions : {"wxyz", "xyzw"}
        ``wxyz`` reads them by their columns' names; ``xyzw`` takes x, y, z, w in the order of the columns.

    Returns
    -------
    HandEyePoses
        Poses in mm; pairs are named by their lines.

    Raises
    ------
    InputError
        Missing columns; a value that is not finite or a quaternion that is not of unit length, named by line; copied
        poses.
    """
    table = read_table(path, WHAT, quaternions)
    sides = [read_side(table, *names) for names in SIDES]
    (flange, flange_covariance), (board, board_covariance) = sides
    names = tuple(f"line {line}" for line in table.lines)
    return HandEyePoses(flange, board, flange_covariance, board_covariance, names, table.where)


def read_side(table: Table, wanted: str, inverse: str) -> tuple[Poses, np.ndarray | None]:
    """Returns poses ``wanted`` and their covariances, from the columns of ``wanted`` or of its inverse."""
    names = [name for name in (wanted, inverse) if any(column.startswith(name + "_") for column in table.columns)]
    if len(names) != 1:
        fault = "no such columns" if not names else "both"
        raise InputError(
            "E-TABLE-COLUMN-MISSING",
            f"{table.where}: {fault}, {wanted}_x_mm … or {inverse}_x_mm … needed; the header is {table.header()}",
        )
    poses, covariance = table.poses(names[0] + "_"), table.pose_covariances(names[0] + "_")
    if names[0] == wanted:
        return poses, covariance
    return poses.inverse(), None if covariance is None else inverse_covariance(poses, covariance)


def inverse_jacobian(poses: Poses) -> np.ndarray:
    """Returns the derivative (m, 6, 6) of the left perturbation of the inverses by that of the poses."""
    transposed = np.swapaxes(poses.rotation, 1, 2)
    derivative = np.zeros((len(poses), 6, 6))
    derivative[:, :3, :3] = derivative[:, 3:, 3:] = -transposed
    derivative[:, 3:, :3] = -transposed @ skew(poses.translation)
    return derivative


def inverse_covariance(poses: Poses, covariance: np.ndarray) -> np.ndarray:
    """Returns the covariances (m, 6, 6) of the inverses of poses with these covariances (m, 6, 6)."""
    jacobian = inverse_jacobian(poses)
    return jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
