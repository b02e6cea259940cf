"""``stcal-sfm calibrate-camera``: intrinsics from photographs of the board."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from stcal.cli.progress import StageProgress
from stcal.cli.sfm import BoardFile, TargetFile, Workers
from stcal.design import reference_board, reference_target
from stcal.errors import InputError
from stcal.io.camera import write_cameras_txt
from stcal.io.design import load_board, load_target
from stcal.io.saving import json_text, save

app = typer.Typer()


@app.command(name="calibrate-camera")
def calibrate_camera(
    images: Annotated[
        Path, typer.Argument(help="Photographs that show the board, in one folder or in IMAGES/<group>/ as for run.")
    ],
    out: Annotated[Path, typer.Option("--out", help="The camera file; must not exist.")] = Path("cameras.txt"),
    target: TargetFile = None,
    board: BoardFile = None,
    model: Annotated[
        str,
        typer.Option(help="SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV, as in COLMAP."),
    ] = "OPENCV",
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Figures and checks as JSON; beside the camera file if not given.")
    ] = None,
    workers: Workers = None,
) -> None:
    """Intrinsics from views of the board, without any start: cameras.txt with σ and correlations, for run."""
    from stcal.sfm.camera.calibrate import calibrate_camera as calibrate
    from stcal.sfm.camera.calibrate import calibration_json
    from stcal.sfm.pipeline import load_design

    if out.exists():
        raise InputError(f"{out}: exists; give a new file with --out")
    target_design = load_design(target, reference_target, load_target)
    board_design = load_design(board, reference_board, load_board)
    with StageProgress() as progress:
        result = calibrate(images, target_design, board_design, model, workers=workers, progress=progress)
    write_cameras_txt(out, result.intrinsics.camera, model, result.intrinsics.covariance)
    summary = calibration_json(result)
    json_file = json_file or out.with_suffix(".json")
    save(json_file, json_text(summary))
    _print(result, summary)
    print(f"camera file: {out}\nfigures and checks: {json_file}")


def _print(result, summary: dict) -> None:
    for each in result.skipped:
        print(f"skipped {each.name}: {each.reason}")
    for each in summary["outliers"]:
        print(f"outlier {each['image']} {each['label']}: residual {each['residual_px']:.3f} px")
    width, height = summary["size_px"]
    print(
        f"{summary['model']}, {width}×{height} px: {len(result.views)} views of the board, "
        f"{sum(len(v) for v in result.views)} dots, residual RMS {summary['residual_rms_px']:.4f} px, "
        f"{result.rounds} rounds of detection"
    )
    for name, each in summary["parameters"].items():
        print(f"{name:>4} {each['value']:14.6f} ± {each['sigma']:.6f}{' px' if name[0] in 'fc' else ''}")
    print(
        f"σ of a projection: {np.median(result.projection.sigma_px):.4f} px median over the image, "
        f"{result.projection.corner_sigma_px.max():.4f} px in the worst corner"
    )
    if result.split:
        split = result.split
        print(
            f"split-half check: {split.verdict}; p = {split.p_value:.2g}, largest difference {split.largest_px:.4f} px "
            f"where {np.sqrt(2) * split.largest_sigma_px:.4f} px is expected"
        )
    for warning in result.warnings:
        print(f"warning: {warning}")
