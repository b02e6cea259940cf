"""Elastic arms: what gravity and gears do is found where it is, and left alone where it is not."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.arrays import rms
from stcal.geometry.rigid import Rigid
from stcal.robot import forward, read_measurements
from stcal.robot.identification.identify import identify
from stcal.robot.identification.prior import DOWN, HEAVIER, MOMENT, usual
from stcal.robot.identification.result import Identified, IdentifiedFile, IdentifyOptions, require_identified_written
from stcal.robot.identified_report import identified_report
from stcal.robot.kinematics.forward import joint_frames
from stcal.robot.kinematics.robot_file import robot_toml
from stcal.robot.kinematics.robot_model import Chain, Conditions, Elasticity, Robot, mh80
from stcal.robot.robot_report import evaluation_report
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.robot.use.evaluation import evaluate
from tests.outcome import refuses
from tests.shared import written
from tests.support.arms import elastic


def drawn(rows: int, seed: int, share: float = 1.0):
    """An arm as made, and positions of it; ``share`` : of usual deflections."""
    rng = np.random.default_rng(seed)
    tool, world = Rigid.exp([0.1, 0.2, -0.3, 100, 50, 150]), Rigid.exp([0.1, 0.2, 0.3, 900, 800, 700])
    true = placed(made(mh80(), rng), world, {"": tool})
    if share:
        true = elastic(true, rng, share)
    return true, replace(measured(true, joint_vectors(true, rows, rng), rng), rotations=None)


def elsewhere(found: Identified, true: Robot) -> float:
    """RMS error at new joint vectors, mm."""
    q = joint_vectors(true, 200, np.random.default_rng(99))
    seen, really = (each.world_from_base @ forward(each, q) for each in (found.robot, true))
    return rms(np.linalg.norm(seen.translation - really.translation, axis=1))


RIGID, ELASTIC = IdentifyOptions(folds=0), IdentifyOptions(model="elastic", folds=0)
AUTO = IdentifyOptions(model="auto", folds=2, repeats=1)


@pytest.fixture(scope="module")
def bending():
    """An elastic arm, its positions, and what is identified of it."""
    true, data = drawn(60, 0)
    return true, data, identify(mh80(), data, AUTO)


@pytest.mark.slow
def test_an_elastic_arm_is_told_and_predicted(bending):
    """Rigid, it is off by 0.15 mm and more at new joint values; its σ of 0.05 mm per coordinate comes out."""
    true, data, found = bending
    rigid = identify(mh80(), data, RIGID)
    assert found.model == "elastic"
    assert found.gain.beyond_chance
    assert found.gain.elastic_mm < found.gain.rigid_mm
    assert elsewhere(rigid, true) > 0.15 > 0.08 > elsewhere(found, true)
    # χ² of about 100 numbers left over
    assert found.weighting.sigma_mm == pytest.approx(0.05, rel=0.25)
    assert found.names == rigid.names
    assert found.covariance.shape == rigid.covariance.shape
    assert not found.robot.elasticity.hysteresis.any()  # rows do not say from where joints came
    assert found.deviations["hysteresis_rad"] is None


@pytest.mark.slow
def test_of_a_rigid_arm_the_rigid_model_is_taken():
    rigid = identify(mh80(), drawn(60, 1, 0.0)[1], AUTO)
    assert rigid.model == "rigid"
    assert rigid.robot.elasticity is None
    assert not rigid.gain.beyond_chance


@pytest.mark.full
def test_of_a_rigid_arm_the_elastic_model_finds_hardly_anything():
    """σ of what is not there become small, and the errors are as those of the rigid model."""
    true, data = drawn(60, 1, 0.0)
    rigid, found = (identify(mh80(), data, options) for options in (RIGID, ELASTIC))
    assert found.deviations["periodic_rad"] < 5e-5
    assert elsewhere(found, true) < 1.5 * elsewhere(rigid, true)


@pytest.mark.full
def test_sigma_of_strong_elasticity_settle():
    """Links give way by three and ten times the usual: σ of compliances went in circles, by factors of up to five."""
    for share, seed in ((3.0, 0), (3.0, 1), (10.0, 2)):
        found = identify(mh80(), drawn(60, seed, share)[1], ELASTIC)
        assert not [note for note in found.notes if "still change" in note]
        assert found.deviations["axis_rad"] == pytest.approx(share * 3e-4, rel=0.8)


def test_the_elasticity_of_the_file_stays_where_a_rigid_arm_is_asked_for():
    true, data = drawn(60, 0)
    known = replace(mh80(), elasticity=true.elasticity)
    found = identify(known, data, RIGID)
    assert found.elasticity_sigma is None
    # turned into the frames of the rows found, by milliradians
    moment = true.elasticity.moment
    assert np.abs(found.robot.elasticity.moment - moment).max() < 0.01 * np.abs(moment).max()
    assert elsewhere(found, true) < 0.08


@pytest.mark.slow
def test_a_written_file_that_predicts_otherwise_is_an_error(tmp_path, bending):
    found = bending[2]
    path = written(tmp_path / "robot.toml", robot_toml(found.robot))
    require_identified_written(path, found)
    rows = (replace(found.robot.rows[0], d=found.robot.rows[0].d + 0.001), *found.robot.rows[1:])
    other = written(path, robot_toml(replace(found.robot, rows=rows)))
    refuses("E-WRITTEN-DIFFERS … robot.toml", require_identified_written, other, found)


@pytest.mark.slow
def test_sigma_elsewhere_hold_what_a_rigid_model_leaves():
    """By the covariance alone 0.1 mm; the arm errs by twice that."""
    true, data = drawn(100, 0)
    rigid = identify(mh80(), data, RIGID)
    assert any(note.startswith("σ hold for these rows, and for places like theirs") for note in rigid.notes)
    assert "--model auto" in rigid.notes[-1]
    alone = identify(mh80(), drawn(100, 0, 0.0)[1], RIGID)
    assert not any(note.startswith("σ hold for these rows") for note in alone.notes)
    assert rms(rigid.predicted.ranges_mm) > 1.5 * rms(alone.predicted.ranges_mm)
    # what goes with the three strongest causes, of more
    assert elsewhere(rigid, true) < 1.5 * rms(rigid.predicted.ranges_mm)


CENTRE = np.array([0.0, 30.0, 120.0])


def load_place(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Where the load is in space, (m, 3); each chain states it in its own last frame."""
    rotation, origin = joint_frames(chain, q)
    return origin[-1] + rotation[-1] @ chain.elasticity.payload_centre


def carrying(rows: int, seed: int, payloads: tuple[float, ...], heavier: float = 1.0):
    """A heavier elastic arm, its drawing with the place of the load, and positions, one payload after the other."""
    rng = np.random.default_rng(seed)
    true = elastic(placed(made(mh80(), rng), Rigid(), {"": Rigid.exp([0.1, 0.2, 0, 50, 60, 70])}), rng, 1.0, heavier)
    true = replace(true, elasticity=replace(true.elasticity, payload_centre=CENTRE))
    none = Elasticity(np.zeros((6, 2)), np.zeros((6, 3)), np.zeros((6, 4)), DOWN, payload_centre=CENTRE)
    mass = np.resize(payloads, rows)
    data = measured(true, joint_vectors(true, rows, rng), rng, conditions=Conditions(mass))
    return true, replace(mh80(), elasticity=none), replace(data, rotations=None)


def sag_error(found: Robot, true: Robot, mass: float) -> float:
    """RMS of what a load moves the tool by, as identified and as it is, mm, over that of what it does."""
    q = joint_vectors(true, 100, np.random.default_rng(98))
    by, does = (forward(each, q, payload_kg=mass).translation - forward(each, q).translation for each in (found, true))
    by = by @ found.world_from_base.rotation.T
    return float(np.sqrt(((by - does) ** 2).sum() / (does**2).sum()))


@pytest.mark.slow
def test_rows_with_two_payloads_tell_how_compliant_the_arm_is():
    """Of an arm 1.6 times as heavy as usual what 100 kg do (0.4 mm) is known to a sixth from positions of 0.05 mm;
    taken as usual it misses 0.4 of it and more."""
    true, nominal, data = carrying(80, 5, (0.0, 60.0), 1.6)
    found = identify(nominal, data, ELASTIC)
    assert 0.01 < sag_error(found.robot, true, 100.0) < 0.25
    assert found.weighting.sigma_mm == pytest.approx(0.05, rel=0.25)
    own, sigma = (each.compliance[:3, 0] for each in (found.robot.elasticity, found.elasticity_sigma))
    assert np.abs((own - true.elasticity.compliance[:3, 0]) / sigma).max() < 3.5
    q = data.q[:5]
    places = [load_place(each, q) for each in (found.state.chain, found.robot.chain())]
    assert np.abs(places[1] - places[0]).max() < 1e-8
    assert found.robot.elasticity.payload_kg == 0.0


@pytest.mark.slow
def test_the_payload_of_all_rows_is_that_of_the_identified_file_and_wrong_rows_are_named():
    true, nominal, data = carrying(60, 6, (40.0,))
    positions = np.array(data.points())
    positions[[5, 20, 40]] += [[3.0, 0, 0], [0, -5.0, 0], [0, 0, 10.0]]
    found = identify(nominal, replace(data, positions=positions), ELASTIC)
    assert [row for row, _ in found.outliers()] == [5, 20, 40]
    assert found.robot.elasticity.payload_kg == 40.0
    q = joint_vectors(true, 50, np.random.default_rng(97))
    seen = found.robot.world_from_base @ forward(found.robot, q)
    assert np.linalg.norm(seen.translation - forward(true, q, payload_kg=40.0).translation, axis=1).mean() < 0.1


def test_a_payload_of_a_rigid_arm_is_said_to_do_nothing():
    data = carrying(60, 6, (40.0,))[2]
    found = identify(mh80(), data, RIGID)
    assert "the arm as identified is rigid, payload_kg moves nothing" in found.notes[-1]
    text = evaluation_report(evaluate({"drawn": mh80()}, data)).text()
    assert "\nrobot drawn is rigid, payload_kg moves nothing" in text


def test_usual_moments_may_all_be_wrong_by_one_factor_where_loads_are_known():
    """(1 + σ² m mᵀ)⁻¹ is what the rows of the whitened moments make; without loads nothing is changed."""
    chain = mh80().chain()
    free, known = usual(chain), usual(chain, carried=True)
    assert (free.apart == np.eye(len(free.group))).all()
    own = free.group == MOMENT
    shares = (free.expected * free.scale)[own]
    covariance = np.eye(own.sum()) + HEAVIER**2 * np.outer(shares, shares)
    by = known.apart[np.ix_(own, own)]
    assert np.abs(by.T @ by @ covariance - np.eye(own.sum())).max() < 1e-9
    assert np.abs(known.apart - free.apart)[~own].max() == 0


def test_files_say_what_was_carried_and_from_where_joints_came(tmp_path):
    path, head = tmp_path / "data.csv", [f"q{i}_deg" for i in range(1, 7)] + ["x_mm", "y_mm", "z_mm"]
    text = ",".join([*head, "station", "payload_kg", "approach2"]) + "\n1,2,3,4,5,6,1,2,3,A,0,-1\n2,2,3,4,5,6,1,2,4,B,"
    read = read_measurements(written(path, f"{text}60,1\n"), mh80())
    assert read.conditions.payload_kg.tolist() == [0, 60]
    assert read[1:].conditions.payload_kg.tolist() == [60]
    assert (read.stations, read[1:].stations) == (("A", "B"), ("B",))
    assert read.conditions.approach.T.tolist() == [[0, 0], [-1, 1], *[[0, 0]] * 4]
    assert read.notes == ()
    for cells, message in (
        ("-1,1", "E-PAYLOAD-VALUE … line 3 … payload_kg … -1 … 10000"),
        ("nan,1", "E-TABLE-NUMBER … payload_kg … 'nan'"),
        ("60,2", "E-APPROACH-VALUE … 3 … approach2 … 2 … 2"),
        ("60,nan", "E-TABLE-NUMBER … approach2 … 'nan'"),
    ):
        refuses(message, read_measurements, written(path, f"{text}{cells}\n"), mh80())


def approached(rows: int, seed: int, size_rad: float):
    """A stiff arm, its hysteresis, and positions that joints came to from either side."""
    rng = np.random.default_rng(seed)
    true = placed(made(mh80(), rng), Rigid(), {"": Rigid.exp([0.1, 0.2, 0, 50, 60, 70])})
    came, half = rng.choice([-1.0, 1.0], (rows, 6)), size_rad * np.array([1, 1, -1, 1, 0.5, 1])
    none = Elasticity(np.zeros((6, 2)), np.zeros((6, 3)), np.zeros((6, 4)), DOWN, hysteresis=half)
    true = replace(true, elasticity=none)
    data = measured(true, joint_vectors(true, rows, rng), rng, conditions=Conditions(approach=came))
    return half, replace(data, rotations=None)


@pytest.mark.slow
def test_hysteresis_is_found_where_rows_say_from_where_joints_came():
    """0.15 mrad (half of it) at up to 2 m is 0.3 mm: joints 1 to 3 to a tenth of it, by 60 positions of 0.05 mm."""
    half, data = approached(60, 8, 1.5e-4)
    found = identify(mh80(), data, ELASTIC)
    own, sigma = (each.hysteresis for each in (found.robot.elasticity, found.elasticity_sigma))
    assert own[:3] == pytest.approx(half[:3], abs=3e-5)
    assert np.abs((own - half) / sigma).max() < 3.5
    assert sigma[:3].max() < 2e-5
    assert found.weighting.sigma_mm == pytest.approx(0.05, rel=0.3)
    assert "hysteresis" in identified_report(found).text()
    assert IdentifiedFile.model_validate(found).elasticity_sigma["hysteresis"] == sigma.tolist()
    rigid = identify(mh80(), data, RIGID)
    assert "the direction from which joint" in rigid.left[0].what
