"""Camera files of other programs: their projections by OpenCV or by the programs' formulas, and the rule for keys."""

import json
import re
import sqlite3
import struct
import warnings

import cv2
import numpy as np
import pycolmap
import pytest

from stcal.errors import InputError, InputNote
from stcal.io.cameras.foreign import ForeignLens
from stcal.io.cameras.forms import name_to_write
from stcal.io.cameras.model import CameraModel
from stcal.io.cameras.read import camera_chosen, read_camera, read_lens
from tests.outcome import fails_with

RAYS = np.column_stack([np.random.default_rng(4).uniform(-0.6, 0.6, (40, 2)), np.ones(40)])
D4, D5 = [-0.2, 0.05, 1e-3, -5e-4], [-0.2, 0.05, 1e-3, -5e-4, 0.01]
K4 = [-0.0152, 0.0132, -0.0248, 0.0178]
LENS = (911.5, 910.25, 639.0, 359.0)
SIZE = (1280, 720)


def matrix(lens=LENS, skew: float = 0.0) -> np.ndarray:
    return np.array([[lens[0], skew, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])


def perspective(k, lens=LENS, skew: float = 0.0) -> np.ndarray:
    """OpenCV's projection; it has no skew, which is added to its normalised coordinates."""
    xy = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), np.eye(3), np.array(k, float))[0].reshape(-1, 2)
    return (np.column_stack([xy, np.ones(len(xy))]) @ matrix(lens, skew).T)[:, :2]


def equidistant(k, lens=LENS) -> np.ndarray:
    none = np.zeros((1, 1, 3))
    return cv2.fisheye.projectPoints(RAYS[:, None], none, none, matrix(lens), np.array(k, float))[0].reshape(-1, 2)


def unified(xi: float, k, lens=LENS, skew: float = 0.0) -> np.ndarray:
    """C. Mei, P. Rives, ICRA 2007: the point of the unit sphere is projected from ξ below its middle."""
    unit = RAYS / np.linalg.norm(RAYS, axis=1)[:, None]
    flat = np.column_stack([unit[:, :2] / (unit[:, 2:] + xi), np.ones(len(unit))])
    xy = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), np.eye(3), np.array(k, float))[0].reshape(-1, 2)
    return (np.column_stack([xy, np.ones(len(xy))]) @ matrix(lens, skew).T)[:, :2]


NEW_NAMES = ("camera_matrix", "distortion_coefficients", "image_width", "image_height")


def storage(more: str = "", k: str = "911.5 0. 639. 0. 910.25 359. 0. 0. 1.", d=D5, names=()) -> str:
    key, coefficients, width, height = names or (
        "camera_matrix",
        "distortion_coefficients",
        "image_width",
        "image_height",
    )
    node = '<{0} type_id="opencv-matrix"><rows>{1}</rows><cols>{2}</cols><dt>d</dt><data>\n {3}</data></{0}>'
    return (
        f'<?xml version="1.0"?>\n<opencv_storage>\n<{width}>1280</{width}>\n<{height}>720</{height}>\n'
        f"{node.format(key, 3, 3, k)}\n{node.format(coefficients, 1, len(d), ' '.join(map(repr, d)))}\n{more}\n"
        "</opencv_storage>\n"
    )


FLAT = [911.5, 0.0, 639.0, 0.0, 910.25, 359.0, 0.0, 0.0, 1.0]
EYE, P = [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], [911.5, 0, 639.0, 0, 0, 910.25, 359.0, 0, 0, 0, 1.0, 0]
ROI = "roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}\n"
CAMERA_INFO = (
    "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\nheight: 720\nwidth: 1280\n"
    f"distortion_model: {{model}}\n{{d}}: {{values}}\n{{k}}: {FLAT}\n{{r}}: {EYE}\n{{p}}: {P}\n"
    f"binning_x: 0\nbinning_y: 0\n{ROI}"
)
ROS1, ROS2 = {"d": "D", "k": "K", "r": "R", "p": "P"}, {"d": "d", "k": "k", "r": "r", "p": "p"}
OST = (
    "image_width: 1280\nimage_height: 720\ncamera_name: cam_a\n"
    f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {FLAT}\n{{model}}\n"
    "distortion_coefficients:\n  rows: 1\n  cols: 4\n  data: {values}\n"
)
INI = (
    "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n1280\n\nheight\n720\n\n[narrow_stereo]\n\ncamera matrix\n"
    "911.5 0.0 639.0\n0.0 910.25 359.0\n0.0 0.0 1.0\n\ndistortion\n-0.2 0.05 0.001 -0.0005 0.01\n\nrectification\n"
    "1.0 0.0 0.0\n0.0 1.0 0.0\n0.0 0.0 1.0\n\nprojection\n911.5 0 639 0\n0 910.25 359 0\n0 0 1 0\n"
)
EUROC = (
    "sensor_type: camera\ncomment: VI-Sensor cam0\nT_BS:\n  cols: 4\n  rows: 4\n"
    "  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\nrate_hz: 20\nresolution: [1280, 720]\n"
    f"camera_model: pinhole\nintrinsics: {list(LENS)}\ndistortion_model: radial-tangential\n"
    f"distortion_coefficients: {D4}\n"
)
VINS = (
    '%YAML:1.0\n\nimu_topic: "/imu0"\nmodel_type: {model}\ncamera_name: camera\nimage_width: 1280\nimage_height: 720\n'
    "{parameters}\nacc_n: 0.08\nestimate_extrinsic: 0\n"
)
CAMODOCAL = {
    "PINHOLE": "distortion_parameters:\n   k1: -0.2\n   k2: 0.05\n   p1: 0.001\n   p2: -0.0005\n"
    "projection_parameters:\n   fx: 911.5\n   fy: 910.25\n   cx: 639.0\n   cy: 359.0",
    "MEI": "mirror_parameters:\n   xi: 1.21\ndistortion_parameters:\n   k1: -0.2\n   k2: 0.05\n   p1: 0.001\n"
    "   p2: -0.0005\nprojection_parameters:\n   gamma1: 911.5\n   gamma2: 910.25\n   u0: 639.0\n   v0: 359.0",
    "KANNALA_BRANDT": f"projection_parameters:\n   k2: {K4[0]}\n   k3: {K4[1]}\n   k4: {K4[2]}\n   k5: {K4[3]}\n"
    "   mu: 911.5\n   mv: 910.25\n   u0: 639.0\n   v0: 359.0",
}
ORB = (
    '%YAML:1.0\n\nCamera.type: "{kind}"\nCamera.fx: 911.5\nCamera.fy: 910.25\nCamera.cx: 639.0\nCamera.cy: 359.0\n'
    "{distortion}Camera.width: 1280\nCamera.height: 720\nCamera.fps: 20.0\nCamera.RGB: 1\nCamera.bf: 47.9\n"
    "ThDepth: 35.0\nORBextractor.nFeatures: 1200\nORBextractor.scaleFactor: 1.2\nViewer.ViewpointF: 500.0\n"
)
NERF = (
    '{{"camera_model": "{model}", "fl_x": 911.5, "fl_y": 910.25, "cx": 639.5, "cy": 359.5, "w": 1280, "h": 720,\n'
    ' {k}, "camera_angle_x": 1.22, "frames": [{{"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0]]}}]}}'
)
BOUGUET = (
    "% Intrinsic and Extrinsic Camera Parameters\n%-- Focal length:\nfc = [ 911.5 ; 910.25 ];\n"
    "%-- Principal point:\ncc = [ 639.0 ; 359.0 ];\nalpha_c = {alpha};\n%-- Distortion coefficients:\n"
    "kc = [ -0.2 ; 0.05 ; 0.001 ; -0.0005 ; 0.01 ];\nfc_error = [ 0.3463 ; 0.3704 ];\nnx = 1280;\nny = 720;\n"
    "n_ima = 1;\nomc_1 = [ 1.0 ; 2.0 ; 3.0 ];\n"
)
KITTI = (
    "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\nS_00: 1.280000e+03 7.200000e+02\n"
    f"K_00: {' '.join(map(str, FLAT))}\nD_00: {' '.join(map(str, D5))}\n"
    "R_00: 1 0 0 0 1 0 0 0 1\nT_00: 0 0 0\nS_rect_00: 1.242e+03 3.75e+02\nP_rect_00: 7 0 6 0 0 7 1 0 0 0 1 0\n"
)
METASHAPE = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>frame</projection>\n  <width>1280</width>\n'
    "  <height>720</height>\n  <f>910.25</f>\n  <cx>-0.5</cx>\n  <cy>-0.5</cy>\n  <b1>1.25</b1>\n  <k1>-0.2</k1>\n"
    "  <k2>0.05</k2>\n  <k3>0.01</k3>\n  <p1>-0.0005</p1>\n  <p2>0.001</p2>\n  <date>2020-01-01T00:00:00Z</date>\n"
    "</calibration>\n"
)
OPENSFM = (
    '{{"v2 sony 1280 720": {{"projection_type": "{kind}", "width": 1280, "height": 720, "focal_x": 0.75, '
    '"focal_y": 0.7, "c_x": 0.01, "c_y": -0.02, {k}}}}}'
)
OPENSFM_LENS = (960.0, 896.0, 639.5 + 12.8, 359.5 - 25.6)
CHAIN = (
    "cam0:\n  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.0]\n  cam_overlaps: [1]\n  camera_model: pinhole\n"
    f"  distortion_coeffs: {D4}\n  distortion_model: radtan\n  intrinsics: {list(LENS)}\n  resolution: [1280, 720]\n"
    "  rostopic: /cam0/image_raw\n"
)
MRCAL = (
    "{\n    'lensmodel': 'LENSMODEL_OPENCV5',\n    'intrinsics': [ 911.5, 910.25, 639, 359, -0.2, 0.05, 0.001, "
    "-0.0005, 0.01 ],\n    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n    'imagersize': [ 1280, 720 ],\n}\n"
)
ZIVID = (
    "__version__: 1\nCameraMatrix: {FX: 911.5, FY: 910.25, CX: 639.0, CY: 359.0}\n"
    "Distortion: {K1: -0.2, K2: 0.05, K3: 0.01, P1: 0.001, P2: -0.0005}\n"
)
MESHROOM = (
    '{{"version": ["1", "2", "1"], "views": [], "intrinsics": [{{"intrinsicId": "42", "width": "1280", '
    '"height": "720", "sensorWidth": "25.6", "serialNumber": "1", "type": "{kind}", {focal}, "scaleLocked": "false", '
    '"principalPoint": ["{x}", "{y}"], "distortionParams": [{k}], "locked": "false"}}]}}'
)
OLD_NAMES = ("Camera_Matrix", "Distortion_Coefficients", "image_Width", "image_Height")
SKEWED = "911.5 0.7 639. 0. 910.25 359. 0. 0. 1."

FILES = {
    "OpenCV": (storage(), perspective(D5)),
    "OpenCV, fisheye": (storage("<fisheye_model>1</fisheye_model>", d=K4), equidistant(K4)),
    "OpenCV, not fisheye": (storage("<fisheye_model>0</fisheye_model>", d=D4), perspective(D4)),
    "OpenCV, omnidir": (storage("<xi>1.21</xi>", SKEWED, d=D4), unified(1.21, D4, skew=0.7)),
    "OpenCV, old names": (storage(names=OLD_NAMES), perspective(D5)),
    "OpenCV, skew": (storage(k=SKEWED), perspective(D5, skew=0.7)),
    "OpenCV, JSON with tabs": (
        f'{{\n\t"camera_matrix": {matrix().tolist()},\n\t"dist_coeffs": [{D5}],\n\t"image_size": [1280, 720]\n}}\n',
        perspective(D5),
    ),
    "ROS 1": (CAMERA_INFO.format(model="equidistant", values=K4, **ROS1) + "---\n", equidistant(K4)),
    "ROS 2": (CAMERA_INFO.format(model="plumb_bob", values=D5, **ROS2), perspective(D5)),
    "ROS, none": (CAMERA_INFO.format(model="none", values=[], **ROS1), perspective([0.0] * 4)),
    "ROS, six": (CAMERA_INFO.format(model="plumb_bob", values=[*D4, 0.01, 0.0], **ROS1), perspective(D5)),
    "ROS, camera_model": (OST.format(model="camera_model: fisheye", values=K4), equidistant(K4)),
    "ROS, ini": (INI, perspective(D5)),
    "EuRoC": (EUROC, perspective(D4)),
    "camodocal": (VINS.format(model="PINHOLE", parameters=CAMODOCAL["PINHOLE"]), perspective(D4)),
    "camodocal, MEI": (VINS.format(model="MEI", parameters=CAMODOCAL["MEI"]), unified(1.21, D4)),
    "camodocal, KB": (VINS.format(model="KANNALA_BRANDT", parameters=CAMODOCAL["KANNALA_BRANDT"]), equidistant(K4)),
    "ORB-SLAM": (
        ORB.format(
            kind="PinHole", distortion="Camera.k1: -0.2\nCamera.k2: 0.05\nCamera.p1: 0.001\nCamera.p2: -0.0005\n"
        ),
        perspective(D4),
    ),
    "ORB-SLAM, KB": (
        ORB.format(kind="KannalaBrandt8", distortion="".join(f"Camera.k{i + 1}: {k}\n" for i, k in enumerate(K4))),
        equidistant(K4),
    ),
    "Nerfstudio": (
        NERF.format(model="OPENCV", k='"k1": -0.2, "k2": 0.05, "k3": 0.0, "k4": 0.0, "p1": 0.001, "p2": -0.0005'),
        perspective(D4),
    ),
    "Nerfstudio, fisheye": (
        NERF.format(model="OPENCV_FISHEYE", k=", ".join(f'"k{i + 1}": {k}' for i, k in enumerate(K4))),
        equidistant(K4),
    ),
    "Bouguet": (BOUGUET.format(alpha=0), perspective(D5)),
    "Bouguet, skew": (BOUGUET.format(alpha=0.7 / 911.5), perspective(D5, skew=0.7)),
    "KITTI": (KITTI, perspective(D5)),
    "Metashape": (METASHAPE, perspective(D5)),
    "OpenSfM": (
        OPENSFM.format(kind="brown", k='"k1": -0.2, "k2": 0.05, "k3": 0.01, "p1": 0.001, "p2": -0.0005'),
        perspective(D5, OPENSFM_LENS),
    ),
    "OpenSfM, fisheye": (
        OPENSFM.format(kind="fisheye", k='"k1": 0.02, "k2": -0.01'),
        equidistant([0.02, -0.01, 0, 0], OPENSFM_LENS),
    ),
    "Kalibr": (CHAIN, perspective(D4)),
    "mrcal": (MRCAL, perspective(D5)),
    "Zivid": (ZIVID, perspective(D5)),
    "stella_vslam": (
        "Camera:\n  name: cam\n  setup: monocular\n  model: perspective\n  fx: 911.5\n  fy: 910.25\n  cx: 639.0\n"
        "  cy: 359.0\n  k1: -0.2\n  k2: 0.05\n  p1: 0.001\n  p2: -0.0005\n  k3: 0.01\n  fps: 30.0\n  cols: 1280\n"
        "  rows: 720\n  color_order: RGB\n",
        perspective(D5),
    ),
    "Meshroom, px": (
        MESHROOM.format(
            kind="brown", focal='"pxFocalLength": "911.5"', x=639, y=359, k='"-0.2","0.05","0.01","0.001","-0.0005"'
        ),
        perspective(D5, (911.5, 911.5, 639.0, 359.0)),
    ),
    "Meshroom, mm": (
        MESHROOM.format(kind="radial3", focal='"focalLength": "18.23"', x=-1, y=-1, k='"-0.2","0.05","0.01"'),
        perspective([-0.2, 0.05, 0, 0, 0.01], (911.5, 911.5, 639.0, 359.0)),
    ),
    "Meshroom, fisheye": (
        MESHROOM.format(kind="fisheye4", focal='"focalLength": "18.23"', x=-1, y=-1, k=",".join(f'"{k}"' for k in K4)),
        equidistant(K4, (911.5, 911.5, 639.0, 359.0)),
    ),
}
"""A file of each program, and the pixels of RAYS."""
XML = [name for name, (text, _) in FILES.items() if text.lstrip().startswith("<")]


def read(tmp_path, content: str | bytes):
    path = tmp_path / "camera"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_lens(path)


def project(lens: CameraModel | ForeignLens) -> np.ndarray:
    return lens.project(RAYS) if isinstance(lens, ForeignLens) else lens.sized(*SIZE).project(RAYS)


@pytest.mark.parametrize("name", FILES)
def test_a_program_projects_the_same(tmp_path, name):
    text, wanted = FILES[name]
    lens = read(tmp_path, text)
    np.testing.assert_allclose(project(lens), wanted, atol=1e-9)
    assert (lens.width, lens.height) in (SIZE, (None, None))
    assert lens.width or name == "Zivid"  # its file has no size


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("form", ["bom", "utf-16", "crlf", "cr", "blank lines"])
def test_another_encoding_or_line_end_changes_nothing(tmp_path, name, form):
    text, wanted = FILES[name]
    if form == "utf-16" and name in XML:
        text = text.replace(' encoding="UTF-8"', "")
    made = {
        "bom": b"\xef\xbb\xbf" + text.encode(),
        "utf-16": text.encode("utf-16"),
        "crlf": text.replace("\n", "\r\n").encode(),
        "cr": text.replace("\n", "\r").encode(),
        "blank lines": f"{text}\n\n\n".encode(),
    }[form]
    np.testing.assert_allclose(project(read(tmp_path, made)), wanted, atol=1e-9)


def with_key(text: str, key: str, value: str) -> str:
    """The text with one more key beside those of the lens."""
    if text.lstrip().startswith("<"):
        at = text.rindex("</")
        return f"{text[:at]}<{key}>{value}</{key}>\n{text[at:]}"
    if text.startswith("%") and "fc = " in text:
        return f"{text}{key} = {value};\n"
    if text.startswith("{\n    'lens"):
        return text.replace("{", f"{{ '{key}': {value}, ", 1)
    if text.startswith("{"):
        at = text.rindex('"width"') if '"projection_type"' in text or "intrinsicId" in text else 1
        return f'{text[:at]}"{key}": {value}, {text[at:]}'
    if "[narrow_stereo]" in text:
        return f"{text}\n{key}\n{value}\n"
    if text.startswith(("cam0:", "Camera:")):
        return f"{text}  {key}: {value}\n"
    return text.removesuffix("---\n") + f"{key}: {value}\n"


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("key", ["operator_42", "weather"])
def test_an_unknown_key_is_named(tmp_path, name, key):
    text, wanted = FILES[name]
    with pytest.warns(InputNote, match=key):
        lens = read(tmp_path, with_key(text, key, "7"))
    np.testing.assert_allclose(project(lens), wanted, atol=1e-9)


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
        confirmed = key == "fisheye_model" and name.endswith(("KB", "fisheye", "camera_model", "ROS 1"))
        assert confirmed or np.abs(project(changed) - wanted).max() > 1
        return
    assert refused.code in ("E-CAMERA-KEY", "E-CAMERA-REPEATED", "E-CAMERA-MODEL", "E-CAMERA-COEFFICIENTS")
    assert key.split("_")[0] in str(refused)


REORDERED = {
    name: text for name, (text, _) in FILES.items() if name not in (*XML, "mrcal", "ROS, ini", "Kalibr", "stella_vslam")
}


@pytest.mark.parametrize("name", REORDERED)
def test_another_order_of_keys_changes_nothing(tmp_path, name):
    """Blocks of lines that begin with a key, the last one first; a JSON object in one line is turned by its parser."""
    text = REORDERED[name]
    if text.startswith("{"):

        def turned(value):
            return {k: turned(v) for k, v in reversed(value.items())} if isinstance(value, dict) else value

        text = json.dumps(turned(json.loads(text, strict=False)))
    else:
        head = "%YAML:1.0\n" if text.startswith("%YAML") else ""
        blocks: list[str] = []
        for line in text.removeprefix(head).removesuffix("---\n").splitlines(keepends=True):
            if line[:1] in (" ", "\n", "%") and blocks:
                blocks[-1] += line
            elif line.strip():
                blocks.append(line)
        text = head + "".join(reversed(blocks))
    np.testing.assert_allclose(project(read(tmp_path, text)), FILES[name][1], atol=1e-9)


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
    "r⁸ of Nerfstudio": (NERF.format(model="OPENCV", k='"k1": -0.2, "k4": 0.1'), "E-CAMERA-COEFFICIENTS … k4 = 0.1"),
    "Scaramuzza": (VINS.format(model="SCARAMUZZA", parameters="fx: 1"), "E-CAMERA-MODEL … SCARAMUZZA"),
    "two words": (
        OST.format(model="camera_model: fisheye\ndistortion_model: plumb_bob", values=K4),
        "E-CAMERA-MODEL … says",
    ),
    "two sizes": (
        OST.format(model="resolution: [720, 1280]", values=D4),
        "E-CAMERA-SIZE … 720×1280 px … 1280×720 px",
    ),
    "two matrices": (OST.format(model=f"K: {EYE}", values=D4), "E-CAMERA-REPEATED … K"),
    "size of a shape": (f"K: {FLAT}\nimage_size: [720, 1280]\n", "E-CAMERA-SIZE … 720×1280 px … width first"),
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


def test_an_inverse_model_of_zeros_has_no_distortion(tmp_path):
    lens = read(tmp_path, OST.format(model="distortion_model: inverse_brown_conrady", values=[0.0] * 5))
    np.testing.assert_allclose(project(lens), perspective([0.0] * 4), atol=1e-9)


def test_a_camera_of_a_pair_is_chosen(tmp_path):
    other = [800.0, 0, 630.0, 0, 801.0, 350.0, 0, 0, 1]
    path = tmp_path / "intrinsics.yml"
    for first, second in (("M1", "M2"), ("camera_matrix_left", "camera_matrix_right"), ("K_00", "K_01")):
        d = {"M1": ("D1", "D2"), "K_00": ("D_00", "D_01")}.get(first, ("dist_coeffs_left", "dist_coeffs_right"))
        path.write_text(f"{first}: {FLAT}\n{d[0]}: {D5}\n{second}: {other}\n{d[1]}: {D4}\nR: {EYE}\nT: [1, 0, 0]\n")
        with fails_with("E-CAMERA-SEVERAL … 2 cameras … --camera-name"):
            read_lens(path)
        names = {"M1": ("1", "2"), "K_00": ("00", "01")}.get(first, ("left", "right"))
        np.testing.assert_allclose(project(read_lens(path, names[0])), perspective(D5), atol=1e-9)
        wanted = perspective(D4, (800.0, 801.0, 630.0, 350.0))
        np.testing.assert_allclose(project(read_lens(path, names[1])), wanted, atol=1e-9)
        with camera_chosen(names[1]):
            np.testing.assert_allclose(project(read_camera(path)), wanted, atol=1e-9)


def test_a_camera_of_a_list_is_chosen(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [{"name": "a", "K": EYE}, {"name": "b", "K": FLAT, "D": {"k1": -0.2}}]}))
    np.testing.assert_allclose(project(read_lens(path, "b")), perspective([-0.2, 0, 0, 0]), atol=1e-9)
    path.write_text(
        ORB.format(kind="PinHole", distortion="") + f"LEFT.height: 480\nLEFT.K: {EYE}\nLEFT.D: {D4}\nRIGHT.K: {EYE}\n"
    )
    np.testing.assert_allclose(project(read_lens(path, "Camera")), perspective([0.0] * 4), atol=1e-9)
    np.testing.assert_allclose(project(read_lens(path, "LEFT")), perspective(D4, (1, 1, 0, 0)), atol=1e-9)


def test_the_camera_of_kittis_odometry_is_that_of_rectified_images(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text("P0: 911.5 0 639 0 0 910.25 359 0 0 0 1 0\nP1: 911.5 0 639 -386 0 910.25 359 0 0 0 1 0\n")
    with pytest.warns(InputNote, match="rectified"):
        lens = read_lens(path, "1")
    np.testing.assert_allclose(project(lens), perspective([0.0] * 4), atol=1e-9)


def test_metashapes_p3_and_p4_are_taken(tmp_path):
    """PhotoScan's manual, version 1.2, appendix C."""
    text = METASHAPE.replace("<date>", "<p3>0.85</p3>\n<p4>-0.44</p4>\n<k4>0.02</k4>\n<b2>0.6</b2>\n<date>")
    lens = read(tmp_path, text)
    assert isinstance(lens, ForeignLens)
    x, y = RAYS[:, 0], RAYS[:, 1]
    r2 = x**2 + y**2
    radial = 1 - 0.2 * r2 + 0.05 * r2**2 + 0.01 * r2**3 + 0.02 * r2**4
    grown = 1 + 0.85 * r2 - 0.44 * r2**2
    p1, p2 = -0.0005, 0.001
    moved_x = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * grown
    moved_y = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * grown
    u = 640 - 0.5 + moved_x * 910.25 + moved_x * 1.25 + moved_y * 0.6 - 0.5
    v = 360 - 0.5 + moved_y * 910.25 - 0.5
    np.testing.assert_allclose(lens.project(RAYS), np.column_stack([u, v]), atol=1e-9)


def test_a_chosen_name_becomes_one_to_write():
    names = {"Cam B (35mm)": "Cam_B_35mm", "2": "cam2", "a.b": "a_b", "": "cam0", "é": "cam0", "_x": "x"}
    assert {name: name_to_write(name) for name in names} == names


@pytest.mark.parametrize("count", [1, 255, 256, 300])
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
    with fails_with("E-CAMERA-UNREADABLE … copy.db-wal … copy both"):
        read_lens(copy)
    assert sorted(each.name for each in tmp_path.iterdir() if each.name.startswith("copy")) == ["copy.db"]
