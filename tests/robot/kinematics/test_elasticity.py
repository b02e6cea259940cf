"""What links give way by: derivatives, files, D-H rows, and the way back from poses to joint values."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot import forward
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import elasticity_jacobian, flange_poses, links
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import Conditions, Elasticity, Robot, loaded, mh80
from stcal.robot.simulated import joint_vectors
from tests.outcome import refuses
from tests.shared import written

TOOL = Rigid.exp([0.1, 0.2, 0.3, 50, 60, 70])
ALONE = ("",) * 20


def bent(scale: float = 1.0) -> Robot:
    """An arm that stands askew, with half a millimetre of deflection at ``scale`` 1."""
    rng = np.random.default_rng(0)
    compliance, moment, periodic = rng.normal(size=(6, 2)), rng.normal(size=(6, 3)), rng.normal(size=(6, 4))
    elasticity = Elasticity(1e-6 * scale * compliance, 100 * moment, 1e-4 * scale * periodic, np.array([0.1, 0.2, -2]))
    return replace(mh80(), world_from_base=Rigid.exp([0.3, -0.5, 0.2, 100, 200, 300]), elasticity=elasticity)


def vectors(robot: Robot, count: int = 20) -> np.ndarray:
    return joint_vectors(robot, count, np.random.default_rng(1))


COUPLING = np.eye(6)
COUPLING[2, 1] = 1.0


def loose() -> Robot:
    """A coupled arm of which joints are 0.1 mrad farther where they came from below. Other deflections are a
    ten-thousandth of usual ones: differences grow with them, as the bent arm's torques are those of the rigid one."""
    elasticity = replace(bent(1e-4).elasticity, hysteresis=1e-4 * np.array([1, -0.5, 2, 0.3, 0.7, 1]))
    return replace(bent(), coupling=COUPLING, elasticity=elasticity)


def test_derivatives_are_those_of_small_changes():
    robot, q, rng = loose(), vectors(loose()), np.random.default_rng(6)
    chain, conditions = robot.chain(), Conditions(rng.uniform(0, 50, 20), rng.choice([-1.0, 1.0], (20, 6)))
    values = chain.elasticity.values(hysteresis=True)
    assert (chain.elasticity.with_values(values).hysteresis == robot.elasticity.hysteresis).all()
    values[54:] *= 1e-2

    def tips(moved) -> Poses:
        bending = replace(chain, elasticity=chain.elasticity.with_values(moved))
        return flange_poses(bending, q, conditions) @ TOOL

    found = elasticity_jacobian(chain, q, tips(values), ALONE, conditions, hysteresis=True)
    assert found.shape == (20, 6, 60)
    assert (elasticity_jacobian(chain, q, tips(values), ALONE, conditions) == found[:, :, :54]).all()
    for k, value in enumerate(values):
        step = np.zeros(len(values))
        step[k] = max(1e-3 * abs(value), 1e-10) if k < 54 else 1e-6
        expected = tips(values + step).difference(tips(values - step)) / (2 * step[k])
        size = np.abs(expected).max()
        assert np.abs(found[:, :, k] - expected).max() < 1e-4 * size + 1e-4


def test_rows_of_an_adjusted_chain_keep_its_deflections():
    """Axes off by 1 mm and 1 mrad: frames turn and slide by as little, deflections of 0.2 mm change by under 1 µm."""
    robot, rng = bent(), np.random.default_rng(2)
    chain = robot.chain()
    step = np.array([rng.normal(0, 1e-3 if c < 3 else 1.0) for _, c in chain.parameters()])
    moved = chain.moved(step)
    rows = robot_from_chain(moved, {"": TOOL}, robot)
    q = vectors(robot)
    reached = (flange_poses(moved, q) @ TOOL).difference(flange_poses(rows.chain(), q) @ rows.tools[""])
    rigid = flange_poses(moved, q).difference(flange_poses(replace(moved, elasticity=None), q))
    assert np.abs(rigid[:, 3:]).max() > 0.2
    assert np.abs(reached[:, 3:]).max() < 1e-3
    assert np.abs(reached[:, :3]).max() < 1e-12


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gravity = [0, 0, 0]", "gravity is [0, 0, 0]"),
        ("axis_rad_per_Nm = [1e-6]", "elasticity: axis_rad_per_Nm has 1 entries, 6 needed"),
        ("stiffness = 3", "stiffness"),
        ("payload_kg = -1", "elasticity: payload_kg is -1; 0 … 10000 needed"),
        ("payload_kg = nan", "payload_kg"),
        ("hysteresis_rad = [1e-5]", "elasticity: hysteresis_rad has 1 entries, 6 needed"),
        ("payload_centre_mm = [1, 2]", "payload_centre_mm"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path, text, message):
    path = written(tmp_path / "robot.toml", f"{robot_toml(mh80())}\n[elasticity]\n{text}\n")
    with pytest.raises(InputError, match=re.escape(message)):
        load_robot(path)


def test_weights_turn_the_shoulder_by_their_torque():
    """Joint 2 of the example is level. 1000 N m about it at 1e-6 rad/(N m) turn it by 1 mrad; 50 kg at the flange by
    50 · 9.80665 N times the flange's distance before it."""
    compliance, moment = np.zeros((6, 2)), np.zeros((6, 3))
    compliance[1, 0] = 1e-6
    q, rigid = np.zeros((1, 6)), mh80()
    place = forward(rigid, q).translation[0]
    reach = place - [rigid.rows[0].a, 0.0, rigid.rows[0].d]
    level = Elasticity(compliance, moment, np.zeros((6, 4)), np.array([0.0, 0.0, -1.0]))
    robot = replace(rigid, elasticity=level)
    moment = moment.copy()
    moment[1] = 1000 * links(rigid.chain(), q)[0][1, 0].T @ [1.0, 0.0, 0.0]
    heavy = replace(rigid, elasticity=replace(level, moment=moment))
    turn = 1e-6 * 50 * 9.80665 * reach[0] * 1e-3
    for moved, angle in ((forward(heavy, q), 1e-3), (forward(robot, q, payload_kg=50), turn)):
        assert moved.translation[0] - place == pytest.approx([angle * reach[2], 0.0, -angle * reach[0]], abs=2e-3)
    assert np.abs(forward(rigid, q, payload_kg=50).difference(forward(rigid, q))).max() == 0
    assert np.abs(forward(robot.loaded(50), q).difference(forward(robot, q, payload_kg=50))).max() == 0
    assert np.abs(forward(robot, q).translation[0] - place).max() == 0


def test_a_file_reads_back_the_same_and_rows_made_of_a_chain_know_the_payload(tmp_path):
    hysteresis = 1e-4 * np.array([1, -0.5, 2, 0.3, 0.7, 1])
    own = replace(bent().elasticity, payload_kg=12.5, payload_centre=np.ones(3), hysteresis=hysteresis)
    robot = replace(bent(), elasticity=own)
    again, q = load_robot(written(tmp_path / "robot.toml", robot_toml(robot))), vectors(robot)
    assert again.elasticity.payload_kg == 12.5
    assert again.elasticity.hysteresis == pytest.approx(hysteresis, rel=1e-15)
    assert np.abs(forward(again, q).difference(forward(robot, q))).max() < 1e-9
    step = np.random.default_rng(3).normal(0, 1e-3, len(robot.chain().parameters()))
    moved = robot.chain().moved(step)
    found = robot_from_chain(moved, {"": TOOL}, robot)
    assert found.elasticity.payload_centre == pytest.approx(np.ones(3), abs=1.0)  # rows put the flange elsewhere
    heavy = loaded(60.0, len(q))
    sag = flange_poses(moved, q, heavy).translation - flange_poses(moved, q).translation
    again = flange_poses(found.chain(), q, heavy).translation - flange_poses(found.chain(), q).translation
    assert np.abs(again - sag).max() < 1e-9


def test_hysteresis_is_an_error_of_the_controllers_values():
    robot, rng = loose(), np.random.default_rng(5)
    q, came = vectors(robot), rng.choice([-1.0, 0.0, 1.0], (20, 6))
    chain = robot.chain()
    moved = flange_poses(chain, q, Conditions(approach=came))
    shifted = flange_poses(chain, q + robot.elasticity.hysteresis * came)
    assert np.abs(moved.difference(shifted)).max() < 1e-6
    assert np.abs(moved.difference(flange_poses(chain, q))[:, 3:]).max() > 0.1


def test_masses_and_directions_that_cannot_be_are_refused():
    refuses("E-APPROACH-VALUE … 2", Conditions, approach=np.array([[1.0, 2.0]]))
    robot = bent()
    for mass in (-1.0, np.nan, 2e4, [1.0, 2.0]):
        with pytest.raises(InputError, match="payload"):
            forward(robot, vectors(robot), payload_kg=mass)
