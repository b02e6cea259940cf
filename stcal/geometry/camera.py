"""The camera: projection with lens distortion and its exact inverse. Pixel centres are integers (OpenCV)."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import ConvergenceError, InputError
from stcal.geometry.arrays import Array, freeze

MAX_NEWTON_STEPS = 50
UNDISTORT_TOLERANCE = 1e-12
"""Largest error of the inverse distortion, in normalised coordinates (1e-8 px at f = 10 000 px)."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A central camera with OpenCV's rational lens model (the first eight coefficients).

    Parameters
    ----------
    width, height : int
        Image size, px.
    focal : (2,) array
        fx, fy, px.
    centre : (2,) array
        cx, cy, px, centre of the top-left pixel at (0, 0).
    distortion : (8,) array
        k1, k2, p1, p2, k3, k4, k5, k6 in OpenCV's order; COLMAP's FULL_OPENCV is the same model.
    """

    width: int
    height: int
    focal: Array
    centre: Array
    distortion: Array

    def __post_init__(self):
        freeze(self, "focal", (2,), "focal length")
        freeze(self, "centre", (2,), "principal point")
        freeze(self, "distortion", (8,), "distortion")
        if (self.focal <= 0).any():
            raise InputError(f"camera: focal length {self.focal.tolist()} px, positive numbers needed")
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: size {self.width}×{self.height} px, a positive size needed")

    def same_as(self, other: "Camera") -> bool:
        """Whether all numbers are equal."""
        size = (self.width, self.height) == (other.width, other.height)
        return size and bool((self.parameters() == other.parameters()).all())

    def parameters(self) -> np.ndarray:
        """fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, (12,)."""
        return np.concatenate([self.focal, self.centre, self.distortion])

    def with_parameters(self, parameters: np.ndarray) -> "Camera":
        """The camera of the same size with other :meth:`parameters`."""
        return Camera(self.width, self.height, parameters[:2], parameters[2:4], parameters[4:])

    def parameter_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """Derivative (n, 2, 12) of the pixels of ideal normalised coordinates (n, 2) by :meth:`parameters`."""
        k1, k2, _, _, k3, k4, k5, k6 = self.distortion
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        powers = np.stack([r2, r2**2, r2**3], axis=1)
        jacobian = np.zeros((len(xy), 2, 12))
        jacobian[:, [0, 1], [0, 1]] = self.distort(xy)
        jacobian[:, [0, 1], [2, 3]] = 1
        jacobian[:, :, [4, 5, 8]] = xy[:, :, None] * (powers / bottom[:, None])[:, None]
        jacobian[:, :, [9, 10, 11]] = -xy[:, :, None] * (powers * (top / bottom**2)[:, None])[:, None]
        jacobian[:, :, 6] = np.stack([2 * x * y, r2 + 2 * y * y], axis=1)
        jacobian[:, :, 7] = np.stack([r2 + 2 * x * x, 2 * x * y], axis=1)
        jacobian[:, :, 4:] *= self.focal[:, None]
        return jacobian

    def distort(self, xy: np.ndarray) -> np.ndarray:
        """Distort.

        Parameters
        ----------
        xy : (..., 2) array
            Ideal normalised coordinates.

        Returns
        -------
        (..., 2) array
            Distorted normalised coordinates.
        """
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        top, bottom = self._radial(r2)
        return np.stack(self._moved(x, y, r2, top / bottom), axis=-1)

    def distort_jacobian(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distort, with the derivative.

        Parameters
        ----------
        xy
            As of :meth:`distort`, which returns the first.

        Returns
        -------
        distorted : (..., 2) array
        jacobian : (..., 2, 2) array
            Their derivative by the ideal ones.
        """
        xy = np.asarray(xy, float)
        distorted, jacobian = np.empty(xy.shape), np.empty((*xy.shape, 2))
        distorted[..., 0], distorted[..., 1], by_x, cross, by_y = self._distorted_parts(xy[..., 0], xy[..., 1])
        jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 1, 0], jacobian[..., 1, 1] = by_x, cross, cross, by_y
        return distorted, jacobian

    def _distorted_parts(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Distorted x and y, and their derivatives: x by x, one by the other, y by y; all (...)."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self.distortion.tolist()
        r2 = x * x + y * y
        top, bottom = self._radial(r2)
        radial = top / bottom
        by_r2 = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / bottom
        return (
            *self._moved(x, y, r2, radial),
            radial + 2 * x * x * by_r2 + 2 * p1 * y + 6 * p2 * x,
            2 * x * y * by_r2 + 2 * p1 * x + 2 * p2 * y,
            radial + 2 * y * y * by_r2 + 6 * p1 * y + 2 * p2 * x,
        )

    def _radial(self, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Top and bottom, (...), of the factor by which the rational model moves points outwards; ``r2`` : (...)."""
        k1, k2, _, _, k3, k4, k5, k6 = self.distortion.tolist()
        return 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))

    def _moved(self, x, y, r2, radial) -> tuple[np.ndarray, np.ndarray]:
        """Distorted x and y, (...)."""
        p1, p2 = self.distortion[2:4].tolist()
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def undistort(self, xy_distorted: np.ndarray) -> np.ndarray:
        """Inverse of :meth:`distort` by Newton's method to 1e-12.

        Raises
        ------
        ConvergenceError
            Where the distortion model folds over, so that no inverse exists, or for coordinates that are not finite.
        """
        target = np.asarray(xy_distorted, float)
        if not self.distortion.any():
            return target.copy()
        if not np.isfinite(target).all():
            raise ConvergenceError("camera: a pixel to undistort is not finite; finite coordinates needed")
        x, y = start_x, start_y = target[..., 0].copy(), target[..., 1].copy()
        steps = 0
        with np.errstate(over="ignore", invalid="ignore"):  # where it diverges; reported below
            while True:
                now_x, now_y, by_x, cross, by_y = self._distorted_parts(x, y)
                off_x, off_y = now_x - start_x, now_y - start_y
                det = by_x * by_y - cross * cross
                done = np.maximum(np.abs(off_x), np.abs(off_y)) < UNDISTORT_TOLERANCE
                steps += 1
                if done.all() or steps == MAX_NEWTON_STEPS:
                    break
                safe = np.where(np.abs(det) > 1e-9, det, 1e-9)
                x, y = x - (by_y * off_x - cross * off_y) / safe, y - (by_x * off_y - cross * off_x) / safe
        # Beyond the fold Newton can end on a mirrored branch: an inverse has a positive definite derivative.
        good = done & (det >= 0) & (by_x + by_y > 0)
        if good.all():
            return np.stack([x, y], axis=-1)
        worst = np.unravel_index(np.argmin(good), good.shape)
        at = self.focal * target[worst] + self.centre
        raise ConvergenceError(
            f"camera: no undistorted point for pixel ({at[0]:.0f}, {at[1]:.0f}); "
            "the distortion coefficients fold the image over there, check them"
        )

    def pixel_from_normalised(self, xy: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of ideal normalised coordinates (..., 2), lens distortion applied."""
        return self.distort(xy) * self.focal + self.centre

    def normalised_from_pixel(self, xy_px: np.ndarray) -> np.ndarray:
        """Ideal normalised coordinates (..., 2) of pixels (..., 2), lens distortion removed."""
        return self.undistort((np.asarray(xy_px, float) - self.centre) / self.focal)

    def project(self, xyz_camera: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) in the camera frame."""
        xyz = np.asarray(xyz_camera, float)
        return self.pixel_from_normalised(xyz[..., :2] / xyz[..., 2:])
