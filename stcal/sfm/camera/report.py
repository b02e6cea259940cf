"""Text and page of calibrated intrinsics, of one camera or of a rig."""

import numpy as np

from stcal.io.cameras.model import COLMAP_PIXEL_ORIGIN, CalibratedCamera
from stcal.report.camera import distortion_figure
from stcal.report.figure import COLOURS, INK, SMALL, calm, new_figure, plane, round_below, uri
from stcal.report.page import render
from stcal.report.text import HEADS, number, text_table, transform_rows
from stcal.sfm.camera.calibrate import CameraCalibration
from stcal.sfm.camera.checks import FAILED_P, GRID, SUSPICIOUS_P, projection_jacobian
from stcal.sfm.camera.file import CalibrationFile
from stcal.sfm.camera.rig import RigCalibration

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


CAMERA_HEADS = (
    "<camera",
    "<lens model",
    "views",
    "shared",
    "RMS px",
    "alone px",
    "σ of a projection px",
    "held out px",
)
FRUSTUM_SHARE = 0.15
"""Length of the drawn fields of view, as a share of the rig's extent."""


def rig_text(rig: RigCalibration) -> str:
    """Returns the cameras and their poses on the rig as text."""
    lines = [
        f"skipped {name}/{each.name}: {each.reason}"
        for name, camera in zip(rig.names, rig.cameras, strict=True)
        for each in camera.skipped
    ]
    lines += [f"apart {each.camera}/{each.image}: {each.reason}" for each in rig.apart]
    lines += [_headline(rig), "", *text_table([list(CAMERA_HEADS), *_camera_rows(rig)])]
    for name, rows in _poses(rig):
        lines += ["", *text_table([["<" + name, *HEADS[1:]], *rows])]
    lines += [f"warning: {each}" for each in _all_warnings(rig)]
    return "\n".join(lines)


def _headline(rig: RigCalibration) -> str:
    shared = sum(len(images) > 1 for images in rig.instants.values())
    return (
        f"{len(rig.names)} cameras, {len(rig.instants)} instants, {shared} of them seen by several; residuals are "
        f"{rig.factor:.3g} times those of the cameras alone"
    )


def _all_warnings(rig: RigCalibration) -> list[str]:
    each = zip(rig.names, rig.cameras, strict=True)
    return [*rig.warnings, *(f"{name}: {text}" for name, own in each for text in own.warnings)]


def _camera_rows(rig: RigCalibration) -> list[list[str]]:
    return [
        [
            name,
            camera.intrinsics.colmap_model,
            str(len(camera.views)),
            str(shared),
            number(rms, 4),
            number(alone, 4),
            number(float(np.median(camera.projection.sigma_px)), 4),
            number(camera.held_out.rms_px() if camera.held_out else None, 4),
        ]
        for name, camera, shared, rms, alone in zip(
            rig.names, rig.cameras, rig.shared, rig.rms_of_cameras(), rig.alone_rms_px, strict=True
        )
    ]


def _poses(rig: RigCalibration) -> list[tuple[str, list[list[str]]]]:
    each = zip(rig.names[1:], rig.camera_from_first[1:], rig.covariance[1:], strict=True)
    return [(f"{name}_from_{rig.names[0]}", transform_rows(pose, covariance)) for name, pose, covariance in each]


def rig_page(rig: RigCalibration, where: str) -> str:
    """Returns the report of ``calibrate-camera --rig``."""
    return render(
        "sfm/camera/rig.html.jinja",
        where=where,
        names=rig.names,
        headline=_headline(rig),
        warnings=rig.warnings,
        camera_heads=CAMERA_HEADS,
        cameras=_camera_rows(rig),
        heads=HEADS,
        poses=_poses(rig),
        arrangement=uri(_arrangement(rig)),
        by_instant=uri(_by_instant(rig)),
        maps=[
            (name, own.warnings, sigma_map(own), residual_map(own))
            for name, own in zip(rig.names, rig.cameras, strict=True)
        ],
        instants=[
            [name, number(rig.rms_px[name], 4), *(images.get(camera, "") for camera in rig.names)]
            for name, images in rig.instants.items()
        ],
        left_out=[[each.camera, each.image, each.reason] for each in rig.apart]
        + [
            [name, each.name, each.reason]
            for name, own in zip(rig.names, rig.cameras, strict=True)
            for each in own.skipped
        ],
        most=MOST_ROWS,
    )


def _arrangement(rig: RigCalibration):
    """Returns a figure of the cameras and their fields of view from above (x, z) and from the side (z, y).

    Coordinates are in the frame of the first camera.
    """
    inverse = [pose.inverse() for pose in rig.camera_from_first]
    places = np.array([pose.translation for pose in inverse])
    length = FRUSTUM_SHARE * max(float(np.ptp(places, axis=0).max()), 1.0) * 3
    figure = new_figure(7.2, 3.4)
    figure.set_layout_engine("constrained")
    for axes, (a, b), labels in zip(
        figure.subplots(1, 2), ((0, 2), (2, 1)), (("x, mm", "z, mm"), ("z, mm", "y, mm")), strict=True
    ):
        calm(axes)
        for k, (name, pose, calibration) in enumerate(zip(rig.names, inverse, rig.cameras, strict=True)):
            camera, colour = calibration.intrinsics.camera, COLOURS[k % len(COLOURS)]
            across = 0 if a == 0 else 1
            half = 0.5 * (camera.width, camera.height)[across] / camera.focal[across]
            edge = np.zeros((2, 3))
            edge[:, across], edge[:, 2] = [-half, half], 1.0
            ends = pose @ (length * edge / np.hypot(half, 1))
            fan = np.array([ends[0], pose.translation, ends[1]])
            axes.plot(fan[:, a], fan[:, b], color=colour, linewidth=1.2)
            axes.annotate(
                name, pose.translation[[a, b]], fontsize=SMALL, color=colour, xytext=(4, -8), textcoords="offset points"
            )
        plane(axes, *labels, 0.15)
    figure.axes[1].invert_yaxis()
    return figure


def _by_instant(rig: RigCalibration):
    """Returns a figure of the residuals by instant. Instants that several cameras saw have their own colour."""
    figure = new_figure(7.2, 2.2)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    calm(axes)
    shared = [len(images) > 1 for images in rig.instants.values()]
    axes.bar(
        range(len(shared)), list(rig.rms_px.values()), color=[COLOURS[0] if each else "#9aa0a8" for each in shared]
    )
    axes.set_ylabel("RMS, px", fontsize=SMALL + 0.5, color=INK)
    axes.set_xlabel("instant", fontsize=SMALL + 0.5, color=INK)
    return figure


def models_table(summary: CalibrationFile) -> list[str]:
    """Returns a table of how well lens models predict held-out views. The chosen model has a star."""
    rows = [["<", "<lens model", "parameters", "held out px", "worse σ²", "±", "<"]]
    for model in summary.models:
        star = "*" if model.model == summary.model else ""
        numbers = [number(model.rms_px, 4), number(model.worse, 4), number(model.worse_sigma, 4)]
        rows.append([star, model.model, str(model.parameters), *numbers, model.why])
    return text_table(rows)


def calibration_text(result: CameraCalibration, summary: CalibrationFile) -> str:
    """Returns the parameters with σ, checks, outliers and warnings as text."""
    lines = [f"skipped {each.name}: {each.reason}" for each in result.skipped]
    lines += [f"outlier {each.image} {each.label}: residual {each.residual_px:.3f} px" for each in summary.outliers]
    width, height = summary.size_px
    lines.append(
        f"{summary.model}, {width}×{height} px: {len(result.views)} views of the board, "
        f"{sum(len(v) for v in result.views)} dots, residual RMS {summary.residual_rms_px:.4f} px, "
        f"{result.rounds} rounds of detection"
    )
    lines += [
        f"{name:>4} {each.value:14.6f} ± {each.sigma:.6f}{' px' if name[0] in 'fc' else ''}"
        for name, each in summary.parameters.items()
    ]
    lines.append(
        "cx, cy count from the centre of the top-left pixel; the camera file is COLMAP's, counts from that pixel's "
        f"corner and has them {COLMAP_PIXEL_ORIGIN:g} px larger"
    )
    lines.append(
        f"σ of a projection: {np.median(result.projection.sigma_px):.4f} px median over the image, "
        f"{result.projection.corner_sigma_px.max():.4f} px in the worst corner"
    )
    if result.held_out is not None:
        lines.append(
            f"views held out, {result.held_out.folds} parts: residual RMS {result.held_out.rms_px():.4f} px after "
            "their poses were fitted"
        )
    if summary.models:
        lines += [
            f"--model auto: {summary.model}, the simplest that foretells them as well as the best",
            *models_table(summary),
        ]
    if split := result.split:
        lines.append(
            f"split-half check: {split.verdict}; p = {split.p_value:.2g}, largest difference {split.largest_px:.4f} px "
            f"where {np.sqrt(2) * split.largest_sigma_px:.4f} px is expected (suspicious by chance in one "
            f"calibration in {1 / SUSPICIOUS_P:,.0f}, failed in one in {1 / FAILED_P:,.0f})"
        )
    return "\n".join(lines + [f"warning: {warning}" for warning in result.warnings])
