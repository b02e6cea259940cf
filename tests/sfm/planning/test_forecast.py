"""σ before and without photographs: against simulations, against the run's own adjustment, and against simple laws."""

import json
import pickle
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import chi2

from stcal import Camera, Rigid, reference_board, reference_target
from stcal.boards.board_file import save_board
from stcal.boards.target_file import save_target
from stcal.io.cameras.camera_model import CameraModel, CameraPrior, model_of
from stcal.labels import CircleLabel
from stcal.sfm.adjust import equations
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.joint import adjusted, unmoved
from stcal.sfm.data.group_model import MetricModel
from stcal.sfm.detect.defocus import RESPONSE
from stcal.sfm.planning import session
from stcal.sfm.planning.advise import GRID_DEG, KnownRun, PlannedView, advise, candidates, doubts, known_of, known_scene
from stcal.sfm.planning.forecast import (
    BLUR_PX,
    CONTRAST,
    IMAGE_NOISE,
    PRACTICE,
    CentreNoise,
    Forecast,
    PositionsWith,
    Setup,
    forecast,
    nominal_poses,
    observe,
    true_models,
    variance_shares,
)
from stcal.sfm.planning.session import PlanOptions, plan, widest_aperture_mm
from stcal.sfm.runs.saved import load_run
from stcal.synthetic.designs import second_design, tag_cube
from stcal.synthetic.scene import Scene, SceneOptions, make_scene
from tests.outcome import fails_with

pytestmark = pytest.mark.slow

NOISE = CentreNoise(0.1, 3.0)  # of centres: about 0.013 px, so that image and a board of 20 µm matter alike
SLOW = pytest.mark.slow
CHANCE = 1e-4  # of a sound forecast to fall outside the bounds of a χ² test, on either side
SMALL = SceneOptions(
    seed=4, width=2592, height=1728, images_per_group=3, groups=(("1", "2"), ("1", "4")), circle_sigma_mm=0.0
)


@pytest.fixture(scope="module")
def exact() -> Scene:
    """Faces 1, 2 and 4 in two groups of three images; the board as designed."""
    return make_scene(
        SMALL, reference_target(), replace(reference_board(), sigma_mm=0.0), reference_target().rough_poses()
    )


def setup_of(scene: Scene, board_sigma_mm: float = 0.02, common: float = 0.0) -> Setup:
    seen = {face for group in scene.groups.values() for face in group.faces}
    poses = {face: pose for face, pose in scene.target_from_face.items() if face in seen}
    start = CalibratedTarget("1", poses, scene.circles_target, dict.fromkeys(scene.groups, Rigid()))
    board = replace(scene.board, sigma_mm=board_sigma_mm)
    return Setup(scene.target, board, scene.camera, start, "plane", None, None, common)


def models_of(scene: Scene, noise: CentreNoise = NOISE) -> list[MetricModel]:
    radius = scene.target.radius_of() | scene.board.radius_of()
    models = true_models(scene, observe(scene, 0.0, np.random.default_rng(0)))
    return [noise.applied(model, scene.camera, radius) for model in models]


def drawn(models: list[MetricModel], setup: Setup, rng: np.random.Generator) -> list[MetricModel]:
    """The models with dots displaced by the board's σ, one plate or one for each group, and noisy centres."""
    model_from_board = unmoved(models, setup.board, setup.camera).result(1.0).model_from_board
    labels = setup.board.labels()
    plate = rng.normal(0, setup.board.sigma_mm, (len(labels), 3))
    noisy = []
    for model in models:
        own = plate if setup.common else rng.normal(0, setup.board.sigma_mm, plate.shape)
        moved = dict(zip(labels, own @ model_from_board[model.group].rotation.T, strict=True))
        shift = np.array([moved.get(label, np.zeros(3)) for label in model.labels])
        true = replace(model, xyz_model=model.xyz_model + shift)
        root = np.linalg.cholesky(model.covariance_px2)
        noise = np.einsum("nij,nj->ni", root, rng.standard_normal(model.measured_px.shape))
        noisy.append(replace(true, measured_px=setup.camera.project(true.xyz_camera()) + noise, shift_px=0 * noise))
    return noisy


def errors_of(models: list[MetricModel], setup: Setup, expected: Forecast, draws: int, seed: int):
    """Pose errors by face, (draws, 6), of adjusted simulations, and the last adjustment."""
    rng = np.random.default_rng(seed)
    truth = unmoved(models, setup.board, setup.camera).result(1.0).xyz_model
    rows = []
    for _ in range(draws):
        joint = adjusted(drawn(models, setup, rng), setup.board, setup.camera).result()
        rows.append((joint.xyz_model - truth).ravel())
    return {face: np.array(rows) @ expected.derivatives.faces[face].T for face in expected.face_covariance}, joint


def require_chi2(errors: np.ndarray, covariance: np.ndarray):
    """Errors (n, k) are as large as their covariance says, no more and no less."""
    square = float(np.einsum("ni,ni->", errors, np.linalg.solve(covariance, errors.T).T))
    low, high = chi2.ppf([CHANCE, 1 - CHANCE], errors.size)
    assert low < square < high, square / errors.size


def test_images_are_worth_their_root_unless_the_board_dominates_and_scale_is_as_good_as_the_plate(exact):
    """A plate of n dots with σ: its scale has σ/√Σr², whatever the images (least squares of a similarity)."""
    models = models_of(exact)
    doubled = [m.plus(replace(m, images=tuple(f"{name} again" for name in m.images))) for m in models]
    setups = [setup_of(exact, board_sigma_mm) for board_sigma_mm in (1e-4, 1.0)]
    once, twice = ([forecast(m, own) for own in setups] for m in (models, doubled))
    assert twice[0].worst()[1] / once[0].worst()[1] == pytest.approx(0.708, abs=1e-3)
    assert 0.85 <= twice[1].scale_sigma / once[1].scale_sigma <= 1
    setup = setup_of(exact, 0.02, 0.99)
    away = exact.board.xy_mm() - exact.board.xy_mm().mean(0)
    expected = 0.02 / np.sqrt((away**2).sum())
    assert forecast(models_of(exact, CentreNoise(1e-3)), setup).scale_sigma == pytest.approx(expected, rel=0.02)


def test_centre_noise_is_a_cramer_rao_bound_found_again_and_what_a_rim_tells_the_integral_around_it(exact):
    """Fisher's information of a blurred disc, summed over pixels. A rim against a polygon of 4096 sides, which errs by
    (π/4096)²/6, a part in ten million."""
    radius, step = 15.0, 1e-3
    y, x = np.mgrid[-30:31, -30:31]

    def disc(shift):
        return CONTRAST * ndtr((radius - np.hypot(x - shift, y)) / BLUR_PX)

    slope = (disc(step) - disc(-step)) / (2 * step)
    bound = IMAGE_NOISE / np.sqrt((slope**2).sum())
    assert PRACTICE * bound == pytest.approx(CentreNoise.expected().edge / np.sqrt(np.pi * radius), rel=0.01)
    radius = exact.target.radius_of() | exact.board.radius_of()
    found = CentreNoise.measured(models_of(exact), exact.camera, radius)
    assert (found.edge, found.narrow_px) == pytest.approx((NOISE.edge, NOISE.narrow_px), rel=1e-6)
    for tilt_deg in (0.0, 76.0):
        camera = Camera(4000, 3000, [3000.0, 3000.0], [2000.0, 1500.0], np.zeros(8))
        turn = Rigid.exp([np.radians(tilt_deg), 0, 0, 0, 0, 0]).rotation
        angle = 2 * np.pi * np.arange(4096) / 4096
        xyz = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(4096)])
        rim = 3000.0 * 1e-3 * (xyz @ turn.T)[:, :2]
        side = np.roll(rim, -1, axis=0) - rim
        across = np.column_stack([side[:, 1], -side[:, 0]]) / np.sqrt(np.linalg.norm(side, axis=1))[:, None]
        labels = tuple(CircleLabel("1", str(i)) for i in range(4))
        places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) * 1e-3 @ turn.T
        one = np.zeros(4, int)
        model = MetricModel(
            "1", ("a",), (Rigid(np.eye(3), [0.0, 0, 1000]),), labels, places, one, np.arange(4), np.arange(4),
            np.zeros((4, 2)), np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1)),
        )  # fmt: skip
        found = np.linalg.inv(CentreNoise(1.0).applied(model, camera, dict.fromkeys(labels, 1.0)).covariance_px2)
        np.testing.assert_allclose(found[0], across.T @ across, rtol=1e-6, atol=1e-7)


def known_from(scene: Scene) -> KnownRun:
    setup, models = setup_of(scene, 0.005), tuple(models_of(scene))
    joint = unmoved(models, setup.board, setup.camera).result(1.0)
    return KnownRun(models, setup, NOISE, known_scene(joint, setup, scene.camera.colmap_model))


@pytest.fixture(scope="module")
def known(exact) -> KnownRun:
    return known_from(exact)


def look_coarsely(patch: pytest.MonkeyPatch) -> None:
    """Few candidates, 25° in place of 10° apart, compared in this process: others would not know of it."""
    assert GRID_DEG == 10.0  # what users get
    patch.setattr("stcal.sfm.planning.advise.GRID_DEG", 25.0)
    patch.setattr("stcal.sfm.planning.advise.kept_processes", nullcontext)


@pytest.fixture
def coarse(monkeypatch):
    look_coarsely(monkeypatch)


@pytest.fixture(scope="module")
def advice(known):
    with pytest.MonkeyPatch.context() as patch:
        look_coarsely(patch)
        return advise(known, 2)


def after(known: KnownRun, views: list[PlannedView], now: Forecast) -> Forecast:
    models = {model.group: model for model in known.models}
    for view in views:
        models[view.group] = models[view.group].plus(view.model)
    return forecast(list(models.values()), known.setup, now.derivatives)


@pytest.mark.parametrize(("flatness_mm", "common", "refined"), [(0.01, 0.6, False), (None, 0.0, True)])
def test_one_more_view_needs_no_new_adjustment(known, coarse, flatness_mm, common, refined):
    prior = CameraPrior("OPENCV", np.diag([2.0] * 4 + [1e-3] * 4) ** 2) if refined else None
    setup = replace(known.setup, flatness_mm=flatness_mm, common=common, prior=prior, sigma0=1.3)
    known = replace(known, setup=setup)
    now = forecast(known.models, setup)
    positions = handed_over(PositionsWith.of(known.models, setup, now.derivatives))
    for model, own in offered(known):
        assert own, model.group
        for view in own[::9]:
            assert positions(view.model) == pytest.approx(after(known, [view], now).position_sigma_mm(), rel=1e-6)


def test_advised_views_do_what_is_said(known, advice):
    """Photographed in simulation: errors as forecast, and σ falls from the run to the adjustment as forecast."""
    models = {model.group: model for model in known.models}
    for choice in advice.choices:
        models[choice.view.group] = models[choice.view.group].plus(choice.view.model)
    views = [choice.view for choice in advice.choices]
    expected = after(known, views, advice.now)
    assert expected.worst() == (advice.choices[-1].face, pytest.approx(advice.choices[-1].sigma_mm))
    errors, joint = errors_of(list(models.values()), known.setup, expected, 8, 3)
    _, before = errors_of(list(known.models), known.setup, advice.now, 1, 4)
    for face, rows in errors.items():
        require_chi2(rows, expected.face_covariance[face])
    face = advice.now.worst()[0]
    stated = [
        np.sqrt(np.trace(advice.now.derivatives.face_covariance(j.covariance_mm2)[face][3:, 3:]))
        for j in (before, joint)
    ]
    forecasts = [each.position_sigma_mm()[face] for each in (advice.now, expected)]
    assert forecasts[1] < 0.9 * forecasts[0]
    assert stated[1] / stated[0] == pytest.approx(forecasts[1] / forecasts[0], rel=0.1)


def handed_over(value):
    """What another process has of it."""
    return pickle.loads(pickle.dumps(value))


def offered(known):
    return [(model, handed_over(candidates(*handed_over((known, model))))) for model in known.models]


def test_an_advised_view_beats_a_random_one_unless_a_bad_board_dominates(known, advice, coarse):
    views = [view for _, own in offered(known) for view in own]
    random = [after(known, [view], advice.now).worst()[1] for view in views[::2]]
    now, best = advice.now.worst()[1], advice.choices[0].sigma_mm
    assert best <= min(random) * (1 + 1e-6)
    assert (now - best) > 1.5 * (now - np.mean(random)) > 0
    found = advise(replace(known, setup=setup_of(known.scene, 0.2)), 1)
    assert found.board_dominates
    assert not advice.board_dominates
    assert 0.5 <= found.better_board.worst()[1] / found.now.worst()[1] < 0.7
    assert found.choices[0].sigma_mm > 0.9 * found.now.worst()[1]


def test_a_new_group_is_advised_for_faces_not_seen_together(coarse):
    """Faces 2 and 5 meet in no group; the forecast of a third group is what a scene with that group has."""
    pairs = (("1", "2"), ("1", "5"), ("2", "5"))
    board = replace(reference_board(), sigma_mm=0.0)
    three = make_scene(replace(SMALL, groups=pairs), reference_target(), board, reference_target().rough_poses())
    two = replace(three, groups={name: three.groups[name] for name in ("12", "15")})
    advice = advise(known_from(two), 3)
    (group,) = advice.new_groups
    assert (group.faces, group.images) == (("2", "5"), 3)
    assert group.sigma_mm < 0.95 * advice.now.worst()[1]
    known = known_from(three)
    assert group.sigma_mm == pytest.approx(forecast(known.models, known.setup).worst()[1], rel=0.15)


def test_a_candidate_shows_nothing_that_is_hidden(known, coarse):
    """Faces 2 and 4 look to opposite sides: no view shows both, and the whole board is always in it."""
    for model, own in offered(known):
        assert len(own) > 4
        for view in own:
            assert not {"2", "4"} <= view.tilts_deg.keys()
            assert sum(model.labels[i].startswith("board:") for i in view.model.point_index) == 63
            assert max(view.tilts_deg.values()) < 75


def test_advice_starts_from_a_runs_own_sigma_with_estimated_rims_and_says_where_it_is_not_to_be_trusted(small_run):
    """No view lowers that of rims: each face lies half of an error of the height along its own normal."""
    known = known_of(saved := load_run(small_run))
    now = forecast(known.models, known.setup)
    stated = json.loads((small_run / "faces.json").read_text())["target_from_face_covariance"]
    for face, covariance in now.face_covariance.items():
        # Huber's weights of the few long residuals make the difference.
        assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(stated[face])), rel=0.03)
    first, *checks = saved.report["checks"]
    failed = replace(saved, report=saved.report | {"checks": [first | {"verdict": "failed"}, *checks]})
    control = replace(saved, options=replace(saved.options, eccentricity=False))
    assert "uncorrected control" in doubts(control)
    assert ("1 checks of" in doubts(failed), doubts(saved)) == (True, "")
    saved = load_run(small_run)
    faces = saved.faces.model_copy(update={"rim_mm": dict.fromkeys(saved.faces.circles, 0.2)})
    summary = saved.report["summary"] | {"rim_sigma_mm": 0.01}
    known = known_of(replace(saved, faces_file=faces, report=saved.report | {"summary": summary}))
    now = forecast(known.models, known.setup)
    seen = forecast(known.models, replace(known.setup, rims_mm2=None), now.derivatives)
    shares = variance_shares(now, known.models, known.setup)
    normal = {face: np.array(m)[:3, 2] for face, m in saved.faces.target_from_face.items()}
    model = known.models[0]
    view = replace(
        model.observed(model.rows_by_image()[0]), images=model.images[:1], camera_from_model=model.camera_from_model[:1]
    )
    further, further_seen = (
        PositionsWith.of(known.models, setup, now.derivatives)(view)
        for setup in (known.setup, replace(known.setup, rims_mm2=None))
    )
    for face, covariance in now.face_covariance.items():
        expected = 0.005 * np.linalg.norm(normal[face] - normal[saved.faces.reference_face])
        added = np.trace((covariance - seen.face_covariance[face])[3:, 3:])
        assert np.sqrt(added) == pytest.approx(expected, rel=0.02)
        assert shares[face]["rims"] == pytest.approx(added / np.trace(covariance[3:, 3:]), rel=0.01)
        assert sum(shares[face].values()) == pytest.approx(1, abs=1e-3)
        assert np.sqrt(further[face] ** 2 - further_seen[face] ** 2) == pytest.approx(expected, rel=0.02)


def test_a_plan_takes_a_camera_as_its_file_that_states_its_size():
    camera = Camera(2592, 1728, [2600, 2600], [1295, 863], [0.1, 0, 0, 0, 0, 0, 0, 0])
    target, board, cube = reference_target(), reference_board(), tag_cube(50.0)
    for given in (camera, model_of(camera)):
        options = PlanOptions(images=2, camera=given, groups=(("1", "2"),))
        assert session._beside_board(options, target, board, None)[0].camera.same_as(camera)
        near = PlanOptions(images=20, distance_mm=300.0, camera=given)
        assert session.planned_photographs(near, cube)[0].camera.same_as(camera)
    camera = CameraModel(np.array([2800.0, 2800.0]), np.array([1296.0, 864.0]), np.zeros(8), "PINHOLE", 2592, None, "f")
    with fails_with("E-CAMERA-SIZE"):
        PlanOptions(camera=camera)


def test_through_the_widest_aperture_depth_of_field_moves_one_centre_by_its_sigma(exact):
    """By differences of the squared blur between two points of a circle's plane, a hundredth of a px apart in the
    image."""
    sigma_px = 0.01
    model = true_models(exact, observe(exact, sigma_px, np.random.default_rng(0)))[0]
    aperture_mm = widest_aperture_mm([model], exact.camera)
    focal_px = float(np.sqrt(exact.camera.focal.prod()))
    xyz = model.xyz_camera()
    times = []
    for k, (image, point) in enumerate(zip(model.image_index, model.point_index, strict=True)):
        plane = model.points_by_face()[model.labels[point].plane]
        own = model.camera_from_model[image] @ model.xyz_model[plane]
        normal = np.linalg.svd(own - own.mean(0))[2][2]
        focus = np.mean(1 / xyz[model.image_index == image, 2])
        rays = np.append(xyz[k, :2] / xyz[k, 2], 1) + 0.01 / focal_px * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        inverse_depth = rays @ normal / (normal @ xyz[k])
        blur2 = (focal_px * aperture_mm / 4) ** 2 * (inverse_depth - focus) ** 2
        times.append(RESPONSE * np.linalg.norm(blur2[1:] - blur2[0]) / 0.01 / sigma_px)
    assert max(times) == pytest.approx(1, rel=2e-3)


def test_plan_remedies_are_plans_of_their_own_and_a_fine_board_is_forecast_by_some_of_its_dots(monkeypatch):
    """Of faces 1, 2 and 3, the last two groups away from the first. σ of all faces as by every dot, to 5 %: photographs
    and board are the same, and the edges weigh more."""
    options = PlanOptions(width=2592, images=2, groups=(("1", "2"), ("2", "3")), noise=NOISE)
    designs = reference_target(), reference_board(), reference_target().rough_poses()
    two, four = (plan(replace(options, images=images), *designs) for images in (2, 4))
    assert two.remedies[0].sigma_mm == pytest.approx(four.forecast.worst()[1], rel=1e-9)
    assert 0.65 < two.remedies[0].sigma_mm / two.forecast.worst()[1] < 0.95
    board = replace(reference_board(), rows=16, columns=22, pitch_mm=16.0, radius_mm=5.0, corner=None)
    board = replace(board, corner_radius_mm=None)
    options, target = PlanOptions(images=2, groups=(("1", "2"), ("1", "4"))), reference_target()
    found = []
    for most in (session.MOST_DOTS, 1000):
        monkeypatch.setattr(session, "MOST_DOTS", most)
        _, models, setup = session._beside_board(options, target, board, target.rough_poses())
        found.append((setup, forecast(models, setup).position_sigma_mm(), sum(setup.centres(m).sum() for m in models)))
    (some, sigma, observations), (every, expected, all_observations) = found
    np.testing.assert_allclose([sigma[face] for face in expected], list(expected.values()), rtol=0.05)
    assert observations == pytest.approx(all_observations, rel=0.05)
    assert some.stands_for > every.stands_for == 1


@pytest.mark.slow
def test_a_plan_of_a_design_of_ones_own_names_its_faces(stcal_sfm, tmp_path):
    target, board, _ = second_design()
    save_target(tmp_path / "target.toml", replace(target, faces=target.faces[:2]))
    save_board(tmp_path / "board.toml", board)
    designs = "--target", tmp_path / "target.toml", "--board", tmp_path / "board.toml"
    code, out, _ = stcal_sfm("plan", *designs, "--images", 3, "--width", 1200)
    assert code == 0
    assert all(face.id in out for face in target.faces[:2])


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--noise", 0.01, "--run", "anywhere"), (2, "E-OPTION-CONFLICT")),
        (("--groups", "12,17"), (2, "E-OPTION-VALUE")),
        (("--groups", "12,34"), (2, "E-PLAN-UNLINKED")),
        (("--run", "nowhere"), (2, "E-RUN-FOLDER")),
        pytest.param(("--distance", 300, "--images", 2, "--groups", "12"), (3, "E-SCENE-VIEWS"), marks=SLOW),
    ],
)
def test_plan_says_what_is_wrong(stcal_sfm, arguments, code):
    ended = stcal_sfm("plan", *arguments)
    assert (ended[0], ended.error) == code


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (None, "E-TARGET-ROUGH-POSE … rough_pose … origin_mm … --faces"),
        ('{"unit": "m", "target_from_face": {}}', "E-KEY-VALUE … 'm'"),
        ('{"target_from_face": {}}', "E-TARGET-NO-FACE … top"),
    ],
)
def test_plan_of_another_design_needs_its_faces(faces, message, tmp_path):
    target, _, _ = second_design()
    target = replace(target, faces=tuple(replace(face, rough_target_from_face=None) for face in target.faces))
    path = tmp_path / "faces.json"
    path.write_text(faces or "")
    with fails_with(message):
        nominal_poses(target, path if faces else None)


@pytest.mark.parametrize(("common", "refined"), [(0.0, True), (0.99, False)])
def test_dots_reduced_first_are_the_same_as_cameras_first(exact, monkeypatch, common, refined):
    """To rounding: the two ways differ in the order of elimination alone."""
    prior = CameraPrior("OPENCV", np.diag([1, 1, 1, 1, 1e-6, 1e-6, 1e-8, 1e-8])) if refined else None
    models = true_models(exact, observe(exact, 0.02, np.random.default_rng(0)))
    board = replace(exact.board, sigma_mm=0.02)
    found = []
    for first in (True, False):
        monkeypatch.setattr(equations, "is_dots_first_cheaper", lambda _, first=first: first)
        found.append(unmoved(models, board, exact.camera, 0.02, prior, common).result(1.0))
    dots, cameras = found
    largest = cameras.covariance_mm2.max()
    np.testing.assert_allclose(dots.covariance_mm2, cameras.covariance_mm2, rtol=0, atol=1e-8 * largest)
    unit = np.sqrt(np.diag(cameras.camera_covariance)) if refined else np.ones(len(cameras.camera_covariance))
    scaled = [each.camera_covariance / np.outer(unit, unit) for each in found]
    np.testing.assert_allclose(*scaled, rtol=0, atol=1e-6)
    assert (dots.sigma0, dots.redundancy) == (cameras.sigma0, cameras.redundancy)
