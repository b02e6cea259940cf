"""Why circles, faces or images of a run are missing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode
from stcal.parallel import Progress, run_in_order
from stcal.sfm.data.model import MIN_POINTS, ImageObservations, MetricModel
from stcal.sfm.data.patterns import Pattern, ideal_border, in_view, patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.labels import leaves_a_pattern_out
from stcal.sfm.diagnose.examine import CircleVerdict, Expected, OptionTrial, by_geometry, examine, labels_found, trials
from stcal.sfm.diagnose.findings import WHOLE_PATTERN, Diagnosis, Finding, advice, in_order
from stcal.sfm.report.sections import Words
from stcal.sfm.runs.saved import AnyRun, SavedRun, read_target_model, saved_run

MIN_MAPPED = 3
"""Least number of mapped circles that place the others of their plane."""


def missing_circles(
    model: MetricModel,
    circles: dict[str, np.ndarray],
    observations: dict[str, ImageObservations],
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
) -> dict[str, list[Expected]]:
    """Returns, by image of one group, the planes with circles that should be visible but have no label.

    ``model`` : the model of the group, target frame, mm; ``circles`` : centres of the target's circles, (3,) by label,
    target frame, mm; centres of the model take precedence; ``observations`` : observations by image.
    """
    xyz = circles | dict(zip(model.labels, model.xyz_model, strict=True))
    patterns = patterns_of(target, board).values()
    placed = [(pattern, pose) for pattern in patterns if (pose := _placed(pattern, xyz)) is not None]
    border = ideal_border(camera)
    planes_by_image = {}
    for name, camera_from_target in zip(model.images, model.camera_from_model, strict=True):
        labels_observed = set(observations[name].labels)
        planes = []
        for pattern, target_from_plane in placed:
            pose = camera_from_target @ target_from_plane
            missing = in_view(pattern, pose, camera, border) & [
                label not in labels_observed for label in pattern.labels
            ]
            if missing.any():
                planes.append(Expected(pattern, pose, missing))
        if planes:
            planes_by_image[name] = planes
    return planes_by_image


def _placed(pattern: Pattern, xyz: dict[str, np.ndarray]) -> Rigid | None:
    """Returns target_from_plane, fitted to the mapped circles, or None if they are too few or collinear."""
    mapped_rows = [i for i, label in enumerate(pattern.labels) if label in xyz]
    if len(mapped_rows) < MIN_MAPPED:
        return None
    try:
        return align_rigid(np.array([xyz[pattern.labels[i]] for i in mapped_rows]), pattern.xyz_mm()[mapped_rows])
    except DegenerateError:
        return None


MIN_VIEWS = 2
NOTHING_KNOWN = "is it sharp and well lit? "


@require_arguments
def doctor(
    run: AnyRun,
    images: str | Path | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Finds every image and circle that a run left out, and why.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.
    images : str or Path, optional
        Folder of the photographs, if it has moved since the run.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Diagnosis
        ``findings``, the most useful to know first: what was left out, the threshold that stopped it, its value, and
        what would let it in.

    Raises
    ------
    InputError
        The run is damaged or of another version, or the folder of photographs does not exist.
    """
    run = saved_run(run)
    if images is not None and not Path(images).is_dir():
        raise InputError(
            "E-IMAGES-FOLDER", f"image folder {images}: not a folder; give the folder of the run's images with --images"
        )
    models = read_target_model(run).in_mm()
    mapped = {name for model in models for name in model.images}
    try:
        findings = [*_files(run), *_images(run, mapped), *_circles(run), *_faces(run), *_unread(run, models)]
        files, circles = run.report["summary"]["files"], run.faces.circles
    except (KeyError, TypeError) as error:
        raise InputError("E-RUN-VERSION", f"run {run.folder}: of another version ({error}); run it again") from error
    jobs = _jobs(run, Path(images or run.images), models, circles)
    examined = run_in_order(_examine, [(job,) for job in jobs], workers, progress and partial(progress, "examine"))
    options = _try_options(run, jobs, examined, workers, progress)
    for job, (verdicts, problem) in zip(jobs, examined, strict=True):
        findings += _findings(job, verdicts, problem, options.get(job.name, {}))
    shown = _shown_with(run, mapped, options)
    findings = [_with_options(finding, options, shown) for finding in findings]
    observed = sum(len(model.image_index) for model in models)
    point = Words.of(run.report).point
    return Diagnosis(files, len(run.observations), len(mapped), observed, in_order(findings), point)


def _files(run: SavedRun) -> list[Finding]:
    return [
        Finding(file["name"], (), file["gate"], file["value"], file["limit"], "", _remedy_in(file))
        for file in run.report["left_out"]["files"]
    ]


def _images(run: SavedRun, mapped: set[str]) -> list[Finding]:
    """Returns findings on images without a pose, and on faces and boards left out of mapped images. All other images
    are examined later."""
    left_out = run.report["left_out"]
    findings = [
        Finding(
            entry["name"],
            (),
            entry["gate"],
            entry["value"],
            entry["limit"],
            Words.of(run.report).points,
            (NOTHING_KNOWN if entry["value"] == 0 else "") + _remedy_in(entry),
        )
        for entry in left_out["images"]
    ]
    reported = {finding.image for finding in findings}
    findings += [
        Finding(image.name, (), "group", None, None, "", f"link group {image.group} to the others by a face of theirs")
        for image in run.observations
        if image.name not in mapped | reported
    ]
    for entry in left_out["notes"]:
        if entry["image"] not in mapped:
            findings.append(Finding(entry["image"], (), "note", None, None, "", entry["note"]))
        elif leaves_a_pattern_out(entry["note"]):
            findings.append(Finding(entry["image"], (), WHOLE_PATTERN, None, None, "", entry["note"]))
    return findings


def _circles(run: SavedRun) -> list[Finding]:
    """Returns findings on labelled circles that are not in the model."""
    return [
        Finding(
            circle["image"],
            (circle["label"],),
            circle["gate"],
            circle["value"],
            circle["limit"],
            circle["unit"],
            advice(circle["gate"]),
        )
        for circle in run.report["left_out"]["circles"]
    ]


def _faces(run: SavedRun) -> list[Finding]:
    """Returns findings on faces that no image helps to place, and the run's notes."""
    findings = []
    for face_id in run.report["summary"]["faces_not_seen"]:
        labels = tuple(run.target_design.face(face_id).labels())
        views = sum(bool(set(labels) & set(image.labels)) for image in run.observations)
        findings.append(Finding("", labels, "views", views, MIN_VIEWS, "images", advice("views")))
    notes = [*run.report["notes"], *_depth_of_field(run)]
    return findings + [Finding("", (), "note", None, None, "", note) for note in notes]


MAX_TILT_DEG = 60.0
"""Largest tilt of a face at which its tags are to be read."""


def _unread(run: SavedRun, models: Sequence[MetricModel]) -> list[Finding]:
    """Returns findings on faces with boards or tags that an image shows whole, at a moderate tilt, without a corner."""
    poses, size = run.faces.poses(), np.array([run.camera.width, run.camera.height])
    seen = {image.name: {str(label).partition(":")[0] for label in image.labels} for image in run.observations}
    findings = []
    for face in run.target_design.with_faces(printed=True).faces:
        if face.id not in poses:
            continue
        for name, pose in (
            (name, pose) for m in models for name, pose in zip(m.images, m.camera_from_model, strict=True)
        ):
            camera_from_face = pose @ poses[face.id]
            xyz = camera_from_face @ face.places_mm(face.ids)
            ray = xyz.mean(0) / np.linalg.norm(xyz.mean(0))
            tilt = float(np.degrees(np.arccos(np.clip(-face.outward * camera_from_face.rotation[:, 2] @ ray, -1, 1))))
            if face.id in seen[name] or tilt > MAX_TILT_DEG or (xyz[:, 2] <= 0).any():
                continue
            pixels = run.camera.project(xyz)
            if ((pixels > 0) & (pixels < size - 1)).all():
                labels = tuple(str(label) for label in face.labels())
                findings.append(Finding(name, labels, "tags", round(tilt), None, "° tilt", advice("tags")))
    return findings


def _depth_of_field(run: SavedRun) -> list[str]:
    """Returns which f-number and distance keep what depth of field moves centres by below their σ, if more is moved.

    The shift grows with the square of the aperture's diameter, and falls with the third power of the distance.
    """
    rows = [row for row in run.report["focus"] if row["shift_px"] > 0]
    if not rows:
        return []
    worst = max(rows, key=lambda row: row["shift_px"])
    sigma = float(np.median(np.concatenate([image.sigma_px() for image in run.observations])))
    times = worst["shift_px"] / sigma
    if times <= 1:
        return []
    return [
        f"depth of field moves centres by up to {worst['shift_px']:.3f} px ({worst['image']}), {times:.0f} times their "
        f"σ, which is corrected to about 15 %; it is below σ from {np.sqrt(times):.1f} times the f-number "
        f"({np.ceil(np.log2(times)):.0f} stops), or from {times ** (1 / 3):.1f} times the distance"
    ]


def _remedy_in(left_out: dict) -> str:
    """Returns the advice at the end of a reason, or the whole reason if it comes without a value."""
    reason = left_out["reason"]
    return reason if left_out["value"] is None else reason.partition("; ")[2] or reason


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """An image to open and examine.

    ``expected`` : circles to examine; if empty, options are tried to see whether enough of the ``known`` circles would
    be found to place the image.
    """

    path: Path
    name: str
    camera: Camera
    target: TargetDesign
    board: BoardDesign
    options: EllipseOptions
    expected: list[Expected]
    known: frozenset[str]


def _jobs(run: SavedRun, images: Path, models: Sequence[MetricModel], circles: dict[str, np.ndarray]) -> list[_Job]:
    """Returns jobs for mapped images that lack visible circles, and for images without a pose. Groups without a model
    have no jobs."""
    target = run.target_design.with_faces(printed=False)
    settings = run.camera, target, run.board_design, run.options.ellipses
    if not (target.faces or run.board_design.rows):
        return []  # corners are not circles, and no option for circles lets them in
    observations = {image.name: image for image in run.observations}
    jobs = []
    for model in models:
        missing = missing_circles(model, circles, observations, run.camera, target, run.board_design)
        jobs += [_Job(images / name, name, *settings, planes, frozenset()) for name, planes in missing.items()]
        jobs += [
            _Job(images / name, name, *settings, [], frozenset(model.labels))
            for name, image in observations.items()
            if image.group == model.group and name not in model.images
        ]
    return jobs


def _decoded(job: _Job) -> tuple[np.ndarray | None, str]:
    """Returns the image, or None and what is wrong with it."""
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
    """Returns verdicts on the expected circles of an image. They come from the geometry alone if the image cannot be
    used."""
    image, problem = _decoded(job)
    if image is None:
        return by_geometry(job.expected, job.camera, job.options), problem
    return examine(image, job.camera, job.target, job.board, job.options, job.expected) if job.expected else [], ""


def _try_options(run: SavedRun, jobs, examined, workers, progress) -> dict[str, dict[str, set[str]]]:
    """Returns, by image, the labels that each option finds. Only options that loosen a gate of the image are tried."""
    verdicts = [verdict for image_verdicts, _ in examined for verdict in image_verdicts]
    all_trials = trials(verdicts, run.camera.width * run.camera.height, run.options.ellipses)
    attempts = []
    for job, (image_verdicts, problem) in zip(jobs, examined, strict=True):
        gates = {verdict.gate for verdict in image_verdicts} or {"min_diameter"}
        useful = [trial for trial in all_trials if trial.gate in gates]
        if useful and not problem:
            attempts.append((job, useful))
    results = run_in_order(_try, attempts, workers, progress and partial(progress, "try options"))
    return {job.name: labels for (job, _), labels in zip(attempts, results, strict=True)}


def _try(job: _Job, tried: list[OptionTrial]) -> dict[str, set[str]]:
    """Returns the labels that each option finds. An image without a pose has labels only if enough known circles are
    found to place it."""
    image, problem = _decoded(job)
    if image is None:
        raise InputError("E-RUN-IMAGES", problem)
    labels_by_option = {}
    for trial in tried:
        labels = labels_found(image, job.camera, job.target, job.board, trial.options, job.expected)
        placed = not job.known or len(labels & job.known) >= MIN_POINTS
        labels_by_option[trial.text] = labels if placed else set()
    return labels_by_option


def _shown_with(run: SavedRun, mapped: set[str], options) -> dict[str, list[dict[str, set[str]]]]:
    """Returns, for each option and group, the labels that every image then shows.

    An image that even then has no pose shows none.
    """
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
        for text in dict.fromkeys(text for labels_by_option in options.values() for text in labels_by_option)
    }


def _with_options(finding: Finding, options, shown: dict[str, list[dict[str, set[str]]]]) -> Finding:
    """Adds the options that help to a finding that does not concern one place in one image.

    These options place the image, or show the circles in enough images of a group.
    """
    if finding.gate == "known_circles":
        return replace(
            finding,
            options=tuple(text for text, shown_labels in options.get(finding.image, {}).items() if shown_labels),
        )
    if finding.gate != "views":
        return finding
    helping = []
    for text, groups in shown.items():
        groups_of_finding = [group for group in groups if not finding.image or finding.image in group]
        views = [sum(labels.issuperset(finding.labels) for labels in group.values()) for group in groups_of_finding]
        if max(views, default=0) >= MIN_VIEWS:
            helping.append(text)
    return replace(finding, options=tuple(helping))


def _findings(job: _Job, verdicts: list[CircleVerdict], problem: str, options: dict[str, set[str]]) -> list[Finding]:
    """Returns the findings of one image. ``options`` : labels that each option finds in the image."""
    findings = []
    for verdict in verdicts:
        remedy = advice(verdict.gate, verdict.value, verdict.limit, verdict.cause)
        if problem:
            remedy = f"not examined ({problem}): give the folder of the images with --images"
        helping = tuple(text for text, labels in options.items() if verdict.label in labels)
        findings.append(
            Finding(
                job.name, (verdict.label,), verdict.gate, verdict.value, verdict.limit, verdict.unit, remedy, helping
            )
        )
    return findings
