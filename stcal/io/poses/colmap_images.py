"""Lines of COLMAP's ``images.txt``: two for each image, the second of which is empty where an image has no points."""

from dataclasses import dataclass

from stcal.errors import InputError

CELLS = 10
"""Cells of an image's first line: id, four of the rotation, three of the translation, camera, name."""
POINT_CELLS = 3
"""Cells of a point in an image's second line: x, y, id."""


@dataclass(frozen=True, slots=True)
class ImageLine:
    """The first line of an image.

    ``number`` : of the line; ``pose`` : qw, qx, qy, qz, tx, ty, tz; ``name`` : of the image; ``followed`` : whether its
    second line is there. Programs that remove empty lines also remove those.
    """

    number: int
    pose: list[float]
    name: str
    followed: bool


def image_lines(text: str, where: str) -> list[ImageLine]:
    """Return the images of ``images.txt``, also of one from which empty lines were removed.

    Raises InputError: a line is neither an image's nor a list of points; the message names it.
    """
    images: list[ImageLine] = []
    pending: tuple[int, list[float], str] | None = None  # an image whose second line is to come
    for number, line in enumerate(text.splitlines(), 1):
        record = _record(line)
        if pending is not None:
            images.append(ImageLine(*pending, followed=record is None))
            pending = None
            if record is None:
                if not _are_points(line):
                    raise InputError(
                        "E-MODEL-UNREADABLE",
                        f"{where}: line {number}: {len(line.split())} cells, not points of `x y id` each; export the "
                        "model anew",
                    )
                continue
        elif not line.strip() or line.lstrip().startswith("#"):
            continue
        if record is None:
            raise InputError(
                "E-MODEL-UNREADABLE",
                f"{where}: line {number}: not `id qw qx qy qz tx ty tz camera name`; export the model anew",
            )
        pending = (number, *record)
    if pending is not None:
        images.append(ImageLine(*pending, followed=False))
    return images


def _record(line: str) -> tuple[list[float], str] | None:
    """Return pose and name of an image's first line; None for any other line."""
    cells = line.split(maxsplit=CELLS - 1)
    pose = floats_of(cells[1:8])
    if len(cells) < CELLS or pose is None or floats_of([cells[0], cells[8]]) is None or _are_points(line):
        return None
    return pose, cells[9].strip()


def _are_points(line: str) -> bool:
    cells = line.split()
    return len(cells) % POINT_CELLS == 0 and floats_of(cells) is not None


def floats_of(cells: list[str]) -> list[float] | None:
    """Return the numbers of the cells; None if a cell is no number."""
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
