"""Board views of an unknown camera: numbering of the dots, and approximate focal length and poses."""

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
"""Approximate focal lengths over the longer image side: between wide-angle and portrait; equidistant lens of 127°."""
FOCAL_LIMITS = (0.2, 50.0)
"""Limits of the focal length over the longer image side. Results of the closed form outside of them are noise."""
SETTLING_PASSES = 3


def start_camera(width: int, height: int, colmap_model: str) -> Camera:
    """Returns a camera of medium focal length without distortion, with the principal point in the middle."""
    fisheye = FISHEYE in colmap_model
    focal = (FISHEYE_FOCAL if fisheye else START_FOCAL) * max(width, height)
    return Camera(width, height, [focal, focal], [(width - 1) / 2, (height - 1) / 2], np.zeros(8), fisheye)


def closed_form(observations: Sequence[ImageObservations], board: BoardDesign, camera: Camera) -> Camera:
    """Returns ``camera`` with the focal length estimated from the homographies of the boards.

    The camera is unchanged if the homographies give no plausible focal length, and for equidistant lenses, as their
    rays depend on the focal length.

    Zhang (2000), sec. 3.1, with square pixels and known principal point: the two axes of each board are orthogonal
    and equally long, which is linear in 1/f². Lens distortion of ``camera`` is removed first.
    """
    if camera.fisheye:
        return camera
    coefficients, constants = [], []
    for image in observations:
        h = _homography(image, board, camera)
        first, second = h[:, 0], h[:, 1]
        first, second = np.array([first, second]) / np.sqrt(np.linalg.norm(first[:2]) * np.linalg.norm(second[:2]))
        coefficients += [first[:2] @ second[:2], first[:2] @ first[:2] - second[:2] @ second[:2]]
        constants += [-first[2] * second[2], second[2] ** 2 - first[2] ** 2]
    square = float(np.dot(coefficients, coefficients))
    inverse = float(np.dot(coefficients, constants)) / square if square else 0.0  # (assumed focal / focal)²
    low, high = FOCAL_LIMITS * np.array(max(camera.width, camera.height)) / camera.focal[0]
    if not high**-2 < inverse < low**-2:
        return camera
    return replace(camera, focal=camera.focal / np.sqrt(inverse))


def start_pose(image: ImageObservations, board: BoardDesign, camera: Camera) -> Rigid:
    """Returns camera_from_board of one view.

    Raises
    ------
    DegenerateError
        The dots do not determine the pose.
    """
    pose = camera_from_plane(_homography(image, board, camera))
    return refine_planar_pose(pose, board.places_mm(image.labels)[:, :2], camera.normalised_from_pixel(image.centre_px))


def _homography(image: ImageObservations, board: BoardDesign, camera: Camera) -> np.ndarray:
    return fit_homography(board.places_mm(image.labels)[:, :2], camera.normalised_from_pixel(image.centre_px))


def board_views(images: Sequence[DetectedImage], board: BoardDesign, camera: Camera) -> list[ImageObservations]:
    """Returns the dots of every image that shows the board, numbered consistently in all images of a folder.

    A plain board looks the same after half a turn, and if a strip is hidden, rows may be numbered off by one. A wrong
    numbering only breaks the match between the dots and their individual deviations from the grid. The numbering is
    therefore selected by these deviations, which a good ``camera`` shows best.
    """
    views = []
    for image in images:
        sighting = image.detection.board
        if sighting is not None and len(sighting.rows):
            dots = image.detection.centres.select(sighting.rows)
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
    """Returns measured minus designed dots in the board's plane, (k, rows·columns, 2) mm for k numberings, else 0."""
    fields = np.zeros((len(numberings), board.rows * board.columns, 2))
    for field, cells in zip(fields, numberings, strict=True):
        xy_mm = board.pitch_mm * cells[:, ::-1].astype(float)
        plane_from_image = fit_homography(xy_normalised, xy_mm)
        field[cells @ [board.columns, 1]] = apply_homography(plane_from_image, xy_normalised) - xy_mm
    return fields


def _choose_alike(fields: Sequence[np.ndarray]) -> list[int]:
    """Selects for each image the field of deviations that agrees best with those of the other images."""
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
