"""Straight edges between dark and bright areas, their crossings and corners of tags, by the areas in each pixel."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from stcal.boards.area import (
    PIXEL_VARIANCE,
    PRIOR_PX,
    Displacement,
    SamplingVariance,
    across_edges,
    displacement_variance,
    integrated_step,
    of_sampling,
    passed_by_blur,
    products,
    reach_of,
    solved,
)
from stcal.geometry.arrays import rms
from stcal.geometry.least_squares import block_diagonal
from stcal.geometry.robust import median_length

SAMPLES = 25  # number of samples of a profile across an edge
POINTS = 32  # largest number of places along an edge that are used; at most one per pixel
ALONG = (0.08, 0.92)
"""Range of an edge that is used, as shares of its length: near its ends the next edge's blur disturbs it."""
LEAST_ALONG = 0.25
"""Share of an edge to either side of its middle that is used, however wide the blur is."""
END_PX = 2.0  # distance from an edge's ends from which on pixels are used, px
CELLS_ACROSS = 0.8
"""Reach of a profile to either side, in cells; the border of a tag, and the white around it, is one cell wide."""
REACH_PX = (1.5, 6.0)
MIN_RISE = 0.15
"""Smallest step that counts as a part of the edge, as a share of a profile's steepest step; smaller ones are noise."""
MIN_CONTRAST = 0.3
"""Smallest contrast of a profile, as a share of the tag's; a lower one is another tag's edge, a stain or a shadow."""
MIN_SHARE = 0.25  # smallest share of good profiles of a visible edge
MIN_CELL_PX = 2.0
CUT = 2.5  # largest distance of a point from the line, in robust σ; points beyond it are outliers
CUT_ROUNDS = 4
MIN_SIGMA_PX = 0.01
"""Smallest σ of edge points: below it printing, flatness and the lens limit the accuracy of a corner, not noise."""
STEPS = 3  # number of Gauss–Newton steps; the last one is below a thousandth of a pixel
START_VARIANCE, MIN_VARIANCE = 0.4, 0.01  # variance of the blur at the start, and its lower limit, px²
MOST_MOVED_PX = 1.0
"""Largest distance of an edge from where its profiles have it; one that ends farther away stays with the profiles."""
SMEAR_SHARE, SMEAR_POWER = 0.08, 3
"""Error of an edge's place that motion over one cell causes, as a share of the cell, and how it grows with the way."""
TOLD, LONG_SMEAR = 4.0, 0.4
"""Difference of two directions' blur, in RMS of what is left, from which it is motion; way that is named, in cells."""
ROUNDING = 1 / 12  # variance of rounding to whole grey values
BLURS, LEAST_INSIDE_PX = 2.5, 1.0
"""Distance of pixels from the tag's inner cells, in σ of blur and pixel, and least width of the border's band, px."""
CLEAR_BLURS = 1.5  # distance of pixels from the pattern next to a crossing, in σ of blur and pixel
SHADED_HALF_PX = 4  # half the side of a window from which on grey values may change along it
CROSSING_STEPS = 4
"""Number of Gauss–Newton steps to a crossing, which may end :data:`MOST_MOVED_PX` from its start."""
MOST_LEFT = 0.15
"""Largest RMS residual of a window, as a share of the contrast; a window with a larger one shows something else."""
WIDEST_BLUR = 0.4
"""Largest σ of the blur, in half sides of the window: a wider one leaves no area of one colour."""


def corners_from_edges(
    grey: np.ndarray, corners: np.ndarray, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Refine the corners (n, 4, 2), in cyclic order, of dark tags with ``cells`` (n,) cells per side, border included.
    Return them with the covariances (n, 8, 8) of the four of a tag together, a mask (n,) of the tags of which all edges
    are visible, and the way by which motion during the exposure blurs edges, px, 0 where it is short beside a cell."""
    n = len(corners)
    if not n:
        return np.zeros((0, 4, 2)), np.zeros((0, 8, 8)), np.zeros(0, bool), 0.0
    frame = _Edges(np.asarray(corners, float), cells)
    offset, good = _profiles(grey, frame)
    with np.errstate(divide="ignore", invalid="ignore"):  # edges that are not visible
        rough = _fit(frame.place, offset, good)
        area = _Area(grey, frame, rough)
        meeting = _meet(frame, area.lines(rough, SamplingVariance(0.0, 0.0)))[0]
        covariance = _meet(frame, area.lines(rough, displacement_variance(area.told)))[1]
    seen = good.mean(2) >= MIN_SHARE
    seen &= np.isfinite(covariance.sum((1, 2)))[:, None] & (frame.length >= MIN_CELL_PX * np.reshape(cells, (-1, 1)))
    return meeting, covariance, seen.all(1), area.smear_px


def corners_by_edges(corners: np.ndarray) -> np.ndarray:
    """Return the shifts of the corners (..., 4, 2) of tags, in cyclic order, if all four edges move outwards by one."""
    along = np.roll(corners, -1, axis=-2) - corners
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    outwards = np.sign((normal * (corners - corners.mean(-2, keepdims=True))).sum((-1, -2)))
    normal *= outwards[..., None, None]
    pair = np.stack([np.roll(normal, 1, axis=-2), normal], axis=-2)
    return np.linalg.solve(pair, np.ones((*pair.shape[:-1], 1)))[..., 0]


class _Edges:
    """Geometry of the four edges of tags with ``corners`` (n, 4, 2) and ``cells`` (n,) per side, px."""

    def __init__(self, corners: np.ndarray, cells: np.ndarray):
        end, number = np.roll(corners, -1, axis=1), np.reshape(cells, (-1, 1))
        self.length = np.linalg.norm(end - corners, axis=2)  # (n, 4)
        self.along = (end - corners) / self.length[..., None]  # (n, 4, 2)
        self.middle = (corners + end) / 2  # (n, 4, 2)
        normal = np.stack([self.along[..., 1], -self.along[..., 0]], axis=-1)
        depth = 2 * ((self.middle - corners.mean(1, keepdims=True)) * normal).sum(2)
        self.normal = normal * np.where(depth < 0, -1.0, 1.0)[..., None]  # (n, 4, 2) outwards
        self.cell = np.minimum(np.abs(depth), self.length) / number  # (n, 4) width of a cell across
        self.cells = np.broadcast_to(number, self.length.shape)  # (n, 4) number of cells along
        self.reach = np.clip(CELLS_ACROSS * self.cell, *REACH_PX)  # (n, 4) of the profiles
        # (n, 4, POINTS) of the profiles from the middle
        self.place = (np.linspace(*ALONG, POINTS) - 0.5) * self.length[..., None]


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines of points p with ``normal @ (p − middle) = offset + slope · along @ (p − middle)``."""

    offset: np.ndarray  # (n, 4)
    slope: np.ndarray  # (n, 4)
    covariance: np.ndarray  # (n, 4, 2, 2) of the two
    keep: np.ndarray  # (n, 4, POINTS) profiles that are no outliers


def _profiles(grey: np.ndarray, frame: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """Return the edge in each profile, px from the frame's line, and a mask of good profiles, (n, 4, POINTS)."""
    n = len(frame.length)
    across = np.linspace(-1, 1, SAMPLES) * frame.reach[..., None]
    base = frame.middle[:, :, None] + frame.place[..., None] * frame.along[:, :, None]
    xy = base[:, :, :, None] + (across[..., None] * frame.normal[:, :, None])[:, :, None]
    flat = xy.reshape(4 * n, POINTS * SAMPLES, 2).astype(np.float32)
    level = cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR).astype(np.float32)
    level = level.reshape(n, 4, POINTS, SAMPLES)
    inside = np.all((xy >= 0) & (xy <= [grey.shape[1] - 1, grey.shape[0] - 1]), axis=(2, 3, 4))
    rise = np.diff(level, axis=3).clip(0)
    rise[rise < MIN_RISE * rise.max(3, keepdims=True)] = 0
    total = rise.sum(3)
    low, high = np.percentile(level.reshape(n, -1), [5, 95], axis=1)
    good = (total > MIN_CONTRAST * (high - low)[:, None, None]) & (total > 0) & inside[..., None]
    middle = (across[..., 1:] + across[..., :-1]) / 2
    return np.einsum("nkps,nks->nkp", rise, middle) / np.where(good, total, 1.0), good


def _fit(place: np.ndarray, offset: np.ndarray, good: np.ndarray) -> _Lines:
    keep = good
    for _ in range(CUT_ROUNDS):
        value, spread = _line(place, offset, keep)
        off = np.abs(offset - value[..., :1] - value[..., 1:] * place)
        sorted_off = np.sort(np.where(keep, off, np.inf), axis=2)
        middle = np.maximum(keep.sum(2, keepdims=True) - 1, 0) // 2
        sigma = np.take_along_axis(sorted_off, middle, axis=2) / median_length(1)
        new = good & (off < CUT * np.maximum(sigma, MIN_SIGMA_PX))
        if (new == keep).all():
            break
        keep = new
    value, spread = _line(place, offset, keep)
    off = offset - value[..., :1] - value[..., 1:] * place
    count = keep.sum(2)
    variance = np.maximum((off**2 * keep).sum(2) / (count - 2), MIN_SIGMA_PX**2)
    extent = np.where(keep, place, -np.inf).max(2) - np.where(keep, place, np.inf).min(2)
    points = np.minimum(count, np.maximum(extent, 1.0))
    return _Lines(value[..., 0], value[..., 1], (variance * count / points)[..., None, None] * spread, keep)


def _pixels(grey: np.ndarray, frame: _Edges, rough: _Lines) -> tuple[np.ndarray, ...]:
    """Return level, places along and across from the edge's middle, and use (m, p, s) of the pixels within reach of m
    edges, in the p columns or rows of the profiles that are kept; and how ``across`` rises (m,) by pixel."""
    m, each = frame.length.size, np.arange(frame.length.size)
    middle, along, normal = (value.reshape(m, 2) for value in (frame.middle, frame.along, frame.normal))
    length, reach = frame.length.reshape(m, 1, 1), frame.reach.reshape(m, 1, 1)
    offset, slope = (np.nan_to_num(value).reshape(m, 1) for value in (rough.offset, rough.slope))
    place = frame.place.reshape(m, -1)
    point = middle[:, None] + place[..., None] * along[:, None] + (offset + slope * place)[..., None] * normal[:, None]
    major = np.abs(along).argmax(1)
    # Each profile moves to the nearest column; of those in one column, one is used.
    column = np.rint(point[each, :, major])
    keep = rough.keep.reshape(m, -1).copy()
    keep[:, 1:] &= np.diff(column, axis=1) != 0
    rise = (along[each, 1 - major] / along[each, major])[:, None]
    start = np.rint(point[each, :, 1 - major] + rise * (column - point[each, :, major]))
    level, xy, inside = across_edges(grey, major, column, start, reach_of(reach, normal[each, 1 - major]))
    off = xy - middle[:, None, None]
    t, d = np.einsum("mpsi,mi->mps", off, along), np.einsum("mpsi,mi->mps", off, normal)
    used = keep[..., None] & inside
    used &= np.abs(d - offset[..., None] - slope[..., None] * t) <= reach
    used &= np.abs(t) <= np.minimum((0.5 - ALONG[0]) * length, length / 2 - END_PX)
    return level, t, d, used.astype(float), normal[each, 1 - major]


class _Area:
    """Lines of the edges of tags by area, with what their σ are made of."""

    def __init__(self, grey: np.ndarray, frame: _Edges, rough: _Lines):
        level, t, d, weight, per_pixel = _pixels(grey, frame, rough)
        m, shape = len(level), frame.length.shape
        normal, most = frame.normal.reshape(m, 2), frame.reach.ravel() ** 2
        length = frame.length.reshape(m, 1, 1)
        relative = 2 * t / length
        distance = residual = d
        design, inverse = np.zeros((*t.shape, 7)), np.zeros((m, 7, 7))
        value = np.zeros((m, 7))  # offset, slope, variance of blur, dark and rise with their changes along the edge
        value[:, :2] = np.nan_to_num(np.stack([rough.offset, rough.slope], -1).reshape(m, 2))
        value[:, 2] = START_VARIANCE
        for k in range(STEPS + 1):
            if k == STEPS - 1:  # the blur is known: the next cell's must not reach the pixels, nor the next edge's
                blurs = BLURS * np.sqrt(value[:, 2] + PIXEL_VARIANCE)[:, None, None]
                weight = weight * (distance >= -np.maximum(frame.cell.reshape(m, 1, 1) - blurs, LEAST_INSIDE_PX))
                weight = weight * (np.abs(t) <= np.maximum(length / 2 - blurs, LEAST_ALONG * length))
            distance = d - value[:, :1, None] - value[:, 1:2, None] * t
            step, slope, widening = integrated_step(distance, normal, value[:, 2])
            levels = np.stack([np.ones_like(t), relative, step, step * relative], axis=-1)
            if not k:  # the levels follow linearly
                value[:, 3:] = solved(levels, weight, level)[0]
            rise = value[:, 5, None, None] + value[:, 6, None, None] * relative
            residual = level - (levels @ value[:, None, 3:, None])[..., 0]
            by_edge = (rise * np.stack([-slope, -slope * t, widening])).transpose(1, 2, 3, 0)
            design = np.concatenate([by_edge, levels], -1)
            change, inverse = solved(design, weight, residual)
            if k < STEPS:
                value += change
                value[:, 2] = value[:, 2].clip(MIN_VARIANCE, most)
                value = np.where(np.isfinite(value), value, 0.0)
        good = np.isfinite(inverse).all((1, 2)) & (weight.sum((1, 2)) > 2 * design.shape[-1])
        sampling = of_sampling(distance, per_pixel, design[..., 0])
        explained = [solved(design, weight, column)[0] for column in np.moveaxis(sampling, -1, 0)]
        harmonic = sampling - np.stack([(design @ part[:, None, :, None])[..., 0] for part in explained], axis=-1)
        scatter = residual - (harmonic @ solved(harmonic, weight, residual)[0][:, None, :, None])[..., 0]
        noise = _noise_of(scatter, distance, weight)
        noise = noise * _growth_of_tags(scatter, design[..., 0], weight, noise, good, shape)
        self.passed = passed_by_blur(per_pixel, value[:, 2])  # (m,) share of sampling that the blur passes
        # (m, 2, 2) derivatives of offset and slope by the two harmonics of sampling, in columns
        self.by_sampling = (inverse @ products(design, weight, sampling))[:, :2]
        shift, uncertain = _by_next_cells(frame, design, rise, distance, t, weight, inverse, value[:, 2])
        # (m, 2, 2) covariance of offset and slope without sampling
        by_noise = noise[:, None, None] * inverse[:, :2, :2] + uncertain
        self.by_noise = np.where(good[:, None, None], by_noise, np.nan)
        smear = _smear(normal, value[:, 2], good)
        self.by_noise[:, 0, 0] += (SMEAR_SHARE * smear * (smear / frame.cell.reshape(m)) ** SMEAR_POWER) ** 2
        # way of motion, 0 where it is short
        self.smear_px = float(smear.max()) if (smear > LONG_SMEAR * frame.cell.reshape(m)).any() else 0.0
        # of the offset, by the profiles along rotated edges
        self.told = _told_along(residual, harmonic, self.passed, weight, noise, good)
        line = np.moveaxis((value[:, :2] - shift).reshape(*shape, 2), 2, 0)
        # (n, 4) False where the profiles' line is kept
        self.settled = (np.abs(line[0] - rough.offset) < MOST_MOVED_PX) & (value[:, 5] > 0).reshape(shape)
        self.offset, self.slope = np.where(self.settled, line, [rough.offset, rough.slope])  # (n, 4) as in _Lines

    def lines(self, rough: _Lines, variance: SamplingVariance) -> _Lines:
        """Return the lines with their covariances, where sampling displaces them by ``variance``."""
        displaced = self.by_sampling @ np.swapaxes(self.by_sampling, 1, 2)
        covariance = self.by_noise + variance.of(self.passed)[:, None, None] * displaced
        covariance = covariance.reshape(*self.offset.shape, 2, 2)
        covariance = np.where(self.settled[..., None, None], covariance, rough.covariance)
        return _Lines(self.offset, self.slope, covariance, rough.keep)


def _smear(normal: np.ndarray, blur: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Return by what way (m,), px, motion during the exposure widens edges with these normals (m, 2) and blurs (m,)."""
    if good.sum() < 4:
        return np.zeros(len(blur))
    x, y = normal.T
    rows = np.stack([x * x, 2 * x * y, y * y], axis=1)
    xx, xy, yy = told = np.linalg.lstsq(rows[good], blur[good], rcond=1e-3)[0]
    least, most = np.linalg.eigvalsh([[xx, xy], [xy, yy]])
    if most - least < TOLD * rms(blur[good] - rows[good] @ told):
        return np.zeros(len(blur))
    return np.sqrt(12 * np.maximum(rows @ told - max(least, MIN_VARIANCE), 0.0))


def _by_next_cells(frame, design, rise, distance, t, weight, inverse, variance) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of the shift (m, 2) of offset and slope by random cells behind the border."""
    m, cells = len(design), frame.cells.ravel()
    blur = np.sqrt(variance + PIXEL_VARIANCE)[:, None, None]
    brought = rise * ndtr(-(distance + frame.cell.reshape(m, 1, 1)) / blur)
    number = np.floor((t / frame.length.reshape(m, 1, 1) + 0.5) * cells[:, None, None]).astype(int)
    inner = weight * brought * ((number >= 1) & (number <= cells[:, None, None] - 2))
    most = int(cells.max(initial=1))
    pull = _by_class(number.clip(0, most - 1), most, np.moveaxis(inner[..., None] * design, -1, 0))
    moved = (pull @ inverse)[..., :2]
    return moved.sum(1) / 2, np.swapaxes(moved, 1, 2) @ moved / 4


BIN_PX = 0.25
"""Width of a class of distances from an edge of a crossing: pixels in one class see the same part of its profile."""


def _by_class(number: np.ndarray, classes: int, values: Iterable[np.ndarray]) -> np.ndarray:
    """Return the sums (n, classes, k) of k values (n, …) of pixels that have these class numbers (n, …)."""
    n = len(number)
    row = (number + classes * np.arange(n).reshape(-1, *[1] * (number.ndim - 1))).ravel()
    return np.stack([np.bincount(row, part.ravel(), n * classes).reshape(n, classes) for part in values], axis=-1)


def _by_distance(distance: np.ndarray, farthest_px: float, values: Iterable[np.ndarray]) -> np.ndarray:
    """Return the sums of :func:`_by_class` of pixels in one class of distances from an edge, which all move alike."""
    most = round(farthest_px / BIN_PX)
    return _by_class(np.rint(distance / BIN_PX).clip(-most, most).astype(int) + most, 2 * most + 1, values)


def _told_along(residual, harmonic, passed, weight, noise, good) -> Displacement:
    """Return what turned edges say: whether their profiles move with the phase."""
    pulled = products(harmonic, weight, residual[..., None])[..., 0]
    gram = products(harmonic, weight, harmonic)
    by_noise, by_displacement = noise * np.trace(gram, axis1=1, axis2=2), np.maximum((gram**2).sum((1, 2)), 1e-12)
    square = ((pulled**2).sum(1) - by_noise) / by_displacement
    return Displacement(np.where(good, square, np.nan), by_noise / by_displacement, passed)


def _noise_of(residual, distance, weight) -> np.ndarray:
    """Return the variances (m,) of single pixels, from their scatter within classes of distances from the edge."""
    count, total = np.moveaxis(_by_distance(distance, 2 * REACH_PX[1], (weight, weight * residual)), 2, 0)
    within = (weight * residual**2).sum((1, 2)) - (total**2 / np.maximum(count, 1)).sum(1)
    return np.maximum(within / np.maximum(count.sum(1) - (count > 0).sum(1), 1), ROUNDING)


def _growth_of_tags(residual, offset, weight, noise, good, shape) -> np.ndarray:
    """Return factors (m,) of variances by edges that are not straight, for each tag: squared pulls over expected."""
    of_profile = ((weight * offset * residual).sum(2) ** 2).sum(1)
    profiles = weight.any(2).sum(1)
    expected = noise * (weight * offset**2).sum((1, 2)) * (1 - 2 / np.maximum(profiles, 3))
    usable = np.where(good & (profiles > 3), 1.0, 0.0).reshape(shape)
    growth = (usable * of_profile.reshape(shape)).sum(1) / np.maximum((usable * expected.reshape(shape)).sum(1), 1e-12)
    return np.repeat(np.maximum(growth, 1.0), shape[1])


def _line(place: np.ndarray, offset: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and slope (n, 4, 2) of the points ``keep``, and their inverse normal matrix (n, 4, 2, 2)."""
    s0, s1, s2 = keep.sum(2), (place * keep).sum(2), (place**2 * keep).sum(2)
    y0, y1 = (offset * keep).sum(2), (offset * place * keep).sum(2)
    inverse = np.stack([np.stack([s2, -s1], -1), np.stack([-s1, s0.astype(float)], -1)], -2)
    inverse = inverse / (s0 * s2 - s1**2)[..., None, None]
    return (inverse @ np.stack([y0, y1], -1)[..., None])[..., 0], inverse


def _meet(frame: _Edges, lines: _Lines) -> tuple[np.ndarray, np.ndarray]:
    """Return the intersection of each edge with the previous one, (n, 4, 2), and the covariance (n, 8, 8) of all."""
    row = frame.normal - lines.slope[..., None] * frame.along
    right = lines.offset + (row * frame.middle).sum(2)
    pair = np.stack([np.roll(row, 1, axis=1), row], axis=2)
    bad = ~np.isfinite(pair).all((2, 3)) | (np.abs(np.linalg.det(np.nan_to_num(pair))) < 1e-6)
    pair[bad] = np.eye(2)
    inverse = np.linalg.inv(pair)
    point = (inverse @ np.stack([np.roll(right, 1, axis=1), right], axis=2)[..., None])[..., 0]
    n, corner = len(pair), np.arange(4)
    by_line = np.zeros((n, 4, 2, 4, 2))
    for side, turn in enumerate((1, 0)):
        middle, along = np.roll(frame.middle, turn, axis=1), np.roll(frame.along, turn, axis=1)
        gradient = np.stack([np.ones(point.shape[:2]), ((point - middle) * along).sum(2)], axis=-1)
        moved = inverse[..., side, None] * gradient[:, :, None]
        by_line[:, corner, :, (corner - turn) % 4] = np.moveaxis(moved, 1, 0)
    by_line = by_line.reshape(n, 8, 8)
    covariance = by_line @ block_diagonal(lines.covariance) @ np.swapaxes(by_line, 1, 2)
    covariance[bad.any(1)] = np.nan
    return point, covariance


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Crossings ``xy_px`` (n, 2) with ``covariance_px2`` (n, 2, 2); ``seen`` : (n,) False if a window shows none."""

    xy_px: np.ndarray
    covariance_px2: np.ndarray
    seen: np.ndarray

    def otherwise(self, other: "Crossings") -> "Crossings":
        """Return these crossings, those that are not seen as ``other`` has them."""
        return Crossings(
            np.where(self.seen[:, None], self.xy_px, other.xy_px),
            np.where(self.seen[:, None, None], self.covariance_px2, other.covariance_px2),
            self.seen | other.seen,
        )


def crossings(
    grey: np.ndarray, start: np.ndarray, along: np.ndarray, half: np.ndarray, clear_px: np.ndarray
) -> Crossings:
    """Measure the crossings near ``start`` (n, 2) of edges in the directions ``along`` (n, 2, 2), one edge in a row.
    ``half`` : (n,) half the sides of the square windows, whole px; ``clear_px`` : (n,) distance to the nearest pattern
    other than the two edges, from where blur carries light into pixels, which are not used then."""
    n = len(start)
    xy, covariance, seen = start.astype(float), np.full((n, 2, 2), np.nan), np.zeros(n, bool)
    for side in np.unique(half).tolist():
        rows = np.flatnonzero(half == side)
        xy[rows], covariance[rows], seen[rows] = _of_size(grey, start[rows], along[rows], side, clear_px[rows])
    return Crossings(np.where(seen[:, None], xy, start), covariance, seen)


def _of_size(grey, start, along, half: int, clear_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossings, their covariances and a mask of those seen, for windows of one size."""
    n, shaded = len(start), half >= SHADED_HALF_PX
    q, parameters = 11, 11 if shaded else 7
    offsets = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), axis=-1).reshape(-1, 2)
    pixels = np.rint(start).astype(int)[:, None] + offsets
    last = np.array(grey.shape[::-1]) - 1
    inside = ((pixels >= 0) & (pixels <= last)).all((1, 2))
    x, y = np.moveaxis(pixels.clip(0, last), 2, 0)
    level, weight = grey[y, x].astype(float), np.ones(x.shape)
    relative = offsets / half * shaded
    shade = np.broadcast_to(np.column_stack([np.ones(len(offsets)), relative]), (n, len(offsets), 3))
    angle = np.arctan2(along[..., 1], along[..., 0])
    value = np.zeros((n, q))  # shift, turns of both edges, variance of the blur, dark and rise with their gradients
    value[:, 4] = START_VARIANCE
    residual = first = second = distance = level
    design, inverse = np.zeros((*level.shape, q)), np.zeros((n, q, q))
    for k in range(CROSSING_STEPS + 1):
        if k == CROSSING_STEPS - 1:  # the blur is known
            reach = clear_px - CLEAR_BLURS * np.sqrt(value[:, 4] + PIXEL_VARIANCE)
            reach = np.maximum(reach, half if shaded else 2 * half)  # a small window is needed whole
            weight = weight * (np.linalg.norm(pixels - (start + value[:, :2])[:, None], axis=2) <= reach[:, None])
        direction = np.stack([np.cos(angle + value[:, 2:4]), np.sin(angle + value[:, 2:4])], axis=-1)
        normal = np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
        off = pixels - (start + value[:, :2])[:, None]
        distance, place = (np.einsum("nki,nei->enk", off, axes) for axes in (normal, direction))
        steps = (integrated_step(distance[e], normal[:, e], value[:, 4]) for e in (0, 1))
        (one, slope1, wide1), (two, slope2, wide2) = steps
        # Where edges are not square, the pixel sees both at once (first term of the tetrachoric series).
        both = (normal[:, 0] * normal[:, 1]).sum(1) * (value[:, 4] + PIXEL_VARIANCE)
        cross = one * two + (1 - one) * (1 - two) + 2 * both[:, None] * slope1 * slope2
        by_first, by_second = (2 * two - 1) * slope1, (2 * one - 1) * slope2
        levels = np.concatenate([shade, cross[..., None] * shade], axis=2)
        if not k:
            value[:, 5:] = solved(levels, weight, level)[0]
        rise = (shade @ value[:, 8:, None])[..., 0]
        first, second = rise * by_first, rise * by_second
        by_shift = -first[..., None] * normal[:, None, 0] - second[..., None] * normal[:, None, 1]
        by_turns = np.stack([-first * place[0], -second * place[1]], axis=-1)
        by_blur = rise * ((2 * two - 1) * wide1 + (2 * one - 1) * wide2)
        design = np.concatenate([by_shift, by_turns, by_blur[..., None], levels], axis=2)
        residual = level - (levels @ value[:, 5:, None])[..., 0]
        change, inverse = solved(design, weight, residual)
        if k < CROSSING_STEPS:
            value += np.where(np.isfinite(change), change, 0.0)
            value[:, 4] = value[:, 4].clip(MIN_VARIANCE, half**2)
    redundancy = weight.sum(1) - parameters
    noise = np.maximum((weight * residual**2).sum(1) / np.maximum(redundancy, 1), ROUNDING)
    noise = np.maximum(noise, np.median(noise))  # a few pixels alone do not tell it
    pull = weight[..., None] * (design @ inverse)[..., :2]
    near = np.where(np.abs(distance[0]) <= np.abs(distance[1]), place[0], place[1] + 4 * half)
    growth = _growth(pull, residual, near, noise, 2 * half + 1, float(np.median(value[:, 4])))
    covariance = growth * noise[:, None, None] * inverse[:, :2, :2]
    for e, displaced in enumerate((first, second)):
        passed = passed_by_blur(np.abs(normal[:, e]).max(1), value[:, 4])
        summed = _by_distance(distance[e], 2 * half, np.moveaxis(pull * displaced[..., None], 2, 0))
        covariance += (PRIOR_PX * passed[:, None, None]) ** 2 * np.swapaxes(summed, 1, 2) @ summed
    seen = inside & (redundancy > q) & np.isfinite(covariance).all((1, 2))
    seen &= np.linalg.norm(value[:, :2], axis=1) <= MOST_MOVED_PX
    seen &= (np.sqrt(noise) <= MOST_LEFT * np.abs(value[:, 8])) & (np.sqrt(value[:, 4]) <= WIDEST_BLUR * half)
    return start + value[:, :2], covariance, seen


def _growth(
    pull: np.ndarray,  # (n, k, 2) derivatives of a crossing by the pixels of its window
    residual: np.ndarray,  # (n, k) grey values
    place: np.ndarray,  # (n, k) profiles of the pixels, px along the edges; different numbers on both
    noise: np.ndarray,  # (n,) variances of the pixels
    profiles: int,  # number on each edge
    blur: float,  # variance, px²; neighbours at a distance k correlate by exp(−k²/4σ²)
) -> float:
    """Return the factor, 1 or more, of all variances by edges that are not straight: all pixels of a profile move."""
    number = np.rint(place).astype(int)
    number -= number.min()
    pulls = _by_class(number, number.max() + 1, np.moveaxis(pull * residual[..., None], 2, 0))
    squares = np.square(pulls).sum(2).sum(1)
    expected = noise * (pull**2).sum((1, 2)) * (1 - 2 / profiles)
    told = expected > 0
    if not told.any():
        return 1.0
    together = max(2 * np.sqrt(np.pi * (blur + PIXEL_VARIANCE)), 1.0)
    return 1 + together * max(float(np.median(squares[told] / expected[told])) - 1, 0.0)
