"""Where the faces of a target are before it is photographed: of the reference design, or from an earlier run."""

import json
from pathlib import Path

import numpy as np

from stcal.design import TargetDesign, reference_target
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.synthetic.scene import nominal_target_from_face


def nominal_poses(target: TargetDesign, faces: Path | None) -> dict[str, Rigid]:
    """Pose of every face in one frame; ``faces`` : a ``faces.json``, or None for the reference design.

    Raises
    ------
    InputError
        Another design without a ``faces.json``, a file that is none, or one that lacks a face.
    """
    if faces is None:
        if not _is_reference(target):
            raise InputError(
                f"target {target.name}: the design does not say where its faces are; give --faces, the faces.json of "
                "an earlier run, be it a rough one"
            )
        return nominal_target_from_face()
    try:
        content = json.loads(faces.read_text(encoding="utf-8"))
        poses = {face: Rigid.from_matrix(np.array(m, float)) for face, m in content["target_from_face"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{faces}: not the faces.json of a run ({error}); give RUN/faces.json") from error
    missing = [face.id for face in target.faces if face.id not in poses]
    if missing:
        raise InputError(
            f"{faces}: no face {missing[0]} of target {target.name}; give a run that shows all of its faces"
        )
    return {face.id: poses[face.id] for face in target.faces}


def _is_reference(target: TargetDesign) -> bool:
    own, reference = _places(target), _places(reference_target())
    return own.keys() == reference.keys() and all(np.allclose(own[k], reference[k], atol=0.5) for k in own)


def _places(target: TargetDesign) -> dict[str, np.ndarray]:
    return {label: xy for face in target.faces for label, xy in zip(face.labels(), face.xy_mm, strict=True)}
