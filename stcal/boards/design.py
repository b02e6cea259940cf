"""Boards and tags: where their corners are, and which turns leave them looking the same."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Rigid


@dataclass(frozen=True, slots=True)
class ChessboardDesign:
    """``rows`` × ``columns`` inner corners of squares of ``square_mm``.

    X along a row, Y down the columns, Z into the board, origin at inner corner (0, 0); the square between inner
    corners (0, 0) and (1, 1) is black. ``sigma_mm`` : σ of a corner about the grid, per axis.
    """

    rows: int
    columns: int
    square_mm: float
    sigma_mm: float = 0.01

    def xy_mm(self) -> np.ndarray:
        """Inner corners, (rows·columns, 2), row-major, mm."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return self.square_mm * np.column_stack([column, row]).astype(float)

    def symmetries(self) -> list[Rigid]:
        """Half or quarter turns after which the board looks the same, as board_from_board; never the identity."""
        if (self.rows + self.columns) % 2:
            return []
        # After a quarter turn a square board has its colours again where its inner corners are even in number.
        square = self.rows == self.columns
        return turns(self.xy_mm(), [1, 2, 3] if square and self.rows % 2 == 0 else [2])


@dataclass(frozen=True, slots=True)
class CharucoDesign:
    """``rows`` × ``columns`` squares of ``square_mm``, tags of ``marker_mm`` of ``dictionary`` in the white ones.

    X along a row, Y down the columns, Z into the board, origin at the outer corner of the first square. ``legacy`` :
    printed by OpenCV before 4.6, which began boards of an even number of rows with a white square. ``sigma_mm`` :
    σ of a corner about the grid, per axis.
    """

    rows: int
    columns: int
    square_mm: float
    marker_mm: float
    dictionary: str
    legacy: bool = False
    sigma_mm: float = 0.01

    def xy_mm(self) -> np.ndarray:
        """Inner corners, ((rows − 1)·(columns − 1), 2), row-major, mm."""
        row, column = np.divmod(np.arange((self.rows - 1) * (self.columns - 1)), self.columns - 1)
        return self.square_mm * (1 + np.column_stack([column, row]).astype(float))

    def symmetries(self) -> list[Rigid]:
        """None: its tags differ."""
        return []


@dataclass(frozen=True, slots=True, eq=False)
class TagLayout:
    """Tags in one plane, Z into it.

    ``tags`` : (n,) dictionary and id of each; ``corners_mm`` : (n, 4, 2) top left, top right, bottom right, bottom
    left as printed, mm; ``sigma_mm`` : σ of a corner's coordinate.
    """

    tags: tuple[tuple[str, int], ...]
    corners_mm: np.ndarray
    sigma_mm: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "corners_mm", frozen(self.corners_mm, (len(self.tags), 4, 2), "tags' corners"))
        if len(set(self.tags)) < len(self.tags):
            twice = next(tag for tag in self.tags if self.tags.count(tag) > 1)
            raise InputError(f"tag layout: tag {twice[1]} of {twice[0]} occurs twice; tags must differ")

    def xy_mm(self) -> np.ndarray:
        """(4n, 2), tag by tag, mm."""
        return self.corners_mm.reshape(-1, 2)

    def symmetries(self) -> list[Rigid]:
        """None: its tags differ."""
        return []


FlatBoard = ChessboardDesign | CharucoDesign | TagLayout


def turns(xy_mm: np.ndarray, quarters: list[int]) -> list[Rigid]:
    """Turns by so many quarters about the middle of a board's points (n, 2), as board_from_board."""
    middle = np.append((xy_mm.min(0) + xy_mm.max(0)) / 2, 0.0)
    found = []
    for quarter in quarters:
        cosine, sine = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter % 4]
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
        found.append(Rigid(rotation, middle - rotation @ middle))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The points of a board in one image.

    ``image`` : its name; ``ids`` : (k,) rows of the design's ``xy_mm``; ``xyz_board`` : (k, 3) mm; ``xy_px`` : (k, 2);
    ``covariance_px2`` : (k, 2, 2), or None where the detector has no idea of it.
    """

    image: str
    ids: np.ndarray
    xyz_board: np.ndarray
    xy_px: np.ndarray
    covariance_px2: np.ndarray | None = None

    def __post_init__(self):
        k = len(self.ids)
        object.__setattr__(self, "ids", frozen(self.ids, (k,), "ids", int))
        object.__setattr__(self, "xyz_board", frozen(self.xyz_board, (k, 3), "board points"))
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (k, 2), "image points"))
        if self.covariance_px2 is not None:
            object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (k, 2, 2), "covariances"))

    def __len__(self) -> int:
        return len(self.ids)


def view_of(image: str, board: FlatBoard, ids: np.ndarray, xy_px: np.ndarray, covariance_px2=None) -> BoardView:
    """The view of those points of a flat board."""
    xy = board.xy_mm()[ids]
    return BoardView(image, ids, np.column_stack([xy, np.zeros(len(xy))]), xy_px, covariance_px2)
