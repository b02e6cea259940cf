"""Difference between two cameras, and the fit of a supported camera model to a lens of another model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from stcal.errors import DegenerateError, InputError, named
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import FISHEYE, WIDEST_RAD, Camera, intrinsic_basis, parameter_names
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.foreign_lenses import ForeignLens
from stcal.io.cameras.read import camera_of_photograph, is_photograph, read_lens, sized_camera

CELLS = 24  # number of grid points along the shorter side of the image
STEPS, STEP_RAD = 10, 1e-6
LONGEST_RAD = 0.1  # longest step of Newton's method for a ray
MET_PX = 1e-6  # largest distance between a pixel and the projection of its ray
LEAST_POINTS = 10


@dataclass(frozen=True, slots=True, eq=False)
class CameraDifference:
    """The difference between two cameras over the image: ``pixels`` (r, c, 2) of the first one; for the same rays,
    offsets ``apart`` (r, c, 2) px of the second one's, nan where one has none; and the best rotation between them."""

    pixels: np.ndarray
    apart: np.ndarray
    second_from_first: Rigid

    def lengths(self) -> np.ndarray:
        """Return the lengths (r, c) of the offsets, px."""
        return np.linalg.norm(self.apart, axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class FittedLens:
    """A lens of an unsupported model over an image, the camera that was fitted to it, and its RMS and largest residual
    where the lens was determined. ``share`` : of the azimuths in which that ends within 89° of the axis;
    ``camera_from_lens`` : the rotation of the camera's axes, the identity unless it helps much."""

    lens: ForeignLens
    camera: Camera
    rms_px: float
    most_px: float
    share: float
    camera_from_lens: Rigid

    def project(self, rays: np.ndarray) -> np.ndarray:
        """Return the pixels (n, 2) of rays (n, 3)."""
        return self.lens.project(rays)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Return the unit rays (n, 3) of pixels (n, 2) by Newton's method; nan where there is none."""
        unit = self.camera_from_lens.inverse() @ rays(self.camera, pixels)
        unit /= np.linalg.norm(unit, axis=1)[:, None]
        for _ in range(STEPS):
            off = self.project(unit) - pixels
            aside = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit), axis=1)])
            aside /= np.linalg.norm(aside, axis=1)[:, None]
            sides = np.stack([aside, np.cross(unit, aside)], axis=1)
            slope = np.stack([self.project(unit + STEP_RAD * sides[:, i]) - self.project(unit) for i in (0, 1)], axis=2)
            good = np.isfinite(off).all(1) & (np.abs(np.linalg.det(np.nan_to_num(slope))) > 0)
            step = np.zeros((len(unit), 2))
            step[good] = -STEP_RAD * np.linalg.solve(slope[good], off[good, :, None])[..., 0]
            step *= np.minimum(1, LONGEST_RAD / np.maximum(np.linalg.norm(step, axis=1), LONGEST_RAD))[:, None]
            unit = unit + (step[:, :, None] * sides).sum(axis=1)
            unit /= np.linalg.norm(unit, axis=1)[:, None]
        met = np.linalg.norm(self.project(unit) - pixels, axis=1) < MET_PX
        return np.where((met & self.lens.determined(pixels))[:, None], unit, np.nan)


@require_arguments
def compare_cameras(one: Camera | FittedLens, two: Camera | FittedLens) -> CameraDifference:
    """Return how many pixels apart two cameras see the same ray, after the turn that brings them nearest.

    Images that differ by a rotation of the camera count as equal: it acts like a shift of the principal point.

    Parameters
    ----------
    one, two : Cameras of the same image size. Of a lens with a region only this is compared.

    Raises DegenerateError: too few pixels have a ray in both cameras.
    """
    a, b = (each.camera if isinstance(each, FittedLens) else each for each in (one, two))
    if (a.width, a.height) != (b.width, b.height):
        fault = f"cameras of {a.width}×{a.height} and {b.width}×{b.height} px"
        raise InputError("E-CAMERA-SIZES-DIFFER", f"{fault}; files of one image size needed")
    pixels = image_grid(a)
    flat = pixels.reshape(-1, 2)
    first, second = (each.rays(flat) if isinstance(each, FittedLens) else rays(each, flat) for each in (one, two))
    good = np.isfinite(first).all(1) & np.isfinite(second).all(1)
    if good.sum() < LEAST_POINTS:
        fault = f"{good.sum()} of {len(flat)} pixels have a ray in both cameras"
        raise DegenerateError("E-CAMERA-NO-RAYS", f"{fault}, {LEAST_POINTS} needed")
    unit = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in (first[good], second[good])]
    near = Rigid(align_rigid(unit[1], unit[0]).rotation, np.zeros(3))

    def turned(step: np.ndarray) -> Rigid:
        return Rigid.exp([*step, 0, 0, 0]) @ near

    def off(step: np.ndarray) -> np.ndarray:
        return (two.project(turned(step) @ first[good]) - flat[good]).ravel()

    turn = turned(least_squares(off, np.zeros(3), diff_step=STEP_RAD, method="lm", xtol=SETTLED, ftol=SETTLED).x)
    apart = np.full(flat.shape, np.nan)
    seen = two.project(turn @ first[good])
    if isinstance(two, FittedLens):
        seen = np.where(two.lens.determined(seen)[:, None], seen, np.nan)
    apart[good] = seen - flat[good]
    return CameraDifference(pixels, apart.reshape(pixels.shape), turn)


def image_grid(camera: Camera) -> np.ndarray:
    """Return a grid of pixels (r, c, 2) over the image, edges included."""
    count = max(round(CELLS * camera.width / camera.height), 2), CELLS
    x, y = (np.linspace(-0.5, side - 0.5, n) for side, n in zip((camera.width, camera.height), count, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1)


def rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the rays (n, 3) with z = 1 of pixels (n, 2); nan where the lens has none."""
    xy = camera.normalised_from_pixel(pixels, or_nan=True)
    return np.where(np.isfinite(xy[:, :1]), np.column_stack([xy, np.ones(len(xy))]), np.nan)


CANDIDATES = ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE")
"""Camera models that are tried, from few parameters to many, perspective and equidistant."""
AS_GOOD_PX = 1e-3
"""Reduction of the largest residual, in px, that a model with more parameters must reach to be preferred."""
AZIMUTHS, RADII, FIT_STEPS = 72, 40, 1000
"""Numbers of azimuths of the rays, of radii along each, and of steps in the search for the edge of the image."""
BEYOND = 0.01
"""Share of the image's size by which rays extend beyond the edge, so that they enclose the whole image."""
FAR_PX = 1e6  # residual, in px, where the fitted lens projects a ray to no pixel
MOST_STEPS, SETTLED = 200, 1e-14
GOOD_PX = 0.05
"""Largest residual, px, of a fit that needs no turn: a turned camera has other axes, which its user must know of."""
TURN_HELPS = 0.5  # share of the RMS residual to which a turn of the camera must bring it down
HALF = 0.5  # largest share by which a focal length may shrink in the fit
SMALL = 1e-6
"""Step about the axis, in normalised coordinates, from which the initial focal lengths are computed."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedLens:
    """The lens of a file: the camera, or another model's lens; ``told`` : what a photograph's EXIF says of it."""

    lens: Camera | FittedLens
    told: str = ""

    @property
    def camera(self) -> Camera:
        """The camera; of a lens of another model the one that was fitted to it."""
        return self.lens if isinstance(self.lens, Camera) else self.lens.camera

    @property
    def fitted(self) -> FittedLens | None:
        """Quality of the fit, None where the file's model is supported."""
        return None if isinstance(self.lens, Camera) else self.lens


@require_arguments
def load_lens(path: str | Path, name: str = "", size: tuple[int, int] | None = None) -> LoadedLens:
    """Load a camera from a file also of a model that is not supported, to which one is fitted, or from EXIF.

    Parameters
    ----------
    path : Camera file as of :func:`stcal.load_camera`, of any model, or a photograph.
    name : Name of the camera in a file of several, such as ``cam1``.
    size : (int, int). Width and height of the images, px, for a file that does not state them.

    Raises InputError: the file is missing or malformed, holds more than one camera, or no size is known.
    Raises ConvergenceError, DegenerateError: no supported model comes near the lens.
    """
    if is_photograph(path):
        return LoadedLens(*camera_of_photograph(path))
    lens, (across, up) = read_lens(path, name), size or (0, 0)
    width, height = lens.width or across, lens.height or up
    if isinstance(lens, CameraModel) or not (width and height):
        return LoadedLens(sized_camera(lens, path, (width, height)))
    with named(f"camera file {path}"):
        return LoadedLens(fit_lens(lens, width, height))


def fit_lens(lens: ForeignLens, width: int, height: int) -> FittedLens:
    """Return the supported camera model that is nearest to a lens over an image of this size, px."""
    rays, pixels, share = _rays(lens, width, height)

    def best(turn: bool) -> FittedLens:
        fits = []
        for model in CANDIDATES:
            camera, from_lens = _fitted(model, rays, pixels, lens, (width, height), turn)
            off = np.linalg.norm(camera.project(from_lens @ rays) - pixels, axis=1)
            if not fits or not off.max() > fits[-1].most_px - AS_GOOD_PX:
                figures = float(np.sqrt((off**2).mean())), float(off.max()), share
                fits.append(FittedLens(lens, camera, *figures, from_lens))
        return fits[-1]

    straight = best(turn=False)
    if straight.most_px <= GOOD_PX:
        return straight
    turned = best(turn=True)
    return turned if turned.rms_px < TURN_HELPS * straight.rms_px else straight


def _rays(lens: ForeignLens, width: int, height: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return rays (n, 3) with z = 1 spread evenly over the image, their pixels (n, 2), and :attr:`FittedLens.share`."""
    angle = np.linspace(0, WIDEST_RAD, FIT_STEPS + 1)[1:]
    far = np.array([width, height]) * BEYOND
    centre = lens.project(np.array([[0.0, 0.0, 1.0]]))[0]
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [width, height] - 0.5 - centre
    around = np.concatenate([np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False), np.arctan2(*corners.T[::-1])])
    rays, pixels, ends = [], [], 0
    for azimuth in around:
        x, y = np.cos(azimuth) * np.tan(angle), np.sin(azimuth) * np.tan(angle)
        rays_of_azimuth = np.column_stack([x, y, np.ones(FIT_STEPS)])
        pixels_of_azimuth = lens.project(rays_of_azimuth)
        radius = np.linalg.norm(pixels_of_azimuth - centre, axis=1)
        off = np.abs(pixels_of_azimuth - (np.array([width, height]) - 1) / 2)
        inside = (off <= np.array([width, height]) / 2 + far).all(axis=1) & lens.determined(pixels_of_azimuth)
        grows = np.diff(radius, prepend=0) > 0  # beyond this radius the distortion folds over
        good = np.logical_and.accumulate(inside & grows)
        count = int(good.sum())
        ends += count < FIT_STEPS and bool(grows[count])
        if count:
            at = np.searchsorted(radius[:count], np.linspace(0, radius[count - 1], RADII + 1)[1:])
            rays.append(rays_of_azimuth[np.unique(np.minimum(at, count - 1))])
            pixels.append(pixels_of_azimuth[np.unique(np.minimum(at, count - 1))])
    if sum(map(len, rays)) < AZIMUTHS:
        raise InputError("E-CAMERA-NO-FIELD", f"{lens.called} projects hardly any point into {width}×{height} px")
    return np.concatenate(rays), np.concatenate(pixels), ends / len(around)


def _fitted(
    model: str, rays: np.ndarray, pixels: np.ndarray, lens: ForeignLens, size: tuple[int, int], turn: bool
) -> tuple[Camera, Rigid]:
    """Return the fitted model and the axes' turn; weights grow with the radius, as outer rays represent more area."""
    about = lens.project(np.array([[0, 0, 1], [SMALL, 0, 1], [0, SMALL, 1]]))
    focal = np.linalg.norm(about[1:] - about[0], axis=1) / SMALL
    start = Camera(*size, focal, about[0], np.zeros(12), FISHEYE in model)
    weight = np.sqrt(np.linalg.norm(pixels - about[0], axis=1, keepdims=True) / max(size))
    basis = intrinsic_basis(model)
    names = parameter_names(model)
    count = len(names)
    scale = np.array([focal[0] if name in ("fx", "fy", "cx", "cy") else 1.0 for name in names])

    def camera_at(x: np.ndarray) -> Camera:
        return start.with_parameters(start.parameters() + basis @ (x[:count] * scale))

    def turned(x: np.ndarray) -> Rigid:
        return Rigid.exp([*x[count:], 0, 0, 0]) if turn else Rigid()

    def off(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            away = weight * (camera_at(x).project(turned(x) @ rays) - pixels)
        return np.nan_to_num(away, nan=FAR_PX, posinf=FAR_PX, neginf=-FAR_PX).ravel()

    def slope(x: np.ndarray) -> np.ndarray:
        camera, xyz = camera_at(x), turned(x) @ rays
        with np.errstate(all="ignore"):
            derivatives = camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis * scale
            if turn:
                steps = [x + np.eye(len(x))[count + i] * STEP_RAD for i in range(3)]
                here = camera.project(xyz)
                by_turn = [(camera.project(turned(step) @ rays) - here) / STEP_RAD for step in steps]
                derivatives = np.concatenate([derivatives, np.stack(by_turn, axis=2)], axis=2)
        return np.nan_to_num((weight[:, :, None] * derivatives).reshape(-1, len(x)), posinf=0, neginf=0)

    lowest = np.array([-HALF if name in ("fx", "fy") else -np.inf for name in names] + [-np.inf] * 3 * turn)
    how: dict[str, Any] = {"jac": slope, "max_nfev": MOST_STEPS, **dict.fromkeys(("xtol", "ftol", "gtol"), SETTLED)}
    solution = least_squares(off, np.zeros(len(lowest)), bounds=(lowest, np.inf), x_scale="jac", **how)
    return Camera.of(camera_at(solution.x), model), turned(solution.x)
