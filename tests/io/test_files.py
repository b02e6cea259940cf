"""No file is read beyond what its kind can have; written files appear complete or not at all."""

import json
import os
import tracemalloc
from pathlib import Path

import pytest

from stcal.boards.board_file import load_board, load_flat_board
from stcal.errors import InputError
from stcal.io import files
from stcal.io.cameras.read import read_camera
from stcal.io.files import MB, MODEL_BYTES, SETTINGS_BYTES, TABLE_BYTES, keep_apart, read_bytes, save
from stcal.io.json import read_json
from stcal.io.table import read_table
from tests.outcome import refuses
from tests.shared import written

READERS = {
    "camera": (read_camera, SETTINGS_BYTES),
    "board": (load_board, SETTINGS_BYTES),
    "flat board": (load_flat_board, SETTINGS_BYTES),
    "table": (lambda path: read_table(path, "table"), TABLE_BYTES),
    "result": (lambda path: read_json(path, "result", "give another"), TABLE_BYTES),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_larger_file_is_an_error_with_the_limit(tmp_path, kind):
    read, most = READERS[kind]
    path = tmp_path / "large"
    path.touch()
    os.truncate(path, 3 << 30)
    with pytest.raises(InputError, match=f"large: 3221 MB, at most {most // 1_000_000} MB are read; "):
        read(path)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no file without end on this system")
def test_a_file_without_end_is_an_error():
    refuses("E-CAMERA-UNREADABLE … /dev/zero … 10", read_camera, "/dev/zero")


def test_a_link_to_itself(tmp_path):
    """Python before 3.13 raises RuntimeError where such a path is resolved."""
    link = tmp_path / "a"
    link.symlink_to("a")
    keep_apart([("--out", tmp_path / "b")], [("pairs", link)])
    refuses("E-CAMERA-UNREADABLE … symbolic links", read_camera, link)


def test_as_much_as_there_may_be_is_read_in_memory_of_its_own_size(tmp_path):
    """`read` takes memory for all that it is asked for, and the limits are far above any file."""
    path = written(tmp_path / "small.txt", b"x" * 1000)
    assert read_bytes(path, 1000) == b"x" * 1000
    with pytest.raises(OSError, match="0 MB, at most 0 MB are read"):
        read_bytes(path, 999)
    tracemalloc.start()
    try:
        assert read_bytes(path, MODEL_BYTES) == b"x" * 1000
        assert tracemalloc.get_traced_memory()[1] < 3 * MB
    finally:
        tracemalloc.stop()


def test_no_result_is_larger_than_what_is_read_again(monkeypatch):
    rows = {"residuals": [[0.25, -1.5, 3.0]] * 400}
    wide = len(files.json_text(rows))
    monkeypatch.setattr(files, "COMPACT_FROM", wide // 2)
    assert len(files.json_text(rows)) < wide // 2
    assert json.loads(files.json_text(rows)) == rows
    monkeypatch.setattr(files, "TABLE_BYTES", wide // 4)
    refuses("E-OUTPUT-SIZE … give fewer rows", files.json_text, rows)


def test_text_bytes_and_folders(tmp_path):
    save(tmp_path / "a" / "b" / "text.txt", "µ\n")
    assert (tmp_path / "a" / "b" / "text.txt").read_bytes() == "µ\n".encode()
    save(tmp_path / "bytes", b"\x00\xff")
    assert (tmp_path / "bytes").read_bytes() == b"\x00\xff"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "bytes"]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "result.csv"
    save(path, "old")

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[:2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(InputError, match=r"result\.csv: cannot be written: No space left on device; check"):
        save(path, "new content")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["result.csv"]


@pytest.mark.parametrize(
    ("place", "words"),
    [("file/below.txt", "below.txt: cannot be written: "), ("folder", "folder: is a folder"), ("..", "is a folder")],
)
def test_a_place_that_is_none_is_named(tmp_path, place, words):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=words):
        save(tmp_path / place, "x")
    with pytest.raises(InputError, match="is a folder"):
        save(Path(), "x")


@pytest.mark.parametrize("value", [float("nan"), [1.0, float("inf")], [[1.0], [float("-inf")]]])
def test_json_knows_no_infinity(value):
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.json_text({"a": value})
