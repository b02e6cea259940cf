"""``stcal-run.json``: the marker of a run's folder, with the hashes of all that the run made."""

import hashlib
import json
import os
import stat
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

import stcal
from stcal.io.json import ResultFile
from stcal.io.saving import RUN_MARKER
from stcal.sfm.runs.options import RunOptions

ByFile = Annotated[str, "file"]


class MarkerFile(ResultFile):
    """Of a run's folder: what it was given."""

    program: Literal["stcal-sfm"] = Field(description="that made the folder")
    version: str = Field(description="of stcal")
    images: str = Field(description="the folder of photographs")
    options: dict[str, Any] | None = Field(description="of the run; null for `detect`")
    sha256: dict[ByFile, str] | None = Field(
        default=None,
        description="path below the folder → SHA-256 (hex) of every file of the results, and of this one without its "
        "own entry; absent until the run has ended well",
    )

    @classmethod
    def of(cls, images: str | Path, options: RunOptions | None) -> "MarkerFile":
        """The marker of a run, or of a detection alone, that begins."""
        return cls(
            program="stcal-sfm",
            version=stcal.__version__,
            images=str(Path(images).absolute()),
            options=None if options is None else asdict(options),
        )

    def sealed(self, digests: dict[str, str]) -> "MarkerFile":
        """The marker of results with these hashes, its own among them."""
        others = {name: value for name, value in digests.items() if name != RUN_MARKER}
        content = self.model_copy(update={"sha256": others}).content()
        return self.model_copy(update={"sha256": {RUN_MARKER: own_digest(content), **others}})


def own_digest(content: dict[str, Any]) -> str:
    """SHA-256 of a marker's content, less its own entry among the hashes."""
    others = {name: value for name, value in content["sha256"].items() if name != RUN_MARKER}
    return hashlib.sha256(json.dumps(content | {"sha256": others}, sort_keys=True).encode()).hexdigest()


def files_below(folder: Path) -> Iterator[str]:
    """Paths of all files and links below a folder, with forward slashes; links are not followed."""
    for place, folders, files in os.walk(folder):
        for name in (*files, *(each for each in folders if os.path.islink(os.path.join(place, each)))):
            yield (Path(place) / name).relative_to(folder).as_posix()


def digest_of(path: Path) -> str:
    """SHA-256 of a file, read piece by piece; empty of what is no file but a link, a folder, a pipe or nothing."""
    if not (os.path.lexists(path) and stat.S_ISREG(path.lstat().st_mode)):
        return ""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
