"""Every method on simulated poses with known truth."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import METHODS, HandEyeOptions, HandEyePoses, Noise
from stcal.handeye.data.pose_pairs import FRAMES, SETUPS, Loop, Motions, poses_with_log
from stcal.handeye.methods.closed_form import AX_XB, Bounds, EvolutionOptions, Objective, evolve, robust
from tests.levels import sampled
from tests.outcome import fails_with, refuses
from tests.support.handeye import disturbed, handeye, simulated

FROM_POSES = tuple(m for m in METHODS if m != "reprojection")
EXACT = tuple(m for m in FROM_POSES if m != "de")
"""Plain differential evolution ends where its last generation is."""


def off(found, truth, name="mount_from_camera"):
    away = getattr(truth, name).inverse() @ getattr(found, name)
    return away.angle_rad(), float(np.linalg.norm(away.translation))


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("method", EXACT)
def test_exact_poses_give_the_truth(method, setup):
    truth = simulated(np.random.default_rng(3), 12, setup)
    found = handeye(truth.pairs, setup, method)
    assert found.transforms[f"{FRAMES[setup].mount}_from_camera"] is found.mount_from_camera
    for name in ("mount_from_camera", "stand_from_board"):
        angle, distance = off(found, truth, name)
        assert angle < 1e-8
        assert distance < 1e-5
    assert np.abs(found.residuals).max() < 1e-5


@pytest.mark.parametrize("method", FROM_POSES)
def test_noisy_poses_give_about_the_truth(method):
    """σ of X is about that of a pose over its lever and √m: 1 mrad × 450 mm over √20 ≈ 0.2 mm; 4 mm is a blunder.
    Zhao's R_X need not be a rotation and takes up ten times more; plain evolution ends anywhere near the bottom."""
    truth = simulated(np.random.default_rng(4), 20, robot=(2e-4, 0.1), camera=(1e-3, 0.3))
    angle, distance = off(handeye(truth.pairs, method=method), truth)
    assert 1e-6 < angle < {"de": 0.1}.get(method, 5e-3)
    assert 1e-3 < distance < {"de": 100, "zhao": 15}.get(method, 4)


@pytest.mark.parametrize("method", EXACT)
def test_the_unit_of_the_poses_and_motions_near_half_a_turn_make_no_difference(method):
    """Tilts of ±80° and turns of ±160°: some motions exceed 170°; only methods that take logarithms lose poses."""
    truth = simulated(np.random.default_rng(5), 10, camera=(1e-3, 0.4))
    sides = (truth.pairs.base_from_flange, truth.pairs.camera_from_board)
    in_metres = HandEyePoses(*(Poses(p.rotation, p.translation / 1000) for p in sides))
    known = [HandEyeOptions(noise=Noise(0.0, 0.0, 1e-3, mm)) for mm in (0.4, 0.0004)]
    mm, m = (handeye(p, "eye-in-hand", method, options=o) for p, o in zip((truth.pairs, in_metres), known, strict=True))
    assert mm.mount_from_camera.rotation == pytest.approx(m.mount_from_camera.rotation, abs=1e-6)
    assert mm.mount_from_camera.translation == pytest.approx(1000 * m.mount_from_camera.translation, abs=2e-3)
    truth = simulated(np.random.default_rng(1), 14, robot=(3e-4, 0.1), camera=(1e-3, 0.3), tilt=1.4)
    angle, _ = off(found := handeye(truth.pairs, method=method), truth)
    assert 1e-6 < angle < 4e-3
    assert bool(found.notes) == (method in AX_XB)


def test_poses_in_two_groups_half_a_turn_apart():
    """Any motion between the groups turns by more than 170°: two poses with logarithms are left, Shah needs none."""
    truth = simulated(np.random.default_rng(2), 4)
    y, x, half = (Rotation.from_rotvec(np.radians(v)) for v in ([0, 30, 0], [30, 0, 0], [0, 0, 180]))
    turns = [Rotation.identity(), y, half, half * x]
    flange = Poses(np.array([t.as_matrix() for t in turns]), truth.pairs.base_from_flange.translation)
    board = truth.mount_from_camera.inverse() @ (flange.inverse() @ truth.stand_from_board)
    pairs = HandEyePoses(flange, board)
    for method in ("shah", "pose"):
        assert off(handeye(pairs, method=method), truth)[0] < 1e-8
    refuses("E-HANDEYE-LARGE-TURNS", handeye, pairs, method="park-martin")
    assert poses_with_log(Loop.of(pairs, "eye-in-hand")).sum() == 2


def test_evolution_follows_its_rules():
    """The best never gets worse, the same seed repeats itself, and without crossover nothing moves."""
    truth = simulated(np.random.default_rng(6), 19, camera=(1e-3, 0.3))
    motions = Motions.consecutive(Loop.of(truth.pairs, "eye-in-hand"))
    objective = Objective(motions, 1000.0, 1.0)
    runs = [evolve(objective, EvolutionOptions(generations=n, seed=3), 500) for n in range(0, 101, 20)]
    costs = [objective.linear(x).cost for x in runs]
    assert (np.diff(costs) <= 1e-12).all()
    assert costs[0] > 2 * costs[1] > 4 * costs[5]
    again = evolve(objective, EvolutionOptions(seed=3), 500)
    assert objective.linear(again).cost == costs[5]
    still = evolve(objective, EvolutionOptions(seed=3, crossover=0.0), 500)
    assert objective.linear(still).cost == pytest.approx(costs[0], rel=1e-12)


def test_wrong_arguments_and_options():
    pairs = simulated(np.random.default_rng(3), 6).pairs
    refuses("E-OPTION-METHOD … 'tsai' … tsai-lenz", handeye, pairs, method="tsai")
    refuses("E-HANDEYE-SETUP … 'hand-in-eye' … eye-in-hand or eye-to-hand", handeye, pairs, "hand-in-eye")
    refuses("E-HANDEYE-NEEDS-VIEWS", handeye, pairs, method="reprojection")
    with fails_with("E-HANDEYE-NO-TRANSFORM … eye-in-hand … base_from_camera"):
        _ = handeye(pairs).base_from_camera
    refuses("E-EVOLUTION-OPTIONS … 3", EvolutionOptions, population=3)
    refuses("E-EVOLUTION-OPTIONS … -1", Bounds, -1.0)
    refuses("E-EVOLUTION-OPTIONS … 1e+308", Bounds, 1e308)
    refuses("E-SIGMA-INCOMPLETE … σ_rot … σ_trans … robot", Noise, robot_rad=1e-3)
    refuses("E-SIGMA-VALUE … 10 … 100", Noise, camera_rad=1e-3, camera_mm=-1.0)
    refuses("E-SIGMA-VALUE … corner_px … 0 … more … than 0", Noise, corner_px=0.0)
    refuses("E-SIGMA-VALUE", Noise, 0.0, 0.1, 0.0, 0.1)


def test_park_and_martin_as_they_wrote_it_and_every_name_is_a_method_of_its_own():
    """R_X = (MᵀM)^(−1/2) Mᵀ with M = Σ β αᵀ over all pairs of poses. On noisy poses no two methods agree, and the
    separable ones share what they share: the translation's equations."""
    truth = simulated(np.random.default_rng(11), 9, camera=(2e-3, 0.3))
    motions = Motions.all(Loop.of(truth.pairs, "eye-in-hand"))
    m = motions.beta.T @ motions.alpha
    value, vector = np.linalg.eigh(m.T @ m)
    rotation = vector @ np.diag(value**-0.5) @ vector.T @ m.T
    found = handeye(truth.pairs, method="park-martin").mount_from_camera
    assert found.rotation == pytest.approx(rotation, abs=1e-9)
    shift = np.linalg.lstsq(
        (motions.mount.rotation - np.eye(3)).reshape(-1, 3),
        (motions.camera.translation @ rotation.T - motions.mount.translation).ravel(),
        rcond=None,
    )[0]
    assert found.translation == pytest.approx(shift, abs=1e-6)
    truth = simulated(np.random.default_rng(12), 9, camera=(2e-3, 0.3))
    found = {method: handeye(truth.pairs, method=method).mount_from_camera for method in FROM_POSES}
    for one, other in combinations(found, 2):
        apart = np.linalg.norm(found[one].translation - found[other].translation)
        assert apart > 1e-6, (one, other)
    horaud = found["horaud"].rotation  # Horaud's quaternion and Shah's product minimise the same over rotations only
    assert horaud == pytest.approx(found["park-martin"].rotation, abs=3e-3)


def apart(found: Rigid, true: Rigid) -> np.ndarray:
    error = (found @ true.inverse()).log()
    return np.array([np.linalg.norm(error[:3]), np.linalg.norm(found.translation - true.translation)])


@pytest.mark.parametrize("seed", sampled(range(4)))
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


@pytest.mark.parametrize("seed", sampled(range(4)))
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
