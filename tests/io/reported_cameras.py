"""Camera files that were reported (``../shared/cases``), and the pixels of RAYS by the numbers that stand in them."""

import numpy as np
import pycolmap

from tests.io import camera_files

RAYS = np.column_stack([np.random.default_rng(8).uniform(-0.5, 0.5, (40, 2)), np.ones(40)])
RATIONAL = [0.41, -2.66, 0.0006, -0.0002, 1.52, 0.29, -2.48, 1.45]
PLUMB = [-0.0306, 0.0352, -0.00013, -0.00014, -0.012, 0, 0, 0]
SAMPLES = (911.5, 910.25, 639, 359), [-0.2, 0.05, 0.001, -0.0005, 0.01]
ROS = 610.2, 610.5, 640.3, 401.7


def perspective(lens, k) -> np.ndarray:
    return camera_files.perspective(k, lens, rays=RAYS)


def equidistant(lens, k) -> np.ndarray:
    return camera_files.equidistant(k, lens, RAYS)


def metashape() -> np.ndarray:
    k, p, centre = (0.11, -0.32, 0.21), (0.0012, -0.0031), (4032 / 2 - 44.5 - 0.5, 3024 / 2 + 12.25 - 0.5)
    return camera_files.metashape(RAYS[:, :2], 3268.25, (1.5, 0), k, p, (0.85, -0.44), centre)


def colmap(model: str, size: tuple[int, int], params: list[float]) -> np.ndarray:
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    return np.array([camera.img_from_cam(ray) for ray in RAYS]) - 0.5


CASES = {
    ("stereo_yml/intrinsics.yml", "1"): lambda: perspective(*SAMPLES),
    ("stereo_yml/intrinsics.yml", "2"): lambda: perspective(*SAMPLES),
    ("metashape_p3p4/cal.xml", ""): metashape,
    ("name_choice/cameras.txt", "2"): lambda: colmap(
        "OPENCV", (1920, 1080), [1502, 1501, 960, 540, -0.1, 0.02, 0.0001, 0.0002]
    ),
    ("name_choice/cams.xml", "Cam B (35mm)"): lambda: perspective(
        (8196.7, 8196.7, 3000 + 15.4 - 0.5, 2000 + 16.1 - 0.5), [-0.04, 0.02, 0, 0]
    ),
    ("ros_coefficients/kb.yaml", ""): lambda: equidistant(ROS, [0.1, 0.1, 0, 0]),
    ("ros_coefficients/zeros5.yaml", ""): lambda: perspective(ROS, [0.0] * 4),
    ("ros_coefficients/plumb8.yaml", ""): lambda: perspective(ROS, PLUMB),
    ("ros_coefficients/rat8.yaml", ""): lambda: perspective(ROS, RATIONAL),
    ("ros_coefficients/thin12.yaml", ""): lambda: perspective(ROS, [*PLUMB, 0.0011, -0.0004, 0.0009, 0.0003]),
    ("ros_coefficients/tilt14.yaml", ""): lambda: perspective(ROS, [*PLUMB, 0, 0, 0, 0, 0.01, -0.02]),
}
"""File and name of the camera, and the pixels of RAYS; others are shown in `test_cases_as_typed`."""
