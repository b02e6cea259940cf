"""Synthesis of photographs of a scene: circles by exact area coverage, lens blur, vignetting, noise, quantisation."""

from dataclasses import dataclass

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.labels import DotLabel
from stcal.synthetic.background import draw_background, look_of
from stcal.synthetic.observe import ImageCircles, image_circles, rim_points
from stcal.synthetic.scene import Scene

SUBSAMPLES = 8
"""Number of cells per pixel side at a rim. A cell that the rim crosses counts by its linear share."""
FINE = 4
"""Number of squares per pixel side on which a circle is blurred."""
RIM_REACH_PX = 1.5
STEEP_RAD = np.radians(75)
FULL_SCALE = 255.0


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Appearance of the photographs.

    Parameters
    ----------
    noise : float
        Standard deviation of the sensor noise, fraction of full scale.
    blur_px : float
        Sigma of the Gaussian point spread function.
    vignetting : float
        Loss of light in the corners, fraction.
    gradient : float
        Linear variation of brightness by ± this fraction from one side of the image to the other, in random direction.
    spread : float
        Standard deviation of the brightness of single circles, fraction.
    exposure : float
        Factor on all brightness. Circles saturate above 1.4 on a bright design; the default stays clear of it.
    clutter : bool
        Whether there are a checkered wall with discs and ellipses, and reflections; else a plain wall.
    bit_depth : int
        8 or 16.
    seed : int
        Seed of noise and scenery, in addition to the seed of the scene.
    """

    noise: float = 0.01
    blur_px: float = 0.7
    vignetting: float = 0.15
    gradient: float = 0.05
    spread: float = 0.02
    exposure: float = 1.0
    clutter: bool = False
    bit_depth: int = 8
    seed: int = 0

    def __post_init__(self):
        for name in ("noise", "blur_px", "vignetting", "gradient", "spread", "exposure"):
            if getattr(self, name) < 0:
                raise InputError(
                    "E-SIMULATE-OPTIONS", f"rendering: {name} {getattr(self, name):g}, zero or more needed"
                )
        if self.bit_depth not in (8, 16):
            raise InputError("E-SIMULATE-OPTIONS", f"rendering: bit depth {self.bit_depth}, 8 or 16 needed")


def render(scene: Scene, group: str, image: int, options: RenderOptions | None = None) -> np.ndarray:
    """Renders photograph number ``image`` of ``group``: (height, width), uint8 or uint16.

    The same arguments give the same image.
    """
    options = options or RenderOptions()
    rng = np.random.default_rng([scene.seed, options.seed, 1 + list(scene.groups).index(group), image])
    circles = image_circles(scene, group, image)
    picture = draw_background(scene, group, image, options.clutter, options.seed).astype(np.float32)
    board, face = look_of(scene.board.polarity).circle, look_of(scene.target.polarity).circle
    base = np.array([board if isinstance(label, DotLabel) else face for label in circles.labels])
    levels = base * (1 + options.spread * rng.standard_normal(len(base)))
    picture = _add_circles(picture, scene.camera, circles, levels, options.blur_px)
    return _expose(picture, options, rng)


def encode(picture: np.ndarray, suffix: str, jpeg_quality: int = 95) -> bytes:
    """Returns the content of an image file; ``suffix`` is ``.jpg`` or ``.png``."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if suffix == ".jpg" else []
    return cv2.imencode(suffix, picture, quality)[1].tobytes()


def _add_circles(
    picture: np.ndarray, camera: Camera, circles: ImageCircles, levels: np.ndarray, blur_px: float
) -> np.ndarray:
    """Blurs the picture and adds the circles.

    The lens blurs before the sensor samples: blurring coverage per pixel instead would shift centres by up to
    0.004 px. Therefore each circle is blurred on a finer grid, and added; the background around it is even.
    """
    rims = camera.project(rim_points(circles.xyz_camera, circles.normal_camera, circles.radius_mm))
    margin = 2 + int(np.ceil(4 * blur_px))
    low = np.maximum(np.floor(rims.min(1)).astype(int) - margin, 0)
    high = np.minimum(np.ceil(rims.max(1)).astype(int) + margin + 1, [camera.width, camera.height])
    light = np.zeros_like(picture)
    for i, level in enumerate(levels):
        (x0, y0), (x1, y1) = low[i], high[i]
        disc = circles.xyz_camera[i], circles.normal_camera[i], float(circles.radius_mm[i])
        share = _fine_coverage(camera, (x0, y0, x1, y1), *disc, steep=circles.tilt_rad[i] > STEEP_RAD)
        if blur_px > 0:
            share = cv2.GaussianBlur(share, (0, 0), blur_px * FINE, borderType=cv2.BORDER_REPLICATE)
        share = share.reshape(y1 - y0, FINE, x1 - x0, FINE).mean((1, 3))
        light[y0:y1, x0:x1] += share * (np.float32(level) - picture[y0:y1, x0:x1])
    if blur_px > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    light += picture
    return light


def _fine_coverage(
    camera: Camera, box, centre: np.ndarray, normal: np.ndarray, radius: float, steep: bool
) -> np.ndarray:
    """Returns the share of each ¼ px square of a box that one disc covers, (4·(y1 - y0), 4·(x1 - x0)) float32.

    Rays through pixels are intersected with the disc's plane. Away from the rim the distance from the disc's centre
    decides; near the rim the pixel is divided into cells.
    """
    x0, y0, x1, y1 = box
    ideal = camera.normalised_from_pixel(np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1))
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

    share = np.empty((y1 - y0, x1 - x0, FINE, FINE), np.float32)
    share[:] = (outside <= 0)[..., None, None]
    share[rim] = cells_share.reshape(-1, FINE, SUBSAMPLES // FINE, FINE, SUBSAMPLES // FINE).mean((2, 4))
    return share.transpose(0, 2, 1, 3).reshape((y1 - y0) * FINE, (x1 - x0) * FINE)


def _relative_distance(xy: np.ndarray, centre: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """Returns distance from the disc's centre / radius − 1 where rays (..., 2) meet the disc's plane, (...)."""
    # Written out, because a matrix product would start BLAS threads, which slow down parallel rendering.
    x, y = xy[..., 0], xy[..., 1]
    depth = (normal @ centre) / (x * normal[0] + y * normal[1] + normal[2])
    dx, dy, dz = depth * x - centre[0], depth * y - centre[1], depth - centre[2]
    return np.sqrt(dx * dx + dy * dy + dz * dz) / radius - 1


def _expose(picture: np.ndarray, options: RenderOptions, rng: np.random.Generator) -> np.ndarray:
    """Returns the grey levels of the light ``picture`` on the sensor, which is overwritten."""
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
