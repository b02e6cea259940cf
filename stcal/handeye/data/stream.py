"""The robot's poses as a stream with times, and the pose at the time of an image."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Poses

LONGEST_S = 0.25
"""Between two samples a pose is interpolated where they are not farther apart …"""
TOLERANCE_S = 0.02
"""… else the nearest sample stands for it within this, if no other tolerance is stated."""
SAME_S = 1e-9
"""Times that are equal."""
NANOSECONDS_FROM = Decimal(10) ** 14
LEAST_STAMP = Decimal(10) ** 8
"""Whole numbers below are numbers of images, not seconds since 1970."""
STEP = 1e-3
"""Of a derivative, in spacings of the samples."""
WINDOW = 4
"""Samples of a cubic."""
LOO_NOISE = float(np.sqrt(1 + 34 / 36))
"""By which a sample's noise and that of its four neighbours make it miss their cubic, in σ of one."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """n poses of the flange in order of their times.

    ``seconds`` : (n,) after ``origin``, the first sample's, of the robot's clock; ``base_from_flange`` : n, mm;
    ``where`` : the file's name.
    """

    seconds: np.ndarray
    base_from_flange: Poses
    origin: Decimal
    where: str

    def __post_init__(self):
        object.__setattr__(self, "seconds", frozen(self.seconds, (len(self.base_from_flange),), "times"))

    def __len__(self) -> int:
        return len(self.seconds)

    @classmethod
    def of(cls, times: Sequence[Decimal], poses: Poses, where: str) -> "Stream":
        """In any order.

        Raises
        ------
        InputError
            Fewer than two samples, or two of one time.
        """
        if len(times) < 2:
            raise InputError(
                "E-TIMES-FEW", f"{where}: {len(times)} sample with a time, 2 needed; give the whole stream"
            )
        order = sorted(range(len(times)), key=times.__getitem__)
        origin = times[order[0]]
        seconds = np.array([float(times[i] - origin) for i in order])
        if len(same := np.flatnonzero(np.diff(seconds) < SAME_S)):
            raise InputError(
                "E-TIMES-REPEATED", f"{where}: two samples of the time {times[order[same[0]]]}; take one of them out"
            )
        return cls(seconds, poses[order], origin, where)

    def after_origin(self, times: Sequence[Decimal]) -> np.ndarray:
        """(k,) s."""
        return np.array([float(time - self.origin) for time in times])

    def at(self, seconds: np.ndarray) -> Poses:
        """Poses (k,) at times after the origin: of a cubic through the four samples about each (Lagrange), of rotations
        in the rotation vectors from the sample before. Outside it goes on, and should not be asked."""
        n, width = len(self), min(WINDOW, len(self))
        before = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, n - 2)
        nodes = np.clip(before - 1, 0, n - width)[:, None] + np.arange(width)
        weight = _lagrange(self.seconds[nodes], seconds)
        return self._weighted(before, nodes, weight)

    def velocity(self, seconds: np.ndarray) -> np.ndarray:
        """(k, 6) at times after the origin: of the left perturbation, rad/s and mm/s."""
        step = STEP * self.spacing_s()
        return self.at(seconds + step).difference(self.at(seconds - step)) / (2 * step)

    def spacing_s(self) -> float:
        """Median between samples."""
        return float(np.median(np.diff(self.seconds)))

    def rest(self) -> tuple[float, float]:
        """By how much a sample misses the cubic through its four neighbours (RMS; rad, mm), as σ of one sample where
        that is noise: interpolation errs less. NaN of fewer than five."""
        n = len(self)
        if n < WINDOW + 1:
            return float("nan"), float("nan")
        own = np.arange(2, n - 2)
        nodes = own[:, None] + np.array([-2, -1, 1, 2])
        close = self.seconds[nodes[:, -1]] - self.seconds[nodes[:, 0]] <= WINDOW * LONGEST_S
        own, nodes = own[close], nodes[close]
        if not len(own):
            return float("nan"), float("nan")
        met = self._weighted(own - 1, nodes, _lagrange(self.seconds[nodes], self.seconds[own]))
        off = self.base_from_flange[own].difference(met).reshape(-1, 2, 3)
        turn, shift = np.sqrt((off**2).sum(2).mean(0)) / LOO_NOISE
        return float(turn), float(shift)

    def travel(self, seconds: np.ndarray, window_s: float) -> tuple[float, float]:
        """RMS turn (rad) and way (mm) of the flange within a window about each time."""
        low, high = (np.clip(seconds + s * window_s / 2, 0, self.seconds[-1]) for s in (-1, 1))
        off = self.at(high).difference(self.at(low)).reshape(-1, 2, 3)
        turn, way = np.sqrt((off**2).sum(2).mean(0))
        return float(turn), float(way)

    def _weighted(self, reference: np.ndarray, nodes: np.ndarray, weight: np.ndarray) -> Poses:
        base = np.asarray(self.base_from_flange.rotation)
        about = base[reference]
        turned = base[nodes] @ np.swapaxes(about, 1, 2)[:, None]
        logs = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(*nodes.shape, 3)
        turn = Rotation.from_rotvec(np.einsum("kn,kna->ka", weight, logs)).as_matrix()
        place = np.einsum("kn,kna->ka", weight, np.asarray(self.base_from_flange.translation)[nodes])
        return Poses(turn @ about, place)


def _lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Weights (k, w) of values at nodes (k, w) for the polynomial through them, at (k,)."""
    width = nodes.shape[1]
    weight = np.ones(nodes.shape)
    for i in range(width):
        for j in range(width):
            if i != j:
                weight[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return weight


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """``stream`` of the robot's poses; ``seconds`` : (m,) times of the pairs after its origin by the camera's clock."""

    stream: Stream
    seconds: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """Poses at k times: ``kept`` : (k,) whether there is one; ``base_from_flange`` : of those kept; ``why`` : (k,) why
    there is none, empty where there is; ``said`` : what was done, in a line."""

    kept: np.ndarray
    base_from_flange: Poses
    why: tuple[str, ...]
    said: str


def taken_at(stream: Stream, seconds: np.ndarray, tolerance_s: float = TOLERANCE_S) -> Taken:
    """Poses at times (k,) after the stream's origin, interpolated where its samples are close, else of the nearest
    within the tolerance."""
    own = stream.seconds
    after = np.clip(np.searchsorted(own, seconds), 1, len(own) - 1)
    before = after - 1
    nearest = np.where(seconds - own[before] <= own[after] - seconds, before, after)
    away = np.abs(own[nearest] - seconds)
    inside = (seconds >= own[0]) & (seconds <= own[-1]) & (own[after] - own[before] <= LONGEST_S)
    near, same = away <= tolerance_s, away < SAME_S
    kept = inside | near | same
    at = np.where(inside & ~same, seconds, own[nearest])
    why = []
    for k, time in enumerate(seconds):
        if kept[k]:
            why.append("")
        elif own[0] <= time <= own[-1]:
            gap = own[after[k]] - own[before[k]]
            why.append(
                f"in a gap of {gap:.3g} s of {stream.where}, {LONGEST_S:g} s allowed; the nearest sample is "
                f"{away[k]:.3g} s away, {tolerance_s:g} s allowed (--time-tolerance)"
            )
        else:
            side = "before" if time < own[0] else "after"
            why.append(
                f"{away[k]:.4g} s {side} the samples of {stream.where}, {tolerance_s:g} s allowed (--time-tolerance)"
            )
    counts = int(same.sum()), int((inside & ~same).sum()), int((kept & ~inside & ~same).sum())
    parts = [f"{counts[0]} at a sample"] if counts[0] else []
    if counts[1]:
        turn, shift = stream.rest()
        rest = "" if np.isnan(turn) else f", each within {shift:.2g} mm and {np.degrees(turn):.2g}° of the others"
        parts.append(f"{counts[1]} interpolated (cubic; samples {stream.spacing_s():.3g} s apart{rest})")
    if counts[2]:
        farthest = away[kept & ~inside & ~same].max()
        parts.append(f"{counts[2]} by the nearest sample, up to {farthest:.3g} s away ({tolerance_s:g} s allowed)")
    if len(seconds) > kept.sum():
        parts.append(f"{len(seconds) - int(kept.sum())} left out")
    said = f"poses by time: {len(seconds)} times in {len(own)} samples of {stream.where}: {', '.join(parts)}"
    return Taken(kept, stream.at(at[kept]) if kept.any() else Poses.of([]), tuple(why), said)


def stamps_of(names: Sequence[str]) -> list[Decimal] | None:
    """Times that names are, s; None where one is none, or all are whole numbers as of a count of images."""
    found = [time_of(name) for name in names]
    times = [time for time in found if time is not None]
    if not times or len(times) < len(found):
        return None
    fraction = any(re.search(r"\d\.\d", name) for name in names)
    return times if fraction or max(abs(time) for time in times) >= LEAST_STAMP else None


def time_of(name: str) -> Decimal | None:
    """Seconds; numbers of nanoseconds as seconds too."""
    try:
        value = Decimal(stem_of(name) if not re.fullmatch(r"[-+\d.eE]+", name) else name)
    except InvalidOperation:
        return None
    if not value.is_finite():
        return None
    return value.scaleb(-9) if value >= NANOSECONDS_FROM else value.normalize()


def stem_of(name: str) -> str:
    last = PurePosixPath(name.replace("\\", "/")).name
    return last.rsplit(".", 1)[0] if re.search(r"\.[A-Za-z]\w{1,4}$", last) else last
