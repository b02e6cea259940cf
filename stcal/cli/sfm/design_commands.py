"""Commands ``stcal-sfm init``, ``draw`` and ``design``: targets and boards to edit and to be made; and ``simulate``,
``compare`` and ``demo``: data with known truth."""

import tempfile
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stcal.cli import options as shared
from stcal.cli.options import SEED, WIDTH, WRITES, Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, printed_last, say, write_if
from stcal.errors import InputError
from stcal.io.files import COMPARISON, RUN_MARKER, json_text, real_place, save

if TYPE_CHECKING:
    from stcal.design import BoardDesign, TargetDesign
    from stcal.synthetic.optics import ThinLens
    from stcal.synthetic.scene import Scene


app = typer.Typer()


@app.command()
def init(folder: Annotated[Path, "Write the two files to this folder.", Arg()]) -> None:
    """Write target.toml and board.toml of the reference design, with comments, to edit."""
    from stcal import design
    from stcal.boards import board_file, target_file

    folder.mkdir(parents=True, exist_ok=True)
    target, board = folder / "target.toml", folder / "board.toml"
    for path in (target, board):
        if path.exists():
            raise InputError("E-OUTPUT-EXISTS", f"{path}: exists; move it away, or give another folder")
    target_file.save_target(target, design.reference_target())
    board_file.save_board(board, design.reference_board())
    say(f"{target}\n{board}")


@app.command()
def simulate(
    folder: Annotated[Path, "Write the data set to this new folder.", Arg()],
    width: Annotated[int, "Render images of this width, px, in the ratio 3:2.", Opt(min=320, max=50_000)] = 2592,
    images: Annotated[int, "Render this many images in each group.", Opt(min=2, max=500)] = 6,
    distance: shared.Distance = 1000.0,
    spread: Annotated[float, "Spread the views by ± this, degrees.", Opt(min=2, max=80)] = 40.0,
    fisheye: Annotated[float | None, "Use an equidistant lens of this diagonal field, °.", Opt(min=60, max=170)] = None,
    noise: Annotated[float, "Add noise of this fraction of full scale.", Opt(min=0, max=0.2)] = 0.01,
    blur: Annotated[float, "Blur by this standard deviation, px.", Opt(min=0, max=10)] = 0.7,
    f_number: Annotated[float | None, "Use a thin lens of this f-number; else no blur.", Opt(min=0.5, max=100)] = None,
    focus_mm: Annotated[float | None, "Focus at this depth, or at --distance.", Opt(min=10, max=1e7)] = None,
    focal_mm: Annotated[
        float | None, "Set the focal length, or that of a sensor 22.3 mm wide.", Opt(min=0.5, max=5000)
    ] = None,
    rim_mm: Annotated[float, "Set the height of rims; < 0: raised discs.", Opt(min=-20, max=20)] = 0.0,
    slope: Annotated[float, "Let the light of circles rise by this fraction across.", Opt(min=0, max=1)] = 0.0,
    clutter: Annotated[bool, "Add lamps, discs and a checkered wall.", Opt("--clutter/--clean")] = False,
    table_reflectance: Annotated[float | None, "Add a table of this reflectance.", Opt(min=0, max=1)] = None,
    target: shared.TargetFile = None,
    board: shared.BoardFile = None,
    groups: Annotated[str | None, "Photograph these pairs of faces, such as 12,14; else all visible ones."] = None,
    camera: Annotated[Path | None, "Render with the camera of this file, in place of --width."] = None,
    one_board: Annotated[bool, "Photograph one board with all groups, as `plan` assumes."] = False,
    second_design: Annotated[bool, "Use three faces, dark on white, and another board."] = False,
    png: Annotated[bool, "Write PNG instead of JPEG."] = False,
    sixteen_bit: Annotated[bool, "Write 16-bit PNG.", Opt("--16-bit")] = False,
    seed: Annotated[int, "Draw all random numbers with this seed.", SEED] = 0,
    body_seed: Annotated[int | None, "Draw errors of target, camera and board with this, not --seed.", SEED] = None,
    margin_mm: shared.PlateMargin = 15.0,
    workers: shared.Workers = None,
) -> None:
    """Write a simulated data set with known truth, of the reference design or your own: images, cameras.txt,
    target.toml, board.toml, truth.json."""
    from stcal.boards.target_file import target_of
    from stcal.io.cameras.read import read_camera
    from stcal.sfm.planning.forecast import nominal_poses
    from stcal.sfm.planning.session import pairs_of_faces
    from stcal.synthetic import body_scene
    from stcal.synthetic.dataset import write_dataset
    from stcal.synthetic.render import RenderOptions
    from stcal.synthetic.scene import SceneOptions, make_scene

    model = None if camera is None else read_camera(camera)
    kind = "png" if png or sixteen_bit else "jpg"
    if target is not None and (body := target_of(target)).with_faces(printed=True).faces:
        names = "--groups --fisheye --f-number --rim-mm --board --slope --second-design --one-board --clutter --16-bit"
        others = groups, fisheye, f_number, rim_mm, board, slope, second_design, one_board, clutter, sixteen_bit
        if unfit := [name for name, value in zip(names.split(), others, strict=True) if value]:
            fault = f"{unfit[0]}: not for a body with boards or tags on its faces"
            raise InputError("E-OPTION-CONFLICT", f"{fault}; leave it out")
        if model is not None and not (model.width and model.height):
            raise InputError("E-CAMERA-SIZE", f"camera file {camera} states no image size; add it to the file")
        with_camera = body_scene.body_camera(width) if model is None else model.calibrated(0, 0)
        errors: dict[str, Any] = {"noise": noise, "blur_px": blur, "print_errors": 1, "body_seed": body_seed}
        printed = body_scene.BodyOptions(images, distance, seed=seed, **errors)
        held = body_scene.make_body_scene(body, with_camera, printed)
        with StageProgress() as progress:
            step = partial(progress, "render")
            paths = write_dataset(folder, held, image_format=kind, workers=workers, progress=step)
        say(f"{len(paths)} images: {folder}")
        print_each("note", filter(None, [held.hardly_seen()]))
        return
    if second_design and (target or board):
        raise InputError("E-OPTION-CONFLICT", "--second-design and --target or --board: two designs; give one of them")
    one_given = (target is None) != (board is None)  # both are the reference's if neither is given
    with shared.designs_told(target, board, with_target=one_given, with_board=one_given):
        designs = _designs(target, board, second_design)
        poses, pairs = nominal_poses(designs[0], None), pairs_of_faces(groups, designs[0]) if groups else None
        if camera is not None and fisheye is not None:
            raise InputError("E-OPTION-CONFLICT", f"--camera {camera} and --fisheye {fisheye:g}: two cameras; give one")
        shape: dict[str, Any] = {"distance_mm": distance, "spread_deg": spread, "margin_mm": margin_mm, "groups": pairs}
        shape |= {"width": width, "height": round(width * 2 / 3), "fisheye_deg": fisheye, "images_per_group": images}
        options = SceneOptions(seed=seed, one_board=one_board, body_seed=body_seed, **shape)
        scene = make_scene(options, *designs, poses, model)
    lens = None
    if f_number is not None:
        lens = _lens(scene, f_number, distance if focus_mm is None else focus_mm, focal_mm, camera)
    for name, mm in {"--focus-mm": focus_mm, "--focal-mm": focal_mm}.items():
        if mm is not None and f_number is None:
            raise InputError("E-OPTION-NEEDS", f"{name} {mm:g}: only with a thin lens; add --f-number")
    look: dict[str, Any] = {"noise": noise, "blur_px": blur, "clutter": clutter, "reflectance": table_reflectance}
    depth = 16 if sixteen_bit else 8
    rendering = RenderOptions(bit_depth=depth, seed=seed, lens=lens, rim_mm=rim_mm, slope=slope, **look)
    with StageProgress() as progress:
        step = partial(progress, "render")
        paths = write_dataset(folder, scene, rendering, image_format=kind, workers=workers, progress=step)
    say(f"{len(paths)} images in {len(scene.groups)} groups: {folder}")


def _lens(scene: "Scene", f_number: float, focus_mm: float, focal_mm: float | None, camera: Path | None) -> "ThinLens":
    from stcal.synthetic.optics import ThinLens
    from stcal.synthetic.scene import SENSOR_WIDTH_MM

    if focal_mm is None and camera is not None:
        fault = f"--f-number {f_number:g}: camera file {camera} states no length in mm"
        raise InputError("E-OPTION-NEEDS", f"{fault}, which the aperture's diameter needs; add --focal-mm")
    usual_mm = round(float(scene.camera.focal.mean()) * SENSOR_WIDTH_MM / scene.camera.width, 6)
    return ThinLens(f_number, usual_mm if focal_mm is None else focal_mm, focus_mm)


def _designs(target: Path | None, board: Path | None, second_design: bool) -> "tuple[TargetDesign, BoardDesign]":
    from stcal.boards.board_designs import CornerBoard
    from stcal.boards.board_file import board_of
    from stcal.boards.target_file import target_of
    from stcal.synthetic import scene

    designs = scene.second_design()[:2] if second_design else (target_of(target, printed=False), board_of(board))
    if isinstance(designs[1], CornerBoard):
        fault = f"--board {board}: squares or tags, which are not drawn beside a target"
        needed = "a board of dots, asymmetric or hexagonal circles needed here (`run` takes this one)"
        raise InputError("E-BOARD-TYPE", f"{fault}; {needed}")
    return designs


@app.command()
def compare(
    run: Annotated[Path, "Read this finished run, its faces.json, or poses.csv of measure.", Arg("RUN")],
    truth: Annotated[Path, "Read the truth from this truth.json.", Arg()],
    out: shared.JsonFile = None,
) -> None:
    """Compare a run, or measured poses, with the known truth, as a table and as JSON."""
    from stcal.sfm.report.compare import compare as against
    from stcal.sfm.report.compare import compare_poses, comparison_table, poses_table
    from stcal.sfm.runs.transaction import added_results

    if run.suffix.lower() == ".csv":
        of_poses = compare_poses(run, truth)
        with printed_last():
            say(poses_table(of_poses))
            write_if(out, lambda: of_poses, "as JSON")
        return

    into_run = run / COMPARISON
    is_added = (run / RUN_MARKER).is_file() and (out is None or real_place(out) == real_place(into_run))
    with added_results(run) if is_added else nullcontext() as stage:
        comparison = against(run, truth)
        if stage is not None:
            save(stage / COMPARISON, json_text(comparison))
    with printed_last():
        say(comparison_table(comparison))
        if is_added:
            say(f"as JSON: {into_run}")
        else:
            write_if(out or (into_run if run.is_dir() else None), lambda: comparison, "as JSON")


@app.command()
def demo(
    out: Annotated[Path | None, "Keep data set and run in this folder, in place of a temporary one."] = None,
    workers: shared.Workers = None,
) -> None:
    """Render a small data set with known truth, calibrate it, and compare the faces with the truth."""
    from stcal.sfm.pipeline import run
    from stcal.sfm.report.compare import compare, comparison_table
    from stcal.sfm.runs.folder import run_text
    from stcal.sfm.runs.run_options import RunOptions
    from stcal.synthetic.dataset import write_dataset
    from stcal.synthetic.scene import SceneOptions, make_scene

    folder = out or Path(tempfile.mkdtemp(prefix="stcal-demo-"))
    data, options = folder / "data", SceneOptions(seed=1, width=1728, height=1152, images_per_group=5)
    say("simulated photographs of the reference target: 4 groups of 5 images, 1728×1152 px, at 1 m")
    with StageProgress() as progress:
        write_dataset(data, make_scene(options), workers=workers, progress=partial(progress, "render"))
        designs = data / "target.toml", data / "board.toml", RunOptions(workers=workers)
        result = run(data / "images", data / "cameras.txt", folder / "run", *designs, progress)
        comparison = compare(folder / "run", data / "truth.json")
    say(run_text(result))
    say("\nagainst the truth:")
    say(comparison_table(comparison))


Body = Literal["cube", "dodecahedron"]
CIRCLES, DICTIONARY = 10, "APRILTAG_36h11"  # defaults of `design`


@app.command()
def draw(
    design: Annotated[Path, "Read this target.toml, or this board file of any kind.", Arg("DESIGN")],
    out: Annotated[Path, "Write this file; its suffix selects the form: .pdf or .svg.", WRITES],
    paper: Annotated[
        str,
        "Print on as many sheets of this paper as needed: A5 … A0, Letter, Legal or Tabloid. With own, a page is as "
        "large as its content. If not given, A4 for .pdf and own for the others.",
    ] = "",
    margin_mm: Annotated[float, "Add this margin around the circles, mm.", Opt(min=0, max=1e4)] = 10.0,
    net: Annotated[bool, "Draw a target's plates as one net to fold, using outline_mm and rough_pose."] = False,
) -> None:
    """Draw a target or a board 1:1, with dimensions, cut marks and scale bars, to print, cut or mill."""
    from stcal.drawing.draw import draw as drawn
    from stcal.drawing.draw import drawn_text

    say(drawn_text(drawn(design, out, paper, margin_mm, net)))


@app.command()
def design(
    folder: Annotated[Path, "Write target.toml to this folder, and board.toml if there is none.", Arg()],
    size: Annotated[str, "Make it for a box of W,H,D mm; for --tags, give the width between opposite faces."],
    tags: Annotated[Body | None, "Make this body with a tag on each face and no board."] = None,
    dictionary: Annotated[str, "Take the tags of --tags from this dictionary."] = DICTIONARY,
    first_id: Annotated[int, "Number the tags of --tags from this id.", Opt(min=0, max=100_000)] = 0,
    faces: Annotated[
        str,
        "Place circles on these sides of front, right, back, left and top; on all five if not given. The first one "
        "is the reference face. With --tags, place tags on these faces alone, by number: 1,2,3,4,5.",
    ] = "",
    circles: Annotated[int, "Place this many circles on each face.", Opt(min=9, max=40)] = CIRCLES,
    radius_mm: Annotated[
        float | None, "Draw the smaller circles with this radius; else chosen.", Opt(min=0.01, max=1e4)
    ] = None,
    distance: shared.Distance = 1000.0,
    width: Annotated[int, "Take images of this width, px, 3:2, with a 24 mm lens.", WIDTH] = 5184,
    camera: Annotated[Path | None, "Read the camera from this file, in place of --width."] = None,
    bright: Annotated[bool, "Make bright circles on dark plates, or dark on bright.", Opt("--bright/--dark")] = False,
    images: Annotated[int, "Plan this many images in each group.", Opt(min=2, max=500)] = 10,
    seed: Annotated[int, "Draw all random numbers with this seed.", SEED] = 0,
) -> None:
    """Make a target for a box, with circles that identify each face even if any three are hidden; or make a cube or
    dodecahedron of tags. Forecast its σ."""
    from stcal.drawing.draw import net_text
    from stcal.io.cameras.read import read_camera
    from stcal.sfm import make
    from stcal.sfm.planning.session import PlanOptions, plan_text
    from stcal.synthetic import designs

    unfit = {"--dictionary": dictionary != DICTIONARY, "--first-id": first_id}
    why = "of tags, and there are none without --tags; add it"
    if tags is not None:
        unfit = {"--circles": circles != CIRCLES, "--radius-mm": radius_mm, "--bright": bright}
        why = "of circles, not of --tags; leave it out"
    if given := [name for name, value in unfit.items() if value]:
        raise InputError("E-OPTION-CONFLICT", f"{given[0]}: {why}")
    model = read_camera(camera) if camera else None
    if tags is not None:
        session = PlanOptions(images=images, distance_mm=distance, width=width, camera=model, seed=seed)
        made = make.design_tag_body(tags, designs.width_of(size), dictionary, first_id, session, folder, faces)
    else:
        shape = circles, radius_mm, distance, width, model, "bright" if bright else "dark", seed
        options = make.DesignOptions(make.size_of(size), *shape, make.faces_of(faces))
        with StageProgress() as progress:
            made = make.design_target(options, images, folder, progress)
    if made.made is not None:
        say(make.made_text(made.made))
        if made.board is not None:
            say(f"board: {shared.board_in_words(made.board)}")
    elif made.forecast is not None:
        say(designs.made_text(made.target, made.forecast.setup.camera, distance))
    if tags is not None:
        say(net_text(made.target))
    for path in made.files:
        say(path)
    if made.forecast is not None:
        say(f"\n{plan_text(made.forecast, made.source)}")
    else:
        say(f"no forecast: {made.reason}, --images {2 * images} say")
