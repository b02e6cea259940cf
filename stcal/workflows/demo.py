"""A data set with known truth: rendered, calibrated, and compared with the truth, for ``stcal-sfm demo``."""

from functools import partial
from pathlib import Path

from stcal.parallel import Progress
from stcal.sfm.pipeline import run
from stcal.sfm.report.compare import CompareFile, compare
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.result import RunResult
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import SceneOptions, make_scene

OPTIONS = SceneOptions(seed=1, width=1728, height=1152, images_per_group=5)
WHAT = "simulated photographs of the reference target: 4 groups of 5 images, 1728×1152 px, at 1 m"


def demo(folder: Path, workers: int | None, progress: Progress) -> tuple[RunResult, CompareFile]:
    """Returns the run in ``folder/run`` of the data set in ``folder/data``, and its errors against the truth."""
    data = folder / "data"
    write_dataset(data, make_scene(OPTIONS), workers=workers, progress=partial(progress, "render"))
    files = data / "target.toml", data / "board.toml", RunOptions(workers=workers)
    result = run(data / "images", data / "cameras.txt", folder / "run", *files, progress)
    return result, compare(folder / "run", data / "truth.json")
