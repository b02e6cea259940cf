"""The page of ``measure``: where the target was, how well that is known, and what was left out."""

import numpy as np

from stcal.report.figure import (
    COLOURS,
    FAINT,
    INK,
    SMALL,
    calm,
    locator,
    new_figure,
    plane,
    round_below,
    uri,
)
from stcal.report.page import render
from stcal.report.text import number
from stcal.sfm.measurement.images import MeasuredImage, MeasureResult
from stcal.sfm.measurement.output import summary
from stcal.sfm.measurement.pose import fit_verdict

COLOUR_OF = {"certain": COLOURS[0], "resolved": COLOURS[2], "ambiguous": COLOURS[1]}
MOST_ROWS = 500
"""Rows of a table on a page; more are in the CSV file."""
ELLIPSE_SHARE = 0.06
"""Of the plot's width: how long the largest σ is drawn."""


def measure_page(result: MeasureResult, where: str) -> str:
    """The report of ``measure``."""
    at = np.array([each.pose.camera_from_target.translation for each in result.images])
    largest = np.sqrt(max(np.linalg.eigvalsh(each.pose.covariance[3:, 3:])[-1] for each in result.images))
    times = round_below(ELLIPSE_SHARE * max(float(np.ptp(at, axis=0).max()), 1.0) / largest)
    verdicts = any(fit_verdict(each.pose) != "passed" for each in result.images)
    found = {each.pose.status for each in result.images}
    return render(
        "sfm/measurement/page.html.jinja",
        where=where,
        lines=summary(result),
        times=times,
        statuses={status: colour for status, colour in COLOUR_OF.items() if status in found},
        views=[
            (_view(result, at, 0, 1, times), "as the camera sees it"),
            (_view(result, at, 0, 2, times), "from above, the camera below"),
        ],
        sigma=_sigma(result),
        verdicts=verdicts,
        rows=[_row(each, verdicts) for each in result.images[:MOST_ROWS]],
        count=len(result.images),
        left_out=[(each.name, each.reason) for each in result.left_out],
        outliers=[
            [each.name, o.label, number(o.residual_px, 3), number(o.limit_px, 3)]
            for each in result.images
            for o in each.pose.outliers
        ],
    )


def _view(result: MeasureResult, at: np.ndarray, i: int, j: int, times: float) -> str:
    """Plot of two coordinates of the path, with the ellipses of σ enlarged."""
    from matplotlib.patches import Ellipse

    figure = new_figure(5, 4.4)
    axes = figure.add_axes((0.15, 0.12, 0.83, 0.86))
    for rows in _folders(result.images):
        axes.plot(at[rows, i], at[rows, j], "-", lw=0.7, color="#9aa0a8", zorder=1)
    for each, place in zip(result.images, at, strict=True):
        values, directions = np.linalg.eigh(each.pose.covariance[np.ix_([3 + i, 3 + j], [3 + i, 3 + j])])
        width, height = 2 * times * np.sqrt(values)
        angle = float(np.degrees(np.arctan2(directions[1, 0], directions[0, 0])))
        colour = COLOUR_OF[each.pose.status]
        axes.add_patch(Ellipse(place[[i, j]], width, height, angle=angle, fc=colour, ec=colour, alpha=0.3, lw=0.6))
        axes.plot(place[i], place[j], "o", ms=3.2, color=colour, mew=0)
    plane(axes, f"{'xyz'[i]}, mm", f"{'xyz'[j]}, mm", 0.12)
    if j == 1:
        axes.invert_yaxis()  # y of a camera points down
    return uri(figure)


def _folders(images: tuple[MeasuredImage, ...]) -> list[list[int]]:
    """Rows of each folder, by name."""
    folders: dict[str, list[int]] = {}
    for row in sorted(range(len(images)), key=lambda i: images[i].name):
        folders.setdefault(images[row].name.rpartition("/")[0], []).append(row)
    return list(folders.values())


def _sigma(result: MeasureResult) -> str:
    """σ along and across the line of sight, and of the rotation, image by image."""
    figure = new_figure(9, 3)
    place = figure.add_axes((0.07, 0.17, 0.41, 0.74))
    turn = figure.add_axes((0.57, 0.17, 0.41, 0.74))
    along, across, rotation = (1e3 * np.array(values) for values in zip(*map(_split, result.images), strict=True))
    rows = np.arange(1, len(result.images) + 1)
    size = 4 if len(rows) <= 200 else 1.5
    colours = [COLOUR_OF[each.pose.status] for each in result.images]
    place.scatter(rows, along, s=size**2, c=colours, lw=0)
    place.scatter(rows, across, s=size**2, c="none", edgecolors=colours, lw=0.8)
    turn.scatter(rows, np.degrees(rotation), s=size**2, c=colours, lw=0)
    for axes, label in ((place, "σ position, µm"), (turn, "σ rotation, mdeg")):
        axes.set_ylim(0, None)
        axes.yaxis.set_major_locator(locator())
        axes.set_xlim(0.4, len(rows) + 0.6)
        axes.set_xlabel("image, in order of the table", fontsize=SMALL + 1, color=INK)
        axes.set_ylabel(label, fontsize=SMALL + 1, color=INK)
        axes.xaxis.set_major_locator(locator())
        calm(axes)
        axes.grid(axis="y", color=FAINT, lw=0.6)
        axes.set_axisbelow(True)
    return uri(figure)


def _split(each: MeasuredImage) -> tuple[float, float, float]:
    """σ along the line of sight and across it (mm), and of the rotation (rad)."""
    covariance, place = each.pose.covariance, each.pose.camera_from_target.translation
    sight = place / np.linalg.norm(place)
    along = float(sight @ covariance[3:, 3:] @ sight)
    across = (float(np.trace(covariance[3:, 3:])) - along) / 2
    return np.sqrt(along), np.sqrt(max(across, 0.0)), float(np.sqrt(np.trace(covariance[:3, :3]) / 3))


def _row(each: MeasuredImage, verdicts: bool) -> list[str]:
    """Of the table of poses."""
    pose = each.pose
    sigma = np.sqrt(np.diag(pose.covariance))
    return (
        [each.name, ", ".join(pose.faces), str(len(pose.labels)), pose.status]
        + [number(v, 3) for v in pose.camera_from_target.translation]
        + [number(1e3 * v, 1) for v in sigma[3:]]
        + [number(1e3 * np.degrees(v), 2) for v in sigma[:3]]
        + [number(pose.rms_px(), 4), number(pose.chi2_per_redundancy(), 2)]
        + ([fit_verdict(pose)] if verdicts else [])
    )
