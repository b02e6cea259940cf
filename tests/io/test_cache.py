"""What is kept is read back bit by bit; what is damaged, edited or another's counts as absent, with a note."""

import ast
import os
import threading
import time
import tracemalloc
import warnings
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stcal.errors import InputNote
from stcal.io import cache
from stcal.io.cache import keep, kept

ARRAYS = {"xyz": np.array([[0.1, 0.2, 0.3]]), "index": np.array([3, 1])}
META = {"name": "ä", "count": 2}


def together(arrays, meta):
    return {name: arrays[name] for name in ARRAYS}, meta


def test_kept_and_read_back(tmp_path):
    path = tmp_path / "cache" / "key.npz"
    keep(path, ARRAYS, META)
    arrays, meta = kept(path, together)
    assert meta == META
    assert all(np.array_equal(arrays[name], ARRAYS[name]) for name in ARRAYS)


def test_heads_of_arrays_are_parsed_by_one_thread_at_a_time(tmp_path, monkeypatch):
    """NumPy parses them by ``ast``, which can fail in several threads."""
    parse, busy, overlaps = ast.literal_eval, threading.Lock(), []

    def slowly(text):
        overlaps.append(not busy.acquire(blocking=False))
        time.sleep(1e-3)
        if not overlaps[-1]:
            busy.release()
        return parse(text)

    path = tmp_path / "key.npz"
    keep(path, ARRAYS, META)
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
