"""Whether commanded poses and the nominal robot can be meant as they stand: against joint values and the arm's reach.

What joint values beside the poses prove is refused; what only the arm's reach makes doubtful is a note.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.quaternions import EXPLAINS, READINGS
from stcal.io.table import LENGTHS, UNIT_WORDS
from stcal.robot.kinematics.damped import reach_mm
from stcal.robot.kinematics.dh import FITS, TURNED_RAD, require_convention
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import Inverse
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.targets import Targets, joints_of, poses_of, rows_by_tool

UNITS = ("m", "in")
"""What columns of mm may hold; of micrometres no arm would reach anything, and a tenth, of cm, may be meant."""
USUAL = 0.01
"""Usual error as a fraction of the reach: ten times the manufacturing tolerance, or all zeros off by half a degree."""
SAMPLE = 50
"""Joint vectors at which two robots are compared."""
DOUBTED, LEAST, TRIED = 0.25, 4, 8
"""Share and number of targets out of reach from which on another convention is looked for, and how many it must bring
within reach, all of them: by chance each is, half the time, so that one of six conventions is in 2 of 100 sets of 8."""
PAIRED = 0.01
"""Distance, shares of the reach and chords of the rotation, of poses that are those of joint values in other rows."""
INVERSE = "poses were inverse (base seen from the tool); give the tool in the base's frame"


def robots_apart(identified: Robot, nominal: Robot) -> str:
    """A doubt whether two files are of one robot; empty where they well may be.

    Their flanges are compared over the joints' ranges; arms are made to a thousandth of their reach, and files of one
    arm state the same base and flange, whichever tool they have.

    Raises
    ------
    InputError
        They cannot be.
    """
    ends = [""] if identified.tree is None else list(identified.tree.carriers)
    identified, nominal = (replace(each, tools=dict.fromkeys(ends, Rigid())) for each in (identified, nominal))
    rng = np.random.default_rng(0)
    limits = identified.limits()
    half = np.where(identified.prismatic, reach_mm(identified, ends[0]), np.pi)
    low, high = (
        np.where(np.isfinite(limits[:, 0]), limits[:, 0], -half),
        np.where(np.isfinite(limits[:, 1]), limits[:, 1], half),
    )
    q = rng.uniform(low, high, (SAMPLE, len(half)))
    off = [forward(identified, q, end).translation - forward(nominal, q, end).translation for end in ends]
    apart, reach = max(map(_rms, off)), max(reach_mm(each, end) for each in (identified, nominal) for end in ends)
    if apart <= USUAL * reach:
        return ""
    said = (
        f"nominal robot {nominal.name} and identified robot {identified.name} are {apart:.4g} mm apart at the same "
        "joint values (RMS)"
    )
    if apart > FITS * reach:
        raise InputError(
            "E-ROBOT-MISMATCH",
            f"{said}, {FITS * reach:.3g} mm allowed, {FITS:.0%} of the reach: files of the same robot needed; check "
            "units, D-H rows, convention and coupling of both",
        )
    return f"{said}, more than arms are off their drawing ({USUAL:.0%} of the reach): are both files of this robot?"


def on_targets(robot: Robot, targets: Targets) -> tuple[bool, tuple[str, ...]]:
    """Whether joint values beside them confirm the poses, and what is doubtful about them.

    Parameters
    ----------
    robot : Robot
        That commands them.
    targets : Targets
        m poses base_from_tool, with or without joint values.

    Raises
    ------
    InputError
        Joint values lead to the poses in another unit or convention, or order of rows; the message says which.
    """
    if targets.poses is None:
        return True, ()
    if targets.q is None:
        return False, _near_base(robot, targets, targets.poses)
    reached, reach = poses_of(robot, targets, targets.q), reach_mm(robot)
    own = _rms(reached.translation - targets.poses.translation)
    if own <= FITS * reach:
        require_convention(targets.where, targets.tools, reached.rotation, targets.poses.rotation)
    else:
        _explain(robot, targets, targets.poses, targets.q, own, reach)
    notes = _elsewhere(targets, targets.poses.difference(reached), reach)
    return not notes, notes + (_near_base(robot, targets, targets.poses) if notes else ())


def position_misfit_mm(robot: Robot, targets: Targets) -> float:
    """Returns the RMS distance between the positions that joint values reach and those of the poses of their rows."""
    if targets.poses is None:
        raise InputError("E-TARGETS-NO-POSES", f"{targets.where}: joint values without poses; columns x_mm … qz needed")
    return _rms(poses_of(robot, targets, targets.joints()).translation - targets.poses.translation)


def _rms(shift: np.ndarray) -> float:
    """Returns the RMS length of vectors (m, 3)."""
    return float(np.sqrt((shift**2).sum(axis=1).mean()))


def _explain(robot: Robot, targets: Targets, poses: Poses, q: np.ndarray, own: float, reach: float) -> None:
    """Refuse poses to which the joint values would lead but for a frequent mistake.

    One row beside the right place by chance: within 5 % of the reach and 11°, once in 10⁶.
    """
    for reason, meant, of in _guesses(robot, targets, poses, q):
        off = meant.difference(of)
        left, turn = _rms(off[:, 3:]), _rms(off[:, :3])
        if left < min(FITS * reach, EXPLAINS * own) and turn < TURNED_RAD:
            raise InputError(
                "E-ROBOT-MISMATCH",
                f"{targets.where}: joint values of robot {robot.name} lead {own:.4g} mm (RMS) away from their poses, "
                f"{FITS * reach:.3g} mm allowed, {FITS:.0%} of the reach; but {left:.3g} mm if {reason}",
            )


def _guesses(robot: Robot, targets: Targets, poses: Poses, q: np.ndarray) -> Iterator[tuple[str, Poses, Poses]]:
    """Frequent mistakes: what would be right, with poses and joint values' poses as if it were."""
    reached = poses_of(robot, targets, q)
    for unit in UNITS:
        yield (
            f"lengths were {UNIT_WORDS[unit]}; call the columns x_{unit} …",
            Poses(poses.rotation, LENGTHS[unit] * poses.translation),
            reached,
        )
    yield INVERSE, poses.inverse(), reached
    turned = q * np.where(robot.prismatic, 1.0, np.degrees(1.0))  # degrees in columns of radians: told where read
    reason = "joint values were radians in columns of degrees; call the columns q1_rad …"
    yield reason, poses, poses_of(robot, targets, turned)
    paired = _paired(targets, poses, reached, reach_mm(robot))
    if paired is not None:
        yield "joint values stood in other rows; give each pose its own", poses, paired


def _paired(targets: Targets, poses: Poses, reached: Poses, reach: float) -> Poses | None:
    """Returns for each pose the nearest pose ``reached`` with its tool, of any row. Returns None if the assignment is
    not one to one and very near: rough joint values that choose a branch are often nearer to another row's pose."""
    rows = np.arange(len(poses))
    for _, own in rows_by_tool(targets):
        tree, asked = (
            np.hstack([p.rotation[own].reshape(-1, 9), p.translation[own] / reach]) for p in (reached, poses)
        )
        away, found = KDTree(tree).query(asked)
        rows[own] = own[found]
        if away.max() > PAIRED:
            return None
    return reached[rows] if len(set(rows.tolist())) == len(rows) else None


def _elsewhere(targets: Targets, off: np.ndarray, reach: float) -> tuple[str, ...]:
    """Joint values that lead to other poses, by (m, 6); none of the same joint values in all rows, which only choose a
    branch."""
    mm, rad = np.linalg.norm(off[:, 3:], axis=1), np.linalg.norm(off[:, :3], axis=1)
    away = (mm > FITS * reach) | (rad > TURNED_RAD)
    if not away.any() or targets.q is None or (len(off) > 1 and not np.ptp(targets.q, axis=0).any()):
        return ()
    return (
        f"joint values of {away.sum()} of {len(off)} rows, first line {targets.lines[int(away.argmax())]}, lead "
        f"elsewhere than their poses, by {np.median(mm[away]):.4g} mm and {np.degrees(np.median(rad[away])):.3g}° "
        "(median): they only choose the branch; if they are those of the poses check order, units and conventions",
    )


def _near_base(robot: Robot, targets: Targets, poses: Poses) -> tuple[str, ...]:
    """Where all poses are so near to the base's origin that those in metres or inches would be within reach too: an
    arm has its foot there. 3 m in metres are 3 mm, in inches 118."""
    far = float(np.linalg.norm(poses.translation, axis=1).max())
    reach = max(reach_mm(robot, name) for name in set(targets.tools)) + _base_mm(robot)
    fitting = [unit for unit in UNITS if 0 < far * LENGTHS[unit] <= reach]
    if not fitting:
        return ()
    unit = fitting[0]
    return (
        f"all targets lie within {far:.3g} mm of the base's origin, where no arm works that reaches {reach:.4g} mm: if "
        f"the unit of x, y, z is {UNIT_WORDS[unit]}, call the columns x_{unit} …",
    )


def _base_mm(robot: Robot) -> float:
    """Returns the distance from the base's origin to the first joint, mm."""
    return float(np.linalg.norm(replace(robot, world_from_base=Rigid()).chain().translation[0]))


def out_of_reach(robot: Robot, targets: Targets, found: Inverse) -> tuple[str, ...]:
    """Where many poses are out of reach that all would be within in another convention."""
    lost = np.flatnonzero(~found.usable)
    if targets.poses is None or len(lost) < max(LEAST, DOUBTED * len(found)):
        return ()
    some = lost[np.unique(np.linspace(0, len(lost) - 1, TRIED).astype(int))]
    poses = targets.poses[some]
    guesses = {f"quaternions were {each.held}; {each.remedy}": each.poses(poses) for each in READINGS}
    guesses[INVERSE] = poses.inverse()
    for reason, meant in guesses.items():
        # Most guesses fail at once: a pose out of reach takes a third of a second.
        if all(
            joints_of(robot, targets[some[[i]]], meant[[i]], found.q[some[[i]]]).usable[0] for i in range(len(some))
        ):
            return (
                f"{len(lost)} of {len(found)} poses are out of reach; {len(some)} of {len(some)} of these that were "
                f"tried would be within if {reason}",
            )
    return ()
