"""The result of a camera calibration as text for the terminal."""

import numpy as np

from stcal.io.cameras.model import COLMAP_PIXEL_ORIGIN
from stcal.report.text import number, text_table
from stcal.sfm.camera.calibrate import CameraCalibration
from stcal.sfm.camera.file import CalibrationFile
from stcal.sfm.camera.trust import FAILED_P, SUSPICIOUS_P


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
