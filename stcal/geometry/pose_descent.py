"""Levenberg–Marquardt from several poses at once, with Huber's loss: for problems with several minima."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid

MAX_STEPS = 60
ACCEPTED = 1e-2
"""What is still settled after all steps: a tenth of σ. In a flat valley steps are many, and short."""
SLOW = 0.01
"""A minimum worse by ``hopeless`` in χ², which a step promises to improve by less than this share, is not followed
further: with large residuals the last steps are many, and short."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseStack:
    """h poses: (h, 3, 3) and (h, 3). Unlike :class:`~stcal.geometry.rigid.Poses` not checked, for inner loops."""

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def of(cls, *poses: Rigid) -> "PoseStack":
        """From single poses."""
        return cls(np.array([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses]))

    def rigid(self, row: int) -> Rigid:
        """One of them."""
        return Rigid(self.rotation[row], self.translation[row])

    def __len__(self) -> int:
        return len(self.translation)

    def moved(self, step: np.ndarray) -> "PoseStack":
        """After left perturbations (h, 6)."""
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return PoseStack(turn @ self.rotation, self.translation + step[:, 3:])

    def __getitem__(self, rows) -> "PoseStack":
        return PoseStack(self.rotation[rows], self.translation[rows])

    def plus(self, other: "PoseStack") -> "PoseStack":
        return PoseStack(
            np.concatenate([self.rotation, other.rotation]), np.vstack([self.translation, other.translation])
        )


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """h poses' ``cost`` (h,), ``normal`` matrices (h, 6, 6), ``right``-hand sides (h, 6), and ``length`` (h, n) of the
    residuals in σ."""

    cost: np.ndarray
    normal: np.ndarray
    right: np.ndarray
    length: np.ndarray

    @classmethod
    def of(cls, residual: np.ndarray, by_pose: np.ndarray, possible: np.ndarray, huber: float) -> "Normal":
        """Huber's loss on the lengths of whitened residuals (h, n, 2), with minus their derivative (h, n, 2, 6); of
        infinite cost where the pose is not ``possible``, (h,)."""
        length = np.sqrt((residual**2).sum(2))
        short = np.minimum(length, huber)
        cost = np.where(possible, (short * (2 * length - short)).sum(1), np.inf)
        h = len(residual)
        flat = by_pose.reshape(h, -1, 6)
        weight = np.repeat(short / np.maximum(length, 1e-12), 2, axis=1)[..., None]
        back = np.swapaxes(weight * flat, 1, 2)
        return cls(cost, back @ flat, (back @ residual.reshape(h, -1, 1))[..., 0], length)

    def where(self, take: np.ndarray, other: "Normal") -> "Normal":
        """The other's rows where ``take``, (h,)."""
        return Normal(
            np.where(take, other.cost, self.cost),
            np.where(take[:, None, None], other.normal, self.normal),
            np.where(take[:, None], other.right, self.right),
            np.where(take[:, None], other.length, self.length),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """h poses at their minima: ``cost`` (h,), ``normal`` (h, 6, 6), ``length`` (h, n) residuals in σ, ``settled``."""

    poses: PoseStack | Poses
    cost: np.ndarray
    normal: np.ndarray
    length: np.ndarray
    settled: np.ndarray

    def rows(self, index) -> "Minima":
        """Those of a list, a mask or a slice."""
        return Minima(*(getattr(self, name)[index] for name in Minima.__slots__))

    def plus(self, other: "Minima") -> "Minima":
        """These, and the other's after them."""
        rest = [np.concatenate([getattr(self, name), getattr(other, name)]) for name in Minima.__slots__[1:]]
        return Minima(self.poses.plus(other.poses), *rest)


def descend(
    evaluate: Callable[[PoseStack | Poses], Normal],
    poses: PoseStack | Poses,
    settled: float,
    hopeless: float = np.inf,
) -> Minima:
    """Minima from h poses at once.

    Parameters
    ----------
    settled : a step that lowers χ² by less, or by less than that share, is the last
    hopeless : by how much χ² a minimum may be worse and still be followed to its end; see :data:`SLOW`
    """
    now = evaluate(poses)
    damping, done = np.full(len(poses), 1e-6), np.zeros(len(poses), bool)
    for _ in range(MAX_STEPS):
        # Millimetres and radians: damped by the diagonal (Marquardt), not by its mean.
        scale = np.einsum("hii->hi", now.normal)
        damped = now.normal + (damping[:, None] * scale)[:, :, None] * np.eye(6)
        step = np.linalg.solve(damped, now.right[..., None])[..., 0]
        gain, behind = (step * now.right).sum(1), now.cost - now.cost.min()
        done |= (gain < settled * np.maximum(now.cost, 1)) | ((behind > hopeless) & (gain < SLOW * behind))
        if done.all():
            break
        step[done] = 0
        trial = poses.moved(step)
        new = evaluate(trial)
        better = (new.cost <= now.cost) & ~done
        poses = replace(
            poses,
            rotation=np.where(better[:, None, None], trial.rotation, poses.rotation),
            translation=np.where(better[:, None], trial.translation, poses.translation),
        )
        now = now.where(better, new)
        damping = np.where(better, damping / 10, np.minimum(np.maximum(10 * damping, 1e-3), 1e8))
    return Minima(poses, now.cost, now.normal, now.length, done | (gain < ACCEPTED))


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """(…, an, bn) of (…, n, a, b)."""
    *stack, n, a, b = blocks.shape
    full = np.zeros((*stack, n, a, n, b))
    every = np.arange(n)
    full[..., every, :, every, :] = np.moveaxis(blocks, -3, 0)
    return full.reshape(*stack, n * a, n * b)
