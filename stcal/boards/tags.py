"""Detection of tags (through ``cv2.aruco``), and corners of a tag from its four edges."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stcal.boards.design import BoardView, TagLayout, view_of
from stcal.geometry.arrays import frozen
from stcal.geometry.robust import median_length
from stcal.io.images import grey_8bit

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


UNREFINED_PX = 0.5
"""σ of a corner whose edges cannot be measured."""
SATURATED = 254
"""Smallest grey value (8 bit) of a pixel that may be saturated."""
EDGE_PX = 0.1
"""σ of the shift that all edges of a tag share, by a nonlinear response, stray light or ink."""
SATURATED_EDGE_PX = 0.7
"""σ that saturation adds to this shift. An edge blurred by 0.7 px whose bright side is clipped at ½ or ¼ of its height
seems to lie 0.6 or 0.9 px farther towards the dark side (the mean of a normal density's tail)."""
SATURATION_POINTS = 8
"""Number of points along each edge at which saturation is tested."""
WHITE_PX = 3
"""Side of the window of the dilation, px. Without dilation, a blurred corner at which two black squares meet joins them
to one outline."""
GROWN_LOOKS = ((2, 4e7), (3, 1e7), (1, 5e8))
"""Scales of the dilated images, each with the largest number of pixels up to which it is used. Dilation by a pixel at
the original scale grows the white too far into tags of 50 px and less."""


@dataclass(frozen=True, slots=True, eq=False)
class Tags:
    """The tags seen in one image.

    ``tags`` : (n,) dictionary and id; ``corners_px`` : (n, 4, 2) top left, top right, bottom right, bottom left as
    printed; ``covariance_px2`` : (n, 4, 2, 2); ``repeated`` : tags that were omitted because they occur more than once;
    ``saturated`` : (n,) share of the white around a tag that is saturated, see :meth:`edge_sigma_px`.
    """

    tags: tuple[tuple[str, int], ...]
    corners_px: np.ndarray
    covariance_px2: np.ndarray
    repeated: tuple[tuple[str, int], ...] = ()
    saturated: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "corners_px", frozen(self.corners_px, (len(self.tags), 4, 2), "tags' corners"))
        shape = (len(self.tags), 4, 2, 2)
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, shape, "corners' covariances"))
        share = np.zeros(len(self.tags)) if self.saturated is None else self.saturated
        object.__setattr__(self, "saturated", frozen(share, (len(self.tags),), "saturated shares"))

    def __len__(self) -> int:
        return len(self.tags)

    def edge_sigma_px(self) -> np.ndarray:
        """Return σ (n,) of an outward or inward shift that all edges of a tag share, and residuals do not show."""
        return np.hypot(EDGE_PX, SATURATED_EDGE_PX * np.asarray(self.saturated))


def find_tags(image: np.ndarray, dictionaries: Sequence[str], border_bits: int = 1, joined: bool = False) -> Tags:
    """Return the tags of the dictionaries in a grey image (height, width), with corners from their edges.

    ``border_bits`` : width of the black border in cells; ``joined`` : True if black squares touch the tags' corners.
    """
    grey = grey_8bit(image)
    places_of: dict[tuple[str, int], list[np.ndarray]] = {}
    for name in dict.fromkeys(dictionaries):
        detector = cv2.aruco.ArucoDetector(dictionary_of(name), detector_settings(name, border_bits))
        for look in _looks(grey, joined):
            corners, ids, _ = detector.detectMarkers(look.grey)
            places = look.in_image(np.array(corners, np.float32).reshape(-1, 4, 2))
            earlier = {tag: list(known_places) for tag, known_places in places_of.items()}
            for place, tag in zip(places, [] if ids is None else ids.ravel(), strict=True):
                if not any(_inside(place, earlier_place) for earlier_place in earlier.get((name, int(tag)), [])):
                    places_of.setdefault((name, int(tag)), []).append(place)
    places_of = _outermost(places_of)
    once = {tag: places[0] for tag, places in sorted(places_of.items()) if len(places) == 1}
    cells = np.array([dictionary_of(name).markerSize + 2 * border_bits for name, _ in once])
    corners, covariance = _refined(grey, np.array(list(once.values()), float).reshape(-1, 4, 2), cells)
    if joined:  # places from larger and dilated images are less accurate
        corners, covariance = _refined(grey, corners, cells)
    saturated = _saturated(grey, corners, cells)
    # If the white is partly saturated, each edge shifts by a different amount.
    uneven = SATURATED_EDGE_PX**2 * saturated * (1 - saturated)
    repeated = tuple(sorted(tag for tag, places in places_of.items() if len(places) > 1))
    return Tags(tuple(once), corners, covariance + uneven[:, None, None, None] * np.eye(2), repeated, saturated)


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """An image enlarged by the factor ``larger``, in which white areas are dilated by ``grown_px`` of its pixels."""

    grey: np.ndarray
    larger: int = 1
    grown_px: float = 0.0

    def in_image(self, corners: np.ndarray) -> np.ndarray:
        """Return the corners of tags (n, 4, 2) in the original image, px."""
        if self.grown_px and len(corners):
            corners = (corners + self.grown_px * corners_by_edges(corners)).astype(np.float32)
        return corners if self.larger == 1 else ((corners + 0.5) / self.larger - 0.5).astype(np.float32)


def _looks(grey: np.ndarray, joined: bool) -> Iterator[_Look]:
    """Yield the image; if tags are joined at their corners, dilated images come first."""
    for larger, most in GROWN_LOOKS if joined else ():
        if grey.size * larger**2 <= most:
            interpolation = cv2.INTER_CUBIC
            large = grey if larger == 1 else cv2.resize(grey, None, fx=larger, fy=larger, interpolation=interpolation)
            grown = cv2.dilate(large, np.ones((WHITE_PX, WHITE_PX), np.uint8))
            yield _Look(grown, larger, (WHITE_PX - 1) / 2)
    yield _Look(grey)


def _inside(place: np.ndarray, other: np.ndarray) -> bool:
    """Return True if the middle of a tag (4, 2) lies inside another tag."""
    x, y = place.mean(0).tolist()
    return cv2.pointPolygonTest(other, (x, y), False) > 0


def other_dictionaries(image: np.ndarray, known: Sequence[str]) -> list[tuple[str, int]]:
    """Return the dictionaries, except ``known`` ones, of which the image shows tags, and the numbers of tags.

    The dictionary with most tags is first; of dictionaries that contain one another, the smaller one is first.
    """
    grey = grey_8bit(image)
    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name not in known)
    # Some dictionaries have two names; and one of the second names finds tags everywhere.
    names = [name for name in names if name.upper() == name or name.upper() not in names]
    counts = []
    for name in names:
        dictionary = dictionary_of(name)
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary, detector_settings(name)).detectMarkers(grey)
        if ids is not None:
            counts.append((-len(ids), len(dictionary.bytesList), name))
    return [(name, -count) for count, _, name in sorted(counts)]


def view_of_tags(image: str, tags: Tags, layout: TagLayout) -> BoardView | None:
    """Return the corners of the layout's tags, None if no tag is seen; tags that are not in the layout are ignored."""
    row = {tag: i for i, tag in enumerate(layout.tags)}
    known = [k for k, tag in enumerate(tags.tags) if tag in row]
    if not known:
        return None
    ids = np.concatenate([4 * row[tags.tags[k]] + np.arange(4) for k in known])
    covariance = tags.covariance_px2[known].reshape(-1, 2, 2)
    view = view_of(image, layout, ids, tags.corners_px[known].reshape(-1, 2), covariance)
    return replace(view, unused=tuple(f"tag {tag[1]} is in view more than once" for tag in tags.repeated if tag in row))


def dictionary_of(name: str):
    """Return the dictionary of ``cv2.aruco`` with this name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def detector_settings(name: str, border_bits: int = 1):
    """Return the settings of the detector.

    The default settings lose small tags: only the middle of a cell keeps its colour, blur mixes the rest with the
    neighbours, and four pixels per cell are too few to separate them. Of 272 real tags of 19 to 60 px a side the
    default settings read 86 %, these 97 %. Two sizes of the threshold window find as much as three.
    """
    settings = cv2.aruco.DetectorParameters()
    settings.markerBorderBits = border_bits
    settings.perspectiveRemovePixelPerCell = 10
    settings.perspectiveRemoveIgnoredMarginPerCell = 0.35
    settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax, settings.adaptiveThreshWinSizeStep = 5, 25, 20
    if "APRILTAG" in name.upper():
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return settings


def _outermost(found: dict[tuple[str, int], list[np.ndarray]]) -> dict[tuple[str, int], list[np.ndarray]]:
    """Return the tags without those read inside a larger tag, from its cells or a second time from its border."""
    flat = [(tag, place, cv2.contourArea(place)) for tag, places in found.items() for place in places]
    outermost: dict[tuple[str, int], list[np.ndarray]] = {}
    for tag, place, area in flat:
        if not any(larger > area and _inside(place, other_place) for _, other_place, larger in flat):
            outermost.setdefault(tag, []).append(place)
    return outermost


def _saturated(grey: np.ndarray, corners: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the saturated share (n,) of the white half a cell outside of tags with ``cells`` cells per side."""
    if not len(corners):
        return np.zeros(0)
    middle = corners.mean(1, keepdims=True)
    outer = middle + (corners - middle) * (1 + 1 / cells)[:, None, None]
    along = np.linspace(0, 1, SATURATION_POINTS, endpoint=False)[:, None]
    points = outer[:, :, None] + along * (np.roll(outer, -1, axis=1) - outer)[:, :, None]
    x, y = np.rint(points).astype(int).reshape(-1, 2).T
    level = grey[y.clip(0, grey.shape[0] - 1), x.clip(0, grey.shape[1] - 1)]
    return (level.reshape(len(corners), -1) >= SATURATED).mean(1)


def _refined(grey: np.ndarray, corners: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners and covariances; a corner that moves too far, or lacks a visible edge, is not refined."""
    measured = corners_from_edges(grey, corners, cells)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(1, initial=np.inf)
    away = np.linalg.norm(np.where(measured.seen[:, None, None], measured.corners_px - corners, 0), axis=2).max(
        1, initial=0
    )
    good = (measured.seen & (away <= np.maximum(2.0, side / cells)))[:, None, None]
    covariance = np.where(good[..., None], measured.covariance_px2, UNREFINED_PX**2 * np.eye(2))
    return np.where(good, measured.corners_px, corners), covariance
