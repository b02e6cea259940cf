"""A finished run read back from its folder, for every command that continues from it; and the comparison of its files
with the hashes stored at its end."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stcal.boards.board_file import load_board
from stcal.boards.target_file import load_target
from stcal.design import scale_reference
from stcal.errors import InputError
from stcal.geometry.arrays import frozen, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraPrior, camera_prior
from stcal.io.cameras.read import read_camera
from stcal.io.covariance import OF_PIXEL, first_fault
from stcal.io.files import (
    BOARD,
    CAMERA,
    DATABASE,
    MODEL_BYTES,
    RUN_MARKER,
    TARGET,
    TARGET_MODEL,
    digest_of,
    own_digest,
    read_bytes,
    require_unchanged,
)
from stcal.io.json import checked, read_json
from stcal.io.table import csv_rows
from stcal.sfm.adjust.calibration import with_sigma
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.adjust.joint import Adjusted, adjusted
from stcal.sfm.adjust.scale import with_edge_sigma
from stcal.sfm.adjust.uncertainty import with_differences
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import read_model
from stcal.sfm.mapping.pairs import PairOptions
from stcal.sfm.runs.report_file import ReportRead
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.run_result import AnyRun, SavedRun, by_circle, folder_of, no_faces
from stcal.sfm.runs.transaction import AGAIN, RESULTS, MarkerFile, as_written, complete_interrupted, files_below

COLUMNS = ("x_px", "y_px", "corrected_x_px", "corrected_y_px", "var_x_px2", "cov_xy_px2", "var_y_px2")


def saved_run(run: AnyRun) -> SavedRun:
    """Returns a run that has a folder, read back if the folder is given; errors as of :func:`load_run`."""
    if not isinstance(run, SavedRun):
        return load_run(run)
    require_run(run.folder)
    return run


def require_run(folder: Path) -> None:
    """Refuses a folder that is not of a run."""
    if not (folder / RUN_MARKER).is_file():
        raise InputError(
            "E-RUN-FOLDER", f"run {folder}: not a run's folder (no {RUN_MARKER}); give the --out of a finished run"
        )


@require_arguments
def load_run(folder: str | Path) -> SavedRun:
    """Reads a finished run.

    Parameters
    ----------
    folder : path
        Folder that was given to the run as ``out``.

    Returns
    -------
    SavedRun
        Inputs, labelled centres and results of the run.

    Raises
    ------
    InputError
        Not a run's folder, an unfinished run, or a damaged file in the folder.
    """
    folder = Path(folder)
    require_run(folder)
    complete_interrupted(folder)
    has_target = (folder / TARGET).is_file()
    target = load_target(folder / TARGET) if has_target else None
    without_board = target is not None and target.has_scale and not (folder / BOARD).exists()
    inputs = (CAMERA, TARGET) if without_board else (CAMERA, TARGET, BOARD)
    needed = (*inputs, "labels.csv", DATABASE, "report.json", "faces.json")
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing == ["faces.json"]:
        raise no_faces(folder)
    if missing:
        raise InputError(
            "E-RUN-UNFINISHED",
            f"run {folder}: unfinished, or of another version: no {', '.join(missing)}; run it again",
        )
    assert target is not None
    marker, faces, report = (read_json(folder / n, "", AGAIN) for n in (RUN_MARKER, "faces.json", "report.json"))
    camera = read_camera(folder / CAMERA).calibrated(0, 0)
    board = scale_reference(None if without_board else load_board(folder / BOARD), target)
    with as_written(folder / RUN_MARKER):
        marker_file = checked(marker, MarkerFile)
        options, photographs = _options(marker_file.options or {}).settled(target), Path(marker_file.images)
    with as_written(folder / "report.json"):
        names = checked(report, ReportRead).names()
    with as_written(folder / "faces.json"):
        result = checked(faces, FacesFile)
    with as_written(folder / "labels.csv"):
        known = {*target.radius_of(), *board.radius_of()}
        observations, corrected = _labels(folder / "labels.csv", names, camera, known)
        board = with_edge_sigma(board, observations)
    for name in (RUN_MARKER, *needed):
        if name != DATABASE:  # SQLite writes to it when it is read
            require_unchanged(folder / name)
    return SavedRun(folder, photographs, options, camera, target, board, observations, corrected, result, report)


def _options(stored: dict) -> RunOptions:
    read: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in stored.items()}
    pairs, ellipses = PairOptions(**stored["pairs"]), EllipseOptions(**stored["ellipses"])
    return RunOptions(**read | {"pairs": pairs, "ellipses": ellipses})


def _labels(path: Path, names: list[tuple[str, str, int]], camera: Camera, known: Collection[str]):
    """Observations and corrected centres from ``labels.csv``; ``names``: (name, group, circles) of the images."""
    rows: dict[str, list[dict]] = {name: [] for name, _, _ in names}
    for row in csv_rows(read_bytes(path, MODEL_BYTES).decode()):
        if None in row.values():
            raise ValueError(f"image {row['image']}: keypoint {row['keypoint']}: its row is cut")
        rows[row["image"]].append(row)
    observations, corrected = [], []
    for name, group, circles in names:
        image_rows = rows[name]
        if [int(row["keypoint"]) for row in image_rows] != list(range(circles)):
            raise ValueError(f"image {name}: its keypoints are not 0 to {circles - 1} in the order of the database")
        labels = tuple(row["label"] for row in image_rows)
        unknown = [label for label in labels if label not in known]
        if unknown or len(set(labels)) < len(labels):
            raise ValueError(f"image {name}: {f'no circle {unknown[0]}' if unknown else 'a label twice'}")
        texts = [[row[column] for column in COLUMNS] for row in image_rows]
        values = frozen(np.array(texts, float).reshape(-1, len(COLUMNS)), (None, len(COLUMNS)), name)
        centre_px, covariance = values[:, :2], values[:, [4, 5, 5, 6]].reshape(-1, 2, 2)
        fault = first_fault(covariance, OF_PIXEL, definite=True)
        if fault is not None:
            raise ValueError(f"image {name}: keypoint {fault.row}: covariance: {fault.reason}")
        centre, shape = camera.normalised_from_pixel(centre_px), np.zeros_like(covariance)
        observations.append(ImageObservations(name, group, labels, centre_px, centre, shape, covariance))
        corrected.append(values[:, 2:4])
    return tuple(observations), tuple(corrected)


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedRun:
    """The final adjustment of a run."""

    state: Adjusted  # groups in mm in the target frame, at the minimum, with σ as in the run
    start: CalibratedTarget  # result of the run
    prior: CameraPrior | None  # of the intrinsics if they were adjusted


def adjusted_run(run: SavedRun) -> AdjustedRun:
    """Repeats the final adjustment of a run, which moves nothing, from its model in mm in the target frame."""
    ids = image_ids(run.observations)
    read = read_model(run.folder / TARGET_MODEL, run.observations, ids, run.corrected_px, corrected_again=True)
    models = [with_sigma(model, run.sigma_factors()) for model in read.in_mm()]
    placed = {model.group: Rigid() for model in models}
    start = CalibratedTarget(run.faces.reference_face, run.faces.poses(), by_circle(run.faces.circles), placed)
    prior = camera_prior(run.camera) if run.options.refine_camera else None
    state = adjusted(models, run.board_design, run.camera, run.options.flatness_mm, prior, read.camera)
    state = with_differences(state, start, run.target_design, run.faces.frame)
    return AdjustedRun(replace(state, enlarged=run.report["summary"].get("sigma_enlarged") or 1.0), start, prior)


@dataclass(frozen=True, slots=True)
class Verified:
    """Differences of a run's folder from what the run of ``version`` wrote, as paths below the folder."""

    version: str
    missing: tuple[str, ...]  # files that are gone
    changed: tuple[str, ...]
    added: tuple[str, ...]  # files among the results that the run did not make

    def notes(self, but: tuple[str, ...] = ()) -> list[str]:
        """Returns one note on all files but some that differ, or none."""
        kinds = {kind: [n for n in getattr(self, kind) if n not in but] for kind in ("missing", "changed", "added")}
        clauses = [
            f"{len(names)} {kind} ({names[0]}{' …' * (len(names) > 1)})" for kind, names in kinds.items() if names
        ]
        return [f"the run's folder is not as the run left it: {'; '.join(clauses)}"] if clauses else []


def verify(run: AnyRun) -> Verified:
    """Compares the files of a finished run with the hashes that were kept when it ended.

    Raises InputError: not a run's folder, or one without hashes.
    """
    run = folder_of(run)
    require_run(run)
    complete_interrupted(run)
    content = read_json(run / RUN_MARKER, "run", AGAIN)
    with as_written(f"run {run / RUN_MARKER}"):
        marker = checked(content, MarkerFile)
    if marker.sha256 is None:
        raise InputError(
            "E-RUN-UNFINISHED",
            f"run {run}: no hashes in {RUN_MARKER}, it is unfinished or of another version (stcal {marker.version}); "
            "run it again",
        )
    present = {name for name in files_below(run) if name == RUN_MARKER or name.split("/")[0] in RESULTS}
    known = marker.sha256
    now = {
        name: own_digest(content) if name == RUN_MARKER else digest_of(run / name) for name in known.keys() & present
    }
    added = (name.encode("utf-8", "backslashreplace").decode() for name in present - known.keys())
    changed = (name for name, digest in now.items() if digest != known.get(name))
    return Verified(marker.version, *(tuple(sorted(names)) for names in (known.keys() - present, changed, added)))
