"""Whether ``stcal register`` tells of rows that are wrong together, by a few σ, on simulated points with known truth.

.venv/bin/python scripts/studies/two_groups_study.py [--trials 300] [--clean 500] [--only shifts clean]

n points in a cube of 200 mm, noise σ; a share of them is off by the same shift, or by a small turn about their middle.
An answer is wrong when its RMS error over the cube is above three times what its covariance states and above 1.5 times
that of the fit to the good rows; it is wrong in silence when no note names another group, a bend or another scale;
``clear`` are those of them with 100 rows or more, and wrong ones 4.5 σ off or more: of fewer or nearer ones data tell
little.

shifts
    By kind: the wrong rows anywhere (``anywhere``), in one half of the workspace (``one half``), shifted along an axis
    (``one axis``), a block of them turned (``turned``); sizes, σ, shift over σ and share drawn anew in each trial.
issue
    Shifts of 0.7 mm of 40 to 45 % of 100 rows, σ 0.15 mm.
clean
    Clean sets, and sets with 20 % of the rows off at random, of which the note is given all the same.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scripts.runner import script
from stcal.errors import DegenerateError
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.register import Registration, register
from stcal.register.consensus import MODELS, jacobian
from tests.support.point_pairs import cube, directions, make_scene, random_rigid

KINDS = ("anywhere", "one half", "one axis", "turned")
SIZES = (20, 30, 50, 100, 300)
SIGMAS_MM = (0.05, 0.15, 0.3)
SHIFTS_MM = (0.3, 0.7, 1.0, 2.0)
SHARES = (0.3, 0.35, 0.4, 0.45)
TIMES_SIGMA, TIMES_BEST = 3.0, 1.5
CLEAR_OFF, CLEAR_ROWS = 4.5, 100
"""From so many σ and rows on data tell that there are two groups; of less, often not."""
TOLD = ("another transform", "two groups", "bent", "lengths in b")
"""In notes that say so."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Points, the truth, the good rows, and how far the others are off, σ."""

    xyz_a: np.ndarray
    xyz_b: np.ndarray
    b_from_a: Rigid
    good: np.ndarray
    off: float = 0.0


def made(rng: np.random.Generator, kind: str, n: int, sigma_mm: float, shift_mm: float, share: float) -> Trial:
    """Points of which a ``share`` is wrong together."""
    truth, xyz_a = random_rigid(rng), cube(rng, n)
    xyz_b = truth @ xyz_a + rng.normal(0, sigma_mm, (n, 3))
    order = np.argsort(xyz_a[:, rng.integers(3)]) if kind in ("one half", "turned") else rng.permutation(n)
    wrong = order[: round(share * n)]
    if kind == "turned":  # as far off at the block's edge, about, as a shift
        middle = xyz_b[wrong].mean(0)
        turn = Rigid.exp([*(directions(rng, 1)[0] * shift_mm / 60), 0, 0, 0])
        xyz_b[wrong] = turn @ (xyz_b[wrong] - middle) + middle
    elif kind == "one axis":
        xyz_b[wrong, rng.integers(3)] += shift_mm
    else:
        xyz_b[wrong] += directions(rng, 1) * shift_mm
    good = np.ones(n, bool)
    good[wrong] = False
    return Trial(xyz_a, xyz_b, truth, good, shift_mm / sigma_mm)


def is_wrong(found: Registration, trial: Trial) -> bool:
    """Against what the covariance states over the cube, and against the fit to the good rows."""
    best = align_rigid(trial.xyz_b[trial.good], trial.xyz_a[trial.good])
    at = trial.xyz_a
    error, least = (np.sqrt(((t @ at - trial.b_from_a @ at) ** 2).sum(1).mean()) for t in (found.b_from_a, best))
    by_step = jacobian(MODELS["rigid"], found.b_from_a, at)
    stated = np.sqrt(np.einsum("nij,jk,nik->n", by_step, found.covariance, by_step).mean())
    return bool(error > TIMES_SIGMA * stated and error > TIMES_BEST * least)


def one_line(name: str, trials: int, draw: Callable[[np.random.Generator], Trial]) -> None:
    """Prints the counts of a case."""
    told = wrong = silent = clear = refused = 0
    for k in range(trials):
        trial = draw(np.random.default_rng([k, len(name)]))
        try:
            found = register(trial.xyz_a, trial.xyz_b, folds=0, seed=k)
        except DegenerateError:
            refused += 1
            continue
        bad, said = is_wrong(found, trial), any(word in note for note in found.notes for word in TOLD)
        told, wrong, silent = told + said, wrong + bad, silent + (bad and not said)
        clear += bad and not said and trial.off >= CLEAR_OFF and len(trial.good) >= CLEAR_ROWS
    print(f"{name:<34}{trials:7}{refused:9}{told:7}{wrong:7}{silent:8}{clear:8}", flush=True)


def shifts(trials: int) -> None:
    """All kinds, everything else drawn."""
    for kind in KINDS:

        def draw(rng: np.random.Generator, kind: str = kind) -> Trial:
            n, sigma, shift, share = (rng.choice(each) for each in (SIZES, SIGMAS_MM, SHIFTS_MM, SHARES))
            return made(rng, kind, int(n), sigma, shift, share)

        one_line(kind, trials, draw)


def issue(trials: int) -> None:
    """As it was seen first."""
    for share in (0.4, 0.45):
        name = f"0.7 mm, {100 * share:.0f} %, σ 0.15 mm, n 100"
        one_line(name, trials, lambda rng, share=share: made(rng, "anywhere", 100, 0.15, 0.7, share))


def clean(trials: int) -> None:
    """No group to be told of."""
    for name, share in (("clean", 0.0), ("20 % wrong at random", 0.2)):

        def draw(rng: np.random.Generator, share: float = share) -> Trial:
            s = make_scene(rng, int(rng.choice(SIZES)), share, sigma_mm=float(rng.choice(SIGMAS_MM)))
            return Trial(s.xyz_a, s.xyz_b, s.b_from_a, s.clean)

        one_line(name, trials, draw)


@script(trials=300, clean=500, only=["shifts", "issue", "clean"], limited=True)
def main(given) -> None:
    print(f"{'':<34}{'trials':>7}{'refused':>9}{'told':>7}{'wrong':>7}{'silent':>8}{'clear':>8}")
    for name in given.only:
        {"shifts": shifts, "issue": issue, "clean": clean}[name](given.clean if name == "clean" else given.trials)
