"""Scale and faces from COLMAP models that were made or edited elsewhere, by the native mapper or in the GUI."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from stcal.errors import InputError, MappingError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.files import json_text, save
from stcal.parallel import one_thread
from stcal.sfm.adjust.calibration import Calibration, calibrate
from stcal.sfm.adjust.file import FacesFile, require_faces_written
from stcal.sfm.adjust.options import AdjustOptions
from stcal.sfm.data.model import WorldModel
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import ReadModel, find_models, read_model
from stcal.sfm.runs.saved import AnyRun, SavedRun, saved_run

Chained = Literal["chain", "paper"]


def _options(run: SavedRun, solve: Chained) -> AdjustOptions:
    options = replace(run.options, solve=solve, refine_camera=False)
    if solve == "paper":
        options = replace(options, frame="three-point", eccentricity=False)
    return options.adjustment(run.target_design)


def faces_from_models(read: Sequence[ReadModel], run: SavedRun, solve: Chained = "chain") -> Calibration:
    """Returns scale and faces of unchanged models of the run's groups, group by group and chained.

    ``solve`` : ``chain`` for our stages, ``paper`` for those of Zhang & Wei (2017).

    Raises InputError if the models state different cameras. Raises ScaleError: if the board of a group is not in its
    model. Raises MappingError if the reference face is in none of the models, or a face is not linked to it.
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
    models_in_order = [models[name] for name in run.groups() if name in models]
    try:
        calibration = calibrate(models_in_order, read[0].camera, run.target_design, run.board_design, options)
    except MappingError as error:
        raise MappingError(error.code, "; ".join([str(error), *notes])) from error
    return replace(calibration, notes=(*notes, *calibration.notes))


@require_arguments
@one_thread()
def calibrate_models(
    model: str | Path, run: AnyRun, solve: Chained = "chain", out: str | Path | None = None
) -> Calibration:
    """Returns scale and faces from COLMAP models of a run's database that were made or edited elsewhere.

    Parameters
    ----------
    model : str or Path
        A COLMAP model, or the folder of several.
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    solve : {"chain", "paper"}
        Every way to a face weighed; or as in Zhang & Wei (2017): λ by rows, three-point frames, single transforms.
    out : str or Path, optional
        File for the faces, as ``faces.json``; nothing is written if None.

    Returns
    -------
    Calibration
        ``target`` and models in mm, target frame; ``scales`` by group; ``notes``.

    Raises
    ------
    InputError
        The models are not of the run's database, state different cameras, or ``out`` cannot be written.
    ScaleError
        The board of a group is not in its model.
    MappingError
        The reference face is in none of the models, or a face is not linked to it.
    """
    run, model = saved_run(run), Path(model)
    ids = image_ids(run.observations)
    read = [read_model(path, run.observations, ids, run.corrected_px) for path in find_models(model)]
    calibration = faces_from_models(read, run, solve)
    if out is not None:
        write_faces(Path(out), calibration, run, solve)
    return calibration


def write_faces(path: Path, calibration: Calibration, run: SavedRun, solve: Chained = "chain") -> None:
    """Writes ``faces.json`` of chained models."""
    options = _options(run, solve)
    faces = FacesFile.of(calibration.target, run.target_design, options, calibration.sigma_factors.of_target)
    save(path, json_text(faces.content()))
    require_faces_written(path, calibration.target)


def _camera_change_px(camera: Camera, run: SavedRun) -> float:
    """Returns the largest change of the run's keypoints, per coordinate, by projection with another camera, px."""
    ideal = np.concatenate([image.centre for image in run.observations])
    return float(np.abs(camera.pixel_from_normalised(ideal) - run.camera.pixel_from_normalised(ideal)).max())
