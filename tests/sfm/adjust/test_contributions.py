"""The adjustment's covariance taken apart, against what small changes of the inputs do."""

from dataclasses import replace

import numpy as np
import pytest

from stcal import CameraPrior, Rigid
from stcal.geometry.normal_equations import free_motions
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.uncertainty import (
    DISTANCES,
    INTRINSICS,
    OBSERVED,
    PRINT,
    SIZES,
    calibrated_target,
    contributions_of,
    derivatives,
)

FLATNESS_MM = 0.02
SIGMAS = np.array([1.5, 1.5, 1.0, 1.0, 5e-4, 2e-3, 5e-5, 5e-5])
"""Of fx, fy, cx, cy (px), k1, k2, p1, p2."""


@pytest.fixture(scope="module")
def case(labels_only, small_scene):
    observed = labels_only.observations(small_scene, 0.01, np.random.default_rng(2))
    return labels_only.models(small_scene, observed), small_scene


def state_of(case, refined=False, common=None, board=None, camera=None):
    models, scene = case
    prior = CameraPrior(scene.camera.colmap_model, np.diag(SIGMAS**2)) if refined else None
    return adjusted(models, board or scene.board, camera or scene.camera, FLATNESS_MM, prior, common=common)


def shift(case, changed, common) -> np.ndarray:
    before = state_of(case, common=common).result().xyz_model
    free = free_motions(before, scale=False)
    moved = (changed.result().xyz_model - before).ravel()
    return moved - free @ (free.T @ moved)


@pytest.mark.parametrize(("refined", "common"), [(False, None), (True, None), (False, 0.6)])
def test_the_parts_are_covariances_and_their_sum_is_the_adjustments_own(case, refined, common):
    found = contributions_of(state_of(case, refined, common))
    whole = found.joint.covariance_mm2
    assert list(found.covariance_mm2) == list(OBSERVED)
    absent = {PRINT, SIZES, DISTANCES} if refined else {PRINT, SIZES, DISTANCES, INTRINSICS}
    for kind, part in found.covariance_mm2.items():
        least, most = np.linalg.eigvalsh(part)[[0, -1]]
        assert least > -1e-9 * np.abs(whole).max(), kind
        assert (most > 1e-4 * np.abs(whole).max()) == (kind not in absent), kind
    np.testing.assert_allclose(sum(found.covariance_mm2.values()), whole, atol=1e-7 * np.abs(whole).max())


def test_what_the_sources_contribute_to_a_position_adds_up_as_squares(case):
    """It is what :func:`contributions_of` has of each kind, in the face's own frame."""
    scene = case[1]
    state = state_of(case, refined=True)
    seen = {label.face for label in state.setting.labels}
    poses = {face: pose for face, pose in scene.target_from_face.items() if face in seen}
    start = CalibratedTarget("1", poses, scene.circles_target, dict.fromkeys(scene.groups, Rigid()))
    joint, parts = state.result(), contributions_of(state).covariance_mm2
    found = calibrated_target(joint, start, scene.target, "plane", state)
    assert calibrated_target(joint, start, scene.target, "plane").position_sources_mm == {}
    own = derivatives(joint, start, scene.target, "plane")
    for face, sources in found.position_sources_mm.items():
        variance = np.diag(found.face_covariance[face])[3:]
        total = sum(sigma**2 for sigma in sources.values())
        np.testing.assert_allclose(total, variance, rtol=1e-6, atol=1e-12)
        for kind, sigma in sources.items():
            expected = np.diag(own.faces[face][3:] @ parts[kind] @ own.faces[face][3:].T)
            np.testing.assert_allclose(sigma**2, expected, rtol=1e-6, atol=1e-6 * variance.max() + 1e-12)


@pytest.mark.parametrize("common", [0.0, 0.6])
def test_a_wider_pitch_moves_the_circles_as_foretold(case, common):
    found = contributions_of(state_of(case, common=common))
    board = case[1].board
    wider = state_of(case, common=common, board=replace(board, pitch_mm=board.pitch_mm * (1 + 1e-5)))
    np.testing.assert_allclose(shift(case, wider, common), 1e-5 * found.by_scale, atol=1e-6)
    xyz = found.joint.xyz_model - found.joint.xyz_model.mean(0)
    np.testing.assert_allclose(found.by_scale, xyz.ravel(), atol=1e-3 * np.abs(xyz).max())


def test_another_camera_moves_the_circles_as_foretold(case):
    """The error is the adjusted circle less the true one: what the camera was wrongly given more."""
    found = contributions_of(state_of(case, common=0.0))
    away = np.zeros(16)
    away[[0, 2, 4]] = 0.1, 0.05, 1e-5
    camera = case[1].camera
    other = state_of(case, common=0.0, camera=camera.with_parameters(camera.parameters() + away))
    moved = shift(case, other, 0.0)
    assert np.abs(moved).max() > 1e-3
    np.testing.assert_allclose(moved, -found.by_intrinsics @ away, atol=1e-3 * np.abs(moved).max())
