"""Observations of one simulated image: the circles in view, and measured centres without rendering pixels."""

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.labels import Label
from stcal.synthetic.scene import Scene

MAX_FOUND_TILT_RAD = np.radians(70)
"""Largest tilt at which a circle must be found, in rad."""
MAX_SHOWN_TILT_RAD = np.radians(89)
RIM_POINTS = 72
NEAR_BORDER = 3.0
"""Distance of a circle's centre from the image border at which no rim reaches it, in radii of its frontal image."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageCircles:
    """True values of the circles that one image shows; camera frame, mm.

    ``labels`` : n labels; ``xyz_camera``, ``normal_camera`` : (n, 3), normals towards the camera; ``radius_mm`` :
    (n,); ``tilt_rad`` : (n,) angle between normal and line of sight; ``centre_px`` : (n, 2) image of the circle's
    centre; ``must_find`` : (n,) bool, True for circles of the group's faces or the board with a tilt up to 70° that lie
    completely in the image.
    """

    labels: tuple[Label, ...]
    xyz_camera: np.ndarray
    normal_camera: np.ndarray
    radius_mm: np.ndarray
    tilt_rad: np.ndarray
    centre_px: np.ndarray
    must_find: np.ndarray

    def __post_init__(self):
        n = len(self.labels)
        for name, shape in {
            "xyz_camera": (n, 3),
            "normal_camera": (n, 3),
            "radius_mm": (n,),
            "tilt_rad": (n,),
            "centre_px": (n, 2),
        }.items():
            freeze(self, name, shape, name)
        freeze(self, "must_find", (n,), "must_find", bool)

    def select(self, rows: np.ndarray) -> "ImageCircles":
        """Returns the circles of a mask (n,)."""
        labels = tuple(label for label, own in zip(self.labels, rows, strict=True) if own)
        return ImageCircles(labels, *(getattr(self, name)[rows] for name in _ARRAYS))

    def smaller(self, share: float) -> "ImageCircles":
        """Returns circles of this share of the radius at the same places."""
        return replace(self, radius_mm=share * self.radius_mm)


_ARRAYS = ("xyz_camera", "normal_camera", "radius_mm", "tilt_rad", "centre_px", "must_find")


def together(first: ImageCircles, second: ImageCircles) -> ImageCircles:
    """Returns the circles of both."""
    arrays = (np.concatenate([getattr(first, name), getattr(second, name)]) for name in _ARRAYS)
    return ImageCircles((*first.labels, *second.labels), *arrays)


def image_circles(scene: Scene, group: str, image: int) -> ImageCircles:
    """Returns the circles that face the camera and whose centres lie in the image."""
    g = scene.groups[group]
    camera_from_target = g.camera_from_target[image]
    labels, xyz, normal, radius, wanted = [], [], [], [], []
    for face in scene.target.faces:
        labels += face.labels()
        xyz.append(scene.face_circles(face.id))
        normal.append(np.tile(scene.target_from_face[face.id].rotation[:, 2], (len(face.ids), 1)))
        radius.append(face.radius_mm)
        wanted += [face.id in g.faces] * len(face.ids)
    labels += scene.board.labels()
    xyz.append(g.board_circles_target)
    normal.append(np.tile(-g.target_from_board.rotation[:, 2], (len(g.board_circles_target), 1)))
    radius.append(scene.board.radii_mm())
    wanted += [True] * len(g.board_circles_target)

    xyz = camera_from_target @ np.vstack(xyz)
    normal = np.vstack(normal) @ camera_from_target.rotation.T
    radius = np.concatenate(radius)
    cosine = -(xyz * normal).sum(1) / np.linalg.norm(xyz, axis=1)
    tilt = np.arccos(np.clip(cosine, -1, 1))
    size = np.array([scene.camera.width, scene.camera.height])
    centre = scene.camera.project(xyz)
    shown = (tilt <= MAX_SHOWN_TILT_RAD) & ((centre > -0.5) & (centre < size - 0.5)).all(1)
    whole = _whole(scene.camera, xyz, normal, radius, centre)
    findable = np.array(wanted) & (tilt <= MAX_FOUND_TILT_RAD) & whole
    return ImageCircles(
        tuple(compress(labels, shown.tolist())),
        xyz[shown],
        normal[shown],
        radius[shown],
        tilt[shown],
        centre[shown],
        findable[shown],
    )


def _whole(camera: Camera, xyz, normal, radius, centre_px: np.ndarray) -> np.ndarray:
    """Returns the mask of the circles whose rims lie in the image. Only rims near its border are computed."""
    size = np.array([camera.width, camera.height])
    reach = NEAR_BORDER * camera.focal.max() * radius / np.maximum(xyz[:, 2], radius)
    inside = ((centre_px > reach[:, None]) & (centre_px < size - 1 - reach[:, None])).all(1)
    near = np.flatnonzero(~inside)
    rim = camera.project(rim_points(xyz[near], normal[near], radius[near]))
    inside[near] = ((rim > 0) & (rim < size - 1)).all((1, 2))
    return inside


def rim_points(xyz: np.ndarray, normal: np.ndarray, radius: np.ndarray, count: int = RIM_POINTS) -> np.ndarray:
    """Returns points on the rims of n circles, (n, count, 3), in the frame of the arguments (n, 3), (n, 3), (n,)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    e1 = np.cross(normal, helper)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(normal, e1)
    angle = 2 * np.pi * np.arange(count) / count
    circle = np.cos(angle)[:, None] * e1[:, None] + np.sin(angle)[:, None] * e2[:, None]
    return xyz[:, None] + radius[:, None, None] * circle
