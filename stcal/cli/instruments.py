"""Commands ``stcal locate``: tags in any light; ``stcal register``: two frames; ``stcal camera``: camera files."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stcal.cli import options as shared
from stcal.cli.help import group
from stcal.cli.options import WRITES, Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, say, warn, warn_if_quiet, write, write_if
from stcal.errors import ConvergenceError, DegenerateError, InputError

if TYPE_CHECKING:
    from stcal.io.cameras.difference import LoadedLens

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

    def told(row) -> None:
        shares = f"{100 * row.saturated_share:.1f} % saturated, {100 * row.dark_share:.1f} % dark"
        say(f"  {row.image}: exposure {row.exposure_set:g} set for {row.exposure:g}, {shares}")

    try:
        say(f"{source.name}: {count} exposures")
        capture(source, exposures.tolist(), folder, gain, settle, told)
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
    from stcal.io.device import images_or_frames
    from stcal.io.table import require_pose_table_written
    from stcal.locate.base_chain import accepted, goal_chain, goals, uncertain
    from stcal.locate.layout import load_layout
    from stcal.locate.located_report import LocatedFile, poses_csv, run_report
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


Method = Literal["robust", "least-squares", "liu2017"]  # method of the fit


def register(
    pairs_file: Annotated[
        Path | None, "Read ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm of the same points from this file (CSV).", Arg("PAIRS")
    ] = None,
    model: Annotated[Literal["rigid", "similarity", "affine"], "Fit a transform of this kind."] = "rigid",
    method: Annotated[Method, "Fit with this method; liu2017 is the published one, always affine."] = "robust",
    threshold: Annotated[
        float | None,
        "Count points nearer than this as inliers, mm. If not given, it is estimated from the data; for liu2017 it "
        "is 0.2.",
        Opt("--threshold --threshold-mm"),
    ] = None,
    sample: Annotated[
        int | None, "Draw samples of this many points, for liu2017; 30 if not given.", Opt(min=4, max=100_000)
    ] = None,
    share: Annotated[
        float | None,
        "Accept a sample if more than this share of the other points are inliers, for liu2017; 0.85 if not given.",
        Opt(min=1e-9, max=1),
    ] = None,
    tries: Annotated[
        int | None, "Draw this many samples, for liu2017; 1000 if not given.", Opt(min=1, max=1_000_000)
    ] = None,
    orthogonality: Annotated[
        float | None,
        "Reject a sample if an entry of RᵀR − 1, with its 3×3 part R, is larger than this, for liu2017; 0.01 if not "
        "given.",
        Opt(min=1e-12, max=1e6),
    ] = None,
    seed: Annotated[int, "Draw random samples and folds with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    folds: Annotated[int, "Cross-validate with this many folds; 0 for none.", Opt(min=0, max=100_000)] = 6,
    allow_ambiguous: Annotated[bool, "Answer even if another transform fits about as well."] = False,
    robot_file: Annotated[
        Path | None,
        "Solve for base and kinematics of this robot together (TOML); PAIRS needs q1_deg ….",
        Opt("--robot"),
    ] = None,
    identified: Annotated[Path | None, "Write the robot identified with --robot to this file (TOML).", WRITES] = None,
    joined: shared.JoinOptions = shared.JOINED_BY_NAME,
    out: Annotated[Path | None, "Write all results to this file (JSON).", WRITES] = None,
    report: shared.ReportFile = None,
) -> None:
    """Find b_from_a from points measured in two frames, with σ and outliers, and show systematic residuals."""
    from stcal.register import register as registered
    from stcal.register.registered import read_pairs
    from stcal.register.registration import Liu2017Options
    from stcal.register.registration_report import OF_ROBOT, RegistrationFile, registration_report, sample_size_section
    from stcal.register.workspace import findings

    if identified and not robot_file:
        raise InputError("E-OPTION-NEEDS", f"--identified {identified}: only with --robot FILE")
    published: dict[str, Any] = {"sample": sample, "share": share, "tries": tries, "orthogonal_within": orthogonality}
    published = {name: value for name, value in published.items() if value is not None}
    if published and method != "liu2017":
        raise InputError("E-OPTION-NEEDS", "--sample, --share, --tries, --orthogonality: only with --method liu2017")
    liu2017 = replace(Liu2017Options(), **published) if method == "liu2017" else None
    source = joined.table(pairs_file, "PAIRS", ("a", "b"))
    pairs = read_pairs(source)
    if not isinstance(source, Path) and any("cov_" in column for column in source.columns):
        say("note: the covariances of --a and --b are not used; the noise of the points is estimated")
    allow_ambiguous |= robot_file is not None  # a bent arm may look like two motions; the kinematics show it
    both = {"threshold_mm": threshold, "liu2017_options": liu2017, "folds": folds}
    asked = {"model": model, "method": method, "seed": seed, "allow_ambiguous": allow_ambiguous, **both}
    stated = {"weights": pairs.weights, "covariances": pairs.covariances, "lines": pairs.lines}
    result = registered(pairs.xyz_a, pairs.xyz_b, **asked, **stated)
    registration = findings(pairs, result)
    content, sections, failed = RegistrationFile.model_validate(registration), [], None
    if report and liu2017:
        limits = liu2017 if threshold is None else replace(liu2017, limit_mm=threshold)
        sections.append(sample_size_section(pairs.xyz_a, pairs.xyz_b, limits, seed))
    if robot_file:
        from stcal.robot.identification.result import require_identified_written
        from stcal.robot.kinematics.robot_file import load_robot, robot_toml
        from stcal.workflows.register_robot import comparison_section, register_with_robot

        try:
            beside = register_with_robot(pairs, registration, load_robot(robot_file), source, **both)
            content = content.model_copy(update={"robot": OF_ROBOT.checked(beside)})
            sections.append(comparison_section(beside))
            if identified:
                comments = [f"Identified from {shared.name_of(source)}: {beside.identified.rank} parameters."]
                write(identified, robot_toml(beside.identified.robot, comments))
                require_identified_written(identified, beside.identified)
        except (DegenerateError, ConvergenceError) as error:  # the transform is valid without it
            failed = error
    document = registration_report(registration, sections)
    say(document.text())
    print_each(f"warning: {pairs.where}", result.notes)
    write_if(out, lambda: content)
    write_if(report, document.page)
    if failed is not None:
        raise failed


camera_app = group("stcal camera", "Show, convert and compare camera files of this and other programs.")
Form = Literal["colmap", "colmap-bin", "opencv", "ros", "kalibr", "mrcal", "metashape", "metashape-cameras", "matlab"]
"""Format of a camera file."""
NameOption = Annotated[
    str, "Choose this camera from a file of several, such as cam1 or 2; it is also the name written."
]
SizeOption = Annotated[str, "Take images to have this size, px, if the file states none.", Opt(metavar="WxH")]
PlotFile = Annotated[Path | None, "Draw a picture into this file (.svg).", WRITES]


@camera_app.command()
def convert(
    source: Annotated[Path, "Read the camera from this file, in any form.", Arg("A")],
    out: Annotated[Path, "Write the camera to this file.", Arg("B", writes=True)],
    form: Annotated[
        Form | None,
        "Write this form; if not given, it follows from B's suffix: .txt colmap, .bin colmap-bin, .yaml opencv, "
        ".cameramodel mrcal, .xml metashape, .mat matlab.",
    ] = None,
    name: NameOption = "",
    size: SizeOption = "",
) -> None:
    """Convert a camera file to the form of another program, and say what that form cannot hold."""
    from stcal.io.cameras.keys import collecting_passed_over
    from stcal.io.cameras.read import form_of, save_camera

    kind = form_of(out, form)
    with collecting_passed_over() as passed_over:
        camera = _lens(source, name, size).camera
    lost = save_camera(out, camera, kind, name)
    say(f"{source}: {camera.colmap_model}, {camera.width}×{camera.height} px; written as {kind}")
    if lost or passed_over:
        warn(f"not in {out}: {'; '.join([*lost, *passed_over])}")
    say(f"written: {out}")


@camera_app.command()
def show(
    source: Annotated[Path, "Read the camera from this file, of any form.", Arg("A")],
    name: NameOption = "",
    size: SizeOption = "",
    plot: PlotFile = None,
) -> None:
    """Print a camera's parameters with σ, its field of view, and how far the lens moves points."""
    from stcal.report.camera_figures import field_figure, moved_px, shown
    from stcal.report.svg import save

    camera = _lens(source, name, size).camera
    say("\n".join(shown(camera)))
    if plot:
        save(field_figure(*moved_px(camera)), plot)
        say(f"picture: {plot}")


@camera_app.command()
def compare(
    first: Annotated[Path, "Read the first camera from this file, in any form.", Arg("A")],
    second: Annotated[Path, "Read the camera to compare from this file, in any form.", Arg("B")],
    name: NameOption = "",
    size: SizeOption = "",
    plot: PlotFile = None,
) -> None:
    """Compare two cameras: by how many pixels their images of a ray differ, after the rotation that fits best."""
    from stcal.io.cameras.difference import compare_cameras
    from stcal.report.camera_figures import comparison_text, field_figure
    from stcal.report.svg import save

    first_lens, second_lens = _lens(first, name, size, False), _lens(second, name, size, False)
    difference = compare_cameras(first_lens.lens, second_lens.lens)
    say("\n".join(comparison_text(difference)))
    if plot:
        save(field_figure(difference.pixels, difference.apart, "second camera, px apart"), plot)
        say(f"picture: {plot}")


def _lens(path: Path, name: str, size: str, fit: bool = True) -> "LoadedLens":
    """Returns the lens of a file, and prints the quality of a ``fit``, or what EXIF says."""
    from stcal.io.cameras.difference import load_lens
    from stcal.io.cameras.read import SIGMA_FOCAL
    from stcal.report.camera_figures import fitted_text

    sides = size.lower().split("x") if size else ["0", "0"]
    if len(sides) != 2 or not all(side.isdigit() for side in sides):
        raise InputError("E-OPTION-SIZE", f"--size {size}: two numbers with x between needed, such as 1920x1080")
    found = load_lens(path, name, (int(sides[0]), int(sides[1])))
    if found.fitted and fit:
        print_each("note", fitted_text(found.fitted))
    elif found.fitted:
        lens = found.fitted.lens
        where = ", within its valid_intrinsics_region" if lens.region is not None else ""
        print_each("note", [f"{path}: {lens.called} is compared by its own projection{where}, not by a fit to it"])
    elif found.told:
        accuracy = f"f to {SIGMA_FOCAL:.0%}, distortion unknown"
        start = "a start for `run --refine-camera`, not for measuring"
        print_each("note", [f"from EXIF: {found.told}; {accuracy}: {start}"])
    return found
