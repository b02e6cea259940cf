"""Data sets on disk: complete, readable by the package itself, and in the form of the shared data."""

import json

import cv2
import numpy as np
import pytest

from stcal.boards.board_file import load_board
from stcal.boards.target_file import load_target
from stcal.io.cameras.read import read_camera
from stcal.synthetic.dataset import TruthFile, write_dataset
from stcal.synthetic.designs import second_design
from stcal.synthetic.render import RenderOptions, render
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.outcome import refuses

OPTIONS = SceneOptions(seed=5, width=324, height=216, images_per_group=2)


@pytest.fixture(scope="module")
def scene():
    return make_scene(OPTIONS)


def _keys(value):
    """The form of a JSON value: keys, types, and lengths of arrays; names that data choose become ``*``."""
    if isinstance(value, dict):
        fixed = {key: _keys(v) for key, v in value.items() if not any(c in key for c in ":/") and not key.isdigit()}
        free = [_keys(v) for key, v in value.items() if key not in fixed]
        return fixed | ({"*": free[0]} if free else {})
    if isinstance(value, list):
        return [_keys(value[0]), len(value)]
    return type(value).__name__


@pytest.mark.parametrize("name", ["sample", "clean", "clutter"])
def test_truth_has_the_form_of_the_rendered_sets(scene, sample, shared_data, name):
    folder = sample if name == "sample" else shared_data(f"stereo_target/{name}")
    shared, ours = (
        json.loads((folder / "truth.json").read_text()),
        json.loads(json.dumps(TruthFile.of(scene).content())),
    )
    assert _keys(ours) == _keys(shared)
    assert list(ours["circles"]) == list(shared["circles"])
    assert list(ours["target_from_face"]) == list(shared["target_from_face"])
    image, other = (data["groups"]["12"]["images"]["12/IMG_1001.jpg"]["circles"] for data in (ours, shared))
    assert list(image)[-63:] == list(other)[-63:]


def test_truth_predicts_its_own_pixels(scene):
    data = TruthFile.of(scene).content()
    name, image = next(iter(data["groups"]["15"]["images"].items()))
    assert name == "15/IMG_1000.jpg"
    camera_from_target = np.array(image["camera_from_target"])
    focal, centre, d = scene.camera.focal[0], scene.camera.centre, scene.camera.distortion
    known = data["circles"] | {f"board:{i}": xyz for i, xyz in enumerate(data["groups"]["15"]["board_circles_target"])}
    for label, circle in image["circles"].items():
        x, y, z = (camera_from_target @ [*known[label], 1])[:3]
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + d[0] * r2 + d[1] * r2**2
        u = x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x)
        v = y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y
        # The file rounds to 1e-5 px.
        np.testing.assert_allclose(circle["centre_px"], focal * np.array([u, v]) + centre, atol=1.1e-5)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_data_set_on_disk(tmp_path, workers):
    scene = make_scene(OPTIONS, *second_design())
    finished = []
    paths = write_dataset(
        tmp_path / "new", scene, RenderOptions(), workers=workers, progress=lambda *count: finished.append(count)
    )
    folder = tmp_path / "new"
    assert [str(p.relative_to(folder / "images")) for p in paths] == [
        f"{group}/IMG_100{i}.jpg" for group in ("top-left", "top-right", "left-right") for i in (0, 1)
    ]
    assert finished == [(done, 6) for done in range(1, 7)]
    picture = cv2.imread(str(paths[3]), cv2.IMREAD_GRAYSCALE).astype(float)
    rendered = render(scene, "top-right", 1).astype(float)
    assert 0.1 < np.sqrt(((picture - rendered) ** 2).mean()) < 3  # JPEG at quality 95
    camera = read_camera(folder / "cameras.txt")
    assert camera.colmap_model == "OPENCV"
    np.testing.assert_allclose(camera.centre, scene.camera.centre, atol=1e-9)
    np.testing.assert_array_equal(camera.distortion, scene.camera.distortion)
    target, board = load_target(folder / "target.toml"), load_board(folder / "board.toml")
    assert target.polarity == "dark"
    for read, made in zip(target.faces, scene.target.faces, strict=True):
        assert read.ids == made.ids
        np.testing.assert_allclose(read.xy_mm, made.xy_mm, atol=1e-8)
    assert (board.corner, board.corner_radius_mm, board.columns) == ((0, 7), 7.5, 8)
    assert json.loads((folder / "truth.json").read_text()) == TruthFile.of(scene).content()


def test_png_holds_the_image_exactly(tmp_path):
    scene = make_scene(SceneOptions(seed=5, width=324, height=216, images_per_group=1, groups=(("1", "2"),)))
    (path,) = write_dataset(tmp_path, scene, RenderOptions(bit_depth=16), image_format="png", workers=1)
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint16
    np.testing.assert_array_equal(picture, render(scene, "12", 0, RenderOptions(bit_depth=16)))


def test_refusals_and_a_data_set_that_fails_leaves_no_folder(tmp_path, scene):
    (tmp_path / "mine.txt").write_text("keep")
    refuses("E-OUTPUT-EXISTS", write_dataset, tmp_path, scene)
    refuses("E-OUTPUT-EXISTS", write_dataset, tmp_path / "mine.txt", scene)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    refuses("E-OPTION-FORM … tif", write_dataset, tmp_path / "new", scene, image_format="tif")
    refuses("E-OPTION-FORM", write_dataset, tmp_path / "new", scene, RenderOptions(bit_depth=16))

    def fails(done, total):
        raise RuntimeError("no")

    folder = tmp_path / "new" / "set"
    with pytest.raises(RuntimeError, match="no"):
        write_dataset(folder, scene, workers=2, progress=fails)
    assert not folder.exists()


def test_another_seed_photographs_the_same_body_again():
    first, again, other = (
        make_scene(SceneOptions(seed=seed, body_seed=own, one_board=True))
        for seed, own in ((3, None), (4, 3), (4, None))
    )
    assert str(first.target_from_face) == str(again.target_from_face) != str(other.target_from_face)
    assert np.array_equal(first.camera.parameters(), again.camera.parameters())
    group, taken_again = (each.groups["12"] for each in (first, again))
    assert not np.array_equal(group.board_circles_target, taken_again.board_circles_target)
    assert group.camera_from_target[0] != taken_again.camera_from_target[0]
