"""First values: exact from exact poses, and as good as that with a third of bad ones."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pose_pairs import HandEyePoses, Loop
from stcal.handeye.methods.closed_form import robust
from tests.support.handeye import disturbed, simulated


def apart(found: Rigid, true: Rigid) -> np.ndarray:
    error = (found @ true.inverse()).log()
    return np.array([np.linalg.norm(error[:3]), np.linalg.norm(found.translation - true.translation)])


def test_the_board_s_size_comes_out_too():
    truth = simulated(np.random.default_rng(1), 12)
    loop = Loop.of(truth.pairs, "eye-in-hand")
    eye = loop.camera_from_board
    x, _, scale = robust(replace(loop, camera_from_board=Poses(eye.rotation, eye.translation / 1.05)), True)
    assert scale == pytest.approx(1.05, rel=1e-9)
    assert apart(x, truth.mount_from_camera)[1] < 1e-5


@pytest.mark.parametrize("seed", range(4))
def test_a_third_of_bad_poses_does_no_harm(seed):
    """Five of fifteen off by 0.3 rad and 100 mm, the others by 1e-4 rad and 0.05 mm: about what ten good ones give; the
    solution of all at once is tens of mm off."""
    rng = np.random.default_rng(seed)
    truth = simulated(rng, 15)
    loop = Loop.of(truth.pairs, "eye-in-hand")
    eye, bad = loop.camera_from_board, np.arange(15) < 5
    good, spoilt = disturbed(rng, eye, 1e-4, 0.05), disturbed(rng, eye, 0.3, 100.0)
    rotation = np.where(bad[:, None, None], spoilt.rotation, good.rotation)
    translation = np.where(bad[:, None], spoilt.translation, good.translation)
    x, z, _ = robust(replace(loop, camera_from_board=Poses(rotation, translation)))
    assert 1e-6 < apart(x, truth.mount_from_camera)[0] < 1e-3
    assert 1e-3 < apart(x, truth.mount_from_camera)[1] < 1.0
    assert apart(z, truth.stand_from_board)[1] < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_flange_that_turns_about_a_point_does_not_shrink_the_board(seed):
    """Six of nine poses turn about one point of the flange, exactly, which a board of no size would fit; the camera
    errs by 1 mm at a quarter of a metre or more, so that the size is known to 1 % or so from the three that move."""
    rng = np.random.default_rng(seed)
    truth = simulated(rng, 9, camera=(1e-3, 0.3))
    flange, point = truth.pairs.base_from_flange, np.array([20.0, 10.0, 350.0])
    place = np.array(flange.translation)
    place[:6] = place[0] + (flange.rotation[0] @ point) - flange.rotation[:6] @ point
    moved = Poses(flange.rotation, place)
    board = (moved @ truth.mount_from_camera).inverse() @ Poses.of([truth.stand_from_board] * 9)
    pairs = HandEyePoses(moved, disturbed(rng, board, 1e-3, 1.0))
    assert robust(Loop.of(pairs, "eye-in-hand"), True)[2] == pytest.approx(1, abs=0.1)
