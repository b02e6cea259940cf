"""The whole chain on simulated photographs: what the run's folder holds, and that any COLMAP can use it."""

import json
import re
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from stcal.sfm.adjust.refine import adjust, find_scale
from stcal.sfm.mapping.database import from_colmap_px, image_ids
from stcal.sfm.mapping.incremental import map_group
from stcal.sfm.mapping.pairs import PairOptions, rank_pairs
from tests.shared import own_copy


def test_a_result_shows_itself_in_a_line_and_in_a_notebook(small_result):
    text, page = repr(small_result), small_result._repr_html_()
    assert len(text) < 500
    assert "\n" not in text
    assert small_result.judgement.use.removesuffix(".") in text
    assert small_result.judgement.use in page
    assert re.findall(r'<th scope="row" class="l">(\d)', page) == list(small_result.target.target_from_face)


def test_every_promised_file_is_there(small_run):
    """Faces and labels are read back in `runs/test_saved_run.py`."""
    out = small_run
    np.testing.assert_allclose(json.loads((out / "faces.json").read_text())["circles"]["1:1"], 0, atol=0.01)
    report = json.loads((out / "report.json").read_text())
    assert report["summary"]["images_mapped"] == 8
    assert len(report["groups"][0]["pairs"]) == 6
    assert (out / "report.html").stat().st_size > 100_000
    assert {p.name for p in (out / "colmap/models").iterdir()} == {"12", "14"}
    assert not list(out.rglob("*.partial"))
    assert not (out / "scratch").exists()


def test_any_colmap_makes_an_unbiased_model_of_the_database(small_result, tmp_path):
    """Mapped again from the file alone, without any correction: the board keeps its shape and the faces their place."""
    result = small_result
    observations = result.observations
    ids = image_ids(observations)
    group = [o for o in observations if o.group == "12"]
    pairs = rank_pairs(group, result.camera, PairOptions())
    own = own_copy(result.out / "colmap/database.db", tmp_path)  # pycolmap changes what it opens
    mapping = map_group(own, tmp_path / "scratch", group, list(ids), ids, pairs, result.camera)
    ours = next(s.model for s in result.solutions if s.model.group == "12")
    with pycolmap.Database.open(str(own)) as database:
        keypoints = {o.name: from_colmap_px(database.read_keypoints(ids[o.name])[:, :2]) for o in group}
    model = mapping.model
    rows = zip(model.image_index, model.keypoint, strict=True)
    plain = np.array([keypoints[model.images[i]][k] for i, k in rows])
    theirs = adjust(replace(model, measured_px=plain), result.camera)
    distances = []
    for each in (ours, theirs):
        scale = find_scale(each, result.board_design).mm_per_unit
        place = {label: scale * xyz for label, xyz in zip(each.labels, each.xyz_model, strict=True)}
        distances.append(np.linalg.norm(place["1:1"] - place["2:1"]))
    assert distances[0] == pytest.approx(distances[1], abs=2e-4)  # float32 keypoints; the bias would be 0.05 mm
