"""Folders of groups that were forgotten, or given one level too high: what was assumed, and what to do."""

import pytest

from tests.outcome import INPUT, assert_error

pytestmark = pytest.mark.usefixtures("no_page")


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
