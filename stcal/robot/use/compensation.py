"""Joint values of an identified arm that reach the poses that a file commands, in the programmed configuration."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AliasPath, BeforeValidator, Field

from stcal.errors import InputError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, require_arguments, rms
from stcal.geometry.rigid import Poses, Rigid, other_axes
from stcal.io.json import Named, ResultFile, Shape, Vector
from stcal.io.rotations import EXPLAINS
from stcal.io.table import LENGTHS, UNIT_WORDS, csv_text
from stcal.parallel import one_thread
from stcal.robot.identification.adjustment import State, over_ranges, position_errors
from stcal.robot.kinematics.dh import FITS, TURNED_RAD, require_orientations
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import (
    LIMIT,
    ORIENTATION,
    SAME_BRANCH,
    SINGULAR_POSE,
    UNREACHABLE,
    Inverse,
    inverse,
    reach_mm,
)
from stcal.robot.kinematics.measurements import Targets
from stcal.robot.kinematics.robot_model import Joint, Robot


def poses_of(robot: Robot, targets: Targets, q: np.ndarray) -> Poses:
    """Returns base_from_tool of joint values (m, n), with each row's tool and load."""
    arm = State(replace(robot, world_from_base=Rigid()).chain(), {name: robot.tool(name) for name in targets.tools})
    return arm.tips(q, targets.tools, targets.conditions)


def joints_of(robot: Robot, targets: Targets, poses: Poses, near: np.ndarray | None) -> Inverse:
    """Returns joint values that bring each row's tool to ``poses``, near to ``near`` (m, n)."""
    m, mass = len(poses), targets.conditions.payload_kg
    alike: dict[tuple[str, float | None], list[int]] = {}
    for row, pair in enumerate(zip(targets.tools, [None] * m if mass is None else mass.tolist(), strict=True)):
        alike.setdefault(pair, []).append(row)
    found = Inverse(np.zeros((m, len(robot.rows))), ("",) * m, np.zeros(m), np.zeros(m))
    for (name, kg), rows in alike.items():
        part = inverse(robot, poses[rows], None if near is None else near[rows], name, kg)
        found = found.with_rows(rows, part)
    return found


UNITS = ("m", "in")
"""Possible units of columns of mm. In micrometres no arm would reach a pose, and cm differ by a factor of ten only."""
USUAL_SHARE, SAMPLE = 0.01, 50
"""Usual error as a share of the reach, ten times the manufacturing tolerance; number of joint vectors compared."""


def robots_apart(identified: Robot, nominal: Robot) -> str:
    """Returns a note if two files may be of different robots, by their flanges. Raises InputError: they must be."""
    ends = list(identified.tree.carriers) or [""]
    identified, nominal = (replace(each, tools=dict.fromkeys(ends, Rigid())) for each in (identified, nominal))
    q = over_ranges(identified, SAMPLE, ends[0])
    off = [forward(identified, q, end).translation - forward(nominal, q, end).translation for end in ends]
    apart, reach = max(map(rms, map(position_errors, off))), max(reach_mm(each, ends) for each in (identified, nominal))
    if apart <= USUAL_SHARE * reach:
        return ""
    both = f"nominal robot {nominal.name} and identified robot {identified.name}"
    said = f"{both} are {apart:.4g} mm apart at the same joint values (RMS),"
    if apart > FITS * reach:
        fault = f"{said} {FITS * reach:.3g} mm allowed, {FITS:.0%} of the reach: files of the same robot needed"
        raise InputError("E-ROBOT-MISMATCH", f"{fault}; check units, D-H rows, convention and coupling of both")
    usual = f"more than arms are off their drawing ({USUAL_SHARE:.0%} of the reach)"
    return f"{said} {usual}: are both files of this robot?"


def on_targets(robot: Robot, targets: Targets) -> tuple[bool, tuple[str, ...]]:
    """Returns whether joint values beside the poses confirm them, and doubts about the poses of ``robot``. Raises
    InputError: joint values lead to the poses in another unit, convention or order of rows, which it names; chance does
    so once in 10⁶ a row."""
    poses, q = targets.poses, targets.q
    if poses is None:
        return True, ()
    near_base = _near_base(robot, targets, poses)
    if q is None:
        return False, near_base

    def off(case: tuple[Poses, np.ndarray]) -> np.ndarray:
        """Returns the length (2, m) of the turn, rad, and of the shift, mm, from where joint values lead to poses."""
        return np.linalg.norm(case[0].difference(poses_of(robot, targets, case[1])).reshape(-1, 2, 3), axis=2).T

    def misfit(case: tuple[Poses, np.ndarray]) -> float:
        turn, shift = map(rms, off(case))
        return np.inf if turn >= TURNED_RAD else shift

    (rad, mm), allowed = off((poses, q)), FITS * reach_mm(robot, set(targets.tools))
    own = rms(mm)
    if own <= allowed:
        reached = poses_of(robot, targets, q).rotation
        require_orientations(targets.where, targets.tools, reached, poses.rotation, many=False)
    else:
        for best, left in explain(_mistakes(robot, poses, q), misfit, min(allowed, EXPLAINS * own))[:1]:
            away = f"{targets.where}: joint values of robot {robot.name} lead {own:.4g} mm (RMS) away from their poses"
            fault = f"{away}, {allowed:.3g} mm allowed, {FITS:.0%} of the reach"
            raise InputError("E-ROBOT-MISMATCH", f"{fault}; but {left:.3g} mm if {best.words}")
    away = (mm > allowed) | (rad > TURNED_RAD)
    if not away.any() or (len(q) > 1 and not np.ptp(q, axis=0).any()):  # the same values only choose a branch
        return True, ()
    note = (
        f"joint values of {away.sum()} of {len(q)} rows, first line {targets.lines[int(away.argmax())]}, lead "
        f"elsewhere than their poses, by {np.median(mm[away]):.4g} mm and {np.degrees(np.median(rad[away])):.3g}° "
        "(median): they only choose the branch; if they are those of the poses, check order, units and conventions; if "
        "the poses are of the nominal robot's tool, give that robot with --nominal"
    )
    return False, (note, *near_base)


def _mistakes(robot: Robot, poses: Poses, q: np.ndarray) -> Iterator[Candidate]:
    """Yields frequent mistakes with the poses and the joint values that were meant."""
    for unit in UNITS:
        words = f"lengths were {UNIT_WORDS[unit]}; call the columns x_{unit} …"
        yield Candidate(words, partial(tuple, (Poses(poses.rotation, LENGTHS[unit] * poses.translation), q)))
    for names, places in other_axes(poses.translation):
        words = f"x, y, z were {names}; correct order and signs of the columns of positions"
        yield Candidate(words, partial(tuple, (Poses(poses.rotation, places), q)))
    inverse = "poses were inverse (base seen from the tool); give the tool in the base's frame"
    yield Candidate(inverse, lambda: (poses.inverse(), q))
    radians = "joint values were radians in columns of degrees; call the columns q1_rad …"
    yield Candidate(radians, lambda: (poses, q * robot.shown))  # degrees in columns of radians: told where read


def _near_base(robot: Robot, targets: Targets, poses: Poses) -> tuple[str, ...]:
    """Returns a note if all poses are so near the base's origin that metres or inches would also be within reach."""
    far = float(np.linalg.norm(poses.translation, axis=1).max())
    first_joint = replace(robot, world_from_base=Rigid()).chain().translation[0]
    reach = reach_mm(robot, set(targets.tools)) + float(np.linalg.norm(first_joint))
    return tuple(
        f"all targets lie within {far:.3g} mm of the base's origin, where no arm works that reaches {reach:.4g} mm: if "
        f"the unit of x, y, z is {UNIT_WORDS[unit]}, call the columns x_{unit} …"
        for unit in UNITS
        if 0 < far * LENGTHS[unit] <= reach
    )[:1]


FAR_RAD, AMPLIFIED = np.radians(1.0), 10.0
"""Largest usual motion of a joint; its ratio to the error of the pose, in rad, from which the pose is near singular."""
SAME_TOOL_MM, SAME_TOOL_RAD = 20.0, np.radians(5)  # largest plausible deviation of a tool from its drawing, mm and rad
ROUND_MM = 0.01  # lengths as drawn are multiples of this
MEANING = {
    LIMIT: "only joint values beyond the limits reach it",
    UNREACHABLE: "no joint values reach it",
    SINGULAR_POSE: "singular: the joint values are not the only ones",
    ORIENTATION: "position reached, orientation as near as the joints allow",
}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Compensated(Brief):
    """The commanded poses with the corrected values for the controller.

    ``targets`` : as given; ``poses`` : commanded base_from_tool; ``found`` : by the identified robot; ``nominal`` : by
    the nominal robot: what would be commanded without calibration; ``before_mm``, ``before_rad`` : (m,) error of the
    nominal joint values by the identified robot, which compensation removes; empty without a nominal robot;
    ``identified`` : the identified robot, with the tools that were taken; ``beyond`` : joints, and their values, of
    rows that only joint values beyond the limits reach; ``doubts`` : notes on targets that may have another meaning,
    and on tools and arms that differ from the nominal robot.
    """

    targets: Targets
    poses: Poses
    found: Inverse
    nominal: Inverse | None
    before_mm: np.ndarray
    before_rad: np.ndarray
    identified: Robot
    beyond: dict[int, str]
    doubts: tuple[str, ...] = ()
    format: ClassVar = "stcal compensation 1"

    def __len__(self) -> int:
        return len(self.found)

    @property
    def remarks(self) -> list[str]:
        """Notes of the file of targets, and :meth:`notes`."""
        return [*self.targets.notes, *self.notes()]

    @property
    def joints(self) -> list[dict[str, float] | None]:
        """Joint values to command, by the names of columns; None where they do not reach the pose."""
        return _by_column(self.found, self.identified)

    @property
    def nominal_joints(self) -> list[dict[str, float] | None] | None:
        """The same by the nominal robot."""
        return None if self.nominal is None else _by_column(self.nominal, self.identified)

    def compared(self) -> np.ndarray:
        """Mask (m,) of the rows that both robots reach."""
        return self.found.usable & self.nominal.usable if self.nominal else np.zeros(len(self), bool)

    def notes(self) -> list[str]:
        """Returns doubts about targets and robots, then notes on rows not simply reached or far from nominal values."""
        found, lines, notes = self.found, self.targets.lines, [*self.doubts]
        for i, (line, status) in enumerate(zip(lines, found.status, strict=True)):
            if status in MEANING:
                beyond = f" ({self.beyond[i]})" if i in self.beyond else ""
                mm, deg = found.error_mm[i], np.degrees(found.error_rad[i])
                notes.append(f"line {line}: {MEANING[status]}{beyond}; {mm:.4g} mm and {deg:.4g}° remain")
        if self.nominal is None:
            return notes
        moved = np.abs(found.q - self.nominal.q)[:, ~self.identified.prismatic].max(axis=1, initial=0.0)
        expected = self.before_rad + self.before_mm / reach_mm(self.identified, self.targets.tools[:1])
        for i in np.flatnonzero(self.compared() & (moved > FAR_RAD)).tolist():
            deg = np.degrees(self.before_rad[i])
            why = f"the nominal joint values err by {self.before_mm[i]:.4g} mm and {deg:.3g}°"
            why = "near a singular pose" if moved[i] > AMPLIFIED * expected[i] else why
            notes.append(f"line {lines[i]}: a joint moves by {np.degrees(moved[i]):.1f}°: {why}")
        return notes


def _with_one_tool(identified: Robot, nominal: Robot, targets: Targets) -> tuple[Robot, Robot, tuple[str, ...]]:
    """Returns both robots with the same tools, the identified unless joint values show the nominal's, and notes."""
    apart = {}
    for name in dict.fromkeys(targets.tools):
        own, other = identified.tool(name), nominal.tools.get(name)
        if other is None:
            apart[name] = "is not in the nominal file"
            continue
        mm, rad = np.linalg.norm(own.translation - other.translation), (own.inverse() @ other).angle_rad()
        if mm > SAME_TOOL_MM or rad > SAME_TOOL_RAD:
            apart[name] = f"differs by {mm:.4g} mm and {np.degrees(rad):.3g}° between the two files"
    with_own = replace(nominal, tools={**nominal.tools, **{name: identified.tools[name] for name in apart}})
    taken, poses, q = "identified file is taken in both", targets.poses, targets.q
    if apart.keys() <= nominal.tools.keys() and poses is not None and q is not None:
        misses = [rms(position_errors(poses_of(each, targets, q).difference(poses))) for each in (nominal, with_own)]
        if misses[0] < misses[1]:
            taken = "nominal file is taken in both (joint values beside the poses say so)"
            own_tools = {name: nominal.tools[name] for name in apart}
            identified, with_own = replace(identified, tools={**identified.tools, **own_tools}), nominal
    notes = (f"tool {name or 'of the robot files'} {said}: that of the {taken}" for name, said in apart.items())
    return identified, with_own, tuple(notes)


@require_arguments
@one_thread()
def compensate(identified: Robot, targets: Targets | Poses, nominal: Robot | None = None) -> Compensated:
    """Returns joint values for the commanded poses, by the identified robot and by the nominal one.

    Of several branches, the one nearest to the nominal joint values is taken, else to the commanded ones; if it is
    beyond a limit, no other instead. With neither, the first pose gets the branch nearest to the middle of the limits,
    and every other the one nearest to that of the pose before.

    Parameters
    ----------
    identified : as it is; mm, rad.
    targets : m commanded poses base_from_tool; of files from :func:`read_targets`; in memory, with tools or joint
        values, ``Targets("targets", range(1, m + 1), tools, poses, q)``.
    nominal : the model in its controller.

    Returns
    -------
    Compensated : joint vectors (m, n) to command, rad or mm, and for each whether it reaches its pose; poses out of
        reach raise no error.

    Raises InputError: joint values without poses need the nominal robot; robots of different joints, or too far apart
    to be one; an unknown tool; poses to which their joint values lead in another unit or convention only.
    """
    if isinstance(targets, Poses):
        m = len(targets)
        targets = Targets("targets", range(1, m + 1), ("",) * m, targets, None)
    both = [identified] if nominal is None else [identified, nominal]
    builds = [[(joint.type, each.tree.after(i)) for i, joint in enumerate(each.joints)] for each in both]
    if builds[0] != builds[-1]:
        who = f"nominal robot {both[-1].name} and identified robot {identified.name}"
        fault = f"{who}: joints of different number, type or order"
        raise InputError("E-ROBOT-MISMATCH", f"{fault}; files of the same robot needed")
    if nominal is None and targets.poses is None:
        remedy = "only the nominal robot can tell which poses they command; give its file with --nominal"
        raise InputError("E-TARGETS-NO-POSES", f"{targets.where}: joint values without poses; {remedy}")
    doubts, others = (), ()
    rigid = targets.conditions.ignored(f"robot {identified.name}") if identified.elasticity is None else ()
    if nominal is not None:
        apart = robots_apart(identified, nominal)
        doubts = ((apart,) if apart else ()) + _roles(identified, nominal)
        if targets.poses is None and targets.q is not None and len(targets) > 2:
            most = np.degrees(np.abs(targets.q[:, ~identified.prismatic]).max(initial=0))
            radians = f"joint values are {most:.3g}° at most, as of radians in columns of degrees"
            doubts += (f"{radians}: if so, call the columns q1_rad …",) if most <= 2 * np.pi else ()
        identified, nominal, others = _with_one_tool(identified, nominal, targets)
    commander = nominal or identified
    confirmed, of_targets = on_targets(commander, targets)
    poses = poses_of(commander, targets, targets.joints()) if targets.poses is None else targets.poses
    before, off, near, known = None, np.zeros((0, 6)), targets.q, np.full(len(targets), confirmed)
    if nominal is not None:
        before = joints_of(nominal, targets, poses, targets.q)
        off, near, known = poses.difference(poses_of(identified, targets, before.q)), before.q, before.usable
    found = joints_of(identified, targets, poses, near)
    found, beyond = _stayed(identified, targets, poses, near, found, known)
    return Compensated(
        targets=targets,
        poses=poses,
        found=found,
        nominal=before,
        before_mm=np.linalg.norm(off[:, 3:], axis=1),
        before_rad=np.linalg.norm(off[:, :3], axis=1),
        identified=identified,
        beyond=beyond,
        doubts=doubts + of_targets + others + rigid,
    )


def _roles(identified: Robot, nominal: Robot) -> tuple[str, ...]:
    """Returns a doubt if the files seem exchanged, or hold the same arm."""
    one, other = ((robot.rows, robot.elasticity, robot.tools) for robot in (identified, nominal))
    if one == other:
        same = f"identified robot {identified.name} and nominal robot {nominal.name} are the same"
        remedy = "give the file of identify with --robot, and the model in the controller with --nominal"
        return (f"{same}, so that nothing is compensated: {remedy}",)
    lengths = [np.array([[row.a, row.d] for row in robot.rows]) for robot in (identified, nominal)]
    drawn = [bool((np.abs(each / ROUND_MM - np.round(each / ROUND_MM)) < 1e-6).all()) for each in lengths]
    if drawn == [True, False]:
        as_drawn = f"identified robot {identified.name} has all lengths as drawn, in steps of {ROUND_MM:g} mm"
        exchanged = f"{as_drawn}, and nominal robot {nominal.name} has not, as if they were exchanged"
        return (f"{exchanged}: --robot takes the file of identify, --nominal the model in the controller",)
    return ()


def _stayed(
    robot: Robot, targets: Targets, poses: Poses, near: np.ndarray | None, inverse: Inverse, known: np.ndarray
) -> tuple[Inverse, dict[int, str]]:
    """Returns solutions in the configuration of ``near`` (m, n) where ``known`` (m,), and by row limits against it."""
    if near is None or not known.any() or len(robot.rows) > 6:
        return inverse, {}
    away = (np.abs(inverse.q - near)[:, ~robot.prismatic] > FAR_RAD).any(axis=1)
    rows = np.flatnonzero(known & (away | np.array([status == LIMIT for status in inverse.status])))
    if not len(rows):
        return inverse, {}
    unlimited = _between(robot, np.tile([-np.inf, np.inf], (len(robot.rows), 1)))
    free = joints_of(unlimited, targets[rows], poses[rows], near[rows])
    found, beyond = inverse, {}
    for i, q in zip(rows[free.usable].tolist(), free.q[free.usable], strict=True):
        reason, usable = _beyond(robot, q), inverse.usable[i]
        if not reason or (usable and np.abs(q - inverse.q[i]).max() <= SAME_BRANCH):
            continue
        beyond[i] = reason
        if usable:
            ends = np.column_stack([np.minimum(near[i], q), np.maximum(near[i], q)])
            limits = ends.clip(*robot.limits().T[:, :, None])
            at = joints_of(_between(robot, limits), targets[[i]], poses[[i]], near[[i]])
            found = found.with_rows([i], replace(at, status=(LIMIT,)))
    return found, beyond


def _between(robot: Robot, limits: np.ndarray) -> Robot:
    """Returns the robot with other limits (n, 2); those of a joint that cannot move differ in the last bit."""
    low, high = limits[:, 0], np.maximum(limits[:, 1], np.nextafter(limits[:, 0], np.inf))
    ends = zip(robot.joints, low.tolist(), high.tolist(), strict=True)
    return replace(robot, joints=tuple(Joint(own.type, *limit) for own, *limit in ends))


def _beyond(robot: Robot, q: np.ndarray) -> str:
    """Returns the joints of (n,) that are beyond their limits, with both values, as text; empty if there is none."""
    limit, units = np.clip(q, *robot.limits().T), np.where(robot.prismatic, " mm", "°")
    said = zip(q * robot.shown, units, limit * robot.shown, np.abs(q - limit) > SAME_BRANCH, strict=True)
    return " and ".join(
        f"J{i} at {value:.6g}{unit}, limit {end:.6g}{unit}" for i, (value, unit, end, far) in enumerate(said, 1) if far
    )


def joint_columns(robot: Robot) -> list[str]:
    """Returns the column names ``q1_deg`` …, and ``q3_mm`` for prismatic joints."""
    return [f"q{i}_{'mm' if sliding else 'deg'}" for i, sliding in enumerate(robot.prismatic, 1)]


def _by_column(found: Inverse, robot: Robot) -> list[dict[str, float] | None]:
    rows, columns = zip((found.q * robot.shown).tolist(), found.usable, strict=True), joint_columns(robot)
    return [dict(zip(columns, q, strict=True)) if usable else None for q, usable in rows]


def joint_cells(robot: Robot, q: np.ndarray) -> list[str]:
    """Returns a joint vector in the units of :func:`joint_columns`, to nine decimals (a millionth of a µm of arc)."""
    return [f"{value:.9f}" for value in q * robot.shown]


@require_arguments
def compensated_csv(result: Compensated, robot: Robot, sigma_mm: Sequence[float] | np.ndarray = ()) -> str:
    """Returns the CSV of the joint values of ``result`` for its ``robot``, empty where a pose is not reached.

    Joint values in degrees or mm, what errors they leave, mm and degrees (form: ``data_layout.md``), and ``sigma_mm`` :
    predicted σ of the tool's position there, if known; nan if not reached, an empty cell.
    """
    columns, names = joint_columns(robot), result.targets.names
    head = [*names, "line", "target", *columns, "status", "error_mm", "error_deg"]
    if result.nominal:
        head += [*(f"nominal_{c}" for c in columns), "nominal_status", "nominal_error_mm", "nominal_error_deg"]
    rows: list[Sequence] = [[*head, "sigma_mm"] if len(sigma_mm) else head]

    def cells(inverse: Inverse, i: int, mm: np.ndarray, rad: np.ndarray, shown: bool = True) -> list[str]:
        values = joint_cells(robot, inverse.q[i]) if inverse.usable[i] else [""] * len(columns)
        errors = [f"{mm[i]:.6f}", f"{np.degrees(rad[i]):.6f}"] if shown else ["", ""]
        return [*values, inverse.status[i], *errors]

    for i, line in enumerate(result.targets.lines):
        row = [*(own[i] for own in names.values()), line, result.targets.tools[i]]
        row += cells(result.found, i, result.found.error_mm, result.found.error_rad)
        if (nominal := result.nominal) is not None:
            row += cells(nominal, i, result.before_mm, result.before_rad, bool(nominal.usable[i]))
        rows.append(row + ["" if np.isnan(sigma) else f"{sigma:.6f}" for sigma in sigma_mm[i : i + 1]])
    return csv_text(rows)


OF_POSES = Named("status error_mm error_rad")


class CompensationFile(ResultFile):
    """Result file of ``compensate``."""

    format: Literal["stcal compensation 1"] = Field(description="the file's form and its version")
    robot: str = Field(validation_alias=AliasPath("identified", "name"), description="name")
    lines: Annotated[list[int], BeforeValidator(list)] = Field(
        validation_alias=AliasPath("targets", "lines"), description="of the poses in the file"
    )
    poses: Annotated[
        np.ndarray,
        Shape((None, 4, 4)),
        BeforeValidator(lambda poses: poses.matrix() if isinstance(poses, Poses) else poses),
    ] = Field(description="commanded base_from_tool, mm")
    joints: list[dict[str, float] | None] = Field(description="joint values by column name; null if not reached")
    found: Annotated[Inverse, OF_POSES] = Field(
        description="`status` of each pose, and what remains: `error_mm`, `error_rad`"
    )
    nominal_joints: list[dict[str, float] | None] | None = Field(description="the same of the nominal robot")
    nominal: Annotated[Inverse, OF_POSES] | None = Field(
        description="the same of the nominal robot: `status`, `error_mm`, `error_rad`"
    )
    before_mm: Vector = Field(description="error of the nominal joint values by the identified robot, where reached")
    before_rad: Vector = Field(description="the same of the orientation")
    notes: list[str] = Field(
        validation_alias="remarks", description="columns not read, doubts of targets and robots, rows hardly reached"
    )


def compensated_summary(result: Compensated) -> list[str]:
    """Returns sentences on all poses together."""
    lines = [f"{int(result.found.usable.sum())} of {len(result)} poses reached by the identified robot"]
    both = result.compared()
    if both.any():
        before, after = result.before_mm[both], max(result.found.error_mm[both].max(), 1e-6)
        lines.append(
            f"position error of the nominal joint values, by the identified robot: mean {before.mean():.4f}, "
            f"max {before.max():.4f} mm; after compensation {after:.1g} mm or less. The real robot errs by more: by "
            "about the error of rows held out that identify stated"
        )
    return lines
