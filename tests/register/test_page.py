"""Text, page and JSON of a registration."""

import json
import re
from functools import cache

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid, skew
from stcal.io.files import json_text
from stcal.register import Pairs, register
from stcal.register.registration_report import FEW_ROWS, RegistrationFile, registration_report
from stcal.register.workspace import GRID, findings
from stcal.report.document import Section

B_FROM_A = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])
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


def test_text_tells_transform_outliers_and_reach():
    text = registration_report(found_of()).text()
    assert "40 point pairs, rigid, robust" in text
    assert "38 inliers, 2 outliers" in text
    rows = [line.split() for line in text.splitlines() if "OUTLIER" in line]
    assert sorted(row[:3] for row in rows) == [["line", "19", "OUTLIER"], ["line", "5", "OUTLIER"]]
    np.testing.assert_allclose(sorted(float(row[-1]) for row in rows), [8, 22], atol=0.5)
    lines = text[text.index("b_from_a") :].splitlines()[1:5]
    matrix = [re.findall(r"-?\d+\.\d+", line) for line in lines]
    np.testing.assert_allclose(np.array(matrix, float), B_FROM_A.matrix(), atol=1.0)
    assert "no systematic residuals seen" in text
    assert re.search(r"held out \(6 folds\), inliers +38 ", text)
    assert max(map(len, text.splitlines())) < 320
    few = registration_report(found_of(n=FEW_ROWS - 4)).text()
    assert len(re.findall(r"line \d+ +(?:inlier|OUTLIER)", few)) == FEW_ROWS - 4


def test_the_answer_is_at_the_head():
    """Least squares cannot know wrong pairs, and a bent frame or few pairs are no "yes" either."""
    answers = {
        "Yes: inliers that are held out are missed by": found_of(),
        "With care: least squares takes every pair as right": found_of(wild=(), method="least-squares"),
        "With care: residuals are systematic": found_of(n=60, bend=0.15),
        "With care: no pairs were held out": found_of(folds=0),
    }
    for answer, found in answers.items():
        assert registration_report(found).text().splitlines()[1].startswith(f"May I use it? {answer}")


def test_rows_that_do_not_correspond_are_no_noise():
    rng = np.random.default_rng(1)
    a = rng.uniform(-1000, 1000, (40, 3))
    b = 0.5 * a + rng.normal(0, 200, a.shape)
    text = registration_report(
        findings(Pairs("x", range(40), a, b), register(a, b, model="rigid", method="least-squares"))
    ).text()
    assert "no systematic residuals" not in text
    assert "do not use this transform" in text


def test_a_bent_frame_is_said():
    text = registration_report(found_of(n=90, bend=0.6, allow_ambiguous=True)).text()
    assert "residuals are systematic" in text
    assert re.search(r"fitted in the cube of \d+ mm it holds within [\d.]+ mm there, [\d.]+ mm to \d+ mm", text)


@pytest.mark.parametrize("model", ["rigid", "similarity", "affine"])
def test_json_is_the_result(model):
    result = found_of(model=model)
    content = json.loads(json_text(RegistrationFile.model_validate(result)))
    assert content["format"] == "stcal registration 1"
    matrix = np.array(content["b_from_a"])
    a = result.xyz_a
    np.testing.assert_allclose(a @ matrix[:3, :3].T + matrix[:3, 3], result.b_from_a @ a, atol=1e-9)
    p = {"rigid": 6, "similarity": 7, "affine": 12}[model]
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


@pytest.mark.slow
def test_page_shows_outliers_and_escapes_names():
    page = registration_report(found_of(), [Section("One <more>", ["section"])]).page()
    assert "pairs &lt;a&amp;b&gt;.csv" in page
    assert "<a&b>" not in page
    assert page.count("data:image/svg+xml;base64,") == 2
    order = [
        page.index(f'id="{key}"') for key in ("result", "residuals-in-space", "where-it-holds", "one-more", "rows")
    ]
    assert order == sorted(order)
    assert "OUTLIER</td>" in page[page.index('id="rows"') :]


def test_page_of_three_points():
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
