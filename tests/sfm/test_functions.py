"""The commands as a user types them; public functions give what they print and write, of a run as its folder, as
`load_run` reads it, or as `run` returned it. Commands and functions: `tests/test_python_functions.py`."""

import csv
import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import stcal
from stcal import load_board, load_target, save_board, save_target, sfm
from stcal.cli.main import LIBRARIES, main
from stcal.io.cameras.read import read_camera
from stcal.io.files import json_text
from stcal.sfm.planning.session import plan_text
from stcal.synthetic.designs import second_design
from tests.outcome import ended, fails_with, refuses
from tests.shared import own_copy


def written_json(stcal_sfm, out, *words) -> dict:
    assert stcal_sfm(*words, "--json", out)[0] == 0
    return json.loads(out.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_uncertainty_budget_and_exports(stcal_sfm, small_result, small_run, tmp_path):
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_calibrate_models_and_runs_and_programs_that_are_missing(stcal_sfm, small_run, tmp_path, small_result):
    """The comparison of programs itself: `interop/test_crosscheck.py`."""
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    assert stcal_sfm("faces", small_run / "colmap/models", "--run", small_run, "--out", one)[0] == 0
    found = sfm.calibrate_models(small_run / "colmap/models", small_run, out=two)
    assert one.read_bytes() == two.read_bytes()
    assert json.loads(one.read_text(encoding="utf-8"))["reference_face"] == found.target.reference_face
    program = tmp_path / "no-colmap"
    own = own_copy(small_run, tmp_path / "run")  # its lock is taken
    assert stcal_sfm("crosscheck", own, "--colmap", program).error == "E-COLMAP-PROGRAM"
    refuses("E-COLMAP-PROGRAM … no-colmap", sfm.crosscheck, small_run, program, sfm.Tolerances(sigma=1.0))
    refuses("E-OPTION-RANGE … face_um … -1 … or more needed", sfm.Tolerances, -1.0)
    refuses("E-FIELD-TYPE … tolerances … Tolerances", sfm.crosscheck, small_run, program, 0.5)
    for call in (sfm.uncertainty_budget, sfm.crosscheck, sfm.report_again, sfm.advise):
        refuses("E-FIELD-TYPE … 7", call, 7)
        refuses("E-RUN-FOLDER … out", call, replace(small_result, out=None))
        refuses(f"E-RUN-FOLDER … {tmp_path}", call, tmp_path)


def test_init_writes_the_reference_design_and_overwrites_nothing(stcal_sfm, tmp_path):
    code, out, _ = stcal_sfm("init", tmp_path / "mine")
    assert code == 0
    assert "target.toml" in out
    assert "board.toml" in out
    target, board = load_target(tmp_path / "mine" / "target.toml"), load_board(tmp_path / "mine" / "board.toml")
    assert [f.id for f in target.faces] == ["1", "2", "3", "4", "5"]
    assert (board.rows, board.columns, board.pitch_mm, board.radius_mm) == (7, 9, 30.0, 7.5)
    code, _, err = stcal_sfm("init", tmp_path / "mine")
    assert code == 2
    assert "exists" in err
    text = (tmp_path / "mine" / "board.toml").read_text()  # what is written as a remark may be used
    for key in ("[corner]", "row", "column", "radius_mm"):
        text = text.replace(f"# {key}", key)
    (tmp_path / "mine" / "board.toml").write_text(text)
    assert load_board(tmp_path / "mine" / "board.toml").corner is not None


@pytest.mark.parametrize(("solve", "faces", "word"), [("joint", "1,2,4", "Yes"), ("chain", "1,3", "Part, with care: ")])
def test_a_quiet_run_says_the_verdict_alone_and_only_where_it_is_not_yes(
    stcal_sfm, small_set, no_page, solve, faces, word
):
    """Face 3 is not in the photographs; a chain is faster, and never a plain yes."""
    small = small_set("12", "14")
    files = ["--target", small.folder / "target.toml", "--board", small.folder / "board.toml"]
    code, out, err = stcal_sfm(
        *small.arguments(*files, "--solve", solve, "--expect-faces", faces, "--no-strict", "--quiet")
    )
    assert (code, out) == (0, "")
    assert err.startswith(f"warning: may I use it? {word}") if word != "Yes" else not err
    assert err.count("\n") == (word != "Yes")


@pytest.fixture
def designs(tmp_path):
    """Of two faces of a cube, and of a board beside it."""
    target, board, _ = second_design()
    save_target(tmp_path / "target.toml", replace(target, faces=target.faces[:2]))
    save_board(tmp_path / "board.toml", board)
    return "--target", tmp_path / "target.toml", "--board", tmp_path / "board.toml"


def test_simulate_with_the_camera_of_a_file_and_faces_that_have_no_place(stcal_sfm, designs, tmp_path):
    camera = tmp_path / "cameras.txt"
    camera.write_text("1 SIMPLE_RADIAL 400 300 430 203 148 -0.05\n")
    call = "simulate", tmp_path / "data", *designs, "--camera", camera, "--images", 2, "--workers", 1
    code, text, _ = stcal_sfm(*call)
    assert code == 0
    assert "2 images in 1 groups" in text
    written, given = (read_camera(path).calibrated(0, 0) for path in (tmp_path / "data" / "cameras.txt", camera))
    assert written.colmap_params() == given.colmap_params()
    code, _, err = stcal_sfm(*call, "--fisheye", 100)
    assert code == 2
    assert "two cameras" in err
    target = load_target(designs[1])
    first, second = target.faces
    save_target(designs[1], replace(target, faces=(first, replace(second, rough_target_from_face=None))))
    code, _, err = stcal_sfm("simulate", tmp_path / "none", *designs)
    assert code == 2
    assert f"does not say where face {second.id} is; add approximate rough_pose = {{ origin_mm, x, normal }}" in err


@pytest.mark.slow
def test_simulate_with_lens_and_rim(stcal_sfm, tmp_path):
    small = "--width", 324, "--images", 2, "--workers", 1
    lens = "--f-number", 4, "--focus-mm", 900, "--rim-mm", 0.2
    code, _, err = stcal_sfm("simulate", tmp_path / "data", *small, *lens)
    assert code == 0, err
    optics = json.loads((tmp_path / "data/truth.json").read_text())["optics"]
    assert optics == {"lens": {"f_number": 4.0, "focal_mm": 24.0, "focus_mm": 900.0}, "rim_mm": 0.2}
    camera = "--camera", tmp_path / "data/cameras.txt"
    for options, names in (
        (("--focus-mm", 900), "--f-number"),
        (("--focal-mm", 50), "--f-number"),
        (("--f-number", 4, *camera), "--focal-mm"),
        (("--f-number", 4, "--fisheye", 120, "--distance", 500), "perspective"),
        (("--f-number", 4, "--focus-mm", 20), "focal length"),
    ):
        code, _, err = stcal_sfm("simulate", tmp_path / "none", *small, *options)
        assert (code, err.count("error:")) == (2, 1)
        assert names in err
    assert not (tmp_path / "none").exists()


def test_versions_for_reports_of_faults(monkeypatch, capsys):
    """Also where COLMAP is not there, or a library does not load."""
    monkeypatch.setattr(sys, "argv", ["stcal", "--versions"])
    code, out, _ = ended(main, capsys)
    found = dict(line.split(maxsplit=1) for line in out.splitlines() if not line.startswith("native"))
    assert code == 0
    assert found["stcal"] == stcal.__version__
    assert found["NumPy"] == np.__version__
    assert found["pycolmap"].startswith("4.2")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(LIBRARIES, "OpenCV", "no_such_module")
    again = ended(main, capsys)[1]
    assert "native colmap  not found" in again
    assert "OpenCV         does not load: No module named 'no_such_module'" in again


@pytest.mark.slow
def test_without_a_camera_the_board_tells_it(stcal_sfm, small_dataset, small_run, tmp_path):
    """The lens is that of the file within what eight views of a board tell: as many circles have names."""
    designs = ("--target", small_dataset / "target.toml", "--board", small_dataset / "board.toml")
    code, told, _ = stcal_sfm("detect", small_dataset / "images", *designs, "--out", tmp_path / "look")
    assert code == 0
    assert "note: no --camera: found by the dots of the board, f " in told
    with_camera = (small_run / "labels.csv").read_text().splitlines()
    assert len((tmp_path / "look/detections.csv").read_text().splitlines()) == len(with_camera)
