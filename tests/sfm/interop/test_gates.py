"""The gates for the initial pair: every verdict is held against what COLMAP then does with the pair."""

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pycolmap
import pytest

from stcal.geometry.rigid import Rigid
from stcal.sfm.interop import gates as gates_module
from stcal.sfm.interop.gates import group_gates, limits_text, own_gates
from stcal.sfm.mapping.database import image_ids, write_database
from stcal.sfm.mapping.incremental import seeded_mapping
from stcal.sfm.mapping.pairs import PairOptions, PairScore
from tests.shared import unsealed_copy


def turned(camera_from_target: Rigid, centre: np.ndarray, axis: np.ndarray, degrees: float) -> Rigid:
    """The camera moved round a point of the target."""
    about = Rigid(np.eye(3), centre) @ Rigid.exp([*(np.radians(degrees) * axis), 0, 0, 0])
    return camera_from_target @ about @ Rigid(np.eye(3), -centre)


@pytest.fixture(scope="module")
def places(scene):
    """Poses of one group's camera by name: ``0``, so many degrees beside it, and nearer."""
    group = scene.groups["12"]
    base = group.camera_from_target[0]
    centre = np.mean([scene.circles_target[k] for k in scene.circles_target if k[0] in "12"], axis=0)
    places = {f"{d:g}": turned(base, centre, group.axes[1], d) for d in (0, 0.05, 0.7, 6, 25)}
    return places | {"nearer": Rigid(np.eye(3), np.array([0, 0, -300.0])) @ base}


@pytest.fixture(scope="module")
def views(scene, places, labels_only):
    """Observations from these places."""
    group = scene.groups["12"]
    moved = replace(scene, groups={"12": replace(group, camera_from_target=tuple(places.values()))})
    observed = labels_only.observations(moved, 0.003, np.random.default_rng(0))
    return {name: replace(image, name=name) for name, image in zip(places, observed, strict=True)}


@pytest.fixture(scope="module")
def judged(scene, views):
    """The pairs of view ``0`` with each other view, and with few labels of view ``25``, by name."""
    few = {f"{n} of 25": replace(views["25"].select(range(0, 2 * n, 2)), name=f"{n} of 25") for n in (5, 12, 20)}
    group = [*views.values(), *few.values()]
    scores = [PairScore("0", image.name, len(image), 0.5, 1.0, 0.1, None, "usable") for image in group[1:]]
    rows = group_gates(group, scores, scene.camera, PairOptions())
    return group, {row.score.second: row for row in rows}


def refusing(verdict) -> list[str]:
    return [gate.name for gate in verdict.gates if not gate.passed]


def measured(verdict, name):
    return next(gate for gate in verdict.gates if gate.name == name)


def test_narrow_forward_and_poor_pairs_are_refused_for_what_they_are(judged):
    _, rows = judged
    assert rows["25"].as_set.relaxations == rows["6"].as_set.relaxations == 0
    assert refusing(rows["0.05"].as_set)[0] == "angle"
    assert rows["0.05"].as_set.relaxations is None
    assert "angle" in refusing(rows["0.7"].as_set)
    assert rows["0.7"].as_set.relaxations == 2  # 8, 4 inliers at 1°, then 0.5°
    assert refusing(rows["nearer"].as_set) == ["forward"]
    assert rows["nearer"].as_set.relaxations is None
    assert "matches" in refusing(rows["5 of 25"].as_set)
    # COLMAP wants 15 inliers however low init_min_num_inliers is.
    assert refusing(rows["12 of 25"].as_set) == ["inliers"]
    assert rows["12 of 25"].as_set.relaxations is None
    assert rows["20 of 25"].as_set.relaxations == 0


def true_angle(scene, labels, a: Rigid, b: Rigid) -> float:
    """Median angle, degrees, at the circles between the rays to both cameras."""
    board = dict(zip(scene.board.labels(), scene.groups["12"].board_circles_target, strict=True))
    xyz = np.array([scene.circles_target[k] if k in scene.circles_target else board[k] for k in labels])
    rays = [pose.inverse().translation - xyz for pose in (a, b)]
    cosine = (rays[0] * rays[1]).sum(1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    return float(np.degrees(np.median(np.arccos(cosine))))


def test_what_is_measured_is_the_scene(scene, places, judged, views):
    _, rows = judged
    for name in ("6", "25"):
        verdict = rows[name].as_set
        shared = [label for label in views["0"].labels if label in views[name].labels]
        assert measured(verdict, "matches").value == measured(verdict, "points").value == len(shared)
        # The eccentricity, not corrected here, and the planar estimate of the narrow pair are the errors.
        angle = true_angle(scene, shared, places["0"], places[name])
        assert np.degrees(measured(verdict, "angle").value) == pytest.approx(angle, rel=0.05)
        assert 0 < measured(verdict, "forward").value < 0.5
    assert measured(rows["nearer"].as_set, "forward").value > 0.99


def test_the_defaults_want_more(judged):
    _, rows = judged
    assert refusing(rows["25"].defaults) == ["inliers"]
    assert rows["25"].defaults.relaxations == 1  # 50 inliers
    assert refusing(rows["6"].defaults) == ["inliers", "angle", "points"]
    assert measured(rows["6"].defaults, "points").value == 0  # no ray angle comes near 16°
    assert rows["6"].defaults.relaxations == 4  # 8° is too much still, 4° not
    assert rows["20 of 25"].defaults.relaxations is None


@pytest.mark.slow
def test_verdicts_are_what_colmap_does(scene, judged, tmp_path):
    """Started from the pair, COLMAP registers it where the verdict says so, and makes no model where it does not."""
    group, rows = judged
    database, ids = tmp_path / "pairs.db", image_ids(group)
    write_database(database, scene.camera, group, np.array(list(combinations(range(len(group)), 2))))
    names = [image.name for image in group]
    for second, row in rows.items():
        pair = ids["0"], ids[second]
        model = seeded_mapping(database, tmp_path / "models", names, pair)
        assert (model is not None) == (row.as_set.relaxations is not None), second
        assert model is None or {"0", second} <= {model.image(i).name for i in model.reg_image_ids()}
        options = pycolmap.IncrementalPipelineOptions()
        options.init_image_id1, options.init_image_id2 = pair
        options.init_num_trials, options.random_seed, options.extract_colors = 1, 1, False
        (tmp_path / "out").mkdir(exist_ok=True)
        models = pycolmap.incremental_mapping(str(database), str(tmp_path), str(tmp_path / "out"), options)
        assert bool(models) == (row.defaults.relaxations is not None), second


def test_the_first_gates_are_colmaps_own(scene, judged, tmp_path):
    """COLMAP's ``estimate_initial_two_view_geometry`` takes the pairs that the gates before the points let pass."""
    group, rows = judged
    database, ids = tmp_path / "pairs.db", image_ids(group)
    write_database(database, scene.camera, group, np.array(list(combinations(range(len(group)), 2))))
    options = gates_module.pipeline_options([image.name for image in group], (1, 2))
    with pycolmap.Database.open(str(database)) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions(min_num_matches=6))
    mapper = pycolmap.IncrementalMapper(cache)
    loaded = pycolmap.Reconstruction()
    mapper.begin_reconstruction(loaded)
    taken = set()
    for second, row in rows.items():
        if not loaded.exists_image(ids[second]):
            continue
        pose = mapper.estimate_initial_two_view_geometry(options.get_mapper(), ids["0"], ids[second])
        if pose is not None:
            taken.add(second)
            # The database has the centres in single precision.
            forward = measured(row.as_set, "forward").value
            assert forward == pytest.approx(abs(pose.translation[2]), abs=1e-5)
    mapper.end_reconstruction(True)
    assert taken == {second for second, row in rows.items() if set(refusing(row.as_set)) <= {"points"}}
    assert taken == {"6", "25", "20 of 25"}


def test_wrong_centres_do_not_survive(scene, views):
    """Three centres so far off their epipolar lines that no point is within 2° of its rays: COLMAP makes none then."""
    a, b = views["0"], views["25"]
    wrong = b.centre_px.copy()
    wrong[[3, 20, 40], 1] += np.radians(12.0) * scene.camera.focal[1]
    spoilt = replace(b, centre_px=wrong, centre=scene.camera.normalised_from_pixel(wrong))
    score = PairScore("0", "25", len(b), 0.5, 1.0, 0.1, None, "usable")
    (row,) = group_gates([a, spoilt], [score], scene.camera, PairOptions())
    shared = len(set(a.labels) & set(b.labels))
    assert measured(row.as_set, "points").value == measured(row.as_set, "inliers").value == shared - 3
    # At its defaults COLMAP makes no points of circles that two images of all see.
    assert measured(row.defaults, "points").value == 0


def test_our_own_gates():
    score = PairScore("a", "b", 8, np.radians(61), 0.95, 0.1, None, "")
    assert [gate.passed for gate in own_gates(score, PairOptions())] == [True, True, True, False]
    assert [gate.passed for gate in own_gates(score, PairOptions(np.radians(70)))] == [True] * 4
    narrow = replace(score, median_angle_rad=np.radians(0.9), in_front=0.8)
    assert [gate.passed for gate in own_gates(narrow, PairOptions())] == [True, False, False, True]
    assert [(g.name, g.passed) for g in own_gates(replace(score, shared=7), PairOptions())] == [("labels", False)]


def test_limits_in_words():
    """COLMAP's defaults as its documentation has them (``colmap mapper -h``)."""
    as_set, defaults, *_ = limits_text(PairOptions()).splitlines()
    assert as_set == (
        "as set: matches ≥ 6, inliers ≥ 15, forward < 0.95, angle > 1°, points ≥ 6; "
        "relaxed 4×: inliers ≥ 15, angle > 0.25°"
    )
    assert defaults == (
        "COLMAP's defaults: matches ≥ 15, inliers ≥ 100, forward < 0.95, angle > 16°, points ≥ 30; "
        "relaxed 4×: inliers ≥ 25, angle > 4°"
    )


def test_the_command(small_run, stcal_sfm, tmp_path, monkeypatch):
    monkeypatch.setattr("stcal.cli.sfm.colmap.SHOWN_PAIRS", 2)
    before = sorted(path.stat().st_mtime_ns for path in small_run.rglob("*"))
    code, out, _ = stcal_sfm("pairs", small_run, "--json", tmp_path / "pairs.json")
    assert code == 0
    assert "group 12: 6 pairs of 4 images, the first 2 (--all for the other 4)" in out
    report = json.loads((small_run / "report.json").read_text(encoding="utf-8"))
    written = json.loads((tmp_path / "pairs.json").read_text(encoding="utf-8"))
    for group, known in zip(written["groups"], report["groups"], strict=True):
        assert [(p["first"], p["second"]) for p in group["pairs"]] == [
            (p["first"], p["second"]) for p in known["pairs"]
        ]
        chosen = known["pairs"][0]
        marked = [line for line in out.splitlines() if line.startswith("*") and f"{chosen['shared']}" in line]
        names = chosen["first"].split("/")[1], chosen["second"].split("/")[1]
        assert any(all(name in line for name in names) and " passes " in line for line in marked)
        assert group["pairs"][0]["as_set"]["relaxations"] == 0
        assert all(gate["passed"] for gate in group["pairs"][0]["ranking"])
    code, out, _ = stcal_sfm("pairs", small_run, "--group", "14", "--all")
    assert (code, out.count("IMG_") // 2, "group 12" in out) == (0, 6, False)
    assert sorted(path.stat().st_mtime_ns for path in small_run.rglob("*")) == before


def test_errors(small_run, stcal_sfm, tmp_path):
    assert stcal_sfm("pairs", small_run, "--group", "99")[2].startswith("error: group 99: not in run")
    assert "not a run's folder" in stcal_sfm("pairs", tmp_path)[2]
    own = tmp_path / "run"
    unsealed_copy(small_run, own)
    report = json.loads((own / "report.json").read_text(encoding="utf-8"))
    report["groups"][0]["pairs"][-1]["first"] = "12/none.jpg"
    (own / "report.json").write_text(json.dumps(report), encoding="utf-8")
    code, _, error = stcal_sfm("pairs", own)
    assert (code, error.count("\n")) == (2, 1)
    assert "no image 12/none.jpg in labels.csv" in error
    del report["groups"][0]["pairs"][-1]["forward"]
    (own / "report.json").write_text(json.dumps(report), encoding="utf-8")
    code, _, error = stcal_sfm("pairs", own)
    assert (code, error.count("\n")) == (2, 1)
    assert "no ranked pairs ('forward')" in error
