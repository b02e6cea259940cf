"""Detection by the rules of Zhang & Wei (2017), §1.2: threshold, two tests of ellipses, names by directions.

It is for comparison. The rules need a whole pattern of ten circles in view, and name a face by scalar and vector
products in the image, which perspective distorts. A note states each pattern that they miss, with the measured values.
A pattern that they misname keeps the name that its own plane gives it, also with a note.

Details that the document leaves open are decided here. The threshold is Otsu's, one for the image. "= 0" means within
half of the 45° to the next name. Distances are measured in radii of the circle that they start from. The board, which
§1.2 does not mention, is found as everywhere in this package.
"""

from dataclasses import replace

import cv2
import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.errors import DegenerateError, InputError
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography
from stcal.io.images import grey_8bit
from stcal.sfm.data.group_model import Centres
from stcal.sfm.detect.candidates import (
    Candidates,
    EllipseOptions,
    Ellipses,
    FaceSighting,
    ImageDetection,
    contrast_threshold,
    diameter_limits_px,
    distinct,
    outline_area,
    outlines,
)
from stcal.sfm.detect.dot_grid import find_boards
from stcal.sfm.detect.image import image_corners

SMOOTHING_PX = 5  # side of the Gaussian filter, px
EQUAL_SIGMA_PX = 0.05  # σ of every centre. Its value does not matter, as it is equal for all.
MIN_OUTLINE_PX = 6
AREA_RATIO = 2.0  # largest ratio of areas of equal circles in one pattern, due to perspective
STEP_RATIO = 1.4  # largest ratio of distances between neighbouring circles, due to perspective
ZERO_COSINE = float(np.sin(np.radians(22.5)))
"""Largest cosine of directions that count as perpendicular: half way to those 45° off."""
SAME_SIZE = 0.75  # least radius of a large or a small circle, as a share of the largest; small ones have no more
MAX_MISFIT = 0.25  # largest distance of a circle from its place in the face's plane, in radii


CIRCLES = [*"1234567abc"]
LINES = ("2", "3"), ("4", "5"), ("6", "7")
"""Large circles along X, Y and the diagonal from circle 1 on. Small are a and b, beside circle 1 in X and Y, and c,
beside circle 7, whose direction names the face."""


class PublishedPattern:
    """Pattern of the published rules: sizes, and names of faces; an error if the design has another form."""

    def __init__(self, target: TargetDesign):
        if not (target.faces and all(sorted(f.ids) == CIRCLES for f in target.faces) and self._read(target)):
            fault = f"target {target.name}: its circles are not 1 to 7, a, b, c of Zhang & Wei (2017) in place and size"
            raise InputError("E-TARGET-NOT-PUBLISHED", f"{fault}, which --solve paper needs; use joint or chain")

    def _read(self, target: TargetDesign) -> bool:
        """Reads sizes and names; returns whether the circles lie as published."""
        radii = np.array([[face.radius_mm[face.ids.index(i)] for i in CIRCLES] for face in target.faces])
        radius, large, small = dict(zip(CIRCLES, radii[0].tolist(), strict=True)), radii[:, :7], radii[:, 7:]
        xy = np.array([face.places_mm(CIRCLES)[:, :2] for face in target.faces])
        along, step = xy[0, 1:7].max(1), xy[0, 7, 0]  # of circles 2 to 7 from circle 1, and of a
        ways = np.repeat([[1, 0], [0, 1], [1, 1]], 2, axis=0)
        published = np.vstack([[0, 0], along[:, None] * ways, [step, 0], [0, step]])
        directions = xy[:, 9] - xy[:, 6]
        distances = np.linalg.norm(directions, axis=1)
        # circles along X, Y and the diagonal from circle 1 on: (id, distance in steps)
        pairs = zip(LINES, (along / step).reshape(3, 2).tolist(), strict=True)
        self.lines = [sorted(zip(*line, strict=True), key=lambda each: each[1]) for line in pairs]
        self.step_radii = step / radius["1"]  # distance from circle 1 to a in radii of circle 1
        self.c_radii = distances[0] / radius["7"]
        self.small = (radius["a"] / radius["1"]) ** 2  # ratio of the areas of small and large circles
        # face id by (sign of the scalar, of the vector product) of the direction of c with the diagonal
        self.names = {_signs(way, np.ones(2)): face.id for way, face in zip(directions, target.faces, strict=True)}
        is_told_apart = len(self.names) == len(target.faces) and np.allclose(distances, distances[0], rtol=0.05)
        is_alike = all(each.min() > SAME_SIZE * each.max() for each in (large, small))
        is_told_apart &= is_alike and small.max() <= SAME_SIZE * large.max()
        return is_told_apart and along.min() > step and np.allclose(xy[:, :9], published, atol=0.01 * step)


def _signs(direction: np.ndarray, diagonal: np.ndarray) -> tuple[int, int]:
    """Returns the signs of the scalar product and, unless that is zero, of the vector product with the diagonal."""
    cosine = direction @ diagonal / (np.linalg.norm(direction) * np.linalg.norm(diagonal))
    if abs(cosine) < ZERO_COSINE:
        return 0, 0
    return int(np.sign(cosine)), int(np.sign(diagonal[0] * direction[1] - diagonal[1] * direction[0]))


def detect_published(
    image: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageDetection:
    """Finds all circles of the target and the board in one grey image by the published rules, all with the same σ.
    Diameters and axis ratio in ``options`` are the rules' two tests."""
    pattern = PublishedPattern(target)
    grey = cv2.GaussianBlur(grey_8bit(image), (SMOOTHING_PX, SMOOTHING_PX), 0)
    polarities: set[Polarity] = {target.polarity, board.polarity if board else target.polarity}
    first, centres, candidates, boards, free = {}, [], {}, [], {}
    for polarity in sorted(polarities):
        every = contour_ellipses(grey, polarity, options)
        own = candidates[polarity] = Candidates(every, camera)
        first[polarity], free[polarity] = sum(map(len, centres)), np.ones(len(every), bool)
        equal = np.broadcast_to(EQUAL_SIGMA_PX**2 * np.eye(2), (len(every), 2, 2))
        centres.append(Centres.without_rims(every.centre_px, own.xy, own.shape, equal, every.contrast))
    if board is not None:
        for grid in find_boards(candidates[board.polarity], board, image_corners(camera)):
            boards.append(replace(grid, rows=first[board.polarity] + grid.rows))
            free[board.polarity][grid.rows] = False
    together = Centres.concatenate(centres)
    own, start = target.polarity, first[target.polarity]
    faces, notes = _Rules(pattern, target, candidates[own], together.centre_px[start:]).find(free[own])
    sightings = tuple(replace(face, rows=start + face.rows) for face in faces)
    return ImageDetection(together, sightings, tuple(boards), notes=tuple(notes), candidates=len(together))


def contour_ellipses(grey: np.ndarray, polarity: Polarity, options: EllipseOptions) -> Ellipses:
    """Returns ellipses fitted to contours after thresholding, selected by pixel count and axis ratio."""
    kind = cv2.THRESH_BINARY if polarity == "bright" else cv2.THRESH_BINARY_INV
    level, mask = cv2.threshold(grey, 0, 255, kind + cv2.THRESH_OTSU)
    smallest, largest = (np.pi / 4 * d**2 for d in diameter_limits_px(grey.size, options))
    rows = []
    for contour in outlines(mask) if grey.min() <= level < grey.max() else []:
        if len(contour) < MIN_OUTLINE_PX or not smallest <= outline_area(contour) <= largest:
            continue
        (x, y), (d1, d2), angle_deg = cv2.fitEllipse(contour)
        if np.isfinite([x, y, d1, d2]).all() and min(d1, d2) >= options.min_axis_ratio * max(d1, d2) > 0:
            rows.append((x, y, d1 + 1, d2 + 1, angle_deg))  # a contour runs through the outermost pixels' centres
    return distinct(grey, polarity, np.array(rows).reshape(-1, 5), contrast_threshold(grey, options))


class _Rules:
    """§1.2 (3) on the ellipses of one image; directions are taken in the image without its distortion."""

    def __init__(self, pattern: PublishedPattern, target: TargetDesign, found: Candidates, centre_px: np.ndarray):
        self.pattern, self.target, self.found, self.centre_px = pattern, target, found, centre_px
        self.area = found.radius**2

    def find(self, free: np.ndarray) -> tuple[list[FaceSighting], list[str]]:
        """Returns the faces among the ``free`` candidates, and notes on rejected patterns."""
        faces, notes = [], []
        for origin in np.argsort(-self.area, kind="stable").tolist():
            if not free[origin]:
                continue
            beside = self._beside(origin, self.pattern.step_radii, free)
            if len(beside) != 2:
                continue
            if np.linalg.det(self.found.xy[beside] - self.found.xy[origin]) > 0:  # the image's y points down
                beside.reverse()
            circles = {"1": origin, "a": beside[0], "b": beside[1]}
            where = "a pattern about ({:.0f}, {:.0f}) px".format(*self.centre_px[origin])
            named = self._walk(circles, free) or self._name(circles, free)
            if isinstance(named, str):
                notes.append(f"{where}: {named}; left out by the published rules")
                continue
            face, note = named
            free[face.rows] = False
            faces.append(face)
            notes += [f"{where}: {note}"] if note else []
        return faces, notes

    def _beside(self, centre: int, radii: float, free: np.ndarray) -> list[int]:
        """Returns the small circles at the given distance from a large one, in its radii."""
        off = (self.found.xy - self.found.xy[centre]).T
        away = np.linalg.norm(np.linalg.solve(self.found.shape[centre], off), axis=0)
        size = self.area / (self.pattern.small * self.area[centre])
        near = (away > radii / STEP_RATIO) & (away < radii * STEP_RATIO)
        alike = (size > 1 / AREA_RATIO) & (size < AREA_RATIO)
        return np.flatnonzero(free & near & alike).tolist()

    def _walk(self, circles: dict[str, int], free: np.ndarray) -> str:
        """Labels the large circles along the three directions; returns the reason if one is missing, else ""."""
        origin = circles["1"]
        off = self.found.xy - self.found.xy[origin]
        step_x, step_y = off[circles["a"]], off[circles["b"]]
        size = self.area / self.area[origin]
        large = free & (size > 1 / AREA_RATIO) & (size < AREA_RATIO)
        large[origin] = False
        for line, step in zip(self.pattern.lines, (step_x, step_y, step_x + step_y), strict=True):
            direction, on_line = step / np.linalg.norm(step), [origin]
            for circle, steps in line:
                across = np.abs(off @ [-direction[1], direction[0]])
                relative_steps = off @ direction / (steps * np.linalg.norm(step))
                near = (relative_steps > 1 / STEP_RATIO) & (relative_steps < STEP_RATIO)
                rows = np.flatnonzero(large & (across < self.found.radius) & near)
                if not len(rows):
                    return f"circle {circle} not found in its direction"
                circles[circle] = int(rows[np.argmin(np.abs(relative_steps[rows] - 1))])
                on_line.append(circles[circle])
                direction = _fitted_direction(self.found.xy[on_line], direction)
        return ""

    def _name(self, circles: dict[str, int], free: np.ndarray) -> str | tuple[FaceSighting, str]:
        """Returns the face named by circle c, and a note; or why there is none."""
        pattern = self.pattern
        last = circles["7"]
        beside = [i for i in self._beside(last, pattern.c_radii, free) if i not in circles.values()]
        if len(beside) != 1:
            return f"{len(beside)} small circles beside circle 7, 1 needed"
        on_diagonal = self.found.xy[[circles[circle] for circle in "167"]]
        diagonal = _fitted_direction(on_diagonal, on_diagonal[-1] - on_diagonal[0])
        direction = self.found.xy[beside[0]] - self.found.xy[last]
        flip = np.array([1.0, -1.0])  # the image's y points down
        published = pattern.names.get(_signs(flip * direction, flip * diagonal))
        placed = self._placed(circles, beside[0])
        if isinstance(placed, str):
            return placed
        places = [face.xy_mm[face.ids.index("c")] for face in self.target.faces]
        face = self.target.faces[int(np.linalg.norm(places - placed, axis=1).argmin())]
        rows = np.array([{**circles, "c": beside[0]}[circle] for circle in face.ids])
        sighting = FaceSighting(face.id, rows, np.arange(len(rows)))
        if published == face.id:
            return sighting, ""
        cosine = direction @ diagonal / np.linalg.norm(direction)
        said = f"(cosine {cosine:+.2f}) say {f'face {published}' if published else 'no face'}"
        broken = f"perspective breaks the published name: the products in the image {said}, its own plane says"
        return sighting, f"{broken} face {face.id}, which was taken"

    def _placed(self, circles: dict[str, int], c: int) -> np.ndarray | str:
        """Returns circle c in the plane of the face, mm, or the reason why the others are no face."""
        face = self.target.faces[0]
        common = [i for i, circle in enumerate(face.ids) if circle in circles]
        xy = self.found.xy[[circles[face.ids[i]] for i in common]]
        try:
            plane = fit_homography(xy, face.xy_mm[common])
        except DegenerateError:
            return "its circles lie in one line"
        off = np.linalg.norm(apply_homography(plane, xy) - face.xy_mm[common], axis=1) / face.radius_mm[common]
        worst = int(np.argmax(off))
        if off[worst] > MAX_MISFIT:
            circle = face.ids[common[worst]]
            return f"circle {circle} lies {off[worst]:.2f} radii off in the plane of the others, {MAX_MISFIT:g} allowed"
        return apply_homography(plane, self.found.xy[[c]])[0]


def _fitted_direction(xy: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Returns the unit direction of the line fitted to points."""
    way = np.linalg.svd(xy - xy.mean(0))[2][0]
    return way if way @ towards > 0 else -way
