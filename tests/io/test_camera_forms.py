"""Cameras of other programs: each form read back, and their projections by the formulas of their documents."""

from typing import get_args

import numpy as np
import pycolmap
import pytest

from stcal.cli.instruments import Form
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.cameras.read import SUFFIXES, WRITERS, read_camera
from tests.outcome import refuses

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


METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>{kind}</projection><width>5184</width><height>3456</height>
  <f>4000.5</f><cx>12.25</cx><cy>-8.5</cy><b1>1.5</b1>
  <k1>-0.05</k1><k2>0.02</k2><k3>-0.003</k3><p1>0.0004</p1><p2>-0.0007</p2>
</calibration>
"""


def test_metashapes_fisheye_projects_by_its_own_formula(tmp_path):
    """Metashape's manual, appendix D: u = w/2 + cx + x' (f + b1), p1 beside r² + 2 x²; the first pixel is at 0.5."""
    (tmp_path / "c.xml").write_text(METASHAPE.format(kind="fisheye"))
    camera = read_camera(tmp_path / "c.xml").sized(0, 0)
    x, y = np.array([[0.3, -0.2], [0.1, 0.35]]).T
    expected = []
    for a, b in zip(x, y, strict=True):
        r = np.hypot(a, b)
        a, b = a * np.arctan(r) / r, b * np.arctan(r) / r
        r2 = a * a + b * b
        radial = 1 - 0.05 * r2 + 0.02 * r2**2 - 0.003 * r2**3
        moved_x = a * radial + 0.0004 * (r2 + 2 * a * a) - 2 * 0.0007 * a * b
        moved_y = b * radial - 0.0007 * (r2 + 2 * b * b) + 2 * 0.0004 * a * b
        expected.append([5184 / 2 + 12.25 + moved_x * 4002.0 - 0.5, 3456 / 2 - 8.5 + moved_y * 4000.5 - 0.5])
    np.testing.assert_allclose(camera.project(np.column_stack([x, y, np.ones(2)])), expected, atol=1e-9)


def test_mrcal_is_read_with_its_comments(tmp_path):
    (tmp_path / "c.cameramodel").write_text(
        "# written by hand\n{\n    'lensmodel':  'LENSMODEL_OPENCV8',\n    # fx,fy,cx,cy,distortion0,distortion1,...\n"
        "    'intrinsics': [ 1761.18, 1761.25, 1965.7, 1087.5, -0.01, 0.2, -0.0001, 0.0001, 0.05, 0.4, 0.2, 0.01, ],\n"
        "    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n    'imagersize': [ 4000, 2200 ],\n}\n"
    )
    camera = read_camera(tmp_path / "c.cameramodel")
    assert (camera.colmap_model, camera.width, camera.height) == ("FULL_OPENCV", 4000, 2200)
    np.testing.assert_array_equal(camera.centre, [1965.7, 1087.5])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("c.cameramodel", "{'lensmodel': 'LENSMODEL_SPLINED_STEREOGRAPHIC', 'intrinsics': [1], 'imagersize': [1, 1]}",
         "E-CAMERA-MODEL"),
        ("c.cameramodel", "{'lensmodel': __import__('os'), 'imagersize': [1, 1]}", "E-CAMERA-UNREADABLE"),
        ("c.xml", METASHAPE.format(kind="spherical"), "E-CAMERA-MODEL … spherical"),
        ("c.xml", METASHAPE.format(kind="frame").replace("<b1>", "<b2>0.1</b2><b1>"), "E-CAMERA-MODEL … b2 … 0.1"),
        ("c.xml", "<calibration><width>3</width></calibration>", "E-CAMERA-UNREADABLE"),
        ("cameras.bin", b"\x01" + bytes(7) + b"\x01" + bytes(30), "E-CAMERA-UNREADABLE"),
        ("cameras.bin", b"\x02" + bytes(7), "E-CAMERA-UNREADABLE"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_named(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refuses(message, read_camera, path)
