"""Candidates: blobs whose outline is an ellipse, over a pyramid of scales; their matches with patterns; and what is
found in an image, before it is compared with its group."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial import KDTree

from stcal.design import FaceDesign, Polarity
from stcal.errors import InputError
from stcal.geometry.arrays import freeze, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homographies, homography_jacobian, singular_values
from stcal.io.images import shrunk
from stcal.labels import BOARD, CircleLabel
from stcal.sfm.data.group_model import Centres, CircleRows

WINDOWS_PX = (41, 193)  # sides of the windows whose mean is the threshold, on every level of the pyramid
WINDOW_OVER_DIAMETER = 3.0
"""Smallest ratio of window to blob. In a smaller window the blob pulls the mean towards itself."""
HALF_SCALE_FROM_PX = 8_000_000
"""Images of more pixels start the pyramid at half scale, unless smaller circles are required …"""
MIN_DIAMETER_AT_HALF_SCALE_PX = 9.0  # smallest default diameter at half scale
MIN_DIAMETER_PX = 4.5  # smallest diameter of the circle of the same area: a circle 8 px across at 70° has 4.7
DOUBLE_SCALE_BELOW_PX = 1_500_000
"""Images of fewer pixels start at double scale: the outline of a small ellipse is coarse."""
REACH_PX = 11
OUTLINE_LEVEL = 0.45  # outlines run at this fraction of the highest value within reach
MIN_LEVEL_DIAMETER_PX = 3.0
MIN_COARSE_DIAMETER_PX = 24.0
"""Smallest diameter on coarse levels. Smaller ellipses are found on finer levels, where outlines are more accurate."""
MAX_OUTLINE_DEVIATION = 0.025
"""RMS deviation of the outline from the ellipse, in units of its radius (a square has 0.07) …"""
MAX_OUTLINE_DEVIATION_PX = 0.45  # additional deviation by pixels and noise
MAX_AREA_ERROR = 0.15
"""Largest difference between the areas of the outline and of its ellipse, as a fraction of the latter."""
MIN_THRESHOLD = 4.0  # smallest threshold, in grey values of the 8-bit image

OPTION_RANGES = dict.fromkeys(("min_diameter_px", "max_diameter_px"), (1.0, 1e6))
OPTION_RANGES |= {"min_axis_ratio": (0.01, 1.0), "min_contrast": (1e-6, 1.0)}


@dataclass(frozen=True, slots=True)
class EllipseOptions:
    """Limits for candidates."""

    min_diameter_px: float | None = None  # of the circle of the same area; None: 4.5, or 9 in images over 8 megapixels
    max_diameter_px: float = 450.0
    min_axis_ratio: float = 0.2  # minor over major axis (cos 70° is 0.34; blur and pixels take some more)
    min_contrast: float = 0.08  # inside against surroundings, as a fraction of the image's grey range

    def __post_init__(self):
        require_fields(self, "options")
        for name, (low, high) in OPTION_RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                needed = f"option {name} {value:g}: {low:g} to {high:g} possible; give another"
                raise InputError("E-OPTION-RANGE", needed)


@dataclass(frozen=True, slots=True, eq=False)
class Ellipses(CircleRows):
    """n candidates."""

    centre_px: np.ndarray  # (n, 2)
    shape_px: np.ndarray  # (n, 2, 2), symmetric, rim = centre + shape @ unit circle
    contrast: np.ndarray  # (n,) middle against surroundings, grey values of the 8-bit image, positive

    def __post_init__(self):
        for name, shape in (("centre_px", (2,)), ("shape_px", (2, 2)), ("contrast", ())):
            freeze(self, name, (len(self.centre_px), *shape), name)

    def __len__(self) -> int:
        return len(self.centre_px)

    def radius_px(self) -> np.ndarray:
        """Returns the radius of the circle of the same area, (n,)."""
        return np.sqrt(np.abs(np.linalg.det(self.shape_px)))


def find_ellipses(image: np.ndarray, polarity: Polarity, options: EllipseOptions) -> Ellipses:
    """Finds blobs of one polarity with an elliptic outline in an 8-bit grey image; centres are good to about 0.1 px."""
    threshold = contrast_threshold(image, options)
    found = [_rows(*level, polarity, threshold, options) for level in _levels(image, options)]
    return distinct(image, polarity, np.concatenate(found), threshold)


def contrast_threshold(image: np.ndarray, options: EllipseOptions) -> float:
    """Returns the contrast that a circle must exceed, grey values."""
    low, high = np.percentile(image[::8, ::8], [0.5, 99.9])
    return max(MIN_THRESHOLD, options.min_contrast * (max(high, 1.0) - low))


def diameter_limits_px(pixels: int, options: EllipseOptions) -> tuple[float, float]:
    """Returns the smallest and largest diameter to find in an image of the given number of pixels."""
    default = MIN_DIAMETER_AT_HALF_SCALE_PX if pixels > HALF_SCALE_FROM_PX else MIN_DIAMETER_PX
    return options.min_diameter_px or default, options.max_diameter_px


def _levels(image: np.ndarray, options: EllipseOptions) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yields the levels of the pyramid, the finest first: image, size of its pixels in px, and diameter sought."""
    scale, minimum = 1.0, diameter_limits_px(image.size, options)[0]
    if image.size > HALF_SCALE_FROM_PX and minimum >= MIN_DIAMETER_AT_HALF_SCALE_PX:
        image, scale = shrunk(image, 0.5), 2.0
    elif image.size < DOUBLE_SCALE_BELOW_PX:
        image, scale = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 0.5
    first = True
    while True:
        # Both of the first two levels of a small image look for everything: the coarser one sees less noise.
        fine = first or scale <= 1
        smallest = max(MIN_LEVEL_DIAMETER_PX, minimum / scale) if fine else MIN_COARSE_DIAMETER_PX
        yield image, scale, max((options.min_diameter_px or 0) / scale, smallest)
        if options.max_diameter_px / scale <= WINDOWS_PX[-1] / WINDOW_OVER_DIAMETER or min(image.shape) < 16:
            return
        scale, first = 2 * scale, False
        image = shrunk(image, 0.5)


def _contrast(image: np.ndarray, polarity: Polarity, centre: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Returns the median grey value in the middle minus that around, (n,); with opposite sign for dark circles."""
    angle, inner, outer = np.arange(16) * (np.pi / 8), 0.4 * shape, 1.25 * shape + 2.0 * np.eye(2)
    median = []
    for wide in (inner, outer):
        rim = np.einsum("nij,kj->nki", wide, np.column_stack([np.cos(angle), np.sin(angle)]))
        at = np.round(centre[:, None] + rim).astype(int)
        x, y = (np.clip(at[..., k], 0, image.shape[1 - k] - 1) for k in range(2))
        median.append(np.median(image[y, x], axis=1) if len(at) else np.zeros(0))
    return (median[0] - median[1]) * (1 if polarity == "bright" else -1)


def outlines(mask: np.ndarray) -> list[np.ndarray]:
    """Returns the outer outlines in a mask, without outlines of holes."""
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [contours[i] for i in np.flatnonzero(hierarchy[0, :, 3] < 0).tolist()] if contours else []


def outline_area(contour: np.ndarray) -> float:
    """Returns the area of the pixels inside an outline, including its own."""
    return cv2.contourArea(contour) + 0.5 * cv2.arcLength(contour, True) + 1


def _rows(
    image: np.ndarray, scale: float, lowest: float, polarity: Polarity, threshold: float, options: EllipseOptions
) -> np.ndarray:
    """Returns the ellipses of one level, in px of the full image: x, y, full axes 1 and 2, angle of axis 1 in deg."""
    smooth, rows = cv2.GaussianBlur(image, (3, 3), 0), []
    for window in WINDOWS_PX:
        highest = min(options.max_diameter_px / scale, window / WINDOW_OVER_DIAMETER)
        if highest < lowest:
            continue
        mean = cv2.blur(smooth, (window, window), borderType=cv2.BORDER_REFLECT)
        difference = cv2.subtract(smooth, mean) if polarity == "bright" else cv2.subtract(mean, smooth)
        # An outline at half the blob's own height neither grows with blur nor runs into a neighbour.
        peak = cv2.dilate(difference, np.ones((REACH_PX, REACH_PX), np.uint8))
        mask = cv2.bitwise_and(
            cv2.threshold(difference, threshold, 255, cv2.THRESH_BINARY)[1],
            cv2.compare(difference, cv2.convertScaleAbs(peak, alpha=OUTLINE_LEVEL), cv2.CMP_GT),
        )
        points = max(6.0, 2 * lowest), 4 * highest / np.sqrt(options.min_axis_ratio)
        limits = mask.shape, points, (lowest, highest), options.min_axis_ratio
        rows += [_ellipse(contour, *limits) for contour in outlines(mask)]
    table = np.array([row for row in rows if row is not None]).reshape(-1, 5)
    table[:, :2] = table[:, :2] * scale + (scale - 1) / 2
    table[:, 2:4] *= scale
    return table


def _ellipse(
    contour: np.ndarray, shape: tuple[int, ...], points: tuple, diameter_px: tuple, min_axis_ratio: float
) -> tuple[float, ...] | None:
    """Returns an ellipse within the limits, (x, y, full axes 1 and 2, angle of axis 1 in deg), or None."""
    if not points[0] <= len(contour) <= points[1]:
        return None
    x, y, w, h = cv2.boundingRect(contour)
    if x == 0 or y == 0 or x + w == shape[1] or y + h == shape[0]:
        return None
    (cx, cy), (d1, d2), angle = cv2.fitEllipseDirect(contour)
    if not np.isfinite(d1 + d2 + cx + cy):
        return None
    # The outline runs through the centres of the outermost pixels, half a pixel inside the edge.
    d1, d2 = d1 + 1, d2 + 1
    if min(d1, d2) < min_axis_ratio * max(d1, d2) or not diameter_px[0] <= np.sqrt(d1 * d2) <= diameter_px[1]:
        return None
    if abs(outline_area(contour) / (np.pi / 4 * d1 * d2) - 1) > MAX_AREA_ERROR:
        return None
    turn, (x, y) = np.radians(angle), (contour[:, 0, :] - [cx, cy]).T
    along, across = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    rho = np.hypot(along * 2 / max(d1 - 1, 1e-6), across * 2 / max(d2 - 1, 1e-6))
    size = np.sqrt((d1 - 1) * (d2 - 1)) / 2
    deviation = np.sqrt(np.mean((rho - 1) ** 2)) * size  # RMS distance of the outline from the ellipse
    within = deviation <= MAX_OUTLINE_DEVIATION_PX + MAX_OUTLINE_DEVIATION * size
    return (cx, cy, d1, d2, angle) if within else None


def distinct(image: np.ndarray, polarity: Polarity, table: np.ndarray, threshold: float) -> Ellipses:
    """Returns the ellipses of rows (x, y, full axes 1 and 2, angle of axis 1 in deg) of enough contrast. Of coincident
    rows the first, from the finest level, is kept."""
    centre, radius = table[:, :2], np.sqrt(table[:, 2] * table[:, 3]) / 2
    pairs = KDTree(centre).query_pairs(0.5 * radius.max(initial=0), output_type="ndarray")
    smaller, larger = np.sort(radius[pairs], axis=1).T
    near = np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1) < 0.3 * smaller + 0.5
    table = np.delete(table, pairs[near & (smaller > 0.75 * larger), 1], axis=0)
    angle = np.radians(table[:, 4])
    axes = np.stack([np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)], 2)
    shape = (axes * table[:, None, 2:4] / 2) @ np.swapaxes(axes, 1, 2)
    contrast = _contrast(image, polarity, table[:, :2], shape)
    keep = contrast > threshold
    return Ellipses(table[keep, :2], shape[keep], contrast[keep])


MAX_POSITION_ERROR = 0.15  # largest distance between a pattern's prediction and a candidate, in radii of the circle
MAX_POSITION_ERROR_PX = 1.5  # lower bound of that distance, px: candidates before centring are good to a few tenths
MAX_AXIS_RATIO = 1.45  # largest ratio between the predicted and the found ellipse along any direction
MIN_HOMOGRAPHY_POINTS = 4


class Candidates:
    """n ellipses in normalised ideal coordinates. Lens distortion is removed from centres exactly, from shapes to first
    order."""

    tree: KDTree  # over ``xy``

    def __init__(self, ellipses: Ellipses, camera: Camera):
        self.xy = camera.normalised_from_pixel(ellipses.centre_px)  # (n, 2) centres
        _, distorted_by_ideal = camera.distort_jacobian(self.xy)
        # (n, 2, 2), rim = xy + shape @ unit circle
        self.shape = np.linalg.solve(distorted_by_ideal, ellipses.shape_px / camera.focal[:, None])
        self.radius = np.sqrt(np.abs(np.linalg.det(self.shape)))  # (n,) of equal area
        self.contrast = ellipses.contrast  # (n,) grey values
        self.px = 1 / float(np.sqrt(camera.focal.prod()))  # size of a pixel in these coordinates
        self.tree = KDTree(self.xy)

    def mirrored(self) -> "Candidates":
        """Returns the mirror image of the candidates, with reversed x."""
        found, flip = copy(self), np.array([-1.0, 1.0])
        found.xy, found.shape = self.xy * flip, flip[:, None] * self.shape * flip
        found.tree = KDTree(found.xy)
        return found

    def __len__(self) -> int:
        return len(self.xy)


def match_pattern(
    candidates: Candidates, image_from_plane: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, slack: float = 1.0
) -> np.ndarray:
    """Returns for each circle of a pattern the candidate at its place with its size and shape, (m,), −1 for none.
    ``image_from_plane``: (3, 3) into normalised coordinates, ``xy_plane``: (m, 2), ``radius``: (m,), or k of each;
    ``slack``: factor on the position tolerance."""
    predicted = apply_homography(image_from_plane, xy_plane)
    local = homography_jacobian(image_from_plane, xy_plane) * radius[..., None, None]
    size = np.sqrt(np.abs(np.linalg.det(local)))
    distance, nearest = candidates.tree.query(predicted)
    nearest = np.where(np.isfinite(distance), nearest, 0)
    widest, narrowest = singular_values(np.linalg.solve(candidates.shape[nearest], local))
    # Blur and pixels widen small ellipses: half a pixel at each end of the minor axis.
    max_stretch = MAX_AXIS_RATIO * (1 + candidates.px / np.maximum(singular_values(local)[1], candidates.px))
    fits = distance < slack * np.maximum(MAX_POSITION_ERROR * size, MAX_POSITION_ERROR_PX * candidates.px)
    index = np.where(fits & (widest < max_stretch) & (narrowest > 1 / max_stretch), nearest, -1)
    # A candidate that two circles of a pattern claim goes to the nearer one.
    claimed = index.ravel() + np.arange(index.size) // index.shape[-1] * (len(candidates) + 1)
    order = np.lexsort((distance.ravel(), claimed))
    again = np.flatnonzero((claimed[order][1:] == claimed[order][:-1]) & (index.ravel()[order][1:] >= 0)) + 1
    index.reshape(-1)[order[again]] = -1
    return index


def grow_matches(
    candidates: Candidates, index: np.ndarray, xy_plane: np.ndarray, radius: np.ndarray, rounds: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Alternates between fitting homographies to the matched circles and matching again, until nothing changes.
    ``index``: (k, m) start, −1 if there is none; ``xy_plane``: (k, m, 2); ``radius``: (k, m), 0 behind the last circle
    of a shorter pattern, with the place of an existing circle. Returns index, homographies (k, 3, 3) to normalised
    coordinates, and whether matches converged with four circles or more, (k,)."""
    index, there = index.copy(), radius > 0
    homography, holds = np.full((len(index), 3, 3), np.nan), np.zeros(len(index), bool)
    active = np.arange(len(index))
    for turn in range(rounds):
        matched = index[active] >= 0
        low, high = (np.where(matched[..., None], xy_plane[active], far) for far in (np.inf, -np.inf))
        spread = (high.max(1) > low.min(1)).all(1)  # not all in one row or column
        active = active[(matched.sum(1) >= MIN_HOMOGRAPHY_POINTS) & spread]
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
    return index, homography, holds


SECOND_BOARD_SHARE = 0.8  # smallest number of dots of a second board, as a share of the dots of the first


@dataclass(frozen=True, slots=True, eq=False)
class FaceSighting:
    """A face in an image."""

    face: str
    rows: np.ndarray  # (n,) indices of its circles among the candidates, or the image's centres
    circles: np.ndarray  # (n,) their indices in the design

    def labels(self, design: FaceDesign) -> tuple[CircleLabel, ...]:
        """Returns the labels of its circles."""
        labels = design.labels()
        return tuple(labels[i] for i in self.circles)

    def by(self, row: np.ndarray) -> "FaceSighting":
        """Returns the circles that have other indices: ``row`` by that so far, −1 for none."""
        rows = row[self.rows]
        return FaceSighting(self.face, rows[rows >= 0], self.circles[rows >= 0])


OpenFace = tuple[FaceSighting, ...]
"""A pattern that the image alone cannot name: all faces that it may be."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardSighting:
    """A board in an image."""

    rows: np.ndarray  # (n,) indices of its dots among the candidates, or the image's centres
    numberings: np.ndarray  # (k, n, 2) row and column of each dot in each numbering, the likeliest first
    # (u, n, 2) that require covered dots inside the image; the group may confirm them
    unlikely: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 2), int))

    def by(self, row: np.ndarray) -> "BoardSighting":
        """Returns the dots that have other indices: ``row`` by that so far, −1 for none."""
        rows = row[self.rows]
        ok = rows >= 0
        return BoardSighting(rows[ok], self.numberings[:, ok], self.unlikely[:, ok])


@dataclass(frozen=True, slots=True, eq=False)
class ImageDetection:
    """Result of detection in one image; a face or the board may occur more than once."""

    centres: Centres
    faces: tuple[FaceSighting, ...]
    boards: tuple[BoardSighting, ...] = ()  # the one with the most dots first
    mirrored: tuple[str, ...] = ()  # ids of faces
    notes: tuple[str, ...] = ()  # exclusions with reasons
    candidates: int = 0  # number of outlines
    open_faces: tuple[OpenFace, ...] = ()  # patterns without a name
    # faces with a board or tags, whose corners are among the centres, without extent
    printed: tuple[FaceSighting, ...] = ()

    @property
    def repeated(self) -> tuple[str, ...]:
        """Names of the faces, and of the board, that are in view more than once."""
        ids = [sighting.face for sighting in self.faces]
        boards = self.boards[1:2] and len(self.boards[1].rows) >= SECOND_BOARD_SHARE * len(self.boards[0].rows)
        return (BOARD,) * bool(boards) + tuple(f"face {i}" for i in sorted(set(ids)) if ids.count(i) > 1)

    @property
    def board(self) -> BoardSighting | None:
        """The only board of the image; None if there is none, or a second one of similar size."""
        return None if not self.boards or BOARD in self.repeated else self.boards[0]
