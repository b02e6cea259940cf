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
from stcal.errors import InputError

app = typer.Typer()


@app.command(name="calibrate-camera")
def calibrate_camera(
    images: Annotated[
        Path,
        "Read photographs that show the board from this folder, or from IMAGES/<group>/ as run does; with --rig from "
        "IMAGES/<camera>/.",
        Arg(),
    ],
    out: Annotated[
        Path | None,
        "Write the camera to this file, cameras.txt if not given; with --rig, write all cameras to this new folder, "
        "rig if not given.",
        WRITES,
    ] = None,
    target: TargetFile = None,
    board: Annotated[
        Path | None,
        "Read the board from this file, TOML or Kalibr's YAML: dots, chessboard, ChArUco, AprilGrid or "
        "asymmetric circles, in place of the reference board.",
    ] = None,
    rig: Annotated[
        bool,
        "Calibrate cameras that are fixed to each other. Each has a folder; photographs of the same instant have the "
        "same name.",
    ] = False,
    model: Annotated[
        list[str] | None,
        "Fit this model of COLMAP: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV (default) or FULL_OPENCV; "
        "for wide lenses SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE or THIN_PRISM_FISHEYE. `auto` takes "
        "the simplest model that predicts held-out views as well as the best one. With --rig, CAMERA=MODEL sets the "
        "model of one camera.",
    ] = None,
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
    correlations; or calibrate the cameras of a rig with their poses on it."""
    from stcal.boards.file import load_flat_board
    from stcal.design import BoardDesign
    from stcal.io.design import board_of, target_of
    from stcal.workflows.calibrate_camera import models_of

    models, common_model = models_of(model or [], "OPENCV")
    target_design = target_of(target)
    board_design = board_of(None) if board is None else load_flat_board(board)
    dots = isinstance(board_design, BoardDesign)
    common = (json_file, report, workers)
    with designs_told(target, board, with_target=dots and board is None):
        if rig:
            failed = _rig(images, out or Path("rig"), target_design, board_design, common_model, models, *common)
        elif models:
            raise InputError(
                "E-OPTION-NEEDS",
                f"--model {next(iter(models))}=…: names a camera of a rig; give --rig, or a model alone",
            )
        else:
            failed = _one(images, out or Path("cameras.txt"), target_design, board_design, common_model, *common)
    require_passed(strict, failed, report)


def _one(images: Path, out: Path, target, board, model: str, json_file, report, workers) -> list[str]:
    """Calibrates one camera, and returns the failed checks."""
    from stcal.design import BoardDesign
    from stcal.geometry.camera import Camera
    from stcal.io.cameras.write import save_camera
    from stcal.sfm.camera.calibrate import calibrate_camera as calibrate
    from stcal.sfm.camera.file import CalibrationFile
    from stcal.sfm.camera.report import calibration_report
    from stcal.workflows.calibrate_camera import calibrate_camera_by_corners

    json_file = json_file or out.with_suffix(".json")
    require_new([("--out", out), *([("--json", json_file)] if json_file != STANDARD_OUTPUT else [])])
    with StageProgress() as progress:
        if isinstance(board, BoardDesign):
            result = calibrate(images, target, board, model, workers=workers, progress=progress)
        else:
            result = calibrate_camera_by_corners(images, board, model, workers, progress)
    intrinsics = result.intrinsics
    save_camera(out, Camera.of(intrinsics.camera, intrinsics.colmap_model, intrinsics.covariance), "colmap")
    summary = CalibrationFile.of(result)
    document = calibration_report(result, summary, str(images))
    say(document.text())
    print_each("warning", result.warnings)
    say(f"camera file: {out}")
    write(json_file, summary, "figures and checks")
    write_if(report, document.page, "report")
    return ["split-half check"] if result.split is not None and result.split.verdict == "failed" else []


def _rig(images: Path, out: Path, target, board, common, models, json_file, report, workers) -> list[str]:
    """Calibrates the cameras of a rig, and returns the failed checks."""
    from stcal.io.files import require_new_folder, save_folder
    from stcal.sfm.camera.file import RigCalibrationFile
    from stcal.sfm.camera.report import rig_report
    from stcal.workflows.calibrate_camera import calibrate_rig, files_of, require_rig_written

    require_new_folder(out, images)
    with StageProgress() as progress:
        calibration = calibrate_rig(images, target, board, common, models, workers, progress)
    files, missing = files_of(calibration)
    save_folder(out, files)
    require_rig_written(out, files, calibration)
    document = rig_report(calibration, str(images))
    say(document.text())
    print_each("warning", calibration.warnings)
    for name, single in zip(calibration.names, calibration.cameras, strict=True):
        print_each("warning", (f"{name}: {text}" for text in single.warnings))
    print_each("note", missing)
    say(f"rig: {out}: {', '.join(files)}")
    write_if(json_file, lambda: RigCalibrationFile.of(calibration), "figures and checks")
    write_if(report, document.page, "report")
    named_cameras = zip(calibration.names, calibration.cameras, strict=True)
    return [
        f"split-half check of {name}"
        for name, single in named_cameras
        if single.split and single.split.verdict == "failed"
    ]
