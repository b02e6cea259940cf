"""Evaluation of robot files by measurements that they were not made from: errors by row, and their causes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy.stats import t as t_distribution

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import length_limit, robust_sigma
from stcal.io.json import Matrix, Part, ResultFile
from stcal.robot.identification.adjustment import (
    WIDTH,
    Observed,
    State,
    Weighting,
    as_seen,
    frame_motions,
    jacobian,
    observed,
    position_errors,
    residuals,
    tips_of,
    tool_motions,
)
from stcal.robot.identification.prior import Placed
from stcal.robot.identification.result import Figures, PlacedPose
from stcal.robot.identification.start import Fit, start
from stcal.robot.identification.unexplained import LEAST_FREEDOM, Finding, left
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot

Refit = Literal["none", "base", "tool", "base-tool"]
FALSE_ALARM, SURELY = 1e-3, 1.5
"""False-alarm probability per row, and factor on its limit, as a model's residuals have longer tails than noise."""
LEAST_MM = 1e-3
"""Error below which a row is never wrong, as no instrument shows less."""
ROUNDS = 5
"""Largest number of rounds of fitting without gross errors; one or two are usually enough."""
UNSEEN = 1e-12
"""Relative visibility of a direction of parameters below which its σ is set to a huge value."""
CHANCE = 0.05
"""Probability of calling one of two equal robots better."""


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
    rows that some robot explains; ``rotation_rad`` : (r,) errors of orientations, empty if none were measured;
    ``left`` : effects found in the residuals, None if there are too few rows for a test; ``beyond`` : the same after a
    fit of all kinematic parameters to these rows.
    """

    robot: Robot
    state: State
    residuals: np.ndarray
    good: np.ndarray
    rotation_rad: np.ndarray
    placed: tuple[Placed, ...]
    left: tuple[Finding, ...] | None
    beyond: tuple[Finding, ...] | None

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

    ``refit`` : what was fitted of each robot; ``wrong`` : (r,) rows that no robot explains: they are wrong, or all
    models lack an effect; nothing was fitted to them; ``differences`` : the robot of least mean error against each
    other one, in order of their means.
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
        return [line for line, wrong in zip(self.lines, self.wrong, strict=True) if wrong]


FINDING = "`what`, `joint`, `turns`, `effect_mm`, `effect_rad`, `share`, `p`, `line`, `advice`"


class EvaluatedRobot(Part):
    name: str
    position_mm: Figures
    good_mm: Figures
    orientation_rad: Figures | None
    placed: list[PlacedPose] = Field(description="as of `identify`: `name`, `pose`, `sigma`; null what is the file's")
    left: list[Finding] | None = Field(description=f"what the residuals go with: {FINDING}; null of too few rows")
    beyond: list[Finding] | None = Field(description=f"what an identification from these rows would leave: {FINDING}")
    residuals: Matrix = Field(description="of each row: measured minus modelled position in the base, or distance, mm")


class EvaluationFile(ResultFile):
    """Result file of ``evaluate``."""

    format: Literal["stcal evaluation 1"] = Field(description="the file's form and its version")
    refit: str = Field(description="what was fitted: `none`, `base`, `tool` or `base-tool`")
    observed: str = Field(description="positions or distances")
    lines: list[int] = Field(description="of the data file, of each row")
    wrong_lines: list[int] = Field(description="those that no robot explains; nothing was fitted to them")
    best: str = Field(description="the robot that is better than all others by more than chance; empty: none is")
    robots: list[EvaluatedRobot] = Field(
        description="`name`, and of their errors `position_mm` (of distances for those) of all rows, `good_mm` without "
        "the wrong ones, `orientation_rad` where measured: `rows`, `mean`, `median`, `rms`, `p95`, `max`"
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
    Evaluation
        Errors by row, the better robot, and the effects found in residuals; mm, in the axes of each robot's base.

    Raises
    ------
    InputError : a robot of other joints, or that does not fit the data; a tool that it does not have.
    DegenerateError : too few rows for what is fitted, or positions that do not show it.
    """
    fit: Fit = frozenset(part for part in ("base", "tool") if part in refit.split("-"))
    named = {name: replace(robot, name=name) for name, robot in robots.items()}
    for name, robot in named.items():
        if len(robot.rows) != data.q.shape[1]:
            raise InputError(
                "E-ROBOT-MISMATCH",
                f"{data.where}: {data.q.shape[1]} joint values, robot {name} has {len(robot.rows)} joints",
            )
    seen = observed(data, None if data.positions is None else "position")
    what = f"parameters of {' and '.join(sorted(fit))}"
    seen.require_more_than(_parameters(seen, fit), what, "or fit less (--refit)")
    states, wrong = _fitted(list(named.values()), seen, fit)
    found = tuple(
        _evaluated(robot, state, seen, fit, wrong) for robot, state in zip(named.values(), states, strict=True)
    )
    return Evaluation(refit, seen, found, wrong, _differences(found, ~wrong))


def _parameters(measured: Observed, fit: Fit) -> int:
    base = 6 if "base" in fit and measured.kind != "distance" else 0
    return base + (3 * len(set(measured.data.targets)) if "tool" in fit else 0)


def _fitted(robots: list[Robot], measured: Observed, fit: Fit) -> tuple[list[State], np.ndarray]:
    """Returns the states of all robots, and a mask (r,) of rows (never of distances) that none explains: not fitted."""
    wrong, width, targets = np.zeros(len(measured), bool), WIDTH[measured.kind], np.array(measured.data.targets)
    freedom = width * len(measured) - _parameters(measured, fit)
    for _ in range(ROUNDS):
        kept = measured[~wrong].data
        states = [start(robot, kept, fit) for robot in robots]
        errors = np.array([position_errors(residuals(state, measured)) for state in states])
        sigma = min(robust_sigma(each[~wrong], width, freedom / width / len(measured)) for each in errors)
        now = errors.min(0) > max(SURELY * sigma * length_limit(width, FALSE_ALARM / len(measured)), LEAST_MM)
        left_out = set(targets[measured.first]) - set(targets[measured.first[~now]])
        if freedom < LEAST_FREEDOM or (now == wrong).all() or left_out:
            break
        wrong = now
    return states, wrong


def _evaluated(robot: Robot, state: State, measured: Observed, fit: Fit, wrong: np.ndarray) -> Evaluated:
    base = state.chain.gap(0) @ replace(robot, world_from_base=Rigid()).chain().gap(0).inverse()
    in_base, rotation = residuals(state, measured), np.zeros(0)
    if measured.data.rotations is not None:
        whole = observed(measured.data, "pose")
        rotation = np.linalg.norm(residuals(state, whole)[:, :3], axis=1)
    good = measured[np.flatnonzero(~wrong)]
    tip, parts = tips_of(state, good.data), [np.zeros((len(good), WIDTH[good.kind], 0))]
    if "base" in fit and good.kind != "distance":
        parts.append(as_seen(state, good, tip, frame_motions(tip, base.translation)))
    if "tool" in fit:
        tools = (tool_motions(tip, good.data.targets, name, good.kind) for name in state.tools)
        parts += [as_seen(state, good, tip, moves) for moves in tools]
    fitted, one = np.concatenate(parts, axis=2), Weighting(1.0, 1.0)
    seeks = np.concatenate([fitted, jacobian(state, good)], axis=2)
    if in_base.shape[1] == 3:
        stations = [state.stations[measured.data.stations[row]].rotation for row in measured.first]
        in_base = np.einsum("nji,nj->ni", np.array(stations), in_base) @ base.rotation
    return Evaluated(
        robot=replace(robot, world_from_base=base, tools=state.tools),
        state=state,
        residuals=in_base,
        good=~wrong,
        rotation_rad=rotation,
        placed=_placed(state, base, residuals(state, good), fitted, fit, good.kind != "distance"),
        left=left(state, base, good, one, fitted),
        beyond=left(state, base, good, one, seeks),
    )


def _placed(
    state: State, base: Rigid, found: np.ndarray, fitted: np.ndarray, fit: Fit, with_base: bool
) -> tuple[Placed, ...]:
    """Returns the placements with σ from the residuals ``found`` (r, w) and the derivatives ``fitted`` (r, w, k)."""
    flat, k = fitted.reshape(found.size, -1), fitted.shape[2]
    size = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    seen, directions = np.linalg.eigh((flat / size).T @ (flat / size))
    inverse = directions / np.maximum(seen, UNSEEN) @ directions.T / size / size[:, None]
    covariance = found.ravel() @ found.ravel() / max(found.size - k, 1) * inverse
    at, placed = 0, []
    if with_base:
        sigma = np.full(6, np.nan)
        if "base" in fit:
            sigma, at = np.sqrt(np.diag(covariance)[:6]), 6
        placed.append(Placed("base", base, sigma))
    for name, tool in state.tools.items():
        sigma = np.full(6, np.nan)
        if "tool" in fit:
            own = tool.rotation @ covariance[at : at + 3, at : at + 3] @ tool.rotation.T
            sigma[3:], at = np.sqrt(np.diag(own)), at + 3
        placed.append(Placed(f"tool {name}".rstrip(), tool, sigma))
    return tuple(placed)


def _differences(robots: tuple[Evaluated, ...], good: np.ndarray) -> tuple[Difference, ...]:
    """Returns paired differences between robots; errors of rows that are hard for all robots cancel in them."""
    order = sorted(robots, key=lambda each: each.errors_mm[good].mean())
    better, found = order[0], []
    for worse in order[1:]:
        apart = (worse.errors_mm - better.errors_mm)[good]
        mean, sigma = float(apart.mean()), float(apart.std(ddof=1) / np.sqrt(len(apart))) if len(apart) > 1 else np.inf
        p = 2 * t_distribution.sf(mean / sigma, len(apart) - 1) if 0 < sigma < np.inf else float(mean == 0 or sigma > 0)
        found.append(
            Difference(better.robot.name, worse.robot.name, mean, sigma, float(min(1.0, (len(order) - 1) * p)))
        )
    return tuple(found)
