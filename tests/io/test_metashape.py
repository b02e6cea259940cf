"""Sensors of Metashape's exported cameras: values, and covariances there and back."""

import numpy as np
import pytest

from stcal.geometry.camera import Camera, parameter_names
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.cameras.read import read_camera, save_camera
from tests.io.test_camera_forms import camera_of
from tests.outcome import refuses

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
    path.write_text(SENSOR.format(label=label, params=names, coeffs=text, more=more))
    return path


def test_an_adjusted_sensor_with_its_covariance(tmp_path):
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


def test_of_several_sensors_one_is_chosen(tmp_path):
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


def test_what_has_no_place_is_said(tmp_path):
    camera = camera_of("OPENCV")
    stated = Camera.of(camera, "FULL_OPENCV", np.diag(np.full(12, 1e-4)))
    assert save_camera(tmp_path / "cameras.xml", stated, "metashape-cameras") == ("σ of k4, k5 and k6",)
    found = read_camera(tmp_path / "cameras.xml")
    assert found.colmap_model == "FULL_OPENCV"  # for k3
    assert found.covariance is not None
    assert np.diag(found.covariance)[:9] == pytest.approx(1e-4)
    assert (np.sqrt(np.diag(found.covariance))[9:] < 1e-3).all()


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


def test_cameras_before_alignment(tmp_path):
    (tmp_path / "cameras.xml").write_text('<document><chunk><sensors><sensor id="0"/></sensors></chunk></document>')
    refuses("E-CAMERA-NONE", read_camera, tmp_path / "cameras.xml")
