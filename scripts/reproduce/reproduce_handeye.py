"""The experiment of Jin et al. (hand-eye calibration by differential evolution) in simulation, by all methods.

.venv/bin/python scripts/reproduce/reproduce_handeye.py [--seeds 100]

A camera of 1280×1024 px on the flange of an arm of a UR10's reach sees a chessboard of 8×7 squares of 25 mm from 25
poses: 24 motions A_N, B_N from each pose to the next, 18 to solve with and 6 held out. Corners err by 0.1 px, the arm
by 0.1 mm and 0.3 mrad (σ of a coordinate); nothing is real. DE runs as the paper has it: M = 30, F = 0.5, CR = 0.9, 100
generations, λ = 1 (lengths in metres), x = (log R_X, b_X), DE/rand/1/bin. The paper takes the bounds of the first
population from prior knowledge; what they were is not legible. Here: nothing known, ±180° and ± the farthest pose of
the flange about zero; what a drawing tells, the truth but for 10° and 30 mm; and the closed-form solution.

Prints, as Markdown, over all seeds: the objective that evolution reaches over its minimum, from each of the bounds,
without and with polishing; what λ = 1 means with lengths in m, cm and mm; the errors of the predicted
Â_N = X B_N X⁻¹ of the six motions (the paper's measure, eqs. 24–26), and of X itself against the truth.
"""

import numpy as np

from scripts.runner import executor_of, head, row, script
from stcal.errors import StcalError
from stcal.geometry.rigid import Rigid
from stcal.handeye import METHODS, motion_errors
from stcal.handeye.data.pose_pairs import Loop, Motions
from stcal.handeye.handeye_problem import UNIT_MM, HandEyeProblem
from stcal.handeye.methods.closed_form import Bounds, EvolutionOptions, Objective, evolve, polish
from tests.support.handeye import Truth, simulated_views

POSES, FITTED = 25, 18
ROBOT, CORNER_PX = (3e-4, 0.1), 0.1
KNOWN = np.radians(10.0), 30.0
"""By how much a drawing of the set-up is off, rad and mm."""
ABOUT_KNOWN = ((90.0, 200.0), (45.0, 100.0), (20.0, 50.0))
ABOUT_CLOSED_FORM = (10.0, 20.0)
"""Half widths of the bounds, degrees and mm."""
UNITS = {"m": 1000.0, "cm": 10.0, "mm": 1.0}
"""Lengths, mm, that weigh like one radian with λ = 1."""


def trial(seed: int) -> dict:
    """One seed: ``ratios`` of the objective, and by method ``motions`` (6, 2) mm and rad, and ``x`` (2,)."""
    truth = simulated_views(np.random.default_rng(seed), POSES, robot=ROBOT, corner_px=CORNER_PX)
    motions = Motions.consecutive(Loop.of(truth.pairs, truth.setup))
    kept = truth.pairs[: FITTED + 1], truth.views[: FITTED + 1]
    fitted = motions[:FITTED]
    fitted = fitted[fitted.has_log()]
    found = {"ratios": ratios(truth, fitted, seed), "units": by_unit(truth, fitted)}
    for method in METHODS:
        try:
            x = HandEyeProblem(kept[0], truth.setup, kept[1]).solved(method).result.flange_from_camera
        except StcalError as error:
            found[method] = str(error)
            continue
        off = truth.mount_from_camera.inverse() @ x
        own = (float(np.linalg.norm(off.translation)), off.angle_rad())
        found[method] = motion_errors(x, motions[FITTED:])[:, ::-1], own
    return found


def ratios(truth: Truth, motions: Motions, seed: int) -> dict[str, float]:
    """What evolution reaches over the minimum, by its bounds, without and with polishing."""
    objective, flange = Objective(motions, UNIT_MM, 1.0), truth.pairs.base_from_flange
    farthest = float(np.linalg.norm(flange.translation, axis=1).max())
    costs = {}
    closed = HandEyeProblem(truth.pairs[: FITTED + 1], truth.setup).solved("park-martin").result.flange_from_camera
    for name, options in bounds_of(truth, seed).items():
        x = evolve(objective, options, farthest, closed)
        costs[name] = objective.linear(x).cost
        costs[f"{name}, polished"] = objective.linear(polish(objective, x)).cost
    # The minimum is that next to the truth, unless evolution finds a better one.
    least = min(objective.linear(polish(objective, truth.mount_from_camera)).cost, *costs.values())
    return {name: cost / least for name, cost in costs.items()}


def bounds_of(truth: Truth, seed: int) -> dict[str, EvolutionOptions]:
    """Where the first population lies, by name."""
    rng = np.random.default_rng([seed, 1])
    way = rng.normal(size=(2, 3))
    turn, shift = np.array(KNOWN)[:, None] * way / np.linalg.norm(way, axis=1, keepdims=True)
    known = Rigid.exp([*turn, 0, 0, 0]).rotation @ truth.mount_from_camera.rotation
    centre = Rigid(known, truth.mount_from_camera.translation + shift).log()
    found = {"nothing known: ±180°, the farthest pose": EvolutionOptions(seed=seed)}
    for deg, mm in ABOUT_KNOWN:
        bounds = Bounds(np.radians(deg), tuple(centre[:3])), Bounds(mm, tuple(centre[3:]))
        options = EvolutionOptions(bounds_rad=bounds[0], bounds_mm=bounds[1], seed=seed)
        found[f"about the drawing: ±{deg:g}°, ±{mm:g} mm"] = options
    deg, mm = ABOUT_CLOSED_FORM
    options = EvolutionOptions(bounds_rad=Bounds(np.radians(deg), None), bounds_mm=Bounds(mm, None), seed=seed)
    return found | {f"about the closed form: ±{deg:g}°, ±{mm:g} mm": options}


def by_unit(truth: Truth, motions: Motions) -> dict[str, tuple[float, float]]:
    """Error of X at the minimum of the objective, mm and rad, by the unit of its lengths."""
    found = {}
    for name, unit_mm in UNITS.items():
        off = truth.mount_from_camera.inverse() @ polish(Objective(motions, unit_mm, 1.0), truth.mount_from_camera)
        found[name] = float(np.linalg.norm(off.translation)), off.angle_rad()
    return found


def print_tables(trials: list[dict]) -> None:
    """Markdown."""
    print("\nObjective that differential evolution reaches, over its minimum\n")
    head("first population", "median", "90 %", "worst", "below 1.001", "below 1.1")
    for name in trials[0]["ratios"]:
        values = np.array([each["ratios"][name] for each in trials])
        shares = (f"{(values < most).sum()} of {len(values)}" for most in (1.001, 1.1))
        row(name, f"{np.median(values):.6g}", f"{np.quantile(values, 0.9):.4g}", f"{values.max():.4g}", *shares)
    print("\nX at the minimum of the objective with λ = 1: median over all seeds (worst seed)\n")
    head("lengths in", "X, mm", "X, °")
    for name in UNITS:
        mm, rad = np.array([each["units"][name] for each in trials]).T
        row(name, *map(median_worst, (mm, np.degrees(rad))))
    print("\nHeld-out motions, and X itself: median over all seeds (worst seed)\n")
    head("method", "Â, mm", "Â, °", "X, mm", "X, °", "failed")
    for method in METHODS:
        good = [each[method] for each in trials if not isinstance(each[method], str)]
        motions, own = np.array([m.mean(0) for m, _ in good]), np.array([x for _, x in good])
        columns = [motions[:, 0], np.degrees(motions[:, 1]), own[:, 0], np.degrees(own[:, 1])]
        row(method, *map(median_worst, columns), len(trials) - len(good))


def median_worst(values: np.ndarray) -> str:
    return f"{np.median(values):.3f} ({values.max():.3g})"


@script(seeds=100, scheduler=str, limited=True)
def main(arguments) -> None:
    with executor_of(arguments.scheduler) as pool:
        trials = list(pool.map(trial, range(arguments.seeds)))
    print(f"{arguments.seeds} seeds, simulated; {FITTED} motions to solve with, {POSES - 1 - FITTED} held out")
    print_tables(trials)
