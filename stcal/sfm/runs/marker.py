"""The marker of a run's folder: the input of the run, and the hashes of its files."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

import stcal
from stcal.io.files import RUN_MARKER, own_digest
from stcal.io.json import ResultFile
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
