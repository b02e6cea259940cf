"""Why something was left out of a finished run: the threshold that stopped it, its value there, what would let it in.

Left out is every file, image and circle that the run itself names, and every circle of the design that by the run's
own result is in view in a mapped image and has no label there: its image is opened again and examined at the place
where the final model predicts it (``stcal.sfm.diagnose.examine``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode
from stcal.parallel import run_parallel
from stcal.sfm.data.model import MIN_POINTS, MetricModel
from stcal.sfm.detect.circles.ellipses import EllipseOptions
from stcal.sfm.detect.labels import leaves_a_pattern_out
from stcal.sfm.diagnose.examine import CircleVerdict, Expected, OptionTrial, by_geometry, examine, labels_found, trials
from stcal.sfm.diagnose.findings import WHOLE_PATTERN, Diagnosis, Finding, advice, in_order
from stcal.sfm.diagnose.missing import missing_circles
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import read_model
from stcal.sfm.runs.saved import SavedRun

MIN_VIEWS = 2
NOTHING_KNOWN = "is it sharp and well lit? "


def diagnose(
    run: SavedRun,
    images: Path | None = None,
    workers: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Diagnosis:
    """Find what a run left out, and why.

    Parameters
    ----------
    images : the folder of photographs, where it is no longer the one that the run was given
    progress : called with (stage, done, total)

    Raises
    ------
    InputError
        A damaged run, one of another version, or a folder of photographs that does not exist.
    """
    if images is not None and not images.is_dir():
        raise InputError(
            "E-IMAGES-FOLDER", f"image folder {images}: not a folder; give the folder of the run's images with --images"
        )
    ids = image_ids(run.observations)
    models = read_model(run.folder / "target_model", run.observations, ids, run.corrected_px).in_mm()
    mapped = {name for model in models for name in model.images}
    try:
        findings = [*_files(run), *_images(run, mapped), *_circles(run), *_faces(run)]
        files, circles = run.report["summary"]["files"], run.faces.circles
    except (KeyError, TypeError) as error:
        raise InputError("E-RUN-VERSION", f"run {run.folder}: of another version ({error}); run it again") from error
    jobs = _jobs(run, images or run.images, models, circles)
    examined = _side_by_side(_examine, [(job,) for job in jobs], "examine", workers, progress)
    options = _try_options(run, jobs, examined, workers, progress)
    for job, (verdicts, problem) in zip(jobs, examined, strict=True):
        findings += _findings(job, verdicts, problem, options.get(job.name, {}))
    shown = _shown_with(run, mapped, options)
    findings = [_with_options(finding, options, shown) for finding in findings]
    observed = sum(len(model.image_index) for model in models)
    return Diagnosis(files, len(run.observations), len(mapped), observed, in_order(findings))


def _side_by_side(function: Callable, jobs: list[tuple], stage: str, workers, progress) -> list:
    """Results in the order of the jobs."""
    results = [None] * len(jobs)
    for done, (i, result) in enumerate(run_parallel(function, jobs, workers), start=1):
        results[i] = result
        if progress:
            progress(stage, done, len(jobs))
    return results


def _files(run: SavedRun) -> list[Finding]:
    return [
        Finding(each["name"], (), each["gate"], each["value"], each["limit"], "", _remedy_in(each))
        for each in run.report["left_out"]["files"]
    ]


def _images(run: SavedRun, mapped: set[str]) -> list[Finding]:
    """Images without a pose, and what was seen in them and left out; other images are examined."""
    left_out = run.report["left_out"]
    findings = [
        Finding(
            each["name"],
            (),
            each["gate"],
            each["value"],
            each["limit"],
            "circles",
            (NOTHING_KNOWN if each["value"] == 0 else "") + _remedy_in(each),
        )
        for each in left_out["images"]
    ]
    told = {finding.image for finding in findings}
    findings += [
        Finding(image.name, (), "group", None, None, "", f"link group {image.group} to the others by a face of theirs")
        for image in run.observations
        if image.name not in mapped | told
    ]
    for each in left_out["notes"]:
        if each["image"] not in mapped:
            findings.append(Finding(each["image"], (), "note", None, None, "", each["note"]))
        elif leaves_a_pattern_out(each["note"]):
            findings.append(Finding(each["image"], (), WHOLE_PATTERN, None, None, "", each["note"]))
    return findings


def _circles(run: SavedRun) -> list[Finding]:
    """Circles with a label that are not in the model."""
    return [
        Finding(
            each["image"],
            (each["label"],),
            each["gate"],
            each["value"],
            each["limit"],
            each["unit"],
            advice(each["gate"]),
        )
        for each in run.report["left_out"]["circles"]
    ]


def _faces(run: SavedRun) -> list[Finding]:
    """Faces that no image helps to place, and what else the run says of whole groups."""
    findings = []
    for face_id in run.report["summary"]["faces_not_seen"]:
        labels = tuple(run.target.face(face_id).labels())
        views = sum(bool(set(labels) & set(image.labels)) for image in run.observations)
        findings.append(Finding("", labels, "views", views, MIN_VIEWS, "images", advice("views")))
    return findings + [Finding("", (), "note", None, None, "", note) for note in run.report["notes"]]


def _remedy_in(left_out: dict) -> str:
    """The advice at the end of a reason; all of it, where no value says the rest."""
    reason = left_out["reason"]
    return reason if left_out["value"] is None else reason.partition("; ")[2] or reason


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """An image to open: to examine what is ``expected`` in it, or, where that is nothing, to see whether an option
    would show enough of the ``known`` circles to place it."""

    path: Path
    name: str
    camera: Camera
    target: TargetDesign
    board: BoardDesign
    options: EllipseOptions
    expected: list[Expected]
    known: frozenset[str]


def _jobs(run: SavedRun, images: Path, models: Sequence[MetricModel], circles: dict[str, np.ndarray]) -> list[_Job]:
    """Mapped images that lack circles in view, and images without a pose; not those of groups without a model."""
    given = run.camera, run.target, run.board, run.options.ellipses
    observations = {image.name: image for image in run.observations}
    jobs = []
    for model in models:
        missing = missing_circles(model, circles, observations, run.camera, run.target, run.board)
        jobs += [_Job(images / name, name, *given, planes, frozenset()) for name, planes in missing.items()]
        jobs += [
            _Job(images / name, name, *given, [], frozenset(model.labels))
            for name, image in observations.items()
            if image.group == model.group and name not in model.images
        ]
    return jobs


def _decoded(job: _Job) -> tuple[np.ndarray | None, str]:
    """The image, or what is wrong with it."""
    size = job.camera.height, job.camera.width
    try:
        image = decode(read_bytes(job.path, IMAGE_BYTES), job.name)
    except OSError as error:
        return None, f"{job.path}: {error.strerror or error}"
    except InputError as error:
        return None, str(error)
    if image.shape != size:
        return None, f"{job.path}: {image.shape[1]}×{image.shape[0]} px, {size[1]}×{size[0]} px needed"
    return image, ""


def _examine(job: _Job) -> tuple[list[CircleVerdict], str]:
    """Verdicts on what is expected in an image; by the geometry alone where something is wrong with the image."""
    image, problem = _decoded(job)
    if image is None:
        return by_geometry(job.expected, job.camera, job.options), problem
    return examine(image, job.camera, job.target, job.board, job.options, job.expected) if job.expected else [], ""


def _try_options(run: SavedRun, jobs, examined, workers, progress) -> dict[str, dict[str, set[str]]]:
    """By image the labels that each option finds which loosens one of the image's gates."""
    verdicts = [verdict for own, _ in examined for verdict in own]
    tried = trials(verdicts, run.camera.width * run.camera.height, run.options.ellipses)
    attempts = []
    for job, (own, problem) in zip(jobs, examined, strict=True):
        gates = {verdict.gate for verdict in own} or {"min_diameter"}
        useful = [trial for trial in tried if trial.gate in gates]
        if useful and not problem:
            attempts.append((job, useful))
    found = _side_by_side(_try, attempts, "try options", workers, progress)
    return {job.name: labels for (job, _), labels in zip(attempts, found, strict=True)}


def _try(job: _Job, tried: list[OptionTrial]) -> dict[str, set[str]]:
    """Labels that each option finds; for an image without a pose those known, if they are enough to place it."""
    image, problem = _decoded(job)
    if image is None:
        raise InputError("E-RUN-IMAGES", problem)
    found = {}
    for trial in tried:
        labels = labels_found(image, job.camera, job.target, job.board, trial.options, job.expected)
        placed = not job.known or len(labels & job.known) >= MIN_POINTS
        found[trial.text] = labels if placed else set()
    return found


def _shown_with(run: SavedRun, mapped: set[str], options) -> dict[str, list[dict[str, set[str]]]]:
    """For each option, by group, the labels that every image then shows; none where it has no pose even then."""
    return {
        text: [
            {
                image.name: options.get(image.name, {})
                .get(text, set())
                .union(image.labels if image.name in mapped else ())
                for image in group
            }
            for group in run.groups().values()
        ]
        for text in dict.fromkeys(text for found in options.values() for text in found)
    }


def _with_options(finding: Finding, options, shown: dict[str, list[dict[str, set[str]]]]) -> Finding:
    """A finding that is not of one place in one image, with the options that help: those that place the image, or
    show the circles in enough images of a group."""
    if finding.gate == "known_circles":
        return replace(finding, options=tuple(text for text, found in options.get(finding.image, {}).items() if found))
    if finding.gate != "views":
        return finding
    helping = []
    for text, groups in shown.items():
        own = [group for group in groups if not finding.image or finding.image in group]
        views = [sum(labels.issuperset(finding.labels) for labels in group.values()) for group in own]
        if max(views, default=0) >= MIN_VIEWS:
            helping.append(text)
    return replace(finding, options=tuple(helping))


def _findings(job: _Job, verdicts: list[CircleVerdict], problem: str, options: dict[str, set[str]]) -> list[Finding]:
    """``options`` : labels that each option finds in the image."""
    findings = []
    for v in verdicts:
        remedy = advice(v.gate, v.value, v.limit, v.cause)
        if problem:
            remedy = f"not examined ({problem}): give the folder of the images with --images"
        helping = tuple(text for text, labels in options.items() if v.label in labels)
        findings.append(Finding(job.name, (v.label,), v.gate, v.value, v.limit, v.unit, remedy, helping))
    return findings
