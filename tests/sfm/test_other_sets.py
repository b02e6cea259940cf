"""Sets with truth. Unlike that of the reference design, each rendered and calibrated from its own files; rendered and
photographed data from elsewhere: the acceptance figures of the main job; and the main chain, run, compare, measure,
report, on our own small images and on photographs of another program. Faces and poses come with covariances C; a
squared error eᵀC⁻¹e of six numbers is χ²(6) if C is true. Bounds leave out what happens once in a thousand sets, on
either side: larger errors are wrong, smaller ones are too good to be had."""

import csv
import hashlib
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from stcal import BoardDesign, Camera, Rigid, load_target, reference_target
from stcal.boards.board_designs import AsymmetricCirclesDesign, HexagonalCirclesDesign, LatticePart
from stcal.boards.board_file import board_toml, load_board
from stcal.io.cameras.read import read_camera
from stcal.labels import DotLabel
from stcal.sfm import RunOptions, calibrate_camera, compare, crosscheck, load_run, run
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.runs.folder import run_text
from stcal.synthetic import RenderOptions, write_dataset
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene, second_design
from tests.levels import FULL, SLOW
from tests.outcome import refuses
from tests.sfm.report.test_report import Page
from tests.support.image_poses import pose_error, true_poses

CIRCLES = AsymmetricCirclesDesign(11, 5, 20.0, 6.0, "dark")
OPTIONS = SceneOptions(seed=5, width=1728, height=1152, images_per_group=4)


def beside(circles):
    """The second design beside a board of circles in shifted rows, whose lattice's places are its dots."""
    target, _, *rough = second_design()
    return make_scene(OPTIONS, target, circles.lattice(), *rough)


def wide():
    """A lens of 150°, with circles far from its axis."""
    options = SceneOptions(3, 1944, 1296, images_per_group=6, distance_mm=450.0, fisheye_deg=150.0)
    scene = make_scene(options)
    circles = np.array(list(scene.circles_target.values()))
    seen = np.concatenate([pose @ circles for group in scene.groups.values() for pose in group.camera_from_target])
    away = np.degrees(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]))
    assert np.percentile(away, 99) > 50
    return scene


SETS = {
    "another design": (lambda: make_scene(OPTIONS, *second_design()), 30),
    "OpenCV's asymmetric circles": (lambda: beside(CIRCLES), 40),
    "hexagonal circles": (lambda: beside(HexagonalCirclesDesign(9, 7, 27.0, 6.0, "dark")), 40),
    "a wide lens": (wide, 20),
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=FULL if name.startswith("hex") else SLOW) for name in SETS])
def test_labels_are_right_and_faces_within_their_sigma(tmp_path, no_page, name):
    make, most_um = SETS[name]
    scene, data, out = make(), tmp_path / "data", tmp_path / "run"
    write_dataset(data, scene, RenderOptions(seed=1), image_format="png")
    result = run(data / "images", data / "cameras.txt", out, data / "target.toml", data / "board.toml")
    for image in result.observations:
        seen = image_circles(scene, image.group, int(image.name.split("_")[-1].split(".")[0]) - 1000)
        truth = dict(zip(seen.labels, seen.centre_px, strict=True))
        for label, centre in zip(image.labels, image.centre_px, strict=True):  # lattices may be numbered otherwise
            is_free = isinstance(scene.board, LatticePart) and isinstance(label, DotLabel)
            assert is_free or np.linalg.norm(centre - truth[label]) < 1.5, f"{image.name} {label}"
        dots = sum(isinstance(label, DotLabel) for label in image.labels)
        assert dots > (40 if isinstance(scene.board, LatticePart) else 20)
    found = compare(out, data / "truth.json").content()
    assert found["missing"] == []
    for face, row in found["faces"].items():
        if face != found["reference_face"]:
            # √(eᵀC⁻¹e/6) of a true covariance exceeds 2 about once in 2000 draws (χ² with 6 degrees of freedom).
            assert 0.1 < row["normalised_error"] < 2.0, face
            assert row["translation_um"] < most_um, face
    assert result.calibration.joint.sigma0 == pytest.approx(1.0, abs=0.2)
    assert load_run(out).board_design.labels() == scene.board.labels()


@pytest.mark.full
def test_a_wide_camera_is_found(tmp_path):
    """Parameters within their σ and correlations: χ² of eight has 26 with p = 0.001."""
    write_dataset(tmp_path, wide(), RenderOptions(seed=1), image_format="png")
    designs = load_target(tmp_path / "target.toml"), load_board(tmp_path / "board.toml")
    found = calibrate_camera(tmp_path / "images", *designs, "OPENCV_FISHEYE").intrinsics
    true = read_camera(tmp_path / "cameras.txt").sized(0, 0).parameters()
    used = [0, 1, 2, 3, 4, 5, 8, 9]
    off = (found.camera.parameters() - true)[used]
    assert off @ np.linalg.solve(found.covariance, off) < 26.1


def written(folder, text):
    path = folder / "board.toml"
    path.write_text(text)
    return path


def test_the_lattice_holds_the_circles_and_no_others_and_other_boards_are_refused(tmp_path):
    board = load_board(written(tmp_path, board_toml(CIRCLES.lattice())))
    assert isinstance(board, LatticePart)
    assert board.printed == CIRCLES
    xy = board.xy_mm()
    assert len(board.labels()) == len(board.radii_mm()) == len(xy) == 55
    # Neighbours' distances are those of OpenCV's documented layout.
    wanted = np.sort(np.linalg.norm(CIRCLES.xy_mm()[:, None] - CIRCLES.xy_mm(), axis=2).ravel())
    np.testing.assert_allclose(np.sort(np.linalg.norm(xy[:, None] - xy, axis=2).ravel()), wanted, atol=1e-9)
    np.testing.assert_allclose(board.places_mm([DotLabel(*board.cells()[7])])[0, :2], xy[7])
    several = 'type = "boards"\n[[board]]\nfile = "other.toml"\n'
    refuses("E-BOARD-SINGLE … several boards", load_board, written(tmp_path, several))
    circles = "target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: True\n"
    refuses("E-BOARD-RADIUS … radius_mm", load_board, written(tmp_path, circles))


# Bounds of the issue: µm of faces 2, 4, 5 and of face 3, mdeg of the same, µm mean of circles after a rigid fit,
# and the share of visible circles found.
BOUNDS = {"clean": (10, 20, 7, 9, 4, 0.99), "clutter": (30, 50, 15, 20, 8, 0.97)}


@pytest.fixture(scope="module", params=["clean", "clutter"])
def rendered(request, shared_data, tmp_path_factory):
    folder = shared_data(f"stereo_target/{request.param}")
    out = tmp_path_factory.mktemp(request.param) / "run"
    result = run(folder / "images", folder / "cameras.txt", out)
    truth = json.loads((folder / "truth.json").read_text())
    return request.param, folder, out, result, truth


@pytest.mark.slow
def test_labels_faces_and_centres_are_right_and_every_image_is_registered(rendered):
    name, folder, out, result, truth = rendered
    near_um, far_um, near_mdeg, far_mdeg, circles_um, share = BOUNDS[name]
    found = compare(out, folder / "truth.json").content()
    labels, faces = found["labels"], found["faces"]
    assert labels["wrong"] == 0
    assert labels["visible"] > 1000
    assert labels["found"] / labels["visible"] >= share
    mapped = {name for s in result.solutions for name in s.model.images}
    assert mapped == {name for g in truth["groups"].values() for name in g["images"]}
    assert set(faces) == {"1", "2", "3", "4", "5"}
    for face_id, row in faces.items():
        assert row["translation_um"] < (far_um if face_id == "3" else near_um), face_id
        assert row["rotation_mdeg"] < (far_mdeg if face_id == "3" else near_mdeg), face_id
        # Bounded below as well: an error of zero would mean that the truth leaked in.
        assert 0.05 < row["circles_mean_um"] < circles_um, face_id
    residuals = np.concatenate([s.model.residuals_px(result.camera).ravel() for s in result.solutions])
    # Against the exact ellipse centres: 0.005 px on clean images is what the field's notes call good.
    assert 0.001 < np.sqrt((residuals**2).mean()) < (0.005 if name == "clean" else 0.008)


@pytest.mark.slow
def test_the_native_program_agrees(rendered):
    """On the clean set within the issue's 2 µm and 1 mdeg on every face; our database is not touched."""
    name, _, out, _, _ = rendered
    if shutil.which("colmap") is None:
        pytest.skip("native colmap is not on PATH")
    if name != "clean":
        pytest.skip("asked of the clean set")
    before = hashlib.sha256((out / "colmap/database.db").read_bytes()).hexdigest()
    check = crosscheck(load_run(out)).model_dump()
    for key in ("mapping", "result"):
        assert check[key]["faces"].keys() == {"1", "2", "3", "4", "5"}
        for face_id, row in check[key]["faces"].items():
            assert row["translation_um"] < 2, face_id
            assert row["rotation_mdeg"] < 1, face_id
    assert check["differences"] == []
    assert check["images"]["native"] == check["images"]["pycolmap"] == 24
    # Two programs, not one twice: their iterations end at other places.
    assert max(row["translation_um"] for row in check["mapping"]["faces"].values()) > 1e-3
    assert hashlib.sha256((out / "colmap/database.db").read_bytes()).hexdigest() == before


@pytest.mark.slow
def test_the_uncorrected_control_shows_the_bias_that_residuals_hide(shared_data, no_page, tmp_path):
    """The bias r²cosθ/D is 40–64 µm for the big circles at 0–50° and 1 m; a face is one circle against another's."""
    folder = shared_data("stereo_target/clean")
    result = run(folder / "images", folder / "cameras.txt", tmp_path / "run", options=RunOptions(eccentricity=False))
    faces = compare(tmp_path / "run", folder / "truth.json").content()["faces"]
    for face_id in ("2", "4", "5"):
        assert 40 < faces[face_id]["translation_um"] < 70
    assert faces["3"]["translation_um"] > 65
    for s in result.solutions:
        assert np.sqrt((s.model.residuals_px(result.camera) ** 2).mean()) < 0.02


# Corner of the larger dot in the printed sheet: lower left when its text reads upwards.
DOTGRID = BoardDesign(10, 10, 20.0, 5.0, "dark", 0.05, corner=(9, 0), corner_radius_mm=7.5)


def dotgrid_images(shared_data):
    """Every third of fifteen."""
    folder = shared_data("dotgrid_handeye/images")
    return [(path.stem, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in sorted(folder.glob("*.png"))[::3]]


@pytest.mark.slow
def test_all_photographed_boards_are_found_and_oriented(shared_data):
    camera = Camera(640, 480, [542.324, 543.515], [320.474, 226.039], np.zeros(8))
    images = dotgrid_images(shared_data)
    assert len(images) == 5
    for name, image in images:
        found = detect_image(image, camera, reference_target(), DOTGRID, EllipseOptions())
        assert found.board is not None
        assert found.board.numberings.shape[0] == 1, f"{name}: not oriented"
        assert found.board.numberings.shape[1] >= 97, f"{name}: {found.board.numberings.shape[1]} dots"
        assert not found.faces, f"{name}: a face where there is none"
        _check_orientation(name, found)


def _check_orientation(name, found):
    """In all these photographs the sheet stands the same way up: columns to the right, rows downwards, and the dot
    numbered as the corner is the larger one."""
    numbering, centre = found.board.numberings[0], found.centres.centre_px[found.board.rows]
    rows, columns = numbering.T
    along_column = np.polyfit(columns, centre[:, 0], 1)[0]
    along_row = np.polyfit(rows, centre[:, 1], 1)[0]
    assert along_column > 5, name
    assert along_row > 5, name
    size = np.sqrt(np.linalg.det(found.centres.shape))
    corner = (rows == 9) & (columns == 0)
    if corner.any():
        assert size[corner][0] > 1.25 * np.median(size), name


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


def test_the_report_says_what_the_files_say_and_detections_are_where_the_truth_has_them(calibrated):
    """Ellipse centres against images of circle centres: eccentricity makes r²cosθ/D of difference, 0.1 px at most here
    (r = 7.5 mm, 1 m, f = 1678 px), noise a hundredth."""
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
    with open(calibrated.out / "labels.csv", newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if not row["label"].startswith("board")]
    images = {name: each for g in calibrated.content()["groups"].values() for name, each in g["images"].items()}
    true = np.array([images[row["image"]]["circles"][row["label"]]["centre_px"] for row in rows])
    away = np.linalg.norm(np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows]) - true, axis=1)
    assert len(rows) > 16 * len(images)
    assert np.median(away) > 0.001
    assert away.max() < 0.2
