"""``stcal-run.json``: the marker of a run's folder."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

import stcal
from stcal.io.json import ResultFile
from stcal.sfm.run.options import RunOptions


class MarkerFile(ResultFile):
    """Of a run's folder: what it was given."""

    program: Literal["stcal-sfm"] = Field(description="that made the folder")
    version: str = Field(description="of stcal")
    images: str = Field(description="the folder of photographs")
    options: dict[str, Any] | None = Field(description="of the run; null for `detect`")

    @classmethod
    def of(cls, images: str | Path, options: RunOptions | None) -> "MarkerFile":
        """The marker of a run, or of a detection alone, that begins."""
        return cls(
            program="stcal-sfm",
            version=stcal.__version__,
            images=str(Path(images).absolute()),
            options=None if options is None else asdict(options),
        )
