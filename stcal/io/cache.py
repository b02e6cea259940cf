"""Cache of results between runs: arrays and plain values in one file; a damaged file is ignored."""

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from stcal.errors import StcalError
from stcal.io.files import TABLE_BYTES, read_bytes, save

R = TypeVar("R")
META = "meta"
DAMAGE = (OSError, ValueError, LookupError, EOFError, TypeError, zipfile.BadZipFile, zlib.error, StcalError)
"""Exceptions of reading a file, or of rebuilding its result, if the file is missing, truncated or of another form."""


def packed(arrays: Mapping[str, Any], meta: dict[str, Any]) -> bytes:
    """Return the content of a file that :func:`kept` reads: arrays by name, and plain values ``meta``."""
    stream = io.BytesIO()
    np.savez(stream, **{**arrays, META: np.frombuffer(json.dumps(meta).encode(), np.uint8)})
    return stream.getvalue()


def keep(path: Path, arrays: Mapping[str, Any], meta: dict[str, Any]) -> None:
    """Save arrays by name, and plain values ``meta``, to a file that :func:`kept` reads."""
    save(path, packed(arrays, meta))


def kept(path: Path, make: Callable[[Mapping[str, np.ndarray], dict[str, Any]], R]) -> R | None:
    """Return the result that ``make`` builds from the arrays and values of a file; None if it is missing or damaged."""
    try:
        with np.load(io.BytesIO(read_bytes(path, TABLE_BYTES))) as stored:
            if sum(part.file_size for part in stored.zip.infolist()) > TABLE_BYTES:
                return None
            return make(stored, json.loads(stored[META].tobytes()))
    except DAMAGE:
        return None
