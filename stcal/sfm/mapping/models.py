"""COLMAP's model files: writes models in this form, and reads models of COLMAP, or edited ones, back with labels."""

import math
import os
import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, Similarity
from stcal.io.cameras.model import camera_from_colmap
from stcal.io.files import MODEL_BYTES, TABLE_BYTES, read_bytes, require_size
from stcal.io.poses.programs import image_lines
from stcal.labels import DotLabel, Label
from stcal.sfm.data.model import GroupModel, ImageObservations, MetricModel, WorldModel
from stcal.sfm.mapping.colmap import pycolmap
from stcal.sfm.mapping.database import CAMERA_ID, colmap_camera, from_colmap_px, to_colmap_px

LOG_NOTHING = 4
"""Level of COLMAP's log that prints nothing. Errors are raised as exceptions."""
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


def rigid_from_colmap(pose: pycolmap.Rigid3d) -> Rigid:
    """Returns COLMAP's transform as a :class:`Rigid`."""
    return Rigid(pose.rotation.matrix(), pose.translation)


def to_reconstruction(
    models: Sequence[GroupModel],
    observations: Sequence[ImageObservations],
    ids: dict[str, int],
    camera: Camera,
) -> tuple[pycolmap.Reconstruction, dict[int, tuple[str, str]]]:
    """Returns models that share one world in COLMAP's form, and (group, label) by point id; all keypoints, in the
    database's order. A circle at the same place in two groups is one point with an empty group."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(colmap_camera(camera))
    by_name = {image.name: image for image in observations}
    tracks: dict[tuple[str, tuple[float, ...]], pycolmap.Track] = {}
    groups: dict[tuple[str, tuple[float, ...]], set[str]] = {}
    for model in models:
        places = [(label, tuple(xyz)) for label, xyz in zip(model.labels, model.xyz_model.tolist(), strict=True)]
        for place in places:
            tracks.setdefault(place, pycolmap.Track())
            groups.setdefault(place, set()).add(model.group)
        for name, pose, rows in zip(model.images, model.camera_from_model, model.rows_by_image(), strict=True):
            image = pycolmap.Image(name=name, camera_id=CAMERA_ID, image_id=ids[name])
            keypoints = to_colmap_px(model.keypoints_px(by_name[name], rows))
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy_px) for xy_px in keypoints])
            reconstruction.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
            )
            for row in rows:
                tracks[places[model.point_index[row]]].add_element(ids[name], int(model.keypoint[row]))
    names = {}
    for (label, xyz), track in tracks.items():
        groups_of_point = groups[label, xyz]
        names[reconstruction.add_point3D(np.array(xyz), track)] = (
            groups_of_point.pop() if len(groups_of_point) == 1 else "",
            label,
        )
    reconstruction.update_point_3d_errors()
    return reconstruction, names


def write_model(
    folder: Path,
    models: Sequence[GroupModel],
    observations: Sequence[ImageObservations],
    ids: dict[str, int],
    camera: Camera,
) -> None:
    """Writes models that share one world as COLMAP's binary files, and reads them back."""
    folder.mkdir(parents=True, exist_ok=True)
    write_reconstruction(to_reconstruction(models, observations, ids, camera)[0], folder)


def write_reconstruction(reconstruction: pycolmap.Reconstruction, folder: Path, text: bool = False) -> None:
    """Writes a model into an existing folder and reads it back: COLMAP's writers do not report a full disk."""
    try:
        (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
        written = _numbers(open_model(folder))
        same = all(np.array_equal(a, b) for a, b in zip(_numbers(reconstruction), written, strict=True))
    except (InputError, RuntimeError, OSError):
        same = False
    if not same:
        raise InputError(
            "E-OUTPUT-READ-BACK",
            f"model {folder}: its files differ from what was written; check the folder's space and rights, "
            "or give another place",
        )


def _numbers(reconstruction: pycolmap.Reconstruction) -> list[np.ndarray]:
    """Returns cameras, poses, keypoints and points of a model to 12 digits, as text files lose the last ones."""
    cameras = [[i, *c.params] for i, c in sorted(reconstruction.cameras.items())]
    images, keypoints, points = [], [], []
    for i, image in sorted(reconstruction.images.items()):
        pose = image.cam_from_world().matrix().ravel() if image.has_pose else np.zeros(12)
        images.append([i, *pose])
        keypoints += [[*each.xy, each.point3D_id if each.has_point3D() else -1] for each in image.points2D]
    for i, point in sorted(reconstruction.points3D.items()):
        points.append([i, *point.xyz, len(point.track.elements)])
    parts = (np.array(each, float) for each in (cameras, images, keypoints, points))
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
    models = []
    if folder.is_dir():
        candidates = sorted([folder, *folder.glob("*"), *folder.glob("*/*")])
        models = [p for p in candidates if any(os.path.exists(p / f"images.{kind}") for kind in ("bin", "txt"))]
    if not models:
        raise InputError(
            "E-MODEL-UNREADABLE",
            f"model {folder}: no COLMAP model (cameras, images and points3D as .bin or .txt) there; "
            "give the folder that the mapper or the GUI wrote",
        )
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
        raise InputError(
            "E-MODEL-CAMERAS", f"model {path}: {len(cameras)} cameras, 1 needed; map the exported database as it is"
        )
    native = cameras[0]
    camera = camera_from_colmap(native.model.name, native.width, native.height, list(native.params), path)
    index_of_name = {image.name: i for i, image in enumerate(observations)}
    members: dict[str, list] = {}
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        if image.name not in index_of_name:
            is_cut = any(" " in name and name.split()[0] == image.name for name in index_of_name)
            remedy = (
                "COLMAP reads names in texts up to a space: write the model as binary"
                if is_cut
                else "give the run that the model's database came from"
            )
            raise InputError(
                "E-MODEL-NOT-OF-RUN",
                f"model {path}: image {image.name} is not of this run ({observations[0].name} … "
                f"{observations[-1].name}); {remedy}",
            )
        i = index_of_name[image.name]
        tolerance_px = CORRECTION_TOLERANCE_PX if corrected_again else KEYPOINT_TOLERANCE_PX
        xy = require_keypoints(path, image, observations[i].labels, corrected_px[i], tolerance_px)
        corrected = xy if corrected_again else corrected_px[i]
        members.setdefault(observations[i].group, []).append((observations[i], corrected, image))
    point_label, unlabelled = _labels_of_points(reconstruction, index_of_name, observations)
    groups, split = [], 0
    for name, images in sorted(members.items()):
        images.sort(key=lambda entry: ids[entry[0].name])
        model, split_of_group = _group_model(path, name, images, reconstruction, point_label)
        split += split_of_group
        if model is not None:
            _require_fit(path, model, camera.sized(0, 0))
            groups.append(model)
    if not groups:
        raise InputError("E-MODEL-EMPTY", f"model {path}: no image with a pose and labelled points; map again")
    named_points = {p.point3D_id for image in reconstruction.images.values() for p in image.points2D if p.has_point3D()}
    absent = len(named_points - set(reconstruction.points3D))
    return ReadModel(path, camera.sized(0, 0), tuple(groups), unlabelled, split, absent)


def open_model(path: Path) -> pycolmap.Reconstruction:
    """Opens a model's files; InputError if one is damaged or missing."""
    pycolmap.logging.minloglevel = LOG_NOTHING
    try:
        for name, skip in _RECORDS.items():
            file = Path(path) / f"{name}.bin"
            if file.exists():
                _require_whole(file, skip)
        for file in Path(path).glob("*.txt"):
            require_size(file, TABLE_BYTES)
        _require_second_lines(Path(path) / "images.txt")
        return pycolmap.Reconstruction(str(path))
    except (RuntimeError, ValueError, IndexError, OverflowError, OSError) as error:
        reason = _CHECK.sub("", " ".join(str(error).split()))[-150:] or "a line or record of another form"
        raise InputError(
            "E-MODEL-UNREADABLE", f"model {path}: damaged or incomplete ({reason}); write or copy it again"
        ) from error


_CHECK = re.compile(r"\[\w.]+:\d+\] Check failed: .*")
"""COLMAP's words for a fault of a file: a place in its own source."""


def _require_second_lines(file: Path) -> None:
    """Refuse an ``images.txt`` without the empty lines of images without points: COLMAP passes over such images."""
    if not file.exists():
        return
    for image in image_lines(read_bytes(file, TABLE_BYTES).decode("utf-8-sig", "replace"), f"model {file}"):
        if not image.followed:
            raise InputError(
                "E-MODEL-UNREADABLE",
                f"model {file}: line {image.number}: {image.name[:80]} has no second line, which is empty without "
                "points; add it after each such image, or export the model anew",
            )


class _Walk:
    """A position in a binary file that only moves forward."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def skip(self, size: int) -> None:
        """Skips bytes; raises ValueError at the end of the file."""
        self.at += size
        if self.at > len(self.data):
            raise ValueError("ends too soon")

    def number(self, kind: str) -> int:
        """Reads the next number, in a format of :mod:`struct`."""
        start = self.at
        self.skip(struct.calcsize(f"<{kind}"))
        return struct.unpack_from(f"<{kind}", self.data, start)[0]

    def skip_text(self) -> None:
        """Skips a text and its terminating zero."""
        end = self.data.find(b"\0", self.at)
        self.skip(end + 1 - self.at if end >= 0 else len(self.data) + 1)


def parameter_count(model: int) -> int:
    """Returns the number of parameters of the camera model with COLMAP's id; raises ValueError for an unknown id."""
    return len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1).params)


def _skip_camera(walk: _Walk) -> None:
    walk.skip(4)
    walk.skip(16 + 8 * parameter_count(walk.number("i")))


def _skip_rig(walk: _Walk) -> None:
    walk.skip(4)
    sensors = walk.number("I")
    walk.skip(8 if sensors else 0)
    for _ in range(sensors - 1):
        walk.skip(8)
        walk.skip(56 if walk.number("B") else 0)


def _skip_frame(walk: _Walk) -> None:
    walk.skip(64)
    walk.skip(16 * walk.number("I"))


def _skip_image(walk: _Walk) -> None:
    walk.skip(64)
    walk.skip_text()
    walk.skip(24 * walk.number("Q"))


def _skip_point(walk: _Walk) -> None:
    walk.skip(43)
    walk.skip(8 * walk.number("Q"))


_RECORDS: dict[str, Callable[[_Walk], None]] = {
    "cameras": _skip_camera,
    "rigs": _skip_rig,
    "frames": _skip_frame,
    "images": _skip_image,
    "points3D": _skip_point,
}
"""Functions that skip one record of each binary file. A file is a count followed by that many records."""


def _require_whole(file: Path, skip: Callable[[_Walk], None]) -> None:
    """Checks the counts in a file: pycolmap reads past its end, for hours and until memory is full."""
    walk = _Walk(read_bytes(file, MODEL_BYTES))
    try:
        for _ in range(walk.number("Q")):
            skip(walk)
    except ValueError as error:
        raise ValueError(f"{file.name}, {len(walk.data)} bytes: {error}") from error
    if walk.at != len(walk.data):
        raise ValueError(f"{file.name}: {len(walk.data)} bytes, {walk.at} by its own counts")


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
        raise InputError(
            "E-MODEL-NOT-OF-RUN",
            f"model {path}: image {image.name} has {len(xy)} keypoints, the run {len(corrected_px)}; "
            "give the run that the model's database came from",
        )
    off = np.abs(xy - corrected_px).max(axis=1, initial=0.0)
    if not (off <= tolerance_px).all():
        k = int(np.argmax(off))
        raise InputError(
            "E-MODEL-NOT-OF-RUN",
            f"model {path}: image {image.name}: keypoint {k} ({labels[k]}) is {off[k]:.4f} px off the run's, "
            f"{tolerance_px:g} allowed; give the run that the model's database came from",
        )
    return xy


def _require_fit(path: Path, model: GroupModel, camera: Camera) -> None:
    """Checks that poses, points and camera fit the keypoints. Damaged files may still hold valid numbers."""
    with np.errstate(all="ignore"):
        residual = np.linalg.norm(model.residuals_px(camera), axis=1)
        rms = float(np.sqrt((residual**2).mean() / 2))
    if not rms <= MAX_RMS_PX:
        k = int(np.argmax(residual))
        raise InputError(
            "E-MODEL-MISFIT",
            f"model {path}: group {model.group}: keypoints are {rms:.3g} px RMS off the images of their points, "
            f"{MAX_RMS_PX:g} allowed, most of all {model.labels[model.point_index[k]]} in "
            f"{model.images[model.image_index[k]]}; adjust its bundle, or write or copy it again",
        )


def pose_of_image(path: Path, image: pycolmap.Image) -> Rigid:
    """Returns camera_from_model of an image, which must be a finite rotation and translation."""
    pose = image.cam_from_world()
    length = math.hypot(*pose.rotation.quat)  # accepts any numbers without a warning
    if not (abs(length - 1) <= MAX_LENGTH_ERROR and np.isfinite(pose.translation).all()):
        raise InputError(
            "E-MODEL-POSE",
            f"model {path}: image {image.name}: no pose (quaternion of length {length:.4g}, 1 needed; translation "
            f"{pose.translation.tolist()}); write or copy it again",
        )
    pose.rotation.normalize()
    return rigid_from_colmap(pose)


def _labels_of_points(reconstruction, place, observations) -> tuple[dict[int, tuple[str, str]], int]:
    """Returns (group, label) by point id, an empty group for the target's circles, and the number of others."""
    label_of_point, unlabelled = {}, 0
    for point_id, point in reconstruction.points3D.items():
        names = set()
        for element in point.track.elements:
            image = observations[place[reconstruction.image(element.image_id).name]]
            label = image.labels[element.point2D_idx]
            names.add((image.group if isinstance(label, DotLabel) else "", label))
        if len(names) == 1:
            label_of_point[point_id] = names.pop()
        else:
            unlabelled += 1
    return label_of_point, unlabelled


def _group_model(path: Path, group: str, images, reconstruction, point_label) -> tuple[WorldModel | None, int]:
    """Returns the model of one group (None without labelled points) and the number of labels with several points."""
    rows = []  # image, keypoint, point id
    for i, (_, _, image) in enumerate(images):
        for k, point in enumerate(image.points2D):
            if point.has_point3D() and point.point3D_id in point_label:
                rows.append((i, k, point.point3D_id))
    if not rows:
        return None, 0
    votes_of_label: dict[Label, Counter[int]] = {}
    for _, _, point_id in rows:
        votes_of_label.setdefault(point_label[point_id][1], Counter())[point_id] += 1
    chosen = {label: max(sorted(votes), key=votes.__getitem__) for label, votes in votes_of_label.items()}
    labels = sorted(chosen)
    index = {chosen[label]: i for i, label in enumerate(labels)}
    image_index, keypoint, point_id = np.array([row for row in rows if row[2] in index]).T
    observed = [images[i][0] for i in image_index]
    measured = np.array([o.centre_px[k] for o, k in zip(observed, keypoint, strict=True)])
    corrected = np.array([images[i][1][k] for i, k in zip(image_index, keypoint, strict=True)])
    xyz = np.array([reconstruction.point3D(chosen[label]).xyz for label in labels])
    if not np.isfinite(xyz).all():
        lost = labels[int(np.argmin(np.isfinite(xyz).all(axis=1)))]
        raise InputError(
            "E-MODEL-POSE", f"model {path}: point {chosen[lost]} ({lost}) is not finite; write or copy it again"
        )
    model = WorldModel(
        group=group,
        images=tuple(o.name for o, _, _ in images),
        camera_from_model=tuple(pose_of_image(path, image) for _, _, image in images),
        labels=tuple(labels),
        xyz_model=xyz,
        image_index=image_index,
        point_index=np.array([index[p] for p in point_id.tolist()]),
        keypoint=keypoint,
        measured_px=measured,
        shift_px=measured - corrected,
        covariance_px2=np.array([o.covariance_px2[k] for o, k in zip(observed, keypoint, strict=True)]),
    )
    return model, sum(len(votes) > 1 for votes in votes_of_label.values())
