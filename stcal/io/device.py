"""Pictures of cameras of this machine (V4L2, UVC), streams and videos through OpenCV; sharp frames of a video that
differ in their view; simulated cameras."""

import contextlib
import threading
import time
import warnings
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from stcal.errors import InputError, InputNote, environment
from stcal.io.files import IMAGE_BYTES, read_bytes, save, unwritable
from stcal.io.images import SUFFIXES, decode, find_images, grey_8bit
from stcal.parallel import scratch_folder

MANUAL_V4L2, MANUAL_OTHERS = 1.0, 0.25
"""Values of OpenCV's AUTO_EXPOSURE that mean manual: V4L2's menu, and the convention of the other back ends."""
SATURATED = 250
DARK = 5
FULL_SCALE = 255
SIMULATED_NOISE = 1.0  # noise σ of a pixel of the simulated camera, grey values
PATIENCE_S = 5.0  # time without a picture after which a camera or a stream counts as lost, s
FFMPEG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
"""Variable of the environment by which OpenCV sets how much FFmpeg says."""
READINGS = 3
"""Number of frames that a driver may still have in its queue after the exposure was changed."""


@runtime_checkable
class Source(Protocol):
    """A device that takes images."""

    name: str

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """Return a grey image (h, w), and the exposure at which it was taken, in the driver's unit."""
        ...

    def close(self) -> None:
        """Give the camera back."""
        ...


class OpenCVSource:
    """A camera of this machine.

    Parameters
    ----------
    device : Its number, or a path such as ``/dev/video0``.
    gain : Gain in the driver's unit; unchanged if None.
    """

    def __init__(self, device: str, gain: float | None = None):
        self.name = f"camera {device}"
        place = int(device) if device.isdigit() else device
        self._capture = _device(place)
        if not self._capture.isOpened():
            free = "check that it is plugged in and free (`ls /dev/video*`), or --simulate with an image"
            raise InputError("E-DEVICE-OPEN", f"{self.name}: cannot be opened; {free}")
        back_end = self._capture.getBackendName()
        self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_V4L2 if back_end == "V4L2" else MANUAL_OTHERS)
        if gain is not None and not self._capture.set(cv2.CAP_PROP_GAIN, gain):
            self.close()
            no_gain = f"{self.name}: its driver ({back_end}) takes no gain; leave --gain out"
            raise InputError("E-DEVICE-SETTING", no_gain)

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """Return an image and its exposure, see :class:`Source`; frames during the settle time are dropped."""
        if not self._capture.set(cv2.CAP_PROP_EXPOSURE, exposure):
            remedy = "give exposures in its unit (V4L2: 100 µs), see `v4l2-ctl --list-ctrls`"
            none = f"{self.name}: its driver takes no exposure {exposure:g}; {remedy}"
            raise InputError("E-DEVICE-SETTING", none)
        until, frame, read = time.monotonic() + settle_s, None, 0
        while frame is None or read < READINGS or time.monotonic() < until:
            received, frame = self._capture.read()
            read += 1
            if not received or frame is None:
                raise InputError("E-DEVICE-NO-IMAGE", f"{self.name}: no longer gives images; check its cable")
        return _grey(frame), float(self._capture.get(cv2.CAP_PROP_EXPOSURE))

    def close(self) -> None:
        """Give the camera back."""
        self._capture.release()


class SimulatedSource:
    """A simulated camera that shows an image. It belongs to exposure 1; brightness is proportional to exposure.

    Parameters
    ----------
    image : str or Path
    gain : Factor on the brightness; 1 if None.
    seed : Seed of the noise.
    """

    def __init__(self, image: str | Path, gain: float | None = None, seed: int = 0):
        self._image = Path(image)
        self.name = f"simulated camera before {self._image.name}"
        self._gain = 1.0 if gain is None else gain
        self._rng = np.random.default_rng(seed)

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """Return the image at an exposure, see :class:`Source`; there is no settle time."""
        try:
            content = read_bytes(self._image, IMAGE_BYTES)
        except OSError as error:
            unread = f"{self._image}: {error.strerror or error}; an image needed to simulate a camera"
            raise InputError("E-IMAGE-UNREADABLE", unread) from error
        grey = exposure * self._gain * grey_8bit(decode(content, str(self._image))).astype(float)
        grey += self._rng.normal(0, SIMULATED_NOISE, grey.shape)
        return np.clip(np.round(grey), 0, FULL_SCALE).astype(np.uint8), exposure

    def close(self) -> None:
        """Do nothing: a simulated camera holds no device."""


def png(image: np.ndarray) -> bytes:
    """Return the bytes of a PNG file of a grey image."""
    return cv2.imencode(".png", image)[1].tobytes()


@contextmanager
def pictures_of(source: int | str) -> Iterator[Iterator[np.ndarray]]:
    """Open a camera by number, a stream by URL, a video file or a folder of images, and return its pictures, grey.
    Pictures of a camera or a stream that come while one is measured are left out; of a file or a folder none is.
    Raises InputError: it cannot be opened or gives no picture, or none for ``PATIENCE_S`` in between."""
    if isinstance(source, str) and Path(source).is_dir():
        paths = [file.path for file in find_images(source)[0]]
        yield (grey_8bit(decode(read_bytes(path, IMAGE_BYTES), str(path))) for path in paths)
        return
    what = f"--camera-index {source}" if isinstance(source, int) else f"--live {source}"
    device = _device(source)
    is_file = isinstance(source, str) and Path(source).is_file()
    pictures = _every(device) if is_file else _newest(device, what)
    try:
        if not device.isOpened():
            remedy = "give a camera's number, a stream's URL, a video file or a folder of images"
            raise InputError("E-LIVE-SOURCE", f"{what}: cannot be opened; {remedy}")
        first = next(pictures, None)
        if first is None:
            raise InputError("E-LIVE-SOURCE", f"{what}: opened, but gives no picture; is another program using it?")
        yield chain([first], pictures)
    finally:
        pictures.close()  # which waits until nothing reads from the device any more
        device.release()


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep back what OpenCV prints by itself; its errors are raised as ever."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _device(source: int | str) -> cv2.VideoCapture:
    """Return the source, opened if it can be. The libraries' own words about it are kept back."""
    with environment({FFMPEG_LEVEL: "-8"}), quiet_opencv():
        device = cv2.VideoCapture(source)
        device.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as the sensor wrote them, which the camera file describes
        return device


def _grey(frame: np.ndarray) -> np.ndarray:
    return frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)


def _every(device: cv2.VideoCapture) -> Generator[np.ndarray, None, None]:
    while (read := device.read())[0]:
        yield _grey(read[1])


def _newest(device: cv2.VideoCapture, what: str) -> Generator[np.ndarray, None, None]:
    """Yield the newest picture of a camera or a stream, and leave out those that come meanwhile."""
    came, ended = threading.Event(), threading.Event()
    newest: deque[np.ndarray] = deque(maxlen=1)

    def read() -> None:
        while not ended.is_set() and (taken := device.read())[0]:
            newest.append(taken[1])
            came.set()
        ended.set()
        came.set()

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        while newest or not ended.is_set():
            if not came.wait(PATIENCE_S):
                raise InputError("E-LIVE-LOST", f"{what}: no picture for {PATIENCE_S:g} s; is it still connected?")
            came.clear()
            if newest:
                yield _grey(newest.pop())
    finally:
        ended.set()
        thread.join()


AUTO = "auto"
SMALL_PX = 240  # longer side of the frames that are compared, px
MOVED = 0.04
"""Move of the parts that move most, share of the longer side, from which a view is another: about two degrees."""
MOVING = 90
"""Percentile of the moves of pixels: a body before a resting background has few pixels."""
SHARP_BLUR_PX = 2.0
"""σ, px, of the blur that measures a frame's sharpness: an already blurred one loses hardly any detail."""
EDGE_SHARE = 0.05  # share of the pixels that are taken for edges
ALL, NEXT, BEFORE = slice(None), slice(1, None), slice(None, -1)
DIRECTIONS = (
    ((ALL, NEXT), (ALL, BEFORE)),
    ((NEXT, ALL), (BEFORE, ALL)),
    ((NEXT, NEXT), (BEFORE, BEFORE)),
    ((NEXT, BEFORE), (BEFORE, NEXT)),
)
"""Neighbours along the rows, the columns and both diagonals."""
LEAST_SHARPNESS = 0.6
"""Smallest sharpness of a chosen frame, as a share of the median: by motion or a focus that hunts, others have less."""
LEAST_FRAMES = 3
MOST_FRAMES = 120
"""Most frames that are chosen: more of one video cost time, and hardly add views."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame: its ``number``, ``grey`` as the video has it, ``small`` (h, w) for comparison, ``sharpness``."""

    number: int
    grey: np.ndarray
    small: np.ndarray
    sharpness: float


def checked_every(every: str | int) -> str | int:
    """Return ``auto`` or the number of frames."""
    if every == AUTO:
        return AUTO
    with contextlib.suppress(ValueError):
        if (count := int(every)) >= 1:
            return count
    raise InputError("E-OPTION-VALUE", f"--every {str(every)[:20]}: auto or a number of frames, 1 and more, needed")


def sharpness(grey: np.ndarray) -> float:
    """Return how much steeper the edges of a grey image are than after a blur, in the direction where they are
    least. It is a ratio of squared differences of neighbours, less 1, at the blurred image's steepest edges, so that
    brightness, contrast and empty parts do not count."""
    picture = grey.astype(np.float32)
    blurred = cv2.GaussianBlur(picture, (0, 0), SHARP_BLUR_PX)
    ratios = []
    for first, second in DIRECTIONS:
        own, smooth = ((image[first] - image[second]) ** 2 for image in (picture, blurred))
        edges = smooth >= max(float(np.quantile(smooth, 1 - EDGE_SHARE)), 1e-6)
        ratios.append(float(own[edges].sum() / smooth[edges].sum()) - 1 if edges.any() else 0.0)
    return max(min(ratios), 0.0)


def chosen_frames(frames: Iterator[np.ndarray], every: str | int = AUTO) -> Iterator[_Frame]:
    """Yield the sharpest frame of each part of a video in which the view hardly changes, or of ``every`` frames."""
    start = last = best = None
    for number, grey in enumerate(frames):
        scale = SMALL_PX / max(grey.shape)
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        frame = _Frame(number, grey, small, sharpness(grey))
        if start is None or (
            number // every != start.number // every if isinstance(every, int) else _move(start, frame) >= MOVED
        ):
            if best is not None:
                yield best
                last = best
            start, best = frame, None
        apart = last is None or isinstance(every, int) or _move(last, frame) >= MOVED / 2
        if apart and (best is None or frame.sharpness > best.sharpness):
            best = frame
    if best is not None:
        yield best


def _move(first: _Frame, second: _Frame) -> float:
    """Return the motion of the fastest parts between two frames, as a share of the frames' longer side."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(first.small, second.small, None)  # type: ignore[call-overload]
    return float(np.percentile(np.linalg.norm(flow, axis=2), MOVING)) / SMALL_PX


def write_frames(video: str | Path, folder: str | Path, every: str | int = AUTO) -> list[Path]:
    """Write the chosen frames of a video into a folder, as ``frame_<number>.png``; those of an earlier call go. A
    warning lists them. Frames that are blurred more than others are left out. Raises InputError: the video cannot be
    read, fewer than ``LEAST_FRAMES`` views of it differ, or the folder cannot be written."""
    video, folder, every = Path(video), Path(folder), checked_every(every)
    written: list[tuple[Path, int, float]] = []
    device = _device(str(video))
    try:
        frames = _every(device)
        first = next(frames, None) if device.isOpened() else None
        if first is None:
            unread = f"video {video}: cannot be read as one, a folder of images or a video file needed"
            convert = "another program may convert it, such as `ffmpeg -i VIDEO clip.mp4`"
            raise InputError("E-VIDEO-UNREADABLE", f"{unread}; {convert}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.glob("frame_*.png"):
                old.unlink()
        except OSError as error:
            raise unwritable(folder, error) from error
        for frame in chosen_frames(chain([first], frames), every):
            path = folder / f"frame_{frame.number:06d}.png"
            save(path, png(frame.grey))
            written.append((path, frame.number, frame.sharpness))
    finally:
        device.release()
    usual = float(np.median([sharp for _, _, sharp in written]))
    sharp_ones = [each for each in written if each[2] >= LEAST_SHARPNESS * usual]
    spare = np.linspace(0, len(sharp_ones) - 1, min(len(sharp_ones), MOST_FRAMES)).round().astype(int).tolist()
    chosen = [sharp_ones[k] for k in spare]
    for path in {path for path, _, _ in written} - {path for path, _, _ in chosen}:
        path.unlink()
    if len(chosen) < LEAST_FRAMES:
        few = f"video {video}: {len(chosen)} sharp frames with different views, {LEAST_FRAMES} needed"
        remedy = "move the target or the camera more, and slowly, or name a number of frames with --every"
        raise InputError("E-VIDEO-VIEWS", f"{few}; {remedy}")
    blurred = len(written) - len(sharp_ones)
    warnings.warn(
        f"{video.name}: {len(chosen)} frames chosen{f', {blurred} left out as blurred' if blurred else ''}: "
        f"{', '.join(str(number) for _, number, _ in chosen)}; photographs are better: rolling shutter and compression "
        "move edges, which σ do not know",
        InputNote,
        stacklevel=2,
    )
    return [path for path, _, _ in chosen]


@contextlib.contextmanager
def images_or_frames(images: Path) -> Iterator[Path]:
    """Yield a folder of images, or of one image, as it is; of a video, a folder with its chosen frames."""
    if not images.is_file() or images.suffix.lower() in SUFFIXES:
        yield images
        return
    with scratch_folder("frames") as folder:
        write_frames(images, folder)
        yield folder
