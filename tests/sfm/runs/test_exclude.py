"""Images taken out by name, and runs that end as failed where their checks have."""

import json

import cv2
import numpy as np
import pytest

from stcal.io.images import chosen_images
from stcal.sfm import load_run, read_target
from stcal.sfm.report.check import Check, ranked
from tests.outcome import INPUT, assert_error, fails_with

CHECKS_FAILED = 4
STRAY = "12/IMG_1002.jpg"


@pytest.fixture
def with_a_stray(small_set):
    """A photograph taken with another focus: distorted by 2 px in its corners more than the others."""
    small = small_set("12", "14")
    picture = cv2.imread(str(small.image(2)), cv2.IMREAD_GRAYSCALE)
    height, width = picture.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    from_middle = np.stack([x - width / 2, y - height / 2])
    square = (from_middle**2).sum(0) / (width**2 + height**2) * 4
    x, y = from_middle * (1 + 2 * square * 2 / np.hypot(width, height)) + np.array([width, height])[:, None, None] / 2
    cv2.imwrite(str(small.image(2)), cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC))
    return small


def files(small):
    return "--target", small.folder / "target.toml", "--board", small.folder / "board.toml"


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_a_failed_check_names_its_image_and_the_option_that_takes_it_out(with_a_stray, stcal_sfm):
    """Exit code 4, and 0 with what the first remedy says."""
    small = with_a_stray
    _, out, err = outcome = stcal_sfm(*small.arguments(*files(small)))
    line = assert_error(outcome, CHECKS_FAILED, "E-CHECKS-FAILED", "may I use it? No", "--no-strict", "see")
    assert {"faces: 4 of 4", "check: 19 of 19"} <= set(err.splitlines())
    assert "µm" not in next(line for line in out.splitlines() if line.startswith("How good is it?"))
    assert "(a check is suspicious by chance in one run in 1,000, failed in one in 100,000)" in " ".join(out.split())
    assert f"--exclude {STRAY}" in " ".join(out.split()).split(" failed: ")[1]
    assert line.endswith(str(small.out / "report.html"))
    doubted = read_target(small.out / "faces.json", load_run(small.out).target_design).notes
    assert any("must not be used: No: " in note for note in doubted), doubted

    code, out, _ = stcal_sfm(*small.arguments(*files(small), "--exclude", STRAY))
    assert code == 0
    assert f"skipped {STRAY}: taken out with --exclude" in out
    assert "by chance" not in out
    report = json.loads((small.out / "report.json").read_text())
    assert [(each["name"], each["gate"]) for each in report["left_out"]["files"]] == [(STRAY, "excluded")]
    assert STRAY not in {each["name"] for each in report["images"]}
    assert (load_run(small.out).options.exclude, load_run(small.out).faces.doubted) == ((STRAY,), "")
    assert small.image(2).exists()


def test_images_are_named_as_in_results_or_by_their_path(small_set, stcal_sfm, monkeypatch):
    small = small_set("12", "14")
    outcome = stcal_sfm(*small.arguments("--exclude", "12/IMG_1000.jpg", "--exclude", "IMG_1001.jpg"))
    assert_error(outcome, INPUT, "E-OPTION-EXCLUDE", "--exclude", "IMG_1001.jpg", "12/IMG_1000.jpg")
    outcome = stcal_sfm("detect", *small.arguments("--exclude", "12/none.jpg")[1:])
    assert_error(outcome, INPUT, "E-OPTION-EXCLUDE", "--exclude", "12/none.jpg")
    monkeypatch.chdir(small.images / "14")
    kept, left = chosen_images(small.images, ["12/IMG_1001.jpg", "IMG_1002.jpg", str(small.image(3))])
    assert [each.name for each in left] == ["12/IMG_1001.jpg", "12/IMG_1003.jpg", "14/IMG_1002.jpg"]
    assert {each.gate for each in left} == {"excluded"}
    assert len(kept) == 5
    with fails_with("E-OPTION-EXCLUDE … --exclude … 8"):
        chosen_images(small.images, [each.name for each in chosen_images(small.images)[0]])


def test_failed_checks_that_name_an_image_come_first_and_those_that_others_explain_last():
    def check(key, verdict, *names):
        return Check(key, key, verdict, "", (), 1, names, "")

    checks = [
        check("dull", "suspicious", "b.jpg"),
        check("passed", "passed"),
        check("camera", "failed", "camera"),
        check("centre", "suspicious", "b.jpg 1:1"),
        check("image", "failed", "a.jpg"),
    ]
    order = [each.key for each in ranked(checks, frozenset({"a.jpg", "b.jpg"}))]
    assert order == ["image", "camera", "dull", "centre", "passed"]
    for later, why in (("radius-design", "rim"), ("groups", "board"), ("loops", "flatness")):
        checks = [check(key, "failed", key) for key in (later, why, "agreement")]
        assert [each.key for each in ranked(checks, frozenset())] == [why, later, "agreement"]
        assert [each.key for each in ranked(checks[::2], frozenset())] == [later, "agreement"]
