"""Files of several boards that are fixed in one frame, and the check that images can distinguish these boards."""

from itertools import combinations
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import BoardSet, CharucoDesign, ChessboardDesign, FlatBoard
from stcal.boards.board_file import SET, board_content, design_of, flat_board, load_flat_board
from stcal.boards.target_file import tags_on
from stcal.design import BoardDesign
from stcal.errors import InputError, named
from stcal.geometry.rigid import Rigid
from stcal.io.toml import Finite, PoseEntry, Strict, validated

MOST_BOARDS = 100


class _BoardsFile(Strict):
    type: Literal["boards"]
    board: list[dict[str, Any]] = Field(min_length=1, max_length=MOST_BOARDS)


class _Place(PoseEntry):
    """The pose of a board: position and quaternion, or ``rpy_deg`` about the fixed axes X, Y, Z; or a 4×4 matrix."""

    rpy_deg: list[Finite] | None = Field(default=None, min_length=3, max_length=3)
    common_from_board: list[list[Finite]] | None = None

    def common(self, where: str) -> Rigid:
        """Return common_from_board."""
        given_keys = self.model_fields_set
        if self.common_from_board is not None:
            if further := given_keys - {"common_from_board"}:
                conflict = f"{where}: common_from_board and {min(further)}; give one of them"
                raise InputError("E-BOARD-KEY-CONFLICT", conflict)
            if [len(row) for row in self.common_from_board] != [4] * 4:
                raise InputError("E-BOARD-PLACE", f"{where}: common_from_board: 4 rows of 4 numbers needed")
            try:
                return Rigid.from_matrix(self.common_from_board)
            except InputError as error:
                raise InputError("E-BOARD-PLACE", f"{where}: common_from_board: {error}") from error
        if self.rpy_deg is None:
            return self.rigid(where)
        if given_keys & {"qw", "qx", "qy", "qz"}:
            raise InputError("E-BOARD-KEY-CONFLICT", f"{where}: rpy_deg and a quaternion; one of them needed")
        turn = Rotation.from_euler("xyz", self.rpy_deg, degrees=True)
        return Rigid(turn.as_matrix(), [self.x_mm, self.y_mm, self.z_mm])


def load_boards(path: str | Path) -> BoardDesign | FlatBoard | BoardSet:
    """Read a board file of any kind, of one board or several (form: ``data_layout.md``)."""
    content = board_content(path)
    if content is None or content.get("type") != SET:
        return design_of(path, content)
    where = f"board file {path}"
    names, boards, places = [], [], []
    for number, entry in enumerate(validated(content, _BoardsFile, where).board, 1):
        entry_place = f"{where}: board {number}"
        place = {key: value for key, value in entry.items() if key in _Place.model_fields}
        entry_board = {key: value for key, value in entry.items() if key not in place}
        places.append(validated(place, _Place, entry_place).common(entry_place))
        boards.append(_board(Path(path), entry_board, entry_place))
        names.append(f"board {number}" + (f" ({Path(entry_board['file']).name})" if "file" in entry_board else ""))
    board_set = BoardSet(tuple(names), tuple(boards), tuple(places))
    _require_told_apart(board_set, where)
    return board_set


def _board(path: Path, entry: dict[str, Any], where: str) -> BoardDesign | FlatBoard:
    if "file" not in entry:
        return flat_board(entry, where)
    if not isinstance(entry["file"], str):
        raise InputError("E-BOARD-FILE-KEY", f"{where}: file: a string needed")
    if extra := sorted(set(entry) - {"file"}):
        beside = f"{where}: {', '.join(extra)} beside file; the board's file says what the board is"
        raise InputError("E-BOARD-KEY-CONFLICT", beside)
    with named(where):
        return load_flat_board(path.parent / entry["file"])


def _require_told_apart(found: BoardSet, where: str) -> None:
    """Refuse boards that look alike in an image, and boards that look the same after a rotation."""
    for name, board in zip(found.names, found.boards, strict=True):
        if not board.unique() if isinstance(board, BoardDesign) else board.symmetries():
            raise InputError(
                "E-BOARD-AMBIGUOUS",
                f"{where}: {name} looks the same when turned, so that its points cannot be numbered in the common "
                "frame; a chessboard of an odd and an even side, a larger corner dot, or tags needed",
            )
    for (first_name, first), (second_name, second) in combinations(zip(found.names, found.boards, strict=True), 2):
        if reason := _alike(first, second):
            raise InputError("E-BOARD-AMBIGUOUS", f"{where}: {first_name} and {second_name} look alike: {reason}")


def _alike(first: BoardDesign | FlatBoard, second: BoardDesign | FlatBoard) -> str:
    """Return why two boards look alike in images, and what to do; empty if they differ."""
    if (colour := getattr(first, "polarity", "")) and colour == getattr(second, "polarity", ""):
        return f"both have {colour} circles; one of them bright and one dark, or tags, needed"
    for whole, part in ((first, second), (second, first)):
        if not isinstance(part, ChessboardDesign) or not (inner := _inner(whole)):
            continue
        if all(a <= b for a, b in zip(sorted((part.rows, part.columns)), sorted(inner), strict=True)):
            return (
                f"{part.rows}×{part.columns} inner corners are seen in {inner[0]}×{inner[1]} too; one with more rows "
                "and fewer columns, or tags, needed"
            )
    if common := sorted(set(tags_on(first)) & set(tags_on(second))):
        return f"both have tag {common[0][1]} of {common[0][0]}; other ids (first_id) or another dictionary needed"
    return ""


def _inner(board: BoardDesign | FlatBoard) -> tuple[int, int] | None:
    """Return rows and columns of inner corners of a board of squares, else None."""
    if isinstance(board, ChessboardDesign):
        return board.rows, board.columns
    return (board.rows - 1, board.columns - 1) if isinstance(board, CharucoDesign) else None
