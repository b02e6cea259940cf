"""Hand-eye calibration by differential evolution on SE(3), as Jin et al. wrote it, and the same with a final
descent."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Rigid, skew
from stcal.handeye.data.pose_pairs import Motions

MOST = 100_000
"""Largest number of candidates, and of generations."""
EXACT = 1e-24
"""Gain of a step at which the minimum is reached, rad²: the objective is not in units of any σ."""
FARTHEST = 1e9
"""Largest number of bounds, mm or rad: a thousand kilometres."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of three coordinates of the first population.

    ``half_width`` : mm, or rad of the rotation vector; ``centre`` : (3,) centre of the bounds; where None, that of the
    closed-form solution (Park & Martin 1994).

    Raises InputError: the half width is not positive, or a number is not finite or beyond :data:`FARTHEST`.
    """

    half_width: float
    centre: tuple[float, float, float] | None = (0.0, 0.0, 0.0)

    def __post_init__(self):
        require_fields(self, "differential evolution")
        if not (0 < self.half_width <= FARTHEST and (np.abs(self.centre or 0) <= FARTHEST).all()):
            raise InputError(
                "E-EVOLUTION-OPTIONS",
                f"differential evolution: bounds of half width {self.half_width:g} about {self.centre}; numbers up to "
                f"{FARTHEST:g} and a positive half width needed",
            )

    def in_words(self, factor: float, unit: str) -> str:
        """Returns the bounds in words, times ``factor``."""
        about = "the closed-form solution" if self.centre is None else "zero"
        if any(self.centre or ()):
            about = ", ".join(f"{factor * coordinate:g}" for coordinate in self.centre or ()) + unit
        return f"±{factor * self.half_width:.4g}{unit} about {about}"


@dataclass(frozen=True, slots=True)
class EvolutionOptions:
    """DE/rand/1/bin (Storn & Price 1997) with the values of the paper.

    Parameters
    ----------
    population, generations : M and the number of generations
    factor, crossover : F and CR
    weight : λ, with lengths in the unit that weighs like one radian (1 m where no σ are stated)
    bounds_rad : bounds of the rotation vectors of the first population. The paper takes them from knowledge of the
        set-up; its values are not legible in the source.
    bounds_mm : bounds of its translations; where None, about zero, as wide as the distance of the farthest board or
        flange
    seed : int
    """

    population: int = 30
    generations: int = 100
    factor: float = 0.5
    crossover: float = 0.9
    weight: float = 1.0
    bounds_rad: Bounds = Bounds(np.pi)
    bounds_mm: Bounds | None = None
    seed: int = 0

    def __post_init__(self):
        require_fields(self, "differential evolution", seed=0)
        if not (
            4 <= self.population <= MOST
            and 0 <= self.generations <= MOST
            and 0 < self.weight < np.inf
            and 0 < self.factor <= 2
            and 0 <= self.crossover <= 1
        ):
            raise InputError(
                "E-EVOLUTION-OPTIONS",
                f"differential evolution: population {self.population}, {self.generations} generations, F "
                f"{self.factor:g}, CR {self.crossover:g}, λ {self.weight:g}; 4 to {MOST}, 0 to {MOST}, above 0 to 2, 0 "
                "to 1, and a positive number needed",
            )

    def needs_closed_form(self) -> bool:
        """True if some bounds lie about the closed-form solution."""
        return any(bounds is not None and bounds.centre is None for bounds in (self.bounds_rad, self.bounds_mm))

    def in_words(self, unit_mm: float) -> str:
        """Returns in words the settings that the paper leaves to choose, or that its copy does not show."""
        turn = self.bounds_rad.in_words(180 / np.pi, "°")
        shift = self.bounds_mm.in_words(1.0, " mm") if self.bounds_mm else "as far as the farthest pose about zero"
        return (
            f"differential evolution: first population {turn} and {shift}; λ {self.weight:g} with lengths in units of "
            f"{unit_mm:g} mm; the paper's own bounds are not legible, and what it reaches depends on them"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """Objective f = Σ‖α − R_X β‖² + λ Σ‖(R_A − I) b_X + b_A − R_X b_B‖², lengths in ``unit_mm``; x = (log R_X, b_X)."""

    motions: Motions
    unit_mm: float
    weight: float

    def values(self, x: np.ndarray) -> np.ndarray:
        """Returns the objective (p,) of candidates (p, 6)."""
        turn = Rotation.from_rotvec(x[:, :3]).as_matrix()
        rotation, translation = self._parts(turn, x[:, 3:])
        return (rotation**2).sum((1, 2)) + self.weight * (translation**2).sum((1, 2))

    def linear(self, x: Rigid) -> NormalEquations:
        """Returns the normal equations about X, translation in mm."""
        rotation, translation = self._parts(x.rotation[None], x.translation[None] / self.unit_mm)
        root = np.sqrt(self.weight)
        white = np.concatenate([rotation[0], root * translation[0]]).ravel()
        jacobian = np.zeros((2, len(self.motions), 3, 6))
        jacobian[0, :, :, :3] = skew(self.motions.beta @ x.rotation.T)
        jacobian[1, :, :, :3] = root / self.unit_mm * skew(self.motions.camera.translation @ x.rotation.T)
        jacobian[1, :, :, 3:] = root / self.unit_mm * (self.motions.mount.rotation - np.eye(3))
        return NormalEquations.of(white, jacobian.reshape(-1, 6))

    def _parts(self, turn: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the errors (p, k, 3) of rotation and translation."""
        a, b = self.motions.mount, self.motions.camera
        rotation = self.motions.alpha - np.einsum("pij,kj->pki", turn, self.motions.beta)
        moved = np.einsum("kij,pj->pki", a.rotation - np.eye(3), shift) + a.translation / self.unit_mm
        return rotation, moved - np.einsum("pij,kj->pki", turn, b.translation / self.unit_mm)


def evolve(objective: Objective, options: EvolutionOptions, reach_mm: float, closed_form: Rigid | None = None) -> Rigid:
    """Returns the best candidate of the last generation; bounds limit the first one only. ``reach_mm``, ``closed_form``
    : half width and centre of bounds that have none."""
    rng, size = np.random.default_rng(options.seed), options.population
    about = np.zeros(6) if closed_form is None else closed_form.log()
    parts = options.bounds_rad, options.bounds_mm or Bounds(reach_mm)
    own = (about[:3], about[3:])
    centre = np.concatenate([a if b.centre is None else b.centre for a, b in zip(own, parts, strict=True)])
    scale = np.repeat([1.0, 1 / objective.unit_mm], 3)
    centre, half = centre * scale, np.repeat([bounds.half_width for bounds in parts], 3) * scale
    x = rng.uniform(centre - half, centre + half, (size, 6))
    value = objective.values(x)
    for _ in range(options.generations):
        a, b, c = three_others(rng, size)
        mutant = x[a] + options.factor * (x[b] - x[c])
        trial = np.where(rng.random((size, 6)) <= options.crossover, mutant, x)
        trial_value = objective.values(trial)
        better = trial_value <= value
        x, value = np.where(better[:, None], trial, x), np.where(better, trial_value, value)
    best = x[np.argmin(value)]
    return Rigid.exp(np.concatenate([best[:3], objective.unit_mm * best[3:]]))


def three_others(rng: np.random.Generator, size: int) -> np.ndarray:
    """Returns three other candidates for each of ``size`` candidates, all different, (3, size)."""
    order = rng.random((size, size))
    np.fill_diagonal(order, 2)  # the candidate itself comes last
    return np.argsort(order, axis=1)[:, :3].T


def polish(objective: Objective, x: Rigid) -> Rigid:
    """Returns the minimum of the objective next to X; raises ConvergenceError."""
    minimum = minimise(x, objective.linear, Rigid.moved, least_gain=EXACT)
    return minimum.required("differential evolution", "check the poses that fit worst").state
