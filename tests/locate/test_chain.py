"""From the camera to the robot's base."""

import json

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid, UncertainRigid
from stcal.io.table import COVARIANCE, POSE, pose_cells
from stcal.locate.base_chain import goal_chain

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


def test_the_chain_is_the_product(files):
    chain = read_chain(*files)
    goal = chain.base_from_goal("a", SEEN)
    assert np.allclose(goal.rigid.matrix(), (FLANGE @ MOUNT @ SEEN.rigid @ OFFSET).matrix(), atol=1e-9)
    assert (np.linalg.eigvalsh(goal.covariance) > 0).all()
    # A turn of the camera's pose by σ = 1e-3 rad is an arc at the goal, 100 mm off: more than its own 0.1 mm.
    exact = UncertainRigid(SEEN.rigid, np.diag([0.0] * 3 + [0.01] * 3))
    assert np.trace(goal.covariance[3:, 3:]) > np.trace(chain.base_from_goal("a", exact).covariance[3:, 3:]) + 0.015


def test_covariances_of_the_robot_add_up(files):
    hand_eye, poses, _ = files
    plain = read_chain(hand_eye, poses).base_from_goal("a", SEEN).covariance
    own = np.diag([1e-7] * 3 + [0.04] * 3)
    text = ",".join(["scene", *POSE, *COVARIANCE]) + "\n" + ",".join(["a", *pose_cells(FLANGE, own)]) + "\n"
    poses.write_text(text)
    more = read_chain(hand_eye, poses).base_from_goal("a", SEEN).covariance
    assert np.allclose(np.diag(more - plain)[:3], 1e-7)
    assert (np.diag(more - plain)[3:] > 0.04).all()


def test_a_fixed_camera_needs_no_robot_poses(files, tmp_path):
    fixed = tmp_path / "fixed.json"
    fixed.write_text(json.dumps({"base_from_camera": MOUNT.matrix().tolist(), "covariance": None}))
    goal = read_chain(fixed, None).base_from_goal("any", SEEN)
    assert np.allclose(goal.rigid.matrix(), (MOUNT @ SEEN.rigid).matrix())
    with pytest.raises(InputError, match="camera is fixed"):
        read_chain(fixed, files[1])


def registered(path, b_from_a, model="rigid", covariance=None):
    content = {"format": "stcal registration 1", "model": model, "method": "robust", "b_from_a": b_from_a.tolist()}
    content["covariance"] = (np.eye(6) * 1e-6 if covariance is None else covariance).tolist()
    path.write_text(json.dumps(content))
    return path


def test_a_registration_leads_to_the_base_too(files, tmp_path):
    file = registered(tmp_path / "register.json", MOUNT.matrix())
    goal = goal_chain(registration=file, offset=files[2]).base_from_goal("any", SEEN)
    mount = UncertainRigid(MOUNT, np.eye(6) * 1e-6)
    wanted = mount @ SEEN @ UncertainRigid.exact(OFFSET)
    assert np.allclose(goal.rigid.matrix(), wanted.rigid.matrix())
    assert np.allclose(goal.covariance, wanted.covariance)


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
    with pytest.raises(InputError, match=f"no rigid motion \\({model}: .*register with --model rigid"):
        goal_chain(registration=file)


def test_scenes_are_found_by_another_column(files):
    hand_eye, poses, _ = files
    poses.write_text(poses.read_text().replace("scene", "image"))
    assert list(read_chain(hand_eye, poses, key="image").flange) == ["a"]
    with pytest.raises(InputError, match="no column scene"):
        read_chain(hand_eye, poses)


def test_what_is_wrong_is_named(files, tmp_path):
    hand_eye, poses, offset = files
    with pytest.raises(InputError, match="on the flange; robot poses"):
        read_chain(hand_eye, None)
    with pytest.raises(InputError, match="none of scene b"):
        read_chain(hand_eye, poses).base_from_goal("b", SEEN)
    poses.write_text(poses.read_text() + poses.read_text().splitlines()[1] + "\n")
    with pytest.raises(InputError, match="line 3: scene a again"):
        read_chain(hand_eye, poses)
    for content, reason in [
        ("{", "not JSON"),
        ("[]", "an object"),
        ("{}", "neither; flange_from_camera or base_from_camera"),
        (json.dumps({"flange_from_camera": [[1, 2], [3, 4]]}), "flange_from_camera.*4×4 needed"),
        (
            json.dumps({"flange_from_camera": MOUNT.matrix().tolist(), "covariance": NEGATIVE}),
            "covariance: variance -2.5e\\+05 of y, 0 or more needed",
        ),
        (json.dumps({"flange_from_camera": "x"}), "flange_from_camera.*'x'"),
        (json.dumps({"format": "stcal handeye 2", "base_from_camera": MOUNT.matrix().tolist()}), "'stcal handeye 1'"),
    ]:
        hand_eye.write_text(content)
        with pytest.raises(InputError, match=reason):
            read_chain(hand_eye, poses)
    offset.write_text("{}")
    hand_eye.write_text(json.dumps({"base_from_camera": np.eye(4).tolist()}))
    with pytest.raises(InputError, match="no 'obj_from_goal'"):
        read_chain(hand_eye, None, offset)


def test_the_order_of_the_robots_quaternions_is_an_option(files):
    hand_eye, poses, _ = files
    x, y, z, qw, qx, qy, qz = pose_cells(FLANGE)
    poses.write_text(",".join(["scene", *POSE]) + "\n" + ",".join(["a", x, y, z, qx, qy, qz, qw]) + "\n")
    found = read_chain(hand_eye, poses, quaternions="xyzw").flange["a"].rigid
    assert np.allclose(found.matrix(), FLANGE.matrix(), atol=1e-12)
