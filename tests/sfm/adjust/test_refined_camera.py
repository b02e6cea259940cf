"""Intrinsics as observations: wrong ones hardly matter where they are refined, and matter much where they are not."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, Similarity
from stcal.io.cameras.camera_model import camera_prior
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.refine import refine
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.outcome import fails_with

NOISE_PX = 0.01


def position_error_um(scene, observations, camera, refine_camera: bool) -> float:
    """RMS over the faces but the reference."""
    seen = [replace(image, centre=camera.normalised_from_pixel(image.centre_px)) for image in observations]
    models = [
        refine(m.in_world(Similarity(1.0, Rigid())), camera, scene.target, scene.board).model
        for m in true_models(scene, seen)
    ]
    given = Camera.of(camera, scene.camera.colmap_model)
    options = RunOptions(refine_camera=refine_camera).adjustment(scene.target)
    result = calibrate(models, camera, scene.target, scene.board, options, camera_prior(given))
    poses = result.target.target_from_face
    off = [p.translation - scene.target_from_face[f].translation for f, p in poses.items() if f != "1"]
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(off), axis=1))))


@pytest.mark.slow
def test_wrong_intrinsics_are_refined():
    """0.03 % in f, 2 px in c, 1 % in k1: within 1.5 times the error with the true camera; several times it without."""
    scene = make_scene(SceneOptions(seed=0, images_per_group=4, groups=(("1", "2"), ("1", "4"))))
    observations = observe(scene, NOISE_PX, np.random.default_rng(0))
    true = scene.camera
    k1 = np.array([0.01 * true.distortion[0], *[0] * 11])
    centre = true.centre + np.array([2, 2])
    wrong = replace(true, focal=1.0003 * true.focal, centre=centre, distortion=true.distortion + k1)
    cases = ((true, False), (wrong, True), (wrong, False))
    known, refined, held = (position_error_um(scene, observations, camera, refine) for camera, refine in cases)
    assert 0.5 * known < refined < 1.5 * known
    assert held > 5 * known


def test_the_chain_has_no_intrinsics_to_refine():
    scene = make_scene(SceneOptions(seed=0, images_per_group=2))
    with fails_with("E-OPTION-NEEDS … --solve"):
        RunOptions(solve="chain", refine_camera=True).settled(scene.target)
