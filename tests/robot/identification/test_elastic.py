"""Elastic arms: what gravity and gears do is found where it is, and left alone where it is not. Two arms on a trunk:
one adjustment of all joints, by markers on several branches."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.arrays import rms
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.prior import DOWN, HEAVIER, MOMENT, usual
from stcal.robot.identification.result import Identified, IdentifiedFile, IdentifyOptions, require_identified_written
from stcal.robot.identified_report import identified_report, joints_figure
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import forward, joint_frames
from stcal.robot.kinematics.forward import jacobian as by_joints
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.measurements import read_measurements
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import Chain, Conditions, Elasticity, Robot, mh80
from stcal.robot.robot_report import evaluation_report
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.robot.use.evaluation import evaluate
from tests.outcome import refuses
from tests.shared import written
from tests.support.arms import MARKERS, RIGHT, elastic, two_arms


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
def test_an_elastic_arm_is_told_and_predicted_also_by_its_file(bending, tmp_path):
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
    path = written(tmp_path / "robot.toml", robot_toml(found.robot))
    require_identified_written(path, found)
    rows = (replace(found.robot.rows[0], d=found.robot.rows[0].d + 0.001), *found.robot.rows[1:])
    other = written(path, robot_toml(replace(found.robot, rows=rows)))
    refuses("E-WRITTEN-DIFFERS … robot.toml", require_identified_written, other, found)


@pytest.mark.slow
def test_of_a_rigid_arm_the_rigid_model_is_taken_and_sigma_elsewhere_hold_what_it_leaves():
    """By the covariance alone 0.1 mm; the arm errs by twice that."""
    rigid = identify(mh80(), drawn(60, 1, 0.0)[1], AUTO)
    assert rigid.model == "rigid"
    assert rigid.robot.elasticity is None
    assert not rigid.gain.beyond_chance
    true, data = drawn(100, 0)
    rigid = identify(mh80(), data, RIGID)
    assert any(note.startswith("σ hold for these rows, and for places like theirs") for note in rigid.notes)
    assert "--model auto" in rigid.notes[-1]
    alone = identify(mh80(), drawn(100, 0, 0.0)[1], RIGID)
    assert not any(note.startswith("σ hold for these rows") for note in alone.notes)
    assert rms(rigid.predicted.ranges_mm) > 1.5 * rms(alone.predicted.ranges_mm)
    # what goes with the three strongest causes, of more
    assert elsewhere(rigid, true) < 1.5 * rms(rigid.predicted.ranges_mm)


@pytest.mark.full
def test_of_a_rigid_arm_the_elastic_model_finds_hardly_anything_and_sigma_of_a_strong_one_settle():
    """σ of what is not there become small, and the errors are as those of the rigid model. Links that give way by
    three and ten times the usual: σ of compliances went in circles, by factors of up to five."""
    true, data = drawn(60, 1, 0.0)
    rigid, found = (identify(mh80(), data, options) for options in (RIGID, ELASTIC))
    assert found.deviations["periodic_rad"] < 5e-5
    assert elsewhere(found, true) < 1.5 * elsewhere(rigid, true)
    for share, seed in ((3.0, 0), (3.0, 1), (10.0, 2)):
        found = identify(mh80(), drawn(60, seed, share)[1], ELASTIC)
        assert not [note for note in found.notes if "still change" in note]
        assert found.deviations["axis_rad"] == pytest.approx(share * 3e-4, rel=0.8)


def test_the_elasticity_of_the_file_stays_where_a_rigid_arm_is_asked_for_and_a_payload_does_nothing():
    true, data = drawn(60, 0)
    known = replace(mh80(), elasticity=true.elasticity)
    found = identify(known, data, RIGID)
    assert found.elasticity_sigma is None
    # turned into the frames of the rows found, by milliradians
    moment = true.elasticity.moment
    assert np.abs(found.robot.elasticity.moment - moment).max() < 0.01 * np.abs(moment).max()
    assert elsewhere(found, true) < 0.08
    data = carrying(60, 6, (40.0,))[2]
    found = identify(mh80(), data, RIGID)
    assert "the arm as identified is rigid, payload_kg moves nothing" in found.notes[-1]
    text = evaluation_report(evaluate({"drawn": mh80()}, data)).text()
    assert "\nrobot drawn is rigid, payload_kg moves nothing" in text


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
        ("60,2", "E-APPROACH-VALUE … 3 … approach2 … 2"),
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


def apart(one: Robot, other: Robot, q: np.ndarray, name: str) -> np.ndarray:
    return (one.world_from_base @ forward(one, q, name)).difference(other.world_from_base @ forward(other, q, name))


def seen_by(robot: Robot, rng, each):
    targets = [name for name in MARKERS for _ in range(each)]
    return measured(robot, joint_vectors(robot, len(targets), rng), rng, targets=targets)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_branch_is_the_arm_alone_and_comes_back_from_the_chain(convention):
    """The right hand by the tree, and by the torso's rows, mount and arm put one after the other by hand."""
    robot = two_arms(convention)
    q = joint_vectors(robot, 5, np.random.default_rng(0))
    torso = Robot("torso", robot.convention, robot.rows[:2], robot.joints[:2])
    arm = Robot("arm", robot.convention, robot.rows[8:], robot.joints[8:], tools={"": robot.tool("right")})
    wanted = forward(torso, q[:, :2]) @ RIGHT @ forward(arm, q[:, 8:])
    assert np.abs(forward(robot, q, "right").difference(wanted)).max() < 1e-9
    columns = by_joints(robot, q, "left")  # which joints of the other arm do not move
    assert np.abs(columns[:, :, 8:]).max() == 0
    assert np.abs(columns[:, :, :8]).max(axis=(0, 1)).min() > 0
    true = made(robot, np.random.default_rng(1))
    q = joint_vectors(robot, 8, np.random.default_rng(2))
    again = robot_from_chain(true.chain(), true.tools, robot)
    assert max(np.abs(apart(again, true, q, name)).max() for name in MARKERS) < 1e-9
    assert again.rows[2].theta == robot.rows[2].theta  # of a branch's first row the mount takes what differs
    assert true.rows[2].theta != robot.rows[2].theta
    assert again.rows[3] != robot.rows[3]
    assert np.abs(again.tree.mounts[8][1].matrix() - RIGHT.matrix()).max() > 1e-4


@pytest.mark.slow
def test_derivatives_of_an_elastic_tree_are_those_of_differences():
    """At a thousandth of usual deflections: torques are those on the rigid tree. The last are second derivatives. Every
    third parameter: each joint has some."""
    rng = np.random.default_rng(3)
    robot = elastic(two_arms(), rng, 1e-3)
    data = measured(robot, joint_vectors(robot, 3, rng), rng, 0.0, 0.0, MARKERS)
    state, seen = State(robot.chain(), dict(robot.tools), elastic=True), observed(data)
    derivative, pull = state.jacobian(seen), rng.normal(size=(3, 6))
    bent, count = state.curvature(seen, pull), state.elastic_count
    for k in range(0, count, 3):
        step = np.zeros(derivative.shape[2])
        step[k - count] = max(1e-3 * abs(robot.elasticity.values()[k]), 1e-9)
        ahead, behind = (state.moved(sign * step, "pose") for sign in (1, -1))
        by_difference = (behind.residuals(seen) - ahead.residuals(seen)) / (2 * step[k - count])
        size = max(np.abs(by_difference).max(), np.abs(derivative[:, :, k - count]).max())
        assert np.abs(derivative[:, :, k - count] - by_difference).max() < 1e-3 * size + 1e-6
        if k < 28:  # compliances
            change = (ahead.jacobian(seen) - behind.jacobian(seen))[:, :, 28 - count : 70 - count]
            expected = np.einsum("rw,rwk->k", pull, change) / (2 * step[k - count])
            assert np.abs(bent[k, 28:70] - expected).max() < 1e-3 * np.abs(bent).max()


def with_stiff_torso(robot: Robot) -> Robot:
    stiff = np.array(robot.elasticity.compliance)
    stiff[:2] = 0
    return replace(robot, elasticity=replace(robot.elasticity, compliance=stiff))


def test_one_arm_bends_the_other_a_load_hangs_at_the_tool_without_name_and_a_hand_is_brought_to_a_pose():
    """The left hand sinks as the right arm is stretched out, by the torque on the torso alone."""
    rng = np.random.default_rng(0)
    robot = elastic(two_arms(), rng)
    q = np.zeros((2, 14))
    q[1, 8:] = joint_vectors(robot, 1, rng)[0, 8:]
    rigid = replace(robot, elasticity=None)
    assert np.ptp(forward(rigid, q, "left").translation, axis=0).max() == 0
    assert np.ptp(forward(robot, q, "left").translation, axis=0).max() > 0.003
    assert np.ptp(forward(with_stiff_torso(robot), q, "left").translation, axis=0).max() < 1e-9
    refuses("E-ROBOT-TREE", forward, robot, np.zeros((1, 14)), "left", 50.0)
    named = replace(robot.tree, carriers={**robot.tree.carriers, "": 7})
    robot = with_stiff_torso(replace(robot, tree=named, tools={**robot.tools, "": Rigid()}))
    q = joint_vectors(robot, 4, rng)
    sag = {name: np.abs(forward(robot, q, name, 50.0).difference(forward(robot, q, name))).max() for name in MARKERS}
    assert sag["left"] > 0.01
    assert sag["elbow"] > 0.001
    assert sag["right"] == 0
    rng = np.random.default_rng(7)
    robot = elastic(two_arms(), rng)
    q = joint_vectors(robot, 5, rng, 0.3)
    wanted = forward(robot, q, "right")
    found = inverse(robot, wanted, q + rng.normal(0, 0.02, q.shape), "right")
    assert found.usable.all()
    assert np.abs(forward(robot, found.q, "right").difference(wanted)).max() < 1e-6


def test_joints_are_drawn_with_the_rows_that_they_move_and_a_target_on_no_branch_is_refused():
    robot, rng = two_arms(), np.random.default_rng(3)
    seen = observed(seen_by(robot, rng, each=4))
    state = State(robot.chain(), dict(robot.tools))
    drawn = joints_figure(state, seen, state.residuals(seen), np.ones(12, bool))
    dots = re.findall(r'd="([^"]*)" stroke="[^"]*" stroke-opacity', drawn.svg())
    points = [path.count("M") for path in dots]
    assert points == [12] * 2 + [8] * 3 + [4] * 9  # torso; left arm as far as the elbow; left hand, right arm
    refuses("E-ROBOT-TREE … target other", identify, robot, replace(seen.data, targets=("other",) * 12))


@pytest.mark.slow
def test_two_arms_are_identified_together():
    rng = np.random.default_rng(4)
    nominal = two_arms()
    true = made(nominal, rng)
    found = identify(nominal, seen_by(true, rng, each=25), IdentifyOptions(folds=0))
    assert found.rank == 4 * 14 + 6 * 3
    assert found.undetermined == ()
    assert found.weighting.sigma_mm == pytest.approx(0.05, rel=0.15)
    q = joint_vectors(true, 200, rng, 0.5)
    for name in MARKERS:
        off, before = (np.linalg.norm(apart(true, each, q, name)[:, 3:]) for each in (found.robot, nominal))
        assert off < 0.1 * before
    mount = next(each for each in found.placed if each.name == "mount of joint 9 behind joint 2")
    same_form = robot_from_chain(true.chain(), true.tools, nominal)  # a branch's first θ and d as drawn
    away = mount.pose.translation - same_form.tree.mounts[8][1].translation
    assert np.abs(away / mount.sigma[3:]).max() < 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("after = 2", "after = 9", "E-ROBOT-BRANCH … 3 … 9 … 2"),
        ("after = 2", "", "E-ROBOT-BRANCH … 3"),
        ("joint = 8", "joint = 15", "E-ROBOT-BRANCH … target left … 15 … 14"),
        ('type = "revolute"', 'type = "revolute"\nafter = 0', "E-ROBOT-BRANCH"),
    ],
)
def test_a_file_that_names_no_tree_is_refused(tmp_path, old, new, message):
    text = robot_toml(two_arms())
    assert old in text
    refuses(message, load_robot, written(tmp_path / "robot.toml", text.replace(old, new, 1)))


def test_rows_of_an_elastic_tree_keep_the_place_about_which_a_link_gives_way(tmp_path):
    """Joint 1 stands 700 mm below where the next axis crosses it: its row takes the crossing, and links give way by a
    fifth of a degree across it, about where they did."""
    robot, rng = elastic(two_arms(), np.random.default_rng(5)), np.random.default_rng(6)
    chain = robot.chain()
    place = chain.translation.copy()
    place[0] -= 700 * chain.rotation[0][:, 2]
    place[1] += [0, 0, 700]
    compliance = chain.elasticity.compliance.copy()
    compliance[0] = 1e-5
    bent = replace(chain, translation=place, elasticity=replace(chain.elasticity, compliance=compliance))
    text = robot_toml(robot_from_chain(bent, robot.tools, robot))
    again = load_robot(written(tmp_path / "robot.toml", text))
    assert again.tree.carriers == robot.tree.carriers
    q, targets = joint_vectors(robot, 6, rng), MARKERS * 2
    wanted = State(bent, dict(robot.tools)).tips(q, targets)
    found = State(again.chain(), dict(again.tools)).tips(q, targets)
    assert np.abs(found.difference(wanted)).max() < 1e-8
    slid = replace(again, elasticity=replace(again.elasticity, pivot=np.zeros_like(again.elasticity.pivot)))
    assert np.abs(State(slid.chain(), dict(slid.tools)).tips(q, targets).difference(wanted)).max() > 1e-3
    pivots = [joint_frames(each, q)[1][0] for each in (bent, again.chain())]
    assert np.abs(pivots[1] - pivots[0]).max() < 1e-8
