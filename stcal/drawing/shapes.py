"""What drawings are made of: discs, areas, lines, words; mm, X to the right, Y upwards."""

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

Ink = Literal["black", "white", "grey"]
Layer = Literal["GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS"]
LAYERS: tuple[Layer, ...] = ("GROUND", "PATTERN", "CUT", "FOLD", "DIMENSIONS", "LABELS")
"""``GROUND`` : what is inked behind a bright pattern; ``CUT`` : outlines and cut marks; ``DIMENSIONS`` : dimensions,
scale bars, registration marks; ``LABELS`` : words beside the parts."""
WIDTH_PER_HEIGHT = 0.85
"""Of a letter, about: for room, not for setting."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A circle, filled. ``name`` : its label."""

    x: float
    y: float
    radius: float
    ink: Ink
    layer: Layer = "PATTERN"
    name: str = ""

    def box(self) -> np.ndarray:
        """Least and largest place, (2, 2)."""
        return np.array([[self.x - self.radius, self.y - self.radius], [self.x + self.radius, self.y + self.radius]])


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """Filled between closed ``lines`` (k, 2); lines within lines are holes."""

    lines: tuple[np.ndarray, ...]
    ink: Ink
    layer: Layer = "PATTERN"

    def box(self) -> np.ndarray:
        """Least and largest place, (2, 2)."""
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
        """Least and largest place, (2, 2)."""
        return _box(self.points)


@dataclass(frozen=True, slots=True)
class Text:
    """Words with capitals of that ``height``, from (x, y) on the base line; ``turned`` : upwards, not along X."""

    x: float
    y: float
    words: str
    height: float = 2.5
    anchor: Literal["start", "middle", "end"] = "start"
    turned: bool = False
    ink: Ink = "black"
    layer: Layer = "LABELS"

    def box(self) -> np.ndarray:
        """Least and largest place, (2, 2), about."""
        length = WIDTH_PER_HEIGHT * self.height * len(self.words)
        before = {"start": 0.0, "middle": length / 2, "end": length}[self.anchor]
        own = np.array([[-before, -0.4 * self.height], [length - before, 1.2 * self.height]])
        if self.turned:
            own = np.array([[-own[1, 1], own[0, 0]], [-own[0, 1], own[1, 0]]])
        return own + np.array([self.x, self.y])


Shape: TypeAlias = Disc | Area | Line | Text


def extent(shapes) -> np.ndarray:
    """Least and largest place of all, (2, 2)."""
    boxes = np.array([shape.box() for shape in shapes])
    return np.array([boxes[:, 0].min(0), boxes[:, 1].max(0)])


def moved(shape: Shape, x: float, y: float) -> Shape:
    """The shape somewhere else."""
    if isinstance(shape, Disc | Text):
        return replace(shape, x=shape.x + x, y=shape.y + y)
    if isinstance(shape, Area):
        return replace(shape, lines=tuple(line + np.array([x, y]) for line in shape.lines))
    return replace(shape, points=shape.points + np.array([x, y]))


def _box(points: np.ndarray) -> np.ndarray:
    return np.array([points.min(0), points.max(0)])


def said_mm(value: float) -> str:
    """A length without needless digits; µm are the last."""
    text = f"{value:.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
