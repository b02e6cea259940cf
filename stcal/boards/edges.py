"""Corners of a tag from its four edges: lines through edge points, and where they meet.

``cv2.cornerSubPix`` balances gradients about a point. That is right where two dark squares meet in a corner of a
chessboard, but at the outer corner of a tag it lies inside, by 0.1 to 0.2 px with ordinary blur. The edges' middles do
not move with a symmetrical blur, so that lines through them meet in the corner.
"""

from dataclasses import dataclass

import cv2
import numpy as np

STEP_PX = 0.25
ALONG = (0.08, 0.92)
"""Part of an edge that is used: near its ends the other edge's blur is in the profile."""
CELLS_ACROSS = 0.8
"""How far a profile reaches to either side, in cells; the border of a tag, and the white about it, is one cell wide."""
REACH_PX = (1.5, 6.0)
MIN_CONTRAST = 0.3
"""Of a profile, as a share of the tag's median; less is another tag's edge, a stain, a shadow's rim."""
POINTS = 40
MIN_POINTS = 5
CUT = 2.5
"""Points farther off the line than so many robust σ are left out."""
MIN_SIGMA_PX = 0.01
"""Below this the noise of edge points is not what limits a corner: printing, flatness and the lens are."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCorners:
    """``corners_px`` : (4, 2); ``covariance_px2`` : (4, 2, 2)."""

    corners_px: np.ndarray
    covariance_px2: np.ndarray


def corners_from_edges(grey: np.ndarray, corners: np.ndarray, cells: int) -> EdgeCorners | None:
    """Refine four corners (4, 2), in order around a dark tag with ``cells`` cells a side, its border included.

    None where an edge is not seen: too short, hidden, or without contrast.
    """
    lines = []
    contrast = _tag_contrast(grey, corners)
    for k in range(4):
        line = _edge(grey, corners[k], corners[(k + 1) % 4], cells, corners.mean(0), contrast)
        if line is None:
            return None
        lines.append(line)
    found, covariance = zip(*(_meet(lines[k - 1], lines[k]) for k in range(4)), strict=True)
    return EdgeCorners(np.array(found), np.array(covariance))


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """Points p with ``normal @ (p − middle) = offset + slope · along @ (p − middle)``; ``covariance`` of the two."""

    middle: np.ndarray
    normal: np.ndarray
    along: np.ndarray
    offset: float
    slope: float
    covariance: np.ndarray


def _tag_contrast(grey: np.ndarray, corners: np.ndarray) -> float:
    """Bright minus dark end of what is in and around the tag."""
    x0, y0 = np.floor(corners.min(0) - 3).astype(int).clip(0)
    x1, y1 = np.ceil(corners.max(0) + 4).astype(int)
    low, high = np.percentile(grey[y0:y1, x0:x1], [5, 95])
    return float(high - low)


def _edge(grey: np.ndarray, start: np.ndarray, end: np.ndarray, cells: int, inside: np.ndarray, contrast: float):
    """The line through the edge's points; None where there are too few."""
    length = np.linalg.norm(end - start)
    if length < 2 * cells:  # cells of under two pixels: nothing to measure
        return None
    along = (end - start) / length
    normal = np.array([along[1], -along[0]])
    if normal @ (inside - start) > 0:
        normal = -normal  # outwards, from dark to bright
    depth = abs(normal @ (inside - start)) * 2
    reach = float(np.clip(CELLS_ACROSS * min(depth, length) / cells, *REACH_PX))
    across = np.arange(-reach, reach + STEP_PX / 2, STEP_PX)
    place = np.linspace(*ALONG, int(np.clip(length, MIN_POINTS, POINTS))) * length
    base = start + place[:, None] * along
    xy = base[:, None] + across[:, None] * normal
    profile = cv2.remap(grey, xy[..., 0].astype(np.float32), xy[..., 1].astype(np.float32), cv2.INTER_LINEAR)
    if (xy < 0).any() or (xy > [grey.shape[1] - 1, grey.shape[0] - 1]).any():
        return None
    rise = np.diff(profile.astype(float), axis=1).clip(0)
    # Noise rises too, everywhere alike: what is below a share of the steepest is not the edge.
    rise[rise < 0.15 * rise.max(1, keepdims=True)] = 0
    total = rise.sum(1)
    good = total > MIN_CONTRAST * contrast
    if good.sum() < MIN_POINTS:
        return None
    middle_of_step = (across[1:] + across[:-1]) / 2
    offset = (rise[good] @ middle_of_step) / total[good]
    return _fit(base[good], place[good] - length / 2, offset, start + along * length / 2, normal, along)


def _fit(base, place, offset, middle, normal, along) -> _Line | None:
    """Straight line by least squares without what is far off it."""
    keep = np.ones(len(place), bool)
    for _ in range(5):
        slope = np.column_stack([np.ones(keep.sum()), place[keep]])
        value = np.linalg.lstsq(slope, offset[keep], rcond=None)[0]
        off = np.abs(offset - value[0] - value[1] * place)
        spread = max(1.4826 * np.median(off[keep]), MIN_SIGMA_PX)
        new = off < CUT * spread
        if new.sum() < MIN_POINTS:
            return None
        if (new == keep).all():
            break
        keep = new
    # Profiles nearer than a pixel share pixels: not more independent points than pixels along the edge.
    points = min(keep.sum(), max(np.ptp(place[keep]), MIN_POINTS))
    sigma2 = max(float((off[keep] ** 2).sum() / (keep.sum() - 2)), MIN_SIGMA_PX**2)
    covariance = sigma2 * np.linalg.inv(slope.T @ slope) * keep.sum() / points
    return _Line(middle, normal, along, float(value[0]), float(value[1]), covariance)


def _meet(a: _Line, b: _Line) -> tuple[np.ndarray, np.ndarray]:
    """Where two lines meet, and its covariance (2, 2)."""
    rows = np.array([a.normal - a.slope * a.along, b.normal - b.slope * b.along])
    right = np.array([a.offset + rows[0] @ a.middle, b.offset + rows[1] @ b.middle])
    point = np.linalg.solve(rows, right)
    variance = np.zeros((2, 2))
    for i, line in enumerate((a, b)):
        by = np.array([1.0, line.along @ (point - line.middle)])
        variance[i, i] = by @ line.covariance @ by
    inverse = np.linalg.inv(rows)
    return point, inverse @ variance @ inverse.T
