"""Camera files of other programs: their projections by OpenCV or by the programs' formulas, and the rule for keys."""

import re
import sqlite3
import struct
import warnings

import numpy as np
import pycolmap
import pytest

from stcal.errors import InputError, InputNote
from stcal.io.cameras.camera_model import CameraModel
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
    OST,
    RAYS,
    REMOVED,
    ROS1,
    SIZE,
    metashape,
    perspective,
)
from tests.outcome import fails_with, refuses


def read(tmp_path, content: str | bytes):
    path = tmp_path / "camera"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_lens(path)


def project(lens: CameraModel | ForeignLens) -> np.ndarray:
    return lens.project(RAYS) if isinstance(lens, ForeignLens) else lens.sized(*SIZE).project(RAYS)


@pytest.mark.parametrize("name", FILES)
def test_a_program_projects_the_same(tmp_path, name):
    """In another encoding with other line ends too; a key more is named and changes nothing."""
    text, wanted = FILES[name]
    encoded = text.replace(' encoding="UTF-8"', "").replace("\n", "\r\n").encode("utf-16")
    with pytest.warns(InputNote, match="operator_42"):
        longer = read(tmp_path, with_key(text, "operator_42", "7"))
    lens = read(tmp_path, text)
    for each in (lens, longer, read(tmp_path, encoded)):
        np.testing.assert_allclose(project(each), wanted, atol=1e-9)
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
        zero = project(read(tmp_path, with_key(text, key, "0")))
        np.testing.assert_allclose(zero, wanted, atol=1e-9)
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


REFUSED = {
    "inverse": (
        OST.format(model="distortion_model: inverse_brown_conrady", values=D4),
        "E-CAMERA-MODEL … inverse_brown_conrady … another formula … calibrate",
    ),
    "binning": (
        CAMERA_INFO.format(model="none", values=[], **ROS1).replace("binning_x: 0", "binning_x: 2"),
        "E-CAMERA-KEY … binning_x = 2 … set it to 0 … calibrate",
    ),
    "a region": (
        CAMERA_INFO.format(model="none", values=[], **ROS1).replace("x_offset: 0", "x_offset: 320"),
        "E-CAMERA-KEY … roi.x_offset = 320",
    ),
    "two words": (
        OST.format(model="camera_model: fisheye\ndistortion_model: plumb_bob", values=K4),
        "E-CAMERA-MODEL … says",
    ),
    "two sizes": (OST.format(model="resolution: [720, 1280]", values=D4), "E-CAMERA-SIZE … 720×1280 px … 1280×720 px"),
    "two matrices": (OST.format(model=f"K: {EYE}", values=D4), "E-CAMERA-REPEATED … K"),
    "size of a shape": (f"K: {FLAT}\nimage_size: [720, 1280]\n", "E-CAMERA-SIZE … 720×1280 px … width first"),
    "a fisheye without a model": (f"K: {FLAT}\nD: {K4}\n", "E-CAMERA-MODEL … D … -0.0248 … equidistant"),
    "a lens in mm": (f"K: [16, 0, 640, 0, 16, 360, 0, 0, 1]\nimage_size: {list(SIZE)}\n", "E-CAMERA-FOCAL … 16 … mm"),
    "a lens in mm without a size": ("K: [16, 0, 640, 0, 16, 360, 0, 0, 1]\n", "E-CAMERA-FOCAL … 16 … mm"),
    "shares of a side": ("K: [0.75, 0, 0.51, 0, 0.76, 0.49, 0, 0, 1]\n", "E-CAMERA-FOCAL … 0.75 … shares"),
    "a centre from the middle": (
        f"image_size: {list(SIZE)}\nK: [911.5, 0, -3.2, 0, 910, 7.5, 0, 0, 1]\n",
        "E-CAMERA-CENTRE … -3.2 … middle",
    ),
    "YAML key twice": (f"K: {FLAT}\nD: {D4}\nD: {D5}\n", "E-CAMERA-UNREADABLE … D twice"),
    "JSON key twice": ('{"K": [1, 0, 1, 0, 1, 1, 0, 0, 1], "K": 5}', "E-CAMERA-UNREADABLE … K twice"),
    "documents that differ": (
        CAMERA_INFO.format(model="none", values=[], **ROS1)
        + "---\n"
        + CAMERA_INFO.format(model="none", values=D4, **ROS1),
        "E-CAMERA-UNREADABLE … 2 documents",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_told_is_named_in_one_line(tmp_path, name):
    text, said = REFUSED[name]
    with fails_with(said) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


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


@pytest.mark.parametrize("key", ["kc", "dist_vec", "calib_dist", "rect_distortion", "D_vec", "lens", "num_dist"])
def test_coefficients_under_any_name_are_refused(tmp_path, key):
    refuses(f"E-CAMERA-KEY … {key} … distortion_coefficients", read, tmp_path, f"camera_matrix: {FLAT}\n{key}: {D5}\n")


@pytest.mark.parametrize("other", ["turn: [0.5, 0.5, 0.5, 0.5]", "window: [0, 0, 1280, 720]", "tvec: [0.1, 2, 3, 4.5]"])
def test_lists_that_are_no_coefficients_pass(tmp_path, other):
    lens = read(tmp_path, f"camera_matrix: {FLAT}\ndist: {D5}\n{other}\n")
    np.testing.assert_allclose(project(lens), perspective(D5), atol=1e-9)
    lens = read(tmp_path, f"camera_matrix: {FLAT}\n{other}\n")
    np.testing.assert_allclose(project(lens), perspective([0.0] * 5), atol=1e-9)


@pytest.mark.parametrize(("more", "named"), [("", "equidistant"), ("42: 7\n", "42")])
def test_four_coefficients_without_a_model_and_a_key_that_is_a_number_are_named(tmp_path, more, named):
    with pytest.warns(InputNote, match=named):
        lens = read(tmp_path, f"K: {FLAT}\nD: {D4}\n{more}")
    np.testing.assert_allclose(project(lens), perspective(D4), atol=1e-9)


def test_the_essential_matrices_of_a_pair_are_no_cameras(tmp_path):
    path = tmp_path / "stereo.yml"
    path.write_text(f"K1: {FLAT}\nD1: {D5}\nK2: {EYE}\nD2: {D4}\nR: {EYE}\nE: {FLAT}\nF: {FLAT}\n")
    refuses("E-CAMERA-SEVERAL … 2 cameras … 1, 2", read_lens, path)
    np.testing.assert_allclose(project(read_lens(path, "1")), perspective(D5), atol=1e-9)


def test_an_inverse_model_of_zeros_has_no_distortion(tmp_path):
    lens = read(tmp_path, OST.format(model="distortion_model: inverse_brown_conrady", values=[0.0] * 5))
    np.testing.assert_allclose(project(lens), perspective([0.0] * 4), atol=1e-9)


def test_a_camera_of_a_pair_is_chosen(tmp_path):
    other = [800.0, 0, 630.0, 0, 801.0, 350.0, 0, 0, 1]
    path = tmp_path / "intrinsics.yml"
    for first, second in (("M1", "M2"), ("camera_matrix_left", "camera_matrix_right")):
        d = {"M1": ("D1", "D2")}.get(first, ("dist_coeffs_left", "dist_coeffs_right"))
        path.write_text(f"{first}: {FLAT}\n{d[0]}: {D5}\n{second}: {other}\n{d[1]}: {D4}\nR: {EYE}\nT: [1, 0, 0]\n")
        refuses("E-CAMERA-SEVERAL … 2 cameras … --camera-name", read_lens, path)
        names = ("1", "2") if first == "M1" else ("left", "right")
        np.testing.assert_allclose(project(read_lens(path, names[0])), perspective(D5), atol=1e-9)
        wanted = perspective(D4, (800.0, 801.0, 630.0, 350.0))
        np.testing.assert_allclose(project(read_lens(path, names[1])), wanted, atol=1e-9)
        with camera_chosen(names[1]):
            np.testing.assert_allclose(project(read_camera(path)), wanted, atol=1e-9)


def test_metashapes_p3_and_p4_are_taken(tmp_path):
    text = METASHAPE.replace("<date>", "<p3>0.85</p3>\n<p4>-0.44</p4>\n<k4>0.02</k4>\n<b2>0.6</b2>\n<date>")
    lens = read(tmp_path, text)
    assert isinstance(lens, ForeignLens)
    k, p = (-0.2, 0.05, 0.01, 0.02), (-0.0005, 0.001)
    wanted = metashape(RAYS[:, :2], 910.25, (1.25, 0.6), k, p, (0.85, -0.44))
    np.testing.assert_allclose(lens.project(RAYS), wanted, atol=1e-9)


def test_a_chosen_name_becomes_one_to_write():
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
    np.testing.assert_allclose(project(lens), wanted, atol=1e-9)


def test_a_database_without_its_log_is_named(tmp_path):
    path = tmp_path / "database.db"
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("CREATE TABLE cameras (camera_id, model, width, height, params)")
    database.commit()
    copy = tmp_path / "copy.db"
    copy.write_bytes(path.read_bytes())
    database.close()
    refuses("E-CAMERA-UNREADABLE … copy.db-wal … copy both", read_lens, copy)
    assert sorted(each.name for each in tmp_path.iterdir() if each.name.startswith("copy")) == ["copy.db"]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_pair_in_ros_ini_is_chosen(tmp_path, side):
    head, _, own = INI.partition("[narrow_stereo]")
    other = own.replace("911.5", "912.5")
    (tmp_path / "ost.txt").write_text(f"{head}[narrow_stereo/left]{own}[narrow_stereo/right]{other}")
    wanted = perspective(D5, (911.5 + (side == "right"), 910.25, 639.0, 359.0))
    np.testing.assert_allclose(project(read_lens(tmp_path / "ost.txt", f"narrow_stereo/{side}")), wanted, atol=1e-9)
