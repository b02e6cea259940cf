"""A run's folder read back: what was written, number by number, or one line that says which file is wrong."""

import csv
import json
import re
import shutil
from dataclasses import asdict
from importlib import import_module

import cv2
import numpy as np
import pytest

from stcal.design import reference_target
from stcal.errors import InputError
from stcal.io.files import BOARD, CAMERA, DATABASE, TARGET
from stcal.sfm import run, uncertainty_budget
from stcal.sfm.adjust.faces_file import read_target
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.mapping.pairs import PairOptions
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.saved import adjusted_run, load_run
from stcal.sfm.runs.transaction import MarkerFile, run_folder
from tests.outcome import INPUT, assert_error, refuses
from tests.shared import own_copy, unsealed_copy

FRAME = ("id", "ids", "origin", "x", "y")
UNLABELLED = "12/IMG_1001.jpg"
OTHER = RunOptions(
    solve="chain",
    frame="three-point",
    eccentricity=False,
    reference_face="2",
    pairs=PairOptions(max_angle_rad=0.9),
    ellipses=EllipseOptions(min_diameter_px=7.5, max_diameter_px=321.0, min_axis_ratio=0.23, min_contrast=0.07),
    workers=3,
    flatness_mm=0.3,
    exclude=("12/a.jpg", "b.jpg"),
    expect_faces=("1", "2"),
)
SPECIAL = ("refine_camera", "rim", "compare", "board_only")
"""No value is a default but those that only the joint adjustment knows, and that of runs without faces."""


@pytest.fixture(scope="module")
def written(small_dataset, small_run, tmp_path_factory):
    """A run with options of its own, one image in the middle grey, that shows no circle; and the same read back."""
    folder = tmp_path_factory.mktemp("written")
    own_copy(small_dataset, folder / "data")
    (folder / "run").mkdir()
    own_copy(small_run / ".stcal/cache", folder / "run" / ".stcal/cache")
    own_copy(small_run / ".stcal/run.json", folder / "run" / ".stcal")
    grey(folder / "data" / "images" / UNLABELLED)
    options = RunOptions("chain", "three-point", True, "2", PairOptions(np.radians(40)), workers=1)
    data = folder / "data"
    files = [data / name for name in ("images", "cameras.txt")], [data / name for name in ("target.toml", "board.toml")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("stcal.sfm.runs.folder"), "report_html", lambda *_: "")  # as no_page, of one test
        result = run(*files[0], folder / "run", *files[1], options)
    return result, load_run(folder / "run")


def grey(path) -> None:
    path.write_bytes(cv2.imencode(".jpg", np.full((864, 1296), 90, np.uint8))[1].tobytes())


def test_labels_and_centres_are_the_same_numbers(written):
    result, saved = written
    assert [image.name for image in saved.observations] == [image.name for image in result.observations]
    for found, known in zip(saved.observations, result.observations, strict=True):
        assert (found.group, found.labels) == (known.group, known.labels)
        assert np.array_equal(found.centre_px, known.centre_px)  # all 64 bits
        # Undistorted again from the same pixels, by the same iteration to 1e-12.
        assert np.allclose(found.centre, known.centre, rtol=0, atol=1e-11)
        # Squared and rooted again: one rounding of 1.1e-16 each.
        assert np.allclose(found.sigma_px(), known.sigma_px(), rtol=1e-15, atol=0)
    by_name = dict(zip((image.name for image in saved.observations), saved.corrected_px, strict=True))
    for model in (solution.model for solution in result.solutions):
        names = np.array(model.images)[model.image_index]
        found = np.array([by_name[name][k] for name, k in zip(names, model.keypoint, strict=True)])
        assert np.array_equal(found, model.corrected_px())
        assert np.abs(model.shift_px).max() > 0.01  # they differ from the measured ones
    # An image without a label keeps its place.
    assert [image.name for image in saved.groups()["12"]][1] == saved.observations[1].name == UNLABELLED
    assert [len(image.labels) > 70 for image in saved.observations] == [True, False, *[True] * 6]
    assert saved.observations[1].centre_px.shape == saved.corrected_px[1].shape == (0, 2)


def test_a_run_just_made_gives_what_its_folder_gives(small_result, small_run):
    made, read = (uncertainty_budget(each).file.content() for each in (small_result, small_run))
    assert made == read
    assert set(made["faces"]) == {"2", "4", "5"}


def test_camera_designs_options_and_faces_are_the_same(written):
    result, saved = written
    assert saved.camera.same_as(result.camera)
    assert saved.camera.colmap_model == result.camera.colmap_model
    assert saved.target_design.radius_of() == result.target_design.radius_of()
    for found, known in zip(saved.target_design.faces, result.target_design.faces, strict=True):
        assert [getattr(found, n) for n in FRAME] == [getattr(known, n) for n in FRAME]
        assert np.allclose(found.xy_mm, known.xy_mm, rtol=0, atol=1e-9)  # written to nine digits
    assert asdict(saved.board_design) == asdict(result.board_design)
    assert saved.faces.target_from_face.keys() == result.target.target_from_face.keys()
    for face, pose in result.target.target_from_face.items():
        assert np.array_equal(saved.faces.target_from_face[face], pose.matrix())
        np.testing.assert_allclose(saved.target.target_from_face[face].matrix(), pose.matrix(), atol=1e-12)
    for label, covariance in result.target.circle_covariance.items():
        np.testing.assert_allclose(saved.target.circle_covariance[label], covariance, rtol=1e-9)
    assert (saved.options, saved.options.reference_face, saved.faces.reference_face) == (result.options, "2", "2")
    assert saved.photographs == result.photographs == result.out.parent / "data" / "images"
    assert saved.database == result.out / "colmap/database.db"


def test_options_that_are_all_other_than_the_defaults(small_run, tmp_path, monkeypatch):
    """What ``run`` puts into the folder at its start, into a copy of a finished run."""
    default = RunOptions()
    assert all(getattr(OTHER, name) != getattr(default, name) for name in RunOptions.__slots__ if name not in SPECIAL)
    assert all(getattr(OTHER.ellipses, n) != getattr(default.ellipses, n) for n in EllipseOptions.__slots__)
    monkeypatch.chdir(tmp_path)
    with run_folder("new", MarkerFile.of("some images", OTHER), {}):
        pass
    own = own_copy(small_run, tmp_path / "run")
    shutil.copy(tmp_path / "new" / ".stcal/run.json", own / ".stcal")
    saved = load_run(own)
    assert saved.options == OTHER
    assert saved.photographs == tmp_path / "some images"


@pytest.mark.parametrize(
    ("groups", "given", "expected"),
    [
        (("12", "14"), (), ["1", "2", "4"]),
        (("1-2", "4_1"), (), ["1", "2", "4"]),
        (("1", "2"), (), []),  # numbers of groups, most likely
        (("12", "16"), (), []),
        (("12", "far"), (), []),
        (("12", "1-far"), (), []),
        (("12",), ("5", "3"), ["3", "5"]),
        ((".",), ("1",), ["1"]),
    ],
)
def test_which_faces_the_photographs_were_to_show(groups, given, expected):
    assert RunOptions(expect_faces=given).faces_expected(groups, reference_target()) == expected
    assert RunOptions(expect_faces=given, board_only=True).faces_expected(groups, reference_target()) == []


def test_an_expected_face_that_the_design_lacks():
    refuses("E-TARGET-NO-FACE … 7", RunOptions(expect_faces=("7",)).settled, reference_target())
    refuses("E-TARGET-NO-FACE … 9 … 1, 2, 3, 4, 5", RunOptions(reference_face="9").settled, reference_target())


def edit(path, change) -> None:
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")


NEEDED = [CAMERA, TARGET, BOARD, "labels.csv", DATABASE, "report.json", "faces.json"]


@pytest.mark.parametrize("name", NEEDED)
def test_a_file_is_missing(own_run, name):
    (own_run / name).unlink()
    code = "E-RUN-NO-FACES" if name == "faces.json" else "E-RUN-UNFINISHED"
    refuses(f"{code} … {own_run} … {name}", load_run, own_run)


def test_not_a_run(own_run, tmp_path, stcal_sfm):
    (own_run / ".stcal/run.json").unlink()
    for path in (own_run, tmp_path / "nothing", tmp_path / "run" / "faces.json"):
        outcome = stcal_sfm("faces", own_run / "colmap/models", "--run", path)
        assert_error(outcome, INPUT, "E-RUN-FOLDER", f"{path}", ".stcal/run.json", "--out")


def test_a_folder_of_detections_only(small_set, stcal_sfm):
    small = small_set("12")
    stcal_sfm("detect", small.images, "--camera", small.camera, "--out", small.out, "--workers", 1)
    outcome = stcal_sfm("faces", small.out, "--run", small.out)
    assert_error(outcome, INPUT, "E-RUN-UNFINISHED", str(small.out), f"{CAMERA}, {TARGET}")


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        (".stcal/run.json", b"[1]", "CONTENT"),
        ("report.json", b"\xff\xfe", "INVALID"),
        ("faces.json", b"[" * 100_000, "INVALID"),
    ],
)
def test_a_file_that_is_no_json_object(own_run, name, content, code):
    (own_run / name).write_bytes(content)
    refuses(f"E-JSON-{code} … {own_run / name} … run it again", load_run, own_run)


WRONG = {
    "of before images were written": (".stcal/run.json", lambda c: c.pop("images"), "no 'images'"),
    "of before circles were written": ("faces.json", lambda c: c.pop("circles"), "no 'circles'"),
    "options null, as of detect": (".stcal/run.json", lambda c: c.update(options=None), "no 'pairs'"),
    "an option unknown here": (".stcal/run.json", lambda c: c["options"].update(magic=1), "magic"),
    "no such face": (".stcal/run.json", lambda c: c["options"].update(reference_face="9"), "no face 9"),
    "report's images a list of names": ("report.json", lambda c: c.update(images=["a", "b"]), "images.1: 'a': "),
    "a group without pairs": ("report.json", lambda c: c["groups"][0].update(pairs=[]), "index out of range"),
    "a group missing": ("report.json", lambda c: c["groups"].pop(), "no '14'"),
    "another group's pair": (
        "report.json",
        lambda c: c["groups"][0].update(pairs=c["groups"][1]["pairs"]),
        "group 12: its initial pair is not of its images",
    ),
    "the residual a word": ("report.json", lambda c: c["summary"].update(residual_rms_px="small"), "'small'"),
    "names that are none": (
        ".stcal/run.json",
        lambda c: c["options"].update(exclude=[7]),
        "options: exclude <1>: a tuple, each a text, needed",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_value_that_no_run_writes(own_run, case):
    name, change, part = WRONG[case]
    edit(own_run / name, change)
    refuses(f"E-RUN-DAMAGED … {own_run / name}: damaged, or of another version … {part}", load_run, own_run)


def rows(change):
    """A change of the rows of labels.csv, each a list of values, without the header."""

    def apply(path) -> None:
        with path.open(encoding="utf-8", newline="") as stream:
            header, *body = csv.reader(stream)
        body = change(body)
        with path.open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows([header, *body])

    return apply


def value(row: int, column: int, text: str):
    return rows(lambda body: [*body[:row], [*body[row][:column], text, *body[row][column + 1 :]], *body[row + 1 :]])


ORDER = "image 12/IMG_1000.jpg: its keypoints are not 0 to 8"
LABELS = {
    "two rows swapped": (rows(lambda body: [body[1], body[0], *body[2:]]), ORDER),
    "a row missing": (rows(lambda body: body[:5] + body[6:]), ORDER),
    "an image not of the run": (value(4, 2, "12/other.jpg"), "no '12/other.jpg'"),
    "a label not of the target": (value(4, 4, "7:1"), "image 12/IMG_1000.jpg: no circle 7:1"),
    "a label twice": (rows(lambda body: [body[0], [*body[1][:4], body[0][4], *body[1][5:]], *body[2:]]), "label twice"),
    "a word for a number": (value(4, 5, "left"), "'left'"),
    "not a number": (value(4, 7, "nan"), "not finite"),
    "σ of zero": (value(4, 9, "0"), "covariance: variance 0 of x, a positive number needed"),
    "cut in a row": (lambda path: path.write_bytes(path.read_bytes()[:-25]), "run it again"),
    "not UTF-8": (lambda path: path.write_bytes(b"\xff\xfe\xff"), "utf-8"),
    "no such column": (lambda path: path.write_text(path.read_text().replace("var_x_px2", "s", 1)), "no 'var_x_px2'"),
    "one endless field": (lambda path: path.write_text('image\n"' + 200_000 * "x"), "field larger than"),
}


@pytest.mark.parametrize("case", LABELS)
def test_labels_that_are_not_the_database_s(own_run, case):
    spoil, part = LABELS[case]
    spoil(own_run / "labels.csv")
    refuses(f"E-RUN-DAMAGED … {own_run / 'labels.csv'}: damaged, or of another version ( … {part}", load_run, own_run)


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        (CAMERA, "1 PINHOLE 9 9 1 1 1", "3 parameters of PINHOLE, 4 needed"),
        (TARGET, "polarity = 3", "polarity"),
        (BOARD, "rows", "not valid TOML"),
    ],
)
def test_a_damaged_copy_of_what_the_run_was_given(own_run, name, content, part):
    (own_run / name).write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=f"file {own_run / name}: .*{part}"):
        load_run(own_run)


def test_rows_of_the_images_in_another_order_are_the_same(small_run, tmp_path):
    """Rows name their image; what counts is their order in it."""
    run = unsealed_copy(small_run, tmp_path / "run")
    rows(lambda body: sorted(body, key=lambda row: (-int(row[0]), int(row[1]))))(run / "labels.csv")
    found, known = load_run(run), load_run(small_run)
    assert [image.labels for image in found.observations] == [image.labels for image in known.observations]
    assert all(np.array_equal(a, b) for a, b in zip(found.corrected_px, known.corrected_px, strict=True))


def nudge(path):
    text = path.read_text(encoding="utf-8")
    place = max(match.start() for match in re.finditer(r"(?<=\d\.\d)\d", text))
    path.write_text(text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :], encoding="utf-8")


@pytest.mark.parametrize("name", ["labels.csv", "faces.json", "report.json", CAMERA, TARGET, ".stcal/run.json"])
def test_a_file_with_another_digit_is_refused(own_run, name):
    nudge(own_run / name)
    refuses(f"E-RUN-CHANGED … {own_run / name} … run it again", load_run, own_run)
    if name == "faces.json":  # also what reads it alone
        refuses("E-RUN-CHANGED", read_target, own_run / name, own_run / TARGET)


def test_centres_that_the_joint_adjustment_corrected_otherwise(small_run, tmp_path):
    """Its poses are others than those of the groups, and with a wrong camera their eccentricities differ by more than a
    rounded number: the run's own model is read with its own centres."""
    run = unsealed_copy(small_run, tmp_path / "run")

    def shifted(body):
        return [[*row[:7], *(str(float(value) + 0.01) for value in row[7:9]), *row[9:]] for row in body]

    rows(shifted)(run / "labels.csv")
    found, known = (adjusted_run(load_run(folder))[0].result() for folder in (run, small_run))
    assert np.array_equal(found.xyz_model, known.xyz_model)
