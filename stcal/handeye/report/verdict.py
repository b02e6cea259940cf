"""Verdict on a hand-eye calibration: tests of significance, and the effect of its σ on a prediction.

A transform is used to predict in the robot's frame where an object is that the camera sees. The error of the prediction
has two parts: that of one pose and one image, which the residuals show, and that of the transform, which its covariance
states. The levels of significance are those of the checks of ``stcal-sfm run``: care is advised for what happens by
chance in one calibration of a thousand, and use is advised against for what happens in one of a hundred thousand.
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
"""Significance levels of ``use with care`` and of ``do not use``."""
HALF, MOST = 0.5, 0.9
"""Limits of the transform's share in the variance of a prediction. Beyond half, more poses help more than a better
robot or camera would; beyond nine tenths, the error of a prediction is three times that of a pose."""
AS_ONE, AS_THREE = 1.0, 3.0
"""Limits of σ in the worst direction, in σ of one pose. They are the same two limits if there is no covariance."""
NOTHING_MM = 1e-6
"""Smallest RMS residual that is tested, in mm. Poses with smaller residuals have no errors."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Verdict on one matter: ``said`` in words, ``value`` and its ``limit``, and the ``remedy``."""

    title: str
    word: Word
    said: str
    value: str = ""
    limit: str = ""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a calibration; ``findings`` in the order in which they were made."""

    findings: tuple[Finding, ...]

    @property
    def word(self) -> Word:
        """The worst word of all findings."""
        return max(self.findings, key=lambda each: get_args(Word).index(each.word)).word

    def reasons(self) -> list[Finding]:
        """Returns the findings behind the word: all that are not good, the worst first; or all if all are good."""
        doubts = [each for each in self.findings if each.word != GOOD]
        return sorted(doubts, key=lambda each: each.word != BAD) or list(self.findings)

    def failed(self) -> list[str]:
        """Returns the reasons against use of the calibration."""
        return [each.said for each in self.findings if each.word == BAD]

    def sentence(self) -> str:
        """Returns the word and its reasons in one line."""
        return f"{self.word}: {'; '.join(each.said for each in self.reasons())}"


def judged(outcome: Outcome) -> Verdict:
    """Returns the verdict on a calibration."""
    tests = [_of_prediction(outcome), _of_share(outcome), _of_motions(outcome), _of_outliers(outcome)]
    return Verdict(tuple(each for each in (*tests, *of_notes(outcome.all_notes())) if each is not None))


def _of_prediction(outcome: Outcome) -> Finding | None:
    """Tests the errors on held-out poses against those expected from the residuals.

    A fit to few poses, or to poses that contradict each other, predicts worse than it fits.
    """
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
    camera_covariance = result.reprojection.camera_covariance if result.reprojection else None
    unknowns = 12 + (result.sigma_scale is not None) + (0 if camera_covariance is None else len(camera_covariance))
    unknowns += len(outcome.arm.parameters) if outcome.arm else 0
    equations, predicting = 6 * int(good.sum()), 6 * (len(good) - held.rows.shape[1])
    if unknowns >= min(equations, predicting) or fitted < NOTHING_MM:
        return None
    # The fit makes residuals smaller than the errors; its own error makes errors on held-out poses larger.
    expected = (1 + unknowns / predicting) / (1 - unknowns / equations)
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
    """Judges the share of the transform's σ in a prediction.

    The share is unknown if the arm was solved for, as correlated errors of the arm cancel errors of the transform.
    """
    share = share_of_variance(outcome)
    if share is None or outcome.arm is not None:
        return None
    distance, sigma, shift = share
    share_of_transform, word = sigma**2 / (sigma**2 + shift**2), _word(sigma**2 / (sigma**2 + shift**2), HALF, MOST)
    said = (
        f"{FRAMES[outcome.result.setup].camera} errs by {sigma:.2g} mm where the board was ({distance:.0f} mm away), a "
        f"single pose by {shift:.2g} mm"
    )
    remedy = "take more poses, and turn the flange more, about two axes" if word != GOOD else ""
    return Finding("σ of the transform", word, said, f"{share_of_transform:.0%} of the variance", f"{HALF:.0%}", remedy)


def share_of_variance(outcome: Outcome) -> tuple[float, float, float] | None:
    """Returns the board's distance, σ there due to the transform, and the RMS error of one pose, all in mm and 3-D."""
    result, pairs = outcome.result, outcome.pairs
    shift, used = result.rms()[1], int((~result.outliers).sum())
    if result.covariance is None or pairs is None or used <= 2 or shift < NOTHING_MM:
        return None
    place = pairs.camera_from_board.translation[~result.outliers] * result.scale
    jacobian = np.concatenate(
        [-skew(place @ result.mount_from_camera.rotation.T), np.tile(np.eye(3), (used, 1, 1))], axis=2
    )
    variance = np.einsum("mab,bc,mac->m", jacobian, result.covariance, jacobian).mean()
    distance = float(np.linalg.norm(place, axis=1).mean())
    return distance, float(np.sqrt(variance)), shift / float(np.sqrt(1 - 2 / used))


def _of_motions(outcome: Outcome) -> Finding | None:
    """Judges whether the flange turned enough about two axes."""
    observability = outcome.result.observability
    if observability is None:
        return None
    ratio = observability.sigma_mm / COMMON_MM
    word = _word(ratio, AS_ONE, AS_THREE)
    first, second, _ = np.degrees(observability.turns_rad)
    said = f"the flange turns by {first:.0f}° and {second:.0f}° (RMS) about two axes"
    if word != GOOD:
        said = f"by these motions the camera's place has {ratio:.2f} times the σ of one pose, in its worst direction"
    remedy = observability.missing() if word != GOOD else ""
    return Finding("Motions of the flange", word, said, f"{ratio:.2f} × σ of a pose", f"{AS_ONE:g}", remedy)


def _of_outliers(outcome: Outcome) -> Finding:
    """Judges the number of outliers; one good set in a hundred has an outlier."""
    bad, count = outcome.outliers(), len(outcome.result.names)
    word = GOOD if not bad else BAD if len(bad) > MANY * count else CARE
    said = f"none of {count} poses contradicts the others"
    if bad:
        few = ", ".join(bad[:3]) + (f" and {len(bad) - 3} more" if len(bad) > 3 else "")
        said = f"{len(bad)} of {count} poses contradict{'s' * (len(bad) == 1)} the others: {few}"
    remedy = "look at these poses: moved while the image was taken, or paired with another image" if bad else ""
    return Finding("Outliers", word, said, str(len(bad)), "0", remedy)


def of_notes(notes: Iterable[str]) -> list[Finding]:
    """Returns a finding for each note except asides. The text behind a note's colon becomes the remedy."""
    findings = []
    for note in notes:
        if not isinstance(note, Aside):
            said, _, remedy = note.partition(": ")
            findings.append(Finding("Note", BAD if isinstance(note, Grave) else CARE, said, remedy=remedy))
    return findings


def _word(value: float, care: float, bad: float) -> Word:
    return BAD if value > bad else CARE if value > care else GOOD
