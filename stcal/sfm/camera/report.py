"""The report of calibrated intrinsics, of one camera or of a rig."""

import numpy as np

from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, Camera
from stcal.report.camera import distortion_figure
from stcal.report.document import (
    Block,
    Document,
    Section,
    Table,
    alarms,
    bullets,
    page_only,
    plot,
    plots,
    subheading,
)
from stcal.report.svg import COLOURS, INK, SMALL, calm, new_figure, plane, round_below
from stcal.report.text import HEADS, number, transform_rows
from stcal.sfm.camera.calibrate import CameraCalibration
from stcal.sfm.camera.checks import FAILED_P, GRID, SUSPICIOUS_P, projection_jacobian
from stcal.sfm.camera.file import CalibrationFile
from stcal.sfm.camera.rig import RigCalibration

CELLS = (12, 8)
"""Number of cells of the figure of residuals, in x and y."""
MIN_IN_CELL = 3
ARROW_SHARE = 0.7
"""Largest length of a drawn mean residual, as a share of the cell."""


def calibration_report(result: CameraCalibration, summary: CalibrationFile, where: str) -> Document:
    """Returns the report of ``calibrate-camera``."""
    lens = Camera.of(result.intrinsics.camera, result.intrinsics.colmap_model)
    parameters = [
        [name, number(each.value, 4 if name[0] in "fc" else 7), number(each.sigma, 4 if name[0] in "fc" else 7)]
        for name, each in summary.parameters.items()
    ]
    models = [
        ["*" if each.model == summary.model else "", each.model, str(each.parameters)]
        + [number(v, 4) for v in (each.rms_px, each.worse, each.worse_sigma)]
        + [each.why]
        for each in summary.models
    ]
    images = [[each.image, each.dots, number(each.tilt_deg, 1), number(each.rms_px, 4)] for each in summary.images]
    outliers = [[o.image, o.label, number(o.residual_px, 3), number(o.weight, 2)] for o in summary.outliers]
    held_out = (
        ""
        if result.held_out is None
        else f"views held out, {result.held_out.folds} parts: residual RMS {result.held_out.rms_px():.4f} px after "
        "their poses were fitted"
    )
    sigma = (
        f"σ of a projection: {np.median(result.projection.sigma_px):.4f} px median over the image, "
        f"{result.projection.corner_sigma_px.max():.4f} px in the worst corner"
    )
    return Document(
        "Calibration of a camera",
        f"{where}: {summary.model}, {summary.size_px[0]}×{summary.size_px[1]} px: {len(result.views)} views of the "
        f"board, {sum(len(view) for view in result.views)} dots, residual RMS {summary.residual_rms_px:.4f} px, "
        f"{result.rounds} rounds of detection",
        [
            Section(
                "Parameters",
                [
                    alarms(summary.warnings),
                    Table(["<parameter", "value, px", "σ"], parameters),
                    "the principal point counts from the centre of the top-left pixel; the camera file, as COLMAP's, "
                    f"counts from that pixel's corner, so that cx, cy are {COLMAP_PIXEL_ORIGIN:g} px larger there",
                    sigma,
                    held_out,
                    *_split_half(result),
                    plot(lambda: distortion_figure(lens), "What the lens moves"),
                ],
                terminal=True,
            ),
            Section(
                "Uncertainty over the image",
                [
                    "How well it is known where the camera sees a known direction, up to a rotation of the camera, "
                    "which poses absorb. White: dots",
                    plots(
                        plot(lambda: sigma_map(result), "σ of a projection over the image", "σ, by the covariance", ""),
                        None
                        if result.split is None
                        else plot(
                            lambda: _halves(result),
                            "difference of two halves over the image",
                            f"Every second view against the others: {result.split.verdict}, p = "
                            f"{result.split.p_value:.2g}",
                            "",
                        ),
                    ),
                ],
            ),
            Section(
                "Residuals",
                [
                    "Means over cells of the image. Arrows that are alike in neighbouring cells are what the lens "
                    "model leaves",
                    plots(plot(lambda: residual_map(result), "Mean residuals, measured minus projected", css="")),
                ],
            ),
            Section(
                "Lens models",
                [
                    f"--model auto: {summary.model}, the simplest that foretells views held out as well as the best",
                    page_only(
                        "Each model calibrated without a fifth of the views and compared with these, five times. The "
                        "star is the simplest that is not worse than the best by more than two standard errors"
                    ),
                    Table(["<", "<lens model", "parameters", "held out px", "worse σ²", "±", "<"], models),
                ]
                if models
                else [],
                terminal=True,
            ),
            Section("Views", [Table(["<image", "dots", "tilt °", "RMS px"], images)]),
            Section(
                "Left out",
                [
                    Table(["<image or file", "<reason"], [[e.name, e.reason] for e in summary.left_out], css="text"),
                    Table(["<image", "<dot", "residual px", "weight"], outliers),
                ],
                terminal=True,
            ),
        ],
    )


def _split_half(result: CameraCalibration) -> list[str]:
    split = result.split
    if split is None:
        return []
    return [
        f"split-half check: {split.verdict}; p = {split.p_value:.2g}, largest difference {split.largest_px:.4f} px "
        f"where {np.sqrt(2) * split.largest_sigma_px:.4f} px is expected (suspicious by chance in one "
        f"calibration in {1 / SUSPICIOUS_P:,.0f}, failed in one in {1 / FAILED_P:,.0f})"
    ]


def _image_axes(result: CameraCalibration):
    camera = result.intrinsics.camera
    figure = new_figure(5.6, 0.9 + 4.6 * camera.height / camera.width)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    calm(axes, "x, px", "y, px")
    axes.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), aspect="equal")
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
    return figure


def sigma_map(result: CameraCalibration):
    return _map(result, result.projection.sigma_px, "σ of a projection, px")


def _halves(result: CameraCalibration):
    assert result.split is not None
    moved = projection_jacobian(result.intrinsics.camera, result.intrinsics.colmap_model) @ result.split.difference
    return _map(result, np.linalg.norm(moved, axis=1), "difference of the halves, px")


def residual_map(result: CameraCalibration):
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
    return figure


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


def _headline(rig: RigCalibration) -> str:
    shared = sum(len(images) > 1 for images in rig.instants.values())
    return (
        f"{len(rig.names)} cameras, {len(rig.instants)} instants, {shared} of them seen by several; residuals are "
        f"{rig.factor:.3g} times those of the cameras alone"
    )


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


def rig_report(rig: RigCalibration, where: str) -> Document:
    """Returns the report of ``calibrate-camera --rig``."""
    own = list(zip(rig.names, rig.cameras, strict=True))
    left_out = [[each.camera, each.image, each.reason] for each in rig.apart]
    left_out += [[name, each.name, each.reason] for name, camera in own for each in camera.skipped]
    instants = [
        [name, number(rig.rms_px[name], 4), *(images.get(camera, "") for camera in rig.names)]
        for name, images in rig.instants.items()
    ]
    poses = [Table(["<" + name, *HEADS[1:]], rows) for name, rows in _poses(rig)]
    maps: list[Block] = []
    for name, camera in own:
        maps += [
            subheading(name),
            bullets(camera.warnings),
            plots(
                plot(lambda camera=camera: sigma_map(camera), f"σ of a projection of {name}", css=""),
                plot(lambda camera=camera: residual_map(camera), f"mean residuals of {name}", css=""),
            ),
        ]
    return Document(
        f"Calibration of a rig of cameras: {', '.join(rig.names)}",
        f"{where}: {_headline(rig)}",
        [
            Section(
                "Cameras",
                [
                    alarms(rig.warnings),
                    Table(CAMERA_HEADS, _camera_rows(rig), css="text"),
                    page_only(
                        "Shared: instants that another camera saw too. Alone: residuals before the cameras were held "
                        "to one rig. Views were held out from each camera by itself"
                    ),
                ],
                terminal=True,
            ),
            Section(
                "Where they sit",
                [
                    *poses,
                    page_only(
                        "The pose of the first camera in the other. σ are those of rotations about the axes, and of "
                        "translations along the axes, of the frame named first"
                    ),
                    plot(
                        lambda: _arrangement(rig),
                        "cameras from above and from the side",
                        "Cameras and their fields of view from above and from the side, in the frame of "
                        f"{rig.names[0]}",
                    ),
                ],
                terminal=True,
            ),
            Section(
                "Over the images",
                [
                    "σ of where a known direction is seen, up to a rotation of the camera; white: dots. Mean "
                    "residuals are measured minus projected: what is alike in neighbouring cells is what the lens "
                    "model leaves",
                    *maps,
                ],
            ),
            Section(
                "Instants",
                [
                    plot(
                        lambda: _by_instant(rig),
                        "residuals by instant",
                        "Residuals of each instant; grey: seen by one camera alone",
                    ),
                    Table(["<instant", "RMS px", *(name.replace("<", "") for name in rig.names)], instants, css="text"),
                ],
            ),
            Section("Left out", [Table(["<camera", "<image or file", "<reason"], left_out, css="text")], terminal=True),
        ],
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
    shared = [len(images) > 1 for images in rig.instants.values()]
    axes.bar(
        range(len(shared)), list(rig.rms_px.values()), color=[COLOURS[0] if each else "#9aa0a8" for each in shared]
    )
    calm(axes, "instant", "RMS, px")
    return figure
