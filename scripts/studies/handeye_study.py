"""Whether hand-eye results know how good they are where the camera file is off.

.venv/bin/python scripts/studies/handeye_study.py [--trials 500] [--only METHOD]

Poses are simulated, and corners of a chessboard of 8×7 squares of 25 mm from about 450 mm; nothing is real. The camera
file is off by the σ that is stated of it, and by four times as much. "Calibration": RMS over trials and the six numbers
of X of the error in units of the covariance that the result states; 1 is true, more is too sure of itself.
"""

from functools import partial
from itertools import product

import numpy as np
from scipy.stats import chi2

from scripts.runner import executor_of, head, row, script
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, Noise
from stcal.handeye.data.corner_views import Views, pairs_of_views
from stcal.handeye.data.pose_pairs import SETUPS
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.io.cameras.camera_model import camera_prior
from tests.support.handeye import CAMERA, simulated_views

CORNERS = {"corner_px": 0.1, "board_mm": 0.03}
NOISES = {
    "camera ≫ robot": Noise(1e-4, 0.03, 1e-3, 0.3, **CORNERS),
    "camera ≈ robot": Noise(5e-4, 0.2, 5e-4, 0.2, **CORNERS),
    "robot ≫ camera": Noise(1e-3, 0.3, 1e-4, 0.03, **CORNERS),
}
PRIOR = camera_prior(Camera.of(CAMERA, "OPENCV"))
"""What is stated of the camera."""
CAMERAS = {
    "pose, camera as filed": ("pose", HandEyeOptions(camera=PRIOR)),
    "reprojection, camera as filed": ("reprojection", HandEyeOptions(camera=PRIOR)),
    "reprojection, camera solved for": ("reprojection", HandEyeOptions(intrinsics=PRIOR)),
}
OFF = (1.0, 4.0)
"""By how many σ of the camera file its intrinsics are off."""
POSES_OFF = 12


def camera_trial(method: str, setup: str, name: str, off: float, seed: int) -> tuple[float, float]:
    """Squared error of X by a camera file that is off: in units of the stated covariance, and of its translation, mm²;
    σ are estimated."""
    noise, rng = NOISES[name], np.random.default_rng([seed, 1])
    truth = simulated_views(rng, POSES_OFF, setup, (noise.robot_rad, noise.robot_mm), noise.corner_px, noise.board_mm)
    error = off * rng.multivariate_normal(np.zeros(len(PRIOR.covariance)), PRIOR.covariance)
    camera = CAMERA.with_parameters(CAMERA.parameters() + intrinsic_basis(PRIOR.colmap_model) @ error)
    views = Views(camera, truth.views.views)
    solved_by, options = CAMERAS[method]
    pairs = pairs_of_views(truth.pairs.base_from_flange, views)
    found = HandEyeProblem(pairs, setup, views, options).solved(solved_by).result
    apart = Poses.of([found.mount_from_camera]).difference(Poses.of([truth.mount_from_camera]))[0]
    return float(apart @ np.linalg.solve(found.covariance, apart)), float(apart[3:] @ apart[3:])


@script(trials=500, only="", scheduler=str, limited=True)
def main(given) -> None:
    low, high = np.sqrt(chi2.ppf([0.025, 0.975], 6 * given.trials) / (6 * given.trials))
    print(f"{given.trials} trials each, simulated; a ratio that is 1 lies within {low:.3f} … {high:.3f}\n")
    with executor_of(given.scheduler) as pool:
        print(f"\n{POSES_OFF} poses, σ estimated:\n")
        head("method", "setup", "noise", "camera off", "calibration", "RMS error, mm")
        for case in product([name for name in CAMERAS if name.startswith(given.only)], SETUPS, NOISES, OFF):
            found = np.array(list(pool.map(partial(camera_trial, *case), range(given.trials), chunksize=10)))
            ratio, rms = np.sqrt(found.mean(0) / [6, 1])
            row(*case[:3], f"{case[3]:g} σ", f"{ratio:.3f}", f"{rms:.3g}")
