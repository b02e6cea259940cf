"""Readers of NumPy's files npy and npz that never execute code from the file."""

import io
import tokenize
import zipfile
import zlib
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.io.files import MB, TABLE_BYTES

NPY, NPZ = b"\x93NUMPY", b"PK\x03\x04"
"""First bytes of the files."""
DAMAGED = (ValueError, TypeError, EOFError, OSError, MemoryError, OverflowError, SyntaxError, tokenize.TokenError)
"""Errors that NumPy raises for damaged files, whose heads are literals of Python."""


def load_npy(data: bytes, where: str) -> np.ndarray:
    """Returns the array of an npy file.

    Raises InputError: the file is damaged, or holds objects, which only a program could load.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = read(stream)
    except DAMAGED as error:
        raise _damaged(where, error) from error
    if kind.hasobject or kind.kind not in "iuf":
        raise InputError(
            "E-NUMPY-CONTENT", f"{where}: an array of {kind}, numbers needed; save it with np.save of a float array"
        )
    available, needed = len(data) - stream.tell(), int(np.prod([int(n) for n in shape], dtype=object)) * kind.itemsize
    if available != needed:
        raise InputError(
            "E-NUMPY-UNREADABLE", f"{where}: {available} bytes of numbers, {needed} needed by its head; save it again"
        )
    if not shape or not needed:
        raise InputError("E-NUMPY-CONTENT", f"{where}: an array of shape {shape}; poses needed")
    try:
        return np.array(np.load(io.BytesIO(data), allow_pickle=False), dtype=float)
    except DAMAGED as error:
        raise _damaged(where, error) from error


def load_npz(data: bytes, where: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Returns the arrays of an npz file by name, and the names of those that are not numbers.

    Raises InputError: the file is damaged, or larger than any such file is when unpacked.
    """
    arrays, others = {}, []
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            size = sum(member.file_size for member in members)
            if size > TABLE_BYTES:
                raise InputError(
                    "E-FILE-TOO-LARGE", f"{where}: {size / MB:.0f} MB unpacked, at most {TABLE_BYTES // MB} MB are read"
                )
            for member in members:
                with archive.open(member) as stream:
                    content = stream.read(TABLE_BYTES + 1)
                name = member.filename.removesuffix(".npy")
                if _is_text(content):
                    arrays[name] = _texts(content)
                    continue
                try:
                    arrays[name] = load_npy(content, f"{where}: {name}")
                except InputError:
                    others.append(name)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, *DAMAGED) as error:
        raise _damaged(where, error) from error
    if not arrays:
        raise InputError("E-NUMPY-CONTENT", f"{where}: no arrays of numbers; save it with np.savez")
    return arrays, tuple(others)


def _is_text(content: bytes) -> bool:
    return b"'descr': '<U" in content[:128]


def _texts(content: bytes) -> list[str]:
    """Returns the strings of an array, which are mostly names of images."""
    try:
        return [str(text) for text in np.load(io.BytesIO(content), allow_pickle=False).ravel()]
    except MemoryError as error:
        raise ValueError("a head that is larger than its file") from error


def _damaged(where: str, error: Exception) -> InputError:
    return InputError(
        "E-NUMPY-UNREADABLE", f"{where}: not a file of NumPy ({' '.join(str(error).split())[:80]}); save it again"
    )
