"""What ``measure`` writes with ``--json``."""

from typing import Literal

from pydantic import Field

from stcal.io.json import Finite, Matrix6, NamedReason, Pair, Part, Pose, ResultFile


class OtherPose(Part):
    camera_from_target: Pose
    covariance: Matrix6


class CircleRow(Part):
    label: str
    residual_px: Pair
    weight: float


class OutlierCircleRow(Part):
    label: str
    residual_px: float
    limit_px: float


class ImagePose(Part):
    image: str
    faces: list[str]
    status: str
    camera_from_target: Pose
    covariance: Matrix6
    covariance_parts: dict[str, Matrix6] = Field(
        description="what it is the sum of: `image`, `target`, `intrinsics`, `curvature`: by which the likelihood is "
        "wider, or narrower, than its linearisation says (zero unless a face is frontal, far and noisy)"
    )
    alternative: OtherPose | None = Field(
        description="`camera_from_target` and `covariance` of the other pose that fits, null where there is none"
    )
    delta_chi2: Finite = Field(
        description="by which the other pose fits worse (null: there is no other; below 0: this one does, and "
        "`--previous` chose it)"
    )
    delta_chi2_needed: float | None = Field(description="from where on this one is certain")
    rms_px: float = Field(description="of the residuals, per coordinate")
    chi2: float = Field(description="of the residuals")
    dof: int = Field(description="their degrees of freedom")
    p_value: float = Field(description="of as much by chance")
    fit: Literal["passed", "suspicious", "failed"] = Field(description="suspicious: p < 0.001, failed: p < 0.00001")
    circles: list[CircleRow] = Field(
        description="`label`, `residual_px` measured minus projected ellipse centre, Huber's `weight`"
    )
    outliers: list[OutlierCircleRow] = Field(
        description="`label`, `residual_px`, `limit_px` of circles that contradict the others and are left out"
    )
    notes: list[str] = Field(description="what detection saw and left out")


class PosesFile(ResultFile):
    """Of ``measure``."""

    format: Literal["stcal poses 1"] = Field(description="the file's form and its version")
    unit: Literal["mm"] = Field(description="of all lengths")
    sigma_factor: float = Field(
        description="factor on the centres' own σ: `centre_sigma_factor` of `faces.json`, or `--sigma-factor`"
    )
    intrinsics_held: bool = Field(description="whether the camera file states no σ")
    notes: list[str] = Field(description="what `faces.json` lacks for the covariance")
    images: list[ImagePose] = Field(
        description="`image`, `faces`, `status`, `camera_from_target` 4×4, `covariance` 6×6, and"
    )
    left_out: list[NamedReason] = Field(description="`name`, `reason` of files and images without a pose")
