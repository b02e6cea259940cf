"""Command ``stcal-sfm calibrate-camera``: intrinsics from photographs of the board."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.options import (
    WRITES,
    Arg,
    Opt,
    ReportFile,
    Strict,
    TargetFile,
    Workers,
    designs_told,
    require_new,
    require_passed,
)
from stcal.cli.terminal import STANDARD_OUTPUT, StageProgress, print_each, say, write, write_if

app = typer.Typer()


@app.command(name="calibrate-camera")
def calibrate_camera(
    images: Annotated[
        Path,
        "Read photographs that show the board from this folder, or from IMAGES/<group>/ as run does.",
        Arg(),
    ],
    out: Annotated[Path, "Write the camera to this file.", WRITES] = Path("cameras.txt"),
    target: TargetFile = None,
    board: Annotated[
        Path | None,
        "Read the board from this file, TOML or Kalibr's YAML: dots, chessboard, ChArUco, AprilGrid or "
        "asymmetric circles, in place of the reference board.",
    ] = None,
    model: Annotated[
        str,
        "Fit this model of COLMAP: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV; "
        "for wide lenses SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE or THIN_PRISM_FISHEYE. `auto` takes "
        "the simplest model that predicts held-out views as well as the best one.",
    ] = "OPENCV",
    json_file: Annotated[
        Path | None,
        "Write figures and checks to this file (JSON), or to standard output with `-`; beside --out if not given.",
        Opt("--json", writes=True),
    ] = None,
    report: ReportFile = None,
    strict: Strict = False,
    workers: Workers = None,
) -> None:
    """Calibrate the camera from views of the board, without start values, and write cameras.txt with σ and
    correlations."""
    from stcal.boards.file import load_flat_board
    from stcal.design import BoardDesign
    from stcal.geometry.camera import Camera
    from stcal.io.cameras.read import save_camera
    from stcal.io.design import board_of, target_of
    from stcal.sfm.camera.calibrate import calibrate_camera as calibrate
    from stcal.sfm.camera.file import CalibrationFile
    from stcal.sfm.camera.report import calibration_report
    from stcal.workflows.calibrate_camera import calibrate_camera_by_corners

    json_file = json_file or out.with_suffix(".json")
    require_new([("--out", out), *([("--json", json_file)] if json_file != STANDARD_OUTPUT else [])])
    target_design = target_of(target)
    board_design = board_of(None) if board is None else load_flat_board(board)
    dots = isinstance(board_design, BoardDesign)
    with designs_told(target, board, with_target=dots and board is None), StageProgress() as progress:
        if isinstance(board_design, BoardDesign):
            result = calibrate(images, target_design, board_design, model, workers=workers, progress=progress)
        else:
            result = calibrate_camera_by_corners(images, board_design, model, workers, progress)
    intrinsics = result.intrinsics
    save_camera(out, Camera.of(intrinsics.camera, intrinsics.colmap_model, intrinsics.covariance), "colmap")
    summary = CalibrationFile.of(result)
    document = calibration_report(result, summary, str(images))
    say(document.text())
    print_each("warning", result.warnings)
    say(f"camera file: {out}")
    write(json_file, summary, "figures and checks")
    write_if(report, document.page, "report")
    failed = result.split is not None and result.split.verdict == "failed"
    require_passed(strict, ["split-half check"] if failed else [], report)
