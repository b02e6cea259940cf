"""Commands ``stcal-sfm draw`` and ``design``: targets and boards to be made."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from stcal.cli.options import MOST_SEED, WRITES, Arg, Opt, board_in_words
from stcal.cli.terminal import StageProgress, print_each, say
from stcal.errors import InputError

app = typer.Typer()


TagBody = Literal["cube", "dodecahedron"]


CIRCLES, DICTIONARY = 10, "APRILTAG_36h11"
"""Defaults of `design`."""


@app.command()
def draw(
    design: Annotated[Path, "Read this target.toml, or this board file of any kind.", Arg("DESIGN")],
    out: Annotated[Path, "Write this file; its suffix selects the form: .pdf, .svg or .dxf.", WRITES],
    paper: Annotated[
        str,
        "Print on as many sheets of this paper as needed: A5 … A0, Letter, Legal or Tabloid. With own, a page is as "
        "large as its content. If not given, A4 for .pdf and own for the others.",
    ] = "",
    margin: Annotated[
        float, "Add this margin around the outermost circles, mm.", Opt("--margin-mm", min=0, max=1e4)
    ] = 10.0,
    net: Annotated[bool, "Draw a target's plates as one net to fold, using outline_mm and rough_pose."] = False,
) -> None:
    """Draw a target or a board 1:1, with dimensions, cut marks and scale bars, to print, cut or mill."""
    from stcal.design import TargetDesign
    from stcal.drawing.draw import draw as drawn
    from stcal.drawing.draw import drawn_text, load_design
    from stcal.sfm.detect.sightings import likeness_notes

    if isinstance(target := load_design(design), TargetDesign):
        print_each("note", likeness_notes(target))
    say(drawn_text(drawn(design, out, paper, margin, net)))


@app.command()
def design(
    folder: Annotated[Path, "Write target.toml to this folder, and board.toml if there is none.", Arg()],
    size: Annotated[
        str,
        "Make it for a box of this width, height and depth, W,H,D in mm; with --tags, give the width between "
        "opposite faces.",
    ],
    tags: Annotated[TagBody | None, "Make a cube or dodecahedron with a tag on each face and no board."] = None,
    dictionary: Annotated[str, "Take the tags of --tags from this dictionary."] = DICTIONARY,
    first_id: Annotated[int, "Number the tags of --tags from this id.", Opt(min=0, max=100_000)] = 0,
    faces: Annotated[
        str,
        "Place circles on these sides of front, right, back, left and top; on all five if not given. The first one "
        "is the reference face.",
    ] = "",
    circles: Annotated[int, "Place this many circles on each face.", Opt(min=9, max=40)] = CIRCLES,
    radius: Annotated[
        float | None,
        "Draw the smaller circles with this radius; if not given, it is chosen for box and camera.",
        Opt("--radius-mm", min=0.01, max=1e4),
    ] = None,
    distance: Annotated[
        float, "Place the camera at this distance.", Opt("--distance-mm --distance", min=50, max=1e5)
    ] = 1000.0,
    width: Annotated[
        int, "Take images of this width, px, in the ratio 3:2, with a 24 mm lens.", Opt(min=320, max=100_000)
    ] = 5184,
    camera: Annotated[Path | None, "Read the camera from this file, in place of --width."] = None,
    bright: Annotated[
        bool, "Make bright circles on dark plates, or dark ones on bright.", Opt("--bright/--dark")
    ] = False,
    images: Annotated[int, "Plan this many images in each group.", Opt(min=2, max=500)] = 10,
    seed: Annotated[int, "Draw all random numbers with this seed.", Opt(min=0, max=MOST_SEED)] = 0,
) -> None:
    """Make a target for a box, with circles that identify each face even if any three are hidden; or make a cube or
    dodecahedron of tags. Forecast its σ."""
    from stcal.io.cameras.read import read_camera
    from stcal.sfm.detect.sightings import likeness_notes
    from stcal.sfm.make.box import faces_of, size_of
    from stcal.sfm.make.design import DesignOptions, made_text
    from stcal.sfm.make.target import design_tag_body, design_target
    from stcal.sfm.planning.file import plan_text
    from stcal.sfm.planning.session import PlanOptions
    from stcal.synthetic.designs import made_text as body_text
    from stcal.synthetic.designs import width_of

    of_circles = {"--faces": faces, "--circles": circles != CIRCLES, "--radius-mm": radius, "--bright": bright}
    of_tags = {"--dictionary": dictionary != DICTIONARY, "--first-id": first_id}
    if tags is not None and (unfit := [name for name, given in of_circles.items() if given]):
        raise InputError("E-OPTION-CONFLICT", f"{unfit[0]}: of circles, not of --tags; leave it out")
    if tags is None and (unfit := [name for name, given in of_tags.items() if given]):
        raise InputError("E-OPTION-CONFLICT", f"{unfit[0]}: of tags, and there are none without --tags; add it")
    model = read_camera(camera) if camera else None
    if tags is not None:
        session = PlanOptions(images=images, distance_mm=distance, width=width, camera=model, seed=seed)
        made = design_tag_body(tags, width_of(size), dictionary, first_id, session, folder)
    else:
        polarity = "bright" if bright else "dark"
        sides, names = size_of(size), faces_of(faces)
        options = DesignOptions(sides, circles, radius, distance, width, model, polarity, seed, names)
        with StageProgress() as progress:
            made = design_target(options, images, folder, progress)
    if made.made is not None:
        print_each("note", likeness_notes(made.target))
        say(made_text(made.made))
        if made.board is not None:
            say(f"board: {board_in_words(made.board)}")
    elif made.forecast is not None:
        say(body_text(made.target, made.forecast.setup.camera, distance))
    for path in made.files:
        say(path)
    if made.forecast is not None:
        say(f"\n{plan_text(made.forecast, made.source)}")
    else:
        say(f"no forecast: {made.reason}, --images {2 * images} say")
