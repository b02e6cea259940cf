"""Whether the covariance of ``stcal robot identify`` is true: simulated arms as they leave the factory, each with a
placement, a tool and measurements of its own.

.venv/bin/python scripts/studies/identify_study.py [--draws 200]

Prints for every case two normalised squared errors, eᵀC⁻¹e over its degrees of freedom, mean over the draws with its
standard error; their expectation is 1. ``predicted`` : of the tool's position at 50 new joint vectors (where distances
were measured, of its distance from the first of them); ``parameters`` : of all that the data determine. In the
bottom lines one measurement in twenty is off by 2 mm.
"""

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.parallel import one_thread
from stcal.robot.identify.residuals import Observed, State, jacobian, observed, residuals, tips
from stcal.robot.identify.result import Identified, IdentifyOptions
from stcal.robot.identify.solve import identify
from stcal.robot.kinematics.example import mh80
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot
from stcal.synthetic.measured.arms import joint_vectors, made, measured, placed
from stcal.workflows.cluster import executor_of

SIGMA_MM, SIGMA_RAD = 0.05, 2e-4
NEW_POSES = 50
OUTLIERS, OUTLIER_MM = 0.05, 2.0


@dataclass(frozen=True)
class Case:
    """``kind`` : what is measured; ``sigma`` : ``estimated``, ``given``, or ``own`` of each pose; ``used`` : kind of
    observation made of it, None for itself."""

    kind: str
    rows: int
    sigma: str = "estimated"
    used: str | None = None
    outliers: bool = False

    def title(self) -> str:
        what = f"{self.used}s of {self.kind}s" if self.used else f"{self.kind}s"
        return what + (", outliers" if self.outliers else "")


ROWS = (30, 60, 200)
CASES = (  # one σ given is a weight like any other: positions and distances come out the same with it
    *(Case("pose", n, s) for s in ("estimated", "given", "own") for n in ROWS),
    *(Case("position", n) for n in ROWS),
    *(Case("pose", n, "own", "position") for n in ROWS),
    *(Case("distance", n) for n in ROWS),
    Case("position", 30, used="distance"),
    *(Case(kind, 60, outliers=True) for kind in ("pose", "position")),
)


def simulated(case: Case, seed: int) -> tuple[Robot, Measurements]:
    """An arm as made, somewhere, with a tool of its own; and what was measured of it."""
    rng = np.random.default_rng([CASES.index(case), seed])
    tool = Rigid.exp(rng.normal(0, 0.5, 6) * [1, 1, 1, 200, 200, 200])
    true = placed(made(mh80(), rng), Rigid.exp(rng.normal(0, 1, 6) * [1, 1, 1, 1000, 1000, 1000]), {"": tool})
    q = joint_vectors(true, case.rows, rng)
    if case.kind == "distance":
        return true, distances(true, q, rng)
    data = measured(
        true, q, rng, SIGMA_MM, SIGMA_RAD, covariance=own_covariances(rng, q) if case.sigma == "own" else None
    )
    if case.outliers:
        bad = rng.choice(len(q), round(OUTLIERS * len(q)), replace=False)
        away = np.zeros((len(q), 3))
        away[bad] = rng.normal(0, 1, (len(bad), 3))
        away[bad] *= OUTLIER_MM / np.linalg.norm(away[bad], axis=1)[:, None]
        data = replace(data, positions=data.positions + away)
    return true, data if case.kind == "pose" else replace(data, rotations=None)


def own_covariances(rng: np.random.Generator, q: np.ndarray) -> np.ndarray:
    """(m, 6, 6) between a quarter and four times the usual variance, in a direction of its own each."""
    turn = np.linalg.qr(rng.normal(size=(len(q), 6, 6)))[0]
    shape = (turn * np.exp(rng.uniform(-1.4, 1.4, (len(q), 1, 6)))) @ np.swapaxes(turn, 1, 2)
    sigma = np.repeat([SIGMA_RAD, SIGMA_MM], 3)
    return shape * sigma[:, None] * sigma


def distances(true: Robot, q: np.ndarray, rng: np.random.Generator) -> Measurements:
    """Of every position from one of the first four (of these, from the first), as a telescopic bar gives them."""
    tip = tips(State(true.chain(), dict(true.tools)), q, ("",) * len(q)).translation
    start = np.where(np.arange(len(q)) < 4, 0, np.arange(len(q)) % 4)
    length = np.linalg.norm(tip - tip[start], axis=1) + rng.normal(0, SIGMA_MM, len(q)) * (start != np.arange(len(q)))
    return Measurements("simulated", range(2, len(q) + 2), q, ("",) * len(q), distances=length, from_row=start)


def errors(case: Case, seed: int) -> tuple[float, float]:
    """Normalised squared errors of predicted positions (or distances), and of the parameters."""
    true, data = simulated(case, seed)
    sigma = (SIGMA_MM, SIGMA_RAD if case.kind == "pose" else None) if case.sigma == "given" else (None, None)
    found = identify(mh80(), data, IdentifyOptions(case.used, *sigma, folds=0))
    rng = np.random.default_rng([seed])
    return predicted(found, true, rng), parameters(found, true, rng)


def predicted(found: Identified, true: Robot, rng: np.random.Generator) -> float:
    """Mean of eᵀC⁻¹e over its width at new joint vectors."""
    exact = without_noise(true, joint_vectors(true, NEW_POSES, rng), found.seen.used)
    error = residuals(found.state, exact)[:, -3:]
    slope = jacobian(found.state, exact)[:, -3:]
    covariance = slope @ found.covariance @ np.swapaxes(slope, 1, 2)
    return float(np.mean(np.einsum("ri,rij,rj->r", error, np.linalg.inv(covariance), error))) / error.shape[1]


def parameters(found: Identified, true: Robot, rng: np.random.Generator) -> float:
    """eᵀC⁻¹e over the degrees of freedom, e being the errors of all combinations of parameters that such observations
    tell, from what they tell of the true arm."""
    exact = without_noise(true, joint_vectors(true, 200, rng), found.seen.kind)
    slope, sigma = jacobian(found.state, exact), np.maximum(np.sqrt(np.diag(found.covariance)), 1e-12)
    freedom = len(sigma) - 6 * (found.seen.kind == "distance")
    u, s, vt = np.linalg.svd(slope.reshape(-1, len(sigma)) * sigma, full_matrices=False)
    error = u[:, :freedom].T @ residuals(found.state, exact).ravel() / s[:freedom]
    covariance = vt[:freedom] @ (found.covariance / sigma[:, None] / sigma) @ vt[:freedom].T
    return float(error @ np.linalg.solve(covariance, error)) / freedom


def without_noise(true: Robot, q: np.ndarray, kind: str) -> Observed:
    """What a perfect instrument sees."""
    tip = tips(State(true.chain(), dict(true.tools)), q, ("",) * len(q))
    data = Measurements("", range(len(q)), q, ("",) * len(q), tip.translation, tip.rotation)
    if kind != "distance":
        return observed(data, kind)
    apart = np.linalg.norm(tip.translation - tip.translation[0], axis=1)
    start = np.zeros(len(q), int)
    return observed(replace(data, positions=None, rotations=None, distances=apart, from_row=start))


@one_thread()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="hand the trials to this Dask cluster")
    given = parser.parse_args()
    draws = given.draws
    began = time.perf_counter()
    print(f"simulated arms, {draws} draws: eᵀC⁻¹e over its degrees of freedom, expected 1")
    print(f"{'measured':<24}{'rows':>6}  {'σ':<12}{'predicted':>18}{'parameters':>18}")
    with executor_of(given.scheduler) as pool:
        for case in CASES:
            found = np.array(list(pool.map(errors, [case] * draws, range(draws), chunksize=10)))
            cells = "".join(
                f"{m:12.3f} ±{s:.3f}" for m, s in zip(found.mean(0), found.std(0) / draws**0.5, strict=True)
            )
            print(f"{case.title():<24}{case.rows:>6}  {case.sigma:<12}{cells}", flush=True)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
