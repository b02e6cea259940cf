"""The main chain with truth: run, compare, measure, report; on our own small images, and, as slow tests, on photographs
of another program. Needs nothing beside the repository.

Faces and poses come with covariances C; a squared error eᵀC⁻¹e of six numbers is χ²(6) if C is true. Bounds leave out
what happens once in a thousand sets, on either side: larger errors are wrong, smaller ones are too good to be had.
"""

import csv
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.geometry.rigid import Rigid
from stcal.sfm.report.compare import compare
from stcal.sfm.runs.folder import run_text
from tests.sfm.report.test_report import Page
from tests.sfm.truth import true_poses
from tests.support.image_poses import pose_error

ONCE_IN = 1000


def bounds(count: int) -> tuple[float, float]:
    """Of χ²(6), such that one of ``count`` lies outside once in a thousand sets (Bonferroni)."""
    share = 1 / ONCE_IN / count / 2
    return float(chi2.ppf(share, 6)), float(chi2.isf(share, 6))


def printed(*arguments) -> str:
    call = [sys.executable, "-c", "from stcal.cli.main import main_sfm; main_sfm()", *map(str, arguments)]
    done = subprocess.run(call, capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    return done.stdout


@dataclass(frozen=True)
class Calibrated:
    """The run's folder and images, what the command printed, its faces but for the reference, and the truth of all."""

    out: Path
    images: Path
    text: str
    faces: tuple[str, ...]
    truth: Path

    def content(self) -> dict:
        return json.loads(self.truth.read_text())


def of_sample(sample: Path, folder: Path) -> Calibrated:
    """A run of all its groups."""
    truth, out, images = sample / "truth.json", folder / "run", sample / "images"
    text = printed("run", images, "--camera", sample / "cameras.txt", "--out", out, "--workers", 1)
    return Calibrated(out, images, text, ("2", "3", "4", "5"), truth)


@pytest.fixture(scope="module", params=["small", pytest.param("sample", marks=pytest.mark.slow)])
def calibrated(request, tmp_path_factory) -> Calibrated:
    """A run of ``small_dataset``, and one of the photographs of another program."""
    if request.param == "sample":
        return of_sample(request.getfixturevalue("sample"), tmp_path_factory.mktemp("sample"))
    data, result = (request.getfixturevalue(name) for name in ("small_dataset", "small_result"))
    return Calibrated(result.out, data / "images", run_text(result), ("2", "4", "5"), data / "truth.json")


def test_faces_are_as_far_off_as_they_say_one_that_is_off_would_be_seen_and_no_circle_is_wrong(calibrated, tmp_path):
    """All visible circles are found. Thirty µm of a face would be ten of its σ."""
    found = compare(calibrated.out, calibrated.truth).content()
    assert set(found["missing"]) == {"2", "3", "4", "5"} - set(calibrated.faces)
    least, most = bounds(len(calibrated.faces))
    for face_id in calibrated.faces:
        row = found["faces"][face_id]
        assert least < 6 * row["normalised_error"] ** 2 < most, face_id
        assert row["circles"] == 10
    labels, groups = found["labels"], calibrated.content()["groups"].values()
    visible = [c for g in groups for i in g["images"].values() for c in i["circles"].values()]
    images = sum(len(group["images"]) for group in groups)
    seen = {"wrong": 0, "found": labels["visible"], "visible": sum(c["must_find"] for c in visible)}
    assert labels == {**seen, "images": images, "images_of_truth": images}
    assert labels["visible"] > 75 * len(list(calibrated.images.glob("*/*")))
    truth = calibrated.content()
    truth["target_from_face"]["2"][0][3] += 0.03
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    found = compare(calibrated.out, tmp_path / "truth.json").content()["faces"]["2"]
    assert 6 * found["normalised_error"] ** 2 > bounds(len(calibrated.faces))[1]


@pytest.mark.slow
def test_poses_of_the_target_are_as_far_off_as_they_say(calibrated, tmp_path):
    """Measured in the same photographs with the faces just found; board dots are told apart by the board's file.

    All poses share the errors of these faces, whose squares come to 1.6 σ² in JPEG photographs of other renderers than
    our own (five sets, 20 faces; 1.05 in ours): the bound allows for it.
    """
    out = calibrated.out
    printed(
        *("measure", calibrated.images, "--camera", calibrated.truth.parent / "cameras.txt"),
        *("--faces", out / "faces.json"),
        *("--board", out / "inputs/board.toml", "--out", tmp_path / "poses.csv", "--json", tmp_path / "poses.json"),
        *("--workers", 1),
    )
    poses = true_poses(calibrated.content())
    measured = {each["image"]: each for each in json.loads((tmp_path / "poses.json").read_text())["images"]}
    assert set(measured) == set(poses)
    least, most = bounds(len(poses))
    for name, each in measured.items():
        error = pose_error(Rigid.from_matrix(each["camera_from_target"]), poses[name])
        assert each["status"] == "certain", name
        assert least < error @ np.linalg.solve(np.array(each["covariance"]), error) < 1.6 * most, name


def test_the_report_says_what_the_files_say(calibrated):
    out, text = calibrated.out, calibrated.text
    assert text.startswith("May I use it? ")
    assert len(text.splitlines()) <= 20  # seen at a glance
    html = (out / "report.html").read_text(encoding="utf-8")
    page = Page(html)
    assert {"faces", "use", "trust", "detail", "scale", "residuals", "overlays"} <= set(page.ids)
    assert [a for a in page.references if not a.startswith(("#", "data:"))] == []
    faces = json.loads((out / "faces.json").read_text())["target_from_face"]
    for face_id in calibrated.faces:
        for value in np.array(faces[face_id])[:3, 3]:
            assert f"{value:.4f}" in text
            assert f"{value:.4f}" in html.replace("−", "-")


def test_detections_are_where_the_truth_has_them(calibrated):
    """Ellipse centres against images of circle centres: eccentricity makes r²cosθ/D of difference, 0.1 px at most here
    (r = 7.5 mm, 1 m, f = 1678 px), noise a hundredth."""
    with open(calibrated.out / "labels.csv", newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if not row["label"].startswith("board")]
    images = {name: each for g in calibrated.content()["groups"].values() for name, each in g["images"].items()}
    true = np.array([images[row["image"]]["circles"][row["label"]]["centre_px"] for row in rows])
    away = np.linalg.norm(np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows]) - true, axis=1)
    assert len(rows) > 16 * len(images)
    assert np.median(away) > 0.001
    assert away.max() < 0.2
