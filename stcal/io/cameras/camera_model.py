"""Camera models from the parameters of COLMAP or OpenCV, each with its pixel origin; and writing of ``cameras.txt``.

:mod:`stcal.io.cameras.read` reads the files.
"""

import warnings
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.errors import InputError, InputNote, named
from stcal.geometry.arrays import ByValue, CovarianceRows, require_covariance, require_fields
from stcal.geometry.camera import (
    COLMAP_LAYOUT,
    COLMAP_PIXEL_ORIGIN,
    FISHEYE,
    MAX_SIDE_PX,
    PARAMETER_NAMES,
    Camera,
    intrinsic_basis,
    not_in_pixels,
    opencv_lens,
    require_lens,
)

SIGMA, CORRELATION = "# SIGMA[]", "# CORRELATION[]"
"""Beginnings of the comments of ``cameras.txt`` that state the uncertainty of its parameters."""
SQUARE_WITHIN = 1e-6  # largest deviation from 1 of the correlation of a parameter with itself
EQUIDISTANT = ("equidistant", "fisheye", "kannala_brandt")
"""Names of ``distortion_model`` for OpenCV's fisheye."""
OF_IMAGES = "the images"
"""Source of a camera that is found from the images themselves, of which some may show a part of the sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel(ByValue):
    """A camera as its file states it: a :class:`Camera`, but ``width`` and ``height`` are None if the file states
    none. ``colmap_model`` : the COLMAP model that represents it exactly; ``covariance`` : (q, q) of that model's
    parameters."""

    focal: np.ndarray
    centre: np.ndarray
    distortion: np.ndarray
    colmap_model: str
    width: int | None
    height: int | None
    source: str
    covariance: np.ndarray | None = None

    def sized(self, width: int, height: int) -> Camera:
        """Return the camera; the arguments give the size if the file does not state it."""
        size = self.width or width, self.height or height
        fisheye = FISHEYE in self.colmap_model
        return Camera(*size, self.focal, self.centre, self.distortion, fisheye, self.colmap_model)

    def calibrated(self, width: int, height: int) -> Camera:
        """Return the camera of :meth:`sized` with its covariance."""
        return replace(self.sized(width, height), covariance=self.covariance)

    def of_video(self, width: int, height: int) -> "CameraModel":
        """Return the camera of pictures of this size: itself, unless the last row or column of an odd number is
        missing, which writers of videos drop; an :class:`InputNote` says so."""
        stated = self.width or width, self.height or height
        if (width, height) == stated or (width, height) != tuple(side // 2 * 2 for side in stated):
            return self
        warnings.warn(
            f"pictures of {width}×{height} px, a camera of {stated[0]}×{stated[1]}: the last row or column of an odd "
            "number is taken as dropped, as video does; if the pictures were resized instead, poses are off",
            InputNote,
            stacklevel=2,
        )
        return replace(self, width=width, height=height)

    def require_inside(self, width: int, height: int, image: str) -> None:
        """Refuse an image without the principal point: a file that states no size may belong to another camera."""
        x, y = self.centre
        if self.source != OF_IMAGES and not (0 < x < width and 0 < y < height):
            where = f"principal point ({x:.0f}, {y:.0f}) px is outside of {image} ({width}×{height} px)"
            remedy = "use the camera file that belongs to the images"
            raise InputError("E-CAMERA-CENTRE", f"camera file {self.source}: {where}; {remedy}")


def model_of(camera: Camera, source: str = "camera") -> CameraModel:
    """Return a camera of known size as a file would state it; ``source`` : where it is from, for messages."""
    lens = camera.focal, camera.centre, camera.distortion
    return CameraModel(*lens, camera.colmap_model, camera.width, camera.height, source, camera.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class CameraPrior(ByValue):
    """A prior of the intrinsics, as :func:`stcal.camera_prior` returns it.

    Parameters
    ----------
    colmap_model : COLMAP's name of the lens's model.
    covariance : (q, q) array. Covariance of the model's parameters, in its order.
    """

    colmap_model: str
    covariance: np.ndarray

    def __post_init__(self):
        require_fields(self, "prior of the camera")


WITHOUT_DISTORTION = ("SIMPLE_PINHOLE", "PINHOLE")
PRIOR_FOCAL = 1e-3
"""Relative σ of the focal lengths if the camera file states none; these four are as of a calibration of weeks ago."""
PRIOR_CENTRE = 2e-3  # σ of the principal point if the camera file states none, in image widths
PRIOR_RADIAL = 0.01
"""σ of k1 … k6 if the camera file states none; a tenth of the coefficient if that is larger."""
PRIOR_TANGENTIAL = 1e-3  # σ of p1, p2, s1 … s4 if the camera file states none


def camera_prior(camera: Camera) -> CameraPrior:
    """Return a prior of the intrinsics, for hand-eye: the camera's covariance, or that of an old calibration.

    Parameters
    ----------
    camera : From :func:`stcal.load_camera` or :meth:`stcal.Camera.from_opencv`.
    """
    if camera.covariance is not None:
        return CameraPrior(camera.colmap_model, camera.covariance)
    radial = np.maximum(PRIOR_RADIAL, 0.1 * np.abs(camera.distortion))
    radial[[2, 3, 8, 9, 10, 11]] = PRIOR_TANGENTIAL
    flat = np.concatenate([PRIOR_FOCAL * camera.focal, [PRIOR_CENTRE * camera.width] * 2, radial])
    first = intrinsic_basis(camera.colmap_model).argmax(0)
    return CameraPrior(camera.colmap_model, np.diag(flat[first] ** 2))


def refinable(camera: Camera) -> Camera:
    """Return the camera with the model to refine: OPENCV where its file says nothing of distortion."""
    if camera.covariance is None and camera.colmap_model in WITHOUT_DISTORTION:
        return replace(camera, colmap_model="OPENCV")
    return camera


def cameras_txt(camera: Camera) -> str:
    """Return ``cameras.txt`` with one camera of id 1; σ and correlations of its parameters as comments."""
    params, covariance = " ".join(map(repr, camera.colmap_params())), camera.covariance
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (centre of the first pixel at 0.5, 0.5)"]
    if covariance is not None:
        sigma = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(sigma, sigma)
        lines.append(f"{SIGMA} {' '.join(repr(float(s)) for s in sigma)}")
        lines += [f"{CORRELATION} {' '.join(repr(float(c)) for c in row)}" for row in correlation]
    lines.append(f"1 {camera.colmap_model} {camera.width} {camera.height} {params}")
    return "\n".join(lines) + "\n"


def stated_covariance(text: str, names: list[str]) -> np.ndarray | None:
    """Return the covariance (q, q) in the comments of :func:`cameras_txt`; None if there are none."""
    lines, count = text.splitlines(), len(names)
    sigmas, rows = ([line.split()[2:] for line in lines if line.startswith(key)] for key in (SIGMA, CORRELATION))
    if not sigmas and not rows:
        return None
    try:
        if list(map(len, sigmas)) != [count] or list(map(len, rows)) != [count] * count:
            raise InputError("E-CAMERA-COVARIANCE", f"a line of {count} σ and {count}×{count} correlations needed")
        sigma, correlation = np.array(sigmas[0], float), np.array(rows, float)
        for name, of_name, with_itself in zip(names, sigma, np.diagonal(correlation), strict=True):
            # the covariance hides such errors
            if not 0 < of_name <= MAX_SIDE_PX or not abs(with_itself - 1) <= SQUARE_WITHIN:
                measured = f"σ of {name} is {of_name:g}, its correlation with itself {with_itself:g}"
                needed = f"a positive number up to {MAX_SIDE_PX}, and 1 needed"
                raise InputError("E-CAMERA-COVARIANCE", f"{measured}; {needed}")
        covariance = correlation * np.outer(sigma, sigma)
        require_covariance(covariance, count, CovarianceRows(tuple(names)), definite=True)
    except (InputError, ValueError) as error:
        none = f"SIGMA and CORRELATION state no covariance of its parameters: {error}"
        raise InputError("E-CAMERA-COVARIANCE", f"{none}; write it again, or remove these comments") from error
    return covariance


LEAST_FOCAL = {False: 0.1, True: 0.05}
"""Smallest focal length over the longer side, by whether the lens is a fisheye; lengths in mm are shorter."""
LEAST_FOCAL_PX = 5.0
"""Smallest focal length, px: shares of a side, which files without a size have, are shorter."""
AT_CORNER = 0.02
"""Share of each side within which a principal point is at the image's corner, as one relative to the middle is."""


def camera_model(flat: np.ndarray, colmap_model: str, width, height) -> CameraModel:
    """Return the camera of :data:`PARAMETER_NAMES`, of which the last ones may be missing."""
    flat = np.pad(flat, (0, len(PARAMETER_NAMES) - len(flat)))
    require_lens(flat, width, height)
    longer = max(width, height) if width and height else 2 * float(flat[2:4].max())
    if flat[:2].max() < max(LEAST_FOCAL[FISHEYE in colmap_model] * longer, LEAST_FOCAL_PX):
        raise not_in_pixels(flat, width, height)
    if width and height and (np.abs(flat[2:4]) < AT_CORNER * np.array([width, height])).all():
        fault = f"principal point ({flat[2]:g}, {flat[3]:g}) px is at the corner of {width:g}×{height:g} px"
        remedy = "pixels from the image's corner needed; check that they are not from its middle"
        raise InputError("E-CAMERA-CENTRE", f"{fault}; {remedy}")
    width, height = (None if side is None else int(side) for side in (width, height))
    return CameraModel(flat[:2], flat[2:4], flat[4:], colmap_model, width, height, "")


def camera_from_colmap(colmap_model: str, width: float, height: float, params, source: str | Path = "") -> CameraModel:
    """Return the camera of COLMAP's ``params``, in its order and pixel origin; ``source`` : file, for messages."""
    with named(f"camera file {source}") if source else nullcontext():
        if colmap_model not in COLMAP_LAYOUT:
            known = ", ".join(COLMAP_LAYOUT)
            raise InputError("E-CAMERA-MODEL", f"model {colmap_model} is not supported; use one of {known}")
        basis = intrinsic_basis(colmap_model)
        if len(params) != basis.shape[1]:
            fault = f"{len(params)} parameters of {colmap_model}"
            raise InputError("E-CAMERA-COEFFICIENTS", f"{fault}, {basis.shape[1]} needed")
        flat = np.where(basis.any(axis=1), np.array(params, float)[basis.argmax(axis=1)], 0.0)
        flat[2:4] -= COLMAP_PIXEL_ORIGIN
        return replace(camera_model(flat, colmap_model, width, height), source=str(source))


def camera_from_opencv(
    lens, given: np.ndarray, fisheye: bool, width: float, height: float, tangential: bool = False
) -> CameraModel:
    """Return the camera of fx, fy, cx, cy, px, and OpenCV's coefficients (k,); 0 for sides that are not stated."""
    distortion, kind = opencv_lens(given, fisheye, tangential)
    return camera_model(np.concatenate([lens, distortion]), kind, width or None, height or None)
