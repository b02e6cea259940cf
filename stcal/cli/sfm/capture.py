"""Commands ``stcal-sfm plan``, ``advise``, ``watch`` and ``capture``: photographs before, during and after a run."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stcal.cli import options as shared
from stcal.cli.options import Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, say, write_if
from stcal.errors import InputError

if TYPE_CHECKING:
    from stcal.workflows.growing import Update

app = typer.Typer()


@app.command()
def plan(
    images: Annotated[int, "Plan this many images in each group.", Opt(min=2, max=500)] = 10,
    spread: Annotated[float, "Spread the views by ± this, degrees.", Opt(min=2, max=80)] = 40.0,
    distance: shared.Distance = 1000.0,
    width: Annotated[
        int, "Take images of this width, px, in the ratio 3:2, with a 24 mm lens.", Opt(min=320, max=100_000)
    ] = 5184,
    camera: Annotated[Path | None, "Read the camera from this file, in place of --width."] = None,
    noise: Annotated[float | None, "Assume this σ of every centre, px.", Opt(min=1e-5, max=10)] = None,
    run: Annotated[Path | None, "Take the σ of the centres from the finished run in this folder."] = None,
    target: shared.TargetFile = None,
    faces: Annotated[Path | None, "Place the faces of --target as in the faces.json of an earlier run."] = None,
    board: shared.BoardFile = None,
    groups: Annotated[
        str | None, "Photograph these pairs of faces together, such as 12,14,15,23 or front-right,front-top."
    ] = None,
    refine_camera: Annotated[bool, "Adjust the intrinsics too."] = False,
    one_board: Annotated[
        bool, "Use one plate in all groups, instead of a new print for each.", Opt("--one-board/--own-boards")
    ] = True,
    seed: Annotated[int, "Place board and cameras at random with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    margin: shared.PlateMargin = 15.0,
    out: shared.JsonFile = None,
) -> None:
    """Forecast the σ before any photograph is taken, without Monte Carlo, and say what would help most."""
    from stcal.boards.target import body_of
    from stcal.io.cameras.read import read_camera
    from stcal.io.design import load_board
    from stcal.sfm.planning.advise import expected_noise, failures_of, noise_of_run, stated_noise
    from stcal.sfm.planning.bodies import plan as planned
    from stcal.sfm.planning.file import PlanFile, plan_text
    from stcal.sfm.planning.session import PlanOptions, pairs_of_faces
    from stcal.sfm.runs.options import RunOptions
    from stcal.sfm.runs.saved import load_run

    design = body_of(target)
    printed = bool(design.with_faces(printed=True).faces)
    if printed and (unfit := [name for name, value in {"--groups": groups, "--board": board}.items() if value]):
        raise InputError(
            "E-OPTION-CONFLICT", f"{unfit[0]}: not for a body with boards or tags on its faces; leave it out"
        )
    if noise is not None and run is not None:
        raise InputError(
            "E-OPTION-CONFLICT", f"--noise {noise:g} and --run {run}: both give the σ of centres; give one of them"
        )
    if noise is not None:
        centre_noise, source = stated_noise(noise)
    elif run is not None:
        saved = load_run(run)
        centre_noise, source = noise_of_run(saved), f"by size and tilt as in {run}"
        if failures := failures_of(saved):
            print_each("warning", [f"{failures}: the σ of its centres have in them what failed"])
    else:
        centre_noise, source = expected_noise(of_corners=printed)
        source = f"{source} (--noise, --run)"
    options = PlanOptions(
        images,
        spread,
        distance,
        width,
        read_camera(camera) if camera else None,
        pairs_of_faces(groups, design) if groups else None,
        centre_noise,
        one_board,
        RunOptions(refine_camera=refine_camera),
        seed,
        margin,
    )
    with shared.designs_told(target, board):
        result = planned(options, design, load_board(board) if board else None, faces)
    say(plan_text(result, source))
    write_if(out, lambda: PlanFile.of_plan(result), "as JSON")


@app.command()
def advise(
    run: shared.Run,
    count: Annotated[int, "Advise this many views.", Opt(min=1, max=50)] = 5,
    out: shared.JsonFile = None,
) -> None:
    """Compute which further photographs would lower the σ of the worst face of a run most."""
    shared.load_ahead(None)
    from stcal.sfm.planning.advise import advise as advice_for
    from stcal.sfm.planning.advise import doubts, known_of
    from stcal.sfm.planning.file import AdviceFile, advice_text
    from stcal.sfm.runs.saved import load_run

    saved = load_run(run)
    if doubt := doubts(saved):
        print_each("warning", [doubt])
    geometry = known_of(saved)
    with StageProgress() as progress:
        advice = advice_for(geometry, count, progress)
    say(advice_text(advice))
    write_if(out, lambda: AdviceFile.of_advice(advice), "as JSON")


@app.command()
def watch(
    images: Annotated[
        Path,
        "Follow the photographs that come into this folder, IMAGES/<group>/*.jpg, png, tif, bmp; it may be empty "
        "at first.",
        Arg(),
    ],
    camera: shared.CameraFile,
    out: Annotated[Path, "Write the run to this folder, which must be new, empty, or of an earlier run."],
    target: shared.TargetFile = None,
    board: shared.BoardFile = None,
    interval: Annotated[
        float,
        "Look at the folder at this interval, s; a file is read once it no longer changes.",
        Opt(min=0.1, max=3600),
    ] = 1.0,
    idle: Annotated[
        float | None, "End when no file has come for this time, s; if not given, at Ctrl-C.", Opt(min=0.1, max=1e6)
    ] = None,
    views: Annotated[int, "Compute this many views that would help; 0 for none.", Opt(min=0, max=50)] = 1,
    refine_camera: Annotated[bool, "Adjust the intrinsics too."] = False,
    min_diameter: shared.MinDiameter = None,
    max_diameter: shared.MaxDiameter = 450.0,
    workers: shared.Workers = None,
) -> None:
    """Calibrate while photographs are taken. After each, print what was found, the worst σ so far and the view that
    would help most. RUN/report.html is kept up to date and reloads itself."""
    shared.load_ahead(workers)
    from stcal.sfm.runs.options import RunOptions
    from stcal.workflows.growing import WatchOptions
    from stcal.workflows.growing import watch as updates

    run_options = RunOptions(
        refine_camera=refine_camera, ellipses=shared.ellipse_options(min_diameter, max_diameter), workers=workers
    )
    options = WatchOptions(interval, idle, views, run_options)
    say(f"watching {images}; report: {out / 'report.html'}")
    sys.stdout.flush()
    with shared.designs_told(target, board):
        for update in updates(images, camera, out, target, board, options):
            _say_update(update)


def _say_update(update: "Update") -> None:
    """Prints the circles found in new photographs, σ so far, and the view that would help most."""
    from stcal.sfm.planning.file import next_text
    from stcal.sfm.runs.text import found_lines, so_far_text

    print_each("gone", update.gone)
    for line in found_lines(update.new, update.blur_px):
        say(line)
    print_each("left out", (f"{each.name}: {each.reason}" for each in update.left_out))
    if update.result is not None:
        say(so_far_text(update.result))
    if update.advice is not None:
        say(f"next: {next_text(update.advice)}")
    elif update.reason:
        say(f"{'not yet' if update.result is None else 'no advice'}: {update.reason}")
    sys.stdout.flush()


@app.command()
def capture(
    images: Annotated[
        Path, "Write photographs to this folder, IMAGES/<group>/IMG_0001.png; earlier ones are kept.", Arg()
    ],
    camera: shared.CameraFile,
    out: Annotated[Path, "Write the run to this folder: new, empty, or of an earlier run."],
    group: Annotated[str, "Name the group like this; only the camera may move between its photographs."],
    target: shared.TargetFile = None,
    board: shared.BoardFile = None,
    device: shared.Device = "0",
    exposure: Annotated[
        float | None,
        "Set this exposure, in the driver's unit; if not given, the camera chooses it.",
        Opt(min=1e-9, max=1e9),
    ] = None,
    gain: shared.Gain = None,
    settle: Annotated[
        float, "Give the camera this time before each photograph, s.", Opt("--settle-s", min=0, max=60)
    ] = 0.3,
    count: Annotated[
        int | None, "End after this many photographs; if not given, at Ctrl-C or Ctrl-D.", Opt(min=1, max=100_000)
    ] = None,
    every: Annotated[
        float | None, "Take a photograph at this interval, s; if not given, at each Enter.", Opt(min=0, max=86_400)
    ] = None,
    simulate: Annotated[
        Path | None, "Use a simulated camera that shows this image, or those of this folder, in place of --device."
    ] = None,
    views: Annotated[int, "Compute so many views that would help; 0 for none.", Opt(min=0, max=50)] = 1,
    refine_camera: Annotated[bool, "Adjust the intrinsics too."] = False,
    min_diameter: shared.MinDiameter = None,
    max_diameter: shared.MaxDiameter = 450.0,
    workers: shared.Workers = None,
) -> None:
    """Take photographs with a camera of this machine and calibrate meanwhile. After each, print what was found, blur,
    saturation, the worst σ so far and the view that would help most."""
    shared.load_ahead(workers)
    from stcal.io.device import OpenCVSource, SimulatedSource
    from stcal.sfm.runs.options import RunOptions
    from stcal.workflows.growing import GrowingRun, Trigger, WatchOptions
    from stcal.workflows.growing import capture as captured

    run_options = RunOptions(
        refine_camera=refine_camera, ellipses=shared.ellipse_options(min_diameter, max_diameter), workers=workers
    )
    growing = GrowingRun.of(images, camera, out, target, board, WatchOptions(views=views, run=run_options))
    source = SimulatedSource(simulate, gain) if simulate else OpenCVSource(device, gain, exposure is not None)
    trigger = Trigger(count, every, sys.stdin, lambda text: (say(text), sys.stdout.flush()))
    try:
        say(f"{source.name}; report: {out / 'report.html'}")
        with shared.designs_told(target, board):
            for photo in captured(source, growing, group, trigger.ready, exposure, settle):
                say(f"taken {photo.name}: {photo.light()}")
                _say_update(photo.update)
    finally:
        source.close()
