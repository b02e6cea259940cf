"""Time and memory of detection have bounds, whatever the picture shows."""

import cv2
import numpy as np
import pytest

from stcal import Camera, reference_board, reference_target
from stcal.sfm.detect import image as stage
from stcal.sfm.detect.candidates import OPTION_RANGES, EllipseOptions
from stcal.sfm.mapping.pairs import PairOptions
from tests.outcome import refuses

CAMERA = Camera(400, 300, np.array([500.0, 500.0]), np.array([200.0, 150.0]), np.zeros(8))


def checkerboard(side: int = 6) -> np.ndarray:
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    return cv2.GaussianBlur((((x // side) + (y // side)) % 2 * 160 + 40).astype(np.uint8), (0, 0), 0.7)


@pytest.mark.parametrize(
    ("image", "error"),
    [
        (checkerboard()[::2, ::2], "E-IMAGE-SIZE … 200×150 px, camera 400×300"),
        (np.dstack([checkerboard()] * 3), "E-IMAGE-TYPE … (300, 400, 3) … green"),
        (checkerboard() / 255, "E-IMAGE-TYPE … float64"),
    ],
)
def test_an_array_that_is_no_grey_image_of_the_camera_is_refused(image, error):
    refuses(error, stage.detect_image, image, CAMERA, reference_target(), None, EllipseOptions())


@pytest.mark.slow
def test_of_a_fine_pattern_the_largest_outlines_are_tried_and_it_is_said(monkeypatch):
    monkeypatch.setattr(stage, "MAX_FREE", 30)
    found = stage.detect_image(checkerboard(), CAMERA, reference_target(), reference_board(), EllipseOptions())
    assert found.candidates > 1000
    assert "the 30 largest were tried for faces; keep fine patterns out of view, or raise --min-d" in found.notes[0]
    assert found.boards == found.faces == ()


@pytest.mark.parametrize("value", [0.0, 1e308, np.nan])
@pytest.mark.parametrize(
    ("options", "name"), [*((EllipseOptions, name) for name in OPTION_RANGES), (PairOptions, "max_angle_rad")]
)
def test_options_have_ranges(options, name, value):
    refuses(f"{'E-OPTION-RANGE' if np.isfinite(value) else 'E-FIELD-TYPE'} … {name}", options, **{name: value})
