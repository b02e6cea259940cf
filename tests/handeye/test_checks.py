"""Poses that cannot be solved are refused with the motion that is missing; mixed-up conventions are said."""

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError, StcalError
from stcal.geometry.least_squares import perturbed
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions, HandEyePoses
from stcal.handeye.data.pairs import Loop
from stcal.handeye.data.views import View, Views, pairs_of_views
from stcal.handeye.judge.mistakes import repair
from stcal.handeye.judge.observability import Observability
from stcal.handeye.judge.remarks import of_size
from stcal.handeye.methods.noise import Noise
from stcal.handeye.solve import handeye
from stcal.io.quaternions import INVERTED
from stcal.workflows.handeye.inputs import HandEyeInput, without_flips
from tests.outcome import fails_with
from tests.support.handeye import (
    BASE_FROM_BOARD,
    BASE_FROM_CAMERA,
    FLANGE_FROM_BOARD,
    FLANGE_FROM_CAMERA,
    board_corners,
    disturbed,
    simulated,
    simulated_views,
)

SETUPS = ("eye-in-hand", "eye-to-hand")
ONE_QUICK = ("eye-in-hand", pytest.param("eye-to-hand", marks=pytest.mark.slow))
"""Where the other setup is the same but for what its poses are called."""
NOISE = {"robot": (3e-4, 0.1), "camera": (1e-3, 0.3)}
SETS = pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 10))])
"""Of draws: the quick tests try one."""


def seen_from(flange, setup, rng=None, sigma=(5e-4, 0.1)):
    """Pairs of these flange poses."""
    if setup == "eye-in-hand":
        board = FLANGE_FROM_CAMERA.inverse() @ (flange.inverse() @ BASE_FROM_BOARD)
    else:
        board = BASE_FROM_CAMERA.inverse() @ (flange @ FLANGE_FROM_BOARD)
    return HandEyePoses(flange, board if rng is None else disturbed(rng, board, *sigma))


def flange_turned(rng, rotvec):
    """Flange poses at random places with rotations of a fixed one by ``rotvec`` (m, 3) in its own frame."""
    rest = Rotation.from_euler("zyx", [40, 160, 10], degrees=True)
    place = rng.uniform([400, -200, 300], [700, 200, 500], (len(rotvec), 3))
    return Poses((rest * Rotation.from_rotvec(rotvec)).as_matrix(), place)


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("axis", [(0, 0, 1.0), (0, 1.0, 0), (0.6, 0, 0.8)])
@pytest.mark.parametrize("exact", [True, False])
def test_parallel_axes_are_refused_with_the_missing_rotation(setup, axis, exact):
    """The axis is named in the flange's frame, whichever carries the camera, and the one to add is across."""
    rng = np.random.default_rng(1)
    flange = flange_turned(rng, np.outer(rng.uniform(-1, 1, 10), axis))
    if not exact:  # a tracker saw the flange, to 0.1 mrad
        flange = disturbed(rng, flange, 1e-4, 0.01)
    pairs = seen_from(flange, setup, rng)
    found = Observability.of(Loop.of(pairs, setup))
    assert found.axes[0] == pytest.approx(axis, abs=1e-3)
    assert found.axes[1] @ axis == pytest.approx(0, abs=1e-3)
    assert found.turns_rad[1] < 1e-3 < 0.3 < found.turns_rad[0]
    words = ", ".join(f"{v:.2g}" for v in axis)
    for method in ("pose", "park-martin", "shah"):
        with fails_with("E-HANDEYE-AXES") as caught:
            handeye(pairs, setup, method)
        assert f"({words})" in str(caught.value) or not exact
        assert "by 30° or more" in str(caught.value)


@pytest.mark.parametrize("setup", SETUPS)
def test_the_missing_rotation_helps(setup):
    """Two poses turned by 30° about the axis that the message names, and the same poses are solved."""
    rng = np.random.default_rng(2)
    turns = np.outer(rng.uniform(-1, 1, 8), [0, 0, 1.0])
    alone = seen_from(flange_turned(rng, turns), setup, rng)
    other = Observability.of(Loop.of(alone, setup)).axes[1]
    more = seen_from(flange_turned(rng, np.vstack([turns, np.outer([0.52, -0.52], other)])), setup, rng)
    true = FLANGE_FROM_CAMERA if setup == "eye-in-hand" else BASE_FROM_CAMERA
    found = handeye(more, setup)
    assert (true.inverse() @ found.mount_from_camera).angle_rad() < 3e-3
    sigma = np.sqrt(np.diag(found.covariance))
    assert 0.01 < sigma[3:].max() < 3


@pytest.mark.parametrize("setup", SETUPS)
def test_motions_that_are_too_small_are_refused(setup):
    pairs = simulated(np.random.default_rng(3), 12, setup, tilt=2e-4).pairs
    with fails_with("E-HANDEYE-AXES"):
        handeye(pairs, setup)
    pairs = simulated(np.random.default_rng(3), 12, setup, tilt=0.05).pairs  # ±3° do, with a larger σ
    assert handeye(pairs, setup).outliers.sum() == 0


def test_translations_only_are_refused():
    rng = np.random.default_rng(4)
    pairs = seen_from(flange_turned(rng, np.zeros((6, 3))), "eye-in-hand", rng)
    with fails_with("E-HANDEYE-AXES … 0"):
        handeye(pairs)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_poses(count):
    pairs = simulated(np.random.default_rng(5), 4).pairs[:count]
    with pytest.raises(DegenerateError, match=f"{count} poses, 3 needed and 10 wanted; rotate"):
        handeye(pairs)


def test_three_poses_are_enough():
    truth = simulated(np.random.default_rng(6), 3)
    found = handeye(truth.pairs)
    assert found.flange_from_camera.translation == pytest.approx(truth.mount_from_camera.translation, abs=1e-5)


def test_four_dof_where_it_does_not_belong():
    rng = np.random.default_rng(7)
    options = HandEyeOptions(four_dof=True)
    with fails_with("E-HANDEYE-AXES … four_dof"):
        handeye(simulated(rng, 10).pairs, options=options)
    with fails_with("E-HANDEYE-AXES"):
        handeye(seen_from(flange_turned(rng, np.zeros((6, 3))), "eye-in-hand", rng), options=options)


@pytest.mark.parametrize("setup", ONE_QUICK)
@pytest.mark.parametrize("side", ["robot", "camera"])
@pytest.mark.parametrize("method", ["pose", pytest.param("daniilidis", marks=pytest.mark.slow)])
def test_one_side_inverted_is_said(setup, side, method):
    truth = simulated(np.random.default_rng(8), 10, setup, **NOISE)
    flange, board = truth.pairs.base_from_flange, truth.pairs.camera_from_board
    flange, board = (flange.inverse(), board) if side == "robot" else (flange, board.inverse())
    with fails_with("E-HANDEYE-CONVENTION") as caught:
        handeye(HandEyePoses(flange, board), setup, method)
    assert setup not in str(caught.value)
    inverted, sound = ("flange_from_base", "board_from_camera")[:: 1 if side == "robot" else -1]
    assert inverted in str(caught.value)
    assert sound not in str(caught.value)  # that advice would invert both sides


def test_both_sides_inverted_put_the_board_behind_the_camera():
    """It fits, with X and Z exchanged; only the place of the board can tell."""
    truth = simulated(np.random.default_rng(9), 10, **NOISE)
    pairs = HandEyePoses(truth.pairs.base_from_flange.inverse(), truth.pairs.camera_from_board.inverse())
    found = handeye(pairs)
    assert found.flange_from_camera.translation == pytest.approx(truth.stand_from_board.translation, abs=2)
    assert found.notes[0].startswith("the board lies behind the camera in all poses")
    assert all(name in found.notes[0] for name in ("flange_from_base", "board_from_camera"))


def test_one_board_behind_the_camera_is_named():
    truth = simulated(np.random.default_rng(9), 10, **NOISE)
    board = list(truth.pairs.camera_from_board)
    board[6] = Rigid(board[6].rotation, -board[6].translation)
    found = handeye(HandEyePoses(truth.pairs.base_from_flange, Poses.of(board)))
    assert found.notes[0] == "the board lies behind the camera in pose 7: check its pose"
    assert found.outliers[6]


@pytest.mark.parametrize("side", ["robot", "board"])
def test_metres_that_are_called_millimetres_are_said(side):
    truth = simulated(np.random.default_rng(10), 10, **NOISE)
    flange, board = truth.pairs.base_from_flange, truth.pairs.camera_from_board
    if side == "robot":
        flange = Poses(flange.rotation, flange.translation / 1000)
    else:
        board = Poses(board.rotation, board.translation / 1000)
    with pytest.raises(InputError, match=f"with the {side}'s lengths times 1000: if they are metres"):
        handeye(HandEyePoses(flange, board))


@pytest.mark.parametrize(("side", "role"), [("robot", "robot"), ("board", "camera")])
def test_millimetres_that_are_called_metres_are_said_of_the_right_side(side, role):
    truth = simulated(np.random.default_rng(10), 10, **NOISE)
    flange, board = truth.pairs.base_from_flange, truth.pairs.camera_from_board
    if side == "robot":
        flange = Poses(flange.rotation, 1000 * flange.translation)
    else:
        board = Poses(board.rotation, 1000 * board.translation)
    said = rf"by [\d.]+° and [\d.]+ mm with the {side}'s lengths divided by 1000: if they are mm, .*unit {role}=mm"
    with pytest.raises(InputError, match=said):
        handeye(HandEyePoses(flange, board))


@pytest.mark.parametrize("side", ["robot", "board", "both"])
def test_radians_that_are_called_degrees_are_said(side):
    truth = simulated(np.random.default_rng(10), 10, **NOISE)

    def small(poses):
        angles = Rotation.from_matrix(poses.rotation).as_euler("xyz")
        return Poses(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), poses.translation)

    flange, board = truth.pairs.base_from_flange, truth.pairs.camera_from_board
    flange = flange if side == "board" else small(flange)
    board = board if side == "robot" else small(board)
    said = "the robot and the board" if side == "both" else f"the {side}"
    with pytest.raises(InputError, match=f"if the angles of {said} are radians, .*_rad, or .*-rad; if not, pair"):
        handeye(HandEyePoses(flange, board))


def misread(poses):
    """x, y, z, w read as w, x, y, z."""
    return Poses.from_quaternions(poses.quaternions()[:, [1, 2, 3, 0]], poses.translation)


@pytest.mark.parametrize("setup", ONE_QUICK)
@pytest.mark.parametrize("sides", ["the robot's", "the board's", "all"])
def test_quaternions_in_another_order_are_said(setup, sides):
    pairs = simulated(np.random.default_rng(14), 10, setup, **NOISE).pairs
    flange, board = pairs.base_from_flange, pairs.camera_from_board
    flange = flange if sides == "the board's" else misread(flange)
    board = board if sides == "the robot's" else misread(board)
    remedy = "give --quaternions xyzw" if sides == "all" else "name the columns so"
    with pytest.raises(
        InputError, match=f"with {sides} quaternions in another order: if x, y, z, w in the order .*, {remedy}"
    ):
        handeye(HandEyePoses(flange, board), setup)


@pytest.mark.parametrize("side", ["the robot's", "the board's"])
def test_conjugated_quaternions_are_said(side):
    pairs = simulated(np.random.default_rng(14), 10, **NOISE).pairs
    sides = {"the robot's": pairs.base_from_flange, "the board's": pairs.camera_from_board}
    sides[side] = INVERTED.poses(sides[side])
    with pytest.raises(InputError, match=f"with {side} quaternions conjugated: .*, change the sign of qw"):
        handeye(HandEyePoses(*sides.values()))


@pytest.mark.parametrize("setup", ONE_QUICK)
@pytest.mark.parametrize("axis", [0, *(pytest.param(axis, marks=pytest.mark.slow) for axis in (1, 2))])
@pytest.mark.parametrize("side", ["robot", "camera"])
def test_left_handed_poses_are_said(setup, axis, side):
    pairs = simulated(np.random.default_rng(15), 10, setup, **NOISE).pairs
    mirror = np.eye(3)
    mirror[axis, axis] = -1

    def mirrored(poses):
        return Poses(mirror @ poses.rotation @ mirror, poses.translation @ mirror)

    flange, board = pairs.base_from_flange, pairs.camera_from_board
    flange, board = (mirrored(flange), board) if side == "robot" else (flange, mirrored(board))
    with fails_with("E-HANDEYE-CONVENTION"):
        handeye(HandEyePoses(flange, board), setup)


def test_poses_that_have_nothing_in_common_are_refused():
    pairs = simulated(np.random.default_rng(16), 12, **NOISE).pairs
    with fails_with("E-HANDEYE-CONVENTION … spread over … pair each pose"):
        handeye(HandEyePoses(pairs.base_from_flange, pairs.camera_from_board[np.roll(np.arange(12), 5)]))


def test_a_board_of_another_size_is_no_contradiction():
    """Half as large as stated: said, with its size, and solved for on demand."""
    pairs = simulated(np.random.default_rng(17), 12, **NOISE).pairs
    board = Poses(pairs.camera_from_board.rotation, 2 * pairs.camera_from_board.translation)
    found = handeye(HandEyePoses(pairs.base_from_flange, board))
    said = re.search(r"the board is ([\d.]+) ± ([\d.]+) times as large as stated", found.notes[0])
    size, sigma = map(float, said.groups())
    assert abs(size - 0.5) < 4 * sigma < 0.5
    solved = handeye(HandEyePoses(pairs.base_from_flange, board), options=HandEyeOptions(with_scale=True))
    assert solved.scale == pytest.approx(0.5, abs=5 * solved.sigma_scale)


def turning(flange: Poses, seed: int) -> HandEyePoses:
    """Of eye-in-hand with noise."""
    rng = np.random.default_rng(seed)
    board = FLANGE_FROM_CAMERA.inverse() @ flange.inverse() @ BASE_FROM_BOARD
    return HandEyePoses(disturbed(rng, flange, 2e-4, 0.1), disturbed(rng, board, 5e-4, 0.2))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1, 8))])
def test_a_flange_that_only_turns_tells_no_size(seed):
    """Z, the lever of X and the size are open together: refused where it is asked for, and no note says otherwise."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(rng.normal(0, 0.3, (15, 3)))
    pairs = turning(Poses(turns.as_matrix(), np.tile([600.0, 0, 500], (15, 1))), seed)
    with fails_with("E-HANDEYE-BOARD-SCALE"):
        handeye(pairs, options=HandEyeOptions(with_scale=True))
    found = handeye(pairs)
    assert not any("times as large" in note for note in found.notes)
    assert found.flange_from_camera.translation == pytest.approx(FLANGE_FROM_CAMERA.translation, abs=1)


def test_three_poses_tell_no_size():
    with fails_with("E-HANDEYE-FEW-POSES … 3 … 4"):
        handeye(simulated(np.random.default_rng(5), 3).pairs, options=HandEyeOptions(with_scale=True))


@pytest.mark.parametrize(
    ("factor", "unit"),
    [
        (25.4, "the robot's were in inches"),
        pytest.param(0.1, "its lengths were in centimetres", marks=pytest.mark.slow),
    ],
)
def test_units_of_one_side_are_named(factor, unit):
    pairs = simulated(np.random.default_rng(18), 12, **NOISE).pairs
    board = Poses(pairs.camera_from_board.rotation, factor * pairs.camera_from_board.translation)
    pairs = HandEyePoses(pairs.base_from_flange, board)
    assert any(f"as if {unit}: name the columns so" in note for note in handeye(pairs).notes)
    with fails_with("E-HANDEYE-BOARD-SCALE"):
        handeye(pairs, options=HandEyeOptions(with_scale=True))


def test_metres_on_both_sides_are_said():
    pairs = simulated(np.random.default_rng(19), 12, **NOISE).pairs
    both = (Poses(p.rotation, p.translation / 1000) for p in (pairs.base_from_flange, pairs.camera_from_board))
    assert (
        handeye(HandEyePoses(*both))
        .notes[0]
        .endswith("name the columns x_m … or x_in …, or give --length-unit m where none states a unit")
    )


def test_four_dof_at_one_place():
    rng = np.random.default_rng(20)
    turns = Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", rng.uniform(-1, 1, (12, 1)))
    pairs = turning(Poses(turns.as_matrix(), np.tile([600.0, 0, 500], (12, 1))), 20)
    with fails_with("E-HANDEYE-AXES"):
        handeye(pairs, options=HandEyeOptions(four_dof=True))


def test_many_outliers_make_the_setup_suspect():
    pairs = simulated(np.random.default_rng(21), 15, **NOISE).pairs
    places = pairs.camera_from_board.translation.copy()
    places[:5] += np.random.default_rng(0).normal(0, 40, (5, 3))
    found = handeye(HandEyePoses(pairs.base_from_flange, Poses(pairs.camera_from_board.rotation, places)))
    assert any(note.startswith("5 of 15 poses contradict the others: with so many look first") for note in found.notes)


@pytest.mark.parametrize("moved", [pytest.param(False, marks=pytest.mark.full), True])
@pytest.mark.parametrize("sets", [1, pytest.param(40, marks=pytest.mark.full)])
def test_a_board_that_was_moved_half_way_is_said(moved, sets):
    """By 5° and 30 mm, every other pose: too many for outliers. Without, no such note for 40 sets in a row."""
    said = 0
    for seed in range(sets):
        pairs = simulated(np.random.default_rng(seed), 20, **NOISE).pairs
        away = Rigid.exp([0.05, 0.08, 0.02, 20, 20, 10])
        board = [p @ away if moved and i % 2 else p for i, p in enumerate(pairs.camera_from_board)]
        notes = handeye(HandEyePoses(pairs.base_from_flange, Poses.of(board))).notes
        said += any("the poses fall into two groups" in note for note in notes)
    assert said >= 0.9 * sets if moved else said == 0


@pytest.mark.parametrize(("what", "row"), [("camera", 12), ("board", 8)])
def test_what_moved_between_two_poses_is_located(what, row):
    pairs = simulated(np.random.default_rng(31), 24, **NOISE).pairs
    away = Rigid.exp([0.02, 0.03, 0.0, 5, -5, 3])
    later = [away @ p if what == "camera" else p @ away for p in pairs.camera_from_board]
    seen = [*list(pairs.camera_from_board)[:row], *later[row:]]
    notes = handeye(HandEyePoses(pairs.base_from_flange, Poses.of(seen))).notes
    [note] = [note for note in notes if "moved before" in note]
    assert note.startswith(f"the {what} moved before pose {row + 1}")


def with_flips(rng, pairs: HandEyePoses, count: int) -> tuple[HandEyePoses, list[int]]:
    """Some poses replaced by the other pose of the board's plane: tilts about the line of sight with opposite sign."""
    poses, rows = list(pairs.camera_from_board), sorted(rng.choice(len(pairs.names), count, replace=False).tolist())
    for row in rows:
        pose = poses[row]
        sight = pose.translation / np.linalg.norm(pose.translation)
        mirror = np.eye(3) - 2 * np.outer(sight, sight)
        poses[row] = Rigid(mirror @ pose.rotation @ np.diag([1, 1, -1.0]), pose.translation)
    return HandEyePoses(pairs.base_from_flange, Poses.of(poses)), rows


def test_flips_are_named_and_undone_where_asked():
    rng = np.random.default_rng(41)
    truth = simulated(rng, 20, **NOISE)
    pairs, rows = with_flips(rng, truth.pairs, 5)
    found = handeye(pairs)
    [note] = [note for note in found.notes if "tilted the other way" in note]
    assert [int(word) - 1 for word in re.findall(r"pose (\d+)", note)] == rows
    assert not any("tilted" in note for note in handeye(truth.pairs).notes)
    mended, said = without_flips(HandEyeInput("poses", pairs))
    assert said.startswith("tilted the other way, as --undo-flips asks, 5 of 20 poses")
    again = handeye(mended.pairs)
    assert not again.outliers.any()
    off = np.linalg.norm((again.mount_from_camera.inverse() @ FLANGE_FROM_CAMERA).translation)
    assert off < 4 * np.sqrt(np.trace(again.covariance[3:, 3:]))


def test_other_wrong_poses_are_no_flips():
    """Turned by 20° about random axes; of a hundred one may seem to be a flip."""
    rng = np.random.default_rng(42)
    pairs = simulated(rng, 20, **NOISE).pairs
    for _ in range(3):
        poses = list(pairs.camera_from_board)
        for row in (2, 7, 11):
            axis = rng.normal(size=3)
            poses[row] = poses[row] @ Rigid.exp([*(0.35 * axis / np.linalg.norm(axis)), 0, 0, 0])
        notes = handeye(HandEyePoses(pairs.base_from_flange, Poses.of(poses))).notes
        assert not any("tilted the other way" in note for note in notes)


@pytest.mark.parametrize(("sets", "most"), [(4, 0), pytest.param(200, 6, marks=pytest.mark.full)])
def test_sound_poses_do_not_move(sets, most):
    """In the order of their rows; at 1 %, of 200 sets seven or more once in 200 runs."""
    notes = [handeye(simulated(np.random.default_rng(seed), 20, **NOISE).pairs).notes for seed in range(sets)]
    assert sum(any("moved before" in note or "drifts" in note for note in each) for each in notes) <= most


@pytest.mark.slow
@pytest.mark.parametrize("sets", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_rough_poses_that_fit_another_setup_better_are_said(sets):
    """Errors of 0.5° and 5 mm, and turns of few degrees: no setup fits well, but the right one is named."""
    said = 0
    for seed in range(sets):
        truth = simulated(np.random.default_rng(seed), 15, "eye-in-hand", (8e-3, 5.0), (1e-3, 0.3), tilt=0.2)
        try:
            notes = handeye(truth.pairs, "eye-to-hand").notes
        except StcalError as error:
            notes = (str(error),)
        said += any("--setup eye-in-hand" in note for note in notes)
        right = handeye(truth.pairs, "eye-in-hand").notes
        assert not any("--setup eye-to-hand" in note for note in right)
    assert said >= 0.8 * sets


@pytest.mark.slow
def test_three_hundred_poses_need_little_memory():
    """All pairs of motions are 45 000; a full singular basis of them would be 15 GB."""
    tracemalloc.start()
    found = handeye(simulated(np.random.default_rng(22), 300, **NOISE).pairs)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.covariance is not None
    assert peak < 300e6


@SETS
def test_few_poses_are_not_thinned_out(seed):
    """Without known σ four good poses are too few to contradict one another."""
    assert not handeye(simulated(np.random.default_rng(seed), 4, **NOISE).pairs).outliers.any()


@SETS
def test_rough_poses_in_the_right_convention_pass(seed):
    """Errors of 2° and 20 mm: bad, but no other convention is better."""
    truth = simulated(np.random.default_rng(seed), 12, camera=(0.035, 20.0))
    assert len(handeye(truth.pairs).residuals) == 12


HALF = Rigid(np.diag([-1.0, -1, 1]), [200, 175, 0])
"""A chessboard of 8×7 squares of 25 mm seen from its other end."""


@pytest.mark.parametrize("setup", ONE_QUICK)
@pytest.mark.parametrize("turned", [[], [2, 5, 9], [0, 1, 3, 4, 6, 7, 8]])
def test_turned_views_are_put_right(setup, turned):
    """Up to a turn of all: the numbering of most is kept."""
    truth = simulated(np.random.default_rng(11), 12, setup, **NOISE)
    board = [p @ HALF if i in turned else p for i, p in enumerate(truth.pairs.camera_from_board)]
    pairs = HandEyePoses(truth.pairs.base_from_flange, Poses.of(board))
    mended = repair(pairs, setup, (HALF,))
    kept = turned if len(turned) < 6 else [i for i in range(12) if i not in turned]
    assert np.flatnonzero(mended.turned).tolist() == kept
    found = handeye(pairs, setup, options=HandEyeOptions(symmetries=(HALF,)))
    assert not found.outliers.any()
    assert (truth.mount_from_camera.inverse() @ found.mount_from_camera).angle_rad() < 3e-3
    assert bool(found.notes) == bool(kept)
    if kept:
        assert found.notes[0].endswith(", ".join(f"pose {i + 1}" for i in kept))


def test_a_square_board_has_four_numberings():
    truth = simulated(np.random.default_rng(12), 14, **NOISE)
    middle = np.array([87.5, 87.5, 0])
    turns = []
    for k in (1, 2, 3):
        turn = Rotation.from_euler("z", 90 * k, degrees=True).as_matrix()
        turns.append(Rigid(turn, middle - turn @ middle))
    labels = np.random.default_rng(0).integers(0, 4, 14)
    every = [Rigid(), *turns]
    board = Poses.of(p @ every[k] for p, k in zip(truth.pairs.camera_from_board, labels, strict=True))
    found = handeye(HandEyePoses(truth.pairs.base_from_flange, board), options=HandEyeOptions(symmetries=tuple(turns)))
    assert not found.outliers.any()
    assert (truth.mount_from_camera.inverse() @ found.mount_from_camera).angle_rad() < 3e-3


def test_corners_of_turned_views_are_put_right():
    """Numbered from the other end in two views: the adjustment comes out as without, to rounding."""
    truth = simulated_views(np.random.default_rng(13), 8, corner_px=0.1)
    xyz = board_corners(8, 7, 25.0)
    other = np.argsort(((HALF @ xyz)[:, None] - xyz[None]).__pow__(2).sum(2), axis=1)[:, 0]
    views = list(truth.views.views)
    for i in (1, 6):
        views[i] = View(xyz, views[i].xy_px[other])
    views = Views(truth.views.camera, tuple(views))
    pairs = pairs_of_views(truth.pairs.base_from_flange, views)
    found = handeye(pairs, views=views, options=HandEyeOptions(symmetries=(HALF,)))
    assert found.notes == ("numbered from another end of the board, and corrected: pose 2, pose 7",)
    plain = handeye(truth.pairs, views=truth.views)
    assert found.mount_from_camera.translation == pytest.approx(plain.mount_from_camera.translation, abs=1e-5)


def test_corners_of_a_square_board_are_put_right():
    """Numbered from another corner, a quarter turn on: the corners fit where they then belong."""
    truth = simulated_views(np.random.default_rng(15), 9)
    xyz = board_corners(8, 8, 25.0)
    middle, quarter = xyz.mean(0), Rotation.from_euler("z", 90, degrees=True).as_matrix()
    turn = Rigid(quarter, middle - quarter @ middle)
    turns = (turn, turn @ turn, turn @ turn @ turn)
    truly = truth.pairs.camera_from_board
    camera = truth.views.camera
    # A corner that is called p is really at turn @ p.
    views = [View(xyz, camera.project(p @ (turn @ xyz if i in (2, 5) else xyz))) for i, p in enumerate(truly)]
    views = Views(camera, tuple(views))
    pairs = pairs_of_views(truth.pairs.base_from_flange, views)
    found = handeye(pairs, views=views, options=HandEyeOptions(symmetries=turns))
    assert found.notes[0].endswith("pose 3, pose 6")
    assert not found.outliers.any()
    assert np.abs(found.reprojection.residuals_px).max() < 1e-3


def test_covariances_of_turned_views_are_carried_along():
    """The other origin moves by the rotation's error too: against the turned poses of many disturbed ones."""
    truth = simulated(np.random.default_rng(14), 6)
    seen = truth.pairs.camera_from_board[3] @ HALF
    steps = np.eye(6) * np.repeat([1e-5, 1e-2], 3)
    moved = Poses.of(perturbed(seen, step) @ HALF for step in steps)
    by = moved.difference(Poses.of([seen @ HALF] * 6)).T / np.repeat([1e-5, 1e-2], 3)
    board = [*truth.pairs.camera_from_board]
    board[3] = seen
    sigma = np.diag(np.square([1e-3, 2e-3, 5e-4, 0.1, 0.2, 0.4]))
    pairs = HandEyePoses(truth.pairs.base_from_flange, Poses.of(board), None, np.array([sigma] * 6))
    mended = repair(pairs, "eye-in-hand", (HALF,))
    assert mended.turned.tolist() == [0, 0, 0, 1, 0, 0]
    got = mended.pairs.camera_from_board_covariance
    scale = np.sqrt(np.diag(by @ sigma @ by.T))
    assert got[3] / np.outer(scale, scale) == pytest.approx(by @ sigma @ by.T / np.outer(scale, scale), abs=1e-3)
    assert (got[2] == sigma).all()


@SETS
def test_rough_poses_of_a_square_board_are_put_right(seed):
    """Errors of 2° and 8 mm: no pose agrees with all others at once; the solution of most tells the rest."""
    middle = np.array([87.5, 87.5, 0])
    turns = [Rotation.from_euler("z", 90 * k, degrees=True).as_matrix() for k in (1, 2, 3)]
    every = [Rigid(), *(Rigid(turn, middle - turn @ middle) for turn in turns)]
    truth = simulated(np.random.default_rng(seed), 14, camera=(0.035, 8.0))
    labels = np.random.default_rng(seed).integers(0, 4, 14)
    board = Poses.of(p @ every[k] for p, k in zip(truth.pairs.camera_from_board, labels, strict=True))
    mended = repair(HandEyePoses(truth.pairs.base_from_flange, board), "eye-in-hand", tuple(every[1:]))
    left = np.array([every[k].rotation @ every[t].rotation for k, t in zip(labels, mended.turned, strict=True)])
    assert np.abs(left - left[0]).max() < 1e-9


def test_a_board_of_another_size_is_said_of_few_poses_too():
    """It makes the σ of the robot, and with them those of its own step: 7 poses leave 3.6 of them."""
    truth = simulated(np.random.default_rng(3), 7, robot=(1e-6, 1e-3), camera=(1e-5, 1e-2))
    seen = truth.pairs.camera_from_board
    large = replace(truth.pairs, camera_from_board=Poses(seen.rotation, 1.05 * seen.translation))
    loop = Loop.of(large, "eye-in-hand")
    (note,) = of_size(loop, (0.9523, 0.0132), Noise())
    assert "the board is 0.952" in note
    assert of_size(loop, (0.9523, 0.03), Noise()) == ()
    assert of_size(Loop.of(truth.pairs, "eye-in-hand"), (0.9523, 0.0132), Noise()) == ()


def with_flange(pairs: HandEyePoses, rotation=None, translation=None) -> HandEyePoses:
    flange = pairs.base_from_flange
    rotation = flange.rotation if rotation is None else rotation
    translation = flange.translation if translation is None else translation
    return HandEyePoses(Poses(rotation, translation), pairs.camera_from_board)


@pytest.mark.parametrize(
    ("places", "said"), [(lambda t: t * [1, -1, 1], "taken as x, −y, z"), (lambda t: t[:, [1, 0, 2]], "as y, x, z")]
)
def test_positions_with_other_signs_or_order_are_named(places, said):
    """Rotations agree: what is wrong is not the pairing of the rows."""
    pairs = simulated(np.random.default_rng(51), 12, **NOISE).pairs
    with fails_with(f"E-HANDEYE-CONVENTION … x, y, z of the robot … {said}"):
        handeye(with_flange(pairs, translation=places(pairs.base_from_flange.translation)))
    wild = np.random.default_rng(0).normal(0, 300, (12, 3))
    with fails_with("E-HANDEYE-CONVENTION … positions … rotations agree … columns of positions"):
        handeye(with_flange(pairs, translation=wild))


@pytest.mark.parametrize(("read", "meant"), [("xyz", "ZYX"), ("xyz", "XYZ"), ("XYZ", "zyx")])
def test_angles_in_another_convention_are_named(read, meant):
    pairs = simulated(np.random.default_rng(52), 12, **NOISE).pairs
    angles = Rotation.from_matrix(pairs.base_from_flange.rotation).as_euler(meant)
    wrong = with_flange(pairs, rotation=Rotation.from_euler(read, angles).as_matrix())
    with fails_with(f"E-HANDEYE-CONVENTION … --rotation robot={meant}-deg (or -rad) if they were read as {read}"):
        handeye(wrong)


def test_a_mistake_in_poses_of_the_other_setup_is_named():
    pairs = simulated(np.random.default_rng(53), 16, setup="eye-to-hand", **NOISE).pairs
    metres = with_flange(pairs, translation=pairs.base_from_flange.translation / 1000)
    with fails_with("E-HANDEYE-CONVENTION … with --setup eye-to-hand and with the robot's lengths times 1000"):
        handeye(metres)


@pytest.mark.parametrize(("order", "name"), [([1, 2, 3, 0], "xyzw"), ([3, 0, 1, 2], "wxyz")])
def test_the_option_for_quaternions_is_that_of_what_the_columns_hold(order, name):
    pairs = simulated(np.random.default_rng(54), 12, **NOISE).pairs
    flange = pairs.base_from_flange
    filed = Poses.from_quaternions(flange.quaternions()[:, order], flange.translation)
    with fails_with(f"E-HANDEYE-CONVENTION … the robot's quaternions … --rotation robot={name}"):
        handeye(HandEyePoses(filed, pairs.camera_from_board))
