"""Camera files as other programs write them, and the pixels of :data:`RAYS` by OpenCV or by the programs' formulas."""

import cv2
import numpy as np
import pycolmap

from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.foreign_lenses import ForeignLens

RAYS = np.column_stack([np.random.default_rng(4).uniform(-0.6, 0.6, (40, 2)), np.ones(40)])
D4, D5 = [-0.2, 0.05, 1e-3, -5e-4], [-0.2, 0.05, 1e-3, -5e-4, 0.01]
K4 = [-0.0152, 0.0132, -0.0248, 0.0178]
LENS = (911.5, 910.25, 639.0, 359.0)
SIZE = (1280, 720)


def project(lens: CameraModel | ForeignLens, rays=RAYS) -> np.ndarray:
    """Pixels of rays by a lens that was read; its file may state no size."""
    return lens.project(rays) if isinstance(lens, ForeignLens) else lens.sized(10_000, 10_000).project(rays)


def colmap(model: str, params: list[float], rays=RAYS, size=SIZE) -> np.ndarray:
    """Pixels of rays by pycolmap, whose pixels begin at their corner."""
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    return np.array([camera.img_from_cam(ray) for ray in rays]) - 0.5


def matrix(lens=LENS, skew: float = 0.0) -> np.ndarray:
    return np.array([[lens[0], skew, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])


def perspective(k, lens=LENS, skew: float = 0.0, rays=RAYS) -> np.ndarray:
    """OpenCV's projection; it has no skew, which is added to its normalised coordinates."""
    xy = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(k, float))[0].reshape(-1, 2)
    return (np.column_stack([xy, np.ones(len(xy))]) @ matrix(lens, skew).T)[:, :2]


def equidistant(k, lens=LENS, rays=RAYS) -> np.ndarray:
    none = np.zeros((1, 1, 3))
    return cv2.fisheye.projectPoints(rays[:, None], none, none, matrix(lens), np.array(k, float))[0].reshape(-1, 2)


def unified(xi: float, k, lens=LENS, skew: float = 0.0, rays=RAYS) -> np.ndarray:
    """C. Mei, P. Rives, ICRA 2007: the point of the unit sphere is projected from ξ below its middle."""
    unit = rays / np.linalg.norm(rays, axis=1)[:, None]
    return perspective(k, lens, skew, np.column_stack([unit[:, :2] / (unit[:, 2:] + xi), np.ones(len(unit))]))


def metashape(xy, f: float, b, k, p, grown=(0.0, 0.0), centre=LENS[2:]) -> np.ndarray:
    """Pixels of normalised coordinates: Agisoft's manual, appendix D, with the p3 and p4 of PhotoScan's, version 1.2,
    appendix C. ``b`` : b1, b2; ``grown`` : p3, p4."""
    x, y = xy.T
    r2 = x * x + y * y
    radial = 1 + sum(each * r2**i for i, each in enumerate(k, 1))
    more = 1 + grown[0] * r2 + grown[1] * r2**2
    moved_x = x * radial + (p[0] * (r2 + 2 * x * x) + 2 * p[1] * x * y) * more
    moved_y = y * radial + (p[1] * (r2 + 2 * y * y) + 2 * p[0] * x * y) * more
    return np.column_stack([centre[0] + moved_x * (f + b[0]) + moved_y * b[1], centre[1] + moved_y * f])


NEW_NAMES = ("camera_matrix", "distortion_coefficients", "image_width", "image_height")


def storage(more: str = "", k: str = "911.5 0. 639. 0. 910.25 359. 0. 0. 1.", d=D5, names=NEW_NAMES) -> str:
    key, coefficients, width, height = names
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
BOUGUET = (
    "% Intrinsic and Extrinsic Camera Parameters\n%-- Focal length:\nfc = [ 911.5 ; 910.25 ];\n"
    "%-- Principal point:\ncc = [ 639.0 ; 359.0 ];\nalpha_c = {alpha};\n%-- Distortion coefficients:\n"
    "kc = [ -0.2 ; 0.05 ; 0.001 ; -0.0005 ; 0.01 ];\nfc_error = [ 0.3463 ; 0.3704 ];\nnx = 1280;\nny = 720;\n"
    "n_ima = 1;\nomc_1 = [ 1.0 ; 2.0 ; 3.0 ];\n"
)
METASHAPE = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>frame</projection>\n  <width>1280</width>\n'
    "  <height>720</height>\n  <f>910.25</f>\n  <cx>-0.5</cx>\n  <cy>-0.5</cy>\n  <b1>1.25</b1>\n  <k1>-0.2</k1>\n"
    "  <k2>0.05</k2>\n  <k3>0.01</k3>\n  <p1>-0.0005</p1>\n  <p2>0.001</p2>\n  <date>2020-01-01T00:00:00Z</date>\n"
    "</calibration>\n"
)
CHAIN = (
    "cam0:\n  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.0]\n  cam_overlaps: [1]\n  camera_model: pinhole\n"
    f"  distortion_coeffs: {D4}\n  distortion_model: radtan\n  intrinsics: {list(LENS)}\n  resolution: [1280, 720]\n"
    "  rostopic: /cam0/image_raw\n"
)
MRCAL = (
    "# written by hand\n{\n    'lensmodel':  'LENSMODEL_OPENCV5',\n    # fx,fy,cx,cy,distortion0,distortion1,...\n"
    "    'intrinsics': [ 911.5, 910.25, 639, 359, -0.2, 0.05, 0.001, -0.0005, 0.01, ],\n"
    "    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n    'imagersize': [ 1280, 720 ],\n}\n"
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
        f'{{\n\t"cameraMatrix": {matrix().tolist()},\n\t"distCoeffs": [{D5}],\n\t"image_size": [1280, 720]\n}}\n',
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
    "camodocal, full": (
        VINS.format(
            model="PINHOLE_FULL",
            parameters=CAMODOCAL["PINHOLE"].replace(
                "   p1", "   k3: 0.01\n   k4: 0.02\n   k5: -0.01\n   k6: 0.003\n   p1"
            ),
        ),
        perspective([*D5, 0.02, -0.01, 0.003]),
    ),
    "Bouguet": (BOUGUET.format(alpha=0), perspective(D5)),
    "Bouguet, skew": (BOUGUET.format(alpha=0.7 / 911.5), perspective(D5, skew=0.7)),
    "Metashape": (METASHAPE, perspective(D5)),
    "Kalibr": (CHAIN, perspective(D4)),
    "mrcal": (MRCAL, perspective(D5)),
    "ROS-Industrial": (
        "data: []\nfinder: {type: A}\nintrinsics:\n  fx: 911.5  # px\n  fy: 910.25\n  cx: 639.0\n  cy: 359.0\n",
        perspective([]),
    ),
}
"""A file of each program, and the pixels of RAYS."""
FX = "fx: 911.5\n{0}fy: 910.25\n{0}cx: 639.0\n{0}cy: 359.0\n"
REMOVED = {
    "ORB-SLAM": f'%YAML:1.0\nCamera.type: "PinHole"\nCamera.{FX.format("Camera.")}Camera.k1: -0.2\n',
    "KITTI": f"S_00: 1280 720\nK_00: {FLAT}\nD_00: {D5}\nK_01: {FLAT}\nP_rect_00: {P}\n",
    "Zhang": "832.5 0 832.53 303.959 206.585\n\n-0.228601 0.190353\n\n1 0 0\n0 1 0\n0 0 1\n1 2 3\n",
    "a matrix alone": "911.5 0 639\n0 910.25 359\n0 0 1\n",
    "two nested cameras": f"left: {{K: {FLAT}, D: {D5}}}\nright: {{K: {FLAT}, D: {D5}}}\n",
    "RealityCapture": '<x:xmpmeta xmlns:x="adobe:ns:meta/" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"/>',
    "camodocal, SCARAMUZZA": VINS.format(model="SCARAMUZZA", parameters="fx: 1"),
}
"""Files of forms that are not read."""
