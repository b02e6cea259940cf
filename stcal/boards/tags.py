"""Detection of tags, through ``cv2.aruco``."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stcal.boards.board_designs import AprilGridDesign, BoardView, TagLayout, mean_sides, view_of
from stcal.boards.dictionaries import cells_of, dictionary_of
from stcal.boards.edges import corners_by_edges, corners_from_edges
from stcal.geometry.arrays import freeze, frozen
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography
from stcal.io.images import grey_8bit

UNREFINED_PX = 0.5  # σ of a corner whose edges cannot be measured
SATURATED = 254  # smallest grey value (8 bit) of a pixel that may be saturated
EDGE_PX = 0.1
"""σ of the shift that all edges of a tag share, by a nonlinear response, stray light or ink."""
SATURATED_EDGE_PX = 0.7
"""σ that saturation adds to this shift: an edge blurred by 0.7 px and clipped at half its height moves by 0.6 px."""
SATURATION_POINTS = 8  # number of points along each edge at which saturation is tested
WHITE_PX = 3
"""Side of the window of the dilation, px, which separates black squares that meet at a blurred corner."""
TOGETHER_PX, APART_PX = (5, 25), ((5,), (21,))
"""Sides of the windows of the threshold, px, of one search, and of two."""
GROWN_LOOKS = ((2, 4e7), (3, 1e7), (1, 5e8))
"""Scales of the dilated images, each with the largest number of pixels up to which it is used."""


@dataclass(frozen=True, slots=True, eq=False)
class Tags:
    """The n tags seen in one image."""

    tags: tuple[tuple[str, int], ...]  # dictionary and id
    corners_px: np.ndarray  # (n, 4, 2) top left, top right, bottom right, bottom left as printed
    joint_px2: np.ndarray  # (n, 8, 8) covariances of the four corners of a tag together
    repeated: tuple[tuple[str, int], ...] = ()  # tags that were omitted because they occur more than once
    saturated: np.ndarray | None = None  # (n,) share of the white around a tag, see :meth:`edge_sigma_px`
    smear_px: float = 0.0  # way by which motion during the exposure blurs edges; 0 where it is short

    def __post_init__(self):
        freeze(self, "corners_px", (len(self.tags), 4, 2), "tags' corners")
        freeze(self, "joint_px2", (len(self.tags), 8, 8), "tags' covariances")
        share = np.zeros(len(self.tags)) if self.saturated is None else self.saturated
        object.__setattr__(self, "saturated", frozen(share, (len(self.tags),), "saturated shares"))

    def __len__(self) -> int:
        return len(self.tags)

    def corner_covariances_px2(self) -> np.ndarray:
        """Return the covariances (n, 4, 2, 2) of single corners."""
        corner = np.arange(4)
        return np.moveaxis(self.joint_px2.reshape(-1, 4, 2, 4, 2)[:, corner, :, corner], 0, 1)

    def edge_sigma_px(self) -> np.ndarray:
        """Return σ (n,) of an outward or inward shift that all edges of a tag share, and residuals do not show."""
        return np.hypot(EDGE_PX, SATURATED_EDGE_PX * np.asarray(self.saturated))


def find_tags(
    image: np.ndarray,
    dictionaries: Sequence[str],
    border_bits: int = 1,
    joined: bool = False,
    windows_px: Sequence[tuple[int, ...]] = (TOGETHER_PX,),
) -> Tags:
    """Return the tags of the dictionaries in a grey image (height, width), with corners from their edges.
    ``border_bits`` : width of the black border in cells; ``joined`` : True if black squares touch the tags' corners;
    ``windows_px`` : sides of the threshold windows of each search."""
    grey = grey_8bit(image)
    places_of: dict[tuple[str, int], list[np.ndarray]] = {}
    for name in dict.fromkeys(dictionaries):
        settings = [detector_settings(name, border_bits, windows) for windows in windows_px]
        detectors = [cv2.aruco.ArucoDetector(dictionary_of(name), each) for each in settings]
        for large, larger, grown_px in _looks(grey, joined):
            for detector in detectors:
                corners, ids, _ = detector.detectMarkers(large)
                places = np.array(corners, np.float32).reshape(-1, 4, 2)
                if grown_px and len(places):
                    places = (places + grown_px * corners_by_edges(places)).astype(np.float32)
                if larger != 1:
                    places = ((places + 0.5) / larger - 0.5).astype(np.float32)
                seen = zip([] if ids is None else [(name, int(tag)) for tag in ids.ravel()], places, strict=True)
                new = [(t, p) for t, p in seen if not any(_inside(p, other) for other in places_of.get(t, ()))]
                for tag, place in new:
                    places_of.setdefault(tag, []).append(place)
    # Tags are also read inside of larger ones, from their cells or a second time from their border.
    every = [(place, cv2.contourArea(place)) for places in places_of.values() for place in places]
    for tag, places in places_of.items():
        sized = [(place, cv2.contourArea(place)) for place in places]
        places_of[tag] = [p for p, area in sized if not any(area < large and _inside(p, o) for o, large in every)]
    once = {tag: places[0] for tag, places in sorted(places_of.items()) if len(places) == 1}
    cells = np.array([cells_of(name, border_bits) for name, _ in once])
    corners = np.array(list(once.values()), float).reshape(-1, 4, 2)
    for _ in range(1 + joined):  # places from larger and dilated images are less accurate
        corners, covariance, smear_px = _refined(grey, corners, cells)
    saturated = _saturated(grey, corners, cells)
    # If the white is partly saturated, each edge shifts by a different amount.
    uneven = SATURATED_EDGE_PX**2 * saturated * (1 - saturated)
    joint = covariance + uneven[:, None, None] * np.eye(8)
    repeated = tuple(sorted(tag for tag, places in places_of.items() if len(places) > 1))
    return Tags(tuple(once), corners, joint, repeated, saturated, smear_px)


def _looks(grey: np.ndarray, joined: bool) -> Iterator[tuple[np.ndarray, int, float]]:
    """Yield the image; first, of ``joined`` tags, enlarged ones with dilated white: image, factor, and dilation, px."""
    for larger, most in GROWN_LOOKS if joined else ():
        if grey.size * larger**2 <= most:
            interpolation = cv2.INTER_CUBIC
            large = grey if larger == 1 else cv2.resize(grey, None, fx=larger, fy=larger, interpolation=interpolation)
            yield cv2.dilate(large, np.ones((WHITE_PX, WHITE_PX), np.uint8)), larger, (WHITE_PX - 1) / 2
    yield grey, 1, 0.0


def _inside(place: np.ndarray, other: np.ndarray) -> bool:
    x, y = place.mean(0).tolist()
    return cv2.pointPolygonTest(other, (x, y), False) > 0


def seen_otherwise(image: np.ndarray, own: Collection[tuple[str, int]], place: str) -> str:
    """Return in words what an image shows where no tag is read as it should be, with the remedy; empty if nothing. Tags
    of ``own`` may be in view twice, mirrored, or white on black, or of another dictionary than ``place`` says."""
    grey, known = grey_8bit(image), sorted({name for name, _ in own})
    if twice := [tag for tag in find_tags(grey, known).repeated if tag in own]:
        return f"tag {twice[0][1]} more than once; cover what is not the target, and mirrors"
    ways = {
        "mirrored; use the files that the camera wrote, or print them anew": grey[:, ::-1].copy(),
        "white on black; print them black on white": 255 - grey,
    }
    counts = {way: len(set(find_tags(each, known).tags) & set(own)) for way, each in ways.items()}
    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    # Some dictionaries have two names; and one of the second names finds tags everywhere.
    names = [name for name in names if name.upper() == name or name.upper() not in names]
    others = []
    for name in (name for name in names if name.upper() not in map(str.upper, known)):
        dictionary = dictionary_of(name)
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary, detector_settings(name)).detectMarkers(grey)
        if ids is not None:  # of dictionaries that contain one another, the smaller one is named
            others.append((-len(ids), len(dictionary.bytesList), name))
    most, _, name = min(others, default=(0, 0, ""))
    best = max(counts, key=counts.__getitem__)
    if counts[best] >= max(1, -most):
        return f"{counts[best]} of its tags {best}"
    return f"{-most} of {name}; correct dictionary in {place}" if most else ""


def view_of_tags(image: str, tags: Tags, layout: TagLayout) -> BoardView | None:
    """Return the corners of the layout's tags, None if no tag is seen; tags that are not in the layout are ignored."""
    row = {tag: i for i, tag in enumerate(layout.tags)}
    known = [k for k, tag in enumerate(tags.tags) if tag in row]
    if not known:
        return None
    ids = np.concatenate([4 * row[tags.tags[k]] + np.arange(4) for k in known])
    covariance = tags.corner_covariances_px2()[known].reshape(-1, 2, 2)
    view = view_of(image, layout, ids, tags.corners_px[known].reshape(-1, 2), covariance)
    return replace(view, unused=tuple(f"tag {tag[1]} is in view more than once" for tag in tags.repeated if tag in row))


def detector_settings(name: str, border_bits: int = 1, windows_px: tuple[int, ...] = TOGETHER_PX):
    """Return the settings of the detector; ``windows_px`` : smallest and largest side of its threshold windows. The
    default settings lose small tags, in which only the middle of a cell keeps its colour: of 272 real tags of 19 to 60
    px a side they read 86 %, these 97 %. Two sizes of the window find more if each has a search of its own."""
    settings = cv2.aruco.DetectorParameters()
    settings.markerBorderBits = border_bits
    settings.perspectiveRemovePixelPerCell = 10
    settings.perspectiveRemoveIgnoredMarginPerCell = 0.35
    first, last = windows_px[0], windows_px[-1]
    settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = first, last
    settings.adaptiveThreshWinSizeStep = max(last - first, 1)
    if "APRILTAG" in name.upper():
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return settings


def _saturated(grey: np.ndarray, corners: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the saturated share (n,) of the white half a cell outside of tags."""
    middle = corners.mean(1, keepdims=True)
    outer = middle + (corners - middle) * (1 + 1 / cells)[:, None, None]
    along = np.linspace(0, 1, SATURATION_POINTS, endpoint=False)[:, None]
    points = outer[:, :, None] + along * (np.roll(outer, -1, axis=1) - outer)[:, :, None]
    x, y = np.rint(points).astype(int).reshape(-1, 2).T
    level = grey[y.clip(0, grey.shape[0] - 1), x.clip(0, grey.shape[1] - 1)]
    return (level.reshape(len(corners), 4 * SATURATION_POINTS) >= SATURATED).mean(1)


def _refined(grey: np.ndarray, corners: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return corners and covariances, refined where all edges are seen, and motion."""
    measured, joint, seen, smear_px = corners_from_edges(grey, corners, cells)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(1, initial=np.inf)
    away = np.linalg.norm(np.where(seen[:, None, None], measured - corners, 0), axis=2).max(1, initial=0)
    good = (seen & (away <= np.maximum(2.0, side / cells)))[:, None, None]
    return np.where(good, measured, corners), np.where(good, joint, UNREFINED_PX**2 * np.eye(8)), smear_px


KALIBR_BITS, USUAL_BITS = 2, 1  # widths of the black border of Kalibr's tags and of usual ones, cells
TELLING_SHARE = 0.5
"""Smallest share of the tags read with a border of one cell that a border of two cells must read."""
ENOUGH_SHARE = 0.5
"""Share of all tags of the board from which on a border of two cells is accepted without trying one cell."""
MAX_OFF_SHARE = 0.15
"""Largest deviation of a tag from its place in the board's plane, as a share of its side."""
MOST_STRAY_SHARE = 1 / 3
"""Largest share of the tags in view that may be rejected for lying off the plane."""


class Unseen(str):
    """The reason why a board is not found that is no fault of an image: no part of the board is in it."""

    __slots__ = ()


def find_aprilgrid(
    image: np.ndarray, name: str, board: AprilGridDesign, camera: Camera
) -> tuple[BoardView | None, str]:
    """Return the view with all four corners of each tag seen, or None and the reason. A part of the board is enough."""
    layout, ids = board.layout(), board.tag_ids()
    tags, bits = _tags(image, board)
    view = view_of_tags(name, tags, layout)
    if view is None and tags.tags:
        others = f"tag {tags.tags[0][1]} of {board.dictionary}, none of {ids[0]} … {ids[-1]} of the AprilGrid"
        return None, Unseen(others)
    if view is None and tags.repeated:
        return None, f"tag {tags.repeated[0][1]} of the AprilGrid is in view more than once, and no other"
    if view is None:
        return None, Unseen(f"no tag of the AprilGrid: {board.dictionary}, border of {bits} cells")
    fitting, unused = view, list(view.unused)
    unused += [f"tag {tag} is none of its {len(ids)}" for _, tag in tags.tags if tag not in ids]
    least = (1 - MOST_STRAY_SHARE) * len(view)
    while (off := _off(fitting, camera)).max() > MAX_OFF_SHARE and len(fitting) - 4 >= least:
        worst = fitting.ids[4 * int(off.argmax())] // 4
        unused.append(f"tag {layout.tags[worst][1]} lies off the board's plane")
        fitting = fitting.rows(fitting.ids // 4 != worst)
    if off.max() > MAX_OFF_SHARE:
        return None, _why_off(view, board, camera)
    return replace(fitting, unused=tuple(unused)), ""


def _tags(image: np.ndarray, board: AprilGridDesign) -> tuple[Tags, str]:
    """Return the tags, read with the board's border width or the more likely one, and the widths tried, in words."""

    def read(bits: int) -> tuple[Tags, int]:
        tags = find_tags(image, (board.dictionary,), bits, joined=True)
        return tags, sum(tag in board.tag_ids() for _, tag in tags.tags)

    if board.border_bits is not None:
        return read(board.border_bits)[0], f"{board.border_bits}"
    of_two_bits, two = read(KALIBR_BITS)
    if two >= ENOUGH_SHARE * len(board.tag_ids()):
        return of_two_bits, f"{KALIBR_BITS}"
    of_one_bit, one = read(USUAL_BITS)
    return (of_two_bits if 0 < two >= TELLING_SHARE * one else of_one_bit), f"{USUAL_BITS} or {KALIBR_BITS}"


def _off(view: BoardView, camera: Camera) -> np.ndarray:
    """Return the RMS deviation of each tag's corners from their places in the plane, in sides of the tag as seen."""
    observed = camera.normalised_from_pixel(view.xy_px)
    predicted = apply_homography(fit_homography(view.xyz_board[:, :2], observed), view.xyz_board[:, :2])
    return np.sqrt(((predicted - observed) ** 2).sum(1).reshape(-1, 4).mean(1)) / mean_sides(observed.reshape(-1, 4, 2))


def _why_off(view: BoardView, board: AprilGridDesign, camera: Camera) -> str:
    turned = replace(board, upright=not board.upright)
    if _off(replace(view, xyz_board=np.pad(turned.xy_mm()[view.ids], ((0, 0), (0, 1)))), camera).max() <= MAX_OFF_SHARE:
        value = "true" if turned.upright else "false"
        return f"the tags of the AprilGrid are turned by half a turn; write upright = {value} into its file"
    elsewhere = f"{len(view) // 4} tags of the AprilGrid, but not where rows, columns and spacing put them"
    return f"{elsewhere}; ids count from the bottom left, row by row upwards"
