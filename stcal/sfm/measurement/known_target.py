"""A calibrated target for measurement: its circles in the target frame with their covariance."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from stcal.boards.target_file import load_target
from stcal.design import FaceDesign, TargetDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, Rows, freeze, frozen, require_arguments, require_covariance
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.json import read_result
from stcal.labels import CircleLabel, circle_labels
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces_file import FacesFile

SAME_DESIGN_MM = 0.5  # largest RMS deviation of a face from the design; another design is off by far more
SAME_RADIUS_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TargetCircles(Brief):
    """The c circles of a calibrated target, target frame, mm."""

    labels: tuple[CircleLabel, ...]
    xyz: np.ndarray  # (c, 3)
    radius: np.ndarray  # (c,)
    covariance: np.ndarray  # (3c, 3c) of all centres, mm², zero if unknown
    sigma_factor: float = 1.0  # on the centres' own σ, as estimated by the run
    notes: tuple[str, ...] = ()  # what the covariance lacks
    design: TargetDesign | None = None  # None if images are not searched
    normal: np.ndarray = field(init=False)  # (c, 3) of the plane of each circle's face
    target_from_plane: dict[str, Rigid] = field(init=False)  # with the mean of its circles as origin
    place: dict[CircleLabel, int] = field(init=False)  # index by label

    def __post_init__(self):
        object.__setattr__(self, "labels", circle_labels(self.labels))
        c = len(self.labels)
        freeze(self, "xyz", (c, 3), "circles")
        freeze(self, "radius", (c,), "radii")
        freeze(self, "covariance", (3 * c, 3 * c), "circles' covariance")
        try:
            require_covariance(self.covariance, 3 * c, Rows.of(self.labels, "xyz"))
        except InputError as error:
            raise InputError(error.code, f"circles' covariance: {error}; make the run again") from error
        object.__setattr__(self, "place", {label: i for i, label in enumerate(self.labels)})
        if len(self.place) < c or not (self.radius > 0).all():
            raise InputError(
                "E-LABEL-REPEATED", "circles: a label twice, or a radius that is not positive; correct them"
            )
        if not (np.isfinite(self.sigma_factor) and self.sigma_factor > 0):
            raise InputError("E-OPTION-RANGE", f"σ factor {self.sigma_factor}: a positive number needed")
        normal, planes = np.zeros((c, 3)), {}
        for face_id in dict.fromkeys(label.face for label in self.labels):
            rows = [i for i, label in enumerate(self.labels) if label.face == face_id]
            if len(rows) < 3:
                continue  # such a face has no plane and is not measured
            try:
                axis = fit_plane(self.xyz[rows]).normal
            except DegenerateError as error:
                raise DegenerateError(error.code, f"face {face_id}: {error}") from error
            normal[rows] = axis
            across = np.linalg.svd(axis[None])[2][1:]
            turn = np.column_stack([across[0], np.cross(axis, across[0]), axis])
            planes[face_id] = Rigid(turn, self.xyz[rows].mean(0))
        object.__setattr__(self, "normal", frozen(normal))
        object.__setattr__(self, "target_from_plane", planes)

    def of_face(self, face: FaceDesign) -> tuple[np.ndarray, np.ndarray]:
        """Returns the circles of a face: centres in the target frame, (k, 3), and in that of its design, (k, 3)."""
        own = [i for i, label in enumerate(face.labels()) if label in self.place]
        xyz = self.xyz[[self.place[face.labels()[i]] for i in own]]
        return xyz, np.column_stack([face.xy_mm[own], np.zeros(len(own))])

    @classmethod
    def of(cls, target: CalibratedTarget, design: TargetDesign, sigma_factor: float = 1.0) -> "TargetCircles":
        """Returns the circles of a run's result in memory. ``sigma_factor`` : the factor of its calibration."""
        labels, radius = tuple(target.circles), design.radius_of()
        covariance, notes = _covariance(labels, target.covariance_mm2, target.circle_covariance)
        xyz = np.array([target.circles[label] for label in labels])
        return cls(labels, xyz, np.array([radius[label] for label in labels]), covariance, sigma_factor, notes, design)


@require_arguments
def read_target(path: str | Path, design: TargetDesign | str | Path) -> TargetCircles:
    """Reads a ``faces.json`` and checks that it belongs to this design.

    Parameters
    ----------
    path : path
        ``faces.json`` of a finished run.
    design : TargetDesign or path
        Design of the same target, or its ``target.toml``.

    Returns
    -------
    TargetCircles
        Centres of all circles with their joint covariance, target frame, mm and mm².

    Raises
    ------
    InputError
        If the file is no ``faces.json``, or belongs to another design.
    """
    path, design = Path(path), load_target(design) if isinstance(design, str | Path) else design
    faces = read_result(path, FacesFile, "faces", "give RUN/faces.json, the faces.json of a run")
    try:
        labels = circle_labels(faces.circles)
        xyz = np.array(list(faces.circles.values())).reshape(-1, 3)
        # Circles behind rims are seen half a rim in front of their luminous surface.
        outward = {face: pose.rotation[:, 2] for face, pose in faces.poses().items()}
        shifts = [0.5 * faces.rim_mm.get(label, 0.0) * outward.get(label.face, np.zeros(3)) for label in labels]
        xyz = xyz + np.array(shifts).reshape(-1, 3)
        radius = np.array([faces.radius_mm[label] for label in labels])
        joint, whole = faces.circles_joint_covariance_mm2, None
        if joint is not None:
            place = {label: i for i, label in enumerate(joint.labels)}
            if sorted(place) != sorted(labels):
                raise InputError("E-COVARIANCE-SHAPE", "its joint covariance is not of its circles")
            rows = [3 * place[label] + axis for label in labels for axis in range(3)]
            whole = joint.matrix()[np.ix_(rows, rows)]
        covariance, notes = _covariance(labels, whole, faces.circle_covariance_mm2)
        if faces.centre_sigma_factor is None:
            notes += ("faces.json states no centre_sigma_factor: the centres' own σ are used; run it again",)
        if faces.doubted:
            notes += (f"the run that made faces.json must not be used: {faces.doubted} Mend that, and run again",)
        factor = 1.0 if faces.centre_sigma_factor is None else faces.centre_sigma_factor
        target = TargetCircles(labels, xyz, radius, covariance, factor, notes, design)
    except (InputError, DegenerateError, LookupError, TypeError, ValueError, AttributeError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else str(error)[:150]
        raise InputError(
            "E-FACES-FILE", f"faces {path}: not the faces.json of a run ({reason}); give RUN/faces.json"
        ) from error
    _require_design(target, design, path)
    return target


def _covariance(
    labels, joint: np.ndarray | None, single: Mapping[Any, np.ndarray]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns the most complete covariance (3c, 3c) available, and notes on missing parts."""
    if joint is not None:
        return joint, ()
    parts = [single[label] if single else np.zeros((3, 3)) for label in labels]
    missing = "covariances between circles" if single else "covariances of its circles"
    note = f"the target states no {missing}: they are taken as zero in the poses' covariances"
    return np.asarray(block_diag(*parts)), (note,)


def _require_design(target: TargetCircles, design: TargetDesign, path: Path) -> None:
    radius, faults = design.radius_of(), []
    for label, own in zip(target.labels, target.radius, strict=True):
        if label not in radius:
            faults.append(f"circle {label} is not in target {design.name}")
        elif abs(own - radius[label]) > SAME_RADIUS_MM:
            faults.append(f"circle {label} has radius {own:g} mm, {radius[label]:g} mm in target {design.name}")
    for face in () if faults else design.faces:
        xyz, flat = target.of_face(face)
        off_mm = 0.0 if len(xyz) < 3 else np.sqrt(((align_rigid(xyz, flat) @ flat - xyz) ** 2).sum(1).mean())
        if off_mm > SAME_DESIGN_MM:
            allowed = f"{SAME_DESIGN_MM:g} mm allowed"
            faults.append(f"face {face.id} is {off_mm:.3g} mm RMS off that of target {design.name}, {allowed}")
    if faults:
        raise InputError("E-FACES-DESIGN", f"faces {path}: {faults[0]}; give the target.toml of that run as --target")
