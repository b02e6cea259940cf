"""Photographs of a run as the page shows them, with detections and residual vectors."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stcal.report.figure import round_below
from stcal.report.text import number

FIRST_IMAGES = 100
"""Number of rows and overlays that the page has room for."""
LONGEST = 0.04
"""Length of the vector that nineteen of twenty residuals do not exceed, as a share of the image's width."""
Residuals = np.ndarray
"""Array (n, 4) of circles: centre x, y and residual x, y, px."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """One photograph.

    ``says`` : what was found in it; ``jpeg`` : as a data URI; ``vectors`` : path of an SVG in px of the image.
    """

    name: str
    says: str
    jpeg: str
    vectors: str


@dataclass(frozen=True, slots=True)
class Photographs:
    """All photographs that the page shows, with the common scale of their vectors.

    ``box`` : the images' place in px, pixel centres integer; ``aspect`` : width by height; ``factor`` : by which all
    vectors are lengthened, 0 if there are none; ``stroke`` : width of their lines, px; ``bar`` : path of a bar, as long
    as the vector of a residual of ``bar_px``.
    """

    each: tuple[Photograph, ...]
    box: str
    aspect: float
    factor: float
    stroke: float
    bar: str
    bar_px: float


def photographs(report: dict, overlays: dict[str, bytes], residuals: Mapping[str, Residuals]) -> Photographs:
    """Returns all photographs that the page shows, with vectors on one scale.

    Parameters
    ----------
    report : content of ``report.json``
    overlays : JPEG by image name
    residuals : by image name
    """
    width, height = report["camera"]["size_px"]
    mapped = {row["image"]: row for row in report["residuals_by_image"]}
    lengths = np.concatenate([np.zeros(0), *(np.hypot(*entry[:, 2:].T) for entry in residuals.values())])
    usual = float(np.quantile(lengths, 0.95)) if len(lengths) else 0.0
    factor = round_below(LONGEST * width / usual) if usual > 0 else 0.0
    bar_px = round_below(LONGEST * width / factor) if factor else 0.0
    shown = []
    for name, jpeg in overlays.items():
        entry = mapped.get(name)
        says = f"{entry['observations']} centres, {number(entry['rms_px'], 4)} px RMS" if entry else "not mapped"
        uri = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
        shown.append(Photograph(name, says, uri, _path(residuals.get(name, np.zeros((0, 4))), factor)))
    box = f"-0.5 -0.5 {width} {height}"
    bar = f"M{0.98 * width:.1f} {0.97 * height:.1f}h{-factor * bar_px:.1f}"
    return Photographs(tuple(shown), box, round(width / height, 5), factor, round(width / 450, 2), bar, bar_px)


def _path(residuals: Residuals, factor: float) -> str:
    """Returns a path of lines from each centre along its residual."""
    return "".join(f"M{x:.1f} {y:.1f}l{factor * dx:.1f} {factor * dy:.1f}" for x, y, dx, dy in residuals.tolist())


def shown_overlays(report: dict) -> list[str]:
    """Returns the names of the images whose overlays the page shows.

    These are all images, or in a large set those that most deserve a look.
    """
    names = [image["name"] for image in report["images"]]
    if len(names) <= FIRST_IMAGES:
        return names
    worst = {row["image"]: row["max_px"] for row in report["residuals_by_image"]}
    noted = {note["image"] for note in report["left_out"]["notes"]}
    ranked = sorted(names, key=lambda name: (name in worst, name not in noted, -worst.get(name, 0.0)))
    chosen = set(ranked[:FIRST_IMAGES])
    return [name for name in names if name in chosen]
