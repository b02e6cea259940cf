"""What is drawn on an overlay is where it should be."""

import cv2
import numpy as np
import pytest

from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.detect.overlay import draw_overlay

FOCAL = np.array([2000.0, 2000.0])
GREY = 90


def overlay(labels, centres, shapes, scale: float, width: int = 1600, notes: int = 0, left_out=()) -> np.ndarray:
    """Drawn on a plain image of ``width`` px, its thumbnail ``scale`` of that."""
    n = len(labels)
    size = (round(width * 0.75 * scale), round(width * scale))
    _, jpeg = cv2.imencode(".jpg", np.full((*size, 3), GREY, np.uint8))
    seen = centres, np.zeros((n, 2)), np.array(shapes) / FOCAL[:, None], np.tile(np.eye(2), (n, 1, 1))
    image = ImageObservations("12/a.jpg", "12", tuple(labels), *seen)
    drawn = draw_overlay(jpeg.tobytes(), scale, image, ["1", "2"], FOCAL, notes, left_out)
    return cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR).astype(float)


def coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey, (n, 2) as x, y."""
    return np.argwhere(np.ptp(picture, axis=2) > 60)[:, ::-1]


@pytest.mark.parametrize("scale", [1.0, 0.75])
def test_the_rim_is_drawn_where_the_ellipse_is(scale):
    """Every sixteenth of the rim has colour within 1.5 px, and nothing inside it but the cross is coloured."""
    centre, shape = np.array([800.0, 600.0]), np.array([[100.0, 20.0], [0.0, 60.0]])
    found = coloured(overlay(["1:3"], [centre], [shape], scale))
    at = (centre + 0.5) * scale - 0.5
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = at + scale * np.column_stack([np.cos(angle), np.sin(angle)]) @ shape.T
    away = np.linalg.norm(rim[:, None] - found, axis=2).min(1)
    assert away.max() < 1.5
    radius = np.linalg.norm(np.linalg.solve(scale * shape, (found - at).T), axis=0)
    inside = found[(radius < 0.9) & (found[:, 1] > at[1] - 8)]  # the face's name stands above
    assert np.abs(inside - at).max() < 5
    assert np.linalg.norm(inside - at, axis=1).min() < 1


def test_what_is_left_out_has_a_cross_and_the_picture_says_what_it_means():
    """White along the diagonals of the circle, and nowhere else beside a line of words at the bottom."""
    labels, centres = ["1:3", "1:4"], [[500.0, 600.0], [1000.0, 600.0]]
    plain, crossed = (overlay(labels, centres, 2 * [60 * np.eye(2)], 1.0, left_out=x) for x in ((), ("1:4",)))
    y, x = np.nonzero(np.abs(crossed - plain).max(2) > 60)
    legend = y > 1100
    assert legend.sum() > 100
    across, up = np.abs(x - 1000)[~legend], np.abs(y - 600)[~legend]
    assert np.abs(across - up).max() < 8
    assert 60 < across.max() < 100  # as large as the circle
    assert crossed[580:590, 980:990].max() > 230
