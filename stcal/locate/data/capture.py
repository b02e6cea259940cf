"""Exposure series by hardware: a camera over V4L2 or UVC through OpenCV, or a simulated one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

import stcal
from stcal.errors import InputError
from stcal.io.device import DARK, SATURATED, Source, checked_name, png
from stcal.io.json import Part, ResultFile
from stcal.io.saving import json_text, save
from stcal.locate.data.exposures import CAPTURED


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
            raise InputError("E-OPTION-RANGE", f"--settle-s {self.settle_s:g}: 0 to 60 s needed")


def scene_folder(out: Path, scene: str) -> Path:
    """The new folder of a scene.

    Raises
    ------
    InputError
        A name that is none, or a scene that is there.
    """
    folder = out / checked_name(scene, "scene")
    if folder.exists():
        raise InputError("E-OUTPUT-EXISTS", f"{folder}: exists; give another --scene")
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
        gain=settings.gain,
        settle_s=settings.settle_s,
        exposures=rows,
    )
    folder.mkdir(parents=True)
    for row, image in zip(rows, images, strict=True):
        save(folder / row.image, png(image))
    save(folder / CAPTURED, json_text(content.content()))
    return content
