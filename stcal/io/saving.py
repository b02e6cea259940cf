"""Files that appear complete or not at all, and that replace no input."""

import json
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

from stcal.errors import InputError

RUN_MARKER = "stcal-run.json"
"""Tells a run's folder from others."""
CAMERA, TARGET, BOARD = "cameras.txt", "target.toml", "board.toml"
"""Copies of what a run was given."""
REFINED_CAMERA = "refined_cameras.txt"
"""As a run adjusted it, where it did, with σ."""
REPORT_PDF = "report.pdf"
"""Of a run's report.html, where one was asked for."""
RUN_ENTRIES = (
    RUN_MARKER,
    "faces.json",
    "report.json",
    "report.html",
    REPORT_PDF,
    "labels.csv",
    "detections.csv",
    "database.db",
    CAMERA,
    REFINED_CAMERA,
    TARGET,
    BOARD,
    "models",
    "target_model",
    "overlays",
)
"""What a run makes, in the order in which it takes its place: the marker says what the rest is."""
UNFINISHED, ADDED, READY, CACHE = "unfinished", "added", "ready", "cache"
"""Folders in it: of a run that is going on, of files that a command adds to a finished one, of results about to take
their places, of what later runs take up."""
NEVER_READ = (".csv", ".json", ".html", ".pdf", ".svg")
"""Suffixes of outputs; but for a run's entries, what commands read from a folder are images, YAML poses, and COLMAP's
models and databases."""


def save(path: Path, content: str | bytes) -> None:
    """Write a file at once, its folder too where there is none.

    Raises
    ------
    InputError
        It cannot be written.
    """
    if not path.name or path.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{path}: is a folder; the name of a file needed")
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(partial, path)
    except OSError as error:
        raise InputError(
            "E-OUTPUT-UNWRITABLE",
            f"{path}: cannot be written: {error.strerror or error}; check the folder's space and rights, or give "
            "another place",
        ) from error
    finally:
        with suppress(OSError):  # where a file stands in the folder's place there is none to remove
            partial.unlink(missing_ok=True)


def require_new_folder(out: Path, images: Path) -> None:
    """Refuse, before the work, a place that holds anything, that lies among the photographs or cannot be written.

    Raises
    ------
    InputError
        Which.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("E-OUTPUT-EXISTS", f"--out {out}: is not a new or empty folder; give another place")
    if real_place(images) in (real_place(out), *real_place(out).parents):
        raise InputError(
            "E-OUTPUT-PLACE", f"--out {out}: lies in the folder of the photographs {images}; give another place"
        )
    above = next(each for each in out.absolute().parents if each.exists())
    try:
        tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=above).cleanup()
    except OSError as error:
        raise InputError(
            "E-OUTPUT-UNWRITABLE", f"--out {out}: cannot be written: {error.strerror or error}; give another place"
        ) from error


def save_folder(out: Path, files: dict[str, str]) -> None:
    """Write all files into a new folder, or none.

    Raises
    ------
    InputError
        They cannot be written.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as folder:
        made = Path(folder) / "made"
        for name, content in files.items():
            save(made / name, content)
        try:
            made.replace(out)
        except OSError as error:
            raise InputError(
                "E-OUTPUT-UNWRITABLE", f"{out}: cannot be written: {error.strerror or error}; give another place"
            ) from error


def json_text(content) -> str:
    """As all JSON files of the package are written: of a dict, or of a result file (``stcal.io.json.ResultFile``)."""
    plain = content if isinstance(content, dict) else content.content()
    return _indented(plain, "\n") + "\n"


_encode = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode
PLAIN = {float, int, bool, type(None)}
"""Types whose text holds neither a comma nor a bracket."""


def _indented(value, line: str) -> str:
    """The text of ``json.dumps`` with ``indent=1``, whose writer works on one number after the other: lists of numbers,
    and lists of such lists, are written at once. ``line`` : a line's end and the indent of what follows."""
    inner = line + " "
    if isinstance(value, dict):
        items = [f"{_key(key)}: {_indented(each, inner)}" for key, each in value.items()]
        return f"{{{inner}{f',{inner}'.join(items)}{line}}}" if items else "{}"
    if not isinstance(value, list | tuple):
        return _encode(value)
    if not value:
        return "[]"
    kinds = set(map(type, value))
    if kinds <= PLAIN:
        return f"[{inner}{_encode(value)[1:-1].replace(',', f',{inner}')}{line}]"
    if kinds == {list} and all(value) and set(map(type, chain.from_iterable(value))) <= PLAIN:
        ends, between = f"{inner}]", f"{inner} "
        rows = _encode(value)[2:-2].replace(",", f",{between}").replace(f"],{between}[", f"{ends},{inner}[{between}")
        return f"[{inner}[{between}{rows}{ends}{line}]"
    return f"[{inner}{f',{inner}'.join([_indented(each, inner) for each in value])}{line}]"


def _key(key) -> str:
    """As ``json.dumps`` writes it: numbers in quotes."""
    return _encode(key) if isinstance(key, str) else _encode({key: 0})[1:-3]


def keep_apart(outputs: Sequence[tuple[str, Path]], inputs: Sequence[tuple[str, Path]]) -> None:
    """Refuse, before the work, files that would replace an input, a file among the inputs, or each other.

    Parameters
    ----------
    outputs, inputs : (option, path); an input may be a folder

    Raises
    ------
    InputError
        Which, and what it would replace.
    """
    places: dict[Path, str] = {}
    for option, path in outputs:
        place = real_place(path)
        for given, read in inputs:
            own = real_place(read)
            if place == own:
                raise InputError(
                    "E-OUTPUT-IS-INPUT", f"{option} {path}: is an input of this command; give another name"
                )
            if own in place.parents and place.exists() and not _is_ours(place, own):
                raise InputError(
                    "E-OUTPUT-IS-INPUT", f"{option} {path}: is a file of {given} {read}; give another name"
                )
        if place in places:
            raise InputError(
                "E-OUTPUT-TWICE", f"{option} {path}: is also what {places[place]} writes; give each its own name"
            )
        if place.is_dir():
            raise InputError("E-OUTPUT-FOLDER", f"{option} {path}: is a folder; the name of a file needed")
        places[place] = option


def real_place(path: str | Path) -> Path:
    """Where a path leads; links that lead to themselves stay as they are, for who reads to say."""
    return Path(os.path.realpath(path))


def _is_ours(place: Path, folder: Path) -> bool:
    """Whether no command reads a file that lies in an input folder: in a run's folder whatever no run makes, in one of
    images what has a table's or a page's suffix."""
    if (folder / RUN_MARKER).exists():
        return place.relative_to(folder).parts[0] not in {*RUN_ENTRIES, UNFINISHED, ADDED, READY, CACHE}
    return place.name not in RUN_ENTRIES and place.suffix.lower() in NEVER_READ
