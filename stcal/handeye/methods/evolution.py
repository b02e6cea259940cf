"""Hand-eye calibration by differential evolution on SE(3), as Jin et al. wrote it, and the same polished."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.least_squares import NormalEquations, minimise, perturbed
from stcal.geometry.rigid import Rigid, skew
from stcal.handeye.data.motions import Motions

EXACT = 1e-24
"""What a step at the minimum may promise, rad²: the objective is in no σ."""


@dataclass(frozen=True, slots=True)
class EvolutionOptions:
    """DE/rand/1/bin (Storn & Price 1997) with the values of the paper.

    Parameters
    ----------
    population, iterations : int
        M and the number of generations.
    factor, crossover : float
        F and CR.
    weight : float
        λ, with lengths in the unit that weighs like one radian (1 m where no σ are stated).
    reach_mm : float, optional
        Bounds of each coordinate of the translation where the population starts; those of the rotation vector are ±π.
        The paper takes them from knowledge of the set-up; without, the farthest board or flange.
    seed : int
    """

    population: int = 30
    iterations: int = 100
    factor: float = 0.5
    crossover: float = 0.9
    weight: float = 1.0
    reach_mm: float | None = None
    seed: int = 0

    def __post_init__(self):
        if self.population < 4 or self.iterations < 0 or not (self.weight > 0 and self.factor > 0):
            raise InputError(
                f"differential evolution: population {self.population}, {self.iterations} iterations, "
                f"F {self.factor:g}, λ {self.weight:g}; at least 4, not negative, and positive needed"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """f = Σ‖α − R_X β‖² + λ Σ‖(R_A − I) b_X + b_A − R_X b_B‖², lengths in ``unit_mm``; x = (log R_X, b_X)."""

    motions: Motions
    unit_mm: float
    weight: float

    def values(self, x: np.ndarray) -> np.ndarray:
        """(p,) of candidates (p, 6)."""
        turn = Rotation.from_rotvec(x[:, :3]).as_matrix()
        rotation, translation = self._parts(turn, x[:, 3:])
        return (rotation**2).sum((1, 2)) + self.weight * (translation**2).sum((1, 2))

    def linear(self, x: Rigid) -> NormalEquations:
        """About X, translation in mm."""
        rotation, translation = self._parts(x.rotation[None], x.translation[None] / self.unit_mm)
        root = np.sqrt(self.weight)
        white = np.concatenate([rotation[0], root * translation[0]]).ravel()
        jacobian = np.zeros((2, len(self.motions), 3, 6))
        jacobian[0, :, :, :3] = skew(self.motions.beta @ x.rotation.T)
        jacobian[1, :, :, :3] = root / self.unit_mm * skew(self.motions.camera.translation @ x.rotation.T)
        jacobian[1, :, :, 3:] = root / self.unit_mm * (self.motions.mount.rotation - np.eye(3))
        return NormalEquations.of(white, jacobian.reshape(-1, 6))

    def _parts(self, turn: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors (p, k, 3) of rotation and translation."""
        a, b = self.motions.mount, self.motions.camera
        rotation = self.motions.alpha - np.einsum("pij,kj->pki", turn, self.motions.beta)
        moved = np.einsum("kij,pj->pki", a.rotation - np.eye(3), shift) + a.translation / self.unit_mm
        return rotation, moved - np.einsum("pij,kj->pki", turn, b.translation / self.unit_mm)


def evolve(objective: Objective, reach_mm: float, options: EvolutionOptions) -> Rigid:
    """The best of the last generation. Mutants are not held within the bounds, which are those of the first one."""
    rng, size = np.random.default_rng(options.seed), options.population
    bounds = np.repeat([np.pi, (options.reach_mm or reach_mm) / objective.unit_mm], 3)
    x = rng.uniform(-bounds, bounds, (size, 6))
    value = objective.values(x)
    for _ in range(options.iterations):
        a, b, c = three_others(rng, size)
        mutant = x[a] + options.factor * (x[b] - x[c])
        trial = np.where(rng.random((size, 6)) <= options.crossover, mutant, x)
        trial_value = objective.values(trial)
        better = trial_value <= value
        x, value = np.where(better[:, None], trial, x), np.where(better, trial_value, value)
    best = x[np.argmin(value)]
    return Rigid.exp(np.concatenate([best[:3], objective.unit_mm * best[3:]]))


def three_others(rng: np.random.Generator, size: int) -> np.ndarray:
    """(3, size): for each of ``size`` candidates three others, all different."""
    order = rng.random((size, size))
    np.fill_diagonal(order, 2)  # oneself comes last
    return np.argsort(order, axis=1)[:, :3].T


def polish(objective: Objective, x: Rigid) -> Rigid:
    """The minimum of the objective next to X.

    Raises
    ------
    ConvergenceError
        None is reached.
    """
    found = minimise(x, objective.linear, perturbed, least_gain=EXACT)
    return found.required("differential evolution", "check the poses that fit worst").state
