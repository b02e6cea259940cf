"""Contribution of each kind of observation to the covariance of the circles, and effect of unobserved errors.

Unobserved errors are those of the board's pitch and of fixed intrinsics: no observation of the adjustment carries them.

To first order the adjusted circles are x = G l, with the observations l and G = N⁻¹AᵀW. The law of propagation of
uncertainty (JCGM 100:2008, 5.1.2 and E.3) turns the covariance S of one kind of observation into G S Gᵀ. With the
weights of the adjustment these contributions add up to the covariance of the adjustment, N⁻¹.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stcal.geometry.arrays import frozen
from stcal.geometry.normal_equations import constrained_inverse
from stcal.geometry.rigid import skew
from stcal.io.cameras.model import PARAMETER_NAMES
from stcal.sfm.adjust.blocks import Block, Reduced, robust_weights
from stcal.sfm.adjust.equations import Setting, Shared, free_directions, normal_equations, planes
from stcal.sfm.adjust.group import projection_jacobians
from stcal.sfm.adjust.joint import Adjusted, JointResult

CIRCLES, DOTS, BOARD, FLATNESS, INTRINSICS = "circles", "dots", "board", "flatness", "intrinsics"
OBSERVED = (CIRCLES, DOTS, BOARD, FLATNESS, INTRINSICS)
"""Kinds of observations: centres of circles and of dots in the images, positions of the dots on the board, flatness of
the faces, and the given intrinsics if they are adjusted."""
AT_ONCE = 10_000
"""Number of observations that are processed together; it bounds the memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Contributions:
    """Contributions to the covariance of the c circles, in the datum of the adjustment.

    ``joint`` : result of the adjustment; ``covariance_mm2`` : (3c, 3c) by kind of observation, which add up to the
    covariance of ``joint``; ``by_scale`` : (3c,) mm, error of the circles per relative error of the board's pitch;
    ``by_intrinsics`` : (3c, 16), error of the circles per error of the intrinsics if these are fixed, else zero;
    ``centre_sigma_px`` : σ of the centres of circles and of dots, RMS per axis, scaled by σ₀ of the adjustment.
    """

    joint: JointResult
    covariance_mm2: dict[str, np.ndarray]
    by_scale: np.ndarray
    by_intrinsics: np.ndarray
    centre_sigma_px: dict[str, float]

    def __post_init__(self):
        c = 3 * len(self.joint.labels)
        fixed = {kind: frozen(matrix, (c, c), f"{kind}: covariance") for kind, matrix in self.covariance_mm2.items()}
        object.__setattr__(self, "covariance_mm2", fixed)
        object.__setattr__(self, "by_scale", frozen(self.by_scale, (c,), "scale"))
        object.__setattr__(self, "by_intrinsics", frozen(self.by_intrinsics, (c, len(PARAMETER_NAMES)), "intrinsics"))


def contributions_of(state: Adjusted) -> Contributions:
    """Splits the covariance at the minimum of an adjustment into the contributions of the observations."""
    blocks, shared, setting, joint = state.blocks, state.shared, state.setting, state.result()
    normal, _, groups = normal_equations(blocks, shared, setting)
    c = shared.xyz_model.size
    inverse = constrained_inverse(normal, free_directions(len(normal), shared))[:, :c]
    covariance = {kind: np.zeros((c, c)) for kind in OBSERVED}
    by_scale, by_intrinsics = np.zeros(c), np.zeros((c, len(PARAMETER_NAMES)))
    fixed = shared.basis.shape[1] == 0
    for block, reduced in zip(blocks, groups, strict=True):
        group_answer = _Answer.of(block, reduced, inverse[setting.outer(block, shared)], shared)
        for kind, rows, lens_rows in group_answer.images(block, shared, setting):
            covariance[kind] += rows.T @ rows
            by_intrinsics += rows.T @ lens_rows if fixed else 0.0
        rows = group_answer.board(block, shared)
        covariance[BOARD] += rows.T @ rows
        by_scale += rows.T @ (block.design @ block.model_from_board.rotation.T).ravel() / block.sigma_mm
    places = setting.places(shared)
    if setting.common:
        rows = inverse[places.shape] / setting.shape_sigma_mm()
        covariance[BOARD] += rows.T @ rows
    covariance[INTRINSICS] += inverse[places.intrinsics].T @ setting.prior @ inverse[places.intrinsics]
    for members, across, plane_normal in planes(shared, setting):
        heights = inverse[:c].reshape(-1, 3, c)[members]
        rows = across @ np.einsum("j,mjk->mk", plane_normal, heights) / setting.flatness_mm
        covariance[FLATNESS] += rows.T @ rows
    variance = joint.sigma0**2
    return Contributions(
        joint,
        {kind: variance * (matrix + matrix.T) / 2 for kind, matrix in covariance.items()},
        by_scale,
        by_intrinsics,
        {kind: joint.sigma0 * _centre_sigma_px(blocks, kind) for kind in (CIRCLES, DOTS)},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """Columns of the inverse normal matrix for the k coordinates of all circles, with the rows of one group.

    ``points`` : (p, 3, k); ``cameras`` : (m, 6, k); ``pose`` : (6, k) of the group's board; ``shape`` : (d, 3, k);
    ``intrinsics`` : (q, k).
    """

    points: np.ndarray
    cameras: np.ndarray
    pose: np.ndarray
    shape: np.ndarray
    intrinsics: np.ndarray

    @classmethod
    def of(cls, block: Block, reduced: Reduced, outer: np.ndarray, shared: Shared) -> "_Answer":
        """Computes the eliminated unknowns of a group from ``outer``, the rows of its outer unknowns."""
        k, d, q = outer.shape[1], len(block.dots), shared.basis.shape[1]
        assert reduced.cameras is not None, "the normal matrix of the photographs alone has no cameras"
        inner = -(reduced.inner.from_kept[0] @ outer)
        points = np.zeros((len(block.model.labels), 3, k))
        points[block.circles] = outer[: 3 * len(block.circles)].reshape(-1, 3, k)
        points[block.dots] = inner[: 3 * d].reshape(-1, 3, k)
        intrinsics = outer[len(outer) - q :]
        cameras = -(reduced.cameras.from_kept @ np.concatenate([points.reshape(-1, k), intrinsics]))
        shape = outer[3 * len(block.circles) : len(outer) - q].reshape(-1, 3, k)
        return cls(points, cameras, inner[3 * d :], shape, intrinsics)

    def images(self, block: Block, shared: Shared, setting: Setting) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Yields the equations of the images batch by batch.

        A batch is its kind of observation, the whitened rows (2n, k), and the whitened derivatives of the observations
        by the intrinsics (2n, 16).
        """
        model, camera = block.model, shared.camera
        root = np.sqrt(robust_weights(model, camera, setting.huber))[:, None, None]
        of_circle = np.isin(model.point_index, block.circles)
        for kind, indices in ((CIRCLES, np.flatnonzero(of_circle)), (DOTS, np.flatnonzero(~of_circle))):
            for begin in range(0, len(indices), AT_ONCE):
                batch = indices[begin : begin + AT_ONCE]
                batch_model = model.observed(batch)
                by_pose, by_point = projection_jacobians(batch_model, camera)
                xyz = batch_model.xyz_camera()
                lens = camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:])
                rows = by_pose @ self.cameras[batch_model.image_index] + by_point @ self.points[batch_model.point_index]
                rows = rows + (lens @ shared.basis) @ self.intrinsics
                whitened = (batch_model.whiten(array) * root[batch] for array in (rows, lens))
                rows, lens = (array.reshape(2 * len(batch), -1) for array in whitened)
                yield kind, rows, lens

    def board(self, block: Block, shared: Shared) -> np.ndarray:
        """Returns the whitened rows (3d, k) of the positions of the dots."""
        rotation = block.model_from_board.rotation
        turned = block.expected_dots(shared) @ rotation.T
        rows = self.points[block.dots] + skew(turned) @ self.pose[:3] - self.pose[3:]
        if len(self.shape):
            rows = rows - rotation @ self.shape
        return rows.reshape(3 * len(turned), -1) / block.sigma_mm


def _centre_sigma_px(blocks: Sequence[Block], kind: str) -> float:
    """Returns the RMS of the centres' σ per axis, as used for the weights."""
    square = np.concatenate(
        [
            b.model.sigma_px()[np.isin(b.model.point_index, b.circles if kind == CIRCLES else b.dots)] ** 2
            for b in blocks
        ]
    )
    return float(np.sqrt(square.mean())) if len(square) else 0.0
