"""The commands as a user types them."""

import json
import sys

import numpy as np
import pytest

import stcal
from stcal.cli.main import main, main_sfm
from stcal.io.design import load_board, load_target
from stcal.workflows import versions


@pytest.fixture
def command(monkeypatch, capsys):
    def call(*arguments, entry=main_sfm):
        monkeypatch.setattr(sys, "argv", ["stcal-sfm", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            entry()
        output = capsys.readouterr()
        return end.value.code or 0, output.out, output.err

    return call


def test_init_writes_the_reference_design_and_overwrites_nothing(command, tmp_path):
    code, out, _ = command("init", tmp_path / "mine")
    assert code == 0
    assert "target.toml" in out
    assert "board.toml" in out
    target, board = load_target(tmp_path / "mine" / "target.toml"), load_board(tmp_path / "mine" / "board.toml")
    assert [f.id for f in target.faces] == ["1", "2", "3", "4", "5"]
    assert (board.rows, board.columns, board.pitch_mm, board.radius_mm) == (7, 9, 30.0, 7.5)
    code, _, err = command("init", tmp_path / "mine")
    assert code == 2
    assert "exists" in err


def test_the_umbrella_command_is_the_same_thing(command, tmp_path):
    code, out, _ = command("sfm", "init", tmp_path / "a", entry=main)
    assert code == 0
    assert "board.toml" in out
    code, out, _ = command("--version", entry=main)
    assert code == 0
    assert out.strip().count(".") == 2


def test_simulate_and_compare(command, small_dataset, small_run, tmp_path):
    code, text, _ = command("simulate", tmp_path, "--width", 324, "--images", 2, "--second-design", "--workers", 1)
    assert code == 0
    assert "6 images in 3 groups" in text
    code, text, _ = command("compare", small_run, small_dataset / "truth.json", "--json", tmp_path / "errors.json")
    assert code == 0
    assert "2" in text
    assert 0 < json.loads((tmp_path / "errors.json").read_text())["worst"]["translation_um"] < 60


@pytest.mark.slow
def test_simulate_detect_run_compare(command, tmp_path):
    data, out, one = tmp_path / "data", tmp_path / "run", ("--workers", 1)
    code, text, _ = command(
        "simulate", data, "--width", 1296, "--images", 3, "--second-design", "--seed", 2, "--png", *one
    )
    assert code == 0
    assert "9 images in 3 groups" in text
    files = [*one, "--camera", data / "cameras.txt", "--target", data / "target.toml", "--board", data / "board.toml"]
    code, text, _ = command("detect", data / "images", *files, "--out", tmp_path / "detect")
    assert code == 0
    assert (tmp_path / "detect" / "overlays" / "top-left" / "IMG_1000.png.jpg").stat().st_size > 10_000
    code, text, _ = command("run", data / "images", *files, "--out", out)
    assert code == 0
    assert "faces.json" in text
    # Detection alone writes the same file as the whole run.
    assert (tmp_path / "detect" / "detections.csv").read_text() == (out / "detections.csv").read_text()
    faces = json.loads((out / "faces.json").read_text())
    assert faces["unit"] == "mm"
    assert set(faces["target_from_face"]) == {"top", "left", "right"}
    assert all(len(xyz) == 3 for xyz in faces["circles"].values())
    code, text, _ = command("compare", out, data / "truth.json", "--json", tmp_path / "errors.json")
    assert code == 0
    errors = json.loads((tmp_path / "errors.json").read_text())
    assert "left" in text
    assert 0 < errors["worst"]["translation_um"] < 60
    # The same inputs again: nothing is detected anew, and the answer is the same to the last digit.
    before = {p.name: p.stat().st_mtime_ns for p in (out / "cache").glob("*.npz")}
    assert command("run", data / "images", *files, "--out", out)[0] == 0
    assert {p.name: p.stat().st_mtime_ns for p in (out / "cache").glob("*.npz")} == before
    assert json.loads((out / "faces.json").read_text()) == faces


@pytest.mark.slow
def test_the_demo_ends_within_its_own_sigma(command, tmp_path):
    code, text, _ = command("demo", "--out", tmp_path / "demo")
    assert code == 0
    assert "simulated" in text
    from stcal.sfm.report.compare import compare

    comparison = compare(tmp_path / "demo" / "run", tmp_path / "demo" / "data" / "truth.json").content()
    for face_id in ("2", "3", "4", "5"):
        assert 0.1 < comparison["faces"][face_id]["normalised_error"] < 2.0


def test_versions_for_reports_of_faults(command, monkeypatch):
    """Also where COLMAP is not there, or a library does not load."""
    code, out, _ = command("--versions", entry=main)
    found = dict(line.split(maxsplit=1) for line in out.splitlines() if not line.startswith("native"))
    assert code == 0
    assert found["stcal"] == stcal.__version__
    assert found["NumPy"] == np.__version__
    assert found["pycolmap"].startswith("4.2")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(versions.LIBRARIES, "OpenCV", "no_such_module")
    again = command("--versions")[1]
    assert "native colmap  not found" in again
    assert "OpenCV         does not load: No module named 'no_such_module'" in again
