"""Normal equations of a group written out in full, derivatives by differences: what the package never does."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.sfm.data.group_model import GroupModel

STEP = 1e-6


def moved(model: GroupModel, step: np.ndarray) -> GroupModel:
    """After a step of all poses (6 each: a turn from the left, a shift) and then of all points (3 each)."""
    m = len(model.images)
    poses = tuple(
        Rigid(Rigid.exp([*s[:3], 0, 0, 0]).rotation @ pose.rotation, pose.translation + s[3:])
        for s, pose in zip(step[: 6 * m].reshape(m, 6), model.camera_from_model, strict=True)
    )
    return replace(model, camera_from_model=poses, xyz_model=model.xyz_model + step[6 * m :].reshape(-1, 3))


def derivative(function: Callable[[np.ndarray], np.ndarray], size: int) -> np.ndarray:
    """Central differences (rows, size) about zero."""
    steps = STEP * np.eye(size)
    return np.column_stack([(function(s) - function(-s)).ravel() / (2 * STEP) for s in steps])


def projections(model: GroupModel, camera: Camera) -> np.ndarray:
    """Over σ, (n, 2)."""
    return model.whiten(camera.project(model.xyz_camera()))


def jacobian(model: GroupModel, camera: Camera) -> np.ndarray:
    """(2n, 6m + 3p) of the projections over σ by poses and points."""
    size = 6 * len(model.images) + 3 * len(model.labels)
    return derivative(lambda step: projections(moved(model, step), camera), size)
