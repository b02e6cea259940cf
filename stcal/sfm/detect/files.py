"""Detection over all files: in parallel, each result kept by the content of its image and the options."""

import hashlib
import json
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DetectionError, InputError
from stcal.geometry.camera import Camera
from stcal.io.cache import keep, kept
from stcal.io.camera import CameraModel
from stcal.io.images import ImageFile, Skipped, decode, grey_8bit, thumbnail
from stcal.labels import circle_labels
from stcal.parallel import run_parallel
from stcal.sfm.detect.centres import Centres
from stcal.sfm.detect.ellipses import EllipseOptions
from stcal.sfm.detect.image import ImageDetection, detect_image

CACHE_VERSION = 2
"""Raised whenever detection gives other results for the same image: what was kept is then not used again."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectedImage:
    """One file with its detection; ``digest`` of its content; ``thumbnail`` a small JPEG, ``thumbnail_scale`` its size
    over the image's; ``reused`` whether the detection was kept from an earlier run."""

    file: ImageFile
    detection: ImageDetection
    digest: str
    thumbnail: bytes
    thumbnail_scale: float
    reused: bool


@dataclass(frozen=True, slots=True, eq=False)
class DetectionResult:
    """``images`` in the order of the files, ``skipped`` files with reasons, ``camera`` with its size."""

    images: tuple[DetectedImage, ...]
    skipped: tuple[Skipped, ...]
    camera: Camera


def detect_files(
    files: list[ImageFile],
    camera_model: CameraModel,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> DetectionResult:
    """Detect in all files; what cannot be used is skipped and listed.

    Parameters
    ----------
    cache : folder for results by content
    progress : called with the name of each finished file, in any order

    Raises
    ------
    InputError
        No file is usable; the message names the first one and its reason.
    """
    camera = _sized(camera_model, files)
    cache.mkdir(parents=True, exist_ok=True)
    settings = _fingerprint(camera, target, board, options)
    size_from = "the camera file" if camera_model.width and camera_model.height else "the first readable image"
    jobs = [(file, camera, size_from, target, board, options, settings, cache) for file in files]
    found: list[DetectedImage | Skipped | None] = [None] * len(files)
    pending = []
    for i, file in enumerate(files):
        found[i] = _kept(file, settings, cache)
        if found[i] is None:
            pending.append(i)
        elif progress:
            progress(file.name)
    try:
        for k, outcome in run_parallel(_detect_file, [jobs[i] for i in pending], workers):
            i = pending[k]
            found[i] = (
                outcome if isinstance(outcome, Skipped) else _load(files[i], cache / f"{outcome}.npz", reused=False)
            )
            if found[i] is None:
                raise InputError(f"{cache / f'{outcome}.npz'}: written, and cannot be read again; check the disk")
            if progress:
                progress(files[i].name)
    except BrokenProcessPool as error:
        raise DetectionError(
            f"detection in {len(pending)} images: a process was ended from outside, for lack of memory perhaps; "
            "run again with fewer --workers, finished detections are kept"
        ) from error
    images, skipped = _without_copies([f for f in found if f is not None])
    if not images:
        first = skipped[0]
        raise InputError(f"no usable image among {len(files)}: {first.name}: {first.reason}")
    return DetectionResult(tuple(images), tuple(skipped), camera)


def _sized(camera_model: CameraModel, files: list[ImageFile]) -> Camera:
    """The camera; a file of OpenCV may not say its size, then the first readable image does."""
    if camera_model.width and camera_model.height:
        return camera_model.sized(camera_model.width, camera_model.height)
    for file in files:
        try:
            height, width = decode(file.path.read_bytes(), file.name).shape
        except (InputError, OSError):
            continue
        camera_model.require_inside(width, height, file.name)
        return camera_model.sized(width, height)
    raise InputError(f"no readable image among {len(files)}, first {files[0].name}; check the files")


def _fingerprint(camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions) -> str:
    """Hash of everything but the image that detection depends on."""

    def plain(value):
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    parts = [CACHE_VERSION, asdict(camera), asdict(target), asdict(board) if board else None, asdict(options)]
    return hashlib.sha256(json.dumps(parts, default=plain, sort_keys=True).encode()).hexdigest()


def _key(data: bytes, settings: str) -> tuple[str, str]:
    digest = hashlib.sha256(data).hexdigest()
    return digest, hashlib.sha256(f"{digest} {settings}".encode()).hexdigest()[:40]


def _kept(file: ImageFile, settings: str, cache: Path) -> DetectedImage | None:
    """The result of an earlier run for this content and these settings."""
    if not any(cache.iterdir()):
        return None
    try:
        path = cache / f"{_key(file.path.read_bytes(), settings)[1]}.npz"
    except OSError:
        return None
    return _load(file, path, reused=True) if path.exists() else None


def _detect_file(
    file: ImageFile,
    camera: Camera,
    size_from: str,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    settings: str,
    cache: Path,
) -> str | Skipped:
    """Detect in one file and keep the result; returns its key."""
    try:
        data = file.path.read_bytes()
    except OSError as error:
        return Skipped(file.name, f"cannot be read: {error.strerror or error}")
    try:
        image = decode(data, file.name)
    except InputError as error:
        return Skipped(file.name, str(error).removeprefix(f"{file.name}: "))
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        return Skipped(
            file.name,
            f"{width}×{height} px, but {size_from} says {camera.width}×{camera.height} px; "
            "use images as the camera took them, or the camera file that belongs to them",
            "image_size",
            f"{width}×{height} px",
            f"{camera.width}×{camera.height} px",
        )
    try:
        detection = detect_image(image, camera, target, board, options)
    except ConvergenceError as error:
        return Skipped(file.name, str(error), "distortion")
    digest, key = _key(data, settings)
    _save(cache / f"{key}.npz", detection, digest, image)
    return key


def _save(path: Path, detection: ImageDetection, digest: str, image: np.ndarray) -> None:
    jpeg, scale = thumbnail(grey_8bit(image))
    meta = {
        "digest": digest,
        "scale": scale,
        "target_labels": detection.target_labels,
        "notes": detection.notes,
        "repeated": detection.repeated,
        "candidates": detection.candidates,
    }
    arrays = {f.name: getattr(detection.centres, f.name) for f in fields(Centres)}
    keep(path, {"numberings": detection.numberings, "thumbnail": jpeg, **arrays}, meta)


def _load(file: ImageFile, path: Path, reused: bool) -> DetectedImage | None:
    """Read what was kept; None where the file is damaged."""

    def make(stored, meta) -> DetectedImage:
        detection = ImageDetection(
            Centres(*(stored[f.name] for f in fields(Centres))),
            circle_labels(meta["target_labels"]),
            stored["numberings"],
            tuple(meta["notes"]),
            tuple(meta["repeated"]),
            meta["candidates"],
        )
        return DetectedImage(file, detection, meta["digest"], stored["thumbnail"].tobytes(), meta["scale"], reused)

    return kept(path, make)


def _without_copies(found: list[DetectedImage | Skipped]) -> tuple[list[DetectedImage], list[Skipped]]:
    """A second copy of a photograph adds no information and would pass for it."""
    images: list[DetectedImage] = []
    skipped: list[Skipped] = []
    first: dict[str, str] = {}
    for each in found:
        if isinstance(each, Skipped):
            skipped.append(each)
        elif each.digest in first:
            skipped.append(Skipped(each.file.name, f"the same image as {first[each.digest]}", "copy"))
        else:
            first[each.digest] = each.file.name
            images.append(each)
    return images, skipped


def require_single(images: tuple[DetectedImage, ...]) -> None:
    """Refuse images in which a face or the board is in view more than once.

    Raises
    ------
    DetectionError
        Naming image and face.
    """
    for image in images:
        if image.detection.repeated:
            what = ", ".join(image.detection.repeated)
            raise DetectionError(
                f"{image.file.name}: {what} found more than once; only one target and one board may be in view, "
                "cover or remove the other (or its mirror image)"
            )
