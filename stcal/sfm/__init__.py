"""From a folder of images to the calibrated target; read ``pipeline.py`` first."""

from stcal.sfm.pipeline import run
from stcal.sfm.result import RunOptions, RunResult

__all__ = ["RunOptions", "RunResult", "run"]
