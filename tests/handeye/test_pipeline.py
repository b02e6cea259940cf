"""The answer of :func:`stcal.handeye.handeye`: that of the command, from pairs of poses and from matrices."""

import json

import numpy as np
import pytest

from stcal import handeye
from stcal.geometry.rigid import Poses
from tests.handeye.test_cli import NOISE, poses_file
from tests.outcome import fails_with, refuses
from tests.support.handeye import FLANGE_FROM_CAMERA, simulated


@pytest.fixture
def truth():
    return simulated(np.random.default_rng(7), 8, **NOISE)


@pytest.fixture
def pairs(truth):
    return truth.pairs


def metres(poses: Poses) -> np.ndarray:
    return poses.matrix() * np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, "pose"])
def test_the_answer_is_that_of_the_command(command, truth, pairs, method, tmp_path):
    """To the last digits of the file: result, method and σ, which poses held out widen here."""
    out = tmp_path / "result.json"
    words = ["--method", method] if method else []
    assert command(poses_file(tmp_path / "poses.csv", truth), "--out", out, *words)[0] == 0
    said, found = json.loads(out.read_text()), handeye.handeye(pairs, method=method)
    own = handeye.compare(pairs, methods=("pose",))[0].result
    if method == "pose":  # of eight poses, results without some scatter by more than the adjustment's own σ
        assert found.covariance[3, 3] > 1.05 * own.covariance[3, 3]
    assert said["method"] == found.method
    np.testing.assert_allclose(said["flange_from_camera"], found.mount_from_camera.matrix(), atol=1e-6)
    np.testing.assert_allclose(said["covariance"], found.covariance, rtol=1e-3)
    assert said["verdict"]["word"] == found.verdict.word
    assert [finding["title"] for finding in said["verdict"]["findings"]] == [f.title for f in found.verdict.findings]
    with fails_with("E-HANDEYE-NOT-JUDGED … pose alone"):
        print(own.verdict)
    scaled = handeye.handeye(pairs, options=handeye.HandEyeOptions(with_scale=True))
    assert (scaled.method, scaled.sigma_scale is None) == ("pose", False)


@pytest.mark.slow
def test_matrices_in_metres_are_pairs_of_poses(pairs):
    found = handeye.handeye(
        metres(pairs.base_from_flange), metres(pairs.camera_from_board), setup="eye-in-hand", unit="m", method="pose"
    )
    same = handeye.handeye(pairs, "eye-in-hand", "pose")
    assert handeye.handeye(pairs=pairs, method="pose").mount_from_camera == same.mount_from_camera
    np.testing.assert_allclose(found.mount_from_camera.matrix(), same.mount_from_camera.matrix(), atol=1e-9)
    off = found.mount_from_camera.translation - FLANGE_FROM_CAMERA.translation
    assert np.linalg.norm(off) < 1.0  # noise of 0.2 mm an axis
    mixed = handeye.handeye(
        pairs.base_from_flange, pairs.camera_from_board.matrix(), setup="eye-in-hand", method="pose"
    )
    np.testing.assert_allclose(mixed.covariance, same.covariance)


def test_what_is_no_pairs_of_poses_is_refused(pairs):
    refuses("E-POSES-COUNT … camera_from_board", handeye.handeye, pairs.base_from_flange, setup="eye-in-hand")
    refuses("E-OPTION-CONFLICT … unit 'm'", handeye.handeye, pairs, unit="m")
    with fails_with("E-OPTION-VALUE … unit 'feet'"):
        handeye.handeye(pairs.base_from_flange, pairs.camera_from_board, setup="eye-in-hand", unit="feet")
