"""Corners of a tag as the intersections of its four edges, each a line through edge points.

``cv2.cornerSubPix`` balances gradients about a point. This is correct where two dark squares of a chessboard meet, but
at the outer corner of a tag its result lies inside the tag, by 0.1 to 0.2 px with ordinary blur. A symmetrical blur
does not move the middles of edges, so that lines through them meet in the corner.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from stcal.geometry.robust import median_length

SAMPLES = 25
"""Number of samples of a profile across an edge."""
POINTS = 32
"""Number of profiles of an edge; if they are closer than a pixel, only one per pixel counts as independent."""
ALONG = (0.08, 0.92)
"""Range of an edge that is used, as shares of its length: near its ends the next edge's blur disturbs the profile."""
CELLS_ACROSS = 0.8
"""Reach of a profile to either side, in cells; the border of a tag, and the white around it, is one cell wide."""
REACH_PX = (1.5, 6.0)
MIN_RISE = 0.15
"""Smallest step that counts as a part of the edge, as a share of a profile's steepest step; smaller ones are noise."""
MIN_CONTRAST = 0.3
"""Smallest contrast of a profile, as a share of the tag's; a lower one is another tag's edge, a stain or a shadow."""
MIN_SHARE = 0.25
"""Smallest share of good profiles of a visible edge."""
MIN_CELL_PX = 2.0
CUT = 2.5
"""Largest distance of a point from the line, in robust σ; points beyond it are outliers."""
CUT_ROUNDS = 4
MIN_SIGMA_PX = 0.01
"""Smallest σ of edge points: below it printing, flatness and the lens limit the accuracy of a corner, not noise."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCorners:
    """The refined corners ``corners_px`` (n, 4, 2), with ``covariance_px2`` (n, 4, 2, 2).

    ``seen`` : (n,) True if all four edges of a tag are visible; otherwise its values are meaningless.
    """

    corners_px: np.ndarray
    covariance_px2: np.ndarray
    seen: np.ndarray


def corners_from_edges(grey: np.ndarray, corners: np.ndarray, cells: np.ndarray) -> EdgeCorners:
    """Refine the corners (n, 4, 2), in cyclic order, of dark tags with ``cells`` (n,) cells per side, border included.

    An edge is not visible if it is too short, hidden, outside of the image, or without contrast.
    """
    n = len(corners)
    if not n:
        return EdgeCorners(np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)), np.zeros(0, bool))
    frame = _frame(np.asarray(corners, float), cells)
    offset, good = _profiles(grey, frame)
    with np.errstate(divide="ignore", invalid="ignore"):  # edges that are not visible
        lines = _fit(frame.place, offset, good)
        meeting, covariance = _meet(frame, lines)
    seen = good.mean(2) >= MIN_SHARE
    seen &= np.isfinite(covariance).all((2, 3)) & (frame.length >= MIN_CELL_PX * np.reshape(cells, (-1, 1)))
    return EdgeCorners(meeting, covariance, seen.all(1))


def corners_by_edges(corners: np.ndarray) -> np.ndarray:
    """Return the shifts of the corners (..., 4, 2) of tags, in cyclic order, if all four edges move outwards by one.

    Over-exposure, spread ink and a nonlinear response of the camera move all edges alike.
    """
    along = np.roll(corners, -1, axis=-2) - corners
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    outwards = np.sign((normal * (corners - corners.mean(-2, keepdims=True))).sum((-1, -2)))
    normal *= outwards[..., None, None]
    pair = np.stack([np.roll(normal, 1, axis=-2), normal], axis=-2)
    return np.linalg.solve(pair, np.ones((*pair.shape[:-1], 1)))[..., 0]


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """Geometry of the edges, px.

    ``middle`` : (n, 4, 2) of each edge; ``along`` : (n, 4, 2) direction; ``normal`` : (n, 4, 2) outwards; ``length`` :
    (n, 4); ``reach`` : (n, 4) of the profiles; ``place`` : (n, 4, POINTS) of the profiles from the middle.
    """

    middle: np.ndarray
    along: np.ndarray
    normal: np.ndarray
    length: np.ndarray
    reach: np.ndarray
    place: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines of points p with ``normal @ (p − middle) = offset + slope · along @ (p − middle)``.

    ``offset``, ``slope`` : (n, 4); ``covariance`` : (n, 4, 2, 2) of the two.
    """

    offset: np.ndarray
    slope: np.ndarray
    covariance: np.ndarray


def _frame(corners: np.ndarray, cells: np.ndarray) -> _Frame:
    """Return the edges from each corner to the next."""
    end = np.roll(corners, -1, axis=1)
    length = np.linalg.norm(end - corners, axis=2)
    along = (end - corners) / length[..., None]
    middle = (corners + end) / 2
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    depth = 2 * ((middle - corners.mean(1, keepdims=True)) * normal).sum(2)
    normal = normal * np.where(depth < 0, -1.0, 1.0)[..., None]
    reach = np.clip(CELLS_ACROSS * np.minimum(np.abs(depth), length) / np.reshape(cells, (-1, 1)), *REACH_PX)
    place = (np.linspace(*ALONG, POINTS) - 0.5) * length[..., None]
    return _Frame(middle, along, normal, length, reach, place)


def _profiles(grey: np.ndarray, frame: _Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return the edge in each profile, px from the frame's line, and a mask of good profiles, (n, 4, POINTS)."""
    n = len(frame.length)
    across = np.linspace(-1, 1, SAMPLES) * frame.reach[..., None]
    base = frame.middle[:, :, None] + frame.place[..., None] * frame.along[:, :, None]
    xy = base[:, :, :, None] + (across[..., None] * frame.normal[:, :, None])[:, :, None]
    flat = xy.reshape(4 * n, POINTS * SAMPLES, 2).astype(np.float32)
    level = (
        cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR).reshape(n, 4, POINTS, SAMPLES).astype(np.float32)
    )
    inside = np.all((xy >= 0) & (xy <= [grey.shape[1] - 1, grey.shape[0] - 1]), axis=(2, 3, 4))
    rise = np.diff(level, axis=3).clip(0)
    rise[rise < MIN_RISE * rise.max(3, keepdims=True)] = 0
    total = rise.sum(3)
    low, high = np.percentile(level.reshape(n, -1), [5, 95], axis=1)
    good = (total > MIN_CONTRAST * (high - low)[:, None, None]) & (total > 0) & inside[..., None]
    middle = (across[..., 1:] + across[..., :-1]) / 2
    return np.einsum("nkps,nks->nkp", rise, middle) / np.where(good, total, 1.0), good


def _fit(place: np.ndarray, offset: np.ndarray, good: np.ndarray) -> _Lines:
    """Fit straight lines by least squares, with removal of outliers."""
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
    return _Lines(value[..., 0], value[..., 1], (variance * count / points)[..., None, None] * spread)


def _line(place: np.ndarray, offset: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and slope (n, 4, 2) of the points ``keep``, and their inverse normal matrix (n, 4, 2, 2)."""
    s0, s1, s2 = keep.sum(2), (place * keep).sum(2), (place**2 * keep).sum(2)
    y0, y1 = (offset * keep).sum(2), (offset * place * keep).sum(2)
    inverse = np.stack([np.stack([s2, -s1], -1), np.stack([-s1, s0.astype(float)], -1)], -2)
    inverse = inverse / (s0 * s2 - s1**2)[..., None, None]
    return (inverse @ np.stack([y0, y1], -1)[..., None])[..., 0], inverse


def _meet(frame: _Frame, lines: _Lines) -> tuple[np.ndarray, np.ndarray]:
    """Return the intersection of each edge with the previous one, (n, 4, 2), and its covariance (n, 4, 2, 2)."""
    row = frame.normal - lines.slope[..., None] * frame.along
    right = lines.offset + (row * frame.middle).sum(2)
    pair = np.stack([np.roll(row, 1, axis=1), row], axis=2)
    bad = ~np.isfinite(pair).all((2, 3)) | (np.abs(np.linalg.det(np.nan_to_num(pair))) < 1e-6)
    pair[bad] = np.eye(2)
    inverse = np.linalg.inv(pair)
    point = (inverse @ np.stack([np.roll(right, 1, axis=1), right], axis=2)[..., None])[..., 0]
    variance = np.zeros_like(pair)
    for side, turn in enumerate((1, 0)):
        middle, along = np.roll(frame.middle, turn, axis=1), np.roll(frame.along, turn, axis=1)
        gradient = np.stack([np.ones(point.shape[:2]), ((point - middle) * along).sum(2)], axis=-1)
        variance[..., side, side] = np.einsum(
            "nki,nkij,nkj->nk", gradient, np.roll(lines.covariance, turn, axis=1), gradient
        )
    covariance = inverse @ variance @ np.swapaxes(inverse, 2, 3)
    covariance[bad] = np.nan
    return point, covariance
