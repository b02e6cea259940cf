"""What in the photographs limits σ: their number, distance, angles, blur and light, each as a factor on σ."""

import math

import numpy as np

from stcal.sfm.data.group_model import GroupModel, ImageObservations
from stcal.sfm.mapping.incremental import widest_angle_rad
from stcal.sfm.runs.saved import RunResult

IMAGE_NOISE = 0.01  # standard deviation of the grey values, as a fraction of full scale
CONTRAST = 0.7  # contrast between circle and surroundings, as a fraction of full scale
BLUR_PX = 0.76  # blur of an edge, standard deviation: a lens of 0.7 px and the pixels themselves, 1/√12 px
PRACTICE = 1.3
"""Ratio of the σ of centres to the Cramér–Rao bound in runs on rendered photographs. It is due to estimated brightness
gradients, quantisation and neighbouring edges."""
IMAGES = 10  # number of images of a group that docs/howto/photograph.md asks for
FILLED = 0.7  # share of a picture's diagonal that faces and board cover where they fill the picture
APART_RAD = math.radians(80)  # angle between the outermost cameras of a group as their middle point sees it: ±40°


def conditions(run: RunResult) -> dict[str, tuple[float, float]]:
    """Returns, by the name of each condition, what was measured, in the unit that the judgement names, and by which
    factor the σ of faces are larger at most than in good photographs."""
    models = list(run.final_models().values())
    number = float(np.median([len(model.images) for model in models]))
    filled = float(np.median([_filled(model) for model in models])) / math.hypot(run.camera.width, run.camera.height)
    apart = min(map(_apart_rad, models))
    found = {
        "number": (number, math.sqrt(IMAGES / number)),
        "distance": (100 * filled, (FILLED / filled) ** 1.5),  # of a circle: σ in px by r^-½, and mm per px by r⁻¹
        "angles": (math.degrees(apart), math.sin(APART_RAD / 2) / math.sin(max(apart, 0.01) / 2)),
    }
    used = [image.select(np.flatnonzero(image.blur_px > 0)) for image in run.observations]
    if blurs := [image.blur_px for image in used if len(image)]:
        blur = float(np.median(np.concatenate(blurs)))
        focal_px = float(np.sqrt(run.calibration.camera.focal.prod()))
        noise = float(np.median(np.concatenate([_noise(image, focal_px) for image in used])))
        found["blur"] = (blur, math.sqrt(blur / BLUR_PX))
        found["light"] = (100 * noise, noise * CONTRAST / IMAGE_NOISE)
    return found


def _filled(model: GroupModel) -> float:
    """Returns the median diagonal of what the images of a group show, px."""
    return float(np.median([math.hypot(*np.ptp(model.measured_px[rows], axis=0)) for rows in model.rows_by_image()]))


def _apart_rad(model: GroupModel) -> float:
    rays = np.array([pose.inverse().translation for pose in model.camera_from_model]) - model.xyz_model.mean(axis=0)
    return widest_angle_rad(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _noise(image: ImageObservations, focal_px: float) -> np.ndarray:
    """Returns a pixel's noise over the contrast of its circle, (n,), of which the centre's σ is that of
    :class:`stcal.sfm.planning.forecast.CentreNoise`."""
    sigma_px = np.sqrt(np.trace(image.covariance_px2, axis1=1, axis2=2) / 2)
    radius_px = focal_px * np.sqrt(np.abs(np.linalg.det(image.shape)))
    return sigma_px * np.sqrt(np.pi * radius_px / (2 * np.sqrt(np.pi) * image.blur_px)) / PRACTICE
