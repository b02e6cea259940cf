"""Commands ``stcal-sfm plan`` and ``advise``: photographs before and after a run."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli import options as shared
from stcal.cli.options import Opt
from stcal.cli.terminal import StageProgress, print_each, printed_last, say, write_if
from stcal.errors import InputError

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
    from stcal.sfm.planning.advise import expected_noise, failures_of, noise_of_run
    from stcal.sfm.planning.forecast import CentreNoise
    from stcal.sfm.planning.plan_report import PlanFile, plan_text
    from stcal.sfm.planning.session import PlanOptions, pairs_of_faces
    from stcal.sfm.planning.session import plan as planned
    from stcal.sfm.runs.options import RunOptions
    from stcal.sfm.runs.saved import load_run

    design = body_of(target)
    if noise is not None and run is not None:
        raise InputError(
            "E-OPTION-CONFLICT", f"--noise {noise:g} and --run {run}: both give the σ of centres; give one of them"
        )
    if noise is not None:
        centre_noise = CentreNoise(0.0, floor_px=noise, corner_px=noise)
        source = "--noise, whatever the size of a circle"
    elif run is not None:
        saved = load_run(run)
        centre_noise, source = noise_of_run(saved), f"by size and tilt as in {run}"
        if failures := failures_of(saved):
            print_each("warning", [f"{failures}: the σ of its centres have in them what failed"])
    else:
        centre_noise, source = expected_noise(of_corners=bool(design.with_faces(printed=True).faces))
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
    with printed_last():
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
    from stcal.sfm.planning.plan_report import AdviceFile, advice_text
    from stcal.sfm.runs.saved import load_run

    saved = load_run(run)
    if doubt := doubts(saved):
        print_each("warning", [doubt])
    geometry = known_of(saved)
    with StageProgress() as progress:
        advice = advice_for(geometry, count, progress)
    with printed_last():
        say(advice_text(advice))
        write_if(out, lambda: AdviceFile.of_advice(advice), "as JSON")
