"""Denavit-Hartenberg rows from a chain of axes, and checks of poses against joint values."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.explain import Candidate, explain
from stcal.geometry.rigid import Rigid
from stcal.io.rotations import EXPLAINS, READINGS
from stcal.robot.kinematics.forward import joint_frames
from stcal.robot.kinematics.robot_model import (
    Chain,
    Convention,
    DHRow,
    Elasticity,
    Joint,
    Robot,
    about_z,
    across,
    along,
)

PARALLEL_RAD, SAME_AXIS_MM = np.radians(1.0), 1e-10
"""Angle between axes below which Hayati's β is used; distance below which parallel ones are one line, and θ is free."""
ROUNDING, ROUNDING_MM, NOTHING_MM, NOTHING_RAD = 1e-12, 1e-9, 1e-12, 1e-14
"""Rounding of a product of a dozen transforms; length and angle that are rounded to zero."""


def robot_from_chain(chain: Chain, tools: Mapping[str, Rigid], nominal: Robot) -> Robot:
    """Returns the robot whose rows, base and tools give the same poses as ``chain`` with ``tools`` (flange_from_tool).
    What a chain does not determine is kept from ``nominal``: θ and d of the first row, the part of the last row after
    its joint, a and d of a prismatic joint, and d of a row with β."""
    n = len(chain)
    rows = list(nominal.rows)
    standard = nominal.convention == "standard"
    mounts = nominal.tree.mounts
    begins = {0, *mounts}
    first = dict.fromkeys(begins, Rigid())
    passed = [Rigid()] * n  # free motion of a joint: about its axis and along it (if prismatic, any slide)
    for i in sorted(set(range(n)) - begins):
        gap = passed[i - 1] @ chain.gap(i)
        before = rows[i - 1]
        after = before if standard else rows[i]
        wanted = DHRow(after.a, after.alpha, before.d, before.theta, after.beta)
        found = _row_between(gap, wanted, bool(chain.prismatic[i]))
        passed[i] = (along(found) @ across(found)).inverse() @ gap
        if i - 1 in begins:  # base or mount absorbs the difference from the nominal first row
            first[i - 1] = Rigid(about_z(found.theta - before.theta), [0.0, 0.0, found.d - before.d])
            passed[i - 1] = first[i - 1].inverse()
            found = replace(found, theta=before.theta, d=before.d)
        if standard:
            rows[i - 1] = found
        else:
            rows[i - 1] = replace(before, theta=found.theta, d=found.d)
            rows[i] = replace(after, a=found.a, alpha=found.alpha, beta=found.beta)

    def begin(i: int) -> Rigid:
        """Returns the start of a branch's first row in the frame at the end of its carrier's row."""
        place = chain.gap(i) @ first[i]
        return place if standard else place @ across(rows[i]).inverse()

    def end(i: int) -> Rigid:
        """Returns the pose of joint i of ``chain`` relative to the frame at the end of its row."""
        nominal_end = along(rows[i]) @ across(rows[i]) if standard else along(rows[i])
        return nominal_end.inverse() @ passed[i]

    base = begin(0)
    before = {i: end(after) if after >= 0 else base.inverse() for i, (after, _) in mounts.items()}
    tree = replace(nominal.tree, mounts={i: (after, before[i] @ begin(i)) for i, (after, _) in mounts.items()})
    on_flange = {name: end(k := chain.carrier(name)) @ chain.ends[k] @ tool for name, tool in tools.items()}
    robot = replace(nominal, rows=tuple(rows), world_from_base=base, tools=on_flange, elasticity=None, tree=tree)
    if chain.elasticity is None:
        return robot
    return replace(robot, elasticity=_elasticity(robot, chain, chain.elasticity, end(chain.carrier(""))))


def _elasticity(robot: Robot, chain: Chain, elasticity: Elasticity, flange_from_loaded: Rigid) -> Elasticity:
    """Returns the elasticity of ``chain`` in the joint frames of ``robot``: pivots keep their points."""
    zero = np.zeros((1, len(chain)))
    of_rows, rows_at = joint_frames(robot.chain(), zero)
    of_chain, chain_at = joint_frames(replace(chain, elasticity=None), zero)
    back = np.swapaxes(of_rows, 2, 3)[:, 0]
    turn = back @ of_chain[:, 0]
    moment = (turn @ elasticity.moment[:, :, None])[:, :, 0]
    pivot = (back @ (chain_at - rows_at)[:, 0, :, None])[:, :, 0]
    pivot[~chain.prismatic, :2] = 0.0  # rounding: the frames share their axes
    return replace(
        elasticity,
        moment=moment,
        pivot=np.where(np.abs(pivot) < ROUNDING_MM, 0.0, pivot),
        gravity=robot.world_from_base.rotation.T @ chain.rotation[0] @ elasticity.gravity,
        payload_centre=flange_from_loaded @ elasticity.payload_centre,
    )


def _row_between(gap: Rigid, nominal: DHRow, to_prismatic: bool) -> DHRow:
    """Returns the row with θ, d of the previous joint and a, α, β to the next axis, up to that joint's motion."""
    z, place = gap.rotation[:, 2], gap.translation
    sine = float(np.hypot(z[0], z[1]))
    if sine < np.sin(PARALLEL_RAD):
        a, theta = nominal.a, nominal.theta
        if not to_prismatic:
            x, y = place[:2] + (nominal.d - place[2]) / z[2] * z[:2]
            sign = -1.0 if nominal.a < 0 else 1.0
            a = sign * float(np.hypot(x, y))
            if abs(a) > SAME_AXIS_MM:
                theta = _near(float(np.arctan2(sign * y, sign * x)), nominal.theta)
        rotated = about_z(-theta) @ z  # (sin β, −sin α cos β, cos α cos β)
        alpha = _near(float(np.arctan2(-rotated[1], rotated[2])), nominal.alpha)
        return DHRow(a, alpha, nominal.d, theta, float(np.arcsin(rotated[0])))
    sign = -1.0 if np.sin(nominal.alpha) < 0 else 1.0
    alpha = _near(float(np.arctan2(sign * sine, z[2])), nominal.alpha)
    theta = _near(float(np.arctan2(sign * z[0], -sign * z[1])), nominal.theta)
    if to_prismatic:
        return DHRow(nominal.a, alpha, nominal.d, theta)
    rotated = about_z(-theta) @ place  # (a, −ψ sin α, d + ψ cos α), ψ along the next axis
    slide = -rotated[1] / np.sin(alpha)
    return DHRow(float(rotated[0]), alpha, float(rotated[2] - slide * np.cos(alpha)), theta)


def _near(angle: float, nominal: float) -> float:
    """Returns ``angle`` plus the multiple of 2π that brings it nearest to ``nominal``."""
    return angle + 2 * np.pi * round((nominal - angle) / (2 * np.pi))


def robot_between(
    chain: Chain, tools: Mapping[str, Rigid], name: str, convention: Convention, joints: tuple[Joint, ...]
) -> Robot:
    """Returns the robot with these axes and tools, without a nominal one; base and tools absorb what rows cannot."""
    bare = Robot(name, convention, (DHRow(0.0, 0.0, 0.0, 0.0),) * len(chain), joints, chain.coupling, unusual_size=True)
    hints = list(bare.rows)
    robot = _with_ends(chain, tools, bare)
    for i in range(len(hints) - 1):  # the x axis along each common normal is within 90° of the previous one
        if abs(robot.rows[i].theta) > np.pi / 2 + ROUNDING:
            k = i if convention == "standard" else i + 1
            hints[k] = DHRow(-robot.rows[k].a, -robot.rows[k].alpha, 0.0, 0.0)
            robot = _with_ends(chain, tools, replace(bare, rows=tuple(hints)))
    rows = np.array([astuple(row) for row in robot.rows])  # without rounding errors of lengths of 0 and right angles
    exact = np.pi / 2 * np.round(rows / (np.pi / 2)) * [0, 1, 0, 1, 1] + 0.0  # not -0
    rounded = np.abs(rows - exact) < [NOTHING_MM, NOTHING_RAD, NOTHING_MM, NOTHING_RAD, NOTHING_RAD]
    return replace(robot, rows=tuple(DHRow(*row) for row in np.where(rounded, exact, rows).tolist()))


def _with_ends(chain: Chain, tools: Mapping[str, Rigid], nominal: Robot) -> Robot:
    """Returns the robot with a first row from the chain's base and a last row to its flange, where such rows exist."""
    rows, modified = list(nominal.rows), nominal.convention == "modified"
    bare = robot_from_chain(chain, {"": Rigid()}, nominal)
    if (end := _row_of(bare.tool(), whole=not modified)) is not None:
        rows[-1] = end if not modified else replace(rows[-1], d=end.d, theta=end.theta)
    base = bare.world_from_base
    begin = _row_of(base.inverse() if modified else base, whole=modified)  # a modified row is a standard one backwards
    if len(rows) > 1 and begin is not None:
        back = (0.0 - v for v in (begin.a, begin.alpha, begin.d, begin.theta))  # not −0
        rows[0] = DHRow(*back) if modified else replace(rows[0], d=begin.d, theta=begin.theta)
    robot = robot_from_chain(chain, tools, replace(nominal, rows=tuple(rows)))
    base = robot.world_from_base
    at_base = np.abs(base.translation).max() < ROUNDING_MM and np.abs(base.rotation - np.eye(3)).max() < ROUNDING
    return replace(robot, world_from_base=Rigid()) if at_base else robot


def _row_of(pose: Rigid, whole: bool) -> DHRow | None:
    """Returns the standard row without β that gives this pose, or None; only with d and θ unless ``whole``."""
    r, p = pose.rotation, pose.translation
    theta = float(np.arctan2(r[1, 0], r[0, 0]))
    a = float(np.cos(theta) * p[0] + np.sin(theta) * p[1]) if whole else 0.0
    row = DHRow(a, float(np.arctan2(r[2, 1], r[2, 2])) if whole else 0.0, float(p[2]), theta)
    pose_of_row = along(row) @ across(row)
    fits = np.abs(pose_of_row.rotation - r).max() < ROUNDING and np.abs(pose_of_row.translation - p).max() < ROUNDING_MM
    return row if fits else None


FITS, TURNED_RAD = 0.05, 0.2
"""Largest RMS error of a nominal robot over the spread of its data, and of orientations: twice what robots err by."""


def require_orientations(
    where: str, targets: Sequence[str], flange: np.ndarray, seen: np.ndarray, many: bool = True
) -> None:
    """Refuses orientations of which most are not those of the robot, whatever its tools, by InputError. ``where`` :
    name of the file; ``targets`` : (m,) of the rows; ``flange``, ``seen`` : (m, 3, 3) rotations by the model, and of
    the targets as read; ``many`` : False for few rows, which are refused only if quaternions of another convention fit.
    One orientation in all rows is no misreading."""
    own = _typical_rad(targets, flange, seen)
    if own < TURNED_RAD or np.ptp(seen, axis=0).max() < NOTHING_RAD:
        return
    found = explain(
        (Candidate(f"quaternions were {each.held}; {each.remedy}", partial(each.rotations, seen)) for each in READINGS),
        lambda read: _typical_rad(targets, flange, read),
        EXPLAINS * own,
    )
    missed = f"{where}: orientations typically miss the robot by {np.degrees(own):.3g}°, {np.degrees(TURNED_RAD):.2g}°"
    for best, left in found[:1]:
        raise InputError("E-ROBOT-ORIENTATIONS", f"{missed} allowed; by {np.degrees(left):.2g}° if {best.words}")
    if many:
        remedy = "check the convention of the angles and that each orientation is in the line of its joint values"
        fault = f"{missed} allowed, though positions fit"
        raise InputError("E-ROBOT-ORIENTATIONS", f"{fault}; {remedy}, or leave the orientations out")


def _typical_rad(targets: Sequence[str], flange: np.ndarray, seen: np.ndarray) -> float:
    """Returns the median angle from the tool of each target for which the median of its rows is least, rad."""
    between, angles = np.swapaxes(flange, 1, 2) @ seen, []
    for name in dict.fromkeys(targets):
        own = Rotation.from_matrix(between[[target == name for target in targets]])
        tools = own[:: 1 + len(own) // 200]  # so many are tried for the one that most rows agree with
        off = [(tool.inv() * own).magnitude() for tool in tools]
        angles.append(min(off, key=np.median))
    return float(np.median(np.concatenate(angles)))
