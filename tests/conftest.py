"""What tests share: the data sets beside the repository, and a calibration without pixels."""

import os
import signal

from stcal.errors import COMMAND_LINE
from stcal.parallel import ONE_THREAD

os.environ[COMMAND_LINE] = "1"  # errors name options as they stand in the source
os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # before numpy is loaded; for the commands that tests start, too
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # of a suite in the background: its commands could not be stopped
    signal.signal(signal.SIGINT, signal.default_int_handler)

import multiprocessing.util
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import typer.main
from hypothesis import HealthCheck, settings

from stcal.geometry.rigid import Rigid, Similarity
from stcal.sfm import RunOptions, RunResult, run
from stcal.sfm.adjust.chain import chain_faces, faces_of_group
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.refine import adjust, eccentricity_px, find_scale
from stcal.sfm.adjust.uncertainty import calibrated_target
from stcal.sfm.data.group_model import ImageObservations, WorldModel
from stcal.sfm.planning.forecast import observe, true_models
from stcal.synthetic import Scene, SceneOptions, make_scene, write_dataset
from tests.shared import Once, without_rights

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SAMPLE = Path(__file__).parent / "data" / "sample"
multiprocessing.util.get_temp_dir()  # kept for the process: not in the folder of a test that has one of its own

# How long examples take is the machine's, and no fault of a test.
# Examples are the same each time but where `scripts/full` draws a seed.
settings.register_profile(
    "all", deadline=None, derandomize="STCAL_SEED" not in os.environ, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("quick", settings.get_profile("all"), max_examples=20)
settings.load_profile("all")
typer.main.get_command = cache(typer.main.get_command)  # of hundreds of calls here, each would build the tree anew


def pytest_configure(config):
    """Fewer examples of each property but in `scripts/full`; and programs that tests start keep what they compile.

    Where Python is told to keep nothing, each would compile its libraries anew, which takes longer than most calls.
    """
    if "not full" in config.option.markexpr:
        settings.load_profile("quick")
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", "") and "PYTHONPYCACHEPREFIX" not in os.environ:
        kept = tempfile.TemporaryDirectory(prefix="stcal-tests-", ignore_cleanup_errors=True)
        os.environ["PYTHONPYCACHEPREFIX"] = kept.name
        config.add_cleanup(kept.cleanup)


def pytest_collection_modifyitems(items):
    """Tests of whole chains, which lie in the upper folders, first: no process is left alone with them at the end."""
    items.sort(key=lambda item: len(item.path.parts))


@pytest.fixture(scope="session", autouse=True)
def plain_rights():
    """The rights of a plain user, also where the superuser runs the tests, so that shared data cannot be written to."""
    with without_rights():
        yield


@pytest.fixture(scope="session")
def once(tmp_path_factory, worker_id):
    """Makes folders once for all processes of a test run; none of their files may have changed at its end."""
    shared = Once(tmp_path_factory, worker_id)
    yield shared
    assert shared.changed() == []


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """A data set that is not part of the repository, by its place in ``../shared/data``; without it, skips the test."""

    def find(place: str) -> Path:
        if not (SHARED / place).exists():
            pytest.skip("data sets that may not be passed on lie in ../shared/data alone")
        return SHARED / place

    return find


@pytest.fixture(scope="session")
def shared_case(shared_data) -> Callable[[str], Path]:
    """An input that was reported, by its folder in ``../shared/cases``; without it, skips the test."""
    return lambda place: shared_data(f"../cases/{place}")


@pytest.fixture(scope="session")
def sample() -> Path:
    """Twelve rendered images of the reference target, with truth: see its README. Not to be written to."""
    return SAMPLE


@pytest.fixture(scope="session")
def scene():
    """The reference target in four groups of five views, half-size camera."""
    return make_scene(SceneOptions(seed=3, width=2592, height=1728, images_per_group=5))


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


class LabelsOnly:
    """Observations and models of a scene, straight from the geometry."""

    def observations(self, scene: Scene, noise_px: float, rng) -> list[ImageObservations]:
        """Ellipse centres of everything that must be found, with noise."""
        return observe(scene, noise_px, rng)

    def models(self, scene: Scene, observations: list[ImageObservations], unit_mm: float = 1.0) -> list[WorldModel]:
        """Models at the true geometry, in a world turned and scaled against the target frame."""
        world_from_target = Similarity(1 / unit_mm, Rigid.exp([0.3, -0.2, 0.5, 40, -30, 900]))
        return [model.in_world(world_from_target) for model in true_models(scene, observations)]

    def adjusted(self, scene: Scene, observations: list[ImageObservations]) -> list[WorldModel]:
        """Models of the groups, each adjusted by itself with the eccentricity of the true geometry."""
        radius, camera = scene.target.radius_of() | scene.board.radius_of(), scene.camera
        shifts = ((m, eccentricity_px(m, camera, radius, 1.0)) for m in self.models(scene, observations))
        return [adjust(replace(model, shift_px=shift), camera) for model, shift in shifts]

    def calibrate(self, scene: Scene, noise_px: float, seed: int, solve: str = "joint"):
        """Chain or joint calibration from labels; returns (CalibratedTarget, JointResult or None)."""
        target, board, camera = scene.target, scene.board, scene.camera
        models = self.adjusted(scene, self.observations(scene, noise_px, np.random.default_rng(seed)))
        scales, faces = {m.group: find_scale(m, board).mm_per_unit for m in models}, []
        for model in models:
            faces += faces_of_group(model.metric(Similarity(scales[model.group], Rigid())), camera, target, "plane")[0]
        chained = chain_faces(faces, target, target.faces[0].id)
        if solve == "chain":
            return chained, None
        metric = [
            m.metric(Similarity(1.0, chained.target_from_group[m.group]) @ Similarity(scales[m.group], Rigid()))
            for m in models
        ]
        joint = adjusted(metric, board, camera).result()
        return calibrated_target(joint, chained, target, "plane"), joint


@pytest.fixture(scope="session")
def labels_only():
    return LabelsOnly()
