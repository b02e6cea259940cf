"""Commands ``stcal-sfm run``, ``detect``, ``report`` and ``budget``; and those that exchange with COLMAP and others."""

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Annotated, Literal

import typer

from stcal.cli import options as shared
from stcal.cli.options import WRITES, Arg, Opt, Run
from stcal.cli.terminal import StageProgress, print_each, say, verbose, write, write_if
from stcal.errors import ChecksFailed, InputError, MappingError, StcalError
from stcal.io.files import keep_apart

app = typer.Typer()
Solve = Literal["joint", "chain", "paper"]  # way in which the groups are solved


@app.command()
def run(
    images: shared.Images,
    out: Annotated[Path, "Write the run to this folder, which must be new, empty, or of an earlier run."],
    camera: shared.OptionalCamera = None,
    target: shared.TargetFile = None,
    board: shared.BoardFile = None,
    solve: Annotated[
        Solve | None,
        "Use joint, one adjustment over all groups (default); chain, group by group; or paper, the whole method of "
        "Zhang & Wei (2017) as published, including detection, for comparison.",
    ] = None,
    reference_face: Annotated[
        str | None, "Take the frame of this face as the target frame; the first if not given."
    ] = None,
    eccentricity: Annotated[
        bool,
        "Correct the eccentricity of circles; without it, as a control, groups are chained.",
        Opt("--eccentricity/--no-eccentricity"),
    ] = True,
    max_angle: Annotated[
        float | None,
        "Reject an initial pair with a larger median ray angle, degrees; 60, or the smallest, if not given.",
        Opt(min=2, max=170),
    ] = None,
    flatness: Annotated[str, "Set the σ of circles about the plane of their face, mm, or off."] = "0.02",
    refine_camera: Annotated[bool, "Adjust the given intrinsics too, weighted by their σ."] = False,
    rim: Annotated[
        bool | None,
        "Compute the height of rims in front of the circles, and give the faces of the surface behind them; if not "
        "given, where the radii show a rim for certain.",
        Opt("--rim/--no-rim"),
    ] = None,
    board_only: Annotated[bool, "Use only the board, even if other circles are in view: λ and residuals."] = False,
    compare: Annotated[
        Literal["paper"] | None, "Solve as published too (paper), and show what each later step improves."
    ] = None,
    exclude: shared.Exclude = None,
    every: Annotated[
        str | None,
        "Take frames from a video that is given as IMAGES: the sharpest of this many frames, or of each stretch in "
        "which the view hardly changes (auto, the default).",
        Opt(metavar="FRAMES"),
    ] = None,
    expect_faces: Annotated[
        str | None,
        "End with exit code 4 if one of these faces, such as 1,2, is missing from the result. If not given, the faces "
        "in the names of the groups, such as 12, are expected.",
        Opt(metavar="FACES"),
    ] = None,
    strict: shared.StrictByDefault = True,
    detection: shared.DetectionOptions = shared.DETECTION,
) -> None:
    """Calibrate the target: detect, map, scale, chain and adjust; writes faces.json and report.html."""
    shared.load_ahead(detection.workers)
    import numpy as np

    from stcal.sfm import pipeline
    from stcal.sfm.mapping.pairs import PairOptions
    from stcal.sfm.runs.folder import found_lines, run_text
    from stcal.sfm.runs.run_options import RunOptions
    from stcal.sfm.runs.transaction import is_finished

    options = RunOptions(
        solve=solve,
        eccentricity=eccentricity,
        reference_face=reference_face,
        flatness_mm=_flatness(flatness),
        refine_camera=refine_camera,
        rim=rim,
        board_only=board_only,
        compare=compare,
        pairs=PairOptions(None if max_angle is None else float(np.radians(max_angle))),
        ellipses=detection.ellipses(),
        workers=detection.workers,
        exclude=tuple(exclude or ()),
        expect_faces=() if expect_faces is None else tuple(face.strip() for face in expect_faces.split(",")),
    )
    lines, notes = "", StringIO()  # of what was assumed and noted: the verdict is the first line
    try:
        assumed, elsewhere = shared.designs_told(target, board), detection.handed_over()
        with redirect_stdout(notes), assumed, elsewhere, StageProgress() as told:
            result = pipeline.run(images, camera, out, target, board, options, told, every=every)
        lines = run_text(result)
    except StcalError as error:
        if (page := out / "report.html").exists() and not is_finished(out):
            error.append(f"; {page} shows the images")
        raise
    finally:
        for text in filter(None, (lines, notes.getvalue().rstrip())):
            say(text)
    if verbose():
        say("\n".join(found_lines(result.labelled)))
    judgement, faces = result.judgement, {face.id for face in result.target_design.faces}
    has_faces = bool(result.target.target_from_face)  # a run of the board alone has none, and was asked for none
    if has_faces and judgement is not None and judgement.verdict != "yes":
        is_no, verdict = judgement.verdict == "no", f"may I use it? {judgement.use.removesuffix('.')}"
        reasons = [verdict] if is_no or faces.intersection(judgement.missing) else []
        but = "do not use them" if is_no else "without faces that were expected"
        shared.require_usable(strict, reasons, out / "report.html", verdict, but)


@app.command()
def detect(
    images: shared.Images,
    camera: shared.OptionalCamera = None,
    out: Annotated[Path, "Write detections.csv and overlays/ to this folder."] = Path("detect"),
    target: shared.TargetFile = None,
    board: shared.BoardFile = None,
    solve: Annotated[Solve | None, "Detect as `run` does with this option."] = None,
    exclude: shared.Exclude = None,
    detection: shared.DetectionOptions = shared.DETECTION,
) -> None:
    """Detect circles only, and write detections.csv and an overlay picture of every image."""
    shared.load_ahead(detection.workers)
    from stcal.sfm.pipeline import detect_images
    from stcal.sfm.runs.folder import found_in_all, found_lines, skipped_lines
    from stcal.sfm.runs.run_options import RunOptions

    options = RunOptions(
        solve=solve, ellipses=detection.ellipses(), workers=detection.workers, exclude=tuple(exclude or ())
    )
    with shared.designs_told(target, board), detection.handed_over(), StageProgress() as progress:
        found = detect_images(images, camera, out, target, board, options, progress)
    print_each("note", found.notes)
    say("\n".join([*found_lines(found.labelled), *skipped_lines(found.detection), found_in_all(found.labelled)]))
    say(f"detections: {out / 'detections.csv'}\noverlays:   {out / 'overlays'}")
    if not any(len(image.observations) for image in found.labelled):
        raise ChecksFailed("E-NOTHING-SEEN", f"{images}: {found_in_all(found.labelled)}; look at the overlays")


@app.command()
def report(
    run: shared.Run,
    pdf: Annotated[bool, "Also write the page as PDF beside it (needs the extra `pdf`)."] = False,
    out: Annotated[Path | None, "Write the page to this file (HTML), instead of into the run's folder.", WRITES] = None,
) -> None:
    """Write the report of a finished run again from the files in its folder, as a page and as a PDF."""
    from stcal.sfm.runs.folder import report_again

    if pdf and out is not None:
        keep_apart([("--pdf", out.with_suffix(".pdf"))], [("RUN", run)])
    say(report_again(run, pdf, out).text())


def _flatness(text: str) -> float | None:
    if text == "off":
        return None
    try:
        return float(text)
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--flatness {text}: a σ in mm, more than 0, or off") from error


@app.command()
def budget(
    run: shared.Run,
    statement: Annotated[
        Path | None, "Read temperatures, expansion, σ of the pitch and header from this file (TOML)."
    ] = None,
    field: Annotated[
        list[str] | None, "Write NAME=VALUE into the header, such as operator='A. Smith'; repeat it."
    ] = None,
    check_lengths: Annotated[
        Path | None, "Compare distances with the lengths in this file (CSV: from, to, length_mm, sigma_mm)."
    ] = None,
    lengths: Annotated[Path | None, "Compare the longest distances with the second calibration in this folder."] = None,
    lengths_statement: Annotated[Path | None, "Read the statement of that second calibration from this file."] = None,
    page: shared.ReportFile = None,
    pdf: Annotated[bool, "Also write the page as PDF beside it (needs the extra `pdf`)."] = False,
    out: shared.JsonFile = None,
    strict: shared.StrictByDefault = True,
) -> None:
    """Compute the uncertainty budget (GUM) of the faces and of the target's longest distances, by contributions."""
    from stcal.report.document import pdf_of, require_pdf
    from stcal.sfm.budget.budget_page import budget_in_brief, uncertainty_budget
    from stcal.sfm.budget.combine import fields_of

    if pdf and page is None:
        raise InputError("E-OPTION-NEEDS", "--pdf: the PDF stands beside the page; give that with --report FILE.html")
    if pdf and page is not None:
        keep_apart([("--pdf", page.with_suffix(".pdf"))], [("RUN", run)])
        require_pdf()
    fields = fields_of(field or ())
    result = uncertainty_budget(run, statement, fields, check_lengths, lengths, lengths_statement)
    say(result.document().text() if verbose() else budget_in_brief(result.file, page is not None))
    write_if(out, lambda: result.file, "as JSON")
    if page:
        html = result.document().page()
        write(page, html, "report")
        if pdf:
            write(page.with_suffix(".pdf"), pdf_of(html), "PDF")
    shared.require_usable(strict, result.refusals, page)


LIMIT = Opt(min=0, max=1e6)


def _warn_of_failures(run: Path) -> None:
    from stcal.sfm.planning.advise import failures_of
    from stcal.sfm.runs.saved import load_run

    if failures := failures_of(load_run(run)):
        print_each("warning", [f"{failures}: do not use what was written"])


@app.command(name="export-database")
def export_database(
    run: Run,
    out: Annotated[Path, "Write the copy to this file, which must be new.", Arg("OUT.db", writes=True)],
    schema: Annotated[str, "Write for this version of COLMAP: 3.8, 3.9, 3.10, 3.11, 3.12, 3.13, 4.0, 4.1, 4.2."],
) -> None:
    """Copy the run's database in the form of COLMAP 3.8, which later versions open; ids and values stay the same."""
    from stcal.sfm.interop.export_colmap import export_database as export

    say(export(run, out, schema).text)


@app.command(name="export-model")
def export_model(
    run: Run,
    out: Annotated[Path, "Write to this new or empty folder.", Arg("OUT")],
    kind: Annotated[str, "Write this format: colmap-bin or colmap-txt.", Opt("--format")],
) -> None:
    """Write the run's final model in mm, in the target frame, for other programs, with a file of labels."""
    from stcal.sfm.interop.export_colmap import export_model as export

    say(export(run, out, kind).text)
    _warn_of_failures(run)


@app.command(name="export")
def export_run(
    run: Run,
    out: Annotated[
        Path,
        "Write this new file; its suffix selects the form: .urdf, .xacro, .yaml (tf2), .py (a launch file of "
        "ROS 2), .yml (OpenCV) or .csv.",
        Arg("FILE", writes=True),
    ],
    form: Annotated[str, "Write this form: urdf, xacro, tf2, ros2, opencv or csv."] = "",
    name: Annotated[str, "Name the target frame NAME; faces are then NAME_FACE, circles NAME_FACE_CIRCLE."] = "target",
) -> None:
    """Write faces and circles for robots and other programs, with σ if the form can hold them."""
    from stcal.sfm.interop.export import export_run as export

    say(export(run, out, form, name).text)
    _warn_of_failures(run)


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
    from stcal.sfm.interop.crosscheck import crosscheck as cross_checked
    from stcal.sfm.runs.comparisons import Tolerances

    tolerances = Tolerances(
        tolerance_um, tolerance_mdeg, tolerance_um, camera_tolerance_um, camera_tolerance_mdeg, tolerance_sigma
    )
    with StageProgress() as progress:
        check = cross_checked(run, colmap, tolerances, timeout, progress, into_report=True)
    say(comparison_text(check))
    say(f"report: {run / 'report.html'}")
    if check.differences:
        differ = f"native COLMAP {check.native} and stcal differ: {'; '.join(check.differences)}"
        raise MappingError("E-CROSSCHECK-DIFFERS", f"cross-check: {differ}")


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
    from stcal.sfm.interop.crosscheck import calibrate_models, faces_text
    from stcal.sfm.runs.saved import load_run

    if out is not None and not out.parent.is_dir():
        raise InputError("E-OUTPUT-FOLDER", f"{out}: no folder {out.parent}; make it, or give another place with --out")
    saved = load_run(run)
    calibration = calibrate_models(model, saved, solve, out)
    say(faces_text(calibration, saved))
    if out is not None:
        say(f"faces: {out}")
