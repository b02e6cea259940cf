"""ArUco and AprilTag markers in an image, and the ChArUco boards made of them (through ``cv2.aruco``)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stcal.boards.design import BoardView, CharucoDesign, TagLayout, view_of
from stcal.boards.edges import EdgeCorners, corners_from_edges
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.images import grey_8bit

UNREFINED_PX = 0.5
"""σ of a corner whose edges cannot be measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Tags:
    """Tags seen in one image.

    ``tags`` : (n,) dictionary and id; ``corners_px`` : (n, 4, 2) top left, top right, bottom right, bottom left as
    printed, with ``covariance_px2`` : (n, 4, 2, 2); ``repeated`` : tags seen more than once, left out for that.
    """

    tags: tuple[tuple[str, int], ...]
    corners_px: np.ndarray
    covariance_px2: np.ndarray
    repeated: tuple[tuple[str, int], ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "corners_px", frozen(self.corners_px, (len(self.tags), 4, 2), "tags' corners"))
        shape = (len(self.tags), 4, 2, 2)
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, shape, "corners' covariances"))

    def __len__(self) -> int:
        return len(self.tags)


def find_tags(image: np.ndarray, dictionaries: Sequence[str]) -> Tags:
    """Tags of the dictionaries in a grey image (height, width), corners where their edges meet."""
    grey = grey_8bit(image)
    found: dict[tuple[str, int], list[np.ndarray]] = {}
    for name in dict.fromkeys(dictionaries):
        detector = cv2.aruco.ArucoDetector(_dictionary(name), _parameters(name))
        corners, ids, _ = detector.detectMarkers(grey)
        for place, tag in zip(corners, [] if ids is None else ids.ravel(), strict=True):
            found.setdefault((name, int(tag)), []).append(place.reshape(4, 2))
    once = {tag: places[0] for tag, places in sorted(found.items()) if len(places) == 1}
    refined = [_refined(grey, name, place) for (name, _), place in once.items()]
    return Tags(
        tuple(once),
        np.array([r.corners_px for r in refined]).reshape(-1, 4, 2),
        np.array([r.covariance_px2 for r in refined]).reshape(-1, 4, 2, 2),
        tuple(sorted(tag for tag, places in found.items() if len(places) > 1)),
    )


def view_of_tags(image: str, tags: Tags, layout: TagLayout) -> BoardView | None:
    """The corners of the layout's tags; None where none is seen."""
    row = {tag: i for i, tag in enumerate(layout.tags)}
    known = [k for k, tag in enumerate(tags.tags) if tag in row]
    if not known:
        return None
    ids = np.concatenate([4 * row[tags.tags[k]] + np.arange(4) for k in known])
    covariance = tags.covariance_px2[known].reshape(-1, 2, 2)
    return view_of(image, layout, ids, tags.corners_px[known].reshape(-1, 2), covariance)


def find_charuco(image: np.ndarray, name: str, board: CharucoDesign, camera: Camera | None = None) -> BoardView | None:
    """Inner corners of a ChArUco board; None where fewer than four are seen.

    One seen neighbour tag is enough for a corner, and tags that the first pass missed are looked for where the board
    has them: OpenCV's own settings lose a quarter of the corners of real sets.
    """
    grey = grey_8bit(image)
    plain = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, board.marker_mm, _dictionary(board.dictionary)
    )
    plain.setLegacyPattern(board.legacy)
    how = cv2.aruco.CharucoParameters()
    how.minMarkers, how.tryRefineMarkers = 1, True
    if camera is not None:
        how.cameraMatrix = np.array(
            [[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]]
        )
        how.distCoeffs = np.array(camera.distortion)
    detector = cv2.aruco.CharucoDetector(plain, how, _parameters(board.dictionary))
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None or len(ids) < 4:
        return None
    return view_of(name, board, ids.ravel().astype(int), corners.reshape(-1, 2).astype(float))


def _dictionary(name: str):
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _parameters(name: str):
    how = cv2.aruco.DetectorParameters()
    if "APRILTAG" in name.upper():
        how.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return how


def _refined(grey: np.ndarray, name: str, corners: np.ndarray) -> EdgeCorners:
    """Corners where the edges meet, or as they were where that leads away or an edge is not seen."""
    cells = _dictionary(name).markerSize + 2
    found = corners_from_edges(grey, corners.astype(float), cells)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min()
    if found is None or np.linalg.norm(found.corners_px - corners, axis=1).max() > max(2.0, side / cells):
        return EdgeCorners(corners.astype(float), np.tile(UNREFINED_PX**2 * np.eye(2), (4, 1, 1)))
    return found
