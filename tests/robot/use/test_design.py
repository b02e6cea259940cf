"""Observability indices by hand; chosen measurement poses against random ones."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import ObservabilityIndices, identification_jacobian
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.robot_model import Joint, mh80
from stcal.robot.robot_report import design_report
from stcal.robot.simulated import joint_vectors, made, measured
from stcal.robot.use.pose_design import DesignOptions, choose, design
from tests.outcome import fails_with, refuses

TOOL = Rigid.exp([0.1, 0.2, -0.3, 40.0, -25.0, 110.0])
ARM = replace(mh80(), tools={"": TOOL})


def test_indices_by_hand_and_exchange_finds_the_best_of_all_sets_of_a_small_problem():
    found = ObservabilityIndices.of([2.0, 8.0, 4.0], 4)
    assert found.o1 == pytest.approx(64 ** (1 / 3) / 2)  # cube root of 2·4·8 over √4
    assert found.o2 == pytest.approx(0.25)
    assert found.o3 == pytest.approx(2)
    assert found.o4 == pytest.approx(0.5)  # 2² / 8
    assert found.o5 == pytest.approx(8 / 7)  # 1 / (1/2 + 1/4 + 1/8)
    assert ObservabilityIndices.of([3.0, 0.0], 1).values() == dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
    sigma = np.geomspace(1e-12, 1e12, 400)  # of many poses: no overflow, and in any order
    assert ObservabilityIndices.of(sigma, 1).o1 == pytest.approx(1)
    assert ObservabilityIndices.of(sigma[::-1], 1).o4 == pytest.approx(1e-36)
    # Against every set of three out of twelve.
    hits = 0
    for seed in range(10):
        rows = np.random.default_rng(seed).normal(size=(12, 2, 4))
        chosen, _ = choose(rows, 3)

        def volume(index, rows=rows):
            return np.linalg.slogdet(np.einsum("mri,mrj->ij", rows[list(index)], rows[list(index)]))[1]

        best = max(volume(c) for c in combinations(range(12), 3))
        assert len(set(chosen.tolist())) == 3
        assert volume(chosen) > best - 1.0
        hits += volume(chosen) > best - 1e-9
    assert hits >= 6  # single exchanges may end in a local best, mostly they do not
    rows = np.full((6, 1, 1), 0.1) * np.eye(2)
    rows[2] *= 100  # no pose is taken twice however good it is
    chosen, _ = choose(rows, 3)
    assert 2 in chosen
    assert len(set(chosen.tolist())) == 3


@pytest.mark.parametrize(("limits", "low", "high"), [({"upper": 1.0}, 1.0 - 2 * np.pi, 1.0), ({}, -np.pi, np.pi)])
def test_a_joint_without_limits_turns_once(limits, low, high):
    joints = (Joint(**limits), *ARM.joints[1:])
    (q,) = design(replace(ARM, joints=joints), DesignOptions(count=30, candidates=300)).q[:, :1].T
    assert low <= q.min() < low + 1
    assert high - 1 < q.max() <= high


def test_chosen_poses_beat_every_random_set_and_are_the_same_of_the_same_seed():
    result = design(ARM, DesignOptions(count=30, observe="pose", candidates=600, seed=3))
    assert (result.seen, result.parameters) == (30, 30)
    assert len(result.random) == 20
    assert result.chosen.o1 > 1.02 * max(each.o1 for each in result.random)
    assert result.sigma_mm < 0.97 * result.random_sigma_mm
    assert result.exchanges > 0
    box = (600.0, -700.0, 300.0, 1700.0, 700.0, 1500.0)
    options = DesignOptions(count=12, candidates=200, seed=5, box=box)
    first, second = design(ARM, options), design(ARM, options)
    np.testing.assert_array_equal(first.q, second.q)
    assert not np.array_equal(first.q, design(ARM, replace(options, seed=6)).q)
    low, high = ARM.limits().T
    assert ((first.q >= low) & (first.q <= high)).all()
    at = forward(ARM, first.q).translation
    assert (at >= box[:3]).all()
    assert (at <= box[3:]).all()
    np.testing.assert_allclose(first.poses.translation, at)


def test_identification_states_the_indices_that_the_design_promised_and_the_sigma():
    """With σ₀ out of the σ that the residuals tell; the arm as made differs from its drawing by a thousandth. By linear
    least squares on noisy positions, too: spread of predicted positions against the stated σ."""
    options = DesignOptions(count=40, observe="pose", candidates=300, sigma_mm=0.05, sigma_rad=2e-4)
    planned = design(ARM, options)
    true, rng = made(ARM, np.random.default_rng(2)), np.random.default_rng(3)
    data = measured(true, planned.q, rng, 0.05, 2e-4)
    found = identify(ARM, data, IdentifyOptions("pose", 0.05, 2e-4, folds=0))
    for name, value in planned.chosen.values().items():
        scale = 1.0 if name == "O2" else found.sigma0
        assert found.observability.values()[name] * scale == pytest.approx(value, rel=0.02)
    options = DesignOptions(count=25, candidates=300, sigma_mm=0.05)
    result = design(ARM, options)
    rng = np.random.default_rng(0)
    rows = identification_jacobian(ARM, result.q, "position", options.sigma_mm).reshape(-1, 27)
    other = joint_vectors(ARM, 300, rng, 1.0)
    predict = identification_jacobian(ARM, other, "position")
    found = np.linalg.pinv(rows, rcond=1e-13) @ rng.normal(size=(len(rows), 200))
    spread = np.sqrt(np.mean((predict @ found) ** 2))
    # 200 draws of 27 correlated parameters, and 200 against 300 poses: about 5 %.
    assert spread == pytest.approx(result.sigma_mm, rel=0.15)


def test_what_no_pose_shows_is_left_out_and_told_and_mistakes_are_named():
    """A tool on the last axis: two tilts of that axis look like two shifts."""
    result = design(mh80(), DesignOptions(count=20, candidates=200))
    assert (result.seen, result.parameters) == (25, 27)
    assert result.chosen.o3 > 0
    assert "2 of 27 combinations of parameters move nothing" in design_report(result, mh80()).text()
    refuses("E-DESIGN-FEW … 8 … 3 … 27 … 9", design, ARM, DesignOptions(count=8, candidates=100))
    refuses("E-DESIGN-OPTIONS", DesignOptions, count=50, candidates=50)
    refuses("E-DESIGN-OPTIONS", DesignOptions, box=(0, 0, 0, 1, 1, -1))
    refuses("E-SIGMA-VALUE", DesignOptions, sigma_mm=0)
    refuses("E-SIGMA-VALUE", DesignOptions, sigma_mm=1e308)
    with fails_with("E-DESIGN-BOX … 0 … 5000"):
        design(ARM, DesignOptions(count=10, candidates=50, box=(5000, 0, 0, 6000, 1, 1)))
    sliding = replace(ARM, joints=(*ARM.joints[:2], Joint("prismatic"), *ARM.joints[3:]))
    refuses("E-ROBOT-LIMITS … 3", design, sliding)
