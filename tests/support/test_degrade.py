"""Degraded photographs: each does what it says, and nothing else."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support import degrade
from tests.support.photograph import Photograph, RenderedSet, read_set

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "sample"
STEP = np.tile(np.where(np.arange(120) < 60, 40.0, 200.0).astype(np.float32), (80, 1))
POINT = np.zeros((81, 81), np.float32)
POINT[40, 40] = 1000.0
EVEN = np.full((200, 300), 120, np.uint8)


@pytest.fixture(scope="module")
def rendered() -> RenderedSet:
    return read_set(SAMPLE, at_most=1)


@pytest.fixture(scope="module")
def photo(rendered) -> Photograph:
    return rendered.photographs[0]


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid, and the root of the second moments about it, along x and y, px."""
    xy = np.indices(image.shape)[::-1]
    middle = (xy * image).sum((1, 2)) / image.sum()
    return middle, np.sqrt(((xy - middle[:, None, None]) ** 2 * image).sum((1, 2)) / image.sum())


def test_defocus_spreads_a_point_over_a_disc():
    disc = degrade.defocused(POINT, 6.0)
    assert disc.sum() == pytest.approx(1000, rel=1e-5)
    centroid, spread = moments(disc)
    assert centroid == pytest.approx([40, 40], abs=1e-3)
    assert spread == pytest.approx([3, 3], rel=0.02)  # r/2 of an even disc
    assert np.count_nonzero(disc > 0.5 * disc.max()) == pytest.approx(np.pi * 36, rel=0.05)


def test_motion_spreads_a_point_over_a_line_and_leaves_its_middle():
    for angle in (0.0, 0.9, np.pi / 2):
        centroid, spread = moments(degrade.motion_blurred(POINT, 12.0, angle))
        assert centroid == pytest.approx([40, 40], abs=1e-3)
        # An even line of 12 px has a spread of 12/√12; sharing points among pixels adds up to 1/4 px².
        along = np.array([abs(np.cos(angle)), abs(np.sin(angle))]) * 12 / np.sqrt(12)
        assert spread == pytest.approx(along, abs=0.1)


def test_rolling_shutter_moves_points_where_it_says():
    smooth = cv2.GaussianBlur(np.pad(POINT, ((0, 60), (0, 0))), (0, 0), 2.0)
    moved = degrade.rolling_shutter(smooth, 8.0)
    expected = degrade.rolled(np.array([40.0, 40.0]), 8.0, smooth.shape[0])
    assert expected[0] == pytest.approx(40 + 8 * (40 / 140 - 0.5))
    assert moments(np.maximum(moved, 0))[0] == pytest.approx(expected, abs=0.02)


def test_noise_has_its_sigma_and_seed():
    noisy = degrade.noisy(EVEN, 12.0, 3)
    assert (noisy - EVEN).std() == pytest.approx(12, rel=0.02)  # 60 000 pixels: 0.3 %
    assert abs((noisy - EVEN).mean()) < 0.3
    assert (noisy == degrade.noisy(EVEN, 12.0, 3)).all()
    assert (noisy != degrade.noisy(EVEN, 12.0, 4)).any()


def test_exposure_clips_and_blooms():
    assert degrade.exposed(STEP, 0.5) == pytest.approx(STEP / 2)
    bright = degrade.stored(degrade.exposed(STEP, 2.0)).astype(float)
    assert (bright[:, 61:] == 255).all()
    assert (bright[:, :30] == 80).all()
    assert 85 < bright[40, 58] < 110  # half of 15 % of the 145 grey values lost beside it: 91


def test_the_truth_says_where_circles_are(rendered, photo):
    truth = rendered.truth["groups"][photo.group]["images"][photo.name]["circles"]
    ellipses = photo.ellipses()
    assert ellipses.keys() == truth.keys()
    for label, (centre, radius) in ellipses.items():
        assert np.hypot(*(centre - truth[label]["centre_px"])) < 0.3  # eccentricity
        assert 2 < radius < 20
    for plane in photo.planes:
        circle, plate = photo.levels(plane)
        assert circle > plate + 50


def test_pixels_and_planes_belong_together(photo):
    x, y = np.meshgrid([3, 700, 1500], [5, 1030])
    exact = photo.camera.normalised_from_pixel(np.stack([x, y], axis=-1))
    assert photo.ideal[y, x] == pytest.approx(exact, abs=1e-8)  # 2e-5 px
    window, unit = photo.circle(photo.board, 0, 1.5)
    place = photo.camera.project(photo.board.xyz_camera(photo.board.xy_mm[0]))
    corner = np.array([window[1].start, window[0].start])
    nearest = np.unravel_index(np.argmin(np.hypot(unit[..., 0], unit[..., 1])), unit.shape[:2])
    assert np.abs(corner + nearest[::-1] - place).max() <= 0.5


def test_hidden_circles_are_gone_and_others_stay(photo):
    face = photo.faces[0]
    image = degrade.without_circles(photo, face.labels[:3])
    assert degrade.covered_labels(photo, image) == (set(face.labels[:3]), set())
    circle, plate = photo.levels(face)
    x, y = np.rint(photo.ellipses()[face.labels[0]][0]).astype(int)
    assert image[y, x] == pytest.approx(plate, abs=15)
    assert photo.grey[y, x] == pytest.approx(circle, abs=40)


def test_cut_circles_lose_their_share(photo):
    face = max(photo.faces, key=lambda f: sum(photo.must_find.get(k, False) for k in f.labels))
    label = face.labels[0]
    image = degrade.cut_circles(photo, [label], 0.3, 5)
    window, _ = photo.circle(face, 0, 1.3)
    _, plate = photo.levels(face)
    lost = (photo.grey[window] - image[window]).sum() / (photo.grey[window] - plate).sum()
    assert lost == pytest.approx(0.3, abs=0.04)
    assert degrade.covered_labels(photo, image) == (set(), {label})


def test_what_stands_behind_covers_neither_target_nor_board(photo):
    board = photo.board.moved(np.eye(3), np.array([150.0, 200.0, 400.0]))
    image = degrade.behind(photo, [board], [(255.0, 90.0)])
    assert degrade.covered_labels(photo, image) == (set(), set())
    assert 0.005 < (np.abs(image - photo.grey) > 20).mean() < 0.2
