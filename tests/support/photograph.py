"""What a photograph of a rendered set shows, by its ``truth.json``: where faces, circles and board lie in it."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.special import ndtr

from stcal.boards.board_file import load_board
from stcal.boards.target_file import load_target
from stcal.design import BoardDesign, TargetDesign, reference_board, reference_target
from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_image_offset
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.cameras.read import read_camera
from stcal.io.images import decode
from stcal.labels import BOARD
from stcal.synthetic.scene import rim_points

EDGE_PX = 0.7
"""Gaussian blur of what is drawn: about that of the lens."""
MARGIN_MM = 10.0  # from the outermost rims to a plate's edge


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Circles on a plane before a camera.

    ``matrix`` : (3, 3), columns e₁, e₂ and origin in the camera frame, mm; (x, y) lies at ``matrix @ (x, y, 1)``. Seen
    in a mirror it is left-handed. ``labels`` : n texts; ``xy_mm`` : (n, 2); ``radius_mm`` : (n,).
    """

    name: str
    matrix: np.ndarray
    labels: tuple[str, ...]
    xy_mm: np.ndarray
    radius_mm: np.ndarray

    def xyz_camera(self, xy_mm: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the plane in the camera frame, (..., 3) mm."""
        return xy_mm @ self.matrix[:, :2].T + self.matrix[:, 2]

    def outline_mm(self, margin_mm: float = MARGIN_MM) -> np.ndarray:
        """Corners (k, 2) of the convex hull of all circles, ``margin_mm`` beyond their rims."""
        angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        points = self.xy_mm[:, None] + (self.radius_mm[:, None] + margin_mm)[..., None] * ring
        return cv2.convexHull(points.reshape(-1, 1, 2).astype(np.float32))[:, 0].astype(float)

    def moved(self, matrix: np.ndarray, shift_mm: np.ndarray) -> "Plane":
        """At ``matrix @ xyz + shift_mm``, camera frame; a reflection is allowed."""
        return replace(self, matrix=matrix @ self.matrix + np.outer(shift_mm, [0, 0, 1.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """One photograph and what it shows.

    ``number`` : in its group, from 0; ``grey`` : (height, width) uint8; ``ideal`` : (height, width, 2) normalised
    coordinates of the pixels, lens distortion removed; ``faces`` : those that are turned towards the camera;
    ``hidden_faces`` : the others; ``must_find`` : by label, for all circles in view.
    """

    name: str
    group: str
    number: int
    grey: np.ndarray
    camera: Camera
    ideal: np.ndarray
    camera_from_target: Rigid
    faces: tuple[Plane, ...]
    hidden_faces: tuple[Plane, ...]
    board: Plane
    must_find: dict[str, bool]

    @property
    def planes(self) -> tuple[Plane, ...]:
        return (*self.faces, self.board)

    def ellipses(self) -> dict[str, tuple[np.ndarray, float]]:
        """By label of the circles in view: centre of the ellipse, (2,) px, and its mean radius, px."""
        found = {}
        for plane in self.planes:
            normal = np.cross(plane.matrix[:, 0], plane.matrix[:, 1])
            xyz = plane.xyz_camera(plane.xy_mm)
            normals = np.tile(normal / np.linalg.norm(normal), (len(xyz), 1))
            centres = self.camera.project(circle_image_offset(xyz, normals, plane.radius_mm))
            rims = self.camera.project(rim_points(xyz, normals, plane.radius_mm))
            x, y = np.moveaxis(rims, -1, 0)
            area = np.abs((x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y).sum(1)) / 2
            radius = np.sqrt(area / np.pi)
            found |= {k: (c, float(r)) for k, c, r in zip(plane.labels, centres, radius, strict=True)}
        return {label: found[label] for label in self.must_find if label in found}

    def circle(self, plane: Plane, index: int, reach: float) -> tuple[tuple[slice, slice], np.ndarray] | None:
        """Surroundings of one circle: a window of the image that holds ``reach`` radii about it, and the window's
        pixels in the plane in units of the radius from its centre, (h, w, 2); None where it is out of view."""
        xy, radius = plane.xy_mm[index], plane.radius_mm[index]
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = xy + radius * reach * np.column_stack([np.cos(angle), np.sin(angle)])
        px = self.camera.project(plane.xyz_camera(ring))
        height, width = self.grey.shape
        x0, y0 = np.maximum(np.floor(px.min(0)).astype(int) - 1, 0)
        x1, y1 = np.minimum(np.ceil(px.max(0)).astype(int) + 2, [width, height])
        if x1 - x0 < 3 or y1 - y0 < 3:
            return None
        window = slice(y0, y1), slice(x0, x1)
        return window, (self.in_plane(plane, window) - xy) / radius

    def in_plane(self, plane: Plane, window: tuple[slice, slice] = (slice(None), slice(None))) -> np.ndarray:
        """Where the rays of a window's pixels meet a plane, (h, w, 2) mm."""
        inverse = np.linalg.inv(plane.matrix)
        rays = self.ideal[window]
        x, y = rays[..., 0], rays[..., 1]
        depth = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
        return np.stack([(inverse[i, 0] * x + inverse[i, 1] * y + inverse[i, 2]) / depth for i in (0, 1)], axis=-1)

    def region(self, outline_px: np.ndarray, blur_px: float = 1.0) -> np.ndarray:
        """Share (height, width), float32, of the pixels inside a polygon (k, 2) px, its edge blurred."""
        share = np.zeros(self.grey.shape, np.float32)
        points = np.rint(np.clip(outline_px, -1e4, 1e4) * 16).astype(np.int32)
        cv2.fillPoly(share, [points], [1.0], cv2.LINE_8, 4)
        reach = int(np.ceil(4 * blur_px)) + 1
        (x0, y0), (x1, y1) = np.maximum([(points.min(0) >> 4) - reach, (points.max(0) >> 4) + reach + 1], 0)
        if share[y0:y1, x0:x1].size:
            share[y0:y1, x0:x1] = cv2.GaussianBlur(share[y0:y1, x0:x1], (0, 0), blur_px)
        return share

    def outline_px(self, plane: Plane, margin_mm: float = MARGIN_MM) -> np.ndarray:
        return self.camera.project(plane.xyz_camera(plane.outline_mm(margin_mm)))

    def face_region(self, plane: Plane) -> np.ndarray:
        return self.region(self.outline_px(plane))

    def foreground(self) -> np.ndarray:
        all_faces = np.vstack([self.outline_px(face) for face in (*self.faces, *self.hidden_faces)])
        hull = cv2.convexHull(all_faces.astype(np.float32))[:, 0]
        return np.maximum(self.region(hull), self.face_region(self.board))

    def levels(self, plane: Plane) -> tuple[float, float]:
        angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        around = plane.xy_mm[:, None] + 1.5 * plane.radius_mm[:, None, None] * ring
        found = []
        for xy in (plane.xy_mm, around.reshape(-1, 2)):
            x, y = np.rint(self.camera.project(plane.xyz_camera(xy))).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < self.grey.shape[1]) & (y < self.grey.shape[0])
            found.append(float(np.median(self.grey[y[inside], x[inside]])) if inside.any() else 0.0)
        return found[0], found[1]


def _slope(distance: np.ndarray) -> np.ndarray:
    """Change of a window's values per px."""
    down, right = np.gradient(distance)
    return np.hypot(down, right) + 1e-9


def disc_share(unit: np.ndarray, reach: float = 1.0, edge_px: float = EDGE_PX) -> np.ndarray:
    """Share of pixels, given in units of a radius (h, w, 2), within ``reach`` radii; the edge blurred by Gauss."""
    distance = np.hypot(unit[..., 0], unit[..., 1]) - reach
    return ndtr(-distance / _slope(distance) / edge_px)


def half_share(unit: np.ndarray, angle_rad: float, offset: float = 0.0, edge_px: float = EDGE_PX) -> np.ndarray:
    """Share of pixels beyond a line at ``offset`` radii from the centre, on the side of ``angle_rad``."""
    distance = unit[..., 0] * np.cos(angle_rad) + unit[..., 1] * np.sin(angle_rad) - offset
    return ndtr(distance / _slope(distance) / edge_px)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSet:
    """A rendered set: its photographs with their truth, and its designs; ``truth`` : as ``truth.json`` has it."""

    folder: Path
    target: TargetDesign
    board: BoardDesign
    camera: Camera
    truth: dict
    photographs: tuple[Photograph, ...]


def read_set(folder: str | Path, at_most: int | None = None) -> RenderedSet:
    """A folder with ``images``, ``cameras.txt``, ``truth.json`` and, unless they are the reference ones, designs; of
    each group the first ``at_most`` photographs."""
    folder = Path(folder)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    own = [folder / name for name in ("target.toml", "board.toml")]
    target = load_target(own[0]) if own[0].exists() else reference_target()
    board = load_board(own[1]) if own[1].exists() else reference_board()
    photographs, camera, ideal = [], None, None
    for group, content in truth["groups"].items():
        for number, (name, image) in enumerate(list(content["images"].items())[:at_most]):
            grey = decode((folder / "images" / name).read_bytes(), name)
            if camera is None or ideal is None:
                camera = read_camera(folder / "cameras.txt").calibrated(grey.shape[1], grey.shape[0])
                ideal = _ideal(camera)
            pose = Rigid.from_matrix(image["camera_from_target"])
            planes = _faces(target, truth, pose)
            seen = {label.partition(":")[0] for label in image["circles"]}
            faces, hidden = (tuple(each for each in planes if (each.name in seen) == shown) for shown in (True, False))
            dots = _board(board, np.array(content["board_circles_target"]), pose)
            must_find = {label: bool(circle["must_find"]) for label, circle in image["circles"].items()}
            taken = name, group, number, grey, camera, ideal, pose
            photographs.append(Photograph(*taken, faces, hidden, dots, must_find))
    assert camera is not None
    return RenderedSet(folder, target, board, camera, truth, tuple(photographs))


def _ideal(camera: Camera) -> np.ndarray:
    """Normalised coordinates of all pixels, (height, width, 2): every eighth by the camera, a cubic spline between."""
    x, y = (np.arange(-8.0, size + 16, 8) for size in (camera.width, camera.height))
    knots = camera.normalised_from_pixel(np.stack(np.meshgrid(x, y), axis=-1))
    rows, columns = np.arange(camera.height), np.arange(camera.width)
    return np.stack([RectBivariateSpline(y, x, knots[..., i])(rows, columns) for i in (0, 1)], axis=-1)


def _faces(target: TargetDesign, truth: dict, camera_from_target: Rigid) -> list[Plane]:
    planes = []
    for face in target.faces:
        labels = tuple(map(str, face.labels()))
        pose = Rigid.from_matrix(truth["target_from_face"][face.id])
        xyz = pose.inverse() @ np.array([truth["circles"][label] for label in labels])
        planes.append(Plane(face.id, _columns(camera_from_target @ pose), labels, xyz[:, :2], face.radius_mm))
    return planes


def _board(board: BoardDesign, dots_target: np.ndarray, camera_from_target: Rigid) -> Plane:
    grid = np.column_stack([board.xy_mm(), np.zeros(len(dots_target))])
    target_from_board = align_rigid(dots_target, grid)
    xyz = target_from_board.inverse() @ dots_target
    labels = tuple(f"{BOARD}:{i}" for i in range(len(xyz)))
    return Plane(BOARD, _columns(camera_from_target @ target_from_board), labels, xyz[:, :2], board.radii_mm())


def _columns(camera_from_plane: Rigid) -> np.ndarray:
    return np.column_stack([camera_from_plane.rotation[:, :2], camera_from_plane.translation])
