"""Scale and faces from COLMAP models that someone made or edited elsewhere: the native mapper, the GUI."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from stcal.errors import InputError, MappingError
from stcal.geometry.camera import Camera
from stcal.io.files import json_text, save
from stcal.parallel import one_thread
from stcal.sfm.adjust.calibration import Calibration, calibrate
from stcal.sfm.adjust.file import FacesFile
from stcal.sfm.adjust.options import AdjustOptions
from stcal.sfm.data.model import WorldModel
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import ReadModel, find_models, read_model
from stcal.sfm.runs.saved import SavedRun

Chained = Literal["chain", "paper"]


def _options(run: SavedRun, solve: Chained) -> AdjustOptions:
    options = replace(run.options, solve=solve)
    if solve == "paper":
        options = replace(options, frame="three-point", eccentricity=False)
    return options.adjustment(run.target)


def faces_from_models(read: Sequence[ReadModel], run: SavedRun, solve: Chained = "chain") -> Calibration:
    """Our scale and face stages, group by group and chained, on models of the run's groups as they are; or as
    Zhang & Wei (2017) have these stages, with ``solve`` ``paper``.

    Raises
    ------
    InputError
        The models state different cameras.
    ScaleError
        A group's board is not in its model.
    MappingError
        The reference face is in none of the models, or a face is not linked to it.
    """
    models: dict[str, WorldModel] = {}
    notes = []
    for source in read:
        if not source.camera.same_as(read[0].camera):
            raise InputError(
                "E-MODEL-CAMERAS",
                f"models {read[0].path}, {source.path}: different cameras; keep the intrinsics fixed in the mapper, "
                "or give one model at a time",
            )
        if not source.camera.same_as(run.camera):
            notes.append(
                f"model {source.path}: its camera is up to {_camera_change_px(source.camera, run):.2g} px off the "
                "run's at the keypoints; the model's is used"
            )
        if source.unlabelled:
            notes.append(
                f"model {source.path}: points left out, since their keypoints name no one circle: {source.unlabelled}"
            )
        if source.split:
            notes.append(
                f"model {source.path}: circles that are several points each, longest tracks taken: {source.split}"
            )
        if source.absent:
            notes.append(
                f"model {source.path}: points that keypoints name, but the model does not have: {source.absent}"
            )
        for model in source.groups:
            if model.group in models:
                notes.append(f"group {model.group}: in several models; the one with the most images was taken")
            if model.group not in models or len(model.images) > len(models[model.group].images):
                models[model.group] = model
    notes += [f"group {name}: in none of the models" for name in run.groups() if name not in models]
    options = _options(run, solve)
    ordered = [models[name] for name in run.groups() if name in models]
    try:
        calibration = calibrate(ordered, read[0].camera, run.target, run.board, options)
    except MappingError as error:
        raise MappingError(error.code, "; ".join([str(error), *notes])) from error
    return replace(calibration, notes=(*notes, *calibration.notes))


@one_thread()
def calibrate_models(model: Path, run: SavedRun, solve: Chained = "chain") -> Calibration:
    """Scale and faces from a COLMAP model, or the models in a folder, that rest on the run's database."""
    ids = image_ids(run.observations)
    read = [read_model(path, run.observations, ids, run.corrected_px) for path in find_models(model)]
    return faces_from_models(read, run, solve)


def write_faces(path: Path, calibration: Calibration, run: SavedRun, solve: Chained = "chain") -> None:
    """``faces.json`` of models that were chained."""
    options = _options(run, solve)
    faces = FacesFile.of(calibration.target, run.target, options, calibration.sigma_factors.circles)
    save(path, json_text(faces.content()))


def _camera_change_px(camera: Camera, run: SavedRun) -> float:
    """How far another camera moves the images of what the run's keypoints show, at most."""
    ideal = np.concatenate([image.centre for image in run.observations])
    return float(np.abs(camera.pixel_from_normalised(ideal) - run.camera.pixel_from_normalised(ideal)).max())
