"""Detection in all images, from files or memory, in parallel, and what is remembered of it.

A folder keeps what was detected in an image, under a hash of its content and of all that detection depends on (camera,
designs, options, versions), and what a second look measured, under a hash of the places that it searched. Commands that
share the folder, as ``detect`` and ``run`` do, detect nothing twice, whatever the files are called.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from stcal.boards.finders import shift_by_curves
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DetectionError, InputError
from stcal.geometry.camera import Camera
from stcal.io.cache import keep, keep_packed, kept, made_by, packed
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.images import (
    MAJORITY,
    ImageFile,
    ImageFiles,
    Skipped,
    decode,
    grey_8bit,
    grey_of,
    name_fault,
    require_common_size,
    run_on_images,
    same_photograph,
    size_fault,
    thumbnail,
    without_excluded,
)
from stcal.labels import CircleLabel, DotLabel, parse_label
from stcal.sfm.data.group_model import Centres, Note
from stcal.sfm.detect.candidates import BoardSighting, EllipseOptions, FaceSighting, ImageDetection
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.predict import PredictedCircles, SecondLook, measure_predicted

CACHE_VERSION = 13
"""Version of detection, which increases with every change of its results, so that older cached results are not used."""

PHOTOGRAPHS = "the photographs"  # where a camera that was found is from, for messages
LOSSY = (".jpg", ".jpeg")
COPY = re.compile(r"\b(copy|kopie|copie|copia|cópia)\b|\(\d+\)|~", re.IGNORECASE)  # in names, by file managers
KEPT: dict[str, Callable] = {"dict": lambda *pairs: dict(pairs), "label": parse_label}
KEPT |= {kind.__name__: kind for kind in (BoardSighting, Centres, FaceSighting, ImageDetection, Note, SecondLook)}
"""What makes the parts of cached results, by the name of their type."""
SAME_PLACE_PX = 4.0
SAME_SHARE = 0.6  # share of an image's circles that lie within the same squares of that side in another form of it

Detector = Callable[[np.ndarray, Camera, TargetDesign, BoardDesign | None, EllipseOptions], ImageDetection]
"""Type of functions that detect circles in one grey image."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectedImage:
    """One file with its detection."""

    file: ImageFile
    detection: ImageDetection
    digest: str  # of its content
    thumbnail: bytes  # a small JPEG
    thumbnail_scale: float  # its size over the image's
    reused: bool  # whether the detection was kept from an earlier run


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
    progress: Callable[[str], None] | None = None,  # called with the name of each finished file, in any order
    detector: Detector | None = None,  # reads one image; that of this package if None
    forms: bool = True,  # whether a photograph in several forms, such as PNG and JPEG, counts once
    pictures: bool = True,  # whether a small picture of each image is kept, for overlays
) -> DetectionResult:
    """Detects circles in all files; unusable files are skipped and listed. It is an error if no file is usable."""
    camera, size_from = sized_by(camera_model, files)
    cache.mkdir(parents=True, exist_ok=True)
    settings = _fingerprint(detector, camera, target, board, options, pictures)
    outcomes: list[DetectedImage | Skipped | None] = [None] * len(files)
    if any(cache.glob("*.npz")):
        with ThreadPoolExecutor() as pool:  # reading and hashing release the interpreter
            outcomes[:] = pool.map(lambda file: _kept(file, settings, cache), files)
    pending = [i for i, each in enumerate(outcomes) if each is None]
    step = progress or (lambda _: None)
    for file, each in zip(files, outcomes, strict=True):
        if each is not None:
            step(file.name)
    common = camera, size_from, (target, board, options), settings, detector or detect_image, pictures
    for k, outcome in run_on_images(_detect_file, [(files[i], *common) for i in pending], workers, kept=True):
        i = pending[k]
        if isinstance(outcome, Skipped):
            outcomes[i] = outcome
        else:  # saved in the cache and loaded from there
            path = cache / f"{outcome[0]}.npz"
            keep_packed(path, outcome[1])
            outcomes[i] = _load(files[i], path, reused=False)
            if outcomes[i] is None:
                raise InputError("E-OUTPUT-READ-BACK", f"{path}: written, and cannot be read again; check the disk")
        step(files[i].name)
    grouped = forms and board is not None and board.rows > 0  # a board moves between groups
    images, skipped = _without_copies([f for f in outcomes if f is not None], forms, grouped)
    if not images:
        first = skipped[0]
        raise InputError("E-IMAGES-NONE-USABLE", f"no usable image among {len(files)}: {first.name}: {first.reason}")
    return DetectionResult(tuple(images), tuple(skipped), camera)


def seen_by(detection: DetectionResult, camera: Camera, target: TargetDesign) -> DetectionResult:
    """Returns corners of tags, made with a camera without distortion, as another camera sees them."""
    images = []
    for image in detection.images:
        centres = image.detection.centres
        centre_px = centres.centre_px.copy()
        for sighting in image.detection.printed:
            if target.face(sighting.face).of_tags:
                corners = centre_px[sighting.rows].reshape(-1, 4, 2)
                centre_px[sighting.rows] = (corners - shift_by_curves(corners, camera)).reshape(-1, 2)
        seen = replace(centres, centre_px=centre_px, centre=camera.normalised_from_pixel(centre_px))
        images.append(replace(image, detection=replace(image.detection, centres=seen)))
    return replace(detection, images=tuple(images), camera=camera)


def sized_by(camera_model: CameraModel, files: list[ImageFile]) -> tuple[Camera, str]:
    """Returns the camera with its image size, and the source of the size: the file, or most images if it lacks one."""
    if camera_model.width and camera_model.height:
        stated_by = MAJORITY if camera_model.source == PHOTOGRAPHS else "the camera file"
        return camera_model.sized(camera_model.width, camera_model.height), stated_by
    size, name = require_common_size(files)
    camera_model.require_inside(*size, name)
    return camera_model.sized(*size), MAJORITY


def _fingerprint(detector: Detector | None, camera: Camera, target, board, options, pictures: bool) -> str:
    """Returns a hash of everything that detection depends on except the image."""
    dots = {key: value for key, value in asdict(board).items() if key != "stated"} if board else None
    lens = {key: value for key, value in asdict(camera).items() if key not in ("colmap_model", "covariance")}
    parts = [CACHE_VERSION, made_by(), cv2.__version__, lens, asdict(target.patterns_alone()), dots, asdict(options)]
    parts += [*([detector.__name__] if detector else []), *([] if pictures else ["no picture"])]
    plain = json.dumps(parts, default=lambda each: getattr(each, "tolist", each.__str__)(), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()


def _key(data: bytes, settings: str) -> tuple[str, str]:
    digest = hashlib.sha256(data).hexdigest()
    return digest, hashlib.sha256(f"{digest} {settings}".encode()).hexdigest()[:40]


def _kept(file: ImageFile, settings: str, cache: Path) -> DetectedImage | None:
    """Returns the cached result for this content and these settings."""
    try:
        path = cache / f"{_key(file.read(), settings)[1]}.npz"
    except OSError:
        return None
    return _load(file, path, reused=True)


def _detect_file(
    file: ImageFile, camera: Camera, size_from: str, seen, settings: str, detector: Detector, pictures: bool
) -> tuple[str, bytes] | Skipped:
    """Detects circles in one file; returns the key of the result and its content for the cache."""
    loaded = load_image(file, camera, size_from)
    if isinstance(loaded, Skipped):
        return loaded
    data, image = loaded
    try:
        detection = detector(image, camera, *seen)
    except (ConvergenceError, DetectionError) as error:
        return Skipped(file.name, str(error), *(["distortion"] if isinstance(error, ConvergenceError) else []))
    digest, key = _key(data, settings)
    picture, scale = thumbnail(grey_8bit(image)) if pictures else (np.zeros(0, np.uint8), 1.0)
    arrays = {"thumbnail": picture}
    meta = {"detection": _plain(detection, arrays), "digest": digest, "scale": scale}
    return key, packed(key, arrays, meta)


def load_image(file: ImageFile, camera: Camera, size_from: str) -> tuple[bytes, np.ndarray] | Skipped:
    """Returns the content of a file and its grey image, or why it cannot be used; ``size_from``: source of the size."""
    try:
        data = file.read()
    except OSError as error:
        return Skipped(file.name, f"cannot be read: {error.strerror or error}")
    try:
        image = decode(data, file.name, (camera.width, camera.height))
    except InputError as error:
        return Skipped(file.name, str(error).removeprefix(f"{file.name}: "))
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        return size_fault(file.name, (width, height), (camera.width, camera.height), size_from)
    return data, image


def _plain(value, arrays: dict[str, np.ndarray]):
    """Returns a result as JSON can hold it, with its arrays by their names in ``arrays``; :func:`_whole` undoes it."""
    if isinstance(value, np.ndarray):
        arrays[name := str(len(arrays))] = value
        return {"array": name}
    if isinstance(value, CircleLabel | DotLabel):
        return {"label": [str(value)]}
    if isinstance(value, Note):
        return {"Note": [value.words, value.code, value.place, value.remedy]}
    if isinstance(value, dict):
        return {"dict": [_plain(pair, arrays) for pair in value.items()]}
    if is_dataclass(value):
        return {type(value).__name__: [_plain(getattr(value, f.name), arrays) for f in fields(value)]}
    return [_plain(each, arrays) for each in value] if isinstance(value, tuple) else value


def _whole(plain, arrays: Mapping[str, np.ndarray]):
    if isinstance(plain, dict):
        ((kind, content),) = plain.items()
        return arrays[content] if kind == "array" else KEPT[kind](*_whole(content, arrays))
    return tuple(_whole(each, arrays) for each in plain) if isinstance(plain, list) else plain


def _load(file: ImageFile, path: Path, reused: bool) -> DetectedImage | None:
    """Loads a cached result; None if there is none, or the file is not as it was saved."""

    def make(stored, meta) -> DetectedImage:
        detection, picture = _whole(meta["detection"], stored), stored["thumbnail"].tobytes()
        return DetectedImage(file, detection, meta["digest"], picture, meta["scale"], reused)

    return kept(path, make)


def look_again(
    jobs: Sequence[tuple[DetectedImage, PredictedCircles]],
    camera: Camera,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
) -> dict[str, SecondLook]:
    """Measures the circles that are predicted in images, by name; an image that cannot be read any more has none."""
    looks: dict[str, SecondLook] = {}
    pending: list[tuple[ImageFile, Camera, PredictedCircles, EllipseOptions]] = []
    paths: list[Path] = []
    for image, predicted in jobs:
        stated = CACHE_VERSION, made_by(), cv2.__version__, image.digest, predicted.labels, predicted.polarity, options
        hasher = hashlib.sha256("\0".join(map(str, stated)).encode())
        for values in (predicted.centre_px, predicted.shape_px, predicted.wanted, camera.parameters()):
            hasher.update(values.tobytes())
        path = cache / f"again-{hasher.hexdigest()[:40]}.npz"
        if known := kept(path, lambda stored, meta: _whole(meta["look"], stored)):
            looks[image.file.name] = known
        else:
            pending.append((image.file, camera, predicted, options))
            paths.append(path)
    for k, look in run_on_images(_look_again, pending, workers, kept=True):
        if look is not None:
            arrays: dict[str, np.ndarray] = {}
            meta = {"look": _plain(look, arrays)}
            keep(paths[k], arrays, meta)
            looks[pending[k][0].name] = look
    return looks


def _look_again(file: ImageFile, camera: Camera, *searched) -> SecondLook | None:
    loaded = load_image(file, camera, "")
    return None if isinstance(loaded, Skipped) else measure_predicted(loaded[1], camera, *searched)


def copy_of(file: ImageFile, first: str, what: str = "") -> Skipped:
    """Returns the reason why a second file of the same content is skipped."""
    return Skipped(file.name, f"the same image as {first}{what}", "copy")


def _without_copies(
    outcomes: list[DetectedImage | Skipped], forms: bool, grouped: bool
) -> tuple[list[DetectedImage], list[Skipped]]:
    """Returns the images without copies of photographs, of which the plainest name stays, and the files skipped."""
    detected = [outcome for outcome in outcomes if isinstance(outcome, DetectedImage)]
    same: dict[str, list[ImageFile]] = {}
    for image in sorted(detected, key=lambda image: _plainness(image.file)):
        same.setdefault(image.digest, []).append(image.file)
    groups = [{file.group for file in files} for files in same.values()]
    whole = {group for each in groups if len(each) == 1 for group in each}  # others are copied folders
    copies: dict[str, Skipped] = {}
    for (first, *others), shown in zip(same.values(), groups, strict=True):
        if grouped and len(both := sorted(shown & whole)) > 1:
            reason = f"the same photograph is in groups {' and '.join(both)}, and belongs to one; delete the other file"
            copies |= {file.name: Skipped(file.name, reason, "copy") for file in (first, *others)}
        else:
            copies |= {file.name: copy_of(file, first.name) for file in others}
    for pair in _in_two_forms([image for image in detected if image.file.name not in copies] if forms else []):
        first, second = sorted((image.file for image in pair), key=_plainness)
        with suppress(InputError, OSError):
            if not {first.name, second.name} & copies.keys() and same_photograph(
                *(decode(each.read(), each.name) for each in (first, second))
            ):
                copies[second.name] = copy_of(second, first.name, ", saved in another form")
    images = [image for image in detected if image.file.name not in copies]
    reasons = [outcome if isinstance(outcome, Skipped) else copies.get(outcome.file.name) for outcome in outcomes]
    return images, [reason for reason in reasons if reason is not None]


def _plainness(file: ImageFile) -> tuple[bool, bool, int]:
    """Returns a sort key: lossless files first, then names without a word for copy, then short names."""
    return file.path.suffix.lower() in LOSSY, bool(COPY.search(file.path.stem)), len(file.path.stem)


def _in_two_forms(images: list[DetectedImage]) -> Iterator[tuple[DetectedImage, DetectedImage]]:
    """Yields pairs in different forms with circles at the same places; a camera that does not move has equal forms."""
    kinds = [each.file.path.suffix.lower()[:4].replace(".jpe", ".jpg") for each in images]
    if len(set(kinds)) < 2:
        return
    places = [np.floor(each.detection.centres.centre_px / SAME_PLACE_PX).astype(int) for each in images]
    squares = [set(map(tuple, each.tolist())) for each in places]
    for (first, kind, own), (second, other_kind, other) in combinations(zip(images, kinds, squares, strict=True), 2):
        if kind != other_kind and len(own & other) >= max(1, SAME_SHARE * min(len(own), len(other))):
            yield first, second


def require_upright(images: tuple[DetectedImage, ...], board: BoardDesign | None = None) -> None:
    """Raises an error if more than half of the images with a face are mirrored, or rather the drawing, as a board with
    one larger dot, which is read the right way round alone, shows."""
    mirrored = [image for image in images if image.detection.mirrored]
    upright = [image for image in images if image.detection.faces and not image.detection.mirrored]
    if mirrored and len(mirrored) > len(upright):
        first, drawing = mirrored[0], "the drawing is mirrored: change the sign of y_mm of all circles in target.toml"
        remedy = f"flip the images back, or use the files that the camera wrote; if these are its files, {drawing}"
        handed = board is not None and board.corner is not None and board.rows != board.columns
        if handed and sum(bool(image.detection.boards) for image in mirrored) > len(mirrored) / 2:
            remedy = f"as the board's dots are the right way round, {drawing}"
        count = f"{len(mirrored)} of {len(mirrored) + len(upright)} images with a face are mirrored, first "
        shown = f"{first.file.name}: face {', '.join(first.detection.mirrored)} appears mirrored"
        raise DetectionError("E-FACES-MIRRORED", f"{count}{shown}; {remedy}")


def files_of_arrays(images: Mapping[str, Sequence[np.ndarray]], exclude: Sequence[str] = ()) -> ImageFiles:
    """Return images in memory as files that carry their content, named ``12/0.png``, ``12/1.png`` … by group.
    ``images`` : grey or RGB arrays of 8 or 16 bit, by name of the group; ``exclude`` : names of those not used."""
    named = [(group, f"{group}/{k}.png", image) for group, arrays in images.items() for k, image in enumerate(arrays)]
    if not named:
        raise InputError("E-IMAGES-NONE", "images: no image in memory; give arrays by the name of their group")
    for group, name, _ in named:
        if fault := name_fault(name) or ("is no name of one folder" if "/" in group or not group else None):
            raise InputError("E-IMAGES-GROUP", f"images: group {group!r} {fault}; give a plain name, such as 12")

    def file(group: str, name: str, image: np.ndarray) -> ImageFile:
        content = cv2.imencode(".png", grey_of(image, name), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        return ImageFile(Path(name), name, group, content)

    with ThreadPoolExecutor() as pool:  # encoding releases the interpreter
        files = list(pool.map(file, *zip(*named, strict=True)))
    return without_excluded(files, [], exclude, "memory")
