"""Rigid, similarity and affine transforms, exact or with covariance, and their least-squares alignment to points.

``a_from_b @ b_from_c == a_from_c`` and ``xyz_a = a_from_b @ xyz_b``. Covariances are those of rotation (rad) and
translation (mm), left perturbation in the outer frame.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import permutations, product
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar, cast, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Array, Brief, ByValue, freeze, frozen

ModelName = Literal["rigid", "similarity", "affine"]
Order = Literal["wxyz", "xyzw"]
"""Order of a quaternion's components; in tables by the names of columns (``wxyz``), or by their order (``xyzw``)."""
UNIT_WITHIN = 1e-3
"""Largest deviation of a quaternion's length from 1, as rounding to four printed digits may cause."""
SMALL_RAD = 1e-3  # angle below which the next term of a series is rounding error
NEAR_DEPTH = 1e-9  # depth that stands for a smaller one


def skew(v: ArrayLike) -> np.ndarray:
    """Return the cross-product matrices, shape (..., 3, 3), of vectors of shape (..., 3)."""
    v = np.asarray(v, float)
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return m - np.swapaxes(m, -1, -2)


def by_pose(by_point: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Return derivatives (..., 6) by a left perturbation of the pose that turned points to ``turned`` (..., 3) before
    its translation, from those (..., 3) by the points."""
    return np.concatenate([-by_point @ skew(turned), by_point], axis=-1)


def perspective(xyz_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ideal coordinates (..., 2) of points (..., 3) before a camera, and their derivatives (..., 2, 3)."""
    depth = xyz_camera[..., 2:]
    depth = np.where(np.abs(depth) > NEAR_DEPTH, depth, NEAR_DEPTH)
    by_point = np.zeros((*depth.shape[:-1], 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / depth[..., 0]
    by_point[..., 2] = -xyz_camera[..., :2] / depth**2
    return xyz_camera[..., :2] / depth, by_point


def _off_proper(x: list[float], y: list[float], z: list[float]) -> float:
    """Return the largest |R Rᵀ − 1| of rows, infinite if left-handed; numpy takes ten times as long for so few."""
    (a, b, c), (d, e, f), (g, h, i) = x, y, z
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
        return math.inf
    own = a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i
    across = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    return max(*(abs(square - 1) for square in own), *map(abs, across))


if TYPE_CHECKING:

    class Turn(Array):
        """Type of a field of rotation matrices, which accepts SciPy's rotations too."""

        def __set__(self, instance: object, value: ArrayLike | Rotation) -> None: ...

else:
    Turn = Array


class _Frames:
    __slots__ = ()
    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def _of(cls, rotation: np.ndarray, translation: np.ndarray) -> Self:
        """Return the transform of a product of rotations, which is one."""
        made = object.__new__(cls)
        for name, values in (("rotation", rotation), ("translation", translation)):
            object.__setattr__(made, name, values)
            values.flags.writeable = False
        return made

    def matrix(self) -> np.ndarray:
        """Return the homogeneous matrix, (..., 4, 4)."""
        m = np.zeros((*self.translation.shape[:-1], 4, 4))
        m[..., :3, :3], m[..., :3, 3], m[..., 3, 3] = self.rotation, self.translation, 1.0
        return m

    def inverse(self) -> Self:
        """Return b_from_a."""
        back = np.swapaxes(self.rotation, -1, -2)
        return self._of(np.ascontiguousarray(back), -(back @ self.translation[..., None])[..., 0])

    def _product(self, other: "_Frames") -> tuple[np.ndarray, np.ndarray]:
        """Return rotation and translation of a_from_c for b_from_c; one transform goes with each of a stack."""
        translation = (self.rotation @ other.translation[..., None])[..., 0]
        return self.rotation @ other.rotation, translation + self.translation

    def as_scipy(self) -> Rotation:
        """Return the rotation as SciPy's, of which quaternions, Euler angles and rotation vectors can be taken."""
        return Rotation.from_matrix(np.array(self.rotation))

    def moved(self, step: np.ndarray) -> Self:
        """Return the transform after a left perturbation (..., 6), rad and mm: exp(w) R, t + dt."""
        turn = Rotation.from_rotvec(step[..., :3]).as_matrix()
        return self._of(turn @ self.rotation, self.translation + step[..., 3:])

    def difference(self, other: Self) -> np.ndarray:
        """Return the motion (..., 6) from ``other`` to this: rotation vector (rad) and translation (mm) in frame a."""
        turn = Rotation.from_matrix(self.rotation @ np.swapaxes(other.rotation, -1, -2)).as_rotvec()
        return np.concatenate([turn, self.translation - other.translation], axis=-1)


F = TypeVar("F", "Rigid", "Poses", "Similarity")


@dataclass(frozen=True, slots=True, eq=False)
class Rigid(ByValue, _Frames):
    """A rigid transform a_from_b: ``xyz_a = rotation @ xyz_b + translation``.

    Parameters
    ----------
    rotation : (3, 3) array or Rotation
        A proper rotation; checked to 1e-6, then projected onto SO(3). SciPy's rotations are taken too.
    translation : (3,) array. Origin of b in a, mm.
    """

    rotation: Turn = field(default_factory=lambda: cast(Any, np.eye(3)))
    translation: Array = field(default_factory=lambda: cast(Any, np.zeros(3)))

    def __post_init__(self):
        if isinstance(self.rotation, Rotation):
            object.__setattr__(self, "rotation", self.rotation.as_matrix())
        freeze(self, "rotation", (3, 3), "rotation")
        freeze(self, "translation", (3,), "translation")
        deviation = _off_proper(*self.rotation.tolist())
        if deviation > 1e-6:
            raise InputError("E-ROTATION-IMPROPER", "rotation: improper; orthogonal with determinant +1 needed")
        if deviation > 1e-12:  # projected onto SO(3), or a product of accepted rotations could be refused
            object.__setattr__(self, "rotation", frozen(best_rotations(self.rotation)[0]))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> "Rigid":
        """Return the transform of a 4×4 (or 3×4) homogeneous matrix; the rotation part is projected onto SO(3)."""
        m = frozen(matrix, what="rigid transform")
        if m.shape not in ((4, 4), (3, 4)):
            raise InputError("E-ARRAY-SHAPE", f"rigid transform: shape {m.shape}, 4×4 needed")
        if (m[3:] != [0, 0, 0, 1]).any():
            fault = f"rigid transform: last row {m[3].tolist()}, 0 0 0 1 needed"
            raise InputError("E-MATRIX-LAST-ROW", f"{fault}; is it transposed?")
        u, s, vt = np.linalg.svd(m[:3, :3])
        if np.linalg.det(m[:3, :3]) <= 0 or np.abs(s - 1).max() > 1e-3:
            raise InputError("E-ROTATION-IMPROPER", "rigid transform: 3×3 part is no rotation (left-handed or scaled)")
        return cls(u @ vt, m[:3, 3])

    @classmethod
    def exp(cls, twist: ArrayLike) -> "Rigid":
        """Return the transform of a rotation vector (rad) and a translation (mm), (6,): not the SE(3) exponential, but
        the product perturbation ``(exp(w), t)`` in which the package states pose covariances."""
        motion = np.array(frozen(twist, (6,), "rotation vector and translation"))
        return cls(Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:])

    def log(self) -> np.ndarray:
        """Return rotation vector (rad) and translation (mm), (6,): the inverse of :meth:`exp`."""
        return np.concatenate([self.as_scipy().as_rotvec(), self.translation])

    def log_sigma(self, covariance: np.ndarray) -> np.ndarray:
        """Return the σ (6,) of :meth:`log`, rad and mm, from the covariance (6, 6) of a left perturbation. A small
        turn ω moves the rotation vector φ by the inverse left Jacobian of SO(3), (φ/2) cot(φ/2) ω across φ, and by
        half of ω × φ; σ about the axes are those of its components for small φ only (Barfoot, "State Estimation for
        Robotics", 2017, sec. 7.1.5)."""
        turn = self.log()[:3]
        angle = float(np.linalg.norm(turn))
        across = 1 / 12 if angle < SMALL_RAD else (1 - angle / 2 / math.tan(angle / 2)) / angle**2
        by_turn = np.eye(3) - skew(turn) / 2 + across * skew(turn) @ skew(turn)
        squares = np.concatenate([np.diag(by_turn @ covariance[:3, :3] @ by_turn.T), np.diag(covariance)[3:]])
        return np.sqrt(np.maximum(squares, 0))

    @overload
    def __matmul__(self, other: F) -> F: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> np.ndarray: ...
    def __matmul__(self, other):
        """Return a_from_c for transforms b_from_c, or points in frame a for points (..., 3) in frame b, mm."""
        if isinstance(other, _Frames):
            return other._of(*self._product(other))
        if isinstance(other, Similarity):
            return Similarity(1.0, self) @ other
        return np.asarray(other, float) @ self.rotation.T + self.translation

    def angle_rad(self) -> float:
        """Return the angle of the rotation, in [0, π]."""
        return float(self.as_scipy().magnitude())


@dataclass(frozen=True, slots=True, eq=False)
class Similarity(ByValue):
    """A similarity a_from_b, ``xyz_a = scale * rotation @ xyz_b + translation``, as from COLMAP's unitless world."""

    scale: float
    rigid: Rigid

    def __post_init__(self):
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError("E-SCALE-VALUE", f"similarity: scale {self.scale}, a positive number needed")

    @classmethod
    def of(cls, linear: np.ndarray, translation: np.ndarray) -> "Similarity":
        """Return the similarity of a linear part (3, 3), a rotation times a scale, and a translation (3,)."""
        scale = float(np.cbrt(np.linalg.det(linear)))
        return cls(scale, Rigid(linear / scale, translation))

    def matrix(self) -> np.ndarray:
        """Return the homogeneous 4×4 matrix, with the scale in its 3×3 part."""
        m = self.rigid.matrix()
        m[:3, :3] *= self.scale
        return m

    def inverse(self) -> "Similarity":
        """Return b_from_a."""
        inverse = self.rigid.inverse()
        return Similarity(1 / self.scale, Rigid(inverse.rotation, inverse.translation / self.scale))

    @overload
    def __matmul__(self, other: "Similarity | Rigid") -> "Similarity": ...
    @overload
    def __matmul__(self, other: ArrayLike) -> np.ndarray: ...
    def __matmul__(self, other):
        """Return a_from_c for a transform b_from_c, or points in frame a for points (..., 3) in frame b."""
        if isinstance(other, Similarity):
            rotation = self.rigid.rotation @ other.rigid.rotation
            return Similarity(self.scale * other.scale, Rigid(rotation, self @ other.rigid.translation))
        if isinstance(other, Rigid):
            return self @ Similarity(1.0, other)
        return self.scale * (np.asarray(other, float) @ self.rigid.rotation.T) + self.rigid.translation


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Poses(Brief, _Frames):
    """A stack of m transforms a_from_b; indexed by a number it gives one :class:`Rigid`.

    Parameters
    ----------
    rotation : (m, 3, 3) array. Proper rotations, to 1e-6.
    translation : (m, 3) array. Origins of b in a, mm.
    """

    rotation: Array
    translation: Array

    def __post_init__(self):
        freeze(self, "translation", (None, 3), "translations")
        freeze(self, "rotation", (len(self.translation), 3, 3), "rotations")
        r = self.rotation
        if len(r) and ((np.linalg.det(r) < 0).any() or np.abs(r @ np.swapaxes(r, 1, 2) - np.eye(3)).max() > 1e-6):
            raise InputError("E-ROTATION-IMPROPER", "rotations: improper; orthogonal with determinant +1 needed")

    @classmethod
    def of(cls, transforms: Iterable[Rigid]) -> "Poses":
        """Return the stack of single transforms."""
        transforms = list(transforms)
        rotation = np.array([t.rotation for t in transforms], float).reshape(-1, 3, 3)
        return cls._of(rotation, np.array([t.translation for t in transforms], float).reshape(-1, 3))

    @classmethod
    def from_matrices(cls, matrices: ArrayLike) -> "Poses":
        """Return the transforms of homogeneous matrices (m, 4, 4), mm, with rotations projected onto SO(3); of one that
        is not finite, left-handed, scaled or transposed the number is named."""
        rigid = []
        for number, matrix in enumerate(frozen(matrices, (None, None, None), "poses", finite=False), 1):
            try:
                rigid.append(Rigid.from_matrix(matrix))
            except InputError as error:
                raise InputError(error.code, f"pose {number}: {error}") from error
        return cls.of(rigid)

    @classmethod
    def from_quaternions(cls, wxyz: ArrayLike, translation: ArrayLike) -> "Poses":
        """Return the transforms of quaternions (m, 4), w first, unit to 1e-3, and translations (m, 3), mm."""
        wxyz = frozen(wxyz, (None, 4), "quaternions")
        off = np.abs(np.linalg.norm(wxyz, axis=1) - 1)
        if len(off) and off.max() > UNIT_WITHIN:
            fault = f"quaternion {off.argmax() + 1}: length off by {off.max():.3g}"
            raise InputError("E-QUATERNION-LENGTH", f"{fault}, {UNIT_WITHIN} allowed")
        return cls(Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix(), translation)

    def quaternions(self) -> np.ndarray:
        """Return the quaternions (m, 4), w first and not negative."""
        return self.as_scipy().as_quat(canonical=True)[:, [3, 0, 1, 2]]

    @property
    def dim(self) -> int:
        """Number of unknowns of a pose."""
        return 6

    def __len__(self) -> int:
        return len(self.translation)

    @overload
    def __getitem__(self, index: int | np.integer) -> Rigid: ...
    @overload
    def __getitem__(self, index: slice | np.ndarray | Sequence[int]) -> "Poses": ...
    def __getitem__(self, index):
        """Return one :class:`Rigid` for an integer, :class:`Poses` for a slice, mask or list."""
        if np.ndim(index) == 0 and not isinstance(index, slice):
            return Rigid(self.rotation[index], self.translation[index])
        return Poses._of(self.rotation[index], self.translation[index])

    def __add__(self, other: "Poses") -> "Poses":
        """Return these transforms, then those of ``other``."""
        both = np.concatenate([self.rotation, other.rotation])
        return Poses._of(both, np.concatenate([self.translation, other.translation]))

    def __iter__(self) -> Iterator[Rigid]:
        return (self[i] for i in range(len(self)))

    @overload
    def __matmul__(self, other: "Rigid | Poses") -> "Poses": ...
    @overload
    def __matmul__(self, other: ArrayLike) -> np.ndarray: ...
    def __matmul__(self, other):
        """Return a_from_c for a :class:`Rigid` or m :class:`Poses` b_from_c; points (m, 3) for one or m points."""
        if isinstance(other, _Frames):
            return self._of(*self._product(other))
        points = np.broadcast_to(np.asarray(other, float), self.translation.shape)
        return np.einsum("mij,mj->mi", self.rotation, points) + self.translation


@dataclass(frozen=True, slots=True, eq=False)
class Affine(ByValue):
    """An affine transform a_from_b of twelve parameters, ``linear`` (3, 3) and ``translation`` (3,), mm."""

    linear: Array
    translation: Array

    def __post_init__(self):
        freeze(self, "linear", (3, 3), "linear part")
        freeze(self, "translation", (3,), "translation")

    def matrix(self) -> np.ndarray:
        """Return the homogeneous 4×4 matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.linear, self.translation
        return m

    def inverse(self) -> "Affine":
        """Return b_from_a; a singular linear part is refused."""
        if np.linalg.cond(self.linear) > 1e12:
            raise DegenerateError("E-AFFINE-SINGULAR", "affine transform: singular 3×3 part; an invertible one needed")
        back = np.linalg.inv(self.linear)
        return Affine(back, -back @ self.translation)

    def __matmul__(self, other: ArrayLike) -> np.ndarray:
        """Return points in frame a for points (..., 3) in frame b, mm."""
        return np.asarray(other, float) @ self.linear.T + self.translation


def other_axes(xyz: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yields points (m, 3) in every other order and sign of their axes: its name, like ``y, x, −z``, and the points."""
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        if (order, signs) != ((0, 1, 2), (1, 1, 1)):
            names = ", ".join(("−" if sign < 0 else "") + "xyz"[k] for k, sign in zip(order, signs, strict=True))
            yield names, xyz[:, order] * signs


def align_rigid(xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray | None = None) -> Rigid:
    """Return the a_from_b that minimises Σ wᵢ‖aᵢ − a_from_b bᵢ‖² (Kabsch 1976, with Umeyama's sign). ``xyz_a``,
    ``xyz_b`` : (n, 3), n ≥ 3, those of positive weight not collinear, else DegenerateError; ``weights`` : (n,)"""
    return Rigid(*align(xyz_a, xyz_b, weights, "rigid"))


def align_similarity(xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray | None = None) -> Similarity:
    """Return a_from_b with scale (Umeyama 1991); arguments and errors as :func:`align_rigid`."""
    return Similarity.of(*align(xyz_a, xyz_b, weights, "similarity"))


def align(xyz_a, xyz_b, weights: np.ndarray | None, model: ModelName) -> tuple[np.ndarray, np.ndarray]:
    """Return linear part (3, 3) and translation (3,) of a_from_b; arguments and errors as :func:`align_rigid`. Affine
    ones need four points or more off a plane."""
    a, b, needed = np.asarray(xyz_a, float), np.asarray(xyz_b, float), 4 if model == "affine" else 3
    if a.shape != b.shape or len(a) < needed:
        raise DegenerateError("E-POINTS-FEW", f"alignment: {len(a)} and {len(b)} points, {needed} or more pairs needed")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, float)
    if (w < 0).any() or not w.any():
        raise DegenerateError("E-ALIGN-WEIGHTS", "alignment: weights are negative or all zero; positive weights needed")
    used = slice(None) if weights is None else w > 0
    if model == "affine" and _rank_below(3, b[used]):
        fault = "alignment: the points are coplanar"
        raise DegenerateError("E-POINTS-COPLANAR", f"{fault}; an affine transform needs points off the plane")
    if _rank_below(2, a[used]) or _rank_below(2, b[used]):
        raise DegenerateError("E-POINTS-COLLINEAR", "alignment: the points are collinear; points off the line needed")
    (linear,), (translation,) = alignments(a[None], b[None], w / w.sum(), model)
    return linear, translation


def alignments(
    xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray, model: ModelName
) -> tuple[np.ndarray, np.ndarray]:
    """Return linear parts (s, 3, 3) and translations (s, 3) of a_from_b for sets of points (s, n, 3) with weights (n,)
    of sum 1. Those of degenerate sets are finite and wrong."""
    mean_a, mean_b = weights @ xyz_a, weights @ xyz_b
    a, b = xyz_a - mean_a[:, None], xyz_b - mean_b[:, None]
    if model == "affine":  # not by squares, which lose points that are off a plane by little
        root = np.sqrt(weights)[:, None]
        linear = np.swapaxes(np.linalg.pinv(root * b) @ (root * a), 1, 2)
    else:
        linear, product = best_rotations(np.swapaxes(weights[:, None] * a, 1, 2) @ b)
        if model == "similarity":
            linear = linear * (product / np.maximum(np.einsum("snk,snk,n->s", b, b, weights), 1e-300))[:, None, None]
    return linear, mean_a - (linear @ mean_b[:, :, None])[:, :, 0]


def best_rotations(cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations R that maximise tr(Rᵀ cross), (..., 3, 3), and these maxima: those of a_from_b if ``cross``
    is Σ wᵢ aᵢ bᵢᵀ of centred points (Kabsch 1976)."""
    u, s, vt = np.linalg.svd(cross)
    sign = np.ones(s.shape)
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * sign[..., None, :]) @ vt, (s * sign).sum(-1)


def _rank_below(rank: int, points: np.ndarray) -> bool:
    """Return whether points (n, 3) lie in fewer dimensions than ``rank``."""
    centred = points - points.sum(0) / len(points)
    values = np.linalg.eigvalsh(centred.T @ centred)
    if values[3 - rank] > 1e-12 * values[2]:  # clear without the SVD, which is slow for a million points
        return False
    s = np.linalg.svd(centred, compute_uv=False)
    return len(s) < rank or s[rank - 1] <= 1e-9 * s[0]


class ImageFit:
    """Statistics of a pose's residuals in an image."""

    __slots__ = ()
    residuals_px: np.ndarray
    chi2: float
    redundancy: int

    def rms_px(self) -> float:
        """Return the RMS of the residuals per coordinate."""
        return float(np.sqrt((self.residuals_px**2).mean()))

    def chi2_per_redundancy(self) -> float:
        """Return χ² per redundancy; it is about 1 if the σ of points, target and intrinsics are true."""
        return self.chi2 / self.redundancy

    def p_value(self) -> float:
        """Return the probability of residuals at least as large if the stated σ are true."""
        return float(chdtrc(self.redundancy, self.chi2))


@dataclass(frozen=True, slots=True, eq=False)
class UncertainRigid:
    """A transform a_from_b with ``covariance`` (6, 6) of its errors, R' = exp(w) R, t' = t + dt; zero if exact."""

    rigid: Rigid
    covariance: Array

    def __post_init__(self):
        freeze(self, "covariance", (6, 6), "pose covariance")

    @classmethod
    def exact(cls, rigid: Rigid) -> "UncertainRigid":
        """Return the transform with a covariance of zero."""
        return cls(rigid, np.zeros((6, 6)))

    def __matmul__(self, other: "UncertainRigid") -> "UncertainRigid":
        """Return a_from_c with its covariance to first order, the errors of both transforms being independent."""
        arm = self.rigid.rotation @ other.rigid.translation
        by_self, by_other = np.eye(6), np.zeros((6, 6))
        by_self[3:, :3] = -skew(arm)
        by_other[:3, :3] = by_other[3:, 3:] = self.rigid.rotation
        covariance = by_self @ self.covariance @ by_self.T + by_other @ other.covariance @ by_other.T
        return UncertainRigid(self.rigid @ other.rigid, (covariance + covariance.T) / 2)
