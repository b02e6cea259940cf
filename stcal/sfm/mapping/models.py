"""COLMAP's model files: writes models in this form, and reads models of COLMAP, or edited ones, back with labels."""

import math
import os
import re
import struct
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, Similarity
from stcal.io.cameras.camera_model import camera_from_colmap
from stcal.io.files import MODEL_BYTES, TABLE_BYTES, read_bytes, require_size
from stcal.io.static_transforms import image_lines
from stcal.labels import DotLabel, Label
from stcal.sfm.data.group_model import GroupModel, ImageObservations, MetricModel, WorldModel, assemble
from stcal.sfm.mapping.database import CAMERA_ID, colmap_camera, from_colmap_px, pycolmap, to_colmap_px

LOG_NOTHING = 4  # level of COLMAP's log that prints nothing. Errors are raised as exceptions.
KEYPOINT_TOLERANCE_PX = 0.002
"""Largest deviation of a keypoint from the database. Steps of float32: 0.0005 px at x = 5000, 0.002 px at x = 30
000."""
CORRECTION_TOLERANCE_PX = 1.0
"""Largest deviation of a keypoint whose eccentricity was computed again from other poses, or not at all: less than an
eccentricity of a large circle, far less than the distance of neighbours."""
MAX_RMS_PX = 4.0
"""Largest RMS reprojection error of a model per axis. COLMAP excludes observations that are further off."""
MAX_LENGTH_ERROR = 1e-3
"""Largest deviation of a quaternion's length from 1. Text files may hold few digits; quaternions are normalised."""


def _fault(code: str, path: Path, fault: str, remedy: str = "write or copy it again") -> InputError:
    return InputError(code, f"model {path}: {fault}; {remedy}")


def rigid_from_colmap(pose: pycolmap.Rigid3d) -> Rigid:
    """Returns COLMAP's transform as a :class:`Rigid`."""
    return Rigid(pose.rotation.matrix(), pose.translation)


def write_model(
    folder: Path,
    models: Sequence[GroupModel],
    observations: Sequence[ImageObservations],
    ids: dict[str, int],
    camera: Camera,
) -> None:
    """Writes models that share one world as COLMAP's binary files, and reads them back; all keypoints, in the
    database's order. A circle at the same place in two groups is one point."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(colmap_camera(camera))
    by_name = {image.name: image for image in observations}
    tracks: dict[tuple[Label, tuple[float, ...]], pycolmap.Track] = {}
    for model in models:
        places = [(label, tuple(xyz)) for label, xyz in zip(model.labels, model.xyz_model.tolist(), strict=True)]
        tracks |= {place: pycolmap.Track() for place in places if place not in tracks}
        for name, pose, rows in zip(model.images, model.camera_from_model, model.rows_by_image(), strict=True):
            image = pycolmap.Image(name=name, camera_id=CAMERA_ID, image_id=ids[name])
            keypoints = to_colmap_px(model.keypoints_px(by_name[name], rows))
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy_px) for xy_px in keypoints])
            reconstruction.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
            )
            for row in rows:
                tracks[places[model.point_index[row]]].add_element(ids[name], int(model.keypoint[row]))
    for (_, xyz), track in tracks.items():
        reconstruction.add_point3D(np.array(xyz), track)
    reconstruction.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    write_reconstruction(reconstruction, folder)


def write_reconstruction(reconstruction: pycolmap.Reconstruction, folder: Path, text: bool = False) -> None:
    """Writes a model into an existing folder and reads it back: COLMAP's writers do not report a full disk."""
    try:
        (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
        written = _numbers(open_model(folder))
        same = all(np.array_equal(a, b) for a, b in zip(_numbers(reconstruction), written, strict=True))
    except (InputError, RuntimeError, OSError):
        same = False
    if not same:
        remedy = "check the folder's space and rights, or give another place"
        raise _fault("E-OUTPUT-READ-BACK", folder, "its files differ from what was written", remedy)


def _numbers(reconstruction: pycolmap.Reconstruction) -> list[np.ndarray]:
    """Returns cameras, poses, keypoints and points of a model to 12 digits, as text files lose the last ones."""
    cameras = [[i, *c.params] for i, c in sorted(reconstruction.cameras.items())]
    images = [each for _, each in sorted(reconstruction.images.items())]
    poses = [[i.image_id, *(i.cam_from_world().matrix().ravel() if i.has_pose else np.zeros(12))] for i in images]
    keypoints = [[*p.xy, p.point3D_id if p.has_point3D() else -1] for image in images for p in image.points2D]
    points = [[i, *p.xyz, len(p.track.elements)] for i, p in sorted(reconstruction.points3D.items())]
    parts = (np.array(each, float) for each in (cameras, poses, keypoints, points))
    return [np.round(each, 12 - int(np.ceil(np.log10(max(np.abs(each).max(initial=1), 1))))) for each in parts]


@dataclass(frozen=True, slots=True, eq=False)
class ReadModel:
    """A COLMAP model with labels, by group of images, all in the model's world."""

    path: Path
    camera: Camera  # of the model, possibly refined
    groups: tuple[WorldModel, ...]
    unlabelled: int  # number of points whose keypoints have no label or several
    split: int  # number of labels with several points, of which the longest track is used
    absent: int  # number of points that keypoints name but the model does not contain

    def in_mm(self) -> tuple[MetricModel, ...]:
        """Returns the groups of a model that was written in mm, like a run's ``target_model``."""
        return tuple(group.metric(Similarity(1.0, Rigid())) for group in self.groups)


def find_models(folder: str | Path) -> list[Path]:
    """Returns the folders with a COLMAP model among this folder and its subfolders (the mapper writes 0, 1, …)."""
    folder = Path(folder)
    places = sorted([folder, *folder.glob("*"), *folder.glob("*/*")]) if folder.is_dir() else []
    models = [p for p in places if any(os.path.exists(p / f"images.{kind}") for kind in ("bin", "txt"))]
    if not models:
        missing = "no COLMAP model (cameras, images and points3D as .bin or .txt) there"
        raise _fault("E-MODEL-UNREADABLE", folder, missing, "give the folder that the mapper or the GUI wrote")
    return models


def read_model(
    path: Path,
    observations: Sequence[ImageObservations],
    ids: dict[str, int],
    corrected_px: Sequence[np.ndarray],
    corrected_again: bool = False,  # of ``target_model``, whose centres the joint adjustment corrected
) -> ReadModel:
    """Reads a model based on the keypoints of the run's database, where (image, keypoint) determines the label."""
    reconstruction = open_model(path)
    cameras = list(reconstruction.cameras.values())
    if len(cameras) != 1:
        raise _fault("E-MODEL-CAMERAS", path, f"{len(cameras)} cameras, 1 needed", "map the exported database as it is")
    native = cameras[0]
    camera = camera_from_colmap(native.model.name, native.width, native.height, list(native.params), path)
    of_run = {image.name: (image, xy) for image, xy in zip(observations, corrected_px, strict=True)}
    tolerance_px = CORRECTION_TOLERANCE_PX if corrected_again else KEYPOINT_TOLERANCE_PX
    members: dict[str, list] = {}
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        if image.name not in of_run:
            listed = f"{observations[0].name} … {observations[-1].name}"
            cut = "; names with spaces need a binary model" if any(" " in name for name in of_run) else ""
            raise _of_another_run(path, f"image {image.name} is not of this run ({listed}{cut})")
        observed, corrected = of_run[image.name]
        xy = require_keypoints(path, image, observed.labels, corrected, tolerance_px)
        members.setdefault(observed.group, []).append((observed, xy if corrected_again else corrected, image))
    labelled = _labelled_points(reconstruction, {image.name: image for image in observations})
    groups, split = [], 0
    for name, images in sorted(members.items()):
        images.sort(key=lambda entry: ids[entry[0].name])
        model, split_of_group = _group_model(path, name, images, reconstruction, labelled)
        split += split_of_group
        if model is not None:
            _require_fit(path, model, camera.sized(0, 0))
            groups.append(model)
    if not groups:
        raise _fault("E-MODEL-EMPTY", path, "no image with a pose and labelled points", "map again")
    named_points = {p.point3D_id for image in reconstruction.images.values() for p in image.points2D if p.has_point3D()}
    absent = len(named_points - set(reconstruction.points3D))
    unlabelled = len(reconstruction.points3D) - len(labelled)
    return ReadModel(path, camera.sized(0, 0), tuple(groups), unlabelled, split, absent)


def open_model(path: Path) -> pycolmap.Reconstruction:
    """Opens a model's files; InputError if one is damaged or missing."""
    pycolmap.logging.minloglevel = LOG_NOTHING
    try:
        for file in (Path(path) / f"{name}.bin" for name in ("cameras", "rigs", "frames", "images", "points3D")):
            if file.exists():
                _require_whole(file)
        for file in Path(path).glob("*.txt"):
            require_size(file, TABLE_BYTES)
        texts = Path(path) / "images.txt"
        text = read_bytes(texts, TABLE_BYTES).decode("utf-8-sig", "replace") if texts.exists() else ""
        for image in image_lines(text, f"model {texts}"):
            if not image.followed:  # COLMAP passes over images without points that lack their empty line
                fault = f"line {image.number}: {image.name[:80]} has no second line, which is empty without points"
                remedy = "add it after each such image, or export the model anew"
                raise _fault("E-MODEL-UNREADABLE", texts, fault, remedy)
        return pycolmap.Reconstruction(str(path))
    except (RuntimeError, ValueError, IndexError, OverflowError, OSError) as error:
        reason = _CHECK.sub("", " ".join(str(error).split()))[-150:] or "a line or record of another form"
        raise _fault("E-MODEL-UNREADABLE", path, f"damaged or incomplete ({reason})") from error


_CHECK = re.compile(r"\[\w.]+:\d+\] Check failed: .*")
"""COLMAP's words for a fault of a file: a place in its own source."""


def _end_of(kind: str, data: bytes, at: int) -> int:
    """Returns where a record ends; struct.error if a number is missing, ValueError for an unknown camera model."""

    def number(form: str, place: int) -> int:
        return struct.unpack_from(f"<{form}", data, place)[0]

    match kind:
        case "cameras":
            camera = pycolmap.CameraModelId(number("i", at + 4))
            return at + 24 + 8 * len(pycolmap.Camera.create_from_model_id(1, camera, 1.0, 1, 1).params)
        case "frames":
            return at + 68 + 16 * number("I", at + 64)
        case "images":
            text = data.find(b"\0", at + 64) + 1 or len(data)
            return text + 8 + 24 * number("Q", text)
        case "points3D":
            return at + 51 + 8 * number("Q", at + 43)
    sensors = number("I", at + 4)  # of a rig
    at += 16 if sensors else 8
    for _ in range(sensors - 1):
        at += 65 if number("B", at + 8) else 9
    return at


def _require_whole(file: Path) -> None:
    """Checks the counts in a file: pycolmap reads past its end, for hours and until memory is full."""
    data, at, fault = read_bytes(file, MODEL_BYTES), 8, "ends too soon"
    try:
        for _ in range(struct.unpack_from("<Q", data)[0]):
            if (at := _end_of(file.stem, data, at)) > len(data):
                break
        fault = fault if at > len(data) else "" if at == len(data) else f"{at} by its own counts"
    except struct.error:
        pass
    except ValueError as error:
        fault = str(error)
    if fault:
        raise ValueError(f"{file.name}, {len(data)} bytes: {fault}")


def _of_another_run(path: Path, fault: str) -> InputError:
    return _fault("E-MODEL-NOT-OF-RUN", path, fault, "give the run that the model's database came from")


def require_keypoints(
    path: Path,
    image: pycolmap.Image,
    labels: Sequence[str],
    corrected_px: np.ndarray,
    tolerance_px: float = KEYPOINT_TOLERANCE_PX,
) -> np.ndarray:
    """Returns the model's keypoints (k, 2), which must be the run's: only then do they determine labels."""
    xy = from_colmap_px(np.array([point.xy for point in image.points2D]).reshape(-1, 2))
    if len(xy) != len(corrected_px):
        raise _of_another_run(path, f"image {image.name} has {len(xy)} keypoints, the run {len(corrected_px)}")
    off = np.abs(xy - corrected_px).max(axis=1, initial=0.0)
    if not (off <= tolerance_px).all():
        k = int(np.argmax(off))
        off_by = f"{off[k]:.4f} px off the run's, {tolerance_px:g} allowed"
        raise _of_another_run(path, f"image {image.name}: keypoint {k} ({labels[k]}) is {off_by}")
    return xy


def _require_fit(path: Path, model: GroupModel, camera: Camera) -> None:
    """Checks that poses, points and camera fit the keypoints. Damaged files may still hold valid numbers."""
    with np.errstate(all="ignore"):
        residual = np.linalg.norm(model.residuals_px(camera), axis=1)
        rms = float(np.sqrt((residual**2).mean() / 2))
    if not rms <= MAX_RMS_PX:
        image, label = model.seen()[int(np.argmax(residual))]
        off = f"keypoints are {rms:.3g} px RMS off the images of their points, {MAX_RMS_PX:g} allowed"
        fault, remedy = f"{off}, most of all {label} in {image}", "adjust its bundle, or write or copy it again"
        raise _fault("E-MODEL-MISFIT", path, f"group {model.group}: {fault}", remedy)


def pose_of_image(path: Path, image: pycolmap.Image) -> Rigid:
    """Returns camera_from_model of an image, which must be a finite rotation and translation."""
    pose = image.cam_from_world()
    length = math.hypot(*pose.rotation.quat)  # accepts any numbers without a warning
    if not (abs(length - 1) <= MAX_LENGTH_ERROR and np.isfinite(pose.translation).all()):
        found = f"quaternion of length {length:.4g}, 1 needed; translation {pose.translation.tolist()}"
        raise _fault("E-MODEL-POSE", path, f"image {image.name}: no pose ({found})")
    pose.rotation.normalize()
    return rigid_from_colmap(pose)


def _labelled_points(reconstruction: pycolmap.Reconstruction, observations: dict[str, ImageObservations]) -> set[int]:
    """Returns the ids of the points all of whose keypoints have one label; dots of two groups are different ones."""

    def label_of(element: pycolmap.TrackElement) -> tuple[str, Label]:
        image = observations[reconstruction.image(element.image_id).name]
        label = image.labels[element.point2D_idx]
        return image.group if isinstance(label, DotLabel) else "", label

    tracks = {i: point.track.elements for i, point in reconstruction.points3D.items()}
    return {i for i, elements in tracks.items() if len({label_of(element) for element in elements}) == 1}


def points_by_votes(
    observations: Sequence[ImageObservations], images: Sequence[pycolmap.Image], known: Collection[int] | None = None
) -> tuple[dict[Label, int], int]:
    """Returns by label the point (of the ``known``) that most keypoints name, and the number of labels with several."""
    votes_of_label: dict[Label, Counter[int]] = {}
    for observed, image in zip(observations, images, strict=True):
        for label, point in zip(observed.labels, image.points2D, strict=True):
            if point.has_point3D() and (known is None or point.point3D_id in known):
                votes_of_label.setdefault(label, Counter())[point.point3D_id] += 1
    chosen = {label: max(sorted(votes), key=votes.__getitem__) for label, votes in votes_of_label.items()}
    return chosen, sum(len(votes) > 1 for votes in votes_of_label.values())


def _group_model(path: Path, group: str, images, reconstruction, labelled) -> tuple[WorldModel | None, int]:
    """Returns the model of one group (None without labelled points) and the number of labels with several points."""
    observations, corrected_px, native = zip(*images, strict=True)
    chosen, split = points_by_votes(observations, native, labelled)
    if not chosen:
        return None, 0
    xyz = {label: reconstruction.point3D(point).xyz for label, point in chosen.items()}
    for label in sorted(xyz):
        if not np.isfinite(xyz[label]).all():
            raise _fault("E-MODEL-POSE", path, f"point {chosen[label]} ({label}) is not finite")
    model = assemble(WorldModel, group, observations, [pose_of_image(path, image) for image in native], xyz)
    names = [[point.point3D_id for point in image.points2D] for image in native]
    at = zip(model.image_index.tolist(), model.point_index.tolist(), model.keypoint.tolist(), strict=True)
    model = model.observed(np.array([names[i][k] == chosen[model.labels[p]] for i, p, k in at]))
    corrected = [corrected_px[i][k] for i, k in zip(model.image_index, model.keypoint, strict=True)]
    return replace(model, shift_px=model.measured_px - np.array(corrected)), split
