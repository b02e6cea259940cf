"""Readers of board files: dots (``stcal.io.design``), chessboards, ChArUco boards, AprilGrids, and Kalibr's YAML."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from stcal.boards.design import (
    UNIT_SQUARE,
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    CornerBoard,
    FlatBoard,
    HexagonalCirclesDesign,
    TagLayout,
    require_tags,
    sides_mm,
)
from stcal.boards.dictionaries import count_of, known_dictionary, of_opencv
from stcal.boards.foreign import KEYS as BUNDLE_KEYS
from stcal.boards.foreign import Few, kalibr_board_of, tags_of_bundle, yaml_content
from stcal.design import BoardDesign, Polarity, reference_board
from stcal.errors import InputError
from stcal.io.covariance import Rows, require_covariance
from stcal.io.design import BoardEntry, Count, Rings, Squares, board_design, board_toml, rings_of
from stcal.io.design import load_board as load_dots
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_same, save, text_of
from stcal.io.json import mistake
from stcal.io.toml import Finite, Positive, Sized, Strict, load_toml, toml_of, toml_string, validated
from stcal.lengths import Length, radius, require_millimetres, side, stated_unusual

SET = "boards"
REMEDY = (
    'a file with type = "chessboard", "charuco", "tags", "aprilgrid", "asymmetric-circles" or "hexagonal-circles" '
    "needed, one of dots, or one of Kalibr, see data_layout.md"
)
MOST_MARKER = 0.99
"""Largest ratio of a ChArUco tag's side to its square's: detection needs white around a tag."""
LEAST_AREA = 1e-6
"""Smallest area of a tag over its longest side squared; below it the corners lie on a line."""
OF_OTHERS = {"square_mm", "marker_mm", "dictionary", "tag", "tag_mm", "spacing_mm", "board"}
"""Keys that occur only in files of other boards than dots."""


Dictionary = Annotated[str, AfterValidator(known_dictionary)]
OpenCvDictionary = Annotated[str, AfterValidator(of_opencv)]
TagId = Annotated[int, Field(ge=0, strict=True)]


class _Chessboard(Sized):
    type: Literal["chessboard"]
    rows: Squares
    columns: Squares
    square_mm: Positive
    sigma_mm: Positive = 0.01


class _Charuco(Sized):
    type: Literal["charuco"]
    rows: Squares
    columns: Squares
    square_mm: Positive
    marker_mm: Positive
    dictionary: OpenCvDictionary
    legacy: bool = False
    sigma_mm: Positive = 0.01
    first_id: TagId = 0


class _AprilGrid(Sized):
    type: Literal["aprilgrid"]
    rows: Few
    columns: Few
    tag_mm: Positive
    spacing: Annotated[float, Field(gt=0, le=10, strict=True)]
    border_bits: Annotated[int, Field(ge=1, le=2, strict=True)] | None = None
    first_id: TagId = 0
    dictionary: OpenCvDictionary = "DICT_APRILTAG_36h11"
    upright: bool = False
    sigma_mm: Positive = 0.01


class _AsymmetricCircles(Sized):
    type: Literal["asymmetric-circles", "hexagonal-circles"]
    rows: Count
    columns: Count
    spacing_mm: Positive
    radius_mm: Positive | None = None
    diameter_mm: Positive | None = None
    polarity: Polarity
    sigma_mm: Positive = 0.005
    rings: Rings = ()


class TagEntry(Strict):
    """One tag of a layout, by its middle and angle, or by its corners; both are absent if it is to be determined."""

    dictionary: Dictionary
    id: TagId
    size_mm: Positive | None = None
    x_mm: Finite | None = None
    y_mm: Finite | None = None
    angle_deg: Finite = 0.0
    corners_mm: list[Annotated[list[Finite], Field(min_length=2, max_length=2)]] | None = Field(
        default=None, min_length=4, max_length=4
    )

    def corners(self, where: str) -> np.ndarray | None:
        """Return the corners (4, 2), mm, in the layout's frame; None if the place is unknown."""
        if self.corners_mm is not None:
            return np.array(self.corners_mm)
        if self.x_mm is None and self.y_mm is None:
            return None
        if self.x_mm is None or self.y_mm is None or self.size_mm is None:
            needed = f"{where}: tag {self.id}: x_mm, y_mm and size_mm needed together, or corners_mm"
            raise InputError("E-TAG-PLACE", needed)
        square, angle = self.size_mm * UNIT_SQUARE, np.radians(self.angle_deg)
        cosine, sine = np.cos(angle), np.sin(angle)
        return square @ np.array([[cosine, sine], [-sine, cosine]]) + [self.x_mm, self.y_mm]


class TagsFile(Sized):
    """A layout of tags; a board does not need the keys that ``stcal locate`` adds."""

    type: Literal["tags"]
    name: str = "tags"
    sigma_mm: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    origin: TagId | None = None
    sigma_px: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    tag_sigma_px: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    covariance_mm2: list[list[Finite]] | None = None
    tag: list[TagEntry] = Field(min_length=1)

    def covariance(self) -> np.ndarray | None:
        """Return the covariance (8n, 8n), mm², of the corners' coordinates; None if the file states none."""
        if self.covariance_mm2 is None:
            return None
        full = np.zeros((len(self.covariance_mm2),) * 2)
        for k, row in enumerate(self.covariance_mm2):
            full[k, : k + 1] = full[: k + 1, k] = row
        return full

    @model_validator(mode="after")
    def _states_a_covariance(self) -> Self:
        lower, size = self.covariance_mm2, 8 * len(self.tag)
        if lower is not None and [len(row) for row in lower] != list(range(1, size + 1)):
            raise mistake(f"covariance_mm2: not the lower triangle of {size} rows, 8 for each tag; calibrate again")
        full = self.covariance()
        if full is not None:
            corners = [f"corner {corner} of tag {tag.id}" for tag in self.tag for corner in range(4)]
            try:
                require_covariance(full, size, Rows.of(corners, "xy"))
            except InputError as error:
                raise mistake(f"covariance_mm2: {error}; calibrate again") from error
        return self


def load_tags(path: str | Path, what: str) -> TagsFile:
    """Read a layout of tags: TOML, or bundles of apriltag_ros (YAML)."""
    try:
        content = yaml_content(text_of(read_bytes(path, SETTINGS_BYTES)), BUNDLE_KEYS)
    except (OSError, UnicodeDecodeError):
        content = None  # the error of the reader of TOML says why
    if content is None:
        return load_toml(path, TagsFile, what, REMEDY)
    where = f"{what} {path}"
    return validated(tags_of_bundle(content, where), TagsFile, where)


def load_run_board(path: str | Path) -> BoardDesign:
    """Read the file of a board beside a target: dots, asymmetric circles as places of a lattice, or points of a board
    of squares or tags.

    Parameters
    ----------
    path : str or Path
        ``board.toml``, or the file of another kind of board (form: ``data_layout.md``).

    Returns
    -------
    BoardDesign
        Board frame, mm.

    Raises
    ------
    InputError
        As :func:`load_flat_board`; or its circles have no radius.
    """
    board = load_flat_board(path) if Path(path).is_file() else load_dots(path)
    if isinstance(board, BoardDesign):
        return board
    if not isinstance(board, AsymmetricCirclesDesign):
        return CornerBoard.of(board)
    if board.radius_mm is None:
        without = f"board file {path}: circles without a radius, which their eccentricity needs here"
        raise InputError("E-BOARD-RADIUS", f'{without}; write a file with type = "asymmetric-circles" and radius_mm')
    return board.lattice()


def run_board_of(given: str | Path | BoardDesign | None) -> BoardDesign:
    """Return the given board, or the board of a file; the reference board if ``given`` is None."""
    return reference_board() if given is None else given if isinstance(given, BoardDesign) else load_run_board(given)


TYPES = {
    ChessboardDesign: "chessboard",
    CharucoDesign: "charuco",
    AprilGridDesign: "aprilgrid",
    AsymmetricCirclesDesign: "asymmetric-circles",
    HexagonalCirclesDesign: "hexagonal-circles",
    TagLayout: "tags",
}
"""The word of each kind of board in files."""


def run_board_toml(board: BoardDesign) -> str:
    """Return the text of a board file that :func:`load_run_board` reads."""
    printed = getattr(board, "printed", None) or getattr(board, "circles", None)
    if printed is None:
        return board_toml(board)
    rows = tag_rows(printed) if isinstance(printed, TagLayout) else []
    lines = [f'type = "{TYPES[type(printed)]}"', *stated_unusual(_lengths(printed)), *keys_of(printed)]
    return "".join(f"{line}\n" for line in [*lines, *(["tag = [", *rows, "]"] if rows else [])])


def keys_of(board: FlatBoard) -> list[str]:
    """Return ``key = value`` for each number and word of a board of squares, tags or circles, as its file has them."""

    def text(value: Any) -> str:
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, tuple):
            return repr(list(map(list, value)))
        return toml_string(value) if isinstance(value, str) else repr(value)

    skipped = ("tags", "corners_mm") if isinstance(board, TagLayout) else ()
    stated = {entry.name: getattr(board, entry.name) for entry in fields(board) if entry.name not in skipped}
    return [f"{key} = {text(value)}" for key, value in stated.items() if value not in (None, ())]


def tag_rows(layout: TagLayout) -> list[str]:
    """Return a line of a file for each tag of a layout: size and place of an upright square, else the corners."""
    rows = []
    for (dictionary, tag), corners in zip(layout.tags, layout.corners_mm, strict=True):
        (x, y), size = corners.mean(0).tolist(), float(corners[1, 0] - corners[0, 0])
        if np.array_equal(size * UNIT_SQUARE + [x, y], corners):
            place = f"size_mm = {size!r}, x_mm = {x!r}, y_mm = {y!r}"
        else:
            place = f"corners_mm = [{', '.join(f'[{x!r}, {y!r}]' for x, y in corners.tolist())}]"
        rows.append(f"  {{ dictionary = {toml_string(dictionary)}, id = {tag}, {place} }},")
    return rows


def _lengths(board: FlatBoard) -> list[Length]:
    """Return the lengths of a board by which the unit of its file is judged."""
    if isinstance(board, AsymmetricCirclesDesign):
        return [side("spacing_mm", board.spacing_mm), radius("radius_mm", board.radius_mm or 0.0)]
    if isinstance(board, TagLayout):
        return [side("side of a tag", float(mm)) for mm in sides_mm(board.corners_mm)]
    names = ("square_mm", "marker_mm", "tag_mm")
    return [side(name, getattr(board, name)) for name in names if hasattr(board, name)]


def save_run_board(path: str | Path, board: BoardDesign) -> None:
    """Write the file of a board beside a target, and require that it is read as the same board.

    Parameters
    ----------
    path : str or Path
        ``board.toml`` to write.
    board : BoardDesign
        Board of dots.
    """
    text = run_board_toml(board)
    save(Path(path), text)
    require_same(path, lambda: run_board_toml(load_run_board(path)), text)


load_board, save_board = load_run_board, save_run_board
"""Names of the public interface."""


def load_flat_board(path: str | Path) -> BoardDesign | FlatBoard:
    """Read a file of one board of any kind (form: ``data_layout.md``); without ``type`` it is a board of dots.

    Parameters
    ----------
    path : str or Path
        The file: TOML, or Kalibr's YAML.

    Returns
    -------
    BoardDesign or another board design
        Board frame, mm.

    Raises
    ------
    InputError
        The file is unreadable, invalid for its kind, or of several boards; the message names file, place and reason.
    """
    return design_of(path, board_content(path))


def design_of(path: str | Path, content: dict[str, Any] | None) -> BoardDesign | FlatBoard:
    """Return the board of a file's content; errors as :func:`load_flat_board`."""
    if content is None:
        return load_dots(path)  # no TOML: the error states why
    if "type" not in content and not OF_OTHERS.isdisjoint(content):
        raise InputError("E-BOARD-TYPE", f"board file {path}: no type; {REMEDY}")
    return flat_board(content, f"board file {path}")


def flat_board(content: dict[str, Any], where: str) -> BoardDesign | FlatBoard:
    """Return the board of keys and values; errors as :func:`load_flat_board`, with ``where`` in front."""
    if any(key in content for key in BUNDLE_KEYS):
        return _tags(validated(tags_of_bundle(content, where), TagsFile, where), where)
    if "target_type" in content:
        return kalibr_board_of(content, where)
    kind = content.get("type", "circles")
    if kind == SET:
        several = f"{where}: several boards that are not in one plane; the file of a single board needed here"
        raise InputError("E-BOARD-SINGLE", several)
    if not isinstance(kind, str) or kind not in READERS:
        raise InputError("E-BOARD-TYPE", f"{where}: type {kind!r}; one of {', '.join(READERS)} needed")
    entry, board_of = READERS[kind]
    return board_of(validated(content, entry, where), where)


def board_content(path: str | Path) -> dict[str, Any] | None:
    """Return keys and values of a board file, TOML or Kalibr's YAML; None if it is neither."""
    try:
        text = text_of(read_bytes(path, SETTINGS_BYTES))
        return toml_of(text)
    except OSError as error:
        raise InputError("E-BOARD-UNREADABLE", f"board file {path}: {error.strerror or error}; {REMEDY}") from error
    except UnicodeDecodeError:
        return None
    except (ValueError, RecursionError):
        return yaml_content(text, ("target_type",) if "target_type" in text else BUNDLE_KEYS)


GRIDS = {"chessboard": ChessboardDesign, "charuco": CharucoDesign, "aprilgrid": AprilGridDesign}
"""Boards of squares and of tags in rows, whose fields are the keys of the file."""


def _grid(data: _Chessboard | _Charuco | _AprilGrid, where: str) -> ChessboardDesign | CharucoDesign | AprilGridDesign:
    board = GRIDS[data.type](**data.model_dump(exclude={"type", "unusual_size"}))
    require_millimetres(_lengths(board), data.unusual_size, where)
    if isinstance(board, ChessboardDesign):
        return board
    if isinstance(board, CharucoDesign) and board.marker_mm > MOST_MARKER * board.square_mm:
        raise InputError(
            "E-BOARD-MARKER-SIZE",
            f"{where}: marker_mm {board.marker_mm:g}, under {MOST_MARKER:g} of square_mm {board.square_mm:g} needed; "
            "are they swapped?",
        )
    ids = board.tag_ids()
    if ids.stop > (count := count_of(board.dictionary)):
        raise InputError(
            "E-TAG-ID-RANGE",
            f"{where}: tags {ids.start} … {ids.stop - 1}, {board.dictionary} has 0 … {count - 1}; correct rows, "
            "columns, first_id or dictionary",
        )
    return board


def _tags(data: TagsFile, where: str) -> TagLayout:
    require_sizes(data, where)
    corners = [tag.corners(where) for tag in data.tag]
    for tag, place in zip(data.tag, corners, strict=True):
        place_of_tag = f"{where}: tag {tag.id}"
        if place is None:
            raise InputError("E-TAG-PLACE", f"{place_of_tag}: no place; x_mm, y_mm and size_mm, or corners_mm needed")
        if tag.id >= (count := count_of(tag.dictionary)):
            raise InputError(
                "E-TAG-ID-RANGE", f"{place_of_tag}: {tag.dictionary} has 0 … {count - 1}; correct id or dictionary"
            )
        _require_convex(place, place_of_tag)
    try:
        tags = tuple((tag.dictionary, tag.id) for tag in data.tag)
        return TagLayout(tags, np.array(corners), data.sigma_mm, data.unusual_size)
    except InputError as error:
        raise InputError(error.code, f"{where}: {error}") from error


def require_sizes(data: TagsFile, where: str) -> None:
    """Refuse tags whose sides are in another unit than mm, and tags that lie on each other, for their places are."""
    require_millimetres(tag_sides(data, where), data.unusual_size, where)
    corners = [place if (place := tag.corners(where)) is not None else np.full((4, 2), np.nan) for tag in data.tag]
    require_tags([(tag.dictionary, tag.id) for tag in data.tag], np.array(corners), True, where)


def tag_sides(data: TagsFile, where: str = "") -> list[Length]:
    """Returns the stated or measured side of each tag."""
    sides = []
    for tag in data.tag:
        if tag.size_mm is not None:
            sides.append(side(f"size_mm of tag {tag.id}", tag.size_mm))
        elif (corners := tag.corners(where)) is not None:
            sides.append(side(f"side of tag {tag.id} by corners_mm", float(sides_mm(corners[None])[0])))
    return sides


def _require_convex(corners: np.ndarray, where: str) -> None:
    """Refuse corners (4, 2) of a tag that are not in cyclic order, clockwise with Y downwards, as printed."""
    side = np.roll(corners, -1, axis=0) - corners
    following = np.roll(side, -1, axis=0)
    turn = side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0]
    if turn.min() <= LEAST_AREA * (side**2).sum(1).max():
        raise InputError(
            "E-TAG-CORNERS",
            f"{where}: corners_mm turn the other way, cross or lie on a line; top left, top right, bottom right, "
            "bottom left as printed needed, Y downwards",
        )


def _asymmetric(data: _AsymmetricCircles, where: str) -> AsymmetricCirclesDesign:
    if (data.radius_mm is None) == (data.diameter_mm is None):
        raise InputError("E-BOARD-RADIUS", f"{where}: radius_mm or diameter_mm needed, one of them")
    radius_mm = data.radius_mm if data.diameter_mm is None else data.diameter_mm / 2
    lengths = [side("spacing_mm", data.spacing_mm), radius("radius of the circles", radius_mm or 0.0)]
    require_millimetres(lengths, data.unusual_size, where)
    kind, said = CIRCLES[data.type]
    rings = rings_of(data.rings, data.rows, data.columns, False, where)
    board = kind(data.rows, data.columns, data.spacing_mm, radius_mm, data.polarity, data.sigma_mm, rings)
    most = board.nearest_mm() / 2
    if radius_mm is None or radius_mm >= most:
        raise InputError(
            "E-BOARD-RADIUS",
            f"{where}: radius {radius_mm:g} mm, under {most:g} mm needed for circles apart; spacing_mm is {said}",
        )
    return board


CIRCLES = {
    "asymmetric-circles": (AsymmetricCirclesDesign, "half of what neighbours in a row are apart"),
    "hexagonal-circles": (HexagonalCirclesDesign, "what neighbours are apart"),
}
"""Grids of circles with shifted rows, and what their spacing is."""
READERS: dict[str, tuple[type[Strict], Callable[..., BoardDesign | FlatBoard]]] = {
    "circles": (BoardEntry, board_design),
    "chessboard": (_Chessboard, _grid),
    "charuco": (_Charuco, _grid),
    "tags": (TagsFile, _tags),
    "aprilgrid": (_AprilGrid, _grid),
    **dict.fromkeys(CIRCLES, (_AsymmetricCircles, _asymmetric)),
}
"""Form of the file of each kind of board, and its reader."""
