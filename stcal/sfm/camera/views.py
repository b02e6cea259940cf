"""Board views for a camera that is not known yet: which dot is which, a focal length and poses to start from."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stcal.design import BoardDesign
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import FISHEYE
from stcal.labels import DotLabel
from stcal.sfm.data.observations import ImageObservations, by_group
from stcal.sfm.detect.files import DetectedImage

START_FOCAL, FISHEYE_FOCAL = 1.2, 0.45
"""In longer image sides: between a wide-angle and a portrait lens; and of equidistant lenses 127° across."""
FOCAL_LIMITS = (0.2, 50.0)
"""In longer image sides; what the closed form gives outside of them is noise."""
SETTLING_PASSES = 3


def start_camera(width: int, height: int, colmap_model: str) -> Camera:
    """A lens of middling focal length without distortion, principal point in the middle."""
    fisheye = FISHEYE in colmap_model
    focal = (FISHEYE_FOCAL if fisheye else START_FOCAL) * max(width, height)
    return Camera(width, height, [focal, focal], [(width - 1) / 2, (height - 1) / 2], np.zeros(8), fisheye)


def closed_form(observations: Sequence[ImageObservations], board: BoardDesign, camera: Camera) -> Camera:
    """``camera`` with the focal length that the boards' homographies ask for; unchanged where they ask for none, and of
    equidistant lenses, whose rays turn with the focal length.

    Zhang (2000), sec. 3.1, with square pixels and known principal point: the two axes of each board are orthogonal
    and equally long, which is linear in 1/f². Lens distortion of ``camera`` is removed first.
    """
    if camera.fisheye:
        return camera
    along, known = [], []
    for image in observations:
        h = _homography(image, board, camera)
        first, second = h[:, 0], h[:, 1]
        first, second = np.array([first, second]) / np.sqrt(np.linalg.norm(first[:2]) * np.linalg.norm(second[:2]))
        along += [first[:2] @ second[:2], first[:2] @ first[:2] - second[:2] @ second[:2]]
        known += [-first[2] * second[2], second[2] ** 2 - first[2] ** 2]
    square = float(np.dot(along, along))
    inverse = float(np.dot(along, known)) / square if square else 0.0  # (assumed focal / focal)²
    low, high = FOCAL_LIMITS * np.array(max(camera.width, camera.height)) / camera.focal[0]
    if not high**-2 < inverse < low**-2:
        return camera
    return replace(camera, focal=camera.focal / np.sqrt(inverse))


def start_pose(image: ImageObservations, board: BoardDesign, camera: Camera) -> Rigid:
    """camera_from_board of one view.

    Raises
    ------
    DegenerateError
        The dots do not determine it.
    """
    pose = camera_from_plane(_homography(image, board, camera))
    return refine_planar_pose(pose, board.places_mm(image.labels)[:, :2], camera.normalised_from_pixel(image.centre_px))


def _homography(image: ImageObservations, board: BoardDesign, camera: Camera) -> np.ndarray:
    return fit_homography(board.places_mm(image.labels)[:, :2], camera.normalised_from_pixel(image.centre_px))


def board_views(images: Sequence[DetectedImage], board: BoardDesign, camera: Camera) -> list[ImageObservations]:
    """The dots of every image that shows the board, numbered alike in all images of a folder.

    A plain board looks the same after half a turn, and where a strip is hidden the rows may be off by one. A wrong
    numbering costs nothing but the match between the dots and their own deviations from the grid; so these, seen
    best with a good ``camera``, decide.
    """
    views = []
    for image in images:
        seen = image.detection.board
        if seen is not None and len(seen.rows):
            dots = image.detection.centres.select(seen.rows)
            labels = tuple(DotLabel(0, i) for i in range(len(dots)))
            views.append(
                ImageObservations(
                    name=image.file.name,
                    group=image.file.group,
                    labels=labels,
                    centre_px=dots.centre_px,
                    centre=dots.centre,
                    shape=dots.shape,
                    covariance_px2=dots.covariance_px2,
                )
            )
    numberings = {i.file.name: i.detection.board.numberings for i in images if i.detection.board is not None}
    settled = {}
    for members in by_group(views).values():
        fields = [_deviations(numberings[v.name], camera.normalised_from_pixel(v.centre_px), board) for v in members]
        settled |= {
            v.name: numberings[v.name][choice] for v, choice in zip(members, _choose_alike(fields), strict=True)
        }
    return [replace(v, labels=tuple(DotLabel(row, column) for row, column in settled[v.name].tolist())) for v in views]


def _deviations(numberings: np.ndarray, xy_normalised: np.ndarray, board: BoardDesign) -> np.ndarray:
    """Dots as seen minus as designed, in the board's plane, (k, rows·columns, 2) mm for k numberings; 0 unseen."""
    fields = np.zeros((len(numberings), board.rows * board.columns, 2))
    for field, cells in zip(fields, numberings, strict=True):
        xy_mm = board.pitch_mm * cells[:, ::-1].astype(float)
        plane_from_image = fit_homography(xy_normalised, xy_mm)
        field[cells @ [board.columns, 1]] = apply_homography(plane_from_image, xy_normalised) - xy_mm
    return fields


def _choose_alike(fields: Sequence[np.ndarray]) -> list[int]:
    """For each image the field of deviations that agrees best with those of the others."""
    chosen = [0] * len(fields)
    order = sorted(range(len(fields)), key=lambda i: -np.count_nonzero(fields[i][0]))
    total = np.zeros_like(fields[0][0])
    for turn in range(SETTLING_PASSES):
        for i in order:
            if turn:
                total -= fields[i][chosen[i]]
            chosen[i] = int(np.argmax([(field * total).sum() for field in fields[i]]))
            total += fields[i][chosen[i]]
    return chosen
