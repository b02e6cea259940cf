"""The simulated experiment of Liu et al. (2017), what the table of docs/accuracy says for one robot; and a real robot
with a total station: the acceptance figures."""

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.forward import forward
from tests.scripts import load_script


@pytest.fixture(scope="module")
def script():
    return load_script("reproduce_registration")


def test_the_simulation_is_what_it_says(script):
    rng = np.random.default_rng(0)
    cell = script.Cell.of(rng)
    true = cell.points(100, script.SMALL, 0.0, rng)
    assert np.abs(true.a - script.MIDDLE).max() <= script.SMALL / 2
    np.testing.assert_allclose(forward(cell.drawn, true.q).translation, true.a, atol=1e-6)
    np.testing.assert_allclose(cell.b_from_base @ forward(cell.real, true.q).translation, true.b, atol=1e-9)
    # drawn and made differ by tenths of a millimetre in every axis: a millimetre or two at the tool
    assert 0.1 < np.linalg.norm(true.b - cell.b_from_base @ true.a, axis=1).mean() < 5
    measured = cell.measured(100, script.SMALL, (0.3, 0.0), np.random.default_rng(1))
    again = cell.points(100, script.SMALL, 0.0, np.random.default_rng(1))
    off = np.linalg.norm(measured.b - again.b, axis=1)
    assert (off > 0.9).sum() == 30
    assert off.max() < script.OFF_MM[1] + 0.3


@pytest.mark.slow
def test_ours_beats_theirs_which_beats_their_least_squares_and_only_the_kinematics_hold_outside(script):
    """Mean errors in the cube of the fit and in the large one, mm, one point in ten wrong. The paper says three times
    their least squares; one robot of ours: at least 1.5 and at most 6."""
    errors = {name: [float(e.mean()) for e in errors] for name, errors in script.trial(1, script.SHOWN).items()}
    near, far = ({name: both[i] for name, both in errors.items()} for i in (0, 1))
    assert 1.5 < near[script.USUAL] / near[script.PAPER] < 6
    assert near[script.AFFINE] < near[script.PAPER] / 1.5
    assert near[script.TOGETHER] < near[script.PAPER] / 1.5
    assert near[script.FIELD] < near[script.RIGID]
    for name in (script.USUAL, script.PAPER, script.RIGID, script.AFFINE):
        assert far[name] > near[name]
    assert far[script.RIGID] > 1.3 * near[script.RIGID]
    assert far[script.TOGETHER] == min(far.values())


@pytest.fixture(scope="module")
def stationing():
    return load_script("register_shared")


@pytest.fixture(scope="module")
def data(stationing, shared_data):
    """Stations by name, and the robot of the URDF."""
    root = shared_data("hilti_stationing")
    return root, stationing.stations(root), stationing.robot_of(root / "data" / "trailblazer.urdf")


@pytest.mark.slow  # a set that lies beside the repository
def test_rows_make_the_poses_of_the_urdf(stationing, data):
    """The URDF's transforms multiplied one by one, with both stages of the column as it says."""
    root, stations, robot = data
    q = stationing.everything(stations["flat"]).q[::40]
    for values, found in zip(q, (robot.world_from_base @ forward(robot, q).translation), strict=True):
        pose, rest = Rigid(), list(values[1:])
        for name, kind, origin in stationing.urdf_joints(root / "data" / "trailblazer.urdf"):
            pose = pose @ origin
            if kind == "prismatic":
                offset = {"column_middle_joint": -706.0, "column_top_joint": -736.0}[name]
                pose = pose @ Rigid(np.eye(3), [0, 0, values[0] / 2 + offset])
            elif kind == "revolute":
                pose = pose @ Rigid.exp([0, 0, rest.pop(0), 0, 0, 0])
        np.testing.assert_allclose(pose.translation, found, atol=1e-8)


@pytest.mark.slow  # a set that lies beside the repository
def test_rigid_registration_holds_to_a_centimetre_and_affine_to_metres(stationing, data):
    """The figures of SOURCE.txt: 6.9–9.9 mm, and 3.2–5.4 m of the affine fit to coplanar places."""
    _, stations, robot = data
    rigid = {name: stationing.errors_by_part(s, robot).mean() for name, s in stations.items()}
    affine = {name: stationing.errors_by_part(s, robot, affine=True).mean() for name, s in stations.items()}
    assert len(rigid) == 7
    assert min(rigid.values()) > 6.0
    assert max(rigid.values()) < 9.95
    assert min(affine.values()) > 2000


@pytest.mark.slow  # a set that lies beside the repository
def test_kinematics_of_one_station_serve_another(stationing, data):
    """Identified where the floor is flat, used where it is not: the error falls to below 70 %."""
    _, stations, robot = data
    real = stationing.identified(robot, stationing.everything(stations["flat"]))
    for name in ("outdoor", "pallet", "diagonal_wood"):
        nominal, better = (stationing.errors_by_part(stations[name], each).mean() for each in (robot, real))
        assert better < 0.7 * nominal
