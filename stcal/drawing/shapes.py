"""Elements of drawings: discs, areas, lines, words; mm, X to the right, Y upwards."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

Ink = Literal["black", "white", "grey"]
Layer = Literal["GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS"]
LAYERS: tuple[Layer, ...] = ("GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS")
"""Layers. ``GROUND`` : ink behind a bright pattern; ``CUT`` : outlines and cut marks; ``DIMENSIONS`` : dimensions,
scale bars, registration marks; ``LABELS`` : words beside the parts."""
WIDTH_PER_HEIGHT = 0.85
"""Approximate width of a letter over its height: for reserving space, not for typesetting."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A filled circle. ``name`` : its label."""

    x: float
    y: float
    radius: float
    ink: Ink
    layer: Layer = "PATTERN"
    name: str = ""

    def box(self) -> np.ndarray:
        """Return the bounding box, (2, 2): smallest and largest coordinates."""
        return np.array([[self.x - self.radius, self.y - self.radius], [self.x + self.radius, self.y + self.radius]])


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """A filled area between closed ``lines`` (k, 2); lines inside others are holes."""

    lines: tuple[np.ndarray, ...]
    ink: Ink
    layer: Layer = "PATTERN"

    def box(self) -> np.ndarray:
        """Return the bounding box, (2, 2): smallest and largest coordinates."""
        return _box(np.concatenate(self.lines))


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A thin line through ``points`` (k, 2)."""

    points: np.ndarray
    layer: Layer
    ink: Ink = "black"
    width: float = 0.15
    closed: bool = False
    dashed: bool = False

    def box(self) -> np.ndarray:
        """Return the bounding box, (2, 2): smallest and largest coordinates."""
        return _box(self.points)


@dataclass(frozen=True, slots=True)
class Text:
    """Words from (x, y) on the base line; ``height`` : of capitals; ``turned`` : upwards instead of along X."""

    x: float
    y: float
    words: str
    height: float = 2.5
    anchor: Literal["start", "middle", "end"] = "start"
    turned: bool = False
    ink: Ink = "black"
    layer: Layer = "LABELS"

    def box(self) -> np.ndarray:
        """Return the approximate bounding box, (2, 2): smallest and largest coordinates."""
        length = WIDTH_PER_HEIGHT * self.height * len(self.words)
        before = {"start": 0.0, "middle": length / 2, "end": length}[self.anchor]
        box = np.array([[-before, -0.4 * self.height], [length - before, 1.2 * self.height]])
        if self.turned:
            box = np.array([[-box[1, 1], box[0, 0]], [-box[0, 1], box[1, 0]]])
        return box + np.array([self.x, self.y])


Shape: TypeAlias = Disc | Area | Line | Text


def extent(shapes) -> np.ndarray:
    """Return the bounding box of all shapes, (2, 2): smallest and largest coordinates."""
    boxes = np.array([shape.box() for shape in shapes])
    return np.array([boxes[:, 0].min(0), boxes[:, 1].max(0)])


def moved(shape: Shape, x: float, y: float) -> Shape:
    """Return the shape shifted by (x, y)."""
    if isinstance(shape, Disc | Text):
        return replace(shape, x=shape.x + x, y=shape.y + y)
    if isinstance(shape, Area):
        return replace(shape, lines=tuple(line + np.array([x, y]) for line in shape.lines))
    return replace(shape, points=shape.points + np.array([x, y]))


def _box(points: np.ndarray) -> np.ndarray:
    return np.array([points.min(0), points.max(0)])


def words_with_room(places: np.ndarray, words: Iterable[str], height: float, taken: Iterable[Text] = ()) -> list[Text]:
    """Return words about their places (n, 2), without those that would overlap others before, or the ``taken`` ones."""
    found, boxes = [], [text.box() for text in taken]
    for (x, y), word in zip(places.tolist(), words, strict=True):
        text = Text(x, y - height / 2, word, height, "middle")
        low, high = text.box()
        if all((low >= box[1]).any() or (high <= box[0]).any() for box in boxes):
            found.append(text)
            boxes.append(text.box())
    return found


def said_mm(value: float) -> str:
    """Return the text of a length in mm to the µm, without trailing zeros."""
    text = f"{value:.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
