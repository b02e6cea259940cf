"""F tests of what a model leaves unexplained: residuals that go with a joint's angle, gravity or place."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import Weighting
from stcal.robot.identification.residuals import WIDTH, Observed, State, as_seen, residuals, tips_of
from stcal.robot.identification.variances import GROSS
from stcal.robot.kinematics.forward import joint_frames

LEVEL = 0.01
"""Probability that anything is reported of a clean set; it is divided among the tests (Bonferroni)."""
MOST = 3
"""Largest number of findings, the strongest first."""
LEAST_SHARE, LEAST_MM, LEAST_RAD = 0.01, 1e-3, 1e-6
"""Smallest share of the squared residuals, and smallest RMS effects, that are worth a sentence."""
LEAST_FREEDOM = 10
"""Smallest number of degrees of freedom that allows a test."""
NEW, SAME = 1e-3, 1e-9
"""Share of a motion that must be left after the parameters absorb theirs; and share below which a remainder is
rounding."""
SHARED = 4
"""Number of distances from one position from which on the error of this position counts as a parameter."""
TURNS = {1: "once a turn", 2: "twice a turn"}


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that the residuals go with.

    Parameters
    ----------
    what : str
        Name of the effect: "the angle of joint 3, once a turn".
    effect_mm, effect_rad : float
        Amplitude in the residuals of position and of orientation (0 if there are none) if the effect is periodic, else
        RMS.
    joint, turns : int
        Number of the joint, and number of periods in one turn of it; 0 where there is none.
    share : float
        Share of the squared residuals (weighted as in the fit) that the effect explains.
    p : float
        Probability of such an effect by chance, times the number of tests.
    """

    what: str
    joint: int
    turns: int
    effect_mm: float
    effect_rad: float
    share: float
    p: float

    def sentence(self) -> str:
        """Returns the finding as a sentence."""
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
    """Returns the effects that the residuals of ``state`` go with.

    Candidates of a revolute joint are its zero; its angle, once and twice a turn, as a motion of that joint (an error
    of its gear or encoder) and as one of the tool along the base's axes; the direction from which it came; and the
    torque about it of a load at the tool, where z of the base is up. A prismatic joint has its value. Candidates of
    place are scale, linear terms, and the distance from the base's axis.

    Parameters
    ----------
    state : State
        Chain and tools, as fitted or given.
    world_from_base : Rigid
        Pose of the base, for up, the axes and the place.
    seen : Observed
        r observations.
    weighting : Weighting
        σ of the observations, up to a common factor.
    explained : (r, w, k) array
        Derivatives by the parameters that were fitted to these observations.
    weights : (r,) array, optional
        Weights of the observations; those below 0.5 are errors and left out.

    Returns
    -------
    tuple of Finding, or None
        The strongest first, at most three; None if the observations are too few to tell.
    """
    errors = residuals(state, seen)
    good = np.ones(len(errors), bool) if weights is None else weights >= GROSS
    root = np.sqrt(np.ones(len(errors)) if weights is None else weights)[:, None, None] * good[:, None, None]

    def white(values: np.ndarray) -> np.ndarray:
        return root * weighting.whiten(values, seen)

    explained = np.concatenate([explained, _shared(state, seen)], axis=2)
    fitted = _basis(_unit(white(explained).reshape(errors.size, -1)), SAME)
    before = white(errors[..., None]).ravel()
    remaining = before - fitted @ (fitted.T @ before)
    freedom = int(good.sum()) * errors.shape[1] - fitted.shape[1]
    if freedom < LEAST_FREEDOM:
        return None

    def effect(takes: np.ndarray, part: slice) -> float:
        """Returns the RMS of ``takes``, rad or mm."""
        unit, size, taken = (
            float((each[..., part] ** 2).sum()) for each in (errors[good], by_row(before), by_row(takes))
        )
        return float(np.sqrt(unit / int(good.sum()) / max(size, 1e-300) * taken))

    def by_row(flat: np.ndarray) -> np.ndarray:
        return flat.reshape(errors.shape)

    candidates = [
        (each, white(each.motions).reshape(errors.size, -1)) for each in _candidates(state, seen, world_from_base)
    ]
    square = float(remaining @ remaining)
    findings: list[Finding] = []
    while len(findings) < MOST:
        tests = [(each, test) for each, values in candidates if (test := _tested(remaining, fitted, values, freedom))]
        if not tests:
            break
        candidate, best = min(tests, key=lambda each: each[1].p)
        amplitude = np.sqrt(2) if candidate.turns else 1.0
        mm = float(amplitude * effect(best.takes, slice(-3, None)))
        rad = float(amplitude * effect(best.takes, slice(0, 3))) if errors.shape[1] == 6 else 0.0
        share = float(best.takes @ best.takes) / max(square, 1e-300)
        p = min(1.0, len(tests) * best.p)
        if p > LEVEL or share < LEAST_SHARE or (mm < LEAST_MM and rad < LEAST_RAD):
            break
        findings.append(Finding(candidate.what, candidate.joint, candidate.turns, mm, rad, share, p))
        fitted, remaining = np.hstack([fitted, best.new]), remaining - best.takes
        freedom -= best.new.shape[1]
    return tuple(findings)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A candidate. ``motions`` : (r, w, c) of the tool as observed, in any scale."""

    what: str
    joint: int
    turns: int
    motions: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Test:
    """An F test. ``takes`` : (N,) part of the residuals that the candidate explains; ``new`` : (N, c) basis of what it
    adds."""

    p: float
    takes: np.ndarray
    new: np.ndarray


def _tested(rest: np.ndarray, known: np.ndarray, values: np.ndarray, freedom: int) -> _Test | None:
    """Returns the F test of what ``values`` (N, c) add to ``known``; None if they add nothing, or leave no degrees of
    freedom."""
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
    """Returns the columns (N, c) scaled to length 1, without those of length 0."""
    size = np.linalg.norm(values, axis=0)
    return values[:, size > 0] / size[size > 0]


def _basis(values: np.ndarray, least: float) -> np.ndarray:
    """Returns an orthonormal basis (N, c) of the directions in which columns of length 1 differ by more than
    ``least``."""
    u, s, _ = np.linalg.svd(values, full_matrices=False)
    return u[:, s > least]


def _shared(state: State, seen: Observed) -> np.ndarray:
    """Returns shifts (r, w, c) of positions from which several distances start. The error of such a position is in all
    of its distances, as if they went with place."""
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
    candidates = []

    def add(what: str, motions: np.ndarray, joint: int = 0, turns: int = 0) -> None:
        if joint:
            motions = motions * carries[joint - 1, :, None, None]
        candidates.append(_Candidate(what, joint, turns, as_seen(state, seen, tip, motions)))

    for i, (z, origin) in enumerate(zip(turned[..., 2], origins, strict=True)):
        joint, arm = i + 1, tip.translation - origin
        if chain.prismatic[i]:
            twist, by = np.hstack([np.zeros_like(z), z]), values[:, i, None, None]
            add(f"the value of joint {joint}, along its motion", twist[:, :, None] * by, joint)
            add(f"the value of joint {joint}", along * by, joint)
            continue
        twist = np.hstack([z, np.cross(z, arm)])
        add(f"the zero of joint {joint}", twist[:, :, None], joint)
        for turns, period in TURNS.items():
            waves = np.stack([np.cos(turns * values[:, i]), np.sin(turns * values[:, i])], axis=1)
            what = f"the angle of joint {joint}, {period}"
            add(f"{what}, along its motion", twist[:, :, None] * waves[:, None], joint, turns)
            add(what, np.einsum("dc,mt->mdct", along, waves).reshape(len(waves), 6, 6), joint, turns)
        approach = data.conditions.approach
        if approach is not None and approach[:, i].any():
            add(f"the direction from which joint {joint} came", twist[:, :, None] * approach[:, i, None, None], joint)
        torque = np.einsum("mi,mi->m", z, np.cross(arm, base[:, 2]))
        if np.abs(torque).max() > NEW * np.linalg.norm(arm, axis=1).max():
            what = f"gravity's torque about joint {joint}"
            add(what, (twist * torque[:, None])[:, :, None], joint)
    radial = np.linalg.norm(place[:, :2], axis=1)
    add("the scale of lengths", np.pad(place @ base.T, ((0, 0), (3, 0)))[:, :, None])
    add("the place, linearly", np.einsum("dc,mp->mdcp", along, place).reshape(len(place), 6, 9))
    add("the distance from the base's axis, up or down", along[:, 2, None] * radial[:, None, None])
    return candidates
