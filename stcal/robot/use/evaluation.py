"""Robots against measurements that they were not made from: distances before and after, and errors of robot files.

Verification is the test of the stereo-target paper. Distances from the first position need no common frame of robot and
instrument, but all carry its error; the distances of all pairs depend less on any one position.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy.special import stdtr

from stcal.errors import InputError
from stcal.geometry.arrays import freeze, require_arguments
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import length_limit, robust_sigma
from stcal.io.json import Named, Part, ResultFile, Vector
from stcal.io.table import Table, read_table
from stcal.robot.descriptions import few
from stcal.robot.identification.adjustment import (
    WIDTH,
    Observed,
    State,
    Weighting,
    frame_motions,
    observed,
    position_errors,
    tool_motions,
)
from stcal.robot.identification.prior import PlacedFrame
from stcal.robot.identification.result import Figures
from stcal.robot.identification.start import Fit, start
from stcal.robot.identification.unexplained import LEAST_FREEDOM, Effect, left
from stcal.robot.kinematics.measurements import Measurements, unread
from stcal.robot.kinematics.robot_model import Robot

WHAT = "measured positions"
SAME_MM = 1e-6
"""Distance below which two commanded positions count as the same command; it covers the rounding of printed numbers."""
MISSES, MISSES_MM = 0.05, 20.0
"""Largest RMS deviation of measured from commanded distances, as a share and in mm; arms err by under 1 %."""
OFF, OFF_MM, LEAST_POSES = 6.0, 0.1, 6
"""Ratio of a pose's typical error to that of most, and its size, from which on the pose is named; and least number of
poses for it; of fewer, an error of MISSES_MM is named."""
MOST_ELSEWHERE, MOST_COMPARED = 0.3, 1000
"""Largest share of the poses that may be named as elsewhere, and number up to which all are compared."""
NO_BETTER = 0.8  # ratio to the errors of the first set from which on they are about as large
MOST_OF_IT = 0.75  # share of the squared errors of distances from which on their scale is named
SCALE_WITHIN = 0.005  # relative difference of scale from which on it is named in any case
LEAST_SPREAD_MM = 20.0  # largest commanded distance below which the unit is doubted
NOT_COMPENSATED = (
    "is the first set in the file the one before compensation, and were the others commanded with compensated joint "
    "values, --robot of compensate being the file of identify?"
)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPoses:
    """Rows of a file. ``sets``, ``names`` : (m,) set and pose of each; ``commanded``, ``measured`` : (m, 3) mm, each in
    a frame of its own; ``notes`` : on columns that were not read."""

    where: str
    lines: Sequence[int]
    sets: tuple[str, ...]
    names: tuple[str, ...]
    commanded: np.ndarray
    measured: np.ndarray
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        m = len(self.lines)
        freeze(self, "commanded", (m, 3), "commanded positions")
        freeze(self, "measured", (m, 3), "measured positions")


class SetResult(Part):
    """Distance errors of one set, mm."""

    name: str
    error_mm: Vector
    mean_mm: float
    std_mm: float
    max_mm: float
    pairs_rms_mm: float
    pairs_mm: float
    scale: float
    elsewhere: str = ""

    def doubt(self) -> str:
        """Returns why the measured positions may not belong to the commands; empty if they may."""
        allowed, said = max(MISSES * self.pairs_mm, MISSES_MM), self.elsewhere
        by_scale, remedy = (self.scale - 1) * self.pairs_mm, "check units, and the instrument's scale"
        times = f"measured distances are {self.scale:.6g} times the commanded ones"
        if not said and by_scale**2 > MOST_OF_IT * self.pairs_rms_mm**2 > MOST_OF_IT * OFF_MM**2:
            said = f"{times}, which is most of their error: {remedy}"
        elif not said and self.pairs_rms_mm > allowed:
            missed = f"measured distances miss the commanded ones by {self.pairs_rms_mm:.4g} mm (RMS of all pairs)"
            remedy = "check the order of the poses, units, and the robot that commanded them"
            said = f"{missed}, {allowed:.3g} mm allowed; {remedy}"
        elif not said and abs(self.scale - 1) > SCALE_WITHIN:
            said = f"{times}, {1 - SCALE_WITHIN:g} to {1 + SCALE_WITHIN:g} allowed: {remedy}"
        return said and f"set {self.name}: {said}"

    def figures(self) -> dict[str, float]:
        """Returns the figures that are compared between sets, mm."""
        return {"mean": self.mean_mm, "std": self.std_mm, "max": self.max_mm, "all pairs RMS": self.pairs_rms_mm}


class Verification(ResultFile):
    """Distance errors of several sets of measurements, over the poses that all sets have: result file of ``verify``."""

    format: Literal["stcal verification 1"] = Field(description="the file's form and its version")
    poses: list[str] = Field(description="names, the first being the one that distances start from")
    distance_mm: Vector = Field(description="commanded distances of the others from it")
    sets: list[SetResult] = Field(
        description="`name`; `error_mm` measured minus commanded; `mean_mm`, `std_mm` (sample), `max_mm` of their "
        "absolute values; `pairs_rms_mm`, `pairs_mm` RMS of errors and of commanded distances of all pairs, `scale` of "
        "measured over commanded ones; `elsewhere`: poses that alone are not where they were commanded"
    )
    missing: dict[Annotated[str, "set"], list[str]] = Field(description="poses that a set lacks")
    warnings: list[str] = Field(description="what to look at")
    notes: list[str] = Field(description="columns that were not read")

    def reduction(self, index: int) -> dict[str, float]:
        """Returns the reduction of each figure of set ``index`` relative to the first set, per cent."""
        first, figures = self.sets[0].figures(), self.sets[index].figures()
        return {key: 100 * (1 - figures[key] / value) if value > 0 else float("nan") for key, value in first.items()}


def _warnings(sets: list[SetResult], missing: dict[str, list[str]], most_mm: float) -> list[str]:
    """Returns warnings of missing poses and of doubtful sets; ``most_mm`` : the longest commanded distance."""
    found = [
        f"set {name}: missing poses, left out of all sets ({len(poses)}): {few(poses)}"
        for name, poses in missing.items()
        if poses
    ]
    found += [doubt for each in sets if (doubt := each.doubt())]
    if most_mm < LEAST_SPREAD_MM:
        remedy = "if lengths are in another unit than the names of their columns say, correct these"
        found.append(f"commanded positions lie within {most_mm:.3g} mm of the first one; {remedy}")
    first, before = sets[0], sets[0].pairs_rms_mm
    found += [
        f"set {each.name}: errs by {each.pairs_rms_mm:.3g} mm (RMS of all pairs), "
        f"{'no' if each.pairs_rms_mm >= before else 'hardly'} less than set {first.name} with {before:.3g} mm: "
        f"{NOT_COMPENSATED}"
        for each in sets[1:]
        if not each.elsewhere and each.pairs_rms_mm > NO_BETTER * max(before, 1e-12)
    ]
    return found


def read_measured(path: str | Path | Table) -> MeasuredPoses:
    """Reads commanded positions in the robot's base and measured ones in the instrument's frame, mm.

    ``path`` : table (CSV; form: ``data_layout.md``). Raises InputError: missing columns, bad rows, or a pose twice in
    one set; the message names the line.
    """
    table = read_table(path, WHAT)
    commanded, measured = table.points("commanded_"), table.points()
    sets = tuple(table.text("set")) if "set" in table else ("measured",) * len(table)
    names = _names(table, sets, commanded)
    return MeasuredPoses(table.where, table.lines, sets, names, commanded, measured, unread(table))


def _names(table: Table, sets: tuple[str, ...], commanded: np.ndarray) -> tuple[str, ...]:
    """Returns the names of poses from column ``pose``, or else by equal commanded positions, counted within a set."""
    if "pose" in table:
        names, first = tuple(table.text("pose")), {}
        before = [first.setdefault(key, row) for row, key in enumerate(zip(sets, names, strict=True))]

        def again(i: int) -> str:
            fault = f"pose {names[i]} of set {sets[i]} stands on line {table.lines[before[i]]} already"
            return f"{fault}; give the sets different names"

        table.refuse(np.array(before) != np.arange(len(table)), "E-TABLE-ROW-REPEATED", again)
        return names
    places, numbers, times = {}, [], Counter()
    for name, xyz in zip(sets, np.round(commanded / SAME_MM).astype(np.int64).tolist(), strict=True):
        times[name, *xyz] += 1
        numbers.append(places.setdefault((*xyz, times[name, *xyz]), len(places) + 1))
    return tuple(map(str, numbers))


def verify(data: MeasuredPoses) -> Verification:
    """Returns the distance errors of each set of ``data``, over the poses that all sets have, mm.

    Distances from the first position need no common frame of robot and instrument (Zhang & Wei 2017, section 4.3).
    Raises InputError: fewer than three poses in common, or one pose commanded to different places.
    """
    rows: dict[str, dict[str, int]] = {}
    for i, (group, name) in enumerate(zip(data.sets, data.names, strict=True)):
        rows.setdefault(group, {})[name] = i
    every = dict.fromkeys(data.names)
    missing = {group: [name for name in every if name not in own] for group, own in rows.items()}
    common = [name for name in every if not any(name in lacking for lacking in missing.values())]
    if len(common) < 3:
        which = f"{'all of the sets ' if len(rows) > 1 else ''}{', '.join(rows)}"
        remedy = "at least 3 needed; are the commanded positions of the sets the same?"
        raise InputError("E-VERIFY-FEW", f"{data.where}: {len(common)} poses in {which}; {remedy}")
    index = {group: np.array([own[name] for name in common]) for group, own in rows.items()}
    first, at = next(iter(index.items()))
    for group, own in index.items():
        apart = np.abs(data.commanded[own] - data.commanded[at]).max(axis=1)
        if apart.max() > SAME_MM:
            k = int(apart.argmax())
            fault = f"{data.where}: pose {common[k]} is commanded {apart[k]:.4g} mm apart in sets {first} and {group}"
            raise InputError("E-VERIFY-COMMANDED", f"{fault} (line {data.lines[own[k]]}); the same commands needed")
    sets = []
    for group, own in index.items():
        copied = group != first and (data.measured[own] == data.measured[at]).all()
        sets.append(_set_result(data, group, own, common, COPIED if copied else ""))
    distances = np.linalg.norm(data.commanded[at[1:]] - data.commanded[at[0]], axis=1)
    return Verification(
        format="stcal verification 1",
        poses=common,
        distance_mm=distances,
        sets=sets,
        missing=missing,
        warnings=_warnings(sets, missing, float(distances.max())),
        notes=list(data.notes),
    )


COPIED = "measured positions are those of the first set to the last digit; give those of the instrument"


def _elsewhere(commanded: np.ndarray, measured: np.ndarray, names: Sequence[str]) -> str:
    """Returns which few poses (n, 3) miss most others by far more than these miss one another; else ""."""
    if (measured == commanded).all():
        return "measured positions are the commanded ones to the last digit; give those of the instrument"
    wanted, found = (np.linalg.norm(xyz[:, None] - xyz, axis=2) for xyz in (commanded, measured))
    typical = np.median(np.abs(found - wanted), axis=1)
    far = typical > max(OFF * np.median(typical), OFF_MM if len(names) >= LEAST_POSES else MISSES_MM)
    if not 0 < far.mean() <= MOST_ELSEWHERE:
        return ""
    listed = few([f"{names[i]} ({typical[i]:.2g} mm)" for i in np.flatnonzero(far).tolist()])
    others = f"far worse than the others, {np.median(typical):.2g} mm (median)"
    return f"pose{'s' * int(far.sum() > 1)} {listed}: {others}: correct the rows, or measure again"


def _set_result(data: MeasuredPoses, name: str, rows: np.ndarray, names: Sequence[str], elsewhere: str) -> SetResult:
    commanded, measured = data.commanded[rows], data.measured[rows]
    error = np.linalg.norm(measured[1:] - measured[0], axis=1) - np.linalg.norm(commanded[1:] - commanded[0], axis=1)
    sums = np.zeros(4)  # row by row: all pairs of thousands at once are gigabytes
    for i in range(1, len(measured)):
        seen, wanted = (np.linalg.norm(xyz[:i] - xyz[i], axis=1) for xyz in (measured, commanded))
        sums += ((seen - wanted) ** 2).sum(), seen @ wanted, wanted @ wanted, i
    squares, product, commanded_squares, pairs = sums.tolist()
    if commanded_squares == 0:
        fault = f"{data.where}: set {name}: all commanded positions are the same"
        raise InputError("E-VERIFY-ALIKE", f"{fault}; different ones needed")
    size = np.abs(error)
    if not elsewhere and len(names) <= MOST_COMPARED:
        elsewhere = _elsewhere(commanded, measured, names)
    return SetResult(
        name=name,
        error_mm=error,
        mean_mm=float(size.mean()),
        std_mm=float(size.std(ddof=1)),
        max_mm=float(size.max()),
        pairs_rms_mm=float(np.sqrt(squares / pairs)),
        pairs_mm=float(np.sqrt(commanded_squares / pairs)),
        scale=product / commanded_squares,
        elsewhere=elsewhere,
    )


Refit = Literal["none", "base", "tool", "base-tool"]
FALSE_ALARM, SURELY = 1e-3, 1.5
"""False-alarm probability per row, and factor on its limit, as a model's residuals have longer tails than noise."""
LEAST_MM = 1e-3  # error below which a row is never wrong, as no instrument shows less
UNSEEN, CHANCE = 1e-12, 0.05
"""Least relative visibility of parameters, below which σ is huge; probability of calling one of two equals better."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Mean error of ``worse`` minus ``better`` on the same rows; ``p`` : by chance, times the number of comparisons."""

    better: str
    worse: str
    mm: float
    sigma_mm: float
    p: float

    @property
    def real(self) -> bool:
        return self.p < CHANCE


@dataclass(frozen=True, slots=True, eq=False)
class Evaluated:
    """Errors of one robot at the r observations, with base and tools as fitted.

    ``residuals`` : (r, 3) measured minus modelled position in the base's axes, or (r, 1) distance; mm; ``good`` : (r,)
    rows that some robot explains; ``rotation_rad`` : (r,) errors of orientations, if measured; ``left`` : effects found
    in the residuals, None of too few rows; ``beyond`` : the same after a fit of all kinematic parameters.
    """

    robot: Robot
    state: State
    residuals: np.ndarray
    good: np.ndarray
    rotation_rad: np.ndarray
    placed: tuple[PlacedFrame, ...]
    left: tuple[Effect, ...] | None
    beyond: tuple[Effect, ...] | None

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.robot.name

    @property
    def errors_mm(self) -> np.ndarray:
        """Lengths (r,) of the position errors, mm."""
        return position_errors(self.residuals)

    @property
    def position_mm(self) -> Figures:
        """Summary of the errors of all rows."""
        return Figures.of(self.errors_mm)

    @property
    def good_mm(self) -> Figures:
        """Summary of the errors of good rows."""
        return Figures.of(self.errors_mm[self.good])

    @property
    def orientation_rad(self) -> Figures | None:
        """Summary of the errors of orientations, if any were measured."""
        return Figures.of(self.rotation_rad) if len(self.rotation_rad) else None


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Robots, in the order given, on one set of r observations: positions or distances.

    ``refit`` : what was fitted of each robot; ``wrong`` : (r,) rows that no robot explains, which were not fitted;
    ``differences`` : the robot of least mean error against each other one, in order of their means.
    """

    format: ClassVar = "stcal evaluation 1"
    refit: Refit
    seen: Observed
    robots: tuple[Evaluated, ...]
    wrong: np.ndarray
    differences: tuple[Difference, ...]

    @property
    def best(self) -> str:
        """Name of the robot that is better than all others beyond chance; empty if there is none."""
        return self.differences[0].better if self.differences and all(d.real for d in self.differences) else ""

    @property
    def observed(self) -> str:
        """What was compared: positions or distances."""
        return f"{self.seen.kind}s"

    @property
    def lines(self) -> list[int]:
        """Lines (r,) of the file."""
        return self.seen.lines

    @property
    def wrong_lines(self) -> list[int]:
        """Lines of the rows that no robot explains."""
        return [self.lines[row] for row in np.flatnonzero(self.wrong)]


class EvaluationFile(ResultFile):
    """Result file of ``evaluate``."""

    format: Literal["stcal evaluation 1"] = Field(description="the file's form and its version")
    refit: str = Field(description="what was fitted: `none`, `base`, `tool` or `base-tool`")
    observed: str = Field(description="positions or distances")
    lines: list[int] = Field(description="of the data file, of each row")
    wrong_lines: list[int] = Field(description="those that no robot explains; nothing was fitted to them")
    best: str = Field(description="the robot that is better than all others by more than chance; empty: none is")
    robots: list[
        Annotated[Evaluated, Named("name position_mm good_mm orientation_rad placed left beyond residuals")]
    ] = Field(
        description="`name`, and of their errors `position_mm` (of distances for those) of all rows, `good_mm` without "
        "the wrong ones, `orientation_rad` where measured: `rows`, `mean`, `median`, `rms`, `p95`, `max`; `placed` as "
        "of `identify`, null what is the file's; what the residuals go with, `left`, and what an identification from "
        "these rows would leave, `beyond`: as `left` of `identify`; `residuals` of each row: measured minus modelled "
        "position in the base, or distance, mm"
    )
    differences: list[Difference] = Field(
        description="`mm`: mean error of the `worse` robot less that of the `better` on the same rows without the "
        "wrong ones, its `sigma_mm`, and `p` times the number of comparisons"
    )


@require_arguments
def evaluate(robots: Mapping[str, Robot], data: Measurements, refit: Refit = "base-tool") -> Evaluation:
    """Returns the errors of robots at measurements, with base and tools fitted or not.

    Parameters
    ----------
    robots : robots by name; mm, rad.
    data : joint values with the measurements made at them, in the instrument's frame.
    refit : what is fitted by least squares with each robot's own axes; the rest is as its file has it.

    Returns
    -------
    Evaluation : errors by row, the better robot, and the effects found in residuals; mm, in the axes of each robot's
        base.

    Raises InputError: a robot of other joints, or that does not fit the data; a tool that it does not have. Raises
    DegenerateError: too few rows for what is fitted, or positions that do not show it.
    """
    fit: Fit = frozenset(part for part in ("base", "tool") if part in refit.split("-"))
    named = {name: replace(robot, name=name) for name, robot in robots.items()}
    for name, robot in named.items():
        if (joints := len(robot.rows)) != data.q.shape[1]:
            fault = f"{data.where}: {data.q.shape[1]} joint values, robot {name} has {joints} joints"
            raise InputError("E-ROBOT-MISMATCH", fault)
    seen = observed(data, None if data.positions is None else "position")
    what = f"parameters of {' and '.join(sorted(fit))}"
    seen.require_more_than(_parameters(seen, fit), what, "or fit less (--refit)")
    states, wrong = _fitted(list(named.values()), seen, fit)
    pairs = zip(named.values(), states, strict=True)
    found = tuple(_evaluated(robot, state, seen, fit, wrong) for robot, state in pairs)
    return Evaluation(refit, seen, found, wrong, _differences(found, ~wrong))


def _parameters(measured: Observed, fit: Fit) -> int:
    base = 6 if "base" in fit and measured.kind != "distance" else 0
    return base + (3 * len(set(measured.data.targets)) if "tool" in fit else 0)


def _fitted(robots: list[Robot], measured: Observed, fit: Fit) -> tuple[list[State], np.ndarray]:
    """Returns the states of all robots, and a mask (r,) of rows (never of distances) that none explains: not fitted."""
    wrong, width, targets = np.zeros(len(measured), bool), WIDTH[measured.kind], np.array(measured.data.targets)
    freedom = width * len(measured) - _parameters(measured, fit)
    for _ in range(5):
        kept = measured[~wrong].data
        states = [start(robot, kept, fit) for robot in robots]
        errors = np.array([position_errors(state.residuals(measured)) for state in states])
        sigma = min(robust_sigma(each[~wrong], width, freedom / width / len(measured)) for each in errors)
        now = errors.min(0) > max(SURELY * sigma * length_limit(width, FALSE_ALARM / len(measured)), LEAST_MM)
        left_out = set(targets[measured.first]) - set(targets[measured.first[~now]])
        if freedom < LEAST_FREEDOM or (now == wrong).all() or left_out:
            break
        wrong = now
    return states, wrong


def _evaluated(robot: Robot, state: State, measured: Observed, fit: Fit, wrong: np.ndarray) -> Evaluated:
    base = state.chain.gap(0) @ replace(robot, world_from_base=Rigid()).chain().gap(0).inverse()
    in_base, rotation = state.residuals(measured), np.zeros(0)
    if measured.data.rotations is not None:
        whole = observed(measured.data, "pose")
        rotation = np.linalg.norm(state.residuals(whole)[:, :3], axis=1)
    good = measured[np.flatnonzero(~wrong)]
    tip, moves = state.tips_of(good.data), [np.zeros((len(good.data), 6, 0))]
    if "base" in fit and good.kind != "distance":
        moves.append(frame_motions(tip.translation, base.translation))
    if "tool" in fit:
        moves += [tool_motions(tip, good.data.targets, name, good.kind) for name in state.tools]
    fitted, one = state.as_seen(good, tip, np.concatenate(moves, axis=2)), Weighting(1.0, 1.0)
    seeks = np.concatenate([fitted, state.jacobian(good)], axis=2)
    if in_base.shape[1] == 3:
        in_base = (in_base[:, None] @ state.seen_from(measured.data.stations).rotation)[:, 0] @ base.rotation
    return Evaluated(
        robot=replace(robot, world_from_base=base, tools=state.tools),
        state=state,
        residuals=in_base,
        good=~wrong,
        rotation_rad=rotation,
        placed=_placed(state, base, state.residuals(good), fitted, fit, good.kind != "distance"),
        left=left(state, base, good, one, fitted),
        beyond=left(state, base, good, one, seeks),
    )


def _placed(
    state: State, base: Rigid, found: np.ndarray, fitted: np.ndarray, fit: Fit, with_base: bool
) -> tuple[PlacedFrame, ...]:
    """Returns the placements with σ from the residuals ``found`` (r, w) and the derivatives ``fitted`` (r, w, k)."""
    flat, k = fitted.reshape(found.size, -1), fitted.shape[2]
    size = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    seen, directions = np.linalg.eigh((flat / size).T @ (flat / size))
    inverse = directions / np.maximum(seen, UNSEEN) @ directions.T / size / size[:, None]
    covariance = found.ravel() @ found.ravel() / max(found.size - k, 1) * inverse
    at, unknown = 6 * (with_base and "base" in fit), np.full(6, np.nan)
    placed = [PlacedFrame("base", base, np.sqrt(np.diag(covariance)[:6]) if at else unknown)] if with_base else []
    for name, tool in state.tools.items():
        sigma = unknown.copy()
        if "tool" in fit:
            own = tool.rotation @ covariance[at : at + 3, at : at + 3] @ tool.rotation.T
            sigma[3:], at = np.sqrt(np.diag(own)), at + 3
        placed.append(PlacedFrame(f"tool {name}".rstrip(), tool, sigma))
    return tuple(placed)


def _differences(robots: tuple[Evaluated, ...], good: np.ndarray) -> tuple[Difference, ...]:
    """Returns paired differences between robots; errors of rows that are hard for all robots cancel in them."""
    order = sorted(robots, key=lambda each: each.errors_mm[good].mean())
    better, found = order[0], []
    for worse in order[1:]:
        apart = (worse.errors_mm - better.errors_mm)[good]
        mean, sigma = float(apart.mean()), float(apart.std(ddof=1) / np.sqrt(len(apart))) if len(apart) > 1 else np.inf
        p = 2 * stdtr(len(apart) - 1, -mean / sigma) if 0 < sigma < np.inf else float(mean == 0 or sigma > 0)
        found.append(Difference(better.name, worse.name, mean, sigma, float(min(1.0, (len(order) - 1) * p))))
    return tuple(found)
