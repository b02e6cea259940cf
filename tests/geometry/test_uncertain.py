"""Covariance along a chain of poses: against many drawn ones."""

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid, UncertainRigid


def drawn(pose: UncertainRigid, count: int, rng) -> Poses:
    steps = rng.multivariate_normal(np.zeros(6), pose.covariance, count)
    turn = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    return Poses(turn @ pose.rigid.rotation, pose.rigid.translation + steps[:, 3:])


def test_the_covariance_of_a_product_is_that_of_drawn_products():
    rng = np.random.default_rng(1)
    parts = []
    for _ in range(3):
        sigma = np.array([2e-4, 3e-4, 1e-4, 0.05, 0.1, 0.02])
        mix = np.linalg.cholesky(0.5 * np.eye(6) + 0.5)
        turn = Rotation.random(random_state=rng).as_matrix()
        parts.append(UncertainRigid(Rigid(turn, 300 * rng.standard_normal(3)), (mix @ mix.T) * np.outer(sigma, sigma)))
    chain = parts[0] @ parts[1] @ parts[2]
    count = 20_000
    a, b, c = (drawn(part, count, rng) for part in parts)
    products = (a @ b) @ c
    off = products.difference(Poses.of([chain.rigid] * count))
    seen = off.T @ off / count
    scale = np.sqrt(np.outer(np.diag(chain.covariance), np.diag(chain.covariance)))
    # σ of a variance from n draws is √(2/n): 1 %; the largest of 21 stays below five of them.
    assert np.abs((seen - chain.covariance) / scale).max() < 0.05
    assert np.abs((np.diag(seen) / np.diag(chain.covariance)) - 1).max() < 0.05


def test_exact_poses_stay_exact():
    one = UncertainRigid.exact(Rigid(np.eye(3), [1.0, 2.0, 3.0]))
    assert ((one @ one).covariance == 0).all()
    assert (one @ one).rigid.translation.tolist() == [2.0, 4.0, 6.0]
