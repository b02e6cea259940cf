"""From a folder of images to camera_from_target of each: the calibrated target at work."""

import csv
import io
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DetectionError, InputError, StcalError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.camera import CameraModel, CameraPrior
from stcal.io.images import Skipped, find_images
from stcal.io.table import COVARIANCE, POSE, Table, common_columns, pose_cells
from stcal.parallel import Progress, counted, one_thread
from stcal.sfm.data.observations import ImageObservations, by_group
from stcal.sfm.detect.circles.ellipses import EllipseOptions
from stcal.sfm.detect.files import DetectedImage, detect_files
from stcal.sfm.detect.labels import label_single
from stcal.sfm.measure.common_errors import common_errors
from stcal.sfm.measure.files import PosesFile
from stcal.sfm.measure.pose import PoseOptions, TargetPose, pose_from_circles
from stcal.sfm.measure.target import TargetCircles

NEAR_PREVIOUS = 1 / 3
"""The pose nearer to the previous image's is taken where its turn from there is at most this share of the other's."""
IMAGE, FACES, CIRCLES, STATUS = "image", "faces", "circles", "status"
QUALITY = ("rms_px", "chi2_per_dof")
NO_FACE = "no face of the target recognised; if a dot board is in view, give --board"
SUSPICIOUS, FAILED = 1e-3, 1e-5
"""Probabilities of a fit's χ², as the checks of a run have them."""


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """What :func:`measure` does with each image.

    Parameters
    ----------
    pose : PoseOptions
        Of the single images.
    previous : bool
        An image's own undecided pose is decided by that of the image before it, by name and in the same folder.
    ellipses : EllipseOptions
        Of detection.
    workers : int, optional
        Processes; one per core where None.
    """

    pose: PoseOptions = field(default_factory=PoseOptions)
    previous: bool = False
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredImage:
    """``name`` of the image, its ``pose``, and ``notes`` on what was seen and left out in it."""

    name: str
    pose: TargetPose
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class MeasureResult:
    """``images`` that have a pose, in order of name; ``left_out`` : the others, with reasons; ``notes`` : what the
    covariances lack; ``sigma_factor`` : on the centres' own σ; ``intrinsics_held`` : whether they were taken as exact;
    ``common`` : (m, 6, r) what the poses' errors have in common, see
    :func:`stcal.sfm.measure.common_errors.common_errors`.
    """

    images: tuple[MeasuredImage, ...]
    left_out: tuple[Skipped, ...]
    notes: tuple[str, ...]
    sigma_factor: float
    intrinsics_held: bool
    common: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "common", frozen(self.common, (len(self.images), 6, None), "common errors"))


@one_thread()
def measure(
    images: str | Path,
    camera: CameraModel,
    target: TargetCircles,
    design: TargetDesign,
    board: BoardDesign | None = None,
    options: MeasureOptions | None = None,
    progress: Progress | None = None,
) -> MeasureResult:
    """Pose of a calibrated target in each image of a folder and of its subfolders.

    Two minima of a face seen alone are told apart where its circles can (Schweighofer & Pinz 2006), and stated both
    where they cannot.

    Parameters
    ----------
    images : path
        Folder of photographs; every folder in it too.
    camera : CameraModel
        As :func:`stcal.io.camera.read_camera` returns it; its covariance, if it has one, goes into the poses'.
    target : TargetCircles
        Its circles, target frame, mm; see :func:`read_target`.
    design : TargetDesign
        Radii and polarity, for detection and labels.
    board : BoardDesign, optional
        A dot board that may be in view, so that its dots are not taken for circles of the target.
    options : MeasureOptions, optional
        The defaults where None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    MeasureResult
        camera_from_target of every image that has a pose, mm, with (6, 6) covariances in rad and mm, left perturbation
        in the camera frame; and what was left out, with reasons.

    Raises
    ------
    InputError
        No image is usable, or the camera file does not belong to them.
    DetectionError
        No image shows a face.
    """
    options, progress = options or MeasureOptions(), progress or (lambda *_: None)
    files, other = find_images(images)
    step = counted(progress, "detect", len(files))
    with tempfile.TemporaryDirectory(prefix="stcal-measure-") as scratch:
        detection = detect_files(files, camera, design, board, options.ellipses, Path(scratch), options.workers, step)
    observations, notes = _labelled(detection.images, design)
    prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
    result = measure_labelled(observations, detection.camera, target, options, prior)
    left_out = (*other, *detection.skipped, *result.left_out)
    if not result.images:
        raise DetectionError(
            f"no face of the target measured in {len(detection.images)} images, first {left_out[-1].name}: "
            f"{left_out[-1].reason}; check target.toml (radii, polarity), faces.json and the exposure"
        )
    measured = tuple(replace(each, notes=notes[each.name]) for each in result.images)
    return replace(result, images=measured, left_out=left_out)


def _labelled(images: Sequence[DetectedImage], design: TargetDesign):
    """Observations of all images, and the notes on each."""
    labelled = [label_single(i.file.name, i.file.group, i.detection, design) for i in images]
    return [each.observations for each in labelled], {each.observations.name: each.notes for each in labelled}


def measure_labelled(
    observations: Sequence[ImageObservations],
    camera: Camera,
    target: TargetCircles,
    options: MeasureOptions | None = None,
    prior: CameraPrior | None = None,
) -> MeasureResult:
    """The poses from labelled centres, without pixels; ``prior`` : of the intrinsics, exact where None.

    An image that gives no pose is among those left out.
    """
    options = options or MeasureOptions()
    measured, left_out = [], []
    for group in by_group(observations).values():
        before: TargetPose | None = None
        for image in sorted(group, key=lambda each: each.name):
            pose, reason = _measured(image, camera, target, options.pose, prior)
            if pose is None:
                left_out.append(Skipped(image.name, reason, "pose"))
            else:
                if options.previous and before is not None:
                    pose = resolved(pose, before.camera_from_target)
                measured.append(MeasuredImage(image.name, pose))
            before = pose if pose is not None and pose.status != "ambiguous" else None
    factor = target.sigma_factor if options.pose.sigma_factor is None else options.pose.sigma_factor
    common = common_errors([each.pose for each in measured], target, prior)
    return MeasureResult(tuple(measured), tuple(left_out), target.notes, factor, prior is None, common)


def _measured(image: ImageObservations, camera, target: TargetCircles, options, prior):
    """The pose, or None and why there is none."""
    known = [i for i, label in enumerate(image.labels) if label in target.place]
    if not known:
        seen = ", ".join(dict.fromkeys(x for x in image.face_ids()))
        return None, f"face {seen} is not calibrated" if seen else NO_FACE
    own = image.select(known)
    try:
        pose = pose_from_circles(
            own.labels, own.centre_px, own.covariance_px2, target, camera, options, prior, image.name
        )
    except StcalError as error:
        return None, str(error).removeprefix(f"{image.name}: ")
    return pose, ""


def resolved(pose: TargetPose, previous: Rigid) -> TargetPose:
    """The pose with its two-fold ambiguity decided by another one that is near, camera_from_target of the image before;
    the same where it is certain, or where that one is near to neither."""
    if pose.status == "certain" or pose.second is None:
        return pose
    own, other = (
        Rigid(each.camera_from_target.rotation @ previous.rotation.T).angle_rad() for each in (pose, pose.second)
    )
    if own <= NEAR_PREVIOUS * other:
        return replace(pose, status="resolved")
    return pose.swapped() if other <= NEAR_PREVIOUS * own else pose


def poses_csv(result: MeasureResult, joints: Table | None = None) -> tuple[str, tuple[str, ...]]:
    """Text of ``poses.csv``, and what could not be joined; ``joints`` : more columns by image, whose rows
    alone are then written.

    Raises
    ------
    InputError
        The table has no column ``image``, an image twice, or a column that is here already.
    """
    header = [IMAGE, FACES, CIRCLES, STATUS, *POSE, *COVARIANCE, *QUALITY]
    common = common_columns(result.common.shape[2])
    where, more, rows = "", [], None
    if joints is not None:
        where, (more, rows) = joints.where, _joint_cells(joints, header + common)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header + more + common)
    missing = []
    for each, felt in zip(result.images, result.common, strict=True):
        if rows is not None and each.name not in rows:
            missing.append(f"{each.name}: measured, but not in {where}")
            continue
        pose = each.pose
        writer.writerow(
            [each.name, "+".join(pose.faces), len(pose.labels), pose.status]
            + pose_cells(pose.camera_from_target, pose.covariance)
            + [f"{pose.rms_px():.5f}", f"{pose.chi2_per_redundancy():.4f}"]
            + (rows[each.name] if rows is not None else [])
            + [f"{v:.7g}" for v in felt.T.ravel()]
        )
    if rows is not None:
        names = {each.name for each in result.images}
        missing += [f"{name}: in {where}, but without a pose" for name in rows if name not in names]
        if len(rows.keys() & names) == 0:
            raise InputError(f"{where}: none of its images was measured; names are like {result.images[0].name}")
    return stream.getvalue(), tuple(missing)


def _joint_cells(joints: Table, header: list[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Names of the further columns, and their cells by image, as they stand in the file."""
    more = [name for name in joints.columns if name != IMAGE]
    taken = [name for name in more if name in header]
    if taken:
        raise InputError(f"{joints.where}: column {taken[0]} is measured here; leave it out")
    names = joints.text(IMAGE)
    cells = [joints.columns[name] for name in more]
    rows: dict[str, list[str]] = {}
    for i, name in enumerate(names):
        if name in rows:
            raise InputError(f"{joints.where}: line {joints.lines[i]}: image {name} a second time; every image once")
        rows[name] = [c[i] if isinstance(c, list) else repr(float(c[i])) for c in cells]
    return more, rows


def fit_verdict(pose: TargetPose) -> str:
    """``passed``, ``suspicious`` or ``failed`` of the χ² of the residuals."""
    p = pose.p_value()
    return "failed" if p < FAILED else "suspicious" if p < SUSPICIOUS else "passed"


def poses_file(result: MeasureResult) -> PosesFile:
    """The content of ``--json``."""
    return PosesFile.model_validate(
        {
            "format": "stcal poses 1",
            "unit": "mm",
            "sigma_factor": result.sigma_factor,
            "intrinsics_held": result.intrinsics_held,
            "notes": list(result.notes),
            "images": [_image_json(each) for each in result.images],
            "left_out": result.left_out,
        }
    )


def _image_json(each: MeasuredImage) -> dict:
    pose = each.pose
    other = pose.second
    return {
        "image": each.name,
        "faces": list(pose.faces),
        "status": pose.status,
        "camera_from_target": pose.camera_from_target,
        "covariance": pose.covariance,
        "covariance_parts": pose.parts,
        "alternative": other,
        "delta_chi2": pose.delta_chi2,
        "delta_chi2_needed": pose.needed_chi2,
        "rms_px": pose.rms_px(),
        "chi2": pose.chi2,
        "dof": pose.redundancy,
        "p_value": pose.p_value(),
        "fit": fit_verdict(pose),
        "circles": [
            {"label": label, "residual_px": residual, "weight": float(weight)}
            for label, residual, weight in zip(pose.labels, pose.residuals_px, pose.weights, strict=True)
        ],
        "outliers": pose.outliers,
        "notes": list(each.notes),
    }


def measure_text(result: MeasureResult) -> str:
    """The table for people."""
    wide = max([len(each.name) for each in result.images] + [5])
    lines = [
        f"{'image':{wide}}  {'faces':7} {'circles':>7}  {'status':9} {'x':>10} {'y':>10} {'z':>10} mm   "
        f"{'σ position µm':^20} {'σ rotation mdeg':^20} {'RMS px':>7} {'χ²/dof':>7}"
    ]
    for each in result.images:
        pose = each.pose
        sigma = np.sqrt(np.diag(pose.covariance))
        place = " ".join(f"{v:10.4f}" for v in pose.camera_from_target.translation)
        position = " ".join(f"{1e3 * v:6.1f}" for v in sigma[3:])
        turn = " ".join(f"{1e3 * np.degrees(v):6.2f}" for v in sigma[:3])
        verdict = fit_verdict(pose)
        lines.append(
            f"{each.name:{wide}}  {'+'.join(pose.faces):7} {len(pose.labels):7}  {pose.status:9} {place}      "
            f"{position} {turn} {pose.rms_px():7.4f} {pose.chi2_per_redundancy():7.2f}"
            + ("" if verdict == "passed" else f"  {verdict}")
        )
        lines += [
            f"  outlier {each.name} {o.label}: residual {o.residual_px:.3f} px, limit {o.limit_px:.3f} px"
            for o in pose.outliers
        ]
    left_out = [f"left out {each.name}: {each.reason}" for each in result.left_out]
    return "\n".join([*lines, *summary(result), *left_out])


def summary(result: MeasureResult) -> list[str]:
    """Counts, then what is to be known besides."""
    poses = [each.pose for each in result.images]
    count = {s: sum(pose.status == s for pose in poses) for s in ("certain", "resolved", "ambiguous")}
    told = ", ".join(f"{n} {s}" for s, n in count.items() if n)
    lines = [f"{len(poses)} poses: {told}; centres' σ × {result.sigma_factor:.3g}"]
    held = "held: their errors are not in σ"
    lines[0] += f", intrinsics {held if result.intrinsics_held else 'with their σ'}"
    if count["ambiguous"]:
        lines.append(
            "ambiguous: two poses fit, mirrored at the line of sight; the likelier one is given, --json has both; "
            "show a second face, come nearer, or use --previous for small motions"
        )
    failed = [each.name for each in result.images if fit_verdict(each.pose) == "failed"]
    if failed:
        lines.append(
            f"χ² failed in {len(failed)} images, first {failed[0]}: residuals beyond their σ by chance in one image of "
            "100 000; check that camera file, faces.json and images belong together"
        )
    return [*lines, *result.notes]
