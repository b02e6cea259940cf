"""Bundles of apriltag_ros: tags as AprilTag's own pictures show them, in the frame of its bundles."""

import cv2
import numpy as np
import pytest

from stcal.boards.board_file import load_flat_board
from stcal.boards.dictionaries import known_dictionary
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.locate.layout import load_layout, load_plan
from stcal.locate.scenes import find_scenes, run
from tests.boards.drawn import kalibr_tag
from tests.outcome import refuses
from tests.shared import written

BUNDLE = """standalone_tags: []
tag_bundles:
  [{name: 'two', layout: [
    {id: 0, size: 0.08, x: 0.0, y: 0.0, z: 0.0, qw: 1, qx: 0, qy: 0, qz: 0},
    {id: 1, size: 0.08, x: 0.12, y: 0.05, z: 0.0, qw: 0.70710678, qx: 0, qy: 0, qz: 0.70710678}]}]
"""
"""Tag 1 stands 120 mm to the right of tag 0 and 50 mm above, and is turned to the left by 90°."""
FOCAL, WIDTH, HEIGHT = 1000.0, 1200, 900


def sheet():
    """A drawing with 10 px of a cell (10 mm): tag 0 at the middle of the left half, tag 1 turned, right and above."""
    drawing = np.full((340, 400), 255, np.uint8)
    for tag, quarter_turns, (x, y) in ((0, 0, (120, 200)), (1, 1, (240, 150))):
        cells = np.rot90(np.pad(kalibr_tag(tag, 1), 1, constant_values=255), quarter_turns)
        drawing[y - 50 : y + 50, x - 50 : x + 50] = np.kron(cells, np.ones((10, 10)))
    return drawing


@pytest.mark.parametrize("tag", [0, 1])
def test_opencv_draws_tags_half_a_turn_from_aprilag(tag):
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), tag, 8)
    np.testing.assert_array_equal(np.rot90(kalibr_tag(tag, 1), 2), drawn)


def test_a_photograph_of_a_bundle(tmp_path):
    """The sheet is parallel to the image, 500 mm away: a mm is 2 px."""
    image = cv2.resize(sheet(), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    photo = np.full((HEIGHT, WIDTH), 255, np.uint8)
    photo[100 : 100 + image.shape[0], 150 : 150 + image.shape[1]] = image
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), cv2.GaussianBlur(photo, (0, 0), 1.0))
    camera = CameraModel((FOCAL, FOCAL), (600.0, 450.0), np.zeros(12), "PINHOLE", WIDTH, HEIGHT, "test")
    located = next(
        iter(run(find_scenes(tmp_path / "images"), load_layout(written(tmp_path / "tags.yaml", BUNDLE)), camera))
    )
    assert located.verdict.decision == "accept"
    pose = located.pose.camera_from_obj
    # {obj}: Z into the target as the camera looks; X to the left and Y up, half a turn about Z.
    assert Rigid(np.diag([-1.0, -1, 1]).T @ pose.rotation).angle_rad() < 0.02
    middle_px = np.array([150 + 2 * 120 - 0.5, 100 + 2 * 200 - 0.5])
    wanted = np.append((middle_px - [600, 450]) / FOCAL * 500, 500)
    assert np.abs(pose.translation - wanted)[:2].max() < 0.1  # 0.2 px
    assert abs(pose.translation[2] - 500) < 2


def test_tags_that_stand_as_opencv_draws_them_and_standalone_ones_without_a_place(tmp_path):
    as_april = load_layout(written(tmp_path / "tags.yaml", BUNDLE)).corners_mm
    upright = load_layout(written(tmp_path / "tags.yaml", "upright: true\n" + BUNDLE)).corners_mm
    np.testing.assert_allclose(upright[0], [[-40, -40], [40, -40], [40, 40], [-40, 40]], atol=1e-9)
    np.testing.assert_allclose(upright[1].mean(axis=0), [120, -50], atol=1e-9)
    np.testing.assert_allclose(as_april[1].mean(axis=0), [-120, 50], atol=1e-9)
    assert load_flat_board(written(tmp_path / "tags.yaml", BUNDLE)).tags == (
        ("DICT_APRILTAG_36h11", 0),
        ("DICT_APRILTAG_36h11", 1),
    )
    plan = load_plan(written(tmp_path / "tags.yaml", "tag_family: tag25h9\nstandalone_tags: [{id: 3, size: 0.05}]\n"))
    assert plan.tags == (("DICT_APRILTAG_25h9", 3),)
    assert np.isnan(plan.corners_mm).all()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (BUNDLE.replace("size: 0.08", "size: 80"), "E-LENGTH-UNIT … tag 0 … 80000"),
        (BUNDLE.replace("x: 0.12, y: 0.05, z: 0.0", "x: 0.12, y: 0.05, z: 0.02"), "E-LAYOUT-FLAT … tag 1 … 20 mm"),
        (BUNDLE.replace("qx: 0, qy: 0, qz: 0.70710678", "qx: 0.70710678, qy: 0, qz: 0"), "E-LAYOUT-FLAT … tag 1 … 90"),
        (BUNDLE.replace("qz: 0.70710678", "qz: 0"), "E-QUATERNION-LENGTH … tag 1"),
        (BUNDLE.replace("}]}]", "}]}, {name: b, layout: [{id: 5, size: 0.1}]}]"), "E-LAYOUT-BUNDLES … two, b"),
        (BUNDLE.replace("z: 0.0, qw: 1", "Z: 0.0, qw: 1"), "E-KEY-UNKNOWN"),
        ("tag_family: tagCustom48h12\n" + BUNDLE, "E-KEY-VALUE … tagCustom48h12 … tag36h11"),
    ],
)
def test_mistakes_in_bundles(tmp_path, text, error):
    refuses(error, load_layout, written(tmp_path / "tags.yaml", text))


def test_names_of_families():
    names = {"tag36h11": "36h11", "Tag16h5": "16h5", "t25h9": "25h9", "tag36h10": "36h10", "apriltag_36h11": "36h11"}
    assert {name: known_dictionary(name) for name in names} == {n: f"DICT_APRILTAG_{own}" for n, own in names.items()}
    assert known_dictionary("DICT_6X6_250") == "DICT_6X6_250"
    for name in ("tagStandard41h12", "TAGCIRCLE21H7", "tag_custom_48h12", "tag52h13", "tagStandard36h11"):
        with pytest.raises(ValueError, match=r"OpenCV does not detect this family .* tag36h11"):
            known_dictionary(name)
