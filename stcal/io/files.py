"""Bytes of a file that the user names, as many as its kind can have."""

import errno
import os
from pathlib import Path

MB = 1_000_000
SETTINGS_BYTES = 10 * MB
"""Most that a file has which people write: camera, designs, robot, layout."""
TABLE_BYTES = 100 * MB
"""Most that tables and result files have."""
IMAGE_BYTES = 500 * MB
"""Most that an image file has: 80 megapixels, 16 bit, colour, as they are."""
MODEL_BYTES = 1000 * MB
"""Most that a file of a COLMAP model has."""


def read_bytes(path: str | Path, most: int) -> bytes:
    """All of a file.

    Raises
    ------
    OSError
        It cannot be read, or is larger than ``most`` bytes.
    """
    chunks, left = [], most + 1
    with open(path, "rb") as stream:
        step = max(os.fstat(stream.fileno()).st_size + 1, MB)  # `read` takes memory for as much as it is asked for
        while chunk := stream.read(min(step, left)):
            chunks.append(chunk)
            left -= len(chunk)
        if not left:
            raise _too_large(path, most)
    return b"".join(chunks)


def require_size(path: str | Path, most: int) -> None:
    """Of a file that another program's library reads.

    Raises
    ------
    OSError
        It is larger than ``most`` bytes.
    """
    if Path(path).stat().st_size > most:
        raise _too_large(path, most)


def _too_large(path: str | Path, most: int) -> OSError:
    size = f"{Path(path).stat().st_size / MB:.0f} MB" if Path(path).is_file() else "no end"
    return OSError(errno.EFBIG, f"{size}, at most {most // MB} MB are read", str(path))
