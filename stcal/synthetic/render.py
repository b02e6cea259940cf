"""Synthesis of photographs of a scene: circles by exact area coverage, rims, lens blur, vignetting, background."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from stcal.boards.board_designs import SQUARE
from stcal.design import Polarity
from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import DotLabel
from stcal.synthetic.optics import SHARP_PX, WIDEST_PX, ThinLens, blur_evenly, defocused
from stcal.synthetic.scene import Group, ImageCircles, PlacedCircles, Scene, image_circles, rim_points

WALL_BEHIND_MM = 350.0
WALL_CELL_MM = 35.0
WALL_REACH = 3.0
"""Half the side of the wall, in widths of the view. An oblique view reaches far; cells out of view cost little."""
LAMP_REACH_MM = 1000.0
TABLE_BELOW_MM = 50.0
FAINT = 0.12  # reflectance of the table that clutter has, which shows circles alone
SHIFT = 4  # fractional bits of cv2's fixed-point pixels


@dataclass(frozen=True, slots=True)
class Look:
    """Grey levels (0 to 255) of the parts of a scene; ``lamps`` is their range for discs and ellipses on the wall."""

    circle: float
    face: float
    body: float
    plate: float
    wall: float
    checker: tuple[float, float]
    lamps: tuple[float, float]


LOOKS: dict[Polarity, Look] = {
    "bright": Look(circle=180, face=5, body=3, plate=5, wall=2, checker=(14, 27), lamps=(25, 225)),
    "dark": Look(circle=24, face=205, body=140, plate=214, wall=85, checker=(75, 108), lamps=(8, 250)),
}
"""By the polarity of a target's or a board's circles."""


def draw_background(scene: Scene, group: str, image: int, options: "RenderOptions") -> np.ndarray:
    """Draws the image without the circles, (height, width) uint8; all images of a group show the same scenery. A
    thin lens blurs the wall by the circle of confusion at its middle, and target and plate by that at theirs."""
    g, look = scene.groups[group], LOOKS[scene.target.polarity]
    canvas = np.full((scene.camera.height, scene.camera.width), round(look.wall), np.uint8)
    painter = _Painter(scene.camera, g.camera_from_target[image], canvas)
    if options.clutter:
        rng = np.random.default_rng([scene.seed, options.seed, list(scene.groups).index(group)])
        wall = _wall(scene, g, rng)
        _draw_checker(painter, wall, look)
        _draw_lamps(painter, wall, look, rng)
    if options.clutter or options.reflectance is not None:
        _draw_reflections(painter, scene, g, options.reflectance)
    outlines = [*(scene.face_outline(face) for face in g.faces), scene.board_outline(group)]
    near_px = 0.0
    if (lens := options.lens) is not None:
        middle_mm = (painter.camera_from_target @ np.vstack(outlines))[:, 2].mean()
        near_px = float(lens.confusion_px(scene.camera, middle_mm))
        if options.clutter:
            far_px = float(lens.confusion_px(scene.camera, (painter.camera_from_target @ wall.translation)[2]))
            # Once more blurred with the target, the wall has the variance of its own circle of confusion.
            painter.canvas[:] = blur_evenly(painter.canvas, float(np.sqrt(max(far_px**2 - near_px**2, 0))))
    _draw_body(painter, scene, look)
    painter.polygons(_edges(scene.board_outline(group)), LOOKS[scene.board.polarity].plate)
    return blur_evenly(painter.canvas, near_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Painter:
    """Canvas in the image of a camera, for polygons in the target frame, perhaps as a mirror shows them."""

    camera: Camera
    camera_from_target: Rigid
    canvas: np.ndarray
    mirror: tuple[np.ndarray, float] | None = None  # unit normal, and distance from the origin
    tone: Callable[[float], float] = lambda level: level  # the canvas's grey level of a thing's

    @property
    def centre(self) -> np.ndarray:
        """Where the eye stands, target frame."""
        return self._mirrored(self.camera_from_target.inverse().translation)

    def _mirrored(self, xyz: np.ndarray) -> np.ndarray:
        if self.mirror is None:
            return xyz
        normal, at = self.mirror
        return xyz - 2 * (xyz @ normal - at)[..., None] * normal

    def pixels(self, polygons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pixels (n, k, 2) of polygons (n, k, 3), and which polygons are near the field of view, (n,)."""
        xyz = self.camera_from_target @ self._mirrored(polygons)
        xy = xyz[..., :2] / np.maximum(xyz[..., 2:], 1.0)
        size = np.array([self.camera.width, self.camera.height])
        # Beyond this reach the distortion may fold points back into the image.
        reach = 0.8 * size / self.camera.focal
        near = (xyz[..., 2].min(1) > 1) & (np.abs(xy) < reach).all((1, 2))
        xy = np.clip(xy, -reach, reach)
        pixel = self.camera.pixel_from_normalised(xy)
        near &= ((pixel.max(1) > -1) & (pixel.min(1) < size)).all(1)
        return pixel, near

    def polygons(self, polygons: np.ndarray, levels) -> None:
        """Fills polygons (n, k, 3), later ones on top."""
        pixel, near = self.pixels(polygons)
        for outline, level in zip(pixel[near], np.broadcast_to(levels, len(near))[near], strict=True):
            self.fill(outline, level)

    def circles(self, pattern: PlacedCircles, level: float) -> None:
        """Fills the circles that face the eye."""
        shown = (self.centre - pattern.xyz_target) @ pattern.normal > 0
        if shown.any():
            normals = np.tile(pattern.normal, (shown.sum(), 1))
            self.polygons(rim_points(pattern.xyz_target[shown], normals, pattern.radius_mm[shown], 48), level)

    def fill(self, outline: np.ndarray, level: float) -> None:
        """Fills a polygon (k, 2) px."""
        fixed = np.rint(outline * 2**SHIFT).astype(np.int32)
        cv2.fillPoly(self.canvas, [fixed], float(self.tone(level)), cv2.LINE_AA, SHIFT)


def _edges(corners: np.ndarray, pieces: int = 12) -> np.ndarray:
    """Returns points along the edges of a polygon (k, 3), so that the lens can bend the edges, (1, k·pieces, 3)."""
    t = np.arange(pieces)[:, None] / pieces
    following = np.roll(corners, -1, axis=0)
    return (corners[:, None] * (1 - t) + following[:, None] * t).reshape(1, -1, 3)


def _wall(scene: Scene, g: Group, rng) -> Rigid:
    points = np.vstack([*(scene.face_outline(face.id) for face in scene.target.faces), scene.board_outline(g.name)])
    turn = Rigid.exp([*np.radians(rng.uniform(-10, 10, 3)), 0, 0, 0]).rotation
    rotation = g.axes.T @ turn
    depth = (points @ g.axes[2]).min() - WALL_BEHIND_MM
    middle = (points.min(0) + points.max(0)) / 2
    return Rigid(rotation, middle + (depth - middle @ g.axes[2]) * g.axes[2])


def _draw_checker(painter: _Painter, wall: Rigid, look: Look) -> None:
    distance = np.linalg.norm(painter.camera_from_target.translation) + WALL_BEHIND_MM
    view_mm = float(distance * painter.camera.width / painter.camera.focal[0])  # width at the wall, about
    n = int(WALL_REACH * view_mm / WALL_CELL_MM)
    row, column = np.mgrid[-n:n, -n:n].reshape(2, -1)
    light = (row + column) % 2 == 0
    xy = WALL_CELL_MM * (np.column_stack([column, row])[light][:, None] + SQUARE)
    painter.canvas[:] = round(look.checker[0])
    painter.polygons(wall @ np.dstack([xy, np.zeros(xy.shape[:2])]), look.checker[1])


def _draw_lamps(painter: _Painter, wall: Rigid, look: Look, rng) -> None:
    n_discs, n = 120, 180  # the others are ellipses
    centre = np.column_stack([rng.uniform(-LAMP_REACH_MM, LAMP_REACH_MM, (n, 2)), np.full(n, 1.0)])
    radius = np.exp(rng.uniform(np.log(2.0), np.log(45.0), n))
    ratio = np.where(np.arange(n) < n_discs, 1.0, rng.uniform(0.2, 0.9, n))
    angle = rng.uniform(0, np.pi, n)
    level = np.where(rng.random(n) < 0.4, look.lamps[1] * rng.uniform(0.6, 1, n), rng.uniform(*look.lamps, n))
    t = 2 * np.pi * np.arange(96) / 96
    x, y = radius[:, None] * np.cos(t), (ratio * radius)[:, None] * np.sin(t)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    rim = np.stack([c * x - s * y, s * x + c * y, np.zeros_like(x)], axis=-1)
    order = rng.permutation(n)
    painter.polygons((wall @ (centre[:, None] + rim))[order], level[order])


def _draw_reflections(painter: _Painter, scene: Scene, g: Group, reflectance: float | None) -> None:
    """Draws target and board mirrored in a table by its ``reflectance``; of the circles alone, if None."""
    whole, share, up = reflectance is not None, FAINT if reflectance is None else reflectance, g.axes[1]
    outlines = np.vstack([*(scene.face_outline(f.id) for f in scene.target.faces), scene.board_outline(g.name)])
    at = (outlines @ up).min() - TABLE_BELOW_MM
    if painter.centre @ up <= at:
        return
    look, plate = LOOKS[scene.target.polarity], LOOKS[scene.board.polarity]
    own = look.checker[1]
    mirror = replace(painter, mirror=(up, at), tone=lambda level: own + share * (level - own))
    if whole:
        _draw_body(mirror, scene, look)
    *faces, board = scene.patterns(g.name)
    for pattern in faces:
        mirror.circles(pattern, look.circle)
    if whole:
        mirror.polygons(_edges(scene.board_outline(g.name)), plate.plate)
    mirror.circles(board, plate.circle)


def _draw_body(painter: _Painter, scene: Scene, look: Look) -> None:
    outlines = {face.id: scene.face_outline(face.id) for face in scene.target.faces}
    pixel, _ = painter.pixels(np.concatenate([_edges(outline) for outline in outlines.values()]))
    points = pixel.reshape(-1, 2)
    painter.fill(points[ConvexHull(points).vertices], look.body)
    for face_id in sorted(outlines, key=lambda face: -np.linalg.norm(outlines[face].mean(0) - painter.centre)):
        ray = painter.centre - outlines[face_id].mean(0)
        cosine = scene.target_from_face[face_id].rotation[:, 2] @ ray / np.linalg.norm(ray)
        if cosine > 0:
            painter.polygons(_edges(outlines[face_id]), look.face * (0.8 + 0.2 * cosine))


SUBSAMPLES = 8
"""Number of cells per pixel side at a rim. A cell that the rim crosses counts by its linear share."""
FINE = 4  # number of squares per pixel side on which a circle is blurred
RIM_REACH_PX = 1.5
SPREAD_BY_DISTORTION = 1.3  # largest factor by which the lens distortion may enlarge a circle of confusion
HOLE_SHARE = 0.4  # radius of the hole in a dot that tells a board from its turns, in radii of the dot
STEEP_RAD = np.radians(75)
FULL_SCALE = 255.0


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Appearance of the photographs.

    Parameters
    ----------
    noise : Standard deviation of the sensor noise, fraction of full scale.
    blur_px : Sigma of the Gaussian point spread function.
    vignetting : Loss of light in the corners, fraction.
    gradient : float
        Linear variation of brightness by ± this fraction from one side of the image to the other, in random direction.
    spread : Standard deviation of the brightness of single circles, fraction.
    exposure : Factor on all brightness. Circles saturate above 1.4 on a bright design; the default stays clear of it.
    clutter : Whether there are a checkered wall with discs and ellipses, and reflections; else a plain wall.
    reflectance : Reflectance of a table below target and board, which shows all of them as a mirror does. Clutter has a
        table that shows their circles faintly.
    bit_depth : 8 or 16.
    seed : Seed of noise and scenery, in addition to the seed of the scene.
    lens : Aperture and focus; without it everything is in focus. It needs a perspective camera.
    rim_mm : Depth of the luminous discs of the faces behind rims of the same radius, cylindrical holes: what is seen is
        the part of a disc that a camera sees through the hole's upper edge. A negative value raises the disc by that
        height: its top shines, its wall is dark, and the circle simply lies higher. The stated true circles stay where
        the face is. Dots of the board have the rims that its design states.
    slope : Fraction by which the light of each disc of the faces rises from one side to the other, along x of its face.
    fade : Fraction of its light that each disc of the faces lacks at its edge; the loss grows with the squared radius.
    """

    noise: float = 0.01
    blur_px: float = 0.7
    vignetting: float = 0.15
    gradient: float = 0.05
    spread: float = 0.02
    exposure: float = 1.0
    clutter: bool = False
    reflectance: float | None = None
    bit_depth: int = 8
    seed: int = 0
    lens: ThinLens | None = None
    rim_mm: float = 0.0
    slope: float = 0.0
    fade: float = 0.0

    def __post_init__(self):
        require_fields(self, "rendering", seed=0)
        for name in ("noise", "blur_px", "vignetting", "gradient", "spread", "exposure", "slope", "fade"):
            if (value := getattr(self, name)) < 0:
                raise InputError("E-SIMULATE-OPTIONS", f"rendering: {name} {value:g}, zero or more needed")
        if self.bit_depth not in (8, 16):
            raise InputError("E-SIMULATE-OPTIONS", f"rendering: bit depth {self.bit_depth}, 8 or 16 needed")
        if self.reflectance is not None and not 0 <= self.reflectance <= 1:
            raise InputError("E-SIMULATE-OPTIONS", f"rendering: reflectance {self.reflectance:g}, 0 to 1 needed")


def check_lens(scene: Scene, lens: ThinLens | None) -> None:
    """Raises an error if the lens does not fit the scene's camera, or blurs a circle beyond what can be rendered."""
    if lens is None:
        return
    if scene.camera.fisheye:
        fault = "rendering: thin lens of an equidistant camera"
        raise InputError("E-SIMULATE-OPTIONS", f"{fault}; a perspective camera needed, or leave the f-number out")
    depth = np.concatenate([image_circles(scene, *view).xyz_camera[:, 2] for view in scene.views()])
    confusion = lens.confusion_px(scene.camera, depth)
    if len(depth) and confusion.max() > WIDEST_PX:
        focus = f"rendering: focused at {lens.focus_mm:g} mm, a circle at {depth[confusion.argmax()]:.0f} mm is blurred"
        fault = f"{focus} to a radius of {confusion.max():.0f} px, at most {WIDEST_PX:g} possible"
        raise InputError("E-SIMULATE-OPTIONS", f"{fault}; focus nearer to it, or take a larger f-number")


def render(scene: Scene, group: str, image: int, options: RenderOptions | None = None) -> np.ndarray:
    """Renders photograph number ``image`` of ``group``: (height, width), uint8 or uint16; the same each time."""
    options = options or RenderOptions()
    rng = np.random.default_rng([scene.seed, options.seed, 1 + list(scene.groups).index(group), image])
    circles = image_circles(scene, group, image)
    picture = draw_background(scene, group, image, options).astype(np.float32)
    board, face = LOOKS[scene.board.polarity].circle, LOOKS[scene.target.polarity].circle
    dot = np.array([isinstance(label, DotLabel) for label in circles.labels], bool)
    levels = np.where(dot, board, face) * (1 + options.spread * rng.standard_normal(len(dot)))
    rim_mm = np.where(dot, scene.board.rim_mm, options.rim_mm)
    rings = {DotLabel(*cell) for cell in scene.board.rings}
    holes = np.array([label in rings for label in circles.labels], bool)
    if holes.any():
        # The light of a hole is that of the plate in place of its dot's; circles are added to the plate's.
        plate = LOOKS[scene.board.polarity].plate
        every = circles.rows(np.append(np.arange(len(dot)), np.flatnonzero(holes)))
        radius_mm = np.append(circles.radius_mm, HOLE_SHARE * circles.radius_mm[holes])
        circles = replace(every, radius_mm=radius_mm)
        levels = np.append(levels, 2 * plate - levels[holes])
        rim_mm = np.append(rim_mm, np.minimum(rim_mm[holes], 0))
    turn = scene.groups[group].camera_from_target[image].rotation
    slopes = np.zeros((len(levels), 3))  # of the discs' light, camera frame; none of dots and of holes
    for i, label in enumerate(circles.labels):
        if not isinstance(label, DotLabel):
            slopes[i] = turn @ scene.target_from_face[label.face].rotation[:, 0]
    picture = _add_circles(picture, scene.camera, circles, levels, rim_mm, slopes, options)
    return _expose(picture, options, rng)


def encode(picture: np.ndarray, suffix: str, jpeg_quality: int = 95) -> bytes:
    """Returns the content of an image file; ``suffix`` is ``.jpg`` or ``.png``."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if suffix == ".jpg" else []
    return cv2.imencode(suffix, picture, quality)[1].tobytes()


def _add_circles(
    picture: np.ndarray,
    camera: Camera,
    circles: ImageCircles,
    levels: np.ndarray,
    rim_mm: np.ndarray,
    slopes: np.ndarray,
    options: RenderOptions,
) -> np.ndarray:
    """Blurs the picture and adds the circles, each blurred on a finer grid: by pixels, centres move by 0.004 px."""
    blur_px, lens = options.blur_px, options.lens
    top = circles.xyz_camera + np.maximum(-rim_mm, 0)[:, None] * circles.normal_camera
    outlines = rim_points(top, circles.normal_camera, circles.radius_mm)
    rims = camera.project(outlines)
    confusion = np.zeros(len(levels)) if lens is None else lens.confusion_px(camera, outlines[..., 2]).max(1)
    margin = (2 + np.ceil(4 * blur_px) + np.ceil(SPREAD_BY_DISTORTION * confusion)).astype(int)[:, None]
    low = np.maximum(np.floor(rims.min(1)).astype(int) - margin, 0)
    high = np.minimum(np.ceil(rims.max(1)).astype(int) + margin + 1, [camera.width, camera.height])
    light = np.zeros_like(picture)
    for i in np.flatnonzero((high > low).all(1)):
        (x0, y0), (x1, y1) = low[i], high[i]
        normal, radius = circles.normal_camera[i], float(circles.radius_mm[i])
        planes = [top[i]] if rim_mm[i] <= 0 else [top[i], top[i] + rim_mm[i] * normal]
        steep = circles.tilt_rad[i] > STEEP_RAD
        ideal = camera.normalised_from_pixel(np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1))
        shares = [_fine_coverage(camera, ideal, plane, normal, radius, steep) for plane in planes]
        own = None
        if (options.slope or options.fade) and slopes[i].any():
            own = _light_of_disc(ideal, planes[-1], normal, radius, slopes[i], options)
        if lens is not None and confusion[i] > SHARP_PX:
            share = defocused(shares, planes, normal, (x0, y0), FINE, camera, lens, blur_px, own)
        else:
            share = np.minimum.reduce(shares)
            share = share if own is None else share * own
        if blur_px > 0:
            share = cv2.GaussianBlur(share, (0, 0), blur_px * FINE, borderType=cv2.BORDER_REPLICATE)
        share = share.reshape(y1 - y0, FINE, x1 - x0, FINE).mean((1, 3))
        light[y0:y1, x0:x1] += share * (np.float32(levels[i]) - picture[y0:y1, x0:x1])
    if blur_px > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    light += picture
    return light


def _fine_coverage(
    camera: Camera, ideal: np.ndarray, centre: np.ndarray, normal: np.ndarray, radius: float, steep: bool
) -> np.ndarray:
    """Returns the share of each ¼ px square that one disc covers, (4 h, 4 w); ``ideal`` : (h, w, 2) of the pixels."""
    height, width = ideal.shape[:2]
    outside = _relative_distance(ideal, centre, normal, radius)
    rim = np.abs(outside) < RIM_REACH_PX * np.hypot(*np.gradient(outside))
    if steep:  # the ellipse is so narrow that the linear estimate of the distance fails
        rim[:] = True
    # Within a pixel the lens is linear to 1e-5 px.
    _, distorted_from_ideal = camera.distort_jacobian(ideal[rim])
    ideal_from_pixel = np.linalg.inv(distorted_from_ideal) / camera.focal
    step = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5
    dx, dy = step[:, None], step[:, None, None]
    along_x, along_y = (ideal_from_pixel[:, None, None, :, i] for i in (0, 1))
    cells = ideal[rim][:, None, None] + along_x * dx + along_y * dy
    cells_outside = _relative_distance(cells, centre, normal, radius)
    slope = np.hypot(*np.gradient(cells_outside, axis=(1, 2)))
    cells_share = np.clip(0.5 - cells_outside / np.maximum(slope, 1e-12), 0, 1)

    share = np.empty((height, width, FINE, FINE), np.float32)
    share[:] = (outside <= 0)[..., None, None]
    share[rim] = cells_share.reshape(-1, FINE, SUBSAMPLES // FINE, FINE, SUBSAMPLES // FINE).mean((2, 4))
    return share.transpose(0, 2, 1, 3).reshape(height * FINE, width * FINE)


def _light_of_disc(ideal: np.ndarray, centre, normal, radius: float, x, options: RenderOptions) -> np.ndarray:
    """Returns the light of a disc over its mean level on the squares of :func:`_fine_coverage`; ``x`` : unit vector."""
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=-1)
    place = (rays * ((normal @ centre) / (rays @ normal))[..., None] - centre) / radius
    light = 1 + options.slope / 2 * np.clip(place @ x, -1.5, 1.5)
    light -= options.fade * np.minimum((place**2).sum(-1), 1.5)
    return cv2.resize(light.astype(np.float32), None, fx=FINE, fy=FINE, interpolation=cv2.INTER_LINEAR)


def _relative_distance(xy: np.ndarray, centre: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """Returns distance from the disc's centre / radius − 1 where rays (..., 2) meet the disc's plane, (...)."""
    # Written out, because a matrix product would start BLAS threads, which slow down parallel rendering.
    x, y = xy[..., 0], xy[..., 1]
    depth = (normal @ centre) / (x * normal[0] + y * normal[1] + normal[2])
    dx, dy, dz = depth * x - centre[0], depth * y - centre[1], depth - centre[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz) / radius - 1


def _expose(picture: np.ndarray, options: RenderOptions, rng: np.random.Generator) -> np.ndarray:
    height, width = picture.shape
    x = ((np.arange(width) - (width - 1) / 2) / (width / 2)).astype(np.float32)
    y = ((np.arange(height) - (height - 1) / 2) / (width / 2)).astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    corner = 1 + (height / width) ** 2
    along_x = options.exposure * (1 + options.gradient * np.cos(angle) * x - options.vignetting / corner * x**2)
    along_y = options.exposure * (options.gradient * np.sin(angle) * y - options.vignetting / corner * y**2)
    picture *= along_x[None] + along_y[:, None]
    if options.noise > 0:
        noise = rng.standard_normal(picture.shape, dtype=np.float32)
        noise *= np.float32(options.noise * FULL_SCALE)
        picture += noise
    top = 2**options.bit_depth - 1
    picture *= np.float32(top / FULL_SCALE)
    np.clip(picture, 0, top, out=picture)
    return np.rint(picture, out=picture).astype(np.uint8 if options.bit_depth == 8 else np.uint16)
