"""Whether the predicted uncertainty is true: labels simulated with noise, calibrated, errors against covariances.

.venv/bin/python scripts/studies/uncertainty_study.py [--runs 200]

Every run has a target, a board and cameras of its own. Prints for the default board, for one of 20 µm, and with refined
intrinsics (the given ones drawn from their σ): RMS of the position errors over the Cramér–Rao bound (the adjustment's
covariance with σ₀ = 1 at the noise that was put in), and the mean normalised squared error eᵀC⁻¹e/6 of the face poses.
"""

from dataclasses import replace

import numpy as np

from scripts.runner import executor_of, face_errors, normalised, script
from stcal.design import reference_board
from stcal.geometry.camera import intrinsic_basis
from stcal.geometry.rigid import Rigid, Similarity
from stcal.io.cameras.camera_model import CameraPrior
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.refine import adjust, eccentricity_px
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.scene import SceneOptions, make_scene

NOISE_PX = 0.02
CAMERA_SIGMA = np.array([1.5, 1.5, 1.0, 1.0, 5e-4, 2e-3, 5e-5, 5e-5])
"""σ of fx, fy, cx, cy (px), k1, k2, p1, p2 of the given intrinsics where they are refined."""


def one_run(seed: int, board_sigma_mm: float, refine: bool) -> list[tuple[float, float]]:
    """Squared position error over its bound, and normalised squared error, of every face but the reference."""
    rng = np.random.default_rng([seed, 77])
    board = replace(reference_board(), sigma_mm=board_sigma_mm)
    scene = make_scene(SceneOptions(seed=seed, width=2592, height=1728, images_per_group=6), None, board)
    observations = observe(scene, NOISE_PX, rng)
    camera, prior = scene.camera, None
    if refine:
        prior = CameraPrior(scene.camera.colmap_model, np.diag(CAMERA_SIGMA**2))
        away = intrinsic_basis(scene.camera.colmap_model) @ (CAMERA_SIGMA * rng.standard_normal(8))
        camera = camera.with_parameters(camera.parameters() + away)
    radius = scene.target.radius_of() | board.radius_of()
    models = [
        adjust(replace(m, shift_px=eccentricity_px(m, camera, radius, 1.0)), camera).in_world(Similarity(1.0, Rigid()))
        for m in true_models(scene, observations)
    ]
    options = RunOptions(refine_camera=refine).adjustment(scene.target)
    result = calibrate(models, camera, scene.target, board, options, prior)
    scale = (result.sigma_factors.circles * result.joint.sigma_scale) ** 2
    errors = face_errors(result.target, scene.target_from_face)
    bound = [np.trace(result.target.face_covariance[face][3:, 3:]) / scale for face in errors]
    shares = [error[3:] @ error[3:] / each for error, each in zip(errors.values(), bound, strict=True)]
    return list(zip(shares, normalised(result.target, errors), strict=True))


@script(runs=200, scheduler=str, limited=True)
def main(given) -> None:
    count = given.runs
    print(f"{count} runs each, {NOISE_PX} px noise, 4 groups of 6 images, 2592×1728 px (simulated labels)")
    print(f"{'':28} error / bound   normalised squared error")
    for title, sigma, refine in (
        ("board σ 5 µm", 0.005, False),
        ("board σ 20 µm", 0.02, False),
        ("board σ 5 µm, camera refined", 0.005, True),
    ):
        with executor_of(given.scheduler) as pool:
            answers = list(pool.map(one_run, range(count), [sigma] * count, [refine] * count))
        rows = np.array([row for answer in answers for row in answer])
        spread = rows[:, 1].reshape(count, -1).mean(1).std() / np.sqrt(count)
        figures = f"{np.sqrt(rows[:, 0].mean()):13.3f}   {rows[:, 1].mean():.3f} ± {spread:.3f}"
        print(f"{title:28} {figures}", flush=True)
