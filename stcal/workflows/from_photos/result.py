"""What was found on the way from photographs to joint values."""

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
    """What was found on the way.

    Parameters
    ----------
    images : str
        The folder.
    measured : MeasureResult
        Poses of the target.
    nominal : Robot
        As drawn.
    data : Measurements
        Poses with their joint values.
    axes : AxesResult or None
        The axis method, where every joint is swept …
    without_axes : str
        … and else why not.
    identified : Identified
        From all poses.
    compensated : Compensated or None
        Joint values for the targets, where there are any.
    errors : dict of str to Figures
        Position errors of the rows, mm: as drawn and by the axis method with base and tool fitted, identified, and of
        rows held out.
    notes : tuple of str
        On rows and photographs that have no partner, and of what was read.
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
        """(t,) predicted σ of the tool's position at the targets, mm; nan where not reached, or of unmeasured tools."""
        found, sigma = self.compensated, self.identified.predicted
        if found is None or sigma is None:
            return np.zeros(0)
        at = predicted_at(sigma, self.identified.state, "pose", found.found.q, found.targets.tools)
        return np.where(found.found.usable, at, np.nan)

    def moves(self) -> np.ndarray:
        """(t, n) joint values to send less those of the arm as drawn, rad or mm; nan where one of both is none."""
        found = self.compensated
        if found is None or found.nominal is None:
            return np.zeros((0, len(self.nominal.rows)))
        return np.where(found.compared()[:, None], found.found.q - found.nominal.q, np.nan)
