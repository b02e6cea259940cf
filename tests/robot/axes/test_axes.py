"""The axis method on simulated arms, where everything is known, and on tracked sweeps of a Fanuc."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.robot import simulated
from stcal.robot.axes.axes_model import pairs_of, robot_from_sweeps, slopes_of
from stcal.robot.axes.fit import find_arcs, fit_axes, length_of, ring
from stcal.robot.kinematics.forward import forward, joint_frames
from stcal.robot.kinematics.measurements import Measurements, read_measurements
from stcal.robot.kinematics.robot_file import load_robot
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made, placed
from tests.levels import SLOW, sampled
from tests.outcome import fails_with, refuses
from tests.scripts import load_script
from tests.support.arms import modified, scara, two_arms

SIGMA = 0.03
WORLD = Rigid.exp([0.1, -0.05, 2.1, 2500.0, -900.0, 400.0])
TOOLS = {"A": Rigid(np.eye(3), [180, 20, 150]), "B": Rigid(np.eye(3), [-120, 130, 90])}
TOOLS["C"] = Rigid(np.eye(3), [-60, -170, 210])


def coupled() -> Robot:
    coupling = np.eye(6)
    coupling[2, 1], coupling[5, 4] = 1, -0.5
    return replace(mh80(), name="coupled", coupling=coupling)


NOMINALS = {"MH80": mh80, "Craig": modified, "SCARA": scara, "coupled": coupled}
QUICK_AND_SLOW = ["SCARA", pytest.param("coupled", marks=SLOW), *sampled(["Craig", "MH80"], kept=())]


def arm(nominal: Robot) -> Robot:
    """As made, where an instrument sees it, with three reflectors."""
    return placed(made(nominal, np.random.default_rng(11)), WORLD, TOOLS)


def sweep_values(robot: Robot, count: int = 9, rests: int = 1) -> np.ndarray:
    """Controller's values: each joint swept alone in kinematic values, from rests that all share."""
    n = len(robot.rows)
    q = []
    for rest in range(rests):
        home = np.where(robot.prismatic, 30.0, 0.25 + 0.3 * rest) * np.where(np.arange(n) % 2, 1, -1)
        q.append(home)
        for j in range(n):
            way = np.linspace(0, 150, count) if robot.prismatic[j] else np.linspace(-1.1, 1.1, count)
            for value in way:
                q.append(np.where(np.arange(n) == j, value, home))
    return np.array(q) @ np.linalg.inv(robot.coupling).T


def measured(robot: Robot, q: np.ndarray, sigma: float = 0.0, seed: int = 0) -> Measurements:
    """Positions of all reflectors at each joint vector, reflectors side by side in the rows."""
    seen = np.stack([robot.world_from_base @ forward(robot, q, name).translation for name in robot.tools], axis=1)
    points = seen.reshape(-1, 3) + np.random.default_rng(seed).normal(0, 1, (seen.size // 3, 3)) * sigma
    k = len(robot.tools)
    lines = range(2, 2 + len(points))
    return Measurements("sweeps", lines, np.repeat(q, k, axis=0), tuple(robot.tools) * len(q), points)


SWEEP = 9
"""Positions of each joint's; three reflectors at each, after the first instant."""


def rows_of(joint: int) -> slice:
    return slice(3 * (1 + SWEEP * joint), 3 * (1 + SWEEP * (joint + 1)))


@pytest.fixture(scope="module")
def swept() -> Measurements:
    return measured(arm(mh80()), sweep_values(mh80(), SWEEP), SIGMA, 2)


@pytest.mark.parametrize("name", QUICK_AND_SLOW)
def test_without_noise_the_arm_comes_back(name):
    nominal = NOMINALS[name]()
    true = arm(nominal)
    result = robot_from_sweeps(measured(true, sweep_values(true, rests=2)), nominal)
    q = joint_vectors(nominal, 50, np.random.default_rng(3))
    for tool in true.tools:
        there = true.world_from_base @ forward(true, q, tool).translation
        here = result.robot.world_from_base @ forward(result.robot, q, tool).translation
        # rounding of coordinates of 3000 mm is 5e-13 mm; axes far outside the measured arcs enlarge it
        assert np.abs(here - there).max() < 1e-9
    assert not result.notes
    assert max(fit.sigma_mm for fit in result.fits) < 1e-11


def test_a_tracker_that_moved_between_two_rows_is_located():
    true = arm(scara())
    data = measured(true, sweep_values(true), SIGMA)
    assert not any("elsewhere" in note for note in robot_from_sweeps(data, scara()).notes)
    row, middle = 57, data.points().mean(0)
    later = Rigid.exp([0, 0, 1e-3, 0.8, 0, 0.6]) @ (data.points()[row:] - middle) + middle
    moved = replace(data, positions=np.concatenate([data.points()[:row], later]))
    [note] = [note for note in robot_from_sweeps(moved, scara()).notes if "elsewhere" in note]
    assert f"from line {data.lines[row]}" in note
    assert "column station" in note


def errors_of(frames, robot: Robot) -> np.ndarray:
    """Of all axes of a true robot, one after the other."""
    rotation, origin = joint_frames(robot.chain(), np.zeros((1, len(robot.rows))))
    pairs = zip(frames, rotation[:, 0, :, 2], origin[:, 0], robot.prismatic, strict=True)
    return np.concatenate([axis_error(*each) for each in pairs])


def axis_error(frame: Rigid, z: np.ndarray, origin: np.ndarray, sliding: bool) -> np.ndarray:
    """rx, ry, tx, ty of the true axis in the found one's frame."""
    direction, place = frame.rotation.T @ z, frame.inverse() @ origin
    place = place - direction * place[2] / direction[2]
    return np.array([-direction[1], direction[0], *place[:2]])[: 2 if sliding else 4]


@pytest.mark.full
@pytest.mark.parametrize(("name", "rests"), [("MH80", 1), ("coupled", 2), ("SCARA", 1)])
def test_errors_of_axes_and_pairs_are_as_large_as_their_covariance(name, rests):
    nominal = NOMINALS[name]()
    true = arm(nominal)
    q = sweep_values(true, 7 if rests == 1 else 5, rests)
    arcs, _ = find_arcs(measured(true, q), nominal)

    def fitted(sigma: float, seed: int):
        fits, covariance, *_ = fit_axes(measured(true, q, sigma, seed), nominal, arcs)
        frames = [fit.world_from_axis for fit in fits]
        slopes = slopes_of(frames, nominal)
        return fits, covariance, frames, pairs_of(frames, slopes, covariance, nominal, 2000.0)[:3]

    wanted = fitted(0.0, 0)[3]
    squares, coordinates, scores = [], [], []
    for seed in range(100):
        fits, covariance, frames, pairs = fitted(SIGMA, seed)
        error = errors_of(frames, true)
        squares.append(error @ np.linalg.solve(covariance, error) / len(error))
        coordinates.append([fit.sigma_mm / SIGMA for fit in fits])
        for one, two in zip(pairs, wanted, strict=True) if name == "MH80" else ():  # others cross: signs are not kept
            apart = (one.distance_mm - two.distance_mm) / one.distance_sigma_mm
            scores.append([apart, (one.angle_rad - two.angle_rad) / one.angle_sigma_rad])
    redundancy = min(fit.redundancy for fit in fits)
    # normal errors over an estimated σ: the mean of their squares is redundancy / (redundancy − 2); 100 draws of 14
    # to 24 coordinates scatter by √(2 / 1400) = 4 % at most
    assert 0.9 < np.mean(squares) < 1.1 * redundancy / (redundancy - 2)
    assert np.mean(np.square(coordinates)) == pytest.approx(1, abs=0.03)  # 100 draws × 4 axes × 30 or more
    if scores:  # 300 each, not all independent: the mean square scatters by √(2 / 300) = 8 % or somewhat more
        assert np.mean(np.square(scores), axis=0) == pytest.approx([1, 1], abs=0.33)


@pytest.mark.slow
def test_leaving_out_a_row_is_fitting_without_it():
    nominal = mh80()
    data = measured(arm(nominal), sweep_values(nominal, 4), SIGMA, 2)
    whole = robot_from_sweeps(data, nominal)
    for instant in (3, 12):
        rows = np.arange(len(data)) // 3 != instant
        index = whole.without_one.lines.index(2 + 3 * instant)
        again = robot_from_sweeps(data[rows], nominal)
        found = np.abs(whole.without_one.distance[index])
        # to first order, and with the weights of all rows
        sigma = np.array([p.distance_sigma_mm for p in whole.pairs])
        assert (np.abs(found - [p.distance_mm for p in again.pairs]) < 0.1 * sigma).all()
        assert np.abs(found - [p.distance_mm for p in whole.pairs]).max() > 1e-4


@pytest.mark.slow
def test_a_value_in_another_joints_column_is_named_not_the_axis(swept):
    q, wrong = np.array(swept.q), slice(rows_of(2).start + 21, rows_of(2).start + 24)
    q[wrong, 3], q[wrong, 2] = q[wrong, 2], q[0, 2]
    found = robot_from_sweeps(replace(swept, q=q), mh80())
    assert {line for off in found.off for line in off} == set(swept.lines[wrong])
    clean = robot_from_sweeps(swept, mh80())
    assert [row.d for row in found.robot.rows] == pytest.approx([row.d for row in clean.robot.rows], abs=0.2)


@pytest.mark.parametrize("off_mm", sampled([0.5, 20.0, 300.0, 2000.0]))
def test_a_gross_error_is_named_and_left_out(off_mm):
    nominal = mh80()
    data = measured(arm(nominal), sweep_values(nominal, 6), SIGMA, 7)
    clean = robot_from_sweeps(data, nominal)
    positions = np.array(data.positions)
    positions[40] += off_mm * np.array([0.6, -0.48, 0.64])
    result = robot_from_sweeps(replace(data, positions=positions), nominal)
    assert [note for note in result.notes if f"line {data.lines[40]}, reflector B" in note and "left out" in note]
    assert len(result.notes) == 1
    for one, two in zip(result.pairs, clean.pairs, strict=True):
        assert abs(one.distance_mm - two.distance_mm) < 3 * two.distance_sigma_mm  # one of 18 points less


@pytest.mark.parametrize("seed", [0, *sampled((1, 2), kept=())])
def test_a_loose_reflector_is_left_out_row_by_row(seed, swept):
    """Of an arc one point is left, or none."""
    loose, positions = np.array(swept.targets) == "C", np.array(swept.positions)
    positions[loose] += np.random.default_rng(seed).normal(0, 2.0, (loose.sum(), 3))
    result = robot_from_sweeps(replace(swept, positions=positions), mh80())
    assert [len(off) >= SWEEP - 1 for off in result.off] == [True] * 6
    assert all(max(off.values()) < 10 for off in result.off)  # 5 σ
    assert not any("close to the axis" in note for note in result.notes)


def test_a_reflector_on_the_axis_says_nothing_and_a_row_without_a_target_is_named(swept):
    nominal = mh80()
    true = replace(arm(nominal), tools=TOOLS | {"D": Rigid(np.eye(3), [0.01, 0, 300])})
    result = robot_from_sweeps(measured(true, sweep_values(nominal), SIGMA), nominal)
    assert [arc.target for arc in result.fits[5].near] == ["D"]
    assert "reflector D: too close to the axis of joint 6" in result.notes[0]
    error = errors_of([fit.world_from_axis for fit in result.fits], true)[-4:]
    assert np.abs(error[2:]).max() < 5 * np.sqrt(np.diag(result.fits[5].covariance)[2:].max())
    alone = replace(true, tools={"D": true.tools["D"]})
    refuses("E-AXES-UNDETERMINED … 6:", robot_from_sweeps, measured(alone, sweep_values(nominal), SIGMA), nominal)
    names = list(swept.targets)
    names[40] = ""
    notes = robot_from_sweeps(replace(swept, targets=tuple(names)), mh80()).notes
    assert any(f"line {swept.lines[40]}: rows without a target, beside rows with one" in note for note in notes)


def test_full_turns_and_arcs_too_short_to_use():
    """At −0.3°, 0.1° and 359.9° a joint stands at one place, where it may stray by 1°."""
    true, q = scara(), np.tile([0.2, 0.1, 30.0, 0.0], (4, 1))
    for shift in (0.0, 0.004, -0.004):
        q[:, 0] = [shift - 0.005, shift + 0.002, shift + 2 * np.pi - 0.002, 1.0]
        data = measured(arm(true), np.vstack([q, sweep_values(true)]))
        arcs, notes = find_arcs(data, true, np.radians(1.0))
        assert sum("an arc of 2 positions is not used" in note for note in notes) == 3  # of each reflector
        assert not any(arc.rows[0] == 0 for arc in arcs)
    true = arm(mh80())
    q = sweep_values(true, 5)
    turned, two = np.repeat(q[:1], 4, axis=0), np.repeat(q[:1], 2, axis=0)
    turned[:, 5] = np.radians([-360, -120, 120, 360])
    two[:, 0] = 1.0
    two[1, 5] = 0.9
    _, notes = find_arcs(measured(true, np.vstack([q, turned, two])), mh80())
    assert len(notes) == 3  # of each reflector
    assert all("joint 6" in note and "an arc of 2 positions is not used" in note for note in notes)
    result = robot_from_sweeps(measured(true, np.vstack([q, turned])), mh80())
    assert np.degrees(result.fits[5].span) == pytest.approx(720)


def test_the_arms_that_cannot_be_had(swept):
    nominal = mh80()
    true = arm(nominal)
    q = sweep_values(true, 6)
    good = measured(true, q, SIGMA)
    slides = measured(arm(scara()), sweep_values(scara()), SIGMA)
    robot_from_sweeps(slides, scara())
    two = Robot("2R", "standard", (DHRow(300, 0, 0, 0),) * 2, (Joint(),) * 2)
    planar = measured(placed(two, WORLD, TOOLS), sweep_values(two), SIGMA)
    rows = (nominal.rows[0], replace(nominal.rows[1], beta=np.radians(3)), *nominal.rows[2:])
    robot_from_sweeps(measured(placed(replace(nominal, rows=rows), WORLD, TOOLS), q, SIGMA), nominal)
    fixed, still = np.array(good.positions), np.array(swept.positions)
    fixed[1::3] = fixed[1]
    still[rows_of(3)] = np.tile(still[:3], (SWEEP, 1)) + np.random.default_rng(0).normal(0, SIGMA, (3 * SWEEP, 3))
    short = q[0] + 0.01 * (q - q[0])  # 1.3°: σ of a direction is beyond what its covariance can say
    few = measured(replace(true, tools={"A": TOOLS["A"]}), sweep_values(true, 3)[1:])
    for words, data, robot in (
        ("E-AXES-NO-SWEEP … sweeps … 4", good[np.abs(good.q[:, 3] - good.q[0, 3]) < 1e-9], nominal),
        ("E-AXES-NO-SWEEP", measured(arm(coupled()), sweep_values(coupled(), 6)), nominal),
        ("E-TARGET-STILL … reflector B", replace(good, positions=fixed), nominal),
        ("E-AXES-UNDETERMINED … joint 4 … measured anew", replace(swept, positions=still), nominal),
        ("E-AXES-MIRRORED … MH80", replace(good, positions=good.positions * [1, -1, 1]), nominal),
        ("E-AXES-MIRRORED … scara", replace(slides, positions=slides.positions[:, [1, 0, 2]]), scara()),
        ("E-ROBOT-TREE", good, two_arms()),
        ("E-AXES-SIGN … 3 … MH80", replace(good, q=good.q * [1, 1, -1, 1, 1, 1]), nominal),
        ("E-AXES-UNITS … 0.1 times … 2R", replace(planar, positions=planar.positions / 10), two),
        ("E-MEASURED-DISTANCES", replace(good, positions=None), nominal),
        ("E-AXES-UNDETERMINED … sweep further", measured(true, short, SIGMA), nominal),
        ("E-AXES-FEW … joint 1: 3 … 1", few, nominal),
    ):
        refuses(words, robot_from_sweeps, data, robot)
    refuses("E-AXES-JOINT-VALUES", robot_from_sweeps, replace(good, q=np.radians(good.q)), nominal, 1e-6)


def test_exactly_parallel_axes_have_no_common_normal_and_both_errors_are_alike_at_the_length():
    nominal = mh80()
    result = robot_from_sweeps(measured(placed(nominal, Rigid(), TOOLS), sweep_values(nominal)), nominal)
    pair = result.pairs[1]
    assert pair.parallel
    assert pair.distance_mm == pytest.approx(870, abs=1e-8)
    assert pair.refused
    true = arm(mh80())
    data = posed(true, sweep_values(true, 3))
    assert length_of(data) == pytest.approx(LENGTH_MM)
    assert length_of(replace(data, covariance=None)) is None
    with fails_with("E-MEASURED-NO-ORIENTATION"):
        robot_from_sweeps(measured(true, sweep_values(true, 3)), nominal, places=ring(100.0))
    refuses("E-OPTION-RANGE … --orientations … 0.1 … 1 … 10000", ring, 0.1)


def test_tracked_sweeps_lie_on_their_circles_and_give_the_arms_lengths(shared_data, tmp_path):
    """The tracked sweeps as our files, three rows for each of theirs, and an R-2000's nominal rows. Against 311.45,
    1075.58, 226.08 mm of separate circle fits (SOURCE.txt), printed to 0.005 mm. Denavit and Hartenberg are refused for
    the nearly parallel pair."""
    shared_data("fanuc_sweeps/N1N2N3Jval.csv")
    load_script("same_results").prepare(tmp_path)
    nominal = load_robot(tmp_path / "fanuc.toml")
    result = robot_from_sweeps(read_measurements(tmp_path / "fanuc.csv", nominal), nominal)
    rms = [np.sqrt((fit.lengths() ** 2).mean()) for fit in result.fits]  # of the points' vectors
    assert 0.02 < min(rms) <= max(rms) < 0.04
    assert [len(fit.rows) for fit in result.fits] == [18] * 6
    assert not result.notes
    for pair, wanted in zip(result.pairs, (311.45, 1075.58, 226.08), strict=False):
        # other estimators of the same data: they differ by less than the σ of the data
        assert abs(pair.distance_mm - wanted) < pair.distance_sigma_mm + 0.005
        assert 0.02 < pair.distance_sigma_mm < 0.2
    assert [abs(row.a) for row in result.robot.rows[:3]] == pytest.approx([p.distance_mm for p in result.pairs[:3]])
    pair = result.pairs[1]
    assert np.pi - pair.angle_rad == pytest.approx(np.radians(0.0104), abs=2 * pair.angle_sigma_rad)
    assert abs(pair.foot_mm) == pytest.approx(5.9e6, abs=2 * pair.foot_sigma_mm)
    assert pair.parallel
    assert "foot 59" in pair.refused
    assert "1 mm needed" in pair.refused
    assert result.robot.rows[1].beta != 0
    assert [p.refused for p in result.pairs if p.joint != 2] == [""] * 4
    distance, normal = (result.without_one.spread(key)[1] for key in ("distance", "normal"))
    assert len(result.without_one.lines) == 36
    assert 0.005 < distance < 0.1 < 100 < normal


LENGTH_MM = 150.0
UNEVEN = np.array([[120.0, 0, 0], [-120, 0, 0], [0, 160, -40], [0, -160, -40], [0, 0, 80]])
"""Middles of faces, say, about their mean."""
PLACES = {"ring": ring(LENGTH_MM), "uneven": UNEVEN * LENGTH_MM / np.sqrt((UNEVEN**2).sum(axis=1).mean())}


def posed(robot: Robot, q: np.ndarray, sigma: float = 0.0, seed: int = 0) -> Measurements:
    """Poses of one target: σ of position, and of rotation as much at ``LENGTH_MM``."""
    covariance = np.tile(np.diag([(SIGMA / LENGTH_MM) ** 2] * 3 + [SIGMA**2] * 3), (len(q), 1, 1))
    seen = simulated.measured(robot, q, np.random.default_rng(seed), sigma, sigma / LENGTH_MM, ("A",) * len(q))
    return replace(seen, covariance=covariance)


def test_orientations_give_the_pose_of_the_target_too():
    nominal = mh80()
    true = arm(nominal)
    true = replace(true, tools={"A": Rigid.exp([0.3, -0.2, 0.5, 180, 20, 150])})
    places = np.add(UNEVEN, [30.0, 50, -100])
    result = robot_from_sweeps(posed(true, sweep_values(true, rests=2)), nominal, places=places)
    assert list(result.robot.tools) == ["A"]
    q = joint_vectors(nominal, 20, np.random.default_rng(3))
    there = true.world_from_base @ forward(true, q, "A")
    here = result.robot.world_from_base @ forward(result.robot, q, "A")
    assert np.abs(here.difference(there)[:, 3:]).max() < 1e-8
    assert np.abs(here.difference(there)[:, :3]).max() < 1e-10


@pytest.mark.full
@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
def test_orientations_help_and_their_covariance_is_true(places):
    """40 trials of 6 axes of 4 parameters: the mean square over σ² scatters by √(2/960) = 5 %, and by more since axes
    share what the unwinding passes on. Points that share the errors of a pose are not taken for independent."""
    nominal = mh80()
    true = arm(nominal)
    q = sweep_values(true, 5)
    squares, sizes = [], []
    for seed in range(40):
        data = posed(true, q, SIGMA, seed)
        found = [robot_from_sweeps(data, nominal, places=used) for used in (places, None)]
        errors = [errors_of([fit.world_from_axis for fit in each.fits], true) for each in found]
        squares.append(errors[0] @ np.linalg.solve(found[0].covariance, errors[0]) / len(errors[0]))
        sizes.append([np.abs(each.reshape(-1, 4)[:, :2]).mean() for each in errors])
    assert 0.75 < np.mean(squares) < 1.35
    with_them, without = np.mean(sizes, axis=0)
    assert with_them < 0.9 * without
