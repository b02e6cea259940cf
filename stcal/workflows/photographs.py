"""Calibration that takes its photographs itself and reports the circles, sharpness and σ after each."""

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from stcal.geometry.arrays import require_arguments
from stcal.io.device import SATURATED, Source, checked_name, png
from stcal.io.files import save
from stcal.parallel import Progress
from stcal.workflows.growing import GrowingRun, Update

FIRST = 1
NUMBERED = re.compile(r"IMG_(\d{4,})\.png")


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A photograph.

    ``name`` : as in the run; ``exposure`` : the one that was actually set, in the driver's unit; ``update`` : the
    calibration so far; ``circles`` : number of named circles in it; ``saturated`` : number of these whose middle is
    saturated; ``saturated_share`` : share of saturated pixels.
    """

    name: str
    exposure: float
    update: Update
    circles: int
    saturated: int
    saturated_share: float

    def light(self) -> str:
        """Returns exposure and saturation in words."""
        message = f"exposure {self.exposure:g}, {100 * self.saturated_share:.1f} % of the pixels saturated"
        if self.circles:
            message += f", {self.saturated} of {self.circles} circles"
        if self.circles and self.saturated > self.circles / 2:
            message += ": expose less, saturated circles grow and their centres move"
        return message


class Trigger:
    """Trigger of photographs: at each Enter, or at fixed intervals.

    ``count`` : number of photographs after which it ends; ``every_s`` : interval; if None, a photograph is taken at
    each line of ``keys``; ``keys`` : the trigger ends with this stream; ``say`` : called with the text that prompts the
    user.
    """

    def __init__(self, count: int | None, every_s: float | None, keys: TextIO, say: Callable[[str], object]):
        self._left = math.inf if count is None else count
        self._every_s, self._keys, self._say = every_s, keys, say
        self._last: float | None = None

    def ready(self, number: int) -> bool:
        """Waits for photograph ``number``. Returns False if there will be none."""
        if self._left < 1:
            return False
        self._left -= 1
        if self._every_s is None:
            self._say(f"Enter: take photograph {number} (Ctrl-D: end)")
            return bool(self._keys.readline())
        if self._last is not None:
            time.sleep(max(0.0, self._last + self._every_s - time.monotonic()))
        self._last = time.monotonic()
        return True


@require_arguments
def capture(
    source: Source,
    growing: GrowingRun,
    group: str,
    ready: Callable[[int], bool],
    exposure: float | None = None,
    settle_s: float = 0.3,
    progress: Progress | None = None,
) -> Iterator[Taken]:
    """Takes photographs of a group, ``IMAGES/<group>/IMG_0001.png`` …, and after each run over all photographs so far.

    Parameters
    ----------
    source : OpenCVSource or SimulatedSource
        The camera; or anything else with a ``name`` and their methods.
    growing : GrowingRun
        The run, with the folder that the photographs are written to.
    group : str
        Name of the group, in which only the camera moves. Its folder may hold earlier photographs, which stay.
    ready : callable
        Waits for the photograph of this number in the group; returns False at the end.
    exposure : float, optional
        Exposure in the driver's unit; unchanged if None.
    settle_s : float
        Time that the camera is given before each photograph, s.
    progress : callable, optional
        Called with (stage, done, total).

    Yields
    ------
    Taken
        The photograph, with the state of the run.

    Raises
    ------
    InputError
        The name cannot be a folder's, the camera gives no image, or an input is not of the kind that is expected.
    """
    folder = growing.images / checked_name(group, "group")
    number = _next(folder)
    while ready(number):
        image, really = source.expose(exposure, settle_s)
        name = f"{group}/IMG_{number:04d}.png"
        folder.mkdir(parents=True, exist_ok=True)
        save(growing.images / name, png(image))
        images = sum(1 for path in growing.images.glob("*/*") if path.is_file())
        update = growing.update(images, {name}, (), progress)
        inside = [_middle(image, labelled.observations.centre_px) for labelled in update.new]
        grey = np.concatenate(inside) if inside else np.zeros(0)
        saturated = int((grey >= SATURATED).sum())
        yield Taken(name, really, update, len(grey), saturated, float((image >= SATURATED).mean()))
        number += 1


def _next(folder: Path) -> int:
    paths = folder.iterdir() if folder.is_dir() else ()
    numbers = [int(match[1]) for path in paths if (match := NUMBERED.fullmatch(path.name))]
    return max(numbers, default=FIRST - 1) + 1


def _middle(image: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Returns the grey values (n,) at circles' centres (n, 2), px."""
    column, row = np.clip(np.rint(centre_px).astype(int), 0, np.array(image.shape)[::-1] - 1).T
    return image[row, column]
