"""Camera files as other programs write them, and the pixels of :data:`RAYS` by OpenCV or by the programs' formulas."""

import json

import cv2
import numpy as np

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

NODE = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: {}\n"
FULL_K, FULL_D, FULL_K4 = NODE.format(3, 3, FLAT), NODE.format(1, 5, D5), NODE.format(1, 4, K4)
NESTED = matrix().tolist()
XI, ALPHA = -0.2, 0.57


def double_sphere() -> np.ndarray:
    """V. Usenko et al., "The double sphere camera model", 3DV 2018, equations 40 to 42."""
    x, y, z = RAYS.T
    one = np.linalg.norm(RAYS, axis=1)
    two = np.sqrt(x**2 + y**2 + (XI * one + z) ** 2)
    below = ALPHA * two + (1 - ALPHA) * (XI * one + z)
    return np.column_stack([LENS[0] * x / below + LENS[2], LENS[1] * y / below + LENS[3]])


def extended_unified() -> np.ndarray:
    """B. Khomutenko et al., "An enhanced unified camera model", RA-L 2016, with β = 1."""
    x, y, z = RAYS.T
    below = ALPHA * np.linalg.norm(RAYS, axis=1) + (1 - ALPHA) * z
    return np.column_stack([LENS[0] * x / below + LENS[2], LENS[1] * y / below + LENS[3]])


def basalt(kind: str, **more: float) -> str:
    lens = dict(zip(("fx", "fy", "cx", "cy"), LENS, strict=True)) | more
    camera = {"camera_type": kind, "intrinsics": lens}
    return json.dumps({"value0": {"intrinsics": [camera], "resolution": [SIZE], "imu_update_rate": 200.0}}, indent=1)


FILES |= {
    "Basalt, kb4": (basalt("kb4", **{f"k{i + 1}": k for i, k in enumerate(K4)}), equidistant(K4)),
    "Basalt, ds": (basalt("ds", xi=XI, alpha=ALPHA), double_sphere()),
    "Basalt, ucm": (basalt("ucm", alpha=ALPHA), extended_unified()),
    "Basalt, radtan8": (
        basalt("pinhole-radtan8", k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4, k3=0.01, k4=0.02, k5=-0.01, k6=0.003),
        perspective([*D5, 0.02, -0.01, 0.003]),
    ),
    "aslam, SVO": (
        "cameras:\n- camera:\n    distortion:\n      parameters: {cols: 1, rows: 4, data: "
        f"{K4}}}\n      type: equidistant\n    image_height: 720\n    image_width: 1280\n"
        f"    intrinsics: {{cols: 1, rows: 4, data: {list(LENS)}}}\n    label: cam0\n    type: pinhole\n",
        equidistant(K4),
    ),
    "OKVIS": (
        "%YAML:1.0\ncameras:\n     - {image_dimension: [1280, 720], distortion_coefficients: "
        f"{D4}, distortion_type: radialtangential,\n        focal_length: {list(LENS[:2])}, principal_point: "
        f"{list(LENS[2:])}}}\n",
        perspective(D4),
    ),
    "DepthAI": (
        json.dumps(
            {
                "boardName": "A",
                "cameraData": [
                    [
                        0,
                        {
                            "cameraType": 0,
                            "distortionCoeff": [*D5, *[0.0] * 9],
                            "height": 720,
                            "intrinsicMatrix": NESTED,
                            "lensPosition": 130,
                            "specHfovDeg": 68.8,
                            "width": 1280,
                        },
                    ]
                ],
            }
        ),
        perspective(D5),
    ),
    "MC-Calib": (
        "%YAML:1.0\n---\nnb_camera: 1\ncamera_0:\n"
        + "".join(f"   {line}\n" for line in f"camera_matrix: {FULL_K}distortion_vector: {FULL_K4}".splitlines())
        + "   distortion_type: 1\n   camera_group: 0\n   img_width: 1280\n   img_height: 720\n",
        equidistant(K4),
    ),
    "multical": (
        json.dumps({"cameras": {"a": {"model": "standard", "image_size": SIZE, "K": NESTED, "dist": [D5]}}}),
        perspective(D5),
    ),
    "Anipose": (
        f'[cam_0]\nname = "A"\nsize = [ 1280, 720,]\nmatrix = {NESTED}\ndistortions = {D5}\nerror = 0.5\n',
        perspective(D5),
    ),
    "Gyroflow": (
        json.dumps(
            {
                "name": "A",
                "camera_model": "HERO",
                "lens_model": "",
                "calibrator_version": "1.0",
                "calib_dimension": {"w": 1280, "h": 720},
                "output_dimension": {"w": 1280, "h": 640},
                "fisheye_params": {"RMS_error": 1.0, "camera_matrix": NESTED, "distortion_coeffs": K4},
            }
        ),
        equidistant(K4),
    ),
    "Open3D": (
        json.dumps({"width": 1280, "height": 720, "intrinsic_matrix": matrix().T.ravel().tolist()}),
        perspective([0.0] * 4),
    ),
    "RealSense": (
        json.dumps(
            dict(zip(("fx", "fy", "ppx", "ppy"), LENS, strict=True))
            | {"width": 1280, "height": 720, "model": "distortion.brown_conrady", "coeffs": D5, "depth_scale": 0.001}
        ),
        perspective(D5),
    ),
    "instant-ngp": (
        NERF.format(model="OPENCV", k='"sk_x": 0.0, "sk_y": 0.0, "is_fisheye": false, "k1": -0.2, "k2": 0.05'),
        perspective([-0.2, 0.05, 0, 0]),
    ),
    "ZED": (
        "[LEFT_CAM_HD]\nfx=911.5\nfy=910.25\ncx=639.0\ncy=359.0\nk1=-0.2\nk2=0.05\nk3=0.01\np1=0.001\np2=-0.0005\n",
        perspective(D5),
    ),
    "a nested size": (
        json.dumps(
            {
                "resolution": {"width": 1280, "height": 720},
                "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), LENS, strict=True)),
                "distortion_model": "plumb_bob",
                "distortion_coefficients": D5,
            }
        ),
        perspective(D5),
    ),
    "a matrix as intrinsics": (
        json.dumps({"intrinsics": NESTED, "distortion": D5, "image_size": SIZE}),
        perspective(D5),
    ),
}
"""Those of further programs."""
MVG = {"focal_length": 911.5, "height": 720, "principal_point": list(LENS[2:]), "width": 1280}
SQUARE_LENS = (911.5, 911.5, 639.0, 359.0)


def openmvg(kind: str, data: dict) -> str:
    value = {"polymorphic_id": 1, "polymorphic_name": kind, "ptr_wrapper": {"id": 2, "data": data}}
    return json.dumps({"sfm_data_version": "0.3", "intrinsics": [{"key": 0, "value": value}], "views": []})


def node(values: list, rows: int) -> dict:
    return {"rows": rows, "cols": len(values) // rows, "type": 6, "data": values}


PHOTON = {"resolution": {"width": 1280.0, "height": 720.0}, "cameraIntrinsics": node(FLAT, 3)}
FILES |= {
    "OpenMVG, k3": (
        openmvg("pinhole_radial_k3", MVG | {"disto_k3": [-0.2, 0.05, 0.01]}),
        perspective([-0.2, 0.05, 0, 0, 0.01], SQUARE_LENS),
    ),
    "OpenMVG, brown": (
        openmvg("pinhole_brown_t2", {"value0": MVG, "disto_t2": [-0.2, 0.05, 0.01, 1e-3, -5e-4]}),
        perspective(D5, SQUARE_LENS),
    ),
    "OpenMVG, fisheye": (openmvg("fisheye", {"value0": MVG, "fisheye": K4}), equidistant(K4, SQUARE_LENS)),
    "OpenSfM, reconstruction": (
        "["
        + OPENSFM.format(kind="brown", k='"k1": -0.2, "k2": 0.05, "k3": 0.01, "p1": 0.001, "p2": -0.0005').replace(
            '{"v2', '{"cameras": {"v2', 1
        )
        + ', "shots": {}}]',
        perspective(D5, OPENSFM_LENS),
    ),
    "PhotonVision": (
        json.dumps(
            PHOTON
            | {"distCoeffs": node(D5, 1), "lensmodel": "LENSMODEL_OPENCV", "calobjectSpacing": 0.025}
            | {"calobjectWarp": [0.1, 0.2], "observations": []}
        ),
        perspective(D5),
    ),
    "PhotonVision 2023": (json.dumps(PHOTON | {"cameraExtrinsics": node(D5, 1)}), perspective(D5)),
    "camodocal, full": (
        VINS.format(
            model="PINHOLE_FULL",
            parameters=CAMODOCAL["PINHOLE"].replace(
                "   p1", "   k3: 0.01\n   k4: 0.02\n   k5: -0.01\n   k6: 0.003\n   p1"
            ),
        ),
        perspective([*D5, 0.02, -0.01, 0.003]),
    ),
    "ORB-SLAM, rectified": (ORB.format(kind="Rectified", distortion=""), perspective([0.0] * 4)),
    "rpg_vikit": (
        "cam_model: Pinhole\ncam_width: 1280\ncam_height: 720\nscale: 1.0\ncam_fx: 911.5\ncam_fy: 910.25\n"
        "cam_cx: 639.0\n"
        "cam_cy: 359.0\ncam_d0: -0.2\ncam_d1: 0.05\ncam_d2: 0.001\ncam_d3: -0.0005\n",
        perspective(D4),
    ),
    "R3LIVE": (
        f"r3live_vio:\n   image_width: 1280\n   image_height: 720\n   camera_intrinsic:\n      {FLAT}\n"
        f"   camera_dist_coeffs: {D5}\n",
        perspective(D5),
    ),
    "BOP": (
        json.dumps({str(i): {"cam_K": FLAT, "depth_scale": 1.0, "width": 1280, "height": 720} for i in range(4)}),
        perspective([0.0] * 4),
    ),
    "rs-enumerate-devices": (
        ' Intrinsic of "Color" / 1280x720 / {YUYV/RGB8}:\n  Width:      \t1280\n  Height:     \t720\n'
        "  PPX:        \t639.0\n  PPY:        \t359.0\n  Fx:         \t911.5\n  Fy:         \t910.25\n"
        "  Distortion: \tBrown Conrady\n  Coeffs:     \t-0.2  \t0.05  \t0.001  \t-0.0005  \t0.01  \n",
        perspective(D5),
    ),
    "VSLAM-LAB": (
        "cameras:\n  - cam_name: rgb_0\n    cam_type: gray\n    cam_model: pinhole\n    focal_length: [911.5, 910.25]\n"
        "    principal_point: [639.0, 359.0]\n    distortion_type: equid4\n"
        f"    distortion_coefficients: {K4}\n    image_dimension: [1280, 720]\n    fps: 20.0\n",
        equidistant(K4),
    ),
    "a list of nested cameras": (
        json.dumps(
            {
                "cameras": [
                    {
                        "camera_id": "00",
                        "intrinsics": {"resolution": SIZE, "camera_matrix": FLAT, "distortion_coefficients": D5},
                        "extrinsics": {"view_matrix": EYE},
                    }
                ]
            }
        ),
        perspective(D5),
    ),
    "calibdb": (
        json.dumps(
            {"camera_matrix": NESTED, "distortion_coefficients": D5, "distortion_model": "rectilinear"}
            | {"img_size": SIZE, "type": "camera"}
        ),
        perspective(D5),
    ),
}
"""Those of programs whose names for cameras and coefficients differ further."""
