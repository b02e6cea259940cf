"""The test of the paper: distances from the first position, before and after."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from stcal.geometry.rigid import Rigid
from stcal.robot.robot_report import verification_report
from stcal.robot.use.evaluation import MeasuredPoses, Verification, VerificationFile, read_measured, verify
from tests.outcome import refuses
from tests.shared import written

HEAD = "set,commanded_x_mm,commanded_y_mm,commanded_z_mm,x_mm,y_mm,z_mm"
COMMANDED = np.array([[0, 0, 0], [30, 0, 0], [0, 40, 0], [0, 0, 50], [60, 80, 0]], float)
MOVED = Rigid.exp([0.4, -1.0, 2.0, 500.0, -300.0, 90.0])
SHIFTS = {"before": [0.0, 0.3, -0.4, 0.2, 0.5], "after": [0.0, 0.1, -0.1, 0.2, 0.0]}
"""Each position is moved so far along its line from the first one."""


def measured(name: str) -> np.ndarray:
    """In another frame, so that positions compare only by distances."""
    length = np.linalg.norm(COMMANDED, axis=1)
    along = COMMANDED / np.where(length, length, 1)[:, None]
    return MOVED @ (COMMANDED + along * np.array(SHIFTS[name])[:, None])


def read(folder: Path, lines: list[str], head: str = HEAD) -> MeasuredPoses:
    return read_measured(written(folder / "measured.csv", "\n".join([head, *lines]) + "\n"))


def lines_of(name: str, leave_out: int | None = None) -> list[str]:
    rows = zip(COMMANDED, measured(name), strict=True)
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
    off = pdist(measured("before")) - pdist(COMMANDED)
    assert before.pairs_rms_mm == pytest.approx(np.sqrt(np.mean(off**2)))
    text = verification_report(result).text()
    assert "RMS over all pairs depends less on any one" in text
    assert "0.3500" in text
    assert "71.4 %" in text


def test_a_missing_pose_is_named_and_left_out_of_all_and_poses_by_name_stand_in_any_order(tmp_path):
    result = verify(read(tmp_path, lines_of("before") + lines_of("after", leave_out=2)))
    assert result.poses == ("1", "2", "4", "5")
    assert result.missing == {"before": (), "after": ("3",)}
    assert "set after: missing poses, left out of all sets (1): 3" in result.warnings()
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


def test_too_few_and_other_units_are_named(tmp_path):
    refuses("E-VERIFY-FEW … 2 … before", verify, read(tmp_path, lines_of("before")[:2]))
    inches = read(tmp_path, lines_of("before"), HEAD.replace(",x_mm,y_mm,z_mm", ",x_in,y_in,z_in"))
    [warning] = verify(inches).warnings()
    assert "times the commanded ones; check units" in warning
    assert verify(read(tmp_path, lines_of("before"))).warnings() == []
    still = [f"before,1,2,3,{i},0,0" for i in range(4)]
    refuses("E-VERIFY-ALIKE", verify, read(tmp_path, still))
    refuses("E-TABLE-COLUMN-MISSING … commanded_x_mm", read, tmp_path, ["1,2,3"], "x_mm,y_mm,z_mm")


@pytest.mark.parametrize(("off_mm", "warned"), [(0.01, False), (15.0, False), (4100.0, True)])
def test_commands_of_another_robot_are_said(off_mm, warned):
    """Distances that miss the commanded ones, though they are as long in all: no other unit."""
    rng = np.random.default_rng(3)
    commanded, away = rng.uniform(-1000, 1000, (40, 3)), rng.normal(0, 1, (40, 3))
    wrong = commanded + off_mm * away / np.linalg.norm(away, axis=1, keepdims=True)
    warnings = verified(commanded, a=wrong / verified(commanded, a=wrong).sets[0].scale).warnings()
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
    assert ten_of_two_sets(1.0, 0.1).warnings() == []
    assert "set after errs more than set before" in " ".join(ten_of_two_sets(0.1, 1.0).warnings()).replace(": ", " ")
    assert "errs as set before does" in ten_of_two_sets(1.0, 1.0).warnings()[0]
    ten = np.random.default_rng(6).uniform(-500, 500, (10, 3))
    larger = verified(ten, a=1.002 * ten)
    assert "1.00200 times the commanded ones, which is most of its error" in larger.warnings()[0]
    assert "are the commanded ones to the last digit" in ten_of_two_sets(0.0, 0.1).warnings()[0]
    both = ten_of_two_sets(1.0, 0.0)
    assert "set after: measured positions are the commanded ones" in both.warnings()[0]
    exact = ten_of_two_sets(0.0, 0.0)  # no error, and no reduction of it
    assert np.isnan(exact.reduction(1)["mean"])
    json.dumps(VerificationFile.model_validate(exact).content(), allow_nan=False)


def test_wrong_poses_are_named():
    """The first pose is in all distances from it: its error looks like one of all others."""
    none = np.zeros((10, 3))
    far, little = none + [0, 300, 0] * (np.arange(10) == 4)[:, None], none + [0, 5, 0] * (np.arange(10) == 0)[:, None]
    assert ten_poses(lambda at: at) == ""
    exchanged = ten_poses(lambda at: at[[0, 1, 6, 3, 4, 5, 2, 7, 8, 9]])
    assert exchanged == "set after: poses P3, P7: not where commanded, the others are; correct or remove"
    wrong = ten_poses(lambda at: at + far)
    assert wrong == "set after: pose P5: not where commanded, the others are; correct or remove"
    assert ten_poses(lambda at: at + little).startswith("set after: pose P1 (")
    late = ten_poses(lambda at: np.roll(at, 1, axis=0))
    assert "check units and the order of the poses" in late
    assert "check units and the order" in ten_poses(lambda at: 1.1 * at)
    assert "as if the commanded ones were inches" in ten_poses(lambda at: 25.4 * at)
