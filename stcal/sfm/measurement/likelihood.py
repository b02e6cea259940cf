"""How far a pose may be off where its likelihood is no Gaussian: a face seen frontally, far away, or in much noise.

Such a face says little on how it is tilted to first order, and more to second order.
"""

import numpy as np

from stcal.geometry.plane_poses import mirrored, step_between
from stcal.geometry.pose_descent import PoseStack
from stcal.geometry.rigid import Rigid
from stcal.sfm.measurement.problem import PoseProblem

CURVED = 0.2
"""χ² two σ away that differs from its parabola by more than this share: the covariance is then taken from samples."""
SAMPLES = 1000
SAMPLED_WIDER = 1.5
"""Samples are drawn with σ so much larger, or their tails would rest on a few of them."""
SAMPLE_ROUNDS = 2
MIN_EFFECTIVE = 20
"""Effective number of samples (Kong 1992) below which they say less than what they were drawn from."""
OTHER_SIDE = 3.0
"""A pose mirrored at the line of sight is another one from this distance on, in σ; nearer, the covariance covers it."""


def covariance_of_likelihood(
    problem: PoseProblem,
    pose: PoseStack,
    full: np.ndarray,
    least: float,
    covariance: np.ndarray,
    second: PoseStack | None,
    plane: Rigid | None,
    plausible: float,
) -> tuple[np.ndarray, float]:
    """Covariance of a pose (6, 6), and by how much χ² its mirror image is worse, infinite where that is no matter.

    The covariance is the given one where the likelihood is Gaussian. Else it is the second moment about the pose of all
    poses by their likelihood: importance sampling with fixed numbers (Bishop 2006, Pattern Recognition and Machine
    Learning, sec. 11.1.4); poses nearer to the ``second`` solution are that one's.

    Parameters
    ----------
    full : (2n, 2n) covariance of the centres
    least : χ² of the pose
    covariance : (6, 6) of the linearised problem
    second : the second solution, or None
    plane : target_from_plane of a face seen alone and without a second minimum, else None. The two may have grown
        together: a valley of which the linearised problem sees one side. The mirror image matters where it is
        ``plausible``, some σ off, and far more probable than these say.
    plausible : what χ² of the mirror image may be worse by
    """
    whiten = np.linalg.inv(np.linalg.cholesky(full))

    def excess(step: np.ndarray) -> np.ndarray:
        near = PoseStack(np.repeat(pose.rotation, len(step), 0), np.repeat(pose.translation, len(step), 0)).moved(step)
        residual, image = problem.seen(near)
        square = ((residual.reshape(len(step), -1) @ whiten.T) ** 2).sum(1)
        return np.where((image.depth > 0).all(1), square, np.inf)

    axes = _principal(covariance)
    curved = np.abs((excess(2 * np.vstack([axes, -axes])) - least) / 4 - 1).max() >= CURVED
    other_side, first = np.inf, covariance
    if plane is not None:
        image_pose = mirrored(pose, plane)
        away = step_between(pose, image_pose)
        square = float(away @ np.linalg.solve(covariance, away))
        worse = _best_of_tilt(problem, image_pose, plane, whiten) - least
        if worse < min(plausible, square / 2) and square > OTHER_SIDE**2:
            other_side, first, curved = float(worse), covariance + np.outer(away, away) / 4, True
    return (_sampled(excess, least, pose, first, second) if curved else covariance), other_side


def _best_of_tilt(problem: PoseProblem, pose: PoseStack, plane: Rigid, whiten: np.ndarray) -> float:
    """χ² of a pose when everything but the tilt of the plane may follow, to first order."""
    residual, image = problem.seen(pose)
    free = np.zeros((6, 4))
    free[:3, 0] = pose.rotation[0] @ plane.rotation[:, 2]
    free[3:, 1:] = np.eye(3)
    a, r = whiten @ image.by_pose.reshape(-1, 6) @ free, whiten @ residual.ravel()
    rest = r - a @ np.linalg.lstsq(a, r)[0]
    return float(rest @ rest)


def _sampled(excess, least: float, pose: PoseStack, covariance: np.ndarray, second: PoseStack | None) -> np.ndarray:
    """Second moment (6, 6) of exp(−(excess − least)/2) about the pose; ``covariance`` : about what it will be."""
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 6))
    precision = np.linalg.inv(covariance)
    for _ in range(SAMPLE_ROUNDS):
        step = SAMPLED_WIDER * normal @ _principal(covariance)
        log = (normal**2).sum(1) / 2 - (excess(step) - least) / 2
        if second is not None:
            away = step_between(pose, second)
            log[(step - away / 2) @ precision @ away > 0] = -np.inf
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        if 1 / (weight**2).sum() < MIN_EFFECTIVE:
            break
        covariance = np.einsum("k,ki,kj->ij", weight, step, step)
    return covariance


def _principal(covariance: np.ndarray) -> np.ndarray:
    """Rows whose summed outer products are the covariance: principal axes in units of σ."""
    sigma = np.sqrt(np.diag(covariance))
    value, vector = np.linalg.eigh(covariance / sigma / sigma[:, None])
    return (vector * np.sqrt(np.maximum(value, 0))).T * sigma
