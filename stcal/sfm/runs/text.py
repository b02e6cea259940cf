"""Text for the terminal: the findings of a run or a detection in a few lines."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stcal.design import faces_of_known_shape, known_distances
from stcal.geometry.camera import Camera
from stcal.io.files import REFINED_CAMERA
from stcal.io.images import TOP_GROUP, Skipped
from stcal.labels import DotLabel
from stcal.report.text import text_table, wrapped
from stcal.sfm.adjust.scale import Scale
from stcal.sfm.checks.verdict import BY_CHANCE, Check, ranked
from stcal.sfm.detect.files import DetectionResult
from stcal.sfm.detect.labels import LabelledImage
from stcal.sfm.detect.predict import REMEDIES
from stcal.sfm.report.compare import comparison_cells
from stcal.sfm.report.judgement import applies, images_left_out
from stcal.sfm.report.sections import NOT_APPLICABLE, count_verdicts
from stcal.sfm.runs.result import Comparison, RunResult
from stcal.sfm.runs.solve import GroupSolution

WEAK_FOCAL = 0.01
"""Relative σ of a focal length beyond which the views lack what determines it."""
NOTED, NAMED = 4, 6
"""Number of images whose notes are printed, and number of further images that are named."""


def run_text(result: RunResult) -> str:
    """Returns the result of a run: groups, what was left out, faces with σ, and checks that did not pass."""
    lines = [*_skipped(result.detection.skipped)]
    for solution in result.solutions:
        lines += _group(solution, result.calibration.scales[solution.model.group], result.target_design.points)
    lines += result.notes
    lines += _noted(result.labelled)
    lines += [*_scale_of_target(result), *_found_camera(result)]
    lines += [*_defocus(result.labelled), *_rims(result)]
    if result.options.solve == "paper":
        lines.append(
            "as published, for comparison: centres of contours with equal weights, without the eccentricity; faces "
            "are off by tens of µm, and no residual shows it"
        )
    elif not result.options.eccentricity:
        lines.append(
            "uncorrected control: without the eccentricity faces are off by tens of µm, and no residual shows it"
        )
    if result.camera.covariance is not None and not result.options.refine_camera:
        lines.append(_camera_taken_as_exact(result.camera))
    reused = sum(image.reused for image in result.detection.images)
    if reused:
        lines.append(f"detections kept from an earlier run: {reused} of {len(result.detection.images)}")
    lines += [
        *(_faces(result) if result.target.target_from_face else _boards(result)),
        *_checks(result.checks, frozenset(image.name for image in result.observations())),
    ]
    if result.comparison is not None:
        lines += _compared(result.comparison)
    if result.judgement is not None:
        lines += [f"{question} {answer}" for question, answer in result.judgement.answers()]
    if result.out is not None and result.target.target_from_face:
        lines.append(f"faces:  {result.out / 'faces.json'}")
    if result.out is not None and result.refined_camera is not None:
        lines.append(f"camera: {result.out / REFINED_CAMERA}, as adjusted, with σ")
    if result.out is not None:
        lines.append(f"report: {result.out / 'report.html'}")
    return "\n".join(part for line in lines for part in wrapped(line))


def _camera_taken_as_exact(camera: Camera) -> str:
    """Returns the note on a camera file that states σ which the run does not use."""
    assert camera.covariance is not None
    focal = float(np.sqrt(camera.covariance[0, 0]))
    return (
        f"the camera file states σ of its parameters ({focal:.2g} px of the focal length), and this run takes them as "
        f"exact: no σ below includes them; --refine-camera adjusts the intrinsics within them and includes them in "
        f"all σ"
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


def _defocus(labelled: Sequence[LabelledImage]) -> list[str]:
    """Returns what was corrected for blur that varies across a circle, if anything was."""
    corrected = [image.focus for image in labelled if image.focus is not None and image.focus.shift_px > 0]
    if not corrected:
        return []
    most = max(corrected, key=lambda focus: focus.shift_px)
    plane = "" if most.focused_mm is None else f", in focus at {most.focused_mm:.0f} mm"
    return [
        f"depth of field: centres of {len(corrected)} images corrected, by up to {most.shift_px:.4f} px ({most.image}: "
        f"blur {most.blur_px[0]:.2f} px at {most.depth_mm[0]:.0f} mm, {most.blur_px[1]:.2f} at "
        f"{most.depth_mm[1]:.0f} mm{plane})"
    ]


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
    return "\n".join([*found_lines(labelled), *_skipped(detection.skipped), found_in_all(labelled)])


def found_in_all(labelled: Sequence[LabelledImage]) -> str:
    """Returns in how many images faces and board are, and what was left out in most of them."""
    images, count = [each.observations for each in labelled], len(labelled)
    faces = sum(bool(image.face_ids()) for image in images)
    dots = sum(any(isinstance(label, DotLabel) for label in image.labels) for image in images)
    alike: dict[str, list[str]] = {}
    for each in labelled:
        for note in {re.sub(r"[\d.:]+", "", note): note for note in each.notes}.items():
            alike.setdefault(note[0], []).append(note[1])
    most = max(alike.values(), key=len, default=[])
    reason = f"; in {len(most)} of {count}: {most[0]}" if most else ""
    return f"a face in {faces} of {count} images, the board in {dots}{reason}"


def found_lines(labelled: Sequence[LabelledImage]) -> Iterator[str]:
    """Yields faces and dots of each image, and what was left out in it and helps."""
    board_seen = any(isinstance(label, DotLabel) for each in labelled for label in each.observations.labels)
    for labelled_image in labelled:
        image = labelled_image.observations
        dots = sum(isinstance(label, DotLabel) for label in image.labels)
        faces = ", ".join(sorted(image.face_ids())) or "none"
        yield f"{image.name}: faces {faces} ({len(image) - dots} circles), board {dots} dots"
        yield from (f"  {note}" for note in labelled_image.notes)
        if not image.face_ids():
            yield f"  no face is read: {REMEDIES['face']}"
        if board_seen and not dots:
            yield f"  the board is not read: {REMEDIES['board']}"


def _skipped(skipped: Sequence[Skipped]) -> Iterator[str]:
    return (f"skipped {file.name}: {file.reason}" for file in skipped)


def _noted(labelled: Sequence[LabelledImage]) -> Iterator[str]:
    """Yields what was left out within images: notes of the first images, names of the others."""
    noted = {image.observations.name: image.notes for image in labelled if image.notes}
    for name in list(noted)[:NOTED]:
        yield from (f"{name}: {note}" for note in noted[name])
    if others := list(noted)[NOTED:]:
        surplus = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
        yield f"something was left out in {', '.join(others[:NAMED])}{surplus} too; the report says what and why"


def _group(solution: GroupSolution, scale: Scale, points: str) -> Iterator[str]:
    pair = solution.pairs[0]
    of_scale = {"board": "board", "faces": "printed faces", "distances": "known distances", "drawing": "drawing"}[
        scale.source
    ]
    name = "all images together" if solution.model.group == TOP_GROUP else f"group {solution.model.group}"
    yield (
        f"{name}: {len(solution.model.images)} images, {len(solution.model.labels)} {points}, "
        f"initial pair {Path(pair.first).name} – {Path(pair.second).name} at "
        f"{np.degrees(pair.median_angle_rad):.0f}°, {of_scale} {1e3 * scale.rms_mm():.1f} µm RMS"
    )
    for name, reason in solution.left_out.items():
        yield f"left out {name}: {reason}"
    for outlier in solution.outliers:
        yield f"left out {outlier.image} {outlier.label}: residual {outlier.residual_px:.3f} px"


def _faces(result: RunResult) -> Iterator[str]:
    target = result.target
    failed = result.judgement is not None and result.judgement.verdict == "no"
    face_covariance = {} if failed else target.face_covariance
    sigma_heading = "   σ position µm      σ rotation mdeg" if face_covariance else ""
    yield f"{'face':>6} {'x':>10} {'y':>10} {'z':>10} mm{sigma_heading}"
    for face_id, pose in target.target_from_face.items():
        x, y, z = pose.translation
        line = f"{face_id:>6} {x:10.4f} {y:10.4f} {z:10.4f}"
        covariance = face_covariance.get(face_id)
        if face_id == target.reference_face:
            line += "      reference"
        elif covariance is not None:
            sigma = np.sqrt(np.maximum(np.diag(covariance), 0))
            position = " ".join(f"{1e3 * s:5.1f}" for s in sigma[3:])
            rotation = " ".join(f"{1e3 * np.degrees(s):5.2f}" for s in sigma[:3])
            line += f"    {position}   {rotation}"
        yield line
    absent = [f.id for f in result.target_design.faces if f.id not in target.target_from_face]
    notes = [(image.observations.name, note) for image in result.labelled for note in image.notes]
    used = {name for solution in result.solutions for name in solution.model.images}
    unseen = []
    for face in absent:
        shown = [i.name for i in result.observations() if any(label.plane == face for label in i.labels)]
        if images := images_left_out(face, notes):
            yield f"read and left out, of {len(images)} images: face {face}"
        elif len(shown) == 1:
            yield f"face {face} is not in the result: seen in 1 image; 2 needed, better 5"
        elif shown:
            why = "but by too few points for its frame" if used.intersection(shown) else "which were left out"
            yield f"face {face} is not in the result: seen in {len(shown)} images, {why}"
        else:
            unseen.append(face)
    if unseen:
        yield f"not seen in any image: face{'' if len(unseen) == 1 else 's'} {', '.join(unseen)}"


def _boards(result: RunResult) -> Iterator[str]:
    """Yields λ and residuals of the board alone."""
    images = len(result.labelled)
    yield (
        f"the board alone: no face of the target in {images} images, so that there is no faces.json; length of the "
        "board's residuals, as in table 1 of Zhang & Wei (2017)"
    )
    rows = [["<group", "dots", "λ mm/unit", "λ by rows", "mean µm", "± µm"]]
    for name, scale in result.calibration.scales.items():
        residuals = [f"{1e3 * value:.2f}" for value in (scale.mean_mm(), scale.spread_mm())]
        lengths = [f"{value:.6g}" for value in (scale.mm_per_unit, scale.rows_mm_per_unit)]
        rows.append([name, str(len(scale.labels)), *lengths, *residuals])
    yield from (f"  {line}" for line in text_table(rows))


def _checks(checks: Sequence[Check], images: frozenset[str]) -> Iterator[str]:
    """Yields the number of checks with each verdict, and those that did not pass, the worst first."""
    yield f"checks: {count_verdicts([(check.verdict, check.remedy) for check in checks])}"
    if any(check.verdict in ("failed", "suspicious") for check in checks):
        yield f"  ({BY_CHANCE})"
    no_matter = [check for check in checks if not applies(check.verdict, check.remedy)]
    for check in ranked(checks, images):
        if check.verdict != "passed" and check not in no_matter:
            remedy = f"; {check.remedy}" if check.remedy else ""
            yield f"  {check.verdict}: {check.title}: {check.reason}{remedy}"
    if len(no_matter) == 1:
        yield f"  {NOT_APPLICABLE}: {no_matter[0].title}: {no_matter[0].reason}"
    elif no_matter:
        yield f"  {NOT_APPLICABLE} to what was photographed: {'; '.join(check.title for check in no_matter)}"


def _compared(comparison: Comparison) -> Iterator[str]:
    yield "compared with Zhang & Wei (2017): distance of faces from the last row's, three-point frames; steps add up"
    heads, rows = comparison_cells(comparison.model_dump())
    yield from (f"  {line}" for line in text_table([heads, *rows]))
    yield from (f"  {row.method}: {row.reason}" for row in comparison.rows if row.reason)
