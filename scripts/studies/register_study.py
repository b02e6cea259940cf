"""What ``stcal register`` promises, measured on simulated points with known truth.

.venv/bin/python scripts/studies/register_study.py [--trials 200] [--only outliers structured affine covariance million]

100 points in a cube of 200 mm (as in Liu et al. 2017), noise of σ 0.15 mm per axis, unless said otherwise.

outliers
    Square sum of the clean points under the transform found over their least-squares optimum, worst trial; how many
    trials stay within 1 %; RMS true error over the cube, of all trials, against that of the fit to the clean points;
    trials refused, and trials silently wrong: outside the region that the covariance states (F distribution, one in a
    million) with neither an ambiguity nor a bent frame reported.
structured
    The same where all wrong points share one displacement, one other motion, or one place.
affine
    RMS error of test points, robust against least squares of twelve parameters and the method of Liu et al.
covariance
    Mean of eᵀC⁻¹e / p (1 when true; for an estimated σ of ν degrees of freedom times (ν − 2)/ν, its expectation), and
    the variance of e over the mean of C, median over the parameters.
million
    Seconds for a million pairs, 30 % of them wrong, from arrays.
"""

import argparse
import time

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f as fisher

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Affine, Rigid, Similarity, align_rigid, skew
from stcal.parallel import one_thread
from stcal.register import Liu2017Options, Registration, register
from stcal.register.liu2017 import affine_least_squares
from stcal.register.models import parts
from tests.support.point_pairs import CENTRE_MM, SIGMA_MM, cube, make_scene, parameter_error

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
WITHIN = 1.01
ONE_IN = 1e-6


def is_silently_wrong(found: Registration, truth: Rigid) -> bool:
    """Whether the truth is outside what the covariance admits, and nothing was said."""
    error = parameter_error(found.b_from_a, truth)
    size = error @ np.linalg.solve(found.covariance, error) / len(error)
    told = found.ambiguous or found.alternative is not None or any("bent" in note for note in found.notes)
    return bool(size > fisher.isf(ONE_IN, len(error), found.redundancy)) and not told


def trials_of(count: int, n: int, share: float, kind: str) -> str:
    """One line of figures."""
    ratios, errors, best_errors, refused, told, wrong = [], [], [], 0, 0, 0
    for trial in range(count):
        rng = np.random.default_rng([trial, n, round(100 * share), len(kind)])
        s = make_scene(rng, n, share, *STRUCTURED.get(kind, (kind,)))
        try:
            found = register(s.xyz_a, s.xyz_b, folds=0, seed=trial)
        except DegenerateError:
            refused += 1
            continue
        a, b = s.xyz_a[s.clean], s.xyz_b[s.clean]
        best = align_rigid(b, a)
        ratios.append(((b - found.b_from_a @ a) ** 2).sum() / ((b - best @ a) ** 2).sum())
        at = cube(rng, 200)
        errors.append((((found.b_from_a @ at) - s.b_from_a @ at) ** 2).sum(1).mean())
        best_errors.append((((best @ at) - s.b_from_a @ at) ** 2).sum(1).mean())
        told += found.ambiguous or found.alternative is not None
        wrong += is_silently_wrong(found, s.b_from_a)
    within = sum(ratio <= WITHIN for ratio in ratios)
    worst = f"{max(ratios):9.5f}" if ratios else "        –"
    true = f"{np.sqrt(np.mean(errors)):8.4f} {np.sqrt(np.mean(best_errors)):8.4f}" if errors else "       –        –"
    name = f"{kind} {100 * share:.0f} %"
    return f"{name:<22}{n:5} {within:6}/{count:<5}{worst} {true} {told:6} {refused:8} {wrong:6}"


HEAD = (
    f"{'wrong points':<22}{'n':>5} {'within 1 %':>12}{'worst':>9} {'RMS mm':>8} {'optimum':>8} {'told':>6} "
    f"{'refused':>8} {'silent':>6}"
)


STRUCTURED = {
    "one shift": ("one shift",),
    "shift of 2 mm": ("one shift", (2.0, 2.0)),
    "two shifts": ("two shifts",),
    "other motion": ("other motion",),
    "drift": ("drift",),
    "one place": ("one place",),
    "rows shifted": ("rows shifted",),
}


def outliers(count: int) -> None:
    """Clean data, and points displaced at random."""
    print(HEAD)
    for n in (100, 20):
        for share in SHARES:
            print(trials_of(count, n, share, "random"), flush=True)


def structured(count: int) -> None:
    """Wrong points that agree with one another."""
    print(HEAD)
    for kind in STRUCTURED:
        for share in (0.2, 0.4, 0.5, 0.6):
            for n in (100, 12):
                print(trials_of(count, n, share, kind), flush=True)


def affine(count: int) -> None:
    """Held-out error against the baselines, outliers of 5 mm."""
    print(f"{'wrong by 5 mm':<16}{'robust':>9} {'12-parameter':>13} {'times':>7} {'liu2017':>9} {'refused':>8}")
    for share in SHARES:
        errors = {"robust": [], "affine": [], "liu2017": []}
        refused = 0
        for trial in range(count):
            rng = np.random.default_rng([trial, 5, round(100 * share)])
            s = make_scene(rng, 100, share, off_mm=(5.0, 5.0))
            at = cube(rng, 50)
            found = {
                "robust": register(s.xyz_a, s.xyz_b, folds=0).b_from_a,
                "affine": affine_least_squares(s.xyz_a, s.xyz_b),
            }
            try:
                options = Liu2017Options(tries=200, limit_mm=0.6)  # 4 σ: at the paper's 0.2 mm none is acceptable here
                found["liu2017"] = register(
                    s.xyz_a, s.xyz_b, method="liu2017", liu2017_options=options, folds=0
                ).b_from_a
            except DegenerateError:
                refused += 1
            for name, transform in found.items():
                errors[name].append(((transform @ at - s.b_from_a @ at) ** 2).sum(1).mean())
        rms = {name: np.sqrt(np.mean(e)) if e else np.nan for name, e in errors.items()}
        name = f"{100 * share:.0f} %"
        print(
            f"{name:<16}{rms['robust']:9.4f} {rms['affine']:13.4f} {rms['affine'] / rms['robust']:7.1f} "
            f"{rms['liu2017']:9.4f} {refused:8}",
            flush=True,
        )


def covariance(count: int) -> None:
    """Calibration of the covariance."""
    print(f"{'case':<44}{'eᵀC⁻¹e/p':>10} {'variance/C':>11} {'sets':>6}")
    count = max(count, 500)
    for model in ("rigid", "similarity", "affine"):
        for n, share in ((10, 0.0), (30, 0.0), (100, 0.0), (100, 0.3)):
            _calibrated(f"{model}, n = {n}, {100 * share:.0f} % wrong", count, model, n, share)
    _calibrated("rigid, n = 100, threshold of 2 σ", count, "rigid", 100, 0.0, threshold=2 * SIGMA_MM)
    _calibrated("rigid, n = 100, threshold of 3 σ, 30 % wrong", count, "rigid", 100, 0.3, threshold=3 * SIGMA_MM)
    for model in ("rigid", "similarity", "affine"):
        _calibrated(f"{model}, n = 40, covariances, 20 % wrong", count, model, 40, 0.2, given=True)
    _calibrated("rigid, n = 40, covariances 9 times too small", count, "rigid", 40, 0.0, given=True, understated=9)


def _calibrated(title, count, model, n, share, threshold=None, given=False, understated=1) -> None:
    sizes, errors, covariances = [], [], []
    for trial in range(count):
        rng = np.random.default_rng([trial, n, len(title)])
        s = make_scene(rng, n, share)
        truth = _distorted(rng, s.b_from_a, model)
        xyz_b = truth @ s.xyz_a + (s.xyz_b - s.b_from_a @ s.xyz_a)
        stated = None
        if given:  # like a tracker's: along the line of sight ten times better than across
            axes = Rotation.random(n, random_state=rng.integers(2**31)).as_matrix()
            sigmas = np.array([0.02, 0.2, 0.2]) * rng.uniform(0.5, 2, (n, 1))
            root = axes * sigmas[:, None, :]
            noise = np.einsum("nij,nj->ni", root, rng.normal(size=(n, 3)))
            xyz_b = np.where(s.clean[:, None], truth @ s.xyz_a + noise, xyz_b)
            stated = root @ np.swapaxes(root, 1, 2) / understated
        found = register(s.xyz_a, xyz_b, model=model, covariances=stated, threshold_mm=threshold, folds=0, seed=trial)
        error = parameter_error(found.b_from_a, truth)
        spread = (found.redundancy - 2) / found.redundancy if np.isfinite(found.redundancy) else 1.0
        sizes.append(error @ np.linalg.solve(found.covariance, error) / len(error) * spread)
        # about the points' middle, where rotation and translation are independent
        shift = _about(found, np.array(CENTRE_MM))
        errors.append(shift @ error)
        covariances.append(np.diag(shift @ found.covariance @ shift.T))
    ratio = np.var(errors, axis=0) / np.mean(covariances, axis=0)
    print(f"{title:<44}{np.mean(sizes):10.3f} {np.median(ratio):11.3f} {len(sizes):6}", flush=True)


def _distorted(rng: np.random.Generator, rigid: Rigid, model: str):
    if model == "rigid":
        return rigid
    if model == "similarity":
        return Similarity(1.003, rigid)
    return Affine(rigid.rotation @ (np.eye(3) + rng.normal(0, 0.01, (3, 3))), rigid.translation)


def _about(found: Registration, point: np.ndarray) -> np.ndarray:
    """(p, p): errors of the parameters about a point of a instead of its origin."""
    p = len(found.covariance)
    change = np.eye(p)
    if found.model == "affine":
        for row in range(3):
            change[4 * row + 3, 4 * row : 4 * row + 3] = point
        return change
    at = parts(found.b_from_a)[0] @ point
    change[3:6, :3] = -skew(at)
    if p == 7:
        change[3:6, 6] = at
    return change


def million(_: int) -> None:
    """Time of a million pairs."""
    s = make_scene(np.random.default_rng(0), 1_000_000, 0.3)
    for folds in (0, 6):
        start, used = time.perf_counter(), time.process_time()
        found = register(s.xyz_a, s.xyz_b, folds=folds)
        wall, used = time.perf_counter() - start, time.process_time() - used
        print(
            f"1 000 000 pairs, folds {folds}: {wall:.2f} s ({used:.2f} s of processor), "
            f"{found.inliers.sum()} inliers of {s.clean.sum()} clean points"
        )


SECTIONS = {
    "outliers": outliers,
    "structured": structured,
    "affine": affine,
    "covariance": covariance,
    "million": million,
}


@one_thread()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    arguments = parser.parse_args()
    for name in arguments.only:
        print(f"\n{name} (simulated)")
        SECTIONS[name](arguments.trials)


if __name__ == "__main__":
    main()
