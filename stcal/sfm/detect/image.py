"""Detection in one image: candidates → board → faces → centres. Decisions that need the group stay open."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

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


@dataclass(frozen=True, slots=True, eq=False)
class ImageReading:
    """Interpretation of the outlines in one image, before their centres are measured."""

    found: dict[Polarity, Ellipses]
    boards: tuple[BoardSighting, ...]  # the one with the most dots first
    free: Ellipses  # the largest ``MAX_FREE`` outlines of the target's polarity outside of boards
    faces: list[FaceSighting]
    unnamed: list[OpenFace]
    mirrored: tuple[str, ...]  # ids of faces
    untried: int = 0  # number of outlines beyond ``MAX_FREE``
    misstated: str = ""  # what of the board's file its dots contradict

    def face_ids(self) -> set[str]:
        """Returns the ids of the named faces."""
        return {each.face for each in self.faces}


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
        readings.append(reading := _read_once(grey, camera, target, board, searched, aside))
        enough = len(reading.face_ids()) >= min(len(target.faces), 1 if board is None else 2)
        if reading.untried or (enough and (board is None or reading.boards)):
            break
    return max(readings, key=lambda each: (len(each.boards) > 0, len(each.face_ids())))


def _read_once(grey, camera, target, board, options, aside) -> ImageReading:
    polarities: set[Polarity] = {target.polarity, board.polarity if board else target.polarity}
    outlines: dict[Polarity, Ellipses] = {p: find_ellipses(grey, p, options) for p in polarities}
    if aside is not None:
        for polarity, found in outlines.items():
            inside = [cv2.pointPolygonTest(aside.astype(np.float32), at, False) > 0 for at in found.centre_px.tolist()]
            outlines[polarity] = found.select(~np.array(inside, bool))
    boards: list[BoardSighting] = []
    misstated = ""
    free = {p: np.ones(len(e), bool) for p, e in outlines.items()}
    if board is not None:
        dots = Candidates.of(outlines[board.polarity], camera)
        sightings = find_boards(dots, board, image_corners(camera))
        misstated = contradiction(dots, board, image_corners(camera), sightings)
        for found in sightings if not misstated else ():
            boards.append(by_rings(found, board, grey, camera, dots.xy) if board.rings else found)
            free[board.polarity][found.rows] = False
    all_free = outlines[target.polarity].select(free[target.polarity])
    ellipses = all_free.select(np.sort(np.argsort(-all_free.radius_px(), kind="stable")[:MAX_FREE]))
    candidates = Candidates.of(ellipses, camera)
    faces, unnamed = find_faces(candidates, target)
    mirrored = find_mirrored(candidates, target, faces)
    return ImageReading(
        outlines, tuple(boards), ellipses, faces, unnamed, mirrored, len(all_free) - len(ellipses), misstated
    )


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
    parts, sightings, board_sightings, first = [detection.centres], [], [*detection.boards], len(detection.centres)
    for face, view in views.items():
        assert view.covariance_px2 is not None, "detectors of boards on faces state σ"
        extent = np.zeros((len(view), 2, 2))
        centre = camera.normalised_from_pixel(view.xy_px)
        parts.append(Centres.without_rims(view.xy_px, centre, extent, view.covariance_px2))
        rows = first + np.arange(len(view))
        if face == BOARD and corners is not None:
            board_sightings.append(BoardSighting(rows, corners.numberings(view.ids)))
        else:
            sightings.append(FaceSighting(face, rows, view.ids))
        first += len(view)
    return replace(
        detection,
        centres=Centres.concatenate(parts),
        boards=tuple(board_sightings),
        printed=tuple(sightings),
        notes=(*detection.notes, *notes),
        candidates=detection.candidates + sum(len(sighting.rows) for sighting in board_sightings),
    )


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
    free, named, refused = reading.free, reading.faces, reading.unnamed
    of_board = board.polarity if board else target.polarity
    patterns: list[_Pattern] = []
    for face in named:
        patterns.append((target.polarity, free, face.rows, face.labels(target.face(face.face)), (face,)))
    for faces in refused:
        rows = np.unique(np.concatenate([face.rows for face in faces]))
        patterns.append((target.polarity, free, rows, [NAMELESS] * len(rows), faces))
    for grid in reading.boards if dots else ():
        patterns.append((of_board, reading.found[of_board], grid.rows, [DOT] * len(grid.rows), (grid,)))
    measured = _measured(grey_fine(image), camera, patterns, reading.found)
    notes = [reading.misstated] if reading.misstated else []
    if reading.untried:
        every, tried = len(free) + reading.untried, f"the {len(free)} largest were tried for faces"
        remedy = "keep fine patterns out of view, or raise --min-diameter"
        notes.append(f"{every} outlines like circles beside the board, {tried}; {remedy}")
    parts, sightings = [NO_CENTRES], []
    for (_, ellipses, rows, names, own), centres in zip(patterns, measured, strict=True):
        for i in np.flatnonzero(~centres.ok).tolist():
            share = f"{100 * centres.rim[i]:.0f} % of its rim follows an ellipse, {100 * MIN_RIM:.0f} % needed"
            why = f"{share}; partly hidden or disturbed, left out"
            if centres.rim[i] >= MIN_RIM:
                why = "σ of its centre is not determined, left out; check the distortion in the camera file"
            notes.append(f"{names[i]}: {why}")
        row = np.full(len(ellipses), -1)
        row[rows[centres.ok]] = sum(map(len, parts)) + np.arange(centres.ok.sum())
        parts.append(centres.select(centres.ok))
        sightings.append(tuple(each.by(row) for each in own))
    first, second = len(named), len(named) + len(refused)
    return ImageDetection(
        Centres.concatenate(parts),
        tuple(face for (face,) in sightings[:first]),
        tuple(grid for (grid,) in sightings[second:]),
        reading.mirrored,
        tuple(notes),
        sum(len(e) for e in reading.found.values()),
        tuple(sightings[first:second]),
    )


_Pattern = tuple[Polarity, Ellipses, np.ndarray, Sequence[Label | str], tuple[FaceSighting | BoardSighting, ...]]
"""Polarity of one face or board, candidates, its rows among them, names for notes, and what it may be."""


def _measured(
    image: np.ndarray, camera: Camera, patterns: list[_Pattern], found: dict[Polarity, Ellipses]
) -> list[Centres]:
    """Returns the centres of each pattern. All patterns of one polarity are measured at once."""
    measured: dict[int, Centres] = {}
    for polarity, every in found.items():
        members = [i for i, pattern in enumerate(patterns) if pattern[0] == polarity]
        if members:
            own = [patterns[i][1].select(patterns[i][2]) for i in members]
            groups = np.repeat(np.arange(len(members)), [len(each) for each in own])
            centres = measure_centres(image, camera, Ellipses.concatenate(own), every, groups)
            measured |= {i: centres.select(groups == k) for k, i in enumerate(members)}
    return [measured[i] for i in range(len(patterns))]


def image_corners(camera: Camera) -> np.ndarray:
    """Returns the corners of the image in order around it, in normalised ideal coordinates, (4, 2)."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return camera.normalised_from_pixel(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
