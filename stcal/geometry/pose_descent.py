"""Levenberg–Marquardt from several poses at once, with Huber's loss: for problems with several minima."""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import huber_cost, huber_weights

MAX_STEPS = 60
ACCEPTED = 1e-2
"""What is still settled after all steps: a tenth of σ. In a flat valley steps are many, and short."""


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
class Normal(NormalEquations):
    """Normal equations of h poses, and ``length`` (h, n) of the residuals in σ."""

    cost: np.ndarray
    length: np.ndarray

    @classmethod
    def of(cls, residual: np.ndarray, by_pose: np.ndarray, possible: np.ndarray, huber: float) -> "Normal":
        """Huber's loss on the lengths of whitened residuals (h, n, 2), with minus their derivative (h, n, 2, 6); of
        infinite cost where the pose is not ``possible``, (h,)."""
        length = np.sqrt((residual**2).sum(2))
        cost = np.where(possible, huber_cost(length, huber).sum(1), np.inf)
        h = len(residual)
        flat = by_pose.reshape(h, -1, 6)
        weight = np.repeat(huber_weights(length, huber), 2, axis=1)[..., None]
        back = np.swapaxes(weight * flat, 1, 2)
        return cls(cost, back @ flat, -(back @ residual.reshape(h, -1, 1))[..., 0], length)


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """h poses at their minima: ``cost`` (h,), ``normal`` (h, 6, 6), ``length`` (h, n) residuals in σ, ``settled``."""

    poses: PoseStack
    cost: np.ndarray
    normal: np.ndarray
    length: np.ndarray
    settled: np.ndarray

    def rows(self, index) -> "Minima":
        """Those of a list, a mask or a slice."""
        return Minima(self.poses[index], self.cost[index], self.normal[index], self.length[index], self.settled[index])

    def plus(self, other: "Minima") -> "Minima":
        """These, and the other's after them."""
        rest = ("cost", "normal", "length", "settled")
        both = (np.concatenate([getattr(self, name), getattr(other, name)]) for name in rest)
        return Minima(self.poses.plus(other.poses), *both)


def descend(
    evaluate: Callable[[PoseStack], Normal],
    poses: PoseStack,
    settled: float,
    hopeless: float = np.inf,
) -> Minima:
    """Minima from h poses at once.

    Parameters
    ----------
    evaluate
        Normal equations at h poses.
    poses
        The starts.
    settled
        A step that lowers χ² by less, or by less than that share, is the last.
    hopeless
        By how much χ² of a pose may be worse than of the best and still be followed to its end.
    """
    found = minimise(
        poses,
        evaluate,
        lambda stack, step: stack.moved(step),
        select=select_rows,
        damping=1e-6,
        settled=settled,
        least_gain=settled,
        max_steps=MAX_STEPS,
        hopeless=hopeless,
    )
    last = found.linear
    ended = found.converged | (found.promised < ACCEPTED) | (last.cost - last.cost.min() > hopeless)
    return Minima(found.state, last.cost, last.normal, last.length, ended)


def select_rows(take: np.ndarray, new, old):
    """Rows of the new poses, or normal equations, where ``take`` (h,), else of the old ones."""

    def rows(name: str) -> np.ndarray:
        a, b = getattr(new, name), getattr(old, name)
        return np.where(take.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return type(new)(*(rows(field.name) for field in fields(new)))


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """(…, an, bn) of (…, n, a, b)."""
    *stack, n, a, b = blocks.shape
    full = np.zeros((*stack, n, a, n, b))
    every = np.arange(n)
    full[..., every, :, every, :] = np.moveaxis(blocks, -3, 0)
    return full.reshape(*stack, n * a, n * b)
