"""Where identification starts: base and tools by the nominal axes; and data that this robot cannot have made."""

from dataclasses import replace

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.align import align_rigid
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.robot.data import Measurements
from stcal.robot.kinematics import flange_poses
from stcal.robot.model import Robot
from stcal.robot.observe import State

ROUNDS = 50
SETTLED_MM = 1e-6
FITS = 0.05
"""A nominal robot fits its data when its RMS error is below this share of their spread; factories err by under 1 %."""
EXPLAINS = 0.2
"""A mistake explains a misfit when mending it leaves less than this share of it."""
STILL_MM = 0.01


def start(robot: Robot, data: Measurements) -> State:
    """The nominal chain where the instrument stands, with tools that fit the measurements best.

    Raises
    ------
    InputError
        The nominal robot does not fit the data; the reason is named where one mends it.
    DegenerateError
        A target never moved, or only along a line.
    """
    _moves(data)
    tools = {name: robot.tools.get(name, robot.tools.get("", Rigid())) for name in sorted(set(data.targets))}
    if data.positions is None:  # distances see neither base nor where the instrument stands
        return State(replace(robot, world_from_base=Rigid()).chain(), tools)
    state, misfit = _placed(robot, data, tools)
    spread = float(np.sqrt(((data.positions - data.positions.mean(0)) ** 2).sum(1).mean()))
    if misfit > FITS * spread:
        _explain(robot, data, tools, misfit, spread)
    return state


def _moves(data: Measurements) -> None:
    if data.positions is None:
        if np.ptp(data.distances) < STILL_MM:
            raise DegenerateError(f"{data.where}: all distances are equal; positions apart from one another needed")
        return
    for name in sorted(set(data.targets)):
        own = data.positions[[t == name for t in data.targets]]
        moved = float(np.linalg.norm(np.ptp(own, axis=0)))
        if moved < STILL_MM and len(own) > 1:
            raise DegenerateError(
                f"{data.where}: target {name or 'of all rows'} never moved ({moved:.2g} mm over {len(own)} rows, more "
                f"than {STILL_MM} mm needed); was it on the robot, were positions read anew?"
            )


def _placed(robot: Robot, data: Measurements, tools: dict[str, Rigid]) -> tuple[State, float]:
    """Base and tool points by least squares, tool orientations after them; and the RMS misfit, mm."""
    chain = replace(robot, world_from_base=Rigid()).chain()
    flange = flange_poses(chain, data.q)
    names = list(tools)
    rows = np.array([names.index(t) for t in data.targets])
    points = np.array([tools[name].translation for name in names])
    base, points, misfit = _base_and_points(flange, data.positions, rows, points)
    if data.rotations is not None:
        seen = base.inverse() @ data.poses()
        turns = np.swapaxes(flange.rotation, 1, 2) @ seen.rotation
        for k, name in enumerate(names):
            u, _, vt = np.linalg.svd(turns[rows == k].sum(0))
            rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
            tools = tools | {name: Rigid(rotation, tools[name].translation)}
    tools = {name: Rigid(tools[name].rotation, points[k]) for k, name in enumerate(names)}
    placed = replace(robot, world_from_base=base)
    return State(placed.chain(), tools), misfit


def _base_and_points(flange: Poses, positions: np.ndarray, rows: np.ndarray, points: np.ndarray):
    """Gauss–Newton over the base and the tool points, from the alignment with the points given; and RMS misfit, mm."""
    base = align_rigid(positions, flange @ points[rows])
    misfit = np.inf
    for _ in range(ROUNDS):
        seen = flange @ points[rows]
        error = positions - base @ seen
        before, misfit = misfit, float(np.sqrt((error**2).sum(1).mean()))
        if before - misfit < SETTLED_MM:
            break
        slope = np.zeros((len(rows), 3, 6 + 3 * len(points)))
        slope[:, :, :3] = -skew(seen @ base.rotation.T)
        slope[:, :, 3:6] = np.eye(3)
        for k in range(len(points)):
            slope[rows == k, :, 6 + 3 * k : 9 + 3 * k] = base.rotation @ flange.rotation[rows == k]
        step = np.linalg.lstsq(slope.reshape(-1, slope.shape[2]), error.ravel(), rcond=1e-9)[0]
        base = Rigid(Rigid.exp(step[:6]).rotation @ base.rotation, base.translation + step[3:6])
        points = points + step[6:].reshape(-1, 3)
    return base, points, misfit


def _explain(robot: Robot, data: Measurements, tools: dict[str, Rigid], misfit: float, spread: float) -> None:
    """Say what is wrong with the data."""
    turning = ~robot.prismatic
    mirrored = replace(data, positions=data.positions * [1, 1, -1], rotations=None, covariance=None)
    degree = np.pi / 180
    guesses = {
        "joint values are radians in columns of degrees; call the columns q1_rad …": _with_q(data, turning, 1 / degree),
        "joint values are degrees in columns of radians; call the columns q1_deg …": _with_q(data, turning, degree),
        "positions are mirrored (a left-handed frame); change the sign of one axis": mirrored,
        "positions are metres in columns of mm; call the columns x_m …": _scaled(data, 1e3),
        "joint values have the opposite sign; check the rows and the joints' directions": _with_q(data, turning, -1.0),
    }
    if data.rotations is not None:
        inverse = data.poses().inverse()
        guesses["poses are inverse (instrument seen from the tool); give the tool in the instrument's frame"] = replace(
            data, positions=inverse.translation, rotations=inverse.rotation, covariance=None
        )
    found = {}
    for reason, guess in guesses.items():
        found[reason] = _placed(robot, guess, tools)[1] / float(
            np.sqrt(((guess.positions - guess.positions.mean(0)) ** 2).sum(1).mean())
        )
    reason = min(found, key=found.get)
    says = f"{data.where}: robot {robot.name} misses the measurements by {misfit:.3g} mm RMS, "
    says += f"{FITS:.0%} of their spread of {spread:.3g} mm allowed; "
    if found[reason] < EXPLAINS * misfit / spread:
        raise InputError(f"{says}it would fit if {reason}")
    raise InputError(f"{says}check D-H rows and convention, the order and zero of joints, coupling, and units")


def _with_q(data: Measurements, turning: np.ndarray, factor: float) -> Measurements:
    return replace(data, q=np.where(turning, data.q * factor, data.q))


def _scaled(data: Measurements, factor: float) -> Measurements:
    return replace(data, positions=data.positions * factor)
