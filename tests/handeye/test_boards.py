"""``stcal handeye`` with boards of the newer kinds, drawn."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.boards.design import AprilGridDesign, AsymmetricCirclesDesign
from stcal.geometry.rigid import Rigid
from tests.boards.drawn import aprilgrid_mm, photograph_of_several
from tests.handeye.photographed import CAMERA, PER_MM, image_from_sheet, looks, photographs, sheet_of_dots
from tests.handeye.test_cli import CHANCE, EXACT, command, in_sigmas  # noqa: F401
from tests.handeye.test_images import charuco
from tests.support.handeye import FLANGE_FROM_CAMERA

GRID = AprilGridDesign(3, 4, 25.0, 0.3)
CIRCLES = AsymmetricCirclesDesign(9, 4, 18.0, 6.0, "dark")
APRILGRID = "target_type: aprilgrid\ntagCols: 4\ntagRows: 3\ntagSize: 0.025\ntagSpacing: 0.3\n"
ASYMMETRIC = 'type = "asymmetric-circles"\nrows = 9\ncolumns = 4\nspacing_mm = 18\nradius_mm = 6\npolarity = "dark"\n'
SET = """type = "boards"
[[board]]
type = "charuco"
rows = 6
columns = 8
square_mm = 20.0
marker_mm = 10.0
dictionary = "5X5_50"
[[board]]
type = "aprilgrid"
rows = 3
columns = 4
tag_mm = 25.0
spacing = 0.3
x_mm = -165.0
y_mm = 105.0
z_mm = 30.0
rpy_deg = [0.0, 30.0, 0.0]
"""
COMMON_FROM_GRID = Rigid(Rotation.from_euler("y", 30, degrees=True).as_matrix(), [-165, 105, 30])


def drawn(kind: str, folder):
    """Eight photographs, eye-in-hand, without errors of the robot."""
    rng = np.random.default_rng(21)
    if kind == "aprilgrid":
        return photographs(folder, *aprilgrid_mm(GRID, 2), looks(rng, 8, np.array([60, -45]), 1.0), APRILGRID)
    if kind == "asymmetric circles":
        seen = looks(rng, 8, CIRCLES.xy_mm().mean(0), 1.0)
        return photographs(folder, *sheet_of_dots(CIRCLES.xy_mm(), CIRCLES.radii_mm()), seen, ASYMMETRIC)
    _, sheet, first = charuco()
    seen = looks(rng, 8, np.array([10, 60]), 1.0)
    found = photographs(folder, sheet, first, seen, SET)
    grid, origin = aprilgrid_mm(GRID, 2)
    for i, pose in enumerate(seen):
        sheets = [
            (grid, image_from_sheet(origin, pose @ COMMON_FROM_GRID)),
            (sheet, image_from_sheet(first, pose)),
        ]
        picture = photograph_of_several(sheets, PER_MM, (CAMERA.width, CAMERA.height))
        cv2.imwrite(str(found.images / f"{i}.png"), picture)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("aprilgrid", "AprilGrid"),
        pytest.param("asymmetric circles", "asymmetric circles", marks=pytest.mark.full),
        pytest.param("boards", "2 boards", marks=pytest.mark.full),
    ],
)
def test_the_camera_is_found(command, tmp_path, kind, said):  # noqa: F811
    """Within chance of its σ, and within 0.2 mm; `--dry-run` says what the board is."""
    files, out = drawn(kind, tmp_path), tmp_path / "h.json"
    code, shown, _ = command(*files.arguments(), "--dry-run")
    assert code == 0
    assert said in shown
    options = ("--workers", 1, "--splits", 0, "--method", "reprojection", "--out", out)
    code, shown, err = command(*files.arguments(), *options, *EXACT)
    assert code == 0, err
    data = json.loads(out.read_text())
    assert in_sigmas(data, "flange_from_camera", FLANGE_FROM_CAMERA) < CHANCE
    off = Rigid.from_matrix(data["flange_from_camera"]).translation - FLANGE_FROM_CAMERA.translation
    assert np.linalg.norm(off) < 0.2
