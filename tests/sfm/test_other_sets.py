"""Sets unlike that of the reference design: each rendered, calibrated from its own files, compared with its truth."""

import numpy as np
import pytest

from stcal.boards.board_designs import AsymmetricCirclesDesign, HexagonalCirclesDesign, LatticePart
from stcal.boards.board_file import board_toml, load_board
from stcal.boards.target_file import load_target
from stcal.io.cameras.read import read_camera
from stcal.labels import DotLabel
from stcal.sfm import calibrate_camera, compare, load_run, run
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
