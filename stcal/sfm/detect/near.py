"""Circles near their predicted places, in an image that follows another one: common shift and centres."""

import cv2
import numpy as np

from stcal.geometry.camera import Camera
from stcal.labels import Label
from stcal.sfm.data.centres import Centres
from stcal.sfm.detect.circles.centres import measure_centres
from stcal.sfm.detect.circles.ellipses import Ellipses
from stcal.sfm.detect.predict import PredictedCircles, stands_out

SEARCH = 5.0
"""Search range about the predicted places, in mean radii of the circles, to each side."""
COARSE_RADIUS_PX = 2.5
"""Radius of the circles in the small picture that the common shift is measured in."""
CORRELATED = 0.3
"""Smallest significant correlation. Below it the shift is ignored."""
LEVEL_PX = 9
"""Side of the square in the small picture whose mean is subtracted."""


def measure_near(image: np.ndarray, camera: Camera, predicted: PredictedCircles) -> tuple[tuple[Label, ...], Centres]:
    """Returns the labels and centres of the circles that are found at predicted places in a grey image of any depth."""
    expected = Ellipses(predicted.centre_px, predicted.shape_px, np.ones(len(predicted.labels)))
    planes = [label.plane for label in predicted.labels]
    number = {plane: i for i, plane in enumerate(dict.fromkeys(planes))}
    found = measure_centres(image, camera, expected, expected, np.array([number[plane] for plane in planes], int))
    seen = np.flatnonzero(found.ok & stands_out(found, predicted.polarity))
    return tuple(predicted.labels[i] for i in seen.tolist()), found.select(seen)


def common_shift(grey: np.ndarray, predicted: PredictedCircles) -> np.ndarray:
    """Returns the common shift of the circles of an 8-bit image from their predicted places, (2,) px.

    It is accurate to a fraction of a radius. The image and discs at the predicted places, both reduced and high-pass
    filtered, are correlated (Lewis 1995, Fast normalized cross-correlation).
    """
    radius = float(np.sqrt(np.linalg.det(predicted.shape_px)).mean() ** 0.5)
    scale = min(1.0, COARSE_RADIUS_PX / radius)
    margin = int(np.ceil(SEARCH * radius * scale))
    extent = np.sqrt((predicted.shape_px**2).sum(2)) + radius
    low = np.floor((predicted.centre_px - extent).min(0)).astype(int)
    high = np.ceil((predicted.centre_px + extent).max(0)).astype(int)
    size = np.ceil((high - low) * scale).astype(int)
    discs = np.zeros(size[::-1], np.float32)
    for place, shape, polarity in zip(predicted.centre_px, predicted.shape_px, predicted.polarity, strict=True):
        half, axes = np.linalg.eigh(scale * shape)
        middle, turn = (place - low + 0.5) * scale - 0.5, float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
        box = (float(middle[0]), float(middle[1])), (2 * float(half[0]), 2 * float(half[1])), turn
        cv2.ellipse(discs, box, 1.0 if polarity == "bright" else -1.0, -1)
    reach = round(margin / scale)
    part = _part(grey, low - reach, low + np.round(size / scale).astype(int) + reach)
    small = cv2.resize(part, tuple((size + 2 * margin).tolist()), interpolation=cv2.INTER_AREA).astype(np.float32)
    correlation = cv2.matchTemplate(_levelled(small), _levelled(discs), cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    if not correlation[row, column] >= CORRELATED:
        return np.zeros(2)
    return (np.array([column, row]) - margin) / scale


def _part(grey: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Returns a part of an image, with the edge replicated outside of the image."""
    (left, top), (right, bottom), (height, width) = low.tolist(), high.tolist(), grey.shape
    inside = grey[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
    borders = max(-top, 0), max(bottom - height, 0), max(-left, 0), max(right - width, 0)
    return cv2.copyMakeBorder(inside, *borders, cv2.BORDER_REPLICATE) if any(borders) else inside


def _levelled(image: np.ndarray) -> np.ndarray:
    """Returns the image minus the local mean around each pixel."""
    return image - cv2.blur(image, (LEVEL_PX, LEVEL_PX))
