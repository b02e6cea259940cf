"""The native COLMAP against ours; and native programs that are absent, something else, broken, or wrong."""

import json
import os
import re
import shutil
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from hashlib import sha256
from io import StringIO
from pathlib import Path

import pytest

from stcal.cli.main import main_sfm
from stcal.io.files import RUN_MARKER
from stcal.sfm.interop.crosscheck import find_colmap, mapper_options
from stcal.sfm.mapping.incremental import pipeline_options
from stcal.sfm.runs.transaction import verify
from tests.outcome import COMPUTATION, INPUT, assert_error, lines_of
from tests.shared import own_copy

INSTALL = "install it with `sudo apt-get install colmap`"


def state_of(folder) -> dict[str, str]:
    """Every file of a run's results, with its marker, and a digest of its content."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.parent != folder / ".stcal"]
    files = [path for path in files if ".stcal/cache" not in path.as_posix()] + [folder / RUN_MARKER]
    return {path.relative_to(folder).as_posix(): sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(autouse=True)
def nothing_is_left(tmp_path, monkeypatch):
    """Temporary folders are made in one that must be empty in the end."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    yield
    assert list(folder.iterdir()) == []


@pytest.fixture(scope="session")
def colmap() -> str:
    found = shutil.which("colmap")
    if found is None:
        pytest.skip("native colmap is not on PATH")
    return found


@pytest.fixture(scope="module")
def checked(small_run, colmap, tmp_path_factory):
    """A run that was cross-checked: its folder, its state before, and what the command said."""
    run = tmp_path_factory.mktemp("checked") / "run"
    own_copy(small_run, run, ignore=shutil.ignore_patterns("cache"))
    before = state_of(run)
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["stcal-sfm", "crosscheck", str(run)])
        with pytest.raises(SystemExit) as ended:
            main_sfm()
    return run, before, (ended.value.code or 0, out.getvalue(), err.getvalue())


@pytest.mark.slow
def test_the_two_programs_agree_and_the_report_alone_changes(checked):
    """They differ where their iterations end; ours forgets where it started; and as COLMAP leaves a model it lacks our
    weights and the joint adjustment."""
    run, before, (code, out, err) = checked
    assert code == 0, err
    assert lines_of(err) == []
    assert "allowed: faces and circles 3 σ between the programs, 0.5 σ adjusted: they agree" in out
    assert out.splitlines()[-1] == f"report: {run / 'report.html'}"
    check = json.loads((run / "report.json").read_text(encoding="utf-8"))["crosscheck"]
    assert check["differences"] == check["notes"] == []
    assert check["images"] == {"native": 8, "pycolmap": 8, "run": 8, "only_native": [], "only_pycolmap": []}
    assert check["mapping"]["faces"].keys() == check["result"]["faces"].keys() == {"1", "2", "4", "5"}
    assert len(check["mapping"]["cameras"]) == 8
    assert len(check["mapping"]["circles_um"]) == len(json.loads((run / "faces.json").read_text())["circles"])
    for key, low, high in (("mapping", 1e-4, 2), ("result", 0, 0.05), ("plain", 2, 50)):
        assert low <= max(row["translation_um"] for row in check[key]["faces"].values()) < high
    assert 1e-4 < max(check["mapping"]["circles_um"].values()) < 2
    assert 1e-3 < max(row["position_um"] for row in check["mapping"]["cameras"]) < 20
    assert 0.001 < check["residual_rms_px"]["native"] < 0.02
    assert check["residual_rms_px"]["native"] == pytest.approx(check["residual_rms_px"]["pycolmap"], rel=1e-3)
    after = state_of(run)
    assert {name for name in after if after[name] != before.get(name)} == {"report.json", "report.html", RUN_MARKER}
    assert verify(run).notes() == []
    assert after.keys() == before.keys()


@pytest.mark.slow
def test_outside_the_tolerances_it_says_where(colmap, checked, stcal_sfm, tmp_path):
    """Nothing is allowed: every face but the reference, a circle and a camera are named, and the report is written."""
    run = own_copy(checked[0], tmp_path / "run")
    (run / "report.html").write_text("", encoding="utf-8")
    outcome = stcal_sfm("crosscheck", run, "--tolerance-um", 0, "--camera-tolerance-um", 0)
    line = assert_error(outcome, COMPUTATION, "cross-check: native COLMAP ", " and stcal differ: ")
    for face in ("2", "4", "5"):
        assert re.search(rf"face {face} \(mapped by both\) \d\.\d µm, 0\.\d\d mdeg, 0\.\d\d σ; 0 µm allowed", line)
    assert "face 1 (mapped" not in line
    differences = json.loads((run / "report.json").read_text(encoding="utf-8"))["crosscheck"]["differences"]
    assert any(re.match(r"circle \d:\w \(mapped by both\) \d\.\d µm; 0 µm allowed", each) for each in differences)
    assert re.search(r"camera 1[24]/IMG_100\d.jpg: position \d\.\d µm; 0 µm allowed", line)
    assert "exceeded" in outcome[1]
    assert "They differ: face " in (run / "report.html").read_text(encoding="utf-8")


def numbers(options, prefix: str = "") -> dict[str, float]:
    values = {name: getattr(options, name) for name in dir(options) if not name.startswith("_")}
    return {prefix + name: value for name, value in values.items() if isinstance(value, bool | int | float)}


def test_the_native_mapper_is_given_every_threshold_that_it_has(colmap):
    found = find_colmap()
    given = mapper_options(found, ["a", "b"], (7, 9))
    own = pipeline_options(["a", "b"], (7, 9))
    ours = numbers(own.triangulation, "tri_") | numbers(own.mapper) | numbers(own)
    offered = {option.removeprefix("Mapper."): option for option in found.mapper_options if "Mapper." in option}
    shared = {key for key in ours.keys() & offered.keys() if ours[key] >= 0}
    assert len(shared) >= 40
    for key in shared:
        assert float(given[offered[key]]) == float(ours[key]), key
        assert given[offered[key]] in ("0", "1") or not isinstance(ours[key], bool), key
    assert given.keys() <= found.mapper_options


def program(folder, mapper: str, version: str = "3.8", asked: str = "") -> Path:
    """A shell script that answers as COLMAP does, and maps as ``mapper`` says; ``asked`` comes before all answers."""
    path = folder / "colmap"
    path.write_text(
        f"""#!/bin/sh
{asked}
case "$1 $2" in
"help "*) echo "COLMAP {version} -- Structure-from-Motion and Multi-View Stereo"; exit ;;
"mapper -h") echo "  --Mapper.min_num_matches arg (=15)"; echo "  --Mapper.multiple_models arg (=1)"; exit ;;
esac
for word; do
  case $before in
  --database_path) database=$word ;;
  --output_path) models=$word ;;
  --image_list_path) list=$word ;;
  esac
  before=$word
done
{mapper}
"""
    )
    path.chmod(0o755)
    return path


@pytest.fixture
def refused_page_and_all(own_run, stcal_sfm, tmp_path):
    """The cross-check with a program must end in one line, and the run stay as it is."""

    def check(colmap, code: int, *parts: str, more=()) -> str:
        before = state_of(own_run)
        line = assert_error(stcal_sfm("crosscheck", own_run, "--colmap", colmap, *more), code, *parts)
        assert state_of(own_run) == before
        return line

    return check


@pytest.fixture
def refused(refused_page_and_all, no_page):
    """The same for a report that is whole, whose page need not be drawn to see that."""
    return refused_page_and_all


def test_programs_that_are_not_there_or_not_colmap(refused, own_run, stcal_sfm, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))
        outcome = stcal_sfm("crosscheck", own_run)
    assert_error(outcome, INPUT, "E-COLMAP-PROGRAM", "on the PATH", INSTALL, "--colmap")
    (tmp_path / "text").write_text("no program")
    for place in (tmp_path / "none", tmp_path / "text"):
        refused(place, INPUT, f"native COLMAP: no program at {place} that can be executed", INSTALL)
    refused(shutil.which("true"), INPUT, "does not say a COLMAP version", INSTALL, "or give another --colmap")
    refused(shutil.which("false"), INPUT, "help` ended with code 1: no message", INSTALL)


FAILURES = {
    "exits with a message": (
        'echo "doing well"; echo "ERROR: no space left on device" >&2; exit 1',
        "mapper` ended with code 1: doing well ERROR: no space left on device; check the program",
    ),
    "writes no model": ("exit 0", "group 12: native COLMAP 3.8 makes no model from the run's initial pair"),
    "writes something else": (
        'mkdir "$models/0"; for f in cameras images points3D; do echo hello > "$models/0/$f.bin"; done',
        "group 12: what native COLMAP 3.8 made from the run's database cannot be used: model ",
    ),
}


def test_a_mapper_that_fails_and_what_it_is_given(refused, tmp_path, own_run):
    """Names of one group, its pair by the database's ids, choices as 0 and 1, an empty folder, no screen."""
    for case in FAILURES:
        mapper, part = FAILURES[case]
        refused(program(tmp_path, mapper), COMPUTATION, part)
    said = tmp_path / "said"
    keep = f'printf "%s\\n" "$@" > "{said}"; cat "$list" > "{said}.list"; ls -A "$models" > "{said}.models"'
    path = program(tmp_path, f'{keep}; echo $QT_QPA_PLATFORM > "{said}.screen"; exit 1')
    refused(path, COMPUTATION, "ended with code 1")
    words = said.read_text().split()
    assert words[0] == "mapper"
    given = dict(zip(words[1::2], words[2::2], strict=True))
    assert given["--Mapper.multiple_models"] == "0"
    assert given["--Mapper.min_num_matches"] == "6"
    assert len(given) == 6
    assert (tmp_path / "said.list").read_text().splitlines() == [f"12/IMG_100{i}.jpg" for i in range(4)]
    assert (tmp_path / "said.models").read_text() == ""
    assert (tmp_path / "said.screen").read_text() == "offscreen\n"
    assert not given["--database_path"].startswith(str(own_run))


def answers_of(colmap: str) -> str:
    return f'case "$1 $2" in "help "*|"mapper -h") exec {colmap} "$@" ;; esac'


def has_ended(pid: int) -> bool:
    """Whether a process is no more, or only waits to be collected; five seconds to get there."""
    until = time.monotonic() + 5
    while time.monotonic() < until:
        try:
            os.kill(pid, 0)
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.01)
    return False


@pytest.mark.slow
def test_a_mapper_that_hangs_with_a_child(refused, tmp_path):
    pids = tmp_path / "pids"
    path = program(tmp_path, f'sleep 61 & echo $$ $! > "{pids}"; wait')
    start = time.monotonic()
    said = "E-COLMAP-TIMEOUT", "mapper` is still running after 1 s; raise --timeout"
    refused(path, COMPUTATION, *said, more=("--timeout", 1))
    assert 1 < time.monotonic() - start < 30
    mapper, child = map(int, pids.read_text().split())
    assert has_ended(mapper)
    assert has_ended(child)


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_a_model_that_lacks_an_image(own_run, stcal_sfm, colmap, tmp_path):
    """One that is not of the initial pair, taken from the list."""
    path = program(tmp_path, f'sed -i "/IMG_1002/d" "$list"; exec {colmap} "$@"', asked=answers_of(colmap))
    outcome = stcal_sfm("crosscheck", own_run, "--colmap", path)
    assert_error(outcome, COMPUTATION, "differ: image 12/IMG_1002.jpg and 1 more: registered by pycolmap only; ")
    assert ": 6 of 8 images" in outcome[1]
    check = json.loads((own_run / "report.json").read_text(encoding="utf-8"))["crosscheck"]
    assert check["images"]["only_pycolmap"] == ["12/IMG_1002.jpg", "14/IMG_1002.jpg"]
    assert max(row["translation_um"] for row in check["result"]["faces"].values()) < 0.05  # resected by its labels


def test_a_report_that_cannot_be_added_to(own_run, refused_page_and_all, tmp_path):
    """It is said before the mapping, which takes minutes on large sets."""
    (own_run / "overlays/12/IMG_1000.jpg").unlink()
    never = program(tmp_path, "echo the mapper was started; exit 1")
    refused_page_and_all(never, INPUT, "IMG_1000.jpg: No such", "run it again")
