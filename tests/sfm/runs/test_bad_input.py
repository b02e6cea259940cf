"""Bad input gets one line that names the thing and the remedy; odd but valid input is taken as it is. Of designs and
folders of groups that were forgotten or are wrong: what was assumed, and what the images say."""

import csv
import json
import os
import re
import shutil
from collections import Counter
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from stcal import StcalError
from stcal.boards.target_file import target_toml
from stcal.io.cameras.read import read_camera
from stcal.io.images import decode
from stcal.sfm.data.group_model import GROUP_LEFT_OUT
from stcal.sfm.detect import detect_files as files
from stcal.sfm.pipeline import run
from stcal.synthetic import RenderOptions, SceneOptions, make_scene, second_design, write_dataset
from stcal.synthetic.scene import image_circles
from tests.outcome import COMPUTATION, INPUT, INTERRUPTED, assert_error, lines_of, refuses

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_page")]

CHAIN = ("--solve", "chain")
"""For what is seen before faces are adjusted together, which takes half of a small run's time."""
RESULTS = ("faces.json", "report.json", "report.html", "colmap")


def assert_success(outcome) -> str:
    """No word on standard error but progress; returns standard output."""
    code, out, err = outcome
    assert (code, lines_of(err)) == (0, [])
    return out


def detections(out: Path) -> dict[tuple[str, str], tuple[float, float]]:
    """(image, label) → centre, px, of a run or of a detection alone."""
    table = next(out / name for name in ("labels.csv", "detections.csv") if (out / name).exists())
    with table.open(encoding="utf-8", newline="") as file:
        return {(row["image"], row["label"]): (float(row["x_px"]), float(row["y_px"])) for row in csv.DictReader(file)}


def pixels(path: Path) -> np.ndarray:
    return decode(path.read_bytes(), path.name)


def encoded(suffix: str, image: np.ndarray, *parameters: int) -> bytes:
    return cv2.imencode(suffix, image, parameters)[1].tobytes()


def box_around(scene, group: str, image: int, board: bool) -> tuple[slice, slice]:
    """Rows and columns about the board's dots, or the target's circles, of an image."""
    seen = image_circles(scene, group, image)
    xy = np.array([c for label, c in zip(seen.labels, seen.centre_px, strict=True) if label.startswith("b") == board])
    (x0, y0), (x1, y1) = np.maximum(xy.min(0).astype(int) - 12, 0), xy.max(0).astype(int) + 13
    return slice(y0, y1), slice(x0, x1)


def blacken(small, scene, group: str, board: bool, count: int) -> None:
    """Hide the board, or the target, in the first images of a group, and take its others away."""
    for i in range(count, 4):
        small.image(i, group).unlink()
    for i in range(count):
        picture = pixels(small.image(i, group)).copy()
        picture[box_around(scene, group, i, board)] = np.median(picture)
        small.image(i, group).write_bytes(encoded(".jpg", picture))


def test_inputs_that_are_not_there(small_set, stcal_sfm):
    """Designs that are impossible are in tests/boards/test_target_files.py."""
    small = small_set("12")
    outcome = stcal_sfm("run", small.camera, "--camera", small.camera, "--out", small.out)
    assert_error(outcome, INPUT, "E-VIDEO-UNREADABLE", str(small.camera), "a folder of images")
    assert not (small.out / ".stcal/cache" / "frames").exists()
    path = small.folder / "none.toml"
    for kind in ("--target", "--board"):
        outcome = stcal_sfm(*small.arguments(kind, path))
        assert_error(outcome, INPUT, "E-FILE-UNREADABLE", str(path), "`stcal-sfm init DIR` writes one")
    for photograph in (small.images / "12").iterdir():
        photograph.write_bytes(b"")
    parts = ("4", "12/IMG_1000.jpg", "empty file (0 bytes); copy it again")
    assert_error(stcal_sfm(*small.arguments()), INPUT, "E-IMAGES-NONE-USABLE", *parts)
    shutil.rmtree(small.images / "12")
    refuses("E-IMAGES-NONE", stcal_sfm, *small.arguments("--debug"))  # which lets the error through


def test_bad_files_among_good_ones_are_left_out_and_listed(small_set, stcal_sfm):
    """Each photograph once, in whatever form and however often it lies in the folder; and one that shows no circle."""
    small = small_set("12")
    good = pixels(small.image())
    folder = small.images / "12"
    bad = {
        "cut.jpg": (small.image().read_bytes()[:-5000], "truncated"),
        "cut.png": (encoded(".png", good)[:-5000], "truncated"),
        "cut.tif": (encoded(".tif", good)[:-5000], "not readable"),
        "zero.jpg": (b"", "empty file (0 bytes)"),
        "text.png": (b"this is no image", "not readable"),
        "small.jpg": (encoded(".jpg", good[:-1]), "1296×863 px, but the camera file says 1296×864 px"),
        "float.tif": (encoded(".tif", good.astype(np.float32)), "pixels of type float32; 8 or 16 bit needed"),
        "notes.txt": (b"f/8, ISO 100", "not an image file"),
        "IMG_1002 (copy).jpg": (small.image(2).read_bytes(), "the same image as 12/IMG_1002.jpg"),
        "Copy of IMG_1003.jpg": (small.image(3).read_bytes(), "the same image as 12/IMG_1003.jpg"),
    }
    # Damage that decoders do not report: bytes in the middle are gone, the picture comes out shifted.
    data = bytearray(small.image(1).read_bytes())
    data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
    bad["garbled.jpg"] = (bytes(data), "damaged (Corrupt JPEG data")
    data = bytearray(encoded(".png", good))
    data[len(data) // 2] ^= 255
    bad["garbled.png"] = (bytes(data), "damaged (a checksum is wrong)")
    for name, (content, _) in bad.items():
        (folder / name).write_bytes(content)
    (folder / "link.jpg").symlink_to(folder / "gone.jpg")
    (folder / "more.jpg").mkdir()
    bad |= {"link.jpg": (b"", "broken link"), "more.jpg": (b"", "a folder inside a group")}
    (folder / "IMG_1001.png").write_bytes(encoded(".png", pixels(small.image(1))))
    bad["IMG_1001.jpg"] = (b"", "the same image as 12/IMG_1001.png, saved in another form")
    (folder / "black.png").write_bytes(encoded(".png", np.zeros_like(good)))
    out = assert_success(stcal_sfm(*small.arguments(*CHAIN)))
    report = (small.out / "report.json").read_text(encoding="utf-8")
    for name, (_, reason) in bad.items():
        line = next(line for line in out.splitlines() if line.startswith(f"skipped 12/{name}: "))
        assert reason in line
        assert f"12/{name}" in report
    assert sum(line.startswith("skipped ") for line in out.splitlines()) == len(bad)
    assert json.loads(report)["summary"]["images_mapped"] == 4
    assert {image for image, _ in detections(small.out)} == {
        f"12/IMG_100{end}" for end in ("0.jpg", "1.png", "2.jpg", "3.jpg")
    }
    ((name, reason),) = ((each["name"], each["reason"]) for each in json.loads(report)["left_out"]["images"])
    assert (name, "0 of its circles or corners are in the model, 6 needed" in reason) == ("12/black.png", True)


def test_a_group_without_the_board_and_a_photograph_in_two_groups(small_set, small_scene, stcal_sfm):
    """The run goes on without group 14, says why, and does not claim its face; the photograph is in neither group."""
    small = small_set("12", "14")
    blacken(small, small_scene, "14", board=True, count=2)
    shutil.copy(small.image(3, "12"), small.images / "14" / "IMG_0999.jpg")
    out = assert_success(stcal_sfm(*small.arguments(*CHAIN, "--no-strict")))
    for name in ("12/IMG_1003.jpg", "14/IMG_0999.jpg"):
        said = f"skipped {name}: the same photograph is in groups 12 and 14, and belongs to one"
        assert said in " ".join(out.split())
    assert re.search(r"May I use it\? (No|Part, with care): .*group\s+14\s+was\s+left\s+out\s+completely", out, re.S)
    notes = json.loads((small.out / "report.json").read_text())["notes"]
    (note,) = (note["note"] for note in notes if (note["code"], note["place"]) == (GROUP_LEFT_OUT, "14"))
    parts = ("group 14: no board recognised in 2 images", "keep the whole board in view", "board.toml")
    assert [part for part in parts if part not in note] == []
    assert "left out whole: group 14" in out
    faces = json.loads((small.out / "faces.json").read_text())["target_from_face"].keys()
    assert {"1", "2"} <= faces
    assert "4" not in faces


def opencv_yaml(focal: float, x: float, y: float, distortion: list[float]) -> str:
    """A camera file that does not state the image size."""
    matrix = [float(v) for v in (focal, 0, x, 0, focal, y, 0, 0, 1)]
    return f"%YAML:1.0\n---\ncamera_matrix: {matrix}\ndistortion_coefficients: {distortion}\n"


OUTSIDE = ("(2592, 1728) px is outside of 12/IMG_1000.jpg (1296×864 px)", "use the camera file that belongs")
WRONG_CAMERAS = [
    (None, INPUT, ("No such file", "camera file ")),
    ("prose", INPUT, ("E-CAMERA-UNREADABLE", "camera file ")),
    (opencv_yaml(5580, 2592, 1728, []), INPUT, ("E-CAMERA-CENTRE", "camera.yml", *OUTSIDE)),  # for larger images
    (
        opencv_yaml(3000, 648, 432, []),  # another one than took the images
        COMPUTATION,
        ("group 12: ", "check that the camera file belongs to the images"),
    ),
]


@pytest.mark.parametrize(("content", "code", "parts"), WRONG_CAMERAS)
def test_a_camera_file_that_is_none_or_not_of_the_images(small_set, stcal_sfm, content, code, parts):
    """Others are in tests/io/test_camera.py."""
    small = small_set("12")
    small.image(3).unlink()
    path = small.folder / "camera.yml"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    assert_error(stcal_sfm(*small.arguments("--camera", path)), code, *parts)


def test_a_foreign_folder_is_refused_and_left_alone(small_set, stcal_sfm):
    small = small_set("12", detected=False)
    small.out.mkdir()
    (small.out / "faces.json").write_text("mine", encoding="utf-8")
    outcome = stcal_sfm(*small.arguments())
    assert_error(outcome, INPUT, "E-OUTPUT-EXISTS", str(small.out), "--out")
    assert [p.name for p in small.out.iterdir()] == ["faces.json"]
    assert (small.out / "faces.json").read_text(encoding="utf-8") == "mine"


def test_an_interrupted_run_keeps_what_it_has_detected(small_set, stcal_sfm, monkeypatch):
    """Ctrl-C in the second photograph of two."""
    small = small_set("12", detected=False)
    for i in (2, 3):
        small.image(i).unlink()
    detected, detect_image = [], files.detect_image

    def second_is_interrupted(*given):
        detected.append(given)
        if len(detected) == 2:
            raise KeyboardInterrupt
        return detect_image(*given)

    monkeypatch.setattr(files, "detect_image", second_is_interrupted)
    code, _, err = stcal_sfm(*small.arguments(*CHAIN))
    assert code == INTERRUPTED
    (line,) = lines_of(err)
    assert line.startswith("interrupted; finished detections are kept, run the same command again")
    assert {p.name for p in small.out.iterdir()} == {".stcal"}
    assert_success(stcal_sfm(*small.arguments(*CHAIN)))
    assert [name for name in RESULTS if not (small.out / name).exists()] == []
    assert len(detected) == 3  # the first one was kept


def same_centres(found, expected, tolerance_px: float) -> None:
    assert found.keys() == expected.keys()
    assert len(found) > 70
    worst = max(np.hypot(*np.subtract(found[key], expected[key])) for key in found)
    assert worst <= tolerance_px


def test_formats_of_the_same_pixels(small_set):
    """With a trailer, as telephones append a video, with bytes in it that mean something in a JPEG; PNG with alpha."""
    path = small_set("12").image()
    data, grey = path.read_bytes(), pixels(path)
    with_alpha = np.dstack([grey, grey, grey, np.full_like(grey, 128)])
    for content in (data + b"ftypmp42 \xff\xd9 \xff\xda \xff\xc4 and so on", encoded(".png", with_alpha)):
        path.write_bytes(content)
        np.testing.assert_array_equal(pixels(path), grey)


def test_a_format_of_more_bits_and_names_that_are_not_utf8(small_set, small_run, stcal_sfm):
    """16 bit are scaled so that the bright end just fits, edges are found at other grey levels."""
    small = small_set("12")
    for i in (1, 2, 3):
        small.image(i).unlink()
    (small.images / "12" / "two\nlines.jpg").write_bytes(small.image().read_bytes())
    latin = Path(os.fsdecode(os.fsencode(small.images / "12") + b"/caf\xe9.jpg"))
    with suppress(OSError):  # of a file system that takes UTF-8 only
        latin.write_bytes(small.image().read_bytes())
    small.image().write_bytes(encoded(".tif", pixels(small.image()).astype(np.uint16) * 257))
    arguments = ("detect", small.images, "--camera", small.camera, "--out", small.out, "--workers", 1)
    out = assert_success(stcal_sfm(*arguments))
    said = re.search(r"^skipped 12/caf\S+\.jpg: its name is not UTF-8; rename it$", out, re.M)
    assert bool(said) == latin.exists()
    assert re.search(r"^skipped 12/two\S+\.jpg: its name holds a control character; rename it$", out, re.M)
    expected = {key: xy for key, xy in detections(small_run).items() if key[0] == "12/IMG_1000.jpg"}
    same_centres(detections(small.out), expected, 0.02)


def test_a_camera_of_opencv_without_a_size_and_two_targets_in_view(small_set, small_run, small_scene, stcal_sfm):
    """A picture of the target lies in one image's corner: neither is read, and the real one is measured where the group
    predicts it."""
    small = small_set("12")
    camera = read_camera(small.camera)
    path = small.folder / "camera.yml"
    text = opencv_yaml(camera.focal[0], *camera.centre, camera.distortion[:5].tolist())
    path.write_text(text, encoding="utf-8")
    small.image(3).write_bytes(encoded(".jpg", pixels(small.image(3))[:-100]))
    picture = pixels(small.image()).copy()
    copied = picture[box_around(small_scene, "12", 0, board=False)]
    height, width = copied.shape
    picture[-height - 20 : -20, 20 : 20 + width] = copied
    small.image().write_bytes(encoded(".jpg", picture, cv2.IMWRITE_JPEG_QUALITY, 95))
    out = assert_success(stcal_sfm(*small.arguments("--camera", path, *CHAIN)))
    assert "skipped 12/IMG_1003.jpg: 1296×764 px, but the majority of the images says 1296×864 px" in out
    found, expected = (
        {key: xy for key, xy in detections(run).items() if key[0].startswith("12/IMG_1001")}
        for run in (small.out, small_run)
    )
    same_centres(found, expected, 1e-5)
    report = json.loads((small.out / "report.json").read_text())
    notes = [each["note"] for each in report["left_out"]["notes"] if each["image"] == "12/IMG_1000.jpg"]
    assert any(note.startswith("face 1 found more than once") for note in notes)
    code, _, _ = stcal_sfm("compare", small.out, small.folder / "truth.json")
    labels = json.loads((small.out / "compare.json").read_text())["labels"]
    assert (code, labels["wrong"]) == (0, 0)
    assert labels["found"] >= 0.97 * labels["visible"]  # the copy may cover some


def test_a_second_run_does_only_what_changed(small_set, small_run, stcal_sfm):
    small = small_set("14")
    cache = small.out / ".stcal/cache"

    def stamps() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in cache.glob("*.npz")}

    assert_success(stcal_sfm(*small.arguments(*CHAIN)))
    before = stamps()
    out = assert_success(stcal_sfm(*small.arguments(*CHAIN)))
    assert stamps() == before
    kinds = Counter(name.rpartition("-")[0] for name in before)
    assert kinds.pop("overlay") >= 8  # it crosses out what the result does not use, which another group may decide
    assert kinds == {"": 8, "group": 2}  # a group alone is what it was beside another one
    assert "report: RUN/report.html" in out.replace(str(small.out), "RUN").splitlines()
    own = {key: xy for key, xy in detections(small_run).items() if key[0].startswith("14/")}
    assert detections(small.out) == own

    picture = pixels(small.image(2, "14"))
    small.image(2, "14").write_bytes(encoded(".jpg", cv2.GaussianBlur(picture, (3, 3), 0)))
    assert_success(stcal_sfm(*small.arguments(*CHAIN)))
    after = stamps()
    assert {name: after[name] for name in before} == before
    added = sorted(name.rpartition("-")[0] for name in after.keys() - before.keys())
    assert added == ["", "group", "overlay"]  # of that image
    new = detections(small.out)
    assert {key[0] for key in new if new[key] != own.get(key)} == {"14/IMG_1002.jpg"}


TARGET_ASSUMED = "assumed: the reference target, 5 faces of 10 circles (no --target)"
BOARD_ASSUMED = "assumed: the reference board, 7×9 dots of radius 7.5 mm, pitch 30 mm (no --board)"


@pytest.fixture
def two_images(small_set):
    small = small_set("12", detected=False)
    small.image(3).unlink()
    small.image(2).unlink()
    return small


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


def test_a_run_with_another_pitch_names_the_measured_one(stcal_sfm, small_set):
    small = small_set("12", detected=False)
    board = small.folder / "board.toml"
    board.write_text(board.read_text().replace("pitch_mm = 30.0", "pitch_mm = 25.0"))
    code, _, err = stcal_sfm(*small.arguments("--board", board, "--target", small.folder / "target.toml"))
    assert code == 4
    assert "the board in board.toml is 0.833" in err
    assert "times as large as the drawing in target.toml has the faces" in err


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
