"""Defocus: the blur of an image as a function of depth, and the shifts of centres that its variation causes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.robust import huber_weights, ratio_limit, robust_sigma
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.data.patterns import Pattern, planar_pose

MIN_PLANE = 5  # smallest number of circles of a plane for its pose. Four determine it, a fifth allows a check.
MIN_CIRCLES = 12  # smallest number of circles of an image for its law of blur, which has three parameters
BY_CHANCE = 1e-6  # share of images with even blur of which a law is found by chance
RESPONSE, RESPONSE_OF_BLUR2 = 0.51, 5.8
"""Shift of a centre as a multiple of the gradient of the squared blur by the law of its image, and its growth with the
square of the blur over the smaller radius: from 3751 circles that were rendered through points of a pupil."""
RESPONSE_SIGMA = 0.15
"""σ of this multiple for one circle, as a share of it, with what the circles of a face have in common."""
FAR_BLUR, FAR_SIGMA = 0.45, 0.5
"""Where the blur is wider than this share of the smaller radius, the share is :data:`FAR_SIGMA`."""
MAX_UNEXPLAINED = 0.5
"""Largest scatter of the squared blur about its law, as a share of its scatter about their mean, that is not told."""
TOLD_PX = 0.3  # smallest variation of the blur, px, that is told if depth does not explain it
ROUNDS = 6  # number of rounds of the robust fit: weights are settled to a per cent after four
HUBER = 2.0  # residual, in σ, beyond which the weight falls (Huber 1964)
LEAST_PX2 = 1e-6
"""Scatter of the squared blur, px², that counts as none."""


@dataclass(frozen=True, slots=True, eq=False)
class Focus:
    """Blur in one image."""

    image: str
    focused_mm: float | None  # distance of the plane of focus along the optical axis, None if it is not determined
    depth_mm: tuple[float, float]  # of the nearest and the farthest circle
    blur_px: tuple[float, float]  # (σ) at these
    shift_px: float  # largest correction of a centre
    note: str = ""  # blur that defocus does not explain, in words


class _Blurs:
    """The n circles of one image with a blur, of planes that have enough of them for a pose."""

    def __init__(self, image: ImageObservations, patterns: Mapping[str, Pattern], focal_px: float):
        planes = np.where(image.blur_px > 0, np.array([label.plane for label in image.labels], str), "")
        rows, inverse_depth, gradient = [np.zeros(0, int)], [np.zeros(0)], [np.zeros((0, 2))]
        for plane in (plane for plane in dict.fromkeys(planes.tolist()) if plane in patterns):
            members, place = np.flatnonzero(planes == plane), {x: k for k, x in enumerate(patterns[plane].labels)}
            xy_mm, xy = patterns[plane].xy_mm[[place[image.labels[i]] for i in members]], image.centre[members]
            pose = planar_pose(xy_mm, xy) if len(members) >= MIN_PLANE else None
            if pose is not None:
                normal = pose.rotation[:, 2] / (pose.rotation[:, 2] @ pose.translation)
                rows.append(members)
                inverse_depth.append(np.pad(xy, ((0, 0), (0, 1)), constant_values=1) @ normal)
                gradient.append(np.tile(normal[:2] / focal_px, (len(xy), 1)))
        self.rows, self.inverse_depth = np.concatenate(rows), np.concatenate(inverse_depth)  # 1/mm
        self.gradient = np.concatenate(gradient)  # (n, 2) of it by the ideal image coordinates, 1/(mm·px)
        self.blur2 = image.blur_px[self.rows] ** 2  # px²
        smaller = np.linalg.svd(image.shape[self.rows], compute_uv=False)[:, 1] * focal_px
        wide2 = self.blur2 / smaller**2
        self.response = RESPONSE + RESPONSE_OF_BLUR2 * np.minimum(wide2, 1.0)  # of the centre, as a share
        self.sigma = np.where(wide2 > FAR_BLUR**2, FAR_SIGMA, RESPONSE_SIGMA)  # of the response, likewise


class _Law:
    """Law of the squared blur: c₀ + c₁ u + c₂ u², u the inverse depth about its mean, ``about``, in units of ``unit``.
    This is σ₀² + a² (1/z − 1/z_f)²: the variance of a uniform disc, the image of the pupil (thin lens). By robust least
    squares; ``curvature`` : mean and variance of that of other images."""

    def __init__(self, own: _Blurs, unit: float, curvature: tuple[float, float] | None = None):
        self.own, self.unit, self.about = own, unit, float(own.inverse_depth.mean())
        rows = np.vander((own.inverse_depth - self.about) / unit, 3, increasing=True)
        from_median = np.abs(own.blur2 - np.median(own.blur2))
        self.plain = self.scatter = float(robust_sigma(from_median))  # of residuals about a constant and the law, px²
        weight = np.ones(len(rows))
        for _ in range(ROUNDS):
            scale2 = max(self.scatter, LEAST_PX2) ** 2
            normal, right = (rows.T * weight) @ rows / scale2, (rows.T * weight) @ own.blur2 / scale2
            if curvature is not None:
                normal[2, 2] += 1 / curvature[1]
                right[2] += curvature[0] / curvature[1]
            self.covariance = np.linalg.pinv(normal, hermitian=True)
            self.coefficients = self.covariance @ right
            length = np.abs(own.blur2 - rows @ self.coefficients)
            self.scatter = float(robust_sigma(length, redundancy=1 - 3 / len(rows)))
            weight = huber_weights(length / max(self.scatter, LEAST_PX2), HUBER)
        residual = np.minimum(np.abs(own.blur2 - rows @ self.coefficients), 3 * max(self.scatter, 1e-12))
        freedom, square = len(rows) - 3, float((residual**2).sum())
        gain = float((np.minimum(from_median, 3 * max(self.plain, 1e-12)) ** 2).sum()) - square
        # whether depth explains the blur better than a constant does
        self.significant = bool(gain / 2 > ratio_limit(BY_CHANCE, 2, freedom) * square / freedom)

    def slope(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the derivative of the squared blur by the inverse depth, px²·mm, and its σ."""
        u = (self.own.inverse_depth - self.about) / self.unit
        by = np.stack([np.zeros_like(u), np.ones_like(u), 2 * u], axis=1) / self.unit
        return by @ self.coefficients, np.sqrt(np.einsum("ni,ij,nj->n", by, self.covariance, by))

    def focus(self, image: str, shift_px: float) -> Focus:
        """Returns the blur of the image in depth, with the largest correction of a centre."""
        (_, slope, curvature), sigma = self.coefficients, float(np.sqrt(self.covariance[2, 2]))
        near, far = self.own.inverse_depth.max(), self.own.inverse_depth.min()
        u = (np.array([near, far]) - self.about) / self.unit
        first, last = np.sqrt(np.maximum(np.vander(u, 3, increasing=True) @ self.coefficients, 0.0)).tolist()
        spread, note = float(np.ptp(np.percentile(np.sqrt(self.own.blur2), [5, 95]))), ""
        odd = self.significant and curvature < -3 * sigma
        if spread > TOLD_PX and (odd or self.scatter > MAX_UNEXPLAINED * self.plain):
            why = "motion, a curved plane of focus or dirt on the lens; centres may be off by more than their σ"
            note = f"blur varies by {spread:.1f} px among its circles, and depth does not explain it: {why}"
        determined = self.significant and curvature > 3 * sigma
        sharpest = self.about - self.unit * slope / (2 * curvature) if determined else 0.0
        focused_mm = float(1 / sharpest) if sharpest > 0 else None
        return Focus(image, focused_mm, (1 / float(near), 1 / float(far)), (first, last), shift_px, note)


def correct_defocus(
    images: Sequence[ImageObservations], camera: Camera, patterns: Mapping[str, Pattern]
) -> tuple[list[ImageObservations], list[Focus | None]]:
    """Returns the images with centres at which a lens with the same blur everywhere would show them, and their blur,
    None where too few circles tell it. Out of focus, blur varies across a tilted circle, and its fit with one
    blur moves towards the blurrier side. ``patterns``: of the faces and the board, by the plane of a label."""
    focal_px = float(np.sqrt(camera.focal.prod()))
    corrected: list[ImageObservations] = list(images)
    focus: list[Focus | None] = [None] * len(images)
    for i, law in _laws([_Blurs(image, patterns, focal_px) for image in images]).items():
        shift_px = 0.0
        if law.significant:
            corrected[i], shift_px = _moved(images[i], law, camera, focal_px)
        focus[i] = law.focus(images[i].name, shift_px)
    return corrected, focus


def _laws(views: Sequence[_Blurs]) -> dict[int, _Law]:
    """Returns the laws of the images with enough circles. Each a² is drawn towards the mean of all by as much as their
    scatter allows (DerSimonian & Laird 1986, Control. Clin. Trials 7)."""
    enough = {i: circles for i, circles in enumerate(views) if len(circles.rows) >= MIN_CIRCLES}
    if not enough:
        return {}
    unit = float(np.median([np.ptp(circles.inverse_depth) for circles in enough.values()])) or 1.0
    laws = {i: _Law(circles, unit) for i, circles in enough.items()}
    curvature = np.array([law.coefficients[2] for law in laws.values()])
    variance = np.array([law.covariance[2, 2] for law in laws.values()])
    if len(enough) >= 3 and (variance > 0).all():
        weight = 1 / variance
        mean = float((weight * curvature).sum() / weight.sum())
        excess = float((weight * (curvature - mean) ** 2).sum()) - (len(curvature) - 1)
        between = max(0.0, excess / (weight.sum() - (weight**2).sum() / weight.sum()))
        weight = 1 / (variance + between)
        prior = float((weight * curvature).sum() / weight.sum()), between + 1 / float(weight.sum())
        laws = {i: _Law(circles, unit, prior) for i, circles in enough.items()}
    return laws


def _moved(image: ImageObservations, law: _Law, camera: Camera, focal_px: float) -> tuple[ImageObservations, float]:
    """Returns the image with corrected centres, and the largest correction, px."""
    own, (slope, slope_sigma) = law.own, law.slope()
    by_slope = own.response[:, None] * own.gradient
    shift = slope[:, None] * by_slope
    variance = slope_sigma**2 + (own.sigma * slope) ** 2
    centre, centre_px = image.centre.copy(), image.centre_px.copy()
    centre[own.rows] -= shift / focal_px
    distorted, jacobian = camera.distort_jacobian(centre[own.rows])
    centre_px[own.rows] = distorted * camera.focal + camera.centre
    by_slope = (jacobian * camera.focal[:, None] / focal_px @ by_slope[..., None])[..., 0]
    covariance = image.covariance_px2.copy()
    covariance[own.rows] += variance[:, None, None] * by_slope[:, :, None] * by_slope[:, None, :]
    moved = replace(image, centre=centre, centre_px=centre_px, covariance_px2=covariance)
    return moved, float(np.linalg.norm(shift, axis=1).max())
