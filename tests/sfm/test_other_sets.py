"""Sets with truth. Unlike that of the reference design, each rendered and calibrated from its own files, also beside
boards of squares or tags, whose corners the scale rests on; rendered and photographed data from elsewhere: the
acceptance figures of the main job; and the main chain, run, compare, measure, report, on our own small images and on
photographs of another program. Faces and poses come with covariances C; a squared error eᵀC⁻¹e of six numbers is χ²(6)
if C is true. Bounds leave out what happens once in a thousand sets, on either side: larger errors are wrong, smaller
ones are too good to be had."""

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
from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    CornerBoard,
    HexagonalCirclesDesign,
    LatticePart,
)
from stcal.boards.board_file import board_toml, load_board, load_flat_board
from stcal.boards.dictionaries import dictionary_of
from stcal.io.cameras.read import read_camera
from stcal.labels import DotLabel
from stcal.sfm import RunOptions, calibrate_camera, compare, crosscheck, load_run, run
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.runs.folder import run_text
from stcal.sfm.runs.run_options import require_dots
from stcal.synthetic import RenderOptions, Scene, SceneOptions, make_scene, second_design, write_dataset
from stcal.synthetic.dataset import image_name
from stcal.synthetic.render import render
from stcal.synthetic.scene import image_circles
from tests.boards.drawn import aprilgrid_mm, chessboard_mm
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


BOARDS = {
    "aprilgrid": AprilGridDesign(3, 4, 40.0, 0.25, 2),
    "chessboard": ChessboardDesign(6, 8, 25.0),
    "charuco": CharucoDesign(7, 9, 24.0, 18.0, "DICT_4X4_50"),
}
PER_MM = 5
SAMPLES = 4
"""Samples of a pixel along each axis."""
BLUR_PX, NOISE = 0.6, 1.5


def sheet_of(board) -> tuple[np.ndarray, np.ndarray]:
    """The printed sheet, ``PER_MM`` pixels a millimetre, and the place of the board's origin on it, mm."""
    if isinstance(board, AprilGridDesign):
        return aprilgrid_mm(board, board.border_bits, per_mm=PER_MM, margin=30.0)
    if isinstance(board, ChessboardDesign):
        sheet, origin = chessboard_mm(board.rows, board.columns, board.square_mm, PER_MM)
        return sheet, np.array([origin, origin])
    side, margin = round(board.square_mm * PER_MM), 24
    plain = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, board.marker_mm, dictionary_of(board.dictionary)
    )
    drawn = plain.generateImage((board.columns * side, board.rows * side))
    edge = margin * PER_MM
    return cv2.copyMakeBorder(drawn, *[edge] * 4, cv2.BORDER_CONSTANT, value=255), np.array([margin, margin], float)


def with_sheet(picture: np.ndarray, camera: Camera, camera_from_board: Rigid, board, seed: int) -> np.ndarray:
    """The picture with the sheet of the board in front of it: each pixel is the mean of the points that it sees."""
    sheet, origin = sheet_of(board)
    extent = np.array(sheet.shape[::-1]) / PER_MM
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * extent - origin
    box = camera.project(camera_from_board @ np.pad(corners, ((0, 0), (0, 1))))
    low = np.maximum(np.floor(box.min(0)).astype(int) - 3, 0)
    high = np.minimum(np.ceil(box.max(0)).astype(int) + 4, [camera.width, camera.height])
    x, y = (np.arange(a, b) for a, b in zip(low, high, strict=True))
    middles = camera.normalised_from_pixel(np.stack(np.meshgrid(x, y), axis=-1))
    ideal = cv2.resize(middles, None, fx=SAMPLES, fy=SAMPLES, interpolation=cv2.INTER_LINEAR)
    board_from_camera = camera_from_board.inverse()
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=2) @ board_from_camera.rotation.T
    depth = -board_from_camera.translation[2] / rays[..., 2]
    place = ((board_from_camera.translation + depth[..., None] * rays)[..., :2] + origin) * PER_MM - 0.5
    seen = cv2.remap(sheet, *np.moveaxis(place.astype(np.float32), 2, 0), cv2.INTER_LINEAR, borderValue=255)
    # The lens blurs before the sensor samples: blurred pixels would put edges along their rows 0.04 px off.
    seen = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), BLUR_PX * SAMPLES)
    shape = (high[1] - low[1], SAMPLES, high[0] - low[0], SAMPLES)
    there = ((place > -0.5) & (place < np.array(sheet.shape[::-1]) - 0.5)).all(2).reshape(shape).mean((1, 3))
    light = 20 + 0.75 * seen.reshape(shape).mean((1, 3))
    part = picture[low[1] : high[1], low[0] : high[0]]
    mixed = there * light + (1 - there) * part + np.random.default_rng(seed).normal(0, NOISE * (there > 0))
    part[:] = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return picture


def scene_with(board, **options) -> Scene:
    target, _, *rough = second_design()
    return make_scene(SceneOptions(**options), target, CornerBoard.of(board), *rough)


def photograph(scene: Scene, board, group: str, image: int) -> np.ndarray:
    where = scene.groups[group]
    picture = render(scene, group, image, RenderOptions(clutter=False))
    camera_from_board = where.camera_from_target[image] @ where.target_from_board
    return with_sheet(picture, scene.camera, camera_from_board, board, image)


def nees_of(detection, scene: Scene, camera_from_board: Rigid) -> np.ndarray:
    """Normalised squared errors of the board's points, mean 1, in the better of the numberings that fit the image."""
    (sighting,) = detection.boards
    errors = []
    for cells in sighting.numberings:
        xyz = scene.board.places_mm([DotLabel(*cell) for cell in cells.tolist()])
        off = detection.centres.centre_px[sighting.rows] - scene.camera.project(camera_from_board @ xyz)
        weight = np.linalg.inv(detection.centres.covariance_px2[sighting.rows])
        errors.append(np.einsum("ni,nij,nj->n", off, weight, off) / 2)
    return min(errors, key=np.mean)


@pytest.mark.parametrize(("kind", "low"), [("aprilgrid", 0.4), ("chessboard", 0.4), ("charuco", 0.05)])
def test_corners_of_one_image_are_as_good_as_they_say(kind, low):
    board = BOARDS[kind]
    scene = scene_with(board, seed=5, width=864, height=576, images_per_group=2, groups=(("top", "left"),))
    where = scene.groups["top-left"]
    camera_from_board = where.camera_from_target[0] @ where.target_from_board
    picture = with_sheet(np.full((576, 864), 90, np.uint8), scene.camera, camera_from_board, board, 0)
    detection = detect_image(picture, scene.camera, scene.target, scene.board, EllipseOptions())
    assert 44 <= len(detection.boards[0].rows) <= len(scene.board.labels()) == 48
    assert len(detection.boards[0].numberings) == (2 if kind == "chessboard" else 1)
    # The mean of 96 squares has a σ of 0.14. The ChArUco board has 1.8 px of white beside its corners: edges alone do
    # not tell some of them, and the σ of a saddle covers what its shape leaves.
    assert low < nees_of(detection, scene, camera_from_board).mean() < 1.6
    assert not detection.faces
    assert detection.candidates - len(detection.boards[0].rows) < 6, (
        "outlines of the board's own squares are not tried as circles"
    )


def test_a_run_reads_every_kind_of_board_and_writes_it_as_it_was_but_what_is_none(tmp_path):
    """A gap in metres is no ratio, and the published method needs dots."""
    for text in (
        'type = "chessboard"\nrows = 6\ncolumns = 9\nsquare_mm = 25.4\nsigma_mm = 0.02\n',
        'type = "charuco"\nrows = 5\ncolumns = 7\nsquare_mm = 20\nmarker_mm = 15\ndictionary = "4X4_50"\n',
        'type = "aprilgrid"\nrows = 3\ncolumns = 4\ntag_mm = 30\nspacing = 0.3\nborder_bits = 1\nfirst_id = 7\n',
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n",
        "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n",
        'type = "tags"\nunusual_size = true\ntag = [{ dictionary = "tag36h11", id = 3, size_mm = 4000, x_mm = 1.5, '
        "y_mm = 0.3, angle_deg = 20 }]\n",
    ):
        board = load_board(written(tmp_path, text))
        flat = load_flat_board(tmp_path / "board.toml")
        np.testing.assert_allclose(board.places_mm(board.labels())[:, :2], flat.xy_mm(), atol=1e-12)
        assert len(set(board.labels())) == len(flat.xy_mm())
        again = load_board(written(tmp_path, board_toml(board)))
        assert again.labels() == board.labels()
        assert type(again.printed) is type(flat)
        np.testing.assert_allclose(again.xy_mm(), flat.xy_mm(), atol=1e-12)
    text = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.0264\n"
    refuses("E-BOARD-SPACING … tagSpacing 0.0264 … 0.1 … 0.3", load_board, written(tmp_path, text))
    for option in ("--solve paper", "--compare paper"):
        board = CornerBoard.of(BOARDS["chessboard"])
        refuses(f"E-OPTION-CONFLICT … {option} … squares or tags", require_dots, board, option)


def test_points_are_numbered_by_rows_and_columns_and_both_ways_where_a_board_looks_the_same_turned():
    board = CornerBoard.of(AprilGridDesign(2, 3, 40.0, 0.25, 2))
    assert (board.rows, board.columns) == (4, 6)
    # The bottom left tag of Kalibr has its corners at (0, 0) to (40, -40) mm; a gap of 10 mm follows.
    assert np.unique(board.xy_mm()[:, 0]).tolist() == [0, 40, 50, 90, 100, 140]
    np.testing.assert_allclose(board.places_mm([DotLabel(3, 0), DotLabel(0, 5)]), [[0, 0, 0], [140, -90, 0]])
    both = CornerBoard.of(ChessboardDesign(3, 5, 10.0)).numberings(np.array([0, 1]))
    assert both.tolist() == [[[0, 0], [0, 1]], [[2, 4], [2, 3]]]
    assert len(CornerBoard.of(ChessboardDesign(4, 5, 10.0)).numberings(np.array([0]))) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["charuco", *(pytest.param(kind, marks=pytest.mark.full) for kind in BOARDS if kind != "charuco")]
)
def test_faces_beside_a_board_of_corners_are_right(tmp_path, no_page, kind):
    board = BOARDS[kind]
    scene = scene_with(board, seed=5, width=1728, height=1152, images_per_group=3)
    data = tmp_path / "data"
    write_dataset(data, scene, image_format="png")
    for group, where in scene.groups.items():
        for image in range(len(where.camera_from_target)):
            path = data / "images" / image_name(group, image, "png")
            cv2.imwrite(str(path), photograph(scene, board, group, image))
    result = run(data / "images", data / "cameras.txt", tmp_path / "run", data / "target.toml", data / "board.toml")
    assert result.judgement.verdict != "no"
    comparison = compare(tmp_path / "run", data / "truth.json").content()
    assert not comparison["missing"]
    errors = [row for face, row in comparison["faces"].items() if face != comparison["reference_face"]]
    assert len(errors) == 2
    for row in errors:
        assert row["normalised_error"] < 2.0
        assert row["translation_um"] < 15
    assert load_run(tmp_path / "run").board_design.labels() == scene.board.labels()
