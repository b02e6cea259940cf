"""Boards and tags: where their corners are, and which turns leave them looking the same."""

from dataclasses import dataclass

import numpy as np

from stcal.design import BoardDesign, Polarity
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
    σ of a corner about the grid, per axis. ``first_id`` : of its tags, which count up from there.
    """

    rows: int
    columns: int
    square_mm: float
    marker_mm: float
    dictionary: str
    legacy: bool = False
    sigma_mm: float = 0.01
    first_id: int = 0

    def tag_ids(self) -> range:
        """Ids of its tags: one in every second square."""
        return range(self.first_id, self.first_id + self.rows * self.columns // 2)

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
            raise InputError(
                "E-TAG-REPEATED", f"tag layout: tag {twice[1]} of {twice[0]} occurs twice; tags must differ"
            )

    def xy_mm(self) -> np.ndarray:
        """(4n, 2), tag by tag, mm."""
        return self.corners_mm.reshape(-1, 2)

    def symmetries(self) -> list[Rigid]:
        """None: its tags differ."""
        return []


@dataclass(frozen=True, slots=True)
class AprilGridDesign:
    """``rows`` × ``columns`` AprilTags of ``tag_mm`` (outer edge of the black border), as Kalibr prints them.

    From tag to tag ``tag_mm`` · (1 + ``spacing``). Ids count up from ``first_id`` along the bottom row, then row by row
    upwards. X along a row, Y down the columns, Z into the board, origin at the bottom left corner of the first tag:
    Kalibr's frame, turned by half a turn about X, so that tag (row i from below, column j) has its bottom left corner
    at (j · step, −i · step). ``border_bits`` : width of the black border in cells, Kalibr's 2 or the usual 1; None
    where images are to tell. ``upright`` : tags stand as OpenCV draws them, where Kalibr prints them turned by half a
    turn. ``sigma_mm`` : σ of a corner about the grid, per axis.
    """

    rows: int
    columns: int
    tag_mm: float
    spacing: float
    border_bits: int | None = None
    first_id: int = 0
    dictionary: str = "DICT_APRILTAG_36h11"
    upright: bool = False
    sigma_mm: float = 0.01

    def tag_ids(self) -> range:
        """Ids of its tags."""
        return range(self.first_id, self.first_id + self.rows * self.columns)

    def layout(self) -> "TagLayout":
        """Its tags one by one, corners in the order in which detectors name them."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        first = self.tag_mm * (1 + self.spacing) * np.column_stack([column, -row])
        square = self.tag_mm * np.array([[0, -1], [1, -1], [1, 0], [0, 0]], float)
        square = square if self.upright else np.roll(square, -2, axis=0)
        tags = tuple((self.dictionary, tag) for tag in self.tag_ids())
        return TagLayout(tags, first[:, None] + square, self.sigma_mm)

    def xy_mm(self) -> np.ndarray:
        """(4·rows·columns, 2), tag by tag, corners as detectors name them, mm."""
        return self.layout().xy_mm()

    def symmetries(self) -> list[Rigid]:
        """None: its tags differ."""
        return []


@dataclass(frozen=True, slots=True, eq=False)
class LatticePart(BoardDesign):
    """A grid of dots of which only some places are taken. ``taken`` : (n, 2) their rows and columns."""

    taken: np.ndarray | None = None

    def cells(self) -> np.ndarray:
        """Row and column of every dot, (n, 2)."""
        return BoardDesign.cells(self) if self.taken is None else self.taken


@dataclass(frozen=True, slots=True)
class AsymmetricCirclesDesign:
    """``rows`` rows of ``columns`` circles, every second row shifted by half a step: OpenCV's asymmetric circle grid.

    Circle (i, j), row i from 0 and place j in it from 0, lies at x = (2 j + i mod 2) · ``spacing_mm``, y = i ·
    ``spacing_mm``: neighbours in a row are two spacings apart, rows one. X along a row, Y down the columns, Z into the
    board, origin at circle (0, 0). OpenCV's own pattern has 11 rows and 4 columns. ``radius_mm`` of all circles, None
    where images are to tell; ``polarity`` : circles against the board; ``sigma_mm`` : σ of a circle about the grid.
    """

    rows: int
    columns: int
    spacing_mm: float
    radius_mm: float | None
    polarity: Polarity
    sigma_mm: float = 0.005

    def _steps(self) -> np.ndarray:
        row, place = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.column_stack([2 * place + row % 2, row])

    def xy_mm(self) -> np.ndarray:
        """Centres, (rows·columns, 2), row-major, mm."""
        return self.spacing_mm * self._steps().astype(float)

    def symmetries(self) -> list[Rigid]:
        """A half turn where rows are even in number: it takes the last row to the first, and either is shifted."""
        return [] if self.rows % 2 else turns(self.xy_mm(), [2])

    def radii_mm(self) -> np.ndarray:
        """Radii, (rows·columns,), mm.

        Raises
        ------
        InputError
            The design has none.
        """
        if self.radius_mm is None:
            raise InputError("E-BOARD-RADIUS", "asymmetric circles: no radius; radius_mm needed")
        return np.full(self.rows * self.columns, self.radius_mm)

    def lattice(self) -> LatticePart:
        """The square lattice that stands on its corner, of which the circles are a part."""
        x, y = self._steps().T
        cells = np.column_stack([y - x, y + x]) // 2
        cells = cells - cells.min(0)
        rows, columns = (cells.max(0) + 1).tolist()
        pitch = float(np.sqrt(2) * self.spacing_mm)
        return LatticePart(rows, columns, pitch, self.radii_mm()[0], self.polarity, self.sigma_mm, taken=cells)


FlatBoard = ChessboardDesign | CharucoDesign | TagLayout | AprilGridDesign | AsymmetricCirclesDesign


@dataclass(frozen=True, slots=True, eq=False)
class BoardSet:
    """Several boards that do not move against one another.

    ``names`` : what messages call each; ``boards`` : flat ones that images tell apart, none of which looks the same
    turned; ``common_from_board`` : their places in the frame of the set, which stands for the board's frame.
    """

    names: tuple[str, ...]
    boards: tuple[BoardDesign | FlatBoard, ...]
    common_from_board: tuple[Rigid, ...]

    def first_ids(self) -> list[int]:
        """Number of the first point of each board in :meth:`xyz_mm`."""
        return np.cumsum([0, *(len(board.xy_mm()) for board in self.boards)])[:-1].tolist()

    def xyz_mm(self) -> np.ndarray:
        """Points of all boards, one behind the other, (n, 3) mm in the frame of the set."""
        parts = zip(self.common_from_board, self.boards, strict=True)
        return np.concatenate([place @ np.pad(board.xy_mm(), ((0, 0), (0, 1))) for place, board in parts])

    def symmetries(self) -> list[Rigid]:
        """None: none of its boards has one."""
        return []


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

    ``image`` : its name; ``ids`` : (k,) rows of the design's ``xy_mm`` (of a set's ``xyz_mm``); ``xyz_board`` : (k, 3)
    mm; ``xy_px`` : (k, 2); ``covariance_px2`` : (k, 2, 2), or None where the detector has no idea of it; ``normal`` :
    (k, 3) unit normals of the planes that the points lie in, None where that is Z of all; ``unused`` : what was seen of
    the board and not used, each with its reason.
    """

    image: str
    ids: np.ndarray
    xyz_board: np.ndarray
    xy_px: np.ndarray
    covariance_px2: np.ndarray | None = None
    normal: np.ndarray | None = None
    unused: tuple[str, ...] = ()

    def __post_init__(self):
        k = len(self.ids)
        object.__setattr__(self, "ids", frozen(self.ids, (k,), "ids", int))
        object.__setattr__(self, "xyz_board", frozen(self.xyz_board, (k, 3), "board points"))
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (k, 2), "image points"))
        if self.covariance_px2 is not None:
            object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (k, 2, 2), "covariances"))
        if self.normal is not None:
            object.__setattr__(self, "normal", frozen(self.normal, (k, 3), "normals"))

    def __len__(self) -> int:
        return len(self.ids)


def view_of(image: str, board: FlatBoard, ids: np.ndarray, xy_px: np.ndarray, covariance_px2=None) -> BoardView:
    """The view of those points of a flat board."""
    xy = board.xy_mm()[ids]
    return BoardView(image, ids, np.column_stack([xy, np.zeros(len(xy))]), xy_px, covariance_px2)
