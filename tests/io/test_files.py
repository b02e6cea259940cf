"""Files: none is read beyond what its kind can have, and those written appear complete or not at all. JSON: any content
is a value or one line of error, which says what is wrong where. What is kept is read back bit by bit, or is absent."""

import ast
import json
import os
import threading
import time
import tomllib
import tracemalloc
import warnings
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from stcal.boards.board_file import load_board, load_flat_board
from stcal.errors import InputError, InputNote
from stcal.geometry.rigid import Rigid
from stcal.io import cache, files
from stcal.io.cache import keep, kept
from stcal.io.cameras.read import read_camera
from stcal.io.files import MB, MODEL_BYTES, SETTINGS_BYTES, TABLE_BYTES, json_text, keep_apart, read_bytes, save
from stcal.io.json import ByFace, Named, Part, Pose, ResultFile, Vector3, checked, read_json, read_result
from stcal.io.table import read_table
from stcal.io.toml import toml_of, toml_string
from tests.outcome import fails_with, refuses
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


def test_text_bytes_and_folders_and_a_failed_write_that_leaves_the_old_file(tmp_path, monkeypatch):
    save(tmp_path / "a" / "b" / "text.txt", "µ\n")
    assert (tmp_path / "a" / "b" / "text.txt").read_bytes() == "µ\n".encode()
    save(tmp_path / "bytes", b"\x00\xff")
    assert (tmp_path / "bytes").read_bytes() == b"\x00\xff"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "bytes"]
    path = tmp_path / "a" / "result.csv"
    save(path, "old")

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[:2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(InputError, match=r"result\.csv: cannot be written: No space left on device; check"):
        save(path, "new content")
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.glob("*.*")] == ["result.csv"]


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


class Row(Part):
    name: str
    value: int | float | None


class Example(ResultFile):
    format: Literal["stcal example 1"]
    rows: list[Row]
    poses: dict[ByFace, Pose]
    middle: Vector3
    later: float | None = None


POSE = Rigid.exp([0.1, -0.2, 0.3, 4, 5, 6])
WHOLE = {
    "format": "stcal example 1",
    "rows": [{"name": "ä", "value": 1}, {"name": "b", "value": 1.0}, {"name": "c", "value": None}],
    "poses": {"1": POSE},
    "middle": np.array([0.1, 0.2, 0.3]),
}


def test_written_as_given_and_read_back_without_keys_of_later_versions_of_which_none_is_written(tmp_path):
    text = json_text(Example.model_validate(WHOLE).content())
    plain = WHOLE | {"poses": {"1": POSE.matrix().tolist()}, "middle": [0.1, 0.2, 0.3]}
    assert text == json.dumps(plain, indent=1, ensure_ascii=False) + "\n"  # 1 stays 1, and later is not there
    path = written(tmp_path / "example.json", b"\xef\xbb\xbf" + text.encode())
    found = read_result(path, Example, "example", "make one")
    assert np.array_equal(found.poses["1"], POSE.matrix())
    assert found.later is None
    assert found.content() == json.loads(text)
    assert "newer" not in checked(WHOLE | {"newer": 1}, Example).content()
    with pytest.raises(ValidationError, match="newer"):
        Example.model_validate(WHOLE | {"newer": 1})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "stcal example 2"}, "E-KEY-VALUE … 'stcal example 2' … 'stcal example 1'"),
        ({"rows": [{"name": "a", "value": float("nan")}]}, "E-KEY-VALUE … 1."),
        ({"rows": [{"name": "a"}]}, "E-KEY-MISSING … 1. … 'value'"),
        ({"rows": [{"name": 3, "value": 1}]}, "E-KEY-VALUE … 1. … 3"),
        ({"poses": {"1": np.diag([2.0, 1, 1, 1])}}, "E-KEY-VALUE … 1"),
        ({"poses": {"1": "abc"}}, "E-KEY-VALUE … 1 … 'abc'"),
        ({"middle": [1, 2]}, "E-KEY-VALUE … 1 … 2 … 2 … 3"),
        ({"middle": [1, 2, float("inf")]}, "E-KEY-VALUE"),
    ],
)
def test_the_place_and_the_reason_are_named(change, message):
    refuses(message, checked, WHOLE | change, Example)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "E-JSON-INVALID"),
        (b"\xff\xfe\x00", "E-JSON-INVALID"),
        (b"[" * 100_000, "E-JSON-INVALID"),
        (b'{"a": ' + b"9" * 5000 + b"}", "E-JSON-INVALID"),
        (b"[1]", "E-JSON-CONTENT … list"),
        (b"NaN", "E-JSON-CONTENT … float"),
    ],
)
def test_a_file_that_is_no_object(tmp_path, content, reason):
    path = written(tmp_path / "some.json", content)
    with fails_with(reason) as caught:
        read_json(path, "file", "make one")
    assert str(caught.value).startswith(f"file {path}: ")
    assert str(caught.value).endswith("; make one")
    assert "\n" not in str(caught.value)
    refuses("E-FILE-UNREADABLE … none.json … make one", read_json, tmp_path / "none.json", "file", "make one")


@pytest.mark.slow
@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_any_bytes_are_a_value_or_one_line(tmp_path_factory, content):
    path = written(tmp_path_factory.getbasetemp() / "any.json", content)
    try:
        message = str(read_json(path, "file", "make one"))
    except InputError as error:
        message = str(error)
    assert "\n" not in message


@dataclass(frozen=True)
class Fit:
    pose: Rigid
    sigma: np.ndarray
    worst: float = np.inf

    def share(self) -> float:
        return 0.5


@dataclass(frozen=True)
class Found:
    fit: Fit
    names: tuple[str, ...] = ("a",)


class WithKeys(ResultFile):
    every: Annotated[Fit, Named()]
    named: Annotated[Found, Named("names fit.share fit.worst")]


def test_an_object_of_a_file_holds_named_attributes_of_a_result_or_all_its_fields():
    fit = Fit(Rigid(), np.array([1.0, 2.0]))
    content = WithKeys.model_validate({"every": fit, "named": Found(fit)}).content()
    assert content["every"] == {"pose": np.eye(4).tolist(), "sigma": [1.0, 2.0], "worst": None}
    assert content["named"] == {"names": ["a"], "fit": {"share": 0.5, "worst": None}}
    assert WithKeys.model_validate(content).content() == content
    with pytest.raises(ValidationError, match="an object with pose sigma worst needed"):
        WithKeys.model_validate(content | {"every": {"pose": 1}})


@given(st.text())
def test_a_text_comes_back_as_it_was(text):
    assert tomllib.loads(f"name = {toml_string(text)}") == {"name": text}


@pytest.mark.parametrize("filled", ["9", "x", "[", '"', " ", ",", "."])
def test_a_long_line_is_judged_as_fast_as_it_is_read(filled):
    """Its length squared would be minutes."""
    start = time.process_time()
    with suppress(ValueError):
        toml_of("a = 1\n" + filled * 300_000 + "\n")
    assert time.process_time() - start < 5


ARRAYS = {"xyz": np.array([[0.1, 0.2, 0.3]]), "index": np.array([3, 1])}
META = {"name": "ä", "count": 2}


def together(arrays, meta):
    return {name: arrays[name] for name in ARRAYS}, meta


def test_kept_and_read_back_heads_of_arrays_by_one_thread_at_a_time(tmp_path, monkeypatch):
    """NumPy parses them by ``ast``, which can fail in several threads."""
    path = tmp_path / "cache" / "key.npz"
    keep(path, ARRAYS, META)
    arrays, meta = kept(path, together)
    assert meta == META
    assert all(np.array_equal(arrays[name], ARRAYS[name]) for name in ARRAYS)
    parse, busy, overlaps = ast.literal_eval, threading.Lock(), []

    def slowly(text):
        overlaps.append(not busy.acquire(blocking=False))
        time.sleep(1e-3)
        if not overlaps[-1]:
            busy.release()
        return parse(text)

    monkeypatch.setattr(ast, "literal_eval", slowly)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: kept(path, together), range(8)))
    assert None not in found
    assert len(overlaps) == 8 * 4  # two arrays, the values, and the checksum
    assert not any(overlaps)


@pytest.mark.parametrize("end", [0, 10, 200, -1])
def test_a_damaged_or_absent_file_is_none(tmp_path, end):
    path = tmp_path / "key.npz"
    with warnings.catch_warnings(action="error"):  # a file that never was is nothing to note
        assert kept(path, together) is None
    keep(path, ARRAYS, META)
    path.write_bytes(path.read_bytes()[:end])
    with pytest.warns(InputNote, match=r"key\.npz is damaged"):
        assert kept(path, together) is None


def test_an_edited_file_and_that_of_another_are_none(tmp_path):
    """The edit is one that NumPy can read."""
    path, other = tmp_path / "key.npz", tmp_path / "other.npz"
    keep(other, {"xyz": ARRAYS["xyz"]}, META)  # of another form
    assert kept(other, together) is None
    keep(path, ARRAYS, META)
    keep(other, ARRAYS, META)
    assert kept(other, together) is not None
    other.write_bytes(path.read_bytes())
    with pytest.warns(InputNote, match=r"other\.npz is made from other inputs"):
        assert kept(other, together) is None
    with np.load(path) as stored:
        np.savez(path, **dict(stored) | {"xyz": ARRAYS["xyz"] + 1e-6})
    with pytest.warns(InputNote, match=r"key\.npz is edited"):
        assert kept(path, together) is None


@pytest.mark.parametrize("make", [lambda path: (path / "deeper").mkdir(parents=True), os.mkfifo])
def test_a_folder_or_a_pipe_in_its_place_makes_room_and_is_not_waited_for(tmp_path, make):
    path = tmp_path / "key.npz"
    make(path)
    with pytest.warns(InputNote, match=r"key\.npz is damaged"):
        assert kept(path, together) is None
    keep(path, ARRAYS, META)
    assert kept(path, together) is not None


def test_a_file_of_gigabytes_is_none_and_takes_no_memory(tmp_path, monkeypatch):
    """Sparse, or of zeros that were packed."""
    most = 5_000_000
    monkeypatch.setattr(cache, "TABLE_BYTES", most)
    sparse, packed = tmp_path / "sparse.npz", tmp_path / "packed.npz"
    keep(sparse, ARRAYS, META)
    os.truncate(sparse, 3 << 30)
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("xyz.npy", bytes(most + 1))
    tracemalloc.start()
    try:
        assert kept(sparse, together) is None
        assert kept(packed, together) is None
        assert tracemalloc.get_traced_memory()[1] < 2 * most
    finally:
        tracemalloc.stop()
