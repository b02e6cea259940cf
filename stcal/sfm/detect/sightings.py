"""What one image shows, before the group is asked: planes of the target and boards, each with its circles."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.labels import BOARD, CircleLabel
from stcal.sfm.data.centres import Centres

SECOND_BOARD_SHARE = 0.8
"""A second board is one with at least this share of the dots of the first."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceSighting:
    """A face: ``face`` id, ``rows`` : (n,) of its circles among the image's centres, ``circles`` : (n,) their places in
    the design."""

    face: str
    rows: np.ndarray
    circles: np.ndarray

    def labels(self, design: FaceDesign) -> tuple[CircleLabel, ...]:
        """Of its circles."""
        labels = design.labels()
        return tuple(labels[i] for i in self.circles)


OpenFace = tuple[FaceSighting, ...]
"""A pattern that the image alone cannot name: the faces that it may be."""


def open_face_note(circles: int, faces: Iterable[str]) -> str:
    """What is said of a pattern of so many circles that stays without a name."""
    return (
        f"a pattern of {circles} circles that fits face {', '.join(sorted(set(faces)))} but may be another; left out, "
        "show the circles that tell the faces apart"
    )


@dataclass(frozen=True, slots=True, eq=False)
class BoardSighting:
    """A board: ``rows`` : (n,) of its dots among the image's centres, ``numberings`` : (k, n, 2) row and column of each
    in each of the k numberings that the image admits, the likeliest first."""

    rows: np.ndarray
    numberings: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class ImageDetection:
    """What one image shows.

    ``centres`` : the measured circles; ``faces`` and ``boards`` : what they were read as, the boards with the most dots
    first, a face or the board perhaps more than once; ``open_faces`` : patterns without a name; ``mirrored`` : ids of
    faces that the image shows as a mirror does; ``notes`` : what was seen and left out, and why; ``candidates`` :
    outlines found.
    """

    centres: Centres
    faces: tuple[FaceSighting, ...]
    boards: tuple[BoardSighting, ...] = ()
    mirrored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    candidates: int = field(default=0)
    open_faces: tuple[OpenFace, ...] = ()

    @property
    def repeated(self) -> tuple[str, ...]:
        """What is in view more than once."""
        ids = [sighting.face for sighting in self.faces]
        boards = self.boards[1:2] and len(self.boards[1].rows) >= SECOND_BOARD_SHARE * len(self.boards[0].rows)
        return (BOARD,) * bool(boards) + tuple(f"face {i}" for i in sorted(set(ids)) if ids.count(i) > 1)

    @property
    def board(self) -> BoardSighting | None:
        """The one board; None where there is none, or a second one as large."""
        return None if not self.boards or BOARD in self.repeated else self.boards[0]

    def single_faces(self) -> tuple[FaceSighting, ...]:
        """Faces that are in view once."""
        ids = [sighting.face for sighting in self.faces]
        return tuple(sighting for sighting in self.faces if ids.count(sighting.face) == 1)

    def labelled_rows(self, target: TargetDesign) -> tuple[list[CircleLabel], np.ndarray]:
        """Labels of the circles of :meth:`single_faces`, and their rows among the centres."""
        faces = self.single_faces()
        labels = [label for each in faces for label in each.labels(target.face(each.face))]
        return labels, np.concatenate([each.rows for each in faces]) if faces else np.zeros(0, int)
