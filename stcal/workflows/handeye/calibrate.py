"""Hand-eye calibration from a file of poses or from images of any board, for ``stcal handeye``. It composes three
systems."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.errors import StcalError
from stcal.geometry.arrays import require_arguments
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.pairs import Setup
from stcal.handeye.judge.remarks import Grave
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.pipeline import Validated, validated
from stcal.handeye.report.outcome import Outcome
from stcal.handeye.result import HandEye
from stcal.handeye.solve import handeye
from stcal.handeye.validate import (
    LEAST_LEFT,
    better_setup,
    compare,
    predict_motions,
    splits,
    widened_by_scatter,
)
from stcal.parallel import Progress
from stcal.workflows.handeye.arm import with_arm
from stcal.workflows.handeye.inputs import HandEyeInput
from stcal.workflows.handeye.offset import at_offset, lag_tried, with_offset

ALL, AUTO = "all", "auto"
"""Words in place of a method's name: all methods, compared; the way of solving that predicts best."""


@dataclass(frozen=True, slots=True)
class Splits:
    """Settings of the cross-validation: number of repeats, poses held out in each (a quarter if None), seed, processes;
    and number of the last motions to predict, if any."""

    repeats: int = 15
    held_out: int | None = None
    seed: int = 0
    workers: int | None = None
    motions: int | None = None


@require_arguments
def calibrate_handeye(
    given: HandEyeInput,
    method: str | None = None,
    options: HandEyeOptions | None = None,
    *,
    refine_camera: bool = False,
    time_offset: bool = False,
    repeats: int = 15,
    held_out: int | None = None,
    seed: int = 0,
    motions: int | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Returns where the camera sits on the flange, or in the base, with errors on poses held out.

    Parameters
    ----------
    given : HandEyeInput
        Of :func:`stcal.workflows.read_handeye`.
    method : str, optional
        One of :data:`stcal.handeye.METHODS`, or ``all`` to compare them; the way that predicts poses held out best if
        None.
    options : HandEyeOptions, optional
        Known errors, and further unknowns; the symmetries of the board are those of ``given``.
    refine_camera : bool
        Whether the intrinsics are adjusted, from those of the camera file with their σ.
    time_offset : bool
        Whether the offset of the two clocks is estimated first.
    repeats : int
        Number of splits of the cross-validation; 0 for none.
    held_out : int, optional
        Number of poses held out in each; a quarter if None.
    seed : int
        Seed of the splits.
    motions : int, optional
        Number of the last motions to predict from the poses before.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Outcome
        ``result``, a :class:`stcal.handeye.HandEye`, mm and rad; its errors on poses ``held_out``; ``all_notes()``.

    Raises
    ------
    StcalError
        As of :func:`stcal.handeye.handeye`; the message also names what was left out before.
    """
    setup, options, offset = given.setup or "eye-in-hand", options or HandEyeOptions(), None
    with_scale = options.with_scale or given.unit_mm is not None
    camera = given.prior if refine_camera else options.camera
    options = replace(options, camera=camera, with_scale=with_scale, symmetries=given.symmetries)
    if method is None and not (refine_camera or camera is not None or with_scale or options.four_dof):
        method = AUTO
    if time_offset:
        given, options, offset = at_offset(given, setup, options)
    validation = Splits(repeats, held_out, seed, workers, motions)
    told = progress or (lambda *_: None)
    return with_offset(calibrate(given, setup, method, options, validation, told, time_offset), offset)


def calibrate(
    given: HandEyeInput,
    setup: Setup,
    method: str | None,
    options: HandEyeOptions,
    validation: Splits,
    progress: Progress = lambda *_: None,
    offset_known: bool = False,
) -> Outcome:
    """Returns the result and its errors on poses held out.

    Clocks that differ are tried as a cause of residuals, unless poses of ``given`` are at a known offset already.

    All methods are compared where ``method`` is :data:`ALL`;
    the way of solving that predicts best is used where it is :data:`AUTO`.

    Raises
    ------
    StcalError
        For the reasons given in :func:`stcal.handeye.handeye`; the message also names what was left out before.
    """
    try:
        return _outcome(given, setup, method, options, validation, progress, offset_known)
    except StcalError as error:
        if not given.left_out:
            raise
        name, reason = given.left_out[0]
        error.append(f"; {len(given.left_out)} left out before, first {name}: {reason}")
        raise


FAR_MM, TOO_FAR_MM = 600.0, 1000.0
"""Distances of a camera from the flange that carries it that are doubted, and that are called wrong unless the setup is
stated; brackets are shorter."""


def _of_setup(given: HandEyeInput, setup: Setup, result: HandEye) -> tuple[str, ...]:
    """Returns a note if a setup that nobody stated puts the camera where no flange carries it. Poses of the other setup
    that were inverted before fit as well, so that no residual tells."""
    away = float(np.linalg.norm(result.mount_from_camera.translation))
    if setup != "eye-in-hand" or given.setup is not None or away < FAR_MM:
        return ()
    said = (
        f"the camera is {away:.0f} mm off the flange, farther than brackets reach, and no residual tells the setup: "
        "give --setup eye-to-hand if the camera stood beside the robot, --setup eye-in-hand if the flange carried it"
    )
    return (Grave(said) if away > TOO_FAR_MM else said,)


def _outcome(
    given: HandEyeInput,
    setup: Setup,
    method: str | None,
    options: HandEyeOptions,
    validation: Splits,
    progress: Progress,
    offset_known: bool,
) -> Outcome:
    pairs, views = given.pairs, given.views
    if options.camera is None:
        options = replace(options, camera=given.prior)
    compared, rows = (), np.zeros((0, 0), int)
    if validation.repeats and (validation.held_out or len(pairs) > LEAST_LEFT):
        rows = splits(len(pairs), validation.held_out, validation.repeats, validation.seed)
    if method == ALL:
        result, done = handeye(pairs, setup, None, views, options), partial(progress, "methods")
        compared = compare(pairs, setup, views, options, rows=rows, workers=validation.workers, progress=done)
        held_out = next(comparison.held_out for comparison in compared if comparison.method == result.method)
        solution = Validated(result if held_out is None else widened_by_scatter(result, held_out), held_out, options)
    else:
        prior, done = given.prior if views is not None else None, partial(progress, "held out")
        asked, spread = None if method == AUTO else method, (rows, validation.workers, done)
        solution = validated(pairs, setup, asked, views, options, prior, *spread, choosing=method == AUTO)
    result, options, notes = solution.result, solution.options, solution.notes
    if len(rows) and (meant := better_setup(pairs, setup, options, rows)):
        notes = (*notes, meant)
    notes = (*notes, *_of_setup(given, setup, result))
    if not offset_known:
        result, lagging = lag_tried(given, setup, options, result)
        notes = (*notes, *lagging)
    motions = None
    if validation.motions is not None:
        motions = predict_motions(pairs, setup, result.method, views, options, validation.motions)
    model = options.intrinsics.colmap_model if options.intrinsics else ""
    own_sigmas = views is not None and all(view.covariance is not None for view in views.views)
    if options.symmetries:
        mended = repair(pairs, setup, options.symmetries, views)
        pairs, views = mended.pairs, mended.views
    outcome = Outcome(
        given.where,
        result.with_common(given.pairs.common_of_camera()),
        solution.held_out,
        compared,
        given.pitch_mm,
        model,
        own_sigmas,
        given.left_out,
        notes,
        motions,
        solution.choice,
        understood=given.understood,
        unit_mm=given.unit_mm,
        pairs=pairs,
        views=views,
        folder=given.folder,
    )
    if given.arm is None:
        return outcome
    done = partial(progress, "with the arm")
    return with_arm(outcome, given.arm, options, given.prior, rows, validation.workers, done)
