"""What is mistaken in data that do not fit: the changes that the data can test, tried the smaller one first."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError

ALIKE = 1.05
"""Ratio of misfits up to which two explanations are equally good."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A mistake that may have been made.

    ``words`` : what it is, and the remedy; ``change`` : returns the input without it; ``size`` : of the change, in any
    measure by which the candidates of one table are ordered.
    """

    words: str
    change: Callable[[], Any]
    size: Any = 0


def explain(
    candidates: Iterable[Candidate], fit: Callable[[Any], float], most: float, alike: float = ALIKE
) -> list[tuple[Candidate, float]]:
    """Return the candidates that explain the data, with their misfits, the best first; several if the data cannot
    tell, none if none does. Those of one size are tried together; larger changes only if no smaller one explains the
    data. ``fit`` : returns the misfit of a changed input; one without a solution explains nothing; ``most`` : misfit
    below which a candidate explains the data; ``alike`` : ratio of misfits up to which candidates are told with the
    best one."""

    def misfit(candidate: Candidate) -> float:
        try:
            return float(fit(candidate.change()))
        except (DegenerateError, ConvergenceError):
            return np.inf

    for _, level in groupby(sorted(candidates, key=lambda each: each.size), lambda each: each.size):
        found = [(each, left) for each in level if (left := misfit(each)) < most]
        if found:
            found.sort(key=lambda each: each[1])
            return [each for each in found if each[1] <= alike * found[0][1]]
    return []
