"""Detection in one image: candidates → board → faces → centres. Decisions that need the group stay open."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

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
from stcal.sfm.detect.circles.candidates import Candidates, EllipseOptions, Ellipses, find_ellipses
from stcal.sfm.detect.circles.centres import MIN_RIM, measure_centres
from stcal.sfm.detect.dot_grid import BoardReading, by_rings, find_boards
from stcal.sfm.detect.face_patterns import FaceFinder, FaceFinding, FaceReading
from stcal.sfm.detect.sightings import BoardSighting, FaceSighting, ImageDetection

NAMELESS, DOT = "a circle of a face without a name", "a board dot"
FAINT = 0.25
"""Share of the required contrast that is used if an image shows too little with the full one."""
MAX_FREE = 400
"""Number of the largest outlines outside of boards that are tried for faces. Photographs have up to 130."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageReading:
    """Interpretation of the outlines in one image, before their centres are measured."""

    found: dict[Polarity, Ellipses]
    boards: tuple[BoardReading, ...]  # the one with the most dots first
    free: Ellipses  # the largest ``MAX_FREE`` outlines of the target's polarity outside of boards
    faces: FaceFinding
    mirrored: tuple[FaceReading, ...]
    untried: int = 0  # number of outlines beyond ``MAX_FREE``

    def face_ids(self) -> set[str]:
        """Returns the ids of the named faces."""
        return {each.face.id for each in self.faces.faces}


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
    reading = _read_once(grey, camera, target, board, options, aside)
    wanted = min(len(target.faces), 1 if board is None else 2)
    short = len(reading.face_ids()) < wanted or (board is not None and not reading.boards)
    if short and not reading.untried:
        faint = replace(options, min_contrast=FAINT * options.min_contrast)
        second = _read_once(grey, camera, target, board, faint, aside)
        return max(reading, second, key=lambda each: (len(each.boards) > 0, len(each.face_ids())))
    return reading


def _read_once(grey, camera, target, board, options, aside) -> ImageReading:
    polarities: set[Polarity] = {target.polarity, board.polarity if board else target.polarity}
    outlines: dict[Polarity, Ellipses] = {p: find_ellipses(grey, p, options) for p in polarities}
    if aside is not None:
        for polarity, found in outlines.items():
            inside = [cv2.pointPolygonTest(aside.astype(np.float32), at, False) > 0 for at in found.centre_px.tolist()]
            outlines[polarity] = found.select(~np.array(inside, bool))
    boards: list[BoardReading] = []
    free = {p: np.ones(len(e), bool) for p, e in outlines.items()}
    if board is not None:
        dots = Candidates.of(outlines[board.polarity], camera)
        for found in find_boards(dots, board, image_corners(camera)):
            boards.append(by_rings(found, board, grey, camera, dots.xy) if board.rings else found)
            free[board.polarity][found.candidates] = False
    all_free = outlines[target.polarity].select(free[target.polarity])
    ellipses = all_free.select(np.sort(np.argsort(-all_free.radius_px(), kind="stable")[:MAX_FREE]))
    finder, candidates = FaceFinder(target), Candidates.of(ellipses, camera)
    faces = finder.find(candidates)
    mirrored = finder.find_mirrored(candidates, faces.faces)
    return ImageReading(outlines, tuple(boards), ellipses, faces, mirrored, len(all_free) - len(ellipses))


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
    detection = ImageDetection(_corners(np.zeros((0, 2)), np.zeros((0, 2, 2)), camera), ())
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
        parts.append(_corners(view.xy_px, view.covariance_px2, camera))
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


def _corners(xy_px: np.ndarray, covariance_px2: np.ndarray, camera: Camera) -> Centres:
    """Returns corners as centres of ellipses without extent."""
    flat, centre = np.zeros((len(xy_px), 2, 2)), camera.normalised_from_pixel(xy_px)
    return Centres.without_rims(xy_px, centre, flat, covariance_px2)


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
    grey, free = grey_fine(image), reading.free
    named, refused, boards = reading.faces.faces, reading.faces.refused, reading.boards if dots else ()
    of_board = board.polarity if board else target.polarity
    used = [np.unique(np.concatenate([reading.used() for reading in nameless])) for nameless in refused]
    patterns: list[_Pattern] = [(target.polarity, free.select(face.used()), face.labels()) for face in named]
    for own in used:
        patterns.append((target.polarity, free.select(own), [NAMELESS] * len(own)))
    for grid in boards:
        patterns.append((of_board, reading.found[of_board].select(grid.candidates), [DOT] * len(grid.candidates)))
    measured = _measured(grey, camera, patterns, reading.found)
    notes: list[str] = []
    if reading.untried:
        every, tried = len(free) + reading.untried, f"the {len(free)} largest were tried for faces"
        remedy = "keep fine patterns out of view, or raise --min-diameter"
        notes.append(f"{every} outlines like circles beside the board, {tried}; {remedy}")
    for (_, _, names), centres in zip(patterns, measured, strict=True):
        for i in np.flatnonzero(~centres.ok).tolist():
            share = f"{100 * centres.rim[i]:.0f} % of its rim follows an ellipse, {100 * MIN_RIM:.0f} % needed"
            why = f"{share}; partly hidden or disturbed, left out"
            if centres.rim[i] >= MIN_RIM:
                why = "σ of its centre is not determined, left out; check the distortion in the camera file"
            notes.append(f"{names[i]}: {why}")
    ends = np.cumsum([0, *(int(centres.ok.sum()) for centres in measured)])
    rows = [(centres.ok, np.arange(*own)) for centres, own in zip(measured, pairwise(ends), strict=True)]
    first, second = len(named), len(named) + len(refused)
    faces, open_faces = [], []
    for face, (ok, own) in zip(named, rows[:first], strict=True):
        faces.append(FaceSighting(face.face.id, own, np.flatnonzero(face.index >= 0)[ok]))
    for nameless, candidates, (ok, own) in zip(refused, used, rows[first:second], strict=True):
        row = np.full(len(free) + 1, -1)  # of each candidate among the centres; −1, as for none, if it is not measured
        row[candidates[ok]] = own
        sightings = []
        for face in nameless:
            circles = np.flatnonzero(row[face.index] >= 0)
            sightings.append(FaceSighting(face.face.id, row[face.index[circles]], circles))
        open_faces.append(tuple(sightings))
    grids = zip(boards, rows[second:], strict=True)
    none = measure_centres(grey, camera, free.select(np.zeros(0, int)), free)
    return ImageDetection(
        Centres.concatenate([none, *(centres.select(np.flatnonzero(centres.ok)) for centres in measured)]),
        tuple(faces),
        tuple(BoardSighting(own, grid.numberings[:, ok], grid.unlikely[:, ok]) for grid, (ok, own) in grids),
        tuple(face.face.id for face in reading.mirrored),
        tuple(notes),
        sum(len(e) for e in reading.found.values()),
        tuple(open_faces),
    )


_Pattern = tuple[Polarity, Ellipses, Sequence[Label | str]]
"""Polarity of one face or board, its ellipses, and their names for notes."""


def _measured(
    image: np.ndarray, camera: Camera, patterns: list[_Pattern], found: dict[Polarity, Ellipses]
) -> list[Centres]:
    """Returns the centres of each pattern. All patterns of one polarity are measured at once."""
    measured: dict[int, Centres] = {}
    for polarity, every in found.items():
        members = [i for i, pattern in enumerate(patterns) if pattern[0] == polarity]
        if members:
            groups = np.repeat(np.arange(len(members)), [len(patterns[i][1]) for i in members])
            together = Ellipses.concatenate([patterns[i][1] for i in members])
            centres = measure_centres(image, camera, together, every, groups)
            measured |= {i: centres.select(np.flatnonzero(groups == k)) for k, i in enumerate(members)}
    return [measured[i] for i in range(len(patterns))]


def image_corners(camera: Camera) -> np.ndarray:
    """Returns the corners of the image in order around it, in normalised ideal coordinates, (4, 2)."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return camera.normalised_from_pixel(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
