"""Text for the terminal, and what a notebook shows: the findings of a run or a detection in a few lines."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from stcal.design import faces_of_known_shape, known_distances
from stcal.io.files import REFINED_CAMERA
from stcal.labels import DotLabel
from stcal.report.document import Block, Document, Printed, Section, Table
from stcal.report.text import join, wrapped
from stcal.sfm.detect.detect_files import DetectionResult
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.detect.predict import REMEDIES
from stcal.sfm.report.check import BY_CHANCE, Check, count_verdicts, ranked
from stcal.sfm.report.compare import comparison_cells
from stcal.sfm.report.judgement import QUESTIONS, without_sigma_of
from stcal.sfm.report.run_page import CONTROL, PUBLISHED, faces_table
from stcal.sfm.runs.report_file import face_row
from stcal.sfm.runs.run_result import RunResult

WEAK_FOCAL = 0.01
"""Relative σ of a focal length beyond which the views lack what determines it."""
FIRST = 20
"""Number of images that are named."""


def run_text(result: RunResult) -> str:
    """Returns the result of a run for the terminal."""
    return "\n".join(part for line in document_of(result).text().splitlines() for part in wrapped(line))


def document_of(result: RunResult) -> Document:
    """Returns the result of a run in short: the verdict, faces with σ, checks that did not pass, and remarks."""
    verdict, *others = [] if result.judgement is None else result.judgement.answers()
    blocks: list[Block] = []
    faces = {face: face_row(result, face) for face in result.target.target_from_face}
    if faces:
        failed = result.judgement is not None and result.judgement.verdict == "no"
        blocks.append(faces_table(without_sigma_of(faces) if failed else faces, result.target.reference_face))
    else:
        blocks += _boards(result)
    blocks += _checks(result.checks, frozenset(image.name for image in result.observations))
    if result.comparison is not None:
        heads, compared = comparison_cells(result.comparison.model_dump())
        blocks += [
            "compared with Zhang & Wei (2017): distance of faces from the last row's, three-point frames; steps add up",
            Table(heads, compared),
            *(f"{row.method}: {row.reason}" for row in result.comparison.rows if row.reason),
        ]
    blocks.append(Printed([*result.notes, *_remarks(result)]))
    if (out := result.out) is not None:
        files = [f"faces:  {out / 'faces.json'}"] if faces else []
        files += [f"camera: {out / REFINED_CAMERA}, as adjusted, with σ"] if result.refined_camera else []
        blocks.append(Printed([*files, f"report: {out / 'report.html'}"]))
    first = " ".join(verdict) if verdict else QUESTIONS["use"] + " It was not judged."
    answers = [f"{question} {answer}" for question, answer in others]
    return Document(result.target_design.name, first, [Section("", blocks, terminal=True)], answers)


def _remarks(result: RunResult) -> Iterator[str]:
    """Yields what was left out, on what the size and the camera rest, and what was corrected."""
    unmapped = [f"left out {name}: {why}" for solution in result.solutions for name, why in solution.left_out.items()]
    noted = [image.observations.name for image in result.labelled if image.notes]
    outliers = sum(len(solution.outliers) for solution in result.solutions)
    for lines in (_skipped(result.detection), unmapped):
        yield from lines[:FIRST]
        if len(lines) > FIRST:
            yield f"and {len(lines) - FIRST} more, which the report names"
    if noted:
        more = f" and {len(noted) - FIRST} more" if len(noted) > FIRST else ""
        yield f"something was left out in {join(noted[:FIRST])}{more}; the report says what and why"
    if outliers:
        yield f"{outliers} {result.target_design.points} left out that contradict the others"
    yield from _scale_of_target(result)
    yield from _found_camera(result)
    yield from _rims(result)
    if result.options.solve == "paper" or not result.options.eccentricity:
        yield PUBLISHED if result.options.solve == "paper" else CONTROL
    if result.camera.covariance is not None and not result.options.refine_camera:
        yield (
            f"the camera file states σ of its parameters ({np.sqrt(result.camera.covariance[0, 0]):.2g} px of the "
            "focal length), and this run takes them as exact: no σ below includes them; --refine-camera adjusts the "
            "intrinsics within them and includes them in all σ"
        )


def _scale_of_target(result: RunResult) -> Iterator[str]:
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
    if "drawing" in sources:
        (drawn,) = known_distances(result.board_design)
        yield (
            f"scale: unknown, nothing of known size is in view; the unit is such that {drawn.first} and {drawn.second} "
            f"are {drawn.mm:g} mm apart, as drawn"
        )
    if count and "faces" not in sources:
        yield f"scale: from {distances}"


def _found_camera(result: RunResult) -> Iterator[str]:
    """Yields how well a camera that was found from the photographs is determined, and what the views lack."""
    refined = result.refined_camera
    if result.camera_given or refined is None or refined.covariance is None:
        return
    sigma = np.sqrt(np.diag(refined.covariance))
    focal, centre = refined.focal, refined.centre
    yield (
        f"camera: found from the photographs: f {focal[0]:.2f} ± {sigma[0]:.2f}, {focal[1]:.2f} ± {sigma[1]:.2f} px, "
        f"principal point {centre[0]:.2f} ± {sigma[2]:.2f}, {centre[1]:.2f} ± {sigma[3]:.2f} px from the centre of the "
        "first pixel (in the camera file from that pixel's corner, as in COLMAP: there 0.5 px more)"
    )
    if sigma[0] > WEAK_FOCAL * focal[0]:
        yield (
            f"camera: the focal length is known to {100 * sigma[0] / focal[0]:.1f} % alone: take views from a shorter "
            f"distance, and of faces tilted by 30° to 60°, or give a camera file"
        )


def _rims(result: RunResult) -> Iterator[str]:
    """Yields what the result allows for of rims before the circles of the faces and the dots of the board."""
    calibration, of_dots = result.calibration, result.board_design.rim_mm
    if calibration.rim_mm:
        height, sigma = float(np.mean(list(calibration.rim_mm.values()))), calibration.rim_sigma_mm
        source = f" ± {sigma:.3f} mm, as estimated" if sigma else " mm, as stated"
        yield f"rims: faces are those of the luminous surface, behind rims of {height:.3f}{source}"
    if of_dots:
        yield (
            f"rims: dots of the board are seen {of_dots / 2:.3f} mm before its surface, as stated, and no face depends "
            "on it"
        )


def detection_text(detection: DetectionResult, labelled: Sequence[LabelledImage]) -> str:
    """Returns faces and dots of each image, and what was left out."""
    return "\n".join([*found_lines(labelled), *_skipped(detection), found_in_all(labelled)])


def _skipped(detection: DetectionResult) -> list[str]:
    return [f"skipped {file.name}: {file.reason}" for file in detection.skipped]


def found_in_all(labelled: Sequence[LabelledImage]) -> str:
    """Returns in how many images faces and board are, and what was left out in most of them."""
    images, count = [each.observations for each in labelled], len(labelled)
    faces = sum(bool(image.face_ids()) for image in images)
    dots = sum(any(isinstance(label, DotLabel) for label in image.labels) for image in images)
    alike: dict[str, list[str]] = {}
    for each in labelled:
        for kind, note in {re.sub(r"[\d.:]+", "", note): note for note in each.notes}.items():
            alike.setdefault(kind, []).append(note)
    most = max(alike.values(), key=len, default=[])
    reason = f"; in {len(most)} of {count}: {most[0]}" if most else ""
    return f"a face in {faces} of {count} images, the board in {dots}{reason}"


def found_lines(labelled: Sequence[LabelledImage]) -> Iterator[str]:
    """Yields faces and dots of each image, and what was left out in it and helps."""
    counts = [sum(isinstance(label, DotLabel) for label in each.observations.labels) for each in labelled]
    for each, dots in zip(labelled, counts, strict=True):
        image = each.observations
        faces = ", ".join(sorted(image.face_ids())) or "none"
        yield f"{image.name}: faces {faces} ({len(image) - dots} circles), board {dots} dots"
        yield from (f"  {note}" for note in each.notes)
        if not image.face_ids():
            yield f"  no face is read: {REMEDIES['face']}"
        if any(counts) and not dots:
            yield f"  the board is not read: {REMEDIES['board']}"


def _boards(result: RunResult) -> list[Block]:
    """Returns λ and residuals of the board alone."""
    rows = [
        [name, len(s.labels)]
        + [f"{each:.6g}" for each in (s.mm_per_unit, s.rows_mm_per_unit)]
        + [f"{1e3 * each:.2f}" for each in (s.mean_mm(), s.spread_mm())]
        for name, s in result.calibration.scales.items()
    ]
    return [
        f"the board alone: no face of the target in {len(result.labelled)} images, so that there is no faces.json; "
        "length of the board's residuals, as in table 1 of Zhang & Wei (2017)",
        Table(["<group", "dots", "λ mm/unit", "λ by rows", "mean µm", "± µm"], rows),
    ]


def _checks(checks: Sequence[Check], images: frozenset[str]) -> Iterator[str]:
    """Yields the checks that did not pass, the worst first."""
    doubtful = [check for check in ranked(checks, images) if check.verdict in ("failed", "suspicious")]
    if doubtful:
        yield f"checks: {count_verdicts(checks)} ({BY_CHANCE})"
    for check in doubtful:
        yield f"{check.verdict}: {check.title}: {check.reason}{'; ' * bool(check.remedy)}{check.remedy}"
