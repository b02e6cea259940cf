"""The robot from the axes of all joints: Denavit–Hartenberg rows, tools, their σ, and what to refuse."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stcal.errors import InputError
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid
from stcal.io.json import ByName, Finite, Matrix, Part, Pose, ResultFile
from stcal.parallel import one_thread
from stcal.robot.axes.checks import (
    LeaveOneOut,
    Pair,
    chain_through,
    jacobian_by_axes,
    leave_one_out,
    off_mm,
    pairs_of,
    remarks,
    require_like_nominal,
    sigma_of,
)
from stcal.robot.axes.fit import TINY, AxisFit, fit_axes
from stcal.robot.axes.sweeps import STILL_RAD, find_arcs, virtual_reflectors
from stcal.robot.identification.prior import dh_values
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_file import RobotText
from stcal.robot.kinematics.robot_model import Chain, Robot

ByLine = Annotated[int, "line"]
Rows = Annotated[list[list[Finite]], BeforeValidator(lambda rows: np.asarray(rows, float).tolist())]
"""Rows of numbers, null where there is none."""
TOOL_GROSS = 6.0
"""Distance, in median distances, beyond which a row does not count for a reflector's place on the flange."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxesResult:
    """A robot by the axis method.

    ``fits`` : one for each joint, with the joints before it at zero; ``covariance`` : (p, p) of all axes together, 4 or
    2 parameters of each in its own frame, including what each axis inherits from the unwinding of those before;
    ``robot`` : its rows, base and tools; ``row_sigma`` : (n, 5) of a, alpha, d, theta, beta (mm, rad), 0 where the
    nominal value is kept; ``tool_spread_mm`` : RMS of each reflector about its place on the flange; ``chain`` : the
    axes; ``off`` : for each axis, lines of the rows that were left out and how far they are off their arcs, mm;
    ``notes`` : what was passed over.
    """

    format: ClassVar = "stcal axes 1"
    fits: tuple[AxisFit, ...]
    covariance: Array
    chain: Chain
    robot: Robot
    row_sigma: Array
    tool_spread_mm: dict[str, float]
    pairs: tuple[Pair, ...]
    without_one: LeaveOneOut
    off: tuple[Mapping[int, float], ...]
    notes: tuple[str, ...]

    def __post_init__(self):
        freeze(self, "covariance", (None, None), "covariance")
        freeze(self, "row_sigma", (None, 5), "σ of the rows")

    @property
    def rows(self) -> np.ndarray:
        """Rows (n, 5) a, alpha, d, theta, beta of the robot; mm, rad."""
        return dh_values(self.robot)

    @property
    def tools(self) -> Mapping[str, Rigid]:
        """Tools of the robot."""
        return self.robot.tools


class AxisPart(Part):
    world_from_axis: Pose
    covariance: Matrix
    rms_mm: float
    sigma_mm: float
    redundancy: int
    span: float
    arcs: Annotated[list[str], BeforeValidator(lambda arcs: [getattr(arc, "target", arc) for arc in arcs])]
    radii: Annotated[list[Finite], BeforeValidator(list)]
    heights: Annotated[list[Finite], BeforeValidator(list)]


class LeaveOneOutRows(Part):
    lines: list[int]
    distance: Rows
    normal: Rows


class AxesFile(ResultFile):
    """The result file of ``axes``."""

    format: Literal["stcal axes 1"] = Field(description="the file's form and its version")
    robot: RobotText = Field(description="text of the robot file")
    fits: list[AxisPart] = Field(
        description="of each joint, all joints at zero: `world_from_axis`, z along positive motion; `covariance` of "
        "rx, ry (rad), tx, ty (mm) in that frame (prismatic: rx, ry) by its own noise; `rms_mm` of a coordinate of the "
        "residuals, `sigma_mm`, `redundancy`; `span`, rad or mm; reflectors of its `arcs`, `radii` and `heights`, mm"
    )
    off: list[dict[ByLine, float]] = Field(description="by joint, rows off their arcs and left out, mm")
    covariance: Matrix = Field(description="of all axes together, with what each inherits from those before")
    rows: Matrix = Field(description="`a` (mm), `alpha` (rad), `d`, `theta`, `beta` of each joint")
    row_sigma: Matrix = Field(description="their σ; 0: kept from the robot given")
    tools: dict[ByName, Pose] = Field(description="flange_from_target, mm")
    tool_spread_mm: dict[ByName, float] = Field(description="RMS about it: encoders, gears and elasticity are in it")
    pairs: list[Pair] = Field(
        description="`joint` (from 1) and the next: `angle_rad`, `angle_sigma_rad`; `parallel`: within 1° of it; "
        "`distance_mm`, `distance_sigma_mm`: along the common normal, of near-parallel axes in the plane of their row; "
        "`normal_mm`, `foot_mm` and their σ `normal_sigma_mm`, `foot_sigma_mm`: the common normal, and its foot along "
        'the first axis from where that was measured; `refused`: why these must not be used, or `""`'
    )
    without_one: LeaveOneOutRows = Field(
        description="`lines` of the rows left out, `distance`, `normal` of each pair without them, mm, signed as `a`"
    )
    notes: list[str] = Field(description="rows, reflectors and arcs not used, columns not read, conventions of angles")


@one_thread()
def robot_from_sweeps(
    data: Measurements, nominal: Robot, still_rad: float = STILL_RAD, places: np.ndarray | None = None
) -> AxesResult:
    """Returns the axes, the robot, and their uncertainty by the axis method.

    Axes do not determine everything. What :func:`~stcal.robot.kinematics.dh.robot_from_chain` keeps of the nominal
    robot is kept here, and so is the orientation of tools.

    Parameters
    ----------
    data : positions of one or more reflectors in sweeps of single joints.
    nominal : convention, joint types, coupling, and approximate build of the arm.
    still_rad : change of a revolute joint's value up to which the joint stands still.
    places : (k, 3) array, optional
        Places of virtual reflectors in the target's frame, mm, k ≥ 3 and not in line, by which orientations are used
        too: those of :func:`~stcal.robot.axes.sweeps.ring`, or points of a real target. If None, positions alone
        are used.

    Returns
    -------
    AxesResult : axes in the instrument's frame with their covariance, and the robot that they make; mm, rad.

    Raises
    ------
    ConvergenceError : the fit of an axis reaches no minimum.
    InputError : several stations, a joint never swept, a reflector that does not move, mirrored positions, a robot of
        another build; no orientations where they are asked for.
    DegenerateError : axes that their arcs do not determine.

    References
    ----------
    H. W. Stone, "Kinematic Modeling, Identification, and Control of Robotic Manipulators", 1987. J. Santolaria, M.
    Ginés, "Uncertainty estimation in robot kinematic calibration", Robotics and Computer-Integrated Manufacturing 29,
    2013.
    """
    if len(set(data.stations)) > 1:
        raise InputError(
            "E-STATION-SINGLE",
            f"{data.where}: stations {', '.join(data.by_station())}; sweeps are seen from one, so give one at a time",
        )
    measured, virtual = data, None if places is None else virtual_reflectors(data, places)
    data = data if virtual is None else virtual.data
    if nominal.tree is not None:
        raise InputError(
            "E-ROBOT-TREE",
            f"robot {nominal.name} is a tree of joints; the axis method takes one arm at a time: give its file",
        )
    arcs, notes = find_arcs(data, nominal, still_rad)
    notes = [*data.notes, *notes]
    fits, covariance, unwound, passed = fit_axes(data, nominal, arcs, virtual)
    frames = [fit.world_from_axis for fit in fits]
    require_like_nominal(data.where, frames, nominal)
    axes = chain_through(frames, nominal)
    tools, spread = _tools(data, frames[-1], unwound)
    if virtual is not None:
        tools, spread = virtual.tools(tools, spread)
    robot = robot_from_chain(axes, tools, nominal)
    if virtual is None:
        orientation = {name: nominal.tools[name].rotation if name in nominal.tools else np.eye(3) for name in tools}
        robot = replace(robot, tools={n: Rigid(orientation[n], t.translation) for n, t in robot.tools.items()})

    def row_values(frames: list[Rigid]) -> np.ndarray:
        return dh_values(robot_from_chain(chain_through(frames, nominal), {}, nominal)).ravel()

    row_sigma = sigma_of(jacobian_by_axes(row_values, frames, nominal), covariance).reshape(-1, 5)
    pairs = pairs_of(frames, covariance, robot)
    notes += remarks(measured, data, fits, robot, nominal)
    notes += [
        f"joints {p.joint} and {p.joint + 1}: {p.refused}; their row is Denavit and Hartenberg's all the same, as "
        f"they are not within {np.degrees(PARALLEL_RAD):g}° of parallel"
        for p in pairs
        if p.refused and not p.parallel
    ]
    return AxesResult(
        fits=tuple(fits),
        covariance=covariance,
        chain=axes,
        robot=robot,
        row_sigma=row_sigma,
        tool_spread_mm=spread,
        pairs=pairs,
        without_one=leave_one_out(data, fits, nominal, passed),
        off=tuple({int(data.lines[row]): size for row, size in off_mm(fit).items()} for fit in fits),
        notes=tuple(notes),
    )


def _tools(data: Measurements, last: Rigid, unwound: np.ndarray):
    """Returns the places of the reflectors in the last joint's frame, from all rows, and their spread."""
    names, tools, spread = np.array(data.targets), {}, {}
    for name in dict.fromkeys(data.targets):
        points = last.inverse() @ unwound[names == name]
        place = np.median(points, axis=0)
        far = np.linalg.norm(points - place, axis=1)
        good = far <= TOOL_GROSS * max(np.median(far), TINY)
        place = points[good].mean(axis=0)
        tools[name] = Rigid(np.eye(3), place)
        spread[name] = float(np.sqrt(((points[good] - place) ** 2).sum(axis=1).mean()))
    return tools, spread
