"""What a camera file's error does to X is part of its σ."""

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.handeye import HandEyeOptions, Views, pairs_of_views
from stcal.io.cameras.camera_model import CameraPrior, camera_prior
from tests.support.handeye import CAMERA, handeye, simulated_views, squared

PRIOR = camera_prior(Camera.of(CAMERA, "OPENCV"))
TRIALS = 12


def by_a_wrong_camera(seed: int, times: float, method: str, options: HandEyeOptions) -> float:
    rng = np.random.default_rng(seed)
    truth = simulated_views(rng, 12, "eye-in-hand", (1e-4, 0.03), 0.1, 0.03)
    error = times * rng.multivariate_normal(np.zeros(len(PRIOR.covariance)), PRIOR.covariance)
    camera = CAMERA.with_parameters(CAMERA.parameters() + intrinsic_basis("OPENCV") @ error)
    views = Views(camera, truth.views.views)
    found = handeye(pairs_of_views(truth.pairs.base_from_flange, views), "eye-in-hand", method, views, options)
    return squared(found, truth)


@pytest.mark.full
@pytest.mark.parametrize("method", ["pose", "reprojection"])
@pytest.mark.parametrize("times", [1.0, 4.0])
def test_sigma_covers_what_the_camera_file_errs(method, times):
    """Of all trials together within what chance makes of six numbers each, a factor of 1.25² left for errors that are
    not linear; it is far beyond without (8 to 15 times σ)."""
    considered = [by_a_wrong_camera(seed, times, method, HandEyeOptions(camera=PRIOR)) for seed in range(TRIALS)]
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * TRIALS)
    assert low / 1.25**2 < sum(considered) < high * 1.25**2
    exact = [by_a_wrong_camera(seed, times, method, HandEyeOptions()) for seed in range(TRIALS)]
    assert sum(exact) > 2 * high


@pytest.mark.parametrize("method", ["pose", "reprojection"])
def test_a_camera_that_is_known_exactly_adds_nothing(method):
    """σ of 1e-9 of the usual: what they add, and what the others' σ change with them, is below 1e-3."""
    exact = HandEyeOptions(camera=CameraPrior("OPENCV", 1e-18 * PRIOR.covariance))
    truth = simulated_views(np.random.default_rng(5), 12, "eye-in-hand", (1e-4, 0.03), 0.1, 0.03)
    stated, silent = (handeye(truth.pairs, "eye-in-hand", method, truth.views, o) for o in (exact, HandEyeOptions()))
    assert np.allclose(stated.mount_from_camera.matrix(), silent.mount_from_camera.matrix(), atol=1e-9)
    assert np.allclose(np.diag(stated.covariance), np.diag(silent.covariance), rtol=1e-3)
