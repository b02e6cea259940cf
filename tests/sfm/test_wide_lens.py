"""A lens of 150°: rendered, calibrated with its camera given, and the camera calibrated from the same photographs."""

import numpy as np
import pytest

from stcal.boards.board_file import load_board
from stcal.boards.target_file import load_target
from stcal.io.cameras.read import read_camera
from stcal.sfm import run
from stcal.sfm.camera.calibrate import calibrate_camera
from stcal.sfm.report.compare import compare
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.render import RenderOptions
from stcal.synthetic.scene import SceneOptions, make_scene

pytestmark = pytest.mark.slow
FIELD_DEG = 150.0


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wide")
    options = SceneOptions(3, 1944, 1296, images_per_group=6, distance_mm=450.0, fisheye_deg=FIELD_DEG)
    scene = make_scene(options)
    write_dataset(folder, scene, RenderOptions(seed=1), image_format="png")
    return scene, folder


def test_faces_are_right_within_their_sigma(rendered):
    scene, data = rendered
    circles = np.array(list(scene.circles_target.values()))
    seen = np.concatenate([pose @ circles for group in scene.groups.values() for pose in group.camera_from_target])
    away = np.degrees(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]))
    assert np.percentile(away, 99) > 50  # circles are seen far from the axis
    out = data / "run"
    run(data / "images", data / "cameras.txt", out, data / "target.toml", data / "board.toml")
    comparison = compare(out, data / "truth.json").content()
    assert not comparison["missing"]
    for face_id, row in comparison["faces"].items():
        if face_id != comparison["reference_face"]:
            assert row["normalised_error"] < 2.0, face_id  # √(eᵀC⁻¹e/6): once in 2000 draws
            assert row["translation_um"] < 20, face_id


@pytest.mark.full
def test_the_camera_is_found(rendered):
    """Parameters within their σ and correlations: χ² of eight has 26 with p = 0.001."""
    _, data = rendered
    designs = load_target(data / "target.toml"), load_board(data / "board.toml")
    found = calibrate_camera(data / "images", *designs, "OPENCV_FISHEYE").intrinsics
    true = read_camera(data / "cameras.txt").sized(0, 0).parameters()
    used = [0, 1, 2, 3, 4, 5, 8, 9]
    off = (found.camera.parameters() - true)[used]
    assert off @ np.linalg.solve(found.covariance, off) < 26.1
