"""Candidates in ideal (undistorted, normalised) coordinates, and the test that an ellipse is a given circle's image."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography, homography_jacobian
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
        """Lens distortion removed from centres exactly, from shapes to first order."""
        xy = camera.normalised_from_pixel(ellipses.centre_px)
        _, distorted_by_ideal = camera.distort_jacobian(xy)
        shape = np.linalg.solve(distorted_by_ideal, ellipses.shape_px / camera.focal[:, None])
        radius = np.sqrt(np.abs(np.linalg.det(shape))) if len(xy) else np.zeros(0)
        return cls(xy, shape, radius, ellipses.contrast, 1 / float(np.sqrt(camera.focal.prod())), KDTree(xy))

    def mirrored(self) -> "Candidates":
        """As a mirror shows them: x turned about."""
        flip = np.array([-1.0, 1.0])
        xy = self.xy * flip
        return Candidates(xy, flip[:, None] * self.shape * flip, self.radius, self.contrast, self.px, KDTree(xy))

    def __len__(self) -> int:
        return len(self.xy)


def singular_values(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest and smallest singular values, (...,), of 2×2 matrices (..., 2, 2), in closed form."""
    half_trace = (m**2).sum((-1, -2)) / 2
    det = np.abs(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])
    root = np.sqrt(np.maximum(half_trace**2 - det**2, 0))
    return np.sqrt(half_trace + root), np.sqrt(np.maximum(half_trace - root, 0))


@dataclass(frozen=True, slots=True, eq=False)
class PatternFit:
    """The candidate nearest to each of the m circles of a pattern, and how well it fits the prediction.

    ``index`` : (m,); ``radius`` : (m,) predicted, of equal area; ``distance``, ``max_distance`` : (m,) from the
    predicted place, and what is allowed; ``widest``, ``narrowest``, ``max_stretch`` : (m,) extremes over all
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
        """Mask of the circles with a candidate at their place."""
        return self.distance < self.max_distance

    def fits(self) -> np.ndarray:
        """Mask of the circles with a candidate of their size and shape at their place."""
        return self.in_place() & (self.widest < self.max_stretch) & (self.narrowest > 1 / self.max_stretch)


def fit_pattern(
    candidates: Candidates, image_from_plane: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, slack: float = 1.0
) -> PatternFit:
    """Compare a pattern with the candidates nearest to it; arguments as of :func:`match_pattern`."""
    predicted = apply_homography(image_from_plane, xy_plane)
    local = homography_jacobian(image_from_plane, xy_plane) * radius[:, None, None]
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
    """For every circle of a pattern the candidate at its predicted place, of its predicted size and shape.

    Parameters
    ----------
    image_from_plane : (3, 3) homography into normalised coordinates
    xy_plane, radius : (m, 2), (m,) circles in the plane
    slack : factor on the position tolerance

    Returns
    -------
    index : (m,) int, −1 where there is none
    """
    fit = fit_pattern(candidates, image_from_plane, xy_plane, radius, slack)
    index = np.where(fit.fits(), fit.index, -1)
    # A candidate that two circles claim goes to the nearer one.
    order = np.lexsort((fit.distance, index))
    again = np.flatnonzero((index[order][1:] == index[order][:-1]) & (index[order][1:] >= 0)) + 1
    index[order[again]] = -1
    return index


def grow_match(
    candidates: Candidates, index: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, rounds: int = 8
) -> tuple[np.ndarray, np.ndarray] | None:
    """Alternate between fitting the homography to the matched circles and matching anew, until nothing changes.

    Returns the final (index (m,), homography (3, 3)), or None where fewer than four circles hold together.
    """
    for turn in range(rounds):
        matched = index >= 0
        if matched.sum() < MIN_HOMOGRAPHY_POINTS or np.ptp(xy_plane[matched], axis=0).min() == 0:
            return None
        try:
            homography = fit_homography(xy_plane[matched], candidates.xy[index[matched]])
        except DegenerateError:
            return None
        depth = xy_plane @ homography[2, :2] + homography[2, 2]
        if not np.isfinite(homography).all() or (depth * np.sign(depth[0]) <= 1e-9 * np.abs(depth).max()).any():
            return None
        again = match_pattern(candidates, homography, xy_plane, radius, slack=3.0 if turn < 2 else 1.0)
        if turn >= 2 and (again == index).all():
            return index, homography
        index = again
    return None
