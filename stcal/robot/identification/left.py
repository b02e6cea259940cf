"""What a model leaves: whether residuals go with a joint's angle, gravity or place, by F tests of all of them together.

Each candidate is a set of motions of the tool. What the fitted parameters take up is taken out of it first, so that a
clean fit gives F its distribution exactly, whatever share of the rows' freedom the parameters used (Frisch & Waugh
1933). The strongest is named, taken out too, and the others are tested again: one cause is not named six times.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import Weighting
from stcal.robot.identification.residuals import WIDTH, Observed, State, as_seen, residuals, tips_of
from stcal.robot.identification.variances import GROSS
from stcal.robot.kinematics.forward import joint_frames

LEVEL = 0.01
"""Probability that anything is said of a clean set; each of the tests has its share (Bonferroni)."""
MOST = 3
"""Findings, the strongest first."""
LEAST_SHARE, LEAST_MM, LEAST_RAD = 0.01, 1e-3, 1e-6
"""Of the squared residuals, and RMS: what takes less is not worth a sentence."""
LEAST_FREEDOM = 10
"""Numbers beyond the parameters, fewer of which tell nothing."""
NEW, SAME = 1e-3, 1e-9
"""Share of a motion that the parameters must not take up themselves; and what rounding leaves of one."""
SHARED = 4
"""Distances from one position, from which on its own error counts as a parameter."""
TURNS = {1: "once a turn", 2: "twice a turn"}


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that residuals go with.

    Parameters
    ----------
    what : str
        With what: "the angle of joint 3, once a turn".
    effect_mm, effect_rad : float
        Amplitude in the residuals of position and (0 where there are none) orientation where it is periodic, else RMS.
    joint, turns : int
        Number of the joint, and how often its turn repeats the effect; 0 where there is none.
    share : float
        Of the squared residuals (weighted as in the fit) that it takes.
    p : float
        Probability of as much by chance, times the number of tests.
    """

    what: str
    joint: int
    turns: int
    effect_mm: float
    effect_rad: float
    share: float
    p: float

    def sentence(self) -> str:
        """For people."""
        size = f"{self.effect_mm:.2g} mm" + (f" and {np.degrees(self.effect_rad):.2g}°" if self.effect_rad else "")
        size = f"amplitude {size}" if self.turns else f"{size} RMS"
        chance = "p < 0.001" if self.p < 1e-3 else f"p = {self.p:.2g}"
        return f"residuals go with {self.what}: {size}, {self.share:.0%} of their squares, {chance}"


def left(
    state: State,
    world_from_base: Rigid,
    seen: Observed,
    weighting: Weighting,
    explained: np.ndarray,
    weights: np.ndarray | None = None,
) -> tuple[Finding, ...] | None:
    """What the residuals of ``state`` go with.

    Candidates are each joint's zero and its angle, once and twice a turn, as a motion of that joint (a gear's or an
    encoder's error) and as one of the tool along the base's axes, and the direction from which it came; prismatic
    joints' values; the torque of a load at the
    tool about each joint, where z of the base is up; and place: scale, linear, distance from the base's axis.

    Parameters
    ----------
    state : State
        Chain and tools, as fitted or given.
    world_from_base : Rigid
        For up, the axes and the place.
    seen : Observed
        r observations.
    weighting : Weighting
        Their σ, up to a common factor.
    explained : (r, w, k) array
        Derivatives by the parameters that were fitted to these observations.
    weights : (r,) array, optional
        Of each observation; those below 0.5 are errors and left out.

    Returns
    -------
    tuple of Finding, or None
        The strongest first, at most three; None where the observations are too few to tell.
    """
    found = residuals(state, seen)
    good = np.ones(len(found), bool) if weights is None else weights >= GROSS
    root = np.sqrt(np.ones(len(found)) if weights is None else weights)[:, None, None] * good[:, None, None]

    def white(values: np.ndarray) -> np.ndarray:
        return root * weighting.whiten(values, seen)

    explained = np.concatenate([explained, _shared(state, seen)], axis=2)
    known = _basis(_unit(white(explained).reshape(found.size, -1)), SAME)
    before = white(found[..., None]).ravel()
    rest = before - known @ (known.T @ before)
    freedom = int(good.sum()) * found.shape[1] - known.shape[1]
    if freedom < LEAST_FREEDOM:
        return None

    def effect(takes: np.ndarray, part: slice) -> float:
        """RMS of what is taken, rad or mm."""
        unit, size, own = (float((each[..., part] ** 2).sum()) for each in (found[good], by_row(before), by_row(takes)))
        return float(np.sqrt(unit / int(good.sum()) / max(size, 1e-300) * own))

    def by_row(flat: np.ndarray) -> np.ndarray:
        return flat.reshape(found.shape)

    candidates = [
        (each, white(each.motions).reshape(found.size, -1)) for each in _candidates(state, seen, world_from_base)
    ]
    square = float(rest @ rest)
    findings: list[Finding] = []
    while len(findings) < MOST:
        tests = [(each, test) for each, values in candidates if (test := _tested(rest, known, values, freedom))]
        if not tests:
            break
        what, best = min(tests, key=lambda each: each[1].p)
        amplitude = np.sqrt(2) if what.turns else 1.0
        mm = float(amplitude * effect(best.takes, slice(-3, None)))
        rad = float(amplitude * effect(best.takes, slice(0, 3))) if found.shape[1] == 6 else 0.0
        share = float(best.takes @ best.takes) / max(square, 1e-300)
        p = min(1.0, len(tests) * best.p)
        if p > LEVEL or share < LEAST_SHARE or (mm < LEAST_MM and rad < LEAST_RAD):
            break
        findings.append(Finding(what.what, what.joint, what.turns, mm, rad, share, p))
        known, rest = np.hstack([known, best.new]), rest - best.takes
        freedom -= best.new.shape[1]
    return tuple(findings)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """``motions`` : (r, w, c) of the tool as observed, whatever their size."""

    what: str
    joint: int
    turns: int
    motions: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Test:
    """``takes`` : (N,) the part of the residuals that goes with it; ``new`` : (N, c) basis of what it adds."""

    p: float
    takes: np.ndarray
    new: np.ndarray


def _tested(rest: np.ndarray, known: np.ndarray, values: np.ndarray, freedom: int) -> _Test | None:
    """F test of what ``values`` (N, c) add to ``known``; None where that is nothing, or all that there is."""
    values = _unit(values)
    new = _basis(values - known @ (known.T @ values), NEW)
    c = new.shape[1]
    if c == 0 or freedom - c < 1:
        return None
    takes = new @ (new.T @ rest)
    left_over = rest - takes
    ratio = float(takes @ takes) / c / max(float(left_over @ left_over) / (freedom - c), 1e-300)
    return _Test(float(f_distribution.sf(ratio, c, freedom - c)), takes, new)


def _unit(values: np.ndarray) -> np.ndarray:
    """Columns (N, c) of length 1, without those of 0."""
    size = np.linalg.norm(values, axis=0)
    return values[:, size > 0] / size[size > 0]


def _basis(values: np.ndarray, least: float) -> np.ndarray:
    """(N, c) orthonormal, of directions in which columns of length 1 differ by more than ``least``."""
    u, s, _ = np.linalg.svd(values, full_matrices=False)
    return u[:, s > least]


def _shared(state: State, seen: Observed) -> np.ndarray:
    """(r, w, c) shifts of positions from which several distances start: their error is in all of these, as if it went
    with place."""
    starts = [row for row in np.unique(seen.second) if (seen.second == row).sum() >= SHARED]
    if seen.kind != "distance" or not starts:
        return np.zeros((len(seen), WIDTH[seen.kind], 0))
    place = tips_of(state, seen.data).translation
    away = place[seen.first] - place[seen.second]
    away /= np.maximum(np.linalg.norm(away, axis=1), 1e-12)[:, None]
    return np.concatenate([away * (seen.second == row)[:, None] for row in starts], axis=1)[:, None]


def _candidates(state: State, seen: Observed, world_from_base: Rigid) -> list[_Candidate]:
    chain, data = state.chain, seen.data
    tip = tips_of(state, data)
    turned, origins = joint_frames(chain, data.q, data.conditions)
    base, place = world_from_base.rotation, world_from_base.inverse() @ tip.translation
    along = np.concatenate([np.zeros((3, 3)), base])  # motions along the base's axes
    values = data.q @ chain.coupling.T
    carries = chain.carries(data.targets)
    found = []

    def add(what: str, motions: np.ndarray, joint: int = 0, turns: int = 0) -> None:
        if joint:
            motions = motions * carries[joint - 1, :, None, None]
        found.append(_Candidate(what, joint, turns, as_seen(state, seen, tip, motions)))

    for i, (z, origin) in enumerate(zip(turned[..., 2], origins, strict=True)):
        joint, arm = i + 1, tip.translation - origin
        if chain.prismatic[i]:
            own, by = np.hstack([np.zeros_like(z), z]), values[:, i, None, None]
            add(f"the value of joint {joint}, along its motion", own[:, :, None] * by, joint)
            add(f"the value of joint {joint}", along * by, joint)
            continue
        own = np.hstack([z, np.cross(z, arm)])
        add(f"the zero of joint {joint}", own[:, :, None], joint)
        for turns, said in TURNS.items():
            waves = np.stack([np.cos(turns * values[:, i]), np.sin(turns * values[:, i])], axis=1)
            what = f"the angle of joint {joint}, {said}"
            add(f"{what}, along its motion", own[:, :, None] * waves[:, None], joint, turns)
            add(what, np.einsum("dc,mt->mdct", along, waves).reshape(len(waves), 6, 6), joint, turns)
        came = data.conditions.approach
        if came is not None and came[:, i].any():
            add(f"the direction from which joint {joint} came", own[:, :, None] * came[:, i, None, None], joint)
        torque = np.einsum("mi,mi->m", z, np.cross(arm, base[:, 2]))
        if np.abs(torque).max() > NEW * np.linalg.norm(arm, axis=1).max():
            what = f"gravity's torque about joint {joint}"
            add(what, (own * torque[:, None])[:, :, None], joint)
    radial = np.linalg.norm(place[:, :2], axis=1)
    add("the scale of lengths", np.pad(place @ base.T, ((0, 0), (3, 0)))[:, :, None])
    add("the place, linearly", np.einsum("dc,mp->mdcp", along, place).reshape(len(place), 6, 9))
    add("the distance from the base's axis, up or down", along[:, 2, None] * radial[:, None, None])
    return found
