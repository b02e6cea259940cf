"""Detection of the inner corners of a ChArUco board: read by tags (through ``cv2.aruco``), measured where edges meet.

No camera is needed. OpenCV would place corners by the camera that it is given, and several px off if that is a guess.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from stcal.boards.design import BoardView, CharucoDesign, view_of
from stcal.boards.dictionaries import dictionary_of
from stcal.boards.edges import crossings
from stcal.boards.tags import detector_settings
from stcal.geometry.plane import apply_homography, fit_homography, homography_jacobian
from stcal.geometry.robust import median_length, robust_sigma
from stcal.io.images import grey_8bit

LEAST_CORNERS = 4
"""Smallest number of corners of a view: they determine a homography."""
NEIGHBOURS = 12
"""Number of nearest corners that predict a corner: neither a lens nor a bent board bends such a small patch by much."""
TESTED_FROM = 8
"""Smallest number of corners of a view in which corners are tested: fewer cannot predict one another."""
SLOPE_SIGMA_PX = 5.0
"""σ of the change of a deviation from the homography from one square to the next, px; it keeps the fit regular."""
ROBUST_PASSES = 10
LEAST_SCATTER_PX = 0.05
"""Smallest scatter of corners about a smooth field, px: printing and lenses cause it even in sharp views."""
GATE = 5.0
"""Largest deviation of a corner from the prediction by its neighbours. It is in units of the robust σ of such
deviations in the view, or of the scatter of the neighbours themselves, whichever is larger. A bent board or a wide lens
makes the latter large near an edge."""
SMOOTHING_PX = 0.8
"""σ of the smoothing before gradients are taken."""
ALIKE_PX2 = 4 * np.pi * SMOOTHING_PX**2
"""Area of pixels that smoothing makes alike, px²."""
LEAST_WINDOW_PX, MOST_WINDOW_PX = 2, 30
"""Limits of half the side of a window, px."""
STEPS, SETTLED_PX = 20, 1e-3
"""Most steps of a corner's measurement, and the step at which it ends, px."""
WIDEST_EDGE, MOST_FROM_SADDLE = 0.4, 0.25
"""Largest σ of an edge's blur at which edges that meet are measured, and largest distance of their point from the
saddle, in half sides of the window. Wider edges leave it, and only the saddle is measured."""
NOISE = 1e-6
"""Keeps the equations of a blank window regular."""
LEAST_SIGMA_PX = 0.02
"""Smallest σ of a corner: below it printing, flatness and the lens limit its accuracy, not noise."""


def find_charuco(image: np.ndarray, name: str, board: CharucoDesign) -> BoardView | None:
    """Return the inner corners of a ChArUco board, with covariances; None if fewer than four are seen.

    One visible neighbour tag is enough for a corner, and tags that the first pass missed are searched at their expected
    places: OpenCV's default settings lose a quarter of the corners of real image sets. Corners from a single blurred
    tag may be several px off. Each measurement therefore starts at the place that the surrounding corners predict, and
    the corner is left out if the measurement ends far from there.

    A corner is measured in one of three ways. The first is the crossing of the edges by the areas that they cover in
    the pixels of a window clear of the tags. If the pixels do not fit such a crossing, it is the point where the
    gradients of the edges meet. If the edges are too blurred for that, it is the saddle of the grey values, in a window
    in which the board is symmetric about the corner.
    """
    grey = grey_8bit(image)
    ids, corners = _read(grey, board)
    if len(ids) < LEAST_CORNERS:
        return None
    squares = board.xy_mm()[ids] / board.square_mm
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING_PX)
    small, large = _windows(board)
    for _ in range(2):
        foretold = _foretold(squares, corners)
        blurred = _saddles(smooth, foretold.xy_px, _half_px(large, foretold))
        corners = blurred.xy_px
    sharp = _edges_meet(_gradient(smooth), corners, _half_px(small, foretold))
    along = np.swapaxes(homography_jacobian(_robust_homography(squares, corners), squares), 1, 2)
    start, clear = sharp.otherwise(blurred).xy_px, np.sqrt(2) * small * foretold.step_px
    by_area = crossings(grey, start, along, _half_px(small, foretold), clear)
    measured = _Corners(by_area.xy_px, by_area.covariance_px2, by_area.seen).otherwise(sharp).otherwise(blurred)
    good = measured.seen & _foretold(squares, measured.xy_px).agrees(measured.xy_px)
    if good.sum() < LEAST_CORNERS:
        return None
    view = view_of(name, board, ids[good], measured.xy_px[good], measured.covariance_px2[good])
    return view if good.all() else replace(view, unused=("corners that lie off the corners about them",))


def _read(grey: np.ndarray, board: CharucoDesign) -> tuple[np.ndarray, np.ndarray]:
    """Return the ids (n,) of the inner corners beside tags, and their approximate places (n, 2), px."""
    plain = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_mm,
        board.marker_mm,
        dictionary_of(board.dictionary),
        np.array(board.tag_ids(), np.int32),
    )
    plain.setLegacyPattern(board.legacy)
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers, settings.tryRefineMarkers = 1, True
    detector = cv2.aruco.CharucoDetector(plain, settings, detector_settings(board.dictionary))
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None:
        return np.zeros(0, int), np.zeros((0, 2))
    return ids.ravel().astype(int), corners.reshape(-1, 2).astype(float)


@dataclass(frozen=True, slots=True, eq=False)
class _Foretold:
    """Corners as predicted by the corners around each of them: ``xy_px`` (n, 2); ``scatter_px`` : (n,) median deviation
    of those corners from their own smooth field; ``step_px`` : (n,) shorter side of a square there."""

    xy_px: np.ndarray
    scatter_px: np.ndarray
    step_px: np.ndarray

    def agrees(self, xy_px: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the corners that are at their predicted places."""
        if len(xy_px) < TESTED_FROM:
            return np.ones(len(xy_px), bool)
        off = np.linalg.norm(xy_px - self.xy_px, axis=1)
        scatter = np.maximum(self.scatter_px / median_length(2), max(robust_sigma(off, 2), LEAST_SCATTER_PX))
        return off <= GATE * scatter


def _foretold(squares: np.ndarray, corners: np.ndarray) -> _Foretold:
    """Return the places of corners as predicted by the corners around them, (n, 2) px.

    ``squares`` : (n, 2) places on the board in squares. The deviations from a homography of the whole view come from
    the lens and a bent board. They are smooth, and are modelled as linear among the corners around each.
    """
    image_from_squares = _robust_homography(squares, corners)
    base = apply_homography(image_from_squares, squares)
    step = np.linalg.svd(homography_jacobian(image_from_squares, squares), compute_uv=False)[:, 1]
    n = len(squares)
    if n < TESTED_FROM:
        return _Foretold(base, np.zeros(n), step)
    near = np.asarray(KDTree(squares).query(squares, k=min(NEIGHBOURS, n - 1) + 1)[1])[:, 1:]
    design = np.concatenate([np.ones((*near.shape, 1)), squares[near] - squares[:, None]], axis=2)
    left = (corners - base)[near]
    weight = np.ones(near.shape)
    for _ in range(ROBUST_PASSES):  # least lengths instead of squares, by reweighting: a median of the plane
        normal = np.einsum("nki,nk,nkj->nij", design, weight, design) + np.diag([0, *[SLOPE_SIGMA_PX**-2] * 2])
        plane = np.linalg.solve(normal, np.einsum("nki,nk,nkc->nic", design, weight, left))
        length = np.linalg.norm(left - design @ plane, axis=2)
        weight = 1 / np.maximum(length, LEAST_SCATTER_PX)
    return _Foretold(base + plane[:, 0], np.median(length, axis=1), step)


def _robust_homography(squares: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the homography of least median deviation, image from squares; of least squares without redundancy."""
    found = cv2.findHomography(squares, corners, cv2.LMEDS)[0] if len(squares) > LEAST_CORNERS else None
    return fit_homography(squares, corners) if found is None else found


def _windows(board: CharucoDesign) -> tuple[float, float]:
    """Return half the sides of both windows in squares: clear of the tags, and of the tags' cells.

    White and the tags' black border lie alike on both sides of a corner. Windows are upright in the image: only their
    half diagonals are limited.
    """
    white = (1 - board.marker_mm / board.square_mm) / 2
    cell = board.marker_mm / board.square_mm / (dictionary_of(board.dictionary).markerSize + 2)
    return white / np.sqrt(2), (white + cell) / np.sqrt(2)


def _half_px(share: float, foretold: _Foretold) -> np.ndarray:
    """Return half the sides (n,) of the corners' windows, whole px."""
    return np.rint(share * foretold.step_px).clip(LEAST_WINDOW_PX, MOST_WINDOW_PX).astype(int)


def _gradient(smooth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of an image by x and y, grey values per px."""
    return cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    """Corners as measured, ``xy_px`` (n, 2) with ``covariance_px2`` (n, 2, 2). ``seen`` : (n,) False if there is
    none in its window."""

    xy_px: np.ndarray
    covariance_px2: np.ndarray
    seen: np.ndarray

    def otherwise(self, other: "_Corners") -> "_Corners":
        """Return these corners, those that are not seen as ``other`` has them."""
        return _Corners(
            np.where(self.seen[:, None], self.xy_px, other.xy_px),
            np.where(self.seen[:, None, None], self.covariance_px2, other.covariance_px2),
            self.seen | other.seen,
        )


def _edges_meet(gradient: tuple[np.ndarray, np.ndarray], start: np.ndarray, half: np.ndarray) -> _Corners:
    """Return the corners near ``start`` (n, 2): points through which the edges in a window of ``half`` (n,) px pass.

    The weighted squares of the gradients' components towards the corner are least (Förstner & Gülch 1987).
    """

    def step(xy: np.ndarray, window: _Window) -> tuple[np.ndarray, np.ndarray]:
        slope = np.stack([window.sampled(part, xy) for part in gradient], axis=2)
        weight = window.weight(xy, gradient[0].shape)
        weighted = np.swapaxes(slope * weight[..., None], 1, 2)
        normal = weighted @ slope + NOISE * np.eye(2)
        right = weighted @ (slope * window.offsets).sum(2)[..., None]
        move = np.linalg.solve(normal, right)[..., 0]
        beside = (slope * (window.offsets - move[:, None])).sum(2)
        strength = np.maximum((weight[..., None] * slope**2).sum((1, 2)), NOISE)
        wide = (weight * beside**2).sum(1) > (WIDEST_EDGE * window.half) ** 2 * strength
        pull = slope * (weight * beside)[..., None]
        pull = (pull + pull[:, ::-1]) / 2  # zero where the image is symmetric: blur alone moves no corner
        inverse = np.linalg.inv(normal)
        covariance = ALIKE_PX2 * inverse @ (np.swapaxes(pull, 1, 2) @ pull) @ inverse
        good = window.whole(weight) & ~wide
        return move, np.where(good[:, None, None], covariance, np.nan)

    return _found(step, start, half, MOST_FROM_SADDLE)


def _saddles(grey: np.ndarray, start: np.ndarray, half: np.ndarray) -> _Corners:
    """Return the saddles near ``start`` (n, 2) of a smooth image, by a parabola in a window of ``half`` (n,) px.

    A blurred corner has no edges that meet, but is still a saddle: the image is symmetric about it. The fit's residuals
    give σ.
    """

    def step(xy: np.ndarray, window: _Window) -> tuple[np.ndarray, np.ndarray]:
        weight = window.weight(xy, grey.shape)
        x, y = window.offsets.T
        design = np.column_stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])
        level = window.sampled(grey, xy)
        products = (design[:, :, None] * design[:, None]).reshape(len(x), -1)
        inverse = np.linalg.inv((weight @ products).reshape(-1, 6, 6) + NOISE * np.eye(6))
        value = (inverse @ ((weight * level) @ design)[..., None])[..., 0]
        bend = value[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
        determinant = bend[:, 0, 0] * bend[:, 1, 1] - bend[:, 0, 1] ** 2
        is_saddle = (determinant < 0) & window.whole(weight)
        bent = np.linalg.inv(np.where(is_saddle[:, None, None], bend, np.eye(2)))
        move = -(bent @ value[:, 1:3, None])[..., 0]
        square = (weight * (level - value @ design.T) ** 2).sum(1)
        variance = ALIKE_PX2 * square / np.maximum(weight.sum(1), NOISE)
        covariance = variance[:, None, None] * bent @ inverse[:, 1:3, 1:3] @ bent
        return np.where(is_saddle[:, None], move, 0), np.where(is_saddle[:, None, None], covariance, np.nan)

    return _found(step, start, half)


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """Places about a corner: ``offsets`` (k, 2) px, with weights ``bell`` (k,); ``half`` : half a side, px."""

    half: int
    offsets: np.ndarray
    bell: np.ndarray

    @classmethod
    def of(cls, half: int) -> "_Window":
        """Return a square window with half sides of ``half`` px."""
        offsets = np.stack(np.meshgrid(*[np.arange(-half, half + 1.0)] * 2), axis=-1).reshape(-1, 2)
        return cls(half, offsets, np.exp(-(offsets**2).sum(1) / half**2))

    def weight(self, xy: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return the weights (n, k) about corners (n, 2): zero outside of the image, and opposite to it."""
        at = xy[:, None] + self.offsets
        inside = np.all((at >= 0) & (at <= np.array([shape[1] - 1, shape[0] - 1])), axis=2)
        return self.bell * (inside & inside[:, ::-1])

    def whole(self, weight: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the windows that lie in the image by more than half."""
        return weight.sum(1) > self.bell.sum() / 2

    def sampled(self, image: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """Return the values (n, k) of an image about corners (n, 2)."""
        x, y = np.moveaxis((xy[:, None] + self.offsets).astype(np.float32), 2, 0)
        return cv2.remap(image, x, y, cv2.INTER_LINEAR).astype(float)


def _found(step: Callable, start: np.ndarray, half: np.ndarray, reach: float = 1.0) -> _Corners:
    """Return the corners at which the steps end.

    ``step`` : returns steps (n, 2) and covariances (n, 2, 2); ``reach`` : largest distance from ``start`` (n, 2) of a
    corner, in ``half`` sides (n,) of its window.
    """
    n = len(start)
    xy, covariance, seen = start.copy(), np.full((n, 2, 2), np.nan), np.zeros(n, bool)
    for side in np.unique(half).tolist():
        own, window = np.flatnonzero(half == side), _Window.of(side)
        for _ in range(STEPS):
            move, covariance[own] = step(xy[own], window)
            short = np.minimum(1.0, side / 2 / np.maximum(np.linalg.norm(move, axis=1, keepdims=True), SETTLED_PX))
            xy[own] += short * move
            if np.abs(move).max() < SETTLED_PX:
                break
        seen[own] = np.linalg.norm(xy[own] - start[own], axis=1) <= reach * side
    seen &= np.isfinite(covariance).all((1, 2))
    return _Corners(np.where(seen[:, None], xy, start), covariance + LEAST_SIGMA_PX**2 * np.eye(2), seen)
