"""Robot poses and hand-eye that cannot be meant as they stand; and such as can."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid, UncertainRigid
from stcal.io.rotations import INVERTED
from stcal.locate.base_chain import GoalChain, on_chain

MOUNT = Rigid.exp([0.1, -0.2, 1.5, 60, -30, 110])


def looks(seed: int, count: int, turn_rad: float = 0.5, moves: float = 0.0) -> tuple[Poses, Poses]:
    """base_from_flange and camera_from_obj, with noise of 0.3 mm and 0.5 mrad; ``moves`` : σ of the target, mm."""
    rng = np.random.default_rng([seed, count])
    about = Rigid.exp([*rng.normal(0, 1, 3), *rng.uniform(-900, 900, 3)])
    turns = rng.normal(0, turn_rad, (count, 3))
    flange = [about @ Rigid.exp([*turn, *rng.normal(0, 80, 3)]) for turn in turns]
    obj = flange[0] @ MOUNT @ Rigid.exp([0.2, 0.1, 0.4, 10, 20, 600])
    seen = []
    for each in flange:
        away = Rigid.exp([*rng.normal(0, moves * 5e-3, 3), *rng.normal(0, moves, 3)])
        noise = Rigid.exp([*rng.normal(0, 5e-4, 3), *rng.normal(0, 0.3, 3)])
        seen.append((each @ MOUNT).inverse() @ away @ obj @ noise)
    return Poses.of(flange), Poses.of(seen)


def judged(flange: Poses, seen: Poses, mount: Rigid = MOUNT) -> tuple[str, ...]:
    poses = {str(i): UncertainRigid.exact(each) for i, each in enumerate(flange)}
    chain = GoalChain(UncertainRigid.exact(mount), True, poses, Rigid())
    return on_chain(chain, {str(i): UncertainRigid.exact(each) for i, each in enumerate(seen)})


def rolled(poses: Poses) -> Poses:
    """x, y, z, w read as w, x, y, z."""
    return Poses.from_quaternions(poses.quaternions()[:, [1, 2, 3, 0]], poses.translation)


def times(each, factor: float):
    return replace(each, translation=factor * each.translation)


MISTAKES = {
    "xyzw": (
        lambda f, m: (rolled(f), m),
        "the robot's quaternions were x, y, z, w in the order .*; give --quaternions xyzw",
    ),
    "conjugated": (lambda f, m: (INVERTED.poses(f), m), "the robot's quaternions were conjugated"),
    "inverse": (lambda f, m: (f.inverse(), m), "the robot's poses were flange_from_base"),
    "hand-eye inverse": (lambda f, m: (f, m.inverse()), "the hand-eye were camera_from_flange"),
    "metres": (lambda f, m: (times(f, 1e-3), m), "the robot's lengths were metres; name the columns _m"),
    "inches": (lambda f, m: (times(f, 1 / 25.4), m), "the robot's lengths were inches; name the columns _in"),
    "hand-eye in metres": (
        lambda f, m: (f, times(m, 1e-3)),
        "the hand-eye's lengths were metres; multiply them by 1000",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.parametrize("count", [2, 3, 12])
def test_a_target_that_stands_still_shows_the_mistake(name, count):
    wrong, says = MISTAKES[name]
    for seed in range(4):
        flange, seen = looks(seed, count)
        flange, mount = wrong(flange, MOUNT)
        with pytest.raises(InputError, match=rf"varies by .* \(RMS of {count} scenes\), but by .* if {says}"):
            judged(flange, seen, mount)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3, 12])
@pytest.mark.parametrize("turn_rad", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("moves", [0.0, 3.0, 200.0])
def test_good_poses_pass(count, turn_rad, moves):
    """Flanges that turn and that do not, targets that stand and that move."""
    for seed in range(12):
        assert judged(*looks(seed, count, turn_rad, moves)) == ()


def test_a_flange_in_the_robots_foot_is_said():
    flange, seen = looks(1, 1)
    assert judged(times(flange, 1e-3), seen)[0].startswith("robot poses: the flange is within ")
    assert "if lengths are metres, name the columns _m" in judged(times(flange, 1e-3), seen)[0]
    assert judged(Poses.of([Rigid()]), seen) == ()


def test_a_camera_in_the_flange_is_said():
    flange, seen = looks(1, 1)
    (note,) = judged(flange, seen, times(MOUNT, 1e-3))
    assert note.startswith(
        "hand-eye file: the camera is 0.13 mm from the origin of the flange, more than 2 mm expected"
    )
    assert judged(flange, seen, Rigid()) == ()
    fixed = GoalChain(UncertainRigid.exact(times(MOUNT, 0.02)), False, {}, Rigid())
    assert "of the base, more than 20 mm expected" in on_chain(fixed, {})[0]
