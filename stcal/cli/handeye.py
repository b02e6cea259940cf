"""``stcal handeye``: where the camera sits on the robot's flange, or beside the robot, and how well that is known."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stcal.cli.progress import StageProgress
from stcal.cli.saving import keep_apart, save, save_json
from stcal.errors import DegenerateError, InputError, StcalError

if TYPE_CHECKING:
    from stcal.handeye import HandEyeOptions, HandEyePoses, Views
    from stcal.handeye.report.file import Outcome
    from stcal.io.camera import CameraPrior

ALL = "all"
SCALED = ("pose", "reprojection")
"""Methods that can find the board's size."""


class SetupName(StrEnum):
    """What carries the camera."""

    in_hand = "eye-in-hand"
    to_hand = "eye-to-hand"


def handeye(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="POSES.csv|IMAGES",
            help="Pose pairs: base_from_flange_… and camera_from_board_… (CSV); or a folder of images of a board.",
        ),
    ],
    poses: Annotated[
        Path | None, typer.Option("--poses", help="With images: column image and base_from_flange_… (CSV).")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option("--camera", help="With images: intrinsics, COLMAP cameras.txt, OpenCV or ROS file.")
    ] = None,
    board: Annotated[
        Path | None, typer.Option("--board", help="With images: circles, chessboard, ChArUco board or tags (TOML).")
    ] = None,
    setup: Annotated[
        SetupName, typer.Option(help="eye-in-hand: camera on the flange; eye-to-hand: board on the flange.")
    ] = SetupName.in_hand,
    method: Annotated[
        str | None,
        typer.Option(help="Name of a method, or all to compare them; reprojection for images, pose for poses."),
    ] = None,
    sigma_robot_mm: Annotated[
        float | None, typer.Option("--sigma-robot-mm", min=0, help="σ of the flange's position; goes with -deg.")
    ] = None,
    sigma_robot_deg: Annotated[
        float | None,
        typer.Option("--sigma-robot-deg", min=0, help="σ of its rotation; estimated if not given."),
    ] = None,
    sigma_camera_mm: Annotated[
        float | None, typer.Option("--sigma-camera-mm", min=0, help="σ of the board's position; goes with -deg.")
    ] = None,
    sigma_camera_deg: Annotated[
        float | None, typer.Option("--sigma-camera-deg", min=0, help="σ of its rotation.")
    ] = None,
    sigma_px: Annotated[
        float | None,
        typer.Option("--sigma-px", min=1e-9, help="σ of a corner; of dots and tags, in units of their own σ."),
    ] = None,
    sigma_board_mm: Annotated[
        float | None, typer.Option("--sigma-board-mm", min=0, help="σ of a corner's place on the board; 0: exact.")
    ] = None,
    refine_camera: Annotated[
        bool, typer.Option("--refine-camera", help="Adjust the intrinsics too, from the given ones with their σ.")
    ] = False,
    with_scale: Annotated[
        bool, typer.Option("--with-scale", help="Find the board's true size from the robot's motion.")
    ] = False,
    four_dof: Annotated[
        bool,
        typer.Option("--four-dof", help="The flange turns about one axis only (SCARA): solve for what is known."),
    ] = False,
    held_out: Annotated[
        int | None, typer.Option("--held-out", min=1, help="Poses held out in each split; a quarter if not given.")
    ] = None,
    splits: Annotated[int, typer.Option("--splits", min=0, help="Of the cross-validation; 0 for none.")] = 15,
    seed: Annotated[int, typer.Option(min=0, help="Of the splits.")] = 0,
    out: Annotated[Path | None, typer.Option("--out", help="The result (JSON).")] = None,
    ros: Annotated[Path | None, typer.Option("--ros", help="Static transform of ROS (YAML, metres).")] = None,
    urdf: Annotated[Path | None, typer.Option("--urdf", help="Fixed joint with its origin (URDF, metres).")] = None,
    opencv: Annotated[Path | None, typer.Option("--opencv", help="OpenCV's FileStorage (YAML, mm).")] = None,
    parent: Annotated[str, typer.Option(help="Name of the flange or base in ROS and URDF.")] = "",
    child: Annotated[str, typer.Option(help="Name of the camera in ROS and URDF.")] = "",
    camera_out: Annotated[
        Path | None, typer.Option("--camera-out", help="With --refine-camera: the camera with σ (cameras.txt).")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="All of it: every split and method too.")] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Also write a page with tables and plots.")] = None,
) -> None:
    """Hand-eye calibration: where a camera sits on a robot's flange, or in its base, and how well that is known."""
    from stcal.handeye import METHODS, HandEyeOptions, Noise
    from stcal.handeye.report.export import opencv_yaml, ros_yaml, urdf_joint
    from stcal.handeye.report.file import calibration_json, outcome_json
    from stcal.handeye.report.page import outcome_page, outcome_text

    robot, seen = (_radians(sigma_robot_deg), sigma_robot_mm), (_radians(sigma_camera_deg), sigma_camera_mm)
    noise = Noise(*robot, *seen, sigma_px, sigma_board_mm)
    outputs = {"--out": out, "--ros": ros, "--urdf": urdf, "--opencv": opencv, "--camera-out": camera_out}
    keep_apart(outputs | {"--json": json_file, "--report": report}, (source, poses, camera, board))
    if camera_out and not refine_camera:
        raise InputError("--camera-out: only with --refine-camera; the camera is as given else")
    if refine_camera and source.is_file():
        raise InputError("--refine-camera: only with images; poses tell nothing of the camera")
    if camera_out and method not in (None, ALL, "reprojection"):
        raise InputError(f"--camera-out: {method} does not adjust the camera; leave --method out")
    if method not in (None, ALL, *METHODS):
        raise InputError(f"--method {method}: unknown; {ALL} or one of {', '.join(METHODS)} needed")
    if (parent or child) and not (ros or urdf):
        raise InputError("--parent, --child: only with --ros or --urdf, whose frames they name")
    if source.is_file() and (sigma_px is not None or sigma_board_mm is not None):
        raise InputError(
            "--sigma-px, --sigma-board-mm: only with images; give --sigma-camera-mm and --sigma-camera-deg"
        )
    if source.is_dir() and sigma_camera_mm is not None:
        raise InputError("--sigma-camera-mm, --sigma-camera-deg: only with poses; with images give --sigma-px")
    given = _given(source, poses, camera, board, workers)
    prior = given.prior if refine_camera else None
    options = HandEyeOptions(noise, prior, with_scale, given.symmetries, four_dof)
    try:
        outcome = _solved(given, setup.value, method, options, _Splits(splits, held_out, seed, workers))
    except StcalError as error:
        if not given.left_out:
            raise
        name, reason = given.left_out[0]
        raise type(error)(f"{error}; {len(given.left_out)} left out before, first {name}: {reason}") from error
    print(outcome_text(outcome))
    for option, given_, able in (("--with-scale", with_scale, SCALED), ("--refine-camera", refine_camera, SCALED[1:])):
        if given_ and outcome.result.method not in able:
            print(f"note: {option} does nothing for {outcome.result.method}, only for {' and '.join(able)}")
    for name, reason in outcome.left_out:
        print(f"left out {name}: {reason}")
    for note in outcome.all_notes():
        print(f"note: {note}")
    result = outcome.result
    if out:
        save_json(out, calibration_json(outcome))
    for path, content in (
        (ros, lambda: ros_yaml(result, parent, child)),
        (urdf, lambda: urdf_joint(result, parent, child)),
        (opencv, lambda: opencv_yaml(result)),
        (report, lambda: outcome_page(outcome)),
    ):
        if path:
            save(path, content())
    if camera_out:
        _save_camera(camera_out, outcome)
    save_json(json_file, outcome_json(outcome))


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """The input: ``pitch_mm`` of the board's file; ``left_out`` : images and rows, and why."""

    where: str
    pairs: "HandEyePoses"
    views: "Views | None" = None
    symmetries: tuple = ()
    prior: "CameraPrior | None" = None
    pitch_mm: float | None = None
    left_out: tuple[tuple[str, str], ...] = ()


def _given(source: Path, poses: Path | None, camera: Path | None, board: Path | None, workers: int | None) -> _Given:
    from stcal.handeye import read_poses

    images = {"--poses": poses, "--camera": camera, "--board": board}
    if source.is_dir():
        missing = [name for name, path in images.items() if path is None]
        if missing:
            raise InputError(f"image folder {source}: {', '.join(missing)} needed with images")
        return _from_images(source, poses, camera, board, workers)
    if not source.exists():
        raise InputError(f"{source}: does not exist; a file of poses (CSV) or a folder of images needed")
    extra = [name for name, path in images.items() if path is not None]
    if extra:
        raise InputError(f"{', '.join(extra)}: only with a folder of images; {source} is a file of poses")
    return _Given(source.name, read_poses(source))


def _from_images(source: Path, poses: Path, camera: Path, board: Path, workers: int | None) -> _Given:
    """Corners of the board in all images that have a pose."""
    from stcal.boards.file import load_flat_board
    from stcal.handeye import View, Views, pairs_of_views
    from stcal.handeye.data.robot_poses import read_robot_poses
    from stcal.io.camera import camera_prior, read_camera, refinable
    from stcal.io.images import find_images
    from stcal.workflows.board_views import look

    design, model, robot = load_flat_board(board), read_camera(camera), read_robot_poses(poses)
    files, skipped = find_images(source)
    rows, missing = robot.rows([file.name for file in files])
    if not rows:
        raise InputError(
            f"{robot.where}: no row is of an image in {source}: {robot.images[0]} … there, {files[0].name} … here; "
            "correct them"
        )
    with StageProgress() as progress:
        with_pose = [file for file in files if file.name in rows]
        sights = look(with_pose, model, design, (), workers, lambda done, total: progress("board", done, total))
    views = sights.views()
    left_out = [(each.name, each.reason) for each in (*skipped, *sights.skipped)]
    left_out += [(file.name, f"no row in {poses.name}") for file in files if file.name not in rows]
    left_out += [(name, f"no such image, in a row of {poses.name}") for name in missing]
    if not views:
        raise InputError(f"image folder {source}: the board is in none of {len(with_pose)} images: {_first(sights)}")
    seen = Views(sights.camera, tuple(View(v.xyz_board, v.xy_px, v.covariance_px2) for v in views.values()))
    at = [rows[name] for name in views]
    pairs = pairs_of_views(robot.base_from_flange[at], seen, tuple(views), str(source))
    if robot.covariance is not None:
        pairs = replace(pairs, base_from_flange_covariance=robot.covariance[at])
    pitch = getattr(design, "pitch_mm", getattr(design, "square_mm", None))
    prior = camera_prior(refinable(model), sights.camera)
    where = f"{source.name}, {poses.name}"
    return _Given(where, pairs, seen, sights.symmetries, prior, pitch, tuple(left_out))


def _first(sights) -> str:
    return f"{sights.skipped[0].name}: {sights.skipped[0].reason}"


@dataclass(frozen=True, slots=True)
class _Splits:
    """Of the cross-validation: how many, poses in each (a quarter if None), which, and processes for it."""

    repeats: int
    held_out: int | None
    seed: int
    workers: int | None


def _solved(given: _Given, setup: str, method: str | None, options: "HandEyeOptions", validation: _Splits) -> "Outcome":
    """The result, its errors on poses held out, and the comparison of methods where it is asked for."""
    from stcal.handeye import handeye as solve
    from stcal.handeye.report.file import Outcome
    from stcal.handeye.validate import LEAST_LEFT, compare, cross_validate, splits

    pairs, views = given.pairs, given.views
    chosen = None if method == ALL else method
    result = solve(pairs, setup, chosen, views, options)
    compared, held_out, notes, rows = (), None, (), ()
    if validation.repeats and (validation.held_out or len(pairs) > LEAST_LEFT):
        rows = splits(len(pairs), validation.held_out, validation.repeats, validation.seed)
    if method == ALL:
        with StageProgress() as progress:
            tell = partial(progress, "methods")
            compared = compare(pairs, setup, views, options, rows=rows, workers=validation.workers, progress=tell)
        held_out = next(each.held_out for each in compared if each.method == result.method)
    elif len(rows):
        try:
            with StageProgress() as progress:
                tell = partial(progress, "held out")
                held_out = cross_validate(pairs, setup, chosen, views, options, rows, validation.workers, tell)
        except DegenerateError as error:
            notes = (f"no errors on poses held out: {error}",)
    model = options.intrinsics.colmap_model if options.intrinsics else ""
    own = views is not None and all(view.covariance is not None for view in views.views)
    return Outcome(given.where, result, held_out, compared, given.pitch_mm, model, own, given.left_out, notes)


def _save_camera(path: Path, outcome: "Outcome") -> None:
    from stcal.io.camera import write_cameras_txt

    found = outcome.result.reprojection
    path.parent.mkdir(parents=True, exist_ok=True)
    write_cameras_txt(path, found.camera, outcome.colmap_model, found.camera_covariance)
    print(f"written: {path}")


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)
