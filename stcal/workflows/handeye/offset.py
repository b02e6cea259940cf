"""The offset between the clocks of robot and camera, found before X and Z and carried through them."""

from dataclasses import replace

import numpy as np

from stcal.errors import InputError
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.pairs import Setup
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.report.outcome import Outcome
from stcal.handeye.time_offset import TimeOffset, estimate_offset
from stcal.parallel import one_thread
from stcal.workflows.handeye.inputs import HandEyeInput


@one_thread()
def at_offset(
    given: HandEyeInput, setup: Setup, options: HandEyeOptions
) -> tuple[HandEyeInput, HandEyeOptions, TimeOffset]:
    """Returns the same input with the robot's poses at the estimated offset.

    Numberings of a symmetric board are put right.

    Raises
    ------
    InputError
        There are no times, or the robot has four axes.
    StcalError
        For the reasons given in :func:`~stcal.handeye.time_offset.estimate_offset`.
    """
    timed = given.timed
    if timed is None:
        raise InputError(
            "E-POSES-UNTIMED",
            f"{given.where}: --time-offset needs times of both, of the robot's poses (a column time_s, or TUM) and of "
            "the images (their names, or --image-times)",
        )
    if options.four_dof:
        raise InputError(
            "E-OPTION-CONFLICT",
            "--time-offset: not with --four-dof, whose motions do not tell it; leave one of them out",
        )
    pairs, views, notes = given.pairs, given.views, ()
    if options.symmetries:
        mended = repair(pairs, setup, options.symmetries, views)
        pairs, views, notes = mended.pairs, mended.views, mended.notes()
    offset = estimate_offset(pairs, timed.stream, timed.seconds, setup, options.noise, options.with_scale)
    rows = np.flatnonzero(offset.kept)
    outside = [
        (name, "outside of the robot's times at the time offset")
        for name, k in zip(pairs.names, offset.kept, strict=True)
        if not k
    ]
    given = replace(
        given,
        pairs=replace(pairs[rows], base_from_flange=offset.base_from_flange),
        views=None if views is None else views[rows],
        symmetries=(),
        left_out=(*given.left_out, *outside),
        understood=(*given.understood, *notes),
    )
    return given, replace(options, symmetries=()), offset


def with_offset(outcome: Outcome, offset: TimeOffset | None) -> Outcome:
    """Returns the outcome with the offset in the report, and its σ in those of the transforms."""
    if offset is None:
        return outcome
    return replace(outcome, result=offset.carried(outcome.result), time_offset=offset)
