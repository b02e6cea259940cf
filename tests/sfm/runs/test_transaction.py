"""A run's folder holds one run's results, the earlier or the new one, whatever ends the run."""

import json
import os
import subprocess
import sys
from contextlib import suppress

import pytest

from stcal.errors import DetectionError, InputError
from stcal.io.files import RUN_MARKER
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.transaction import READY, RESULTS, MarkerFile, complete, run_folder
from tests.outcome import fails_with

MARKER = MarkerFile.of("images", RunOptions())


def write(stage, text, names=("faces.json", "report.json", "database.db")):
    for name in names:
        (stage / name).write_text(text)
    (stage / "overlays" / "12").mkdir(parents=True)
    (stage / "overlays" / "12" / "a.jpg").write_text(text)


def make(out, text, **names):
    with run_folder(out, MARKER, {}) as folder:
        write(folder.stage, text, **names)


def fail(out, names=("detections.csv",)):
    with run_folder(out, MARKER, {}) as folder:
        write(folder.stage, "new", names=names)
        raise DetectionError("E-TEST", "nothing found")


def content(out):
    """What the folder holds, but for the cache."""
    return {str(p.relative_to(out)): p.read_text() for p in out.rglob("*") if p.is_file() and p.parent.name != "cache"}


def test_new_results_take_the_earlier_ones_place(tmp_path):
    make(tmp_path / "run", "old", names=("faces.json", "labels.csv", "compare.json"))
    (tmp_path / "run" / "notes.txt").write_text("mine")
    make(tmp_path / "run", "new")
    found = content(tmp_path / "run")
    assert json.loads(found.pop(RUN_MARKER))["program"] == "stcal-sfm"
    assert found == {
        "faces.json": "new",
        "report.json": "new",
        "database.db": "new",
        "overlays/12/a.jpg": "new",
        "notes.txt": "mine",
    }


@pytest.mark.parametrize("names", [("faces.json", "report.json"), ("detections.csv",)])
def test_a_run_that_fails_leaves_the_earlier_results(tmp_path, names):
    make(tmp_path / "run", "old", names=names)
    before = content(tmp_path / "run")
    with pytest.raises(DetectionError, match=r"nothing found; the earlier results stay, .*unfinished holds what"):
        fail(tmp_path / "run")
    after = content(tmp_path / "run")
    assert after.pop("unfinished/detections.csv") == after.pop("unfinished/overlays/12/a.jpg") == "new"
    assert after == before


def test_a_first_run_that_fails_leaves_its_overlays_in_place(tmp_path):
    with pytest.raises(DetectionError, match=r"^nothing found$"):
        fail(tmp_path / "run")
    assert set(content(tmp_path / "run")) == {RUN_MARKER, "detections.csv", "overlays/12/a.jpg"}


def test_a_first_run_that_fails_while_it_writes_leaves_no_half_results(tmp_path):
    """As on a disk that fills: a ``faces.json`` without its report would pass for a result."""
    with fails_with("E-TEST"):
        fail(tmp_path / "run", names=("detections.csv", "faces.json", "database.db"))
    assert set(content(tmp_path / "run")) == {RUN_MARKER, "detections.csv", "overlays/12/a.jpg"}


def test_a_path_that_is_too_long_for_a_database_is_refused_at_once(tmp_path):
    with fails_with("E-OUTPUT-LENGTH … 500"):
        make(tmp_path / ("x" * 200) / ("y" * 200) / ("z" * 200), "new")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("moment", range(len(RESULTS) + 2))
def test_a_run_that_is_killed_while_results_take_their_places_is_completed(tmp_path, moment, monkeypatch):
    """Killed at each of the renames: what is opened next is whole, and the new one's."""
    out = tmp_path / "run"
    make(out, "old", names=("faces.json", "labels.csv", "compare.json"))
    done, replace = [], os.replace

    def killed(source, place):
        if len(done) == moment:
            raise KeyboardInterrupt
        if READY in (source.parent.name, place.name):
            done.append(place)
        replace(source, place)

    monkeypatch.setattr(os, "replace", killed)
    with suppress(KeyboardInterrupt):
        make(out, "new")
    monkeypatch.undo()
    complete(out)
    found = content(out)
    found.pop(RUN_MARKER)
    new = {"faces.json": "new", "report.json": "new", "database.db": "new", "overlays/12/a.jpg": "new"}
    old = {"faces.json": "old", "labels.csv": "old", "compare.json": "old", "overlays/12/a.jpg": "old"}
    assert {name: text for name, text in found.items() if not name.startswith("unfinished")} == (new if moment else old)


HOLD = """
import sys
from stcal.sfm.runs.transaction import MarkerFile
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.transaction import run_folder
with run_folder(sys.argv[1], MarkerFile.of("images", RunOptions()), {}):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.slow
def test_two_runs_into_one_folder_are_refused_and_a_dead_one_holds_nothing(tmp_path):
    command = [sys.executable, "-c", HOLD, tmp_path / "run"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with fails_with("E-OUTPUT-IN-USE"):
            make(tmp_path / "run", "new")
        other.kill()
    make(tmp_path / "run", "new")
    assert content(tmp_path / "run")["faces.json"] == "new"


@pytest.mark.parametrize("inside", ["target.toml", "overlays", "scratch/images", "."])
def test_inputs_in_the_folder_are_refused_and_stay(tmp_path, inside):
    make(tmp_path / "run", "old")
    given = tmp_path / "run" / inside
    before = content(tmp_path / "run")
    claim = run_folder(tmp_path / "run", MARKER, {"images": tmp_path / "elsewhere", "--target": given})
    with fails_with("E-OUTPUT-IS-INPUT … --target"):
        claim.__enter__()
    assert content(tmp_path / "run") == before


@pytest.mark.parametrize("name", ["models", "overlays", "faces.json"])
def test_nothing_is_written_through_a_link(tmp_path, name):
    make(tmp_path / "run", "old")
    behind = tmp_path / "behind"
    behind.mkdir()
    (behind / "a.txt").write_text("mine")
    place = tmp_path / "run" / name
    if place.is_dir():
        (place / "12" / "a.jpg").unlink()
        (place / "12").rmdir()
        place.rmdir()
    place.unlink(missing_ok=True)
    place.symlink_to(behind if name != "faces.json" else behind / "a.txt")
    make(tmp_path / "run", "new")
    assert not place.is_symlink()
    assert content(behind) == {"a.txt": "mine"}


@pytest.mark.parametrize("name", ["cache", "unfinished", "ready"])
def test_a_folder_of_links_is_refused(tmp_path, name):
    (tmp_path / "behind").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / RUN_MARKER).write_text("{}")
    (tmp_path / "run" / name).symlink_to(tmp_path / "behind")
    with pytest.raises(InputError, match=f"{name} in it is a link; remove it"):
        make(tmp_path / "run", "new")
