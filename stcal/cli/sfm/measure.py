"""Commands ``stcal-sfm plan``, ``advise``, ``calibrate-camera`` and ``measure``: photographs before and after a run."""

import json
import re
import sys
import threading
import time
from contextlib import nullcontext
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer

from stcal.cli import options as shared
from stcal.cli.options import JSON, SEED, WIDTH, WRITES, Arg, Opt
from stcal.cli.terminal import STANDARD_OUTPUT, StageProgress, print_each, printed_last, say, verbose, write, write_if
from stcal.errors import InputError

app = typer.Typer()


@app.command()
def plan(
    images: Annotated[int, "Plan this many images in each group.", Opt(min=2, max=500)] = 10,
    spread: Annotated[float, "Spread the views by ± this, degrees.", Opt(min=2, max=80)] = 40.0,
    distance: shared.Distance = 1000.0,
    width: Annotated[
        int | None, "Take images of this width, px, 3:2, with a 24 mm lens; 5184 if not given.", WIDTH
    ] = None,
    camera: Annotated[Path | None, "Read the camera from this file, in place of --width."] = None,
    noise: Annotated[float | None, "Assume this σ of every centre, px.", Opt(min=1e-5, max=10)] = None,
    run: Annotated[
        Path | None, "Take the σ of the centres, and target, board and camera if not given, from this finished run."
    ] = None,
    target: shared.TargetFile = None,
    faces: Annotated[Path | None, "Place the faces of --target as in the faces.json of an earlier run."] = None,
    board: shared.BoardFile = None,
    groups: Annotated[str | None, "Photograph these pairs of faces, such as 12,14 or front-right,front-top."] = None,
    refine_camera: Annotated[bool, "Adjust the intrinsics too."] = False,
    one_board: Annotated[bool, "Use one plate in all groups, not one each.", Opt("--one-board/--own-boards")] = True,
    seed: Annotated[int, "Place board and cameras at random with this seed.", SEED] = 0,
    margin_mm: shared.PlateMargin = 15.0,
    out: shared.JsonFile = None,
) -> None:
    """Forecast the σ before any photograph is taken, without Monte Carlo, and say what would help most."""
    from stcal.boards import board_file, target_file
    from stcal.io.cameras.read import read_camera
    from stcal.sfm.planning import advise, session
    from stcal.sfm.runs.run_options import RunOptions
    from stcal.sfm.runs.saved import load_run

    def of_run(given: Path | None, name: str) -> Path | None:
        file = run / "inputs" / name if run else None
        return given or (file if file and file.exists() else None)

    target, board = of_run(target, "target.toml"), of_run(board, "board.toml")
    camera = of_run(camera, "cameras.txt") if width is None else camera
    design = target_file.target_of(target)
    if noise is not None and run is not None:
        raise InputError("E-OPTION-CONFLICT", f"--noise {noise:g} and --run {run}: both state σ; give one of them")
    if noise is not None:
        centre_noise = session.CentreNoise(0.0, floor_px=noise, corner_px=noise)
        source = "--noise, whatever the size of a circle"
    elif run is not None:
        saved = load_run(run)
        centre_noise, source = advise.noise_of_run(saved), f"by size and tilt as in {run}"
        if failures := advise.failures_of(saved):
            print_each("warning", [f"{failures}: the σ of its centres have in them what failed"])
    else:
        centre_noise, source = advise.expected_noise(of_corners=bool(design.with_faces(printed=True).faces))
        source = f"{source} (--noise, --run)"
    model, pairs = read_camera(camera) if camera else None, session.pairs_of_faces(groups, design) if groups else None
    how = centre_noise, one_board, RunOptions(refine_camera=refine_camera), seed, margin_mm
    options = session.PlanOptions(images, spread, distance, width or 5184, model, pairs, *how)
    with shared.designs_told(target, board):
        result = session.plan(options, design, board_file.load_dots(board) if board else None, faces)
    with printed_last():
        say(session.plan_text(result, source))
        write_if(out, lambda: session.PlanFile.of_plan(result), "as JSON")


@app.command()
def advise(
    run: shared.Run,
    count: Annotated[int, "Advise this many views.", Opt(min=1, max=50)] = 5,
    out: shared.JsonFile = None,
) -> None:
    """Compute which further photographs would lower the σ of the worst face of a run most."""
    shared.load_ahead(None)
    from stcal.sfm.planning import advise
    from stcal.sfm.runs.saved import load_run

    saved = load_run(run)
    print_each("warning", filter(None, [advise.doubts(saved)]))
    geometry = advise.known_of(saved)
    with StageProgress() as progress:
        advice = advise.advise(geometry, count, progress)
    with printed_last():
        say(advise.advice_text(advice))
        write_if(out, lambda: advise.AdviceFile.of_advice(advice), "as JSON")


@app.command(name="calibrate-camera")
def calibrate_camera(
    images: Annotated[Path, "Read photographs of the board from this folder, or frames of a video, like run.", Arg()],
    out: Annotated[Path, "Write the camera to this file.", WRITES] = Path("cameras.txt"),
    target: shared.TargetFile = None,
    board: Annotated[Path | None, "Read the board, of any kind, from this file (TOML, or Kalibr's YAML)."] = None,
    model: Annotated[
        str,
        "Fit this model of COLMAP: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV; "
        "for wide lenses SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE or THIN_PRISM_FISHEYE. `auto` takes "
        "the simplest model that predicts held-out views as well as the best one.",
    ] = "OPENCV",
    json_file: Annotated[Path | None, "Write figures and checks here (JSON), or beside --out.", JSON] = None,
    report: shared.ReportFile = None,
    strict: shared.Strict = False,
    workers: shared.Workers = None,
) -> None:
    """Calibrate the camera from views of the board, without start values, and write cameras.txt with σ and
    correlations."""
    from stcal.boards import board_file, target_file
    from stcal.design import BoardDesign
    from stcal.geometry.camera import Camera
    from stcal.io.cameras.read import save_camera
    from stcal.io.device import images_or_frames
    from stcal.sfm.camera import calibrate, camera_report
    from stcal.workflows.board_views import calibrate_camera_by_corners

    json_file = json_file or out.with_suffix(".json")
    shared.require_new([("--out", out), *([("--json", json_file)] if json_file != STANDARD_OUTPUT else [])])
    target_design = target_file.target_of(target, printed=False)
    board_design = board_file.board_of(None) if board is None else board_file.load_flat_board(board)
    dots = isinstance(board_design, BoardDesign)
    told = shared.designs_told(target, board, with_target=dots and board is None)
    with told, images_or_frames(images) as folder, StageProgress() as progress:
        if isinstance(board_design, BoardDesign):
            how: dict[str, Any] = {"workers": workers, "progress": progress}
            result = calibrate.calibrate_camera(folder, target_design, board_design, model, **how)
        else:
            result = calibrate_camera_by_corners(folder, board_design, model, workers, progress)
    intrinsics = result.intrinsics
    save_camera(out, Camera.of(intrinsics.camera, intrinsics.colmap_model, intrinsics.covariance), "colmap")
    summary = camera_report.calibration_file(result)
    document = camera_report.calibration_report(result, summary, str(images))
    with printed_last():
        say(document.text())
        print_each("warning", result.warnings)
        say(f"camera file: {out}")
        write(json_file, summary, "figures and checks")
        write_if(report, document.page, "report")
    shared.require_passed(strict, [] if intrinsics.settled else ["σ of centres and dots"], report)


SAY_EVERY_S = 1.0  # shortest time between two lines of --live, s
TABLE = Path("poses.csv")


@app.command()
def measure(
    camera: shared.CameraFile,
    faces: Annotated[Path, "Read the calibrated target from this faces.json."],
    images: Annotated[
        Path | None,
        "Read the images of this folder and its subfolders; or, with --live, a stream's URL or a video.",
        Arg(),
    ] = None,
    target: shared.TargetFile = None,
    out: Annotated[Path, "Write the table of poses to this file (CSV).", WRITES] = TABLE,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
    joints: Annotated[Path | None, "Add the columns of this file, such as joints, by its column image (CSV)."] = None,
    board: Annotated[Path | None, "Identify the dots of the board in this board.toml, if the board is in view."] = None,
    previous: Annotated[bool, "Decide between two solutions by the previous image, assuming small motions."] = False,
    sequence: Annotated[bool, "Follow the target from image to image, by name, and decide as with --previous."] = False,
    sigma_factor: Annotated[
        float | None, "Multiply the σ of the centres by this, not by that of faces.json.", Opt(min=1e-3, max=1e3)
    ] = None,
    strict: shared.Strict = False,
    detection: shared.DetectionOptions = shared.DETECTION,
    serve: Annotated[bool, "Answer images sent over HTTP, POST /pose, with JSON for each, until Ctrl-C."] = False,
    live: Annotated[
        bool,
        "Show a page with the pictures of a camera, or of the folder, stream or video IMAGES, and the target's pose in "
        "each, until Ctrl-C. One line is printed per second; with `--json -`, every pose is.",
    ] = False,
    camera_index: Annotated[int, "Take the pictures of --live from this camera.", Opt(min=0, max=99)] = 0,
    host: Annotated[str, "Listen at this address; at 0.0.0.0, other machines connect with --token."] = "127.0.0.1",
    port: Annotated[int, "Listen at this port; 0 chooses a free one.", Opt(min=0, max=65535)] = 8765,
    max_megabytes: Annotated[float, "Accept image files up to this size over HTTP.", Opt(min=0.01, max=2000)] = 64.0,
    token: Annotated[
        str, "Answer only requests with this word, as `Authorization: Bearer` or ?token=.", Opt(envvar="STCAL_TOKEN")
    ] = "",
) -> None:
    """Measure the pose of a calibrated target in each image, from the visible faces, with its 6×6 covariance."""
    ellipses = detection.ellipses()
    target = _design_beside(faces) if target is None else target
    if serve or live:
        mode, source = ("--live", "from a camera, as taken") if live else ("--serve", "over HTTP, one answer each")
        alone = {"--serve": serve and live, "--report": report, "--joints": joints, "--out": out != TABLE}
        to_file = None if live and json_file == STANDARD_OUTPUT else json_file
        alone |= {"IMAGES": images if serve else None, "--json": to_file}
        alone |= {"--previous": previous, "--sequence": sequence, "--scheduler": detection.scheduler}
        alone |= {"--send-images": detection.send_images, "--strict": strict, "--workers": detection.workers}
        if conflict := next((name for name, value in alone.items() if value), None):
            lines = ", or give --json -, a line each" if live and conflict in ("--json", "--out") else ""
            raise InputError("E-OPTION-CONFLICT", f"{mode} and {conflict}: images come {source}; leave it out{lines}")
    elif images is None:
        raise InputError("E-OPTION-MISSING", "IMAGES: missing; give the folder of images, --serve or --live")
    else:
        from stcal.io.images import SUFFIXES

        if images.is_file() and images.suffix.lower() not in SUFFIXES:
            remedy = "for the pose in each picture of a video give --live --json -, or give the folder of its frames"
            raise InputError("E-IMAGES-FOLDER", f"{images}: a file, and no image; {remedy}")
        shared.load_ahead(detection.workers)
    from stcal.boards import board_file, target_file
    from stcal.io.cameras.read import read_camera
    from stcal.io.table import read_table
    from stcal.sfm.adjust.faces_file import read_target
    from stcal.sfm.measurement import measure_images as work
    from stcal.sfm.measurement import pose_report as output
    from stcal.sfm.measurement.pose import PoseOptions, fit_verdict

    for path in (out, json_file, report):
        if path is not None and not path.parent.is_dir():
            raise InputError("E-OUTPUT-FOLDER", f"{path}: no folder {path.parent}; make it, or give another place")
    design = target_file.target_of(target)
    circles, dots = read_target(faces, design), board_file.load_dots(board) if board else None
    posing = PoseOptions(sigma_factor=sigma_factor)
    if serve or live:
        # A path has one slash where the URL of a stream has two.
        url = re.sub(r"^([a-z]+):/(?!/)", r"\1://", str(images))
        source = None if serve else camera_index if images is None else url
        model = read_camera(camera)
        model = replace(model, source=Path(model.source).name)  # answers name no folder of this machine
        setting = replace(circles, design=design), model, dots, posing, ellipses
        limits = {"token": token, "max_megabytes": max_megabytes}
        _serve(setting, source, host, port, limits, json_file is not None)
        return
    assert images is not None  # else it was refused above
    table = read_table(joints, "joints") if joints else None
    options = work.MeasureOptions(posing, previous, sequence, ellipses, detection.workers)
    told = shared.designs_told(target, board, with_board=False)
    with told, detection.handed_over(), StageProgress() as progress:
        result = work.measure(images, read_camera(camera), circles, design, dots, options, progress)
    text, apart = output.poses_csv(result, table)
    document = output.measure_report(result, str(images), every=verbose())
    with printed_last():
        say(document.text())
        print_each("not joined", apart)
        write(out, text, "poses")
        output.require_table_written(out, result, table)
        write_if(json_file, lambda: output.poses_file(result), "as JSON")
        write_if(report, document.page, "report")
    failed = [image.name for image in result.images if fit_verdict(image.pose) == "failed"]
    shared.require_passed(strict, [f"χ² of {name}" for name in failed], report)


def _design_beside(faces: Path) -> Path | None:
    from stcal.io.files import RUN_MARKER, TARGET

    own = faces.parent / TARGET
    if not ((faces.parent / RUN_MARKER).is_file() and own.is_file()):
        return None
    print_each("note", [f"no --target: {own}, which the run wrote beside {faces.name}"])
    return own


def _serve(setting: tuple, source: int | str | None, host: str, port: int, limits: dict, as_json: bool) -> None:
    from stcal.cli.terminal import wait_for_others, write_out
    from stcal.io.device import pictures_of
    from stcal.sfm.measurement.live import LiveService, line_of, served
    from stcal.sfm.measurement.measure_images import Tracker

    service = LiveService(Tracker(*setting), source is not None, **limits)
    shown = nullcontext(iter(())) if source is None else pictures_of(source)
    with shown as frames, served(service, host, port) as url:
        if not url.startswith(("http://127.", "http://[::1]")):
            who = "every machine that knows the token"
            print_each("warning", [f"{who} can send images and see what is shown; nothing is encrypted"])
        if source is None:
            say(f"answering POST {url}/pose, files up to {limits['max_megabytes']:g} MB")
        else:
            say(f"showing {url}/ until {'it ends' if isinstance(source, str) else 'Ctrl-C'}")
        sys.stdout.flush()
        wait_for_others()
        if source is None:
            threading.Event().wait()
        first = next(frames)
        target, camera, *others = setting
        tracker = Tracker(target, camera.of_video(*first.shape[::-1]), *others)
        said_s = -SAY_EVERY_S
        for picture in service.follow(chain([first], frames), tracker):
            if as_json:
                write_out(f"{json.dumps(picture, ensure_ascii=False, allow_nan=False)}\n")
            if time.monotonic() - said_s >= SAY_EVERY_S:
                said_s = time.monotonic()
                say(line_of(picture))
                sys.stdout.flush()
        say(f"ended after {picture['picture']} pictures")
