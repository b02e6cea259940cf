"""Report of the poses to take next: for the terminal, as a table, and for programs."""

import csv
import io
from typing import Literal

import numpy as np
from pydantic import Field

from stcal.geometry.arrays import require_arguments
from stcal.handeye.plan import NextPoses
from stcal.handeye.result import HandEye
from stcal.io.json import Part, Pose, ResultFile
from stcal.io.table import POSE, pose_cells
from stcal.report.document import Document, Section, Table
from stcal.report.text import NONE, number

JOINT_DIGITS = 3
"""Number of digits of joint values (deg or mm) on the terminal."""


class PlannedPose(Part):
    base_from_flange: Pose
    camera_from_board: Pose
    worst_sigma_mm: float
    turn_rad: float
    joints: dict[str, float] | None


class HandEyePlanFile(ResultFile):
    """Result file of ``handeye plan``."""

    format: Literal["stcal handeye plan 1"] = Field(description="the file's form and its version")
    setup: str = Field(description="`eye-in-hand` or `eye-to-hand`")
    method: str = Field(description="that solved for the poses taken")
    taken: list[str] = Field(description="names of the poses taken that the solution rests on")
    worst_sigma_mm: float = Field(description="largest σ, in any direction, of a point at the board: now")
    poses: list[PlannedPose] = Field(
        description="to take, in order: `base_from_flange`, `camera_from_board` (how the board is seen there), "
        "`worst_sigma_mm` with this pose and those before, `turn_rad` against the nearest pose taken, `joints` by "
        "column (deg or mm; null without a robot file)"
    )


def planned_report(result: HandEye, planned: NextPoses, joints: dict[str, np.ndarray]) -> Document:
    """Returns the report of ``handeye plan``."""
    taken = int((~result.outliers).sum())
    rotvec = np.degrees([flange.log()[:3] for flange in planned.base_from_flange])
    heads = ["<pose", "worst σ, mm", "turn, °", "x, mm", "y, mm", "z, mm", "rx, °", "ry, °", "rz, °"]
    rows = [[f"{taken} taken", number(planned.sigma_mm[0], 3), *[NONE] * 7]]
    cells = []
    for k, (sigma, turn) in enumerate(zip(planned.sigma_mm[1:], planned.turn_rad, strict=True)):
        place = [f"{value:.2f}" for value in (*planned.base_from_flange[k].translation, *rotvec[k])]
        rows.append([f"next {k + 1}", number(sigma, 3), f"{np.degrees(turn):.0f}", *place])
        cells.append([f"next {k + 1}", *(f"{values[k]:.{JOINT_DIGITS}f}" for values in joints.values())])
    last = "joint limits and the image" if joints else "the image; give --robot for joint limits"
    blocks = [
        Table(heads, rows),
        Table(["<joints", *joints], cells if joints else []),
        "turn: relative to the nearest pose taken; rx, ry, rz: rotation vector. σ include only independent errors of "
        f"the poses. Collisions are not checked, only {last}",
    ]
    return Document(
        "Poses to take next",
        f"{result.setup}, method {result.method}: poses of the flange in the base, in order, and the worst σ of a "
        "point at the board with each",
        [Section("Poses", blocks, terminal=True)],
    )


@require_arguments
def planned_csv(planned: NextPoses, joints: dict[str, np.ndarray] | None = None) -> str:
    """Returns the table of the poses to take next.

    Parameters
    ----------
    planned : NextPoses
        Of :func:`~stcal.handeye.plan_poses`, k poses.
    joints : dict of (k,) array, optional
        Joint values of the poses by the name of their column, ``q1_deg`` …, degrees or mm.

    Returns
    -------
    str
        CSV with base_from_flange and camera_from_board, mm (form: ``data_layout.md``).
    """
    joints = joints or {}
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    frames = {"base_from_flange": planned.base_from_flange, "camera_from_board": planned.camera_from_board}
    writer.writerow(["pose", "worst_sigma_mm", "turn_deg", *joints, *(f"{name}_{c}" for name in frames for c in POSE)])
    for k, turn in enumerate(planned.turn_rad):
        values = [planned.sigma_mm[k + 1], np.degrees(turn), *(of[k] for of in joints.values())]
        cells = [repr(float(value)) for value in values]
        writer.writerow([k + 1, *cells, *(cell for poses in frames.values() for cell in pose_cells(poses[k]))])
    return stream.getvalue()


def planned_file(result: HandEye, planned: NextPoses, joints: dict[str, np.ndarray]) -> HandEyePlanFile:
    """Returns the file of the planned poses, for programs."""
    rows = [
        {
            "base_from_flange": planned.base_from_flange[k].matrix(),
            "camera_from_board": planned.camera_from_board[k].matrix(),
            "worst_sigma_mm": planned.sigma_mm[k + 1],
            "turn_rad": turn,
            "joints": {name: of[k] for name, of in joints.items()} or None,
        }
        for k, turn in enumerate(planned.turn_rad)
    ]
    taken = [name for name, out in zip(result.names, result.outliers, strict=True) if not out]
    return HandEyePlanFile.model_validate(
        {
            "format": "stcal handeye plan 1",
            "setup": result.setup,
            "method": result.method,
            "taken": taken,
            "worst_sigma_mm": planned.sigma_mm[0],
            "poses": rows,
        }
    )
