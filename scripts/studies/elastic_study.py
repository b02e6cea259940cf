"""Elastic arms in ``stcal robot identify``: simulated arms as they leave the factory, measured over their ranges.

.venv/bin/python scripts/studies/elastic_study.py [--draws 200] [--only TEXT]

Each line is a kind of observation, a number of rows, and by how much links give way and gears err, in usual σ (0.017°
at the usual torque about the axes, 0.006° across them, 0.006° of the gears). ``elastic taken`` : draws in which
``auto`` did. RMS errors of positions at 50 new joint vectors, mm: ``rigid`` and ``elastic`` identified, and of
``auto``. ``bound`` : RMS error of the elastic one over what the noise and these σ allow the best estimate (posterior
covariance at the true arm, σ known). ``NEES`` : mean square of its errors over their predicted σ, ± standard error of
the draws; 1 is expected.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scripts.runner import executor_of, head, row, script
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State, observed, parameter_units
from stcal.robot.identification.identify import identify
from stcal.robot.identification.prior import Deviations, NominalRows
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.support.arms import elastic

NEW_POSES = 50
SIGMA_MM, SIGMA_RAD = 0.05, 2e-4
MADE = Deviations(length_mm=0.3, twist_rad=5e-4, zero_rad=7e-4)
"""About what :func:`made` does to dimensions."""
TARGETS = ("",) * NEW_POSES


@dataclass(frozen=True)
class Case:
    """``kind`` of observations, ``rows``, and ``share`` of usual elasticity."""

    kind: str
    rows: int
    share: float

    def title(self) -> str:
        """First cells of its line."""
        return f"{self.kind} | {self.rows} | {self.share:g}"


CASES = (
    *(Case("position", rows, share) for share in (0.0, 0.5, 1.0, 3.0) for rows in (50, 100)),
    *(Case("pose", 50, share) for share in (0.0, 1.0)),
)


def draw(case: Case, seed: int) -> tuple[bool, np.ndarray, float]:
    """Whether ``auto`` took the elastic one; mean squares of errors, mm², by rigid, elastic, auto and what is possible;
    and of errors over σ, by the elastic one."""
    rng = np.random.default_rng([CASES.index(case), seed])
    tool = Rigid.exp(rng.normal(0, 0.5, 6) * [1, 1, 1, 200, 200, 200])
    true = placed(made(mh80(), rng), Rigid.exp(rng.normal(0, 1, 6) * [1, 1, 1, 1000, 1000, 1000]), {"": tool})
    if case.share:
        true = elastic(true, rng, case.share)
    data = measured(true, joint_vectors(true, case.rows, rng), rng, SIGMA_MM, SIGMA_RAD)
    if case.kind == "position":
        data = replace(data, rotations=None)
    q = joint_vectors(true, NEW_POSES, rng)
    found = {model: identify(mh80(), data, IdentifyOptions(model=model, folds=0)) for model in ("rigid", "elastic")}
    found["auto"] = identify(mh80(), data, IdentifyOptions(model="auto", repeats=1))
    real = State(true.chain(), dict(true.tools)).tips(q, TARGETS).translation
    off = {model: each.state.tips(q, TARGETS).translation - real for model, each in found.items()}
    squares = [(each**2).sum(1).mean() for each in off.values()]
    best = found["elastic"]
    place = best.state.tip_jacobian(q, TARGETS, best.seen.kind)[1][:, 3:]
    variances = np.einsum("rik,kl,ril->ri", place, best.adjustment.spread.covariance(), place)
    squares.append(possible(true, data, case, q))
    return found["auto"].model == "elastic", np.array(squares), (off["elastic"] ** 2 / variances).mean()


def possible(true: Robot, data: Measurements, case: Case, q: np.ndarray) -> float:
    """Mean square error, mm², of the best estimate: σ known, linear about the true arm."""
    state = State(true.chain(), dict(true.tools), elastic=bool(case.share))
    seen = observed(data)
    derivative = state.jacobian(seen)
    rows = NominalRows.about(state, parameter_units(derivative), mh80(), carried=data.conditions.loaded)
    usual = Deviations()
    known = replace(
        MADE,
        axis_rad=case.share * usual.axis_rad,
        across_rad=case.share * usual.across_rad,
        periodic_rad=case.share * usual.periodic_rad,
    )
    sigma = np.repeat([SIGMA_RAD, SIGMA_MM], 3)[-derivative.shape[1] :]
    white = (derivative / sigma[:, None]).reshape(-1, derivative.shape[2])
    _, held, _ = rows.held(state, known, seen.kind)
    normal = white.T @ white + held.T @ held
    units = 1 / np.sqrt(np.diag(normal))  # by what is seen and held of each: moments span ten decades of others
    covariance = np.linalg.pinv(normal * units[:, None] * units, hermitian=True) * units[:, None] * units
    place = state.tip_jacobian(q, TARGETS, seen.kind)[1][:, 3:]
    return float(np.einsum("rik,kl,ril->r", place, covariance, place).mean())


@script(draws=200, only="", scheduler=str, limited=True)
def main(arguments) -> None:
    print(f"{arguments.draws} draws each, simulated\n")
    head("observed", "rows", "usual σ ×", "elastic taken", "rigid, mm", "elastic, mm", "auto, mm", "bound", "NEES")
    with executor_of(arguments.scheduler) as pool:
        for case in (each for each in CASES if each.title().startswith(arguments.only)):
            taken, squares, normal = zip(*pool.map(partial(draw, case), range(arguments.draws)), strict=True)
            rms = np.sqrt(np.mean(squares, axis=0))
            figures = (f"{value:.3f}" for value in rms[:-1])
            nees = f"{np.mean(normal):.2f} ± {np.std(normal) / np.sqrt(len(normal)):.2f}"
            row(case.title(), sum(taken), *figures, f"{rms[1] / rms[-1]:.2f}", nees)
