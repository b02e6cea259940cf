"""A run's folder holds one run's results, the earlier or the new one, whatever ends the run; what is not as the run
wrote it is named."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress

import pytest

from stcal.errors import DetectionError
from stcal.io.files import INTERNAL, RUN_MARKER
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.transaction import READY, STAGE, MarkerFile, added_results, complete_interrupted, run_folder, verify
from tests.outcome import INPUT, assert_error, fails_with, refuses
from tests.shared import own_copy

MARKER = MarkerFile.of("images", RunOptions())


def write(stage, text, names=("faces.json", "report.json", "colmap")):
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
    """What the folder holds, but for the hidden one."""
    files = (p for p in out.rglob("*") if p.is_file())
    return {str(p.relative_to(out)): p.read_text() for p in files if INTERNAL not in p.relative_to(out).parts}


NEW = {"faces.json": "new", "report.json": "new", "colmap": "new", "overlays/12/a.jpg": "new"}


def test_new_results_take_the_earlier_ones_place_and_a_run_that_fails_leaves_them(tmp_path):
    out = tmp_path / "run"
    for names in (("faces.json", "report.json"), ("detections.csv",), ("faces.json", "labels.csv", "compare.json")):
        make(out, "old", names=names)
        before = content(out)
        with pytest.raises(DetectionError, match=r"nothing found; the earlier results stay"):
            fail(out)
        assert content(out) == before
        assert verify(out).notes() == []
    (out / "notes.txt").write_text("mine")
    make(out, "new")
    assert content(out) == NEW | {"notes.txt": "mine"}
    assert json.loads((out / RUN_MARKER).read_text())["program"] == "stcal-sfm"


def test_a_first_run_that_fails_leaves_what_helps_to_see_why_and_one_of_too_long_a_path_nothing(tmp_path):
    """And no half results, as on a disk that fills: a ``faces.json`` without its report would pass for a result."""
    with fails_with("E-OUTPUT-LENGTH … 500"):
        make(tmp_path / ("x" * 200) / ("y" * 200) / ("z" * 200), "new")
    assert not any(tmp_path.iterdir())
    for names in (("detections.csv",), ("detections.csv", "faces.json", "colmap")):
        out = tmp_path / f"run {len(names)}"
        with pytest.raises(DetectionError, match=r"^nothing found$"):
            fail(out, names)
        assert content(out) == {"detections.csv": "new", "overlays/12/a.jpg": "new"}
        assert not (out / STAGE).exists()


def ended_at(moment, monkeypatch, write_results):
    """Ends with the ``moment``-th rename by which results take their places."""
    done, replace = [], os.replace

    def killed(source, place):
        if READY in str(source) or str(place).endswith(READY):
            if len(done) == moment:
                raise KeyboardInterrupt
            done.append(place)
        replace(source, place)

    monkeypatch.setattr(os, "replace", killed)
    with suppress(KeyboardInterrupt):
        write_results()
    monkeypatch.undo()


@pytest.mark.parametrize("moment", range(len(NEW) + 3))
def test_what_is_killed_while_results_take_their_places_is_completed(tmp_path, moment, monkeypatch):
    """A run and an addition, killed at each of the renames: what is opened next is whole, and the new one's. An
    addition takes nothing away."""
    run, own = tmp_path / "run", tmp_path / "own"
    make(run, "old", names=("faces.json", "labels.csv", "compare.json"))
    make(own, "old", names=("faces.json", "report.html", "report.pdf"))

    def add():
        with added_results(own) as stage:
            (stage / "report.html").write_text("added")

    added = {name: text for name, text in content(own).items() if name != "report.pdf"} | {"report.html": "added"}
    for out, write_results, new in ((run, lambda: make(run, "new"), NEW), (own, add, added)):
        before = content(out)
        ended_at(moment, monkeypatch, write_results)
        complete_interrupted(out)
        assert content(out) == (new if moment else before)
        assert verify(out).notes() == []


HOLD = """
import sys
from stcal.sfm.runs.transaction import MarkerFile
from stcal.sfm.runs.run_options import RunOptions
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


@pytest.mark.parametrize("inside", ["inputs/target.toml", "overlays", ".stcal/images", "."])
def test_inputs_in_the_folder_are_refused_and_stay(tmp_path, inside):
    make(tmp_path / "run", "old")
    given = tmp_path / "run" / inside
    before = content(tmp_path / "run")
    claim = run_folder(tmp_path / "run", MARKER, {"images": tmp_path / "elsewhere", "--target": given})
    with fails_with("E-OUTPUT-IS-INPUT … --target"):
        claim.__enter__()
    assert content(tmp_path / "run") == before


@pytest.mark.parametrize("name", ["colmap", "overlays", "faces.json"])
def test_nothing_is_written_through_a_link(tmp_path, name):
    make(tmp_path / "run", "old")
    behind = tmp_path / "behind"
    behind.mkdir()
    (behind / "a.txt").write_text("mine")
    place = tmp_path / "run" / name
    shutil.rmtree(place, ignore_errors=True)
    place.unlink(missing_ok=True)
    place.symlink_to(behind if name != "faces.json" else behind / "a.txt")
    make(tmp_path / "run", "new")
    assert not place.is_symlink()
    assert content(behind) == {"a.txt": "mine"}


@pytest.mark.parametrize("name", [".stcal", ".stcal/cache", ".stcal/unfinished", ".stcal/ready"])
def test_a_folder_of_links_is_refused(tmp_path, name):
    (tmp_path / "behind").mkdir()
    (tmp_path / "run" / name).parent.mkdir(parents=True)
    (tmp_path / "run" / name).symlink_to(tmp_path / "behind")
    with fails_with(f"E-OUTPUT-LINK … {name}"):
        make(tmp_path / "run", "new")


@pytest.fixture
def made(tmp_path):
    with run_folder(tmp_path / "run", MARKER, {}) as folder:
        for name in ("faces.json", "report.json", "colmap/models/12/images.bin", "overlays/12/a.jpg"):
            (folder.stage / name).parent.mkdir(parents=True, exist_ok=True)
            (folder.stage / name).write_text(name)
    return tmp_path / "run"


def edit_marker(run, change):
    content = json.loads((run / RUN_MARKER).read_text())
    change(content)
    (run / RUN_MARKER).write_text(json.dumps(content))


def link(path):
    content = path.with_name("elsewhere")
    path.replace(content)
    path.symlink_to(content)


SPOILT = {
    "missing": (lambda run: (run / "overlays/12/a.jpg").unlink(), "missing", "overlays/12/a.jpg"),
    "one letter": (lambda run: (run / "faces.json").write_text("faces.jsoN"), "changed", "faces.json"),
    "a link": (lambda run: link(run / "faces.json"), "changed", "faces.json"),
    "a pipe": (lambda run: ((run / "report.json").unlink(), os.mkfifo(run / "report.json")), "changed", "report.json"),
    "the marker": (lambda run: edit_marker(run, lambda c: c.update(images="/elsewhere")), "changed", RUN_MARKER),
    "its hashes": (lambda run: edit_marker(run, lambda c: c["sha256"].popitem()), "changed", RUN_MARKER),
    "a file among the results": (lambda run: (run / "colmap/models/new.bin").touch(), "added", "colmap/models/new.bin"),
    "a database's journal": (lambda run: (run / "colmap/database.db-wal").touch(), "added", "colmap/database.db-wal"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_what_is_not_as_it_was_is_named(made, case):
    spoil, kind, name = SPOILT[case]
    spoil(made)
    result = verify(made)
    assert getattr(result, kind) == (name,)
    (note,) = result.notes()
    assert f"1 {kind} ({name})" in note
    if case != "its hashes":  # of which a file is then missing too
        assert result.notes(but=(name,)) == []


def test_what_a_command_adds_belongs_to_the_run_and_files_beside_it_do_not(made):
    (made / "notes.txt").write_text("mine")
    (made / ".stcal/cache" / "x.npz").write_text("later")
    assert verify(made).notes() == []
    for text in ("first", "second"):
        with added_results(made) as stage:
            (stage / "compare.json").write_text(text)
            (stage / "report.json").write_text(text)
        assert verify(made).notes() == []
    assert (made / "compare.json").read_text() == "second"
    assert (made / "faces.json").read_text() == "faces.json"
    (made / "compare.json").unlink()
    assert verify(made).missing == ("compare.json",)


def test_a_command_that_fails_adds_nothing_and_runs_and_additions_wait_for_each_other(made):
    """The same process counts as another one here: each claim opens the lock anew."""

    def add():
        with added_results(made) as stage:
            (stage / "report.json").write_text("half")
            raise ValueError

    with pytest.raises(ValueError, match=r"^$"):
        add()
    assert verify(made).notes() == []
    assert not (made / ".stcal/unfinished").exists()
    with added_results(made), fails_with("E-OUTPUT-IN-USE"):
        run_folder(made, MARKER, {}).__enter__()
    with run_folder(made, MARKER, {}), fails_with("E-OUTPUT-IN-USE"):
        added_results(made).__enter__()


def test_a_run_without_hashes_gets_none(made):
    edit_marker(made, lambda content: content.pop("sha256"))
    with added_results(made) as stage:
        (stage / "compare.json").write_text("x")
    assert (made / "compare.json").read_text() == "x"
    refuses(f"E-RUN-UNFINISHED … {RUN_MARKER}", verify, made)
    edit_marker(made, lambda content: content.update(sha256=3))
    refuses(f"E-RUN-DAMAGED … {RUN_MARKER} … sha256: 3:", verify, made)
    refuses("E-RUN-FOLDER", verify, made / "colmap/models")


def test_compare_adds_its_file(small_run, small_dataset, tmp_path, stcal_sfm):
    run, truth = own_copy(small_run, tmp_path / "run"), small_dataset / "truth.json"
    code, text, _ = stcal_sfm("compare", run, truth)
    assert (code, text.splitlines()[-1]) == (0, f"as JSON: {run / 'compare.json'}")
    assert verify(run).notes() == []
    with added_results(run):
        assert_error(stcal_sfm("compare", run, truth), INPUT, "E-OUTPUT-IN-USE")
