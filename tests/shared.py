"""Data that tests share: made once for all processes of a test run, not to be written to."""

import csv
import ctypes
import json
import os
import pickle
import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest
from filelock import FileLock

CAPABILITIES, ANY_FILE = 0x20080522, 0b110
"""Version of Linux's interface, and the bits of CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH."""
OF_READERS = ("lock", ".db-wal", ".db-shm")
T = TypeVar("T")


class Once:
    """Makes folders once for all processes of a test run.

    Files lose their write bits when they are made. :meth:`changed` names what is not as it was made all the same: a
    process of the superuser may write to any file.
    """

    def __init__(self, factory: pytest.TempPathFactory, worker: str):
        base = factory.getbasetemp()
        self.root = (base if worker == "master" else base.parent) / "once"
        self.root.mkdir(exist_ok=True)
        self._stamps: dict[Path, dict[str, tuple[int, int]]] = {}

    def folder(self, name: str, make: Callable[[Path], object]) -> Path:
        """The folder of this name, filled by ``make`` where no process has done so yet."""
        return self.value(name, make)[0]

    def value(self, name: str, make: Callable[[Path], T]) -> tuple[Path, T]:
        """Like :meth:`folder`, with what ``make`` returned; it must be possible to pickle it."""
        folder, kept = self.root / name, self.root / f"{name}.pickle"
        with FileLock(self.root / f"{name}.lock"):
            if not kept.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of an attempt that failed
                made = make(folder)
                protect(folder)
                kept.write_bytes(pickle.dumps((made, stamps(folder))))
            value, self._stamps[folder] = pickle.loads(kept.read_bytes())
        return folder, value

    def changed(self) -> list[str]:
        found = []
        for folder, made in self._stamps.items():
            now = stamps(folder)
            found += [str(folder / name) for name in made.keys() | now.keys() if made.get(name) != now.get(name)]
        return sorted(found)


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file below a folder, but for those that readers make: locks, and SQLite's files."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(OF_READERS))
    return {str(path.relative_to(folder)): ((s := path.stat()).st_size, s.st_mtime_ns) for path in files}


def protect(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file() and not path.name.endswith(OF_READERS):
            path.chmod(0o444)


def own_copy(source: Path, to: Path, ignore: Callable | None = None) -> Path:
    """Copy a shared file or folder so that the copy may be written to; returns the copy.

    Parameters
    ----------
    to : place of the copy; a file goes into a folder that is there
    ignore : as of :func:`shutil.copytree`
    """
    if source.is_dir():
        return Path(shutil.copytree(source, to, ignore=ignore, copy_function=shutil.copyfile, dirs_exist_ok=True))
    return Path(shutil.copyfile(source, to / source.name if to.is_dir() else to))


def written(path: Path, content: str | bytes) -> Path:
    """The path, with this content in its file."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_rows(path: Path, header, rows) -> Path:
    """The path, with a table in its file."""
    with open(path, "w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows([header, *rows])
    return path


def unsealed_copy(run: Path, to: Path, ignore: Callable | None = None) -> Path:
    """Copy a run without the hashes of its files, as old versions left it: an edited file is then read; as above."""
    unseal(own_copy(run, to, ignore))
    return to


def unseal(run: Path) -> None:
    marker = json.loads((run / ".stcal/run.json").read_text(encoding="utf-8"))
    (run / ".stcal/run.json").write_text(json.dumps(marker | {"sha256": None}), encoding="utf-8")


@contextmanager
def without_rights(wanted: bool = True):
    """Meanwhile without the superuser's right to read and write any file; new processes have it again."""
    if not wanted or os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None)
    header, held = (ctypes.c_uint32 * 2)(CAPABILITIES, 0), (ctypes.c_uint32 * 6)()
    libc.capget(header, held)
    fewer = (ctypes.c_uint32 * 6)(*held)
    fewer[0] &= ~ANY_FILE
    libc.capset(header, fewer)
    try:
        yield
    finally:
        libc.capset(header, held)
