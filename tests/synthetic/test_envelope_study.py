"""The study of the envelope, without the program: what it degrades, and how it judges."""

import numpy as np
import pytest

from stcal.io.cameras.read import read_camera
from tests.conftest import SAMPLE
from tests.scripts import load_script

study = load_script("envelope_study")
DATA = study.read_set(SAMPLE, at_most=1)
KINDS = {kind.name: kind for kind in study.KINDS}
HEADER = "image,label,x_px,y_px,sigma_px\n"


def written(name: str, strength: int, folder) -> dict:
    return study.write_case(KINDS[name], study.Case(DATA, name, KINDS[name].values[strength - 1]), folder)


def perfect(pictures: dict, skip: set[str] = frozenset()) -> list[tuple[str, str, np.ndarray]]:
    """Image, label and place of all circles that must be found, the board turned round."""
    rows = []
    for photo in DATA.photographs:
        picture = pictures[photo.name.rpartition(".")[0]]
        for label, (centre, _) in photo.ellipses().items():
            if photo.must_find[label] and label not in picture.hidden | skip:
                name = label
                if label.startswith("board:"):
                    row, column = divmod(62 - int(label[6:]), 9)
                    name = f"board:{row}:{8 - column if picture.mirrored else column}"
                rows.append((photo.name, name, picture.place(centre) if picture.place else centre))
    return rows


def judged(rows: list, pictures: dict, folder) -> dict:
    text = "".join(f"{image},{label},{x},{y},0.01\n" for image, label, (x, y) in rows)
    folder.mkdir(exist_ok=True)
    (folder / "detections.csv").write_text(HEADER + text)
    return study.judge_labels(DATA, pictures, folder)


@pytest.mark.parametrize(("name", "strength"), [("plain", 1), ("small circles", 5), ("rotated", 1), ("mirrored", 3)])
def test_true_places_are_right_wherever_pixels_went(name, strength, tmp_path):
    pictures = written(name, strength, tmp_path)
    counts = judged(perfect(pictures), pictures, tmp_path / "run")
    assert counts["wrong"] == 0
    assert (counts["found"], counts["dots"]) == (counts["must"], counts["must_dots"])
    assert counts["must_dots"] == {"mirrored": 0}.get(name, 4 * 63)


def test_what_is_wrong_or_missing_is_counted(tmp_path):
    pictures = written("circles hidden", 3, tmp_path)
    rows = perfect(pictures)
    hidden = sum(len(picture.hidden) for picture in pictures.values())
    assert hidden == sum(3 * len(photo.faces) for photo in DATA.photographs)
    right = judged(rows, pictures, tmp_path / "run")
    assert right["wrong"] == 0
    assert right["must"] < 80
    image, label, place = rows[0]
    away = [(image, label, place + 6.0), *rows[1:]]
    counts = judged(away, pictures, tmp_path / "run")
    assert (counts["wrong"], counts["found"]) == (1, right["must"] - 1)
    name = image.rpartition(".")[0]
    gone = min(pictures[name].hidden & DATA.photographs[0].ellipses().keys())
    counts = judged([*rows, (image, gone, DATA.photographs[0].ellipses()[gone][0])], pictures, tmp_path / "run")
    assert (counts["wrong"], counts["found"]) == (1, right["must"])


def test_a_turned_camera_sees_what_turned_pixels_show(tmp_path):
    """A ray of the camera of the set, turned by 90°, meets the pixel that the picture's place says."""
    pictures = written("rotated", 1, tmp_path)
    photo = DATA.photographs[0]
    place = pictures[photo.name.rpartition(".")[0]].place
    camera = read_camera(tmp_path / "cameras.txt").sized(1, 1)
    ray = photo.camera.normalised_from_pixel(np.array([300.0, 900.0]))
    turned = np.array([ray[1], -ray[0]])
    assert camera.pixel_from_normalised(turned) == pytest.approx(place(np.array([300.0, 900.0])), abs=1e-6)
    assert (camera.width, camera.height) == photo.grey.shape


def test_a_row_is_silent_without_a_failed_check():
    row = {"worst_sigma": 4.5, "failed": []}
    assert study.silent(row)
    assert not study.silent(row | {"failed": ["camera"]})
    assert not study.silent(row | {"worst_sigma": 3.9})
    assert not study.silent(row | {"worst_sigma": None})


def test_every_kind_has_five_strengths_and_a_name_of_its_own():
    assert all(len(kind.values) == 5 for kind in study.KINDS if kind.name != "plain")
    assert len({kind.name for kind in study.KINDS}) == len(study.KINDS) >= 30
