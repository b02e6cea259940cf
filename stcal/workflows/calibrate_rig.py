"""Calibration of the cameras of a rig from a folder that has one folder of photographs for each camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stcal.boards.design import CharucoDesign, FlatBoard
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.io.cameras.forms import kalibr_chain
from stcal.io.cameras.model import CalibratedCamera, cameras_txt
from stcal.io.images import name_fault
from stcal.io.json import ResultFile
from stcal.io.saving import json_text
from stcal.parallel import Progress
from stcal.sfm.camera.calibrate import CameraCalibration, calibrate_camera
from stcal.sfm.camera.file import CalibrationFile, RigCalibrationFile
from stcal.sfm.camera.rig import RigCalibration, calibrate_rig
from stcal.workflows.calibrate_camera import calibrate_camera_by_corners, corner_grid

RIG_FILE, CHAIN_FILE = "rig.json", "camchain.yaml"
TAKEN = ("rig", "camchain")
"""Camera names whose files would overwrite these files."""


@dataclass(frozen=True, slots=True)
class Models:
    """Lens models: ``own`` by camera, ``common`` for the other cameras."""

    own: Mapping[str, str]
    common: str

    @classmethod
    def of(cls, given: Sequence[str], default: str) -> "Models":
        """Returns the models from words NAME=MODEL, and one word MODEL.

        Raises
        ------
        InputError
            Two models for one camera, or two words MODEL.
        """
        model_of: dict[str, str] = {}
        common = [word for word in given if "=" not in word]
        for word in given:
            name, separator, model = word.rpartition("=")
            if separator and name in model_of:
                raise InputError(
                    "E-OPTION-REPEATED", f"--model {word}: {name} has {model_of[name]} already; one for each camera"
                )
            if separator:
                model_of[name] = model
        if len(common) > 1:
            raise InputError(
                "E-OPTION-CONFLICT",
                f"--model {common[1]}: {common[0]} is given too; one for all, or NAME=MODEL for each",
            )
        return cls(model_of, common[0] if common else default)


def calibrate_rig_from_photographs(
    folder: Path,
    target: TargetDesign,
    board: BoardDesign | FlatBoard,
    models: Models,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RigCalibration:
    """Calibrate each camera by itself, then all together.

    Parameters
    ----------
    folder
        Folder with a folder of photographs for each camera; images of one instant have the same name in all.
    target, board, workers, progress
        As in :func:`calibrate_camera`; boards of corners are possible too.
    models
        COLMAP's models, or ``auto``.

    Raises
    ------
    StcalError
        One of its subclasses; the message names the camera.
    """
    names = camera_names(folder)
    unknown = [name for name in models.own if name not in names]
    if unknown:
        raise InputError(
            "E-OPTION-VALUE", f"--model {unknown[0]}=…: no folder {unknown[0]} in {folder}; it has {', '.join(names)}"
        )
    grid = board if isinstance(board, BoardDesign) else corner_grid(board)
    cameras: dict[str, CameraCalibration] = {}
    for name in names:
        model = models.own.get(name, models.common)

        def step(stage: str, done: int, total: int, name=name) -> None:
            if progress:
                progress(f"{name}: {stage}", done, total)

        try:
            if isinstance(board, BoardDesign):
                calibration = calibrate_camera(folder / name, target, board, model, workers=workers, progress=step)
            else:
                calibration = calibrate_camera_by_corners(folder / name, board, model, workers, step)
        except StcalError as error:
            raise type(error)(error.code, f"rig: {name}: {error}") from error
        cameras[name] = calibration
    return calibrate_rig(cameras, grid, isinstance(board, CharucoDesign))


def camera_names(folder: Path) -> list[str]:
    """Returns the names of the folders in a folder.

    Raises
    ------
    InputError
        Not a folder, fewer than two folders in it, or names that no file can have.
    """
    if not folder.is_dir():
        raise InputError(
            "E-IMAGES-FOLDER",
            f"rig folder {folder}: {'not a folder' if folder.exists() else 'does not exist'}; give one",
        )
    names = sorted(
        subfolder.name for subfolder in folder.iterdir() if subfolder.is_dir() and not subfolder.name.startswith(".")
    )
    if len(names) < 2:
        raise InputError(
            "E-RIG-CAMERAS",
            f"rig folder {folder}: {len(names)} folders in it, one for each of two cameras and more needed; put "
            "photographs into <camera>/, or leave --rig away",
        )
    for name in names:
        fault = "is that of a file of the result" if name.lower() in TAKEN else name_fault(name)
        if fault or not name.isprintable():
            raise InputError(
                "E-RIG-CAMERAS", f"rig folder {folder}: camera name {name!r} {fault or 'is not printable'}; rename it"
            )
    return names


def files_of(rig: RigCalibration) -> tuple[dict[str, str], list[str]]:
    """Returns the contents of the files by name, and what is missing, with the reason.

    The files are a camera file and its JSON for each camera, ``rig.json``, and ``camchain.yaml`` where Kalibr has
    models for the lenses.
    """
    files, cameras = {}, []
    for name, calibration in zip(rig.names, rig.cameras, strict=True):
        intrinsics = calibration.intrinsics
        camera = CalibratedCamera.of(intrinsics.camera, intrinsics.colmap_model, intrinsics.covariance)
        files |= {f"{name}.txt": cameras_txt(camera), f"{name}.json": json_text(CalibrationFile.of(calibration))}
        cameras.append((name, camera))
    summary: ResultFile = RigCalibrationFile.of(rig)
    files[RIG_FILE] = json_text(summary)
    missing = []
    try:
        chain = [(*named_camera, pose) for named_camera, pose in zip(cameras, rig.camera_from_first, strict=True)]
        files[CHAIN_FILE] = kalibr_chain(chain)
    except InputError as error:
        missing.append(f"no {CHAIN_FILE}: {error}")
    return files, missing
