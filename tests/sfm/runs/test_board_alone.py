"""Photographs of the board alone: λ and its residuals, as in Zhang & Wei's table 1. What cannot be solved is refused
before anything is mapped, and says what to add."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from stcal import Camera, Rigid, reference_board
from stcal.boards.target_file import target_toml
from stcal.errors import InputError, MappingError
from stcal.io.images import Skipped
from stcal.sfm.detect.labelling import PlaneView, _numbered
from stcal.sfm.runs.stages import LIKELY, explained, usable_groups, wrong_file
from tests.outcome import COMPUTATION, INPUT, fails_with, refuses
from tests.sfm.conftest import SmallSet
from tests.sfm.runs.test_bad_input import blacken
from tests.shared import own_copy

BOARD = reference_board()


@pytest.fixture(scope="module")
def hidden(small_dataset, small_scene, tmp_path_factory):
    own = SmallSet(tmp_path_factory.mktemp("alone") / "set")
    own_copy(small_dataset, own.folder)
    blacken(own, small_scene, "12", board=False, count=4)
    shutil.rmtree(own.images / "14")
    return own


@pytest.mark.slow
def test_the_board_alone_gives_scale_and_residuals(hidden, stcal_sfm):
    code, text, _ = stcal_sfm(*hidden.arguments())
    assert code == 0
    assert "the board alone: no face of the target in 4 images, so that there is no faces.json" in text
    assert not (hidden.out / "faces.json").exists()
    report = json.loads((hidden.out / "report.json").read_text())
    assert (report["faces"], report["summary"]["faces"]) == ({}, 0)
    (group,) = report["groups"]
    assert "by the board" in group["seeded"]
    scale = group["scale"]
    # Dots 5 µm off per axis: 5 √(8/π) = 8 µm in length; σ of the centres adds some at this size.
    assert 4 < scale["board_mean_um"] < 25
    assert scale["board_spread_um"] < scale["board_mean_um"]
    assert scale["board_rms_um"] == pytest.approx(np.hypot(scale["board_mean_um"], scale["board_spread_um"]))
    assert f"{scale['board_mean_um']:.2f}" in text
    assert "The board alone" in (hidden.out / "report.html").read_text()
    code, _, error = stcal_sfm("advise", hidden.out)
    assert (code, "no faces.json: of the board alone" in error) == (INPUT, True)


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_the_published_method_knows_the_board_alone(hidden, stcal_sfm):
    code, text, _ = stcal_sfm(*hidden.arguments("--solve", "paper", "--no-strict"))
    assert code == 0
    assert "the board alone" in text


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_a_target_in_view_is_asked_for(small_set, small_scene, stcal_sfm):
    """Dark circles are sought and bright ones in view: the file is wrong, unless that does not matter."""
    small = small_set("12", detected=False)
    path = small.folder / "target.toml"
    path.write_text(target_toml(replace(small_scene.target, polarity="dark")), encoding="utf-8")
    code, _, error = stcal_sfm(*small.arguments("--target", path))
    assert code == COMPUTATION
    assert "group 12: no face of the target recognised in 4 images" in error
    assert "polarity" in error
    assert "use --board-only" in error
    code, text, _ = stcal_sfm(*small.arguments("--target", path, "--board-only", "--no-strict"))
    assert code == 0
    assert "the board alone" in text


def views(roll_deg: float) -> list[PlaneView]:
    """Both numberings of the reference board, from a camera that is turned about its axis."""
    labels = BOARD.labels()
    xy = BOARD.xy_mm()
    turn = np.radians(roll_deg)
    pose = Rigid.exp([0, 0, turn, 0, 0, 0]) @ Rigid(np.eye(3), [-120.0, -90, 900])
    half_turn = Rigid(np.diag([-1.0, -1, 1]), [240.0, 180, 0])
    none = np.zeros((len(labels), 2))
    common = {"plane": "board", "labels": tuple(labels), "rows": np.arange(len(labels)), "xy_mm": xy, "xy": none}
    return [PlaneView(**common, area=1.0, camera_from_plane=each) for each in (pose, pose @ half_turn)]


def test_numberings_follow_the_camera_up_to_a_quarter_turn_and_whether_an_image_shows_the_board_whole():
    """From each image to its nearest, over more than a quarter turn in all. Of a board with a covered strip, numberings
    a pitch apart do not differ by the camera's turn."""
    rolls = [0, 35, 70, 105]
    chosen = _numbered([views(r)[::-1] if i % 2 else views(r) for i, r in enumerate(rolls)])
    for view, roll in zip(chosen, rolls, strict=True):
        assert np.allclose(view.camera_from_plane.matrix(), views(roll)[0].camera_from_plane.matrix())
    first, second = _numbered([views(0), views(88)])
    assert isinstance(first, PlaneView)
    assert "2 numberings fit, the camera is turned by 88° or 92° from the nearest image" in second
    shifted = [replace(v, camera_from_plane=v.camera_from_plane @ Rigid(np.eye(3), [30.0, 0, 0])) for v in views(20)]
    chosen = _numbered([[*views(20), *shifted], views(0)])
    assert [isinstance(each, PlaneView) for each in chosen] == [False, True]
    assert "4 numberings fit, the camera is turned by 20° or 20°" in chosen[0]


@pytest.fixture(scope="module")
def group(scene, labels_only):
    images = labels_only.observations(scene, 0.01, np.random.default_rng(0))
    return [image for image in images if image.group == images[0].group]


def only(group, board: bool):
    return [
        image.select([i for i, label in enumerate(image.labels) if str(label).startswith("board") == board])
        for image in group
    ]


def test_what_is_missing_is_named_and_two_images_with_board_and_face_will_do(group):
    """A group of which every file was skipped is not forgotten; a folder of copies or of notes is no group."""
    with fails_with("E-GROUP-FEW-IMAGES … 1 usable image"):
        usable_groups({group[0].group: group[:1]}, [])
    refuses("E-GROUP-NO-FACE … 5", usable_groups, {"12": only(group, board=True)}, [])
    refuses("E-GROUP-NO-BOARD … 5", usable_groups, {"12": only(group, board=False)}, [])
    lost = [Skipped("99/a.jpg", "cannot be read")]
    usable, notes = usable_groups({"12": group}, lost)
    assert list(usable) == ["12"]
    assert len(notes) == 1
    assert notes[0].startswith("left out whole: group 99: 0 usable images, 2 needed, not 99/a.jpg: cannot be read")
    with fails_with("E-GROUP-FEW-IMAGES … 99 … 0 usable images"):
        usable_groups({}, lost)
    skipped = [
        Skipped("copies/a.jpg", "the same image as 12/b.jpg", "copy"),
        Skipped("99/notes.txt", "not an image file"),
    ]
    assert usable_groups({"12": group[:2]}, skipped) == ({"12": group[:2]}, [])


@pytest.mark.slow
def test_an_error_of_photographs_that_cannot_be_solved_says_what_of_the_file_is_wrong(scene, group):
    file = Camera.of(scene.camera, "OPENCV")
    file = replace(file, focal=1.25 * file.focal)
    with pytest.raises(MappingError) as error, explained(group, file, scene.board):
        raise MappingError("E-GROUP-CONTRADICTS", "group 12: a symptom")
    symptom, _, cause = str(error.value).partition(LIKELY)
    assert symptom == "group 12: a symptom"
    assert "the focal length is not" in cause
    assert re.search(r"-20(\.0|) ± ", cause)
    assert "px RMS" in cause


def test_an_error_names_no_cause_that_the_photographs_do_not_tell(scene, group):
    """A camera file that fits the dots; the board out of view; and a mistake in the input."""
    file = Camera.of(scene.camera, "OPENCV")
    assert wrong_file(group, file, scene.board) is None
    assert wrong_file(only(group, board=False), replace(file, focal=2 * file.focal), scene.board) is None
    with pytest.raises(InputError) as error, explained(group, replace(file, focal=2 * file.focal), scene.board):
        raise InputError("E-OPTION-VALUE", "a symptom")
    assert str(error.value) == "a symptom"
