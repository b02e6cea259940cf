"""Result file of calibrated intrinsics."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stcal.geometry.camera import parameter_names
from stcal.io.json import ByName, Matrix, NamedReason, Part, ResultFile
from stcal.sfm.camera.calibrate import CORNERS, OUTLIER_WEIGHT, CameraCalibration, residual_rms_px
from stcal.sfm.camera.intrinsics import Intrinsics, model_parameters

ByCorner = Annotated[str, "corner"]


class Parameter(Part):
    value: float
    sigma: float
    freedom: float


class Print(Part):
    folder: str
    stretch: float
    shear: float


class Corner(Part):
    reach: float
    sigma_px: float


class Projection(Part):
    median_sigma_px: float
    corners: dict[ByCorner, Corner] = Field(
        description="`reach` of the dots towards it, 1 at the corner, and `sigma_px` there"
    )


class HeldOutViews(Part):
    rms_px: float
    folds: int


class LensModel(Part):
    model: str
    parameters: int
    rms_px: float | None
    worse: float | None
    worse_sigma: float | None
    why: str


class BoardViewRow(Part):
    image: str
    dots: int
    tilt_deg: float
    rms_px: float


class OutlierRow(Part):
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
    prints: list[Print] = Field(
        description="by `folder`: how much longer the board is printed along its rows than across, relative "
        "(`stretch`), and its `shear`; both are adjusted"
    )
    redundancy: int = Field(description="degrees of freedom")
    rounds: int = Field(description="of detection")
    projection: Projection = Field(
        description="σ per axis of where a known direction is seen, up to a rotation of the camera: `median_sigma_px` "
        "over the image, and in the corners"
    )
    held_out: HeldOutViews | None = Field(
        None,
        description="each view foretold by a calibration without it, in `folds` parts: `rms_px` per coordinate; null "
        "with fewer than four views",
    )
    models: list[LensModel] = Field(
        [],
        description="with `--model auto`: `model`, `parameters` it has, `rms_px` of held-out views, `worse` than the "
        "best by so much in the mean square (σ²) and its standard error `worse_sigma`; `why` it could not be tried",
    )
    images: list[BoardViewRow] = Field(
        description="`image`, `dots`, `tilt_deg` of the board against the image plane, `rms_px`"
    )
    outliers: list[OutlierRow] = Field(
        description="dots that weigh less than half: `image`, `label`, `residual_px`, `weight`"
    )
    left_out: list[NamedReason] = Field(description="`name`, `reason`")
    warnings: list[str] = Field(description="what to look at, and do")

    @classmethod
    def of(cls, calibration: CameraCalibration) -> "CalibrationFile":
        """Returns the file of a calibrated camera."""
        result, projection = calibration.intrinsics, calibration.projection
        camera, sigma, names = result.camera, result.sigma(), parameter_names(result.colmap_model)
        values = zip(names, model_parameters(camera, result.colmap_model), sigma, result.freedom, strict=True)
        corners = zip(CORNERS, projection.reach, projection.corner_sigma_px, strict=True)
        return cls(
            format="stcal camera 1",
            model=result.colmap_model,
            size_px=(camera.width, camera.height),
            parameters={name: Parameter(value=value, sigma=own, freedom=free) for name, value, own, free in values},
            correlation=result.covariance / np.outer(sigma, sigma),
            residual_rms_px=residual_rms_px(result),
            centre_sigma_factor=result.factors.centres,
            dot_sigma_factor=result.factors.dots,
            photographs_differ=result.differ,
            prints=[Print(folder=own, stretch=two[0], shear=two[1]) for own, two in result.prints().items()],
            redundancy=result.redundancy,
            rounds=calibration.rounds,
            projection=Projection(
                median_sigma_px=float(np.median(projection.sigma_px)),
                corners={corner: Corner(reach=reach, sigma_px=own) for corner, reach, own in corners},
            ),
            held_out=calibration.held_out
            and HeldOutViews(rms_px=calibration.held_out.rms_px(), folds=calibration.held_out.folds),
            models=[LensModel.model_validate(asdict(each)) for each in calibration.candidates],
            images=list(_views(result)),
            outliers=list(_outliers(result)),
            left_out=[NamedReason(name=each.name, reason=each.reason) for each in calibration.skipped],
            warnings=list(calibration.warnings),
        )


def _views(result: Intrinsics) -> Iterator[BoardViewRow]:
    for model in result.models:
        residual = model.residuals_px(result.camera)
        for image, pose, rows in zip(model.images, model.camera_from_model, model.rows_by_image(), strict=True):
            yield BoardViewRow(
                image=image,
                dots=len(rows),
                tilt_deg=float(np.degrees(np.arccos(abs(pose.rotation[2, 2])))),
                rms_px=float(np.sqrt((residual[rows] ** 2).mean())),
            )


def _outliers(result: Intrinsics) -> Iterator[OutlierRow]:
    for model, weights in zip(result.models, result.weights(), strict=True):
        length = np.linalg.norm(model.residuals_px(result.camera), axis=1)
        for i in np.flatnonzero(weights < OUTLIER_WEIGHT):
            image, label = model.images[model.image_index[i]], model.labels[model.point_index[i]]
            yield OutlierRow(image=image, label=label, residual_px=length[i], weight=weights[i])
