"""``stcal-sfm calibrate-camera``: intrinsics from photographs of the board."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.designs import designs_told
from stcal.cli.options import ReportFile, Strict, TargetFile, Workers, require_passed
from stcal.cli.terminal import StageProgress, say, write
from stcal.errors import InputError

app = typer.Typer()


@app.command(name="calibrate-camera")
def calibrate_camera(
    images: Annotated[
        Path,
        typer.Argument(help="Read photographs that show the board from this folder, or from IMAGES/<group>/ as run."),
    ],
    out: Annotated[
        Path, typer.Option("--out", writable=True, help="Write the camera to this file, which must not exist.")
    ] = Path("cameras.txt"),
    target: TargetFile = None,
    board: Annotated[
        Path | None,
        typer.Option(
            "--board",
            help="Read the board from this file: dots, chessboard or ChArUco (TOML), in place of the reference board.",
        ),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="Fit this model of COLMAP: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV; of "
            "wide lenses SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE, THIN_PRISM_FISHEYE; or `auto`: the "
            "simplest that foretells held-out views as well as the best."
        ),
    ] = "OPENCV",
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json",
            writable=True,
            help="Write figures and checks to this file (JSON); to standard output with `-`; beside --out if not "
            "given.",
        ),
    ] = None,
    report: ReportFile = None,
    strict: Strict = False,
    workers: Workers = None,
) -> None:
    """Calibrate the camera from views of the board, without any start: cameras.txt with σ and correlations, for run."""
    from stcal.boards.file import load_flat_board
    from stcal.design import BoardDesign
    from stcal.io.camera import CalibratedCamera, write_cameras_txt
    from stcal.io.design import board_of, target_of
    from stcal.sfm.camera.calibrate import calibrate_camera as calibrate
    from stcal.sfm.camera.file import CalibrationFile
    from stcal.sfm.camera.text import calibration_text
    from stcal.workflows.calibrate_camera import calibrate_camera_by_corners

    if out.exists():
        raise InputError(f"{out}: exists; give a new file with --out")
    target_design = target_of(target)
    board_design = board_of(None) if board is None else load_flat_board(board)
    dots = isinstance(board_design, BoardDesign)
    with designs_told(target, board, with_target=dots), StageProgress() as progress:
        if isinstance(board_design, BoardDesign):
            result = calibrate(images, target_design, board_design, model, workers=workers, progress=progress)
        else:
            result = calibrate_camera_by_corners(images, board_design, model, workers, progress)
    own = result.intrinsics
    write_cameras_txt(out, CalibratedCamera.of(own.camera, own.colmap_model, own.covariance))
    summary = CalibrationFile.of(result)
    json_file = json_file or out.with_suffix(".json")
    say(calibration_text(result, summary))
    say(f"camera file: {out}")
    write(json_file, summary, "figures and checks")
    if report:
        from stcal.sfm.camera.report import calibration_page

        write(report, calibration_page(result, summary, str(images)), "report")
    failed = result.split is not None and result.split.verdict == "failed"
    require_passed(strict, ["split-half check"] if failed else [], report)
