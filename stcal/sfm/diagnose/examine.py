"""Search for why a visible circle was not found: the gates of detection at its place, in detection's order.

Nothing is judged anew here. Outlines, patterns, faces, board and rims go through the functions that detection itself
uses, with the same options. To see whether another option would find a circle, detection is run with that option.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.arrays import frozen
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
    PatternFit,
    fit_pattern,
)
from stcal.sfm.detect.circles.centres import MIN_RIM, measure_centres
from stcal.sfm.detect.circles.ellipses import EllipseOptions, diameter_limits_px
from stcal.sfm.detect.faces import needed_circles
from stcal.sfm.detect.image import ImageReading, detect_image, read_image
from stcal.sfm.diagnose.trace import trace_outlines

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
        object.__setattr__(self, "missing", frozen(self.missing, (len(self.pattern.labels),), "missing", dtype=bool))

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
