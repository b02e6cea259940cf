"""Target files whose faces may be boards or tags: reader and writer over those of ``stcal.io.design``."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from stcal.boards.design import TAG_SIGMA_MM, AprilGridDesign, CharucoDesign, FlatBoard, TagLayout
from stcal.boards.file import TYPES, flat_board, keys_of, tag_rows
from stcal.design import POINT_RADIUS_MM, FaceDesign, TargetDesign, reference_target
from stcal.errors import InputError
from stcal.io.design import PrintedFaceFile, target_toml
from stcal.io.design import load_target as load_design
from stcal.io.files import require_same, save
from stcal.io.toml import toml_string

ON_FACES = (CharucoDesign, AprilGridDesign, TagLayout)


def load_body(path: str | Path) -> TargetDesign:
    """Read ``target.toml`` with faces of circles, boards and tags; errors as :func:`stcal.io.design.load_target`.

    Parameters
    ----------
    path : str or Path
        The file (form: ``data_layout.md``).

    Returns
    -------
    TargetDesign
        Faces in their own frames, mm.

    Raises
    ------
    InputError
        Also: a tag on two faces, or a board of another kind.
    """
    target = load_design(path, _printed_face)
    face_of_tag: dict[tuple[str, int], str] = {}
    for face in target.with_faces(printed=True).faces:
        for tag in tags_on(face.printed):
            if tag in face_of_tag:
                raise InputError(
                    "E-TAG-REPEATED",
                    f"target file {path}: tag {tag[1]} of {tag[0]} is on faces {face_of_tag[tag]} and {face.id}, "
                    "each tag once needed; correct first_id or id",
                )
            face_of_tag[tag] = face.id
    return target


def body_of(given: str | Path | TargetDesign | None) -> TargetDesign:
    """Return the given target, or the target of a file; the reference design if ``given`` is None."""
    return reference_target() if given is None else given if isinstance(given, TargetDesign) else load_body(given)


def body_toml(target: TargetDesign) -> str:
    """Return the text of a ``target.toml`` for ``target``, with comments."""
    return target_toml(target, _printed_lines)


def save_body(path: str | Path, target: TargetDesign) -> None:
    """Write the file of a target, and require that it is read as the same design.

    Parameters
    ----------
    path : str or Path
        ``target.toml`` to write.
    target : TargetDesign
        Faces of circles, boards and tags.
    """
    text = body_toml(target)
    save(Path(path), text)
    require_same(path, lambda: body_toml(load_body(path)), text)


load_target, save_target = load_body, save_body
"""Names of the public interface."""


def tags_on(printed: Any) -> list[tuple[str, int]]:
    """Return dictionary and id of every tag of a board or layout; a chessboard, or a board of circles, has none."""
    if isinstance(printed, TagLayout):
        return list(printed.tags)
    if isinstance(printed, CharucoDesign | AprilGridDesign):
        return [(printed.dictionary, tag) for tag in printed.tag_ids()]
    return []


def printed_face(
    face_id: str, board: FlatBoard, sigma_mm: float | None = None, size_sigma_mm: float = 0.0, **more: Any
) -> FaceDesign:
    """Return the face of a board or tags; ``sigma_mm`` : σ of a corner, else the board's; ``more`` : pose, outline."""
    ids, xy = corner_ids(board), board.xy_mm()
    first = int(np.linalg.norm(xy - xy.mean(0), axis=1).argmax())
    second = int(np.linalg.norm(xy - xy[first], axis=1).argmax())
    along = (xy[second] - xy[first]) / np.linalg.norm(xy[second] - xy[first])
    across = (xy - xy[first]) @ np.array([-along[1], along[0]])
    third = int(across.argmax()) if across.max() >= -across.min() else int(across.argmin())
    if across[third] < 0:  # as seen along Z, X to Y must turn like the axes
        first, second = second, first
    frame = ids[first], ids[second], ids[third]
    own = board.sigma_mm or TAG_SIGMA_MM
    more |= {"printed": board, "sigma_mm": own if sigma_mm is None else sigma_mm}
    more |= {"size_sigma": size_sigma_mm / _size_mm(board), "of_tags": not isinstance(board, CharucoDesign)}
    return FaceDesign(face_id, ids, xy, np.full(len(ids), POINT_RADIUS_MM), *frame, **more)


def corner_ids(board: FlatBoard) -> tuple[str, ...]:
    """Return the ids of a board's corners: row.column of an inner corner, tag.corner of a tag."""
    if isinstance(board, CharucoDesign):
        row, column = np.divmod(np.arange((board.rows - 1) * (board.columns - 1)), board.columns - 1)
        return tuple(f"{i}.{j}" for i, j in zip(row.tolist(), column.tolist(), strict=True))
    tags = tags_on(board)
    count = Counter(tag for _, tag in tags)
    families = [f"{name.removeprefix('DICT_')}." if count[tag] > 1 else "" for name, tag in tags]
    names = [f"{family}{tag}" for family, (_, tag) in zip(families, tags, strict=True)]
    return tuple(f"{name}.{corner}" for name in names for corner in range(4))


def _size_mm(board: FlatBoard) -> float:
    """Return the size that is measured on the print: the side of a square, or of the first tag."""
    if isinstance(board, CharucoDesign):
        return board.square_mm
    layout = board.layout() if isinstance(board, AprilGridDesign) else board
    assert isinstance(layout, TagLayout)
    corners = layout.corners_mm[0]
    return float(np.linalg.norm(corners[1] - corners[0]))


def _printed_face(entry: PrintedFaceFile, unusual_size: bool, where: str) -> FaceDesign:
    if (entry.board is None) == (entry.tags is None):
        raise InputError("E-TARGET-PRINTED", f"{where}: board and tags; one of them needed")
    content: dict[str, Any] = {"type": "tags", "tag": entry.tags} if entry.board is None else dict(entry.board)
    if unusual_size:
        content.setdefault("unusual_size", True)
    board = flat_board(content, f"{where}: {'tags' if entry.board is None else 'board'}")
    if not isinstance(board, ON_FACES):
        raise InputError(
            "E-TARGET-PRINTED",
            f"{where}: board: type {content.get('type', 'circles')}; charuco or aprilgrid needed, as a face must "
            "differ from the others; give tags with `tags`, and dots as circles",
        )
    outline = None if entry.outline_mm is None else np.array(entry.outline_mm)
    more = {"rough_target_from_face": entry.rough(where), "outline_mm": outline}
    return printed_face(entry.id, board, entry.sigma_mm, entry.size_sigma_mm or 0.0, **more)


def _printed_lines(face: FaceDesign) -> list[str]:
    board = face.printed
    assert isinstance(board, CharucoDesign | AprilGridDesign | TagLayout)
    lines = [f"sigma_mm = {face.sigma_mm!r}  # of a corner about the design, per axis"]
    if face.size_sigma:
        lines.append(f"size_sigma_mm = {face.size_sigma * _size_mm(board)!r}  # of the side of a square or tag")
    else:
        lines.append("# size_sigma_mm = 0.03  # of the side of a square or tag, where you measured it")
    if isinstance(board, TagLayout):
        return [*lines, "tags = [", *tag_rows(board), "]"]
    return [*lines, f"board = {{ type = {toml_string(TYPES[type(board)])}, {', '.join(keys_of(board))} }}"]
