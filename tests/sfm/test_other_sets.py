"""Sets unlike that of the reference design, each rendered, calibrated from its own files, compared with its truth; and
rendered and photographed data from elsewhere: the acceptance figures of the main job."""

import hashlib
import json
import shutil

import cv2
import numpy as np
import pytest

from stcal import BoardDesign, Camera, load_target, reference_target
from stcal.boards.board_designs import AsymmetricCirclesDesign, HexagonalCirclesDesign, LatticePart
from stcal.boards.board_file import board_toml, load_board
from stcal.io.cameras.read import read_camera
from stcal.labels import DotLabel
from stcal.sfm import RunOptions, calibrate_camera, compare, crosscheck, load_run, run
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.synthetic import RenderOptions, write_dataset
from stcal.synthetic.scene import SceneOptions, image_circles, make_scene, second_design
from tests.levels import FULL, SLOW
from tests.outcome import refuses

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


def test_the_lattice_holds_the_circles_and_no_others(tmp_path):
    board = load_board(written(tmp_path, board_toml(CIRCLES.lattice())))
    assert isinstance(board, LatticePart)
    assert board.printed == CIRCLES
    xy = board.xy_mm()
    assert len(board.labels()) == len(board.radii_mm()) == len(xy) == 55
    # Neighbours' distances are those of OpenCV's documented layout.
    wanted = np.sort(np.linalg.norm(CIRCLES.xy_mm()[:, None] - CIRCLES.xy_mm(), axis=2).ravel())
    np.testing.assert_allclose(np.sort(np.linalg.norm(xy[:, None] - xy, axis=2).ravel()), wanted, atol=1e-9)
    np.testing.assert_allclose(board.places_mm([DotLabel(*board.cells()[7])])[0, :2], xy[7])


def test_other_boards_are_refused_with_what_takes_them(tmp_path):
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
