"""Poses from simulated corners: covariance, branches, tags that are wrong; and the published steps, each for itself."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from stcal.boards.tags import Tags
from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.locate.estimate import SeenTags, locate, merge
from stcal.locate.scenes import exposure_times
from stcal.locate.verdict import PatentOptions, VerdictOptions, gate, judge, largest_area, locate_as_patent
from tests.outcome import refuses
from tests.support.tags import CAMERA, CornerNoise, example_layout, random_pose, simulated_exposures

SIX = (0, 1, 2, 3, 4, 5)
LAYOUT = example_layout()


def error_of(pose, truth: Rigid) -> np.ndarray:
    return pose.camera_from_obj.difference(truth)


@pytest.mark.full
@pytest.mark.parametrize(
    ("shown", "layout", "shared"),
    [
        (((0, 1, 2, 5), (2, 3, 4), (4, 5)), LAYOUT, 0.5),
        ((SIX,), replace(example_layout(0.03, 0.2), tag_sigma_px=0.4), 0.0),
    ],
)
def test_the_covariance_is_true(shown, layout, shared):
    """Mean of eᵀC⁻¹e/6 over 500 poses: 1, with σ 0.026; the band is four of them."""
    rng = np.random.default_rng(5)
    squares, fits = [], []
    for _ in range(500):
        truth = random_pose(rng)
        seen = merge(simulated_exposures(layout, truth, rng, CornerNoise(shared=shared), shown), layout).seen
        pose = locate(seen, layout, CAMERA)
        error = error_of(pose, truth)
        squares.append(error @ np.linalg.solve(pose.covariance, error) / 6)
        fits.append(pose.chi2_per_redundancy())
    assert 0.9 < np.mean(squares) < 1.1
    assert 0.9 < np.mean(fits) < 1.1


@pytest.mark.full
def test_intrinsics_with_sigma_make_the_pose_as_uncertain():
    rng = np.random.default_rng(2)
    sigma = np.array([3.0, 3.0, 2.0, 2.0])
    plain = Camera(1600, 1200, [1350.0, 1350.0], [799.5, 599.5], np.zeros(8))
    squares, held = [], []
    for _ in range(100):
        truth = random_pose(rng)
        off = np.append(sigma * rng.standard_normal(4), np.zeros(8))
        real = plain.with_parameters(plain.parameters()[:12] + off)
        seen = merge(simulated_exposures(LAYOUT, truth, rng, camera=real), LAYOUT).seen
        for prior, into in ((CameraPrior("PINHOLE", np.diag(sigma**2)), squares), (None, held)):
            pose = locate(seen, LAYOUT, plain, prior)
            error = error_of(pose, truth)
            into.append(error @ np.linalg.solve(pose.covariance, error) / 6)
    assert 0.8 < np.mean(squares) < 1.2  # σ of the mean 0.058
    assert np.mean(held) > 3


@pytest.mark.slow
def test_no_flipped_pose_is_accepted():
    """A single tag far away, and noisy: many poses cannot be told from their mirror image, and are not."""
    rng = np.random.default_rng(3)
    layout = example_layout(0.03, 0.2)
    accepted = flipped = ambiguous = turned = 0
    for _ in range(100):
        truth = random_pose(rng, 1500.0, (15, 50))
        seen = merge(simulated_exposures(layout, truth, rng, shown=((0,),)), layout).seen
        pose, verdict = judge(locate(seen, layout, CAMERA), VerdictOptions(max_sigma_deg=10))
        off = np.linalg.norm(error_of(pose, truth)[:3]) > np.radians(15)
        turned += off
        accepted += verdict.decision == "accept"
        ambiguous += verdict.decision == "ambiguous"
        flipped += off and verdict.decision == "accept"
    assert flipped == 0
    assert turned > 5  # or the test would say nothing
    assert ambiguous > 25


def test_both_minima_are_refined_and_covered_by_one_covariance_where_they_are_one():
    truth = Rigid.exp([0.4, 0, 0, 0, 0, 1500.0])
    layout = example_layout(0.03, 0.2)
    seen = merge(simulated_exposures(layout, truth, np.random.default_rng(0), shown=((0,),)), layout).seen
    pose = locate(seen, layout, CAMERA)
    tilts = sorted(p.rotation[1, 2] for p in (pose.camera_from_obj, pose.second))
    assert tilts[0] < -0.2
    assert tilts[1] > 0.2
    assert 0 <= pose.delta_chi2 < 60
    assert judge(pose, VerdictOptions(max_sigma_deg=90.0))[1].decision == "ambiguous"
    away = pose.second.difference(pose.camera_from_obj)
    equal, verdict = judge(pose, VerdictOptions(equal_deg=90.0, max_sigma_deg=90.0))
    assert verdict.decision == "accept"
    odds = np.exp(-pose.delta_chi2 / 2)
    assert np.allclose(equal.covariance - pose.covariance, odds / (1 + odds) * np.outer(away, away))


def with_wrong_tag(rows: list[int], row: int) -> SeenTags:
    """One tag of the scene is shown where it is not."""
    truth = Rigid.exp([0.3, 0.1, 0, 0, 0, 700.0])
    tags = simulated_exposures(LAYOUT, truth, np.random.default_rng(0), shown=(rows,))[0]
    corners = np.array(tags.corners_px)
    corners[rows.index(row)] += [40.0, -25.0]
    return merge([Tags(tags.tags, corners, tags.joint_px2)], LAYOUT).seen


def test_a_wrong_tag_is_left_out_two_that_contradict_are_rejected_and_none_is_refused():
    pose = locate(with_wrong_tag(list(SIX), 2), LAYOUT, CAMERA)
    assert pose.outliers == (2,)
    assert np.linalg.norm(error_of(pose, Rigid.exp([0.3, 0.1, 0, 0, 0, 700.0]))[:3]) < np.radians(0.3)
    _, verdict = judge(locate(with_wrong_tag([0, 3], 3), LAYOUT, CAMERA))
    assert verdict.decision == "reject"
    assert verdict.reasons[0].startswith("chi2 per dof")
    empty = SeenTags(np.zeros(0, int), np.zeros((0, 4, 2)), np.zeros((0, 8, 8)), np.zeros(0))
    refuses("E-LOCATE-NO-TAG", locate, empty, LAYOUT, CAMERA)


def test_shared_errors_do_not_average_out():
    """Nine exposures: with independent noise σ falls to a third, with common noise not at all."""
    truth = Rigid.exp([0.3, 0.1, 0, 0, 0, 700.0])
    exact = example_layout(1e-6)
    sigma = {}
    for shared, count in product((0.0, 1.0), (1, 9)):
        rng = np.random.default_rng(4)
        seen = merge(simulated_exposures(exact, truth, rng, CornerNoise(0.3, shared), (SIX,) * count), exact).seen
        sigma[shared, count] = np.sqrt(np.trace(seen.covariance_px2, axis1=1, axis2=2).mean() / 8)
    assert sigma[0.0, 9] / sigma[0.0, 1] == pytest.approx(1 / 3, rel=0.1)
    assert sigma[1.0, 9] / sigma[1.0, 1] == pytest.approx(1, rel=0.1)


EXACT = example_layout(1e-6)
TRUTH = Rigid.exp([0.4, -0.1, 0.2, 10, 5, 600.0])


def tag_at(x: float, y: float, side: float = 10.0) -> np.ndarray:
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


def test_exposure_times_are_a_geometric_series_and_exposures_are_chosen_by_number_and_area():
    assert np.allclose(exposure_times(1.0, 16.0, 5), [1, 2, 4, 8, 16])
    refuses("E-EXPOSURES-VALUE", exposure_times, 0.0, 1.0, 3)
    refuses("E-EXPOSURES-VALUE", exposure_times, 1.0, 2.0, 1)
    small = np.stack([tag_at(0, 0), tag_at(20, 0)])
    large = np.stack([tag_at(0, 0), tag_at(90, 0)])
    single = tag_at(0, 0)[None]
    corners = [small, single, large, large + 1]
    area, chosen = largest_area(corners, 0.8)
    assert (list(area), chosen) == ([0, 2, 3], [2, 3])
    assert largest_area(corners, 0.2)[1] == [0, 2, 3]
    assert largest_area(corners, area[0] / area[2])[1] == [2, 3]  # more than S_dis, as written


def test_the_exposure_with_the_smallest_error_is_kept():
    rng = np.random.default_rng(0)
    coarse_fine_few = [
        simulated_exposures(EXACT, TRUTH, rng, CornerNoise(sigma_px, 0.0), (shown,))[0]
        for sigma_px, shown in ((0.5, SIX), (0.01, SIX), (0.0, (0, 1)))
    ]
    found = locate_as_patent(coarse_fine_few, EXACT, CAMERA, PatentOptions())
    assert (found.exposure, found.candidates) == (1, (0, 1))
    coarse, fine, few = found.exposures
    assert [(each.tags, each.candidate) for each in found.exposures] == [(6, True), (6, True), (2, False)]
    assert (fine.errors_px, fine.det_j) == (found.errors_px, found.det_j)
    assert coarse.errors_px[0] > found.errors_px[0]
    assert few.area_px2 is few.poses is None
    assert (found.camera_from_obj @ TRUTH.inverse()).angle_rad() < np.radians(0.2)
    assert found.verdict.decision == "accept"


@pytest.mark.parametrize(
    ("det_j", "error", "ratio", "same", "reasons"),
    [
        (1e-6, 0.3, 5.0, False, []),
        (1e-9, 0.3, 5.0, False, ["det J"]),
        (1e-6, 1.3, 5.0, False, ["error 1.3"]),
        (1e-6, 0.3, 1.5, False, ["error ratio 1.5"]),
        (1e-6, 0.3, 1.0, True, []),
        (1e-9, 2.0, 1.0, False, ["det J", "error 2", "error ratio"]),
    ],
)
def test_the_gate(det_j, error, ratio, same, reasons):
    verdict = gate(det_j, error, ratio, same, PatentOptions())
    assert verdict.decision == ("reject" if reasons else "accept")
    assert len(verdict.reasons) == len(reasons)
    assert all(text.startswith(start) for text, start in zip(verdict.reasons, reasons, strict=True))


def test_a_pose_that_fits_exactly_has_a_ratio_and_none_is_named(monkeypatch):
    def refuse(xy, seen):
        raise DegenerateError("E-TEST", "no")

    flat = np.pad(EXACT.corners_mm.reshape(-1, 2), ((0, 0), (0, 1)))
    corners = CAMERA.project(TRUTH @ flat).reshape(-1, 4, 2)
    exact = Tags(EXACT.tags, corners, np.tile(np.eye(8), (len(corners), 1, 1)))
    assert locate_as_patent([exact], EXACT, CAMERA, PatentOptions()).verdict.decision == "accept"
    empty = Tags((), np.zeros((0, 4, 2)), np.zeros((0, 8, 8)))
    refuses("E-LOCATE-NO-TAG", locate_as_patent, [empty], EXACT, CAMERA, PatentOptions())
    monkeypatch.setattr("stcal.locate.verdict.poses_of_plane", refuse)
    refuses("E-LOCATE-NO-POSE … in any exposure", locate_as_patent, [exact], EXACT, CAMERA, PatentOptions())
