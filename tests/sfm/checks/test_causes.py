"""Causes of the whole set are named first, with their size; what only some images have is not taken for one."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import MappingError
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.plane import circle_image_offset
from stcal.sfm.checks import suite
from stcal.sfm.checks.significance import moved_apart
from stcal.sfm.checks.suite import _turned, cause_of_file, whole_set_cause
from stcal.sfm.report.check import CAUSE, OF_WHOLE_SET, ranked
from stcal.sfm.runs import stages as solve
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.stages import Groups, GroupSolution, refine_or_explain
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.outcome import fails_with
from tests.sfm.checks.test_checks import Lab, on_face, seen_circles


@pytest.fixture(scope="module")
def few():
    """Four images in each of three groups; the principal point is 3 to 18 px off the middle."""
    pairs = (("1", "2"), ("1", "4"), ("1", "5"))
    return make_scene(SceneOptions(seed=4, images_per_group=4, width=2592, height=1728, groups=pairs))


@pytest.fixture(scope="module")
def lab(labels_only):
    return Lab(labels_only)


def first(scene, lab, images, camera=None, board=None):
    checks = lab.check(scene, images, camera=camera, board=board)
    return ranked(list(checks.values()), frozenset(image.name for image in images))[0]


def of_file(key, change):
    return lambda scene, images: (images, replace(scene.camera, **{key: change(getattr(scene.camera, key))}))


def of_photographs(change):
    """Photographs that are changed: new places, px, from an image and the camera."""

    def plant(scene, images):
        return [replace(image, centre_px=change(image, scene.camera, k)) for k, image in enumerate(images)], None

    return plant


def zoomed(by):
    return of_photographs(lambda i, camera, k: camera.centre + (1 + by(i, k)) * (i.centre_px - camera.centre))


def turned_photograph(image, camera):
    """Where the centres are in a photograph turned by 180°, to be read upright: the lens is turned with its sensor."""
    return turned_camera(camera).pixel_from_normalised(image.centre)


def turned_camera(camera):
    """The camera that takes photographs turned by 180°: its tangential distortion is turned, too."""
    return camera.with_parameters(_turned(camera, 2))


RANDOM = np.random.default_rng(0).normal(size=(12, 2))
PLANTED = {
    "focal length long": (of_file("focal", lambda f: 1.01 * f), "the focal length is not"),
    "focal length short": (of_file("focal", lambda f: 0.998 * f), "the focal length is not"),
    "unlike": (of_file("focal", lambda f: f * [1.003, 1]), "width and height are scaled differently"),
    "principal point": (of_file("centre", lambda c: c + np.array([8, -5])), "the principal point is not"),
    "undistorted": (
        of_photographs(lambda i, camera, _: i.centre * camera.focal + camera.centre),
        "already undistorted",
    ),
    "undistorted to another matrix": (
        of_photographs(lambda i, camera, _: 0.985 * i.centre * camera.focal + camera.centre + np.array([3, 1])),
        "already undistorted, with another camera matrix",
    ),
    "signs reversed": (of_file("distortion", lambda d: -d), "sign reversed"),
    "scaled": (of_photographs(lambda i, *_: 1.005 * (i.centre_px + 0.5) - 0.5), "scaled relative to the camera file"),
    "turned": (lambda scene, images: (images, turned_camera(scene.camera)), "turned by 180°"),
    "some turned": (
        of_photographs(lambda i, camera, k: i.centre_px if k % 2 else turned_photograph(i, camera)),
        "some photographs are turned by 180°",
    ),
    "zoom by group": (zoomed(lambda i, _: {"12": 0, "14": 0.003, "15": -0.004}[i.group]), "between the groups"),
    "autofocus": (zoomed(lambda _, k: 0.003 * RANDOM[k, 0]), "from image to image"),
    "rolling shutter": (
        of_photographs(lambda i, camera, k: i.centre_px + RANDOM[k] * (i.centre_px[:, 1:] / camera.height - 0.5)),
        "rolling shutter",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTED)
def test_the_planted_cause_is_named_first(few, lab, name):
    plant, words = PLANTED[name]
    images, camera = plant(few, lab.observe(few))
    check = first(few, lab, images, camera)
    assert (check.key, check.verdict, check.names) == (CAUSE, "failed", ())
    assert check.title.startswith(OF_WHOLE_SET)
    assert words in check.title
    assert check.remedy


def test_the_size_of_the_cause_is_said_no_file_is_wrong_where_there_is_none_and_centroids_are_named(
    few, lab, monkeypatch
):
    """Nor is a cause named that leaves more of the residuals than is allowed, as beside a group that is found out. A
    check that would name nearly all images names few. Centroids come before what they make fail."""
    asked = []
    monkeypatch.setattr(suite, "whole_set_cause", lambda *given: asked.append(given) or whole_set_cause(*given))
    images, camera = PLANTED["focal length long"][0](few, lab.observe(few))
    checks = lab.check(few, images, camera=camera)
    assert re.match(r"focal length -(1|0\.99\d*) ± \S+ % against the file: 1 parameter", checks[CAUSE].reason)
    assert "of the camera file" in checks[CAUSE].title
    assert checks["moved"].verdict == "failed"
    assert len(checks["moved"].names) <= 0.7 * len(images)
    networks, given, moved, *_ = asked[0]
    other = whole_set_cause(networks, given, moved, from_file=False)
    assert other is None or "camera file" not in other.title
    assert whole_set_cause(networks, given, moved, most_left=0.0) is None
    check = first(few, lab, centroids(few, lab.observe(few)))
    assert "eccentricity" in check.title
    found = float(re.match(r"(-?[\d.]+) ± ", check.reason)[1])
    assert found == pytest.approx(0, abs=0.2)


def shifted(image):
    return replace(image, centre_px=image.centre_px + on_face(image)[:, None] * [0.4, 0])


def test_what_one_image_has_is_no_cause_of_the_whole_set_and_of_two_halves_of_a_group_none_is_named(few, lab):
    """Another place of the target in one, and another focus in one. Where the target stood elsewhere in two of four
    images, that it moved is said, and that either half may be it."""
    images = [shifted(image) if k == 3 else image for k, image in enumerate(lab.observe(few))]
    check = first(few, lab, images)
    assert check.key != CAUSE
    assert check.names[0] == images[3].name
    refocused, _ = zoomed(lambda _, k: 0.01 * (k == 5))(few, lab.observe(few))
    assert first(few, lab, refocused).key != CAUSE
    images = [shifted(image) if k in (0, 1) else image for k, image in enumerate(lab.observe(few))]
    checks = lab.check(few, images)
    best = ranked(list(checks.values()), frozenset(image.name for image in images))[0]
    assert (best.key, best.names) == (CAUSE, ())
    assert "the target moved relative to the board" in best.title
    assert checks["moved"].names == ()
    assert f"group {images[0].group}: leaving out less than half of them" in checks["moved"].reason


def test_a_camera_turned_by_a_quarter_has_its_parameters_turned():
    distortion = np.array([-0.1, 0.02, 1e-3, -2e-3, 0, 0, 0, 0, 3e-3, 1e-3, -2e-3, 4e-3])
    camera = Camera(1000, 1000, np.array([800.0, 790.0]), np.array([520.0, 480.0]), distortion)
    xy = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2))
    turned = camera.with_parameters(_turned(camera, 1))
    pixel = camera.pixel_from_normalised(xy)
    expected = np.column_stack([pixel[:, 1], 999 - pixel[:, 0]])
    np.testing.assert_allclose(
        turned.pixel_from_normalised(np.column_stack([xy[:, 1], -xy[:, 0]])), expected, atol=1e-9
    )
    np.testing.assert_allclose(_turned(camera, 4), camera.parameters())


def centroids(scene, images):
    """Images of the circles' centres, as of centroids that nothing corrects."""
    made = []
    for image in images:
        xyz, normal, radius, _ = seen_circles(scene, image)
        shift = scene.camera.project(circle_image_offset(xyz, normal, radius)) - scene.camera.project(xyz)
        made.append(replace(image, centre_px=image.centre_px - shift))
    return made


FAR_OFF = {
    "focal length": (lambda c: replace(c, focal=1.3 * c.focal), "the focal length is not"),
    "cropped": (lambda c: replace(c, centre=c.centre + np.array([400, -300])), "the principal point is not"),
    # 106 % of it is not in the photographs, which is no removal
    "distortion": (lambda c: replace(c, distortion=-16 * c.distortion), "the distortion is not"),
    "all": (
        lambda c: c.with_parameters(
            c.parameters() + intrinsic_basis("OPENCV") @ np.array([90, -70, 80, 60, 0.02, 0.2, 2e-3, 2e-3])
        ),
        "the intrinsics are not",
    ),
    "undistorted": (lambda c: replace(c, distortion=0 * c.distortion), "undistorted"),
}


@pytest.mark.parametrize("name", FAR_OFF)
def test_a_file_that_is_far_off_is_compared_with_the_true_camera(few, name):
    """By hypotheses on its parameters, which need no derivatives at the file."""
    own = Camera.of(few.camera, "OPENCV")
    change, words = FAR_OFF[name]
    file, found = (own, change(own)) if name == "undistorted" else (change(own), own)
    covariance = np.diag([0.5, 0.5, 0.5, 0.5, 1e-4, 1e-3, 1e-5, 1e-5]) ** 2
    check = cause_of_file(file, found, covariance, "OPENCV")
    assert (check.key, check.verdict) == (CAUSE, "failed")
    assert words in check.title
    assert check.remedy


def elsewhere(image, scene, shift_mm):
    """The image with all faces ``shift_mm`` off their place, board and camera where they were."""
    xyz, normal, radius, _ = seen_circles(scene, image)
    there = xyz + on_face(image)[:, None] * shift_mm
    before, after = (scene.camera.project(circle_image_offset(at, normal, radius)) for at in (xyz, there))
    return replace(image, centre_px=image.centre_px + after - before)


def test_target_and_board_that_moved_apart_agree_by_themselves(few, lab, labels_only):
    """In half of the images of a group the target stood 2 mm elsewhere: no minimum of all, but one of each part."""
    images = [elsewhere(i, few, [2, -1, 1]) if k % 4 > 1 else i for k, i in enumerate(lab.observe(few))]
    moved = labels_only.models(few, images)[0]
    assert moved_apart(moved, few.camera, few.target, few.board)
    wrong = replace(few.camera, distortion=few.camera.distortion - 0.3 * np.eye(len(few.camera.distortion))[0])
    still = labels_only.models(few, lab.observe(few))[0]
    assert not moved_apart(still, wrong, few.target, few.board)


@pytest.mark.parametrize("wrong", [(2,), (1, 2)])
def test_one_photograph_that_contradicts_a_group_is_named(few, lab, monkeypatch, wrong):
    """As a cropped one does: the group was lost without a word about which photograph it is. Of two, none is named."""
    model = next(each for each in lab.labels_only.models(few, lab.observe(few)) if each.group == "12")
    names = {model.images[k] for k in wrong}

    def fails_with_them(group, *_):
        if names & set(group.images):
            raise MappingError("E-GROUP-CONTRADICTS", f"group {group.group}: observations contradict")

    monkeypatch.setattr(solve, "refine", fails_with_them)
    said = f"{model.images[2]} contradicts the others" if len(wrong) == 1 else "observations contradict"
    with fails_with(f"E-GROUP-CONTRADICTS … group 12: {said}"):
        refine_or_explain(model, few.camera, few.target, few.board)


def test_circles_that_no_image_shows_as_drawn_are_named(few, lab):
    models = lab.labels_only.models(few, lab.observe(few))
    solutions = tuple(GroupSolution((), model, "", 0, {}, ()) for model in models)
    groups = Groups((), (), None, few.camera, few.board, RunOptions(), False, (), solutions)
    assert groups.unseen_notes(few.target) == []

    def without(model, lost: str):
        return model.without(np.array([model.labels[p] == lost for p in model.point_index]))

    cut = tuple(replace(each, model=without(each.model, "1:4")) for each in solutions)
    [note] = replace(groups, solutions=cut).unseen_notes(few.target)
    assert note.startswith("1:4: not in the result, as too few images show it as drawn; check their design")
