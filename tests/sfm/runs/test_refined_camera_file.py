"""``refined_cameras.txt``: the camera as a run adjusted it, a camera file for other commands."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import InputNote
from stcal.io.cameras.camera_model import model_of
from stcal.io.cameras.read import read_camera
from stcal.io.files import CAMERA, REFINED_CAMERA
from stcal.sfm import RunOptions, run
from stcal.sfm.camera.intrinsics import model_parameters
from stcal.sfm.mapping.body import unknown_lens
from tests.levels import sampled

pytestmark = pytest.mark.usefixtures("no_page")
CHI2_8_999 = 26.1
"""Of the squares of eight parameters' errors over their σ, once in a thousand draws more."""


def test_held_intrinsics_make_no_file(small_run):
    assert (small_run / CAMERA).is_file()
    assert not (small_run / REFINED_CAMERA).exists()


@pytest.mark.parametrize("given", sampled(["as of EXIF, 4 % off", "nothing"]))
def test_an_unknown_or_rough_camera_is_found_from_the_dots(small_dataset, small_scene, tmp_path, given):
    """The photographs have a lens with distortion. It is right within its σ, and far nearer than what was given."""
    true = small_scene.camera
    rough = replace(true, focal=np.full(2, 1.04 * true.focal.mean()), distortion=np.zeros(12))
    camera = None if given == "nothing" else model_of(unknown_lens(rough))
    files = [small_dataset / name for name in ("target.toml", "board.toml")]
    told = pytest.warns(InputNote, match="focal length to ±") if camera else nullcontext()
    with told:  # the file's own σ is reason enough to adjust the camera
        result = run(small_dataset / "images", camera, tmp_path / "run", *files, RunOptions(workers=1))
    assert not result.camera_given
    assert not result.notes
    found = read_camera(tmp_path / "run" / REFINED_CAMERA)
    assert np.allclose(found.focal, result.calibration.camera.focal, rtol=1e-12)
    off = model_parameters(found.sized(0, 0), "OPENCV") - model_parameters(true, "OPENCV")
    assert off @ np.linalg.solve(found.covariance, off) < CHI2_8_999
    assert np.abs(off[:2]).max() < 0.02 * 0.04 * true.focal.mean()
    for face, pose in result.target.target_from_face.items():
        error = pose.translation - small_scene.target_from_face[face].translation
        if face != result.target.reference_face:
            sigma = np.sqrt(np.diag(result.target.face_covariance[face])[3:])
            assert 0.05 < np.abs(error / sigma).max() < 4


@pytest.mark.slow
def test_circles_that_only_a_rough_camera_contradicts_are_not_left_out(small_set, small_scene):
    """A tangential distortion that is off by 0.003 moves centres by up to tenths of a pixel against one another. The
    refined camera follows the lens, and what was left out before is judged by it."""
    rough = small_scene.camera.parameters().copy()
    rough[6] += 0.003
    camera = small_scene.camera.with_parameters(rough)
    result = run(small_set("12").images, camera, None, options=RunOptions(refine_camera=True, workers=1))
    assert [outlier for group in result.solutions for outlier in group.outliers] == []
    assert [check.key for check in result.checks if check.verdict == "failed"] == []
