"""IPPE: against OpenCV's, and against poses that are known."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.plane import poses_of_plane
from stcal.geometry.rigid import Rigid
from tests.outcome import fails_with


def scene(seed: int):
    rng = np.random.default_rng(seed)
    while True:
        xy = rng.uniform(-50, 50, (6, 2)) + np.array([30, 10])
        turn = Rotation.from_rotvec(0.5 * rng.standard_normal(3)).as_matrix()
        pose = Rigid(turn, [*rng.uniform(-200, 200, 2), 800.0])
        at = pose @ np.pad(xy, ((0, 0), (0, 1)))
        middle = at.mean(0)
        cosine = turn[:, 2] @ middle / np.linalg.norm(middle)
        if cosine > 0.1 and (at[:, 2] > 0).all():
            return xy, at[:, :2] / at[:, 2:], pose, cosine


@pytest.mark.parametrize("seed", range(20))
def test_one_of_the_poses_is_the_true_one_and_both_are_opencvs(seed):
    xy, seen, pose, cosine = scene(seed)
    found = poses_of_plane(xy, seen)
    off = [
        max(np.abs(p.rotation - pose.rotation).max(), np.abs(p.translation - pose.translation).max())
        for p in found.poses
    ]
    assert min(off) < 1e-8  # rounding, over the condition of the homography
    assert found.foreshortening == pytest.approx(cosine, abs=1e-9)
    _, turns, _, _ = cv2.solvePnPGeneric(np.pad(xy, ((0, 0), (0, 1))), seen, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    theirs = [cv2.Rodrigues(turn)[0] for turn in turns]
    for ours in found.poses:
        assert min(np.abs(ours.rotation - each).max() for each in theirs) < 1e-9


def test_size_and_distance_change_det_j_but_not_the_foreshortening():
    xy, seen, _, _ = scene(3)
    one, ten = poses_of_plane(xy, seen), poses_of_plane(10 * xy, seen)
    assert ten.foreshortening == pytest.approx(one.foreshortening, rel=1e-9)
    assert ten.determinant == pytest.approx(one.determinant / 100, rel=1e-9)


def test_from_behind_is_refused():
    xy, seen, _, _ = scene(0)
    with fails_with("E-POINTS-MIRRORED"):
        poses_of_plane(xy * [-1, 1], seen)
