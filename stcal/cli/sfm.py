"""``stcal-sfm``: from images to the calibrated target."""

import tempfile
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from stcal.cli.progress import StageProgress
from stcal.design import reference_board, reference_target
from stcal.errors import InputError
from stcal.io.camera import read_camera
from stcal.io.design import board_toml, load_board, load_target, target_toml
from stcal.io.saving import json_text, save
from stcal.labels import DotLabel

app = typer.Typer(
    name="stcal-sfm",
    help="From a folder of images to the calibrated target. Any command takes --debug for a traceback.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Images = Annotated[Path, typer.Argument(help="Folder of images: IMAGES/<group>/*.jpg, png, tif, bmp.")]
CameraFile = Annotated[Path, typer.Option("--camera", help="COLMAP cameras.txt, or OpenCV or ROS YAML or XML.")]
TargetFile = Annotated[Path | None, typer.Option("--target", help="target.toml; the reference design if not given.")]
BoardFile = Annotated[Path | None, typer.Option("--board", help="board.toml; the reference board if not given.")]
Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Processes; one per core if not given.")]
MinDiameter = Annotated[
    float | None,
    typer.Option(
        "--min-diameter", min=4, help="Smallest circle sought, px; 4.5, and 9 over 8 megapixels, if not given."
    ),
]
MaxDiameter = Annotated[float, typer.Option("--max-diameter", min=8, help="Largest circle sought, px.")]


class Frame(StrEnum):
    """How a face's frame is laid."""

    plane = "plane"
    three_point = "three-point"


class Pairs(StrEnum):
    """Which pairs of images are matched."""

    all = "all"
    sparse = "sparse"


class Solve(StrEnum):
    """How the groups are solved."""

    joint = "joint"
    chain = "chain"


@app.command()
def run(
    images: Images,
    camera: CameraFile,
    out: Annotated[Path, typer.Option("--out", help="Folder of the run: new, empty, or of an earlier run.")],
    target: TargetFile = None,
    board: BoardFile = None,
    solve: Annotated[
        Solve | None,
        typer.Option(
            help="joint: one adjustment over all groups, the default; chain: group by group, as in the paper."
        ),
    ] = None,
    frame: Annotated[
        Frame | None,
        typer.Option(
            help="plane: Z from the plane of all circles of a face, the default; three-point: as in the paper."
        ),
    ] = None,
    reference_face: Annotated[
        str | None,
        typer.Option("--reference-face", help="Face whose frame is the target frame; the first if not given."),
    ] = None,
    eccentricity: Annotated[
        bool,
        typer.Option("--eccentricity/--no-eccentricity", help="Off: the uncorrected control, chained as in the paper."),
    ] = True,
    max_angle: Annotated[
        float | None,
        typer.Option(
            "--max-angle",
            min=2,
            max=170,
            help="Largest median ray angle of the initial pair, degrees; 60, and the smallest beyond it, if not given.",
        ),
    ] = None,
    flatness: Annotated[
        str, typer.Option(help="σ of a circle about the plane of its face, mm, for --solve joint; or off.")
    ] = "0.02",
    refine_camera: Annotated[
        bool,
        typer.Option("--refine-camera", help="Adjust the intrinsics too, from the given ones with their σ."),
    ] = False,
    pairs: Annotated[
        Pairs | None,
        typer.Option(
            help="Pairs of images to match: all, or sparse, as many as hold every circle together; "
            "sparse above 80 images if not given."
        ),
    ] = None,
    min_diameter: MinDiameter = None,
    max_diameter: MaxDiameter = 450.0,
    workers: Workers = None,
) -> None:
    """Calibrate: detect, map, scale, chain and adjust; writes faces.json and report.html."""
    from stcal.sfm import pipeline
    from stcal.sfm.mapping.pairs import PairOptions

    options = pipeline.RunOptions(
        solve=solve and solve.value,
        frame=frame and frame.value,
        eccentricity=eccentricity,
        reference_face=reference_face,
        flatness_mm=_flatness(flatness),
        refine_camera=refine_camera,
        graph=pairs and pairs.value,
        pairs=PairOptions(None if max_angle is None else float(np.radians(max_angle))),
        ellipses=ellipse_options(min_diameter, max_diameter),
        workers=workers,
    )
    with StageProgress() as progress:
        result = pipeline.run(images, camera, out, target, board, options, progress)
    _print_run(result)


@app.command()
def detect(
    images: Images,
    camera: CameraFile,
    out: Annotated[Path, typer.Option("--out", help="Folder for detections.csv and overlays/.")] = Path("detect"),
    target: TargetFile = None,
    board: BoardFile = None,
    min_diameter: MinDiameter = None,
    max_diameter: MaxDiameter = 450.0,
    workers: Workers = None,
) -> None:
    """Detection alone: detections.csv and an overlay picture of every image."""
    from stcal.io.images import find_images
    from stcal.sfm import pipeline
    from stcal.sfm.run.saved import marker_json

    model = read_camera(camera)
    target_design = pipeline.load_design(target, reference_target, load_target)
    board_design = pipeline.load_design(board, reference_board, load_board)
    options = pipeline.RunOptions(ellipses=ellipse_options(min_diameter, max_diameter), workers=workers)
    if (out / "faces.json").exists():
        raise InputError(f"output folder {out}: holds a finished calibration; give another folder with --out")
    find_images(images)
    folder = pipeline.claim_folder(out, marker_json(images, None))
    with StageProgress() as progress:
        detection, labelled = pipeline.detect(images, model, folder, target_design, board_design, options, progress)
    for each in labelled:
        image = each.observations
        dots = sum(isinstance(label, DotLabel) for label in image.labels)
        faces = ", ".join(sorted(image.face_ids())) or "none"
        print(f"{image.name}: faces {faces} ({len(image) - dots} circles), board {dots} dots")
        for note in each.notes:
            print(f"  {note}")
    _print_skipped(detection.skipped)
    for image in detection.images:
        for what in image.detection.repeated:
            print(f"{image.file.name}: {what} found more than once; left out")
    print(f"detections: {folder / 'detections.csv'}\noverlays:   {folder / 'overlays'}")


@app.command()
def init(folder: Annotated[Path, typer.Argument(help="Where to write the two files.")]) -> None:
    """Write target.toml and board.toml of the reference design, commented, to edit."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"target.toml": target_toml(reference_target()), "board.toml": board_toml(reference_board())}
    for name in texts:
        if (folder / name).exists():
            raise InputError(f"{folder / name}: exists; move it away, or give another folder")
    for name, text in texts.items():
        save(folder / name, text)
        print(folder / name)


@app.command()
def simulate(
    folder: Annotated[Path, typer.Argument(help="New folder for the data set.")],
    width: Annotated[int, typer.Option(min=320, help="Image width, px; 3:2 images.")] = 2592,
    images: Annotated[int, typer.Option("--images", min=2, help="Images in each group.")] = 6,
    distance: Annotated[float, typer.Option(min=200, help="Distance of the camera, mm.")] = 1000.0,
    spread: Annotated[float, typer.Option(min=2, max=80, help="Spread of the views, ± degrees.")] = 40.0,
    noise: Annotated[float, typer.Option(min=0, max=0.2, help="Noise, fraction of full scale.")] = 0.01,
    blur: Annotated[float, typer.Option(min=0, max=10, help="Blur, px (standard deviation).")] = 0.7,
    clutter: Annotated[bool, typer.Option("--clutter/--clean", help="Lamps, discs and a checkered wall.")] = False,
    second_design: Annotated[
        bool, typer.Option("--second-design", help="Three faces, dark on white, another board.")
    ] = False,
    png: Annotated[bool, typer.Option("--png", help="PNG in place of JPEG.")] = False,
    sixteen_bit: Annotated[bool, typer.Option("--16-bit", help="16-bit PNG.")] = False,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 0,
    workers: Workers = None,
) -> None:
    """Write a simulated data set with known truth: images, cameras.txt, target.toml, board.toml, truth.json."""
    from stcal.synthetic.dataset import write_dataset
    from stcal.synthetic.render import RenderOptions
    from stcal.synthetic.scene import SceneOptions, make_scene
    from stcal.synthetic.scene import second_design as other

    options = SceneOptions(
        seed=seed,
        width=width,
        height=round(width * 2 / 3),
        distance_mm=distance,
        spread_deg=spread,
        images_per_group=images,
    )
    scene = make_scene(options, *(other() if second_design else ()))
    rendering = RenderOptions(noise=noise, blur_px=blur, clutter=clutter, bit_depth=16 if sixteen_bit else 8, seed=seed)
    total = images * len(scene.groups)
    done = 0
    with StageProgress() as progress:

        def step(_name: str) -> None:
            nonlocal done
            done += 1
            progress("render", done, total)

        kind = "png" if png or sixteen_bit else "jpg"
        write_dataset(folder, scene, rendering, image_format=kind, workers=workers, progress=step)
    print(f"{total} images in {len(scene.groups)} groups: {folder}")


@app.command()
def compare(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A finished run, or its faces.json.")],
    truth: Annotated[Path, typer.Argument(help="truth.json")],
    out: Annotated[Path | None, typer.Option("--json", help="Also write the comparison as JSON.")] = None,
) -> None:
    """Errors of a run against a known truth, as a table and as JSON."""
    from stcal.sfm.report.compare import compare as against
    from stcal.sfm.report.compare import comparison_table

    comparison = against(run_folder, truth)
    print(comparison_table(comparison))
    target = out or (run_folder / "compare.json" if run_folder.is_dir() else None)
    if target:
        save(target, json_text(comparison))
        print(f"as JSON: {target}")


@app.command()
def demo(
    out: Annotated[
        Path | None, typer.Option("--out", help="Keep data set and run here; a temporary folder if not given.")
    ] = None,
    workers: Workers = None,
) -> None:
    """Render a small data set with known truth, calibrate it, and print the faces against the truth."""
    from stcal.sfm import pipeline
    from stcal.sfm.report.compare import compare as against
    from stcal.sfm.report.compare import comparison_table
    from stcal.synthetic.dataset import write_dataset
    from stcal.synthetic.scene import SceneOptions, make_scene

    folder = Path(out) if out else Path(tempfile.mkdtemp(prefix="stcal-demo-"))
    data = folder / "data"
    scene = make_scene(SceneOptions(seed=1, width=1728, height=1152, images_per_group=5))
    print("simulated photographs of the reference target: 4 groups of 5 images, 1728×1152 px, at 1 m")
    with StageProgress() as progress:
        done = 0

        def step(_name: str) -> None:
            nonlocal done
            done += 1
            progress("render", done, 20)

        write_dataset(data, scene, workers=workers, progress=step)
        options = pipeline.RunOptions(workers=workers)
        result = pipeline.run(
            data / "images",
            data / "cameras.txt",
            folder / "run",
            data / "target.toml",
            data / "board.toml",
            options,
            progress,
        )
    _print_run(result)
    print("\nagainst the truth:")
    print(comparison_table(against(folder / "run", data / "truth.json")))


def _flatness(text: str) -> float | None:
    if text == "off":
        return None
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise InputError(f"--flatness {text}: a σ in mm, more than 0, or off")
    return value


def ellipse_options(min_diameter: float | None, max_diameter: float):
    """Sizes of the circles that detection seeks."""
    from stcal.sfm.detect.ellipses import EllipseOptions

    if min_diameter is not None and max_diameter <= min_diameter:
        raise InputError(f"--max-diameter {max_diameter:g} px, more than --min-diameter {min_diameter:g} px needed")
    return EllipseOptions(min_diameter_px=min_diameter, max_diameter_px=max_diameter)


def _print_skipped(skipped) -> None:
    for each in skipped:
        print(f"skipped {each.name}: {each.reason}")


def _print_checks(checks) -> None:
    """How many checks came out how, and those that did not pass."""
    from stcal.sfm.report.checks import count_verdicts

    print(f"checks: {count_verdicts([check.verdict for check in checks])}")
    for check in checks:
        if check.verdict != "passed":
            remedy = f"; {check.remedy}" if check.remedy else ""
            print(f"  {check.verdict}: {check.title}: {check.reason}{remedy}")


def _print_run(result) -> None:
    """The answer in a few lines."""
    _print_skipped(result.detection.skipped)
    for solution in result.solutions:
        group = solution.model.group
        scale = result.calibration.scales[group]
        pair = solution.pairs[0]
        print(
            f"group {group}: {len(solution.model.images)} images, {len(solution.model.labels)} circles, "
            f"initial pair {Path(pair.first).name} – {Path(pair.second).name} at "
            f"{np.degrees(pair.median_angle_rad):.0f}°, board within {1e3 * scale.rms_mm():.1f} µm RMS"
        )
        for name, reason in solution.left_out.items():
            print(f"left out {name}: {reason}")
        for outlier in solution.outliers:
            print(f"left out {outlier.image} {outlier.label}: residual {outlier.residual_px:.3f} px")
    for note in result.notes:
        print(note)
    told = sum(bool(each.notes) for each in result.labelled)
    if told:
        print(f"something was left out in {told} of {len(result.labelled)} images; the report says what and why")
    if not result.options.eccentricity:
        print("uncorrected control: without the eccentricity faces are off by tens of µm, and no residual shows it")
    reused = sum(image.reused for image in result.detection.images)
    if reused:
        print(f"detections kept from an earlier run: {reused} of {len(result.detection.images)}")
    sigma_heading = "   σ position µm      σ rotation mdeg" if result.target.face_covariance else ""
    print(f"{'face':>6} {'x':>11} {'y':>11} {'z':>11} mm{sigma_heading}")
    for face_id, pose in result.target.target_from_face.items():
        x, y, z = pose.translation
        line = f"{face_id:>6} {x:11.4f} {y:11.4f} {z:11.4f}"
        covariance = result.target.face_covariance.get(face_id)
        if face_id == result.target.reference_face:
            line += "      reference"
        elif covariance is not None:
            sigma = np.sqrt(np.maximum(np.diag(covariance), 0))
            position = " ".join(f"{1e3 * s:5.1f}" for s in sigma[3:])
            rotation = " ".join(f"{1e3 * np.degrees(s):5.2f}" for s in sigma[:3])
            line += f"    {position}   {rotation}"
        print(line)
    unseen = [f.id for f in result.target_design.faces if f.id not in result.target.target_from_face]
    if unseen:
        print(f"not seen in any image: face {', '.join(unseen)}")
    _print_checks(result.checks)
    print(f"faces:  {result.out / 'faces.json'}\nreport: {result.out / 'report.html'}")
