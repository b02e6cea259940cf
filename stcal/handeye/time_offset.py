"""Offset between the clocks of robot and camera, from images that were taken while the robot moved.

The trajectory's derivative is a further column of the pose adjustment (as in Kelly & Sukhatme, Int. J. Robotics Res.
30, 2011, and Furgale, Rehder & Siegwart, IROS 2013; here the trajectory is the robot's own, with estimated errors).
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.data.pose_pairs import HandEyePoses, Loop, Setup, rms_of
from stcal.handeye.data.stream import Stream
from stcal.handeye.handeye_problem import HandEye
from stcal.handeye.methods import closed_form
from stcal.handeye.methods.pose_adjustment import UNKNOWNS, Noise, adjust_poses

WITHIN_S, SCAN_S = 1.0, 0.05
"""Range and step of the scan for a first offset, in s. A robot's motion within one step is smooth."""
MOST_STEP_S = 0.05
ROUNDS = 30
SETTLED = 1e-3  # largest last step as a share of σ
WINDOW_S = 0.1  # time window around an image in which the flange must move, in s
MOVED = 5.0  # least motion of the flange within the window, in multiples of the noise of the stream's samples
MOST_SIGMA_S = 0.1  # largest σ with which an offset is reported, in s
LEAST_KEPT = 2 / 3  # least share of the images that must lie within the stream for an offset to be tried
LEAST_POSES = 4
"""Least number of poses: three of six numbers each leave too little redundancy for σ beside thirteen unknowns."""


@dataclass(frozen=True, slots=True, eq=False)
class TimeOffset:
    """Lead of the robot's clock over the camera's: an image stamped t was taken when it showed t + ``seconds``.

    ``sigma_s`` : σ of ``seconds``; ``slope`` : (12,) change of X and Z per second of offset (rad, mm); ``kept`` : (m,)
    poses whose corrected time lies within the stream; ``base_from_flange`` : poses then, mm; ``speed_rad_s``,
    ``speed_mm_s`` : RMS speed of the flange.
    """

    seconds: float
    sigma_s: float
    slope: np.ndarray
    kept: np.ndarray
    base_from_flange: Poses
    speed_rad_s: float
    speed_mm_s: float

    def __post_init__(self):
        freeze(self, "slope", (UNKNOWNS,), "slope")
        freeze(self, "kept", (None,), "kept", bool)

    def in_words(self) -> str:
        """Returns the offset with its sign, σ, and the speed of the flange as one sentence."""
        order, sign = ("ahead of", "+") if self.seconds >= 0 else ("behind", "-")
        offset, speed = f"{1e3 * self.seconds:.2f} ± {1e3 * self.sigma_s:.2g} ms", f"{self.speed_mm_s:.3g} mm/s"
        said = f"time offset: {offset}, robot's clock minus camera's: the robot's is {order} the camera's, an image "
        said += f"stamped t was taken at t {sign} {1e3 * abs(self.seconds):.2f} ms of the robot's; the flange moves by "
        return said + f"{speed} and {np.degrees(self.speed_rad_s):.3g}°/s at the images (RMS)"

    def carried(self, result: HandEye) -> HandEye:
        """Returns ``result``, which was solved at the offset, with the offset's σ propagated into its covariances."""
        if result.covariance is None or result.stand_covariance is None:
            return result
        shift = self.sigma_s**2 * np.outer(self.slope, self.slope)
        mount, stand = result.covariance + shift[:6, :6], result.stand_covariance + shift[6:, 6:]
        return replace(result, covariance=mount, stand_covariance=stand)


def estimate_offset(
    pairs: HandEyePoses,
    stream: Stream,
    seconds: np.ndarray,
    setup: Setup = "eye-in-hand",
    noise: Noise | None = None,
    with_scale: bool = False,
) -> TimeOffset:
    """Estimates offset, X and Z by least squares of the loop's residuals, with σ estimated as by method ``pose``.
    ``pairs`` : only their poses of the board are used; ``seconds`` : (m,) times of the pairs after the stream's origin,
    by the camera's clock. Raises InputError: too few poses, or too few within the stream. Raises DegenerateError: the
    flange stands still at the images, or its motions leave the offset open. Raises ConvergenceError: it does not
    converge."""
    noise = noise or Noise()
    if len(pairs) < LEAST_POSES:
        raise InputError("E-TIME-OFFSET-FEW", f"{pairs.where}: {len(pairs)} poses, {LEAST_POSES} needed for an offset")
    if (within := _inside(stream, seconds)).any():  # at rest the noise of the samples would pass for motion
        noises, moved = stream.rest(), stream.travel(seconds[within], WINDOW_S)
        if not any(way > MOVED * max(np.nan_to_num(own), 1e-9) for own, way in zip(noises, moved, strict=True)):
            said = f"{stream.where}: the flange stands still at the images, {moved[1]:.2g} mm and "
            said += f"{np.degrees(moved[0]):.2g}° within {WINDOW_S:g} s (RMS), where samples err by {noises[1]:.2g} mm "
            said += f"and {np.degrees(noises[0]):.2g}°: no time offset can be determined; leave --time-offset out, or "
            said += "take images while the robot moves"
            raise DegenerateError("E-TIME-OFFSET-STANDSTILL", said)
    offset, state = _scanned(pairs, stream, seconds, setup, with_scale), None
    for _ in range(ROUNDS):
        within = _inside(stream, seconds + offset)
        if within.sum() < LEAST_POSES:
            said = f"{stream.where}: {within.sum()} images within it at an offset of {offset:.3g} s; give more"
            raise InputError("E-TIME-OFFSET-RANGE", said)
        at = seconds[within] + offset
        loop = Loop.of(replace(pairs[within], base_from_flange=stream.at(at)), setup)
        state = state or closed_form.robust(loop, with_scale)
        solution = adjust_poses(loop, state, noise, with_scale)
        state, speed, count = solution.state, stream.velocity(at), UNKNOWNS + with_scale
        x, scale = state.mount_from_camera, state.scale
        by_time = loop.by_robot(x, scale) @ speed[:, :, None]
        jacobian = np.concatenate([loop.jacobian(x, scale, count), by_time], axis=2)
        used = np.flatnonzero(~solution.outliers)
        weighted = np.linalg.solve(solution.covariance[used], jacobian[used])
        inverse = generalised_inverse(np.einsum("mai,maj->ij", jacobian[used], weighted))
        sigma = float(np.sqrt(inverse[count, count]))
        step = -float(inverse[count] @ np.einsum("mai,ma->i", weighted, solution.residuals[used]))
        if not 0 < sigma < MOST_SIGMA_S:
            said = f"{stream.where}: the time offset would have σ {sigma:.2g} s, {MOST_SIGMA_S:g} s allowed: the "
            said += "motions at the images do not determine it; leave --time-offset out, or take images while the "
            said += "flange turns and moves"
            raise DegenerateError("E-TIME-OFFSET-SIGMA", said)
        offset += float(np.clip(step, -MOST_STEP_S, MOST_STEP_S))
        if abs(step) < SETTLED * sigma:
            within = _inside(stream, seconds + offset)
            turn, travel = rms_of(speed)
            slope = inverse[:UNKNOWNS, count] / inverse[count, count]
            at = stream.at(seconds[within] + offset)
            return TimeOffset(offset, sigma, slope, within, at, turn, travel)
    said = f"{stream.where}: the time offset does not settle, last {offset:.4g} ± {sigma:.2g} s"
    raise ConvergenceError("E-TIME-OFFSET-UNSETTLED", f"{said}; check times and poses")


def _inside(stream: Stream, seconds: np.ndarray) -> np.ndarray:
    """Returns a mask (m,) of the times that lie within the stream."""
    return (seconds >= 0) & (seconds <= stream.seconds[-1])


def _scanned(pairs: HandEyePoses, stream: Stream, seconds: np.ndarray, setup: Setup, with_scale: bool) -> float:
    """Returns the offset at which a first solution fits best, to one step of the scan."""
    best, least = 0.0, np.inf
    for offset in np.arange(-WITHIN_S, WITHIN_S + SCAN_S / 2, SCAN_S):
        within = _inside(stream, seconds + offset)
        if within.sum() < max(LEAST_POSES, LEAST_KEPT * len(seconds)):
            continue
        loop = Loop.of(replace(pairs[within], base_from_flange=stream.at(seconds[within] + offset)), setup)
        miss = np.median(loop.misses(*closed_form.robust(loop, with_scale)), axis=0)
        cost = float(np.log(miss + 1e-12).sum())
        if cost < least:
            best, least = float(offset), cost
    if not np.isfinite(least):
        share = _inside(stream, seconds).sum()
        said = f"{stream.where}: {share} of {len(seconds)} images lie within its times, {LEAST_KEPT:.0%} needed at "
        said += f"some offset up to {WITHIN_S:g} s; give the whole stream, and times of clocks that differ by less"
        raise InputError("E-TIME-OFFSET-RANGE", said)
    return best
