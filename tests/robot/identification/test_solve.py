"""Identification against simulated arms of known kinematics, and real tracker data where they are at hand."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import DegenerateError, InputError
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.prior import dh_values
from stcal.robot.identification.result import Identified, IdentifyOptions
from stcal.robot.identified_report import identified_report
from stcal.robot.kinematics.forward import flange_poses
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.levels import sampled
from tests.scripts import load_script
from tests.support.arms import MARKERS, two_arms

pytestmark = pytest.mark.slow

QUICK = IdentifyOptions(folds=0)


def simulated(seed: int, count: int, sigma_mm: float = 0.05, sigma_rad: float = 2e-4, targets=("",)):
    """A made arm somewhere in the instrument's frame, and what the instrument sees of it."""
    rng = np.random.default_rng(seed)
    tools = {name: Rigid.exp(rng.normal(0, 0.5, 6) * [1, 1, 1, 200, 200, 200]) for name in targets}
    true = placed(made(mh80(), rng), Rigid.exp(rng.normal(0, 1, 6) * [1, 1, 1, 1000, 1000, 1000]), tools)
    names = [targets[i % len(targets)] for i in range(count)]
    return true, measured(true, joint_vectors(true, count, rng), rng, sigma_mm, sigma_rad, names)


def test_what_a_model_lacks_at_repeated_joint_values_counts_once():
    """Forty places, four measurements at each with one error of 0.2 mm in common; taken for independent, the mean
    squared error of new positions over the covariance is 5.3. Two draws: 1 ± 0.32, three of these."""
    squares = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        true, first = simulated(seed, 40, 0.2, 5e-4)
        rows = np.repeat(np.arange(40), 4)
        data = first[rows]
        data = replace(data, positions=data.positions + rng.normal(0, 0.01, (160, 3)))
        found, q = identify(mh80(), data, IdentifyOptions("position", folds=0)), joint_vectors(true, 50, rng)
        at, motion = found.state.tip_jacobian(q, ("",) * 50, "position")
        motion = motion[:, 3:, : len(found.names)]
        covariance = motion @ found.covariance @ np.swapaxes(motion, 1, 2)
        off = at.translation - State(true.chain(), dict(true.tools)).tips(q, ("",) * 50).translation
        squares.append(np.einsum("mi,mi->m", off, np.linalg.solve(covariance, off[..., None])[..., 0]).mean() / 3)
    assert 0.05 < np.mean(squares) < 1.95


def test_without_noise_the_arm_is_found_exactly_and_one_whose_rows_are_singular_to_noise():
    true, data = simulated(1, 40, 0, 0)
    found = identify(mh80(), data, QUICK)
    q = joint_vectors(true, 50, np.random.default_rng(9))
    wanted, own = (flange_poses(robot.chain(), q) @ robot.tools[""] for robot in (true, found.robot))
    assert np.abs(wanted.difference(own)[:, 3:]).max() < 1e-7  # mm; rounding of 2 m over the condition of the data
    assert found.nominal_mm.mean() > 0.3
    rows = (*mh80().rows[:4], DHRow(0, 0, 0, 0), DHRow(0, 0, 175, 0))  # the last three axes on one line
    arm = Robot("singular", "standard", rows, (Joint(),) * 6)
    rng = np.random.default_rng(0)
    q = joint_vectors(arm, 60, rng)
    seen = flange_poses(arm.chain(), q)
    positions = seen.translation + rng.normal(0, 0.05, (60, 3))
    data = Measurements("d", range(2, 62), q, ("",) * 60, positions, seen.rotation)
    found = identify(arm, data, replace(QUICK, sigma_mm=0.05, sigma_rad=1e-4))
    assert found.rank == 30
    # mean length of the noise is 1.6 σ = 0.08 mm, less what 30 parameters take up of 360 numbers
    assert 0.06 < found.fitted_mm.mean() < 0.09
    again = flange_poses(found.robot.chain(), q) @ found.robot.tools[""]
    assert again.difference(found.state.tips(data.q, data.targets)) == pytest.approx(np.zeros((60, 6)), abs=1e-9)


@pytest.mark.parametrize("tree", [False, True])
@pytest.mark.parametrize("kind", ["pose", "position", "distance"])
def test_derivatives_are_those_of_differences(kind, tree):
    """Without noise: with residuals w the logarithm of a rotation turns by w / 2 more."""
    true, rng = two_arms() if tree else simulated(4, 2, targets=("a", "b"))[0], np.random.default_rng(3)
    names = MARKERS * 4 if tree else ("a", "b") * 6
    data = measured(true, joint_vectors(true, 12, rng), rng, 0, 0, names)
    state, seen = State(true.chain(), dict(true.tools)), observed(data, kind)
    analytic = state.jacobian(seen)
    for k in range(analytic.shape[2]):
        step = np.zeros(analytic.shape[2])
        step[k] = 1e-6
        ahead, behind = (state.moved(sign * step, seen.kind).residuals(seen) for sign in (1, -1))
        assert (behind - ahead) / 2e-6 == pytest.approx(
            analytic[:, :, k], abs=2e-5 * max(np.abs(analytic[:, :, k]).max(), 1)
        )


def test_held_out_error_is_that_of_new_poses_and_a_flat_direction_is_no_failure():
    true, data = simulated(5, 60)
    found = identify(mh80(), data, IdentifyOptions(repeats=1))
    assert found.ranks == {"pose": 30, "position": 27, "distance": 21}
    q = joint_vectors(true, 500, np.random.default_rng(7))
    own, of = (each.tips(q, ("",) * 500) for each in (found.state, State(true.chain(), dict(true.tools))))
    model = np.linalg.norm(of.translation - own.translation, axis=1)
    # mean length of the noise alone is 1.6 σ; the model's own error comes on top, in squares
    expected = np.hypot(0.05 * np.sqrt(8 / np.pi), model.mean())
    assert found.held_out.position_mm.mean() == pytest.approx(expected, rel=0.25)
    assert found.held_out.position_mm.mean() > found.fitted_mm.mean()
    # Distances of 30 points; along one direction every step gains a millionth of σ², a hundred times.
    study = load_script("identify_study")
    case = next(case for case in study.CASES if (case.kind, case.rows) == ("distance", 30))
    predicted, parameters = study.errors(case, 45)
    assert 0.1 < predicted < 3  # mean of 49 squares, correlated
    assert 0.3 < parameters < 2.2  # of 21 squares


def squares(found: Identified, true: Robot, seed: int, kind: str = "position"):
    """Of the parameters' errors over their covariance, by exact poses: their mean; and the σ of what they do there."""
    q = joint_vectors(true, 100, np.random.default_rng(seed))
    exact = observed(measured(true, q, np.random.default_rng(0), 0, 0), kind)
    slope = found.state.jacobian(exact).reshape(-1, len(found.names))
    away = np.linalg.lstsq(slope, found.state.residuals(exact).ravel(), rcond=None)[0]
    return away @ np.linalg.solve(found.covariance, away) / len(away), (slope @ away).std()


@pytest.mark.full
@pytest.mark.parametrize("count", [30, 60])
def test_the_covariance_is_true(count):
    """Of 30 positions σ of the noise and of the arm's dimensions are estimated from little; of 60, three are off by
    2 mm, forty σ: with Huber's weight alone each would pull like the worst honest one, and the mean would be 1.2."""
    draws, errors, rows = 40, [], []
    for seed in range(draws):
        true, data = simulated(1000 + seed, count)
        rng = np.random.default_rng(seed)
        positions, bad = data.positions.copy(), rng.choice(count, 3 if count > 30 else 0, replace=False)
        away = rng.normal(size=(len(bad), 3))
        positions[bad] += 2 * away / np.linalg.norm(away, axis=1)[:, None]
        found = identify(mh80(), replace(data, rotations=None, positions=positions), QUICK)
        assert sorted(row for row, _ in found.outliers()) == sorted(bad)
        errors.append(squares(found, true, seed)[0])
        seen = found.dh_sigma > 0
        rows.append((((dh_values(found.robot) - dh_values(true)) / found.dh_sigma.clip(1e-12)) ** 2)[seen].mean())
        assert seen.sum() == 18
    # Squares of 27 normal numbers have a relative σ of √(2 / 27); three times what is left of it after so many draws.
    # Those of the rows are correlated: √(2 / 9) at the most or so.
    assert np.mean(errors) == pytest.approx(1, abs=3 * np.sqrt(2 / 27 / draws))
    assert np.mean(rows) == pytest.approx(1, abs=3 * np.sqrt(2 / 9 / draws))


def test_an_outlier_is_named_and_does_no_harm():
    _, data = simulated(6, 50)
    positions = data.positions.copy()
    positions[17] += [0, 5, 0]
    clean, spoilt = (identify(mh80(), d, QUICK) for d in (data, replace(data, positions=positions)))
    assert [row for row, _ in spoilt.outliers()] == [17]
    change = [abs(a.a - b.a) for a, b in zip(clean.robot.rows, spoilt.robot.rows, strict=True)]
    assert max(change) < 0.05  # of σ about 0.03 mm; 5 mm in one of 50 rows would make tenths of a mm
    assert "line 19" in identified_report(spoilt).text()
    assert spoilt.weighting.sigma_mm == pytest.approx(clean.weighting.sigma_mm, rel=0.05)


def of_distances(data: Measurements, factor: float = 1.0) -> Measurements:
    """Distances of the positions from the first, times a factor, in place of the positions."""
    away = factor * np.linalg.norm(data.points() - data.points()[0], axis=1)
    return replace(data, positions=None, rotations=None, distances=away, from_row=np.zeros(len(data), int))


REVERSED = [1, 1, -1, 1, 1, 1]


@pytest.mark.parametrize(
    ("spoil", "kind", "words"),
    [
        (lambda d: d[:4], DegenerateError, "4 poses give 24 numbers for 30 parameters"),
        (lambda d: replace(d, q=np.where(np.arange(6) == 2, 0.1, d.q)), DegenerateError, "joint 3 never moved"),
        (lambda d: replace(d, positions=np.tile(d.positions[:1], (40, 1))), DegenerateError, "never moved"),
        (lambda d: replace(d, positions=d.positions * [1, -1, 1], rotations=None), InputError, "mirrored"),
        (lambda d: replace(d, positions=d.positions / 1000, rotations=None), InputError, "metres"),
        *sampled(
            [
                (lambda d: of_distances(d, 1e-3), InputError, "it would fit if .*lengths are metres"),
                (lambda d: replace(d, q=np.radians(d.q)), InputError, "radians in columns of degrees"),
                (lambda d: replace(of_distances(d), q=d.q * REVERSED), InputError, "joint 3 had the opposite"),
            ]
        ),
    ],
)
def test_data_that_cannot_be_right_are_named(spoil, kind, words):
    _, data = simulated(8, 40)
    with pytest.raises(kind, match=words):
        identify(mh80(), spoil(data), QUICK)


def test_rokae_held_out(rokae):
    robot, data = rokae
    assert len(data) == 30
    found = identify(robot, data, IdentifyOptions(repeats=1))
    # 0.115 mm asked; 0.06 would be below the noise of a coordinate times 1.6
    assert 0.06 < found.held_out.position_mm.mean() <= 0.115
    assert found.nominal_mm.mean() > 10 * found.held_out.position_mm.mean()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sigma_mm": 5e-5}, "times the σ that are stated"),
        ({"sigma_mm": 50.0, "sigma_rad": 2e-4}, "residuals of positions are 0.0"),
        ({"sigma_rad": 0.0115}, "residuals of orientations are 0.0"),
        ({"sigma_mm": 0.05, "sigma_rad": 2e-4}, ""),
    ],
)
def test_stated_sigma_that_residuals_contradict_are_told(options, said):
    notes = identify(mh80(), simulated(32, 60)[1], replace(QUICK, **options)).notes
    told = [note for note in notes if "that are stated" in note]
    assert told == [note for note in notes if said and said in note]
    assert bool(told) == bool(said)


def test_a_common_scale_of_all_lengths_and_joint_values_that_were_rounded_are_told():
    """The one is not of the robot; with the others nothing is gained."""
    data = simulated(34, 40)[1]
    grown = replace(data, positions=1.01 * data.points())
    rounded = replace(data, q=np.radians(np.round(np.degrees(data.q))))
    held_out = IdentifyOptions(folds=2, repeats=1)
    given = (data, held_out), (grown, QUICK), (rounded, held_out)
    clean, scale, gain = (" ".join(identify(mh80(), *each).notes) for each in given)
    assert not re.search("all lengths of the robot are|no gain", clean)
    found = re.search(r"all lengths of the robot are (\S+) ± (\S+) times nominal", scale)
    assert abs(float(found[1]) - 1.01) < 3 * float(found[2])
    assert "no gain: rows held out err by" in gain
