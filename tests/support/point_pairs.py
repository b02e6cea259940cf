"""Corresponding points with known truth: the setting of Liu et al. (2017), some of the points wrong."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Affine, Rigid
from stcal.register.consensus import Transform

SIGMA_MM = 0.15
HALF_MM = 100.0
CENTRE_MM = (800.0, 200.0, 700.0)
OFF_MM = (2.0, 50.0)
B_FROM_A = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])


@dataclass(frozen=True, slots=True, eq=False)
class PointPairScene:
    """``xyz_a``, ``xyz_b`` : (n, 3) mm, b with noise; ``b_from_a`` : the truth; ``clean`` : (n,) mask."""

    xyz_a: np.ndarray
    xyz_b: np.ndarray
    b_from_a: Rigid
    clean: np.ndarray

    def __post_init__(self):
        n = len(self.clean)
        object.__setattr__(self, "xyz_a", frozen(self.xyz_a, (n, 3), "points of a"))
        object.__setattr__(self, "xyz_b", frozen(self.xyz_b, (n, 3), "points of b"))
        object.__setattr__(self, "clean", frozen(self.clean, (n,), "clean points", bool))


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


def cube(rng: np.random.Generator, n: int, half_mm: float = HALF_MM) -> np.ndarray:
    return np.array(CENTRE_MM) + rng.uniform(-half_mm, half_mm, (n, 3))


def random_rigid(rng: np.random.Generator) -> Rigid:
    """Any rotation, and a translation within 3 m along each axis."""
    seed = rng.integers(2**31)
    turn = Rotation.random(random_state=seed)  # the seeded stream of earlier figures
    return Rigid(turn.as_matrix(), rng.uniform(-3000, 3000, 3))


def _random(rng, xyz, off):
    return xyz + directions(rng, len(xyz)) * rng.uniform(*off, (len(xyz), 1))


def _one_shift(rng, xyz, off):
    return xyz + directions(rng, 1) * rng.uniform(*off)


def _other_motion(rng, xyz, off):
    middle = xyz.mean(0)
    turn = directions(rng, 1)[0] * rng.uniform(0.03, 0.5)
    return Rigid.exp([*turn, *(directions(rng, 1)[0] * rng.uniform(*off))]) @ (xyz - middle) + middle


WRONG: dict[str, Callable] = {"random": _random, "one shift": _one_shift, "other motion": _other_motion}
"""Ways for points to be wrong."""


def make_scene(
    rng: np.random.Generator,
    n: int = 100,
    share: float = 0.0,
    kind: str = "random",
    off_mm: tuple[float, float] = OFF_MM,
    sigma_mm: float = SIGMA_MM,
) -> PointPairScene:
    """n points in a cube of 200 mm, ``share`` of them wrong, by a distance within ``off_mm`` where that applies."""
    b_from_a = random_rigid(rng)
    xyz_a = cube(rng, n)
    xyz_b = b_from_a @ xyz_a + rng.normal(0, sigma_mm, (n, 3))
    wrong = rng.permutation(n)[: round(share * n)]
    if len(wrong):
        xyz_b[wrong] = WRONG[kind](rng, xyz_b[wrong], off_mm)
    clean = np.ones(n, bool)
    clean[wrong] = False
    return PointPairScene(xyz_a, xyz_b, b_from_a, clean)


def scene(seed, *args, **options) -> PointPairScene:
    return make_scene(np.random.default_rng(seed), *args, **options)


def parameter_error(found: Transform, truth: Transform) -> np.ndarray:
    """The step (p,) from truth to found: that of :meth:`~stcal.register.consensus.Problem.unit_covariance`."""
    (linear, translation), (true_linear, true_translation) = (
        (matrix[:3, :3], matrix[:3, 3]) for matrix in (found.matrix(), truth.matrix())
    )
    if not isinstance(found, Affine):
        scale = np.cbrt(np.linalg.det(linear) / np.linalg.det(true_linear))
        turn = Rotation.from_matrix(linear @ np.linalg.inv(true_linear) / scale).as_rotvec()
        error = [*turn, *(translation - true_translation)]
        return np.array(error if isinstance(found, Rigid) else [*error, scale - 1])
    return np.column_stack([linear - true_linear, translation - true_translation]).ravel()
