"""Follow the outline of one circle through the masks in which detection looks for ellipses, and say where it ends."""

from dataclasses import dataclass

import cv2
import numpy as np

from stcal.design import Polarity
from stcal.sfm.detect.circles.candidates import MAX_POSITION_ERROR, MAX_POSITION_ERROR_PX
from stcal.sfm.detect.circles.ellipses import (
    EllipseOptions,
    Level,
    OutlineGates,
    contrast_of,
    contrast_threshold,
    diameter_limits_px,
    distinct,
    levels,
    masks,
    outline_area,
    outlines,
)

MIN_OVERLAP = 0.2
"""Share of a circle's predicted disc that an outline must cover to belong to the circle."""
MERGED, CUT = 1.5, 0.6
"""Ratios of the diameter of an outline to the predicted one beyond which it runs into something else, or misses a
part."""
HIDDEN = 0.25
"""Share of the needed contrast below which a circle counts as hidden."""
PROGRESS = (
    "short",
    "long",
    "border",
    "ellipse",
    "min_axis_ratio",
    "min_diameter",
    "max_diameter",
    "outline_area",
    "outline_deviation",
    "",
)
"""Gates of an outline in their order. Of several outlines of a circle, the one that passed most gates decides, …"""
NEEDED = ("min_axis_ratio", "min_diameter")
"""… and among these the one closest to its limit. The limit is the least needed for these gates, the most allowed for
others."""


@dataclass(frozen=True, slots=True)
class OutlineEnd:
    """The gate that stopped an outline, with value and limit in px of the full image.

    ``cause`` : ``merged``, ``cut`` or empty; ``rank`` : position of the gate in ``PROGRESS``; ``ellipse`` : the ellipse
    of an outline that passed, a row as of :meth:`Level.in_full`.
    """

    gate: str
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    cause: str = ""
    rank: int = -1
    ellipse: np.ndarray | None = None

    def closeness(self) -> float:
        """Returns how close the value came to the limit. It is comparable between values of one gate only."""
        if self.value is None or self.limit is None:
            return 0.0
        return self.value / self.limit if self.gate in NEEDED else -self.value / self.limit


def trace_outlines(
    image: np.ndarray, polarity: Polarity, options: EllipseOptions, centre: np.ndarray, shape: np.ndarray
) -> list[OutlineEnd]:
    """Returns where the outlines of n circles end.

    Parameters
    ----------
    image : 8-bit grey
    centre, shape : (n, 2), (n, 2, 2) predicted ellipses that detection did not find, px
    """
    threshold, grey_range = contrast_threshold(image, options)
    grey_range = max(grey_range, 1.0)
    predicted = 2 * np.sqrt(np.abs(np.linalg.det(shape)))
    ends: list[list[OutlineEnd]] = [[] for _ in centre]
    limits = diameter_limits_px(image.size, options)
    for level in levels(image, options):
        centre_level, shape_level = (centre - (level.scale - 1) / 2) / level.scale, shape / level.scale
        for mask, gates in masks(level, polarity, threshold, options):
            contours = outlines(mask)
            boxes = np.array([cv2.boundingRect(c) for c in contours]).reshape(-1, 4)
            for k in range(len(centre)):
                contour = _covering(mask, contours, boxes, centre_level[k], shape_level[k])
                if contour is not None:
                    ends[k].append(_end(gates, contour, level, limits, predicted[k]))
    contrast = contrast_of(image, polarity, centre, shape)
    result = []
    for k, ends_of_circle in enumerate(ends):
        furthest = max(
            (end for end in ends_of_circle if end.rank >= 0), key=lambda end: (end.rank, end.closeness()), default=None
        )
        if furthest is None:
            result.append(_nothing(contrast[k], threshold, grey_range, predicted[k], limits))
        elif furthest.ellipse is not None:
            result.append(_passed(image, polarity, furthest.ellipse, threshold, grey_range, centre[k], predicted[k]))
        else:
            result.append(furthest)
    return result


def _covering(mask, contours, boxes, centre, shape) -> np.ndarray | None:
    """Returns the outline whose inside covers most of an ellipse, the innermost of equal ones, or None if no outline
    covers enough."""
    reach = np.sqrt((shape**2).sum(1))
    low = np.maximum(np.floor(centre - reach).astype(int), 0)
    high = np.minimum(np.ceil(centre + reach).astype(int) + 1, mask.shape[::-1])
    x, y = np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)))
    offset = np.linalg.solve(shape, np.stack([x - centre[0], y - centre[1]]).reshape(2, -1))
    disc = (np.linalg.norm(offset, axis=0) <= 1).reshape(x.shape)
    inside = disc & (mask[low[1] : high[1], low[0] : high[0]] > 0)
    if not disc.any():
        return None
    near = (boxes[:, :2] < high).all(1) & (boxes[:, :2] + boxes[:, 2:] > low).all(1)
    best = (MIN_OVERLAP * disc.sum(), 0, None)
    for k in np.flatnonzero(near):
        filled = np.zeros(x.shape, np.uint8)
        cv2.drawContours(filled, contours, int(k), 1, -1, offset=(-int(low[0]), -int(low[1])))
        covered, size = (inside & (filled > 0)).sum(), boxes[k, 2] * boxes[k, 3]
        if covered > best[0] or (covered == best[0] and size < best[1]):
            best = (covered, size, contours[k])
    return best[2]


def _end(gates: OutlineGates, contour, level: Level, limits: tuple[float, float], predicted: float) -> OutlineEnd:
    """Returns where one outline in one mask ends. The rank is −1 if only another level or window can judge it."""
    verdict = gates.check(contour)
    gate, value, limit = verdict.gate, verdict.value, verdict.limit
    rank, unit = PROGRESS.index(gate), ""
    diameter = float(np.sqrt(outline_area(contour) * 4 / np.pi))
    if gate == "short":
        gate, value, limit = "min_diameter", min(diameter, value * gates.lowest / limit), gates.lowest
    elif gate == "long":
        gate, value, limit = "max_diameter", max(diameter, value * gates.highest / limit), gates.highest
    if gate in ("min_diameter", "max_diameter", "border"):
        value, limit, unit = value * level.scale, limit * level.scale, "px"
    if (gate == "min_diameter" and limit > 1.001 * limits[0]) or (gate == "max_diameter" and limit < 0.999 * limits[1]):
        rank = -1
    size = diameter * level.scale / predicted
    cause = "merged" if size > MERGED else "cut" if size < CUT else ""
    if not gate or gate == "ellipse":  # these gates have no value
        return OutlineEnd(gate, rank=rank, cause=cause, ellipse=None if gate else level.in_full([verdict.ellipse]))
    return OutlineEnd(gate, float(value), float(limit), unit, cause, rank)


def _passed(image, polarity, row: np.ndarray, threshold, grey_range, centre, predicted) -> OutlineEnd:
    """Returns the verdict on an outline that is an ellipse: it is too faint, or not that of the circle."""
    at, shape = distinct(row)
    contrast = contrast_of(image, polarity, at, shape)[0]
    if contrast <= threshold:
        return _faint(contrast, threshold, grey_range)
    limit = max(MAX_POSITION_ERROR, 2 * MAX_POSITION_ERROR_PX / predicted)
    return OutlineEnd("position", float(np.linalg.norm(at[0] - centre) * 2 / predicted), limit, "radii")


def _nothing(contrast, threshold, grey_range, predicted, limits: tuple[float, float]) -> OutlineEnd:
    """Returns the verdict on a place that no outline covers."""
    if contrast <= threshold:
        return _faint(contrast, threshold, grey_range)
    for gate, limit, beyond in (
        ("min_diameter", limits[0], predicted < limits[0]),
        ("max_diameter", limits[1], predicted > limits[1]),
    ):
        if beyond:
            return OutlineEnd(gate, float(predicted), limit, "px")
    return OutlineEnd("outline")


def _faint(contrast: float, threshold: float, grey_range: float) -> OutlineEnd:
    gate = "hidden" if contrast < HIDDEN * threshold else "min_contrast"
    return OutlineEnd(gate, float(contrast / grey_range), float(threshold / grey_range), "of the grey range")
