"""What an identification is asked for, and what it answers."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Array, freeze
from stcal.robot.identification.adjustment import (
    Solution,
    Weighting,
)
from stcal.robot.identification.left import Finding
from stcal.robot.identification.nominal import Adjusted, Deviations, NominalRows, Placed
from stcal.robot.identification.observability import ObservabilityIndices
from stcal.robot.identification.predicted import Predicted
from stcal.robot.identification.residuals import (
    Kind,
    Observed,
    State,
)
from stcal.robot.identification.variances import Components
from stcal.robot.kinematics.model import Elasticity, Robot

Model = Literal["rigid", "elastic", "auto"]
LEAST_FOLDS = 2
BEYOND_CHANCE = 2.5
"""Standard errors by which one model's errors of held-out rows are to be below the other's. Rows of one fold share what
their solution errs by, so that a standard error of independent rows is too small: of rigid arms 2 would do for 95 %."""
OUTLIER_WEIGHT = 0.5
"""Observations of less are named: their residual is over twice Huber's limit."""


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """How :func:`identify` works.

    Parameters
    ----------
    observe : {"pose", "position", "distance"}, optional
        What of the measurements to use; the most that was measured if not given.
    sigma_mm, sigma_rad : float, optional
        σ of one coordinate of a position, mm, and of an orientation, rad; estimated where not given.
    robust : bool
        Whether outliers weigh less (Huber), and what are errors and no noise nothing at all.
    folds : int
        Of the cross-validation; 0 for none.
    repeats : int, optional
        Divisions into folds, in each of which every row is held out once; 5 of few rows, 1 of many, if not given.
    seed : int
        Of the divisions.
    partial : bool
        Keep nominal what the data do not determine, in place of refusing them.
    adjust : {"all", "geometry", "zeros", "base,tool"}
        Dimensions to adjust beside base and tools: all, all but the joints' zero positions, these alone, or none. What
        the robot file calls fixed stays in any case.
    model : {"rigid", "elastic", "auto"}
        Whether links give way to gravity and gears turn unevenly; ``auto`` takes what predicts held-out rows better by
        more than chance, and rigid where neither does.

    Raises
    ------
    InputError
        A σ that is not positive, or beyond 1 m or 1 rad.
    """

    observe: Kind | None = None
    sigma_mm: float | None = None
    sigma_rad: float | None = None
    robust: bool = True
    folds: int = 6
    repeats: int | None = None
    seed: int = 0
    partial: bool = False
    model: Model = "rigid"
    adjust: Adjusted = "all"

    def __post_init__(self):
        for name, value, most in (("sigma_mm", self.sigma_mm, 1e3), ("sigma_rad", self.sigma_rad, 1.0)):
            if value is not None and not 1e-12 <= value <= most:
                raise InputError("E-OPTION-RANGE", f"{name} is {value:g}; a number above 0, up to {most:g}, needed")
        if self.model == "auto" and self.folds < LEAST_FOLDS:
            raise InputError(
                "E-OPTION-RANGE",
                f"folds is {self.folds}: models are compared by rows held out; {LEAST_FOLDS} or more folds needed",
            )


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutRows:
    """Errors of rows that a fit had not seen: ``position_mm``, ``rotation_rad`` : (repeats, r), nan where there is
    none, as of rotations where positions were measured."""

    folds: int
    position_mm: np.ndarray
    rotation_rad: np.ndarray


@dataclass(frozen=True, slots=True)
class Gain:
    """What ``elastic`` predicts rows better by than ``rigid``: RMS errors of held-out rows by both, and the mean of the
    rows' differences with its standard error, mm."""

    rigid_mm: float
    elastic_mm: float
    gain_mm: float
    sigma_mm: float

    @classmethod
    def between(cls, rigid: HeldOutRows, elastic: HeldOutRows) -> "Gain":
        """Of the same rows by both."""
        both = [np.nanmean(each.position_mm, axis=0) for each in (rigid, elastic)]
        less = both[0] - both[1]
        less = less[np.isfinite(less)]
        before, after = (float(np.sqrt(np.nanmean(each.position_mm**2))) for each in (rigid, elastic))
        return cls(before, after, float(less.mean()), float(less.std(ddof=1) / np.sqrt(len(less))))

    @property
    def beyond_chance(self) -> bool:
        """Whether it is one."""
        return self.gain_mm > BEYOND_CHANCE * self.sigma_mm


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """A solution with the σ that go with it; ``notes`` : on what had not come to rest."""

    solution: Solution
    weighting: Weighting
    deviations: Deviations
    rows: NominalRows
    parts: Components
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Identified:
    """The identified robot, and how far to trust it; r observations, k parameters, n joints.

    Parameters
    ----------
    robot : Robot
        Base where the instrument stands, tools by target; mm, rad.
    seen : Observed
        The r observations.
    adjustment : Adjustment
        Solution, weights and σ; what is wanted of it is at hand as properties.
    names : tuple of str
        (k,) of the parameters, small motions of each joint's frame and of the tools (J2 ry: axis of joint 2 about its
        y, rad; tool x: mm).
    covariance : (k, k) array
        Of the parameters, rad and mm.
    rank : int
        Parameters that the data used determine.
    ranks : dict of str to int
        Parameters that these joint values determine, by kind of observation.
    undetermined : tuple of str
        Directions that were kept nominal, each by its parameters.
    nominal_mm : (r,) array
        Errors with nominal axes, base and tools fitted.
    held_out : HeldOutRows or None
        Errors of the cross-validation.
    predicted : Predicted or None
        σ of the tool's position by the covariance; None of distances.
    placed : tuple of Placed
        Base and tools of the robot, with σ.
    left : tuple of Finding or None
        What the residuals go with; None where observations are too few to tell.
    dh_sigma : (n, 5) array
        σ of a, alpha, d, theta, beta; mm, rad.
    observability : ObservabilityIndices
        Of the parameters that are determined.
    deviations : dict of str to float or None
        σ of this robot's dimensions about nominal, as the data show them, by name; mm, rad. Of elasticity: of what
        links give way by at the usual torque, and of gears, rad.
    elasticity_sigma : Elasticity or None
        σ of the robot's elasticity where it was adjusted.
    gain : Gain or None
        Where both models were tried.
    all_held_out : HeldOutRows or None
        Errors of the cross-validation with all dimensions adjusted, where some are kept.
    notes : tuple of str
        Rows left out, and what is to be known of the result.
    """

    robot: Robot
    seen: Observed
    adjustment: Adjustment
    names: tuple[str, ...]
    covariance: Array
    rank: int
    ranks: dict[str, int]
    undetermined: tuple[str, ...]
    nominal_mm: np.ndarray
    held_out: HeldOutRows | None
    predicted: Predicted | None
    placed: tuple[Placed, ...]
    left: tuple[Finding, ...] | None
    dh_sigma: np.ndarray
    observability: ObservabilityIndices
    deviations: dict[str, float | None]
    elasticity_sigma: Elasticity | None
    gain: Gain | None
    all_held_out: HeldOutRows | None
    notes: tuple[str, ...]

    def __post_init__(self):
        k = len(self.names)
        freeze(self, "covariance", (k, k), "covariance")

    @property
    def model(self) -> Model:
        """That was adjusted."""
        return "elastic" if self.state.elastic else "rigid"

    @property
    def state(self) -> State:
        """Chain and tools as identified."""
        return self.adjustment.solution.state

    @property
    def weighting(self) -> Weighting:
        """σ of the observations."""
        return self.adjustment.weighting

    @property
    def sigma0(self) -> float:
        """By how much the σ that were given have to be multiplied; 1 where they were estimated."""
        return self.weighting.factor

    @property
    def weights(self) -> np.ndarray:
        """(r,) Huber's weights."""
        return self.adjustment.solution.weights

    @property
    def residuals(self) -> np.ndarray:
        """(r, 6), (r, 3) or (r, 1) measured minus modelled, rad and mm, in the instrument's axes."""
        return self.adjustment.solution.residuals

    @property
    def fitted_mm(self) -> np.ndarray:
        """(r,) errors with identified axes."""
        return position_errors(self.residuals)

    def outliers(self) -> list[tuple[int, float]]:
        """(row of the observations, error in mm) of those that weigh less than half."""
        return [(int(i), float(self.fitted_mm[i])) for i in np.flatnonzero(self.weights < OUTLIER_WEIGHT)]


def position_errors(found: np.ndarray) -> np.ndarray:
    """(r,) position error, mm."""
    return np.linalg.norm(found[:, -3:], axis=1) if found.shape[1] > 1 else np.abs(found[:, 0])
