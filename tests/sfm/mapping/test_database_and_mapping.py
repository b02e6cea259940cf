"""Labels into COLMAP's database and out of its models: ids, order, pixel origin, and what COLMAP must not change."""

import os

import numpy as np
import pycolmap
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import align_similarity
from stcal.sfm.mapping.database import from_colmap_px, image_ids, labels_csv, match_labels, to_colmap_px, write_database
from stcal.sfm.mapping.incremental import map_group
from stcal.sfm.mapping.models import write_model
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


def test_the_pixel_origin_moves_by_half_a_pixel_and_back(scene, database, observed):
    """COLMAP puts the centre of the first pixel at (0.5, 0.5); float32 leaves half a step of 2.4e-4 px near 2592. It
    projects where our camera does."""
    with pycolmap.Database.open(str(database)) as opened:
        camera = opened.read_camera(1)
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


def test_one_camera_one_rig_a_frame_for_each_image_and_calibrated_pairs(database, observed):
    assert sorted(p.name for p in database.parent.iterdir()) == ["database.db"]
    with pycolmap.Database.open(str(database)) as opened:
        assert (opened.num_cameras(), opened.num_rigs()) == (1, 1)
        assert opened.num_images() == opened.num_frames() == len(observed)
        pairs, geometries = opened.read_two_view_geometries()
        assert len(pairs) == opened.num_matched_image_pairs() > 0
        assert {g.config for g in geometries} == {pycolmap.TwoViewGeometryConfiguration.CALIBRATED}
        images = {image.image_id: image.name for image in opened.read_all_images()}
    assert images == {i: name for name, i in image_ids(observed).items()}


def test_board_dots_match_in_a_group_only_and_target_circles_everywhere(observed):
    a = observed[0]
    same = next(o for o in observed[1:] if o.group == a.group)
    other = next(o for o in observed if o.group != a.group and set(o.face_ids()) & set(a.face_ids()))
    assert any(a.labels[i].startswith("board:") for i, _ in match_labels(a, same))
    across = match_labels(a, other)
    assert len(across) >= 10
    assert not any(a.labels[i].startswith("board:") for i, _ in across)
    assert all(a.labels[i] == other.labels[j] for i, j in across)


def test_labels_csv_joins_by_image_and_keypoint(observed):
    residual = [np.where(np.arange(len(o))[:, None] == 1, np.nan, o.centre_px + 0.5) for o in observed]
    rows = labels_csv(observed, [o.centre_px - 0.01 for o in observed], residual).splitlines()
    first = rows[1].split(",")
    assert first[:2] == ["1", "0"]
    assert first[4] == observed[0].labels[0]
    assert float(first[5]) == observed[0].centre_px[0, 0]  # float64, not the database's float32
    assert float(first[7]) == observed[0].centre_px[0, 0] - 0.01
    assert [float(each) for each in first[12:]] == (observed[0].centre_px[0] + 0.5).tolist()
    assert rows[2].split(",")[12:] == ["", ""]  # not in the result
    assert len(rows) == 1 + sum(len(o) for o in observed)


def map_one(scene, observed, database, tmp_path, group, pairs=None):
    own = [o for o in observed if o.group == group]
    pairs = pairs or rank_pairs(own, scene.camera, PairOptions())
    ids = image_ids(observed)
    return own, map_group(database, tmp_path / "scratch", own, list(ids), ids, pairs, scene.camera)


def truth_of(scene, model):
    board = dict(zip(scene.board.labels(), scene.groups[model.group].board_circles_target, strict=True))
    return np.array([scene.circles_target[k] if k in scene.circles_target else board[k] for k in model.labels])


def test_every_image_registers_and_the_shape_is_right(scene, observed, database, tmp_path):
    for group in scene.groups:
        own, mapping = map_one(scene, observed, database, tmp_path, group)
        assert set(mapping.model.images) == {o.name for o in own}
        assert mapping.left_out == {}
        truth = truth_of(scene, mapping.model)
        target_from_model = align_similarity(truth, mapping.model.xyz_model)
        error = np.linalg.norm(target_from_model @ mapping.model.xyz_model - truth, axis=1)
        # 0.003 px of noise is 2 µm; the eccentricity, not yet corrected here, adds tens.
        assert np.median(error) < 0.1


def test_our_own_pose_is_registered_where_colmap_refuses_the_pair_or_no_model_is_named(
    scene, observed, database, tmp_path, monkeypatch
):
    monkeypatch.setattr("stcal.sfm.mapping.incremental.seeded_mapping", lambda *_: None)
    own, mapping = map_one(scene, observed, database, tmp_path, "12")
    assert set(mapping.model.images) == {o.name for o in own}
    assert "our relative pose" in mapping.seeded
    monkeypatch.setattr("stcal.sfm.mapping.incremental._own_mapping", lambda *_: None)
    with fails_with("E-MAPPING-NO-MODEL … 12"):
        map_one(scene, observed, database, tmp_path, "12")


def test_the_same_seed_gives_the_same_model(scene, observed, database, tmp_path):
    _, a = map_one(scene, observed, database, tmp_path, "14")
    _, b = map_one(scene, observed, database, tmp_path, "14")
    np.testing.assert_array_equal(a.model.xyz_model, b.model.xyz_model)


def test_the_written_model_is_colmaps_and_keeps_the_keypoints(scene, observed, database, tmp_path):
    own, mapping = map_one(scene, observed, database, tmp_path, "12")
    write_model(tmp_path / "model", [mapping.model], observed, image_ids(observed), scene.camera)
    read = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert read.num_reg_images() == len(own)
    assert read.num_points3D() == len(mapping.model.labels)
    for image in own:
        stored = read.image(image_ids(observed)[image.name])
        assert stored.name == image.name
        assert np.abs(np.array([p.xy for p in stored.points2D]) - 0.5 - image.centre_px).max() < 1e-9
    # COLMAP's own residuals over the corrected points agree with ours.
    ours = np.linalg.norm(mapping.model.residuals_px(scene.camera), axis=1).mean()
    assert read.compute_mean_reprojection_error() == pytest.approx(ours, rel=0.05)
