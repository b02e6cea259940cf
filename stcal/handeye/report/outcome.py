"""A hand-eye calibration as it is reported."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.handeye.choose import Choice
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import Views
from stcal.handeye.predict import HeldOutMotions
from stcal.handeye.result import HandEye
from stcal.handeye.time_offset import TimeOffset
from stcal.handeye.validate import Compared, HeldOutPoses


@dataclass(frozen=True, slots=True, eq=False)
class ArmFound:
    """Parameters of the arm that were solved for too.

    Parameters
    ----------
    robot : str
        Its name.
    names : tuple of str
        (k,) of the parameters: small motions of the axes, J2 ry in rad, J2 x in mm.
    parameters, sigma : (k,) arrays
        By how much the axes are off the robot's file, and its σ.
    plain : HeldOutPoses, optional
        Errors on the same poses held out, of the solution without them.
    """

    robot: str
    names: tuple[str, ...]
    parameters: np.ndarray
    sigma: np.ndarray
    plain: HeldOutPoses | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A calibration as it is reported.

    Parameters
    ----------
    where : str
        What it was made from.
    result : HandEye
    held_out : HeldOutPoses, optional
        Errors of its method on poses held out.
    compared : tuple of Compared
        Every method, where that was asked for.
    pitch_mm : float, optional
        Of dots or squares, as the board's file states it.
    colmap_model : str
        Of the camera whose intrinsics were solved for.
    own_sigmas : bool
        Whether corners came with covariances, of which the result's ``corner_px`` is the factor.
    left_out : tuple of (str, str)
        Images and rows that did not take part, and why.
    notes : tuple of str
        Besides those of the result.
    motions : HeldOutMotions, optional
        Errors of the last motions, held out.
    choice : Choice, optional
        What else was tried, where no method was named.
    pairs : HandEyePoses, optional
        What was solved, numberings of a symmetric board put right.
    views : Views, optional
        The corners, likewise, where there were images.
    folder : Path, optional
        Where the images lie, of which the pairs have the names.
    understood : tuple of str
        What files of other programs were taken for.
    unit_mm : float, optional
        Of a model without a unit: mm by which the camera's lengths were multiplied before.
    arm : ArmFound, optional
        Where the arm's parameters were solved for too.
    time_offset : TimeOffset, optional
        Of the robot's clock from the camera's, where it was solved for; σ of the result hold its own.
    """

    where: str
    result: HandEye
    held_out: HeldOutPoses | None = None
    compared: tuple[Compared, ...] = ()
    pitch_mm: float | None = None
    colmap_model: str = ""
    own_sigmas: bool = False
    left_out: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    motions: HeldOutMotions | None = None
    choice: Choice | None = None
    pairs: HandEyePoses | None = None
    views: Views | None = None
    folder: Path | None = None
    understood: tuple[str, ...] = ()
    unit_mm: float | None = None
    arm: ArmFound | None = None
    time_offset: TimeOffset | None = None

    def sentence(self) -> str:
        """What was solved for, and what that gains; empty where the user said what to solve for."""
        if self.arm is None:
            return self.choice.sentence if self.choice else ""
        if self.arm.plain is None or self.held_out is None:
            return f"solved for the parameters of {self.arm.robot} too"
        now, before = self.held_out.means(), self.arm.plain.means()
        return (
            f"with the parameters of {self.arm.robot} solved for, poses held out are missed by "
            f"{now['board_mm']:.3g} mm at the board, {before['board_mm']:.3g} mm without"
        )

    def all_notes(self) -> tuple[str, ...]:
        """Of the result, then the others."""
        return (*self.result.notes, *(self.choice.notes if self.choice else ()), *self.notes)

    def outliers(self) -> tuple[str, ...]:
        """Names of the poses that contradict the others."""
        return tuple(name for name, bad in zip(self.result.names, self.result.outliers, strict=True) if bad)
