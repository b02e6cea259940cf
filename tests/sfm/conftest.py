"""Small data sets with pixels, made once, and the command line in this process."""

import shutil
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import pytest

from stcal.cli.main import main_sfm
from stcal.sfm.runs.saved import SavedRun, load_run
from tests.fuzzing.stock import make_stock
from tests.outcome import Outcome, ended
from tests.shared import own_copy


@pytest.fixture(scope="session")
def stock(small_dataset, small_run, once) -> Path:
    """Valid inputs of every command, see `tests/fuzzing/stock.py`. Not to be written to."""
    return once.folder("stock", lambda folder: make_stock(folder, small_dataset, small_run))


@pytest.fixture(scope="session")
def saved(small_run) -> SavedRun:
    return load_run(small_run)


@pytest.fixture
def own_run(small_run, tmp_path) -> Path:
    return own_copy(small_run, tmp_path / "run", ignore=shutil.ignore_patterns("cache"))


@dataclass(frozen=True)
class SmallSet:
    """A data set of one's own to spoil."""

    folder: Path

    @property
    def images(self) -> Path:
        return self.folder / "images"

    @property
    def camera(self) -> Path:
        return self.folder / "cameras.txt"

    @property
    def out(self) -> Path:
        return self.folder / "run"

    def image(self, i: int = 0, group: str = "12") -> Path:
        return self.images / group / f"IMG_{1000 + i}.jpg"

    def arguments(self, *more) -> list:
        return ["run", self.images, "--camera", self.camera, "--out", self.out, "--workers", 1, *more]


@pytest.fixture
def small_set(small_dataset, small_run, tmp_path):
    """Factory: a copy of ``small_dataset`` with some of its groups, its images detected already if asked for."""

    def copy(*groups: str, detected: bool = True) -> SmallSet:
        own = SmallSet(tmp_path / "set")
        own.images.mkdir(parents=True)
        for group in groups:
            own_copy(small_dataset / "images" / group, own.images / group)
        for name in ("cameras.txt", "target.toml", "board.toml", "truth.json"):
            own_copy(small_dataset / name, own.folder / name)
        if detected:
            own_copy(small_run / ".stcal/cache", own.out / ".stcal/cache")
            own_copy(small_run / ".stcal/run.json", own.out / ".stcal")
        return own

    return copy


@pytest.fixture
def no_page(monkeypatch):
    """For those who do not read the report's page, which takes half of a small run's time."""
    monkeypatch.setattr(import_module("stcal.sfm.runs.folder"), "report_html", lambda *_: "")


@pytest.fixture
def stcal_sfm(monkeypatch, capfd):
    """``stcal-sfm`` with arguments, in this process: exit code, text on standard output and on standard error."""

    def call(*arguments) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["stcal-sfm", *map(str, arguments)])
        return ended(main_sfm, capfd)

    return call
