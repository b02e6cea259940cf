"""Optics of simulated photographs: a thin lens with an aperture, and new exposures of a real photograph."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.camera import Camera

SHARP_PX = 0.01
"""Radius of a circle of confusion below which nothing is blurred: it moves no centre by 1e-4 px."""
WIDEST_PX = 20.0  # largest circle of confusion that is rendered, radius: the time grows with its square
HIGHEST_WAVE = 3.0
"""Highest wave number that matters, in 1/σ of the Gaussian blur, which lets through 1 % of it."""
LEAST_SIGMA_PX = 0.35  # σ of the blur by a pixel's own area, about 1/√12


@dataclass(frozen=True, slots=True)
class ThinLens:
    """A thin lens of diameter ``focal_mm`` / ``f_number`` at the camera's centre, focused on Z = ``focus_mm``.

    The ray from a point (X, Y, Z) through the point p = (u, v, 0) of the aperture meets the plane of focus z_f at
    p + ((X, Y) − p) z_f / Z. The plane of focus is imaged as by a pinhole, so that the ray arrives at the normalised
    coordinates (X, Y) / Z + p (1/z_f − 1/Z). With p on the disc of diameter A = f / N, the point's image is a disc of
    even light about its pinhole image, with the radius (circle of confusion)

        c = f_px · A / 2 · |1/Z − 1/z_f|   in px, of the variance c² / 4 per axis.

    f_px is the camera's focal length, and hence is that of the focused lens: a thin lens of focal length f has its
    sensor at f z_f / (z_f − f). (Potmesil & Chakravarty 1981, A lens and aperture camera model for synthetic image
    generation; Hecht, Optics, sec. 5.2.)

    Parameters
    ----------
    f_number : Focal length / diameter of the aperture, N.
    focal_mm : Focal length, f.
    focus_mm : Depth of the plane of focus from the camera's centre, z_f.
    """

    f_number: float
    focal_mm: float
    focus_mm: float

    def __post_init__(self):
        require_fields(self, "lens")
        for name in ("f_number", "focal_mm", "focus_mm"):
            if (value := getattr(self, name)) <= 0:
                raise InputError("E-SIMULATE-OPTIONS", f"lens: {name} {value:g}, a positive number needed")
        if self.focus_mm <= self.focal_mm:
            fault = f"lens: focused at {self.focus_mm:g} mm, within its focal length of {self.focal_mm:g} mm"
            raise InputError("E-SIMULATE-OPTIONS", f"{fault}, so that it forms no image; focus farther away")

    def confusion_px(self, camera: Camera, depth_mm: np.ndarray) -> np.ndarray:
        """Returns the radius of the circle of confusion of points at these depths (...), in px, (...)."""
        aperture_mm = self.focal_mm / self.f_number
        return camera.focal.mean() * aperture_mm / 2 * np.abs(1 / np.asarray(depth_mm) - 1 / self.focus_mm)

    def points(self, confusion_px: float, blur_px: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns points of the aperture (n, 2), mm, and their weights (n,), for means over it. Gauss's rule for the
        squared radius and even angles: exact for what a Gaussian blur of ``blur_px`` leaves of an image blurred by
        this circle of confusion. The points lie in pairs on both sides of the centre."""
        waves = HIGHEST_WAVE / max(blur_px, LEAST_SIGMA_PX) * confusion_px
        n_rings, n_angles = int(np.ceil(waves / 4)) + 2, 2 * int(np.ceil(waves / 2)) + 4
        node, weight = np.polynomial.legendre.leggauss(n_rings)
        radius = self.focal_mm / self.f_number / 2 * np.sqrt((node + 1) / 2)
        angle = 2 * np.pi * (np.arange(n_angles) + np.arange(n_rings)[:, None] % 2 / 2) / n_angles
        xy = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return xy.reshape(-1, 2), np.repeat(weight / 2 / n_angles, n_angles)


def blur_evenly(picture: np.ndarray, radius_px: float) -> np.ndarray:
    """Returns the picture (height, width) blurred by a disc of even light of this radius, 1/8 px or more."""
    cells, reach = 8, int(np.ceil(radius_px + 0.5))
    if radius_px < 1 / cells:
        return picture
    offset = (np.arange((2 * reach + 1) * cells) + 0.5) / cells - reach - 0.5
    # A cell on the rim counts by its linear share, so that a small disc is one too.
    inside = np.clip((radius_px - np.hypot(offset, offset[:, None])) * cells + 0.5, 0, 1)
    kernel = inside.reshape(2 * reach + 1, cells, 2 * reach + 1, cells).sum((1, 3))
    return cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def defocused(
    shares: list[np.ndarray],  # (h, w), sharp image of each outline, by squares of which ``cells`` make a pixel's side
    planes: list[np.ndarray],  # (3,), a point of each plane near the disc, camera frame, mm
    normal: np.ndarray,  # (3,) of the planes, camera frame
    corner_px: tuple[int, int],  # pixel (x, y) in the corner of the images
    cells: int,
    camera: Camera,
    lens: ThinLens,
    blur_px: float,  # σ of the Gaussian blur that follows, which decides how many points of the lens are taken
    light: np.ndarray | None = None,  # (h, w) of the disc on the last plane; even if None
) -> np.ndarray:
    """Returns the out-of-focus image of a flat disc through apertures above it: the mean over the lens. Through a point
    p of the lens each plane is seen as by a pinhole, but moved by p (1/z_f − 1/Z), an affine map, 1/Z being linear in
    the image. Lens distortion is linear across the disc: off by < 1e-3 of the circle of confusion."""
    widest = max(float(lens.confusion_px(camera, point[2])) for point in planes)
    at_lens, weights = lens.points(widest, blur_px)
    base = np.array(corner_px) - 0.5 + 0.5 / cells  # pixel of the first square
    moves = []
    for point in planes:
        ideal = point[:2] / point[2]
        distorted, jacobian = camera.distort_jacobian(ideal)
        pixel_from_ideal = camera.focal[:, None] * jacobian
        pixel = camera.focal * distorted + camera.centre
        gradient = normal[:2] / (normal @ point)
        moved = at_lens @ pixel_from_ideal.T / (1 - at_lens @ gradient)[:, None]
        slope = gradient @ np.linalg.inv(pixel_from_ideal)
        # The factor 1/z_f − 1/Z at the first square, and its change from square to square.
        factor = 1 / lens.focus_mm - 1 / point[2] - slope @ (base - pixel)
        maps = np.zeros((len(moved), 2, 3))
        maps[:, :, :2] = np.eye(2) + moved[:, :, None] * slope
        maps[:, :, 2] = -moved * factor * cells
        moves.append(maps)
    mean = np.zeros_like(shares[0])
    for i, weight in enumerate(weights):
        share = np.minimum.reduce([_moved(share, maps[i]) for share, maps in zip(shares, moves, strict=True)])
        mean += np.float32(weight) * (share if light is None else share * _moved(light, moves[-1][i]))
    return mean


def _moved(share: np.ndarray, source_from_square: np.ndarray) -> np.ndarray:
    """Returns the image at places that an affine map (2, 3) gives; cv2 rounds these to 1/32 square."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(share, source_from_square, share.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


DARKEST = 1e-3  # least grey value, as a share of white. The photograph holds no information below.
FULL_WELL, READ_NOISE = 10_000.0, 8.0
"""Electrons of a sensor at full scale, whose shot noise is the root of their number, and read noise in electrons."""


@dataclass(frozen=True, slots=True)
class Light:
    """Light on a scene in addition to the light in its photograph; places and radii in image widths."""

    stops: float = 0.0  # gradient in powers of two per width of the image
    angle_rad: float = 0.0  # direction of the gradient
    pivot: tuple[float, float] = (0.5, 0.5)  # (x, y) at which the light is unchanged
    glare: float = 0.0  # light added in the middle of a spot, in units of the photograph's white
    glare_at: tuple[float, float] = (0.5, 0.5)
    glare_radius: float = 0.1  # of a Gaussian


def expose(
    photograph: np.ndarray, times: Sequence[float], light: Light | None = None, seed: int = 0
) -> list[np.ndarray]:
    """Exposes the scene of an 8-bit photograph (height, width) at other times; time 1 keeps its brightness. Saturated
    pixels of the photograph count as white. The exposures' noise is independent."""
    if photograph.dtype != np.uint8 or photograph.ndim != 2:
        kind = f"{photograph.dtype} of shape {photograph.shape}"
        raise InputError("E-IMAGE-TYPE", f"photograph: {kind}; 8-bit grey needed")
    if not all(time > 0 for time in times):
        raise InputError("E-EXPOSURES-VALUE", "exposure times: positive numbers needed")
    rng, exposures = np.random.default_rng(seed), []
    # The light within one grey level is unknown. It is spread evenly, or a darker exposure would show the levels.
    grey = (photograph + rng.random(photograph.shape, np.float32)) / np.float32(256)
    scene, light = np.maximum(grey, np.float32(DARKEST)), light or Light()
    height, width = scene.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) / width, np.arange(height, dtype=np.float32) / width)
    if light.stops:
        towards = np.float32(np.cos(light.angle_rad)), np.float32(np.sin(light.angle_rad))
        along = (x - np.float32(light.pivot[0])) * towards[0] + (y - np.float32(light.pivot[1])) * towards[1]
        scene = scene * np.exp2(np.float32(light.stops) * along)
    if light.glare:
        squared_distance = (x - np.float32(light.glare_at[0])) ** 2 + (y - np.float32(light.glare_at[1])) ** 2
        scene = scene + np.float32(light.glare) * np.exp(-squared_distance / np.float32(2 * light.glare_radius**2))
    for time in times:
        electrons = scene * np.float32(time * FULL_WELL)
        noise = np.sqrt(electrons + np.float32(READ_NOISE**2)) * rng.standard_normal(scene.shape, np.float32)
        exposures.append(np.rint(255 * np.clip((electrons + noise) / np.float32(FULL_WELL), 0, 1)).astype(np.uint8))
    return exposures
