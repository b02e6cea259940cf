"""Whether a file of an image is whole: decoders silently make up what is missing."""

import re
import zlib

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
