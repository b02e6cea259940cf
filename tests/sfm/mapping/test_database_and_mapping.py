"""Labels into COLMAP's database and out of its models: ids, order, pixel origin, and what COLMAP must not change."""

import os

import numpy as np
import pycolmap
import pytest

from stcal.errors import InputError
from stcal.sfm.mapping.database import from_colmap_px, image_ids, match_labels, to_colmap_px, write_database
from stcal.sfm.mapping.incremental import map_group
from stcal.sfm.mapping.pairs import PairOptions, image_graph, rank_pairs
from tests.outcome import fails_with


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


def test_a_database_holds_one_camera_a_frame_for_each_image_and_the_keypoints_half_a_pixel_on(
    scene, database, observed
):
    """COLMAP puts the centre of the first pixel at (0.5, 0.5); float32 leaves half a step of 2.4e-4 px near 2592. It
    projects where our camera does. Pairs are calibrated: it passes over others."""
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


def test_board_dots_match_in_a_group_only_and_target_circles_everywhere(observed):
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
    monkeypatch.setattr("stcal.sfm.mapping.incremental._mapped", lambda *_: None)
    with fails_with("E-MAPPING-NO-MODEL … 12"):
        map_one(scene, observed, database, "12")


def test_the_same_seed_gives_the_same_model(scene, observed, database):
    _, a = map_one(scene, observed, database, "14")
    _, b = map_one(scene, observed, database, "14")
    np.testing.assert_array_equal(a.model.xyz_model, b.model.xyz_model)
