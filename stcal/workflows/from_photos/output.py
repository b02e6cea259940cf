"""The folder: every step's files by the names of its own command, all or none."""

import tempfile
from pathlib import Path

from stcal.errors import InputError
from stcal.io.saving import json_text, real_place, save
from stcal.robot.axes.report import axes_file, axes_page
from stcal.robot.identify.report import identified_file, identified_page
from stcal.robot.kinematics.file import robot_toml
from stcal.robot.use.compensation import (
    compensated_csv,
    compensation_file,
)
from stcal.robot.use.report import compensation_page
from stcal.sfm.measure.output import poses_csv, poses_file
from stcal.sfm.measure.report import measure_page
from stcal.workflows.from_photos.report import from_photos_page
from stcal.workflows.from_photos.result import FromPhotos

POSES = "poses.csv"


def files_of(result: FromPhotos) -> dict[str, str]:
    """By name, all that is written."""
    identified, found = result.identified.robot, result.compensated
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
    said = f"Identified from {result.data.where}: {result.identified.rank} parameters."
    files |= {
        "identified.toml": robot_toml(identified, [said]),
        "identified.json": json_text(identified_file(result.identified, result.nominal)),
        "identified.html": identified_page(result.identified, result.nominal),
    }
    if found is not None:
        files |= {
            "compensated.csv": compensated_csv(found, identified),
            "compensated.json": json_text(compensation_file(found, identified)),
            "compensated.html": compensation_page(found, identified),
        }
    return files | {"report.html": from_photos_page(result, tuple(files))}


def require_new_folder(out: Path, images: Path) -> None:
    """Refuse, before the work, a place that holds anything, that lies among the photographs or cannot be written.

    Raises
    ------
    InputError
        Which.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: is not a new or empty folder; give another place")
    if real_place(images) in (real_place(out), *real_place(out).parents):
        raise InputError(f"--out {out}: lies in the folder of the photographs {images}; give another place")
    above = next(each for each in out.absolute().parents if each.exists())
    try:
        tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=above).cleanup()
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror or error}; give another place") from error


def save_folder(out: Path, files: dict[str, str]) -> None:
    """Write all files into a new folder, or none.

    Raises
    ------
    InputError
        They cannot be written.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as folder:
        made = Path(folder) / "made"
        for name, content in files.items():
            save(made / name, content)
        try:
            made.replace(out)
        except OSError as error:
            raise InputError(f"{out}: cannot be written: {error.strerror or error}; give another place") from error
