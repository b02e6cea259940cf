"""Files that commands write, and say so."""

from pathlib import Path

from stcal import saving


def save(path: Path, content: str | bytes) -> None:
    """Write a file at once, complete or not at all."""
    saving.save(path, content)
    print(f"written: {path}")


def save_json(path: Path | None, content: dict) -> None:
    """Where a path is given."""
    if path:
        save(path, saving.json_text(content))
