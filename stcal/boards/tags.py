"""ArUco and AprilTag markers in an image, and the ChArUco boards made of them (through ``cv2.aruco``)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stcal.boards.design import BoardView, CharucoDesign, TagLayout, view_of
from stcal.boards.edges import corners_by_edges, corners_from_edges
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.io.images import grey_8bit

REFINE_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
UNREFINED_PX = 0.5
"""σ of a corner whose edges cannot be measured."""
SATURATED = 254
"""Grey value (8 bit) from which on a pixel may have been brighter."""
EDGE_PX = 0.1
"""σ of the shift that all edges share: a response that is not linear, stray light, ink."""
SATURATED_EDGE_PX = 0.7
"""What saturation adds: an edge blurred by 0.7 px whose bright side is clipped at ½, ¼ of its height seems to lie 0.6,
0.9 px farther towards the dark (the mean of a normal density's tail)."""
SATURATION_POINTS = 8
"""Of each edge."""
WHITE_PX = 3
"""Side of the window whose largest value takes the place of a pixel: a blurred corner at which two black squares meet
is black across, and the squares have one outline."""
GROWN_LOOKS = ((2, 4e7), (3, 1e7), (1, 5e8))
"""How much larger than the image, where that makes at most so many pixels: by a pixel of its own the white grows too
far into tags of 50 px and less."""


@dataclass(frozen=True, slots=True, eq=False)
class Tags:
    """Tags seen in one image.

    ``tags`` : (n,) dictionary and id; ``corners_px`` : (n, 4, 2) top left, top right, bottom right, bottom left as
    printed, with ``covariance_px2`` : (n, 4, 2, 2); ``repeated`` : tags seen more than once, left out for that;
    ``saturated`` : (n,) share of the white around a tag that is at the sensor's limit, see :meth:`edge_sigma_px`.
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
        """σ (n,) of a shift that all edges of a tag share, outwards or inwards, which no residual of theirs shows."""
        return np.hypot(EDGE_PX, SATURATED_EDGE_PX * np.asarray(self.saturated))


def find_tags(image: np.ndarray, dictionaries: Sequence[str], border_bits: int = 1, joined: bool = False) -> Tags:
    """Tags of the dictionaries in a grey image (height, width), corners where their edges meet.

    ``border_bits`` : width of their black border in cells; ``joined`` : black squares touch their corners.
    """
    grey = grey_8bit(image)
    found: dict[tuple[str, int], list[np.ndarray]] = {}
    for name in dict.fromkeys(dictionaries):
        detector = cv2.aruco.ArucoDetector(dictionary_of(name), _parameters(name, border_bits))
        for look in _looks(grey, joined):
            corners, ids, _ = detector.detectMarkers(look.grey)
            places = look.in_image(np.array(corners, np.float32).reshape(-1, 4, 2))
            earlier = {tag: list(there) for tag, there in found.items()}
            for place, tag in zip(places, [] if ids is None else ids.ravel(), strict=True):
                if not any(_inside(place, other) for other in earlier.get((name, int(tag)), [])):
                    found.setdefault((name, int(tag)), []).append(place)
    found = _outermost(found)
    once = {tag: places[0] for tag, places in sorted(found.items()) if len(places) == 1}
    cells = np.array([dictionary_of(name).markerSize + 2 * border_bits for name, _ in once])
    corners, covariance = _refined(grey, np.array(list(once.values()), float).reshape(-1, 4, 2), cells)
    if joined:  # places from larger and grown images are off by more
        corners, covariance = _refined(grey, corners, cells)
    saturated = _saturated(grey, corners, cells)
    # Where some of the white is saturated and some is not, edges shift, and each by something else.
    uneven = SATURATED_EDGE_PX**2 * saturated * (1 - saturated)
    repeated = tuple(sorted(tag for tag, places in found.items() if len(places) > 1))
    return Tags(tuple(once), corners, covariance + uneven[:, None, None, None] * np.eye(2), repeated, saturated)


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """An image ``larger`` times as large, in which what is white reaches ``grown_px`` farther, px of its own."""

    grey: np.ndarray
    larger: int = 1
    grown_px: float = 0.0

    def in_image(self, corners: np.ndarray) -> np.ndarray:
        """Corners of tags (n, 4, 2) in the image as it is, px."""
        if self.grown_px and len(corners):
            corners = (corners + self.grown_px * corners_by_edges(corners)).astype(np.float32)
        return corners if self.larger == 1 else ((corners + 0.5) / self.larger - 0.5).astype(np.float32)


def _looks(grey: np.ndarray, joined: bool) -> Iterator[_Look]:
    """The image; where tags hang together at their corners, first those in which what is white has grown."""
    for larger, most in GROWN_LOOKS if joined else ():
        if grey.size * larger**2 <= most:
            how = cv2.INTER_CUBIC
            large = grey if larger == 1 else cv2.resize(grey, None, fx=larger, fy=larger, interpolation=how)
            grown = cv2.dilate(large, np.ones((WHITE_PX, WHITE_PX), np.uint8))
            yield _Look(grown, larger, (WHITE_PX - 1) / 2)
    yield _Look(grey)


def _inside(place: np.ndarray, other: np.ndarray) -> bool:
    """Whether the middle of a tag (4, 2) lies in another."""
    x, y = place.mean(0).tolist()
    return cv2.pointPolygonTest(other, (x, y), False) > 0


def other_dictionaries(image: np.ndarray, known: Sequence[str]) -> list[tuple[str, int]]:
    """Dictionaries but the ``known`` ones of which the image shows tags, and how many; those with most tags first, and
    of dictionaries that contain one another the smaller first."""
    grey = grey_8bit(image)
    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name not in known)
    # Two names for one dictionary; and one that finds tags everywhere.
    names = [name for name in names if name.upper() == name or name.upper() not in names]
    counts = []
    for name in names:
        dictionary = dictionary_of(name)
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary, _parameters(name)).detectMarkers(grey)
        if ids is not None:
            counts.append((-len(ids), len(dictionary.bytesList), name))
    return [(name, -count) for count, _, name in sorted(counts)]


def view_of_tags(image: str, tags: Tags, layout: TagLayout) -> BoardView | None:
    """The corners of the layout's tags; None where none is seen. Tags that are no part of it are passed over."""
    row = {tag: i for i, tag in enumerate(layout.tags)}
    known = [k for k, tag in enumerate(tags.tags) if tag in row]
    if not known:
        return None
    ids = np.concatenate([4 * row[tags.tags[k]] + np.arange(4) for k in known])
    covariance = tags.covariance_px2[known].reshape(-1, 2, 2)
    view = view_of(image, layout, ids, tags.corners_px[known].reshape(-1, 2), covariance)
    return replace(view, unused=tuple(f"tag {tag[1]} is in view more than once" for tag in tags.repeated if tag in row))


def find_charuco(image: np.ndarray, name: str, board: CharucoDesign, camera: Camera | None = None) -> BoardView | None:
    """Inner corners of a ChArUco board; None where fewer than four are seen.

    One seen neighbour tag is enough for a corner, and tags that the first pass missed are looked for where the board
    has them: OpenCV's own settings lose a quarter of the corners of real sets.
    """
    grey = grey_8bit(image)
    plain = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_mm,
        board.marker_mm,
        dictionary_of(board.dictionary),
        np.array(board.tag_ids(), np.int32),
    )
    plain.setLegacyPattern(board.legacy)
    how = cv2.aruco.CharucoParameters()
    how.minMarkers, how.tryRefineMarkers = 1, True
    if camera is not None and not camera.fisheye:  # OpenCV projects its corners by a perspective lens
        how.cameraMatrix = np.array(
            [[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]]
        )
        how.distCoeffs = np.array(camera.distortion)
    detector = cv2.aruco.CharucoDetector(plain, how, _parameters(board.dictionary))
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None or len(ids) < 4:
        return None
    return view_of(name, board, ids.ravel().astype(int), _refined_inner(grey, corners.reshape(-1, 2), board))


def _refined_inner(grey: np.ndarray, corners: np.ndarray, board: CharucoDesign) -> np.ndarray:
    """Inner corners (n, 2) once more, in windows whose diagonal just stays in the white about each: the detector's own
    go by the tags that it read, and reach into them or stay small."""
    apart = np.linalg.norm(corners[:, None] - corners, axis=2)
    np.fill_diagonal(apart, np.inf)
    clear = (1 - board.marker_mm / board.square_mm) / 2 / np.sqrt(2)
    half = np.rint(clear * apart.min(1)).astype(int).clip(2, 30)
    start = corners.astype(np.float32).reshape(-1, 1, 1, 2)
    found = [
        cv2.cornerSubPix(grey, xy.copy(), (h, h), (-1, -1), REFINE_STEPS)
        for xy, h in zip(start, half.tolist(), strict=True)
    ]
    return np.array(found).reshape(-1, 2).astype(float)


def dictionary_of(name: str):
    """Of ``cv2.aruco``, by its name there."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _parameters(name: str, border_bits: int = 1):
    """Settings of the detector. Its own lose small tags, of whose cells only the middle has its own colour, the rest is
    blurred by their neighbours, and four pixels are too few to find it: of 272 real tags of 19 to 60 px a side they
    read 86 %, these 97 %. Two sizes of threshold window find what three do."""
    how = cv2.aruco.DetectorParameters()
    how.markerBorderBits = border_bits
    how.perspectiveRemovePixelPerCell = 10
    how.perspectiveRemoveIgnoredMarginPerCell = 0.35
    how.adaptiveThreshWinSizeMin, how.adaptiveThreshWinSizeMax, how.adaptiveThreshWinSizeStep = 5, 25, 20
    if "APRILTAG" in name.upper():
        how.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return how


def _outermost(found: dict[tuple[str, int], list[np.ndarray]]) -> dict[tuple[str, int], list[np.ndarray]]:
    """Without what is read inside of a larger tag, its cells as a tag of another dictionary, or its border twice."""
    flat = [(tag, place, cv2.contourArea(place)) for tag, places in found.items() for place in places]
    kept: dict[tuple[str, int], list[np.ndarray]] = {}
    for tag, place, area in flat:
        if not any(larger > area and _inside(place, other) for _, other, larger in flat):
            kept.setdefault(tag, []).append(place)
    return kept


def _saturated(grey: np.ndarray, corners: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Share (n,) of the white, half a cell outside of the edges of tags (n, 4, 2) with so many cells a side."""
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
    """Corners where the edges meet, or as they were where that leads away or an edge is not seen; covariances."""
    found = corners_from_edges(grey, corners, cells)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(1, initial=np.inf)
    away = np.linalg.norm(np.where(found.seen[:, None, None], found.corners_px - corners, 0), axis=2).max(1, initial=0)
    good = (found.seen & (away <= np.maximum(2.0, side / cells)))[:, None, None]
    covariance = np.where(good[..., None], found.covariance_px2, UNREFINED_PX**2 * np.eye(2))
    return np.where(good, found.corners_px, corners), covariance
