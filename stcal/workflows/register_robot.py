"""Base and kinematics solved together, as an alternative to the transform: ``stcal register --robot`` composes two
systems."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stcal.cross_validation import dealt, held_out_errors
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments, rms
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.geometry.robust import length_limit
from stcal.io.table import Table, read_table
from stcal.parallel import one_thread
from stcal.register import register
from stcal.register.registered import WHAT, ErrorFigures, Pairs, Registration
from stcal.register.registration import Liu2017Options
from stcal.register.registration_report import error_table, matrix_table
from stcal.register.workspace import Findings, findings
from stcal.report import document
from stcal.robot.identification.adjustment import State, position_errors
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import Identified, IdentifyOptions
from stcal.robot.kinematics.measurements import Measurements, joint_values, read_conditions, targets_of
from stcal.robot.kinematics.robot_model import Robot

FIRST_NAMES = 6
ROUNDS, CLEAN_SETS = 3, 0.01
"""Number of rounds in which rows are added, and the probability that a clean set exceeds, anywhere, the bound of rows
to add."""
SAME_MM = 0.01
"""Largest deviation, in mm, at which positions of a and of the robot file agree; beyond it, a belongs to another base
or tool."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RegisteredRobot(Brief):
    """A robot identified in the frame b of a registration, and errors of both on the same held-out rows.

    ``robot`` : the nominal robot; ``identified`` : base and kinematics solved together, whose ``robot.world_from_base``
    is b_from_base, mm; ``model`` : of the transform; ``lines`` : (n,) of all rows, for messages; ``folds`` : number of
    folds of the cross-validation; ``rows`` : (m,) held out; ``transform_mm``, ``kinematics_mm`` : (m,) held-out errors
    by the transform, and by base and kinematics; ``wild`` : (m,) bool, outliers of both; ``off_mm`` : RMS distance of
    the points a from the nominal robot's positions after a rigid fit.
    """

    robot: Robot
    identified: Identified
    model: str
    lines: Sequence[int]
    folds: int
    rows: np.ndarray
    transform_mm: np.ndarray
    kinematics_mm: np.ndarray
    wild: np.ndarray
    off_mm: float

    @property
    def b_from_base(self) -> Rigid:
        """The identified robot's base in frame b, mm."""
        return self.identified.robot.world_from_base

    @property
    def transform(self) -> ErrorFigures:
        """Errors of the transform at rows held out, without outliers of both."""
        return ErrorFigures.of(self.transform_mm[~self.wild | self.wild.all()])

    @property
    def kinematics(self) -> ErrorFigures:
        """Errors of base and kinematics at rows held out, without outliers of both."""
        return ErrorFigures.of(self.kinematics_mm[~self.wild | self.wild.all()])

    @property
    def better(self) -> bool:
        """True if base and kinematics together predict better."""
        return self.kinematics.mean_mm < self.transform.mean_mm


@require_arguments
@one_thread()
def register_with_robot(
    pairs: Pairs,
    registration: Registration | Findings,
    robot: Robot,
    joints: Measurements | Table | str | Path,
    *,
    threshold_mm: float | None = None,
    liu2017_options: Liu2017Options | None = None,
    folds: int = 6,
) -> RegisteredRobot:
    """Identifies base and kinematics of the robot that carried the points, and compares them with the transform.

    Points that the transform cannot explain because the arm bends them are no outliers of the kinematics.

    Parameters
    ----------
    pairs : Points in the frames a and b, of :func:`stcal.register.read_pairs`, mm; b is the instrument that measured
        them.
    registration : Result of :func:`stcal.register.register` from these pairs, with ``allow_ambiguous`` where a bent arm
        looks like two motions.
    robot : The nominal robot, mm and rad.
    joints : Joint values at each pair, with targets and loads; or a table with columns ``q1_deg`` …, as the file of the
        pairs may have. The positions are always those of ``pairs`` in b.
    threshold_mm, liu2017_options : Options of the registration, for the transforms of the cross-validation.
    folds : Number of folds of the cross-validation; 0 for none.

    Returns
    -------
    RegisteredRobot : ``identified`` and the held-out errors of both ways.

    Raises
    ------
    InputError : There are no joint values, as many as pairs are needed, or the robot does not fit them.
    DegenerateError : Too few points for the robot's parameters.
    ConvergenceError : The identification reaches no minimum.
    """
    if not isinstance(registration, Findings):
        registration = findings(pairs, registration)
    found, data = registration, _measurements(pairs, joints, robot)
    if not len(found) == len(data) == len(pairs):
        given = f"{len(pairs)} point pairs, a registration of {len(found)}, {len(data)} joint vectors"
        raise InputError("E-ARRAY-SHAPE", f"{pairs.where}: {given}; as many of each needed")
    options: dict[str, Any] = {"model": found.model, "method": found.method, "seed": found.seed}
    options |= {"threshold_mm": threshold_mm, "liu2017_options": liu2017_options}
    settings = IdentifyOptions("position", folds=0, seed=found.seed, partial=True)
    good = found.inliers.copy()
    if registration.field is not None:
        good[registration.field.taken_back] = True
    identified, used = grown(robot, data, good, settings)

    def by_transform(train: np.ndarray, test: np.ndarray) -> np.ndarray:
        weights, covariances = (None if each is None else each[train] for each in (pairs.weights, pairs.covariances))
        of_train = {"weights": weights, "covariances": covariances, "folds": 0, "allow_ambiguous": True}
        b_from_a = register(pairs.xyz_a[train], pairs.xyz_b[train], **options, **of_train).b_from_a
        return position_errors(pairs.xyz_b[test] - b_from_a @ pairs.xyz_a[test])

    def by_kinematics(train: np.ndarray, test: np.ndarray) -> np.ndarray:
        fitted = grown(robot, data[train], good[train], settings)[0].robot
        return position_errors(pairs.xyz_b[test] - positions(fitted, data[test]))

    parts = dealt(len(data), folds, np.random.default_rng([found.seed, 4]))
    done, rows, (by_one, by_both) = held_out_errors([by_transform, by_kinematics], parts)
    nominal = positions(robot, data)
    off_mm = rms(position_errors(pairs.xyz_a - align_rigid(pairs.xyz_a, nominal) @ nominal))
    wild = ~(found.inliers | used)[rows]
    return RegisteredRobot(robot, identified, found.model, pairs.lines, done, rows, by_one, by_both, wild, off_mm)


def _measurements(pairs: Pairs, joints: Measurements | Table | str | Path, robot: Robot) -> Measurements:
    if isinstance(joints, Measurements):
        q, targets, conditions = joints.q, joints.targets, joints.conditions
        if len(joints) != len(pairs):
            return joints
    else:
        table = read_table(joints, WHAT)
        try:
            q = joint_values(table, robot)
        except InputError as error:
            raise InputError(error.code, f"{error} (--robot needs the joint values of each point)") from error
        targets, conditions = targets_of(table), read_conditions(table, joints=len(robot.rows))
    return Measurements(pairs.where, pairs.lines, q, targets, pairs.xyz_b, conditions=conditions)


def grown(robot: Robot, data: Measurements, good: np.ndarray, settings: IdentifyOptions):
    """Returns the identification from good rows and those that it then explains, and which were used. Rows that only
    the bending arm puts off the transform are no outliers of the kinematics."""
    identified = identify(robot, data[good], settings)
    for _ in range(ROUNDS):
        error = np.linalg.norm(data.positions - positions(identified.robot, data), axis=1)
        before, limit = good, identified.weighting.sigma_mm * length_limit(3, CLEAN_SETS / len(data))
        good = good | (error < limit)
        if (good == before).all():
            break
        identified = identify(robot, data[good], settings)
    used = good.copy()
    used[np.flatnonzero(good)[[row for row, _ in identified.outliers()]]] = False
    return identified, used


def positions(robot: Robot, data: Measurements) -> np.ndarray:
    """Returns the positions (m, 3) of the targets, in the instrument's frame."""
    tools = {name: robot.tool(name if name in robot.tools else "") for name in data.targets}
    return State(robot.chain(), tools).tips(data.q, data.targets, data.conditions).translation


def comparison_section(beside: RegisteredRobot) -> document.Section:
    """Returns the comparison as a section of the report."""
    outliers = f", without {beside.wild.sum()} outliers of both" if beside.wild.any() else ""
    identified, open_ones = beside.identified, beside.identified.undetermined
    determined = f"{identified.rank} of {len(identified.names)} parameters of axes, base and tool determined"
    solved = "solved together from the joint values and the positions in b"
    told = f"robot {beside.robot.name}: {determined}, {solved}; the same rows are held out of both ways{outliers}"
    ways = [(f"{beside.model} transform", beside.transform), ("base and kinematics together", beside.kinematics)]
    notes = []
    if open_ones:
        shown = ", ".join(open_ones[:FIRST_NAMES]) + ", …" * (len(open_ones) > FIRST_NAMES)
        remedy = "b_from_base and the tool may be off along these; vary the orientation more"
        notes.append(f"the points leave open: {shown}; {remedy}")
    if len(beside.rows) and not beside.better:
        notes.append("base and kinematics together are no better here: trust the transform near its points")
    if beside.off_mm > SAME_MM:
        off = f"a is {beside.off_mm:.3g} mm RMS off the positions of the robot file, after a rigid fit"
        notes.append(f"{off}: it comes from another tool or other kinematics")
    errors = error_table("held out, mm", ways) if len(beside.rows) else None
    matrix = matrix_table("b_from_base of the identified robot", beside.b_from_base.matrix())
    return document.Section("Base and kinematics together", [told, errors, matrix, *notes], terminal=True)
