"""One adjustment by least squares: blocks of unknowns, factors that tie them, elimination, σ, and influence.

A factor states residuals row by row; each row depends on one member of each block that the factor is on, or on a block
of a single member. A block of many members that no row ties to one another is eliminated (Schur complement).
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from stcal.adjust.blocks import (
    Block,
    Components,
    Equations,
    Factor,
    FactorRows,
    Huber,
    Known,
    Values,
    Vector,
    numbers,
    sigma_factor,
)
from stcal.errors import ConvergenceError, InputError
from stcal.geometry.clusters import ByClusters, by_clusters
from stcal.geometry.least_squares import SETTLED, Minimum, block_diagonal, minimise
from stcal.geometry.normal_equations import (
    TINY,
    Reduction,
    blocks_of,
    constrained_inverse,
    datum,
    generalised_inverse,
    reduce,
)

HELD = 1e-14
"""Share of an eliminated member's information that is added, so that one which its rows do not determine stays."""
LOOSE = 1e-10
"""Share of each unknown's information that is added where σ are sought, so that undetermined ones do no harm."""
AT_ONCE = 10_000  # number of rows whose derivatives are multiplied at once; it bounds the memory


@dataclass(eq=False)
class Adjustment:
    """A problem of least squares.

    Parameters
    ----------
    blocks, factors, priors : What :meth:`block`, :meth:`factor` and :meth:`prior` have added.
    sigma : Factor on the σ of a kind of rows, 1 where it is not stated.

    Examples
    --------
    >>> a = Adjustment()
    >>> line = a.block("line", Vector(np.zeros((1, 2))))
    >>> x, y = np.arange(4.0), np.array([1.0, 3.1, 4.9, 7.0])
    >>> a.factor(lambda v: (v.array[:, :1] + v.array[:, 1:] * x[:, None]) - y[:, None], [(line, None)], sigma=0.1)
    >>> print(a.solve().values["line"].array.round(2))
    [[1.03 1.98]]
    """

    blocks: list[Block] = field(default_factory=list)
    factors: list[Factor] = field(default_factory=list)
    priors: list[Known] = field(default_factory=list)
    sigma: dict[str, float] = field(default_factory=dict)

    def block(self, name: str, start: Values, eliminate: bool = False, fixed: Sequence[int] | np.ndarray = ()) -> Block:
        """Add a block of unknowns.

        Parameters
        ----------
        name : its name, by which :attr:`Solution.values` has it
        start : its members at the start of the descent
        eliminate : whether it is eliminated first; one block at most, of whose members no row has two
        fixed : numbers of the members that stay at their start
        """
        if any(name == block.name or (eliminate and block.eliminate) for block in self.blocks):
            fault = f"block {name}: another one has this name, or is eliminated"
            raise InputError("E-OPTION-COMBINATION", f"{fault}; one of a kind")
        held = np.zeros(len(start), bool)
        held[np.asarray(fixed, int)] = True
        self.blocks.append(Block(name, start, eliminate, held))
        return self.blocks[-1]

    def factor(
        self,
        residuals: Callable[..., np.ndarray],
        on: Sequence[tuple[Block, np.ndarray | None]],
        sigma: float | np.ndarray = 1.0,
        derivatives: Callable[..., Sequence[np.ndarray]] | None = None,
        root: np.ndarray | None = None,
        kind: str | Sequence[str] = "",
        cluster: np.ndarray | None = None,
        loss: Huber | None = None,
    ) -> None:
        """Add rows of residuals.

        Parameters
        ----------
        residuals : returns (r, w) of the members of the blocks of ``on``, in their order
        on : blocks, each with the number (r,) of the member on which each row depends, None for a block of one member
        sigma : σ of the rows, a number, (r,) or (r, w)
        derivatives : returns the derivatives (r, w, dim) of the residuals by each block; numerical ones if None
        root : (r, w, w) matrices that whiten the rows, in place of ``sigma``
        kind : name of the σ that the rows share, or (w,) one of each column, which :meth:`Solution.component` tells; it
            is multiplied by ``self.sigma[kind]``, 1 where that has none
        cluster : (r,) number of the photograph, or other unit, whose errors may be common
        loss : loss of the rows' lengths over σ; squares if None
        """
        whiten = 1 / np.asarray(sigma, float) if root is None else root
        kinds = kind if isinstance(kind, str) else tuple(kind)
        ends = tuple((block, None if rows is None else np.asarray(rows)) for block, rows in on)
        self.factors.append(Factor(residuals, derivatives, ends, whiten, kinds, cluster, loss or Huber()))

    def prior(self, block: Block, mean: np.ndarray, weight: np.ndarray) -> None:
        """Add knowledge of a kept :class:`Vector` block: ``mean`` (n, dim), and ``weight`` (n·dim, n·dim) over σ²."""
        of_prior = np.asarray(mean), np.asarray(weight)
        self.know(Known(block, partial(_prior_cost, *of_prior), partial(_prior_equations, *of_prior)))

    def know(self, known: Known) -> None:
        """Add knowledge of a kept block that has equations of its own."""
        block = known.block
        if block.eliminate:
            raise InputError("E-OPTION-COMBINATION", f"block {block.name}: eliminated, its prior must be a factor")
        self.priors.append(known)

    def solve(self, values: Mapping[str, Any] | None = None, **options: Any) -> "Solution":
        """Return the solution of least cost, from the start or from ``values``.

        ``options`` : of :func:`stcal.geometry.least_squares.minimise`. Raises ConvergenceError: no minimum is reached.
        """
        minimum = self.minimum(values, **options).required("adjustment", "give a better start, or fewer unknowns")
        return minimum.linear

    def minimum(
        self, values: Mapping[str, Any] | None = None, settled: float = SETTLED, **options: Any
    ) -> "Minimum[dict[str, Any], Solution]":
        """Return where the descent ended, with the solution there as ``linear``."""
        begin = {block.name: block.start for block in self.blocks} if values is None else dict(values)
        if not np.isfinite(self.cost(begin)):
            raise InputError("E-OPTION-RANGE", "adjustment: a residual is not finite at the start; start elsewhere")
        return minimise(begin, self.at, self.moved, cost=self.cost, settled=settled, **options)

    def cost(self, values: Mapping[str, Any]) -> float:
        """Return the cost of a state, in σ²; infinite where a residual is not finite."""
        total = 0.0
        for factor in self.factors:
            with np.errstate(all="ignore"):
                white = factor.white(values, self.sigma)
            if not np.isfinite(white).all():
                return np.inf
            total += float(factor.loss.cost(np.sqrt((white**2).sum(1))).sum())
        return total + sum(prior.cost(values[prior.block.name]) for prior in self.priors)

    def moved(self, values: Mapping[str, Any], step: np.ndarray) -> dict[str, Any]:
        """Return the state after a step of all unknowns, those of kept blocks first."""
        found, at = dict(values), 0
        for block in sorted(self.blocks, key=lambda each: each.eliminate):
            own = values[block.name]
            size = len(own) * own.dim
            found[block.name] = own.moved(step[at : at + size].reshape(len(own), own.dim))
            at += size
        return found

    def at(self, values: Mapping[str, Any]) -> "Solution":
        """Return the problem linearised about a state."""
        return Solution(self, dict(values))


def _prior_cost(mean: np.ndarray, weight: np.ndarray, members: Vector) -> float:
    away = (members.array - mean).ravel()
    return float(away @ weight @ away)


def _prior_equations(mean: np.ndarray, weight: np.ndarray, members: Vector) -> tuple[np.ndarray, np.ndarray]:
    return weight, -weight @ (members.array - mean).ravel()


@dataclass(frozen=True, eq=False)
class Solution:
    """The adjustment ``problem`` linearised about a state: ``values``, the members of each block by its name."""

    problem: Adjustment
    values: dict[str, Any]

    @cached_property
    def cost(self) -> float:
        """Cost of the state, in σ²."""
        of_priors = sum(prior.cost(self.values[prior.block.name]) for prior in self.problem.priors)
        return sum(float(rows.factor.loss.cost(rows.length).sum()) for rows in self.rows) + of_priors

    @cached_property
    def places(self) -> dict[str, slice]:
        """Place of each kept block among the kept unknowns."""
        found, at = {}, 0
        for block in self.problem.blocks:
            if not block.eliminate:
                size = len(block.start) * block.start.dim
                found[block.name] = slice(at, at + size)
                at += size
        return found

    @property
    def kept(self) -> int:
        """Number of kept unknowns."""
        return max((at.stop for at in self.places.values()), default=0)

    @cached_property
    def held(self) -> np.ndarray:
        """Whether each kept unknown (k,) is fixed."""
        fixed = [np.repeat(block.fixed, block.start.dim) for block in self.problem.blocks if not block.eliminate]
        return np.concatenate([*fixed, np.zeros(0, bool)])

    @cached_property
    def dropped(self) -> Block | None:
        return next((block for block in self.problem.blocks if block.eliminate), None)

    @cached_property
    def rows(self) -> list[FactorRows]:
        """Whitened and weighted rows of all factors."""
        return [FactorRows.of(factor, self.values, self.problem.sigma) for factor in self.problem.factors]

    def equations(self, kinds: Collection[str] | None = None) -> Equations:
        """Return the equations of the residuals of some kinds, or of all, without prior knowledge."""
        dropped = self.dropped
        sums = Equations.nothing(self.kept, (len(dropped.start), dropped.start.dim) if dropped else (0, 1))
        square, count = 0.0, 0
        for rows in self._of(kinds):
            rows.add(sums, self.places)
            square, count = square + float((rows.residual**2).sum()), count + rows.residual.size
        return replace(sums, square=square, count=count)

    def _of(self, kinds: Collection[str] | None) -> list[FactorRows]:
        return self.rows if kinds is None else [own for rows in self.rows if (own := rows.of_kinds(kinds))]

    @cached_property
    def _all(self) -> Equations:
        """Equations of everything; fixed unknowns do not move."""
        sums = self.equations()
        for prior in self.problem.priors:
            at = self.places[prior.block.name]
            of_prior, pull = prior.equations(self.values[prior.block.name])
            sums.normal[at, at] += of_prior
            sums.right[at] += pull
        held = self.held
        sums.normal[held], sums.normal[:, held], sums.right[held] = 0.0, 0.0, 0.0  # of priors
        sums.normal[held, held] = 1.0
        own = np.einsum("mii->mi", sums.block)
        own[:] = np.where(own > 0, (1 + HELD) * own, 1.0)  # 1: fixed members, and what no row depends on
        return sums

    @cached_property
    def reduction(self) -> Reduction:
        """Elimination of the block that is not kept."""
        return reduce(self._all.block, self._all.block_right, self._all.cross)

    @cached_property
    def normal(self) -> np.ndarray:
        """Normal matrix (k, k) of the kept unknowns, the others eliminated."""
        return self._all.normal - self.reduction.normal

    @cached_property
    def right(self) -> np.ndarray:
        """Right side (k,) of the kept unknowns: minus half the gradient of the cost."""
        return self._all.right - self.reduction.right

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Return the step of kept, then eliminated unknowns, damped for the kept ones, and its predicted gain."""
        with np.errstate(all="ignore"):
            scale = np.sqrt(np.maximum(np.diag(self.normal), TINY))
            unit = self.normal / scale[:, None] / scale + damping * np.eye(self.kept)
        if not np.isfinite(unit).all():
            fault = "adjustment: no minimum, as its equations are not finite"
            raise ConvergenceError("E-NO-MINIMUM", f"{fault}; check the values and σ given")
        try:
            kept = cho_solve(cho_factor(unit), self.right / scale) / scale
        except LinAlgError:
            kept = np.linalg.lstsq(unit, self.right / scale, rcond=1e-12)[0] / scale
        gain = 2 * float(kept @ self.right) - float(kept @ self.normal @ kept) + self.reduction.gain
        return np.concatenate([kept, self.reduction.back(kept).ravel()]), gain

    @cached_property
    def inverse(self) -> np.ndarray:
        """Covariance (k, k) of the kept unknowns, of independent errors; the pseudo-inverse of a singular matrix."""
        try:
            found = np.linalg.inv(self.normal)
        except LinAlgError:
            found = generalised_inverse(self.normal)
        found[self.held, self.held] = 0.0
        return found

    def covariance(self, block: Block) -> np.ndarray:
        """Return the covariance (n·dim, n·dim) of a kept block, or (n, dim, dim) of each eliminated member."""
        if not block.eliminate:
            return self.inverse[self.places[block.name], self.places[block.name]]
        by = self.reduction.from_kept
        return self.reduction.inverse + by @ self.inverse @ np.swapaxes(by, 1, 2)

    def together(self, block: Block) -> np.ndarray:
        """Return the covariance (k + n·dim, k + n·dim) of all kept unknowns, and of the members of a block after them.

        A kept block stands in it twice.
        """
        by = self._each[block.name].reshape(-1, self.kept)
        mixed = by @ self.inverse
        own = mixed @ by.T
        if block.eliminate:
            own += block_diagonal(self.reduction.inverse)
        return np.block([[self.inverse, mixed.T], [mixed, own]])

    def by_clusters(self, block: Block) -> ByClusters:
        """Return the covariance of a kept block by how the clusters of observations differ."""
        normal, along = _alone(self.normal, self.places[block.name])
        return _by_clusters(normal, self.told(along))

    def effects(self, along: np.ndarray) -> Iterator[tuple[FactorRows, slice, np.ndarray]]:
        """Yield by batches the rows of each factor, the part of them that it is, and the derivatives (r, w, q) of this
        part by changes ``along`` (k, q) of the kept unknowns."""
        ways = self._ways(along)
        for rows in self.rows:
            for begin in range(0, len(rows.residual), AT_ONCE):
                batch = slice(begin, begin + AT_ONCE)
                yield rows, batch, rows.total(ways, batch)

    def told(self, along: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield of each factor with clusters their numbers (r,), the derivatives (r, w, q) of the rows by changes
        ``along`` (k, q) of the kept unknowns, and the residuals (r, w)."""
        for rows, batch, slope in self.effects(along):
            if rows.factor.cluster is not None:
                yield rows.factor.cluster[batch], slope, rows.residual[batch]

    def _ways(self, along: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return by block how its members (n, dim, q) change by ``along`` (k, q), or by each kept unknown if None."""
        every = np.eye(self.kept) if along is None else along
        kept = {b.name: (len(b.start), b.start.dim, every.shape[1]) for b in self.problem.blocks if not b.eliminate}
        ways = {name: every[self.places[name]].reshape(shape) for name, shape in kept.items()}
        if self.dropped:
            by = self.reduction.from_kept
            ways[self.dropped.name] = -by if along is None else -(by @ along)
        return ways

    @cached_property
    def _each(self) -> dict[str, np.ndarray]:
        return self._ways()

    def without(self, cluster: int) -> dict[str, Any]:
        """Return the values one step after leaving out a cluster (influence: Cook & Weisberg 1982)."""
        rest, others = self.problem.at(self.values), []
        for rows in self.rows:
            factor = rows.factor
            keep = np.ones(len(rows.residual), bool) if factor.cluster is None else factor.cluster != cluster
            slopes = [slope * keep[:, None, None] for slope in rows.slopes]
            others.append((keep, replace(rows, residual=rows.residual * keep[:, None], slopes=slopes)))
        if all(keep.all() for keep, _ in others):
            raise InputError("E-OPTION-NEEDS", f"adjustment: no row of cluster {cluster}; give one that factors have")
        vars(rest)["rows"] = [rows for _, rows in others]  # in place of what its cached property would compute
        return self.problem.moved(self.values, rest.step(0.0)[0])

    def redundancy(self, kind: str | None = None) -> float:
        """Return the redundancy of the rows of one kind, or of all."""
        left = 0.0
        for rows in self._of(None if kind is None else (kind,)):
            total = rows.total(self._each)
            taken = float(((total @ self.inverse) * total).sum())
            for (block, index), slope in zip(rows.factor.on, rows.slopes, strict=True):
                if block.eliminate:
                    inverse = self.reduction.inverse[numbers(index, slope)]
                    taken += float(((slope @ inverse) * slope).sum())
            left += rows.residual.shape[1] * np.count_nonzero(rows.weight) - taken
        return left

    def component(self, kind: str) -> float:
        """Return the factor on the σ of a kind that its residuals ask for (Förstner 1979)."""
        own = [rows for rows in self.rows if rows.factor.kind == kind]
        square = sum(float(rows.factor.loss.cost(rows.length).sum()) for rows in own)
        return sigma_factor(square, self.redundancy(kind))

    def components(self, kinds: Sequence[str], caution: float | np.ndarray = 0.0) -> Components:
        """Return what all residuals tell together about the σ of some ``kinds``, those of the others being known.

        ``caution`` : redundancy of each kind that is not counted. Prior knowledge must be factors.
        """
        others = {kind for factor in self.problem.factors for kind in factor.kinds} - set(kinds)
        each = [self.equations((kind,)) for kind in kinds]
        return Components(each, self.equations(others), caution=caution, held=LOOSE)


def _alone(normal: np.ndarray, at: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix (q, q) of some unknowns alone, and how all (k, q) go with them."""
    others = np.setdiff1d(np.arange(len(normal)), np.arange(len(normal))[at])
    rest = reduce(normal[None, others[:, None], others], np.zeros((1, len(others))), normal[None, others, at])
    along = np.empty((len(normal), rest.normal.shape[0]))
    along[at], along[others] = np.eye(len(rest.normal)), -rest.from_kept[0]
    return normal[at, at] - rest.normal, along


def _by_clusters(normal: np.ndarray, told: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> ByClusters:
    each = list(told)
    if not each:
        raise InputError("E-OPTION-NEEDS", "adjustment: no factor has clusters; state them")
    names = np.unique(np.concatenate([number for number, _, _ in each]))
    pulls, informations = np.zeros((len(names), len(normal))), np.zeros((len(names), *normal.shape))
    for number, slope, residual in each:
        square, pull = blocks_of(slope, -residual, np.searchsorted(names, number), len(names))
        pulls, informations = pulls + pull, informations + square
    return by_clusters(normal, pulls, informations)


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Adjustments that have blocks in common, such as those of groups of photographs by one camera.

    ``parts`` : the adjustments. The names of blocks that are not shared differ from part to part, as do the numbers of
    their clusters. ``shared`` : names of the blocks in common, the first ones of each part. What is known of them
    stands in one part only. All other unknowns are eliminated. ``free`` : returns of a state the orthonormal directions
    (s, f) of the shared unknowns in which nothing changes, such as motions of all points, if there are any; the datum
    is that of smallest trace over them.
    """

    parts: Sequence[Adjustment]
    shared: tuple[str, ...]
    free: Callable[[Mapping[str, Any]], np.ndarray] | None = None

    def cost(self, values: Mapping[str, Any]) -> float:
        """Return the cost of a state, in σ²."""
        return sum(part.cost(values) for part in self.parts)

    def moved(self, values: Mapping[str, Any], step: np.ndarray) -> dict[str, Any]:
        """Return the state after the steps of all parts, one after the other; shared blocks stand in each."""
        found, at = dict(values), 0
        for part in self.parts:
            own = {block.name: values[block.name] for block in part.blocks}
            size = sum(len(each) * each.dim for each in own.values())
            found |= part.moved(own, step[at : at + size])
            at += size
        return found

    def at(self, values: Mapping[str, Any]) -> "JoinedSolution":
        """Return the problem linearised about a state."""
        return JoinedSolution(self, dict(values))


@dataclass(frozen=True, eq=False)
class JoinedSolution:
    """Adjustments in common, linearised about ``values``."""

    problem: Joined
    values: dict[str, Any]

    @property
    def cost(self) -> float:
        """Cost of the state, in σ²."""
        return sum(part.cost for part in self.parts)

    @cached_property
    def parts(self) -> tuple[Solution, ...]:
        """The parts, each as if it were alone."""
        return tuple(part.at(self.values) for part in self.problem.parts)

    @cached_property
    def count(self) -> int:
        """Number of shared unknowns, the first ones of each part."""
        return max((self.parts[0].places[name].stop for name in self.problem.shared), default=0)

    @cached_property
    def reductions(self) -> list[tuple[Solution, Reduction]]:
        """The parts, each with the elimination of its own kept unknowns."""
        s = self.count
        return [(p, reduce(p.normal[None, s:, s:], p.right[None, s:], p.normal[None, s:, :s])) for p in self.parts]

    @cached_property
    def normal(self) -> np.ndarray:
        """Normal matrix of the shared unknowns, all others eliminated."""
        s = self.count
        return np.sum([part.normal[:s, :s] - own.normal for part, own in self.reductions], axis=0)

    @cached_property
    def right(self) -> np.ndarray:
        """Right side of the shared unknowns."""
        return np.sum([part.right[: self.count] - own.right for part, own in self.reductions], axis=0)

    @cached_property
    def inverse(self) -> np.ndarray:
        """Covariance of the shared unknowns, of independent errors."""
        return constrained_inverse(self.normal, self.free)

    @cached_property
    def free(self) -> np.ndarray:
        """Directions (s, f) in which nothing changes."""
        return self.problem.free(self.values) if self.problem.free else np.zeros((self.count, 0))

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Return the steps of all parts, damped for the shared unknowns alone, and their predicted gain."""
        own = np.diag(self.normal)
        held = self.normal + damping * np.diag(own) + datum(own, self.free)
        shared = np.linalg.solve(held, self.right)
        gain = 2 * float(shared @ self.right) - float(shared @ self.normal @ shared)
        steps = []
        for part, reduction in self.reductions:
            kept = np.concatenate([shared, reduction.back(shared)[0]])
            gain += reduction.gain + part.reduction.gain
            steps += [kept, part.reduction.back(kept).ravel()]
        return np.concatenate(steps), gain

    @cached_property
    def whole(self) -> tuple[Solution, ...]:
        """The parts, each with the covariance of its unknowns that all parts together leave."""
        found = []
        for part, reduction in self.reductions:
            by = reduction.from_kept[0]
            mixed = -by @ self.inverse
            covariance = np.block([[self.inverse, mixed.T], [mixed, reduction.inverse[0] - mixed @ by.T]])
            found.append(copy(part))
            vars(found[-1])["inverse"] = covariance  # what its cached property would compute of the part alone
        return tuple(found)

    def by_clusters(self, block: Block) -> ByClusters:
        """Return the covariance of a shared block by how the clusters of observations differ."""
        normal, along = _alone(self.normal, self.parts[0].places[block.name])
        ways = [(part, np.concatenate([along, -own.from_kept[0] @ along])) for part, own in self.reductions]
        return _by_clusters(normal, (told for part, way in ways for told in part.told(way)))
