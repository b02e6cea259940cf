"""``stcal locate``: a planar target of several tags, calibrated, found under any light, and judged."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stcal.cli.saving import keep_apart, save, save_json
from stcal.errors import InputError

if TYPE_CHECKING:
    from stcal.io.camera import CameraModel
    from stcal.locate.data.views import CalibrationImages
    from stcal.workflows.board_views import Board

app = typer.Typer(
    name="stcal locate",
    help="Find a planar target of several tags under any light, with a verdict whether its pose may be trusted.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

CameraFile = Annotated[Path, typer.Option("--camera", help="Intrinsics: COLMAP cameras.txt, OpenCV or ROS file.")]
LayoutFile = Annotated[Path, typer.Option("--layout", help="The target's tags (TOML).")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Also write everything as JSON.")]
ReportFile = Annotated[Path | None, typer.Option("--report", help="Also write a page with tables and pictures (HTML).")]
NOTHING_ACCEPTED = 3


class MethodName(StrEnum):
    """How the pose is found and judged."""

    joint = "joint"
    patent = "patent"


@app.command()
def schedule(
    shortest: Annotated[float, typer.Argument(help="Shortest exposure time, in any unit.")],
    longest: Annotated[float, typer.Argument(help="Longest.")],
    count: Annotated[int, typer.Argument(min=1, max=1000, help="How many.")],
) -> None:
    """Exposure times in a geometric series."""
    from stcal.locate.data.exposures import exposure_times

    for time in exposure_times(shortest, longest, count):
        print(f"{time:.6g}")


@app.command()
def calibrate(
    images: Annotated[Path, typer.Argument(help="Photographs of the target with a board in the same plane.")],
    camera: CameraFile,
    board: Annotated[Path, typer.Option("--board", help="Dots, chessboard, ChArUco or tags (TOML).")],
    layout: LayoutFile,
    out: Annotated[Path, typer.Option("--out", help="The calibrated layout (TOML).")] = Path("calibrated.toml"),
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Where the corners of the target's tags lie, with σ; the frame in the middle of the layout's origin tag."""
    from stcal.boards.file import load_flat_board
    from stcal.cli.progress import StageProgress
    from stcal.io.camera import read_camera
    from stcal.locate.calibrate.solve import calibrate as calibrated
    from stcal.locate.data.layout import layout_toml, load_plan
    from stcal.locate.report.calibration import calibrated_json, calibrated_text, warnings

    keep_apart({"--out": out, "--json": json_file}, (layout, board, camera))
    plan, design, model = load_plan(layout), load_flat_board(board), read_camera(camera)
    dictionaries = tuple(dict.fromkeys(dictionary for dictionary, _ in plan.tags))
    with StageProgress() as progress:
        found = calibration_images(images, model, design, dictionaries, workers, progress)
    result = calibrated(plan, found.views, found.tags, found.names, found.camera, found.symmetries)
    print(calibrated_text(result))
    for each in (*found.left_out, *result.left_out):
        print(f"left out: {each}")
    for warning in warnings(result, plan.tags):
        print(f"warning: {warning}")
    save(out, layout_toml(result.layout, [f"Calibrated by stcal locate from {len(result.images)} images."]))
    if json_file:
        save_json(json_file, calibrated_json(result))


@app.command()
def run(
    exposures: Annotated[
        Path, typer.Argument(help="One image; a folder of exposures of one scene; or a folder of such folders.")
    ],
    layout: LayoutFile,
    camera: CameraFile,
    out: Annotated[Path | None, typer.Option("--out", help="Accepted poses (CSV).")] = None,
    method: Annotated[MethodName, typer.Option(help="joint: all exposures together; patent: as published.")] = (
        MethodName.joint
    ),
    hand_eye: Annotated[
        Path | None, typer.Option("--hand-eye", help="JSON of `stcal handeye`: poses in the robot's base too.")
    ] = None,
    robot_poses: Annotated[
        Path | None, typer.Option("--robot-poses", help="base_from_flange of each scene (CSV with a column scene).")
    ] = None,
    offset: Annotated[
        Path | None, typer.Option("--offset", help="JSON with obj_from_goal, 4×4: where to go, in the target's frame.")
    ] = None,
    min_tags: Annotated[int, typer.Option(min=1, help="Tags needed.")] = 1,
    min_spread_px: Annotated[float, typer.Option("--min-spread-px", min=0, help="Extent of their corners.")] = 12.0,
    min_foreshortening: Annotated[
        float, typer.Option(min=0, max=1, help="Cosine between target's normal and line of sight: det J without scale.")
    ] = 0.17,
    max_p: Annotated[float, typer.Option(help="Odds of residuals as large, from which on a pose is rejected.")] = 1e-4,
    flip_odds: Annotated[float, typer.Option(help="Odds of the other pose that are allowed.")] = 1e-6,
    sigma_margin: Annotated[float, typer.Option(min=1, help="By which all σ may be too small.")] = 1.5,
    equal_deg: Annotated[float, typer.Option("--equal-deg", min=0, help="Two poses nearer than this are one.")] = 1.0,
    max_sigma_deg: Annotated[float, typer.Option("--max-sigma-deg", help="Largest σ of the rotation.")] = 2.0,
    max_sigma_mm: Annotated[
        float | None, typer.Option("--max-sigma-mm", help="Largest σ of the position; any if not given.")
    ] = None,
    moved_px: Annotated[
        float, typer.Option("--moved-px", help="Tags that shift by more between exposures have moved.")
    ] = 0.5,
    s_dis: Annotated[float, typer.Option("--s-dis", help="The patent's share of the largest area.")] = 0.8,
    j_lim: Annotated[float, typer.Option("--j-lim", help="The patent's limit of det J, 1/mm².")] = 1e-8,
    e_lim_px: Annotated[float, typer.Option("--e-lim-px", help="The patent's limit of the error.")] = 1.0,
    e_ratio: Annotated[float, typer.Option("--e-ratio", help="The patent's limit of the errors' ratio.")] = 2.0,
    workers: Annotated[int | None, typer.Option(min=1, help="Threads; as many as cores if not given.")] = None,
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Pose of the target in each scene, with its 6×6 covariance, and accept, ambiguous or reject.

    Exit code 3 when no pose is accepted.
    """
    from stcal.io.camera import read_camera
    from stcal.locate.data.exposures import find_scenes
    from stcal.locate.data.layout import load_layout
    from stcal.locate.pipeline import LocateOptions
    from stcal.locate.pipeline import run as located
    from stcal.locate.pose.patent import PatentOptions
    from stcal.locate.pose.verdict import VerdictOptions
    from stcal.locate.report.chain import read_chain
    from stcal.locate.report.tables import accepted, poses_csv, run_json, run_text

    inputs = (layout, camera, hand_eye, robot_poses, offset)
    keep_apart({"--out": out, "--json": json_file, "--report": report}, inputs)
    if hand_eye is None and (robot_poses or offset):
        raise InputError("--robot-poses, --offset: only with --hand-eye, which leads from the camera to the robot")
    chain = read_chain(hand_eye, robot_poses, offset) if hand_eye else None
    target, model = load_layout(layout), read_camera(camera)
    limits = VerdictOptions(
        min_tags,
        min_spread_px,
        min_foreshortening,
        max_p,
        flip_odds,
        sigma_margin,
        equal_deg,
        max_sigma_deg,
        max_sigma_mm,
    )
    patent = PatentOptions(s_dis, j_lim, e_lim_px, e_ratio)
    scenes = find_scenes(exposures)
    missing = chain.without_pose([scene.name for scene in scenes]) if chain else []
    if missing:
        raise InputError(f"robot poses {robot_poses}: none of scene {missing[0]}; add a row, or take the scene away")
    results = list(located(scenes, target, model, LocateOptions(method.value, limits, patent, moved_px, workers)))
    print(run_text(results, chain))
    for scene in scenes:
        for each in scene.skipped:
            print(f"not used: {each}")
    if out:
        save(out, poses_csv(results, chain))
    if json_file:
        save_json(json_file, run_json(results, target, chain))
    if report:
        from stcal.locate.report.page import run_page

        save(report, run_page(results, scenes, target, model, chain))
    if not accepted(results):
        print(f"no pose accepted in {len(results)} scene{'s' * (len(results) > 1)}")
        raise typer.Exit(NOTHING_ACCEPTED)


def calibration_images(
    folder: Path, model: "CameraModel", board: "Board", dictionaries: tuple[str, ...], workers: int | None, progress
) -> "CalibrationImages":
    """Board and tags in all images of a folder; ``progress`` is told (stage, done, total)."""
    from stcal.io.images import find_images
    from stcal.locate.data.views import CalibrationImages
    from stcal.workflows.board_views import look

    files, skipped = find_images(folder)
    sights = look(files, model, board, dictionaries, workers, lambda done, total: progress("images", done, total))
    names, views, tags = zip(*((sight.name, sight.view, sight.tags) for sight in sights.images), strict=True)
    left_out = tuple(f"{each.name}: {each.reason}" for each in (*skipped, *sights.skipped) if each.name not in names)
    return CalibrationImages(names, views, tags, sights.camera, sights.symmetries, left_out)
