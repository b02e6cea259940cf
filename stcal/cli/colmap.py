"""``stcal-sfm``: what goes to and comes from COLMAP, and why something was left out."""

import os
from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.progress import StageProgress
from stcal.errors import InputError, MappingError
from stcal.io.saving import json_text, save

app = typer.Typer()

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
SHOWN_PAIRS = 10


@app.command(name="export-database")
def export_database(
    run: Run,
    out: Annotated[Path, typer.Argument(metavar="OUT.db", help="New file; nothing is overwritten.")],
    schema: Annotated[
        str, typer.Option("--schema", help="COLMAP's version: 3.8, 3.9, 3.10, 3.11, 3.12, 3.13, 4.0 (and 4.1), 4.2.")
    ],
) -> None:
    """A copy of the run's database that another version of COLMAP opens; ids, orders and values stay."""
    from stcal.sfm.interop.export_database import export_database as export
    from stcal.sfm.run.saved import load_run

    written = export(load_run(run).database, out, schema)
    print(
        f"schema {written.schema}, checked: {written.images} images, {written.pairs} pairs, "
        f"camera model {', '.join(written.camera_models)}"
    )
    print(f"open it with: colmap gui --database_path {written.path} --image_path IMAGES")


@app.command(name="export-model")
def export_model(
    run: Run,
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="New file for ply and nvm, new or empty folder for the others."),
    ],
    kind: Annotated[str, typer.Option("--format", help="colmap-bin, colmap-txt, ply, nvm or bundler.")],
) -> None:
    """The run's final model, mm, target frame, for other programs; labels beside it."""
    from stcal.sfm.interop.export_model import export_model as export

    written = export(run, out, kind)
    print(f"{written.images} images and {written.points} points, mm, target frame: {written.path}")
    print(f"labels: {written.labels}")
    if written.focal_px is not None:
        x, y = written.centre_px
        print(
            f"{kind} knows one focal length and a principal point at the centre: the keypoints are those of an ideal "
            f"camera without distortion, f = {written.focal_px:.4f} px, principal point ({x:g}, {y:g}) px; undistort "
            "the photographs to it to match"
        )


@app.command()
def crosscheck(
    run: Run,
    colmap: Annotated[
        Path | None, typer.Option("--colmap", help="The native program; `colmap` on the PATH if not given.")
    ] = None,
    tolerance_um: Annotated[
        float, typer.Option(min=0, max=1e6, help="Faces and circles may differ by this, µm.")
    ] = 2.0,
    tolerance_mdeg: Annotated[
        float, typer.Option(min=0, max=1e6, help="Faces may differ by this, millidegrees.")
    ] = 1.0,
    camera_tolerance_um: Annotated[
        float, typer.Option(min=0, max=1e6, help="Camera positions may differ by this, µm.")
    ] = 20.0,
    camera_tolerance_mdeg: Annotated[float, typer.Option(min=0, max=1e6, help="Camera attitudes, millidegrees.")] = 2.0,
    timeout: Annotated[
        float, typer.Option(min=1, max=1e6, help="Longest time for one group in the native mapper, s.")
    ] = 600.0,
) -> None:
    """Map the same database with the native COLMAP and compare faces, circles and cameras; into the report."""
    from stcal.sfm import pipeline
    from stcal.sfm.interop.crosscheck import Tolerances, comparison_text
    from stcal.sfm.run.saved import load_run

    tolerances = Tolerances(tolerance_um, tolerance_mdeg, tolerance_um, camera_tolerance_um, camera_tolerance_mdeg)
    saved = load_run(run)
    with StageProgress() as progress:
        check = pipeline.crosscheck_run(saved, colmap, tolerances, timeout, progress)
    print(comparison_text(check))
    print(f"report: {run / 'report.html'}")
    if check["differences"]:
        raise MappingError(
            f"cross-check: native COLMAP {check['native']} and stcal differ: {'; '.join(check['differences'])}"
        )


@app.command()
def faces(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="A COLMAP model, or the folder of several, of the run's database.")
    ],
    run: Annotated[Path, typer.Option("--run", help="Folder of the run whose database was mapped.")],
    out: Annotated[Path | None, typer.Option("--out", help="Also write them as a faces.json; a new file.")] = None,
) -> None:
    """Scale and faces from a COLMAP model made or edited elsewhere; points get their labels by (image, keypoint)."""
    from stcal.sfm import pipeline
    from stcal.sfm.interop.crosscheck import face_differences
    from stcal.sfm.run.saved import load_run

    if out is not None and os.path.lexists(out):
        raise InputError(f"{out}: exists; give a new file with --out")
    if out is not None and not out.parent.is_dir():
        raise InputError(f"{out}: no folder {out.parent}; make it, or give another place with --out")
    saved = load_run(run)
    calibration = pipeline.calibrate_models(model, saved)
    for note in calibration.notes:
        print(note)
    for each in calibration.models:
        scale = calibration.scales[each.group]
        print(
            f"group {each.group}: {len(each.images)} images, {len(each.labels)} circles, {scale.mm_per_unit:.6g} mm "
            f"per unit, board within {1e3 * scale.rms_mm():.1f} µm RMS"
        )
    difference = face_differences(calibration.target, saved)
    print(f"{'face':>6} {'x':>11} {'y':>11} {'z':>11} mm   against the run: µm     mdeg")
    for face_id, pose in calibration.target.target_from_face.items():
        x, y, z = pose.translation
        row = difference.get(face_id)
        beside = f"{row['translation_um']:22.2f} {row['rotation_mdeg']:8.3f}" if row else f"{'not in the run':>31}"
        print(f"{face_id:>6} {x:11.4f} {y:11.4f} {z:11.4f}   {beside}")
    if out is not None:
        pipeline.write_faces(out, calibration, saved)
        print(f"faces: {out}")


@app.command()
def pairs(
    run: Run,
    group: Annotated[str | None, typer.Option("--group", help="One group only.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="All pairs; the first ten if not given.")] = False,
    out: Annotated[Path | None, typer.Option("--json", help="Also write all pairs and gates as JSON.")] = None,
) -> None:
    """The ranked initial pairs, and how each fares at every gate: ours, COLMAP's as set, COLMAP's at its defaults."""
    from stcal.sfm.interop.gates import limits_text, pairs_json, pairs_table, run_gates
    from stcal.sfm.run.saved import load_run

    saved = load_run(run)
    found = run_gates(saved, group)
    for name, rows in found.items():
        images = len({image for row in rows for image in (row.score.first, row.score.second)})
        print(pairs_table(name, images, rows, len(rows) if everything else SHOWN_PAIRS), end="\n\n")
    print(limits_text(saved.options.pairs))
    if out:
        save(out, json_text(pairs_json(found)))
        print(f"as JSON: {out}")


@app.command()
def doctor(
    run: Run,
    images: Annotated[
        Path | None,
        typer.Option("--images", help="Folder of the photographs, if it is no longer where the run had it."),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="All lines; the first forty if not given.")] = False,
    out: Annotated[Path | None, typer.Option("--json", help="Also write all findings as JSON.")] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes; one per core if not given.")
    ] = None,
) -> None:
    """Every image and circle left out: the threshold that stopped it, its value there, and what would let it in."""
    from stcal.sfm.diagnose import findings
    from stcal.sfm.diagnose.doctor import diagnose
    from stcal.sfm.run.saved import load_run

    saved = load_run(run)
    with StageProgress() as progress:
        diagnosis = diagnose(saved, images, workers, progress)
    print(findings.table(diagnosis, None if everything else findings.MAX_LINES))
    if out:
        save(out, json_text(findings.to_json(diagnosis)))
        print(f"as JSON: {out}")
