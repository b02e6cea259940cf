"""Candidates of either polarity, from 8 to 400 px across, and what is none; time and memory have bounds, whatever the
picture shows."""

import cv2
import numpy as np
import pytest

from stcal import Camera, reference_board, reference_target
from stcal.sfm.detect import image as stage
from stcal.sfm.detect.candidates import OPTION_RANGES, EllipseOptions, find_ellipses
from stcal.sfm.mapping.pairs import PairOptions
from tests.outcome import refuses


def picture(size=(900, 1200), level=40):
    return np.full(size, level, np.uint8)


def add_ellipse(image, centre, axes, angle=0.0, value=200):
    """Anti-aliased: drawn eight times finer and averaged."""
    big = np.zeros((int(2 * max(axes)) + 12, int(2 * max(axes)) + 12))
    half = big.shape[0] // 2
    fine = np.zeros((big.shape[0] * 8,) * 2, np.uint8)
    cv2.ellipse(fine, (half * 8, half * 8), (int(axes[0] * 8), int(axes[1] * 8)), angle, 0, 360, 255, -1)
    share = cv2.resize(fine, big.shape[::-1], interpolation=cv2.INTER_AREA) / 255.0
    y, x = int(centre[1]) - half, int(centre[0]) - half
    patch = image[y : y + big.shape[0], x : x + big.shape[1]]
    patch[:] = np.round(patch + share * (float(value) - patch)).astype(np.uint8)
    return image


def test_circles_of_every_size_and_tilt_are_found_but_beyond_limits_and_faint_blobs():
    for polarity in ("bright", "dark"):
        for diameter in (8, 40, 400):
            level, value = (40, 200) if polarity == "bright" else (200, 40)
            image = add_ellipse(picture(level=level), (600, 450), (diameter / 2, diameter / 2), value=value)
            found = find_ellipses(cv2.GaussianBlur(image, (3, 3), 0.8), polarity, EllipseOptions())
            assert len(found) == 1
            assert np.linalg.norm(found.centre_px[0] - [600, 450]) < 0.02 * diameter + 1
            assert found.radius_px()[0] == pytest.approx(diameter / 2, rel=0.1, abs=0.8)
            assert found.contrast[0] == pytest.approx(160, abs=40)
    for tilt_deg in (30, 70):
        image = add_ellipse(picture(), (600, 450), (30, 30 * np.cos(np.radians(tilt_deg))), angle=35)
        found = find_ellipses(image, "bright", EllipseOptions())
        assert len(found) == 1
        axes = np.linalg.eigvalsh(found.shape_px[0])
        assert axes[0] / axes[1] == pytest.approx(np.cos(np.radians(tilt_deg)), abs=0.06)
    image = add_ellipse(add_ellipse(picture(), (300, 300), (10, 10)), (700, 500), (60, 60))
    add_ellipse(image, (1000, 300), (30, 30), value=48)
    found = find_ellipses(image, "bright", EllipseOptions(min_diameter_px=40))
    assert [round(r) for r in found.radius_px()] == [60]


def of_a_square_and_a_bar():
    image = picture()
    cv2.rectangle(image, (200, 200), (260, 260), 200, -1)
    return cv2.rectangle(image, (500, 200), (700, 215), 200, -1)


@pytest.mark.parametrize(
    ("image", "polarity"),
    [
        (picture(), "bright"),
        (add_ellipse(picture(), (600, 450), (20, 20)), "dark"),
        (of_a_square_and_a_bar(), "bright"),
        (cv2.circle(picture(), (5, 400), 25, 200, -1), "bright"),
    ],
    ids=["plain", "the other polarity", "no ellipses", "cut by the border"],
)
def test_what_is_no_circle_is_not_found(image, polarity):
    assert len(find_ellipses(image, polarity, EllipseOptions())) == 0


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
