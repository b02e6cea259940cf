"""Small data sets with pixels, made once, and the command line in this process."""

import sys
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import pytest

from stcal.cli.main import main_sfm
from stcal.sfm.pipeline import RunOptions, RunResult, run
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import Scene, SceneOptions, make_scene
from tests.fuzzing.stock import make_stock
from tests.outcome import Outcome, ended
from tests.shared import own_copy

SMALL = SceneOptions(seed=3, width=1296, height=864, images_per_group=4, groups=(("1", "2"), ("1", "4")))


@pytest.fixture(scope="session")
def small_scene() -> Scene:
    """The reference design in groups 12 and 14, four images of 1296×864 px each."""
    return make_scene(SMALL)


@pytest.fixture(scope="session")
def small_dataset(small_scene, once) -> Path:
    """``small_scene`` as a folder. Not to be written to: see ``small_set``."""
    return once.folder("small", lambda folder: write_dataset(folder, small_scene, workers=1))


@pytest.fixture(scope="session")
def small_result(small_dataset, once) -> RunResult:
    """Of a run of ``small_dataset``; its folder is ``small_run``."""
    data = small_dataset
    files = [data / name for name in ("target.toml", "board.toml")]

    def make(out: Path) -> RunResult:
        return run(data / "images", data / "cameras.txt", out, *files, RunOptions(workers=1))

    return once.value("small_run", make)[1]


@pytest.fixture(scope="session")
def small_run(small_result) -> Path:
    """A finished run of ``small_dataset``. Not to be written to."""
    return small_result.out


@pytest.fixture(scope="session")
def stock(small_dataset, small_run, once) -> Path:
    """Valid inputs of every command, see `tests/fuzzing/stock.py`. Not to be written to."""
    return once.folder("stock", lambda folder: make_stock(folder, small_dataset, small_run))


@pytest.fixture(scope="session")
def other_pair_scene(small_scene) -> Scene:
    """The same target and camera, faces 3 and 4 in view."""
    scene = make_scene(replace(SMALL, images_per_group=3, groups=(("3", "4"),)))
    assert scene.circles_target["1:1"].tolist() == small_scene.circles_target["1:1"].tolist()
    return scene


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
        """Of ``stcal-sfm run``."""
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
