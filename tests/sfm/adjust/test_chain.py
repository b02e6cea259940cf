"""Face frames, also where no image shows their circles, and their chaining into the target frame."""

import numpy as np
import pytest

from stcal import Rigid, reference_target
from stcal.sfm.adjust.calibration import AdjustOptions, calibrate
from stcal.sfm.adjust.chain import FaceInGroup, chain_faces, face_frame, measure_chains, with_known
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.outcome import fails_with, refuses
from tests.support.image_poses import pose_error

TARGET = reference_target()
FACE = TARGET.face("1")
WORLD_FROM_FACE = Rigid.exp([0.5, -1.0, 0.3, 100.0, -50.0, 900.0])


def circles(noise=0.0, seed=0, keep=None):
    xyz = np.column_stack([FACE.xy_mm, np.zeros(10)])
    xyz = WORLD_FROM_FACE @ (xyz + np.random.default_rng(seed).normal(0, noise, xyz.shape))
    return {c: p for c, p in zip(FACE.ids, xyz, strict=True) if keep is None or c in keep}


def test_frames_are_exact_on_exact_circles_and_that_of_the_plane_spreads_less():
    """Z of ten circles against Z of three, with the same noise."""
    for kind in ("plane", "three-point"):
        frame = face_frame(FACE, circles(), kind, WORLD_FROM_FACE.rotation[:, 2])
        np.testing.assert_allclose(frame.matrix(), WORLD_FROM_FACE.matrix(), atol=1e-12)
    spread, up = {}, WORLD_FROM_FACE.rotation[:, 2]
    for kind in ("plane", "three-point"):
        along = [face_frame(FACE, circles(0.01, s), kind, up).rotation[:, 2] @ up for s in range(200)]
        spread[kind] = np.sqrt(np.mean(np.arccos(np.minimum(along, 1.0)) ** 2))
    assert 0.3 < spread["plane"] / spread["three-point"] < 0.8
    with fails_with("E-FACE-FRAME-CIRCLES … 1:3 and 1:5"):
        face_frame(FACE, circles(keep="12467abc"), "plane", np.array([0, 0, 1.0]))
    assert with_known(FACE, circles(keep="1a23"), circles()).keys() == set("1a23")  # those on one line place no other


TRUE = {
    "1": Rigid(),
    "2": Rigid.exp([0, np.pi / 2, 0, 138, 0, -58]),
    "3": Rigid.exp([0, np.pi, 0, 78, 0, -198]),
    "4": Rigid.exp([0, -np.pi / 2, 0, -58, 0, -138]),
}


def in_group(group, face_id, error=None, weight=1.0):
    target_from_group = Rigid.exp([0.1 * len(group), 0.2, -0.1, *(50.0 * (ord(group[-1]) % 5), 20, 700)])
    pose = target_from_group.inverse() @ TRUE[face_id] @ (Rigid.exp(error) if error is not None else Rigid())
    face = TARGET.face(face_id)
    xyz = np.column_stack([face.xy_mm, np.zeros(10)])
    information = np.tile(weight * 1e6 * np.eye(3), (10, 1, 1))
    return FaceInGroup(group, face_id, pose, tuple(face.labels()), xyz, information, 4)


FACES = [in_group(g, f) for g, pair in (("a", "12"), ("b", "14"), ("c", "23")) for f in pair]
ERROR = [0, 0, 0, 0.0, 0.03, 0.0]


def test_exact_groups_chain_exactly_and_two_ways_of_few_faces_are_combined_by_weight():
    """Another reference face moves the frame alone."""
    one, two = chain_faces(FACES, TARGET, "1"), chain_faces(FACES, TARGET, "2")
    for face_id, pose in TRUE.items():
        np.testing.assert_allclose(one.target_from_face[face_id].matrix(), pose.matrix(), atol=1e-9)
        moved = two.target_from_face["1"] @ one.target_from_face[face_id]
        np.testing.assert_allclose(moved.matrix(), two.target_from_face[face_id].matrix(), atol=1e-9)
    np.testing.assert_allclose(one.circles["3:2"], TRUE["3"] @ [40.0, 0, 0], atol=1e-9)
    faces = [*FACES, in_group("d", "3", ERROR), in_group("d", "4")]
    target = chain_faces(faces, TARGET, "1")
    shift = target.target_from_face["3"].translation - TRUE["3"].translation
    assert 0.005 < np.linalg.norm(shift) < 0.025  # between the two ways, 30 µm apart
    ways = measure_chains(faces, target)["3"]
    assert {way.groups for way in ways} == {("a", "c"), ("b", "d")}
    assert sum(way.translation_mm for way in ways) == pytest.approx(0.03, rel=0.2)
    faces = [in_group(*own, weight=100) for own in ("a1", "a2", "b1")] + [in_group("b", "2", ERROR, weight=1)]
    shift = chain_faces(faces, TARGET, "1").target_from_face["2"].translation - TRUE["2"].translation
    assert np.linalg.norm(shift) < 0.003
    pairs = {"a": "12", "b": "14", "c": "24", "d": "23"}
    expected = {"2": {"a", "bc"}, "3": {"ad", "bcd"}, "4": {"b", "ac"}}
    assert ways_by(pairs) == expected
    assert ways_by(dict(reversed(pairs.items()))) == expected  # whatever the order of the groups
    pairs["e"] = "34"
    assert ways_by(pairs) == {"2": {"a", "bc"}, "3": {"ad", "be", "bcd", "ace"}, "4": {"b", "ac"}}


def ways_by(pairs: dict[str, str]) -> dict[str, set[str]]:
    """Groups of the ways to each face, by groups that show two faces each."""
    faces = [in_group(g, f) for g, pair in pairs.items() for f in pair]
    ways = measure_chains(faces, chain_faces(faces, TARGET, "1"))
    return {face: {"".join(way.groups) for way in own} for face, own in ways.items()}


def test_faces_that_no_group_links_are_left_out_and_the_reference_face_must_be_there(labels_only):
    pairs = (("1", "2"), ("3", "4"))
    scene = make_scene(SceneOptions(seed=3, width=2592, height=1728, images_per_group=2, groups=pairs))
    found = calibrated(scene, labels_only, (), solve="chain")
    assert found.target.target_from_face.keys() == {"1", "2"}
    for face_id in "34":
        start = f"face {face_id}: left out, never linked to reference face 1; add a group that shows"
        assert sum(note.startswith(start) for note in found.notes) == 1
    faces = [in_group(*own) for own in ("a1", "a2", "b3", "b4")]
    refuses("E-FACE-UNLINKED … 3, 4 … 1", chain_faces, faces, TARGET, "1")
    refuses("E-FACE-REFERENCE … 5", chain_faces, faces[:2], TARGET, "5")
    refuses("E-TARGET-NO-FACE … 9 … 1, 2, 3, 4, 5", chain_faces, [in_group("a", "1")], TARGET, "9")


def calibrated(scene, labels_only, hidden, seed=0, groups=("12", "14"), solve="joint"):
    """``hidden`` labels in the images of the ``groups``."""
    observations = [
        image.select([i for i, label in enumerate(image.labels) if not (label in hidden and image.group in groups)])
        for image in labels_only.observations(scene, 0.02, np.random.default_rng(seed))
    ]
    models = labels_only.adjusted(scene, observations)
    return calibrate(models, scene.camera, scene.target, scene.board, AdjustOptions(reference_face="1", solve=solve))


@pytest.fixture(scope="module")
def scene():
    """Two groups of five views, half-size camera."""
    pairs = (("1", "2"), ("1", "4"))
    return make_scene(SceneOptions(seed=3, width=2592, height=1728, images_per_group=5, groups=pairs))


@pytest.mark.slow
def test_the_faces_are_as_far_off_as_they_say(scene, labels_only):
    """Circles are placed with σ 20 µm about the design: σ of the faces grows to that, and covers the error. χ²₆/6 of a
    true covariance exceeds 4 once in 2000 draws; the placement's own estimate has some 80 degrees of freedom."""
    whole = calibrated(scene, labels_only, ()).target
    found = calibrated(scene, labels_only, ("1:1", "1:5", "2:3"))
    for face_id, pose in found.target.target_from_face.items():
        if face_id == "1":
            continue
        error = pose_error(pose, scene.target_from_face[face_id])
        covariance = found.target.face_covariance[face_id]
        assert error @ np.linalg.solve(covariance, error) / 6 < 4
        own, before = (np.sqrt(np.trace(c[3:, 3:])) for c in (covariance, whole.face_covariance[face_id]))
        assert 0.005 < own < 0.2
        assert own > 1.5 * before
    assert sum("stands where the design has it" in note for note in found.notes) == 2


@pytest.mark.parametrize("solve", ["joint", "chain"])
def test_a_frame_circle_that_one_group_lacks_is_taken_from_the_others(scene, labels_only, solve):
    """Circle 1:3 in group 14 alone, the only one that links face 4: nothing is left to the design, which is 20 µm off
    and would move faces 2 and 4 by 24 and 11 µm. They agree with those of all circles to half of their σ of 13 µm."""
    whole = calibrated(scene, labels_only, (), solve=solve)
    found = calibrated(scene, labels_only, ("1:3",), groups=("14",), solve=solve)
    assert found.notes == whole.notes == ()
    for face_id, pose in whole.target.target_from_face.items():
        assert np.linalg.norm(found.target.target_from_face[face_id].translation - pose.translation) < 0.007
