"""Circles where an arrangement of planes predicts them: their search, and those that contradict the arrangement."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stcal.adjust.blocks import Huber
from stcal.adjust.engine import Adjustment
from stcal.design import Polarity
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_image_offset, singular_values
from stcal.geometry.rigid import Poses, Rigid, by_pose, perspective
from stcal.io.images import grey_fine
from stcal.labels import BOARD, Label
from stcal.sfm.data.group_model import Centres, ImageObservations, Note, rows_by
from stcal.sfm.data.patterns import MAX_TILT_RAD, Pattern, ideal_border, images_px, in_view
from stcal.sfm.detect.candidates import (
    MAX_POSITION_ERROR,
    MAX_POSITION_ERROR_PX,
    MIN_DIAMETER_PX,
    EllipseOptions,
    Ellipses,
)
from stcal.sfm.detect.centres import MIN_RIM, MIN_SIGMA, measure_centres

MAX_STRETCH = 1.15
"""Largest ratio of measured to predicted ellipse along any direction, in addition to half a pixel at each end."""
MAX_BLUR = 1.0  # largest blur (σ) over the smaller radius: a rim that is more blurred merges with its opposite side
MAX_SIGMA_PX = 0.5
"""Largest σ of a centre. It is fifty times that of a clear one, so that the weight of a worse one is negligible."""
MIN_SIGNIFICANCE = 8.0
"""Smallest contrast, in σ of a pixel's noise around the rim. A single pixel of clutter or noise has less."""
CUT = "cut off"
"""Code of the reason that a circle is smaller than expected in one direction."""
REMEDIES = {
    "small": "come closer, use a longer lens, or give a smaller --min-diameter",
    "large": "step back, use a shorter lens, or give a larger --max-diameter",
    "rim": "partly hidden, reflecting or disturbed: uncover it, or cover what is bright beside it",
    "contrast": "hidden or dark: uncover it, light it, expose longer, or cover what is brighter",
    "sigma": "light it, expose longer, or come closer",
    "blur": "focus on it, close the aperture, or hold the camera still",
    "place": "something else is there, or a part of the circle: uncover it; is its place in the target file right?",
    CUT: "uncover it; is its radius in the target file right?",
    "shape": "something else is there, or a part of the circle: uncover it; is its radius in the target file right?",
    "face": "show one whole with the white about it, less obliquely, sharper, closer, evenly lit; cover other dots",
    "board": "show more of its dots and those between them, sharper, evenly lit; cover what is like a dot",
}
"""What to change in the scene, by what stops a circle, or all of a face or of the board, from being found."""


@dataclass(frozen=True, slots=True, eq=False)
class PredictedCircles:
    """n circles that are in view in one image."""

    labels: tuple[Label, ...]
    centre_px: np.ndarray  # (n, 2)
    shape_px: np.ndarray  # (n, 2, 2)
    polarity: tuple[Polarity, ...]
    wanted: np.ndarray  # (n,) those that have no label yet

    def __post_init__(self):
        for name, shape, dtype in (("centre_px", (2,), float), ("shape_px", (2, 2), float), ("wanted", (), bool)):
            freeze(self, name, (len(self.labels), *shape), name, dtype)

    def shifted(self, by_px: np.ndarray) -> "PredictedCircles":
        """Returns all circles shifted by (2,) px."""
        return replace(self, centre_px=self.centre_px + by_px)


@dataclass(frozen=True, slots=True, eq=False)
class SecondLook:
    """Result of a second look: the measured circles, and reasons of the others with their kinds as codes."""

    labels: tuple[Label, ...]
    centres: Centres
    missed: dict[Label, Note]


def predict_circles(
    camera_from_group: Rigid,
    group_from_plane: Mapping[str, Rigid],
    seen: Collection[Label],
    patterns: Mapping[str, Pattern],
    camera: Camera,
    max_tilt_rad: float = MAX_TILT_RAD,
) -> PredictedCircles:
    """Predicts the circles in view on planes of known poses; those not in ``seen`` are wanted."""
    labels: list[Label] = []
    centre, shape, polarity = [np.zeros((0, 2))], [np.zeros((0, 2, 2))], []
    border = ideal_border(camera)
    for plane, pattern in patterns.items():
        if plane not in group_from_plane:
            continue
        camera_from_plane = camera_from_group @ group_from_plane[plane]
        shown = np.flatnonzero(in_view(pattern, camera_from_plane, camera, border, max_tilt_rad))
        place, outline = images_px(pattern, camera_from_plane, camera, shown)
        labels += [pattern.labels[i] for i in shown.tolist()]
        centre.append(place)
        shape.append(outline)
        polarity += [pattern.polarity] * len(shown)
    known = set(seen)
    wanted = np.array([label not in known for label in labels], bool)
    return PredictedCircles(tuple(labels), np.concatenate(centre), np.concatenate(shape), tuple(polarity), wanted)


def contradictions(predicted: PredictedCircles, observed: ImageObservations, camera: Camera) -> dict[Label, Note]:
    """Returns circles, with reasons, whose size contradicts others of their plane: partly hidden, or something else. A
    common size ratio of a plane's circles is attributed to the design and accepted."""
    place = {label: i for i, label in enumerate(predicted.labels)}
    rows = np.array([k for k, label in enumerate(observed.labels) if label in place], int)
    labels = [observed.labels[k] for k in rows]
    shapes_px = predicted.shape_px[np.array([place[label] for label in labels], int)]
    widest, narrowest = _stretch(shapes_px, observed.select(rows), camera)
    reasons: dict[Label, Note] = {}
    for members in rows_by(label.plane for label in labels).values():
        size = float(np.median(np.sqrt(widest[members] * narrowest[members])))
        for k in members.tolist():
            stretch, blur = (widest[k] / size, narrowest[k] / size), float(observed.blur_px[rows[k]])
            kind, reason = _disagreement(shapes_px[k], 0.0, stretch, blur)
            if reason:
                reasons[labels[k]] = Note(reason, kind)
    return reasons


def _stretch(shape_px: np.ndarray, found: Centres | ImageObservations, camera: Camera) -> tuple[np.ndarray, ...]:
    """Returns the largest and smallest ratio, in any direction, of measured ellipses to expected ones."""
    return singular_values(np.linalg.solve(shape_px, camera.pixel_jacobian(found.centre) @ found.shape))


def _disagreement(shape_px: np.ndarray, off_px: float, stretch: tuple[float, float], blur_px: float) -> tuple[str, str]:
    """Returns why a measured ellipse is not the expected one: the key of its remedy and the reason; empty if it is."""
    largest, smallest = singular_values(shape_px)
    allowed_px = max(MAX_POSITION_ERROR * float(np.sqrt(largest * smallest)), MAX_POSITION_ERROR_PX)
    most, limit = max(stretch[0], 1 / stretch[1]), MAX_STRETCH * (1 + 0.5 / float(smallest))
    if blur_px > MAX_BLUR * smallest:
        return "blur", f"blurred by {blur_px:.2g} px, {MAX_BLUR * float(smallest):.2g} px allowed by its smaller radius"
    if off_px > allowed_px:
        return "place", f"{off_px:.3g} px from its place, {allowed_px:.3g} allowed"
    if most > max(limit, stretch[0]) and stretch[0] > 1 / limit:
        return CUT, f"cut off to {1 / most:.2g} of its size along one direction, {1 / limit:.2g} allowed"
    if most > limit:
        return "shape", f"{most:.3g} times its size along one direction, {limit:.3g} allowed"
    return "", ""


def measure_predicted(
    image: np.ndarray, camera: Camera, predicted: PredictedCircles, options: EllipseOptions
) -> SecondLook:
    """Measures the wanted circles in a grey image of any depth, if the options admit their size."""
    everything = Ellipses(predicted.centre_px, predicted.shape_px, np.ones(len(predicted.labels)))
    low, high = options.min_diameter_px or MIN_DIAMETER_PX, options.max_diameter_px
    diameter, missed = 2 * everything.radius_px(), {}
    admitted = (diameter >= low) & (diameter <= high)
    for i in np.flatnonzero(predicted.wanted & ~admitted):
        kind, reason = "small" if diameter[i] < low else "large", f"{diameter[i]:.1f} px across"
        missed[predicted.labels[i]] = Note(f"{reason}, {low:g} to {high:g} px asked for", kind, remedy=REMEDIES[kind])
    wanted = np.flatnonzero(predicted.wanted & admitted)
    expected = everything.select(wanted)
    found = measure_centres(grey_fine(image), camera, expected, everything)
    contrast, needed = _contrast(found, [predicted.polarity[i] for i in wanted])
    off, sigma = np.linalg.norm(found.centre_px - expected.centre_px, axis=1), found.sigma_px()
    widest, narrowest = _stretch(expected.shape_px, found, camera)
    accepted = []
    for k, i in enumerate(wanted):
        kind, reason = "rim", f"{100 * found.rim[k]:.0f} % of its rim follows an ellipse, {100 * MIN_RIM:.0f} % needed"
        if found.ok[k] and contrast[k] < needed[k]:
            kind, reason = "contrast", f"contrast {contrast[k]:z.1f}, {needed[k]:.1f} needed"
        elif found.ok[k]:
            stretch, blur = (widest[k], narrowest[k]), float(found.blur_px[k])
            kind, reason = _disagreement(expected.shape_px[k], float(off[k]), stretch, blur)
            if not reason and sigma[k] > MAX_SIGMA_PX:
                kind, reason = "sigma", f"σ {sigma[k]:.2f} px, {MAX_SIGMA_PX:g} allowed"
        if reason:
            missed[predicted.labels[i]] = Note(reason, kind, remedy=REMEDIES[kind])
        else:
            accepted.append(k)
    labels = tuple(predicted.labels[i] for i in wanted[accepted])
    return SecondLook(labels, found.select(np.array(accepted, int)), missed)


def _contrast(found: Centres, polarity: Sequence[Polarity]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the contrast of each circle, positive with the right sign, and the contrast needed."""
    contrast = found.contrast * [1 if each == "bright" else -1 for each in polarity]
    return contrast, MIN_SIGNIFICANCE * np.maximum(found.noise, MIN_SIGMA)


MISSED = "should be in view and not measured"
CONTRADICTED = "left out, partly hidden or something else"


def notes_by_plane(reasons: Mapping[Label, Note], what: str) -> list[Note]:
    """Returns one note for each face, and one for the board, on circles with the reason of the first one and its code;
    ``what`` : :data:`MISSED` or :data:`CONTRADICTED`."""
    notes = []
    for plane in dict.fromkeys(label.plane for label in reasons):
        first, *more = [label for label in reasons if label.plane == plane]
        place, others = "board" if plane == BOARD else f"face {plane}", f" and {len(more)} more" if more else ""
        notes.append(Note(f"{place}: {first}{others} {what}; {first}: {reasons[first]}", reasons[first].code))
    return notes


HUBER_PX = 1.5
"""Residual beyond which an observation loses weight: such residuals are of printed planes, not of centres."""
BUNDLE_SETTLED = 1e-4  # relative decrease of χ² at convergence. A prediction to a fraction of a pixel is sufficient.
BUNDLE_STEPS = 30


def adjusted_planes(
    cameras: Poses,
    planes: Poses,
    image: np.ndarray,
    plane: np.ndarray,
    xyz: np.ndarray,
    seen: np.ndarray,
    focal_px: float,
) -> tuple[Poses, Poses]:
    """Adjusts the poses camera_from_world of images and world_from_plane of planes, of which the first is fixed, to n
    points: ``image``, ``plane`` (n,); ``xyz`` (n, 3) in the plane; ``seen`` (n, 2) measured, ideal px. Without
    convergence the last state is returned, or the start if a point is behind its camera: predictions are verified."""

    def off(planes: Poses, cameras: Poses) -> np.ndarray:
        xyz_camera = cameras[image] @ (planes[plane] @ xyz)
        if (xyz_camera[:, 2] <= 0).any():
            return np.full(seen.shape, np.inf)
        return focal_px * perspective(xyz_camera)[0] - seen

    def slopes(planes: Poses, cameras: Poses) -> tuple[np.ndarray, np.ndarray]:
        turned = np.einsum("nij,nj->ni", planes.rotation[plane], xyz)
        xyz_camera = cameras[image] @ (turned + planes.translation[plane])
        by_point = focal_px * perspective(xyz_camera)[1]
        placed = xyz_camera - cameras.translation[image]
        return by_pose(by_point @ cameras.rotation[image], turned), by_pose(by_point, placed)

    if not np.isfinite(off(planes, cameras)).all():
        return cameras, planes
    a = Adjustment()
    on = [(a.block("planes", planes, fixed=[0]), plane), (a.block("cameras", cameras, eliminate=True), image)]
    a.factor(off, on, derivatives=slopes, loss=Huber(HUBER_PX))
    found = a.minimum(settled=BUNDLE_SETTLED, max_steps=BUNDLE_STEPS, damping=1e-3).state
    return found["cameras"], found["planes"]


MIN_LIMIT_PX = 0.5
"""Largest deviation that never counts as outlying. Centres are good to hundredths, designs to tenths."""
BEYOND = 4.0  # factor on the median deviation of the plane's circles: 4.7 σ of normal errors, exceeded by one in 60 000
BEYOND_SIGMA = 5.0
"""Smallest outlying distance in σ of the centre; one normal error in 270 000 is larger (two coordinates)."""
MIN_USUAL = 6
"""Least number of circles for a plane's own pose and median; those of other planes are judged by the median of all."""
ALIKE = 0.5  # relative difference up to which a circle's deviation in another image counts as the same
MAX_ROUNDS = 10


def outlying_circles(
    cameras: Poses,
    planes: Mapping[str, Rigid],
    images: Sequence[ImageObservations],
    patterns: Mapping[str, Pattern],
    focal_px: float,
) -> tuple[Poses, Poses, list[dict[Label, Note]]]:
    """Finds circles that contradict the others of their group; returns the poses of images and planes adjusted without
    them, the given ones if there are none, and the reasons by label for each image."""
    design = {
        label: (k, *xyz, radius)
        for k, pattern in enumerate(patterns[plane] for plane in planes)
        for label, xyz, radius in zip(pattern.labels, pattern.xyz_mm(), pattern.radius_mm, strict=True)
    }
    seen_in = [(i, *row) for i, o in enumerate(images) for row in zip(o.labels, o.centre, o.sigma_px(), strict=True)]
    table = [(label, i, *design[label], *centre, sigma) for i, label, centre, sigma in seen_in if label in design]
    start, found = (cameras, Poses.of(planes.values())), [{} for _ in images]
    if not table:
        return *start, found
    labels, numbers = [row[0] for row in table], np.array([row[1:] for row in table], float)
    (image, plane), xyz, sigma_px = numbers[:, :2].astype(int).T, numbers[:, 2:5], numbers[:, 8]
    poses = start
    camera_from_plane = cameras[image] @ start[1][plane]
    xyz_camera = camera_from_plane @ xyz
    offset = circle_image_offset(xyz_camera, camera_from_plane.rotation[:, :, 2], numbers[:, 5])
    seen = focal_px * (numbers[:, 6:8] - perspective(offset)[0] + perspective(xyz_camera)[0])  # of the circles' centres
    shown = np.array([len(np.unique(image[plane == p])) for p in range(len(planes))])
    enough = np.bincount(plane)[plane] >= MIN_USUAL
    alone = (shown[plane] == 1) & [label.plane != BOARD for label in labels] & enough
    keep = np.ones(len(labels), bool)
    for _ in range(MAX_ROUNDS):
        if (use := keep & enough).any():
            poses = adjusted_planes(*poses, image[use], plane[use], xyz[use], seen[use], focal_px)
        camera_from_plane = poses[0][image] @ poses[1][plane]
        ideal, by_point = perspective(camera_from_plane @ xyz)
        shift, by_place = seen - focal_px * ideal, focal_px * (by_point @ camera_from_plane.rotation[:, :, :2])
        off_px, limit = np.linalg.norm(shift, axis=1), np.maximum(MIN_LIMIT_PX, BEYOND_SIGMA * sigma_px)
        usual = np.full(len(off_px), np.median(off_px[keep]))
        for p in np.unique(plane[keep & enough]):
            usual[plane == p] = np.median(off_px[keep & (plane == p)])
        limit = np.where(alone, limit, np.maximum(limit, BEYOND * usual))
        outlying, moved_mm = keep & (off_px > limit), np.linalg.solve(by_place, shift[..., None])[..., 0]
        for k in np.flatnonzero(outlying):  # what other images show alike is the design's
            same = keep & (image != image[k]) & [label == labels[k] for label in labels]
            apart_px = np.linalg.norm((moved_mm[same] - moved_mm[k]) @ by_place[k].T, axis=1)
            outlying[k] = not (apart_px < ALIKE * off_px[k]).any()
        if not outlying.any():
            break
        for i, p in {(image[k], plane[k]) for k in np.flatnonzero(outlying)}:  # the worst one alone: it biases others
            own = np.flatnonzero(keep & (image == i) & (plane == p))
            worst = own[np.argmax(np.where(outlying, off_px / limit, 0)[own])]
            reason = f"{off_px[worst]:.3g} px from its place, {limit[worst]:.3g} allowed"
            if alone[worst]:
                reason = f"{labels[worst]} is {reason}, and no other image of the group tells which circles are right"
            for k in own if alone[worst] else [worst]:
                keep[k], found[i][labels[k]] = False, Note(reason, "place")
    return *(start if keep.all() else poses), found


SEARCH = 5.0  # search range about the predicted places, in mean radii of the circles, to each side
COARSE_RADIUS_PX = 2.5  # radius of the circles in the small picture that the common shift is measured in
CORRELATED = 0.3  # smallest significant correlation. Below it the shift is ignored.
LEVEL_PX = 9  # side of the square in the small picture whose mean is subtracted


def measure_near(image: np.ndarray, camera: Camera, predicted: PredictedCircles) -> tuple[tuple[Label, ...], Centres]:
    """Returns the labels and centres of the circles that are found at predicted places in a grey image of any depth."""
    expected = Ellipses(predicted.centre_px, predicted.shape_px, np.ones(len(predicted.labels)))
    _, plane = np.unique([label.plane for label in predicted.labels], return_inverse=True)
    found = measure_centres(image, camera, expected, expected, plane)
    contrast, needed = _contrast(found, predicted.polarity)
    seen = np.flatnonzero(found.ok & (contrast >= needed))
    return tuple(predicted.labels[i] for i in seen.tolist()), found.select(seen)


def common_shift(grey: np.ndarray, predicted: PredictedCircles) -> np.ndarray:
    """Returns the common shift, (2,) px, of the circles of an 8-bit image from their places, to a fraction of a radius,
    by correlation with high-pass filtered discs (Lewis 1995, Fast normalized cross-correlation)."""
    radius = float(np.sqrt(np.linalg.det(predicted.shape_px)).mean() ** 0.5)
    scale = min(1.0, COARSE_RADIUS_PX / radius)
    margin = int(np.ceil(SEARCH * radius * scale))
    extent = np.sqrt((predicted.shape_px**2).sum(2)) + radius
    low = np.floor((predicted.centre_px - extent).min(0)).astype(int)
    high = np.ceil((predicted.centre_px + extent).max(0)).astype(int)
    size = np.ceil((high - low) * scale).astype(int)
    discs = np.zeros(size[::-1], np.float32)
    for place, shape, polarity in zip(predicted.centre_px, predicted.shape_px, predicted.polarity, strict=True):
        half, axes = np.linalg.eigh(scale * shape)
        middle, turn = (place - low + 0.5) * scale - 0.5, float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
        box = (float(middle[0]), float(middle[1])), (2 * float(half[0]), 2 * float(half[1])), turn
        cv2.ellipse(discs, box, 1.0 if polarity == "bright" else -1.0, -1)
    reach = round(margin / scale)
    (left, top), (right, bottom) = (low - reach).tolist(), (low + np.round(size / scale).astype(int) + reach).tolist()
    part = grey[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]  # the edge is replicated outside of it
    beyond = max(-top, 0), max(bottom - len(grey), 0), max(-left, 0), max(right - grey.shape[1], 0)
    part = cv2.copyMakeBorder(part, *beyond, cv2.BORDER_REPLICATE)
    small = cv2.resize(part, tuple((size + 2 * margin).tolist()), interpolation=cv2.INTER_AREA).astype(np.float32)
    small, discs = (each - cv2.blur(each, (LEVEL_PX, LEVEL_PX)) for each in (small, discs))
    correlation = cv2.matchTemplate(small, discs, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    if not correlation[row, column] >= CORRELATED:
        return np.zeros(2)
    return (np.array([column, row]) - margin) / scale
