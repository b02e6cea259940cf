#!/usr/bin/env python
"""Calibrate a cube with printed faces from real photographs, without a board and without a camera file.

No truth is known but the nominal geometry: the faces of a cube are at right angles as far as paper on a cube is. What
is printed: images used, faces, residuals, the focal length with its σ, how far the normals of neighbouring faces are
off 90°, and the largest σ of a face's position and rotation.

Data: `real/pycamset_cube` of shared/data. It takes a minute or two.
"""

import numpy as np

from scripts.runner import DATA, head, row, script
from stcal.boards.board_designs import CharucoDesign
from stcal.boards.target_file import printed_face
from stcal.design import TargetDesign
from stcal.sfm import pipeline

SAME_PLANE_DEG = 45.0
"""Smallest angle between the planes of neighbouring faces."""


def pycamset_cube() -> TargetDesign:
    """The cube of pyCamSet: six ChArUco faces of 10 × 10 squares of 3.2 mm; face k has the tags from 50 k on."""
    boards = [CharucoDesign(10, 10, 3.2, 2.4, "DICT_6X6_1000", first_id=50 * k) for k in range(6)]
    return TargetDesign("cube", "bright", tuple(printed_face(str(k), board) for k, board in enumerate(boards)))


@script()
def main(_) -> None:
    neighbours, sigmas = "neighbours off 90°, mean and worst, °", ("σ of a position, µm", "of a rotation, mdeg")
    head("set", "images", "faces", "residuals, px", "focal length, px", neighbours, *sigmas)
    result = pipeline.run(DATA / "real" / "pycamset_cube" / "cam0", None, None, pycamset_cube())
    target, joint, camera = result.target, result.calibration.joint, result.refined_camera
    assert joint is not None
    assert camera is not None
    assert camera.covariance is not None
    normals = np.array([pose.rotation[:, 2] for pose in target.target_from_face.values()])
    angles = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)))[np.triu_indices(len(normals), 1)]
    off = np.abs(angles[np.minimum(angles, 180 - angles) > SAME_PLANE_DEG] - 90)
    sigma = np.sqrt([np.diag(c) for f, c in target.face_covariance.items() if f != target.reference_face])
    residuals = np.concatenate([m.residuals_px(result.calibration.camera).ravel() for m in joint.models])
    images = sum(len(solution.model.images) for solution in result.solutions)
    total = len(result.detection.images) + len(result.detection.skipped)
    row(
        "pycamset_cube",
        f"{images} of {total}",
        f"{len(target.target_from_face)} of {len(result.target_design.faces)}",
        f"{np.sqrt((residuals**2).mean()):.3f}",
        f"{camera.focal[0]:.1f} ± {np.sqrt(camera.covariance[0, 0]):.1f}",
        f"{off.mean():.2f}, {off.max():.2f}",
        f"{1e3 * sigma[:, 3:].max():.0f}",
        f"{1e3 * np.degrees(sigma[:, :3].max()):.0f}",
    )
