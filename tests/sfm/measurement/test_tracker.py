"""A target followed from image to image: the same poses as searched one by one, and nothing kept that is lost."""

import cv2
import numpy as np
import pytest

from stcal.errors import InputError
from stcal.io.cameras.read import read_camera, save_camera
from stcal.sfm import MeasureOptions, Tracker, measure
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.detect.predict import common_shift
from stcal.synthetic.render import RenderOptions, render
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.outcome import fails_with
from tests.support.image_poses import filmed, pose_error

pytestmark = pytest.mark.slow
IMAGES = 4
OTHER_BAND = 1.0
"""σ by which a pose may move when the bands of the same rims, mostly the same pixels, lie about another start: two fits
of independent pixels would differ by √2."""


@pytest.fixture(scope="module")
def film():
    """Four images that follow each other, and one of another part of the film."""
    scene = make_scene(SceneOptions(seed=5, width=1296, height=864, images_per_group=6))
    return filmed(scene, "12", 30, seed=1)


@pytest.fixture(scope="module")
def frames(film):
    return {i: render(film, "12", i, RenderOptions(noise=0.01)) for i in (*range(IMAGES), 25)}


@pytest.fixture(scope="module")
def target(film):
    """Its circles as they are."""
    labels = tuple(film.circles_target)
    radius = film.target.radius_of()
    xyz = np.array([film.circles_target[label] for label in labels])
    none = np.zeros((3 * len(labels), 3 * len(labels)))
    return TargetCircles(labels, xyz, np.array([radius[label] for label in labels]), none, design=film.target)


@pytest.fixture(scope="module")
def model(film, frames, tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    (folder / "images/12").mkdir(parents=True)
    for i in range(IMAGES):
        cv2.imwrite(str(folder / f"images/12/{i}.png"), frames[i])
    save_camera(folder / "cameras.txt", film.camera)
    return folder, read_camera(folder / "cameras.txt")


def off_sigmas(pose, other):
    """By how many σ two poses differ at most."""
    return np.abs(pose_error(other.camera_from_target, pose.camera_from_target)) / np.sqrt(np.diag(pose.covariance))


def test_a_followed_pose_is_that_of_a_search_and_what_jumps_is_searched_and_found(film, frames, target, model):
    follower, searcher = (Tracker(target, model[1], film.board) for _ in range(2))
    for i in range(IMAGES):
        searcher.forget()
        own, other = follower.locate(frames[i], f"{i}"), searcher.locate(frames[i], f"{i}")
        assert follower.searched == (i == 0)
        assert set(other.labels) <= set(own.labels)
        assert off_sigmas(own, other).max() < OTHER_BAND
        error = pose_error(own.camera_from_target, film.groups["12"].camera_from_target[i])
        assert error @ np.linalg.solve(own.covariance, error) < 28  # χ² of 6, one in 10 000
    tracker = Tracker(target, model[1], film.board)
    truth = film.groups["12"].camera_from_target
    for i, searched in ((0, True), (1, False), (None, True), (2, True), (25, True), (3, True)):
        if i is None:
            with fails_with("E-MEASURE-NO-FACE"):
                tracker.locate(np.zeros_like(frames[0]), "dark")
            continue
        pose = tracker.locate(frames[i])
        assert tracker.searched == searched
        assert np.linalg.norm(pose.camera_from_target.translation - truth[i].translation) < 1


def test_the_common_shift_is_found_and_a_hidden_face_missed_by_name(film, frames, target, model):
    tracker = Tracker(target, model[1], film.board)
    seen = tracker.locate(frames[0])
    hidden, face = frames[1].copy(), seen.faces[0]
    xyz = [film.circles_target[label] for label in seen.labels if label.face == face]
    at = film.camera.project(film.groups["12"].camera_from_target[1] @ np.array(xyz))
    (left, top), (right, bottom) = (at.min(0) - 30).astype(int), (at.max(0) + 30).astype(int)
    hidden[max(top, 0) : bottom, max(left, 0) : right] = hidden[:20, :20].mean()
    left_over = tracker.locate(hidden)
    assert face not in left_over.faces
    assert not tracker.searched  # the other face has half of the circles, as many as are asked for
    assert any(note.startswith(f"face {face}: {face}:1 and 9 more should be in view") for note in tracker.notes)
    tracker = Tracker(target, model[1], film.board)
    pose = tracker.locate(frames[0])
    predicted = tracker._predicted(pose.camera_from_target, tracker.camera, (), np.radians(70))
    radius = float(np.sqrt(np.linalg.det(predicted.shape_px)).mean() ** 0.5)
    for shift in ([0, 0], [3 * radius, -2 * radius], [-4 * radius, 4 * radius]):
        found = common_shift(frames[0], predicted.shifted(np.array(shift)))
        assert np.abs(found + shift).max() < 0.3 * radius
    assert not common_shift(np.zeros_like(frames[0]), predicted).any()


def test_what_is_no_image_of_the_camera_and_a_target_without_design_are_refused(target, model):
    for image in (np.zeros((864, 1296, 3), np.uint8), np.zeros((864, 1296)), np.zeros((10, 10), np.uint8)):
        with pytest.raises(InputError, match=r"^image: "):
            Tracker(target, model[1]).locate(image)
    bare = TargetCircles(target.labels, target.xyz, target.radius, target.covariance)
    with fails_with("E-FACES-DESIGN"):
        Tracker(bare, model[1])


def test_measure_follows_a_folder(film, target, model):
    folder, camera = model
    together = measure(folder / "images", camera, target, film.target, film.board, MeasureOptions(sequence=True))
    single = measure(folder / "images", camera, target, film.target, film.board, MeasureOptions(workers=1))
    assert together.searched == 1
    assert single.searched is None
    assert [each.name for each in together.images] == [each.name for each in single.images]
    for own, other in zip(together.images, single.images, strict=True):
        assert off_sigmas(own.pose, other.pose).max() < OTHER_BAND
