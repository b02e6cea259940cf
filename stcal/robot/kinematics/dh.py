"""From a chain of axes back to Denavit–Hartenberg rows, with Hayati's β where two axes are nearly parallel."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.forward import joint_frames
from stcal.robot.kinematics.model import (
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

PARALLEL_RAD = np.radians(1.0)
"""Below this the foot of the common normal is far away and moves by metres with micro-radians: Hayati's β instead."""
SAME_AXIS_MM = 1e-10
"""Parallel axes closer than this are one line, as of a SCARA's spindle: any θ does, the nominal one is kept."""

ROUNDING, ROUNDING_MM = 1e-12, 1e-9
"""What products of a dozen transforms leave of an equality."""
NOTHING_MM, NOTHING_RAD = 1e-12, 1e-14
"""By which no tool is moved by 1e-10 mm."""


def robot_from_chain(chain: Chain, tools: Mapping[str, Rigid], nominal: Robot) -> Robot:
    """The robot whose rows, base and tools make the same poses as ``chain`` with ``tools`` (flange_from_tool).

    What a chain does not determine is kept from ``nominal``: θ and d of the first row (the base may turn and slide
    along the first axis) and the whole part of the last row after its joint (the tools may do so along the last), a and
    d of a prismatic joint, d of a row with β.
    """
    n = len(chain)
    rows = list(nominal.rows)
    standard = nominal.convention == "standard"
    mounts = {} if nominal.tree is None else nominal.tree.mounts
    begins = {0, *mounts}
    first = dict.fromkeys(begins, Rigid())
    passed = [Rigid()] * n  # what a joint lets through: a turn and a slide about its axis (any, if prismatic)
    for i in sorted(set(range(n)) - begins):
        gap = passed[i - 1] @ chain.gap(i)
        before = rows[i - 1]
        after = before if standard else rows[i]
        wanted = DHRow(after.a, after.alpha, before.d, before.theta, after.beta)
        found = _row_between(gap, wanted, bool(chain.prismatic[i]))
        passed[i] = (along(found) @ across(found)).inverse() @ gap
        if i - 1 in begins:  # base or mount takes what differs from the nominal first row
            first[i - 1] = Rigid(about_z(found.theta - before.theta), [0.0, 0.0, found.d - before.d])
            passed[i - 1] = first[i - 1].inverse()
            found = replace(found, theta=before.theta, d=before.d)
        if standard:
            rows[i - 1] = found
        else:
            rows[i - 1] = replace(before, theta=found.theta, d=found.d)
            rows[i] = replace(after, a=found.a, alpha=found.alpha, beta=found.beta)

    def begin(i: int) -> Rigid:
        """Where the first row of a branch begins in the frame that its carrier's row ends in."""
        place = chain.gap(i) @ first[i]
        return place if standard else place @ across(rows[i]).inverse()

    def end(i: int) -> Rigid:
        """Joint i as in ``chain`` in the frame that its row ends in."""
        nominal_end = along(rows[i]) @ across(rows[i]) if standard else along(rows[i])
        return nominal_end.inverse() @ passed[i]

    ends = [chain.last_from_flange] * n if chain.grown is None else chain.grown.ends
    base, tree = begin(0), nominal.tree
    if tree is not None:
        before = {i: end(after) if after >= 0 else base.inverse() for i, (after, _) in mounts.items()}
        tree = replace(tree, mounts={i: (after, before[i] @ begin(i)) for i, (after, _) in mounts.items()})
    robot = replace(
        nominal,
        rows=tuple(rows),
        world_from_base=base,
        tools={name: end(k := chain.carrier(name)) @ ends[k] @ tool for name, tool in tools.items()},
        elasticity=None,
        tree=tree,
    )
    return replace(robot, elasticity=_elasticity(robot, chain, nominal))


def _elasticity(robot: Robot, chain: Chain, nominal: Robot) -> Elasticity | None:
    """That of ``chain`` in the frames of ``robot``, which are turned about the joints' axes, and slid along them: by so
    little, or of so stiff an arm, that what it gives way by stays; loads are where ``nominal`` says."""
    elasticity = chain.elasticity
    if elasticity is None:
        return None
    zero = np.zeros((1, len(chain)))
    rigid = replace(chain, elasticity=None)
    turn = np.swapaxes(joint_frames(robot.chain(), zero)[0], 2, 3) @ joint_frames(rigid, zero)[0]
    gravity = robot.world_from_base.rotation.T @ chain.rotation[0] @ elasticity.gravity
    moment = (turn[:, 0] @ elasticity.moment[:, :, None])[:, :, 0]
    centre = np.zeros(3) if nominal.elasticity is None else nominal.elasticity.payload_centre
    return replace(elasticity, moment=moment, gravity=gravity, payload_centre=centre)


def _row_between(gap: Rigid, nominal: DHRow, to_prismatic: bool) -> DHRow:
    """θ, d of the joint before and a, α, β up to the next axis, ``gap`` being known up to what that lets through."""
    z, place = gap.rotation[:, 2], gap.translation
    sine = float(np.hypot(z[0], z[1]))
    parallel = sine < np.sin(PARALLEL_RAD)
    if parallel:
        theta = nominal.theta
        if not to_prismatic:
            x, y = place[:2] + (nominal.d - place[2]) / z[2] * z[:2]
            offset = float(np.hypot(x, y))
            sign = -1.0 if nominal.a < 0 else 1.0
            a = sign * offset
            if offset > SAME_AXIS_MM:
                theta = _near(float(np.arctan2(sign * y, sign * x)), nominal.theta)
        else:
            a = nominal.a
        seen = about_z(-theta) @ z  # (sin β, −sin α cos β, cos α cos β)
        alpha = _near(float(np.arctan2(-seen[1], seen[2])), nominal.alpha)
        return DHRow(a, alpha, nominal.d, theta, float(np.arcsin(seen[0])))
    sign = -1.0 if np.sin(nominal.alpha) < 0 else 1.0
    alpha = _near(float(np.arctan2(sign * sine, z[2])), nominal.alpha)
    theta = _near(float(np.arctan2(sign * z[0], -sign * z[1])), nominal.theta)
    if to_prismatic:
        return DHRow(nominal.a, alpha, nominal.d, theta)
    seen = about_z(-theta) @ place  # (a, −ψ sin α, d + ψ cos α), ψ along the next axis
    slide = -seen[1] / np.sin(alpha)
    return DHRow(float(seen[0]), alpha, float(seen[2] - slide * np.cos(alpha)), theta)


def _near(angle: float, nominal: float) -> float:
    """The same angle in the turn around the nominal one."""
    return angle + 2 * np.pi * round((nominal - angle) / (2 * np.pi))


def robot_between(
    chain: Chain, tools: Mapping[str, Rigid], name: str, convention: Convention, joints: tuple[Joint, ...]
) -> Robot:
    """A robot of these axes and tools (flange_from_tool) that has no nominal one.

    Its first row begins at the chain's base, and its last ends at the chain's flange, where a row can; else the base,
    and the tools, take what is left.
    """
    bare = Robot(name, convention, (DHRow(0.0, 0.0, 0.0, 0.0),) * len(chain), joints, chain.coupling)
    hints = list(bare.rows)
    found = _with_ends(chain, tools, bare)
    for i in range(len(hints) - 1):  # of the two x axes along each common normal the one within 90° of the last
        if abs(found.rows[i].theta) > np.pi / 2 + ROUNDING:
            k = i if convention == "standard" else i + 1
            hints[k] = DHRow(-found.rows[k].a, -found.rows[k].alpha, 0.0, 0.0)
            found = _with_ends(chain, tools, replace(bare, rows=tuple(hints)))
    rows = [DHRow(_length(r.a), _angle(r.alpha), _length(r.d), _angle(r.theta), _angle(r.beta)) for r in found.rows]
    return replace(found, rows=tuple(rows))


def _with_ends(chain: Chain, tools: Mapping[str, Rigid], nominal: Robot) -> Robot:
    """With a first row from the chain's base and a last one to its flange, where there are such."""
    rows, modified = list(nominal.rows), nominal.convention == "modified"
    bare = robot_from_chain(chain, {"": Rigid()}, nominal)
    if (end := _row_of(bare.tool(), modified=False, across_too=not modified)) is not None:
        rows[-1] = end if not modified else replace(rows[-1], d=end.d, theta=end.theta)
    if len(rows) > 1 and (begin := _row_of(bare.world_from_base, modified, across_too=modified)) is not None:
        rows[0] = begin if modified else replace(rows[0], d=begin.d, theta=begin.theta)
    found = robot_from_chain(chain, tools, replace(nominal, rows=tuple(rows)))
    base = found.world_from_base
    at_base = np.abs(base.translation).max() < ROUNDING_MM and np.abs(base.rotation - np.eye(3)).max() < ROUNDING
    return replace(found, world_from_base=Rigid()) if at_base else found


def _row_of(pose: Rigid, modified: bool, across_too: bool) -> DHRow | None:
    """The row without β that makes this pose, alone or as its part along the axis; None where none does."""
    r, p = pose.rotation, pose.translation
    if not across_too:
        row = DHRow(0.0, 0.0, float(p[2]), float(np.arctan2(r[1, 0], r[0, 0])))
    elif modified:
        alpha = float(np.arctan2(-r[1, 2], r[2, 2]))
        d = float(r[1, 2] * p[1] + r[2, 2] * p[2])
        row = DHRow(float(p[0]), alpha, d, float(np.arctan2(-r[0, 1], r[0, 0])))
    else:
        theta = float(np.arctan2(r[1, 0], r[0, 0]))
        a = float(np.cos(theta) * p[0] + np.sin(theta) * p[1])
        row = DHRow(a, float(np.arctan2(r[2, 1], r[2, 2])), float(p[2]), theta)
    made = across(row) @ along(row) if modified else along(row) @ across(row)
    fits = np.abs(made.rotation - r).max() < ROUNDING and np.abs(made.translation - p).max() < ROUNDING_MM
    return row if fits else None


def _length(value: float) -> float:
    """0 where rounding left something."""
    return 0.0 if abs(value) < NOTHING_MM else value


def _angle(value: float) -> float:
    """Whole right angles where rounding left something."""
    right = np.pi / 2 * round(value / (np.pi / 2))
    return right if abs(value - right) < NOTHING_RAD else value
