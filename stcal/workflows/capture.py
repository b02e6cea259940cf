"""A calibration that takes its photographs itself: after each, what was found in it, how sharp, and σ so far."""

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from stcal.io.device import SATURATED, Source, checked_name, png
from stcal.io.saving import save
from stcal.parallel import Progress
from stcal.workflows.watch import Growing, Update

FIRST = 1
NUMBERED = re.compile(r"IMG_(\d{4,})\.png")


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A photograph.

    ``name`` : as the run has it; ``exposure`` : that was really set, in the driver's unit; ``update`` : the calibration
    so far; ``circles`` : named ones in it, ``saturated`` : those of them whose middle is; ``saturated_share`` : of all
    pixels.
    """

    name: str
    exposure: float
    update: Update
    circles: int
    saturated: int
    saturated_share: float

    def light(self) -> str:
        """Exposure and saturation, in words."""
        said = f"exposure {self.exposure:g}, {100 * self.saturated_share:.1f} % of the pixels saturated"
        if self.circles:
            said += f", {self.saturated} of {self.circles} circles"
        if self.circles and self.saturated > self.circles / 2:
            said += ": expose less, saturated circles grow and their centres move"
        return said


class Trigger:
    """When a photograph is taken: at each Enter, or each so many seconds.

    Parameters
    ----------
    count : int, optional
        Ends after so many.
    every_s : float, optional
        At each line of ``keys`` where None.
    keys : text stream
        Its end ends it.
    say : callable
        Called with what the user is asked for.
    """

    def __init__(self, count: int | None, every_s: float | None, keys: TextIO, say: Callable[[str], object]):
        self._left = math.inf if count is None else count
        self._every_s, self._keys, self._say = every_s, keys, say
        self._last: float | None = None

    def ready(self, number: int) -> bool:
        """Waits for photograph ``number``; False where there will be none."""
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


def photograph(
    source: Source,
    growing: Growing,
    group: str,
    exposure: float | None,
    settle_s: float,
    ready: Callable[[int], bool],
    progress: Progress | None = None,
) -> Iterator[Taken]:
    """Take photographs of a group, ``IMAGES/<group>/IMG_0001.png`` …, and run after each over all that are there.

    Parameters
    ----------
    source : Source
        The camera.
    growing : Growing
        The calibration.
    group : str
        Between its photographs only the camera moves; its folder may hold earlier ones, which stay.
    exposure : float, optional
        In the driver's unit; as it is where None.
    settle_s : float
        Given to the camera before each photograph, s.
    ready : callable
        Waits for the photograph of this number in the group; ends where False.
    progress : callable, optional
        Called with (stage, done, total).

    Yields
    ------
    Taken

    Raises
    ------
    InputError
        The name is no folder's, the camera gives no image, or something that is given is not what it is given for.
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
        inside = [_middle(image, each.observations.centre_px) for each in update.new]
        grey = np.concatenate(inside) if inside else np.zeros(0)
        saturated = int((grey >= SATURATED).sum())
        yield Taken(name, really, update, len(grey), saturated, float((image >= SATURATED).mean()))
        number += 1


def _next(folder: Path) -> int:
    there = folder.iterdir() if folder.is_dir() else ()
    numbers = [int(found[1]) for path in there if (found := NUMBERED.fullmatch(path.name))]
    return max(numbers, default=FIRST - 1) + 1


def _middle(image: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """(n,) grey values at circles' centres (n, 2), px."""
    column, row = np.clip(np.rint(centre_px).astype(int), 0, np.array(image.shape)[::-1] - 1).T
    return image[row, column]
