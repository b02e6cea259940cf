"""The marker of a run's folder, ``stcal-run.json``, with the hashes of all files that the run made."""

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
    """Marker of a run's folder: the input of the run, and the hashes of its files."""

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
        """Returns the marker of a run, or of a detection alone, that begins."""
        return cls(
            program="stcal-sfm",
            version=stcal.__version__,
            images=str(Path(images).absolute()),
            options=None if options is None else asdict(options),
        )

    def sealed(self, digests: dict[str, str]) -> "MarkerFile":
        """Returns the marker of results with these hashes, which include its own."""
        others = {name: value for name, value in digests.items() if name != RUN_MARKER}
        content = self.model_copy(update={"sha256": others}).content()
        return self.model_copy(update={"sha256": {RUN_MARKER: own_digest(content), **others}})


def own_digest(content: dict[str, Any]) -> str:
    """Returns the SHA-256 of a marker's content without its own entry among the hashes."""
    others = {name: value for name, value in content["sha256"].items() if name != RUN_MARKER}
    return hashlib.sha256(json.dumps(content | {"sha256": others}, sort_keys=True).encode()).hexdigest()


def files_below(folder: Path) -> Iterator[str]:
    """Yields the paths of all files and links below a folder, with forward slashes; links are not followed."""
    for place, folders, files in os.walk(folder):
        for name in (*files, *(subfolder for subfolder in folders if os.path.islink(os.path.join(place, subfolder)))):
            yield (Path(place) / name).relative_to(folder).as_posix()


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file, read piece by piece; empty for a link, a folder, a pipe, or nothing."""
    if not (os.path.lexists(path) and stat.S_ISREG(path.lstat().st_mode)):
        return ""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
