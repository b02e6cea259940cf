"""The output folder: the files of every step by the names of its own command, all or none."""

from stcal.io.saving import json_text
from stcal.robot.axes.report import axes_file, axes_page
from stcal.robot.identification.report import identified_file, identified_page
from stcal.robot.kinematics.file import robot_toml
from stcal.robot.use.compensation import (
    compensated_csv,
    compensation_file,
)
from stcal.robot.use.report import compensation_page
from stcal.sfm.measurement.output import poses_csv, poses_file
from stcal.sfm.measurement.report import measure_page
from stcal.workflows.from_photos.report import from_photos_page
from stcal.workflows.from_photos.result import FromPhotos

POSES = "poses.csv"


def files_of(result: FromPhotos) -> dict[str, str]:
    """Returns the contents of all files, by name."""
    identified, compensated = result.identified.robot, result.compensated
    files = {
        POSES: poses_csv(result.measured)[0],
        "poses.json": json_text(poses_file(result.measured)),
        "poses.html": measure_page(result.measured, result.images),
    }
    if result.axes is not None:
        files |= {
            "axes.toml": robot_toml(result.axes.robot, ["Identified by the axis method from the sweeps."]),
            "axes.json": json_text(axes_file(result.axes)),
            "axes.html": axes_page(result.axes, result.data.where),
        }
    source = f"Identified from {result.data.where}: {result.identified.rank} parameters."
    files |= {
        "identified.toml": robot_toml(identified, [source]),
        "identified.json": json_text(identified_file(result.identified, result.nominal)),
        "identified.html": identified_page(result.identified, result.nominal),
    }
    if compensated is not None:
        files |= {
            "compensated.csv": compensated_csv(compensated, identified),
            "compensated.json": json_text(compensation_file(compensated, identified)),
            "compensated.html": compensation_page(compensated, identified),
        }
    return files | {"report.html": from_photos_page(result, tuple(files))}
