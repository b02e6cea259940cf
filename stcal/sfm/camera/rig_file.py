"""``rig.json``: the result of ``calibrate-camera --rig``."""

from typing import Annotated, Literal

from pydantic import Field

from stcal.io.json import Part, Pose, PoseCovariance, ResultFile
from stcal.sfm.camera.rig import RigCalibration

ByCamera = Annotated[str, "camera"]


class RigCamera(Part):
    name: str
    model: str
    views: int
    shared_instants: int
    residual_rms_px: float
    alone_rms_px: float
    camera_from_first: Pose
    covariance: PoseCovariance


class InstantRow(Part):
    name: str
    images: dict[ByCamera, str]
    rms_px: float


class ApartRow(Part):
    camera: str
    image: str
    reason: str


class RigCalibrationFile(ResultFile):
    """Result file of ``calibrate-camera --rig``. Each camera has its own camera file and JSON file beside it."""

    format: Literal["stcal camera rig 1"] = Field(description="the file's form and its version")
    cameras: list[RigCamera] = Field(
        description="`name`, that of its folder and files; `model` of COLMAP; `views` of the board, `shared_instants` "
        "that another camera saw too; `residual_rms_px` per coordinate, `alone_rms_px` before the cameras were held to "
        "one rig; `camera_from_first`, the pose of the first camera in this one, mm, and its `covariance` (rotation "
        "rad, translation mm; zero of the first)"
    )
    instants: list[InstantRow] = Field(description="`name`, `images` by camera, `rms_px` of all residuals in it")
    apart: list[ApartRow] = Field(
        description="`camera`, `image` that is none of the instant it is named after, and the `reason`; it still "
        "counts for the camera's intrinsics"
    )
    residual_factor: float = Field(
        description="by which residuals exceed those of the cameras alone; all σ are scaled by it"
    )
    dot_sigma_factor: float = Field(description="as of one camera, of all of them")
    redundancy: int = Field(description="degrees of freedom of all cameras")
    warnings: list[str] = Field(description="what to look at, and do; those of each camera stand in its own file")

    @classmethod
    def of(cls, rig: RigCalibration) -> "RigCalibrationFile":
        """Returns the file of a calibrated rig."""
        rows = zip(
            rig.names,
            rig.cameras,
            rig.shared,
            rig.rms_of_cameras(),
            rig.alone_rms_px,
            rig.camera_from_first,
            rig.covariance,
            strict=True,
        )
        return cls(
            format="stcal camera rig 1",
            cameras=[
                RigCamera(
                    name=name,
                    model=own.intrinsics.colmap_model,
                    views=len(own.views),
                    shared_instants=shared,
                    residual_rms_px=rms,
                    alone_rms_px=alone,
                    camera_from_first=pose.matrix(),
                    covariance=covariance,
                )
                for name, own, shared, rms, alone, pose, covariance in rows
            ],
            instants=[
                InstantRow(name=name, images=images, rms_px=rig.rms_px[name]) for name, images in rig.instants.items()
            ],
            apart=[ApartRow(camera=each.camera, image=each.image, reason=each.reason) for each in rig.apart],
            residual_factor=rig.factor,
            dot_sigma_factor=rig.dots,
            redundancy=rig.redundancy,
            warnings=list(rig.warnings),
        )
