"""Outcome of a rig's calibration with everything that its report shows, and the verdict on it."""

from dataclasses import dataclass

from stcal.handeye.data.loop import FRAMES
from stcal.handeye.judge.notes import Aside
from stcal.handeye.report.outcome import Outcome
from stcal.handeye.report.verdict import Finding, Verdict, judged, of_notes
from stcal.handeye.result import HandEye
from stcal.handeye.rig.result import Rig
from stcal.handeye.rig.validate import RigHeldOut

MOTIONS = "Motions of the flange"


@dataclass(frozen=True, slots=True, eq=False)
class RigOutcome:
    """A rig's calibration with everything that its report shows.

    Parameters
    ----------
    where : str
        Names of the files that were solved.
    rig : Rig
    cameras : tuple of Outcome
        The part of each camera, as the outcome of a calibration of its own.
    alone : tuple of HandEye or None
        Solution of each camera by itself; None if it cannot be solved alone.
    held_out : RigHeldOut, optional
        Errors on held-out poses of the robot.
    notes : tuple of str
        Notes in addition to those of the rig.
    understood : tuple of str
        How files were interpreted.
    widened : float
        Factor by which σ of the transforms were widened, because solutions from subsets of the poses scatter more.
    """

    where: str
    rig: Rig
    cameras: tuple[Outcome, ...]
    alone: tuple[HandEye | None, ...]
    held_out: RigHeldOut | None = None
    notes: tuple[str, ...] = ()
    understood: tuple[str, ...] = ()
    widened: float = 1.0

    def all_notes(self) -> tuple[str, ...]:
        """Returns the notes of the rig and its cameras, then the others."""
        return (*self.rig.all_notes(), *self.notes)

    def left_out(self) -> list[tuple[str, str, str]]:
        """Returns (camera, image or row, reason) of everything that was left out."""
        outcome_of_camera = zip(self.rig.names, self.cameras, strict=True)
        return [(name, item, reason) for name, camera in outcome_of_camera for item, reason in camera.left_out]


def rig_judged(outcome: RigOutcome) -> Verdict:
    """Returns the verdict: findings of each camera under its name, of the robot's motions once, and of the rig."""
    findings: list[Finding] = []
    for name, camera in zip(outcome.rig.names, outcome.cameras, strict=True):
        for finding in judged(camera).findings:
            if finding.title != MOTIONS:
                findings.append(_of(name, finding, FRAMES[outcome.rig.setup].mount))
            elif all(earlier.title != MOTIONS for earlier in findings):
                findings.insert(0, finding)
    return Verdict((*findings, *of_notes((*outcome.rig.notes, *outcome.notes))))


def _of(name: str, each: Finding, mount: str) -> Finding:
    said = each.said.replace(f"{mount}_from_camera", f"{mount}_from_{name}")
    return Finding(f"{name}: {each.title}", each.word, f"{name}: {said}", each.value, each.limit, each.remedy)


def asides(outcome: RigOutcome) -> list[str]:
    """Returns the notes that do not put the result in doubt."""
    return [note for note in outcome.all_notes() if isinstance(note, Aside)]
