"""Transforms: group axioms, points, covariances of chains, alignment, and what is refused. Covariances: rounding
passes, all that cannot be one is named with what was measured."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from stcal.geometry.arrays import OF_PIXEL, OF_POSE, ROUNDING, CovarianceRows, first_fault, require_covariance
from stcal.geometry.rigid import Affine, Poses, Rigid, Similarity, UncertainRigid, align_rigid, align_similarity, skew
from stcal.io.json import Part, PoseCovariance, checked
from tests.outcome import fails_with, refuses

TOLERANCE_MM = 1e-9
"""Rounding: three products of coordinates below 1e4 mm lose about 1e4 · 1e-16 · 10 = 1e-11 mm."""
length_mm = st.floats(-1000, 1000)
vectors = st.tuples(length_mm, length_mm, length_mm).map(np.array)
unit = st.floats(-1, 1)


@st.composite
def rotation_vectors(draw, max_angle_rad=3.1):
    axis = np.array(draw(st.tuples(unit, unit, unit)))
    assume(np.linalg.norm(axis) > 0.1)
    return axis / np.linalg.norm(axis) * draw(st.floats(0, max_angle_rad))


rigids = st.builds(lambda w, t: Rigid.exp(np.concatenate([w, t])), rotation_vectors(), vectors)
similarities = st.builds(Similarity, st.floats(0.1, 10), rigids)


def near(of) -> dict[str, float]:
    # With scales up to 100 and translations up to 1e5: 100 times the rounding above.
    return {"rtol": 0, "atol": TOLERANCE_MM} if isinstance(of, Rigid) else {"rtol": 1e-12, "atol": 100 * TOLERANCE_MM}


def assert_same(one, other):
    np.testing.assert_allclose(one.matrix(), other.matrix(), **near(one))


@pytest.mark.parametrize(("kind", "one"), [(rigids, Rigid()), (similarities, Similarity(1.0, Rigid()))])
@given(data=st.data())
def test_transforms_are_a_group(kind, one, data):
    a_from_b, b_from_c, c_from_d = (data.draw(kind) for _ in range(3))
    assert_same((a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d))
    for same in (a_from_b @ one, one @ a_from_b):
        assert_same(same, a_from_b)
    for same in (a_from_b @ a_from_b.inverse(), a_from_b.inverse() @ a_from_b):
        assert_same(same, one)


@pytest.mark.parametrize(("left", "right"), [(rigids, rigids), (similarities, rigids), (rigids, similarities)])
@given(data=st.data())
def test_composition_acts_as_one_after_the_other(left, right, data):
    a_from_b, b_from_c, xyz = data.draw(left), data.draw(right), data.draw(vectors)
    both = a_from_b @ b_from_c
    np.testing.assert_allclose(both @ xyz, a_from_b @ (b_from_c @ xyz), **near(both))
    np.testing.assert_allclose(a_from_b.inverse() @ (a_from_b @ xyz), xyz, **near(a_from_b))


@given(rotation_vectors(), vectors)
def test_exp_and_log_are_inverse_below_half_a_turn(w, t):
    twist = np.concatenate([w, t])
    a_from_b = Rigid.exp(twist)
    np.testing.assert_allclose(a_from_b.log(), twist, atol=1e-9)  # near π, log loses about half the digits of π − θ
    assert a_from_b.angle_rad() == pytest.approx(np.linalg.norm(w), abs=1e-7)  # arccos near 0: √ε


@given(rigids)
def test_matrix_round_trip(a_from_b):
    for matrix in (a_from_b.matrix(), a_from_b.matrix()[:3]):
        assert_same(Rigid.from_matrix(matrix), a_from_b)


def test_quarter_turn_by_hand_and_fields_are_read_only_copies():
    a_from_b = Rigid.exp([0, 0, np.pi / 2, 10, 20, 30])
    np.testing.assert_allclose(a_from_b @ [1.0, 0, 0], [10, 21, 30], atol=1e-14)
    np.testing.assert_allclose(a_from_b.inverse() @ [10, 21, 30], [1, 0, 0], atol=1e-14)
    assert (a_from_b @ np.zeros((4, 5, 3))).shape == (4, 5, 3)
    np.testing.assert_allclose(Similarity(2.0, a_from_b) @ [1.0, 0, 0], [10, 22, 30], atol=1e-14)
    rotation = np.eye(3)
    a_from_b = Rigid(rotation)
    rotation[0, 0] = 5
    assert a_from_b.rotation[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        a_from_b.translation[0] = 1
    with pytest.raises(AttributeError):
        a_from_b.translation = np.ones(3)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(skew(np.array([[v, w]])) @ w, [[np.cross(v, w), np.zeros(3)]], atol=1e-9)  # up to 1e6
    np.testing.assert_array_equal(skew(v), -skew(v).T)


def test_products_of_accepted_rotations_are_accepted_and_the_rounding_of_a_text_file_repaired():
    # Seven printed digits: each factor passes the 1e-6 check; unprojected, the third product would not.
    rotation = np.eye(3) * (1 + 4e-7)
    product = Rigid(rotation)
    for _ in range(10):
        product = product @ Rigid(rotation)
    np.testing.assert_allclose(product.rotation @ product.rotation.T, np.eye(3), atol=1e-12)
    exact = Rigid.exp([0.3, -0.2, 0.9, 1, 2, 3])
    repaired = Rigid.from_matrix(np.round(exact.matrix(), 4))
    error = np.abs(repaired.rotation - exact.rotation).max()
    assert 0 < error < 1e-4  # four decimals were lost, and no more than that comes back
    np.testing.assert_allclose(repaired.rotation @ repaired.rotation.T, np.eye(3), atol=1e-14)


def _changed(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (Rigid, (np.diag([1.0, 1, -1]), np.zeros(3)), "E-ROTATION-IMPROPER"),
        (Rigid, (np.eye(3) * 1.0001, np.zeros(3)), "E-ROTATION-IMPROPER"),
        (Rigid, (np.full((3, 3), np.nan), np.zeros(3)), "E-ARRAY-NOT-FINITE … rotation"),
        (Rigid, (np.eye(4), np.zeros(3)), "E-ARRAY-SHAPE … rotation … (4 … 4)"),
        (Rigid, (np.eye(3), np.zeros(2)), "E-ARRAY-SHAPE … translation … (2,)"),
        (Rigid, (np.eye(3), [0, np.inf, 0]), "E-ARRAY-NOT-FINITE … translation"),
        (Rigid.from_matrix, (np.eye(3),), "E-ARRAY-SHAPE … (3, 3)"),
        (Rigid.from_matrix, (np.diag([1.0, 1, -1, 1]),), "E-ROTATION-IMPROPER"),
        (Rigid.from_matrix, (np.diag([2.0, 2, 2, 1]),), "E-ROTATION-IMPROPER"),
        (Rigid.from_matrix, (np.diag([0.0, 0, 0, 1]),), "E-ROTATION-IMPROPER"),
        (Rigid.from_matrix, (_changed(0, 3, np.nan),), "E-ARRAY-NOT-FINITE"),
        # the translation in the last row: the row-vector convention
        (Rigid.from_matrix, (_changed(3, 0, 100.0),), "E-MATRIX-LAST-ROW"),
        (Rigid.from_matrix, (_changed(3, 3, 0.0),), "E-MATRIX-LAST-ROW"),
        *((Similarity, (scale, Rigid()), "E-SCALE-VALUE") for scale in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_what_is_no_transform_is_refused(make, given, message):
    refuses(message, make, *given)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 2.0, np.pi - 1e-3])
def test_sigma_of_a_rotation_vector_are_those_of_its_components(angle):
    rng = np.random.default_rng(3)
    axis = rng.normal(size=3)
    pose = Rigid.exp([*(angle * axis / np.linalg.norm(axis)), 1.0, 2.0, 3.0])
    root = rng.normal(size=(6, 6)) * 1e-3
    step = 1e-6
    turned = [Rigid.exp(step * e) @ replace(pose, translation=np.zeros(3)) for e in np.eye(6)[:3]]
    jacobian = (np.array([each.log()[:3] for each in turned]) - pose.log()[:3]).T / step
    expected = np.sqrt(np.diag(jacobian @ (root @ root.T)[:3, :3] @ jacobian.T))
    np.testing.assert_allclose(pose.log_sigma(root @ root.T)[:3], expected, rtol=1e-4)
    np.testing.assert_allclose(pose.log_sigma(root @ root.T)[3:], np.sqrt(np.diag(root @ root.T)[3:]))


def drawn(pose: UncertainRigid, count: int, rng) -> Poses:
    return Poses.of([pose.rigid] * count).moved(rng.multivariate_normal(np.zeros(6), pose.covariance, count))


def test_the_covariance_of_a_product_is_that_of_drawn_products_and_exact_poses_stay_exact():
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
    step, pose = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]), Rigid.exp([0.4, 0.5, -0.6, 7, 8, 9])
    moved = Rigid(Rigid.exp([*step[:3], 0, 0, 0]).rotation @ pose.rotation, pose.translation + step[3:])
    np.testing.assert_allclose(moved.difference(pose), step, atol=1e-12)
    one = UncertainRigid.exact(Rigid(np.eye(3), [1.0, 2.0, 3.0]))
    assert ((one @ one).covariance == 0).all()
    assert (one @ one).rigid.translation.tolist() == [2.0, 4.0, 6.0]


def cloud(seed: int, n: int = 6, flat: bool = False) -> np.ndarray:
    xyz = np.random.default_rng(seed).uniform(-100, 100, (n, 3))
    if flat:
        xyz[:, 2] = 0
    return xyz


def random_rigid(seed: int) -> Rigid:
    rng = np.random.default_rng(seed + 10_000)
    return Rigid(Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.uniform(-1000, 1000, 3))


@given(st.integers(0, 9999), st.booleans(), st.integers(3, 9), st.floats(1e-3, 1e3))
def test_the_truth_comes_back(seed, flat, n, scale):
    truth, xyz_b = random_rigid(seed), cloud(seed, n, flat)
    # Rounding of coordinates of 1000 mm is 1e-13 mm; thin triangles magnify it.
    np.testing.assert_allclose(align_rigid(truth @ xyz_b, xyz_b) @ xyz_b, truth @ xyz_b, atol=1e-9)
    scaled, xyz_b = Similarity(scale, truth), cloud(seed, 6, flat)
    found = align_similarity(scaled @ xyz_b, xyz_b)
    # 1000 mm of translation on points of 0.1 mm at the smallest scale: 1e-13 / 0.1, and a margin of 1000.
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found @ xyz_b, scaled @ xyz_b, rtol=1e-9, atol=1e-9)


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


def test_similarity_is_the_minimum_that_a_general_optimiser_finds_and_no_reflection():
    rng = np.random.default_rng(5)
    xyz_b, weights = cloud(5, 7), rng.uniform(0.5, 2, 7)
    xyz_a = Similarity(1.7, random_rigid(5)) @ xyz_b + rng.normal(0, 5, (7, 3))
    found = align_similarity(xyz_a, xyz_b, weights)

    def cost(p):
        candidate = Similarity(found.scale * np.exp(p[6]), Rigid.exp(p[:6]) @ found.rigid)
        return float(weights @ ((candidate @ xyz_b - xyz_a) ** 2).sum(1))

    best = minimize(cost, np.full(7, 0.01), method="BFGS", options={"gtol": 1e-6})
    assert cost(np.zeros(7)) == pytest.approx(best.fun, rel=1e-9)  # neither may be lower than the other
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
    refuses(message, align, xyz_a, xyz_b, weights)


def test_an_affine_transform_is_inverted():
    one, points = Affine([[2, 1, 0], [0, 1, 0], [0, 0, 3.0]], [1, 2, 3]), cloud(0, 4)
    np.testing.assert_allclose(one.inverse() @ (one @ points), points, atol=1e-12)
    refuses("E-AFFINE-SINGULAR", Affine(np.ones((3, 3)), np.zeros(3)).inverse)


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
    "correlation of 9": (with_entry(3, 4, 9.0), "E-COVARIANCE-VALUE … correlation 9 of x and y, −1 to 1"),
    "correlation over 1": (with_entry(0, 5, -1.01), "E-COVARIANCE-VALUE … correlation -1.01 of rx and z"),
    "not symmetric": (with_entry(0, 1, 0.5) + with_entry(0, 1, 0.06, both=False), "E-COVARIANCE-VALUE … 10.7"),
    "one side only": (with_entry(4, 2, 0.5, both=False), "E-COVARIANCE-VALUE … 100"),
    "not together": (without_a_reason_in_pairs(), "E-COVARIANCE-VALUE … -0.2 … 0"),
    "covariance without variance": (without_variance(), "E-COVARIANCE-VALUE … of x and y, −1 to 1"),
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


def test_a_covariance_of_what_has_no_variance_is_refused():
    infinite = np.array([[0, 1e10], [1e10, 0]])
    refuses("E-COVARIANCE-VALUE … inf of x and y, −1 to 1", require_covariance, infinite, 2, OF_PIXEL)


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
    refuses("E-COVARIANCE-VALUE … 1.00009 of rx and ry", require_covariance, high, 6, OF_POSE)
    stack = np.tile(np.diag(SIGMA**2), (5, 1, 1))
    assert first_fault(stack, OF_POSE, definite=True) is None
    stack[2, 5, 5] = stack[4, 5, 5] = 0
    assert first_fault(stack, OF_POSE) is None
    fault = first_fault(stack, OF_POSE, definite=True)
    assert fault is not None
    assert fault.row == 2
    assert fault.reason == "variance 0 of z, a positive number needed (and 1 more)"
    assert first_fault(stack[:0], OF_POSE, definite=True) is None
