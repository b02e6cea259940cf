"""Photographs of a run as the page shows them: what was found in each, and residual vectors over it."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stcal.report.figure import round_below
from stcal.report.text import number

FIRST_IMAGES = 100
"""Rows and overlays that the page has room for."""
LONGEST = 0.04
"""A vector of this share of the image's width is what nineteen of twenty residuals do not exceed."""
Residuals = np.ndarray
"""(n, 4): a circle's centre and its residual, x, y and x, y, px."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """``says`` : what was found in it; ``jpeg`` : as a data URI; ``vectors`` : path of an SVG in px of the image."""

    name: str
    says: str
    jpeg: str
    vectors: str


@dataclass(frozen=True, slots=True)
class Photographs:
    """``box`` : the images' place in px, pixel centres integer; ``aspect`` : width by height; ``factor`` : by which all
    vectors are lengthened, 0 without any; ``stroke`` : width of their lines, px; ``bar`` : path of a bar, as long as a
    residual of ``bar_px`` is drawn."""

    each: tuple[Photograph, ...]
    box: str
    aspect: float
    factor: float
    stroke: float
    bar: str
    bar_px: float


def photographs(report: dict, overlays: dict[str, bytes], residuals: Mapping[str, Residuals]) -> Photographs:
    """All photographs that the page shows, with vectors on one scale.

    Parameters
    ----------
    report : content of ``report.json``
    overlays : JPEG by image name
    residuals : by image name
    """
    width, height = report["camera"]["size_px"]
    mapped = {row["image"]: row for row in report["residuals_by_image"]}
    lengths = np.concatenate([np.zeros(0), *(np.hypot(*own[:, 2:].T) for own in residuals.values())])
    usual = float(np.quantile(lengths, 0.95)) if len(lengths) else 0.0
    factor = round_below(LONGEST * width / usual) if usual > 0 else 0.0
    bar_px = round_below(LONGEST * width / factor) if factor else 0.0
    each = []
    for name, jpeg in overlays.items():
        own = mapped.get(name)
        says = f"{own['observations']} centres, {number(own['rms_px'], 4)} px RMS" if own else "not mapped"
        uri = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
        each.append(Photograph(name, says, uri, _path(residuals.get(name, np.zeros((0, 4))), factor)))
    box = f"-0.5 -0.5 {width} {height}"
    bar = f"M{0.98 * width:.1f} {0.97 * height:.1f}h{-factor * bar_px:.1f}"
    return Photographs(tuple(each), box, round(width / height, 5), factor, round(width / 450, 2), bar, bar_px)


def _path(residuals: Residuals, factor: float) -> str:
    """From each centre along its residual."""
    return "".join(f"M{x:.1f} {y:.1f}l{factor * dx:.1f} {factor * dy:.1f}" for x, y, dx, dy in residuals.tolist())


def shown_overlays(report: dict) -> list[str]:
    """Names of the images whose overlays the page shows: all, or of a large set those that most deserve a look."""
    names = [image["name"] for image in report["images"]]
    if len(names) <= FIRST_IMAGES:
        return names
    worst = {row["image"]: row["max_px"] for row in report["residuals_by_image"]}
    told = {each["image"] for each in report["left_out"]["notes"]}
    ranked = sorted(names, key=lambda name: (name in worst, name not in told, -worst.get(name, 0.0)))
    chosen = set(ranked[:FIRST_IMAGES])
    return [name for name in names if name in chosen]
