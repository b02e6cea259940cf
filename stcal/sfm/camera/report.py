"""Report of calibrated intrinsics."""

import numpy as np

from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, Camera
from stcal.geometry.clusters import NOTED
from stcal.geometry.print_modes import stretch_in_words
from stcal.report.camera import field_figure, moved_px
from stcal.report.document import Answer, Block, Document, Section, Table, bullets, plot, plots
from stcal.report.svg import INK, SMALL, VIRIDIS, Axes, Drawing, round_below
from stcal.report.text import number
from stcal.sfm.camera.calibrate import CameraCalibration
from stcal.sfm.camera.checks import CELLS, GRID, mean_residuals
from stcal.sfm.camera.file import CalibrationFile

MIN_IN_CELL = 3
ARROW_SHARE = 0.7
"""Largest length of a drawn mean residual, as a share of the cell."""


def calibration_report(result: CameraCalibration, summary: CalibrationFile, where: str) -> Document:
    """Returns the report of ``calibrate-camera``."""
    lens, held_out = Camera.of(result.intrinsics.camera, result.intrinsics.colmap_model), result.held_out
    digits = {name: 4 if name[0] in "fc" else 7 for name in summary.parameters}
    parameters = [
        [name, number(each.value, digits[name]), number(each.sigma, digits[name])]
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
    differ = f"{summary.photographs_differ:.1f} times more than their pixels explain; σ are larger by that"
    blocks: list[Block] = [
        bullets(summary.warnings[1:]),
        Table(["<parameter", "value, px", "σ"], parameters),
        "the principal point counts from the centre of the top-left pixel; the camera file, as COLMAP's, counts from "
        f"that pixel's corner, so that cx, cy are {COLMAP_PIXEL_ORIGIN:g} px larger there",
        f"σ of a projection: {summary.projection_sigma_px:.4f} px median over the image, "
        f"{result.projection.corner_sigma_px.max():.4f} px in the worst corner",
        f"photographs differ {differ if summary.photographs_differ > NOTED else 'no more than their pixels explain'}",
    ]
    if held_out is not None:
        blocks.append(
            f"views held out, {held_out.folds} parts: residual RMS {held_out.rms_px():.4f} px after their poses were "
            "fitted"
        )
    for folder, own in summary.prints.items():
        board = "the board" if folder == "." else f"the board of {folder}"
        blocks += stretch_in_words(board, own.stretch, own.shear)
    chosen: list[Block] = [
        f"--model auto: {summary.model}, the simplest that foretells views held out as well as the best: not worse "
        "than it by more than two standard errors",
        Table(["<", "<lens model", "parameters", "held out px", "worse σ²", "±", "<"], models),
    ]
    return Document(
        "Calibration of a camera",
        f"{where}: {summary.model}, {summary.size_px[0]}×{summary.size_px[1]} px: {len(result.views)} views of the "
        f"board, {sum(len(view) for view in result.views)} dots, residual RMS {summary.residual_rms_px:.4f} px, "
        f"{result.rounds} rounds of detection",
        [
            Section(
                "Parameters",
                [*blocks, plot(lambda: field_figure(*moved_px(lens)), "What the lens moves")],
                terminal=True,
            ),
            Section(
                "Uncertainty over the image",
                [
                    "How well it is known where the camera sees a known direction, up to a rotation of the camera, "
                    "which poses absorb. White: dots",
                    plots(plot(lambda: sigma_map(result), "σ of a projection over the image", "", "")),
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
            Section("Lens models", chosen if models else [], terminal=True),
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
        [_verdict(summary)],
    )


def _verdict(summary: CalibrationFile) -> Answer:
    """Returns whether the camera may be used: with care where a warning says so."""
    if summary.warnings:
        return Answer("with care", summary.warnings[0])
    held = summary.held_out_rms_px
    return Answer("yes", "no check found anything" + ("" if held is None else f"; views held out fit to {held:.3g} px"))


def _image_axes(camera: Camera) -> Axes:
    drawing = Drawing(5.6, 0.6 + 4.4 * camera.height / camera.width)
    box = drawing.panels(top=20, right=44)[0]
    return Axes(drawing, box, (-0.5, camera.width - 0.5), (camera.height - 0.5, -0.5))


def sigma_map(result: CameraCalibration) -> Drawing:
    """Returns a figure of σ of projections over the image as shades, with the measured dots."""
    camera, axes = result.intrinsics.camera, _image_axes(result.intrinsics.camera)
    sigma = result.projection.sigma_px.reshape(GRID[::-1])
    step = round_below(float(sigma.max()) / 8)
    bands = max(1, int(np.ceil(sigma.max() / step)))
    axes.shade(sigma, (0, 0, camera.width - 1, camera.height - 1), 0, bands * step, VIRIDIS, bands)
    for model in result.intrinsics.models:
        axes.marks(*model.measured_px.T, kind="dot", size=0.8, colour="#ffffff", opacity=0.5)
    axes.frame("x, px", "y, px")
    _, top, right, bottom = axes.box
    axes.drawing.scale((right + 8, top + 16, right + 15, bottom - 10), 0, bands * step, "σ, px", VIRIDIS)
    return axes.drawing


def residual_map(result: CameraCalibration) -> Drawing:
    """Returns a figure of mean residuals over cells of the image. Model errors are alike in neighbouring cells."""
    camera = result.intrinsics.camera
    axes = _image_axes(camera)
    mean, weight = mean_residuals(result.intrinsics)
    size, count = np.array([camera.width, camera.height]) / CELLS, weight.sum(0)
    enough = count >= MIN_IN_CELL
    mean = (weight[..., None] * mean).sum(0)[enough] / count[enough, None]
    middle = (np.stack(np.divmod(np.flatnonzero(enough), CELLS[1]), axis=1) + 0.5) * size
    longest = float(np.linalg.norm(mean, axis=1).max()) if len(mean) else 0.0
    times = round_below(ARROW_SHARE * size.min() / longest) if longest else 1.0
    axes.arrows(middle, times * mean, 1.2, INK)
    axes.frame("x, px", "y, px")
    said = f"enlarged {times:g} times; the longest is {longest:.4f} px"
    axes.drawing.words(((axes.box[0] + axes.box[2]) / 2, 10), said, SMALL + 1)
    return axes.drawing
