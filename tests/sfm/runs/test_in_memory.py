"""A run on arrays gives what the same pixels in files give, and leaves no file."""

import tempfile
from dataclasses import replace

import numpy as np
import pytest

from stcal import sfm, synthetic
from stcal.synthetic.dataset import write_dataset
from tests.conftest import SMALL
from tests.levels import SLOW
from tests.outcome import fails_with


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@SLOW
@pytest.mark.usefixtures("no_page")
def test_arrays_give_what_files_give(tmp_path, scratch):
    scene = synthetic.make_scene(replace(SMALL, groups=(("1", "2"),)))
    write_dataset(tmp_path / "data", scene, image_format="png")
    from_files = sfm.run(tmp_path / "data" / "images", scene.camera, tmp_path / "run")
    result = sfm.run(synthetic.render_all(scene), scene.camera)
    assert result.out is None
    assert list(scratch.glob("stcal-run*")) == []
    assert result.target.circles.keys() == from_files.target.circles.keys()
    worst = max(np.abs(result.target.circles[k] - from_files.target.circles[k]).max() for k in result.target.circles)
    assert worst < 1e-6  # mm: the same pixels; sums in another order
    assert result.judgement.use == from_files.judgement.use
    images = result.images()
    assert [image.name for image in images][:2] == ["12/0.png", "12/1.png"]
    for image in images:
        assert len(image.residuals_px) == len(image.labels) == len(image.xy_px)
        assert 0.5 < np.linalg.norm(image.residuals_px) / (image.rms_px * np.sqrt(image.residuals_px.size)) < 2
        true = scene.groups[image.group].camera_from_target[int(image.name[-5])]
        between = true.inverse() @ image.camera_from_target
        # The target frame through a plane and that through three circles placed to 0.02 mm.
        assert np.linalg.norm(between.translation) < 0.3
        assert (np.linalg.eigvalsh(image.covariance) > 0).all()


def test_a_run_that_fails_leaves_no_file_either(scratch):
    with fails_with("E-GROUP-FEW-IMAGES … 1/0.png"):
        sfm.run({"1": [np.zeros((864, 1296), np.uint8)]}, synthetic.make_scene(SMALL).camera)
    assert list(scratch.glob("stcal-run*")) == []
