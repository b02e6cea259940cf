"""A target made in code, located in an image that is an array."""

import cv2
import numpy as np
import pytest

from stcal.boards.board_designs import CharucoDesign, TagLayout
from stcal.boards.finders import find_charuco
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.locate.layout import TargetLayout
from stcal.locate.scenes import locate_image
from tests.outcome import fails_with, refuses
from tests.support.areas import homography, rendered

CAMERA = Camera(320, 240, [500.0, 500.0], [159.5, 119.5], np.zeros(8))
LAYOUT = TagLayout.from_tags("4X4_50", [3, 7], [[0.0, 0.0], [50.0, 0.0]], [30.0, 25.0], [0.0, 90.0])
TRUTH = Rigid.exp([0.3, 0.2, 0.1, -25.0, 5.0, 300.0])


@pytest.fixture(scope="module")
def grey():
    matrix = np.array([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]])
    place = homography(matrix, TRUTH.rotation, TRUTH.translation)
    return rendered(LAYOUT, place, (320, 240), np.random.default_rng(1))


@pytest.mark.parametrize(
    "camera", [CAMERA, CameraModel((500, 500), (159.5, 119.5), np.zeros(8), "PINHOLE", 320, 240, "")]
)
def test_an_array_is_located(grey, camera):
    result = locate_image(grey, LAYOUT, camera)
    assert result.verdict.decision == "accept"
    error = Poses.of([result.pose.camera_from_obj]).difference(Poses.of([TRUTH]))[0]
    assert error @ np.linalg.solve(result.pose.covariance, error) < 22.5  # one in a thousand (6 degrees of freedom)


def test_colour_and_depth_of_an_array_do_not_matter(grey):
    plain = locate_image(grey, TargetLayout.of(LAYOUT), CAMERA).pose
    for image in (np.dstack([grey] * 3), grey[:, :, None], grey.astype(np.uint16) * 257):
        pose = locate_image(image, LAYOUT, CAMERA).pose.camera_from_obj
        assert np.linalg.norm(pose.translation - plain.camera_from_obj.translation) < 3 * plain.sigma_mm()


def test_a_wrong_dictionary_is_named(grey):
    other = TagLayout.from_tags("5X5_50", [1], [[0.0, 0.0]], 30.0)
    result = locate_image(grey, other, CAMERA)
    assert result.pose is None
    assert result.verdict.reasons[0].startswith("no tag of DICT_5X5_50")
    assert "shows 2 of DICT_4X4" in result.verdict.reasons[0]
    assert "correct dictionary" in result.verdict.reasons[0]


def test_images_that_are_none_of_the_cameras(grey):
    refuses("E-IMAGE-SIZE … image … 160×120 … 320×240", locate_image, grey[::2, ::2], LAYOUT, CAMERA)
    refuses("E-ARRAY-SHAPE … image … (240, 320, 2)", locate_image, cv2.merge([grey, grey]), LAYOUT, CAMERA)
    refuses("E-IMAGE-TYPE … image … float64", locate_image, grey / 255, LAYOUT, CAMERA)


def test_tags_of_a_layout():
    assert LAYOUT.tags == (("DICT_4X4_50", 3), ("DICT_4X4_50", 7))
    assert np.allclose(LAYOUT.corners_mm[0], [[-15, -15], [15, -15], [15, 15], [-15, 15]])
    # turned from X to Y: top left goes to where top right was
    assert np.allclose(LAYOUT.corners_mm[1], [[62.5, -12.5], [62.5, 12.5], [37.5, 12.5], [37.5, -12.5]])
    refuses("E-TAG-DICTIONARY … 4x4_51", TagLayout.from_tags, "4x4_51", [1], [[0.0, 0.0]], 30.0)
    refuses("E-TAG-ID-RANGE … 50 … DICT_4X4_50", TagLayout.from_tags, "4x4_50", [50], [[0.0, 0.0]], 30.0)
    with fails_with("E-TAG-REPEATED … 1"):
        TargetLayout("", (("4x4_50", 1), ("DICT_4X4_50", 1)), np.zeros((2, 4, 2)), np.zeros((16, 16)), 0)
    refuses("E-TAG-SIZE … -1", TagLayout.from_tags, "4x4_50", [1], [[0.0, 0.0]], -1.0)
    refuses("E-ARRAY-SHAPE", TagLayout.from_tags, "4x4_50", [1, 2], [[0.0, 0.0]], 30.0)
    with fails_with("E-TAG-DICTIONARY … 4x4_51"):
        find_charuco(np.zeros((9, 9), np.uint8), "", CharucoDesign(5, 7, 30.0, 20.0, "4x4_51"))
