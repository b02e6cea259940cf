"""Designs and folders of groups that were forgotten or are wrong: what was assumed, and what the images say."""

import re

import pytest

from stcal import StcalError, reference_target
from stcal.boards.target_file import target_toml
from stcal.sfm.detect.face_patterns import likeness_notes
from stcal.sfm.pipeline import run
from stcal.synthetic import RenderOptions, SceneOptions, make_scene, second_design, write_dataset
from tests.outcome import INPUT, assert_error

pytestmark = pytest.mark.usefixtures("no_page")

TARGET_ASSUMED = "assumed: the reference target, 5 faces of 10 circles (no --target)"
BOARD_ASSUMED = "assumed: the reference board, 7×9 dots of radius 7.5 mm, pitch 30 mm (no --board)"


@pytest.fixture
def two_images(small_set):
    small = small_set("12", detected=False)
    small.image(3).unlink()
    small.image(2).unlink()
    return small


@pytest.mark.slow
def test_the_reference_board_is_said_and_named_in_an_error(stcal_sfm, two_images, tmp_path):
    target = tmp_path / "target.toml"
    target.write_text(target_toml(second_design()[0]))
    code, out, err = stcal_sfm(*two_images.arguments("--target", target))
    assert code == 3
    assert BOARD_ASSUMED in out
    assert "no face of the target recognised" in err
    assert BOARD_ASSUMED in err.splitlines()[-1]
    assert "; a face in 0 of 2 images, the board in " in err
    page = (two_images.out / "report.html").read_text("utf-8")  # and what there is to look at
    assert "No: group 12: no face of the target recognised in 2 images" in page
    assert re.findall(r'src="(overlays/12/[^"]+)"', page) == [f"overlays/12/{two_images.image(i).name}" for i in (0, 1)]


@pytest.mark.slow
def test_measure_calibrate_camera_and_plan_name_what_they_assumed(stcal_sfm, small_set, small_run, tmp_path):
    small = small_set("12", detected=False)
    for i in (1, 2, 3):
        small.image(i).unlink()
    one = "--workers", 1
    code, out, err = stcal_sfm("calibrate-camera", small.images, "--out", tmp_path / "cameras.txt", *one)
    assert code == 3
    assert "the reference target" in out
    assert "1 of 1 images show the board" in err
    assert "pitch 30 mm (no --board)" in err
    faces = tmp_path / "faces.json"
    faces.write_bytes((small_run / "faces.json").read_bytes())  # without the target.toml beside it
    measured = "measure", small.images, "--camera", small.camera, *one, "--out", tmp_path / "poses.csv", "--faces"
    code, out, err = stcal_sfm(*measured, faces)
    assert code == 0
    assert TARGET_ASSUMED in out
    code, out, err = stcal_sfm(*measured, small_run / "faces.json", "--overwrite")
    assert code == 0
    assert "no --target: " in out
    assert not any(said in out for said in (TARGET_ASSUMED, "reference board"))
    out = stcal_sfm("plan", "--images", 2, "--width", 1296, "--groups", "12")[1]
    assert (TARGET_ASSUMED in out, BOARD_ASSUMED in out) == (True, True)
    out = stcal_sfm("plan", "--run", small_run, "--images", 2, "--groups", "12")[1]
    assert "assumed: " not in out
    assert "1296×864 px" in out


@pytest.mark.slow
def test_a_run_with_another_pitch_names_the_measured_one(stcal_sfm, small_set):
    small = small_set("12", detected=False)
    board = small.folder / "board.toml"
    board.write_text(board.read_text().replace("pitch_mm = 30.0", "pitch_mm = 25.0"))
    code, _, err = stcal_sfm(*small.arguments("--board", board, "--target", small.folder / "target.toml"))
    assert code == 4
    assert "the board in board.toml is 0.833" in err
    assert "times as large as the drawing in target.toml has the faces" in err


def test_faces_that_one_circle_tells_apart_are_noted(stcal_sfm, tmp_path):
    one, mirrored = likeness_notes(reference_target())
    assert "faces 1, 2, 3, 4, 5: one circle tells each from another" in one
    # Their circles c: (94.142, 65.858) and (100, 80), after a motion that fits the other nine.
    assert "1:c against face 2, 15.3 mm" in one
    assert "mirror images: 2 and 4, 3 and 5" in mirrored
    assert likeness_notes(second_design()[0]) == []
    path = tmp_path / "target.toml"
    path.write_text(target_toml(reference_target()))
    code, out, _ = stcal_sfm("plan", "--target", path, "--images", 2, "--width", 1296, "--groups", "12")
    assert code == 0
    assert out.startswith(f"note: {one}\nnote: {mirrored}\n")


@pytest.mark.slow
def test_images_without_folders_are_said_to_be_one_group_and_lost_boards_are_counted(stcal_sfm, small_set):
    small = small_set("12", "14")
    for group in ("12", "14"):
        for i in range(4):
            small.image(i, group).rename(small.images / f"{group}-{i}.jpg")
        (small.images / group).rmdir()
    files = "--target", small.folder / "target.toml", "--board", small.folder / "board.toml", "--solve", "chain"
    code, out, _ = stcal_sfm(*small.arguments(*files))
    assert code == 0
    assert "assumed: 8 images that lie in no folder of a group are one group, in which only the camera moved" in out
    # The board stood elsewhere in the other group: the images of one of both lose it.
    assert "the board of 4 of them (1" in out
    remedy = "put the images of each setting of target and board into a folder of its own, IMAGES/<group>/"
    assert remedy in " ".join(out.split())


def test_the_parent_of_the_images_is_told_from_them(stcal_sfm, small_set):
    small = small_set("12", detected=False)
    outcome = stcal_sfm("run", small.folder, "--camera", small.camera, "--out", small.out)
    parts = ("images lie in <group>/ directly", f"did you mean {small.images}?")
    assert_error(outcome, INPUT, "E-IMAGES-NONE", *parts)
    small.image(0).rename(small.images / "stray.jpg")  # one image is found, and the others are deeper
    code, _, err = stcal_sfm("run", small.folder, "--camera", small.camera, "--out", small.out, "--workers", 1)
    assert code == 3
    assert "group images: 1 usable image (images/stray.jpg), 2 needed" in err
    assert "images/12: a folder inside a group; images lie in <group>/ directly; it holds images" in err
    assert f"did you mean {small.images}?" in err


@pytest.mark.slow
def test_circles_cut_by_a_rim_are_named_where_a_run_fails_and_again_from_what_was_kept(stcal_sfm, tmp_path):
    scene = make_scene(SceneOptions(seed=3, width=1728, height=1152, images_per_group=4, groups=(("2", "3"),)))
    write_dataset(tmp_path, scene, RenderOptions(rim_mm=3.3), workers=1)
    camera, target = tmp_path / "cameras.txt", tmp_path / "target.toml"
    with pytest.raises(StcalError, match=r"; circles cut off on one side in 3 of 4 images: behind a rim\?"):
        run(tmp_path / "images", camera, tmp_path / "out", target)
    command = "detect", tmp_path / "images", "--camera", camera, "--target", target, "--out", tmp_path / "detect"
    first, again = stcal_sfm(*command), stcal_sfm(*command)
    assert "should be in view and not measured" in first[1]
    assert again[1] == first[1]
