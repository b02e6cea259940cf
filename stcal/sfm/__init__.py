"""From a folder of images to the calibrated target; read ``pipeline.py`` first."""

from stcal.sfm.pipeline import RunOptions, RunResult, run

__all__ = ["RunOptions", "RunResult", "run"]
