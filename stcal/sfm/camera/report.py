"""The page of ``calibrate-camera``: σ of projections over the image, and residuals of the lens model."""

import numpy as np

from stcal.io.cameras.model import CalibratedCamera
from stcal.report.camera import distortion_figure
from stcal.report.figure import INK, SMALL, calm, new_figure, round_below, uri
from stcal.report.page import render
from stcal.report.text import number
from stcal.sfm.camera.calibrate import CameraCalibration
from stcal.sfm.camera.file import CalibrationFile
from stcal.sfm.camera.trust import GRID, projection_jacobian

CELLS = (12, 8)
"""Number of cells of the figure of residuals, in x and y."""
MIN_IN_CELL = 3
ARROW_SHARE = 0.7
"""Largest length of a drawn mean residual, as a share of the cell."""
MOST_ROWS = 500


def calibration_page(result: CameraCalibration, summary: CalibrationFile, where: str) -> str:
    """Returns the report of ``calibrate-camera``."""
    intrinsics = result.intrinsics
    return render(
        "sfm/camera/page.html.jinja",
        where=where,
        summary=summary,
        views=len(result.views),
        dots=sum(len(view) for view in result.views),
        sigma=sigma_map(result),
        halves=_halves(result),
        split=result.split,
        residuals=residual_map(result),
        lens=uri(distortion_figure(CalibratedCamera.of(intrinsics.camera, intrinsics.colmap_model))),
        parameters=[
            [name, number(each.value, 4 if name[0] in "fc" else 7), number(each.sigma, 4 if name[0] in "fc" else 7)]
            for name, each in summary.parameters.items()
        ],
        models=[
            [
                "*" if each.model == summary.model else "",
                each.model,
                each.parameters,
                number(each.rms_px, 4),
                number(each.worse, 4),
                number(each.worse_sigma, 4),
                each.why,
            ]
            for each in summary.models
        ],
        images=[[each.image, each.dots, number(each.tilt_deg, 1), number(each.rms_px, 4)] for each in summary.images],
        left_out=[[each.name, each.reason] for each in summary.left_out],
        outliers=[[o.image, o.label, number(o.residual_px, 3), number(o.weight, 2)] for o in summary.outliers],
        most=MOST_ROWS,
    )


def _image_axes(result: CameraCalibration):
    camera = result.intrinsics.camera
    figure = new_figure(5.6, 0.9 + 4.6 * camera.height / camera.width)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    calm(axes)
    axes.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), aspect="equal")
    axes.set_xlabel("x, px", fontsize=SMALL + 0.5, color=INK)
    axes.set_ylabel("y, px", fontsize=SMALL + 0.5, color=INK)
    return figure, axes


def _map(result: CameraCalibration, values: np.ndarray, label: str):
    """Returns a figure of values (n,) over the image's grid as filled contours, with the measured dots."""
    figure, axes = _image_axes(result)
    grid = result.projection.xy_px.reshape(*GRID[::-1], 2)
    shown = values.reshape(GRID[::-1])
    contours = axes.contourf(grid[..., 0], grid[..., 1], shown, levels=12, cmap="viridis")
    for model in result.intrinsics.models:
        axes.plot(*model.measured_px.T, ".", color="white", markersize=1.0, alpha=0.5)
    bar = figure.colorbar(contours, ax=axes, shrink=0.85, pad=0.02)
    bar.set_label(label, fontsize=SMALL + 0.5, color=INK)
    bar.ax.tick_params(labelsize=SMALL)
    return uri(figure)


def sigma_map(result: CameraCalibration) -> str:
    return _map(result, result.projection.sigma_px, "σ of a projection, px")


def _halves(result: CameraCalibration) -> str | None:
    if result.split is None:
        return None
    moved = projection_jacobian(result.intrinsics.camera, result.intrinsics.colmap_model) @ result.split.difference
    return _map(result, np.linalg.norm(moved, axis=1), "difference of the halves, px")


def residual_map(result: CameraCalibration) -> str:
    """Returns a figure of mean residuals over cells of the image. Model errors are alike in neighbouring cells."""
    figure, axes = _image_axes(result)
    camera = result.intrinsics.camera
    xy = np.concatenate([model.measured_px for model in result.intrinsics.models])
    weight = np.concatenate(result.intrinsics.weights())
    residuals = result.intrinsics.residuals_px()
    size = np.array([camera.width, camera.height]) / CELLS
    cell = np.clip((xy / size).astype(int), 0, np.array(CELLS) - 1)
    index = cell[:, 0] * CELLS[1] + cell[:, 1]
    count = np.bincount(index, weight, CELLS[0] * CELLS[1])
    enough = count >= MIN_IN_CELL
    mean = np.stack([np.bincount(index, weight * residuals[:, i], len(count)) for i in range(2)], axis=1)
    mean = mean[enough] / count[enough, None]
    middle = (np.stack(np.divmod(np.flatnonzero(enough), CELLS[1]), axis=1) + 0.5) * size
    longest = float(np.linalg.norm(mean, axis=1).max()) if len(mean) else 0.0
    times = round_below(ARROW_SHARE * size.min() / longest) if longest else 1.0
    axes.quiver(
        *middle.T, *(times * mean).T, angles="xy", scale_units="xy", scale=1, color=INK, width=0.003, headwidth=4
    )
    axes.set_title(f"enlarged {times:g} times; the longest is {longest:.4f} px", fontsize=SMALL + 1, color=INK)
    return uri(figure)
