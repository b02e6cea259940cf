"""Lengths in mm: how large hardware is, and the refusal of those that are metres or another unit."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

from stcal.errors import InputError

LEAST_SIDE_MM, MOST_SIDE_MM = 1.0, 5e3
"""Sides of tags and squares, and pitches. Tags of 1 m are 1 mm if metres are taken as mm; in a file in metres whose
values are mm, a tag of 5 mm is one of 5 m."""
LEAST_RADIUS_MM, MOST_RADIUS_MM = 0.05, 2e3
"""Radii of printed dots: 50 mm in metres are 0.05 mm, and dots of half a millimetre are the smallest in use."""
LEAST_LINK_MM, MOST_LINK_MM = 10.0, 5e4
"""The longest link of an arm: 10 m in metres are 10 mm, and no arm has links of 50 m. Along joint axes that are nearly
parallel the common normal may be any distance away, so that ``d`` has no upper limit."""
KEY = "unusual_size"
"""The key with which a file states that its unusually small or large lengths are meant."""


@dataclass(frozen=True, slots=True)
class Length:
    """A length of a file; ``place`` : its key; ``least``, ``most`` : between which hardware has it, mm."""

    place: str
    value_mm: float
    least: float
    most: float


side = partial(Length, least=LEAST_SIDE_MM, most=MOST_SIDE_MM)
"""Returns the side of a tag or a square, or a pitch, of its place and value."""
radius = partial(Length, least=LEAST_RADIUS_MM, most=MOST_RADIUS_MM)
"""Returns the radius of a dot, likewise."""


def _unusual(lengths: Iterable[Length]) -> Length | None:
    """Returns the first length that no hardware has; an exact zero is meant."""
    return next((each for each in lengths if each.value_mm and not each.least <= abs(each.value_mm) <= each.most), None)


def require_millimetres(lengths: Iterable[Length], stated: bool, where: str) -> None:
    """Refuse lengths that no hardware has in mm. ``stated`` : the file says with :data:`KEY` that they are right."""
    wrong = None if stated else _unusual(lengths)
    if wrong is None:
        return
    small = abs(wrong.value_mm) < wrong.least
    limit = f"at least {wrong.least:g} mm" if small else f"at most {wrong.most:g} mm"
    remedy = "if lengths are metres, multiply them by 1000" if small else "if lengths are in another unit, convert them"
    fault = f"{where}: {wrong.place} is {wrong.value_mm:g} mm, {limit} usual"
    raise InputError("E-LENGTH-UNIT", f"{fault}; {remedy}; if it is right, add `{KEY} = true`")


def stated_unusual(lengths: Iterable[Length]) -> list[str]:
    """Returns the line of a file that states lengths as meant, where they would be refused without it."""
    return [f"{KEY} = true"] if _unusual(lengths) else []
