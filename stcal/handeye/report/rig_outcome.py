"""A rig's calibration as it is reported, and what is thought of it."""

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
    """A rig's calibration as it is reported.

    Parameters
    ----------
    where : str
        What it was made from.
    rig : Rig
    cameras : tuple of Outcome
        Each camera's part, as one calibration's.
    alone : tuple of HandEye or None
        Each camera by itself; None where it cannot be found so.
    held_out : RigHeldOut, optional
        Errors on poses of the robot held out.
    notes : tuple of str
        Besides those of the rig.
    understood : tuple of str
        What files were taken for.
    widened : float
        By which σ of the transforms were multiplied, for solutions of parts of the poses scatter more than they say.
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
        """Of the rig and its cameras, then the others."""
        return (*self.rig.all_notes(), *self.notes)

    def left_out(self) -> list[tuple[str, str, str]]:
        """(camera, image or row, why)."""
        each = zip(self.rig.names, self.cameras, strict=True)
        return [(name, what, why) for name, camera in each for what, why in camera.left_out]


def rig_judged(outcome: RigOutcome) -> Verdict:
    """What was found of each camera, by its name; of the robot's motions, once; and on the rig."""
    found: list[Finding] = []
    for name, camera in zip(outcome.rig.names, outcome.cameras, strict=True):
        for each in judged(camera).findings:
            if each.title != MOTIONS:
                found.append(_of(name, each, FRAMES[outcome.rig.setup].mount))
            elif all(own.title != MOTIONS for own in found):
                found.insert(0, each)
    return Verdict((*found, *of_notes((*outcome.rig.notes, *outcome.notes))))


def _of(name: str, each: Finding, mount: str) -> Finding:
    said = each.said.replace(f"{mount}_from_camera", f"{mount}_from_{name}")
    return Finding(f"{name}: {each.title}", each.word, f"{name}: {said}", each.value, each.limit, each.remedy)


def asides(outcome: RigOutcome) -> list[str]:
    """Notes that take nothing from the result."""
    return [note for note in outcome.all_notes() if isinstance(note, Aside)]
