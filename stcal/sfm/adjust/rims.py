"""Rims in front of luminous circles: radii of circles as each view shows them, and the height of a rim from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.robust import huber_weights, robust_sigma
from stcal.labels import DotLabel, Label
from stcal.sfm.data.group_model import CircleRows, GroupModel, ImageObservations

MAX_TAN = 2.75
"""Largest tangent of the tilt (70°) of views that are used for a rim: beyond it, the short axis of the ellipse is a few
pixels."""
SECOND_ORDER = 0.085
"""Second-order share of the loss of radius, (h tan τ)²/r: of the ellipse that fits the lens-shaped area best."""
MIN_VIEWS, MIN_SPREAD = 30, 0.15
"""Smallest number of views of a kind of circle, and of the standard deviation of their tan τ, for a rim."""
BLUR_SHARE = 0.3
"""σ of the blur's effect on the radius that is left after its correction, as a share of it: the
prior of the share that all views of a kind have in common, which the views determine better."""
BLUR_SHARE_BY_TILT = 0.05
"""σ by which this share grows with the tangent of the tilt, which looks like a rim: it is 0.00 to 0.02 for circles that
face the camera, 0.05 at 50° and 0.04 to 0.13 at 62° in rendered scenes (circles of 8 px and more)."""
LEAST_SIGMA_MM = 0.003  # smallest σ of a rim: what else the light of a circle adds
DOME_BY_TILT = 0.04
"""The same of a dome's effect on radii, which is that of one step. In 30 rendered scenes that lack 10 to 40 % of the
light at the rim, the mean square of the error over σ is 0.8."""
NARROW, NARROW_SIGMA, LEAST_DOME = 0.7, 2.0, 0.01
"""Dome that the fit of an evenly lit disc finds, times (blur / narrowest radius)²; σ of that, which covers other forms
of blur than a Gaussian (rendered sets: 0.06, 0.027, 0.01 at 3.5, 5, 7 blurs, and −0.05, −0.03 at 7, 10 out of focus);
and the smallest σ of what all have in common."""
HUBER = 2.0
STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class RadiusViews(CircleRows):
    """The radii in n observations of circles."""

    point_index: np.ndarray
    image_index: np.ndarray
    design_mm: np.ndarray
    ratio: np.ndarray  # measured over designed radius
    size_px: np.ndarray  # designed radius in the image
    blur_mm: np.ndarray  # correction of the radius for blur, which is in the ratio
    tan_tilt: np.ndarray  # of the angle between the normal and the line of sight
    domes: np.ndarray  # (n, 2) by which share of its light each is brighter in the middle, and σ of that
    by_dome_mm: np.ndarray  # by how much a dome of all its light makes it look smaller


@dataclass(frozen=True, slots=True)
class Rim:
    """Height of the rim in front of circles of one kind, mm, its σ, and the number of ``views`` that determine it."""

    height_mm: float
    sigma_mm: float
    views: int


def radius_views(
    model: GroupModel, images: Mapping[str, ImageObservations], design_mm: Mapping[Label, float], camera: Camera
) -> RadiusViews:
    """Returns the radii from areas of ellipses, by the dual conic r²(I − n·nᵀ) − C·Cᵀ (Hartley & Zisserman, sec. 8.3)
    of the planes of the faces. A blur of σ reduces a disc's radius R by σ²/2R, and the fitted one alike: corrected."""
    focal = float(np.sqrt(camera.focal.prod()))
    rows = model.rows_by_image()
    order = np.concatenate(rows)
    seen = [(images[name], model.keypoint[own]) for name, own in zip(model.images, rows, strict=True)]
    names = "shape", "blur_px", "domes"
    shape, blur, domes = (np.concatenate([getattr(own, name)[k] for own, k in seen]) for name in names)
    point = model.point_index[order]
    is_circle = np.array([label in design_mm for label in model.labels])[point]  # corners have no radius
    radius = np.array([design_mm.get(label, 1.0) for label in model.labels])[point]
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index[order]]
    n = np.einsum("nij,nj->ni", rotation, model.normals()[point])
    c = model.xyz_camera()[order]
    dual = radius[:, None, None] ** 2 * (np.eye(3) - n[:, :, None] * n[:, None, :]) - c[:, :, None] * c[:, None, :]
    middle = dual[:, :2, 2] / dual[:, 2:, 2]
    shape2 = middle[:, :, None] * middle[:, None, :] - dual[:, :2, :2] / dual[:, 2:, 2:]
    size = focal * np.sqrt(np.sqrt(np.maximum(np.linalg.det(shape2), 1e-300)))
    measured = focal * np.sqrt(np.maximum(np.linalg.det(shape), 0))
    lost = np.divide(blur**2, 2 * measured, out=np.zeros_like(measured), where=measured > 0)
    cosine = np.abs((n * c).sum(1)) / np.linalg.norm(c, axis=1)
    # Of the narrowest radius: the fit's own errors look like a dome.
    narrow = np.divide(blur**2, cosine * size**2, out=np.zeros_like(size), where=blur > 0)
    return RadiusViews(
        point,
        model.image_index[order],
        radius,
        np.where(is_circle, (measured + lost) / size, np.nan),
        size,
        lost / size * radius,
        np.sqrt(np.maximum(1 - cosine**2, 0)) / cosine,
        np.column_stack([domes[:, 0] - NARROW * narrow, np.hypot(domes[:, 1], NARROW_SIGMA * narrow)]),
        domes[:, 2] * radius,
    )


def lost_radius_mm(height_mm: float, tan_tilt: np.ndarray, radius_mm: float | np.ndarray) -> np.ndarray:
    """Returns by how much a rim reduces a radius, mm: the area common to two discs h tan τ apart, to second order."""
    return height_mm * tan_tilt / np.pi + SECOND_ORDER * height_mm * abs(height_mm) * tan_tilt**2 / radius_mm


def find_rims(
    models: Sequence[GroupModel], images: Sequence[ImageObservations], design_mm: Mapping[Label, float], camera: Camera
) -> dict[str, Rim]:
    """Returns the height of the rim in front of the faces' ``circles`` and of the board's ``dots``, if views suffice.
    The area common to disc and rim appears h/2 in front of the disc, and its radius is smaller by h tan τ/π."""
    by_name = {image.name: image for image in images}
    parts, dots, before = [], [], 0
    for model in models:
        views = radius_views(model, by_name, design_mm, camera)
        parts.append(replace(views, image_index=before + views.image_index))
        dots.append(np.array([isinstance(label, DotLabel) for label in model.labels])[views.point_index])
        before += len(model.images)
    views, is_dot, rims = RadiusViews.concatenate(parts), np.concatenate(dots), {}
    near = (views.tan_tilt < MAX_TAN) & (views.ratio > 0)  # not of corners, whose ratio is not a number
    for kind, own in (("circles", ~is_dot & near), ("dots", is_dot & near)):
        if np.count_nonzero(own) >= MIN_VIEWS and views.tan_tilt[own].std() >= MIN_SPREAD:
            rims[kind] = _rim(views.select(own))
    return rims


def common_dome(domes: np.ndarray) -> tuple[float, float]:
    """Returns the share of light by which all are brighter in the middle, and its σ, from those of each (n, 2)."""
    share, sigma = domes[domes[:, 1] > 0].T
    if not len(share):
        return 0.0, LEAST_DOME
    weight = 1 / sigma**2
    return float(weight @ share / weight.sum()), float(weight @ sigma / weight.sum()) + LEAST_DOME


def _rim(views: RadiusViews) -> Rim:
    """Returns the rim from the radii's excess, mm, with an offset of each radius, the share of blur that is left, and
    the light that falls off towards the rim, of all. Circles of one image share exposure, focus and tilt: σ is at least
    that by whole images (Liang & Zeger 1986, Biometrika 73)."""
    tangent, radius, blur, by_dome = views.tan_tilt, views.design_mm, views.blur_mm, views.by_dome_mm
    short = (views.ratio - 1) * radius
    _, kind = np.unique(radius, return_inverse=True)
    rows = np.column_stack([np.eye(kind.max() + 1)[kind], blur, -by_dome, -tangent / np.pi])
    dome, dome_sigma = common_dome(views.domes)
    height, weight, sigma, inverse = 0.0, np.ones(len(short)), 1.0, np.eye(1)
    for _ in range(STEPS):
        right = short + lost_radius_mm(height, tangent, radius) - height * tangent / np.pi
        normal = (rows.T * weight) @ rows
        pull = (rows.T * weight) @ right
        normal[-3, -3] += (sigma / BLUR_SHARE) ** 2
        normal[-2, -2] += (sigma / dome_sigma) ** 2
        pull[-2] += (sigma / dome_sigma) ** 2 * dome
        inverse = np.linalg.pinv(normal, hermitian=True)
        solution = inverse @ pull
        height = float(solution[-1])
        length = np.abs(right - rows @ solution)
        sigma = float(robust_sigma(length, redundancy=max(1 - rows.shape[1] / len(rows), 0.1)))
        weight = huber_weights(length / max(sigma, 1e-9), HUBER)
    left = np.hypot(BLUR_SHARE_BY_TILT * blur, DOME_BY_TILT * solution[-2] * by_dome) * tangent
    by_tilt = float((inverse @ ((rows.T * weight) @ left))[-1])
    pull = (rows @ inverse[:, -1]) * weight * (right - rows @ solution)
    of_image = np.bincount(np.unique(views.image_index, return_inverse=True)[1], pull)
    by_image = float((of_image**2).sum()) * len(of_image) / max(len(of_image) - 1, 1)
    spread = float(np.sqrt(max(sigma**2 * inverse[-1, -1], by_image)))
    return Rim(height, float(np.sqrt(spread**2 + by_tilt**2 + LEAST_SIGMA_MM**2)), len(short))
