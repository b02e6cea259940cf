"""Comparison of a result with the truth, or with another result."""

import warnings
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from stcal.errors import DegenerateError, InputError, InputNote
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.files import MODEL_BYTES, read_bytes, require_unchanged
from stcal.io.json import ByFace, ByImage, Part, Pose, PoseCovariance, ResultFile, Vector3, read_result
from stcal.io.table import FARTHEST, LENGTHS, csv_rows, read_table
from stcal.labels import BOARD, CircleLabel, DotLabel, parse_label, parse_labels
from stcal.report.text import number, text_table
from stcal.synthetic.dataset import TrueGroup, TrueImage, TruthFile

FACES = "faces.json"
LABELS = ("labels.csv", "detections.csv")  # labels of a run, and of a detection alone
NEAR_PX = 1.5  # from a label's ellipse centre to the true circle centre's image; eccentricity makes 0.2

MOST_LISTED = 20  # largest number of images that the table of poses has a row for
REMEDY = "give a finished run, and truth.json, as data_layout.md has them"
OF_A_UNIT = 0.1  # relative deviation of a ratio of distances from a unit's factor; runs are off by a few per cent


class ComparedFaces(Part):
    """Content of ``faces.json`` that is compared."""

    format: Literal["stcal faces 1"] = "stcal faces 1"
    unit: Literal["mm"]
    reference_face: str
    target_from_face: dict[str, Pose]
    circles: dict[str, Vector3]
    target_from_face_covariance: dict[str, PoseCovariance] = Field({})


class FaceErrors(Part):
    translation_um: float
    rotation_mdeg: float
    circles: int
    circles_mean_um: float | None
    circles_max_um: float | None
    translation_sigma_um: Vector3 | None = None
    rotation_sigma_mdeg: Vector3 | None = None
    normalised_error: float | None = None


class LargestErrors(Part):
    translation_um: float | None
    rotation_mdeg: float | None
    circles_mean_um: float | None


class LabelCounts(Part):
    wrong: int
    found: int
    visible: int
    images: int
    images_of_truth: int


class PoseErrors(Part):
    translation_um: float
    rotation_mdeg: float
    normalised_error: float | None = None


class ComparePosesFile(ResultFile):
    """Result of ``compare`` of measured poses."""

    images: dict[ByImage, PoseErrors] = Field(
        description="`translation_um`, `rotation_mdeg` of camera_from_target against the truth, camera frame; with "
        "covariances also `normalised_error` √(eᵀC⁻¹e/6), about 1 when σ is true, in all poses alike where their "
        "errors are common"
    )
    not_in_truth: list[str] = Field(description="measured images whose pose the truth does not state")


class CompareFile(ResultFile):
    """Result of ``compare``."""

    reference_face: str = Field(description="face id, the same in both")
    faces: dict[ByFace, FaceErrors] = Field(
        description="`translation_um`, `rotation_mdeg` of `target_from_face` against the truth; after a rigid fit of "
        "the face's `circles` (number in common) `circles_mean_um`, `circles_max_um`, null with fewer than three; with "
        "covariances in the run also `translation_sigma_um`, `rotation_sigma_mdeg` and, but for the reference face, "
        "`normalised_error` √(eᵀC⁻¹e/6), about 1 when σ is true"
    )
    missing: list[str] = Field(description="faces of the truth that the run lacks")
    worst: LargestErrors = Field(
        description="largest `translation_um`, `rotation_mdeg`, `circles_mean_um` of all faces"
    )
    labels: LabelCounts | None = Field(
        None,
        description="where the truth lists images that the run has: `wrong` labels (of circles that the truth knows; "
        "the board's numbers up to its symmetry), and `found` of the `visible` circles (`must_find`), in those "
        "`images` of the `images_of_truth` that have labels",
    )


@require_arguments
def compare(run: str | Path, truth: str | Path) -> CompareFile:
    """Returns the errors of a run's faces, circles and labels against the truth of a simulated data set.

    Parameters
    ----------
    run : The run's folder, or its ``faces.json`` alone; the labels are not compared then.
    truth : ``truth.json`` of the data set.

    Returns
    -------
    CompareFile
        Errors of each face, µm and millidegrees in the target frame, also over their σ; counts of wrong labels.

    Raises
    ------
    InputError
        A file is missing or has another form, or the reference faces differ.
    """
    run = Path(run)
    answer = read_result(run / FACES if run.is_dir() else run, ComparedFaces, "run", REMEDY)
    known = read_result(truth, TruthFile, "truth", REMEDY)
    for where, circles in ((run, answer.circles), (truth, known.circles)):
        for label, place in circles.items():
            if (far := max(map(abs, place))) > FARTHEST:  # its square would overflow
                length = f"{where}: circles.{label}: a length of {far:.3g}"
                raise InputError("E-VALUE-TOO-FAR", f"{length}, up to {FARTHEST:g} possible; correct it")
    if answer.reference_face != known.reference_face:
        fault = f"reference face {answer.reference_face} in the run, {known.reference_face} in the truth"
        raise InputError("E-COMPARE-REFERENCE", f"{fault}; run again with --reference-face {known.reference_face}")
    if not known.target_from_face.keys() & answer.target_from_face.keys():
        fault = f"run {run}, truth {truth}: no face in common"
        raise InputError("E-COMPARE-NO-FACE", f"{fault}; give the truth of the same target")
    origins = [{face: pose[:3, 3] for face, pose in side.target_from_face.items()} for side in (known, answer)]
    for kind, (true, found) in {"circles": (known.circles, answer.circles), "faces": origins}.items():
        common = [np.array([side[name] for name in true if name in found]).reshape(-1, 3) for side in (true, found)]
        true_mm, found_mm = (float(np.linalg.norm(xyz - xyz.mean(axis=0))) if len(xyz) else 0.0 for xyz in common)
        _require_same_unit(f"run {run}, truth {truth}", kind, true_mm, found_mm, "run")
    faces = {face: _face(face, answer, known) for face in known.target_from_face if face in answer.target_from_face}
    labels = None
    if run.is_dir() and known.groups:
        own = next((run / name for name in LABELS if (run / name).exists()), run / LABELS[0])
        labels = _labels(own, known.circles, known.groups)
    errors = {name: [getattr(face, name) for face in faces.values()] for name in LargestErrors.model_fields}
    worst = {name: max((v for v in values if v is not None), default=None) for name, values in errors.items()}
    missing = [face_id for face_id in known.target_from_face if face_id not in faces]
    counted = {"labels": labels} if labels else {}
    return CompareFile(
        reference_face=known.reference_face, faces=faces, missing=missing, worst=LargestErrors(**worst), **counted
    )


@require_arguments
def compare_poses(poses: str | Path, truth: str | Path) -> ComparePosesFile:
    """Returns the errors of measured poses against the truth of a simulated data set.

    Parameters
    ----------
    poses : ``poses.csv`` of ``measure``.
    truth : ``truth.json`` of the data set. Images are found in it by their name below ``images``, or by the name of the
        file where only one image has it.

    Returns
    -------
    ComparePosesFile : Errors of each pose, µm and millidegrees, also over its σ.

    Raises
    ------
    InputError
        A file is missing or has another form, or the truth states no pose of any image.
    """
    known = read_result(truth, TruthFile, "truth", REMEDY)
    true = {name: Rigid.from_matrix(pose) for name, pose in known.poses().items()}
    by_file: dict[str, list[str]] = {}
    for name in true:
        by_file.setdefault(Path(name).name, []).append(name)
    table = read_table(poses, "pose file")
    measured, covariance = table.poses(), table.pose_covariances()
    images: dict[str, PoseErrors] = {}
    unknown: list[str] = []
    distances: list[list[float]] = []
    for i, name in enumerate(table.text("image")):
        match [name] if name in true else by_file.get(Path(name).name, []):
            case [known_name]:
                pose = true[known_name]
                images[name] = _pose_errors(measured[i], pose, None if covariance is None else covariance[i])
                distances.append([float(np.linalg.norm(p.translation)) for p in (pose, measured[i])])
            case _:
                unknown.append(name)
    if not images:
        fault = f"{poses}, truth {truth}: no image in common that the truth states one pose of"
        names = f", with names like {next(iter(true))}" if true else ""
        raise InputError("E-COMPARE-IMAGES", f"{fault}; give the truth of the same photographs{names}")
    true_mm, measured_mm = np.median(distances, axis=0).tolist()
    _require_same_unit(f"poses {poses}, truth {truth}", "camera and target", true_mm, measured_mm, "poses")
    return ComparePosesFile(images=images, not_in_truth=unknown)


def _pose_errors(found: Rigid, true: Rigid, covariance: np.ndarray | None) -> PoseErrors:
    """Returns the errors of a pose, also over its (6, 6) covariance, rad and mm, if it is positive definite."""
    shift, turn = found.translation - true.translation, Rigid(found.rotation @ true.rotation.T)
    normalised = None
    if covariance is not None and np.linalg.eigvalsh(covariance)[0] > 0:
        error = np.concatenate([turn.log()[:3], shift])
        normalised = float(np.sqrt(error @ np.linalg.solve(covariance, error) / 6))
    um, mdeg = 1e3 * float(np.linalg.norm(shift)), 1e3 * float(np.degrees(turn.angle_rad()))
    return PoseErrors(translation_um=um, rotation_mdeg=mdeg, normalised_error=normalised)


def _require_same_unit(where: str, kind: str, true: float, measured: float, side: str) -> None:
    """Refuses lengths whose ratio is the factor of another unit than mm."""
    for unit, factor in LENGTHS.items():
        for name, small, large in (("truth", true, measured), (side, measured, true)):
            if unit != "mm" and small > 0 and abs(large / small / factor - 1) < OF_A_UNIT:
                times = f"{measured / true:.4g} times those of the truth, 1 ± {OF_A_UNIT:g} expected"
                remedy = f"if the {name} is in {unit}, multiply its lengths by {factor:g}"
                raise InputError("E-COMPARE-UNITS", f"{where}: distances between {kind} are {times}; {remedy}")


def _labels(path: Path, circles: Collection[str], groups: dict[str, TrueGroup]) -> LabelCounts | None:
    """Counts the labels against the truth; a board's numbers are known up to its symmetry, for a whole group."""
    try:
        rows = list(csv_rows(read_bytes(path, MODEL_BYTES).decode()))
        require_unchanged(path)
        measured: dict[str, dict[str, tuple[float, float]]] = {}
        for row in rows:
            labels, label = measured.setdefault(row["image"], {}), parse_label(row["label"])
            if label in circles or not isinstance(label, CircleLabel):  # else it is neither right nor wrong
                labels[label] = (float(row["x_px"]), float(row["y_px"]))
        total = np.zeros(3, int)
        for group in groups.values():
            dots = group.board_circles_target
            steps = np.diff(dots, axis=0)
            turned = np.flatnonzero(steps @ steps[0] < 0)  # the first step back ends a row
            grid = np.arange(len(dots)).reshape(-1, int(turned[0]) + 1 if len(turned) else len(dots))
            turns = [grid, np.rot90(grid, 2)]
            turns += [np.rot90(grid), np.rot90(grid, 3)] if grid.shape[0] == grid.shape[1] else []
            counts = [_count(measured, group.images, turn) for turn in turns]
            total += min(counts, key=lambda c: (c[0], -c[1]))
    except (OSError, KeyError, ValueError, TypeError, IndexError, InputError) as error:
        reason = getattr(error, "strerror", None) or "damaged"
        warnings.warn(f"{path}: {reason}: the labels are not compared with the truth", InputNote, stacklevel=2)
        return None
    if not total.any():
        return None
    true, (wrong, found, visible) = {name for group in groups.values() for name in group.images}, total.tolist()
    images = len(true & measured.keys())
    return LabelCounts(wrong=wrong, found=found, visible=visible, images=images, images_of_truth=len(true))


def _count(measured: dict, images: dict[str, TrueImage], numbers: np.ndarray) -> tuple[int, int, int]:
    """Returns (wrong, found, visible) if the board's dots have the ``numbers``, (rows, columns)."""
    wrong = found = visible = 0
    rows, columns = map(range, numbers.shape)
    for name in images.keys() & measured.keys():
        circles = images[name].circles
        visible += sum(c.must_find for c in circles.values())
        for label, centre in measured[name].items():
            key = label
            if isinstance(label, DotLabel) and label.row in rows and label.column in columns:
                key = f"{BOARD}:{numbers[label.row, label.column]}"
            near = key in circles and bool(np.linalg.norm(np.subtract(centre, circles[key].centre_px)) < NEAR_PX)
            wrong += not near
            found += near and circles[key].must_find
    return wrong, found, visible


def _face(face_id: str, found: ComparedFaces, known: TruthFile) -> FaceErrors:
    estimate, true = (Rigid.from_matrix(source.target_from_face[face_id]) for source in (found, known))
    labels = [label for label in parse_labels(known.circles) if label.plane == face_id and label in found.circles]
    a, b = (np.array([source.circles[label] for label in labels]).reshape(-1, 3) for source in (known, found))
    c = found.target_from_face_covariance.get(face_id)
    mean = largest = sigma = turn = None
    with suppress(DegenerateError):  # with fewer than three circles in common there is no rigid fit
        error = 1e3 * np.linalg.norm(align_rigid(a, b) @ b - a, axis=1)
        mean, largest = float(error.mean()), float(error.max())
    if c is not None:
        turn, sigma = np.split(1e3 * np.sqrt(np.maximum(np.diag(c), 0)), 2)
        turn = np.degrees(turn)
    of_pose = _pose_errors(estimate, true, None if face_id == known.reference_face else c).model_dump()
    of_circles: dict[str, Any] = {"circles": len(labels), "circles_mean_um": mean, "circles_max_um": largest}
    return FaceErrors(**of_pose, **of_circles, translation_sigma_um=sigma, rotation_sigma_mdeg=turn)


def poses_table(comparison: ComparePosesFile) -> str:
    """Returns the comparison of poses as a text table, the RMS of all first; of many the worst only."""
    errors = comparison.images
    values = np.array([[e.translation_um, e.rotation_mdeg, e.normalised_error or np.nan] for e in errors.values()])
    worst = sorted(np.argsort(-values[:, 0])[:MOST_LISTED].tolist())
    names = [f"RMS of {len(errors)} poses", *(list(errors)[i] for i in worst)]
    rows = [["<image", "position", "rotation", "error / σ"], ["", "µm", "mdeg", ""]]
    for name, row in zip(names, [np.sqrt((values**2).mean(axis=0)), *values[worst]], strict=True):
        rows.append([name, *(number(value, digits) for value, digits in zip(row, (1, 2, 2), strict=True))])
    text = text_table(rows)
    if more := len(errors) - len(worst):
        text.append(f"{more} poses with smaller errors of position: --json writes all")
    if unknown := comparison.not_in_truth:
        text.append(f"not in the truth: {', '.join(unknown[:3])}{' …' if len(unknown) > 3 else ''}")
    return "\n".join(text)


def comparison_table(comparison: CompareFile) -> str:
    rows = [
        ["face", "position", "rotation", "circles", "worst", "of", "error / σ"],
        ["", "µm", "mdeg", "mean µm", "µm", "", ""],
    ]
    for face_id, row in comparison.faces.items():
        pose = [number(row.translation_um, 1), number(row.rotation_mdeg, 2)]
        circles = [number(row.circles_mean_um, 2), number(row.circles_max_um, 2), str(row.circles)]
        pose = ["reference", ""] if face_id == comparison.reference_face else pose
        rows.append([face_id, *pose, *circles, number(row.normalised_error, 2)])
    lines = text_table(rows, least=(6, 10, 10, 10, 8, 4, 10), gap=1)
    if n := comparison.labels:
        lines.append(f"labels: {n.wrong} wrong; {n.found} of {n.visible} visible circles found")
        if n.images < n.images_of_truth:
            lines[-1] += f" in the {n.images} of {n.images_of_truth} images that have labels"
    if comparison.missing:
        lines.append(f"not in the run: face {', '.join(comparison.missing)}")
    return "\n".join(lines)
