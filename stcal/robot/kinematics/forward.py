"""Forward kinematics of many joint vectors at once, and its derivatives by joint values and by the chain."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.robot.kinematics.robot_model import USUAL, Chain, Conditions, Elasticity, Robot, loaded, warn_of_degrees

GRAVITY_M_S2 = 9.80665
CHUNK = 8192  # number of joint vectors at a time: their frames, 96 bytes each, stay in a processor's cache


def forward(robot: Robot, q: ArrayLike, tool: str = "", payload_kg: ArrayLike | None = None) -> Poses:
    """Returns base_from_tool of each joint vector.

    ``robot`` : an arm of n joints; where its base stands does not matter; ``q`` : (m, n) or (n,) values of the
    controller, rad or mm; ``tool`` : its name; ``payload_kg`` : mass at the flange, a number or (m,); that of the robot
    if not given. Returns m transforms, mm; one for a single joint vector. ``.matrix()`` has them as (m, 4, 4),
    ``[i].matrix()`` one. Raises InputError: joint values of another shape or not finite; an unknown tool; a mass that
    no arm carries.
    """
    values = _joint_vectors(q, robot)
    chain, flange_from_tool = from_base(robot, tool)
    return flange_poses(chain, values, loaded(payload_kg, len(values))) @ flange_from_tool


def jacobian(robot: Robot, q: ArrayLike, tool: str = "") -> np.ndarray:
    """Returns the geometric Jacobian (m, 6, n): the derivative of base_from_tool by the controller's values.

    ``robot``, ``q``, ``tool`` : as of :func:`forward`. Rotation vector (rad) over translation (mm) of the tool's
    origin, in the axes of the base (left perturbation), by rad or mm of each joint; the deflection of links is taken as
    constant. Raises InputError: joint values of another shape or not finite; an unknown tool.
    """
    values = _joint_vectors(q, robot)
    return tool_jacobian(*from_base(robot, tool), values)


def from_base(robot: Robot, tool: str) -> tuple[Chain, Rigid]:
    """Returns the chain from the base to the flange that carries a tool, and flange_from_tool."""
    flange_from_tool = robot.tool(tool)
    return replace(robot, world_from_base=Rigid()).chain().branch(tool), flange_from_tool


def tool_jacobian(chain: Chain, flange_from_tool: Rigid, q: np.ndarray) -> np.ndarray:
    """Returns :func:`jacobian` of the chain's own base, at joint vectors (m, n)."""
    path = list(chain.path())
    columns = joint_motions(chain, q, flange_poses(chain, q) @ flange_from_tool)
    return np.moveaxis(columns[path], 0, 2) @ chain.coupling[path]


def joint_motions(chain: Chain, q: np.ndarray, tip: Poses, conditions: Conditions = USUAL) -> np.ndarray:
    """Returns the motion (n, m, 6) of ``tip``, rad over mm in the world's axes, by the value of each joint."""
    axes, origins = joint_frames(chain, q, conditions)
    z = axes[..., 2]  # (n, m, 3)
    swept, sliding = np.cross(z, tip.translation - origins), chain.prismatic[:, None, None]
    return np.concatenate([np.where(sliding, 0.0, z), np.where(sliding, z, swept)], axis=2)


def flange_poses(chain: Chain, q: np.ndarray, conditions: Conditions = USUAL) -> Poses:
    """Returns world_from_flange of joint vectors (m, n); raises InputError for a tree, which has no one flange."""
    rotation, translation = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
    path = chain.path()
    end = chain.ends[path[-1]]
    for start in range(0, len(q), CHUNK):
        part = slice(start, start + CHUNK)
        axes, origin = _walk(chain, path, q[part], conditions[part])
        rotation[part] = np.einsum("cjm,ck->mjk", axes, end.rotation)
        translation[part] = (origin + np.einsum("cjm,c->jm", axes, end.translation)).T
    return Poses(rotation, translation)


def carried_poses(chain: Chain, q: np.ndarray, targets: Sequence[str], conditions: Conditions = USUAL) -> Poses:
    """Returns world_from_flange of joint vectors (m, n), for the flange that carries each row's target."""
    carrier = np.array([chain.carrier(name) for name in targets])
    rotation, translation = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
    for each in np.unique(carrier):
        rows = carrier == each
        found = flange_poses(replace(chain, flange_joint=int(each)), q[rows], conditions[rows])
        rotation[rows], translation[rows] = found.rotation, found.translation
    return Poses(rotation, translation)


def fixed_values(n: int) -> np.ndarray:
    """Returns (8, n) pseudo-random joint values, rad or mm, the same every time."""
    return np.random.default_rng(0).uniform(-3, 3, (8, n))


def joint_frames(chain: Chain, q: np.ndarray, conditions: Conditions = USUAL) -> tuple[np.ndarray, np.ndarray]:
    """Returns world_from_joint of each joint before its own motion: rotations (n, m, 3, 3) and origins (n, m, 3)."""
    n, m = len(chain), len(q)
    rotation, origin = np.empty((n, m, 3, 3)), np.empty((n, m, 3))

    def keep(i: int, axes: np.ndarray, place: np.ndarray) -> None:
        rotation[i], origin[i] = np.moveaxis(axes, 2, 0).swapaxes(1, 2), place.T

    _walk(chain, range(n), q, conditions, keep)
    return rotation, origin


def links(chain: Chain, q: np.ndarray, conditions: Conditions = USUAL) -> tuple[np.ndarray, np.ndarray]:
    """Returns world_from_link of each link after its joint's motion: rotations (n, m, 3, 3) and origins (n, m, 3)."""
    rotation, origin = joint_frames(chain, q, conditions)
    angle = np.where(chain.prismatic, 0.0, q @ chain.coupling.T).T[:, :, None]
    x, y, z = np.moveaxis(rotation, 3, 0)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([x * c + y * s, y * c - x * s, z], axis=3), origin


def torques(
    chain: Chain, q: np.ndarray, rotation: np.ndarray, origin: np.ndarray, conditions: Conditions = USUAL
) -> np.ndarray:
    """Returns the torque of gravity about each joint, (n, m, 3) N m, in the world's axes; frames from :func:`links`."""
    elasticity = _elasticity(chain)
    carried = chain.gathered((rotation @ elasticity.moment[:, None, :, None])[:, :, :, 0])
    mass = np.full(len(q), elasticity.payload_kg) if conditions.payload_kg is None else conditions.payload_kg
    if mass.any():
        if chain.tree and "" not in chain.tree.carriers:
            fault = "the robot is a tree of joints, and its file does not say which carries the load"
            raise InputError("E-ROBOT-TREE", f"{fault}; give [tool] joint")
        last = chain.carrier("")
        place = origin[last] + rotation[last] @ elasticity.payload_centre
        if chain.prismatic[last]:
            place = place + rotation[last, :, :, 2] * (q @ chain.coupling[last])[:, None]
        held = chain.carries([""])[:, :, None]
        carried = carried + held * (1e-3 * GRAVITY_M_S2 * mass[:, None] * (place - origin))
    return np.cross(carried, chain.rotation[0] @ elasticity.gravity)


def waves(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Returns (4, n, m): sin and cos of joint angles, then sin and cos of twice the angles; 0 for prismatic joints."""
    angle = (q @ chain.coupling.T).T
    found = np.array([np.sin(angle), np.cos(angle), np.sin(2 * angle), np.cos(2 * angle)])
    return np.where(chain.prismatic[:, None], 0.0, found)


def _turning(chain: Chain) -> np.ndarray:
    """Returns the derivatives (n, N) of the joints' angles by the controller's values; 0 for prismatic ones."""
    return np.where(chain.prismatic[:, None] | chain.prismatic, 0.0, chain.coupling)


def deflections(chain: Chain, q: np.ndarray, conditions: Conditions = USUAL) -> np.ndarray:
    """Returns the deflection of each link, (n, m, 3) rad, in its frame, by the torques on the rigid arm."""
    elasticity = _elasticity(chain)
    rotation, origin = links(replace(chain, elasticity=None), q)
    torque = np.einsum("imkc,imk->imc", rotation, torques(chain, q, rotation, origin, conditions))
    axis, across = elasticity.compliance.T
    turn = torque * np.stack([across, across, axis], axis=1)[:, None]
    turn[:, :, 2] += np.einsum("ik,kim->im", elasticity.periodic, waves(chain, q))
    if conditions.approach is not None and elasticity.hysteresis.any():
        turn[:, :, 2] += _turning(chain) @ (elasticity.hysteresis * conditions.approach).T
    return turn


def _elasticity(chain: Chain) -> Elasticity:
    if chain.elasticity is None:
        raise InputError("E-ROBOT-RIGID", "the robot is rigid; elasticity needed")
    return chain.elasticity


def _walk(
    chain: Chain, joints: Sequence[int], q: np.ndarray, conditions: Conditions = USUAL, visit=None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns axes (3, 3, m) and origin (3, m) after ``joints``; ``visit`` gets frames before each motion."""
    m = len(q)
    give = None
    if chain.elasticity is not None:
        give = Rotation.from_rotvec(deflections(chain, q, conditions).reshape(-1, 3)).as_matrix()
        give = give.reshape(len(chain), m, 3, 3)
    q = q @ chain.coupling.T
    axes = np.repeat(np.eye(3)[:, :, None], m, axis=2)
    origin = np.zeros((3, m))
    moved = {-1: (axes, origin)}  # by the joints, which may carry others than the next one
    for i in joints:
        if chain.after(i) != i - 1:
            axes, origin = moved[chain.after(i)]
        origin = origin + np.tensordot(chain.translation[i], axes, 1)
        axes = (chain.rotation[i].T @ axes.reshape(3, -1)).reshape(3, 3, m)
        if visit is not None:
            visit(i, axes, origin)
        if chain.prismatic[i]:
            origin = origin + q[:, i] * axes[2]
        else:
            c, s = np.cos(q[:, i]), np.sin(q[:, i])
            x, y = axes[0] * c + axes[1] * s, axes[1] * c - axes[0] * s
            axes = np.stack([x, y, axes[2]])
        if give is not None:
            axes = np.einsum("kjm,mkc->cjm", axes, give[i])
        if chain.tree:
            moved[i] = axes, origin
    return axes, origin


def chain_jacobian(chain: Chain, q: np.ndarray, tip: Poses, conditions: Conditions = USUAL) -> np.ndarray:
    """Returns the derivative (m, 6, k) of ``tip`` by :meth:`Chain.parameters`, in the world's axes."""
    rotation, origin = joint_frames(chain, q, conditions)
    joint, component = np.array(chain.parameters()).T
    direction = rotation[joint, :, :, component % 3]  # (k, m, 3)
    turning = (component < 3)[:, None, None]
    swept = np.cross(direction, (tip.translation - origin)[joint])
    columns = [np.where(turning, direction, 0.0), np.where(turning, swept, direction)]
    return np.moveaxis(np.concatenate(columns, axis=2), 0, 2)


def elasticity_jacobian(
    chain: Chain,
    q: np.ndarray,
    tip: Poses,
    targets: Sequence[str],
    conditions: Conditions = USUAL,
    hysteresis: bool = False,
) -> np.ndarray:
    """Returns the derivative (m, 6, 9 n or 10 n) of ``tip`` by :meth:`Elasticity.values`, in the world's axes."""
    elasticity = _elasticity(chain)
    rotation, origin = links(replace(chain, elasticity=None), q)
    torque, z = torques(chain, q, rotation, origin, conditions), rotation[..., 2]
    about = z * (z * torque).sum(2)[:, :, None]
    periodic = z * waves(chain, q)[..., None]  # (4, n, m, 3)
    lever = tip.translation - origin
    axis, across = elasticity.compliance.T[:, :, None, None, None]
    gives = across * np.eye(3) + (axis - across) * z[..., :, None] * z[..., None, :]  # (n, m, 3, 3)
    gives = np.concatenate([gives, -skew(lever) @ gives], axis=2)
    moves = chain.carries(targets)[:, :, None]
    moved = np.tensordot(chain.behind().T, np.where(moves[..., None], gives, 0.0), 1)  # with the joints before each
    pulled = _by_moment(chain, rotation, elasticity)
    by_moment = np.moveaxis(moved @ pulled, 3, 1).reshape(-1, len(q), 6)
    turned = np.concatenate([np.stack([about, torque - about], axis=1), np.moveaxis(periodic, 0, 1)], axis=1)
    by_turn = np.concatenate([turned, np.cross(turned, lever[:, None])], axis=3)  # (n, 6, m, 6)
    by_turn = np.where(moves[:, None], by_turn, 0.0)
    parts = [by_turn[:, :2].reshape(-1, len(q), 6), by_moment, by_turn[:, 2:].reshape(-1, len(q), 6)]
    if hysteresis:
        came = np.zeros((len(q), len(chain))) if conditions.approach is None else conditions.approach
        each = np.where(moves, np.concatenate([z, np.cross(z, lever)], axis=2), 0.0)
        parts.append(np.einsum("ij,mj,imc->jmc", _turning(chain), came, each))
    return np.moveaxis(np.concatenate(parts), 0, 2)


def elasticity_curvature(
    chain: Chain, q: np.ndarray, tip: Poses, targets: Sequence[str], pull: np.ndarray, conditions: Conditions = USUAL
) -> np.ndarray:
    """Returns the second derivative (9 n, 9 n) of ``pull`` (m, 6) times the tool's motions by elasticity."""
    elasticity, n = _elasticity(chain), len(chain)
    rotation, origin = links(replace(chain, elasticity=None), q)
    z = rotation[..., 2]
    turn = pull[:, :3] + np.cross(tip.translation - origin, pull[:, 3:])
    turn = np.where(chain.carries(targets)[:, :, None], turn, 0.0)
    about = z * (z * turn).sum(2)[:, :, None]
    pulled = _by_moment(chain, rotation, elasticity)
    each = np.einsum("iamc,jmck->iajk", np.stack([about, turn - about], axis=1), pulled, optimize=True)
    each = np.where(chain.behind()[:, None, :, None], each, 0.0).reshape(2 * n, 3 * n)
    found = np.zeros((9 * n, 9 * n))
    found[: 2 * n, 2 * n : 5 * n], found[2 * n : 5 * n, : 2 * n] = each, each.T
    return found


def _by_moment(chain: Chain, rotation: np.ndarray, elasticity: Elasticity) -> np.ndarray:
    """Returns the derivative (n, m, 3, 3) of the torque, in the world's axes, by each link's moment."""
    return np.cross(rotation, (chain.rotation[0] @ elasticity.gravity)[:, None], axisa=2, axisb=0, axisc=2)


def _joint_vectors(q: ArrayLike, robot: Robot) -> np.ndarray:
    values, n = np.atleast_2d(frozen(q, None, "joint values")), len(robot.rows)
    if values.ndim != 2 or values.shape[1] != n:
        raise InputError("E-ARRAY-SHAPE", f"joint values: shape {values.shape}, (m, {n}) needed for {n} joints")
    warn_of_degrees(values, ~robot.prismatic, f"robot {robot.name}: joint values")
    return values
