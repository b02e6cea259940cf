"""What decoders leave out: whether a photograph's file is whole; HEIC; what is a mosaic of colours or a raw file."""

import re
import zlib
from importlib.util import find_spec
from io import BytesIO

import cv2
import numpy as np
from PIL import Image, ImageFile

from stcal.errors import InputError

_JPEG_MARKER = re.compile(rb"\xff[\x01-\xcf\xd8-\xfe]")
"""A JPEG marker other than a restart marker, which occurs inside a scan."""


def is_png(data: bytes) -> bool:
    """Return True if the file begins as a PNG."""
    return data[:8] == b"\x89PNG\r\n\x1a\n"


def png_intact(data: bytes) -> bool:
    """Return True if the checksums of all chunks are right."""
    at = 8
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False


def ends_properly(data: bytes) -> bool:
    """Return True if a JPEG, PNG or BMP is complete: decoders silently fill in missing data."""
    if data[:2] == b"\xff\xd8":
        return _jpeg_ends(data)
    if is_png(data):
        return data.rfind(b"IEND") > 0
    if data[:2] == b"BM" and len(data) >= 6:
        return len(data) >= int.from_bytes(data[2:6], "little")
    return True


def _jpeg_ends(data: bytes) -> bool:
    """Return True if the end marker of the main image exists; an embedded thumbnail or appended video has its own."""
    at = 2
    while marker := _JPEG_MARKER.search(data, at):
        kind, at = data[marker.end() - 1], marker.end()
        if kind == 0xD9:
            return True
        if kind not in (0x01, 0xD8):
            at += max(int.from_bytes(data[at : at + 2], "big"), 2)
    return False


LEAST_COLOUR = 0.05
"""Smallest relative difference between neighbours of two colours that tells a mosaic."""
GREEN_ALIKE = 0.3
"""Largest difference between both greens, as a share of that between green and the other colours."""
TRIED_PX = 1024  # side of the middle of the image that is judged, px


def patterns_seen(image: np.ndarray) -> tuple[str, ...]:
    """Return the patterns that a grey image may be a mosaic of: two, as red and blue look alike; none if it is none.
    Both greens, on one diagonal of each 2×2 pixels, are alike, and another colour differs all over the image, which
    medians show: the scene favours no pixel of the four."""
    height, width = (min(side, TRIED_PX) // 2 * 2 for side in image.shape)
    if not height or not width:
        return ()
    top, left = ((side - part) // 4 * 2 for side, part in zip(image.shape, (height, width), strict=True))
    grey = image[top : top + height, left : left + width].astype(np.float32)
    a, b, c, d = grey[::2, ::2], grey[::2, 1::2], grey[1::2, ::2], grey[1::2, 1::2]
    total = a + b + c + d
    bright = total >= max(float(np.median(total)), 1.0)
    if not bright.any():
        return ()

    def apart(one: np.ndarray, two: np.ndarray) -> float:
        return float(np.median((one - two)[bright] / total[bright])) * 4

    for greens, others, patterns in (((b, c), (a, d), ("RGGB", "BGGR")), ((a, d), (b, c), ("GRBG", "GBRG"))):
        colour = max(min(abs(apart(other, green)) for green in greens) for other in others)
        if colour > LEAST_COLOUR and abs(apart(*greens)) < GREEN_ALIKE * colour:
            return patterns
    return ()


HEIC = (".heic", ".heif", ".hif")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
EXPORT = "export it as JPEG of its full size, not edited"
UNREAD = {
    **dict.fromkeys(
        HEIC, "a HEIC photograph, which is read after `pip install 'stereo-target-calibration[heic]'`; or " + EXPORT
    ),
    **dict.fromkeys(RAW, "a raw photograph; develop it to TIFF or PNG without correction of the lens, crop or turn"),
}
"""What photographs of these suffixes are, and what to do where they are not read."""
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""Brands of HEIC files, in the bytes 8 to 12."""
DNG_VERSION = 50706  # tag of a TIFF that is a raw photograph


def readable() -> tuple[str, ...]:
    """Return the suffixes whose package is installed."""
    return HEIC if find_spec("pillow_heif") else ()


def is_heic(data: bytes) -> bool:
    """Return True for the bytes of a HEIC photograph, whatever its name."""
    return data[4:8] == b"ftyp" and data[8:12] in HEIC_BRANDS


def let_pillow_read_heic(name: str) -> None:
    """Register the package that reads HEIC with Pillow."""
    if find_spec("pillow_heif") is None:
        raise InputError("E-IMAGE-EXTRA", f"{name}: {UNREAD['.heic']}")
    import pillow_heif

    pillow_heif.register_heif_opener()


def heic_grey(data: bytes, name: str) -> np.ndarray:
    """Return the grey pixels of a HEIC photograph as they are stored, without the turn that its container states."""
    let_pillow_read_heic(name)
    lenient, ImageFile.LOAD_TRUNCATED_IMAGES = ImageFile.LOAD_TRUNCATED_IMAGES, False  # WeasyPrint turns it on
    try:
        with Image.open(BytesIO(data)) as image:
            colours = np.asarray(image.convert("RGB"))
    except Exception as error:  # damaged containers fail in many ways
        raise InputError("E-IMAGE-UNREADABLE", f"{name}: not readable as HEIC; copy it again") from error
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = lenient
    if b"imir" in _properties(data):
        raise InputError("E-IMAGE-TYPE", f"{name}: its container mirrors the image; {EXPORT}")
    return np.ascontiguousarray(np.rot90(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), -heic_turns(data)))


def _properties(data: bytes) -> bytes:
    start = data.find(b"meta")
    return data[start : start + int.from_bytes(data[max(start - 4, 0) : start], "big")] if start >= 0 else b""


def heic_turns(data: bytes) -> int:
    """Return the quarter turns to the left by which the container of a HEIC photograph turns the stored pixels."""
    properties = _properties(data)
    at = properties.find(b"irot")
    return properties[at + 4] & 3 if 0 <= at < len(properties) - 4 else 0


def is_dng(data: bytes) -> bool:
    """Return True for a TIFF whose first directory has the tag of a DNG."""
    tags = Image.Exif()
    try:
        tags.load(data)
    except Exception:  # damaged directories fail in many ways
        return False
    return DNG_VERSION in tags
