"""Image files by group, their pixels as the sensor gave them, and jobs on images, by processes or on a cluster."""

import contextlib
import os
import re
import socket
import tempfile
import threading
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, TypeVar

import cv2
import numpy as np
from PIL import ExifTags, Image

from stcal.errors import DetectionError, InputError, held
from stcal.io import decoding
from stcal.io.decoding import ends_properly, is_png, patterns_seen, png_intact
from stcal.io.files import IMAGE_BYTES, RUN_MARKER, read_bytes
from stcal.parallel import hand_over, run_parallel

USUAL = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
SUFFIXES = (*USUAL, *decoding.readable())
"""Suffixes of the images that are read, some of them by optional packages."""
UNPACKED = (".png", ".tif", ".tiff", ".bmp")
"""Forms in which programs of industrial cameras write pixels as the sensor gave them."""
EXCLUDED = "taken out with --exclude"
HOLDS_IMAGES = "it holds images"  # part of the reason why a folder is left out
TOP_GROUP = "."  # name of the group that images lying directly in the folder form
NOISE_BLUR_PX = 1.5  # σ of the blur that removes noise
SAME_NOISE = 1.2
"""Largest RMS difference of two files of one photograph, over its noise: JPEG differs by 1.1, exposures by 1.5."""
SAME_GREY = 1.0
"""Lower limit of the allowed RMS difference, of 255: rounding and compression cause as much without noise."""
SAME_EDGES = 1.5
"""Factor on the allowed RMS difference with edges: compression changes them little, motion of the camera much."""
MAJORITY = "the majority of the images"  # what states the size of images where the camera file does not
TIFF_HEADS = (b"II*\0", b"MM\0*")
THUMBNAIL_PX = 1400
THUMBNAIL_QUALITY = 80
MOST_JPEG_SIDE = 65_000  # largest height of a thumbnail, px; the JPEG format is limited to 65 535
_DAMAGE = re.compile(
    rb"(Corrupt JPEG data(?!: \d+ extraneous bytes before marker 0xd9)|Premature end|TIFF_Error)[^\n]*"
)
"""Messages that decoders write to standard error without failing; stray bytes before the end of a JPEG do no harm."""
_STANDARD_ERROR = threading.Lock()  # lock that is held while standard error is redirected


@dataclass(frozen=True, slots=True)
class ImageFile:
    """An image file; ``name`` : path below the image folder, with /; ``content`` : bytes carried to another machine."""

    path: Path
    name: str
    group: str
    content: bytes | None = field(default=None, repr=False)

    def read(self) -> bytes:
        """Return the content of the file. Raises InputError: it is gone, and a result without it would be another
        one than was asked for. Raises OSError: it cannot be read, or is too large for an image."""
        if self.content is not None:
            return self.content
        try:
            return read_bytes(self.path, IMAGE_BYTES)
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
            reason = "was there when the work began, and is gone; put it back, or begin again without it"
            raise InputError("E-IMAGES-GONE", f"{self.path}: {reason}") from error

    def carried(self) -> "ImageFile":
        """Return the file with its content. An unreadable file is unchanged: its later read reports the error."""
        try:
            return replace(self, content=self.read())
        except (OSError, InputError):
            return self


@dataclass(frozen=True, slots=True)
class Skipped:
    """A file that is not used, and the reason: its ``value`` does not meet the ``limit`` of the check ``gate``."""

    name: str
    reason: str
    gate: str = "readable"
    value: str | None = None
    limit: str | None = None


ImageFiles = tuple[list[ImageFile], list[Skipped]]
"""Files to use and files that are left out, as they were when the work began."""


def image_file(path: Path) -> ImageFile:
    """Return a single image file, outside of any folder of images."""
    return ImageFile(path, path.name, TOP_GROUP)


@lru_cache(maxsize=4)
def _mosaics(path: Path, _: int) -> tuple[str, ...]:
    """Return the patterns that an image may be a mosaic of; commands look for the same images more than once."""
    with contextlib.suppress(Exception), Image.open(path) as image:  # whoever reads it says what is wrong
        if image.mode in ("L", "I", "I;16", "I;16B"):
            return patterns_seen(decode(read_bytes(path, IMAGE_BYTES), path.name))
    return ()


def _refuse_mosaics(files: Sequence[ImageFile]) -> None:
    for first in [file for file in files if file.path.suffix.lower() in UNPACKED][:1]:
        if seen := _mosaics(first.path, first.path.stat().st_mtime_ns):
            fault = f"{first.name}: its pixels are a mosaic of colours, {' or '.join(seen)}, as a sensor with a Bayer "
            remedy = "filter delivers them; give the grey or colour images that the camera's program makes of it"
            raise InputError("E-IMAGE-MOSAIC", fault + remedy)


def _entries(root: Path) -> Iterator[tuple[Path, str, str]]:
    """Yield path, name and group of a single file, or of what lies in a folder and in its groups."""
    if root.is_file():
        yield root, root.name, TOP_GROUP
        return
    for path in sorted(root.iterdir(), key=lambda p: (p.is_dir(), p.name)):
        if not path.is_dir():
            yield path, path.name, TOP_GROUP
        elif not path.name.startswith(".") and not (path / RUN_MARKER).exists():
            for inner in sorted(path.iterdir(), key=lambda p: p.name):
                yield inner, f"{path.name}/{inner.name}", path.name


def find_images(folder: str | Path) -> tuple[list[ImageFile], list[Skipped]]:
    """Return the image files below a folder, or the one image, by group and name, and the files that are skipped."""
    root = Path(folder)
    entries = _entries(root) if root.exists() else ()
    judged = [_judged(*entry) for entry in entries if not entry[0].name.startswith(".")]
    files = [each for each in judged if isinstance(each, ImageFile)]
    skipped = [each for each in judged if isinstance(each, Skipped)]
    if not files and not root.is_dir():
        fault = f"not a folder, and {skipped[0].reason}" if skipped else "does not exist"
        raise InputError("E-IMAGES-FOLDER", f"image folder {root}: {fault}; give a folder or an image")
    if not files:
        unread = set(decoding.UNREAD.values())  # then a nested folder is the most helpful hint: images lie too deep
        telling = sorted(
            skipped, key=lambda s: (s.reason not in unread, s.gate != "folder", HOLDS_IMAGES not in s.reason)
        )
        hint = "".join(f" (left out {s.name}: {s.reason})" for s in telling[:1])
        kinds = f"{', '.join(s[1:] for s in USUAL)}{hint}"
        raise InputError("E-IMAGES-NONE", f"image folder {root}: no image, {kinds}; put them into {root}/<group>/")
    _refuse_mosaics(files)
    return files, skipped


def chosen_images(folder: str | Path, exclude: Sequence[str] = ()) -> tuple[list[ImageFile], list[Skipped]]:
    """Return :func:`find_images` with the images ``exclude``, by name or path, among the skipped files."""
    return without_excluded(*find_images(folder), exclude, folder)


def without_excluded(
    files: list[ImageFile], skipped: list[Skipped], exclude: Sequence[str], folder: str | Path
) -> ImageFiles:
    """Return the files with the images ``exclude`` moved to the skipped ones; errors as :func:`chosen_images`."""
    excluded: set[str] = set()
    for word in exclude:
        matching = {file.name for file in files if word == file.name or Path(word).absolute() == file.path.absolute()}
        if not matching:
            none = f"--exclude {word}: no such image in {folder}"
            raise InputError("E-OPTION-EXCLUDE", f"{none}; give its name as results have it, such as {files[0].name}")
        excluded |= matching
    remaining = [file for file in files if file.name not in excluded]
    if not remaining:
        every = f"image folder {folder}: --exclude takes out all {len(files)} images"
        raise InputError("E-OPTION-EXCLUDE", f"{every}; leave some in")
    return remaining, [*skipped, *(Skipped(f.name, EXCLUDED, "excluded") for f in files if f.name in excluded)]


def _judged(path: Path, name: str, group: str) -> ImageFile | Skipped:
    plain = name.encode("utf-8", "backslashreplace").decode()
    if path.is_dir():
        reason = "a folder inside a group; images lie in <group>/ directly"
        with contextlib.suppress(OSError):  # the folder cannot be read
            if any(inner.suffix.lower() in SUFFIXES for inner in path.iterdir()):
                reason += f"; {HOLDS_IMAGES}: did you mean {path.parent}?"
        return Skipped(plain, reason, "folder")
    if path.suffix.lower() not in SUFFIXES:
        kinds, suffix = ", ".join(USUAL), path.suffix.lower()
        reason = decoding.UNREAD.get(suffix, "not an image file")
        return Skipped(plain, reason, "file_type", path.suffix or "no suffix", kinds)
    if plain != name or name_fault(name):  # result files cannot store such a name
        reason = f"its name {name_fault(name) or 'is not UTF-8'}; rename it"
        return Skipped(repr(plain)[1:-1], reason, "file_name")
    if not path.is_file():
        return Skipped(name, "cannot be read: not a file, or a broken link")
    return ImageFile(path, name, group)


def name_fault(name: str) -> str | None:
    """Return what is wrong with an image's name, or None; on any system it must lie below the folder of images."""
    if any(unicodedata.category(character) == "Cc" for character in name):
        return "holds a control character"
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        if path.anchor or path.drive or ".." in path.parts:
            return "leads out of the folder of images"
    return None


def decode(data: bytes, name: str, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return the grey image (height, width), uint8 or uint16, of an image file's bytes, with pixels as the sensor gave
    them. If the camera's ``size`` is given and the image has its sides swapped, it is turned as EXIF says."""
    if not data:
        raise InputError("E-IMAGE-EMPTY", f"{name}: empty file (0 bytes); copy it again")
    if not ends_properly(data):
        raise InputError("E-IMAGE-TRUNCATED", f"{name}: truncated ({len(data)} bytes); copy it again")
    if is_png(data) and not png_intact(data):
        raise InputError("E-IMAGE-DAMAGED", f"{name}: damaged (a checksum is wrong); copy it again")
    if decoding.is_heic(data):
        image = decoding.heic_grey(data, name)
    elif name.lower().endswith(decoding.RAW) or (data[:4] in TIFF_HEADS and decoding.is_dng(data)):
        raise InputError("E-IMAGE-TYPE", f"{name}: {decoding.UNREAD['.dng']}")
    else:
        image = _decoded(data, name)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError("E-IMAGE-TYPE", f"{name}: pixels of type {image.dtype}; 8 or 16 bit needed")
    if image.dtype == np.uint16 and data[:4] in TIFF_HEADS:
        with contextlib.suppress(Exception), Image.open(BytesIO(data)) as file:  # damaged EXIF fails in many ways
            if file.getexif().get(ExifTags.Base.PhotometricInterpretation) == 0:
                image = np.iinfo(np.uint16).max - image  # white is zero; the decoder turns those of 8 bit alone
    if size is not None and size[0] != size[1] and image.shape == size:  # (height, width) is (width, height)
        turn = _turn(data)
        return image if turn is None else cv2.rotate(image, turn)
    return image


def _decoded(data: bytes, name: str) -> np.ndarray:
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    with _STANDARD_ERROR, _decoder_messages() as messages:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            image = None
        if image is not None:
            image = _clearest(image, lambda: cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_COLOR))
    if image is None:
        unread = f"{name}: not readable as an image; copy it again, or convert it to {', '.join(USUAL)}"
        raise InputError("E-IMAGE-UNREADABLE", unread)
    if damage := _DAMAGE.search(messages):
        seen = damage[0].decode(errors="replace").strip()
        raise InputError("E-IMAGE-DAMAGED", f"{name}: damaged ({seen}); copy it again")
    return image


SPARSE = 5  # only one row and column in this number is looked at
FLAT, CLEARER = 0.1, 3.0
"""Range of grey values below which channels are looked at, and how many times larger a channel's must be."""


def _clearest(grey: np.ndarray, colours: Callable[[], Any]) -> np.ndarray:
    """Return a grey image, or the channel that shows what is flat in it: colours of equal brightness."""
    if grey.dtype.kind != "u" or _range(grey) >= FLAT:
        return grey
    channel = np.asarray(max(cv2.split(colours()), key=_range))
    return channel if _range(channel) > CLEARER * _range(grey) else grey


def _range(image: np.ndarray) -> float:
    """Return the range of all but the darkest and brightest hundredth of the pixels, as a share of all values."""
    low, high = np.percentile(image[::SPARSE, ::SPARSE], (1, 99))
    return float(high - low) / np.iinfo(image.dtype).max


def _turn(data: bytes) -> int | None:
    """Return the turn that EXIF states; None if it is none by 90°, or if the size in EXIF shows that it was done."""
    turns = {6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}
    try:
        with Image.open(BytesIO(data)) as image:
            exif = image.getexif()
            stated = exif.get_ifd(ExifTags.IFD.Exif)
            width, height = (stated.get(tag) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight))
            if width and height and (width < height) != (image.size[0] < image.size[1]):
                return None
            return turns.get(exif.get(ExifTags.Base.Orientation, 1))
    except Exception:  # damaged EXIF fails in many ways
        return None


def common_size(files: Sequence[ImageFile]) -> tuple[tuple[int, int], str] | None:
    """Return width and height, px, of most files, and a name among them; None if no file is readable."""
    with_size: dict[tuple[int, int], list[ImageFile]] = {}
    unknown: list[ImageFile] = []
    for file in files:
        try:
            with Image.open(BytesIO(file.content) if file.content is not None else file.path) as image:
                with_size.setdefault(image.size, []).append(file)
        except Exception:  # a file that is no image fails in many ways
            unknown.append(file)
    ranked = sorted(with_size.values(), key=len, reverse=True)
    _refuse_a_tie({size: own for size, own in with_size.items() if len(own) == len(ranked[0])})
    for own in (*ranked, unknown):
        for file in own:
            if shape := _shape(file):
                return (shape[1], shape[0]), file.name
    return None


def _refuse_a_tie(equal: dict[tuple[int, int], list[ImageFile]]) -> None:
    sizes = [size for size, own in equal.items() if any(map(_shape, own))] if len(equal) > 1 else []
    if len(sizes) < 2:
        return
    shown = " and ".join(f"{len(equal[s])} of {s[0]}×{s[1]} px, first {equal[s][0].name}" for s in sizes[:2])
    turn = "turn one half back by 90°, or leave it out" if sizes[0] == sizes[1][::-1] else "leave one size out"
    raise InputError("E-IMAGES-SIZES", f"images: {shown}: no size is that of the majority; {turn}")


def _shape(file: ImageFile) -> tuple[int, ...]:
    try:
        return decode(file.read(), file.name).shape
    except (InputError, OSError):
        return ()


def require_common_size(files: Sequence[ImageFile]) -> tuple[tuple[int, int], str]:
    """Return width and height, px, of most of the images, and the name of one of them."""
    found = common_size(files)
    if found is None:
        fault = f"no readable image among {len(files)}, first {files[0].name}"
        raise InputError("E-IMAGES-NONE-READABLE", f"{fault}; check them")
    return found


def size_fault(name: str, own: tuple[int, int], wanted: tuple[int, int], stated_by: str) -> Skipped:
    """Return why an image of another size is skipped; ``stated_by`` : what says the size that is ``wanted``, px."""
    own_text, wanted_text = ("{}×{} px".format(*size) for size in (own, wanted))
    reason = f"{own_text}, but {stated_by} says {wanted_text}; "
    if own == wanted[::-1]:
        reason = f"sides swapped: {reason}a program turned it by 90°, and nothing says which way: turn it back "
        reason += "without loss (jpegtran -rotate), or copy it again as the camera wrote it"
    else:
        reason += "use images as the camera took them, or the camera file that belongs to them"
    return Skipped(name, reason, "image_size", own_text, wanted_text)


def stated_size(data: bytes, name: str) -> tuple[int, int]:
    """Return width and height, px, from the header of an image file, without decoding it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(BytesIO(data)) as image:
                return image.size
    except Image.DecompressionBombError as error:
        fault = f"{name}: more pixels than any camera has"
        raise InputError("E-IMAGE-TOO-LARGE", f"{fault}; send the file of the camera unchanged") from error
    except Exception as error:  # data that are no image fail in many ways
        fault = f"{name}: no readable image"
        raise InputError("E-IMAGE-UNREADABLE", f"{fault}; convert it to {', '.join(USUAL)}") from error


def grey_of(image: np.ndarray, name: str) -> np.ndarray:
    """Return the grey image (height, width) of an array, grey or with three channels RGB."""
    image = np.asarray(image)
    if not image.size or image.shape[2:] not in ((), (1,), (3,)) or image.ndim < 2:
        fault = f"{name}: shape {image.shape}"
        raise InputError("E-ARRAY-SHAPE", f"{fault}; (height, width), or (height, width, 3) of RGB needed")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError("E-IMAGE-TYPE", f"{name}: pixels of type {image.dtype}; 8 or 16 bit needed")
    if image.ndim == 2:
        return image
    return _clearest(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), lambda: image) if image.shape[2] == 3 else image[:, :, 0]


def grey_8bit(image: np.ndarray) -> np.ndarray:
    """Return the image in 8 bit; deeper images are scaled so that their bright end just fits."""
    if image.dtype == np.uint8:
        return image
    return cv2.convertScaleAbs(image, alpha=255.0 / _bright_end(image))


def grey_fine(image: np.ndarray) -> np.ndarray:
    """Return the image in the grey values of :func:`grey_8bit`, but without rounding."""
    return image if image.dtype == np.uint8 else image * np.float32(255.0 / _bright_end(image))


def require_grey(image: np.ndarray, size: tuple[int, int] | None, name: str = "image") -> None:
    """Refuse an array that is not a grey image of 8 or 16 bits, or not of the camera's ``size``, (width, height) px."""
    if not isinstance(image, np.ndarray):
        raise InputError("E-IMAGE-TYPE", f"{name}: {type(image).__name__}, no image; leave lost frames out")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        remedy = "; of colours, give one: image[:, :, 1] is green" if image.ndim == 3 else ""
        fault = f"{name}: {image.dtype} of shape {image.shape}"
        raise InputError("E-IMAGE-TYPE", f"{fault}; 8 or 16 bits of grey needed{remedy}")
    if size is not None and image.shape[::-1] != size:
        fault = f"{name}: {image.shape[1]}×{image.shape[0]} px, camera {size[0]}×{size[1]} px"
        raise InputError("E-IMAGE-SIZE", f"{fault}; give images as the camera took them")


def same_photograph(image: np.ndarray, other: np.ndarray) -> bool:
    """Return True if two grey images are two files of one exposure, of equal noise but for losses by compression. That
    of two exposures differs by √2 times itself. Brightness may differ by a factor and a constant."""
    if image.shape != other.shape:
        return False
    first, second = (grey_8bit(grey).astype(np.float32) for grey in (image, other))
    first, second = first - first.mean(), second - second.mean()
    first *= float((first * second).mean()) / max(float((first * first).mean()), 1e-9)
    smooth = [cv2.GaussianBlur(grey, (0, 0), NOISE_BLUR_PX) for grey in (first, second)]
    slope = np.hypot(*np.gradient(smooth[0]))
    flat = slope <= np.median(slope)  # edges would hide the noise

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt((values[flat] ** 2).mean()))

    allowed = max(SAME_GREY, SAME_NOISE * max(rms(first - smooth[0]), rms(second - smooth[1])))
    return rms(second - first) < allowed and float(np.sqrt(((second - first) ** 2).mean())) < SAME_EDGES * allowed


def shrunk(image: np.ndarray, scale: float) -> np.ndarray:
    """Return the image at a scale of at most 1, at least one pixel wide and high."""
    height, width = image.shape[:2]
    if min(height, width) * scale <= 0.5:  # rounding would leave no pixel
        size = max(1, round(width * scale)), max(1, round(height * scale))
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def thumbnail(grey: np.ndarray, width_px: int = THUMBNAIL_PX) -> tuple[np.ndarray, float]:
    """Return a small JPEG (bytes as a uint8 array) of an 8-bit grey image, and its scale relative to the image."""
    height, width = grey.shape
    scale = min(1.0, width_px / width, MOST_JPEG_SIDE / height)
    while scale < 0.5:  # halving is cheap, and removes most of the pixels
        grey, scale = shrunk(grey, 0.5), 2 * scale
    small = shrunk(grey, scale)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY])
    return jpeg.ravel(), small.shape[1] / width


def _bright_end(image: np.ndarray) -> float:
    return max(float(np.percentile(image[::4, ::4], 99.95)), 255.0)


@contextlib.contextmanager
def _decoder_messages() -> Iterator[bytearray]:
    """Collect what C libraries write to standard error, the only sign of made-up pixels; by one thread at a time."""
    messages = bytearray()
    try:
        standard_error = os.dup(2)
    except OSError:  # the process has no standard error
        yield messages
        return
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(standard_error, 2)
            os.close(standard_error)
            caught.seek(0)
            messages += caught.read()


R = TypeVar("R")
_elsewhere: ContextVar[tuple[Executor, int, bool] | None] = ContextVar("executor of images", default=None)


def spread(executor: Executor, at_once: int, send_images: bool = False) -> contextlib.AbstractContextManager[None]:
    """Let an executor, which stays open, run the jobs on single images inside the ``with`` block; results are the
    same. ``at_once`` : number of images that are handed over at a time; ``send_images`` : whether by content, and
    not by their path on storage that all machines share."""
    return held(_elsewhere, (executor, at_once, send_images))


def run_on_images(
    function: Callable[..., R], jobs: Sequence[tuple], workers: int | None = None, kept: bool = False
) -> Iterator[tuple[int, R]]:
    """Yield index and result of each job, run by :func:`stcal.parallel.run_parallel` or the executor of
    :func:`spread`. The first argument of a job is an image file, or a list of them. ``kept`` : True if the caller
    keeps finished results, so that a second try continues there. Raises DetectionError: a process was ended from
    outside. Raises InputError: a worker does not see the folder of an image."""
    if current := _elsewhere.get():
        executor, at_once, send_images = current
        sent = ((function, _sent(files, send_images), *arguments) for files, *arguments in jobs)
        yield from hand_over(executor, _on_worker, sent, at_once)
        return
    try:
        yield from run_parallel(function, jobs, workers)
    except BrokenExecutor as error:
        died = f"images, {len(jobs)} of them: a process was ended from outside, for lack of memory perhaps"
        again = f"run the same command again, with fewer --workers{', finished detections are kept' * kept}"
        raise DetectionError("E-WORKER-DIED", f"{died}; {again}") from error


def _sent(files: ImageFile | list[ImageFile], with_content: bool) -> list[ImageFile] | ImageFile:
    if isinstance(files, list):
        return [_sent(file, with_content) for file in files]  # type: ignore[misc]
    return files.carried() if with_content else replace(files, path=files.path.absolute())


def _on_worker(function: Callable, files: ImageFile | list[ImageFile], *arguments):
    for file in [files] if isinstance(files, ImageFile) else files:
        if file.content is None and not file.path.parent.is_dir():
            fault = f"{file.path.parent}: does not exist on worker {socket.gethostname()}"
            raise InputError("E-WORKER-PATH", f"{fault}; give a path that all workers see, or --send-images")
    return function(files, *arguments)
