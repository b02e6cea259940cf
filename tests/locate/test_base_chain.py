"""From the camera to the robot's base; robot poses and hand-eye that cannot be meant as they stand, and such as can."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid, UncertainRigid
from stcal.io.rotations import INVERTED
from stcal.io.table import COVARIANCE, POSE, pose_cells
from stcal.locate.base_chain import GoalChain, goal_chain, on_chain
from tests.levels import sampled
from tests.outcome import refuses

MOUNT = Rigid.exp([0.1, 0.2, 0.3, 10, 20, 30])
FLANGE = Rigid.exp([1.0, 0, 0.5, 400, 0, 600])
SEEN = UncertainRigid(Rigid.exp([0.2, 0, 0, 5, 6, 700]), np.diag([1e-6] * 3 + [0.01] * 3))
OFFSET = Rigid.exp([0, 0, 0.5, 0, 0, -100])

NEGATIVE = np.diag([1e-8, 1e-8, 1e-8, 1e-4, -250_000.0, 1e-4]).tolist()


def read_chain(hand_eye, poses=None, offset=None, **options):
    return goal_chain(hand_eye, robot_poses=poses, offset=offset, **options)


@pytest.fixture
def files(tmp_path):
    hand_eye, poses, offset = (tmp_path / name for name in ("he.json", "poses.csv", "offset.json"))
    sigma = np.diag([1e-8] * 3 + [1e-4] * 3)
    hand_eye.write_text(json.dumps({"flange_from_camera": MOUNT.matrix().tolist(), "covariance": sigma.tolist()}))
    poses.write_text(",".join(["scene", *POSE]) + "\n" + ",".join(["a", *pose_cells(FLANGE)]) + "\n")
    offset.write_text(json.dumps({"obj_from_goal": OFFSET.matrix().tolist()}))
    return hand_eye, poses, offset


def test_the_chain_is_the_product_and_covariances_of_the_robot_add_up(files):
    chain = read_chain(*files)
    goal = chain.base_from_goal("a", SEEN)
    assert np.allclose(goal.rigid.matrix(), (FLANGE @ MOUNT @ SEEN.rigid @ OFFSET).matrix(), atol=1e-9)
    assert (np.linalg.eigvalsh(goal.covariance) > 0).all()
    # A turn of the camera's pose by σ = 1e-3 rad is an arc at the goal, 100 mm off: more than its own 0.1 mm.
    exact = UncertainRigid(SEEN.rigid, np.diag([0.0] * 3 + [0.01] * 3))
    assert np.trace(goal.covariance[3:, 3:]) > np.trace(chain.base_from_goal("a", exact).covariance[3:, 3:]) + 0.015
    plain = read_chain(*files[:2]).base_from_goal("a", SEEN).covariance
    own = np.diag([1e-7] * 3 + [0.04] * 3)
    text = ",".join(["scene", *POSE, *COVARIANCE]) + "\n" + ",".join(["a", *pose_cells(FLANGE, own)]) + "\n"
    files[1].write_text(text)
    more = read_chain(*files[:2]).base_from_goal("a", SEEN).covariance
    assert np.allclose(np.diag(more - plain)[:3], 1e-7)
    assert (np.diag(more - plain)[3:] > 0.04).all()


def test_a_fixed_camera_needs_no_robot_poses_and_a_registration_leads_to_the_base_too(files, tmp_path):
    fixed = tmp_path / "fixed.json"
    fixed.write_text(json.dumps({"base_from_camera": MOUNT.matrix().tolist(), "covariance": None}))
    goal = read_chain(fixed, None).base_from_goal("any", SEEN)
    assert np.allclose(goal.rigid.matrix(), (MOUNT @ SEEN.rigid).matrix())
    refuses("E-OPTION-NEEDS … fixed.json … the camera is fixed", read_chain, fixed, files[1])
    file = registered(tmp_path / "register.json", MOUNT.matrix())
    goal = goal_chain(registration=file, offset=files[2]).base_from_goal("any", SEEN)
    mount = UncertainRigid(MOUNT, np.eye(6) * 1e-6)
    wanted = mount @ SEEN @ UncertainRigid.exact(OFFSET)
    assert np.allclose(goal.rigid.matrix(), wanted.rigid.matrix())
    assert np.allclose(goal.covariance, wanted.covariance)


def registered(path, b_from_a, model="rigid", covariance=None):
    content = {"format": "stcal registration 1", "model": model, "method": "robust", "b_from_a": b_from_a.tolist()}
    content["covariance"] = (np.eye(6) * 1e-6 if covariance is None else covariance).tolist()
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("matrix", "model", "size"),
    [
        (np.diag([1.001, 1.001, 1.001, 1]), "similarity", 7),
        (np.diag([-1.0, 1, 1, 1]), "rigid", 6),
        (np.diag([1.0, 1.0, 1.0, 1]), "affine", 12),
    ],
)
def test_a_registration_that_is_no_rigid_motion_is_refused(tmp_path, matrix, model, size):
    file = registered(tmp_path / "register.json", matrix, model, np.eye(size))
    refuses(f"E-REGISTER-FILE … {model} … --model rigid", goal_chain, registration=file)


def test_scenes_are_found_by_another_column_and_the_order_of_quaternions_is_an_option(files):
    hand_eye, poses, _ = files
    poses.write_text(poses.read_text().replace("scene", "image"))
    assert list(read_chain(hand_eye, poses, key="image").flange) == ["a"]
    refuses("E-TABLE-COLUMN-MISSING … scene", read_chain, hand_eye, poses)
    x, y, z, qw, qx, qy, qz = pose_cells(FLANGE)
    poses.write_text(",".join(["scene", *POSE]) + "\n" + ",".join(["a", x, y, z, qx, qy, qz, qw]) + "\n")
    found = read_chain(hand_eye, poses, quaternions="xyzw").flange["a"].rigid
    assert np.allclose(found.matrix(), FLANGE.matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "not JSON"),
        ("[]", "an object"),
        ("{}", "neither; flange_from_camera or base_from_camera"),
        ({"flange_from_camera": [[1, 2], [3, 4]]}, "flange_from_camera.*4×4 needed"),
        ({"flange_from_camera": MOUNT.matrix().tolist(), "covariance": NEGATIVE}, "covariance: .* of y, 0 or more"),
        ({"flange_from_camera": "x"}, "flange_from_camera.*'x'"),
        ({"format": "stcal handeye 2", "base_from_camera": MOUNT.matrix().tolist()}, "'stcal handeye 1'"),
    ],
)
def test_what_is_wrong_in_a_hand_eye_file_is_named(files, content, reason):
    files[0].write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError, match=reason):
        read_chain(*files)


def test_what_does_not_lead_to_the_base_is_named(files):
    hand_eye, poses, offset = files
    refuses("E-OPTION-MISSING … on the flange", read_chain, hand_eye)
    refuses("E-ROBOT-POSES-SCENE … scene b", read_chain(hand_eye, poses).base_from_goal, "b", SEEN)
    poses.write_text(poses.read_text() + poses.read_text().splitlines()[1] + "\n")
    refuses("E-TABLE-ROW-REPEATED … line 3: scene a", read_chain, hand_eye, poses)
    offset.write_text("{}")
    hand_eye.write_text(json.dumps({"base_from_camera": np.eye(4).tolist()}))
    with pytest.raises(InputError, match="no 'obj_from_goal'"):
        read_chain(hand_eye, None, offset)


CAMERA_ON_FLANGE = Rigid.exp([0.1, -0.2, 1.5, 60, -30, 110])


def looks(seed: int, count: int, turn_rad: float = 0.5, moves: float = 0.0) -> tuple[Poses, Poses]:
    """base_from_flange and camera_from_obj, with noise of 0.3 mm and 0.5 mrad; ``moves`` : σ of the target, mm."""
    rng = np.random.default_rng([seed, count])
    about = Rigid.exp([*rng.normal(0, 1, 3), *rng.uniform(-900, 900, 3)])
    turns = rng.normal(0, turn_rad, (count, 3))
    flange = [about @ Rigid.exp([*turn, *rng.normal(0, 80, 3)]) for turn in turns]
    obj = flange[0] @ CAMERA_ON_FLANGE @ Rigid.exp([0.2, 0.1, 0.4, 10, 20, 600])
    seen = []
    for each in flange:
        away = Rigid.exp([*rng.normal(0, moves * 5e-3, 3), *rng.normal(0, moves, 3)])
        noise = Rigid.exp([*rng.normal(0, 5e-4, 3), *rng.normal(0, 0.3, 3)])
        seen.append((each @ CAMERA_ON_FLANGE).inverse() @ away @ obj @ noise)
    return Poses.of(flange), Poses.of(seen)


def judged(flange: Poses, seen: Poses, mount: Rigid = CAMERA_ON_FLANGE) -> tuple[str, ...]:
    poses = {str(i): UncertainRigid.exact(each) for i, each in enumerate(flange)}
    chain = GoalChain(UncertainRigid.exact(mount), True, poses, Rigid())
    return on_chain(chain, {str(i): UncertainRigid.exact(each) for i, each in enumerate(seen)})


def rolled(poses: Poses) -> Poses:
    """x, y, z, w read as w, x, y, z."""
    return Poses.from_quaternions(poses.quaternions()[:, [1, 2, 3, 0]], poses.translation)


def times(each, factor: float):
    return replace(each, translation=factor * each.translation)


MISTAKES = {
    "robot's quaternions were x, y, z, w in the order .*; give --quaternions xyzw": lambda f, m: (rolled(f), m),
    "robot's quaternions were conjugated": lambda f, m: (INVERTED.poses(f), m),
    "robot's poses were flange_from_base": lambda f, m: (f.inverse(), m),
    "hand-eye were camera_from_flange": lambda f, m: (f, m.inverse()),
    "robot's lengths were metres; name the columns _m": lambda f, m: (times(f, 1e-3), m),
    "robot's lengths were inches; name the columns _in": lambda f, m: (times(f, 1 / 25.4), m),
    "hand-eye's lengths were metres; multiply them by 1000": lambda f, m: (f, times(m, 1e-3)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("count", [2, 12])
def test_a_target_that_stands_still_shows_the_mistake(mistake, count):
    for seed in range(2):
        flange, seen = looks(seed, count)
        flange, mount = MISTAKES[mistake](flange, CAMERA_ON_FLANGE)
        with pytest.raises(InputError, match=rf"varies by .* \(RMS of {count} scenes\), but by .* if the {mistake}"):
            judged(flange, seen, mount)


@pytest.mark.parametrize("sets", sampled([2, 12]))
def test_good_poses_pass(sets):
    """Flanges that turn and that do not, targets that stand and that move."""
    for count, turn_rad, moves in product((1, 2, 3, 12), (0.0, 0.02, 0.5), (0.0, 3.0, 200.0)):
        for seed in range(sets):
            assert judged(*looks(seed, count, turn_rad, moves)) == ()


def test_lengths_in_metres_are_said():
    flange, seen = looks(1, 1)
    (note,) = judged(times(flange, 1e-3), seen, CAMERA_ON_FLANGE)
    assert note.startswith("robot poses: the flange is within ")
    assert "if lengths are metres, name the columns _m" in note
    (note,) = judged(flange, seen, times(CAMERA_ON_FLANGE, 1e-3))
    assert note.startswith("hand-eye file: the camera is 0.13 mm from the origin of the flange, more than 2 mm")
    fixed = GoalChain(UncertainRigid.exact(times(CAMERA_ON_FLANGE, 0.02)), False, {}, Rigid())
    assert "of the base, more than 20 mm expected" in on_chain(fixed, {})[0]
    assert judged(Poses.of([Rigid()]), seen) == judged(flange, seen, Rigid()) == ()
