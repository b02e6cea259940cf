"""Commands ``stcal camera``: camera files of other programs are shown, converted and compared."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.help import PLAIN, Commands
from stcal.cli.terminal import print_each, say
from stcal.errors import InputError

if TYPE_CHECKING:
    from stcal.geometry.camera import Camera
    from stcal.io.cameras.difference import SizedLens

app = typer.Typer(
    name="stcal camera",
    help="Show, convert and compare camera files of this and other programs.",
    cls=Commands,
    **PLAIN,
)


Form = Literal[
    "colmap", "colmap-bin", "opencv", "ros", "kalibr", "mrcal", "metashape", "metashape-cameras", "matlab", "zhang"
]
"""Format of a camera file."""


NameOption = Annotated[
    str, "Choose this camera from a file of several, such as cam1 or 2; it is also the name that is written."
]
SizeOption = Annotated[str, "Take images to have this size, px, if the file states none.", Opt(metavar="WxH")]
PlotFile = Annotated[Path | None, "Draw a picture into this file (PNG or SVG).", WRITES]


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
    from stcal.io.cameras.write import form_of, save_camera

    kind = form_of(out, form)
    camera = _camera(source, name, size)
    lost = save_camera(out, camera, kind, name)
    say(f"{source}: {camera.colmap_model}, {camera.width}×{camera.height} px; written as {kind}")
    print_each(f"note: not in {kind}", lost)
    say(f"written: {out}")


@app.command()
def show(
    source: Annotated[Path, "Read the camera from this file, of any form.", Arg("A")],
    name: NameOption = "",
    size: SizeOption = "",
    plot: PlotFile = None,
) -> None:
    """Print a camera's parameters with σ, its field of view, and how far the lens moves points."""
    from stcal.report.camera import distortion_figure, shown
    from stcal.report.figure import save

    camera = _camera(source, name, size)
    say("\n".join(shown(camera)))
    if plot:
        save(distortion_figure(camera), plot)
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
    from stcal.io.cameras.difference import camera_difference
    from stcal.report.camera import comparison_figure, comparison_text
    from stcal.report.figure import save

    first_lens, second_lens = _lens(first, name, size), _lens(second, name, size)
    difference = camera_difference(first_lens, second_lens)
    say("\n".join(comparison_text(difference)))
    if plot:
        save(comparison_figure(difference), plot)
        say(f"picture: {plot}")


def _camera(path: Path, name: str, size: str) -> "Camera":
    from stcal.io.cameras.difference import SizedLens

    lens = _lens(path, name, size)
    return lens.near.camera if isinstance(lens, SizedLens) else lens


def _lens(path: Path, name: str, size: str) -> "Camera | SizedLens":
    """Return the camera of a file, or a lens of another model with the fit to it, whose quality is printed."""
    from stcal.io.cameras.difference import SizedLens, fit_lens
    from stcal.io.cameras.model import CameraModel
    from stcal.io.cameras.photograph import camera_of_photograph, is_photograph
    from stcal.io.cameras.read import read_lens, sized_camera
    from stcal.report.camera import exif_text, fitted_text

    if is_photograph(path):
        from_exif = camera_of_photograph(path)
        print_each("note", [exif_text(from_exif.told)])
        return from_exif.camera
    lens = read_lens(path, name)
    sides = size.lower().split("x") if size else ["0", "0"]
    if len(sides) != 2 or not all(side.isdigit() for side in sides):
        raise InputError("E-OPTION-SIZE", f"--size {size}: two numbers with x between needed, such as 1920x1080")
    width, height = lens.width or int(sides[0]), lens.height or int(sides[1])
    if isinstance(lens, CameraModel) or not (width and height):
        return sized_camera(lens, path, (width, height))
    fitted = fit_lens(lens, width, height)
    print_each("note", fitted_text(lens.called, fitted, lens.region is not None))
    return SizedLens(lens, width, height, fitted)
