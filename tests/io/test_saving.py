"""Files appear complete or not at all."""

import json
from pathlib import Path

import pytest

from stcal.errors import InputError
from stcal.io.files import json_text, keep_apart, save


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


def test_json_keeps_letters():
    assert json.loads(json_text({"σ": [1.0]})) == {"σ": [1.0]}
    assert "σ" in json_text({"σ": 1})


def test_outputs_are_kept_apart(tmp_path, monkeypatch):
    """However a path is written, and before anything is done."""
    monkeypatch.chdir(tmp_path)
    given = tmp_path / "data.csv"
    given.touch()
    keep_apart([("--out", tmp_path / "a")], [("data", given)])
    with pytest.raises(InputError, match=r"--out data\.csv: is an input of this command"):
        keep_apart([("--out", Path("data.csv"))], [("data", given)])
    with pytest.raises(InputError, match="is a folder; the name of a file needed"):
        keep_apart([("--out", tmp_path)], [("data", given)])


@pytest.mark.parametrize("value", [float("nan"), [1.0, float("inf")], [[1.0], [float("-inf")]]])
def test_json_knows_no_infinity(value):
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text({"a": value})
