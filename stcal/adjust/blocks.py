"""What a problem of least squares is stated by: blocks of unknowns, losses, factors and prior knowledge."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from stcal.adjust.components import Equations
from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.rigid import Poses
from stcal.geometry.robust import huber_cost, huber_weights

PoseStack = Poses  # members that are poses, moved by left perturbations
STEP = 1e-6  # step of numerical derivatives, as a share of 1, or of the unknown's size where that is more


class Values(Protocol):
    """The members of a block, such as a :class:`Vector` or :class:`~stcal.geometry.rigid.Poses`."""

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
    start : Vector or Poses
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


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Rows of a factor about a state: ``slopes`` (r, w, dim) by block and ``residual`` (r, w), over σ and weighted;
    ``length`` and ``weight`` (r,)."""

    factor: Factor
    places: tuple[slice | None, ...]
    slopes: list[np.ndarray]
    residual: np.ndarray
    length: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(
        cls, factor: Factor, values: Mapping[str, Any], sigma: Mapping[str, float], kept: Mapping[str, slice]
    ) -> "Rows":
        """Return the rows of a factor about a state; ``kept`` : places of the kept blocks among the unknowns."""
        white = factor.white(values, sigma)
        length = np.sqrt((white**2).sum(1))
        weight = factor.loss.weight(length)
        root = np.sqrt(weight)
        slopes = [each * root[:, None, None] for each in factor.slopes(values, sigma)]
        for (block, members), slope in zip(factor.on, slopes, strict=True):
            if block.fixed.any():
                slope[block.fixed[numbers(members, slope)]] = 0.0
        places = tuple(kept.get(block.name) for block, _ in factor.on)
        return cls(factor, places, slopes, white * root[:, None], length, weight)

    def of_kinds(self, kinds: Collection[str]) -> "Rows | None":
        """Return the residuals of some kinds."""
        own = [i for i, kind in enumerate(self.factor.kinds) if kind in kinds]
        if isinstance(self.factor.kind, str) or not own:
            return self if own else None
        return replace(self, slopes=[each[:, own] for each in self.slopes], residual=self.residual[:, own])

    def total(self, ways: Mapping[str, np.ndarray], part: slice = slice(None)) -> np.ndarray:
        """Return the derivatives (r, w, q) of a part of the rows by changes of all blocks (n, dim, q), by name."""
        total: Any = 0.0
        for (block, index), slope in zip(self.factor.on, self.slopes, strict=True):
            way = ways[block.name]
            total = total + slope[part] @ (way[0] if index is None else way[index[part]])
        return total

    def add(self, sums: Equations) -> None:
        """Add the rows to the matrices and right sides of equations."""
        normal, mixed = sums.normal, sums.cross.reshape(-1, sums.cross.shape[2])
        ends = list(zip(self.factor.on, self.places, self.slopes, strict=True))
        for i, ((own, members), place, slope) in enumerate(ends):
            square, pull = blocks_of(slope, -self.residual, numbers(members, slope), len(own.start))
            if place is None:
                sums.block[:] += square
                sums.block_right[:] += pull
            else:
                at = _unknowns(place, np.arange(len(own.start)), slope)
                normal[at[:, :, None], at[:, None]] += square
                sums.right[place] += pull.ravel()
            for j, (_, other_place, other) in enumerate(ends[:i]):
                pairs, products = self._products(i, j)
                one, two = (
                    _unknowns(which, number, each)
                    for which, number, each in zip((place, other_place), pairs, (slope, other), strict=True)
                )
                back = np.swapaxes(products, 1, 2)
                if place is None:
                    mixed[one[:, :, None], two[:, None]] += products
                elif other_place is None:
                    mixed[two[:, :, None], one[:, None]] += back
                else:
                    normal[one[:, :, None], two[:, None]] += products
                    normal[two[:, :, None], one[:, None]] += back

    def _products(self, i: int, j: int) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Return the pairs of members that rows tie, and the sums (u, a, b) of the products of their derivatives."""
        one, two = self.slopes[i], self.slopes[j]
        members, others = (self.factor.on[k][1] for k in (i, j))
        if members is None and others is None:
            none = np.zeros(1, int)
            return (none, none), np.tensordot(one, two, ((0, 1), (0, 1)))[None]
        if (i, j) not in self.factor.order:
            first, second = numbers(members, one), numbers(others, two)
            pair = first * (second.max(initial=0) + 1) + second
            order = np.argsort(pair, kind="stable")
            starts = np.flatnonzero(np.diff(pair[order], prepend=-1))
            self.factor.order[i, j] = order, starts, (first[order[starts]], second[order[starts]])
        order, starts, pairs = self.factor.order[i, j]
        products = np.swapaxes(one, 1, 2) @ two
        return pairs, np.add.reduceat(products[order], starts, axis=0) if len(order) else products


def _unknowns(place: slice | None, members: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the numbers (u, dim) of the unknowns of members (u,)."""
    width = slope.shape[2]
    return (place.start if place else 0) + width * members[:, None] + np.arange(width)
