"""Find the image files, group by group, and decode them: pixels as the sensor gave them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stcal.errors import InputError

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
TOP_GROUP = "."
"""Name of the group that images lying directly in the folder form."""
RUN_MARKER = "stcal-run.json"
"""A folder that holds this file is a run's output and never a group of images."""


@dataclass(frozen=True, slots=True)
class ImageFile:
    """One file: ``name`` is its path below the image folder, with forward slashes."""

    path: Path
    name: str
    group: str


@dataclass(frozen=True, slots=True)
class Skipped:
    """A file that is not used, and why."""

    name: str
    reason: str


def find_images(folder: str | Path) -> tuple[list[ImageFile], list[Skipped]]:
    """Image files below ``folder``, sorted by group and name, and the files that are none.

    Raises
    ------
    InputError
        The folder is missing, or holds no image.
    """
    root = Path(folder)
    if not root.is_dir():
        raise InputError(f"image folder {root}: {'not a folder' if root.exists() else 'does not exist'}; give a folder")
    files, skipped = [], []
    for path in sorted(root.iterdir(), key=lambda p: (p.is_dir(), p.name)):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            if not (path / RUN_MARKER).exists():
                for inner in sorted(path.iterdir(), key=lambda p: p.name):
                    _sort_in(inner, f"{path.name}/{inner.name}", path.name, files, skipped)
        else:
            _sort_in(path, path.name, TOP_GROUP, files, skipped)
    if not files:
        raise InputError(
            f"image folder {root}: no image ({', '.join(s[1:] for s in SUFFIXES)}); put them into {root}/<group>/"
        )
    return files, skipped


def _sort_in(path: Path, name: str, group: str, files: list, skipped: list) -> None:
    if path.name.startswith("."):
        return
    if path.is_dir():
        skipped.append(Skipped(name, "a folder inside a group; images lie in <group>/ directly"))
    elif path.suffix.lower() in SUFFIXES:
        files.append(ImageFile(path, name, group))
    else:
        skipped.append(Skipped(name, "not an image file"))


def decode(data: bytes, name: str) -> np.ndarray:
    """Grey image (height, width), uint8 or uint16, of an image file's bytes; EXIF orientation is ignored.

    Raises
    ------
    InputError
        Empty, truncated or unreadable data.
    """
    if not data:
        raise InputError(f"{name}: empty file (0 bytes); copy it again")
    if not _ends_properly(data):
        raise InputError(f"{name}: truncated ({len(data)} bytes); copy it again")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{name}: not readable as an image; convert it to one of {', '.join(SUFFIXES)}")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name}: pixels of type {image.dtype}; 8 or 16 bit needed")
    return image


def _ends_properly(data: bytes) -> bool:
    """Whether a JPEG, PNG or BMP is there to its end: decoders fill up what is missing without a word."""
    if data[:2] == b"\xff\xd8":
        # A marker inside entropy-coded data is escaped: the last scan must be followed by an end of image.
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return data.rfind(b"IEND") > 0
    if data[:2] == b"BM" and len(data) >= 6:
        return len(data) >= int.from_bytes(data[2:6], "little")
    return True
