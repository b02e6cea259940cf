"""What cannot be solved is refused before anything is mapped, and says what to add."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import InputError, MappingError
from stcal.geometry.camera import Camera
from stcal.io.images import Skipped
from stcal.sfm.runs.stages import LIKELY, explained, usable_groups, wrong_file
from tests.outcome import fails_with, refuses


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
