"""What a run writes into its folder, overlays, results and report, and what it prints."""

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.boards.board_file import save_board
from stcal.boards.target_file import save_target
from stcal.design import faces_of_known_shape, known_distances
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io import files
from stcal.io.cameras.read import save_camera
from stcal.io.json import checked, read_json, require_result_written
from stcal.io.table import csv_rows
from stcal.labels import DotLabel, Label
from stcal.parallel import Progress
from stcal.report.document import (
    Answer,
    Block,
    Document,
    Notes,
    Printed,
    Section,
    Table,
    links,
    macro,
    pdf_of,
    plots,
    require_pdf,
    sentence,
)
from stcal.report.text import join, wrapped
from stcal.sfm.adjust.faces_file import FacesFile
from stcal.sfm.data.group_model import ImageObservations, Note, detections_csv
from stcal.sfm.detect.detect_files import DetectionResult
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.detect.overlay import kept_overlay
from stcal.sfm.detect.predict import CUT, REMEDIES
from stcal.sfm.mapping.database import image_ids, labels_csv, write_database
from stcal.sfm.mapping.models import write_model
from stcal.sfm.report.check import BY_CHANCE, count_verdicts, ranked
from stcal.sfm.report.judgement import QUESTIONS, judgement_of, without_sigma_of
from stcal.sfm.report.run_page import (
    CONTROL,
    FIRST_IMAGES,
    PUBLISHED,
    comparison_cells,
    faces_table,
    report_html,
    shown_overlays,
)
from stcal.sfm.runs.report_file import ReportFile, face_row, report_of
from stcal.sfm.runs.saved import AnyRun, RunResult, SavedRun
from stcal.sfm.runs.stages import DetectedImages, Task
from stcal.sfm.runs.transaction import AGAIN, added_results, as_written, require_run, verify

LONGEST_NAME, HASH_DIGITS = 200, 12
"""Largest number of bytes of an image's name in the name of its overlay. File systems take 255, including the suffix
during writing."""
WEAK_FOCAL = 0.01  # relative σ of a focal length beyond which the views lack what determines it
FIRST = 20  # number of images that are named
FEW = 3  # number of images up to which what was left out in each is said


@contextlib.contextmanager
def overlays_beside(seen: DetectedImages, task: Task, page: bool = True) -> Iterator[dict[str, frozenset[Label]]]:
    """Writes ``detections.csv``, and draws the detections into every image while other work goes on; all overlays exist
    at the end of the block, which adds the labels to cross out to those yielded, by image. Where it fails, a page on
    why and what was found is written, if ``page``, and the error gets what most images have in common."""
    stage, focal_px, face_ids = task.folder.stage, seen.detection.camera.focal, [face.id for face in task.target.faces]
    files.save(stage / "detections.csv", detections_csv(seen.observations))
    pictures = {image.file.name: image for image in seen.detection.images}
    left_out: dict[str, frozenset[Label]] = {}

    def draw(image: LabelledImage) -> None:
        name, picture = image.observations.name, pictures[image.observations.name]
        small, crossed = (picture.thumbnail, picture.thumbnail_scale), left_out.get(name, frozenset())
        drawn = image.observations, face_ids, focal_px, len(image.notes), crossed
        files.save(overlay_path(stage, name), kept_overlay(task.folder.cache, picture.digest, *small, *drawn))

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
            files.save(stage / "report.html", _page_on_failure(task.target.name, error, found, seen))
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
    observations, models = result.observations, {s.model.group: s.model for s in result.solutions}
    ids, by_name = image_ids(observations), {image.name: image for image in observations}
    keypoints = {name: image.centre_px for name, image in by_name.items()}
    for model in models.values():  # as the models of the groups correct them
        rows_of = zip(model.images, model.rows_by_image(), strict=True)
        keypoints |= {name: model.keypoints_px(by_name[name], rows) for name, rows in rows_of}
    corrected = list(keypoints.values())
    (out / files.DATABASE).parent.mkdir()
    write_database(out / files.DATABASE, result.camera, observations, result.graph.pairs, corrected)
    files.save(out / "labels.csv", labels_csv(observations, corrected, list(result.residuals_px().values())))
    for name, model in models.items():  # "models/." where the images lie directly in their folder
        write_model(out / files.MODELS / name, [model], observations, ids, result.camera)
    adjusted = Camera.of(result.calibration.camera, result.camera.colmap_model)
    write_model(out / files.TARGET_MODEL, result.calibration.models, observations, ids, adjusted)
    save_camera(out / files.CAMERA, result.camera)
    if (refined := result.refined_camera) is not None:
        save_camera(out / files.REFINED_CAMERA, refined)
    save_target(out / files.TARGET, result.target_design)
    if result.board_design.rows:
        save_board(out / files.BOARD, result.board_design)
    report, faces = report_of(result).content(), None
    judgement = judgement_of(report)
    report["judgement"] = judgement.model_dump()
    if result.target.target_from_face:  # a run of the board alone has no faces
        options, factor = result.options.adjustment(result.target_design), result.calibration.sigma_factors.of_target
        doubted, rims = judgement.use if judgement.verdict == "no" else "", result.calibration.rim_mm
        faces = FacesFile.of(result.target, result.target_design, options, factor, rims, doubted)
        files.save(out / "faces.json", files.json_text(faces.content()))
        require_result_written(out / "faces.json", faces)
    write_report(out, report, out)
    (out / "detections.csv").unlink(missing_ok=True)  # `labels.csv` has more of them
    progress("report", 1, 1)
    written = read_json(out / "report.json", "run", AGAIN)
    return replace(result, corrected_px=tuple(corrected), faces_file=faces, report=written, judgement=judgement)


def write_report(out: Path, report: dict, run: Path) -> None:
    """Writes ``report.json`` and ``report.html`` into a folder; ``run`` : folder of the overlays."""
    page, _ = _report_page(run, report)
    files.save(out / "report.json", files.json_text(report))
    files.save(out / "report.html", page)


@dataclass(frozen=True, slots=True)
class ReportAgain:
    """Result of :func:`report_again`."""

    files: tuple[Path, ...]  # page and PDF that were written
    notes: tuple[str, ...]  # on overlays that the page lacks, and files that are not as the run left them

    def text(self) -> str:
        """Returns the text for the terminal."""
        return "\n".join([*(f"note: {note}" for note in self.notes), *(f"report: {path}" for path in self.files)])


@require_arguments
def report_again(run: AnyRun, pdf: bool = False, out: str | Path | None = None) -> ReportAgain:
    """Writes the page of a finished run again, from its ``report.json`` and its overlays, and a PDF if requested.

    Parameters
    ----------
    run : The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    pdf : Whether the PDF is written, beside the page; it needs the extra ``pdf``.
    out : File for the page (HTML); the page in the run's folder is replaced if None.

    Returns
    -------
    ReportAgain : Paths of the ``files`` that were written, and ``notes``.

    Raises
    ------
    InputError
        Not a finished run, a damaged file in it, a file that cannot be written, or no WeasyPrint.
    """
    run, out = run.folder if isinstance(run, SavedRun) else Path(run), None if out is None else Path(out)
    require_run(run)
    if out is not None and out.suffix.lower() == ".pdf":
        fault = f"--out {out}: the page is HTML"
        raise InputError("E-OUTPUT-SUFFIX", f"{fault}; give {out.with_suffix('.html')}, and --pdf for {out.name}")
    if pdf:
        require_pdf()
    notes = verify(run).notes(but=("report.html", files.REPORT_PDF))
    with contextlib.nullcontext(run) if out else added_results(run) as stage:
        file, report = out or stage / "report.html", read_json(run / "report.json", "run", AGAIN)
        with as_written(run / "report.json"):
            checked(report, ReportFile)
            files.json_text(report)  # no NaN, which Python's reader takes for a number
            page, gone = _report_page(run, report)
        notes += [f"{gone} overlays are no longer in the folder: the report is without them"] if gone else []
        contents: dict[Path, str | bytes] = {file: page} | ({file.with_suffix(".pdf"): pdf_of(page)} if pdf else {})
        for place, content in contents.items():
            files.save(place, content)
    return ReportAgain(tuple(contents) if out else tuple(run / place.name for place in contents), tuple(notes))


def _report_page(run: Path, report: dict) -> tuple[str, int]:
    """Returns the page with the overlays that are in the folder, and the number of those that are not."""
    shown = shown_overlays(report)
    overlays = {name: path.read_bytes() for name in shown if (path := overlay_path(run, name)).is_file()}
    gone = len(shown) - len(overlays)
    rows: dict[str, list[list[float]]] = {name: [] for name in overlays}
    # Of the group by group adjustments: poses and points are unknown, a similarity of each is not determined.
    unknown = sum(6 * len(group["images"]) + 3 * group["points"] - 7 for group in report["groups"])
    free = 1 - unknown / (2 * max(report["summary"]["observations"], 1))
    factor = report["summary"]["sigma_factor"] * float(np.sqrt(max(free, 0.01)))
    with as_written(run / "labels.csv"):
        for row in csv_rows(files.read_bytes(run / "labels.csv", files.MODEL_BYTES).decode()):
            if row["image"] in rows and row["residual_x_px"]:
                rows[row["image"]].append([float(row[key]) for key in DRAWN])
    residuals = {name: _with_normalised(np.array(own).reshape(-1, len(DRAWN)), factor) for name, own in rows.items()}
    return report_html(report, overlays, residuals, gone), gone


DRAWN = ("x_px", "y_px", "residual_x_px", "residual_y_px", "var_x_px2", "cov_xy_px2", "var_y_px2")
"""Columns of ``labels.csv`` that the page draws."""


def _with_normalised(rows: np.ndarray, factor: float) -> np.ndarray:
    """Returns centre and residual, and the residual over its σ, (n, 6), of columns ``DRAWN`` and a factor on σ."""
    xx, cross, yy = rows[:, 4:].T
    along, across = np.sqrt(xx), np.sqrt(np.maximum(yy - cross**2 / xx, 1e-12 * yy))
    first = rows[:, 2] / along
    return np.column_stack([rows[:, :4], first / factor, (rows[:, 3] - cross / along * first) / across / factor])


def require_report(saved: SavedRun) -> None:
    """Refuses a run whose report cannot be extended: of another version, without its overlays, or read-only."""
    with as_written(saved.folder / "report.json"):
        report = {key: value for key, value in saved.report.items() if key != "crosscheck"}
        for name in shown_overlays(report):
            overlay_path(saved.folder, name).stat()
        _report_page(saved.folder, report)
    if not os.access(saved.folder, os.W_OK):
        fault = f"run {saved.folder}: cannot be written to, and the comparison goes into its report"
        raise InputError("E-OUTPUT-UNWRITABLE", f"{fault}; copy it")


def _page_on_failure(name: str, error: StcalError, found: str, seen: DetectedImages) -> str:
    """Returns the page of a run without a result; the overlays lie beside it."""
    counts = [(image, _count_dots(image)) for image in seen.observations]
    rows = [[image.name, join(sorted(image.face_ids())), len(image) - dots, dots] for image, dots in counts]
    left_out = [f"{each.observations.name}: {note}" for each in seen.labelled for note in each.notes]
    overlays = [(overlay_path(Path(), image.name).as_posix(), image.name) for image, _ in counts]
    shown, others = overlays[:FIRST_IMAGES], overlays[FIRST_IMAGES:]
    pictures = plots(*(macro("plot", place, image, image) for place, image in shown))
    sections = [
        *([Section("What to do", [sentence(error.remedy)])] if error.remedy else []),
        Section("What was found", [found, Table(["<Image", "<Faces", "Points", "Dots"], rows)]),
        Section("Left out", [Notes(left_out)]),
        Section("Not read", [Notes([f"{file.name}: {file.reason}" for file in seen.detection.skipped])]),
        Section("Overlays", [pictures, links(others) if others else None]),
    ]
    return Document(name, f"{len(rows)} images, no calibrated target", sections, [Answer("no", error.fault)]).page()


def run_text(result: RunResult) -> str:
    return "\n".join(part for line in document_of(result).text().splitlines() for part in wrapped(line))


def document_of(result: RunResult) -> Document:
    """Returns the result of a run in short: the verdict, faces with σ, checks that did not pass, and remarks."""
    verdict, *others = [] if result.judgement is None else result.judgement.answers()
    faces = {face: face_row(result, face) for face in result.target.target_from_face}
    if faces:
        failed = result.judgement is not None and result.judgement.verdict == "no"
        shown = without_sigma_of(faces) if failed else faces
        blocks: list[Block] = [faces_table(shown, result.target.reference_face)]
    else:
        rows = [
            [name, len(s.labels)]
            + [f"{each:.6g}" for each in (s.mm_per_unit, s.rows_mm_per_unit)]
            + [f"{1e3 * each:.2f}" for each in (s.mean_mm(), s.spread_mm())]
            for name, s in result.calibration.scales.items()
        ]
        blocks = [
            f"the board alone: no face of the target in {len(result.labelled)} images, so that there is no faces.json; "
            "length of the board's residuals, as in table 1 of Zhang & Wei (2017)",
            Table(["<group", "dots", "λ mm/unit", "λ by rows", "mean µm", "± µm"], rows),
        ]
    names = frozenset(image.name for image in result.observations)
    doubtful = [check for check in ranked(result.checks, names) if check.verdict in ("failed", "suspicious")]
    blocks += [f"checks: {count_verdicts(result.checks)} ({BY_CHANCE})"] if doubtful else []
    blocks += [f"{c.verdict}: {c.title}: {c.reason}{'; ' * bool(c.remedy)}{c.remedy}" for c in doubtful]
    if result.comparison is not None:
        blocks += [
            "compared with Zhang & Wei (2017): distance of faces from the last row's, three-point frames; steps add up",
            Table(*comparison_cells(result.comparison.model_dump())),
            *(f"{row.method}: {row.reason}" for row in result.comparison.rows if row.reason),
        ]
    blocks.append(Printed([*result.notes, *_remarks(result)]))
    if (out := result.out) is not None:
        written = [f"faces:  {out / 'faces.json'}"] if faces else []
        written += [f"camera: {out / files.REFINED_CAMERA}, as adjusted, with σ"] if result.refined_camera else []
        blocks.append(Printed([*written, f"report: {out / 'report.html'}"]))
    first = " ".join(verdict) if verdict else QUESTIONS["use"] + " It was not judged."
    answers = [f"{question} {answer}" for question, answer in others]
    return Document(result.target_design.name, first, [Section("", blocks, terminal=True)], answers)


def _remarks(result: RunResult) -> Iterator[str]:
    """Yields what was left out, and on what the size and the camera rest."""
    unmapped = [f"left out {name}: {why}" for solution in result.solutions for name, why in solution.left_out.items()]
    noted = {image.observations.name: image.notes for image in result.labelled if image.notes}
    outliers = sum(len(solution.outliers) for solution in result.solutions)
    for lines in (skipped_lines(result.detection), unmapped):
        yield from lines[:FIRST]
        if len(lines) > FIRST:
            yield f"and {len(lines) - FIRST} more, which the report names"
    if 0 < len(noted) <= FEW:
        yield from (f"left out in {name}: {notes[0]}" for name, notes in noted.items())
    elif noted:
        more = f" and {len(noted) - FIRST} more" if len(noted) > FIRST else ""
        yield f"something was left out in {join([*noted][:FIRST])}{more}; the report says what and why"
    if outliers:
        yield f"{outliers} {result.target_design.points} left out that contradict the others"
    yield from _on_size(result)
    yield from _on_camera(result)
    if result.options.solve == "paper" or not result.options.eccentricity:
        yield PUBLISHED if result.options.solve == "paper" else CONTROL


def _on_size(result: RunResult) -> Iterator[str]:
    """Yields what the size rests on where that is not the board alone, and how good print and flatness are."""
    sources, joint = result.scale_from(), result.calibration.joint
    known = [f for f in faces_of_known_shape(result.board_design) if f.id in result.target.target_from_face]
    count = len(known_distances(result.board_design)) if "distances" in sources else 0
    distances = f"{count} known distance{'' if count == 1 else 's'}"
    if "faces" in sources:
        beside = " beside the board" if "board" in sources else ", no board"
        stated = any(face.size_sigma for face in known)
        size = "" if stated else ", which is taken as exact: state size_sigma_mm of a measured square or tag"
        faces = f"the printed size of {len(known)} face{'' if len(known) == 1 else 's'}"
        yield f"scale: from {f'{distances} and ' if count else ''}{faces}{beside}{size}"
        if joint is not None:
            within = 1e3 * joint.print_factor * float(np.median([face.sigma_mm or 0.0 for face in known]))
            flat = result.options.flatness_mm
            off = "" if flat is None else f", {1e3 * joint.bend_factor * flat:.0f} µm off it"
            yield f"print: corners lie {within:.0f} µm about the design in the plane{off} (σ, from the photographs)"
    elif count:
        yield f"scale: from {distances}"
    if "drawing" in sources:
        (drawn,) = known_distances(result.board_design)
        apart = f"{drawn.first} and {drawn.second} are {drawn.mm:g} mm apart, as drawn"
        yield f"scale: unknown, nothing of known size is in view; the unit is such that {apart}"


def _on_camera(result: RunResult) -> Iterator[str]:
    """Yields how well a camera that was found from the photographs is determined, or that its stated σ is left out."""
    given, refined = result.camera.covariance, result.refined_camera
    if given is not None and not result.options.refine_camera:
        stated = f"the camera file states σ of its parameters ({np.sqrt(given[0, 0]):.2g} px of the focal length)"
        remedy = "--refine-camera adjusts the intrinsics within them and includes them in all σ"
        yield f"{stated}, and this run takes them as exact: no σ below includes them; {remedy}"
    if result.camera_given or refined is None or refined.covariance is None:
        return
    sigma, focal = np.sqrt(np.diag(refined.covariance)), refined.focal
    fx, fy, cx, cy = (f"{v:.2f} ± {s:.2f}" for v, s in zip((*focal, *refined.centre), sigma, strict=False))
    corner = "in the camera file from that pixel's corner, as in COLMAP: there 0.5 px more"
    centre = f"principal point {cx}, {cy} px from the centre of the first pixel ({corner})"
    yield f"camera: found from the photographs: f {fx}, {fy} px, {centre}"
    if sigma[0] > WEAK_FOCAL * focal[0]:
        views = "take views from a shorter distance, and of faces tilted by 30° to 60°, or give a camera file"
        yield f"camera: the focal length is known to {100 * sigma[0] / focal[0]:.1f} % alone: {views}"


def skipped_lines(detection: DetectionResult) -> list[str]:
    return [f"skipped {file.name}: {file.reason}" for file in detection.skipped]


def _count_dots(image: ImageObservations) -> int:
    return sum(isinstance(label, DotLabel) for label in image.labels)


def found_in_all(labelled: Sequence[LabelledImage]) -> str:
    """Returns in how many images faces and board are, and what was left out in most of them."""
    images, count = [each.observations for each in labelled], len(labelled)
    faces, dots = sum(bool(image.face_ids()) for image in images), sum(_count_dots(image) > 0 for image in images)
    alike: dict[str, list[str]] = {}
    for each in labelled:
        for kind, note in {re.sub(r"[\d.:]+", "", note): note for note in each.notes}.items():
            alike.setdefault(kind, []).append(note)
    most = max(alike.values(), key=len, default=[])
    reason = f"; in {len(most)} of {count}: {most[0]}" if most else ""
    cut = sum(any(isinstance(note, Note) and note.code == CUT for note in each.notes) for each in labelled)
    if cut > 1 and 2 * cut >= faces:
        reason = f"; circles cut off on one side in {cut} of {count} images: behind a rim?{reason}"
    return f"a face in {faces} of {count} images, the board in {dots}{reason}"


def found_lines(labelled: Sequence[LabelledImage]) -> Iterator[str]:
    """Yields faces and dots of each image, and what was left out in it and helps."""
    counts = [_count_dots(each.observations) for each in labelled]
    for each, dots in zip(labelled, counts, strict=True):
        image = each.observations
        faces = ", ".join(sorted(image.face_ids())) or "none"
        yield f"{image.name}: faces {faces} ({len(image) - dots} circles), board {dots} dots"
        yield from (f"  {note}" for note in each.notes)
        if not image.face_ids():
            yield f"  no face is read: {REMEDIES['face']}"
        if any(counts) and not dots:
            yield f"  the board is not read: {REMEDIES['board']}"
