"""Public functions give what their commands print and write; commands and functions: `tests/test_python_functions.py`.

Functions take a run as its folder, as `load_run` reads it, or as `run` returned it.
"""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import stcal
from stcal import sfm
from stcal.io.files import json_text
from stcal.sfm.planning.session import plan_text
from tests.outcome import fails_with, refuses
from tests.shared import own_copy

pytestmark = pytest.mark.slow


def written_json(stcal_sfm, out, *words) -> dict:
    assert stcal_sfm(*words, "--json", out)[0] == 0
    return json.loads(out.read_text(encoding="utf-8"))


def test_uncertainty_budget(stcal_sfm, small_result, small_run, tmp_path):
    """Of a run just made, and of its folder."""
    words = "budget", small_run, "--field", "operator=A", "--no-strict"
    answer = written_json(stcal_sfm, tmp_path / "a.json", *words)
    found = sfm.uncertainty_budget(small_result, fields={"operator": "A"})
    assert json.loads(json_text(found.file)) == answer
    assert found.file.fields["operator"] == "A"
    assert set(answer["faces"]) == {"2", "4", "5"}
    assert "A" in found.document().text()
    with fails_with("E-OPTION-VALUE … 62"):
        sfm.uncertainty_budget(small_run, fields={61 * "n": ""})


def test_exports(stcal_sfm, small_result, small_run, tmp_path):
    for words, call in (
        (("export", "urdf"), lambda out: sfm.export_run(small_result, out)),
        (("export-database", "db", "--schema", "3.8"), lambda out: sfm.export_database(small_result, out, "3.8")),
    ):
        one, two = tmp_path / f"one.{words[1]}", tmp_path / f"two.{words[1]}"
        assert stcal_sfm(words[0], small_run, one, *words[2:])[0] == 0
        assert call(two).path == two
        assert two.read_bytes().replace(b"two.", b"one.") == one.read_bytes()


def test_detect_images(stcal_sfm, small_dataset, tmp_path):
    photograph, data = next((small_dataset / "images" / "12").iterdir()), small_dataset
    (tmp_path / "images" / "12").mkdir(parents=True)
    own_copy(photograph, tmp_path / "images" / "12")
    camera, target, board = (data / name for name in ("cameras.txt", "target.toml", "board.toml"))
    files = "--camera", camera, "--target", target, "--board", board, "--workers", "1"
    assert stcal_sfm("detect", tmp_path / "images", *files, "--out", tmp_path / "out")[0] == 0
    array = np.asarray(Image.open(photograph))
    (seen,) = sfm.detect_images({"12": [array]}, camera, None, target, board, sfm.RunOptions(workers=1)).images.values()
    rows = list(csv.DictReader((tmp_path / "out" / "detections.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["label"] for row in rows] == [str(label) for label in seen.labels]
    np.testing.assert_allclose([[float(row[key]) for key in ("x_px", "y_px")] for row in rows], seen.xy_px, atol=1e-6)


def test_design_target(stcal_sfm, monkeypatch, tmp_path):
    """Cases of hidden circles, which take seconds: `make/test_design.py`."""
    monkeypatch.setattr("stcal.sfm.make.unnamed_cases", lambda *_: ([], 1))
    words = "--size", "130,120,110", "--faces", "front,right", "--circles", "9", "--images", "2", "--width", "1296"
    _, said, _ = stcal_sfm("design", tmp_path / "one", *words)
    options = sfm.DesignOptions((130.0, 120.0, 110.0), 9, width=1296, faces=("front", "right"))
    found = sfm.design_target(options, 2, tmp_path / "two")
    assert plan_text(found.forecast, found.source) in said
    for name, path in zip(("target.toml", "board.toml"), found.files, strict=True):
        assert path.read_bytes() == (tmp_path / "one" / name).read_bytes()
    refuses("E-OUTPUT-EXISTS … target.toml", sfm.design_target, options, 2, tmp_path / "two")
    refuses("E-OPTION-VALUE … under", sfm.DesignOptions, (130.0, 120.0, 110.0), faces=("front", "under"))


def test_design_tag_body_and_plan(stcal_sfm, tmp_path):
    words = "--faces", "1,2,3", "--images", "4", "--distance", "300", "--width", "900"
    _, said, _ = stcal_sfm("design", tmp_path / "one", "--tags", "cube", "--size", "50", *words)
    session = sfm.PlanOptions(4, distance_mm=300.0, width=900)
    found = sfm.design_tag_body("cube", 50.0, session=session, faces="1,2,3")
    assert plan_text(found.forecast, found.source) in said
    assert found.files == ()
    target = stcal.load_target(tmp_path / "one" / "target.toml")
    assert plan_text(sfm.plan(session, target), found.source) in said
    with fails_with("E-OPTION-CONFLICT … board"):
        sfm.plan(session, target, stcal.reference_board())


def test_calibrate_models(stcal_sfm, small_run, tmp_path):
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    assert stcal_sfm("faces", small_run / "colmap/models", "--run", small_run, "--out", one)[0] == 0
    found = sfm.calibrate_models(small_run / "colmap/models", small_run, out=two)
    assert one.read_bytes() == two.read_bytes()
    assert json.loads(one.read_text(encoding="utf-8"))["reference_face"] == found.target.reference_face


def test_crosscheck_names_what_is_missing(stcal_sfm, small_run, tmp_path):
    """The comparison itself: `interop/test_crosscheck.py`."""
    program = tmp_path / "no-colmap"
    own = own_copy(small_run, tmp_path / "run")  # its lock is taken
    assert stcal_sfm("crosscheck", own, "--colmap", program).error == "E-COLMAP-PROGRAM"
    refuses("E-COLMAP-PROGRAM … no-colmap", sfm.crosscheck, small_run, program, sfm.Tolerances(sigma=1.0))
    refuses("E-FIELD-TYPE … tolerances … Tolerances", sfm.crosscheck, small_run, program, 0.5)


@pytest.mark.parametrize(
    "call", [sfm.uncertainty_budget, sfm.crosscheck, sfm.report_again, sfm.advise], ids=lambda call: call.__name__
)
def test_a_run_is_a_folder_or_a_result(call, small_result, tmp_path):
    refuses("E-FIELD-TYPE … 7", call, 7)
    refuses("E-RUN-FOLDER … out", call, replace(small_result, out=None))
    refuses(f"E-RUN-FOLDER … {tmp_path}", call, tmp_path)
