"""Hand-eye calibration as a whole: a way of solving, σ that hold for poses that it has not seen, and the verdict."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Never

import numpy as np
from scipy.special import fdtri

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import PARAMETER_NAMES, parameter_names
from stcal.geometry.rigid import by_pose
from stcal.handeye.choose import ChosenWay, choose
from stcal.handeye.conventions import flipped
from stcal.handeye.data.corner_views import Views
from stcal.handeye.data.pose_content import HandEyeInput
from stcal.handeye.data.pose_pairs import FRAMES, HandEyePoses, LengthUnit, Loop, Setup
from stcal.handeye.handeye_problem import METHODS, HandEye, HandEyeOptions, problem_of
from stcal.handeye.methods.pose_adjustment import UNKNOWNS
from stcal.handeye.remarks import (
    BAD,
    CARE,
    COMMON_MM,
    GOOD,
    MANY,
    Aside,
    Finding,
    Grave,
    SizeDoubt,
    Verdict,
    Word,
    in_words,
    of_setup,
    spoken,
)
from stcal.handeye.time_offset import TimeOffset
from stcal.handeye.validate import LEAST_LEFT, Compared, HeldOutMotions, HeldOutPoses, compare, cross_validate, splits
from stcal.io.cameras.camera_model import CameraPrior
from stcal.parallel import one_thread


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A calibration with everything that its report shows.

    ``given`` : what was solved, as numbered if the board is symmetric; ``held_out`` : errors of the result's method on
    held-out poses; ``compared`` : results of every method, if a comparison was asked for; ``options`` : by which the
    result was solved; ``notes`` : notes in addition to those of the result; ``motions`` : errors of the last motions,
    held out; ``choice`` : the candidates that were tried, if no method was named; ``time_offset`` : offset of the
    robot's clock from the camera's, if it was solved for. σ of the result contain its σ.
    """

    given: HandEyeInput
    result: HandEye
    held_out: HeldOutPoses | None = None
    compared: tuple[Compared, ...] = ()
    options: HandEyeOptions = field(default_factory=HandEyeOptions)
    notes: tuple[str, ...] = ()
    motions: HeldOutMotions | None = None
    choice: ChosenWay | None = None
    time_offset: TimeOffset | None = None

    @property
    def colmap_model(self) -> str:
        """Model of the camera whose intrinsics were solved for."""
        return self.options.intrinsics.colmap_model if self.options.intrinsics else ""

    @property
    def own_sigmas(self) -> bool:
        """Whether corners came with covariances. The result's ``corner_px`` is then their factor."""
        views = self.given.views
        return views is not None and all(view.covariance is not None for view in views.views)

    def sentence(self) -> str:
        """Returns what was solved for and what that gains; empty if the user chose what to solve for."""
        return self.choice.sentence if self.choice else ""

    def all_notes(self) -> tuple[str, ...]:
        """Returns the notes of the result, then those of the choice, then the others."""
        return (*self.result.notes, *(self.choice.notes if self.choice else ()), *self.notes)

    def outliers(self) -> tuple[str, ...]:
        """Returns the names of the poses that contradict the others."""
        return tuple(name for name, bad in zip(self.result.names, self.result.outliers, strict=True) if bad)

    @property
    def camera(self) -> dict | None:
        """COLMAP ``model``, ``parameters`` and their ``sigma`` by name, of intrinsics that were solved for."""
        found = self.result.reprojection
        if found is None or found.camera_covariance is None:
            return None
        parameters, sigma = found.camera.parameters(), np.sqrt(np.diag(found.camera_covariance))
        values = dict(zip(PARAMETER_NAMES, parameters, strict=True))
        sigmas = dict(zip(parameter_names(self.colmap_model), sigma, strict=True))
        return {"model": self.colmap_model, "parameters": values, "sigma": sigmas}


SUSPICIOUS, FAILED = 1e-3, 1e-5  # significance levels of ``use with care`` and of ``do not use``
SHOWN = 3  # number of poses that a sentence names
HALF, MOST = 0.5, 0.9
"""Limits of the transform's share in the variance of a prediction. Beyond half, more poses help more than a better
robot or camera would; beyond nine tenths, the error of a prediction is three times that of a pose."""
AS_ONE, AS_THREE = 1.0, 3.0
"""Limits of σ in the worst direction, in σ of one pose. They are the same two limits if there is no covariance."""
WRONG_RAD, WRONG_SHARE = float(np.radians(4.0)), 0.04
"""Residuals (RMS), as an angle and as a share of the board's distance, beyond which poses do not belong together. Arms
that were never calibrated and poses of single tags stay below half of these."""
OTHER_SIZE, SIZE_SIGMAS = 0.005, 5.0
"""Deviation of a board's size, and in σ, beyond which it is told: printers err by that, measured pitches do not."""
FEW_FREEDOM = 12  # redundancy of four poses, of which σ are known to 1/√24, 20 %
NOTHING_MM = 1e-6  # smallest RMS residual that is tested, in mm. Poses with smaller residuals have no errors


def judged(outcome: Outcome) -> Verdict:
    kinds = _of_residuals, _of_prediction, _of_share, _of_common_errors, _of_motions, _of_size, _of_outliers, _of_number
    tests = [judge(outcome) for judge in kinds]
    for note in outcome.all_notes():  # the text behind a note's colon is the remedy
        if not isinstance(note, Aside):
            said, _, remedy = note.partition(": ")
            tests.append(Finding("Note", BAD if isinstance(note, Grave) else CARE, said, remedy=remedy))
    return Verdict(tuple(each for each in tests if each is not None))


def _of_residuals(outcome: Outcome) -> Finding | None:
    """Refuses residuals that are too large for a sound robot and camera, even if they predict held-out poses well."""
    result, used = outcome.result, ~outcome.result.outliers
    if not used.any():
        return None
    turn, shift = result.rms()
    places = outcome.given.pairs.camera_from_board.translation[used]
    away = result.scale * float(np.median(np.linalg.norm(places, axis=1)))
    if turn <= WRONG_RAD and shift <= WRONG_SHARE * away:
        return None
    size = f"{np.degrees(turn):.2g}°", f"{shift:.3g} mm"
    said = f"the poses miss one another by {' and '.join(size)} (RMS), {shift / away:.0%} of the board's distance of "
    said += f"{away:.0f} mm"
    limit = f"{np.degrees(WRONG_RAD):.0f}°, {WRONG_SHARE * away:.3g} mm"
    remedy = "pair each pose of the board with that of the flange at that time, and check units, directions and camera"
    remedy = "" if any(isinstance(note, SizeDoubt) for note in outcome.all_notes()) else remedy
    return Finding("Residuals", BAD, said, ", ".join(size), limit, remedy)


def _of_prediction(outcome: Outcome) -> Finding | None:
    """Tests held-out errors against the residuals: few or contradicting poses predict worse than they fit."""
    title, result, held = "Poses held out", outcome.result, outcome.held_out
    if held is None:
        remedy = "take ten poses or more, or keep the default of --splits"
        return Finding(title, CARE, "errors on poses held out are not known", remedy=remedy)
    good = ~result.outliers
    agreeing = good[held.rows]
    if not agreeing.any():
        return None
    error, fitted = float(np.sqrt((held.translation_mm[agreeing] ** 2).mean())), result.rms()[1]
    intrinsics = result.reprojection.camera_covariance if result.reprojection else None
    unknowns = UNKNOWNS + (result.sigma_scale is not None) + (0 if intrinsics is None else len(intrinsics))
    equations, predicting = 6 * int(good.sum()), 6 * (len(good) - held.rows.shape[1])
    if unknowns >= min(equations, predicting) or fitted < NOTHING_MM:
        return None
    # The fit makes residuals smaller than the errors; its own error makes errors on held-out poses larger.
    expected = (1 + unknowns / predicting) / (1 - unknowns / equations)
    dof = equations / 2, (equations - unknowns) / 2
    limits = [fitted * float(np.sqrt(expected * fdtri(*dof, 1 - odds))) for odds in (SUSPICIOUS, FAILED)]
    word, promised = _word(error, *limits), f"the residuals of {fitted:.3g} mm promise"
    promise = f"as {promised}" if word == GOOD else f"where {promised} {fitted * np.sqrt(expected):.3g} mm"
    said = f"poses held out are missed by {error:.3g} mm (RMS), {promise}"
    remedy = "take more poses, and look for poses that do not belong to the others"
    return _graded(title, word, said, f"{error:.3g} mm", f"{limits[0]:.3g} mm", remedy)


def _of_number(outcome: Outcome) -> Finding | None:
    """Doubts a result of so few poses that σ, which are estimated from them, are themselves known to 20 % at best."""
    used = int((~outcome.result.outliers).sum())
    if 6 * used - UNKNOWNS > FEW_FREEDOM:
        return None
    said = f"{used} poses are few: neither σ nor outliers can be trusted"
    return Finding("Number of poses", CARE, said, remedy="take ten poses or more, and turn the flange about two axes")


def _of_share(outcome: Outcome) -> Finding | None:
    """Judges the share of the transform's σ in a prediction."""
    if (share := share_of_variance(outcome)) is None:
        return None
    distance, sigma, shift = share
    part = sigma**2 / (sigma**2 + shift**2)
    alone = "" if outcome.result.common_covariance is None else ", without what all poses err by in common,"
    said = f"σ of {FRAMES[outcome.result.setup].camera}{alone} is {sigma:.2g} mm where the board was "
    said += f"({distance:.0f} mm away), the error of a single pose {shift:.2g} mm (RMS)"
    remedy, value = "take more poses, and turn the flange more, about two axes", f"{part:.0%} of the variance"
    return _graded("σ of the transform", _word(part, HALF, MOST), said, value, f"{HALF:.0%}", remedy)


def _of_common_errors(outcome: Outcome) -> Finding | None:
    """Judges what the errors of the board's poses have in common: σ contain it, and more poses do not reduce it."""
    title, result = "Common errors of the board's poses", outcome.result
    if (common := result.common_covariance) is None:
        if outcome.given.pairs.camera_from_board_common is None or result.covariance is not None:
            return None
        said = f"{result.method} gives no σ, and the board's poses state errors that all have in common"
        return Finding(title, CARE, said, remedy="leave --method out: no residual shows these errors, only σ do")
    if (share := share_of_variance(outcome, common)) is None:
        return None
    distance, sigma, shift = share
    said = f"errors that all poses of the board have in common add {sigma:.2g} mm to the σ of "
    said += f"{FRAMES[result.setup].camera} where the board was ({distance:.0f} mm away)"
    remedy = "calibrate the camera better, or solve from the images: more poses do not help"
    return _graded(title, _word(sigma, shift), said, f"{sigma:.2g} mm", f"{shift:.2g} mm", remedy)


def share_of_variance(outcome: Outcome, covariance: np.ndarray | None = None) -> tuple[float, float, float] | None:
    """Returns the board's distance, σ there due to the transform (of ``covariance``, by default without common errors),
    and the RMS error of one pose, all in mm and 3-D."""
    result = outcome.result
    if covariance is None and result.covariance is not None:
        common = result.common_covariance
        covariance = result.covariance if common is None else result.covariance - common
    shift, used = result.rms()[1], int((~result.outliers).sum())
    if covariance is None or used <= 2 or shift < NOTHING_MM:
        return None
    place = outcome.given.pairs.camera_from_board.translation[~result.outliers] * result.scale
    jacobian = by_pose(np.tile(np.eye(3), (used, 1, 1)), place @ result.mount_from_camera.rotation.T)
    variance = np.einsum("mab,bc,mac->m", jacobian, covariance, jacobian).mean()
    distance = float(np.linalg.norm(place, axis=1).mean())
    return distance, float(np.sqrt(variance)), shift / float(np.sqrt(1 - 2 / used))


def _of_motions(outcome: Outcome) -> Finding | None:
    """Judges whether the flange turned enough about two axes."""
    if (seen := outcome.result.observability) is None:
        return None
    ratio, (first, second, _) = seen.sigma_mm / COMMON_MM, np.degrees(seen.turns_rad)
    title, word, limit = "Motions of the flange", _word(ratio, AS_ONE, AS_THREE), f"{AS_ONE:g}"
    if not np.isfinite(ratio):
        said = f"the flange turns by {first:.0f}° (RMS) about one axis: the camera's place along it is not determined"
        remedy = f"measure where the camera is along this axis, {in_words(seen.axes[0])} of the flange, which a robot "
        remedy += "with four axes cannot show; or turn the flange about another axis too, without --four-dof"
        return Finding(title, word, said, "one axis", f"{limit} × σ of a pose", remedy)
    said = f"the flange turns by {first:.0f}° and {second:.0f}° (RMS) about two axes"
    if word != GOOD:
        said = f"by these motions the camera's place has {ratio:.2f} times the σ of one pose, in its worst direction"
    return _graded(title, word, said, f"{ratio:.2f} × σ of a pose", limit, seen.missing())


def _of_size(outcome: Outcome) -> Finding | None:
    """Judges a board's size that was solved for: where it is far from the stated one, something else may be wrong."""
    scale, sigma = outcome.result.scale, outcome.result.sigma_scale
    if sigma is None or abs(scale - 1) <= max(SIZE_SIGMAS * sigma, OTHER_SIZE):
        return None
    said = f"the board is {scale:.3g} times as large as stated, or the focal length wrong by as much"
    remedy = "measure the board, and correct its file or the poses' unit; where it is as stated, check the camera file"
    return Finding("Size of the board", CARE, said, f"{scale:.3g}", f"1 ± {OTHER_SIZE:g}", remedy)


def _of_outliers(outcome: Outcome) -> Finding:
    """Judges the number of outliers; one good set in a hundred has an outlier."""
    result, bad, count = outcome.result, outcome.outliers(), len(outcome.result.names)
    if not bad:
        return Finding("Outliers", GOOD, f"none of {count} poses contradicts the others", "0", "0")
    loop = Loop.of(outcome.given.pairs, result.setup)
    tilted = flipped(loop, result.mount_from_camera, result.stand_from_board, result.outliers)
    flips = tuple(name for name, flip in zip(result.names, tilted, strict=True) if flip)
    others, said, remedies = tuple(name for name in bad if name not in flips), [], []
    if flips:
        tilt = "poses are tilted the other way, as the second pose of a flat target is"
        said.append(f"{len(flips)} of {count} {tilt}: {_few(flips)}")
        if outcome.given.views is None:
            undo = "solve with --undo-flips, which takes the other tilt, or give images, not the board's poses"
            remedies.append(undo)
    if others:
        said.append(f"{len(others)} of {count} poses contradict{'s' * (len(others) == 1)} the others: {_few(others)}")
        which = _few(others) if flips else "these poses"
        remedy = f"look at {which}: moved while the image was taken, or paired with another image"
        if len(others) > MANY * count:
            remedy = "so many suggest a wrong setup, poses of the robot beside those of other images, or a camera file "
            remedy += "that does not fit"
        remedies.append(remedy)
    word = BAD if len(bad) > MANY * count else CARE
    return Finding("Outliers", word, "; ".join(said), str(len(bad)), "0", "; ".join(remedies))


def _few(names: Sequence[str]) -> str:
    return ", ".join(map(spoken, names[:SHOWN])) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")


def _graded(title: str, word: Word, said: str, value: str, limit: str, remedy: str) -> Finding:
    return Finding(title, word, said, value, limit, remedy if word != GOOD else "")


def _word(value: float, care: float, bad: float = np.inf) -> Word:
    return BAD if value > bad else CARE if value > care else GOOD


ALL = "all"  # word in place of a method's name: all methods, compared


def validated(
    given: HandEyeInput,
    options: HandEyeOptions,
    method: str | None,
    rows: np.ndarray,
    prior: CameraPrior | None = None,
    choosing: bool = False,
    workers: int | None = 1,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Outcome:
    """Returns the result of a method, or of the way that predicts best, with σ that hold for poses held out. ``rows`` :
    (s, k) poses to hold out; ``prior`` : of intrinsics that may be solved for; ``choosing`` : among all ways. Raises
    StcalError: as :func:`stcal.handeye.handeye`."""
    problem, notes, compared, held_out = problem_of(given, options), (), (), None
    if method == ALL:  # the result is that of the default method
        result = problem.solved().result
        compared = compare(given.pairs, problem.setup, given.views, options, METHODS, rows, workers, progress)
        held_out = next(each.held_out for each in compared if each.method == result.method)
    else:
        try:
            if choosing and len(rows):
                choice = choose(problem, prior, rows, workers, progress)
                options = choice.chosen.of(problem, prior).options
                return Outcome(given, choice.result, choice.held_out, options=options, choice=choice)
            result = problem.solved(method).result
            if len(rows):
                how = method, given.views, options, rows, workers, progress
                held_out = cross_validate(given.pairs, problem.setup, *how)
        except DegenerateError as error:  # if not of all poses, then of those besides some
            result, notes = problem.solved(method).result, (f"no errors on poses held out: {error}",)
    return Outcome(given, held_out.widened(result) if held_out else result, held_out, compared, options, notes)


@require_arguments
@one_thread()
def handeye(
    pairs: HandEyePoses | None = None,
    *unnamed: Never,
    base_from_flange: Any = None,
    camera_from_board: Any = None,
    unit: LengthUnit = "mm",
    setup: Setup | None = None,
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
) -> HandEye:
    """Returns where the camera is on the flange, or in the robot's base frame: the answer of ``stcal handeye``.

    σ hold for poses that the result has not seen: they are widened by the scatter of results without some poses, and
    where another way of solving predicts as well and answers otherwise.

    Parameters
    ----------
    pairs, unnamed : pairs of poses, see :func:`~stcal.handeye.read_poses`, :func:`~stcal.handeye.pairs_of_views`;
        everything else by name
    base_from_flange, camera_from_board : (m, 4, 4) each, in place of ``pairs``: at least three poses, rotated about two
        axes that are not parallel, and the pose of the board in the camera in each of them
    unit : {"mm", "m", "cm", "um", "in"}, unit of their translations
    setup : {"eye-in-hand", "eye-to-hand"}, ``eye-in-hand``: the camera on the flange, also if None; ``eye-to-hand``:
        the board on the flange
    method : one of :data:`METHODS`. If None, the way that predicts poses held out best, among all methods, with the
        board's size as stated or solved for; ``reprojection`` with views, else ``pose``, where ``options`` name
        unknowns.
    views : the corners from which the poses were computed. ``reprojection`` adjusts them; with ``pose`` they carry the
        camera's errors into σ.
    options : known errors of robot and camera, and further unknowns; the defaults if None

    Returns
    -------
    HandEye : X and Z with covariances, residuals, outliers, notes on anything doubtful, and the verdict.

    Raises InputError: the method or setup is unknown, ``reprojection`` has no views, or the poses follow another
    convention. Raises DegenerateError: the poses do not determine the answer; the message says which motion is missing.
    Raises ConvergenceError: the method fails on these poses.

    Examples
    --------
    >>> pairs = read_poses("poses.csv")  # doctest: +SKIP
    >>> found = handeye(pairs, setup="eye-in-hand")  # doctest: +SKIP
    >>> found.flange_from_camera @ [0, 0, 500]  # a point half a metre before the camera  # doctest: +SKIP
    """
    if unnamed:
        given = "handeye(base_from_flange=…, camera_from_board=…, setup=…)"
        raise InputError("E-ARGUMENT-UNNAMED", f"hand-eye: arguments without names are easily exchanged; give {given}")
    asked, sides = setup or "eye-in-hand", (base_from_flange, camera_from_board)
    if pairs is not None:
        if unit != "mm" or any(side is not None for side in sides):
            raise InputError("E-OPTION-CONFLICT", "hand-eye: pairs of poses are in mm; give no matrices, no unit")
    elif any(side is None for side in sides):
        raise InputError("E-POSES-COUNT", "hand-eye: give base_from_flange and camera_from_board of each pose")
    else:
        pairs = HandEyePoses.from_matrices(*sides, unit=unit)
    options = options or HandEyeOptions()
    rows = splits(len(pairs)) if len(pairs) > LEAST_LEFT else np.zeros((0, 0), int)
    prior = None if views is None else options.camera
    choosing = method is None and not options.names_unknowns
    found = validated(HandEyeInput("", pairs, views, setup=asked), options, method, rows, prior, choosing)
    x, z = found.result.mount_from_camera, found.result.stand_from_board
    outcome = replace(found, notes=(*found.notes, *of_setup(x, z, asked, setup is not None)))
    return replace(outcome.result, judgement=judged(outcome), notes=outcome.all_notes())
