"""``stcal register``: the transform between two instruments' frames from corresponding points."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.saving import keep_apart, save, save_json
from stcal.errors import ConvergenceError, DegenerateError, InputError


class Model(StrEnum):
    """Of the transform."""

    rigid = "rigid"
    similarity = "similarity"
    affine = "affine"


class Method(StrEnum):
    """Of the fit."""

    robust = "robust"
    least_squares = "least-squares"
    liu2017 = "liu2017"


def register(
    pairs_file: Annotated[
        Path, typer.Argument(metavar="PAIRS", help="ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm of the same points (CSV).")
    ],
    model: Annotated[Model, typer.Option(help="Of the transform.")] = Model.rigid,
    method: Annotated[Method, typer.Option(help="liu2017: a published method, always affine.")] = Method.robust,
    threshold: Annotated[
        float | None, typer.Option(help="Inliers are nearer than this, mm; estimated from the data if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random samples and of the cross-validation.")] = 0,
    folds: Annotated[int, typer.Option(min=0, help="Of the cross-validation; 0 for none.")] = 6,
    allow_ambiguous: Annotated[
        bool, typer.Option("--allow-ambiguous", help="Answer even where another transform is about as good.")
    ] = False,
    robot_file: Annotated[
        Path | None,
        typer.Option("--robot", help="Robot file (TOML), with q1_deg … in PAIRS: solve base and kinematics together."),
    ] = None,
    identified: Annotated[
        Path | None, typer.Option("--identified", help="With --robot: the identified robot (TOML).")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Everything (JSON).")] = None,
    report: Annotated[Path | None, typer.Option("--report", help="A page with tables and pictures (HTML).")] = None,
) -> None:
    """b_from_a from points measured in two frames, some of which may be wrong; with σ, outliers and where it holds."""
    from stcal.register import register as registered
    from stcal.register.core.pairs import read_pairs
    from stcal.register.report.file import registration_json
    from stcal.register.report.page import registration_page, registration_text
    from stcal.register.workspace.findings import findings

    keep_apart({"--out": out, "--report": report, "--identified": identified}, (pairs_file, robot_file))
    if identified and not robot_file:
        raise InputError(f"--identified {identified}: only with --robot FILE")
    pairs = read_pairs(pairs_file)
    allow_ambiguous |= robot_file is not None  # a bent arm may look like two motions; the kinematics tell
    options = {"model": model.value, "method": method.value, "threshold_mm": threshold, "seed": seed}
    result = registered(
        pairs.xyz_a,
        pairs.xyz_b,
        **options,
        weights=pairs.weights,
        covariances=pairs.covariances,
        folds=folds,
        allow_ambiguous=allow_ambiguous,
        lines=pairs.lines,
    )
    found = findings(pairs.where, pairs.lines, pairs.xyz_a, pairs.xyz_b, result, pairs.weights, pairs.covariances)
    print(registration_text(found))
    for note in result.notes:
        print(f"warning: {pairs.where}: {note}")
    content, sections, failed = registration_json(found), [], None
    if robot_file:
        from stcal.robot.kinematics.file import robot_toml
        from stcal.workflows.register_robot import compared, comparison_json, comparison_section, comparison_text

        try:
            beside = compared(pairs, pairs_file, robot_file, found, options, folds)
            print("", comparison_text(beside), sep="\n")
            content["robot"] = comparison_json(beside)
            sections.append(comparison_section(beside))
            if identified:
                comments = [f"Identified from {pairs_file.name}: {beside.identified.rank} parameters."]
                save(identified, robot_toml(beside.identified.robot, comments))
        except (DegenerateError, ConvergenceError) as error:  # the transform stands all the same
            failed = error
    save_json(out, content)
    if report:
        save(report, registration_page(found, sections))
    if failed is not None:
        raise failed
