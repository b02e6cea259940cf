"""Camera files: each kind with its pixel origin, and one test per way in which a file can be wrong."""

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import cameras_txt
from stcal.io.cameras.read import read_camera
from tests.io.camera_files import METASHAPE, MRCAL
from tests.outcome import fails_with, refuses

K = [[1000.0, 0, 500], [0, 1100, 400], [0, 0, 1]]
D5 = [0.1, -0.2, 0.003, -0.004, 0.05]
COLMAP_CASES = {
    "SIMPLE_PINHOLE": [1000, 500.5, 400.5],
    "PINHOLE": [1000, 1100, 500.5, 400.5],
    "SIMPLE_RADIAL": [1000, 500.5, 400.5, 0.1],
    "RADIAL": [1000, 500.5, 400.5, 0.1, -0.2],
    "OPENCV": [1000, 1100, 500.5, 400.5, 0.1, -0.2, 3e-3, -4e-3],
    "FULL_OPENCV": [1000, 1100, 500.5, 400.5, 0.1, -0.2, 3e-3, -4e-3, 0.05, 0.06, 0.07, 0.08],
    "SIMPLE_RADIAL_FISHEYE": [1000, 500.5, 400.5, 0.1],
    "RADIAL_FISHEYE": [1000, 500.5, 400.5, 0.1, -0.2],
    "OPENCV_FISHEYE": [1000, 1100, 500.5, 400.5, 0.1, -0.2, 3e-3, -4e-3],
    "THIN_PRISM_FISHEYE": [1000, 1100, 500.5, 400.5, 0.1, -0.2, 3e-3, -4e-3, 0.05, 0.06, 0.007, 0.008],
}
"""Model, and its parameters in COLMAP's order."""


def yaml_text(k="[1000, 0, 500, 0, 1100, 400, 0, 0, 1]", d="[]", more="") -> str:
    return f"camera_matrix: {k}\ndistortion_coefficients: {d}\n{more}"


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
"""Values of 400 million words in ten lines."""


def padded(distortion) -> list[float]:
    return [*distortion, *[0.0] * (12 - len(distortion))]


def read(tmp_path, content: str | bytes, name="camera.txt"):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_camera(path)


@pytest.mark.parametrize("name", COLMAP_CASES)
def test_projection_agrees_with_pycolmap(tmp_path, name):
    params = COLMAP_CASES[name]
    model = read(tmp_path, f"# Camera list\n1 {name} 1000 800 {' '.join(map(str, params))}\n")
    assert (model.width, model.height, model.colmap_model) == (1000, 800, name)
    camera = model.sized(1, 1)
    xyz = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (20, 3))
    theirs = pycolmap.Camera(model=name, width=1000, height=800, params=params).img_from_cam(xyz)
    np.testing.assert_allclose(camera.project(xyz), theirs - 0.5, atol=1e-9)  # rounding at 1000 px
    np.testing.assert_allclose(Camera.of(camera, name).colmap_params(), params, rtol=1e-15)


@given(
    st.sampled_from(sorted(COLMAP_CASES)),
    st.lists(st.floats(600, 20000), min_size=3, max_size=3),
    st.floats(0.2, 5),
    st.lists(st.floats(-1, 1), min_size=8, max_size=8),
)
def test_cameras_txt_round_trip(tmp_path_factory, name, lengths, ratio, coefficients):
    path = tmp_path_factory.mktemp("round") / "cameras.txt"
    path.write_text(f"1 {name} 1000 800 {' '.join(map(str, COLMAP_CASES[name]))}\n")
    plain = read_camera(path).sized(1, 1)
    k = np.where(plain.distortion, [*coefficients, *coefficients[:4]], 0.0)
    fx, fy = lengths[0], lengths[0] * (1 if plain.focal[0] == plain.focal[1] else ratio)
    camera = Camera(6000, 4000, [fx, fy], lengths[1:], k, "FISHEYE" in name)
    path.write_text(cameras_txt(Camera.of(camera, name)))
    found = read_camera(path)
    assert (found.colmap_model, found.width, found.height) == (name, 6000, 4000)
    np.testing.assert_array_equal(found.focal, camera.focal)
    np.testing.assert_array_equal(found.distortion, camera.distortion)
    np.testing.assert_allclose(found.centre, camera.centre, rtol=0, atol=4e-12)  # +0.5 − 0.5 at 20 000 px: one ulp


@pytest.mark.parametrize("suffix", ["yaml", "yml", "xml", "json"])
def test_file_storage_of_opencv(tmp_path, suffix):
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon Jan  1 12:00:00 2024")
    storage.write("image_width", 1001)
    storage.write("image_height", 801)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([[1e-7, -0.2, 3e-20, -4e-3, 0.05]]).T)
    storage.write("avg_reprojection_error", 0.2)
    storage.release()
    model = read_camera(path)
    assert (model.width, model.height, model.colmap_model) == (1001, 801, "FULL_OPENCV")
    np.testing.assert_array_equal(model.focal, [1000, 1100])
    np.testing.assert_array_equal(model.centre, [500, 400])  # OpenCV's origin is ours: nothing is subtracted
    np.testing.assert_array_equal(model.distortion, padded([1e-7, -0.2, 3e-20, -4e-3, 0.05]))


@pytest.mark.parametrize(
    ("distortion", "expected"),
    [
        ("[]", "PINHOLE"),
        ("[0, 0, 0, 0, 0]", "PINHOLE"),
        ("[0.1, 0, 0, 0]", "OPENCV"),
        ("[0.1, 0, 0, 0, 0]", "OPENCV"),
        ("[0.1, 0, 0, 0, 0.1]", "FULL_OPENCV"),
        ("[0, 0, 0, 0, 0, 0, 0, 0.1]", "FULL_OPENCV"),
        ("[0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]", "OPENCV"),  # the rest is zero: held exactly
    ],
)
def test_the_smallest_colmap_model_that_holds_it(tmp_path, distortion, expected):
    assert read(tmp_path, yaml_text(d=distortion)).colmap_model == expected


def test_a_size_that_the_file_does_not_state_is_the_images(tmp_path):
    model = read(tmp_path, yaml_text())
    assert (model.width, model.height) == (None, None)
    camera = model.sized(640, 480)
    assert (camera.width, camera.height) == (640, 480)
    stated = read(tmp_path, yaml_text(more="image_width: 1000\nimage_height: 800.0\n")).sized(640, 480)
    assert (stated.width, stated.height) == (1000, 800)


def stated(sigma: str, correlation: str) -> str:
    """A camera that states the covariance of f, cx, cy, k1."""
    rows = "".join(f"# CORRELATION[] {row}\n" for row in correlation.split(", ") if row)
    return f"# SIGMA[] {sigma}\n{rows}1 SIMPLE_RADIAL 640 480 700 320 240 0\n"


SIGMA, ALONE = "0.3 0.2 0.2 1e-4", "1 0 0 0, 0 1 0 0, 0 0 1 0, 0 0 0 1"


# fmt: off
WRONG = {
    "empty": ("", "E-CAMERA-UNREADABLE"),
    "binary": (bytes(range(256)), "E-CAMERA-UNREADABLE"),
    "a photograph": (b"\xff\xd8\xff\xe0\x00\x10JFIF", "E-CAMERA-UNREADABLE"),
    "UTF-16 without its mark": ("1 PINHOLE 10 10 1 1 1 1".encode("utf-16-le"), "E-CAMERA-UNREADABLE"),
    "COLMAP: two cameras": ("1 PINHOLE 9 9 1 1 1 1\n2 PINHOLE 9 9 1 1 1 1\n", "E-CAMERA-SEVERAL … 2 … 1, 2"),
    "COLMAP: too few": ("1 PINHOLE 9 9 1 1 1", "E-CAMERA-COEFFICIENTS … 3 … PINHOLE … 4"),
    "COLMAP: a word": ("1 PINHOLE 9 9 1 one 1 1", "E-CAMERA-CONTENT"),
    "COLMAP: negative width": ("1 PINHOLE -9 9 1 1 1 1", "E-CAMERA-SIZE … -9"),
    "COLMAP: half a pixel": ("1 PINHOLE 9.5 9 1 1 1 1", "E-CAMERA-SIZE … 9.5"),
    "COLMAP: 5000 digits": (f"1 PINHOLE {'9' * 5000} 9 1 1 1 1", "E-CAMERA-SIZE … inf"),
    "COLMAP: negative focal": ("1 PINHOLE 9 9 1 -7 1 1", "E-CAMERA-FOCAL … 1 … -7"),
    "σ: negative": (stated("0.3 -0.2 0.2 1e-4", ALONE), "E-CAMERA-COVARIANCE … 0.2"),
    "σ: a word": (stated("0.3 0.2 0.2 small", ALONE), "E-CAMERA-COVARIANCE"),
    "σ: too few": (stated("0.3 0.2 0.2", ALONE), "E-CAMERA-COVARIANCE … 4 σ"),
    "σ: no correlations": (stated(SIGMA, ""), "E-CAMERA-COVARIANCE … 4 … 4 … 4"),
    "σ: upper only": (stated(SIGMA, ALONE.replace("1 0 0 0", "1 0.5 0 0")), "E-CAMERA-COVARIANCE … 100"),
    "σ: diagonal of 9": (stated(SIGMA, ALONE.replace("1 0 0 0", "9 0 0 0")), "E-CAMERA-COVARIANCE … 9 … 1"),
    "YAML: broken": ("camera_matrix: [1, 2", "E-CAMERA-UNREADABLE"),
    "YAML: unknown tag": ("a: !!python/object/apply:os.getcwd []", "E-CAMERA-UNREADABLE"),
    "YAML: nested too deep": ("[" * 5000, "E-CAMERA-UNREADABLE"),
    "YAML: an alias": (yaml_text("&m [9, 0, 9, 0, 9, 9, 0, 0, 1]") + "\nother: *m", "E-CAMERA-UNREADABLE"),
    "YAML: an alias bomb": (BOMB + yaml_text(more="distortion_model: *i\n"), "E-CAMERA-UNREADABLE"),
    "YAML: no matrix": ("image_width: 640\n", "E-CAMERA-CONTENT … camera_matrix"),
    "YAML: matrix without data": ("camera_matrix: {rows: 3, cols: 3}", "E-CAMERA-CONTENT … camera_matrix"),
    "YAML: matrix 2×2": (yaml_text("[1000, 0, 0, 1000]"), "E-CAMERA-COEFFICIENTS … matrix … 4"),
    "YAML: matrix ragged": (yaml_text("[[1, 0, 2], [0, 1], [0, 0, 1]]"), "E-CAMERA-UNREADABLE"),
    "YAML: matrix transposed": (yaml_text("[1000, 0, 0, 0, 1000, 0, 500, 400, 1]"), "E-CAMERA-MATRIX … transposed"),
    "YAML: matrix of zeros": (yaml_text("[0, 0, 0, 0, 0, 0, 0, 0, 0]"), "E-CAMERA-UNCALIBRATED … calibrate"),
    "YAML: matrix sheared": (yaml_text("[1000, 0, 500, 5, 1000, 400, 0, 0, 1]"), "E-CAMERA-MATRIX"),
    "YAML: skew": (yaml_text("[1000, 0.5, 500, 0, 1000, 400, 0, 0, 1]"), "E-CAMERA-MODEL … skewed"),
    "YAML: NaN skew": (yaml_text("[1000, .nan, 500, 0, 1000, 400, 0, 0, 1]"), "E-CAMERA-SKEW … nan"),
    "YAML: NaN distortion": (yaml_text(d="[.nan, 0, 0, 0]"), "E-CAMERA-NOT-FINITE"),
    "YAML: thin prism": (yaml_text(d="[0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0]"), "E-CAMERA-MODEL"),
    "YAML: k1 k2 k3": (yaml_text(d="[0.1, 0.2, 0.3]"), "E-CAMERA-COEFFICIENTS … 3 … 0, 4, 5, 8, 12, 14"),
    "YAML: distortion a mapping": (yaml_text(d="{a: 1}"), "E-CAMERA-KEY … distortion_coefficients.a = 1"),
    "YAML: a width that is true": (yaml_text(more="image_width: true"), "E-CAMERA-SIZE"),
    "COLMAP: fy of 2": ("1 PINHOLE 1000 800 1000 2 500 400", "E-CAMERA-FOCAL … 10"),
    "YAML: negative width": (yaml_text(more="image_width: -5"), "E-CAMERA-SIZE … -5"),
    "YAML: width a word": (yaml_text(more="image_width: wide"), "E-CAMERA-UNREADABLE … 'wide'"),
    "YAML: double sphere": (yaml_text(more="distortion_model: ds"), "E-CAMERA-MODEL … 'ds'"),
    "YAML: five of a fisheye": (yaml_text(d=str(D5), more="distortion_model: fisheye"), "E-CAMERA-COEFFICIENTS … 5"),
    "XML: cut off": ("<opencv_storage><camera_matrix>", "E-CAMERA-UNREADABLE"),
    "XML: a web page": ("<!DOCTYPE html><html><body>404</body></html>", "E-CAMERA-CONTENT … camera_matrix"),
    "Metashape: spherical": (METASHAPE.replace("frame", "spherical"), "E-CAMERA-MODEL … spherical"),
    "Metashape: b2": (METASHAPE.replace("<b1>", "<b2>0.1</b2><b1>"), "E-CAMERA-MODEL … b2 … 0.1"),
    "Metashape: short": ("<calibration><width>3</width></calibration>", "E-CAMERA-UNREADABLE"),
    "mrcal: splines of nothing": (MRCAL.replace("OPENCV5", "SPLINED_STEREOGRAPHIC"), "E-CAMERA-MODEL"),
    "mrcal: a program": ("{'lensmodel': __import__('os'), 'imagersize': [1, 1]}", "E-CAMERA-UNREADABLE"),
    "COLMAP, binary: cut off": (b"\x01" + bytes(7) + b"\x01" + bytes(30), "E-CAMERA-UNREADABLE"),
    "COLMAP, binary: no camera": (b"\x02" + bytes(7), "E-CAMERA-UNREADABLE"),
    "XML: short": ("<o><camera_matrix><data>1 2 3</data></camera_matrix></o>", "E-CAMERA-COEFFICIENTS … matrix … 3"),
}
# fmt: on


@pytest.mark.slow
@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_named_in_one_line(tmp_path, case):
    content, message = WRONG[case]
    with fails_with(message) as caught:
        read(tmp_path, content)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 350 + len(str(tmp_path))  # a line to read, not a dump of the file


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (".", "E-CAMERA-UNREADABLE … Is a directory"),
        ("missing.txt", "E-CAMERA-UNREADABLE … No such file"),
        ("x" * 300, "E-CAMERA-UNREADABLE … File name too long"),
        ("a\0b", "E-CAMERA-UNREADABLE"),
    ],
)
def test_a_path_that_cannot_be_read(tmp_path, name, message):
    refuses(message, read_camera, tmp_path / name)


@given(st.binary(max_size=80))
def test_any_bytes_give_a_camera_or_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any_camera"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:  # 80 random bytes are no camera
        read_camera(path)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", range(12))
def test_a_parameter_out_of_all_bounds_is_named(tmp_path, place):
    """Without a word of what overflows."""
    values = [900.0, 900.0, 400.0, 300.0, *[0.0] * 8]
    values[place] = 1e308
    path = tmp_path / "cameras.txt"
    path.write_text(f"1 FULL_OPENCV 800 600 {' '.join(map(str, values))}\n")
    refuses("E-CAMERA-TOO-FAR … 1e+308 … 1e+12", read_camera, path)
