"""Hand-eye calibration as a whole: a way of solving, and σ that hold for poses that it has not seen."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import require_arguments
from stcal.handeye import solve
from stcal.handeye.choose import Choice, choose
from stcal.handeye.data.pairs import HandEyePoses, LengthUnit, Setup
from stcal.handeye.data.views import Views
from stcal.handeye.judge.remarks import of_setup
from stcal.handeye.report.outcome import Outcome, judged
from stcal.handeye.result import HandEye
from stcal.handeye.solve import HandEyeOptions
from stcal.handeye.validate import LEAST_LEFT, HeldOutPoses, cross_validate, splits
from stcal.io.cameras.model import CameraPrior
from stcal.parallel import one_thread


@dataclass(frozen=True, slots=True, eq=False)
class Validated:
    """A result with its errors on held-out poses. ``held_out`` : None if too few would be left; ``options`` : as used;
    ``choice`` : the ways that were tried, if none was named; ``notes`` : why errors are missing."""

    result: HandEye
    held_out: HeldOutPoses | None
    options: HandEyeOptions
    choice: Choice | None = None
    notes: tuple[str, ...] = ()


def validated(
    pairs: HandEyePoses,
    setup: Setup,
    method: str | None,
    views: Views | None,
    options: HandEyeOptions,
    prior: CameraPrior | None,
    rows: np.ndarray,
    workers: int | None = 1,
    progress: Callable[[int, int], None] = lambda *_: None,
    choosing: bool = False,
) -> Validated:
    """Returns the result of a method, or of the way that predicts best, with σ that hold for poses held out.

    ``prior`` : of intrinsics that may be solved for; ``rows`` : (s, k) poses to hold out; ``choosing`` : among all
    ways. Raises StcalError: as :func:`stcal.handeye.handeye`.
    """
    try:
        if choosing and len(rows):
            choice = choose(pairs, setup, views, options, prior, rows, workers, progress)
            return Validated(choice.result, choice.held_out, choice.chosen.options(options, prior), choice)
        result = solve.handeye(pairs, setup, method, views, options)
        if not len(rows):
            return Validated(result, None, options)
        held_out = cross_validate(pairs, setup, method, views, options, rows, workers, progress)
        return Validated(held_out.widened(result), held_out, options)
    except DegenerateError as error:  # if not of all poses, then of those besides some
        result = solve.handeye(pairs, setup, method, views, options)
        return Validated(result, None, options, notes=(f"no errors on poses held out: {error}",))


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
    base_from_flange : Poses or (m, 4, 4) array
        At least three poses, rotated about two axes that are not parallel.
    camera_from_board : Poses or (m, 4, 4) array
        The pose of the board in the camera in each of them. After ``pairs``, the setup may stand here.
    method : str, optional
        One of :data:`METHODS`. If None, the way that predicts poses held out best, among all methods, with the board's
        size as stated or solved for; ``reprojection`` with views, else ``pose``, where ``options`` name unknowns.
    views : Views, optional
        The corners from which the poses were computed. ``reprojection`` adjusts them; with ``pose`` they carry the
        camera's errors into σ.
    options : HandEyeOptions, optional
        Known errors of robot and camera, and further unknowns; the defaults if None.
    setup : {"eye-in-hand", "eye-to-hand"}
        ``eye-in-hand``: the camera on the flange, also if None; ``eye-to-hand``: the board on the flange.
    unit : {"mm", "m", "cm", "um", "in"}
        Unit of translations.
    pairs : HandEyePoses
        Pairs of poses in place of the first two, also as the first argument; see :func:`~stcal.handeye.read_poses`,
        :func:`~stcal.handeye.pairs_of_views`.

    Returns
    -------
    HandEye
        X and Z with covariances, residuals, outliers, notes on anything doubtful, and the verdict.

    Raises
    ------
    InputError
        The method or setup is unknown, ``reprojection`` has no views, or the poses follow another convention.
    DegenerateError
        The poses do not determine the answer; the message says which motion is missing.
    ConvergenceError
        The method fails on these poses.

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
    options = options or HandEyeOptions()
    rows = splits(len(pairs)) if len(pairs) > LEAST_LEFT else np.zeros((0, 0), int)
    prior = None if views is None else options.camera
    choosing = method is None and not options.names_unknowns
    found = validated(pairs, asked, method, views, options, prior, rows, choosing=choosing)
    x, z = found.result.mount_from_camera, found.result.stand_from_board
    notes = (*found.notes, *of_setup(x, z, asked, setup is not None))
    outcome = Outcome("", found.result, found.held_out, notes=notes, choice=found.choice, pairs=pairs)
    return replace(found.result, judgement=judged(outcome), notes=outcome.all_notes())
