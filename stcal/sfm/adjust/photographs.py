"""By how much photographs differ more than their pixels explain, pooled over all faces and groups of a run.

Few photographs show a face, so that a covariance by photographs is itself uncertain. One factor for all of them is
not: the mean over the faces of how far the photographs' pulls on a face scatter, over what independent errors of pixels
would do. A photograph's own residuals are smaller than its errors, as it took part in the answer; they are corrected
for that (CR2, Bell & McCaffrey 2002).
"""

from dataclasses import replace

import numpy as np

from stcal.design import TargetDesign
from stcal.geometry.clusters import released
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.equations import normalised, robust_weights, rows_of_view
from stcal.sfm.adjust.faces import FrameKind
from stcal.sfm.adjust.joint import Adjusted, points_of, scale_of
from stcal.sfm.adjust.uncertainty import Derivatives, derivatives


def with_differences(state: Adjusted, start: CalibratedTarget, target: TargetDesign, kind: FrameKind) -> Adjusted:
    """Return an adjustment that knows by how much its photographs differ; arguments as of :func:`calibrated_target`."""
    return replace(state, differ=_differ(state, derivatives(state.result(), start, target, kind)))


def _differ(state: Adjusted, own: Derivatives) -> float:
    faces = np.concatenate([by_circles for by_circles in own.faces.values() if by_circles.any()] or [np.zeros((0, 0))])
    if not faces.size:
        return 1.0
    extensible, camera, basis = points_of(state), state.shared.camera, state.shared.basis
    scatter, told = np.zeros((2, len(faces), len(faces)))
    for block in state.blocks:
        model = block.model
        points, to_faces = extensible.points[model.group], extensible.to_circles[model.group] @ faces.T
        for rows in model.rows_by_image():
            view = model.observed(rows)
            root = np.repeat(np.sqrt(robust_weights(view, camera, state.setting.huber)), 2)
            equations, across = rows_of_view(view, camera, basis, root)
            residual = across.T @ (root * normalised(view, camera).ravel())
            expected = to_faces.T @ equations.T
            pull = expected @ released(residual, equations @ points @ equations.T)
            scatter += np.outer(pull, pull)
            told += expected @ expected.T
    ratios = []
    for i in range(0, len(faces), 6):
        own_part = np.ix_(range(i, i + 6), range(i, i + 6))
        ratios.append(np.trace(np.linalg.lstsq(told[own_part], scatter[own_part], rcond=None)[0]) / 6)
    return max(1.0, float(np.sqrt(np.mean(ratios))) / scale_of(state.result().sigma0))
