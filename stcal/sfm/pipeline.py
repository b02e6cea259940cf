"""The main job: from a folder of images to the calibrated target. Each call is a stage; its result is saved."""

import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign, reference_board, reference_target
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.camera import CameraModel, CameraPrior, camera_prior, read_camera, refinable, write_cameras_txt
from stcal.io.design import board_toml, load_board, load_target, target_toml
from stcal.io.images import RUN_MARKER, find_images
from stcal.io.saving import json_text, save
from stcal.parallel import one_thread
from stcal.sfm.adjust.calibration import Calibration, calibrate
from stcal.sfm.adjust.chain import measure_chains
from stcal.sfm.adjust.file import FacesFile
from stcal.sfm.checks.suite import Evidence, run_checks
from stcal.sfm.data.model import GroupModel
from stcal.sfm.data.observations import ImageObservations, by_group, detections_csv
from stcal.sfm.detect.files import DetectionResult, detect_files, require_single
from stcal.sfm.detect.labels import LabelledImage, label_group
from stcal.sfm.detect.overlay import draw_overlay
from stcal.sfm.interop.crosscheck import Tolerances, crosscheck
from stcal.sfm.interop.external import faces_from_models
from stcal.sfm.mapping.database import image_ids, labels_csv, remove_database, write_database
from stcal.sfm.mapping.graph import ImageGraph, image_graph
from stcal.sfm.mapping.models import find_models, read_model, write_model
from stcal.sfm.report.page import report_html, shown_overlays
from stcal.sfm.run.marker import MarkerFile
from stcal.sfm.run.options import RunOptions
from stcal.sfm.run.output import report_of
from stcal.sfm.run.result import RunResult
from stcal.sfm.run.saved import BOARD, CAMERA, TARGET, SavedRun
from stcal.sfm.run.solve import GroupSolution, require_groups, solve_group, unseen_board

RESULTS = ("faces.json", "report.json", "report.html", "labels.csv", "detections.csv", "compare.json")
RESULTS += (CAMERA, TARGET, BOARD)
RESULT_FOLDERS = ("models", "target_model", "overlays", "scratch")
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""


@one_thread()
def run(
    images: str | Path,
    camera: str | Path | CameraModel,
    out: str | Path,
    target: str | Path | TargetDesign | None = None,
    board: str | Path | BoardDesign | None = None,
    options: RunOptions | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Calibrate a target from photographs.

    Parameters
    ----------
    images : folder with one folder of images for each group
    camera : COLMAP's cameras.txt, OpenCV's YAML or XML, or what :func:`stcal.io.camera.read_camera` returned
    out : the run's folder, new, empty, or of an earlier run
    target, board : designs or their TOML files; the reference design where None

    Raises
    ------
    StcalError
        One of its kinds, with a one-line message that says what to do.
    """
    tell = progress or (lambda *_: None)
    model = camera if isinstance(camera, CameraModel) else read_camera(camera)
    target = load_design(target, reference_target, load_target)
    board = load_design(board, reference_board, load_board)
    options = (options or RunOptions()).settled(target)
    model = refinable(model) if options.refine_camera else model
    find_images(images)  # before anything of an earlier run is removed
    out = claim_folder(out, MarkerFile.of(images, options))

    detection, labelled = detect(images, model, out, target, board, options, tell)
    require_single(detection.images)
    observations = [each.observations for each in labelled]
    groups = by_group(observations)
    require_groups(groups, detection.skipped)

    tell("map", 0, len(groups))
    graph = image_graph(observations, board, options.graph)
    solutions = solve_groups(
        observations, graph, out, detection.camera, model.colmap_model, target, board, options, tell
    )
    tell("faces", 0, 1)
    prior = camera_prior(model, detection.camera)
    calibration = calibrate(
        [s.model for s in solutions], detection.camera, target, board, options.adjustment(target), prior
    )
    tell("faces", 1, 1)
    result = RunResult(
        out=out,
        camera=detection.camera,
        colmap_model=model.colmap_model,
        camera_covariance=model.covariance,
        target_design=target,
        board_design=board,
        options=options,
        detection=detection,
        labelled=tuple(labelled),
        graph=graph,
        solutions=tuple(solutions),
        calibration=calibration,
        chains=measure_chains(calibration.faces, calibration.target),
        notes=(*calibration.notes, *unseen_board(solutions, board)),
    )
    tell("check", 0, 1)
    result = replace(result, checks=run_checks(_evidence(result, prior)))
    tell("check", 1, 1)
    _write(result, tell)
    return result


def _evidence(result: RunResult, prior: CameraPrior) -> Evidence:
    """What the checks look at."""
    blur = {i.file.name: i.detection.centres.blur_px for i in result.detection.images}
    return Evidence(
        models=tuple(s.model for s in result.solutions),
        outliers=tuple(o for s in result.solutions for o in s.outliers),
        images=tuple(result.observations()),
        camera=result.camera,
        colmap_model=result.colmap_model,
        target=result.target_design,
        board=result.board_design,
        options=result.options.adjustment(result.target_design),
        calibration=result.calibration,
        prior=prior if result.options.refine_camera else None,
        blur_px={name: float(np.median(each)) for name, each in blur.items() if len(each)},
    )


def detect(
    images: str | Path,
    camera: CameraModel,
    out: Path,
    target: TargetDesign,
    board: BoardDesign | None,
    options: RunOptions,
    tell: Progress,
) -> tuple[DetectionResult, list[LabelledImage]]:
    """Detection, labels, ``detections.csv`` and overlays, into a claimed folder."""
    files, other = find_images(images)
    done = 0

    def step(_name: str) -> None:
        nonlocal done
        done += 1
        tell("detect", done, len(files))

    tell("detect", 0, len(files))
    detection = detect_files(files, camera, target, board, options.ellipses, out / "cache", options.workers, step)
    detection = replace(detection, skipped=(*other, *detection.skipped))
    groups: dict[str, list] = {}
    for image in detection.images:
        groups.setdefault(image.file.group, []).append((image.file.name, image.file.group, image.detection))
    labelled = [each for group in groups.values() for each in label_group(group, target, board)]
    save(out / "detections.csv", detections_csv([each.observations for each in labelled]))
    _write_overlays(detection, labelled, target, out, tell)
    return detection, labelled


def crosscheck_run(
    saved: SavedRun, colmap: Path | None, tolerances: Tolerances, timeout_s: float, progress: Progress | None = None
) -> dict:
    """Cross-check a finished run with the native COLMAP; the comparison is added to its report."""
    _require_report(saved)  # before minutes of mapping
    check = crosscheck(saved, colmap, tolerances, timeout_s, progress)
    write_report(saved.folder, saved.report | {"crosscheck": check})
    return check


@one_thread()
def calibrate_models(model: Path, saved: SavedRun) -> Calibration:
    """Scale and faces from a COLMAP model, or the models in a folder, that rest on the run's database."""
    ids = image_ids(saved.observations)
    read = [read_model(path, saved.observations, ids, saved.corrected_px) for path in find_models(model)]
    return faces_from_models(read, saved)


def write_faces(path: Path, calibration: Calibration, saved: SavedRun) -> None:
    """``faces.json`` of models that were chained."""
    options = replace(saved.options, solve="chain").adjustment(saved.target)
    faces = FacesFile.of(calibration.target, saved.target, options, calibration.sigma_factor)
    save(path, json_text(faces.content()))


def load_design(given, default: Callable, load: Callable):
    """A design given as an object, a file, or not at all."""
    if given is None:
        return default()
    return load(given) if isinstance(given, (str, Path)) else given


def claim_folder(out: str | Path, content: MarkerFile) -> Path:
    """Make the run's folder, mark it as ours with ``content``, and remove results that will be made anew.

    Raises
    ------
    InputError
        The folder holds something else.
    """
    out = Path(out)
    marker = out / RUN_MARKER
    try:
        if out.exists() and not out.is_dir():
            raise InputError(f"output {out}: not a folder; give a new folder with --out")
        if out.is_dir() and not marker.exists() and any(not p.name.startswith(RUN_MARKER) for p in out.iterdir()):
            raise InputError(f"output folder {out}: not empty and not of an earlier run; give a new folder with --out")
        out.mkdir(parents=True, exist_ok=True)
        save(marker, json_text(content.content()))
        for name in RESULTS:
            (out / name).unlink(missing_ok=True)
        for name in RESULT_FOLDERS:
            shutil.rmtree(out / name, ignore_errors=True)
        remove_database(out / "database.db")
    except OSError as error:
        raise InputError(f"output folder {out}: {error.strerror or error}; give a writable folder") from error
    return out


def _write_overlays(detection: DetectionResult, labelled: list[LabelledImage], target, out: Path, tell) -> None:
    face_ids = [face.id for face in target.faces]

    def draw(image, each: LabelledImage) -> None:
        path = overlay_path(out, image.file.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = draw_overlay(
            image.thumbnail,
            image.thumbnail_scale,
            each.observations,
            face_ids,
            detection.camera.focal,
            len(each.notes),
        )
        save(path, picture)

    with ThreadPoolExecutor() as pool:  # drawing and JPEG release the interpreter
        for i, _ in enumerate(pool.map(draw, _in_order(detection, labelled), labelled)):
            tell("overlays", i + 1, len(labelled))


def _in_order(detection: DetectionResult, labelled: list[LabelledImage]):
    by_name = {image.file.name: image for image in detection.images}
    return [by_name[each.observations.name] for each in labelled]


def overlay_path(out: Path, name: str) -> Path:
    """The overlay of an image."""
    return out / "overlays" / f"{name}.jpg"


def solve_groups(
    observations: Sequence[ImageObservations],
    graph: ImageGraph,
    out: Path,
    camera: Camera,
    colmap_model: str,
    target: TargetDesign,
    board: BoardDesign,
    options: RunOptions,
    tell: Progress,
) -> list[GroupSolution]:
    """Map and refine group by group, in ``out/scratch``, which is removed again."""
    scratch = out / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    ids = image_ids(observations)
    database = scratch / "mapping.db"
    groups = by_group(observations)
    solutions = []
    try:
        write_database(database, camera, colmap_model, observations, graph.pairs)
        for name, group in groups.items():
            solutions.append(
                solve_group(
                    group,
                    [observations[i].name for i in graph.skeleton[name]],
                    database,
                    scratch / "models",
                    ids,
                    camera,
                    target,
                    board,
                    options.pairs,
                    options.eccentricity,
                    out / "cache",
                )
            )
            tell("map", len(solutions), len(groups))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return solutions


def _write(result: RunResult, tell: Progress) -> None:
    """The database with corrected centres, models, faces and report; ``faces.json`` comes last but for the report."""
    out = result.out
    observations = result.observations()
    ids = image_ids(observations)
    models = {s.model.group: s.model for s in result.solutions}
    corrected = _corrected_px(models, observations)
    write_database(out / "database.db", result.camera, result.colmap_model, observations, result.graph.pairs, corrected)
    save(out / "labels.csv", labels_csv(observations, corrected))
    shutil.rmtree(out / "models", ignore_errors=True)
    for name, model in models.items():
        folder = out / "models" / name  # "models/." where the images lie directly in their folder
        write_model(folder, [model], observations, ids, result.camera, result.colmap_model)
    write_model(
        out / "target_model",
        result.calibration.models,
        observations,
        ids,
        result.calibration.camera,
        result.colmap_model,
    )
    write_cameras_txt(out / CAMERA, result.camera, result.colmap_model, result.camera_covariance)
    save(out / TARGET, target_toml(result.target_design))
    save(out / BOARD, board_toml(result.board_design))
    report = report_of(result).content()
    faces = FacesFile.of(
        result.target,
        result.target_design,
        result.options.adjustment(result.target_design),
        result.calibration.sigma_factor,
    )
    save(out / "faces.json", json_text(faces.content()))
    write_report(out, report)
    tell("report", 1, 1)


def write_report(out: Path, report: dict) -> None:
    """``report.json`` and ``report.html`` of a run's folder."""
    page = _report_page(out, report)
    save(out / "report.json", json_text(report))
    save(out / "report.html", page)


def _report_page(out: Path, report: dict) -> bytes:
    overlays = {name: overlay_path(out, name).read_bytes() for name in shown_overlays(report)}
    return report_html(report, overlays).encode()


def _require_report(saved: SavedRun) -> None:
    """Refuse a run whose report cannot be added to: of another version, without its overlays, or read-only."""
    try:
        _report_page(saved.folder, {key: value for key, value in saved.report.items() if key != "crosscheck"})
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror or error}; the report needs it, run it again") from error
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else error
        raise InputError(
            f"{saved.folder / 'report.json'}: damaged, or of another version ({reason}); run it again"
        ) from error
    if not os.access(saved.folder, os.W_OK):
        raise InputError(f"run {saved.folder}: cannot be written to, and the comparison goes into its report; copy it")


def _corrected_px(models: dict[str, GroupModel], observations: list[ImageObservations]) -> list[np.ndarray]:
    """All keypoints of every image as the models of the groups correct them."""
    rows = {name: rows for m in models.values() for name, rows in zip(m.images, m.rows_by_image(), strict=True)}
    none = np.zeros(0, int)
    return [models[image.group].keypoints_px(image, rows.get(image.name, none)) for image in observations]
