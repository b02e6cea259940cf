"""Another maker's target is a file and not a code change: the second design through its TOML files alone."""

import pytest

from stcal.sfm import run
from stcal.sfm.report.compare import compare
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.designs import second_design
from stcal.synthetic.scene import SceneOptions, make_scene


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("second")
    options = SceneOptions(seed=5, width=1728, height=1152, images_per_group=4)
    scene = make_scene(options, *second_design())
    write_dataset(folder / "data", scene)
    data = folder / "data"
    result = run(data / "images", data / "cameras.txt", folder / "run", data / "target.toml", data / "board.toml")
    return scene, data, folder / "run", result


@pytest.mark.slow
def test_faces_are_right_within_their_own_sigma(calibrated):
    _, data, out, result = calibrated
    comparison = compare(out, data / "truth.json").content()
    assert not comparison["missing"]
    assert comparison["labels"]["wrong"] == 0
    for face_id, row in comparison["faces"].items():
        if face_id == comparison["reference_face"]:
            continue
        # √(eᵀC⁻¹e/6) of a true covariance exceeds 2 about once in 2000 draws (χ² with 6 degrees of freedom).
        assert 0.1 < row["normalised_error"] < 2.0, face_id
        assert row["translation_um"] < 30, face_id
    assert result.calibration.joint.sigma0 == pytest.approx(1.0, abs=0.2)
