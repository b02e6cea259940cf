"""One image: candidates → board → faces → centres. What only the group can decide stays open."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.camera import Camera
from stcal.io.images import grey_8bit, grey_fine
from stcal.labels import Label
from stcal.sfm.data.centres import Centres
from stcal.sfm.detect.board import BoardReading, find_boards
from stcal.sfm.detect.circles.candidates import Candidates
from stcal.sfm.detect.circles.centres import measure_centres
from stcal.sfm.detect.circles.ellipses import EllipseOptions, Ellipses, find_ellipses
from stcal.sfm.detect.faces import FaceFinder, FaceFinding, FaceReading
from stcal.sfm.detect.sightings import BoardSighting, FaceSighting, ImageDetection

NAMELESS, DOT = "a circle of a face without a name", "a board dot"
FAINT = 0.25
"""Of the contrast asked for, where an image shows too little with that."""
MAX_FREE = 400
"""Outlines beside the boards that are tried for faces, the largest: photographs have up to 130, and time and memory
grow with each; a fine checkerboard has tens of thousands."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageReading:
    """What the outlines in one image were read as, before their centres are measured.

    ``found`` : all outlines by polarity; ``boards`` : the one with the most dots first; ``free`` : the target's
    outlines that are no board's, the largest ``MAX_FREE``; ``faces`` : what they were read as; ``mirrored`` : faces
    seen as in a mirror; ``untried`` : outlines that are too many.
    """

    found: dict[Polarity, Ellipses]
    boards: tuple[BoardReading, ...]
    free: Ellipses
    faces: FaceFinding
    mirrored: tuple[FaceReading, ...]
    untried: int = 0

    def face_ids(self) -> set[str]:
        """Faces that are named."""
        return {each.face.id for each in self.faces.faces}


def read_image(
    grey: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageReading:
    """Find the outlines of one polarity or both in an 8-bit image, and the boards and the faces among them.

    Where that leaves the board or the faces unnamed that an image of a group is to show, fainter outlines are let in.
    """
    reading = _read_once(grey, camera, target, board, options)
    wanted = min(len(target.faces), 1 if board is None else 2)
    short = len(reading.face_ids()) < wanted or (board is not None and not reading.boards)
    if short and not reading.untried:
        faint = replace(options, min_contrast=FAINT * options.min_contrast)
        again = _read_once(grey, camera, target, board, faint)
        better = (len(again.boards) > 0, len(again.face_ids())) > (len(reading.boards) > 0, len(reading.face_ids()))
        return again if better else reading
    return reading


def _read_once(
    grey: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageReading:
    polarities: set[Polarity] = {target.polarity, board.polarity if board else target.polarity}
    found: dict[Polarity, Ellipses] = {p: find_ellipses(grey, p, options) for p in polarities}
    boards: list[BoardReading] = []
    free = {p: np.ones(len(e), bool) for p, e in found.items()}
    if board is not None:
        boards = find_boards(Candidates.of(found[board.polarity], camera), board, image_corners(camera))
        for each in boards:
            free[board.polarity][each.candidates] = False
    every = found[target.polarity].select(free[target.polarity])
    ellipses = every.select(np.sort(np.argsort(-every.radius_px(), kind="stable")[:MAX_FREE]))
    finder, candidates = FaceFinder(target), Candidates.of(ellipses, camera)
    faces = finder.find(candidates)
    mirrored = finder.find_mirrored(candidates, faces.faces)
    return ImageReading(found, tuple(boards), ellipses, faces, mirrored, len(every) - len(ellipses))


def detect_image(
    image: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageDetection:
    """Find and measure all circles of the target and the board in one grey image of the camera's size."""
    reading = read_image(grey_8bit(image), camera, target, board, options)
    scaled = grey_fine(image)
    named, refused, boards = reading.faces.faces, reading.faces.refused, reading.boards
    of_board = board.polarity if board else target.polarity
    free, dots = reading.free, reading.found[of_board]
    patterns = [_Pattern(target.polarity, free.select(each.used()), each.labels()) for each in named]
    patterns += [_Pattern(target.polarity, free.select(own := each.used()), [NAMELESS] * len(own)) for each in refused]
    patterns += [_Pattern(of_board, dots.select(own := each.candidates), [DOT] * len(own)) for each in boards]
    measured = _measured(scaled, camera, patterns, reading.found)
    notes = [_untried_note(reading)] if reading.untried else []
    for pattern, centres in zip(patterns, measured, strict=True):
        notes += [_rim_note(pattern.names[i], centres.rim[i]) for i in np.flatnonzero(~centres.ok).tolist()]
    ends = np.cumsum([0, *(int(centres.ok.sum()) for centres in measured)])
    seen = [(centres.ok, np.arange(*rows)) for centres, rows in zip(measured, pairwise(ends), strict=True)]
    first, second = len(named), len(named) + len(refused)
    faces, open_faces, board_sightings = [], [], []
    for each, (ok, rows) in zip(named, seen[:first], strict=True):
        faces.append(FaceSighting(each.face.id, rows, np.flatnonzero(each.index >= 0)[ok]))
    for each, (ok, rows) in zip(refused, seen[first:second], strict=True):
        row = np.full(len(reading.free), -1)
        row[each.used()[ok]] = rows
        open_faces.append(tuple(_sighting(own, row) for own in each.readings))
    for each, (ok, rows) in zip(boards, seen[second:], strict=True):
        board_sightings.append(BoardSighting(rows, each.numberings[:, ok], each.unlikely[:, ok]))
    return ImageDetection(
        Centres.concatenate(
            [centres.select(np.flatnonzero(centres.ok)) for centres in measured] or [_nothing(scaled, camera, free)]
        ),
        tuple(faces),
        tuple(board_sightings),
        tuple(each.face.id for each in reading.mirrored),
        tuple(notes),
        sum(len(e) for e in reading.found.values()),
        tuple(open_faces),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Pattern:
    """Ellipses that belong together, what they are, and their names for notes."""

    polarity: Polarity
    ellipses: Ellipses
    names: Sequence[Label | str]


def _measured(
    image: np.ndarray, camera: Camera, patterns: list[_Pattern], found: dict[Polarity, Ellipses]
) -> list[Centres]:
    """The centres of each pattern, all of one polarity measured at once."""
    measured: dict[int, Centres] = {}
    for polarity, every in found.items():
        own = [i for i, pattern in enumerate(patterns) if pattern.polarity == polarity]
        if not own:
            continue
        groups = np.repeat(np.arange(len(own)), [len(patterns[i].ellipses) for i in own])
        together = Ellipses.concatenate([patterns[i].ellipses for i in own])
        centres = measure_centres(image, camera, together, every, groups)
        measured |= {i: centres.select(np.flatnonzero(groups == k)) for k, i in enumerate(own)}
    return [measured[i] for i in range(len(patterns))]


def _sighting(reading: FaceReading, row: np.ndarray) -> FaceSighting:
    """``row`` : of each candidate among the centres, −1 where it was not measured."""
    rows = np.where(reading.index >= 0, row[reading.index], -1)
    circles = np.flatnonzero(rows >= 0)
    return FaceSighting(reading.face.id, rows[circles], circles)


def _nothing(image: np.ndarray, camera: Camera, ellipses: Ellipses) -> Centres:
    return measure_centres(image, camera, ellipses.select(np.zeros(0, int)), ellipses)


def _rim_note(label: Label | str, rim: float) -> str:
    return (
        f"{label}: {100 * rim:.0f} % of its rim follows an ellipse, 80 % needed; partly hidden or disturbed, left out"
    )


def _untried_note(reading: ImageReading) -> str:
    tried = len(reading.free)
    return (
        f"{tried + reading.untried} outlines like circles beside the board, the {tried} largest "
        "were tried for faces; keep fine patterns out of view, or raise --min-diameter"
    )


def image_corners(camera: Camera) -> np.ndarray:
    """Corners of the image, around it, in normalised ideal coordinates."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return camera.normalised_from_pixel(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
