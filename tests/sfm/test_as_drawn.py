"""Faces that are not where the design draws them."""

import re

import numpy as np
import pytest

from stcal.boards.target_file import target_toml
from stcal.geometry.rigid import Rigid
from stcal.sfm import pipeline
from stcal.sfm.checks.suite import cause_of_drawing
from stcal.sfm.data.group_model import NOT_AS_DRAWN, not_as_drawn
from stcal.sfm.report.judgement import judgement_of
from stcal.sfm.runs.saved import load_run
from stcal.synthetic.body_scene import BodyOptions, body_camera, make_body_scene
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.designs import tag_cube
from tests.levels import sampled

pytestmark = pytest.mark.slow

CUBE = tag_cube(60.0)


def found(size: float = 1.0, seed: int = 1) -> dict[str, Rigid]:
    """The cube made to 5° and 3 mm, in the frame of its third face."""
    rng, rough = np.random.default_rng(seed), CUBE.rough_poses()
    off = [Rigid.exp([*rng.normal(0, np.radians(3), 3), *rng.normal(0, 1.5, 3)]) for _ in rough]
    third = rough["3"].inverse()
    return {
        face: Rigid((at := third @ pose @ error).rotation, size * at.translation)
        for (face, pose), error in zip(rough.items(), off, strict=True)
    }


@pytest.mark.parametrize("seed", range(5))
def test_a_body_as_drawn_says_nothing(seed):
    assert not_as_drawn(found(seed=seed), CUBE) == []
    assert not_as_drawn({"1": Rigid()}, CUBE) == []


def test_another_size_and_turned_faces_are_named():
    [size] = not_as_drawn(found(0.1), CUBE)
    assert re.match(r"not as drawn: faces are 0\.(1|09\d|10) times as far from one another as their rough_pose", size)
    poses = found()
    poses["2"], poses["5"] = poses["5"], poses["2"]
    [turned] = not_as_drawn(poses, CUBE)
    assert re.search(r"face 2 is turned by \d+°, face 5 is turned by \d+°", turned)
    turn = Rigid.exp([0, 0, np.pi / 2, 0, 0, 0])
    poses = found()
    [turned] = not_as_drawn(poses | {"4": poses["4"] @ turn}, CUBE)
    assert "face 4 is turned by 9" in turned or "face 4 is turned by 8" in turned


@pytest.mark.parametrize(("turned", "named"), [(30.0, False), (60.0, True)])
def test_a_face_on_another_side_is_not_the_one_drawn(turned, named):
    faces = found(seed=1) | {}
    faces["4"] = faces["4"] @ Rigid.exp([np.radians(turned), 0, 0, 0, 0, 0])
    cause = cause_of_drawing(faces, CUBE)
    assert bool(cause) is named
    if cause:
        assert (cause.verdict, cause.names) == ("failed", ("4",))
        assert "face 4 is not where its rough_pose has it" in cause.title


@pytest.mark.parametrize("what", sampled(["size", "id"]))
def test_one_tag_of_another_size_or_id_is_named(tmp_path, no_page, what):
    write_dataset(
        tmp_path / "set", make_body_scene(CUBE, body_camera(640), BodyOptions(images=10, distance_mm=300, seed=5))
    )
    text = target_toml(CUBE)
    second = [line for line in text.splitlines() if "size_mm = " in line and "dictionary" in line][1]
    old, new = {"size": (second, second.replace("size_mm = 45.0", "size_mm = 40.0")), "id": ("id = 2,", "id = 77,")}[
        what
    ]
    (path := tmp_path / "target.toml").write_text(text.replace(old, new), encoding="utf-8")
    result = pipeline.run(tmp_path / "set/images", tmp_path / "set/cameras.txt", tmp_path / "run", path)
    scales = next(check for check in result.checks if check.key == "scales")
    if what == "size":
        assert (scales.verdict, scales.names) == ("failed", ("face 2",))
        assert scales.reason.startswith("face 2 would fit with 1.1")
        assert result.judgement.verdict == "no"
    else:
        assert scales.verdict != "failed"
        assert any("tag 2 of dict_apriltag_36h11" in note.lower() and "not 77 of" in note for note in result.notes)


def test_a_run_that_is_not_as_drawn_is_with_care_and_says_what_to_do(small_run):
    report = load_run(small_run).report
    drawn = {"code": NOT_AS_DRAWN, "words": "faces are 0.1 times as far", "remedy": "check the sizes"}
    notes = [*report["notes"], drawn]
    report["options"]["expect_faces"] = list(report["faces"])
    assert judgement_of(report).verdict == "yes"
    judged = judgement_of(report | {"notes": notes})
    assert judged.verdict == "with care"
    assert "; faces are 0.1 times as far" in judged.use
    assert judged.limit == "The drawing: faces are 0.1 times as far."
    assert judged.next.startswith("Check the sizes.")
