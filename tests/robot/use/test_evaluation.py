"""Robot files on measurements that they were not made from; and the test of the paper: distances from the first
position, before and after."""

import json
import re
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.measurements import Measurements, read_measurements
from stcal.robot.kinematics.robot_model import Joint, Robot, mh80
from stcal.robot.robot_report import evaluated_csv, evaluation_report, names_of, verification_report
from stcal.robot.simulated import joint_vectors, made, measured, placed
from stcal.robot.use.evaluation import MeasuredPoses, Verification, evaluate, read_measured, verify
from tests.levels import sampled
from tests.outcome import refuses
from tests.robot.identification.test_solve import of_distances
from tests.shared import written

BASE, TOOL = Rigid.exp([0.1, -0.05, 2.1, 2500.0, -900.0, 400.0]), Rigid.exp([0, 0.1, 0, 220, 60, 150])
SIGMA_MM = 0.05


def arm(seed: int = 0) -> Robot:
    return placed(made(mh80(), np.random.default_rng(seed)), BASE, {"": TOOL})


def seen(robot: Robot, seed: int, count: int = 40, poses: bool = False, **noise) -> Measurements:
    rng = np.random.default_rng(1000 + seed)
    data = measured(robot, joint_vectors(robot, count, rng), rng, **{"sigma_mm": SIGMA_MM} | noise)
    return data if poses else replace(data, rotations=None)


def test_figures_by_hand_and_files_by_their_names():
    true = arm()
    data = seen(true, 2, sigma_mm=0.0)
    off = np.zeros((40, 3))
    off[:, 0] = 0.1 * np.arange(40)
    away = off @ BASE.rotation.T  # along x of the base
    [found] = evaluate({"a": true}, replace(data, positions=data.points() + away), "none").robots
    assert found.residuals == pytest.approx(off, abs=1e-9)
    rms = np.sqrt(0.01 * (39 * 40 * 79 / 6) / 40)
    assert astuple(found.position_mm) == pytest.approx((40, 1.95, 1.95, rms, 0.95 * 3.9, 3.9))
    assert names_of([Path("a/robot.toml"), Path("a/made.toml")]) == ["robot", "made"]
    assert names_of([Path("a/robot.toml"), Path("b/robot.toml")]) == ["a/robot.toml", "b/robot.toml"]
    refuses("E-OPTION-REPEATED", names_of, [Path("a.toml"), Path("a.toml")])


def test_base_and_tool_are_fitted_by_the_robots_own_axes_and_the_better_robot_is_named_with_its_error():
    """Nominal and true arm on 60 new poses; the true one elsewhere, with another tool."""
    elsewhere = placed(arm(), Rigid.exp([0, 0, 1, 100, 200, 300]), {"": Rigid.exp([0, 0, 0, 0, 0, 100])})
    robots = {"nominal": replace(mh80(), tools={"": TOOL}), "true": elsewhere}
    pair = evaluate(robots, seen(arm(), 1, 60, poses=True))
    nominal, true = pair.robots
    # noise of three coordinates, less what 9 parameters take up of 180
    assert true.position_mm.rms == pytest.approx(SIGMA_MM * np.sqrt(3 * (1 - 9 / 180)), rel=0.15)
    assert nominal.position_mm.rms > 0.3
    assert true.orientation_rad.rms == pytest.approx(2e-4 * np.sqrt(3), rel=0.2)
    base, tool = true.placed
    for each, pose in ((base, BASE), (tool, TOOL)):
        off = each.pose.translation - pose.translation
        assert (np.abs(off) < 4.5 * each.sigma[3:]).all()
        assert (each.sigma[3:] < 0.1).all()
    turned = (base.pose @ BASE.inverse()).log()[:3]
    assert (np.abs(turned) < 4.5 * base.sigma[:3]).all()
    [difference] = pair.differences
    assert (difference.better, difference.worse) == ("true", "nominal")
    assert pair.best == "true"
    apart = nominal.errors_mm - true.errors_mm
    assert difference.mm == pytest.approx(apart.mean())
    assert difference.sigma_mm == pytest.approx(apart.std(ddof=1) / np.sqrt(60))
    assert "true is better than nominal: mean error " in evaluation_report(pair).text()


@pytest.mark.parametrize("wrong", ["base", "tool"])
def test_only_what_is_asked_for_is_fitted(wrong):
    """In place within a degree and 5 mm, one of the two is taken from its file."""
    true = arm()
    small = Rigid.exp([0.01, 0, 0.01, 5, 0, -5])
    robot = placed(true, BASE @ small if wrong == "base" else BASE, {"": TOOL @ small if wrong == "tool" else TOOL})
    data = seen(true, 3)
    rms = {refit: evaluate({"a": robot}, data, refit).robots[0].position_mm.rms for refit in REFITS}
    for refit, found in rms.items():
        if wrong in refit:
            assert found == pytest.approx(SIGMA_MM * np.sqrt(3), rel=0.25)
        else:
            assert 1 < found < 40
    fixed = evaluate({"a": robot}, data, "tool" if wrong == "base" else "base").robots[0].robot
    given, found = (each.world_from_base if wrong == "base" else each.tools[""] for each in (robot, fixed))
    assert found.matrix() == pytest.approx(given.matrix())


REFITS = ("none", "base", "tool", "base-tool")


@pytest.mark.full
def test_equal_robots_are_told_apart_seldom():
    """Files that are off alike, by chance: at 5 %, of 60 pairs more than eight once in 200 runs."""
    true, named = arm(), 0
    for seed in range(60):
        robots = {str(k): made(true, np.random.default_rng(10 * seed + k), 0.02, 2e-5) for k in (1, 2)}
        result = evaluate(robots, seen(true, seed, 25, sigma_mm=0.2), "base-tool")
        named += bool(result.best)
    assert named <= 8
    same = evaluate({"a": true, "b": true}, seen(true, 1))
    assert same.best == ""
    assert "a and b differ by no more than chance" in evaluation_report(same).text()


def test_wrong_rows_are_named_and_not_fitted_to_and_what_a_file_leaves_is_said():
    true, data = arm(), seen(arm(), 4)
    positions = data.points().copy()
    positions[[7, 20]] += [[0, 30.0, 0], [5.0, 0, 0]]
    result = evaluate({"nominal": replace(mh80(), tools={"": TOOL}), "true": true}, replace(data, positions=positions))
    assert result.wrong_lines == [9, 22]
    clean = evaluate({"true": true}, data[~result.wrong]).robots[0]
    own = result.robots[1]
    assert own.errors_mm[~result.wrong] == pytest.approx(clean.errors_mm, abs=1e-6)
    assert own.errors_mm[7] == pytest.approx(30, abs=0.5)
    text = evaluation_report(result).text()
    assert "rows that no robot explains (the least error that any of them leaves): line 9 (" in text
    assert "line 22 (" in text
    plain, robust = (line.split() for line in text.splitlines() if line.startswith(("true  ", "true, ")))
    assert plain[1] == "40"
    assert robust[3] == "38"
    assert float(plain[4]) > 3 > 0.2 > float(robust[6])
    true = arm()
    rows = tuple(replace(row, theta=row.theta + 1e-3 * (i == 2)) for i, row in enumerate(true.rows))
    result = evaluate({"a": replace(true, rows=rows)}, seen(true, 5, 60))
    [found] = result.robots
    assert [each.what for each in found.left][:1] == ["the zero of joint 3"]
    assert found.beyond == ()
    text = evaluation_report(result).text()
    assert "a: residuals go with the zero of joint 3: " in text
    assert "a: parameters identified from these rows would explain all of it" in text
    [clean] = evaluate({"a": true}, seen(true, 5, 60)).robots
    assert clean.left == ()


@pytest.mark.parametrize("sets", sampled([4, 40]))
def test_clean_rows_are_hardly_ever_wrong(sets):
    robots = [arm(seed) for seed in range(sets)]
    assert sum(evaluate({"a": robot}, seen(robot, seed)).wrong.sum() for seed, robot in enumerate(robots)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("refit", ["none", "base-tool"])
def test_distances_have_their_own_errors(refit):
    true = arm()
    data = of_distances(seen(true, 8, 50))
    result = evaluate({"a": true, "nominal": replace(mh80(), tools={"": TOOL})}, data, refit)
    assert len(result.wrong) == 49
    # two positions, the first in all: σ of one distance is √2 times a coordinate's
    assert 0.6 * SIGMA_MM < result.robots[0].position_mm.rms < 2 * SIGMA_MM
    assert result.best == "a"
    assert "49 distances" in evaluation_report(result).text()


@pytest.mark.slow
def test_another_arm_is_refused_in_one_line():
    data = seen(arm(), 9)
    other = Robot("other", "standard", mh80().rows[:3], (Joint(),) * 3)
    refuses("E-ROBOT-MISMATCH … 6 … 3", evaluate, {"a": arm(), "b": other}, data)
    rows = tuple(replace(row, alpha=-row.alpha) for row in mh80().rows)
    refuses("E-IDENTIFY-MISFIT", evaluate, {"a": arm(), "b": replace(mh80(), rows=rows)}, data)
    refuses("E-IDENTIFY-MISFIT", evaluate, {"a": mh80()}, data, "none")
    refuses("E-ROBOT-NO-TOOL … 'ball'", evaluate, {"a": arm()}, replace(data, targets=("ball",) * 40), "base")
    refuses("E-IDENTIFY-FEW … 3 … position … 9 … 9 … base and tool", evaluate, {"a": arm()}, data[:3])


def test_identify_and_verify_read_what_was_written(tmp_path):
    true = arm()
    data = seen(true, 10, 40, poses=True)
    again = read_measurements(written(tmp_path / "rows.csv", evaluated_csv(evaluate({"my robot": true}, data))), true)
    assert again.q == pytest.approx(data.q, abs=1e-10)
    assert again.points() == pytest.approx(data.points(), abs=1e-6)
    assert again.poses().difference(data.poses()) == pytest.approx(np.zeros((40, 6)), abs=1e-6)
    verified = verify(read_measured(tmp_path / "rows.csv")).sets[0]
    assert 0.5 * SIGMA_MM < verified.mean_mm < 3 * SIGMA_MM
    distances = of_distances(data)
    (tmp_path / "d.csv").write_text(evaluated_csv(evaluate({"a": true, "b": mh80()}, distances, "tool")))
    read = read_measurements(tmp_path / "d.csv", true)
    assert read.lengths()[0] == pytest.approx(distances.lengths()[0], abs=1e-6)
    assert (read.lengths()[1] == 0).all()


def test_stations_leave_base_and_tool_as_they_are_and_errors_in_its_axes():
    """Half of the rows from another station, turned by a quarter: without a fit, all is as from one, but for what the
    place of the second station takes up."""
    true, turned = arm(), Rigid.exp([0.0, 0.0, np.pi / 2, 500.0, 0.0, 0.0])
    data = seen(true, 5, sigma_mm=0.0)
    off = np.zeros((40, 3))
    off[:, 0] = np.tile([0.1, -0.1], 20)
    points = data.points() + off @ BASE.rotation.T
    second = np.arange(40) % 4 >= 2
    there = np.where(second[:, None], turned @ points, points)
    apart = replace(data, positions=there, stations=tuple(np.where(second, "B", "A").tolist()))
    other_tool = placed(true, BASE, {"": TOOL @ Rigid.exp([0, 0, 0, 5.0, 0, 0])})
    [found, other] = evaluate({"a": true, "b": other_tool}, apart, "none").robots
    assert found.residuals == pytest.approx(off, abs=0.09)  # across, as of other axes: 0.1
    assert np.array_equal(other.robot.tools[""].matrix(), other_tool.tools[""].matrix())


HEAD = "set,commanded_x_mm,commanded_y_mm,commanded_z_mm,x_mm,y_mm,z_mm"
COMMANDED = np.array([[0, 0, 0], [30, 0, 0], [0, 40, 0], [0, 0, 50], [60, 80, 0]], float)
MOVED = Rigid.exp([0.4, -1.0, 2.0, 500.0, -300.0, 90.0])
SHIFTS = {"before": [0.0, 0.3, -0.4, 0.2, 0.5], "after": [0.0, 0.1, -0.1, 0.2, 0.0]}
"""Each position is moved so far along its line from the first one."""


def measured_mm(name: str) -> np.ndarray:
    """In another frame, so that positions compare only by distances."""
    length = np.linalg.norm(COMMANDED, axis=1)
    along = COMMANDED / np.where(length, length, 1)[:, None]
    return MOVED @ (COMMANDED + along * np.array(SHIFTS[name])[:, None])


def read(folder: Path, lines: list[str], head: str = HEAD) -> MeasuredPoses:
    return read_measured(written(folder / "measured.csv", "\n".join([head, *lines]) + "\n"))


def lines_of(name: str, leave_out: int | None = None) -> list[str]:
    rows = zip(COMMANDED, measured_mm(name), strict=True)
    return [
        f"{name}," + ",".join(f"{v!r}" for v in [*c.tolist(), *m.tolist()])
        for i, (c, m) in enumerate(rows)
        if i != leave_out
    ]


def test_figures_by_hand(tmp_path):
    result = verify(read(tmp_path, lines_of("before") + lines_of("after")))
    before, after = result.sets
    np.testing.assert_allclose(before.error_mm, [0.3, -0.4, 0.2, 0.5], atol=1e-9)
    np.testing.assert_allclose(result.distance_mm, [30, 40, 50, 100])
    assert before.mean_mm == pytest.approx(0.35)
    assert before.std_mm == pytest.approx(np.sqrt((0.05**2 + 0.05**2 + 0.15**2 + 0.15**2) / 3))
    assert before.max_mm == pytest.approx(0.5)
    assert after.mean_mm == pytest.approx(0.1)
    reduced = result.reduction(1)
    assert reduced["mean"] == pytest.approx(100 * (1 - 0.1 / 0.35))
    assert reduced["max"] == pytest.approx(60)
    off = pdist(measured_mm("before")) - pdist(COMMANDED)
    assert before.pairs_rms_mm == pytest.approx(np.sqrt(np.mean(off**2)))
    text = verification_report(result, "t").text()
    assert "RMS over all pairs depends less on any one" in text
    assert "0.3500" in text
    assert "71.4 %" in text


def test_a_missing_pose_is_named_and_left_out_of_all_and_poses_by_name_stand_in_any_order(tmp_path):
    result = verify(read(tmp_path, lines_of("before") + lines_of("after", leave_out=2)))
    assert result.poses == ["1", "2", "4", "5"]
    assert result.missing == {"before": [], "after": ["3"]}
    assert "set after: missing poses, left out of all sets (1): 3" in result.warnings
    np.testing.assert_allclose(result.sets[0].error_mm, [0.3, 0.2, 0.5], atol=1e-9)
    head = "pose," + HEAD
    names = ["a", "b", "c", "d", "e"]
    before = [f"{n},{row}" for n, row in zip(names, lines_of("before"), strict=True)]
    after = [f"{n},{row}" for n, row in zip(names, lines_of("after"), strict=True)][::-1]
    result = verify(read(tmp_path, before + after, head))
    np.testing.assert_allclose(result.sets[1].error_mm, [0.1, -0.1, 0.2, 0.0], atol=1e-9)
    twice = verify(read(tmp_path, [*lines_of("before"), lines_of("before")[0]]))
    assert len(twice.poses) == 6  # without names the same command twice is two poses
    assert twice.sets[0].error_mm[-1] == pytest.approx(0, abs=1e-9)
    refuses("E-TABLE-ROW-REPEATED … 7 … before … 2", read, tmp_path, [*before, before[0]], head)
    moved = [row.replace("after,30", "after,31") for row in after]
    refuses("E-VERIFY-COMMANDED … 1 … before … after", verify, read(tmp_path, before + moved, head))


def test_too_few_poses_other_units_and_wrong_poses_are_named(tmp_path):
    """The first pose is in all distances from it: its error looks like one of all others."""
    refuses("E-VERIFY-FEW … 2 … before", verify, read(tmp_path, lines_of("before")[:2]))
    inches = read(tmp_path, lines_of("before"), HEAD.replace(",x_mm,y_mm,z_mm", ",x_in,y_in,z_in"))
    [warning] = verify(inches).warnings
    assert "times the commanded ones, which is most of their error: check units" in warning
    assert verify(read(tmp_path, lines_of("before"))).warnings == []
    still = [f"before,1,2,3,{i},0,0" for i in range(4)]
    refuses("E-VERIFY-ALIKE", verify, read(tmp_path, still))
    refuses("E-TABLE-COLUMN-MISSING … commanded_x_mm", read, tmp_path, ["1,2,3"], "x_mm,y_mm,z_mm")
    none = np.zeros((10, 3))
    far, little = none + [0, 300, 0] * (np.arange(10) == 4)[:, None], none + [0, 5, 0] * (np.arange(10) == 0)[:, None]
    assert ten_poses(lambda at: at) == ""
    exchanged = ten_poses(lambda at: at[[0, 1, 6, 3, 4, 5, 2, 7, 8, 9]])
    assert exchanged.startswith("set after: poses P3 (")
    assert "P7 (" in exchanged
    assert re.findall(r"P\d+", exchanged) == ["P3", "P7"]
    wrong = ten_poses(lambda at: at + far)
    assert wrong.startswith("set after: pose P5 (")
    assert ten_poses(lambda at: at + little).startswith("set after: pose P1 (")
    few = verified(COMMANDED * 10, a=COMMANDED * 10 + [[0, 0, 0], [0, 0, 0], [200, 0, 0], [0, 0, 0], [0, 0, 0.1]])
    assert few.warnings[0].startswith("set a: pose P3 (")
    late = ten_poses(lambda at: np.roll(at, 1, axis=0))
    assert "check the order of the poses" in late
    assert "check units" in ten_poses(lambda at: 1.1 * at)
    inches = ten_poses(lambda at: 25.4 * at)  # to the noise of 0.2 mm
    assert re.search(r"measured distances are 25\.[34]\d* times the commanded ones.*check units", inches)


@pytest.mark.parametrize(("off_mm", "warned"), [(0.01, False), (15.0, False), (4100.0, True)])
def test_commands_of_another_robot_are_said(off_mm, warned):
    """Distances that miss the commanded ones, though they are as long in all: no other unit."""
    rng = np.random.default_rng(3)
    commanded, away = rng.uniform(-1000, 1000, (40, 3)), rng.normal(0, 1, (40, 3))
    wrong = commanded + off_mm * away / np.linalg.norm(away, axis=1, keepdims=True)
    warnings = verified(commanded, a=wrong / verified(commanded, a=wrong).sets[0].scale).warnings
    assert len(warnings) == warned
    assert all("set a: measured distances miss the commanded ones by" in warning for warning in warnings)


def verified(commanded: np.ndarray, **sets: np.ndarray) -> Verification:
    """Of sets of poses P1, P2 … that are commanded to (m, 3) and measured at (m, 3)."""
    m, names = len(commanded), tuple(f"P{i}" for i in range(1, len(commanded) + 1)) * len(sets)
    of_sets, every = np.repeat(list(sets), m).tolist(), np.tile(commanded, (len(sets), 1))
    return verify(
        MeasuredPoses("t", range(2, len(names) + 2), tuple(of_sets), names, every, np.vstack([*sets.values()]))
    )


def ten_poses(change) -> str:
    """What is doubted of ten poses in a metre, measured in another frame to 0.2 mm, with ``change`` made to them."""
    rng = np.random.default_rng(4)
    commanded = rng.uniform(-500, 500, (10, 3))
    at = MOVED @ (commanded + rng.normal(0, 0.2, commanded.shape))
    return verified(commanded, after=change(at)).sets[0].doubt()


def ten_of_two_sets(first, second) -> Verification:
    """Ten poses in two sets, each measured to ``first`` and ``second`` mm in the robot's frame."""
    rng = np.random.default_rng(5)
    commanded = rng.uniform(-500, 500, (10, 3))
    before, after = (commanded + rng.normal(0, sigma, commanded.shape) for sigma in (first, second))
    return verified(commanded, before=before, after=after)


def test_sets_in_the_wrong_order_and_positions_that_are_copies_are_named():
    assert ten_of_two_sets(1.0, 0.1).warnings == []
    for before, words in ((0.1, "no less than set before"), (1.0, "hardly less than set before")):
        assert words in ten_of_two_sets(before, 1.0).warnings[0]
    ten = np.random.default_rng(6).uniform(-500, 500, (10, 3))
    larger = verified(ten, a=1.002 * ten)
    assert "1.002 times the commanded ones, which is most of their error" in larger.warnings[0]
    both = verified(ten, a=1.002 * ten, b=1.002 * ten + 1e-3).warnings
    assert "set b: errs by" in both[2]
    noisy = verified(ten, a=1.01 * ten + np.random.default_rng(0).normal(0, 6, ten.shape))
    assert re.search(r"are 1\.0[01]\d+ times the commanded ones, 0\.995 to 1\.005 allowed", noisy.warnings[0])
    assert "are the commanded ones to the last digit" in ten_of_two_sets(0.0, 0.1).warnings[0]
    both = ten_of_two_sets(1.0, 0.0)
    assert "set after: measured positions are the commanded ones" in both.warnings[0]
    exact = ten_of_two_sets(0.0, 0.0)  # no error, and no reduction of it
    assert np.isnan(exact.reduction(1)["mean"])
    json.dumps(exact.content(), allow_nan=False)
