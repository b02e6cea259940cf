"""Nominal poses of the faces of a target before it is photographed, from its design or from an earlier run."""

from pathlib import Path

import numpy as np

from stcal.design import TargetDesign, reference_target
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.design import ROUGH_KEYS
from stcal.io.json import read_result
from stcal.sfm.adjust.file import FacePoses


def nominal_poses(target: TargetDesign, faces: Path | None) -> dict[str, Rigid]:
    """Returns the pose of every face in one frame. ``faces`` : a ``faces.json``, or None for the rough poses of the
    design.

    Raises
    ------
    InputError
        If a face has no rough pose and there is no ``faces.json``, or if that file is invalid or lacks a face.
    """
    if faces is None:
        rough = target.rough_poses()
        if not rough and _is_reference(target):  # of files from before there were rough poses
            return reference_target().rough_poses()
        if missing := [face.id for face in target.faces if face.id not in rough]:
            raise InputError(
                "E-TARGET-ROUGH-POSE",
                f"target {target.name}: the design does not say where {_faces(missing)}; add {ROUGH_KEYS} to each "
                "[[face]] of the target file, be it rough, or to `plan` give --faces, the faces.json of an earlier run",
            )
        return rough
    poses = read_result(faces, FacePoses, "faces", "give RUN/faces.json, the faces.json of a run").poses()
    missing = [face.id for face in target.faces if face.id not in poses]
    if missing:
        raise InputError(
            "E-TARGET-NO-FACE",
            f"{faces}: no face {missing[0]} of target {target.name}; give a run that shows all of its faces",
        )
    return {face.id: poses[face.id] for face in target.faces}


def _faces(ids: list[str]) -> str:
    return f"face {ids[0]} is" if len(ids) == 1 else f"faces {', '.join(ids[:-1])} and {ids[-1]} are"


def _is_reference(target: TargetDesign) -> bool:
    own, reference = _places(target), _places(reference_target())
    return own.keys() == reference.keys() and all(np.allclose(own[k], reference[k], atol=0.5) for k in own)


def _places(target: TargetDesign) -> dict[str, np.ndarray]:
    return {label: xy for face in target.faces for label, xy in zip(face.labels(), face.xy_mm, strict=True)}
