"""Views of a board with two answers, numbered from another end or tilted the other way; motions of the robot decide."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.least_squares import PoseStack
from stcal.geometry.plane import mirrored
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.handeye.data.pairs import HandEyePoses, Loop, Setup
from stcal.handeye.data.views import View, Views
from stcal.handeye.judge.remarks import Aside, spoken
from stcal.handeye.methods import closed_form

ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Repair:
    """``pairs`` : m, the board's poses as if all views had been numbered alike; ``views`` : the same, where given;
    ``turned`` : (m,) number, from 1, of the symmetry that each view was turned by; 0 where the view stayed."""

    pairs: HandEyePoses
    views: Views | None
    turned: np.ndarray

    def notes(self) -> tuple[str, ...]:
        """Returns a note that names the turned views."""
        names = [name for name, turn in zip(self.pairs.names, self.turned, strict=True) if turn]
        if not names:
            return ()
        return (Aside(f"numbered from another end of the board, and corrected: {', '.join(names)}"),)


def repair(pairs: HandEyePoses, setup: Setup, symmetries: tuple[Rigid, ...], views: Views | None = None) -> Repair:
    """Give all views the same numbering of a symmetric board.

    Between two poses, robot and camera turn by the same angle and advance by the same length along the axis, whatever X
    is. This tells which numberings belong together. The most common numbering is kept.

    ``symmetries`` : all board_from_board except the identity that map the board onto itself.

    Raises DegenerateError: fewer than three poses.
    """
    loop, every = Loop.of(pairs, setup), (Rigid(), *symmetries)
    as_numbered = loop.camera_from_board
    variants = [as_numbered @ turn for turn in every]
    best, least = np.zeros(len(loop), int), np.inf
    for labels in np.unique(_guesses(loop, variants), axis=0):
        labels, cost = _settled(loop, variants, labels)
        if cost < least:
            best, least = labels, cost
    best = _most_as_they_are(best, every)
    poses = Poses.of(variants[k][i] for i, k in enumerate(best))
    covariance, common = pairs.camera_from_board_covariance, pairs.camera_from_board_common
    carried = _carried(as_numbered, poses)
    repaired = replace(
        pairs,
        camera_from_board=poses,
        camera_from_board_covariance=None if covariance is None else carried @ covariance @ np.swapaxes(carried, 1, 2),
        camera_from_board_common=None if common is None else carried @ common,
    )
    if views is not None:
        turned = (turned_view(view, every[k]) for view, k in zip(views.views, best, strict=True))
        views = Views(views.camera, tuple(turned))
    return Repair(repaired, views, best)


def _guesses(loop: Loop, variants: list[Poses]) -> np.ndarray:
    """Returns labels (m, m). Each row holds, with one pose as the reference, the numbering of every pose that agrees
    best with the robot's motion."""
    hand, m = loop.stand_from_mount, len(loop)
    labels = np.zeros((m, m), int)
    for reference in range(m):
        by_robot = _invariants(hand.inverse() @ hand[reference])
        misfits = []
        for variant in variants:
            by_camera = _invariants(variant @ variants[0][reference].inverse())
            # Angles are multiplied by the distance of the board, so that both terms are in mm.
            reach = np.linalg.norm(variant.translation, axis=1)
            misfits.append(np.hypot((by_robot - by_camera)[:, 0] * reach, (by_robot - by_camera)[:, 1]))
        labels[reference] = np.argmin(misfits, axis=0)
        labels[reference, reference] = 0
    return labels


def _invariants(motions: Poses) -> np.ndarray:
    """Returns the angle (rad) and the advance along the axis (mm) of motions, (m, 2). They are the same for A and B
    where AX = XB."""
    log = Rotation.from_matrix(np.array(motions.rotation)).as_rotvec()
    angle = np.linalg.norm(log, axis=1)
    axis = log / np.maximum(angle, 1e-12)[:, None]
    advance = np.abs((axis * motions.translation).sum(1))
    return np.column_stack([angle, np.where(angle > 1e-3, advance, np.linalg.norm(motions.translation, axis=1))])


def _settled(loop: Loop, variants: list[Poses], labels: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns labels that fit the solution they lead to, and the sum of their residuals, mm."""
    for _ in range(ROUNDS):
        chosen = replace(loop, camera_from_board=Poses.of(variants[k][i] for i, k in enumerate(labels)))
        x, z, _ = closed_form.robust(chosen)
        costs = []
        for variant in variants:
            misses = replace(loop, camera_from_board=variant).residuals(x, z).reshape(-1, 2, 3)
            turn, shift = np.linalg.norm(misses, axis=2).T
            costs.append(np.hypot(turn * np.linalg.norm(variant.translation, axis=1), shift))
        better = np.argmin(costs, axis=0)
        if (better == labels).all():
            break
        labels = better
    return labels, float(np.min(costs, axis=0).sum())


def _most_as_they_are(labels: np.ndarray, every: tuple[Rigid, ...]) -> np.ndarray:
    """Returns the same numbering after one turn of all views, chosen so that most views stay as they are."""
    common = int(np.bincount(labels).argmax())
    common_inverse = every[common].inverse()
    # Label k of a view means C S_k. All are turned by S_common⁻¹ from the right; S_k S_common⁻¹ is again in the group.
    return np.array([_nearest(every[k] @ common_inverse, every) for k in labels])


def _nearest(turn: Rigid, every: tuple[Rigid, ...]) -> int:
    angles = [Rigid(symmetry.rotation.T @ turn.rotation).angle_rad() for symmetry in every]
    return int(np.argmin(angles))


def _carried(seen: Poses, poses: Poses) -> np.ndarray:
    """Returns the derivative (m, 6, 6) of errors of camera_from_board when its origin moves on the board: the error of
    the rotation moves the origin too."""
    jacobian = np.tile(np.eye(6), (len(poses), 1, 1))
    jacobian[:, 3:, :3] = -skew(poses.translation - seen.translation)
    return jacobian


def turned_view(view: View, turn: Rigid) -> View:
    """Returns the same corners under the numbers that they have after the turn."""
    return view.turned(turn.inverse())


PUT_RIGHT = 0.2
"""Largest share of a pose's error of rotation that is left when it is tilted the other way. Of errors of any direction
0.2³, one in a hundred, seem to be flips."""


def tilted(poses: Poses) -> Poses:
    """Returns camera_from_board with the depths about the board's origin mirrored along the line of sight."""
    other = mirrored(PoseStack(np.asarray(poses.rotation), np.asarray(poses.translation)), Rigid())
    return Poses(other.rotation, np.asarray(poses.translation))


def flipped(loop: Loop, x: Rigid, z: Rigid, outliers: np.ndarray) -> np.ndarray:
    """Returns a mask (m,) of the ``outliers`` that agree with the solution when they are tilted the other way."""
    other = replace(loop, camera_from_board=tilted(loop.camera_from_board))
    before, after = (np.linalg.norm(each.residuals(x, z)[:, :3], axis=1) for each in (loop, other))
    return outliers & (after < PUT_RIGHT * before)


def flip_note(names: tuple[str, ...], flips: np.ndarray) -> tuple[str, ...]:
    """Returns a note on the poses that are flipped, (m,)."""
    if not flips.any():
        return ()
    shown = ", ".join(spoken(name) for name, flip in zip(names, flips, strict=True) if flip)
    return (
        Aside(
            f"{flips.sum()} of the poses left out agree when tilted the other way, as the second pose of a flat target "
            f"is, which its image hardly excludes: {shown}; --undo-flips takes that one, or give images"
        ),
    )
