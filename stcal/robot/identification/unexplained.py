"""F tests of effects that a model leaves in the residuals: of a joint's angle, gravity, place, or order of the rows."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import fdtrc

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import WIDTH, Observed, State, Weighting, frame_motions, tool_motions
from stcal.robot.identification.problem import GROSS
from stcal.robot.kinematics.forward import joint_frames, joint_motions
from stcal.row_order import Change, changes_along

LEVEL = 0.01  # probability that anything is reported of a clean set; it is divided among the tests (Bonferroni)
MOST = 3  # largest number of findings, the strongest first
LEAST_SHARE, LEAST_MM, LEAST_RAD = 0.01, 1e-3, 1e-6
"""Smallest share of the squared residuals, and smallest RMS effects, that are worth a sentence."""
LEAST_FREEDOM = 10  # smallest number of degrees of freedom that allows a test
NEW, SAME = 1e-3, 1e-9
"""Share of a motion that must be left beside the parameters, and share below which a remainder is rounding."""
SHARED = 4  # number of distances from one position from which on the error of this position counts as a parameter
TURNS = {1: "once a turn", 2: "twice a turn"}


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect found in the residuals; the result file of ``identify`` describes the fields (``left``)."""

    what: str
    joint: int
    turns: int
    effect_mm: float
    effect_rad: float
    share: float
    p: float
    line: int | None = None
    advice: str = ""

    def sentence(self) -> str:
        """Returns the finding as a sentence."""
        size = f"{self.effect_mm:.2g} mm" + (f" and {np.degrees(self.effect_rad):.2g}°" if self.effect_rad else "")
        size = size if self.advice else f"amplitude {size}" if self.turns else f"{size} RMS"
        chance = "p < 0.001" if self.p < 1e-3 else f"p = {self.p:.2g}"
        advice = f"; {self.advice}" if self.advice else ""
        return f"residuals go with {self.what}: {size}, {self.share:.0%} of their squares, {chance}{advice}"


def left(
    state: State,
    world_from_base: Rigid,
    measured: Observed,
    weighting: Weighting,
    explained: np.ndarray | None = None,
    weights: np.ndarray | None = None,
) -> tuple[Effect, ...] | None:
    """Returns the effects found in the residuals of ``state``, at most three, the strongest first; None for too few
    rows. Along the order of the rows, a jump or drift is tried with all rows: half may seem errors. ``explained`` : (r,
    w, k) derivatives by the fitted parameters, all if None; ``weights`` : (r,), those below 0.5 are left out."""
    explained = state.jacobian(measured) if explained is None else explained
    explained = np.concatenate([explained, _shared(state, measured)], axis=2)
    errors, white = state.residuals(measured), partial(weighting.whiten, measured=measured)
    candidates, order = _candidates(state, measured, world_from_base), _order(state, measured)
    weights = np.ones(len(errors)) if weights is None else weights
    root = np.sqrt(weights) * (weights >= GROSS)
    findings, tests, square = [], len(candidates) + len(order), 0.0
    while len(findings) < MOST:
        rest = _Rest.of(errors, white, explained, root)
        square = max(square, float(rest.remaining @ rest.remaining))
        by_itself = rest.strongest(candidates, len(order), square)
        in_order = _moved_meanwhile(errors, white, measured.lines, order, explained, tests)
        tried = [each for each in (by_itself, in_order) if each is not None]
        if not tried:
            return tuple(findings) if findings or rest.freedom >= LEAST_FREEDOM else None
        found = min(tried, key=lambda each: each.log_p)
        findings.append(found.finding)
        explained, root = np.concatenate([explained, found.motions], axis=2), found.root
        square = 0.0 if found is in_order else square  # shares are of what is left beside a jump, which may hide all
    return tuple(findings)


Whiten = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class _Effect:
    """What may be in the residuals, or may have moved between two rows. ``motions`` : (r, w, c) as observed, in any
    scale, of what may have moved rad over mm where c is 6; ``advice`` : what to do about a jump; ``slides`` : True for
    a prismatic joint, whose motion is in mm."""

    what: str
    joint: int
    motions: np.ndarray
    turns: int = 0
    advice: str = ""
    slides: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """A finding, its log chance, its ``motions`` (r, w, c), and roots (r,) of the weights of the rows, 0 for errors."""

    finding: Effect
    log_p: float
    motions: np.ndarray
    root: np.ndarray

    @classmethod
    def of(cls, finding: Effect, log_p: float, motions: np.ndarray, root: np.ndarray) -> "_Found | None":
        """Returns the finding, with its probability, if it is beyond chance, and not tiny."""
        tiny = finding.share < LEAST_SHARE or (finding.effect_mm < LEAST_MM and finding.effect_rad < LEAST_RAD)
        if tiny or log_p > np.log(LEVEL):
            return None
        return cls(replace(finding, p=float(np.exp(min(log_p, 0.0)))), log_p, motions, root)


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """The part ``remaining`` of whitened residuals (N,) that ``fitted`` (N, k) does not explain. ``errors`` : (r, w);
    ``root`` : (r,) roots of the weights, 0 for rows left out; ``weighted`` : whitens values (r, w, c) to (N, c)."""

    errors: np.ndarray
    root: np.ndarray
    weighted: Whiten
    before: np.ndarray
    fitted: np.ndarray
    remaining: np.ndarray
    freedom: int

    @classmethod
    def of(cls, errors: np.ndarray, white: Whiten, explained: np.ndarray, root: np.ndarray) -> "_Rest":
        """Returns the residuals that the motions ``explained`` (r, w, k) leave of ``errors`` (r, w)."""

        def weighted(values: np.ndarray) -> np.ndarray:
            return (root[:, None, None] * white(values)).reshape(errors.size, -1)

        before, fitted = weighted(errors[..., None]).ravel(), _basis(_unit(weighted(explained)), SAME)
        freedom = np.count_nonzero(root) * errors.shape[1] - fitted.shape[1]
        return cls(errors, root, weighted, before, fitted, before - fitted @ (fitted.T @ before), freedom)

    def strongest(self, candidates: list[_Effect], others: int, square: float) -> _Found | None:
        """Returns what explains most beyond chance; ``others`` : further tests; ``square`` : of the first residuals."""
        if self.freedom < LEAST_FREEDOM:
            return None
        tried = [(each, test) for each in candidates if (test := self._tested(self.weighted(each.motions)))]
        if not tried:
            return None
        candidate, (log_p, takes) = min(tried, key=lambda each: each[1][0])
        amplitude, good = np.sqrt(2) if candidate.turns else 1.0, self.root > 0

        def size(part: slice) -> float:
            """Returns the amplitude, or RMS, of what the candidate takes, rad or mm."""
            parts = (each.reshape(self.errors.shape)[good, part] for each in (self.errors, self.before, takes))
            unit, white, taken = (float((each**2).sum()) for each in parts)
            return float(amplitude * np.sqrt(unit / np.count_nonzero(good) / max(white, 1e-300) * taken))

        mm, rad = size(slice(-3, None)), size(slice(0, 3)) if self.errors.shape[1] == 6 else 0.0
        share = float(takes @ takes) / max(square, 1e-300)
        finding = Effect(candidate.what, candidate.joint, candidate.turns, mm, rad, share, 1.0)
        return _Found.of(finding, log_p + float(np.log(len(tried) + others)), candidate.motions, self.root)

    def _tested(self, values: np.ndarray) -> tuple[float, np.ndarray] | None:
        """Returns log p of the F test of what ``values`` (N, c) add, and what they explain (N,); None if nothing."""
        values = _unit(values)
        new = _basis(values - self.fitted @ (self.fitted.T @ values), NEW)
        c = new.shape[1]
        if c == 0 or self.freedom - c < 1:
            return None
        takes = new @ (new.T @ self.remaining)
        left_over = self.remaining - takes
        ratio = float(takes @ takes) / c / max(float(left_over @ left_over) / (self.freedom - c), 1e-300)
        return float(np.log(max(fdtrc(c, self.freedom - c, ratio), np.finfo(float).tiny))), takes


def _unit(values: np.ndarray) -> np.ndarray:
    """Returns the columns (N, c) scaled to length 1, without those of length 0."""
    size = np.linalg.norm(values, axis=0)
    return values[:, size > 0] / size[size > 0]


def _basis(values: np.ndarray, least: float) -> np.ndarray:
    """Returns an orthonormal basis (N, c) of directions in which unit columns differ by more than ``least``."""
    u, s, _ = np.linalg.svd(values, full_matrices=False)
    return u[:, s > least]


def _shared(state: State, measured: Observed) -> np.ndarray:
    """Returns shifts (r, w, c) of positions from which several distances start: each is in all of its distances."""
    starts, counts = np.unique(measured.second, return_counts=True)
    starts = starts[counts >= SHARED]
    if measured.kind != "distance" or not len(starts):
        return np.zeros((len(measured), WIDTH[measured.kind], 0))
    away = measured.along(state.tips_of(measured.data))
    return np.concatenate([away * (measured.second == row)[:, None] for row in starts], axis=1)[:, None]


DRIFTS = "let the instrument warm up, and measure a fixed point now and then"


def _order(state: State, measured: Observed) -> list[_Effect]:
    """Returns what may move during the measurements; none for distances, which no frame enters."""
    if measured.used == "distance":
        return []
    tip, data, order = state.tips_of(measured.data), measured.data, []

    def add(what: str, motions: np.ndarray, advice: str, joint: int = 0, slides: bool = False) -> None:
        order.append(_Effect(what, joint, state.as_seen(measured, tip, motions), 0, advice, slides))

    another = "name these rows another {0} (column {0}), or measure again"
    frame = frame_motions(tip.translation, tip.translation.mean(0))
    add("the instrument or the robot's base elsewhere", frame, another.format("station"))
    for name in dict.fromkeys(data.targets):
        on_flange = tool_motions(tip, data.targets, name, measured.kind)
        what = f"target {name} elsewhere on its flange" if name else "the target elsewhere on its flange"
        add(what, on_flange, another.format("target"))
    twists = joint_motions(state.chain, data.q, tip, data.conditions) * state.chain.carries(data.targets)[:, :, None]
    for i, (twist, slides) in enumerate(zip(twists, state.chain.prismatic.tolist(), strict=True), 1):
        advice = "look whether it slipped, and measure again"
        add(f"the zero of joint {i} another one", twist[:, :, None], advice, i, slides)
    return order


def _moved_meanwhile(
    errors: np.ndarray, white: Whiten, lines: list[int], order: list[_Effect], explained: np.ndarray, tests: int
) -> _Found | None:
    """Returns the jump or the drift along the order of the rows; None if there is none beyond chance."""
    changes = changes_along(white(errors), white(explained), [white(each.motions) for each in order])
    found = [(each, change) for each, change in zip(order, changes, strict=True) if change is not None]
    if not found:
        return None
    moved, change = min(found, key=lambda each: each[1].log_p)
    when, line, advice = "by and by", None, DRIFTS
    if change.kind != "drift":
        line, advice = lines[change.row], moved.advice
        likely = f" ({lines[change.first]} to {lines[change.last]} as likely)" if change.first < change.last else ""
        when = f"from line {line}{likely} on"
    what, size = f"the order of the rows, {moved.what} {when}", _size(moved, change)
    finding = Effect(what, moved.joint, 0, *size, change.share, 1.0, line, advice)
    taken = change.moves[:, None, None] * moved.motions
    return _Found.of(finding, change.log_p + float(np.log(tests)), taken, change.good.astype(float))


def moved_meanwhile(state: State, measured: Observed, share: float = 0.0) -> Effect | None:
    """Returns the jump or drift along the rows, of equal σ; None without one of more than ``share`` of the squares."""
    order, errors = _order(state, measured), state.residuals(measured)
    white = partial(Weighting(1.0, 1.0).whiten, measured=measured)
    found = _moved_meanwhile(errors, white, measured.lines, order, state.jacobian(measured), len(order))
    return found.finding if found is not None and found.finding.share > share else None


def _size(moved: _Effect, change: Change) -> tuple[float, float]:
    """Returns the size of a change, mm and rad: of frames at the middle of the places, of joints as seen."""
    if moved.motions.shape[2] == 6:
        return float(np.linalg.norm(change.motion[3:])), float(np.linalg.norm(change.motion[:3]))
    as_measured = np.linalg.norm((moved.motions @ change.motion)[:, -3:], axis=1)
    turns = moved.joint and not moved.slides and len(change.motion) == 1
    turned = float(abs(change.motion[0])) if turns else 0.0
    return float(np.sqrt((as_measured**2).mean())), turned


def _candidates(state: State, measured: Observed, world_from_base: Rigid) -> list[_Effect]:
    """Returns what may go with the place, or with the values and torques of joints."""
    chain, data = state.chain, measured.data
    tip = state.tips_of(data)
    turned, origins = joint_frames(chain, data.q, data.conditions)
    base, place = world_from_base.rotation, world_from_base.inverse() @ tip.translation
    along = np.concatenate([np.zeros((3, 3)), base])  # motions along the base's axes
    values, carries, candidates = data.q @ chain.coupling.T, chain.carries(data.targets), []

    def add(what: str, motions: np.ndarray, joint: int = 0, turns: int = 0) -> None:
        if joint:
            motions = motions * carries[joint - 1, :, None, None]
        candidates.append(_Effect(what, joint, state.as_seen(measured, tip, motions), turns))

    twists = joint_motions(chain, data.q, tip, data.conditions)[..., None]
    for i, (z, origin, twist) in enumerate(zip(turned[..., 2], origins, twists, strict=True)):
        joint, arm, own = i + 1, tip.translation - origin, values[:, i, None, None]
        for k in [k for k in range(len(chain)) if k != i]:
            what = f"the value of joint {k + 1}, along the motion of joint {joint}"
            add(f"{what}, as of a coupling that the robot file does not state", twist * values[:, k, None, None], joint)
        if chain.prismatic[i]:
            add(f"the value of joint {joint}, along its motion", twist * own, joint)
            add(f"the value of joint {joint}", along * own, joint)
            continue
        add(f"the zero of joint {joint}", twist, joint)
        for turns, period in TURNS.items():
            waves = np.stack([np.cos(turns * values[:, i]), np.sin(turns * values[:, i])], axis=1)
            what = f"the angle of joint {joint}, {period}"
            add(f"{what}, along its motion", twist * waves[:, None], joint, turns)
            add(what, np.einsum("dc,mt->mdct", along, waves).reshape(len(waves), 6, 6), joint, turns)
        approach = data.conditions.approach
        if approach is not None and approach[:, i].any():
            add(f"the direction from which joint {joint} came", twist * approach[:, i, None, None], joint)
        torque = np.einsum("mi,mi->m", z, np.cross(arm, base[:, 2]))
        if np.abs(torque).max() > NEW * np.linalg.norm(arm, axis=1).max():
            add(f"gravity's torque about joint {joint}", twist * torque[:, None, None], joint)
    radial = np.linalg.norm(place[:, :2], axis=1)
    add("the scale of lengths", np.pad(place @ base.T, ((0, 0), (3, 0)))[:, :, None])
    add("the place, linearly", np.einsum("dc,mp->mdcp", along, place).reshape(len(place), 6, 9))
    add("the distance from the base's axis, up or down", along[:, 2, None] * radial[:, None, None])
    return candidates
