"""The free network of one group with its cofactors: random variation of residuals, circles and further parameters.
Whether further parameters are needed is a score test, without another adjustment (Rao 1948; Baarda 1968)."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import blocks_of, constrained_inverse, free_motions, reduce
from stcal.sfm.adjust.refine import projection_jacobians
from stcal.sfm.data.group_model import GroupModel

MIN_SHARE = 1e-6
"""Smallest share of a parameter's information that poses and points leave to it. Below this share, the parameter cannot
be separated from them."""
MIN_CONTROL = 0.1
"""Smallest redundancy of one coordinate at which the other observations control it: its residual then shows a tenth of
its error."""


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """An adjusted group, mm, with n observations, m images, p points."""

    model: GroupModel
    residual: np.ndarray  # (n, 2) over σ
    by_pose: np.ndarray  # (n, 2, 6) derivatives of the projections over σ
    by_point: np.ndarray  # (n, 2, 3)
    inverse: np.ndarray  # (m, 6, 6) of the poses' normal blocks
    coupling: np.ndarray  # (m, 6, 3p) between poses and points
    pose_right: np.ndarray  # (m, 6) right-hand sides after the adjustment, almost zero
    point_right: np.ndarray  # (3p,)
    covariance_mm2: np.ndarray  # (3p, 3p) of the points, in the datum of smallest trace
    residual_cofactor: np.ndarray  # (n, 2, 2) covariance of each residual over σ²

    def __post_init__(self):
        p = 3 * len(self.model.labels)
        freeze(self, "covariance_mm2", (p, p), "covariance")

    @property
    def redundancy(self) -> np.ndarray:
        """Redundancy of each observation, (n,), between 0 and 2."""
        return np.trace(self.residual_cofactor, axis1=1, axis2=2)

    def squares_of_observations(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the squared residuals over their own covariances, (n,), and the degrees of freedom, 0 to 2: a
        direction that the other observations hardly control tells nothing."""
        value, vector = np.linalg.eigh(self.residual_cofactor)
        held = value > MIN_CONTROL
        along = (np.swapaxes(vector, 1, 2) @ self.residual[..., None])[..., 0]
        square = np.where(held, along**2 / np.where(held, value, 1.0), 0.0)
        return square.sum(1), held.sum(1)

    def noise(self) -> float:
        """Returns the squared residual per degree of freedom of this group; 1 if that is less, as σ explain it."""
        return max(float((self.residual**2).sum() / max(self.redundancy.sum(), 1e-9)), 1.0)

    def square_by_image(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns squared residuals over σ² and redundancy of each image, (m,)."""
        square, redundancy = np.zeros((2, len(self.model.images)))
        np.add.at(square, self.model.image_index, (self.residual**2).sum(1))
        np.add.at(redundancy, self.model.image_index, self.redundancy)
        return square, redundancy

    def covariance_of(self, points: np.ndarray) -> np.ndarray:
        """Returns the covariance of some of the points, (3k, 3k)."""
        place = (3 * np.asarray(points)[:, None] + np.arange(3)).ravel()
        return self.covariance_mm2[np.ix_(place, place)]

    def pose_covariance(self) -> np.ndarray:
        """Returns (m, 6, 6) rad and mm, in the datum of the points, rotations perturbed on the left."""
        to_points = self.inverse @ self.coupling
        return self.inverse + to_points @ self.covariance_mm2 @ np.swapaxes(to_points, 1, 2)

    def score(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Equations (q, q), (q,) of parameters of the group by the derivatives ``columns`` (n, 2, q) over σ."""
        normal, right, to_points = self._by_image(columns)
        coupled = to_points.sum(0)
        weighted = coupled @ self.covariance_mm2
        return normal.sum(0) - weighted @ coupled.T, right.sum(0) - weighted @ self.point_right

    def score_by_image(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns :meth:`score` of separate parameters for each image: (m, q, q) and (m, q)."""
        normal, right, to_points = self._by_image(columns)
        weighted = to_points @ self.covariance_mm2
        return normal - weighted @ np.swapaxes(to_points, 1, 2), right - weighted @ self.point_right

    def score_of_image(self, image: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns :meth:`score` (2k, 2k), (2k,) of one parameter per coordinate of an image, the first ones first. They
        explain any residuals of the image, as if the image were left out."""
        rows = self.model.rows_by_image()[image]
        k, p = len(rows), len(self.model.labels)
        by_pose = np.concatenate([self.by_pose[rows, 0], self.by_pose[rows, 1]])
        to_points = np.zeros((2 * k, p, 3))
        for axis in range(2):
            to_points[axis * k + np.arange(k), self.model.point_index[rows]] = self.by_point[rows, axis]
        eliminated = by_pose @ self.inverse[image]
        coupled = to_points.reshape(2 * k, 3 * p) - eliminated @ self.coupling[image]
        weighted = coupled @ self.covariance_mm2
        right = self.residual[rows].T.ravel() - eliminated @ self.pose_right[image]
        return np.eye(2 * k) - eliminated @ by_pose.T - weighted @ coupled.T, right - weighted @ self.point_right

    def _by_image(self, e: np.ndarray):
        """Returns by image, without its pose: normal (m, q, q), right side (m, q), coupling to points (m, q, 3p)."""
        model = self.model
        m, q, p = len(model.images), e.shape[2], len(model.labels)
        normal, by_pose, right = np.empty((m, q, q)), np.empty((m, q, 6)), np.empty((m, q))
        for i, rows in enumerate(model.rows_by_image()):
            own = e[rows].reshape(-1, q).T
            normal[i], by_pose[i] = own @ own.T, own @ self.by_pose[rows].reshape(-1, 6)
            right[i] = own @ self.residual[rows].ravel()
        to_points = np.zeros((m, q, p, 3))
        to_points[model.image_index, :, model.point_index] = np.swapaxes(e, 1, 2) @ self.by_point
        eliminated = by_pose @ self.inverse
        return (
            normal - eliminated @ np.swapaxes(by_pose, 1, 2),
            right - np.einsum("mqi,mi->mq", eliminated, self.pose_right),
            to_points.reshape(m, q, 3 * p) - eliminated @ self.coupling,
        )


def free_network(model: GroupModel, camera: Camera) -> Network:
    """Returns the free network of an adjusted model."""
    by_pose, by_point = projection_jacobians(model, camera)
    a, b = model.whiten(by_pose), model.whiten(by_point)
    m, p = len(model.images), len(model.labels)
    residual = model.whiten(model.residuals_px(camera))
    coupling = np.zeros((m, p, 6, 3))
    coupling[model.image_index, model.point_index] = np.swapaxes(a, 1, 2) @ b
    coupling = coupling.transpose(0, 2, 1, 3).reshape(m, 6, 3 * p)
    poses, pose_right = blocks_of(a, residual, model.image_index, m)
    points, point_right = blocks_of(b, residual, model.point_index, p)
    reduction = reduce(poses, pose_right, coupling)
    normal = -reduction.normal
    place = 3 * np.arange(p)[:, None] + np.arange(3)
    normal[place[:, :, None], place[:, None]] += points
    covariance = constrained_inverse(normal, free_motions(model.xyz_model, scale=True))
    # cofactors of each adjusted observation, (n, 2, 2)
    inverse, weighted = reduction.inverse, reduction.from_kept @ covariance
    pose = inverse + weighted @ np.swapaxes(reduction.from_kept, 1, 2)
    mixed = weighted.reshape(m, 6, p, 3)[model.image_index, :, model.point_index]
    blocks = covariance.reshape(p, 3, p, 3)[np.arange(p), :, np.arange(p)]
    cross = a @ mixed @ np.swapaxes(b, 1, 2)
    of_poses = a @ pose[model.image_index] @ np.swapaxes(a, 1, 2)
    of_points = b @ blocks[model.point_index] @ np.swapaxes(b, 1, 2)
    cofactor = np.eye(2) - (of_poses - cross - np.swapaxes(cross, 1, 2) + of_points)
    right = point_right.ravel() - reduction.right
    return Network(model, residual, a, b, inverse, coupling, pose_right, right, covariance, cofactor)


@dataclass(frozen=True, slots=True, eq=False)
class ScoreTest:
    """Result of a score test: ``statistic`` follows χ² if no further parameter is needed."""

    estimate: np.ndarray
    covariance: np.ndarray
    statistic: float
    freedom: int


def solve_score(normal: np.ndarray, right: np.ndarray) -> ScoreTest:
    """Returns the test for the equations of :meth:`Network.score`, without directions that they do not determine."""
    own = np.diag(normal)
    scale = np.sqrt(np.where(own > 0, own, np.inf))  # a parameter that rounding alone determines counts for nothing
    value, vector = np.linalg.eigh(normal / np.outer(scale, scale))
    held = value > MIN_SHARE
    half = vector[:, held] / np.sqrt(value[held])
    half = half / scale[:, None]
    along = half.T @ right
    return ScoreTest(half @ along, half @ half.T, float(along @ along), int(held.sum()))
