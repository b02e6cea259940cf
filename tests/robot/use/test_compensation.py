"""Compensation: the identified robot gets to where the nominal one only believes to be; commanded poses and nominal
robots that cannot be meant as they stand, and such as can."""

import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.io.table import POSE, pose_cells
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.measurements import Targets, read_targets
from stcal.robot.kinematics.robot_file import robot_toml
from stcal.robot.kinematics.robot_model import Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made
from stcal.robot.use.compensation import CompensationFile, compensate, compensated_csv, on_targets, robots_apart
from tests.levels import sampled
from tests.outcome import refuses
from tests.shared import write_rows
from tests.support.arms import elastic, scara, targets

pytestmark = pytest.mark.slow

JOINTS = [f"q{i}_deg" for i in range(1, 7)]
FEW = 3


class Case:
    """Nominal and real robot, and 12 commanded poses; ``FEW`` where every branch is sought for each."""

    def __init__(self, folder: Path):
        self.folder = folder
        rng = np.random.default_rng(21)
        tools = {"": Rigid.exp([0, 0, 0, 10, 20, 150]), "ball": Rigid.exp([0, 0.3, 0, -40, 0, 90])}
        self.nominal = replace(mh80(), tools=tools)
        self.real = made(self.nominal, rng)
        self.q = joint_vectors(self.nominal, 12, rng, 0.7)
        self.poses = forward(self.nominal, self.q)

    def write(self, header: Sequence[str], rows: list[list[str]]) -> Path:
        return write_rows(self.folder / "targets.csv", header, rows)

    def read(self, header: Sequence[str], rows: list[list[str]]) -> Targets:
        return read_targets(self.write(header, rows), self.real)

    def pose_rows(self) -> list[list[str]]:
        return [pose_cells(p) for p in self.poses]

    def joint_rows(self) -> list[list[str]]:
        return [[repr(float(v)) for v in np.degrees(row)] for row in self.q]


@pytest.fixture
def case(tmp_path):
    return Case(tmp_path)


def test_joint_values_command_what_the_nominal_robot_makes_of_them_and_poses_need_none(case):
    result = compensate(case.real, targets(None, case.q), case.nominal)
    reached = forward(case.real, result.found.q)
    assert result.found.usable.all()
    np.testing.assert_allclose(reached.translation, case.poses.translation, atol=1e-8)
    np.testing.assert_allclose(result.nominal.q, case.q, atol=1e-9)
    # What is taken away is what the real robot errs with the nominal values: millimetres at 2 m and 0.5 mrad.
    expected = np.linalg.norm(forward(case.real, case.q).translation - case.poses.translation, axis=1)
    np.testing.assert_allclose(result.before_mm, expected, atol=1e-8)
    assert 0.5 < expected.mean() < 5
    # The same branch: others are about π away, and at the wrist 0.5 mrad over 8 mrad of bend are 0.1 rad.
    assert np.abs(result.found.q - case.q).max() < 1
    result = compensate(case.real, targets(case.poses[:FEW]))
    assert result.found.usable.all()
    assert len(result.before_mm) == 0
    np.testing.assert_allclose(forward(case.real, result.found.q).translation, case.poses.translation[:FEW], atol=1e-8)


def test_joint_values_beside_poses_choose_the_branch(case):
    flipped = case.q + np.array([0, 0, 0, np.pi, 0, np.pi])
    flipped[:, 4] *= -1
    flipped[:, 3] -= 2 * np.pi * (flipped[:, 3] > 2 * np.pi)
    found = compensate(case.real, targets(case.poses, flipped)).found
    low, high = case.real.limits().T
    inside = ((flipped > low + 0.1) & (flipped < high - 0.1)).all(axis=1) & (np.abs(case.q[:, 4]) > 0.2)
    assert inside.sum() > 2
    assert np.abs(found.q - flipped)[inside].max() < 0.1


def test_a_tool_that_the_nominal_file_lacks_is_the_identified_ones_but_of_poses_of_the_flange(case):
    """Poses of the flange, with the joint values that the controller has there: the identified tool is not theirs."""
    given, bare = targets(None, case.q[:FEW]), replace(case.nominal, tools={"": Rigid()})
    found = compensate(case.real, given, bare)
    assert re.match(r"tool of the robot files differs by 151\.\d mm and 0° between .* taken in both", found.notes()[0])
    both = compensate(case.real, given, replace(case.nominal, tools=case.real.tools))
    assert not any("differs by" in note for note in both.notes())
    np.testing.assert_allclose(found.found.q, both.found.q, atol=1e-9)
    nameless = compensate(case.real, given, replace(case.nominal, tools={"other": Rigid()})).notes()[0]
    assert "is not in the nominal file: that of the identified file is taken in both" in nameless
    flange = forward(bare, case.q)
    by_flange = compensate(case.real, targets(flange, case.q), bare)
    assert "nominal file is taken in both (joint values beside the poses say so)" in by_flange.notes()[0]
    reached = forward(replace(case.real, tools={"": Rigid()}), by_flange.found.q)
    np.testing.assert_allclose(reached.translation, flange.translation, atol=1e-8)


def test_every_tool_by_its_name(case):
    names = ["ball" if i % 2 else "" for i in range(12)]
    rows = [[n, *q] for n, q in zip(names, case.joint_rows(), strict=True)]
    result = compensate(case.real, case.read(["target", *JOINTS], rows), case.nominal)
    for name in ("ball", ""):
        own = np.array([n == name for n in names])
        wanted, reached = forward(case.nominal, case.q[own], name), forward(case.real, result.found.q[own], name)
        np.testing.assert_allclose(reached.translation, wanted.translation, atol=1e-8)
    real, nominal = (replace(robot, tools={"ball": robot.tools["ball"]}) for robot in (case.real, case.nominal))
    balls = targets(forward(nominal, case.q[:FEW], "ball"), case.q[:FEW], ["ball"] * FEW)
    assert "unreachable" not in compensate(real, balls, nominal).found.status
    rows[3][0] = "cube"
    refuses("E-ROBOT-NO-TOOL … 5 … 'cube' … MH80 … '', 'ball'", case.read, ["target", *JOINTS], rows)


def test_what_is_not_reached_keeps_its_row_without_joint_values_and_none_of_all_is_an_error(case, stcal_robot):
    places = case.poses.translation[:FEW].copy()
    places[1] = [5000, 0, 0]
    result = compensate(case.real, targets(Poses(case.poses.rotation[:FEW], places)), case.nominal)
    assert result.found.status[1] == "unreachable"
    note = result.notes()[0]
    assert note.startswith("line 3: no joint values reach it; ")
    table = list(csv.DictReader(compensated_csv(result, case.real).splitlines()))
    assert len(table) == FEW
    empty = ("q1_deg", "nominal_q1_deg", "nominal_error_mm")
    assert [table[1][c] for c in ("status", *empty)] == ["unreachable", "", "", ""]
    assert float(table[1]["error_mm"]) > 2000
    kept = [0, 2]
    assert all(table[i]["status"] == "reached" for i in kept)
    back = np.radians([[float(table[i][c]) for c in JOINTS] for i in kept])
    # Nine decimals of a degree at 2 m: 2 m · 1.7e-11 · some joints.
    np.testing.assert_allclose(forward(case.real, back).translation, case.poses.translation[kept], atol=1e-6)
    content = CompensationFile.model_validate(result).content()
    assert content["found"]["status"].count("reached") == FEW - 1
    assert content["joints"][1] is None
    far = [pose_cells(Rigid(p.rotation, p.translation + np.array([9000, 0, 0]))) for p in case.poses[:1]]
    (case.folder / "identified.toml").write_text(robot_toml(case.real))
    code, _, error = stcal_robot("compensate", case.write(POSE, far), "--robot", case.folder / "identified.toml")
    assert code == 3
    assert "none of 1 poses is reached" in error


def test_limits_of_the_controller_are_respected_and_a_long_way_near_a_singularity_is_told(case):
    """Wrist bent by 2 mrad: errors of half of that turn its joints by several degrees."""
    joints = [Joint("revolute", q - 1e-5, q + 1e-5) for q in case.q[0]]
    tight = replace(case.real, joints=tuple(joints))
    result = compensate(tight, targets(None, case.q[:1]), case.nominal)
    assert result.found.status == ("limit",)  # errors of 0.5 mrad need more than 0.01 mrad
    assert np.abs(result.found.q[0] - case.q[0]).max() <= 1e-5 + 1e-9
    assert 0.1 < result.found.error_mm[0] < result.before_mm[0]
    assert "beyond the limits" in result.notes()[0]
    q = np.array([[0.3, 0.4, -0.2, 0.5, 2e-3, 0.7]])
    result = compensate(case.real, targets(None, q), case.nominal)
    moved = np.degrees(np.abs(result.found.q - q).max())
    assert moved > 1
    assert result.notes() == [f"line 2: a joint moves by {moved:.1f}°: near a singular pose"]


@pytest.mark.parametrize("nominal", sampled([False, True]))
def test_a_joint_at_its_limit_does_not_turn_the_wrist_over(case, nominal):
    """J4 commanded to its limit, beyond which this arm would have to take it: J4 + 180° with the wrist bent the other
    way is within the limits, and no compensation."""
    at = np.radians(-150.0)
    q = case.q[:10].copy()
    q[:, 3], q[:, 4] = at, np.where(np.abs(q[:, 4]) < 0.3, 0.5, np.abs(q[:, 4]))
    joints = [replace(j, lower=at, upper=-at) if i == 3 else j for i, j in enumerate(case.nominal.joints)]
    real, drawn = (replace(robot, joints=tuple(joints)) for robot in (case.real, case.nominal))
    result = compensate(real, targets(forward(drawn, q), q), drawn if nominal else None)
    stopped = np.array([status == "limit" for status in result.found.status])
    assert stopped.sum() > 5
    assert np.abs(result.found.q - q).max() < 0.1
    assert np.allclose(result.found.q[stopped, 3], at, atol=1e-6)
    told = [note for note in result.notes() if "beyond the limits" in note]
    assert len(told) == stopped.sum()
    assert all(re.search(r"\(J4 at -150\.\d+°, limit -150°\)", note) for note in told)


def test_bad_targets_are_named_and_each_row_is_compensated_for_its_payload(case):
    refuses("E-TARGETS-NO-POSES … x_mm", case.read, ["a", "b"], [["1", "2"]])
    refuses("E-TARGETS-NO-ORIENTATION", case.read, POSE[:3], [["1", "2", "3"]])
    refuses("E-TARGETS-NO-POSES … --nominal", compensate, case.real, targets(None, case.q))
    for poses, tools in ((case.poses, ("",)), (case.poses[:1], ("",) * 2)):
        refuses("E-NAMES-COUNT … t.csv: 1", Targets, "t.csv", range(2), tools, poses, None)
    shorter = replace(case.nominal, rows=case.nominal.rows[:5], joints=case.nominal.joints[:5], coupling=None)
    refuses("E-ROBOT-MISMATCH", compensate, case.real, targets(case.poses), shorter)
    for cell, option, message in (("-2", None, "E-PAYLOAD-VALUE … 2 … -2"), ("2", 3.0, "E-OPTION-CONFLICT … 3")):
        path = case.write([*POSE, "payload_kg"], [[*case.pose_rows()[0], cell]])
        refuses(message, read_targets, path, case.real, payload_kg=option)
    bent = elastic(case.real, np.random.default_rng(4))
    mass, poses = np.tile([0.0, 80.0], 2), case.poses[:4]
    at = zip(case.pose_rows()[:4], case.joint_rows()[:4], mass, strict=True)
    rows = [[*row, *q, f"{m:g}"] for row, q, m in at]
    result = compensate(bent, case.read([*POSE, *JOINTS, "payload_kg"], rows), case.nominal)
    assert set(result.found.status) == {"reached"}
    reached = forward(bent, result.found.q, payload_kg=mass)
    assert np.abs(poses.difference(reached)[:, 3:]).max() < 1e-8
    assert np.linalg.norm(poses.difference(forward(bent, result.found.q))[1::2, 3:], axis=1).min() > 0.02
    table = list(csv.DictReader(compensated_csv(result, bent).splitlines()))
    assert [row["payload_kg"] for row in table[:2]] == ["0", "80"]


def test_files_or_axes_that_are_exchanged_the_same_file_and_radians_without_poses_are_told(case):
    given = targets(None, case.q[:1])
    good = compensate(case.real, given, case.nominal).notes()
    assert not any("as drawn" in note or "are the same" in note for note in good)
    assert "as if they were exchanged" in compensate(case.nominal, given, case.real).notes()[0]
    assert "are the same, so that nothing is compensated" in compensate(case.real, given, case.real).notes()[0]
    q, exchanged = case.q[:FEW], Poses(case.poses.rotation[:FEW], case.poses.translation[:FEW][:, [1, 0, 2]])
    refuses("E-ROBOT-MISMATCH … if x, y, z were y, x, z", compensate, case.real, targets(exchanged, q), case.nominal)
    notes = compensate(case.real, targets(None, np.radians(q)), case.nominal).notes()
    assert any("as of radians in columns of degrees" in note for note in notes)


TOOL = Rigid.exp([0.2, -0.4, 0.1, 30, -20, 180])


def arm(seed: int, size: float = 1.0) -> Robot:
    rng, nominal = np.random.default_rng(seed), mh80()
    rows = (
        replace(r, a=r.a * size * rng.uniform(0.7, 1.3), d=r.d * size * rng.uniform(0.7, 1.3)) for r in nominal.rows
    )
    return replace(nominal, rows=tuple(rows), tools={"": TOOL})


def sliding(_: int) -> Robot:
    return replace(scara(), tools={"": TOOL})


def commanded(robot: Robot, count: int, seed: int, share: float = 0.6) -> tuple[np.ndarray, Poses]:
    q = joint_vectors(robot, count, np.random.default_rng(seed), share)
    return q, forward(robot, q)


def times(poses: Poses, factor: float) -> Poses:
    return Poses(poses.rotation, factor * poses.translation)


@pytest.mark.parametrize(
    ("make", "count", "share"),
    sampled([(make, *each) for make in (arm, sliding) for each in ((1, 0.02), (1, 0.6), (2, 0.02), (30, 0.6))], (0, 7)),
)
def test_good_targets_and_arms_as_made_pass(make, count, share):
    """Far apart and all near one another; with their own joint values, with others that choose a branch, with none."""
    for seed in range(3):
        nominal, rng = make(seed), np.random.default_rng([seed, count])
        q, poses = commanded(nominal, count, seed, share)
        assert on_targets(nominal, targets(poses, q)) == (True, ())
        assert on_targets(nominal, targets(poses)) == (False, ())
        on_targets(nominal, targets(poses, q + rng.normal(0, 0.3, q.shape)))
        on_targets(nominal, targets(poses, q + np.where(np.arange(q.shape[1]) == q.shape[1] - 1, np.pi, 0)))
        on_targets(nominal, targets(poses, np.zeros_like(q)))
        moved = replace(made(nominal, rng, 1.0, 2e-3), tools={"": Rigid()}, world_from_base=TOOL)
        assert robots_apart(moved, nominal) == ""


def test_one_orientation_fits_in_every_convention_and_joint_values_that_lead_elsewhere_are_said():
    """The tool points down in all rows, whatever the last joint's value is said to be."""
    nominal = arm(1)
    q, poses = commanded(nominal, 8, 1)
    down = np.repeat(Rotation.from_euler("xz", [180, 40], degrees=True).as_matrix()[None], 8, axis=0)
    _, notes = on_targets(nominal, targets(Poses(down, poses.translation), q))
    assert [note.split(",")[0] for note in notes] == ["joint values of 8 of 8 rows"]
    nominal = arm(2)
    q, poses = commanded(nominal, 6, 2)
    other = q.copy()
    other[3:] = commanded(nominal, 3, 9)[0]
    confirmed, notes = on_targets(nominal, targets(poses, other))
    assert not confirmed
    assert "joint values of 3 of 6 rows, first line 5, lead elsewhere than their poses, by" in notes[0]


@pytest.mark.parametrize(
    ("factor", "words", "count"), [(1e-3, "metres, call the columns x_m", 1), (1 / 25.4, "inches", 12)]
)
def test_targets_in_the_arms_foot_are_said(factor, words, count):
    for seed in range(4):
        nominal = arm(seed, 0.3 + 0.4 * seed)
        _, notes = on_targets(nominal, targets(times(commanded(nominal, count, seed)[1], factor)))
        assert len(notes) == 1
        assert "of the base's origin, where no arm works that reaches" in notes[0]
        assert words in notes[0]


def test_a_nominal_robot_of_another_arm_is_refused_and_files_unusually_far_apart_are_said():
    """Zeros off by 1° in all joints: 2 % of the reach."""
    nominal = arm(4)
    real = made(nominal, np.random.default_rng(4))
    q, poses = commanded(nominal, 3, 4)
    for given in (targets(poses, q), targets(poses), targets(None, q)):
        refuses("E-ROBOT-MISMATCH", compensate, real, given, arm(5))
    off = replace(nominal, rows=tuple(replace(r, theta=r.theta + np.radians(1.0)) for r in nominal.rows))
    notes = compensate(off, targets(poses, q), nominal).notes()
    assert "more than arms are off their drawing (1% of the reach): are both files of this robot?" in notes[0]
    assert not any("apart" in note for note in compensate(real, targets(poses, q), nominal).notes())
