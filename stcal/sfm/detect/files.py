"""Detection over all files: in parallel, each result kept by the content of its image and the options."""

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DetectionError, InputError
from stcal.geometry.camera import Camera
from stcal.io.cache import keep, kept, packed
from stcal.io.camera import CameraModel
from stcal.io.images import ImageFile, Skipped, decode, grey_8bit, thumbnail
from stcal.io.saving import save
from stcal.io.spread import run_on_images
from stcal.labels import parse_label, parse_labels
from stcal.sfm.data.centres import Centres
from stcal.sfm.detect.circles.ellipses import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.predict import PredictedCircles, SecondLook, measure_predicted
from stcal.sfm.detect.sightings import BoardSighting, FaceSighting, ImageDetection

CACHE_VERSION = 7
"""Raised whenever detection gives other results for the same image: what was kept is then not used again."""

Detector = Callable[[np.ndarray, Camera, TargetDesign, BoardDesign | None, EllipseOptions], ImageDetection]
"""Reads one grey image."""


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
    detector: Detector | None = None,
) -> DetectionResult:
    """Detect in all files; what cannot be used is skipped and listed.

    Parameters
    ----------
    cache : folder for results by content
    progress : called with the name of each finished file, in any order
    detector : what reads one image; ours where None

    Raises
    ------
    InputError
        No file is usable; the message names the first one and its reason.
    DetectionError
        A process that worked on an image was ended from outside.
    """
    camera, size_from = sized_by(camera_model, files)
    cache.mkdir(parents=True, exist_ok=True)
    settings = _fingerprint(detector, camera, target, board, options)
    jobs = [(file, camera, size_from, target, board, options, settings, detector) for file in files]
    found: list[DetectedImage | Skipped | None] = [None] * len(files)
    if any(cache.glob("*.npz")):
        with ThreadPoolExecutor() as pool:  # reading and hashing release the interpreter
            found[:] = pool.map(lambda file: _kept(file, settings, cache), files)
    pending = [i for i, each in enumerate(found) if each is None]
    for file, each in zip(files, found, strict=True):
        if each is not None and progress:
            progress(file.name)
    for k, outcome in run_on_images(_detect_file, [jobs[i] for i in pending], workers, kept=True):
        i = pending[k]
        found[i] = outcome if isinstance(outcome, Skipped) else _stored(files[i], cache, *outcome)
        if progress:
            progress(files[i].name)
    images, skipped = _without_copies([f for f in found if f is not None])
    if not images:
        first = skipped[0]
        raise InputError(f"no usable image among {len(files)}: {first.name}: {first.reason}")
    return DetectionResult(tuple(images), tuple(skipped), camera)


def sized_by(camera_model: CameraModel, files: list[ImageFile]) -> tuple[Camera, str]:
    """The camera, and what its size is from: a file of OpenCV may not say it, then the first readable image does."""
    if camera_model.width and camera_model.height:
        return camera_model.sized(camera_model.width, camera_model.height), "the camera file"
    for file in files:
        try:
            height, width = decode(file.read(), file.name).shape
        except (InputError, OSError):
            continue
        camera_model.require_inside(width, height, file.name)
        return camera_model.sized(width, height), "the first readable image"
    raise InputError(f"no readable image among {len(files)}, first {files[0].name}; check the files")


def _fingerprint(
    detector: Detector | None, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> str:
    """Hash of everything but the image that detection depends on."""

    def plain(value):
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    dots = {key: value for key, value in asdict(board).items() if key != "stated"} if board else None
    parts = [CACHE_VERSION, asdict(camera), asdict(target.patterns_alone()), dots, asdict(options)]
    parts += [detector.__name__] if detector else []
    return hashlib.sha256(json.dumps(parts, default=plain, sort_keys=True).encode()).hexdigest()


def _key(data: bytes, settings: str) -> tuple[str, str]:
    digest = hashlib.sha256(data).hexdigest()
    return digest, hashlib.sha256(f"{digest} {settings}".encode()).hexdigest()[:40]


def _kept(file: ImageFile, settings: str, cache: Path) -> DetectedImage | None:
    """The result of an earlier run for this content and these settings."""
    try:
        path = cache / f"{_key(file.read(), settings)[1]}.npz"
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
    detector: Detector | None,
) -> tuple[str, bytes] | Skipped:
    """Detect in one file: the key of the result, and what is to be kept of it."""
    loaded = load_image(file, camera, size_from)
    if isinstance(loaded, Skipped):
        return loaded
    data, image = loaded
    try:
        detection = (detector or detect_image)(image, camera, target, board, options)
    except ConvergenceError as error:
        return Skipped(file.name, str(error), "distortion")
    digest, key = _key(data, settings)
    return key, _packed(detection, digest, image)


def _stored(file: ImageFile, cache: Path, key: str, content: bytes) -> DetectedImage:
    """Keep a result, and take it as it is kept."""
    path = cache / f"{key}.npz"
    save(path, content)
    found = _load(file, path, reused=False)
    if found is None:
        raise InputError(f"{path}: written, and cannot be read again; check the disk")
    return found


def load_image(file: ImageFile, camera: Camera, size_from: str) -> tuple[bytes, np.ndarray] | Skipped:
    """Content of a file and the grey image in it, or why it cannot be used; ``size_from`` : what the size is from."""
    try:
        data = file.read()
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
    return data, image


def _packed(detection: ImageDetection, digest: str, image: np.ndarray) -> bytes:
    jpeg, scale = thumbnail(grey_8bit(image))
    meta = {
        "digest": digest,
        "scale": scale,
        "faces": [each.face for each in detection.faces],
        "boards": len(detection.boards),
        "open_faces": [[each.face for each in faces] for faces in detection.open_faces],
        "mirrored": detection.mirrored,
        "notes": detection.notes,
        "candidates": detection.candidates,
    }
    arrays = _centre_arrays(detection.centres)
    for i, face in enumerate(detection.faces):
        arrays |= {f"face_rows_{i}": face.rows, f"face_circles_{i}": face.circles}
    for i, faces in enumerate(detection.open_faces):
        for k, face in enumerate(faces):
            arrays |= {f"open_rows_{i}_{k}": face.rows, f"open_circles_{i}_{k}": face.circles}
    for i, each in enumerate(detection.boards):
        arrays |= {f"board_{f.name}_{i}": getattr(each, f.name) for f in fields(BoardSighting)}
    return packed({"thumbnail": jpeg, **arrays}, meta)


def _load(file: ImageFile, path: Path, reused: bool) -> DetectedImage | None:
    """Read what was kept; None where the file is damaged."""

    def make(stored, meta) -> DetectedImage:
        faces = [
            FaceSighting(face, stored[f"face_rows_{i}"], stored[f"face_circles_{i}"])
            for i, face in enumerate(meta["faces"])
        ]
        boards = [
            BoardSighting(*(stored[f"board_{f.name}_{i}"] for f in fields(BoardSighting)))
            for i in range(meta["boards"])
        ]
        open_faces = [
            tuple(
                FaceSighting(face, stored[f"open_rows_{i}_{k}"], stored[f"open_circles_{i}_{k}"])
                for k, face in enumerate(names)
            )
            for i, names in enumerate(meta["open_faces"])
        ]
        detection = ImageDetection(
            _stored_centres(stored),
            tuple(faces),
            tuple(boards),
            tuple(meta["mirrored"]),
            tuple(meta["notes"]),
            meta["candidates"],
            tuple(open_faces),
        )
        return DetectedImage(file, detection, meta["digest"], stored["thumbnail"].tobytes(), meta["scale"], reused)

    return kept(path, make)


def _centre_arrays(centres: Centres) -> dict[str, np.ndarray]:
    return {f.name: getattr(centres, f.name) for f in fields(Centres)}


def _stored_centres(stored) -> Centres:
    return Centres(*(stored[f.name] for f in fields(Centres)))


def look_again(
    jobs: Sequence[tuple[DetectedImage, PredictedCircles]],
    camera: Camera,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
) -> dict[str, SecondLook]:
    """Measure the circles that are predicted in images; by name. What an earlier run measured is kept.

    An image that can no longer be read is left as it was after the first look.
    """
    found: dict[str, SecondLook] = {}
    pending: list[tuple[ImageFile, Camera, PredictedCircles, EllipseOptions]] = []
    paths: list[Path] = []
    for image, predicted in jobs:
        path = cache / f"again-{_predicted_key(image.digest, predicted, camera, options)}.npz"
        known = kept(path, _stored_look)
        if known is None:
            pending.append((image.file, camera, predicted, options))
            paths.append(path)
        else:
            found[image.file.name] = known
    for k, look in run_on_images(_look_again, pending, workers, kept=True):
        if look is not None:
            keep(paths[k], _centre_arrays(look.centres), {"labels": look.labels, "missed": look.missed})
            found[pending[k][0].name] = look
    return found


def _predicted_key(digest: str, predicted: PredictedCircles, camera: Camera, options: EllipseOptions) -> str:
    hasher = hashlib.sha256(f"{CACHE_VERSION}\0{digest}\0{predicted.labels}\0{predicted.polarity}\0{options}".encode())
    for values in (predicted.centre_px, predicted.shape_px, predicted.wanted, camera.parameters()):
        hasher.update(values.tobytes())
    return hasher.hexdigest()[:40]


def _look_again(
    file: ImageFile, camera: Camera, predicted: PredictedCircles, options: EllipseOptions
) -> SecondLook | None:
    try:
        image = decode(file.read(), file.name)
    except (InputError, OSError):
        return None
    return measure_predicted(image, camera, predicted, options)


def _stored_look(stored, meta) -> SecondLook:
    missed = {parse_label(label): reason for label, reason in meta["missed"].items()}
    return SecondLook(parse_labels(meta["labels"]), _stored_centres(stored), missed)


def copy_of(file: ImageFile, first: str) -> Skipped:
    """Why a second file of the same content is left out."""
    return Skipped(file.name, f"the same image as {first}", "copy")


def _without_copies(found: list[DetectedImage | Skipped]) -> tuple[list[DetectedImage], list[Skipped]]:
    """A second copy of a photograph adds no information and would pass for it."""
    images: list[DetectedImage] = []
    skipped: list[Skipped] = []
    first: dict[str, str] = {}
    for each in found:
        if isinstance(each, Skipped):
            skipped.append(each)
        elif each.digest in first:
            skipped.append(copy_of(each.file, first[each.digest]))
        else:
            first[each.digest] = each.file.name
            images.append(each)
    return images, skipped


def require_upright(images: tuple[DetectedImage, ...]) -> None:
    """Refuse a set of images that is mirrored.

    Raises
    ------
    DetectionError
        Of the images that show a face more are mirrored than are not.
    """
    mirrored = [image for image in images if image.detection.mirrored]
    upright = [image for image in images if image.detection.faces and not image.detection.mirrored]
    if mirrored and len(mirrored) > len(upright):
        first = mirrored[0]
        raise DetectionError(
            f"{len(mirrored)} of {len(mirrored) + len(upright)} images with a face are mirrored, first "
            f"{first.file.name}: face {', '.join(first.detection.mirrored)} is seen as in a mirror; turn the images "
            "back, or use the files that the camera wrote"
        )
