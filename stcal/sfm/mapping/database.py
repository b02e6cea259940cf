"""COLMAP's bindings and its database: one camera, one frame for each image, labelled keypoints, and matches."""

import ctypes
import os
import re
import signal
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, Camera
from stcal.io.table import csv_text
from stcal.labels import CircleLabel
from stcal.sfm.data.group_model import ImageObservations

# The bindings, imported only here, install signal handlers. The system's own are restored, of every signal and in any
# thread: Python knows only some of them.
_ROOM = 1024  # more bytes than the system's struct sigaction has anywhere
_handlers: dict[int, ctypes.Array] = {}
if os.name == "posix":
    _system = ctypes.CDLL(None)
    # They wait until the import ends: NumPy, which it may load, would make another error of an interrupt.
    _blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    for _number in signal.valid_signals():
        _before = ctypes.create_string_buffer(_ROOM)
        if _system.sigaction(int(_number), None, _before) == 0:
            _handlers[int(_number)] = _before
try:
    import pycolmap
finally:
    if os.name == "posix":
        for _number, _before in _handlers.items():
            _system.sigaction(_number, _before, None)
        signal.pthread_sigmask(signal.SIG_SETMASK, _blocked)

CAMERA_ID = RIG_ID = 1
LOG_FATAL_ALONE = 3


def colmap_camera(camera: Camera) -> pycolmap.Camera:
    """Returns the camera in COLMAP's form, with COLMAP's pixel origin."""
    size, lens = {"width": camera.width, "height": camera.height}, camera.colmap_params()
    of = {"camera_id": CAMERA_ID, "model": camera.colmap_model, "params": lens}
    return pycolmap.Camera(**of, **size, has_prior_focal_length=True)


def to_colmap_px(xy_px: np.ndarray) -> np.ndarray:
    """Converts OpenCV pixels to COLMAP's. The only place where the pixel origin is shifted on output."""
    return np.asarray(xy_px, float) + COLMAP_PIXEL_ORIGIN


def from_colmap_px(xy_px: np.ndarray) -> np.ndarray:
    """Converts COLMAP pixels to OpenCV's. The only place where the pixel origin is shifted on input."""
    return np.asarray(xy_px, float) - COLMAP_PIXEL_ORIGIN


def image_ids(observations: Sequence[ImageObservations]) -> dict[str, int]:
    """Returns COLMAP's image id, which is also the frame id, by image name: 1, 2, … in the given order."""
    return {image.name: i for i, image in enumerate(observations, start=1)}


def match_labels(a: ImageObservations, b: ImageObservations) -> np.ndarray:
    """Returns the keypoint indices (n, 2) of the labels that both images show. Dots match within one group only."""
    keypoint_of_label = {label: j for j, label in enumerate(b.labels)}
    same_board = a.group == b.group
    pairs = [
        (i, keypoint_of_label[label])
        for i, label in enumerate(a.labels)
        if label in keypoint_of_label and (same_board or isinstance(label, CircleLabel))
    ]
    return np.array(pairs, dtype=np.uint32).reshape(-1, 2)


def write_database(
    path: str | Path,
    camera: Camera,
    observations: Sequence[ImageObservations],
    pairs: np.ndarray,  # (n, 2) indices of the images to match
    # (n, 2) by image, OpenCV pixel origin; by default the measured centres
    keypoints_px: Sequence[np.ndarray] | None = None,
) -> None:
    """Writes a new database atomically: the file appears complete or not at all."""
    partial = Path(path).with_name(Path(path).name + ".partial")
    remove_database(partial)
    pycolmap.logging.minloglevel = LOG_FATAL_ALONE  # what fails is raised
    try:
        with pycolmap.Database.open(str(partial)) as database:
            # row by row, since a transaction of COLMAP ends the process if the disk is full
            native, rig, ids = colmap_camera(camera), pycolmap.Rig(rig_id=RIG_ID), image_ids(observations)
            database.write_camera(native, use_camera_id=True)
            rig.add_ref_sensor(native.sensor_id)
            database.write_rig(rig, use_rig_id=True)
            for i, image in enumerate(observations):
                record = pycolmap.Image(name=image.name, camera_id=CAMERA_ID, image_id=ids[image.name])
                frame = pycolmap.Frame(frame_id=ids[image.name], rig_id=RIG_ID)
                frame.add_data_id(record.data_id)
                database.write_image(record, use_image_id=True)
                database.write_frame(frame, use_frame_id=True)
                xy = image.centre_px if keypoints_px is None else keypoints_px[i]
                database.write_keypoints(ids[image.name], to_colmap_px(xy).astype(np.float32))
            for i, j in pairs:
                a, b = observations[i], observations[j]
                matches = match_labels(a, b)
                database.write_matches(ids[a.name], ids[b.name], matches)
                geometry = pycolmap.TwoViewGeometry(inlier_matches=matches)
                # COLMAP 4.x silently skips pairs of configuration UNDEFINED.
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                database.write_two_view_geometry(ids[a.name], ids[b.name], geometry)
        if Path(f"{partial}-wal").exists():  # SQLite could not move its content into the database, and does not say so
            raise RuntimeError("a part of it is left in the log")
    except RuntimeError as error:
        remove_database(partial)
        raise unwritable(path, error) from error
    for suffix in ("-wal", "-shm"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
    os.replace(partial, path)


def unwritable(path: str | Path, error: RuntimeError) -> InputError:
    """Returns the error of a database that COLMAP cannot write, or cannot open for lack of space beside it."""
    reason = re.sub(r"^\[[^]]*] *", "", str(error))
    fault = f"database {path}: cannot be written ({reason})"
    return InputError("E-OUTPUT-UNWRITABLE", f"{fault}; check the folder's space and rights")


def remove_database(path: Path) -> None:
    """Removes a database and SQLite's files beside it."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)


def labels_csv(
    observations: Sequence[ImageObservations], corrected_px: Sequence[np.ndarray], residual_px: Sequence[np.ndarray]
) -> str:
    """``labels.csv``, a row for each keypoint; residuals outside of the result are nan, and their cells empty."""
    columns = (
        "image_id keypoint image group label x_px y_px corrected_x_px corrected_y_px var_x_px2 cov_xy_px2 var_y_px2 "
        "residual_x_px residual_y_px"
    )
    rows: list[Sequence] = [columns.split()]
    ids = image_ids(observations)
    for image, corrected, residual in zip(observations, corrected_px, residual_px, strict=True):
        covariance = image.covariance_px2.reshape(-1, 4)[:, [0, 1, 3]]
        values = np.column_stack([image.centre_px, corrected, covariance]).tolist()
        for k, label in enumerate(image.labels):
            residual_cells = ["" if np.isnan(v) else repr(v) for v in residual[k].tolist()]
            rows.append([ids[image.name], k, image.name, image.group, label, *map(repr, values[k]), *residual_cells])
    return csv_text(rows)
