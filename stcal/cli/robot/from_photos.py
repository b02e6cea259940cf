"""Command ``stcal robot from-photos``: joint values from photographs of the target on an arm."""

from pathlib import Path
from typing import Annotated

from stcal.cli.declare import Arg
from stcal.cli.options import CameraFile, RobotFile, TargetFile, Workers, load_ahead
from stcal.cli.robot.identify import Model
from stcal.cli.terminal import StageProgress, print_each, say


def from_photos(
    images: Annotated[Path, "Read the photographs of this folder and of its subfolders.", Arg("VIEWS")],
    camera: CameraFile,
    faces: Annotated[Path, "Read the calibrated target from this faces.json."],
    joints: Annotated[Path, "Read the joint values of each photograph from this file, matched by --key (CSV)."],
    robot_file: RobotFile,
    out: Annotated[
        Path,
        "Write all results to this new folder. For more options, use its poses.csv, which has the joint values, in "
        "robot axes and identify, and its identified.toml in robot compensate.",
    ],
    targets: Annotated[
        Path | None, "Compute joint values for the poses in this file, or for the poses at its joint values (CSV)."
    ] = None,
    target: TargetFile = None,
    board: Annotated[Path | None, "Identify the dots of the board in this board.toml, if the board is in view."] = None,
    model: Annotated[Model, "Take the arm as rigid, or as elastic; auto chooses by held-out rows."] = "rigid",
    partial: Annotated[bool, "Keep parameters that the photographs do not determine nominal."] = False,
    key: Annotated[str, "Match photographs and joint values by this column."] = "image",
    columns: Annotated[Path | None, "Read --joints with the columns, delimiter … of this file (TOML)."] = None,
    workers: Workers = None,
) -> None:
    """Measure the target on an arm in photographs, find axes and kinematics, and compensate poses, in one folder."""
    load_ahead(workers)
    from stcal.io.cameras.read import read_camera
    from stcal.io.design import load_board, target_of
    from stcal.io.files import require_new_folder, save_folder
    from stcal.robot.identification.result import IdentifyOptions
    from stcal.robot.kinematics.file import load_robot
    from stcal.sfm.measurement.images import MeasureOptions
    from stcal.sfm.measurement.target import read_target
    from stcal.workflows.from_photos.result import files_of, require_files_written, story
    from stcal.workflows.from_photos.run import robot_from_photos

    require_new_folder(out, images)
    design = target_of(target)
    with StageProgress() as progress:
        result = robot_from_photos(
            images,
            read_camera(camera),
            read_target(faces, design),
            design,
            joints,
            load_robot(robot_file),
            targets,
            load_board(board) if board else None,
            key,
            MeasureOptions(workers=workers),
            IdentifyOptions(model=model, partial=partial),
            progress,
            columns,
        )
    print_each("note", result.notes)
    for line in story(result):
        say(line)
    save_folder(out, files_of(result))
    require_files_written(out, result)
    say(f"report: {out / 'report.html'}")
