"""Files of several boards that are fixed in one frame, and what must tell these boards apart."""

from itertools import combinations
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from scipy.spatial.transform import Rotation

from stcal.boards.design import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    BoardSet,
    CharucoDesign,
    ChessboardDesign,
    FlatBoard,
    TagLayout,
)
from stcal.boards.file import SET, board_content, design_of, flat_board, load_flat_board
from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.toml import Finite, PoseEntry, Strict, validated

MOST_BOARDS = 100


class _BoardsFile(Strict):
    type: Literal["boards"]
    board: list[dict[str, Any]] = Field(min_length=1, max_length=MOST_BOARDS)


class _Place(PoseEntry):
    """Where a board is: a pose, its rotation also as ``rpy_deg`` about the fixed axes X, Y, Z; or a 4×4 matrix."""

    rpy_deg: list[Finite] | None = Field(default=None, min_length=3, max_length=3)
    common_from_board: list[list[Finite]] | None = None

    def common(self, where: str) -> Rigid:
        """common_from_board."""
        said = self.model_fields_set
        if self.common_from_board is not None:
            if len(said) > 1:
                other = min(said - {"common_from_board"})
                raise InputError(
                    "E-BOARD-KEY-CONFLICT", f"{where}: common_from_board and {other}; the place needed once"
                )
            if [len(row) for row in self.common_from_board] != [4] * 4:
                raise InputError("E-BOARD-PLACE", f"{where}: common_from_board: 4 rows of 4 numbers needed")
            try:
                return Rigid.from_matrix(self.common_from_board)
            except InputError as error:
                raise InputError("E-BOARD-PLACE", f"{where}: common_from_board: {error}") from error
        if self.rpy_deg is None:
            return self.rigid(where)
        if said & {"qw", "qx", "qy", "qz"}:
            raise InputError("E-BOARD-KEY-CONFLICT", f"{where}: rpy_deg and a quaternion; one of them needed")
        turn = Rotation.from_euler("xyz", self.rpy_deg, degrees=True)
        return Rigid(turn.as_matrix(), [self.x_mm, self.y_mm, self.z_mm])


def load_boards(path: str | Path) -> BoardDesign | FlatBoard | BoardSet:
    """Read a board file of any kind, of one board or several (form: ``data_layout.md``).

    Raises
    ------
    InputError
        As :func:`~stcal.boards.file.load_flat_board`; boards of a set that images do not tell apart, or that look the
        same turned.
    """
    content = board_content(path)
    if content is None or content.get("type") != SET:
        return design_of(path, content)
    where = f"board file {path}"
    names, boards, places = [], [], []
    for number, entry in enumerate(validated(content, _BoardsFile, where).board, 1):
        own = f"{where}: board {number}"
        place = {key: value for key, value in entry.items() if key in _Place.model_fields}
        rest = {key: value for key, value in entry.items() if key not in place}
        places.append(validated(place, _Place, own).common(own))
        boards.append(_board(Path(path), rest, own))
        names.append(f"board {number} ({Path(rest['file']).name})" if "file" in rest else f"board {number}")
    found = BoardSet(tuple(names), tuple(boards), tuple(places))
    _require_told_apart(found, where)
    return found


def _board(path: Path, entry: dict[str, Any], where: str) -> BoardDesign | FlatBoard:
    if "file" not in entry:
        return flat_board(entry, where)
    if not isinstance(entry["file"], str):
        raise InputError("E-BOARD-FILE-KEY", f"{where}: file: a string needed")
    if extra := sorted(set(entry) - {"file"}):
        raise InputError(
            "E-BOARD-KEY-CONFLICT", f"{where}: {', '.join(extra)} beside file; what the board is stands in its file"
        )
    try:
        return load_flat_board(path.parent / entry["file"])
    except InputError as error:
        raise InputError(error.code, f"{where}: {error}") from error


def _require_told_apart(found: BoardSet, where: str) -> None:
    """Refuse what an image cannot decide: which of two boards, or which way round."""
    for name, board in zip(found.names, found.boards, strict=True):
        if _turnable(board):
            raise InputError(
                "E-BOARD-AMBIGUOUS",
                f"{where}: {name} looks the same turned, so that its points have no numbers in the common frame; "
                "a chessboard of an odd and an even side, a larger corner dot, or tags needed",
            )
    for (one, first), (two, second) in combinations(zip(found.names, found.boards, strict=True), 2):
        if said := _alike(first, second):
            raise InputError("E-BOARD-AMBIGUOUS", f"{where}: {one} and {two} look alike: {said}")


def _turnable(board: BoardDesign | FlatBoard) -> bool:
    return board.corner is None if isinstance(board, BoardDesign) else bool(board.symmetries())


def _alike(first: BoardDesign | FlatBoard, second: BoardDesign | FlatBoard) -> str:
    """Why images cannot tell two boards apart, and what to do; empty where they can."""
    if (colour := _circles(first)) and colour == _circles(second):
        return f"both have {colour} circles; one of them bright and one dark, or tags, needed"
    for whole, part in ((first, second), (second, first)):
        if isinstance(part, ChessboardDesign) and (inner := _inner(whole)) and _fits(part, inner):
            return (
                f"{part.rows}×{part.columns} inner corners are seen in {inner[0]}×{inner[1]} too; one with more rows "
                "and fewer columns, or tags, needed"
            )
    if common := sorted(_tags(first) & _tags(second)):
        return f"both have tag {common[0][1]} of {common[0][0]}; other ids (first_id) or another dictionary needed"
    return ""


def _circles(board: BoardDesign | FlatBoard) -> str:
    return board.polarity if isinstance(board, BoardDesign | AsymmetricCirclesDesign) else ""


def _inner(board: BoardDesign | FlatBoard) -> tuple[int, int] | None:
    """Rows and columns of inner corners of squares."""
    if isinstance(board, ChessboardDesign):
        return board.rows, board.columns
    return (board.rows - 1, board.columns - 1) if isinstance(board, CharucoDesign) else None


def _fits(part: ChessboardDesign, inner: tuple[int, int]) -> bool:
    """Whether a chessboard is found in a larger one, or among the squares of a ChArUco board."""
    return all(a <= b for a, b in zip(sorted((part.rows, part.columns)), sorted(inner), strict=True))


def _tags(board: BoardDesign | FlatBoard) -> set[tuple[str, int]]:
    """Dictionary and id of each of its tags."""
    if isinstance(board, TagLayout):
        return set(board.tags)
    if isinstance(board, CharucoDesign | AprilGridDesign):
        return {(board.dictionary, tag) for tag in board.tag_ids()}
    return set()
