"""What an image was read as, with the pose of each plane that it may be: what a group's arrangement is made from."""

from dataclasses import dataclass

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.plane import camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD, DotLabel, Label
from stcal.sfm.detect.sightings import FaceSighting, ImageDetection

MIN_POSE_CIRCLES = 5
"""Four fix a pose, one more lets it be doubted."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaneView:
    """One way to read n circles of an image as those of one plane.

    ``plane`` : face id or ``board``; ``rows`` : (n,) among the image's centres; ``xy_mm`` : (n, 2) in the plane;
    ``xy`` : (n, 2) seen, normalised; ``area`` : that they take up, in units of their ellipses'; ``camera_from_plane`` :
    from these alone; ``named`` : whether the image by itself tells which plane it is.
    """

    plane: str
    labels: tuple[Label, ...]
    rows: np.ndarray
    xy_mm: np.ndarray
    xy: np.ndarray
    area: float
    camera_from_plane: Rigid
    named: bool = True

    def xyz_mm(self) -> np.ndarray:
        """The circles, (n, 3), plane's frame."""
        return np.column_stack([self.xy_mm, np.zeros(len(self.xy_mm))])

    def span_mm(self) -> np.ndarray:
        """Three points of the plane about its circles, (3, 3), plane's frame."""
        low, high = self.xy_mm.min(0), self.xy_mm.max(0)
        return np.array([[*low, 0.0], [high[0], low[1], 0.0], [low[0], high[1], 0.0]])


Readings = list[PlaneView]
"""The ways to read the same circles; one holds."""


def readings_of(detection: ImageDetection, target: TargetDesign, board: BoardDesign | None) -> list[Readings]:
    """What one image was read as, with a pose for each way to read it; without those too few to have one."""
    found = []
    for each in detection.faces:
        found.append([_face_view(each, target, detection, named=True)])
    for faces in detection.open_faces:
        own = [_face_view(each, target, detection, named=False) for each in faces]
        found.append([view for view in own if view is not None])
    if board is not None:
        for each in detection.boards:
            places = board.pitch_mm * each.numberings[:, :, ::-1].astype(float)
            labels = [tuple(DotLabel(*cell) for cell in cells.tolist()) for cells in each.numberings]
            rows = each.rows
            found.append([_view(BOARD, own, rows, xy, detection) for own, xy in zip(labels, places, strict=True)])
    return [[v for v in views if v is not None] for views in found if views and all(v is not None for v in views)]


def _face_view(each: FaceSighting, target: TargetDesign, detection: ImageDetection, named: bool) -> PlaneView | None:
    face = target.face(each.face)
    return _view(face.id, each.labels(face), each.rows, face.xy_mm[each.circles], detection, named)


def _view(
    plane: str, labels, rows: np.ndarray, xy_mm: np.ndarray, detection: ImageDetection, named: bool = True
) -> PlaneView | None:
    xy = detection.centres.centre[rows]
    if len(rows) < MIN_POSE_CIRCLES:
        return None
    try:
        pose = refine_planar_pose(camera_from_plane(fit_homography(xy_mm, xy)), xy_mm, xy)
    except (ConvergenceError, DegenerateError):
        return None
    area = float(np.abs(np.linalg.det(detection.centres.shape[rows])).sum())
    return PlaneView(plane, labels, rows, xy_mm, xy, area, pose, named)
