"""``faces.json`` has every number of the calibrated target, in the order and units that it states."""

import json

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.io.files import json_text
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.runs.run_options import RunOptions


@pytest.fixture(scope="module")
def written(scene, labels_only):
    target, _ = labels_only.calibrate(scene, 0.01, 4)
    options = RunOptions().settled(scene.target).adjustment(scene.target)
    content = FacesFile.of(target, scene.target, options, 1.25).content()
    return target, json.loads(json_text(content))


def test_poses_and_circles_come_back(written, scene):
    target, content = written
    for face_id, pose in target.target_from_face.items():
        found = Rigid.from_matrix(content["target_from_face"][face_id])
        np.testing.assert_allclose(found.matrix(), pose.matrix(), atol=1e-15)
    np.testing.assert_allclose(content["target_from_face"]["1"], np.eye(4), atol=1e-15)
    circles = {str(label): xyz for label, xyz in target.circles.items()}
    assert content["circles"] == {label: xyz.tolist() for label, xyz in circles.items()}
    radius = {str(label): value for label, value in scene.target.radius_of().items()}
    assert content["radius_mm"] == {label: radius[label] for label in circles}
    assert content["centre_sigma_factor"] == 1.25


def test_sigma_of_a_distance_is_that_of_the_faces(written):
    """From the reference, which is held, to another face: what the other's translation may do along the line."""
    target, content = written
    for face_id in ("2", "3"):
        along = np.array(content["target_from_face"][face_id])[:3, 3]
        along = along / np.linalg.norm(along)
        covariance = np.array(content["target_from_face_covariance"][face_id])[3:, 3:]
        sigma = content["distance_sigma_mm"][f"1 {face_id}"]
        assert sigma == pytest.approx(np.sqrt(along @ covariance @ along), rel=1e-6)
    assert content["scale_sigma_ppm"] == pytest.approx(1e6 * target.scale_sigma)
