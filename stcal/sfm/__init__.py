"""From a folder of images to the calibrated target; read ``pipeline.py`` first."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stcal.sfm.pipeline import run
    from stcal.sfm.result import RunOptions, RunResult

__all__ = ["RunOptions", "RunResult", "run"]


def __getattr__(name: str):
    """Import on demand: processes that only detect need neither COLMAP nor the adjustment."""
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from stcal.sfm import pipeline, result

    return getattr(pipeline if name == "run" else result, name)
