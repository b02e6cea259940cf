"""Detection of the inner corners of chessboards and ChArUco boards, and of all boards and tags on the faces of a body.

Corners of a chessboard are found by both detectors of OpenCV. ``cv2.findChessboardCornersSB`` (after Duda & Frese 2018)
tolerates noise, shade and small squares; the older detector, which joins dark squares, tolerates steep views and blur.
Images are searched at the smallest size that shows the squares, which is fastest, and then at others. Corners are
measured in the original image. A ChArUco board is read by its tags (through ``cv2.aruco``), without a camera.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from stcal.boards.board_designs import (
    AprilGridDesign,
    BoardView,
    CharucoDesign,
    ChessboardDesign,
    SquaresOrTags,
    TagLayout,
    column_row,
    view_of,
)
from stcal.boards.dictionaries import dictionary_of
from stcal.boards.edges import ALONG, POINTS, Crossings, crossings
from stcal.boards.tags import (
    APART_PX,
    Unseen,
    detector_settings,
    find_aprilgrid,
    find_tags,
    seen_otherwise,
    view_of_tags,
)
from stcal.boards.target_file import tags_on
from stcal.design import FaceDesign
from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography, homography_jacobian
from stcal.geometry.robust import median_length, robust_sigma
from stcal.io.images import ImageFile, decode, grey_8bit, grey_of
from stcal.labels import BOARD

WINDOW_SHARE = 0.4
"""Half the side of the window in which a corner is refined, as a share of the smallest square's side."""
REFINE_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
LEAST_WINDOW, MOST_WINDOW, MOST_AT_FIRST = 2.0, 20.0, 100.0
MOST_BY_AREA = 10.0
"""Limits of half that window's side, px: smallest, largest, largest in the first pass, and largest for areas."""
UNSEEN_PX = 0.1
"""σ of a corner that is where the gradients of its edges meet, as the areas in its window do not fit."""
SMOOTHED_SHARE, LEAST_SMOOTHING = 0.05, 0.3
"""σ of the smoothing before refinement, as a share of half the window's side, and its lower limit in px."""
MARGIN, LEAST_MARGIN = 3.0, 10.0
"""Margin about the corners in which the image is smoothed, in windows and then in px: no window comes near its end."""
FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
OLDER_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
PART, PART_FLAGS = (3, 3), cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
"""Smallest grid of inner corners that counts as a part of a chessboard, and the flags to find one."""
FIRST_SIDE, LEAST_SIDE = 1600, 300
"""Longer side of the largest image that is searched before the original, and of the smallest one, px."""
PX_A_SQUARE = 25.0
"""Longer side of the first image that is searched, px per square of the board's longer side."""


def find_chessboard(image: np.ndarray, name: str, board: ChessboardDesign, with_sigma=False) -> BoardView | None:
    """Return all inner corners, or None; they are numbered so that the square between (0, 0) and (1, 1) is black. A
    board that looks the same after half a turn may be returned rotated. ``with_sigma`` : whether covariances are."""
    grey = grey_8bit(image)
    for detected in _read_corners(grey, board):
        measured = _refined(grey, detected)
        grid = measured.xy_px.reshape(detected.shape)
        if _is_a_grid(detected, grid):
            order = _numbered(grey, grid, board)
            covariance = np.where(measured.seen[:, None, None], measured.covariance_px2, UNSEEN_PX**2 * np.eye(2))
            stated = covariance[order] if with_sigma else None
            return view_of(name, board, np.arange(len(order)), measured.xy_px[order], stated)
    return None


def _read_corners(grey: np.ndarray, board: ChessboardDesign) -> Iterator[np.ndarray]:
    """Yield the grids (rows, columns, 2) that the detectors find, px of the original image."""
    height, width = grey.shape
    longer = max(height, width)
    sides = [longer * 0.5**k for k in range(6) if k == 0 or longer * 0.5**k >= LEAST_SIDE]
    needed = min(PX_A_SQUARE * (max(board.rows, board.columns) + 1), FIRST_SIDE)
    first = [side for side in sides if side >= needed][-1:]
    moderate = [side for side in sides if side <= FIRST_SIDE and side not in first]
    for side in (*first, *moderate, *(side for side in sides if side not in (*first, *moderate))):
        scale = side / longer
        size = (max(round(scale * width), 1), max(round(scale * height), 1))
        small = grey if scale == 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        pixel = np.array([width / size[0], height / size[1]])
        for find, flags in ((cv2.findChessboardCornersSB, FLAGS), (cv2.findChessboardCorners, OLDER_FLAGS)):
            success, corners = find(small, (board.columns, board.rows), flags=flags)
            if success:
                yield (corners.reshape(board.rows, board.columns, 2).astype(float) + 0.5) * pixel - 0.5


def _is_a_grid(found: np.ndarray, refined: np.ndarray) -> bool:
    """Return True if the refinement moved no corner to another one, and no square is folded."""
    across, down = refined[:-1, 1:] - refined[:-1, :-1], refined[1:, :-1] - refined[:-1, :-1]
    turn = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    stayed = np.linalg.norm(refined - found, axis=2).max() < _least_step(refined) / 2
    return bool(stayed and (np.sign(turn) == np.sign(turn[0, 0])).all())


def _numbered(grey: np.ndarray, grid: np.ndarray, board: ChessboardDesign) -> np.ndarray:
    """Return the rows (k,) of the corners in the order of the design."""
    order = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # seen from the front, X to Y turns clockwise on the screen
        order = order[:, ::-1]
    xy = grid.reshape(-1, 2)
    if not _first_is_black(grey, xy[order], board):
        order = order[::-1, ::-1]
    if not _first_is_black(grey, xy[order], board) and board.rows == board.columns:
        order = np.rot90(order)
    return order.ravel()


def _refined(grey: np.ndarray, grid: np.ndarray) -> Crossings:
    """Return the corners to hundredths of a pixel: by large windows, for blur, then by small ones, for distortion."""
    window = _window(grid)
    margin = MARGIN * min(window, MOST_AT_FIRST) + LEAST_MARGIN
    first = np.floor(np.maximum(grid.min((0, 1)) - margin, 0)).astype(int)
    last = np.ceil(grid.max((0, 1)) + margin).astype(int) + 1
    grey, grid = grey[first[1] : last[1], first[0] : last[0]], grid - first
    for most in (MOST_AT_FIRST, MOST_WINDOW):
        half = int(min(window, most))
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), max(SMOOTHED_SHARE * half, LEAST_SMOOTHING))
        places = np.ascontiguousarray(grid.reshape(-1, 1, 2), np.float32)
        grid = cv2.cornerSubPix(smooth, places, (half, half), (-1, -1), REFINE_STEPS).reshape(grid.shape).astype(float)
        if window <= MOST_WINDOW:
            break
    # By the areas of black and white: gradients place corners along pixel rows 0.02 px aside.
    along = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2).reshape(-1, 2, 2)
    halves = np.full(len(along), int(min(_window(grid), MOST_BY_AREA)))
    measured = crossings(grey, grid.reshape(-1, 2), along, halves, np.linalg.norm(along, axis=2).min(1))
    return replace(measured, xy_px=measured.xy_px + first)


def _least_step(grid: np.ndarray) -> float:
    return min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))


def _window(grid: np.ndarray) -> float:
    """Return half the side of a window that holds no neighbour of a corner, px."""
    return max(WINDOW_SHARE * _least_step(grid), LEAST_WINDOW)


def _first_is_black(grey: np.ndarray, grid: np.ndarray, board: ChessboardDesign) -> bool:
    """Return True if the square between corners (0, 0) and (1, 1) has the darker colour."""
    image_from_board = fit_homography(board.xy_mm() / board.square_mm, grid.reshape(-1, 2))
    first = column_row(board.rows - 1, board.columns - 1)  # corners of the squares
    x, y = np.rint(apply_homography(image_from_board, first + 0.5)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < grey.shape[1]) & (y < grey.shape[0])
    level = grey[y[inside], x[inside]].astype(float)
    even = (first.sum(1) % 2 == 0)[inside]
    return bool(even.all() or level[even].mean() < level[~even].mean())


def why_no_chessboard(image: np.ndarray, board: ChessboardDesign) -> str:
    """Return the likely reason why :func:`find_chessboard` finds nothing, judged by the number of corners in view."""
    grey = grey_8bit(image)
    scale = min(FIRST_SIDE / max(grey.shape), 1.0)
    small = grey if scale == 1 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, PART, PART_FLAGS)
    inner, correct = f"not all {board.rows}×{board.columns} inner corners of the chessboard", "correct rows and columns"
    if not found:
        return f"{inner}, which rows and columns of its file count"
    rows, columns = sorted(meta.shape[:2])
    if rows > min(board.rows, board.columns) or columns > max(board.rows, board.columns):
        return f"{inner}, but {rows}×{columns}; {correct} in its file, which count inner corners"
    part = "a part of a plain chessboard has no numbers; show all of it"
    return f"{inner}, but {rows}×{columns}: {part}, or {correct} in its file"


LEAST_CORNERS = 4  # smallest number of corners of a view: they determine a homography
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
"""Largest deviation of a corner from its prediction, in robust σ of the view or, if larger, of the neighbours."""
SMOOTHING_PX = 0.8  # σ of the smoothing before gradients are taken
ALIKE_PX2 = 4 * np.pi * SMOOTHING_PX**2  # area of pixels that smoothing makes alike, px²
LEAST_WINDOW_PX, MOST_WINDOW_PX = 2, 30  # limits of half the side of a window, px
STEPS, SETTLED_PX = 20, 1e-3  # most steps of a corner's measurement, and the step at which it ends, px
WIDEST_EDGE, MOST_FROM_SADDLE = 0.4, 0.25
"""Largest σ of an edge's blur, and distance of the edges' point from the saddle, in half sides of the window."""
NOISE = 1e-6  # keeps the equations of a blank window regular
LEAST_SIGMA_PX = 0.02
"""Smallest σ of a corner: below it printing, flatness and the lens limit its accuracy, not noise."""


def find_charuco(image: np.ndarray, name: str, board: CharucoDesign) -> BoardView | None:
    """Return the inner corners of a ChArUco board, with covariances; None if fewer than four are seen. Each measurement
    starts where the surrounding corners predict it, and must end near there: at the crossing of the edges by their
    areas; else where their gradients meet; else at the saddle of the grey values."""
    grey = grey_8bit(image)
    ids, corners = _read(grey, board)
    if len(ids) < LEAST_CORNERS:
        return None
    squares = board.xy_mm()[ids] / board.square_mm
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING_PX)
    # Half the sides of upright windows, in squares, whose diagonals are clear of the tags, and of the tags' cells:
    # white and a tag's black border lie alike on both sides of a corner.
    white = (1 - board.marker_mm / board.square_mm) / 2
    cell = board.marker_mm / board.square_mm / (dictionary_of(board.dictionary).markerSize + 2)
    small, large = white / np.sqrt(2), (white + cell) / np.sqrt(2)
    for _ in range(2):
        foretold = _Foretold(squares, corners)
        blurred = _saddles(smooth, foretold.xy_px, _half_px(large, foretold))
        corners = blurred.xy_px
    gradient = tuple(cv2.Scharr(smooth, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    sharp = _edges_meet(gradient, corners, _half_px(small, foretold))
    along = np.swapaxes(homography_jacobian(_robust_homography(squares, corners), squares), 1, 2)
    start, clear = sharp.otherwise(blurred).xy_px, np.sqrt(2) * small * foretold.step_px
    by_area = crossings(grey, start, along, _half_px(small, foretold), clear)
    measured = by_area.otherwise(sharp).otherwise(blurred)
    good = measured.seen & _Foretold(squares, measured.xy_px).agrees(measured.xy_px)
    if good.sum() < LEAST_CORNERS:
        return None
    view = view_of(name, board, ids[good], measured.xy_px[good], measured.covariance_px2[good])
    return view if good.all() else replace(view, unused=("corners that lie off the corners about them",))


def _read(grey: np.ndarray, board: CharucoDesign) -> tuple[np.ndarray, np.ndarray]:
    """Return the ids (n,) of the inner corners beside tags, and their approximate places (n, 2), px."""
    size, dictionary = (board.columns, board.rows), dictionary_of(board.dictionary)
    ids_of_board = np.array(board.tag_ids(), np.int32)
    plain = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary, ids_of_board)
    plain.setLegacyPattern(board.legacy)
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers, settings.tryRefineMarkers = 1, True
    detector = cv2.aruco.CharucoDetector(plain, settings, detector_settings(board.dictionary))
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None:
        return np.zeros(0, int), np.zeros((0, 2))
    return ids.ravel().astype(int), corners.reshape(-1, 2).astype(float)


class _Foretold:
    """Corners at ``squares`` (n, 2) of the board as predicted by the corners around each of them."""

    def __init__(self, squares: np.ndarray, corners: np.ndarray):
        image_from_squares, n = _robust_homography(squares, corners), len(squares)
        self.xy_px = base = apply_homography(image_from_squares, squares)  # (n, 2)
        # (n,) shorter side of a square there
        self.step_px = np.linalg.svd(homography_jacobian(image_from_squares, squares), compute_uv=False)[:, 1]
        self.scatter_px = np.zeros(n)  # (n,) median deviation of those corners from their own smooth field
        if n < TESTED_FROM:
            return
        near = np.asarray(KDTree(squares).query(squares, k=min(NEIGHBOURS, n - 1) + 1)[1])[:, 1:]
        design = np.concatenate([np.ones((*near.shape, 1)), squares[near] - squares[:, None]], axis=2)
        left = (corners - base)[near]
        weight = np.ones(near.shape)
        for _ in range(ROBUST_PASSES):  # least lengths instead of squares, by reweighting: a median of the plane
            normal = np.einsum("nki,nk,nkj->nij", design, weight, design) + np.diag([0, *[SLOPE_SIGMA_PX**-2] * 2])
            plane = np.linalg.solve(normal, np.einsum("nki,nk,nkc->nic", design, weight, left))
            length = np.linalg.norm(left - design @ plane, axis=2)
            weight = 1 / np.maximum(length, LEAST_SCATTER_PX)
        self.xy_px, self.scatter_px = base + plane[:, 0], np.median(length, axis=1)

    def agrees(self, xy_px: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the corners that are at their predicted places."""
        if len(xy_px) < TESTED_FROM:
            return np.ones(len(xy_px), bool)
        off = np.linalg.norm(xy_px - self.xy_px, axis=1)
        scatter = np.maximum(self.scatter_px / median_length(2), max(robust_sigma(off, 2), LEAST_SCATTER_PX))
        return off <= GATE * scatter


def _robust_homography(squares: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the homography of least median deviation, image from squares; of least squares without redundancy."""
    found = cv2.findHomography(squares, corners, cv2.LMEDS)[0] if len(squares) > LEAST_CORNERS else None
    return fit_homography(squares, corners) if found is None else found


def _half_px(share: float, foretold: _Foretold) -> np.ndarray:
    """Return half the sides (n,) of the corners' windows, whole px."""
    return np.rint(share * foretold.step_px).clip(LEAST_WINDOW_PX, MOST_WINDOW_PX).astype(int)


def _edges_meet(gradient: tuple[np.ndarray, ...], start: np.ndarray, half: np.ndarray) -> Crossings:
    """Return the points near ``start`` (n, 2) where edges meet, in windows of ``half`` (n,) (Förstner & Gülch 1987)."""

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


def _saddles(grey: np.ndarray, start: np.ndarray, half: np.ndarray) -> Crossings:
    """Return the saddles near ``start`` (n, 2), by parabolas in windows of ``half`` (n,) px; residuals give σ."""

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


class _Window:
    """A square window with half sides of ``half`` px: ``offsets`` (k, 2) from its middle, weights ``bell`` (k,)."""

    def __init__(self, half: int):
        self.half = half
        self.offsets = np.stack(np.meshgrid(*[np.arange(-half, half + 1.0)] * 2), axis=-1).reshape(-1, 2)
        self.bell = np.exp(-(self.offsets**2).sum(1) / half**2)

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


def _found(step: Callable, start: np.ndarray, half: np.ndarray, reach: float = 1.0) -> Crossings:
    """Return where steps (n, 2), with covariances, end: within ``reach`` half sides of the window from ``start``."""
    n = len(start)
    xy, covariance, seen = start.copy(), np.full((n, 2, 2), np.nan), np.zeros(n, bool)
    for side in np.unique(half).tolist():
        own, window = np.flatnonzero(half == side), _Window(side)
        for _ in range(STEPS):
            move, covariance[own] = step(xy[own], window)
            short = np.minimum(1.0, side / 2 / np.maximum(np.linalg.norm(move, axis=1, keepdims=True), SETTLED_PX))
            xy[own] += short * move
            if np.abs(move).max() < SETTLED_PX:
                break
        seen[own] = np.linalg.norm(xy[own] - start[own], axis=1) <= reach * side
    seen &= np.isfinite(covariance).all((1, 2))
    return Crossings(np.where(seen[:, None], xy, start), covariance + LEAST_SIGMA_PX**2 * np.eye(2), seen)


MOST_READ, LOOKED_AT = 12, 5
"""Largest numbers of images in which tags of no face, and tags of other kinds, are looked for."""
MOST_TILT_DEG = 70.0
LEAST_COSINE = float(np.cos(np.radians(MOST_TILT_DEG)))
"""Largest tilt of tags, and its cosine: beyond, corners had errors of 0.27 to 0.45 px RMS in place of 0.06."""


def find_on_faces(
    image: np.ndarray, name: str, boards: Mapping[str, SquaresOrTags], camera: Camera
) -> tuple[dict[str, BoardView], list[str]]:
    """Return the views of boards and tags in a grey image by face, and notes on what was left out."""
    together = [tags_on(board) for board in boards.values() if isinstance(board, TagLayout | CharucoDesign)]
    tags = find_tags(image, [dictionary for own in together for dictionary, _ in own], windows_px=APART_PX)
    read = {*tags.tags, *tags.repeated}

    def found(board: SquaresOrTags) -> tuple[BoardView | None, str]:
        if isinstance(board, TagLayout):
            return view_of_tags(name, tags, board), ""
        if isinstance(board, AprilGridDesign):
            return find_aprilgrid(image, name, board, camera)
        if isinstance(board, ChessboardDesign):
            view = find_chessboard(image, name, board, with_sigma=True)
            return view, "" if view else why_no_chessboard(image, board)
        unread = read.isdisjoint(tags_on(board))
        return (None, f"no tag of {board.dictionary}") if unread else (find_charuco(image, name, board), "")

    views: dict[str, BoardView] = {}
    notes: list[str] = []
    for face, board in boards.items():
        view, why, oblique = None, "", ""
        try:
            view, why = found(board)
            if view is not None and isinstance(board, TagLayout | AprilGridDesign):
                view, oblique = _not_oblique(view)
                view = straightened(view, camera)
        except StcalError as error:  # corners on a line, say
            view, why = None, f"left out, {error}"
        where = BOARD if face == BOARD else f"face {face}"
        notes += [f"{where}: {oblique}"] if oblique else []
        if view is not None:
            views[face] = view
            notes += [f"{where}: {reason}" for reason in view.unused]
        elif why and (face == BOARD or not isinstance(why, Unseen)):
            notes.append(f"{where}: {why}")
    return views, notes


def _not_oblique(view: BoardView) -> tuple[BoardView | None, str]:
    """Returns the view of tags without those that are tilted too far, None if none is left, and why."""
    corners = view.xy_px.reshape(-1, 4, 2)
    across = corners[:, 1] + corners[:, 2] - corners[:, 0] - corners[:, 3]
    down = corners[:, 2] + corners[:, 3] - corners[:, 0] - corners[:, 1]
    shape = np.linalg.svd(np.stack([across, down], axis=2), compute_uv=False)
    cosine = shape[:, 1] / shape[:, 0]
    keep = np.repeat(cosine >= LEAST_COSINE, 4)
    if keep.all():
        return view, ""
    count, tilt_deg = int((~keep).sum()) // 4, float(np.degrees(np.arccos(cosine.min())))
    tags = "a tag is" if count == 1 else f"{count} tags are"
    why = f"{tags} tilted by {tilt_deg:.0f}°, up to {MOST_TILT_DEG:g}° is measured; turn the face towards the camera"
    return view.rows(keep) if keep.any() else None, why


def straightened(view: BoardView | None, camera: Camera) -> BoardView | None:
    """Returns the view of tags with the corners at which their curved edges meet."""
    if view is None:
        return None
    return replace(view, xy_px=view.xy_px - shift_by_curves(view.xy_px.reshape(-1, 4, 2), camera).reshape(-1, 2))


def shift_by_curves(corners_px: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns how far the lens moves the measured corners (n, 4, 2) of tags, as lines are laid along its curves."""
    ideal = camera.normalised_from_pixel(corners_px)
    step = (np.roll(ideal, -1, axis=1) - ideal)[:, :, None]
    edge = camera.pixel_from_normalised(ideal[:, :, None] + np.linspace(*ALONG, POINTS)[:, None] * step)
    middle = edge.mean(2)
    away = edge - middle[:, :, None]
    normal = np.linalg.eigh(np.swapaxes(away, 2, 3) @ away)[1][..., 0]
    lines, offsets = (np.stack([np.roll(each, 1, axis=1), each], axis=2) for each in (normal, (normal * middle).sum(2)))
    return np.linalg.solve(lines, offsets[..., None])[..., 0] - corners_px


def tags_of_no_face(files: Sequence[ImageFile], faces: Sequence[FaceDesign], unseen: Sequence[FaceDesign]) -> list[str]:
    """Return notes on tags that images show and no face has, where tags of ``unseen`` faces are in none of them."""
    missing = sorted({tag for face in unseen for tag in tags_on(face.printed)})
    if not missing:
        return []
    own = {tag for face in faces for tag in tags_on(face.printed)}
    known = sorted({dictionary for dictionary, _ in own})
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, min(len(files), MOST_READ)).astype(int))]
    seen = Counter(tag for file in chosen for tag in set(find_tags(_grey(file), known).tags))
    strange = [(tag, count) for tag, count in seen.most_common() if tag not in own and count > 1]
    if not strange:
        return []
    shown = ", ".join(f"tag {number} of {name} in {count} of {len(chosen)}" for (name, number), count in strange[:3])
    names = ", ".join(f"{number} of {name}" for name, number in missing[:3])
    return [f"images show tags that no face has ({shown}), and not {names}"]


def _grey(file: ImageFile) -> np.ndarray:
    return grey_of(decode(file.read(), file.name), file.name)


def why_unseen(files: Sequence[ImageFile], faces: Sequence[FaceDesign]) -> str:
    """Return why none of the images shows one of the printed faces, by the tags in the first images."""
    own = {tag for face in faces for tag in tags_on(face.printed)}
    known = sorted({dictionary for dictionary, _ in own})
    reason = f"no printed face of the target is seen in {len(files)} images"
    for file in files[:LOOKED_AT] if known else ():
        grey = _grey(file)
        read = find_tags(grey, known).tags
        names = ", ".join(str(tag) for _, tag in read[:5])
        if own.intersection(read):
            return f"{reason}: {file.name} shows tags {names}, too small or too steep; go nearer, or turn the target"
        if read:
            return f"{reason}, and {file.name} shows tags {names} of its dictionaries; correct the ids in target.toml"
        if shown := seen_otherwise(grey, own, "target.toml"):
            return f"{reason}, and {file.name} shows {shown}"
    return f"{reason}; look at overlays (`stcal-sfm detect`), and check dictionary, ids and the exposure"
