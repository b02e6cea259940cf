"""Lines between the cells of tags, by the areas in each pixel: their scatter shows how far sampling displaces edges."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtr

from stcal.boards.board_designs import UNIT_SQUARE
from stcal.geometry.plane import apply_homography, fit_homographies

PIXEL_VARIANCE = 1 / 12  # variance of a square pixel about its centre, px²
PRIOR_PX = 0.005  # σ of the displacement of edges by the pixels' sampling before an image is seen, px
POINTS_PX = 0.01
"""The same of images that were resampled in points, as far as nothing shows that they were not, px."""
LEAST_PX = 0.0005  # least σ of a displacement that is told apart from another, px
ROUNDS = 5  # number of times that estimates are weighted by the variances found before
BY_CHANCE = 3.0  # number of σ up to which scatter of lines is taken for chance


def integrated_step(distance: np.ndarray, normal: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the share of the bright side of m edges in pixels, and its derivatives by distance and by variance. The
    square pixel as the edge's normal (m, 2) sees it is a trapezoid, the convolution of two boxes. The wider one, and
    with it an edge along the rows, is integrated exactly; the narrower one, like the blur of ``variance`` (m,) px², as
    a Gaussian. ``distance`` : (m, ...) of the pixels' centres, positive on the bright side, px."""
    narrow, wide = (side.reshape(-1, *(1,) * (distance.ndim - 1)) for side in np.sort(np.abs(normal), axis=1).T)
    sigma = np.sqrt(variance.reshape(narrow.shape) + narrow**2 / 12)
    first, last = ((distance + shift) / sigma for shift in (wide / 2, -wide / 2))
    below = ndtr(first), ndtr(last)
    density = tuple(np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi) for at in (first, last))
    step = sigma * (first * below[0] + density[0] - last * below[1] - density[1])
    widening = (density[0] - density[1]) / (2 * sigma)
    return step / wide, (below[0] - below[1]) / wide, widening / wide


def reach_of(reach: np.ndarray, rise: np.ndarray) -> int:
    """Return how many pixels to either side of the middle one, half a pixel off the edge, lie within ``reach`` (m,)."""
    across = reach.ravel() / np.abs(rise)
    return int(np.ceil(np.max(across, initial=1.0, where=np.isfinite(across)) + 0.5))


def across_edges(
    grey: np.ndarray, major: np.ndarray, column: np.ndarray, middle: np.ndarray, half: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return levels (m, p, s), places (m, p, s, 2) and whether they are in the image, of pixels across m edges.
    ``major`` : (m,) 0 for an edge along the rows, whose pixels are taken by columns; ``column``, ``middle`` : (m,
    p)."""
    across = middle[..., None] + np.arange(-half, half + 1)
    along = np.broadcast_to(column[..., None], across.shape)
    by_column = (major == 0)[:, None, None]
    x, y = np.where(by_column, along, across), np.where(by_column, across, along)
    height, width = grey.shape
    level = grey[y.clip(0, height - 1).astype(int), x.clip(0, width - 1).astype(int)].astype(float)
    return level, np.stack([x, y], axis=-1), (x >= 0) & (y >= 0) & (x < width) & (y < height)


def products(left: np.ndarray, weight: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the sums (m, q, k) over the pixels (p, s) of weight · left · rightᵀ, of (m, p, s, q) and (m, p, s, k)."""
    m, pixels = len(weight), int(np.prod(weight.shape[1:]))
    rows, others = (values.reshape(m, pixels, values.shape[-1]) for values in (left, right))
    return np.swapaxes(rows, 1, 2) @ (weight.reshape(m, pixels, 1) * others)


def solved(design: np.ndarray, weight: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares solutions (m, q) and inverse normal matrices (m, q, q), NaN where they are singular."""
    normal = products(design, weight, design) + 1e-9 * np.eye(design.shape[-1])
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:  # one of them is enough
        regular = np.linalg.matrix_rank(normal, hermitian=True) == normal.shape[-1]
        inverse = np.full_like(normal, np.nan)
        inverse[regular] = np.linalg.inv(normal[regular])
    return (inverse @ products(design, weight, right[..., None]))[..., 0], inverse


def passed_by_blur(rise: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the displacements (m,) of edges by sampling, relative to that of an edge along the rows: a Gaussian blur
    of ``variance`` σ² passes exp(−2π²σ²f²) of what the image contains at the frequency f of the pixels across the edge.
    ``rise`` : (m,) change of the distance from the edge from one pixel to the next."""
    return np.exp(-2 * np.pi**2 * variance * (rise**-2 - 1))


def of_sampling(distance: np.ndarray, rise: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return the gradients (m, p, s, 2) by a displacement of 1 px that follows the cosine, or the sine, of the phase:
    sampling displaces all profiles of an edge along the rows alike. ``gradient`` : (m, p, s) derivative of the grey
    values by the place of the edge."""
    angle = -2 * np.pi * distance / rise[:, None, None]
    return gradient[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """What lines say about the variance of the displacement of edges by sampling, px²; k estimates."""

    square: np.ndarray  # the variance, which may be negative
    noise: np.ndarray  # mean of its part by other errors
    lines: np.ndarray  # equivalent number of lines
    passed: np.ndarray  # as of :func:`passed_by_blur`


@dataclass(frozen=True, slots=True)
class SamplingVariance:
    """Variances of the displacement of edges by sampling, px²."""

    of_area: float  # of an edge along the rows; the blur passes less of it in turned ones
    of_points: float  # of all edges in images that were resampled in points before they were blurred

    def of(self, passed: np.ndarray) -> np.ndarray:
        """Return the variances of edges of which the blur passes ``passed`` (m,)."""
        return self.of_area * passed**2 + self.of_points


def displacement_variance(by_phase: Sequence[Displacement], otherwise: Sequence[Displacement] = ()) -> SamplingVariance:
    """Return the variances that explain the estimates best, weighted by their certainty; at least 0. Both have a prior.
    ``otherwise`` is the scatter of lines that does not follow the phase; it counts if it is beyond chance."""
    square, noise, lines, passed = _known(by_phase)
    design = np.stack([passed**2, np.ones_like(passed)], axis=-1)
    before = np.array([PRIOR_PX, POINTS_PX]) ** 2
    variance = before
    for _ in range(ROUNDS):
        root = np.sqrt(lines) / (noise + design @ variance + LEAST_PX**2)  # of weights: squares vary as themselves
        rows = np.concatenate([root[:, None] * design, np.diag(1 / before)])
        variance = nnls(rows, np.concatenate([root * square, np.ones(2)]))[0]
    square, noise, lines, _ = _known(otherwise)
    certainty = lines * (noise + PRIOR_PX**2) ** -2
    scatter, chance = (certainty * square).sum(), np.sqrt((certainty**2 * 2 * noise**2 / lines).sum())
    further = scatter / certainty.sum() if scatter > BY_CHANCE * chance else 0.0
    return SamplingVariance(float(variance[0]), float(variance[1] + further))


def _known(parts: Sequence[Displacement]) -> list[np.ndarray]:
    names = [part.name for part in fields(Displacement)]
    every = [np.concatenate([getattr(part, name) for part in parts] or [np.zeros(0)]) for name in names]
    known = np.isfinite(every[0]) & (every[2] > 0)
    return [values[known] for values in every]


CLEAR_BLURS = 2.5  # distance from other lines, in σ of blur and pixel, from which on pixels are used
END_BLURS = 2.0  # distance from the ends of a cell's side, in the same, from which on pixels are used
LEAST_BLURS, MOST_BLURS = 1.5, 4.0
"""Least and largest reach of pixels to either side of a line, in σ of blur and pixel."""
FARTHEST_PX = 0.1
"""Largest distance of a line from the tag's grid; cells that are printed in dots are not all of one size."""
MOST_PX = 0.04
"""Largest displacement by sampling that is believed; lines of a tag that scatter by more show its print."""
STEPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class OuterLines:
    """What was measured of the outer edges of n tags, from each corner to the next."""

    corners_px: np.ndarray  # (n, 4, 2)
    blur: np.ndarray  # (n,) variance, px²
    dark: np.ndarray  # (n,) grey values, as ``rise``
    rise: np.ndarray
    noise: np.ndarray  # (n,) variance of pixels
    variance: np.ndarray  # (n, 4) of the edges' offsets
    by_sampling: np.ndarray  # (n, 4, 2) their derivatives by the harmonics of sampling


def told_by_lines(grey: np.ndarray, outer: OuterLines, cells: int) -> tuple[Displacement, Displacement]:
    """Return the displacement of edges by sampling, estimated from the lines between cells, which are evenly spaced
    apart from perspective and lens: what is left of them and follows the phase of the pixels. And that by other errors,
    such as the print: the rest of their scatter."""
    square = np.broadcast_to(cells * (UNIT_SQUARE + 0.5), outer.corners_px.shape)
    image_from_grid = fit_homographies(square, outer.corners_px, np.ones(outer.corners_px.shape[:2], bool))
    middle = np.stack(np.meshgrid(np.arange(cells) + 0.5, np.arange(cells) + 0.5), axis=-1).reshape(-1, 2)
    xy = apply_homography(image_from_grid, middle).astype(np.float32)
    level = cv2.remap(grey, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR).astype(float)
    bright = (level > (outer.dark + outer.rise / 2)[:, None]).reshape(-1, cells, cells)
    return _scatter(cells, *_offsets(grey, _Pieces(image_from_grid, bright, cells), outer, cells))


class _Pieces:
    """The s sides between a dark and a bright cell in the grids of tags."""

    def __init__(self, image_from_grid: np.ndarray, bright: np.ndarray, cells: int):
        found = []
        for axis, colour in enumerate((np.swapaxes(bright, 1, 2), bright)):  # (n, line, along); 0: lines of one x
            change = colour[:, 1:].astype(int) - colour[:, :-1]
            tag, line, along = np.nonzero(change)
            found.append((tag, np.full(len(tag), axis), line + 1, along, change[change != 0].astype(float)))
        self.tag, self.axis, self.line, place, self.sign = (np.concatenate(parts) for parts in zip(*found, strict=True))
        self.along = (2 * place + 1) / cells - 1  # place on the line, -1 to 1
        step, across = np.eye(2)[1 - self.axis], np.eye(2)[self.axis]
        corner = self.line[:, None] * across + place[:, None] * step
        self.start, self.end, before, after = (  # (s, 2) px
            apply_homography(image_from_grid[self.tag], (corner + move)[:, None])[:, 0]
            for move in (0 * step, step, -across, across)
        )
        direction = (self.end - self.start) / np.linalg.norm(self.end - self.start, axis=1, keepdims=True)
        normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
        # (s, 2) towards the next cell, whose side is ``sign`` +1 where it is bright
        self.normal = normal * np.sign(((after - before) * normal).sum(1))[:, None]
        # How far the cell's other sides run along the line for each px across it.
        self.lean = ((after - before) * direction).sum(1) / ((after - before) * self.normal).sum(1)
        widths = [np.abs(((there - self.start) * self.normal).sum(1)) for there in (before, after)]
        self.cell = np.minimum(*widths)  # distance to the next line, px


def _offsets(grey: np.ndarray, pieces: _Pieces, outer: OuterLines, cells: int) -> tuple[np.ndarray, ...]:
    """Return the offsets of the lines between cells, and of the outer edges, from the grid, px, NaN where a line is not
    seen; their variances, derivatives by sampling and mean places of the sides used, (2n, k) by tag and direction, k
    lines of both signs apart; and what the blur passes, (2n,)."""
    n = len(outer.blur)
    shape = (n, 2, cells + 1, 2)
    group = np.ravel_multi_index((pieces.tag, pieces.axis, pieces.line, (pieces.sign > 0).astype(int)), shape)
    level, distance, used, rise = _pixels(grey, pieces, np.sqrt(outer.blur + PIXEL_VARIANCE))
    blur, sign = outer.blur[pieces.tag], pieces.sign[:, None, None]
    value = np.zeros((n * 4 * (cells + 1), 3))  # shift, dark, rise
    value[:, 1], value[:, 2] = (np.repeat(part, 4 * (cells + 1)) for part in (outer.dark, outer.rise))
    inverse, pull = np.zeros((len(value), 3, 3)), np.zeros((len(value), 3, 2))
    for _ in range(STEPS):
        own = value[group][:, :, None, None]
        away = distance - own[:, 0]
        step, slope = integrated_step(sign * away, pieces.normal, blur)[:2]
        design = np.stack([-own[:, 2] * sign * slope, np.ones_like(step), step], axis=-1)
        residual = level - own[:, 1] - own[:, 2] * step
        sampling = of_sampling(away, rise, design[..., 0])
        rows = products(design, used, np.concatenate([design, sampling, residual[..., None]], -1))
        total = np.zeros((len(value), 3, 6))
        np.add.at(total, group, rows)
        seen = total[:, 1, 1] > 0
        inverse = np.where(seen[:, None, None], np.linalg.inv(total[..., :3] + 1e-9 * np.eye(3)), np.nan)
        value += (inverse @ total[..., 5:])[..., 0]
        pull = inverse @ total[..., 3:5]
    offset = value[:, 0].reshape(shape)
    variance = inverse[:, 0, 0].reshape(shape) * outer.noise[:, None, None, None]
    by_sampling = pull[:, 0].reshape(*shape, 2)
    offset[~(np.abs(offset) < FARTHEST_PX)] = np.nan
    for edge, axis, line, sign in ((0, 1, 0, 0), (1, 0, -1, 1), (2, 1, -1, 1), (3, 0, 0, 0)):
        offset[:, axis, line, sign] = 0.0
        variance[:, axis, line, sign] = outer.variance[:, edge]
        by_sampling[:, axis, line, sign] = outer.by_sampling[:, edge] * (-1 if line == 0 else 1)  # outwards there
    pixels = used.sum((1, 2))
    along = np.bincount(group, pixels * pieces.along, len(value)) / np.bincount(group, pixels, len(value)).clip(1)
    direction = 2 * pieces.tag + pieces.axis
    passed = np.bincount(direction, passed_by_blur(rise, blur), 2 * n) / np.bincount(direction, minlength=2 * n).clip(1)
    flat = 2 * n, 2 * (cells + 1)
    return offset.reshape(flat), variance.reshape(flat), by_sampling.reshape(*flat, 2), along.reshape(flat), passed


def _pixels(grey: np.ndarray, pieces: _Pieces, sigma: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return level, distance from the line and use (s, p, a) of pixels, and the distance's rise (s,) by pixel."""
    each, sigma = np.arange(len(pieces.tag)), sigma[pieces.tag]
    along = pieces.end - pieces.start
    length = np.linalg.norm(along, axis=1)
    major = np.abs(along).argmax(1)
    direction = along / np.maximum(length, 1e-9)[:, None]
    ends = np.sort(np.stack([pieces.start[each, major], pieces.end[each, major]]), axis=0)
    first, last = np.ceil(ends[0]), np.floor(ends[1])
    reach = np.minimum(pieces.cell - CLEAR_BLURS * sigma, MOST_BLURS * sigma)
    most = int(max(np.max(last - first, initial=0.0), 0.0)) + 1
    half = reach_of(reach, pieces.normal[each, 1 - major])
    column = first[:, None] + np.arange(most)
    slope = along[each, 1 - major] / along[each, major]
    middle = np.rint(pieces.start[each, 1 - major, None] + slope[:, None] * (column - pieces.start[each, major, None]))
    level, xy, inside = across_edges(grey, major, column, middle, half)
    off = xy - pieces.start[:, None, None]
    place, distance = (np.einsum("spai,si->spa", off, axis) for axis in (direction, pieces.normal))
    place = place - pieces.lean[:, None, None] * distance
    used = (np.abs(distance) <= reach[:, None, None]) & (column <= last[:, None])[..., None]
    used &= np.abs(place - length[:, None, None] / 2) <= (length / 2 - END_BLURS * sigma)[:, None, None]
    used &= (reach > LEAST_BLURS * sigma)[:, None, None] & inside
    return level, distance, used.astype(float), pieces.normal[each, 1 - major]


def _scatter(cells: int, offset, variance, by_sampling, along, passed) -> tuple[Displacement, Displacement]:
    """Return what evenly spaced lines say by tag and direction: how they move with the phase, and scatter otherwise."""
    place = 2 * np.arange(cells + 1) / cells - 1
    sign, place = np.tile([-1.0, 1.0], cells + 1), np.repeat(place, 2)
    m, k = offset.shape
    fixed = np.stack([np.ones(k), place, place**2, sign], axis=-1)  # middle, spacing and its change, spread of black
    turned = np.stack([along, along * place], axis=-1)  # of the grid, whose corners have errors
    design = np.concatenate([np.broadcast_to(fixed, (m, *fixed.shape)), turned], axis=-1)
    pull = np.nan_to_num(by_sampling)
    there = np.isfinite(offset) & np.isfinite(variance) & (variance > 0)
    weight = np.where(there, 1 / np.where(there, variance, 1.0), 0.0)
    root = np.sqrt(weight)
    offset = np.where(there, offset, 0.0)
    # Residuals over their σ, and the matrix that makes them of errors.
    basis = root[..., None] * design
    made = np.eye(k) - basis @ np.linalg.pinv(basis, rcond=1e-6)
    made = made * there[:, None, :] * there[:, :, None]
    left = np.einsum("gij,gj->gi", made, root * offset)
    freedom = np.einsum("gii->g", made)
    # Seen from its other side, an edge has the opposite phase and the opposite displacement: a sine of the phase.
    # If all lines have about one phase, they move together, as another spacing would move them: ``known`` is small.
    wave = np.sqrt(2) * np.einsum("gij,gj->gi", made, root * pull[..., 1])
    known = np.maximum((wave**2).sum(1), 1e-12)
    amplitude = (wave * left).sum(1) / known
    by_phase = amplitude**2 - 1 / known
    same = np.equal.outer(np.arange(k) // 2, np.arange(k) // 2)
    shared = (pull @ np.swapaxes(pull, 1, 2)) * same * root[:, :, None] * root[:, None]
    by_displacement = np.einsum("gij,gjk,gik->g", made, shared, made)
    rest = ((left - amplitude[:, None] * wave) ** 2).sum(1)
    good = (freedom > 1.5) & (by_displacement > 1e-9)
    by_displacement = np.where(good, by_displacement, 1.0)
    square = (rest - (freedom - 1)) / by_displacement
    good &= square < MOST_PX**2 + 3 * np.sqrt(2 * freedom.clip(1)) / by_displacement
    square[~good] = np.nan
    others = np.maximum(freedom - 1, 0.0)
    by_phase[~good] = np.nan
    return (
        Displacement(by_phase, 1 / known, np.ones(m), passed),
        Displacement(square, others / by_displacement, others, passed),
    )
