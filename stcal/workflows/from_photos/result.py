"""The results on the way from photographs to joint values."""

from dataclasses import dataclass

import numpy as np

from stcal.robot.axes.model import AxesResult
from stcal.robot.identification.predicted import predicted_at
from stcal.robot.identification.result import Identified
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import (
    Compensated,
)
from stcal.robot.use.evaluation import Figures
from stcal.sfm.measurement.images import MeasureResult

DRAWING, AXES, SAME_ROWS = "as drawn", "by the axis method", "identified, the same rows"


@dataclass(frozen=True, slots=True, eq=False)
class FromPhotos:
    """Results of all steps, from photographs to joint values.

    Parameters
    ----------
    images : str
        Folder of the photographs.
    measured : MeasureResult
        Poses of the target.
    nominal : Robot
        The arm as drawn.
    data : Measurements
        Poses with their joint values.
    axes : AxesResult or None
        Result of the axis method, where every joint is swept.
    without_axes : str
        Reason why there is no result of the axis method.
    identified : Identified
        Identification from all poses.
    compensated : Compensated or None
        Joint values for the targets, where there are any.
    errors : dict of str to Figures
        Position errors of the rows, mm: as drawn and by the axis method with base and tool fitted, identified, and of
        rows held out.
    notes : tuple of str
        Notes on rows and photographs that have no partner, and on the input.
    """

    images: str
    measured: MeasureResult
    nominal: Robot
    data: Measurements
    axes: AxesResult | None
    without_axes: str
    identified: Identified
    compensated: Compensated | None
    errors: dict[str, Figures]
    notes: tuple[str, ...]

    def sigma_mm(self) -> np.ndarray:
        """Returns predicted σ (t,) of the tool's position at the targets, mm; nan where a target is not reached, or its
        tool was not measured."""
        compensated, sigma = self.compensated, self.identified.predicted
        if compensated is None or sigma is None:
            return np.zeros(0)
        at = predicted_at(sigma, self.identified.state, "pose", compensated.found.q, compensated.targets.tools)
        return np.where(compensated.found.usable, at, np.nan)

    def moves(self) -> np.ndarray:
        """Returns joint values to send minus those of the arm as drawn, (t, n), rad or mm; nan where one of them does
        not exist."""
        compensated = self.compensated
        if compensated is None or compensated.nominal is None:
            return np.zeros((0, len(self.nominal.rows)))
        return np.where(compensated.compared()[:, None], compensated.found.q - compensated.nominal.q, np.nan)
