"""Capture of exposure series by a camera over V4L2 or UVC through OpenCV, or by a simulated camera."""

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


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a capture.

    ``gain`` : gain to set, None to leave it; ``settle_s`` : time to wait after each change of exposure, s.
    """

    gain: float | None = None
    settle_s: float = 0.3

    def __post_init__(self):
        if not 0 <= self.settle_s <= 60:
            raise InputError("E-OPTION-RANGE", f"--settle-s {self.settle_s:g}: 0 to 60 s needed")


def scene_folder(out: Path, scene: str) -> Path:
    """Returns the path of a new folder for a scene.

    Raises
    ------
    InputError
        The name is invalid, or the scene exists.
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
    """Takes an exposure series and writes ``<folder>/<exposure>.png`` and ``capture.json`` with the settings used.

    Parameters
    ----------
    source
        The camera.
    exposures
        Exposures in the unit of the camera's driver, from :func:`~stcal.locate.data.exposures.exposure_times`.
    folder
        Folder of the scene. It is created and written only after all images are taken.
    settings
        Gain and settle time.
    taken
        Called with the row of each image.

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
        image, exposure_set = source.expose(float(exposure), settings.settle_s)
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
        gain=settings.gain,
        settle_s=settings.settle_s,
        exposures=rows,
    )
    folder.mkdir(parents=True)
    for row, image in zip(rows, images, strict=True):
        save(folder / row.image, png(image))
    save(folder / CAPTURED, json_text(content.content()))
    return content
