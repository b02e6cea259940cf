"""Files that appear complete or not at all, and that replace no input."""

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from stcal.errors import InputError


def save(path: Path, content: str | bytes) -> None:
    """Write a file at once, its folder too where there is none.

    Raises
    ------
    InputError
        It cannot be written.
    """
    if not path.name or path.is_dir():
        raise InputError(f"{path}: is a folder; the name of a file needed")
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(partial, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; check the folder's space and rights, or give "
            "another place"
        ) from error
    finally:
        with suppress(OSError):  # where a file stands in the folder's place there is none to remove
            partial.unlink(missing_ok=True)


def json_text(content) -> str:
    """As all JSON files of the package are written: of a dict, or of a result file (``stcal.io.json.ResultFile``)."""
    plain = content if isinstance(content, dict) else content.content()
    return json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def keep_apart(outputs: dict[str, Path | None], inputs: Sequence[Path | None]) -> None:
    """Refuse, before the work, files that would replace an input or each other.

    Parameters
    ----------
    outputs : by option

    Raises
    ------
    InputError
        Which, and what they would replace.
    """
    places: dict[Path, str] = {}
    own = {path.resolve() for path in inputs if path}
    for option, path in outputs.items():
        if not path:
            continue
        place = path.resolve()
        if place in own:
            raise InputError(f"{option} {path}: is an input of this command; give another name")
        if place in places:
            raise InputError(f"{option} {path}: is also what {places[place]} writes; give each its own name")
        if place.is_dir():
            raise InputError(f"{option} {path}: is a folder; the name of a file needed")
        places[place] = option
