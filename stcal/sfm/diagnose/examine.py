"""Search for why a visible circle was not found: the gates of detection at its place, in detection's order."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography
from stcal.geometry.rigid import Rigid
from stcal.io.images import grey_8bit, grey_fine
from stcal.labels import BOARD
from stcal.sfm.data.patterns import Pattern, images_px
from stcal.sfm.detect.board import needed_dots
from stcal.sfm.detect.circles.candidates import (
    MAX_POSITION_ERROR,
    MAX_POSITION_ERROR_PX,
    Candidates,
    EllipseOptions,
    Level,
    OutlineGates,
    PatternFit,
    contrast_of,
    contrast_threshold,
    diameter_limits_px,
    distinct,
    fit_pattern,
    levels,
    masks,
    outline_area,
    outlines,
)
from stcal.sfm.detect.circles.centres import MIN_RIM, measure_centres
from stcal.sfm.detect.faces import needed_circles
from stcal.sfm.detect.image import ImageReading, detect_image, read_image

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
"""Gates of an outline in their order. Among several outlines of a circle, the one that passed most gates decides; among
several of these, the one that is closest to its limit."""
NEEDED = ("min_axis_ratio", "min_diameter")
"""Gates whose limit is a lower bound; that of the other gates is an upper bound."""


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

    ``image`` : 8-bit grey; ``centre``, ``shape`` : (n, 2), (n, 2, 2) predicted ellipses that detection did not find,
    px.
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


LEAST_MIN_DIAMETER_PX = 4.0
"""Smallest value that ``--min-diameter`` accepts."""
LOOSER = (0.75, 0.5, 0.25)
"""Factors by which limits are loosened. Outlines run at half a blob's height, and only a lower threshold leaves the
blob whole."""
LARGER = (1.02, 1.2)


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """The n circles of one plane in one image.

    ``pattern`` : the circles; ``camera_from_plane`` : pose of the plane; ``missing``, (n,): True for circles that
    should be visible but have no label.
    """

    pattern: Pattern
    camera_from_plane: Rigid
    missing: np.ndarray

    def __post_init__(self):
        freeze(self, "missing", (len(self.pattern.labels),), "missing", dtype=bool)

    @property
    def is_board(self) -> bool:
        """True if the plane is the board, False if it is a face."""
        return self.pattern.plane == BOARD

    def image_from_plane(self) -> np.ndarray:
        """Returns the homography from mm in the plane to normalised image coordinates, (3, 3)."""
        return np.column_stack([self.camera_from_plane.rotation[:, :2], self.camera_from_plane.translation])

    def in_px(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Returns centres (n, 2) and shapes (n, 2, 2) of the circles' images, px."""
        return images_px(self.pattern, self.camera_from_plane, camera)


@dataclass(frozen=True, slots=True)
class CircleVerdict:
    """The gate that stopped one circle: its ``value`` did not pass the ``limit`` of ``gate``.

    ``cause`` : ``merged`` if its outline runs into something else, ``cut`` if the outline misses a part of the circle.
    """

    label: str
    gate: str
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    cause: str = ""


@dataclass(frozen=True, slots=True)
class OptionTrial:
    """An option to try. ``text`` : the option as the user writes it; ``gate`` : the gate that it loosens."""

    gate: str
    text: str
    options: EllipseOptions


def examine(
    image: np.ndarray,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    options: EllipseOptions,
    planes: list[Expected],
) -> list[CircleVerdict]:
    """Returns, for each missing circle of an image, the first gate that it fails."""
    reading = read_image(grey_8bit(image), camera, target, board, options)
    verdicts = []
    for plane in planes:
        verdicts += _Examination(image, camera, target, board, options, reading, plane).verdicts()
    return verdicts


class _Examination:
    """Examination of the missing circles of one plane in one image."""

    def __init__(self, image, camera: Camera, target, board, options, reading: ImageReading, plane: Expected):
        self.image, self.camera, self.options, self.reading, self.plane = image, camera, options, reading, plane
        self.target, self.board = target, board
        self.is_board, self.pattern = plane.is_board, plane.pattern
        self.polarity: Polarity = plane.pattern.polarity
        self.ellipses = reading.found[self.polarity] if self.is_board else reading.free
        self.fit: PatternFit | None = None
        if len(self.ellipses):
            candidates = Candidates.of(self.ellipses, camera)
            self.fit = fit_pattern(candidates, self._homography(), self.pattern.xy_mm, self.pattern.radius_mm)

    def _homography(self) -> np.ndarray:
        """Returns the homography with which detection predicted the circles, or that of the model if detection did not
        get that far."""
        if self.is_board:
            homographies = [homography for board in self.reading.boards for homography in board.homographies]
        else:
            homographies = [r.homography for r in self.reading.faces.faces if r.face.id == self.pattern.plane]
        # If the board has several numberings, the group chose the one that agrees with the model.
        xy, by_model = self.pattern.xy_mm, self.plane.image_from_plane()
        expected = apply_homography(by_model, xy)
        deviations = [np.abs(apply_homography(h, xy) - expected).max() for h in homographies]
        return homographies[int(np.argmin(deviations))] if homographies else by_model

    def verdicts(self) -> list[CircleVerdict]:
        """Returns the verdicts on all missing circles of the plane."""
        verdicts, lost = [], []
        for i in np.flatnonzero(self.plane.missing).tolist():
            if self.fit is not None and self.fit.fits()[i]:
                verdicts.append(self._recognised(i, self.fit) or self._rim(i, self.fit))
            elif self.fit is not None and self.fit.distance[i] < self.fit.radius[i]:
                verdicts.append(self._pattern(i, self.fit))
            else:
                lost.append(i)
        if lost:
            centre, shape = self.plane.in_px(self.camera)
            grey = grey_8bit(self.image)
            for i, end in zip(
                lost, trace_outlines(grey, self.polarity, self.options, centre[lost], shape[lost]), strict=True
            ):
                verdicts.append(
                    CircleVerdict(self.pattern.labels[i], end.gate, end.value, end.limit, end.unit, end.cause)
                )
        return verdicts

    def _recognised(self, i: int, fit: PatternFit) -> CircleVerdict | None:
        """Returns the gate of the face or board that stopped a circle after its outline passed, or None if there is
        none."""
        label, reading, candidate = self.pattern.labels[i], self.reading, fit.index[i]
        count = int(fit.fits().sum())
        if self.is_board:
            if reading.boards:
                on_a_board = any(candidate in board.candidates for board in reading.boards)
                return None if on_a_board else CircleVerdict(label, "board_grid")
            needed = int(np.ceil(needed_dots(self.board)))
            return CircleVerdict(label, "board_dots" if count < needed else "board_grid", count, needed, "dots")
        named = [r for r in reading.faces.faces if r.face.id == self.pattern.plane]
        if named:
            return (
                None
                if any(candidate in face_reading.used() for face_reading in named)
                else CircleVerdict(label, "pattern")
            )
        for refused in reading.faces.refused:
            if set(refused.used()) & set(fit.index[fit.fits()]):
                return CircleVerdict(label, refused.gate, refused.value, refused.limit, "other readings")
        needed = needed_circles(self.target.face(self.pattern.plane))
        return CircleVerdict(label, "face_circles" if count < needed else "face_pattern", count, needed, "circles")

    def _rim(self, i: int, fit: PatternFit) -> CircleVerdict:
        """Returns the verdict of the last gate, the measurement of the rim."""
        ellipse = self.ellipses.select(fit.index[i : i + 1])
        measured = measure_centres(grey_fine(self.image), self.camera, ellipse, self.reading.found[self.polarity])
        if not measured.ok[0]:
            return CircleVerdict(self.pattern.labels[i], "rim", float(measured.rim[0]), MIN_RIM, "of the rim")
        return CircleVerdict(self.pattern.labels[i], "board_numbering" if self.is_board else "found_now")

    def _pattern(self, i: int, fit: PatternFit) -> CircleVerdict:
        """Returns the verdict on an ellipse near the circle's place that is displaced, or of another size or shape."""
        label = self.pattern.labels[i]
        if not fit.in_place()[i]:
            deviation, allowed = fit.distance[i] / fit.radius[i], fit.max_distance[i] / fit.radius[i]
            return CircleVerdict(label, "position", float(deviation), float(allowed), "radii")
        stretch = max(fit.widest[i], 1 / max(fit.narrowest[i], 1e-9))
        return CircleVerdict(label, "shape", float(stretch), float(fit.max_stretch[i]))


def by_geometry(planes: list[Expected], camera: Camera, options: EllipseOptions) -> list[CircleVerdict]:
    """Returns verdicts from the predicted size of the missing circles alone, for use without the image."""
    smallest, largest = diameter_limits_px(camera.width * camera.height, options)
    verdicts = []
    for plane in planes:
        diameter = 2 * np.sqrt(np.abs(np.linalg.det(plane.in_px(camera)[1])))
        for i in np.flatnonzero(plane.missing).tolist():
            gate, limit = "not_examined", None
            if diameter[i] < smallest:
                gate, limit = "min_diameter", smallest
            elif diameter[i] > largest:
                gate, limit = "max_diameter", largest
            verdicts.append(CircleVerdict(plane.pattern.labels[i], gate, float(diameter[i]), limit, "px"))
    return verdicts


def trials(verdicts: Sequence[CircleVerdict], pixels: int, options: EllipseOptions) -> list[OptionTrial]:
    """Returns options that could let circles in, gentle ones first: loosened as far as the verdicts ask for, and to the
    end."""
    option_trials = []
    smallest, _ = diameter_limits_px(pixels, options)
    stopped = [(verdict.gate, verdict.value) for verdict in verdicts if verdict.value is not None and not verdict.cause]
    small = [value for gate, value in stopped if gate == "min_diameter" and value >= LEAST_MIN_DIAMETER_PX]
    half_px = np.floor(2 * min(small, default=LEAST_MIN_DIAMETER_PX)) / 2
    for diameter in dict.fromkeys((half_px, LEAST_MIN_DIAMETER_PX)):
        if diameter < smallest:
            looser = replace(options, min_diameter_px=float(diameter))
            option_trials.append(OptionTrial("min_diameter", f"--min-diameter {diameter:g}", looser))
    if large := [value for gate, value in stopped if gate == "max_diameter"]:
        for diameter in dict.fromkeys(10 * np.ceil(factor * max(large) / 10) for factor in LARGER):
            looser = replace(options, max_diameter_px=float(diameter))
            option_trials.append(OptionTrial("max_diameter", f"--max-diameter {diameter:g}", looser))
    for gate in ("min_contrast", "min_axis_ratio"):
        if any(verdict.gate == gate and not verdict.cause for verdict in verdicts):
            for factor in LOOSER:
                limit = float(f"{factor * getattr(options, gate):.2g}")
                option_trials.append(
                    OptionTrial(gate, f"EllipseOptions({gate}={limit:g})", replace(options, **{gate: limit}))
                )
    return option_trials


def labels_found(
    image: np.ndarray,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
    options: EllipseOptions,
    planes: list[Expected],
) -> set[str]:
    """Returns the labels that detection finds with these options. A dot of the board is identified by its place among
    the expected dots."""
    detection = detect_image(image, camera, target, board, options)
    labels: set[str] = {label for reading in detection.faces for label in reading.labels(target.face(reading.face))}
    dots = detection.centres.centre_px[[row for reading in detection.boards for row in reading.rows]]
    for plane in planes:
        if plane.is_board and len(dots):
            centre, shape = plane.in_px(camera)
            near = np.maximum(MAX_POSITION_ERROR * np.sqrt(np.abs(np.linalg.det(shape))), MAX_POSITION_ERROR_PX)
            distance = np.linalg.norm(centre[:, None] - dots, axis=2).min(1)
            labels |= {label for label, is_near in zip(plane.pattern.labels, distance < near, strict=True) if is_near}
    return labels
