"""Test of whether detection identifies each face of a target with any of its circles hidden, in all cases one by
one."""

from collections.abc import Callable
from itertools import combinations
from math import comb

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.design import FaceDesign, TargetDesign
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.sfm.data.patterns import Pattern, images_px
from stcal.sfm.detect.circles.candidates import Candidates
from stcal.sfm.detect.circles.ellipses import Ellipses
from stcal.sfm.detect.faces import FaceFinder

TILT_RAD = np.radians(40.0)
"""Tilt of the face about an oblique axis in the simulated views."""
CONTRAST = 100.0


def unnamed_cases(
    target: TargetDesign, camera: Camera, distance_mm: float, hidden: int, progress: Callable[[int, int], None] | None
) -> tuple[list[tuple[str, tuple[str, ...]]], int]:
    """Returns the cases in which the finder does not read exactly the visible circles, and the number of all cases.

    A case is the face and its hidden circles. The ellipses are noise-free images of the circles, in the form in which
    outlines give them to the finder.
    """
    finder = FaceFinder(target)
    failed, done = [], 0
    total = sum(comb(len(face.ids), hidden) for face in target.faces)
    for face in target.faces:
        ellipses = _seen(face, target, camera, distance_mm)
        for hidden_rows in combinations(range(len(face.ids)), hidden):
            visible = np.setdiff1d(np.arange(len(face.ids)), hidden_rows)
            readings = finder.find(Candidates.of(ellipses.select(visible), camera)).faces
            right = [reading for reading in readings if reading.face is face and len(readings) == 1]
            named = {(i, int(row)) for r in right for i, row in enumerate(r.index) if row >= 0}
            if named != {(int(circle), row) for row, circle in enumerate(visible)}:
                failed.append((face.id, tuple(face.ids[i] for i in hidden_rows)))
            done += 1
            if progress is not None and (done % 20 == 0 or done == total):
                progress(done, total)
    return failed, total


def _seen(face: FaceDesign, target: TargetDesign, camera: Camera, distance_mm: float) -> Ellipses:
    """Returns the ellipses of all circles of a face that is tilted and turned, with its middle on the optical axis."""
    axis = np.array([0.6, 0.8, 0.0])
    front = np.diag([1.0, -1.0, -1.0])  # Z of the face to the camera
    turn = Rotation.from_rotvec(TILT_RAD * axis).as_matrix() @ front
    middle = np.append((face.xy_mm.min(0) + face.xy_mm.max(0)) / 2, 0.0)
    pose = Rigid(turn, np.array([0, 0, distance_mm]) - turn @ middle)
    pattern = Pattern(face.id, face.labels(), face.xy_mm, face.radius_mm, target.polarity, 1)
    centre, shape = images_px(pattern, pose, camera)
    return Ellipses(centre, shape, np.full(len(centre), CONTRAST))
