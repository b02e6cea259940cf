"""Cache of results between runs: arrays and plain values in one file, with what they were made from and a checksum.

A file's name is the hash of its inputs. A file that is damaged, was edited, or lies under the name of another one is
not used: it is made again, and a note says so.
"""

import functools
import hashlib
import importlib.metadata
import io
import json
import shutil
import threading
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import stcal
from stcal.errors import InputNote, StcalError
from stcal.io.files import TABLE_BYTES, read_bytes, save

R = TypeVar("R")
META, MADE_FROM, CHECKSUM = "meta", "made_from", "checksum"
DAMAGE = (OSError, ValueError, LookupError, EOFError, TypeError, zipfile.BadZipFile, zlib.error, StcalError)
"""Exceptions of reading a file, or of rebuilding its result, if the file is truncated or of another form."""
_parsing = threading.Lock()
"""A lock for parsing heads of arrays, which fails in several threads (github.com/python/cpython/issues/106905)."""


@functools.cache
def made_by() -> str:
    """Return the versions of the packages on which results depend, as a part of their keys."""
    return " ".join([stcal.__version__, *map(importlib.metadata.version, ("numpy", "scipy", "pycolmap"))])


def packed(key: str, arrays: Mapping[str, Any], meta: dict[str, Any]) -> bytes:
    """Return the content of a file that :func:`kept` reads; ``key`` : hash of its inputs, by which it is called."""
    content = {name: np.asarray(values) for name, values in arrays.items()}
    content[META] = _bytes(json.dumps(meta | {MADE_FROM: key}).encode())
    stream = io.BytesIO()
    np.savez(stream, **content | {CHECKSUM: _bytes(_digest(content))})  # type: ignore[arg-type]
    return stream.getvalue()


def keep(path: Path, arrays: Mapping[str, Any], meta: dict[str, Any]) -> None:
    """Save arrays by name, and plain values ``meta``, to a file that :func:`kept` reads."""
    keep_packed(path, packed(path.stem, arrays, meta))


def keep_packed(path: Path, content: bytes) -> None:
    """Save what :func:`packed` returns, also in the place of a folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    save(path, content)


def kept(path: Path, make: Callable[[Mapping[str, np.ndarray], dict[str, Any]], R]) -> R | None:
    """Return the result that ``make`` builds from the arrays and values of a file; None if there is no such file, or,
    with a note, if it is damaged, edited, or was made from other inputs."""
    try:
        if path.exists() and not path.is_file():  # a named pipe would never end
            raise ValueError("no file")
        with np.load(io.BytesIO(read_bytes(path, TABLE_BYTES))) as stored:
            if sum(part.file_size for part in stored.zip.infolist()) > TABLE_BYTES:
                raise ValueError("too large")
            with _parsing:
                content = dict(stored)
        fault = "" if content.pop(CHECKSUM).tobytes() == _digest(content) else "edited"
        meta = json.loads(content[META].tobytes())
        if meta.pop(MADE_FROM) == path.stem and not fault:
            return make(content, meta)
        fault = fault or "made from other inputs"
    except FileNotFoundError:
        return None
    except DAMAGE:
        fault = "damaged"
    warnings.warn(f"cache: {path.name} is {fault}; it is not used and made anew", InputNote, stacklevel=2)
    return None


def _bytes(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)


def _digest(content: Mapping[str, np.ndarray]) -> bytes:
    hasher = hashlib.sha256()
    for name, values in sorted(content.items()):
        hasher.update(f"{name}\0{values.dtype.str}\0{values.shape}\0".encode() + values.tobytes())
    return hasher.digest()
