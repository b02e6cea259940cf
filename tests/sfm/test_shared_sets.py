"""Rendered and photographed data from elsewhere: the acceptance figures of the main job."""

import hashlib
import json
import shutil

import cv2
import numpy as np
import pytest

from stcal import BoardDesign, Camera, reference_target
from stcal.sfm import RunOptions, compare, crosscheck, load_run, run
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image

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
