"""Commands ``stcal camera``: camera files of other programs are shown, converted and compared."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from stcal.cli.help import group
from stcal.cli.options import WRITES, Arg, Opt
from stcal.cli.terminal import print_each, say, warn
from stcal.errors import InputError

if TYPE_CHECKING:
    from stcal.io.cameras.difference import LoadedLens

app = group("stcal camera", "Show, convert and compare camera files of this and other programs.")
Form = Literal["colmap", "colmap-bin", "opencv", "ros", "kalibr", "mrcal", "metashape", "metashape-cameras", "matlab"]
"""Format of a camera file."""
NameOption = Annotated[
    str, "Choose this camera from a file of several, such as cam1 or 2; it is also the name written."
]
SizeOption = Annotated[str, "Take images to have this size, px, if the file states none.", Opt(metavar="WxH")]
PlotFile = Annotated[Path | None, "Draw a picture into this file (.svg).", WRITES]


@app.command()
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


@app.command()
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


@app.command()
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
    """Returns the lens of a file, and prints the quality of a fit, or what EXIF says. ``fit`` : whether the fit is
    what is used, so that its quality is printed, or the lens itself."""
    from stcal.io.cameras.difference import SizedLens, load_lens
    from stcal.io.cameras.read import SIGMA_FOCAL
    from stcal.report.camera_figures import fitted_text

    sides = size.lower().split("x") if size else ["0", "0"]
    if len(sides) != 2 or not all(side.isdigit() for side in sides):
        raise InputError("E-OPTION-SIZE", f"--size {size}: two numbers with x between needed, such as 1920x1080")
    found = load_lens(path, name, (int(sides[0]), int(sides[1])))
    lens = found.lens
    if isinstance(lens, SizedLens) and fit:
        print_each("note", fitted_text(lens.lens.called, lens.near, lens.lens.region is not None))
    elif isinstance(lens, SizedLens):
        where = ", within its valid_intrinsics_region" if lens.lens.region is not None else ""
        print_each("note", [f"{path}: {lens.lens.called} is compared by its own projection{where}, not by a fit to it"])
    elif found.told:
        accuracy = f"f to {SIGMA_FOCAL:.0%}, distortion unknown"
        start = "a start for `run --refine-camera`, not for measuring"
        print_each("note", [f"from EXIF: {found.told}; {accuracy}: {start}"])
    return found
