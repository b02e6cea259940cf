"""One group: its free network against the same equations in full, score tests, weights, and λ from the board. Rims in
front of circles, from the change of their radii with tilt, and faces of the surface behind them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtrc

from stcal.boards.board_file import board_toml, load_board
from stcal.boards.target_file import load_target, target_toml
from stcal.design import BoardDesign, reference_board
from stcal.geometry.rigid import Rigid, skew
from stcal.labels import CircleLabel, DotLabel
from stcal.sfm.adjust import equations
from stcal.sfm.adjust.equations import GroupPart, Setting
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.refine import adjust, find_scale, free_network, solve_score
from stcal.sfm.adjust.rims import RadiusViews, Rim, _rim, find_rims, lost_radius_mm
from stcal.sfm.checks.board_checks import rim_check
from stcal.sfm.data.group_model import WorldModel
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.labelling import label_single
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.render import RenderOptions, render
from tests.levels import sampled
from tests.outcome import fails_with

NOISE_PX, FACTOR = 0.01, 1.3
DRAWS = 1000


def jacobian_of(model, camera) -> np.ndarray:
    """(2n, 6m + 3p) of the projections over σ by poses, a turn from the left and a shift, and points: differences."""
    m = len(model.images)

    def projected(step):
        poses = tuple(
            Rigid(Rigid.exp([*s[:3], 0, 0, 0]).rotation @ pose.rotation, pose.translation + s[3:])
            for s, pose in zip(step[: 6 * m].reshape(m, 6), model.camera_from_model, strict=True)
        )
        moved = replace(model, camera_from_model=poses, xyz_model=model.xyz_model + step[6 * m :].reshape(-1, 3))
        return moved.whiten(camera.project(moved.xyz_camera()))

    steps = 1e-6 * np.eye(6 * m + 3 * len(model.labels))
    return np.column_stack([(projected(s) - projected(-s)).ravel() / 2e-6 for s in steps])


@pytest.fixture(scope="module")
def group(labels_only, small_scene):
    """An adjusted group of four images, mm, and its camera."""
    observed = labels_only.observations(small_scene, NOISE_PX, np.random.default_rng(2))
    return labels_only.adjusted(small_scene, observed)[0], small_scene.camera


@pytest.fixture(scope="module")
def network(group):
    model, camera = group
    return free_network(replace(model, covariance_px2=FACTOR**2 * model.covariance_px2), camera)


@pytest.fixture(scope="module")
def full(group):
    """Dense Jacobian over σ, and the cofactors of all unknowns with inner constraints on the points."""
    model, camera = group
    model = replace(model, covariance_px2=FACTOR**2 * model.covariance_px2)
    jacobian = jacobian_of(model, camera)
    middle = model.xyz_model - model.xyz_model.mean(0)
    size, p = jacobian.shape[1], len(middle)
    free = np.zeros((size, 7))
    free[-3 * p :] = np.concatenate(
        [-skew(middle), np.broadcast_to(np.eye(3), (p, 3, 3)), middle[:, :, None]], axis=2
    ).reshape(-1, 7)
    bordered = np.block([[jacobian.T @ jacobian, free], [free.T, np.zeros((7, 7))]])
    return jacobian, np.linalg.inv(bordered)[:size, :size]


def test_covariance_and_redundancy_are_those_of_the_full_equations_and_squares_are_chi_square(network, full, group):
    """Diagonal of 1 − J C Jᵀ, both coordinates of an observation; in all, what is not unknown. Of 1000 draws of noise
    as many are beyond the quantile of one in a thousand as there should be."""
    p = 3 * len(group[0].labels)
    scale = np.sqrt(np.diag(network.covariance_mm2))
    np.testing.assert_allclose(
        network.covariance_mm2 / np.outer(scale, scale), full[1][-p:, -p:] / np.outer(scale, scale), atol=1e-5
    )
    np.testing.assert_array_equal(network.covariance_of([3, 1])[3:, :3], network.covariance_mm2[3:6, 9:12])
    jacobian, cofactors = full
    own = 1 - np.einsum("ij,jk,ik->i", jacobian, cofactors, jacobian)
    np.testing.assert_allclose(network.redundancy, own.reshape(-1, 2).sum(1), atol=1e-6)
    assert network.redundancy.sum() == pytest.approx(len(jacobian) - (jacobian.shape[1] - 7), abs=1e-5)
    square, redundancy = network.square_by_image()
    assert square.sum() == pytest.approx((network.residual**2).sum())
    assert redundancy.sum() == pytest.approx(network.redundancy.sum())
    assert len(square) == len(group[0].images)
    assert network.noise() == 1.0  # σ that are as stated are never made smaller
    assert replace(network, residual=3 / FACTOR * network.residual).noise() > 1.0
    jacobian, cofactor = full
    projector = np.eye(len(jacobian)) - jacobian @ cofactor @ jacobian.T
    rng, beyond, count = np.random.default_rng(4), 0, 0
    for _ in range(DRAWS):
        residual = (projector @ rng.standard_normal(len(jacobian))).reshape(-1, 2)
        drawn = replace(network, residual=residual)
        square, freedom = drawn.squares_of_observations()
        held = freedom > 0
        beyond += int((chdtrc(freedom[held], square[held]) < 1e-3).sum())
        count += int(held.sum())
    assert 0.8 < beyond / (1e-3 * count) < 1.25


def test_scores_are_estimates_beside_all_others_and_find_a_fault_where_it_is(network, full, group):
    """By the general equations, and by those of one image of one parameter for each of its coordinates. One image's
    focal length 1e-3 longer is eleven times its σ there."""
    model, rng = group[0], np.random.default_rng(0)
    column = rng.normal(size=(len(model.image_index), 2, 1))
    test = solve_score(*network.score(column))
    wider = np.column_stack([full[0], column.reshape(-1)])
    estimate = np.linalg.lstsq(wider, network.residual.reshape(-1), rcond=1e-9)[0][-1]
    left = column.reshape(-1) - full[0] @ np.linalg.lstsq(full[0], column.reshape(-1), rcond=1e-9)[0]
    assert test.covariance[0, 0] == pytest.approx(1 / (left @ left), rel=1e-4)
    assert test.estimate[0] == pytest.approx(estimate, rel=1e-3, abs=1e-4 * np.sqrt(test.covariance[0, 0]))
    assert test.freedom == 1
    assert test.statistic == pytest.approx(test.estimate[0] ** 2 / test.covariance[0, 0])
    image = 3
    rows = np.flatnonzero(network.model.image_index == image)
    k = np.arange(len(rows))
    columns = np.zeros((len(network.residual), 2, 2 * len(rows)))
    columns[rows, 0, k] = columns[rows, 1, len(rows) + k] = 1
    normal, right = network.score_of_image(image)
    general = network.score(columns)
    np.testing.assert_allclose(normal, general[0], atol=1e-9)
    np.testing.assert_allclose(right, general[1], atol=1e-9)
    normal = np.array([[2.0, 2.0], [2.0, 2.0]])
    test = solve_score(normal, np.array([1.0, 1.0]))
    assert test.freedom == 1
    assert test.statistic == pytest.approx(0.5)
    assert normal @ test.estimate == pytest.approx([1.0, 1.0])
    model, camera = group
    image = 1
    own = model.image_index == image
    stretched = model.measured_px.copy()
    stretched[own] += 1e-3 * (stretched[own] - camera.centre)
    network = free_network(adjust(replace(model, measured_px=stretched), camera), camera)
    columns = network.model.whiten(network.model.corrected_px() - camera.centre)[:, :, None]
    normal, right = network.score_by_image(columns)
    statistics = [solve_score(n, r).statistic for n, r in zip(normal, right, strict=True)]
    assert np.argmax(statistics) == image
    assert solve_score(normal[image], right[image]).estimate[0] == pytest.approx(1e-3, rel=0.05)


def test_weights_are_hubers_and_costs_are_theirs_and_those_of_dots_off_their_design(group):
    """Weight 1 within the limit and limit/length beyond; the cost's derivative by a residual is 2 w r."""
    model, camera = group
    far = model.measured_px.copy()
    far[5] += [1.0, 0.0]
    model = replace(model, measured_px=far)
    length = np.linalg.norm(equations.normalised(model, camera), axis=1)
    weights = equations.robust_weights(model, camera, 4.0)
    assert weights[5] == pytest.approx(4 / length[5])
    assert (weights[length < 4] == 1).all()

    def cost(shift: float) -> float:
        changed = far.copy()
        changed[5, 0] += shift
        return equations.image_cost(replace(model, measured_px=changed), camera, 4.0)

    gradient = (cost(1e-4) - cost(-1e-4)) / 2e-4
    by_x = model.whiten(np.tile([1.0, 0.0], (len(far), 1)))[5]
    turned = tuple(Rigid.exp([np.pi, 0, 0, 0, 0, 0]) @ pose for pose in model.camera_from_model)
    assert equations.image_cost(replace(model, camera_from_model=turned), camera, 4.0) == np.inf  # behind them
    assert gradient == pytest.approx(2 * weights[5] * by_x @ equations.normalised(model, camera)[5], rel=1e-5)
    model, camera = group
    (dot_rows,) = np.nonzero([isinstance(label, DotLabel) for label in model.labels])
    (circle_rows,) = np.nonzero([isinstance(label, CircleLabel) for label in model.labels])
    labels = tuple(model.labels[i] for i in circle_rows)

    def cost(off_mm: np.ndarray) -> float:
        own = GroupPart(
            model=model,
            model_from_board=Rigid(),
            design=model.xyz_model[dot_rows] + off_mm,
            dots=dot_rows,
            circles=circle_rows,
            cells=np.arange(len(dot_rows)),
            circle_place=np.arange(len(circle_rows)),
        )
        board = BoardDesign(10, 10, 20.0, 5.0, "bright", sigma_mm=0.02)
        setting = Setting((own,), labels, board, 0.0, np.inf, camera, np.zeros((16, 0)), np.zeros((0, 0)), np.inf)
        values = setting.values(model.xyz_model[circle_rows], camera)
        return setting.joined(values).cost(values)

    off = np.random.default_rng(0).normal(0, 0.05, (len(dot_rows), 3))
    assert cost(off) - cost(0 * off) == pytest.approx((off**2).sum() / 0.02**2, rel=1e-6)


BOARD = reference_board()
WORLD_FROM_BOARD = Rigid.exp([0.4, -0.2, 0.9, 3.0, 1.0, 20.0])


def model_of(xyz_board, labels, mm_per_unit=25.0):
    xyz = (WORLD_FROM_BOARD @ xyz_board) / mm_per_unit
    none, pairs = np.zeros(0), np.zeros((0, 2))
    return WorldModel("g", (), (), tuple(labels), xyz, none, none, none, pairs, pairs, np.zeros((0, 2, 2)))


def board_xyz():
    return np.column_stack([BOARD.xy_mm(), np.zeros(63)])


def test_scales_are_exact_without_noise_and_follow_the_boards_sigma():
    for missing in (0, 5):
        keep = [i for i in range(63) if not missing or i % missing]
        scale = find_scale(model_of(board_xyz()[keep], [BOARD.labels()[i] for i in keep]), BOARD)
        assert scale.mm_per_unit == pytest.approx(25.0, rel=1e-12)
        # The mean over pairs, 2/(n(n−1)): the printed 1/(n−1)! would give a number near zero.
        assert scale.rows_mm_per_unit == pytest.approx(25.0, rel=1e-12)
        assert scale.rows == (0, 6)
        assert scale.rms_mm() < 1e-10
    xyz = board_xyz()
    xyz[9:54] += np.random.default_rng(0).normal(0, 1, (45, 3))  # the rows between are far off
    scale = find_scale(model_of(xyz, BOARD.labels()), BOARD)
    assert scale.rows_mm_per_unit == pytest.approx(25.0, rel=1e-12)
    assert abs(scale.mm_per_unit / 25 - 1) > 1e-6
    rng = np.random.default_rng(0)
    ratios, residuals = [], []
    for _ in range(300):
        scale = find_scale(model_of(board_xyz() + rng.normal(0, 0.005, (63, 3)), BOARD.labels()), BOARD)
        ratios.append((scale.mm_per_unit / 25 - 1) / (scale.sigma_mm_per_unit / scale.mm_per_unit))
        residuals.append(scale.rms_mm())
    assert 0.85 < np.std(ratios) < 1.15  # 300 draws: ± 4 %
    # 189 coordinates less 7 parameters: 5 µm · √3 · √(182/189).
    assert np.mean(residuals) == pytest.approx(0.0085, rel=0.03)
    for keep, reason in ((range(3), "E-SCALE-FEW-DOTS … 3 … 4"), (range(9), "E-SCALE-COLLINEAR")):
        labels = [BOARD.labels()[i] for i in keep]
        with fails_with(reason):
            find_scale(model_of(board_xyz()[list(keep)], labels), BOARD)


@pytest.fixture(scope="module")
def scene(small_scene):
    return small_scene


def rim_of(short, tangent, radius, blur, image) -> Rim:
    """The rim of 240 circles whose light is even."""
    none, index = np.zeros(240), np.arange(240)
    return _rim(RadiusViews(index, image, radius, 1 + short / radius, none, blur, tangent, np.zeros((240, 2)), none))


def rims_of(scene, rim_mm, **look):
    images = []
    for i in range(4):
        picture = render(scene, "12", i, RenderOptions(seed=5, rim_mm=rim_mm, clutter=False, **look))
        found = detect_image(picture, scene.camera, scene.target, None, EllipseOptions())
        images.append(label_single(f"12/{i:04d}", "12", found, scene.target).observations)
    radius = scene.target.radius_of() | scene.board.radius_of()
    return find_rims(true_models(scene, images), images, radius, scene.camera)


@pytest.mark.parametrize("rim_mm", sampled([0.3, 0.15]))
def test_the_height_of_a_rim_is_found(scene, rim_mm):
    """Within 10 %, as the area of the lens-shaped image is that of an ellipse to second order alone, and within 3 σ."""
    rim = rims_of(scene, rim_mm)["circles"]
    assert rim.height_mm == pytest.approx(rim_mm, abs=0.1 * rim_mm + 3 * rim.sigma_mm)
    assert rim.height_mm > 4 * rim.sigma_mm
    check = rim_check({"circles": rim}, 0.002, {})
    assert check.verdict == "suspicious"
    assert "in front of the luminous surface" in check.reason
    assert rim_check({"circles": rim}, 0.002, {"circles": rim_mm}).verdict == "passed"


@pytest.mark.parametrize("look", sampled([{}, {"fade": 0.25}, {"fade": 0.25, "blur_px": 1.2}], kept=(2,)))
def test_no_rim_is_found_where_there_is_none(scene, look):
    """Nor where discs have a quarter less light at their rim, which makes them look smaller."""
    rims = rims_of(scene, 0.0, **look)
    assert abs(rims["circles"].height_mm) < 3 * rims["circles"].sigma_mm
    assert rim_check(rims, 0.002, {}).verdict == "passed"


def test_rims_that_harm_nothing_are_no_fault_need_the_joint_adjustment_and_are_stated_by_designs(scene, tmp_path):
    """It is seen with certainty, and moves faces by less than their σ."""
    assert rim_check({}, 0.002, {}).verdict == "not possible"
    assert rim_check({"circles": Rim(0.02, 0.001, 500)}, 0.02, {}).verdict == "passed"
    assert rim_check({"circles": Rim(0.02, 0.001, 500)}, 0.002, {}).verdict == "suspicious"
    for options, refusal in (
        ({"solve": "chain", "rim": True}, "E-RIM-SOLVE … --solve joint"),
        ({"solve": "paper", "rim": True}, "E-RIM-SOLVE … --solve joint"),
        ({"solve": "chain", "refine_camera": True}, "E-OPTION-NEEDS … --solve"),
    ):
        with fails_with(refusal):
            RunOptions(**options).settled(scene.target)
        assert RunOptions(rim=True).settled(scene.target).rim
    face = scene.target.faces[0]
    heights = np.where(np.arange(len(face.ids)) == 2, -0.1, 0.25)
    target = replace(scene.target, faces=(replace(face, rim_mm=heights), *scene.target.faces[1:]))
    (tmp_path / "target.toml").write_text(target_toml(target), encoding="utf-8")
    read = load_target(tmp_path / "target.toml")
    np.testing.assert_array_equal(read.faces[0].rim_mm, heights)
    assert read.faces[1].rim_mm is None
    assert read.rim_of() == dict(zip(face.labels(), heights.tolist(), strict=True))
    board = replace(scene.board, rim_mm=0.3)
    (tmp_path / "board.toml").write_text(board_toml(board), encoding="utf-8")
    assert load_board(tmp_path / "board.toml").rim_mm == 0.3
    rims = {"dots": Rim(0.31, 0.01, 500)}
    assert "the board lies 0.155 mm in front of" in rim_check(rims, 0.002, {}).reason
    passed = rim_check(rims, 0.002, {"dots": board.rim_mm})
    assert passed.verdict == "passed"
    assert "0.3 mm stated" in passed.reason


def test_a_rim_hides_what_is_not_in_common_of_two_discs_and_rims_of_dots_move_the_board_alone(scene):
    """Of the radius by area. That of the fit, which follows the rim, is less by up to 2 %."""
    apart = np.array([0.05, 0.1, 0.15])
    area = 2 * np.arccos(apart / 2) - apart / 2 * np.sqrt(4 - apart**2)
    np.testing.assert_allclose(lost_radius_mm(0.1, 10 * 5.0 * apart, 5.0) / 5.0, 1 - np.sqrt(area / np.pi), rtol=0.02)
    models = true_models(scene, observe(scene, 0.01, np.random.default_rng(0)))
    seen, surface = (adjusted(models, replace(scene.board, rim_mm=h), scene.camera).result() for h in (0.0, 0.3))
    np.testing.assert_allclose(surface.xyz_model, seen.xyz_model, atol=1e-6)
    moved = surface.model_from_board["12"].translation - seen.model_from_board["12"].translation
    np.testing.assert_allclose(moved, 0.15 * seen.model_from_board["12"].rotation[:, 2], atol=1e-6)


def test_a_blur_corrected_by_too_little_is_no_rim_and_errors_common_to_an_image_are_in_sigma():
    """Radii that blur makes smaller, by a fifth more than is put back, in views of other tilts and distances. Then
    twelve images of one tilt each, of 20 circles: a common error as large as that of single circles. With σ of
    independent circles, and the least σ of a rim, the mean square is 2.6."""
    for height_mm in (0.0, 0.05):
        rng = np.random.default_rng(3)
        tangent, distance = rng.uniform(0.1, 2.0, 240), rng.uniform(0.8, 1.4, 240)
        radius = np.where(np.arange(240) % 2, 4.0, 8.0)
        blur = 0.02 * distance**2 / radius * 6 * np.sqrt(1 + tangent**2)
        noise = rng.normal(0, 0.003, 240)
        short = noise + 0.2 * blur - lost_radius_mm(height_mm, tangent, radius)
        rim = rim_of(short, tangent, radius, blur, np.arange(240))
        assert rim.height_mm == pytest.approx(height_mm, abs=2.5 * rim.sigma_mm)
        assert 0.003 < rim.sigma_mm < 0.0125  # of 0.05 mm at four σ
    rng, normed = np.random.default_rng(5), []
    for _ in range(100):
        image = np.repeat(np.arange(12), 20)
        tangent, common = rng.uniform(0.1, 2.0, 12)[image], rng.normal(0, 0.003, 12)[image]
        rim = rim_of(common + rng.normal(0, 0.003, 240), tangent, np.full(240, 8.0), np.zeros(240), image)
        normed.append(rim.height_mm / rim.sigma_mm)
    assert 0.5 < np.mean(np.square(normed)) < 2.0
    assert np.mean(np.abs(normed) > 4) <= 0.01
