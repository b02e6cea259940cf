"""``faces.json``: the calibrated target as a file."""

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stcal.design import TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import Rows, require_covariance
from stcal.geometry.rigid import Rigid
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
)
from stcal.labels import CircleLabel
from stcal.sfm.adjust.calibration import AdjustOptions, Solve
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces import FrameKind


class FacePoses(Part):
    """Content of ``faces.json`` that a plan needs."""

    format: Literal["stcal faces 1"] = "stcal faces 1"
    unit: Literal["mm"] = "mm"
    target_from_face: dict[str, Pose]

    def poses(self) -> dict[str, Rigid]:
        """Returns target_from_face of every face, by face."""
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
        size = 3 * len(self.labels)
        needed = size * (size + 1) // 2
        if len(self.upper_triangle) != needed:
            count = len(self.upper_triangle)
            raise mistake(f"upper_triangle of {count} numbers, {needed} needed for {size}×{size}")
        try:
            require_covariance(self.matrix(), size, Rows.of(self.labels, "xyz"))
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
        """File of a calibrated target, with covariances if it states them, rims behind which it lies, and why not to
        use it."""
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
        """Returns target_from_face of every face, by face."""
        return {face: Rigid.from_matrix(matrix) for face, matrix in self.target_from_face.items()}
