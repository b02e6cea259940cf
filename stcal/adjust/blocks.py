"""What a problem of least squares is stated by: blocks of unknowns, losses, factors and prior knowledge; and variance
components by restricted maximum likelihood (REML, Patterson & Thompson 1971)."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import minimize

from stcal.geometry.normal_equations import Reduction, blocks_of, inverse_and_size, reduce
from stcal.geometry.rigid import Poses
from stcal.geometry.robust import huber_cost, huber_weights


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Normal equations of k kept and of m eliminated unknowns, of ``a`` numbers each."""

    square: float  # sum of the squares of all residuals
    count: float  # of the residuals
    normal: np.ndarray  # (k, k)
    right: np.ndarray  # (k,) minus half the gradient
    block: np.ndarray  # (m, a, a) of each eliminated unknown
    block_right: np.ndarray  # (m, a)
    cross: np.ndarray  # (m, a, k) mixed parts

    @classmethod
    def nothing(cls, kept: int, eliminated: tuple[int, int] = (0, 1)) -> "Equations":
        """Return the equations of no residual; ``eliminated`` : m and a."""
        k, (m, a) = kept, eliminated
        return cls(0.0, 0.0, np.zeros((k, k)), np.zeros(k), np.zeros((m, a, a)), np.zeros((m, a)), np.zeros((m, a, k)))

    @classmethod
    def of(cls, residual: np.ndarray, slope: np.ndarray) -> "Equations":
        """Return the equations of residuals (n,) and their derivatives (n, k), both over σ; nothing is eliminated."""
        square, count = float(residual @ residual), float(len(residual))
        none = cls.nothing(slope.shape[1])
        return cls(square, count, slope.T @ slope, -slope.T @ residual, none.block, none.block_right, none.cross)

    def __add__(self, other: "Equations") -> "Equations":
        return Equations(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))

    def flat(self) -> np.ndarray:
        return np.concatenate([np.ravel(getattr(self, each.name)) for each in fields(self)])

    def filled(self, flat: np.ndarray) -> "Equations":
        """Return equations of the same unknowns with the numbers of :meth:`flat`."""
        shapes = [np.shape(getattr(self, each.name)) for each in fields(self)]
        parts = np.split(flat, np.cumsum([np.prod(shape, dtype=int) for shape in shapes])[:-1])
        numbers: list[Any] = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
        return Equations(*numbers)

    def alone(self, held: float = 0.0) -> "tuple[np.ndarray, np.ndarray, Reduction]":
        """Return normal matrix and right side of the kept unknowns alone, and the elimination of the others. ``held`` :
        share of each unknown's information that is added; one on which nothing depends stays."""
        normal, block = self.normal.copy(), self.block.copy()
        for diagonal in (np.einsum("kk->k", normal), np.einsum("maa->ma", block)):
            diagonal[:] = np.where(diagonal > 0, (1 + held) * diagonal, 1.0)
        reduction = reduce(block, self.block_right, self.cross)
        return normal - reduction.normal, self.right - reduction.right, reduction

    def told(self, from_kept: np.ndarray) -> np.ndarray:
        """Return what the residuals tell (k, k) about the kept unknowns, with which the others go: (m, a, k)."""
        mixed = np.tensordot(from_kept, self.cross, ((0, 1), (0, 1)))
        return self.normal - mixed - mixed.T + np.tensordot(from_kept, self.block @ from_kept, ((0, 1), (0, 1)))


@dataclass(frozen=True, eq=False)
class Components:
    """A linearised adjustment in p parts with a σ each; what is sought is x = log (σ / present σ) (p,)."""

    each: Sequence[Equations]  # p of the parts at their present σ
    fixed: Equations  # of what has a known σ
    expected: np.ndarray | float = 0.0  # (p,) mean of the prior of x
    doubt: np.ndarray | float = np.inf  # (p,) σ of the prior
    caution: np.ndarray | float = 0.0  # (p,) redundancy that is not counted
    held: float = 0.0  # see :meth:`Equations.alone`

    @cached_property
    def _flat(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The numbers of all parts (p, N), those of ``fixed`` (N,), and how many residuals of each part count (p,)."""
        counted = np.array([own.count for own in self.each]) - self.caution
        return np.array([own.flat() for own in self.each]), self.fixed.flat(), counted

    def at(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the posterior at x (p,), by restricted maximum likelihood (Patterson & Thompson 1971). Return its
        logarithm, gradient (p,), the step of the kept unknowns (k,) from the state, and their covariance (k, k)."""
        share, (each, fixed, counted) = np.exp(-2 * x), self._flat
        whole = self.fixed.filled(share @ each + fixed)
        normal, right, reduction = whole.alone(self.held)
        inverse, size = inverse_and_size(normal)
        kept = inverse @ right
        away, dropped = reduction.from_kept, reduction.back(kept)
        mixed = -away @ inverse
        of_dropped = reduction.inverse - mixed @ np.swapaxes(away, 1, 2)
        # Second moments of the unknowns about the state, laid out as what they are multiplied by.
        moments = Equations(
            1.0,
            0.0,
            inverse + kept[:, None] * kept,
            -2 * kept,
            of_dropped + dropped[:, :, None] * dropped[:, None],
            -2 * dropped,
            2 * (mixed + dropped[:, :, None] * kept),
        )
        doubted = (x - self.expected) / self.doubt
        size += float(np.linalg.slogdet(reduction.block)[1].sum())
        left = float(whole.square - kept @ right - reduction.gain)
        value = -float(x @ counted) - 0.5 * (left + size + float((doubted**2).sum()))
        return value, share * (each @ moments.flat()) - counted - doubted / self.doubt, kept, inverse

    def best(self, low: np.ndarray, high: np.ndarray, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the x (p,) of highest density within bounds (p,), by descents from several ``starts`` (p,)."""

        def downhill(logs: np.ndarray) -> tuple[float, np.ndarray]:
            """Return minus twice the log density, and its gradient, at the logarithms of the weights, -2x."""
            value, gradient, _, _ = self.at(-logs / 2)
            return -2 * value, gradient

        bounds, begin = -2 * np.column_stack([high, low]), [-2 * np.clip(x, low, high) for x in starts]
        fits = [minimize(downhill, logs, jac=True, method="L-BFGS-B", bounds=bounds) for logs in begin]
        return -min(fits, key=lambda fit: fit.fun).x / 2


def component_variances(
    residuals: np.ndarray,
    jacobian: np.ndarray,
    known: np.ndarray,
    free: np.ndarray,
    first: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    caution: float = 0.0,
) -> np.ndarray:
    """Return restricted maximum-likelihood variances (f,) of ``free`` (f, m, a, a) beside ``known`` (m, a, a)
    covariances of residuals (m, a) with derivatives (m, a, k), from ``first`` (f,) and within ``bounds``; ``caution`` :
    redundancy of each variance that is not counted."""
    flat = jacobian.reshape(-1, jacobian.shape[2])
    u, s, _ = np.linalg.svd(flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300), full_matrices=False)
    jacobian = u[:, s > 1e-7 * s[0]].reshape(*jacobian.shape[:2], -1)  # an orthonormal basis of its columns

    def cost(logs: np.ndarray) -> tuple[float, np.ndarray]:
        theta = np.exp(logs)
        spread = known + np.tensordot(theta, free, 1)
        inverse = np.linalg.inv(spread)
        weighted = inverse @ jacobian
        normal = np.einsum("mai,maj->ij", jacobian, weighted)
        covariance = np.linalg.inv(normal)
        remaining = residuals - jacobian @ (covariance @ np.einsum("mai,ma->i", weighted, residuals))
        fitted = np.einsum("mab,mb->ma", inverse, remaining)
        value = np.linalg.slogdet(spread)[1].sum() + np.linalg.slogdet(normal)[1] + (fitted * remaining).sum()
        inner = inverse - weighted @ covariance @ np.swapaxes(weighted, 1, 2) - fitted[:, :, None] * fitted[:, None]
        return float(value - caution * logs.sum()), np.tensordot(free, inner, 3) * theta - caution

    limits = np.log(np.column_stack(bounds))
    optimum = minimize(cost, np.log(first), jac=True, method="L-BFGS-B", bounds=limits, options={"ftol": 1e-12})
    return np.exp(optimum.x)


def sigma_factor(square: float, redundancy: float) -> float:
    """Return the factor on σ that makes the sum of squares over σ² equal its redundancy (Förstner 1979)."""
    return float(np.sqrt(square / max(redundancy, 1.0)))


PoseStack = Poses  # members that are poses, moved by left perturbations
STEP = 1e-6  # step of numerical derivatives, as a share of 1, or of the unknown's size where that is more


@dataclass(frozen=True, slots=True, eq=False)
class Vector:
    """Members without curvature: ``array`` (n, dim)."""

    array: np.ndarray

    @property
    def dim(self) -> int:
        return self.array.shape[1]

    def __len__(self) -> int:
        return len(self.array)

    def moved(self, step: np.ndarray) -> "Vector":
        return Vector(self.array + step)


Values = Vector | Poses
"""The members of a block."""


@dataclass(frozen=True, slots=True)
class Huber:
    """Huber's loss of the lengths of rows over their σ, the square up to ``limit``. It is constant beyond ``gross``,
    where a row has no weight."""

    limit: float = np.inf
    gross: float = np.inf

    def cost(self, length: np.ndarray) -> np.ndarray:
        return huber_cost(np.minimum(length, self.gross), self.limit)

    def weight(self, length: np.ndarray) -> np.ndarray:
        return np.where(length > self.gross, 0.0, huber_weights(length, self.limit))


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A block of unknowns, from :meth:`Adjustment.block`: its ``name``; its n members at the ``start``; whether to
    ``eliminate`` it; ``fixed`` (n,), whether a member stays."""

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
            size = STEP * (np.abs(values.array).max(initial=1.0) if isinstance(values, Vector) else 1.0)
            for step in size * np.eye(values.dim):
                moved = (values.moved(np.tile(way, (len(values), 1))) for way in (step, -step))
                ahead, behind = (self.residuals(*own[:i], each, *own[i + 1 :]) for each in moved)
                columns.append((ahead - behind) / (2 * size))
            found.append(np.stack(columns, axis=-1))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Knowledge of a kept :class:`Vector` block: functions of its members."""

    block: Block
    cost: Callable[[Vector], float]  # in σ²
    # normal matrix (n·dim, n·dim) and right side (n·dim,): minus half the gradient of the cost
    equations: Callable[[Vector], tuple[np.ndarray, np.ndarray]]


def numbers(members: np.ndarray | None, slope: np.ndarray) -> np.ndarray:
    """Return the member (r,) on which each row depends."""
    return np.zeros(len(slope), int) if members is None else members


@dataclass(frozen=True, slots=True, eq=False)
class FactorRows:
    """Rows of a factor about a state: ``slopes`` (r, w, dim) by block and ``residual`` (r, w), over σ and weighted;
    ``length`` and ``weight`` (r,)."""

    factor: Factor
    slopes: list[np.ndarray]
    residual: np.ndarray
    length: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, factor: Factor, values: Mapping[str, Any], sigma: Mapping[str, float]) -> "FactorRows":
        """Return the rows of a factor about a state."""
        white = factor.white(values, sigma)
        length = np.sqrt((white**2).sum(1))
        weight = factor.loss.weight(length)
        root = np.sqrt(weight)
        slopes = [each * root[:, None, None] for each in factor.slopes(values, sigma)]
        for (block, members), slope in zip(factor.on, slopes, strict=True):
            if block.fixed.any():
                slope[block.fixed[numbers(members, slope)]] = 0.0
        return cls(factor, slopes, white * root[:, None], length, weight)

    def of_kinds(self, kinds: Collection[str]) -> "FactorRows | None":
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

    def add(self, sums: Equations, places: Mapping[str, slice]) -> None:
        """Add the rows to the matrices and right sides of equations; ``places`` : of the kept blocks in them."""
        normal, mixed = sums.normal, sums.cross.reshape(-1, sums.cross.shape[2])
        ends = [(places.get(own.name), slope) for (own, _), slope in zip(self.factor.on, self.slopes, strict=True)]
        for i, ((own, members), (place, slope)) in enumerate(zip(self.factor.on, ends, strict=True)):
            square, pull = blocks_of(slope, -self.residual, numbers(members, slope), len(own.start))
            if place is None:
                sums.block[:] += square
                sums.block_right[:] += pull
            else:
                at = _unknowns(place, np.arange(len(own.start)), slope)
                normal[at[:, :, None], at[:, None]] += square
                sums.right[place] += pull.ravel()
            for j, (other_place, other) in enumerate(ends[:i]):
                (first, second), products = self._products(i, j)
                one, two = _unknowns(place, first, slope), _unknowns(other_place, second, other)
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
