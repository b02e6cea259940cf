"""Residual field and cubes: where a registration holds; and its text, page and JSON."""

import json
import re
from functools import cache

import numpy as np
import pytest

from stcal.geometry.rigid import skew
from stcal.io.files import json_text
from stcal.register import Pairs, register
from stcal.register.consensus import MODELS, Problem, problem_of
from stcal.register.registration_report import FEW_ROWS, RegistrationFile, registration_report
from stcal.register.workspace import GRID, MOST_POINTS, cubes, findings, residual_field
from stcal.report.document import Section
from tests.support.point_pairs import B_FROM_A

pytestmark = pytest.mark.slow

SIGMA = 0.05


def bend(xyz: np.ndarray) -> np.ndarray:
    """Smooth, some tenths of a mm, and no transform."""
    x, y, z = (xyz / 100).T
    return 0.3 * np.column_stack([np.sin(1.5 * y) + 0.5 * x * z, np.cos(1.2 * z), x**2])


def bent(seed: int, n: int, sigma: float = SIGMA, half: float = 100.0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(-half, half, (n, 3))
    return a, B_FROM_A @ (a + bend(a)) + rng.normal(0, sigma, a.shape)


def inputs(found, a, b, covariances=None) -> Problem:
    return problem_of(MODELS[found.model], a, b, None, covariances)


def fitted(a, b):
    found = register(a, b, method="least-squares", folds=0)
    return found, residual_field(found, inputs(found, a, b))


def test_noise_is_not_taken_for_a_field_which_predicts_new_places_and_knows_how_well():
    """One case in a hundred may be: more than one of 8 has a chance of 0.3 %."""
    seen = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        a = rng.uniform(-100, 100, (30, 3))
        seen += fitted(a, B_FROM_A @ a + rng.normal(0, SIGMA, a.shape))[1].seen
    assert seen <= 1
    squares, plain, corrected = [], [], []
    for seed in range(4):
        a, b = bent(seed, 80)
        found, field = fitted(a, b)
        assert field.seen
        new = np.random.default_rng(100 + seed).uniform(-100, 100, (300, 3))
        true = B_FROM_A @ (new + bend(new)) - found.b_from_a @ new
        error, covariance = field.at(new)
        off = true - error
        squares.append(np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).mean() / 3)
        plain.append(np.linalg.norm(true, axis=1).mean())
        corrected.append(np.linalg.norm(off, axis=1).mean())
        # 300 numbers of noise, of which the field takes up to a third: σ is known to 5 %
        assert field.noise_mm == pytest.approx(SIGMA, rel=0.2)
        assert field.sigma_ratio == pytest.approx(1, abs=0.1)
    assert np.mean(corrected) < np.mean(plain) / 3
    # Errors of neighbours go together, so that 4 × 300 places tell the ratio to some 25 % only.
    assert 0.7 < np.mean(squares) < 1.4


def test_errors_of_points_left_out_are_those_of_refits_and_few_points_have_no_field():
    a, b = bent(3, 25)
    _, field = fitted(a, b)
    for i in range(0, 25, 6):
        rest = np.delete(np.arange(25), i)
        refit = register(a[rest], b[rest], method="least-squares", folds=0).b_from_a
        # the field takes small motions to be linear: good to their square, 1e-6
        assert field.plain_mm[i] == pytest.approx(np.linalg.norm(b[i] - refit @ a[i]), rel=1e-3)
    assert field.corrected_mm.mean() < field.plain_mm.mean()
    assert fitted(*bent(0, 5))[1] is None
    assert len(fitted(*bent(0, 3 * MOST_POINTS))[1].rows) == MOST_POINTS


def test_bent_points_are_taken_back_and_wild_ones_are_not():
    a, b = bent(4, 120)
    wild = [5, 50, 90]
    b[wild] += [[2.0, 0, 0], [0, -3, 0], [0, 0, 4]]
    found = register(a, b, threshold_mm=0.25, folds=0)
    lost = set(found.outliers) - set(wild)
    assert len(lost) >= 5
    field = residual_field(found, inputs(found, a, b))
    assert set(field.taken_back) <= lost
    assert len(field.taken_back) > len(lost) / 2


def test_points_of_different_sigma():
    """A third of the points is ten times as noisy: told so, the field is far better than without."""
    rng = np.random.default_rng(6)
    a = rng.uniform(-100, 100, (90, 3))
    sigma = np.where(np.arange(90) % 3 == 0, 10 * SIGMA, SIGMA)
    b = B_FROM_A @ (a + bend(a)) + rng.normal(0, 1, a.shape) * sigma[:, None]
    new = rng.uniform(-100, 100, (200, 3))
    errors = {}
    for name, given in (("told", sigma**2), ("untold", None)):
        found = register(a, b, method="least-squares", covariances=given, folds=0)
        field = residual_field(found, inputs(found, a, b, given))
        off = B_FROM_A @ (new + bend(new)) - found.b_from_a @ new - field.at(new)[0]
        errors[name] = np.linalg.norm(off, axis=1).mean()
        if name == "told":
            assert field.sigma_ratio == pytest.approx(1, abs=0.12)
            assert field.noise_mm == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=0.2)
    assert errors["told"] < 0.7 * errors["untold"]


def test_cubes_by_hand_and_without_points_or_width():
    """A grid, undisturbed within 100 mm of its middle, the rest shifted by 5 mm."""
    steps = np.linspace(-200, 200, 9)
    a = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3) + np.array([800, 200, 700])
    far = np.abs(a - [800, 200, 700]).max(1) > 110
    b = B_FROM_A @ a + np.where(far[:, None], [3.0, 0.0, 4.0], 0.0)
    found = register(a, b, threshold_mm=10.0, folds=0)
    assert found.inliers.all()
    result = cubes(found, inputs(found, a, b))
    np.testing.assert_allclose(result.middle, [800, 200, 700])
    np.testing.assert_allclose(result.sides_mm, [100, 200, 300, 400])
    inner = result.errors[0]
    assert [e.points for e in inner] == [27, 125 - 27, 343 - 125, 729 - 343]
    np.testing.assert_allclose([e.max_mm for e in inner], [0, 0, 5, 5], atol=1e-9)
    np.testing.assert_allclose([e.mean_mm for e in inner], [0, 0, 5, 5], atol=1e-9)
    # fitted to all, the error is shared: of 729 points 125 stand still, so that the shift is 5 · 604/729 in the middle
    outer = result.errors[3]
    assert outer[0].mean_mm == pytest.approx(5 * 604 / 729, rel=0.02)
    assert outer[3].mean_mm == pytest.approx(5 * 125 / 729, rel=0.05)
    a, b = bent(0, 8)
    found = register(a, b, folds=0)
    assert cubes(found, inputs(found, a, b)) is None
    rng = np.random.default_rng(0)
    flat = np.vstack([rng.uniform(-50, 50, (20, 3)) * [1, 1, 0], rng.uniform(-200, 200, (60, 3))])
    found = register(flat, B_FROM_A @ flat, model="affine", method="least-squares", folds=0)
    result = cubes(found, inputs(found, flat, B_FROM_A @ flat))
    assert result.sides_mm[0] > 100  # the plane in the middle determines no affine transform: left out


def test_points_in_the_cube_are_held_out():
    """Ten points in it: a fit to them has residuals 1 − 6/30 of the noise's square, held out it is above."""
    inside = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        a = np.vstack([rng.uniform(-50, 50, (10, 3)), rng.uniform(-50, 50, (10, 3)) + np.array([0, 0, 150])])
        b = B_FROM_A @ a + rng.normal(0, 1, a.shape)
        found = register(a, b, method="least-squares", folds=0)
        result = cubes(found, inputs(found, a, b), folds=10)
        inside.append(result.errors[-1][-1].rms_mm if result.errors[-1][-1] else np.nan)
    # 20 points: held out 1 + 6/60 of the noise's variance of 3, in sample 1 − 6/60
    assert np.sqrt(3) < np.nanmean(inside) < np.sqrt(3 * 1.25)


WILD = (3, 17)


@cache
def found_of(n=40, model="rigid", wild=WILD, where="pairs <a&b>.csv", bend=0.0, method="robust", **options):
    rng = np.random.default_rng(0)
    a = rng.uniform(-200, 200, (n, 3)) + np.array([800, 200, 700])
    b = B_FROM_A @ (a + bend * np.sin(a[:, [1, 2, 0]] / 70)) + rng.normal(0, 0.1, a.shape)
    for i in wild:
        b[i] += [5.0 + i, 0, 0]
    result = register(a, b, model=model, method=method, **options)
    return findings(Pairs(where, range(2, n + 2), a, b), result)


def test_text_tells_transform_outliers_and_reach_and_the_answer_at_its_head():
    """Least squares cannot know wrong pairs, and a bent frame or few pairs are no "yes" either."""
    text = registration_report(found_of()).text()
    assert "40 point pairs, rigid, robust" in text
    assert "38 inliers, 2 outliers" in text
    rows = [line.split() for line in text.splitlines() if "OUTLIER" in line]
    assert sorted(row[:3] for row in rows) == [["line", "19", "OUTLIER"], ["line", "5", "OUTLIER"]]
    np.testing.assert_allclose(sorted(float(row[-1]) for row in rows), [8, 22], atol=0.5)
    lines = text[text.index("b_from_a") :].splitlines()[1:5]
    matrix = np.array([re.findall(r"-?\d+\.\d+", line) for line in lines], float)
    np.testing.assert_allclose(matrix, B_FROM_A.matrix(), atol=1.0)
    assert "no systematic residuals seen" in text
    assert re.search(r"held out \(6 folds\), inliers +38 ", text)
    assert max(map(len, text.splitlines())) < 320
    few = registration_report(found_of(n=FEW_ROWS - 4)).text()
    assert len(re.findall(r"line \d+ +(?:inlier|OUTLIER)", few)) == FEW_ROWS - 4
    answers = {
        "Yes: inliers that are held out are missed by": found_of(),
        "With care: least squares takes every pair as right": found_of(wild=(), method="least-squares"),
        "With care: residuals are systematic": found_of(n=60, bend=0.15),
        "With care: no pairs were held out": found_of(folds=0),
    }
    for answer, found in answers.items():
        assert registration_report(found).text().splitlines()[1].startswith(f"May I use it? {answer}")


def test_rows_that_do_not_correspond_are_no_noise_and_a_bent_frame_is_said():
    rng = np.random.default_rng(1)
    a = rng.uniform(-1000, 1000, (40, 3))
    b = 0.5 * a + rng.normal(0, 200, a.shape)
    found = findings(Pairs("x", range(40), a, b), register(a, b, method="least-squares", folds=0))
    text = registration_report(found).text()
    assert "no systematic residuals" not in text
    assert "do not use this transform" in text
    text = registration_report(found_of(n=90, bend=0.6, allow_ambiguous=True)).text()
    assert "residuals are systematic" in text
    assert re.search(r"fitted in the cube of \d+ mm it holds within [\d.]+ mm there, [\d.]+ mm to \d+ mm", text)


@pytest.mark.parametrize("model", ["rigid", "affine"])
def test_json_is_the_result(model):
    result = found_of(model=model)
    content = json.loads(json_text(RegistrationFile.model_validate(result)))
    assert content["format"] == "stcal registration 1"
    matrix = np.array(content["b_from_a"])
    a = result.xyz_a
    np.testing.assert_allclose(a @ matrix[:3, :3].T + matrix[:3, 3], result.b_from_a @ a, atol=1e-9)
    p = {"rigid": 6, "affine": 12}[model]
    assert np.shape(content["covariance"]) == (p, p)
    assert len(content["covariance_of"]) == p
    assert content["inliers"] == result.inliers.tolist()
    np.testing.assert_allclose(content["residuals"], result.residuals, atol=1e-9)
    assert content["lines"] == list(range(2, 42))
    assert [content["lines"][row] for row in content["outliers"]] == [19, 5]
    assert content["held_out"]["of_inliers"]["mean_mm"] == result.held_out.of_inliers.mean_mm
    assert len(content["field"]["grid"]["xyz_a_mm"]) == GRID**3
    assert np.shape(content["field"]["grid"]["error_mm"]) == (GRID**3, 3)
    assert len(content["cubes"]["errors"]) == len(content["cubes"]["sides_mm"])
    np.testing.assert_allclose(content["scales"], 1, atol=2e-3)


def test_pages_show_outliers_escape_names_and_have_three_points():
    page = registration_report(found_of(), [Section("One <more>", ["section"])]).page()
    assert "pairs &lt;a&amp;b&gt;.csv" in page
    assert "<a&b>" not in page
    assert page.count("data:image/svg+xml;base64,") == 1
    bent = registration_report(found_of(n=60, bend=0.15)).page()
    assert bent.count("data:image/svg+xml;base64,") == 2  # a systematic error is drawn, noise is not
    sections = ("result", "residuals-in-space", "where-it-holds", "one-more", "rows")
    order = [page.index(f'id="{key}"') for key in sections]
    assert order == sorted(order)
    assert "OUTLIER</td>" in page[page.index('id="rows"') :]
    page = registration_report(found_of(n=3, wild=())).page()
    assert "Too few points to tell" in page
    assert page.count("data:image/svg+xml;base64,") == 1
    assert 'class="alarm"' in page  # what three points do not tell is said


def test_sigma_of_the_transform_by_place():
    """Far from a's origin its turn, times the lever in frame b, adds to its shift: dy = dw × (R x) + dt."""
    found, place = found_of(), np.array([500.0, -80.0, 20.0])
    by_step = np.hstack([-skew(found.b_from_a.rotation @ place), np.eye(3)])
    expected = np.sqrt(np.diag(by_step @ found.covariance @ by_step.T))
    np.testing.assert_allclose(found.sigma_mm_at(place), expected, rtol=1e-9)
    np.testing.assert_allclose(found.sigma_mm_at(np.zeros(3)), np.sqrt(np.diag(found.covariance)[3:]), rtol=1e-9)
