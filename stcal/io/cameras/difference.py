"""Difference between two cameras: distances of their pixels for the same rays, after the best rotation."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.align import align_rigid
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid

CELLS = 24
"""Number of grid points along the shorter side of the image."""
STEPS, STEP_RAD = 10, 1e-6
LEAST_POINTS = 10


@dataclass(frozen=True, slots=True, eq=False)
class CameraDifference:
    """The difference between two cameras over the image.

    ``pixels`` : (r, c, 2) of the first camera; ``apart`` : (r, c, 2) px, offsets of the second camera's pixels for the
    same rays, nan where one of the cameras has no ray; ``second_from_first`` : the best rotation.
    """

    pixels: np.ndarray
    apart: np.ndarray
    second_from_first: Rigid

    def lengths(self) -> np.ndarray:
        """Return the lengths (r, c) of the offsets, px."""
        return np.linalg.norm(self.apart, axis=2)


def camera_difference(one: Camera, two: Camera) -> CameraDifference:
    """Return the difference between two cameras over the image.

    Images that differ by a rotation of the camera count as equal: it acts like a shift of the principal point.

    Parameters
    ----------
    one, two : Camera
        Cameras of the same image size.

    Raises
    ------
    InputError
        The image sizes differ.
    DegenerateError
        Too few pixels have a ray in both cameras.
    """
    if (one.width, one.height) != (two.width, two.height):
        raise InputError(
            "E-CAMERA-SIZES-DIFFER",
            f"cameras of {one.width}×{one.height} and {two.width}×{two.height} px; files of one image size needed",
        )
    pixels = image_grid(one)
    flat = pixels.reshape(-1, 2)
    first, second = rays(one, flat), rays(two, flat)
    good = np.isfinite(first).all(1) & np.isfinite(second).all(1)
    if good.sum() < LEAST_POINTS:
        raise DegenerateError(
            "E-CAMERA-NO-RAYS", f"{good.sum()} of {len(flat)} pixels have a ray in both cameras, {LEAST_POINTS} needed"
        )
    unit = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in (first[good], second[good])]
    turn = Rigid(align_rigid(unit[1], unit[0]).rotation, np.zeros(3))
    for _ in range(STEPS):
        offset = two.project(turn @ first[good]) - flat[good]
        rotations = [Rigid.exp([*step, 0, 0, 0]) @ turn for step in STEP_RAD * np.eye(3)]
        slope = (
            np.stack([two.project(rotated @ first[good]) - flat[good] - offset for rotated in rotations], axis=2)
            / STEP_RAD
        )
        step = -np.linalg.lstsq(slope.reshape(-1, 3), offset.ravel())[0]
        turn = Rigid.exp([*step, 0, 0, 0]) @ turn
        if np.abs(step).max() < STEP_RAD**2:
            break
    apart = np.full(flat.shape, np.nan)
    apart[good] = two.project(turn @ first[good]) - flat[good]
    return CameraDifference(pixels, apart.reshape(pixels.shape), turn)


def image_grid(camera: Camera) -> np.ndarray:
    """Return a grid of pixels (r, c, 2) over the image, edges included."""
    count = max(round(CELLS * camera.width / camera.height), 2), CELLS
    x, y = (np.linspace(-0.5, side - 0.5, n) for side, n in zip((camera.width, camera.height), count, strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1)


def rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the rays (n, 3) with z = 1 of pixels (n, 2); nan where the lens has none."""
    try:
        return np.column_stack([camera.normalised_from_pixel(pixels), np.ones(len(pixels))])
    except ConvergenceError:
        if len(pixels) == 1:
            return np.full((1, 3), np.nan)
        half = len(pixels) // 2
        return np.concatenate([rays(camera, pixels[:half]), rays(camera, pixels[half:])])
