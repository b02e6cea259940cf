"""Camera files: each kind with its pixel origin, other programs by their own projections, and what is refused."""

import re
import sqlite3
import struct
import warnings

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.errors import InputError, InputNote
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import cameras_txt
from stcal.io.cameras.foreign_lenses import ForeignLens
from stcal.io.cameras.read import camera_chosen, name_to_write, read_camera, read_lens
from tests.io.camera_files import (
    CAMERA_INFO,
    D4,
    D5,
    EYE,
    FILES,
    FLAT,
    INI,
    K4,
    METASHAPE,
    MRCAL,
    OST,
    RAYS,
    REMOVED,
    ROS1,
    SIZE,
    metashape,
    perspective,
    project,
)
from tests.outcome import fails_with, refuses
from tests.shared import written

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


def read(tmp_path, content: str | bytes):
    return read_lens(written(tmp_path / "camera", content))


def same_pixels(lens, wanted: np.ndarray) -> None:
    np.testing.assert_allclose(project(lens), wanted, atol=1e-9)


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
    storage.write("camera_matrix", np.array([[1000.0, 0, 500], [0, 1100, 400], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[1e-7, -0.2, 3e-20, -4e-3, 0.05]]).T)
    storage.write("avg_reprojection_error", 0.2)
    storage.release()
    model = read_camera(path)
    assert (model.width, model.height, model.colmap_model) == (1001, 801, "FULL_OPENCV")
    np.testing.assert_array_equal(model.focal, [1000, 1100])
    np.testing.assert_array_equal(model.centre, [500, 400])  # OpenCV's origin is ours: nothing is subtracted
    np.testing.assert_array_equal(model.distortion, [1e-7, -0.2, 3e-20, -4e-3, 0.05, *[0.0] * 7])


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


def test_a_size_that_is_not_stated_is_the_images_and_lists_that_are_no_coefficients_pass(tmp_path):
    model = read(tmp_path, yaml_text())
    assert (model.width, model.height) == (None, None)
    camera = model.sized(640, 480)
    assert (camera.width, camera.height) == (640, 480)
    stated = read(tmp_path, yaml_text(more="image_width: 1000\nimage_height: 800.0\n")).sized(640, 480)
    assert (stated.width, stated.height) == (1000, 800)
    for other in ("turn: [0.5, 0.5, 0.5, 0.5]", "window: [0, 0, 1280, 720]", "tvec: [0.1, 2, 3, 4.5]"):
        same_pixels(read(tmp_path, f"camera_matrix: {FLAT}\ndist: {D5}\n{other}\n"), perspective(D5))
        same_pixels(read(tmp_path, f"camera_matrix: {FLAT}\n{other}\n"), perspective([0.0] * 5))
    inverse = OST.format(model="distortion_model: inverse_brown_conrady", values=[0.0] * 5)
    same_pixels(read(tmp_path, inverse), perspective([0.0] * 4))


@pytest.mark.parametrize("name", FILES)
def test_a_program_projects_the_same(tmp_path, name):
    """In another encoding with other line ends too; a key more is named and changes nothing."""
    text, wanted = FILES[name]
    encoded = text.replace(' encoding="UTF-8"', "").replace("\n", "\r\n").encode("utf-16")
    with pytest.warns(InputNote, match="operator_42"):
        longer = read(tmp_path, with_key(text, "operator_42", "7"))
    lens = read(tmp_path, text)
    for each in (lens, longer, read(tmp_path, encoded)):
        same_pixels(each, wanted)
    assert (lens.width, lens.height) in (SIZE, (None, None))
    assert lens.width or name == "ROS-Industrial"  # its files have no size


def with_key(text: str, key: str, value: str) -> str:
    """The text with one more key beside those of the lens."""
    if text.lstrip().startswith("<"):
        at = text.rindex("</")
        return f"{text[:at]}<{key}>{value}</{key}>\n{text[at:]}"
    if "fc = " in text:
        return f"{text}{key} = {value};\n"
    if "'lensmodel'" in text:
        return text.replace("{", f"{{ '{key}': {value}, ", 1)
    if text.startswith("{"):
        return text.replace("{", f'{{"{key}": {value}, ', 1)
    if "[narrow_stereo]" in text:
        return f"{text}\n{key}\n{value}\n"
    return text.removesuffix("---\n") + f"{'  ' if text.startswith('cam0:') else ''}{key}: {value}\n"


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("key", ["xi", "s1", "tilt_x", "fisheye_model", "lens_distortion", "k9", "distortion_model_2"])
def test_a_key_of_the_projection_is_taken_or_refused(tmp_path, name, key):
    """Its pixels change, or the error names it; with 0 it changes nothing."""
    text, wanted = FILES[name]
    if re.search(rf"\b{key}\b", text):
        return
    if key != "fisheye_model":  # 0 says perspective
        same_pixels(read(tmp_path, with_key(text, key, "0")), wanted)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            changed = read(tmp_path, with_key(text, key, "1.5"))
    except InputError as error:
        refused = error
    else:
        confirmed = key == "fisheye_model" and name in ("OpenCV, fisheye", "ROS 1", "ROS, camera_model")
        assert confirmed or np.abs(project(changed) - wanted).max() > 1
        return
    assert refused.code in ("E-CAMERA-KEY", "E-CAMERA-REPEATED", "E-CAMERA-MODEL", "E-CAMERA-COEFFICIENTS")
    assert key.split("_")[0] in str(refused)


def stated(sigma: str, correlation: str) -> str:
    """A camera that states the covariance of f, cx, cy, k1."""
    rows = "".join(f"# CORRELATION[] {row}\n" for row in correlation.split(", ") if row)
    return f"# SIGMA[] {sigma}\n{rows}1 SIMPLE_RADIAL 640 480 700 320 240 0\n"


def info(values=()) -> str:
    return CAMERA_INFO.format(model="none", values=list(values), **ROS1)


IN_MM = [16, 0, 640, 0, 16, 360, 0, 0, 1]
ODD_KEYS = ["kc", "dist_vec", "calib_dist", "rect_distortion", "D_vec", "lens", "num_dist"]
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
    "ROS: inverse": (OST.format(model="distortion_model: inverse_brown_conrady", values=D4),
                     "E-CAMERA-MODEL … inverse_brown_conrady … another formula … calibrate"),
    "ROS: binning": (info().replace("binning_x: 0", "binning_x: 2"),
                     "E-CAMERA-KEY … binning_x = 2 … set it to 0 … calibrate"),
    "ROS: a region": (info().replace("x_offset: 0", "x_offset: 320"), "E-CAMERA-KEY … roi.x_offset = 320"),
    "ROS: two words": (OST.format(model="camera_model: fisheye\ndistortion_model: plumb_bob", values=K4),
                       "E-CAMERA-MODEL … says"),
    "ROS: two sizes": (OST.format(model="resolution: [720, 1280]", values=D4),
                       "E-CAMERA-SIZE … 720×1280 px … 1280×720 px"),
    "ROS: two matrices": (OST.format(model=f"K: {EYE}", values=D4), "E-CAMERA-REPEATED … K"),
    "ROS: documents that differ": (f"{info()}---\n{info(D4)}", "E-CAMERA-UNREADABLE … 2 documents"),
    "size of a shape": (f"K: {FLAT}\nimage_size: [720, 1280]\n", "E-CAMERA-SIZE … 720×1280 px … width first"),
    "a fisheye without a model": (f"K: {FLAT}\nD: {K4}\n", "E-CAMERA-MODEL … D … -0.0248 … equidistant"),
    "a lens in mm": (f"K: {IN_MM}\nimage_size: {list(SIZE)}\n", "E-CAMERA-FOCAL … 16 … mm"),
    "a lens in mm without a size": (f"K: {IN_MM}\n", "E-CAMERA-FOCAL … 16 … mm"),
    "shares of a side": ("K: [0.75, 0, 0.51, 0, 0.76, 0.49, 0, 0, 1]\n", "E-CAMERA-FOCAL … 0.75 … shares"),
    "a centre from the middle": (f"image_size: {list(SIZE)}\nK: [911.5, 0, -3.2, 0, 910, 7.5, 0, 0, 1]\n",
                                 "E-CAMERA-CENTRE … -3.2 … middle"),
    "YAML: key twice": (f"K: {FLAT}\nD: {D4}\nD: {D5}\n", "E-CAMERA-UNREADABLE … D twice"),
    "JSON: key twice": ('{"K": [1, 0, 1, 0, 1, 1, 0, 0, 1], "K": 5}', "E-CAMERA-UNREADABLE … K twice"),
    **{f"YAML: coefficients as {key}": (f"camera_matrix: {FLAT}\n{key}: {D5}\n",
                                       f"E-CAMERA-KEY … {key} … distortion_coefficients") for key in ODD_KEYS},
}
# fmt: on


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_named_in_one_line(tmp_path, case):
    content, message = WRONG[case]
    with fails_with(message) as caught:
        read_camera(written(tmp_path / "camera.txt", content))
    assert str(caught.value).startswith("camera file")
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
    path = written(tmp_path_factory.getbasetemp() / "any_camera", content)
    with pytest.raises(InputError) as caught:  # 80 random bytes are no camera
        read_camera(path)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", range(12))
def test_a_parameter_out_of_all_bounds_is_named(tmp_path, place):
    """Without a word of what overflows."""
    values = [900.0, 900.0, 400.0, 300.0, *[0.0] * 8]
    values[place] = 1e308
    text = f"1 FULL_OPENCV 800 600 {' '.join(map(str, values))}\n"
    refuses("E-CAMERA-TOO-FAR … 1e+308 … 1e+12", read, tmp_path, text)


@pytest.mark.parametrize("name", REMOVED)
def test_a_form_that_is_not_read_is_refused_in_one_line(tmp_path, name):
    with pytest.raises(InputError, match="camera file") as caught:
        read(tmp_path, REMOVED[name])
    assert "\n" not in str(caught.value)


def test_what_is_not_understood_names_the_programs_that_are_read(tmp_path):
    programs = "COLMAP, OpenCV, ROS, Kalibr, EuRoC, MATLAB, Bouguet, Metashape, mrcal and camodocal"
    for content in ("hello", f"fx: {FLAT}\n", b"PK\x03\x04\xff", b"\x80\x04\x95\x10\xff"):
        with pytest.raises(InputError, match=programs):
            read(tmp_path, content)


@pytest.mark.parametrize(("more", "named"), [("", "equidistant"), ("42: 7\n", "42")])
def test_four_coefficients_without_a_model_and_a_key_that_is_a_number_are_named(tmp_path, more, named):
    with pytest.warns(InputNote, match=named):
        lens = read(tmp_path, f"K: {FLAT}\nD: {D4}\n{more}")
    same_pixels(lens, perspective(D4))


def test_a_camera_of_a_pair_is_chosen_and_its_essential_matrices_are_no_cameras(tmp_path):
    other = [800.0, 0, 630.0, 0, 801.0, 350.0, 0, 0, 1]
    sides = {"left": "camera_matrix_left dist_coeffs_left", "right": "camera_matrix_right dist_coeffs_right"}
    for names in ({"1": "M1 D1", "2": "M2 D2"}, {"1": "K1 D1", "2": "K2 D2"}, sides):
        (first, one), (second, two) = ((name, keys.split()) for name, keys in names.items())
        text = f"{one[0]}: {FLAT}\n{one[1]}: {D5}\n{two[0]}: {other}\n{two[1]}: {D4}\n"
        path = written(tmp_path / "stereo.yml", f"{text}R: {EYE}\nT: [1, 0, 0]\nE: {FLAT}\nF: {FLAT}\n")
        refuses(f"E-CAMERA-SEVERAL … 2 cameras … {first}, {second} … --camera-name", read_lens, path)
        same_pixels(read_lens(path, first), perspective(D5))
        wanted = perspective(D4, (800.0, 801.0, 630.0, 350.0))
        same_pixels(read_lens(path, second), wanted)
        with camera_chosen(second):
            same_pixels(read_camera(path), wanted)


def test_metashapes_p3_and_p4_are_taken_and_a_chosen_name_becomes_one_to_write(tmp_path):
    text = METASHAPE.replace("<date>", "<p3>0.85</p3>\n<p4>-0.44</p4>\n<k4>0.02</k4>\n<b2>0.6</b2>\n<date>")
    lens = read(tmp_path, text)
    assert isinstance(lens, ForeignLens)
    k, p = (-0.2, 0.05, 0.01, 0.02), (-0.0005, 0.001)
    same_pixels(lens, metashape(RAYS[:, :2], 910.25, (1.25, 0.6), k, p, (0.85, -0.44)))
    names = {"Cam B (35mm)": "Cam_B_35mm", "2": "cam2", "a.b": "a_b", "": "cam0", "é": "cam0", "_x": "x"}
    assert {name: name_to_write(name) for name in names} == names


@pytest.mark.parametrize("count", [255, 256])
def test_any_number_of_cameras_of_colmap(tmp_path, count):
    content = [struct.pack("<Q", count)]
    for i in range(1, count + 1):
        content.append(struct.pack("<IiQQ8d", i, 4, 1920, 1080, 1500.0 + i, 1501, 960, 540, -0.1, 0.02, 1e-4, 2e-4))
    (tmp_path / "cameras.bin").write_bytes(b"".join(content))
    for name in ("images.bin", "points3D.bin"):
        (tmp_path / name).write_bytes(bytes(8))
    theirs = pycolmap.Reconstruction(tmp_path).cameras[count]
    lens = read_lens(tmp_path / "cameras.bin", str(count))
    wanted = np.array([theirs.img_from_cam(ray) for ray in RAYS]) - 0.5
    same_pixels(lens, wanted)


def test_a_database_without_its_log_is_named(tmp_path):
    path = tmp_path / "database.db"
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("CREATE TABLE cameras (camera_id, model, width, height, params)")
    database.commit()
    copy = written(tmp_path / "copy.db", path.read_bytes())
    database.close()
    refuses("E-CAMERA-UNREADABLE … copy.db-wal … copy both", read_lens, copy)
    assert sorted(each.name for each in tmp_path.iterdir() if each.name.startswith("copy")) == ["copy.db"]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_pair_in_ros_ini_is_chosen(tmp_path, side):
    head, _, own = INI.partition("[narrow_stereo]")
    other = own.replace("911.5", "912.5")
    path = written(tmp_path / "ost.txt", f"{head}[narrow_stereo/left]{own}[narrow_stereo/right]{other}")
    wanted = perspective(D5, (911.5 + (side == "right"), 910.25, 639.0, 359.0))
    same_pixels(read_lens(path, f"narrow_stereo/{side}"), wanted)
