"""What is not the target: mirror images of its faces, mirrored files, and what is blurred beyond its size.

Rendered photographs are judged as in ``test_light_and_cover``.
"""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stcal import BoardDesign, Rigid
from stcal.errors import DetectionError
from stcal.io.images import ImageFile
from stcal.sfm.detect.candidates import BoardSighting
from stcal.sfm.detect.detect_files import DetectedImage, require_upright
from stcal.sfm.detect.labelling import label_groups
from tests.levels import sampled
from tests.sfm.detect.degraded import study
from tests.sfm.detect.test_arrangement import FOCAL_PX, TARGET, Seen, plane_centres
from tests.support import degrade

FIRST = "12/IMG_1000"
ALL = ("12", "14", "15", "23")
MIRRORS = {"vertical": np.array([0.0, 0.0, 1.0]), "floor": np.array([0.0, -1.0, 0.0])}
"""Normals, target frame, whose y axis points down: the vertical one stands behind face 3."""
OFF_MM = 40.0


def mirrored_in(kind):
    """A mirror, ``OFF_MM`` off the target's circles, that shows all its faces ``value`` times as bright to group 12."""

    def make(photo, value, case):
        if photo.group != "12":
            return study.Picture(photo.grey)
        normal = MIRRORS[kind]
        at = (np.array(list(case.data.truth["circles"].values())) @ normal).min() - OFF_MM
        motion = np.eye(3) - 2 * np.outer(normal, normal), 2 * at * normal
        planes = study.facing(photo, study.all_faces(photo), motion)
        assert study.visible_share(photo, planes, 1 - photo.foreground()) > 0.9  # a whole face: enough to mislead
        circle, plate = photo.levels(photo.faces[0])
        return study.Picture(degrade.behind(photo, planes, [(value * circle, value * plate)] * len(planes), 15.0))

    return make


@pytest.mark.parametrize("kind", sampled(MIRRORS))
def test_a_mirror_image_of_the_target_gives_no_wrong_label(bench, kind):
    """One group of three sees it. That group alone could not tell a face that it does not show from its image."""
    found = bench.label(mirrored_in(kind), 0.7, "12", "14", "23")
    found.assert_all_found()


@pytest.fixture(scope="module")
def two_groups(scene, labels_only):
    seen = labels_only.observations(scene, 0.003, np.random.default_rng(0))
    return [[o for o in seen if o.group == group] for group in scene.groups if "2" in group]


def test_a_table_that_mirrors_board_and_target_is_a_second_world(scene, two_groups):
    """It moves with the real one. A face in it reads as face 3, turned from its rough pose; the board is seen twice."""
    own = two_groups[0]
    group = scene.groups["12"]
    up = group.axes[1]
    points = np.vstack([*(scene.face_outline(face) for face in "12345"), scene.board_outline("12")])
    turn = np.eye(3) - 2 * np.outer(up, up)
    shift = 2 * ((points @ up).min() - OFF_MM) * up
    left_handed = np.diag([-1.0, 1.0, 1.0])
    pose = scene.target_from_face["2"]
    target_from_image = Rigid(turn @ pose.rotation @ left_handed, turn @ pose.translation + shift)
    seen = [Seen(o) for o in own]
    for each, camera_from_target in zip(seen, group.camera_from_target, strict=True):
        xyz = camera_from_target @ (group.board_circles_target @ turn + shift)
        each.board(xyz[:, :2] / xyz[:, 2:], [[row, 8 - column] for row in range(7) for column in range(9)])
        each.face("3", plane_centres(camera_from_target @ target_from_image, TARGET.face("3").xy_mm))
    named = [(o.name, o.group, s.detection()) for o, s in zip(own, seen, strict=True)]
    (alone,), _ = label_groups([named], scene.target, scene.board, FOCAL_PX)
    for result, o in zip(alone[0], own, strict=True):
        assert set(result.observations.labels) == {label for label in o.labels if label.plane != "board"}
        board, face = (note.partition(":")[0].partition(" found")[0] for note in result.notes)
        assert (board, face) == ("board", "a pattern like face 3")


def test_a_face_that_another_group_has_elsewhere_goes_out(scene, two_groups):
    """The first group sees face 1 on a shiny floor as face 3, but for one circle; the second has the real face 3 beside
    face 2. Without it nothing contradicts."""
    own, other = two_groups
    assert {face for o in other for face in o.face_ids()} >= {"2", "3"}
    face = TARGET.face("3")
    target_from_image = scene.target_from_face["3"] @ Rigid.exp([0.1, 0.0, 0.0, 30, 250, 20])
    seen = [Seen(o) for o in own]
    for each, pose in zip(seen, scene.groups[own[0].group].camera_from_target, strict=True):
        each.face("3", plane_centres(pose @ target_from_image, face.xy_mm[:9]), range(9))
    named = [(o.name, o.group, s.detection()) for o, s in zip(own, seen, strict=True)]
    real = [(o.name, o.group, Seen(o).detection()) for o in other]
    (alone,), _ = label_groups([named], scene.target, scene.board, FOCAL_PX)
    assert all("3" in each.observations.face_ids() for each in alone[0])
    together, _ = label_groups([named, real], scene.target, scene.board, FOCAL_PX)
    for results, observed in zip(together, (own, other), strict=True):
        for result, o in zip(results[0], observed, strict=True):
            assert set(result.observations.labels) == set(o.labels)
    notes = [note for each in together[0][0] for note in each.notes]
    assert sum("a pattern like face 3: not where other groups see that face" in note for note in notes) == len(own)


@pytest.mark.slow
def test_one_mirrored_image_loses_its_labels_and_says_so(bench):
    found = bench.label("mirrored", "one image")
    found.assert_all_found()
    assert found.labels(FIRST) == set()
    (note,) = found.images[FIRST].notes
    assert note.startswith("the image is mirrored: it shows face ")
    assert all(image.notes == () for name, image in found.images.items() if name != FIRST)
    assert found.counts["must"] == 3 * 10  # of the two others
    assert found.counts["must_dots"] == 2 * 63


@pytest.mark.slow
def test_a_mirrored_group_whose_faces_pass_for_others_is_told_by_the_other_groups(bench):
    """Faces 2, 3 and 5 of all images of group 23 pass for 4, 5 and 3, and nothing in that group contradicts."""
    found = bench.label("mirrored", "a group", *ALL)
    found.assert_all_found()
    assert all(not found.labels(name, face) for name in found.images for face in "12345" if name.startswith("23/"))
    assert "the image is mirrored" in found.notes()


@pytest.mark.slow
def test_circles_blurred_beyond_their_size_give_no_wrong_label(bench):
    """Circles of a third face at 75°, half as wide as their blur: not searched for, but seen by the first look."""
    found = bench.label("defocus", 5.0, "12", "23")
    found.assert_all_found(0.9)


def detected(name, faces=(), mirrored=()):
    """An image that shows these faces, or these as a mirror does."""
    seen = Seen()
    for face in faces:
        seen.face(face, np.zeros((0, 2)), [])
    return DetectedImage(ImageFile(Path(name), name, "12"), seen.detection(mirrored), name, b"", 1.0, False)


def images(mirrored, upright, empty=0):
    numbers = {("m", "", "25"): mirrored, ("u", "1", ""): upright, ("e", "", ""): empty}
    return tuple(detected(f"{kind}{i}", *shown) for (kind, *shown), n in numbers.items() for i in range(n))


@pytest.mark.parametrize(
    ("mirrored", "upright", "empty"),
    [(1, 0, 0), (3, 2, 40), (0, 0, 3), (1, 11, 0), (2, 2, 0)],
)
def test_a_set_that_is_mostly_mirrored_is_refused_and_others_go_on(mirrored, upright, empty):
    """Images without a face say nothing of it."""
    words = f"{mirrored} of {mirrored + upright} images with a face are mirrored, first m0: face 2, 5 appears"
    refused = pytest.raises(DetectionError, match=words)
    with refused if mirrored > upright else nullcontext():
        require_upright(images(mirrored, upright, empty))


@pytest.mark.parametrize(("corner", "said"), [((0, 0), "right way round, the drawing is mirrored"), (None, "flip the")])
def test_a_board_that_is_read_shows_that_the_drawing_is_mirrored(corner, said):
    board = BoardDesign(7, 9, 30.0, 7.5, "bright", 0.1, corner, 11.0 if corner else None)
    seen = BoardSighting(np.arange(63), np.zeros((1, 63, 2), int))
    own = [replace(i, detection=replace(i.detection, boards=(seen,))) for i in images(3, 0, 0)]
    with pytest.raises(DetectionError, match=said):
        require_upright(tuple(own), board)
