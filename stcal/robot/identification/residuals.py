"""Residuals of measurements about a robot, and their derivatives by the minimal parameters."""

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
    """The unknowns of an identification. ``chain``; ``tools`` : flange_from_tool by target; ``elastic`` : whether the
    chain's elasticity is among them, as the last parameters; ``stations`` : station_from_world by station, the first of
    which is the world; ``hysteresis`` : whether elasticity includes hysteresis."""

    chain: Chain
    tools: dict[str, Rigid]
    elastic: bool = False
    stations: dict[str, Rigid] = field(default_factory=lambda: {"": Rigid()})
    hysteresis: bool = False

    @property
    def elastic_count(self) -> int:
        """Number of parameters of the elasticity."""
        return (10 if self.hysteresis else 9) * len(self.chain) if self.elastic else 0


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Measurements as one kind of observation.

    ``first``, ``second`` : (r,) rows of the measurements that each observation is about; they differ for distances
    only. ``values`` : (r,) distances, mm, else empty. ``frameless`` : positions of which only the distances are used.
    All distances of m points determine the points but for a motion of all of them. So such points are positions in a
    frame of their own, whose pose is identified with the other parameters but not counted.
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
        """Kind of observation for which the measurements are used."""
        return "distance" if self.frameless else self.kind


def tool_width(kind: Kind) -> int:
    """Returns the number of parameters of each tool; orientation is seen in poses only."""
    return 6 if kind == "pose" else 3


def observed(data: Measurements, kind: Kind | None = None) -> Observed:
    """Returns the measurements as ``kind``, or as the richest kind that they hold.

    Raises InputError: the measurements do not hold ``kind``.
    """
    richest = "distance" if data.distances is not None else "position" if data.rotations is None else "pose"
    kind = kind or richest
    if WIDTH[kind] > WIDTH[richest]:
        raise InputError("E-MEASURED-KIND", f"{data.where}: {richest}s were measured; they do not give {kind}s")
    rows, none = np.arange(len(data)), np.zeros(0)
    if kind != "distance":
        return Observed(kind, data, rows, rows, none)
    if richest == "distance":
        distances, from_row = data.lengths()
        real = rows[from_row != rows]
        return Observed(kind, data, real, from_row[real], distances[real])
    return Observed("position", data, rows, rows, none, frameless=True)


def parameter_names(state: State, kind: Kind) -> list[str]:
    """Returns the names of the parameters without elasticity: ``J2 rx`` … of the axes, ``tool x`` … of the tools, and
    ``station B rx`` … of stations but the first; r in rad, the others in mm."""
    component = ("rx", "ry", "rz", "x", "y", "z")
    tool = component if kind == "pose" else component[3:]
    names = [f"J{i + 1} {component[c]}" for i, c in chain_parameters(state.chain)]
    names += [f"tool {name} {c}".replace("  ", " ") for name in state.tools for c in tool]
    return names + [f"station {name} {c}" for name in list(state.stations)[1:] for c in component]


def tips(state: State, q: np.ndarray, targets: Sequence[str], conditions: Conditions = USUAL) -> Poses:
    """Returns world_from_tool at joint vectors (m, n), with the tool and the load of each."""
    place = {name: i for i, name in enumerate(state.tools)}
    tool = Poses.of(state.tools.values())
    return carried_poses(state.chain, q, targets, conditions) @ tool[[place[t] for t in targets]]


def tips_of(state: State, data: Measurements) -> Poses:
    """Returns world_from_tool of m measurements."""
    return tips(state, data.q, data.targets, data.conditions)


def residuals(state: State, measured: Observed) -> np.ndarray:
    """Returns measured minus modelled values, (r, 6), (r, 3) or (r, 1): rad and mm in the axes of the row's station."""
    return _beside(state, tips_of(state, measured.data), measured)


def jacobian(state: State, measured: Observed) -> np.ndarray:
    """Returns the derivative of the modelled values by :func:`parameter_names` and the elasticity, (r, 6 or 3 or 1,
    k)."""
    return linear(state, measured)[1]


def linear(state: State, measured: Observed) -> tuple[np.ndarray, np.ndarray]:
    """Returns :func:`residuals` and :func:`jacobian`."""
    tip, full = tip_jacobian(state, measured.data.q, measured.data.targets, measured.kind, measured.data.conditions)
    if len(state.stations) > 1:
        full = _by_station(state, measured, tip, full)
    return _beside(state, tip, measured), as_seen(state, measured, tip, full)


def curvature(state: State, measured: Observed, pull: np.ndarray) -> np.ndarray:
    """Returns the second derivative (9 n, 9 n), by compliances and moments, of the sum of ``pull`` (r, 6 or 3) times
    the modelled values."""
    tip, data = tips_of(state, measured.data), measured.data
    moves = as_seen(state, measured, tip, np.broadcast_to(np.eye(6), (len(tip), 6, 6)))
    pulls = np.einsum("rw,rwk->rk", pull, moves)
    return elasticity_curvature(state.chain, data.q, tip, data.targets, pulls, data.conditions)


def as_seen(state: State, measured: Observed, tip: Poses, moves: np.ndarray) -> np.ndarray:
    """Returns the effect on observations, (r, 6 or 3 or 1, k), of motions ``moves`` (m, 6, k) of the tools at ``tip``.

    Motions are rad over mm in the world's axes; their effects are in the axes of the row's station.
    """
    if len(state.stations) > 1:
        turn = _stations(state, measured.data.stations).rotation[:, None]
        moves = (turn @ moves.reshape(len(moves), 2, 3, -1)).reshape(moves.shape)
    if measured.kind == "pose":
        return moves
    if measured.kind == "position":
        return moves[:, 3:]
    apart = tip.translation[measured.first] - tip.translation[measured.second]
    unit = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-12)[:, None]
    return np.einsum("ri,rik->rk", unit, moves[measured.first, 3:] - moves[measured.second, 3:])[:, None]


def _stations(state: State, names: Sequence[str]) -> Poses:
    """Returns station_from_world of each row."""
    place = {name: i for i, name in enumerate(state.stations)}
    return Poses.of(state.stations.values())[[place[name] for name in names]]


def _by_station(state: State, measured: Observed, tip: Poses, full: np.ndarray) -> np.ndarray:
    """Returns the derivative with the columns of the stations filled in, as small motions of the world."""
    full, names = full.copy(), np.array(measured.data.stations)
    offset = len(parameter_names(state, measured.kind)) - 6 * (len(state.stations) - 1)
    for s, name in enumerate(list(state.stations)[1:]):
        rows, place = names == name, offset + 6 * s
        full[rows, :3, place : place + 3] = np.eye(3)
        full[rows, 3:, place : place + 3] = -skew(tip.translation[rows])
        full[rows, 3:, place + 3 : place + 6] = np.eye(3)
    return full


def _beside(state: State, tip: Poses, measured: Observed) -> np.ndarray:
    """Returns measured minus modelled values for the poses ``tip`` (m,) of the tools."""
    if len(state.stations) > 1:
        tip = _stations(state, measured.data.stations) @ tip
    if measured.kind == "pose":
        return measured.data.poses().difference(tip)
    if measured.kind == "position":
        return measured.data.points() - tip.translation
    apart = tip.translation[measured.first] - tip.translation[measured.second]
    return (measured.values - np.linalg.norm(apart, axis=1))[:, None]


def tip_jacobian(
    state: State, q: np.ndarray, targets: Sequence[str], kind: Kind, conditions: Conditions = USUAL
) -> tuple[Poses, np.ndarray]:
    """Returns world_from_tool at joint vectors (m, n), and its derivative (m, 6, k) by :func:`parameter_names` and the
    elasticity: rotation (rad) over translation (mm), in the world's axes; stations move nothing."""
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
    """Returns the state after small motions along the parameters, (k,)."""
    k = len(chain_parameters(state.chain))
    width = tool_width(kind)
    tools = {}
    for t, (name, tool) in enumerate(state.tools.items()):
        tool_step = step[k + width * t : k + width * (t + 1)]
        tools[name] = tool @ Rigid.exp(tool_step if width == 6 else [0, 0, 0, *tool_step])
    stations, k = dict(state.stations), k + width * len(tools)
    for s, name in enumerate(list(stations)[1:]):
        stations[name] = stations[name] @ Rigid.exp(step[k + 6 * s : k + 6 * s + 6])
    chain = moved_chain(state.chain, step[: len(chain_parameters(state.chain))])
    if state.elastic and chain.elasticity is not None:
        values = elasticity_values(chain.elasticity, state.hysteresis) + step[-state.elastic_count :]
        chain = replace(chain, elasticity=with_values(chain.elasticity, values))
    return replace(state, chain=chain, tools=tools, stations=stations)


def only_of(measured: Observed, keep: np.ndarray) -> Observed:
    """Returns the observations at the indices, or of the mask (r,), ``keep``."""
    if measured.kind == "distance":
        return replace(
            measured,
            first=measured.first[keep],
            second=measured.second[keep],
            values=measured.values[keep],
        )
    data = measured.data[keep]
    rows = np.arange(len(data))
    return replace(measured, data=data, first=rows, second=rows)
