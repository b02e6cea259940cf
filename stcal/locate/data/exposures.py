"""Scenes (one target in one place, photographed at several exposures), and the tags that each exposure shows."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.boards.tags import Tags, find_tags
from stcal.errors import InputError
from stcal.io.files import IMAGE_BYTES, read_bytes
from stcal.io.images import SUFFIXES, TOP_GROUP, ImageFile, decode, find_images, grey_8bit
from stcal.io.saving import real_place
from stcal.locate.data.layout import TargetLayout


@dataclass(frozen=True, slots=True)
class SceneFiles:
    """The exposures of one scene, not yet read.

    Parameters
    ----------
    name : str
        Name of the scene.
    files : tuple of ImageFile
        Files of the exposures.
    skipped : tuple of str
        Files beside them that are not exposures, with reasons.
    """

    name: str
    files: tuple[ImageFile, ...]
    skipped: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One readable image: the ``tags`` that it shows, and its ``size`` (width and height, px)."""

    name: str
    tags: Tags
    size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Unreadable:
    """An image that cannot be read; ``trouble`` says why."""

    name: str
    trouble: str


@dataclass(frozen=True, slots=True, eq=False)
class SceneTags:
    """The exposures of one scene."""

    name: str
    exposures: tuple[Exposure | Unreadable, ...]

    def readable(self) -> list[Exposure]:
        """Returns the exposures whose image could be read."""
        return [exposure for exposure in self.exposures if isinstance(exposure, Exposure)]

    def unreadable(self) -> list[Unreadable]:
        """Returns the exposures whose image could not be read."""
        return [exposure for exposure in self.exposures if isinstance(exposure, Unreadable)]


CAPTURED = "capture.json"
"""Name of the file that ``capture`` writes beside the images of a scene."""


def exposure_times(shortest: float, longest: float, count: int) -> np.ndarray:
    """Returns ``count`` exposure times from ``shortest`` to ``longest`` in a geometric series, in their unit.

    Raises
    ------
    InputError
        Times are not positive or not in order, or ``count`` does not fit them.
    """
    if not (0 < shortest <= longest < np.inf) or count < 1 or (count == 1 and shortest < longest):
        raise InputError(
            "E-EXPOSURES-VALUE",
            f"exposures: {count} from {shortest:g} to {longest:g}; two or more, from a positive shortest time to a "
            "longest that is not shorter, needed",
        )
    return np.geomspace(shortest, longest, count)


def find_scenes(path: str | Path) -> list[SceneFiles]:
    """Finds the scenes in a folder.

    Parameters
    ----------
    path : str or Path
        One image; a folder of exposures; or a folder of such folders, each a scene.

    Returns
    -------
    list of SceneFiles

    Raises
    ------
    InputError
        The path does not exist, or holds no image.
    """
    path = Path(path)
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(
                "E-IMAGE-UNREADABLE", f"exposures {path}: not an image; a folder or one of {', '.join(SUFFIXES)} needed"
            )
        return [SceneFiles(path.stem, (ImageFile(path, path.name, TOP_GROUP),))]
    files, skipped = find_images(path)
    scenes = []
    for group in dict.fromkeys(file.group for file in files):
        skipped_in_group = [s for s in skipped if (Path(s.name).parent.name or TOP_GROUP) == group]
        left_out = tuple(f"{s.name}: {s.reason}" for s in skipped_in_group if Path(s.name).name != CAPTURED)
        name = real_place(path).name if group == TOP_GROUP else group
        scenes.append(SceneFiles(name, tuple(f for f in files if f.group == group), left_out))
    return scenes


def read_scenes(scenes: Sequence[SceneFiles], layout: TargetLayout, workers: int | None = None) -> Iterator[SceneTags]:
    """Yields the tags of each scene. Each image is decoded once, while other threads search earlier images for tags."""
    dictionaries = layout.dictionaries()
    with ThreadPoolExecutor(workers) as pool:
        for scene in scenes:
            # Decoding stays in this thread, because it captures what the decoders write to standard error.
            pending = [_begin(file, dictionaries, pool) for file in scene.files]
            yield SceneTags(scene.name, tuple(finish() for finish in pending))


def detect(image: np.ndarray, name: str, dictionaries: Sequence[str]) -> Exposure:
    """Finds the tags of a decoded image."""
    return Exposure(name, find_tags(image, dictionaries), (image.shape[1], image.shape[0]))


def _begin(
    file: ImageFile, dictionaries: Sequence[str], pool: ThreadPoolExecutor
) -> Callable[[], Exposure | Unreadable]:
    """Starts the search for tags, and returns a function that waits for its result."""
    try:
        image = grey_8bit(decode(read_bytes(file.path, IMAGE_BYTES), file.name))
    except (InputError, OSError) as error:
        trouble = Unreadable(file.name, " ".join(str(error).split()))
        return lambda: trouble
    return pool.submit(detect, image, file.name, dictionaries).result
