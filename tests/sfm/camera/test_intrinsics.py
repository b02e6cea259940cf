"""Intrinsics from board views: without pixels against the truth and their own σ, with pixels, and refusals."""

import json
import re
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stcal import camera_prior, reference_board
from stcal.boards.board_designs import CharucoDesign
from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera, parameter_names
from stcal.geometry.plane import circle_image_offset
from stcal.io.cameras.read import read_camera
from stcal.sfm.camera import calibrate as calibration
from stcal.sfm.camera import intrinsics
from stcal.sfm.camera.calibrate import require_determined
from stcal.sfm.camera.intrinsics import adjust_intrinsics, closed_form, model_parameters, projection_sigma
from stcal.sfm.data.group_model import Centres, ImageObservations
from stcal.sfm.detect.candidates import BoardSighting, ImageDetection
from stcal.workflows.board_views import corner_grid
from tests.outcome import fails_with

pytestmark = pytest.mark.slow

TRUE = Camera(2592, 1728, [2790.0, 2784.0], [1301.0, 859.0], [-0.06, 0.045, 1.5e-4, -1e-4, 0, 0, 0, 0])
BOARD = reference_board()
RAYS = np.array([[x, y, 1.0] for x in (-0.35, 0.0, 0.35) for y in (-0.25, 0.0, 0.25)])


def views_of(
    rng, count=12, noise_px=0.02, tilt_deg=35.0, camera=TRUE, made=None, board=BOARD
) -> list[ImageObservations]:
    """Ellipse centres of the dots that a hand-held board, 0.3 to 0.6 m away, shows in the image."""
    count_of_points = len(board.labels())
    if made is None:
        made = np.pad(board.xy_mm(), ((0, 0), (0, 1))) + board.sigma_mm * rng.standard_normal((count_of_points, 3))
    middle_mm = made.mean(axis=0)
    size = np.array([camera.width, camera.height])
    views = []
    while len(views) < count:
        angles = [rng.uniform(-180, 180), *rng.uniform(-tilt_deg, tilt_deg, 2)]
        rotation = Rotation.from_euler("zxy", angles, degrees=True).as_matrix()
        depth = rng.uniform(300, 600)
        place = np.append(rng.uniform(-0.35, 0.35, 2) * size / camera.focal * depth, depth)
        xyz = (made - middle_mm) @ rotation.T + place
        normal = np.tile(rotation[:, 2], (count_of_points, 1))
        xy = camera.project(circle_image_offset(xyz, normal, board.radii_mm()))
        seen = ((xy > 20) & (xy < size - 20)).all(1)
        if seen.sum() < 0.48 * count_of_points:
            continue
        labels = tuple(label for label, s in zip(board.labels(), seen, strict=True) if s)
        n = len(labels)
        xy = xy[seen] + noise_px * rng.standard_normal((n, 2))
        shape, covariance = np.tile(np.eye(2), (n, 1, 1)), np.tile(noise_px**2 * np.eye(2), (n, 1, 1))
        views.append(ImageObservations(f"{len(views)}.jpg", ".", labels, xy, np.zeros((n, 2)), shape, covariance))
    return views


def calibrated(views, model="OPENCV", board=BOARD):
    start = closed_form(views, board, intrinsics.start_camera(TRUE.width, TRUE.height, model))
    return adjust_intrinsics(views, board, start, model)


def error(result, truth=TRUE) -> np.ndarray:
    return model_parameters(result.camera, result.colmap_model) - model_parameters(truth, result.colmap_model)


@pytest.mark.full
@pytest.mark.parametrize(("field_px", "count", "low", "high"), [(0.0, 12, 0.8, 1.2), (0.04, 14, 0.6, 1.6)])
def test_truth_within_predicted_sigma(field_px, count, low, high):
    """Of 40 calibrations from nothing the normalised squared error of 8 parameters scatters by 8 % about 1. With a
    field of twice the centres' σ, by σ of independent errors it is above 5; σ of the mean is then 0.2, as σ themselves
    have 10 degrees of freedom."""
    squares, factors = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        views = views_of(rng, count)
        result = calibrated(with_a_field(views, rng, field_px) if field_px else views)
        squares.append(error(result) @ np.linalg.solve(result.covariance, error(result)) / 8)
        factors.append(result.factors.centres)
    assert low < np.mean(squares) < high
    if not field_px:
        assert abs(np.mean(factors) - 1) < 0.02
        # Of a 24 mm lens on a 22 mm sensor, 1 px is 4e-4: σ of 0.02 px centres must be far below.
        assert 0.05 < result.sigma()[0] < 0.2


def test_sigma_follows_what_the_centres_do_and_a_bad_dot_is_weighed_down():
    # Centres five times as bad as they say: found out, and σ grow as much.
    views = views_of(np.random.default_rng(5), noise_px=0.1)
    honest = calibrated(views)
    boastful = calibrated([replace(v, covariance_px2=v.covariance_px2 / 25) for v in views])
    assert boastful.factors.centres == pytest.approx(5 * honest.factors.centres, rel=0.02)
    assert boastful.sigma() == pytest.approx(honest.sigma(), rel=0.05)
    views = views_of(np.random.default_rng(6))
    shifted = views[3].centre_px + 1.0 * (np.arange(len(views[3])) == 7)[:, None]
    spoilt = calibrated([*views[:3], replace(views[3], centre_px=shifted), *views[4:]])
    assert (np.abs(error(spoilt)) < 4 * spoilt.sigma()).all()
    weights, model = spoilt.weights()[0], spoilt.models[0]
    worst = int(np.argmin(weights))
    assert weights[worst] < 0.1
    named = model.images[model.image_index[worst]], model.labels[model.point_index[worst]]
    assert named == ("3.jpg", views[3].labels[7])


def test_models_of_fewer_and_of_more_parameters():
    """The rational model knows projections, though not its coefficients."""
    camera = replace(TRUE, focal=[2790.0, 2790.0], distortion=[-0.1, *[0] * 7])
    result = calibrated(views_of(np.random.default_rng(7), camera=camera), "SIMPLE_RADIAL")
    e = error(result, camera)
    assert 0.01 < e @ np.linalg.solve(result.covariance, e) / chi2.ppf(0.999, len(e)) < 1
    result = calibrated(views_of(np.random.default_rng(8)), "FULL_OPENCV")
    sigma = projection_sigma(result)
    moved = np.abs(result.camera.project(RAYS) - TRUE.project(RAYS)).max()
    middle = np.linalg.norm(intrinsics.image_grid(result.camera) - [1296, 864], axis=1) < 900
    assert result.sigma()[4] > 0.1
    assert sigma.sigma_px[middle].max() < 0.1
    assert 0.001 < moved < 0.5


def test_intrinsics_that_are_held_stay_and_closed_form_finds_the_focal_length_else_several_are_tried(monkeypatch):
    wrong = replace(TRUE, focal=[2795.0, 2784.0])
    views = views_of(np.random.default_rng(8), count=6)
    held = adjust_intrinsics(views, BOARD, wrong, "OPENCV", held=True)
    assert (held.camera.parameters() == wrong.parameters()).all()
    free = adjust_intrinsics(views, BOARD, wrong, "OPENCV")
    assert (np.abs(error(free)) < 5 * free.sigma()).all()
    # 5 px of 2790 are 1 px at the edge of a board that fills the image, and some of it no pose can take up.
    assert np.sqrt((held.residuals_px() ** 2).mean()) > 2 * np.sqrt((free.residuals_px() ** 2).mean())
    # Exact but for the eccentricity of the dots, and the principal point 6 px off the middle; then with distortion.
    pinhole = replace(TRUE, focal=[2790.0, 2790.0], distortion=np.zeros(8))
    start = intrinsics.start_camera(TRUE.width, TRUE.height, "OPENCV")
    for camera, tolerance in ((pinhole, 5e-3), (TRUE, 0.05)):
        found = closed_form(views_of(np.random.default_rng(9), noise_px=1e-3, camera=camera), BOARD, start).focal
        assert found == pytest.approx([2790, 2790], rel=tolerance)
        assert (found != start.focal).all()
    monkeypatch.setattr(intrinsics, "FOCAL_LIMITS", (60.0, 60.0))
    found = closed_form(views_of(np.random.default_rng(1), count=6), BOARD, start).focal
    assert 2**-0.3 < found[0] / TRUE.focal[0] < 2**0.3  # the nearest of a row with steps of √2 is within 2^¼


BENT = replace(TRUE, distortion=[-0.3, 0.1, 0, 0, 0, 0, 0, 0])


def test_what_cannot_be_calibrated_is_refused_and_why(stcal_sfm, small_dataset, tmp_path, small_set):
    for shown, model, refusal in (
        ({"count": 6, "tilt_deg": 0.02}, "OPENCV", "E-CALIBRATE-UNDETERMINED … 6 … 2 %"),
        ({"camera": BENT}, "PINHOLE", "E-CALIBRATE-MISFIT … PINHOLE puts them … use --model OPENCV"),
    ):
        views = views_of(np.random.default_rng(2), **shown)
        with fails_with(refusal):
            require_determined(calibrated(views, model), views, BOARD)
    words = "calibrate-camera", small_dataset / "images", "--out", tmp_path / "new.txt", "--model", "FISHEYE"
    ended = stcal_sfm(*words)
    assert (ended[0], ended.error) == (2, "E-CAMERA-MODEL")
    (tmp_path / "images").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((300, 400), 60 + i, np.uint8))
    code, _, message = stcal_sfm("calibrate-camera", tmp_path / "images", "--out", tmp_path / "c.txt", "--workers", 1)
    assert code == 3
    assert "error: camera: no board recognised in 3 images; 0.png: no board recognised; check the board" in message
    assert not (tmp_path / "c.txt").exists()
    own = small_set("12", detected=False)
    own.image(3).unlink()
    cv2.imwrite(str(own.image(2)), np.zeros((400, 600), np.uint8))
    out = own.folder / "c.txt"
    code, _, message = stcal_sfm("calibrate-camera", own.images, "--out", out, "--workers", 1)
    assert code == 3
    assert "2 of 3 images show the board, 3 needed" in message
    assert "12/IMG_1002.jpg: 600×400 px, but the majority of the images says 1296×864 px" in message


def test_sigma_cover_a_changed_focus_and_a_loud_photograph_hardly_counts():
    """Half of the views with another focal length: no error of any pixel, and σ cover both. A loud photograph moves the
    answer by 2.5 σ where it counts; else by 0.3 to 0.6 σ, and σ by −7 to +26 %, in four draws."""
    rng = np.random.default_rng(3)
    made = np.column_stack([BOARD.xy_mm(), np.zeros(63)])
    refocused = replace(TRUE, focal=1.002 * TRUE.focal)
    both = zip(views_of(rng, 6, made=made), views_of(rng, 6, camera=refocused, made=made), strict=True)
    views = [replace(v, name=f"{i}.jpg") for i, v in enumerate(v for pair in both for v in pair)]
    result = calibrated(views)
    assert result.differ > 2
    assert 0.2 < result.sigma()[0] / (0.002 * 2790 / np.sqrt(12)) < 2  # of a mean of twelve, which two kinds are
    lines = calibration._warnings(result, projection_sigma(result), BOARD)
    assert any("photographs differ" in line for line in lines)
    rng = np.random.default_rng(3)
    views = views_of(rng, 14)
    loud = with_a_field(views[3:4], rng, 8 * 0.02)
    sound, all_of_them = calibrated([*views[:3], *views[4:]]), calibrated([*views[:3], *loud, *views[4:]])
    apart = [model_parameters(each.camera, "OPENCV") for each in (all_of_them, sound)]
    assert np.abs(np.subtract(*apart) / sound.sigma()).max() < 1
    assert all_of_them.sigma() / sound.sigma() == pytest.approx(1, abs=0.25)


def with_a_field(views, rng, sigma_px: float, length_px: float = 250.0):
    """The views with errors that are alike in neighbouring places of one photograph, and not in others."""
    moved = []
    for view in views:
        apart = ((view.centre_px[:, None] - view.centre_px) ** 2).sum(2)
        root = np.linalg.cholesky(np.exp(-apart / 2 / length_px**2) + 1e-9 * np.eye(len(view)))
        moved.append(replace(view, centre_px=view.centre_px + sigma_px * root @ rng.standard_normal((len(view), 2))))
    return moved


STRETCHED = {"along": [[1.0, 0.0], [0.0, 0.0]], "across": [[0.0, 0.0], [0.0, 1.0]], "sheared": [[0.0, 0.5], [0.5, 0.0]]}


@pytest.mark.parametrize(
    ("board", "count", "most"),
    [(BOARD, 12, 3.5), (corner_grid(CharucoDesign(9, 7, 26.0, 18.0, "DICT_5X5_100")), 4, 6.0)],
    ids=["dots", "corners"],
)
def test_a_stretched_print_moves_the_focal_lengths_within_their_sigma(board, count, most):
    """As a printer does that feeds its paper too fast; without modes of the print fx and fy are 0.2 to 1 % apart. χ² of
    the two, of nine calibrations, has a mean of 2 ± 0.7, and of few photographs, which tell σ to a half, up to 6."""
    squares = []
    for i, (percent, how) in enumerate(product((0.2, 0.5, 1.0), STRETCHED.values())):
        rng = np.random.default_rng(100 * count + i)
        made = np.pad(board.xy_mm() @ (np.eye(2) + 0.01 * percent * np.array(how)), ((0, 0), (0, 1)))
        made += board.sigma_mm * rng.standard_normal(made.shape)
        result = calibrated(views_of(rng, count, made=made, board=board), board=board)
        moved = error(result)[:2]
        # The mean size over both directions is kept as stated: no ray moves by it.
        squares.append(moved @ np.linalg.solve(result.covariance[:2, :2], moved))
        stretched = 0.01 * percent * np.array([how[0][0] - how[1][1], 2 * how[0][1]])
        assert result.prints()["."] == pytest.approx(stretched, abs=1e-3)
    assert 0.5 < np.mean(squares) < most


def test_photographs_each_alone_in_their_group_and_a_board_upside_down_are_of_one_board():
    """A board of its own in each would explain every photograph, whatever the centres' errors are."""
    for groups in (("a", "b", "c", "d", "e"), ("a", "b", "b", "b", "b")):
        views = views_of(np.random.default_rng(8), len(groups))
        result = calibrated([replace(view, group=group) for view, group in zip(views, groups, strict=True)])
        one = calibrated([replace(view, group="b") for view in views])
        assert len(result.models) == 1
        assert error(result) == pytest.approx(error(one), abs=1e-3 * one.sigma().max())
    rng = np.random.default_rng(4)
    images, truth = [], []
    for i, view in enumerate(views_of(rng, noise_px=0.005)):
        cells = np.array([[int(v) for v in label.split(":")[1:]] for label in view.labels])
        both = np.stack([cells, [BOARD.rows - 1, BOARD.columns - 1] - cells])
        centres = Centres.without_rims(view.centre_px, view.centre, view.shape, view.covariance_px2)
        seen = BoardSighting(np.arange(len(view)), both[::-1] if i % 3 == 1 else both)
        detection = ImageDetection(centres, (), (seen,))
        images.append(SimpleNamespace(file=SimpleNamespace(name=view.name, group="."), detection=detection))
        truth.append(view.labels)
    found = [view.labels for view in intrinsics.board_views(images, BOARD, TRUE)]
    agree = [a == b for a, b in zip(found, truth, strict=True)]
    assert all(agree) or not any(agree)  # which way up is by convention


def test_photographs_give_a_camera_file_that_runs_take_as_prior(stcal_sfm, small_set, small_dataset, tmp_path):
    """The camera file is a prior that covers the truth, and the figures beside it say the same."""
    own, out = small_set("12", "14", detected=False), tmp_path / "camera.txt"
    code, printed, _ = stcal_sfm("calibrate-camera", own.images, "--out", out, "--workers", 1)
    assert code == 0
    truth = read_camera(small_dataset / "cameras.txt").sized(1296, 864)
    assert "photographs differ" in printed
    # Terminal and file have the same principal point, half a pixel apart as the line below says.
    (shown,) = re.findall(r"^ *cx +([0-9.]+) ", printed, flags=re.MULTILINE)
    stated = out.read_text(encoding="utf-8").splitlines()[-1].split()
    assert stated[1] == "OPENCV"
    assert float(stated[6]) == pytest.approx(float(shown) + 0.5, abs=5.1e-5)  # four decimals are shown
    camera = read_camera(out).calibrated(truth.width, truth.height)
    prior = camera_prior(camera)
    assert prior.colmap_model == "OPENCV"
    e = model_parameters(camera, "OPENCV") - model_parameters(truth, "OPENCV")
    assert 0.05 < e @ np.linalg.solve(prior.covariance, e) / 8 < chi2.ppf(0.999, 8) / 8
    assert (np.sqrt(np.diag(prior.covariance))[:2] < 1e-3 * truth.focal[0]).all()

    summary = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert list(summary["parameters"]) == parameter_names("OPENCV")
    assert summary["parameters"]["cx"]["value"] == pytest.approx(camera.centre[0], abs=1e-9)
    assert summary["parameters"]["cx"]["sigma"] == pytest.approx(np.sqrt(prior.covariance[2, 2]))
    assert 0.001 < summary["residual_rms_px"] < 0.025
    assert len(summary["images"]) == 8
    assert summary["photographs_differ"] < 1.5
    assert 2 <= summary["rounds"] <= 3  # detected again with the camera found
    # Views that keep to the middle: their corners are extrapolated, and the report says so.
    assert any("no dots near the corner" in warning for warning in summary["warnings"])


@pytest.mark.parametrize(("bow_mm", "spread", "count", "factor"), [(0.3, 1.0, 12, 1.0), (0.0, 0.4, 20, 0.45)])
def test_a_bend_of_the_board_is_none_of_its_dots_and_dots_nearer_than_stated_are_told(bow_mm, spread, count, factor):
    """χ² of 8 parameters stays below 26 (p = 0.001); the factor of 3 · 63 dots scatters by 5 %."""
    rng = np.random.default_rng(3)
    xy = BOARD.xy_mm() - BOARD.xy_mm().mean(axis=0)
    made = np.column_stack([BOARD.xy_mm(), np.zeros(63)]) + spread * BOARD.sigma_mm * rng.standard_normal((63, 3))
    made[:, 2] += bow_mm * (xy**2).sum(axis=1) / (xy**2).sum(axis=1).max()  # like a dish, by that at its corners
    result = calibrated(views_of(rng, count, made=made))
    e = error(result)
    assert e @ np.linalg.solve(result.covariance, e) < 26
    assert 0.75 * factor < result.factors.dots < 1.25 * factor
    bent = result.models[0].xyz_model[:, 2]
    assert np.ptp(bent) == pytest.approx(bow_mm, abs=0.06)  # six σ of the dots at random, two at each end


def test_a_descent_that_does_not_end_begins_again_and_says_so(monkeypatch):
    views = views_of(np.random.default_rng(7))
    plain, own, calls = calibrated(views), intrinsics._adjusted, []

    def endless_first(*given):
        calls.append(given)
        if len(calls) == 1:
            raise ConvergenceError("E-NO-MINIMUM", "projections still move")
        return own(*given)

    monkeypatch.setattr(intrinsics, "_adjusted", endless_first)
    again = calibrated(views)
    assert (plain.restarted, again.restarted, len(calls)) == (False, True, 2)
    np.testing.assert_allclose(again.camera.parameters(), plain.camera.parameters(), rtol=1e-4)  # the same minimum
    warned = [
        any("other minima" in line for line in calibration._warnings(result, projection_sigma(result), BOARD))
        for result in (plain, again)
    ]
    assert warned == [False, True]
