"""Elastic arms in ``stcal robot identify``: simulated arms as they leave the factory, measured over their ranges.

.venv/bin/python scripts/studies/elastic_study.py [--draws 200] [--only TEXT] [--payload | --trees | --approach]

Each line is a kind of observation, a number of rows, and by how much links give way and gears err, in usual σ (0.017°
at the usual torque about the axes, 0.006° across them, 0.006° of the gears). ``elastic taken`` : draws in which
``auto`` did. RMS errors of positions at 50 new joint vectors, mm: ``rigid`` and ``elastic`` identified, and of
``auto``. ``bound`` : RMS error of the elastic one over what the noise and these σ allow the best estimate (posterior
covariance at the true arm, σ known). ``NEES`` : mean square of its errors over their predicted σ, ± standard error of
the draws; 1 is expected.

``--payload`` : other rows carry other masses at the flange, and arms are heavier than usual by a factor of σ 0.5; new
joint vectors carry 0 … 100 kg. ``unknown`` : identified without the masses, and asked without; ``known``, ``bound``,
``NEES`` as above, with them. ``axis`` : the same of the compliances about the joints' axes.

``--trees`` : two arms on a torso, with three markers; columns as without.

``--approach`` : joints have a hysteresis too, of the same share of the usual 0.006°, and rows say from where they came;
so do the new joint vectors. Columns as without.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scripts.runner import executor_of, head, row, script
from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State, jacobian, observed, parameter_units, tip_jacobian, tips
from stcal.robot.identification.identify import identify
from stcal.robot.identification.prior import HEAVIER, Deviations, NominalRows
from stcal.robot.identification.result import Identified, IdentifyOptions
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import USUAL, Conditions, Robot, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.support.arms import MARKERS, elastic, two_arms

NEW_POSES = 50
SIGMA_MM, SIGMA_RAD = 0.05, 2e-4
MADE = Deviations(length_mm=0.3, twist_rad=5e-4, zero_rad=7e-4)
"""About what :func:`made` does to dimensions."""


@dataclass(frozen=True)
class Case:
    """``kind`` of observations, ``rows``, and ``share`` of usual elasticity; of a ``tree`` or an arm, whose joints come
    from either side where ``approach``."""

    kind: str
    rows: int
    share: float
    payloads: tuple[float, ...] = ()
    tree: bool = False
    approach: bool = False

    def title(self) -> str:
        """First cells of its line."""
        last = " and ".join(f"{mass:g}" for mass in self.payloads) or f"{self.share:g}"
        return f"{self.kind} | {self.rows} | {last}"

    def nominal(self) -> Robot:
        """As drawn."""
        return two_arms() if self.tree else mh80()

    def targets(self, count: int) -> tuple[str, ...]:
        """Of so many rows."""
        return ((MARKERS if self.tree else ("",)) * count)[:count]

    def came(self, rng: np.random.Generator, count: int) -> Conditions:
        """Of so many joint vectors."""
        return Conditions(approach=rng.choice([-1.0, 1.0], (count, 6))) if self.approach else USUAL

    def made(self, rng: np.random.Generator) -> Robot:
        """As made, somewhere, with a tool of its own."""
        if self.tree:
            return made(two_arms(), rng)
        tool = Rigid.exp(rng.normal(0, 0.5, 6) * [1, 1, 1, 200, 200, 200])
        return placed(made(mh80(), rng), Rigid.exp(rng.normal(0, 1, 6) * [1, 1, 1, 1000, 1000, 1000]), {"": tool})


CASES = (
    *(Case("position", rows, share) for share in (0.0, 0.5, 1.0, 3.0) for rows in (50, 100)),
    *(Case("pose", 50, share) for share in (0.0, 1.0)),
)
LOADED = (
    *(Case("position", rows, 1.0, masses) for masses in ((0, 60), (60,)) for rows in (60, 120)),
    Case("pose", 60, 1.0, (0, 60)),
)
TREES = tuple(Case(kind, 180, s, tree=True) for kind, s in (("position", 0.0), ("position", 1.0), ("pose", 1.0)))
LOOSE = tuple(Case("position", rows, share, approach=True) for share in (0.0, 1.0, 3.0) for rows in (50, 100))
SEEDS = {case: start + i for start, cases in ((0, CASES), (200, TREES), (300, LOOSE)) for i, case in enumerate(cases)}
MOST_KG = 100.0
"""That new joint vectors carry."""
CENTRE = np.array([20.0, -30.0, 150.0])
"""Of the payload, mm, in the flange's frame."""


def draw(case: Case, seed: int) -> tuple[bool, np.ndarray, np.ndarray]:
    """Whether ``auto`` took the elastic one; mean squares of errors, mm², by rigid, elastic, auto and what is possible;
    and of errors over σ, by the elastic one."""
    rng = np.random.default_rng([SEEDS[case], seed])
    true = case.made(rng)
    if case.share:
        true = elastic(true, rng, case.share)
    if case.approach and true.elasticity is not None:
        loose = rng.normal(0, case.share * Deviations().hysteresis_rad, 6)
        true = replace(true, elasticity=replace(true.elasticity, hysteresis=loose))
    rows, targets = joint_vectors(true, case.rows, rng), case.targets(case.rows)
    came = case.came(rng, case.rows)
    data = measured(true, rows, rng, SIGMA_MM, SIGMA_RAD, targets, conditions=came)
    if case.kind == "position":
        data = replace(data, rotations=None)
    q, there = joint_vectors(true, NEW_POSES, rng), case.came(rng, NEW_POSES)
    nominal = case.nominal()
    found = {model: identify(nominal, data, IdentifyOptions(model=model, folds=0)) for model in ("rigid", "elastic")}
    found["auto"] = identify(nominal, data, IdentifyOptions(model="auto", repeats=1))
    squares = [(errors(case, each, true, q, there) ** 2).sum(1).mean() for each in found.values()]
    least = possible(true, data, case, q, there)
    normal = errors(case, found["elastic"], true, q, there) ** 2 / variances(case, found["elastic"], q, there)
    return found["auto"].model == "elastic", np.array([*squares, least]), normal.mean()


def draw_loaded(case: Case, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares of errors, mm², without and with known masses, and of what is possible; and of errors over σ, of
    positions, and of the compliances about the axes."""
    rng = np.random.default_rng([100 + LOADED.index(case), seed])
    true = case.made(rng)
    true = elastic(true, rng, case.share, max(rng.normal(1, HEAVIER), 0.2))
    assert true.elasticity is not None
    true = replace(true, elasticity=replace(true.elasticity, payload_centre=CENTRE))
    nominal = replace(mh80(), elasticity=replace(true.elasticity, compliance=np.zeros((6, 2))))
    mass = np.resize(case.payloads, case.rows)
    data = measured(true, joint_vectors(true, case.rows, rng), rng, SIGMA_MM, SIGMA_RAD, conditions=Conditions(mass))
    if case.kind == "position":
        data = replace(data, rotations=None)
    q, carried = joint_vectors(true, NEW_POSES, rng), Conditions(rng.uniform(0, MOST_KG, NEW_POSES))
    options = IdentifyOptions(model="elastic", folds=0)
    known = identify(nominal, data, options)
    unknown = identify(nominal, replace(data, conditions=USUAL), options)
    off = errors(case, known, true, q, carried)
    squares = [(errors(case, unknown, true, q, carried, USUAL) ** 2).sum(1).mean(), (off**2).sum(1).mean()]
    found, sigma = known.robot.elasticity, known.elasticity_sigma
    assert found is not None
    assert sigma is not None
    axis = ((found.compliance - true.elasticity.compliance) / sigma.compliance)[:, 0] ** 2
    normal = [(off**2 / variances(case, known, q, carried)).mean(), axis.mean()]
    return np.array([*squares, possible(true, data, case, q, carried)]), np.array(normal)


def errors(
    case: Case,
    found: Identified,
    true: Robot,
    q: np.ndarray,
    carried: Conditions = USUAL,
    told: Conditions | None = None,
) -> np.ndarray:
    """(m, 3) of positions in the instrument's frame, mm; ``told`` : what is said to be carried, if not ``carried``."""
    really = tips(State(true.chain(), dict(true.tools)), q, case.targets(len(q)), carried)
    believed = carried if told is None else told
    return tips(found.state, q, case.targets(len(q)), believed).translation - really.translation


def variances(case: Case, found: Identified, q: np.ndarray, carried: Conditions = USUAL) -> np.ndarray:
    """(m, 3) by its covariance, mm²."""
    place = tip_jacobian(found.state, q, case.targets(len(q)), found.seen.kind, carried)[1][:, 3:]
    adjusted = found.adjustment
    covariance = adjusted.spread.covariance(np.zeros(len(adjusted.spread.least)))
    return np.einsum("rik,kl,ril->ri", place, covariance, place)


def possible(true: Robot, data: Measurements, case: Case, q: np.ndarray, carried: Conditions = USUAL) -> float:
    """Mean square error, mm², of the best estimate: σ known, linear about the true arm."""
    state = State(true.chain(), dict(true.tools), elastic=bool(case.share), hysteresis=case.approach)
    seen = observed(data)
    derivative = jacobian(state, seen)
    rows = NominalRows.about(state, parameter_units(derivative), case.nominal(), carried=data.conditions.loaded)
    usual = Deviations()
    known = replace(
        MADE,
        axis_rad=case.share * usual.axis_rad,
        across_rad=case.share * usual.across_rad,
        periodic_rad=case.share * usual.periodic_rad,
        hysteresis_rad=case.share * usual.hysteresis_rad,
    )
    sigma = np.repeat([SIGMA_RAD, SIGMA_MM], 3)[-derivative.shape[1] :]
    white = (derivative / sigma[:, None]).reshape(-1, derivative.shape[2])
    _, held, _ = rows.held(state, known, seen.kind)
    normal = white.T @ white + held.T @ held
    units = 1 / np.sqrt(np.diag(normal))  # by what is seen and held of each: moments span ten decades of others
    covariance = np.linalg.pinv(normal * units[:, None] * units, hermitian=True) * units[:, None] * units
    place = tip_jacobian(state, q, case.targets(len(q)), seen.kind, carried)[1][:, 3:]
    return float(np.einsum("rik,kl,ril->r", place, covariance, place).mean())


def nees(each: np.ndarray) -> str:
    """Of draws (d,)."""
    return f"{each.mean():.2f} ± {each.std() / np.sqrt(len(each)):.2f}"


@script(draws=200, only="", scheduler=str, payload=False, trees=False, approach=False, limited=True)
def main(arguments) -> None:
    print(f"{arguments.draws} draws each, simulated\n")
    if arguments.payload:
        head("observed", "rows", "payloads, kg", "unknown, mm", "known, mm", "bound", "NEES", "axis")
        cases, one = LOADED, draw_loaded
    else:
        rms = "rigid, mm", "elastic, mm", "auto, mm"
        head("observed", "rows", "usual σ ×", "elastic taken", *rms, "bound", "NEES")
        cases, one = TREES if arguments.trees else LOOSE if arguments.approach else CASES, draw
    with executor_of(arguments.scheduler) as pool:
        for case in (each for each in cases if each.title().startswith(arguments.only)):
            *taken, squares, normal = zip(*pool.map(partial(one, case), range(arguments.draws)), strict=True)
            rms = np.sqrt(np.mean(squares, axis=0))
            figures = (f"{value:.3f}" for value in rms[:-1])
            squared = np.transpose(np.reshape(normal, (arguments.draws, -1)))
            row(case.title(), *map(sum, taken), *figures, f"{rms[1] / rms[-1]:.2f}", *map(nees, squared))
