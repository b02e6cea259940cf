"""Sparse graphs, the skeleton and resection: large sets, from labels without pixels."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.mapping.incremental import complete
from stcal.sfm.mapping.pairs import (
    MIN_SHARED,
    MIN_VIEWS,
    SKELETON,
    SPARSE_FROM,
    image_graph,
    incidence,
)
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.stages import Groups, Task, map_groups
from stcal.sfm.runs.transaction import RunFolder
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.scripts import script_path

NOISE_PX = 0.02
STUDY = script_path("scale_study")


@pytest.fixture(scope="module")
def crowd(labels_only):
    """Two groups of 50 views, one circle in ten missing in every image: scene and observations."""
    scene = make_scene(
        SceneOptions(seed=2, width=2592, height=1728, images_per_group=50, groups=(("1", "2"), ("1", "4")))
    )
    rng = np.random.default_rng(1)
    observed = labels_only.observations(scene, NOISE_PX, rng)
    return scene, [o.select(np.flatnonzero(rng.random(len(o)) > 0.1)) for o in observed]


def solve(scene, observations, kind, out):
    options = RunOptions().settled(scene.target)
    graph = image_graph(observations, scene.board, kind)
    out.mkdir()
    labelled = tuple(LabelledImage(image, ()) for image in observations)
    groups = Groups(labelled, tuple(scene.groups), graph, scene.camera, scene.board, options, False, ())
    task = Task(([], []), RunFolder(out, out, out), scene.target, scene.board, options, lambda *_: None)
    solutions = map_groups(task, groups).solutions
    models = [solution.model for solution in solutions]
    calibration = calibrate(models, scene.camera, scene.target, scene.board, options.adjustment(scene.target))
    return solutions, calibration


def require_same_tracks(scene, images) -> None:
    """Images of a track share a number, whatever the numbers are."""
    joined = np.zeros((2, len(images), len(images)), bool)
    for own, kind in zip(joined, ("all", "sparse"), strict=True):
        own[tuple(image_graph(images, scene.board, kind).pairs.T)] = True
    for own in map(np.flatnonzero, incidence(images).T):
        a, b = (connected_components(each[np.ix_(own, own)], directed=False)[1] for each in joined)
        np.testing.assert_array_equal(a[:, None] == a, b[:, None] == b)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.1, 0.9))
@settings(max_examples=3, deadline=None)
def test_sparse_pairs_hold_every_track_together_as_all_pairs_do(crowd, seed, share):
    """Of images that show a random share of their circles, some of them nearly nothing."""
    scene, observations = crowd
    rng = np.random.default_rng(seed)
    spoiled = [o.select(np.flatnonzero(rng.random(len(o)) < share * rng.random())) for o in observations]
    require_same_tracks(scene, spoiled)


def test_sparse_pairs_are_few_have_enough_labels_in_common_and_are_the_default_above_their_size(crowd):
    scene, observations = crowd
    require_same_tracks(scene, observations)
    every, sparse = (image_graph(observations, scene.board, kind) for kind in ("all", "sparse"))
    assert set(map(tuple, sparse.pairs.tolist())) <= set(map(tuple, every.pairs.tolist()))
    assert len(every.pairs) > 4000
    # Two skeletons with all their pairs, links for every other image, a few between the groups.
    assert 2 * SKELETON * (SKELETON - 1) / 2 + 60 <= len(sparse.pairs) < 900
    assert image_graph(observations[:SPARSE_FROM], scene.board).kind == "all"
    assert image_graph(observations[: SPARSE_FROM + 1], scene.board).kind == "sparse"
    few = [observations[0], observations[1].select(np.arange(MIN_SHARED)), observations[2].select([0, 1])]
    labels = [set(o.labels) for o in few]
    wanted = [[i, j] for i in range(3) for j in range(i + 1, 3) if len(labels[i] & labels[j]) >= MIN_SHARED]
    assert image_graph(few, scene.board, "all").pairs.tolist() == wanted
    boards = [o.select([k for k, label in enumerate(o.labels) if label.startswith("board")]) for o in observations]
    for kind in ("all", "sparse"):
        pairs = image_graph(boards, scene.board, kind).pairs
        assert len(pairs)
        assert all(boards[i].group == boards[j].group for i, j in pairs)


def test_the_skeleton_is_well_spread_and_sees_every_circle(crowd):
    scene, observations = crowd
    graph = image_graph(observations, scene.board, "sparse")
    for name, group in scene.groups.items():
        members = [i for i, o in enumerate(observations) if o.group == name]
        chosen = graph.skeleton[name]
        assert SKELETON <= len(chosen) <= SKELETON + 5
        seen = incidence([observations[i] for i in members])
        views = seen[np.isin(members, chosen)].sum(0)
        assert (views >= np.minimum(seen.sum(0), MIN_VIEWS)).all()
        position = np.array([pose.inverse().translation for pose in group.camera_from_target])
        middle = scene.circles_target["1:1"]
        direction = (position - middle) / np.linalg.norm(position - middle, axis=1)[:, None]
        own = direction[[members.index(i) for i in chosen]]
        # 50 views over 80° × 80°: farthest-point choice of 20 leaves none further than a fifth of that from one.
        away = np.degrees(np.arccos(np.clip((direction @ own.T).max(1), -1, 1)))
        assert away.max() < 16


@pytest.mark.slow
def test_sparse_gives_the_same_faces_as_all_pairs(crowd, tmp_path):
    """Both end in the minimum of the same adjustment: the difference is what stopping leaves, 1e-8 px in 2592."""
    scene, observations = crowd
    some = [image for image in observations if int(image.name[-4:]) < 24]  # of each group
    mapped_all, every = solve(scene, some, "all", tmp_path / "all")
    mapped_sparse, sparse = solve(scene, some, "sparse", tmp_path / "sparse")
    assert sum(len(s.model.images) for s in mapped_all) == sum(len(s.model.images) for s in mapped_sparse) == 48
    for face_id, pose in every.target.target_from_face.items():
        other = sparse.target.target_from_face[face_id]
        assert np.abs(pose.matrix() - other.matrix()).max() < 1e-6
        true = scene.target_from_face[face_id]
        assert np.linalg.norm(pose.translation - true.translation) < 0.02  # mm; σ is about 0.004
    assert not any(s.left_out or s.outliers for s in mapped_sparse)


@pytest.fixture(scope="module")
def placed(crowd, labels_only):
    """The model of the first ten images of a group at the true geometry, and all images of the group."""
    scene, observations = crowd
    group = [o for o in observations if o.group == "12"]
    one = replace(scene, groups={"12": replace(scene.groups["12"])})
    return scene, group, labels_only.models(one, group)[0]


def first_images(model, count: int):
    return model.without(model.image_index >= count)


def test_resection_places_the_other_images_adds_missing_circles_and_leaves_out_others(
    placed,
):
    scene, group, true = placed
    start = first_images(true, 10)
    model = complete(start, group, scene.camera, 4.0)
    assert model.images == true.images
    rms = np.sqrt((model.residuals_px(scene.camera) ** 2).mean())
    # Ellipse centres against images of the centres: eccentricity is up to 0.2 px here, noise 0.02.
    assert NOISE_PX < rms < 0.15
    for ours, theirs in zip(model.camera_from_model, true.camera_from_model, strict=True):
        assert np.linalg.norm(ours.inverse().translation - theirs.inverse().translation) < 2  # mm at 1 m
    lost = start.labels.index("1:3")
    without = start.without(start.point_index == lost)
    assert "1:3" not in without.labels
    model = complete(without, group, scene.camera, 4.0)
    error = model.xyz_model[model.labels.index("1:3")] - true.xyz_model[true.labels.index("1:3")]
    assert np.linalg.norm(error) < 0.2  # mm: eccentricity moves a circle by about 0.06
    few = group[21].select(np.arange(5))
    labels = tuple(np.random.default_rng(0).permutation(group[20].labels).tolist())
    wrong = replace(group[20], labels=labels)
    model = complete(start, [*group[:10], wrong, few, group[22]], scene.camera, 4.0)
    assert model.images == (*start.images, group[22].name)


def measured(count: int) -> dict:
    command = [sys.executable, str(STUDY), "--one", str(count), "sparse"]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


@pytest.mark.full
def test_2000_images_cost_no_more_each_than_40():
    """Processor time per image within 3×, database and memory linear: what is quadratic would be 50× here."""
    small, large = measured(40), measured(2000)
    assert large["mapped"] == 2000
    assert small["not_passed"] == large["not_passed"] == []
    assert large["cpu_ms_per_image"] < 3 * small["cpu_ms_per_image"]
    assert large["database_mib"] < 3 * 50 * small["database_mib"]
    assert large["memory_mib"] < 1000
    # σ of the worst face is 4 µm with 40 images and a seventh of that with 2000; the board's own 5 µm stay in both.
    assert 0.01 < large["worst_face_um"] < 4
