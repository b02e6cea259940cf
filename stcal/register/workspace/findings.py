"""A registration with the data of its report: the points' lines, the residual field, the cubes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.geometry.arrays import Array, freeze
from stcal.parallel import one_thread
from stcal.register.core.models import MODELS, jacobian
from stcal.register.core.result import Registration
from stcal.register.workspace.field import Cubes, Field, cubes, residual_field


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """A registration and its checks.

    ``where`` : the file; ``lines`` : (n,) its lines; ``xyz_a`` : (n, 3) mm; ``field``, ``cubes`` : None if there are
    too few points.
    """

    where: str
    lines: Sequence[int]
    xyz_a: Array
    registration: Registration
    field: Field | None
    cubes: Cubes | None

    def __post_init__(self):
        freeze(self, "xyz_a", (len(self.registration), 3), "points")

    @property
    def length_mm(self) -> np.ndarray:
        """Lengths (n,) of the residuals, mm."""
        return np.linalg.norm(self.registration.residuals, axis=1)

    def middle(self) -> np.ndarray:
        """Middle (3,) of the inliers, frame a, mm."""
        return self.xyz_a[self.registration.inliers].mean(0)

    def sigma_mm_at(self, xyz_a: np.ndarray) -> np.ndarray:
        """Returns σ (3,) by the transform's covariance at a point of frame a, along b's axes."""
        found = self.registration
        by_step = jacobian(MODELS[found.model], found.b_from_a, xyz_a[None])[0]
        return np.sqrt(np.diag(by_step @ found.covariance @ by_step.T).clip(0))


@one_thread()
def findings(
    where: str,
    lines: Sequence[int],
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    registration: Registration,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
) -> Findings:
    """Returns a registration with its residual field and cubes. Arguments as in :func:`stcal.register.pipeline`."""
    field = residual_field(registration, xyz_a, xyz_b, weights, covariances)
    back = None if field is None else field.taken_back
    reach = cubes(registration, xyz_a, xyz_b, back, weights, covariances)
    return Findings(where, lines, xyz_a, registration, field, reach)
