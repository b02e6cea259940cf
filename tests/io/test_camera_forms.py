"""Cameras of other programs: each form read back, and their projections by the formulas of their documents."""

from typing import get_args

import numpy as np
import pycolmap
import pytest

from stcal.cli.instruments import Form
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.cameras.read import SUFFIXES, WRITERS, read_camera
from tests.io.camera_files import METASHAPE, RAYS, metashape

LENSES = {
    "PINHOLE": [],
    "OPENCV": [-0.1, 0.03, 1e-3, -2e-3],
    "FULL_OPENCV": [-0.1, 0.03, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003],
    "OPENCV_FISHEYE": [0.02, -0.01, 0, 0, 3e-3, -1e-3],
    "THIN_PRISM_FISHEYE": [0.02, -0.01, 1e-3, -2e-3, 3e-3, -1e-3, 0, 0, 1e-3, 0, -1e-3],
}
SUFFIX = {form: suffix for suffix, form in reversed(SUFFIXES.items())} | {
    "ros": ".yaml",
    "kalibr": ".yaml",
    "metashape-cameras": ".xml",
}
REFUSED = {
    "OPENCV": (),
    "PINHOLE": (),
    "FULL_OPENCV": ("kalibr", "metashape", "metashape-cameras", "matlab"),
    "OPENCV_FISHEYE": ("mrcal", "matlab"),
    "THIN_PRISM_FISHEYE": ("opencv", "ros", "kalibr", "mrcal", "metashape", "metashape-cameras", "matlab"),
}
"""Forms that cannot hold a lens."""


def camera_of(model: str) -> Camera:
    distortion = np.pad(np.array(LENSES[model], float), (0, 12 - len(LENSES[model])))
    camera = Camera(1280, 961, [812.25, 809.5], [640.125, 478.0625], distortion, "FISHEYE" in model)
    return Camera.of(camera, model)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("form", WRITERS)
def test_what_is_written_reads_back(tmp_path, form, model):
    camera = camera_of(model)
    path = tmp_path / f"camera{SUFFIX[form]}"
    if form in REFUSED[model]:
        with pytest.raises(InputError, match=f"{form} has no place for .* of {model}; write --form colmap"):
            WRITERS[form](camera, "cam0")
        return
    content = WRITERS[form](camera, "cam0")
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = read_camera(path).calibrated(1280, 961)
    assert (found.width, found.height, found.fisheye) == (1280, 961, camera.fisheye)
    # sums and differences of half the image's size round in the last place
    np.testing.assert_allclose(found.parameters(), camera.parameters(), rtol=1e-14, atol=1e-12)


def test_the_command_knows_every_form():
    assert get_args(Form) == tuple(WRITERS)


def test_a_comment_does_not_tell_the_form(tmp_path):
    text = "# as the lensmodel of mrcal\n1 PINHOLE 1280 961 812.25 809.5 640.125 478.0625\n"
    (tmp_path / "cameras.txt").write_text(text)
    assert read_camera(tmp_path / "cameras.txt").colmap_model == "PINHOLE"


@pytest.mark.parametrize(("form", "suffix"), [("colmap", "txt"), ("colmap-bin", "bin")])
def test_colmap_reads_what_is_written(tmp_path, form, suffix):
    for model in LENSES:
        content = WRITERS[form](camera_of(model), "cam0")
        (tmp_path / f"cameras.{suffix}").write_bytes(content if isinstance(content, bytes) else content.encode())
        for name in ("images", "points3D"):
            (tmp_path / f"{name}.{suffix}").write_bytes(bytes(8) if suffix == "bin" else b"")
        (found,) = pycolmap.Reconstruction(tmp_path).cameras.values()
        assert found.model.name == model
        assert list(found.params) == camera_of(model).colmap_params()


def test_metashapes_fisheye_projects_by_its_own_formula(tmp_path):
    """u = w/2 + cx + x' (f + b1), p1 beside r² + 2 x²; the first pixel is at 0.5."""
    (tmp_path / "c.xml").write_text(METASHAPE.replace("frame", "fisheye"))
    radius = np.linalg.norm(RAYS[:, :2], axis=1, keepdims=True)
    turned = RAYS[:, :2] * np.arctan(radius) / radius
    wanted = metashape(turned, 910.25, (1.25, 0), (-0.2, 0.05, 0.01), (-0.0005, 0.001))
    np.testing.assert_allclose(read_camera(tmp_path / "c.xml").sized(0, 0).project(RAYS), wanted, atol=1e-9)
