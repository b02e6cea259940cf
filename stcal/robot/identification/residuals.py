"""What measurements say about a robot: residuals, and their derivatives by the minimal parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.robot.kinematics.conditions import USUAL, Conditions
from stcal.robot.kinematics.forward import (
    carried_poses,
    chain_jacobian,
    chain_parameters,
    elasticity_curvature,
    elasticity_jacobian,
    elasticity_values,
    moved_chain,
    with_values,
)
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Chain

Kind = Literal["pose", "position", "distance"]
WIDTH = {"pose": 6, "position": 3, "distance": 1}


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What is identified: the chain, and flange_from_tool by target; where ``elastic`` the chain's elasticity too, the
    parameters of which are the last ones, with ``hysteresis`` or without; and station_from_world by station, the first
    of which is the world."""

    chain: Chain
    tools: dict[str, Rigid]
    elastic: bool = False
    stations: dict[str, Rigid] = field(default_factory=lambda: {"": Rigid()})
    hysteresis: bool = False

    @property
    def elastic_count(self) -> int:
        """Parameters of the elasticity."""
        return (10 if self.hysteresis else 9) * len(self.chain) if self.elastic else 0


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Measurements as one kind of observation.

    ``first``, ``second`` : (r,) rows of the measurements that each observation is about; equal but for distances.
    ``values`` : (r,) distances, mm, else empty. ``frameless`` : positions of which only the distances are used. All
    distances of m points hold what the points hold but a motion of all of them; so these are positions in a frame of
    their own, whose place is identified with the rest, and not counted.
    """

    kind: Kind
    data: Measurements
    first: np.ndarray
    second: np.ndarray
    values: np.ndarray
    frameless: bool = False

    def __len__(self) -> int:
        return len(self.first)

    @property
    def used(self) -> Kind:
        """What of the measurements is used."""
        return "distance" if self.frameless else self.kind


def tool_width(kind: Kind) -> int:
    """Parameters of each tool: orientation is seen in poses only."""
    return 6 if kind == "pose" else 3


def observed(data: Measurements, kind: Kind | None = None) -> Observed:
    """The measurements as ``kind``, or as the most that they hold.

    Raises
    ------
    InputError
        They do not hold it.
    """
    held = "distance" if data.distances is not None else "position" if data.rotations is None else "pose"
    kind = kind or held
    if WIDTH[kind] > WIDTH[held]:
        raise InputError("E-MEASURED-KIND", f"{data.where}: {held}s were measured, {kind}s cannot be had from them")
    rows, none = np.arange(len(data)), np.zeros(0)
    if kind != "distance":
        return Observed(kind, data, rows, rows, none)
    if held == "distance":
        distances, from_row = data.lengths()
        real = rows[from_row != rows]
        return Observed(kind, data, real, from_row[real], distances[real])
    return Observed("position", data, rows, rows, none, frameless=True)


def parameter_names(state: State, kind: Kind) -> list[str]:
    """``J2 rx`` … of the axes, ``tool x`` … of the tools, and ``station B rx`` … of stations but the first; r in rad,
    the others in mm; without elasticity."""
    component = ("rx", "ry", "rz", "x", "y", "z")
    tool = component if kind == "pose" else component[3:]
    names = [f"J{i + 1} {component[c]}" for i, c in chain_parameters(state.chain)]
    names += [f"tool {name} {c}".replace("  ", " ") for name in state.tools for c in tool]
    return names + [f"station {name} {c}" for name in list(state.stations)[1:] for c in component]


def tips(state: State, q: np.ndarray, targets: Sequence[str], conditions: Conditions = USUAL) -> Poses:
    """world_from_tool at joint vectors (m, n), with the tool and the load of each."""
    place = {name: i for i, name in enumerate(state.tools)}
    tool = Poses.of(state.tools.values())
    return carried_poses(state.chain, q, targets, conditions) @ tool[[place[t] for t in targets]]


def tips_of(state: State, data: Measurements) -> Poses:
    """world_from_tool of m measurements."""
    return tips(state, data.q, data.targets, data.conditions)


def residuals(state: State, seen: Observed) -> np.ndarray:
    """Measured minus modelled, (r, 6), (r, 3) or (r, 1): rad and mm in the axes of the row's station."""
    return _beside(state, tips_of(state, seen.data), seen)


def jacobian(state: State, seen: Observed) -> np.ndarray:
    """Derivative of what the model says by :func:`parameter_names` and the elasticity, (r, 6 or 3 or 1, k)."""
    return linear(state, seen)[1]


def linear(state: State, seen: Observed) -> tuple[np.ndarray, np.ndarray]:
    """:func:`residuals` and :func:`jacobian`."""
    tip, full = tip_jacobian(state, seen.data.q, seen.data.targets, seen.kind, seen.data.conditions)
    if len(state.stations) > 1:
        full = _by_station(state, seen, tip, full)
    return _beside(state, tip, seen), as_seen(state, seen, tip, full)


def curvature(state: State, seen: Observed, pull: np.ndarray) -> np.ndarray:
    """Second derivative, (9 n, 9 n), of the sum of ``pull`` (r, 6 or 3) times what the model says, by compliances and
    moments."""
    tip, data = tips_of(state, seen.data), seen.data
    moves = as_seen(state, seen, tip, np.broadcast_to(np.eye(6), (len(tip), 6, 6)))
    pulls = np.einsum("rw,rwk->rk", pull, moves)
    return elasticity_curvature(state.chain, data.q, tip, data.targets, pulls, data.conditions)


def as_seen(state: State, seen: Observed, tip: Poses, moves: np.ndarray) -> np.ndarray:
    """What observations see, (r, 6 or 3 or 1, k), of motions of the tools (m, 6, k) at ``tip``: rad over mm, in the
    world's axes; seen in those of the row's station."""
    if len(state.stations) > 1:
        turn = _stations(state, seen.data.stations).rotation[:, None]
        moves = (turn @ moves.reshape(len(moves), 2, 3, -1)).reshape(moves.shape)
    if seen.kind == "pose":
        return moves
    if seen.kind == "position":
        return moves[:, 3:]
    apart = tip.translation[seen.first] - tip.translation[seen.second]
    unit = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-12)[:, None]
    return np.einsum("ri,rik->rk", unit, moves[seen.first, 3:] - moves[seen.second, 3:])[:, None]


def _stations(state: State, names: Sequence[str]) -> Poses:
    """station_from_world of each row."""
    place = {name: i for i, name in enumerate(state.stations)}
    return Poses.of(state.stations.values())[[place[name] for name in names]]


def _by_station(state: State, seen: Observed, tip: Poses, full: np.ndarray) -> np.ndarray:
    """The derivative with columns of the stations, as small motions of the world."""
    full, names = full.copy(), np.array(seen.data.stations)
    own = len(parameter_names(state, seen.kind)) - 6 * (len(state.stations) - 1)
    for s, name in enumerate(list(state.stations)[1:]):
        rows, place = names == name, own + 6 * s
        full[rows, :3, place : place + 3] = np.eye(3)
        full[rows, 3:, place : place + 3] = -skew(tip.translation[rows])
        full[rows, 3:, place + 3 : place + 6] = np.eye(3)
    return full


def _beside(state: State, tip: Poses, seen: Observed) -> np.ndarray:
    """Measured minus modelled (m,) poses of the tips."""
    if len(state.stations) > 1:
        tip = _stations(state, seen.data.stations) @ tip
    if seen.kind == "pose":
        return seen.data.poses().difference(tip)
    if seen.kind == "position":
        return seen.data.points() - tip.translation
    apart = tip.translation[seen.first] - tip.translation[seen.second]
    return (seen.values - np.linalg.norm(apart, axis=1))[:, None]


def tip_jacobian(
    state: State, q: np.ndarray, targets: Sequence[str], kind: Kind, conditions: Conditions = USUAL
) -> tuple[Poses, np.ndarray]:
    """world_from_tool at joint vectors (m, n), and its derivative (m, 6, k) by :func:`parameter_names` and the
    elasticity: rotation (rad) over translation (mm), in the world's axes, where stations move nothing."""
    tip = tips(state, q, targets, conditions)
    width = tool_width(kind)
    axes_part = chain_jacobian(state.chain, q, tip, conditions)
    if state.chain.grown is not None:
        joint = [i for i, _ in chain_parameters(state.chain)]
        axes_part = axes_part * state.chain.carries(targets)[joint].T[:, None]
    tools_part = np.zeros((len(tip), 6, width * len(state.tools)))
    names = np.array(targets)
    for t, name in enumerate(state.tools):
        rows, place = names == name, width * t
        if width == 6:
            tools_part[rows, :3, place : place + 3] = tip.rotation[rows]
            place += 3
        tools_part[rows, 3:, place : place + 3] = tip.rotation[rows]
    parts = [axes_part, tools_part, np.zeros((len(tip), 6, 6 * (len(state.stations) - 1)))]
    if state.elastic:
        parts.append(elasticity_jacobian(state.chain, q, tip, targets, conditions, state.hysteresis))
    return tip, np.concatenate(parts, axis=2)


def moved(state: State, step: np.ndarray, kind: Kind) -> State:
    """The state after small motions along the parameters, (k,)."""
    k = len(chain_parameters(state.chain))
    width = tool_width(kind)
    tools = {}
    for t, (name, tool) in enumerate(state.tools.items()):
        own = step[k + width * t : k + width * (t + 1)]
        tools[name] = tool @ Rigid.exp(own if width == 6 else [0, 0, 0, *own])
    stations, k = dict(state.stations), k + width * len(tools)
    for s, name in enumerate(list(stations)[1:]):
        stations[name] = stations[name] @ Rigid.exp(step[k + 6 * s : k + 6 * s + 6])
    chain = moved_chain(state.chain, step[: len(chain_parameters(state.chain))])
    if state.elastic and chain.elasticity is not None:
        values = elasticity_values(chain.elasticity, state.hysteresis) + step[-state.elastic_count :]
        chain = replace(chain, elasticity=with_values(chain.elasticity, values))
    return replace(state, chain=chain, tools=tools, stations=stations)


def only_of(seen: Observed, keep: np.ndarray) -> Observed:
    """The observations at indices, or of a mask (r,)."""
    if seen.kind == "distance":
        return replace(seen, first=seen.first[keep], second=seen.second[keep], values=seen.values[keep])
    data = seen.data[keep]
    rows = np.arange(len(data))
    return replace(seen, data=data, first=rows, second=rows)
