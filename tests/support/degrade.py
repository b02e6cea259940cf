"""What a photograph of a rendered set shows, by its ``truth.json``: where faces, circles and board lie in it. And good
photographs made bad as photographs are: by lens, sensor, light, what covers them and what stands behind.

Functions that degrade take an image (height, width) in grey values of 0…255, uint8 or float, and return float32 in the
same unit, not clipped: :func:`stored` makes the file's pixels of it. Places come as shares of the pixels (0…1) or from
a :class:`Photograph`. The same seed gives the same image.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
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
from stcal.synthetic.render import encode
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


WHITE = 255.0
HIDDEN_REACH = 1.35
"""Radii about a circle's centre within which it is painted over; its ring, which gives the colour, goes further."""
RING_REACH = 1.8
BLOOM_PX = 6.0
BLOOM = 0.15
"""Share of the light beyond the scale that reaches the surroundings, spread by a Gauss of ``BLOOM_PX``."""


def stored(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Pixels of a file: clipped, rounded, uint8; of 9 to 16 bits uint16 with white at 2^bits − 1."""
    top = 2**bits - 1
    levels = np.rint(np.clip(np.asarray(image, np.float32) * np.float32(top / WHITE), 0, top))
    return levels.astype(np.uint8 if bits == 8 else np.uint16)


def defocused(image: np.ndarray, radius_px: float) -> np.ndarray:
    """Out of focus: every point becomes an even disc of ``radius_px``."""
    reach = int(np.ceil(radius_px)) + 1
    step = (np.arange(-8 * reach - 4, 8 * reach + 4) + 0.5) / 8
    inside = (step[:, None] ** 2 + step**2 <= radius_px**2).astype(np.float32)
    return _filtered(image, inside.reshape(2 * reach + 1, 8, 2 * reach + 1, 8).mean((1, 3)))


def motion_blurred(image: np.ndarray, length_px: float, angle_rad: float) -> np.ndarray:
    """Moved by ``length_px`` along ``angle_rad`` while the shutter was open, evenly, half of it to either side: the
    middle of a circle stays where it was."""
    reach = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for along in np.linspace(-length_px / 2, length_px / 2, 16 * reach + 1):
        x, y = reach + along * np.cos(angle_rad), reach + along * np.sin(angle_rad)
        i, j = int(np.floor(y)), int(np.floor(x))
        for row, column in ((i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)):
            if 0 <= row < len(kernel) and 0 <= column < len(kernel):
                kernel[row, column] += max(0, 1 - abs(y - row)) * max(0, 1 - abs(x - column))
    return _filtered(image, kernel)


def rolling_shutter(image: np.ndarray, shift_px: float) -> np.ndarray:
    """Rows read one after the other while the image moves sideways: the last row stands ``shift_px`` to the right of
    the first, the middle one where it was. :func:`rolled` says where a point went."""
    height, width = image.shape
    rows, columns = np.meshgrid(np.arange(height, dtype=float), np.arange(width, dtype=float), indexing="ij")
    columns -= shift_px * (rows / (height - 1) - 0.5)
    return ndimage.map_coordinates(np.asarray(image, np.float32), [rows, columns], order=3, mode="nearest")


def rolled(xy_px: np.ndarray, shift_px: float, height: int) -> np.ndarray:
    """Where :func:`rolling_shutter` puts points (..., 2) px."""
    xy = np.array(xy_px, float)
    xy[..., 0] += shift_px * (xy[..., 1] / (height - 1) - 0.5)
    return xy


def shrunk(image: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(np.asarray(image, np.float32), (width, height), interpolation=cv2.INTER_AREA)


def noisy(image: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal(image.shape, dtype=np.float32)
    return np.asarray(image, np.float32) + np.float32(sigma) * noise


def exposed(image: np.ndarray, factor: float) -> np.ndarray:
    """Exposed ``factor`` times as long; light beyond white is lost, and a part of it blooms into the surroundings."""
    light = np.asarray(image, np.float32) * np.float32(factor)
    beyond = np.maximum(light - WHITE, 0)
    return np.minimum(light, WHITE) + BLOOM * cv2.GaussianBlur(beyond, (0, 0), BLOOM_PX)


def toned(image: np.ndarray, gamma: float) -> np.ndarray:
    """Another response: share of white to the power of 1/``gamma``; above 1 the dark parts get brighter."""
    share = np.clip(np.asarray(image, np.float32) / WHITE, 0, 1)
    return WHITE * share ** np.float32(1 / gamma)


def jpeg(image: np.ndarray, quality: int) -> bytes:
    return encode(stored(image), ".jpg", quality)


def hot_pixels(image: np.ndarray, share: float, seed: int) -> np.ndarray:
    hot = np.random.default_rng(seed).random(image.shape) < share
    return np.where(hot, np.float32(WHITE), np.asarray(image, np.float32))


def dusty(image: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Dust on the sensor: ``count`` soft spots of 3 to 10 px (Gauss), each taking 10 to 40 % of the light."""
    rng = np.random.default_rng(seed)
    result = np.array(image, np.float32)
    for _ in range(count):
        x, y = rng.uniform(0, 1, 2) * np.array(image.shape)[::-1]
        spot = _spot(image.shape, (x, y), rng.uniform(3, 10))
        result *= 1 - np.float32(rng.uniform(0.1, 0.4)) * spot
    return result


def vignetted(image: np.ndarray, loss: float) -> np.ndarray:
    """The corners lose this share of their light, the way there by the square of the distance."""
    x, y = _from_middle(image.shape)
    corner = np.hypot(x[0, 0], y[0, 0])
    return np.asarray(image, np.float32) * (1 - np.float32(loss) * (x**2 + y**2) / corner**2)


def graded(image: np.ndarray, ratio: float, angle_rad: float) -> np.ndarray:
    """Light that falls off evenly towards ``angle_rad``: ``ratio`` between the brightest corner and the darkest."""
    x, y = _from_middle(image.shape)
    along = x * np.cos(angle_rad) + y * np.sin(angle_rad)
    share = (along - along.min()) / np.ptp(along)
    return np.asarray(image, np.float32) * (1 - np.float32(1 - 1 / ratio) * share)


def hazy(image: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Haze of grey 190 ± 20 takes this share of the contrast and lays itself over the image."""
    rng = np.random.default_rng(seed)
    coarse = rng.normal(190, 20, (4, 6)).astype(np.float32)
    veil = cv2.resize(coarse, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return (1 - np.float32(share)) * np.asarray(image, np.float32) + np.float32(share) * veil


def brightened(image: np.ndarray, share: np.ndarray, factor: float) -> np.ndarray:
    """``factor`` times as bright where ``share``, (height, width), is 1."""
    return np.asarray(image, np.float32) * (1 + np.float32(factor - 1) * share)


def glared(image: np.ndarray, places_px: Iterable[np.ndarray], radius_px: float, peak: float) -> np.ndarray:
    """Glare spots: Gaussian of ``radius_px`` about each place, ``peak`` grey values in the middle."""
    result = np.array(image, np.float32)
    for place in places_px:
        result += np.float32(peak) * _spot(image.shape, place, radius_px)
    return result


def unevenly_lit(photograph: Photograph, ratio: float) -> np.ndarray:
    """The target lit from one side: from face to face, and across each, brightness falls by up to ``ratio``, fixed to
    the target; the board keeps its light."""
    light = np.array([0.55, -0.45, 0.70])
    image = photograph.grey.astype(np.float32)
    for face in photograph.faces:
        share = photograph.face_region(face)
        rows, columns = (np.flatnonzero(share.any(axis)) for axis in (1, 0))
        if not len(rows):
            continue
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        normal = photograph.camera_from_target.rotation.T @ np.cross(face.matrix[:, 0], face.matrix[:, 1])
        towards = 0.5 + 0.5 * float(light @ normal) / np.linalg.norm(light)
        low, high = face.xy_mm.min(0), face.xy_mm.max(0)
        place = (photograph.in_plane(face, window) - low) / (high - low)
        across = np.clip(place[..., 0], -0.3, 1.3)
        factor = ratio ** (-(0.5 * (1 - towards) + 0.5 * across))
        image[window] *= 1 + share[window] * (factor.astype(np.float32) - 1)
    return image


def without_circles(photograph: Photograph, labels: Iterable[str]) -> np.ndarray:
    """These circles painted over in the colour around them."""
    image = photograph.grey.astype(np.float32)
    for _, window, unit in _circles(photograph, RING_REACH, labels):
        image[window] = _covered(image[window], unit, disc_share(unit, HIDDEN_REACH, 1.0))
    return image


def cut_circles(photograph: Photograph, labels: Iterable[str], share: float, seed: int) -> np.ndarray:
    """Of each of these circles a segment of that share of its area is covered in the colour around, from any side."""
    rng = np.random.default_rng(seed)
    heights = np.linspace(-1, 1, 2001)
    beyond = (np.arccos(heights) - heights * np.sqrt(1 - heights**2)) / np.pi
    offset = float(np.interp(-share, -beyond, heights))
    image = photograph.grey.astype(np.float32)
    for _, window, unit in _circles(photograph, RING_REACH, labels):
        segment = half_share(unit, rng.uniform(0, 2 * np.pi), offset)
        image[window] = _covered(image[window], unit, disc_share(unit, HIDDEN_REACH, 1.0) * segment)
    return image


def half_darker(photograph: Photograph, share: float, angle_rad: float = 0.6) -> np.ndarray:
    """One half of every circle has this share less contrast against its surroundings, the same half in all images, as
    where an LED stands off the middle behind it. Rims stay where they are: any shift of a centre is the detector's."""
    image = photograph.grey.astype(np.float32)
    for _, window, unit in _circles(photograph, 1.3):
        distance = np.hypot(unit[..., 0], unit[..., 1])
        ring = (distance > 1.1) & (distance < 1.3)
        if ring.any():
            inside = disc_share(unit, 1.15, 1.0) * half_share(unit, angle_rad)
            contrast = image[window] - np.median(image[window][ring])
            image[window] -= (np.float32(share) * inside * contrast).astype(np.float32)
    return image


def board_covered(photograph: Photograph, share: float, seed: int, grey: float = 120.0) -> np.ndarray:
    """A sheet of paper over this share of the board, from one of its sides."""
    rng = np.random.default_rng(seed)
    outline = photograph.board.outline_mm()
    low, high = outline.min(0), outline.max(0)
    axis, from_low = int(rng.integers(2)), bool(rng.integers(2))
    edge = share * (high[axis] - low[axis])
    low, high = low - 20.0, high + 20.0
    if from_low:
        high[axis] = low[axis] + 20.0 + edge
    else:
        low[axis] = high[axis] - 20.0 - edge
    sheet = _polygon(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))
    cover = photograph.region(photograph.camera.project(photograph.board.xyz_camera(sheet)), 0.7)
    body = np.vstack([photograph.outline_px(face) for face in (*photograph.faces, *photograph.hidden_faces)])
    cover *= 1 - photograph.region(cv2.convexHull(body.astype(np.float32))[:, 0], 0.7)
    paper = grey + rng.normal(0, 2, photograph.grey.shape).astype(np.float32)
    return photograph.grey * (1 - cover) + paper * cover


def covered_labels(photograph: Photograph, image: np.ndarray, least: float = 8.0) -> tuple[set[str], set[str]]:
    """Labels of circles in view whose pixels an image has changed by ``least`` grey values or more: (all over, in
    part). All over means in nine tenths of the disc."""
    changed = np.abs(image - photograph.grey) >= least
    whole, part = set(), set()
    for label, window, unit in _circles(photograph, 1.1, photograph.must_find):
        disc = np.hypot(unit[..., 0], unit[..., 1]) < 1.1
        share = changed[window][disc].mean() if disc.any() else 0.0
        (whole if share > 0.9 else part if share > 0.02 else set()).add(label)
    return whole, part


def behind(
    photograph: Photograph, planes: Iterable[Plane], levels: Iterable[tuple[float, float]], margin_mm: float = MARGIN_MM
) -> np.ndarray:
    """The photograph with planes drawn behind target and board; ``levels`` : grey values of each one's circles and of
    its plate. Later ones cover earlier ones; those that reach behind the camera are not drawn."""
    image = photograph.grey.astype(np.float32)
    free = 1 - photograph.foreground()
    for plane, (circle, plate) in zip(planes, levels, strict=True):
        if (plane.xyz_camera(plane.outline_mm(margin_mm))[:, 2] < 10).any():
            continue
        share = photograph.region(photograph.outline_px(plane, margin_mm), 0.7)
        drawn = image * (1 - share) + np.float32(plate) * share
        for i in range(len(plane.labels)):
            if found := photograph.circle(plane, i, 1.5):
                window, unit = found
                disc = disc_share(unit).astype(np.float32)
                drawn[window] += disc * (np.float32(circle) - drawn[window])
        image += free * (drawn - image)
    return image


def _covered(pixels: np.ndarray, unit: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """A window with a circle covered in the colour of its ring, a linear fit, with the ring's noise."""
    distance = np.hypot(unit[..., 0], unit[..., 1])
    ring = (distance > HIDDEN_REACH) & (distance < RING_REACH)
    terms = np.stack([np.ones_like(distance), unit[..., 0], unit[..., 1]], axis=-1)
    if ring.sum() < 10:
        return pixels
    values = pixels[ring]
    usual = np.abs(values - np.median(values)) <= 3 * max(float(np.median(np.abs(values - np.median(values)))), 2.0)
    fit, *_ = np.linalg.lstsq(terms[ring][usual], values[usual], rcond=None)
    spread = float(np.std(values[usual] - terms[ring][usual] @ fit))
    noise = np.random.default_rng(pixels.shape).normal(0, spread, pixels.shape)
    return (pixels * (1 - cover) + (terms @ fit + noise) * cover).astype(np.float32)


def _circles(photograph: Photograph, reach: float, labels: Iterable[str] | None = None):
    """Label and surroundings (:meth:`Photograph.circle`) of circles in view, of all where no labels are given."""
    wanted = None if labels is None else set(labels)
    for plane in photograph.planes:
        for i, label in enumerate(plane.labels):
            if (wanted is None or label in wanted) and (found := photograph.circle(plane, i, reach)):
                yield label, *found


def _polygon(corners: np.ndarray, steps: int = 20) -> np.ndarray:
    """A polygon with points along its sides, so that lens distortion bends them."""
    share = np.arange(steps)[:, None] / steps
    return np.vstack([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])


def _filtered(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    kernel = (kernel / kernel.sum()).astype(np.float32)
    return cv2.filter2D(np.asarray(image, np.float32), -1, kernel, borderType=cv2.BORDER_REPLICATE)


def _spot(shape: tuple[int, ...], place_px: Iterable[float], radius_px: float) -> np.ndarray:
    """A Gaussian of height 1."""
    px, py = place_px
    x = np.exp(-(((np.arange(shape[1]) - px) / radius_px) ** 2) / 2)
    y = np.exp(-(((np.arange(shape[0]) - py) / radius_px) ** 2) / 2)
    return np.outer(y, x).astype(np.float32)


def _from_middle(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    height, width = shape
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    return x.astype(np.float32), y.astype(np.float32)
