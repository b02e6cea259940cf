"""Commands ``stcal-sfm`` for the exchange with COLMAP and other programs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from stcal.cli.options import WRITES, Arg, Opt, Run
from stcal.cli.terminal import StageProgress, say
from stcal.errors import InputError, MappingError

app = typer.Typer()
LIMIT = Opt(min=0, max=1e6)


@app.command(name="export-database")
def export_database(
    run: Run,
    out: Annotated[Path, "Write the copy to this file, which must be new.", Arg("OUT.db", writes=True)],
    schema: Annotated[str, "Write for this version of COLMAP: 3.8, 3.9, 3.10, 3.11, 3.12, 3.13, 4.0 (and 4.1), 4.2."],
) -> None:
    """Copy the run's database in the form of another version of COLMAP; ids, orders and values stay the same."""
    from stcal.sfm.interop.crosscheck import database_text
    from stcal.sfm.interop.export_database import export_database as export

    say(database_text(export(run, out, schema)))


@app.command(name="export-model")
def export_model(
    run: Run,
    out: Annotated[Path, "Write to this place: a new file for nvm, a new or empty folder for the others.", Arg("OUT")],
    kind: Annotated[str, "Write this format: colmap-bin, colmap-txt, nvm or bundler.", Opt("--format")],
) -> None:
    """Write the run's final model in mm, in the target frame, for other programs, with a file of labels."""
    from stcal.sfm.interop.crosscheck import model_text
    from stcal.sfm.interop.export_model import export_model as export

    say(model_text(export(run, out, kind), kind))


@app.command(name="export")
def export_run(
    run: Run,
    out: Annotated[
        Path,
        "Write this new file; its suffix selects the form: .urdf, .xacro, .yaml (tf2), .py and .launch (ROS 2 and "
        "1), .yml (OpenCV), .csv, .gltf or .glb.",
        Arg("FILE", writes=True),
    ],
    form: Annotated[str, "Write this form: urdf, xacro, tf2, ros2, ros1, opencv, csv, gltf or glb."] = "",
    name: Annotated[str, "Name the target frame NAME; faces are then NAME_FACE, circles NAME_FACE_CIRCLE."] = "target",
) -> None:
    """Write faces and circles for robots and viewers, with σ and cameras if the form can hold them."""
    from stcal.sfm.interop.crosscheck import export_text
    from stcal.sfm.interop.export import export_run as export

    say(export_text(export(run, out, form, name)))


@app.command()
def crosscheck(
    run: Run,
    colmap: Annotated[Path | None, "Run this native program; `colmap` on the PATH if not given."] = None,
    tolerance_sigma: Annotated[float, "Accept differences of faces and circles up to this, in σ.", LIMIT] = 0.5,
    tolerance_um: Annotated[float | None, "Accept differences of faces and circles up to this, µm.", LIMIT] = None,
    tolerance_mdeg: Annotated[float | None, "Accept differences of faces up to this, millidegrees.", LIMIT] = None,
    camera_tolerance_um: Annotated[float | None, "Accept camera positions that differ up to this, µm.", LIMIT] = None,
    camera_tolerance_mdeg: Annotated[float | None, "Accept attitudes that differ up to this, mdeg.", LIMIT] = None,
    timeout: Annotated[float, "Stop the native mapper after this time for a group, s.", Opt(min=1, max=1e6)] = 600.0,
) -> None:
    """Map the same database with the native COLMAP, compare faces, circles and cameras, and add this to the report."""
    from stcal.sfm.interop.crosscheck import comparison_text
    from stcal.sfm.interop.crosscheck import crosscheck as checked
    from stcal.sfm.runs.comparisons import Tolerances

    tolerances = Tolerances(
        tolerance_um, tolerance_mdeg, tolerance_um, camera_tolerance_um, camera_tolerance_mdeg, tolerance_sigma
    )
    with StageProgress() as progress:
        check = checked(run, colmap, tolerances, timeout, progress, into_report=True)
    say(comparison_text(check))
    say(f"report: {run / 'report.html'}")
    if check.differences:
        raise MappingError(
            "E-CROSSCHECK-DIFFERS",
            f"cross-check: native COLMAP {check.native} and stcal differ: {'; '.join(check.differences)}",
        )


@app.command()
def faces(
    model: Annotated[Path, "Read this COLMAP model of the run's database, or a folder of several.", Arg("MODEL")],
    run: Annotated[Path, "Read the run in this folder, from whose database the model was mapped."],
    out: Annotated[Path | None, "Also write the faces to this file, in the form of faces.json.", WRITES] = None,
    solve: Annotated[
        Literal["chain", "paper"], "Solve by the mean over all chains to a face, or as in the paper, by single ones."
    ] = "chain",
) -> None:
    """Find scale and faces of a COLMAP model made or edited elsewhere; its labels are found by image and keypoint."""
    from stcal.sfm.interop.crosscheck import faces_text
    from stcal.sfm.interop.native import calibrate_models
    from stcal.sfm.runs.saved import load_run

    if out is not None and not out.parent.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: no folder {out.parent}; make it, or give another place with --out")
    saved = load_run(run)
    calibration = calibrate_models(model, saved, solve, out)
    say(faces_text(calibration, saved))
    if out is not None:
        say(f"faces: {out}")
