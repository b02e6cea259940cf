"""The camera: projection with lens distortion and its exact inverse. Pixel centres are integers (OpenCV)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from stcal.errors import ConvergenceError, InputError, named
from stcal.geometry.arrays import Array, ByValue, freeze, frozen, require_arguments, require_fields

MAX_NEWTON_STEPS = 50
COEFFICIENTS = 12  # number of distortion coefficients
WIDEST_RAD = np.radians(89.0)
"""Largest angle from the axis that an equidistant camera may see: points of the plane Z = 1 are within 57 of it."""
NEAR_AXIS = 1e-8  # largest squared radius at which the series expansion is exact to rounding
UNDISTORT_TOLERANCE = 1e-12
"""Largest error of the inverse distortion, in normalised coordinates (1e-8 px at f = 10 000 px)."""
COLMAP_PIXEL_ORIGIN = 0.5
"""COLMAP's coordinate of the centre of the top-left pixel; OpenCV's, and ours, is 0."""
DISTORTION_COUNTS = (0, 4, 5, 8, 12, 14)  # numbers of distortion coefficients that OpenCV knows
COLMAP_LAYOUT = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3",
}
"""COLMAP's parameters in its order, by camera model: names of :data:`PARAMETER_NAMES`, or f for fx and fy."""
COLMAP_MODELS = tuple(COLMAP_LAYOUT)  # camera models that stcal supports
PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
FISHEYE = "FISHEYE"  # part of the names of COLMAP's equidistant models
MAX_FOCAL_RATIO = 10.0  # largest ratio between fx and fy; anamorphic lenses have 2
FARTHEST = 1e12  # largest value of any parameter, whose square does not overflow
MAX_SIDE_PX = 1_000_000  # longest image side that a camera file may state, px
LEAST_SHARE_OF_SIDE = 0.015
"""Share of the longer side that focal length or principal point of every lens exceed; lengths in mm do not."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera(ByValue):
    """A central camera with OpenCV's lens model and perspective or equidistant projection, before the camera.

    Perspective: the ideal point (x, y) = (X, Y) / Z is distorted by OpenCV's rational model with thin prisms (its first
    twelve coefficients; COLMAP's FULL_OPENCV without prisms). Equidistant: the point is moved to the radius θ, its
    angle from the axis, and then distorted by 1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸, p1, p2, s1 and s3 (Kannala & Brandt
    2006; OpenCV's fisheye; COLMAP's THIN_PRISM_FISHEYE).

    Parameters
    ----------
    width, height : Image size, px.
    focal, centre : (2,) array. fx, fy and cx, cy, px, centre of the top-left pixel at (0, 0).
    distortion : (12,) array. k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 in OpenCV's order; or the first eight.
    fisheye : True for equidistant projection; k5, k6, s2 and s4 must then be 0.
    colmap_model : str, optional
        The COLMAP model that represents the camera exactly; the most general one of its projection if not given.
    covariance : (q, q) array. Covariance of the parameters of ``colmap_model``, in its order; None if unknown.
    """

    width: int
    height: int
    focal: Array
    centre: Array
    distortion: Array
    fisheye: bool = False
    colmap_model: str = ""
    covariance: np.ndarray | None = None

    def __post_init__(self):
        require_fields(self, "camera")
        freeze(self, "focal", (2,), "focal length")
        freeze(self, "centre", (2,), "principal point")
        freeze(self, "distortion", None, "distortion")
        if self.distortion.shape == (8,):
            object.__setattr__(self, "distortion", np.pad(self.distortion, (0, 4)))
        freeze(self, "distortion", (COEFFICIENTS,), "distortion")
        if self.fisheye and self.distortion[[6, 7, 9, 11]].any():
            raise InputError("E-CAMERA-COEFFICIENTS", "camera: k5, k6, s2 or s4 of an equidistant camera; 0 needed")
        if not self.colmap_model:
            object.__setattr__(self, "colmap_model", "THIN_PRISM_FISHEYE" if self.fisheye else "FULL_OPENCV")
        if self.colmap_model not in COLMAP_LAYOUT or (FISHEYE in self.colmap_model) != self.fisheye:
            known = ", ".join(model for model in COLMAP_MODELS if (FISHEYE in model) == self.fisheye)
            kind = "an equidistant" if self.fisheye else "a perspective"
            fault = f"camera: model {self.colmap_model} of {kind} camera"
            raise InputError("E-CAMERA-MODEL", f"{fault}; one of {known} needed")
        if self.covariance is not None:
            count = len(parameter_names(self.colmap_model))
            freeze(self, "covariance", (count, count), "camera's covariance")
        with named("camera"):
            require_lens(self.parameters(), self.width, self.height)

    @classmethod
    def of(cls, camera: "Camera", colmap_model: str, covariance: np.ndarray | None = None) -> "Camera":
        """Return ``camera`` as one of a COLMAP model, with the covariance of its parameters."""
        return replace(camera, fisheye=FISHEYE in colmap_model, colmap_model=colmap_model, covariance=covariance)

    @classmethod
    @require_arguments
    def from_opencv(
        cls, matrix: ArrayLike, distortion: ArrayLike, size: tuple[int, int], fisheye: bool = False
    ) -> "Camera":
        """Return the camera of OpenCV's matrix and coefficients.

        Parameters
        ----------
        matrix : (3, 3) array. ``cameraMatrix``: fx, fy, cx, cy, px; without skew.
        distortion : (k,) array. k1, k2, p1, p2, k3, k4, k5, k6, all or the first 4 or 5; none for a lens without
            distortion. With ``fisheye``, the equidistant projection of ``cv2.fisheye``, its k1, k2, k3, k4.
        size : (int, int). Width and height of the images, px.
        """
        k = frozen(matrix, (3, 3), "camera matrix")
        if k[0, 1] or k[1, 0] or k[2].tolist() != [0, 0, 1]:
            fault = f"camera matrix {k.tolist()}: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] needed"
            raise InputError("E-CAMERA-MATRIX", f"{fault}; skew is not supported")
        given = frozen(np.ravel(distortion), None, "distortion")
        with named("camera"):
            flat, model = opencv_lens(given, fisheye)
        return cls(int(size[0]), int(size[1]), k[[0, 1], [0, 1]], k[:2, 2], flat, fisheye, model)

    def to_opencv(self) -> tuple[np.ndarray, np.ndarray]:
        """Return OpenCV's camera matrix (3, 3) and its 4, 5, 8 or 12 coefficients; four of a fisheye without prisms."""
        matrix = np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1]])
        if not self.fisheye:
            count = next(n for n in (4, 5, 8, 12) if not self.distortion[n:].any())
            return matrix, self.distortion[:count].copy()
        if self.distortion[[2, 3, 8, 10]].any():
            fault = "camera: p1, p2 or prisms, which OpenCV's fisheye lacks"
            raise InputError("E-CAMERA-MODEL", f"{fault}; write it in COLMAP's form")
        return matrix, self.distortion[[0, 1, 4, 5]]

    def colmap_params(self) -> list[float]:
        """Return the parameters in COLMAP's order and pixel origin."""
        flat = self.parameters()
        flat[2:4] += COLMAP_PIXEL_ORIGIN
        return flat[intrinsic_basis(self.colmap_model).argmax(axis=0)].tolist()

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
        x, y = xy.T
        *_, r2, top, bottom = self._distorted(x, y)
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

    def distort(self, xy: ArrayLike) -> np.ndarray:
        """Return distorted normalised coordinates (..., 2) of ideal ones (..., 2)."""
        xy = np.asarray(xy, float)
        if self.fisheye:
            xy = _equidistant(xy)
        return np.stack(self._distorted(xy[..., 0], xy[..., 1])[:2], axis=-1)

    def distort_jacobian(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`distort` of ideal coordinates (..., 2), and its derivative (..., 2, 2)."""
        xy = ideal = np.asarray(xy, float)
        if self.fisheye:
            xy = _equidistant(ideal)
        x, y, *derivatives = self._distorted_parts(xy[..., 0], xy[..., 1])
        distorted, jacobian = np.stack([x, y], axis=-1), np.stack(derivatives, axis=-1).reshape(*xy.shape, 2)
        return distorted, jacobian @ _equidistant_jacobian(ideal) if self.fisheye else jacobian

    def pixel_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """Return the derivative (..., 2, 2) of pixels by ideal normalised coordinates (..., 2)."""
        return self.focal[:, None] * self.distort_jacobian(xy)[1]

    def projection_jacobian(self, xyz_camera: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 2, 3) of :meth:`project` by points (n, 3) in the camera frame."""
        ideal = xyz_camera[:, :2] / xyz_camera[:, 2:]
        by_ideal = self.pixel_jacobian(ideal)
        return np.concatenate([by_ideal, -by_ideal @ ideal[..., None]], axis=2) / xyz_camera[:, 2, None, None]

    def _distorted_parts(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return distorted x and y, and derivatives x by x, x by y, y by x, y by y; after :func:`_equidistant`."""
        k1, k2, p1, p2, k3, k4, k5, k6, *prisms = self.distortion.tolist()
        moved_x, moved_y, r2, top, bottom = self._distorted(x, y)
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
        return moved_x, moved_y, x_by_x, x_by_y, y_by_x, y_by_y

    def _distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return distorted x and y, the squared radius, and numerator and denominator of the radial factor, (...)."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.distortion.tolist()
        r2 = x * x + y * y
        if self.fisheye:
            top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))), np.ones_like(r2)
        else:
            top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = top / bottom
        moved_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        moved_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        if s1 or s2 or s3 or s4:
            moved_x, moved_y = moved_x + r2 * (s1 + r2 * s2), moved_y + r2 * (s3 + r2 * s4)
        return moved_x, moved_y, r2, top, bottom

    def undistort(self, xy_distorted: ArrayLike, or_nan: bool = False) -> np.ndarray:
        """Invert :meth:`distort` by Newton's method to 1e-12, of finite points; where the image is folded over, raise
        ConvergenceError, or with ``or_nan`` return NaN."""
        target = np.asarray(xy_distorted, float)
        if not self.distortion.any():
            return self._perspective(target.copy(), target, or_nan)
        if not np.isfinite(target).all():
            raise ConvergenceError("E-CAMERA-PIXEL", "camera: a pixel to undistort is not finite; finite ones needed")
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
        if or_nan or good.all():
            return self._perspective(np.where(good, [x, y], np.nan).transpose(*range(1, x.ndim + 1), 0), target, or_nan)
        worst = np.unravel_index(np.argmin(good), good.shape)
        at = self.focal * target[worst] + self.centre
        fault = f"camera: no undistorted point for pixel ({at[0]:.0f}, {at[1]:.0f})"
        remedy = "the distortion coefficients fold the image over there, check them"
        raise ConvergenceError("E-CAMERA-FOLDED", f"{fault}; {remedy}")

    def _perspective(self, xy: np.ndarray, target: np.ndarray, or_nan: bool) -> np.ndarray:
        """Return ideal coordinates (..., 2) of undistorted ``xy``; ``target`` : distorted points, for messages."""
        if not self.fisheye:
            return xy
        theta = np.hypot(xy[..., 0], xy[..., 1])
        if or_nan:
            theta = np.where(theta < WIDEST_RAD, theta, np.nan)
        elif (theta >= WIDEST_RAD).any():
            at = self.focal * target[np.unravel_index(theta.argmax(), theta.shape)] + self.centre
            fault = f"camera: pixel ({at[0]:.0f}, {at[1]:.0f}) is {np.degrees(theta.max()):.1f}° from the axis"
            needed = f"less than {np.degrees(WIDEST_RAD):.0f}° needed; use the middle of the image"
            raise ConvergenceError("E-CAMERA-FIELD", f"{fault}, {needed}")
        return xy * np.where(theta == 0, 1.0, np.tan(theta) / np.where(theta == 0, 1.0, theta))[..., None]

    def pixel_from_normalised(self, xy: ArrayLike) -> np.ndarray:
        """Return the pixels (..., 2) of ideal normalised coordinates (..., 2), lens distortion applied."""
        return self.distort(xy) * self.focal + self.centre

    def normalised_from_pixel(self, xy_px: ArrayLike, or_nan: bool = False) -> np.ndarray:
        """Return ideal normalised coordinates (..., 2) of pixels (..., 2), lens distortion removed; see
        :meth:`undistort`."""
        return self.undistort((np.asarray(xy_px, float) - self.centre) / self.focal, or_nan)

    def project(self, xyz_camera: ArrayLike) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3) in the camera frame; NaN of points that are not before it."""
        xyz = np.asarray(xyz_camera, float)
        if xyz.shape[-1:] != (3,):
            raise InputError("E-ARRAY-SHAPE", f"camera: points of shape {xyz.shape}; (..., 3) needed")
        depth = np.where(xyz[..., 2:] > 0, xyz[..., 2:], np.nan)
        return self.pixel_from_normalised(xyz[..., :2] / depth)


def _equidistant(xy: np.ndarray) -> np.ndarray:
    """Return points (..., 2) of the plane Z = 1 with their radius replaced by the angle from the axis, rad."""
    xy = np.asarray(xy, float)
    return xy * _angle_share((xy**2).sum(-1))[..., None]


def _angle_share(r2: np.ndarray) -> np.ndarray:
    """Return arctan(r) / r for squared radii ``r2``."""
    r = np.sqrt(r2)
    return np.where(r2 > NEAR_AXIS, np.arctan(r) / np.where(r2 > NEAR_AXIS, r, 1.0), 1 - r2 / 3)


def _equidistant_jacobian(xy: np.ndarray) -> np.ndarray:
    r2 = (xy**2).sum(-1)
    share, near = _angle_share(r2), r2 <= NEAR_AXIS
    along = np.where(near, -2 / 3 + 4 / 5 * r2, (1 / (1 + r2) - share) / np.where(near, 1.0, r2))
    return share[..., None, None] * np.eye(2) + along[..., None, None] * xy[..., :, None] * xy[..., None, :]


def opencv_lens(given: np.ndarray, fisheye: bool, tangential: bool = False) -> tuple[np.ndarray, str]:
    """Return the distortion (12,) of OpenCV's coefficients (k,), and the COLMAP model that holds them exactly; of a
    fisheye k1 to k4, or if ``tangential`` k1, k2, p1, p2, k3, k4."""
    distortion = np.zeros(COEFFICIENTS)
    if fisheye:
        if len(given) not in ((6,) if tangential else (0, 4)):
            raise InputError("E-CAMERA-COEFFICIENTS", f"{len(given)} coefficients of a fisheye; k1 to k4 needed")
        distortion[[0, 1, 2, 3, 4, 5] if tangential else [0, 1, 4, 5][: len(given)]] = given
        return distortion, "THIN_PRISM_FISHEYE" if distortion[2:4].any() else "OPENCV_FISHEYE"
    if given[8:].any():
        raise InputError("E-CAMERA-COEFFICIENTS", f"{len(given)} distortion coefficients, at most 8 are supported")
    if len(given) not in DISTORTION_COUNTS:
        possible = f"{', '.join(map(str, DISTORTION_COUNTS))} are possible (k1, k2, p1, p2, k3 …)"
        raise InputError("E-CAMERA-COEFFICIENTS", f"{len(given)} distortion coefficients; {possible}")
    distortion[: min(len(given), 8)] = given[:8]
    return distortion, "FULL_OPENCV" if distortion[4:].any() else "OPENCV" if distortion.any() else "PINHOLE"


def require_lens(flat: np.ndarray, width: float | None, height: float | None) -> None:
    """Refuse parameters (16,), see :data:`PARAMETER_NAMES`, and sizes that no camera has; None: not stated."""
    if not np.isfinite(flat).all():
        raise InputError("E-CAMERA-NOT-FINITE", "a camera parameter is not a finite number; correct it")
    if (far := np.abs(flat).max()) > FARTHEST:
        raise InputError("E-CAMERA-TOO-FAR", f"a camera parameter of {far:g}, up to {FARTHEST:g} possible; correct it")
    if (flat[:2] <= 0).any():
        raise InputError("E-CAMERA-FOCAL", f"focal length {flat[0]:g}, {flat[1]:g} px; positive numbers needed")
    if max(flat[:2]) > MAX_FOCAL_RATIO * min(flat[:2]):
        needed = f"not more than {MAX_FOCAL_RATIO:g} times apart needed, pixels are nearly square"
        raise InputError("E-CAMERA-FOCAL", f"focal lengths {flat[0]:g} and {flat[1]:g} px; {needed}")
    for side in (width, height):
        if side is not None and not (0 < side <= MAX_SIDE_PX and float(side).is_integer()):
            raise InputError("E-CAMERA-SIZE", f"image of {width}×{height} px; whole numbers in 1…{MAX_SIDE_PX} needed")
    if width and height and flat[:4].max() < LEAST_SHARE_OF_SIDE * max(width, height):
        raise not_in_pixels(flat, width, height)


def not_in_pixels(flat: np.ndarray, width: float | None, height: float | None) -> InputError:
    """Return the error of parameters (16,) that are too small for pixels; sizes as of :func:`require_lens`."""
    size = f" of an image of {width:g}×{height:g} px" if width and height else ""
    fault = f"focal length {flat[0]:g} and principal point ({flat[2]:g}, {flat[3]:g}){size}"
    return InputError("E-CAMERA-FOCAL", f"{fault}; pixels needed; check that they are not mm, or shares of a side")


def intrinsic_basis(colmap_model: str) -> np.ndarray:
    """Return the derivative (16, q) of :data:`PARAMETER_NAMES` by the q parameters of a COLMAP model."""
    names = parameter_names(colmap_model)
    return np.array([[float(name in (own, own[0])) for name in names] for own in PARAMETER_NAMES])


def parameter_names(colmap_model: str) -> list[str]:
    """Return the names of the parameters of a COLMAP model, in its order."""
    return COLMAP_LAYOUT[colmap_model].split()
