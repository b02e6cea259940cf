"""Command ``stcal-sfm measure``: poses of the calibrated target in images."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, say, write, write_if
from stcal.errors import InputError

app = typer.Typer()


@app.command()
def measure(
    camera: shared.CameraFile,
    faces: Annotated[Path, "Read the calibrated target from this faces.json."],
    images: Annotated[
        Path | None, "Read the images of this folder and of its subfolders; none with --serve.", Arg()
    ] = None,
    target: shared.TargetFile = None,
    out: Annotated[Path, "Write the table of poses to this file (CSV).", WRITES] = Path("poses.csv"),
    json_file: Annotated[
        Path | None,
        "Also write everything to this file, both solutions of an undecided image too (JSON); to standard "
        "output with `-`.",
        Opt("--json", writes=True),
    ] = None,
    report: shared.ReportFile = None,
    joints: Annotated[
        Path | None, "Add to the table the columns of this file, joint values say; it needs a column image (CSV)."
    ] = None,
    columns: Annotated[Path | None, "Read --joints with the columns, delimiter … of this file (TOML)."] = None,
    board: Annotated[Path | None, "Tell the dots of the board of this board.toml apart, if it is in view."] = None,
    previous: Annotated[bool, "Decide between two solutions by the image before, as motions are small."] = False,
    sequence: Annotated[
        bool,
        "Follow the target from image to image of each folder, in order of name, and search an image as a whole "
        "only where it is lost. An undecided pose is decided as with --previous.",
    ] = False,
    sigma_factor: Annotated[
        float | None,
        "Multiply the centres' σ by this; by the factor of faces.json if not given.",
        Opt(min=1e-3, max=1e3),
    ] = None,
    strict: shared.Strict = False,
    min_diameter: shared.MinDiameter = None,
    max_diameter: shared.MaxDiameter = 450.0,
    workers: shared.Workers = None,
    scheduler: shared.Scheduler = None,
    send_images: shared.SendImages = False,
    serve: Annotated[
        bool, "Answer images that programs send over HTTP, POST /measure, with a JSON each, until Ctrl-C."
    ] = False,
    host: Annotated[str, "Listen at this address with --serve; other machines reach 0.0.0.0."] = "127.0.0.1",
    port: Annotated[int, "Listen at this port with --serve; at a free one with 0.", Opt(min=0, max=65535)] = 8765,
    max_megabytes: Annotated[float, "Accept image files up to this size with --serve.", Opt(min=0.01, max=2000)] = 64.0,
    token: Annotated[
        str, "Answer with --serve only requests with `Authorization: Bearer` and this word.", Opt(envvar="STCAL_TOKEN")
    ] = "",
) -> None:
    """Measure the pose of a calibrated target in each image, from whatever faces it shows, with its 6×6 covariance."""
    if serve:
        alone = {"IMAGES": images, "--json": json_file, "--report": report, "--joints": joints, "--columns": columns}
        alone |= {
            "--previous": previous,
            "--sequence": sequence,
            "--scheduler": scheduler,
            "--send-images": send_images,
            "--strict": strict,
        }
        if conflicting := [name for name, value in alone.items() if value]:
            raise InputError(
                "E-OPTION-CONFLICT",
                f"--serve and {conflicting[0]}: images come over HTTP, one answer each; leave {conflicting[0]} out",
            )
        ellipses = shared.ellipse_options(min_diameter, max_diameter)
        _serve(camera, faces, target, board, sigma_factor, ellipses, (host, port, max_megabytes, token), workers)
        return
    if images is None:
        raise InputError("E-OPTION-MISSING", "IMAGES: missing; give the folder of images, or --serve")
    if columns is not None and joints is None:
        raise InputError("E-OPTION-NEEDS", f"--columns {columns}: of a table of joint values; give it with --joints")
    shared.load_ahead(workers)
    from stcal.boards.target import body_of
    from stcal.io.cameras.read import read_camera
    from stcal.io.design import load_board
    from stcal.io.join import table_of
    from stcal.sfm.measurement import images as work
    from stcal.sfm.measurement import report as output
    from stcal.sfm.measurement.pose import PoseOptions, fit_verdict
    from stcal.sfm.measurement.target import read_target

    for path in (out, json_file, report):
        if path is not None and not path.parent.is_dir():
            raise InputError("E-OUTPUT-FOLDER", f"{path}: no folder {path.parent}; make it, or give another place")
    design = body_of(target)
    circles = read_target(faces, design)
    table = table_of(joints, columns, "joints") if joints else None
    options = work.MeasureOptions(
        PoseOptions(sigma_factor=sigma_factor),
        previous,
        sequence,
        shared.ellipse_options(min_diameter, max_diameter),
        workers,
    )
    told = shared.designs_told(target, board, with_board=False)
    with told, shared.handed_over(scheduler, send_images), StageProgress() as progress:
        result = work.measure(
            images, read_camera(camera), circles, design, load_board(board) if board else None, options, progress
        )
    text, apart = output.poses_csv(result, table)
    document = output.measure_report(result, str(images))
    say(document.text())
    print_each("not joined", apart)
    write(out, text, "poses")
    output.require_table_written(out, result, table)
    write_if(json_file, lambda: output.poses_file(result), "as JSON")
    write_if(report, document.page, "report")
    failed = [image.name for image in result.images if fit_verdict(image.pose) == "failed"]
    shared.require_passed(strict, [f"χ² of {name}" for name in failed], report)


def _serve(camera, faces, target, board, sigma_factor, ellipses, listen, workers) -> None:
    from stcal.boards.target import body_of
    from stcal.io.cameras.read import read_camera
    from stcal.io.design import load_board
    from stcal.sfm.measurement.pose import PoseOptions
    from stcal.sfm.measurement.serve import MeasureServer, MeasureService, ServeOptions, Setting, counts_text, serve
    from stcal.sfm.measurement.target import read_target

    options = ServeOptions(*listen)
    workers = workers or os.cpu_count() or 1
    circles = replace(read_target(faces, design := body_of(target)), design=design)
    setting = Setting(
        circles,
        read_camera(camera),
        load_board(board) if board else None,
        PoseOptions(sigma_factor=sigma_factor),
        ellipses,
    )
    servers: list[MeasureServer] = []

    def ready(server: MeasureServer) -> None:
        servers.append(server)
        if not server.local:
            who = "that knows the token" if options.token else f"that reaches {options.host}"
            remedy = "" if options.token else "; give a --token"
            print_each("warning", [f"every machine {who} can send images; nothing is encrypted{remedy}"])
        say(f"answering POST {server.url}/measure, {workers} processes, files up to {options.max_megabytes:g} MB")
        sys.stdout.flush()

    try:
        serve(MeasureService(setting, workers), options, ready)
    finally:
        for server in servers:
            say(counts_text(server.counts))
