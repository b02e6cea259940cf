"""Detection in one image: candidates → board → faces → centres. Decisions that need the group stay open."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from stcal.boards.board_designs import CornerBoard
from stcal.boards.finders import find_on_faces
from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography
from stcal.io.images import grey_8bit, grey_fine, require_grey
from stcal.labels import BOARD, Label
from stcal.sfm.data.group_model import Centres
from stcal.sfm.detect.candidates import (
    BoardSighting,
    Candidates,
    EllipseOptions,
    Ellipses,
    FaceSighting,
    ImageDetection,
    OpenFace,
    find_ellipses,
)
from stcal.sfm.detect.centres import MIN_RIM, measure_centres
from stcal.sfm.detect.dot_grid import by_rings, contradiction, find_boards
from stcal.sfm.detect.face_patterns import find_faces, find_mirrored

NAMELESS, DOT = "a circle of a face without a name", "a board dot"
NO_CENTRES = Centres.without_rims(*np.zeros((2, 0, 2)), *np.zeros((2, 0, 2, 2)))
FAINT = 0.25  # share of the required contrast that is used if an image shows too little with the full one
MAX_FREE = 400  # number of the largest outlines outside of boards that are tried for faces. Photographs have up to 130.


class ImageReading:
    """Interpretation of the outlines in one 8-bit image, before their centres are measured; as :func:`read_image`."""

    def __init__(
        self,
        grey: np.ndarray,
        camera: Camera,
        target: TargetDesign,
        board: BoardDesign | None,
        options: EllipseOptions,
        aside: np.ndarray | None,
    ):
        polarities: set[Polarity] = {target.polarity, board.polarity if board else target.polarity}
        self.found: dict[Polarity, Ellipses] = {p: find_ellipses(grey, p, options) for p in polarities}
        if aside is not None:
            area = aside.astype(np.float32)
            for polarity, every in self.found.items():
                inside = [cv2.pointPolygonTest(area, at, False) > 0 for at in every.centre_px.tolist()]
                self.found[polarity] = every.select(~np.array(inside, bool))
        self.boards: list[BoardSighting] = []  # the one with the most dots first
        self.misstated = ""  # what of the board's file its dots contradict
        is_free = {p: np.ones(len(e), bool) for p, e in self.found.items()}
        if board is not None:
            dots = Candidates(self.found[board.polarity], camera)
            sightings = find_boards(dots, board, image_corners(camera))
            self.misstated = contradiction(dots, board, image_corners(camera), sightings)
            for grid in sightings if not self.misstated else ():
                self.boards.append(by_rings(grid, board, grey, camera, dots.xy) if board.rings else grid)
                is_free[board.polarity][grid.rows] = False
        every, free = self.found[target.polarity], np.flatnonzero(is_free[target.polarity])
        tried = free[np.sort(np.argsort(-every.radius_px()[free], kind="stable")[:MAX_FREE])]
        candidates = Candidates(every.select(tried), camera)
        named, unnamed = find_faces(candidates, target)
        self.mirrored = find_mirrored(candidates, target, named)  # ids of faces
        self.faces, self.face_ids = [face.by(tried) for face in named], {face.face for face in named}
        self.unnamed: list[OpenFace] = [tuple(face.by(tried) for face in faces) for faces in unnamed]
        self.free = len(free)  # number of outlines of the target's polarity outside of boards


def read_image(
    grey: np.ndarray,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    aside: np.ndarray | None = None,
) -> ImageReading:
    """Finds outlines in an 8-bit image, and boards and faces among them; fainter outlines if too few are recognised.
    ``aside``: (k, 2) px, polygon whose outlines are left out."""
    readings: list[ImageReading] = []
    for share in (1.0, FAINT):
        searched = replace(options, min_contrast=share * options.min_contrast)
        readings.append(reading := ImageReading(grey, camera, target, board, searched, aside))
        enough = len(reading.face_ids) >= min(len(target.faces), 1 if board is None else 2)
        if reading.free > MAX_FREE or (enough and (board is None or reading.boards)):
            break
    return max(readings, key=lambda each: (len(each.boards) > 0, len(each.face_ids)))


def detect_target(
    image: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageDetection:
    """Does as :func:`detect_image`, but only sets the dots of the board aside: they take half of the time."""
    return detect_image(image, camera, target, board, options, dots=False)


def detect_image(
    image: np.ndarray,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    dots: bool = True,
) -> ImageDetection:
    """Finds and measures all points of the target and the board in one grey image of 8 or 16 bits. Circles are searched
    outside of a board of corners; corners are used as found."""
    require_grey(image, (camera.width, camera.height))
    image = np.ascontiguousarray(image)
    circles, printed = target.with_faces(printed=False), target.with_faces(printed=True)
    corners = board if isinstance(board, CornerBoard) else None
    if not printed.faces and corners is None:
        return _detect_circles(image, camera, target, board, options, dots=dots)
    boards = {face.id: face.printed for face in printed.faces} | ({} if corners is None else {BOARD: corners.printed})
    views, notes = find_on_faces(image, "", boards, camera)  # type: ignore[arg-type]
    detection = ImageDetection(NO_CENTRES, ())
    if circles.faces or (board is not None and corners is None):
        aside = None
        if corners is not None and BOARD in views:  # circles are searched outside of the board and a step about it
            xy, view = corners.xy_mm(), views[BOARD]
            (x0, y0), (x1, y1) = xy.min(0) - corners.pitch_mm, xy.max(0) + corners.pitch_mm
            image_from_board = fit_homography(view.xyz_board[:, :2], view.xy_px)
            aside = apply_homography(image_from_board, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
        detection = _detect_circles(image, camera, circles, None if corners else board, options, aside, dots)
    parts, sightings, board_sightings = [detection.centres], [], [*detection.boards]
    for face, view in views.items():
        assert view.covariance_px2 is not None, "detectors of boards on faces state σ"
        extent = np.zeros((len(view), 2, 2))
        centre = camera.normalised_from_pixel(view.xy_px)
        rows = sum(map(len, parts)) + np.arange(len(view))
        parts.append(Centres.without_rims(view.xy_px, centre, extent, view.covariance_px2))
        if face == BOARD and corners is not None:
            board_sightings.append(BoardSighting(rows, corners.numberings(view.ids)))
        else:
            sightings.append(FaceSighting(face, rows, view.ids))
    candidates = detection.candidates + sum(len(sighting.rows) for sighting in board_sightings)
    detection = replace(detection, centres=Centres.concatenate(parts), candidates=candidates)
    found = {"boards": tuple(board_sightings), "printed": tuple(sightings)}
    return replace(detection, notes=(*detection.notes, *notes), **found)


def _detect_circles(
    image: np.ndarray,
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    aside: np.ndarray | None = None,
    dots: bool = True,
) -> ImageDetection:
    """Finds and measures all circles of the target and, with ``dots``, the board outside of the polygon ``aside``."""
    reading = read_image(grey_8bit(image), camera, target, board, options, aside)
    of_board = board.polarity if board else target.polarity
    # Polarity of a face or board, its rows among the outlines, names for notes, and what it may be.
    patterns: list[tuple[Polarity, np.ndarray, Sequence[Label | str], Sequence[FaceSighting | BoardSighting]]] = []
    for face in reading.faces:
        patterns.append((target.polarity, face.rows, face.labels(target.face(face.face)), (face,)))
    for faces in reading.unnamed:
        rows = np.unique(np.concatenate([face.rows for face in faces]))
        patterns.append((target.polarity, rows, [NAMELESS] * len(rows), faces))
    for grid in reading.boards if dots else ():
        patterns.append((of_board, grid.rows, [DOT] * len(grid.rows), (grid,)))
    fine, measured = grey_fine(image), []
    polarities: dict[Polarity, None] = dict.fromkeys(pattern[0] for pattern in patterns)
    for polarity in polarities:  # all patterns of one polarity at once
        own, every = [pattern[1] for pattern in patterns if pattern[0] == polarity], reading.found[polarity]
        groups = np.repeat(np.arange(len(own)), [len(rows) for rows in own])
        centres = measure_centres(fine, camera, every.select(np.concatenate(own)), every, groups)
        measured += [centres.select(groups == k) for k in range(len(own))]
    notes = [reading.misstated] if reading.misstated else []
    if reading.free > MAX_FREE:
        tried = f"the {MAX_FREE} largest were tried for faces"
        remedy = "keep fine patterns out of view, or raise --min-diameter"
        notes.append(f"{reading.free} outlines like circles beside the board, {tried}; {remedy}")
    parts, sightings = [NO_CENTRES], []
    for (polarity, rows, names, own), centres in zip(patterns, measured, strict=True):
        for i in np.flatnonzero(~centres.ok).tolist():
            share = f"{100 * centres.rim[i]:.0f} % of its rim follows an ellipse, {100 * MIN_RIM:.0f} % needed"
            why = f"{share}; partly hidden or disturbed, left out"
            if centres.rim[i] >= MIN_RIM:
                why = "σ of its centre is not determined, left out; check the distortion in the camera file"
            notes.append(f"{names[i]}: {why}")
        row = np.full(len(reading.found[polarity]), -1)
        row[rows[centres.ok]] = sum(map(len, parts)) + np.arange(centres.ok.sum())
        parts.append(centres.select(centres.ok))
        sightings.append(tuple(each.by(row) for each in own))
    first, second = len(reading.faces), len(reading.faces) + len(reading.unnamed)
    named, unnamed, grids = sightings[:first], sightings[first:second], sightings[second:]
    faces, boards = (tuple(each for (each,) in alone) for alone in (named, grids))
    outlines = sum(map(len, reading.found.values()))
    seen = faces, boards, reading.mirrored, tuple(notes), outlines, tuple(unnamed)
    return ImageDetection(Centres.concatenate(parts), *seen)


def image_corners(camera: Camera) -> np.ndarray:
    """Returns the corners of the image in order around it, in normalised ideal coordinates, (4, 2)."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return camera.normalised_from_pixel(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
