"""Commands ``stcal handeye`` and ``handeye plan``: where a camera is on or beside a robot, with σ, and which
poses of the robot to take next."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stcal.cli import options as shared
from stcal.cli.options import WRITES, Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, say, write, write_if
from stcal.errors import InputError

if TYPE_CHECKING:
    from stcal.handeye.methods.closed_form import Bounds
    from stcal.workflows.handeye_inputs import Files


@dataclass(frozen=True, slots=True)
class PoseFiles:
    """Options of the files with the poses, or photographs, and of what these do not state."""

    source: Annotated[
        Path | None,
        "Read pose pairs from this file: base_from_flange_… and camera_from_board_… (CSV, JSON, YAML, npz), or "
        "samples of easy_handeye or MoveIt; or photographs of a board from this folder.",
        Arg("POSES|IMAGES"),
    ] = None
    poses: Annotated[
        Path | None,
        "Read the robot's poses here: image, base_from_flange_… (CSV), 4×4 matrices (JSON, npz, npy) or a TUM file.",
    ] = None
    camera: Annotated[Path | None, "Read the intrinsics from this file: COLMAP cameras.txt, OpenCV or ROS."] = None
    board: Annotated[
        Path | None,
        "Read the board from this file, TOML or Kalibr's YAML: dots, chessboard, ChArUco, AprilGrid, asymmetric "
        "circles, tags, or several boards.",
    ] = None
    setup: Annotated[
        Literal["eye-in-hand", "eye-to-hand"] | None,
        "Choose eye-in-hand, camera on the flange, or eye-to-hand, board on the flange; if not given, as in the file.",
    ] = None
    rotation: Annotated[
        list[str] | None,
        "Read angles in this convention, if the file names none: kuka-abc, fanuc-wpr, ur-rotvec, rpy …, rotvec, xyz "
        "(fixed axes), ZYX (moving axes) …; robot=… or camera=… for one side.",
    ] = None
    length_unit: Annotated[
        list[str] | None,
        "Take lengths in this unit, if the file does not name it: mm, m, cm, um, in; robot=… or camera=… for one side.",
    ] = None
    poses_are: Annotated[
        list[str] | None,
        "Take poses in this direction, if the file names none, once a side: base_from_flange or flange_from_base; "
        "camera_from_board or board_from_camera.",
    ] = None
    first: shared.FirstTable = None
    second: shared.SecondTable = None
    key: shared.Key = "image"
    quaternions: shared.Quaternions = "wxyz"
    workers: shared.Workers = None

    def given(self, **timing: Any) -> "Files":
        """Returns the file or folder given as argument, or --a and --b, of any of the formats."""
        from stcal.handeye.data.pose_content import Said
        from stcal.workflows.handeye_inputs import Files

        said = Said.of_options(self.rotation or [], self.length_unit or [], self.poses_are or [], self.setup)
        source, second = self.first, self.second
        if self.source is not None or source is None or second is None:
            source, second = shared.JoinOptions(source, second, self.key).table(self.source, "POSES|IMAGES"), None
        own = self.poses, self.camera, self.board
        return Files(source, *own, second, self.key, said, self.quaternions, **timing)


POSE_FILES = PoseFiles()
SIGMA, MANY = Opt(min=0), Opt(min=1, max=100_000)


def handeye(
    files: PoseFiles = POSE_FILES,
    dry_run: Annotated[bool, "Print how the files were understood; solve and write nothing."] = False,
    method: Annotated[
        str | None,
        "Use this method, or compare all. If not given, poses and corners are both tried, with camera and board as "
        "in their files and solved for; the one that predicts held-out poses best is used.",
    ] = None,
    sigma_robot_mm: Annotated[
        float | None, "Set σ of the flange's position, mm; with --sigma-robot-deg.", SIGMA
    ] = None,
    sigma_robot_deg: Annotated[float | None, "Set σ of the flange's rotation; estimated if not given.", SIGMA] = None,
    sigma_camera_mm: Annotated[float | None, "Set σ of the board's position; with --sigma-camera-deg.", SIGMA] = None,
    sigma_camera_deg: Annotated[float | None, "Set σ of the board's rotation.", SIGMA] = None,
    sigma_px: Annotated[float | None, "Set σ of a corner, px; of dots and tags, a factor.", Opt(min=1e-9)] = None,
    sigma_board_mm: Annotated[float | None, "Set σ of a corner's position on the board; 0 if exact.", SIGMA] = None,
    refine_camera: Annotated[bool, "Adjust the intrinsics too, from the given ones and weighted by their σ."] = False,
    with_scale: Annotated[bool, "Find the board's true size from the robot's motion."] = False,
    undo_flips: Annotated[
        bool,
        "Replace a pose of a flat target by its second solution, tilted the other way, if only that one agrees with "
        "the other poses; not with images.",
    ] = False,
    four_dof: Annotated[bool, "Solve only for what a flange determines that turns about one axis (SCARA)."] = False,
    held_out: Annotated[int | None, "Hold out this many poses in each split; a quarter if not given.", MANY] = None,
    splits: Annotated[int, "Cross-validate over this many splits; 0 for none.", Opt(min=0, max=100_000)] = 15,
    seed: Annotated[int, "Draw the splits with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    time_offset: Annotated[bool, "Find the offset between the clocks of robot and camera, and apply it."] = False,
    image_times: Annotated[
        Path | None, "Read the times of the images from this file: image, time_s (CSV); if not given, from their names."
    ] = None,
    time_tolerance: Annotated[
        float, "Take the robot's nearest pose within this time, s, if none can be interpolated.", Opt(min=0, max=3600)
    ] = 0.02,
    motions_held_out: Annotated[
        int | None, "Hold out this many motions at the end, and predict them from the motions before.", MANY
    ] = None,
    out: Annotated[Path | None, "Write the result to this file (JSON).", WRITES] = None,
    ros: Annotated[Path | None, "Write a static transform of ROS to this file (YAML, metres).", WRITES] = None,
    urdf: Annotated[Path | None, "Write a fixed joint with its origin to this file (URDF, metres).", WRITES] = None,
    opencv: Annotated[Path | None, "Write OpenCV's FileStorage to this file (YAML, mm).", WRITES] = None,
    export: Annotated[
        list[str] | None,
        "Write the transform to this file; may be repeated. Forms: ros2, easy-handeye, easy-handeye2.",
        Opt(metavar="FORM=FILE"),
    ] = None,
    parent: Annotated[str, "Name the flange or base like this in ROS and URDF."] = "",
    child: Annotated[str, "Name the camera like this in ROS and URDF."] = "",
    camera_frame: Annotated[
        Literal["optical", "link"],
        "Give ROS and URDF the camera's optical frame (Z forward), or its link (X forward) with that frame below it.",
    ] = "optical",
    camera_out: Annotated[Path | None, "Write the adjusted camera with σ to this file (cameras.txt).", WRITES] = None,
    de_bounds_deg: Annotated[
        str | None,
        "Begin --method de within this rotation: ± about zero, X,Y,Z,± about a rotation vector, or closed-form,± "
        "about the closed form; ±180 if not given.",
    ] = None,
    de_bounds_mm: Annotated[
        str | None,
        "Begin --method de within this translation: ± about zero, X,Y,Z,± or closed-form,±; if not given, up to the "
        "distance of the farthest pose.",
    ] = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
    strict: shared.Strict = False,
) -> None:
    """Find where a camera is mounted on a robot's flange, or in its base, with σ."""
    from stcal.geometry.camera import Camera
    from stcal.handeye import METHODS, EvolutionOptions, HandEyeOptions, Noise
    from stcal.handeye import handeye_file as forms
    from stcal.handeye.handeye_file import HandEyeFile
    from stcal.handeye.handeye_page import outcome_report
    from stcal.handeye.handeye_pipeline import ALL, judged
    from stcal.handeye.handeye_problem import SCALED
    from stcal.io.cameras.read import save_camera
    from stcal.io.files import require_same
    from stcal.io.static_transforms import messages
    from stcal.workflows.handeye_run import calibrate_handeye, without_flips

    turns = (None if each is None else math.radians(each) for each in (sigma_robot_deg, sigma_camera_deg))
    noise = Noise(next(turns), sigma_robot_mm, next(turns), sigma_camera_mm, sigma_px, sigma_board_mm)
    exports = shared.exports_of(export or [], forms.FORMS)
    given = files.given(tolerance_s=time_tolerance, image_times=image_times, time_offset=time_offset)
    folder = files.source is not None and files.source.is_dir()
    for code, refusals in {
        "E-OPTION-NEEDS": {
            "--camera-out: only with --refine-camera; otherwise the camera stays as given": (
                camera_out and not refine_camera
            ),
            "--refine-camera: only with images; poses do not determine the intrinsics": refine_camera and not folder,
            "--parent, --child, --camera-frame: only with --ros, --urdf or --export, whose frames they name": (
                (parent or child or camera_frame != "optical") and not (ros or urdf or exports)
            ),
            "--sigma-px, --sigma-board-mm: only with images; give --sigma-camera-mm and --sigma-camera-deg": (
                not folder and (sigma_px is not None or sigma_board_mm is not None)
            ),
            "--sigma-camera-mm, --sigma-camera-deg: only with poses; with images give --sigma-px": (
                folder and sigma_camera_mm is not None
            ),
            f"--de-bounds-…: only with --method de, de-polished or {ALL}": (
                (de_bounds_deg or de_bounds_mm) and method not in (ALL, "de", "de-polished")
            ),
        },
        "E-OPTION-METHOD": {
            f"--camera-out: {method} does not adjust the camera; leave --method out": (
                camera_out and method not in (None, ALL, "reprojection")
            ),
            f"--method {method}: unknown; {ALL} or one of {', '.join(METHODS)} needed": (
                method not in (None, ALL, *METHODS)
            ),
        },
    }.items():
        for message, refused in refusals.items():
            if refused:
                raise InputError(code, message)
    forms.frame_names(files.setup or "eye-in-hand", parent, child, camera_frame)  # refused before the work
    shift = _bounds("--de-bounds-mm", de_bounds_mm, 1.0)
    turn = _bounds("--de-bounds-deg", de_bounds_deg, math.radians(1))
    evolved = EvolutionOptions(bounds_mm=shift) if turn is None else EvolutionOptions(bounds_rad=turn, bounds_mm=shift)
    if dry_run:
        say("\n".join(given.dry_run()))
        return
    with StageProgress() as progress:
        inputs = given.read(files.workers, progress)
        print_each("note", inputs.notes)
        for line in inputs.understood:
            say(line)
        prior = inputs.prior if refine_camera else None
        options = HandEyeOptions(noise, prior, with_scale, inputs.symmetries, four_dof, evolved)
        if undo_flips:
            inputs, undone = without_flips(inputs, options)
            say(undone)
        validation = {"repeats": splits, "held_out": held_out, "seed": seed, "motions": motions_held_out}
        asked = {"refine_camera": refine_camera, "time_offset": time_offset, "workers": files.workers}
        outcome = calibrate_handeye(inputs, method, options, **asked, **validation, progress=progress)
    result = outcome.result
    document = outcome_report(outcome)
    say(document.text())
    for option, given_, able in (("--with-scale", with_scale, SCALED), ("--refine-camera", refine_camera, SCALED[1:])):
        if given_ and result.method not in able:
            say(f"note: {option} does nothing for {result.method}, only for {' and '.join(able)}")
    for name, reason in outcome.given.left_out:
        say(f"left out {name}: {reason}")
    print_each("note", outcome.all_notes())
    write_if(out, lambda: HandEyeFile.of(outcome))
    transforms = forms.tree(result, parent, child, camera_frame)
    for path, text in (
        (ros, lambda: messages(transforms)),
        (urdf, lambda: forms.urdf_joint(transforms)),
        (opencv, lambda: forms.opencv_yaml(result)),
        *((path, partial(forms.FORMS[form], result, transforms, path.stem)) for form, path in exports),
    ):
        if path:
            write(path, content := text())
            require_same(path, partial(path.read_text, "utf-8"), content)
    write_if(report, document.page)
    adjusted = result.reprojection  # refused above for methods that adjust nothing
    if camera_out and adjusted is not None:
        camera_out.parent.mkdir(parents=True, exist_ok=True)
        camera = Camera.of(adjusted.camera, outcome.colmap_model, adjusted.camera_covariance)
        save_camera(camera_out, camera, "colmap")
        say(f"written: {camera_out}")
    write_if(json_file, lambda: HandEyeFile.of(outcome, whole=True))
    found = judged(outcome)
    shared.require_passed(strict, found.failed(), report, found.doubt())


def _bounds(option: str, text: str | None, factor: float) -> "Bounds | None":
    """Returns the bounds in a text like ``±``, ``X,Y,Z,±`` or ``closed-form,±``."""
    from stcal.handeye.methods.closed_form import Bounds

    if text is None:
        return None
    *about, half = text.split(",")
    try:
        half_width = factor * float(half)
        if about == ["closed-form"]:
            return Bounds(half_width, None)
        x, y, z = (factor * float(number) for number in about or "000")
        return Bounds(half_width, (x, y, z))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"{option} {text}: one number, X,Y,Z,± or closed-form,± needed") from error


def plan(
    files: PoseFiles = POSE_FILES,
    robot_file: Annotated[
        Path | None,
        "Plan only poses that this robot reaches within its joint limits (TOML), and give their joint values.",
        Opt("--robot"),
    ] = None,
    count: Annotated[int, "Name this many poses.", Opt(min=1, max=100)] = 3,
    seed: Annotated[int, "Draw the candidates with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    out: Annotated[Path | None, "Write the poses to this file (CSV).", WRITES] = None,
    json_file: shared.JsonFile = None,
) -> None:
    """Name further robot poses that would lower the worst σ of a hand-eye calibration, at the board, most."""
    from stcal.handeye.plan import HandEyePlanFile, planned_csv, planned_report
    from stcal.io.table import require_pose_table_written
    from stcal.robot import load_robot
    from stcal.workflows.handeye_run import plan_handeye

    robot = load_robot(robot_file) if robot_file else None
    with StageProgress() as progress:
        inputs = files.given().read(files.workers, progress)
    print_each("note", inputs.notes)
    for line in inputs.understood:
        say(line)
    planned = plan_handeye(inputs, count, robot, seed)
    say(planned_report(planned.result, planned.poses, planned.joints).text())
    for name, reason in inputs.left_out:
        say(f"left out {name}: {reason}")
    print_each("note", planned.notes)
    write_if(out, lambda: planned_csv(planned.poses, planned.joints))
    if out:
        frames = ("base_from_flange", "camera_from_board")
        require_pose_table_written(out, {f"{name}_": getattr(planned.poses, name) for name in frames})
    write_if(json_file, lambda: HandEyePlanFile.of(planned.result, planned.poses, planned.joints))


app = typer.Typer()
app.command("handeye")(handeye)
app.command("handeye plan")(plan)
