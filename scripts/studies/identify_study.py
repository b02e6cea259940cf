"""Whether the covariance of ``stcal robot identify`` is true: simulated arms as they leave the factory, each with a
placement, a tool and measurements of its own.

.venv/bin/python scripts/studies/identify_study.py [--draws 200] [--only TEXT]

Prints for every case two normalised squared errors, eᵀC⁻¹e over its degrees of freedom, mean over the draws with its
standard error; their expectation is 1. ``predicted`` : of the tool's position at 50 new joint vectors (where distances
were measured, of its distance from the first of them); ``parameters`` : of all that the data determine. Among the
last lines are sets with one measurement in twenty off by 2 mm; positions at one orientation, of which new ones are
predicted too (``partial``; the robot file has the tool to 5 mm); rows of an instrument that stood at two places; and a
robot with two arms on a torso and three markers.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from scripts.runner import executor_of, script
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.identification.adjustment import Observed, State, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import Identified, IdentifyOptions
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.support.arms import MARKERS, two_arms

SIGMA_MM, SIGMA_RAD = 0.05, 2e-4
NEW_POSES = 50
DOWN = Rigid.exp([0, np.pi * 0.9, 0, 0, 0, 0]).rotation
MOVED = Rigid.exp([0.2, -0.1, 1.5, 4000, -3000, 200])
"""second_from_first station."""
OUTLIERS, OUTLIER_MM = 0.05, 2.0


@dataclass(frozen=True)
class Case:
    """``kind`` : what is measured; ``sigma`` : ``estimated``, ``given``, or ``own`` of each pose; ``used`` : kind of
    observation made of it, None for itself; ``which`` : arm or rows, where they are not the usual ones."""

    kind: str
    rows: int
    sigma: str = "estimated"
    used: str | None = None
    outliers: bool = False
    which: str = ""

    def title(self) -> str:
        what = f"{self.used}s of {self.kind}s" if self.used else f"{self.kind}s"
        return ", ".join([what, *(["outliers"] if self.outliers else []), *([self.which] if self.which else [])])

    def nominal(self, true: Robot) -> Robot:
        """As drawn; with the tool to some millimetres where the data do not show it."""
        if self.which == ONE_ORIENTATION:
            return replace(mh80(), tools={"": true.tool() @ Rigid.exp([0, 0, 0, 3, -3, 3])})
        return two_arms() if self.which == TREE else mh80()


ONE_ORIENTATION, STATIONS, TREE = "one orientation", "two stations", "two arms"
ROWS = (30, 60, 200)
CASES = (  # one σ given is a weight like any other: positions and distances come out the same with it
    *(Case("pose", n, s) for s in ("estimated", "given", "own") for n in ROWS),
    *(Case("position", n) for n in ROWS),
    *(Case("pose", n, "own", "position") for n in ROWS),
    *(Case("distance", n) for n in ROWS),
    Case("position", 30, used="distance"),
    *(Case(kind, 60, outliers=True) for kind in ("pose", "position")),
    *(Case("position", n, which=ONE_ORIENTATION) for n in ROWS[1:]),
    *(Case(kind, 60, which=STATIONS) for kind in ("pose", "position")),
    *(Case(kind, n, which=TREE) for kind, n in (("pose", 120), ("position", 200))),
)


def simulated(case: Case, seed: int) -> tuple[Robot, Measurements]:
    """An arm as made, somewhere, with a tool of its own; and what was measured of it."""
    rng = np.random.default_rng([CASES.index(case), seed])
    if case.which == TREE:
        true = made(two_arms(), rng)
    else:
        tool = Rigid.exp(rng.normal(0, 0.5, 6) * [1, 1, 1, 200, 200, 200])
        true = placed(made(mh80(), rng), Rigid.exp(rng.normal(0, 1, 6) * [1, 1, 1, 1000, 1000, 1000]), {"": tool})
    q, targets = drawn(case, case.rows, rng)
    if case.kind == "distance":
        return true, distances(true, q, rng)
    own = own_covariances(rng, q) if case.sigma == "own" else None
    data = measured(true, q, rng, SIGMA_MM, SIGMA_RAD, targets, own)
    if case.outliers:
        bad = rng.choice(len(q), round(OUTLIERS * len(q)), replace=False)
        away = np.zeros((len(q), 3))
        away[bad] = rng.normal(0, 1, (len(bad), 3))
        away[bad] *= OUTLIER_MM / np.linalg.norm(away[bad], axis=1)[:, None]
        data = replace(data, positions=data.positions + away)
    if case.which == STATIONS:
        data = in_stations(data)
    return true, data if case.kind == "pose" else replace(data, rotations=None)


def drawn(case: Case, count: int, rng: np.random.Generator) -> tuple[np.ndarray, tuple[str, ...]]:
    """(count, n) joint vectors of the case, and the tool of each."""
    if case.which == ONE_ORIENTATION:
        places = rng.uniform([900.0, -500.0, 500.0], [1500.0, 500.0, 1000.0], (count, 3))
        return inverse(mh80(), Poses(np.tile(DOWN, (count, 1, 1)), places)).q, ("",) * count
    names = MARKERS if case.which == TREE else ("",)
    return joint_vectors(two_arms() if case.which == TREE else mh80(), count, rng), (names * count)[:count]


def in_stations(data: Measurements) -> Measurements:
    """Every third row as the instrument sees it from another place."""
    second = np.arange(len(data)) % 3 == 1
    there = MOVED @ data.poses()
    positions = np.where(second[:, None], there.translation, data.points())
    rotations = np.where(second[:, None, None], there.rotation, data.poses().rotation)
    names = tuple(np.where(second, "B", "A").tolist())
    return replace(data, positions=positions, rotations=rotations, stations=names)


def own_covariances(rng: np.random.Generator, q: np.ndarray) -> np.ndarray:
    """(m, 6, 6) between a quarter and four times the usual variance, in a direction of its own each."""
    turn = np.linalg.qr(rng.normal(size=(len(q), 6, 6)))[0]
    shape = (turn * np.exp(rng.uniform(-1.4, 1.4, (len(q), 1, 6)))) @ np.swapaxes(turn, 1, 2)
    sigma = np.repeat([SIGMA_RAD, SIGMA_MM], 3)
    return shape * sigma[:, None] * sigma


def distances(true: Robot, q: np.ndarray, rng: np.random.Generator) -> Measurements:
    """Of every position from one of the first four (of these, from the first), as a telescopic bar gives them."""
    tip = State(true.chain(), dict(true.tools)).tips(q, ("",) * len(q)).translation
    start = np.where(np.arange(len(q)) < 4, 0, np.arange(len(q)) % 4)
    length = np.linalg.norm(tip - tip[start], axis=1) + rng.normal(0, SIGMA_MM, len(q)) * (start != np.arange(len(q)))
    return Measurements("simulated", range(2, len(q) + 2), q, ("",) * len(q), distances=length, from_row=start)


def errors(case: Case, seed: int) -> tuple[float, float]:
    """Normalised squared errors of predicted positions (or distances), and of the parameters."""
    true, data = simulated(case, seed)
    sigma = (SIGMA_MM, SIGMA_RAD if case.kind == "pose" else None) if case.sigma == "given" else (None, None)
    options = IdentifyOptions(case.used, *sigma, folds=0, partial=case.which == ONE_ORIENTATION)
    found = identify(case.nominal(true), data, options)
    rng = np.random.default_rng([seed])
    return predicted(case, found, true, rng), parameters(case, found, true, rng)


def predicted(case: Case, found: Identified, true: Robot, rng: np.random.Generator) -> float:
    """Mean of eᵀC⁻¹e over its width at new joint vectors."""
    exact = without_noise(case, true, NEW_POSES, rng, found.seen.used)
    error = found.state.residuals(exact)[:, -3:]
    slope = found.state.jacobian(exact)[:, -3:]
    covariance = slope @ found.covariance @ np.swapaxes(slope, 1, 2)
    return float(np.mean(np.einsum("ri,rij,rj->r", error, np.linalg.inv(covariance), error))) / error.shape[1]


def parameters(case: Case, found: Identified, true: Robot, rng: np.random.Generator) -> float:
    """eᵀC⁻¹e over the degrees of freedom, e being the errors of all combinations of parameters that such observations
    tell, from what they tell of the true arm."""
    exact = without_noise(case, true, 200, rng, found.seen.kind)
    slope, sigma = found.state.jacobian(exact), np.maximum(np.sqrt(np.diag(found.covariance)), 1e-12)
    freedom = len(sigma) - 6 * (found.seen.kind == "distance") - len(found.undetermined)
    u, s, vt = np.linalg.svd(slope.reshape(-1, len(sigma)) * sigma, full_matrices=False)
    error = u[:, :freedom].T @ found.state.residuals(exact).ravel() / s[:freedom]
    covariance = vt[:freedom] @ (found.covariance / sigma[:, None] / sigma) @ vt[:freedom].T
    return float(error @ np.linalg.solve(covariance, error)) / freedom


def without_noise(case: Case, true: Robot, count: int, rng: np.random.Generator, kind: str) -> Observed:
    """What a perfect instrument sees at new joint vectors."""
    q, targets = drawn(case, count, rng)
    tip = State(true.chain(), dict(true.tools)).tips(q, targets)
    data = Measurements("", range(len(q)), q, targets, tip.translation, tip.rotation)
    if kind != "distance":
        return observed(in_stations(data) if case.which == STATIONS else data, kind)
    apart = np.linalg.norm(tip.translation - tip.translation[0], axis=1)
    start = np.zeros(len(q), int)
    return observed(replace(data, positions=None, rotations=None, distances=apart, from_row=start))


@script(draws=200, only="", scheduler=str, limited=True)
def main(given) -> None:
    draws = given.draws
    began = time.perf_counter()
    print(f"simulated arms, {draws} draws: eᵀC⁻¹e over its degrees of freedom, expected 1")
    print(f"{'measured':<28}{'rows':>6}  {'σ':<12}{'predicted':>18}{'parameters':>18}")
    with executor_of(given.scheduler) as pool:
        for case in (each for each in CASES if given.only in each.title()):
            found = np.array(list(pool.map(errors, [case] * draws, range(draws), chunksize=10)))
            cells = "".join(
                f"{m:12.3f} ±{s:.3f}" for m, s in zip(found.mean(0), found.std(0) / draws**0.5, strict=True)
            )
            print(f"{case.title():<28}{case.rows:>6}  {case.sigma:<12}{cells}", flush=True)
    print(f"{time.perf_counter() - began:.0f} s")
