"""The second look at an image: circles that the group's arrangement puts into view are measured where they must be.

A hidden, dim or blurred neighbour then costs a circle nothing: what recognition needs of a whole pattern, a single
circle need not have. A circle counts as seen when the fit of its rim ends at its predicted place, of its predicted size
and shape, and stands out from the noise; all else is left out, with its reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.images import grey_fine
from stcal.labels import BOARD, Label
from stcal.sfm.data.in_view import ideal_border, in_view
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.detect.arrangement import Arrangement
from stcal.sfm.detect.candidates import MAX_POSITION_ERROR, MAX_POSITION_ERROR_PX, singular_values
from stcal.sfm.detect.centres import MIN_SIGMA, Centres, measure_centres
from stcal.sfm.detect.ellipses import MIN_DIAMETER_PX, EllipseOptions, Ellipses

MAX_STRETCH = 1.15
"""Between the predicted and the measured ellipse along any direction, on top of half a pixel at each end."""
MAX_SIGMA_PX = 0.5
"""Of a centre that is worth having."""
MIN_SIGNIFICANCE = 8.0
"""Of the contrast, in σ of a pixel's noise around the rim."""


@dataclass(frozen=True, slots=True, eq=False)
class PredictedCircles:
    """n circles that are in view in one image.

    ``labels`` ; ``centre_px`` : (n, 2) and ``shape_px`` : (n, 2, 2) of their ellipses; ``polarity`` of each; ``wanted``
    : (n,) those that have no label yet.
    """

    labels: tuple[Label, ...]
    centre_px: np.ndarray
    shape_px: np.ndarray
    polarity: tuple[Polarity, ...]
    wanted: np.ndarray

    def __post_init__(self):
        n = len(self.labels)
        object.__setattr__(self, "centre_px", frozen(self.centre_px, (n, 2), "centres"))
        object.__setattr__(self, "shape_px", frozen(self.shape_px, (n, 2, 2), "shapes"))
        object.__setattr__(self, "wanted", frozen(self.wanted, (n,), "wanted", dtype=bool))


@dataclass(frozen=True, slots=True, eq=False)
class SecondLook:
    """``labels`` of the circles that were measured, with their ``centres``; ``missed`` : label → why not."""

    labels: tuple[Label, ...]
    centres: Centres
    missed: dict[Label, str]


@dataclass(frozen=True, slots=True, eq=False)
class _Pattern:
    """Circles of one plane; ``side`` : as of :func:`stcal.sfm.data.in_view.in_view`."""

    labels: Sequence[Label]
    xy_mm: np.ndarray
    radius_mm: np.ndarray
    polarity: Polarity
    side: int


def patterns_of(target: TargetDesign, board: BoardDesign | None) -> dict[str, _Pattern]:
    """Of all planes."""
    found = {f.id: _Pattern(f.labels(), f.xy_mm, f.radius_mm, target.polarity, 1) for f in target.faces}
    if board is not None:
        found[BOARD] = _Pattern(board.labels(), board.xy_mm(), board.radii_mm(), board.polarity, -1)
    return found


def predict_circles(
    arrangement: Arrangement,
    image: int,
    seen: Sequence[Label],
    target: TargetDesign,
    board: BoardDesign | None,
    camera: Camera,
) -> PredictedCircles | None:
    """Circles that the arrangement puts into view in an image, wanted those that have not been ``seen``; None where it
    does not know the image."""
    pose = arrangement.camera_from_group.get(image)
    if pose is None:
        return None
    labels: list[Label] = []
    centre, shape, polarity = [], [], []
    border = ideal_border(camera)
    for plane, pattern in patterns_of(target, board).items():
        if plane not in arrangement.group_from_plane:
            continue
        camera_from_plane = pose @ arrangement.group_from_plane[plane]
        shown = np.flatnonzero(
            in_view(camera_from_plane, pattern.xy_mm, pattern.radius_mm, pattern.side, camera, border)
        )
        place, outline = _ellipses(camera_from_plane, pattern.xy_mm[shown], pattern.radius_mm[shown], camera)
        labels += [pattern.labels[i] for i in shown.tolist()]
        centre.append(place)
        shape.append(outline)
        polarity += [pattern.polarity] * len(shown)
    known = set(seen)
    wanted = np.array([label not in known for label in labels], bool)
    return PredictedCircles(tuple(labels), np.concatenate(centre), np.concatenate(shape), tuple(polarity), wanted)


def contradictions(predicted: PredictedCircles, seen: ImageObservations, camera: Camera) -> dict[Label, str]:
    """Circles of the first look that are not where, or not of the size, that the others of their plane ask for: partly
    hidden, or something else; with the reason. What most circles of a plane are off is the design's, and let pass."""
    place = {label: i for i, label in enumerate(predicted.labels)}
    rows = [k for k, label in enumerate(seen.labels) if label in place]
    own = np.array([place[seen.labels[k]] for k in rows], int)
    planes = np.array([seen.labels[k].plane for k in rows])
    local = camera.focal[:, None] * camera.distort_jacobian(seen.centre[rows])[1]
    ratio = np.linalg.solve(predicted.shape_px[own], local @ seen.shape[rows])
    widest, narrowest = singular_values(ratio)
    radius, minor = np.sqrt(np.linalg.det(predicted.shape_px[own])), singular_values(predicted.shape_px[own])[1]
    off = np.linalg.norm(seen.centre_px[rows] - predicted.centre_px[own], axis=1)
    found: dict[Label, str] = {}
    for plane in dict.fromkeys(planes.tolist()):
        members = np.flatnonzero(planes == plane)
        size = np.median(np.sqrt(widest[members] * narrowest[members]))
        usual = 3 * np.median(off[members])
        for k in members.tolist():
            allowed = max(MAX_POSITION_ERROR * radius[k], MAX_POSITION_ERROR_PX, usual)
            stretch = MAX_STRETCH * (1 + 0.5 / minor[k])
            most = max(widest[k] / size, size / narrowest[k])
            if off[k] > allowed:
                found[seen.labels[rows[k]]] = _off_place(off[k], allowed)
            elif most > stretch:
                found[seen.labels[rows[k]]] = _off_size(most, stretch)
    return found


def _off_place(off_px: float, allowed_px: float) -> str:
    return f"{off_px:.1f} px from its place, {allowed_px:.1f} allowed"


def _off_size(stretch: float, allowed: float) -> str:
    return f"{stretch:.2f} times its size along one direction, {allowed:.2f} allowed"


def _ellipses(
    camera_from_plane: Rigid, xy_mm: np.ndarray, radius_mm: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Images of circles: centres (n, 2) and symmetric shapes (n, 2, 2), px; from the dual conic M·diag(r², r², −1)·Mᵀ,
    M = [e₁ e₂ C] (Hartley & Zisserman, sec. 2.2 and 8.3). Lens distortion to first order."""
    axes = camera_from_plane.rotation[:, :2]
    middle = camera_from_plane @ np.column_stack([xy_mm, np.zeros(len(xy_mm))])
    dual = radius_mm[:, None, None] ** 2 * (axes @ axes.T) - middle[:, :, None] * middle[:, None, :]
    dual = -dual / dual[:, 2:, 2:]
    centre = -dual[:, :2, 2]
    square = dual[:, :2, :2] + centre[:, :, None] * centre[:, None, :]
    distorted, by_ideal = camera.distort_jacobian(centre)
    local = camera.focal[:, None] * by_ideal
    value, vector = np.linalg.eigh(local @ square @ np.swapaxes(local, 1, 2))
    root = np.sqrt(np.maximum(value, 0))
    return distorted * camera.focal + camera.centre, (vector * root[:, None]) @ np.swapaxes(vector, 1, 2)


def measure_predicted(
    image: np.ndarray, camera: Camera, predicted: PredictedCircles, options: EllipseOptions
) -> SecondLook:
    """Measure the wanted circles in a grey image of any depth, of the sizes that the options ask for."""
    scaled = grey_fine(image)
    everything = Ellipses(predicted.centre_px, predicted.shape_px, np.ones(len(predicted.labels)))
    wanted = np.flatnonzero(predicted.wanted)
    low, high = options.min_diameter_px or MIN_DIAMETER_PX, options.max_diameter_px
    diameter = 2 * everything.radius_px()
    missed = {
        predicted.labels[i]: f"{diameter[i]:.1f} px across, {low:g} to {high:g} px asked for"
        for i in wanted
        if not low <= diameter[i] <= high
    }
    wanted = np.array([i for i in wanted if predicted.labels[i] not in missed], int)
    expected = everything.select(wanted)
    found = measure_centres(scaled, camera, expected, everything)
    reasons = [_reason(found, expected, k, predicted.polarity[i], camera) for k, i in enumerate(wanted)]
    seen = [k for k, reason in enumerate(reasons) if not reason]
    return SecondLook(
        tuple(predicted.labels[wanted[k]] for k in seen),
        found.select(np.array(seen, int)),
        missed | {predicted.labels[i]: reason for i, reason in zip(wanted, reasons, strict=True) if reason},
    )


def _reason(found: Centres, expected: Ellipses, k: int, polarity: Polarity, camera: Camera) -> str:
    """Why a fit is not the circle that was expected; empty where it is."""
    if not found.ok[k]:
        return f"{100 * found.rim[k]:.0f} % of its rim follows an ellipse, 80 % needed"
    contrast = found.contrast[k] * (1 if polarity == "bright" else -1)
    needed = MIN_SIGNIFICANCE * max(found.noise[k], MIN_SIGMA)
    if contrast < needed:
        return f"contrast {contrast:.1f}, {needed:.1f} needed"
    size = float(np.sqrt(np.linalg.det(expected.shape_px[k])))
    off, allowed = np.linalg.norm(found.centre_px[k] - expected.centre_px[k]), MAX_POSITION_ERROR * size
    if off > max(allowed, MAX_POSITION_ERROR_PX):
        return _off_place(float(off), max(float(allowed), MAX_POSITION_ERROR_PX))
    _, local = camera.distort_jacobian(found.centre[k])
    own = (camera.focal[:, None] * local) @ found.shape[k]
    widest, narrowest = singular_values(np.linalg.solve(expected.shape_px[k], own))
    stretch = MAX_STRETCH * (1 + 0.5 / float(singular_values(expected.shape_px[k])[1]))
    if widest > stretch or narrowest < 1 / stretch:
        return _off_size(float(max(widest, 1 / narrowest)), float(stretch))
    sigma = float(np.sqrt(np.trace(found.covariance_px2[k]) / 2))
    if sigma > MAX_SIGMA_PX:
        return f"σ {sigma:.2f} px, {MAX_SIGMA_PX:g} allowed"
    return ""


def missed_notes(missed: dict[Label, str]) -> list[str]:
    """One line for each face, and one for the board, of what was expected in view and not measured."""
    planes: dict[str, list[tuple[Label, str]]] = {}
    for label, reason in missed.items():
        planes.setdefault(label.plane, []).append((label, reason))
    notes = []
    for plane, rows in planes.items():
        what = "board" if plane == BOARD else f"face {plane}"
        first, reason = rows[0]
        more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        notes.append(f"{what}: {first}{more} should be in view and not measured; {first}: {reason}; hidden or unclear")
    return notes


def contradicted_notes(found: dict[Label, str]) -> list[str]:
    """One line for each circle."""
    return [f"{label}: {reason}; partly hidden or something else, left out" for label, reason in found.items()]
