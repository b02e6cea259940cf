"""Faces that are not where the design draws them, and groups that show others than they are named after."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal import Rigid, reference_target
from stcal.boards.target_file import target_toml
from stcal.sfm import load_run, pipeline
from stcal.sfm.checks.suite import cause_of_drawing
from stcal.sfm.data.group_model import NOT_AS_DRAWN, ImageObservations, misnamed_groups, not_as_drawn
from stcal.sfm.mapping.body import BodyCorners, place_with_camera, wrong_sizes
from stcal.sfm.planning.session import corners_seen
from stcal.sfm.report.judgement import judgement_of
from stcal.synthetic.body_scene import BodyOptions, body_camera, make_body_scene, write_body
from stcal.synthetic.designs import tag_cube
from tests.levels import sampled
from tests.outcome import refuses

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


def test_a_body_as_drawn_says_nothing():
    assert [not_as_drawn(found(seed=seed), CUBE) for seed in range(5)] == [[]] * 5
    assert not_as_drawn({"1": Rigid()}, CUBE) == []


def test_sizes_and_faces_that_are_not_as_drawn_are_named():
    [size] = not_as_drawn(found(0.1), CUBE)
    assert re.match(r"not as drawn: faces are 0\.(1|09\d|10) times as far from one another as their rough_pose", size)
    poses = found()
    poses["2"], poses["5"] = poses["5"], poses["2"]
    [turned] = not_as_drawn(poses, CUBE)
    assert "as if the names of faces 2 and 5 were exchanged" in turned
    turn = Rigid.exp([0, 0, np.pi / 2, 0, 0, 0])
    poses = found()
    [turned] = not_as_drawn(poses | {"4": poses["4"] @ turn}, CUBE)
    assert "face 4 is turned by 9" in turned or "face 4 is turned by 8" in turned
    assert "exchanged" not in turned
    one, other = (poses["4"] @ Rigid.exp([np.radians(turned), 0, 0, 0, 0, 0]) for turned in (30.0, 60.0))
    assert cause_of_drawing(poses | {"4": one}, CUBE) is None
    cause = cause_of_drawing(poses | {"4": other}, CUBE)  # it is on another side
    assert (cause.verdict, cause.names) == ("failed", ("4",))
    assert "face 4 is not where its rough_pose has it" in cause.title


def seen(group: str, *faces: str) -> list[ImageObservations]:
    labels = tuple(f"{face}:{circle}" for face in faces for circle in "abcd")
    n = len(labels)
    empty = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2, 2))
    return [ImageObservations(f"{group}/{i}", group, labels, *empty) for i in range(3)]


def test_groups_that_show_other_faces_than_their_names_say():
    target = reference_target()
    assert misnamed_groups([*seen("12", "1", "2"), *seen("left", "3", "4"), *seen("14", "1")], target) == []
    aside = [*seen("12", "1", "3"), *seen("12", "1", "3"), *seen("12", "2")[:1]]  # face 2 is in sight once
    assert len(misnamed_groups(aside, target)) == 1
    assert misnamed_groups([*seen("12", "1", "2", "3"), *seen("12", "1", "3")], target) == []
    [note] = misnamed_groups([*seen("12", "1", "3"), *seen("14", "1", "4")], target)
    assert note.startswith("not as drawn: group 12 is named after faces 1 and 2, and shows 1 and 3: correct")


@pytest.mark.parametrize("what", sampled(["size", "id"]))
def test_one_tag_of_another_size_or_id_is_named(tmp_path, no_page, what):
    write_body(
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


@pytest.fixture(scope="module")
def photographed():
    """The cube's scene, and its corners in 16 images."""
    scene = make_body_scene(CUBE, body_camera(640), BodyOptions(images=16, distance_mm=300, seed=5))
    return scene, corners_seen(scene, 0.02)[0]


def test_sizes_that_others_contradict_are_named_before_anything_is_adjusted_but_of_two_faces_none(photographed):
    """Even by a rough camera. A run of such a drawing ended in no minimum, or in a lens that folds its image."""
    scene, images = photographed
    rng, rough = np.random.default_rng(0), replace(scene.camera, focal=1.1 * scene.camera.focal)
    noisy = [replace(each, centre_px=each.centre_px + rng.normal(0, 0.02, each.centre_px.shape)) for each in images]
    assert wrong_sizes(BodyCorners(noisy, CUBE.faces), rough)[0] == {}
    for faces, factor in (((2,), 10.0), ((0,), 0.1), ((3,), 1.25), ((0, 1), 10.0)):
        drawn = list(CUBE.faces)
        for face in faces:
            drawn[face] = replace(drawn[face], xy_mm=drawn[face].xy_mm / factor)
        found = wrong_sizes(BodyCorners(noisy, tuple(drawn)), rough)[0]
        assert sorted(found) == sorted(faces)
        assert list(found.values()) == pytest.approx([factor] * len(faces), rel=0.05)
        refuses(f"E-BODY-SIZES … face {CUBE.faces[faces[0]].id}", place_with_camera, noisy, drawn, rough)
    one, two = (next(face for face in CUBE.faces if face.id == name) for name in ("1", "5"))
    said = "faces 1 and 5 contradict one another … face 5 is 10 times as large against face 1"
    small = [one, replace(two, xy_mm=two.xy_mm / 10)]
    refuses(f"E-BODY-SIZES … {said}", place_with_camera, images, small, scene.camera)
