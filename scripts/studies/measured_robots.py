"""Held-out errors of a measured arm, by what is observed of it: 30 poses of a Rokae arm by a laser tracker.

.venv/bin/python scripts/studies/measured_robots.py [--seeds 5]

Each row is held out once in each division into six parts, of which there are five for each seed. Mean errors of
positions, mm: mean over the seeds, and least and most of them.
"""

import tempfile
from pathlib import Path

import numpy as np
from same_results import prepare

from scripts.runner import head, row, script
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.measurements import read_measurements
from stcal.robot.kinematics.robot_file import load_robot


@script(seeds=5)
def main(given) -> None:
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder))
        robot = load_robot(Path(folder) / "rokae.toml")
        data = read_measurements(Path(folder) / "rokae.csv", robot)
    print(f"rokae_tracker: {len(data)} poses\n")
    head("observed", "model", "mean of seeds, mm", "least", "most", "elastic taken")
    for observe in ("pose", "position"):
        for model in ("rigid", "auto"):
            found = [
                identify(robot, data, IdentifyOptions(observe, seed=seed, model=model)) for seed in range(given.seeds)
            ]
            mean = np.array([np.nanmean(each.held_out.position_mm) for each in found if each.held_out is not None])
            taken = sum(each.model == "elastic" for each in found)
            figures = (f"{value:.4f}" for value in (mean.mean(), mean.min(), mean.max()))
            row(observe, model, *figures, f"{taken} of {len(found)}")
