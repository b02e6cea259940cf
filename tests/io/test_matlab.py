"""Cameras of MATLAB's toolbox and of Bouguet's; against the formulas of their documents."""

import json

import numpy as np
import pytest
from scipy.io import savemat

from stcal.io.cameras.difference import fit_lens
from stcal.io.cameras.foreign_lenses import ForeignLens
from stcal.io.cameras.read import WRITERS, read_camera, read_lens
from tests.io.test_camera_forms import camera_of
from tests.outcome import refuses

STRUCTURE = {
    "RadialDistortion": [-0.28, 0.07],
    "TangentialDistortion": [1e-4, -2e-4],
    "ImageSize": [712.0, 1072.0],
    "IntrinsicMatrix": [[714.19, 0, 0], [0, 710.38, 0], [563.6481, 355.7254, 1.0]],
    "NumRadialDistortionCoefficients": 2,
}
"""Fields of ``toStruct(cameraParams)``; the matrix is turned, and counts from 1."""
RAYS = np.array([[0.0, 0, 1], [0.4, -0.2, 1], [-0.3, 0.25, 1.5]])


def matlab_px(rays: np.ndarray, own: dict, k3: float = 0.0) -> np.ndarray:
    """As the documents of ``cameraParameters`` have it, in its pixels."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    k1, k2 = own["RadialDistortion"][:2]
    p1, p2 = own["TangentialDistortion"]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([u, v, np.ones(len(u))]) @ np.array(own["IntrinsicMatrix"])[:, :2]


def saved(path, variables):
    savemat(path, variables, oned_as="row")
    return path


@pytest.mark.parametrize("form", ["struct", "json", "K", "lengths", "k3"])
def test_a_structure_projects_as_matlab_says(tmp_path, form):
    own = {key: value for key, value in STRUCTURE.items() if form not in ("K", "lengths") or key != "IntrinsicMatrix"}
    matrix, k3 = np.array(STRUCTURE["IntrinsicMatrix"]).T, -0.01 if form == "k3" else 0.0
    if form == "K":
        own["K"] = matrix
    elif form == "lengths":
        own |= {"FocalLength": [matrix[0, 0], matrix[1, 1]], "PrincipalPoint": matrix[:2, 2], "Skew": 0.0}
    elif form == "k3":
        own |= {"RadialDistortion": [*STRUCTURE["RadialDistortion"], k3]}
    if form == "json":
        path = tmp_path / "camera.json"
        path.write_text(json.dumps(own), encoding="utf-8")
    else:
        path = saved(tmp_path / "camera.mat", {"s": own})
    camera = read_camera(path).calibrated(0, 0)
    assert (camera.width, camera.height) == (1072, 712)
    np.testing.assert_allclose(camera.project(RAYS) + 1, matlab_px(RAYS, STRUCTURE, k3), atol=1e-10)


def test_a_camera_of_a_pair_is_chosen_by_name(tmp_path):
    other = STRUCTURE | {"RadialDistortion": [0.1, 0.0]}
    path = saved(tmp_path / "pair.mat", {"stereoParams": {"CameraParameters1": STRUCTURE, "CameraParameters2": other}})
    refuses("E-CAMERA-SEVERAL … 2 cameras, 1 needed … stereoParams.CameraParameters1", read_camera, path)
    assert read_camera(path, "stereoParams.CameraParameters2").distortion[0] == 0.1


@pytest.mark.slow
def test_skewed_axes_are_fitted(tmp_path):
    matrix = np.array(STRUCTURE["IntrinsicMatrix"])
    matrix[1, 0] = 3.0
    path = saved(tmp_path / "skew.mat", {"s": STRUCTURE | {"IntrinsicMatrix": matrix}})
    lens = read_lens(path)
    assert isinstance(lens, ForeignLens)
    np.testing.assert_allclose(
        lens.project(RAYS) + 1, matlab_px(RAYS, STRUCTURE | {"IntrinsicMatrix": matrix}), atol=1e-10
    )
    found = fit_lens(lens, 1072, 712)
    assert 0 < found.rms_px < 1.0  # 3 px over half the height, less what a turn of the camera takes
    refuses("E-CAMERA-MODEL … skewed axes", read_camera, path)


BOUGUET = {
    "fc": [657.39536, 657.76309],
    "cc": [302.98372, 242.61688],
    "alpha_c": 0.0,
    "kc": [-0.25584, 0.12758, -0.00021, 0.00003, 0.0],
    "fc_error": [0.34691, 0.37120],
    "cc_error": [0.70488, 0.64467],
    "kc_error": [0.00271, 0.01075, 0.00015, 0.00014, 0.0],
    "nx": 640.0,
    "ny": 480.0,
}
"""The example of the toolbox's page, vision.caltech.edu/bouguetj/calib_doc/htmls/example.html."""


def test_bouguets_results_with_their_sigmas(tmp_path):
    model = read_camera(saved(tmp_path / "Calib_Results.mat", BOUGUET))
    camera = model.calibrated(0, 0)
    assert (camera.width, camera.height, model.colmap_model) == (640, 480, "OPENCV")
    np.testing.assert_allclose(camera.centre, BOUGUET["cc"])
    np.testing.assert_allclose(camera.distortion[:4], BOUGUET["kc"][:4])
    errors = [*BOUGUET["fc_error"], *BOUGUET["cc_error"], *BOUGUET["kc_error"][:4]]
    np.testing.assert_allclose(np.sqrt(np.diag(model.covariance)), np.array(errors) / 3)
    own = {key: value for key, value in BOUGUET.items() if not key.endswith("_error")}
    assert read_camera(saved(tmp_path / "Calib_Results.mat", own)).covariance is None


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"a": 1.0}, "E-CAMERA-CONTENT"),
        ({"s": {"RadialDistortion": [0.1, 0.2]}}, "E-CAMERA-CONTENT"),
        ({"s": STRUCTURE | {"IntrinsicMatrix": np.eye(2)}}, "E-CAMERA-COEFFICIENTS … IntrinsicMatrix … 4 … 9"),
        ({"s": STRUCTURE | {"IntrinsicMatrix": "no"}}, "E-CAMERA-CONTENT … IntrinsicMatrix"),
        ({"s": STRUCTURE | {"TangentialDistortion": [1.0]}}, "E-CAMERA-COEFFICIENTS … TangentialDistortion … 1 … 2"),
        ({"s": STRUCTURE | {"IntrinsicMatrix": np.diag([np.nan, 1, 1])}}, "E-CAMERA-NOT-FINITE"),
        ({"s": {"MappingCoefficients": [1.0, 2, 3, 4]}}, "E-CAMERA-MODEL"),
        ({"fc": [1.0, 2], "cc": [], "kc": [0.0] * 5}, "E-CAMERA-COEFFICIENTS … cc … 0 … 2"),
    ],
)
def test_what_is_no_camera_is_named(tmp_path, variables, said):
    refuses(said, read_camera, saved(tmp_path / "camera.mat", variables))


def test_a_file_that_is_cut_and_hdf5_are_named(tmp_path):
    path = saved(tmp_path / "camera.mat", {"s": STRUCTURE})
    whole = path.read_bytes()
    for cut in (20, 130, 200, 400):
        path.write_bytes(whole[:cut])
        refuses("E-CAMERA-UNREADABLE", read_camera, path)
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))
    refuses("E-CAMERA-UNREADABLE … '-v7'", read_camera, path)


def test_the_same_camera_gives_the_same_bytes():
    first, second = (WRITERS["matlab"](camera_of("OPENCV"), "cam0") for _ in range(2))
    assert first == second
    assert first.startswith(b"MATLAB 5.0 MAT-file, written by stcal")


DAMAGED = {
    "a type of data that is none": ((9, 72), (0, 72)),
    "complex without imaginary parts": ((6, 8, 6, 0), (6, 8, 6 | 1 << 11, 0)),
    "more values than bytes": ((5, 8, 3, 3), (5, 8, 1 << 16, 1 << 14)),
}
"""Numbers of a file, and what stands in their place: SciPy's reader would take the whole process with it."""


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_data_are_refused(tmp_path, kind):
    right, wrong = DAMAGED[kind]
    path = saved(tmp_path / "camera.mat", {"s": {**STRUCTURE, "K": np.eye(3)}})
    one, other = (np.array(each, "<i4").tobytes() for each in (right, wrong))
    content = path.read_bytes()
    assert one in content
    path.write_bytes(content.replace(one, other))
    refuses("E-CAMERA-UNREADABLE … damaged", read_camera, path)
