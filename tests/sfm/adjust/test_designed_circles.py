"""Frame circles that no image shows: the design stands for them, and σ says what that is worth."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.sfm.adjust.calibration import AdjustOptions, calibrate
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.outcome import fails_with


def calibrated(scene, labels_only, hidden, seed=0, groups=("12", "14"), solve="joint"):
    """``hidden`` labels in the images of the ``groups``."""
    observations = [
        image.select([i for i, label in enumerate(image.labels) if not (label in hidden and image.group in groups)])
        for image in labels_only.observations(scene, 0.02, np.random.default_rng(seed))
    ]
    radius = scene.target.radius_of() | scene.board.radius_of()
    models = []
    for start in labels_only.models(scene, observations):
        model = replace(start, shift_px=eccentricity_px(start, scene.camera, radius, 1.0))
        models.append(adjust(model, scene.camera))
    return calibrate(models, scene.camera, scene.target, scene.board, AdjustOptions(reference_face="1", solve=solve))


@pytest.fixture(scope="module")
def scene():
    """Two groups of five views, half-size camera."""
    return make_scene(
        SceneOptions(seed=3, width=2592, height=1728, images_per_group=5, groups=(("1", "2"), ("1", "4")))
    )


@pytest.fixture(scope="module")
def whole(scene, labels_only):
    return calibrated(scene, labels_only, ()).target


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [("1:1", "1:5", "2:3"), ("2:1",)])
def test_the_faces_are_as_far_off_as_they_say(scene, labels_only, whole, hidden):
    """Circles are placed with σ 20 µm about the design: σ of the faces grows to that, and covers the error. χ²₆/6 of a
    true covariance exceeds 4 once in 2000 draws; the placement's own estimate has some 80 degrees of freedom."""
    found = calibrated(scene, labels_only, hidden)
    for face_id, pose in found.target.target_from_face.items():
        if face_id == "1":
            continue
        truth = scene.target_from_face[face_id]
        turned = (pose @ truth.inverse()).log()[:3]
        error = np.concatenate([turned, pose.translation - truth.translation])
        covariance = found.target.face_covariance[face_id]
        assert error @ np.linalg.solve(covariance, error) / 6 < 4
        if hidden[0].startswith("1") or face_id == "2":
            own, before = (np.sqrt(np.trace(c[3:, 3:])) for c in (covariance, whole.face_covariance[face_id]))
            assert 0.005 < own < 0.2
            assert own > 1.5 * before
    assert sum("stands where the design has it" in note for note in found.notes) == len({x[0] for x in hidden})


def test_too_few_other_circles_are_refused(scene, labels_only):
    hidden = [f"1:{circle}" for circle in "134567c"]
    with fails_with("E-FACE-REFERENCE"):
        calibrated(scene, labels_only, hidden)


@pytest.mark.parametrize("solve", ["joint", "chain"])
def test_a_frame_circle_that_one_group_lacks_is_taken_from_the_others(scene, labels_only, solve):
    """Circle 1:3 in group 14 alone, the only one that links face 4: nothing is left to the design, which is 20 µm off
    and would move faces 2 and 4 by 24 and 11 µm. They agree with those of all circles to half of their σ of 13 µm."""
    whole = calibrated(scene, labels_only, (), solve=solve)
    found = calibrated(scene, labels_only, ("1:3",), groups=("14",), solve=solve)
    assert found.notes == whole.notes == ()
    for face_id, pose in whole.target.target_from_face.items():
        assert np.linalg.norm(found.target.target_from_face[face_id].translation - pose.translation) < 0.007
