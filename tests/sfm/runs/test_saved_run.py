"""A run's folder read back: what was written, number by number, or one line that says which file is wrong; and
``report``: the page of a finished run made again, and its PDF."""

import csv
import json
import math
import re
import shutil
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from stcal.design import reference_target
from stcal.io.files import BOARD, CAMERA, DATABASE, RUN_MARKER, TARGET
from stcal.report.document import with_code
from stcal.sfm import RunOptions, read_target, run
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.mapping.pairs import PairOptions
from stcal.sfm.report.judgement import Judgement
from stcal.sfm.runs import folder
from stcal.sfm.runs.folder import run_text
from stcal.sfm.runs.saved import adjusted_run, load_run
from stcal.sfm.runs.transaction import MarkerFile, added_results, run_folder, verify
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


def test_what_is_read_back_are_the_same_numbers_designs_and_options(written):
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


def test_which_faces_the_photographs_were_to_show():
    target = reference_target()
    for groups, given, expected in (
        (("12", "14"), (), ["1", "2", "4"]),
        (("1-2", "4_1"), (), ["1", "2", "4"]),
        (("1", "2"), (), []),  # numbers of groups, most likely
        (("12", "16"), (), []),
        (("12", "far"), (), []),
        (("12", "1-far"), (), []),
        (("12",), ("5", "3"), ["3", "5"]),
        ((".",), ("1",), ["1"]),
    ):
        assert RunOptions(expect_faces=given).faces_expected(groups, target) == expected
        assert RunOptions(expect_faces=given, board_only=True).faces_expected(groups, target) == []
    refuses("E-TARGET-NO-FACE … 7", RunOptions(expect_faces=("7",)).settled, target)
    refuses("E-TARGET-NO-FACE … 9 … 1, 2, 3, 4, 5", RunOptions(reference_face="9").settled, target)


def edited(change):
    """A change of the content of a JSON file."""

    def apply(path) -> None:
        content = json.loads(path.read_text(encoding="utf-8"))
        change(content)
        path.write_text(json.dumps(content), encoding="utf-8")

    return apply


def holding(content: bytes):
    return lambda path: path.write_bytes(content)


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


def nudge(path) -> None:
    """Another digit, in the largest place after a point."""
    text = path.read_text(encoding="utf-8")
    place = max(match.start() for match in re.finditer(r"(?<=\d\.\d)\d", text))
    path.write_text(text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :], encoding="utf-8")


DAMAGED = "E-RUN-DAMAGED … FILE: damaged, or of another version"
WRONG = {
    "of before images were written": (".stcal/run.json", edited(lambda c: c.pop("images")), "no 'images'"),
    "of before circles were written": ("faces.json", edited(lambda c: c.pop("circles")), "no 'circles'"),
    "options null, as of detect": (".stcal/run.json", edited(lambda c: c.update(options=None)), "no 'pairs'"),
    "an option unknown here": (".stcal/run.json", edited(lambda c: c["options"].update(magic=1)), "magic"),
    "no such face": (".stcal/run.json", edited(lambda c: c["options"].update(reference_face="9")), "no face 9"),
    "report's images a list of names": (
        "report.json",
        edited(lambda c: c.update(images=["a", "b"])),
        "images.1: 'a': ",
    ),
    "a group without pairs": ("report.json", edited(lambda c: c["groups"][0].update(pairs=[])), "index out of range"),
    "a group missing": ("report.json", edited(lambda c: c["groups"].pop()), "no '14'"),
    "another group's pair": (
        "report.json",
        edited(lambda c: c["groups"][0].update(pairs=c["groups"][1]["pairs"])),
        "group 12: its initial pair is not of its images",
    ),
    "the residual a word": ("report.json", edited(lambda c: c["summary"].update(residual_rms_px="small")), "'small'"),
    "names that are none": (
        ".stcal/run.json",
        edited(lambda c: c["options"].update(exclude=[7])),
        "options: exclude <1>: a tuple, each a text, needed",
    ),
}
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
NEEDED = [CAMERA, TARGET, BOARD, "labels.csv", DATABASE, "report.json"]
SPOILT = {
    **{case: (name, spoil, f"{DAMAGED} … {part}") for case, (name, spoil, part) in WRONG.items()},
    **{case: ("labels.csv", spoil, f"{DAMAGED} ( … {part}") for case, (spoil, part) in LABELS.items()},
    **{f"no {name}": (name, Path.unlink, f"E-RUN-UNFINISHED … RUN … {name}") for name in NEEDED},
    "no faces.json": ("faces.json", Path.unlink, "E-RUN-NO-FACES … RUN … faces.json"),
    "a list": (".stcal/run.json", holding(b"[1]"), "E-JSON-CONTENT … FILE … run it again"),
    "not UTF-8, of JSON": ("report.json", holding(b"\xff\xfe"), "E-JSON-INVALID … FILE … run it again"),
    "endlessly nested": ("faces.json", holding(b"[" * 100_000), "E-JSON-INVALID … FILE … run it again"),
    "a lens cut": (CAMERA, holding(b"1 PINHOLE 9 9 1 1 1"), "E-CAMERA-COEFFICIENTS … FILE … 3 … 4"),
    "a polarity that is none": (TARGET, holding(b"polarity = 3"), "E-KEY-VALUE … FILE … polarity"),
    "no TOML": (BOARD, holding(b"rows"), "E-TOML-INVALID … FILE"),
    **{
        f"another digit in {name}": (name, nudge, "E-RUN-CHANGED … FILE … run it again")
        for name in ("labels.csv", "faces.json", "report.json", CAMERA, TARGET, ".stcal/run.json")
    },
}
"""The file that is spoiled, how, and the error, in which RUN is the folder and FILE the file."""


@pytest.mark.parametrize("case", SPOILT)
def test_a_folder_that_is_not_as_the_run_wrote_it_is_refused(own_run, case):
    name, spoil, error = SPOILT[case]
    spoil(own_run / name)
    refuses(error.replace("RUN …", f"{own_run} …").replace("FILE", str(own_run / name)), load_run, own_run)
    if case == "another digit in faces.json":  # also by what reads it alone
        refuses("E-RUN-CHANGED", read_target, own_run / name, own_run / TARGET)


def test_not_a_run_and_a_folder_of_detections_only(own_run, tmp_path, stcal_sfm, small_set):
    (own_run / ".stcal/run.json").unlink()
    for path in (own_run, tmp_path / "nothing", tmp_path / "run" / "faces.json"):
        outcome = stcal_sfm("faces", own_run / "colmap/models", "--run", path)
        assert_error(outcome, INPUT, "E-RUN-FOLDER", f"{path}", ".stcal/run.json", "--out")
    small = small_set("12")
    stcal_sfm("detect", small.images, "--camera", small.camera, "--out", small.out, "--workers", 1)
    outcome = stcal_sfm("faces", small.out, "--run", small.out)
    assert_error(outcome, INPUT, "E-RUN-UNFINISHED", str(small.out), f"{CAMERA}, {TARGET}")


def test_rows_in_another_order_are_the_same_and_the_runs_own_model_has_its_own_centres(small_run, tmp_path):
    """Rows name their image; what counts is their order in it. Poses of the joint adjustment are others than those of
    the groups, and with a wrong camera their eccentricities differ by more than a rounded number."""
    run = unsealed_copy(small_run, tmp_path / "run")
    rows(lambda body: sorted(body, key=lambda row: (-int(row[0]), int(row[1]))))(run / "labels.csv")
    found, known = load_run(run), load_run(small_run)
    assert [image.labels for image in found.observations] == [image.labels for image in known.observations]
    assert all(np.array_equal(a, b) for a, b in zip(found.corrected_px, known.corrected_px, strict=True))

    def shifted(body):
        return [[*row[:7], *(str(float(value) + 0.01) for value in row[7:9]), *row[9:]] for row in body]

    rows(shifted)(run / "labels.csv")
    found, known = (adjusted_run(load_run(folder))[0].result() for folder in (run, small_run))
    assert np.array_equal(found.xyz_model, known.xyz_model)


@pytest.mark.slow
def test_the_same_files_make_the_same_page_there_or_in_a_file_of_ones_own(
    own_run, small_run, tmp_path, stcal_sfm, monkeypatch
):
    monkeypatch.setattr(folder, "pdf_of", lambda page: page[:15].encode())
    (own_run / "report.html").write_text("spoilt")
    assert verify(own_run).notes()
    before, page = (own_run / RUN_MARKER).read_bytes(), (small_run / "report.html").read_bytes()
    own = tmp_path / "for the lab"
    code, out, _ = stcal_sfm("report", own_run, "--pdf", "--out", f"{own}.html")
    assert (code, out) == (0, f"report: {own}.html\nreport: {own}.pdf\n")
    assert (own.with_suffix(".html").read_bytes(), own.with_suffix(".pdf").read_bytes()) == (page, b"<!DOCTYPE html>")
    assert ((own_run / RUN_MARKER).read_bytes(), (own_run / "report.pdf").exists()) == (before, False)
    code, out, _ = stcal_sfm("report", own_run, "--pdf")
    assert (code, out) == (0, f"report: {own_run}/report.html\nreport: {own_run}/report.pdf\n")
    assert (own_run / "report.html").read_bytes() == page
    assert (own_run / "report.pdf").read_bytes() == b"<!DOCTYPE html>"
    assert verify(own_run).notes() == []
    with added_results(own_run) as stage:
        (stage / "report.html").write_text("another")
    assert not (own_run / "report.pdf").exists()  # it was made of the page before
    assert verify(own_run).notes() == []


def test_what_cannot_be_made_is_said_in_one_line(own_run, tmp_path, stcal_sfm):
    assert_error(stcal_sfm("report", tmp_path), INPUT, "E-RUN-FOLDER", "--out")
    assert_error(
        stcal_sfm("report", own_run, "--out", tmp_path / "a.pdf"), INPUT, "E-OUTPUT-SUFFIX", "a.html", "--pdf", "a.pdf"
    )
    assert_error(stcal_sfm("report", own_run, "--out", own_run / "report.html"), INPUT, "E-OUTPUT-IS-INPUT", "run")
    content = json.loads((own_run / "report.json").read_text())
    del content["faces"]
    (own_run / "report.json").write_text(json.dumps(content))
    assert_error(stcal_sfm("report", own_run), INPUT, "E-RUN-DAMAGED", "report.json", "faces")
    assert (own_run / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("report.json", '"label": "1:1"', '"label": "?"'),
        ("labels.csv", "\n1,0,", "\n1,0,12/IMG_1000.jpg,12,x,0,0,0,0,1,0,1,left,0\n1,0,"),
    ],
)
def test_a_page_that_cannot_be_made_leaves_the_earlier_one(own_run, stcal_sfm, name, old, new):
    text, before = (own_run / name).read_text(), (own_run / "report.html").read_bytes()
    (own_run / name).write_text(text.replace(old, new, 1))
    assert_error(stcal_sfm("report", own_run), INPUT, "E-RUN-DAMAGED", f"{name}")
    assert (own_run / "report.html").read_bytes() == before


def test_terminal_file_and_page_have_the_same_judgement_and_residuals(small_result, small_run):
    stored = Judgement.model_validate(json.loads((small_run / "report.json").read_text())["judgement"])
    assert stored == small_result.judgement
    page, terminal = (small_run / "report.html").read_text(), " ".join(run_text(small_result).split())
    assert len(stored.answers()) == 4
    for question, answer in stored.answers():
        assert f"{question} {answer}" in terminal
        assert f"<dt>{question}</dt><dd>{with_code(answer)}</dd>" in page
    report = json.loads((small_run / "report.json").read_text())
    with open(small_run / "labels.csv", encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["residual_x_px"]]
    page = (small_run / "report.html").read_text()
    factor = float(re.search(r"measured less projected, ([\d,]+) times", page)[1].replace(",", ""))
    drawn = page.split('alt="Overlay of ')
    for image in report["residuals_by_image"]:
        own = [[float(row[f"residual_{axis}_px"]) for axis in "xy"] for row in rows if row["image"] == image["image"]]
        assert len(own) == image["observations"]
        assert math.sqrt(sum(x * x + y * y for x, y in own) / (2 * len(own))) == pytest.approx(image["rms_px"])
        assert max(math.hypot(*each) for each in own) == pytest.approx(image["max_px"])
        (part,) = [each for each in drawn if each.startswith(image["image"])]
        vectors = re.findall(r"M[\d.-]+ [\d.-]+l([\d.-]+) ([\d.-]+)", part)
        assert [[float(v) / factor for v in each] for each in vectors] == [
            [pytest.approx(v, abs=0.051 / factor) for v in each] for each in own
        ]
