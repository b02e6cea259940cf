"""What a problem of least squares is stated by: blocks of unknowns, losses, factors and prior knowledge."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from stcal.geometry.least_squares import PoseStack as PoseStack
from stcal.geometry.robust import huber_cost, huber_weights

STEP = 1e-6
"""Step of numerical derivatives, as a share of 1, or of the unknown's size where that is more."""


class Values(Protocol):
    """The members of a block, such as a :class:`Vector` or a :class:`~stcal.geometry.least_squares.PoseStack`."""

    @property
    def dim(self) -> int:
        """Number of unknowns of a member."""
        ...

    def __len__(self) -> int:
        """Return the number of members."""
        ...

    def moved(self, step: np.ndarray) -> Any:
        """Return the members after steps (n, dim)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Vector:
    """Members without curvature.

    Parameters
    ----------
    array : (n, dim) array
        The members.
    """

    array: np.ndarray

    @property
    def dim(self) -> int:
        """Number of unknowns of a member."""
        return self.array.shape[1]

    def __len__(self) -> int:
        return len(self.array)

    def moved(self, step: np.ndarray) -> "Vector":
        """Return the members after steps (n, dim)."""
        return Vector(self.array + step)


@dataclass(frozen=True, slots=True)
class Huber:
    """Huber's loss of the lengths of rows over their σ.

    Parameters
    ----------
    limit : float
        Length up to which it is the square.
    gross : float
        Length beyond which it is constant, and the row has no weight.
    """

    limit: float = np.inf
    gross: float = np.inf

    def cost(self, length: np.ndarray) -> np.ndarray:
        """Return the loss of lengths (r,)."""
        return huber_cost(np.minimum(length, self.gross), self.limit)

    def weight(self, length: np.ndarray) -> np.ndarray:
        """Return the weights of lengths (r,)."""
        return np.where(length > self.gross, 0.0, huber_weights(length, self.limit))


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A block of unknowns; to be had from :meth:`Adjustment.block`.

    Parameters
    ----------
    name : str
        Its name.
    start : Vector or PoseStack
        Its n members at the start.
    eliminate : bool
        Whether it is eliminated.
    fixed : (n,) bool array
        Members that stay.
    """

    name: str
    start: Values
    eliminate: bool
    fixed: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """Rows of residuals; see :meth:`Adjustment.factor`."""

    residuals: Callable[..., np.ndarray]
    derivatives: Callable[..., Sequence[np.ndarray]] | None
    on: tuple[tuple[Block, np.ndarray | None], ...]
    root: np.ndarray
    kind: str | tuple[str, ...]
    cluster: np.ndarray | None
    loss: Huber
    order: dict[tuple[int, int], Any] = field(default_factory=dict)  # in which products are summed, by pair of blocks

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its residuals."""
        return (self.kind,) if isinstance(self.kind, str) else self.kind

    def white(self, values: Mapping[str, Any], sigma: Mapping[str, float]) -> np.ndarray:
        """Return the residuals (r, w) over their σ; ``sigma`` : factor on that of each kind."""
        raw = np.asarray(self.residuals(*(values[block.name] for block, _ in self.on)))
        return self._whitened(raw, sigma)

    def slopes(self, values: Mapping[str, Any], sigma: Mapping[str, float]) -> list[np.ndarray]:
        """Return the derivatives (r, w, dim) of the residuals over σ, by each block."""
        own = [values[block.name] for block, _ in self.on]
        raw = self.derivatives(*own) if self.derivatives else self._numerical(own)
        return [self._whitened(np.asarray(each), sigma) for each in raw]

    def over(self, raw: np.ndarray, sigma: Mapping[str, float]) -> np.ndarray:
        """Return residuals (r, w) or derivatives (r, w, k) over the factors on their σ."""
        if isinstance(self.kind, str):
            return raw / sigma.get(self.kind, 1.0)
        return raw / np.array([sigma.get(kind, 1.0) for kind in self.kind]).reshape(-1, *[1] * (raw.ndim - 2))

    def _whitened(self, raw: np.ndarray, sigma: Mapping[str, float]) -> np.ndarray:
        if self.root.ndim < 3:
            return self.over(raw * self.root.reshape(*self.root.shape, *[1] * (raw.ndim - self.root.ndim)), sigma)
        return self.over((self.root @ (raw if raw.ndim == 3 else raw[..., None])).reshape(raw.shape), sigma)

    def _numerical(self, own: list[Any]) -> list[np.ndarray]:
        """Return central differences: a row depends on one member, so that all members are moved at once."""
        found = []
        for i, values in enumerate(own):
            columns = []
            size = np.abs(values.array).max(initial=1.0) if isinstance(values, Vector) else 1.0
            for k in range(values.dim):
                step = np.zeros((len(values), values.dim))
                step[:, k] = STEP * size
                ends = [self.residuals(*own[:i], values.moved(s), *own[i + 1 :]) for s in (step, -step)]
                columns.append((ends[0] - ends[1]) / (2 * STEP * size))
            found.append(np.stack(columns, axis=-1))
        return found


class Known(Protocol):
    """Knowledge of a kept block: any cost with its equations."""

    @property
    def block(self) -> Block:
        """The block."""
        ...

    def cost(self, values: Mapping[str, Any]) -> float:
        """Return the cost of a state, in σ²."""
        ...

    def equations(self, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return normal matrix (n·dim, n·dim) and right side (n·dim,): minus half the gradient of the cost."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Knowledge of the members of a :class:`Vector` block: ``mean`` (n, dim), and inverse covariance (n·dim, n·dim)."""

    block: Block
    mean: np.ndarray
    weight: np.ndarray

    def away(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return the members minus their mean, (n·dim,)."""
        return (values[self.block.name].array - self.mean).ravel()

    def cost(self, values: Mapping[str, Any]) -> float:
        """Return the cost, in σ²."""
        away = self.away(values)
        return float(away @ self.weight @ away)

    def equations(self, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return normal matrix and right side."""
        return self.weight, -self.weight @ self.away(values)


def numbers(members: np.ndarray | None, slope: np.ndarray) -> np.ndarray:
    """Return the member (r,) on which each row depends."""
    return np.zeros(len(slope), int) if members is None else members
