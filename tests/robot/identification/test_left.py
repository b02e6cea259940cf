"""What a model leaves: said of clean sets one time in a hundred, and named where there is something. The problem of an
arm: its minimum, weights and variance components. Data in another convention than they say, which are refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.adjust.blocks import Components, Equations
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.identification import problem
from stcal.robot.identification.adjustment import State, Weighting, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.problem import ArmProblem, Spread, huber_limit
from stcal.robot.identification.result import IdentifiedFile, IdentifyOptions
from stcal.robot.identification.start import start
from stcal.robot.identification.unexplained import left
from stcal.robot.kinematics.forward import forward, joint_frames
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.levels import sampled
from tests.outcome import fails_with, refuses
from tests.robot.identification.test_solve import of_distances, simulated
from tests.support.arms import seen_arm

NOISE = Weighting(0.05, 2e-4)
QUICK = IdentifyOptions(folds=0)


def left_of(true: Robot, data: Measurements, kind):
    """Of the true robot, with what any fit of its parameters takes up taken out."""
    state, seen = State(true.chain(), dict(true.tools)), observed(data, kind)
    return left(state, true.world_from_base, seen, NOISE, state.jacobian(seen))


@pytest.mark.parametrize(
    ("kind", "sets"), sampled([("position", 20), ("position", 200), ("pose", 100), ("distance", 60)])
)
def test_clean_sets_say_nothing(kind, sets):
    """At 1 %; of 20 sets any with a chance of 18 %, of 200 sets more than five with one of 2 %."""
    said = [found for seed in range(sets) if (found := left_of(*simulated(seed, 40), kind))]
    assert len(said) <= 0.025 * sets


def bent(seed: int, count: int, off: dict) -> tuple[Robot, Measurements]:
    """A robot whose joints (from 1) turn by ``of(q, true)`` (count,) more than their values; 0.05 mm of noise."""
    true, _ = simulated(seed, 2)
    rng = np.random.default_rng(seed)
    q = joint_vectors(true, count, rng)
    really = q.copy()
    for joint, of in off.items():
        really[:, joint - 1] += of(q, true)
    return true, replace(measured(true, really, rng), q=q)


def gravity(q: np.ndarray, true: Robot) -> np.ndarray:
    """0.15 mrad at a torque of a metre about joint 2."""
    at_base = replace(true, world_from_base=type(true.world_from_base)()).chain()
    turned, origin = joint_frames(at_base, q)
    arm = forward(true, q).translation - origin[1]
    return 1.5e-7 * np.einsum("mi,mi->m", turned[1][:, :, 2], np.cross(arm, [0, 0, 1.0]))


def twice(angle: np.ndarray) -> np.ndarray:
    return np.sin(2 * angle)


@pytest.mark.parametrize(
    ("kind", "joint", "of", "what"),
    [
        ("pose", 3, lambda q, _: 2e-4 * np.cos(q[:, 2] + 1), "the angle of joint 3, once a turn, along its motion"),
        ("position", 5, lambda q, _: 3e-4 * twice(q[:, 4]), "the angle of joint 5, twice a turn, along its motion"),
        ("position", 2, gravity, "gravity's torque about joint 2"),
    ],
)
def test_a_cause_is_named_once(kind, joint, of, what):
    true, data = bent(5, 120, {joint: of})
    [finding] = left_of(true, data, kind)
    assert finding.what == what
    assert finding.joint == joint
    assert finding.p < 1e-3
    assert f"residuals go with {what}: " in finding.sentence()


def test_a_coupling_of_the_wrist_is_no_gravity_and_two_causes_are_two_findings():
    """A hundredth of joint 5 in joint 6; and joints 1 and 3."""
    finding = left_of(*bent(4, 60, {6: lambda q, _: 0.01 * q[:, 4]}), "pose")[0]
    assert finding.what.startswith("the value of joint 5, along the motion of joint 6, as of a coupling")
    assert finding.share > 0.9
    both = {1: lambda q, _: 3e-4 * twice(q[:, 0]), 3: lambda q, _: 3e-4 * np.cos(q[:, 2])}
    found = left_of(*bent(7, 200, both), "position")
    assert {finding.joint for finding in found} == {1, 3}
    assert found[0].share > found[1].share


def test_the_effect_is_what_was_put_in_and_neither_rounding_nor_too_few_rows_tell_anything():
    """Twice a turn of joint 1: 0.2 mrad at the tool's distance from the axis, of which parameters take up a fifth."""
    true, data = bent(6, 200, {1: lambda q, _: 2e-4 * twice(q[:, 0])})
    [finding] = left_of(true, data, "position")
    reach = np.linalg.norm(forward(true, data.q).translation[:, :2], axis=1)
    assert finding.turns == 2
    put_in = 2e-4 * np.sqrt((reach**2).mean())
    assert 0.7 * put_in < finding.effect_mm < put_in
    assert 0.3 < finding.share < 0.95
    assert finding.sentence().endswith("p < 0.001")
    assert left_of(*simulated(8, 40, 0, 0), "position") == ()
    assert left_of(*simulated(9, 12), "position") is None


def test_a_jump_hides_no_gear():
    true, data = bent(7, 80, {2: lambda q, _: 3e-4 * np.sin(q[:, 1])})
    jump, gear, *_ = left_of(true, moved_from(50, data, Rigid.exp([0, 0, 0, 20.0, 0, 0])), "position")
    assert (jump.line, gear.joint, gear.turns) == (data.lines[50], 2, 1)


JUMP = Rigid.exp([0, 0, 2e-3, 0.6, -0.8, 0])
"""Of the instrument: a millimetre, and a tenth of a degree."""


def moved_from(row: int, data: Measurements, by: Rigid) -> Measurements:
    middle = Rigid(np.eye(3), data.points().mean(0))
    moved = middle @ by @ middle.inverse() @ data.poses()
    later = np.arange(len(data)) >= row
    return replace(
        data,
        positions=np.where(later[:, None], moved.translation, data.points()),
        rotations=np.where(later[:, None, None], moved.rotation, data.rotations),
    )


@pytest.mark.parametrize(("row", "kind"), [(8, "position"), (34, "pose")])
def test_an_instrument_that_moved_is_located_and_a_station_proposed(row, kind):
    true, data = simulated(11, 40)
    finding, *others = left_of(true, moved_from(row, data, JUMP), kind)
    assert finding.line == data.lines[row]
    assert f"the instrument or the robot's base elsewhere from line {data.lines[row]}" in finding.what
    assert "column station" in finding.sentence()
    assert finding.effect_mm == pytest.approx(1.0, rel=0.3)
    assert finding.effect_rad == pytest.approx(2e-3, rel=0.3)
    assert others == []
    positions = np.array(moved_from(row, data, JUMP).positions)
    positions[[3, 30, 37]] += [[20.0, 0, 0], [0, -30, 0], [0, 0, 50]]  # beside wrong rows, too
    finding, *_ = left_of(true, replace(moved_from(row, data, JUMP), positions=positions), "position")
    assert finding.line == data.lines[row]


def test_a_target_that_slipped_a_joint_that_lost_its_zero_and_a_drift_are_told_apart():
    true, data = simulated(13, 60, targets=("a", "b"))
    later = np.arange(60) >= 30
    slipped = np.array([each == "b" for each in data.targets]) & later
    positions = data.points() + slipped[:, None] * (data.rotations @ np.array([0.5, 0.5, 0]))
    finding, *_ = left_of(true, replace(data, positions=positions), "position")
    assert "target b elsewhere on its flange from line" in finding.what
    really = data.q.copy()
    really[later, 3] += 2e-3
    lost = replace(measured(true, really, np.random.default_rng(1), targets=data.targets), q=data.q)
    finding, *_ = left_of(true, lost, "pose")
    assert (finding.joint, finding.line) == (4, data.lines[30])
    assert finding.effect_rad == pytest.approx(2e-3, rel=0.2)
    true, data = simulated(14, 60)
    along = np.linspace(0, 1, 60)[:, None]
    drifted = replace(data, positions=data.points() + along * [0.8, 0.6, 0])
    finding, *_ = left_of(true, drifted, "position")
    assert "by and by" in finding.what
    assert finding.line is None
    assert finding.effect_mm == pytest.approx(1.0, rel=0.3)


@pytest.mark.slow
def test_identify_tells_that_the_instrument_moved_and_what_is_not_seen_of_base_and_tool_has_no_sigma():
    """Half of the rows moved by 10 mm, which neither errors nor the arm explain."""
    true, data = simulated(15, 60)
    data = moved_from(30, data, Rigid.exp([0, 0, 5e-3, 6, -8, 0]))
    nominal = replace(mh80(), tools=true.tools)
    found = identify(nominal, data, QUICK)
    assert found.left[0].line == data.lines[30]
    assert any("column station" in note for note in found.notes)
    assert IdentifiedFile.model_validate(found).content()["left"][0]["line"] == data.lines[30]
    mended = identify(nominal, replace(data, stations=("A",) * 30 + ("B",) * 30), QUICK)
    assert mended.left == ()
    assert mended.fitted_mm.mean() < 0.2 < 2 < found.fitted_mm.mean()
    data = simulated(11, 45)[1]
    position = identify(mh80(), data, replace(QUICK, observe="position"))
    base, tool = position.placed
    assert np.isfinite(base.sigma).all()
    assert np.isnan(tool.sigma[:3]).all()
    assert (tool.sigma[3:] > 0).all()
    distances = identify(mh80(), of_distances(data), QUICK)
    assert distances.rank == 21
    base, tool = distances.placed
    assert np.isnan(base.sigma).all()
    assert (tool.sigma[3:] > 0).all()


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


WEIGHTING = Weighting(0.05, 2e-4)


@pytest.fixture(scope="module")
def case():
    """A state far from what the instrument sees of a made arm, and what it sees: 40 poses, one with a gross error."""
    _, data = seen_arm(np.random.default_rng(3), 40)
    positions = data.positions.copy()
    positions[7] += [3.0, 0, 0]
    data = replace(data, positions=positions)
    start = identify(mh80(), data, IdentifyOptions(folds=0, robust=False)).state
    return start, observed(data)


def test_it_ends_where_the_weighted_gradient_is_zero_or_with_an_error(case, monkeypatch):
    """In units of its own σ, and of Huber's cost: weight times residual."""
    state, seen = case
    found = ArmProblem(seen, WEIGHTING).solve(state)
    white = WEIGHTING.whiten(found.state.residuals(seen), seen)
    slope = WEIGHTING.whiten(found.state.jacobian(seen), seen)
    length = np.linalg.norm(white, axis=1)
    limit = huber_limit(seen.kind)
    assert found.weights == pytest.approx(np.minimum(1, limit / length))
    assert found.weights[7] == found.weights.min() < 0.2
    gradient = np.einsum("r,ri,rik->k", found.weights, white, slope)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.equations.normal)))
    assert np.abs(gradient * sigma).max() < 1e-2
    monkeypatch.setattr(problem, "MAX_STEPS", 1)
    count = state.jacobian(seen).shape[2]
    far = state.moved(np.full(count, 0.05), seen.kind)
    refuses("E-NO-MINIMUM … identification … 1", ArmProblem(seen, WEIGHTING).solve, far)


def test_what_is_common_to_all_observations_is_whitened_too():
    """Values with covariance Σ = own + F Fᵀ become independent, of σ 1: the whitened Σ is the identity."""
    rng = np.random.default_rng(0)
    data = measured(mh80(), joint_vectors(mh80(), 5, rng), rng, 0.05, 2e-4, [""] * 5)
    root = rng.normal(size=(5, 6, 6)) + 3 * np.eye(6)
    own, common = root @ np.swapaxes(root, 1, 2), rng.normal(size=(5, 6, 2))
    data = replace(data, covariance=own + common @ np.swapaxes(common, 1, 2), common=common)
    seen = observed(data)
    white = Weighting(1.0, 1.0, given=True).whiten(np.eye(30).reshape(5, 6, 30), seen).reshape(30, 30)
    full = np.zeros((30, 30))
    for i in range(5):
        full[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = own[i]
    flat = common.reshape(30, 2)
    np.testing.assert_allclose(white @ (full + flat @ flat.T) @ white.T, np.eye(30), atol=1e-9)
    values = rng.normal(size=(5, 6))  # and half the derivative of their squares is the inverse of Σ times them
    pull = Weighting(1.0, 1.0, given=True).pull(Weighting(1.0, 1.0, given=True).whiten(values, seen), seen)
    np.testing.assert_allclose((full + flat @ flat.T) @ pull.ravel(), values.ravel(), atol=1e-9)


@pytest.mark.parametrize("rows", [14, 24, 104])
def test_one_sigma_is_that_of_least_squares_and_the_covariance_that_of_t(rows):
    rng = np.random.default_rng(rows)
    design, seen = rng.normal(size=(rows, 4)), rng.normal(size=rows)
    fixed = Equations.of(np.zeros(4), 1e-6 * np.eye(4))

    def spread(sigma: float) -> Spread:
        parts = Components([Equations.of(seen / sigma, -design / sigma)], fixed, 0.0, np.array([np.inf]))
        return Spread(parts, np.array([-3.0]), np.array([3.0]), np.ones(4))

    freedom, sigma = rows - 4, float(np.exp(spread(1.0).best()[0]))
    left = np.linalg.lstsq(design, seen, rcond=None)[1][0]
    assert sigma**2 == pytest.approx(left / freedom, rel=1e-6)
    wanted = left / (freedom - 2) * np.linalg.inv(design.T @ design)  # of a t distribution with so many degrees
    # three nodes are exact to the fourth order of the spread of log σ, 1 / √(2 · freedom)
    assert spread(sigma).covariance() == pytest.approx(wanted, rel=3 / freedom**2 + 1e-3)


LAST = "quaternions were x, y, z, w in the order of their columns"


def seen(seed: int, count: int, targets=("",)):
    return simulated(seed, count, targets=targets)[1]


def in_order(data, order, conjugated=False):
    """The file as it is read when its quaternion columns hold other components than they say."""
    wxyz = data.poses().quaternions() * ([1, -1, -1, -1] if conjugated else [1, 1, 1, 1])
    return replace(data, rotations=Poses.from_quaternions(wxyz[:, order], data.points()).rotation)


@pytest.mark.parametrize(
    ("order", "conjugated", "said"),
    [
        ([1, 2, 3, 0], False, f"if {LAST}; give --quaternions xyzw"),
        ([0, 1, 2, 3], True, "conjugated (the first frame seen from the second); change the sign of qw"),
        ([1, 2, 3, 0], True, f"if {LAST}, and conjugated; give --quaternions xyzw and change the sign of qw"),
    ],
)
def test_another_convention_is_named(order, conjugated, said):
    data = seen(8, 8, ("a", "b"))
    start(mh80(), data)
    with fails_with("E-ROBOT-ORIENTATIONS") as caught:
        start(mh80(), in_order(data, order, conjugated))
    assert str(caught.value).endswith(said)


def test_orientations_that_no_convention_mends_are_left_to_the_adjustment_and_a_target_that_slipped_is_named():
    """One orientation in all rows, whatever the joints do."""
    data = seen(1, 20)
    still = np.tile(Rigid.exp([0.4, -0.3, 0.9, 0, 0, 0]).rotation, (20, 1, 1))
    start(mh80(), replace(data, rotations=still))
    rng = np.random.default_rng(1)
    true = placed(
        made(mh80(), rng), Rigid.exp([0.1, -0.05, 2.1, 2500, -900, 400]), {"": Rigid.exp([0, 0.1, 0, 220, 60, 150])}
    )
    slipped = replace(true, tools={"": Rigid.exp([0.2, 0.1, 0.4, 120, 160, 180])})
    q = joint_vectors(true, 60, rng)
    parts = [measured(robot, q[rows], rng) for robot, rows in ((true, slice(30)), (slipped, slice(30, 60)))]
    positions = np.vstack([part.positions for part in parts])
    data = Measurements.from_arrays(q, positions)
    with fails_with("E-IDENTIFY-UNDETERMINED … the target elsewhere on its flange from line 31 on … column target"):
        identify(mh80(), data, IdentifyOptions(folds=0))


def turned(*quarters):
    """The robot with quarters of a turn added to theta of its rows."""
    rows = zip(mh80().rows, quarters, strict=True)
    return replace(mh80(), rows=tuple(replace(row, theta=row.theta + k * np.pi / 2) for row, k in rows))


WITH_ZERO = turned(0, 0, 0, -1, 0, 0)


def as_it_is(q: np.ndarray) -> np.ndarray:
    return q


@pytest.mark.parametrize(
    ("mistaken", "change", "wrong", "named"),
    [
        (mh80(), as_it_is, [3, 20, 31], "lines 5, 22, 33 were not there … remove them"),
        *sampled(
            [
                (replace(mh80(), convention="modified"), as_it_is, [], "standard convention"),
                (WITH_ZERO, as_it_is, [3, 20], "theta of joint 4 … +90° … lines 5, 22 were not there"),
                # joint 1 is square to joint 2: half a turn of the one's zero is the opposite sign of the other
                (turned(0, 0, 0, 2, 0, 0), as_it_is, [], "or if"),
                (mh80(), lambda q: q[:, [0, 2, 1, 3, 4, 5]], [], "columns q2 and q3 were exchanged"),
                (mh80(), lambda q: np.roll(q, 1, axis=0), [], "one row further up"),
                (mh80(), lambda q: np.roll(q, -1, axis=0), [], "one row further down"),
                (mh80(), lambda q: q - q[:, [1]] * [0, 0, 1, 0, 0, 0], [], "joint 3 were coupled to joint 2 by +1"),
                (replace(mh80(), coupling=np.eye(6) + 0.5 * np.eye(6, k=-4)), as_it_is, [], "take coupling out"),
            ],
            kept=(1, 2, 3, 4),
        ),
    ],
)
def test_mistakes_are_named(mistaken, change, wrong, named):
    data = replace(seen(6, 40), rotations=None)
    positions = np.array(data.positions)
    positions[wrong] += np.random.default_rng(0).normal(0, 600.0, (len(wrong), 3))
    refuses(f"E-IDENTIFY-MISFIT … {named}", start, mistaken, replace(data, q=change(data.q), positions=positions))


def test_orientations_that_are_not_the_robots_are_refused_though_positions_fit():
    rng = np.random.default_rng(4)
    robot = mh80()
    data = measured(robot, joint_vectors(robot, 30, rng), rng)
    angles = Rotation.from_matrix(data.rotations).as_euler("xyz")
    ways = (
        Rotation.from_euler("xyz", angles[:, ::-1]),
        Rotation.from_euler("xyz", angles * [1, -1, 1]),
        Rotation.from_matrix(np.roll(data.rotations, 1, axis=0)),
        Rotation.random(30, rng),
    )
    for wrong in (each.as_matrix() for each in ways):
        said = "E-ROBOT-ORIENTATIONS … check the convention of the angles"
        refuses(said, start, robot, replace(data, rotations=wrong))
        third = np.where((np.arange(30) % 3 == 0)[:, None, None], wrong, data.rotations)
        start(robot, replace(data, rotations=third))  # the fit gives such rows no weight


def test_an_instrument_that_moved_far_is_refused_with_the_column_that_mends_it():
    data = replace(seen(2, 40), rotations=None)
    positions = data.positions.copy()
    positions[12:] = Rigid.exp([0.3, -0.2, 1.0, 1500, -900, 400]) @ positions[12:]
    refuses("E-IDENTIFY-MISFIT … moved … column station or target", start, mh80(), replace(data, positions=positions))
