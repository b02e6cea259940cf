"""Whether a hand-eye calibration can be used, in words: tests of significance, and what its σ mean for a prediction.

A transform is used to say where something is that the camera sees, in the robot's frame. That errs by what one pose
and one image err, which the residuals show, and by what the transform errs, which its covariance tells. Tests are at
the odds of the checks of ``stcal-sfm run``: care is advised for what happens by chance in one calibration of a
thousand, use advised against for what happens in one of a hundred thousand.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.stats import f

from stcal.geometry.rigid import skew
from stcal.handeye.data.loop import FRAMES
from stcal.handeye.judge.notes import Aside, Grave
from stcal.handeye.judge.observability import COMMON_MM
from stcal.handeye.judge.remarks import MANY
from stcal.handeye.report.outcome import Outcome

Word = Literal["good", "use with care", "do not use"]
GOOD, CARE, BAD = get_args(Word)
SUSPICIOUS, FAILED = 1e-3, 1e-5
"""Probability by chance."""
HALF, MOST = 0.5, 0.9
"""Share that the transform has in the variance of a prediction: beyond half, more poses gain more than a better robot
or camera would; beyond nine tenths, a prediction errs three times what a pose does."""
AS_ONE, AS_THREE = 1.0, 3.0
"""σ of the worst direction, in those of one pose: the same two shares where no covariance tells."""
NOTHING_MM = 1e-6
"""Of residuals: poses without errors, of which no test can be made."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing judged: ``said`` in words, ``value`` beside its ``limit``, and what to do about it, ``remedy``."""

    title: str
    word: Word
    said: str
    value: str = ""
    limit: str = ""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """``findings`` : in the order in which they were made."""

    findings: tuple[Finding, ...]

    @property
    def word(self) -> Word:
        """The worst of all findings."""
        return max(self.findings, key=lambda each: get_args(Word).index(each.word)).word

    def reasons(self) -> list[Finding]:
        """What the word rests on: all that is not good, the worst first; of a good one everything."""
        doubts = [each for each in self.findings if each.word != GOOD]
        return sorted(doubts, key=lambda each: each.word != BAD) or list(self.findings)

    def failed(self) -> list[str]:
        """What use is advised against for."""
        return [each.said for each in self.findings if each.word == BAD]

    def sentence(self) -> str:
        """The word and its reasons, in one line."""
        return f"{self.word}: {'; '.join(each.said for each in self.reasons())}"


def judged(outcome: Outcome) -> Verdict:
    """The verdict on a calibration."""
    found = [_of_prediction(outcome), _of_share(outcome), _of_motions(outcome), _of_outliers(outcome)]
    return Verdict(tuple(each for each in (*found, *of_notes(outcome.all_notes())) if each is not None))


def _of_prediction(outcome: Outcome) -> Finding | None:
    """Errors on poses held out against what the residuals make expect: a fit of few poses, or of poses that do not go
    together, predicts worse than it fits."""
    title, result, held = "Poses held out", outcome.result, outcome.held_out
    if held is None:
        remedy = "take ten poses or more, or leave --splits as it is"
        return Finding(title, CARE, "no errors on poses held out are known", remedy=remedy)
    good = ~result.outliers
    agreeing = good[held.rows]
    if not agreeing.any():
        return None
    error = float(np.sqrt((held.translation_mm[agreeing] ** 2).mean()))
    fitted = result.rms()[1]
    known = result.reprojection.camera_covariance if result.reprojection else None
    unknowns = 12 + (result.sigma_scale is not None) + (0 if known is None else len(known))
    unknowns += len(outcome.arm.parameters) if outcome.arm else 0
    equations, left = 6 * int(good.sum()), 6 * (len(good) - held.rows.shape[1])
    if unknowns >= min(equations, left) or fitted < NOTHING_MM:
        return None
    # Residuals are smaller than the errors by what was fitted to them, errors on others larger by what the fit errs.
    expected = (1 + unknowns / left) / (1 - unknowns / equations)
    dof = equations / 2, (equations - unknowns) / 2
    limits = [fitted * float(np.sqrt(expected * f.ppf(1 - odds, *dof))) for odds in (SUSPICIOUS, FAILED)]
    word = _word(error, *limits)
    said = f"poses held out are missed by {error:.3g} mm (RMS), as the residuals of {fitted:.3g} mm promise"
    if word != GOOD:
        said = (
            f"poses held out are missed by {error:.3g} mm (RMS), where the residuals of {fitted:.3g} mm promise "
            f"{fitted * np.sqrt(expected):.3g} mm"
        )
    remedy = "take more poses, and look for some that do not belong to the others" if word != GOOD else ""
    return Finding(title, word, said, f"{error:.3g} mm", f"{limits[0]:.3g} mm", remedy)


def _of_share(outcome: Outcome) -> Finding | None:
    """What the transform's σ add to a prediction; unknown where errors of an arm that was solved for cancel them."""
    share = share_of_variance(outcome)
    if share is None or outcome.arm is not None:
        return None
    seen, sigma, shift = share
    worth, word = sigma**2 / (sigma**2 + shift**2), _word(sigma**2 / (sigma**2 + shift**2), HALF, MOST)
    said = (
        f"{FRAMES[outcome.result.setup].camera} errs by {sigma:.2g} mm where the board was ({seen:.0f} mm away), a "
        f"single pose by {shift:.2g} mm"
    )
    remedy = "take more poses, and turn the flange more, about two axes" if word != GOOD else ""
    return Finding("σ of the transform", word, said, f"{worth:.0%} of the variance", f"{HALF:.0%}", remedy)


def share_of_variance(outcome: Outcome) -> tuple[float, float, float] | None:
    """Distance of the board, σ there by the transform's covariance, and RMS of a pose's residual, all in mm and 3-D."""
    result, pairs = outcome.result, outcome.pairs
    shift, used = result.rms()[1], int((~result.outliers).sum())
    if result.covariance is None or pairs is None or used <= 2 or shift < NOTHING_MM:
        return None
    place = pairs.camera_from_board.translation[~result.outliers] * result.scale
    by = np.concatenate([-skew(place @ result.mount_from_camera.rotation.T), np.tile(np.eye(3), (used, 1, 1))], axis=2)
    variance = np.einsum("mab,bc,mac->m", by, result.covariance, by).mean()
    seen = float(np.linalg.norm(place, axis=1).mean())
    return seen, float(np.sqrt(variance)), shift / float(np.sqrt(1 - 2 / used))


def _of_motions(outcome: Outcome) -> Finding | None:
    """Whether the flange turned about two axes, and enough."""
    seen = outcome.result.observability
    if seen is None:
        return None
    ratio = seen.sigma_mm / COMMON_MM
    word = _word(ratio, AS_ONE, AS_THREE)
    first, second, _ = np.degrees(seen.turns_rad)
    said = f"the flange turns by {first:.0f}° and {second:.0f}° (RMS) about two axes"
    if word != GOOD:
        said = f"by these motions the camera's place has {ratio:.2f} times the σ of one pose, in its worst direction"
    remedy = seen.missing() if word != GOOD else ""
    return Finding("Motions of the flange", word, said, f"{ratio:.2f} × σ of a pose", f"{AS_ONE:g}", remedy)


def _of_outliers(outcome: Outcome) -> Finding:
    """A good set has one in a hundred times."""
    bad, count = outcome.outliers(), len(outcome.result.names)
    word = GOOD if not bad else BAD if len(bad) > MANY * count else CARE
    said = f"none of {count} poses contradicts the others"
    if bad:
        few = ", ".join(bad[:3]) + (f" and {len(bad) - 3} more" if len(bad) > 3 else "")
        said = f"{len(bad)} of {count} poses contradict{'s' * (len(bad) == 1)} the others: {few}"
    remedy = "look at these poses: moved while the image was taken, or paired with another image" if bad else ""
    return Finding("Outliers", word, said, str(len(bad)), "0", remedy)


def of_notes(notes: Iterable[str]) -> list[Finding]:
    """What was found on the way; what each means, or needs, stands behind its colon."""
    found = []
    for note in notes:
        if not isinstance(note, Aside):
            said, _, remedy = note.partition(": ")
            found.append(Finding("Note", BAD if isinstance(note, Grave) else CARE, said, remedy=remedy))
    return found


def _word(value: float, care: float, bad: float) -> Word:
    return BAD if value > bad else CARE if value > care else GOOD
