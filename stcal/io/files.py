"""Reading of files that the user names, with a size limit for each kind of file."""

import errno
import os
from pathlib import Path

MB = 1_000_000
SETTINGS_BYTES = 10 * MB
"""Largest size of a file that people write: camera, designs, robot, layout."""
TABLE_BYTES = 100 * MB
"""Largest size of tables and result files."""
IMAGE_BYTES = 500 * MB
"""Largest size of an image file: 80 megapixels, 16 bit, colour, uncompressed."""
MODEL_BYTES = 1000 * MB
"""Largest size of a file of a COLMAP model."""


def read_bytes(path: str | Path, most: int) -> bytes:
    """Return the whole content of a file.

    Raises
    ------
    OSError
        It cannot be read, or is larger than ``most`` bytes.
    """
    chunks, remaining = [], most + 1
    with open(path, "rb") as stream:
        step = max(os.fstat(stream.fileno()).st_size + 1, MB)  # `read` allocates as much memory as it is asked for
        while chunk := stream.read(min(step, remaining)):
            chunks.append(chunk)
            remaining -= len(chunk)
        if not remaining:
            raise _too_large(path, most)
    return b"".join(chunks)


def require_size(path: str | Path, most: int) -> None:
    """Refuse a file that is too large; for files that another program's library reads.

    Raises
    ------
    OSError
        The file is larger than ``most`` bytes.
    """
    if Path(path).stat().st_size > most:
        raise _too_large(path, most)


def _too_large(path: str | Path, most: int) -> OSError:
    size = f"{Path(path).stat().st_size / MB:.0f} MB" if Path(path).is_file() else "no end"
    return OSError(errno.EFBIG, f"{size}, at most {most // MB} MB are read", str(path))
