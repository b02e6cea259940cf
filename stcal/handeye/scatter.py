"""Scatter of the solutions from subsets of the poses against their σ, and σ widened to cover it."""

from dataclasses import replace

import numpy as np

from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.methods.noise import UNKNOWNS
from stcal.handeye.result import HandEye
from stcal.handeye.validate import HeldOutPoses

SCATTERED = 1.5
"""Scatter, in units of what σ predict, from which on there is a note. One in a hundred sets of twelve simulated poses
scatters as much if the poses err as assumed."""


def scatter(result: HandEye, held_out: HeldOutPoses) -> float:
    """Returns how much solutions without some poses scatter about the solution of all, relative to what its σ predict.

    If k of m poses with independent errors are held out, the difference has the covariance C k / (m − k), where C is
    the covariance of the solution (the delete-k jackknife of Shao & Wu, Ann. Statist. 17, 1989). It is a little larger
    if few poses are left, because their information varies (the mean of an inverse Wishart matrix exceeds the inverse
    of the mean). Errors that are correlated, or not equally large in all poses, make the scatter larger.

    Parameters
    ----------
    result : HandEye
        Solution from all poses.
    held_out : HeldOutPoses
        Cross-validation of the same poses, with ``mount_from_camera``.

    Returns
    -------
    float
        RMS over splits and the six parameters. 1 is expected; NaN if the covariance or the solutions are missing.
    """
    if result.covariance is None or held_out.mount_from_camera is None or not len(held_out.rows):
        return float("nan")
    matrices, k = held_out.mount_from_camera, held_out.rows.shape[1]
    solutions = Poses(matrices[:, :3, :3], matrices[:, :3, 3])
    differences = solutions.difference(Poses.of([result.mount_from_camera] * len(solutions)))
    squared = np.einsum("sa,ab,sb->s", differences, generalised_inverse(result.covariance), differences)
    dof = 6 * (len(result.names) - k) - UNKNOWNS - 1
    return float(np.sqrt(squared.mean() / 6 * dof / (6 * k)))


def widened_by_scatter(result: HandEye, held_out: HeldOutPoses) -> HandEye:
    """Returns the result with σ widened by the :func:`scatter`, if that exceeds 1, and a note if it is large."""
    factor = scatter(result, held_out)
    if not factor > 1:
        return result
    notes = result.notes
    if factor > SCATTERED:
        notes += (
            f"solutions of parts of the poses scatter {factor:.2g} times as much as σ say, so that poses do not err "
            "independently and alike: σ of both transforms are widened by that",
        )
    return replace(result.widened(factor), notes=notes)
