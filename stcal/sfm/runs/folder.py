"""Files that a run writes into its folder: overlays, results, report."""

import contextlib
import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.boards.board_file import save_board
from stcal.boards.target_file import save_target
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.cameras.read import save_camera
from stcal.io.files import (
    BOARD,
    CAMERA,
    DATABASE,
    MODEL_BYTES,
    MODELS,
    REFINED_CAMERA,
    REPORT_PDF,
    TARGET,
    TARGET_MODEL,
    json_text,
    read_bytes,
    save,
)
from stcal.io.json import checked, read_json, require_result_written
from stcal.io.table import csv_rows
from stcal.labels import DotLabel, Label
from stcal.parallel import Progress
from stcal.report.document import (
    Answer,
    Document,
    Notes,
    Section,
    Table,
    links,
    macro,
    pdf_of,
    plots,
    require_pdf,
    sentence,
)
from stcal.report.text import join
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.data.group_model import GroupModel, ImageObservations, detections_csv
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.detect.overlay import kept_overlay
from stcal.sfm.mapping.database import image_ids, labels_csv, write_database
from stcal.sfm.mapping.models import write_model
from stcal.sfm.report.judgement import Judgement, judged
from stcal.sfm.report.run_page import FIRST_IMAGES, Residuals, report_html, shown_overlays
from stcal.sfm.runs.report_file import ReportFile, report_of, residuals_px
from stcal.sfm.runs.run_result import AnyRun, RunResult, SavedRun, folder_of
from stcal.sfm.runs.run_text import found_in_all
from stcal.sfm.runs.saved import require_run, verify
from stcal.sfm.runs.task import DetectedImages, Task
from stcal.sfm.runs.transaction import AGAIN, added_results, as_written, complete_interrupted

LONGEST_NAME = 200
"""Largest number of bytes of an image's name in the name of its overlay. File systems take 255, including the suffix
during writing."""
HASH_DIGITS = 12


@contextlib.contextmanager
def overlays_beside(seen: DetectedImages, task: Task, page: bool = True) -> Iterator[dict[str, frozenset[Label]]]:
    """Writes ``detections.csv``, and draws the detections into every image while other work goes on.

    All overlays exist at the end of the block, which adds to the yielded labels, by image, those that are to be crossed
    out. Where the block fails, a page on why and what was found is written, and the error gets what most images have in
    common; not without ``page``.
    """
    stage, focal_px, face_ids = task.folder.stage, seen.detection.camera.focal, [face.id for face in task.target.faces]
    save(stage / "detections.csv", detections_csv(seen.observations()))
    pictures = {image.file.name: image for image in seen.detection.images}
    left_out: dict[str, frozenset[Label]] = {}

    def draw(image: LabelledImage) -> None:
        name, picture = image.observations.name, pictures[image.observations.name]
        small, crossed = (picture.thumbnail, picture.thumbnail_scale), left_out.get(name, frozenset())
        drawn = image.observations, face_ids, focal_px, len(image.notes), crossed
        save(overlay_path(stage, name), kept_overlay(task.folder.cache, picture.digest, *small, *drawn))

    try:
        with ThreadPoolExecutor() as pool:  # drawing and JPEG release the interpreter
            drawn = [pool.submit(draw, image) for image in seen.labelled]
            try:
                yield left_out
            except Exception:
                raise
            except BaseException:  # interrupted or exiting
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            for i, each in enumerate(drawn, 1):
                each.result()
                task.progress("overlays", i, len(drawn))
            list(pool.map(draw, [image for image in seen.labelled if left_out.get(image.observations.name)]))
    except StcalError as error:
        if page:
            found = found_in_all(seen.labelled)
            save(stage / "report.html", _page_on_failure(task.target.name, error, found, seen))
            error.append(f"; {found}")
        raise


def overlay_path(out: Path, name: str) -> Path:
    """Returns the path of an image's overlay, with ``.jpg``; a long name is cut, and ends in its hash."""
    group, slash, file_name = name.rpartition("/")
    if len(os.fsencode(file_name)) > LONGEST_NAME:
        cut = os.fsencode(file_name)[: LONGEST_NAME - HASH_DIGITS - 1].decode(errors="ignore")
        file_name = f"{cut}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:HASH_DIGITS]}"
    suffix = "" if file_name.lower().endswith((".jpg", ".jpeg")) else ".jpg"
    return out / "overlays" / f"{group}{slash}{file_name}{suffix}"


def write_run(result: RunResult, out: Path, progress: Progress) -> RunResult:
    """Writes database, models, faces and report beside the overlays; returns the run as it was written."""
    observations = result.observations
    ids = image_ids(observations)
    models = {s.model.group: s.model for s in result.solutions}
    corrected = _corrected_px(models, observations)
    (out / DATABASE).parent.mkdir()
    write_database(out / DATABASE, result.camera, observations, result.graph.pairs, corrected)
    save(out / "labels.csv", labels_csv(observations, corrected, residuals_px(result)))
    for name, model in models.items():
        folder = out / MODELS / name  # "models/." where the images lie directly in their folder
        write_model(folder, [model], observations, ids, result.camera)
    adjusted = Camera.of(result.calibration.camera, result.camera.colmap_model)
    write_model(out / TARGET_MODEL, result.calibration.models, observations, ids, adjusted)
    save_camera(out / CAMERA, result.camera)
    if (refined := result.refined_camera) is not None:
        save_camera(out / REFINED_CAMERA, refined)
    save_target(out / TARGET, result.target_design)
    if result.board_design.rows:
        save_board(out / BOARD, result.board_design)
    report = judged(report_of(result).content())
    judgement = Judgement.model_validate(report["judgement"])
    faces = None
    if result.target.target_from_face:  # a run of the board alone has no faces
        options, factor = result.options.adjustment(result.target_design), result.calibration.sigma_factors.of_target
        doubted, rims = judgement.use if judgement.verdict == "no" else "", result.calibration.rim_mm
        faces = FacesFile.of(result.target, result.target_design, options, factor, rims, doubted)
        save(out / "faces.json", json_text(faces.content()))
        require_result_written(out / "faces.json", faces)
    write_report(out, report, out)
    (out / "detections.csv").unlink(missing_ok=True)  # `labels.csv` has more of them
    progress("report", 1, 1)
    written = read_json(out / "report.json", "run", AGAIN)
    return replace(result, corrected_px=tuple(corrected), faces_file=faces, report=written, judgement=judgement)


def write_report(out: Path, report: dict, run: Path) -> None:
    """Writes ``report.json`` and ``report.html`` into a folder; ``run`` : folder of the overlays."""
    page, _ = _report_page(run, report)
    save(out / "report.json", json_text(report))
    save(out / "report.html", page)


@dataclass(frozen=True, slots=True)
class ReportAgain:
    """Result of :func:`report_again`."""

    files: tuple[Path, ...]  # page and PDF that were written
    gone: int  # number of overlays that the page lacks
    notes: tuple[str, ...] = ()  # on files that are not as the run left them

    def text(self) -> str:
        """Returns the text for the terminal."""
        lines = [f"{self.gone} overlays are no longer in the folder: the report is without them"] if self.gone else []
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join([*lines, *(f"report: {path}" for path in self.files)])


@require_arguments
def report_again(run: AnyRun, pdf: bool = False, out: str | Path | None = None) -> ReportAgain:
    """Writes the page of a finished run again, from its ``report.json`` and its overlays, and a PDF if requested.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    pdf : bool
        Whether the PDF is written, beside the page; it needs the extra ``pdf``.
    out : str or Path, optional
        File for the page (HTML); the page in the run's folder is replaced if None.

    Returns
    -------
    ReportAgain
        Paths of the ``files`` that were written, and ``notes``.

    Raises
    ------
    InputError
        Not a finished run, a damaged file in it, a file that cannot be written, or no WeasyPrint.
    """
    run, out = folder_of(run), None if out is None else Path(out)
    require_run(run)
    if out is not None and out.suffix.lower() == ".pdf":
        raise InputError(
            "E-OUTPUT-SUFFIX",
            f"--out {out}: the page is HTML; give {out.with_suffix('.html')}, and --pdf for {out.name}",
        )
    if pdf:
        require_pdf()
    complete_interrupted(run)
    notes = tuple(verify(run).notes(but=("report.html", REPORT_PDF)))
    if out is not None:
        return ReportAgain(*_page_and_pdf(run, pdf, out), notes)
    with added_results(run) as stage:
        files, gone = _page_and_pdf(run, pdf, stage / "report.html")
    return ReportAgain(tuple(run / path.name for path in files), gone, notes)


def _page_and_pdf(run: Path, pdf: bool, out: Path) -> tuple[tuple[Path, ...], int]:
    """Writes page and PDF; returns their paths, and the number of overlays that are gone."""
    report = read_json(run / "report.json", "run", AGAIN)
    with as_written(run / "report.json"):
        checked(report, ReportFile)
        page, gone = _report_page(run, report)
    contents: dict[Path, str | bytes] = {out: page}
    if pdf:
        contents[out.with_suffix(".pdf")] = pdf_of(page)
    for file, content in contents.items():
        save(file, content)
    return tuple(contents), gone


def _report_page(run: Path, report: dict) -> tuple[str, int]:
    """Returns the page with the overlays that are in the folder, and the number of those that are not."""
    shown = shown_overlays(report)
    overlays = {name: path.read_bytes() for name in shown if (path := overlay_path(run, name)).is_file()}
    gone = len(shown) - len(overlays)
    return report_html(report, overlays, _residuals(run, list(overlays)), gone), gone


def _residuals(run: Path, names: list[str]) -> dict[str, Residuals]:
    """Returns centres and residuals of these images from ``labels.csv``."""
    rows: dict[str, list[list[float]]] = {name: [] for name in names}
    with as_written(run / "labels.csv"):
        for row in csv_rows(read_bytes(run / "labels.csv", MODEL_BYTES).decode()):
            if row["image"] in rows and row["residual_x_px"]:
                values = [float(row[key]) for key in ("x_px", "y_px", "residual_x_px", "residual_y_px")]
                rows[row["image"]].append(values)
    return {name: np.array(values).reshape(-1, 4) for name, values in rows.items()}


def require_report(saved: SavedRun) -> None:
    """Refuses a run whose report cannot be extended: of another version, without its overlays, or read-only."""
    with as_written(saved.folder / "report.json"):
        report = {key: value for key, value in saved.report.items() if key != "crosscheck"}
        for name in shown_overlays(report):
            overlay_path(saved.folder, name).stat()
        _report_page(saved.folder, report)
    if not os.access(saved.folder, os.W_OK):
        raise InputError(
            "E-OUTPUT-UNWRITABLE",
            f"run {saved.folder}: cannot be written to, and the comparison goes into its report; copy it",
        )


def _corrected_px(models: Mapping[str, GroupModel], observations: Sequence[ImageObservations]) -> list[np.ndarray]:
    """Returns all keypoints of every image as the models of the groups correct them, as measured without a model."""
    corrected = {image.name: image.centre_px.copy() for image in observations}
    for model in models.values():
        for name, rows in zip(model.images, model.rows_by_image(), strict=True):
            corrected[name][model.keypoint[rows]] = model.corrected_px()[rows]
    return list(corrected.values())


def _page_on_failure(name: str, error: StcalError, found: str, seen: DetectedImages) -> str:
    """Returns the page of a run without a result; the overlays lie beside it."""
    rows = []
    for each in seen.labelled:
        image = each.observations
        dots = sum(isinstance(label, DotLabel) for label in image.labels)
        rows.append([image.name, join(sorted(image.face_ids())), len(image) - dots, dots])
    left_out = [f"{each.observations.name}: {note}" for each in seen.labelled for note in each.notes]
    overlays = [(overlay_path(Path(), row[0]).as_posix(), row[0]) for row in rows]
    shown = [macro("plot", place, image, image) for place, image in overlays[:FIRST_IMAGES]]
    sections = [
        *([Section("What to do", [sentence(error.remedy)])] if error.remedy else []),
        Section("What was found", [found, Table(["<Image", "<Faces", "Points", "Dots"], rows)]),
        Section("Left out", [Notes(left_out)]),
        Section("Not read", [Notes([f"{file.name}: {file.reason}" for file in seen.detection.skipped])]),
        Section("Overlays", [plots(*shown), links(overlays[FIRST_IMAGES:]) if overlays[FIRST_IMAGES:] else None]),
    ]
    return Document(name, f"{len(rows)} images, no calibrated target", sections, [Answer("no", error.fault)]).page()
