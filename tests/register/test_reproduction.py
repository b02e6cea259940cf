"""The simulated experiment of Liu et al. (2017), what the table of docs/accuracy says for one robot; and a real robot
with a total station: the acceptance figures."""

import pytest

from tests.scripts import load_script


@pytest.mark.slow
def test_ours_beats_theirs_which_beats_their_least_squares_and_only_the_kinematics_hold_outside():
    """Mean errors in the cube of the fit and in the large one, mm, one point in ten wrong. The paper says three times
    their least squares; one robot of ours: at least 1.5 and at most 6."""
    script = load_script("reproduce_registration")
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
def hilti(shared_data):
    """The script, stations by name, and the robot of the URDF."""
    script, root = load_script("register_shared"), shared_data("hilti_stationing")
    return script, script.stations(root), script.robot_of(root / "data" / "trailblazer.urdf")


@pytest.mark.slow  # a set that lies beside the repository
def test_rigid_registration_holds_to_a_centimetre_affine_to_metres_and_kinematics_serve_another_station(hilti):
    """The figures of SOURCE.txt: 6.9–9.9 mm, and 3.2–5.4 m of the affine fit to coplanar places. Identified where the
    floor is flat, used where it is not: the error falls to below 70 %."""
    script, stations, robot = hilti
    rigid = {name: script.errors_by_part(s, robot).mean() for name, s in stations.items()}
    affine = {name: script.errors_by_part(s, robot, affine=True).mean() for name, s in stations.items()}
    assert len(rigid) == 7
    assert min(rigid.values()) > 6.0
    assert max(rigid.values()) < 9.95
    assert min(affine.values()) > 2000
    real = script.identified(robot, script.everything(stations["flat"]), slice(None, None, 2))
    nominal, better = (script.errors_by_part(stations["pallet"], each).mean() for each in (robot, real))
    assert better < 0.7 * nominal
