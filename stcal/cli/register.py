"""Command ``stcal register``: the transform between two instruments' frames from corresponding points."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from stcal.cli import options as shared
from stcal.cli.options import WRITES, Arg, Opt
from stcal.cli.terminal import print_each, say, write, write_if
from stcal.errors import ConvergenceError, DegenerateError, InputError

Method = Literal["robust", "least-squares", "liu2017"]
"""Method of the fit."""


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
    joined: shared.Joined = shared.JOINED_BY_NAME,
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
    published = {"sample": sample, "share": share, "tries": tries, "orthogonal_within": orthogonality}
    published = {name: value for name, value in published.items() if value is not None}
    if published and method != "liu2017":
        raise InputError("E-OPTION-NEEDS", "--sample, --share, --tries, --orthogonality: only with --method liu2017")
    liu2017 = replace(Liu2017Options(), **published) if method == "liu2017" else None
    source = joined.table(pairs_file, "PAIRS", ("a", "b"))
    pairs = read_pairs(source)
    if not isinstance(source, Path) and any("cov_" in column for column in source.columns):
        say("note: the covariances of --a and --b are not used; the noise of the points is estimated")
    allow_ambiguous |= robot_file is not None  # a bent arm may look like two motions; the kinematics show it
    result = registered(
        pairs.xyz_a,
        pairs.xyz_b,
        model=model,
        method=method,
        threshold_mm=threshold,
        seed=seed,
        liu2017_options=liu2017,
        weights=pairs.weights,
        covariances=pairs.covariances,
        folds=folds,
        allow_ambiguous=allow_ambiguous,
        lines=pairs.lines,
    )
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
            beside = register_with_robot(
                pairs,
                registration,
                load_robot(robot_file),
                source,
                threshold_mm=threshold,
                liu2017_options=liu2017,
                folds=folds,
            )
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
