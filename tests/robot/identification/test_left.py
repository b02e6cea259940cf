"""What a model leaves: said of clean sets one time in a hundred, and named where there is something."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.robot.identification.adjustment import Weighting
from stcal.robot.identification.report import identified_file, identified_report
from stcal.robot.identification.residuals import State, jacobian, observed
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.identification.solve import identify
from stcal.robot.identification.unexplained import left
from stcal.robot.kinematics.forward import forward, joint_frames
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot, mh80
from stcal.robot.simulated import joint_vectors, measured
from tests.robot.identification.test_solve import simulated

NOISE = Weighting(0.05, 2e-4)
QUICK = IdentifyOptions(folds=0)


def left_of(true: Robot, data: Measurements, kind):
    """Of the true robot, with what any fit of its parameters takes up taken out."""
    state, seen = State(true.chain(), dict(true.tools)), observed(data, kind)
    return left(state, true.world_from_base, seen, NOISE, jacobian(state, seen))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "sets"), [("position", 200), ("pose", 100), ("distance", 60)])
def test_clean_sets_say_nothing(kind, sets):
    """At 1 %; of 200 sets five or more once in twenty runs, and 5 % are asked for."""
    said = [found for seed in range(sets) if (found := left_of(*simulated(seed, 40), kind))]
    assert len(said) <= 0.025 * sets


@pytest.mark.full
@pytest.mark.parametrize("kind", ["position", "pose"])
def test_clean_sets_that_were_identified_say_nothing(kind):
    options = replace(QUICK, observe=kind)
    said = [found for seed in range(60) if (found := identify(mh80(), simulated(seed, 40)[1], options).left)]
    assert len(said) <= 3


def bent(seed: int, count: int, joint: int, of) -> tuple[Robot, Measurements]:
    """A robot whose joint (from 1) turns by ``of(q, true)`` (count,) more than its value; 0.05 mm of noise."""
    true, _ = simulated(seed, 2)
    rng = np.random.default_rng(seed)
    q = joint_vectors(true, count, rng)
    really = q.copy()
    really[:, joint - 1] += of(q, true)
    return true, replace(measured(true, really, rng), q=q)


def gravity(q: np.ndarray, true: Robot) -> np.ndarray:
    """0.15 mrad at a torque of a metre about joint 2."""
    at_base = replace(true, world_from_base=type(true.world_from_base)()).chain()
    turned, origin = joint_frames(at_base, q)
    arm = forward(true, q).translation - origin[1]
    return 1.5e-7 * np.einsum("mi,mi->m", turned[1][:, :, 2], np.cross(arm, [0, 0, 1.0]))


@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize(
    ("joint", "of", "what"),
    [
        (3, lambda q, _: 2e-4 * np.cos(q[:, 2] + 1), "the angle of joint 3, once a turn, along its motion"),
        (1, lambda q, _: 2e-4 * np.sin(2 * q[:, 0]), "the angle of joint 1, twice a turn, along its motion"),
        (5, lambda q, _: 3e-4 * np.sin(2 * q[:, 4]), "the angle of joint 5, twice a turn, along its motion"),
        (2, gravity, "gravity's torque about joint 2"),
    ],
)
def test_a_cause_is_named_once(joint, of, what, kind):
    true, data = bent(5, 120, joint, of)
    [finding] = left_of(true, data, kind)
    assert finding.what == what
    assert finding.joint == joint
    assert finding.p < 1e-3
    assert f"residuals go with {what}: " in finding.sentence()


def test_the_effect_is_what_was_put_in():
    """Twice a turn of joint 1: 0.2 mrad at the tool's distance from the axis, of which parameters take up a fifth."""
    true, data = bent(6, 200, 1, lambda q, _: 2e-4 * np.sin(2 * q[:, 0]))
    [finding] = left_of(true, data, "position")
    reach = np.linalg.norm(forward(true, data.q).translation[:, :2], axis=1)
    assert finding.turns == 2
    put_in = 2e-4 * np.sqrt((reach**2).mean())
    assert 0.7 * put_in < finding.effect_mm < put_in
    assert 0.3 < finding.share < 0.95
    assert finding.sentence().endswith("p < 0.001")


def test_two_causes_are_two_findings():
    rng = np.random.default_rng(7)
    true = simulated(7, 2)[0]
    q = joint_vectors(true, 200, rng)
    really = q.copy()
    really[:, 0] += 3e-4 * np.sin(2 * q[:, 0])
    really[:, 2] += 3e-4 * np.cos(q[:, 2])
    found = left_of(true, replace(measured(true, really, rng), q=q), "position")
    assert {finding.joint for finding in found} == {1, 3}
    assert found[0].share > found[1].share


def test_without_noise_rounding_is_not_told():
    true, data = simulated(8, 40, 0, 0)
    assert left_of(true, data, "position") == ()


def test_of_too_few_rows_nothing_is_told():
    true, data = simulated(9, 12)
    assert left_of(true, data, "position") is None


@pytest.mark.slow
def test_identify_says_it_in_notes_file_and_page():
    true, data = bent(5, 80, 3, lambda q, _: 3e-4 * np.cos(q[:, 2] + 1))
    nominal = replace(mh80(), tools=true.tools)
    found = identify(nominal, data, QUICK)
    sentence = found.left[0].sentence()
    assert "the angle of joint 3, once a turn" in sentence
    assert sentence in found.notes
    assert f"note: {sentence}" in identified_report(found, nominal).text()
    assert sentence.split(":")[0] in identified_report(found, nominal).page().split('id="left"')[1]
    assert identified_file(found, nominal).content()["left"][0]["joint"] == 3
    clean = identify(mh80(), simulated(3, 40)[1], QUICK)
    assert clean.left == ()
    assert not any("residuals go with" in note for note in clean.notes)
    assert "Nothing is seen that the residuals go with" in identified_report(clean, mh80()).page()


@pytest.mark.full
def test_sigma_of_base_and_tool_is_that_of_their_errors():
    draws, squares = 40, []
    for seed in range(draws):
        data = simulated(7000 + seed, 40)[1]
        found = identify(mh80(), data, QUICK)
        # The true base and tool in the form of the file: the first row's θ and d, and the flange, are the nominal ones.
        again = identify(mh80(), simulated(7000 + seed, 40, 0, 0)[1], QUICK)
        for one, truth in zip(found.placed, again.placed, strict=True):
            off = one.pose.translation - truth.pose.translation
            turned = (one.pose @ truth.pose.inverse()).log()[:3]
            squares.append((np.append(turned, off) / one.sigma) ** 2)
    assert np.mean(squares) == pytest.approx(1, abs=0.25)  # 480 numbers, of which those of one arm go together


def test_what_is_not_seen_of_base_and_tool_has_no_sigma():
    data = simulated(11, 45)[1]
    position = identify(mh80(), data, replace(QUICK, observe="position"))
    base, tool = position.placed
    assert np.isfinite(base.sigma).all()
    assert np.isnan(tool.sigma[:3]).all()
    assert (tool.sigma[3:] > 0).all()
    lengths = np.linalg.norm(data.positions - data.positions[0], axis=1)
    distances = Measurements("d", data.lines, data.q, data.targets, distances=lengths, from_row=np.zeros(45, int))
    base, tool = identify(mh80(), distances, QUICK).placed
    assert base.sigma_or_none() is None
    assert (tool.sigma[3:] > 0).all()
