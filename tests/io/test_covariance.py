"""What is a covariance: rounding passes, all that cannot be one is named with what was measured."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.geometry.arrays import OF_POSE, ROUNDING, CovarianceRows, first_fault, require_covariance
from stcal.io.json import Part, PoseCovariance, checked
from tests.outcome import fails_with, refuses

SIGMA = np.array([1e-5, 2e-5, 3e-5, 0.01, 0.02, 500.0])
"""rad and mm: sixteen orders of magnitude between variances."""


def with_entry(i: int, j: int, correlation: float, both: bool = True) -> np.ndarray:
    matrix = np.diag(SIGMA**2)
    matrix[i, j] += correlation * SIGMA[i] * SIGMA[j] - (i == j) * matrix[i, j]
    if both:
        matrix[j, i] = matrix[i, j]
    return matrix


def without_a_reason_in_pairs() -> np.ndarray:
    """Three correlations of −0.6 are possible alone, but not together: eigenvalue 1 − 2 · 0.6."""
    correlation = np.eye(6)
    correlation[:3, :3] -= 0.6 * (1 - np.eye(3))
    return correlation * np.outer(SIGMA, SIGMA)


def without_variance() -> np.ndarray:
    matrix = with_entry(3, 4, 0.5)
    matrix[3, 3] = 0
    return matrix


NONE = {
    "negative variance": (with_entry(3, 3, -3.0), "E-COVARIANCE-VALUE … -0.0003 … 0"),
    "correlation of 9": (with_entry(3, 4, 9.0), "E-COVARIANCE-VALUE … 9 … 1 … 1"),
    "correlation over 1": (with_entry(0, 5, -1.01), "E-COVARIANCE-VALUE … -1.01"),
    "not symmetric": (with_entry(0, 1, 0.5) + with_entry(0, 1, 0.06, both=False), "E-COVARIANCE-VALUE … 10.7"),
    "one side only": (with_entry(4, 2, 0.5, both=False), "E-COVARIANCE-VALUE … 100"),
    "not together": (without_a_reason_in_pairs(), "E-COVARIANCE-VALUE … -0.2 … 0"),
    "covariance without variance": (without_variance(), "E-COVARIANCE-VALUE … 5 … 03"),
    "NaN": (with_entry(1, 1, np.nan), "E-COVARIANCE-VALUE"),
    "infinite": (with_entry(1, 1, np.inf), "E-COVARIANCE-VALUE"),
    "too large": (with_entry(5, 5, 1e300), "E-COVARIANCE-VALUE … 2.5 … 305 … 1 … 24"),
    "5×5": (np.eye(5), "E-COVARIANCE-SHAPE … 5×5 … 6 … 6"),
    "a row": (np.ones(6), "E-COVARIANCE-SHAPE … 6 … 6 … 6"),
}


@pytest.mark.parametrize("case", NONE)
def test_what_is_none_is_named(case):
    matrix, message = NONE[case]
    refuses(message, require_covariance, matrix, 6, OF_POSE)


def test_files_name_the_place_and_not_the_numbers():
    class Read(Part):
        faces: dict[str, PoseCovariance]

    with fails_with("E-KEY-VALUE … 2"):
        checked({"faces": {"1": np.eye(6).tolist(), "2": NONE["not together"][0].tolist()}}, Read)


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(6, 12))
def test_all_ranks_pass_with_six_digits(seed, rank, size):
    """Singular ones too, as a covariance in the target's own frame is."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((size, rank)) * 10.0 ** rng.uniform(-6, 2, size)[:, None]
    full = root @ root.T
    written = np.vectorize(lambda v: float(f"{v:.6g}"))(full)
    require_covariance((written + written.T) / 2, size, CovarianceRows(tuple("abcdefghijkl")))


@given(st.integers(0, 2**32 - 1))
def test_rounding_of_zero_passes(seed):
    """That of the reference face is computed as 1e-69 to 1e-20 of any sign."""
    noise = np.random.default_rng(seed).standard_normal((6, 6)) * 1e-20
    require_covariance(noise, 6, OF_POSE)


def test_just_beyond_rounding_and_singular_where_it_is_inverted():
    low, high = (with_entry(0, 1, 1 + share * 6 * ROUNDING) for share in (0.5, 1.5))
    require_covariance(low, 6, OF_POSE)
    refuses("E-COVARIANCE-VALUE … 1", require_covariance, high, 6, OF_POSE)
    stack = np.tile(np.diag(SIGMA**2), (5, 1, 1))
    assert first_fault(stack, OF_POSE, definite=True) is None
    stack[2, 5, 5] = stack[4, 5, 5] = 0
    assert first_fault(stack, OF_POSE) is None
    fault = first_fault(stack, OF_POSE, definite=True)
    assert fault is not None
    assert fault.row == 2
    assert fault.reason == "variance 0 of z, a positive number needed (and 1 more)"
    assert first_fault(stack[:0], OF_POSE, definite=True) is None
