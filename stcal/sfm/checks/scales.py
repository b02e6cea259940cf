"""Check of the sources of the scale against one another: printed faces, known distances and the board."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign, known_distances
from stcal.errors import DegenerateError
from stcal.geometry.rigid import align_similarity
from stcal.labels import DotLabel
from stcal.sfm.adjust.network import Network
from stcal.sfm.adjust.scale import MIN_DOTS, known_points
from stcal.sfm.checks.verdict import Check, Measured, Trial, impossible, judge

PPM = 1e6
ALONE, FAR, LEAST_AGREEING = 0.005, 3.0, 2
"""Relative error of size from which one source is named, how many times as far off as the others it must be, and how
many others must agree."""
MOST_PRINT_FACTOR = 10.0
"""Corners about the design over their stated σ from which on the design, or a stated size, is another one."""


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """A source of the scale."""

    name: str
    log_scale: float  # of the model over the known size
    gradient: np.ndarray  # (3p,) of ``log_scale`` by the points
    variance: float  # of the known size


def scales_check(networks: Sequence[Network], board: BoardDesign, print_factor: float) -> Check:
    """Tests each source of the scale against the mean of all in the free network of a group, which has one scale."""
    key, title = "scales", "Scales against one another"
    remedy = (
        "one print, distance or board has another size than stated: measure a side of each print and correct "
        "target.toml, or state size_sigma_mm"
    )
    if print_factor > MOST_PRINT_FACTOR:
        # σ that have grown so much would hide the contradiction that made them grow.
        measured = Measured("corners about the design", print_factor, MOST_PRINT_FACTOR, "× their stated σ", None)
        if alone := _alone(networks, board):
            name, times = alone
            reason = f"{name} would fit with {times:.4g} times its stated size, and the others agree with one another"
            size = Measured(name, 100 * (times - 1), 100 * ALONE, "% larger than stated", None)
            return Check(key, title, "failed", reason, (size, measured), 1, (name,), f"correct the size of {name}")
        why = "the size or drawing of the print is another one, or its σ too small"
        reason = f"{measured.name} at {measured.words()}: {why}"
        return Check(key, title, "suspicious", reason, (measured,), 1, (measured.name,), remedy)
    trials: list[Trial] = []
    for network in networks:
        sources = _sources(network, board, print_factor)
        if len(sources) < 2:
            continue
        gradient = np.array([source.gradient for source in sources])
        value = np.array([source.log_scale for source in sources])
        own = np.diag([source.variance for source in sources])
        covariance = gradient @ network.covariance_mm2 @ gradient.T + own
        weight = np.linalg.inv(covariance)
        mean = float(weight.sum(0) @ value / weight.sum())
        away = value - mean
        spread = np.diag(covariance) - 1 / weight.sum()
        freedom = float(network.redundancy.sum())
        for source, off, variance in zip(sources, away.tolist(), spread.tolist(), strict=True):
            if variance > 0:
                trials.append(Trial(source.name, PPM * off, "ppm", off**2 / variance, 1, freedom))
    if not trials:
        return impossible(key, title, "only one source of the scale", "state a known distance with scale")
    check = judge(key, title, trials, "sources of the scale", remedy)
    if check.names and (alone := _alone(networks, board)):
        name, times = alone
        size = f"{name} would fit with {times:.4g} times its stated size, and the others agree with one another"
        return replace(check, reason=f"{size}; {check.reason}", names=(name,), remedy=f"correct the size of {name}")
    return check


def _alone(networks: Sequence[Network], board: BoardDesign) -> tuple[str, float] | None:
    """Returns the one source that contradicts all others, which agree, and its size over the stated one."""
    off: dict[str, list[float]] = {}
    for network in networks:
        sources = _sources(network, board, 1.0)
        middle = float(np.median([source.log_scale for source in sources])) if sources else 0.0
        for source in sources:
            off.setdefault(source.name, []).append(source.log_scale - middle)
    ratio = {name: float(np.median(values)) for name, values in off.items()}
    if len(ratio) < LEAST_AGREEING + 1:
        return None
    name = max(ratio, key=lambda each: abs(ratio[each]))
    others = max(abs(value) for each, value in ratio.items() if each != name)
    return (name, float(np.exp(ratio[name]))) if abs(ratio[name]) > max(ALONE, FAR * others) else None


def _sources(network: Network, board: BoardDesign, print_factor: float) -> list[_Source]:
    model = network.model
    parts = [
        (f"face {face.id}", members, face.places_mm(model.labels[i].circle for i in members),
         print_factor * (face.sigma_mm or 1.0), face.size_sigma)
        for face, members in known_points(model.labels, board)
    ]  # fmt: skip
    dots = np.array([i for i, label in enumerate(model.labels) if isinstance(label, DotLabel)], int)
    if len(dots) >= MIN_DOTS:
        parts.append(("board", dots, board.places_mm(model.labels[i] for i in dots), board.sigma_mm, 0.0))
    sources = []
    for name, members, design, sigma_mm, size_sigma in parts:
        try:
            found = align_similarity(model.xyz_model[members], design)
        except DegenerateError:
            continue
        middle = design - design.mean(0)
        square = float((middle**2).sum())
        gradient = np.zeros((len(model.labels), 3))
        gradient[members] = middle @ found.rigid.rotation.T / (square * found.scale)
        variance = sigma_mm**2 / square + size_sigma**2
        sources.append(_Source(name, float(np.log(found.scale)), gradient.ravel(), variance))
    place = {label: i for i, label in enumerate(model.labels)}
    for known in known_distances(board):
        if known.first in place and known.second in place:
            i, j = place[known.first], place[known.second]
            apart = model.xyz_model[i] - model.xyz_model[j]
            length = float(np.linalg.norm(apart))
            gradient = np.zeros((len(model.labels), 3))
            gradient[i], gradient[j] = apart / length**2, -apart / length**2
            name = f"distance {known.first} to {known.second}"
            sources.append(
                _Source(name, float(np.log(length / known.mm)), gradient.ravel(), (known.sigma_mm / known.mm) ** 2)
            )
    return sources
