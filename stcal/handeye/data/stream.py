"""Streams of the robot's poses with times, and the pose at the time of an image."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import permutations
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.rigid import Poses
from stcal.handeye.data.pose_pairs import rms_of

LONGEST_S = 0.25  # largest distance in time of two samples between which a pose is interpolated
TOLERANCE_S = 0.02  # default tolerance within which the nearest sample replaces a pose that cannot be interpolated
SAME_S = 1e-9  # difference below which times are equal
NANOSECONDS_FROM = Decimal(10) ** 14
LEAST_STAMP = Decimal(10) ** 8  # whole numbers below this are numbers of images, not seconds since 1970
STEP = 1e-3  # step of a numerical derivative, in spacings of the samples
WINDOW = 4  # number of samples of a cubic
LOO_NOISE = float(np.sqrt(1 + 34 / 36))
"""Scatter of a sample about the cubic through its four neighbours, in σ of one sample, with the noise of all five."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """n poses of the flange in order of their times.

    ``seconds`` : (n,) times after ``origin``, the time of the first sample by the robot's clock; ``base_from_flange`` :
    n, mm; ``where`` : the file's name.
    """

    seconds: np.ndarray
    base_from_flange: Poses
    origin: Decimal
    where: str

    def __post_init__(self):
        freeze(self, "seconds", (len(self.base_from_flange),), "times")

    def __len__(self) -> int:
        return len(self.seconds)

    @classmethod
    def of(cls, times: Sequence[Decimal], poses: Poses, where: str) -> "Stream":
        """Returns the stream of samples that may be in any order."""
        if len(times) < 2:
            raise InputError("E-TIMES-FEW", f"{where}: {len(times)} sample with a time, 2 needed; give the stream")
        order = sorted(range(len(times)), key=times.__getitem__)
        origin = times[order[0]]
        seconds = np.array([float(times[i] - origin) for i in order])
        if len(same := np.flatnonzero(np.diff(seconds) < SAME_S)):
            raise InputError("E-TIMES-REPEATED", f"{where}: two samples of time {times[order[same[0]]]}; take one out")
        return cls(seconds, poses[order], origin, where)

    def after_origin(self, times: Sequence[Decimal]) -> np.ndarray:
        """Returns times (k,) after the origin, in s."""
        return np.array([float(time - self.origin) for time in times])

    def at(self, seconds: np.ndarray) -> Poses:
        """Returns poses (k,) at times after the origin, each from the cubic through four samples about it (Lagrange),
        in rotation vectors from the sample before. Do not use it outside the samples."""
        n, width = len(self), min(WINDOW, len(self))
        before = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, n - 2)
        nodes = np.clip(before - 1, 0, n - width)[:, None] + np.arange(width)
        return self._weighted(before, nodes, _lagrange(self.seconds[nodes], seconds))

    def velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Returns velocities (k, 6) at times after the origin, of the left perturbation, rad/s and mm/s."""
        step = STEP * self.spacing_s()
        return self.at(seconds + step).difference(self.at(seconds - step)) / (2 * step)

    def spacing_s(self) -> float:
        """Returns the median time between samples."""
        return float(np.median(np.diff(self.seconds)))

    def rest(self) -> tuple[float, float]:
        """Returns σ of one sample (rad, mm), by samples' deviations from the cubic through their four neighbours; NaN
        if fewer than five. It holds where these are noise."""
        samples = np.arange(2, len(self) - 2)
        nodes = samples[:, None] + np.array([-2, -1, 1, 2])
        close = self.seconds[nodes[:, -1]] - self.seconds[nodes[:, 0]] <= WINDOW * LONGEST_S
        samples, nodes = samples[close], nodes[close]
        if not len(samples):
            return float("nan"), float("nan")
        interpolated = self._weighted(samples - 1, nodes, _lagrange(self.seconds[nodes], self.seconds[samples]))
        turn, shift = rms_of(self.base_from_flange[samples].difference(interpolated))
        return turn / LOO_NOISE, shift / LOO_NOISE

    def travel(self, seconds: np.ndarray, window_s: float) -> tuple[float, float]:
        """Returns the RMS rotation (rad) and travel (mm) of the flange within a window about each time."""
        low, high = (np.clip(seconds + s * window_s / 2, 0, self.seconds[-1]) for s in (-1, 1))
        return rms_of(self.at(high).difference(self.at(low)))

    def _weighted(self, reference: np.ndarray, nodes: np.ndarray, weight: np.ndarray) -> Poses:
        rotation = np.asarray(self.base_from_flange.rotation)
        reference_rotation = rotation[reference]
        turned = rotation[nodes] @ np.swapaxes(reference_rotation, 1, 2)[:, None]
        logs = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(*nodes.shape, 3)
        turn = Rotation.from_rotvec(np.einsum("kn,kna->ka", weight, logs)).as_matrix()
        place = np.einsum("kn,kna->ka", weight, np.asarray(self.base_from_flange.translation)[nodes])
        return Poses(turn @ reference_rotation, place)


def _lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns weights (k, w) of values at nodes (k, w) for the polynomial through them, evaluated at (k,)."""
    weight = np.ones(nodes.shape)
    for i, j in permutations(range(nodes.shape[1]), 2):
        weight[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return weight


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """``seconds`` : (m,) times of the pairs after the stream's origin, by the camera's clock."""

    stream: Stream
    seconds: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """``rows`` : places of the times at which there is a pose; ``base_from_flange`` : these poses; ``left_out`` : names
    of the other times, and why; ``said`` : a line on how the poses were found."""

    rows: list[int]
    base_from_flange: Poses
    left_out: tuple[tuple[str, str], ...]
    said: str


def taken_at(stream: Stream, seconds: np.ndarray, names: Sequence[str], tolerance_s: float = TOLERANCE_S) -> Taken:
    """Returns poses at times (k,) after the stream's origin, of ``names`` (k). They are interpolated where the samples
    are close, else taken from the nearest sample within the tolerance."""
    samples = stream.seconds
    after = np.clip(np.searchsorted(samples, seconds), 1, len(samples) - 1)
    nearest = np.where(seconds - samples[after - 1] <= samples[after] - seconds, after - 1, after)
    gap_s, spacing = np.abs(samples[nearest] - seconds), samples[after] - samples[after - 1]
    same, covered = gap_s < SAME_S, (seconds >= samples[0]) & (seconds <= samples[-1])
    between = covered & (spacing <= LONGEST_S) & ~same
    nearby = ~between & ~same & (gap_s <= tolerance_s)
    kept, left_out = between | same | nearby, []
    for k in np.flatnonzero(~kept).tolist():
        reason = f"{gap_s[k]:.4g} s {'before' if seconds[k] < samples[0] else 'after'} the samples of {stream.where}"
        if covered[k]:
            reason = f"in a gap of {spacing[k]:.3g} s of {stream.where}, {LONGEST_S:g} s allowed"
            reason += f"; the nearest sample is {gap_s[k]:.4g} s away"
        left_out.append((names[k], f"{reason}, {tolerance_s:g} s allowed (--time-tolerance)"))
    parts = [f"{same.sum()} at a sample"] if same.any() else []
    if between.any():
        turn, shift = stream.rest()
        noise = "" if np.isnan(turn) else f", each within {shift:.2g} mm and {np.degrees(turn):.2g}° of the others"
        parts.append(f"{between.sum()} interpolated (cubic; samples {stream.spacing_s():.3g} s apart{noise})")
    if nearby.any():
        farthest = f"up to {gap_s[nearby].max():.3g} s away ({tolerance_s:g} s allowed)"
        parts.append(f"{nearby.sum()} by the nearest sample, {farthest}")
    if left_out:
        parts.append(f"{len(left_out)} left out")
    message = f"poses by time: {len(seconds)} times in {len(samples)} samples of {stream.where}: {', '.join(parts)}"
    poses = stream.at(np.where(between, seconds, samples[nearest])[kept]) if kept.any() else Poses.of([])
    return Taken(np.flatnonzero(kept).tolist(), poses, tuple(left_out), message)


def stamps_of(names: Sequence[str]) -> list[Decimal] | None:
    """Returns the times that names mean, in s; None where one is none, or where all may count images."""
    times = [time for name in names if (time := time_of(name)) is not None]
    if not times or len(times) < len(names):
        return None
    fraction = any(re.search(r"\d\.\d", name) for name in names)
    return times if fraction or max(abs(time) for time in times) >= LEAST_STAMP else None


def time_of(name: str) -> Decimal | None:
    """Returns the time that a name means, in s, also from a number of nanoseconds; None where it is not a time."""
    try:
        value = Decimal(stem_of(name) if not re.fullmatch(r"[-+\d.eE]+", name) else name)
    except InvalidOperation:
        return None
    if not value.is_finite():
        return None
    return value.scaleb(-9) if value >= NANOSECONDS_FROM else value.normalize()


def stem_of(name: str) -> str:
    file_name = PurePosixPath(name.replace("\\", "/")).name
    return file_name.rsplit(".", 1)[0] if re.search(r"\.[A-Za-z]\w{1,4}$", file_name) else file_name
