"""The initial pair: median ray angles as the geometry has them, the choice, and every reason to refuse."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.sfm.mapping.pairs import PairOptions, rank_pairs, triangulate
from tests.outcome import refuses


@pytest.fixture(scope="module")
def group(scene, labels_only):
    return [o for o in labels_only.observations(scene, 0.0, np.random.default_rng(0)) if o.group == "12"]


def true_angle(scene, a, b):
    """Median angle at the common points between the rays to both cameras."""
    g = scene.groups["12"]
    board = dict(zip(scene.board.labels(), g.board_circles_target, strict=True))
    both = [label for label in a.labels if label in set(b.labels)]
    xyz = np.array([scene.circles_target[k] if k in scene.circles_target else board[k] for k in both])
    rays = [g.camera_from_target[int(o.name.split("/")[1])].inverse().translation - xyz for o in (a, b)]
    cosine = (rays[0] * rays[1]).sum(1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    return np.degrees(np.median(np.arccos(cosine)))


def test_angles_are_those_of_the_scene(scene, group):
    by_name = {o.name: o for o in group}
    for pair in rank_pairs(group, scene.camera, PairOptions(np.radians(170))):
        # The eccentricity of up to 0.1 px is the only error here.
        expected = true_angle(scene, by_name[pair.first], by_name[pair.second])
        assert np.degrees(pair.median_angle_rad) == pytest.approx(expected, abs=0.5)
        assert pair.in_front == 1.0


def test_the_largest_angle_under_the_limit_wins_and_the_rest_is_ranked(scene, group):
    everything = rank_pairs(group, scene.camera, PairOptions(np.radians(170)))
    assert len(everything) == 10
    angles = [p.median_angle_rad for p in everything]
    assert angles == sorted(angles, reverse=True)
    assert all(pair.first < pair.second for pair in everything)  # the earlier image is the reference
    limit = (angles[2] + angles[3]) / 2
    limited = rank_pairs(group, scene.camera, PairOptions(limit))
    assert limited[0].verdict == "chosen"
    assert limited[0].median_angle_rad == pytest.approx(angles[3])
    assert sum("over the limit" in p.verdict for p in limited) == 3


def test_groups_without_an_initial_pair_say_why(scene, group):
    """Of a camera that did not move, or turned on the spot; of few circles; and of other angles than asked for."""
    rng, still, turned = np.random.default_rng(1), [], []
    for i, angle in enumerate((0.0, 0.05, 0.1)):
        xy = group[0].centre_px + rng.normal(0, 0.02, group[0].centre_px.shape)
        still.append(replace(group[0], name=f"12/{i}", centre_px=xy, centre=scene.camera.normalised_from_pixel(xy)))
        rays = np.column_stack([group[0].centre, np.ones(len(group[0]))]) @ Rigid.exp([0, angle, 0, 0, 0, 0]).rotation.T
        turned.append(replace(group[0], name=f"12/{i}", centre=rays[:, :2] / rays[:, 2:]))
    few = [group[0].select(range(6)), group[1].select(range(6, 12))]
    for images, options, error in (
        (still, PairOptions(), "E-MAPPING-NO-PAIR … 12: … 1"),
        (turned, PairOptions(), "E-MAPPING-NO-PAIR"),
        (few, PairOptions(), "E-MAPPING-NO-PAIR … 8"),
        (group[:2], PairOptions(np.radians(1.5)), "E-MAPPING-NO-PAIR … --max-angle"),
    ):
        refuses(error, rank_pairs, images, scene.camera, options)


def test_the_smallest_angle_serves_where_all_are_beyond_the_default(scene, group, monkeypatch):
    monkeypatch.setattr("stcal.sfm.mapping.pairs.SAFE_ANGLE_RAD", np.radians(2.0))
    ranked = rank_pairs(group, scene.camera, PairOptions())
    assert ranked[0].median_angle_rad == min(p.median_angle_rad for p in ranked)
    assert ranked[0].verdict.startswith("chosen")
    assert len(ranked) == 10


@pytest.mark.parametrize("depth", [1.5, -1.5])
def test_triangulation_returns_the_points(depth):
    xyz = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) + np.array([0, 0, depth])
    b_from_a = Rigid.exp([0.1, -0.3, 0.05, 0.8, 0.1, 0.2])
    in_b = b_from_a @ xyz
    found, front = triangulate(xyz[:, :2] / xyz[:, 2:], in_b[:, :2] / in_b[:, 2:], b_from_a)
    np.testing.assert_allclose(found, xyz, atol=1e-12)
    assert (front == (depth > 0)).all()
