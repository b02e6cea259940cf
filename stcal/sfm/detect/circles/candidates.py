"""Candidates in ideal (undistorted, normalised) coordinates, and the test that an ellipse is a given circle's image."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homographies, homography_jacobian
from stcal.sfm.detect.circles.ellipses import Ellipses

MAX_POSITION_ERROR = 0.15
"""Largest distance between a pattern's prediction and a candidate, in radii of the circle …"""
MAX_POSITION_ERROR_PX = 1.5
"""… and at least this many pixels: candidates before centring are good to a few tenths."""
MAX_AXIS_RATIO = 1.45
"""Largest ratio between the predicted and the found ellipse along any direction."""
MIN_HOMOGRAPHY_POINTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """n ellipses in normalised ideal coordinates.

    ``xy`` : (n, 2) centres; ``shape`` : (n, 2, 2), rim = xy + shape @ unit circle; ``radius`` : (n,) of equal area;
    ``contrast`` : (n,) grey values; ``px`` : size of a pixel in these coordinates; ``tree`` : over ``xy``.
    """

    xy: np.ndarray
    shape: np.ndarray
    radius: np.ndarray
    contrast: np.ndarray
    px: float
    tree: KDTree

    @classmethod
    def of(cls, ellipses: Ellipses, camera: Camera) -> "Candidates":
        """Returns the candidates of ellipses: lens distortion is removed from centres exactly, from shapes to first
        order."""
        xy = camera.normalised_from_pixel(ellipses.centre_px)
        _, distorted_by_ideal = camera.distort_jacobian(xy)
        shape = np.linalg.solve(distorted_by_ideal, ellipses.shape_px / camera.focal[:, None])
        radius = np.sqrt(np.abs(np.linalg.det(shape))) if len(xy) else np.zeros(0)
        return cls(xy, shape, radius, ellipses.contrast, 1 / float(np.sqrt(camera.focal.prod())), KDTree(xy))

    def mirrored(self) -> "Candidates":
        """Returns the mirror image of the candidates, with reversed x."""
        flip = np.array([-1.0, 1.0])
        xy = self.xy * flip
        return Candidates(xy, flip[:, None] * self.shape * flip, self.radius, self.contrast, self.px, KDTree(xy))

    def __len__(self) -> int:
        return len(self.xy)


def singular_values(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the largest and smallest singular values, (...,), of 2×2 matrices (..., 2, 2), in closed form."""
    half_trace = (m**2).sum((-1, -2)) / 2
    det = np.abs(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])
    root = np.sqrt(np.maximum(half_trace**2 - det**2, 0))
    return np.sqrt(half_trace + root), np.sqrt(np.maximum(half_trace - root, 0))


@dataclass(frozen=True, slots=True, eq=False)
class PatternFit:
    """The candidate nearest to each of the m circles of a pattern, and how well it fits the prediction.

    ``index`` : (m,); ``radius`` : (m,) predicted, of equal area; ``distance``, ``max_distance`` : (m,) from the
    predicted place, and the limit; ``widest``, ``narrowest``, ``max_stretch`` : (m,) extremes over all
    directions of the ratio between the predicted and the found ellipse, and how far from 1 they may be (by a factor).
    """

    index: np.ndarray
    radius: np.ndarray
    distance: np.ndarray
    max_distance: np.ndarray
    widest: np.ndarray
    narrowest: np.ndarray
    max_stretch: np.ndarray

    def in_place(self) -> np.ndarray:
        """Returns the mask of the circles with a candidate at their place."""
        return self.distance < self.max_distance

    def fits(self) -> np.ndarray:
        """Returns the mask of the circles with a candidate of their size and shape at their place."""
        return self.in_place() & (self.widest < self.max_stretch) & (self.narrowest > 1 / self.max_stretch)


def fit_pattern(
    candidates: Candidates, image_from_plane: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, slack: float = 1.0
) -> PatternFit:
    """Compares a pattern with its nearest candidates; arguments as in :func:`match_pattern`."""
    predicted = apply_homography(image_from_plane, xy_plane)
    local = homography_jacobian(image_from_plane, xy_plane) * radius[..., None, None]
    size = np.sqrt(np.abs(np.linalg.det(local)))
    distance, index = candidates.tree.query(predicted)
    index = np.where(np.isfinite(distance), index, 0)
    max_distance = slack * np.maximum(MAX_POSITION_ERROR * size, MAX_POSITION_ERROR_PX * candidates.px)
    widest, narrowest = singular_values(np.linalg.solve(candidates.shape[index], local))
    # Blur and pixels widen small ellipses: half a pixel at each end of the minor axis.
    max_stretch = MAX_AXIS_RATIO * (1 + candidates.px / np.maximum(singular_values(local)[1], candidates.px))
    return PatternFit(index, size, distance, max_distance, widest, narrowest, max_stretch)


def match_pattern(
    candidates: Candidates, image_from_plane: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, slack: float = 1.0
) -> np.ndarray:
    """Returns for each circle of a pattern the candidate at its predicted place with its predicted size and shape.

    Parameters
    ----------
    image_from_plane : (3, 3) homography into normalised coordinates, or (k, 3, 3) of k patterns
    xy_plane, radius : (m, 2), (m,) circles in the plane, or (k, m, 2), (k, m)
    slack : factor on the position tolerance

    Returns
    -------
    index : (m,) or (k, m) int, −1 if there is none
    """
    fit = fit_pattern(candidates, image_from_plane, xy_plane, radius, slack)
    index = np.where(fit.fits(), fit.index, -1)
    # A candidate that two circles of a pattern claim goes to the nearer one.
    claimed = index.ravel() + np.arange(index.size) // index.shape[-1] * (len(candidates) + 1)
    order = np.lexsort((fit.distance.ravel(), claimed))
    again = np.flatnonzero((claimed[order][1:] == claimed[order][:-1]) & (index.ravel()[order][1:] >= 0)) + 1
    index.reshape(-1)[order[again]] = -1
    return index


@dataclass(frozen=True, slots=True, eq=False)
class Grown:
    """k grown patterns: ``index`` : (k, m) candidates of their circles, −1 if there is none; ``homography`` : (k, 3,
    3) to normalised coordinates; ``holds`` : (k,) whether the match converged with four circles or more."""

    index: np.ndarray
    homography: np.ndarray
    holds: np.ndarray


def grow_matches(
    candidates: Candidates, index: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, rounds: int = 8
) -> Grown:
    """Alternates between fitting homographies to the matched circles and matching again, until nothing changes.

    Parameters
    ----------
    index : (k, m) start, −1 if there is none
    xy_plane, radius : (k, m, 2), (k, m) circles of each pattern; radius 0 behind the last circle of a shorter pattern,
        with the place of an existing circle
    """
    index, there = index.copy(), radius > 0
    homography, holds = np.full((len(index), 3, 3), np.nan), np.zeros(len(index), bool)
    active = np.arange(len(index))
    for turn in range(rounds):
        active = active[_spread_out(index[active] >= 0, xy_plane[active])]
        if not len(active):
            break
        xy, matched = xy_plane[active], index[active] >= 0
        found = fit_homographies(xy, candidates.xy[index[active]], matched)
        depth = (xy * found[:, None, 2, :2]).sum(2) + found[:, None, 2, 2]
        ahead = depth * np.sign(depth[:, :1]) > 1e-9 * np.abs(depth).max(1, keepdims=True)  # no for what is not finite
        ok = ahead.all(1)
        active, found = active[ok], found[ok]
        if not len(active):
            break
        slack = 3.0 if turn < 2 else 1.0
        again = match_pattern(candidates, found, xy_plane[active], np.where(there, radius, 1)[active], slack)
        again = np.where(there[active], again, -1)
        settled = (again == index[active]).all(1) & (turn >= 2)
        homography[active[settled]], holds[active[settled]] = found[settled], True
        index[active[~settled]] = again[~settled]
        active = active[~settled]
    return Grown(index, homography, holds)


def _spread_out(matched: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Returns whether four circles or more, not all in one row or column, are matched; (k,)."""
    low = np.where(matched[..., None], xy, np.inf).min(1)
    high = np.where(matched[..., None], xy, -np.inf).max(1)
    return (matched.sum(1) >= MIN_HOMOGRAPHY_POINTS) & (high > low).all(1)
