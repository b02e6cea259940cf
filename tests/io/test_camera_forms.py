"""Cameras of other programs: each form read back, and what MATLAB, Bouguet and Metashape write, by their documents."""

import json
from typing import get_args

import numpy as np
import pycolmap
import pytest
from scipy.io import savemat

from stcal.cli.instruments import Form
from stcal.errors import InputError
from stcal.geometry.camera import Camera, parameter_names
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.cameras.difference import fit_lens
from stcal.io.cameras.foreign_lenses import ForeignLens
from stcal.io.cameras.read import SUFFIXES, WRITERS, read_camera, read_lens, save_camera
from tests.io import camera_files
from tests.io.camera_files import METASHAPE, metashape
from tests.outcome import refuses
from tests.shared import written

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
    if form in REFUSED[model]:
        with pytest.raises(InputError, match=f"{form} has no place for .* of {model}; write --form colmap"):
            WRITERS[form](camera, "cam0")
        return
    path = written(tmp_path / f"camera{SUFFIX[form]}", WRITERS[form](camera, "cam0"))
    found = read_camera(path).calibrated(1280, 961)
    assert (found.width, found.height, found.fisheye) == (1280, 961, camera.fisheye)
    # sums and differences of half the image's size round in the last place
    np.testing.assert_allclose(found.parameters(), camera.parameters(), rtol=1e-14, atol=1e-12)


def test_a_comment_does_not_tell_the_form_and_metashapes_fisheye_has_its_own_formula(tmp_path):
    assert get_args(Form) == tuple(WRITERS)
    text = "# as the lensmodel of mrcal\n1 PINHOLE 1280 961 812.25 809.5 640.125 478.0625\n"
    assert read_camera(written(tmp_path / "cameras.txt", text)).colmap_model == "PINHOLE"
    # u = w/2 + cx + x' (f + b1), p1 beside r² + 2 x²; the first pixel is at 0.5.
    lens, rays = read_lens(written(tmp_path / "c.xml", METASHAPE.replace("frame", "fisheye"))), camera_files.RAYS
    radius = np.linalg.norm(rays[:, :2], axis=1, keepdims=True)
    turned = rays[:, :2] * np.arctan(radius) / radius
    wanted = metashape(turned, 910.25, (1.25, 0), (-0.2, 0.05, 0.01), (-0.0005, 0.001))
    np.testing.assert_allclose(camera_files.project(lens), wanted, atol=1e-9)


@pytest.mark.parametrize(("form", "suffix"), [("colmap", "txt"), ("colmap-bin", "bin")])
def test_colmap_reads_what_is_written(tmp_path, form, suffix):
    for model in LENSES:
        written(tmp_path / f"cameras.{suffix}", WRITERS[form](camera_of(model), "cam0"))
        for name in ("images", "points3D"):
            (tmp_path / f"{name}.{suffix}").write_bytes(bytes(8) if suffix == "bin" else b"")
        (found,) = pycolmap.Reconstruction(tmp_path).cameras.values()
        assert found.model.name == model
        assert list(found.params) == camera_of(model).colmap_params()


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


MATRIX = np.array(STRUCTURE["IntrinsicMatrix"]).T
PLAIN = {key: value for key, value in STRUCTURE.items() if key != "IntrinsicMatrix"}
STRUCTURES = {
    **dict.fromkeys(("struct", "json"), STRUCTURE),
    "K": PLAIN | {"K": MATRIX},
    "lengths": PLAIN | {"FocalLength": np.diag(MATRIX)[:2], "PrincipalPoint": MATRIX[:2, 2], "Skew": 0.0},
    "k3": STRUCTURE | {"RadialDistortion": [*STRUCTURE["RadialDistortion"], -0.01]},
}


@pytest.mark.parametrize("form", STRUCTURES)
def test_a_structure_projects_as_matlab_says(tmp_path, form):
    own, k3 = STRUCTURES[form], -0.01 if form == "k3" else 0.0
    if form == "json":
        path = written(tmp_path / "camera.json", json.dumps(own))
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
    skewed = STRUCTURE | {"IntrinsicMatrix": MATRIX.T + np.outer([0, 3.0, 0], [1, 0, 0])}
    path = saved(tmp_path / "skew.mat", {"s": skewed})
    lens = read_lens(path)
    assert isinstance(lens, ForeignLens)
    np.testing.assert_allclose(lens.project(RAYS) + 1, matlab_px(RAYS, skewed), atol=1e-10)
    found = fit_lens(lens, 1072, 712)
    assert 0 < found.rms_px < 1.0  # 3 px over half the height, less what a turn of the camera takes
    refuses("E-CAMERA-MODEL … skewed axes", read_camera, path)


TOOLBOX = {
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
    model = read_camera(saved(tmp_path / "Calib_Results.mat", TOOLBOX))
    camera = model.calibrated(0, 0)
    assert (camera.width, camera.height, model.colmap_model) == (640, 480, "OPENCV")
    np.testing.assert_allclose(camera.centre, TOOLBOX["cc"])
    np.testing.assert_allclose(camera.distortion[:4], TOOLBOX["kc"][:4])
    errors = [*TOOLBOX["fc_error"], *TOOLBOX["cc_error"], *TOOLBOX["kc_error"][:4]]
    np.testing.assert_allclose(np.sqrt(np.diag(model.covariance)), np.array(errors) / 3)
    own = {key: value for key, value in TOOLBOX.items() if not key.endswith("_error")}
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


def test_matlab_files_that_are_cut_and_hdf5_are_named_and_the_same_camera_gives_the_same_bytes(tmp_path):
    path = saved(tmp_path / "camera.mat", {"s": STRUCTURE})
    whole = path.read_bytes()
    for cut in (20, 130, 200, 400):
        refuses("E-CAMERA-UNREADABLE", read_camera, written(path, whole[:cut]))
    hdf5 = written(path, b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))
    refuses("E-CAMERA-UNREADABLE … '-v7'", read_camera, hdf5)
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
    refuses("E-CAMERA-UNREADABLE … damaged", read_camera, written(path, content.replace(one, other)))


SENSOR = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="c"><sensors next_id="2">
<sensor id="0" label="{label}" type="frame"><resolution width="4000" height="3000"/>
<calibration type="frame" class="initial"><resolution width="4000" height="3000"/><f>3000</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="4000" height="3000"/><f>3100</f><cx>10</cx><cy>-5</cy>
<k1>-0.05</k1><k2>0.02</k2><p1>0.001</p1><p2>0.002</p2></calibration>
<covariance><params>{params}</params><coeffs>{coeffs}</coeffs></covariance></sensor>
{more}</sensors></chunk></document>
"""
NAMES = "f cx cy k1 k2 p1 p2"
SIGMA = np.array([2.0, 0.3, 0.4, 1e-3, 2e-3, 3e-5, 4e-5])


def sensor_file(path, names=NAMES, coeffs=None, label="DJI", more=""):
    correlation = 0.5 * np.eye(len(SIGMA)) + 0.5
    matrix = correlation * np.outer(SIGMA, SIGMA)
    text = " ".join(map(repr, matrix.ravel().tolist())) if coeffs is None else coeffs
    return written(path, SENSOR.format(label=label, params=names, coeffs=text, more=more))


def test_an_adjusted_sensor_with_its_covariance_and_of_several_one_is_chosen(tmp_path):
    found = read_camera(sensor_file(tmp_path / "cameras.xml"))
    assert found.colmap_model == "OPENCV"
    assert found.focal == pytest.approx([3100, 3100])
    assert found.centre == pytest.approx([2000 + 10 - 0.5, 1500 - 5 - 0.5])
    assert found.distortion[:4] == pytest.approx([-0.05, 0.02, 0.002, 0.001])  # p1 and p2 are each other's
    assert found.covariance is not None
    sigma = dict(zip(parameter_names("OPENCV"), np.sqrt(np.diag(found.covariance)), strict=True))
    assert sigma == pytest.approx(dict(zip(sigma, [2, 2, 0.3, 0.4, 1e-3, 2e-3, 4e-5, 3e-5], strict=True)), rel=1e-6)
    # One focal length was adjusted: both move as one, by hardly anything against each other, and no more is singular.
    apart = np.array([1, -1, 0, 0, 0, 0, 0, 0.0])
    assert 0 < apart @ found.covariance @ apart < 1e-5
    assert found.covariance[0, 2] == pytest.approx(0.5 * 2 * 0.3, rel=1e-6)
    prior = camera_prior(found.calibrated(0, 0)).covariance
    assert np.linalg.eigvalsh(prior / np.sqrt(np.outer(np.diag(prior), np.diag(prior)))).min() > 0
    other = '<sensor id="1" label="thermal" type="frame"><calibration type="frame" class="adjusted">'
    other += '<resolution width="640" height="512"/><f>700</f></calibration></sensor>'
    path = sensor_file(tmp_path / "doc.xml", more=other)
    refuses("E-CAMERA-SEVERAL … DJI, thermal", read_camera, path)
    assert read_camera(path, "thermal").covariance is None
    assert read_camera(path, "thermal").focal == pytest.approx([700, 700])
    assert read_camera(path, "DJI").covariance is not None


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_a_covariance_reads_back(tmp_path, model):
    camera = camera_of(model)
    count = len(parameter_names(model))
    root = np.random.default_rng(3).standard_normal((count, count)) + 2 * np.eye(count)
    scale = np.array([1.0, 1.0, 0.5, 0.5, *[1e-3] * (count - 4)])
    covariance = (root @ root.T) * np.outer(scale, scale)
    stated = Camera.of(camera, model, covariance)
    assert save_camera(tmp_path / "cameras.xml", stated, "metashape-cameras") == ()
    found = read_camera(tmp_path / "cameras.xml").calibrated(0, 0)
    assert found.colmap_model == model
    assert found.covariance == pytest.approx(covariance, rel=1e-9, abs=1e-18)
    assert save_camera(tmp_path / "lens.xml", stated, "metashape") == ("σ and correlations of the parameters",)


def test_what_has_no_place_is_said_and_cameras_before_alignment_are_none(tmp_path):
    camera = camera_of("OPENCV")
    stated = Camera.of(camera, "FULL_OPENCV", np.diag(np.full(12, 1e-4)))
    assert save_camera(tmp_path / "cameras.xml", stated, "metashape-cameras") == ("σ of k4, k5 and k6",)
    found = read_camera(tmp_path / "cameras.xml")
    assert found.colmap_model == "FULL_OPENCV"  # for k3
    assert found.covariance is not None
    assert np.diag(found.covariance)[:9] == pytest.approx(1e-4)
    assert (np.sqrt(np.diag(found.covariance))[9:] < 1e-3).all()
    text = '<document><chunk><sensors><sensor id="0"/></sensors></chunk></document>'
    refuses("E-CAMERA-NONE", read_camera, written(tmp_path / "cameras.xml", text))


@pytest.mark.parametrize(
    ("names", "coeffs", "message"),
    [
        ("f cx", "1 0 0", "E-CAMERA-COVARIANCE … 2 … 3"),
        ("f q", "1 0 0 1", "E-CAMERA-COVARIANCE … 2 … 4"),
        ("f cx", "1 2 2 1", "E-CAMERA-COVARIANCE"),
        ("f cx", "1 0 0 x", "E-CAMERA-COVARIANCE … could not convert"),
        ("f b2", "1 0 0 1", "E-CAMERA-MODEL"),
    ],
)
def test_covariances_that_are_none(tmp_path, names, coeffs, message):
    refuses(message, read_camera, sensor_file(tmp_path / "cameras.xml", names, coeffs))
