"""Mistakes that the data themselves show: units, mirrored axes, rows exchanged or in another unit."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from stcal.errors import InputError
from stcal.geometry.align import best_rotations
from stcal.geometry.robust import ratio_limit
from stcal.register.core.models import Model, parts
from stcal.register.core.problem import Problem
from stcal.register.core.robust import BY_CHANCE, Fitted

Namer = Callable[[int], str]

UNITS = {1000.0: ("m", "m"), 25.4: ("inches", "in"), 10.0: ("cm", "cm")}
"""Millimetres in a unit: its name and the suffix of its columns."""
UNIT_WITHIN = 0.08
"""Outliers move the median ratio of distances by a few per cent; the factors are far apart."""
PAIRS = 4000
"""Number of pairs of points whose distances are compared."""
MIRROR_RATIO = 4.0
"""Ratio of misfits that indicates a mirrored frame. Mirrored points fit a mirrored frame to noise, and a correct frame
only to their thickness; bent frames never gain so much."""
MIRROR_CHANCE = 1e-4
"""Right frames called mirrored, were their points thick only by noise: so many."""
NAMED_BELOW_RAD = np.radians(15)
"""A sign or an exchange of axes is named when it leaves the frames turned by less: then it is what was meant."""
SHOWN = 5
"""Rows that a note names."""
LOOKED_AT = 10_000
"""Outliers; what slips they show, the others show too."""


def check_units(xyz_a: np.ndarray, xyz_b: np.ndarray, seed: int) -> None:
    """Refuse frames whose distances differ by the ratio of two units.

    Raises
    ------
    InputError
        The median ratio of distances between the same two points in b and a is that of a unit.
    """
    rng = np.random.default_rng([seed, 3])
    i, j = rng.integers(len(xyz_a), size=(2, PAIRS))
    in_a, in_b = (np.linalg.norm(xyz[i] - xyz[j], axis=1) for xyz in (xyz_a, xyz_b))
    apart = (in_a > 0) & (in_b > 0)
    if not apart.any():
        return
    ratio = float(np.median(in_b[apart] / in_a[apart]))
    for factor, (name, suffix) in UNITS.items():
        for by, small, large in ((factor, "a", "b"), (1 / factor, "b", "a")):
            if abs(ratio / by - 1) < UNIT_WITHIN:
                raise InputError(
                    "E-REGISTER-UNITS",
                    f"registration: distances in {large} are {max(ratio, 1 / ratio):.4g} times those in {small} "
                    f"(median); is {small} in {name} (columns {small}x_{suffix}, {small}y_{suffix}, "
                    f"{small}z_{suffix})?",
                )


def mirrored_ratio(xyz_a: np.ndarray, xyz_b: np.ndarray) -> tuple[float, np.ndarray]:
    """Square sum of the best rotation over that of the best reflection, and the reflection (3, 3), b from a."""
    a, b = xyz_a - xyz_a.mean(0), xyz_b - xyz_b.mean(0)
    whole = (a**2).sum() + (b**2).sum()
    flip = np.array([1, 1, -1.0])
    proper = whole - 2 * best_rotations(b.T @ a)[1]
    turn, product = best_rotations(b.T @ (a * flip))
    floor = 1e-20 * whole  # rounding of exact data
    return float(max(proper, floor) / max(whole - 2 * product, floor)), turn * flip


def check_mirrored(model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray) -> None:
    """Refuse points (n, 3) that a reflection explains far better than any rotation.

    Raises
    ------
    InputError
        With the axis to change where one sign or exchange leaves the frames nearly parallel.
    """
    if model.name == "affine" or len(xyz_a) <= model.sample:
        return
    ratio, reflection = mirrored_ratio(xyz_a, xyz_b)
    redundancy = model.redundancy(len(xyz_a))
    if ratio > max(MIRROR_RATIO, ratio_limit(MIRROR_CHANCE, redundancy, redundancy)):
        raise mirrored_error(reflection, len(xyz_a), len(xyz_a), np.sqrt(ratio))


def mirrored_error(reflection: np.ndarray, agree: int, count: int, times: float) -> InputError:
    """What to say of mirrored data; ``reflection`` : (3, 3), b from a, determinant −1."""
    axes = "xyz"
    mends = {f"the sign of a{axis}": np.diag([-1.0 if axis == other else 1.0 for other in axes]) for axis in axes}
    for i, j in ((0, 1), (1, 2), (0, 2)):
        swap = np.eye(3)
        swap[[i, j]] = swap[[j, i]]
        mends[f"a{axes[i]} and a{axes[j]} with each other"] = swap
    turns = {mend: Rotation.from_matrix(reflection @ m).magnitude() for mend, m in mends.items()}
    least = min(turns, key=turns.__getitem__)
    advice = "change the sign of one axis of a or of b"
    if turns[least] < NAMED_BELOW_RAD:
        advice = f"change {least}: the frames are then turned by only {np.degrees(turns[least]):.1f}°"
    return InputError(
        "E-REGISTER-MIRRORED",
        f"registration: one of the frames is left-handed: mirrored, {agree} of {count} point pairs fit {times:.3g} "
        f"times better; {advice}",
    )


def outlier_notes(problem: Problem, fitted: Fitted, name: Namer) -> list[str]:
    """Outliers that a slip explains: exchanged rows, or another unit."""
    rows = np.flatnonzero(~fitted.inliers)[:LOOKED_AT]
    if not len(rows):
        return []
    xyz_a, xyz_b, transform, reach = problem.xyz_a, problem.xyz_b, fitted.transform, fitted.threshold
    notes = []
    mapped = transform @ xyz_a[rows]
    distance, nearest = (np.asarray(each) for each in KDTree(mapped).query(xyz_b[rows]))
    swapped = np.flatnonzero((distance <= reach) & (nearest != np.arange(len(rows))))
    taken = np.minimum(1, 2 * reach / np.maximum(np.ptp(mapped, axis=0), 1e-300)).prod()
    by_chance = bdtrc(len(swapped) - 1, len(rows), 1 - (1 - taken) ** (len(rows) - 1))
    if len(swapped) and by_chance < BY_CHANCE:
        exchanged = [(int(rows[i]), int(rows[nearest[i]])) for i in swapped[:SHOWN]]
        shown = ", ".join(f"{name(i)} is the point of {name(j)}" for i, j in exchanged)
        notes.append(f"rows exchanged: b of {shown}{_more(len(swapped))}; correct the order")
    linear, translation = parts(transform)
    back = np.linalg.inv(linear)
    for factor in [f for unit in UNITS for f in (unit, 1 / unit)]:
        tries = {
            "a": xyz_b[rows] - transform @ (xyz_a[rows] * factor),
            "b": (xyz_b[rows] * factor - translation) @ back.T - xyz_a[rows],
        }
        for side, residual in tries.items():
            fits = np.flatnonzero(np.linalg.norm(residual, axis=1) <= reach)
            if len(fits):
                shown = ", ".join(name(int(rows[i])) for i in fits[:SHOWN])
                shown += _more(len(fits))
                notes.append(f"another unit: {side} of {shown} fits when multiplied by {factor:.6g}; correct it")
    return notes


def _more(count: int) -> str:
    return f" (and {count - SHOWN} more)" if count > SHOWN else ""
