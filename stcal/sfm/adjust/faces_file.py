"""``faces.json``, the calibrated target as a file, and its circles for measurement."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.linalg import block_diag

from stcal.boards.target_file import load_target
from stcal.design import FaceDesign, TargetDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import Brief, CovarianceRows, freeze, frozen, require_arguments, require_covariance
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.json import (
    ByFace,
    ByLabel,
    ByName,
    Part,
    PointCovariance,
    Pose,
    PoseCovariance,
    ResultFile,
    Vector,
    Vector3,
    mistake,
    read_result,
)
from stcal.labels import CircleLabel, circle_labels
from stcal.sfm.adjust.calibration import AdjustOptions, Solve
from stcal.sfm.adjust.chain import CalibratedTarget, FrameKind
from stcal.sfm.data.group_model import rows_by


class FacePoses(Part):
    """Content of ``faces.json`` that a plan needs."""

    format: Literal["stcal faces 1"] = "stcal faces 1"
    unit: Literal["mm"] = "mm"
    target_from_face: dict[str, Pose]

    def poses(self) -> dict[str, Rigid]:
        return {face: Rigid.from_matrix(matrix) for face, matrix in self.target_from_face.items()}


class JointCovariance(Part):
    """Joint covariance of all circles."""

    labels: list[str]
    upper_triangle: Vector

    def matrix(self) -> np.ndarray:
        """Returns the covariance matrix (3c, 3c) in the order of ``labels``."""
        size = 3 * len(self.labels)
        i, j = np.triu_indices(size)
        full = np.zeros((size, size))
        full[i, j] = full[j, i] = self.upper_triangle
        return full

    @model_validator(mode="after")
    def _is_covariance(self) -> Self:
        size, count = 3 * len(self.labels), len(self.upper_triangle)
        needed = size * (size + 1) // 2
        if count != needed:
            raise mistake(f"upper_triangle of {count} numbers, {needed} needed for {size}×{size}")
        try:
            require_covariance(self.matrix(), size, CovarianceRows.of(self.labels, "xyz"))
        except InputError as error:
            raise mistake(error) from error
        return self


class FacesFile(ResultFile):
    """Result of a run: mm and rad, target frame."""

    format: Literal["stcal faces 1"] = Field("stcal faces 1", description="the file's form and its version")
    unit: Literal["mm"] = Field("mm", description="of all lengths")
    reference_face: str = Field(description="id of the face whose frame is the target frame")
    frame: FrameKind = Field(description="of a face, see the table of frames")
    solve: Solve = Field(
        description="one adjustment over all groups (`joint`), group by group (`chain`), or as published (`paper`)"
    )
    surface: Literal["seen", "luminous"] = Field(
        "seen",
        description="of which surface the faces are: `seen`, where circles seem to lie, or `luminous`, behind the rims "
        "of `rim_mm`",
    )
    rim_mm: dict[ByLabel, float] = Field(
        {}, description="`face:circle` → height of the rim in front of the circle, stated or estimated, mm"
    )
    eccentricity: bool = Field(
        description="whether it was corrected; without it `solve` is `chain` and `frame` is `three-point`, as "
        "published, unless they are given"
    )
    doubted: str = Field(
        "", description="only where the run's answer is *no*: why; poses and σ do not hold until that is mended"
    )
    target_from_face: dict[ByFace, Pose] = Field(description="frame of each face")
    circles: dict[ByLabel, Vector3] = Field(description="`face:circle` → centre, target frame, mm")
    radius_mm: dict[ByLabel, float] = Field(description="`face:circle` → radius of the design, mm")
    centre_sigma_factor: float | None = Field(
        None,
        description="by which residuals of the run's groups exceed the centres' own σ; `measure` multiplies σ by it",
    )
    target_from_face_covariance: dict[ByFace, PoseCovariance] = Field(
        {},
        description="only with `joint`: rad and mm, see conventions; that of the reference face is 0 up to rounding",
    )
    distance_sigma_mm: dict[ByName, float] = Field(
        {}, description='only with `joint`: `"a b"` → σ of the distance between the origins of two faces, mm'
    )
    up_to_scale: bool = Field(
        False,
        description="true if nothing of known size was in view: the shape holds, and lengths are in the unit of the "
        "drawing instead of mm",
    )
    scale_sigma_ppm: float | None = Field(
        None, description="only with `joint`: σ of the target's size; left out where it is not known"
    )
    circle_covariance_mm2: dict[ByLabel, PointCovariance] = Field(
        {}, description="only with `joint`: `face:circle` → covariance, target frame, mm²"
    )
    circles_joint_covariance_mm2: JointCovariance | None = Field(
        None,
        description="only with `joint`: `labels` of the c circles in order, and `upper_triangle` of the 3c×3c "
        "covariance of their x, y, z in the target frame, row by row, mm². Singular, since the circles carry the frame",
    )

    @classmethod
    def of(
        cls,
        target: CalibratedTarget,
        design: TargetDesign,
        options: AdjustOptions,
        centre_sigma_factor: float,
        rim_mm: Mapping[CircleLabel, float] | None = None,
        doubted: str = "",
    ) -> "FacesFile":
        """File of a calibrated target, with covariances if stated, rims before it, and why not to use it."""
        radius = design.radius_of()
        content: dict[str, Any] = {
            "format": "stcal faces 1",
            "unit": "mm",
            "reference_face": target.reference_face,
            "frame": options.frame,
            "solve": options.solve,
            **({"surface": "luminous", "rim_mm": rim_mm} if rim_mm else {}),
            "eccentricity": options.eccentricity,
            **({"up_to_scale": True} if design.up_to_scale else {}),
            **({"doubted": doubted} if doubted else {}),
            "target_from_face": target.target_from_face,
            "circles": target.circles,
            "radius_mm": {label: radius[label] for label in target.circles},
            "centre_sigma_factor": centre_sigma_factor,
        }
        if target.covariance_mm2 is not None and target.scale_sigma is not None:
            upper = np.triu_indices(3 * len(target.circles))
            content |= {
                "target_from_face_covariance": target.face_covariance,
                "distance_sigma_mm": {f"{a} {b}": sigma for (a, b), sigma in target.distance_sigma_mm.items()},
                **({} if design.up_to_scale else {"scale_sigma_ppm": 1e6 * target.scale_sigma}),
                "circle_covariance_mm2": target.circle_covariance,
                "circles_joint_covariance_mm2": {
                    "labels": list(target.circles),
                    "upper_triangle": target.covariance_mm2[upper],
                },
            }
        return cls.model_validate(content)

    def poses(self) -> dict[str, Rigid]:
        return {face: Rigid.from_matrix(matrix) for face, matrix in self.target_from_face.items()}


SAME_DESIGN_MM = 0.5  # largest RMS deviation of a face from the design; another design is off by far more


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
            require_covariance(self.covariance, 3 * c, CovarianceRows.of(self.labels, "xyz"))
        except InputError as error:
            raise InputError(error.code, f"circles' covariance: {error}; make the run again") from error
        object.__setattr__(self, "place", {label: i for i, label in enumerate(self.labels)})
        if len(self.place) < c or not (self.radius > 0).all():
            fault = "circles: a label twice, or a radius that is not positive"
            raise InputError("E-LABEL-REPEATED", f"{fault}; correct them")
        if not (np.isfinite(self.sigma_factor) and self.sigma_factor > 0):
            raise InputError("E-OPTION-RANGE", f"σ factor {self.sigma_factor}: a positive number needed")
        normal, planes = np.zeros((c, 3)), {}
        for face_id, rows in rows_by(label.face for label in self.labels).items():
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
        labels = [label for label in face.labels() if label in self.place]
        return self.xyz[[self.place[label] for label in labels]], face.places_mm(label.circle for label in labels)

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
    path : ``faces.json`` of a finished run.
    design : Design of the same target, or its ``target.toml``.

    Returns
    -------
    TargetCircles : Centres of all circles with their joint covariance, target frame, mm and mm².

    Raises
    ------
    InputError : If the file is no ``faces.json``, or belongs to another design.
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
        elif abs(own - radius[label]) > 1e-6:
            faults.append(f"circle {label} has radius {own:g} mm, {radius[label]:g} mm in target {design.name}")
    for face in () if faults else design.faces:
        xyz, flat = target.of_face(face)
        off_mm = 0.0 if len(xyz) < 3 else np.sqrt(((align_rigid(xyz, flat) @ flat - xyz) ** 2).sum(1).mean())
        if off_mm > SAME_DESIGN_MM:
            allowed = f"{SAME_DESIGN_MM:g} mm allowed"
            faults.append(f"face {face.id} is {off_mm:.3g} mm RMS off that of target {design.name}, {allowed}")
    if faults:
        raise InputError("E-FACES-DESIGN", f"faces {path}: {faults[0]}; give the target.toml of that run as --target")
