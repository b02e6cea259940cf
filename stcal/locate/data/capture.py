"""Exposure series by hardware: a camera over V4L2 or UVC through OpenCV, or a simulated one."""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from pydantic import Field

import stcal
from stcal.errors import InputError
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import decode, grey_8bit
from stcal.io.json import Part, ResultFile
from stcal.io.saving import json_text, save
from stcal.locate.data.exposures import CAPTURED

MANUAL_V4L2, MANUAL_OTHERS = 1.0, 0.25
"""What OpenCV's AUTO_EXPOSURE means by manual: V4L2's menu, and the convention of the other back ends."""
SATURATED = 250
DARK = 5
FULL_SCALE = 255
SIMULATED_NOISE = 1.0
"""σ of a pixel of the simulated camera, grey values."""
READINGS = 3
"""Frames that a driver may still have in its queue when it is told another exposure."""


class Source(Protocol):
    """What takes images."""

    name: str

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """A grey image (h, w) at an exposure, in the driver's unit, and the exposure that was really set."""
        ...

    def close(self) -> None:
        """Give the camera back."""
        ...


class OpenCVSource:
    """A camera of this machine, exposure by hand.

    Raises
    ------
    InputError
        No such camera, or one that takes no gain.
    """

    def __init__(self, device: str, gain: float | None = None):
        self.name = f"camera {device}"
        place = int(device) if device.isdigit() else device
        self._capture = cv2.VideoCapture(place)
        if not self._capture.isOpened():
            raise InputError(
                f"{self.name}: cannot be opened; check that it is plugged in and free (`ls /dev/video*`), or "
                "--simulate with an image"
            )
        back_end = self._capture.getBackendName()
        manual = MANUAL_V4L2 if back_end == "V4L2" else MANUAL_OTHERS
        self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, manual)
        if gain is not None and not self._capture.set(cv2.CAP_PROP_GAIN, gain):
            self.close()
            raise InputError(f"{self.name}: its driver ({back_end}) takes no gain; leave --gain out")

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """As of :class:`Source`; frames are passed over until the settle time is over."""
        if not self._capture.set(cv2.CAP_PROP_EXPOSURE, exposure):
            raise InputError(
                f"{self.name}: its driver takes no exposure {exposure:g}; give --shortest and --longest in its unit "
                "(V4L2: 100 µs), see `v4l2-ctl --list-ctrls`"
            )
        until, frame = time.monotonic() + settle_s, None
        read = 0
        while read < READINGS or time.monotonic() < until:
            there, frame = self._capture.read()
            read += 1
            if not there or frame is None:
                raise InputError(f"{self.name}: gives no image any more; check its cable and other programs")
        if frame is None:
            raise InputError(f"{self.name}: gives no image; check it")
        grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        return grey, float(self._capture.get(cv2.CAP_PROP_EXPOSURE))

    def close(self) -> None:
        """Give the camera back."""
        self._capture.release()


class SimulatedSource:
    """A camera that sees one image for ever, which was taken at exposure 1: others are that many times as bright.

    Raises
    ------
    InputError
        The image cannot be read.
    """

    def __init__(self, image: str | Path, gain: float | None = None, seed: int = 0):
        self.name = f"simulated camera before {Path(image).name}"
        try:
            content = read_bytes(Path(image), IMAGE_BYTES)
        except OSError as error:
            raise InputError(f"{image}: {error.strerror or error}; an image needed to simulate a camera") from error
        self._scene = grey_8bit(decode(content, str(image))).astype(float) * (1.0 if gain is None else gain)
        self._rng = np.random.default_rng(seed)

    def expose(self, exposure: float, settle_s: float) -> tuple[np.ndarray, float]:
        """As of :class:`Source`; there is nothing to settle."""
        seen = exposure * self._scene + self._rng.normal(0, SIMULATED_NOISE, self._scene.shape)
        return np.clip(np.round(seen), 0, FULL_SCALE).astype(np.uint8), exposure

    def close(self) -> None:
        """Nothing to give back."""


class CapturedRow(Part):
    image: str
    exposure: float
    exposure_set: float
    saturated_share: float
    dark_share: float


class CaptureFile(ResultFile):
    """``capture.json`` of a scene: what was asked for, and what was set."""

    format: Literal["stcal capture 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    camera: str = Field(description="what took the images")
    gain: float | None = Field(description="asked for; null: as it was")
    settle_s: float = Field(description="waited after each change of exposure, s")
    exposures: list[CapturedRow] = Field(
        description="`image`, `exposure` asked for and `exposure_set` by the driver, in its unit; `saturated_share` "
        "and `dark_share` of the pixels"
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """``gain`` : as asked for; ``settle_s`` : after each change of exposure."""

    gain: float | None = None
    settle_s: float = 0.3

    def __post_init__(self):
        if not 0 <= self.settle_s <= 60:
            raise InputError(f"--settle-s {self.settle_s:g}: 0 to 60 s needed")


def scene_folder(out: Path, scene: str) -> Path:
    """The new folder of a scene.

    Raises
    ------
    InputError
        A name that is none, or a scene that is there.
    """
    if not re.fullmatch(r"[\w][\w .-]{0,99}", scene):
        raise InputError(f"scene {scene!r}: letters, digits, spaces, '.', '-' and '_' needed, up to 100")
    folder = out / scene
    if folder.exists():
        raise InputError(f"{folder}: exists; give another --scene")
    return folder


def capture(
    source: Source,
    exposures: Sequence[float],
    folder: Path,
    settings: Settings,
    taken: Callable[[CapturedRow], None] | None = None,
) -> CaptureFile:
    """Take an exposure series: ``<folder>/<exposure>.png`` and ``capture.json`` with what was really set.

    Parameters
    ----------
    source
        The camera.
    exposures
        In its driver's unit, from :func:`~stcal.locate.data.exposures.exposure_times`.
    folder
        Of the scene; made, and written only when all images are taken.
    settings
        Gain and settle time.
    taken
        Called with each image's row.

    Returns
    -------
    CaptureFile

    Raises
    ------
    InputError
        The camera refuses an exposure, or gives no image.
    """
    rows, images = [], []
    for exposure in exposures:
        image, really = source.expose(float(exposure), settings.settle_s)
        row = CapturedRow(
            image=f"{exposure:.6g}.png",
            exposure=float(exposure),
            exposure_set=really,
            saturated_share=float((image >= SATURATED).mean()),
            dark_share=float((image <= DARK).mean()),
        )
        if any(each.image == row.image for each in rows):
            raise InputError(f"exposure {exposure:.6g} comes twice; take fewer --count, or a wider range")
        rows.append(row)
        images.append(image)
        if taken:
            taken(row)
    content = CaptureFile(
        format="stcal capture 1",
        version=stcal.__version__,
        camera=source.name,
        gain=settings.gain,
        settle_s=settings.settle_s,
        exposures=rows,
    )
    folder.mkdir(parents=True)
    for row, image in zip(rows, images, strict=True):
        save(folder / row.image, cv2.imencode(".png", image)[1].tobytes())
    save(folder / CAPTURED, json_text(content.content()))
    return content
