"""Patterns found in one image, before comparison with its group."""

from dataclasses import dataclass, field

import numpy as np

from stcal.design import FaceDesign
from stcal.labels import BOARD, CircleLabel
from stcal.sfm.data.group_model import Centres

SECOND_BOARD_SHARE = 0.8  # smallest number of dots of a second board, as a share of the dots of the first


@dataclass(frozen=True, slots=True, eq=False)
class FaceSighting:
    """A face in an image."""

    face: str
    rows: np.ndarray  # (n,) indices of its circles among the candidates, or the image's centres
    circles: np.ndarray  # (n,) their indices in the design

    def labels(self, design: FaceDesign) -> tuple[CircleLabel, ...]:
        """Returns the labels of its circles."""
        labels = design.labels()
        return tuple(labels[i] for i in self.circles)

    def by(self, row: np.ndarray) -> "FaceSighting":
        """Returns the circles that have other indices: ``row`` by that so far, −1 for none."""
        rows = row[self.rows]
        return FaceSighting(self.face, rows[rows >= 0], self.circles[rows >= 0])


OpenFace = tuple[FaceSighting, ...]
"""A pattern that the image alone cannot name: all faces that it may be."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardSighting:
    """A board in an image."""

    rows: np.ndarray  # (n,) indices of its dots among the candidates, or the image's centres
    numberings: np.ndarray  # (k, n, 2) row and column of each dot in each numbering, the likeliest first
    # (u, n, 2) that require covered dots inside the image; the group may confirm them
    unlikely: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 2), int))

    def by(self, row: np.ndarray) -> "BoardSighting":
        """Returns the dots that have other indices: ``row`` by that so far, −1 for none."""
        rows = row[self.rows]
        ok = rows >= 0
        return BoardSighting(rows[ok], self.numberings[:, ok], self.unlikely[:, ok])


@dataclass(frozen=True, slots=True, eq=False)
class ImageDetection:
    """Result of detection in one image; a face or the board may occur more than once."""

    centres: Centres
    faces: tuple[FaceSighting, ...]
    boards: tuple[BoardSighting, ...] = ()  # the one with the most dots first
    mirrored: tuple[str, ...] = ()  # ids of faces
    notes: tuple[str, ...] = ()  # exclusions with reasons
    candidates: int = 0  # number of outlines
    open_faces: tuple[OpenFace, ...] = ()  # patterns without a name
    # faces with a board or tags, whose corners are among the centres, without extent
    printed: tuple[FaceSighting, ...] = ()

    @property
    def repeated(self) -> tuple[str, ...]:
        """Names of the faces, and of the board, that are in view more than once."""
        ids = [sighting.face for sighting in self.faces]
        boards = self.boards[1:2] and len(self.boards[1].rows) >= SECOND_BOARD_SHARE * len(self.boards[0].rows)
        return (BOARD,) * bool(boards) + tuple(f"face {i}" for i in sorted(set(ids)) if ids.count(i) > 1)

    @property
    def board(self) -> BoardSighting | None:
        """The only board of the image; None if there is none, or a second one of similar size."""
        return None if not self.boards or BOARD in self.repeated else self.boards[0]

    def single_faces(self) -> tuple[FaceSighting, ...]:
        """Returns the faces that are in view exactly once."""
        ids = [sighting.face for sighting in self.faces]
        return (*(sighting for sighting in self.faces if ids.count(sighting.face) == 1), *self.printed)
