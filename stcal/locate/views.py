"""Board and tags in the photographs of a calibration."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stcal.boards.chessboard import find_chessboard
from stcal.boards.design import BoardView, CharucoDesign, ChessboardDesign, FlatBoard, TagLayout
from stcal.boards.tags import Tags, find_charuco, find_tags, view_of_tags
from stcal.camera_file import CameraModel
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.images import ImageFile, decode, find_images
from stcal.parallel import run_parallel


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationImages:
    """``names`` of m readable images of one size, ``views`` of the board in them, None where it is not seen (or not
    sought), ``tags``; ``camera``; ``left_out`` : files that are not used, and why."""

    names: tuple[str, ...]
    views: tuple[BoardView | None, ...]
    tags: tuple[Tags, ...]
    camera: Camera
    left_out: tuple[str, ...]


def read_images(
    folder: str | Path,
    model: CameraModel,
    board: FlatBoard | None,
    dictionaries: Sequence[str],
    workers: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> CalibrationImages:
    """Find board and tags in all images of a folder; ``board`` None where something else finds it.

    Raises
    ------
    InputError
        No image that can be used; the message names the first and its reason.
    """
    files, skipped = find_images(folder)
    left_out = [f"{each.name}: {each.reason}" for each in skipped]
    found: list = [None] * len(files)
    tell = progress or (lambda *_: None)
    size = (model.width, model.height) if model.width and model.height else None
    jobs = [(file, model, board, tuple(dictionaries)) for file in files]
    for done, (i, result) in enumerate(run_parallel(_read, jobs, workers), 1):
        found[i] = result
        tell("images", done, len(files))
    used = []
    for file, result in zip(files, found, strict=True):
        size = size or (None if isinstance(result, str) else result[0])
        if isinstance(result, str):
            left_out.append(result)
        elif result[0] != size:
            left_out.append(f"{file.name}: {result[0][0]}×{result[0][1]} px, {size[0]}×{size[1]} needed")
        else:
            used.append((file.name, *result[1:]))
    if not used:
        raise InputError(f"images {folder}: none of {len(files)} can be used ({left_out[0]})")
    names, views, tags = zip(*used, strict=True)
    return CalibrationImages(names, views, tags, model.sized(*size), tuple(left_out))


def _read(file: ImageFile, model: CameraModel, board: FlatBoard | None, dictionaries: tuple[str, ...]):
    """Size, board and tags of one image; or why it cannot be used."""
    try:
        image = decode(file.path.read_bytes(), file.name)
    except (InputError, OSError) as error:
        return " ".join(str(error).split())
    height, width = image.shape
    tags = find_tags(image, dictionaries)
    view = None
    if isinstance(board, ChessboardDesign):
        view = find_chessboard(image, file.name, board)
    elif isinstance(board, CharucoDesign):
        view = find_charuco(image, file.name, board, model.sized(width, height))
    elif isinstance(board, TagLayout):
        own = tuple({dictionary for dictionary, _ in board.tags})
        view = view_of_tags(file.name, find_tags(image, own), board)
    return (width, height), view, tags
