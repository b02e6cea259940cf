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
"""Largest predicted decrease, in σ², that counts as settled after the last step: a tenth of σ. In a flat valley steps
are many and short."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseStack:
    """A stack of h poses, ``rotation`` (h, 3, 3) and ``translation`` (h, 3), for inner loops.

    Unlike :class:`~stcal.geometry.rigid.Poses` it is not checked.
    """

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def of(cls, *poses: Rigid) -> "PoseStack":
        """Return the stack of single poses."""
        return cls(np.array([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses]))

    def rigid(self, row: int) -> Rigid:
        """Return the pose of one row."""
        return Rigid(self.rotation[row], self.translation[row])

    def __len__(self) -> int:
        return len(self.translation)

    def moved(self, step: np.ndarray) -> "PoseStack":
        """Return the poses after left perturbations (h, 6)."""
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
        """Return the normal equations of Huber's loss on the lengths of whitened residuals (h, n, 2).

        ``by_pose`` : (h, n, 2, 6) negative derivative of the residuals; ``possible`` : (h,) mask, the cost of other
        poses is infinite.
        """
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
        """Return the minima that a list, a mask or a slice selects."""
        return Minima(self.poses[index], self.cost[index], self.normal[index], self.length[index], self.settled[index])

    def plus(self, other: "Minima") -> "Minima":
        """Return these minima followed by those of ``other``."""
        names = ("cost", "normal", "length", "settled")
        both = (np.concatenate([getattr(self, name), getattr(other, name)]) for name in names)
        return Minima(self.poses.plus(other.poses), *both)


def descend(
    evaluate: Callable[[PoseStack], Normal],
    poses: PoseStack,
    settled: float,
    hopeless: float = np.inf,
) -> Minima:
    """Return the minima reached from h poses at once.

    Parameters
    ----------
    evaluate
        Returns the normal equations at h poses.
    poses
        Starts of the descent.
    settled
        A step is the last if it lowers χ² by less than this value, or by less than this share of χ².
    hopeless
        Excess of a pose's χ² over the best one up to which the pose is followed to its end.
    """
    result = minimise(
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
    last = result.linear
    ended = result.converged | (result.promised < ACCEPTED) | (last.cost - last.cost.min() > hopeless)
    return Minima(result.state, last.cost, last.normal, last.length, ended)


def select_rows(take: np.ndarray, new, old):
    """Return the rows of the new poses, or normal equations, where ``take`` (h,) is True, else of the old ones."""

    def rows(name: str) -> np.ndarray:
        a, b = getattr(new, name), getattr(old, name)
        return np.where(take.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return type(new)(*(rows(field.name) for field in fields(new)))


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """Return block-diagonal matrices (…, n·a, n·b) of blocks (…, n, a, b)."""
    *stack, n, a, b = blocks.shape
    full = np.zeros((*stack, n, a, n, b))
    every = np.arange(n)
    full[..., every, :, every, :] = np.moveaxis(blocks, -3, 0)
    return full.reshape(*stack, n * a, n * b)
