"""``stcal-sfm measure``: the calibrated target at work."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.progress import StageProgress
from stcal.cli.saving import keep_apart
from stcal.cli.sfm import CameraFile, MaxDiameter, MinDiameter, TargetFile, Workers, ellipse_options
from stcal.design import reference_target
from stcal.errors import InputError
from stcal.io.camera import read_camera
from stcal.io.design import load_board, load_target
from stcal.io.saving import json_text, save

app = typer.Typer()


@app.command()
def measure(
    images: Annotated[Path, typer.Argument(help="Folder of images, in it or in its subfolders.")],
    camera: CameraFile,
    faces: Annotated[Path, typer.Option("--faces", help="faces.json of the target's calibration.")],
    target: TargetFile = None,
    out: Annotated[Path, typer.Option("--out", help="Table of the poses (CSV).")] = Path("poses.csv"),
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Also write everything as JSON, both poses of an undecided image too.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Also write a page with the poses, their σ and plots (HTML).")
    ] = None,
    joints: Annotated[
        Path | None,
        typer.Option("--joints", help="CSV with a column image: its other columns, joint values say, join the table."),
    ] = None,
    board: Annotated[
        Path | None, typer.Option("--board", help="board.toml of a dot board that is in view, to tell its dots apart.")
    ] = None,
    previous: Annotated[
        bool, typer.Option("--previous", help="Motions are small: the image before decides between two poses.")
    ] = False,
    sigma_factor: Annotated[
        float | None,
        typer.Option("--sigma-factor", min=1e-3, max=1e3, help="On the centres' σ; that of faces.json if not given."),
    ] = None,
    min_diameter: MinDiameter = None,
    max_diameter: MaxDiameter = 450.0,
    workers: Workers = None,
) -> None:
    """Pose of a calibrated target in each image, from whatever faces it shows, with its 6×6 covariance."""
    from stcal.io.table import read_table
    from stcal.sfm.measure import images as work
    from stcal.sfm.measure.pose import PoseOptions
    from stcal.sfm.measure.target import read_target
    from stcal.sfm.pipeline import load_design

    keep_apart({"--out": out, "--json": json_file, "--report": report}, (camera, faces, target, board, joints))
    for path in (out, json_file, report):
        if path is not None and not path.parent.is_dir():
            raise InputError(f"{path}: no folder {path.parent}; make it, or give another place")
    design = load_design(target, reference_target, load_target)
    known = read_target(faces, design)
    table = read_table(joints, "joints") if joints else None
    options = work.MeasureOptions(
        PoseOptions(sigma_factor=sigma_factor), previous, ellipse_options(min_diameter, max_diameter), workers
    )
    with StageProgress() as progress:
        result = work.measure(
            images, read_camera(camera), known, design, load_board(board) if board else None, options, progress
        )
    text, apart = work.poses_csv(result, table)
    print(work.measure_text(result))
    for each in apart:
        print(f"not joined: {each}")
    save(out, text)
    print(f"poses: {out}")
    if json_file:
        save(json_file, json_text(work.measure_json(result)))
        print(f"as JSON: {json_file}")
    if report:
        from stcal.sfm.measure.report import measure_page

        save(report, measure_page(result, str(images)))
        print(f"report: {report}")
