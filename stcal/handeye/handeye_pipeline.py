"""Hand-eye calibration as a whole: a way of solving, and σ that hold for poses that it has not seen."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import require_arguments
from stcal.handeye.choose import choose
from stcal.handeye.data.corner_views import Views
from stcal.handeye.data.pose_pairs import HandEyePoses, LengthUnit, Setup
from stcal.handeye.handeye_result import HandEye
from stcal.handeye.judge.remarks import of_setup
from stcal.handeye.report.outcome import Outcome, judged
from stcal.handeye.solving import HandEyeOptions, HandEyeProblem
from stcal.handeye.validate import LEAST_LEFT, refitted, splits
from stcal.io.cameras.camera_model import CameraPrior
from stcal.parallel import one_thread


def validated(
    problem: HandEyeProblem,
    method: str | None,
    rows: np.ndarray,
    prior: CameraPrior | None = None,
    choosing: bool = False,
    workers: int | None = 1,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Outcome:
    """Returns the result of a method, or of the way that predicts best, with σ that hold for poses held out.

    ``rows`` : (s, k) poses to hold out; ``prior`` : of intrinsics that may be solved for; ``choosing`` : among all
    ways. Raises StcalError: as :func:`stcal.handeye.handeye`.
    """
    known, notes = {"options": problem.options, "pairs": problem.pairs, "views": problem.views}, ()
    try:
        if choosing and len(rows):
            choice = choose(problem, prior, rows, workers, progress)
            known["options"] = choice.chosen.of(problem, prior).options
            return Outcome("", choice.result, choice.held_out, choice=choice, **known)
        result = problem.solved(method).result
        if len(rows):
            held_out = refitted(problem.mended(), method, rows, workers, progress)
            return Outcome("", held_out.widened(result), held_out, **known)
    except DegenerateError as error:  # if not of all poses, then of those besides some
        result, notes = problem.solved(method).result, (f"no errors on poses held out: {error}",)
    return Outcome("", result, notes=notes, **known)


@require_arguments
@one_thread()
def handeye(
    base_from_flange: Any = None,
    camera_from_board: Any = None,
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
    *,
    setup: Setup | None = None,
    unit: LengthUnit = "mm",
    pairs: HandEyePoses | None = None,
) -> HandEye:
    """Returns where the camera is on the flange, or in the robot's base frame: the answer of ``stcal handeye``.

    σ hold for poses that the result has not seen: they are widened by the scatter of results without some poses, and
    where another way of solving predicts as well and answers otherwise.

    Parameters
    ----------
    base_from_flange : (m, 4, 4), at least three poses, rotated about two axes that are not parallel
    camera_from_board : (m, 4, 4), the pose of the board in the camera in each of them. After ``pairs``, the setup may
        stand here.
    method : one of :data:`METHODS`. If None, the way that predicts poses held out best, among all methods, with the
        board's size as stated or solved for; ``reprojection`` with views, else ``pose``, where ``options`` name
        unknowns.
    views : the corners from which the poses were computed. ``reprojection`` adjusts them; with ``pose`` they carry the
        camera's errors into σ.
    options : known errors of robot and camera, and further unknowns; the defaults if None
    setup : {"eye-in-hand", "eye-to-hand"}, ``eye-in-hand``: the camera on the flange, also if None; ``eye-to-hand``:
        the board on the flange
    unit : {"mm", "m", "cm", "um", "in"}, unit of translations
    pairs : pairs of poses in place of the first two, also as the first argument; see :func:`~stcal.handeye.read_poses`,
        :func:`~stcal.handeye.pairs_of_views`

    Returns
    -------
    HandEye
        X and Z with covariances, residuals, outliers, notes on anything doubtful, and the verdict.

    Raises InputError: the method or setup is unknown, ``reprojection`` has no views, or the poses follow another
    convention. Raises DegenerateError: the poses do not determine the answer; the message says which motion is missing.
    Raises ConvergenceError: the method fails on these poses.

    Examples
    --------
    >>> pairs = read_poses("poses.csv")  # doctest: +SKIP
    >>> found = handeye(pairs, setup="eye-in-hand")  # doctest: +SKIP
    >>> found.flange_from_camera @ [0, 0, 500]  # a point half a metre before the camera  # doctest: +SKIP
    """
    if isinstance(base_from_flange, HandEyePoses):
        pairs, base_from_flange = base_from_flange, None
    asked = setup or "eye-in-hand"
    if pairs is not None:
        asked = setup or camera_from_board or "eye-in-hand"
        if unit != "mm":
            raise InputError("E-OPTION-CONFLICT", f"hand-eye: unit {unit!r} of pairs of poses, which are in mm already")
    elif base_from_flange is None or camera_from_board is None or isinstance(camera_from_board, str):
        raise InputError("E-POSES-COUNT", "hand-eye: poses of the flange alone; give camera_from_board of each, too")
    else:
        pairs = HandEyePoses.from_matrices(base_from_flange, camera_from_board, unit=unit)
    problem = HandEyeProblem(pairs, asked, views, options or HandEyeOptions())
    rows = splits(len(pairs)) if len(pairs) > LEAST_LEFT else np.zeros((0, 0), int)
    prior = None if views is None else problem.options.camera
    choosing = method is None and not problem.options.names_unknowns
    found = validated(problem, method, rows, prior, choosing)
    x, z = found.result.mount_from_camera, found.result.stand_from_board
    outcome = replace(found, notes=(*found.notes, *of_setup(x, z, asked, setup is not None)))
    return replace(outcome.result, judgement=judged(outcome), notes=outcome.all_notes())
