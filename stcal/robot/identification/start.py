"""Start of an identification: base and tools fitted with the nominal axes; refuses data that do not fit the robot."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, combinations, product
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

from stcal.adjust.blocks import Vector
from stcal.adjust.engine import Adjustment
from stcal.errors import DegenerateError, InputError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import rms
from stcal.geometry.rigid import Poses, Rigid, align_rigid, best_rotations, by_pose
from stcal.io.rotations import EXPLAINS
from stcal.io.table import LENGTHS, UNIT_WORDS
from stcal.robot.identification.adjustment import State, observed, position_errors
from stcal.robot.identification.problem import USELESS_MM
from stcal.robot.kinematics.dh import FITS, require_orientations
from stcal.robot.kinematics.forward import carried_poses
from stcal.robot.kinematics.inverse import reach_mm
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot

Fit = frozenset[Literal["base", "tool"]]
BOTH: Fit = frozenset(("base", "tool"))
ROUNDS = 500
SETTLED, REGULAR = 1e-5, 1e-10
"""Largest predicted decrease of the last step, as a share of the squared misfit, which is compared with others; and
smallest damping, which keeps what these positions leave open at its start, as the point of a tool that never turned."""
NEARLY = 1e-3  # share of the squared misfit that the next step may still gain: of a wrong robot file the valley is flat
STILL_MM = 0.01
QUARTERS_DEG = (90, -90, 180)  # errors of a joint's zero by conventions of the home position
FAR, TRIMS, MOSTLY_NEAR = 4.0, 4, 0.7
"""Error in median errors from which a row is far off, largest number of fits without such rows, and least share of the
other rows. Of a wrong robot's errors few are so much larger than their median."""
MOST_NAMED, SHOWN = 3, 6
"""Largest numbers of mistakes that explain the data equally and are named, and of lines that a message names."""
GUESS_ROWS = 60
"""Largest number of rows by which mistakes in the rows are tried: far more than the nine numbers of base and tool."""
MOST_JOINTS = 8  # largest number of joints of which two at a time are tried
LEAST_ORIENTATIONS = 5
"""Number of rows from which on orientations that do not fit are refused: of fewer, chance explains many."""
AROUND = 0.1
"""Distance from the given tool point at which distances are fitted from other starts, as a share of the reach."""


def start(robot: Robot, data: Measurements, fit: Fit = BOTH) -> State:
    """Returns the nominal chain, with base and tools that fit best, or as given if not in ``fit``. Raises InputError:
    the robot does not fit; names a cause that does. Raises DegenerateError: a target moved on a line at most."""
    if data.positions is not None and len(set(data.stations)) > 1:
        return _with_stations(robot, data, fit)
    named = sorted(set(data.targets))
    _require_motion(data, named)
    carriers = robot.tree.carriers if robot.tree else named
    for name in (name for name in named if name not in carriers):
        target = f"target {name}" if name else "the tool of rows without a target"
        remedy = "give it a [[target]] with joint" if name else "give [tool] joint"
        fault = f"{data.where}: robot {robot.name} is a tree, and its file does not say which joint carries {target}"
        raise InputError("E-ROBOT-TREE", f"{fault}; {remedy}")
    default = robot.tools.get("", Rigid())
    tools = {name: robot.tools.get(name, default) if "tool" in fit else robot.tool(name) for name in named}
    state, misfit = _placed(robot, data, tools, fit)
    extent = _extent(data)
    if misfit > FITS * extent:
        missed = f"misses the measurements by {misfit:.3g} mm RMS, {FITS * extent:.3g} mm allowed"
        who, fault = f"{data.where}: robot {robot.name}", f"{missed}, {FITS:.0%} of their spread"
        if fit != BOTH and _placed(robot, data, tools)[1] <= FITS * extent:
            remedy = "it fits with base and tool fitted to them (base-tool)"
            raise InputError("E-IDENTIFY-MISFIT", f"{who} as its file stands {fault}; {remedy}")
        raise InputError("E-IDENTIFY-MISFIT", f"{who} {fault}; {_explanation(robot, data, tools, misfit / extent)}")
    if data.rotations is not None:
        flange = carried_poses(state.chain, data.q, data.targets, data.conditions).rotation
        require_orientations(data.where, data.targets, flange, data.rotations, len(data) >= LEAST_ORIENTATIONS)
    return replace(state, stations={data.stations[0]: Rigid()})


def _with_stations(robot: Robot, data: Measurements, fit: Fit) -> State:
    """Returns the state by the rows of the largest station; its positions place the others."""
    (first, most), *others = data.by_station().items()
    state = start(robot, data[most], fit)
    default, known = robot.tools.get("", Rigid()), {**robot.tools, **state.tools}
    state = replace(state, tools={name: known.get(name, default) for name in sorted(set(data.targets))})
    stations = dict(state.stations)
    for name, rows in others:
        part = data[rows]
        places = state.tips_of(part).translation
        where = f"{data.where}: station {name}"
        try:
            stations[name] = align_rigid(part.points(), places)
        except DegenerateError as error:
            fault = f"{where}: {rows.sum()} positions do not show where it stands"
            remedy = "3 or more off one line needed, or leave them out"
            raise DegenerateError("E-STATION-FEW", f"{fault}; {remedy}") from error
        misfit, extent = rms(position_errors(part.points() - stations[name] @ places)), _extent(part)
        if misfit > FITS * extent:
            fault = f"{where}: its rows miss the robot by {misfit:.3g} mm RMS as the rows of station {first} place it"
            allowed = f"{FITS:.0%} of their spread of {extent:.3g} mm allowed"
            raise InputError("E-IDENTIFY-STATION", f"{fault}, {allowed}; check column station")
    return replace(state, stations=stations)


def _extent(data: Measurements) -> float:
    """Returns the RMS of the measured positions about their mean, or of the measured distances, mm."""
    if data.positions is None:
        return rms(data.lengths()[0])
    return rms(position_errors(data.positions - data.positions.mean(0)))


def _require_motion(data: Measurements, targets: list[str]) -> None:
    if data.positions is None:
        if np.ptp(data.lengths()[0]) < STILL_MM:
            fault = f"{data.where}: all distances are equal"
            raise DegenerateError("E-IDENTIFY-UNDETERMINED", f"{fault}; positions apart from one another needed")
        return
    for name in targets:
        xyz = data.positions[[t == name for t in data.targets]]
        moved = float(np.linalg.norm(np.ptp(xyz, axis=0)))
        if moved < STILL_MM and len(xyz) > 1:
            motion = f"{moved:.2g} mm over {len(xyz)} rows, more than {STILL_MM} mm needed"
            remedy = "check that it was on the robot, and that each position was measured again"
            fault = f"{data.where}: target {name or 'of all rows'} never moved ({motion})"
            raise DegenerateError("E-IDENTIFY-UNMOVED", f"{fault}; {remedy}")


def _placed(robot: Robot, data: Measurements, tools: dict[str, Rigid], fit: Fit = BOTH) -> tuple[State, float]:
    """Returns the state by least squares of base and tool points, then tool orientations; and the RMS misfit, mm."""
    chain = replace(robot, world_from_base=Rigid()).chain()
    flange = carried_poses(chain, data.q, data.targets, data.conditions)
    names = list(tools)
    rows = np.array([names.index(t) for t in data.targets])
    points = np.array([tools[name].translation for name in names])
    turns = np.array([tools[name].rotation for name in names])
    if data.positions is None:  # distances show neither the base nor the instrument's place
        points, misfit = _points_of_distances(robot, flange, data, rows, points, "tool" in fit)
        return State(chain, dict(zip(names, map(Rigid, turns, points), strict=True))), misfit
    if "base" in fit:
        extents = np.linalg.svd(data.points() - data.points().mean(0), compute_uv=False)
        if len(extents) < 2 or extents[1] <= STILL_MM:
            line = f"{data.where}: all positions lie on one line (within {STILL_MM} mm)"
            fault = f"{line}, so that the instrument's pose is not determined"
            raise DegenerateError("E-IDENTIFY-UNDETERMINED", f"{fault}; move joints that take the target off the line")
    base, points = _base_and_points(robot, data.where, flange, data.points(), rows, points, fit)
    if data.rotations is not None and "tool" in fit:
        seen = np.swapaxes(flange.rotation, 1, 2) @ (base.inverse() @ data.poses()).rotation
        turns = [best_rotations(seen[rows == k].sum(0))[0] for k in range(len(names))]
    fitted = dict(zip(names, map(Rigid, turns, points), strict=True))
    misfit = rms(position_errors(base @ (flange @ points[rows]) - data.positions))
    return State(replace(robot, world_from_base=base).chain(), fitted), misfit


def _base_and_points(
    robot: Robot, where: str, flange: Poses, positions: np.ndarray, rows: np.ndarray, points: np.ndarray, fit: Fit
) -> tuple[Rigid, np.ndarray]:
    """Returns base and tool points (t, 3) by least squares, mm; the given ones where they are not in ``fit``."""
    try:
        base = align_rigid(positions, flange @ points[rows]) if "base" in fit else robot.world_from_base
    except DegenerateError as error:
        line = "according to the robot file, the target is on one line at all joint values"
        fault = f"{where}: {line}, so that the instrument's rotation about it is not determined"
        remedy = "move other joints, or give the tool in the robot file if it is off the axis"
        raise DegenerateError("E-IDENTIFY-UNDETERMINED", f"{fault}; {remedy}") from error
    if not fit:
        return base, points
    problem = Adjustment()
    frame = problem.block("base", Poses.of([base]), fixed=() if "base" in fit else (0,))
    tips = problem.block("points", Vector(points), fixed=() if "tool" in fit else range(len(points)))
    problem.prior(tips, points, np.eye(points.size) / USELESS_MM**2)

    def errors(bases: Poses, tools: Vector) -> np.ndarray:
        return bases[0] @ (flange @ tools.array[rows]) - positions

    def derivatives(bases: Poses, tools: Vector) -> list[np.ndarray]:
        turn = bases.rotation[0]
        by_base = by_pose(np.tile(np.eye(3), (len(rows), 1, 1)), (flange @ tools.array[rows]) @ turn.T)
        return [by_base, turn @ flange.rotation]

    problem.factor(errors, [(frame, None), (tips, rows)], derivatives=derivatives)
    minimum = problem.minimum(least_damping=REGULAR, settled=SETTLED, max_steps=ROUNDS)
    accepted = NEARLY * float(minimum.linear.cost)
    found = minimum.required(f"{where}: base and tools", "check the D-H rows and the joint values", accepted).state
    return found["base"][0], found["points"].array


def _points_of_distances(
    robot: Robot, flange: Poses, data: Measurements, rows: np.ndarray, points: np.ndarray, fit_points: bool
) -> tuple[np.ndarray, float]:
    """Returns tool points by least squares, starting at those given and around them; and the RMS misfit, mm."""
    distances, from_row = data.lengths()

    def errors(moved: np.ndarray) -> np.ndarray:
        tip = flange @ moved.reshape(-1, 3)[rows]
        return distances - np.linalg.norm(tip - tip[from_row], axis=1)

    if fit_points:
        around = AROUND * reach_mm(robot, robot.tools) * np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        # This is a start, converged or not: the adjustment goes on from here, and reports if it does not converge.
        fits = [least_squares(errors, (points + shift).ravel(), max_nfev=ROUNDS) for shift in around]
        points = min(fits, key=lambda fit: fit.cost).x.reshape(-1, 3)
    return points, rms(errors(points.ravel()))


Case = tuple[str, Robot, Measurements]  # what was mistaken, with the remedy, and robot and data without the mistake


def _explanation(robot: Robot, data: Measurements, tools: dict[str, Rigid], misfit: float) -> str:
    """Returns what is wrong with the data, or with the robot file; ``misfit`` : as a share of the data's spread."""
    thinned = data  # enough rows of positions to judge a guess; distances, which refer to one another, as they are
    if data.positions is not None:
        thinned = data[np.unique(np.linspace(0, len(data) - 1, GUESS_ROWS).astype(int))]
    mistakes = chain(*(kind(robot, thinned) for kind in (_of_values, _of_rows, _of_order)), _of_frames(robot, data))
    cases = [Candidate(what, partial(tuple, case), len(what) > 0) for what, *case in (("", robot, data), *mistakes)]
    words = []
    for each, _ in explain(cases, lambda case: _fitting(case, tools)[0], min(EXPLAINS * misfit, FITS))[:MOST_NAMED]:
        guess, far = each.change()[1], _fitting(each.change(), tools)[1]
        lines = [str(guess.lines[row]) for row in np.flatnonzero(far)]
        shown = ", ".join(lines[:SHOWN]) + (", …" if len(lines) > SHOWN else "")
        rows = f"line{'s' * (len(lines) > 1)} {shown} were not there, by far the worst; correct or remove them"
        words.append(", and ".join(filter(None, (each.words, rows if lines else ""))))
    if words:
        return f"it would fit if {', or if '.join(words)}"
    cause = "check D-H rows and convention, the order and zero of joints, coupling, and units"
    return f"{cause}; if instrument or target moved, name the rows from there on in a column station or target"


def _fitting(case: tuple[Robot, Measurements], tools: dict[str, Rigid]) -> tuple[float, np.ndarray]:
    """Returns the RMS misfit as a share of the spread, and a mask (m,) of rows that are far off and take no part."""
    robot, data = case
    near = np.ones(len(data), bool)
    for _ in range(TRIMS):
        used = data if near.all() else data[near]
        state, misfit = _placed(robot, used, tools)
        share = misfit / _extent(used)
        if data.positions is None:
            break
        errors = position_errors(state.residuals(observed(data, "position")))
        limit = max(FAR * float(np.median(errors[near])), FITS * _extent(used))
        before, near = near, errors <= limit
        if share < FITS or (near == before).all() or near.mean() < MOSTLY_NEAR:
            break
    return share, ~near


def _of_values(robot: Robot, data: Measurements) -> Iterator[Case]:
    """Yields data with joint values and lengths of another unit, sign or coupling."""
    q, sliding, n = data.q, robot.prismatic, len(robot.rows)
    for what, values in (
        ("joint values are radians in columns of degrees; call the columns q1_rad …", q * (180 / np.pi)),
        ("joint values are degrees in columns of radians; call the columns q1_deg …", q / (180 / np.pi)),
        ("all joint values had the opposite sign; check the rows and the joints' directions", -q),
    ):
        yield what, robot, replace(data, q=np.where(sliding, q, values))
    lengths = {"distances": data.distances, "positions": data.positions}
    for unit, words in UNIT_WORDS.items():
        there = words, "mm", unit, LENGTHS[unit]
        for held, said, right, times in (there, ("mm", words, "mm", 1 / LENGTHS[unit])):
            scaled: dict[str, Any] = {name: times * values for name, values in lengths.items() if values is not None}
            remedy = f"call the columns x_{right} … or distance_{right}"
            yield f"lengths are {held} in columns of {said}; {remedy}", robot, replace(data, **scaled)
    for i in range(n):
        remedy = f"check its direction in the rows, or the sign of q{i + 1}"
        reversed_ = replace(data, q=q * np.where(np.arange(n) == i, -1, 1))
        yield f"joint {i + 1} had the opposite sign; {remedy}", robot, reversed_
    if (robot.coupling != np.eye(n)).any():
        what = "the joints were not coupled; take coupling out of the robot file"
        yield what, replace(robot, coupling=np.eye(n)), data
    makers = {1.0: "as Fanuc's are", -1.0: "as those of parallel linkages are"}
    for sign, whose in makers.items() if n >= 3 else ():
        coupling = robot.coupling.copy()
        coupling[2, 1] = sign
        if (coupling != robot.coupling).any():
            what = f"joint 3 were coupled to joint 2 by {sign:+.0f}, {whose}; give coupling in the robot file so"
            yield what, replace(robot, coupling=coupling), data


def _of_rows(robot: Robot, data: Measurements) -> Iterator[Case]:
    """Yields the robot with rows of the other convention, unit, or zeros of joints that neither base nor tool takes."""
    other = "standard" if robot.convention == "modified" else "modified"
    what = f'rows were of the {other} convention; give convention = "{other}" in the robot file'
    yield what, replace(robot, convention=other), data
    angles = np.array([[row.alpha, row.theta] for row in robot.rows])
    if angles.any() and np.abs(angles).max() <= np.radians(2 * np.pi):
        rows = tuple(replace(row, alpha=np.degrees(row.alpha), theta=np.degrees(row.theta)) for row in robot.rows)
        yield "angles of the robot file were radians; write them in degrees", replace(robot, rows=rows), data
    inner = np.flatnonzero(~robot.prismatic[1:-1]) + 1
    for i, turn in product(inner.tolist(), QUARTERS_DEG):
        rows = list(robot.rows)
        rows[i] = replace(rows[i], theta=rows[i].theta + np.radians(turn))
        what = f"theta of joint {i + 1} were larger by {turn:+d}°; correct theta_deg"
        yield what, replace(robot, rows=tuple(rows)), data


def _of_order(robot: Robot, data: Measurements) -> Iterator[Case]:
    """Yields columns in another order."""
    q, sliding, n = data.q, robot.prismatic, len(robot.rows)
    for i, k in combinations(range(n), 2) if n <= MOST_JOINTS else ():
        if sliding[i] == sliding[k]:
            order = [{i: k, k: i}.get(r, r) for r in range(n)]
            what = f"columns q{i + 1} and q{k + 1} were exchanged; correct the order of the joint values"
            yield what, robot, replace(data, q=q[:, order])


def _of_frames(robot: Robot, data: Measurements) -> Iterator[Case]:
    """Yields positions that are of other rows, mirrored, or seen from the tool."""
    if data.positions is None:
        return
    remedy = "pair each position with the joint values of its moment"
    for way, joints, places in (("up", slice(1, None), slice(-1)), ("down", slice(-1), slice(1, None))):
        if len(data) > 2:
            shifted = replace(data[places], q=data.q[joints])
            yield f"joint values stood one row further {way}; {remedy}", robot, shifted
    mirrored = replace(data, positions=data.positions * [1, 1, -1], rotations=None, covariance=None)
    yield "positions are mirrored (a left-handed frame); change the sign of one axis", robot, mirrored
    if data.rotations is not None:
        inverse = data.poses().inverse()
        inverted = replace(data, positions=inverse.translation, rotations=inverse.rotation, covariance=None)
        what = "poses are inverse (instrument seen from the tool); give the tool in the instrument's frame"
        yield what, robot, inverted
