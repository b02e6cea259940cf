"""Table of the mastering offsets and D-H values of an identified robot, for its controller."""

import csv
import io
from pathlib import Path

import numpy as np

from stcal.geometry.arrays import require_arguments
from stcal.io.files import require_written
from stcal.io.poses.columns import fixed
from stcal.io.table import read_table
from stcal.robot.identification.prior import dh_values
from stcal.robot.identification.report import DH, SHOWN, UNITS
from stcal.robot.identification.result import Identified
from stcal.robot.kinematics.model import Robot

HEAD = ("joint", "parameter", "nominal", "identified", "difference", "sigma", "unit", "determined")
DIGITS = {"mm": 6, "deg": 9}
ZERO = "zero"
LENGTH_AT, ANGLE_AT = DH.index("d"), DH.index("theta")


def zeros(result: Identified, nominal: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns joint values that the controller should have at its present 0, their σ, and a mask of determined ones,
    (n,). Rows have θ + Δ where nominal ones have θ; with the coupling C, that is q + C⁻¹ Δ."""
    at = np.where(nominal.prismatic, LENGTH_AT, ANGLE_AT)
    joints, back = np.arange(len(at)), np.linalg.inv(nominal.coupling)
    change = back @ (dh_values(result.robot) - dh_values(nominal))[joints, at]
    jacobian = back @ result.adjustment.rows.by_parameters(result.robot)[joints, at]
    k = jacobian.shape[1]
    sigma = np.sqrt(np.einsum("nk,kl,nl->n", jacobian, result.covariance[:k, :k], jacobian).clip(0))
    open_ = result.dh_sigma[joints, at] == 0
    open_[[turn for turn, _ in result.adjustment.rows.coaxial]] = True
    return change, sigma, (np.abs(back) > 0) @ open_ == 0


@require_arguments
def offsets_csv(result: Identified, nominal: Robot) -> str:
    """Returns the table of mastering offsets and differences of D-H values.

    Parameters
    ----------
    result : Identified
        The robot as identified, of :func:`~stcal.robot.identify`.
    nominal : Robot
        The robot from which it was identified.

    Returns
    -------
    str
        CSV in mm and degrees, with σ (form: ``data_layout.md``).
    """
    before, values, sigma = dh_values(nominal) * SHOWN, dh_values(result.robot) * SHOWN, result.dh_sigma * SHOWN
    change, change_sigma, known = zeros(result, nominal)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(HEAD)

    def row(joint: int, name: str, old: float, new: float, deviation: float, unit: str, told: bool) -> None:
        shown = [fixed(v, DIGITS[unit]) for v in (old, new, new - old)]
        sigma_text = fixed(deviation, DIGITS[unit]) if told else ""
        writer.writerow([joint, name, *shown, sigma_text, unit, "yes" if told else "no"])

    for i, slides in enumerate(nominal.prismatic):
        for name, unit, old, new, deviation in zip(DH, UNITS, before[i], values[i], sigma[i], strict=True):
            row(i + 1, name, old, new, deviation, unit, deviation > 0)
        factor, unit = (1.0, "mm") if slides else (float(np.degrees(1.0)), "deg")
        row(i + 1, ZERO, 0.0, factor * change[i], factor * change_sigma[i], unit, bool(known[i]))
    return stream.getvalue()


def require_offsets_written(path: str | Path, result: Identified, nominal: Robot) -> None:
    """Read a written table of offsets again, and require the identified D-H values and offsets of zeros."""
    values, change = dh_values(result.robot) * SHOWN, zeros(result, nominal)[0]
    change = np.where(nominal.prismatic, change, np.degrees(change))
    require_written(
        path,
        lambda: read_table(path, "offsets").numbers("identified").reshape(len(values), -1),
        np.column_stack([values, change]),
        10.0 ** -DIGITS["mm"],
        "mm or deg",
    )
