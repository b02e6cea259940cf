"""Files of boards: readers that name every mistake, and writers. Files without ``type`` are of boards of dots."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, create_model, model_validator

from stcal.boards.board_designs import (
    UNIT_SQUARE,
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    CornerBoard,
    FlatBoard,
    HexagonalCirclesDesign,
    TagLayout,
    mean_sides,
    require_tags,
)
from stcal.boards.dictionaries import count_of, known_dictionary
from stcal.boards.foreign import KEYS as BUNDLE_KEYS
from stcal.boards.foreign import Count, Few, Squares, kalibr_board_of, tags_of_bundle, yaml_content
from stcal.design import DOTS_SIGMA_MM, BoardDesign, Polarity, StatedSize, board_lengths, reference_board
from stcal.errors import InputError, named
from stcal.geometry.arrays import CovarianceRows, require_covariance
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_same, save, text_of
from stcal.io.json import mistake
from stcal.io.toml import Finite, Positive, Sized, Strict, load_toml, toml_of, toml_string, validated
from stcal.lengths import Length, radius, require_millimetres, side, stated_unusual

INIT = "`stcal-sfm init DIR` writes one"
REMEDY = (
    'a file with type = "chessboard", "charuco", "tags", "aprilgrid", "asymmetric-circles" or "hexagonal-circles" '
    "needed, one of dots, or one of Kalibr, see data_layout.md"
)
SET = "boards"
MOST_MARKER = 0.99
"""Largest ratio of a ChArUco tag's side to its square's: detection needs white around a tag."""
LEAST_AREA = 1e-6
"""Smallest area of a tag over its longest side squared; below it the corners lie on a line."""
OF_OTHERS = {"square_mm", "marker_mm", "dictionary", "tag", "tag_mm", "spacing_mm", "board"}
"""Keys that occur only in files of other boards than dots."""
LEAST_PPM, LEAST_PITCH_PPM = 1e-3, 0.1
"""Smallest expansion, ppm/K, and σ of a pitch, ppm, that anyone can state: less is in 1/K, or a fraction or mm."""
LEAST_C, MOST_C = -100.0, 200.0
Index = Annotated[int, Field(ge=0, strict=True)]
RimHeight = Annotated[float, Field(ge=-20, le=20)]
"""Height in mm of a rim in front of a circle; negative for a disc that is raised from its plate."""
Place = Annotated[int, Field(ge=0, le=999, strict=True)]
Rings = Annotated[tuple[tuple[Place, Place], ...], Field(max_length=1000)]
"""Row and column, or place in the row, of each dot with a hole."""
Ppm = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False, strict=True)]
SignedPpm = Annotated[float, Field(ge=-100, le=1000, allow_inf_nan=False, strict=True)]


def _in_ppm(value: float) -> float:
    if 0 < abs(value) < LEAST_PPM:
        raise ValueError(f"in ppm/K, so that {value:g} 1/K is {1e6 * value:g}; 0 or {LEAST_PPM:g} needed")
    return value


def _pitch_in_ppm(value: float) -> float:
    if 0 < value < LEAST_PITCH_PPM:
        same = f"{value:g} as a fraction is {1e6 * value:g}, and in % {1e4 * value:g}"
        raise ValueError(f"in ppm, so that {same}; 0 or {LEAST_PITCH_PPM:g} needed")
    return value


def _in_celsius(value: float) -> float:
    if not LEAST_C <= value <= MOST_C:
        kelvin = f"; {value:g} K are {value - 273.15:g} °C" if LEAST_C <= value - 273.15 <= MOST_C else ""
        raise ValueError(f"in °C, {LEAST_C:g} to {MOST_C:g} possible{kelvin}")
    return value


Celsius = Annotated[float, Field(allow_inf_nan=False, strict=True), AfterValidator(_in_celsius)]


class SizeEntry(Strict):
    """The keys of :class:`StatedSize` without the pitch, for any body."""

    expansion_ppm_per_k: Annotated[SignedPpm, AfterValidator(_in_ppm)] | None = None
    expansion_sigma_ppm_per_k: Annotated[Ppm, AfterValidator(_in_ppm)] | None = None
    temperature_c: Celsius | None = None
    temperature_sigma_k: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False, strict=True)] | None = None
    reference_temperature_c: Celsius | None = None

    def stated(self) -> StatedSize:
        """Return the values as a :class:`StatedSize`, the input of the error budget."""
        return StatedSize(**self.model_dump(include={entry.name for entry in fields(StatedSize)}))


class BoardSizeEntry(SizeEntry):
    """All keys of :class:`StatedSize`."""

    pitch_sigma_ppm: Annotated[Ppm, AfterValidator(_pitch_in_ppm)] | None = None


class _CornerFile(Strict):
    row: Index
    column: Index
    radius_mm: Positive


class _Dots(BoardSizeEntry):
    type: Literal["circles"] = "circles"
    rows: Count
    columns: Count
    pitch_mm: Positive
    radius_mm: Positive
    polarity: Polarity
    sigma_mm: Positive = DOTS_SIGMA_MM
    corner: _CornerFile | None = None
    rim_mm: RimHeight = 0.0
    unusual_size: bool = False
    rings: Rings = ()


def _dots(data: _Dots, where: str) -> BoardDesign:
    same = data.model_dump(include={entry.name for entry in fields(BoardDesign)} - {"corner"})
    same["rings"] = _rings(data.rings, data.rows, data.columns, True, where)
    stated = data.corner
    corner, radius_mm = ((stated.row, stated.column), stated.radius_mm) if stated else (None, None)
    with named(where, "board"):
        return BoardDesign(**same, corner=corner, corner_radius_mm=radius_mm, stated=data.stated())


def _rings(rings: Sequence[Sequence[int]], rows: int, columns: int, quarters: bool, where: str) -> tuple:
    """Return the dots with a hole, as (row, column); ``quarters`` : True if rows and columns are alike."""
    told = {(row, column) for row, column in rings}
    for row, column in told:
        if row >= rows or column >= columns:
            fault = f"{where}: rings has [{row}, {column}] of {rows} rows of {columns} dots, counted from 0"
            raise InputError("E-BOARD-RINGS", f"{fault}; correct it")
    half = {(rows - 1 - row, columns - 1 - column) for row, column in told}
    quarter = {(column, rows - 1 - row) for row, column in told} if quarters and rows == columns else set()
    if told and told in (half, quarter):
        fault = f"{where}: {len(told)} rings that look the same after a turn of the board"
        raise InputError("E-BOARD-RINGS", f"{fault}; choose rings that distinguish its ends, or leave rings out")
    return tuple(sorted(told))


Dictionary = Annotated[str, AfterValidator(known_dictionary)]
Bits = Annotated[int, Field(ge=1, le=2, strict=True)] | None
MaybeLength = Positive | None
KEYS: dict[str, Any] = {
    **dict.fromkeys(("square_mm", "marker_mm", "tag_mm", "spacing_mm", "sigma_mm"), Positive),
    "spacing": Annotated[float, Field(gt=0, le=10, strict=True)],
    "border_bits": Bits,
    "first_id": Index,
    "dictionary": Dictionary,
    **dict.fromkeys(("legacy", "upright"), bool),
    "polarity": Polarity,
    "rings": Rings,
}
"""What the keys of files may hold that are fields of designs of the same name."""


def _form(word: str, design: type, number: Any, **more: Any) -> type[Sized]:
    """Return the form of the file of a kind of board; ``number`` : of rows and columns; ``more`` : further keys."""
    keys: dict[str, Any] = {"type": (Literal[word], ...)}  # type: ignore[valid-type]
    for f in fields(design):
        keys[f.name] = KEYS.get(f.name, number), ... if f.default is MISSING else f.default
    return create_model(f"_{design.__name__}", __base__=Sized, **keys | more)


def _grid(design: type[FlatBoard], data: Any, where: str) -> FlatBoard:
    keys = data.model_dump(exclude={"type", "unusual_size", "diameter_mm"})
    if issubclass(design, AsymmetricCirclesDesign):
        if (data.radius_mm is None) == (data.diameter_mm is None):
            raise InputError("E-BOARD-RADIUS", f"{where}: radius_mm or diameter_mm needed, one of them")
        keys["radius_mm"] = data.radius_mm if data.diameter_mm is None else data.diameter_mm / 2
        keys["rings"] = _rings(data.rings, data.rows, data.columns, False, where)
    board = design(**keys)
    require_millimetres(_lengths(board), data.unusual_size, where)
    if isinstance(board, AsymmetricCirclesDesign) and board.radii_mm()[0] >= (most := board.nearest_mm() / 2):
        fault = f"{where}: radius {board.radius_mm:g} mm, under {most:g} mm needed for circles apart"
        raise InputError("E-BOARD-RADIUS", f"{fault}; spacing_mm is {SPACING[design]}")
    if isinstance(board, CharucoDesign) and board.marker_mm > MOST_MARKER * board.square_mm:
        fault = f"{where}: marker_mm {board.marker_mm:g}, under {MOST_MARKER:g} of square_mm {board.square_mm:g} needed"
        raise InputError("E-BOARD-MARKER-SIZE", f"{fault}; are they swapped?")
    if isinstance(board, CharucoDesign | AprilGridDesign):
        ids = board.tag_ids()
        if ids.stop > (count := count_of(board.dictionary)):
            fault = f"{where}: tags {ids.start} … {ids.stop - 1}, {board.dictionary} has 0 … {count - 1}"
            raise InputError("E-TAG-ID-RANGE", f"{fault}; correct rows, columns, first_id or dictionary")
    return board


SPACING: dict[type, str] = {
    AsymmetricCirclesDesign: "half of what neighbours in a row are apart",
    HexagonalCirclesDesign: "what neighbours are apart",
}


class TagEntry(Strict):
    """One tag of a layout, by its middle and angle, or by its corners; both are absent if it is to be determined."""

    dictionary: Dictionary
    id: Index
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
        angle = np.radians(self.angle_deg)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return self.size_mm * UNIT_SQUARE @ turn + [self.x_mm, self.y_mm]


class TagsFile(Sized):
    """A layout of tags; a board does not need the keys that ``stcal locate`` adds."""

    type: Literal["tags"]
    name: str = "tags"
    sigma_mm: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    origin: Index | None = None
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
                require_covariance(full, size, CovarianceRows.of(corners, "xy"))
            except InputError as error:
                raise mistake(f"covariance_mm2: {error}; calibrate again") from error
        return self


def load_tags(path: str | Path, what: str) -> TagsFile:
    """Read a layout of tags: TOML, or bundles of apriltag_ros (YAML)."""
    content, where = board_content(path), f"{what} {path}"
    if content is None or BUNDLE_KEYS.isdisjoint(content):  # the error of the reader of TOML says why
        return load_toml(path, TagsFile, what, REMEDY)
    return validated(tags_of_bundle(content, where), TagsFile, where)


def placed_corners(data: TagsFile, where: str, every: bool = True) -> np.ndarray:
    """Return the corners (n, 4, 2), mm, NaN where the file states no place, which it must unless ``every`` is False.
    Refuse sides in another unit than mm, tags that lie on each other, for their places are, and corners in disorder."""
    sides, corners = [], np.full((len(data.tag), 4, 2), np.nan)
    for k, tag in enumerate(data.tag):
        if (place := tag.corners(where)) is not None:
            corners[k] = place
        if tag.size_mm is not None:
            sides.append(side(f"size_mm of tag {tag.id}", tag.size_mm))
        elif place is not None:
            sides.append(side(f"side of tag {tag.id} by corners_mm", float(mean_sides(place[None])[0])))
    require_millimetres(sides, data.unusual_size, where)
    require_tags([(tag.dictionary, tag.id) for tag in data.tag], corners, True, where)
    for tag, place in zip(data.tag, corners, strict=True):
        if every and np.isnan(place).any():
            needed = "x_mm, y_mm and size_mm or corners_mm needed, or the file that `stcal locate calibrate` writes"
            raise InputError("E-TAG-PLACE", f"{where}: tag {tag.id}: no place; {needed}")
        along = np.roll(place, -1, axis=0) - place
        following = np.roll(along, -1, axis=0)
        turn = along[:, 0] * following[:, 1] - along[:, 1] * following[:, 0]
        if turn.min() <= LEAST_AREA * (along**2).sum(1).max():
            fault = f"{where}: tag {tag.id}: corners_mm turn the other way, cross or lie on a line"
            needed = "top left, top right, bottom right, bottom left as printed needed, Y downwards"
            raise InputError("E-TAG-CORNERS", f"{fault}; {needed}")
    return corners


def _tags(data: TagsFile, where: str) -> TagLayout:
    corners = placed_corners(data, where)
    with named(where):
        tags = tuple((tag.dictionary, tag.id) for tag in data.tag)
        return TagLayout(tags, corners, data.sigma_mm, data.unusual_size)


KINDS: dict[str, tuple[type, Any]] = {
    "chessboard": (ChessboardDesign, Squares),
    "charuco": (CharucoDesign, Squares),
    "tags": (TagLayout, None),
    "aprilgrid": (AprilGridDesign, Few),
    "asymmetric-circles": (AsymmetricCirclesDesign, Count),
    "hexagonal-circles": (HexagonalCirclesDesign, Count),
}
"""Design of each kind of board by its word in files, and the type of its numbers of rows and columns."""
TYPES = {design: word for word, (design, _) in KINDS.items()}  # the word of each kind of board in files
_OF_CIRCLES = dict.fromkeys(("radius_mm", "diameter_mm"), (MaybeLength, None))
READERS: Mapping[str, tuple[type[Strict], Callable[..., BoardDesign | FlatBoard]]] = {"circles": (_Dots, _dots)} | {
    word: (TagsFile, _tags)
    if design is TagLayout
    else (_form(word, design, number, **_OF_CIRCLES if design in SPACING else {}), partial(_grid, design))
    for word, (design, number) in KINDS.items()
}
"""Form of the file of each kind of board, and its reader."""


def board_content(path: str | Path) -> dict[str, Any] | None:
    """Return keys and values of a board file, TOML or Kalibr's YAML; None if it is neither, or cannot be read."""
    try:
        text = text_of(read_bytes(path, SETTINGS_BYTES))
    except (OSError, UnicodeDecodeError):
        return None
    try:
        return toml_of(text)
    except (ValueError, RecursionError):
        return yaml_content(text, ("target_type", *BUNDLE_KEYS))


def flat_board(content: dict[str, Any], where: str) -> BoardDesign | FlatBoard:
    """Return the board of keys and values; errors as :func:`load_flat_board`, with ``where`` in front."""
    if not BUNDLE_KEYS.isdisjoint(content):
        return _tags(validated(tags_of_bundle(content, where), TagsFile, where), where)
    if "target_type" in content:
        return kalibr_board_of(content, where)
    kind = content.get("type", "circles")
    if kind == SET:
        several = f"{where}: several boards that are not in one plane; the file of a single board needed here"
        raise InputError("E-BOARD-SINGLE", several)
    if not isinstance(kind, str) or kind not in READERS:
        raise InputError("E-BOARD-TYPE", f"{where}: type {kind!r}; one of {', '.join(READERS)} needed")
    form, board_of_form = READERS[kind]
    return board_of_form(validated(content, form, where), where)


def design_of(path: str | Path, content: dict[str, Any] | None) -> BoardDesign | FlatBoard:
    """Return the board of a file's content; errors as :func:`load_flat_board`."""
    where = f"board file {path}"
    if content is None:  # the error of the reader of TOML says why
        return _dots(load_toml(path, _Dots, "board file", INIT), where)
    if "type" not in content and not OF_OTHERS.isdisjoint(content):
        raise InputError("E-BOARD-TYPE", f"{where}: no type; {REMEDY}")
    return flat_board(content, where)


def load_flat_board(path: str | Path) -> BoardDesign | FlatBoard:
    """Return the board of a file of any kind (form: ``data_layout.md``), board frame, mm; without ``type`` one of dots.

    Parameters
    ----------
    path : The file: TOML, or Kalibr's YAML.

    Raises InputError: the file is unreadable, invalid for its kind, or of several boards; the message names file, place
    and reason.
    """
    return design_of(path, board_content(path))


def load_dots(path: str | Path) -> BoardDesign:
    """Read a board of dots; errors as :func:`load_flat_board`, and for a file of another kind of board."""
    board = load_flat_board(path)
    if isinstance(board, BoardDesign):
        return board
    dots = "a board of dots needed here: `calibrate-camera`, `handeye` and `locate` take others"
    raise InputError("E-BOARD-TYPE", f"board file {path}: {TYPES[type(board)]}; {dots}")


def load_board(path: str | Path) -> BoardDesign:
    """Return the board beside a target, board frame, mm: dots, asymmetric circles as places of a lattice, or points of
    a board of squares or tags.

    Parameters
    ----------
    path : ``board.toml``, or the file of another kind of board (form: ``data_layout.md``).

    Raises InputError: as :func:`load_flat_board`; or its circles have no radius.
    """
    board = load_flat_board(path)
    if isinstance(board, BoardDesign):
        return board
    if not isinstance(board, AsymmetricCirclesDesign):
        return CornerBoard.of(board)
    if board.radius_mm is None:
        without = f"board file {path}: circles without a radius, which their eccentricity needs here"
        raise InputError("E-BOARD-RADIUS", f'{without}; write a file with type = "asymmetric-circles" and radius_mm')
    return board.lattice()


def board_of(given: str | Path | BoardDesign | None) -> BoardDesign:
    """Return the given board, or the board of a file; the reference board if ``given`` is None."""
    return reference_board() if given is None else given if isinstance(given, BoardDesign) else load_board(given)


def _lengths(board: FlatBoard) -> list[Length]:
    if isinstance(board, TagLayout):
        return [side("side of a tag", float(mm)) for mm in mean_sides(board.corners_mm)]
    if isinstance(board, AsymmetricCirclesDesign):
        return [side("spacing_mm", board.spacing_mm), radius("radius of the circles", board.radius_mm or 0.0)]
    names = ("square_mm", "marker_mm", "tag_mm")
    return [side(name, getattr(board, name)) for name in names if hasattr(board, name)]


def board_toml(board: BoardDesign) -> str:
    """Return the text of a file that :func:`load_board` reads; with comments for a board of dots."""
    if (printed := getattr(board, "printed", None)) is not None:
        rows = tag_rows(printed) if isinstance(printed, TagLayout) else []
        lines = [f'type = "{TYPES[type(printed)]}"', *stated_unusual(_lengths(printed)), *keys_of(printed)]
        return "".join(f"{line}\n" for line in [*lines, *(["tag = [", *rows, "]"] if rows else [])])
    corner = board.corner or (0, 0)
    prefix = "" if board.corner else "# "
    sizes = {entry.name: getattr(board.stated, entry.name) for entry in fields(StatedSize)}
    return "\n".join(
        [
            "# A rectangular grid of dots. Dot (row 0, column 0) is the origin, columns run along X, rows along Y.",
            f"rows = {board.rows}",
            f"columns = {board.columns}",
            f"pitch_mm = {number(board.pitch_mm)}",
            f"radius_mm = {number(board.radius_mm)}",
            f'polarity = "{board.polarity}"  # dots are "bright" or "dark" against the board',
            f"sigma_mm = {number(board.sigma_mm)}  # standard deviation of the dots' positions, per axis",
            *([f"rim_mm = {number(board.rim_mm)}  # height of rims before the dots"] if board.rim_mm else []),
            *(f"{key} = {number(value)}" for key, value in sizes.items() if value is not None),
            *([f"rings = {list(map(list, board.rings))}  # dots with a hole"] if board.rings else []),
            *stated_unusual(board_lengths(board.pitch_mm, board.radius_mm)),
            "",
            "# One larger dot in a corner of the grid tells the orientation; without it the board looks the",
            "# same after half a turn, which a run settles by comparing the images of a group.",
            f"{prefix}[corner]",
            f"{prefix}row = {corner[0]}",
            f"{prefix}column = {corner[1]}",
            f"{prefix}radius_mm = {number(board.corner_radius_mm or 1.5 * board.radius_mm)}",
            "",
        ]
    )


def number(value: float) -> str:
    """Return a length as files have it, with nine decimals at most."""
    return repr(round(float(value), 9) + 0.0)


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


def save_board(path: str | Path, board: BoardDesign) -> None:
    """Write the file of a board beside a target, and require that it is read as the same board.

    Parameters
    ----------
    path : ``board.toml`` to write.
    board : Board of dots, or of the kinds that :func:`load_board` makes boards of dots of.
    """
    text = board_toml(board)
    save(Path(path), text)
    require_same(path, lambda: board_toml(load_board(path)), text)
