"""The initial pair, and labels into COLMAP's database and out of its models: angles, ids, order, pixel origin, every
reason to refuse, and what COLMAP must not change."""

import os
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from stcal import InputError, Rigid
from stcal.sfm.mapping.database import from_colmap_px, image_ids, match_labels, to_colmap_px, write_database
from stcal.sfm.mapping.incremental import BY_COLMAP, map_group
from stcal.sfm.mapping.pairs import PairOptions, image_graph, rank_pairs, triangulate
from tests.outcome import fails_with, refuses


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


def test_angles_are_those_of_the_scene_and_triangulation_returns_the_points(scene, group):
    by_name = {o.name: o for o in group}
    for pair in rank_pairs(group, scene.camera, PairOptions(np.radians(170))):
        # The eccentricity of up to 0.1 px is the only error here.
        expected = true_angle(scene, by_name[pair.first], by_name[pair.second])
        assert np.degrees(pair.median_angle_rad) == pytest.approx(expected, abs=0.5)
        assert pair.in_front == 1.0
    for depth in (1.5, -1.5):
        xyz = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) + np.array([0, 0, depth])
        b_from_a = Rigid.exp([0.1, -0.3, 0.05, 0.8, 0.1, 0.2])
        in_b = b_from_a @ xyz
        found, front = triangulate(xyz[:, :2] / xyz[:, 2:], in_b[:, :2] / in_b[:, 2:], b_from_a)
        np.testing.assert_allclose(found, xyz, atol=1e-12)
        assert (front == (depth > 0)).all()


def test_the_largest_angle_under_the_limit_wins_or_the_smallest_where_all_are_beyond(scene, group, monkeypatch):
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
    monkeypatch.setattr("stcal.sfm.mapping.pairs.SAFE_ANGLE_RAD", np.radians(2.0))
    ranked = rank_pairs(group, scene.camera, PairOptions())
    assert ranked[0].median_angle_rad == min(p.median_angle_rad for p in ranked)
    assert ranked[0].verdict.startswith("chosen")
    assert len(ranked) == 10


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
        (group[:1], PairOptions(), "E-MAPPING-NO-PAIR … 12: … 1 … from different places"),
        (still, PairOptions(), "E-MAPPING-NO-PAIR … 12: … 1 … median ray angle 0. … camera moved"),
        (turned, PairOptions(), "E-MAPPING-NO-PAIR"),
        (few, PairOptions(), "E-MAPPING-NO-PAIR … 8"),
        (group[:2], PairOptions(np.radians(1.5)), "E-MAPPING-NO-PAIR … --max-angle"),
    ):
        refuses(error, rank_pairs, images, scene.camera, options)


@pytest.fixture(scope="module")
def observed(scene, labels_only):
    return labels_only.observations(scene, 0.003, np.random.default_rng(0))


@pytest.fixture(scope="module")
def database(scene, observed, tmp_path_factory):
    path = tmp_path_factory.mktemp("database") / "database.db"
    write_database(path, scene.camera, observed, image_graph(observed, scene.board, "all").pairs)
    return path


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no such limit there")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_database_that_finds_no_space_is_one_error_and_nothing_is_left(scene, observed, tmp_path):
    """COLMAP's transaction ended the process instead. Each size is tried in a process of its own."""
    import resource

    pairs = np.array([(i, j) for i in range(6) for j in range(i)])
    write_database(tmp_path / "whole.db", scene.camera, observed[:6], pairs)
    ends = []
    for size in range(0, (tmp_path / "whole.db").stat().st_size, 20_000):
        if (child := os.fork()) == 0:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
            try:
                write_database(tmp_path / "cut.db", scene.camera, observed[:6], pairs)
                os._exit(0)
            except InputError as error:
                os._exit(error.exit_code if error.code == "E-OUTPUT-UNWRITABLE" else 9)
            finally:
                os._exit(8)
        ends.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        assert [path.name for path in tmp_path.iterdir()] == ["whole.db"], size
    assert set(ends) == {2}
    assert len(ends) > 3


def test_a_database_holds_one_camera_frames_keypoints_half_a_pixel_on_and_matches_of_labels(scene, database, observed):
    """COLMAP puts the centre of the first pixel at (0.5, 0.5); float32 leaves half a step of 2.4e-4 px near 2592. It
    projects where our camera does. Pairs are calibrated: it passes over others. Board dots match in a group only,
    target circles everywhere."""
    assert sorted(p.name for p in database.parent.iterdir()) == ["database.db"]
    with pycolmap.Database.open(str(database)) as opened:
        camera = opened.read_camera(1)
        assert (opened.num_cameras(), opened.num_rigs()) == (1, 1)
        assert opened.num_images() == opened.num_frames() == len(observed)
        pairs, geometries = opened.read_two_view_geometries()
        assert len(pairs) == opened.num_matched_image_pairs() > 0
        assert {g.config for g in geometries} == {pycolmap.TwoViewGeometryConfiguration.CALIBRATED}
        images = {image.image_id: image.name for image in opened.read_all_images()}
        assert images == {i: name for name, i in image_ids(observed).items()}
        for image in observed:
            stored = opened.read_keypoints(image_ids(observed)[image.name])[:, :2].astype(float)
            back = from_colmap_px(stored)
            assert np.abs(back - image.centre_px).max() < 1.3e-4
            assert np.abs(stored - image.centre_px - 0.5).max() < 1.3e-4
    assert camera.has_prior_focal_length
    np.testing.assert_array_equal(from_colmap_px(to_colmap_px([[10.0, 20.0]])), [[10.0, 20.0]])
    xyz = np.array([[0.1, -0.2, 1.0], [-0.3, 0.2, 1.1]])
    theirs = np.array([camera.img_from_cam(point) for point in xyz])
    assert np.abs(theirs - 0.5 - scene.camera.project(xyz)).max() < 1e-9
    a = observed[0]
    same = next(o for o in observed[1:] if o.group == a.group)
    other = next(o for o in observed if o.group != a.group and set(o.face_ids()) & set(a.face_ids()))
    assert any(a.labels[i].startswith("board:") for i, _ in match_labels(a, same))
    across = match_labels(a, other)
    assert len(across) >= 10
    assert not any(a.labels[i].startswith("board:") for i, _ in across)
    assert all(a.labels[i] == other.labels[j] for i, j in across)


def map_one(scene, observed, database, group):
    own = [o for o in observed if o.group == group]
    pairs = rank_pairs(own, scene.camera, PairOptions())
    ids = image_ids(observed)
    return own, map_group(database, own, list(ids), ids, pairs, scene.camera)


def test_all_images_are_mapped_from_the_pair_or_no_model_is_named(scene, observed, database, monkeypatch):
    own, mapping = map_one(scene, observed, database, "12")
    assert set(mapping.model.images) == {o.name for o in own}
    assert "the relative pose of the chosen pair" in mapping.seeded
    monkeypatch.setattr("stcal.sfm.mapping.incremental._mapped", lambda *_: None)
    own, mapping = map_one(scene, observed, database, "12")
    assert (set(mapping.model.images), mapping.seeded) == ({o.name for o in own}, BY_COLMAP)
    assert sorted(p.name for p in database.parent.iterdir()) == ["database.db"]
    monkeypatch.setattr("stcal.sfm.mapping.incremental.seeded_mapping", lambda *_: None)
    with fails_with("E-MAPPING-NO-MODEL … 12"):
        map_one(scene, observed, database, "12")


def test_the_same_seed_gives_the_same_model(scene, observed, database):
    _, a = map_one(scene, observed, database, "14")
    _, b = map_one(scene, observed, database, "14")
    np.testing.assert_array_equal(a.model.xyz_model, b.model.xyz_model)
