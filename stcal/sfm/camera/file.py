"""Result file of calibrated intrinsics."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stcal.geometry.camera import parameter_names
from stcal.io.json import ByName, Matrix, NamedReason, ResultFile
from stcal.sfm.camera.calibrate import CORNERS, OUTLIER_WEIGHT, CameraCalibration, residual_rms_px
from stcal.sfm.camera.checks import Candidate
from stcal.sfm.camera.intrinsics import Intrinsics, model_parameters

ByCorner = Annotated[str, "corner"]


@dataclass(frozen=True, slots=True)
class Parameter:
    value: float
    sigma: float
    freedom: float


@dataclass(frozen=True, slots=True)
class Print:
    stretch: float
    shear: float


@dataclass(frozen=True, slots=True)
class Corner:
    reach: float
    sigma_px: float


@dataclass(frozen=True, slots=True)
class BoardViewRow:
    image: str
    dots: int
    tilt_deg: float
    rms_px: float


@dataclass(frozen=True, slots=True)
class OutlierDot:
    image: str
    label: str
    residual_px: float
    weight: float


class CalibrationFile(ResultFile):
    """Result file of ``calibrate-camera``. Pixels count from the centre of the top-left pixel."""

    format: Literal["stcal camera 1"] = Field(description="the file's form and its version")
    model: str = Field(description="COLMAP model")
    size_px: tuple[int, int] = Field(description="width and height")
    parameters: dict[ByName, Parameter] = Field(
        description="`value`, `sigma`, and the degrees of freedom `freedom` that the photographs have for it, in the "
        "model's order; px and OpenCV pixel origin, distortion coefficients without unit"
    )
    correlation: Matrix = Field(description="in the order of `parameters`")
    residual_rms_px: float = Field(description="per coordinate")
    centre_sigma_factor: float = Field(
        description="by which residuals exceed the centres' own σ (not below 1); σ are scaled by it"
    )
    dot_sigma_factor: float = Field(
        description="by which dots are farther from the grid than the `sigma_mm` of the board file says, but for the "
        "smooth stretch and bends of the print (below 1: nearer); it is in all σ"
    )
    photographs_differ: float = Field(
        description="by how much photographs differ more than their pixels explain, as a ratio of σ; σ are those of "
        "independent photographs, never below those of independent pixels"
    )
    prints: dict[ByName, Print] = Field(
        description="by folder: how much longer the board is printed along its rows than across, relative (`stretch`), "
        "and its `shear`; both are adjusted"
    )
    redundancy: int = Field(description="degrees of freedom")
    rounds: int = Field(description="of detection")
    projection_sigma_px: float = Field(
        description="σ per axis of where a known direction is seen, up to a rotation of the camera: median over the "
        "image"
    )
    corners: dict[ByCorner, Corner] = Field(
        description="of the image: `reach` of the dots towards it, 1 at the corner, and `sigma_px` there"
    )
    held_out_rms_px: float | None = Field(
        description="per coordinate, each view foretold by a calibration without it; null with fewer than four views"
    )
    models: tuple[Candidate, ...] = Field(
        description="with `--model auto`: `model`, `parameters` it has, `rms_px` of held-out views, `worse` than the "
        "best by so much in the mean square (σ²) and its standard error `worse_sigma`; `why` it could not be tried",
    )
    images: list[BoardViewRow] = Field(
        description="`image`, `dots`, `tilt_deg` of the board against the image plane, `rms_px`"
    )
    outliers: list[OutlierDot] = Field(
        description="dots that weigh less than half: `image`, `label`, `residual_px`, `weight`"
    )
    left_out: list[NamedReason] = Field(description="`name`, `reason`")
    warnings: tuple[str, ...] = Field(description="what to look at, and do")

    @classmethod
    def of(cls, calibration: CameraCalibration) -> "CalibrationFile":
        """Returns the file of a calibrated camera."""
        result, projection, held_out = calibration.intrinsics, calibration.projection, calibration.held_out
        camera, sigma = result.camera, result.sigma()
        columns = np.array([model_parameters(camera, result.colmap_model), sigma, result.freedom]).T.tolist()
        names = parameter_names(result.colmap_model)
        reached = np.array([projection.reach, projection.corner_sigma_px]).T.tolist()
        return cls(
            format="stcal camera 1",
            model=result.colmap_model,
            size_px=(camera.width, camera.height),
            parameters={name: Parameter(*values) for name, values in zip(names, columns, strict=True)},
            correlation=result.covariance / np.outer(sigma, sigma),
            residual_rms_px=residual_rms_px(result),
            centre_sigma_factor=result.factors.centres,
            dot_sigma_factor=result.factors.dots,
            photographs_differ=result.differ,
            prints={
                folder: Print(float(stretch), float(shear)) for folder, (stretch, shear) in result.prints().items()
            },
            redundancy=result.redundancy,
            rounds=calibration.rounds,
            projection_sigma_px=float(np.median(projection.sigma_px)),
            corners={corner: Corner(*values) for corner, values in zip(CORNERS, reached, strict=True)},
            held_out_rms_px=held_out and held_out.rms_px(),
            models=calibration.candidates,
            images=list(_views(result)),
            outliers=list(_outliers(result)),
            left_out=[NamedReason.model_validate(each) for each in calibration.skipped],
            warnings=calibration.warnings,
        )


def _views(result: Intrinsics) -> Iterator[BoardViewRow]:
    for model in result.models:
        residual = model.residuals_px(result.camera)
        for image, pose, rows in zip(model.images, model.camera_from_model, model.rows_by_image(), strict=True):
            tilt_deg = float(np.degrees(np.arccos(abs(pose.rotation[2, 2]))))
            yield BoardViewRow(image, len(rows), tilt_deg, float(np.sqrt((residual[rows] ** 2).mean())))


def _outliers(result: Intrinsics) -> Iterator[OutlierDot]:
    for model, weights in zip(result.models, result.weights(), strict=True):
        length = np.linalg.norm(model.residuals_px(result.camera), axis=1)
        for i in np.flatnonzero(weights < OUTLIER_WEIGHT):
            image, label = model.images[model.image_index[i]], model.labels[model.point_index[i]]
            yield OutlierDot(image, label, float(length[i]), float(weights[i]))
