"""Files that commands write, and say so."""

from collections.abc import Sequence
from pathlib import Path

from stcal.errors import InputError
from stcal.io import saving


def save(path: Path, content: str | bytes) -> None:
    """Write a file at once, complete or not at all."""
    saving.save(path, content)
    print(f"written: {path}")


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
    own = {path.resolve(): path for path in inputs if path}
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


def save_json(path: Path | None, content: dict) -> None:
    """Where a path is given."""
    if path:
        save(path, saving.json_text(content))
