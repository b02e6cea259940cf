"""Alignment of points: the truth comes back, noise averages out, reflections are refused, degeneracies are named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid, Similarity, align_rigid, align_similarity
from tests.outcome import fails_with


def cloud(seed: int, n: int = 6, flat: bool = False) -> np.ndarray:
    xyz = np.random.default_rng(seed).uniform(-100, 100, (n, 3))
    if flat:
        xyz[:, 2] = 0
    return xyz


def random_rigid(seed: int) -> Rigid:
    rng = np.random.default_rng(seed + 10_000)
    return Rigid(Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.uniform(-1000, 1000, 3))


@given(st.integers(0, 9999), st.booleans(), st.integers(3, 9))
def test_rigid_comes_back(seed, flat, n):
    a_from_b, xyz_b = random_rigid(seed), cloud(seed, n, flat)
    found = align_rigid(a_from_b @ xyz_b, xyz_b)
    # Rounding of coordinates of 1000 mm is 1e-13 mm; thin triangles magnify it.
    np.testing.assert_allclose(found @ xyz_b, a_from_b @ xyz_b, atol=1e-9)


@given(st.integers(0, 9999), st.booleans(), st.floats(1e-3, 1e3))
def test_similarity_comes_back(seed, flat, scale):
    a_from_b, xyz_b = Similarity(scale, random_rigid(seed)), cloud(seed, 6, flat)
    found = align_similarity(a_from_b @ xyz_b, xyz_b)
    # 1000 mm of translation on points of 0.1 mm at the smallest scale: 1e-13 / 0.1, and a margin of 1000.
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found @ xyz_b, a_from_b @ xyz_b, rtol=1e-9, atol=1e-9)


@given(st.integers(0, 999))
def test_weights_of_zero_and_copies_count_as_absent_and_double(seed):
    rng = np.random.default_rng(seed)
    xyz_b, noise = cloud(seed, 5), rng.normal(0, 1, (5, 3))
    xyz_a = random_rigid(seed) @ xyz_b + noise
    doubled = align_rigid(xyz_a, xyz_b, np.array([2.0, 1, 1, 1, 1]))
    copied = align_rigid(xyz_a[[0, 0, 1, 2, 3, 4]], xyz_b[[0, 0, 1, 2, 3, 4]])
    np.testing.assert_allclose(doubled.matrix(), copied.matrix(), atol=1e-8)
    without = align_rigid(xyz_a[1:], xyz_b[1:])
    np.testing.assert_allclose(align_rigid(xyz_a, xyz_b, [0, 1, 1, 1, 1]).matrix(), without.matrix(), atol=1e-8)


def test_similarity_is_the_minimum_that_a_general_optimiser_finds():
    rng = np.random.default_rng(5)
    xyz_b, weights = cloud(5, 7), rng.uniform(0.5, 2, 7)
    xyz_a = Similarity(1.7, random_rigid(5)) @ xyz_b + rng.normal(0, 5, (7, 3))
    found = align_similarity(xyz_a, xyz_b, weights)

    def cost(p):
        candidate = Similarity(found.scale * np.exp(p[6]), Rigid.exp(p[:6]) @ found.rigid)
        return float(weights @ ((candidate @ xyz_b - xyz_a) ** 2).sum(1))

    best = minimize(cost, np.full(7, 0.01), method="BFGS", options={"gtol": 1e-6})
    assert cost(np.zeros(7)) == pytest.approx(best.fun, rel=1e-9)  # neither may be lower than the other


def test_noise_averages_out_as_theory_says():
    # Mean square residual of n points with σ per axis: σ²(3 − 6/n) (Sibson 1979); 400 trials scatter by about 2 %.
    n, sigma, xyz_b = 10, 0.02, cloud(1, 10)
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(400):
        xyz_a = xyz_b + rng.normal(0, sigma, (n, 3))
        squares.append(((align_rigid(xyz_a, xyz_b) @ xyz_b - xyz_a) ** 2).sum(1).mean())
    assert np.mean(squares) / (sigma**2 * (3 - 6 / n)) == pytest.approx(1, abs=0.08)


def test_mirrored_points_give_a_rotation_not_a_reflection():
    xyz_b = cloud(2)
    mirrored = xyz_b * [1, 1, -1]
    found = align_rigid(mirrored, xyz_b)
    assert np.linalg.det(found.rotation) == pytest.approx(1, abs=1e-12)
    rms = np.sqrt(((found @ xyz_b - mirrored) ** 2).sum(1).mean())
    assert 10 < rms < 200  # no rotation can bring a chiral cloud of ±100 mm onto its mirror image


LINE = np.arange(5.0)[:, None] * [1.0, 2, 3]
OFF_ZERO = LINE + np.array([1000.0, 0, 0])  # a line that misses the origin


@pytest.mark.parametrize("align", [align_rigid, align_similarity])
@pytest.mark.parametrize(
    ("xyz_a", "xyz_b", "weights", "message"),
    [
        (cloud(0, 2), cloud(0, 2), None, "E-POINTS-FEW … 2 … 2 … 3"),
        (cloud(0, 5), cloud(0, 4), None, "E-POINTS-FEW … 5 … 4"),
        (LINE, cloud(0, 5), None, "E-POINTS-COLLINEAR"),
        (OFF_ZERO, cloud(0, 5), None, "E-POINTS-COLLINEAR"),
        (cloud(0, 5), OFF_ZERO, None, "E-POINTS-COLLINEAR"),
        (np.ones((4, 3)), np.ones((4, 3)), None, "E-POINTS-COLLINEAR"),
        (cloud(0, 4), cloud(0, 4), [1, 1, 0, 0], "E-POINTS-COLLINEAR"),  # two points carry all the weight
        (cloud(0, 4), cloud(0, 4), [1, 0, 0, 0], "E-POINTS-COLLINEAR"),
        (cloud(0, 4), cloud(0, 4), [0, 0, 0, 0], "E-ALIGN-WEIGHTS"),
        (cloud(0, 4), cloud(0, 4), [1, 1, 1, -1], "E-ALIGN-WEIGHTS"),
    ],
)
def test_degenerate(align, xyz_a, xyz_b, weights, message):
    with fails_with(message):
        align(xyz_a, xyz_b, weights)
