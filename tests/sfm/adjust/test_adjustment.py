"""The adjustments from labels: exact without noise, invariant, with a σ that is true and stands in the file; their
covariance taken apart, against what small changes of the inputs do."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stcal import Camera, CameraPrior, camera_prior, reference_board
from stcal.geometry.clusters import NOTED
from stcal.geometry.normal_equations import free_motions
from stcal.geometry.rigid import Rigid, Similarity, align_similarity
from stcal.io.files import json_text
from stcal.sfm.adjust.calibration import AdjustOptions, calibrate
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.refine import adjust, refine
from stcal.sfm.adjust.uncertainty import (
    DISTANCES,
    INTRINSICS,
    OBSERVED,
    PRINT,
    SIZES,
    calibrated_target,
    contributions_of,
    derivatives,
)
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.levels import sampled
from tests.sfm.camera.test_intrinsics import with_a_field
from tests.support.image_poses import pose_error

NOISE_PX = 0.005


@pytest.fixture(scope="module")
def scenes():
    return [
        make_scene(SceneOptions(seed=seed, width=2592, height=1728, images_per_group=4)) for seed in range(100, 103)
    ]


def pose_errors(scene, target):
    """Rotation (rad) and translation (mm) errors by face but the reference, in the target frame."""
    poses = {face: pose for face, pose in target.target_from_face.items() if face != target.reference_face}
    return {face: pose_error(pose, scene.target_from_face[face]) for face, pose in poses.items()}


def test_adjustments_are_exact_without_noise_find_the_eccentricity_and_state_sigma_of_distances(scene, labels_only):
    """Without noise the corrected model is the true one: eccentricity is modelled, not fitted away. σ of a distance
    from the reference, which is held, to another face is what the other's translation may do along the line."""
    observed = labels_only.observations(scene, 0.0, np.random.default_rng(0))
    board = reference_board()
    for start in labels_only.models(scene, observed, unit_mm=37.0)[::3]:
        refined = refine(start, scene.camera, scene.target, board)
        assert refined.outliers == ()
        assert 0.02 < np.abs(refined.model.shift_px).max() < 0.2
        assert np.abs(refined.model.residuals_px(scene.camera)).max() < 2e-5
        uncorrected = refine(start, scene.camera, scene.target, board, eccentricity=False).model
        rms = np.sqrt((uncorrected.residuals_px(scene.camera) ** 2).mean())
        assert 1e-4 < rms < 0.02  # the bias hides: residuals stay small …
        group = scene.groups[start.group]
        dots = dict(zip(board.labels(), group.board_circles_target, strict=True))
        true = np.array([scene.circles_target[k] if k in scene.circles_target else dots[k] for k in start.labels])
        for model, low, high in ((refined.model, 0.0, 1e-3), (uncorrected, 0.005, 0.1)):
            fit = align_similarity(true, model.xyz_model)
            error = np.linalg.norm(fit @ model.xyz_model - true, axis=1)
            assert low <= error.mean() < high  # … while the points are tens of µm off
    # A board that is the perfect grid: only then may the residuals vanish.
    ideal = replace(reference_board(), sigma_mm=1e-6)
    groups = (("1", "2"), ("1", "4"))
    exact = make_scene(SceneOptions(seed=4, width=2592, height=1728, images_per_group=3, groups=groups), None, ideal)
    target, joint = labels_only.calibrate(exact, 0.0, 0)
    assert joint.sigma0 < 0.05
    # The chained start leaves eccentricities of a nanometre.
    for error in pose_errors(exact, target).values():
        assert np.abs(error[3:]).max() < 5e-4
        assert np.abs(error[:3]).max() < 5e-6
    target, _ = labels_only.calibrate(scene, 0.01, 4)
    options = RunOptions().settled(scene.target).adjustment(scene.target)
    content = json.loads(json_text(FacesFile.of(target, scene.target, options, 1.25).content()))
    for face_id in ("2", "3"):
        along = np.array(content["target_from_face"][face_id])[:3, 3]
        along = along / np.linalg.norm(along)
        covariance = np.array(content["target_from_face_covariance"][face_id])[3:, 3:]
        sigma = content["distance_sigma_mm"][f"1 {face_id}"]
        assert sigma == pytest.approx(np.sqrt(along @ covariance @ along), rel=1e-6)
    assert content["scale_sigma_ppm"] == pytest.approx(1e6 * target.scale_sigma)


def test_only_what_contradicts_is_left_out_whatever_the_world_or_the_order_of_images(scene, labels_only):
    """60 times the noise is named, three times the noise is noise."""
    for shift_px, named in (((3.0, -2.0), 1), ((0.3, 0.0), 1), ((0.015, 0.0), 0)):
        observed = labels_only.observations(scene, NOISE_PX, np.random.default_rng(1))
        start = labels_only.models(scene, observed)[0]
        row = int(np.flatnonzero(start.image_index == 1)[7])
        measured = start.measured_px.copy()
        measured[row] += shift_px
        refined = refine(replace(start, measured_px=measured), scene.camera, scene.target, reference_board())
        moved = start.images[1], start.labels[start.point_index[row]]
        assert [(o.image, o.label) for o in refined.outliers] == named * [moved]
    observed = labels_only.observations(scene, NOISE_PX, np.random.default_rng(2))
    start = labels_only.models(scene, observed)[0]
    moved = start.moved(Similarity(0.02, Rigid.exp([1.0, 0.2, -0.4, 5, 6, 7])))
    order = np.arange(len(start.images))[::-1]
    shuffled = replace(
        start,
        images=tuple(start.images[i] for i in order),
        camera_from_model=tuple(start.camera_from_model[i] for i in order),
        image_index=order[start.image_index],
    )
    a = adjust(start, scene.camera)
    for other in (moved, shuffled):
        b = adjust(other, scene.camera)
        fit = align_similarity(a.xyz_model, b.xyz_model)
        assert np.abs(fit @ b.xyz_model - a.xyz_model).max() < 1e-6


def _with_new_board(scene, seed):
    """The same scene with another draw of the board's dots."""
    rng = np.random.default_rng(1000 + seed)
    groups = {}
    for name, group in scene.groups.items():
        grid = np.column_stack([scene.board.xy_mm(), np.zeros(63)])
        dots = group.target_from_board @ (grid + rng.normal(0, scene.board.sigma_mm, grid.shape))
        groups[name] = replace(group, board_circles_target=dots)
    return replace(scene, groups=groups)


@pytest.fixture(scope="module")
def drawn(scenes, labels_only):
    """By a seed, a scene with a board of its own, and its joint calibration."""

    @cache
    def draw(seed):
        scene = _with_new_board(scenes[seed % len(scenes)], seed)
        return scene, *labels_only.calibrate(scene, NOISE_PX, seed)

    return draw


@pytest.mark.full
def test_predicted_covariances_are_true(drawn):
    """Normalised squared error of 4 faces over 24 draws: mean of χ²₆/6, standard deviation 0.06 if independent.

    The faces of one draw share circles and cameras, which widens that to about 0.1.
    """
    values, draws = [], [drawn(seed) for seed in range(24)]
    for scene, target, _ in draws:
        for face_id, error in pose_errors(scene, target).items():
            values.append(error @ np.linalg.solve(target.face_covariance[face_id], error) / 6)
    assert 0.7 < np.mean(values) < 1.3
    assert np.mean([joint.sigma0 for _, _, joint in draws]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("count", "low", "high"), sampled([(12, 1.07, 1.47), (24, 1.15, 1.4)]))
def test_joint_beats_the_chain(drawn, labels_only, count, low, high):
    """One target over all groups. 48 draws have an RMS face error 1.27 times smaller, and quarters of them differ by
    0.1: two σ of twelve."""
    joint, chain = [], []
    for seed in range(count):
        scene, target, _ = drawn(seed)
        chained, _ = labels_only.calibrate(scene, NOISE_PX, seed, "chain")
        for values, one in ((joint, target), (chain, chained)):
            values += [float((e[3:] ** 2).sum()) for e in pose_errors(scene, one).values()]
    assert low < np.sqrt(np.mean(chain) / np.mean(joint)) < high


@pytest.mark.slow
def test_sigma_grow_by_how_much_photographs_differ(scenes, labels_only):
    """With a field of twice the centres' σ, errors are beyond σ of independent pixels, and within those stated."""

    def calibrated(scene, images):
        models = labels_only.adjusted(scene, images)
        return calibrate(models, scene.camera, scene.target, scene.board, AdjustOptions(scene.target.faces[0].id))

    stated, independent = [], []
    for seed, scene in enumerate(scenes):
        rng = np.random.default_rng(seed)
        plain = labels_only.observations(scene, NOISE_PX, rng)
        if not seed:
            assert calibrated(scene, plain).joint.differ < 1.25
        found = calibrated(scene, with_a_field(plain, rng, 2 * NOISE_PX))
        assert found.joint.differ > 1.2
        assert (found.joint.differ > NOTED) == any("photographs differ" in note for note in found.notes)
        for face, error in pose_errors(scene, found.target).items():
            square = error @ np.linalg.solve(found.target.face_covariance[face], error) / 6
            stated.append(square)
            independent.append(square * found.joint.differ**2)  # but for the board's part
    assert np.mean(stated) < 1.6 < np.mean(independent)  # 1.09 and 1.99


def position_error_um(scene, observations, camera, refine_camera: bool) -> float:
    """RMS over the faces but the reference."""
    seen = [replace(image, centre=camera.normalised_from_pixel(image.centre_px)) for image in observations]
    models = [
        refine(m.in_world(Similarity(1.0, Rigid())), camera, scene.target, scene.board).model
        for m in true_models(scene, seen)
    ]
    given = Camera.of(camera, scene.camera.colmap_model)
    options = RunOptions(refine_camera=refine_camera).adjustment(scene.target)
    result = calibrate(models, camera, scene.target, scene.board, options, camera_prior(given))
    off = [error[3:] for error in pose_errors(scene, result.target).values()]
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(off), axis=1))))


@pytest.mark.slow
def test_wrong_intrinsics_are_refined():
    """0.03 % in f, 2 px in c, 1 % in k1: within 1.5 times the error with the true camera; several times it without."""
    scene = make_scene(SceneOptions(seed=0, images_per_group=4, groups=(("1", "2"), ("1", "4"))))
    observations = observe(scene, 0.01, np.random.default_rng(0))
    true = scene.camera
    k1 = np.array([0.01 * true.distortion[0], *[0] * 11])
    centre = true.centre + np.array([2, 2])
    wrong = replace(true, focal=1.0003 * true.focal, centre=centre, distortion=true.distortion + k1)
    cases = ((true, False), (wrong, True), (wrong, False))
    known, refined, held = (position_error_um(scene, observations, *case) for case in cases)
    assert 0.5 * known < refined < 1.5 * known
    assert held > 5 * known


FLATNESS_MM = 0.02
SIGMAS = np.array([1.5, 1.5, 1.0, 1.0, 5e-4, 2e-3, 5e-5, 5e-5])
"""Of fx, fy, cx, cy (px), k1, k2, p1, p2."""


@pytest.fixture(scope="module")
def case(labels_only, small_scene):
    observed = labels_only.observations(small_scene, 0.01, np.random.default_rng(2))
    return labels_only.models(small_scene, observed), small_scene


def state_of(case, refined=False, common=None, board=None, camera=None):
    models, scene = case
    prior = CameraPrior(scene.camera.colmap_model, np.diag(SIGMAS**2)) if refined else None
    return adjusted(models, board or scene.board, camera or scene.camera, FLATNESS_MM, prior, common=common)


def shift(case, changed, common) -> np.ndarray:
    before = state_of(case, common=common).result().xyz_model
    free = free_motions(before, scale=False)
    moved = (changed.result().xyz_model - before).ravel()
    return moved - free @ (free.T @ moved)


def test_the_parts_are_covariances_their_sum_the_adjustments_own_and_that_of_a_position(case):
    """What :func:`contributions_of` has of each kind is that of a position in the face's own frame."""
    for refined, common in ((False, None), (True, None), (False, 0.6)):
        found = contributions_of(state_of(case, refined, common))
        whole = found.joint.covariance_mm2
        assert list(found.covariance_mm2) == list(OBSERVED)
        absent = {PRINT, SIZES, DISTANCES} if refined else {PRINT, SIZES, DISTANCES, INTRINSICS}
        for kind, part in found.covariance_mm2.items():
            least, most = np.linalg.eigvalsh(part)[[0, -1]]
            assert least > -1e-9 * np.abs(whole).max(), kind
            assert (most > 1e-4 * np.abs(whole).max()) == (kind not in absent), kind
        np.testing.assert_allclose(sum(found.covariance_mm2.values()), whole, atol=1e-7 * np.abs(whole).max())
    scene = case[1]
    state = state_of(case, refined=True)
    seen = {label.face for label in state.setting.labels}
    poses = {face: pose for face, pose in scene.target_from_face.items() if face in seen}
    start = CalibratedTarget("1", poses, scene.circles_target, dict.fromkeys(scene.groups, Rigid()))
    joint, parts = state.result(), contributions_of(state).covariance_mm2
    found = calibrated_target(joint, start, scene.target, "plane", state)
    assert calibrated_target(joint, start, scene.target, "plane").position_sources_mm == {}
    own = derivatives(joint, start, scene.target, "plane")
    for face, sources in found.position_sources_mm.items():
        variance = np.diag(found.face_covariance[face])[3:]
        total = sum(sigma**2 for sigma in sources.values())
        np.testing.assert_allclose(total, variance, rtol=1e-6, atol=1e-12)
        for kind, sigma in sources.items():
            expected = np.diag(own.faces[face][3:] @ parts[kind] @ own.faces[face][3:].T)
            np.testing.assert_allclose(sigma**2, expected, rtol=1e-6, atol=1e-6 * variance.max() + 1e-12)


def test_a_wider_pitch_and_another_camera_move_the_circles_as_foretold(case):
    """The error is the adjusted circle less the true one: what the camera was wrongly given more."""
    for common in (0.0, 0.6):
        found = contributions_of(state_of(case, common=common))
        board = case[1].board
        wider = state_of(case, common=common, board=replace(board, pitch_mm=board.pitch_mm * (1 + 1e-5)))
        np.testing.assert_allclose(shift(case, wider, common), 1e-5 * found.by_scale, atol=1e-6)
        xyz = found.joint.xyz_model - found.joint.xyz_model.mean(0)
        np.testing.assert_allclose(found.by_scale, xyz.ravel(), atol=1e-3 * np.abs(xyz).max())
    found = contributions_of(state_of(case, common=0.0))
    away = np.zeros(16)
    away[[0, 2, 4]] = 0.1, 0.05, 1e-5
    camera = case[1].camera
    other = state_of(case, common=0.0, camera=camera.with_parameters(camera.parameters() + away))
    moved = shift(case, other, 0.0)
    assert np.abs(moved).max() > 1e-3
    np.testing.assert_allclose(moved, -found.by_intrinsics @ away, atol=1e-3 * np.abs(moved).max())
