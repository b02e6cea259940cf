"""``verify``: a run's folder holds what the run wrote, or what is wrong with it is named."""

import json
import os
import shutil

import pytest

from stcal.io.files import RUN_MARKER
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.saved import verify
from stcal.sfm.runs.transaction import MarkerFile, added_results, run_folder
from tests.outcome import INPUT, assert_error, fails_with, refuses
from tests.shared import own_copy

MARKER = MarkerFile.of("images", RunOptions())


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


def test_a_run_is_whole_with_files_beside_it(made):
    (made / "notes.txt").write_text("mine")
    (made / ".stcal/cache" / "x.npz").write_text("later")
    assert verify(made).notes() == []


def link(path):
    content = path.with_name("elsewhere")
    path.replace(content)
    path.symlink_to(content)


SPOILT = {
    "missing": (lambda run: (run / "overlays/12/a.jpg").unlink(), "missing", "overlays/12/a.jpg"),
    "a folder gone": (lambda run: shutil.rmtree(run / "colmap/models"), "missing", "colmap/models/12/images.bin"),
    "one letter": (lambda run: (run / "faces.json").write_text("faces.jsoN"), "changed", "faces.json"),
    "a link": (lambda run: link(run / "faces.json"), "changed", "faces.json"),
    "a pipe": (lambda run: ((run / "report.json").unlink(), os.mkfifo(run / "report.json")), "changed", "report.json"),
    "the marker": (lambda run: edit_marker(run, lambda c: c.update(images="/elsewhere")), "changed", RUN_MARKER),
    "its hashes": (lambda run: edit_marker(run, lambda c: c["sha256"].popitem()), "changed", RUN_MARKER),
    "a file among the results": (lambda run: (run / "colmap/models/new.bin").touch(), "added", "colmap/models/new.bin"),
    "a link among the results": (lambda run: (run / "colmap/models/new").symlink_to("/"), "added", "colmap/models/new"),
    "a comparison by hand": (lambda run: (run / "compare.json").touch(), "added", "compare.json"),
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


def test_what_a_command_adds_belongs_to_the_run(made):
    for text in ("first", "second"):
        with added_results(made) as stage:
            (stage / "compare.json").write_text(text)
            (stage / "report.json").write_text(text)
        assert verify(made).notes() == []
    assert (made / "compare.json").read_text() == "second"
    assert (made / "faces.json").read_text() == "faces.json"
    (made / "compare.json").unlink()
    assert verify(made).missing == ("compare.json",)


def test_a_command_that_fails_adds_nothing(made):
    def add():
        with added_results(made) as stage:
            (stage / "report.json").write_text("half")
            raise ValueError

    with pytest.raises(ValueError, match=r"^$"):
        add()
    assert verify(made).notes() == []
    assert not (made / ".stcal/unfinished").exists()


def test_a_run_and_an_addition_wait_for_each_other(made):
    """The same process counts as another one here: each claim opens the lock anew."""
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
