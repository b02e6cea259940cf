"""Exposure series: schedules of times, capture, and selection of the usable images."""

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

import stcal
from stcal.boards.tags import Tags, find_tags
from stcal.errors import InputError
from stcal.geometry.arrays import Brief, require_arguments, require_fields
from stcal.io.device import DARK, SATURATED, Source, png
from stcal.io.files import json_text, real_place, save
from stcal.io.images import SUFFIXES, TOP_GROUP, USUAL, ImageFile, decode, find_images, grey_8bit, image_file
from stcal.io.json import Part, ResultFile, require_result_written
from stcal.locate.layout import TargetLayout


@dataclass(frozen=True, slots=True, repr=False)
class SceneFiles(Brief):
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

    def __post_init__(self):
        require_fields(self, "scene")


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One readable image: the ``tags`` that it shows, and its ``size`` (width and height, px)."""

    name: str
    tags: Tags
    size: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class SceneTags:
    """The readable exposures of one scene; ``unreadable`` : why others could not be read."""

    name: str
    exposures: tuple[Exposure, ...]
    unreadable: tuple[str, ...] = ()


CAPTURED = "capture.json"
"""Name of the file that ``capture`` writes beside the images of a scene."""


@require_arguments
def exposure_times(shortest: float, longest: float, count: int) -> np.ndarray:
    """Returns exposure times in a geometric series.

    Parameters
    ----------
    shortest, longest : float
        First and last exposure time, in any unit.
    count : int
        Number of exposure times.

    Returns
    -------
    (count,) array
        In the unit of the arguments.

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


@require_arguments
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
                "E-IMAGE-UNREADABLE", f"exposures {path}: not an image; a folder or one of {', '.join(USUAL)} needed"
            )
        return [SceneFiles(path.stem, (image_file(path),))]
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
            pending, unreadable = [], []
            for file in scene.files:
                # Decoding stays in this thread, because it captures what the decoders write to standard error.
                try:
                    image = grey_8bit(decode(file.read(), file.name))
                except (InputError, OSError) as error:
                    unreadable.append(" ".join(str(error).split()))
                else:
                    pending.append(pool.submit(detect, image, file.name, dictionaries))
            yield SceneTags(scene.name, tuple(each.result() for each in pending), tuple(unreadable))


def detect(image: np.ndarray, name: str, dictionaries: Sequence[str]) -> Exposure:
    """Finds the tags of a decoded image."""
    return Exposure(name, find_tags(image, dictionaries), (image.shape[1], image.shape[0]))


class CapturedRow(Part):
    image: str
    exposure: float
    exposure_set: float
    saturated_share: float
    dark_share: float


class CaptureFile(ResultFile):
    """Content of ``capture.json`` of a scene: the settings asked for, and those really set."""

    format: Literal["stcal capture 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    camera: str = Field(description="what took the images")
    gain: float | None = Field(description="asked for; null: as it was")
    settle_s: float = Field(description="waited after each change of exposure, s")
    exposures: list[CapturedRow] = Field(
        description="`image`, `exposure` asked for and `exposure_set` by the driver, in its unit; `saturated_share` "
        "and `dark_share` of the pixels"
    )


def scene_folder(out: Path, scene: str) -> Path:
    """Returns a scene's new folder; raises InputError: the name is invalid, or the scene exists."""
    if not re.fullmatch(r"[\w][\w .-]{0,99}", scene):
        raise InputError(
            "E-DEVICE-NAME", f"scene {scene!r}: letters, digits, spaces, '.', '-' and '_' needed, up to 100"
        )
    folder = out / scene
    if folder.exists():
        raise InputError("E-OUTPUT-EXISTS", f"{folder}: exists; give another --scene")
    return folder


@require_arguments
def capture(
    source: Source,
    exposures: Sequence[float],
    folder: str | Path,
    gain: float | None = None,
    settle_s: float = 0.3,
    taken: Callable[[CapturedRow], None] | None = None,
) -> CaptureFile:
    """Takes an exposure series and writes ``<folder>/<exposure>.png`` and ``capture.json`` with the settings used.

    Parameters
    ----------
    source : OpenCVSource or SimulatedSource
        The camera; or anything else with a ``name`` and their methods.
    exposures : sequence of float
        Exposures in the unit of the camera's driver, as of :func:`stcal.locate.exposure_times`.
    folder : str or Path
        New folder of the scene. It is written only after all images are taken.
    gain : float, optional
        Gain that ``source`` was told, for ``capture.json``.
    settle_s : float
        Time that the camera is given after each change of exposure, s.
    taken : callable, optional
        Called with the row of each image.

    Returns
    -------
    CaptureFile
        The exposures asked for and those set, and shares of saturated and dark pixels.

    Raises
    ------
    InputError
        The camera refuses an exposure or gives no image, an exposure comes twice, or the folder exists.
    """
    folder = Path(folder)
    if not 0 <= settle_s <= 60:
        raise InputError("E-OPTION-RANGE", f"--settle-s {settle_s:g}: 0 to 60 s needed")
    if folder.exists():
        raise InputError("E-OUTPUT-EXISTS", f"{folder}: exists; give another --scene")
    rows, images = [], []
    for exposure in exposures:
        image, exposure_set = source.expose(float(exposure), settle_s)
        row = CapturedRow(
            image=f"{exposure:.6g}.png",
            exposure=float(exposure),
            exposure_set=exposure_set,
            saturated_share=float((image >= SATURATED).mean()),
            dark_share=float((image <= DARK).mean()),
        )
        if any(each.image == row.image for each in rows):
            raise InputError(
                "E-EXPOSURES-VALUE", f"exposure {exposure:.6g} comes twice; take fewer --count, or a wider range"
            )
        rows.append(row)
        images.append(image)
        if taken:
            taken(row)
    content = CaptureFile(
        format="stcal capture 1",
        version=stcal.__version__,
        camera=source.name,
        gain=gain,
        settle_s=settle_s,
        exposures=rows,
    )
    folder.mkdir(parents=True)
    for row, image in zip(rows, images, strict=True):
        save(folder / row.image, png(image))
    save(folder / CAPTURED, json_text(content.content()))
    require_result_written(folder / CAPTURED, content)
    return content
