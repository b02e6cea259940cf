"""One image: candidates → board → faces → centres. What only the group can decide stays open."""

from dataclasses import dataclass, field

import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.camera import Camera
from stcal.io.images import grey_8bit, grey_fine
from stcal.labels import CircleLabel
from stcal.sfm.detect.board import BoardReading, find_boards
from stcal.sfm.detect.candidates import Candidates
from stcal.sfm.detect.centres import Centres, measure_centres
from stcal.sfm.detect.ellipses import EllipseOptions, Ellipses, find_ellipses
from stcal.sfm.detect.faces import MAX_CONTRAST_RATIO, FaceFinder, FaceFinding

SECOND_BOARD_SHARE = 0.8
"""A second board is one with at least this share of the dots of the first."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageDetection:
    """What one image shows.

    ``centres`` : the measured circles, n = t + b of them, the target's first;
    ``target_labels`` : (t,) their labels;
    ``numberings`` : (k, b, 2) row and column of the board's dots in each of the k numberings that the image admits,
    k = 0 without a board;
    ``notes`` : what was seen and left out, and why; ``repeated`` : what is in view more than once.
    """

    centres: Centres
    target_labels: tuple[CircleLabel, ...]
    numberings: np.ndarray
    notes: tuple[str, ...] = ()
    repeated: tuple[str, ...] = ()
    candidates: int = field(default=0)

    def face_ids(self) -> list[str]:
        """Faces seen, in order of their labels."""
        return list(dict.fromkeys(label.face for label in self.target_labels))


@dataclass(frozen=True, slots=True, eq=False)
class ImageReading:
    """What the outlines in one image were read as, before their centres are measured.

    ``found`` : all outlines by polarity; ``board`` : the one board, if any; ``free`` : the target's outlines that are
    no board's; ``faces`` : what they were read as; ``repeated`` : what is in view more than once.
    """

    found: dict[Polarity, Ellipses]
    board: BoardReading | None
    free: Ellipses
    faces: FaceFinding
    repeated: tuple[str, ...]


def read_image(
    grey: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageReading:
    """Find the outlines of one polarity or both in an 8-bit image, and the board and the faces among them."""
    polarities: set[Polarity] = {target.polarity, board.polarity if board else target.polarity}
    found: dict[Polarity, Ellipses] = {p: find_ellipses(grey, p, options) for p in polarities}
    repeated: list[str] = []
    reading = None
    free = {p: np.ones(len(e), bool) for p, e in found.items()}
    if board is not None:
        ellipses = found[board.polarity]
        boards = find_boards(Candidates.of(ellipses, camera), board, _corners(camera))
        boards.sort(key=lambda r: -float(np.median(ellipses.contrast[r.candidates])))
        contrast = [float(np.median(ellipses.contrast[r.candidates])) for r in boards]
        ambiguous = [
            r
            for r, c in zip(boards[1:], contrast[1:], strict=True)
            if len(r.candidates) >= SECOND_BOARD_SHARE * len(boards[0].candidates)
            and c * MAX_CONTRAST_RATIO > contrast[0]
        ]
        if ambiguous:
            repeated.append("board")
        elif boards:
            reading = boards[0]
        for each in boards:
            free[board.polarity][each.candidates] = False
    ellipses = found[target.polarity].select(free[target.polarity])
    bright = 0.0
    if board is not None and reading is not None and board.polarity == target.polarity:
        bright = float(np.median(found[board.polarity].contrast[reading.candidates]))
    faces = FaceFinder(target).find(Candidates.of(ellipses, camera), bright)
    repeated += [f"face {face_id}" for face_id in faces.repeated]
    return ImageReading(found, reading, ellipses, faces, tuple(repeated))


def detect_image(
    image: np.ndarray, camera: Camera, target: TargetDesign, board: BoardDesign | None, options: EllipseOptions
) -> ImageDetection:
    """Find and measure all circles of the target and the board in one grey image of the camera's size."""
    reading = read_image(grey_8bit(image), camera, target, board, options)
    scaled = grey_fine(image)
    faces = reading.faces.faces
    notes = list(reading.faces.notes)
    labels = [label for face in faces for label, i in zip(face.face.labels(), face.index, strict=True) if i >= 0]
    used = np.concatenate([face.used() for face in faces]) if faces else np.zeros(0, int)
    target_centres = measure_centres(scaled, camera, reading.free.select(used), reading.found[target.polarity])
    notes += [_rim_note(label, c) for label, c, ok in _rows(labels, target_centres) if not ok]
    kept = np.flatnonzero(target_centres.ok)
    parts = [target_centres.select(kept)]
    numberings = np.zeros((0, 0, 2), int)
    if board is not None and reading.board is not None:
        found = reading.found[board.polarity]
        dots = measure_centres(scaled, camera, found.select(reading.board.candidates), found)
        notes += [_rim_note("a board dot", rim) for _, rim, ok in _rows(range(len(dots)), dots) if not ok]
        parts.append(dots.select(np.flatnonzero(dots.ok)))
        numberings = reading.board.numberings[:, dots.ok]
    return ImageDetection(
        Centres.concatenate(parts),
        tuple(labels[i] for i in kept),
        numberings,
        tuple(notes),
        reading.repeated,
        sum(len(e) for e in reading.found.values()),
    )


def _rows(labels, centres: Centres):
    return zip(labels, centres.rim, centres.ok, strict=True)


def _rim_note(label: str, rim: float) -> str:
    return (
        f"{label}: {100 * rim:.0f} % of its rim follows an ellipse, 80 % needed; partly hidden or disturbed, left out"
    )


def _corners(camera: Camera) -> np.ndarray:
    """Corners of the image, around it, in normalised ideal coordinates."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return camera.normalised_from_pixel(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
