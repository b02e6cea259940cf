"""The offset between the clocks of robot and camera: found before X and Z and carried through them, or tried as the
cause of residuals."""

from dataclasses import replace
from decimal import Decimal

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.normal_equations import generalised_inverse
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.pairs import HandEyePoses, Loop, Setup
from stcal.handeye.data.stream import LONGEST_S, Stream, Timed
from stcal.handeye.judge.remarks import Grave, SizeDoubt
from stcal.handeye.judge.symmetry import repair
from stcal.handeye.report.outcome import Outcome
from stcal.handeye.result import HandEye
from stcal.handeye.solve import handeye
from stcal.handeye.time_offset import TimeOffset, estimate_offset
from stcal.parallel import one_thread
from stcal.workflows.handeye.inputs import HandEyeInput

HINT_T, SURE_SIGMAS = 3.0, 4.0
"""Student's t of a first test from which an offset is solved for, and number of its σ from which it is reported: one
sound set in 16,000 is beyond the latter."""
FALLS = 0.98
"""Largest ratio of the mean squares of residuals with and without an offset at which the offset is reported although it
does no harm."""
HARMFUL = 1.0
"""Change of the transform by the offset, in σ of the transform, from which the transform is called wrong."""
ROW_S = 0.05
"""Time assumed between rows if poses have no times but follow one another smoothly: a scan of ±1 s then covers ±20
rows."""
SMOOTH, LEAST_ROWS = 0.2, 20
"""Largest deviation of poses from a cubic through their neighbours, as a share of the steps between them, with which
their order counts as that of a motion; and least number of such poses."""


@one_thread()
def at_offset(
    given: HandEyeInput, setup: Setup, options: HandEyeOptions
) -> tuple[HandEyeInput, HandEyeOptions, TimeOffset]:
    """Returns the same input with the robot's poses at the estimated offset.

    Numberings of a symmetric board are corrected.

    Raises InputError: there are no times, or the robot has four axes. Raises StcalError: for the reasons given in
    :func:`~stcal.handeye.time_offset.estimate_offset`.
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
            "--time-offset: not with --four-dof, whose motions do not determine it; leave one of them out",
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


@one_thread()
def lag_tried(
    given: HandEyeInput, setup: Setup, options: HandEyeOptions, result: HandEye
) -> tuple[HandEye, tuple[str, ...]]:
    """Returns the result and a note if clocks that differ explain its residuals; a doubt of the board's size that ends
    with the lag is then taken from the result's notes.

    The poses are those of ``given`` and ``result``, with no offset applied. Where poses have no times, their order
    gives velocities if they follow one another smoothly.
    """
    pairs = given.pairs
    timed = _moving(given)
    if timed is None or options.four_dof or len(result.outliers) != len(pairs):
        return result, ()
    try:
        if abs(_lag_t(pairs, timed, setup, result)) < HINT_T:
            return result, ()
        plain = replace(options, arm=None, intrinsics=None, camera=None, symmetries=())
        lag = estimate_offset(pairs, timed.stream, timed.seconds, setup, options.noise, options.with_scale)
        shifted = replace(pairs[np.flatnonzero(lag.kept)], base_from_flange=lag.base_from_flange)
        before, after = (handeye(each, setup, "pose", None, plain) for each in (pairs[lag.kept], shifted))
    except StcalError:  # the motions tell no offset
        return result, ()
    fits = [float((_lengths(each) ** 2).mean()) for each in (before, after)]
    harmful = _shift(result, lag) > HARMFUL
    if abs(lag.seconds) < SURE_SIGMAS * lag.sigma_s or fits[1] > (1.0 if harmful else FALLS) * fits[0]:
        return result, ()
    old, new = (f"{np.degrees(each.rms()[0]):.2g}° and {each.rms()[1]:.3g} mm" for each in (before, after))
    if given.timed is not None:
        order = "ahead of" if lag.seconds > 0 else "behind"
        said = (
            f"by the motions the robot's clock is {1e3 * abs(lag.seconds):.3g} ± {1e3 * lag.sigma_s:.2g} ms {order} "
            f"the camera's, with which residuals fall from {old} to {new}: solve with --time-offset"
        )
    else:
        order = "later" if lag.seconds > 0 else "earlier"
        said = (
            f"by the motions the board's poses are {abs(lag.seconds) / ROW_S:.2g} ± {lag.sigma_s / ROW_S:.1g} rows "
            f"{order} than the robot's, with which residuals fall from {old} to {new}: give both with times, and "
            "--time-offset"
        )
    if not any(isinstance(note, SizeDoubt) for note in after.notes):
        result = replace(result, notes=tuple(note for note in result.notes if not isinstance(note, SizeDoubt)))
    return result, (Grave(said) if harmful else said,)


def _moving(given: HandEyeInput) -> Timed | None:
    """Returns the robot's poses as a stream that tells its velocities at the images, by times or by the order of the
    rows; None where neither does.

    Where there is about one sample for each image, the poses must follow one another smoothly.
    """
    pairs, timed = given.pairs, given.timed
    if timed is not None and not _close(timed):
        return None
    if timed is not None and timed.stream.spacing_s() < float(np.median(np.diff(np.sort(timed.seconds)))) / 2:
        return timed
    if len(pairs) < LEAST_ROWS:
        return None
    if timed is None:
        seconds = ROW_S * np.arange(len(pairs))
        timed = Timed(Stream(seconds, pairs.base_from_flange, Decimal(0), pairs.where), seconds)
    poses = timed.stream.base_from_flange
    steps = poses[1:].difference(poses[:-1]).reshape(-1, 2, 3)
    steps_rms = np.sqrt((steps**2).sum(2).mean(0))
    smooth = all(own < SMOOTH * step for own, step in zip(timed.stream.rest(), steps_rms, strict=True))
    return timed if smooth else None


def _close(timed: Timed) -> bool:
    """Returns True if samples of the stream are so close about most images that poses between them are known."""
    samples = timed.stream.seconds
    after = np.clip(np.searchsorted(samples, timed.seconds, side="right"), 1, len(samples) - 1)
    return float(np.median(samples[after] - samples[after - 1])) <= LONGEST_S


def _lag_t(pairs: HandEyePoses, timed: Timed, setup: Setup, result: HandEye) -> float:
    """Returns Student's t of an offset that is solved for with X and Z, to first order, from the poses that are not
    outliers."""
    good = np.flatnonzero(~result.outliers)
    loop, x = Loop.of(pairs[good], setup), result.mount_from_camera
    residuals = loop.residuals(x, result.stand_from_board, result.scale)
    by_time = loop.by_robot(x, result.scale) @ timed.stream.velocity(timed.seconds[good])[:, :, None]
    columns = 12 + (result.sigma_scale is not None)
    jacobian = np.concatenate([loop.jacobian(x, result.scale)[:, :, :columns], by_time], axis=2)
    size = np.sqrt((residuals.reshape(-1, 2, 3) ** 2).mean((0, 2)))
    weight = 1 / np.repeat(np.maximum(size, 1e-12), 3)
    flat, left = (jacobian * weight[:, None]).reshape(-1, columns + 1), (residuals * weight).ravel()
    covariance = generalised_inverse(flat.T @ flat)
    step = -covariance @ (flat.T @ left)
    variance = float(((left + flat @ step) ** 2).sum()) / max(len(left) - columns - 1, 1)
    return float(step[-1] / np.sqrt(max(variance * covariance[-1, -1], 1e-300)))


def _lengths(result: HandEye) -> np.ndarray:
    """Returns the translation residuals (m,) of the poses that are no outliers, mm."""
    return np.linalg.norm(result.residuals[~result.outliers, 3:], axis=1)


def _shift(result: HandEye, lag: TimeOffset) -> float:
    """Returns the largest change of X by the offset, in σ of X; infinite where X has no σ."""
    if result.covariance is None:
        return float("inf")
    return float((np.abs(lag.seconds * lag.slope[:6]) / np.sqrt(np.diag(result.covariance))).max())
