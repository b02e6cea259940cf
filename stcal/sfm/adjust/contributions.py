"""What each kind of observation contributes to the covariance of the circles, and what errors that no observation
carries would do to them.

The adjusted circles are, to first order, x = G l with G = N⁻¹AᵀW of the observations l: the law of propagation of
uncertainty (JCGM 100:2008, 5.1.2 and E.3) takes the covariance S of one kind of observation to G S Gᵀ. With the
adjustment's own weights these add up to its own covariance, N⁻¹.
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
"""Kinds of observations: centres of circles and of dots in the images, places of the dots on the board, circles in the
planes of their faces, and the given intrinsics where they are adjusted."""
AT_ONCE = 10_000
"""Observations that are taken together, for the memory's sake."""


@dataclass(frozen=True, slots=True, eq=False)
class Contributions:
    """Of the c circles, in the datum of the adjustment.

    ``joint`` : the adjustment; ``covariance_mm2`` by kind of observation: (3c, 3c), together that of ``joint``;
    ``by_scale`` : (3c,) mm, error of the circles over the relative error of the board's pitch; ``by_intrinsics`` :
    (3c, 16), over errors of the intrinsics where these are fixed, else zero; ``centre_sigma_px`` of circles and dots:
    RMS per axis, as the residuals have it.
    """

    joint: JointResult
    covariance_mm2: dict[str, np.ndarray]
    by_scale: np.ndarray
    by_intrinsics: np.ndarray
    centre_sigma_px: dict[str, float]

    def __post_init__(self):
        c = 3 * len(self.joint.labels)
        fixed = {kind: frozen(each, (c, c), f"{kind}: covariance") for kind, each in self.covariance_mm2.items()}
        object.__setattr__(self, "covariance_mm2", fixed)
        object.__setattr__(self, "by_scale", frozen(self.by_scale, (c,), "scale"))
        object.__setattr__(self, "by_intrinsics", frozen(self.by_intrinsics, (c, len(PARAMETER_NAMES)), "intrinsics"))


def contributions_of(state: Adjusted) -> Contributions:
    """The covariance at the minimum of an adjustment, taken apart."""
    blocks, shared, setting, joint = state.blocks, state.shared, state.setting, state.result()
    normal, _, groups = normal_equations(blocks, shared, setting)
    c = shared.xyz_model.size
    answer = constrained_inverse(normal, free_directions(len(normal), shared))[:, :c]
    found = {kind: np.zeros((c, c)) for kind in OBSERVED}
    by_scale, by_intrinsics = np.zeros(c), np.zeros((c, len(PARAMETER_NAMES)))
    fixed = shared.basis.shape[1] == 0
    for block, reduced in zip(blocks, groups, strict=True):
        own = _Answer.of(block, reduced, answer[setting.outer(block, shared)], shared)
        for kind, rows, part in own.images(block, shared, setting):
            found[kind] += rows.T @ rows
            by_intrinsics += rows.T @ part if fixed else 0.0
        rows = own.board(block, shared)
        found[BOARD] += rows.T @ rows
        by_scale += rows.T @ (block.design @ block.model_from_board.rotation.T).ravel() / block.sigma_mm
    places = setting.places(shared)
    if setting.common:
        rows = answer[places.shape] / setting.shape_sigma_mm()
        found[BOARD] += rows.T @ rows
    found[INTRINSICS] += answer[places.intrinsics].T @ setting.prior @ answer[places.intrinsics]
    for members, across, plane_normal in planes(shared, setting):
        heights = answer[:c].reshape(-1, 3, c)[members]
        rows = across @ np.einsum("j,mjk->mk", plane_normal, heights) / setting.flatness_mm
        found[FLATNESS] += rows.T @ rows
    variance = joint.sigma0**2
    return Contributions(
        joint,
        {kind: variance * (each + each.T) / 2 for kind, each in found.items()},
        by_scale,
        by_intrinsics,
        {kind: joint.sigma0 * _centre_sigma_px(blocks, kind) for kind in (CIRCLES, DOTS)},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """Columns of the inverse normal matrix for the k coordinates of all circles, rows of one group: ``points``
    (p, 3, k), ``cameras`` (m, 6, k), ``pose`` (6, k) of its board, ``shape`` (d, 3, k), ``intrinsics`` (q, k)."""

    points: np.ndarray
    cameras: np.ndarray
    pose: np.ndarray
    shape: np.ndarray
    intrinsics: np.ndarray

    @classmethod
    def of(cls, block: Block, reduced: Reduced, outer: np.ndarray, shared: Shared) -> "_Answer":
        """``outer`` : those of the group's outer unknowns, whence the eliminated ones follow."""
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
        """Kind, whitened rows (2n, k), and derivatives of the observations by the intrinsics (2n, 16), whitened too,
        part by part."""
        model, camera = block.model, shared.camera
        root = np.sqrt(robust_weights(model, camera, setting.huber))[:, None, None]
        of_circle = np.isin(model.point_index, block.circles)
        for kind, own in ((CIRCLES, np.flatnonzero(of_circle)), (DOTS, np.flatnonzero(~of_circle))):
            for begin in range(0, len(own), AT_ONCE):
                some = own[begin : begin + AT_ONCE]
                part = model.observed(some)
                by_pose, by_point = projection_jacobians(part, camera)
                xyz = part.xyz_camera()
                lens = camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:])
                rows = by_pose @ self.cameras[part.image_index] + by_point @ self.points[part.point_index]
                rows = rows + (lens @ shared.basis) @ self.intrinsics
                whole = (part.whiten(each) * root[some] for each in (rows, lens))
                rows, lens = (each.reshape(2 * len(some), -1) for each in whole)
                yield kind, rows, lens

    def board(self, block: Block, shared: Shared) -> np.ndarray:
        """Whitened rows (3d, k) of the places of the dots."""
        rotation = block.model_from_board.rotation
        turned = block.expected_dots(shared) @ rotation.T
        rows = self.points[block.dots] + skew(turned) @ self.pose[:3] - self.pose[3:]
        if len(self.shape):
            rows = rows - rotation @ self.shape
        return rows.reshape(3 * len(turned), -1) / block.sigma_mm


def _centre_sigma_px(blocks: Sequence[Block], kind: str) -> float:
    """RMS of the σ of centres per axis, as they were weighed."""
    square = np.concatenate(
        [
            b.model.sigma_px()[np.isin(b.model.point_index, b.circles if kind == CIRCLES else b.dots)] ** 2
            for b in blocks
        ]
    )
    return float(np.sqrt(square.mean())) if len(square) else 0.0
