"""Inputs of the commands of hand-eye, and their options."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from stcal.cli.declare import Arg, Opt
from stcal.cli.options import one_table
from stcal.cli.terminal import print_each

if TYPE_CHECKING:
    from stcal.geometry.rigid import Order
    from stcal.handeye.data.formats.record import Said
    from stcal.workflows.handeye.inputs import Source
    from stcal.workflows.handeye.times import Timing


SetupName = Literal["eye-in-hand", "eye-to-hand"]
"""Name of the setup, by the carrier of the camera."""


SourceFile = Annotated[
    Path | None,
    "Read pose pairs from this file: base_from_flange_… and camera_from_board_… (CSV, JSON, YAML, npz), or "
    "samples of easy_handeye or MoveIt; or photographs of a board from this folder.",
    Arg("POSES|IMAGES"),
]
PosesFile = Annotated[
    Path | None,
    "Read the robot's poses from this file: image, base_from_flange_… (CSV), 4×4 matrices, TUM, Zivid, ROS …; or "
    "from this folder, with a file for each image.",
]
OwnCamera = Annotated[Path | None, "Read the intrinsics from this file: COLMAP cameras.txt, OpenCV or ROS."]
OwnBoard = Annotated[
    Path | None,
    "Read the board from this file, TOML or Kalibr's YAML: dots, chessboard, ChArUco, AprilGrid, asymmetric "
    "circles, tags, or several boards.",
]
SetupOption = Annotated[
    SetupName | None,
    "Choose eye-in-hand, camera on the flange, or eye-to-hand, board on the flange. If not given, the file decides; "
    "if it does not say, eye-in-hand.",
]
RotationOption = Annotated[
    list[str] | None,
    "Read angles in this convention, if the file does not name it: kuka-abc, fanuc-wpr, ur-rotvec, rpy …, rotvec, "
    "xyz (fixed axes), ZYX (moving axes) …; robot=… or camera=… for one side.",
]
LengthUnit = Annotated[
    list[str] | None,
    "Take lengths in this unit, if the file does not name it: mm, m, cm, um, in; robot=… or camera=… for one side.",
]
PosesAre = Annotated[
    list[str] | None,
    "Take poses in this direction, if the file does not name it: base_from_flange or flange_from_base, and "
    "camera_from_board or board_from_camera; once for each side.",
]
TimeTolerance = Annotated[
    float,
    "Take the robot's nearest pose within this time, s, if none can be interpolated.",
    Opt(min=0, max=3600),
]


def source_of(
    source: Path | None,
    first: Path | None,
    second: Path | None,
    key: str,
    statements: "Said",
    quaternions: "Order",
    timing: "Timing | None" = None,
    columns: Path | None = None,
    columns_a: Path | None = None,
) -> "Source":
    """Returns the file or folder given as argument, or --a and --b joined, for any of the formats."""
    from stcal.workflows.handeye.inputs import one_source
    from stcal.workflows.handeye.times import Timing

    maps = columns_a, columns
    if source is None and first is not None and second is not None:
        told, notes = one_source(first, second, key, statements, quaternions, timing or Timing(), maps)
        print_each("note", notes)
        return told
    if source is not None and columns is not None and source.is_file():
        return one_source(source, None, key, statements, quaternions, timing or Timing(), maps)[0]
    if source is not None and source.is_dir():
        columns = None  # of the robot's poses
    return one_table(source, first, second, key, "POSES|IMAGES", columns=columns, columns_a=columns_a)
