"""Commands ``stcal locate``: a planar target of several tags is calibrated, located under any light, and judged."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from stcal.cli import options as shared
from stcal.cli.help import group
from stcal.cli.options import WRITES, Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, say, warn_if_quiet, write, write_if

app = group(
    "stcal locate", "Find a planar target of several tags in any light, and judge whether its pose may be trusted."
)
NOTHING_ACCEPTED = 3


@app.command()
def schedule(
    shortest: Annotated[float, "Start with this exposure time, in any unit.", Arg()],
    longest: Annotated[float, "End with this exposure time, in the same unit.", Arg()],
    count: Annotated[int, "Print this many exposure times.", Arg(min=1, max=1000)],
) -> None:
    """Print exposure times in a geometric series."""
    from stcal.locate.scenes import exposure_times

    for time in exposure_times(shortest, longest, count):
        say(f"{time:.6g}")


@app.command()
def capture(
    out: Annotated[Path, "Write the scene's folder of images below this folder.", Arg("SCENES")] = Path("scenes"),
    scene: Annotated[str, "Name the scene like this; its folder must not exist."] = "scene-1",
    device: shared.Device = "0",
    shortest: Annotated[
        float, "Start with this exposure, in the driver's unit; V4L2: 100 µs.", Opt(min=1e-9, max=1e9)
    ] = 10.0,
    longest: Annotated[float, "End with this exposure, in the driver's unit.", Opt(min=1e-9, max=1e9)] = 1000.0,
    count: Annotated[int, "Take this many exposures, in a geometric series.", Opt(min=1, max=1000)] = 5,
    gain: shared.Gain = None,
    settle: Annotated[float, "Give the camera this time after each change, s.", Opt("--settle-s", min=0, max=60)] = 0.3,
    simulate: Annotated[
        Path | None, "Use a simulated camera that shows this image at exposure 1, in place of --device."
    ] = None,
) -> None:
    """Take an exposure series with a camera of this machine, for run: SCENES/<scene>/<exposure>.png."""
    from stcal.io.device import OpenCVSource, SimulatedSource
    from stcal.locate.scenes import capture, exposure_times, scene_folder

    folder = scene_folder(out, scene)
    exposures = exposure_times(shortest, longest, count)
    source = OpenCVSource(device, gain) if simulate is None else SimulatedSource(simulate, gain)
    try:
        say(f"{source.name}: {count} exposures")
        capture(
            source,
            exposures.tolist(),
            folder,
            gain,
            settle,
            lambda row: say(
                f"  {row.image}: exposure {row.exposure_set:g} set for {row.exposure:g}, "
                f"{100 * row.saturated_share:.1f} % saturated, {100 * row.dark_share:.1f} % dark"
            ),
        )
    finally:
        source.close()
    say(f"scene: {folder}")


@app.command()
def calibrate(
    images: Annotated[Path, "Read photographs of the target with a board in the same plane from this folder.", Arg()],
    camera: shared.CameraFile,
    board: shared.FlatBoardFile,
    layout: shared.LayoutFile,
    out: Annotated[Path, "Write the calibrated layout to this file (TOML).", WRITES] = Path("calibrated.toml"),
    workers: shared.Workers = None,
    json_file: shared.JsonFile = None,
) -> None:
    """Find the corners of the target's tags, with σ, in the frame at the centre of the layout's origin tag."""
    from stcal.boards.board_file import load_flat_board
    from stcal.io.cameras.read import read_camera
    from stcal.locate.layout import layout_toml, load_plan, require_layout_written
    from stcal.locate.layout_calibration import calibrate as calibrated
    from stcal.locate.located_report import CalibratedLayoutFile, calibrated_text, warnings
    from stcal.workflows.board_views import calibration_images

    plan, design, model = load_plan(layout), load_flat_board(board), read_camera(camera)
    dictionaries = tuple(dict.fromkeys(dictionary for dictionary, _ in plan.tags))
    with StageProgress() as progress:
        observed = calibration_images(images, model, design, dictionaries, workers, progress)
    result = calibrated(plan, observed.views, observed.tags, observed.names, observed.camera, observed.symmetries)
    say(calibrated_text(result))
    print_each("left out", (*observed.left_out, *result.left_out))
    print_each("warning", warnings(result, plan.tags))
    write(out, layout_toml(result.layout, [f"Calibrated by stcal locate from {len(result.images)} images."]))
    require_layout_written(out, result.layout)
    write_if(json_file, lambda: CalibratedLayoutFile.model_validate(result))


@app.command()
def run(
    exposures: Annotated[
        Path,
        "Read one image, a folder of exposures of one scene, a folder of such folders, or a video, each sharp frame of "
        "which is a scene.",
        Arg(),
    ],
    layout: shared.LayoutFile,
    camera: shared.CameraFile,
    out: Annotated[Path | None, "Write the accepted poses to this file (CSV).", WRITES] = None,
    method: Annotated[
        Literal["joint", "patent"],
        "Use joint, all exposures together, or patent, each exposure separately as published.",
    ] = "joint",
    hand_eye: Annotated[
        Path | None, "Add poses in the robot's base, using this result of `stcal handeye` (JSON)."
    ] = None,
    robot_poses: Annotated[Path | None, "Read base_from_flange of each scene from this file (CSV)."] = None,
    key: Annotated[str, "Match scenes and rows of --robot-poses by this column."] = "scene",
    registration: Annotated[
        Path | None,
        "Add poses in the robot's base, using this result of `stcal register` (JSON), with a the camera and b the "
        "base.",
    ] = None,
    quaternions: shared.Quaternions = "wxyz",
    offset: Annotated[
        Path | None, "Add goal poses, using obj_from_goal, 4×4 in the target's frame, from this file (JSON)."
    ] = None,
    min_tags: Annotated[int, "Reject a pose from fewer tags than this.", Opt(min=1, max=10_000)] = 1,
    min_spread_px: Annotated[
        float, "Reject a pose whose corners spread over less than this, px.", Opt(min=0, max=1e5)
    ] = 12.0,
    min_foreshortening: Annotated[
        float,
        "Reject a pose if the cosine between the target's normal and the line of sight is smaller than this.",
        Opt(min=0, max=1),
    ] = 0.17,
    max_p: Annotated[float, "Reject a pose whose χ² p-value is below this."] = 1e-4,
    flip_odds: Annotated[
        float, "Call a pose ambiguous if the odds of its second solution are larger than this."
    ] = 1e-6,
    sigma_margin: Annotated[float, "Allow for all σ being too small by up to this factor.", Opt(min=1, max=1000)] = 1.5,
    equal_deg: Annotated[float, "Treat two solutions closer than this as one.", Opt(min=0, max=180)] = 1.0,
    max_sigma_deg: Annotated[float, "Reject a pose whose largest σ of rotation exceeds this."] = 2.0,
    max_sigma_mm: Annotated[
        float | None, "Reject a pose whose largest σ of position exceeds this; none by default."
    ] = None,
    moved_px: Annotated[float, "Treat a tag as moved that shifts by more than this between exposures."] = 0.5,
    s_dis: Annotated[float, "Set the patent's share of the largest area, for --method patent."] = 0.8,
    j_lim: Annotated[float, "Set the patent's limit of det J, 1/mm², for --method patent."] = 1e-8,
    e_lim_px: Annotated[float, "Set the patent's limit of the error, px, for --method patent."] = 1.0,
    e_ratio: Annotated[float, "Set the patent's limit of the errors' ratio, for --method patent."] = 2.0,
    workers: Annotated[int | None, "Use this many threads; one per core if not given.", Opt(min=1, max=1024)] = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Find the pose of the target in each scene, with its 6×6 covariance and a verdict: accept, ambiguous or reject.

    Exit code 3 when no pose is accepted.
    """
    from stcal.geometry.rigid import Poses
    from stcal.io.cameras.read import read_camera
    from stcal.io.table import require_pose_table_written
    from stcal.io.video import images_or_frames
    from stcal.locate.base_chain import goal_chain, goals
    from stcal.locate.layout import load_layout
    from stcal.locate.located_report import LocatedFile, accepted, poses_csv, run_report, uncertain
    from stcal.locate.scenes import LocateOptions, find_scenes
    from stcal.locate.scenes import run as located
    from stcal.locate.verdict import PatentOptions, VerdictOptions

    chain = None
    if hand_eye or registration or robot_poses or offset:
        given = {"robot_poses": robot_poses, "offset": offset, "key": key, "quaternions": quaternions}
        chain = goal_chain(hand_eye, registration, **given)
    target, model = load_layout(layout), read_camera(camera)
    least = min_tags, min_spread_px, min_foreshortening
    limits = VerdictOptions(*least, max_p, flip_odds, sigma_margin, equal_deg, max_sigma_deg, max_sigma_mm)
    patent = PatentOptions(s_dis, j_lim, e_lim_px, e_ratio)
    with images_or_frames(exposures) as folder:
        places = [exposures] if folder == exposures else sorted(folder.iterdir())
        scenes = [scene for place in places for scene in find_scenes(place)]
        if chain:
            chain.require_poses([scene.name for scene in scenes])
        results = list(located(scenes, target, model, LocateOptions(method, limits, patent, moved_px, workers)))
        in_base = goals(results, chain) if chain else None
        document = run_report(results, scenes, target, model, in_base)
        say(document.text())
        print_each("warning", in_base.notes if in_base else ())
        print_each("not used", (each for scene in scenes for each in scene.skipped))
        write_if(out, lambda: poses_csv(results, chain))
        if out and (poses := [uncertain(each).rigid for each in accepted(results)]):
            require_pose_table_written(out, {"": Poses.of(poses)})
        write_if(json_file, lambda: LocatedFile.of(results, target, in_base))
        write_if(report, document.page)
    if not accepted(results):
        say(verdict := f"no pose accepted in {len(results)} scene{'s' * (len(results) > 1)}")
        warn_if_quiet(verdict)
        raise typer.Exit(NOTHING_ACCEPTED)
