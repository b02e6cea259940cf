"""Fits of the axes in order, each to points with the joints before it undone."""

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.robot.axes.fit import AxisFit, fit_axis
from stcal.robot.axes.orientations import VirtualReflectors
from stcal.robot.axes.sweeps import Arc
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot


def fit_axes(
    data: Measurements, robot: Robot, arcs: list[Arc], virtual: VirtualReflectors | None = None
) -> tuple[list[AxisFit], np.ndarray, np.ndarray, list[list[np.ndarray]]]:
    """Returns the fits in order, each to points with the joints before unwound; the covariance of all; the points with
    all joints unwound; and for each axis its derivatives by those before it.

    The covariance counts a row once, however many sweeps it belongs to, and a pose once for all its reflectors.
    """
    kinematic = data.q @ robot.coupling.T
    points, m = np.array(data.points()), len(data)
    turned = np.broadcast_to(np.eye(3), (m, 3, 3))  # rotation of the noise by unwinding
    fits, response, inherited, passed = [], [], [], []
    for j, sliding in enumerate(robot.prismatic):
        joint_arcs = [arc for arc in arcs if arc.joint == j]
        fit = fit_axis(points, kinematic[:, j], joint_arcs, bool(sliding), f"{data.where}: joint {j + 1}")
        # derivative of this axis by σ-scaled noise of every row: its own, and through the axes before it
        to_noise = np.zeros((len(fit.gain), m, 3))
        own_noise = fit.sigma_mm * np.einsum("pkc,kcd->kpd", fit.gain, turned[fit.rows])
        np.add.at(to_noise.swapaxes(0, 1), fit.rows, own_noise)  # a row may belong to several arcs
        passed.append([np.einsum("pkc,kcq->pq", fit.gain, jacobian[fit.rows]) for jacobian in inherited])
        for before, by in zip(response, passed[-1], strict=True):
            to_noise += np.einsum("pq,qmc->pmc", by, before)
        turn, after = unwound_by(fit.world_from_axis, points, kinematic[:, j], bool(sliding))
        inherited = [turn @ jacobian for jacobian in inherited]
        inherited.append(_unwinding_jacobian(fit.world_from_axis, points, after, turn, len(fit.gain)))
        fits.append(fit)
        response.append(to_noise)
        points, turned = after, turn @ turned
    rows = np.concatenate(response)
    stacked = rows.reshape(-1, 3 * m) if virtual is None else virtual.by_pose(rows)
    return fits, stacked @ stacked.T, points, passed


def unwound_by(axis: Rigid, points: np.ndarray, value: np.ndarray, sliding: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rotations (m, 3, 3) that undo the joint's values, and the points after that."""
    z, origin = axis.rotation[:, 2], axis.translation
    if sliding:
        return np.broadcast_to(np.eye(3), (len(points), 3, 3)), points - value[:, None] * z
    turn = Rotation.from_rotvec(-value[:, None] * z).as_matrix()
    return turn, np.einsum("mij,mj->mi", turn, points - origin) + origin


def _unwinding_jacobian(axis: Rigid, before: np.ndarray, after: np.ndarray, turn: np.ndarray, count: int) -> np.ndarray:
    """Returns the derivative (m, 3, p) of the unwound points by rx, ry, tx, ty of the axis in its frame.

    A small motion D of the axis turns its unwinding U into D U D⁻¹: δ = D(U x) − U(D x).
    """
    columns = []
    for component in (0, 1, 3, 4)[:count]:
        direction = axis.rotation[:, component % 3]
        if component < 3:
            after_shift, before_shift = (np.cross(direction, points - axis.translation) for points in (after, before))
        else:
            after_shift = before_shift = np.broadcast_to(direction, after.shape)
        columns.append(after_shift - np.einsum("mij,mj->mi", turn, before_shift))
    return np.stack(columns, axis=2)
