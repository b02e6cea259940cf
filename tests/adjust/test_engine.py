"""The engine of least squares, against dense algebra, solutions made again, and the one-way analysis of variance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.adjust import Adjustment, Huber, Vector
from stcal.adjust.blocks import component_variances
from stcal.errors import InputError
from stcal.geometry.rigid import Poses, by_pose, perspective
from tests.outcome import refuses

SIGMA, IMAGES, POINTS = 0.002, 6, 12


def problem(eliminate: str, rng, loss: Huber | None = None, numerical: bool = False, sigma: float = SIGMA):
    """Poses of a camera of unknown focal length that see points, of which three are fixed; one of both eliminated."""
    xyz = np.column_stack([rng.uniform(-1, 1, (POINTS, 3))])
    turn = Rotation.from_rotvec(0.3 * rng.standard_normal((IMAGES, 3))).as_matrix()
    poses = Poses(turn, np.tile([0, 0, 4.0], (IMAGES, 1)))
    image, point = (index.ravel() for index in np.indices((IMAGES, POINTS)))

    def at(poses, points):
        return (poses.rotation[image] @ points.array[point, :, None])[..., 0] + poses.translation[image]

    def seen(poses, points, focal):
        return focal.array * perspective(at(poses, points))[0]

    truth = seen(poses, Vector(xyz), Vector(np.ones((1, 1))))
    noisy = truth + sigma * rng.standard_normal(truth.shape)

    def slopes(poses, points, focal):
        xyz = at(poses, points)
        ideal, by_xyz = perspective(xyz)
        turned = xyz - poses.translation[image]
        by_xyz = focal.array[0] * by_xyz
        return by_pose(by_xyz, turned), by_xyz @ poses.rotation[image], ideal[:, :, None]

    a = Adjustment()
    pose = a.block("pose", poses, eliminate=eliminate == "pose")
    off = 0.001 * rng.standard_normal(xyz.shape) * (np.arange(POINTS) > 2)[:, None]
    points = a.block("point", Vector(xyz + off), eliminate=eliminate == "point", fixed=[0, 1, 2])
    focal = a.block("focal", Vector(np.ones((1, 1))))
    on = [(pose, image), (points, point), (focal, None)]
    by = None if numerical else slopes
    a.factor(lambda *v: seen(*v) - noisy, on, sigma, by, kind="centres", cluster=image, loss=loss)
    if eliminate != "point":
        a.prior(points, xyz, np.eye(3 * POINTS) / 0.05**2)
    return a


def dense(solution) -> np.ndarray:
    """The Jacobian of all rows by kept and eliminated unknowns, from the rows' derivatives."""
    (rows,) = solution.rows
    blocks = sorted(solution.problem.blocks, key=lambda each: each.eliminate)
    sizes = [len(block.start) * block.start.dim for block in blocks]
    starts = dict(zip((block.name for block in blocks), np.cumsum([0, *sizes]), strict=False))
    full = np.zeros((*rows.residual.shape, sum(sizes)))
    for (block, members), slope in zip(rows.factor.on, rows.slopes, strict=True):
        first = starts[block.name] + block.start.dim * (np.zeros(len(slope), int) if members is None else members)
        for r in range(len(slope)):
            full[r, :, first[r] : first[r] + block.start.dim] += slope[r]
    return full


@pytest.fixture(params=["", "pose"])
def solution(request):
    return problem(request.param, np.random.default_rng(1)).solve()


def test_the_answer_depends_neither_on_what_is_eliminated_nor_on_how_derivatives_are_made():
    kinds = ("", False), ("pose", False), ("pose", True)
    one, two, three = (problem(own, np.random.default_rng(1), numerical=n).solve() for own, n in kinds)
    for name in ("point", "focal"):
        assert one.values[name].array == pytest.approx(two.values[name].array, abs=1e-5 * SIGMA)
        assert two.values[name].array == pytest.approx(three.values[name].array, abs=1e-4 * SIGMA)
    focal = [next(b for b in s.problem.blocks if b.name == "focal") for s in (one, two)]
    assert one.covariance(focal[0]) == pytest.approx(two.covariance(focal[1]), rel=1e-6)


def test_covariance_and_redundancy_are_those_of_dense_algebra(solution):
    jacobian = dense(solution)
    flat = jacobian.reshape(-1, jacobian.shape[2])
    normal = flat.T @ flat
    points = solution.places["point"]
    normal[points, points] += np.eye(3 * POINTS) / 0.05**2
    held = points.start + np.arange(9)
    normal[held], normal[:, held] = 0.0, 0.0
    normal[held, held] = 1.0
    inverse = np.linalg.inv(normal)
    inverse[held, held] = 0.0
    k = solution.kept
    assert solution.inverse == pytest.approx(inverse[:k, :k], rel=1e-6, abs=1e-12)
    assert solution.redundancy("centres") == pytest.approx(len(flat) - np.trace(flat @ inverse @ flat.T), rel=1e-6)
    pose = next(block for block in solution.problem.blocks if block.name == "pose")
    if pose.eliminate:
        own = inverse[k:, k:].reshape(IMAGES, 6, IMAGES, 6)[np.arange(IMAGES), :, np.arange(IMAGES)]
        assert solution.covariance(pose) == pytest.approx(own, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("eliminate", ["", "pose", "point"])
def test_without_a_cluster_it_is_as_if_that_had_not_been_there(eliminate):
    """A cluster is an image: all rows of an eliminated pose, or one of six of an eliminated point. With so little noise
    the problem is linear."""
    sigma = 1e-5
    whole = problem(eliminate, np.random.default_rng(1), sigma=sigma)
    solution = whole.solve()
    stepped = solution.without(3)
    (factor,) = whole.factors
    whole.factors[0] = replace(factor, root=factor.root * np.where(factor.cluster == 3, 1e-9, 1.0))
    again = whole.solve()
    for name in ("focal", "point"):
        before, after, one = (each[name].array for each in (solution.values, again.values, stepped))
        assert np.abs(after - before).max() > 0.1 * sigma  # it moves
        assert np.abs(one - after).max() < 0.01 * np.abs(after - before).max()
    with pytest.raises(InputError, match="no row of cluster 9"):
        again.without(9)


def test_clusters_with_independent_errors_have_the_sigma_of_independent_errors():
    ratios, squares = [], []
    for seed in range(40):
        solution = problem("pose", np.random.default_rng(seed)).solve()
        focal = next(block for block in solution.problem.blocks if block.name == "focal")
        found = solution.by_clusters(focal)
        ratios.append(float(np.sqrt(found.covariance[0, 0] / solution.covariance(focal)[0, 0])))
        squares.append(float((solution.values["focal"].array[0, 0] - 1) ** 2 / found.covariance[0, 0]))
    assert min(ratios) >= 1 - 1e-9
    assert np.mean(ratios) < 1.3  # six clusters: Student's excess
    assert 0.4 < np.mean(squares) < 1.5  # of 40: 1 ± 0.22, less by the excess


def test_a_gross_row_has_no_weight():
    a = problem("pose", np.random.default_rng(1), Huber(3.0, 20.0))
    clean, (factor,) = a.solve(), a.factors
    gross = 0.5 * (np.arange(IMAGES * POINTS) == 7)[:, None]
    a.factors[0] = replace(factor, residuals=lambda *v: factor.residuals(*v) + gross)
    spoiled = a.solve()
    assert spoiled.rows[0].weight[7] == 0
    assert spoiled.values["focal"].array == pytest.approx(clean.values["focal"].array, abs=clean.inverse[-1, -1] ** 0.5)


def test_the_sigma_of_a_kind_is_found():
    a = problem("pose", np.random.default_rng(1))
    a.sigma["centres"] = 0.2
    solution = a.solve()
    # 144 coordinates less 64 unknowns: σ of a σ is 8 %
    assert 0.2 * solution.component("centres") == pytest.approx(1.0, abs=0.25)


def test_mistakes_are_named():
    a = Adjustment()
    x = a.block("x", Vector(np.zeros((1, 1))), eliminate=True)
    with pytest.raises(InputError, match="block x: another one has this name"):
        a.block("x", Vector(np.zeros((1, 1))))
    with pytest.raises(InputError, match="eliminated"):
        a.block("y", Vector(np.zeros((1, 1))), eliminate=True)
    with pytest.raises(InputError, match="its prior must be a factor"):
        a.prior(x, np.zeros((1, 1)), np.eye(1))
    a.factor(lambda v: 1 / v.array, [(x, None)])
    with pytest.raises(InputError, match="not finite at the start"):
        a.solve()
    b = Adjustment()
    y = b.block("y", Vector(np.zeros((1, 1))))
    b.factor(lambda v: v.array - 1, [(y, None)])
    with pytest.raises(InputError, match="no factor has clusters"):
        b.solve().by_clusters(y)
    solution = b.at({"y": y.start})
    vars(solution)["normal"] = np.array([[-1e200]])  # finite; scaled by a diagonal that is not positive, it is not
    refuses("E-NO-MINIMUM … adjustment … not finite … values and σ", solution.step, 0.0)


def test_a_member_that_its_rows_do_not_determine_stays():
    a = Adjustment()
    shift = a.block("shift", Vector(np.zeros((1, 1))))
    points = a.block("points", Vector(np.zeros((3, 2))), eliminate=True)
    x = np.array([1.0, 2.0, 3.0])
    a.factor(lambda s, p: s.array + p.array[:, :1] - x[:, None], [(shift, None), (points, np.arange(3))], 0.1)
    a.factor(lambda s: s.array - 1, [(shift, None)], 0.1)
    found = a.solve().values
    assert found["shift"].array == pytest.approx(1)
    assert found["points"].array == pytest.approx(np.array([[0, 0], [1, 0], [2, 0]]), abs=1e-6)


def test_a_factor_without_rows_changes_nothing():
    a = problem("pose", np.random.default_rng(1))
    before = a.solve().values["focal"].array
    points, none = next(block for block in a.blocks if block.name == "point"), np.zeros(0, int)
    a.factor(lambda own: own.array[none], [(points, none)])
    assert a.solve().values["focal"].array == pytest.approx(before, rel=1e-9)


GROUPS, EACH = 12, 5


def drawn() -> np.ndarray:
    rng = np.random.default_rng(3)
    return 7.0 + rng.normal(0, 0.8, (GROUPS, 1)) + rng.normal(0, 0.5, (GROUPS, EACH))


def analysis(eliminate: bool, sigma: dict[str, float]) -> Adjustment:
    """Values with errors of groups beside their own: the balanced one-way layout."""
    values = drawn().reshape(-1, 1)
    a, group = Adjustment(sigma=sigma), np.repeat(np.arange(GROUPS), EACH)
    mean, own = a.block("mean", Vector(np.zeros((1, 1)))), a.block("group", Vector(np.zeros((GROUPS, 1))), eliminate)
    a.factor(lambda m, g: m.array + g.array[group] - values, [(mean, None), (own, group)], kind="error")
    a.factor(lambda g: np.hstack([g.array, 0 * g.array]), [(own, np.arange(GROUPS))], kind=("between", "none"))
    return a


@pytest.fixture(scope="module")
def grouped():
    """Values (a, n) with errors of groups beside their own, and the closed-form REML variances of both: of errors the
    mean square within, of groups what the mean square between has more, by n (Searle, Casella & McCulloch 1992)."""
    values = drawn()
    middle = values.mean(1, keepdims=True)
    within = ((values - middle) ** 2).sum() / (GROUPS * (EACH - 1))
    between = EACH * ((middle - values.mean()) ** 2).sum() / (GROUPS - 1)
    return values, (within, (between - within) / EACH)


@pytest.mark.parametrize("eliminate", [True, False])
def test_each_kind_has_the_variance_of_the_analysis(grouped, eliminate):
    values, wanted = grouped
    present = {"error": 0.3, "between": 2.0}
    problem = analysis(eliminate, present)
    likelihood = problem.at({block.name: block.start for block in problem.blocks}).components(list(present))
    best = likelihood.best(np.full(2, -5.0), np.full(2, 5.0), [np.zeros(2), np.ones(2)])
    assert (np.array(list(present.values())) * np.exp(best)) ** 2 == pytest.approx(wanted, rel=1e-4)
    assert likelihood.at(best)[2][0] == pytest.approx(values.mean(), rel=1e-8)  # a share of 1e-10 is held


def test_what_is_eliminated_changes_neither_density_nor_gradient():
    x, small = np.array([0.4, -0.3]), 1e-5 * np.eye(2)
    both = []
    for eliminate in (True, False):
        problem = analysis(eliminate, {"error": 0.4, "between": 0.9})
        parts = problem.at({block.name: block.start for block in problem.blocks}).components(["error", "between"])
        both.append(replace(parts, expected=0.7, doubt=2.0, caution=np.array([0.1, 0.2])))
    (value, slope, _, _), (again, same, _, _) = (parts.at(x) for parts in both)
    assert value == pytest.approx(again, rel=1e-8)
    assert slope == pytest.approx(same, rel=1e-8)
    ahead, behind = ([both[0].at(x + sign * step)[0] for step in small] for sign in (1, -1))
    assert slope == pytest.approx((np.array(ahead) - behind) / 2e-5, rel=1e-6)


def test_kinds_tell_together_what_all_do():
    problem = analysis(True, {"error": 0.4, "between": 0.9})
    at = problem.at({block.name: block.start for block in problem.blocks})
    told = sum(at.equations((kind,)).told(at.reduction.from_kept) for kind in ("error", "between", "none"))
    assert told == pytest.approx(at.normal, rel=1e-9)


@pytest.mark.parametrize("bound", [0.0, 3.0])
def test_a_sum_of_components_gives_the_variances_of_the_analysis_within_bounds(grouped, bound):
    values, wanted = grouped
    free = np.broadcast_to(np.array([np.eye(EACH), np.ones((EACH, EACH))])[:, None], (2, GROUPS, EACH, EACH))
    least = np.array([1e-6, max(bound * wanted[1], 1e-6)])
    found = component_variances(
        values - 6.0,
        np.ones((GROUPS, EACH, 2)),  # the second column depends on the first
        np.zeros((GROUPS, EACH, EACH)),
        free,
        least.clip(1),
        (least, np.full(2, 1e3)),
    )
    assert found[0] == pytest.approx(wanted[0], rel=0.05 if bound else 1e-4)
    assert found[1] == pytest.approx(max(wanted[1], least[1]), rel=1e-6 if bound else 1e-4)
