"""Command ``stcal handeye rig``: several cameras of one robot, solved together."""

from pathlib import Path
from typing import Annotated

from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.handeye.inputs import LengthUnit, PosesAre, RotationOption, TimeTolerance
from stcal.cli.terminal import StageProgress, print_each, say, write_if
from stcal.io.files import keep_apart


def rig(
    rig_file: Annotated[
        Path,
        "Read setup, board, the robot's poses, and the images and intrinsics of each camera from this file (TOML).",
        Arg("RIG.toml"),
    ],
    refine_camera: Annotated[
        bool, "Adjust the intrinsics of each camera too, starting from its file and weighted by their σ."
    ] = False,
    with_scale: Annotated[bool, "Find the board's true size from the robot's motion."] = False,
    rotation: RotationOption = None,
    length_unit: LengthUnit = None,
    poses_are: PosesAre = None,
    quaternions: shared.Quaternions = "wxyz",
    time_tolerance: TimeTolerance = 0.02,
    held_out: Annotated[
        int | None,
        "Hold out this many of the robot's poses in each split; a quarter of them if not given.",
        Opt(min=1, max=100_000),
    ] = None,
    splits: Annotated[int, "Cross-validate over this many splits; 0 for none.", Opt(min=0, max=100_000)] = 15,
    seed: Annotated[int, "Draw the splits with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    out: Annotated[Path | None, "Write the result to this file (JSON).", WRITES] = None,
    workers: shared.Workers = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
    strict: shared.Strict = False,
) -> None:
    """Find where several cameras are on one flange, or in one base, and relative to each other, in one adjustment."""
    from stcal.handeye.data.rig import read_rig_file
    from stcal.handeye.report.file import HandEyeRigFile
    from stcal.handeye.report.outcome import rig_judged
    from stcal.handeye.report.rig_page import rig_report
    from stcal.workflows.handeye.rig import calibrate_handeye_rig, read_handeye_rig

    files = read_rig_file(rig_file)
    written = {"--out": out, "--json": json_file, "--report": report}
    keep_apart([(name, path) for name, path in written.items() if path], files.read())
    with StageProgress() as progress:
        inputs = read_handeye_rig(
            files,
            rotation=rotation or (),
            length_unit=length_unit or (),
            poses_are=poses_are or (),
            quaternions=quaternions,
            tolerance_s=time_tolerance,
            workers=workers,
            progress=progress,
        )
        print_each("understood", inputs.understood)
        outcome = calibrate_handeye_rig(
            inputs,
            refine_camera,
            with_scale,
            repeats=splits,
            held_out=held_out,
            seed=seed,
            workers=workers,
            progress=progress,
        )
    document = rig_report(outcome)
    say(document.text())
    for name, what, why in outcome.left_out():
        say(f"left out {name}: {what}: {why}")
    print_each("note", outcome.all_notes())
    write_if(out, lambda: HandEyeRigFile.of(outcome))
    write_if(report, document.page)
    write_if(json_file, lambda: HandEyeRigFile.of(outcome, whole=True))
    shared.require_passed(strict, rig_judged(outcome).failed(), report, rig_judged(outcome).doubt())
