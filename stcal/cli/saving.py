"""Files that commands write: complete or not at all."""

import json
import os
from pathlib import Path


def save(path: Path, content: str | bytes) -> None:
    """Write a file at once, its folder too, and say so."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    print(f"written: {path}")


def save_json(path: Path | None, content: dict) -> None:
    """Where a path is given."""
    if path:
        save(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
