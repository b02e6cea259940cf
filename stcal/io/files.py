"""Reading of files within a size limit, and writing: completely or not at all, never over an input, and read again."""

import codecs
import errno
import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from stcal.errors import ConvergenceError, InputError, StcalError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

MB = 1_000_000
SETTINGS_BYTES = 10 * MB
"""Largest size of a file that people write: camera, designs, robot, layout."""
TABLE_BYTES = 100 * MB  # largest size of tables and result files
COMPACT_FROM = TABLE_BYTES // 10  # length from which JSON is written without line breaks
IMAGE_BYTES = 500 * MB
"""Largest size of an image file: 80 megapixels, 16 bit, colour, uncompressed."""
MODEL_BYTES = 1000 * MB  # largest size of a file of a COLMAP model


def read_bytes(path: str | Path, most: int) -> bytes:
    """Return the whole content of a file; raise OSError if it cannot be read, or is larger than ``most`` bytes."""
    chunks, remaining = [], most + 1
    with open(Path(path), "rb") as stream:  # a number is no path: it would be closed as one of the process's streams
        step = max(os.fstat(stream.fileno()).st_size + 1, MB)  # `read` allocates as much memory as it is asked for
        while chunk := stream.read(min(step, remaining)):
            chunks.append(chunk)
            remaining -= len(chunk)
        if not remaining:
            raise _too_large(path, most)
    return b"".join(chunks)


def text_of(content: bytes) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with a byte-order mark; each line ends in a line feed."""
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def require_size(path: str | Path, most: int) -> None:
    """Raise OSError for a file of more than ``most`` bytes, which another program's library is to read."""
    if Path(path).stat().st_size > most:
        raise _too_large(path, most)


def _too_large(path: str | Path, most: int) -> OSError:
    size = f"{Path(path).stat().st_size / MB:.0f} MB" if Path(path).is_file() else "no end"
    return OSError(errno.EFBIG, f"{size}, at most {most // MB} MB are read", str(path))


INTERNAL = ".stcal"
"""Hidden folder in a run's folder: its marker, the cache for later runs, and results that are being written."""
RUN_MARKER, CACHE = f"{INTERNAL}/run.json", f"{INTERNAL}/cache"
"""File that marks the folder of a run, and what later runs use again."""
CAMERA, TARGET, BOARD = "inputs/cameras.txt", "inputs/target.toml", "inputs/board.toml"
"""Copies of a run's inputs."""
DATABASE, MODELS, TARGET_MODEL = "colmap/database.db", "colmap/models", "colmap/target_model"
"""COLMAP's database, its models by group, and the final model in mm in the target frame."""
REFINED_CAMERA = "colmap/refined_cameras.txt"
"""Camera file with the intrinsics that a run refined, and their σ."""
REPORT_PDF, COMPARISON = "report.pdf", "compare.json"  # what `report --pdf` and `compare` add
_RESULTS, _OTHERS = ("faces.json", "report.json", "report.html"), ("labels.csv", "detections.csv", "overlays")
RUN_ENTRIES = (*_RESULTS, REPORT_PDF, COMPARISON, *_OTHERS, "colmap", "inputs", INTERNAL)
"""Files and folders of a run or, ``detections.csv`` and ``overlays``, of a detection alone."""
NEVER_READ = (".csv", ".json", ".html", ".pdf", ".svg")
"""Suffixes of outputs that no command reads from a folder, beside a run's entries."""


def unwritable(path: Path, error: OSError) -> InputError:
    """Return the error of a file or folder that cannot be written."""
    remedy = "check the folder's space and rights, or give another place"
    return InputError("E-OUTPUT-UNWRITABLE", f"{path}: cannot be written: {error.strerror or error}; {remedy}")


def save(path: Path, content: str | bytes) -> None:
    """Write a file atomically; a missing folder is made."""
    if not path.name or path.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{path}: is a folder; the name of a file needed")
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # names of files that are not UTF-8 hold surrogates: written as \udcff, which JSON reads back
        partial.write_bytes(content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content)
        os.replace(partial, path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        with suppress(OSError):  # if the folder's path is a file, there is nothing to remove
            partial.unlink(missing_ok=True)


def require_new_folder(out: Path, images: Path) -> None:
    """Refuse, before the work, an output folder that is not empty, lies among the photographs, or cannot be written."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("E-OUTPUT-EXISTS", f"--out {out}: is not a new or empty folder; give another place")
    if real_place(images) in (real_place(out), *real_place(out).parents):
        among = f"--out {out}: lies in the folder of the photographs {images}"
        raise InputError("E-OUTPUT-PLACE", f"{among}; give another place")
    above = next(parent for parent in out.absolute().parents if parent.exists())
    try:
        tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=above).cleanup()
    except OSError as error:
        raise unwritable(out, error) from error


def require_written(
    path: str | Path, read: "Callable[[], ArrayLike]", reported: "ArrayLike", most: float, unit: str
) -> None:
    """Read a written file with the reader of later commands, and require that it gives the values that were
    reported. ``reported`` : the same quantity from the result in memory, nan where there is none; ``most`` : largest
    difference, rounding by the decimals of the file; ``unit`` : of the values. Raises ConvergenceError."""
    difference = _difference(path, read, reported)
    if not difference <= most:
        differs = f"the file gives values that differ from those reported by up to {difference:.2g} {unit}"
        raise ConvergenceError("E-WRITTEN-DIFFERS", f"{path}: {differs}, {most:g} allowed; {DO_NOT_USE}")


DO_NOT_USE = "do not use the file, and report this with its data"


def _difference(path: str | Path, read: "Callable[[], ArrayLike]", reported: "ArrayLike") -> float:
    """Return the largest difference between a file and the reported values; infinite for another shape."""
    import numpy as np

    try:
        again, values = np.asarray(read(), float), np.asarray(reported, float)
    except (StcalError, OSError, LookupError, ValueError, SyntaxError) as error:
        unread = f"{path}: written, and cannot be read again: {error}; {DO_NOT_USE}"
        raise ConvergenceError("E-WRITTEN-DIFFERS", unread) from error
    if again.shape != values.shape or (np.isnan(again) != np.isnan(values)).any():
        return float("inf")
    return float(np.nanmax(np.abs(again - values), initial=0.0))


def require_same(path: str | Path, read: Callable[[], object], content: object) -> None:
    """Read a written file again, and require that what is read equals ``content``: a text, or plain values."""
    require_written(path, lambda: 0.0 if read() == content else float("inf"), 0.0, 0.0, "(content)")


def require_text_written(path: str | Path, text: str) -> None:
    """Read a written text again, and require that it is the same."""
    require_same(path, lambda: read_bytes(path, TABLE_BYTES), text.encode("utf-8", "backslashreplace"))


def save_folder(out: Path, files: dict[str, str]) -> None:
    """Write all files into a new folder, or none of them."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as folder:
        made = Path(folder) / "made"
        for name, content in files.items():
            save(made / name, content)
        try:
            made.replace(out)
        except OSError as error:
            raise unwritable(out, error) from error


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file, read piece by piece; empty for a link, a folder, a pipe, or nothing."""
    if not (os.path.lexists(path) and stat.S_ISREG(path.lstat().st_mode)):
        return ""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def own_digest(content: dict) -> str:
    """Returns the SHA-256 of a marker's content without its own entry among the hashes."""
    others = {name: value for name, value in content["sha256"].items() if name != RUN_MARKER}
    return hashlib.sha256(json.dumps(content | {"sha256": others}, sort_keys=True).encode()).hexdigest()


def require_unchanged(path: str | Path) -> None:
    """Refuses a file of a run's folder that is not as the run left it, by the hash in the run's marker; others pass."""
    path = Path(path)
    run = next((folder for folder in path.parents[:3] if (folder / RUN_MARKER).is_file()), path.parent)
    name = path.relative_to(run).as_posix()
    try:
        marker = json.loads(text_of(read_bytes(run / RUN_MARKER, TABLE_BYTES)))
        known = marker["sha256"][name]
        found = own_digest(marker) if name == RUN_MARKER else digest_of(path)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return
    if found != known:
        changed = f"{path}: changed since its run ended; take a copy that is whole, or run it again"
        raise InputError("E-RUN-CHANGED", changed)


def json_text(content) -> str:
    """Return the text of a JSON file in the package's form; ``content`` : dict or ``stcal.io.json.ResultFile``."""
    plain = content if isinstance(content, dict) else content.content()
    text = json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if len(text) > COMPACT_FROM:
        text = json.dumps(plain, separators=(",", ":"), ensure_ascii=False, allow_nan=False) + "\n"
    if len(text) > TABLE_BYTES:
        size = f"a result would have {len(text) / MB:.0f} MB, at most {TABLE_BYTES // MB} MB are read"
        raise InputError("E-OUTPUT-SIZE", f"{size}; give fewer rows")
    return text


def keep_apart(outputs: Sequence[tuple[str, Path]], inputs: Sequence[tuple[str, Path]]) -> None:
    """Refuse, before the work, outputs (option, path) that would replace an input, a file of it, or each other."""
    places: dict[Path, str] = {}
    for option, path in outputs:
        place, what = real_place(path), f"{option} {path}"
        for given, read in inputs:
            folder = real_place(read)
            if place == folder:
                raise InputError("E-OUTPUT-IS-INPUT", f"{what}: is an input of this command; give another name")
            if folder in place.parents and place.exists() and _is_read(place, folder):
                raise InputError("E-OUTPUT-IS-INPUT", f"{what}: is a file of {given} {read}; give another name")
        if place in places:
            raise InputError("E-OUTPUT-TWICE", f"{what}: is also what {places[place]} writes; give each its own name")
        if place.is_dir():
            raise InputError("E-OUTPUT-FOLDER", f"{what}: is a folder; the name of a file needed")
        places[place] = option


def real_place(path: str | Path) -> Path:
    """Return the path with all links resolved; a circular link stays as it is, and is reported when it is read."""
    return Path(os.path.realpath(path))


def _is_read(place: Path, folder: Path) -> bool:
    if (folder / RUN_MARKER).exists():
        return place.relative_to(folder).parts[0] in RUN_ENTRIES
    return place.name in RUN_ENTRIES or place.suffix.lower() not in NEVER_READ
