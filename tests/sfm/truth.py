"""What a truth file says of images, in the frames of a run."""

import numpy as np

from stcal import Rigid, reference_target
from stcal.geometry.plane import fit_plane
from stcal.sfm.adjust.chain import face_frame


def true_poses(truth: dict) -> dict[str, Rigid]:
    """camera_from_target by image, the target frame laid by the plane of the reference face's circles as a run does."""
    face = reference_target().face(truth["reference_face"])
    circles = {c: np.array(truth["circles"][f"{face.id}:{c}"]) for c in face.ids}
    frame = face_frame(face, circles, "plane", np.array([0, 0, 1.0]))
    assert fit_plane(np.array(list(circles.values()))).rms < 1e-3
    return {
        name: Rigid.from_matrix(image["camera_from_target"]) @ frame
        for group in truth["groups"].values()
        for name, image in group["images"].items()
    }
