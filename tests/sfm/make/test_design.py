"""A pattern that is made by itself: unambiguous, read with circles hidden, seen well, and where the box has it."""

from itertools import combinations

import numpy as np
import pytest

from stcal import InputError, TargetDesign, load_board
from stcal.boards.target_file import load_target, target_toml
from stcal.cli.sfm.design_commands import design as command
from stcal.lookalikes import MIN_COMMON
from stcal.sfm import PlanOptions, make, plan
from stcal.sfm.detect.face_patterns import confusable, in_common, is_named, mirror_images
from stcal.sfm.make import (
    HIDDEN,
    LARGE,
    LEAST_CIRCLES,
    NAMES,
    DesignOptions,
    faces_of,
    make_pattern,
    make_target,
    sides_of,
    size_of,
    unnamed_cases,
)
from stcal.synthetic.designs import second_design
from tests.outcome import refuses

SIZE = (130.0, 110.0, 100.0)


@pytest.fixture(scope="module")
def made():
    return make_target(DesignOptions(SIZE, circles=LEAST_CIRCLES, distance_mm=800.0, width=2592))


@pytest.mark.slow
def test_each_face_is_named_with_any_three_circles_hidden_and_no_four_are_alike_in_two_readings(made):
    """All cases, by the finder in made views, which the maker has run, and by the naming alone. Nor are they alike with
    another face, turned, or in a mirror: by the package's own search for likeness."""
    target = made.target
    assert made.cases == 5 * 84
    assert made.likeness < MIN_COMMON
    assert not any(confusable(face, target) for face in target.faces)
    assert mirror_images(target) == {}
    for face in target.faces:
        for gone in combinations(range(len(face.ids)), HIDDEN):
            assert is_named(face, set(range(len(face.ids))) - set(gone), target)
        for other in target.faces:
            assert in_common(face, other, mirrored=True) == 0
        middle = face.rough_target_from_face @ np.append(face.outline_mm.mean(0), 0.0)
        assert middle @ face.rough_target_from_face.rotation[:, 2] > 0.49 * min(SIZE)  # outwards, on the box


class Alike(TargetDesign):
    """Faces that look alike, which a design refuses."""

    def __post_init__(self):
        pass


@pytest.mark.slow
def test_circles_are_seen_well_keep_apart_and_likeness_is_found_where_there_is_some(made):
    """A face beside itself, turned and mirrored; and the cases of hidden circles fail."""
    face = made.target.faces[0]
    turned = type(face)("turned", face.ids, face.xy_mm @ [[0, 1], [-1, 0]], face.radius_mm, face.origin, face.x, face.y)
    mirrored = type(face)("mirrored", face.ids, face.xy_mm * [-1, 1], face.radius_mm, face.origin, face.y, face.x)
    assert in_common(turned, face) == len(face.ids)
    assert in_common(mirrored, face) < MIN_COMMON
    assert in_common(mirrored, face, mirrored=True) == len(face.ids)
    assert in_common(face, face) == 0
    two = Alike("two", "dark", (face, turned))
    camera = DesignOptions(SIZE, width=2592).ideal_camera()
    failed, cases = unnamed_cases(two, camera, 800.0, HIDDEN, None)
    assert len(failed) == cases == 168
    target, options = made.target, made.options
    px_per_mm = options.ideal_camera().focal[0] / (1.1 * options.distance_mm)
    assert 2 * made.radius_mm * px_per_mm * np.sqrt(np.cos(np.radians(70))) > 1.4 * 4.5
    for face in target.faces:
        assert set(face.radius_mm) == {made.radius_mm, LARGE * made.radius_mm}
        gap = np.linalg.norm(face.xy_mm[:, None] - face.xy_mm, axis=2) - face.radius_mm[:, None] - face.radius_mm
        assert gap[~np.eye(len(gap), dtype=bool)].min() > 0.5 * made.radius_mm


@pytest.mark.full
def test_a_pattern_that_is_not_always_named_is_drawn_anew(monkeypatch):
    """Nine circles leave six, which is all that a face needs: of such patterns one in a few fails a case."""
    options = DesignOptions((130.0, 120.0, 110.0), circles=LEAST_CIRCLES, width=1296)
    with monkeypatch.context() as once:
        once.setattr(make, "ATTEMPTS", 1)
        refuses("E-MAKE-UNNAMED … 1 … 420 … 1", make_target, options)
    assert make_target(options).cases == 5 * 84


def test_faces_lie_on_the_box_some_sides_alone_have_circles_and_sizes_are_three_lengths():
    """Plates' corners are corners of the box, shared by three faces but for those below; normals point outwards."""
    corners = []
    for face in make_pattern(sides_of(SIZE), LEAST_CIRCLES, 4.0, "dark", 0, "box")[0].faces:
        assert face.rough_target_from_face is not None
        assert face.outline_mm is not None
        place = face.rough_target_from_face @ np.pad(face.outline_mm, ((0, 0), (0, 1)))
        corners += np.round(place, 6).tolist()
        assert place.mean(0) @ face.rough_target_from_face.rotation[:, 2] > 0.49 * min(SIZE)
    w, h, d = SIZE
    counts = {tuple(c): corners.count(c) for c in corners}
    box = {(x, y, z) for x in (-w / 2, w / 2) for y in (-d / 2, d / 2) for z in (-h / 2, h / 2)}
    assert set(counts) == box
    assert all(n == (3 if z > 0 else 2) for (_, _, z), n in counts.items())
    assert faces_of("") == NAMES
    names = faces_of("top, front")
    assert [side.name for side in sides_of(SIZE, names)] == ["top", "front"]
    every = {side.name: side.box_from_plate.matrix() for side in sides_of(SIZE)}
    for side in sides_of(SIZE, names):
        np.testing.assert_array_equal(side.box_from_plate.matrix(), every[side.name])
    for size in ("130,110", "a,b,c", "0,1,1", "nan,1,1", "1e6,1,1"):
        with pytest.raises(InputError, match="--size"):
            DesignOptions(size_of(size))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"radius_mm": 1.0}, "E-MAKE-RADIUS … --radius-mm … 1 … 1000 … 2.28"),
        ({"radius_mm": 60.0, "distance_mm": 500.0}, "E-MAKE-RADIUS"),
        ({"circles": 8}, "E-MAKE-CIRCLES … --circles … 8 … 9 … 6 … 3"),
        ({"circles": 40, "radius_mm": 9.0}, "E-MAKE-ROOM … front … 40 … 9 … 14.4"),
        ({"faces": faces_of("front,under")}, "E-OPTION-VALUE … --faces … under … front, right"),
        ({"faces": faces_of("front,right,front")}, "E-OPTION-REPEATED … --faces … front"),
        ({"faces": faces_of("top")}, "E-OPTION-VALUE … --faces top … two sides"),
        ({"faces": faces_of("left,right")}, "E-OPTION-VALUE … --faces left,right … two sides"),
    ],
)
def test_what_cannot_be_made_is_refused(options, said):
    refuses(said, lambda: make_target(DesignOptions(SIZE, **options)))


def test_outlines_at_any_angle_are_taken_and_those_that_do_not_fit_refused(tmp_path):
    for outline, said in (
        ("[[-5, -5], [90, -5], [90, 90], [-5, 90]]", "E-TARGET-OUTLINE … outline_mm"),
        ("[[-50, -50], [-50, -50], [190, 190]]", "E-TARGET-OUTLINE"),
        ("[[-50, -50], [190, 190]]", "E-KEY-VALUE … outline_mm"),
        ("[[300, -50], [400, -40], [390, 190], [290, 180]]", "E-TARGET-OUTLINE … outline_mm"),  # beside all circles
    ):
        text = target_toml(second_design()[0]).replace("circles = [", f"outline_mm = {outline}\ncircles = [", 1)
        (tmp_path / "target.toml").write_text(text)
        refuses(said, load_target, tmp_path / "target.toml")
    design = second_design()[0]
    middle, reach = design.faces[0].xy_mm.mean(0), np.ptp(design.faces[0].xy_mm, axis=0).max()
    angles = np.radians(50) + np.pi * np.array([0.1, 0.8, 1.2, 1.7])  # no two sides are parallel
    corners = middle + 3 * reach * np.column_stack([np.cos(angles), np.sin(angles)])
    text = target_toml(design).replace("circles = [", f"outline_mm = {corners.tolist()}\ncircles = [", 1)
    (tmp_path / "target.toml").write_text(text)
    np.testing.assert_allclose(load_target(tmp_path / "target.toml").faces[0].outline_mm, corners)


@pytest.mark.slow
def test_box_and_board_fit_the_image_side_by_side():
    distance_mm = 400.0
    made = make_target(
        DesignOptions((130.0, 110.0, 90.0), LEAST_CIRCLES, distance_mm=distance_mm, faces=("front", "right"))
    )
    assert made.board.radius_mm >= made.least_mm
    target = made.target
    planned = plan(PlanOptions(images=2, distance_mm=distance_mm), target, made.board, target.rough_poses())
    assert planned.forecast.worst()[1] > 0


@pytest.mark.slow
def test_the_command_keeps_a_board_and_replaces_nothing(made, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(make, "make_target", lambda *_: made)
    (tmp_path / "board.toml").write_text('rows = 5\ncolumns = 6\npitch_mm = 40\nradius_mm = 10\npolarity = "dark"\n')
    before = (tmp_path / "board.toml").read_text()
    command(tmp_path, "130,110,100", circles=9, images=2, width=2592, distance=800.0)
    said = capsys.readouterr().out
    assert "named with any 3 circles hidden: 420 of 420 cases" in said
    assert "worst is face" in said  # the forecast
    assert (tmp_path / "board.toml").read_text() == before
    assert load_board(tmp_path / "board.toml").rows == 5
    assert load_target(tmp_path / "target.toml").rough_poses().keys() == {"front", "right", "back", "left", "top"}
    refuses("E-OUTPUT-EXISTS", command, tmp_path, "130,110,100")
