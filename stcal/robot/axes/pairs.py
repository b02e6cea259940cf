"""Relations of consecutive axes: angle, distance, common normal, with σ, and whether a row of them can be used."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.model import Chain, Robot

USABLE_MM = 1.0
"""σ of a common normal's length or foot beyond which the Denavit–Hartenberg value is refused: arms repeat to 0.1 mm."""
STEP_RAD, STEP_MM = 1e-7, 1e-4
"""Steps of central differences: far above rounding, and small against angles to which an axis is known."""
EXACTLY = 1e-12
"""Sine of the angle of two axes below which rounding alone decides where their common normal is."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Pair:
    """Two consecutive axes, ``joint`` (from 0) and the next; mm, rad; None along prismatic joints.

    ``angle`` : between the axes; ``distance`` : of the next axis from this one, for near-parallel pairs in the plane
    across this axis that the robot's rows define, else along the common normal; ``parallel`` : the rows have Hayati's
    β; ``normal``, ``foot`` : length of the common normal, and position of its foot on this axis, from where the axis
    was measured; ``refused`` : why a Denavit–Hartenberg row with these values must not be used, or "".
    """

    joint: int
    angle: float
    angle_sigma: float
    parallel: bool
    distance: float | None = None
    distance_sigma: float | None = None
    normal: float | None = None
    normal_sigma: float | None = None
    foot: float | None = None
    foot_sigma: float | None = None
    refused: str = ""


def chain_through(frames: list[Rigid], nominal: Robot) -> Chain:
    """Returns the chain through the axes; the flange is the last joint's frame."""
    gaps = [frames[0], *(a.inverse() @ b for a, b in pairwise(frames))]
    rotation, translation = np.array([g.rotation for g in gaps]), np.array([g.translation for g in gaps])
    return Chain(rotation, translation, Rigid(), nominal.prismatic, nominal.coupling)


def jacobian_by_axes(function, frames: list[Rigid], robot: Robot) -> np.ndarray:
    """Returns the derivative (v, p) of a function of the axes by their parameters, each in its own frame, by central
    differences."""
    columns = []
    for i, sliding in enumerate(robot.prismatic):
        for component in (0, 1) if sliding else (0, 1, 3, 4):
            step = STEP_RAD if component < 3 else STEP_MM
            twist = step * np.eye(6)[component]
            high, low = (
                function([*frames[:i], frames[i] @ Rigid.exp(sign * twist), *frames[i + 1 :]]) for sign in (1, -1)
            )
            columns.append((high - low) / (2 * step))
    return np.column_stack(columns)


def sigma_of(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Returns σ (v,) of values from their ``jacobian`` (v, p) by parameters with this covariance (p, p)."""
    return np.sqrt(np.maximum(np.einsum("vp,pq,vq->v", jacobian, covariance, jacobian), 0))


def pair_values(frames: list[Rigid], nominal: Robot) -> np.ndarray:
    """Returns values (6 (n − 1),) of the pairs: the acute angle as a vector (3), the rows' distance, and the common
    normal's length and foot from the axis's origin (nan with a prismatic joint)."""
    robot = robot_from_chain(chain_through(frames, nominal), {}, nominal)
    values = np.full((len(frames) - 1, 6), np.nan)
    for i, (axis, next_axis) in enumerate(pairwise(frames)):
        across = np.cross(axis.rotation[:, 2], next_axis.rotation[:, 2])
        square = across @ across
        sine = np.sqrt(square)
        acute = np.arctan2(sine, abs(axis.rotation[:, 2] @ next_axis.rotation[:, 2]))
        values[i, :3] = across * (acute / sine if sine > EXACTLY else 1.0)
        if nominal.prismatic[i] or nominal.prismatic[i + 1]:
            continue
        between = next_axis.translation - axis.translation
        values[i, 3] = robot.rows[i if nominal.convention == "standard" else i + 1].a
        if sine > EXACTLY:
            values[i, 4:] = between @ across / sine, np.cross(between, next_axis.rotation[:, 2]) @ across / square
    return values.ravel()


def pairs_of(frames: list[Rigid], covariance: np.ndarray, robot: Robot) -> tuple[Pair, ...]:
    """Returns the pairs of consecutive axes with their σ; ``robot`` gives what axes leave open (planes of near-parallel
    pairs)."""
    if len(frames) < 2:
        return ()
    values = pair_values(frames, robot).reshape(-1, 6)
    jacobians = jacobian_by_axes(lambda f: pair_values(f, robot), frames, robot).reshape(len(values), 6, -1)
    size = sum(abs(row.a) + abs(row.d) for row in robot.rows)
    pairs = []
    for i, (value, jacobian) in enumerate(zip(values, jacobians, strict=True)):
        acute = float(np.linalg.norm(value[:3]))
        opposed = frames[i].rotation[:, 2] @ frames[i + 1].rotation[:, 2] < 0
        lengths = {}
        if np.isfinite(value[3]):
            lengths = _lengths(acute, value[3:], sigma_of(jacobian[3:], covariance), size)
        pair = Pair(
            joint=i,
            angle=np.pi - acute if opposed else acute,
            angle_sigma=_angle_sigma(value[:3], jacobian[:3] @ covariance @ jacobian[:3].T),
            parallel=bool(np.sin(acute) < np.sin(PARALLEL_RAD)),
            **lengths,
        )
        pairs.append(pair)
    return tuple(pairs)


def _angle_sigma(angle: np.ndarray, covariance: np.ndarray) -> float:
    """Returns σ along the angle's vector; for exactly parallel axes, whose angle has no direction yet, the largest
    σ."""
    length = float(np.linalg.norm(angle))
    if length <= EXACTLY:
        return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0)))
    return float(np.sqrt(max(angle @ covariance @ angle, 0)) / length)


def _lengths(angle: float, value: np.ndarray, sigma: np.ndarray, size: float) -> dict:
    """Returns the lengths of a pair, and why Denavit and Hartenberg's must not be used, if so."""
    distance, normal, foot = (float(v) for v in value)
    lengths = {"distance": abs(distance), "distance_sigma": float(sigma[0])}
    if not np.isfinite(foot):
        return lengths | {"refused": "the axes are parallel: every common normal is as good as any other"}
    lengths |= {"normal": abs(normal), "foot": foot, "normal_sigma": float(sigma[1]), "foot_sigma": float(sigma[2])}
    reasons = []
    if abs(foot) > size:
        reasons.append(f"foot {abs(foot) / 1e3:.4g} m away, the arm is {size / 1e3:.3g} m long")
    if max(sigma[1:]) > USABLE_MM:
        reasons.append(f"σ {sigma[1]:.3g} mm of a and {sigma[2] / 1e3:.3g} m of the foot, {USABLE_MM:g} mm needed")
    if reasons:
        per_urad = abs(distance) / np.sin(angle) ** 2 * 1e-6
        reasons.append(f"axes {np.degrees(angle):.4f}° apart, 1 µrad moves the foot by {per_urad / 1e3:.3g} m")
    return lengths | {"refused": "; ".join(reasons)}
