"""Outcome of a hand-eye calibration: the result with everything that the report shows."""

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
    """The arm's parameters, if they were solved for.

    Parameters
    ----------
    robot : str
        Name of the robot.
    names : tuple of str
        Names of the k parameters: small motions of the axes, such as J2 ry in rad, J2 x in mm.
    parameters, sigma : (k,) arrays
        Deviation of the axes from the robot's file, and its σ.
    plain : HeldOutPoses, optional
        Errors on the same held-out poses, of the solution without these parameters.
    """

    robot: str
    names: tuple[str, ...]
    parameters: np.ndarray
    sigma: np.ndarray
    plain: HeldOutPoses | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A calibration with everything that its report shows.

    Parameters
    ----------
    where : str
        Names of the files that were solved.
    result : HandEye
    held_out : HeldOutPoses, optional
        Errors of the result's method on held-out poses.
    compared : tuple of Compared
        Results of every method, if a comparison was asked for.
    pitch_mm : float, optional
        Pitch of dots or squares, as the board's file states it.
    colmap_model : str
        Model of the camera whose intrinsics were solved for.
    own_sigmas : bool
        Whether corners came with covariances. The result's ``corner_px`` is then their factor.
    left_out : tuple of (str, str)
        Images and rows that did not take part, and why.
    notes : tuple of str
        Notes in addition to those of the result.
    motions : HeldOutMotions, optional
        Errors of the last motions, held out.
    choice : Choice, optional
        The candidates that were tried, if no method was named.
    pairs : HandEyePoses, optional
        The pairs that were solved, after repair of the numbering of a symmetric board.
    views : Views, optional
        The corners after the same repair, if there were images.
    folder : Path, optional
        Folder of the images; the pairs hold their names.
    understood : tuple of str
        How files of other programs were interpreted.
    unit_mm : float, optional
        Unit that was assumed for a model without a unit, in mm: the camera's lengths were multiplied by it.
    arm : ArmFound, optional
        The arm's parameters, if they were solved for.
    time_offset : TimeOffset, optional
        Offset of the robot's clock from the camera's, if it was solved for. σ of the result contain its σ.
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
        """Returns what was solved for and what that gains; empty if the user chose what to solve for."""
        if self.arm is None:
            return self.choice.sentence if self.choice else ""
        if self.arm.plain is None or self.held_out is None:
            return f"solved for the parameters of {self.arm.robot} too"
        with_arm, without_arm = self.held_out.means(), self.arm.plain.means()
        return (
            f"with the parameters of {self.arm.robot} solved for, poses held out are missed by "
            f"{with_arm['board_mm']:.3g} mm at the board, {without_arm['board_mm']:.3g} mm without"
        )

    def all_notes(self) -> tuple[str, ...]:
        """Returns the notes of the result, then those of the choice, then the others."""
        return (*self.result.notes, *(self.choice.notes if self.choice else ()), *self.notes)

    def outliers(self) -> tuple[str, ...]:
        """Returns the names of the poses that contradict the others."""
        return tuple(name for name, bad in zip(self.result.names, self.result.outliers, strict=True) if bad)
