"""Whether hand-eye results are as good as they can be, and know how good they are.

.venv/bin/python scripts/studies/handeye_study.py [--trials 500] [--only METHOD]

Poses are simulated, and corners of a chessboard of 8×7 squares of 25 mm from about 450 mm; nothing is real. "Bound":
RMS over trials and the six numbers of X of the error in units of the inverse information at the truth, with the σ that
were put in (Cramér–Rao); 1 is the least that an unbiased method can have. "Calibration": the same in units of the
covariance that the result states; 1 is true, more is too sure of itself. A second table is of a camera file that is
off: by the σ that is stated of it, and by four times as much. Prints Markdown.
"""

from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.stats import chi2

from scripts.runner import options_of
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, Noise
from stcal.handeye.data.corner_views import Views, pairs_of_views
from stcal.handeye.data.pose_pairs import SETUPS, Loop
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.handeye.methods.pose_adjustment import components
from stcal.handeye.methods.reprojection import problem
from stcal.io.cameras.camera_model import camera_prior
from stcal.parallel import one_thread
from stcal.workflows.cluster import executor_of
from tests.support.handeye import CAMERA, Truth, simulated, simulated_views

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
EXACT = Noise(0, 0, 1e-12, 1e-12, 1e-9, 0)
COUNTS = {
    "pose, σ stated": (4, 8, 20),
    "pose, σ estimated": (4, 8, 20),
    "reprojection, σ stated": (12,),
    "reprojection, σ estimated": (12,),
}
"""Poses, by what is solved."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is simulated, and how it is solved."""

    method: str
    setup: str
    noise: str
    count: int


def truth_of(case: Case, seed: int, noise: Noise) -> Truth:
    """The same geometry for every noise of a seed."""
    rng, robot = np.random.default_rng(seed), (noise.robot_rad, noise.robot_mm)
    if case.method.startswith("pose"):
        return simulated(rng, case.count, case.setup, robot, (noise.camera_rad, noise.camera_mm))
    return simulated_views(rng, case.count, case.setup, robot, noise.corner_px, noise.board_mm)


def trial(case: Case, seed: int) -> tuple[float, float, int]:
    """Squared error of X in units of the bound and of the stated covariance; how many good poses were left out."""
    noise = NOISES[case.noise]
    truth = truth_of(case, seed, noise)
    by_poses = case.method.startswith("pose")
    options = HandEyeOptions(noise=noise if case.method.endswith("stated") else Noise())
    problem = HandEyeProblem(truth.pairs, case.setup, truth.views, options)
    found = problem.solved("pose" if by_poses else "reprojection").result
    off = Poses.of([found.mount_from_camera]).difference(Poses.of([truth.mount_from_camera]))[0]
    bound = (pose_bound if by_poses else corner_bound)(truth_of(case, seed, EXACT), noise)
    return (
        float(off @ np.linalg.solve(bound, off)),
        float(off @ np.linalg.solve(found.covariance, off)),
        int(found.outliers.sum()),
    )


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


def print_cameras(pool, trials: int, only: str) -> None:
    """The table of camera files that are off."""
    print(f"\n{POSES_OFF} poses, σ estimated:\n")
    print("| method | setup | noise | camera off | calibration | RMS error, mm |\n|---|---|---|---|---|---|")
    for case in product([name for name in CAMERAS if name.startswith(only)], SETUPS, NOISES, OFF):
        found = np.array(list(pool.map(partial(camera_trial, *case), range(trials), chunksize=10)))
        ratio, rms = np.sqrt(found.mean(0) / [6, 1])
        method, setup, noise, off = case
        print(f"| {method} | {setup} | {noise} | {off:g} σ | {ratio:.3f} | {rms:.3g} |", flush=True)


def pose_bound(exact: Truth, noise: Noise) -> np.ndarray:
    """Inverse information (6, 6) on X of poses, Z unknown."""
    loop = Loop.of(exact.pairs, exact.setup)
    slope = loop.jacobian(exact.mount_from_camera)
    spread = components(loop, noise, exact.mount_from_camera).known
    return np.linalg.inv(np.einsum("mai,maj->ij", slope, np.linalg.solve(spread, slope)))[:6, :6]


def corner_bound(exact: Truth, noise: Noise) -> np.ndarray:
    """Inverse information (6, 6) on X of corners; Z, robot and board unknown but for their σ."""
    flange = exact.pairs.base_from_flange
    corners, _ = problem(Loop.of(exact.pairs, exact.setup), flange, exact.views, noise)
    start = corners.start(exact.mount_from_camera, exact.stand_from_board, 1.0)
    return corners.problem().at(start).inverse[:6, :6]


@one_thread()
def main() -> None:
    """Run all cases; print."""
    arguments = options_of(__doc__, trials=500, only="", cameras=False, scheduler=str)
    trials = arguments.trials
    low, high = np.sqrt(chi2.ppf([0.025, 0.975], 6 * trials) / (6 * trials))
    print(f"{trials} trials each, simulated; a ratio that is 1 lies within {low:.3f} … {high:.3f}\n")
    with executor_of(arguments.scheduler) as pool:
        if arguments.cameras:
            print_cameras(pool, trials, arguments.only)
            return
        print("| method | setup | noise | poses | bound | calibration | good poses left out |")
        print("|---|---|---|---|---|---|---|")
        methods = [method for method in COUNTS if method.startswith(arguments.only)]
        cases = (Case(*v, count) for v in product(methods, SETUPS, NOISES) for count in COUNTS[v[0]])
        ratios: dict[tuple[str, int], list[np.ndarray]] = {}
        for case in cases:
            found = np.array(list(pool.map(partial(trial, case), range(trials), chunksize=10)))
            both = np.sqrt(found[:, :2].mean(0) / 6)
            ratios.setdefault((case.method, case.count), []).append(both)
            row = f"{case.method} | {case.setup} | {case.noise} | {case.count} | {both[0]:.3f} | {both[1]:.3f}"
            print(f"| {row} | {int(found[:, 2].sum())} of {trials * case.count} |", flush=True)
        print_cameras(pool, trials, arguments.only)
    print("\nover setups and noises:\n\n| method | poses | bound | calibration |\n|---|---|---|---|")
    for (method, count), values in ratios.items():
        spans = " | ".join(
            f"{low:.2f}–{high:.2f}" for low, high in zip(np.min(values, 0), np.max(values, 0), strict=True)
        )
        print(f"| {method} | {count} | {spans} |")


if __name__ == "__main__":
    main()
