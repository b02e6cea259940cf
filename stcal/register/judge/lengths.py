"""Whether frames differ by what a transform of the chosen model leaves out: a scale, or three of them and a shear."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import StcalError
from stcal.geometry.affine import Affine
from stcal.geometry.rigid import Similarity
from stcal.geometry.robust import ratio_limit
from stcal.register.core.models import MODELS, Transform, unit_covariance
from stcal.register.core.problem import Problem

BY_CHANCE = 1e-4
"""Frames of one scale called of two: so many."""
MATTERS = 0.1
"""Share of the noise's σ by which the wider model must lower it: less is seen in many points, and moves none."""
THERMAL = 5e-4
"""Relative: 45 K in steel, 20 K in aluminium; what is more has another cause."""


@dataclass(frozen=True, slots=True, eq=False)
class Wider:
    """The wider model that explains the points: ``transform``, σ of a coordinate by it, and what is to be said."""

    problem: Problem
    transform: Transform
    sigma_mm: float
    note: str


def wider(problem: Problem, transform: Transform) -> Wider | None:
    """The narrowest model wider than the problem's own that explains its points better, more than chance does.

    Parameters
    ----------
    problem : Problem
        Points that agree.
    transform : Transform
        Their fit.

    Returns
    -------
    Wider or None
        None where the problem's own model is enough.
    """
    narrow, found = (problem, transform), None
    for name in {"rigid": ("similarity", "affine"), "similarity": ("affine",), "affine": ()}[problem.model.name]:
        model = MODELS[name]
        if len(problem) < model.needed + 1:
            break
        other = replace(problem, model=model)
        try:
            fitted = other.fit()
        except StcalError:  # coplanar points have no affine transform
            break
        before, after = _square(*narrow), _square(other, fitted)
        more, left = model.parameters - narrow[0].model.parameters, other.redundancy
        rounding = 3 * len(problem) * problem.rounding_mm() ** 2
        gain = (before - after) / more / max(after / left, rounding / left)
        sigma = np.sqrt(max(after, 0) / left)
        enough = sigma < (1 - MATTERS) * np.sqrt(before / narrow[0].redundancy)
        if before > rounding and gain > ratio_limit(BY_CHANCE, more, left) and enough:
            narrow = other, fitted
            found = Wider(other, fitted, float(sigma), _said(other, fitted, float(sigma)))
    return found


def _square(problem: Problem, transform: Transform) -> float:
    return float(problem.squares(transform).sum())


def _said(problem: Problem, transform: Transform, sigma_mm: float) -> str:
    """What lengths in b are of those in a, the likely cause, and what to do."""
    covariance = sigma_mm**2 * unit_covariance(problem.model, transform, problem.xyz_a, problem.noise.precision)
    if isinstance(transform, Similarity):
        scale, sigma = transform.scale, transform.scale * float(np.sqrt(covariance[6, 6]))
        off, digits = scale - 1, max(1, 1 - int(np.floor(np.log10(max(sigma, 1e-15)))))
        cause = "a length standard, a board or an instrument of another scale"
        if abs(off) < THERMAL:
            cause = f"{1e6 * abs(off):.0f} ppm, of temperature (steel 11.5, aluminium 23 ppm/K) or a length standard"
        return (
            f"lengths in b are {scale:.{digits}f} ± {sigma:.{digits}f} times those in a: {cause}; correct one "
            "of the files, or use --model similarity"
        )
    assert isinstance(transform, Affine)
    scales = np.linalg.svd(transform.linear, compute_uv=False)
    return (
        f"lengths in b are {', '.join(f'{s:.6g}' for s in scales)} times those in a along three axes: an axis of one "
        "instrument is scaled or not square to the others, or an arm bends; correct it, or use --model affine within "
        "these points"
    )
