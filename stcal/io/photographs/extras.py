"""HEIC and raw photographs, which optional packages decode: extras ``heic`` and ``raw``."""

import struct
from importlib.util import find_spec
from io import BytesIO
from types import ModuleType

import cv2
import numpy as np

from stcal.errors import InputError

HEIC = (".heic", ".heif", ".hif")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
_HEIC = "export it as JPEG of its full size, not edited"
_RAW = "develop it to TIFF without correction of the lens, crop or turn"
EXTRAS = {
    **dict.fromkeys(HEIC, ("pillow_heif", "heic", "a HEIC photograph", _HEIC)),
    **dict.fromkeys(RAW, ("rawpy", "raw", "a raw photograph", _RAW)),
}
"""Optional photographs by suffix: package that reads them, extra that installs it, what they are, a way without."""
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""Brands of HEIC files, in the bytes 8 to 12."""
DNG_VERSION = 50706
"""Tag of a TIFF that is a raw photograph."""


def readable() -> tuple[str, ...]:
    """Return the suffixes whose package is installed."""
    return tuple(suffix for suffix, (package, *_) in EXTRAS.items() if find_spec(package) is not None)


def reason_unread(suffix: str) -> str:
    """Return why a photograph of this suffix is not read, and what to do; for suffixes whose package is missing."""
    _, extra, what, remedy = EXTRAS[suffix]
    return f"{what}, which is read after `pip install 'stereo-target-calibration[{extra}]'`; or {remedy}"


def is_heic(data: bytes) -> bool:
    """Return True for the bytes of a HEIC photograph, whatever its name."""
    return data[4:8] == b"ftyp" and data[8:12] in HEIC_BRANDS


def require_heic(name: str) -> ModuleType:
    """Return the package that reads HEIC.

    Raises InputError: it is not installed; the message begins with ``name``.
    """
    if find_spec("pillow_heif") is None:
        raise InputError("E-IMAGE-EXTRA", f"{name}: {reason_unread('.heic')}")
    import pillow_heif

    return pillow_heif


def heic_grey(data: bytes, name: str) -> np.ndarray:
    """Return the grey pixels of a HEIC photograph as they are stored, without the rotation that its container states.

    Raises InputError: the package is missing, or the data are damaged or mirrored.
    """
    package = require_heic(name)
    try:
        image = np.asarray(package.open_heif(data, convert_hdr_to_8bit=False))
    except Exception as error:  # damaged containers fail in many ways
        raise InputError("E-IMAGE-UNREADABLE", f"{name}: not readable as HEIC; copy it again") from error
    if b"imir" in _properties(data):
        raise InputError("E-IMAGE-TYPE", f"{name}: its container mirrors the image; {_HEIC}")
    return _grey(np.rot90(image, -heic_turns(data)))


def _properties(data: bytes) -> bytes:
    """Return the part of a HEIC file that describes its images."""
    start = data.find(b"meta")
    return data[start : start + int.from_bytes(data[max(start - 4, 0) : start], "big")] if start >= 0 else b""


def heic_turns(data: bytes) -> int:
    """Return the quarter turns to the left by which the container of a HEIC photograph turns the stored pixels."""
    properties = _properties(data)
    at = properties.find(b"irot")
    return properties[at + 4] & 3 if 0 <= at < len(properties) - 4 else 0


def is_dng(data: bytes) -> bool:
    """Return True for a TIFF whose first directory has the tag of a DNG."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None or len(data) < 8:
        return False
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    count = struct.unpack_from(f"{order}H", data, at)[0] if at + 2 <= len(data) else 0
    places = range(at + 2, min(at + 2 + 12 * count, len(data) - 1), 12)
    return any(struct.unpack_from(f"{order}H", data, place)[0] == DNG_VERSION for place in places)


def raw_grey(data: bytes, name: str) -> np.ndarray:
    """Return the grey pixels of a raw photograph, uint16, proportional to the light, without rotation or correction.

    Raises InputError: the package is missing, or cannot read the file.
    """
    if find_spec("rawpy") is None:
        raise InputError("E-IMAGE-EXTRA", f"{name}: {reason_unread('.dng')}")
    import rawpy

    try:
        with rawpy.imread(BytesIO(data)) as raw:
            image = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                output_bps=16,
                user_flip=0,
                use_camera_wb=True,
                output_color=rawpy.ColorSpace.raw,  # type: ignore[attr-defined]
            )
    except rawpy.LibRawError as error:  # type: ignore[attr-defined]
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise InputError(
            "E-IMAGE-UNREADABLE", f"{name}: not readable as a raw photograph ({reason}); copy it again, or develop it"
        ) from error
    return _grey(image)


def _grey(image: np.ndarray) -> np.ndarray:
    image = np.ascontiguousarray(image)
    if image.ndim == 3 and image.shape[2] >= 3:
        return cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY)
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., 0])
