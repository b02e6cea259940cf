"""The camera: projection with lens distortion and its exact inverse. Pixel centres are integers (OpenCV)."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import ConvergenceError, InputError
from stcal.geometry.arrays import Array, freeze

MAX_NEWTON_STEPS = 50
COEFFICIENTS = 12
"""Number of distortion coefficients."""
WIDEST_RAD = np.radians(89.0)
"""Largest angle from the axis that an equidistant camera may see: points of the plane Z = 1 are within 57 of it."""
NEAR_AXIS = 1e-8
"""Largest squared radius at which the series expansion is exact to rounding."""
UNDISTORT_TOLERANCE = 1e-12
"""Largest error of the inverse distortion, in normalised coordinates (1e-8 px at f = 10 000 px)."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A central camera with OpenCV's lens model and perspective or equidistant projection.

    Perspective: the ideal point (x, y) = (X, Y) / Z is distorted by OpenCV's rational model with thin prisms (its first
    twelve coefficients; COLMAP's FULL_OPENCV without prisms). Equidistant: the point is moved to the radius θ, its
    angle from the axis: (x, y) θ / r. It is then distorted by 1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸, p1, p2, s1 and s3
    (Kannala & Brandt 2006; OpenCV's fisheye; COLMAP's THIN_PRISM_FISHEYE). Only points at less than 90° from the axis
    are seen.

    Parameters
    ----------
    width, height : int
        Image size, px.
    focal : (2,) array
        fx, fy, px.
    centre : (2,) array
        cx, cy, px, centre of the top-left pixel at (0, 0).
    distortion : (12,) array
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 in OpenCV's order; or the first eight.
    fisheye : bool
        True for equidistant projection; k5, k6, s2 and s4 must then be 0.
    """

    width: int
    height: int
    focal: Array
    centre: Array
    distortion: Array
    fisheye: bool = False

    def __post_init__(self):
        freeze(self, "focal", (2,), "focal length")
        freeze(self, "centre", (2,), "principal point")
        if np.shape(self.distortion) == (8,):
            object.__setattr__(self, "distortion", np.pad(self.distortion, (0, 4)))
        freeze(self, "distortion", (COEFFICIENTS,), "distortion")
        if (self.focal <= 0).any():
            raise InputError(
                "E-CAMERA-FOCAL", f"camera: focal length {self.focal.tolist()} px, positive numbers needed"
            )
        if self.width < 1 or self.height < 1:
            raise InputError("E-CAMERA-SIZE", f"camera: size {self.width}×{self.height} px, a positive size needed")
        if self.fisheye and self.distortion[[6, 7, 9, 11]].any():
            raise InputError(
                "E-CAMERA-COEFFICIENTS", "camera: k5, k6, s2 or s4 of an equidistant camera, which has none; 0 needed"
            )

    def same_as(self, other: "Camera") -> bool:
        """Return True if size, projection and all parameters are equal."""
        kind = (self.width, self.height, self.fisheye) == (other.width, other.height, other.fisheye)
        return kind and bool((self.parameters() == other.parameters()).all())

    def parameters(self) -> np.ndarray:
        """Return fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, (16,)."""
        return np.concatenate([self.focal, self.centre, self.distortion])

    def coefficients(self) -> np.ndarray:
        """Return the distortion coefficients, (8,) if all prism terms are zero, else (12,)."""
        return self.distortion if self.distortion[8:].any() else self.distortion[:8]

    def with_parameters(self, parameters: np.ndarray) -> "Camera":
        """Return a camera of the same size and projection with these :meth:`parameters`."""
        return Camera(self.width, self.height, parameters[:2], parameters[2:4], parameters[4:], self.fisheye)

    def parameter_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 2, 16) of pixels by :meth:`parameters`, at ideal normalised coordinates (n, 2)."""
        jacobian = np.zeros((len(xy), 2, 4 + COEFFICIENTS))
        jacobian[:, [0, 1], [0, 1]] = self.distort(xy)
        jacobian[:, [0, 1], [2, 3]] = 1
        if self.fisheye:
            xy = _equidistant(xy)
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        top, bottom = self._radial(r2)
        powers = np.stack([r2, r2**2, r2**3], axis=1)
        jacobian[:, :, [4, 5, 8]] = xy[:, :, None] * (powers / bottom[:, None])[:, None]
        if self.fisheye:
            jacobian[:, :, 9] = xy * (r2**4)[:, None]
        else:
            jacobian[:, :, [9, 10, 11]] = -xy[:, :, None] * (powers * (top / bottom**2)[:, None])[:, None]
        jacobian[:, :, 6] = np.stack([2 * x * y, r2 + 2 * y * y], axis=1)
        jacobian[:, :, 7] = np.stack([r2 + 2 * x * x, 2 * x * y], axis=1)
        jacobian[:, 0, 12] = jacobian[:, 1, 14] = r2
        if not self.fisheye:
            jacobian[:, 0, 13] = jacobian[:, 1, 15] = r2 * r2
        jacobian[:, :, 4:] *= self.focal[:, None]
        return jacobian

    def distort(self, xy: np.ndarray) -> np.ndarray:
        """Apply the lens distortion to ideal normalised coordinates.

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
        if self.fisheye:
            xy = _equidistant(xy)
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        top, bottom = self._radial(r2)
        return np.stack(self._moved(x, y, r2, top / bottom), axis=-1)

    def distort_jacobian(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the lens distortion and return its derivative, too.

        Parameters
        ----------
        xy : (..., 2) array
            Ideal normalised coordinates.

        Returns
        -------
        distorted : (..., 2) array
            Result of :meth:`distort`.
        jacobian : (..., 2, 2) array
            Derivative of the distorted by the ideal coordinates.
        """
        xy = ideal = np.asarray(xy, float)
        if self.fisheye:
            xy = _equidistant(ideal)
        distorted, jacobian = np.empty(xy.shape), np.empty((*xy.shape, 2))
        distorted[..., 0], distorted[..., 1], *derivatives = self._distorted_parts(xy[..., 0], xy[..., 1])
        jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 1, 0], jacobian[..., 1, 1] = derivatives
        return distorted, jacobian @ _equidistant_jacobian(ideal) if self.fisheye else jacobian

    def _distorted_parts(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return distorted x and y, and their derivatives: x by x, x by y, y by x, y by y; all (...).

        For an equidistant camera ``x`` and ``y``, by which is differentiated, are the result of :func:`_equidistant`.
        """
        k1, k2, p1, p2, k3, k4, k5, k6, *prisms = self.distortion.tolist()
        r2 = x * x + y * y
        top, bottom = self._radial(r2)
        radial = top / bottom
        if self.fisheye:
            by_r2 = k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4))
        else:
            by_r2 = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / bottom
        cross = 2 * x * y * by_r2 + 2 * p1 * x + 2 * p2 * y
        x_by_y = y_by_x = cross
        x_by_x = radial + 2 * x * x * by_r2 + 2 * p1 * y + 6 * p2 * x
        y_by_y = radial + 2 * y * y * by_r2 + 6 * p1 * y + 2 * p2 * x
        if any(prisms):
            s1, s2, s3, s4 = prisms
            in_x, in_y = 2 * s1 + 4 * s2 * r2, 2 * s3 + 4 * s4 * r2
            x_by_x, x_by_y = x_by_x + in_x * x, cross + in_x * y
            y_by_x, y_by_y = cross + in_y * x, y_by_y + in_y * y
        return *self._moved(x, y, r2, radial), x_by_x, x_by_y, y_by_x, y_by_y

    def _radial(self, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return numerator and denominator, (...), of the radial distortion factor at squared radii ``r2`` (...)."""
        k1, k2, _, _, k3, k4, k5, k6 = self.distortion[:8].tolist()
        if self.fisheye:
            return 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))), np.ones_like(r2)
        return 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))

    def _moved(self, x, y, r2, radial) -> tuple[np.ndarray, np.ndarray]:
        """Return distorted x and y, (...), by radial factor, tangential terms and prisms."""
        p1, p2 = self.distortion[2:4].tolist()
        prisms = self.distortion[8:].tolist()
        moved_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        moved_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        if any(prisms):
            s1, s2, s3, s4 = prisms
            moved_x, moved_y = moved_x + r2 * (s1 + r2 * s2), moved_y + r2 * (s3 + r2 * s4)
        return moved_x, moved_y

    def undistort(self, xy_distorted: np.ndarray) -> np.ndarray:
        """Invert :meth:`distort` by Newton's method to 1e-12.

        Raises
        ------
        ConvergenceError
            Where the distortion model folds over, so that no inverse exists, or for coordinates that are not finite.
        """
        target = np.asarray(xy_distorted, float)
        if not self.distortion.any():
            return self._perspective(target.copy(), target)
        if not np.isfinite(target).all():
            raise ConvergenceError(
                "E-CAMERA-PIXEL", "camera: a pixel to undistort is not finite; finite coordinates needed"
            )
        x, y = start_x, start_y = target[..., 0].copy(), target[..., 1].copy()
        steps = 0
        with np.errstate(over="ignore", invalid="ignore"):  # divergence is reported below
            while True:
                now_x, now_y, x_by_x, x_by_y, y_by_x, y_by_y = self._distorted_parts(x, y)
                off_x, off_y = now_x - start_x, now_y - start_y
                det = x_by_x * y_by_y - x_by_y * y_by_x
                done = np.maximum(np.abs(off_x), np.abs(off_y)) < UNDISTORT_TOLERANCE
                steps += 1
                if done.all() or steps == MAX_NEWTON_STEPS:
                    break
                safe = np.where(np.abs(det) > 1e-9, det, 1e-9)
                x, y = x - (y_by_y * off_x - x_by_y * off_y) / safe, y - (x_by_x * off_y - y_by_x * off_x) / safe
        # Beyond the fold Newton can end on a mirrored branch: an inverse has a positive definite derivative.
        good = done & (det >= 0) & (x_by_x + y_by_y > 0)
        if good.all():
            return self._perspective(np.stack([x, y], axis=-1), target)
        worst = np.unravel_index(np.argmin(good), good.shape)
        at = self.focal * target[worst] + self.centre
        raise ConvergenceError(
            "E-CAMERA-FOLDED",
            f"camera: no undistorted point for pixel ({at[0]:.0f}, {at[1]:.0f}); "
            "the distortion coefficients fold the image over there, check them",
        )

    def _perspective(self, xy: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return ideal normalised coordinates (..., 2) of undistorted points ``xy``.

        For an equidistant camera the radius of ``xy`` is the angle. ``target`` : (..., 2) the distorted points, which
        an error message converts to pixels.
        """
        if not self.fisheye:
            return xy
        theta = np.hypot(xy[..., 0], xy[..., 1])
        if (theta >= WIDEST_RAD).any():
            at = self.focal * target[np.unravel_index(theta.argmax(), theta.shape)] + self.centre
            raise ConvergenceError(
                "E-CAMERA-FIELD",
                f"camera: pixel ({at[0]:.0f}, {at[1]:.0f}) is {np.degrees(theta.max()):.1f}° from the axis, less than "
                f"{np.degrees(WIDEST_RAD):.0f}° needed; use the middle of the image",
            )
        return xy * np.where(theta > 0, np.tan(theta) / np.where(theta > 0, theta, 1.0), 1.0)[..., None]

    def pixel_from_normalised(self, xy: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of ideal normalised coordinates (..., 2), lens distortion applied."""
        return self.distort(xy) * self.focal + self.centre

    def normalised_from_pixel(self, xy_px: np.ndarray) -> np.ndarray:
        """Return ideal normalised coordinates (..., 2) of pixels (..., 2), lens distortion removed."""
        return self.undistort((np.asarray(xy_px, float) - self.centre) / self.focal)

    def project(self, xyz_camera: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3) in the camera frame."""
        xyz = np.asarray(xyz_camera, float)
        return self.pixel_from_normalised(xyz[..., :2] / xyz[..., 2:])


def _equidistant(xy: np.ndarray) -> np.ndarray:
    """Return points (..., 2) of the plane Z = 1 with their radius replaced by the angle from the axis, rad."""
    xy = np.asarray(xy, float)
    return xy * _angle_share((xy**2).sum(-1))[..., None]


def _angle_share(r2: np.ndarray) -> np.ndarray:
    """Return arctan(r) / r for squared radii ``r2``."""
    r = np.sqrt(r2)
    return np.where(r2 > NEAR_AXIS, np.arctan(r) / np.where(r2 > NEAR_AXIS, r, 1.0), 1 - r2 / 3)


def _equidistant_jacobian(xy: np.ndarray) -> np.ndarray:
    """Return the derivative (..., 2, 2) of :func:`_equidistant`."""
    r2 = (xy**2).sum(-1)
    share, near = _angle_share(r2), r2 <= NEAR_AXIS
    along = np.where(near, -2 / 3 + 4 / 5 * r2, (1 / (1 + r2) - share) / np.where(near, 1.0, r2))
    return share[..., None, None] * np.eye(2) + along[..., None, None] * xy[..., :, None] * xy[..., None, :]
