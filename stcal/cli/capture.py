"""``stcal-sfm plan`` and ``stcal-sfm advise``: what to photograph, before and after."""

from itertools import permutations
from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.colmap import Run
from stcal.cli.progress import StageProgress
from stcal.design import TargetDesign, reference_board, reference_target
from stcal.errors import InputError
from stcal.io.camera import read_camera
from stcal.io.design import load_board, load_target
from stcal.io.saving import json_text, save

app = typer.Typer()

JsonFile = Annotated[Path | None, typer.Option("--json", help="Also write it as JSON.")]


@app.command()
def plan(
    images: Annotated[int, typer.Option("--images", min=2, max=500, help="Images in each group.")] = 10,
    spread: Annotated[float, typer.Option(min=2, max=80, help="Spread of the views, ± degrees.")] = 40.0,
    distance: Annotated[float, typer.Option(min=50, help="Distance of the camera, mm.")] = 1000.0,
    width: Annotated[int, typer.Option(min=320, help="Image width, px; 3:2 images of a 24 mm lens.")] = 5184,
    camera: Annotated[Path | None, typer.Option("--camera", help="Camera file, in place of --width.")] = None,
    noise: Annotated[float | None, typer.Option(min=1e-5, max=10, help="σ of every centre, px.")] = None,
    run: Annotated[Path | None, typer.Option("--run", help="Finished run to take the σ of centres from.")] = None,
    target: Annotated[Path | None, typer.Option("--target", help="target.toml; the reference design if not given.")] = (
        None
    ),
    faces: Annotated[
        Path | None, typer.Option("--faces", help="faces.json of an earlier run: where the faces of --target are.")
    ] = None,
    board: Annotated[Path | None, typer.Option("--board", help="board.toml; the reference board if not given.")] = None,
    groups: Annotated[str | None, typer.Option(help="Pairs of faces to photograph together: 12,14,15,23.")] = None,
    refine_camera: Annotated[bool, typer.Option("--refine-camera", help="Intrinsics are adjusted too.")] = False,
    one_board: Annotated[
        bool, typer.Option("--one-board/--own-boards", help="One plate in all groups, or a print made anew for each.")
    ] = True,
    seed: Annotated[int, typer.Option(help="Of where board and cameras happen to stand.")] = 0,
    out: JsonFile = None,
) -> None:
    """The σ to expect before any photograph is taken, and what would help most; no Monte Carlo."""
    from stcal.sfm.plan.nominal import nominal_poses
    from stcal.sfm.plan.session import PlanOptions
    from stcal.sfm.plan.session import plan as planned
    from stcal.sfm.plan.tables import plan_json, plan_text
    from stcal.sfm.run.options import RunOptions

    design = load_target(target) if target else reference_target()
    centre_noise, told = _centre_noise(noise, run)
    options = PlanOptions(
        images,
        spread,
        distance,
        width,
        read_camera(camera) if camera else None,
        _pairs(groups, design) if groups else None,
        centre_noise,
        one_board,
        RunOptions(refine_camera=refine_camera),
        seed,
    )
    result = planned(options, design, load_board(board) if board else reference_board(), nominal_poses(design, faces))
    print(plan_text(result, told))
    _write(out, plan_json(result))


@app.command()
def advise(
    run: Run,
    count: Annotated[int, typer.Option("--count", min=1, max=50, help="Views to advise.")] = 5,
    out: JsonFile = None,
) -> None:
    """Which further photographs would lower the σ of a run's worst face most, computed from its own geometry."""
    from stcal.sfm.plan.advise import advise as advice_for
    from stcal.sfm.plan.advise import known_of
    from stcal.sfm.plan.tables import advice_json, advice_text
    from stcal.sfm.run.saved import load_run

    saved = load_run(run)
    failed = [check["title"] for check in saved.report.get("checks", ()) if check["verdict"] == "failed"]
    if not saved.options.eccentricity:
        print(f"warning: {run} is an uncorrected control, whose faces are biased by tens of µm: these σ are not theirs")
    elif failed:
        what = f"{len(failed)} checks of {run} failed, first {failed[0]}"
        print(f"warning: {what}: its faces may be off by far more than these σ")
    known = known_of(saved)
    with StageProgress() as progress:
        advice = advice_for(known, count, progress)
    print(advice_text(advice))
    _write(out, advice_json(advice))


def _centre_noise(noise: float | None, run: Path | None):
    """The σ of centres, and in words where it comes from."""
    from stcal.sfm.plan.advise import known_of
    from stcal.sfm.plan.session import forecast
    from stcal.sfm.run.saved import load_run

    if noise is not None and run is not None:
        raise InputError(f"--noise {noise:g} and --run {run}: two sources of one σ; give one of them")
    if noise is not None:
        return forecast.CentreNoise(0.0, floor_px=noise), "--noise, whatever the size of a circle"
    if run is not None:
        known = known_of(load_run(run))
        return known.noise.scaled(known.setup.sigma0), f"by size and tilt as in {run}"
    return forecast.CentreNoise.expected(), (
        f"image noise {100 * forecast.IMAGE_NOISE:g} % and contrast {100 * forecast.CONTRAST:g} % of full scale, edges "
        f"blurred by {forecast.BLUR_PX:g} px, {forecast.PRACTICE:g} × the Cramér–Rao bound (--noise, --run)"
    )


def _pairs(text: str, target: TargetDesign) -> tuple[tuple[str, str], ...]:
    """``12,14`` or ``top-left,top-right`` as pairs of face ids."""
    from stcal.synthetic.scene import group_name

    known = {group_name(pair): pair for pair in permutations([face.id for face in target.faces], 2)}
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            raise InputError(f"--groups: {name!r} is no pair of faces; use such as {', '.join(list(known)[:3])}")
    return tuple(known[name] for name in names)


def _write(out: Path | None, content: dict) -> None:
    if out is not None:
        save(out, json_text(content))
        print(f"as JSON: {out}")
