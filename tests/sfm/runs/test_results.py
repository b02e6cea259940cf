"""What a run gives: its folder, which any COLMAP can use, the same on arrays, the camera as it was adjusted, a camera
file for other commands, and what in the photographs limits σ."""

import json
import math
import re
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from stcal import sfm, synthetic
from stcal.errors import InputNote
from stcal.io.cameras.camera_model import model_of
from stcal.io.cameras.read import read_camera
from stcal.io.files import CAMERA, REFINED_CAMERA
from stcal.sfm import RunOptions, run
from stcal.sfm.adjust.refine import adjust, find_scale
from stcal.sfm.camera.intrinsics import model_parameters
from stcal.sfm.mapping.body import unknown_lens
from stcal.sfm.mapping.database import from_colmap_px, image_ids
from stcal.sfm.mapping.incremental import map_group
from stcal.sfm.mapping.pairs import PairOptions, rank_pairs
from stcal.sfm.runs.conditions import conditions
from stcal.synthetic import RenderOptions, write_dataset
from tests.conftest import SMALL
from tests.levels import SLOW, sampled
from tests.outcome import fails_with
from tests.shared import own_copy


def test_a_result_shows_itself_and_every_promised_file_is_there(small_result, small_run):
    """Faces and labels are read back in `runs/test_saved_run.py`; intrinsics that are held make no file."""
    text, page = repr(small_result), small_result._repr_html_()
    assert len(text) < 500
    assert "\n" not in text
    assert small_result.judgement.use.removesuffix(".") in text
    assert small_result.judgement.use in page
    assert re.findall(r'<th scope="row" class="l">(\d)', page) == list(small_result.target.target_from_face)
    out = small_run
    np.testing.assert_allclose(json.loads((out / "faces.json").read_text())["circles"]["1:1"], 0, atol=0.01)
    report = json.loads((out / "report.json").read_text())
    assert report["summary"]["images_mapped"] == 8
    assert len(report["groups"][0]["pairs"]) == 6
    assert (out / "report.html").stat().st_size > 100_000
    assert {p.name for p in (out / "colmap/models").iterdir()} == {"12", "14"}
    assert not list(out.rglob("*.partial"))
    assert not (out / "scratch").exists()
    assert (small_run / CAMERA).is_file()
    assert not (small_run / REFINED_CAMERA).exists()


def test_any_colmap_makes_an_unbiased_model_of_the_database(small_result, tmp_path):
    """Mapped again from the file alone, without any correction: the board keeps its shape and the faces their place."""
    result = small_result
    observations = result.observations
    ids = image_ids(observations)
    group = [o for o in observations if o.group == "12"]
    pairs = rank_pairs(group, result.camera, PairOptions())
    own = own_copy(result.out / "colmap/database.db", tmp_path)  # pycolmap changes what it opens
    mapping = map_group(own, tmp_path / "scratch", group, list(ids), ids, pairs, result.camera)
    ours = next(s.model for s in result.solutions if s.model.group == "12")
    with pycolmap.Database.open(str(own)) as database:
        keypoints = {o.name: from_colmap_px(database.read_keypoints(ids[o.name])[:, :2]) for o in group}
    model = mapping.model
    rows = zip(model.image_index, model.keypoint, strict=True)
    plain = np.array([keypoints[model.images[i]][k] for i, k in rows])
    theirs = adjust(replace(model, measured_px=plain), result.camera)
    distances = []
    for each in (ours, theirs):
        scale = find_scale(each, result.board_design).mm_per_unit
        place = {label: scale * xyz for label, xyz in zip(each.labels, each.xyz_model, strict=True)}
        distances.append(np.linalg.norm(place["1:1"] - place["2:1"]))
    assert distances[0] == pytest.approx(distances[1], abs=2e-4)  # float32 keypoints; the bias would be 0.05 mm


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@SLOW
@pytest.mark.usefixtures("no_page")
def test_arrays_give_what_files_give(tmp_path, scratch):
    scene = synthetic.make_scene(replace(SMALL, groups=(("1", "2"),)))
    write_dataset(tmp_path / "data", scene, image_format="png")
    from_files = sfm.run(tmp_path / "data" / "images", scene.camera, tmp_path / "run")
    result = sfm.run(synthetic.render_all(scene), scene.camera)
    assert result.out is None
    assert list(scratch.glob("stcal-run*")) == []
    assert result.target.circles.keys() == from_files.target.circles.keys()
    worst = max(np.abs(result.target.circles[k] - from_files.target.circles[k]).max() for k in result.target.circles)
    assert worst < 1e-6  # mm: the same pixels; sums in another order
    assert result.judgement.use == from_files.judgement.use
    images = result.images()
    assert [image.name for image in images][:2] == ["12/0.png", "12/1.png"]
    for image in images:
        assert len(image.residuals_px) == len(image.labels) == len(image.xy_px)
        assert 0.5 < np.linalg.norm(image.residuals_px) / (image.rms_px * np.sqrt(image.residuals_px.size)) < 2
        true = scene.groups[image.group].camera_from_target[int(image.name[-5])]
        between = true.inverse() @ image.camera_from_target
        # The target frame through a plane and that through three circles placed to 0.02 mm.
        assert np.linalg.norm(between.translation) < 0.3
        assert (np.linalg.eigvalsh(image.covariance) > 0).all()


def test_a_run_that_fails_leaves_no_file_either(scratch):
    with fails_with("E-GROUP-FEW-IMAGES … 1/0.png"):
        sfm.run({"1": [np.zeros((864, 1296), np.uint8)]}, synthetic.make_scene(SMALL).camera)
    assert list(scratch.glob("stcal-run*")) == []


pytestmark = pytest.mark.usefixtures("no_page")
CHI2_8_999 = 26.1
"""Of the squares of eight parameters' errors over their σ, once in a thousand draws more."""


@pytest.mark.parametrize("given", sampled(["as of EXIF, 4 % off", "nothing"]))
def test_an_unknown_or_rough_camera_is_found_from_the_dots(small_dataset, small_scene, tmp_path, given):
    """The photographs have a lens with distortion. It is right within its σ, and far nearer than what was given."""
    true = small_scene.camera
    rough = replace(true, focal=np.full(2, 1.04 * true.focal.mean()), distortion=np.zeros(12))
    camera = None if given == "nothing" else model_of(unknown_lens(rough))
    files = [small_dataset / name for name in ("target.toml", "board.toml")]
    told = pytest.warns(InputNote, match="focal length to ±") if camera else nullcontext()
    with told:  # the file's own σ is reason enough to adjust the camera
        result = run(small_dataset / "images", camera, tmp_path / "run", *files, RunOptions(workers=1))
    assert not result.camera_given
    assert not result.notes
    found = read_camera(tmp_path / "run" / REFINED_CAMERA)
    assert np.allclose(found.focal, result.calibration.camera.focal, rtol=1e-12)
    off = model_parameters(found.sized(0, 0), "OPENCV") - model_parameters(true, "OPENCV")
    assert off @ np.linalg.solve(found.covariance, off) < CHI2_8_999
    assert np.abs(off[:2]).max() < 0.02 * 0.04 * true.focal.mean()
    for face, pose in result.target.target_from_face.items():
        error = pose.translation - small_scene.target_from_face[face].translation
        if face != result.target.reference_face:
            sigma = np.sqrt(np.diag(result.target.face_covariance[face])[3:])
            assert 0.05 < np.abs(error / sigma).max() < 4


@pytest.mark.slow
def test_circles_that_only_a_rough_camera_contradicts_are_not_left_out(small_set, small_scene):
    """A tangential distortion that is off by 0.003 moves centres by up to tenths of a pixel against one another. The
    refined camera follows the lens, and what was left out before is judged by it."""
    rough = small_scene.camera.parameters().copy()
    rough[6] += 0.003
    camera = small_scene.camera.with_parameters(rough)
    result = run(small_set("12").images, camera, None, options=RunOptions(refine_camera=True, workers=1))
    assert [outlier for group in result.solutions for outlier in group.outliers] == []
    assert [check.key for check in result.checks if check.verdict == "failed"] == []


def test_conditions_are_those_of_the_rendered_photographs(small_result, small_scene, labels_only):
    found, as_rendered = conditions(small_result), RenderOptions()
    assert found["number"] == (4.0, math.sqrt(10 / 4))
    assert found["blur"][0] == pytest.approx(math.hypot(as_rendered.blur_px, 1 / math.sqrt(12)), rel=0.02)
    contrast = np.median(np.concatenate([i.detection.centres.contrast for i in small_result.detection.images])) / 255
    assert found["light"][0] == pytest.approx(100 * as_rendered.noise / contrast, rel=0.15)  # as of a straight edge
    widest, seen = [], labels_only.observations(small_scene, 0.001, np.random.default_rng(1))
    for model in labels_only.models(small_scene, seen):
        middle = model.xyz_model.mean(axis=0)
        rays = [pose.inverse().translation - middle for pose in model.camera_from_model]
        widest.append(max(Rotation.align_vectors([a], [b])[0].magnitude() for a, b in combinations(rays, 2)))
    assert found["angles"][0] == pytest.approx(np.degrees(min(widest)), rel=0.01)
