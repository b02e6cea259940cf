"""Image sources: cameras of this machine (V4L2, UVC), streams and videos through OpenCV; simulated cameras."""

import os
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from stcal.errors import InputError
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode, find_images, grey_8bit

MANUAL_V4L2, MANUAL_OTHERS = 1.0, 0.25
"""Values of OpenCV's AUTO_EXPOSURE that mean manual: V4L2's menu, and the convention of the other back ends."""
SATURATED = 250
DARK = 5
FULL_SCALE = 255
SIMULATED_NOISE = 1.0
"""Noise σ of a pixel of the simulated camera, grey values."""
PATIENCE_S = 5.0
"""Time without a picture after which a camera or a stream counts as lost, s."""
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
    device : str
        Its number, or a path such as ``/dev/video0``.
    gain : float, optional
        Gain in the driver's unit; unchanged if None.
    """

    def __init__(self, device: str, gain: float | None = None):
        self.name = f"camera {device}"
        place = int(device) if device.isdigit() else device
        self._capture = _device(place)
        if not self._capture.isOpened():
            raise InputError(
                "E-DEVICE-OPEN",
                f"{self.name}: cannot be opened; check that it is plugged in and free (`ls /dev/video*`), or "
                "--simulate with an image",
            )
        back_end = self._capture.getBackendName()
        manual = MANUAL_V4L2 if back_end == "V4L2" else MANUAL_OTHERS
        self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, manual)
        if gain is not None and not self._capture.set(cv2.CAP_PROP_GAIN, gain):
            self.close()
            raise InputError(
                "E-DEVICE-SETTING", f"{self.name}: its driver ({back_end}) takes no gain; leave --gain out"
            )

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """Return an image and its exposure, see :class:`Source`; frames during the settle time are dropped."""
        if not self._capture.set(cv2.CAP_PROP_EXPOSURE, exposure):
            raise InputError(
                "E-DEVICE-SETTING",
                f"{self.name}: its driver takes no exposure {exposure:g}; give exposures in its unit (V4L2: 100 µs), "
                "see `v4l2-ctl --list-ctrls`",
            )
        until, frame, read = time.monotonic() + settle_s, None, 0
        while frame is None or read < READINGS or time.monotonic() < until:
            received, frame = self._capture.read()
            read += 1
            if not received or frame is None:
                raise InputError(
                    "E-DEVICE-NO-IMAGE", f"{self.name}: no longer gives images; check its cable and other programs"
                )
        return _grey(frame), float(self._capture.get(cv2.CAP_PROP_EXPOSURE))

    def close(self) -> None:
        """Give the camera back."""
        self._capture.release()


class SimulatedSource:
    """A simulated camera that shows an image. It belongs to exposure 1; brightness is proportional to exposure.

    Parameters
    ----------
    image : str or Path
    gain : float, optional
        Factor on the brightness; 1 if None.
    seed : int
        Seed of the noise.
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
            raise InputError(
                "E-IMAGE-UNREADABLE", f"{self._image}: {error.strerror or error}; an image needed to simulate a camera"
            ) from error
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

    Pictures of a camera or a stream that come while one is measured are left out; of a file or a folder none is. Raises
    InputError: it cannot be opened or gives no picture, or none for ``PATIENCE_S`` in between.
    """
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
            raise InputError(
                "E-LIVE-SOURCE",
                f"{what}: cannot be opened; give a camera's number, a stream's URL, a video file or a folder of images",
            )
        first = next(pictures, None)
        if first is None:
            raise InputError("E-LIVE-SOURCE", f"{what}: opened, but gives no picture; is another program using it?")
        yield chain([first], pictures)
    finally:
        pictures.close()  # which waits until nothing reads from the device any more
        device.release()


@contextmanager
def frames_of(video: str | Path) -> Iterator[Iterator[np.ndarray]]:
    """Open a video file, and return its frames, grey."""
    device = _device(str(video))
    try:
        frames = _every(device)
        first = next(frames, None) if device.isOpened() else None
        if first is None:
            raise InputError(
                "E-VIDEO-UNREADABLE",
                f"video {video}: cannot be read as one, a folder of images or a video file needed; another program may "
                "convert it, such as `ffmpeg -i VIDEO clip.mp4`",
            )
        yield chain([first], frames)
    finally:
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
    before = os.environ.get(FFMPEG_LEVEL)
    os.environ[FFMPEG_LEVEL] = "-8"
    try:
        with quiet_opencv():
            device = cv2.VideoCapture(source)
            device.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as the sensor wrote them, which the camera file describes
            return device
    finally:
        os.environ.pop(FFMPEG_LEVEL)
        if before is not None:
            os.environ[FFMPEG_LEVEL] = before


def _grey(frame: np.ndarray) -> np.ndarray:
    return frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)


def _every(device: cv2.VideoCapture) -> Generator[np.ndarray, None, None]:
    while (read := device.read())[0]:
        yield _grey(read[1])


def _newest(device: cv2.VideoCapture, what: str) -> Generator[np.ndarray, None, None]:
    """Yield the newest picture of a camera or a stream, and leave out those that come meanwhile."""
    ready, ended = threading.Condition(), threading.Event()
    newest: list[np.ndarray] = []

    def read() -> None:
        while not ended.is_set():
            came, frame = device.read()
            if not came:
                break
            with ready:
                newest[:] = [frame]
                ready.notify()
        with ready:
            ended.set()
            ready.notify()

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        while True:
            with ready:
                if not ready.wait_for(lambda: newest or ended.is_set(), PATIENCE_S):
                    raise InputError("E-LIVE-LOST", f"{what}: no picture for {PATIENCE_S:g} s; is it still connected?")
                if not newest:
                    return
                frame = newest.pop()
            yield _grey(frame)
    finally:
        ended.set()
        thread.join()
