"""What target and camera do to all poses together is what they are drawn from."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.camera import intrinsic_basis
from stcal.io.cameras.model import CameraPrior
from stcal.sfm.measurement.pose import MOST, common_errors, pose_from_circles
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.support.image_poses import faces_view, known_target, pose_error, see, view

NOISE_PX = 0.02
SIGMA = np.array([0.3, 0.3, 0.3, 0.3, 1e-4, 3e-4, 1e-5, 1e-5])
"""Of intrinsics: fx, fy, cx, cy, k1, k2, p1, p2."""


@pytest.fixture(scope="module")
def scene():
    return make_scene(SceneOptions(seed=5, width=2592, height=1728, images_per_group=6))


@pytest.fixture(scope="module")
def known(scene):
    return known_target(scene, NOISE_PX)


def measured(image, target, camera, prior):
    return pose_from_circles(image.labels, image.centre_px, image.covariance_px2, target, camera, prior=prior)


def test_what_is_common_is_less_than_the_whole(scene, known):
    """Of a pose whose covariance is smaller than the target's part of it, as a curved likelihood may have it."""
    rng = np.random.default_rng(1)
    images = [see(scene, view(faces_view(scene, ("1", "2")), 0.2, 900, rng), ("1", "2"), NOISE_PX, rng) for _ in "abc"]
    poses = [measured(image, known.truth, scene.camera, None) for image in images]
    poses[1] = replace(poses[1], covariance=0.3 * poses[1].parts["target"] + 1e-3 * poses[1].parts["image"])
    common = common_errors(poses, known.truth, None)
    for pose, own in zip(poses, common, strict=True):
        root = np.linalg.inv(np.linalg.cholesky(pose.covariance))
        left = np.linalg.eigvalsh(np.eye(6) - root @ own @ own.T @ root.T)
        assert left[0] > 5e-4


@pytest.mark.parametrize(
    ("with_camera", "draws"), [(True, 4), *(pytest.param(own, 20, marks=pytest.mark.full) for own in (True, False))]
)
def test_poses_err_together_as_stated(scene, known, with_camera, draws):
    """Without noise in the images all errors are common ones: z of each direction, from the errors of all poses, has
    mean square 1, to 1.4 / √(directions × draws)."""
    rng = np.random.default_rng(0)
    faces = [("1", "2"), ("1", "4"), ("1", "5"), ("2", "3")] * 3
    truths = [view(faces_view(scene, f), np.radians(15), rng.uniform(700, 1200), rng) for f in faces]
    images = [see(scene, truth, f, 0.0, rng) for truth, f in zip(truths, faces, strict=True)]
    images = [replace(i, covariance_px2=np.tile(NOISE_PX**2 * np.eye(2), (len(i), 1, 1))) for i in images]
    prior = CameraPrior(scene.camera.colmap_model, np.diag(SIGMA**2)) if with_camera else None
    exact = [measured(image, known.truth, scene.camera, prior) for image in images]
    common = common_errors(exact, known.truth, prior)
    assert 6 <= common.shape[2] <= MOST
    own = np.linalg.cholesky([pose.covariance for pose in exact])
    felt = np.linalg.pinv(np.linalg.solve(own, common).reshape(6 * len(images), -1))
    z = []
    for _ in range(draws):
        target, camera = known.measured(rng), scene.camera
        if with_camera:
            away = intrinsic_basis(scene.camera.colmap_model) @ (SIGMA * rng.standard_normal(8))
            camera = camera.with_parameters(camera.parameters() + away)
        poses = [measured(image, target, camera, prior) for image in images]
        error = [pose_error(p.camera_from_target, t) for p, t in zip(poses, truths, strict=True)]
        z.append(felt @ np.linalg.solve(own, np.array(error)[:, :, None]).ravel())
    assert np.mean(np.square(z)) == pytest.approx(1, abs=3 * np.sqrt(2 / np.size(z)))
