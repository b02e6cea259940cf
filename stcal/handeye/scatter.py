"""Whether solutions of parts of the poses scatter as σ say, and σ that hold what they do."""

from dataclasses import replace

import numpy as np

from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.methods.noise import UNKNOWNS
from stcal.handeye.result import HandEye
from stcal.handeye.validate import HeldOutPoses

SCATTERED = 1.5
"""Times by which solutions scatter that are told of: of twelve simulated poses that err as is assumed, one set in a
hundred does so."""


def scatter(result: HandEye, held_out: HeldOutPoses) -> float:
    """By how much solutions without some of the poses scatter about the one of all, in units of what its σ say.

    Of m poses with independent errors of which k are held out, the difference has the covariance C k / (m − k), where C
    is the solution's (the jackknife of Shao & Wu, Ann. Statist. 17, 1989, with several left out at once); a little
    more where few are left, for what they see differs (as the mean of an inverse Wishart matrix exceeds the inverse of
    the mean). Errors that are not independent, or not as large in all poses, show as more.

    Parameters
    ----------
    result : HandEye
        Of all poses.
    held_out : HeldOutPoses
        Of the same poses, with ``mount_from_camera``.

    Returns
    -------
    float
        RMS over splits and the six numbers; 1 is expected, NaN where a covariance or the solutions are missing.
    """
    if result.covariance is None or held_out.mount_from_camera is None or not len(held_out.rows):
        return float("nan")
    four, k = held_out.mount_from_camera, held_out.rows.shape[1]
    each = Poses(four[:, :3, :3], four[:, :3, 3])
    off = each.difference(Poses.of([result.mount_from_camera] * len(each)))
    squared = np.einsum("sa,ab,sb->s", off, generalised_inverse(result.covariance), off)
    left = 6 * (len(result.names) - k) - UNKNOWNS - 1
    return float(np.sqrt(squared.mean() / 6 * left / (6 * k)))


def widened_by_scatter(result: HandEye, held_out: HeldOutPoses) -> HandEye:
    """With σ that reach the :func:`scatter` of solutions without some of the poses; a note where that is much."""
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
