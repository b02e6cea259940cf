"""Result file and report of a calibrated camera."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from stcal.geometry.arrays import rms
from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, Camera, parameter_names
from stcal.geometry.clusters import NOTED
from stcal.geometry.print_modes import stretch_in_words
from stcal.io.json import ByName, Matrix, Named, NamedReason, ResultFile
from stcal.report.camera_figures import field_figure, mean_residuals_figure, moved_px
from stcal.report.document import Answer, Block, Document, Section, Table, bullets, plot, plots
from stcal.report.svg import VIRIDIS, Axes, Drawing, round_below
from stcal.report.text import number
from stcal.sfm.camera import calibrate
from stcal.sfm.camera.calibrate import CameraCalibration, residual_rms_px
from stcal.sfm.camera.intrinsics import GRID, Intrinsics, model_parameters

ByCorner = Annotated[str, "corner"]


class CalibrationFile(ResultFile):
    """Result file of ``calibrate-camera``. Pixels count from the centre of the top-left pixel."""

    format: Literal["stcal camera 1"] = Field(description="the file's form and its version")
    model: str = Field(description="COLMAP model")
    size_px: tuple[int, int] = Field(description="width and height")
    parameters: dict[ByName, Annotated[Any, Named("value sigma freedom")]] = Field(
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
    prints: dict[ByName, Annotated[Any, Named("stretch shear")]] = Field(
        description="by folder: how much longer the board is printed along its rows than across, relative (`stretch`), "
        "and its `shear`; both are adjusted"
    )
    redundancy: int = Field(description="degrees of freedom")
    rounds: int = Field(description="of detection")
    projection_sigma_px: float = Field(
        description="σ per axis of where a known direction is seen, up to a rotation of the camera: median over the "
        "image"
    )
    corners: dict[ByCorner, Annotated[Any, Named("reach sigma_px")]] = Field(
        description="of the image: `reach` of the dots towards it, 1 at the corner, and `sigma_px` there"
    )
    held_out_rms_px: float | None = Field(
        description="per coordinate, each view foretold by a calibration without it; null with fewer than four views"
    )
    models: tuple[calibrate.TriedModel, ...] = Field(
        description="with `--model auto`: `model`, `parameters` it has, `rms_px` of held-out views, `worse` than the "
        "best by so much in the mean square (σ²) and its standard error `worse_sigma`; `why` it could not be tried",
    )
    images: list[Annotated[Any, Named("image dots tilt_deg rms_px")]] = Field(
        description="`image`, `dots`, `tilt_deg` of the board against the image plane, `rms_px`"
    )
    outliers: list[Annotated[Any, Named("image label residual_px weight")]] = Field(
        description="dots that weigh less than half: `image`, `label`, `residual_px`, `weight`"
    )
    left_out: list[NamedReason] = Field(description="`name`, `reason`")
    warnings: tuple[str, ...] = Field(description="what to look at, and do")


def calibration_file(calibration: CameraCalibration) -> CalibrationFile:
    result, projection, held_out = calibration.intrinsics, calibration.projection, calibration.held_out
    camera, sigma = result.camera, result.sigma()
    found = {"value": model_parameters(camera, result.colmap_model), "sigma": sigma, "freedom": result.freedom}
    reached = {"reach": projection.reach, "sigma_px": projection.corner_sigma_px}
    return CalibrationFile(
        format="stcal camera 1",
        model=result.colmap_model,
        size_px=(camera.width, camera.height),
        parameters=_rows(parameter_names(result.colmap_model), found),
        correlation=result.covariance / np.outer(sigma, sigma),
        residual_rms_px=residual_rms_px(result),
        centre_sigma_factor=result.factors.centres,
        dot_sigma_factor=result.factors.dots,
        photographs_differ=result.differ,
        prints={folder: {"stretch": float(a), "shear": float(b)} for folder, (a, b) in result.prints().items()},
        redundancy=result.redundancy,
        rounds=calibration.rounds,
        projection_sigma_px=float(np.median(projection.sigma_px)),
        corners=_rows(calibrate.CORNERS, reached),
        held_out_rms_px=None if held_out is None else held_out.rms_px(),
        models=calibration.candidates,
        images=list(_views(result)),
        outliers=list(_outliers(result)),
        left_out=[NamedReason.model_validate(each) for each in calibration.skipped],
        warnings=calibration.warnings,
    )


def _rows(names: Sequence[str], columns: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    return {name: {key: float(own[i]) for key, own in columns.items()} for i, name in enumerate(names)}


def _views(result: Intrinsics) -> Iterator[dict[str, Any]]:
    for model in result.models:
        residual = model.residuals_px(result.camera)
        for image, pose, rows in zip(model.images, model.camera_from_model, model.rows_by_image(), strict=True):
            tilt_deg = float(np.degrees(np.arccos(abs(pose.rotation[2, 2]))))
            yield {"image": image, "dots": len(rows), "tilt_deg": tilt_deg, "rms_px": rms(residual[rows])}


def _outliers(result: Intrinsics) -> Iterator[dict[str, Any]]:
    for model, weights in zip(result.models, result.weights(), strict=True):
        length = np.linalg.norm(model.residuals_px(result.camera), axis=1)
        for i in np.flatnonzero(weights < calibrate.OUTLIER_WEIGHT):
            image, label = model.images[model.image_index[i]], model.labels[model.point_index[i]]
            yield {"image": image, "label": label, "residual_px": float(length[i]), "weight": float(weights[i])}


def calibration_report(result: CameraCalibration, summary: CalibrationFile, where: str) -> Document:
    lens, held = Camera.of(result.intrinsics.camera, result.intrinsics.colmap_model), summary.held_out_rms_px
    digits = {name: 4 if name[0] in "fc" else 7 for name in summary.parameters}
    rows = [[n, *(number(own[k], digits[n]) for k in ("value", "sigma"))] for n, own in summary.parameters.items()]
    models = []
    for own in summary.models:
        numbers = [number(v, 4) for v in (own.rms_px, own.worse, own.worse_sigma)]
        models.append(["*" * (own.model == summary.model), own.model, str(own.parameters), *numbers, own.why])
    images = [[v["image"], v["dots"], number(v["tilt_deg"], 1), number(v["rms_px"], 4)] for v in summary.images]
    outliers = [[o["image"], o["label"], number(o["residual_px"], 3), number(o["weight"], 2)] for o in summary.outliers]
    left_out = [[own.name, own.reason] for own in summary.left_out]
    differ = f"{summary.photographs_differ:.1f} times more than their pixels explain; σ are larger by that"
    parameters: list[Block] = [
        bullets(summary.warnings[1:]),
        Table(["<parameter", "value, px", "σ"], rows),
        "the principal point counts from the centre of the top-left pixel; the camera file, as COLMAP's, counts from "
        f"that pixel's corner, so that cx, cy are {COLMAP_PIXEL_ORIGIN:g} px larger there",
        f"σ of a projection: {summary.projection_sigma_px:.4f} px median over the image, "
        f"{result.projection.corner_sigma_px.max():.4f} px in the worst corner",
        f"photographs differ {differ if summary.photographs_differ > NOTED else 'no more than their pixels explain'}",
    ]
    if result.held_out is not None:
        parts = f"{result.held_out.folds} parts: residual RMS {held:.4f} px"
        parameters.append(f"views held out, {parts} after their poses were fitted")
    for folder, own in summary.prints.items():
        board = "the board" if folder == "." else f"the board of {folder}"
        parameters += stretch_in_words(board, **own)
    parameters.append(plots(plot(lambda: field_figure(*moved_px(lens)), "What the lens moves", css="")))
    uncertainty = [
        "How well it is known where the camera sees a known direction, up to a rotation of the camera, which poses "
        "absorb. Points: those of the boards",
        plots(plot(lambda: sigma_map(result), "σ of a projection over the image", "", "")),
    ]
    residuals = [
        "Means over cells of the image. Arrows that are alike in neighbouring cells are what the lens model leaves",
        plots(plot(lambda: residual_map(result), "Mean residuals, measured minus projected", css="")),
    ]
    chosen = [
        f"--model auto: {summary.model}, the simplest that foretells views held out as well as the best: not worse "
        "than it by more than two standard errors",
        Table(["<", "<lens model", "parameters", "held out px", "worse σ²", "±", "<"], models),
    ]
    out = [
        Table(["<image or file", "<reason"], left_out, css="text"),
        Table(["<image", "<dot", "residual px", "weight"], outliers),
    ]
    if summary.warnings:
        answer = Answer("with care", summary.warnings[0])
    else:
        fit = "" if held is None else f"; views held out fit to {held:.3g} px"
        answer = Answer("yes", f"no check found anything{fit}")
    return Document(
        "Calibration of a camera",
        f"{where}: {summary.model}, {summary.size_px[0]}×{summary.size_px[1]} px: {len(result.views)} views of the "
        f"board, {sum(len(view) for view in result.views)} dots, residual RMS {summary.residual_rms_px:.4f} px, "
        f"{result.rounds} rounds of detection",
        [
            Section("Parameters", parameters, terminal=True),
            Section("Uncertainty over the image", uncertainty),
            Section("Residuals", residuals),
            Section("Lens models", chosen if models else [], terminal=True),
            Section("Views", [Table(["<image", "dots", "tilt °", "RMS px"], images)]),
            Section("Left out", out, terminal=True),
        ],
        [answer],
    )


def sigma_map(result: CameraCalibration) -> Drawing:
    """Returns a figure of σ of projections over the image as shades, with the measured dots."""
    camera = result.intrinsics.camera
    drawing = Drawing(5.6, 0.6 + 4.4 * camera.height / camera.width)
    box = drawing.panels(top=20, right=44)[0]
    axes = Axes(drawing, box, (-0.5, camera.width - 0.5), (camera.height - 0.5, -0.5))
    sigma = result.projection.sigma_px.reshape(GRID[::-1])
    step = round_below(float(sigma.max()) / 8)
    bands = max(1, int(np.ceil(sigma.max() / step)))
    axes.shade(sigma, (0, 0, camera.width - 1, camera.height - 1), 0, bands * step, VIRIDIS, bands)
    for model in result.intrinsics.models:
        axes.marks(*model.measured_px.T, kind="dot", size=0.8, colour="#ffffff", opacity=0.5)
    axes.frame("x, px", "y, px")
    _, top, right, bottom = box
    drawing.scale((right + 8, top + 16, right + 15, bottom - 10), 0, bands * step, "σ, px", VIRIDIS)
    return drawing


def residual_map(result: CameraCalibration) -> Drawing:
    """Returns a figure of mean residuals over cells of the image."""
    camera, (mean, weight) = result.intrinsics.camera, calibrate.mean_residuals(result.intrinsics)
    count = weight.sum(0)
    mean = (weight[..., None] * mean).sum(0) / np.maximum(count, 1e-12)[:, None]
    return mean_residuals_figure(mean, count, calibrate.CELLS, (camera.width, camera.height))
