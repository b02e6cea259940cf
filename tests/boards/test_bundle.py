"""Bundles of apriltag_ros: tags as AprilTag's own pictures show them, in the frame of its bundles; and families of
AprilTag that OpenCV lacks, drawn from the cells that AprilTag's own library draws."""

import cv2
import numpy as np
import pytest

from stcal.boards import dictionaries
from stcal.boards.board_designs import UNIT_SQUARE
from stcal.boards.board_file import load_flat_board
from stcal.boards.dictionaries import dictionary_of, known_dictionary, of_opencv
from stcal.boards.tags import find_tags
from stcal.geometry.plane import apply_homography
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.locate.layout import load_layout, load_plan
from stcal.locate.scenes import find_scenes, run
from tests.boards.drawn import kalibr_tag
from tests.outcome import refuses
from tests.shared import written
from tests.support.areas import warped

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
    assert (plan.tags, plan.size_mm.tolist()) == ((("DICT_APRILTAG_25h9", 3),), [50.0])
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


CELLS = {
    ("tagStandard41h12", 0): "1bc 000 17c 07d 04c 055 17c 000 1a4",
    ("tagStandard41h12", 2114): "1ef 000 07c 144 144 07c 07c 100 055",
    ("tagCircle21h7", 37): "038 000 07c 065 075 15c 07c 000 020",
}
"""Printed tags by family and id, from ``apriltag_to_image`` of AprilTag 3, in rows of nine bits: 1 is white,
the white ring 5 cells wide."""
RING = 5
PER_CELL = 16
LAYOUT = """type = "tags"
tag = [{ dictionary = "TagStandard41h12", id = 3, size_mm = 40, x_mm = 0, y_mm = 0 }]
"""


def view_of_tag(tag: tuple[str, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    cells = 255 * np.array([[int(bit) for bit in f"{int(row, 16):09b}"] for row in CELLS[tag].split()], np.uint8)
    sheet = np.kron(np.pad(cells, 1, constant_values=255), np.ones((PER_CELL, PER_CELL), np.uint8))
    cell_px, angle = rng.uniform(5.5, 12), rng.uniform(0, 2 * np.pi)
    across = cell_px * np.array([np.cos(angle), np.sin(angle)])
    down = cell_px * rng.uniform(0.7, 1) * np.array([-np.sin(angle), np.cos(angle)])
    image_from_cells = np.column_stack([np.append(c, rng.uniform(-0.01, 0.01)) for c in (across, down)])
    image_from_cells = np.column_stack([image_from_cells, [*(90 + rng.uniform(size=2)), 1]])
    first = 0.5 - len(sheet) / 2
    cells_from_sheet = np.array([[1, 0, first], [0, 1, first], [0, 0, PER_CELL]])
    image = warped(sheet, image_from_cells @ cells_from_sheet, (180, 180), rng, 0.6, (25.0, 216.0), 1.5)
    return image, apply_homography(image_from_cells, RING * UNIT_SQUARE)


@pytest.mark.parametrize("tag", CELLS)
def test_tags_of_other_families_have_their_corners_and_sigma(tag):
    pytest.importorskip("pupil_apriltags")
    squares = []
    for seed in range(6):
        image, corners = view_of_tag(tag, seed)
        tags = find_tags(image, (tag[0],))
        assert tags.tags == (tag,)
        off = tags.corners_px[0] - corners
        assert np.abs(off).max() < 0.1
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(tags.corner_covariances_px2()[0]), off) / 2)
    assert 0.4 < np.mean(squares) < 2.5  # 24 corners, and the four of a tag share its edges


def test_both_kinds_of_tags_are_read_in_one_image():
    pytest.importorskip("pupil_apriltags")
    first, corners = view_of_tag(("tagStandard41h12", 0), 1)
    second = np.full((180, 180), 210, np.uint8)
    second[50:130, 50:130] = cv2.aruco.generateImageMarker(dictionary_of("4X4_50"), 7, 80)
    tags = find_tags(np.hstack([first, second]), ("tagStandard41h12", "DICT_4X4_50"))
    assert sorted(tags.tags) == [("DICT_4X4_50", 7), ("tagStandard41h12", 0)]
    found = dict(zip(tags.tags, tags.corners_px, strict=True))
    np.testing.assert_allclose(found["tagStandard41h12", 0], corners, atol=0.1)
    np.testing.assert_allclose(found["DICT_4X4_50", 7][0], [229.5, 49.5], atol=0.1)


@pytest.fixture
def installed(monkeypatch):
    """Function that says whether the package for these families is there."""
    known_dictionary.cache_clear()
    yield lambda there: monkeypatch.setattr(dictionaries, "find_spec", lambda _: there)
    known_dictionary.cache_clear()


@pytest.mark.parametrize("family", ["tagStandard41h12", "TAGCIRCLE21H7", "tag_standard_41h12"])
def test_without_the_package_its_extra_is_offered(installed, tmp_path, family):
    installed(None)
    path = written(tmp_path / "b.toml", LAYOUT.replace("TagStandard41h12", family))
    package = "pip install 'stereo-target-calibration[apriltag]'"
    refuses(f"E-KEY-VALUE … dictionary … {package} … tag36h11", load_flat_board, path)


def test_families_are_known_by_name_and_tags_of_their_bundles_stand_as_printed(installed, tmp_path):
    installed(True)
    bundle = "tag_bundles: [{name: one, layout: [{id: 3, size: 0.04, x: 0.1, y: 0.02, z: 0, qw: 1}]}]\n"
    path = written(tmp_path / "tags.yaml", "tag_family: tagStandard41h12\n" + bundle)
    layout = load_flat_board(path)  # Y of apriltag_ros goes up
    np.testing.assert_allclose(layout.corners_mm[0], [[80, -40], [120, -40], [120, 0], [80, 0]], atol=1e-9)
    path = written(tmp_path / "b.toml", LAYOUT)
    assert load_flat_board(path).tags == (("tagStandard41h12", 3),)
    wrong = written(path, LAYOUT.replace("id = 3", "id = 2115"))
    refuses("E-TAG-ID-RANGE … 2115 … tagStandard41h12 has 0 … 2114", load_flat_board, wrong)
    with pytest.raises(ValueError, match="only a layout of tags"):
        of_opencv("tagStandard41h12")
    refuses("E-TAG-DICTIONARY … tagStandard41h12 … not drawn here", dictionary_of, "tagStandard41h12")


@pytest.mark.parametrize(
    ("name", "why"),
    [(name, "gigabyte") for name in ("tagStandard52h13", "tagCircle49h12", "tagCustom48h12")]
    + [(name, "OpenCV does not detect this family") for name in ("tag52h13", "tagStandard36h11")],
)
def test_families_that_are_not_read_are_refused(name, why):
    with pytest.raises(ValueError, match=why):
        known_dictionary(name)
