"""Boards and tags: places of their corners, rotations that leave their appearance unchanged, black areas to draw."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from stcal.boards.dictionaries import dictionary_of, known_tags
from stcal.design import POINT_RADIUS_MM, BoardDesign, Polarity
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, frozen, require_fields
from stcal.geometry.rigid import Rigid
from stcal.labels import DotLabel, Label, dot_cells
from stcal.lengths import require_millimetres, side


class Distinct:
    """A board that no turn leaves as it looks: its tags, or its boards, differ."""

    __slots__ = ()

    def symmetries(self) -> list[Rigid]:
        """Return an empty list."""
        return []


def column_row(rows: int, columns: int) -> np.ndarray:
    """Return column and row of all places of a grid, (rows·columns, 2), row by row."""
    return np.column_stack(np.divmod(np.arange(rows * columns), columns))[:, ::-1]


@dataclass(frozen=True, slots=True)
class ChessboardDesign:
    """A chessboard of ``rows`` × ``columns`` inner corners, with squares of ``square_mm``. X along a row, Y down the
    columns, Z into the board, origin at inner corner (0, 0); the square between inner corners (0, 0) and (1, 1) is
    black. ``sigma_mm`` : σ of a corner about the grid, per axis."""

    rows: int
    columns: int
    square_mm: float
    sigma_mm: float = 0.01

    def xy_mm(self) -> np.ndarray:
        """Return the inner corners, (rows·columns, 2), row-major, mm."""
        return self.square_mm * column_row(self.rows, self.columns).astype(float)

    def symmetries(self) -> list[Rigid]:
        """Return the turns after which the board looks the same, as board_from_board, without the identity."""
        if (self.rows + self.columns) % 2:
            return []
        # A quarter turn preserves the colours of a square board if its number of inner corners per row is even.
        square = self.rows == self.columns
        return turns(self.xy_mm(), [1, 2, 3] if square and self.rows % 2 == 0 else [2])


@dataclass(frozen=True, slots=True)
class CharucoDesign(Distinct):
    """A ChArUco board of ``rows`` × ``columns`` squares of ``square_mm``, with tags in the white squares. The tags
    have the size ``marker_mm`` and are from ``dictionary``. X along a row, Y down the columns, Z into the board,
    origin at the outer corner of the first square. ``legacy`` : True for the pattern of OpenCV before 4.6, in which
    boards with an even number of rows began with a white square. ``sigma_mm`` : σ of a corner about the grid, per
    axis. ``first_id`` : id of the first tag; ids count up from there."""

    rows: int
    columns: int
    square_mm: float
    marker_mm: float
    dictionary: str
    legacy: bool = False
    sigma_mm: float = 0.01
    first_id: int = 0

    def tag_ids(self) -> range:
        """Return the ids of the board's tags: one in every second square."""
        return range(self.first_id, self.first_id + self.rows * self.columns // 2)

    def xy_mm(self) -> np.ndarray:
        """Return the inner corners, ((rows − 1)·(columns − 1), 2), row-major, mm."""
        return self.square_mm * (1.0 + column_row(self.rows - 1, self.columns - 1))


UNIT_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
"""Corners of a tag of side 1 about its middle: top left, top right, bottom right, bottom left."""
NESTED = 0.5
"""Largest ratio of the sides of two tags of which one may be inside the other, as in nested markers."""


def mean_sides(corners: np.ndarray) -> np.ndarray:
    """Return the mean side (n,) of each of n quadrilaterals (n, 4, 2)."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(1)


def require_tags(tags: Sequence[tuple[str, int]], corners_mm: np.ndarray, unusual_size: bool, where: str) -> None:
    """Refuse tags in another unit than mm, or on each other. ``corners_mm`` : (n, 4, 2), NaN where unknown."""
    known = np.flatnonzero(np.isfinite(corners_mm).all((1, 2))).tolist()
    ids, middles, sides = [tags[i][1] for i in known], corners_mm[known].mean(1), mean_sides(corners_mm[known])
    lengths = (side(f"side of tag {tag} by corners_mm", float(mm)) for tag, mm in zip(ids, sides, strict=True))
    require_millimetres(lengths, unusual_size, where)
    for i in range(1, len(ids)):
        apart = np.linalg.norm(middles[:i] - middles[i], axis=1)
        smaller, larger = np.minimum(sides[:i], sides[i]), np.maximum(sides[:i], sides[i])
        over = np.flatnonzero((apart < smaller / 2) & (smaller > NESTED * larger) & (np.array(ids[:i]) != ids[i]))
        if len(over):
            j = over[0]
            places = f"{apart[j]:.3g} mm apart, sides {sides[j]:.3g} and {sides[i]:.3g} mm"
            fault = f"{where}: tags {ids[j]} and {ids[i]} lie on each other: {places}"
            raise InputError("E-TAG-OVERLAP", f"{fault}; check that places are not in metres, and correct them")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TagLayout(Distinct, Brief):
    """Tags in one plane, Z into it.

    Parameters
    ----------
    tags : tuple of (str, int). Dictionary and id of each of the n tags.
    corners_mm : (n, 4, 2) array. Top left, top right, bottom right and bottom left corner as printed, mm.
    sigma_mm : σ of a corner's coordinate.
    unusual_size : True if unusually long or short sides are not a mistake of units.

    Raises InputError: tags that are unknown, occur twice or lie on each other; corners of another shape; lengths that
    are not mm.
    """

    tags: tuple[tuple[str, int], ...]
    corners_mm: np.ndarray
    sigma_mm: float = 0.0
    unusual_size: bool = False

    def __post_init__(self):
        require_fields(self, "tag layout", sigma_mm=0)
        object.__setattr__(self, "tags", known_tags(self.tags, "tag layout"))
        freeze(self, "corners_mm", (len(self.tags), 4, 2), "tags' corners")
        require_tags(self.tags, self.corners_mm, self.unusual_size, "tag layout")

    @classmethod
    def from_tags(
        cls,
        dictionary: str,
        ids: Sequence[int],
        xy_mm: ArrayLike,
        size_mm: ArrayLike,
        angle_deg: ArrayLike = 0.0,
        sigma_mm: float = 0.0,
    ) -> "TagLayout":
        """Return the layout of square tags of one dictionary.

        Parameters
        ----------
        dictionary : Name in ``cv2.aruco``, with or without ``DICT_``: ``"4X4_50"``.
        ids : Ids of the n tags.
        xy_mm : (n, 2) array. Middles of the tags, mm; X to the right and Y down on the printed sheet.
        size_mm : float or (n,) array. Outer sides of the black borders, mm.
        angle_deg : float or (n,) array. Angles by which the tags are turned, from X to Y.
        sigma_mm : σ of a corner's coordinate, mm.

        Raises InputError: a value is not finite, a size is not positive, or a tag is unknown or occurs twice.
        """
        n = len(ids)
        middle = frozen(xy_mm, (n, 2), "tags' middles")
        sizes, angles = (np.full(n, each) if np.ndim(each) == 0 else each for each in (size_mm, angle_deg))
        size, angle = frozen(sizes, (n,), "tags' sizes"), np.radians(frozen(angles, (n,), "tags' angles"))
        if not (size > 0).all():
            raise InputError("E-TAG-SIZE", f"tag layout: size {size.min():g} mm; a positive number needed")
        c, s = np.cos(angle), np.sin(angle)
        turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
        corners = size[:, None, None] * UNIT_SQUARE @ np.swapaxes(turn, 1, 2) + middle[:, None]
        return cls(tuple((dictionary, tag) for tag in ids), corners, sigma_mm)

    def xy_mm(self) -> np.ndarray:
        """Return the corners (4n, 2), tag by tag, mm."""
        return self.corners_mm.reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class AprilGridDesign(Distinct):
    """An AprilGrid of ``rows`` × ``columns`` AprilTags of ``tag_mm`` (outer edge of the black border), as of Kalibr.
    The step from tag to tag is ``tag_mm`` · (1 + ``spacing``). Ids count up from ``first_id`` along the bottom row,
    then row by row upwards. X along a row, Y down the columns, Z into the board, origin at the bottom left corner of
    the first tag: Kalibr's frame, turned by half a turn about X, so that tag (row i from below, column j) has its
    bottom left corner at (j · step, −i · step). ``border_bits`` : width of the black border in cells, Kalibr's 2 or
    the usual 1; None if it is to be determined from images. ``upright`` : True if tags stand as OpenCV draws them;
    Kalibr prints them rotated by half a turn. ``sigma_mm`` : σ of a corner about the grid, per axis."""

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
        """Return the ids of the board's tags."""
        return range(self.first_id, self.first_id + self.rows * self.columns)

    def layout(self) -> "TagLayout":
        """Return the board's tags one by one, with corners in the order of the detectors."""
        first = self.tag_mm * (1 + self.spacing) * (column_row(self.rows, self.columns) * [1, -1])
        square = self.tag_mm * np.array([[0, -1], [1, -1], [1, 0], [0, 0]], float)
        square = square if self.upright else np.roll(square, -2, axis=0)
        tags = tuple((self.dictionary, tag) for tag in self.tag_ids())
        return TagLayout(tags, first[:, None] + square, self.sigma_mm, unusual_size=True)  # the board has been judged

    def xy_mm(self) -> np.ndarray:
        """Return the corners (4·rows·columns, 2), tag by tag, in the order of the detectors, mm."""
        return self.layout().xy_mm()


@dataclass(frozen=True, slots=True, eq=False)
class LatticePart(BoardDesign):
    """A grid of dots in which only some places have a dot."""

    taken: np.ndarray | None = None  # (n, 2) rows and columns of these places
    printed: "FlatBoard | None" = None  # the board whose points these are

    def steps(self) -> np.ndarray:
        """Return the steps (2, 2), as columns, from column to column and from row to row, in pitches."""
        return HEXAGONAL.copy() if isinstance(self.printed, HexagonalCirclesDesign) else BoardDesign.steps(self)

    def cells(self) -> np.ndarray:
        """Return row and column of every dot, (n, 2)."""
        return BoardDesign.cells(self) if self.taken is None else self.taken

    def radii_mm(self) -> np.ndarray:
        """Return the radius of every dot, (n,), mm."""
        return np.full(len(self.cells()), self.radius_mm)

    def labels(self) -> list[DotLabel]:
        """Return the labels of the dots."""
        return [DotLabel(row, column) for row, column in self.cells().tolist()]


@dataclass(frozen=True, slots=True)
class AsymmetricCirclesDesign:
    """OpenCV's asymmetric circle grid: ``rows`` rows of ``columns`` circles, every second row shifted by half a
    step. Circle (i, j), row i and place j in it, both from 0, lies at x = (2 j + i mod 2) · ``spacing_mm``, y = i ·
    ``spacing_mm``: neighbours in a row are two spacings apart, rows one. X along a row, Y down the columns, Z into
    the board, origin at circle (0, 0). OpenCV's own pattern has 11 rows and 4 columns. ``radius_mm`` : radius of all
    circles, None if it is to be determined from images; ``polarity`` : circles against the board; ``sigma_mm`` : σ
    of a circle about the grid; ``rings`` : row and place of each circle with a hole, which tell the board from its
    turn."""

    rows: int
    columns: int
    spacing_mm: float
    radius_mm: float | None
    polarity: Polarity
    sigma_mm: float = 0.005
    rings: tuple[tuple[int, int], ...] = ()

    def __post_init__(self):
        require_fields(self, "asymmetric circles")

    def _steps(self) -> np.ndarray:
        place, row = column_row(self.rows, self.columns).T
        return np.column_stack([2 * place + row % 2, row])

    def xy_mm(self) -> np.ndarray:
        """Return the centres, (rows·columns, 2), row-major, mm."""
        return self.spacing_mm * self._steps().astype(float)

    def symmetries(self) -> list[Rigid]:
        """Return a half turn if the number of rows is even, so that first and last row differ in their shift."""
        return [] if self.rows % 2 or self.rings else turns(self.xy_mm(), [2])

    def radii_mm(self) -> np.ndarray:
        """Return the radii, (rows·columns,), mm."""
        if self.radius_mm is None:
            raise InputError("E-BOARD-RADIUS", "asymmetric circles: no radius; radius_mm needed")
        return np.full(self.rows * self.columns, self.radius_mm)

    def nearest_mm(self) -> float:
        """Return the distance of neighbouring circles, mm."""
        return float(np.sqrt(2) * self.spacing_mm)

    def _cells(self) -> np.ndarray:
        """Return row and column of all circles in the lattice, (n, 2): the square one, rotated by 45°."""
        x, y = self._steps().T
        return np.column_stack([y - x, y + x]) // 2

    def lattice(self) -> LatticePart:
        """Return the lattice of which the circles occupy some places."""
        cells = self._cells() - self._cells().min(0)
        rows, columns = (cells.max(0) + 1).tolist()
        sizes = rows, columns, self.nearest_mm(), self.radii_mm()[0]
        rings = tuple(tuple(cells[row * self.columns + place].tolist()) for row, place in self.rings)
        return LatticePart(*sizes, self.polarity, self.sigma_mm, rings=rings, taken=cells, printed=self)


HEXAGONAL = np.array([[1.0, 0.5], [0.0, np.sqrt(3) / 2]])
"""Steps of a hexagonal lattice, as columns, in pitches."""


@dataclass(frozen=True, slots=True)
class HexagonalCirclesDesign(AsymmetricCirclesDesign):
    """A hexagonal grid of ``rows`` rows of ``columns`` circles, every second row shifted by half a step. Circle (i,
    j), row i and place j in it, both from 0, lies at x = (j + (i mod 2) / 2) · ``spacing_mm``, y = i · √3 / 2 ·
    ``spacing_mm``: all six neighbours are one spacing away. Else it is as :class:`AsymmetricCirclesDesign`."""

    def _steps(self) -> np.ndarray:
        return self._cells()[:, ::-1] @ HEXAGONAL.T

    def nearest_mm(self) -> float:
        """Return the distance of neighbouring circles, mm."""
        return self.spacing_mm

    def _cells(self) -> np.ndarray:
        """Return row and column of all circles in the hexagonal lattice, whose rows are shifted by half a pitch."""
        place, row = column_row(self.rows, self.columns).T
        return np.column_stack([row, place - row // 2])


FlatBoard = ChessboardDesign | CharucoDesign | TagLayout | AprilGridDesign | AsymmetricCirclesDesign
TAG_SIGMA_MM = 0.05
"""σ of a corner of a tag if its file states none: print on paper that is glued on."""
PLACE_DIGITS = 6  # decimals, mm, to which the places of points are the same row or column


@dataclass(frozen=True, slots=True, eq=False)
class CornerBoard(LatticePart):
    """The points of a board of any kind as a board of dots without extent: of one Y a row, of one X a column."""

    y_mm: tuple[float, ...] = ()  # of the rows, which need not be equally spaced
    x_mm: tuple[float, ...] = ()  # of the columns

    def scaled(self, factor: float) -> "CornerBoard":
        """Return the board printed larger by a factor."""
        y, x = (tuple(factor * each for each in places) for places in (self.y_mm, self.x_mm))
        return replace(self, pitch_mm=factor * self.pitch_mm, radius_mm=factor * self.radius_mm, y_mm=y, x_mm=x)

    @classmethod
    def of(cls, board: FlatBoard) -> "CornerBoard":
        """Return the points of a board; ``cells()`` are in the order of its ``xy_mm``."""
        xy, places, ranks = board.xy_mm(), [], []  # places of columns and of rows in ascending order
        for values in xy.T:
            _, first, rank = np.unique(np.round(values, PLACE_DIGITS), return_index=True, return_inverse=True)
            places.append(tuple(values[first].tolist()))
            ranks.append(rank)
        apart = np.linalg.norm(xy[:, None] - xy, axis=2)
        np.fill_diagonal(apart, np.inf)
        sizes = len(places[1]), len(places[0]), float(np.median(apart.min(1))), POINT_RADIUS_MM, "dark"
        common = {"sigma_mm": board.sigma_mm or TAG_SIGMA_MM, "unusual_size": True, "printed": board}
        taken = np.column_stack(ranks[::-1])
        return cls(*sizes, taken=taken, y_mm=places[1], x_mm=places[0], **common)

    def xy_mm(self) -> np.ndarray:
        """Return the positions of the points, (n, 2), mm."""
        row, column = self.cells().T
        return np.column_stack([np.array(self.x_mm)[column], np.array(self.y_mm)[row]])

    def places_mm(self, labels: Iterable[Label]) -> np.ndarray:
        """Return the positions of these points, (n, 3), board frame."""
        row, column = dot_cells(labels).T
        return np.column_stack([np.array(self.x_mm)[column], np.array(self.y_mm)[row], np.zeros(len(row))])

    def numberings(self, ids: np.ndarray) -> np.ndarray:
        """Return row and column of these points, (k, n, 2): as they are, and after each turn that looks the same."""
        xyz = np.pad(self.xy_mm(), ((0, 0), (0, 1)))
        turns_of_board = [] if self.printed is None else self.printed.symmetries()
        places = [xyz[ids], *(turn @ xyz[ids] for turn in turns_of_board)]
        nearest = [np.linalg.norm(place[:, None] - xyz, axis=2).argmin(1) for place in places]
        return self.cells()[np.array(nearest)]


@dataclass(frozen=True, slots=True, eq=False)
class BoardSet(Distinct):
    """A set of several boards that are fixed relative to one another."""

    names: tuple[str, ...]  # of the boards in messages
    boards: tuple[BoardDesign | FlatBoard, ...]  # that look different in images, each without rotational symmetry
    common_from_board: tuple[Rigid, ...]  # in the frame of the set, which acts as the board frame

    def first_ids(self) -> list[int]:
        """Return the index of the first point of each board in :meth:`xyz_mm`."""
        return np.cumsum([0, *(len(board.xy_mm()) for board in self.boards)])[:-1].tolist()

    def xyz_mm(self) -> np.ndarray:
        """Return the points of all boards, board by board, (n, 3) mm in the frame of the set."""
        parts = zip(self.common_from_board, self.boards, strict=True)
        return np.concatenate([place @ np.pad(board.xy_mm(), ((0, 0), (0, 1))) for place, board in parts])


def turns(xy_mm: np.ndarray, quarters: list[int]) -> list[Rigid]:
    """Return the rotations by these numbers of quarter turns about the middle of points (n, 2), as board_from_board."""
    middle = np.append((xy_mm.min(0) + xy_mm.max(0)) / 2, 0.0)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations = [np.linalg.matrix_power(quarter, count) for count in quarters]
    return [Rigid(rotation, middle - rotation @ middle) for rotation in rotations]


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The k points of a board in one image."""

    image: str  # its name
    ids: np.ndarray  # (k,) rows of the design's ``xy_mm`` (of a set's ``xyz_mm``)
    xyz_board: np.ndarray  # (k, 3) mm
    xy_px: np.ndarray  # (k, 2)
    covariance_px2: np.ndarray | None = None  # (k, 2, 2), None if the detector does not estimate it
    normal: np.ndarray | None = None  # (k, 3) unit normals of the planes of the points, None if all are Z
    unused: tuple[str, ...] = ()  # parts of the board that were seen but not used, each with its reason

    def __post_init__(self):
        freeze(self, "ids", (len(self.ids),), "ids", int)
        shapes = {"xyz_board": (3,), "xy_px": (2,), "covariance_px2": (2, 2), "normal": (3,)}
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                freeze(self, name, (len(self.ids), *shape), name)

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, keep: np.ndarray) -> "BoardView":
        """Return the points of a mask (k,)."""
        names = ("ids", "xyz_board", "xy_px", "covariance_px2", "normal")
        parts = {name: part[keep] for name in names if (part := getattr(self, name)) is not None}
        return replace(self, **parts)


def view_of(image: str, board: FlatBoard, ids: np.ndarray, xy_px: np.ndarray, covariance_px2=None) -> BoardView:
    """Return the view of the points ``ids`` of a flat board."""
    xy = board.xy_mm()[ids]
    return BoardView(image, ids, np.column_stack([xy, np.zeros(len(xy))]), xy_px, covariance_px2)


SquaresOrTags = ChessboardDesign | CharucoDesign | TagLayout | AprilGridDesign
SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
UNKNOWN_BITS = 2  # border of an AprilGrid, in cells, if its file does not state it: Kalibr's


def black_areas(board: SquaresOrTags) -> list[list[np.ndarray]]:
    """Return areas as lists of closed lines (k, 2), mm in the board's frame; inner lines are holes, reversed."""
    if isinstance(board, ChessboardDesign):
        return _squares(board.rows + 1, board.columns + 1, board.square_mm, 0, -board.square_mm)
    if isinstance(board, CharucoDesign):
        first, size = int(board.legacy and board.rows % 2 == 0), (board.rows, board.columns, board.square_mm)
        white = _squares(*size, 1 - first, (board.square_mm - board.marker_mm) / 2)
        places = (at[0] + board.marker_mm * SQUARE for (at,) in white)  # the last square may be white without a tag
        tags = [_tag(board.dictionary, tag, at, 1) for tag, at in zip(board.tag_ids(), places, strict=False)]
        return _squares(*size, first, 0.0) + tags
    if isinstance(board, AprilGridDesign):
        bits = board.border_bits or UNKNOWN_BITS
        layout = board.layout()
        tags = [_tag(name, tag, at, bits) for (name, tag), at in zip(layout.tags, layout.corners_mm, strict=True)]
        gap = board.spacing * board.tag_mm
        between = (board.tag_mm + gap) * (column_row(board.rows + 1, board.columns + 1) * [1, -1]) - [gap, 0.0]
        return tags + [[corner + gap * SQUARE] for corner in between]
    return [_tag(name, tag, at, 1) for (name, tag), at in zip(board.tags, board.corners_mm, strict=True)]


def clear_mm(board: SquaresOrTags) -> float:
    """Return the width of white, mm, that detectors need around the board: a square, or a quarter of a tag."""
    if isinstance(board, ChessboardDesign | CharucoDesign):
        return board.square_mm
    if isinstance(board, AprilGridDesign):
        return board.tag_mm / 4
    sides = np.linalg.norm(board.corners_mm - np.roll(board.corners_mm, 1, axis=1), axis=2)
    return float(sides.max()) / 4


def outlines(black: np.ndarray) -> list[np.ndarray]:
    """Return closed lines around the black cells of a mask (rows, columns). Each line is (k, 2) corners, column and
    row, with the black on the right if rows go down. Areas that touch only at a corner stay separate."""
    padded = np.pad(black, 1)
    after: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(black).tolist():
        corners = [(column + x, row + y) for x, y in SQUARE.tolist()]
        for k, (down, right) in enumerate(((0, 1), (1, 2), (2, 1), (1, 0))):  # of the neighbours in ``padded``
            if not padded[row + down, column + right]:
                after.setdefault(corners[k], []).append(corners[(k + 1) % 4])
    lines = []
    while after:
        line, step = [next(iter(after))], (0, 0)
        while len(line) == 1 or line[-1] != line[0]:
            (x, y), ends = line[-1], after[line[-1]]
            right = (x - step[1], y + step[0])
            end = ends.pop(ends.index(right) if right in ends else 0)
            if not ends:
                del after[x, y]
            line.append(end)
            step = (end[0] - x, end[1] - y)
        corners = np.array(line[:-1])
        is_turn = np.roll(corners, -1, axis=0) - corners != corners - np.roll(corners, 1, axis=0)
        lines.append(corners[is_turn.any(1)])  # without those in the middle of an edge
    return lines


def _squares(rows: int, columns: int, side: float, first: int, origin: float) -> list[list[np.ndarray]]:
    """Return the black squares one by one; square (0, 0) begins at ``origin``, and is black if ``first`` is 0."""
    places = column_row(rows, columns)
    return [[side * (at + SQUARE) + origin] for at in places[places.sum(1) % 2 == first]]


def _tag(name: str, tag: int, corners: np.ndarray, border_bits: int) -> list[np.ndarray]:
    """Return lines around the black cells of a tag with these ``corners`` (4, 2), as printed from top left."""
    dictionary = dictionary_of(name)
    cells = dictionary.markerSize + 2 * border_bits
    black = cv2.aruco.generateImageMarker(dictionary, tag, cells, borderBits=border_bits) == 0
    lines = []
    for line in outlines(black):
        u, v = (line / cells).T[:, :, None]
        top = (1 - u) * corners[0] + u * corners[1]
        lines.append((1 - v) * top + v * ((1 - u) * corners[3] + u * corners[2]))
    return lines
