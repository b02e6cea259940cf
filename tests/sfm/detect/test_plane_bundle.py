"""Poses of images and planes from points of planes."""

import numpy as np

from stcal.geometry.rigid import Poses, Rigid
from stcal.sfm.detect.predict import adjusted_planes

FOCAL_PX = 1000.0
GRID = np.array([[x, y, 0.0] for x in range(-40, 60, 20) for y in range(-40, 60, 20)])


def test_an_image_without_points_keeps_its_pose():
    poses = [Rigid.exp([0.1 * i, 0.3 - 0.2 * i, 0.05, 5 * i, -8, 500]) for i in range(3)]
    planes = [Rigid(), Rigid.exp([0, 0.8, 0, 120, 0, -30])]
    image, plane, xyz, seen = [], [], [], []
    for i in (0, 2):  # nothing is left of image 1
        for k, world_from_plane in enumerate(planes):
            at = poses[i] @ (world_from_plane @ GRID)
            image += [i] * len(GRID)
            plane += [k] * len(GRID)
            xyz.append(GRID)
            seen.append(FOCAL_PX * at[:, :2] / at[:, 2:])
    off = Rigid.exp([2e-3, -1e-3, 1e-3, 0.5, 0.3, 1.0])
    start = Poses.of(pose @ off for pose in poses)
    points = np.array(image), np.array(plane), np.concatenate(xyz), np.concatenate(seen), FOCAL_PX
    found, world_from_plane = adjusted_planes(start, Poses.of([planes[0], planes[1] @ off]), *points)
    for i in (0, 2):
        np.testing.assert_allclose(found[i].matrix(), poses[i].matrix(), atol=1e-6)
    np.testing.assert_array_equal(found[1].matrix(), (poses[1] @ off).matrix())
    np.testing.assert_allclose(world_from_plane[1].matrix(), planes[1].matrix(), atol=1e-6)
