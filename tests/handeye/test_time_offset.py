"""The clocks' offset: found with true σ where the robot moves, refused where it stands. Poses by time: interpolated
where samples are close, the nearest within a tolerance, and all else said."""

import json
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.geometry.rigid import Poses
from stcal.handeye.data.pose_content import PoseSide
from stcal.handeye.data.pose_pairs import SETUPS
from stcal.handeye.data.stream import Stream, stamps_of, taken_at, time_of
from stcal.handeye.time_offset import estimate_offset
from stcal.workflows.handeye_inputs import Files, robot_at_images
from tests.handeye.photographed import BOARD
from tests.handeye.test_cli import in_sigmas
from tests.handeye.written import table, trajectory, two
from tests.outcome import INPUT, assert_error, refuses
from tests.shared import written
from tests.support.handeye import StreamTruth, disturbed, handeye, simulated_stream, squared, swing


def squares(truth: StreamTruth) -> tuple[float, float]:
    """Errors of the offset and of X (over six numbers), in units of σ²."""
    found = estimate_offset(truth.pairs, truth.stream, truth.seconds, truth.setup)
    pairs = replace(truth.pairs[np.flatnonzero(found.kept)], base_from_flange=found.base_from_flange)
    result = found.carried(handeye(pairs, truth.setup, "pose"))
    off_s = found.seconds - truth.offset_s
    return off_s**2 / found.sigma_s**2, squared(result, truth) / 6


@pytest.mark.full
@pytest.mark.parametrize("setup", SETUPS)
def test_the_offset_knows_its_error(setup):
    """120 trials with σ estimated of 20 images: χ² of one number and of six, once in 10⁴ beyond, with a tail of t."""
    trials = 120
    found = np.mean(
        [squares(simulated_stream(np.random.default_rng([k, 5]), 20, setup)) for k in range(trials)], axis=0
    )
    for value, numbers in zip(found, (1, 6), strict=True):
        low, high = chi2.ppf([1e-4, 1 - 1e-4], numbers * trials) / (numbers * trials)
        assert 0.9 * low < value < 1.15 * high


@pytest.mark.parametrize("samples", [0.02, 0.1])
def test_a_robot_that_stands_still_is_said(samples):
    truth = simulated_stream(np.random.default_rng(5), 12, still=True, spacing_s=samples)
    far = np.abs(truth.seconds[:, None] - truth.seconds[None]) + 9 * np.eye(len(truth.seconds))
    alone = np.flatnonzero(far.min(1) > 0.6)
    refuses("E-TIME-OFFSET-STANDSTILL", estimate_offset, truth.pairs[alone], truth.stream, truth.seconds[alone])


def test_what_does_not_do_and_noise_of_samples_are_told_and_there_may_be_more_images_than_samples():
    truth = simulated_stream(np.random.default_rng(5), 8)
    refuses("E-TIME-OFFSET-FEW … 3 … 4", estimate_offset, truth.pairs[:3], truth.stream, truth.seconds[:3])
    refuses("E-TIME-OFFSET-RANGE … 0 … 8 … 67%", estimate_offset, truth.pairs, truth.stream, truth.seconds + 100)
    # 196 samples that miss the cubic through their neighbours: σ to 5 %; lengths of three numbers, √3 σ.
    turn, shift = stream(noise=(1e-4, 0.05)).rest()
    assert [turn, shift] == pytest.approx([np.sqrt(3) * 1e-4, np.sqrt(3) * 0.05], rel=0.2)
    times = np.arange(5) * 0.1
    samples = swing(times, PHASE)
    places = tuple(f"line {k + 2}" for k in range(5))
    robot = PoseSide(samples, places, "", names=tuple(f"{t:.1f}" for t in times), where="robot.csv", timed=True)
    seconds = np.round(0.01 + 0.04 * np.arange(9), 2)
    at, left_out, _ = robot_at_images(robot, [f"{t:.2f}.png" for t in seconds], Files("images"))
    assert (len(at), at.names[-1], left_out) == (9, "0.33.png", ())
    assert np.abs(at.poses.difference(swing(seconds, PHASE))).max() < 0.01


CAMERA = "1 PINHOLE 800 600 1000 1000 406.5 293.5\n"


@pytest.mark.slow
def test_the_offset_is_found_and_used(command, tmp_path):
    truth = simulated_stream(np.random.default_rng(7), 10)
    times = [[f"{1700000000 + time:.6f}" for time in each] for each in (truth.stream.seconds, truth.seconds)]
    sides = truth.stream.base_from_flange, truth.pairs.camera_from_board
    files = two(tmp_path, *(trajectory(*each) for each in zip(times, sides, strict=True)))
    files += ["--poses-are", "base_from_flange", "--poses-are", "camera_from_board"]
    out = tmp_path / "h.json"
    code, shown, error = command(*files, "--time-offset", "--splits", 0, "--method", "pose", "--out", out)
    assert code == 0, error
    found = json.loads(out.read_text())
    offset = found["time_offset"]
    assert abs(offset["seconds"] - 0.023) < 3 * offset["sigma_s"] < 2e-3
    taken = f"taken at t + {1e3 * offset['seconds']:.2f} ms of the robot's"
    assert all(text in shown for text in ("robot's clock minus camera's: the robot's is ahead of the camera's", taken))
    assert in_sigmas(found, "flange_from_camera", truth.mount_from_camera) ** 2 < 22.5  # χ² of 6, once in a thousand
    assert found["rms"]["translation_mm"] < 1  # plain, of 23 ms: several mm
    assert "poses by time: 10 times in 1200 samples of robot.txt: 10 interpolated (cubic; samples 0.02 s apart" in shown


def photographs(folder: Path, names: list[str], times: np.ndarray) -> list:
    """A folder of images that no one looks at, and a stream with a column time_s."""
    truth = simulated_stream(np.random.default_rng(3), 4)
    (folder / "images").mkdir()
    for name in names:
        (folder / "images" / name).write_bytes(b"x")
    flange, stamps = truth.stream.base_from_flange[: len(times)], [f"{time:.3f}" for time in times]
    table(folder / "robot.csv", {"base_from_flange": flange}, time_s=stamps)
    (folder / "board.toml").write_text(BOARD)
    (folder / "cameras.txt").write_text(CAMERA)
    files = [("--poses", "robot.csv"), ("--camera", "cameras.txt"), ("--board", "board.toml")]
    return [folder / "images", *(word for option, name in files for word in (option, folder / name))]


def test_dry_run_says_what_was_understood_of_times_of_names_and_of_a_file(command, tmp_path):
    names = ["100.105.png", "100.300.png", "100.6017.png", "200.5.png"]
    given = photographs(tmp_path, names, 100 + np.arange(40) * 0.02)
    code, shown, error = command(*given, "--dry-run")
    assert code == 0, error
    assert "poses by time: 4 times in 40 samples of robot.csv: 1 at a sample, 2 interpolated" in shown
    assert "images: 3 of 4 with a pose of the robot" in shown
    assert "left out 200.5.png: 99.72 s after the samples of robot.csv" in shown
    code, shown, error = command(*given, "--dry-run", "--time-tolerance", 100)
    assert code == 0, error
    assert "images: 4 of 4 with a pose of the robot" in shown
    (tmp_path / "named").mkdir()
    given = photographs(tmp_path / "named", ["a.png", "b.png", "c.png"], 100 + np.arange(40) * 0.02)
    times = written(tmp_path / "times.csv", "image,time_s\na,100.105\nb.png,100.3\n")
    code, shown, error = command(*given, "--dry-run", "--image-times", times)
    assert code == 0, error
    assert "1 at a sample, 1 interpolated" in shown
    assert "left out c.png: no time in" in shown
    said = "image a.png: its name is not a time, but the robot's poses are matched by time (robot.csv)"
    assert_error(command(*given, "--dry-run"), INPUT, said)
    for row, said in (
        ("a,soon", "time_s of a.png is 'soon', a number of"),
        ("z,1.5", "no row is of an image: z"),
        ("a,9.5", "no image has a pose: a.png"),
    ):
        times.write_text(f"image,time_s\n{row}\n")
        assert_error(command(*given, "--dry-run", "--image-times", times), INPUT, said)


PHASE = np.array([[0.3, 1.1, 2.0], [0.1, 4.0, 5.0]])
EVERY = np.arange(0, 10, 0.05)
AT = np.random.default_rng(0).uniform(0.1, 9.9, 60)


def stream(times=EVERY, noise=(0.0, 0.0)) -> Stream:
    poses = disturbed(np.random.default_rng(1), swing(times, PHASE), *noise)
    return Stream.of([Decimal(repr(round(float(t), 6))) for t in times], poses, "robot.csv")


def test_a_cubic_meets_the_trajectory_by_samples_in_any_order_and_at_both_ends():
    """Of samples h = 50 ms apart it errs by at most 3/128 h⁴ |y⁗|: y⁗ = 80 mm · 1.3⁴ = 230 mm/s⁴ gives 34 nm, that of
    rotations by their changing axis too; lines between samples would err by h²/8 |ÿ| = 0.04 mm."""
    off = np.abs(stream().at(AT).difference(swing(AT, PHASE)))
    assert 1e-9 < off[:, 3:].max() < 4e-5
    assert off[:, :3].max() < 1e-6
    assert max(stream().rest()) < 1e-3
    order = np.random.default_rng(2).permutation(len(EVERY))
    times = [Decimal(repr(round(float(t), 6))) for t in EVERY[order]]
    found = Stream.of(times, swing(EVERY[order], PHASE), "robot.csv")
    ends = np.array([0.0, 0.02, 9.94, 9.95])
    assert np.abs(found.at(ends).difference(swing(ends, PHASE))).max() < 1e-4


def test_what_is_taken_is_said():
    times = np.concatenate([EVERY[:100], EVERY[120:]])
    taken = taken_at(stream(times), np.array([0.05, 1.234, 4.96, 5.4, -0.015, 9.98, 12.0]), "abcdefg")
    assert taken.rows == [0, 1, 2, 4]
    why = dict(taken.left_out)
    assert list(why) == ["d", "f", "g"]
    for part in ("7 times in 180 samples of robot.csv", "1 at a sample", "1 interpolated", "2 by the nearest sample"):
        assert part in taken.said
    assert "3 left out" in taken.said
    assert why["d"] == (
        "in a gap of 1.05 s of robot.csv, 0.25 s allowed; the nearest sample is 0.45 s away, 0.02 s allowed "
        "(--time-tolerance)"
    )
    assert why["f"] == "0.03 s after the samples of robot.csv, 0.02 s allowed (--time-tolerance)"
    assert taken_at(stream(times), np.array([5.4]), "d", 0.5).rows == [0]
    nearest = taken.base_from_flange[3]
    assert np.abs(Poses.of([nearest]).difference(swing(np.zeros(1), PHASE))).max() < 1e-12


def test_names_that_are_times_and_streams_that_are_none():
    for names, times in (
        (["a/1689.25.png", "1690.png"], ["1689.25", "1690"]),
        (["1403636579763555584.png"], ["1403636579.763555584"]),
        (["1700000000", "1700000001"], ["1700000000", "1700000001"]),
    ):
        assert stamps_of(names) == [Decimal(time) for time in times]
    assert stamps_of(["01.png", "02.png"]) is None
    assert stamps_of(["1.5.png", "left.png"]) is None
    assert time_of("nan") is None
    for times, error in (([1], "E-TIMES-FEW … 1"), ([1, 2, 1], "E-TIMES-REPEATED … 1")):
        refuses(error, Stream.of, list(map(Decimal, times)), swing(np.array(times) * 1.0, PHASE), "robot.csv")
