"""``stcal handeye`` with a set of boards, drawn."""

import json

import cv2
import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from tests.handeye.photographed import looks, photographs
from tests.handeye.test_cli import CHANCE, EXACT, in_sigmas
from tests.handeye.test_images import charuco, photograph_of_both
from tests.support.handeye import FLANGE_FROM_CAMERA

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


@pytest.mark.slow
def test_several_boards_are_one(command, tmp_path):
    """Eye-in-hand, without errors of the robot: within chance of its σ, and within 0.2 mm; `--dry-run` says what the
    board is."""
    seen = looks(np.random.default_rng(21), 8, np.array([10, 60]), 1.0)
    _, sheet, first = charuco()
    files, out = photographs(tmp_path, sheet, first, seen, SET), tmp_path / "h.json"
    for i, pose in enumerate(seen):
        cv2.imwrite(str(files.images / f"{i}.png"), photograph_of_both(pose))
    code, shown, _ = command(*files.arguments(), "--dry-run")
    assert code == 0
    assert "2 boards" in shown
    options = ("--workers", 1, "--splits", 0, "--method", "reprojection", "--out", out)
    code, shown, err = command(*files.arguments(), *options, *EXACT)
    assert code == 0, err
    data = json.loads(out.read_text())
    assert in_sigmas(data, "flange_from_camera", FLANGE_FROM_CAMERA) < CHANCE
    off = Rigid.from_matrix(data["flange_from_camera"]).translation - FLANGE_FROM_CAMERA.translation
    assert np.linalg.norm(off) < 0.2
