"""What wrong rows do to ``stcal robot identify``: simulated arms as they leave the factory, some rows of few off.

.venv/bin/python scripts/studies/wrong_rows_study.py [--draws 200] [--only TEXT]

Each line is a kind of observation, a number of rows, the share of them that is off, and by how much (in a random
direction; 1–50 mm: uniform). ``within 1.1`` : draws in which positions at 50 new joint vectors err by at most 1.1 times
what they do by the good rows alone, these known; ``worst`` of that ratio; ``named`` : draws in which each wrong row is
among the outliers; ``called wrong`` : good rows that are, of all draws.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scripts.runner import executor_of, head, row, script
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import Identified, IdentifyOptions
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed

NEW_POSES = 50
MIXED = (1.0, 50.0)


@dataclass(frozen=True)
class Case:
    """``kind`` of observations, ``rows`` of which ``share`` are off by ``off_mm``, or uniformly between two."""

    kind: str
    rows: int
    share: float
    off_mm: float | tuple[float, float]

    def title(self) -> str:
        """First cells of its line."""
        off = f"{self.off_mm:g}" if isinstance(self.off_mm, float) else "–".join(f"{each:g}" for each in self.off_mm)
        return f"{self.kind} | {self.rows} | {self.share:.0%} | {off if self.share else '–'}"


CASES = (
    *(Case(kind, 40, 0.0, 0.0) for kind in ("position", "pose")),
    *(Case("position", 40, 0.05, off) for off in (2.0, 10.0)),
    *(Case("position", 40, 0.1, off) for off in (1.0, 5.0, 50.0)),
    *(Case("position", 40, 0.25, off) for off in (1.0, 2.0, 5.0, 10.0, 50.0, MIXED)),
    *(Case("pose", 40, 0.25, off) for off in (1.0, MIXED)),
    *(Case("distance", 60, share, MIXED) for share in (0.0, 0.15)),
    Case("position", 300, 0.25, MIXED),
)


def simulated(case: Case, seed: int) -> tuple[Robot, Measurements, np.ndarray]:
    """An arm as made, somewhere, with a tool of its own; what was measured of it; and which rows are wrong."""
    rng = np.random.default_rng([CASES.index(case), seed])
    tool = Rigid.exp(rng.normal(0, 0.5, 6) * [1, 1, 1, 200, 200, 200])
    true = placed(made(mh80(), rng), Rigid.exp(rng.normal(0, 1, 6) * [1, 1, 1, 1000, 1000, 1000]), {"": tool})
    data = measured(true, joint_vectors(true, case.rows, rng), rng)
    bad = np.sort(rng.choice(np.arange(1, case.rows), round(case.share * case.rows), replace=False))
    span = case.off_mm if isinstance(case.off_mm, tuple) else (case.off_mm, case.off_mm)
    size = rng.uniform(*span, (len(bad), 1))
    if case.kind == "distance":
        length = np.linalg.norm(data.points() - data.points()[0], axis=1)
        length[bad] += rng.choice([-1, 1], len(bad)) * size[:, 0]
        start = np.zeros(case.rows, int)
        return true, replace(data, positions=None, rotations=None, distances=length, from_row=start), bad
    away = rng.normal(0, 1, (len(bad), 3))
    positions = np.array(data.points())
    positions[bad] += size * away / np.linalg.norm(away, axis=1)[:, None]
    return true, replace(data, positions=positions, rotations=data.rotations if case.kind == "pose" else None), bad


def draw(case: Case, seed: int) -> tuple[float, bool, int]:
    """Ratio of the errors, whether each wrong row was named, and how many good ones were."""
    true, data, bad = simulated(case, seed)
    found = identify(mh80(), data, IdentifyOptions(folds=0))
    good = identify(mh80(), without(data, bad), IdentifyOptions(folds=0, robust=False))
    ratio = error(found, true, seed) / error(good, true, seed)
    named = {int(max(found.seen.first[row], found.seen.second[row])) for row, _ in found.outliers()}
    return ratio, set(bad.tolist()) <= named, len(named - set(bad.tolist()))


def without(data: Measurements, bad: np.ndarray) -> Measurements:
    """The other rows; of distances all are from the first, which is good."""
    kept = np.setdiff1d(np.arange(len(data)), bad)
    if data.distances is None:
        return data[kept]
    part = {"distances": data.distances[kept], "from_row": np.zeros(len(kept), int)}
    return Measurements(data.where, [data.lines[i] for i in kept], data.q[kept], ("",) * len(kept), **part)


def error(found: Identified, true: Robot, seed: int) -> float:
    """RMS error of positions (of distances from the first, where these were measured) at new joint vectors, mm."""
    q = joint_vectors(true, NEW_POSES, np.random.default_rng([seed]))
    tip = State(true.chain(), dict(true.tools)).tips(q, ("",) * len(q)).translation
    exact = Measurements("", range(len(q)), q, ("",) * len(q), tip)
    if found.seen.kind == "distance":
        apart, start = np.linalg.norm(tip - tip[0], axis=1), np.zeros(len(q), int)
        exact = replace(exact, positions=None, distances=apart, from_row=start)
    kind = "distance" if found.seen.kind == "distance" else "position"
    return float(np.sqrt((found.state.residuals(observed(exact, kind)) ** 2).sum(1).mean()))


@script(draws=200, only="", scheduler=str, limited=True)
def main(arguments) -> None:
    print(f"{arguments.draws} draws each, simulated\n")
    head("observed", "rows", "wrong", "by, mm", "within 1.1", "worst", "named", "called wrong")
    with executor_of(arguments.scheduler) as pool:
        for case in (each for each in CASES if each.title().startswith(arguments.only)):
            found = list(pool.map(partial(draw, case), range(arguments.draws), chunksize=5))
            ratio = np.array([each[0] for each in found])
            named, wrong = (sum(each[k] for each in found) for k in (1, 2))
            called = f"{wrong} of {len(found) * case.rows}"
            row(case.title(), (ratio <= 1.1).sum(), f"{ratio.max():.2f}", named, called)
