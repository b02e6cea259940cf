"""What a run gives: its folder, which any COLMAP can use, the same on arrays, the camera as it was adjusted, a camera
file for other commands, and what in the photographs limits σ. Images and observations that do not fit, or that are
named, are left out, kept results belong to their inputs, and σ₀ counts. One photograph is one view, in whatever form it
lies in the folder; of a run: `test_bad_input.py`."""

import json
import math
import re
import shutil
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from stcal import sfm, synthetic
from stcal.errors import InputNote
from stcal.io.cameras.camera_model import model_of
from stcal.io.cameras.read import read_camera
from stcal.io.files import CAMERA, REFINED_CAMERA
from stcal.io.images import ImageFile, chosen_images, find_images, same_photograph
from stcal.labels import DotLabel
from stcal.sfm import RunOptions, load_run, read_target, run
from stcal.sfm.adjust.calibration import SigmaFactors, image_sigma_factors, with_sigma
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.refine import adjust, eccentricity_px, find_scale, refine
from stcal.sfm.adjust.uncertainty import calibrated_target
from stcal.sfm.camera.intrinsics import model_parameters
from stcal.sfm.detect.candidates import EllipseOptions, ImageDetection
from stcal.sfm.detect.detect_files import DetectedImage, _without_copies
from stcal.sfm.mapping.body import unknown_lens
from stcal.sfm.mapping.database import from_colmap_px, image_ids
from stcal.sfm.mapping.incremental import left_out, map_group
from stcal.sfm.mapping.pairs import PairOptions, rank_pairs
from stcal.sfm.report.check import Check, ranked
from stcal.sfm.runs.conditions import conditions
from stcal.sfm.runs.stages import Task, detect_with
from stcal.sfm.runs.transaction import RunFolder
from stcal.synthetic import RenderOptions, write_dataset
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.conftest import SMALL
from tests.levels import SLOW, sampled
from tests.outcome import INPUT, assert_error, fails_with
from tests.sfm.detect.test_arrangement import centres_of
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
    mapping = map_group(own, group, list(ids), ids, pairs, result.camera)
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


def calibrate(folder, out, **options):
    """Chained: what is left out, and what is kept, is seen before faces are adjusted together."""
    options = RunOptions(workers=1, solve="chain", **options)
    return run(folder / "images", folder / "cameras.txt", out, options=options)


@pytest.mark.slow
def test_a_dot_that_one_image_alone_shows_is_crossed_in_its_overlay(small_set, small_result):
    """Painted over in the three others; the overlay of the image of a dot that is used has no white there."""
    small, out = small_set("12"), DotLabel(3, 4)
    seen = {image.name: image for image in small_result.observations if image.group == "12"}
    assert all(out in image.labels for image in seen.values())
    for name in list(seen)[1:]:
        picture = cv2.imread(str(small.images / name))
        at = seen[name].centre_px[seen[name].labels.index(out)]
        x, y = at.round().astype(int).tolist()
        cv2.circle(picture, (x, y), 12, picture[y - 12, x - 12].tolist(), -1)
        cv2.imwrite(str(small.images / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 98])
    result = calibrate(small.folder, small.out)
    (name, *_), first = seen, next(iter(seen.values()))
    assert {label for labels in result.unadjusted().values() for label in labels} == {out}
    drawn = cv2.imread(str(small.out / "overlays" / name))
    assert drawn.shape[:2] == (864, 1296)
    for label in (out, DotLabel(3, 5)):
        x, y = first.centre_px[first.labels.index(label)].round().astype(int)
        assert (drawn[y - 3 : y + 4, x - 3 : x + 4].min(2).max() > 200) == (label == out)


@pytest.mark.slow
def test_kept_results_are_not_taken_for_other_options(small_set, tmp_path):
    small = small_set("12", "14")  # its groups are kept, with the correction
    folder = small.folder
    shutil.copytree(small.out, tmp_path / "fresh", ignore=shutil.ignore_patterns("group-*"))  # detections alone
    fresh = calibrate(folder, tmp_path / "fresh", eccentricity=False)
    again = calibrate(folder, small.out, eccentricity=False)
    np.testing.assert_array_equal(
        fresh.target.target_from_face["2"].matrix(), again.target.target_from_face["2"].matrix()
    )
    shutil.rmtree(folder / "images" / "14")
    for i in (1, 2, 3):
        small.image(i).unlink()
    target, board = again.target_design, again.board_design
    coarse = RunOptions(workers=1, solve="chain", ellipses=EllipseOptions(min_diameter_px=9.0)).settled(target)
    own = RunFolder(small.out, small.out / ".stcal/unfinished", small.out / ".stcal/cache")
    task = Task(find_images(folder / "images"), own, target, board, coarse, lambda *_: None)
    seen = detect_with(task, read_camera(folder / "cameras.txt"))
    assert not any(image.reused for image in seen.detection.images)


def test_dropped_observations_take_what_they_alone_hold_and_leave_the_redundancy_of_a_free_network(scene, labels_only):
    """Residuals with the stated σ give a factor of 1 within the spread of χ² (about 900 degrees of freedom a group)."""
    observed = labels_only.observations(scene, 0.003, np.random.default_rng(0))
    model = labels_only.models(scene, observed)[0]
    rows = np.flatnonzero(model.image_index == 1)
    drop = np.zeros(len(model.image_index), bool)
    drop[rows[5:]] = True  # five are left, six needed
    smaller = model.without(drop)
    assert set(model.images) - set(smaller.images) == {model.images[1]}
    own = [o for o in observed if o.group == model.group]
    assert "fewer than 6 of its" in left_out(own, smaller)[model.images[1]]
    kept = smaller.image_index == smaller.images.index(model.images[2])
    before = model.image_index == 2
    np.testing.assert_array_equal(smaller.measured_px[kept], model.measured_px[before])
    observed = labels_only.observations(scene, 0.005, np.random.default_rng(5))
    models = [refine(m, scene.camera, scene.target, scene.board).model for m in labels_only.models(scene, observed)]
    assert image_sigma_factors(models, scene.camera).all == pytest.approx(1.0, abs=0.05)
    factors = image_sigma_factors([with_sigma(m, SigmaFactors(0, 0.5, 4.0)) for m in models], scene.camera)
    assert factors.circles == pytest.approx(2.0, abs=0.2)  # a third of the redundancy: ± 3 %
    assert factors.dots == pytest.approx(0.25, abs=0.02)
    smaller = image_sigma_factors([with_sigma(m, SigmaFactors(0, 2.0, 4.0)) for m in models], scene.camera)
    assert smaller.circles == 1.0  # residuals do not deny what all views share
    kinds = SigmaFactors(0, 0.5, 4.0, 2.0, frozenset({"1"}))
    mixed = image_sigma_factors([with_sigma(m, kinds) for m in models], scene.camera, ["1"])
    assert (mixed.printed, mixed.of_target) == (1.0, mixed.circles)
    assert mixed.dots == pytest.approx(factors.dots, rel=0.01)
    assert mixed.circles == pytest.approx(2.0, abs=0.25)
    kinds = SigmaFactors(0, 2.0, 4.0, 0.5, frozenset({"1"}))
    larger = image_sigma_factors([with_sigma(m, kinds) for m in models], scene.camera, ["1"])
    assert larger.printed == pytest.approx(2.0, abs=0.25)


def test_sigma_follows_the_residuals_and_not_what_the_centres_claim(labels_only):
    """All σ stated too small, the board's too, and half as large again: σ₀ doubles and the faces' σ stay."""
    pairs = (("1", "2"), ("2", "3"))
    scene = make_scene(SceneOptions(seed=3, width=2592, height=1728, images_per_group=4, groups=pairs))
    observed = labels_only.observations(scene, 0.005, np.random.default_rng(6))
    chained, _ = labels_only.calibrate(scene, 0.005, 6, "chain")
    radius = scene.target.radius_of() | scene.board.radius_of()
    results = []
    for factor in (0.5, 0.25):
        board = replace(scene.board, sigma_mm=factor * scene.board.sigma_mm)
        shifted = [
            replace(m, shift_px=eccentricity_px(m, scene.camera, radius, 1.0))
            for m in labels_only.models(scene, observed)
        ]
        models = [with_sigma(m, SigmaFactors(factor, factor, factor)) for m in shifted]
        joint = adjusted(models, board, scene.camera).result()
        results.append((joint.sigma0, calibrated_target(joint, chained, scene.target, "plane").face_covariance["3"]))
        # Six free directions, and no more: the rank of the datum of smallest trace.
        value = np.linalg.eigvalsh(joint.covariance_mm2)
        assert (value > 1e-9 * value[-1]).sum() == 3 * len(joint.labels) - 6
    assert results[1][0] == pytest.approx(2 * results[0][0], rel=1e-3)
    np.testing.assert_allclose(results[1][1], results[0][1], rtol=5e-3, atol=1e-12)


NOISE = 2.5
"""Grey values: 1 % of full scale."""


def as_jpeg(image, quality: int) -> np.ndarray:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


@pytest.fixture(scope="module")
def sharp(small_dataset):
    image = cv2.imread(str(small_dataset / "images" / "12" / "IMG_1000.jpg"), cv2.IMREAD_GRAYSCALE)
    return cv2.GaussianBlur(image, (0, 0), 1.0).astype(float)


def exposure(sharp, seed: int) -> np.ndarray:
    noise = NOISE * np.random.default_rng(seed).standard_normal(sharp.shape)
    return np.clip(sharp + noise, 0, 255).round().astype(np.uint8)


@pytest.mark.slow
def test_other_forms_are_the_same_photograph_and_a_second_exposure_is_not(sharp):
    for quality in (60, 95):
        first, second = exposure(sharp, 1), exposure(sharp, 2)
        assert same_photograph(first, as_jpeg(first, quality))
        assert same_photograph(as_jpeg(first, quality), first)
        assert not same_photograph(first, second)
        assert not same_photograph(as_jpeg(first, quality), as_jpeg(second, quality))
    first = exposure(sharp, 1)
    assert same_photograph(first, first.astype(np.uint16) * 200)
    smooth = sharp.round().astype(np.uint8)
    assert same_photograph(smooth, as_jpeg(smooth, 90))
    assert not same_photograph(smooth, smooth[:-1])
    assert not same_photograph(smooth, np.roll(smooth, 1, axis=1))


@pytest.mark.parametrize("content", [b"", b"not an image", None])
def test_what_cannot_be_read_again_is_no_copy(tmp_path, content):
    """A photograph that was there at its detection, and is spoiled or gone when its pixels are compared."""
    seen = ImageDetection(centres_of(np.zeros((9, 2)), np.zeros((9, 2))), ())
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 60), np.uint8))
    if content is not None:
        (tmp_path / "b.jpg").write_bytes(content)
    files = [ImageFile(tmp_path / name, name, "") for name in ("a.png", "b.jpg")]
    images, skipped = _without_copies([DetectedImage(f, seen, f.name, b"", 1.0, False) for f in files], True, False)
    assert ([image.file.name for image in images], skipped) == (["a.png", "b.jpg"], [])


CHECKS_FAILED = 4
STRAY = "12/IMG_1002.jpg"


@pytest.fixture
def with_a_stray(small_set):
    """A photograph taken with another focus: distorted by 2 px in its corners more than the others."""
    small = small_set("12", "14")
    picture = cv2.imread(str(small.image(2)), cv2.IMREAD_GRAYSCALE)
    height, width = picture.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    from_middle = np.stack([x - width / 2, y - height / 2])
    square = (from_middle**2).sum(0) / (width**2 + height**2) * 4
    x, y = from_middle * (1 + 2 * square * 2 / np.hypot(width, height)) + np.array([width, height])[:, None, None] / 2
    cv2.imwrite(str(small.image(2)), cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC))
    return small


def files(small):
    return "--target", small.folder / "target.toml", "--board", small.folder / "board.toml"


@pytest.mark.slow
def test_a_failed_check_names_its_image_and_the_option_that_takes_it_out(with_a_stray, stcal_sfm):
    """Exit code 4, and 0 with what the first remedy says."""
    small = with_a_stray
    _, out, err = outcome = stcal_sfm(*small.arguments(*files(small)))
    line = assert_error(outcome, CHECKS_FAILED, "E-CHECKS-FAILED", "may I use it? No", "--no-strict", "see")
    assert {"faces: 4 of 4", "check: 19 of 19"} <= set(err.splitlines())
    assert "µm" not in next(line for line in out.splitlines() if line.startswith("How good is it?"))
    assert "(a check is suspicious by chance in one run in 1,000, failed in one in 100,000)" in " ".join(out.split())
    assert f"--exclude {STRAY}" in " ".join(out.split()).split(" failed: ")[1]
    assert line.endswith(str(small.out / "report.html"))
    doubted = read_target(small.out / "faces.json", load_run(small.out).target_design).notes
    assert any("must not be used: No: " in note for note in doubted), doubted

    code, out, _ = stcal_sfm(*small.arguments(*files(small), "--exclude", STRAY))
    assert code == 0
    assert f"skipped {STRAY}: taken out with --exclude" in out
    assert "by chance" not in out
    report = json.loads((small.out / "report.json").read_text())
    assert [(each["name"], each["gate"]) for each in report["left_out"]["files"]] == [(STRAY, "excluded")]
    assert STRAY not in {each["name"] for each in report["images"]}
    assert (load_run(small.out).options.exclude, load_run(small.out).faces.doubted) == ((STRAY,), "")
    assert small.image(2).exists()


def test_images_are_named_as_in_results_or_by_their_path(small_set, stcal_sfm, monkeypatch):
    small = small_set("12", "14")
    outcome = stcal_sfm(*small.arguments("--exclude", "12/IMG_1000.jpg", "--exclude", "IMG_1001.jpg"))
    assert_error(outcome, INPUT, "E-OPTION-EXCLUDE", "--exclude", "IMG_1001.jpg", "12/IMG_1000.jpg")
    outcome = stcal_sfm("detect", *small.arguments("--exclude", "12/none.jpg")[1:])
    assert_error(outcome, INPUT, "E-OPTION-EXCLUDE", "--exclude", "12/none.jpg")
    monkeypatch.chdir(small.images / "14")
    kept, left = chosen_images(small.images, ["12/IMG_1001.jpg", "IMG_1002.jpg", str(small.image(3))])
    assert [each.name for each in left] == ["12/IMG_1001.jpg", "12/IMG_1003.jpg", "14/IMG_1002.jpg"]
    assert {each.gate for each in left} == {"excluded"}
    assert len(kept) == 5
    with fails_with("E-OPTION-EXCLUDE … --exclude … 8"):
        chosen_images(small.images, [each.name for each in chosen_images(small.images)[0]])


def test_failed_checks_that_name_an_image_come_first_and_those_that_others_explain_last():
    def check(key, verdict, *names):
        return Check(key, key, verdict, "", (), 1, names, "")

    checks = [
        check("dull", "suspicious", "b.jpg"),
        check("passed", "passed"),
        check("camera", "failed", "camera"),
        check("centre", "suspicious", "b.jpg 1:1"),
        check("image", "failed", "a.jpg"),
    ]
    order = [each.key for each in ranked(checks, frozenset({"a.jpg", "b.jpg"}))]
    assert order == ["image", "camera", "dull", "centre", "passed"]
    for later, why in (("radius-design", "rim"), ("groups", "board"), ("loops", "flatness")):
        checks = [check(key, "failed", key) for key in (later, why, "agreement")]
        assert [each.key for each in ranked(checks, frozenset())] == [why, later, "agreement"]
        assert [each.key for each in ranked(checks[::2], frozenset())] == [later, "agreement"]
