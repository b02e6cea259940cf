"""Checks whether the points determine the transform: lines, planes, symmetric layouts."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.align import best_rotations
from stcal.register.core.models import Model

WIDER_THAN = 10.0
"""Least spread √Σd² of points off a line (affine: off a plane), in σ. The turn about it then has σ ≤ 0.1 rad."""
SYMMETRY_UP_TO = 200
"""Largest number of points checked for symmetry. Larger sets are clouds, not layouts with labels."""
SHOWN = 6
"""Number of points of a cycle that a note names."""

Namer = Callable[[int], str]


def spreads(xyz: np.ndarray) -> np.ndarray:
    """Returns the root square sums (3,) of centred points along their principal axes, the longest first, mm."""
    centred = xyz - xyz.mean(0)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred)[::-1], 0))


def by_chance(agreeing: int, n: int, sigma_mm: float) -> DegenerateError:
    """Returns the error of point pairs that agree no better than chance."""
    return DegenerateError(
        "E-REGISTER-CHANCE",
        f"registration: {agreeing} of {n} point pairs agree to {sigma_mm:.4g} mm, no better than chance; check that "
        "row i of both is the same point",
    )


def check_extent(model: Model, xyz_a: np.ndarray, sigma_mm: float) -> None:
    """Refuses points that do not determine the model at their σ.

    Raises DegenerateError: the points lie along a line, or in a plane for the affine model; or σ is as large as their
    whole extent.
    """
    n, spread = len(xyz_a), spreads(xyz_a)
    needed = WIDER_THAN * sigma_mm
    off_line = float(np.hypot(spread[1], spread[2]))
    length = spread[0] / np.sqrt(n)
    if n > model.needed and spread[0] < needed:
        raise by_chance(n, n, sigma_mm)
    if off_line < needed:
        raise DegenerateError(
            "E-POINTS-COLLINEAR",
            f"registration: the {n} points lie along a line, {off_line / np.sqrt(n):.4g} mm RMS off it ({length:.4g} "
            f"mm along it); {needed / np.sqrt(n):.4g} mm needed at σ {sigma_mm:.4g} mm; measure points off the line",
        )
    if model.name == "affine" and spread[2] < needed:
        raise DegenerateError(
            "E-POINTS-COPLANAR",
            f"registration: the {n} points lie in a plane, {spread[2] / np.sqrt(n):.4g} mm RMS off it ({length:.4g} mm "
            f"along it); {needed / np.sqrt(n):.4g} mm needed for the affine model at σ {sigma_mm:.4g} mm; measure "
            "points off the plane, or use the rigid model",
        )


def single_supports(model: Model, xyz_a: np.ndarray, sigma_mm: float) -> np.ndarray:
    """Returns the indices of points that are indispensable: if one of them is left out, :func:`check_extent` refuses
    the others."""
    n = len(xyz_a)
    centred = xyz_a - xyz_a.mean(0)
    scatter = centred.T @ centred
    held = np.linalg.eigvalsh(scatter)[: 1 if model.name == "affine" else 2].sum()
    taken = n / (n - 1) * (centred**2).sum(1)  # upper bound of a point's part of these eigenvalues: few pass it
    rows = np.flatnonzero(held - taken < (1 + 1e-6) * (WIDER_THAN * sigma_mm) ** 2 + 1e-9 * np.trace(scatter))
    own = centred[rows]
    values = np.maximum(np.linalg.eigvalsh(scatter - n / (n - 1) * own[:, :, None] * own[:, None, :]), 0)
    off = values[:, 0] if model.name == "affine" else values[:, 0] + values[:, 1]
    return rows[np.sqrt(off) < WIDER_THAN * sigma_mm]


def check_supports(model: Model, xyz_a: np.ndarray, inliers: np.ndarray, sigma_mm: float, name: Namer) -> None:
    """Refuses a set with outliers in which a single point determines a turn, as any wrong point would have fitted
    there.

    Raises DegenerateError if the others would be refused by :func:`check_extent` without that point.
    """
    rows = np.flatnonzero(inliers)
    alone = single_supports(model, xyz_a[rows], sigma_mm)
    if len(alone):
        kind, first = "plane" if model.name == "affine" else "line", name(int(rows[alone[0]]))
        raise DegenerateError(
            "E-REGISTER-DEGENERATE",
            f"registration: only {first} keeps the {len(rows)} points that agree off a {kind}, and any "
            f"wrong point would fit there as well; measure more points off the {kind}",
        )


def row_name(row: int, lines: Sequence[int] | None) -> str:
    """Returns a point's name for messages: its line in the file, else its row from 1."""
    return f"row {row + 1}" if lines is None else f"line {lines[row]}"


def symmetry(xyz: np.ndarray, tolerance_mm: float) -> tuple[float, np.ndarray] | None:
    """Returns a turn that maps the points onto themselves but not each onto itself: angle (rad), permutation (n,).

    Candidates map the point farthest from the centroid and one off that line to others at the same distances. Of
    several turns the one with the smallest misfit is returned. The result is None if there is no turn, or points are
    too close together for the tolerance.
    """
    n = len(xyz)
    if not 3 <= n <= SYMMETRY_UP_TO:
        return None
    centred = xyz - xyz.mean(0)
    if pdist(centred).min() < 4 * tolerance_mm:
        return None
    radius = np.linalg.norm(centred, axis=1)
    first = int(radius.argmax())
    second = int(np.linalg.norm(np.cross(centred, centred[first]), axis=1).argmax())
    apart = np.linalg.norm(centred[:, None] - centred, axis=2)
    fits = (
        (np.abs(radius - radius[first]) < 2 * tolerance_mm)[:, None]
        & (np.abs(radius - radius[second]) < 2 * tolerance_mm)
        & (np.abs(apart - apart[first, second]) < 2 * tolerance_mm)
    )
    tree = KDTree(centred)
    least, best = np.inf, None
    for i, j in np.argwhere(fits):
        if (i, j) == (first, second):
            continue
        turn = best_rotations(centred[[i, j]].T @ centred[[first, second]])[0]
        # from two points, then from all: the first two carry their own noise
        turn = best_rotations(centred[_nearest(tree, centred @ turn.T)].T @ centred)[0]
        to = _nearest(tree, centred @ turn.T)
        turn = best_rotations(centred[to].T @ centred)[0]
        misfit = np.linalg.norm(centred @ turn.T - centred[to], axis=1).max()
        is_one = len(np.unique(to)) == n and (to != np.arange(n)).any()
        if is_one and misfit <= 2 * tolerance_mm and misfit < least:
            least, best = misfit, (float(Rotation.from_matrix(turn).magnitude()), to)
    return best


def _nearest(tree: KDTree, xyz: np.ndarray) -> np.ndarray:
    """Returns the indices (n,) of the tree's points nearest to points (n, 3)."""
    return np.asarray(tree.query(xyz)[1])


def symmetry_note(found: tuple[float, np.ndarray], rows: np.ndarray, name: Namer) -> str:
    """Returns one line on the turn and the points that it exchanges."""
    angle, to = found
    start = int(np.flatnonzero(to != np.arange(len(to)))[0])
    cycle, at = [start], int(to[start])
    while at != start:
        cycle.append(at)
        at = int(to[at])
    steps = ", ".join(f"{name(int(rows[i]))} → {name(int(rows[j]))}" for i, j in pairwise([*cycle, start][: SHOWN + 1]))
    return (
        f"the layout is symmetric: a turn by {np.degrees(angle):.1f}° maps it onto itself ({steps}"
        f"{', …' if len(cycle) > SHOWN or (to != np.arange(len(to))).sum() > len(cycle) else ''}); labels exchanged "
        "like that would fit as well, so check that rows are the same points"
    )
